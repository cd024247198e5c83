/* test_shade.c: pictures against closed forms and against rays. */
#include "data/shade.h"

#include "tests/made.h"

/* ---------------------------------------------------------------- scaffolding */

typedef struct painting {
    drawn d; /* at one sample per pixel, for rays */
    dar_arena arena;
    dar_pose pose;
    dar_shade shade;
    uint8_t *rgb;
    int width, height;
} painting;

/* One sun of colour 1 and no sky. */
static dar_shade_config one_sun(int width, int height, double x, double y, double z)
{
    dar_shade_config c = dar_shade_default(width, height);
    double length = sqrt(x * x + y * y + z * z);
    c.lighting = (dar_lighting){ .sun = { { { x / length, y / length, z / length }, { 0.6, 0.6, 0.6 }, false } },
                                 .suns = 1,
                                 .sky = { .haze = 1, .glow_toward = { 0, 1, 0 }, .glow_size = 1 },
                                 .sky_light = 1,
                                 .up = { 0, 1, 0 },
                                 .softness = 0.01,
                                 .exposure = 1 };
    for (int k = 0; k < 3; k++) c.lo[k] = -4, c.hi[k] = 4;
    return c;
}

static void paint_init(painting *p, dar_scene *s, const dar_shade_config *c)
{
    dar_arena plan;
    p->width = c->raster.width, p->height = c->raster.height;
    drawn_init(&p->d, s, &c->raster);
    assert_int_equal(dar_arena_init_plan(&plan, "plan", NULL), DAR_OK);
    dar_shade_init(&p->shade, s, c, &plan);
    assert_int_equal(dar_arena_init(&p->arena, "paint", plan.peak, NULL), DAR_OK);
    dar_shade_init(&p->shade, s, c, &p->arena);
    assert_int_equal(plan.peak, p->arena.used);
    dar_arena_free(&plan);
    p->rgb = calloc((size_t)p->width * (size_t)p->height, 3);
    assert_non_null(p->rgb);
}

static void paint(painting *p, const dar_view *v)
{
    drawn_at(&p->d, DAR_NONE, 0, v);
    dar_shade_draw(&p->shade, &p->d.pose, v, p->rgb);
}

static void paint_free(painting *p)
{
    free(p->rgb);
    dar_arena_free(&p->arena);
    dar_arena_free(&p->d.arena);
    dar_scene_free(p->d.scene);
}

static const uint8_t *pixel(const painting *p, int x, int y)
{
    return p->rgb + 3 * ((size_t)y * (size_t)p->width + (size_t)x);
}

/* Display value of a light, before rounding; below the shoulder. */
static double display(double light)
{
    return 255 * (light <= 0.0031308 ? 12.92 * light : 1.055 * pow(light, 1 / 2.4) - 0.055);
}

/* Half a value for rounding, and what f32 loses of the light: 1e-5 of it, at most 255 * 13 * 1e-5 values. */
#define ROUNDING (0.5 + 0.04)

/* A sheet z = 0, x and y from -1 to 1, facing z, its texture upright. */
static dar_mesh *sheet(dar_scene *s, int material)
{
    static const float x[4][2] = { { -1, -1 }, { 1, -1 }, { 1, 1 }, { -1, 1 } };
    static const uint32_t index[6] = { 0, 1, 2, 0, 2, 3 };
    dar_mesh *m = made_mesh(s, 4, 2, material);
    m->uv = dar_arena_push(&s->memory, 4 * 2 * sizeof(float));
    m->primitive->textured = true;
    memcpy(m->index, index, sizeof index);
    for (size_t v = 0; v < 4; v++) {
        for (size_t c = 0; c < 3; c++) {
            m->position[3 * v + c] = c < 2 ? x[v][c] : 0;
            m->normal[3 * v + c] = c == 2;
        }
        m->uv[2 * v] = (1 + x[v][0]) / 2;
        m->uv[2 * v + 1] = (1 - x[v][1]) / 2;
    }
    return m;
}

