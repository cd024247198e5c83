/* kern_avx2.c: the row kernels in vectors of 8. */
#include "lib/kern_sets.h"

#include <math.h>
#include <string.h>

#if defined __AVX2__ && defined __FMA__ && defined __F16C__
#    include <immintrin.h>

#    define LANES    8
#    define NAME(x)  x##_avx2
#    define SET_NAME "avx2"

typedef __m256 vf;  /* LANES f32 */
typedef __m256d vd; /* LANES / 2 f64 */
typedef __m128i vh; /* LANES 16-bit values */
typedef __m256i vi; /* LANES i32 */
typedef __m256 vm;  /* a choice per lane */

static inline vf v_load(const float *p)
{
    return _mm256_loadu_ps(p);
}

static inline void v_store(float *p, vf x)
{
    _mm256_storeu_ps(p, x);
}

static inline void v_stream(float *p, vf x)
{
    _mm256_stream_ps(p, x);
}

static inline vf v_set(float x)
{
    return _mm256_set1_ps(x);
}

static inline vf v_fma(vf a, vf b, vf c)
{
    return _mm256_fmadd_ps(a, b, c);
}

static inline vf v_max(vf a, vf b)
{
    return _mm256_max_ps(a, b);
}

static inline vf v_min(vf a, vf b)
{
    return _mm256_min_ps(a, b);
}

/* |x| or m, the larger as unsigned integers. */
static inline vf v_larger(vf x, vf m)
{
    __m256i a = _mm256_castps_si256(_mm256_andnot_ps(_mm256_set1_ps(-0.0f), x));
    return _mm256_castsi256_ps(_mm256_max_epu32(a, _mm256_castps_si256(m)));
}

/* The largest lane as unsigned integers. */
static inline uint32_t v_largest(vf x)
{
    __m256i u = _mm256_castps_si256(x);
    __m128i m = _mm_max_epu32(_mm256_castsi256_si128(u), _mm256_extracti128_si256(u, 1));
    m = _mm_max_epu32(m, _mm_shuffle_epi32(m, 0x4e));
    return (uint32_t)_mm_cvtsi128_si32(_mm_max_epu32(m, _mm_shuffle_epi32(m, 0xb1)));
}

static inline vf v_sqrt(vf x)
{
    return _mm256_sqrt_ps(x);
}

static inline vf v_abs(vf x)
{
    return _mm256_andnot_ps(_mm256_set1_ps(-0.0f), x);
}

static inline vf v_sign_from(vf x, vf sign)
{
    return _mm256_or_ps(x, _mm256_and_ps(_mm256_set1_ps(-0.0f), sign));
}

static inline vm v_less(vf a, vf b)
{
    return _mm256_cmp_ps(a, b, _CMP_LT_OQ);
}

static inline vf v_select(vm m, vf yes, vf no)
{
    return _mm256_blendv_ps(no, yes, m);
}

/* x 2^floor(n) for n in [-250, 250], rounded once: two factors that are normal numbers. */
static inline vf v_scale(vf x, vf n)
{
    __m256i e = _mm256_cvtps_epi32(_mm256_floor_ps(n)), half = _mm256_srai_epi32(e, 1), one = _mm256_set1_epi32(127);
    __m256i a = _mm256_slli_epi32(_mm256_add_epi32(half, one), 23);
    __m256i b = _mm256_slli_epi32(_mm256_add_epi32(_mm256_sub_epi32(e, half), one), 23);
    return x * _mm256_castsi256_ps(a) * _mm256_castsi256_ps(b);
}

/* 2^f for the fraction f of n, which the last three bits count. */
static inline vf v_power(vf n)
{
    const __m256 t = _mm256_setr_ps(1, 0x1.172b84p+0f, 0x1.306fep+0f, 0x1.4bfdaep+0f, 0x1.6a09e6p+0f, 0x1.8ace54p+0f,
                                    0x1.ae89fap+0f, 0x1.d5818ep+0f);
    return _mm256_permutevar8x32_ps(t, _mm256_castps_si256(n));
}

/* What rounding took from v_power and v_power_sunk, relative to them. */
static inline vf v_power_rest(vf n)
{
    const __m256 t = _mm256_setr_ps(0, -0x1.9c0c22p-27f, 0x1.125002p-25f, -0x1.0a355p-25f, 0x1.26055cp-26f,
                                    0x1.67a1cap-28f, -0x1.f9c304p-27f, -0x1.a5217cp-28f);
    return _mm256_permutevar8x32_ps(t, _mm256_castps_si256(n));
}

/* 2^(n - 64), a normal number: the bits above the fraction go to the exponent, the fraction's own, which come along,
 * are taken off beforehand. */
