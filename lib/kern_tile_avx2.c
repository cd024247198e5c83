/* kern_tile_avx2.c: f32 tiles of 8 lanes, and their packing. */
#include <immintrin.h>

#include "lib/kern_tiles.h"
#include "lib/kern_transpose_avx2.inc"

#define W    8
#define UNIT 1

typedef float elem;
typedef __m256 acc, bvec, avec;

#define zero()           _mm256_setzero_ps()
#define load_b(p)        _mm256_loadu_ps((const float *)(p))
#define load_a(p)        _mm256_broadcast_ss((const float *)(p))
#define mul_add(c, a, b) _mm256_fmadd_ps(a, b, c)
#define get_c(p, n)      _mm256_maskload_ps(p, first(n))
#define put_c(p, n, c)   _mm256_maskstore_ps(p, first(n), c)
#define add_c(c, d)      _mm256_add_ps(c, d)
#define stream_c(p, c)   _mm256_stream_ps(p, c)

#include "lib/kern_tile.inc"

TILE(mm_6x16, 6, 2)
TILE(mm_12x8, 12, 1)
TILE_BESIDE(mm_6x16_beside, 6, 2)
TILE_BESIDE(mm_12x8_beside, 12, 1)
TILE_TAPS(mm_6x16_taps, 6, 2)
TILE_TAPS(mm_12x8_taps, 12, 1)
TILE_ROWS(mm_6x16_rows, 6, 2)
TILE_ROWS(mm_12x8_rows, 12, 1)

static inline units along_f32(const void *p, size_t n)
{
    return _mm256_maskload_epi32(p, first(n));
}

static inline units along_bf16(const void *p, size_t n)
{
    return _mm256_slli_epi32(_mm256_cvtepu16_epi32(load16(p, 2 * n)), 16);
}

static inline units along_f16(const void *p, size_t n)
{
    return _mm256_castps_si256(_mm256_cvtph_ps(load16(p, 2 * n)));
}

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
    { "f32 6x16 avx2", DAR_TILE_F32, 1, 4, 6, 16, mm_6x16, &pack, mm_6x16_beside, mm_6x16_taps, mm_6x16_rows },
    { "f32 12x8 avx2", DAR_TILE_F32, 1, 4, 12, 8, mm_12x8, &pack, mm_12x8_beside, mm_12x8_taps, mm_12x8_rows },
};
const dar_tile_set dar_tiles_f32_avx2 = { of, 2 };
