/* arena.h: memory with three owners and no free.
 *
 * An arena hands out 64-byte aligned pieces of one mapped range, in order.  mark/reset give back everything that came
 * after the mark.  A planning arena has addresses but no memory behind them: the same code run on it, without
 * computing, finds the exact peak before anything is reserved. */
#ifndef DAR_LIB_ARENA_H
#define DAR_LIB_ARENA_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/status.h"

#define DAR_ALIGN 64

typedef struct dar_arena {
    const char *name; /* for messages */
    unsigned char *base;
    size_t size; /* bytes mapped */
    size_t used; /* bytes handed out */
    size_t peak; /* most bytes ever handed out */
    bool plan;   /* addresses only: touching them is a fault */
} dar_arena;

typedef size_t dar_mark;

/* Map `bytes` (rounded up to 2 MiB) of zeroed memory, asking for huge pages.  On failure a->base is NULL and the
 * message carries the sizes.  `name` must outlive the arena. */
dar_status dar_arena_init(dar_arena *a, const char *name, size_t bytes, dar_err *e);

/* An arena for planning: pushes count, nothing may be read or written. */
dar_status dar_arena_init_plan(dar_arena *a, const char *name, dar_err *e);

/* Unmap.  Accepts a zeroed or already freed arena. */
void dar_arena_free(dar_arena *a);

/* `bytes` of 64-byte aligned memory, content undefined.  Overflow is a planning bug: aborts with the numbers. */
void *dar_arena_push(dar_arena *a, size_t bytes);

dar_mark dar_arena_mark(const dar_arena *a);

/* Give back everything pushed since `m`. */
void dar_arena_reset(dar_arena *a, dar_mark m);

/* a * b, a + b in bytes; abort instead of wrapping round. */
size_t dar_mul_size(size_t a, size_t b);
size_t dar_add_size(size_t a, size_t b);

#endif
