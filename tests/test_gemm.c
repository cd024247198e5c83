/* test_gemm.c: the matrix product against f64, at every level of the processor. */
#include "tests/test.h"

#include <float.h>
#include <sys/mman.h>

#include "lib/gemm.h"
#include "lib/kern.h"
#include "lib/tensor.h"

#define CANARY 0x7b

static uint64_t seed = 1;

static double uniform(void)
{
    seed = seed * 6364136223846793005u + 1442695040888963407u;
    return (double)(seed >> 11) * 0x1p-52 - 1;
}

static dar_arena arena;

static void *push_random(dar_dtype type, size_t n)
{
    void *x = dar_arena_push(&arena, n * dar_dtype_size(type));
    for (size_t i = 0; i < n; i++) {
        if (type == DAR_I8) ((int8_t *)x)[i] = (int8_t)lrint(127 * uniform());
        else dar_dtype_set(type, x, i, uniform());
    }
    return x;
}

/* Rows one element further apart than they must be: strides that are taken for lengths show. */
static dar_matrix matrix(dar_dtype type, size_t rows, size_t cols, bool t)
{
    dar_matrix x = { .type = type, .t = t, .ld = (t ? rows : cols) + 1 };
    size_t stored = t ? cols : rows;
    x.data = push_random(type, stored * x.ld + 1);
    if (type == DAR_I8) {
        float *scale = push_random(DAR_F32, stored + 1);
        for (size_t i = 0; i < stored; i++) scale[i] = 0.01f + fabsf(scale[i]);
        x.scale = scale;
    }
    return x;
}

static double round_to(dar_tile_kind kind, double x)
{
    if (kind == DAR_TILE_F64) return x;
    return kind == DAR_TILE_BF16 ? dar_bf16_to_f32(dar_bf16_from_f32((float)x)) : (float)x;
}

/* The matrix as the arithmetic sees it, [rows, cols]. */
static double *seen(dar_tile_kind kind, const dar_matrix *x, size_t rows, size_t cols)
{
    double *y = dar_arena_push(&arena, rows * cols * sizeof *y);
    for (size_t i = 0; i < rows; i++)
        for (size_t j = 0; j < cols; j++) {
            size_t row = x->t ? j : i, col = x->t ? i : j, e = row * x->ld + col;
            double v = x->type == DAR_I8 ? x->scale[row] * (float)((const int8_t *)x->data)[e]
                                         : dar_dtype_get(x->type, x->data, e);
            y[i * cols + j] = round_to(kind, v);
        }
    return y;
}

/* Add the products of one term to sum, and their magnitudes to size. */
static void add_term(const dar_gemm *g, const dar_matrix *a, const dar_matrix *b, size_t k, double *sum, double *size)
{
    const double *x = seen(g->kind, a, g->m, k), *y = seen(g->kind, b, k, g->n);
    for (size_t i = 0; i < g->m; i++)
        for (size_t p = 0; p < k; p++)
            for (size_t j = 0; j < g->n; j++) {
                double xy = x[i * k + p] * y[p * g->n + j];
                sum[i * g->n + j] += xy;
                size[i * g->n + j] += fabs(xy);
            }
}

static double eps_of(dar_dtype t)
{
    return t == DAR_F64 ? DBL_EPSILON : t == DAR_F32 ? FLT_EPSILON : t == DAR_BF16 ? 0x1p-8 : 0x1p-11;
}

/* A row kernel for the tests: y = 2 x, exact. */
static void twice_f32(size_t n, const void *x, void *y)
{
    for (size_t i = 0; i < n; i++) ((float *)y)[i] = 2 * ((const float *)x)[i];
}

static void twice_f64(size_t n, const void *x, void *y)
{
    for (size_t i = 0; i < n; i++) ((double *)y)[i] = 2 * ((const double *)x)[i];
}

