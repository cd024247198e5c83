/* config.h: what a training run is, read from JSON: train/configs and --set key=value.
 *
 * A file may name another as its "base", relative to itself: keys it does not give are those of the base.  Every key
 * is a line of the table in config.c; their names are those that users of other trainers know.
 *
 *   key                          values           default  what
 *   model                        text             needed   preset, .json or directory (models/model.h)
 *   weights                      text             null     directory of its weights; null: that of the model's file
 *   parts.dit .vae .adapter .lora  text           null     files of them instead
 *   train                        lora | full | vae  lora   low-rank additions and adapter; transformer and adapter; the
 *                                                          autoencoder
 *   from_scratch                 bool             false    the transformer is drawn by the seed, not read
 *   data                         list of texts    needed   bundles, or directories of them
 *   condition                    object           {}       keys of data/condition.h, over those of the model
 *   adapter                      object           {}       keys of models/config.h, likewise: blocks, widen
 *   output_dir                   text             needed   the run's directory
 *   cache_dir                    text             null     of latents; null: cache in the directory above the run's
 *   seed                         0 ..             0
 *
 *   rank                         1 ..             256      of low-rank additions
 *   network_alpha                >= 0             0        they count alpha / rank times; 0: rank
 *   target_modules               list of names    all ten  of models/config.h, lora.targets
 *   mixed_precision              f64 | f32 | bf16  bf16    of products' operands and frozen weights; sums, trained
 *                                                          weights and what is listed in models/dit.h are f32 or wider
 *   gradient_checkpointing       auto | none | cheap | wide | selective | full   auto   keep everything; in backward
 *                                                          compute again what costs little; that and the widest
 *                                                          product; blocks but their attention; blocks
 *   memory_budget                >= 0 [GB]        0        of which auto takes the fastest that fits; 0: the machine's
 *
 *   learning_rate                >= 0             1e-4
 *   learning_rates               object           {}       other rates of trained tensors, by shell patterns of their
 *                                                          names: {"linear.*": 3e-5}; of several, the last that matches
 *   lr_scheduler                 constant_with_warmup | constant | linear | cosine   constant_with_warmup   all rates:
 *                                                          constant: also without warm-up; the others: down to 0 at the
 *                                                          end, after the warm-up
 *   lr_warmup_steps              0 ..             200
 *   lr_decay_share               0 .. 1           0        they go down over the last share of all steps; 0: over all
 *                                                          after the warm-up
 *   lr_decay_steps               0 ..             0        the same as a number of steps, which counts if it is not 0
 *   adam_beta1, adam_beta2       0 .. 1           0.9, 0.999
 *   adam_epsilon                 > 0              1e-10
 *   adam_weight_decay            >= 0             0.03
 *   adam_moments                 f32 | bf16       f32      bf16: half the memory, rounded at random
 *   ema_decay                    0 .. 1           0        of the running average of trained weights (train/optim.h);
 *                                                          if not 0, that is what is validated, and what checkpoints
 *                                                          hold as weights, beside the weights that training goes on
 *                                                          from
 *   max_grad_norm                >= 0             0.05     0: no clipping
 *   max_bad_steps                1 ..             20       in a row, whose gradients are not finite
 *   max_train_steps              1 ..             10000
 *   train_batch_size             1 ..             1
 *   gradient_accumulation_steps  1 ..             1        batches to a step
 *   prefetch                     0 ..             2        batches read ahead
 *   checkpointing_steps          0 ..             2000     0: only at the end
 *   checkpoints_total_limit      1 ..             5
 *   save_merged                  bool             false    RUN/merged: additions and adapter put into the weights
 *
 *   loss.shift                   > 0              5        of the table of sigmas
 *   loss.density                 uniform | logit_normal | mode | cosmap   uniform   how they are drawn
 *   loss.stratified              bool             false    those of a batch from equal parts of that
 *   loss.weighting               flat | bell      flat     how they count
 *   loss.first_frame             exclude | include | noisy   exclude   the first latent frame: clean, at time 0, and
 *                                                          not counted; counted, as in VideoX-Fun; noisy, all alike
 *
 *   text.dropout                 0 .. 1           0.1      clips whose text is left out
 *   text.empty                   text             null     file with the embedding of the empty prompt, which stands
 *                                                          for a text left out, or none; null: no token
 *   posterior                    mean | sample    mean     of the autoencoder, for clean latents
 *
 *   vae.frames, .height, .width  0 ..         9, 64, 64  what is cut out of clips to train the autoencoder; 0: all
 *   vae.round                    >= 0             0.02     of its distance's corner; 0: squares (train/vae_step.h)
 *   vae.edge                     >= 0             0        weight of the distance of slopes
 *   vae.kl                       >= 0             1e-5     weight of the divergence
 *   vae.noise                    >= 0             0        added to latents before they are decoded
 *   vae.spread                   0 to 1           0        of latents, from nothing (models/vae_start.h)
 *
 *   validation.data              list of texts    []       bundles to look at while training
 *   validation.steps             0 ..             1000     every so many steps; 0: never
 *   validation.clips             1 ..             4        at most so many of them are sampled
 *   validation.sampler_steps     1 ..             20
 *   validation.sensitivity       0 ..             8        clips whose loss is also taken with another's condition
 */
