/* kern_attn_bf16.c: attention kernels for bf16 tiles: arithmetic in f32, results rounded to pairs. */
#include "lib/kern_attn_avx512.inc"

typedef uint16_t operand;

#define PAIRS
#define put(p, a, b) _mm512_storeu_si512(p, (__m512i)_mm512_cvtne2ps_pbh(b, a))

static inline void put_pairs(operand *p, vf a, vf b, vf c, vf d)
{
    const __m512i low = _mm512_set_epi16(47, 15, 46, 14, 45, 13, 44, 12, 43, 11, 42, 10, 41, 9, 40, 8, 39, 7, 38, 6, 37,
                                         5, 36, 4, 35, 3, 34, 2, 33, 1, 32, 0);
    const __m512i high = _mm512_add_epi16(low, _mm512_set1_epi16(16));
    __m512i first = (__m512i)_mm512_cvtne2ps_pbh(b, a), second = (__m512i)_mm512_cvtne2ps_pbh(d, c);
    _mm512_storeu_si512(p, _mm512_permutex2var_epi16(first, low, second));
    _mm512_storeu_si512(p + 32, _mm512_permutex2var_epi16(first, high, second));
}

#include "lib/kern_attn_simd.inc"

const dar_kern_attn dar_kern_attn_bf16 = { "bf16", soft, grad };
