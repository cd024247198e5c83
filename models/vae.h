/* vae.h: the autoencoder of Wan2.2: clips to latents and back, as a whole or streaming.
 *
 *   x         [B, 3, F, H, W]      RGB in [-1, 1]; F = 1 + k s, H and W multiples of the factor r (dar_vae_shrink)
 *   moments   [B, 2 C, 1 + k, h, w]   mean, then log-variance
 *   z         [B, C, 1 + k, h, w]  latent as the transformer sees it: (mean - config.mean) / config.std
 *
 * Every level is causal in time: a latent frame depends on the frames up to its own.  So a clip may be cut: its first
 * frame, then s at a time (latent frames: one at a time), with the last inputs of every convolution over time kept in
 * between, gives the same bits as the whole clip.  Memory is then that of one such piece.
 *
 * Precision: products have operands of the storage type and f32 sums; everything is stored as the storage type between
 * them, but for pixels, moments and z, which are of the main type.
 *
 * Source: Wan team 2025, section 4.1; the reference model, WanVAE (2.2); shortcuts: Chen et al. 2024 (DC-AE). */
#ifndef DAR_MODELS_VAE_H
#define DAR_MODELS_VAE_H

#include "autograd/ops.h"
#include "models/config.h"
#include "models/double.h"
#include "models/params.h"

/* ---------------------------------------------------------------- parameters */

typedef struct dar_vae_conv {
    dar_param *w, *b; /* NULL: there is none */
    int slot;         /* of what it keeps of a stream; -1: it does not look back */
} dar_vae_conv;

typedef struct dar_vae_res {
    dar_param *norm[2];
    dar_vae_conv conv[2], shortcut;
} dar_vae_res;

typedef struct dar_vae_level {
    dar_vae_res block[DAR_VAE_BLOCKS];
    int blocks;
    int64_t in, out;
    bool halve, halve_time;   /* encoder: at its end; decoder: the reverse */
    dar_vae_conv space, time; /* of that */
    dar_double folded;        /* decoder: `space` on the small grid (dar_vae_fold) */
} dar_vae_level;

typedef struct dar_vae_half {
    dar_vae_conv first, last;
    dar_vae_level level[DAR_VAE_LEVELS]; /* in the order of use */
    dar_vae_res middle[2];
    dar_param *attn_norm;
    dar_vae_conv qkv, proj;
    dar_param *norm;
    int slots;
} dar_vae_half;

typedef struct dar_vae {
    dar_vae_config c;
    dar_dtype storage, main;
    bool whole; /* record residual blocks as they are, not as recompute segments: faster, more memory */
    dar_vae_half encoder, decoder;
    dar_vae_conv moments, post; /* 1 x 1 x 1 behind the encoder, before the decoder */
    dar_vae_conv linear[2];     /* [2 C, P], [P, C], P = 3 r r s: beside encoder and decoder; NULL: there are none */
    dar_tensor mean, std, rate; /* [C, 1, 1, 1], main type; rate = 1 / std */
} dar_vae;

/* Declare all parameters, under the names of the public checkpoint.  *v must stay where it is. */
void dar_vae_init(dar_vae *v, dar_params *p, const dar_vae_config *c);

/* Fold the decoder's convolutions behind up-sampling (models/double.h), for use when nothing is recorded.  After the
 * parameters have their values; memory in `a`. */
void dar_vae_fold(dar_vae *v, dar_arena *a);

/* ---------------------------------------------------------------- whole clips */

/* x -> moments, z -> pixels, not clamped.  Every residual block is a recompute segment. */
dar_val *dar_vae_encode(dar_tape *t, const dar_vae *v, dar_val *x);
dar_val *dar_vae_decode(dar_tape *t, const dar_vae *v, dar_val *z);

/* Mean, or log-variance, of moments; mean -> z. */
dar_val *dar_vae_mean(dar_tape *t, const dar_vae *v, dar_val *moments);
dar_val *dar_vae_log_variance(dar_tape *t, const dar_vae *v, dar_val *moments);
dar_val *dar_vae_normalise(dar_tape *t, const dar_vae *v, dar_val *mean);

/* ---------------------------------------------------------------- streams
 *
 *     dar_vae_stream s;
 *     dar_vae_stream_init(&s, &v, DAR_VAE_DECODER, arena);
 *     for (each latent frame) dar_vae_decode_next(&s, &tape, z, sink, ctx, e);
 *
 * The tape does not record.  What is kept between pieces is pushed on `arena` with the first two pieces. */

typedef enum dar_vae_side { DAR_VAE_ENCODER, DAR_VAE_DECODER } dar_vae_side;

#define DAR_VAE_SLOTS 128

typedef struct dar_vae_stream {
    const dar_vae *v;
    dar_vae_side side;
    dar_arena *arena;
    int64_t pieces;                  /* done */
    dar_tensor cache[DAR_VAE_SLOTS]; /* the last frames each convolution has read; data NULL: none yet */

    /* Repetition: what the piece before read and gave, and whether it left what is kept as it was. */
    bool skip;                           /* on by default: pieces that must repeat are not computed */
    dar_tensor pixels;                   /* of the piece before */
    dar_tensor part[DAR_VAE_LEVELS + 1]; /* its results: of the levels, and of what follows */
    bool steady[DAR_VAE_LEVELS + 1];     /* the part left its caches as they were */
    int64_t skipped;                     /* parts, in all */
} dar_vae_stream;

void dar_vae_stream_init(dar_vae_stream *s, const dar_vae *v, dar_vae_side side, dar_arena *a);

/* The first frame [B, 3, 1, H, W], then s frames each -> moments of one latent frame, on the tape's arena. */
dar_val *dar_vae_encode_next(dar_vae_stream *s, dar_tape *t, dar_val *x);

/* Contiguous pixels of the main type, cut to [-1, 1] in place. */
void dar_vae_clamp(const dar_tensor *x);

/* One latent frame z [B, C, 1, h, w].  sink gets each frame [B, 3, 1, H, W], main type, clamped to [-1, 1], in order;
 * its memory is gone afterwards.  sink NULL: nobody looks. */
typedef dar_status dar_vae_sink(void *ctx, const dar_tensor *frame, int64_t index, dar_err *e);
dar_status dar_vae_decode_next(dar_vae_stream *s, dar_tape *t, dar_val *z, dar_vae_sink *sink, void *ctx, dar_err *e);

#endif
