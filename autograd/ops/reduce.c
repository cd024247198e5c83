/* reduce.c: sums, means, squared error, softmax. */
#include <math.h>

#include "autograd/bcast.h"
#include "autograd/ops.h"
#include "lib/thread.h"

static void scale_row(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    k->scale(n, *(const double *)arg, x[0], y);
}

/* Sums are f32 even of 16-bit values. */
static dar_dtype wide_dtype(const dar_dtype *in, int n_in, const void *attr)
{
    (void)n_in, (void)attr;
    return dar_compute_type(in[0]);
}

/* ---------------------------------------------------------------- sum, mean */

struct dims {
    unsigned set; /* bit k: dimension k is summed */
    bool keep;    /* it stays as 1 */
};

/* The shape with the summed dimensions as 1. */
static dar_shape kept_shape(dar_shape s, const struct dims *d)
{
    for (int k = 0; k < s.n; k++)
        if (d->set >> k & 1) s.d[k] = 1;
    return s;
}

static dar_shape sum_shape(const dar_shape *in, int n_in, const void *attr)
{
    const struct dims *d = attr;
    dar_shape s = kept_shape(in[0], d), y = { 0 };
    (void)n_in;
    DAR_ASSERT(d->set == DAR_ALL_DIMS || !(d->set >> s.n), "sum: dimensions %#x of %d", d->set, s.n);
    for (int k = 0; k < s.n; k++)
        if (d->keep || !(d->set >> k & 1)) y.d[y.n++] = s.d[k];
    return y;
}

static double sum_terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    dar_shape y = sum_shape(in, n_in, attr);
    return of < 0 ? (double)dar_shape_count(&in[0]) / (double)dar_shape_count(&y) : 1;
}

static dar_tensor with_dims(const dar_opctx *c, const dar_tensor *y)
{
    return dar_tensor_reshape(y, kept_shape(c->x[0].shape, c->attr));
}

static size_t sum_scratch(const dar_opctx *c, bool backward)
{
    dar_tensor y = with_dims(c, &c->y);
    return backward ? 0 : dar_bcast_sum_scratch(&(dar_bcast){ .x = { &c->x[0] }, .y = &y });
}

static void sum_times(const dar_opctx *c, double factor)
{
    dar_tensor y = with_dims(c, &c->y);
    dar_bcast_sum(&(dar_bcast){ .x = { &c->x[0] }, .y = &y, .factor = factor, .scratch = c->scratch });
}

static void spread_times(const dar_opctx *c, double factor)
{
    dar_tensor gy = with_dims(c, &c->gy);
    if (!c->gx[0].data) return;
    dar_bcast_map(&(dar_bcast){ .fn = scale_row, .arg = &factor, .x = { &gy }, .y = &c->gx[0], .add = c->add[0] });
}

static double share(const dar_opctx *c)
{
    return (double)dar_tensor_count(&c->y) / (double)dar_tensor_count(&c->x[0]);
}

static void sum_forward(const dar_opctx *c)
{
    sum_times(c, 1);
}

static void sum_backward(const dar_opctx *c)
{
    spread_times(c, 1);
}

static void mean_forward(const dar_opctx *c)
{
    sum_times(c, share(c));
}

static void mean_backward(const dar_opctx *c)
{
    spread_times(c, share(c));
}

static const struct dims dims_all = { DAR_ALL_DIMS, false }, dims_all_kept = { DAR_ALL_DIMS, true },
                         dims_first = { 1, false }, dims_mid_kept = { 2, true }, dims_last = { 4, false },
                         dims_outer = { 5, false }, dims_nothing = { 0, false }, dims_absent = { 8, false };

