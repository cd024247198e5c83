/* metric_flip.c: LDR-FLIP, row by row.
 *
 *   colour    both pictures as the eye resolves them: y, x - y, y - z filtered by its contrast sensitivity, back to RGB
 *             in [0, 1], to Lab with a and b scaled by L (Hunt); their HyAB distance to the power qc, spread over [0,
 * 1] feature   difference of edges, or of points where that is larger, to the power qf map       colour^(1 - feature)
 *
 * All filters are separable, down the columns first; pixels beyond the border repeat it.
 *
 * Source: Andersson et al. 2020, "FLIP: a difference evaluator for alternating images", with the constants of the
 * authors' program. */
#include "data/metric_inside.h"

#include <math.h>

#include "lib/size.h"

#define PI       3.14159265358979323846
#define PER_DEG  (0.7 * 3840 / 0.7 * PI / 180) /* pixels: a display of 0.7 m and 3840 pixels, seen from 0.7 m */
#define FEATURE  0.082                         /* width of the feature detectors [degrees] */
#define POWER_C  0.7f
#define KNEE_IN  0.4f  /* this share of the largest distance of colours ... */
#define KNEE_OUT 0.95f /* ... becomes this one of the range */

/* ---------------------------------------------------------------- filters */

/* exp(-x^2 / (2 deviation^2)), with deviations in pixels and the centre 1; returns the sum. */
static double bell(dar_flip_taps *t, int radius, double deviation)
{
    double sum = 0;
    t->radius = radius;
    for (int i = 0; i <= radius; i++) {
        double g = exp(-(double)i * i / (2 * deviation * deviation));
        t->w[i] = (float)g;
        sum += i ? 2 * g : g;
    }
    return sum;
}

/* Multiply; what is below 1e-9 of the centre is left out. */
static void scale(dar_flip_taps *t, double by)
{
    while (t->radius && t->w[t->radius] < 1e-9f) t->radius--;
    for (int i = 0; i <= t->radius; i++) t->w[i] = (float)(t->w[i] * by);
}

/* Contrast sensitivity in space: a sqrt(pi / b) exp(-pi^2 x^2 / b), x in degrees. */
static void sensitivity(dar_flip *f)
{
    static const double b[4] = { 0.0047, 0.0053, 0.04, 0.025 }, a[2] = { 34.1, 13.5 };
    dar_flip_taps *t[4] = { &f->light, &f->red_green, &f->blue_yellow[0], &f->blue_yellow[1] };
    int radius = (int)ceil(3 * sqrt(0.04 / (2 * PI * PI)) * PER_DEG);
    double sum[4], weight[2], total = 0;
    for (int i = 0; i < 4; i++) sum[i] = bell(t[i], radius, PER_DEG * sqrt(b[i] / (2 * PI * PI)));
    for (int i = 0; i < 2; i++) {
        scale(t[i], 1 / sum[i]);
        weight[i] = a[i] * sqrt(PI / b[2 + i]);
        total += weight[i] * sum[2 + i] * sum[2 + i];
    }
    for (int i = 0; i < 2; i++) scale(t[2 + i], sqrt(weight[i] / total));
}

/* A Gaussian, its first derivative and its second; positive taps sum to 1, negative ones to -1. */
static void detectors(dar_flip *f)
{
    double deviation = 0.5 * FEATURE * PER_DEG, up = 0, down = 0, side = 0;
    int radius = (int)ceil(3 * deviation);
    double g[DAR_FLIP_RADIUS + 1], second[DAR_FLIP_RADIUS + 1];
    scale(&f->smooth, 1 / bell(&f->smooth, radius, deviation));
    f->edge.radius = f->point.radius = radius;
    for (int i = 0; i <= radius; i++) {
        g[i] = exp(-(double)i * i / (2 * deviation * deviation));
        second[i] = (i * i / (deviation * deviation) - 1) * g[i];
        side += i * g[i];
        *(second[i] > 0 ? &up : &down) += i ? 2 * second[i] : second[i];
    }
    for (int i = 0; i <= radius; i++) {
        f->edge.w[i] = (float)(i * g[i] / side);
        f->point.w[i] = (float)(second[i] / (second[i] > 0 ? up : -down));
    }
}

