/* groups.h: which rows of a parameter the tokens use, and sums over the tokens that use the same one.
 *
 * Tokens [B, N] take parameter rows [B, R]: token i of a clip takes row min(i / split, R - 1).  R = 1: one row for all;
 * R = 2: the first `split` tokens (the first frame) have their own; R = T with split tokens per frame: one per frame.
 * Where the tokens are a piece of a clip, i counts from `first`.
 *
 * The gradient of a parameter row is a sum over its tokens.  They are cut in chunks that never straddle a group; each
 * chunk makes a partial sum, and the partial sums of a group are added by a fixed tree. */
#ifndef DAR_AUTOGRAD_GROUPS_H
#define DAR_AUTOGRAD_GROUPS_H

#include "lib/tensor.h"

typedef struct dar_groups {
    size_t clips, tokens, rows, split; /* B, N, R */
    size_t chunk;                      /* tokens per chunk */
    size_t first;                      /* place of token 0 in its clip */
} dar_groups;

/* Groups of tokens that are rows of `width` elements; split > 0 unless rows is 1; first is 0. */
dar_groups dar_groups_of(size_t clips, size_t tokens, size_t rows, size_t split, size_t width);

/* The group, row b R + r of the parameter, of token b N + i. */
size_t dar_group_of(const dar_groups *g, size_t token);

/* Chunks in all, and chunk i: tokens [begin, end), all of one group. */
typedef struct dar_chunk {
    size_t group, begin, end;
} dar_chunk;
size_t dar_groups_chunks(const dar_groups *g);
dar_chunk dar_groups_chunk(const dar_groups *g, size_t i);

/* dst [groups, width] = or += the sums of the groups' partial sums.  parts: [chunks, width] of arithmetic type c,
 * overwritten.  Runs on all threads. */
void dar_groups_combine(const dar_groups *g, dar_dtype c, void *parts, size_t width, const dar_tensor *dst, bool add);

#endif