/* Give g operands, C and scratch; run it; compare every element, and look round C. */
static void check(dar_gemm *g, dar_dtype ta, dar_dtype tb, bool a_t, bool b_t)
{
    dar_mark mark = dar_arena_mark(&arena);
    dar_dtype real = g->kind == DAR_TILE_F64 ? DAR_F64 : DAR_F32;
    size_t size = dar_dtype_size(g->type);

    g->a = matrix(ta, g->m, g->k, a_t);
    g->b = matrix(tb, g->k, g->n, b_t);
    g->a2 = matrix(ta, g->m, g->k2, a_t);
    g->b2 = matrix(real, g->k2, g->n, b_t);
    g->ldc = g->n + 3;
    size_t count = (g->m + 1) * g->ldc;
    char *c = dar_arena_push(&arena, count * size), *before = push_random(g->type, count);
    memcpy(c, before, count * size);
    g->c = c;
    size_t bytes = dar_gemm_scratch(g);
    char *scratch = dar_arena_push(&arena, bytes + 64);
    memset(scratch, CANARY, bytes + 64);
    dar_gemm_run(g, scratch);
    for (size_t i = 0; i < 64; i++) CHECK(scratch[bytes + i] == CANARY, "scratch: wrote past %zu bytes", bytes);

    double *sums = dar_arena_push(&arena, g->m * g->n * sizeof *sums);
    double *sizes = dar_arena_push(&arena, g->m * g->n * sizeof *sizes);
    memset(sums, 0, g->m * g->n * sizeof *sums);
    memset(sizes, 0, g->m * g->n * sizeof *sizes);
    add_term(g, &g->a, &g->b, g->k, sums, sizes);
    add_term(g, &g->a2, &g->b2, g->k2, sums, sizes);
    for (size_t e = 0; e < count; e++) {
        size_t i = e / g->ldc, j = e % g->ldc;
        double want = dar_dtype_get(g->type, before, e), found = dar_dtype_get(g->type, c, e), bound = 0;
        if (i < g->m && j < g->n) {
            double sum = sums[i * g->n + j], abs = sizes[i * g->n + j], old = g->add ? want : 0;
            double bias = g->bias ? dar_dtype_get(g->bias_type, g->bias, j) : 0;
            want = old + g->alpha * sum + bias;
            bound = eps_of(real) * ((double)(g->k + g->k2) + 8) * (fabs(old) + fabs(g->alpha) * abs + fabs(bias));
            if (g->pre) CHECK_NEAR("pre", dar_dtype_get(real, g->pre, i * g->n + j), want, bound);
            if (g->act) want *= 2, bound *= 2;
            if (g->type != real) bound += eps_of(g->type) * fabs(want);
        }
        CHECK(fabs(found - want) <= bound, "%s * %s kind %d m %zu n %zu k %zu+%zu%s%s: C[%zu, %zu] = %.9g, not %.9g",
              dar_dtype_name(ta), dar_dtype_name(tb), (int)g->kind, g->m, g->n, g->k, g->k2, a_t ? " A^T" : "",
              b_t ? " B^T" : "", i, j, found, want);
    }
    dar_arena_reset(&arena, mark);
}

static void each_level(void (*fn)(void))
{
    unsigned level[5];
    int n = test_levels(level);
    assert_int_equal(dar_arena_init(&arena, "test", (size_t)64 << 20, NULL), DAR_OK);
    for (int i = 0; i < n; i++) {
        dar_cpu_init(level[i]);
        fn();
    }
    dar_cpu_init(DAR_CPU_ALL);
    dar_arena_free(&arena);
}

/* Arithmetic and operands.  A kind that the processor has not is left out by the caller. */
static const struct {
    dar_tile_kind kind;
    dar_dtype a, b;
} operands[] = {
    { DAR_TILE_F64, DAR_F64, DAR_F64 },    { DAR_TILE_F64, DAR_F64, DAR_F32 },   { DAR_TILE_F32, DAR_F32, DAR_F32 },
    { DAR_TILE_F32, DAR_F32, DAR_BF16 },   { DAR_TILE_F32, DAR_F16, DAR_F32 },   { DAR_TILE_F32, DAR_F32, DAR_I8 },
    { DAR_TILE_BF16, DAR_BF16, DAR_BF16 }, { DAR_TILE_BF16, DAR_F32, DAR_BF16 }, { DAR_TILE_BF16, DAR_BF16, DAR_F16 },
    { DAR_TILE_BF16, DAR_BF16, DAR_I8 },
};

/* F64 is the same at every level: the lowest stands for all. */
static bool has(dar_tile_kind kind)
{
    if (kind == DAR_TILE_F64) return dar_cpu_flags() == 0;
    return kind != DAR_TILE_BF16 || dar_tile_kind_for(DAR_BF16) == DAR_TILE_BF16;
}

static void small(void)
{
    static const size_t sizes[] = { 0, 1, 2, 7, 8, 9, 31, 33 };
    for (size_t o = 0; o < DAR_COUNT(operands); o++)
        for (size_t s = 0; has(operands[o].kind) && s < 8 * 8; s++)
            for (int t = 0; t < 8; t++) {
                dar_gemm g = { .kind = operands[o].kind, .alpha = 1, .add = t & 4 };
                g.m = sizes[s % 8];
                g.n = sizes[(s / 8 + s) % 8];
                g.k = sizes[s / 8];
                g.type = g.kind == DAR_TILE_F64 ? DAR_F64 : DAR_F32;
                check(&g, operands[o].a, operands[o].b, t & 1, t & 2);
            }
}

