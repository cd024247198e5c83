/* model.h: the networks of a model with their weights, ready to sample.
 *
 * A model is a JSON file: the keys of models/config.h, and "condition", an object of those of data/condition.h.  It is
 * given as that file, as a directory in which it is called model.json, or as the name of a preset (models/presets).
 * Its weights lie in a directory, or in files given by themselves:
 *
 *   dit    dit.safetensors, or diffusion_pytorch_model.safetensors, or either as shards with an index
 *   vae    vae.safetensors, or Wan2.2_VAE.pth
 *   lora   lora.safetensors, if it is there
 *
 * Channels: those of the model; if it says none, camera where the adapter takes no geometry, else dar. */
#ifndef DAR_INFER_MODEL_H
#define DAR_INFER_MODEL_H

#include <limits.h>

#include "data/condition.h"
#include "lib/weights.h"
#include "models/dit.h"
#include "models/vae.h"

typedef enum dar_model_part { DAR_MODEL_DIT, DAR_MODEL_VAE, DAR_MODEL_LORA, DAR_MODEL_PARTS } dar_model_part;

extern const char *const dar_model_part_name[DAR_MODEL_PARTS + 1]; /* "dit", "vae", "lora", NULL */

typedef struct dar_model_options {
    const char *model;
    const char *weights;               /* directory; NULL: that of the model's file */
    const char *part[DAR_MODEL_PARTS]; /* files; NULL: those found there */
    const char *channels;              /* NULL: the model's */
    dar_dtype storage;                 /* f64, f32 or bf16 */
    double strength;                   /* of the low-rank additions */
    bool apart;                        /* they are not merged into the weights */
    bool plan;                         /* the networks lie on a planning arena; weights need not be there */
} dar_model_options;

typedef struct dar_model {
    dar_config c;
    dar_condition condition;
    dar_dit dit;
    dar_vae vae;
    char file[PATH_MAX];                  /* the JSON */
    char path[DAR_MODEL_PARTS][PATH_MAX]; /* of the weights; "": none */
    size_t bytes;                         /* of the weights in memory, mapped ones included, at most */

    /* Of the model itself. */
    dar_arena weights;
    dar_params params[2]; /* of dit and vae */
    dar_weights *open[DAR_MODEL_PARTS];
} dar_model;

/* On failure *out is NULL. */
dar_status dar_model_open(dar_model **out, const dar_model_options *o, dar_err *e);
void dar_model_close(dar_model *m); /* accepts NULL */

/* Rows and columns of pixels that are one token. */
int64_t dar_model_token(const dar_model *m);

#endif
