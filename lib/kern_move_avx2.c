/* kern_move_avx2.c: transposition and streaming in AVX2 registers. */
#include <immintrin.h>

#include "lib/kern_sets.h"
#include "lib/kern_transpose_avx2.inc"

#define W 8

static inline units get_pairs(const void *p, size_t m, const void *q, size_t n)
{
    __m256i low = _mm256_cvtepu16_epi32(load16(p, 2 * m)), high = _mm256_cvtepu16_epi32(load16(q, 2 * n));
    return _mm256_or_si256(low, _mm256_slli_epi32(high, 16));
}

static inline void put_halves(void *p, size_t n, units u)
{
    if (n == 2 * W) _mm256_storeu_si256(p, u);
    else memcpy(p, &u, 2 * n);
}

static inline void stream_line(void *p, const void *x)
{
    const __m256i *v = x;
    __m256i *to = p;
    for (int i = 0; i < 2; i++) _mm256_stream_si256(to + i, _mm256_loadu_si256(v + i));
}

#define get_units(p, n) _mm256_maskload_epi32(p, first(n))

#include "lib/kern_move.inc"

void dar_kern_move_avx2(dar_kern *k)
{
    fill(k);
}
