/* output.h: the directory that a rendered video becomes.
 *
 *   sample.json        how it was made: the same input gives the same text, so it also tells whether the work is done
 *   frames/00000.png   every frame
 *   exr/00000.exr      every frame with depth, matte and ids, for compositing (infer/layers.h)
 *   video.mp4          for people
 *   video.mkv          every frame, exact (FFV1)
 *   latent.safetensors what the solver arrived at, z [1, C, F, h, w]
 *   metrics.json       distance of the frames from the bundle's own: means, and frame by frame (data/metric.h)
 *   sheet.png          reference, geometry as the network sees it, result, ground truth and distance from it
 *
 * Pictures, videos and EXR files carry the text of sample.json as their comment.  The directory appears whole or not at
 * all (lib/dir.h). */
#ifndef DAR_INFER_OUTPUT_H
#define DAR_INFER_OUTPUT_H

#include "data/bundle.h"
#include "models/model.h"

typedef struct dar_output_options {
    bool png, exr, mp4, mkv, sheet, eval;
    bool overwrite;
} dar_output_options;

/* What the sheet shows beside the result. */
typedef struct dar_output_shown {
    const dar_condition *condition;
    const dar_tensor *cond;
    const uint8_t *reference;
} dar_output_shown;

typedef struct dar_output dar_output;

/* Begin.  b, which is read for ground truth and layers, and settings must outlive it; reference [H, W, 3]; cond as the
 * pipeline has it, data NULL: none.  On failure *out is NULL. */
dar_status dar_output_create(dar_output **out, const char *path, dar_bundle *b, const dar_output_shown *shown,
                             const char *settings, const dar_output_options *o, dar_err *e);

/* The next frame, rgb [H, W, 3]. */
dar_status dar_output_frame(dar_output *o, size_t index, const uint8_t *rgb, dar_err *e);

/* The latent, once. */
dar_status dar_output_latent(dar_output *o, const dar_tensor *z, dar_err *e);

/* All are there: finish the files, write sample.json, rename. */
dar_status dar_output_commit(dar_output *o, dar_err *e);

/* Accepts NULL.  What was not committed is removed. */
void dar_output_discard(dar_output *o);

typedef enum dar_output_state { DAR_OUTPUT_NONE, DAR_OUTPUT_DONE, DAR_OUTPUT_OTHER } dar_output_state;

/* What is at `path`: nothing, a video of these settings, anything else. */
dar_output_state dar_output_look(const char *path, const char *settings);

#endif
