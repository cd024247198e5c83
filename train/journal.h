/* journal.h: what a run tells while it trains: a progress line, log.jsonl, loss.csv and pictures of both.
 *
 *     DAR_TRY(dar_journal_open(&j, &options, resumed, e));
 *     for (...) {
 *         ...
 *         DAR_TRY(dar_journal_step(j, &(dar_journal_entry){ .step = k + 1, .loss = loss, ... }, e));
 *         if (at a checkpoint) DAR_TRY(dar_journal_flush(j, e));             before dar_checkpoint_save
 *     }
 *     dar_journal_close(j);
 *
 * RUN/log.jsonl has one JSON object per line, in the order of steps, each appended by one write, so a run that is
 * killed loses at most the line it was writing:
 *
 *   {"kind": "start", "step": 0, ...}                    once per start of the program
 *   {"kind": "step", "step": 1, "loss": .., "smoothed": .., "sigma": .., "norm": .., "rate": .., "seconds": ..,
 *    "tokens_per_second": .., "fraction_of_peak": .., "peak_bytes": .., "skipped": NAME}
 *   {"kind": "validate", ...}, {"kind": "sensitivity", ...}             or any other name: dar_journal_line
 *
 * "smoothed" is the mean of the losses so far, each counting 0.99 of the next one; "skipped" is there if the step was,
 * with the parameter whose gradient was not finite.
 *
 * The rest is made of it anew each time it is flushed: loss.csv, a row per interval of steps with the mean loss by
 * sigma; loss.svg, the loss over steps; loss_sigma.svg, the loss over sigma in quarters of the run. */
#ifndef DAR_TRAIN_JOURNAL_H
#define DAR_TRAIN_JOURNAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/json_write.h"
#include "lib/status.h"

typedef struct dar_journal dar_journal;

typedef struct dar_journal_options {
    const char *run; /* directory, which exists */
    int64_t steps;   /* of the whole run */
    double tokens;   /* per step; 0: not told */
    double flops;    /* per step; 0: not told */
    double peak;     /* of the machine [flops/s]; 0: not told */
} dar_journal_options;

/* Lines after step `resumed` (0: all of them), and what a kill left of a line, are cut off.  On failure *out is NULL.
 */
dar_status dar_journal_open(dar_journal **out, const dar_journal_options *o, int64_t resumed, dar_err *e);
void dar_journal_close(dar_journal *j); /* accepts NULL */

typedef struct dar_journal_entry {
    int64_t step; /* done, this one included */
    double loss;  /* mean over the batch */
    double sigma; /* of the noise, mean over the batch */
    double norm, rate;
    double seconds;        /* this step took */
    bool skipped;          /* the gradient was not finite */
    const char *nonfinite; /* where; may be NULL */
} dar_journal_entry;

/* One line, and the progress line.  A full disk is a failure, and leaves no half line. */
dar_status dar_journal_step(dar_journal *j, const dar_journal_entry *x, dar_err *e);

/* A line of another kind: {"kind": KIND, "step": STEP, and what is written until the end. */
dar_json_writer *dar_journal_line(dar_journal *j, const char *kind, int64_t step);
dar_status dar_journal_end(dar_journal *j, dar_err *e);

/* Log on the disk; tables and pictures made anew. */
dar_status dar_journal_flush(dar_journal *j, dar_err *e);

/* Mean of the losses so far as in the last line; NAN before the first. */
double dar_journal_smoothed(const dar_journal *j);

#endif
