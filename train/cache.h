/* cache.h: what the autoencoder makes of clips, computed once and kept in files named by what it was made of.
 *
 *   DIR/KEY.h5    moments f32 [2 C, F, h, w]   mean, then log-variance, of the clip, not normalised
 *                 known   f32 [C, F, h, w]     mean of its frame 0 followed by grey, not normalised
 *
 * KEY is the sha256 of the bundle's pictures (as its meta.json has it), size and frames, and of the autoencoder:
 * weights of the encoder as they are multiplied, their type, the sizes.  So a bundle or an autoencoder that changes
 * finds no entry, and moving a bundle changes nothing; nothing is ever stale, and a directory may serve many runs at
 * once.
 *
 * An entry appears whole or not at all, and carries the sha256 of its numbers: one that is damaged is made again. */
#ifndef DAR_TRAIN_CACHE_H
#define DAR_TRAIN_CACHE_H

#include "data/bundle.h"
#include "models/vae.h"

typedef struct dar_cache dar_cache;

/* Name the entries of an autoencoder whose parameters p have their values.  v must outlive it.  The directory is made
 * with the first entry.  Of parameters on a planning arena only sizes can be asked.  On failure *out is NULL. */
dar_status dar_cache_open(dar_cache **out, const char *dir, const dar_vae *v, const dar_params *p, dar_err *e);
void dar_cache_close(dar_cache *c); /* accepts NULL */

typedef struct dar_cache_report {
    size_t found, made, damaged; /* damaged: made again */
    uint64_t bytes;              /* of files made */
} dar_cache_report;

/* Make what is missing of n bundles, with a progress line.  told (may be NULL) is called after each; anything but
 * DAR_OK ends the work, which goes on from there when it is called again. */
dar_status dar_cache_fill(dar_cache *c, const char *const *path, size_t n, dar_status (*told)(void *ctx, dar_err *e),
                          void *ctx, dar_cache_report *r, dar_err *e);

/* Shape of a bundle's moments: [2 C, F, h, w]. */
dar_shape dar_cache_shape(const dar_cache *c, const dar_bundle *b);

/* Contiguous f32 tensors; known may be NULL.  May be called by any thread. */
dar_status dar_cache_read(const dar_cache *c, const dar_bundle *b, const dar_tensor *moments, const dar_tensor *known,
                          dar_err *e);

/* (x - mean) / std of the autoencoder, in place: x [C, F, h, w] f32. */
void dar_cache_normalise(const dar_cache *c, const dar_tensor *x);

#endif
