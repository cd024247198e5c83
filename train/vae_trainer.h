/* vae_trainer.h: a training run of the autoencoder, from its configuration to its last checkpoint.
 *
 * Pixels are cut out of the bundles' clips (vae.frames, .height, .width); before each checkpoint latents of whole clips
 * are measured, and their mean and deviation written into its model.json, so that the transformer sees numbers of about
 * 1; clips of validation.data, whole, tell the distance from pixels the run has not seen: journal lines "validate" with
 * "psnr" [dB], mean over clips.  All else is as for the transformer (train/trainer.h). */
#ifndef DAR_TRAIN_VAE_TRAINER_H
#define DAR_TRAIN_VAE_TRAINER_H

#include "train/trainer.h"
#include "train/vae_step.h"

typedef struct dar_vae_trainer {
    const dar_train_config *c;
    dar_trainer_plan plan;
    dar_clips clips, held;
    dar_arena weights, moments;
    dar_params params;
    dar_vae vae;
    dar_weights *file; /* what values were read from; NULL: none */
    dar_optim optim;
    dar_loader *loader, *measured, *seen; /* seen: of validation.data; NULL: there is none */
    dar_vae_step step, look;
    dar_checkpoint saver;
    dar_journal *journal;
    dar_json_writer text[2]; /* configuration, model */
} dar_vae_trainer;

/* c must outlive the trainer.  On failure *out is NULL. */
dar_status dar_vae_trainer_open(dar_vae_trainer **out, const dar_train_config *c, const dar_trainer_options *o,
                                dar_err *e);
void dar_vae_trainer_close(dar_vae_trainer *t); /* accepts NULL */

dar_status dar_vae_trainer_run(dar_vae_trainer *t, dar_err *e);

#endif
