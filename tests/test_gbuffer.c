/* test_gbuffer.c: what G-buffers mean: identity over time, injectivity, the propositions of the paper, sparse tracks;
 * and what is not drawn: families, frames, instances, alpha. */
#include "tests/made.h"

#include "data/tracks.h"
#include "data/world.h"

/* ---------------------------------------------------------------- a scene with everything */

#define WIDTH  96
#define HEIGHT 64

/* Two tori from one mesh, a doubled sheet, two parts in one mesh, a mirrored sphere. */
static void build(dar_scene *s)
{
    const double right[12] = { 1, 0, 0, 1.6, 0, 1, 0, 0, 0, 0, 1, 0 },
                 mirror[12] = { -1, 0, 0, -1, 0, 1, 0, 1, 0, 0, 1, 1 };
    dar_mesh *m;
    made_init(s);
    int both = made_material(s, true), one = made_material(s, false);
    made_sheet(s, 12, 20, true, made_torus, both);
    made_instance(s, 0, NULL);
    made_instance(s, 0, right);

    m = made_sheet(s, 10, 14, false, made_sphere, one); /* cut in two: the band in the middle is left out */
    size_t band = 28, above = 4 * band, below = 4 * band;
    memmove(m->index + 3 * above, m->index + 3 * (above + band), below * 12);
    m->triangles = m->primitive[0].triangles = above + below;
    made_instance(s, 1, mirror);

    m = made_mesh(s, 8, 4, one); /* a square and its back, corners apart */
    static const float corner[4][3] = { { -1, -1, -1 }, { 1, -1, -1 }, { 1, 1, -1 }, { -1, 1, -1 } };
    static const uint32_t index[12] = { 0, 1, 2, 0, 2, 3, 6, 5, 4, 7, 6, 4 };
    memcpy(m->position, corner, sizeof corner);
    memcpy(m->position + 12, corner, sizeof corner);
    memcpy(m->index, index, sizeof index);
    made_instance(s, 2, NULL);
}

static void draw_init(dar_scene *s, drawn *d)
{
    dar_raster_config c = dar_raster_default(WIDTH, HEIGHT);
    build(s);
    drawn_init(d, s, &c);
}

static void draw_free(dar_scene *s, drawn *d)
{
    dar_arena_free(&d->arena);
    dar_scene_free(s);
}

/* Turn and move instance 0, so that the scene is another. */
static void move_first(dar_scene *s, double angle)
{
    double *m = s->node[s->instance[0].node].matrix;
    m[0] = m[10] = cos(angle), m[2] = sin(angle), m[8] = -sin(angle), m[3] = 0.3 * angle;
}

/* ---------------------------------------------------------------- identity */

static void parts(void **state)
{
    (void)state;
    dar_scene s;
    drawn d;
    draw_init(&s, &d);
    assert_int_equal(d.identity.mesh[0].parts, 1);
    assert_int_equal(d.identity.mesh[1].parts, 2);
    assert_int_equal(d.identity.mesh[2].parts, 2);
    assert_int_equal(d.identity.parts, 6);
    assert_int_equal(d.identity.side, 2);
    const uint32_t *sheet = d.identity.mesh[2].part;
    assert_true(sheet[0] == 0 && sheet[1] == 0 && sheet[2] == 1 && sheet[3] == 1);
    draw_free(&s, &d);

    /* Corners apart at equal places, 0 and -0 among them, hang together; a third triangle lies elsewhere. */
    static const float corner[9][3] = { { 0, 0, 0 },     { 1, 0, 0 }, { 0, 1, 0 }, { 1, -0.0f, 0 }, { 1, 1, 0 },
                                        { -0.0f, 1, 0 }, { 3, 0, 0 }, { 4, 0, 0 }, { 3, 1, 0 } };
    made_init(&s);
    dar_mesh *m = made_mesh(&s, 9, 3, DAR_NONE);
    memcpy(m->position, corner, sizeof corner);
    for (uint32_t i = 0; i < 9; i++) m->index[i] = i;
    made_instance(&s, 0, NULL);
    dar_raster_config c = dar_raster_default(WIDTH, HEIGHT);
    drawn_init(&d, &s, &c);
    const uint32_t *part = d.identity.mesh[0].part;
    assert_int_equal(d.identity.parts, 2);
    assert_true(part[0] == 0 && part[1] == 0 && part[2] == 1);
    draw_free(&s, &d);
}

