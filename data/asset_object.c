/* asset_object.c: things without a motion of their own. */
#include "data/asset_inside.h"

#include <math.h>

static void shift(dar_maker *m, double x, double y, double z)
{
    dar_make_home(m);
    dar_make_shift(m, x, y, z);
}

/* Shapes append to the mesh that make_object has begun. */
typedef void shape(dar_maker *m, dar_dice *d);

static void crate(dar_maker *m, dar_dice *d)
{
    double x = dar_dice_in(d, 0.4, 0.8), y = dar_dice_in(d, 0.35, 0.9);
    shift(m, 0, y / 2, 0);
    dar_make_box(m, x, y, dar_dice_in(d, 0.4, 0.8));
}

static void ball(dar_maker *m, dar_dice *d)
{
    double r = dar_dice_in(d, 0.25, 0.45);
    shift(m, 0, r, 0);
    dar_make_rotate(m, 1, 0.3, 0, dar_dice_in(d, 0, 3));
    dar_make_round(m, r, r, r, 1, 1);
}

static void ring(dar_maker *m, dar_dice *d)
{
    double r = dar_dice_in(d, 0.28, 0.42), tube = dar_dice_in(d, 0.08, 0.16);
    bool stands = dar_dice_chance(d, 0.5);
    shift(m, 0, stands ? r + tube : tube, 0);
    if (stands) dar_make_rotate(m, 1, 0, 0, M_PI / 2);
    dar_make_torus(m, r, tube);
}

static void column(dar_maker *m, dar_dice *d)
{
    double r = dar_dice_in(d, 0.15, 0.35), top = dar_dice_chance(d, 0.4) ? 0 : dar_dice_in(d, 0.4, 1) * r;
    dar_make_cone(m, r, top, dar_dice_in(d, 0.5, 1.4));
}

static void blob(dar_maker *m, dar_dice *d)
{
    double y = dar_dice_in(d, 0.25, 0.5);
    shift(m, 0, y, 0);
    dar_make_rotate(m, 0, 1, 0, dar_dice_in(d, 0, 3));
    dar_make_round(m, dar_dice_in(d, 0.25, 0.4), y, dar_dice_in(d, 0.25, 0.4), dar_dice_in(d, 0.2, 2.2),
                   dar_dice_in(d, 0.2, 2.2));
}

static void vase(dar_maker *m, dar_dice *d)
{
    double profile[15][2] = { { 0, 0 } }, belly = dar_dice_in(d, 0.15, 0.25), at = dar_dice_in(d, 0.3, 0.8);
    double neck = dar_dice_in(d, 0.2, 0.45), height = dar_dice_in(d, 0.6, 1.1);
    for (int i = 1; i < 14; i++) {
        double s = (i - 1) / 12.0;
        profile[i][0] = belly * (0.45 + neck * s * s + 0.8 * pow(sin(M_PI * pow(s, at)), 2));
        profile[i][1] = height * s;
    }
    profile[14][1] = height * 0.9;
    dar_make_lathe(m, (const double(*)[2])profile, 15);
}

static void rock(dar_maker *m, dar_dice *d)
{
    double r = dar_dice_in(d, 0.25, 0.5);
    dar_make_shift(m, 0, 0.7 * r, 0);
    dar_make_stretch(m, 1, dar_dice_in(d, 0.6, 1), dar_dice_in(d, 0.8, 1.2));
    dar_make_rock(m, r, dar_dice_in(d, 0.25, 0.5), dar_rng_u64(d->seed, d->stream, d->next++));
}

static void stack(dar_maker *m, dar_dice *d)
{
    double y = 0, x = dar_dice_in(d, 0.5, 0.7);
    size_t n = 3 + dar_dice_below(d, 3);
    for (size_t i = 0; i < n; i++) {
        double h = dar_dice_in(d, 0.1, 0.25);
        shift(m, dar_dice_in(d, -0.05, 0.05), y + h / 2, dar_dice_in(d, -0.05, 0.05));
        dar_make_rotate(m, 0, 1, 0, dar_dice_in(d, -0.4, 0.4));
        m->paint = dar_asset_paint(m, 0);
        dar_make_box(m, x, h, 0.75 * x);
        y += h;
        x *= dar_dice_in(d, 0.75, 0.95);
    }
}

