/* asset_interior.c: rooms seen as in a doll's house: walls are there from the inside alone. */
#include "data/asset_inside.h"

#include <math.h>

struct interior {
    int walls; /* 2: a corner; 3 */
    bool work; /* machines instead of furniture */
};

static void box(dar_maker *m, double x, double y, double z, double sx, double sy, double sz)
{
    dar_make_home(m);
    dar_make_shift(m, x, y + sy / 2, z);
    dar_make_box(m, sx, sy, sz);
}

static int part(dar_maker *m, int parent, const char *name, double x, double y, double z)
{
    int node = dar_make_node(m, parent, name, x, y, z);
    dar_make_show(m, node, dar_make_end(m, name));
    return node;
}

static void swing(dar_maker *m, dar_dice *d, int node, double x, double y, double z, double amount)
{
    dar_make_move(m, (dar_mover){ .node = node,
                                  .path = DAR_ROTATION,
                                  .axis = { x, y, z },
                                  .swing = amount,
                                  .frequency = dar_dice_in(d, 0.5, 1),
                                  .phase = dar_dice_in(d, 0, 1) });
}

static void add_walls(dar_maker *m, int root, const struct interior *k, double w, double h)
{
    dar_make_begin(m);
    m->density = 0.7;
    m->paint = dar_asset_paint(m, DAR_PAINT(WOOD) | DAR_PAINT(TILES) | DAR_PAINT(CHECKER) | DAR_PAINT(PLAID));
    dar_make_shift(m, 0, 0.002, 0);
    dar_make_plate(m, w, w, 1);
    m->paint = dar_asset_paint(m, DAR_PAINT(STRIPES) | DAR_PAINT(PLAIN) | DAR_PAINT(DOTS) | DAR_PAINT(BRICKS));
    for (int i = 0; i < k->walls; i++) {
        dar_make_home(m);
        dar_make_rotate(m, 0, 1, 0, M_PI / 2 * i);
        dar_make_shift(m, 0, h / 2, -w / 2);
        dar_make_rotate(m, 1, 0, 0, M_PI / 2);
        dar_make_plate(m, w, h, 1);
    }
    part(m, root, "room", 0, 0, 0);
}

static void add_furniture(dar_maker *m, dar_dice *d, int root, double w)
{
    double x = dar_dice_in(d, 0.1, 0.4), z = dar_dice_in(d, -0.1, 0.3);
    dar_make_begin(m);
    m->density = 1.2;
    m->paint = dar_asset_paint(m, DAR_PAINT(WOOD) | DAR_PAINT(PLAIN) | DAR_PAINT(MARBLE));
    box(m, x, 0.5, z, 0.9, 0.06, 0.6);
    for (int i = 0; i < 4; i++) box(m, x + (i & 1 ? 0.4 : -0.4), 0, z + (i & 2 ? 0.25 : -0.25), 0.06, 0.5, 0.06);
    box(m, -0.4 * w, 0, 0.1 * w, 0.3, 1.2, 0.8);
    m->paint = dar_asset_paint(m, 0);
    box(m, -0.05 * w, 0, -0.4 * w, 1.2, 0.35, 0.5);
    box(m, -0.05 * w, 0.35, -0.46 * w, 1.2, 0.4, 0.15);
    m->paint = dar_asset_paint(m, DAR_PAINT(RINGS) | DAR_PAINT(PLAID) | DAR_PAINT(ZIGZAG));
    dar_make_home(m);
    dar_make_shift(m, x, 0.006, z);
    dar_make_disc(m, 0.75);
    m->paint = dar_asset_paint(m, 0);
    dar_make_home(m);
    dar_make_shift(m, x, 0.56, z);
    dar_make_lathe(m, (const double[][2]){ { 0, 0 }, { 0.09, 0 }, { 0.14, 0.12 }, { 0.05, 0.24 }, { 0.08, 0.3 } }, 5);
    part(m, root, "furniture", 0, 0, 0);

    dar_make_begin(m);
    m->paint = dar_asset_paint(m, DAR_PAINT(WOOD) | DAR_PAINT(PLAIN));
    box(m, 0, 0.35, 0, 0.45, 0.05, 0.45);
    box(m, 0, 0.4, -0.2, 0.45, 0.5, 0.05);
    for (int side = -1; side <= 1; side += 2) box(m, 0.18 * side, 0, 0, 0.04, 0.35, 0.4);
    int chair = part(m, root, "rocking chair", x - 0.1, 0.03, z + 0.75);
    dar_make_turn(m, chair, 0, 1, 0, dar_dice_in(d, 2, 4));
    swing(m, d, chair, 1, 0, 0, 0.16);
}