struct sample {
    uint16_t q[3]; /* as stored in 16 bits */
    uint32_t instance, part;
    float rest[3];
};

static int by_colour(const void *a, const void *b)
{
    return memcmp(a, b, sizeof((struct sample *)0)->q);
}

/* Points all over the scene: equal colours in 16 bits mean the same part and places within their step. */
static void injective(void **state)
{
    (void)state;
    enum { N = 200000 };
    dar_scene s;
    drawn d;
    dar_view v = made_view(WIDTH, HEIGHT, (double[]){ 2, 3, 5 }, (double[]){ 0, 0, 0 });
    draw_init(&s, &d);
    drawn_at(&d, DAR_NONE, 0, &v);
    dar_surface_point *p = dar_arena_push(&d.arena, N * sizeof *p);
    struct sample *x = dar_arena_push(&d.arena, N * sizeof *x);
    assert_int_equal(dar_tracks_pick(&d.raster, N, true, p, &d.arena), N);
    size_t seen[6] = { 0 };
    double step = 0;
    for (size_t i = 0; i < N; i++) {
        const dar_identity_mesh *m = &d.identity.mesh[s.instance[p[i].instance].mesh];
        const uint32_t *index = s.mesh[s.instance[p[i].instance].mesh].index + 3 * (size_t)p[i].triangle;
        double origin[3], scale;
        x[i].instance = p[i].instance;
        x[i].part = m->part[p[i].triangle];
        dar_identity_cell(&d.identity, x[i].instance, x[i].part, origin, &scale);
        step = fmax(step, 1 / (65535 * scale));
        seen[d.identity.first[x[i].instance] + x[i].part]++;
        for (size_t c = 0; c < 3; c++) {
            double r = 0;
            for (int k = 0; k < 3; k++) r += p[i].b[k] * m->rest[3 * index[k] + c];
            double q = 65535 * (origin[c] + scale * r);
            CHECK(q > 100 && q < 65435, "colour %g of 65535", q);
            x[i].q[c] = (uint16_t)(q + 0.5);
            x[i].rest[c] = (float)r;
        }
    }
    for (int k = 0; k < 6; k++) CHECK(seen[k] > N / 100, "part %d: %zu points", k, seen[k]);
    qsort(x, N, sizeof *x, by_colour);
    for (size_t i = 1; i < N; i++) {
        if (by_colour(&x[i - 1], &x[i])) continue;
        assert_int_equal(x[i - 1].instance, x[i].instance);
        assert_int_equal(x[i - 1].part, x[i].part);
        for (int c = 0; c < 3; c++) CHECK_NEAR("rest", x[i].rest[c], x[i - 1].rest[c], 1.01 * step);
    }
    draw_free(&s, &d);
}

/* A camera that sees point `x` at the very centre of a pixel. */
static dar_view aim(const double x[3], const double eye[3])
{
    dar_view v = made_view(WIDTH, HEIGHT, eye, x);
    v.cx = 40.5, v.cy = 30.5;
    return v;
}

