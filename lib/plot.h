/* plot.h: lines and points as a picture: SVG that needs nothing else.
 *
 *     dar_plot_series s = { .label = "mean of 100", .n = n, .x = step, .y = loss };
 *     dar_plot p = { .title = "Loss", .x.label = "step", .y.log = true, .series = &s, .n = 1 };
 *     DAR_TRY(dar_plot_write(&p, "loss.svg", e));
 *
 * Axes hold all that is drawn, with round numbers at their ticks.  What is not finite, or not positive on a logarithmic
 * axis, is left out, and a line has a gap there.  Lines and clouds of many points are thinned to what can be seen.
 * Same input, same bytes. */
#ifndef DAR_LIB_PLOT_H
#define DAR_LIB_PLOT_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/status.h"

typedef enum dar_plot_mark { DAR_PLOT_LINE, DAR_PLOT_POINTS, DAR_PLOT_BOTH } dar_plot_mark;

typedef struct dar_plot_series {
    const char *label; /* in the legend; NULL: not there */
    dar_plot_mark mark;
    int colour; /* 0, 1, ... of a palette of eight; the next eight are the same with dashed lines, and so on */
    bool faint; /* pale and thin: what others are the mean of; list it before them */
    size_t n;
    const double *x, *y;
    const double *lo, *hi;    /* ends of error bars, of a band for DAR_PLOT_LINE; NULL: none */
    const char *const *names; /* written beside the points; NULL: none */
    const char *const *tips;  /* told where a point is pointed at; NULL: its name, if any, and its numbers */
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
