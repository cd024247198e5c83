/* test_kern.c: every slot of the kernel table, at every CPU level.
 *
 * A kernel that only adds, multiplies, divides and takes roots must give the bits of the f32 reference.  The reference
 * itself is compared with the f64 table, whose text is the same: each rounding of a value of magnitude M is off by
 * M 2^-25 at most, so a kernel that rounds n times on the way to values of at most M is within n M 2^-24.  Functions
 * with exp inside are compared in units in the last place (tests/ulp.h).  Lengths surround every vector width; rows
 * start off alignment; in front of and behind each row lie canaries, which for inputs are NaN. */
#include "tests/test.h"

#include "lib/kern_sets.h"
#include "tests/ulp.h"

#define LONGEST 1000
#define EDGE    32 /* elements of canary on both sides */
#define ROWS    5

static const size_t lengths[] = { 0, 1, 2, 7, 8, 9, 15, 16, 17, 31, 32, 33, 63, 65, LONGEST };
static ulp_tables tables;

/* Rows of one type.  Kernels read and write any of them. */
struct rows {
    dar_dtype type;
    void *row[ROWS];
    double value[6]; /* what a kernel returned */
    _Alignas(64) unsigned char memory[ROWS][(LONGEST + 2 * EDGE + 4) * sizeof(double)];
};

static uint32_t noise(uint32_t i)
{
    uint32_t h = (i + 1) * 2654435769u;
    h = (h ^ h >> 15) * 2246822519u;
    return h ^ h >> 13;
}

/* The same values, which are f32, in rows of either type; row r starts r elements off alignment. */
static void fill(struct rows *s, dar_dtype type, size_t n)
{
    size_t size = dar_dtype_size(type);
    s->type = type;
    memset(s->memory, 0xff, sizeof s->memory);
    memset(s->value, 0, sizeof s->value);
    for (uint32_t r = 0; r < ROWS; r++) {
        s->row[r] = s->memory[r] + (EDGE + r) * size;
        for (uint32_t i = 0; i < n; i++) {
            double x = (float)((int32_t)noise(i * ROWS + r) * 0x1p-31);
            if (r == 4) x = fabs(x); /* second moments */
            dar_dtype_set(type, s->row[r], i, x);
        }
    }
}

static void check_canaries(const struct rows *s, const char *what, size_t n)
{
    size_t size = dar_dtype_size(s->type);
    for (size_t r = 0; r < ROWS; r++) {
        const unsigned char *from = s->row[r], *to = from + n * size;
        for (const unsigned char *p = s->memory[r]; p < s->memory[r] + sizeof s->memory[r]; p++)
            CHECK((p >= from && p < to) || *p == 0xff, "%s of %zu: wrote row %zu at byte %td", what, n, r, p - from);
    }
}

/* ---------------------------------------------------------------- the kernels */

typedef void kernel_call(const dar_kern *k, size_t n, struct rows *s);

#define CALL(NAME, ...)                                                                                                \
    static void call_##NAME(const dar_kern *k, size_t n, struct rows *s)                                               \
    {                                                                                                                  \
        void **x = s->row;                                                                                             \
        double *v = s->value;                                                                                          \
        (void)x, (void)v;                                                                                              \
        __VA_ARGS__;                                                                                                   \
    }

static const dar_adamw adamw = {
    .rate = 0.01, .beta1 = 0.9, .beta2 = 0.99, .eps = 1e-3, .decay = 0.1, .fix1 = 2, .fix2 = 4, .scale = 0.5
};

CALL(relu, k->relu(n, x[0], x[1]))
CALL(relu_back, k->relu_back(n, x[0], x[1], x[2]))
CALL(rsqrt, k->rsqrt(n, x[4], x[1]))
CALL(add, k->add(n, x[0], x[1], x[2]))
CALL(add_in_place, k->add(n, x[0], x[1], x[0]))
CALL(mul, k->mul(n, x[0], x[1], x[2]))
CALL(offset, k->offset(n, 0.7, x[0], x[1]))
CALL(scale, k->scale(n, 0.7, x[0], x[1]))
CALL(axpy, k->axpy(n, 0.7, x[0], x[1]))
CALL(mul_add, k->mul_add(n, x[0], x[1], x[2], x[3]))
CALL(sum, v[0] = k->sum(n, x[0]))
CALL(dot, v[0] = k->dot(n, x[0], x[1]))
CALL(max, v[0] = k->max(n, x[0]))
CALL(nonfinite, v[0] = (double)k->nonfinite(n, x[0]))
CALL(softmax_back, k->softmax_back(n, x[0], x[1], 0.3, x[2]))
CALL(rope, k->rope[s->type](n / 2 * 2, 6, x[0], x[1], x[2], false, false))
CALL(rope_long, k->rope[s->type](n / 2 * 2, 70, x[0], x[1], x[0], true, true))
CALL(adamw, k->adamw(n, &adamw, x[0], x[1], x[4], x[2]))

