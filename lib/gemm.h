/* gemm.h: the matrix product C (+)= alpha (A B + A2 B2), every operand transposed or not, of any storage type.
 *
 * Written for the linear layers: bias, activation and conversion happen on each tile of C while it is in the nearest
 * cache.  Built on lib/product.h; convolution uses that directly.  Error of f64 and f32: every element is within
 * eps (k + 8) sum |a b| of the exact value, eps of the arithmetic; of bf16, likewise with eps of f32, from the operands
 * as rounded to bf16. */
#ifndef DAR_LIB_GEMM_H
#define DAR_LIB_GEMM_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/dtype.h"
#include "lib/tile.h"

/* Element (i, j) is data[i * ld + j], or data[j * ld + i] if t. */
typedef struct dar_matrix {
    dar_dtype type;
    const void *data;
    size_t ld;          /* distance of stored rows [elements] */
    bool t;             /* stored transposed */
    const float *scale; /* i8 only: one per stored row */
} dar_matrix;

typedef struct dar_gemm {
    dar_tile_kind kind; /* arithmetic: F64, F32 or BF16; operands are converted to it while they are packed */
    size_t m, n;
    size_t k;
    dar_matrix a, b; /* [m, k], [k, n] */
    size_t k2;       /* 0: no second term */
    dar_matrix a2, b2;
    double alpha;

    dar_dtype type; /* of C: f64 with F64, else f32, bf16 or f16 */
    void *c;        /* [m, n], rows ldc apart; overlaps no operand */
    size_t ldc;
    bool add; /* to what C holds; not with bias, act or pre */

    const void *bias; /* NULL, or [n] added to every row */
    dar_dtype bias_type;
    void *pre;                                     /* NULL, or [m, n]: the sums before act, f32 (f64 with F64) */
    void (*act)(size_t n, const void *x, void *y); /* NULL, or a row kernel of that type (lib/kern.h) */
} dar_gemm;

/* The kind for operands of these types: F64 if one is f64, BF16 if both are bf16 and the processor multiplies them,
 * else F32. */
dar_tile_kind dar_gemm_kind(dar_dtype a, dar_dtype b);

/* Bytes of scratch with the present number of threads; data is not looked at. */
size_t dar_gemm_scratch(const dar_gemm *g);

/* Same bits for any number of threads.  Aborts on types that the kind does not take. */
void dar_gemm_run(const dar_gemm *g, void *scratch);

/* ---------------------------------------------------------------- 8 bits times 8 bits */

/* C = A W^T with A quantised row by row: q = round(a / s), s = max |a| / 127 of the row.  The products of q and W are
 * summed exactly and scaled by both scales. */
typedef struct dar_gemm_i8 {
    size_t m, n, k; /* k <= 65536: sums fit 32 bits */
    dar_dtype a_type;
    const void *a; /* [m, k], rows lda apart; f32, bf16 or f16 */
    size_t lda;
    const int8_t *w; /* [n, k], rows k apart */
    const float *w_scale;
    dar_dtype type; /* of C: f32, bf16 or f16 */
    void *c;
    size_t ldc;
    const void *bias;
    dar_dtype bias_type;
    void *pre;
    void (*act)(size_t n, const void *x, void *y);
} dar_gemm_i8;

size_t dar_gemm_i8_scratch(const dar_gemm_i8 *g);
void dar_gemm_i8_run(const dar_gemm_i8 *g, void *scratch);

#endif