/* The same surface point has the same colour at any time and from any camera; its position is where it is. */
static void persistent(void **state)
{
    (void)state;
    enum { N = 150 };
    dar_scene s;
    drawn d;
    dar_view v = made_view(WIDTH, HEIGHT, (double[]){ 2, 3, 5 }, (double[]){ 0, 0, 0 });
    dar_surface_point p[N];
    float q[N][3];
    size_t seen[2] = { 0 };

    draw_init(&s, &d);
    drawn_at(&d, DAR_NONE, 0, &v);
    assert_int_equal(dar_tracks_pick(&d.raster, N, true, p, &d.arena), N);
    for (int time = 0; time < 2; time++)
        for (size_t i = 0; i < N; i++) {
            const double angle = 6 * made_random(i + 1000 * (size_t)time);
            double corner[3][3], x[3] = { 0 }, eye[3];
            uint32_t instance, triangle;
            move_first(&s, time * 0.7);
            drawn_at(&d, DAR_NONE, 0, &v); /* poses the vertices */
            made_corners(&d, p[i].instance, p[i].triangle, corner);
            for (int c = 0; c < 3; c++)
                for (int k = 0; k < 3; k++) x[c] += p[i].b[k] * corner[k][c];
            eye[0] = x[0] + 1.5 * cos(angle), eye[1] = x[1] + 0.8 - time, eye[2] = x[2] + 1.5 * sin(angle);
            dar_view close = aim(x, eye);
            drawn_at(&d, DAR_NONE, 0, &close);
            if (!dar_raster_at(&d.raster, 40, 30, &instance, &triangle) || instance != p[i].instance ||
                triangle != p[i].triangle) {
                q[i][0] = time ? q[i][0] : 0;
                continue;
            }
            seen[time]++;
            size_t at = 30 * WIDTH + 40;
            for (size_t c = 0; c < 3; c++) {
                float found = d.g.tracking[c * d.pixels + at];
                CHECK_NEAR("place", d.g.world[c * d.pixels + at], x[c], 1e-5);
                if (time && q[i][0] > 0) CHECK_NEAR("colour", found, q[i][c], 1e-6);
                if (!time) q[i][c] = found;
            }
        }
    CHECK(seen[0] > N / 4 && seen[1] > N / 4, "%zu, %zu points seen of %d", seen[0], seen[1], N);
    draw_free(&s, &d);
}

/* ---------------------------------------------------------------- the paper's propositions */

/* X = o + depth ray. */
static void back_project(const drawn *d, const dar_view *v, size_t at, double x[3])
{
    double ray[3];
    made_ray(v, (double)(at % WIDTH) + 0.5, (double)(at / WIDTH) + 0.5, ray);
    for (int c = 0; c < 3; c++) x[c] = v->c2w[4 * c + 3] + d->g.depth[at] * ray[c];
}

