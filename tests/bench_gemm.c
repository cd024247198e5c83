/* bench_gemm.c: rows of matrix products, beside OpenBLAS in f32.  The one file apart from lib/gemm.c that knows BLAS:
 * it is the yardstick. */
#include "tests/bench.h"

#include <cblas.h>

#include "lib/gemm.h"
#include "lib/status.h"
#include "lib/thread.h"

/* A row is a linear layer of M tokens, N outputs, K inputs: x [M, K], w [N, K], y [M, N].  Its three products:
 *
 *   gemm_nt   y  = x w^T      forward
 *   gemm_nn   gx = gy w       gy is f32, whatever x and w are stored as
 *   gemm_tn   gw = gy^T x */
struct layer {
    dar_gemm gemm;
    void *scratch;
    float *c; /* for OpenBLAS */
};

const char *bench_blas_core(void)
{
    return openblas_get_corename();
}

static void count_flops(bench *b)
{
    b->flops[0] = 2.0 * (double)b->s[0] * (double)b->s[1] * (double)b->s[2];
}

/* An operand [rows, columns] as stored; t: used transposed. */
static dar_matrix matrix(bench *b, dar_dtype type, int64_t rows, int64_t columns, bool t)
{
    return (dar_matrix){ type, bench_tensor(b, type, DAR_SHAPE(rows, columns)).data, (size_t)columns, t, NULL };
}

/* C [m, n] = p q over k, stored as type. */
static void setup_product(bench *b, int64_t m, int64_t n, int64_t k, dar_matrix p, dar_matrix q, dar_dtype type)
{
    struct layer *l = dar_arena_push(b->arena, sizeof *l);
    l->gemm = (dar_gemm){ .kind = dar_gemm_kind(b->row->type, b->row->type),
                          .m = (size_t)m,
                          .n = (size_t)n,
                          .k = (size_t)k,
                          .a = p,
                          .b = q,
                          .alpha = 1,
                          .type = type,
                          .c = bench_tensor(b, type, DAR_SHAPE(m, n)).data,
                          .ldc = (size_t)n };
    l->scratch = dar_arena_push(b->arena, dar_gemm_scratch(&l->gemm));
    if (b->row->against_rival) l->c = bench_tensor(b, DAR_F32, DAR_SHAPE(m, n)).data;
    b->state = l;
    count_flops(b);
}

static void setup_nt(bench *b)
{
    int64_t M = b->s[0], N = b->s[1], K = b->s[2];
    dar_dtype t = b->row->type;
    setup_product(b, M, N, K, matrix(b, t, M, K, false), matrix(b, t, N, K, true), t);
}

static void setup_nn(bench *b)
{
    int64_t M = b->s[0], N = b->s[1], K = b->s[2];
    setup_product(b, M, K, N, matrix(b, DAR_F32, M, N, false), matrix(b, b->row->type, N, K, false), DAR_F32);
}

static void setup_tn(bench *b)
{
    int64_t M = b->s[0], N = b->s[1], K = b->s[2];
    setup_product(b, N, K, M, matrix(b, DAR_F32, M, N, true), matrix(b, b->row->type, M, K, false), DAR_F32);
}

static void run_product(bench *b)
{
    const struct layer *l = b->state;
    dar_gemm_run(&l->gemm, l->scratch);
}

static void run_blas(bench *b)
{
    const struct layer *l = b->state;
    const dar_gemm *g = &l->gemm;
    openblas_set_num_threads(dar_threads());
    cblas_sgemm(CblasRowMajor, g->a.t ? CblasTrans : CblasNoTrans, g->b.t ? CblasTrans : CblasNoTrans, (int)g->m,
                (int)g->n, (int)g->k, 1, g->a.data, (int)g->a.ld, g->b.data, (int)g->b.ld, 0, l->c, (int)g->n);
}

/* ---------------------------------------------------------------- 8-bit weights and activations, bf16 outside */

struct layer_i8 {
    dar_gemm_i8 gemm;
    void *scratch;
};

