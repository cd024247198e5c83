/* kern_avx512.c: the row kernels in vectors of 16. */
#include "lib/kern_sets.h"

#include <math.h>
#include <string.h>

#if defined __AVX512F__ && defined __AVX512BW__ && defined __AVX512VL__ && defined __AVX512DQ__
#    include <immintrin.h>

#    define LANES    16
#    define NAME(x)  x##_avx512
#    define SET_NAME "avx512"

typedef __m512 vf;    /* LANES f32 */
typedef __m512d vd;   /* LANES / 2 f64 */
typedef __m256i vh;   /* LANES 16-bit values */
typedef __m512i vi;   /* LANES i32 */
typedef __mmask16 vm; /* a choice per lane */

static inline vf v_load(const float *p)
{
    return _mm512_loadu_ps(p);
}

static inline void v_store(float *p, vf x)
{
    _mm512_storeu_ps(p, x);
}

static inline void v_stream(float *p, vf x)
{
    _mm512_stream_ps(p, x);
}

static inline vf v_set(float x)
{
    return _mm512_set1_ps(x);
}

static inline vf v_fma(vf a, vf b, vf c)
{
    return _mm512_fmadd_ps(a, b, c);
}

static inline vf v_max(vf a, vf b)
{
    return _mm512_max_ps(a, b);
}

static inline vf v_min(vf a, vf b)
{
    return _mm512_min_ps(a, b);
}

/* |x| or m, the larger as unsigned integers. */
static inline vf v_larger(vf x, vf m)
{
    return _mm512_castsi512_ps(_mm512_max_epu32(_mm512_castps_si512(_mm512_abs_ps(x)), _mm512_castps_si512(m)));
}

/* The largest lane as unsigned integers. */
static inline uint32_t v_largest(vf x)
{
    return _mm512_reduce_max_epu32(_mm512_castps_si512(x));
}

static inline vf v_sqrt(vf x)
{
    return _mm512_sqrt_ps(x);
}

static inline vf v_abs(vf x)
{
    return _mm512_abs_ps(x);
}

static inline vf v_sign_from(vf x, vf sign)
{
    return _mm512_or_ps(x, _mm512_and_ps(_mm512_set1_ps(-0.0f), sign));
}

static inline vm v_less(vf a, vf b)
{
    return _mm512_cmp_ps_mask(a, b, _CMP_LT_OQ);
}

static inline vf v_select(vm m, vf yes, vf no)
{
    return _mm512_mask_blend_ps(m, no, yes);
}

/* x 2^floor(n), rounded once. */
static inline vf v_scale(vf x, vf n)
{
    return _mm512_scalef_ps(x, n);
}

/* 2^f for the fraction f of n, which the last four bits count. */
static inline vf v_power(vf n)
{
    const __m512 t = _mm512_setr_ps(1, 0x1.0b5586p+0f, 0x1.172b84p+0f, 0x1.2387a6p+0f, 0x1.306fep+0f, 0x1.3dea64p+0f,
                                    0x1.4bfdaep+0f, 0x1.5ab07ep+0f, 0x1.6a09e6p+0f, 0x1.7a1148p+0f, 0x1.8ace54p+0f,
                                    0x1.9c4918p+0f, 0x1.ae89fap+0f, 0x1.c199bep+0f, 0x1.d5818ep+0f, 0x1.ea4afap+0f);
    return _mm512_permutexvar_ps(_mm512_castps_si512(n), t);
}

/* What rounding took from v_power and v_power_sunk, relative to them. */
static inline vf v_power_rest(vf n)
{
    const __m512 t =
        _mm512_setr_ps(0, 0x1.8d96d4p-25f, -0x1.9c0c22p-27f, 0x1.964904p-25f, 0x1.125002p-25f, 0x1.370be4p-25f,
                       -0x1.0a355p-25f, -0x1.00d8acp-27f, 0x1.26055cp-26f, -0x1.05cb44p-25f, 0x1.67a1cap-28f,
                       0x1.a3b5e4p-28f, -0x1.f9c304p-27f, -0x1.6961b4p-28f, -0x1.a5217cp-28f, 0x1.61428ep-28f);
    return _mm512_permutexvar_ps(_mm512_castps_si512(n), t);
}

/* 2^(n - 64), a normal number: the bits above the fraction go to the exponent, the fraction's own, which come along,
 * are taken off beforehand. */
static inline vf v_power_sunk(vf n)
{
    const __m512i t = _mm512_setr_epi32(0x1f800000, 0x1f7daac3, 0x1f7b95c2, 0x1f79c3d3, 0x1f7837f0, 0x1f76f532,
                                        0x1f75fed7, 0x1f75583f, 0x1f7504f3, 0x1f7508a4, 0x1f75672a, 0x1f76248c,
                                        0x1f7744fd, 0x1f78ccdf, 0x1f7ac0c7, 0x1f7d257d);
    __m512i u = _mm512_castps_si512(n);
    return _mm512_castsi512_ps(_mm512_add_epi32(_mm512_permutexvar_epi32(u, t), _mm512_slli_epi32(u, 19)));
}

