/* dit.h: the diffusion transformer of Wan2.2 with a control adapter: velocity of a noisy latent.
 *
 *   scene = what is constant over a clip (dar_dit_scene_prepare): adapter output, known video, positions
 *   text  = what is constant over a prompt (dar_dit_text_prepare): keys and values of every block's cross-attention
 *   v     = dar_dit_forward(scene, text, z, time)
 *
 * All three are functions over ops: with recording on they train, with recording off they sample, on a planning arena
 * they count.  When sampling, scene and text are prepared once on a tape of their own, which must live and not be
 * cleared while they are used; when training, on the tape of the step.
 *
 * Precision (f32 throughout in f32, f64 in f64).  Operands of the products of blocks, of the text embedding and of the
 * adapter's 3 x 3 convolutions are of the storage type, sums f32.  f32 whatever the storage: residual stream, norms,
 * modulation, gates, times, patch embedding, the adapter's first product, head, velocity.
 *
 * Letters: B clips, F latent frames, h w latent size, L = F (h / p) (w / p) tokens in the order f, i, j.
 *
 * Source: Wan team 2025, section 4.2; the reference model, WanModel; the paper, section 3. */
#ifndef DAR_MODELS_DIT_H
#define DAR_MODELS_DIT_H

#include <stdbool.h>
#include <stdint.h>

#include "autograd/ops.h"
#include "models/adapter.h"
#include "models/config.h"
#include "models/params.h"

/* ---------------------------------------------------------------- parameters */

/* A product with weights, with its low-rank addition if it has one: y = x W^T + b + scale (x A^T) U^T. */
typedef struct dar_dit_product {
    dar_param *w, *b;
    dar_param *down, *up; /* A [r, in], U [out, r]; NULL: none */
    double scale;         /* strength alpha / r */
    bool merged;          /* w holds W + scale U A (models/lora.h) */
    dar_tensor other;     /* where w is mapped: memory for the merged one, or, when merged, the mapped one */
} dar_dit_product;

typedef struct dar_dit_block {
    dar_param *modulation; /* [1, 6, D]: shift, scale, gate of self-attention, then of the feed-forward layer */
    dar_dit_product product[DAR_PROJECTIONS];
    dar_param *norm_q[2], *norm_k[2]; /* of self-, of cross-attention; over all D features */
    dar_param *norm3_w, *norm3_b;     /* before cross-attention */
} dar_dit_block;

/* What backward computes again, to save memory; from the least memory to the least time.  What is not computed again
 * lies in the tape's keep arena; without one, all is. */
typedef enum dar_dit_replay {
    DAR_REPLAY_ALL,
    DAR_REPLAY_PRODUCTS, /* all but attention */
    DAR_REPLAY_WIDE,     /* of products, the one whose result is as wide as the feed-forward layer */
    DAR_REPLAY_CHEAP,    /* norms, modulation, rotation, activations: a few percent of the time */
    DAR_REPLAY_NOTHING,
    DAR_REPLAYS
} dar_dit_replay;

extern const char *const dar_dit_replay_name[DAR_REPLAYS + 1]; /* "all", "products", "wide", "cheap", "nothing", NULL */

typedef struct dar_dit {
    dar_dit_config c;
    dar_dtype storage, main;
    dar_param *patch_w, *patch_b;
    dar_param *text_w[2], *text_b[2];
    dar_param *time_w[3], *time_b[3]; /* embedding, embedding, projection */
    dar_param *head_modulation, *head_w, *head_b;
    dar_dit_block *block; /* [layers] */
    dar_adapter adapter;

    bool quantise; /* products whose weights are stored in 8 bits round their operands too: faster, less exact */
    dar_dit_replay replay;
    int64_t piece; /* numbers [tokens, feed-forward width] of that layer that are held at a time */
} dar_dit;

/* Declare all parameters, under the names of the public checkpoint.  m->block is on the heap. */
void dar_dit_init(dar_dit *m, dar_params *p, const dar_dit_config *c, const dar_adapter_config *a);
void dar_dit_free(dar_dit *m); /* accepts a zeroed one */

/* ---------------------------------------------------------------- a clip, a prompt */

typedef struct dar_dit_clip {
    int64_t clips, frames, height, width; /* B, F, h, w */
    dar_tensor cond;  /* [B, C, F, H, W] of the adapter, f32 or f64; data NULL: the adapter's output counts as 0 */
    dar_tensor known; /* [B, mask + latent, F, h, w] of the main type; data NULL: zeros, nothing is known */
} dar_dit_clip;

typedef struct dar_dit_scene {
    dar_shape latent; /* [B, C, F, h, w] */
    int64_t frame;    /* tokens in a frame */
    dar_val *base;    /* [B, L, D] added to the patch embedding; NULL: nothing is */
    dar_val *rope;    /* [L, D / A] */
    bool held;        /* the velocity of the first frame is not wanted; only where nothing is recorded */
} dar_dit_scene;

