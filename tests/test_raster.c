/* test_raster.c: G-buffers against rays, edges, what is skipped, threads, the propositions of the paper. */
#include "tests/made.h"

#include <unistd.h>

#include "data/gltf.h"
#include "data/rays.h"

#define ASSETS "../shared/assets/"

/* ---------------------------------------------------------------- against rays */

static double scene_size(const drawn *d)
{
    double lo[3] = { INFINITY, INFINITY, INFINITY }, hi[3] = { -INFINITY, -INFINITY, -INFINITY }, most = 0;
    for (size_t i = 0; i < 3 * d->scene->vertices; i++) {
        lo[i % 3] = fmin(lo[i % 3], d->raster.position[i]);
        hi[i % 3] = fmax(hi[i % 3], d->raster.position[i]);
    }
    for (int c = 0; c < 3; c++) most = fmax(most, hi[c] - lo[c]);
    return most;
}

/* What the hit says of the surface, in f64. */
struct truth {
    double world[3], normal[3], tracking[3];
};

static struct truth truth_of(const drawn *d, const dar_view *v, const hit *h)
{
    const dar_instance *in = &d->scene->instance[h->instance];
    const dar_identity_mesh *im = &d->identity.mesh[in->mesh];
    const uint32_t *index = d->scene->mesh[in->mesh].index + 3 * (size_t)h->triangle;
    double origin[3], scale, x[3][3], n[3], u[3], w[3], dir[3];
    struct truth t = { { 0 }, { 0 }, { 0 } };

    dar_identity_cell(&d->identity, h->instance, im->part[h->triangle], origin, &scale);
    made_corners(d, h->instance, h->triangle, x);
    for (int k = 0; k < 3; k++)
        for (size_t c = 0; c < 3; c++) {
            t.world[c] += h->b[k] * x[k][c];
            t.normal[c] += h->b[k] * d->raster.normal[3 * (in->vertex + index[k]) + c];
            t.tracking[c] += h->b[k] * (origin[c] + scale * im->rest[3 * index[k] + c]);
        }
    for (int c = 0; c < 3; c++) u[c] = x[1][c] - x[0][c], w[c] = x[2][c] - x[0][c];
    made_cross(u, w, n);
    for (int c = 0; c < 3; c++) dir[c] = t.world[c] - v->c2w[4 * c + 3];
    bool mirrored = d->pose.mirrored[h->instance], back = (made_dot(n, dir) > 0) != mirrored;
    int material = d->scene->mesh[in->mesh].primitive[0].material;
    double r = sqrt(made_dot(t.normal, t.normal)), turn = 1;
    if (r < 1e-6) {
        memcpy(t.normal, n, sizeof n);
        r = sqrt(made_dot(n, n));
        turn = mirrored ? -1 : 1;
    }
    if (back && (material == DAR_NONE || d->scene->material[material].double_sided)) turn = -turn;
    for (int c = 0; c < 3; c++) t.normal[c] *= turn / r;
    return t;
}

static void check_hit(const drawn *d, const dar_view *v, const hit *h, size_t at, double size)
{
    struct truth t = truth_of(d, v, h);
    double dot = 0;
    assert_int_equal(d->g.instance[at], h->instance + 1);
    assert_int_equal(d->g.part[at], d->identity.first[h->instance] +
                                        d->identity.mesh[d->scene->instance[h->instance].mesh].part[h->triangle] + 1);
    CHECK_NEAR("depth", d->g.depth[at], h->depth, 1e-5 * size);
    for (size_t c = 0; c < 3; c++) {
        size_t i = c * d->pixels + at;
        CHECK_NEAR("world", d->g.world[i], t.world[c], 1e-5 * size);
        CHECK_NEAR("normal", d->g.normal[i], t.normal[c], 1e-5);
        CHECK_NEAR("tracking", d->g.tracking[i], t.tracking[c], 1e-6);
        dot += (double)d->g.normal[i] * d->g.normal[i];
    }
    CHECK_NEAR("length of the normal", dot, 1, 1e-6);
}

