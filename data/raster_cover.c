/* raster_cover.c: which pixels of a tile a triangle covers, and whether it is the nearest there. */
#include <float.h>
#include <math.h>

#include "data/raster_inside.h"
#include "data/texture.h"

/* ---------------------------------------------------------------- edges */

static void cross(const double a[3], const double b[3], double y[3])
{
    y[0] = a[1] * b[2] - a[2] * b[1];
    y[1] = a[2] * b[0] - a[0] * b[2];
    y[2] = a[0] * b[1] - a[1] * b[0];
}

/* n . v0, and n.  From differences of corners, which keep their digits when a triangle is small. */
static double plane(double (*cam)[3], const size_t corner[3], double n[3])
{
    const double *v0 = cam[corner[0]], *v1 = cam[corner[1]], *v2 = cam[corner[2]];
    double p[3], q[3];
    for (int c = 0; c < 3; c++) p[c] = v1[c] - v0[c], q[c] = v2[c] - v0[c];
    cross(p, q, n);
    return n[0] * v0[0] + n[1] * v0[1] + n[2] * v0[2];
}

double dar_raster_side(const dar_raster *r, const size_t corner[3])
{
    double n[3];
    return plane(r->in->cam, corner, n);
}

/* Products are rounded before they are subtracted, so cross(a, b) = -cross(b, a) to the bit: what makes common edges
 * tight. */
void dar_raster_edges_of(const dar_raster *r, const size_t corner[3], dar_raster_edges *e)
{
    double n[3], side = plane(r->in->cam, corner, n), sign = side < 0 ? -1 : 1;

    e->back = side > 0;
    for (int k = 0; k < 3; k++) {
        double m[3];
        cross(r->in->cam[corner[(k + 1) % 3]], r->in->cam[corner[(k + 2) % 3]], m);
        e->a[k] = sign * m[0];
        e->b[k] = sign * m[1];
        e->c[k] = sign * m[2];
        /* On the edge itself: the inside lies to the right, or straight below. */
        e->least[k] = e->a[k] > 0 || (e->a[k] == 0 && e->b[k] > 0) ? 0 : DBL_TRUE_MIN;
        e->w[k] = n[k] / side;
    }
}

/* ---------------------------------------------------------------- rows */

/* One row of a triangle: E_k and 1 / depth at dx are x[k] dx + y[k]; k = 3 is 1 / depth. */
struct row {
    double x[4], y[4], least[3], most; /* most: 1 / near */
};

static struct row row_of(const dar_raster_edges *e, double near)
{
    struct row r = { .most = 1 / near };
    for (int k = 0; k < 3; k++) r.x[k] = e->a[k], r.least[k] = e->least[k];
    r.x[3] = e->w[0];
    return r;
}

static void row_at(struct row *r, const dar_raster_edges *e, double dy)
{
    for (int k = 0; k < 3; k++) r->y[k] = e->b[k] * dy + e->c[k];
    r->y[3] = e->w[1] * dy + e->w[2];
}

static void cover_row(const struct row *row, const double *restrict dx, size_t n, double id, double *restrict nearest,
                      double *restrict shown)
{
    const struct row r = *row;
    for (size_t i = 0; i < n; i++) {
        double e0 = r.x[0] * dx[i] + r.y[0], e1 = r.x[1] * dx[i] + r.y[1], e2 = r.x[2] * dx[i] + r.y[2];
        double w = r.x[3] * dx[i] + r.y[3], old = nearest[i];
        double was = shown[i];
        bool hit = (e0 >= r.least[0]) & (e1 >= r.least[1]) & (e2 >= r.least[2]) & (w > old) & (w <= r.most);
        nearest[i] = hit ? w : old;
        shown[i] = hit ? id : was;
    }
}

/* ---------------------------------------------------------------- alpha */

struct alpha {
    const dar_scene *scene;
    const dar_material *material;
    double at[3][3]; /* u, v and the vertex's alpha at the corners */
    double cutoff;
};

static struct alpha alpha_of(const dar_raster *r, const dar_raster_piece *p, size_t t)
{
    const dar_mesh *m = &r->scene->mesh[r->scene->instance[p->instance].mesh];
    struct alpha a = { r->scene, &r->scene->material[p->material], { { 0 } }, p->cutoff };
    for (int k = 0; k < 3; k++) {
        size_t v = m->index[3 * t + (size_t)k];
        for (size_t c = 0; c < 2 && m->uv; c++) a.at[k][c] = m->uv[2 * v + c];
        a.at[k][2] = m->color ? m->color[4 * v + 3] : 1;
    }
    return a;
}

