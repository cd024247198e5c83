/* shape.c: ops that move values and compute nothing. */
#include "autograd/ops.h"

static dar_shape same_shape(const dar_shape *in, int n_in, const void *attr)
{
    (void)n_in, (void)attr;
    return in[0];
}

/* ---------------------------------------------------------------- contiguous */

static void contiguous_forward(const dar_opctx *c)
{
    dar_tensor_copy(&c->y, &c->x[0]);
}

static void contiguous_backward(const dar_opctx *c)
{
    if (!c->gx[0].data) return;
    if (c->add[0]) dar_tensor_add(&c->gx[0], &c->gy);
    else dar_tensor_copy(&c->gx[0], &c->gy);
}

static const dar_sample contiguous_samples[] = {
    { .in = { { 0 } } },
    { .in = { { 3, { 2, 3, 5 } } } },
};

const dar_op dar_op_contiguous = {
    .name = "contiguous",
    .n_in = 1,
    .strided = true,
    .shape = same_shape,
    .forward = contiguous_forward,
    .backward = contiguous_backward,
    .samples = contiguous_samples,
    .n_samples = DAR_COUNT(contiguous_samples),
};

dar_val *dar_contiguous(dar_tape *t, dar_val *x)
{
    return dar_apply(t, &dar_op_contiguous, &x, 1, NULL);
}