/* Position from what is stored alone: the camera, its ray and depth. */
static void check_back_projected(const drawn *d, const dar_view *v, size_t at, double size)
{
    double o[3], r[3], along = 0;
    size_t width = (size_t)v->width;
    dar_rays_at(v, (double)(at % width) + 0.5, (double)(at / width) + 0.5, o, r);
    for (int c = 0; c < 3; c++) along += v->c2w[4 * c + 2] * r[c];
    for (size_t c = 0; c < 3; c++)
        CHECK_NEAR("back-projected", o[c] + d->g.depth[at] / along * r[c], d->g.world[c * d->pixels + at], 1e-5 * size);
}

static void check_empty(const drawn *d, size_t at)
{
    assert_int_equal(d->g.instance[at], 0);
    assert_int_equal(d->g.part[at], 0);
    assert_true(d->g.depth[at] == 0);
    for (size_t c = 0; c < 3; c++) {
        size_t i = c * d->pixels + at;
        assert_true(d->g.world[i] == 0 && d->g.normal[i] == 0 && d->g.tracking[i] == 0);
    }
}

/* Whether the centre is within 1e-6 px of an edge of the triangles that one or the other sees there. */
static bool on_edge(const drawn *d, const dar_view *v, bool cast, const hit *h, int x, int y)
{
    uint32_t instance, triangle;
    double least = INFINITY;
    if (cast) least = made_edge_distance(d, v, h->instance, h->triangle, x + 0.5, y + 0.5);
    if (dar_raster_at(&d->raster, x, y, &instance, &triangle))
        least = fmin(least, made_edge_distance(d, v, instance, triangle, x + 0.5, y + 0.5));
    return least < 1e-6;
}

struct check {
    const drawn *d;
    const dar_view *v;
    hit *hit;
    bool *cast;
};

static void cast_row(void *ctx, size_t y, int thread)
{
    const struct check *c = ctx;
    (void)thread;
    for (int x = 0; x < c->v->width; x++) {
        size_t at = y * (size_t)c->v->width + (size_t)x;
        c->cast[at] = made_cast(c->d, c->v, x + 0.5, (double)y + 0.5, &c->hit[at]);
    }
}

/* Every pixel of what is drawn.  Returns the number of pixels with a surface. */
static size_t check_rays(drawn *d, const dar_view *v)
{
    dar_mark m = dar_arena_mark(&d->arena);
    struct check c = { d, v, dar_arena_push(&d->arena, d->pixels * sizeof(hit)), dar_arena_push(&d->arena, d->pixels) };
    double size = scene_size(d);
    size_t hits = 0, edges = 0;

    dar_parallel((size_t)v->height, cast_row, &c);
    for (size_t at = 0; at < d->pixels; at++) {
        int x = (int)(at % (size_t)v->width), y = (int)(at / (size_t)v->width);
        const hit *h = &c.hit[at];
        uint32_t instance = 0, triangle = 0;
        bool shown = dar_raster_at(&d->raster, x, y, &instance, &triangle);
        assert_int_equal(d->g.mask[at], shown);
        if (shown) check_back_projected(d, v, at, size);
        else check_empty(d, at);
        hits += shown;
        if (shown == c.cast[at] && (!shown || (instance == h->instance && triangle == h->triangle))) {
            if (shown) check_hit(d, v, h, at, size);
            continue;
        }
        /* Another triangle: on an edge, or as near as rounding. */
        bool tie = shown && c.cast[at] && fabs(d->g.depth[at] - h->depth) <= 1e-6 * h->depth;
        CHECK(tie || on_edge(d, v, c.cast[at], h, x, y), "pixel %d, %d: drawn %d (%u, %u), ray %d (%u, %u)", x, y,
              shown, instance, triangle, c.cast[at], h->instance, h->triangle);
        edges++;
    }
    CHECK(edges <= d->pixels / 50, "%zu of %zu pixels on edges", edges, d->pixels);
    dar_arena_reset(&d->arena, m);
    return hits;
}

/* ---------------------------------------------------------------- scenes for them */

/* A ground of two triangles under `eye` heights 0, so large that most of it lies behind the camera. */
static void add_ground(dar_scene *s, double half, int material)
{
    dar_mesh *m = made_mesh(s, 4, 2, material);
    const float h = (float)half, x[12] = { -h, 0, -h, h, 0, -h, h, 0, h, -h, 0, h };
    static const uint32_t index[6] = { 0, 2, 1, 0, 3, 2 };
    memcpy(m->position, x, sizeof x);
    memcpy(m->index, index, sizeof index);
    for (size_t v = 0; v < 4; v++) m->normal[3 * v + 1] = 1;
    made_instance(s, (int)s->meshes - 1, NULL);
}