/* 8-bit rows lie in row 1, as many bytes as elements; f32 ones with flipped signs and those of 16 bits one after the
 * other. */
static const dar_dtype halves[] = { DAR_BF16, DAR_F16 };

CALL(quantise_nothing, k->quantise[DAR_F32](n, x[0], 0, 128, x[1]))
CALL(dequantise, k->quantise[s->type](n, x[0], 0.0081f, 0, x[1]); k->dequantise(n, x[1], 0.0081f, x[2]))

static void call_quantise(const dar_kern *k, size_t n, struct rows *s)
{
    uint16_t buf[LONGEST];
    k->quantise[DAR_F32](n, s->row[0], 0.0081f, 128, s->row[1]);
    for (size_t t = 0; t < DAR_COUNT(halves); t++) {
        dar_row_convert(halves[t], buf, s->type, s->row[0], n);
        k->quantise[halves[t]](n, buf, 0.0081f, 0, (char *)s->row[1] + (t + 1) * n);
    }
}

static void call_max_abs(const dar_kern *k, size_t n, struct rows *s)
{
    uint16_t buf[LONGEST];
    s->value[0] = k->max_abs[s->type](n, s->row[0]);
    for (size_t t = 0; t < DAR_COUNT(halves); t++) {
        dar_row_convert(halves[t], buf, s->type, s->row[0], n);
        s->value[t + 1] = k->max_abs[halves[t]](n, buf);
    }
}

static void call_scale_sums(const dar_kern *k, size_t n, struct rows *s)
{
    static int32_t sum[LONGEST], offset[LONGEST];
    static float b[LONGEST];
    for (uint32_t i = 0; i < n; i++) {
        sum[i] = (int32_t)noise(i) >> 4;
        offset[i] = (int32_t)noise(i + 7) >> 4;
        b[i] = (float)((int32_t)noise(i + 3) * 0x1p-31);
    }
    float a[2] = { 0x1p-29f, 0x1p-30f }, y[LONGEST];
    dar_sums t = { sum, n / 2, offset, a, b };
    k->scale_sums[DAR_F32](2, n / 2, &t, y, n / 2);
    for (size_t i = 0; i < n / 2 * 2; i++) dar_dtype_set(s->type, s->row[2], i, y[i]);
}

/* Row 0 as a matrix, in the table's type or in 16 bits; its columns make more than a strip, its rows more than a run.
 */
static const void *matrix(const dar_kern *k, size_t n, const struct rows *s, dar_dtype t, uint16_t *half)
{
    if (t == s->type) return s->row[0];
    k->put[t](n, s->row[0], half, false);
    return half;
}

static void norm_of(const dar_kern *k, size_t n, struct rows *s, dar_dtype t)
{
    uint16_t half[LONGEST];
    const void *x = matrix(k, n, s, t, half), *w = s->row[2];
    dar_norm p = { .mean = 0.3000000001, .rstd = 0.75 }, weighted = { .mean = 0.3000000001, .rstd = 0.75, .w = w };
    k->moments[t](n, x, true, s->value);
    k->norm_sums[t](n, &p, x, s->row[1], s->value + 2, NULL, NULL);
    k->norm_sums[t](n, &weighted, x, s->row[1], s->value + 4, s->row[3], s->row[4]);
    k->norm_back[t](n, &weighted, x, s->row[1], (double[]){ 0.1, 0.2 }, s->row[2], false);
    k->norm_back[t](n, &p, x, s->row[1], (double[]){ 0.1, 0.2 }, s->row[0], true);
}

