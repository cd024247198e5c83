/* validate.h: what a network in training makes of clips that it does not learn from, and whether it heeds its
 * condition.
 *
 *   samples     some are rendered, without guidance, always from the same noise, and compared with the truth
 *               (data/metric.h): RUN/samples/step-00001000/NAME.png shows both
 *   sensitivity the loss of each with its own condition and with that of the next clip, under the same noise: a network
 *               that does not look at its condition does not tell them apart
 *
 * Both are lines of the journal: "validate" and "sensitivity". */
#ifndef DAR_TRAIN_VALIDATE_H
#define DAR_TRAIN_VALIDATE_H

#include "models/model.h"
#include "train/clips.h"
#include "train/journal.h"
#include "train/step.h"

typedef struct dar_validator dar_validator;

/* Clips of validation.data, of one size, which is that of `latent` [B, C, F, h, w].  If the model only plans, only
 * memory is counted.  Everything must outlive the validator.  On failure *out is NULL; without such clips it is NULL
 * too. */
dar_status dar_validator_open(dar_validator **out, const dar_train_config *c, const dar_model *m, dar_cache *cache,
                              dar_shape latent, dar_err *e);
void dar_validator_close(dar_validator *v); /* accepts NULL */

const dar_clips *dar_validator_clips(const dar_validator *v);
size_t dar_validator_bytes(const dar_validator *v); /* v NULL: 0 */

/* After `step` steps. */
dar_status dar_validator_run(dar_validator *v, dar_step *s, dar_journal *j, int64_t step, dar_err *e);

#endif
