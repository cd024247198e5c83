/* image.h: pictures in memory, read from the bytes of a PNG or JPEG file. */
#ifndef DAR_DATA_IMAGE_H
#define DAR_DATA_IMAGE_H

#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"

#define DAR_IMAGE_MAX_SIDE 16384 /* [px] */

typedef struct dar_image {
    size_t width, height; /* [px] */
    uint8_t *rgba;        /* [height, width, 4] as stored (sRGB), top row first, alpha not multiplied in */
} dar_image;

/* Read width and height; rgba stays NULL.  `name` stands for the file in messages.  DAR_ERR_FORMAT: neither PNG nor
 * JPEG, damaged, or larger than DAR_IMAGE_MAX_SIDE. */
dar_status dar_image_probe(dar_image *im, const char *name, const void *data, size_t size, dar_err *e);

/* Decode into im->rgba, memory of the caller for the size that the probe of the same data told.  16-bit samples are cut
 * to 8; grey and palettes become RGBA. */
dar_status dar_image_decode(const dar_image *im, const char *name, const void *data, size_t size, dar_err *e);

#endif
