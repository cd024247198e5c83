/* product.h: the driver under everything that multiplies: C[m, n] (+)= sum over terms of A[m, k] B[k, n].
 *
 * The operands need not exist as matrices: the driver asks a callback for stripes of them, packed for a tile, when it
 * needs them (a convolution gathers its windows there).  Finished tiles of C go through another callback while they are
 * in the nearest cache.
 *
 * Order of summation: k is cut in blocks of a length that depends on k, on m, and on the tile, which m and n choose;
 * within a block as the tile says, the blocks' sums one after the other, the terms in order.  So C has the same bits
 * for any number of threads; a row of it may have others in a product of other sizes. */
#ifndef DAR_LIB_PRODUCT_H
#define DAR_LIB_PRODUCT_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/tile.h"

/* A: lanes are rows of C.  B: lanes are columns. */
typedef struct dar_operand {
    /* Write lanes [at, at + n) over elements [k0, k0 + k) of the sum as a packed stripe of t, mr or nr wide, filled up
     * with zeros; if `many`, n may be more: as stripes one after the other (dar_tile_pack_* do either).  `at` is a
     * multiple of the width, k0 of the unit.  Runs on any thread; each lane of B is asked for once per block of k. */
    void (*pack)(const void *ctx, const dar_tile *t, size_t at, size_t n, size_t k0, size_t k, void *stripes);
    bool many;
    bool by_row; /* A only: each row of a stripe lies by itself, its units consecutive */
    const void *ctx;

    /* It lies in memory as the tile reads it [units]: of A, unit (i, k) at units + i * row + k; of B, unit (k, j) at
     * units + k * row + j, in whole stripes, and the tile has mm_beside.  A is not packed then; B is where many rows of
     * A share it.  Whole units are read: past k they hold zeros, or the other operand does. */
    const void *units;
    bool in_place;
    size_t row;
} dar_operand;

typedef struct dar_term {
    size_t k; /* 0: no such term */
    dar_operand a, b;
} dar_term;

typedef struct dar_product {
    const dar_tile *tile; /* of dar_tile_fit(kind, m, n) */
    size_t m, n;
    dar_term term[2];

    /* direct: sums are kept in c, in the tile's type of C; add: to what is there.  Else in scratch, seen by `done`. */
    bool direct;
    void *c;
    size_t ldc;
    bool add;

    /* NULL, or called once for every finished tile: rows [i, i + m), columns [j, j + n), m <= mr, n <= nr, which it may
     * change.  Runs on any thread. */
    void (*done)(const void *ctx, size_t i, size_t j, size_t m, size_t n, void *c, size_t ldc);
    const void *ctx;
} dar_product;

/* Bytes of scratch that dar_product_run needs with the present number of threads; no memory is looked at. */
size_t dar_product_scratch(const dar_product *p);
void dar_product_run(const dar_product *p, void *scratch);

#endif
