/* pictures.h: the frames of a clip as pictures that a person has: a directory of PNG and JPEG files, or a video.
 *
 * Display values, RGB, 8 bits, [height, width, 3]; what is transparent in a file lies over black.  Files of a directory
 * are in the order in which people count: 9 before 10. */
#ifndef DAR_DATA_PICTURES_H
#define DAR_DATA_PICTURES_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"

typedef struct dar_pictures dar_pictures;

/* Fails unless there are `frames` pictures of width x height; the size of a file in a directory is looked at when it
 * is read.  `path` must outlive the object.  On failure *out is NULL. */
dar_status dar_pictures_open(dar_pictures **out, const char *path, size_t width, size_t height, size_t frames,
                             dar_err *e);
void dar_pictures_close(dar_pictures *p); /* accepts NULL */

/* The same with as many as there are, which *frames tells, of any size: brought to this one (data/resize.h). */
dar_status dar_pictures_open_any(dar_pictures **out, const char *path, size_t width, size_t height, size_t *frames,
                                 dar_err *e);

/* Whether some picture was brought to another size so far. */
bool dar_pictures_resized(const dar_pictures *p);

/* The next one.  At most as many as there are. */
dar_status dar_pictures_read(dar_pictures *p, uint8_t *rgb, dar_err *e);

/* A single file, which must be of this size. */
dar_status dar_pictures_load(const char *path, size_t width, size_t height, uint8_t *rgb, dar_err *e);

/* A single file of any size, brought to this one (data/resize.h). */
dar_status dar_pictures_fit(const char *path, size_t width, size_t height, uint8_t *rgb, dar_err *e);

#endif
