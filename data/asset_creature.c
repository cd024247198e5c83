/* asset_creature.c: what has a spine and limbs: one skin over a skeleton, walking in place.
 *
 * The spine goes forward (+z) from the hip and rises by `pitch`.  Legs swing from the hip, bend at the knee; opposite
 * ones move in turn, as in a trot. */
#include "data/asset_inside.h"

#include <math.h>

typedef struct creature {
    int pairs;                 /* of legs */
    double body, girth, pitch; /* length, radius [m]; of the spine [degrees] */
    double leg, thick, splay;  /* length, radius; how far the knees are outside, in leg lengths */
    double neck, nod, head;    /* length [m], its pitch [degrees], radius of the head */
    double snout, ears, tail;  /* lengths [m] */
    double arm, wing;          /* lengths [m] */
    double step, tempo;        /* swing of the legs [rad], cycles [1/s] */
    double height;             /* > 0: flies */
    unsigned coat;             /* patterns; 0: any */
} creature;

#define FASTEST 1.3 /* [m/s] */

/* The skeleton as it grows. */
struct body {
    dar_maker *m;
    dar_dice *d;
    const creature *k;
    int root, joint[48];
    double at[48][3]; /* of the joints */
    size_t joints;
    int skin, limb, dark; /* paints */
};

static int add_joint(struct body *b, int parent, const char *name, double x, double y, double z)
{
    size_t i = b->joints++;
    double from[3] = { 0, 0, 0 };
    for (int k = 0; k < 3 && parent >= 0; k++) from[k] = b->at[parent][k];
    b->at[i][0] = x, b->at[i][1] = y, b->at[i][2] = z;
    b->joint[i] =
        dar_make_node(b->m, parent < 0 ? b->root : b->joint[parent], name, x - from[0], y - from[1], z - from[2]);
    return (int)i;
}

static void swing(struct body *b, int joint, const double axis[3], double base, double amount, double phase)
{
    dar_make_move(b->m, (dar_mover){ .node = b->joint[joint],
                                     .path = DAR_ROTATION,
                                     .axis = { axis[0], axis[1], axis[2] },
                                     .base = base,
                                     .swing = amount,
                                     .frequency = b->k->tempo,
                                     .phase = phase });
}

static const double X[3] = { 1, 0, 0 }, Y[3] = { 0, 1, 0 }, Z[3] = { 0, 0, 1 };

/* A round thing carried by one joint, about a place relative to it. */
static void add_round(struct body *b, int joint, const double at[3], double x, double y, double z, int paint)
{
    b->m->paint = paint;
    b->m->joint = joint;
    dar_make_home(b->m);
    dar_make_shift(b->m, b->at[joint][0] + at[0], b->at[joint][1] + at[1], b->at[joint][2] + at[2]);
    dar_make_round(b->m, x, y, z, 1, 1);
}

/* A tube through joints, which carry it; radius [n], the end `over` beyond the last joint. */
static void add_limb(struct body *b, const int *joint, size_t n, const double *radius, int paint)
{
    double spine[8][4] = { 0 };
    for (size_t i = 0; i < n; i++) {
        for (int k = 0; k < 3; k++) spine[i][k] = b->at[joint[i]][k];
        spine[i][3] = radius[i];
    }
    b->m->paint = paint;
    dar_make_home(b->m);
    dar_make_tube(b->m, (const double(*)[4])spine, n, joint);
}

/* ---------------------------------------------------------------- parts */

static void add_leg(struct body *b, int hip, int side, double phase)
{
    const creature *k = b->k;
    double r = k->girth, y = b->at[hip][1], z = b->at[hip][2], x = side * r * 0.62, out = side * k->splay * k->leg;
    double rise = k->splay > 0.2 ? 0.35 * k->leg : 0, middle = k->splay > 0.2 ? y + rise : 0.52 * y;
    int thigh = add_joint(b, hip, "thigh", x, y - (rise > 0 ? 0 : 0.3 * r), z);
    int knee = add_joint(b, thigh, "knee", x + 0.6 * out, middle, z + 0.02 * k->leg);
    int foot = add_joint(b, knee, "foot", x + out, 0.6 * k->thick, z - 0.02 * k->leg);
    add_limb(b, (const int[]){ thigh, knee, foot }, 3, (const double[]){ 1.25 * k->thick, k->thick, 0.7 * k->thick },
             b->limb);
    add_round(b, foot, (const double[]){ 0, -0.1 * k->thick, 0.8 * k->thick }, 0.85 * k->thick, 0.5 * k->thick,
              1.6 * k->thick, b->dark);
    if (rise > 0) {
        swing(b, thigh, Y, 0, side * k->step, phase);
        swing(b, thigh, Z, 0.5 * side * k->step, 0.5 * side * k->step, phase + 0.25);
    } else {
        swing(b, thigh, X, -0.1, k->step, phase);
        swing(b, knee, X, k->step, k->step, phase + 0.3);
    }
}