static void propositions(void **state)
{
    (void)state;
    const double move = 0.25;
    dar_scene s;
    drawn d;
    dar_world w;
    dar_view v = made_view(WIDTH, HEIGHT, (double[]){ 2, 3, 5 }, (double[]){ 0, 0, 0 }), back = v;
    size_t hits = 0, same = 0;

    draw_init(&s, &d);
    drawn_at(&d, DAR_NONE, 0, &v);
    float *q = dar_arena_push(&d.arena, 12 * d.pixels), *depth = dar_arena_push(&d.arena, 4 * d.pixels);
    dar_world_init(&w);
    dar_world_add(&w, d.raster.position, s.vertices);
    dar_world_finish(&w);
    dar_world_normalise(&w, d.g.world, d.g.mask, d.pixels, q);
    memcpy(depth, d.g.depth, 4 * d.pixels);

    for (size_t i = 0; i < d.pixels; i++) {
        double x[3];
        if (!d.g.mask[i]) continue;
        hits++;
        back_project(&d, &v, i, x);
        for (size_t c = 0; c < 3; c++) {
            float value = q[c * d.pixels + i];
            CHECK_NEAR("back-projected", x[c], d.g.world[c * d.pixels + i], 1e-5 * w.size);
            CHECK(value > 0 && value < 1, "normalised position %g", value);
            CHECK_NEAR("X from q", w.centre[c] + (value - 0.5) * w.size, d.g.world[c * d.pixels + i], 1e-6 * w.size);
        }
        /* Depth is not injective: two pixels with the same depth, to 1e-4, are different points. */
        for (size_t j = 0; j < i && !same; j++)
            same += d.g.mask[j] && fabsf(d.g.depth[i] - d.g.depth[j]) < 1e-4f && i - j > 20;
    }
    CHECK(hits > 1000 && same, "%zu hits, %zu equal depths", hits, same);

    /* The camera steps back along z: every point is deeper by the step; its place and identity are what they were.
     * Pixels no longer meet the same points, so points are followed. */
    enum { N = 300 };
    dar_surface_point p[N];
    float xy[2][N][2], z[2][N];
    uint8_t visible[2][N];
    assert_int_equal(dar_tracks_pick(&d.raster, N, false, p, &d.arena), N);
    dar_tracks_follow(&d.raster, p, N, 0, 1, xy[0][0], visible[0], z[0]);
    for (int c = 0; c < 3; c++) back.c2w[4 * c + 3] -= move * v.c2w[4 * c + 2];
    drawn_at(&d, DAR_NONE, 0, &back);
    dar_tracks_follow(&d.raster, p, N, 0, 1, xy[1][0], visible[1], z[1]);
    for (size_t i = 0; i < N; i++) CHECK_NEAR("depth", z[1][i], z[0][i] + move, 1e-5);
    dar_world_normalise(&w, d.g.world, d.g.mask, d.pixels, q);
    for (size_t i = 0; i < d.pixels; i++)
        for (size_t c = 0; c < 3 && d.g.mask[i]; c++)
            CHECK_NEAR("X from q", w.centre[c] + (q[c * d.pixels + i] - 0.5) * w.size, d.g.world[c * d.pixels + i],
                       1e-6 * w.size);
    draw_free(&s, &d);
}

/* ---------------------------------------------------------------- what is not drawn */

