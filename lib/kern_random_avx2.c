/* kern_random_avx2.c: Philox on four blocks at a time, a 32-bit word per 64-bit lane; what a product leaves in the
 * upper halves is never read. */
#include <immintrin.h>

#include "lib/kern_random.h"

/* Words in the order of blocks: 128-bit lane j of `low` holds block j, of `high` block 2 + j. */
static inline void four_blocks(uint64_t seed, uint64_t stream, uint64_t index, __m256i *low, __m256i *high)
{
    const __m256i m0 = _mm256_set1_epi64x(DAR_PHILOX_M0), m1 = _mm256_set1_epi64x(DAR_PHILOX_M1);
    __m256i c0 = _mm256_add_epi64(_mm256_set1_epi64x((int64_t)index), _mm256_setr_epi64x(0, 2, 1, 3));
    __m256i c1 = _mm256_srli_epi64(c0, 32), c2 = _mm256_set1_epi64x((int64_t)stream), c3 = _mm256_srli_epi64(c2, 32);
    uint32_t k0 = (uint32_t)seed, k1 = (uint32_t)(seed >> 32);
    for (int round = 0; round < DAR_PHILOX_ROUNDS; round++) {
        __m256i p = _mm256_mul_epu32(c0, m0), q = _mm256_mul_epu32(c2, m1);
        c0 = _mm256_xor_si256(_mm256_xor_si256(_mm256_srli_epi64(q, 32), c1), _mm256_set1_epi64x(k0));
        c2 = _mm256_xor_si256(_mm256_xor_si256(_mm256_srli_epi64(p, 32), c3), _mm256_set1_epi64x(k1));
        c1 = q;
        c3 = p;
        k0 += DAR_PHILOX_W0;
        k1 += DAR_PHILOX_W1;
    }
    __m256i a = _mm256_blend_epi32(c0, _mm256_slli_epi64(c1, 32), 0xaa);
    __m256i b = _mm256_blend_epi32(c2, _mm256_slli_epi64(c3, 32), 0xaa);
    *low = _mm256_unpacklo_epi64(a, b);
    *high = _mm256_unpackhi_epi64(a, b);
}

static void philox(size_t blocks, uint64_t seed, uint64_t stream, uint64_t index, uint32_t *out)
{
    __m256i x[2];
    for (size_t i = 0; i < blocks; i += 4) {
        four_blocks(seed, stream, index + i, &x[0], &x[1]);
        if (blocks - i >= 4) {
            _mm256_storeu_si256((__m256i *)(void *)(out + 4 * i), x[0]);
            _mm256_storeu_si256((__m256i *)(void *)(out + 4 * i + 8), x[1]);
        } else {
            memcpy(out + 4 * i, x, (blocks - i) * 16);
        }
    }
}

static void dither(size_t n, const uint32_t *random, int half, const float *x, uint16_t *y)
{
    const __m256i low = _mm256_set1_epi32(0xffff), top = _mm256_set1_epi32(0x7f800000);
    size_t i = 0;
    for (; i + 8 <= n; i += 8) {
        __m256i b = _mm256_loadu_si256((const __m256i *)(const void *)(x + i));
        __m256i r = _mm256_loadu_si256((const __m256i *)(const void *)(random + i));
        if (_mm256_movemask_epi8(_mm256_cmpeq_epi32(_mm256_and_si256(b, top), top))) {
            for (size_t k = i; k < i + 8; k++) y[k] = dar_dither(x[k], random[k] >> 16 * half);
            continue;
        }
        r = half ? _mm256_srli_epi32(r, 16) : _mm256_and_si256(r, low);
        b = _mm256_srli_epi32(_mm256_add_epi32(b, r), 16);
        b = _mm256_permute4x64_epi64(_mm256_packus_epi32(b, b), 0xd8);
        _mm_storeu_si128((__m128i *)(void *)(y + i), _mm256_castsi256_si128(b));
    }
    for (; i < n; i++) y[i] = dar_dither(x[i], random[i] >> 16 * half);
}

void dar_kern_random_avx2(dar_kern *k)
{
    k->philox = philox;
    k->dither = dither;
}
