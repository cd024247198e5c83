/* step.h: one training step of the transformer: a batch becomes gradients.
 *
 *     sigma, noise  of clip n of the run, each a pure function of (seed, n)
 *     z = (1 - sigma) z0 + sigma eps, v = eps - z0                       models/flow.h
 *     loss = mean of w (network(z, 1000 sigma) - v)^2                    on the tape; backward
 *
 * By loss.first_frame the first latent frame is clean, has time 0 and is not counted (the mean is over the others), or
 * is counted, or is as noisy as the others.  n = (step accumulation + part) B + slot: nothing random depends on
 * threads, on how far batches were read ahead, or on where a run was resumed.
 *
 * Source: the paper, section 3.5; Lipman et al. 2023, eq. 23. */
#ifndef DAR_TRAIN_STEP_H
#define DAR_TRAIN_STEP_H

#include "models/dit.h"
#include "train/config.h"
#include "train/loader.h"

/* What memory and work depend on. */
typedef struct dar_step_size {
    int64_t clips, frames, height, width; /* of the latent */
    int64_t words;                        /* most tokens of a text */
    int64_t cond;                         /* channels of the condition; 0: none */
    int64_t pixels;                       /* of it to a row or column of the latent */
} dar_step_size;

/* One way of keeping what backward needs. */
typedef struct dar_step_plan {
    size_t bytes[2];          /* of the step's memory, and of what segments keep */
    double forward, backward; /* [FLOP] of a batch */
} dar_step_plan;

typedef struct dar_step {
    const dar_train_config *c;
    dar_dit *m;
    dar_recompute how;
    dar_step_plan plan;
    dar_tensor empty; /* [1, n, text width] that stands for no text; data NULL: no token does */

    /* Of the step itself. */
    dar_arena step, keep;
    dar_tape tape;
} dar_step;

/* Count a batch of this size: memory and work in each of the ways, indexed by dar_recompute.  The parameters have
 * values and gradients, or are planned. */
dar_status dar_step_count(dar_step_plan plan[DAR_RECOMPUTE_ALL + 1], const dar_train_config *c, dar_dit *m,
                          const dar_step_size *size, dar_err *e);

/* The way that the configuration asks for; auto: the one with least work that fits in `bytes`, and if two have the
 * same, the one with less memory; else the smallest. */
dar_recompute dar_step_choose(const dar_train_config *c, const dar_step_plan plan[DAR_RECOMPUTE_ALL + 1], size_t bytes);

/* Reserve memory for it.  c and m must outlive *s.  On failure *s is freed. */
dar_status dar_step_init(dar_step *s, const dar_train_config *c, dar_dit *m, dar_recompute how,
                         const dar_step_plan *plan, dar_err *e);
void dar_step_free(dar_step *s); /* accepts a zeroed one */

typedef struct dar_step_report {
    double loss;                    /* mean over the batch */
    double sigma;                   /* likewise */
    double draw, forward, backward; /* [s] */
} dar_step_report;

/* Forward and backward of batch `part` of a step; gradients are added to those of the parameters, so that after all
 * parts they are of the mean. */
dar_step_report dar_step_run(dar_step *s, const dar_batch *b, int64_t step, int64_t part);

/* Forward alone, with the noise that the batch would have there, and each clip's text. */
dar_step_report dar_step_look(dar_step *s, const dar_batch *b, int64_t step);

#endif
