/* raster_bin.c: vertices into the camera, triangles past the culling, what is left into tiles. */
#include <math.h>
#include <string.h>

#include "data/raster_inside.h"
#include "lib/real.h"
#include "lib/thread.h"

#define SLACK 1e-6 /* [px] around the corners of a triangle, and relative: rounding of the projection stays inside */

/* ---------------------------------------------------------------- vertices */

struct job {
    dar_raster *r;
    const dar_pose *pose;
};

static void to_camera(const dar_view *v, const double x[3], double y[3])
{
    const double *m = v->c2w, d[3] = { x[0] - m[3], x[1] - m[7], x[2] - m[11] };
    for (int k = 0; k < 3; k++) y[k] = m[k] * d[0] + m[4 + k] * d[1] + m[8 + k] * d[2];
}

static void box_run(void *ctx, size_t i, int thread)
{
    const struct job *j = ctx;
    dar_raster_run *run = &j->r->in->run[i];
    float lo[3] = { INFINITY, INFINITY, INFINITY }, hi[3] = { -INFINITY, -INFINITY, -INFINITY };
    (void)thread;

    if (j->r->in->drawn && !j->pose->changed[run->instance]) return;
    for (size_t v = run->begin; v < run->end; v++)
        for (int c = 0; c < 3; c++) {
            float x = j->r->position[3 * v + (size_t)c];
            lo[c] = x < lo[c] ? x : lo[c];
            hi[c] = x > hi[c] ? x : hi[c];
        }
    for (int c = 0; c < 3; c++) run->box[c] = lo[c], run->box[3 + c] = hi[c];
}

static void box_instances(dar_raster *r)
{
    struct dar_raster_inside *in = r->in;
    for (size_t i = 0; i < r->scene->instances; i++)
        for (int c = 0; c < 3; c++) in->box[i][c] = INFINITY, in->box[i][3 + c] = -INFINITY;
    for (size_t i = 0; i < in->runs; i++) {
        double *box = in->box[in->run[i].instance];
        for (int c = 0; c < 3; c++) {
            box[c] = fmin(box[c], in->run[i].box[c]);
            box[3 + c] = fmax(box[3 + c], in->run[i].box[3 + c]);
        }
    }
}

/* Whether a box is outside one of the five planes of the view.  The planes lie a pixel outside the picture, which
 * makes rounding harmless. */
static bool box_outside(const dar_view *v, const double box[6])
{
    double left = (-1 - v->cx) / v->fx, right = (v->width + 1 - v->cx) / v->fx;
    double top = (-1 - v->cy) / v->fy, bottom = (v->height + 1 - v->cy) / v->fy;
    int out[5] = { 0 };

    if (!(box[0] <= box[3])) return true;
    for (int k = 0; k < 8; k++) {
        double x[3] = { box[k & 1 ? 3 : 0], box[k & 2 ? 4 : 1], box[k & 4 ? 5 : 2] }, y[3];
        to_camera(v, x, y);
        out[0] += y[2] < 0;
        out[1] += y[0] < left * y[2];
        out[2] += y[0] > right * y[2];
        out[3] += y[1] < top * y[2];
        out[4] += y[1] > bottom * y[2];
    }
    return out[0] == 8 || out[1] == 8 || out[2] == 8 || out[3] == 8 || out[4] == 8;
}

static void transform_run(void *ctx, size_t i, int thread)
{
    const struct job *j = ctx;
    struct dar_raster_inside *in = j->r->in;
    const dar_raster_run *run = &in->run[i];
    const dar_view *v = &j->r->view;
    (void)thread;

    if (!in->seen[run->instance] || in->kept[run->instance]) return;
    for (size_t k = run->begin; k < run->end; k++) {
        const float *p = j->r->position + 3 * k;
        const double x[3] = { p[0], p[1], p[2] };
        double *y = in->cam[k];
        to_camera(v, x, y);
        if (y[2] < v->near) continue;
        in->px[k][0] = v->fx * y[0] / y[2] + v->cx;
        in->px[k][1] = v->fy * y[1] / y[2] + v->cy;
    }
}