static void skipped(void **state)
{
    (void)state;
    dar_scene s;
    drawn d;
    dar_view v = made_view(WIDTH, HEIGHT, (double[]){ 6, 9, 15 }, (double[]){ 0, 0, 0 }), away = v;
    const dar_raster_stats *n = &d.raster.stats;

    draw_init(&s, &d);
    dar_gbuffer other = drawn_buffers(&d.arena, d.pixels);
    drawn_at(&d, DAR_NONE, 0, &v);
    assert_int_equal(n->vertices_kept, 0);
    CHECK(n->back > 0 && n->drawn > 0 && n->tiles_empty > 0 && n->tiles_empty < n->tiles,
          "%zu backs, %zu drawn, %zu of %zu tiles empty", n->back, n->drawn, n->tiles_empty, n->tiles);
    assert_int_equal(n->triangles,
                     n->outside_instance + n->outside + n->behind + n->back + n->edge_on + n->small + n->drawn);

    assert_int_equal(dar_pose_at(&d.pose, DAR_NONE, 0, NULL), DAR_OK); /* nothing moves: copied */
    dar_raster_draw(&d.raster, &d.pose, &v, &other, &d.g);
    assert_int_equal(n->copied, 1);
    assert_memory_equal(other.world, d.g.world, 12 * d.pixels);
    assert_memory_equal(other.tracking, d.g.tracking, 12 * d.pixels);
    assert_memory_equal(other.mask, d.g.mask, d.pixels);

    move_first(&s, 0.5); /* one instance moves: vertices of the others stay */
    assert_int_equal(dar_pose_at(&d.pose, DAR_NONE, 0, NULL), DAR_OK);
    dar_raster_draw(&d.raster, &d.pose, &v, &other, &d.g);
    assert_int_equal(n->copied, 1);
    assert_int_equal(n->vertices_kept, s.vertices - s.mesh[0].vertices);
    drawn fresh;
    dar_raster_config c = dar_raster_default(WIDTH, HEIGHT);
    drawn_init(&fresh, &s, &c);
    drawn_at(&fresh, DAR_NONE, 0, &v);
    assert_memory_equal(other.world, fresh.g.world, 12 * d.pixels);
    assert_memory_equal(other.normal, fresh.g.normal, 12 * d.pixels);
    assert_memory_equal(other.depth, fresh.g.depth, 4 * d.pixels);

    /* Looking away: nothing is left; then back: nothing is missing. */
    for (int k = 0; k < 3; k++) away.c2w[4 * k] *= -1, away.c2w[4 * k + 2] *= -1;
    size_t outside = n->instances_outside;
    drawn_at(&d, DAR_NONE, 0, &away);
    assert_int_equal(n->instances_outside - outside, s.instances);
    for (size_t i = 0; i < d.pixels; i++) assert_true(d.g.mask[i] == 0 && d.g.world[i] == 0 && d.g.depth[i] == 0);
    drawn_at(&d, DAR_NONE, 0, &v);
    assert_memory_equal(d.g.world, fresh.g.world, 12 * d.pixels);
    assert_memory_equal(d.g.part, fresh.g.part, 4 * d.pixels);

    /* Into the same buffers over and over: no tile keeps what it showed before. */
    for (int k = 0; k < 12; k++) {
        const double angle = 0.9 * k, eye[3] = { 7 * sin(angle), 4 - 0.6 * k, 7 * cos(angle) };
        dar_view around = made_view(WIDTH, HEIGHT, eye, (double[]){ 0.8 * k - 4, 0, 0 });
        assert_int_equal(dar_pose_at(&d.pose, DAR_NONE, 0, NULL), DAR_OK);
        dar_raster_draw(&d.raster, &d.pose, &around, &d.g, &d.g);
        drawn_at(&fresh, DAR_NONE, 0, &around);
        assert_memory_equal(d.g.world, fresh.g.world, 12 * d.pixels);
        assert_memory_equal(d.g.tracking, fresh.g.tracking, 12 * d.pixels);
        assert_memory_equal(d.g.normal, fresh.g.normal, 12 * d.pixels);
        assert_memory_equal(d.g.depth, fresh.g.depth, 4 * d.pixels);
        assert_memory_equal(d.g.mask, fresh.g.mask, d.pixels);
    }
    dar_arena_free(&fresh.arena);
    draw_free(&s, &d);
}

/* Each family alone is what it is among all; normals asked for late are there. */
static void families(void **state)
{
    (void)state;
    dar_scene s;
    drawn d;
    dar_view v = made_view(WIDTH, HEIGHT, (double[]){ 2, 3, 5 }, (double[]){ 0, 0, 0 });
    draw_init(&s, &d);
    dar_gbuffer x = drawn_buffers(&d.arena, d.pixels);
    const dar_gbuffer one[7] = { { .depth = x.depth },  { .mask = x.mask },   { .tracking = x.tracking },
                                 { .part = x.part },    { .world = x.world }, { .instance = x.instance },
                                 { .normal = x.normal } };
    for (int i = 0; i < 7; i++) {
        assert_int_equal(dar_pose_at(&d.pose, DAR_NONE, 0, NULL), DAR_OK);
        dar_raster_draw(&d.raster, &d.pose, &v, &one[i], NULL);
    }
    drawn_at(&d, DAR_NONE, 0, &v);
    assert_memory_equal(x.tracking, d.g.tracking, 12 * d.pixels);
    assert_memory_equal(x.world, d.g.world, 12 * d.pixels);
    assert_memory_equal(x.normal, d.g.normal, 12 * d.pixels);
    assert_memory_equal(x.instance, d.g.instance, 4 * d.pixels);
    assert_memory_equal(x.part, d.g.part, 4 * d.pixels);
    assert_memory_equal(x.depth, d.g.depth, 4 * d.pixels);
    assert_memory_equal(x.mask, d.g.mask, d.pixels);

    dar_raster r;
    dar_raster_config c = dar_raster_default(WIDTH, HEIGHT);
    dar_arena plan;
    assert_int_equal(dar_arena_init_plan(&plan, "plan", NULL), DAR_OK);
    dar_raster_init(&r, &s, NULL, &c, &plan);
    size_t used = d.arena.used, planned = plan.used;
    dar_raster_init(&r, &s, NULL, &c, &d.arena);
    assert_int_equal(d.arena.used - used, planned);
    CHECK_ABORTS(dar_raster_draw(&r, &d.pose, &v, &d.g, NULL)); /* tracking without identity */
    v.width++;
    CHECK_ABORTS(dar_raster_draw(&d.raster, &d.pose, &v, &d.g, NULL));
    dar_arena_free(&plan);
    draw_free(&s, &d);
}

