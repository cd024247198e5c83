/* kern_ref.c: the reference kernels, one text compiled for float and for double. */
#include "lib/kern_sets.h"

#include <math.h>
#include <string.h>

#define REAL    float
#define FN(x)   x##f
#define NAME(x) x##_f32
#include "lib/kern_ref.inc"
#undef REAL
#undef FN
#undef NAME

#define REAL    double
#define FN(x)   x
#define NAME(x) x##_f64
#include "lib/kern_ref.inc"

/* ---------------------------------------------------------------- moves */

#define DEF_TRANSPOSE(SIZE, T)                                                                                         \
    static void transpose_##SIZE(size_t m, size_t n, const void *x_, size_t ldx, void *y_, size_t ldy)                 \
    {                                                                                                                  \
        const T *x = x_;                                                                                               \
        T *y = y_;                                                                                                     \
        for (size_t j = 0; j < n; j++)                                                                                 \
            for (size_t i = 0; i < m; i++) y[j * ldy + i] = x[i * ldx + j];                                            \
    }
DEF_TRANSPOSE(8, uint64_t)
DEF_TRANSPOSE(4, uint32_t)
DEF_TRANSPOSE(2, uint16_t)

static void stream(size_t bytes, const void *x, void *y)
{
    memcpy(y, x, bytes);
}

void dar_kern_move_ref(dar_kern *k)
{
    k->transpose[DAR_F64] = transpose_8;
    k->transpose[DAR_F32] = transpose_4;
    k->transpose[DAR_BF16] = k->transpose[DAR_F16] = transpose_2;
    k->stream = stream;
}
