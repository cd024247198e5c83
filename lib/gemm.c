/* gemm.c: matrices as operands of lib/product.c, and what happens to a finished tile of C. */
#include "lib/gemm.h"

#include <cblas.h>
#include <string.h>

#include "lib/arena.h"
#include "lib/cpu.h"
#include "lib/kern.h"
#include "lib/product.h"
#include "lib/status.h"
#include "lib/thread.h"

/* ---------------------------------------------------------------- tiles by OpenBLAS */

/* OpenBLAS multiplies f64, and f32 where there is no AVX2, one large tile at a time: where threads cut C is our choice,
 * so bits do not depend on their number. */
#define DEF_BLAS(NAME, REAL, GEMM)                                                                                     \
    static void NAME(size_t k, const void *a, size_t a_row, size_t a_k, const void *b, size_t b_k, void *c,            \
                     size_t ldc, size_t m, size_t n, dar_put put)                                                      \
    {                                                                                                                  \
        bool rows = a_k == 1;                                                                                          \
        DAR_ASSERT(ldc < INT32_MAX && a_row < INT32_MAX, "gemm: rows of 2^31 elements are more than OpenBLAS takes");  \
        if (k)                                                                                                         \
            GEMM(CblasRowMajor, rows ? CblasNoTrans : CblasTrans, CblasNoTrans, (int)m, (int)n, (int)k, 1, a,          \
                 (int)(rows ? a_row : a_k), b, (int)b_k, put == DAR_PUT_ADD, c, (int)ldc);                             \
        for (size_t i = 0; !k && put != DAR_PUT_ADD && i < m; i++) memset((REAL *)c + i * ldc, 0, n * sizeof(REAL));   \
    }
DEF_BLAS(mm_dgemm, double, cblas_dgemm)
DEF_BLAS(mm_sgemm, float, cblas_sgemm)

#define BLAS_ROWS 48
#define BLAS_COLS 96

static const dar_tile blas_f64 = { "f64 openblas", DAR_TILE_F64, 1,    8,    BLAS_ROWS, BLAS_COLS,
                                   mm_dgemm,       NULL,         NULL, NULL, NULL };
static const dar_tile blas_f32 = { "f32 openblas", DAR_TILE_F32, 1,    4,    BLAS_ROWS, BLAS_COLS,
                                   mm_sgemm,       NULL,         NULL, NULL, NULL };

static const dar_tile *choose_tile(dar_tile_kind kind, size_t m, size_t n)
{
    if (kind == DAR_TILE_F64) return &blas_f64;
    if (kind == DAR_TILE_F32 && !(dar_cpu_flags() & DAR_CPU_AVX2)) return &blas_f32;
    return dar_tile_fit(kind, m, n);
}

/* ---------------------------------------------------------------- operands */

#define PIECE 64 /* elements along k that are converted from 8 bits at a time */

static void pack_lanes(const dar_tile *t, bool a, bool along, dar_dtype type, const void *src, size_t ld, size_t n,
                       size_t k, void *dst)
{
    if (a) (along ? dar_tile_pack_a_mk : dar_tile_pack_a_km)(t, type, src, ld, n, k, dst);
    else (along ? dar_tile_pack_b_nk : dar_tile_pack_b_kn)(t, type, src, ld, k, n, dst);
}

/* Rows of 8 bits, each with its scale, go through f32, a piece of a stripe at a time. */
static void pack_i8(const dar_matrix *x, const dar_tile *t, bool a, bool along, size_t at, size_t n, size_t k0,
                    size_t k, char *dst)
{
    float buf[BLAS_COLS * PIECE];
    size_t wide = a ? t->mr : t->nr, end = at + n;
    void (*dequantise)(size_t, const int8_t *, float, void *) = dar_kern_for(DAR_F32)->dequantise;
    DAR_ASSERT(wide <= BLAS_COLS, "gemm: a stripe of %zu", wide);
    for (; at < end; at += wide)
        for (size_t p = 0; p < k; p += PIECE) {
            size_t lanes = end - at < wide ? end - at : wide, kn = k - p < PIECE ? k - p : PIECE;
            size_t rows = along ? lanes : kn, cols = along ? kn : lanes;
            size_t row0 = along ? at : k0 + p, col0 = along ? k0 + p : at;
            for (size_t i = 0; i < rows; i++) {
                const int8_t *q = (const int8_t *)x->data + (row0 + i) * x->ld + col0;
                dequantise(cols, q, x->scale[row0 + i], buf + i * cols);
            }
            pack_lanes(t, a, along, DAR_F32, buf, cols, lanes, kn, dst);
            dst += dar_tile_units(t, kn) * wide * t->unit_bytes;
        }
}