/* Round whole tiles, several tasks and several blocks of k. */
static void medium(void)
{
    static const size_t shape[][3] = {
        { 97, 63, 40 },    { 193, 65, 33 }, { 108, 16, 600 }, { 13, 130, 700 },
        { 101, 70, 1100 }, { 200, 17, 31 }, { 1600, 16, 20 },
    };
    for (size_t o = 0; o < DAR_COUNT(operands); o++)
        for (size_t s = 0; has(operands[o].kind) && s < DAR_COUNT(shape); s++)
            for (int t = 0; t < 4; t++) {
                dar_gemm g = { .kind = operands[o].kind, .alpha = 1, .add = s & 1 };
                g.m = shape[s][0];
                g.n = shape[s][1];
                g.k = shape[s][2];
                g.type = g.kind == DAR_TILE_F64 ? DAR_F64 : DAR_F32;
                check(&g, operands[o].a, operands[o].b, t & 1, t & 2);
            }
}

/* Everything that happens to a finished tile, alone and together, with one term and with two. */
static void finishing(void)
{
    static const dar_dtype types[] = { DAR_F32, DAR_BF16, DAR_F16 };
    static const size_t shape[][2] = { { 5, 70 }, { 130, 33 }, { 250, 9 } };
    for (int v = 0; v < 256; v++) {
        dar_mark mark = dar_arena_mark(&arena);
        size_t s = (size_t)v % DAR_COUNT(shape);
        dar_tile_kind kind = v & 1 ? DAR_TILE_F64 : v & 2 && has(DAR_TILE_BF16) ? DAR_TILE_BF16 : DAR_TILE_F32;
        dar_dtype real = kind == DAR_TILE_F64 ? DAR_F64 : DAR_F32;
        dar_gemm g = { .kind = kind, .m = shape[s][0], .n = shape[s][1], .k = 37, .alpha = v & 4 ? -0.75 : 1 };
        g.k2 = v & 8 ? 5 : 0;
        g.type = real == DAR_F64 ? DAR_F64 : types[(size_t)(v / 2) % DAR_COUNT(types)];
        if (v & 16) g.bias = push_random(g.bias_type = v & 2 ? DAR_BF16 : real, g.n);
        if (v & 32) g.pre = push_random(real, g.m * g.n);
        if (v & 64) g.act = real == DAR_F64 ? twice_f64 : twice_f32;
        g.add = !(v & 112);
        check(&g, kind == DAR_TILE_BF16 ? DAR_BF16 : real, kind == DAR_TILE_BF16 ? DAR_BF16 : real, v & 128, v & 4);
        dar_arena_reset(&arena, mark);
    }
}

/* The same bits for 1, 2, 3 and 7 threads. */
static void threads(void)
{
    static const size_t shape[][3] = { { 300, 200, 2100 }, { 16, 500, 300 }, { 500, 16, 300 }, { 40, 40, 40 } };
    int old = dar_threads();
    for (size_t o = 0; o < DAR_COUNT(operands); o++)
        for (size_t s = 0; has(operands[o].kind) && s < DAR_COUNT(shape); s++) {
            dar_mark mark = dar_arena_mark(&arena);
            dar_gemm g = { .kind = operands[o].kind, .m = shape[s][0], .n = shape[s][1], .k = shape[s][2], .alpha = 1 };
            g.a = matrix(operands[o].a, g.m, g.k, s & 2);
            g.b = matrix(operands[o].b, g.k, g.n, s & 1);
            g.type = g.kind == DAR_TILE_F64 ? DAR_F64 : DAR_F32;
            g.ldc = g.n;
            size_t bytes = g.m * g.n * dar_dtype_size(g.type);
            void *first = dar_arena_push(&arena, bytes);
            g.c = dar_arena_push(&arena, bytes);
            static const int count[] = { 1, 2, 3, 7 };
            for (size_t i = 0; i < DAR_COUNT(count); i++) {
                dar_threads_set(count[i]);
                dar_mark inner = dar_arena_mark(&arena);
                dar_gemm_run(&g, dar_arena_push(&arena, dar_gemm_scratch(&g)));
                dar_arena_reset(&arena, inner);
                if (!i) memcpy(first, g.c, bytes);
                CHECK(memcmp(first, g.c, bytes) == 0, "kind %d shape %zu: other bits with %d threads", (int)g.kind, s,
                      count[i]);
            }
            dar_arena_reset(&arena, mark);
        }
    dar_threads_set(old);
}