static void add_arm(struct body *b, int chest, int side)
{
    const creature *k = b->k;
    double x = side * (k->girth * 1.02 + k->thick), y = b->at[chest][1] + 0.1 * k->girth, z = b->at[chest][2];
    int shoulder = add_joint(b, chest, "shoulder", x, y, z);
    int elbow = add_joint(b, shoulder, "elbow", x + side * 0.1 * k->arm, y - 0.48 * k->arm, z);
    int hand = add_joint(b, elbow, "hand", x + side * 0.14 * k->arm, y - 0.9 * k->arm, z + 0.05 * k->arm);
    add_limb(b, (const int[]){ shoulder, elbow, hand }, 3,
             (const double[]){ 0.95 * k->thick, 0.75 * k->thick, 0.6 * k->thick }, b->limb);
    add_round(b, hand, (const double[]){ 0, -0.7 * k->thick, 0 }, 0.7 * k->thick, 0.9 * k->thick, 0.7 * k->thick,
              b->skin);
    swing(b, shoulder, X, 0, 0.9 * k->step, side > 0 ? 0.5 : 0);
    swing(b, elbow, X, -0.5, 0.3, side > 0 ? 0.5 : 0);
}

static void add_wing(struct body *b, int chest, int side)
{
    const creature *k = b->k;
    double x = side * 0.7 * k->girth, y = b->at[chest][1] + 0.4 * k->girth, z = b->at[chest][2] - 0.2 * k->body;
    int root = add_joint(b, chest, "wing", x, y, z),
        tip = add_joint(b, root, "wing tip", x + side * 0.5 * k->wing, y, z);
    for (int part = 0; part < 2; part++) {
        const double at[3] = { side * (part ? 0.26 : 0.24) * k->wing, 0, part ? -0.04 * k->wing : 0 };
        add_round(b, part ? tip : root, at, 0.3 * k->wing, 0.025 * k->wing, (part ? 0.13 : 0.18) * k->wing,
                  part ? b->limb : b->skin);
    }
    swing(b, root, Z, side * 0.25, side * 0.65, 0);
    swing(b, tip, Z, side * -0.1, side * 0.5, -0.15);
}

static void add_face(struct body *b, int head)
{
    const creature *k = b->k;
    double r = k->head;
    for (int side = -1; side <= 1; side += 2) {
        add_round(b, head, (const double[]){ side * 0.48 * r, 0.28 * r, 0.76 * r }, 0.17 * r, 0.2 * r, 0.14 * r,
                  b->dark);
        if (k->ears > 0)
            add_round(b, head, (const double[]){ side * 0.62 * r, 0.75 * r + 0.5 * k->ears, -0.1 * r }, 0.26 * r,
                      0.2 * r + 0.6 * k->ears, 0.14 * r, b->limb);
    }
    if (k->snout > 0)
        add_round(b, head, (const double[]){ 0, -0.22 * r, 0.6 * r + 0.5 * k->snout }, 0.5 * r, 0.42 * r,
                  0.3 * r + 0.5 * k->snout, b->limb);
}

/* A hat, a cap of hair or nothing. */
static void add_hat(struct body *b, int head)
{
    dar_maker *m = b->m;
    double r = b->k->head;
    size_t form = dar_dice_below(b->d, 4);
    m->paint = dar_asset_paint(m, 0);
    m->joint = head;
    dar_make_home(m);
    dar_make_shift(m, b->at[head][0], b->at[head][1] + 0.55 * r, b->at[head][2]);
    if (form == 0) dar_make_cone(m, 1.05 * r, 0, 1.6 * r);
    if (form == 1) dar_make_cone(m, 1.5 * r, 1.5 * r, 0.12 * r), dar_make_cone(m, 0.85 * r, 0.8 * r, 0.9 * r);
    if (form == 2) dar_make_shift(m, 0, -0.25 * r, -0.12 * r), dar_make_round(m, 1.08 * r, 0.85 * r, 1.05 * r, 1, 1);
}

