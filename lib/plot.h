/* plot.h: lines and points as a picture: SVG that needs nothing else.
 *
 *     dar_plot p = { .title = "Loss", .x = { "step" }, .y = { "loss", .log = true }, .series = s, .n = 2 };
 *     DAR_TRY(dar_plot_write(&p, "loss.svg", e));
 *
 * Axes reach from the least to the largest value; ticks are round numbers.  What is not finite, or not positive on a
 * logarithmic axis, is left out, and a line has a gap there.  Same input, same bytes. */
#ifndef DAR_LIB_PLOT_H
#define DAR_LIB_PLOT_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/status.h"

typedef enum dar_plot_mark { DAR_PLOT_LINE, DAR_PLOT_POINTS, DAR_PLOT_BOTH } dar_plot_mark;

typedef struct dar_plot_series {
    const char *label; /* in the legend; NULL: not there */
    dar_plot_mark mark;
    bool faint; /* pale and thin, below the others: what they are the mean of */
    int colour; /* of a palette of eight; more repeat */
    size_t n;
    const double *x, *y;
    const double *lo, *hi;   /* ends of error bars; NULL: none */
    const char *const *tips; /* what is said when a point is pointed at; NULL: its numbers */
} dar_plot_series;

typedef struct dar_plot_axis {
    const char *label;
    bool log;
    double lo, hi; /* equal: from the data */
} dar_plot_axis;

typedef struct dar_plot {
    const char *title; /* NULL: none */
    dar_plot_axis x, y;
    const dar_plot_series *series;
    size_t n;
    int width, height; /* [px]; 0: 720 x 420 */
} dar_plot;

/* The text, to be embedded in a page; the caller frees it.  On failure *svg is NULL. */
dar_status dar_plot_text(const dar_plot *p, char **svg, dar_err *e);

dar_status dar_plot_write(const dar_plot *p, const char *path, dar_err *e);

#endif
