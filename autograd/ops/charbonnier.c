/* charbonnier.c: mean of sqrt((x - target)^2 + eps^2): |x - target| with a round corner.  Source: Charbonnier et al.
 * 1994.
 */
#include "autograd/bcast.h"
#include "autograd/ops.h"

static dar_shape shape(const dar_shape *in, int n_in, const void *attr)
{
    char a[96], b[96];
    (void)n_in;
    DAR_ASSERT(*(const double *)attr > 0, "charbonnier: eps %g", *(const double *)attr);
    DAR_ASSERT(dar_shape_equal(&in[0], &in[1]), "charbonnier: %s against %s", dar_shape_text(&in[0], a, sizeof a),
               dar_shape_text(&in[1], b, sizeof b));
    return (dar_shape){ 0 };
}

static dar_dtype wide_dtype(const dar_dtype *in, int n_in, const void *attr)
{
    (void)n_in, (void)attr;
    return dar_compute_type(in[0]);
}

static double terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    (void)n_in, (void)attr;
    return of < 0 ? (double)dar_shape_count(&in[0]) : 1;
}

/* Of d = x - target, from which y = d^2 + eps^2 is made. */
static void square(const dar_kern *k, double eps, size_t n, const void *const *x, void *y)
{
    k->scale(n, -1, x[1], y);
    k->add(n, x[0], y, y);
    k->mul(n, y, y, y);
    k->offset(n, eps * eps, y, y);
}

static void error_row(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    double root[DAR_PIECE];
    DAR_ASSERT(n <= DAR_PIECE, "charbonnier: a piece of %zu", n);
    square(k, *(const double *)arg, n, x, y);
    k->rsqrt(n, y, root);
    k->mul(n, y, root, y);
}

struct slope {
    double eps, factor;
};

static void slope_row(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    const struct slope *s = arg;
    double root[DAR_PIECE];
    DAR_ASSERT(n <= DAR_PIECE, "charbonnier: a piece of %zu", n);
    square(k, s->eps, n, x, y);
    k->rsqrt(n, y, root);
    k->scale(n, -1, x[1], y);
    k->add(n, x[0], y, y);
    k->mul(n, y, root, y);
    k->scale(n, s->factor, y, y);
}

static dar_bcast sum_of(const dar_opctx *c)
{
    return (dar_bcast){ .fn = error_row,
                        .arg = c->attr,
                        .x = { &c->x[0], &c->x[1] },
                        .y = &c->y,
                        .factor = 1 / (double)dar_tensor_count(&c->x[0]),
                        .scratch = c->scratch };
}

static size_t scratch(const dar_opctx *c, bool backward)
{
    dar_bcast b = sum_of(c);
    return backward ? 0 : dar_bcast_sum_scratch(&b);
}

static void forward(const dar_opctx *c)
{
    dar_bcast b = sum_of(c);
    dar_bcast_sum(&b);
}

static void backward(const dar_opctx *c)
{
    dar_bcast b = sum_of(c);
    struct slope s = { *(const double *)c->attr, b.factor * dar_dtype_get(c->gy.dtype, c->gy.data, 0) };
    b.fn = slope_row;
    b.arg = &s;
    dar_bcast_opposites(b, &s.factor, c->gx, c->add);
}

static const double soft = 0.3, sharp = 0.01, flat = 10, none = 0;

/* Far apart with a sharp corner: every slope is 1. */
static void fill_apart(int input, const dar_tensor *x)
{
    double *v = x->data;
    size_t n = dar_tensor_count(x);
    for (size_t i = 0; i < n; i++) v[i] = (input ? 2 : -2) + 0.1 * (double)(i % 5);
}

static const dar_sample samples[] = {
    { .in = { { 1, { 1 } }, { 1, { 1 } } }, .attr = &soft },
    { .in = { { 2, { 3, 37 } }, { 2, { 3, 37 } } }, .attr = &soft },
    { .in = { { 2, { 3, 37 } }, { 2, { 3, 37 } } }, .attr = &flat },
    { .in = { { 3, { 2, 3, 7 } }, { 3, { 2, 3, 7 } } }, .attr = &sharp, .fill = fill_apart },
    { .in = { { 2, { 3, 7001 } }, { 2, { 3, 7001 } } }, .attr = &soft },
};

static const dar_error_sample errors[] = {
    { .in = { { 2, { 3, 5 } }, { 2, { 3, 1 } } }, .attr = &soft },
    { .in = { { 1, { 3 } }, { 1, { 3 } } }, .attr = &none },
};

const dar_op dar_op_charbonnier = {
    .name = "charbonnier",
    .n_in = 2,
    .keep = DAR_KEEP_X(0) | DAR_KEEP_X(1),
    .attr_size = sizeof(double),
    .shape = shape,
    .dtype = wide_dtype,
    .scratch = scratch,
    .terms = terms,
    .forward = forward,
    .backward = backward,
    .samples = samples,
    .n_samples = DAR_COUNT(samples),
    .errors = errors,
    .n_errors = DAR_COUNT(errors),
};

dar_val *dar_charbonnier(dar_tape *t, dar_val *x, dar_val *target, double eps)
{
    return dar_apply(t, &dar_op_charbonnier, (dar_val *[]){ x, target }, 2, &eps);
}
