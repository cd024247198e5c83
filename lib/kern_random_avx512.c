/* kern_random_avx512.c: as kern_random_avx2.c, on eight blocks at a time. */
#include <immintrin.h>

#include "lib/kern_random.h"

/* 128-bit lane j of `low` holds block j, of `high` block 4 + j. */
static inline void eight_blocks(uint64_t seed, uint64_t stream, uint64_t index, __m512i *low, __m512i *high)
{
    const __m512i m0 = _mm512_set1_epi64(DAR_PHILOX_M0), m1 = _mm512_set1_epi64(DAR_PHILOX_M1);
    __m512i c0 = _mm512_add_epi64(_mm512_set1_epi64((int64_t)index), _mm512_setr_epi64(0, 4, 1, 5, 2, 6, 3, 7));
    __m512i c1 = _mm512_srli_epi64(c0, 32), c2 = _mm512_set1_epi64((int64_t)stream), c3 = _mm512_srli_epi64(c2, 32);
    uint32_t k0 = (uint32_t)seed, k1 = (uint32_t)(seed >> 32);
    for (int round = 0; round < DAR_PHILOX_ROUNDS; round++) {
        __m512i p = _mm512_mul_epu32(c0, m0), q = _mm512_mul_epu32(c2, m1);
        c0 = _mm512_ternarylogic_epi64(_mm512_srli_epi64(q, 32), c1, _mm512_set1_epi64(k0), 0x96);
        c2 = _mm512_ternarylogic_epi64(_mm512_srli_epi64(p, 32), c3, _mm512_set1_epi64(k1), 0x96);
        c1 = q;
        c3 = p;
        k0 += DAR_PHILOX_W0;
        k1 += DAR_PHILOX_W1;
    }
    __m512i a = _mm512_mask_blend_epi32(0xaaaa, c0, _mm512_slli_epi64(c1, 32));
    __m512i b = _mm512_mask_blend_epi32(0xaaaa, c2, _mm512_slli_epi64(c3, 32));
    *low = _mm512_unpacklo_epi64(a, b);
    *high = _mm512_unpackhi_epi64(a, b);
}

static void philox(size_t blocks, uint64_t seed, uint64_t stream, uint64_t index, uint32_t *out)
{
    __m512i x[2];
    for (size_t i = 0; i < blocks; i += 8) {
        eight_blocks(seed, stream, index + i, &x[0], &x[1]);
        if (blocks - i >= 8) {
            _mm512_storeu_si512(out + 4 * i, x[0]);
            _mm512_storeu_si512(out + 4 * i + 16, x[1]);
        } else {
            memcpy(out + 4 * i, x, (blocks - i) * 16);
        }
    }
}

static void dither(size_t n, const uint32_t *random, int half, const float *x, uint16_t *y)
{
    const __m512i low = _mm512_set1_epi32(0xffff), top = _mm512_set1_epi32(0x7f800000);
    for (size_t i = 0; i < n; i += 16) {
        __mmask16 m = n - i < 16 ? (__mmask16)((1u << (n - i)) - 1) : 0xffff;
        __m512i b = _mm512_maskz_loadu_epi32(m, x + i), r = _mm512_maskz_loadu_epi32(m, random + i);
        if (_mm512_cmpeq_epi32_mask(_mm512_and_si512(b, top), top)) {
            for (size_t k = i; k < n && k < i + 16; k++) y[k] = dar_dither(x[k], random[k] >> 16 * half);
            continue;
        }
        r = half ? _mm512_srli_epi32(r, 16) : _mm512_and_si512(r, low);
        b = _mm512_srli_epi32(_mm512_add_epi32(b, r), 16);
        _mm256_mask_storeu_epi16(y + i, m, _mm512_cvtepi32_epi16(b));
    }
}

void dar_kern_random_avx512(dar_kern *k)
{
    k->philox = philox;
    k->dither = dither;
}
