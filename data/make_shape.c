/* make_shape.c: solids as sheets. */
#include "data/make.h"

#include <math.h>
#include <string.h>

#include "data/rigid.h"

#define FINE      20 /* quads around what is round */
#define ROUND_END 3  /* quads along the round end of a tube */

/* Of the texture, per metre. */
static double density(const dar_maker *m)
{
    return m->coarse ? DAR_MAKE_COARSE * m->density : m->density;
}

/* Repeats of the texture along a length: whole ones where the sheet closes. */
static double repeats(const dar_maker *m, double length, bool closed)
{
    double scale = sqrt(dar_vec_dot(m->at, m->at)), n = fabs(length) * scale * density(m);
    return closed ? fmax(1, floor(n + 0.5)) : n;
}

/* ---------------------------------------------------------------- flat */

struct plate {
    double x[3], u[3], v[3]; /* corner, sides */
};

static void plate_point(const void *ctx, double u, double v, double x[3])
{
    const struct plate *p = ctx;
    for (int k = 0; k < 3; k++) x[k] = p->x[k] + u * p->u[k] + v * p->v[k];
}

static void add_plate(dar_maker *m, const struct plate *p, size_t quads)
{
    double u = sqrt(dar_vec_dot(p->u, p->u)), v = sqrt(dar_vec_dot(p->v, p->v));
    dar_make_sheet(m, &(dar_sheet_shape){ .rows = quads,
                                          .columns = quads,
                                          .repeat_u = repeats(m, u, false),
                                          .repeat_v = repeats(m, v, false),
                                          .point = plate_point,
                                          .ctx = p });
}

void dar_make_plate(dar_maker *m, double x, double z, size_t quads)
{
    add_plate(m, &(struct plate){ { -x / 2, 0, z / 2 }, { x, 0, 0 }, { 0, 0, -z } }, quads);
}

void dar_make_box(dar_maker *m, double x, double y, double z)
{
    double a = x / 2, b = y / 2, c = z / 2;
    const struct plate side[6] = {
        { { -a, -b, c }, { x, 0, 0 }, { 0, y, 0 } }, { { a, -b, -c }, { -x, 0, 0 }, { 0, y, 0 } },
        { { a, -b, c }, { 0, 0, -z }, { 0, y, 0 } }, { { -a, -b, -c }, { 0, 0, z }, { 0, y, 0 } },
        { { -a, b, c }, { x, 0, 0 }, { 0, 0, -z } }, { { -a, -b, -c }, { x, 0, 0 }, { 0, 0, z } },
    };
    for (int i = 0; i < 6; i++) add_plate(m, &side[i], 1);
}

/* ---------------------------------------------------------------- round */

struct round {
    double x, y, z, north, east, rough;
    uint64_t seed;
};

static double power(double x, double p)
{
    return copysign(pow(fabs(x), p), x);
}

static void round_point(const void *ctx, double u, double v, double x[3])
{
    const struct round *r = ctx;
    double a = 2 * M_PI * u, b = M_PI * (v - 0.5), ring = v <= 0 || v >= 1 ? 0 : power(cos(b), r->north);
    x[0] = r->x * ring * power(sin(a), r->east);
    x[1] = r->y * (v <= 0 ? -1 : v >= 1 ? 1 : power(sin(b), r->north));
    x[2] = r->z * ring * power(cos(a), r->east);
}

void dar_make_round(dar_maker *m, double x, double y, double z, double north, double east)
{
    struct round r = { .x = x, .y = y, .z = z, .north = north, .east = east };
    double most = fmax(x, fmax(y, z));
    size_t quads = most < 0.06 ? 10 : FINE;
    dar_make_sheet(m, &(dar_sheet_shape){ .rows = quads / 2 + 2,
                                          .columns = quads,
                                          .closed_u = true,
                                          .repeat_u = repeats(m, M_PI * (x + z), true),
                                          .repeat_v = repeats(m, M_PI * y, true),
                                          .point = round_point,
                                          .ctx = &r });
}

