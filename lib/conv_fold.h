/* conv_fold.h: convolution to few channels, where making col costs more than the product.  Part of lib/conv.h.
 *
 * The columns of the kernel become rows of the result: with z[o kw + i] the convolution of x with column i of the
 * kernel alone, y[o] = b[o] + sum over i of z[o kw + i], shifted by i - left.  Then x is read as it lies: once packed,
 * a run of a frame's rows serves all kh rows of the kernel. */
#ifndef DAR_LIB_CONV_FOLD_H
#define DAR_LIB_CONV_FOLD_H

#include "lib/conv.h"

/* Whether it is for this convolution; then the rest as dar_conv_scratch and dar_conv_forward. */
bool dar_conv_fold_fits(const dar_conv *c);
size_t dar_conv_fold_scratch(const dar_conv *c, dar_dtype x, dar_dtype w, int threads);
void dar_conv_fold_forward(const dar_conv *c, const dar_tensor *x, const dar_tensor *w, const dar_tensor *b,
                           const dar_tensor *history, const dar_tensor *y, void *scratch);

#endif