static const dar_sample sum_samples[] = {
    { .in = { { 0, { 0 } } }, .attr = &dims_all },
    { .in = { { 3, { 2, 3, 5 } } }, .attr = &dims_all },
    { .in = { { 3, { 2, 3, 5 } } }, .attr = &dims_all_kept },
    { .in = { { 3, { 2, 3, 5 } } }, .attr = &dims_first },
    { .in = { { 3, { 2, 3, 5 } } }, .attr = &dims_mid_kept },
    { .in = { { 3, { 2, 3, 5 } } }, .attr = &dims_last },
    { .in = { { 3, { 2, 3, 5 } } }, .attr = &dims_outer },
    { .in = { { 3, { 2, 3, 5 } } }, .attr = &dims_nothing },
    { .in = { { 2, { 3, 11001 } } }, .attr = &dims_all },
    { .in = { { 3, { 90, 2, 150 } } }, .attr = &dims_first },
    { .in = { { 3, { 4, 300, 5 } } }, .attr = &dims_mid_kept },
    { .in = { { 3, { 2, 200, 37 } } }, .attr = &dims_last },
};

static const dar_error_sample sum_errors[] = { { .in = { { 3, { 2, 3, 5 } } }, .attr = &dims_absent } };

const dar_op dar_op_sum = {
    .name = "sum",
    .n_in = 1,
    .attr_size = sizeof(struct dims),
    .shape = sum_shape,
    .dtype = wide_dtype,
    .scratch = sum_scratch,
    .terms = sum_terms,
    .forward = sum_forward,
    .backward = sum_backward,
    .samples = sum_samples,
    .n_samples = DAR_COUNT(sum_samples),
    .errors = sum_errors,
    .n_errors = DAR_COUNT(sum_errors),
};

const dar_op dar_op_mean = {
    .name = "mean",
    .n_in = 1,
    .attr_size = sizeof(struct dims),
    .shape = sum_shape,
    .dtype = wide_dtype,
    .scratch = sum_scratch,
    .terms = sum_terms,
    .forward = mean_forward,
    .backward = mean_backward,
    .samples = sum_samples,
    .n_samples = DAR_COUNT(sum_samples),
    .errors = sum_errors,
    .n_errors = DAR_COUNT(sum_errors),
};

dar_val *dar_sum(dar_tape *t, dar_val *x, unsigned dims, bool keep)
{
    struct dims d = { dims, keep };
    return dar_apply(t, &dar_op_sum, &x, 1, &d);
}

dar_val *dar_mean(dar_tape *t, dar_val *x, unsigned dims, bool keep)
{
    struct dims d = { dims, keep };
    return dar_apply(t, &dar_op_mean, &x, 1, &d);
}

/* ---------------------------------------------------------------- squared error */

static dar_shape error_shape(const dar_shape *in, int n_in, const void *attr)
{
    char a[96], b[96];
    (void)n_in, (void)attr;
    DAR_ASSERT(dar_shape_equal(&in[0], &in[1]), "squared_error: %s against %s", dar_shape_text(&in[0], a, sizeof a),
               dar_shape_text(&in[1], b, sizeof b));
    if (in[2].n >= 0) {
        dar_shape s = dar_bcast_shape("squared_error", &in[0], &in[2]);
        DAR_ASSERT(dar_shape_equal(&s, &in[0]), "squared_error: weights %s for %s", dar_shape_text(&in[2], b, sizeof b),
                   dar_shape_text(&in[0], a, sizeof a));
    }
    return (dar_shape){ 0 };
}

static double error_terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    (void)n_in, (void)attr;
    return of < 0 ? (double)dar_shape_count(&in[0]) : 1;
}

/* w (x - y)^2; x[2] NULL: w = 1. */
static void error_row(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    (void)arg;
    k->scale(n, -1, x[1], y);
    k->add(n, x[0], y, y);
    k->mul(n, y, y, y);
    if (x[2]) k->mul(n, y, x[2], y);
}

/* arg w (x - y), which may lie where x lies. */
static void slope_row(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    k->scale(n, -1, x[0], y);
    k->add(n, x[1], y, y);
    if (x[2]) k->mul(n, y, x[2], y);
    k->scale(n, -*(const double *)arg, y, y);
}