static dar_view front(int width, int height, double distance)
{
    const double eye[3] = { 0, 0, distance }, at[3] = { 0, 0, 0 };
    return made_view(width, height, eye, at);
}

/* ---------------------------------------------------------------- display values */

static void srgb(void **state)
{
    static dar_srgb s;
    (void)state;
    dar_srgb_init(&s);
    for (int v = 0; v < 256; v++) assert_int_equal(dar_srgb_of(&s, s.linear[v]), v);
    for (uint64_t i = 0; i < 200000; i++) {
        float light = (float)(made_random(i) * made_random(i + 1000000));
        CHECK_NEAR("value of a light", dar_srgb_of(&s, light), display(light), 0.5 + 1e-3);
    }
    const float odd[][2] = { { -1, 0 }, { 0, 0 }, { 1, 255 }, { 2, 255 }, { INFINITY, 255 }, { NAN, 0 } };
    for (size_t i = 0; i < sizeof odd / sizeof *odd; i++) assert_int_equal(dar_srgb_of(&s, odd[i][0]), odd[i][1]);
    assert_int_equal(dar_srgb_of(&s, nextafterf(1, 0)), 255);
}

/* ---------------------------------------------------------------- light */

static void lambert(void **state)
{
    static const double angle[] = { 0, 30, 60, 85, 95, 180 };
    (void)state;
    for (size_t i = 0; i < sizeof angle / sizeof *angle; i++) {
        double a = angle[i] * PI / 180, light = 0.6 * fmax(0, cos(a));
        dar_shade_config c = one_sun(16, 12, sin(a), 0, cos(a));
        dar_view v = front(16, 12, 1);
        painting p;
        dar_scene s;
        made_init(&s);
        int material = made_material(&s, false);
        s.material[material].color[1] = 0.5;
        sheet(&s, material);
        made_instance(&s, 0, NULL);
        paint_init(&p, &s, &c);
        paint(&p, &v);
        for (int k = 0; k < 3; k++)
            CHECK_NEAR("plane", pixel(&p, 8, 6)[k], display(light * (k == 1 ? 0.5 : 1)), ROUNDING);
        paint_free(&p);
    }
}

/* A bulb before a sheet: its distance and the slant differ from pixel to pixel. */
static void bulb(void **state)
{
    enum { SIDE = 16 };
    dar_shade_config c = one_sun(SIDE, SIDE, 0, 0, 1);
    dar_view v = front(SIDE, SIDE, 1.5);
    painting p;
    dar_scene s;
    (void)state;
    made_init(&s);
    sheet(&s, made_material(&s, false));
    made_instance(&s, 0, NULL);
    c.lighting.suns = 0, c.lighting.bulbs = 1;
    c.lighting.bulb[0] = (dar_bulb){ .at = { 0.3, -0.4, 0.8 }, .color = { 0.5, 0.4, 0.3 }, .reach = 0.9 };
    c.samples = 1;
    paint_init(&p, &s, &c);
    paint(&p, &v);
    for (int i = 1; i < SIDE - 1; i++) {
        double x = (i + 0.5 - v.cx) / v.fx * 1.5 - 0.3, y = -(i + 0.5 - v.cy) / v.fy * 1.5 + 0.4;
        double square = x * x + y * y + 0.64, share = 0.8 / sqrt(square) / (0.1 + 0.9 * square / 0.81);
        for (int k = 0; k < 3; k++)
            CHECK_NEAR("bulb", pixel(&p, i, i)[k], display(c.lighting.bulb[0].color[k] * share), ROUNDING);
    }
    paint_free(&p);
}