/* Smooth noise in [-1, 1] on a lattice of unit cells. */
static double noise(uint64_t seed, const double x[3])
{
    double y = 0, f[3];
    int64_t at[3];
    for (int k = 0; k < 3; k++) {
        at[k] = (int64_t)floor(x[k]);
        f[k] = x[k] - floor(x[k]);
        f[k] = f[k] * f[k] * (3 - 2 * f[k]);
    }
    for (int c = 0; c < 8; c++) {
        double w = 1;
        uint64_t cell = 0;
        for (int k = 0; k < 3; k++) {
            w *= c >> k & 1 ? f[k] : 1 - f[k];
            cell = cell << 16 | (uint16_t)(at[k] + (c >> k & 1));
        }
        y += w * (2 * dar_rng_f64(seed, 7, cell) - 1);
    }
    return y;
}

static void rock_point(const void *ctx, double u, double v, double x[3])
{
    const struct round *r = ctx;
    round_point(ctx, u, v, x);
    double y[3], size = 1;
    for (int k = 0; k < 3; k++) y[k] = 1.6 * x[k] / r->x + 40;
    size += r->rough * noise(r->seed, y);
    for (int k = 0; k < 3; k++) y[k] = 4.2 * x[k] / r->x + 90;
    size += 0.3 * r->rough * noise(r->seed, y);
    for (int k = 0; k < 3; k++) x[k] *= size;
}

void dar_make_rock(dar_maker *m, double radius, double rough, uint64_t seed)
{
    struct round r = { radius, radius, radius, 1, 1, rough, seed };
    dar_make_sheet(m, &(dar_sheet_shape){ .rows = FINE,
                                          .columns = FINE + 8,
                                          .closed_u = true,
                                          .repeat_u = repeats(m, 2 * M_PI * radius, true),
                                          .repeat_v = repeats(m, M_PI * radius, true),
                                          .point = rock_point,
                                          .ctx = &r });
}

static void torus_point(const void *ctx, double u, double v, double x[3])
{
    const double *r = ctx;
    double a = 2 * M_PI * u, b = 2 * M_PI * v, ring = r[0] + r[1] * cos(b);
    x[0] = ring * sin(a);
    x[1] = r[1] * sin(b);
    x[2] = ring * cos(a);
}

void dar_make_torus(dar_maker *m, double radius, double tube)
{
    const double r[2] = { radius, tube };
    dar_make_sheet(m, &(dar_sheet_shape){ .rows = FINE / 2 + 2,
                                          .columns = FINE + 8,
                                          .closed_u = true,
                                          .closed_v = true,
                                          .repeat_u = repeats(m, 2 * M_PI * radius, true),
                                          .repeat_v = repeats(m, 2 * M_PI * tube, true),
                                          .point = torus_point,
                                          .ctx = r });
}

/* ---------------------------------------------------------------- around y */

struct profile {
    const double (*at)[2];
    size_t n;
};

static void lathe_point(const void *ctx, double u, double v, double x[3])
{
    const struct profile *p = ctx;
    double t = v * (double)(p->n - 1), a = 2 * M_PI * u;
    size_t i = (size_t)t < p->n - 1 ? (size_t)t : p->n - 2;
    double f = t - (double)i, radius = (1 - f) * p->at[i][0] + f * p->at[i + 1][0];
    x[0] = radius * sin(a);
    x[1] = (1 - f) * p->at[i][1] + f * p->at[i + 1][1];
    x[2] = radius * cos(a);
}