/* out[i] = sum of w (row at +k, plus or minus row at -k), over the columns of `in`, whose rows repeat at the border. */
static void down(const dar_flip_taps *t, bool odd, const float *in, size_t width, size_t height, size_t y,
                 float *restrict out)
{
    const float *restrict mid = in + y * width;
    for (size_t i = 0; i < width; i++) out[i] = t->w[0] * mid[i];
    for (int k = 1; k <= t->radius; k++) {
        const float *restrict a = in + dar_least(y + (size_t)k, height - 1) * width;
        const float *restrict b = in + (y > (size_t)k ? y - (size_t)k : 0) * width;
        float w = t->w[k];
        if (odd) {
            for (size_t i = 0; i < width; i++) out[i] += w * (a[i] - b[i]);
        } else {
            for (size_t i = 0; i < width; i++) out[i] += w * (a[i] + b[i]);
        }
    }
}

/* The same along a row, before and behind which there is room for DAR_FLIP_RADIUS values. */
static void across(const dar_flip_taps *t, bool odd, float *row, size_t width, float *restrict out)
{
    for (int k = 1; k <= t->radius; k++) {
        row[-k] = row[0];
        row[width - 1 + (size_t)k] = row[width - 1];
    }
    for (size_t i = 0; i < width; i++) out[i] = t->w[0] * row[i];
    for (int k = 1; k <= t->radius; k++) {
        const float *a = row + k, *b = row - k;
        float w = t->w[k];
        if (odd) {
            for (size_t i = 0; i < width; i++) out[i] += w * (a[i] - b[i]);
        } else {
            for (size_t i = 0; i < width; i++) out[i] += w * (a[i] + b[i]);
        }
    }
}

/* ---------------------------------------------------------------- colours */

/* Linear RGB of sRGB to XYZ. */
static const double rgb_to_xyz[3][3] = {
    { 10135552. / 24577794, 8788810. / 24577794, 4435075. / 24577794 },
    { 2613072. / 12288897, 8788810. / 12288897, 887015. / 12288897 },
    { 1425312. / 73733382, 8788810. / 73733382, 70074185. / 73733382 },
};

static void invert(double m[3][3], float out[3][3])
{
    double c[3][3], det = 0;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            c[j][i] = m[(i + 1) % 3][(j + 1) % 3] * m[(i + 2) % 3][(j + 2) % 3] -
                      m[(i + 1) % 3][(j + 2) % 3] * m[(i + 2) % 3][(j + 1) % 3];
    for (int j = 0; j < 3; j++) det += m[0][j] * c[j][0];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) out[i][j] = (float)(c[i][j] / det);
}

static inline float curve(float t)
{
    const float delta = 6.f / 29;
    return t > delta * delta * delta ? cbrtf(t) : t / (3 * delta * delta) + 4.f / 29;
}

/* Lab of XYZ relative to white, a and b scaled by the Hunt effect. */
static inline void hunt(const float xyz[3], float lab[3])
{
    float fx = curve(xyz[0]), fy = curve(xyz[1]), fz = curve(xyz[2]);
    lab[0] = 116 * fy - 16;
    lab[1] = 0.01f * lab[0] * (500 * (fx - fy));
    lab[2] = 0.01f * lab[0] * (200 * (fy - fz));
}

static inline float distance(const float *a, const float *b)
{
    float da = a[1] - b[1], db = a[2] - b[2];
    return powf(fabsf(a[0] - b[0]) + sqrtf(da * da + db * db), POWER_C);
}

static inline void times(const float (*m)[3], const float *x, float *y)
{
    for (int i = 0; i < 3; i++) y[i] = m[i][0] * x[0] + m[i][1] * x[1] + m[i][2] * x[2];
}

void dar_flip_init(dar_flip *f)
{
    double m[3][3];
    float green[3], blue[3], column[3];
    dar_srgb_init(&f->srgb);
    sensitivity(f);
    detectors(f);
    for (int i = 0; i < 3; i++) {
        double white = rgb_to_xyz[i][0] + rgb_to_xyz[i][1] + rgb_to_xyz[i][2];
        for (int j = 0; j < 3; j++) f->to_xyz[i][j] = (float)(m[i][j] = rgb_to_xyz[i][j] / white);
    }
    invert(m, f->to_rgb);
    for (int i = 0; i < 3; i++) column[i] = f->to_xyz[i][1];
    hunt(column, green);
    for (int i = 0; i < 3; i++) column[i] = f->to_xyz[i][2];
    hunt(column, blue);
    f->cmax = distance(green, blue);
}

