/* bench_ops.c: rows of ops, forward and backward, as a network calls them. */
#include "tests/bench.h"

#include "lib/status.h"

/* ---------------------------------------------------------------- elementwise */

static void one(bench *b)
{
    bench_input(b, b->row->type, DAR_SHAPE(b->s[0], b->s[1]), true);
}

static dar_val *call_silu(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_silu(t, x[0]);
}

static dar_val *call_gelu_tanh(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_gelu_tanh(t, x[0]);
}

static dar_val *call_relu(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_relu(t, x[0]);
}

static const bench_kind silu = { BENCH_OP(silu), .inputs = one, .call = call_silu };
static const bench_kind gelu_tanh = { BENCH_OP(gelu_tanh), .inputs = one, .call = call_gelu_tanh };
static const bench_kind relu = { BENCH_OP(relu), .inputs = one, .call = call_relu };

/* ---------------------------------------------------------------- shape: heads to the front, a slice, a concatenation
 */

static void heads(bench *b)
{
    bench_input(b, b->row->type, DAR_SHAPE(b->s[0], b->s[1], b->s[2]), true);
}

static dar_val *call_permute(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_contiguous(t, dar_permute(t, x[0], (int[]){ 1, 0, 2 }));
}

static dar_val *call_transpose(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_contiguous(t, dar_permute(t, x[0], (int[]){ 1, 0 }));
}

static const bench_kind permute = { .part = { "permute" },
                                    .setup = bench_op_setup,
                                    .run = { bench_op_forward },
                                    .reset = bench_op_reset,
                                    .op = &dar_op_contiguous,
                                    .inputs = heads,
                                    .call = call_permute };
static const bench_kind transpose = { .part = { "transpose" },
                                      .setup = bench_op_setup,
                                      .run = { bench_op_forward },
                                      .reset = bench_op_reset,
                                      .op = &dar_op_contiguous,
                                      .inputs = one,
                                      .call = call_transpose };

/* ---------------------------------------------------------------- rows */

#define MEMORY BENCH_COPY, { 0.8, 0.8 }, false

/* Larger than the caches, in the two types that networks use. */
#define STREAM(kind, ...)                                                                                              \
    { &kind, DAR_F32, { __VA_ARGS__ }, MEMORY },                                                                       \
    {                                                                                                                  \
        &kind, DAR_BF16, { __VA_ARGS__ }, MEMORY                                                                       \
    }

const bench_row bench_op_rows[] = {
    STREAM(silu, 8192, 3072),       STREAM(gelu_tanh, 8192, 3072), STREAM(relu, 8192, 3072),
    STREAM(permute, 8192, 24, 128), STREAM(transpose, 8192, 3072),
};
const size_t bench_n_op_rows = DAR_COUNT(bench_op_rows);
