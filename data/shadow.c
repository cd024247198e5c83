/* shadow.c: the map, and comparing a place with it. */
#include "data/shadow.h"

#include <math.h>

#include "lib/real.h"

#define DISTANCE 1000.0 /* of the eye, in sizes of the box: its rays are parallel to 1e-3 */
#define STEEP    6.0f   /* most slope of a plane that is followed */
#define MOST     4      /* reach of an edge [texels] */
#define TEXELS   (2 * MOST)

/* Axes x, y across the direction, z away from the sun. */
static void set_axes(dar_view *v, const double toward[3])
{
    int flat = fabs(toward[0]) < 0.6 ? 0 : 1; /* an axis far from the direction */
    double x[3] = { flat == 0, flat == 1, 0 }, along = toward[flat], length = sqrt(1 - along * along);
    for (int c = 0; c < 3; c++) x[c] = (x[c] - along * toward[c]) / length;
    for (int c = 0; c < 3; c++) {
        int d = (c + 1) % 3, f = (c + 2) % 3;
        v->c2w[4 * c] = x[c];
        v->c2w[4 * c + 1] = x[d] * toward[f] - x[f] * toward[d]; /* z cross x with z = -toward */
        v->c2w[4 * c + 2] = -toward[c];
    }
}

/* Look at the box so that it fills the map but for the reach of the edges. */
static void set_view(dar_shadow *s, const dar_shadow_config *c)
{
    dar_view *v = &s->view;
    double half[3] = { 0 }, size = 0, side = c->side, margin = 5;

    *v = (dar_view){ .width = c->side, .height = c->side, .cx = side / 2, .cy = side / 2 };
    set_axes(v, c->toward);
    for (int k = 0; k < 3; k++) {
        double extent = (c->hi[k] - c->lo[k]) / 2;
        size += extent * extent;
        for (int a = 0; a < 3; a++) half[a] += fabs(v->c2w[4 * k + a]) * extent;
    }
    size = size > 0 ? sqrt(size) : 1;
    double distance = DISTANCE * size;
    for (int k = 0; k < 3; k++) v->c2w[4 * k + 3] = (c->lo[k] + c->hi[k]) / 2 - distance * v->c2w[4 * k + 2];
    v->near = distance - 1.5 * size;
    for (int a = 0; a < 2; a++) {
        half[a] = fmax(half[a], 1e-3 * size);
        double focal = (side / 2 - margin) * v->near / half[a];
        *(a ? &v->fy : &v->fx) = focal;
        s->slope[a] = (float)(distance / focal);
    }
    double texel = fmax(s->slope[0], s->slope[1]);
    s->reach = (float)fmin(fmax(c->width / texel / 2, 1.5), MOST);
    s->bias = (float)(0.7 * texel + 2e-7 * distance);
}

void dar_shadow_init(dar_shadow *s, const dar_scene *scene, const dar_shadow_config *c, dar_arena *a)
{
    dar_raster_config r = dar_raster_default(c->side, c->side);
    size_t texels = (size_t)c->side * (size_t)c->side;

    *s = (dar_shadow){ .reach = 0 };
    r.faces = DAR_FACES_ALL;
    r.blend_cutoff = c->blend_cutoff;
    set_view(s, c);
    dar_raster_init(&s->raster, scene, NULL, &r, a);
    s->map.depth = dar_arena_push(a, dar_mul_size(texels, sizeof(float)));
}

void dar_shadow_draw(dar_shadow *s, const dar_pose *p)
{
    dar_raster_draw(&s->raster, p, &s->view, &s->map, s->raster.stats.frames ? &s->map : NULL);
}

/* Weights of a tent over the texels around x, zeros behind them; the first of them, and their number. */
static int tent(float x, float reach, float weight[TEXELS], float *sum, int *first)
{
    int n = 0;
    *first = (int)ceilf(x - 0.5f - reach);
    *sum = 0;
    for (int i = 0; i < TEXELS; i++) {
        float at = (float)(*first + i) + 0.5f;
        weight[i] = at < x + reach ? 1 - fabsf(at - x) / reach : 0;
        n += at < x + reach;
    }
    for (int i = 0; i < TEXELS; i++) *sum += weight[i];
    return n;
}

float dar_shadow_at(const dar_shadow *s, const float place[3], const float n[3])
{
    const dar_view *v = &s->view;
    double at[3] = { 0 }, normal[3] = { 0 };
    float wx[TEXELS], wy[TEXELS], sum_x, sum_y, lit = 0;
    int left, top;

    for (int k = 0; k < 3; k++)
        for (int a = 0; a < 3; a++) {
            at[a] += v->c2w[4 * k + a] * (place[k] - v->c2w[4 * k + 3]);
            normal[a] += v->c2w[4 * k + a] * n[k];
        }
    float x = (float)(v->fx * at[0] / at[2] + v->cx), y = (float)(v->fy * at[1] / at[2] + v->cy);
    float side = (float)v->width, reach = s->reach;
    if (!(x > reach + 1 && y > reach + 1 && x < side - reach - 1 && y < side - reach - 1)) return 1;
    tent(x, reach, wx, &sum_x, &left);
    int rows = tent(y, reach, wy, &sum_y, &top);

    /* Depth of the place's plane where texel (i, j) is: z + gx (i - x) + gy (j - y).  Columns behind the tent's weigh
     * nothing: they may be those of the next row, which is there. */
    float facing = dar_greaterf((float)-normal[2], 1e-6f);
    float gx = dar_lesserf(dar_greaterf((float)normal[0] / facing, -STEEP), STEEP) * s->slope[0];
    float gy = dar_lesserf(dar_greaterf((float)normal[1] / facing, -STEEP), STEEP) * s->slope[1];
    float z = (float)at[2] - s->bias;
    for (int j = 0; j < rows; j++) {
        const float *row = s->map.depth + (size_t)(top + j) * (size_t)v->width + left;
        float line = z + gy * ((float)(top + j) + 0.5f - y) + gx * ((float)left + 0.5f - x), part = 0, passed[TEXELS];
        for (int i = 0; i < TEXELS; i++) passed[i] = (row[i] >= line + gx * (float)i) | (row[i] == 0) ? wx[i] : 0;
        for (int i = 0; i < TEXELS; i++) part += passed[i];
        lit += wy[j] * part;
    }
    return lit / (sum_x * sum_y);
}
