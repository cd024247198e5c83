/* dar_eval_film.h: the moving pictures of the report: of a clip one video, truth and methods as tiles of it, so that
 * they play in step, and one of their errors. */
#ifndef DAR_INFER_DAR_EVAL_FILM_H
#define DAR_INFER_DAR_EVAL_FILM_H

#include "infer/dar_eval.h"

typedef struct dar_eval_film dar_eval_film;

/* How tiles are laid out, row by row. */
typedef struct dar_eval_tiles {
    size_t n, columns, rows, width, height; /* width and height of one [px] */
} dar_eval_tiles;

dar_eval_tiles dar_eval_film_tiles(size_t n, const dar_eval_clip *c, size_t width);

/* Tiles of about this width [px].  On failure *out is NULL. */
dar_status dar_eval_film_open(dar_eval_film **out, size_t tiles, const dar_eval_clip *c, size_t width, dar_err *e);
void dar_eval_film_close(dar_eval_film *f); /* accepts NULL */

/* Frame t of a tile: rgb [H, W, 3], map [H, W] of errors from 0 to 1, or NULL. */
void dar_eval_film_add(dar_eval_film *f, size_t tile, size_t t, const uint8_t *rgb, const float *map);

/* clips/NUMBER.mp4 and clips/NUMBER-error.mp4 below `out`, coarse enough for `most` bytes together. */
dar_status dar_eval_film_write(const dar_eval_film *f, const char *out, size_t number, const dar_eval_clip *c,
                               double most, dar_err *e);

/* Error 0 .. 1 as a colour from black over violet and orange to pale yellow, brighter all the way. */
void dar_eval_film_colour(float error, uint8_t rgb[3]);

#endif
