/* taew.c: see taew.h. */
#include "models/taew.h"

#include <math.h>
#include <stdio.h>

#include "lib/kern.h"

#define GROUP  4  /* frames of a latent frame */
#define DROP   3  /* frames made before the first of a clip */
#define PATCH  2  /* rows and columns of pixels that are channels */
#define SHRINK 16 /* pixels in a latent row or column */
#define BOUND  3  /* of a latent value inside */
#define MADE   20 /* the first layer of the decoder that makes no more frames */

const dar_taew_config dar_taew_public = { .latent = 48, .encoder_width = 64, .decoder_width = { 256, 128, 64, 64 } };

/* ---------------------------------------------------------------- the public layout */

typedef enum width { PIXELS, LATENT, E, D0, D1, D2, D3 } width;

typedef struct row {
    dar_taew_kind kind;
    width in, out;
    int times;
} row;

static const row encoder[DAR_TAEW_ENCODER] = {
    { DAR_TAEW_CONV, PIXELS, E, 1 }, { DAR_TAEW_RELU, E, E, 1 },

    { DAR_TAEW_POOL, E, E, 2 },      { DAR_TAEW_HALVE, E, E, 1 },  { DAR_TAEW_MEMORY, E, E, 1 },
    { DAR_TAEW_MEMORY, E, E, 1 },    { DAR_TAEW_MEMORY, E, E, 1 },

    { DAR_TAEW_POOL, E, E, 2 },      { DAR_TAEW_HALVE, E, E, 1 },  { DAR_TAEW_MEMORY, E, E, 1 },
    { DAR_TAEW_MEMORY, E, E, 1 },    { DAR_TAEW_MEMORY, E, E, 1 },

    { DAR_TAEW_POOL, E, E, 1 },      { DAR_TAEW_HALVE, E, E, 1 },  { DAR_TAEW_MEMORY, E, E, 1 },
    { DAR_TAEW_MEMORY, E, E, 1 },    { DAR_TAEW_MEMORY, E, E, 1 },

    { DAR_TAEW_CONV, E, LATENT, 1 },
};

static const row decoder[DAR_TAEW_DECODER] = {
    { DAR_TAEW_CLAMP, LATENT, LATENT, 1 }, { DAR_TAEW_CONV, LATENT, D0, 1 }, { DAR_TAEW_RELU, D0, D0, 1 },
    { DAR_TAEW_MEMORY, D0, D0, 1 },        { DAR_TAEW_MEMORY, D0, D0, 1 },   { DAR_TAEW_MEMORY, D0, D0, 1 },

    { DAR_TAEW_LATER, D0, D0, 1 },         { DAR_TAEW_GROW, D0, D0, 1 },     { DAR_TAEW_DOUBLE, D0, D1, 1 },
    { DAR_TAEW_MEMORY, D1, D1, 1 },        { DAR_TAEW_MEMORY, D1, D1, 1 },   { DAR_TAEW_MEMORY, D1, D1, 1 },

    { DAR_TAEW_LATER, D1, D1, 1 },         { DAR_TAEW_GROW, D1, D1, 2 },     { DAR_TAEW_DOUBLE, D1, D2, 1 },
    { DAR_TAEW_MEMORY, D2, D2, 1 },        { DAR_TAEW_MEMORY, D2, D2, 1 },   { DAR_TAEW_MEMORY, D2, D2, 1 },

    { DAR_TAEW_LATER, D2, D2, 1 },         { DAR_TAEW_GROW, D2, D2, 2 },     { DAR_TAEW_DOUBLE, D2, D3, 1 },
    { DAR_TAEW_RELU, D3, D3, 1 },          { DAR_TAEW_CONV, D3, PIXELS, 1 },
};

/* Weight [out, in, k, k] and bias [out]. */
static void declare(dar_params *p, dar_taew_layer *l, int i, dar_shape s, bool bias, const char *name)
{
    double fan = (double)(s.d[1] * s.d[2] * s.d[3]);
    dar_param_info w = { DAR_PARAM_BASE, true, DAR_FRESH_UNIFORM, 1 / sqrt(fan) }, b = w;
    b.matrix = false;
    l->w[i] = dar_params_add(p, w, s, "%s.weight", name);
    if (bias) l->b[i] = dar_params_add(p, b, DAR_SHAPE(s.d[0]), "%s.bias", name);
}

