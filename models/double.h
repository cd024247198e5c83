/* double.h: nearest up-sampling by 2 and the 3 x 3 convolution behind it, in one.
 *
 * All pixels of one parity of row and column read the same 2 x 2 small ones: four 2 x 2 convolutions on the small grid,
 * with the taps that meet there summed, are 4/9 of the work.  Borders are the same.  Not recorded. */
#ifndef DAR_MODELS_DOUBLE_H
#define DAR_MODELS_DOUBLE_H

#include "autograd/tape.h"

typedef struct dar_double {
    dar_tensor w[4]; /* [Cout, Cin, 2, 2] of parity 2 row + column; data NULL: not there */
} dar_double;

/* Sum the taps of w [Cout, Cin, 3, 3], stored as `type`; memory in `a`. */
dar_double dar_double_fold(const dar_tensor *w, dar_dtype type, dar_arena *a);

/* x [B, Cin, T, h, w] -> [B, Cout, T, 2 h, 2 w]; b [Cout] or NULL. */
dar_val *dar_double_forward(dar_tape *t, const dar_double *d, dar_val *b, dar_val *x);

#endif