static void build_torus(dar_scene *s)
{
    made_sheet(s, 24, 40, true, made_torus, made_material(s, false));
    made_instance(s, 0, NULL);
}

static void build_inside(dar_scene *s) /* the camera sits in the sphere; its triangles cross every plane */
{
    made_sheet(s, 7, 9, false, made_sphere, made_material(s, true));
    made_instance(s, 0, NULL);
}

static void build_ground(dar_scene *s)
{
    add_ground(s, 1000, made_material(s, true));
    made_sheet(s, 12, 16, false, made_sphere, DAR_NONE);
    made_instance(s, 1, NULL);
}

static void build_huge(dar_scene *s)
{
    add_ground(s, 3e6, DAR_NONE);
}

static void build_tiny(dar_scene *s) /* triangles of a tenth of a pixel */
{
    made_sheet(s, 60, 90, false, made_sphere, made_material(s, false));
    made_instance(s, 0, NULL);
}

static void add_mirrored(dar_scene *s, bool double_sided) /* one mesh, right and left */
{
    const double right[12] = { 0.8, 0, 0, 1.1, 0, 0.8, 0.2, 0, 0, 0, 0.8, 0 };
    const double left[12] = { -0.8, 0, 0, -1.1, 0, 0.8, 0.2, 0, 0, 0, 0.8, 0 };
    made_sheet(s, 14, 18, true, made_torus, made_material(s, double_sided));
    made_instance(s, 0, right);
    made_instance(s, 0, left);
}

static void build_mirrored(dar_scene *s)
{
    add_mirrored(s, false);
}

static void build_mirrored_double(dar_scene *s)
{
    add_mirrored(s, true);
}

static void build_degenerate(dar_scene *s) /* points, needles, doubles, no normals */
{
    static const uint32_t index[] = { 0, 0, 1, 2, 2, 2, 0, 3, 6, 4, 5, 6, 4, 5, 6, 0, 1, 2, 5, 7, 8 };
    dar_mesh *m = made_mesh(s, 9, DAR_COUNT(index) / 3, DAR_NONE);
    memcpy(m->index, index, sizeof index);
    for (size_t i = 0; i < 27; i++) m->position[i] = (float)(2 * made_random(i) - 1);
    for (size_t c = 0; c < 3; c++) m->position[18 + c] = 2 * m->position[9 + c] - m->position[c]; /* on one line */
    made_instance(s, 0, NULL);
}

static void build_skin(dar_scene *s)
{
    dar_mesh *m = made_sheet(s, 13, 12, false, made_tube, made_material(s, true));
    dar_arena *a = &s->memory;
    static double inverse[2][12];
    const double bend[12] = { 0.6, -0.8, 0, 0, 0.8, 0.6, 0, 0, 0, 0, 1, 0 };
    int root = made_node(s, DAR_NONE, NULL), joint = made_node(s, root, bend);

    m->influences = m->joints = 2;
    m->joint = dar_arena_push(a, m->vertices * 4);
    m->weight = dar_arena_push(a, m->vertices * 8);
    for (size_t v = 0; v < m->vertices; v++) {
        float upper = fminf(1, fmaxf(0, 0.5f + m->position[3 * v + 1]));
        m->joint[2 * v] = 0, m->joint[2 * v + 1] = 1;
        m->weight[2 * v] = 1 - upper, m->weight[2 * v + 1] = upper;
    }
    memcpy(inverse[0], dar_affine_identity, 96);
    memcpy(inverse[1], dar_affine_identity, 96);
    s->skin[0] = (dar_skin){ .name = "skin", .joints = 2, .joint = dar_arena_push(a, 8), .inverse = inverse };
    s->skin[0].joint[0] = root, s->skin[0].joint[1] = joint;
    s->skins = 1;
    made_instance(s, 0, NULL);
    s->instance[0].skin = 0;
}