void dar_make_lathe(dar_maker *m, const double (*profile)[2], size_t n)
{
    struct profile p = { profile, n };
    double length = 0, widest = 0;
    for (size_t i = 0; i < n; i++) {
        widest = fmax(widest, profile[i][0]);
        if (i) length += hypot(profile[i][0] - profile[i - 1][0], profile[i][1] - profile[i - 1][1]);
    }
    dar_make_sheet(m, &(dar_sheet_shape){ .rows = n - 1,
                                          .columns = widest < 0.06 ? 10 : FINE,
                                          .closed_u = true,
                                          .repeat_u = repeats(m, 2 * M_PI * widest, true),
                                          .repeat_v = repeats(m, length, false),
                                          .point = lathe_point,
                                          .ctx = &p });
}

void dar_make_disc(dar_maker *m, double radius)
{
    const double rim[2][2] = { { radius, 0 }, { 0, 0 } };
    struct profile p = { rim, 2 };
    dar_make_sheet(m, &(dar_sheet_shape){ .rows = 1,
                                          .columns = 3 * FINE,
                                          .closed_u = true,
                                          .repeat_u = density(m),
                                          .repeat_v = density(m),
                                          .planar = true,
                                          .point = lathe_point,
                                          .ctx = &p });
}

void dar_make_cone(dar_maker *m, double bottom, double top, double height)
{
    if (bottom > 0) dar_make_lathe(m, (const double[][2]){ { 0, 0 }, { bottom, 0 } }, 2);
    dar_make_lathe(m, (const double[][2]){ { bottom, 0 }, { top, height } }, 2);
    if (top > 0) dar_make_lathe(m, (const double[][2]){ { top, height }, { 0, height } }, 2);
}

/* ---------------------------------------------------------------- along a curve */

struct tube {
    const double (*at)[4];
    size_t n;
    const int *joint;
    double end; /* share of v that a round end takes */
};

/* Place on the curve: point i and the share f of the next; how far beyond the end in radii (< 0 before the begin), and
 * the share of the radius. */
static void along(const struct tube *t, double v, size_t *i, double *f, double *beyond, double *radius)
{
    double s = (v - t->end) / (1 - 2 * t->end), over = s < 0 ? 1 - v / t->end : s > 1 ? 1 - (1 - v) / t->end : 0;
    double p = fmin(fmax(s, 0), 1) * (double)(t->n - 1);
    *i = (size_t)p < t->n - 1 ? (size_t)p : t->n - 2;
    *f = p - (double)*i;
    *beyond = s < 0 ? -sin(M_PI / 2 * over) : s > 1 ? sin(M_PI / 2 * over) : 0;
    *radius = over >= 1 ? 0 : cos(M_PI / 2 * over);
}

/* Catmull and Rom's spline through points i, i + 1, and its direction. */
static void curve(const struct tube *t, size_t i, double f, double x[4], double d[3])
{
    const double *a = t->at[i ? i - 1 : 0], *b = t->at[i], *c = t->at[i + 1], *e = t->at[i + 2 < t->n ? i + 2 : i + 1];
    for (int k = 0; k < 4; k++) {
        double m0 = (c[k] - a[k]) / (i ? 2 : 1), m1 = (e[k] - b[k]) / (i + 2 < t->n ? 2 : 1), f2 = f * f, f3 = f2 * f;
        x[k] = (2 * f3 - 3 * f2 + 1) * b[k] + (f3 - 2 * f2 + f) * m0 + (3 * f2 - 2 * f3) * c[k] + (f3 - f2) * m1;
        if (k < 3) d[k] = (6 * f2 - 6 * f) * (b[k] - c[k]) + (3 * f2 - 4 * f + 1) * m0 + (3 * f2 - 2 * f) * m1;
    }
    double r = sqrt(dar_vec_dot(d, d));
    for (int k = 0; k < 3; k++) d[k] /= r > 0 ? r : 1;
}

