/* act.c: activations, elementwise. */
#include "autograd/ops.h"
#include "lib/kern.h"
#include "lib/thread.h"

static dar_shape same_shape(const dar_shape *in, int n_in, const void *attr)
{
    (void)n_in, (void)attr;
    return in[0];
}

typedef void act_fn(size_t n, const void *x, void *y);
typedef void act_back_fn(size_t n, const void *x, const void *gy, void *gx, bool add);

struct act {
    const dar_opctx *c;
    dar_dtype type;
    act_fn *fn;
    act_back_fn *back;
};

#define CHUNK (16 * DAR_PIECE) /* elements per task */

static void forward_range(void *ctx, size_t begin, size_t end, int thread)
{
    const struct act *a = ctx;
    const dar_tensor *x = &a->c->x[0], *y = &a->c->y;
    double buf[DAR_PIECE];
    (void)thread;
    for (size_t i = begin; i < end; i += DAR_PIECE) {
        size_t n = end - i < DAR_PIECE ? end - i : DAR_PIECE;
        void *to = y->dtype == a->type ? (char *)y->data + i * dar_dtype_size(y->dtype) : (void *)buf;
        const void *from = dar_row_get(a->type, x->dtype, (char *)x->data + i * dar_dtype_size(x->dtype), n, buf);
        a->fn(n, from, to);
        dar_row_put(a->type, to, y->dtype, (char *)y->data + i * dar_dtype_size(y->dtype), n, false);
    }
}

static void backward_range(void *ctx, size_t begin, size_t end, int thread)
{
    const struct act *a = ctx;
    const dar_tensor *x = &a->c->x[0];
    size_t size = dar_dtype_size(a->type);
    double buf[DAR_PIECE];
    (void)thread;
    for (size_t i = begin; i < end; i += DAR_PIECE) {
        size_t n = end - i < DAR_PIECE ? end - i : DAR_PIECE;
        const void *from = dar_row_get(a->type, x->dtype, (char *)x->data + i * dar_dtype_size(x->dtype), n, buf);
        a->back(n, from, (char *)a->c->gy.data + i * size, (char *)a->c->gx[0].data + i * size, a->c->add[0]);
    }
}

static void act_forward(const dar_opctx *c, act_fn *fn)
{
    struct act a = { c, dar_op_compute(c), fn, NULL };
    dar_parallel_range(dar_tensor_count(&c->y), CHUNK, forward_range, &a);
}

static void act_backward(const dar_opctx *c, act_back_fn *back)
{
    if (!c->gx[0].data) return; /* frozen */
    struct act a = { c, dar_op_compute(c), NULL, back };
    dar_parallel_range(dar_tensor_count(&c->y), CHUNK, backward_range, &a);
}

/* ---------------------------------------------------------------- silu */

static void silu_forward(const dar_opctx *c)
{
    act_forward(c, dar_kern_for(dar_op_compute(c))->silu);
}

static void silu_backward(const dar_opctx *c)
{
    act_backward(c, dar_kern_for(dar_op_compute(c))->silu_back);
}

static const dar_sample silu_samples[] = {
    { .in = { { 1, { 1 } } }, .lo = -1, .hi = 1 },       /* one element */
    { .in = { { 2, { 3, 37 } } }, .lo = -4, .hi = 4 },   /* odd vector tail */
    { .in = { { 1, { 9 } } }, .lo = -80, .hi = 80 },     /* both saturations */
    { .in = { { 2, { 5, 4001 } } }, .lo = -4, .hi = 4 }, /* several chunks */
};

const dar_op dar_op_silu = {
    .name = "silu",
    .n_in = 1,
    .keep = DAR_KEEP_X(0),
    .shape = same_shape,
    .forward = silu_forward,
    .backward = silu_backward,
    .samples = silu_samples,
    .n_samples = DAR_COUNT(silu_samples),
};

dar_val *dar_silu(dar_tape *t, dar_val *x)
{
    return dar_apply(t, &dar_op_silu, &x, 1, NULL);
}
