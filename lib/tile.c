/* tile.c: the table of tiles, and packing. */
#include "lib/tile.h"

#include <string.h>

#include "lib/cpu.h"
#include "lib/kern_tiles.h"
#include "lib/status.h"

/* ---------------------------------------------------------------- reference tiles */

/* Unit (i, k) of A at rows[i] elements, if there are rows, else i a_row units, and k a_k units. */
#define DEF_MM(NAME, A, B, C, UNIT)                                                                                    \
    static inline void NAME##_any(size_t k, size_t taps, const size_t *at, const A *a, const size_t *rows,             \
                                  size_t a_row, size_t a_k, const B *b, size_t b_k, C *c, size_t ldc, size_t m,        \
                                  size_t n, dar_put put)                                                               \
    {                                                                                                                  \
        for (size_t i = 0; i < m; i++)                                                                                 \
            for (size_t j = 0; j < n; j++) {                                                                           \
                const A *row = a + (rows ? rows[i] : i * a_row * UNIT);                                                \
                C sum = 0;                                                                                             \
                for (size_t p = 0; p < k; p++)                                                                         \
                    for (size_t s = 0; s < taps; s++)                                                                  \
                        for (size_t u = 0; u < UNIT; u++)                                                              \
                            sum += (C)row[(p * taps + s) * a_k * UNIT + u] * (C)b[(p * b_k + at[s] + j) * UNIT + u];   \
                c[i * ldc + j] = put == DAR_PUT_ADD ? c[i * ldc + j] + sum : sum;                                      \
            }                                                                                                          \
    }                                                                                                                  \
    static void NAME(size_t k, const void *a, size_t a_row, size_t a_k, const void *b, size_t b_k, void *c,            \
                     size_t ldc, size_t m, size_t n, dar_put put)                                                      \
    {                                                                                                                  \
        NAME##_any(k, 1, (const size_t[]){ 0 }, a, NULL, a_row, a_k, b, b_k, c, ldc, m, n, put);                       \
    }
#define DEF_MM_CONV(NAME)                                                                                              \
    static void NAME##_taps(size_t k, size_t taps, const size_t *at, const void *a, size_t a_row, const void *b,       \
                            size_t b_k, void *c, size_t ldc, size_t m, size_t n, dar_put put)                          \
    {                                                                                                                  \
        NAME##_any(k, taps, at, a, NULL, a_row, 1, b, b_k, c, ldc, m, n, put);                                         \
    }                                                                                                                  \
    static void NAME##_rows(size_t k, const void *a, const size_t *rows, const void *b, size_t b_k, void *c,           \
                            size_t ldc, size_t m, size_t n, dar_put put)                                               \
    {                                                                                                                  \
        NAME##_any(k, 1, (const size_t[]){ 0 }, a, rows, 0, 1, b, b_k, c, ldc, m, n, put);                             \
    }
DEF_MM(mm_f64, double, double, double, 1)
DEF_MM(mm_f32, float, float, float, 1)
DEF_MM(mm_i8, uint8_t, int8_t, int32_t, 4)
DEF_MM_CONV(mm_f64)
DEF_MM_CONV(mm_f32)

static const dar_tile ref[] = {
    { "f64 4x16 ref", DAR_TILE_F64, 1, 8, 4, 16, mm_f64, NULL, NULL, mm_f64_taps, mm_f64_rows },
    { "f32 4x16 ref", DAR_TILE_F32, 1, 4, 4, 16, mm_f32, NULL, NULL, mm_f32_taps, mm_f32_rows },
    { "i8 4x16 ref", DAR_TILE_I8, 4, 4, 4, 16, mm_i8, NULL, NULL, NULL, NULL },
};

/* ---------------------------------------------------------------- the table */

static dar_tile_set table[DAR_TILE_KINDS];

void dar_tile_init(unsigned cpu_flags)
{
    memset(table, 0, sizeof table);
    for (size_t i = 0; i < DAR_COUNT(ref); i++) table[ref[i].kind] = (dar_tile_set){ &ref[i], 1 };
#if defined __x86_64__
    if (cpu_flags & DAR_CPU_AVX2) table[DAR_TILE_F32] = dar_tiles_f32_avx2, table[DAR_TILE_I8] = dar_tiles_i8_avx2;
    if (cpu_flags & DAR_CPU_AVX512) table[DAR_TILE_F32] = dar_tiles_f32_avx512;
    if (cpu_flags & DAR_CPU_BF16) table[DAR_TILE_BF16] = dar_tiles_bf16;
    if (cpu_flags & DAR_CPU_VNNI) table[DAR_TILE_I8] = dar_tiles_i8_vnni;
#else
    (void)cpu_flags;
#endif
}

dar_tile_kind dar_tile_kind_for(dar_dtype t)
{
    if (t == DAR_F64) return DAR_TILE_F64;
    return t == DAR_BF16 && (dar_cpu_flags() & DAR_CPU_BF16) ? DAR_TILE_BF16 : DAR_TILE_F32;
}

/* x rounded up to whole stripes of s. */
static double whole(size_t x, size_t s)
{
    return (double)(x / s + (x % s != 0)) * (double)s;
}

