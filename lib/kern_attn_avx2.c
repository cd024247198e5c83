/* kern_attn_avx2.c: attention kernels for f32 tiles, in vectors of 8. */
#include <immintrin.h>
#include <math.h>

#include "lib/kern_attn.h"

#define LANES 8

typedef __m256 vf;
typedef float operand;

#define v_load(p)         _mm256_loadu_ps(p)
#define v_store(p, x)     _mm256_storeu_ps(p, x)
#define v_set(x)          _mm256_set1_ps(x)
#define v_fma(a, b, c)    _mm256_fmadd_ps(a, b, c)
#define v_max(a, b)       _mm256_max_ps(a, b)
#define v_any_above(a, b) _mm256_movemask_ps(_mm256_cmp_ps(a, b, _CMP_GT_OQ))
#define put(p, a, b)      (v_store(p, a), v_store((p) + LANES, b))

static inline vf v_first(vf x, size_t m, vf y)
{
    const __m256i lane = _mm256_set_epi32(7, 6, 5, 4, 3, 2, 1, 0);
    return _mm256_blendv_ps(y, x, _mm256_castsi256_ps(_mm256_cmpgt_epi32(_mm256_set1_epi32((int)m), lane)));
}

static inline float v_most(vf x)
{
    __m128 a = _mm_max_ps(_mm256_castps256_ps128(x), _mm256_extractf128_ps(x, 1));
    a = _mm_max_ps(a, _mm_movehl_ps(a, a));
    return _mm_cvtss_f32(_mm_max_ss(a, _mm_movehdup_ps(a)));
}

static inline vf exp2_fraction(vf f);

/* The exponent is added as an integer; below 2^-126 the result is 0. */
static inline vf v_exp2(vf t)
{
    vf in = v_max(v_set(-126), t), n = _mm256_floor_ps(in), p = exp2_fraction(in - n);
    __m256i e = _mm256_slli_epi32(_mm256_cvtps_epi32(n), 23);
    p = _mm256_castsi256_ps(_mm256_add_epi32(_mm256_castps_si256(p), e));
    return _mm256_and_ps(p, _mm256_cmp_ps(t, v_set(-126), _CMP_NLT_UQ));
}

#include "lib/kern_attn_simd.inc"

const dar_kern_attn dar_kern_attn_f32_avx2 = { "avx2", soft, grad };