static void setup_i8(bench *b)
{
    int64_t M = b->s[0], N = b->s[1], K = b->s[2];
    struct layer_i8 *l = dar_arena_push(b->arena, sizeof *l);
    dar_tensor w = bench_tensor(b, DAR_I8, DAR_SHAPE(N, K));
    l->gemm = (dar_gemm_i8){ .m = (size_t)M,
                             .n = (size_t)N,
                             .k = (size_t)K,
                             .a_type = DAR_BF16,
                             .a = bench_tensor(b, DAR_BF16, DAR_SHAPE(M, K)).data,
                             .lda = (size_t)K,
                             .w = w.data,
                             .w_scale = w.scale,
                             .type = DAR_BF16,
                             .c = bench_tensor(b, DAR_BF16, DAR_SHAPE(M, N)).data,
                             .ldc = (size_t)N };
    l->scratch = dar_arena_push(b->arena, dar_gemm_i8_scratch(&l->gemm));
    b->state = l;
    count_flops(b);
}

static void run_i8(bench *b)
{
    const struct layer_i8 *l = b->state;
    dar_gemm_i8_run(&l->gemm, l->scratch);
}

/* ---------------------------------------------------------------- rows */

static const bench_kind nt = { .part = { "gemm_nt" }, .setup = setup_nt, .run = { run_product }, .rival = run_blas };
static const bench_kind nn = { .part = { "gemm_nn" }, .setup = setup_nn, .run = { run_product }, .rival = run_blas };
static const bench_kind tn = { .part = { "gemm_tn" }, .setup = setup_tn, .run = { run_product }, .rival = run_blas };
static const bench_kind i8 = { .part = { "gemm_nt" }, .setup = setup_i8, .run = { run_i8 } };

#define LAYER(kind, type, peak, bar, M, N, K)                                                                          \
    {                                                                                                                  \
        &kind, type, { M, N, K }, peak, { bar }, type == DAR_F32                                                       \
    }
#define LAYERS(kind, type, peak, bar, M)                                                                               \
    LAYER(kind, type, peak, bar, M, 384, 384), LAYER(kind, type, peak, bar, M, 1536, 384),                             \
        LAYER(kind, type, peak, bar, M, 384, 1536), LAYER(kind, type, peak, bar, M, 3072, 3072),                       \
        LAYER(kind, type, peak, bar, M, 14336, 3072), LAYER(kind, type, peak, bar, M, 3072, 14336)

/* Down to the rank and up again. */
#define THIN(kind, D, R)                                                                                               \
    LAYER(kind, DAR_F32, BENCH_F32, 0.6, 2048, R, D), LAYER(kind, DAR_F32, BENCH_F32, 0.6, 2048, D, R)
#define THINS(kind)                                                                                                    \
    THIN(kind, 384, 16), THIN(kind, 384, 32), THIN(kind, 384, 64), THIN(kind, 384, 256), THIN(kind, 3072, 16),         \
        THIN(kind, 3072, 32), THIN(kind, 3072, 64), THIN(kind, 3072, 256)

const bench_row bench_product_rows[] = {
    LAYERS(nt, DAR_F32, BENCH_F32, 0.88, 2048),
    LAYERS(nt, DAR_F32, BENCH_F32, 0.88, 8192),
    LAYERS(nn, DAR_F32, BENCH_F32, 0.88, 2048),
    LAYERS(nn, DAR_F32, BENCH_F32, 0.88, 8192),
    LAYERS(tn, DAR_F32, BENCH_F32, 0.88, 2048),
    LAYERS(tn, DAR_F32, BENCH_F32, 0.88, 8192),
    LAYERS(nt, DAR_BF16, BENCH_BF16, 0.86, 2048),
    LAYERS(nt, DAR_BF16, BENCH_BF16, 0.86, 8192),
    LAYERS(nn, DAR_BF16, BENCH_BF16, 0.83, 2048),
    LAYERS(nn, DAR_BF16, BENCH_BF16, 0.83, 8192),
    LAYERS(tn, DAR_BF16, BENCH_BF16, 0.83, 2048),
    LAYERS(tn, DAR_BF16, BENCH_BF16, 0.83, 8192),
    LAYERS(i8, DAR_I8, BENCH_I8, 0.84, 2048),
    LAYERS(i8, DAR_I8, BENCH_I8, 0.84, 8192),
    THINS(nt),
    THINS(nn),
    THINS(tn),
};
const size_t bench_n_product_rows = DAR_COUNT(bench_product_rows);