static void pack(const dar_matrix *x, const dar_tile *t, bool a, bool along, size_t at, size_t n, size_t k0, size_t k,
                 void *dst)
{
    size_t from = along ? at * x->ld + k0 : k0 * x->ld + at;
    if (x->type == DAR_I8) pack_i8(x, t, a, along, at, n, k0, k, dst);
    else pack_lanes(t, a, along, x->type, (const char *)x->data + from * dar_dtype_size(x->type), x->ld, n, k, dst);
}

/* ctx is the matrix.  Lanes of A are rows of the matrix, lanes of B columns. */
static void pack_a(const void *ctx, const dar_tile *t, size_t at, size_t n, size_t k0, size_t k, void *dst)
{
    const dar_matrix *x = ctx;
    pack(x, t, true, !x->t, at, n, k0, k, dst);
}

static void pack_b(const void *ctx, const dar_tile *t, size_t at, size_t n, size_t k0, size_t k, void *dst)
{
    const dar_matrix *x = ctx;
    pack(x, t, false, x->t, at, n, k0, k, dst);
}

/* A's rows, only converted. */
static void pack_rows_a(const void *ctx, const dar_tile *t, size_t at, size_t n, size_t k0, size_t k, void *dst)
{
    const dar_matrix *x = ctx;
    const char *from = (const char *)x->data + (at * x->ld + k0) * dar_dtype_size(x->type);
    dar_tile_pack_a_rows(t, x->type, from, x->ld, n, k, dst);
}

/* W, stored [n, k] in 8 bits, for an 8-bit tile. */
static void pack_w(const void *ctx, const dar_tile *t, size_t at, size_t n, size_t k0, size_t k, void *dst)
{
    const dar_matrix *x = ctx;
    dar_tile_pack_b_nk(t, DAR_I8, (const int8_t *)x->data + at * x->ld + k0, x->ld, k, n, dst);
}

/* The same for the transposed product: B's columns are the rows of C^T. */
static void pack_columns_a(const void *ctx, const dar_tile *t, size_t at, size_t n, size_t k0, size_t k, void *dst)
{
    const dar_matrix *x = ctx;
    pack(x, t, true, x->t, at, n, k0, k, dst);
}

static void pack_rows_b(const void *ctx, const dar_tile *t, size_t at, size_t n, size_t k0, size_t k, void *dst)
{
    const dar_matrix *x = ctx;
    pack(x, t, false, !x->t, at, n, k0, k, dst);
}

/* A's rows as the tile reads them: consecutive along k, and in whole units. */
static bool lies_ready(const dar_tile *t, const dar_matrix *a, size_t k)
{
    static const dar_dtype of[] = { DAR_F64, DAR_F32, DAR_BF16, DAR_I8 };
    return !a->t && a->type == of[t->kind] && k % t->unit == 0 && a->ld % t->unit == 0;
}

static dar_operand operand_a(const dar_tile *t, const dar_matrix *a, size_t k)
{
    bool ready = lies_ready(t, a, k);
    bool rows = !a->t && dar_tile_takes_rows(t, a->type);
    return (dar_operand){ .pack = rows ? pack_rows_a : pack_a,
                          .many = true,
                          .by_row = rows,
                          .ctx = a,
                          .units = a->data,
                          .in_place = ready,
                          .row = a->ld / t->unit };
}

/* Rows of f32 serve as stripes of B where they lie, if they are whole stripes. */
static dar_operand operand_b(const dar_tile *t, const dar_matrix *b, size_t n, bool flip)
{
    bool ready = t->mm_beside && b->type == DAR_F32 && b->t == flip && n % t->nr == 0;
    return (dar_operand){
        .pack = flip ? pack_rows_b : pack_b, .many = true, .ctx = b, .units = b->data, .in_place = ready, .row = b->ld
    };
}

