/* png.h: PNG files in memory, through libpng. */
#ifndef DAR_DATA_PNG_H
#define DAR_DATA_PNG_H

#include <stdbool.h>

#include "data/image.h"

bool dar_png_is(const void *data, size_t size);

/* As dar_image_probe and dar_image_decode. */
dar_status dar_png_probe(dar_image *im, const char *name, const void *data, size_t size, dar_err *e);
dar_status dar_png_decode(const dar_image *im, const char *name, const void *data, size_t size, dar_err *e);

#endif