/* Below a roof an even sky lights a floor by 1 - occlusion; without the roof by all of it. */
static void occlusion(void **state)
{
    static const double floor_at[12] = { 3, 0, 0, 0, 0, 0, 3, 0, 0, -3, 0, 0 };
    static const double roof_at[12] = { 2, 0, 0, 0, 0, 0, 2, 2, 0, -2, 0, 0 };
    static const double eye[3] = { 0.1, 1.5, 0.1 }, at[3] = { 0, 0, 0 };
    (void)state;
    for (int roof = 0; roof < 2; roof++) {
        dar_shade_config c = one_sun(8, 8, 0, 1, 0);
        dar_view v = made_view(8, 8, eye, at);
        painting p;
        dar_scene s;
        made_init(&s);
        sheet(&s, made_material(&s, true));
        made_instance(&s, 0, floor_at);
        if (roof) made_instance(&s, 0, roof_at);
        c.lighting.suns = 0;
        c.lighting.occlusion = 0.75;
        for (int k = 0; k < 3; k++) {
            c.lo[k] = k == 1 ? 0 : -3, c.hi[k] = k == 1 ? 2 : 3;
            c.lighting.sky.zenith[k] = c.lighting.sky.horizon[k] = c.lighting.sky.ground[k] = 0.5;
        }
        paint_init(&p, &s, &c);
        paint(&p, &v);
        CHECK_NEAR("floor", pixel(&p, 4, 4)[0], display(roof ? 0.125 : 0.5), ROUNDING + 0.1);
        paint_free(&p);
    }
}

/* Seen from behind, a sheet is lit from behind. */
static void two_sides(void **state)
{
    (void)state;
    for (int side = -1; side <= 1; side += 2) {
        dar_shade_config c = one_sun(8, 8, 0, 0, -1);
        dar_view v = front(8, 8, side);
        painting p;
        dar_scene s;
        made_init(&s);
        sheet(&s, made_material(&s, true));
        made_instance(&s, 0, NULL);
        paint_init(&p, &s, &c);
        paint(&p, &v);
        CHECK_NEAR("sheet", pixel(&p, 4, 4)[0], side < 0 ? display(0.6) : 0, ROUNDING);
        paint_free(&p);
    }
}

/* A smooth sphere shows max(0, n . l), where n is that of the sphere that a ray meets.  Its triangles lie up to
 * h^2 / 8 inside, h = 2 pi / 96; seen under a slant of 1/2 that moves the place by twice as much: 2e-3 of light. */
static void sphere(void **state)
{
    enum { SIDE = 64 };
    dar_shade_config c = one_sun(SIDE, SIDE, 1, 0.5, 0.25);
    dar_view v = front(SIDE, SIDE, 4);
    size_t compared = 0, dark = 0;
    painting p;
    dar_scene s;
    (void)state;
    made_init(&s);
    made_sheet(&s, 49, 96, false, made_sphere, made_material(&s, true));
    made_instance(&s, 0, NULL);
    c.samples = 1;
    paint_init(&p, &s, &c);
    paint(&p, &v);
    for (int y = 0; y < SIDE; y++)
        for (int x = 0; x < SIDE; x++) {
            double d[3], o[3] = { 0, 0, 4 }, n[3], light = 0;
            made_ray(&v, x + 0.5, y + 0.5, d);
            double dd = made_dot(d, d), od = made_dot(o, d), root = od * od - dd * (16 - 1);
            if (root < 0) continue;
            double t = (-od - sqrt(root)) / dd;
            for (int k = 0; k < 3; k++) n[k] = o[k] + t * d[k], light += n[k] * c.lighting.sun[0].toward[k];
            if (-made_dot(n, d) < 0.5 * sqrt(dd)) continue;
            compared++;
            light = 0.6 * light;
            dark += light < -2e-3;
            double lo = display(fmax(0, light - 2e-3)), hi = display(fmax(0, light + 2e-3));
            CHECK_NEAR("sphere", pixel(&p, x, y)[0], (lo + hi) / 2, (hi - lo) / 2 + ROUNDING);
        }
    CHECK(compared > 500 && dark > 50, "only %zu pixels compared, %zu in the dark", compared, dark);
    paint_free(&p);
}

