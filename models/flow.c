/* flow.c: times of flow matching, and the arithmetic on its path. */
#include "models/flow.h"

#include <math.h>

#include "lib/kern.h"
#include "lib/status.h"
#include "lib/thread.h"

#define PI        3.14159265358979323846
#define MODE      1.29 /* Esser et al. 2024, section 3.1 */
#define TABLE_END (1.0 / DAR_FLOW_TIMES)
#define MOST      8 /* terms of a combination */

const char *const dar_flow_density_name[] = { "uniform", "logit_normal", "mode", "cosmap", NULL };
const char *const dar_flow_weighting_name[] = { "none", "bell", NULL };
const char *const dar_flow_grid_name[] = { "even", "twice", "whole", "diffusers", NULL };

double dar_flow_shift(double s, double shift)
{
    return shift * s / (1 + (shift - 1) * s);
}

/* ---------------------------------------------------------------- learning */

double dar_flow_sigma(int k, double shift)
{
    DAR_ASSERT(k >= 0 && k < DAR_FLOW_TIMES, "flow: entry %d of a table of %d", k, DAR_FLOW_TIMES);
    return dar_flow_shift((double)(DAR_FLOW_TIMES - k) / DAR_FLOW_TIMES, shift);
}

/* The normal quantile, by Newton's steps on erfc from the logistic one: its tails are those of u itself. */
static double normal_quantile(double u)
{
    if (!(u > 0)) return -INFINITY;
    double x = log(u / (1 - u)) / 1.702;
    for (int i = 0; i < 50; i++) {
        double step = (erfc(-x / sqrt(2)) / 2 - u) / (exp(-x * x / 2) / sqrt(2 * PI));
        step = fmax(-1, fmin(1, step));
        x -= step;
        if (fabs(step) < 1e-14) break;
    }
    return x;
}

int dar_flow_draw(dar_flow_density d, double u)
{
    DAR_ASSERT(u >= 0 && u < 1, "flow: draw %g is not in [0, 1)", u);
    double p = u;
    switch (d) {
    case DAR_FLOW_LOGIT_NORMAL: p = 1 / (1 + exp(-normal_quantile(u))); break;
    case DAR_FLOW_MODE: p = 1 - u - MODE * (pow(cos(PI * u / 2), 2) - 1 + u); break;
    case DAR_FLOW_COSMAP: p = 1 - 1 / (tan(PI * u / 2) + 1); break;
    default: break;
    }
    int k = (int)(p * DAR_FLOW_TIMES);
    return k < 0 ? 0 : k >= DAR_FLOW_TIMES ? DAR_FLOW_TIMES - 1 : k;
}

static double bell(double sigma)
{
    return exp(-2 * (sigma - 0.5) * (sigma - 0.5));
}

double dar_flow_weight(dar_flow_weighting w, double sigma, double shift)
{
    if (w == DAR_FLOW_FLAT) return 1;
    double least = INFINITY, sum = 0;
    for (int k = 0; k < DAR_FLOW_TIMES; k++) {
        double b = bell(dar_flow_sigma(k, shift));
        least = fmin(least, b);
        sum += b;
    }
    return (bell(sigma) - least) / (sum / DAR_FLOW_TIMES - least);
}

/* ---------------------------------------------------------------- arithmetic */

typedef struct combination {
    int n;
    const double *a;
    const dar_tensor *const *x;
    const dar_tensor *y;
} combination;

/* Elements i .. i + n - 1, n at most DAR_PIECE. */
static void combine_piece(const combination *c, size_t i, size_t n, double *buf)
{
    const dar_kern *k = dar_kern_for(c->x[0]->dtype);
    k->scale(n, c->a[0], dar_tensor_at(c->x[0], i), buf);
    for (int j = 1; j < c->n; j++) k->axpy(n, c->a[j], dar_tensor_at(c->x[j], i), buf);
}

static void combine_range(void *ctx, size_t begin, size_t end, int thread)
{
    const combination *c = ctx;
    dar_dtype type = c->y->dtype;
    double buf[DAR_PIECE];
    (void)thread;

    for (size_t i = begin; i < end; i += DAR_PIECE) {
        size_t n = end - i < DAR_PIECE ? end - i : DAR_PIECE;
        combine_piece(c, i, n, buf);
        dar_row_convert(type, dar_tensor_at(c->y, i), type, buf, n);
    }
}

