/* tracks.c: pick by area, follow by barycentric coordinates, draw as squares. */
#include "data/tracks.h"

#include <math.h>
#include <string.h>

#include "lib/thread.h"

#define CHUNK 1024 /* points of a task */

/* ---------------------------------------------------------------- where a point is */

static void corners(const dar_raster *r, const dar_surface_point *p, const float *x[3])
{
    const dar_instance *in = &r->scene->instance[p->instance];
    const uint32_t *index = r->scene->mesh[in->mesh].index + 3 * (size_t)p->triangle;
    for (int k = 0; k < 3; k++) x[k] = r->position + 3 * (in->vertex + index[k]);
}

/* In the camera. */
static void place(const dar_raster *r, const dar_surface_point *p, double y[3])
{
    const double *m = r->view.c2w;
    const float *x[3];
    double d[3];
    corners(r, p, x);
    for (int c = 0; c < 3; c++) d[c] = p->b[0] * x[0][c] + p->b[1] * x[1][c] + p->b[2] * x[2][c] - m[4 * c + 3];
    for (int k = 0; k < 3; k++) y[k] = m[k] * d[0] + m[4 + k] * d[1] + m[8 + k] * d[2];
}

/* x, y, depth; false: nearer than the near plane. */
static bool project(const dar_raster *r, const dar_surface_point *p, double at[3])
{
    const dar_view *v = &r->view;
    double y[3];
    place(r, p, y);
    if (y[2] < v->near) return false;
    at[0] = v->fx * y[0] / y[2] + v->cx;
    at[1] = v->fy * y[1] / y[2] + v->cy;
    at[2] = y[2];
    return true;
}

static bool is_visible(const dar_raster *r, const dar_surface_point *p, const double at[3])
{
    int width = r->config.width, height = r->config.height;
    if (!(at[0] >= 0 && at[0] < width && at[1] >= 0 && at[1] < height)) return false;
    if (dar_raster_is_back(r, p->instance, p->triangle)) return false;
    int x0 = (int)floor(at[0] - 0.5), y0 = (int)floor(at[1] - 0.5);
    for (int k = 0; k < 4; k++) {
        int x = x0 + (k & 1), y = y0 + (k >> 1);
        if (x < 0 || x >= width || y < 0 || y >= height) continue;
        double depth = dar_raster_depth(r, x, y);
        if (depth == 0 || at[2] <= depth * (1 + DAR_TRACKS_TOLERANCE)) return true;
    }
    return false;
}

/* ---------------------------------------------------------------- pick */

static double area(const dar_raster *r, const dar_surface_point *p)
{
    const float *x[3];
    double u[3], v[3], sum = 0;
    corners(r, p, x);
    for (int c = 0; c < 3; c++) u[c] = (double)x[1][c] - x[0][c], v[c] = (double)x[2][c] - x[0][c];
    for (int c = 0; c < 3; c++) {
        int d = (c + 1) % 3, f = (c + 2) % 3;
        double n = u[d] * v[f] - u[f] * v[d];
        sum += n * n;
    }
    return sqrt(sum) / 2;
}

/* Triangles of all instances in one row: first of each instance. */
static size_t count_triangles(const dar_scene *s, size_t *first)
{
    size_t n = 0;
    for (size_t i = 0; i < s->instances; i++) {
        first[i] = n;
        n += s->mesh[s->instance[i].mesh].triangles;
    }
    return n;
}

static void mark_shown(const dar_raster *r, const size_t *first, uint8_t *wanted)
{
    uint32_t instance, triangle;
    for (int y = 0; y < r->config.height; y++)
        for (int x = 0; x < r->config.width; x++)
            if (dar_raster_at(r, x, y, &instance, &triangle)) wanted[first[instance] + triangle] = 1;
}