static void table(dar_maker *m, dar_dice *d)
{
    double x = dar_dice_in(d, 0.7, 1.1), z = dar_dice_in(d, 0.5, 0.7), h = dar_dice_in(d, 0.45, 0.65);
    shift(m, 0, h, 0), dar_make_box(m, x, 0.07, z);
    for (int i = 0; i < 4; i++) {
        shift(m, (i & 1 ? 0.42 : -0.42) * x, h / 2 - 0.02, (i & 2 ? 0.42 : -0.42) * z);
        dar_make_box(m, 0.06, h - 0.04, 0.06);
    }
    m->paint = dar_asset_paint(m, 0);
    shift(m, 0.2 * x, h + 0.03, 0);
    dar_make_lathe(m, (const double[][2]){ { 0, 0 }, { 0.08, 0 }, { 0.12, 0.12 }, { 0.06, 0.22 }, { 0, 0.2 } }, 5);
}

static void chair(dar_maker *m, dar_dice *d)
{
    double s = dar_dice_in(d, 0.42, 0.52), h = dar_dice_in(d, 0.38, 0.46);
    shift(m, 0, h, 0), dar_make_box(m, s, 0.06, s);
    shift(m, 0, h + 0.34, -0.46 * s), dar_make_box(m, s, 0.4, 0.05);
    for (int i = 0; i < 4; i++) {
        shift(m, (i & 1 ? 0.44 : -0.44) * s, h / 2, (i & 2 ? 0.44 : -0.44) * s);
        dar_make_box(m, 0.05, h, 0.05);
    }
}

static void lamp(dar_maker *m, dar_dice *d)
{
    double h = dar_dice_in(d, 0.9, 1.4);
    dar_make_cone(m, 0.18, 0.14, 0.05);
    dar_make_cone(m, 0.025, 0.025, h);
    m->paint = dar_asset_paint(m, 0);
    shift(m, 0, h, 0);
    dar_make_cone(m, 0.26, 0.13, 0.3);
}

static void shelf(dar_maker *m, dar_dice *d)
{
    int rows = 3 + (int)dar_dice_below(d, 2), wood = m->paint, paint[3];
    double w = dar_dice_in(d, 0.6, 0.9), h = 0.36 * rows;
    for (int i = 0; i < 3; i++) paint[i] = dar_asset_paint(m, 0);
    for (int i = 0; i <= rows; i++) shift(m, 0, 0.36 * i + 0.03, 0), dar_make_box(m, w, 0.04, 0.28);
    for (int side = -1; side <= 1; side += 2)
        shift(m, side * w / 2, h / 2 + 0.03, 0), dar_make_box(m, 0.04, h + 0.04, 0.3);
    shift(m, 0, h / 2 + 0.03, -0.14), dar_make_box(m, w, h, 0.02);
    for (int k = 0; k < 3; k++) {
        m->paint = paint[k];
        for (int i = 0; i < rows; i++) {
            double tall = dar_dice_in(d, 0.15, 0.28), wide = w * dar_dice_in(d, 0.12, 0.25);
            shift(m, (k - 1) * 0.29 * w, 0.36 * i + 0.05 + tall / 2, 0), dar_make_box(m, wide, tall, 0.18);
        }
    }
    m->paint = wood;
}

static void mushroom(dar_maker *m, dar_dice *d)
{
    double h = dar_dice_in(d, 0.35, 0.7), r = dar_dice_in(d, 0.25, 0.45);
    dar_make_cone(m, 0.12, 0.08, h);
    m->paint = dar_asset_paint(m, DAR_PAINT(DOTS) | DAR_PAINT(SPOTS) | DAR_PAINT(RINGS));
    shift(m, 0, h, 0);
    dar_make_lathe(
        m, (const double[][2]){ { 0, 0.02 }, { r, 0 }, { 0.94 * r, 0.3 * r }, { 0.6 * r, 0.62 * r }, { 0, 0.75 * r } },
        5);
}