static void declare_layer(dar_params *p, dar_taew_layer *l, const row *r, const int64_t *widths, const char *name)
{
    int64_t in = widths[r->in], out = widths[r->out];
    char inner[DAR_PARAM_NAME];
    *l = (dar_taew_layer){ .kind = r->kind, .times = r->times };
    switch (r->kind) {
    case DAR_TAEW_CONV:
    case DAR_TAEW_HALVE:
    case DAR_TAEW_DOUBLE: declare(p, l, 0, DAR_SHAPE(out, in, 3, 3), r->kind == DAR_TAEW_CONV, name); break;
    case DAR_TAEW_MEMORY:
        for (int i = 0; i < 3; i++) {
            snprintf(inner, sizeof inner, "%s.conv.%d", name, 2 * i);
            declare(p, l, i, DAR_SHAPE(out, i ? in : 2 * in, 3, 3), true, inner);
        }
        break;
    case DAR_TAEW_POOL:
    case DAR_TAEW_GROW:
        snprintf(inner, sizeof inner, "%s.conv", name);
        if (r->kind == DAR_TAEW_POOL) in *= r->times;
        else out *= r->times;
        declare(p, l, 0, DAR_SHAPE(out, in, 1, 1), false, inner);
        break;
    case DAR_TAEW_RELU:
    case DAR_TAEW_LATER:
    case DAR_TAEW_CLAMP: break;
    }
}

void dar_taew_init(dar_taew *v, dar_params *p, const dar_taew_config *c)
{
    const int64_t widths[] = {
        [PIXELS] = 3 * PATCH * PATCH, [LATENT] = c->latent,       [E] = c->encoder_width,
        [D0] = c->decoder_width[0],   [D1] = c->decoder_width[1], [D2] = c->decoder_width[2],
        [D3] = c->decoder_width[3],
    };
    char name[32];
    *v = (dar_taew){ .c = *c, .storage = p->storage, .main = p->main };
    for (int i = 0; i < DAR_TAEW_ENCODER; i++) {
        snprintf(name, sizeof name, "encoder.%d", i);
        declare_layer(p, &v->encoder[i], &encoder[i], widths, name);
    }
    for (int i = 0; i < DAR_TAEW_DECODER; i++) {
        snprintf(name, sizeof name, "decoder.%d", i);
        declare_layer(p, &v->decoder[i], &decoder[i], widths, name);
    }
}

/* ---------------------------------------------------------------- weights as they are used */

/* w [C, 2 C, 3, 3], channels of this frame and of the one before -> [C, C, 2, 3, 3], the one before and this. */
static dar_tensor order_by_time(const dar_tensor *w, dar_dtype type, dar_arena *a)
{
    static const int frames_last[] = { 0, 2, 1, 3 };
    int64_t C = w->shape.d[0];
    dar_tensor y = dar_tensor_push(a, type, DAR_SHAPE(C, C, 2, 3, 3));
    dar_tensor to = dar_tensor_reshape(&y, DAR_SHAPE(C, C, 2, 9));
    dar_tensor from = dar_tensor_reshape(w, DAR_SHAPE(C, 2, C, 9));
    from = dar_tensor_permute(&from, frames_last);
    for (int k = 0; k < 2 && !a->plan; k++) {
        dar_tensor one = dar_tensor_narrow(&to, 2, 1 - k, 1), frame = dar_tensor_narrow(&from, 2, k, 1);
        dar_tensor_copy(&one, &frame);
    }
    return y;
}

static void prepare(const dar_taew *v, dar_taew_layer *l, int layers, dar_arena *a)
{
    for (int i = 0; i < layers; i++) {
        if (l[i].kind == DAR_TAEW_MEMORY) l[i].back = order_by_time(&l[i].w[0]->x, v->storage, a);
        if (l[i].kind == DAR_TAEW_DOUBLE) l[i].folded = dar_double_fold(&l[i].w[0]->x, v->storage, a);
    }
}

