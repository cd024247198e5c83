/* bcast.h: elementwise work and sums over tensors that broadcast against each other, in pieces that fit the first-level
 * cache.
 *
 * Shapes broadcast as in numpy: they are aligned at the last dimension, and a dimension of 1, or one that is missing,
 * repeats.  Tensors are contiguous and of any storage type but i8.  The same bits for any number of threads. */
#ifndef DAR_AUTOGRAD_BCAST_H
#define DAR_AUTOGRAD_BCAST_H

#include <stdbool.h>

#include "lib/kern.h"
#include "lib/tensor.h"

#define DAR_BCAST_IN 3 /* most inputs */

/* y = fn(x[0], x[1], ...) on n elements of k's type; y is none of the others, but where the
 * caller of what calls fn says so. */
typedef void dar_bcast_fn(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y);

typedef struct dar_bcast {
    dar_bcast_fn *fn;
    const void *arg;
    const dar_tensor *x[DAR_BCAST_IN]; /* NULL after the last */
    const dar_tensor *y;
    bool add;      /* to what is in y */
    double factor; /* of a sum */
    void *scratch; /* of a sum */
} dar_bcast;

/* The shape a and b broadcast to; aborts with the op's name if they do not. */
dar_shape dar_bcast_shape(const char *op, const dar_shape *a, const dar_shape *b);

/* y (+)= fn(x).  Every x broadcasts to y's shape; arithmetic is in the compute type of y. */
void dar_bcast_map(const dar_bcast *b);

/* y (+)= factor * sum of fn(x) over the dimensions in which y repeats.  y and every x broadcast to x[0]'s shape;
 * arithmetic is in the compute type of x[0]; at most 32 terms are added in f32, the rest in f64.  fn NULL: x[0]. */
void dar_bcast_sum(const dar_bcast *b);

/* Gradients of a sum of f(x[0] - x[1]), of one shape: b->fn gives that of x[0] with *slope as it is, that of x[1] with
 * its negative.  What has no gradient has no data; add: to what is there. */
void dar_bcast_opposites(dar_bcast b, double *slope, const dar_tensor gx[2], const bool add[2]);

/* n elements from `element` on in arithmetic type c, in place or in buf; step 0: the one there, n times. */
const void *dar_bcast_get(dar_dtype c, const dar_tensor *x, size_t element, size_t step, size_t n, void *buf);

/* Bytes of scratch for it: a function of the shapes of x and y. */
size_t dar_bcast_sum_scratch(const dar_bcast *b);

#endif