void dar_flip_opponent(const dar_flip *f, const uint8_t *rgb, size_t width, size_t height, size_t y, float *planes)
{
    float *plane[3];
    for (size_t c = 0; c < 3; c++) plane[c] = planes + (c * height + y) * width;
    rgb += 3 * y * width;
    for (size_t i = 0; i < width; i++, rgb += 3) {
        float light[3] = { f->srgb.linear[rgb[0]], f->srgb.linear[rgb[1]], f->srgb.linear[rgb[2]] }, xyz[3];
        times(f->to_xyz, light, xyz);
        plane[0][i] = xyz[1];
        plane[1][i] = xyz[0] - xyz[1];
        plane[2][i] = xyz[1] - xyz[2];
    }
}

/* ---------------------------------------------------------------- a row */

enum { LAB, EDGE = LAB + 3, POINT, SEEN }; /* rows that are kept of a picture */
enum { APART = 4 };                        /* and on the way there */

size_t dar_flip_work(size_t width)
{
    return width + 2 * DAR_FLIP_RADIUS + (APART + 2 * SEEN) * width;
}

static void colours(const dar_flip *f, size_t width, float *const part[APART], float *const seen[SEEN])
{
    for (size_t i = 0; i < width; i++) {
        float y = part[0][i], x = y + part[1][i], z = y - (part[2][i] + part[3][i]);
        float xyz[3] = { x, y, z }, rgb[3], lab[3];
        times(f->to_rgb, xyz, rgb);
        for (int c = 0; c < 3; c++) rgb[c] = rgb[c] > 0 ? (rgb[c] < 1 ? rgb[c] : 1) : 0;
        times(f->to_xyz, rgb, xyz);
        hunt(xyz, lab);
        for (int c = 0; c < 3; c++) seen[LAB + c][i] = lab[c];
    }
}

static void length(size_t n, const float *a, const float *b, float *restrict out)
{
    for (size_t i = 0; i < n; i++) out[i] = sqrtf(a[i] * a[i] + b[i] * b[i]);
}

/* What is seen in row y of one picture.  row: as for across. */
static void look(const dar_flip *f, const float *planes, size_t width, size_t height, size_t y, float *row,
                 float *const part[APART], float *const seen[SEEN])
{
    const dar_flip_taps *eye[APART] = { &f->light, &f->red_green, &f->blue_yellow[0], &f->blue_yellow[1] };
    const dar_flip_taps *sought[2] = { &f->edge, &f->point };
    for (size_t i = 0; i < APART; i++) {
        down(eye[i], false, planes + dar_least(i, 2) * height * width, width, height, y, row);
        across(eye[i], false, row, width, part[i]);
    }
    colours(f, width, part, seen);
    for (int i = 0; i < 2; i++) {
        bool odd = sought[i] == &f->edge;
        down(&f->smooth, false, planes, width, height, y, row);
        across(sought[i], odd, row, width, part[0]);
        down(sought[i], odd, planes, width, height, y, row);
        across(&f->smooth, false, row, width, part[1]);
        length(width, part[0], part[1], seen[EDGE + i]);
    }
}

/* Of the distance of colours, spread so that KNEE_IN of the largest becomes KNEE_OUT. */
static inline float spread(float x, float cmax)
{
    float knee = KNEE_IN * cmax;
    return x < knee ? KNEE_OUT / knee * x : KNEE_OUT + (x - knee) / (cmax - knee) * (1 - KNEE_OUT);
}

void dar_flip_row(const dar_flip *f, const float *found, const float *truth, size_t width, size_t height, size_t y,
                  float *work, float *map)
{
    float *row = work + DAR_FLIP_RADIUS, *part[APART], *a[SEEN], *b[SEEN];
    float *next = work + width + 2 * DAR_FLIP_RADIUS;
    for (int i = 0; i < APART; i++, next += width) part[i] = next;
    for (int i = 0; i < SEEN; i++, next += width) a[i] = next;
    for (int i = 0; i < SEEN; i++, next += width) b[i] = next;
    look(f, found, width, height, y, row, part, a);
    look(f, truth, width, height, y, row, part, b);
    for (size_t i = 0; i < width; i++) {
        float p[3] = { a[LAB][i], a[LAB + 1][i], a[LAB + 2][i] }, q[3] = { b[LAB][i], b[LAB + 1][i], b[LAB + 2][i] };
        float colour = spread(distance(p, q), f->cmax);
        float edge = fabsf(a[EDGE][i] - b[EDGE][i]), point = fabsf(a[POINT][i] - b[POINT][i]);
        float feature = sqrtf((edge > point ? edge : point) * 0.70710678f);
        map[i] = powf(colour, 1 - feature);
    }
}
