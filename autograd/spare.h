/* spare.h: memory of arenas that is free before they are reset: blocks, joined where they touch. */
#ifndef DAR_AUTOGRAD_SPARE_H
#define DAR_AUTOGRAD_SPARE_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/arena.h"

#define DAR_SPARES 64 /* blocks that are remembered: the largest */

typedef struct dar_spare_block {
    unsigned char *at;
    size_t bytes;
    bool apart; /* of another arena: not joined with the rest */
} dar_spare_block;

/* Zeroed: nothing is spare.  A plain value: a copy of it is the state to come back to. */
typedef struct dar_spare {
    dar_spare_block block[DAR_SPARES]; /* those apart last, by address */
    int count;
} dar_spare;

/* `bytes` out of the smallest block that has them (a small piece is not cut out of a large one), else from a's end; a
 * NULL: else NULL. */
void *dar_spare_take(dar_spare *s, dar_arena *a, size_t bytes);

/* What dar_spare_take or dar_arena_push gave is free again. */
void dar_spare_give(dar_spare *s, void *at, size_t bytes, bool apart);

#endif