static void normed_of(const dar_kern *k, size_t n, struct rows *s, dar_dtype t)
{
    uint16_t half[LONGEST];
    const void *x = matrix(k, n, s, t, half);
    dar_norm p = { .mean = 0.3000000001, .rstd = 0.75 };
    k->norm[t](n, &p, x, s->type, s->row[1], false);
    p.w = s->row[2];
    k->norm[t](n, &p, x, s->type, s->row[4], true);
    p.b = s->row[3];
    k->norm[t](n, &p, x, s->type, s->row[0], true);
    k->moments[s->type](n, s->row[3], false, s->value);
}

/* To 16 bits, which are compared as such. */
static void normed_to(const dar_kern *k, size_t n, struct rows *s, dar_dtype t)
{
    _Alignas(64) uint16_t y[LONGEST];
    dar_norm p = { .mean = 0.3000000001, .rstd = 0.75, .w = s->row[2], .b = s->row[3] };
    k->norm[s->type](n, &p, s->row[0], t, y, true);
    k->get[t](n, y, s->row[0]);
}

static void columns_of(const dar_kern *k, size_t n, struct rows *s, dar_dtype t)
{
    uint16_t half[LONGEST];
    const void *x = matrix(k, n, s, t, half);
    size_t wide = n / 3, high = n / 40;
    k->column_sums[t](3, wide, wide, NULL, x, NULL, s->row[2]);
    k->column_sums[t](high ? 40 : 0, high, high, s->row[1], x, s->row[4], s->row[3]);
    s->value[0] = k->column_back[t](n, 0.7, s->row[1], s->row[4], x, s->row[4], s->row[0], true);
}

static void normed_columns_of(const dar_kern *k, size_t n, struct rows *s, dar_dtype t)
{
    _Alignas(64) uint16_t half[LONGEST];
    const void *x = matrix(k, n, s, t, half);
    k->column_norm[t](n, 0.7, s->row[1], x, t == s->type ? s->row[0] : half, true);
    if (t != s->type) k->get[t](n, half, s->row[0]);
}

/* In place, streamed where n is even. */
static void rotated(const dar_kern *k, size_t n, struct rows *s, dar_dtype t)
{
    _Alignas(64) uint16_t half[LONGEST];
    k->put[t](n, s->row[0], half, false);
    k->rope[t](n / 2 * 2, 64, half, s->row[1], half, n % 4 == 0, n % 2 == 0);
    k->get[t](n, half, s->row[0]);
}

CALL(norm, norm_of(k, n, s, s->type))
CALL(norm_bf16, norm_of(k, n, s, DAR_BF16))
CALL(norm_f16, norm_of(k, n, s, DAR_F16))
CALL(normed, normed_of(k, n, s, s->type))
CALL(normed_bf16, normed_of(k, n, s, DAR_BF16))
CALL(normed_f16, normed_of(k, n, s, DAR_F16))
CALL(normed_to_bf16, normed_to(k, n, s, DAR_BF16))
CALL(normed_to_f16, normed_to(k, n, s, DAR_F16))
CALL(columns, columns_of(k, n, s, s->type))
CALL(columns_bf16, columns_of(k, n, s, DAR_BF16))
CALL(columns_f16, columns_of(k, n, s, DAR_F16))
CALL(normed_columns, normed_columns_of(k, n, s, s->type))
CALL(normed_columns_bf16, normed_columns_of(k, n, s, DAR_BF16))
CALL(normed_columns_f16, normed_columns_of(k, n, s, DAR_F16))
CALL(rope_bf16, rotated(k, n, s, DAR_BF16))
CALL(rope_f16, rotated(k, n, s, DAR_F16))