/* Least work, counting what lies in stripes but outside [m, n]; the widest of equals, since a wide tile reads least. */
const dar_tile *dar_tile_fit(dar_tile_kind kind, size_t m, size_t n)
{
    dar_cpu_flags(); /* fills the table at first use */
    const dar_tile *best = NULL;
    double least = 0;

    for (int i = 0; i < table[kind].n; i++) {
        const dar_tile *t = &table[kind].of[i];
        double work = whole(m, t->mr) * whole(n, t->nr);
        if (!best || work < least) best = t, least = work;
    }
    DAR_ASSERT(best, "tile: kind %d is not to be had on this processor", (int)kind);
    return best;
}

const dar_tile *dar_tile_for(dar_tile_kind kind, size_t n)
{
    return dar_tile_fit(kind, 48, n); /* whole stripes of every shape */
}

/* ---------------------------------------------------------------- packing */

size_t dar_tile_units(const dar_tile *t, size_t k)
{
    return (k + t->unit - 1) / t->unit;
}

size_t dar_tile_bytes_a(const dar_tile *t, size_t k)
{
    return dar_tile_units(t, k) * t->mr * t->unit_bytes;
}

size_t dar_tile_bytes_b(const dar_tile *t, size_t k)
{
    return dar_tile_units(t, k) * t->nr * t->unit_bytes;
}

static dar_dtype operand(const dar_tile *t)
{
    static const dar_dtype of[] = { DAR_F64, DAR_F32, DAR_BF16, DAR_I8 };
    return of[t->kind];
}

/* By plain loops: element (lane j, k) of the stored matrix is at src[j * lane + k * step]. */
static void pack_slow(const dar_tile *t, dar_dtype src_type, const void *src, size_t lane, size_t step, size_t lanes,
                      size_t k, size_t wide, void *dst)
{
    dar_dtype to = operand(t);

    memset(dst, 0, dar_tile_units(t, k) * wide * t->unit_bytes);
    for (size_t p = 0; p < k; p++)
        for (size_t j = 0; j < lanes; j++) {
            size_t from = j * lane + p * step, at = (p / t->unit * wide + j) * t->unit + p % t->unit;
            if (to == DAR_I8) ((uint8_t *)dst)[at] = ((const uint8_t *)src)[from];
            else if (to == DAR_F64 && src_type == DAR_F64) ((double *)dst)[at] = ((const double *)src)[from];
            else dar_dtype_set(to, dst, at, dar_dtype_get(src_type, src, from));
        }
}

static void pack(const dar_tile *t, bool along, dar_dtype src_type, const void *src, size_t ld, size_t lanes, size_t k,
                 size_t wide, void *dst)
{
    dar_pack_fn *fn = t->pack ? (along ? t->pack->along : t->pack->across)[src_type] : NULL;
    size_t stripe = dar_tile_units(t, k) * wide * t->unit_bytes, lane = along ? ld : 1, step = along ? 1 : ld;

    if (fn && !along) {
        fn(src, ld, lanes, k, wide, dst);
        return;
    }
    for (size_t j = 0; j < lanes; j += wide) {
        const char *from = (const char *)src + j * lane * dar_dtype_size(src_type);
        char *to = (char *)dst + j / wide * stripe;
        size_t n = lanes - j < wide ? lanes - j : wide;
        if (fn) fn(from, ld, n, k, wide, to);
        else pack_slow(t, src_type, from, lane, step, n, k, wide, to);
    }
}

void dar_tile_pack_a_mk(const dar_tile *t, dar_dtype src_type, const void *src, size_t ld, size_t m, size_t k,
                        void *dst)
{
    pack(t, true, src_type, src, ld, m, k, t->mr, dst);
}

void dar_tile_pack_a_km(const dar_tile *t, dar_dtype src_type, const void *src, size_t ld, size_t m, size_t k,
                        void *dst)
{
    pack(t, false, src_type, src, ld, m, k, t->mr, dst);
}

void dar_tile_pack_b_kn(const dar_tile *t, dar_dtype src_type, const void *src, size_t ld, size_t k, size_t n,
                        void *dst)
{
    pack(t, false, src_type, src, ld, n, k, t->nr, dst);
}

void dar_tile_pack_b_wide(const dar_tile *t, dar_dtype src_type, const void *src, size_t ld, size_t k, size_t n,
                          size_t wide, void *dst)
{
    pack(t, false, src_type, src, ld, n, k, wide, dst);
}

void dar_tile_pack_b_nk(const dar_tile *t, dar_dtype src_type, const void *src, size_t ld, size_t k, size_t n,
                        void *dst)
{
    pack(t, true, src_type, src, ld, n, k, t->nr, dst);
}

bool dar_tile_takes_rows(const dar_tile *t, dar_dtype src_type)
{
    return t->pack && t->pack->rows[src_type];
}

void dar_tile_pack_a_rows(const dar_tile *t, dar_dtype src_type, const void *src, size_t ld, size_t m, size_t k,
                          void *dst)
{
    t->pack->rows[src_type](src, ld, m, k, t->mr, dst);
}
