/* conv_clip.h: what convolutions read and write: channels by frames, some of them in a history of their own. */
#ifndef DAR_LIB_CONV_CLIP_H
#define DAR_LIB_CONV_CLIP_H

#include <string.h>

#include "lib/tensor.h"

typedef struct dar_clip {
    const dar_tensor *x, *past; /* [B, C, T, plane], [B, C, P, plane]; without data: nothing is there */
    size_t C, T, P;
    size_t plane; /* pixels of a frame */
} dar_clip;

/* Frame t of channel c, t < 0 in the history; NULL if it is nowhere. */
static inline char *dar_clip_frame(const dar_clip *v, size_t b, size_t c, int64_t t, dar_dtype *type)
{
    const dar_tensor *of = t < 0 ? v->past : v->x;
    size_t frames = t < 0 ? v->P : v->T;
    if (t < 0) t += (int64_t)v->P;
    if (t < 0 || (size_t)t >= frames || !of->data) return NULL;
    *type = of->dtype;
    return (char *)of->data + ((b * v->C + c) * frames + (size_t)t) * v->plane * dar_dtype_size(of->dtype);
}

/* n elements of `size` bytes are zero. */
static inline void dar_clip_zero(char *dst, size_t n, size_t size)
{
    if (n == 1 && size == 4) memset(dst, 0, 4); /* the usual border: one store */
    else if (n == 1 && size == 2) memset(dst, 0, 2);
    else if (n) memset(dst, 0, n * size);
}

#endif
