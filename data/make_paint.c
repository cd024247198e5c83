/* make_paint.c: textures out of patterns and palettes.  Every pattern repeats without a seam. */
#include "data/make.h"

#include <math.h>

#include "lib/thread.h"

#define SIDE  DAR_MAKE_SIDE
#define GRAIN 32 /* cells of fine noise across a texture */
#define TABLE 1024

/* Patterns with thin lines. */
#define THIN (1u << DAR_PATTERN_BRICKS | 1u << DAR_PATTERN_TILES | 1u << DAR_PATTERN_WOOD)

/* sRGB: two that fill, one that accents, one that is dark or light. */
static const uint32_t palettes[][4] = {
    { 0xe76f51, 0xf4a261, 0x2a9d8f, 0x264653 }, { 0xf1faee, 0xa8dadc, 0xe63946, 0x1d3557 },
    { 0xfefae0, 0xdda15e, 0x606c38, 0x283618 }, { 0xffcdb2, 0xe5989b, 0xb5838d, 0x6d6875 },
    { 0x8ecae6, 0x219ebc, 0xffb703, 0x023047 }, { 0xcdb4db, 0xffc8dd, 0xa2d2ff, 0x7b6d8d },
    { 0xd9c5b2, 0x9c6644, 0x7f5539, 0x3f2a1d }, { 0xedede9, 0xd5bdaf, 0xb08968, 0x5e503f },
    { 0x95d5b2, 0x40916c, 0xf9c74f, 0x1b4332 }, { 0xf94144, 0xf8961e, 0xf9c74f, 0x577590 },
    { 0xb7b7a4, 0xa5a58d, 0xcb997e, 0x6b705c }, { 0xe0e1dd, 0x778da9, 0x415a77, 0x1b263b },
    { 0xffe5d9, 0xf4acb7, 0x9d8189, 0xd8e2dc }, { 0x4cc9f0, 0x4361ee, 0xf72585, 0x3a0ca3 },
    { 0xdad7cd, 0xa3b18a, 0x588157, 0x344e41 }, { 0xfcbf49, 0xf77f00, 0xd62828, 0x003049 },
    { 0xc9ada7, 0x9a8c98, 0x4a4e69, 0x22223b }, { 0xf2e8cf, 0xa7c957, 0x6a994e, 0xbc4749 },
    { 0xe9edc9, 0xccd5ae, 0xd4a373, 0xfaedcd }, { 0x9bf6ff, 0xa0c4ff, 0xffadad, 0xbdb2ff },
    { 0xb08968, 0xddb892, 0xe6ccb2, 0x7f5539 }, { 0x8d99ae, 0xedf2f4, 0xef233c, 0x2b2d42 },
    { 0x70d6ff, 0xff70a6, 0xff9770, 0xffd670 }, { 0x606060, 0x9a9a9a, 0xd0d0d0, 0x303030 },
    { 0xfdf0d5, 0xc1121f, 0x669bbc, 0x780000 }, { 0x52796f, 0x84a98c, 0xcad2c5, 0x2f3e46 },
};

const dar_paint_style dar_make_any = { .palette = DAR_NONE, .contrast = 1 };

struct paint {
    dar_pattern pattern;
    double color[4][3]; /* sRGB in [0, 1] */
    int n, k;           /* repeats across; of stripes against their slant */
    double share, grain;
    float noise[TABLE];
    uint8_t *rgba;
};

/* ---------------------------------------------------------------- noise */

/* Value noise of `cells` cells across the texture. */
static double lattice(const struct paint *p, double u, double v, int cells)
{
    double x = u * cells, y = v * cells, fx = x - floor(x), fy = y - floor(y), c[4];
    int i = (int)floor(x), j = (int)floor(y);
    for (int k = 0; k < 4; k++) {
        unsigned a = (unsigned)((i + (k & 1) + cells) % cells), b = (unsigned)((j + (k >> 1) + cells) % cells);
        c[k] = (double)p->noise[(a * 37 + b * 101 + a * b * 13 + (unsigned)cells * 7) % TABLE];
    }
    fx *= fx * (3 - 2 * fx), fy *= fy * (3 - 2 * fy);
    return (1 - fy) * ((1 - fx) * c[0] + fx * c[1]) + fy * ((1 - fx) * c[2] + fx * c[3]);
}

/* In [-1, 1]; most of it within a half. */
static double clouds(const struct paint *p, double u, double v, int cells)
{
    return (lattice(p, u, v, cells) + 0.5 * lattice(p, u, v, 2 * cells) + 0.25 * lattice(p, u, v, 4 * cells)) / 1.5;
}

