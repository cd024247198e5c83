/* test_tile.c: every tile of every level: packing against scalar conversion, products against f64, edges untouched. */
#include "tests/test.h"

#include <float.h>

#include "lib/dtype.h"
#include "lib/tile.h"

#define MOST 80 /* more than any nr */
#define KMAX 70

static uint64_t seed = 1;

static double uniform(void)
{
    seed = seed * 6364136223846793005u + 1442695040888963407u;
    return (double)(seed >> 11) * 0x1p-52 - 1;
}

static const dar_dtype of_kind[] = { DAR_F64, DAR_F32, DAR_BF16, DAR_I8 };

/* Element (lane, k) of a packed stripe as a number. */
static double packed(const dar_tile *t, const void *stripe, size_t wide, size_t lane, size_t k)
{
    size_t at = (k / t->unit * wide + lane) * t->unit + k % t->unit;
    return t->kind == DAR_TILE_I8 ? ((const int8_t *)stripe)[at] : dar_dtype_get(of_kind[t->kind], stripe, at);
}

static double stored(dar_dtype type, const void *x, size_t i)
{
    return type == DAR_I8 ? ((const int8_t *)x)[i] : dar_dtype_get(type, x, i);
}

/* What packing makes of a stored value. */
static double rounded(const dar_tile *t, double x)
{
    if (t->kind == DAR_TILE_F32) return (float)x;
    return t->kind == DAR_TILE_BF16 ? dar_bf16_to_f32(dar_bf16_from_f32((float)x)) : x;
}

typedef void pack_fn(const dar_tile *t, dar_dtype type, const void *src, size_t ld, size_t lanes, size_t k, void *dst);

static void b_kn(const dar_tile *t, dar_dtype type, const void *src, size_t ld, size_t lanes, size_t k, void *dst)
{
    dar_tile_pack_b_kn(t, type, src, ld, k, lanes, dst);
}

static void b_nk(const dar_tile *t, dar_dtype type, const void *src, size_t ld, size_t lanes, size_t k, void *dst)
{
    dar_tile_pack_b_nk(t, type, src, ld, k, lanes, dst);
}

static void check_pack(const dar_tile *t, dar_dtype type, size_t lanes, size_t k, bool along, bool a)
{
    static double src[(MOST + 3) * (MOST + 3)], dst[MOST * MOST];
    pack_fn *fn = a ? along ? dar_tile_pack_a_mk : dar_tile_pack_a_km : along ? b_nk : b_kn;
    size_t wide = a ? t->mr : t->nr, ld = (along ? k : lanes) + 3, rows = along ? lanes : k;
    size_t bytes = a ? dar_tile_bytes_a(t, k) : dar_tile_bytes_b(t, k);

    for (size_t i = 0; i < rows * ld; i++) {
        if (type == DAR_I8) ((int8_t *)src)[i] = (int8_t)(uniform() * 127);
        else dar_dtype_set(type, src, i, uniform());
    }
    memset(dst, 0x7f, sizeof dst);
    fn(t, type, src, ld, lanes, k, dst);
    for (size_t j = 0; j < wide; j++)
        for (size_t p = 0; p < dar_tile_units(t, k) * t->unit; p++) {
            double want = j < lanes && p < k ? rounded(t, stored(type, src, along ? j * ld + p : p * ld + j)) : 0;
            double found = packed(t, dst, wide, j, p);
            CHECK(found == want, "%s %s %s %zu x %zu: lane %zu, k %zu: found %g, expected %g", t->name,
                  dar_dtype_name(type), along ? "along" : "across", lanes, k, j, p, found, want);
        }
    for (size_t i = bytes; i < bytes + 64; i++)
        CHECK(((char *)dst)[i] == 0x7f, "%s: wrote %zu past the stripe", t->name, i - bytes);
}

