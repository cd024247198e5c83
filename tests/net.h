/* net.h: a small diffusion transformer for tests and measurements of the core as a whole: the blocks of the Wan DiT
 * (self-attention with RMS-normalised, rotated q and k; cross-attention to text; feed-forward; modulation and gates
 * with one row for the first frame and one for the rest), with LoRA on its ten projections or trained in full. */
#ifndef DAR_TESTS_NET_H
#define DAR_TESTS_NET_H

#include "autograd/ops.h"

#define NET_PROJECTIONS 10
#define NET_MAX_BLOCKS  8

typedef struct net_size {
    int blocks;
    int64_t grid[3]; /* tokens in time, height, width */
    int64_t text;    /* text tokens */
    int64_t width, heads, ffn;
    int64_t rank;      /* of the LoRA; 0: every weight is trained */
    dar_dtype storage; /* of frozen weights and of what is multiplied; the residual stream is f32, or f64 */
    bool train;        /* gradient memory for the trainable weights */
    bool keep;         /* keep the results of attention for the replay of a block */
    bool whole;        /* record blocks as they are, not as recompute segments */
} net_size;

typedef struct net_weight {
    dar_tensor x, g; /* g.data NULL: frozen */
} net_weight;

typedef struct net_block {
    net_weight w[NET_PROJECTIONS], b[NET_PROJECTIONS], down[NET_PROJECTIONS], up[NET_PROJECTIONS];
    net_weight norm[4], norm3_w, norm3_b; /* q, k of self, q, k of cross */
    net_weight modulation[6];             /* shift, scale, gate of attention, of the feed-forward: [1, 2, D] */
} net_block;

typedef struct net {
    net_size s;
    dar_dtype main; /* of the residual stream */
    int64_t tokens;
    net_block block[NET_MAX_BLOCKS];
    dar_tensor input, context, rope, target;
} net;

/* Push everything on a: weights and data, the same numbers for every storage type up to its rounding.  On a planning
 * arena nothing is written. */
void net_init(net *n, net_size s, dar_arena *a);

/* Bytes that net_init pushes. */
size_t net_bytes(net_size s);

/* The blocks, each a recompute segment unless `whole`; with recording off each gives its memory back.  input: [1, N, D]
 * of the main type. */
dar_val *net_forward(dar_tape *t, net *n, dar_val *input);

/* Mean squared distance of net_forward from the target. */
dar_val *net_loss(dar_tape *t, net *n, dar_val *input);

/* Call fn on every trainable weight, in order. */
void net_each(net *n, void (*fn)(void *ctx, net_weight *w), void *ctx);

#endif