/* An even sky of radiance L shows a white matte surface as L, whatever its normal.  Rows of directions are summed by
 * their middles: 3 z^2 - 1 has the mean -2.4e-4 instead of 0, which makes 1.5e-4 of light. */
static void even_sky(void **state)
{
    dar_lighting l = one_sun(1, 1, 0, 0, 1).lighting;
    dar_skylight sky;
    (void)state;
    for (int k = 0; k < 3; k++) l.sky.zenith[k] = l.sky.horizon[k] = l.sky.ground[k] = 0.25 * (k + 1);
    dar_skylight_init(&sky, &l);
    for (uint64_t i = 0; i < 100; i++) {
        double z = 2 * made_random(i) - 1, a = 2 * PI * made_random(i + 100);
        float n[3] = { (float)(sqrt(1 - z * z) * cos(a)), (float)(sqrt(1 - z * z) * sin(a)), (float)z }, y[3];
        dar_skylight_on(&sky, n, y);
        for (int k = 0; k < 3; k++) CHECK_NEAR("even sky", y[k], 0.25 * (k + 1), 2e-4 * (k + 1));
    }
}

/* Against the integral itself; nine harmonics miss at most a few percent of what a sky varies by. */
static void any_sky(void **state)
{
    enum { STEPS = 64 };
    (void)state;
    for (size_t kind = 0; kind < dar_lighting_count; kind++) {
        static dar_skylight sky;
        dar_lighting l = dar_lighting_of(kind, kind % 2);
        double most = 0;
        dar_skylight_init(&sky, &l);
        for (uint64_t i = 0; i < 12; i++) {
            double nz = 2 * made_random(i) - 1, na = 2 * PI * made_random(i + 100), sum = 0;
            float n[3] = { (float)(sqrt(1 - nz * nz) * cos(na)), (float)(sqrt(1 - nz * nz) * sin(na)), (float)nz },
                  y[3];
            for (int r = 0; r < STEPS; r++)
                for (int q = 0; q < 2 * STEPS; q++) {
                    double z = (2 * r + 1.0) / STEPS - 1, a = PI * (q + 0.5) / STEPS, w = sqrt(1 - z * z);
                    float d[3] = { (float)(w * cos(a)), (float)z, (float)(w * sin(a)) };
                    double facing = (double)d[0] * n[0] + (double)d[1] * n[1] + (double)d[2] * n[2];
                    dar_skylight_at(&sky, d, y);
                    most = fmax(most, y[1]);
                    sum += fmax(0, facing) * y[1];
                }
            dar_skylight_on(&sky, n, y);
            CHECK_NEAR(dar_lighting_kinds[kind].name, y[1], l.sky_light * 4 * sum / (2 * STEPS * STEPS), 0.04 * most);
        }
    }
}

/* The gradient where it is said to be what: at its ends, and the glow at its middle and at its size. */
static void gradient(void **state)
{
    static dar_skylight sky;
    dar_lighting l = one_sun(1, 1, 0, 0, 1).lighting;
    float up_there[3] = { 0, 1, 0 }, level[3] = { 1, 0, 0 }, down[3] = { 0, -1, 0 }, y[3];
    (void)state;
    l.sky.zenith[0] = 0.2, l.sky.horizon[0] = 0.5, l.sky.ground[0] = 0.1;
    dar_skylight_init(&sky, &l);
    dar_skylight_at(&sky, up_there, y);
    CHECK_NEAR("zenith", y[0], 0.2, 1e-6);
    dar_skylight_at(&sky, level, y);
    CHECK_NEAR("horizon", y[0], 0.5, 1e-6);
    dar_skylight_at(&sky, down, y);
    CHECK_NEAR("ground", y[0], 0.1, 1e-6);
    l.sky.glow[1] = 0.8, l.sky.glow_size = 0.3;
    dar_skylight_init(&sky, &l);
    dar_skylight_at(&sky, up_there, y);
    CHECK_NEAR("glow", y[1], 0.8, 1e-6);
    float beside[3] = { sinf(0.3f), cosf(0.3f), 0 };
    dar_skylight_at(&sky, beside, y);
    CHECK_NEAR("half of the glow", y[1], 0.4, 1e-5);
}