static const struct {
    const char *name;
    kernel_call *call;
    double bound; /* of the f32 reference against f64: roundings times magnitude; elements are at most 1 */
} exact[] = {
#define EXACT(NAME, BOUND)                                                                                             \
    {                                                                                                                  \
#        NAME, call_##NAME, BOUND                                                                                      \
    }
    EXACT(relu, 0),
    EXACT(relu_back, 0),
    EXACT(rsqrt, 2e5), /* the smallest |x| is above 2^-31 */
    EXACT(add, 2),
    EXACT(add_in_place, 2),
    EXACT(mul, 1),
    EXACT(offset, 2 * 2),
    EXACT(scale, 2),
    EXACT(axpy, 3 * 2),
    EXACT(mul_add, 2 * 2),
    EXACT(sum, 0), /* f64 sums of f32 */
    EXACT(dot, 0),
    EXACT(max, 0),
    EXACT(max_abs, 0),
    EXACT(nonfinite, 0),
    EXACT(softmax_back, 3 * 2),
    EXACT(norm, 6 * LONGEST), /* sums of f32 in f64 */
    EXACT(norm_bf16, 6 * LONGEST),
    EXACT(norm_f16, 6 * LONGEST),
    EXACT(normed, 6 * 2),
    EXACT(normed_bf16, 6 * 2),
    EXACT(normed_f16, 6 * 2),
    EXACT(columns, 38 * LONGEST), /* each of 32 accumulators 31 times, their tree, two products */
    EXACT(columns_bf16, 38 * LONGEST),
    EXACT(columns_f16, 38 * LONGEST),
    EXACT(normed_columns, 2 * 2),
    EXACT(rope, 3 * 2),
    EXACT(rope_long, 3 * 2),
    EXACT(adamw, 40), /* rate fix1 m / (sqrt(v fix2) + eps) is 20 at most; 14 roundings, most of less */
    EXACT(dequantise, 2),
    EXACT(scale_sums, 3),
};

/* Row 1 holds bytes, or row 0 what was rounded to 16 bits: only the bits of f32 are compared. */
static const struct {
    const char *name;
    kernel_call *call;
} bytes[] = {
    { "quantise", call_quantise },
    { "quantise_nothing", call_quantise_nothing },
    { "normed_to_bf16", call_normed_to_bf16 },
    { "normed_to_f16", call_normed_to_f16 },
    { "normed_columns_bf16", call_normed_columns_bf16 },
    { "normed_columns_f16", call_normed_columns_f16 },
    { "rope_bf16", call_rope_bf16 },
    { "rope_f16", call_rope_f16 },
};

static struct rows found, expected, truth;

static void same_as_reference(const char *name, kernel_call *call, size_t n)
{
    fill(&expected, DAR_F32, n);
    call(&tables.f32[0], n, &expected);
    check_canaries(&expected, name, n);
    for (int k = 1; k < tables.n; k++) {
        fill(&found, DAR_F32, n);
        call(&tables.f32[k], n, &found);
        check_canaries(&found, name, n);
        for (size_t r = 0; r < ROWS; r++)
            CHECK(memcmp(found.row[r], expected.row[r], n * sizeof(float)) == 0,
                  "%s of %zu, %s: row %zu is not that of the reference", name, n, tables.f32[k].name, r);
        for (size_t i = 0; i < DAR_COUNT(found.value); i++)
            CHECK(found.value[i] == expected.value[i], "%s of %zu, %s: value %.17g, reference %.17g", name, n,
                  tables.f32[k].name, found.value[i], expected.value[i]);
    }
}

static void exact_kernels(void **state)
{
    (void)state;
    for (size_t c = 0; c < DAR_COUNT(exact); c++)
        for (size_t l = 0; l < DAR_COUNT(lengths); l++) {
            size_t n = lengths[l];
            same_as_reference(exact[c].name, exact[c].call, n);
            fill(&truth, DAR_F64, n);
            exact[c].call(&tables.f64, n, &truth);
            double bound = exact[c].bound * 0x1p-24;
            for (size_t r = 0; r < ROWS; r++)
                for (size_t i = 0; i < n; i++) {
                    if (exact[c].call == call_dequantise && r == 1) continue; /* bytes */
                    CHECK_NEAR(exact[c].name, ((float *)expected.row[r])[i], ((double *)truth.row[r])[i], bound);
                }
            for (size_t i = 0; i < DAR_COUNT(truth.value); i++)
                CHECK(expected.value[i] == truth.value[i] || fabs(expected.value[i] - truth.value[i]) <= bound,
                      "%s of %zu: %.17g, f64 %.17g", exact[c].name, n, expected.value[i], truth.value[i]);
        }
    for (size_t c = 0; c < DAR_COUNT(bytes); c++)
        for (size_t l = 0; l < DAR_COUNT(lengths); l++) same_as_reference(bytes[c].name, bytes[c].call, lengths[l]);
}

/* ---------------------------------------------------------------- functions */

