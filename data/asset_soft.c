/* asset_soft.c: things that bend: cloth and jelly as morphs between waves, worms as chains under a skin. */
#include "data/asset_inside.h"

#include <math.h>

/* ---------------------------------------------------------------- cloth */

/* The two halves of a travelling wave: y = x + amount (sin, cos)(k . x) direction, growing from the held edge. */
struct wave {
    double k[3], direction[3], amount, phase, held[4]; /* held: plane; free in proportion to the distance from it */
};

static void bend_wave(const void *ctx, const double x[3], double y[3])
{
    const struct wave *w = ctx;
    double way = w->phase, loose = w->held[3];
    for (int i = 0; i < 3; i++) way += w->k[i] * x[i], loose += w->held[i] * x[i];
    double a = w->amount * fmin(fmax(loose, 0), 1) * sin(way);
    for (int i = 0; i < 3; i++) y[i] = x[i] + a * w->direction[i];
}

/* Two targets a quarter apart, weighted by cosine and sine of time: the wave travels. */
static void make_wave(dar_maker *m, struct wave w)
{
    for (int i = 0; i < 2; i++) {
        dar_make_target(m, bend_wave, &w);
        w.phase += M_PI / 2;
    }
}

static void travel(dar_maker *m, int node, size_t target, double frequency)
{
    for (size_t i = 0; i < 2; i++)
        dar_make_move(m, (dar_mover){ .node = node,
                                      .path = DAR_WEIGHTS,
                                      .target = target + i,
                                      .swing = i ? -1 : 1,
                                      .frequency = frequency,
                                      .phase = i ? 0 : 0.25 });
}

static int cloth_paint(dar_maker *m)
{
    dar_paint_style style = dar_make_any;
    style.double_sided = true;
    return dar_make_paint(m, &style);
}

static void make_flag(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    double height = dar_dice_in(d, 1.5, 1.9), width = dar_dice_in(d, 0.9, 1.3), side = dar_dice_in(d, 0.5, 0.8);
    (void)row;
    dar_make_begin(m);
    m->paint = dar_asset_paint(m, DAR_PAINT(SLANTED) | DAR_PAINT(PLAIN) | DAR_PAINT(WOOD));
    dar_make_cone(m, 0.22, 0.1, 0.12);
    dar_make_cone(m, 0.03, 0.03, height);
    dar_make_shift(m, 0, height, 0), dar_make_round(m, 0.06, 0.06, 0.06, 1, 1);
    dar_make_show(m, dar_make_node(m, out->root, "pole", 0, 0, 0), dar_make_end(m, "pole"));
    dar_make_begin(m);
    m->paint = cloth_paint(m);
    dar_make_shift(m, 0.03 + width / 2, height - 0.02 - side / 2, 0);
    dar_make_rotate(m, 1, 0, 0, M_PI / 2);
    dar_make_plate(m, width, side, 20);
    make_wave(m, (struct wave){ .k = { dar_dice_in(d, 5, 8), dar_dice_in(d, -1.5, 1.5), 0 },
                                .direction = { 0, 0, 1 },
                                .amount = dar_dice_in(d, 0.12, 0.2),
                                .held = { 1.2, 0, 0, -0.03 } });
    int flag = dar_make_node(m, out->root, "flag", 0, 0, 0);
    dar_make_show(m, flag, dar_make_end(m, "flag"));
    travel(m, flag, 0, dar_dice_in(d, 0.8, 1.6));
}

