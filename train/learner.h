/* learner.h: what dar-train can train, each a learner of train/loop.h.
 *
 *   dit   the transformer, with its adapter: low-rank additions, or all of it
 *   vae   the autoencoder.  Pixels are cut out of the bundles' clips (vae.frames, .height, .width); before each
 *         checkpoint latents of whole clips are measured, and their mean and deviation written into its model.json, so
 *         that the transformer sees numbers of about 1; clips of validation.data, whole, tell the distance from pixels
 *         the run has not seen: journal lines "validate" with "psnr" [dB], mean over clips */
#ifndef DAR_TRAIN_LEARNER_H
#define DAR_TRAIN_LEARNER_H

#include "train/loop.h"

extern const dar_learner dar_learner_dit, dar_learner_vae;

#endif
