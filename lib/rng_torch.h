/* rng_torch.h: the normal numbers that PyTorch draws on a CPU, so that users can compare seeds.
 *
 * torch.manual_seed(s); torch.randn(n); torch.randn(m); ... is dar_rng_torch_seed and one dar_rng_torch_normal per
 * call. Everything else in this project takes lib/rng.h.
 *
 *   f32, 16 values and more   the bits of PyTorch on a processor with AVX2 (without it, PyTorch itself differs in the
 *                             last digits)
 *   f64; f32 below 16 values  the same formula in double by the C library's log, cos and sin: within 4 ulp, usually
 * equal
 *
 * Compared with version 2.13.  Source: Matsumoto, Nishimura 1998 (MT19937); Box, Muller 1958; Moshier's Cephes library
 * (polynomials in float). */
#ifndef DAR_LIB_RNG_TORCH_H
#define DAR_LIB_RNG_TORCH_H

#include <stdbool.h>
#include <stdint.h>

#include "lib/tensor.h"

typedef struct dar_rng_torch {
    uint32_t state[624];
    int used;     /* of state */
    bool spare;   /* calls below 16 values make pairs; one number may be left over, */
    double value; /* this one, for the next such call */
} dar_rng_torch;

/* Only the lower 32 bits of the seed count, as there. */
void dar_rng_torch_seed(dar_rng_torch *g, uint64_t seed);

/* Fill a contiguous f32 or f64 tensor as torch.randn of its size would. */
void dar_rng_torch_normal(dar_rng_torch *g, const dar_tensor *x);

#endif
