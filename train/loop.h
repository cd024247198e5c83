/* loop.h: a training run, from its configuration to its last checkpoint, whatever it is that learns.
 *
 *     dar_loop_open(&l, &dar_learner_dit, &config, &options, e);    plans all memory; then, unless it only plans, takes
 * it s = dar_loop_run(l, e); dar_loop_close(l);
 *
 * What all runs have in common is here: the clips, the plan, the optimiser, checkpoints, the journal, when to look and
 * when to save.  What learns is a learner (train/learner.h), a table of calls.
 *
 * Step k = 0, 1, ... takes the batches k accumulation ... of the loader; everything else that it depends on is in the
 * last checkpoint.  Where weights are averaged (ema_decay), the average is what is validated, and what checkpoints give
 * others.  Asked to stop (lib/program.h), a run saves one and returns DAR_ERR_INTERRUPTED. */
#ifndef DAR_TRAIN_LOOP_H
#define DAR_TRAIN_LOOP_H

#include "train/checkpoint.h"
#include "train/clips.h"
#include "train/journal.h"
#include "train/step.h"

typedef struct dar_loop dar_loop;

/* What a run takes. */
typedef struct dar_loop_plan {
    size_t trained, frozen;                       /* numbers */
    size_t weights, moments, batches, validation; /* [bytes]; weights: with gradients */
    size_t program;                               /* [bytes] that it takes without all that */
    size_t budget;                                /* [bytes] it may take: what was said, else the machine's memory */
    dar_step_plan step[DAR_RECOMPUTE_ALL + 1];
    dar_recompute how;
    double tokens, flops, peak; /* of a step; [FLOP] of a step; [FLOP/s] that products reach here */
} dar_loop_plan;

/* Bytes planned, all together. */
size_t dar_loop_bytes(const dar_loop_plan *p);

/* Mean loss of a batch, and mean sigma of its noise, if it has one. */
typedef struct dar_loop_batch {
    double loss, sigma;
} dar_loop_batch;

/* What learns.  Its calls find their own memory in l->state, and are made in this order:
 *
 *     network, prepare, drop     planning
 *     network, prepare           then the steps: batch; now and then validate, describe
 *     drop                       also after a failure of any of them */
typedef struct dar_learner {
    size_t size; /* of the state, which is zeroed before a network is made */

    /* The network with values and gradients: sets l->params, and l->dit if it is a transformer.  Planning, all of it on
     * planning arenas, it sets l->plan.weights. */
    dar_status (*network)(dar_loop *l, bool plan, dar_err *e);

    /* The rest.  Planning, it counts the l->plan that is its own: batches, validation, step, tokens.  Else it may
     * still set the weights that a run which was not resumed, l->saver.step = 0, starts from; l->plan.how says how
     * steps are run. */
    dar_status (*prepare)(dar_loop *l, bool plan, dar_err *e);

    /* Forward and backward of batch `part` of a step: gradients are added, so that after all parts they are of the
     * mean. */
    dar_status (*batch)(dar_loop *l, int64_t step, int64_t part, dar_loop_batch *b, dar_err *e);

    /* After `step` steps, here and below with the average of the weights in their place: look at clips that are not
     * learned from, if there are any, and tell the journal. */
    dar_status (*validate)(dar_loop *l, int64_t step, dar_err *e);

    /* Set what a checkpoint made now says of its weights, in the model's description. */
    dar_status (*describe)(dar_loop *l, dar_json_doc *model, dar_err *e);

    void (*drop)(dar_loop *l);
} dar_learner;

struct dar_loop {
    const dar_learner *learner;
    const dar_train_config *c;
    dar_clips clips; /* of data */
    dar_loop_plan plan;
    void *state;        /* the learner's */
    dar_params *params; /* likewise */
    const dar_dit *dit; /* likewise; NULL: it is no transformer */
    dar_arena moments;
    dar_optim optim;
    dar_checkpoint saver;
    dar_journal *journal;
    dar_json_writer text[2]; /* configuration, model */
};

typedef struct dar_loop_options {
    const char *resume; /* train/checkpoint.h */
    bool plan;          /* count, do not train */
} dar_loop_options;

/* c must outlive the loop.  On failure *out is NULL. */
dar_status dar_loop_open(dar_loop **out, const dar_learner *learner, const dar_train_config *c,
                         const dar_loop_options *o, dar_err *e);
void dar_loop_close(dar_loop *l); /* accepts NULL */

dar_status dar_loop_run(dar_loop *l, dar_err *e);

/* For learners: the clips as the configuration wants them read; what they are read for is to be added. */
dar_loader_config dar_loop_loader(const dar_loop *l, bool plan);

#endif
