/* encode.c: see encode.h. */
#include "models/encode.h"

#include <math.h>

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

struct picture {
    dar_decode_sink *sink;
    void *ctx;
    uint8_t *rgb;
};

/* [-1, 1] to display values, rounded to nearest. */
static dar_status show_frame(void *ctx, const dar_tensor *frame, int64_t index, dar_err *e)
{
    struct picture *p = ctx;
    size_t pixels = dar_tensor_count(frame) / 3;
    for (size_t k = 0; k < 3; k++)
        for (size_t i = 0; i < pixels; i++) {
            double x = dar_dtype_get(frame->dtype, frame->data, k * pixels + i);
            if (!(fabs(x) <= 1)) return dar_fail(e, DAR_ERR_NUMERIC, "frame %lld is not finite", (long long)index);
            p->rgb[3 * i + k] = (uint8_t)(127.5 * (x + 1) + 0.5);
        }
    return p->sink(p->ctx, (size_t)index, p->rgb, e);
}

dar_status dar_decode_clip(dar_tape *t, const dar_vae *v, dar_arena *kept, const dar_tensor *z, dar_decode_sink *sink,
                           void *ctx, dar_err *e)
{
    const int64_t *d = z->shape.d, r = dar_vae_shrink(&v->c);
    const bool plan = t->arena->plan;
    dar_mark begin = dar_arena_mark(kept);
    dar_status s = DAR_OK;
    dar_vae_stream stream;
    struct picture picture = { sink, ctx, dar_arena_push(kept, (size_t)(3 * d[3] * d[4] * r * r)) };
    dar_vae_stream_init(&stream, v, DAR_VAE_DECODER, kept);
    for (int64_t f = 0; f < d[2] && s == DAR_OK; f++) {
        dar_tape_place m = dar_tape_mark(t);
        dar_tensor from = dar_tensor_narrow(z, 2, f, 1);
        dar_val *x = dar_input(t, v->main, from.shape);
        if (!plan) dar_tensor_copy(&x->x, &from);
        s = dar_vae_decode_next(&stream, t, x, plan ? NULL : show_frame, &picture, e);
        dar_tape_reset(t, m);
    }
    dar_arena_reset(kept, begin);
    return s;
}