void dar_taew_prepare(dar_taew *v, dar_arena *a)
{
    prepare(v, v->encoder, DAR_TAEW_ENCODER, a);
    prepare(v, v->decoder, DAR_TAEW_DECODER, a);
}

/* ---------------------------------------------------------------- layers */

/* One run over a clip, or over a piece of it. */
struct pass {
    const dar_taew *v;
    dar_taew_stream *s; /* NULL: the whole clip */
};

static bool begins(const struct pass *p)
{
    return !p->s || p->s->pieces == 0;
}

static dar_val *product(dar_tape *t, const dar_taew *v, const dar_taew_layer *l, int i, dar_val *x)
{
    dar_val *w = dar_param_operand(t, l->w[i], v->storage);
    dar_conv_attr a = dar_conv_same(w);
    if (l->kind == DAR_TAEW_HALVE) a.stride = 2;
    return dar_conv2d(t, x, w, dar_param_leaf(t, l->b[i]), a);
}

struct memory {
    const dar_taew *v;
    const dar_taew_layer *l;
    const dar_tensor *before; /* NULL: zeros */
};

static dar_val *memory_block(dar_tape *t, void *arg, dar_val *const *in)
{
    const struct memory *m = arg;
    dar_val *w = dar_leaf(t, m->l->back, NULL), *before = m->before ? dar_leaf(t, *m->before, NULL) : NULL;
    dar_val *x = dar_conv3d(t, in[0], w, dar_param_leaf(t, m->l->b[0]), before, dar_conv_same(w));
    for (int i = 1; i < 3; i++) x = product(t, m->v, m->l, i, dar_relu(t, x));
    return dar_relu(t, dar_add(t, x, in[0]));
}

static void keep_last(dar_arena *a, dar_tensor *cache, const dar_tensor *x)
{
    dar_tensor last = dar_tensor_narrow(x, 2, x->shape.d[2] - 1, 1);
    if (!cache->data) *cache = dar_tensor_push(a, x->dtype, last.shape);
    if (!a->plan) dar_tensor_copy(cache, &last);
}

/* Layer i of its side: its place in the cache. */
static dar_val *memory(dar_tape *t, const struct pass *p, const dar_taew_layer *l, int i, dar_val *x)
{
    dar_tensor *cache = p->s ? &p->s->cache[i] : NULL;
    struct memory m = { p->v, l, cache && cache->data ? cache : NULL };
    dar_val *y = dar_segment(t, memory_block, &m, &x, 1, x->x.dtype, x->x.shape);
    if (cache) keep_last(p->s->arena, cache, &x->x);
    return y;
}

/* y = BOUND tanh(z / BOUND) */
static dar_val *clamp(dar_tape *t, dar_val *z)
{
    dar_val *y = dar_contiguous(t, z);
    const dar_kern *k = dar_kern_for(y->x.dtype);
    size_t n = dar_tensor_count(&y->x);
    if (t->arena->plan) return y;
    k->scale(n, 1.0 / BOUND, y->x.data, y->x.data);
    k->tanh(n, y->x.data, y->x.data);
    k->scale(n, BOUND, y->x.data, y->x.data);
    return y;
}

static dar_val *layer(dar_tape *t, const struct pass *p, const dar_taew_layer *l, int i, dar_val *x)
{
    switch (l->kind) {
    case DAR_TAEW_CONV:
    case DAR_TAEW_HALVE: return product(t, p->v, l, 0, x);
    case DAR_TAEW_DOUBLE: return dar_double_forward(t, &l->folded, NULL, x);
    case DAR_TAEW_RELU: return dar_relu(t, x);
    case DAR_TAEW_MEMORY: return memory(t, p, l, i, x);
    case DAR_TAEW_POOL: return product(t, p->v, l, 0, dar_frame_unshuffle(t, x, l->times));
    case DAR_TAEW_GROW: return dar_frame_shuffle(t, product(t, p->v, l, 0, x), l->times);
    case DAR_TAEW_LATER: return x;
    case DAR_TAEW_CLAMP: return dar_cast(t, clamp(t, x), p->v->storage);
    }
    return NULL;
}

/* ---------------------------------------------------------------- encoder */

