/* light.c: skies as functions of direction, their light in nine harmonics, and lightings by name. */
#include "data/light.h"

#include <math.h>
#include <string.h>

#include "lib/nearest.h"
#include "lib/real.h"
#include "lib/rng.h"

#define ROWS    64 /* directions over which a sky is integrated */
#define COLUMNS 128

const char *const dar_sky_name[] = { "gradient", "clouds", "hills", "panels", NULL };

/* ---------------------------------------------------------------- by name */

/* clang-format off */
const dar_lighting_kind dar_lighting_kinds[] = {
    { "day", "high sun, blue sky with clouds",
      { .sun = { { { 0.42, 0.72, 0.55 }, { 0.95, 0.88, 0.74 }, true } }, .suns = 1,
        .sky = { .kind = DAR_SKY_CLOUDS, .zenith = { 0.16, 0.33, 0.68 }, .horizon = { 0.62, 0.74, 0.86 },
                 .ground = { 0.22, 0.22, 0.17 }, .haze = 0.06, .glow = { 0.60, 0.54, 0.40 },
                 .glow_toward = { 0.42, 0.72, 0.55 }, .glow_size = 0.22, .detail = { 0.95, 0.95, 0.96 }, .seed = 1 },
        .sky_light = 0.8, .occlusion = 0.6, .softness = 0.012, .exposure = 0.85 } },
    { "studio", "key, fill and rim before a grey backdrop",
      { .sun = { { { 0.55, 0.62, 0.56 }, { 0.80, 0.78, 0.75 }, true },
                 { { -0.75, 0.25, 0.60 }, { 0.14, 0.16, 0.20 }, false },
                 { { -0.35, 0.45, -0.82 }, { 0.35, 0.36, 0.40 }, false } }, .suns = 3,
        .sky = { .kind = DAR_SKY_GRADIENT, .zenith = { 0.46, 0.47, 0.50 }, .horizon = { 0.30, 0.31, 0.33 },
                 .ground = { 0.12, 0.12, 0.13 }, .haze = 0.60, .glow_toward = { 0, 1, 0 }, .glow_size = 1 },
        .sky_light = 0.8, .occlusion = 0.7, .softness = 0.020, .exposure = 0.95 } },
    { "sunset", "low warm sun, hills",
      { .sun = { { { -0.72, 0.34, 0.60 }, { 1.15, 0.62, 0.30 }, true } }, .suns = 1,
        .sky = { .kind = DAR_SKY_HILLS, .zenith = { 0.10, 0.14, 0.32 }, .horizon = { 0.78, 0.42, 0.26 },
                 .ground = { 0.10, 0.08, 0.09 }, .haze = 0.10, .glow = { 1.30, 0.64, 0.20 },
                 .glow_toward = { -0.90, 0.15, 0.40 }, .glow_size = 0.32, .detail = { 0.11, 0.09, 0.14 }, .seed = 2 },
        .sky_light = 1.0, .occlusion = 0.6, .softness = 0.012, .exposure = 0.95 } },
    { "overcast", "soft light from above, weak shadows",
      { .sun = { { { 0.20, 0.94, 0.28 }, { 0.36, 0.36, 0.36 }, true } }, .suns = 1,
        .sky = { .kind = DAR_SKY_CLOUDS, .zenith = { 0.58, 0.61, 0.66 }, .horizon = { 0.70, 0.72, 0.74 },
                 .ground = { 0.20, 0.20, 0.19 }, .haze = 0.12, .glow_toward = { 0, 1, 0 }, .glow_size = 1,
                 .detail = { 0.82, 0.83, 0.85 }, .seed = 3 },
        .sky_light = 1.0, .occlusion = 0.7, .softness = 0.030, .exposure = 0.85 } },
    { "night", "moonlight, two lamps' colours from the sides",
      { .sun = { { { 0.30, 0.80, 0.52 }, { 0.34, 0.42, 0.62 }, true },
                 { { 0.93, 0.10, 0.35 }, { 0.50, 0.22, 0.08 }, false },
                 { { -0.93, 0.10, 0.35 }, { 0.06, 0.20, 0.34 }, false } }, .suns = 3,
        .sky = { .kind = DAR_SKY_HILLS, .zenith = { 0.010, 0.014, 0.040 }, .horizon = { 0.060, 0.075, 0.140 },
                 .ground = { 0.020, 0.020, 0.030 }, .haze = 0.10, .glow_toward = { 0, 1, 0 }, .glow_size = 1,
                 .detail = { 0.014, 0.016, 0.030 }, .seed = 4 },
        .sky_light = 1.6, .occlusion = 0.6, .softness = 0.012, .exposure = 1.2 } },
    { "flat", "even light without shadows before white",
      { .sun = { { { 0.30, 0.60, 0.74 }, { 0.35, 0.35, 0.35 }, false } }, .suns = 1,
        .sky = { .kind = DAR_SKY_GRADIENT, .zenith = { 0.92, 0.92, 0.92 }, .horizon = { 0.92, 0.92, 0.92 },
                 .ground = { 0.92, 0.92, 0.92 }, .haze = 1, .glow_toward = { 0, 1, 0 }, .glow_size = 1 },
        .sky_light = 0.65, .occlusion = 0.5, .softness = 0.012, .exposure = 1.0 } },
};
/* clang-format on */
const size_t dar_lighting_count = sizeof dar_lighting_kinds / sizeof *dar_lighting_kinds;