/* Lightings with z up are those with y up, turned. */
static void up(void **state)
{
    (void)state;
    for (size_t kind = 0; kind < dar_lighting_count; kind++) {
        static dar_skylight y_sky, z_sky;
        dar_lighting y = dar_lighting_of(kind, false), z = dar_lighting_of(kind, true);
        dar_skylight_init(&y_sky, &y);
        dar_skylight_init(&z_sky, &z);
        CHECK_NEAR("sun", z.sun[0].toward[2], y.sun[0].toward[1], 0);
        for (uint64_t i = 0; i < 50; i++) {
            double h = 2 * made_random(i) - 1, a = 2 * PI * made_random(i + 50), w = sqrt(1 - h * h);
            float d[3] = { (float)(w * cos(a)), (float)h, (float)(w * sin(a)) }, e[3] = { d[0], -d[2], d[1] };
            float there[3], here[3];
            dar_skylight_smooth(&y_sky, d, there);
            dar_skylight_smooth(&z_sky, e, here);
            for (int k = 0; k < 3; k++) CHECK_NEAR("sky", here[k], there[k], 1e-5);
        }
    }
}

/* ---------------------------------------------------------------- background, edges */

static void background(void **state)
{
    enum { WIDTH = 24, HEIGHT = 16 };
    (void)state;
    for (size_t kind = 0; kind < dar_lighting_count; kind++) {
        dar_shade_config c = dar_shade_default(WIDTH, HEIGHT);
        const double eye[3] = { 3, 1, 2 }, at[3] = { 9, 3, 4 };
        dar_view v = made_view(WIDTH, HEIGHT, eye, at);
        painting p;
        dar_scene s;
        made_init(&s);
        sheet(&s, made_material(&s, false));
        made_instance(&s, 0, NULL);
        c.lighting = dar_lighting_of(kind, false);
        paint_init(&p, &s, &c);
        paint(&p, &v);
        for (int i = 0; i < WIDTH * HEIGHT; i++) {
            double d[3], length;
            float f[3], y[3];
            made_ray(&v, i % WIDTH + 0.5, i / WIDTH + 0.5, d);
            length = sqrt(made_dot(d, d));
            for (int k = 0; k < 3; k++) f[k] = (float)(d[k] / length);
            dar_skylight_at(p.shade.sky, f, y);
            for (int k = 0; k < 3; k++) {
                double light = c.lighting.exposure * y[k];
                if (light > 0.7) light = 1 - 0.3 * exp((0.7 - light) / 0.3);
                CHECK_NEAR("background", pixel(&p, i % WIDTH, i / WIDTH)[k], display(light), ROUNDING + 0.1);
            }
        }
        paint_free(&p);
    }
}

/* A white sheet that ends within a pixel: light is averaged over n x n samples, before it becomes a value. */
static void coverage(void **state)
{
    (void)state;
    for (int n = 1; n <= DAR_SHADE_SAMPLES; n++) {
        dar_shade_config c = one_sun(8, 8, 0, 0, 1);
        dar_view v = front(8, 8, 2);
        painting p;
        dar_scene s;
        made_init(&s);
        sheet(&s, made_material(&s, false));
        made_instance(&s, 0, NULL);
        c.samples = n;
        v.cx = 4,
        v.fx = v.fy = 5.2; /* the right edge lies at 4 + 2.6 [px]: the columns of samples left of it are covered */
        paint_init(&p, &s, &c);
        paint(&p, &v);
        int covered = 0;
        for (int k = 0; k < n; k++) covered += 6 + (k + 0.5) / n < 6.6;
        CHECK_NEAR("edge", pixel(&p, 6, 4)[0], display(0.6 * covered / n), ROUNDING);
        CHECK_NEAR("inside", pixel(&p, 5, 4)[0], display(0.6), ROUNDING);
        CHECK_NEAR("outside", pixel(&p, 7, 4)[0], 0, 0);
        paint_free(&p);
    }
}

