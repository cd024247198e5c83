/* rng.h: random numbers as a pure function of (seed, stream, index): nothing to carry along, nothing to save.
 *
 * Philox4x32-10 encrypts the counter (index, stream) under the key seed.  Give every purpose a stream of its own:
 * within one, draws of different kinds are made of the same bits.  All numbers, the normal ones too, have the same bits
 * on every machine and for any number of threads: nothing but exact and correctly rounded operations is used.
 *
 * Source: Salmon, Moraes, Dror, Shaw 2011, "Parallel random numbers: as easy as 1, 2, 3". */
#ifndef DAR_LIB_RNG_H
#define DAR_LIB_RNG_H

#include <stdint.h>

#include "lib/tensor.h"

uint32_t dar_rng_u32(uint64_t seed, uint64_t stream, uint64_t index);
uint64_t dar_rng_u64(uint64_t seed, uint64_t stream, uint64_t index);

/* Uniform in [0, 1): multiples of 2^-24, of 2^-53. */
float dar_rng_f32(uint64_t seed, uint64_t stream, uint64_t index);
double dar_rng_f64(uint64_t seed, uint64_t stream, uint64_t index);

/* Uniform in 0 .. n - 1; n >= 1.  A value's probability is off by 2^-64 at most. */
uint64_t dar_rng_below(uint64_t seed, uint64_t stream, uint64_t index, uint64_t n);

/* Normal, mean 0, deviation 1: with u, v of one block, sqrt(-2 ln u) cos(2 pi v) for even indices, sin for odd ones;
 * u > 0 is a multiple of 2^-53, so |value| < 8.6.  Source: Box and Muller 1958.  Within 3 ulp of the formula. */
double dar_rng_normal(uint64_t seed, uint64_t stream, uint64_t index);

/* Element i of a contiguous tensor, not i8, is deviation * dar_rng_normal(seed, stream, i), formed in double and
 * rounded to its type; lo + (hi - lo) * dar_rng_f64(seed, stream, i) likewise.  Runs on all threads. */
void dar_rng_fill_normal(const dar_tensor *x, uint64_t seed, uint64_t stream, double deviation);
void dar_rng_fill_uniform(const dar_tensor *x, uint64_t seed, uint64_t stream, double lo, double hi);

/* A stream for a name, such as that of a weight.  FNV-1a, 64 bits. */
uint64_t dar_rng_stream(const char *name);

/* The function itself: one block of four numbers. */
void dar_rng_philox(const uint32_t counter[4], const uint32_t key[2], uint32_t out[4]);

#endif