static dar_bcast error_sum(const dar_opctx *c)
{
    bool mean = *(const bool *)c->attr;
    return (dar_bcast){ .fn = error_row,
                        .x = { &c->x[0], &c->x[1], c->x[2].data ? &c->x[2] : NULL },
                        .y = &c->y,
                        .factor = mean ? 1 / (double)dar_tensor_count(&c->x[0]) : 1,
                        .scratch = c->scratch };
}

static size_t error_scratch(const dar_opctx *c, bool backward)
{
    dar_bcast b = error_sum(c);
    return backward ? 0 : dar_bcast_sum_scratch(&b);
}

static void error_forward(const dar_opctx *c)
{
    dar_bcast b = error_sum(c);
    dar_bcast_sum(&b);
}

static void error_backward(const dar_opctx *c)
{
    dar_bcast b = error_sum(c);
    double slope = 2 * b.factor * dar_dtype_get(c->gy.dtype, c->gy.data, 0);
    b.fn = slope_row;
    b.arg = &slope;
    dar_bcast_opposites(b, &slope, c->gx, c->add);
}

static const bool mean = true, total = false;

static const dar_sample error_samples[] = {
    { .in = { { 1, { 1 } }, { 1, { 1 } }, { -1, { 0 } } }, .attr = &mean },
    { .in = { { 2, { 3, 37 } }, { 2, { 3, 37 } }, { -1, { 0 } } }, .attr = &total },
    { .in = { { 2, { 3, 37 } }, { 2, { 3, 37 } }, { 2, { 3, 37 } } }, .attr = &mean },
    { .in = { { 4, { 2, 3, 5, 2 } }, { 4, { 2, 3, 5, 2 } }, { 4, { 2, 1, 5, 1 } } }, .attr = &total },
    { .in = { { 4, { 2, 3, 5, 2 } }, { 4, { 2, 3, 5, 2 } }, { 0, { 0 } } }, .attr = &mean },
    { .in = { { 2, { 3, 7001 } }, { 2, { 3, 7001 } }, { 2, { 3, 1 } } }, .attr = &mean },
};

static const dar_error_sample error_errors[] = {
    { .in = { { 2, { 3, 5 } }, { 2, { 3, 1 } }, { -1, { 0 } } }, .attr = &mean },
    { .in = { { 2, { 3, 1 } }, { 2, { 3, 1 } }, { 2, { 3, 5 } } }, .attr = &mean },
};

const dar_op dar_op_squared_error = {
    .name = "squared_error",
    .n_in = 3,
    .n_optional = 1,
    .over = true,
    .keep = DAR_KEEP_X(0) | DAR_KEEP_X(1) | DAR_KEEP_X(2),
    .frozen = DAR_KEEP_X(2),
    .attr_size = sizeof(bool),
    .shape = error_shape,
    .dtype = wide_dtype,
    .scratch = error_scratch,
    .terms = error_terms,
    .forward = error_forward,
    .backward = error_backward,
    .samples = error_samples,
    .n_samples = DAR_COUNT(error_samples),
    .errors = error_errors,
    .n_errors = DAR_COUNT(error_errors),
};

dar_val *dar_squared_error(dar_tape *t, dar_val *x, dar_val *target, dar_val *w, bool as_mean)
{
    return dar_apply(t, &dar_op_squared_error, (dar_val *[]){ x, target, w }, 3, &as_mean);
}

/* ---------------------------------------------------------------- softmax */

static dar_shape softmax_shape(const dar_shape *in, int n_in, const void *attr)
{
    char a[96], b[96];
    (void)n_in, (void)attr;
    DAR_ASSERT(in[0].n > 0, "softmax: a scalar");
    if (in[1].n >= 0) {
        dar_shape s = dar_bcast_shape("softmax", &in[0], &in[1]);
        DAR_ASSERT(dar_shape_equal(&s, &in[0]), "softmax: mask %s for %s", dar_shape_text(&in[1], b, sizeof b),
                   dar_shape_text(&in[0], a, sizeof a));
    }
    return in[0];
}