static dar_val *encode(dar_tape *t, const struct pass *p, dar_val *x)
{
    const int64_t *d = x->x.shape.d, missing = (GROUP - d[2] % GROUP) % GROUP;
    DAR_ASSERT(!t->recording && x->x.shape.n == 5 && d[1] == 3 && d[3] % SHRINK == 0 && d[4] % SHRINK == 0,
               "taew: pixels of %lld channels, %lld x %lld, expected 3 and sides that %d divides; not recorded",
               (long long)d[1], (long long)d[4], (long long)d[3], SHRINK);
    dar_val *last = dar_slice(t, x, 2, d[2] - 1, 1), *frames[GROUP] = { x, last, last, last };
    if (missing) x = dar_concat(t, frames, 1 + (int)missing, 2);
    x = dar_pixel_unshuffle(t, dar_affine(t, x, 0.5, 0.5), PATCH, DAR_PIXELS_ROWS);
    x = dar_cast(t, x, p->v->storage);
    for (int i = 0; i < DAR_TAEW_ENCODER; i++) x = layer(t, p, &p->v->encoder[i], i, x);
    return dar_cast(t, x, p->v->main);
}

dar_val *dar_taew_encode(dar_tape *t, const dar_taew *v, dar_val *x)
{
    return encode(t, &(struct pass){ v, NULL }, x);
}

dar_val *dar_taew_encode_next(dar_taew_stream *s, dar_tape *t, dar_val *x)
{
    DAR_ASSERT(s->side == DAR_VAE_ENCODER && x->x.shape.d[2] <= GROUP, "taew: a stream of the decoder, or %lld frames",
               (long long)x->x.shape.d[2]);
    dar_val *z = encode(t, &(struct pass){ s->v, s }, x);
    s->pieces++;
    return z;
}

/* ---------------------------------------------------------------- decoder */

/* All that makes frames, each still small. */
static dar_val *make_frames(dar_tape *t, const struct pass *p, dar_val *z)
{
    DAR_ASSERT(!t->recording, "taew: a tape that records");
    for (int i = 0; i < MADE; i++) z = layer(t, p, &p->v->decoder[i], i, z);
    return begins(p) ? dar_slice(t, z, 2, DROP, z->x.shape.d[2] - DROP) : z;
}

/* Frames by themselves. */
static dar_val *finish_frames(dar_tape *t, const struct pass *p, dar_val *x)
{
    for (int i = MADE; i < DAR_TAEW_DECODER; i++) x = layer(t, p, &p->v->decoder[i], i, x);
    x = dar_pixel_shuffle(t, dar_cast(t, x, p->v->main), PATCH, DAR_PIXELS_ROWS);
    x = dar_affine(t, x, 2, -1);
    if (!t->arena->plan) dar_vae_clamp(&x->x);
    return x;
}

dar_val *dar_taew_decode(dar_tape *t, const dar_taew *v, dar_val *z)
{
    struct pass p = { v, NULL };
    return finish_frames(t, &p, make_frames(t, &p, z));
}

dar_status dar_taew_decode_next(dar_taew_stream *s, dar_tape *t, dar_val *z, dar_vae_sink *sink, void *ctx, dar_err *e)
{
    struct pass p = { s->v, s };
    dar_status status = DAR_OK;
    DAR_ASSERT(s->side == DAR_VAE_DECODER && z->x.shape.d[2] == 1, "taew: a stream of the encoder, or %lld frames",
               (long long)z->x.shape.d[2]);
    dar_tape_place begin = dar_tape_mark(t);
    dar_val *x = make_frames(t, &p, z);
    int64_t frames = x->x.shape.d[2], first = s->pieces ? GROUP * s->pieces - DROP : 0;
    for (int64_t f = 0; f < frames && status == DAR_OK; f++) {
        dar_tape_place m = dar_tape_mark(t);
        dar_val *y = finish_frames(t, &p, dar_slice(t, x, 2, f, 1));
        if (sink) status = sink(ctx, &y->x, first + f, e);
        dar_tape_reset(t, m);
    }
    dar_tape_reset(t, begin);
    s->pieces++;
    return status;
}

void dar_taew_stream_init(dar_taew_stream *s, const dar_taew *v, dar_vae_side side, dar_arena *a)
{
    *s = (dar_taew_stream){ .v = v, .side = side, .arena = a };
}
