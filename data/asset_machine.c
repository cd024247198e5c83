/* asset_machine.c: things that stand and turn, swing, slide. */
#include "data/asset_inside.h"

#include <math.h>

/* A node that shows what was made since dar_make_begin. */
static int part(dar_maker *m, int parent, const char *name, double x, double y, double z)
{
    int node = dar_make_node(m, parent, name, x, y, z);
    dar_make_show(m, node, dar_make_end(m, name));
    return node;
}

static void spin(dar_maker *m, int node, double x, double y, double z, double rate)
{
    dar_make_move(m, (dar_mover){ .node = node, .path = DAR_ROTATION, .axis = { x, y, z }, .rate = rate });
}

static void swing(dar_maker *m, int node, double x, double y, double z, double amount, double frequency, double phase)
{
    dar_make_move(m, (dar_mover){ .node = node,
                                  .path = DAR_ROTATION,
                                  .axis = { x, y, z },
                                  .swing = amount,
                                  .frequency = frequency,
                                  .phase = phase });
}

static void begin(dar_maker *m, int paint)
{
    dar_make_begin(m);
    m->paint = paint;
}

static void at(dar_maker *m, double x, double y, double z)
{
    dar_make_home(m);
    dar_make_shift(m, x, y, z);
}

/* Three gears in a row, meshing, on a wall or lying. */
static void make_gears(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    double tooth = dar_dice_in(d, 0.1, 0.14), x = -0.9, last = 0, phase = 0, rate = dar_dice_in(d, 1.2, 2.5);
    int upright = *(const int *)row, root = dar_make_node(m, out->root, "wall", 0, upright ? 0.85 : 0.25, 0);
    if (!upright) dar_make_turn(m, root, 1, 0, 0, -M_PI / 2);
    for (int i = 0; i < 3; i++) {
        size_t teeth = 9 + dar_dice_below(d, 10);
        double radius = tooth * (double)teeth / M_PI, pitch = 2 * M_PI / (double)teeth, angle = 0;
        x += last + (i ? radius : 0);
        begin(m, dar_asset_paint(m, 0));
        dar_make_gear(m, teeth, radius, 0.9 * tooth, 0.16);
        m->paint = dar_asset_paint(m, DAR_PAINT(RINGS) | DAR_PAINT(PLAIN) | DAR_PAINT(PLAID));
        dar_make_rotate(m, 1, 0, 0, M_PI / 2);
        dar_make_shift(m, 0, -0.15, 0);
        dar_make_cone(m, 0.3 * radius, 0.3 * radius, 0.3);
        int node = part(m, root, "gear", x, 0, 0);
        /* Where two meet, the tooth of one faces the gap of the other: their shares of a pitch sum to 3 / 8. */
        if (i) angle = M_PI - (0.375 - phase) * pitch;
        phase = -angle / pitch;
        dar_make_turn(m, node, 0, 0, 1, angle);
        spin(m, node, 0, 0, 1, (i % 2 ? -12 : 12) * rate / (double)teeth);
        last = radius;
    }
    out->way = DAR_ASSET_STAYS;
}