static double softmax_terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    (void)n_in, (void)attr, (void)of;
    return (double)in[0].d[in[0].n - 1];
}

static dar_put softmax_put(const dar_opctx *c)
{
    return dar_put_for(dar_tensor_bytes(&c->y), false);
}

/* A row in arithmetic type, per thread, where y cannot hold it. */
static size_t softmax_scratch(const dar_opctx *c, bool backward)
{
    dar_dtype type = dar_op_compute(c);
    if (backward || (c->y.dtype == type && softmax_put(c) == DAR_PUT)) return 0;
    return dar_mul_size(dar_mul_size(dar_tensor_cols(&c->y), dar_dtype_size(type)), (size_t)c->threads);
}

/* First element of the mask's row for row `row` of x, and its step along it: 0 if one number serves the whole row. */
static size_t mask_row(const dar_tensor *x, const dar_tensor *mask, size_t row, size_t *step)
{
    int n = mask->shape.n;
    size_t first = 0;

    *step = n > 0 && mask->shape.d[n - 1] != 1;
    for (int k = x->shape.n - 2, m = n - 2; m >= 0; k--, m--) {
        if (mask->shape.d[m] != 1) first += row % (size_t)x->shape.d[k] * (size_t)mask->stride[m];
        row /= (size_t)x->shape.d[k];
    }
    return first;
}

/* x + mask: a row of x itself, or in `to`. */
static const void *masked_row(const dar_opctx *c, size_t row, void *to)
{
    const dar_tensor *x = &c->x[0], *mask = &c->x[1];
    dar_dtype type = dar_op_compute(c);
    size_t cols = dar_tensor_cols(x), size = dar_dtype_size(type), xs = dar_dtype_size(x->dtype);
    const char *from = (const char *)x->data + row * cols * xs;

    if (!mask->data) return dar_row_get(type, x->dtype, from, cols, to);
    dar_row_convert(type, to, x->dtype, from, cols);
    size_t step, first = mask_row(x, mask, row, &step);
    double buf[DAR_PIECE];
    for (size_t i = 0; i < cols; i += DAR_PIECE) {
        size_t n = cols - i < DAR_PIECE ? cols - i : DAR_PIECE;
        const void *m = dar_bcast_get(type, mask, first + i * step, step, n, buf);
        dar_kern_for(type)->add(n, (char *)to + i * size, m, (char *)to + i * size);
    }
    return to;
}

static void softmax_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const dar_opctx *c = ctx;
    dar_dtype type = dar_op_compute(c);
    const dar_kern *k = dar_kern_for(type);
    size_t cols = dar_tensor_cols(&c->y), size = dar_dtype_size(c->y.dtype);
    char *buf = (char *)c->scratch + (size_t)thread * cols * dar_dtype_size(type);
    dar_put mode = softmax_put(c);

    for (size_t row = begin; row < end; row++) {
        void *y = (char *)c->y.data + row * cols * size, *e = dar_row_out(type, c->y.dtype, y, mode, buf);
        const void *x = masked_row(c, row, e);
        double sum = k->exp_sum(cols, x, k->max(cols, x), e);
        k->scale(cols, sum == 0 ? 0 : 1 / sum, e, e); /* 0: every element is masked */
        dar_row_put(type, e, c->y.dtype, y, cols, mode);
    }
}

static size_t rows_per_task(const dar_opctx *c)
{
    return 16384 / (dar_tensor_cols(&c->y) + 1) + 1;
}

static void softmax_forward(const dar_opctx *c)
{
    dar_parallel_range(dar_tensor_rows(&c->y), rows_per_task(c), softmax_rows, (void *)(uintptr_t)c);
}