static bool there(const struct alpha *a, const double e[3])
{
    double sum = e[0] + e[1] + e[2], x[3];
    for (int c = 0; c < 3; c++) x[c] = (e[0] * a->at[0][c] + e[1] * a->at[1][c] + e[2] * a->at[2][c]) / sum;
    return x[2] * a->material->color[3] * dar_texture_alpha(a->scene, a->material, x[0], x[1]) >= a->cutoff;
}

static void cover_row_masked(const struct row *r, const struct alpha *a, const double *dx, size_t n, double id,
                             double *nearest, double *shown)
{
    for (size_t i = 0; i < n; i++) {
        double e[3], w = r->x[3] * dx[i] + r->y[3];
        for (int k = 0; k < 3; k++) e[k] = r->x[k] * dx[i] + r->y[k];
        if (!(w > nearest[i] && w <= r->most && e[0] >= r->least[0] && e[1] >= r->least[1] && e[2] >= r->least[2]))
            continue;
        if (!there(a, e)) continue;
        nearest[i] = w;
        shown[i] = id;
    }
}

/* ---------------------------------------------------------------- a tile */

/* Whether the rectangle of rays lies outside an edge: its farthest corner does. */
static bool misses(const dar_raster_edges *e, const double *dx, const double *dy, size_t columns, size_t rows)
{
    for (int k = 0; k < 3; k++) {
        double x = e->a[k] > 0 ? dx[columns - 1] : dx[0], y = e->b[k] > 0 ? dy[rows - 1] : dy[0];
        if (e->a[k] * x + (e->b[k] * y + e->c[k]) < e->least[k]) return true;
    }
    return false;
}

static void cover_triangle(dar_raster *r, size_t tile, uint32_t id)
{
    struct dar_raster_inside *in = r->in;
    const dar_raster_piece *p = &in->piece[id / DAR_RASTER_PIECE];
    const dar_raster_box b = in->bounds[id];
    size_t left = tile % in->tiles_x * DAR_TILE_WIDTH, top = tile / in->tiles_x * DAR_TILE_HEIGHT;
    size_t x0 = b.x0 > left ? b.x0 : left, x1 = b.x1 < left + DAR_TILE_WIDTH - 1 ? b.x1 : left + DAR_TILE_WIDTH - 1;
    size_t y0 = b.y0 > top ? b.y0 : top, y1 = b.y1 < top + DAR_TILE_HEIGHT - 1 ? b.y1 : top + DAR_TILE_HEIGHT - 1;
    size_t t = p->triangle + id % DAR_RASTER_PIECE, n = x1 + 1 - x0, corner[3];
    const double *dx = in->dx + x0;
    dar_raster_edges e;
    struct alpha a = { 0 };

    dar_raster_corners(r, p->instance, t, corner);
    dar_raster_edges_of(r, corner, &e);
    if (misses(&e, dx, in->dy + y0, n, y1 + 1 - y0)) return;
    struct row row = row_of(&e, r->view.near);
    if (p->masked) a = alpha_of(r, p, t);
    for (size_t y = y0; y <= y1; y++) {
        size_t at = tile * DAR_TILE_PIXELS + (y - top) * DAR_TILE_WIDTH + (x0 - left);
        row_at(&row, &e, in->dy[y]);
        if (p->masked) cover_row_masked(&row, &a, dx, n, id + 1.0, in->nearest + at, in->shown + at);
        else cover_row(&row, dx, n, id + 1.0, in->nearest + at, in->shown + at);
    }
}

void dar_raster_cover(dar_raster *r, size_t tile, bool fresh)
{
    struct dar_raster_inside *in = r->in;
    size_t first = tile * DAR_TILE_PIXELS;

    for (size_t i = first; fresh && i < first + DAR_TILE_PIXELS; i++) in->nearest[i] = 0, in->shown[i] = 0;
    for (size_t i = in->start[tile]; i < in->start[tile + 1]; i++) cover_triangle(r, tile, in->reference[i]);
}
