/* kern_tile_avx512.c: f32 tiles with 24 accumulators of 16 lanes, and their packing. */
#include <immintrin.h>

#include "lib/kern_tiles.h"
#include "lib/kern_transpose_avx512.inc"

#define W    16
#define UNIT 1

typedef float elem;
typedef __m512 acc, bvec, avec;

#define zero()           _mm512_setzero_ps()
#define load_b(p)        _mm512_loadu_ps(p)
#define load_a(p)        _mm512_set1_ps(*(const float *)(p))
#define mul_add(c, a, b) _mm512_fmadd_ps(a, b, c)
#define get_c(p, n)      _mm512_maskz_loadu_ps(first(n), p)
#define put_c(p, n, c)   _mm512_mask_storeu_ps(p, first(n), c)
#define add_c(c, d)      _mm512_add_ps(c, d)
#define stream_c(p, c)   _mm512_stream_ps(p, c)

#include "lib/kern_tile.inc"

TILE(mm_6x64, 6, 4)
TILE(mm_8x48, 8, 3)
TILE(mm_12x32, 12, 2)
TILE(mm_12x16, 12, 1)
TILE_BESIDE(mm_6x64_beside, 6, 4)
TILE_BESIDE(mm_8x48_beside, 8, 3)
TILE_BESIDE(mm_12x32_beside, 12, 2)
TILE_BESIDE(mm_12x16_beside, 12, 1)
TILE_TAPS(mm_6x64_taps, 6, 4)
TILE_TAPS(mm_8x48_taps, 8, 3)
TILE_TAPS(mm_12x32_taps, 12, 2)
TILE_TAPS(mm_12x16_taps, 12, 1)
TILE_ROWS(mm_6x64_rows, 6, 4)
TILE_ROWS(mm_8x48_rows, 8, 3)
TILE_ROWS(mm_12x32_rows, 12, 2)
TILE_ROWS(mm_12x16_rows, 12, 1)

static inline units along_f32(const void *p, size_t n)
{
    return _mm512_maskz_loadu_epi32(first(n), p);
}

static inline units along_bf16(const void *p, size_t n)
{
    return _mm512_slli_epi32(_mm512_cvtepu16_epi32(_mm256_maskz_loadu_epi16(first(n), p)), 16);
}

static inline units along_f16(const void *p, size_t n)
{
    return _mm512_castps_si512(_mm512_cvtph_ps(_mm256_maskz_loadu_epi16(first(n), p)));
}

/* A unit is one element: across k is the same load. */
#define across_f32(p, ld, rows, n)  along_f32(p, n)
#define across_bf16(p, ld, rows, n) along_bf16(p, n)
#define across_f16(p, ld, rows, n)  along_f16(p, n)

PACK(f32, 4, along_f32, across_f32)
PACK(bf16, 2, along_bf16, across_bf16)
PACK(f16, 2, along_f16, across_f16)

static const dar_packers pack = {
    .along = { [DAR_F32] = f32_along, [DAR_BF16] = bf16_along, [DAR_F16] = f16_along },
    .across = { [DAR_F32] = f32_across, [DAR_BF16] = bf16_across, [DAR_F16] = f16_across },
};

static const dar_tile of[] = {
    { "f32 6x64 avx512", DAR_TILE_F32, 1, 4, 6, 64, mm_6x64, &pack, mm_6x64_beside, mm_6x64_taps, mm_6x64_rows },
    { "f32 8x48 avx512", DAR_TILE_F32, 1, 4, 8, 48, mm_8x48, &pack, mm_8x48_beside, mm_8x48_taps, mm_8x48_rows },
    { "f32 12x32 avx512", DAR_TILE_F32, 1, 4, 12, 32, mm_12x32, &pack, mm_12x32_beside, mm_12x32_taps, mm_12x32_rows },
    { "f32 12x16 avx512", DAR_TILE_F32, 1, 4, 12, 16, mm_12x16, &pack, mm_12x16_beside, mm_12x16_taps, mm_12x16_rows },
};
const dar_tile_set dar_tiles_f32_avx512 = { of, 4 };
