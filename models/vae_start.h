/* vae_start.h: where a small autoencoder begins to learn: what linear maps of blocks of pixels can do.
 *
 *     dar_vae_blocks b;
 *     dar_vae_blocks_init(&b, &vae, height, width, e);
 *     for (some clips) dar_vae_blocks_add(&b, x);
 *     dar_vae_start(&b, spread);
 *     dar_vae_blocks_free(&b);
 *
 * The linear maps, if the configuration has any, become the principal components of those blocks: found by orthogonal
 * iteration from the lowest frequencies of the cosine transform on.  Without blocks they are those frequencies, with
 * the deviations of natural videos.  The last layers of both halves become 0, so that these maps are all there is at
 * first.
 *
 * A component of deviation d becomes a latent number of deviation c d^spread, c so that the mean square of all is 1:
 * spread 0 makes all alike, as the public autoencoder has them after normalisation; 1 keeps a pixel's error the same
 * wherever it comes from.  The posterior's deviation is exp(-3) of the number's own.
 *
 * Source: Golub and Van Loan 2013, algorithm 8.2.8 (orthogonal iteration). */
#ifndef DAR_MODELS_VAE_START_H
#define DAR_MODELS_VAE_START_H

#include "models/vae.h"

/* Blocks of 3 r r s numbers, s frames of r x r pixels of three colours, as the linear maps read them. */
typedef struct dar_vae_blocks {
    dar_vae *v;
    dar_arena arena;
    size_t n;        /* counted */
    size_t most;     /* of a latent frame */
    size_t length;   /* numbers of a block */
    double *product; /* [length, length], the sum of their outer products */
    double *row;     /* [most, length] */
    double *q[2];    /* [latent, length] */
    void *scratch;
} dar_vae_blocks;

/* For clips of at most that size, multiples of dar_vae_shrink. */
dar_status dar_vae_blocks_init(dar_vae_blocks *b, dar_vae *v, int64_t height, int64_t width, dar_err *e);
void dar_vae_blocks_free(dar_vae_blocks *b); /* accepts a zeroed one */

/* Pixels [B, 3, F, H, W] in [-1, 1], contiguous, f32 or f64. */
void dar_vae_blocks_add(dar_vae_blocks *b, const dar_tensor *x);

/* After the parameters have their values. */
void dar_vae_start(dar_vae_blocks *b, double spread);

#endif