static void make_pendulums(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    int n = *(const int *)row, frame = dar_asset_paint(m, DAR_PAINT(WOOD) | DAR_PAINT(PLAIN) | DAR_PAINT(STRIPES));
    double gap = 0.3, width = gap * n + 0.2, height = dar_dice_in(d, 1.2, 1.7), f = dar_dice_in(d, 0.6, 0.9);
    int bob = dar_asset_paint(m, 0);
    begin(m, frame);
    at(m, 0, height, 0), dar_make_box(m, width, 0.08, 0.08);
    for (int side = -1; side <= 1; side += 2) {
        at(m, side * width / 2, height / 2, 0), dar_make_box(m, 0.08, height + 0.08, 0.08);
        at(m, side * width / 2, 0.04, 0), dar_make_box(m, 0.1, 0.08, 0.7);
    }
    part(m, out->root, "frame", 0, 0, 0);
    for (int i = 0; i < n; i++) {
        double length = height * (0.5 + 0.3 * i / n);
        begin(m, frame);
        const double rod[2][4] = { { 0, 0, 0, 0.015 }, { 0, -length, 0, 0.015 } };
        dar_make_tube(m, rod, 2, NULL);
        m->paint = n > 3 ? dar_asset_paint(m, 0) : bob;
        at(m, 0, -length, 0), dar_make_round(m, 0.13, 0.13, 0.13, 1, 1);
        int node = part(m, out->root, "pendulum", (i - 0.5 * (n - 1)) * gap, height, 0);
        swing(m, node, 1, 0, 0, dar_dice_in(d, 0.4, 0.65), f / sqrt(0.5 + 0.3 * i / n), 0.25);
    }
}

/* A crank drives a slotted bar (Scotch yoke) and the pistons on it: their way is a pure sine. */
static void make_pistons(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    int n = *(const int *)row, block = dar_asset_paint(m, DAR_PAINT(TILES) | DAR_PAINT(BRICKS) | DAR_PAINT(CHECKER));
    double f = dar_dice_in(d, 0.6, 1.2), reach = 0.22;
    begin(m, block);
    at(m, 0, 0.2, 0), dar_make_box(m, 0.5 * n + 0.2, 0.4, 0.6);
    part(m, out->root, "block", 0, 0, 0);
    for (int i = 0; i < n; i++) {
        double x = 0.5 * (i - 0.5 * (n - 1)), phase = (double)i / n;
        begin(m, dar_asset_paint(m, 0));
        at(m, 0, -0.3, 0), dar_make_cone(m, 0.06, 0.06, 0.4);
        at(m, 0, 0.1, 0), dar_make_cone(m, 0.2, 0.2, 0.25);
        int piston = part(m, out->root, "piston", x, 0.4 + reach + 0.2, 0);
        dar_make_move(m, (dar_mover){ .node = piston,
                                      .path = DAR_TRANSLATION,
                                      .axis = { 0, 1, 0 },
                                      .swing = reach,
                                      .frequency = f,
                                      .phase = phase });
        begin(m, dar_asset_paint(m, DAR_PAINT(RINGS) | DAR_PAINT(PLAID) | DAR_PAINT(GRADIENT)));
        dar_make_rotate(m, 1, 0, 0, M_PI / 2);
        dar_make_cone(m, 0.18, 0.18, 0.08);
        at(m, 0.13, 0, 0.1), dar_make_round(m, 0.04, 0.04, 0.06, 0.5, 0.5);
        spin(m, part(m, out->root, "crank", x, 0.22, 0.3), 0, 0, 1, 2 * M_PI * f);
    }
}

static void make_windmill(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    int blades = *(const int *)row;
    double height = dar_dice_in(d, 1.3, 1.8), reach = dar_dice_in(d, 0.7, 0.95);
    begin(m, dar_asset_paint(m, DAR_PAINT(BRICKS) | DAR_PAINT(STRIPES) | DAR_PAINT(PLAIN) | DAR_PAINT(CHECKER)));
    m->density = 1.2;
    dar_make_cone(m, 0.42, 0.26, height);
    m->paint = dar_asset_paint(m, 0);
    at(m, 0, height, 0), dar_make_cone(m, 0.34, 0, 0.4);
    part(m, out->root, "tower", 0, 0, 0);
    begin(m, dar_asset_paint(m, 0));
    dar_make_round(m, 0.1, 0.1, 0.14, 1, 1);
    for (int i = 0; i < blades; i++) {
        dar_make_home(m);
        dar_make_rotate(m, 0, 0, 1, 2 * M_PI * i / blades);
        dar_make_shift(m, 0.55 * reach, 0, 0);
        dar_make_rotate(m, 1, 0, 0, 0.3);
        dar_make_box(m, 0.9 * reach, 0.22, 0.03);
    }
    spin(m, part(m, out->root, "sails", 0, height - 0.05, 0.42), 0, 0, 1, dar_dice_in(d, 1, 2.5));
}

