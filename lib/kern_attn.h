/* kern_attn.h: the vector work of attention: from a block of products to a block of weights, and rows at its edges.
 *
 * Weights are powers of two: with t_ij = c s_ij + lw_j, c = scale log2 e and lw in the same unit, a row's weights are
 * 2^(t_ij - max_i) / sum_i.  max_i need not be the row's maximum, only near enough that nothing overflows.
 *
 * One table per kind of tile that does the products.  Numbers (s, max, sum, o, ...) are f64 for DAR_TILE_F64, else f32;
 * operands (p, ds) are what that tile multiplies: f64, f32, or bf16 in pairs.  The reference text
 * (lib/kern_attn_ref.inc) fills every slot. */
#ifndef DAR_LIB_KERN_ATTN_H
#define DAR_LIB_KERN_ATTN_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/tile.h"

#define DAR_ATTN_LANES 16 /* partial sums per row */
#define DAR_ATTN_PAD   32 /* rows of s, dp, p, ds and of numbers per column may be touched up to a multiple of this */

/* A block of forward: rows are queries, columns keys. */
typedef struct dar_attn_soft {
    size_t m, n;
    const void *s; /* products, row i at s + i ld */
    size_t ld;
    double c;
    const void *lw; /* [n] or NULL: all 0 */
    bool first;     /* of its rows: max, sum and o hold nothing yet */
    void *p;        /* weights as operands, row i at p + i ldp; an odd last pair is filled with 0; f32, f64: may be s */
    size_t ldp;     /* [elements] */
    void *max;      /* [m] in units of t, or of s if lw is NULL; -inf: no key yet */
    void *sum;      /* [m, DAR_ATTN_LANES], to be added up */
    void *o;        /* [m, E], row i at o + i ldo: sums weighted so far */
    size_t ldo, E;
} dar_attn_soft;

/* A block of backward: rows are keys, columns queries. */
typedef struct dar_attn_grad {
    size_t m, n;
    const void *s, *dp; /* products q k and v gy', element (j, i) at j ld + i; dp NULL: only p is wanted */
    size_t ld;
    double c;
    const void *lw;  /* [m] or NULL */
    const void *max; /* [n], finite, in units as above */
    const void *dot; /* [n]: sum of gy' y */
    void *p, *ds;    /* 2^(t - max) and p (dp - dot) as operands, row j at j ldp; an odd last pair is filled with 0;
                        f32, f64: may be s and dp.  NULL: not wanted */
    size_t ldp;
    void *ds_pairs; /* bf16: ds once more, pairs of rows together: (j, i) at (j / 2 ldp + i) 2 + j % 2; an odd last row
                       is paired with 0.  NULL: not wanted */
} dar_attn_grad;

typedef struct dar_kern_attn {
    const char *name;

    /* max rises where the block needs it, sum and o are rescaled to it, the block's weights are added to sum.  A row
     * whose t are all -inf keeps max -inf and gets weights 0.  NaN stays NaN. */
    void (*soft)(const dar_attn_soft *b);
    void (*grad)(const dar_attn_grad *b);
} dar_kern_attn;

const dar_kern_attn *dar_kern_attn_for(dar_tile_kind kind);

/* Fill the tables for a set of DAR_CPU_ flags; called by dar_cpu_init. */
void dar_kern_attn_init(unsigned cpu_flags);

/* The sets that fill them. */
extern const dar_kern_attn dar_kern_attn_ref_f64, dar_kern_attn_ref_f32, dar_kern_attn_ref_bf16;
extern const dar_kern_attn dar_kern_attn_f32_avx2, dar_kern_attn_f32_avx512, dar_kern_attn_bf16;

#endif