/* ---------------------------------------------------------------- colour */

static void texture(void **state)
{
    static uint8_t texel[16] = { 255, 0, 0, 255, 0, 255, 0, 255, 0, 0, 255, 255, 188, 188, 188, 255 };
    static const double at[4][3] = { { 1, 0, 0 }, { 0, 1, 0 }, { 0, 0, 1 }, { 0.5, 0.5, 0.5 } };
    dar_shade_config c = one_sun(16, 16, 0, 0, 1);
    dar_view v = front(16, 16, 1.2);
    dar_image image = { 2, 2, texel };
    painting p;
    dar_scene s;
    (void)state;
    made_init(&s);
    int material = made_material(&s, false);
    s.material[material].image = 0;
    s.material[material].nearest = true;
    s.image = &image, s.images = 1;
    sheet(&s, material);
    made_instance(&s, 0, NULL);
    paint_init(&p, &s, &c);
    paint(&p, &v);
    for (int k = 0; k < 4; k++) /* 188 is 0.503 of light */
        for (int i = 0; i < 3; i++)
            CHECK_NEAR("texel", pixel(&p, k & 1 ? 12 : 3, k >> 1 ? 12 : 3)[i], display(0.6 * at[k][i]),
                       k < 3 ? ROUNDING : 1);
    paint_free(&p);
}

/* Far away, a chequered sheet shows the mean of its light, not of its values. */
static void far_texture(void **state)
{
    enum { SIDE = 256 };
    static uint8_t texel[4 * SIDE * SIDE];
    dar_shade_config c = one_sun(16, 16, 0, 0, 1);
    dar_view v = front(16, 16, 4);
    dar_image image = { SIDE, SIDE, texel };
    painting p;
    dar_scene s;
    (void)state;
    for (int i = 0; i < SIDE * SIDE; i++)
        for (int k = 0; k < 4; k++) texel[4 * i + k] = k == 3 || (i + i / SIDE) % 2 ? 255 : 0;
    made_init(&s);
    int material = made_material(&s, false);
    s.material[material].image = 0;
    s.image = &image, s.images = 1;
    sheet(&s, material);
    made_instance(&s, 0, NULL);
    paint_init(&p, &s, &c);
    paint(&p, &v);
    CHECK_NEAR("chequer", pixel(&p, 8, 8)[0], display(0.3), 1);
    paint_free(&p);
}

static void vertex_colors(void **state)
{
    static const float color[4][4] = { { 0, 0.2f, 1, 1 }, { 1, 0.2f, 1, 1 }, { 1, 0.8f, 1, 1 }, { 0, 0.8f, 1, 1 } };
    enum { SIDE = 20 };
    dar_shade_config c = one_sun(SIDE, SIDE, 0, 0, 1);
    dar_view v = front(SIDE, SIDE, 1.5);
    painting p;
    dar_scene s;
    (void)state;
    made_init(&s);
    dar_mesh *m = sheet(&s, made_material(&s, false));
    m->color = dar_arena_push(&s.memory, sizeof color);
    memcpy(m->color, color, sizeof color);
    made_instance(&s, 0, NULL);
    paint_init(&p, &s, &c);
    paint(&p, &v);
    for (int i = 3; i < SIDE - 3; i++) {
        double x = (i + 0.5 - v.cx) / v.fx * 1.5, y = (i + 0.5 - v.cy) / v.fy * 1.5;
        CHECK_NEAR("along x", pixel(&p, i, SIDE / 2)[0], display(0.6 * (1 + x) / 2), ROUNDING);
        CHECK_NEAR("along y", pixel(&p, SIDE / 2, i)[1], display(0.6 * (0.5 - 0.3 * y)), ROUNDING);
        CHECK_NEAR("blue", pixel(&p, i, i)[2], display(0.6), ROUNDING);
    }
    paint_free(&p);
}