static void add_benches(dar_maker *m, dar_dice *d, int root, double w)
{
    for (int i = 0; i < 3; i++) {
        double x = (i - 1) * 0.3 * w, z = -0.3 * w, teeth = 9 + (double)dar_dice_below(d, 5);
        dar_make_begin(m);
        m->paint = dar_asset_paint(m, 0);
        box(m, 0, 0, 0, 0.6, 0.5, 0.5);
        box(m, 0, 0.5, -0.15, 0.5, 0.5, 0.12);
        part(m, root, "bench", x, 0, z);
        dar_make_begin(m);
        m->density = 2;
        m->paint = dar_asset_paint(m, 0);
        dar_make_gear(m, (size_t)teeth, 0.2, 0.06, 0.08);
        int wheel = part(m, root, "wheel", x, 0.78, z);
        dar_make_move(m, (dar_mover){ .node = wheel,
                                      .path = DAR_ROTATION,
                                      .axis = { 0, 0, 1 },
                                      .rate = dar_dice_in(d, 1, 3) * (i & 1 ? -1 : 1) });
    }
    for (int i = 0; i < 3; i++) {
        dar_make_begin(m);
        m->paint = dar_asset_paint(m, DAR_PAINT(WOOD) | DAR_PAINT(SLANTED) | DAR_PAINT(PLAIN));
        box(m, 0, 0, 0, 0.32, 0.32, 0.32);
        int crate = part(m, root, "crate", (i - 1) * 0.6, 0.02, 0.25 * w);
        dar_make_move(
            m,
            (dar_mover){ .node = crate, .path = DAR_TRANSLATION, .axis = { 1, 0, 0 }, .swing = 0.2, .frequency = 0.6 });
    }
}

static void make_interior(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    const struct interior *k = row;
    double w = dar_dice_in(d, 2.6, 3.4), h = dar_dice_in(d, 1.7, 2.1), cord = dar_dice_in(d, 0.4, 0.6);
    add_walls(m, out->root, k, w, h);
    if (k->work) add_benches(m, d, out->root, w);
    else add_furniture(m, d, out->root, w);

    dar_make_begin(m);
    m->paint = dar_make_plain(m, 0.15, 0.15, 0.15);
    dar_make_shift(m, 0, -cord, 0);
    dar_make_cone(m, 0.012, 0.012, cord);
    m->paint = dar_asset_paint(m, 0);
    dar_make_shift(m, 0, -0.2, 0);
    dar_make_cone(m, 0.24, 0.06, 0.22);
    swing(m, d, part(m, out->root, "lamp", 0.1 * w, h, 0.05 * w), 1, 0, 0.4, 0.3);

    dar_make_begin(m);
    m->paint = dar_asset_paint(m, DAR_PAINT(WOOD) | DAR_PAINT(STRIPES));
    dar_make_cone(m, 0.06, 0.06, 0.25);
    for (int i = 0; i < 4; i++) {
        dar_make_home(m);
        dar_make_rotate(m, 0, 1, 0, M_PI / 2 * i);
        dar_make_shift(m, 0.36, 0.04, 0);
        dar_make_rotate(m, 1, 0, 0, 0.2);
        dar_make_box(m, 0.55, 0.02, 0.13);
    }
    int fan = part(m, out->root, "fan", -0.2 * w, h - 0.1, -0.1 * w);
    dar_make_move(m,
                  (dar_mover){ .node = fan, .path = DAR_ROTATION, .axis = { 0, 1, 0 }, .rate = dar_dice_in(d, 2, 5) });
}

static const struct interior workshop = { 3, true }, study = { 2, false }, parlour = { 3, false };

const dar_asset_kind dar_asset_interiors[] = {
    { "workshop", "interior", DAR_ASSET_TRAIN, make_interior, &workshop },
    { "study", "interior", DAR_ASSET_TRAIN, make_interior, &study },
    { "parlour", "interior", DAR_ASSET_VIS, make_interior, &parlour },
};
const size_t dar_asset_interior_count = DAR_COUNT(dar_asset_interiors);