static void softmax_back_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const dar_opctx *c = ctx;
    const dar_tensor *y = &c->y, *gx = &c->gx[0];
    dar_dtype type = dar_op_compute(c);
    const dar_kern *k = dar_kern_for(type);
    size_t cols = dar_tensor_cols(y), size = dar_dtype_size(type), ys = dar_dtype_size(y->dtype);
    dar_put mode = dar_put_for(dar_tensor_bytes(gx), c->add[0]);
    double buf[DAR_PIECE], out[DAR_PIECE];
    (void)thread;

    for (size_t row = begin; row < end; row++) {
        double dot = 0;
        for (int pass = 0; pass < 2; pass++) {
            for (size_t i = 0; i < cols; i += DAR_PIECE) {
                size_t n = cols - i < DAR_PIECE ? cols - i : DAR_PIECE, at = row * cols + i;
                const void *p = dar_row_get(type, y->dtype, (char *)y->data + at * ys, n, buf);
                const void *gy = (char *)c->gy.data + at * size;
                void *dst = (char *)gx->data + at * size, *to = dar_row_out(type, gx->dtype, dst, mode, out);
                if (pass == 0) {
                    dot += k->dot(n, p, gy);
                } else {
                    k->softmax_back(n, p, gy, dot, to);
                    dar_row_put(type, to, gx->dtype, dst, n, mode);
                }
            }
        }
    }
}

static void softmax_backward(const dar_opctx *c)
{
    if (!c->gx[0].data) return;
    dar_parallel_range(dar_tensor_rows(&c->y), rows_per_task(c), softmax_back_rows, (void *)(uintptr_t)c);
}

/* Masks: nothing for the first row, everything for the second, and then every third element. */
static void fill_mask(int input, const dar_tensor *x)
{
    double *v = x->data;
    size_t cols = dar_tensor_cols(x);
    for (size_t i = 0; input == 1 && i < dar_tensor_count(x); i++) {
        size_t row = i / cols;
        if (row == 1 || (row > 1 && i % 3 == 0)) v[i] = -INFINITY;
    }
}

static const dar_sample softmax_samples[] = {
    { .in = { { 1, { 1 } }, { -1, { 0 } } } },
    { .in = { { 2, { 3, 7 } }, { -1, { 0 } } }, .lo = -2, .hi = 2 },
    { .in = { { 2, { 5, 33 } }, { -1, { 0 } } }, .lo = -30, .hi = 30 },
    { .in = { { 3, { 2, 3, 7 } }, { 2, { 3, 7 } } }, .fill = fill_mask },
    { .in = { { 3, { 2, 3, 7 } }, { 3, { 2, 1, 7 } } }, .fill = fill_mask },
    { .in = { { 3, { 2, 3, 7 } }, { 2, { 3, 1 } } }, .fill = fill_mask },
    { .in = { { 2, { 3, 7 } }, { 0, { 0 } } } },
    { .in = { { 2, { 9, 2500 } }, { 1, { 2500 } } }, .lo = -4, .hi = 4 },
};

static const dar_error_sample softmax_errors[] = {
    { .in = { { 0, { 0 } }, { -1, { 0 } } } },
    { .in = { { 2, { 3, 7 } }, { 2, { 7, 3 } } } },
    { .in = { { 1, { 7 } }, { 2, { 3, 7 } } } },
};

const dar_op dar_op_softmax = {
    .name = "softmax",
    .n_in = 2,
    .n_optional = 1,
    .keep = DAR_KEEP_Y,
    .frozen = DAR_KEEP_X(1),
    .shape = softmax_shape,
    .scratch = softmax_scratch,
    .terms = softmax_terms,
    .forward = softmax_forward,
    .backward = softmax_backward,
    .samples = softmax_samples,
    .n_samples = DAR_COUNT(softmax_samples),
    .errors = softmax_errors,
    .n_errors = DAR_COUNT(softmax_errors),
};

dar_val *dar_softmax(dar_tape *t, dar_val *x, dar_val *mask)
{
    return dar_apply(t, &dar_op_softmax, (dar_val *[]){ x, mask }, 2, NULL);
}
