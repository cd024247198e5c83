/* ops.h: every op, as the networks call it.
 *
 * x has any storage type unless said; y has x's storage type unless said.  Gradients are f32, or f64 where x is f64.
 * Letters as in the whole project: B batch, T frames, H W height and width, C channels, N tokens, D width of the model,
 * A heads, E head size, F feed-forward width.  Shapes that do not fit abort with the op's name. */
#ifndef DAR_AUTOGRAD_OPS_H
#define DAR_AUTOGRAD_OPS_H

#include "autograd/tape.h"

/* ---------------------------------------------------------------- arithmetic */

/* ---------------------------------------------------------------- activations */

/* y = x sigmoid(x), elementwise.  Source: Elfwing et al. 2018, eq. 4. */
dar_val *dar_silu(dar_tape *t, dar_val *x);

/* y = x/2 (1 + tanh(sqrt(2/pi) (x + 0.044715 x^3))), elementwise.  Source: Hendrycks and Gimpel 2016, section 2. */
dar_val *dar_gelu_tanh(dar_tape *t, dar_val *x);

/* y = max(x, 0), elementwise; the slope at 0 is 0. */
dar_val *dar_relu(dar_tape *t, dar_val *x);

/* ---------------------------------------------------------------- norms and what surrounds them */

/* ---------------------------------------------------------------- products */

/* ---------------------------------------------------------------- attention */

/* ---------------------------------------------------------------- convolution and resampling */

/* ---------------------------------------------------------------- shape */

/* The same values in contiguous memory: always a copy. */
dar_val *dar_contiguous(dar_tape *t, dar_val *x);

/* The same values stored as `type` (f64, f32, bf16 or f16; 16 bits round to nearest even).  x itself if it is stored so
 * already. */
dar_val *dar_cast(dar_tape *t, dar_val *x, dar_dtype type);

/* Views: no copy, y shares x's memory.  Ops that need contiguous memory copy a strided view when they get it.
 *
 *   reshape   s has as many elements; a strided view is copied first
 *   slice     length indices of dimension dim, from start
 *   permute   y.d[i] = x.d[order[i]]; order has one entry per dimension */
dar_val *dar_reshape(dar_tape *t, dar_val *x, dar_shape s);
dar_val *dar_slice(dar_tape *t, dar_val *x, int dim, int64_t start, int64_t length);
dar_val *dar_permute(dar_tape *t, dar_val *x, const int *order);

/* n (1 to 8) tensors one after the other along dimension dim; the other dimensions are equal.  Stored as x[0]. */
dar_val *dar_concat(dar_tape *t, dar_val *const *x, int n, int dim);

/* Zeros around x: before[k], after[k] >= 0 of them at the ends of dimension k. */
dar_val *dar_pad(dar_tape *t, dar_val *x, const int64_t *before, const int64_t *after);

/* ---------------------------------------------------------------- reductions */

#endif