/* ---------------------------------------------------------------- shadows */

/* Whether anything but the triangle itself lies between a place and the sun. */
static bool blocked(const drawn *d, const double x[3], const double toward[3])
{
    for (size_t i = 0; i < d->scene->instances; i++)
        for (size_t t = 0; t < d->scene->mesh[d->scene->instance[i].mesh].triangles; t++) {
            double corner[3][3], side;
            hit h;
            made_corners(d, i, t, corner);
            if (made_meets(corner, x, toward, &h, &side) && h.depth > 1e-3) return true;
        }
    return false;
}

/* A ball over a floor: where the sun's rays to a disc around the place agree, the place is lit as they say. */
static void shadow(void **state)
{
    static const double floor_at[12] = { 3, 0, 0, 0, 0, 0, 3, 0, 0, -3, 0, 0 }; /* the sheet lies down, facing y */
    static const double ball_at[12] = { 0.9, 0, 0, 0.1, 0, 0.9, 0, 1.5, 0, 0, 0.9, -0.2 };
    static const double eye[3] = { 1.5, 4, 3 }, at[3] = { 0, 0, 0 };
    enum { SIDE = 40 };
    dar_shade_config c = one_sun(SIDE, SIDE, 0.5, 1, 0.3);
    dar_view v = made_view(SIDE, SIDE, eye, at);
    size_t lit = 0, dark = 0, edge = 0;
    painting p;
    dar_scene s;
    (void)state;
    made_init(&s);
    int material = made_material(&s, true);
    sheet(&s, material);
    made_sheet(&s, 13, 24, false, made_sphere, material);
    made_instance(&s, 0, floor_at);
    made_instance(&s, 1, ball_at);
    c.lighting.sun[0].shadow = true;
    for (int k = 0; k < 3; k++) c.lo[k] = k == 1 ? 0 : -3, c.hi[k] = 3;
    c.samples = 1;
    paint_init(&p, &s, &c);
    paint(&p, &v);
    const dar_shadow *w = &p.shade.shadow[0];
    double radius = (w->reach + 1.5) * 1.42 * fmax(w->slope[0], w->slope[1]) / 0.86; /* the sun's slant on the floor */
    for (int i = 0; i < SIDE * SIDE; i++) {
        double d[3], o[3] = { v.c2w[3], v.c2w[7], v.c2w[11] }, x[3];
        int blocks = 0, tries = 0;
        hit h;
        if (!made_cast(&p.d, &v, i % SIDE + 0.5, i / SIDE + 0.5, &h) || h.instance != 0) continue;
        made_ray(&v, i % SIDE + 0.5, i / SIDE + 0.5, d);
        for (int k = 0; k < 3; k++) x[k] = o[k] + h.depth * d[k];
        for (int a = 0; a < 16; a++, tries++) {
            double place[3] = { x[0] + radius * cos(a * PI / 8), 1e-4, x[2] + radius * sin(a * PI / 8) };
            blocks += blocked(&p.d, place, c.lighting.sun[0].toward);
        }
        uint8_t found = pixel(&p, i % SIDE, i / SIDE)[0];
        double full = display(0.6 * c.lighting.sun[0].toward[1]);
        lit += blocks == 0;
        dark += blocks == tries;
        edge += blocks > 0 && blocks < tries;
        if (blocks == 0) CHECK_NEAR("lit floor", found, full, ROUNDING);
        if (blocks == tries) CHECK_NEAR("dark floor", found, 0, 0);
    }
    CHECK(lit > 500 && dark > 20, "%zu lit, %zu dark, %zu at the edge", lit, dark, edge);
    paint_free(&p);
}

/* ---------------------------------------------------------------- the same bits */

