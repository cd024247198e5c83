/* asset_vehicle.c: things on wheels, and in the air. */
#include "data/asset_inside.h"

#include <math.h>

typedef struct vehicle {
    double length, width, hull; /* of the lower body [m] */
    double cabin[3];            /* length, height, place of its middle along the body, in lengths */
    double soft;                /* exponent of the shapes: 0.15 boxes, 1 ellipsoids */
    int axles;
    double wheel, rear; /* radius of the wheels, factor of the rear ones */
    double box[2];      /* a load: length, height; 0: none */
    double chimney, rotor, wings, turret, tail;
    double speed, height;
} vehicle;

static void hull_part(dar_maker *m, const double at[3], const double size[3], double soft, int paint)
{
    m->paint = paint;
    dar_make_home(m);
    dar_make_shift(m, at[0], at[1], at[2]);
    dar_make_round(m, size[0] / 2, size[1] / 2, size[2] / 2, soft, soft);
}

static void add_wheels(dar_maker *m, const vehicle *k, int root, int dark)
{
    int rim = dar_asset_paint(m, DAR_PAINT(PLAID) | DAR_PAINT(CHECKER) | DAR_PAINT(STRIPES));
    for (int i = 0; i < k->axles; i++) {
        double share = k->axles > 1 ? (double)i / (k->axles - 1) : 0.5,
               r = k->wheel * (1 + (k->rear - 1) * (1 - share));
        double z = (share - 0.5) * (k->length - 2.4 * r);
        dar_make_begin(m);
        m->density = 2;
        for (int side = -1; side <= 1; side += 2) {
            dar_make_home(m);
            dar_make_shift(m, side * 0.5 * k->width, 0, 0);
            dar_make_rotate(m, 0, 0, 1, -side * M_PI / 2);
            m->paint = dark;
            dar_make_torus(m, 0.72 * r, 0.28 * r);
            m->paint = rim;
            dar_make_shift(m, 0, -0.16 * r, 0);
            dar_make_cone(m, 0.62 * r, 0.5 * r, 0.3 * r);
        }
        int node = dar_make_node(m, root, "axle", 0, r, z);
        dar_make_show(m, node, dar_make_end(m, "wheels"));
        dar_make_move(m, (dar_mover){ .node = node, .path = DAR_ROTATION, .axis = { 1, 0, 0 }, .rate = k->speed / r });
    }
}

/* Blades about an axis, turning. */
static void add_rotor(dar_maker *m, dar_dice *d, int root, const double at[3], bool lying, double radius)
{
    int blades = 2 + (int)dar_dice_below(d, 3);
    dar_make_begin(m);
    m->paint = dar_asset_paint(m, DAR_PAINT(STRIPES) | DAR_PAINT(PLAIN));
    dar_make_round(m, 0.1 * radius, 0.1 * radius, 0.1 * radius, 1, 1);
    for (int i = 0; i < blades; i++) {
        dar_make_home(m);
        if (lying) dar_make_rotate(m, 0, 1, 0, 2 * M_PI * i / blades);
        else dar_make_rotate(m, 0, 0, 1, 2 * M_PI * i / blades);
        dar_make_shift(m, 0.5 * radius, 0, 0);
        if (lying) dar_make_round(m, 0.5 * radius, 0.02 * radius, 0.08 * radius, 0.4, 0.4);
        else dar_make_round(m, 0.5 * radius, 0.08 * radius, 0.02 * radius, 0.4, 0.4);
    }
    int node = dar_make_node(m, root, "rotor", at[0], at[1], at[2]);
    dar_make_show(m, node, dar_make_end(m, "rotor"));
    dar_make_move(
        m,
        (dar_mover){ .node = node, .path = DAR_ROTATION, .axis = { 0, lying, !lying }, .rate = dar_dice_in(d, 4, 9) });
}

