/* kern_tile_vnni.c: 8-bit tiles (VPDPBUSD: four products of u8 and s8 per lane and instruction), and their packing. */
#include <immintrin.h>

#include "lib/kern_tiles.h"
#include "lib/kern_transpose_avx512.inc"

#define W    16
#define UNIT 4

typedef int32_t elem;
typedef __m512i bvec, avec;
typedef int32_t acc __attribute__((vector_size(64))); /* as 64-bit lanes, gcc 12 copies every accumulator twice */

#define zero()                                                                                                         \
    (acc)                                                                                                              \
    {                                                                                                                  \
        0                                                                                                              \
    }
#define load_b(p)        _mm512_loadu_si512(p)
#define load_a(p)        _mm512_set1_epi32(*(p))
#define mul_add(c, a, b) (acc) _mm512_dpbusd_epi32((__m512i)(c), a, b)
#define get_c(p, n)      (acc) _mm512_maskz_loadu_epi32(first(n), p)
#define put_c(p, n, c)   _mm512_mask_storeu_epi32(p, first(n), (__m512i)(c))
#define add_c(c, d)      ((c) + (d))

#include "lib/kern_tile.inc"

TILE(mm_6x64, 6, 4)
TILE(mm_8x48, 8, 3)
TILE(mm_12x32, 12, 2)
TILE(mm_12x16, 12, 1)

/* 64 bytes along k are 16 quads as they come. */
static inline units along(const void *p, size_t n)
{
    return _mm512_maskz_loadu_epi8(n < 64 ? (1ull << n) - 1 : ~0ull, p);
}

/* Up to four rows, byte by byte. */
static inline units across(const void *p, size_t ld, size_t rows, size_t n)
{
    units u = _mm512_cvtepu8_epi32(_mm_maskz_loadu_epi8(first(n), p));
    for (size_t i = 1; i < rows; i++) {
        units v = _mm512_cvtepu8_epi32(_mm_maskz_loadu_epi8(first(n), (const char *)p + i * ld));
        u = _mm512_or_si512(u, _mm512_sllv_epi32(v, _mm512_set1_epi32((int)(8 * i))));
    }
    return u;
}

PACK(i8, 1, along, across)

static const dar_packers pack = { .along = { [DAR_I8] = i8_along }, .across = { [DAR_I8] = i8_across } };

static const dar_tile of[] = {
    { "i8 6x64 vnni", DAR_TILE_I8, 4, 4, 6, 64, mm_6x64, &pack, NULL, NULL, NULL },
    { "i8 8x48 vnni", DAR_TILE_I8, 4, 4, 8, 48, mm_8x48, &pack, NULL, NULL, NULL },
    { "i8 12x32 vnni", DAR_TILE_I8, 4, 4, 12, 32, mm_12x32, &pack, NULL, NULL, NULL },
    { "i8 12x16 vnni", DAR_TILE_I8, 4, 4, 12, 16, mm_12x16, &pack, NULL, NULL, NULL },
};
const dar_tile_set dar_tiles_i8_vnni = { of, 4 };