static void check_packing(const dar_tile *t)
{
    static const dar_dtype floats[] = { DAR_F64, DAR_F32, DAR_BF16, DAR_F16 }, bytes[] = { DAR_I8 };
    static const size_t sizes[] = { 1, 2, 3, 5, 7, 8, 9, 15, 16, 17, 31, 33, KMAX };
    bool i8 = t->kind == DAR_TILE_I8;

    for (size_t i = 0; i < (i8 ? 1 : DAR_COUNT(floats)); i++)
        for (size_t s = 0; s < DAR_COUNT(sizes); s++)
            for (int v = 0; v < 4; v++) {
                size_t wide = v & 1 ? t->mr : t->nr, k = sizes[s];
                size_t lanes[] = { 1, wide / 2, wide - 1, wide };
                for (size_t l = 0; l < DAR_COUNT(lanes); l++)
                    check_pack(t, (i8 ? bytes : floats)[i], lanes[l], k, v & 2, v & 1);
            }
}

/* C of f32, f64 or i32 as a number. */
static double c_at(const dar_tile *t, const void *c, size_t i)
{
    if (t->kind == DAR_TILE_I8) return ((const int32_t *)c)[i];
    return t->kind == DAR_TILE_F64 ? ((const double *)c)[i] : (double)((const float *)c)[i];
}

static double a[MOST * MOST], b[MOST * MOST], before[MOST * MOST];
static _Alignas(64) double c[MOST * MOST];

static void fill_operands(const dar_tile *t)
{
    dar_dtype type = of_kind[t->kind];
    for (size_t i = 0; i < sizeof a / dar_dtype_size(type); i++) {
        if (t->kind == DAR_TILE_I8) {
            ((uint8_t *)a)[i] = (uint8_t)(127.5 + 127.5 * uniform());
            ((int8_t *)b)[i] = (int8_t)(127 * uniform());
        } else {
            dar_dtype_set(type, a, i, uniform());
            dar_dtype_set(type, b, i, uniform());
        }
    }
    for (size_t i = 0; i < 2 * DAR_COUNT(before); i++) {
        if (t->kind == DAR_TILE_I8) ((int32_t *)before)[i] = (int32_t)i;
        else if (t->kind == DAR_TILE_F64) before[i / 2] = uniform();
        else ((float *)before)[i] = (float)uniform();
    }
}

enum way { PACKED, IN_PLACE, TAPS, ROWS, WAYS };

/* One product; packed A, or A read where it lies (rows of units + 1), or B read at three places, or rows of A that
 * overlap and begin anywhere.  Rows of C are aligned if it is streamed. */
static void check_mm(const dar_tile *t, size_t m, size_t n, size_t k, enum way way, dar_put put)
{
    static const char *const how[] = { "", " add", " stream" }, *const ways[] = { "", " in place", " taps", " rows" };
    static const size_t places[] = { 5, 0, 3 }, here[] = { 0 };
    size_t taps = way == TAPS ? DAR_COUNT(places) : 1, b_k = way == TAPS ? t->nr + 7 : t->nr;
    size_t units = dar_tile_units(t, k), a_row = way == PACKED ? 1 : units * taps + 1, a_k = way == PACKED ? t->mr : 1;
    size_t ldc = put == DAR_PUT_STREAM ? n / 16 * 16 + 16 : n + 3;
    const size_t *at = way == TAPS ? places : here;
    size_t begin[MOST];
    double eps = t->kind == DAR_TILE_F64 ? DBL_EPSILON : t->kind == DAR_TILE_I8 ? 0 : FLT_EPSILON;

    for (size_t i = 0; i < m; i++) begin[i] = way == ROWS ? 7 * i % 31 : i * a_row * t->unit;
    memcpy(c, before, sizeof c);
    if (way == TAPS) t->mm_taps(units, taps, at, a, a_row, b, b_k, c, ldc, m, n, put);
    else if (way == ROWS) t->mm_rows(units, a, begin, b, b_k, c, ldc, m, n, put);
    else t->mm(units, a, a_row, a_k, b, b_k, c, ldc, m, n, put);
    for (size_t i = 0; i < (m + 1) * ldc; i++) {
        size_t row = i / ldc, col = i % ldc;
        bool inside = row < m && col < n;
        double want = inside && put != DAR_PUT_ADD ? 0 : c_at(t, before, i), size = fabs(want);
        for (size_t p = 0; inside && p < units * taps * t->unit; p++) {
            size_t u = p / t->unit, from = begin[row] + u * a_k * t->unit + p % t->unit;
            double x = t->kind == DAR_TILE_I8 ? ((uint8_t *)a)[from] : stored(of_kind[t->kind], a, from);
            double y = packed(t, b, b_k, at[u % taps] + col, u / taps * t->unit + p % t->unit);
            want += x * y;
            size += fabs(x * y);
        }
        double found = c_at(t, c, i), bound = inside ? eps * (double)(k * taps + 8) * size : 0;
        CHECK(fabs(found - want) <= bound, "%s m %zu n %zu k %zu%s%s: C[%zu, %zu] = %g, expected %g", t->name, m, n, k,
              ways[way], how[put], row, col, found, want);
    }
}