static void add_tail(struct body *b, int hip)
{
    const creature *k = b->k;
    double y = b->at[hip][1] + 0.2 * k->girth, z = b->at[hip][2] - 0.8 * k->girth;
    int joint[5], parent = hip;
    double radius[5];
    for (int i = 0; i < 5; i++) {
        double s = i / 4.0;
        joint[i] = add_joint(b, parent, "tail", 0, fmax(y - 0.35 * k->tail * s + 0.3 * k->tail * s * s, 0.05 * k->tail),
                             z - 0.85 * k->tail * s);
        radius[i] = fmax(0.45 * k->girth * (1 - s), 0.02 + 0.1 * k->thick);
        parent = joint[i];
        swing(b, joint[i], Y, 0, 0.22, -0.12 * i);
    }
    add_limb(b, joint, 5, radius, b->skin);
}

/* ---------------------------------------------------------------- the whole */

static void add_trunk(struct body *b, int *hip, int *chest, int *head)
{
    const creature *k = b->k;
    double pitch = k->pitch * M_PI / 180, nod = k->nod * M_PI / 180, r = k->girth, ground = k->leg;
    double up = k->body * sin(pitch), forward = k->body * cos(pitch);
    *hip = add_joint(b, -1, "hip", 0, ground, -forward / 2);
    int middle = add_joint(b, *hip, "middle", 0, ground + up / 2, 0);
    *chest = add_joint(b, middle, "chest", 0, ground + up, forward / 2);
    int neck = add_joint(b, *chest, "neck", 0, ground + up + 0.45 * r * sin(nod), forward / 2 + 0.45 * r * cos(nod));
    *head = add_joint(b, neck, "head", 0, b->at[neck][1] + k->neck * sin(nod), b->at[neck][2] + k->neck * cos(nod));
    add_limb(b, (const int[]){ *hip, middle, *chest }, 3, (const double[]){ 0.95 * r, 1.02 * r, r }, b->skin);
    add_limb(b, (const int[]){ neck, *head }, 2, (const double[]){ fmin(0.75 * r, 0.9 * k->head), 0.55 * k->head },
             b->limb);
    add_round(b, *head, (const double[]){ 0, 0.25 * k->head, 0.15 * k->head }, 0.92 * k->head, k->head, k->head,
              b->skin);
    swing(b, middle, pitch > 0.8 ? Y : X, 0, 0.06, 0.1);
    swing(b, *chest, pitch > 0.8 ? Y : X, 0, 0.08, 0.3);
    swing(b, neck, X, 0, 0.09, 0.25);
    swing(b, *head, Y, 0, 0.12, 0.4);
}

/* [m/s] at which feet do not slip. */
static double speed_of(const creature *k)
{
    return (k->splay > 0.2 ? 1.4 : 3.2) * k->leg * sin(k->step) * k->tempo;
}

static creature vary(const creature *row, dar_dice *d)
{
    creature k = *row;
    double *part[] = { &k.body, &k.girth, &k.leg, &k.thick, &k.neck, &k.head, &k.snout,
                       &k.ears, &k.tail,  &k.arm, &k.wing,  &k.step, &k.tempo };
    for (size_t i = 0; i < DAR_COUNT(part); i++) *part[i] = dar_dice_near(d, *part[i], 0.14);
    k.pitch += dar_dice_in(d, -5, 5);
    k.nod += dar_dice_in(d, -8, 8);
    if (!(k.height > 0)) k.tempo *= fmin(1, FASTEST / speed_of(&k));
    return k;
}

static void make_creature(dar_maker *m, dar_dice *d, const void *row, dar_asset *out)
{
    creature k = vary(row, d);
    struct body b = { .m = m, .d = d, .k = &k, .root = out->root };
    int hip, chest, head;
    b.skin = dar_asset_paint(m, k.coat);
    b.limb = dar_dice_chance(d, 0.5) ? b.skin : dar_asset_paint(m, k.coat);
    double dark = dar_dice_in(d, 0.05, 0.2);
    b.dark = dar_make_plain(m, dark, dark, dark);
    dar_make_begin(m);
    m->density = dar_dice_in(d, 0.8, 2);
    add_trunk(&b, &hip, &chest, &head);
    for (int i = 0; i < k.pairs; i++) {
        int at = k.pairs == 1 || 2 * i < k.pairs - 1 ? hip : chest;
        double share = k.pairs > 2 ? (double)i / (k.pairs - 1) : 0;
        if (k.pairs > 2) /* along the spine: stumps without a skin of their own */
            at = add_joint(&b, hip, "side", 0, b.at[hip][1] + share * (b.at[chest][1] - b.at[hip][1]),
                           b.at[hip][2] + share * (b.at[chest][2] - b.at[hip][2]));
        add_leg(&b, at, -1, 0.5 * (i % 2));
        add_leg(&b, at, 1, 0.5 * (i % 2 == 0));
    }
    for (int side = -1; side <= 1; side += 2) {
        if (k.arm > 0) add_arm(&b, chest, side);
        if (k.wing > 0) add_wing(&b, chest, side);
    }
    add_face(&b, head);
    if (k.pitch > 60 && !(k.snout > 0)) add_hat(&b, head);
    if (k.tail > 0) add_tail(&b, hip);
    dar_make_skin(m, out->root, dar_make_end(m, "creature"), b.joint, b.joints);
    out->way = k.height > 0 ? DAR_ASSET_FLIES : DAR_ASSET_WALKS;
    out->height = k.height > 0 ? dar_dice_near(d, k.height, 0.3) : 0;
    out->speed = k.height > 0 ? 1.2 : speed_of(&k);
}