/* A trunk that divides, leaves at the ends. */
static void branch(dar_maker *m, dar_dice *d, const double from[3], const double way[3], double thick, int depth,
                   int leaf)
{
    double to[3], wood = m->paint;
    for (int k = 0; k < 3; k++) to[k] = from[k] + way[k];
    const double tube[2][4] = { { from[0], from[1], from[2], thick }, { to[0], to[1], to[2], 0.7 * thick } };
    dar_make_home(m);
    dar_make_tube(m, tube, 2, NULL);
    if (depth == 0) {
        double r = dar_dice_in(d, 0.13, 0.22);
        m->paint = leaf;
        dar_make_shift(m, to[0], to[1], to[2]);
        dar_make_round(m, r, 0.8 * r, r, 1, 1);
        m->paint = wood;
        return;
    }
    double length = sqrt(way[0] * way[0] + way[1] * way[1] + way[2] * way[2]), a = dar_dice_in(d, 0, 6);
    for (int i = 0; i < 3; i++) {
        double out = dar_dice_in(d, 0.35, 0.6) * length, up = dar_dice_in(d, 0.5, 0.75) * length;
        double next[3] = { 0.3 * way[0] + out * sin(a), up, 0.3 * way[2] + out * cos(a) };
        branch(m, d, to, next, 0.65 * thick, depth - 1, leaf);
        a += 2.1;
    }
}

static void tree(dar_maker *m, dar_dice *d)
{
    int leaf = dar_asset_paint(m, DAR_PAINT(CLOUDS) | DAR_PAINT(SPOTS) | DAR_PAINT(PLAIN));
    double h = dar_dice_in(d, 0.4, 0.65);
    m->density = 2;
    branch(m, d, (const double[]){ 0, 0.03, 0 }, (const double[]){ dar_dice_in(d, -0.1, 0.1), h, 0 }, 0.06, 2, leaf);
}

static void fir(dar_maker *m, dar_dice *d)
{
    double h = dar_dice_in(d, 0.25, 0.4), r = dar_dice_in(d, 0.35, 0.5), y = 0.2;
    dar_make_cone(m, 0.08, 0.07, 0.3);
    m->paint = dar_asset_paint(m, DAR_PAINT(CLOUDS) | DAR_PAINT(STRIPES) | DAR_PAINT(PLAIN) | DAR_PAINT(ZIGZAG));
    for (int i = 0; i < 3; i++) {
        shift(m, 0, y, 0);
        dar_make_cone(m, r, 0, 1.7 * h);
        y += h, r *= 0.76;
    }
}

static void cactus(dar_maker *m, dar_dice *d)
{
    double h = dar_dice_in(d, 0.7, 1.2);
    const double stem[3][4] = { { 0, 0.1, 0, 0.13 }, { 0, h / 2, 0, 0.14 }, { 0, h, 0, 0.11 } };
    dar_make_tube(m, stem, 3, NULL);
    for (int side = -1; side <= 1; side += 2) {
        double y = h * dar_dice_in(d, 0.3, 0.6), up = dar_dice_in(d, 0.2, 0.35);
        const double arm[4][4] = { { 0, y, 0, 0.07 },
                                   { side * 0.24, y + 0.02, 0, 0.075 },
                                   { side * 0.3, y + 0.1, 0, 0.08 },
                                   { side * 0.3, y + up, 0, 0.07 } };
        dar_make_tube(m, arm, 4, NULL);
    }
}

static void arch(dar_maker *m, dar_dice *d)
{
    double r = dar_dice_in(d, 0.35, 0.5), thick = dar_dice_in(d, 0.08, 0.13), spine[7][4];
    for (int i = 0; i < 7; i++) {
        double a = M_PI * i / 6;
        spine[i][0] = -r * cos(a), spine[i][1] = 0.1 + 1.5 * r * sin(a), spine[i][2] = 0, spine[i][3] = thick;
    }
    dar_make_tube(m, (const double(*)[4])spine, 7, NULL);
}

