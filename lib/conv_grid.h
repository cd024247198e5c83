/* conv_grid.h: frames as lines of pixels with the zeros between them that a convolution reads.
 *
 * An output pixel (h, w) is place h pitch + w of a frame.  On such a line a tap of the kernel is the same pixels from
 * another place on.  With a stride S in space a frame is S x S pictures, its phases: tap (i, j) is at (i / S, j / S) of
 * phase (i mod S, j mod S), and each of those is a line of its own. */
#ifndef DAR_LIB_CONV_GRID_H
#define DAR_LIB_CONV_GRID_H

#include "lib/conv.h"

typedef struct dar_conv_grid {
    size_t stride, H, W, Ho, Wo;
    int64_t top, left;
    size_t tall, wide, phases; /* phases that the kernel reads, along rows and along columns, and in all */
    size_t kh, kw;             /* of the kernel in one phase */
    size_t pitch, plane;       /* places from row to row; from the first output pixel to the last */
    size_t frame;              /* places from frame to frame where frames follow each other on one line */
    size_t around;             /* places that a pixel's last tap is behind its first */
} dar_conv_grid;

dar_conv_grid dar_conv_grid_of(const dar_conv *c);

/* Where tap (y, x) of the kernel reads, from its phase's line. */
size_t dar_conv_grid_phase(const dar_conv_grid *g, size_t y, size_t x);
size_t dar_conv_grid_place(const dar_conv_grid *g, size_t y, size_t x);

/* n elements of a frame that is read, from what the first tap of output place q reads on: frame [H, W] of that type. */
void dar_conv_grid_read(const dar_conv_grid *g, size_t phase, dar_dtype type, char *dst, const char *frame, size_t q,
                        size_t n);

/* n elements of an output frame [Ho, Wo] from place q on: zero between and behind the rows. */
void dar_conv_grid_spread(const dar_conv_grid *g, dar_dtype type, char *dst, const char *frame, size_t q, size_t n);

#endif