/* ---------------------------------------------------------------- kinds */

#define FUR (DAR_PAINT(PLAIN) | DAR_PAINT(SPOTS) | DAR_PAINT(CLOUDS) | DAR_PAINT(STRIPES))
#define WEAR                                                                                                           \
    (DAR_PAINT(STRIPES) | DAR_PAINT(PLAID) | DAR_PAINT(DOTS) | DAR_PAINT(CHECKER) | DAR_PAINT(ZIGZAG) |                \
     DAR_PAINT(PLAIN))

/* pairs; body, girth, pitch; leg, thick, splay; neck, nod, head; snout, ears, tail; arm, wing; step, tempo; height */
/* clang-format off */
static const creature
    adult = { 1, 0.48, 0.17, 88, 0.82, 0.075, 0, 0.12, 85, 0.14, 0, 0, 0, 0.72, 0, 0.48, 1.1, 0, WEAR },
    child = { 1, 0.30, 0.13, 88, 0.45, 0.06, 0, 0.07, 85, 0.15, 0, 0, 0, 0.45, 0, 0.55, 1.5, 0, WEAR },
    giant = { 1, 0.75, 0.32, 85, 0.8, 0.14, 0, 0.1, 80, 0.2, 0, 0, 0, 0.95, 0, 0.4, 0.8, 0, 0 },
    robot = { 1, 0.5, 0.24, 89, 0.6, 0.1, 0, 0.14, 88, 0.2, 0.05, 0.1, 0, 0.65, 0, 0.4, 1.2, 0,
              DAR_PAINT(TILES) | DAR_PAINT(GRADIENT) | DAR_PAINT(STRIPES) },
    dancer = { 1, 0.42, 0.13, 86, 0.95, 0.055, 0, 0.14, 86, 0.12, 0, 0, 0, 0.75, 0, 0.8, 1.3, 0, WEAR },
    gnome = { 1, 0.26, 0.22, 86, 0.28, 0.09, 0, 0.05, 82, 0.19, 0, 0.1, 0, 0.4, 0, 0.5, 1.6, 0, WEAR },
    dog = { 2, 0.55, 0.14, 4, 0.45, 0.05, 0, 0.18, 55, 0.12, 0.12, 0.08, 0.4, 0, 0, 0.5, 1.5, 0, FUR },
    cat = { 2, 0.48, 0.11, 2, 0.3, 0.04, 0, 0.1, 50, 0.11, 0.04, 0.1, 0.5, 0, 0, 0.45, 1.4, 0, FUR },
    horse = { 2, 1.0, 0.27, 4, 0.95, 0.075, 0, 0.6, 55, 0.15, 0.28, 0.12, 0.6, 0, 0, 0.45, 1.1, 0, FUR },
    giraffe = { 2, 0.8, 0.22, 12, 1.15, 0.07, 0, 1.15, 68, 0.13, 0.18, 0.1, 0.4, 0, 0, 0.38, 0.9, 0, FUR },
    elephant = { 2, 1.0, 0.48, 0, 0.85, 0.15, 0, 0.12, 35, 0.34, 0.5, 0.1, 0.4, 0, 0, 0.32, 0.8, 0, FUR },
    pig = { 2, 0.6, 0.25, 0, 0.3, 0.06, 0, 0.05, 25, 0.19, 0.1, 0.08, 0.2, 0, 0, 0.5, 1.6, 0, FUR },
    rabbit = { 2, 0.28, 0.16, 12, 0.18, 0.05, 0, 0.04, 50, 0.13, 0.03, 0.26, 0.12, 0, 0, 0.6, 1.7, 0, FUR },
    cow = { 2, 1.0, 0.33, 0, 0.65, 0.08, 0, 0.2, 35, 0.2, 0.22, 0.12, 0.6, 0, 0, 0.38, 0.9, 0, FUR },
    fox = { 2, 0.5, 0.12, 3, 0.35, 0.04, 0, 0.12, 45, 0.12, 0.14, 0.12, 0.6, 0, 0, 0.5, 1.5, 0, FUR },
    camel = { 2, 0.95, 0.36, 2, 1.05, 0.08, 0, 0.7, 50, 0.16, 0.2, 0.06, 0.4, 0, 0, 0.4, 0.9, 0, FUR },
    lizard = { 2, 0.7, 0.11, 0, 0.2, 0.04, 0.6, 0.1, 15, 0.1, 0.14, 0, 0.9, 0, 0, 0.5, 1.5, 0, 0 },
    turtle = { 2, 0.42, 0.27, 0, 0.22, 0.06, 0.5, 0.2, 30, 0.1, 0.04, 0, 0.15, 0, 0, 0.4, 1, 0, 0 },
    ostrich = { 1, 0.5, 0.24, 20, 0.8, 0.05, 0, 0.75, 78, 0.1, 0.14, 0, 0.3, 0, 0, 0.55, 1.2, 0, FUR },
    duck = { 1, 0.35, 0.18, 15, 0.25, 0.04, 0, 0.16, 70, 0.12, 0.1, 0, 0.18, 0, 0, 0.5, 1.6, 0, FUR },
    raptor = { 1, 0.7, 0.2, 20, 0.7, 0.09, 0, 0.3, 50, 0.15, 0.24, 0, 1, 0.3, 0, 0.55, 1.2, 0, 0 },
    bird = { 1, 0.35, 0.12, 5, 0.16, 0.02, 0, 0.08, 30, 0.1, 0.1, 0, 0.3, 0, 1, 0.2, 2, 1.1, FUR },
    dragon = { 2, 0.9, 0.2, 8, 0.4, 0.07, 0, 0.5, 40, 0.16, 0.22, 0.1, 1.2, 0, 1.6, 0.3, 1.2, 1, 0 },
    spider = { 4, 0.35, 0.2, 0, 0.35, 0.035, 1.5, 0.05, 0, 0.14, 0, 0, 0, 0, 0, 0.35, 1.5, 0, 0 },
    ant = { 3, 0.5, 0.12, 5, 0.3, 0.03, 1.2, 0.06, 10, 0.14, 0.06, 0, 0.1, 0, 0, 0.4, 1.7, 0, 0 },
    crab = { 4, 0.28, 0.24, 0, 0.25, 0.035, 1.6, 0.02, 10, 0.09, 0, 0.1, 0, 0.35, 0, 0.3, 1.6, 0, 0 },
    beetle = { 3, 0.45, 0.24, 0, 0.26, 0.035, 1, 0.06, 0, 0.13, 0.05, 0.12, 0, 0, 0, 0.4, 1.6, 0, 0 };

