/* pipeline.h: from a bundle and a picture to the frames of a video.
 *
 *   bundle      -> condition tensor                  once per clip
 *   reference   -> known video (the picture, then grey) -> encoder, a piece at a time
 *   noise       -> sampler -> latent -> decoder, a piece at a time -> frames, as they are made
 *
 * The pipeline knows networks and numbers; files are infer/output.h. */
#ifndef DAR_INFER_PIPELINE_H
#define DAR_INFER_PIPELINE_H

#include "data/bundle.h"
#include "models/model.h"
#include "models/sampler.h"

/* How numbers are kept, by name: the first of dar_dtype, and "int8": bf16, products of the middle blocks of 8 bits. */
#define DAR_PIPELINE_INT8 3
extern const char *const dar_pipeline_precision[DAR_PIPELINE_INT8 + 2]; /* "f64", "f32", "bf16", "int8", NULL */

typedef struct dar_pipeline_options {
    dar_sampler_config sampler;
    dar_noise noise;
    uint64_t seed;
    const char *noise_file;  /* safetensors with one tensor [C, F, h, w], before that any 1s; NULL: drawn */
    int64_t window, overlap; /* latent frames (models/sampler.h); window 0: one, of the whole clip */

    /* Embeddings [n, text width] in safetensors: tensor "text", "negative", or the only one.  NULL: the bundle's
     * text.safetensors if it is there; no token. */
    const char *text, *negative;
} dar_pipeline_options;

typedef struct dar_pipeline {
    const dar_model *m;
    const dar_condition *condition;
    const dar_dit *dit; /* of m; while counting, perhaps another */
    const char *path;
    dar_bundle *b;
    dar_pipeline_options o;
    dar_tensor cond;               /* [1, 24 + N, F, H, W] f32 as the network sees it; data NULL: it sees none */
    int64_t frames, height, width; /* of the latent */

    /* What a video costs, planned before anything runs. */
    size_t bytes;                           /* of memory, beside the weights */
    double prepare, encode, sample, decode; /* [FLOP]: of a clip; of a video */
    double saved[DAR_SKIPS];                /* [FLOP] of one video, each skip by itself; repeat: of the last made */

    /* Of the pipeline itself. */
    dar_arena kept, step;
    dar_tape tape;
    dar_sampler sampler;
    dar_weights *text[2], *noise;
    dar_tensor words[2], given;
} dar_pipeline;

/* Plan, and unless the model only plans, reserve memory, read the condition, prepare the clip.  m, c, b and `path`,
 * which stands for b in messages, must outlive it.  On failure *out is NULL. */
dar_status dar_pipeline_open(dar_pipeline **out, const dar_model *m, const dar_condition *c, const char *path,
                             dar_bundle *b, const dar_pipeline_options *o, dar_err *e);
void dar_pipeline_close(dar_pipeline *p); /* accepts NULL */

typedef enum dar_pipeline_stage { DAR_PIPELINE_ENCODE, DAR_PIPELINE_SAMPLE, DAR_PIPELINE_DECODE } dar_pipeline_stage;

typedef struct dar_pipeline_listener {
    /* rgb [H, W, 3], display values; frames come in order. */
    dar_status (*frame)(void *ctx, size_t index, const uint8_t *rgb, dar_err *e);
    /* After each latent frame, step, latent frame; NULL: nobody asks.  Anything but DAR_OK ends the work. */
    dar_status (*told)(void *ctx, dar_pipeline_stage stage, size_t done, size_t of, dar_err *e);
    /* After each step, before that: the latent as it is, and where the step saw it go (models/sampler.h); NULL: as
     * above.
     */
    dar_status (*step)(void *ctx, size_t done, const dar_tensor *z, const dar_tensor *clean, dar_err *e);
    void *ctx;
} dar_pipeline_listener;

/* Render with a reference rgb [H, W, 3].  May be called again. */
dar_status dar_pipeline_render(dar_pipeline *p, const uint8_t *reference, const dar_pipeline_listener *l, dar_err *e);

#endif
