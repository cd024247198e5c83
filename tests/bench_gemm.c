/* bench_gemm.c: rows of matrix products, beside OpenBLAS in f32.  The one file apart from lib/gemm.c that knows BLAS:
 * it is the yardstick. */
#include "tests/bench.h"

#include <cblas.h>

#include "lib/status.h"
#include "lib/thread.h"

/* Sizes of a row: M tokens, N outputs, K inputs of a linear layer. */

/* ---------------------------------------------------------------- OpenBLAS */

/* The operands in f32: A, B, C as the three products of a layer use them. */
struct blas {
    float *x, *w, *y; /* [M, K], [N, K], [M, N] */
};

static void setup_blas(bench *b)
{
    struct blas *p = dar_arena_push(b->arena, sizeof *p);
    p->x = bench_tensor(b, DAR_F32, DAR_SHAPE(b->s[0], b->s[2])).data;
    p->w = bench_tensor(b, DAR_F32, DAR_SHAPE(b->s[1], b->s[2])).data;
    p->y = bench_tensor(b, DAR_F32, DAR_SHAPE(b->s[0], b->s[1])).data;
    b->state = p;
    b->flops[0] = 2.0 * (double)b->s[0] * (double)b->s[1] * (double)b->s[2];
}

const char *bench_blas_core(void)
{
    return openblas_get_corename();
}

/* y = x w^T */
static void blas_nt(bench *b)
{
    const struct blas *p = b->state;
    int M = (int)b->s[0], N = (int)b->s[1], K = (int)b->s[2];
    openblas_set_num_threads(dar_threads());
    cblas_sgemm(CblasRowMajor, CblasNoTrans, CblasTrans, M, N, K, 1, p->x, K, p->w, K, 0, p->y, N);
}

/* gx = gy w */
static void blas_nn(bench *b)
{
    const struct blas *p = b->state;
    int M = (int)b->s[0], N = (int)b->s[1], K = (int)b->s[2];
    openblas_set_num_threads(dar_threads());
    cblas_sgemm(CblasRowMajor, CblasNoTrans, CblasNoTrans, M, K, N, 1, p->y, N, p->w, K, 0, p->x, K);
}

/* gw = gy^T x */
static void blas_tn(bench *b)
{
    const struct blas *p = b->state;
    int M = (int)b->s[0], N = (int)b->s[1], K = (int)b->s[2];
    openblas_set_num_threads(dar_threads());
    cblas_sgemm(CblasRowMajor, CblasTrans, CblasNoTrans, N, K, M, 1, p->y, N, p->x, K, 0, p->w, K);
}

static const bench_kind nt = { .part = { "openblas_nt" }, .setup = setup_blas, .run = { blas_nt } };
static const bench_kind nn = { .part = { "openblas_nn" }, .setup = setup_blas, .run = { blas_nn } };
static const bench_kind tn = { .part = { "openblas_tn" }, .setup = setup_blas, .run = { blas_tn } };

/* ---------------------------------------------------------------- rows */

#define LAYER(kind, type, M, N, K, peak, bar)                                                                          \
    {                                                                                                                  \
        &kind, type, { M, N, K }, peak, { bar }, type == DAR_F32                                                       \
    }
#define LAYERS(kind, type, M, peak, bar)                                                                               \
    LAYER(kind, type, M, 384, 384, peak, bar), LAYER(kind, type, M, 1536, 384, peak, bar),                             \
        LAYER(kind, type, M, 384, 1536, peak, bar), LAYER(kind, type, M, 3072, 3072, peak, bar),                       \
        LAYER(kind, type, M, 14336, 3072, peak, bar), LAYER(kind, type, M, 3072, 14336, peak, bar)

const bench_row bench_product_rows[] = {
    LAYERS(nt, DAR_F32, 2048, BENCH_F32, 0),
    LAYERS(nn, DAR_F32, 2048, BENCH_F32, 0),
    LAYERS(tn, DAR_F32, 2048, BENCH_F32, 0),
};
const size_t bench_n_product_rows = DAR_COUNT(bench_product_rows);
