/* made.h: small scenes made in memory, cameras, and a brute-force ray caster in f64 that shares nothing with the
 * rasteriser: every ray against every triangle (Moeller and Trumbore 1997). */
#ifndef DAR_TESTS_MADE_H
#define DAR_TESTS_MADE_H

#include "tests/test.h"

#include "data/affine.h"
#include "data/raster.h"

/* ---------------------------------------------------------------- scenes */

#define MADE_MOST 16 /* nodes, meshes, instances, materials */

static inline void made_init(dar_scene *s)
{
    *s = (dar_scene){ .path = "made" };
    assert_int_equal(dar_arena_init(&s->memory, "made", (size_t)64 << 20, NULL), DAR_OK);
    s->node = dar_arena_push(&s->memory, MADE_MOST * sizeof *s->node);
    s->order = dar_arena_push(&s->memory, MADE_MOST * sizeof *s->order);
    s->mesh = dar_arena_push(&s->memory, MADE_MOST * sizeof *s->mesh);
    s->instance = dar_arena_push(&s->memory, MADE_MOST * sizeof *s->instance);
    s->material = dar_arena_push(&s->memory, MADE_MOST * sizeof *s->material);
    s->skin = dar_arena_push(&s->memory, sizeof *s->skin);
}

static inline int made_material(dar_scene *s, bool double_sided)
{
    s->material[s->materials] = (dar_material){
        .name = "m", .color = { 1, 1, 1, 1 }, .image = DAR_NONE, .cutoff = 0.5, .double_sided = double_sided
    };
    return (int)s->materials++;
}

static inline dar_mesh *made_mesh(dar_scene *s, size_t vertices, size_t triangles, int material)
{
    dar_arena *a = &s->memory;
    dar_mesh *m = &s->mesh[s->meshes++];
    *m = (dar_mesh){ .name = "mesh", .vertices = vertices, .triangles = triangles, .primitives = 1 };
    m->position = dar_arena_push(a, vertices * 12);
    m->normal = dar_arena_push(a, vertices * 12);
    m->index = dar_arena_push(a, triangles * 12);
    m->primitive = dar_arena_push(a, sizeof *m->primitive);
    m->primitive[0] = (dar_primitive){ .vertices = vertices, .triangles = triangles, .material = material };
    memset(m->normal, 0, vertices * 12);
    return m;
}

static inline int made_node(dar_scene *s, int parent, const double matrix[12])
{
    dar_node *n = &s->node[s->nodes];
    *n = (dar_node){ .name = "node",
                     .parent = parent,
                     .mesh = DAR_NONE,
                     .skin = DAR_NONE,
                     .camera = DAR_NONE,
                     .has_matrix = true,
                     .in_scene = true };
    memcpy(n->matrix, matrix ? matrix : dar_affine_identity, sizeof n->matrix);
    s->nodes++;
    assert_int_equal(dar_scene_order(s), DAR_NONE);
    return (int)s->nodes - 1;
}

/* The last mesh in a node of its own. */
static inline int made_instance(dar_scene *s, int mesh, const double matrix[12])
{
    dar_mesh *m = &s->mesh[mesh];
    int node = made_node(s, DAR_NONE, matrix);
    s->node[node].mesh = mesh;
    if (m->targets) {
        s->node[node].weight = m->target_weight;
        s->node[node].first_weight = s->weights;
        s->weights += m->targets;
    }
    s->instance[s->instances++] = (dar_instance){ .node = node, .mesh = mesh, .skin = DAR_NONE, .vertex = s->vertices };
    s->vertices += m->vertices;
    return node;
}

/* A sheet of rows x columns vertices, closed in columns, in rows too if `torus`; x(u, v) and its normal by `fn`. */
typedef void made_fn(double u, double v, double x[3], double n[3]);

static inline dar_mesh *made_sheet(dar_scene *s, size_t rows, size_t columns, bool torus, made_fn *fn, int material)
{
    size_t bands = torus ? rows : rows - 1;
    dar_mesh *m = made_mesh(s, rows * columns, 2 * bands * columns, material);
    for (size_t r = 0; r < rows; r++)
        for (size_t c = 0; c < columns; c++) {
            double x[3], n[3];
            fn((double)c / (double)columns, (double)r / (double)bands, x, n);
            for (size_t k = 0; k < 3; k++) {
                m->position[3 * (r * columns + c) + k] = (float)x[k];
                m->normal[3 * (r * columns + c) + k] = (float)n[k];
            }
        }
    for (size_t r = 0; r < bands; r++)
        for (size_t c = 0; c < columns; c++) {
            uint32_t *i = m->index + 6 * (r * columns + c);
            size_t d = (c + 1) % columns, q = (r + 1) % rows;
            i[0] = i[3] = (uint32_t)(r * columns + c), i[1] = (uint32_t)(r * columns + d);
            i[2] = i[4] = (uint32_t)(q * columns + d), i[5] = (uint32_t)(q * columns + c);
        }
    return m;
}