static void build_morph(dar_scene *s)
{
    dar_mesh *m = made_sheet(s, 20, 24, false, made_sphere, made_material(s, false));
    m->targets = 1;
    m->target_position = dar_arena_push(&s->memory, m->vertices * 12);
    m->target_weight = dar_arena_push(&s->memory, 8);
    m->target_weight[0] = 0.7;
    for (size_t v = 0; v < m->vertices; v++) {
        const float *x = m->position + 3 * v;
        m->target_position[3 * v] = 0.5f * x[0] * sinf(7 * x[1]);
        m->target_position[3 * v + 1] = 0;
        m->target_position[3 * v + 2] = 0.5f * x[2] * sinf(7 * x[1]);
    }
    made_instance(s, 0, NULL);
}

static void build_soup(dar_scene *s) /* everything through everything */
{
    dar_mesh *m = made_mesh(s, 360, 120, made_material(s, true));
    for (size_t i = 0; i < 360; i++) {
        m->index[i] = (uint32_t)i;
        for (size_t c = 0; c < 3; c++) m->position[3 * i + c] = (float)(4 * made_random(3 * i + c) - 2);
    }
    made_instance(s, 0, NULL);
}

static void build_crowd(dar_scene *s) /* more pairs of triangle and tile than fit in one round */
{
    dar_mesh *m = made_mesh(s, 6000, 2000, DAR_NONE);
    for (size_t i = 0; i < 6000; i++) {
        m->index[i] = (uint32_t)i;
        for (size_t c = 0; c < 3; c++) m->position[3 * i + c] = (float)(20 * made_random(3 * i + c) - 10);
    }
    made_instance(s, 0, NULL);
}

static const struct {
    const char *name;
    void (*build)(dar_scene *s);
    double eye[3], at[3];
    dar_faces faces;
    size_t least; /* pixels covered, of 97 x 61 */
} scenes[] = {
    { "torus", build_torus, { 1.5, 1.2, 2 }, { 0, 0, 0 }, DAR_FACES_MATERIAL, 1500 },
    { "torus, from within its tube", build_torus, { 1, 0, 0.05 }, { 0.6, 0.1, 1 }, DAR_FACES_ALL, 5900 },
    { "torus, grazing", build_torus, { 4, 0.4, 0 }, { 0, 0.4, 0 }, DAR_FACES_MATERIAL, 300 },
    { "inside a sphere", build_inside, { 0.1, 0.2, 0 }, { 1, 0.3, 0.4 }, DAR_FACES_MATERIAL, 5900 },
    { "inside, backs not drawn", build_torus, { 1, 0, 0.05 }, { 0.6, 0.1, 1 }, DAR_FACES_MATERIAL, 10 },
    { "ground around the camera", build_ground, { 0, 0.5, -3 }, { 0, 0.2, 1 }, DAR_FACES_MATERIAL, 2500 },
    { "ground, grazing", build_ground, { 0, 0.11, -3 }, { 5, 0.11, 40 }, DAR_FACES_MATERIAL, 2500 },
    { "ground at the near plane", build_ground, { 0, 0.05, -3 }, { 0, 0, 1 }, DAR_FACES_MATERIAL, 1000 },
    { "huge triangles", build_huge, { 10, 2, -3 }, { 0, 0, 50 }, DAR_FACES_MATERIAL, 2500 },
    { "tiny triangles", build_tiny, { 1, 1, 4 }, { 0, 0, 0 }, DAR_FACES_MATERIAL, 800 },
    { "mirrored", build_mirrored, { 0.5, 2, 4 }, { 0, 0, 0 }, DAR_FACES_MATERIAL, 700 },
    { "mirrored, all faces", build_mirrored, { 0.9, 0.3, 1.2 }, { -1, 0, 0 }, DAR_FACES_ALL, 1000 },
    { "mirrored, double-sided, within",
      build_mirrored_double,
      { -2, 0.25, 0 },
      { 1, 0, 0.3 },
      DAR_FACES_MATERIAL,
      1000 },
    { "degenerate", build_degenerate, { 0.5, 0.7, 2.5 }, { 0, 0, 0 }, DAR_FACES_MATERIAL, 50 },
    { "skin", build_skin, { 1.5, 1, 3 }, { 0, 0, 0 }, DAR_FACES_MATERIAL, 500 },
    { "morph", build_morph, { 1.5, 1, 3 }, { 0, 0, 0 }, DAR_FACES_MATERIAL, 700 },
    { "soup", build_soup, { 1, 1, 5 }, { 0, 0, 0 }, DAR_FACES_MATERIAL, 1500 },
    { "soup, within", build_soup, { 0.1, 0.2, 0.1 }, { 1, 0, 0 }, DAR_FACES_MATERIAL, 2500 },
    { "crowd", build_crowd, { 0, 0, 14 }, { 0, 0, 0 }, DAR_FACES_MATERIAL, 5000 },
    { "all behind", build_torus, { 0, 0, 5 }, { 0, 0, 9 }, DAR_FACES_MATERIAL, 0 },
};

