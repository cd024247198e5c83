/* png.h: PNG files through libpng: read from memory, written to a file. */
#ifndef DAR_DATA_PNG_H
#define DAR_DATA_PNG_H

#include <stdbool.h>

#include "data/image.h"

bool dar_png_is(const void *data, size_t size);

/* As dar_image_probe and dar_image_decode. */
dar_status dar_png_probe(dar_image *im, const char *name, const void *data, size_t size, dar_err *e);
dar_status dar_png_decode(const dar_image *im, const char *name, const void *data, size_t size, dar_err *e);

/* Replace the file in one moment: 8 bits, channels 1 (grey), 3 (RGB) or 4 (RGBA), rows without gaps. */
dar_status dar_png_write(const char *path, size_t width, size_t height, int channels, const uint8_t *data, dar_err *e);

/* The same with a text, "Comment": in a tEXt chunk, or where it is not of ASCII alone in an iTXt chunk, as UTF-8. */
typedef struct dar_png {
    size_t width, height;
    int channels;
    const uint8_t *data;
    const char *comment; /* NULL: none */
} dar_png;
dar_status dar_png_save(const char *path, const dar_png *p, dar_err *e);

#endif
