/* dice.h: draws from lib/rng.h one after the other.  The state is the caller's: the same dice give the same numbers. */
#ifndef DAR_DATA_DICE_H
#define DAR_DATA_DICE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/rng.h"

typedef struct dar_dice {
    uint64_t seed, stream, next;
} dar_dice;

/* Dice for one purpose of one thing: those of other names and numbers have nothing in common with them. */
static inline dar_dice dar_dice_for(uint64_t seed, const char *purpose, uint64_t number)
{
    return (dar_dice){ dar_rng_u64(seed, dar_rng_stream(purpose), number), dar_rng_stream(purpose), 0 };
}

static inline double dar_dice_in(dar_dice *d, double lo, double hi)
{
    return lo + (hi - lo) * dar_rng_f64(d->seed, d->stream, d->next++);
}

/* 0 .. n - 1 */
static inline size_t dar_dice_below(dar_dice *d, size_t n)
{
    return (size_t)dar_rng_below(d->seed, d->stream, d->next++, n);
}

static inline bool dar_dice_chance(dar_dice *d, double p)
{
    return dar_dice_in(d, 0, 1) < p;
}

/* x, a little more or less. */
static inline double dar_dice_near(dar_dice *d, double x, double share)
{
    return x * dar_dice_in(d, 1 - share, 1 + share);
}

#endif
