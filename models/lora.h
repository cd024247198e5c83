/* lora.h: low-rank additions to the products of the transformer's blocks: y = x W^T + b + scale (x A^T) U^T.
 *
 * scale = strength alpha / r.  A fresh A is uniform in +- 1 / sqrt(in), a fresh U is 0: nothing changes at first, not a
 * bit.  Parameters are named as in the files that are written.  One set at a time.
 *
 * Files (lib/weights.h) have one of three forms, told apart by their keys:
 *
 *   lora_unet__blocks_0_self_attn_q.lora_down.weight, .lora_up.weight, .alpha       kohya, VideoX-Fun; written
 *   blocks.0.self_attn.q.lora_A.weight, .lora_B.weight                              PEFT
 *   blocks.0.self_attn.q.lora_A.default.weight, .lora_B.default.weight              DiffSynth
 *
 * with diffusion_model., pipe.dit., transformer. or base_model.model. before them, and the products named as in the
 * public checkpoint or as in diffusers (attn1.to_q).  PEFT files do not say alpha: whoever trained with alpha other
 * than r must say so when reading, or the strength is wrong by that ratio.
 *
 * Source: Hu et al. 2021, eq. 3; forms as in the public tools. */
#ifndef DAR_MODELS_LORA_H
#define DAR_MODELS_LORA_H

#include "lib/weights.h"
#include "models/dit.h"

/* Declare a set of one rank on c->targets of every block; nothing if the rank is 0. */
void dar_lora_init(dar_dit *m, dar_params *p, const dar_lora_config *c);

typedef struct dar_lora_read_options {
    double alpha;    /* where the file does not say; 0: the rank */
    double strength; /* 1: as trained */
} dar_lora_read_options;

/* Read all weights of a file.  Products that have no addition get one of the file's rank, which may differ from product
 * to product; one that is declared must have the file's rank.  Fails on the first key that is none of this model's, a
 * missing half, a wrong shape; the model is then not to be used. */
dar_status dar_lora_read(dar_dit *m, dar_params *p, dar_weights *f, const dar_lora_read_options *o, dar_err *e);

/* Write all additions with their alpha, in the types they are stored in. */
dar_status dar_lora_write(const dar_dit *m, const char *path, dar_err *e);

/* W becomes W + scale U A, formed in f32 (f64 where W is) and rounded once; the network then runs as without addition.
 * unmerge gives W back: the same bits where W was mapped (merging then takes memory for a copy from p's arena), else
 * within one rounding of W's type for each way.  Scratch is given back. */
void dar_lora_merge(dar_dit *m, dar_params *p, dar_arena *scratch);
void dar_lora_unmerge(dar_dit *m, dar_arena *scratch);

/* Store the products of blocks [from, to) in 8 bits, a scale per row, for good; additions that are not trained are
 * merged on the way, in f32.  Weights that were mapped are not needed any more.  m->quantise then says whether their
 * operands are rounded to 8 bits too. */
void dar_lora_quantise(dar_dit *m, dar_params *p, int64_t from, int64_t to, dar_arena *scratch);

/* Declare the addition of one product; its scale is the caller's to set. */
void dar_lora_declare(dar_dit *m, dar_params *p, int64_t block, dar_projection which, int64_t rank);

/* "lora_unet__blocks_0_self_attn_q" */
void dar_lora_module(char *name, size_t size, int64_t block, dar_projection which);

/* Which part of which product a key of a file means. */
typedef enum dar_lora_part { DAR_LORA_DOWN, DAR_LORA_UP, DAR_LORA_ALPHA } dar_lora_part;
typedef struct dar_lora_key {
    int64_t block;
    dar_projection projection;
    dar_lora_part part;
} dar_lora_key;
bool dar_lora_parse(dar_lora_key *k, const char *name, int64_t layers);

#endif