static void check_products(const dar_tile *t)
{
    static const size_t depths[] = { 0, 1, 2, 7, 8, 9, 33 };
    size_t rows[] = { 1, t->mr - 1, t->mr }, cols[] = { 1, 7, t->nr / 2, t->nr - 1, t->nr };
    fill_operands(t);
    for (size_t i = 0; i < DAR_COUNT(rows); i++)
        for (size_t j = 0; j < DAR_COUNT(cols); j++)
            for (size_t k = 0; k < DAR_COUNT(depths); k++)
                for (int v = 0; v < 3 * WAYS; v++)
                    if (v % WAYS < TAPS || t->mm_taps)
                        check_mm(t, rows[i], cols[j], depths[k], v % WAYS, (dar_put)(v / WAYS));
}

/* Each distinct tile that dar_tile_fit gives for some shape, at every level. */
static void each_tile(void (*check)(const dar_tile *t))
{
    unsigned level[5];
    int levels = test_levels(level);
    for (int l = 0; l < levels; l++) {
        dar_cpu_init(level[l]);
        for (int kind = 0; kind < DAR_TILE_KINDS; kind++) {
            static const size_t shape[][2] = { { 6, 64 }, { 8, 48 }, { 12, 32 }, { 12, 16 }, { 12, 8 } };
            const dar_tile *seen[DAR_COUNT(shape)] = { 0 };
            if (kind == DAR_TILE_BF16 && dar_tile_kind_for(DAR_BF16) != DAR_TILE_BF16) continue;
            for (size_t i = 0; i < DAR_COUNT(shape); i++) {
                const dar_tile *t = dar_tile_fit(kind, shape[i][0], shape[i][1]);
                size_t j = 0;
                while (j < i && seen[j] != t) j++;
                seen[i] = t;
                if (j == i) check(t);
            }
        }
    }
    dar_cpu_init(DAR_CPU_ALL);
}

static void packing(void **state)
{
    (void)state;
    each_tile(check_packing);
}

static void products(void **state)
{
    (void)state;
    each_tile(check_products);
}

static void thin_tiles(void **state)
{
    (void)state;
    if (!(dar_cpu_flags() & DAR_CPU_AVX512)) SKIP("needs AVX-512");
    static const size_t widths[] = { 16, 32, 48, 64, 128, 384 };
    for (size_t i = 0; i < DAR_COUNT(widths); i++) {
        const dar_tile *t = dar_tile_for(DAR_TILE_F32, widths[i]);
        CHECK(widths[i] % t->nr == 0, "%zu columns get %s", widths[i], t->name);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(packing),
        cmocka_unit_test(products),
        cmocka_unit_test(thin_tiles),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
