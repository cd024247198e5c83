/* kern_ref.c: the reference kernels, one text compiled for float and for double. */
#include "lib/kern_sets.h"

#include <math.h>
#include <string.h>

#include "lib/kern_random.h"

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

/* ---------------------------------------------------------------- random bits */

static void philox(size_t blocks, uint64_t seed, uint64_t stream, uint64_t index, uint32_t *out)
{
    for (size_t i = 0; i < blocks; i++) {
        dar_philox b = dar_philox_at(seed, stream, index + i);
        memcpy(out + 4 * i, b.x, sizeof b.x);
    }
}

static void dither(size_t n, const uint32_t *random, int half, const float *x, uint16_t *y)
{
    for (size_t i = 0; i < n; i++) y[i] = dar_dither(x[i], random[i] >> 16 * half);
}

void dar_kern_random_ref(dar_kern *k)
{
    k->philox = philox;
    k->dither = dither;
}
