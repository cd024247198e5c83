/* distance.h: how far apart two contiguous tensors of as many elements are.  A NaN anywhere gives NaN, which no bound
 * accepts. */
#ifndef DAR_TESTS_DISTANCE_H
#define DAR_TESTS_DISTANCE_H

#include "tests/test.h"

#include "lib/tensor.h"

/* Largest deviation; *most, if it is not NULL: largest value of y. */
static inline double test_distance(const dar_tensor *x, const dar_tensor *y, double *most)
{
    size_t n = dar_tensor_count(y);
    double off = 0, large = 0;
    CHECK(dar_tensor_count(x) == n, "%zu numbers, expected %zu", dar_tensor_count(x), n);
    for (size_t i = 0; i < n; i++) {
        double a = dar_dtype_get(x->dtype, x->data, i), b = dar_dtype_get(y->dtype, y->data, i), d = fabs(a - b);
        if (isnan(d)) return NAN;
        off = fmax(off, d);
        large = fmax(large, fabs(b));
    }
    if (most) *most = large;
    return off;
}

/* Largest deviation over the largest value of y. */
static inline double test_relative(const dar_tensor *x, const dar_tensor *y)
{
    double most = 0, off = test_distance(x, y, &most);
    return off / most;
}

#endif
