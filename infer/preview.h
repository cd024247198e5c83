/* preview.h: what becomes of a video, while it is sampled: frames of the tiny decoder (models/taew.h) side by side in
 * one picture, replaced in one moment. */
#ifndef DAR_INFER_PREVIEW_H
#define DAR_INFER_PREVIEW_H

#include <limits.h>

#include "autograd/tape.h"
#include "models/taew.h"

typedef struct dar_preview {
    const dar_taew *v;
    dar_arena kept, step;
    dar_tape tape;
    char path[PATH_MAX];
    size_t steps, columns; /* of the solver; pictures */
    uint8_t *rgb;          /* [H, W, 3] */
    double ready, took;    /* [s] when the last was there, how long it took */
} dar_preview;

/* Memory that it takes for latents of this shape [bytes]: of what is kept, of a piece, of a frame. */
dar_status dar_preview_plan(const dar_taew *v, dar_shape latent, size_t bytes[3], dar_err *e);

/* For latents of this shape [1, C, F, h, w], of which `steps` will come; a picture at `path`.  On failure nothing is
 * owned. */
dar_status dar_preview_init(dar_preview *p, const dar_taew *v, dar_shape latent, size_t steps, const char *path,
                            dar_err *e);
void dar_preview_free(dar_preview *p); /* accepts a zeroed one */

/* Show a latent, as it will be after `done` steps.  Nothing happens while the last picture cost more than a tenth of
 * the time since. */
dar_status dar_preview_show(dar_preview *p, size_t done, const dar_tensor *clean, dar_err *e);

#endif