/* A sheet on a line, or floating. */
static void make_sheet(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    bool hung = row != NULL;
    double width = dar_dice_in(d, 1, 1.5), height = dar_dice_in(d, 0.9, 1.2), top = hung ? 1.4 : 0.5;
    if (hung) {
        dar_make_begin(m);
        m->paint = dar_asset_paint(m, DAR_PAINT(WOOD) | DAR_PAINT(PLAIN));
        for (int side = -1; side <= 1; side += 2) {
            dar_make_home(m);
            dar_make_shift(m, side * (width / 2 + 0.06), 0, 0);
            dar_make_cone(m, 0.05, 0.04, top + 0.1);
        }
        dar_make_show(m, dar_make_node(m, out->root, "posts", 0, 0, 0), dar_make_end(m, "posts"));
    }
    dar_make_begin(m);
    m->paint = cloth_paint(m);
    if (hung) {
        dar_make_shift(m, 0, top - height / 2, 0);
        dar_make_rotate(m, 1, 0, 0, M_PI / 2);
    } else {
        dar_make_shift(m, 0, top, 0);
    }
    dar_make_plate(m, width, height, 22);
    for (int i = 0; i < 2; i++) {
        struct wave w = { .k = { dar_dice_in(d, 3, 6) * (i ? -1 : 1), 0, 0 }, .amount = dar_dice_in(d, 0.06, 0.13) };
        w.k[hung ? 1 : 2] = dar_dice_in(d, -4, 4);
        w.direction[hung ? 2 : 1] = 1;
        if (hung) w.held[1] = -1, w.held[3] = top;
        else w.held[3] = 1;
        make_wave(m, w);
    }
    int sheet = dar_make_node(m, out->root, "sheet", 0, 0, 0);
    dar_make_show(m, sheet, dar_make_end(m, "sheet"));
    travel(m, sheet, 0, dar_dice_in(d, 0.5, 1.1));
    travel(m, sheet, 2, dar_dice_in(d, 0.4, 0.9));
}

/* ---------------------------------------------------------------- jelly */

static void bend_twist(const void *ctx, const double x[3], double y[3])
{
    const double *amount = ctx;
    double a = amount[0] * x[1], c = cos(a), s = sin(a);
    y[0] = c * x[0] + s * x[2];
    y[1] = x[1];
    y[2] = c * x[2] - s * x[0];
}

static void bend_lean(const void *ctx, const double x[3], double y[3])
{
    const double *amount = ctx;
    y[0] = x[0] + amount[0] * x[1] * x[1];
    y[1] = x[1];
    y[2] = x[2] + amount[1] * x[1] * x[1];
}

static void bend_squash(const void *ctx, const double x[3], double y[3])
{
    const double *amount = ctx;
    double wide = 1 / sqrt(1 - amount[0]);
    y[0] = wide * x[0];
    y[1] = (1 - amount[0]) * x[1];
    y[2] = wide * x[2];
}

static void make_jelly(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    double r = dar_dice_in(d, 0.35, 0.5), twist = dar_dice_in(d, 0.8, 1.6), lean[2], squash = dar_dice_in(d, 0.2, 0.35);
    bool tall = row != NULL;
    dar_make_begin(m);
    m->density = dar_dice_in(d, 0.6, 1.4);
    m->paint = dar_asset_paint(m, 0);
    if (tall) {
        double profile[9][2];
        for (int i = 0; i < 9; i++) {
            profile[i][0] = i == 8 ? 0 : r * (0.75 + 0.2 * sin(i * dar_dice_in(d, 0.9, 1.5)));
            profile[i][1] = 0.17 * i;
        }
        dar_make_lathe(m, (const double(*)[2])profile, 9);
    } else {
        dar_make_shift(m, 0, r, 0);
        dar_make_round(m, r, r, r, dar_dice_in(d, 0.4, 1), dar_dice_in(d, 0.4, 1));
        dar_make_shift(m, 0, 1.25 * r, 0);
        m->paint = dar_asset_paint(m, 0);
        dar_make_round(m, 0.55 * r, 0.5 * r, 0.55 * r, 0.7, 0.7);
    }
    for (int i = 0; i < 2; i++) lean[i] = dar_dice_in(d, -0.35, 0.35);
    dar_make_target(m, bend_twist, &twist);
    dar_make_target(m, bend_lean, lean);
    dar_make_target(m, bend_squash, &squash);
    int node = dar_make_node(m, out->root, "jelly", 0, 0, 0);
    dar_make_show(m, node, dar_make_end(m, "jelly"));
    for (size_t i = 0; i < 3; i++)
        dar_make_move(m, (dar_mover){ .node = node,
                                      .path = DAR_WEIGHTS,
                                      .target = i,
                                      .swing = i < 2 ? 0.8 : 0.5,
                                      .base = i < 2 ? 0 : 0.4,
                                      .frequency = dar_dice_in(d, 0.5, 1.3),
                                      .phase = dar_dice_in(d, 0, 1) });
}