#define ROW(kind, family, where) { #kind, family, DAR_ASSET_##where, make_creature, &kind }
const dar_asset_kind dar_asset_creatures[] = {
    ROW(adult, "humanoid", TRAIN), ROW(child, "humanoid", TRAIN), ROW(robot, "humanoid", TRAIN),
    ROW(dancer, "humanoid", VIS), ROW(giant, "humanoid", VIS), ROW(gnome, "humanoid", OOD),
    ROW(dog, "quadruped", TRAIN), ROW(horse, "quadruped", TRAIN), ROW(elephant, "quadruped", TRAIN),
    ROW(pig, "quadruped", TRAIN), ROW(rabbit, "quadruped", TRAIN), ROW(lizard, "quadruped", TRAIN),
    ROW(cat, "quadruped", VIS), ROW(giraffe, "quadruped", VIS), ROW(cow, "quadruped", VIS),
    ROW(fox, "quadruped", OOD), ROW(camel, "quadruped", OOD), ROW(turtle, "quadruped", OOD),
    ROW(ostrich, "bird", TRAIN), ROW(bird, "bird", TRAIN), ROW(raptor, "bird", VIS), ROW(duck, "bird", OOD),
    ROW(dragon, "bird", OOD),
    ROW(spider, "insect", TRAIN), ROW(beetle, "insect", TRAIN), ROW(ant, "insect", VIS), ROW(crab, "insect", OOD),
};
/* clang-format on */
const size_t dar_asset_creature_count = DAR_COUNT(dar_asset_creatures);
