/* kern_sets.h: the sets of kernels that fill the tables; included by the files that define or choose them. */
#ifndef DAR_LIB_KERN_SETS_H
#define DAR_LIB_KERN_SETS_H

#include "lib/kern.h"

/* Every slot but the conversions: SLOT(name) of each. */
/* clang-format off */
#define DAR_KERN_SLOTS \
    SLOT(exp) SLOT(tanh) SLOT(rsqrt) SLOT(silu) SLOT(gelu_tanh) SLOT(relu) SLOT(silu_back) \
    SLOT(gelu_tanh_back) SLOT(relu_back) SLOT(add) SLOT(mul) SLOT(offset) SLOT(scale) SLOT(axpy) \
    SLOT(mul_add) SLOT(sum) SLOT(dot) SLOT(max) SLOT(nonfinite) SLOT(exp_sum) \
    SLOT(softmax_back) SLOT(rope) SLOT(adamw) SLOT(dequantise)
/* clang-format on */

/* moments from the sums of x - first and of their squares. */
static inline void finish_moments(size_t n, double first, bool centred, double sum, double squares, double m[2])
{
    double d = centred && n ? sum / (double)n : 0;
    m[0] = first + d;
    m[1] = squares - d * sum;
}

void dar_kern_ref_f32(dar_kern *k); /* fills every slot */
void dar_kern_ref_f64(dar_kern *k);

void dar_kern_avx2(dar_kern *f32); /* replace f32 slots; do nothing where the compiler has no such instructions */
void dar_kern_avx512(dar_kern *f32);

void dar_kern_move_ref(dar_kern *k); /* transpose and stream */
void dar_kern_move_avx2(dar_kern *k);
void dar_kern_move_avx512(dar_kern *k);

#endif