/* ---------------------------------------------------------------- patterns: which color, from 0 to 3 */

static double wave(double x)
{
    return x - floor(x);
}

static int parity(double x)
{
    return (int)floor(x) & 1;
}

static double bricks(const struct paint *p, double u, double v)
{
    double y = v * 2 * p->n, x = u * p->n + 0.5 * parity(y);
    bool mortar = wave(x) < 0.06 || wave(y) < 0.12;
    if (mortar) return 3;
    return 0.5 + 0.5 * (double)p->noise[(unsigned)((int)floor(y) * 31 + (int)floor(wave(x / p->n) * p->n)) % TABLE];
}

static double tiles(const struct paint *p, double u, double v)
{
    double x = u * p->n, y = v * p->n;
    if (wave(x) < 0.05 || wave(y) < 0.05) return 3;
    return 1 + (double)p->noise[(unsigned)((int)floor(y) * 57 + (int)floor(x) * 3) % TABLE];
}

static double wood(const struct paint *p, double u, double v)
{
    double plank = floor(u * p->n), tone = (double)p->noise[(unsigned)plank * 11 % TABLE];
    if (wave(u * p->n) < 0.03) return 3;
    double grain = sin(2 * M_PI * (6 * wave(u * p->n) + 1.5 * clouds(p, u, v, 4) + tone));
    return 0.5 + 0.25 * tone + 0.25 * grain;
}

static double dots(const struct paint *p, double u, double v, bool spread)
{
    double x = u * p->n, y = v * p->n;
    unsigned cell = (unsigned)((int)floor(x) * 17 + (int)floor(y) * 71);
    double dx = spread ? 0.2 * (double)p->noise[cell % TABLE] : 0.0,
           dy = spread ? 0.2 * (double)p->noise[(cell + 5) % TABLE] : 0.0;
    double r = hypot(wave(x) - 0.5 - dx, wave(y) - 0.5 - dy);
    double size = spread ? 0.2 + 0.09 * (double)p->noise[(cell + 9) % TABLE] : 0.18 + 0.2 * p->share;
    return r < size ? (spread ? 2 + (cell & 1) : 2) : 0;
}

static double color_at(const struct paint *p, double u, double v)
{
    double n = p->n;
    switch (p->pattern) {
    case DAR_PATTERN_CHECKER: return parity(u * 2 * n) ^ parity(v * 2 * n);
    case DAR_PATTERN_STRIPES: return wave(v * n) < p->share ? 0 : wave(v * n) < 0.9 ? 1 : 2;
    case DAR_PATTERN_SLANTED: return wave(u * n + v * p->k) < p->share ? 0 : 2;
    case DAR_PATTERN_DOTS: return dots(p, u, v, false);
    case DAR_PATTERN_SPOTS: return dots(p, u, v, true);
    case DAR_PATTERN_BRICKS: return bricks(p, u, v);
    case DAR_PATTERN_TILES: return tiles(p, u, v);
    case DAR_PATTERN_WOOD: return wood(p, u, v);
    case DAR_PATTERN_CLOUDS: return 1 + 1.6 * clouds(p, u, v, p->n + 2);
    case DAR_PATTERN_MARBLE: return 1 + sin(2 * M_PI * (n * u + p->k * v + 0.9 * clouds(p, u, v, 4)));
    case DAR_PATTERN_GRADIENT: return 2 * fabs(2 * wave(v) - 1);
    case DAR_PATTERN_ZIGZAG: return (int)floor(wave(v * n + 0.5 * fabs(2 * wave(u * n) - 1)) * 3);
    case DAR_PATTERN_RINGS: return (int)floor(6 * hypot(wave(u * n) - 0.5, wave(v * n) - 0.5)) % 3;
    case DAR_PATTERN_PLAID:
        return (wave(u * n) < p->share) + (wave(v * n) < p->share) + (wave(u * n) > 0.92 || wave(v * n) > 0.92);
    default: return 0.35 + 0.35 * clouds(p, u, v, 4);
    }
}

static uint8_t byte_of(double x)
{
    return (uint8_t)(255 * fmin(fmax(x, 0), 1) + 0.5);
}

