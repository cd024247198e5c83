/* encode.c: see encode.h. */
#include "models/encode.h"

void dar_encode_frame(const dar_tensor *x, int64_t f, const uint8_t *rgb)
{
    const int64_t *d = x->shape.d;
    size_t pixels = (size_t)(d[3] * d[4]);
    for (size_t k = 0; k < 3; k++) {
        size_t at = (k * (size_t)d[2] + (size_t)f) * pixels;
        for (size_t i = 0; i < pixels; i++)
            dar_dtype_set(x->dtype, x->data, at + i, rgb ? rgb[3 * i + k] / 127.5 - 1 : 0);
    }
}

dar_status dar_encode_clip(dar_tape *t, const dar_vae *v, dar_arena *kept, bool skip, dar_encode_source *source,
                           void *ctx, const dar_tensor *y, dar_err *e)
{
    const int64_t *d = y->shape.d, r = dar_vae_shrink(&v->c), frames = dar_vae_shrink_time(&v->c);
    dar_mark begin = dar_arena_mark(kept);
    dar_status s = DAR_OK;
    dar_vae_stream stream;
    dar_vae_stream_init(&stream, v, DAR_VAE_ENCODER, kept);
    stream.skip = skip;
    for (int64_t f = 0; f < d[2] && s == DAR_OK; f++) {
        dar_tape_place m = dar_tape_mark(t);
        dar_val *x = dar_input(t, v->main, DAR_SHAPE(1, 3, f ? frames : 1, d[3] * r, d[4] * r));
        if (!t->arena->plan) s = source(ctx, f, &x->x, e);
        if (s == DAR_OK) x = dar_vae_encode_next(&stream, t, x);
        dar_tensor to = dar_tensor_narrow(y, 2, f, 1);
        if (!t->arena->plan && s == DAR_OK) dar_tensor_copy(&to, &x->x);
        dar_tape_reset(t, m);
    }
    dar_arena_reset(kept, begin);
    return s;
}
