/* journal_inside.h: reading a log back, for journal.c. */
#ifndef DAR_TRAIN_JOURNAL_INSIDE_H
#define DAR_TRAIN_JOURNAL_INSIDE_H

#include "lib/json.h"
#include "train/journal.h"

#define DAR_JOURNAL_LOG   "log.jsonl"
#define DAR_JOURNAL_DECAY 0.99

/* A line; numbers are NAN where it has none.  Texts live until the next line. */
typedef struct dar_journal_past {
    const char *kind;
    int64_t step;
    double loss, smoothed, sigma, norm, rate, seconds, peak_bytes; /* of steps */
    double shuffled, psnr;                                         /* of validation */
    bool skipped;
    size_t end; /* offset behind it [bytes] */
} dar_journal_past;

/* Called for each whole line in order; false: no more. */
typedef bool dar_journal_fn(void *ctx, const dar_journal_past *line);

/* Read a log as far as it is whole.  One that is not there is empty. */
dar_status dar_journal_scan(const char *path, dar_journal_fn *fn, void *ctx, dar_err *e);

/* Make loss.csv, loss.svg, loss_sigma.svg and psnr.svg of the log of a run. */
dar_status dar_journal_draw(const char *run, dar_err *e);

#endif
