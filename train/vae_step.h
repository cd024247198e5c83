/* vae_step.h: one training step of the autoencoder: pixels become gradients.
 *
 *     z    = mean + exp(log-variance / 2) eps + noise eps'          eps, eps' normal, by (seed, clip of the run)
 *     loss = distance(decode(z), x) + edge distance(slopes of that, slopes of x) + kl mean of the divergence
 *
 * distance: mean of sqrt(d^2 + round^2), or of d^2 where round is 0.  slopes: differences of neighbours in rows and
 * columns.  divergence: of a latent's posterior from the unit normal, (mean^2 + variance - 1 - log-variance) / 2.
 *
 * Sources: Kingma and Welling 2014, section 2.3 and appendix B; Rombach et al. 2022, section 3.1 (a small divergence);
 * Charbonnier et al. 1994. */
#ifndef DAR_TRAIN_VAE_STEP_H
#define DAR_TRAIN_VAE_STEP_H

#include "models/vae.h"
#include "train/loader.h"

typedef struct dar_vae_loss {
    double round, edge, kl, noise;
    uint64_t seed;
    int64_t parts; /* batches whose gradients become one step; 0: they are only looked at */
} dar_vae_loss;

typedef struct dar_vae_step {
    dar_vae_loss c;
    dar_vae *v;
    double forward, backward; /* [FLOP] of a batch */

    /* Of the step itself. */
    dar_arena step;
    dar_tape tape;
} dar_vae_step;

/* Bytes and work of batches of pixels [B, 3, F, H, W] are counted, and unless v's parameters lie on a planning arena,
 * reserved.  v, whose parameters have values and gradients, must outlive *s.  On failure *s is freed. */
dar_status dar_vae_step_init(dar_vae_step *s, dar_vae *v, const dar_vae_loss *c, dar_shape pixels, bool plan,
                             dar_err *e);
void dar_vae_step_free(dar_vae_step *s); /* accepts a zeroed one */

typedef struct dar_vae_report {
    double loss, distance, edge, kl; /* kl: of a latent number [nat] */
    double square;                   /* mean squared distance of pixels in [-1, 1] */
} dar_vae_report;

/* Decibels of that, of the 2 that black and white are apart. */
double dar_vae_psnr(double square);

/* Forward and backward of batch `part` of a step; gradients are added to those of the parameters, so that after all
 * parts they are of the mean.  x is f32 or f64. */
dar_vae_report dar_vae_step_run(dar_vae_step *s, const dar_tensor *x, int64_t step, int64_t part);

/* ---------------------------------------------------------------- looking */

/* Sums over latents, channel by channel. */
typedef struct dar_vae_sums {
    double n, sum[DAR_VAE_LATENT], square[DAR_VAE_LATENT];
} dar_vae_sums;

/* Forward alone, of the posterior's mean, pixels cut to [-1, 1]; adds to sums, which may be NULL. */
dar_vae_report dar_vae_step_look(dar_vae_step *s, const dar_tensor *x, dar_vae_sums *sums);

/* Mean and deviation per channel. */
void dar_vae_standard(const dar_vae_sums *s, int64_t channels, double *mean, double *std);

#endif