static void add_turret(dar_maker *m, dar_dice *d, const vehicle *k, int root, double y, int paint, int dark)
{
    dar_make_begin(m);
    m->paint = paint;
    dar_make_round(m, 0.36 * k->width, 0.5 * k->turret, 0.4 * k->width, 0.4, 0.6);
    const double barrel[2][4] = { { 0, 0.1 * k->turret, 0.3 * k->width, 0.07 },
                                  { 0, 0.3 * k->turret, 0.62 * k->length, 0.06 } };
    m->paint = dark;
    dar_make_tube(m, barrel, 2, NULL);
    int node = dar_make_node(m, root, "turret", 0, y + 0.4 * k->turret, 0);
    dar_make_show(m, node, dar_make_end(m, "turret"));
    dar_make_move(m, (dar_mover){ .node = node,
                                  .path = DAR_ROTATION,
                                  .axis = { 0, 1, 0 },
                                  .swing = dar_dice_in(d, 0.3, 0.7),
                                  .frequency = dar_dice_in(d, 0.2, 0.5),
                                  .phase = dar_dice_in(d, 0, 1) });
}

static void add_wings(dar_maker *m, const vehicle *k, double y, int paint)
{
    hull_part(m, (const double[]){ 0, y, 0.06 * k->length }, (const double[]){ k->wings, 0.05, 0.22 * k->length }, 0.5,
              paint);
    hull_part(m, (const double[]){ 0, y + 0.1, -0.46 * k->length },
              (const double[]){ 0.36 * k->wings, 0.04, 0.12 * k->length }, 0.5, paint);
    hull_part(m, (const double[]){ 0, y + 0.25, -0.46 * k->length }, (const double[]){ 0.04, 0.5, 0.13 * k->length },
              0.5, paint);
}

static void make_vehicle(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    vehicle k = *(const vehicle *)row;
    k.length = dar_dice_near(d, k.length, 0.15), k.width = dar_dice_near(d, k.width, 0.12);
    k.hull = dar_dice_near(d, k.hull, 0.15), k.wheel = dar_dice_near(d, k.wheel, 0.12);
    k.cabin[1] = dar_dice_near(d, k.cabin[1], 0.2), k.speed = dar_dice_near(d, k.speed, 0.4);
    int paint = dar_asset_paint(m, 0), second = dar_asset_paint(m, 0), dark = dar_make_plain(m, 0.1, 0.1, 0.12);
    int glass = dar_make_plain(m, 0.25, 0.35, 0.45), light = dar_make_plain(m, 0.95, 0.9, 0.7);
    double low = k.axles ? 0.7 * k.wheel : 0, y = low + k.hull / 2, top = low + k.hull, z = k.cabin[2] * k.length;
    dar_make_begin(m);
    m->density = dar_dice_in(d, 0.6, 1.6);
    hull_part(m, (const double[]){ 0, y, 0 }, (const double[]){ 0.94 * k.width, k.hull, k.length }, k.soft, paint);
    if (k.cabin[1] > 0) {
        const double size[3] = { 0.8 * k.width, 1.2 * k.cabin[1], k.cabin[0] };
        hull_part(m, (const double[]){ 0, top + 0.4 * k.cabin[1], z }, size, k.soft, glass);
        hull_part(m, (const double[]){ 0, top + 0.95 * k.cabin[1], z },
                  (const double[]){ 0.84 * k.width, 0.15 * k.cabin[1], 0.9 * k.cabin[0] }, 0.4, paint);
    }
    if (k.box[0] > 0)
        hull_part(m, (const double[]){ 0, top + 0.5 * k.box[1], z - 0.5 * k.cabin[0] - 0.52 * k.box[0] },
                  (const double[]){ k.width, k.box[1], k.box[0] }, 0.1, second);
    for (int side = -1; side <= 1 && k.axles; side += 2)
        hull_part(m, (const double[]){ side * 0.33 * k.width, y + 0.1 * k.hull, 0.485 * k.length },
                  (const double[]){ 0.18 * k.width, 0.25 * k.hull, 0.05 * k.length }, 1, light);
    if (k.chimney > 0) {
        m->paint = dark;
        dar_make_home(m);
        dar_make_shift(m, 0, top - 0.05, 0.32 * k.length);
        dar_make_cone(m, 0.08, 0.14, k.chimney);
    }
    if (k.wings > 0) add_wings(m, &k, y, second);
    if (k.tail > 0)
        hull_part(m, (const double[]){ 0, y + 0.15 * k.hull, -0.5 * k.length - 0.4 * k.tail },
                  (const double[]){ 0.14 * k.width, 0.2 * k.hull, k.tail }, 0.5, second);
    dar_make_show(m, dar_make_node(m, out->root, "hull", 0, 0, 0), dar_make_end(m, "hull"));
    if (k.axles) add_wheels(m, &k, out->root, dark);
    if (k.turret > 0) add_turret(m, d, &k, out->root, top, second, dark);
    if (k.rotor > 0 && k.wings > 0)
        add_rotor(m, d, out->root, (const double[]){ 0, y, 0.52 * k.length }, false, k.rotor);
    else if (k.rotor > 0) add_rotor(m, d, out->root, (const double[]){ 0, top + k.cabin[1] + 0.1, 0 }, true, k.rotor);
    out->way = k.height > 0 ? DAR_ASSET_FLIES : DAR_ASSET_WALKS;
    out->speed = k.speed;
    out->height = k.height > 0 ? dar_dice_near(d, k.height, 0.4) : 0;
}