static void stairs(dar_maker *m, dar_dice *d)
{
    int n = 4 + (int)dar_dice_below(d, 2);
    double w = dar_dice_in(d, 0.5, 0.8);
    for (int i = 0; i < n; i++) {
        double h = 0.13 * (i + 1);
        shift(m, 0, h / 2, 0.16 * (0.5 * n - i)), dar_make_box(m, w, h, 0.16);
    }
}

static void spring(dar_maker *m, dar_dice *d)
{
    double spine[33][4], r = dar_dice_in(d, 0.2, 0.3), h = dar_dice_in(d, 0.5, 0.9);
    for (int i = 0; i < 33; i++) {
        double a = 2 * M_PI * i / 8;
        spine[i][0] = r * sin(a), spine[i][1] = 0.07 + h * i / 32, spine[i][2] = r * cos(a), spine[i][3] = 0.05;
    }
    dar_make_tube(m, (const double(*)[4])spine, 33, NULL);
}

static void house(dar_maker *m, dar_dice *d)
{
    double x = dar_dice_in(d, 0.6, 0.9), z = dar_dice_in(d, 0.5, 0.7), h = dar_dice_in(d, 0.45, 0.65);
    shift(m, 0, h / 2, 0), dar_make_box(m, x, h, z);
    m->paint = dar_asset_paint(m, DAR_PAINT(BRICKS) | DAR_PAINT(TILES) | DAR_PAINT(STRIPES) | DAR_PAINT(ZIGZAG));
    shift(m, 0, h, 0);
    dar_make_rotate(m, 0, 1, 0, M_PI / 4);
    dar_make_round(m, 0.1 + 0.75 * x, 0.45, 0.1 + 0.75 * x, 2, 2);
    m->paint = dar_make_plain(m, 0.25, 0.18, 0.12);
    shift(m, 0, 0.17, z / 2), dar_make_box(m, 0.18, 0.34, 0.03);
}

/* ---------------------------------------------------------------- kinds */

struct object {
    shape *fn;
    unsigned patterns;
};

static void make_object(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    const struct object *o = row;
    int paint = dar_asset_paint(m, o->patterns);
    dar_make_begin(m);
    m->density = dar_dice_in(d, 0.6, 1.8);
    m->paint = paint;
    o->fn(m, d);
    dar_make_show(m, dar_make_node(m, out->root, "object", 0, 0, 0), dar_make_end(m, "object"));
    out->way = DAR_ASSET_STAYS;
}

#define WOODY (DAR_PAINT(WOOD) | DAR_PAINT(PLAIN) | DAR_PAINT(MARBLE))
#define STONE (DAR_PAINT(CLOUDS) | DAR_PAINT(MARBLE) | DAR_PAINT(PLAIN))
#define OBJECT(fn, patterns)                                                                                           \
    {                                                                                                                  \
#        fn, "object", DAR_ASSET_TRAIN, make_object, &(const struct object)                                            \
        {                                                                                                              \
            fn, patterns                                                                                               \
        }                                                                                                              \
    }
/* clang-format off */
const dar_asset_kind dar_asset_objects[] = {
    OBJECT(crate, 0), OBJECT(ball, 0), OBJECT(ring, 0), OBJECT(column, 0), OBJECT(blob, 0), OBJECT(vase, 0),
    OBJECT(rock, STONE), OBJECT(stack, 0), OBJECT(table, WOODY), OBJECT(chair, WOODY), OBJECT(lamp, 0),
    OBJECT(shelf, WOODY), OBJECT(mushroom, STONE), OBJECT(tree, WOODY), OBJECT(fir, WOODY),
    OBJECT(cactus, DAR_PAINT(STRIPES) | DAR_PAINT(SPOTS)), OBJECT(arch, 0), OBJECT(stairs, 0), OBJECT(spring, 0),
    OBJECT(house, 0),
};
/* clang-format on */
const size_t dar_asset_object_count = DAR_COUNT(dar_asset_objects);