/* sum[k] = area of the wanted triangles up to k; returns that of all. */
static double sum_areas(const dar_raster *r, const uint8_t *wanted, double *sum)
{
    double total = 0;
    size_t k = 0;
    for (size_t i = 0; i < r->scene->instances; i++)
        for (size_t t = 0; t < r->scene->mesh[r->scene->instance[i].mesh].triangles; t++, k++) {
            dar_surface_point p = { (uint32_t)i, (uint32_t)t, { 0 } };
            if (wanted[k]) total += area(r, &p);
            sum[k] = total;
        }
    return total;
}

static size_t first_above(const double *sum, size_t n, double x)
{
    size_t lo = 0, hi = n - 1;
    while (lo < hi) {
        size_t mid = lo + (hi - lo) / 2;
        if (sum[mid] > x) hi = mid;
        else lo = mid + 1;
    }
    return lo;
}

/* Candidate i of the sequence: a share of the area, then a place on the triangle. */
static dar_surface_point candidate(const dar_scene *s, const size_t *first, const double *sum, size_t n, size_t i)
{
    const double g = 1.2207440846057596;
    double u[3], step = 1;
    dar_surface_point p = { 0 };

    for (int k = 0; k < 3; k++) {
        step /= g;
        u[k] = fmod(0.5 + (double)(i + 1) * step, 1);
    }
    size_t at = first_above(sum, n, u[0] * sum[n - 1]);
    for (size_t end = s->instances; end - p.instance > 1;) { /* the last whose first is not behind */
        size_t mid = p.instance + (end - p.instance) / 2;
        if (first[mid] <= at) p.instance = (uint32_t)mid;
        else end = mid;
    }
    p.triangle = (uint32_t)(at - first[p.instance]);
    if (u[1] + u[2] > 1) u[1] = 1 - u[1], u[2] = 1 - u[2];
    p.b[0] = 1 - u[1] - u[2];
    p.b[1] = u[1];
    p.b[2] = u[2];
    return p;
}

size_t dar_tracks_pick(const dar_raster *r, size_t wanted, bool everywhere, dar_surface_point *point, dar_arena *a)
{
    const dar_scene *s = r->scene;
    dar_mark m = dar_arena_mark(a);
    size_t *first = dar_arena_push(a, s->instances * sizeof *first), n = count_triangles(s, first), found = 0;
    double *sum = dar_arena_push(a, n * sizeof *sum), at[3];
    uint8_t *shown = dar_arena_push(a, n);

    memset(shown, everywhere, n);
    if (!everywhere) mark_shown(r, first, shown);
    if (n && sum_areas(r, shown, sum) > 0)
        for (size_t i = 0; found < wanted && i < wanted * DAR_TRACKS_TRIES; i++) {
            point[found] = candidate(s, first, sum, n, i);
            if (everywhere || (project(r, &point[found], at) && is_visible(r, &point[found], at))) found++;
        }
    dar_arena_reset(a, m);
    return found;
}

void dar_tracks_color(const dar_raster *r, const dar_surface_point *point, size_t n, uint8_t *color)
{
    const dar_identity *d = r->identity;
    DAR_ASSERT(d, "tracks: no identity to take colours from");

    for (size_t i = 0; i < n; i++) {
        const dar_surface_point *p = &point[i];
        int mesh = r->scene->instance[p->instance].mesh;
        const uint32_t *index = r->scene->mesh[mesh].index + 3 * (size_t)p->triangle;
        double origin[3], scale;
        dar_identity_cell(d, p->instance, d->mesh[mesh].part[p->triangle], origin, &scale);
        for (size_t c = 0; c < 3; c++) {
            double x = 0;
            for (int k = 0; k < 3; k++) x += p->b[k] * d->mesh[mesh].rest[3 * (size_t)index[k] + c];
            double q = floor(255 * (origin[c] + scale * x) + 0.5);
            color[3 * i + c] = (uint8_t)(q < 1 ? 1 : q);
        }
    }
}

/* ---------------------------------------------------------------- follow */

