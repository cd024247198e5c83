/* tensor.h: shapes, tensors and views.  No arithmetic.
 *
 * Row-major, last index fastest, batch first: video [B, C, T, H, W], tokens [B, N, D].  A tensor does not own its
 * memory; a view shares it and must not outlive it.  Strides count elements. */
#ifndef DAR_LIB_TENSOR_H
#define DAR_LIB_TENSOR_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/arena.h"
#include "lib/dtype.h"

#define DAR_MAX_DIMS 6

typedef struct dar_shape {
    int n; /* dimensions, 0 for a scalar */
    int64_t d[DAR_MAX_DIMS];
} dar_shape;

typedef struct dar_tensor {
    dar_dtype dtype;
    dar_shape shape;
    int64_t stride[DAR_MAX_DIMS]; /* [elements] */
    void *data;                   /* NULL: absent */
    float *scale;                 /* i8 only: one per row of the last dimension, else NULL */
} dar_tensor;

/* Number of elements; 1 for a scalar.  Aborts on overflow or a negative dimension. */
size_t dar_shape_count(const dar_shape *s);
bool dar_shape_equal(const dar_shape *a, const dar_shape *b);

/* "[2, 3, 5]" into buf; returns buf. */
char *dar_shape_text(const dar_shape *s, char *buf, size_t size);

/* dar_shape_of(3, 2L, 3L, 5L) without counting: DAR_SHAPE(2, 3, 5). */
#define DAR_SHAPE(...) ((dar_shape){ sizeof(((int64_t[]){ __VA_ARGS__ })) / sizeof(int64_t), { __VA_ARGS__ } })

/* Describe contiguous memory. */
dar_tensor dar_tensor_of(dar_dtype t, dar_shape s, void *data);

/* Push a contiguous tensor, content undefined; an i8 tensor gets its scales too. */
dar_tensor dar_tensor_push(dar_arena *a, dar_dtype t, dar_shape s);

size_t dar_tensor_count(const dar_tensor *x);
size_t dar_tensor_bytes(const dar_tensor *x); /* of a contiguous tensor, with its scales */
bool dar_tensor_contiguous(const dar_tensor *x);

/* Address of element i of a contiguous tensor. */
static inline void *dar_tensor_at(const dar_tensor *x, size_t i)
{
    return (char *)x->data + i * dar_dtype_size(x->dtype);
}

/* Length of the last dimension, and how many such rows there are.  A scalar is one row of one. */
size_t dar_tensor_cols(const dar_tensor *x);
size_t dar_tensor_rows(const dar_tensor *x);

/* Views.  Abort if they do not fit.  narrow: length elements of dimension `dim` from `start`.  permute: y.d[i] =
 * x.d[order[i]].  reshape: x must be contiguous. */
dar_tensor dar_tensor_narrow(const dar_tensor *x, int dim, int64_t start, int64_t length);
dar_tensor dar_tensor_permute(const dar_tensor *x, const int *order);
dar_tensor dar_tensor_reshape(const dar_tensor *x, dar_shape s);

/* Copy values with conversion between any two types but i8; strides may differ, shapes must not.  Large copies are
 * spread over the threads. */
void dar_tensor_copy(const dar_tensor *dst, const dar_tensor *src);

/* dst += src, likewise; the sum is formed in dst's arithmetic type. */
void dar_tensor_add(const dar_tensor *dst, const dar_tensor *src);

/* Set every element; x must not be i8. */
void dar_tensor_fill(const dar_tensor *x, double value);

/* Index of the first element that is NaN or Inf, or -1. */
int64_t dar_tensor_nonfinite(const dar_tensor *x);

#endif
