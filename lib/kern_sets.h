/* kern_sets.h: the sets of kernels that fill the tables; included by the files that define or choose them. */
#ifndef DAR_LIB_KERN_SETS_H
#define DAR_LIB_KERN_SETS_H

#include "lib/kern.h"

/* Every slot but the conversions: SLOT(name) of each. */
/* clang-format off */
#define DAR_KERN_SLOTS \
    SLOT(exp) SLOT(tanh) SLOT(rsqrt) SLOT(silu) SLOT(gelu_tanh) SLOT(relu) SLOT(silu_back) \
    SLOT(silu_bf16) SLOT(gelu_tanh_bf16) \
    SLOT(gelu_tanh_back) SLOT(relu_back) SLOT(add) SLOT(mul) SLOT(offset) SLOT(scale) SLOT(axpy) \
    SLOT(mul_add) SLOT(sum) SLOT(dot) SLOT(max) SLOT(nonfinite) SLOT(exp_sum) \
    SLOT(softmax_back) SLOT(adamw) SLOT(dequantise)
/* clang-format on */

/* moments from the sums of x - first and of their squares. */
static inline void finish_moments(size_t n, double first, bool centred, double sum, double squares, double m[2])
{
    double d = centred && n ? sum / (double)n : 0;
    m[0] = first + d;
    m[1] = squares - d * sum;
}

/* The same for bf16, from sums of x and of x^2 that were made in the table's type in runs of MOMENT_RUN, of elements
 * with the same accumulator.  A run loses digits only where its elements differ so much that its part of the second
 * moment is large: 2^-16 of it at most.  False where that does not hold, because squares leave the range of f32, or
 * where the second moment is so little of the squares that their sum in f64 is felt: the row is then summed as others
 * are. */
#define MOMENT_RUN 8

static inline bool finish_runs(size_t n, bool centred, double sum, double squares, double m[2])
{
    finish_moments(n, 0, centred, sum, squares, m);
    return m[1] > 0x1p-24 * squares && squares > (double)n * 0x1p-80 && squares < 0x1p120;
}

void dar_kern_ref_f32(dar_kern *k); /* fills every slot */
void dar_kern_ref_f64(dar_kern *k);

void dar_kern_avx2(dar_kern *f32); /* replace f32 slots; do nothing where the compiler has no such instructions */
void dar_kern_avx512(dar_kern *f32);
void dar_kern_bf16(dar_kern *f32);

void dar_kern_move_ref(dar_kern *k); /* transpose and stream */
void dar_kern_move_avx2(dar_kern *k);
void dar_kern_move_avx512(dar_kern *k);

void dar_kern_random_ref(dar_kern *k); /* philox and dither */
void dar_kern_random_avx2(dar_kern *k);
void dar_kern_random_avx512(dar_kern *k);

#endif
