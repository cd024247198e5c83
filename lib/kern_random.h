/* kern_random.h: one block of Philox4x32-10 (lib/rng.h), and rounding with random bits: the definitions. */
#ifndef DAR_LIB_KERN_RANDOM_H
#define DAR_LIB_KERN_RANDOM_H

#include <stdint.h>
#include <string.h>

#include "lib/dtype.h"
#include "lib/kern_sets.h"

#define DAR_PHILOX_ROUNDS 10
#define DAR_PHILOX_M0     0xd2511f53u /* multipliers */
#define DAR_PHILOX_M1     0xcd9e8d57u
#define DAR_PHILOX_W0     0x9e3779b9u /* what is added to the key */
#define DAR_PHILOX_W1     0xbb67ae85u

typedef struct dar_philox {
    uint32_t x[4];
} dar_philox;

static inline dar_philox dar_philox_at(uint64_t seed, uint64_t stream, uint64_t index)
{
    uint32_t c0 = (uint32_t)index, c1 = (uint32_t)(index >> 32), c2 = (uint32_t)stream, c3 = (uint32_t)(stream >> 32);
    uint32_t k0 = (uint32_t)seed, k1 = (uint32_t)(seed >> 32);
    for (int round = 0; round < DAR_PHILOX_ROUNDS; round++) {
        uint64_t p = (uint64_t)c0 * DAR_PHILOX_M0, q = (uint64_t)c2 * DAR_PHILOX_M1;
        c0 = (uint32_t)(q >> 32) ^ c1 ^ k0;
        c1 = (uint32_t)q;
        c2 = (uint32_t)(p >> 32) ^ c3 ^ k1;
        c3 = (uint32_t)p;
        k0 += DAR_PHILOX_W0;
        k1 += DAR_PHILOX_W1;
    }
    return (dar_philox){ { c0, c1, c2, c3 } };
}

/* x as bf16, away from zero if what is cut off and 16 random bits carry; infinity and NaN stay. */
static inline uint16_t dar_dither(float x, uint32_t random)
{
    uint32_t b;
    memcpy(&b, &x, sizeof b);
    return (b & 0x7f800000) == 0x7f800000 ? dar_bf16_from_f32(x) : (uint16_t)((b + (random & 0xffff)) >> 16);
}

#endif
