/* conv_slide.h: convolution without col, and without a stride in time.  Part of lib/conv.h.
 *
 * Rows of pixels are packed once, with zeros between them for the borders.  Then a tap of the kernel is the same pixels
 * read from another place: the tile slides over them (dar_tile.mm_taps). */
#ifndef DAR_LIB_CONV_SLIDE_H
#define DAR_LIB_CONV_SLIDE_H

#include "lib/conv.h"
#include "lib/conv_clip.h"

typedef struct dar_conv_slide {
    dar_conv c;               /* from `in` to `out` */
    bool turned;              /* the kernel is w [Cin, Cout, kt, kh, kw] read from its other end: that of a gradient */
    dar_dtype x_type, w_type; /* what the products depend on */
    dar_clip in, out;
    bool add, add_past;      /* to out.x, to out.past */
    const dar_tensor *w, *b; /* b NULL or without data: none */
} dar_conv_slide;

/* Only c, turned, x_type and w_type are read. */
size_t dar_conv_slide_scratch(const dar_conv_slide *s, int threads);
void dar_conv_slide_run(const dar_conv_slide *s, void *scratch);

#endif
