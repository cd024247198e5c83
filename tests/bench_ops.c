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

static const bench_kind silu = { BENCH_OP(silu), .inputs = one, .call = call_silu };

/* ---------------------------------------------------------------- rows */

#define MEMORY BENCH_COPY, { 0.8, 0.8 }, false

const bench_row bench_op_rows[] = {
    { &silu, DAR_F32, { 8192, 3072 }, MEMORY },
    { &silu, DAR_BF16, { 8192, 3072 }, MEMORY },
};
const size_t bench_n_op_rows = DAR_COUNT(bench_op_rows);