static void rays(void **state)
{
    (void)state;
    for (size_t i = 0; i < DAR_COUNT(scenes); i++) {
        dar_scene s;
        drawn d;
        dar_view v = made_view(97, 61, scenes[i].eye, scenes[i].at);
        dar_raster_config c = dar_raster_default(97, 61);
        c.faces = scenes[i].faces;
        made_init(&s);
        scenes[i].build(&s);
        drawn_init(&d, &s, &c);
        drawn_at(&d, DAR_NONE, 0, &v);
        size_t hits = check_rays(&d, &v);
        CHECK(hits >= scenes[i].least && (hits || !scenes[i].least), "%s: %zu pixels covered, expected %zu",
              scenes[i].name, hits, scenes[i].least);
        assert_int_equal(d.raster.stats.rounds > 1, scenes[i].build == build_crowd);
        dar_arena_free(&d.arena);
        dar_scene_free(&s);
    }
}

/* Frames of a model: all families against rays, then the same bits for other numbers of threads. */
static void check_model(const char *file, const char *animation, double seconds, const double eye[3],
                        const double at[3], size_t least)
{
    static const int threads[] = { 1, 2, 3, 7 };
    dar_scene s;
    dar_err e;
    drawn d;
    int a, before = dar_threads();
    dar_view v = made_view(80, 60, eye, at);
    dar_raster_config c = dar_raster_default(80, 60);

    dar_status status = dar_gltf_load(&s, file, true, &e);
    CHECK(status == DAR_OK, "%s", e.text);
    assert_int_equal(dar_scene_find_animation(&s, animation, &a, &e), DAR_OK);
    drawn_init(&d, &s, &c);
    drawn_at(&d, a, 0, &v);
    drawn_at(&d, a, seconds, &v);
    size_t hits = check_rays(&d, &v);
    CHECK(hits >= least, "%s: %zu pixels covered", file, hits);

    dar_gbuffer first = d.g;
    d.g = drawn_buffers(&d.arena, d.pixels);
    for (size_t i = 0; i < DAR_COUNT(threads); i++) {
        dar_threads_set(threads[i]);
        drawn_at(&d, a, 0, &v);
        drawn_at(&d, a, seconds, &v);
        CHECK(!memcmp(first.tracking, d.g.tracking, 12 * d.pixels) && !memcmp(first.world, d.g.world, 12 * d.pixels) &&
                  !memcmp(first.normal, d.g.normal, 12 * d.pixels) && !memcmp(first.depth, d.g.depth, 4 * d.pixels) &&
                  !memcmp(first.instance, d.g.instance, 4 * d.pixels) && !memcmp(first.part, d.g.part, 4 * d.pixels) &&
                  !memcmp(first.mask, d.g.mask, d.pixels),
              "%s: %d threads: other bits", file, threads[i]);
    }
    dar_threads_set(before);
    dar_arena_free(&d.arena);
    dar_scene_free(&s);
}

static void models(void **state)
{
    (void)state;
    if (access(ASSETS "robot.glb", R_OK) != 0) SKIP("no models at " ASSETS);
    check_model(ASSETS "robot.glb", "Robot_Dance", 0.8, (double[]){ 3, 4, 7 }, (double[]){ 0, 2, 0 }, 600);
    check_model(ASSETS "robot.glb", "Robot_Walking", 0.3, (double[]){ 0.5, 3, 2 }, (double[]){ 0, 2.8, 0 }, 600);
    check_model(ASSETS "AnimatedMorphCube/AnimatedMorphCube.gltf", "", 1.1, (double[]){ 0.03, 0.04, 0.07 },
                (double[]){ 0, 0, 0 }, 150);
}

/* ---------------------------------------------------------------- edges */

/* A wall at depth 4 of n x n squares, jittered (by less than 1/2: none folds over) or exact, wider than the view; only
 * triangles of one kind (t % 3). */
