/* kern_bf16.c: the row kernels in vectors of 16, with instructions that round to bf16. */
#include "lib/kern_sets.h"

#include <math.h>
#include <string.h>

#if defined __AVX512BF16__
#    include "lib/kern_avx512.inc"

#    define NAME(x)  x##_bf16
#    define SET_NAME "bf16"

/* The instructions take denormals for zeros: vectors that have any are rounded as elsewhere. */
static inline bool denormals(vf a, vf b)
{
    __mmask16 m = _mm512_fpclass_ps_mask(a, 0x20), n = _mm512_fpclass_ps_mask(b, 0x20);
    return __builtin_expect(!_mm512_kortestz(m, n), 0);
}

static inline vh v_to_bf16(vf x)
{
    return denormals(x, x) ? v_rounded(x) : (vh)_mm512_cvtneps_pbh(x);
}

#    define V_TWO_TO_BF16

static inline void put_two_bf16(uint16_t *y, vf a, vf b, bool stream)
{
    __m512i u = (__m512i)_mm512_cvtne2ps_pbh(b, a);
    if (denormals(a, b)) u = _mm512_inserti64x4(_mm512_castsi256_si512(v_rounded(a)), v_rounded(b), 1);
    if (stream) _mm512_stream_si512((void *)y, u);
    else _mm512_storeu_si512(y, u);
}

#    include "lib/kern_simd.inc"
#else
void dar_kern_bf16(dar_kern *k)
{
    (void)k;
}
#endif
