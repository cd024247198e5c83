/* journal.h: what a run tells while it trains: a progress line, log.jsonl, loss.csv and pictures.
 *
 *     DAR_TRY(dar_journal_open(&j, &options, resumed, e));
 *     for (...) {
 *         ...
 *         DAR_TRY(dar_journal_step(j, &(dar_journal_entry){ .step = k + 1, .loss = loss, ... }, e));
 *         if (at a checkpoint) DAR_TRY(dar_journal_flush(j, e));             before dar_checkpoint_save
 *     }
 *     dar_journal_close(j);
 *
 * RUN/log.jsonl has one JSON object per line, in the order of steps, each appended by one write: a run that is killed
 * loses at most the line it was writing.
 *
 *   {"kind": "start", "step": 0, "time": "2030-01-31T23:59:59Z", "threads": 2}       whenever the program starts
 *   {"kind": "step", "step": 1, "loss": .., "smoothed": .., "sigma": .., "norm": .., "rate": .., "seconds": ..,
 *    "tokens_per_second": .., "fraction_of_peak": .., "peak_bytes": .., "skipped": NAME}
 *   {"kind": "validate", "step": 1, "psnr": .., ...}                                 train/validate.h
 *   {"kind": "sensitivity", "step": 1, "loss": .., "shuffled": .., ...}
 *
 * "smoothed" is the mean of the finite losses so far, each weighing 0.99 of the next; "skipped" is there if the step
 * was, with the parameter whose gradient is not finite, or null.
 *
 * The rest is made of that file anew: loss.csv, a row per some steps (at most 500 rows) with the mean loss, also by
 * sigma in tenths; loss.svg, the loss over steps, in training and on clips of validation, with their own condition and
 * with another's; loss_sigma.svg, the loss by sigma in the quarters of the run; psnr.svg, of samples, if there are. */
#ifndef DAR_TRAIN_JOURNAL_H
#define DAR_TRAIN_JOURNAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/json_write.h"
#include "lib/status.h"

typedef struct dar_journal dar_journal;

typedef struct dar_journal_options {
    const char *run; /* directory, which exists; must outlive the journal */
    int64_t steps;   /* of the whole run */
    double tokens;   /* per step; 0: not told */
    double flops;    /* per step; 0: not told */
    double peak;     /* of the machine [flops/s]; 0: not told */
} dar_journal_options;

/* Lines after step `resumed` (0: all of them), and what a kill left of a line, are cut off.  On failure *out is NULL.
 */
dar_status dar_journal_open(dar_journal **out, const dar_journal_options *o, int64_t resumed, dar_err *e);

/* Ends the progress line; makes tables and pictures anew, if lines came after the last ones.  Accepts NULL. */
void dar_journal_close(dar_journal *j);

typedef struct dar_journal_entry {
    int64_t step; /* done, this one included */
    double loss;  /* mean over the batch */
    double sigma; /* of the noise, mean over the batch */
    double norm, rate;
    double seconds;        /* this step took */
    bool skipped;          /* the gradient was not finite */
    const char *nonfinite; /* where; may be NULL */
} dar_journal_entry;

/* A line, and the progress line.  A full disk is a failure, and leaves no half line. */
dar_status dar_journal_step(dar_journal *j, const dar_journal_entry *x, dar_err *e);

/* A line of another kind: {"kind": KIND, "step": STEP, and what is written to it until the end.  Lines of a step come
 * before its checkpoint, or a run resumed there would not have them. */
dar_json_writer *dar_journal_line(dar_journal *j, const char *kind, int64_t step);
dar_status dar_journal_end(dar_journal *j, dar_err *e);

/* The log on the disk; tables and pictures made anew, unless that was done so short a time ago that it would take a
 * twentieth of the time.  That those cannot be written is a warning. */
dar_status dar_journal_flush(dar_journal *j, dar_err *e);

/* As in the last line; NAN before the first. */
double dar_journal_smoothed(const dar_journal *j);

#endif