/* A wheel of cabins that hang level. */
static void make_wheel(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    int cabins = *(const int *)row, rim = dar_asset_paint(m, DAR_PAINT(STRIPES) | DAR_PAINT(SLANTED));
    double radius = dar_dice_in(d, 0.75, 0.95), rate = dar_dice_in(d, 0.6, 1.2), y = radius + 0.35;
    begin(m, dar_asset_paint(m, 0));
    for (int side = -1; side <= 1; side += 2)
        for (int leg = -1; leg <= 1; leg += 2) {
            const double way[2][4] = { { 0.6 * leg, 0.03, 0.32 * side, 0.04 }, { 0, y, 0.2 * side, 0.04 } };
            dar_make_home(m);
            dar_make_tube(m, way, 2, NULL);
        }
    part(m, out->root, "stand", 0, 0, 0);
    begin(m, rim);
    for (int side = -1; side <= 1; side += 2) {
        dar_make_home(m);
        dar_make_shift(m, 0, 0, 0.13 * side);
        dar_make_rotate(m, 1, 0, 0, M_PI / 2);
        dar_make_torus(m, radius, 0.035);
    }
    for (int i = 0; i < cabins; i++) {
        double a = 2 * M_PI * i / cabins;
        const double spoke[2][4] = { { 0, 0, 0, 0.02 }, { radius * cos(a), radius * sin(a), 0, 0.02 } };
        dar_make_home(m);
        dar_make_tube(m, spoke, 2, NULL);
    }
    int wheel = part(m, out->root, "wheel", 0, y, 0);
    spin(m, wheel, 0, 0, 1, rate);
    int paint[3];
    for (int i = 0; i < 3; i++) paint[i] = dar_asset_paint(m, 0);
    for (int i = 0; i < cabins; i++) {
        double a = 2 * M_PI * i / cabins;
        begin(m, paint[i % 3]);
        at(m, 0, -0.12, 0), dar_make_round(m, 0.13, 0.12, 0.12, 0.3, 0.5);
        int node = part(m, wheel, "cabin", radius * cos(a), radius * sin(a), 0);
        spin(m, node, 0, 0, 1, -rate);
    }
}

static void make_carousel(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    int riders = *(const int *)row;
    double radius = dar_dice_in(d, 0.7, 0.9), height = dar_dice_in(d, 1, 1.3);
    begin(m, dar_asset_paint(m, DAR_PAINT(STRIPES) | DAR_PAINT(RINGS) | DAR_PAINT(CHECKER)));
    dar_make_cone(m, radius, radius, 0.1);
    m->paint = dar_asset_paint(m, DAR_PAINT(SLANTED) | DAR_PAINT(STRIPES));
    at(m, 0, 0.1, 0), dar_make_cone(m, 0.08, 0.08, height);
    m->paint = dar_asset_paint(m, DAR_PAINT(PLAID) | DAR_PAINT(ZIGZAG) | DAR_PAINT(DOTS));
    at(m, 0, height, 0), dar_make_cone(m, 1.05 * radius, 0, 0.4);
    int top = part(m, out->root, "platform", 0, 0, 0);
    spin(m, top, 0, 1, 0, dar_dice_in(d, 0.7, 1.6));
    for (int i = 0; i < riders; i++) {
        double a = 2 * M_PI * i / riders;
        begin(m, dar_asset_paint(m, 0));
        dar_make_round(m, 0.1, 0.11, 0.2, 0.8, 0.8);
        at(m, 0, 0.14, 0.16), dar_make_round(m, 0.06, 0.14, 0.08, 1, 1);
        int node = part(m, top, "rider", 0.72 * radius * sin(a), 0.1 + 0.42 * height, 0.72 * radius * cos(a));
        dar_make_turn(m, node, 0, 1, 0, a + M_PI / 2);
        dar_make_move(m, (dar_mover){ .node = node,
                                      .path = DAR_TRANSLATION,
                                      .axis = { 0, 1, 0 },
                                      .swing = 0.12,
                                      .frequency = 0.9,
                                      .phase = (double)i / 2 });
    }
}

