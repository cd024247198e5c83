/* size.h: arithmetic of sizes. */
#ifndef DAR_LIB_SIZE_H
#define DAR_LIB_SIZE_H

#include <stddef.h>

static inline size_t dar_least(size_t a, size_t b)
{
    return a < b ? a : b;
}

static inline size_t dar_most(size_t a, size_t b)
{
    return a > b ? a : b;
}

/* How many blocks of that size hold n; n rounded up to whole blocks. */
static inline size_t dar_blocks(size_t n, size_t block)
{
    return n / block + (n % block != 0);
}

static inline size_t dar_round_up(size_t n, size_t block)
{
    return dar_blocks(n, block) * block;
}

/* Length of equal blocks of n: at most `limit`, a multiple of `unit`, and `wanted` of them if none is below `little`.
 */
static inline size_t dar_even_block(size_t n, size_t limit, size_t unit, size_t wanted, size_t little)
{
    size_t count = dar_most(dar_blocks(n, limit), dar_least(wanted, dar_blocks(n, little)));
    return dar_most(dar_round_up(dar_blocks(n, dar_most(count, 1)), unit), unit);
}

#endif