#define PI 3.14159265358979323846

static inline void made_sphere(double u, double v, double x[3], double n[3])
{
    double a = 2 * PI * u, b = PI * v;
    n[0] = sin(b) * cos(a), n[1] = cos(b), n[2] = sin(b) * sin(a);
    for (int k = 0; k < 3; k++) x[k] = n[k];
}

static inline void made_torus(double u, double v, double x[3], double n[3])
{
    double a = 2 * PI * u, b = 2 * PI * v;
    n[0] = cos(b) * cos(a), n[1] = -sin(b), n[2] = cos(b) * sin(a);
    x[0] = (1 + 0.4 * cos(b)) * cos(a), x[1] = -0.4 * sin(b), x[2] = (1 + 0.4 * cos(b)) * sin(a);
}

static inline void made_tube(double u, double v, double x[3], double n[3])
{
    double a = 2 * PI * u;
    n[0] = cos(a), n[1] = 0, n[2] = sin(a);
    x[0] = 0.5 * n[0], x[1] = 1.5 - 3 * v, x[2] = 0.5 * n[2];
}

/* A number in [0, 1) for every i. */
static inline double made_random(uint64_t i)
{
    i = (i + 1) * 0x9e3779b97f4a7c15u;
    i = (i ^ i >> 30) * 0xbf58476d1ce4e5b9u;
    i = (i ^ i >> 27) * 0x94d049bb133111ebu;
    return (double)((i ^ i >> 31) >> 11) * 0x1p-53;
}

/* ---------------------------------------------------------------- cameras */

/* From `eye` towards `at`, y of the world upwards on the picture. */
static inline dar_view made_view(int width, int height, const double eye[3], const double at[3])
{
    dar_view v = { .width = width, .height = height, .fx = 0.9 * width, .fy = 0.91 * width, .near = 0.1 };
    double z[3], x[3], y[3], up[3] = { 0, 1, 0 };
    v.cx = 0.5 * width + 0.3, v.cy = 0.5 * height - 0.2;
    double r = sqrt(pow(at[0] - eye[0], 2) + pow(at[1] - eye[1], 2) + pow(at[2] - eye[2], 2));
    for (int k = 0; k < 3; k++) z[k] = (at[k] - eye[k]) / r;
    if (fabs(z[1]) > 0.99) up[1] = 0, up[2] = 1;
    x[0] = z[1] * up[2] - z[2] * up[1], x[1] = z[2] * up[0] - z[0] * up[2], x[2] = z[0] * up[1] - z[1] * up[0];
    r = sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]);
    for (int k = 0; k < 3; k++) x[k] /= r;
    y[0] = z[1] * x[2] - z[2] * x[1], y[1] = z[2] * x[0] - z[0] * x[2], y[2] = z[0] * x[1] - z[1] * x[0];
    for (int k = 0; k < 3; k++) {
        v.c2w[4 * k] = x[k], v.c2w[4 * k + 1] = y[k], v.c2w[4 * k + 2] = z[k];
        v.c2w[4 * k + 3] = eye[k];
    }
    return v;
}

/* Ray through (x, y) [px] in the world, depth 1 long. */
static inline void made_ray(const dar_view *v, double x, double y, double d[3])
{
    double c[3] = { (x - v->cx) / v->fx, (y - v->cy) / v->fy, 1 };
    for (int k = 0; k < 3; k++) d[k] = v->c2w[4 * k] * c[0] + v->c2w[4 * k + 1] * c[1] + v->c2w[4 * k + 2] * c[2];
}

/* ---------------------------------------------------------------- a scene with everything drawn from it */

typedef struct drawn {
    dar_arena arena;
    dar_scene *scene;
    dar_pose pose;
    dar_identity identity;
    dar_raster raster;
    dar_gbuffer g;
    size_t pixels;
} drawn;

static inline dar_gbuffer drawn_buffers(dar_arena *a, size_t pixels)
{
    dar_gbuffer g = { .tracking = dar_arena_push(a, 12 * pixels),
                      .instance = dar_arena_push(a, 4 * pixels),
                      .part = dar_arena_push(a, 4 * pixels),
                      .world = dar_arena_push(a, 12 * pixels),
                      .normal = dar_arena_push(a, 12 * pixels),
                      .depth = dar_arena_push(a, 4 * pixels),
                      .mask = dar_arena_push(a, pixels) };
    memset(g.tracking, 0xff, 12 * pixels), memset(g.instance, 0xff, 4 * pixels), memset(g.part, 0xff, 4 * pixels);
    memset(g.world, 0xff, 12 * pixels), memset(g.normal, 0xff, 12 * pixels), memset(g.depth, 0xff, 4 * pixels);
    memset(g.mask, 0xff, pixels);
    return g;
}

