/* jpeg.h: JPEG files in memory, through libjpeg-turbo. */
#ifndef DAR_DATA_JPEG_H
#define DAR_DATA_JPEG_H

#include <stdbool.h>

#include "data/image.h"

bool dar_jpeg_is(const void *data, size_t size);

/* As dar_image_probe and dar_image_decode. */
dar_status dar_jpeg_probe(dar_image *im, const char *name, const void *data, size_t size, dar_err *e);
dar_status dar_jpeg_decode(const dar_image *im, const char *name, const void *data, size_t size, dar_err *e);

#endif