/* ---------------------------------------------------------------- a finished tile */

/* x = alpha x + bias, kept in pre, then y = act(x) into C: one row of n elements from column j on. */
struct finish {
    double alpha;
    dar_dtype real, type;
    void *c;
    size_t ldc, n;
    bool add;
    const void *bias;
    dar_dtype bias_type;
    void *pre;
    void (*act)(size_t n, const void *x, void *y);
    void (*put)(size_t n, const void *x, void *dst, bool stream); /* real to type */
};

static void finish_row(const struct finish *f, size_t i, size_t j, size_t n, void *x)
{
    size_t size = dar_dtype_size(f->real);
    double bias[BLAS_COLS];
    const void *b = f->bias ? (const char *)f->bias + j * dar_dtype_size(f->bias_type) : NULL;

    if (b) b = dar_row_get(f->real, f->bias_type, b, n, bias);
    if (f->real == DAR_F64) {
        double *y = x;
        for (size_t q = 0; f->alpha != 1 && q < n; q++) y[q] *= f->alpha;
        for (size_t q = 0; b && q < n; q++) y[q] += ((const double *)b)[q];
    } else {
        float *y = x, alpha = (float)f->alpha;
        for (size_t q = 0; f->alpha != 1 && q < n; q++) y[q] *= alpha;
        for (size_t q = 0; b && q < n; q++) y[q] += ((const float *)b)[q];
    }
    if (f->pre) memcpy((char *)f->pre + (i * f->n + j) * size, x, n * size);
    if (f->act) f->act(n, x, x);
    dar_row_put(f->real, x, f->type, (char *)f->c + (i * f->ldc + j) * dar_dtype_size(f->type), n,
                f->add ? DAR_PUT_ADD : DAR_PUT);
}

/* The next tile down will be stored at rows i to i + m: ask for them, since a store that misses holds up the rest. */
static void fetch_rows(const struct finish *f, size_t i, size_t j, size_t m, size_t n)
{
    size_t size = dar_dtype_size(f->type);
    uintptr_t c = (uintptr_t)f->c + (i * f->ldc + j) * size;
    for (size_t r = 0; r < m; r++)
        for (size_t at = 0; at < n * size; at += DAR_ALIGN)
            __builtin_prefetch((const void *)(c + r * f->ldc * size + at), 1);
}

static bool stores_only(const struct finish *f)
{
    return f->alpha == 1 && !f->bias && !f->pre && !f->act && !f->add;
}

static void finish_tile(const void *ctx, size_t i, size_t j, size_t m, size_t n, void *c, size_t ldc)
{
    const struct finish *f = ctx;
    bool plain = stores_only(f);
    size_t size = dar_dtype_size(f->type), row = ldc * dar_dtype_size(f->real);
    char *x = c, *y = (char *)f->c + (i * f->ldc + j) * size;
    if (f->type != f->real) fetch_rows(f, i + m, j, m, n);
    for (size_t r = 0; r < m; r++, x += row, y += f->ldc * size) {
        if (!plain) finish_row(f, i + r, j, n, x);
        else if (x != y) f->put(n, x, y, false);
    }
}

/* The tile holds columns of C as rows. */
static void finish_transposed(const void *ctx, size_t i, size_t j, size_t m, size_t n, void *c, size_t ldc)
{
    const struct finish *f = ctx;
    double row[BLAS_COLS];
    for (size_t q = 0; q < n; q++) {
        if (f->real == DAR_F64)
            for (size_t r = 0; r < m; r++) row[r] = ((const double *)c)[r * ldc + q];
        else
            for (size_t r = 0; r < m; r++) ((float *)row)[r] = ((const float *)c)[r * ldc + q];
        finish_row(f, j + q, i, m, row);
    }
}

/* ---------------------------------------------------------------- the product */

dar_tile_kind dar_gemm_kind(dar_dtype a, dar_dtype b)
{
    if (a == DAR_F64 || b == DAR_F64) return DAR_TILE_F64;
    return a == DAR_BF16 && b == DAR_BF16 ? dar_tile_kind_for(DAR_BF16) : DAR_TILE_F32;
}

