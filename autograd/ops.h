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

/* ---------------------------------------------------------------- reductions */

#endif