/* Bound, relative to what is computed on the way: f64 at the same arguments, in units of 2^-24 of `magnitude`. */
static void check_function(const char *name, const dar_kern *k, size_t n, const float *y, const double *expect,
                           const double *magnitude)
{
    for (size_t i = 0; i < n; i++)
        CHECK(fabs(y[i] - expect[i]) <= magnitude[i] * 0x1p-24,
              "%s, %s: element %zu is %.9g, expected %.9g, bound %.3g", name, k->name, i, (double)y[i], expect[i],
              magnitude[i] * 0x1p-24);
}

/* exp, tanh, rsqrt and silu: 2 ULP and every length.  The others: the magnitudes of their formulas. */
static void functions(void **state)
{
    (void)state;
    for (int k = 0; k < tables.n; k++)
        for (size_t l = 0; l < DAR_COUNT(lengths); l++) {
            size_t n = lengths[l];
            double m[LONGEST], z[LONGEST];
            dar_kern_map *map[] = { tables.f32[k].gelu_tanh, tables.f32[k].silu, tables.f32[k].exp,
                                    tables.f32[k].tanh };
            dar_kern_map *map64[] = { tables.f64.gelu_tanh, tables.f64.silu, tables.f64.exp, tables.f64.tanh };
            dar_kern_map_back *back[] = { tables.f32[k].gelu_tanh_back, tables.f32[k].silu_back };
            dar_kern_map_back *back64[] = { tables.f64.gelu_tanh_back, tables.f64.silu_back };

            fill(&found, DAR_F32, n);
            fill(&truth, DAR_F64, n);
            tables.f64.scale(n, 9, truth.row[0], truth.row[0]);
            for (size_t i = 0; i < n; i++) {
                ((float *)found.row[0])[i] = (float)((double *)truth.row[0])[i];
                double x = ((double *)truth.row[0])[i] = ((float *)found.row[0])[i];
                z[i] = 2 * sqrt(2 / M_PI) * fabs(x + 0.044715 * x * x * x);
            }
            for (size_t f = 0; f < DAR_COUNT(map); f++) {
                map64[f](n, truth.row[0], truth.row[1]);
                map[f](n, found.row[0], found.row[1]);
                for (size_t i = 0; i < n; i++)
                    m[i] = fabs(((double *)truth.row[1])[i]) * (f == 0 ? 5 * z[i] + 5 : 5); /* 2.5 ULP */
                check_function("function", &tables.f32[k], n, found.row[1], truth.row[1], m);
            }
            for (size_t f = 0; f < DAR_COUNT(back); f++) {
                back64[f](n, truth.row[0], truth.row[2], truth.row[3]);
                back[f](n, found.row[0], found.row[2], found.row[3]);
                for (size_t i = 0; i < n; i++) m[i] = 5 * z[i] + 12; /* s (1 + ..): each factor 2 at most */
                check_function("slope", &tables.f32[k], n, found.row[3], truth.row[3], m);
            }
            for (size_t i = 0; i < n; i++) m[i] = 5 * ((double *)truth.row[1])[i] + 1e-30;
            double s64 = tables.f64.exp_sum(n, truth.row[0], 2, truth.row[1]);
            for (size_t i = 0; i < n; i++) m[i] = (5 + 11) * ((double *)truth.row[1])[i]; /* x - m rounds: 11 2^-24 */
            double s = tables.f32[k].exp_sum(n, found.row[0], 2, found.row[1]);
            check_function("exp_sum", &tables.f32[k], n, found.row[1], truth.row[1], m);
            CHECK_NEAR("sum of exp_sum", s, s64, 16 * 0x1p-24 * s64);
            CHECK_NEAR("masked", tables.f32[k].exp_sum(n, found.row[0], -INFINITY, found.row[1]), 0, 0);
            for (size_t i = 0; i < n; i++) CHECK_NEAR("masked", ((float *)found.row[1])[i], 0, 0);
            check_canaries(&found, "functions", n);
        }
}

