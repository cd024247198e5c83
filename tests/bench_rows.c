/* bench_rows.c: rows of kernels that no op stands for: copies, conversions. */
#include "tests/bench.h"

#include "lib/kern.h"
#include "lib/status.h"

/* ---------------------------------------------------------------- conversions */

static void setup_copy(bench *b, dar_dtype from, dar_dtype to)
{
    b->x[0] = bench_tensor(b, from, DAR_SHAPE(b->s[0], b->s[1]));
    b->y = bench_tensor(b, to, DAR_SHAPE(b->s[0], b->s[1]));
    b->bytes[0] = (double)(dar_tensor_bytes(&b->x[0]) + dar_tensor_bytes(&b->y));
}

static void setup_from_f32(bench *b)
{
    setup_copy(b, DAR_F32, b->row->type);
}

static void setup_to_f32(bench *b)
{
    setup_copy(b, b->row->type, DAR_F32);
}

static void run_copy(bench *b)
{
    dar_tensor_copy(&b->y, &b->x[0]);
}

static const bench_kind from_f32 = { .part = { "convert_from_f32" }, .setup = setup_from_f32, .run = { run_copy } };
static const bench_kind to_f32 = { .part = { "convert_to_f32" }, .setup = setup_to_f32, .run = { run_copy } };

/* ---------------------------------------------------------------- rows */

#define MEMORY BENCH_COPY, { 0.8 }, false

const bench_row bench_row_rows[] = {
    { &from_f32, DAR_F32, { 8192, 3072 }, MEMORY }, { &from_f32, DAR_BF16, { 8192, 3072 }, MEMORY },
    { &from_f32, DAR_F16, { 8192, 3072 }, MEMORY }, { &to_f32, DAR_BF16, { 8192, 3072 }, MEMORY },
    { &to_f32, DAR_F16, { 8192, 3072 }, MEMORY },
};
const size_t bench_n_row_rows = DAR_COUNT(bench_row_rows);
