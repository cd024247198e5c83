/* conv.h: convolution in two and three dimensions as a product.
 *
 * With K = Cin kt kh kw taps and P = To Ho Wo output pixels per batch element, y[Cout, P] = w[Cout, K] col[K, P], where
 * col are the shifted input rows.  gw^T = col gy^T (lib/conv_weights.c).  gx is the convolution of gy with the kernel
 * turned round; where a stride is not 1, gcol = w^T gy, added back to where the taps came from.  A frame alone is T =
 * kt = To = 1. Without a stride in time y is made without col, and with strides of 1 gx too: lib/conv_slide.h.
 * Elsewhere col exists only in pieces that fit the second-level cache.
 *
 * Products run in bf16 if x and w are stored so, else in x's arithmetic type; sums in that type, k ascending in fixed
 * blocks, so a frame's result depends neither on the number of threads nor on the frames it is evaluated with. */
#ifndef DAR_LIB_CONV_H
#define DAR_LIB_CONV_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/tensor.h"

typedef struct dar_conv {
    size_t B, Cin, T, H, W; /* input [B, Cin, T, H, W] */
    size_t past;            /* frames in history [B, Cin, past, H, W] */
    size_t Cout, kt, kh, kw;
    size_t stride, stride_t; /* in space, in time */
    int64_t top, left,
        front;         /* zero rows and columns; frames before frame 0: the last `past` are history, the rest 0 */
    size_t To, Ho, Wo; /* output [B, Cout, To, Ho, Wo] */
} dar_conv;

typedef enum dar_conv_pass { DAR_CONV_FORWARD, DAR_CONV_BACK_X, DAR_CONV_BACK_W } dar_conv_pass;

/* Bytes of scratch for one pass with `threads` threads; x and w as stored. */
size_t dar_conv_scratch(const dar_conv *c, dar_conv_pass pass, dar_dtype x, dar_dtype w, int threads);

/* y = conv(history then x, w) + b.  b and history may have data NULL.  All tensors contiguous. */
void dar_conv_forward(const dar_conv *c, const dar_tensor *x, const dar_tensor *w, const dar_tensor *b,
                      const dar_tensor *history, const dar_tensor *y, void *scratch);

/* gx = (add ? gx : 0) + ..., likewise for history; either may have data NULL.  x_type: storage of x. */
void dar_conv_back_x(const dar_conv *c, dar_dtype x_type, const dar_tensor *w, const dar_tensor *gy,
                     const dar_tensor *gx, bool add, const dar_tensor *ghistory, bool add_history, void *scratch);

/* gw = (add ? gw : 0) + ...  w_type: storage of w. */
void dar_conv_back_w(const dar_conv *c, const dar_tensor *x, const dar_tensor *history, dar_dtype w_type,
                     const dar_tensor *gy, const dar_tensor *gw, bool add, void *scratch);

/* gb = (add ? gb : 0) + sum of gy over batch and pixels. */
void dar_conv_back_b(const dar_conv *c, const dar_tensor *gy, const dar_tensor *gb, bool add);

#endif