static void make_busy(dar_scene *s)
{
    static const double place[12] = { 0.6, 0, 0, 0.4, 0, 0.6, 0, 0.3, 0, 0, 0.6, 0.7 };
    made_init(s);
    int material = made_material(s, true);
    s->material[material].gloss = 0.6;
    sheet(s, material);
    made_sheet(s, 17, 32, true, made_torus, DAR_NONE);
    made_instance(s, 0, NULL);
    made_instance(s, 1, place);
}

static void threads(void **state)
{
    static const int number[] = { 1, 2, 3, 7 };
    enum { WIDTH = 45, HEIGHT = 31 };
    static uint8_t first[3 * WIDTH * HEIGHT];
    int before = dar_threads();
    (void)state;
    for (int i = 0; i < 4; i++) {
        dar_shade_config c = dar_shade_default(WIDTH, HEIGHT);
        dar_view v = front(WIDTH, HEIGHT, 3);
        painting p;
        dar_scene s;
        dar_threads_set(number[i]);
        make_busy(&s);
        for (int k = 0; k < 3; k++) c.lo[k] = -2, c.hi[k] = 2;
        c.samples = 3;
        paint_init(&p, &s, &c);
        paint(&p, &v);
        if (i == 0) memcpy(first, p.rgb, sizeof first);
        assert_memory_equal(first, p.rgb, sizeof first);
        paint_free(&p);
    }
    dar_threads_set(before);
}

/* What does not move is not drawn again; when the camera moves, the shadows stay. */
static void still(void **state)
{
    enum { SIDE = 32 };
    dar_shade_config c = dar_shade_default(SIDE, SIDE);
    dar_view a = front(SIDE, SIDE, 3), b = front(SIDE, SIDE, 4);
    uint8_t first[3 * SIDE * SIDE];
    painting p;
    dar_scene s;
    (void)state;
    make_busy(&s);
    for (int k = 0; k < 3; k++) c.lo[k] = -2, c.hi[k] = 2;
    paint_init(&p, &s, &c);
    paint(&p, &a);
    memcpy(first, p.rgb, sizeof first);
    paint(&p, &a);
    assert_memory_equal(first, p.rgb, sizeof first);
    assert_int_equal(p.shade.copied, 1);
    paint(&p, &b);
    CHECK(memcmp(first, p.rgb, sizeof first) != 0, "the camera moved and the picture did not");
    assert_int_equal(p.shade.copied, 1);
    assert_int_equal(p.shade.shadow[0].raster.stats.copied, 1);
    paint(&p, &a);
    assert_memory_equal(first, p.rgb, sizeof first);
    paint_free(&p);
}

static void wrong_calls(void **state)
{
    dar_shade_config c = dar_shade_default(8, 8);
    dar_scene s;
    dar_arena plan;
    dar_shade shade;
    (void)state;
    make_busy(&s);
    assert_int_equal(dar_arena_init_plan(&plan, "plan", NULL), DAR_OK);
    c.samples = 0;
    CHECK_ABORTS(dar_shade_init(&shade, &s, &c, &plan));
    c.samples = 2, c.raster.width = DAR_RASTER_MAX_SIDE;
    CHECK_ABORTS(dar_shade_init(&shade, &s, &c, &plan));
    dar_arena_free(&plan);
    dar_scene_free(&s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(srgb),        cmocka_unit_test(lambert),     cmocka_unit_test(bulb),
        cmocka_unit_test(occlusion),   cmocka_unit_test(two_sides),   cmocka_unit_test(sphere),
        cmocka_unit_test(even_sky),    cmocka_unit_test(any_sky),     cmocka_unit_test(gradient),
        cmocka_unit_test(up),          cmocka_unit_test(background),  cmocka_unit_test(coverage),
        cmocka_unit_test(texture),     cmocka_unit_test(far_texture), cmocka_unit_test(vertex_colors),
        cmocka_unit_test(shadow),      cmocka_unit_test(threads),     cmocka_unit_test(still),
        cmocka_unit_test(wrong_calls),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