static void paint_row(void *ctx, size_t row, int thread)
{
    const struct paint *p = ctx;
    double v = ((double)row + 0.5) / SIDE;
    (void)thread;
    for (size_t c = 0; c < SIDE; c++) {
        double u = ((double)c + 0.5) / SIDE, x = fmin(fmax(color_at(p, u, v), 0), 3);
        double light = 1 + p->grain * lattice(p, u, v, GRAIN);
        int i = x < 2 ? (int)x : 2;
        uint8_t *y = p->rgba + 4 * (row * SIDE + c);
        for (int k = 0; k < 3; k++)
            y[k] = byte_of(light * ((1 - (x - i)) * p->color[i][k] + (x - i) * p->color[i + 1][k]));
        y[3] = 255;
    }
}

/* ---------------------------------------------------------------- a draw */

static dar_pattern draw_pattern(dar_dice *d, unsigned wanted, bool coarse)
{
    unsigned all = (1u << DAR_PATTERNS) - 1, any = wanted ? wanted & all : all;
    if (coarse) any = any & ~THIN ? any & ~THIN : all & ~THIN;
    for (;;) {
        size_t i = dar_dice_below(d, DAR_PATTERNS);
        if (any >> i & 1) return (dar_pattern)i;
    }
}

/* A palette with its first three colors in any order, each a little off. */
static void draw_colors(struct paint *p, dar_dice *d, const dar_paint_style *style)
{
    size_t row = style->palette == DAR_NONE ? dar_dice_below(d, DAR_COUNT(palettes)) : (size_t)style->palette;
    size_t turn = dar_dice_below(d, 3);
    double mean[3] = { 0 };
    for (size_t i = 0; i < 4; i++) {
        uint32_t c = palettes[row % DAR_COUNT(palettes)][i < 3 ? (i + turn) % 3 : 3];
        double light = dar_dice_in(d, 0.88, 1.08);
        for (int k = 0; k < 3; k++) {
            p->color[i][k] = light * (c >> (16 - 8 * k) & 255) / 255 + dar_dice_in(d, -0.03, 0.03);
            mean[k] += p->color[i][k] / 4;
        }
    }
    for (size_t i = 0; i < 4; i++)
        for (int k = 0; k < 3; k++) p->color[i][k] = mean[k] + style->contrast * (p->color[i][k] - mean[k]);
}

static int add_material(dar_maker *m, dar_material x)
{
    dar_scene *s = m->scene;
    DAR_ASSERT(s->materials < DAR_MAKE_PAINTS, "make: more than %d paints", DAR_MAKE_PAINTS);
    s->material[s->materials] = x;
    return (int)s->materials++;
}

int dar_make_paint(dar_maker *m, const dar_paint_style *style)
{
    dar_scene *s = m->scene;
    dar_dice *d = &m->look;
    struct paint p = { .pattern = draw_pattern(d, style->patterns, m->coarse) };
    draw_colors(&p, d, style);
    dar_material material = {
        .name = "paint", .color = { 1, 1, 1, 1 }, .image = DAR_NONE, .double_sided = style->double_sided
    };
    material.gloss = dar_dice_chance(d, 0.4) ? dar_dice_in(d, 0.2, 0.65) : 0;
    if (m->bare) return add_material(m, material);
    p.n = 1 + (int)dar_dice_below(d, 3);
    p.k = 1 + (int)dar_dice_below(d, 3);
    p.share = dar_dice_in(d, 0.3, 0.6);
    p.grain = dar_dice_in(d, 0.04, 0.14);
    if (m->coarse) p.n = p.k = 1, p.grain = 0;
    uint64_t stream = dar_rng_stream("paint noise"), seed = dar_rng_u64(d->seed, d->stream, d->next++);
    for (uint64_t i = 0; i < TABLE; i++) p.noise[i] = 2 * dar_rng_f32(seed, stream, i) - 1;
    p.rgba = dar_arena_push(&s->memory, (size_t)4 * SIDE * SIDE);
    dar_parallel(SIDE, paint_row, &p);
    s->image[s->images] = (dar_image){ SIDE, SIDE, p.rgba };
    material.image = (int)s->images++;
    return add_material(m, material);
}

static double linear(double x)
{
    return x <= 0.04045 ? x / 12.92 : pow((x + 0.055) / 1.055, 2.4);
}

int dar_make_plain(dar_maker *m, double r, double g, double b)
{
    return add_material(m, (dar_material){ .name = "plain",
                                           .color = { linear(r), linear(g), linear(b), 1 },
                                           .image = DAR_NONE,
                                           .gloss = DAR_GLOSS_UNKNOWN });
}
