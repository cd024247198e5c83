/* kern_tiles.h: the sets of tiles that fill the table of lib/tile.c; included by the files that define or choose them.
 *
 * Each set is one or more shapes, the widest first. */
#ifndef DAR_LIB_KERN_TILES_H
#define DAR_LIB_KERN_TILES_H

#include "lib/tile.h"

typedef struct dar_tile_set {
    const dar_tile *of;
    int n;
} dar_tile_set;

extern const dar_tile_set dar_tiles_f32_avx2, dar_tiles_i8_avx2;
extern const dar_tile_set dar_tiles_f32_avx512, dar_tiles_bf16, dar_tiles_i8_vnni;

#endif
