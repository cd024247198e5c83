/* taew.h: the tiny autoencoder of Wan2.2's latents, for previews: `taew2_2`.
 *
 *   x   [B, 3, F, H, W]     RGB in [-1, 1], of the main type; 16 divides H and W
 *   z   [B, C, k, h, w]     latent as the transformer sees it, of the main type; k = ceil(F / 4)
 *
 * Convolutions on single frames; a `memory` block also sees its own input of the frame before.  So a clip can be cut
 * between groups of four frames, or between latent frames: one frame per memory block is kept, and the pieces give the
 * same bits as the whole.
 *
 * The encoder groups frames from the first on: where the clip ends within a group, its last frame is repeated.  The
 * decoder makes four frames of every latent one and leaves out the first three of the clip: 4 k - 3.
 *
 * Precision: as the autoencoder (models/vae.h).  Nothing is recorded.
 *
 * Source: the public implementation, madebyollin/taehv, whose pixels are in [0, 1]. */
#ifndef DAR_MODELS_TAEW_H
#define DAR_MODELS_TAEW_H

#include "models/double.h"
#include "models/params.h"
#include "models/vae.h"

/* That of the public weights: 1,494,576 numbers in the encoder, 9,923,532 in the decoder. */
extern const dar_taew_config dar_taew_public;

/* ---------------------------------------------------------------- parameters */

/* GROW stands between an up-sampling and the convolution that reads it, and works on points: on the small picture it is
 * a quarter of the work and gives the same.  So the up-sampling is part of the convolution. */
typedef enum dar_taew_kind {
    DAR_TAEW_CONV,   /* 3 x 3 */
    DAR_TAEW_HALVE,  /* with stride 2 */
    DAR_TAEW_DOUBLE, /* behind nearest up-sampling */
    DAR_TAEW_RELU,
    DAR_TAEW_MEMORY, /* y = relu(x + conv(relu(conv(relu(conv(x, x of the frame before)))))) */
    DAR_TAEW_POOL,   /* `times` frames become one: a product of their channels, older first */
    DAR_TAEW_GROW,   /* the reverse */
    DAR_TAEW_LATER,  /* the up-sampling that DOUBLE does */
    DAR_TAEW_CLAMP,  /* 3 tanh(z / 3) */
} dar_taew_kind;

typedef struct dar_taew_layer {
    dar_taew_kind kind;
    int times;
    dar_param *w[3], *b[3];
    dar_tensor back;   /* MEMORY: the first w as a convolution over two frames, [C, C, 2, 3, 3] */
    dar_double folded; /* DOUBLE */
} dar_taew_layer;

#define DAR_TAEW_ENCODER 18
#define DAR_TAEW_DECODER 23

typedef struct dar_taew {
    dar_taew_config c;
    dar_dtype storage, main;
    dar_taew_layer encoder[DAR_TAEW_ENCODER], decoder[DAR_TAEW_DECODER]; /* by the number in the public names */
} dar_taew;

/* Declare all parameters, under the names of the public checkpoint. */
void dar_taew_init(dar_taew *v, dar_params *p, const dar_taew_config *c);

/* Bring the weights into the form that is computed with; memory in `a`.  After the parameters have their values, before
 * anything below. */
void dar_taew_prepare(dar_taew *v, dar_arena *a);

/* ---------------------------------------------------------------- whole clips */

dar_val *dar_taew_encode(dar_tape *t, const dar_taew *v, dar_val *x); /* x -> z */
dar_val *dar_taew_decode(dar_tape *t, const dar_taew *v, dar_val *z); /* z -> x, cut to [-1, 1] */

/* ---------------------------------------------------------------- streams */

typedef struct dar_taew_stream {
    const dar_taew *v;
    dar_vae_side side;
    dar_arena *arena;                   /* of what is kept: pushed with the first piece */
    int64_t pieces;                     /* done */
    dar_tensor cache[DAR_TAEW_DECODER]; /* the last input of each memory block; data NULL: none yet */
} dar_taew_stream;

void dar_taew_stream_init(dar_taew_stream *s, const dar_taew *v, dar_vae_side side, dar_arena *a);

/* Four frames -> one latent frame, on the tape's arena; fewer than four: the end of the clip. */
dar_val *dar_taew_encode_next(dar_taew_stream *s, dar_tape *t, dar_val *x);

/* One latent frame -> frames, each given to sink as dar_vae_decode_next does. */
dar_status dar_taew_decode_next(dar_taew_stream *s, dar_tape *t, dar_val *z, dar_vae_sink *sink, void *ctx, dar_err *e);

#endif
