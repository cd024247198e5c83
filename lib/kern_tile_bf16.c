/* kern_tile_bf16.c: bf16 tiles (VDPBF16PS: a pair of products per lane and instruction), and their packing. */
#include <immintrin.h>

#include "lib/kern_tiles.h"
#include "lib/kern_transpose_avx512.inc"

#define W    16
#define UNIT 2

typedef float elem;
typedef __m512 acc;
typedef __m512bh bvec, avec;

#define zero()           _mm512_setzero_ps()
#define load_b(p)        (__m512bh) _mm512_loadu_si512(p)
#define load_a(p)        (__m512bh) _mm512_set1_epi32(*(p))
#define mul_add(c, a, b) _mm512_dpbf16_ps(c, a, b)
#define get_c(p, n)      _mm512_maskz_loadu_ps(first(n), p)
#define put_c(p, n, c)   _mm512_mask_storeu_ps(p, first(n), c)
#define add_c(c, d)      _mm512_add_ps(c, d)
#define stream_c(p, c)   _mm512_stream_ps(p, c)

#include "lib/kern_tile.inc"

TILE(mm_6x64, 6, 4)
TILE(mm_8x48, 8, 3)
TILE(mm_12x32, 12, 2)
TILE(mm_12x16, 12, 1)
TILE_TAPS(mm_6x64_taps, 6, 4)
TILE_TAPS(mm_8x48_taps, 8, 3)
TILE_TAPS(mm_12x32_taps, 12, 2)
TILE_TAPS(mm_12x16_taps, 12, 1)
TILE_ROWS(mm_6x64_rows, 6, 4)
TILE_ROWS(mm_8x48_rows, 8, 3)
TILE_ROWS(mm_12x32_rows, 12, 2)
TILE_ROWS(mm_12x16_rows, 12, 1)

/* n <= 16 elements as f32. */
static inline __m512 get_f32(const void *p, size_t n)
{
    return _mm512_maskz_loadu_ps(first(n), p);
}

static inline __m512 get_f16(const void *p, size_t n)
{
    return _mm512_cvtph_ps(_mm256_maskz_loadu_epi16(first(n), p));
}

/* 32 elements along k are 16 pairs as they come. */
static inline units along_bf16(const void *p, size_t n)
{
    return _mm512_maskz_loadu_epi16(n < 32 ? (1u << n) - 1 : ~0u, p);
}

#define ALONG(NAME, SIZE, GET)                                                                                         \
    static inline units NAME(const void *p, size_t n)                                                                  \
    {                                                                                                                  \
        const char *high = (const char *)p + 16 * SIZE;                                                                \
        return (units)_mm512_cvtne2ps_pbh(GET(n > 16 ? high : p, n > 16 ? n - 16 : 0), GET(p, n < 16 ? n : 16));       \
    }
ALONG(along_f32, 4, get_f32)
ALONG(along_f16, 2, get_f16)

/* Rows stay rows. */
#define ROWS(NAME, SIZE, ALONG)                                                                                        \
    static void NAME(const void *src, size_t ld, size_t lanes, size_t k, size_t wide, void *dst)                       \
    {                                                                                                                  \
        size_t row = (k + UNIT - 1) / UNIT;                                                                            \
        (void)wide;                                                                                                    \
        for (size_t i = 0; i < lanes; i++) {                                                                           \
            const char *from = (const char *)src + i * ld * SIZE;                                                      \
            int32_t *to = (int32_t *)dst + i * row;                                                                    \
            size_t p = 0;                                                                                              \
            for (; p + W * UNIT <= k; p += W * UNIT) put_units(to + p / UNIT, W, ALONG(from + p * SIZE, W * UNIT));    \
            if (p < k) put_units(to + p / UNIT, row - p / UNIT, ALONG(from + p * SIZE, k - p));                        \
        }                                                                                                              \
    }
ROWS(f32_rows, 4, along_f32)
ROWS(f16_rows, 2, along_f16)

static inline __m256i row_bf16(const void *p, size_t n)
{
    return _mm256_maskz_loadu_epi16(first(n), p);
}

static inline __m256i row_f32(const void *p, size_t n)
{
    return (__m256i)_mm512_cvtneps_pbh(get_f32(p, n));
}

static inline __m256i row_f16(const void *p, size_t n)
{
    return (__m256i)_mm512_cvtneps_pbh(get_f16(p, n));
}

/* Rows k and k + 1 (or one alone) interleaved. */
#define ACROSS(NAME, ROW)                                                                                              \
    static inline units NAME(const void *p, size_t ld, size_t rows, size_t n)                                          \
    {                                                                                                                  \
        return pairs(ROW(p, n), ROW(rows > 1 ? (const char *)p + ld : p, rows > 1 ? n : 0));                           \
    }
ACROSS(across_f32, row_f32)
ACROSS(across_bf16, row_bf16)
ACROSS(across_f16, row_f16)

PACK(f32, 4, along_f32, across_f32)
PACK(bf16, 2, along_bf16, across_bf16)
PACK(f16, 2, along_f16, across_f16)

static const dar_packers pack = {
    .along = { [DAR_F32] = f32_along, [DAR_BF16] = bf16_along, [DAR_F16] = f16_along },
    .across = { [DAR_F32] = f32_across, [DAR_BF16] = bf16_across, [DAR_F16] = f16_across },
    .rows = { [DAR_F32] = f32_rows, [DAR_F16] = f16_rows },
};

static const dar_tile of[] = {
    { "bf16 6x64 avx512", DAR_TILE_BF16, 2, 4, 6, 64, mm_6x64, &pack, NULL, mm_6x64_taps, mm_6x64_rows },
    { "bf16 8x48 avx512", DAR_TILE_BF16, 2, 4, 8, 48, mm_8x48, &pack, NULL, mm_8x48_taps, mm_8x48_rows },
    { "bf16 12x32 avx512", DAR_TILE_BF16, 2, 4, 12, 32, mm_12x32, &pack, NULL, mm_12x32_taps, mm_12x32_rows },
    { "bf16 12x16 avx512", DAR_TILE_BF16, 2, 4, 12, 16, mm_12x16, &pack, NULL, mm_12x16_taps, mm_12x16_rows },
};
const dar_tile_set dar_tiles_bf16 = { of, 4 };