static void add_wall(dar_scene *s, size_t n, double step, double jitter, int kind)
{
    dar_mesh *m = made_mesh(s, (n + 1) * (n + 1), 2 * n * n, DAR_NONE);
    size_t triangles = 0;
    for (size_t v = 0; v < m->vertices; v++) {
        double x = (double)(v % (n + 1)) - (double)n / 2, y = (double)(v / (n + 1)) - (double)n / 2;
        m->position[3 * v] = (float)(step * (x + jitter * (made_random(2 * v) - 0.5)));
        m->position[3 * v + 1] = (float)(step * (y + jitter * (made_random(2 * v + 1) - 0.5)));
        m->position[3 * v + 2] = 4;
    }
    for (size_t t = 0; t < m->triangles; t++) {
        uint32_t v = (uint32_t)(t / 2 / n * (n + 1) + t / 2 % n), w = v + (uint32_t)n + 1;
        const uint32_t corner[2][3] = { { v, v + 1, w }, { v + 1, w + 1, w } };
        if (kind < 0 || (int)(t % 3) == kind) memcpy(m->index + 3 * triangles++, corner[t % 2], 12);
    }
    m->triangles = m->primitive[0].triangles = triangles;
    made_instance(s, 0, NULL);
}

/* Kinds 0, 1, 2 together cover every pixel once. */
static void check_wall(size_t n, double step, double jitter, const dar_view *v)
{
    size_t pixels = (size_t)v->width * (size_t)v->height;
    unsigned char count[128 * 80] = { 0 };
    for (int kind = 0; kind < 3; kind++) {
        dar_raster_config c = dar_raster_default(v->width, v->height);
        dar_scene s;
        drawn d;
        made_init(&s);
        add_wall(&s, n, step, jitter, kind);
        drawn_init(&d, &s, &c);
        drawn_at(&d, DAR_NONE, 0, v);
        for (size_t i = 0; i < pixels; i++) count[i] = (unsigned char)(count[i] + d.g.mask[i]);
        dar_arena_free(&d.arena);
        dar_scene_free(&s);
    }
    for (size_t i = 0; i < pixels; i++)
        CHECK(count[i] == 1, "pixel %zu, %zu: covered %d times", i % 128, i / 128, count[i]);
}

static void edges(void **state)
{
    (void)state;
    dar_view v = { .width = 128, .height = 80, .fx = 128, .fy = 128, .cx = 64, .cy = 40, .near = 0.1 };
    memcpy(v.c2w, dar_affine_identity, sizeof v.c2w);
    check_wall(20, 0.5, 0.45, &v);    /* 16 pixels a square */
    check_wall(150, 0.033, 0.45, &v); /* one pixel */
    check_wall(320, 1.0 / 64, 0, &v); /* half a pixel: corners and edges on the centres of pixels */
    check_wall(40, 1.0 / 8, 0, &v);   /* four pixels, edges through centres once shifted by half a pixel */
    v.cx = 64.5, v.cy = 40.5;
    check_wall(60, 1.0 / 8, 0, &v);
    v.c2w[3] = 0.3, v.c2w[0] = 0.8, v.c2w[1] = -0.6, v.c2w[4] = 0.6, v.c2w[5] = 0.8; /* rolled */
    check_wall(80, 0.2, 0.45, &v);
}

/* Two equal sheets, and one triangle twice: the first in order is seen. */
static void ties(void **state)
{
    (void)state;
    dar_view v = { .width = 128, .height = 80, .fx = 128, .fy = 128, .cx = 64, .cy = 40, .near = 0.1 };
    dar_raster_config c = dar_raster_default(v.width, v.height);
    dar_scene s;
    drawn d;
    memcpy(v.c2w, dar_affine_identity, sizeof v.c2w);
    made_init(&s);
    add_wall(&s, 20, 0.5, 0.45, -1);
    made_instance(&s, 0, NULL);
    drawn_init(&d, &s, &c);
    drawn_at(&d, DAR_NONE, 0, &v);
    for (size_t i = 0; i < d.pixels; i++) assert_int_equal(d.g.instance[i], 1);
    dar_arena_free(&d.arena);
    dar_scene_free(&s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(rays),
        cmocka_unit_test(models),
        cmocka_unit_test(edges),
        cmocka_unit_test(ties),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
