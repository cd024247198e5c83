/* attn.h: attention, forward and backward, without the matrix of weights.
 *
 *   l_ij = scale q_i . k_j + lw_j        per head, j over the keys
 *   y_i  = sum_j exp(l_ij) v_j / sum_j exp(l_ij)
 *
 * n equal keys with equal values can be folded into one with lw = log n; lw = -inf masks a key.  A row without any key
 * gives zeros, and zero gradients.
 *
 * Queries are taken in blocks, keys in blocks, and only a block of weights exists at a time.  Backward computes the
 * weights again from two numbers per row.  Products run on the tile that fits the operands (lib/tile.h): in bf16 if q,
 * k and v are, with the weights rounded to bf16; sums and exponentials are f32, or f64 for f64 operands.
 *
 * Work is cut by sizes alone and partial sums are added in order: same bits for any number of threads.
 * Source: Milakov and Gimelshein 2018 (running maximum), Dao et al. 2022, alg. 1 and 4 (blocks, recomputation). */
#ifndef DAR_LIB_ATTN_H
#define DAR_LIB_ATTN_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/tensor.h"

/* All contiguous.  q, k, v, y of any float types, f64 all or none; stats, gy and gradients f32, or f64 with them;
 * of gy, gk and gv each may be bf16, and is not added to then. */
typedef struct dar_attn {
    dar_tensor q, y; /* [B, Nq, D], D = heads E */
    dar_tensor k, v; /* [B, Nk, D] */
    dar_tensor lw;   /* [Nk] or [B, Nk] log-weights of keys; data NULL: all 0 */
    size_t heads;
    double scale; /* > 0 */

    /* Row statistics (m, s): sum_j exp(l_ij) = s exp(scale m), or s 2^m where lw is present; (0, 0) without a key.
     * Forward writes them unless data is NULL. */
    dar_tensor stats; /* [B, heads, Nq, 2] */

    /* For backward: gq = (add_q ? gq : 0) + gradient, likewise gk, gv; data NULL: not wanted, its work is left out. */
    dar_tensor gy;
    dar_tensor gq, gk, gv;
    bool add_q, add_k, add_v;

    void *scratch; /* dar_attn_scratch bytes, 64-byte aligned */
    int threads;   /* that scratch is for */
} dar_attn;

/* Bytes of scratch; the tensors need no memory behind them, but in backward those whose data is NULL are not wanted. */
size_t dar_attn_scratch(const dar_attn *a, bool backward);

void dar_attn_forward(const dar_attn *a);
void dar_attn_backward(const dar_attn *a);

#endif