/* Few columns and an A that must be packed anyway: C^T = B^T A^T packs it better, as wide stripes of B. */
static bool better_transposed(const dar_gemm *g, const dar_tile *t)
{
    return g->n <= 96 && g->m > 2 * g->n && g->a.t && t->kind != DAR_TILE_F64;
}

static void describe(const dar_gemm *g, struct finish *f, dar_product *p)
{
    const dar_tile *t = choose_tile(g->kind, g->m, g->n);
    dar_dtype real = g->kind == DAR_TILE_F64 ? DAR_F64 : DAR_F32;
    bool flip = better_transposed(g, t);

    *f = (struct finish){ g->alpha, real,    g->type,      g->c,   g->ldc, g->n,
                          g->add,   g->bias, g->bias_type, g->pre, g->act, dar_kern_for(real)->put[g->type] };
    *p = (dar_product){ .tile = t, .m = g->m, .n = g->n, .done = finish_tile, .ctx = f };
    if (flip) {
        *p = (dar_product){ choose_tile(g->kind, g->n, g->m), g->n, g->m, .done = finish_transposed, .ctx = f };
        p->term[0] = (dar_term){ g->k,
                                 { .pack = pack_columns_a, .many = true, .ctx = &g->b },
                                 operand_b(p->tile, &g->a, g->m, true) };
        p->term[1] = (dar_term){ g->k2,
                                 { .pack = pack_columns_a, .many = true, .ctx = &g->b2 },
                                 operand_b(p->tile, &g->a2, g->m, true) };
        return;
    }
    p->term[0] = (dar_term){ g->k, operand_a(t, &g->a, g->k), operand_b(t, &g->b, g->n, false) };
    p->term[1] = (dar_term){ g->k2, operand_a(t, &g->a2, g->k2), operand_b(t, &g->b2, g->n, false) };
    if (g->type == real && !(g->add && g->alpha != 1)) {
        p->direct = true;
        p->c = g->c;
        p->ldc = g->ldc;
        p->add = g->add;
        f->add = false; /* done by the tiles */
        if (g->alpha == 1 && !g->bias && !g->pre && !g->act) p->done = NULL;
    }
}

size_t dar_gemm_scratch(const dar_gemm *g)
{
    struct finish f;
    dar_product p;
    describe(g, &f, &p);
    return dar_product_scratch(&p);
}

void dar_gemm_run(const dar_gemm *g, void *scratch)
{
    struct finish f;
    dar_product p;

    DAR_ASSERT(g->kind != DAR_TILE_I8 && (g->type != DAR_F64 || g->kind == DAR_TILE_F64) && g->type != DAR_I8,
               "gemm: C of type %s from tiles of kind %d", dar_dtype_name(g->type), (int)g->kind);
    DAR_ASSERT(!g->add || !(g->bias || g->pre || g->act), "gemm: add with bias, pre or act");
    describe(g, &f, &p);
    /* OpenBLAS starts threads where it thinks it is alone; inside a task it does not. */
    if ((p.tile == &blas_f64 || p.tile == &blas_f32) && !dar_in_task()) openblas_set_num_threads(1);
    dar_product_run(&p, scratch);
}

/* ---------------------------------------------------------------- 8 bits */

/* Activations are stored as q + 128, so that tiles multiply u8 by s8: sum (q + 128) w = sum q w + 128 sum w. */
struct i8 {
    const dar_gemm_i8 *g;
    struct finish f;
    uint8_t *q;      /* [m, row] */
    size_t row;      /* k in whole units */
    float *scale;    /* [m] */
    int32_t *offset; /* [n]: 128 sum w */
    void (*const *scale_sums)(size_t m, size_t n, const dar_sums *s, void *y, size_t ldy);
    dar_matrix a, b;
};

#define GROUP 4 /* rows quantised together */

/* Scales first: the reduction of a row to one number is a long chain, which the next rows hide. */
static void quantise_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const struct i8 *s = ctx;
    const dar_gemm_i8 *g = s->g;
    size_t row = g->lda * dar_dtype_size(g->a_type);
    (void)thread;
    for (size_t at = begin; at < end; at += GROUP) {
        size_t stop = end - at < GROUP ? end : at + GROUP;
        for (size_t i = at; i < stop; i++) s->scale[i] = dar_row_scale(g->a_type, (const char *)g->a + i * row, g->k);
        for (size_t i = at; i < stop; i++) {
            uint8_t *q = s->q + i * s->row;
            dar_kern_for(DAR_F32)->quantise[g->a_type](g->k, (const char *)g->a + i * row, s->scale[i], 128, q);
            memset(q + g->k, 0, s->row - g->k);
        }
    }
}

