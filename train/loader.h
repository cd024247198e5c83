/* loader.h: batches of clips in an order that is a pure function of seed and step, read ahead by a thread beside.
 *
 *     dar_loader_open(&l, &config, e);
 *     for (step = first; step < last; step++) {
 *         DAR_TRY(dar_loader_get(l, step, &batch, e));
 *         ...
 *     }
 *     dar_loader_close(l);
 *
 * Place p = batch step + b of the endless sequence of clips is number p mod n of epoch p / n, which is a permutation
 * drawn from (seed, epoch).  So a step's number is all that a run needs to resume, whatever was read before; what is
 * read has the same bits for any number of threads and of batches ahead.
 *
 * Latents come from a cache (train/cache.h), conditions are made from the bundles: rays are quicker to compute than to
 * read, and of the geometry only the families of the channel set are read. */
#ifndef DAR_TRAIN_LOADER_H
#define DAR_TRAIN_LOADER_H

#include "data/condition.h"
#include "models/config.h"
#include "train/cache.h"

typedef struct dar_loader_config {
    const char *const *path; /* [clips] of bundles, all of one size; texts must outlive the loader */
    size_t clips;
    int64_t batch; /* B */
    size_t ahead;  /* batches read before they are asked for; 0: none, and no thread */
    bool shuffle;  /* else every epoch is in the order of `path` */
    uint64_t seed;
    bool plan; /* look at the bundles and count bytes; no batch can be got */

    /* For the transformer; must outlive the loader. */
    const dar_cache *cache;         /* NULL: no latents */
    const dar_dit_config *dit;      /* with cache */
    const dar_condition *condition; /* NULL: none */
    bool posterior;                 /* z0 is drawn from the posterior, by (seed, place); else its mean */

    /* For the autoencoder: pixels, cut out at a place drawn by (seed, place). */
    int64_t frames, height, width; /* 0: all; frames 1 + 4 k */
    bool pixels;
} dar_loader_config;

/* Tensors are contiguous f32; data NULL: not asked for. */
typedef struct dar_batch {
    dar_tensor z0;           /* [B, C, F, h, w] clean latents, normalised */
    dar_tensor known;        /* [B, mask + C, F, h, w] as of dar_dit_known: frame 0, then grey; absent if mask = 0 */
    dar_tensor cond;         /* [B, 24 + N, F, H, W] */
    dar_tensor text;         /* [B, n, text width], rows beyond a clip's count 0; n = 0: no clip has a token */
    const int64_t *count;    /* [B] tokens of each clip */
    dar_tensor pixels;       /* [B, 3, frames, height, width] in [-1, 1] */
    const char *const *path; /* [B] of the bundles */
    const size_t *clip;      /* [B] their numbers in the configuration */
} dar_batch;

typedef struct dar_loader dar_loader;

/* Opens every bundle once: a clip that lacks a family, is of another size or has no rgb is refused by name.  On failure
 * *out is NULL. */
dar_status dar_loader_open(dar_loader **out, const dar_loader_config *c, dar_err *e);
void dar_loader_close(dar_loader *l); /* accepts NULL */

/* The batch of a step, valid until the next call.  Steps in order are read ahead; any other may be asked for. */
dar_status dar_loader_get(dar_loader *l, int64_t step, const dar_batch **b, dar_err *e);

dar_shape dar_loader_pixels(
    const dar_loader *l);                      /* [B, 3, frames, height, width]; of the whole clip if not asked for */
int64_t dar_loader_words(const dar_loader *l); /* most tokens of a text: size of batches' texts at most */
size_t dar_loader_bytes(const dar_loader *l);  /* of memory, all batches together */
double dar_loader_waited(const dar_loader *l); /* [s] in dar_loader_get, so far */
dar_shape dar_loader_latent(const dar_loader *l); /* [B, C, F, h, w]; n = 0 without cache */

/* Numbers of the clips of an epoch, in order. */
void dar_loader_order(uint64_t seed, uint64_t epoch, size_t clips, size_t *order);

#endif