static inline vf v_even(vf x)
{
    return _mm512_moveldup_ps(x);
}

static inline vf v_odd(vf x)
{
    return _mm512_movehdup_ps(x);
}

static inline vf v_swap(vf x)
{
    return _mm512_permute_ps(x, 0xb1);
}

/* a - b in even lanes, a + b in odd ones: a product with 1 rounds nothing. */
static inline vf v_addsub(vf a, vf b)
{
    return _mm512_fmaddsub_ps(a, _mm512_set1_ps(1), b);
}

static inline vd d_low(vf x)
{
    return _mm512_cvtps_pd(_mm512_castps512_ps256(x));
}

static inline vd d_high(vf x)
{
    return _mm512_cvtps_pd(_mm512_extractf32x8_ps(x, 1));
}

static inline vd d_fma(vd a, vd b, vd c)
{
    return _mm512_fmadd_pd(a, b, c);
}

/* Lanes j and j + 4, then j + 2, then j + 1. */
static inline double d_sum(vd x)
{
    __m256d q = _mm512_castpd512_pd256(x) + _mm512_extractf64x4_pd(x, 1);
    __m128d s = _mm256_castpd256_pd128(q) + _mm256_extractf128_pd(q, 1);
    return s[0] + s[1];
}

static inline vh h_load(const void *p)
{
    return _mm256_loadu_si256(p);
}

static inline void h_store(void *p, vh x)
{
    _mm256_storeu_si256(p, x);
}

static inline void h_stream(void *p, vh x)
{
    _mm256_stream_si256(p, x);
}

/* |x| or m, the larger as unsigned integers. */
static inline vh h_larger(vh x, vh m)
{
    return _mm256_max_epu16(_mm256_and_si256(x, _mm256_set1_epi16(0x7fff)), m);
}

static inline uint16_t h_largest(vh x)
{
    __m128i m = _mm_max_epu16(_mm256_castsi256_si128(x), _mm256_extracti128_si256(x, 1));
    return (uint16_t)~_mm_extract_epi16(_mm_minpos_epu16(~m), 0);
}

static inline vf v_from_bf16(vh h)
{
    return _mm512_castsi512_ps(_mm512_slli_epi32(_mm512_cvtepu16_epi32(h), 16));
}

/* Not VCVTNEPS2BF16: that one flushes denormals.  Half a unit is added, less the last bit where the result is even;
 * not to NaN, which it would carry into the sign. */
static inline vh v_to_bf16(vf x)
{
    const __m512i high = _mm512_set_epi16(31, 29, 27, 25, 23, 21, 19, 17, 15, 13, 11, 9, 7, 5, 3, 1, 31, 29, 27, 25, 23,
                                          21, 19, 17, 15, 13, 11, 9, 7, 5, 3, 1);
    __m512i u = _mm512_castps_si512(x), quiet = _mm512_or_epi32(u, _mm512_set1_epi32(0x400000));
    __mmask16 number = _mm512_cmp_ps_mask(x, x, _CMP_ORD_Q);
    __mmask16 odd = _mm512_mask_test_epi32_mask(number, u, _mm512_set1_epi32(0x10000));
    __m512i r = _mm512_mask_add_epi32(quiet, number, u, _mm512_set1_epi32(0x7fff));
    r = _mm512_mask_sub_epi32(r, odd, r, _mm512_set1_epi32(-1));
    return _mm512_castsi512_si256(_mm512_permutexvar_epi16(high, r));
}

static inline vf v_from_f16(vh h)
{
    return _mm512_cvtph_ps(h);
}

static inline vh v_to_f16(vf x)
{
    return _mm512_cvtps_ph(x, _MM_FROUND_TO_NEAREST_INT);
}

static inline vf v_from_i8(const int8_t *p)
{
    return _mm512_cvtepi32_ps(_mm512_cvtepi8_epi32(_mm_loadu_si128((const void *)p)));
}

static inline vi i_load(const int32_t *p)
{
    return _mm512_loadu_si512(p);
}

static inline vf v_difference(vi a, vi b)
{
    return _mm512_cvtepi32_ps(_mm512_sub_epi32(a, b));
}

/* Numbers in [-127, 127], to the nearest, as bytes with the bits of `flip` changed. */
static inline void v_to_i8(uint8_t *p, vf x, uint8_t flip)
{
    __m128i q = _mm512_cvtepi32_epi8(_mm512_cvtps_epi32(x));
    _mm_storeu_si128((void *)p, _mm_xor_si128(q, _mm_set1_epi8((char)flip)));
}

#    include "lib/kern_simd.inc"
#else
void dar_kern_avx512(dar_kern *k)
{
    (void)k;
}
#endif
