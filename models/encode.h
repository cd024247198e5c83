/* encode.h: clips to latents and back, a piece at a time, in the memory of one piece: what is known of a video, for
 * sampling and for training; the videos that training learns from; and those that are made. */
#ifndef DAR_MODELS_ENCODE_H
#define DAR_MODELS_ENCODE_H

#include "models/vae.h"

/* rgb [H, W, 3], display values, as frame f of pixels x [1, 3, n, H, W] in [-1, 1]; NULL: grey, which is 0. */
void dar_encode_frame(const dar_tensor *x, int64_t f, const uint8_t *rgb);

/* Write the pixels x [1, 3, n, H, W], contiguous, of a piece: n = 1 for the first, then as many as become one latent
 * frame.  Anything but DAR_OK ends the work. */
typedef dar_status dar_encode_source(void *ctx, int64_t piece, const dar_tensor *x, dar_err *e);

/* Moments y [1, 2 C, F, h, w], main type, of F pieces.  The tape does not record; `kept` holds what is kept between
 * pieces during the call.  skip: pieces that must repeat are not computed.  When planning, the source is not asked. */
dar_status dar_encode_clip(dar_tape *t, const dar_vae *v, dar_arena *kept, bool skip, dar_encode_source *source,
                           void *ctx, const dar_tensor *y, dar_err *e);

/* Take frame `index`, display values rgb [H, W, 3], which are gone afterwards.  Anything but DAR_OK ends the work. */
typedef dar_status dar_decode_sink(void *ctx, size_t index, const uint8_t *rgb, dar_err *e);

/* Frames of a latent z [1, C, F, h, w] in order.  The tape does not record; `kept` as above.  DAR_ERR_NUMERIC: a frame
 * is not finite.  When planning, the sink gets nothing. */
dar_status dar_decode_clip(dar_tape *t, const dar_vae *v, dar_arena *kept, const dar_tensor *z, dar_decode_sink *sink,
                           void *ctx, dar_err *e);

#endif
