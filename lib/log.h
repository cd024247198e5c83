/* log.h: what a person reads while a program runs: events and a progress line, on standard error.
 *
 * Results go to standard output and are printed by programs, not from here.  Every function may be called by any
 * thread. */
#ifndef DAR_LIB_LOG_H
#define DAR_LIB_LOG_H

#include <stddef.h>

typedef enum dar_log_level { DAR_LOG_ERROR, DAR_LOG_WARNING, DAR_LOG_INFO, DAR_LOG_DEBUG } dar_log_level;

/* Print events up to this level; at first DAR_LOG_INFO.  Below it (--quiet) progress is silent too. */
void dar_log_set(dar_log_level most);

/* One event, one line; errors, warnings and debug say so at its start. */
void dar_log(dar_log_level level, const char *fmt, ...) __attribute__((format(printf, 2, 3)));

/* ---------------------------------------------------------------- progress
 *
 *     dar_progress p = dar_progress_begin("sample", "steps", 50);
 *     for (...) dar_progress_step(&p, i + 1, NULL);
 *     dar_progress_end(&p);
 *
 * On a terminal one line that rewrites itself, ten times a second at most; elsewhere a line every ten seconds.  The end
 * is always told. */
typedef struct dar_progress {
    const char *what, *unit;
    double total, done;
    double from;         /* done before it began; the caller's to set: it counts for the share, not for the speed */
    double begun, shown; /* [s] of a monotonic clock */
    double interval;     /* [s] between two lines */
} dar_progress;

dar_progress dar_progress_begin(const char *what, const char *unit, double total);

/* `done` of total, so far; `note` (may be NULL) is appended: "loss 0.031". */
void dar_progress_step(dar_progress *p, double done, const char *note);
void dar_progress_end(dar_progress *p);

/* "sample: 12/50 steps, 24 %, 1.5 steps/s, 25 s left, NOTE" after so many seconds; returns buf. */
char *dar_progress_text(const dar_progress *p, double seconds, const char *note, char *buf, size_t size);

/* Of a monotonic clock [s]. */
double dar_log_clock(void);

/* "0.5 s", "42 s", "3 min 20 s", "2 h 5 min", "3 d 4 h"; returns buf. */
char *dar_log_duration(double seconds, char *buf, size_t size);

#endif
