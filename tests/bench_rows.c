/* bench_rows.c: rows of kernels that no op stands for: conversions, scans, 8-bit rows, the optimiser. */
#include "tests/bench.h"

#include "lib/kern.h"
#include "lib/status.h"
#include "lib/thread.h"

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

/* ---------------------------------------------------------------- scans */

static void setup_scan(bench *b)
{
    b->x[0] = bench_tensor(b, b->row->type, DAR_SHAPE(b->s[0], b->s[1]));
    b->bytes[0] = (double)dar_tensor_bytes(&b->x[0]);
}

static void run_nonfinite(bench *b)
{
    DAR_ASSERT(dar_tensor_nonfinite(&b->x[0]) < 0, "nonfinite: found one");
}

static const bench_kind nonfinite = { .part = { "nonfinite" }, .setup = setup_scan, .run = { run_nonfinite } };

/* ---------------------------------------------------------------- 8-bit rows */

static void setup_quantise(bench *b)
{
    b->x[0] = bench_tensor(b, b->row->type, DAR_SHAPE(b->s[0], b->s[1]));
    b->y = bench_tensor(b, DAR_I8, DAR_SHAPE(b->s[0], b->s[1]));
    b->bytes[0] = (double)(dar_tensor_bytes(&b->x[0]) + dar_tensor_bytes(&b->y));
}

static void quantise_rows(void *ctx, size_t begin, size_t end, int thread)
{
    bench *b = ctx;
    size_t n = (size_t)b->s[1], size = dar_dtype_size(b->x[0].dtype);
    (void)thread;
    for (size_t i = begin; i < end; i++)
        b->y.scale[i] =
            dar_row_quantise(b->x[0].dtype, (const char *)b->x[0].data + i * n * size, n, (int8_t *)b->y.data + i * n);
}

static void run_quantise(bench *b)
{
    dar_parallel_range((size_t)b->s[0], 16, quantise_rows, b);
}

static const bench_kind quantise = { .part = { "quantise" }, .setup = setup_quantise, .run = { run_quantise } };

/* ---------------------------------------------------------------- optimiser */

/* The row's type is that of the moments. */
static void setup_adamw(bench *b)
{
    for (int i = 0; i < 4; i++) /* w, m, v, g */
        b->x[i] = bench_tensor(b, i == 1 || i == 2 ? b->row->type : DAR_F32, DAR_SHAPE(b->s[0], b->s[1]));
    dar_tensor_fill(&b->x[2], 0.1);
    for (int i = 0; i < 4; i++) b->bytes[0] += 2.0 * (double)dar_tensor_bytes(&b->x[i]);
}

static void run_adamw(bench *b)
{
    dar_adamw a = {
        .rate = 1e-4, .beta1 = 0.9, .beta2 = 0.999, .eps = 1e-8, .decay = 0.01, .fix1 = 1.5, .fix2 = 20, .scale = 1
    };
    dar_row_adamw(&a, DAR_F32, b->row->type, dar_tensor_count(&b->x[0]), b->x[0].data, b->x[1].data, b->x[2].data,
                  b->x[3].data);
}

static const bench_kind adamw = { .part = { "adamw" }, .setup = setup_adamw, .run = { run_adamw } };

/* ---------------------------------------------------------------- rows */

#define ROW(kind, type, peak, bar)                                                                                     \
    {                                                                                                                  \
        &kind, type, { 8192, 3072 }, peak, { bar }, false                                                              \
    }

const bench_row bench_row_rows[] = {
    ROW(from_f32, DAR_F32, BENCH_COPY, 0),   ROW(from_f32, DAR_BF16, BENCH_COPY, 0),
    ROW(from_f32, DAR_F16, BENCH_COPY, 0),   ROW(to_f32, DAR_BF16, BENCH_COPY, 0),
    ROW(to_f32, DAR_F16, BENCH_COPY, 0),     ROW(quantise, DAR_F32, BENCH_COPY, 0),
    ROW(quantise, DAR_BF16, BENCH_COPY, 0),  ROW(nonfinite, DAR_F32, BENCH_READ, 0),
    ROW(nonfinite, DAR_BF16, BENCH_READ, 0), ROW(adamw, DAR_F32, BENCH_COPY, 0.8),
    ROW(adamw, DAR_BF16, BENCH_COPY, 0),
};
const size_t bench_n_row_rows = DAR_COUNT(bench_row_rows);