void dar_raster_transform(dar_raster *r, const dar_pose *p, bool moved)
{
    struct dar_raster_inside *in = r->in;
    struct job j = { r, p };

    dar_parallel(in->runs, box_run, &j);
    box_instances(r);
    for (size_t i = 0; i < r->scene->instances; i++) {
        size_t vertices = r->scene->mesh[r->scene->instance[i].mesh].vertices;
        in->seen[i] = !box_outside(&r->view, in->box[i]);
        in->kept[i] = in->kept[i] && !moved && !p->changed[i];
        r->stats.instances++;
        r->stats.instances_outside += !in->seen[i];
        r->stats.vertices += vertices;
        r->stats.vertices_kept += in->kept[i] || !in->seen[i] ? vertices : 0;
    }
    dar_parallel(in->runs, transform_run, &j);
    for (size_t i = 0; i < r->scene->instances; i++) in->kept[i] = in->kept[i] || in->seen[i];
}

/* ---------------------------------------------------------------- culling */

/* Grow box (lowest x, y, highest x, y) by a point. */
static void grow(double box[4], double x, double y)
{
    box[0] = dar_lesser(x, box[0]);
    box[1] = dar_lesser(y, box[1]);
    box[2] = dar_greater(x, box[2]);
    box[3] = dar_greater(y, box[3]);
}

/* Of the part of a triangle that is not nearer than near. */
static void box_triangle(const dar_raster *r, const size_t corner[3], double box[4])
{
    const dar_view *view = &r->view;
    for (int k = 0; k < 3; k++) {
        const double *v = r->in->cam[corner[k]], *u = r->in->cam[corner[(k + 1) % 3]];
        if (v[2] >= view->near) grow(box, r->in->px[corner[k]][0], r->in->px[corner[k]][1]);
        if ((v[2] >= view->near) == (u[2] >= view->near)) continue;
        double t = (view->near - v[2]) / (u[2] - v[2]), z = view->near;
        grow(box, view->fx * (v[0] + t * (u[0] - v[0])) / z + view->cx,
             view->fy * (v[1] + t * (u[1] - v[1])) / z + view->cy);
    }
}

/* Centres between lo and hi among n pixels: first and last, first > last if none. */
static void centres(double lo, double hi, int n, int *first, int *last)
{
    lo -= SLACK + SLACK * fabs(lo);
    hi += SLACK + SLACK * fabs(hi);
    *first = lo < 0.5 ? 0 : lo > n ? n : (int)ceil(lo - 0.5);
    *last = hi > n ? n - 1 : hi < 0.5 ? -1 : (int)floor(hi - 0.5);
}

/* Why triangle t of the piece needs not be drawn, as a counter of the piece; NULL: draw it, in *b. */
static uint32_t *cull(const struct job *j, dar_raster_piece *p, size_t t, dar_raster_box *b)
{
    const dar_raster *r = j->r;
    const double near = r->view.near;
    double box[4] = { INFINITY, INFINITY, -INFINITY, -INFINITY };
    size_t corner[3];
    int x0, y0, x1, y1;

    dar_raster_corners(r, p->instance, p->triangle + t, corner);
    double(*v)[3] = r->in->cam;
    if (v[corner[0]][2] < near && v[corner[1]][2] < near && v[corner[2]][2] < near) return &p->behind;
    box_triangle(r, corner, box);
    centres(box[0], box[2], r->config.width, &x0, &x1);
    centres(box[1], box[3], r->config.height, &y0, &y1);
    if (x1 < 0 || y1 < 0 || x0 >= r->config.width || y0 >= r->config.height) return &p->outside;
    if (x1 < x0 || y1 < y0) return &p->small;
    double side = dar_raster_side(r, corner);
    if (side == 0) return &p->edge_on;
    if (r->config.faces == DAR_FACES_MATERIAL && !p->double_sided && (side > 0) != j->pose->mirrored[p->instance])
        return &p->back;
    *b = (dar_raster_box){ (uint16_t)x0, (uint16_t)y0, (uint16_t)x1, (uint16_t)y1 };
    return NULL;
}

/* Tiles of a box: first and behind the last. */
static void tiles_of(const dar_raster_box *b, size_t tile[4])
{
    tile[0] = b->x0 / DAR_TILE_WIDTH;
    tile[1] = b->y0 / DAR_TILE_HEIGHT;
    tile[2] = (size_t)b->x1 / DAR_TILE_WIDTH + 1;
    tile[3] = (size_t)b->y1 / DAR_TILE_HEIGHT + 1;
}