/* length, width, hull; cabin; soft; axles, wheel, rear; box; chimney, rotor, wings, turret, tail; speed, height */
/* clang-format off */
static const vehicle
    car = { 1.7, 0.8, 0.34, { 0.85, 0.3, -0.04 }, 0.4, 2, 0.2, 1, { 0, 0 }, 0, 0, 0, 0, 0, 1.2, 0 },
    truck = { 2.2, 0.85, 0.3, { 0.5, 0.6, 0.34 }, 0.25, 3, 0.2, 1, { 1.35, 0.85 }, 0, 0, 0, 0, 0, 1, 0 },
    racer = { 1.9, 0.8, 0.2, { 0.5, 0.2, -0.1 }, 0.7, 2, 0.2, 1.3, { 0, 0 }, 0, 0, 0, 0, 0.12, 1.8, 0 },
    tractor = { 1.3, 0.6, 0.4, { 0.5, 0.55, -0.18 }, 0.3, 2, 0.22, 1.9, { 0, 0 }, 0.5, 0, 0, 0, 0, 0.8, 0 },
    bus = { 2.4, 0.8, 0.4, { 2.2, 0.55, 0 }, 0.15, 2, 0.19, 1, { 0, 0 }, 0, 0, 0, 0, 0, 1, 0 },
    train = { 1.9, 0.65, 0.45, { 0.6, 0.5, -0.3 }, 0.35, 4, 0.17, 1, { 0, 0 }, 0.55, 0, 0, 0, 0, 1, 0 },
    tank = { 1.7, 1, 0.36, { 0, 0, 0 }, 0.3, 5, 0.16, 1, { 0, 0 }, 0, 0, 0, 0.34, 0, 0.6, 0 },
    buggy = { 1.3, 0.75, 0.22, { 0.5, 0.4, -0.1 }, 0.8, 2, 0.27, 1.1, { 0, 0 }, 0, 0, 0, 0, 0, 1.3, 0 },
    cart = { 1.1, 0.7, 0.4, { 0, 0, 0 }, 0.12, 1, 0.32, 1, { 0, 0 }, 0, 0, 0, 0, 0, 0.8, 0 },
    plane = { 1.7, 0.34, 0.36, { 0.45, 0.2, 0.1 }, 0.8, 0, 0.1, 1, { 0, 0 }, 0, 0.35, 2, 0, 0, 1.6, 1.2 },
    helicopter = { 1.1, 0.6, 0.6, { 0.5, 0.1, 0 }, 0.9, 0, 0.1, 1, { 0, 0 }, 0, 0.95, 0, 0, 0.9, 1, 1 },
    saucer = { 1.3, 1.3, 0.3, { 0.6, 0.35, 0 }, 1, 0, 0.1, 1, { 0, 0 }, 0, 0, 0, 0, 0, 0.9, 0.9 };

#define ROW(kind, where) { #kind, "vehicle", DAR_ASSET_##where, make_vehicle, &kind }
const dar_asset_kind dar_asset_vehicles[] = {
    ROW(car, TRAIN), ROW(truck, TRAIN), ROW(tractor, TRAIN), ROW(plane, TRAIN), ROW(buggy, TRAIN),
    ROW(racer, VIS), ROW(bus, VIS), ROW(helicopter, VIS),
    ROW(train, OOD), ROW(tank, OOD), ROW(saucer, OOD), ROW(cart, OOD),
};
/* clang-format on */
const size_t dar_asset_vehicle_count = DAR_COUNT(dar_asset_vehicles);