/* Segments one above the other, each turning about its own axis. */
static void make_arm(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    int n = *(const int *)row, dark = dar_make_plain(m, 0.15, 0.15, 0.18), paint = dar_asset_paint(m, 0);
    begin(m, dark);
    dar_make_cone(m, 0.32, 0.28, 0.16);
    int parent = part(m, out->root, "base", 0, 0, 0);
    parent = dar_make_node(m, parent, "turntable", 0, 0.16, 0);
    swing(m, parent, 0, 1, 0, dar_dice_in(d, 0.4, 0.9), dar_dice_in(d, 0.25, 0.5), dar_dice_in(d, 0, 1));
    for (int i = 0; i < n; i++) {
        double length = dar_dice_in(d, 0.45, 0.65) * (1 - 0.12 * i), thick = 0.11 - 0.015 * i;
        begin(m, paint);
        at(m, 0, length / 2, 0), dar_make_round(m, thick, length / 2 + 0.04, thick, 0.3, 0.5);
        m->paint = dark;
        at(m, 0, 0, 0), dar_make_round(m, 1.2 * thick, 1.15 * thick, 1.15 * thick, 1, 1);
        int node = part(m, parent, "segment", 0, i ? dar_dice_in(d, 0.42, 0.46) : 0.1, 0);
        dar_make_turn(m, node, 1, 0, 0, i % 2 ? 0.9 : -0.2);
        swing(m, node, 1, 0, 0, dar_dice_in(d, 0.25, 0.5), dar_dice_in(d, 0.3, 0.8), dar_dice_in(d, 0, 1));
        parent = node;
    }
    begin(m, dark);
    for (int side = -1; side <= 1; side += 2) {
        dar_make_home(m);
        dar_make_shift(m, 0.08 * side, 0.08, 0);
        dar_make_box(m, 0.04, 0.18, 0.1);
    }
    at(m, 0, 0, 0), dar_make_box(m, 0.24, 0.05, 0.12);
    spin(m, part(m, parent, "gripper", 0, 0.42, 0), 0, 1, 0, 2);
}

static void make_clock(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    double height = dar_dice_in(d, 1.3, 1.7), y = height - 0.35;
    (void)row;
    begin(m, dar_asset_paint(m, DAR_PAINT(WOOD) | DAR_PAINT(STRIPES) | DAR_PAINT(MARBLE)));
    at(m, 0, height / 2, -0.05), dar_make_box(m, 0.6, height, 0.3);
    at(m, 0, height + 0.04, -0.05), dar_make_box(m, 0.7, 0.08, 0.4);
    m->paint = dar_asset_paint(m, DAR_PAINT(RINGS) | DAR_PAINT(PLAIN) | DAR_PAINT(GRADIENT));
    at(m, 0, y, 0.1), dar_make_rotate(m, 1, 0, 0, M_PI / 2), dar_make_cone(m, 0.25, 0.25, 0.04);
    part(m, out->root, "case", 0, 0, 0);
    for (int i = 0; i < 2; i++) {
        begin(m, dar_make_plain(m, 0.08, 0.08, 0.1));
        at(m, 0, 0.08 + 0.02 * i, 0), dar_make_box(m, 0.03, 0.2 + 0.06 * i, 0.015);
        spin(m, part(m, out->root, "hand", 0, y, 0.155 + 0.02 * i), 0, 0, 1, i ? -2.5 : -0.5);
    }
    begin(m, dar_asset_paint(m, 0));
    at(m, 0, -0.3, 0), dar_make_box(m, 0.025, 0.6, 0.02);
    at(m, 0, -0.6, 0), dar_make_rotate(m, 1, 0, 0, M_PI / 2), dar_make_cone(m, 0.11, 0.11, 0.03);
    swing(m, part(m, out->root, "pendulum", 0, y - 0.3, 0.14), 0, 0, 1, 0.3, dar_dice_in(d, 0.7, 1.1), 0);
}

