/* tiles.h: the autoencoder on overlapping tiles of the picture, for less memory.
 *
 * Each tile streams through time by itself (models/vae.h), so memory is that of one piece of one tile, beside the clip
 * in and out.  Where tiles overlap, their results are mixed with weights that fall linearly towards the edge of a tile
 * and sum to one; they do not fall at the edge of the picture.
 *
 * It is not the same function.  At an edge of a tile convolutions see zeros instead of neighbours: an error that fades
 * with the distance from the edge, as 3 x 3 kernels follow each other, and that weights and overlap push down.  The
 * attention in the middle sees its tile alone: that error is everywhere, and does not go away however wide the overlap
 * is.  A single tile gives the values of the whole.
 *
 * Source: of the weights, DiffSynth-Studio's tiled VAE. */
#ifndef DAR_MODELS_TILES_H
#define DAR_MODELS_TILES_H

#include "models/vae.h"

typedef struct dar_tiling {
    int64_t size;    /* rows and columns of a tile, at most [latent pixels] */
    int64_t overlap; /* of neighbours, at least [latent pixels]; below size */
} dar_tiling;

/* Along a side of n latent pixels: how many tiles, the length of each, where tile i starts.  As few as size and overlap
 * allow, all of one length, and no longer than that takes. */
int64_t dar_tiles_count(const dar_tiling *o, int64_t n);
int64_t dar_tiles_length(const dar_tiling *o, int64_t n);
int64_t dar_tiles_start(const dar_tiling *o, int64_t n, int64_t i);

/* Weight of tile i at its place x, where a latent pixel has `scale` places. */
double dar_tiles_weight(const dar_tiling *o, int64_t n, int64_t i, int64_t scale, int64_t x);

/* Of the main type, contiguous, apart from each other:
 *
 *   x         [B, 3, F, H, W]      as dar_vae_encode takes it; decoded: cut to [-1, 1]
 *   moments   [B, 2 C, k, h, w]
 *   z         [B, C, k, h, w]
 *
 * The tape does not record, and is where it was afterwards; so is `kept`, which holds what a stream keeps. */
void dar_tiles_encode(dar_tape *t, const dar_vae *v, const dar_tiling *o, const dar_tensor *x,
                      const dar_tensor *moments, dar_arena *kept);
void dar_tiles_decode(dar_tape *t, const dar_vae *v, const dar_tiling *o, const dar_tensor *z, const dar_tensor *x,
                      dar_arena *kept);

#endif
