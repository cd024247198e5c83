/* act.c: activations, elementwise: one walk over pieces, and one kernel each. */
#include "autograd/ops.h"
#include "lib/kern.h"
#include "lib/thread.h"

#define CHUNK (64 * DAR_PIECE) /* elements per task */

struct act {
    const dar_opctx *c;
    dar_dtype type;
    dar_put mode; /* of the result */
    dar_kern_map *fn;
    dar_kern_map_stored *bf16; /* fn from and to bf16; NULL: there is none */
    dar_kern_map_back *back;
};

static dar_shape same_shape(const dar_shape *in, int n_in, const void *attr)
{
    (void)n_in, (void)attr;
    return in[0];
}

static void forward_range(void *ctx, size_t begin, size_t end, int thread)
{
    const struct act *a = ctx;
    const dar_tensor *x = &a->c->x[0], *y = &a->c->y;
    double buf[DAR_PIECE];
    (void)thread;
    if (a->bf16 && x->dtype == DAR_BF16 && y->dtype == DAR_BF16) {
        a->bf16(end - begin, dar_tensor_at(x, begin), dar_tensor_at(y, begin), a->mode == DAR_PUT_STREAM);
        return;
    }
    for (size_t i = begin; i < end; i += DAR_PIECE) {
        size_t n = end - i < DAR_PIECE ? end - i : DAR_PIECE;
        void *to = dar_row_out(a->type, y->dtype, dar_tensor_at(y, i), a->mode, buf);
        a->fn(n, dar_row_get(a->type, x->dtype, dar_tensor_at(x, i), n, buf), to);
        dar_row_put(a->type, to, y->dtype, dar_tensor_at(y, i), n, a->mode);
    }
}

static void backward_range(void *ctx, size_t begin, size_t end, int thread)
{
    const struct act *a = ctx;
    const dar_tensor *x = &a->c->x[0], *gy = &a->c->gy, *gx = &a->c->gx[0];
    double buf[DAR_PIECE], gbuf[DAR_PIECE];
    (void)thread;
    for (size_t i = begin; i < end; i += DAR_PIECE) {
        size_t n = end - i < DAR_PIECE ? end - i : DAR_PIECE;
        const void *g = dar_row_get(a->type, gy->dtype, dar_tensor_at(gy, i), n, gbuf);
        void *to = dar_row_out(a->type, gx->dtype, dar_tensor_at(gx, i), a->mode, buf);
        a->back(n, dar_row_get(a->type, x->dtype, dar_tensor_at(x, i), n, buf), g, to);
        dar_row_put(a->type, to, gx->dtype, dar_tensor_at(gx, i), n, a->mode);
    }
}

static void forward(const dar_opctx *c, dar_kern_map *fn, dar_kern_map_stored *bf16)
{
    struct act a = { c, dar_op_compute(c), dar_put_for(dar_tensor_bytes(&c->y), false), fn, bf16, NULL };
    dar_parallel_range(dar_tensor_count(&c->y), CHUNK, forward_range, &a);
}

static void backward(const dar_opctx *c, dar_kern_map_back *back)
{
    if (!c->gx[0].data) return; /* frozen */
    struct act a = { c, dar_op_compute(c), dar_put_for(dar_tensor_bytes(&c->gx[0]), c->add[0]), NULL, NULL, back };
    dar_parallel_range(dar_tensor_count(&c->y), CHUNK, backward_range, &a);
}

/* The op around the kernels `name` and `name`_back, with or without one for BF16, its samples, and its call. */
#define ACT(NAME, BF16, ...)                                                                                           \
    static void NAME##_forward(const dar_opctx *c)                                                                     \
    {                                                                                                                  \
        const dar_kern *k = dar_kern_for(dar_op_compute(c));                                                           \
        forward(c, k->NAME, BF16);                                                                                     \
    }                                                                                                                  \
    static void NAME##_backward(const dar_opctx *c)                                                                    \
    {                                                                                                                  \
        backward(c, dar_kern_for(dar_op_compute(c))->NAME##_back);                                                     \
    }                                                                                                                  \
    static const dar_sample NAME##_samples[] = { __VA_ARGS__ };                                                        \
    const dar_op dar_op_##NAME = {                                                                                     \
        .name = #NAME,                                                                                                 \
        .n_in = 1,                                                                                                     \
        .in_place = true,                                                                                              \
        .half = DAR_KEEP_X(0) | DAR_KEEP_Y,                                                                            \
        .keep = DAR_KEEP_X(0),                                                                                         \
        .shape = same_shape,                                                                                           \
        .forward = NAME##_forward,                                                                                     \
        .backward = NAME##_backward,                                                                                   \
        .samples = NAME##_samples,                                                                                     \
        .n_samples = DAR_COUNT(NAME##_samples),                                                                        \
    };                                                                                                                 \
    dar_val *dar_##NAME(dar_tape *t, dar_val *x)                                                                       \
    {                                                                                                                  \
        return dar_apply(t, &dar_op_##NAME, &x, 1, NULL);                                                              \
    }

#define ONE                                                                                                            \
    {                                                                                                                  \
        .in = { { 1, { 1 } } }, .lo = -1, .hi = 1                                                                      \
    }
#define ODD_TAIL                                                                                                       \
    {                                                                                                                  \
        .in = { { 2, { 3, 37 } } }, .lo = -4, .hi = 4                                                                  \
    }
#define CHUNKS                                                                                                         \
    {                                                                                                                  \
        .in = { { 2, { 5, 4001 } } }, .lo = -4, .hi = 4                                                                \
    }

ACT(silu, k->silu_bf16, ONE, ODD_TAIL, CHUNKS, { .in = { { 1, { 9 } } }, .lo = -80, .hi = 80 } /* both saturations */)
ACT(gelu_tanh, k->gelu_tanh_bf16, ONE, ODD_TAIL, CHUNKS,
    { .in = { { 1, { 9 } } }, .lo = -30, .hi = 30 } /* both saturations */)
ACT(relu, NULL, { .in = { { 1, { 1 } } }, .lo = -1, .hi = 1, .gap = 0.1 },
    { .in = { { 2, { 3, 37 } } }, .lo = -4, .hi = 4, .gap = 0.1 },
    { .in = { { 2, { 5, 4001 } } }, .lo = -4, .hi = 4, .gap = 0.1 })