/* 8 bits times 8 bits: the integers are exact, so only the two scalings and what follows are rounded. */
static void eight_bits(void)
{
    static const size_t shape[][3] = { { 1, 1, 1 }, { 7, 9, 31 }, { 33, 65, 129 }, { 130, 70, 2100 }, { 101, 17, 64 } };
    for (size_t s = 0; s < DAR_COUNT(shape); s++)
        for (int v = 0; v < 4; v++) {
            dar_mark mark = dar_arena_mark(&arena);
            dar_gemm_i8 g = { .m = shape[s][0], .n = shape[s][1], .k = shape[s][2], .type = DAR_F32 };
            g.a_type = v & 1 ? DAR_BF16 : DAR_F32;
            g.lda = g.k + 2;
            g.ldc = g.n + 1;
            const char *a = g.a = push_random(g.a_type, g.m * g.lda);
            const int8_t *w = g.w = push_random(DAR_I8, g.n * g.k);
            float *ws = push_random(DAR_F32, g.n), *c = dar_arena_push(&arena, g.m * g.ldc * sizeof(float));
            int8_t *q = dar_arena_push(&arena, g.k);
            float *bias = v & 2 ? push_random(DAR_F32, g.n) : NULL;
            g.w_scale = ws;
            g.c = c;
            g.bias = bias;
            g.bias_type = DAR_F32;
            for (size_t i = 0; i < g.m; i++) c[i * g.ldc + g.n] = 7;
            dar_gemm_i8_run(&g, dar_arena_push(&arena, dar_gemm_i8_scratch(&g)));
            for (size_t i = 0; i < g.m; i++) {
                float scale = dar_row_quantise(g.a_type, a + i * g.lda * dar_dtype_size(g.a_type), g.k, q);
                for (size_t j = 0; j < g.n; j++) {
                    int64_t sum = 0;
                    for (size_t p = 0; p < g.k; p++) sum += q[p] * w[j * g.k + p];
                    double ab = (double)sum * scale * ws[j], b = bias ? bias[j] : 0;
                    CHECK_NEAR("8 bits", c[i * g.ldc + j], ab + b, FLT_EPSILON * (2 * fabs(ab) + fabs(ab + b)));
                }
                CHECK(c[i * g.ldc + g.n] == 7, "8 bits: wrote past row %zu", i);
            }
            dar_arena_reset(&arena, mark);
        }
}

static void small_shapes(void **state)
{
    (void)state;
    each_level(small);
}

static void medium_shapes(void **state)
{
    (void)state;
    each_level(medium);
}

static void finished_tiles(void **state)
{
    (void)state;
    each_level(finishing);
}

static void eight_bit_products(void **state)
{
    (void)state;
    each_level(eight_bits);
}

static void any_threads(void **state)
{
    (void)state;
    each_level(threads);
}

/* Rows so far apart that offsets pass 2^31 elements, in memory that is reserved but mostly never touched. */
static void far_rows(void **state)
{
    (void)state;
    size_t ld = ((size_t)1 << 30) + 8, bytes = 3 * ld * sizeof(float), n = 9;
    float *x = mmap(NULL, bytes, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    if (x == MAP_FAILED) SKIP("no address space");
    for (size_t i = 0; i < 3; i++)
        for (size_t j = 0; j < n; j++) x[i * ld + j] = (float)(i * n + j + 1);
    assert_int_equal(dar_arena_init(&arena, "test", (size_t)64 << 20, NULL), DAR_OK);
    for (int t = 0; t < 2; t++) { /* x x^T, and x^T x */
        float c[81];
        dar_gemm g = { .kind = DAR_TILE_F32, .m = t ? n : 3, .k = t ? 3 : n, .alpha = 1, .type = DAR_F32, .c = c };
        g.n = g.ldc = g.m;
        g.a = (dar_matrix){ DAR_F32, x, ld, t, NULL };
        g.b = (dar_matrix){ DAR_F32, x, ld, !t, NULL };
        dar_gemm_run(&g, dar_arena_push(&arena, dar_gemm_scratch(&g)));
        for (size_t i = 0; i < g.m; i++)
            for (size_t j = 0; j < g.n; j++) {
                double want = 0;
                for (size_t p = 0; p < g.k; p++)
                    want += (double)x[t ? p * ld + i : i * ld + p] * x[t ? p * ld + j : j * ld + p];
                CHECK_NEAR("far rows", c[i * g.n + j], want, 0); /* small integers: exact */
            }
    }
    dar_arena_free(&arena);
    munmap(x, bytes);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(small_shapes),       cmocka_unit_test(medium_shapes), cmocka_unit_test(finished_tiles),
        cmocka_unit_test(eight_bit_products), cmocka_unit_test(any_threads),   cmocka_unit_test(far_rows),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