/* ---------------------------------------------------------------- chains */

enum { LINKS = 8 };

/* A tube over links along y or z; each turns against the one before, a wave from end to end.  Returns the node of the
 * first link; those of the others follow it. */
static int make_chain(dar_maker *m, dar_dice *d, int root, const double from[3], const double step[3], double thick,
                      double swing, double phase)
{
    int joint[LINKS];
    double spine[LINKS][4], f = dar_dice_in(d, 0.6, 1.2);
    bool level = fabs(step[1]) < fabs(step[2]);
    for (int i = 0; i < LINKS; i++) {
        const double *x = i ? step : from;
        joint[i] = dar_make_node(m, i ? joint[i - 1] : root, "link", x[0], x[1], x[2]);
        for (int k = 0; k < 3; k++) spine[i][k] = from[k] + i * step[k];
        spine[i][3] = thick * (i < 2 ? 0.85 + 0.1 * i : 1.05 - 0.11 * i);
        dar_make_move(m, (dar_mover){ .node = joint[i],
                                      .path = DAR_ROTATION,
                                      .axis = { 0, level, !level },
                                      .swing = i ? swing : 0.3 * swing,
                                      .frequency = f,
                                      .phase = phase - 0.13 * i });
    }
    static const int carries[LINKS] = { 0, 1, 2, 3, 4, 5, 6, 7 };
    dar_make_begin(m);
    m->density = 1.5;
    m->paint = dar_asset_paint(m, 0);
    dar_make_tube(m, (const double(*)[4])spine, LINKS, carries);
    if (level) {
        m->paint = dar_make_plain(m, 0.08, 0.08, 0.1);
        m->joint = 0;
        for (int side = -1; side <= 1; side += 2) {
            dar_make_home(m);
            dar_make_shift(m, from[0] + 0.55 * side * thick, from[1] + 0.6 * thick, from[2] + 0.5 * thick);
            dar_make_round(m, 0.22 * thick, 0.22 * thick, 0.22 * thick, 1, 1);
        }
    }
    int mesh = dar_make_end(m, "chain"), node = dar_make_node(m, root, "chain", 0, 0, 0);
    /* The skin's node has no part in where it is: the joints below the root have. */
    dar_make_skin(m, node, mesh, joint, LINKS);
    return joint[0];
}

/* A flat ellipsoid that a link carries; half: its axes. */
static void add_fin(dar_maker *m, int link, const double at[3], const double half[3], double turn)
{
    int node = dar_make_node(m, link, "fin", at[0], at[1], at[2]);
    dar_make_begin(m);
    dar_make_rotate(m, 1, 0, 0, turn);
    dar_make_round(m, half[0], half[1], half[2], 1, 1);
    dar_make_show(m, node, dar_make_end(m, "fin"));
}

/* Tail, back and sides of a fish. */
static void add_fins(dar_maker *m, int first, double thick)
{
    const double flat = 0.1 * thick, tail[3] = { flat, 0.4 * thick, 0.9 * thick },
                 back[3] = { flat, thick, 0.6 * thick };
    m->paint = dar_asset_paint(m, 0);
    for (int up = -1; up <= 1; up += 2)
        add_fin(m, first + LINKS - 1, (const double[]){ 0, 0.45 * up * thick, -0.55 * thick }, tail, 0.8 * up);
    add_fin(m, first + 3, (const double[]){ 0, 0.75 * thick, 0 }, back, -0.6);
    for (int side = -1; side <= 1; side += 2)
        add_fin(m, first + 2, (const double[]){ 1.15 * side * thick, -0.3 * thick, 0 },
                (const double[]){ 0.7 * thick, flat, 0.4 * thick }, 0.3);
}

