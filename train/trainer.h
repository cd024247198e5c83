/* trainer.h: a training run of the transformer, from its configuration to its last checkpoint.
 *
 *     dar_trainer_open(&t, &config, &options, e);        plans all memory; then, unless it only plans, reserves it
 *     dar_trainer_run(t, e);
 *     dar_trainer_close(t);
 *
 * Step k = 0, 1, ... takes the batches k accumulation ... of the loader; everything else that it depends on is in the
 * last checkpoint.  Asked to stop (lib/program.h), a run saves one and returns DAR_ERR_INTERRUPTED. */
#ifndef DAR_TRAIN_TRAINER_H
#define DAR_TRAIN_TRAINER_H

#include "train/checkpoint.h"
#include "train/clips.h"
#include "train/journal.h"
#include "train/step.h"
#include "train/validate.h"

typedef struct dar_trainer_options {
    const char *resume; /* train/checkpoint.h */
    bool plan;          /* count, do not train */
} dar_trainer_options;

/* What a run takes. */
typedef struct dar_trainer_plan {
    size_t trained, frozen;                       /* numbers */
    size_t weights, moments, batches, validation; /* [bytes]; weights: with gradients */
    size_t program;                               /* [bytes] that it takes without all that */
    size_t budget;                                /* [bytes] it may take: what was said, else the machine's memory */
    dar_step_plan step[DAR_RECOMPUTE_ALL + 1];
    dar_recompute how;
    double tokens, flops, peak; /* of a step; [FLOP] of a step; [FLOP/s] that products reach here */
} dar_trainer_plan;

typedef struct dar_trainer {
    const dar_train_config *c;
    dar_trainer_plan plan;
    dar_model *m;
    dar_clips clips;
    dar_cache *cache;
    dar_loader *loader;
    dar_arena moments;
    dar_optim optim;
    dar_step step;
    dar_weights *empty; /* text.empty, which step.empty is of; or NULL */
    dar_tensor no_text; /* of it */
    dar_checkpoint saver;
    dar_journal *journal;
    dar_validator *validator; /* NULL: nothing is validated */
    dar_json_writer text[2];  /* configuration, model */
} dar_trainer;

/* c must outlive the trainer.  On failure *out is NULL. */
dar_status dar_trainer_open(dar_trainer **out, const dar_train_config *c, const dar_trainer_options *o, dar_err *e);
void dar_trainer_close(dar_trainer *t); /* accepts NULL */

/* Bytes that the configuration allows, or that the machine has; that the program has taken so far. */
size_t dar_trainer_budget(const dar_train_config *c);
size_t dar_trainer_program(void);

/* Bytes planned, all together. */
size_t dar_trainer_bytes(const dar_trainer_plan *p);

dar_status dar_trainer_run(dar_trainer *t, dar_err *e);

#endif
