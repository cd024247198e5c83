/* kern_tile_i8_avx2.c: 8-bit tiles without VNNI, exact: bytes 0 and 2, and bytes 1 and 3, of each quad are multiplied
 * as 16-bit pairs (VPMADDWD); VPMADDUBSW would saturate. */
#include <immintrin.h>
#include <string.h>

#include "lib/kern_tiles.h"
#include "lib/kern_transpose_avx2.inc"

#define W    8
#define UNIT 4

typedef int32_t elem;
typedef __m256i acc;
typedef struct pairs {
    __m256i even, odd;
} bvec, avec;

static inline bvec load_b(const void *p)
{
    __m256i x = _mm256_loadu_si256((const __m256i *)p);
    return (bvec){ _mm256_srai_epi16(_mm256_slli_epi16(x, 8), 8), _mm256_srai_epi16(x, 8) };
}

static inline avec load_a(const void *p)
{
    int32_t unit;
    memcpy(&unit, p, sizeof unit);
    __m256i x = _mm256_set1_epi32(unit);
    return (avec){ _mm256_and_si256(x, _mm256_set1_epi16(255)), _mm256_srli_epi16(x, 8) };
}

static inline acc mul_add(acc c, avec a, bvec b)
{
    return _mm256_add_epi32(_mm256_add_epi32(c, _mm256_madd_epi16(a.even, b.even)), _mm256_madd_epi16(a.odd, b.odd));
}

#define zero()         _mm256_setzero_si256()
#define get_c(p, n)    _mm256_maskload_epi32(p, first(n))
#define put_c(p, n, c) _mm256_maskstore_epi32(p, first(n), c)
#define add_c(c, d)    _mm256_add_epi32(c, d)

#include "lib/kern_tile.inc"

TILE(mm_4x16, 4, 2)

static inline units along(const void *p, size_t n)
{
    unsigned char buf[32] = { 0 };
    if (n == 32) return _mm256_loadu_si256(p);
    memcpy(buf, p, n);
    return _mm256_loadu_si256((const __m256i *)buf);
}

static inline units across(const void *p, size_t ld, size_t rows, size_t n)
{
    units u = _mm256_cvtepu8_epi32(load16(p, n));
    for (size_t i = 1; i < rows; i++) {
        units v = _mm256_cvtepu8_epi32(load16((const char *)p + i * ld, n));
        u = _mm256_or_si256(u, _mm256_sllv_epi32(v, _mm256_set1_epi32((int)(8 * i))));
    }
    return u;
}

PACK(i8, 1, along, across)

static const dar_packers pack = { .along = { [DAR_I8] = i8_along }, .across = { [DAR_I8] = i8_across } };

static const dar_tile of[] = { { "i8 4x16 avx2", DAR_TILE_I8, 4, 4, 4, 16, mm_4x16, &pack, NULL, NULL, NULL } };
const dar_tile_set dar_tiles_i8_avx2 = { of, 1 };