/* clip->cond and clip->known must live as long as the scene; *s and *x below must stay where they are until backward.
 */
void dar_dit_scene_prepare(dar_tape *t, const dar_dit *m, const dar_dit_clip *clip, dar_dit_scene *s);

typedef struct dar_dit_text {
    dar_val **k, **v;    /* per block [B, n + 1, D]: the tokens, and the zeros after them as one key */
    dar_val *log_weight; /* [B, n + 1]: 0, -inf beyond a clip's own count, log of how many zeros there are */
} dar_dit_text;

/* text [B, n, text width] of any float type, count[b] of which are real (NULL: all); n = 0: no token at all. */
void dar_dit_text_prepare(dar_tape *t, const dar_dit *m, const dar_tensor *text, const int64_t *count, dar_dit_text *x);

/* ---------------------------------------------------------------- forward */

/* Times, 1000 sigma, one row [rows] per clip: rows 1 for every token, 2 for the first frame and the rest, F per frame.
 */
typedef struct dar_dit_time {
    const double *t; /* [B, rows]; not read when planning */
    int64_t rows;
} dar_dit_time;

/* Velocity of z [B, C, F, h, w], of the main type -> the same; of a scene that is held -> [B, C, F - 1, h, w]: of the
 * first frame the last block makes keys and values alone. */
dar_val *dar_dit_forward(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_text *x, dar_val *z,
                         const dar_dit_time *time);

/* The stages of it. */
typedef struct dar_dit_moment {
    dar_val *e;  /* [B, R, D] */
    dar_val *e0; /* [B, R, 6 D] */
} dar_dit_moment;

dar_dit_moment dar_dit_time_embed(dar_tape *t, const dar_dit *m, int64_t clips, const dar_dit_time *time);
dar_val *dar_dit_embed(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, dar_val *z); /* -> [B, L, D] */
dar_val *dar_dit_blocks(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_text *x,
                        const dar_dit_moment *e, dar_val *tokens); /* [B, L, D]; overwrites tokens if not recording */

/* The same in two halves, when nothing is recorded.  No text enters the first, so prompts can share it: the first
 * block's self-attention, in place. */
void dar_dit_blocks_begin(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_moment *e,
                          dar_val *tokens);
dar_val *dar_dit_blocks_end(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_text *x,
                            const dar_dit_moment *e, dar_val *tokens);

/* What the first block's products read, in the main type: tokens, normed and modulated. */
dar_val *dar_dit_blocks_read(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_moment *e,
                             dar_val *tokens);

/* Of a scene that is held: tokens without those of the first frame, velocity without it. */
dar_val *dar_dit_head(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_moment *e, dar_val *tokens);

/* The head's result y as a velocity; y itself unless m->c.precondition.  Then, with s = time / 1000,
 *
 *     v = ((2 s - 1) z + y sqrt(n)) / n,    n = s^2 + (1 - s)^2
 *
 * where the first term is the best linear guess of v = noise - x from z = (1 - s) x + s noise for x of unit variance,
 * and y what is left of it, of unit variance at every s.  Noise need not pass through the network to be subtracted,
 * which a network hardly wider than a token's numbers learns late.  Source: Karras et al., Elucidating the Design Space
 * of Diffusion-Based Generative Models, 2022, appendix B.6, for this interpolant. */
dar_val *dar_dit_velocity(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, dar_val *y, dar_val *z,
                          const dar_dit_time *time);

/* A block by itself: x [B, L, D], as it is (no segment). */
dar_val *dar_dit_block_forward(dar_tape *t, const dar_dit *m, int block, const dar_dit_scene *s, const dar_dit_text *x,
                               dar_val *e0, dar_val *tokens);

/* A product with its low-rank addition; operands of the storage type, activation and what is kept as asked. */
dar_val *dar_dit_multiply(dar_tape *t, const dar_dit *m, const dar_dit_product *p, dar_act act, dar_keep keep,
                          dar_val *x);

/* ---------------------------------------------------------------- what is known of the video */

/* Mask and known-video channels y [B, mask + C, F, h, w] from the known video's latent [B, C, F, h, w] and which of its
 * (F - 1) mask + 1 frames are seen.  Mask channel k of latent frame f is 1 if frame max(0, f mask + k - mask + 1) is;
 * so the first frame fills the first latent frame. */
void dar_dit_known(const dar_tensor *y, const dar_tensor *latent, const bool *seen);

/* z's first frame becomes that of `latent` [B, C, 1 .., h, w]: before the first step of a solver and after each, where
 * the first frame is known.  Its time is then 0. */
void dar_dit_hold_first(const dar_tensor *z, const dar_tensor *latent);

#endif
