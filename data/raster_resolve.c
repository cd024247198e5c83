/* raster_resolve.c: families of the visible triangles, and zeros where there are none. */
#include <math.h>
#include <string.h>

#include "data/raster_inside.h"
#include "lib/size.h"
#include "lib/thread.h"

/* One visible triangle: only what the families asked for need.  Attribute k of corner c is x[c][k]. */
struct surface {
    dar_raster_edges edges;
    const dar_raster_piece *piece;
    double depth[3], world[3][3], normal[3][3], rest[3][3];
    double own[3];           /* its own normal, outwards, not of unit length */
    double origin[3], scale; /* colour of rest coordinates */
    double turn;             /* of the normal: 1 or -1 */
    uint32_t part, triangle;
};

struct job {
    const dar_raster *r;
    const dar_pose *pose;
    const dar_gbuffer *out;
};

/* ---------------------------------------------------------------- a triangle */

static void load(const float *from, double x[3])
{
    for (int c = 0; c < 3; c++) x[c] = from[c];
}

static void set_normals(const struct job *j, struct surface *s, const size_t corner[3])
{
    bool mirrored = j->pose->mirrored[s->piece->instance];
    double u[3], v[3], sign = mirrored ? -1 : 1;

    for (int k = 0; k < 3; k++) load(j->r->normal + 3 * corner[k], s->normal[k]);
    for (int c = 0; c < 3; c++) {
        u[c] = sign * (s->world[1][c] - s->world[0][c]);
        v[c] = s->world[2][c] - s->world[0][c];
    }
    for (int c = 0; c < 3; c++) {
        int d = (c + 1) % 3, f = (c + 2) % 3;
        s->own[c] = u[d] * v[f] - u[f] * v[d];
    }
    s->turn = s->piece->double_sided && s->edges.back != mirrored ? -1 : 1;
}

static void set_colours(const struct job *j, struct surface *s, size_t t)
{
    const dar_identity *d = j->r->identity;
    int mesh = j->r->scene->instance[s->piece->instance].mesh;
    const uint32_t *index = j->r->scene->mesh[mesh].index + 3 * t;
    uint32_t part = d->mesh[mesh].part[t];

    for (int k = 0; k < 3; k++) load(d->mesh[mesh].rest + 3 * (size_t)index[k], s->rest[k]);
    s->part = (uint32_t)(d->first[s->piece->instance] + part + 1);
    dar_identity_cell(d, s->piece->instance, part, s->origin, &s->scale);
}

static void set_surface(const struct job *j, struct surface *s, size_t id)
{
    const dar_raster *r = j->r;
    size_t corner[3], t;

    s->piece = &r->in->piece[id / DAR_RASTER_PIECE];
    t = s->piece->triangle + id % DAR_RASTER_PIECE;
    s->triangle = (uint32_t)t;
    dar_raster_corners(r, s->piece->instance, t, corner);
    dar_raster_edges_of(r, corner, &s->edges);
    for (int k = 0; k < 3; k++) {
        s->depth[k] = r->in->cam[corner[k]][2];
        load(r->position + 3 * corner[k], s->world[k]);
    }
    if (j->out->normal) set_normals(j, s, corner);
    if (j->out->tracking || j->out->part) set_colours(j, s, t);
}

/* ---------------------------------------------------------------- a pixel */

static void blend(const double b[3], double x[3][3], double y[3])
{
    for (int c = 0; c < 3; c++) y[c] = b[0] * x[0][c] + b[1] * x[1][c] + b[2] * x[2][c];
}

static void shade(const struct job *j, const struct surface *s, const double b[3], const double x[3], double n[3])
{
    blend(b, (double(*)[3])s->normal, n);
    double square = n[0] * n[0] + n[1] * n[1] + n[2] * n[2], turn = s->turn;
    if (!(square > 1e-12)) { /* corners without normals, or against each other */
        double most = fmax(fabs(s->own[0]), fmax(fabs(s->own[1]), fabs(s->own[2])));
        for (int c = 0; c < 3; c++) n[c] = most > 0 ? s->own[c] / most : c == 2;
        square = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
    }
    if (j->r->config.normals == DAR_NORMALS_CAMERA) {
        const double *m = j->r->view.c2w;
        turn = n[0] * (x[0] - m[3]) + n[1] * (x[1] - m[7]) + n[2] * (x[2] - m[11]) > 0 ? -1 : 1;
    }
    double scale = turn / sqrt(square);
    for (int c = 0; c < 3; c++) n[c] *= scale;
}

static void store(float *plane, size_t pixels, size_t at, const double x[3])
{
    for (size_t c = 0; c < 3; c++) plane[c * pixels + at] = (float)x[c];
}

