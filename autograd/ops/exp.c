/* exp.c: y = e^x, elementwise. */
#include "autograd/bcast.h"
#include "autograd/ops.h"

static dar_shape shape(const dar_shape *in, int n_in, const void *attr)
{
    (void)n_in, (void)attr;
    return in[0];
}

static void exp_row(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    (void)arg;
    k->exp(n, x[0], y);
}

static void product_row(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    (void)arg;
    k->mul(n, x[0], x[1], y);
}

static void forward(const dar_opctx *c)
{
    dar_bcast_map(&(dar_bcast){ .fn = exp_row, .x = { &c->x[0] }, .y = &c->y });
}

static void backward(const dar_opctx *c)
{
    dar_bcast b = { .fn = product_row, .x = { &c->gy, &c->y }, .y = &c->gx[0], .add = c->add[0] };
    if (c->gx[0].data) dar_bcast_map(&b);
}

static const dar_sample samples[] = {
    { .in = { { 1, { 1 } } } },
    { .in = { { 2, { 3, 37 } } }, .lo = -4, .hi = 4 },
    { .in = { { 2, { 5, 4001 } } }, .lo = -4, .hi = 1 },
    { .in = { { 1, { 9 } } }, .lo = -80, .hi = 0 },
};

const dar_op dar_op_exp = {
    .name = "exp",
    .n_in = 1,
    .keep = DAR_KEEP_Y,
    .shape = shape,
    .forward = forward,
    .backward = backward,
    .samples = samples,
    .n_samples = DAR_COUNT(samples),
};

dar_val *dar_exp(dar_tape *t, dar_val *x)
{
    return dar_apply(t, &dar_op_exp, &x, 1, NULL);
}
