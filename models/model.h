/* model.h: the networks of a model with their weights, ready to sample or to train.
 *
 *     DAR_TRY(dar_model_file_open(&f, "wan22-fun-5b", e));
 *     ... read dar_json_object(dar_json_root(f.doc), "condition"): data/condition.h ...
 *     s = dar_model_file_check(&f, &feed, e);
 *     if (s == DAR_OK) s = dar_model_open(&m, &f, &options, e);
 *     dar_model_file_close(&f);
 *
 * A model is a JSON file: the keys of models/config.h; "condition", an object of those of data/condition.h; "weights",
 * an object of paths of the parts below, relative to the file.  It is given as that file, as a directory in which it is
 * called model.json, or as the name of a preset (models/presets).  Weights are, in this order: files given by
 * themselves; those that the file names; those found in a directory:
 *
 *   dit      dit.safetensors, or diffusion_pytorch_model.safetensors, or either as shards with an index
 *   vae      vae.safetensors, or Wan2.2_VAE.pth
 *   adapter  adapter.safetensors, if it is there: used instead of the one that dit holds
 *   lora     lora.safetensors, if it is there
 *   taew     taew.safetensors, taew2_2.safetensors or taew2_2.pth, where previews are asked for */
#ifndef DAR_MODELS_MODEL_H
#define DAR_MODELS_MODEL_H

#include <limits.h>

#include "lib/json.h"
#include "lib/weights.h"
#include "models/dit.h"
#include "models/taew.h"
#include "models/vae.h"

typedef enum dar_model_part {
    DAR_MODEL_DIT,
    DAR_MODEL_VAE,
    DAR_MODEL_ADAPTER,
    DAR_MODEL_LORA,
    DAR_MODEL_TAEW,
    DAR_MODEL_PARTS
} dar_model_part;

extern const char *const dar_model_part_name[DAR_MODEL_PARTS + 1]; /* "dit", ..., NULL */

/* ---------------------------------------------------------------- the file */

typedef struct dar_model_file {
    char path[PATH_MAX];
    dar_json_doc *doc;
    dar_config c;
    const char *part[DAR_MODEL_PARTS]; /* "weights"; NULL: not named */
} dar_model_file;

/* Find and parse.  On failure *f is closed. */
dar_status dar_model_file_open(dar_model_file *f, const char *model, dar_err *e);
void dar_model_file_close(dar_model_file *f); /* accepts a zeroed one */

/* Read the networks and the paths again, after keys of f->doc were set. */
void dar_model_file_read(dar_model_file *f);

/* What the networks are given: by data/rays.h and data/condition.h. */
typedef struct dar_model_feed {
    int64_t frames;         /* of a latent frame after the first */
    int64_t rays, geometry; /* channels of the condition */
} dar_model_feed;

/* Whether all keys are known and right, and these networks can be put one behind the other and take that. */
dar_status dar_model_file_check(const dar_model_file *f, const dar_model_feed *feed, dar_err *e);

/* Rows and columns of pixels that are one token. */
int64_t dar_model_token(const dar_config *c);

/* ---------------------------------------------------------------- the networks */

typedef struct dar_model_options {
    const char *weights;               /* directory; NULL: that of the model's file */
    const char *part[DAR_MODEL_PARTS]; /* files; NULL: those named or found */
    dar_dtype storage;                 /* f64, f32 or bf16 */
    double strength;                   /* of the low-rank additions */
    bool apart;                        /* they are not merged into the weights */
    bool plan;                         /* the networks lie on a planning arena; weights need not be there */
    bool random;                       /* weights that have no file are drawn from `seed`: to try speed and memory */
    bool eight;   /* products of the middle blocks are of 8 bits by 8 bits; additions are merged first */
    bool preview; /* the tiny decoder is wanted */
    bool codec;   /* the autoencoder is all that is wanted */

    /* Training: roles that get gradients; additions of config.lora are made if they are among them.  `fresh`: the
     * transformer's values are drawn from `seed`, not read, as are those of new additions always. */
    unsigned train;
    bool fresh;
    uint64_t seed;
} dar_model_options;

typedef struct dar_model {
    dar_config c;
    dar_dit dit;
    dar_vae vae;
    dar_taew taew;                        /* if it was wanted */
    char file[PATH_MAX];                  /* the JSON */
    char path[DAR_MODEL_PARTS][PATH_MAX]; /* of the weights; "": none */
    size_t bytes;                         /* of the weights in memory, mapped ones included, at most */

    /* Of the model itself. */
    dar_arena weights;
    dar_params params[3]; /* of dit, vae and taew */
    dar_weights *open[DAR_MODEL_PARTS];
} dar_model;

/* f is not needed afterwards.  On failure *out is NULL. */
dar_status dar_model_open(dar_model **out, const dar_model_file *f, const dar_model_options *o, dar_err *e);
void dar_model_close(dar_model *m); /* accepts NULL */

#endif