/* All numbers of bf16, and rows of some lengths, streamed and not: bits as by way of rows of f32. */
static void activations_of_bf16(void **state)
{
    enum { ALL = 1 << 16 };
    static _Alignas(64) uint16_t x[ALL], y[ALL + 1], expect[ALL];
    static float buf[ALL];
    (void)state;
    for (size_t i = 0; i < ALL; i++) x[i] = (uint16_t)i;
    for (int k = 0; k < tables.n; k++) {
        const dar_kern *f = &tables.f32[k];
        dar_kern_map *map[] = { f->silu, f->gelu_tanh };
        dar_kern_map_stored *stored[] = { f->silu_bf16, f->gelu_tanh_bf16 };
        for (size_t v = 0; v < 2 * DAR_COUNT(map); v++) {
            f->get[DAR_BF16](ALL, x, buf);
            map[v / 2](ALL, buf, buf);
            f->put[DAR_BF16](ALL, buf, expect, false);
            for (size_t l = 0; l <= DAR_COUNT(lengths); l++) {
                size_t n = l < DAR_COUNT(lengths) ? lengths[l] : ALL;
                memset(y, 0x55, sizeof y);
                stored[v / 2](n, x + ALL - n, y, v % 2);
                CHECK(!memcmp(y, expect + ALL - n, n * sizeof *y) && y[n] == 0x5555, "%s, %s of bf16: %zu elements",
                      f->name, v / 2 ? "gelu_tanh" : "silu", n);
            }
        }
    }
}

static void ulps(void **state)
{
    (void)state;
    static ulp_worst worst[ULP_LEVELS][ULP_FUNCTIONS];
    ulp_scan(&tables, 0, 4099, 0x100000000 / 4099 + 1, worst);
    static const uint32_t special[] = { 0,          0x80000000, 1,          0x80000001, 0x007fffff,
                                        0x807fffff, 0x00800000, 0x7f7fffff, 0xff7fffff, 0x7f800000,
                                        0xff800000, 0x7fc00000, 0xffc00000, 0x7f800001 };
    for (size_t i = 0; i < DAR_COUNT(special); i++) ulp_scan(&tables, special[i], 1, 1, worst);
    static const float around[] = { 88.7228f, -87.3365f, -103.972f, -103.279f, 0.625f, 9.01f, -30, -20, 20 };
    for (size_t i = 0; i < DAR_COUNT(around); i++) {
        uint32_t bits;
        memcpy(&bits, &around[i], sizeof bits);
        ulp_scan(&tables, bits - 4096, 1, 8192, worst);
    }
    for (int k = 1; k < tables.n; k++)
        for (int f = 0; f < ULP_FUNCTIONS; f++)
            CHECK(worst[k][f].error <= ulp_bound(f), "%s, %s: %.3g ulp at bits %08x", tables.f32[k].name, ulp_name(f),
                  worst[k][f].error, worst[k][f].at);
}

/* ---------------------------------------------------------------- storage */

/* Every 16-bit pattern and the arguments around every rounding step, to and from; streamed or not, at every offset. */
static void conversions(void **state)
{
    (void)state;
    static const dar_dtype types[] = { DAR_BF16, DAR_F16 };
    for (int k = 0; k < tables.n; k++)
        for (size_t t = 0; t < DAR_COUNT(types); t++)
            for (uint32_t base = 0; base < 65536; base += 61) {
                uint16_t stored[61 + 2], back[61 + 2 + 64];
                float x[61], y[61];
                size_t n = 61 - base % 7, at = base / 61 % 33;
                for (uint32_t i = 0; i < 61; i++) {
                    stored[i + 1] = (uint16_t)(base + i);
                    uint32_t bits = (base + i) << 16 | (noise(base + i) % 5 ? noise(base + i) % 65536 : 0x8000);
                    memcpy(&x[i], &bits, sizeof bits);
                    if (types[t] == DAR_F16)
                        x[i] = dar_f16_to_f32((uint16_t)(base + i)) * (1 + (float)(i % 3) * 0x1p-11f);
                }
                tables.f32[k].get[types[t]](n, stored + 1, y);
                for (size_t i = 0; i < n; i++) {
                    float e = (float)dar_dtype_get(types[t], stored, i + 1);
                    CHECK(memcmp(&e, &y[i], sizeof e) == 0 || (isnan(e) && isnan(y[i])), "%s from %s: %04x",
                          tables.f32[k].name, dar_dtype_name(types[t]), stored[i + 1]);
                }
                memset(back, 0xa5, sizeof back);
                tables.f32[k].put[types[t]](n, x, back + at, base % 2);
                for (size_t i = 0; i < DAR_COUNT(back); i++) {
                    uint16_t e = 0xa5a5;
                    if (i >= at && i < at + n) dar_dtype_set(types[t], &e, 0, x[i - at]);
                    CHECK(back[i] == e, "%s to %s: element %zu, %04x for %04x", tables.f32[k].name,
                          dar_dtype_name(types[t]), i - at, back[i], e);
                }
            }
}