#ifndef DAR_TRAIN_CONFIG_H
#define DAR_TRAIN_CONFIG_H

#include <stdbool.h>
#include <stdint.h>

#include "data/condition.h"
#include "lib/json.h"
#include "models/flow.h"
#include "models/model.h"

typedef enum dar_train_what { DAR_TRAIN_LORA, DAR_TRAIN_FULL, DAR_TRAIN_VAE } dar_train_what;
typedef enum dar_recompute {
    DAR_RECOMPUTE_AUTO,
    DAR_RECOMPUTE_NONE,
    DAR_RECOMPUTE_CHEAP,
    DAR_RECOMPUTE_WIDE,
    DAR_RECOMPUTE_MOST,
    DAR_RECOMPUTE_ALL
} dar_recompute;
typedef enum dar_lr_scheduler { DAR_LR_WARMUP, DAR_LR_CONSTANT, DAR_LR_LINEAR, DAR_LR_COSINE } dar_lr_scheduler;
typedef enum dar_first_frame { DAR_FIRST_EXCLUDE, DAR_FIRST_INCLUDE, DAR_FIRST_NOISY } dar_first_frame;

extern const char *const dar_recompute_name[]; /* "auto", ..., NULL */

#define DAR_TRAIN_RATES 32 /* patterns with a rate of their own, at most */

/* Texts live as long as the configuration.  Choices are int: rows of one table read them. */
typedef struct dar_train_config {
    const char *model, *weights, *part[DAR_MODEL_PARTS];
    int what; /* dar_train_what */
    bool from_scratch;
    const char *output, *cache;
    int64_t seed;

    int64_t rank;
    double alpha;
    int storage;   /* dar_dtype */
    int recompute; /* dar_recompute */
    double budget; /* [GB] */

    double rate;
    struct {
        const char *pattern;
        double rate;
    } rates[DAR_TRAIN_RATES];
    size_t n_rates;
    int scheduler; /* dar_lr_scheduler */
    int64_t warmup, decay_steps;
    double decay_share;
    double beta1, beta2, eps, decay, average, max_norm;
    int moments; /* 0: f32, 1: bf16 */
    int64_t patience, steps, batch, accumulate, ahead;
    int64_t save_every, keep;
    bool save_merged;

    double shift;
    int density, weighting; /* dar_flow_density, dar_flow_weighting */
    bool stratified;
    int first; /* dar_first_frame */
    double text_dropout;
    const char *text_empty;
    int posterior; /* 0: mean, 1: sample */

    int64_t vae_frames, vae_height, vae_width;
    double vae_round, vae_edge, vae_kl, vae_noise, vae_spread;

    int64_t validate_every, validate_clips, validate_steps, sensitivity;

    /* Of the model, with what the keys above say of it. */
    dar_model_file file;
    dar_condition condition;

    dar_json_doc *doc; /* resolved */
} dar_train_config;

/* Read a file, then `n` assignments "key=value"; then the model that it names.  On failure *c is closed. */
dar_status dar_train_config_open(dar_train_config *c, const char *path, const char *const *set, size_t n, dar_err *e);
void dar_train_config_close(dar_train_config *c); /* accepts a zeroed one */

/* The texts of a list: "data", or "validation.data". */
dar_json dar_train_config_list(const dar_train_config *c, const char *group, const char *key);

/* What rates are multiplied with in step k = 0, 1, ...; the warm-up, which comes on top, is the optimiser's. */
double dar_train_schedule(const dar_train_config *c, int64_t k);

/* The resolved configuration as JSON text. */
void dar_train_config_print(const dar_train_config *c, dar_json_writer *w);

#endif