static inline void drawn_init(drawn *d, dar_scene *s, const dar_raster_config *c)
{
    *d = (drawn){ .scene = s, .pixels = (size_t)c->width * (size_t)c->height };
    assert_int_equal(dar_arena_init(&d->arena, "drawn", (size_t)1 << 30, NULL), DAR_OK);
    dar_pose_init(&d->pose, s, &d->arena);
    dar_identity_init(&d->identity, s, &d->arena);
    dar_raster_init(&d->raster, s, &d->identity, c, &d->arena);
    d->g = drawn_buffers(&d->arena, d->pixels);
}

static inline void drawn_at(drawn *d, int animation, double t, const dar_view *v)
{
    dar_err e;
    dar_status status = dar_pose_at(&d->pose, animation, t, &e);
    CHECK(status == DAR_OK, "%s", e.text);
    dar_raster_draw(&d->raster, &d->pose, v, &d->g, NULL);
}

/* ---------------------------------------------------------------- rays */

typedef struct hit {
    uint32_t instance, triangle;
    double depth, b[3];
} hit;

static inline void made_cross(const double a[3], const double b[3], double y[3])
{
    y[0] = a[1] * b[2] - a[2] * b[1], y[1] = a[2] * b[0] - a[0] * b[2], y[2] = a[0] * b[1] - a[1] * b[0];
}

static inline double made_dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* Corners of a posed triangle. */
static inline void made_corners(const drawn *d, size_t instance, size_t t, double x[3][3])
{
    const dar_instance *in = &d->scene->instance[instance];
    const uint32_t *index = d->scene->mesh[in->mesh].index + 3 * t;
    for (int k = 0; k < 3; k++)
        for (size_t c = 0; c < 3; c++) x[k][c] = d->raster.position[3 * (in->vertex + index[k]) + c];
}

/* o + depth dir meets the triangle; sign of *side: dir . outward normal. */
static inline bool made_meets(double x[3][3], const double o[3], const double dir[3], hit *h, double *side)
{
    double e1[3], e2[3], s[3], p[3], q[3], n[3];
    for (int c = 0; c < 3; c++) e1[c] = x[1][c] - x[0][c], e2[c] = x[2][c] - x[0][c], s[c] = o[c] - x[0][c];
    made_cross(dir, e2, p);
    made_cross(s, e1, q);
    made_cross(e1, e2, n);
    double det = made_dot(e1, p);
    if (det == 0) return false;
    h->b[1] = made_dot(s, p) / det;
    h->b[2] = made_dot(dir, q) / det;
    h->b[0] = 1 - h->b[1] - h->b[2];
    h->depth = made_dot(e2, q) / det;
    *side = made_dot(dir, n);
    return h->b[0] >= 0 && h->b[1] >= 0 && h->b[2] >= 0;
}

/* Nearest hit of the ray through (x, y) at or behind view.near; the first at equal depth. */
static inline bool made_cast(const drawn *d, const dar_view *v, double x, double y, hit *nearest)
{
    const dar_scene *s = d->scene;
    double dir[3], corner[3][3], side, o[3] = { v->c2w[3], v->c2w[7], v->c2w[11] };
    bool any = false;
    made_ray(v, x, y, dir);
    for (size_t i = 0; i < s->instances; i++) {
        const dar_mesh *m = &s->mesh[s->instance[i].mesh];
        for (size_t k = 0; k < m->primitives; k++) {
            int material = m->primitive[k].material;
            bool both =
                material == DAR_NONE || s->material[material].double_sided || d->raster.config.faces == DAR_FACES_ALL;
            for (size_t t = m->primitive[k].triangle; t < m->primitive[k].triangle + m->primitive[k].triangles; t++) {
                hit h = { .instance = (uint32_t)i, .triangle = (uint32_t)t };
                made_corners(d, i, t, corner);
                if (!made_meets(corner, o, dir, &h, &side) || h.depth < v->near) continue;
                if (!both && (side > 0) != d->pose.mirrored[i]) continue;
                if (any && h.depth >= nearest->depth) continue;
                *nearest = h;
                any = true;
            }
        }
    }
    return any;
}

/* Distance [px] of (x, y) from the nearest line along an edge of a posed triangle. */
static inline double made_edge_distance(const drawn *d, const dar_view *v, size_t instance, size_t t, double x,
                                        double y)
{
    double corner[3][3], c[3][3], n[3], least = INFINITY, ray[3] = { (x - v->cx) / v->fx, (y - v->cy) / v->fy, 1 };
    made_corners(d, instance, t, corner);
    for (int k = 0; k < 3; k++) {
        double w[3] = { corner[k][0] - v->c2w[3], corner[k][1] - v->c2w[7], corner[k][2] - v->c2w[11] };
        for (int i = 0; i < 3; i++) c[k][i] = v->c2w[i] * w[0] + v->c2w[4 + i] * w[1] + v->c2w[8 + i] * w[2];
    }
    for (int k = 0; k < 3; k++) {
        made_cross(c[k], c[(k + 1) % 3], n);
        double slope = hypot(n[0] / v->fx, n[1] / v->fy);
        if (slope > 0) least = fmin(least, fabs(made_dot(n, ray)) / slope);
    }
    return least;
}

#endif
