/* checkpoint.h: what a run needs to go on as if it had never stopped, in directories that are whole or not there.
 *
 *     dar_checkpoint c = { .run = "out/run", .params = &p, .dit = &m, .optim = &o, .seed = 7, .keep = 3, ... };
 *     DAR_TRY(dar_checkpoint_open(&c, e));
 *     s = dar_checkpoint_resume(&c, "auto", e);              c.step: done before
 *     for (...) if (...) s = dar_checkpoint_save(&c, step, e);
 *     dar_checkpoint_close(&c);
 *
 *   RUN/checkpoint-2000/
 *     lora.safetensors         trained low-rank additions, as models/lora.h writes them
 *     adapter.safetensors      trained parameters of the adapter, named as in the public checkpoint
 *     dit.safetensors          or vae: instead of the adapter, where the network itself is trained: all of it
 *     optimizer.safetensors    moments m.NAME, v.NAME of every trained parameter, as they are stored; where weights are
 *                              averaged, w.NAME too: the weights that training goes on from
 *     config.json, model.json  the resolved configuration; what the weights are, for dar-sample
 *     checkpoint.json          step, counts, seed; size and SHA-256 of every file above
 *
 * Where weights are averaged, it is the average that the files for others hold: save and resume are called with it in
 * its place (dar_optim_swap).
 *
 * Trained tensors are written in the type they are trained in, so all of it comes back bit for bit.  What is random in
 * training is a pure function of seed and step, so those two are the state of the generators and of the data order.
 *
 * A checkpoint is written beside its place, flushed, renamed in one moment: whoever is killed, or has no room on the
 * disk, leaves the older ones as they were.  What killed runs left is removed by the next one. */
#ifndef DAR_TRAIN_CHECKPOINT_H
#define DAR_TRAIN_CHECKPOINT_H

#include <limits.h>

#include "models/dit.h"
#include "train/optim.h"

typedef struct dar_checkpoint {
    const char *run;    /* directory */
    dar_params *params; /* with values */
    const dar_dit *dit; /* whose parameters they are, for alpha; NULL: of an autoencoder, written as vae */
    dar_optim *optim;   /* over the same parameters */
    uint64_t seed;
    const char *config, *model; /* JSON texts, of any lifetime between calls; NULL: no such file */
    int64_t keep;               /* checkpoints in the run, at least 1 */

    int64_t step; /* of the one that was resumed or saved last; 0 before */

    /* Of the checkpoint itself. */
    int lock;
} dar_checkpoint;

/* Make the directory of the run if it is not there, remove what killed writers left in it, and hold it: two programs
 * never write one run.  On failure nothing is owed. */
dar_status dar_checkpoint_open(dar_checkpoint *c, dar_err *e);
void dar_checkpoint_close(dar_checkpoint *c); /* accepts one that was not opened but is zeroed */

/* Take up where a run stopped: parameters, moments, counts and c->step become those of a checkpoint.
 *
 *   NULL     start anew; refused if the run has checkpoints
 *   "auto"   the newest that is whole; damaged ones are named in a warning each and passed over.  c->step stays 0 if
 *            the run has none; if it has, and all are damaged, that is a failure
 *   DIR      that one, of this or of another run.  Refused if this run has a newer one that is whole
 *
 * Keys of the configuration that are others than they were are named in a line each.  Fails if seed, names, shapes or
 * types are not those of the run.  After a failure parameters and moments are undefined. */
dar_status dar_checkpoint_resume(dar_checkpoint *c, const char *from, dar_err *e);

/* Write checkpoint-STEP.  Then only the newest `keep` stay; newer ones than this are damaged (see resume) and go.
 * After a failure, a full disk included, all are as they were. */
dar_status dar_checkpoint_save(dar_checkpoint *c, int64_t step, dar_err *e);

/* The directory of a step in the run. */
void dar_checkpoint_path(const dar_checkpoint *c, int64_t step, char path[PATH_MAX]);

#endif