static void resolve_pixel(const struct job *j, const struct surface *s, double dx, double dy, size_t at)
{
    const dar_gbuffer *out = j->out;
    size_t pixels = (size_t)j->r->config.width * (size_t)j->r->config.height;
    double b[3], x[3], y[3];

    for (int k = 0; k < 3; k++) b[k] = s->edges.a[k] * dx + (s->edges.b[k] * dy + s->edges.c[k]);
    double inverse = 1 / (b[0] + b[1] + b[2]);
    for (int k = 0; k < 3; k++) b[k] *= inverse;
    if (out->mask) out->mask[at] = 1;
    if (out->instance) out->instance[at] = s->piece->instance + 1;
    if (out->part) out->part[at] = s->part;
    if (out->triangle) out->triangle[at] = s->triangle + 1;
    for (size_t c = 0; c < 2 && out->corner; c++) out->corner[c * pixels + at] = (float)b[c + 1];
    if (out->depth) out->depth[at] = (float)(b[0] * s->depth[0] + b[1] * s->depth[1] + b[2] * s->depth[2]);
    if (out->world || out->normal) blend(b, (double(*)[3])s->world, x);
    if (out->world) store(out->world, pixels, at, x);
    if (out->normal) {
        shade(j, s, b, x, y);
        store(out->normal, pixels, at, y);
    }
    if (out->tracking) {
        blend(b, (double(*)[3])s->rest, y);
        for (int c = 0; c < 3; c++) y[c] = s->origin[c] + s->scale * y[c];
        store(out->tracking, pixels, at, y);
    }
}

/* ---------------------------------------------------------------- tiles */

static void clear(void *family, size_t bytes, size_t at, size_t n)
{
    if (family) memset((unsigned char *)family + bytes * at, 0, bytes * n);
}

/* Zeros in n pixels of a row. */
static void clear_row(const dar_raster *r, const dar_gbuffer *out, size_t at, size_t n)
{
    size_t pixels = (size_t)r->config.width * (size_t)r->config.height;
    for (size_t c = 0; c < 3; c++) {
        clear(out->tracking, 4, c * pixels + at, n);
        clear(out->world, 4, c * pixels + at, n);
        clear(out->normal, 4, c * pixels + at, n);
        if (c < 2) clear(out->corner, 4, c * pixels + at, n);
    }
    clear(out->instance, 4, at, n);
    clear(out->part, 4, at, n);
    clear(out->triangle, 4, at, n);
    clear(out->depth, 4, at, n);
    clear(out->mask, 1, at, n);
}

void dar_raster_resolve(const dar_raster *r, const dar_pose *p, const dar_gbuffer *out, size_t tile)
{
    const struct dar_raster_inside *in = r->in;
    size_t width = (size_t)r->config.width, height = (size_t)r->config.height;
    size_t left = tile % in->tiles_x * DAR_TILE_WIDTH, top = tile / in->tiles_x * DAR_TILE_HEIGHT;
    size_t n = dar_least(DAR_TILE_WIDTH, width - left), bottom = dar_least(top + DAR_TILE_HEIGHT, height);
    const double *shown = in->shown + tile * DAR_TILE_PIXELS;
    struct job j = { r, p, out };
    struct surface s;
    double id = 0;

    for (size_t y = top; y < bottom; y++, shown += DAR_TILE_WIDTH) {
        size_t at = y * width + left;
        clear_row(r, out, at, n);
        for (size_t x = 0; x < n; x++) {
            if (!shown[x]) continue;
            if (shown[x] != id) set_surface(&j, &s, (size_t)(id = shown[x]) - 1);
            resolve_pixel(&j, &s, in->dx[left + x], in->dy[y], at + x);
        }
    }
}

/* Runs of empty tiles in one row of tiles, but those that are zero already. */
static void fill_row(void *ctx, size_t row, int thread)
{
    const struct job *j = ctx;
    const struct dar_raster_inside *in = j->r->in;
    const bool *used = in->used + row * in->tiles_x;
    bool *zero = in->zero + row * in->tiles_x;
    size_t width = (size_t)j->r->config.width, height = (size_t)j->r->config.height;
    size_t top = row * DAR_TILE_HEIGHT, bottom = dar_least(top + DAR_TILE_HEIGHT, height);
    (void)thread;

    for (size_t a = 0, b; a < in->tiles_x; a = b + 1) {
        for (b = a; b < in->tiles_x && !used[b] && !zero[b];) b++;
        if (a == b) continue;
        size_t left = a * DAR_TILE_WIDTH, n = dar_least(b * DAR_TILE_WIDTH, width) - left;
        if (n == width) clear_row(j->r, j->out, top * width, (bottom - top) * width);
        else
            for (size_t y = top; y < bottom; y++) clear_row(j->r, j->out, y * width + left, n);
    }
    for (size_t i = 0; i < in->tiles_x; i++) zero[i] = !used[i];
}

void dar_raster_fill(const dar_raster *r, const dar_gbuffer *out)
{
    struct job j = { r, NULL, out };
    dar_parallel(r->in->tiles_y, fill_row, &j);
}