static void make_crane(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    double height = dar_dice_in(d, 1.6, 2.1), reach = dar_dice_in(d, 0.9, 1.2);
    int steel = dar_asset_paint(m, DAR_PAINT(SLANTED) | DAR_PAINT(PLAID) | DAR_PAINT(ZIGZAG));
    (void)row;
    begin(m, steel);
    m->density = 2;
    at(m, 0, 0.05, 0), dar_make_box(m, 0.6, 0.1, 0.6);
    at(m, 0, height / 2, 0), dar_make_box(m, 0.15, height, 0.15);
    part(m, out->root, "mast", 0, 0, 0);
    begin(m, steel);
    at(m, 0, 0, 0.35 * reach), dar_make_box(m, 0.12, 0.12, 1.4 * reach);
    m->paint = dar_asset_paint(m, 0);
    at(m, 0, -0.1, -0.3 * reach), dar_make_box(m, 0.26, 0.26, 0.2);
    int jib = part(m, out->root, "jib", 0, height, 0);
    swing(m, jib, 0, 1, 0, dar_dice_in(d, 0.5, 1), dar_dice_in(d, 0.2, 0.4), dar_dice_in(d, 0, 1));
    begin(m, dar_make_plain(m, 0.1, 0.1, 0.1));
    const double rope[2][4] = { { 0, 0, 0, 0.012 }, { 0, -0.6, 0, 0.012 } };
    dar_make_tube(m, rope, 2, NULL);
    m->paint = dar_asset_paint(m, DAR_PAINT(WOOD) | DAR_PAINT(BRICKS) | DAR_PAINT(CHECKER));
    at(m, 0, -0.75, 0), dar_make_box(m, 0.3, 0.3, 0.3);
    int load = part(m, jib, "load", 0, 0, 0.9 * reach);
    swing(m, load, 1, 0, 0, 0.15, 0.7, 0);
    dar_make_move(m, (dar_mover){ .node = load,
                                  .path = DAR_TRANSLATION,
                                  .axis = { 0, 0, 1 },
                                  .swing = 0.25 * reach,
                                  .base = -0.25 * reach,
                                  .frequency = 0.4 });
}

static const int lying = 0, upright = 1, two = 2, three = 3, four = 4, five = 5, eight = 8;

#define ROW(name, where, fn, row)                                                                                      \
    {                                                                                                                  \
        name, "mechanism", DAR_ASSET_##where, fn, row                                                                  \
    }
/* clang-format off */
const dar_asset_kind dar_asset_machines[] = {
    ROW("gears", TRAIN, make_gears, &upright), ROW("pendulums", TRAIN, make_pendulums, &three),
    ROW("pistons", TRAIN, make_pistons, &two), ROW("windmill", TRAIN, make_windmill, &four),
    ROW("carousel", TRAIN, make_carousel, &five), ROW("robot arm", TRAIN, make_arm, &two),
    ROW("ferris wheel", VIS, make_wheel, &eight), ROW("engine", VIS, make_pistons, &four),
    ROW("clock", VIS, make_clock, NULL),
    ROW("gearbox", OOD, make_gears, &lying), ROW("crane", OOD, make_crane, NULL),
    ROW("pendulum wave", OOD, make_pendulums, &five),
};
/* clang-format on */
const size_t dar_asset_machine_count = DAR_COUNT(dar_asset_machines);