dar_status dar_lighting_find(const char *name, size_t *kind, dar_err *e)
{
    dar_nearest near = dar_nearest_to(name);
    for (*kind = 0; *kind < dar_lighting_count; ++*kind) {
        if (strcmp(dar_lighting_kinds[*kind].name, name) == 0) return DAR_OK;
        dar_nearest_try(&near, dar_lighting_kinds[*kind].name);
    }
    return dar_fail(e, DAR_ERR_USAGE, "lighting: found '%s', expected a name such as %s", name,
                    near.best ? near.best : dar_lighting_kinds[0].name);
}

static void unit(double x[3])
{
    double length = sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]);
    for (int c = 0; c < 3; c++) x[c] /= length;
}

static void stand_up(double x[3])
{
    double y = x[1];
    x[1] = -x[2];
    x[2] = y;
}

void dar_lighting_z_up(dar_lighting *l)
{
    for (size_t i = 0; i < l->suns; i++) stand_up(l->sun[i].toward);
    for (size_t i = 0; i < l->bulbs; i++) stand_up(l->bulb[i].at);
    stand_up(l->sky.glow_toward);
    stand_up(l->up);
}

void dar_lighting_aim(dar_lighting *l, double azimuth, double height)
{
    const double toward[3] = { cos(height) * sin(azimuth), sin(height), cos(height) * cos(azimuth) };
    memcpy(l->sun[0].toward, toward, sizeof toward);
    memcpy(l->sky.glow_toward, toward, sizeof toward);
}

dar_lighting dar_lighting_of(size_t kind, bool z_up)
{
    dar_lighting l = dar_lighting_kinds[kind].lighting;
    for (size_t i = 0; i < l.suns; i++) unit(l.sun[i].toward);
    unit(l.sky.glow_toward);
    l.up[1] = 1;
    if (z_up) dar_lighting_z_up(&l);
    return l;
}

/* ---------------------------------------------------------------- directions */

