/* adapter.h: the control adapter: packed rays and geometry, at the resolution of the pixels, become a map that is added
 * to the tokens once.
 *
 *   unshuffle   channel c, pixel (r Y + dy, r X + dx) is coarse channel (c r + dy) r + dx at (Y, X)
 *   conv        2 x 2, stride 2: a token sees 2 r x 2 r pixels.  With the unshuffle one product per token:
 *               y = W p + b, p[((c r + dy) r + dx) 4 + 2 ky + kx] = cond[c, r (2 i + ky) + dy, r (2 j + kx) + dx]
 *   blocks      x = x + conv3x3(relu(conv3x3(x))), zero padding
 *
 * Frames do not mix.  Channels are outermost in W: geometry appended to the rays appends columns.  The condition and
 * the first product are f32, since world positions need more than 8 bits; the 3 x 3 convolutions have the operands of
 * the network's other products.
 *
 * Source: the paper, section 3.2; the reference model, SimpleAdapter. */
#ifndef DAR_MODELS_ADAPTER_H
#define DAR_MODELS_ADAPTER_H

#include <stdint.h>

#include "models/config.h"
#include "models/params.h"

enum { DAR_ADAPTER_W1, DAR_ADAPTER_B1, DAR_ADAPTER_W2, DAR_ADAPTER_B2 };

typedef struct dar_adapter {
    dar_adapter_config c;
    int64_t width;
    dar_dtype storage, main;
    int64_t group;    /* patches of as many pictures as this many numbers hold are made at a time, at least one's */
    dar_param *w, *b; /* NULL: there is no adapter */
    dar_param *block[DAR_ADAPTER_BLOCKS][4];
} dar_adapter;

/* Declare its parameters; none if c has no channels. */
void dar_adapter_init(dar_adapter *a, dar_params *p, const dar_adapter_config *c, int64_t width);

/* cond [B, C, F, H, W], f32 or f64, contiguous -> [B, F h w, D], h = H / 2 r, w = W / 2 r.  A few frames at a time,
 * each group a recompute segment.  cond must live until backward. */
dar_val *dar_adapter_forward(dar_tape *t, const dar_adapter *a, const dar_tensor *cond);

/* The rows p above of n pictures from `first` (picture b F + f): out [n h w, 4 r r C], f32 or f64. */
void dar_adapter_patches(const dar_tensor *cond, int64_t r, int64_t first, const dar_tensor *out);

/* Give the first convolution the weights x of a file, [D, C' r r, 2, 2] with C' <= C.  If C' < C, a.c.widen decides:
 * copy appends zeros, so that the first C' channels act as before and the others not at all; fresh ignores x. */
dar_status dar_adapter_bind(dar_params *p, const dar_adapter *a, const dar_tensor *x, uint64_t seed, dar_err *e);

#endif