static void streams(void **state)
{
    (void)state;
    for (int k = 0; k < tables.n; k++)
        for (size_t l = 0; l < DAR_COUNT(lengths); l++) {
            fill(&found, DAR_F32, lengths[l]);
            tables.f32[k].put[DAR_F32](lengths[l], found.row[0], found.row[3], true);
            check_canaries(&found, "put", lengths[l]);
            CHECK(memcmp(found.row[0], found.row[3], lengths[l] * sizeof(float)) == 0, "streamed %zu", lengths[l]);
        }
}

/* ---------------------------------------------------------------- reductions and whole rows */

static void reductions_see_everything(void **state)
{
    (void)state;
    float x[100];
    uint16_t half[100];
    for (int k = 0; k < tables.n; k++)
        for (size_t n = 1; n <= 100; n++)
            for (size_t at = 0; at < n; at++) {
                for (size_t i = 0; i < n; i++) x[i] = -3;
                x[at] = -2;
                CHECK_NEAR("max", tables.f32[k].max(n, x), -2, 0);
                x[at] = -5;
                CHECK_NEAR("max_abs", tables.f32[k].max_abs[DAR_F32](n, x), 5, 0);
                x[at] = at % 2 ? NAN : -INFINITY;
                CHECK(tables.f32[k].nonfinite(n, x) == (ptrdiff_t)at, "nonfinite %zu of %zu", at, n);
                CHECK(!isfinite(tables.f32[k].max_abs[DAR_F32](n, x)), "max_abs of %zu: %zu is not finite", n, at);
                for (size_t t = 0; t < DAR_COUNT(halves); t++) {
                    dar_row_convert(halves[t], half, DAR_F32, x, n);
                    CHECK(!isfinite(tables.f32[k].max_abs[halves[t]](n, half)), "max_abs of %zu: %zu is not", n, at);
                }
                if (n > 1) CHECK_NEAR("max", tables.f32[k].max(n, x), -3, 0);
            }
}

/* Second moments of bf16 rows that sums of f32 could not hold: huge, tiny, far from zero, with one element that is not
 * like the others, constant, not finite. */
static void moments_of_any_row(void **state)
{
    (void)state;
    static const double scales[] = { 1, 1e30, 1e-30, 0 }, offsets[] = { 0, 3, 200 }, odd[] = { 0, 1e3, 1e6 };
    static uint16_t x[3000];
    for (int k = 0; k < tables.n; k++)
        for (size_t c = 0; c < DAR_COUNT(scales) * DAR_COUNT(offsets) * DAR_COUNT(odd); c++) {
            size_t o = c / DAR_COUNT(scales), n = DAR_COUNT(x) - c;
            double scale = scales[c % DAR_COUNT(scales)], mean = 0, second = 0, m[2];
            for (uint32_t i = 0; i < n; i++) {
                double v = (int32_t)noise(i) * 0x1p-31 + offsets[o / 3] + (i == 1111 ? odd[o % 3] : 0);
                x[i] = dar_bf16_from_f32((float)(scale == 0 ? 1e6 : v * scale));
                mean += dar_bf16_to_f32(x[i]) / (double)n;
            }
            for (size_t i = 0; i < n; i++) second += pow(dar_bf16_to_f32(x[i]) - mean, 2);
            tables.f32[k].moments[DAR_BF16](n, x, true, m);
            CHECK_NEAR("mean", m[0], mean, (fabs(mean) + sqrt(second / (double)n)) * 0x1p-20);
            CHECK_NEAR("second moment", m[1], second, second * 0x1p-16 + mean * mean * 0x1p-60);
            x[n - 1] = 0x7f80;
            tables.f32[k].moments[DAR_BF16](n, x, true, m);
            CHECK(!isfinite(m[1]), "%s: the second moment of an infinity is %g", tables.f32[k].name, m[1]);
        }
}

