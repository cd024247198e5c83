/* resize.h: a picture at another size.
 *
 * The largest part of it that has the new one's aspect, taken from its middle, through Lanczos' kernel of three lobes,
 * which is widened where the picture shrinks, so that nothing finer than the new pixels is left to alias.  Beyond an
 * edge there is nothing: weights are of sum 1 over what is there.  Display values, as pictures are resized by the tools
 * that the public networks are fed with; a picture of the same size keeps its bits.
 *
 * Source: Turkowski 1990, "Filters for common resampling tasks"; covering and cropping as in Wan2.2, textimage2video.
 */
#ifndef DAR_DATA_RESIZE_H
#define DAR_DATA_RESIZE_H

#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"

typedef struct dar_resize_part {
    double left, top, width, height; /* [px] of the picture */
} dar_resize_part;

/* What of a picture of w x h is seen in one of width x height. */
dar_resize_part dar_resize_cover(size_t w, size_t h, size_t width, size_t height);

/* x [h, w, 3] to y [height, width, 3].  `name` stands for the picture in messages. */
dar_status dar_resize(const char *name, const uint8_t *x, size_t w, size_t h, uint8_t *y, size_t width, size_t height,
                      dar_err *e);

#endif