static void make_snake(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    bool swims = row != NULL;
    double length = dar_dice_in(d, 1.3, 1.9), thick = swims ? 0.17 : dar_dice_in(d, 0.08, 0.13);
    double step[3] = { 0, 0, -length / LINKS }, from[3] = { 0, thick, length / 2 };
    int first = make_chain(m, d, out->root, from, step, thick, swims ? 0.18 : 0.38, 0);
    if (swims) add_fins(m, first, thick);
    out->way = swims ? DAR_ASSET_FLIES : DAR_ASSET_WALKS;
    out->height = swims ? dar_dice_in(d, 0.4, 0.9) : 0;
    out->speed = dar_dice_in(d, 0.4, 0.8);
}

static void make_weeds(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    int n = *(const int *)row;
    for (int i = 0; i < n; i++) {
        double a = 2 * M_PI * i / n + dar_dice_in(d, -0.3, 0.3), r = n > 1 ? dar_dice_in(d, 0.12, 0.22) : 0;
        double from[3] = { r * sin(a), 0, r * cos(a) }, step[3] = { 0, dar_dice_in(d, 0.13, 0.2), 0 };
        make_chain(m, d, out->root, from, step, n > 1 ? 0.07 : 0.16, 0.16, dar_dice_in(d, 0, 1));
    }
}

static void make_jellyfish(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    double r = dar_dice_in(d, 0.35, 0.5), squash = 0.35;
    (void)row;
    for (int i = 0; i < 4; i++) {
        double a = M_PI / 2 * i + 0.4, from[3] = { 0.5 * r * sin(a), 0.95, 0.5 * r * cos(a) },
               step[3] = { 0, -0.11, 0 };
        make_chain(m, d, out->root, from, step, 0.045, 0.2, 0.25 * i);
    }
    dar_make_begin(m);
    m->paint = dar_asset_paint(m, 0);
    dar_make_round(m, r, 0.7 * r, r, 0.9, 1);
    dar_make_target(m, bend_squash, &squash);
    int bell = dar_make_node(m, out->root, "bell", 0, 1, 0);
    dar_make_show(m, bell, dar_make_end(m, "bell"));
    dar_make_move(m, (dar_mover){ .node = bell, .path = DAR_WEIGHTS, .base = 0.5, .swing = 0.5, .frequency = 0.9 });
    out->way = DAR_ASSET_FLIES;
    out->height = 0.3;
    out->speed = 0.4;
}

static const int one = 1, several = 5;

#define ROW(name, family, where, fn, row)                                                                              \
    {                                                                                                                  \
        name, family, DAR_ASSET_##where, fn, row                                                                       \
    }
/* clang-format off */
const dar_asset_kind dar_asset_softs[] = {
    ROW("flag", "cloth", TRAIN, make_flag, NULL), ROW("washing", "cloth", VIS, make_sheet, &one),
    ROW("floating sheet", "cloth", OOD, make_sheet, NULL),
    ROW("jelly", "soft", TRAIN, make_jelly, NULL), ROW("twisting tower", "soft", VIS, make_jelly, &one),
    ROW("snake", "chain", TRAIN, make_snake, NULL), ROW("fish", "chain", VIS, make_snake, &one),
    ROW("weeds", "chain", TRAIN, make_weeds, &several), ROW("tentacle", "chain", OOD, make_weeds, &one),
    ROW("jellyfish", "chain", OOD, make_jellyfish, NULL),
};
/* clang-format on */
const size_t dar_asset_soft_count = DAR_COUNT(dar_asset_softs);