static void cull_piece(void *ctx, size_t i, int thread)
{
    const struct job *j = ctx;
    dar_raster_piece *p = &j->r->in->piece[i];
    dar_raster_box *b = j->r->in->bounds + i * DAR_RASTER_PIECE;
    size_t tile[4];
    (void)thread;

    p->references = 0;
    p->outside = p->behind = p->back = p->edge_on = p->small = 0;
    if (!j->r->in->seen[p->instance]) return;
    for (size_t t = 0; t < p->count; t++) {
        uint32_t *reason = cull(j, p, t, &b[t]);
        if (reason) {
            (*reason)++;
            b[t] = (dar_raster_box){ 1, 0, 0, 0 };
        } else {
            tiles_of(&b[t], tile);
            p->references += (tile[2] - tile[0]) * (tile[3] - tile[1]);
        }
    }
}

void dar_raster_cull(dar_raster *r, const dar_pose *p)
{
    struct dar_raster_inside *in = r->in;
    dar_raster_stats *s = &r->stats;
    struct job j = { r, p };

    dar_parallel(in->pieces, cull_piece, &j);
    for (size_t i = 0; i < in->pieces; i++) {
        const dar_raster_piece *q = &in->piece[i];
        s->triangles += q->count;
        s->references += q->references;
        if (!in->seen[q->instance]) {
            s->outside_instance += q->count;
            continue;
        }
        s->outside += q->outside;
        s->behind += q->behind;
        s->back += q->back;
        s->edge_on += q->edge_on;
        s->small += q->small;
        s->drawn += q->count - q->outside - q->behind - q->back - q->edge_on - q->small;
    }
}

/* ---------------------------------------------------------------- tiles */

/* Visit every pair of a triangle of the group and a tile, in the order of triangles. */
static void walk_group(struct dar_raster_inside *in, size_t group, bool place)
{
    size_t *next = in->next + group * in->tiles_x * in->tiles_y, tile[4];

    for (size_t i = in->group[group]; i < in->group[group + 1]; i++) {
        if (!in->piece[i].references) continue;
        for (size_t t = 0; t < in->piece[i].count; t++) {
            size_t id = i * DAR_RASTER_PIECE + t;
            if (in->bounds[id].x1 < in->bounds[id].x0) continue;
            tiles_of(&in->bounds[id], tile);
            for (size_t y = tile[1]; y < tile[3]; y++)
                for (size_t x = tile[0]; x < tile[2]; x++) {
                    size_t *at = &next[y * in->tiles_x + x];
                    if (place) in->reference[*at] = (uint32_t)id;
                    (*at)++;
                }
        }
    }
}

static void count_group(void *ctx, size_t group, int thread)
{
    struct dar_raster_inside *in = ctx;
    size_t tiles = in->tiles_x * in->tiles_y;
    (void)thread;
    memset(in->next + group * tiles, 0, tiles * sizeof *in->next);
    walk_group(in, group, false);
}

static void place_group(void *ctx, size_t group, int thread)
{
    (void)thread;
    walk_group(ctx, group, true);
}

size_t dar_raster_bin(dar_raster *r, size_t first)
{
    struct dar_raster_inside *in = r->in;
    size_t tiles = in->tiles_x * in->tiles_y, end = first, sum = 0, at = 0;

    while (end < in->pieces && sum + in->piece[end].references <= in->capacity) sum += in->piece[end++].references;
    for (size_t g = 0, i = first, part = 0; g <= DAR_RASTER_GROUPS; g++) {
        while (i < end && part < sum * g / DAR_RASTER_GROUPS) part += in->piece[i++].references;
        in->group[g] = g < DAR_RASTER_GROUPS ? i : end;
    }
    dar_parallel(DAR_RASTER_GROUPS, count_group, in);
    for (size_t tile = 0; tile < tiles; tile++) {
        in->start[tile] = at;
        for (size_t g = 0; g < DAR_RASTER_GROUPS; g++) {
            size_t *next = &in->next[g * tiles + tile], count = *next;
            *next = at;
            at += count;
        }
    }
    in->start[tiles] = at;
    dar_parallel(DAR_RASTER_GROUPS, place_group, in);
    return end;
}