/* A square with a texture of 2 x 1 texels, opaque and not: half of it is there; what is behind shows through. */
static void alpha(void **state)
{
    (void)state;
    static uint8_t texel[8] = { 9, 9, 9, 255, 9, 9, 9, 0 };
    static float uv[8] = { 0, 0, 1, 0, 1, 1, 0, 1 };
    static const float corner[4][3] = { { -1, -1, 0 }, { 1, -1, 0 }, { 1, 1, 0 }, { -1, 1, 0 } };
    static const uint32_t index[6] = { 0, 1, 2, 0, 2, 3 };
    dar_view v = { .width = 64, .height = 64, .fx = 64, .fy = 64, .cx = 32, .cy = 32, .near = 0.1 };
    const double deep[12] = { 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1 };
    memcpy(v.c2w, dar_affine_identity, sizeof v.c2w);
    v.c2w[11] = -4;
    for (int kind = 0; kind < 4; kind++) { /* nearest, blended, ALPHA_BLEND, ALPHA_BLEND that is always there */
        dar_raster_config c = dar_raster_default(64, 64);
        dar_image im = { 2, 1, texel };
        dar_scene s;
        drawn d;
        made_init(&s);
        s.image = &im;
        s.images = 1;
        dar_material *material = &s.material[made_material(&s, true)];
        material->image = 0;
        material->alpha = kind < 2 ? DAR_ALPHA_MASK : DAR_ALPHA_BLEND;
        material->nearest = kind == 0;
        material->wrap_u = material->wrap_v = DAR_WRAP_CLAMP;
        if (kind == 3) c.blend_cutoff = 0;
        for (int k = 0; k < 2; k++) {
            dar_mesh *m = made_mesh(&s, 4, 2, k ? DAR_NONE : 0);
            memcpy(m->position, corner, sizeof corner);
            memcpy(m->index, index, sizeof index);
            m->uv = k ? NULL : uv;
            made_instance(&s, k, k ? deep : NULL);
        }
        drawn_init(&d, &s, &c);
        drawn_at(&d, DAR_NONE, 0, &v);
        for (size_t i = 0; i < d.pixels; i++) {
            size_t x = i % 64, y = i / 64;
            bool front = x >= 16 && x < 48 && y >= 16 && y < 48, solid = front && (x < 32 || kind == 3);
            bool behind = x >= 20 && x < 44 && y >= 20 && y < 44; /* half width 12.8 */
            if (!front || (!solid && !behind && x < 45 && y > 18 && y < 45)) continue;
            unsigned expected = solid ? 1 : behind ? 2 : d.g.instance[i] == 2 ? 2 : 0;
            CHECK(d.g.instance[i] == expected, "kind %d: pixel %zu, %zu: instance %u, expected %u", kind, x, y,
                  d.g.instance[i], expected);
        }
        dar_arena_free(&d.arena);
        dar_scene_free(&s);
    }
}

/* ---------------------------------------------------------------- tracks */