static inline vf v_power_sunk(vf n)
{
    const __m256i t = _mm256_setr_epi32(0x1f800000, 0x1f7b95c2, 0x1f7837f0, 0x1f75fed7, 0x1f7504f3, 0x1f75672a,
                                        0x1f7744fd, 0x1f7ac0c7);
    __m256i u = _mm256_castps_si256(n);
    return _mm256_castsi256_ps(_mm256_add_epi32(_mm256_permutevar8x32_epi32(t, u), _mm256_slli_epi32(u, 20)));
}

static inline vf v_even(vf x)
{
    return _mm256_moveldup_ps(x);
}

static inline vf v_odd(vf x)
{
    return _mm256_movehdup_ps(x);
}

static inline vf v_swap(vf x)
{
    return _mm256_permute_ps(x, 0xb1);
}

/* a - b in even lanes, a + b in odd ones. */
static inline vf v_addsub(vf a, vf b)
{
    return _mm256_addsub_ps(a, b);
}

static inline vd d_low(vf x)
{
    return _mm256_cvtps_pd(_mm256_castps256_ps128(x));
}

static inline vd d_high(vf x)
{
    return _mm256_cvtps_pd(_mm256_extractf128_ps(x, 1));
}

static inline vd d_fma(vd a, vd b, vd c)
{
    return _mm256_fmadd_pd(a, b, c);
}

/* Lanes j and j + 2, then j + 1. */
static inline double d_sum(vd x)
{
    __m128d s = _mm256_castpd256_pd128(x) + _mm256_extractf128_pd(x, 1);
    return s[0] + s[1];
}

static inline vh h_load(const void *p)
{
    return _mm_loadu_si128(p);
}

static inline void h_store(void *p, vh x)
{
    _mm_storeu_si128(p, x);
}

static inline void h_stream(void *p, vh x)
{
    _mm_stream_si128(p, x);
}

/* |x| or m, the larger as unsigned integers. */
static inline vh h_larger(vh x, vh m)
{
    return _mm_max_epu16(_mm_and_si128(x, _mm_set1_epi16(0x7fff)), m);
}

static inline uint16_t h_largest(vh x)
{
    return (uint16_t)~_mm_extract_epi16(_mm_minpos_epu16(~x), 0);
}

static inline vf v_from_bf16(vh h)
{
    return _mm256_castsi256_ps(_mm256_slli_epi32(_mm256_cvtepu16_epi32(h), 16));
}

static inline vh v_to_bf16(vf x)
{
    __m256i u = _mm256_castps_si256(x), high = _mm256_srli_epi32(u, 16);
    __m256i odd = _mm256_and_si256(high, _mm256_set1_epi32(1));
    __m256i r = _mm256_add_epi32(u, _mm256_add_epi32(odd, _mm256_set1_epi32(0x7fff)));
    __m256i nan = _mm256_castps_si256(_mm256_cmp_ps(x, x, _CMP_UNORD_Q));
    __m256i quiet = _mm256_or_si256(high, _mm256_set1_epi32(0x40));
    r = _mm256_blendv_epi8(_mm256_srli_epi32(r, 16), quiet, nan);
    return _mm_packus_epi32(_mm256_castsi256_si128(r), _mm256_extracti128_si256(r, 1));
}

static inline vf v_from_f16(vh h)
{
    return _mm256_cvtph_ps(h);
}

static inline vh v_to_f16(vf x)
{
    return _mm256_cvtps_ph(x, _MM_FROUND_TO_NEAREST_INT);
}

static inline vf v_from_i8(const int8_t *p)
{
    return _mm256_cvtepi32_ps(_mm256_cvtepi8_epi32(_mm_loadl_epi64((const void *)p)));
}

static inline vi i_load(const int32_t *p)
{
    return _mm256_loadu_si256((const void *)p);
}

static inline vf v_difference(vi a, vi b)
{
    return _mm256_cvtepi32_ps(_mm256_sub_epi32(a, b));
}

/* Numbers in [-127, 127], to the nearest, as bytes with the bits of `flip` changed. */
static inline void v_to_i8(uint8_t *p, vf x, uint8_t flip)
{
    __m256i i = _mm256_cvtps_epi32(x);
    __m128i h = _mm_packs_epi32(_mm256_castsi256_si128(i), _mm256_extracti128_si256(i, 1));
    _mm_storel_epi64((void *)p, _mm_xor_si128(_mm_packs_epi16(h, h), _mm_set1_epi8((char)flip)));
}

#    include "lib/kern_simd.inc"
#else
void dar_kern_avx2(dar_kern *k)
{
    (void)k;
}
#endif