static double square_range(void *ctx, size_t begin, size_t end)
{
    const combination *c = ctx;
    double buf[DAR_PIECE], sum = 0;
    for (size_t i = begin; i < end; i += DAR_PIECE) {
        size_t n = end - i < DAR_PIECE ? end - i : DAR_PIECE;
        combine_piece(c, i, n, buf);
        sum += dar_kern_for(c->x[0]->dtype)->dot(n, buf, buf);
    }
    return sum;
}

static double size_range(void *ctx, size_t begin, size_t end)
{
    const combination *c = ctx;
    double buf[DAR_PIECE], wide[DAR_PIECE], sum = 0;
    for (size_t i = begin; i < end; i += DAR_PIECE) {
        size_t n = end - i < DAR_PIECE ? end - i : DAR_PIECE;
        combine_piece(c, i, n, buf);
        dar_row_convert(DAR_F64, wide, c->x[0]->dtype, buf, n);
        for (size_t k = 0; k < n; k++) sum += fabs(wide[k]);
    }
    return sum;
}

static void check_terms(int n, const dar_tensor *const *x, const dar_tensor *y)
{
    DAR_ASSERT(n >= 1 && n <= MOST, "flow: %d terms, expected 1 to %d", n, MOST);
    DAR_ASSERT(y->dtype == DAR_F32 || y->dtype == DAR_F64, "flow: type %s, expected f32 or f64",
               dar_dtype_name(y->dtype));
    for (int j = 0; j < n; j++)
        DAR_ASSERT(x[j]->dtype == y->dtype && dar_shape_equal(&x[j]->shape, &y->shape) && dar_tensor_contiguous(x[j]),
                   "flow: term %d has another type or shape than the result, or is a strided view", j);
    DAR_ASSERT(dar_tensor_contiguous(y), "flow: the result is a strided view");
}

void dar_flow_combine(int n, const double *a, const dar_tensor *const *x, const dar_tensor *y)
{
    check_terms(n, x, y);
    combination c = { n, a, x, y };
    dar_parallel_range(dar_tensor_count(y), 16 * DAR_PIECE, combine_range, &c);
}

double dar_flow_norm(int n, const double *a, const dar_tensor *const *x)
{
    check_terms(n, x, x[0]);
    combination c = { n, a, x, NULL };
    return sqrt(dar_parallel_sum(dar_tensor_count(x[0]), 16 * DAR_PIECE, square_range, &c));
}

double dar_flow_size(int n, const double *a, const dar_tensor *const *x)
{
    check_terms(n, x, x[0]);
    combination c = { n, a, x, NULL };
    return dar_parallel_sum(dar_tensor_count(x[0]), 16 * DAR_PIECE, size_range, &c);
}

void dar_flow_mix(const dar_tensor *z0, const dar_tensor *eps, double sigma, const dar_tensor *z)
{
    dar_flow_combine(2, (double[]){ 1 - sigma, sigma }, (const dar_tensor *[]){ z0, eps }, z);
}

void dar_flow_target(const dar_tensor *z0, const dar_tensor *eps, const dar_tensor *v)
{
    dar_flow_combine(2, (double[]){ 1, -1 }, (const dar_tensor *[]){ eps, z0 }, v);
}

/* ---------------------------------------------------------------- grids */

void dar_flow_fill(dar_flow_grid g, size_t steps, double shift, double *sigma, double *time)
{
    DAR_ASSERT(steps >= 1, "flow: no steps");
    for (size_t i = 0; i < steps; i++) {
        double p = (double)i / (double)steps, s = 0;
        switch (g) {
        case DAR_GRID_EVEN: s = 1 - p; break;
        case DAR_GRID_TWICE: /* from end to end: the last step is its own */
            s = steps > 1 ? 1 + (dar_flow_shift(TABLE_END, shift) - 1) * (double)i / (double)(steps - 1) : 1;
            break;
        case DAR_GRID_WHOLE: s = (1 - TABLE_END) * (1 - p); break;
        case DAR_GRID_DIFFUSERS: s = 1 + (TABLE_END - 1) * p; break;
        default: DAR_ASSERT(false, "flow: grid %d", (int)g);
        }
        sigma[i] = dar_flow_shift(s, shift) - (g == DAR_GRID_DIFFUSERS && i == 0 ? 1e-6 : 0);
        time[i] = DAR_FLOW_TIMES * sigma[i];
        if (g == DAR_GRID_WHOLE) time[i] = floor(time[i]);
    }
    sigma[steps] = 0;
}
