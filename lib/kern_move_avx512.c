/* kern_move_avx512.c: transposition and streaming in AVX-512 registers. */
#include <immintrin.h>

#include "lib/kern_sets.h"
#include "lib/kern_transpose_avx512.inc"

#define W 16

#define get_units(p, n)       _mm512_maskz_loadu_epi32(first(n), p)
#define get_pairs(p, m, q, n) pairs(_mm256_maskz_loadu_epi16(first(m), p), _mm256_maskz_loadu_epi16(first(n), q))
#define put_halves(p, n, u)   _mm512_mask_storeu_epi16(p, (__mmask32)((1ull << (n)) - 1), u)
#define stream_line(p, x)     _mm512_stream_si512((void *)(p), _mm512_loadu_si512(x))

#include "lib/kern_move.inc"

void dar_kern_move_avx512(dar_kern *k)
{
    fill(k);
}