/* 256 bytes sum to 16 bits, eight or more at a time. */
static void sum_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const struct i8 *s = ctx;
    (void)thread;
    for (size_t j = begin; j < end; j++) {
        const int8_t *w = s->g->w + j * s->g->k;
        int32_t sum = 0;
        for (size_t p = 0; p < s->g->k; p += 256) {
            size_t n = s->g->k - p < 256 ? s->g->k - p : 256;
            int16_t part = 0;
            for (size_t q = 0; q < n; q++) part = (int16_t)(part + w[p + q]);
            sum += part;
        }
        s->offset[j] = 128 * sum;
    }
}

static void finish_i8(const void *ctx, size_t i, size_t j, size_t m, size_t n, void *c, size_t ldc)
{
    const struct i8 *s = ctx;
    dar_sums sums = { c, ldc, s->offset + j, s->scale + i, s->g->w_scale + j };
    char *y = (char *)s->f.c + (i * s->f.ldc + j) * dar_dtype_size(s->f.type);
    if (stores_only(&s->f)) {
        fetch_rows(&s->f, i + m, j, m, n);
        s->scale_sums[s->f.type](m, n, &sums, y, s->f.ldc);
    } else {
        s->scale_sums[DAR_F32](m, n, &sums, c, ldc);
        finish_tile(&s->f, i, j, m, n, c, ldc);
    }
}

/* Returns the bytes of scratch in front of the product's own. */
static size_t describe_i8(const dar_gemm_i8 *g, struct i8 *s, dar_product *p, char *scratch)
{
    const dar_tile *t = dar_tile_fit(DAR_TILE_I8, g->m, g->n);
    size_t row = (g->k + DAR_ALIGN - 1) / DAR_ALIGN * DAR_ALIGN;
    size_t scale = g->m * row, offset = scale + g->m * sizeof(float), end = offset + g->n * sizeof(int32_t);

    *s = (struct i8){ .g = g, .row = row, .scale_sums = dar_kern_for(DAR_F32)->scale_sums };
    s->f = (struct finish){ 1,     DAR_F32, g->type,      g->c,   g->ldc, g->n,
                            false, g->bias, g->bias_type, g->pre, g->act, dar_kern_for(DAR_F32)->put[g->type] };
    if (scratch) {
        s->q = (uint8_t *)scratch;
        s->scale = (float *)(void *)(scratch + scale);
        s->offset = (int32_t *)(void *)(scratch + offset);
    }
    s->a = (dar_matrix){ DAR_I8, s->q, row, false, NULL };
    s->b = (dar_matrix){ DAR_I8, g->w, g->k, true, NULL };
    *p = (dar_product){ .tile = t, .m = g->m, .n = g->n, .done = finish_i8, .ctx = s };
    p->direct = g->type == DAR_F32; /* the integers are summed where the result will be */
    p->c = g->c;
    p->ldc = g->ldc;
    p->term[0] = (dar_term){ row, operand_a(t, &s->a, row), { .pack = pack_w, .many = true, .ctx = &s->b } };
    p->term[0].k = g->k;
    return (end + DAR_ALIGN - 1) / DAR_ALIGN * DAR_ALIGN;
}

size_t dar_gemm_i8_scratch(const dar_gemm_i8 *g)
{
    struct i8 s;
    dar_product p;
    size_t own = describe_i8(g, &s, &p, NULL);
    return own + dar_product_scratch(&p);
}

void dar_gemm_i8_run(const dar_gemm_i8 *g, void *scratch)
{
    struct i8 s;
    dar_product p;
    DAR_ASSERT(g->k <= 65536, "gemm: %zu products of 8 bits do not fit a 32-bit sum", g->k);
    size_t own = describe_i8(g, &s, &p, scratch);
    dar_parallel_range(g->m, 64, quantise_rows, &s);
    dar_parallel_range(g->n, 64, sum_rows, &s);
    dar_product_run(&p, (char *)scratch + own);
}