static void quantised_rows(void **state)
{
    (void)state;
    static float x[3 * DAR_PIECE];
    static int8_t q[3 * DAR_PIECE];
    for (size_t i = 0; i < DAR_COUNT(x); i++) x[i] = (float)((int32_t)noise((uint32_t)i) * 0x1p-31);
    x[2500] = -2;
    float scale = dar_row_quantise(DAR_F32, x, DAR_COUNT(x), q);
    CHECK_NEAR("scale", scale, (float)(2.0 / 127), 0);
    CHECK_NEAR("largest", q[2500], -127, 0);
    for (size_t i = 0; i < DAR_COUNT(x); i++) CHECK_NEAR("quantised", q[i] * scale, x[i], scale * 0.5001);
    memset(x, 0, sizeof x);
    CHECK_NEAR("scale of zeros", dar_row_quantise(DAR_F32, x, DAR_COUNT(x), q), 0, 0);
    for (size_t i = 0; i < DAR_COUNT(x); i++) CHECK_NEAR("zeros", q[i], 0, 0);
    x[7] = 3e-45f; /* its scale is no number but 0 */
    CHECK_NEAR("scale of a denormal", dar_row_quantise(DAR_F32, x, DAR_COUNT(x), q), 0, 0);
    x[1030] = INFINITY;
    CHECK(isnan(dar_row_quantise(DAR_F32, x, DAR_COUNT(x), q)), "scale of an infinity");
}

/* The whole step against the definition, written out in f64; moments in every storage type, several tasks. */
static void adamw_steps(void **state)
{
    (void)state;
    static const dar_dtype types[] = { DAR_F32, DAR_BF16 };
    static float w[20000], g[20000], m32[20000], v32[20000];
    static uint16_t m16[20000], v16[20000];
    for (size_t t = 0; t < DAR_COUNT(types); t++) {
        void *m = t ? (void *)m16 : m32, *v = t ? (void *)v16 : v32;
        for (uint32_t i = 0; i < DAR_COUNT(w); i++) {
            w[i] = (float)((int32_t)noise(i) * 0x1p-31);
            g[i] = (float)((int32_t)noise(i + 7) * 0x1p-31);
            dar_dtype_set(types[t], m, i, (int32_t)noise(i + 99) * 0x1p-31);
            dar_dtype_set(types[t], v, i, fabs((int32_t)noise(i + 999) * 0x1p-31));
        }
        double wi[3], mi[3], vi[3];
        static const size_t at[] = { 0, 16384, 19999 };
        for (int i = 0; i < 3; i++) {
            double d = g[at[i]] * adamw.scale;
            mi[i] = adamw.beta1 * dar_dtype_get(types[t], m, at[i]) + (1 - adamw.beta1) * d;
            vi[i] = adamw.beta2 * dar_dtype_get(types[t], v, at[i]) + (1 - adamw.beta2) * d * d;
            double step = mi[i] * adamw.fix1 / (sqrt(vi[i] * adamw.fix2) + adamw.eps) + adamw.decay * w[at[i]];
            wi[i] = w[at[i]] - adamw.rate * step;
        }
        dar_row_adamw(&adamw, DAR_F32, types[t], DAR_COUNT(w), w, m, v, g);
        double unit =
            t ? 0x1p-7
              : 0x1p-22; /* a moment is rounded once, up or down, to its type; three roundings before, of 1 at most */
        for (int i = 0; i < 3; i++) {
            CHECK_NEAR("adamw w", w[at[i]], wi[i], 40 * 0x1p-24); /* as for the kernel */
            CHECK_NEAR("adamw m", dar_dtype_get(types[t], m, at[i]), mi[i], unit);
            CHECK_NEAR("adamw v", dar_dtype_get(types[t], v, at[i]), vi[i], unit);
            CHECK_NEAR("adamw g", g[at[i]], 0, 0);
        }
    }
}

static int setup(void **state)
{
    (void)state;
    ulp_tables_init(&tables);
    return 0;
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(exact_kernels),
        cmocka_unit_test(functions),
        cmocka_unit_test(activations_of_bf16),
        cmocka_unit_test(ulps),
        cmocka_unit_test(conversions),
        cmocka_unit_test(streams),
        cmocka_unit_test(reductions_see_everything),
        cmocka_unit_test(quantised_rows),
        cmocka_unit_test(adamw_steps),
        cmocka_unit_test(moments_of_any_row),
    };
    return cmocka_run_group_tests(tests, setup, NULL) != 0;
}