static void tube_point(const void *ctx, double u, double v, double x[3])
{
    const struct tube *t = ctx;
    size_t i;
    double f, beyond, share, at[4], d[3], p[3], q[3], a = 2 * M_PI * u;
    along(t, v, &i, &f, &beyond, &share);
    curve(t, i, f, at, d);
    const double *begin = t->at[0], *end = t->at[t->n - 1];
    double way[3] = { end[0] - begin[0], end[1] - begin[1], end[2] - begin[2] };
    bool upright = fabs(way[1]) > hypot(way[0], way[2]);
    const double side[3] = { 0, !upright, upright };
    dar_vec_cross(side, d, p);
    double r = sqrt(dar_vec_dot(p, p));
    for (int k = 0; k < 3; k++) p[k] /= r > 1e-9 ? r : 1;
    dar_vec_cross(d, p, q);
    for (int k = 0; k < 3; k++) x[k] = at[k] + at[3] * (beyond * d[k] + share * (cos(a) * p[k] + sin(a) * q[k]));
}

static void tube_joints(const void *ctx, double u, double v, int joint[2], double *second)
{
    const struct tube *t = ctx;
    size_t i;
    double f, beyond, share;
    (void)u;
    along(t, v, &i, &f, &beyond, &share);
    joint[0] = t->joint[i];
    joint[1] = t->joint[i + 1];
    *second = joint[0] == joint[1] ? 0 : f * f * (3 - 2 * f);
}

void dar_make_tube(dar_maker *m, const double (*spine)[4], size_t n, const int *joint)
{
    size_t rows = 4 * (n - 1) + 2 * ROUND_END;
    struct tube t = { spine, n, joint, (double)ROUND_END / (double)rows };
    double length = 0, radius = 0;
    for (size_t i = 0; i < n; i++) {
        double d[3] = { 0 };
        for (int k = 0; i && k < 3; k++) d[k] = spine[i][k] - spine[i - 1][k];
        length += sqrt(dar_vec_dot(d, d));
        radius = fmax(radius, spine[i][3]);
    }
    dar_make_sheet(m, &(dar_sheet_shape){ .rows = rows,
                                          .columns = radius < 0.03 ? 8 : 14,
                                          .closed_u = true,
                                          .repeat_u = repeats(m, 2 * M_PI * radius, true),
                                          .repeat_v = repeats(m, length, false),
                                          .point = tube_point,
                                          .joints = joint ? tube_joints : NULL,
                                          .ctx = &t });
}

/* ---------------------------------------------------------------- gears */

struct gear {
    double teeth, radius, depth, z[2], ring[2]; /* between rings: shares of the outline */
};

/* Flanks rise and fall over an eighth of a tooth each. */
static double outline(const struct gear *g, double u)
{
    double t = u * g->teeth - floor(u * g->teeth);
    double up = t < 0.375 ? fmin(fmax((t - 0.125) / 0.125, 0), 1) : fmin(fmax((0.75 - t) / 0.125, 0), 1);
    return g->radius + g->depth * (up - 0.5);
}

static void gear_point(const void *ctx, double u, double v, double x[3])
{
    const struct gear *g = ctx;
    double a = 2 * M_PI * u, r = outline(g, u) * ((1 - v) * g->ring[0] + v * g->ring[1]);
    x[0] = r * cos(a);
    x[1] = r * sin(a);
    x[2] = (1 - v) * g->z[0] + v * g->z[1];
}

void dar_make_gear(dar_maker *m, size_t teeth, double radius, double depth, double thickness)
{
    double h = thickness / 2;
    const double piece[3][4] = { { -h, h, 1, 1 }, { h, h, 1, 0 }, { -h, -h, 0, 1 } }; /* rim, front, back */
    for (int i = 0; i < 3; i++) {
        const double *p = piece[i];
        struct gear g = { (double)teeth, radius, depth, { p[0], p[1] }, { p[2], p[3] } };
        dar_make_sheet(m, &(dar_sheet_shape){ .rows = 1,
                                              .columns = 8 * teeth,
                                              .closed_u = true,
                                              .repeat_u = repeats(m, 2 * M_PI * radius, true),
                                              .repeat_v = repeats(m, i ? radius : thickness, false),
                                              .point = gear_point,
                                              .ctx = &g });
    }
}