struct job {
    const dar_raster *r;
    const dar_surface_point *point;
    size_t frame, frames;
    float *xy, *depth;
    uint8_t *visible;
};

static void follow(void *ctx, size_t begin, size_t end, int thread)
{
    const struct job *j = ctx;
    (void)thread;
    for (size_t i = begin; i < end; i++) {
        size_t row = i * j->frames + j->frame;
        double at[3] = { -1, -1, 0 };
        bool before = project(j->r, &j->point[i], at);
        j->xy[2 * row] = (float)at[0];
        j->xy[2 * row + 1] = (float)at[1];
        j->visible[row] = before && is_visible(j->r, &j->point[i], at);
        if (j->depth) j->depth[i] = (float)at[2];
    }
}

void dar_tracks_follow(const dar_raster *r, const dar_surface_point *point, size_t n, size_t frame, size_t frames,
                       float *xy, uint8_t *visible, float *depth)
{
    struct job j = { r, point, frame, frames, xy, depth, visible };
    DAR_ASSERT(frame < frames, "tracks: frame %zu of %zu", frame, frames);
    dar_parallel_range(n, CHUNK, follow, &j);
}

/* ---------------------------------------------------------------- map */

static int clamp(int x, int most)
{
    return x < 0 ? 0 : x > most ? most : x;
}

static void draw_square(const dar_raster *r, const float *xy, const uint8_t *color, int side, uint8_t *map)
{
    int width = r->config.width, height = r->config.height, half = side / 2;
    int x = (int)xy[0], y = (int)xy[1];
    size_t plane = (size_t)width * (size_t)height;

    for (int v = clamp(y - half, height); v < clamp(y + half + 1, height); v++)
        for (int u = clamp(x - half, width); u < clamp(x + half + 1, width); u++)
            for (size_t c = 0; c < 3; c++) map[c * plane + (size_t)v * (size_t)width + (size_t)u] = color[c];
}

/* Whether a is drawn before b: deeper, of equals the later. */
static bool before(const float *depth, uint32_t a, uint32_t b)
{
    return depth[a] > depth[b] || (depth[a] == depth[b] && a > b);
}

/* Sort a heap whose root is what is drawn last. */
static void sift(uint32_t *order, size_t root, size_t n, const float *depth)
{
    for (size_t child; (child = 2 * root + 1) < n; root = child) {
        if (child + 1 < n && before(depth, order[child], order[child + 1])) child++;
        if (!before(depth, order[root], order[child])) return;
        uint32_t swap = order[root];
        order[root] = order[child];
        order[child] = swap;
    }
}

static void sort(uint32_t *order, size_t n, const float *depth)
{
    for (size_t i = n / 2; i-- > 0;) sift(order, i, n, depth);
    for (size_t end = n; end-- > 1;) {
        uint32_t swap = order[0];
        order[0] = order[end];
        order[end] = swap;
        sift(order, 0, end, depth);
    }
}

void dar_tracks_map(const dar_raster *r, size_t n, size_t frame, size_t frames, const float *xy, const uint8_t *visible,
                    const float *depth, const uint8_t *color, int side, uint8_t *map, dar_arena *a)
{
    dar_mark m = dar_arena_mark(a);
    uint32_t *order = dar_arena_push(a, n * sizeof *order);
    size_t some = 0;

    DAR_ASSERT(side > 0 && side % 2 == 1, "tracks: squares of side %d, expected odd", side);
    memset(map, 0, 3 * (size_t)r->config.width * (size_t)r->config.height);
    for (size_t i = 0; i < n; i++)
        if (visible[i * frames + frame]) order[some++] = (uint32_t)i;
    sort(order, some, depth);
    for (size_t i = 0; i < some; i++)
        draw_square(r, xy + 2 * (order[i] * frames + frame), color + 3 * (size_t)order[i], side, map);
    dar_arena_reset(a, m);
}