static float dot(const float a[3], const float b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static float ramp(float lo, float hi, float x)
{
    float t = dar_lesserf(dar_greaterf((x - lo) / (hi - lo), 0), 1);
    return t * t * (3 - 2 * t);
}

static void mix(float y[3], const double to[3], float share)
{
    for (int c = 0; c < 3; c++) y[c] += share * ((float)to[c] - y[c]);
}

void dar_skylight_smooth(const dar_skylight *s, const float d[3], float y[3])
{
    const dar_sky *sky = &s->sky;
    float h = dot(d, s->up), toward = 0;

    for (int c = 0; c < 3; c++) {
        y[c] = (float)sky->horizon[c];
        toward += d[c] * (float)sky->glow_toward[c];
    }
    float glow = s->glow_width / (s->glow_width + dar_greaterf(1 - toward, 0));
    if (h > 0) mix(y, sky->zenith, 1 - (1 - h) * (1 - h));
    for (int c = 0; c < 3; c++) y[c] += (float)sky->glow[c] * glow * glow; /* half at glow_size */
    if (h < 0)
        mix(y, sky->ground, ramp(0, (float)sky->haze, -h) * (0.7f + 0.3f * ramp(0, 0.7f, -h))); /* air before it */
}

/* Blended between four numbers of the table, which repeats. */
static float noise_at(const dar_skylight *s, float x, float y)
{
    float fx = floorf(x), fy = floorf(y), u = ramp(0, 1, x - fx), v = ramp(0, 1, y - fy);
    unsigned i = (unsigned)(int)fx, j = (unsigned)(int)fy, m = DAR_LIGHT_LATTICE - 1;
    const float *a = s->noise[j & m], *b = s->noise[(j + 1) & m];
    float top = a[i & m] + u * (a[(i + 1) & m] - a[i & m]), bottom = b[i & m] + u * (b[(i + 1) & m] - b[i & m]);
    return top + v * (bottom - top);
}

/* Four octaves, 0 to 1. */
static float cloud(const dar_skylight *s, float x, float y)
{
    float sum = 0, share = 0.5f;
    for (int k = 0; k < 4; k++, share /= 2, x = 2.03f * x + 7.1f, y = 2.03f * y + 3.7f)
        sum += share * noise_at(s, x, y);
    return sum / 0.9375f;
}

static void add_clouds(const dar_skylight *s, const float d[3], float y[3])
{
    float h = dot(d, s->up), far = 1 / (dar_greaterf(h, 0) + 0.12f);
    if (h <= 0) return;
    float much = cloud(s, 1.3f * far * dot(d, s->east), 1.3f * far * dot(d, s->north));
    mix(y, s->sky.detail, 0.85f * ramp(0.46f, 0.72f, much) * ramp(0, 0.25f, h));
}

static void add_hills(const dar_skylight *s, const float d[3], float y[3])
{
    float h = dot(d, s->up), turn = atan2f(dot(d, s->east), dot(d, s->north)) * (float)(DAR_LIGHT_LATTICE / (2 * M_PI));
    if (h > 0.4f) return;
    for (int row = 0; row < 2; row++) {
        float ridge = (row ? 0.02f : 0.06f) + 0.16f * cloud(s, turn + 5.0f * (float)row, 3.3f * (float)row);
        float share = ramp(0.006f, -0.006f, h - ridge * (row ? 0.6f : 1)) * (row ? 1 : 0.7f);
        mix(y, s->sky.detail, share * ramp(-(float)s->sky.haze - 0.1f, -0.02f, h));
    }
}

static void add_panels(const dar_skylight *s, const float d[3], float y[3])
{
    float h = dot(d, s->up), turn = atan2f(dot(d, s->east), dot(d, s->north)) / (float)(2 * M_PI) + 1;
    float phase = 5 * (turn + s->noise[0][0]), across = fabsf(phase - floorf(phase) - 0.5f);
    mix(y, s->sky.detail, ramp(0.22f, 0.16f, across) * ramp(-0.05f, 0.10f, h) * ramp(0.75f, 0.60f, h));
}

typedef void detail(const dar_skylight *s, const float d[3], float y[3]);

static detail *const details[] = {
    [DAR_SKY_GRADIENT] = NULL,
    [DAR_SKY_CLOUDS] = add_clouds,
    [DAR_SKY_HILLS] = add_hills,
    [DAR_SKY_PANELS] = add_panels,
};

void dar_skylight_at(const dar_skylight *s, const float d[3], float y[3])
{
    dar_skylight_smooth(s, d, y);
    if (details[s->sky.kind]) details[s->sky.kind](s, d, y);
}

/* ---------------------------------------------------------------- light on surfaces */

/* Polynomials of the nine harmonics; their factors are in the table. */
static void harmonics(const float n[3], float b[9])
{
    const float x = n[0], y = n[1], z = n[2];
    const float all[9] = { 1, y, z, x, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y };
    memcpy(b, all, sizeof all);
}

void dar_skylight_on(const dar_skylight *s, const float n[3], float y[3])
{
    float b[9];
    harmonics(n, b);
    for (int c = 0; c < 3; c++) {
        y[c] = 0;
        for (int k = 0; k < 9; k++) y[c] += b[k] * s->harmonic[k][c];
        y[c] = dar_greaterf(y[c], 0);
    }
}

/* Factors of the polynomials, squared: once from the light's integral, once from the surface's. */
static const double factor[9] = { 0.282095, 0.488603, 0.488603, 0.488603, 1.092548,
                                  1.092548, 0.315392, 1.092548, 0.546274 };
/* Of a cosine lobe over pi, by degree. */
static const double lobe[9] = { 1, 2.0 / 3, 2.0 / 3, 2.0 / 3, 0.25, 0.25, 0.25, 0.25, 0.25 };

static void integrate(dar_skylight *s, double sky_light)
{
    double sum[9][3] = { { 0 } };
    for (int i = 0; i < ROWS; i++)
        for (int j = 0; j < COLUMNS; j++) {
            double z = 2 * (i + 0.5) / ROWS - 1, turn = 2 * M_PI * (j + 0.5) / COLUMNS, r = sqrt(1 - z * z);
            float d[3] = { (float)(r * cos(turn)), (float)(r * sin(turn)), (float)z }, y[3], b[9];
            dar_skylight_at(s, d, y);
            harmonics(d, b);
            for (int k = 0; k < 9; k++)
                for (int c = 0; c < 3; c++) sum[k][c] += (double)b[k] * y[c];
        }
    double scale = sky_light * 4 * M_PI / (ROWS * COLUMNS);
    for (int k = 0; k < 9; k++)
        for (int c = 0; c < 3; c++) s->harmonic[k][c] = (float)(scale * factor[k] * factor[k] * lobe[k] * sum[k][c]);
}

static void set_axes(dar_skylight *s, const double up[3])
{
    int flat = fabs(up[0]) < fabs(up[1]) ? 0 : 1; /* an axis that is not up */
    double east[3] = { flat == 0, flat == 1, 0 }, along = east[flat] * up[flat];
    for (int c = 0; c < 3; c++) east[c] -= along * up[c];
    unit(east);
    for (int c = 0; c < 3; c++) {
        int d = (c + 1) % 3, f = (c + 2) % 3;
        s->up[c] = (float)up[c];
        s->east[c] = (float)east[c];
        s->north[c] = (float)(up[d] * east[f] - up[f] * east[d]);
    }
}

void dar_skylight_init(dar_skylight *s, const dar_lighting *l)
{
    uint64_t stream = dar_rng_stream("sky");
    s->sky = l->sky;
    s->glow_width = (1 - cosf((float)s->sky.glow_size)) / 0.41421356f;
    set_axes(s, l->up);
    for (uint64_t i = 0; i < DAR_LIGHT_LATTICE * DAR_LIGHT_LATTICE; i++)
        s->noise[i / DAR_LIGHT_LATTICE][i % DAR_LIGHT_LATTICE] = dar_rng_f32(l->sky.seed, stream, i);
    integrate(s, l->sky_light);
}