static void tracks(void **state)
{
    (void)state;
    enum { N = 500, T = 3 };
    dar_scene s;
    drawn d;
    dar_view v = made_view(WIDTH, HEIGHT, (double[]){ 2, 3, 5 }, (double[]){ 0, 0, 0 });
    static float xy[N][T][2], depth[N];
    static uint8_t visible[N][T], color[N][3], map[3 * WIDTH * HEIGHT];
    static dar_surface_point p[N];
    size_t wrong = 0, early = 0, hidden = 0, coloured = 0;

    draw_init(&s, &d);
    for (size_t t = 0; t < T; t++) {
        move_first(&s, 0.8 * (double)t);
        drawn_at(&d, DAR_NONE, 0, &v);
        if (!t) assert_int_equal(dar_tracks_pick(&d.raster, N, false, p, &d.arena), N);
        if (!t) dar_tracks_color(&d.raster, p, N, color[0]);
        dar_tracks_follow(&d.raster, p, N, t, T, xy[0][0], visible[0], depth);
        dar_tracks_map(&d.raster, N, t, T, xy[0][0], visible[0], depth, color[0], 3, map, &d.arena);
        for (size_t i = 0; i < N; i++) {
            hit h;
            bool cast = made_cast(&d, &v, xy[i][t][0], xy[i][t][1], &h);
            bool free = !cast || h.depth > depth[i] * (1 - 1e-3);
            assert_true(t || visible[i][t]);
            wrong += free != visible[i][t];
            hidden += !visible[i][t];
            early += free && !visible[i][t];
        }
        for (size_t i = 0; i < WIDTH * HEIGHT; i++) coloured += map[i] != 0;
    }
    /* Outlines: up to a pixel too long; seldom, in gaps narrower than a pixel, too short. */
    CHECK(wrong < N * T / 15, "%zu of %d points differ from rays", wrong, N * T);
    CHECK(early < N * T / 100, "%zu of %d points are hidden though nothing is before them", early, N * T);
    CHECK(hidden > N / 20 && coloured > 3 * N, "%zu hidden, %zu pixels of the maps", hidden, coloured);

    /* Of a square and a torus, areas are what points are picked by. */
    size_t all = dar_tracks_pick(&d.raster, N, true, p, &d.arena), square = 0;
    for (size_t i = 0; i < all; i++) square += p[i].instance == 3;
    double areas[4] = { 0 }, sum = 0;
    for (size_t i = 0; i < 4; i++)
        for (size_t t = 0; t < s.mesh[s.instance[i].mesh].triangles; t++) {
            double x[3][3], u[3], w[3], n[3];
            made_corners(&d, i, t, x);
            for (int c = 0; c < 3; c++) u[c] = x[1][c] - x[0][c], w[c] = x[2][c] - x[0][c];
            made_cross(u, w, n);
            areas[i] += sqrt(made_dot(n, n)) / 2;
        }
    for (int i = 0; i < 4; i++) sum += areas[i];
    assert_int_equal(all, N);
    CHECK_NEAR("share of the square", (double)square / N, areas[3] / sum, 0.01);

    /* The nearest square lies on top. */
    float where[2][2] = { { 20.5f, 20.5f }, { 21.5f, 20.5f } }, deep[2] = { 3, 2 };
    uint8_t on[2] = { 1, 1 }, two[6] = { 10, 10, 10, 20, 20, 20 };
    dar_tracks_map(&d.raster, 2, 0, 1, where[0], on, deep, two, 3, map, &d.arena);
    assert_int_equal(map[20 * WIDTH + 19], 10);
    for (size_t x = 20; x < 23; x++) assert_int_equal(map[20 * WIDTH + x], 20);
    assert_int_equal(map[20 * WIDTH + 23], 0);
    draw_free(&s, &d);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(parts),        cmocka_unit_test(injective), cmocka_unit_test(persistent),
        cmocka_unit_test(propositions), cmocka_unit_test(skipped),   cmocka_unit_test(families),
        cmocka_unit_test(alpha),        cmocka_unit_test(tracks),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
