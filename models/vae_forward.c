/* vae_forward.c: the autoencoder as functions over ops, for whole clips and for pieces of them. */
#include <math.h>
#include <string.h>

#include "models/vae.h"

/* One run over a clip, or over a piece of it. */
struct pass {
    const dar_vae *v;
    dar_vae_stream *s; /* NULL: the whole clip */
    bool *steady;      /* cleared when a cache changes; NULL: nobody asks */
};

static bool begins(const struct pass *p)
{
    return !p->s || p->s->pieces == 0;
}

/* ---------------------------------------------------------------- convolutions that look back */

static int64_t frames_of(const dar_val *x)
{
    return x->x.shape.d[2];
}

/* Whether frames [from, from + n) of x are those of `kept`, n in all. */
static bool same_frames(const dar_tensor *kept, const dar_tensor *x, int64_t from)
{
    if (!dar_tensor_contiguous(x)) return false;
    size_t frame = (size_t)(x->shape.d[3] * x->shape.d[4]) * dar_dtype_size(x->dtype);
    size_t rows = (size_t)(x->shape.d[0] * x->shape.d[1]), T = (size_t)x->shape.d[2], n = (size_t)kept->shape.d[2];
    for (size_t i = 0; i < rows; i++)
        if (memcmp((char *)kept->data + i * n * frame, (char *)x->data + (i * T + (size_t)from) * frame, n * frame))
            return false;
    return true;
}

/* Keep the last n frames of what was kept and x. */
static void keep_last(const struct pass *p, dar_tensor *cache, const dar_tensor *x, int64_t n)
{
    int64_t T = x->shape.d[2], old = T < n ? n - T : 0;
    bool fresh = !cache->data;
    if (fresh) {
        dar_shape s = x->shape;
        s.d[2] = n;
        *cache = dar_tensor_push(p->s->arena, x->dtype, s);
    }
    if (p->s->arena->plan) return;
    if (fresh) dar_tensor_fill(cache, 0);
    if (p->steady && *p->steady) {
        *p->steady = !fresh && !old && same_frames(cache, x, T - n);
        if (*p->steady) return;
    }
    if (old) {
        dar_tensor to = dar_tensor_narrow(cache, 2, 0, old), from = dar_tensor_narrow(cache, 2, n - old, old);
        dar_tensor_copy(&to, &from);
    }
    dar_tensor to = dar_tensor_narrow(cache, 2, old, n - old), from = dar_tensor_narrow(x, 2, T - (n - old), n - old);
    dar_tensor_copy(&to, &from);
}

/* The n frames before this piece: what is kept of the stream, or NULL: zeros. */
static dar_val *history(dar_tape *t, const struct pass *p, const dar_vae_conv *c)
{
    if (!p->s || c->slot < 0 || !p->s->cache[c->slot].data) return NULL;
    return dar_leaf(t, p->s->cache[c->slot], NULL);
}

static dar_val *weight(dar_tape *t, const struct pass *p, const dar_vae_conv *c)
{
    return dar_param_operand(t, c->w, p->v->storage);
}

static dar_val *causal(dar_tape *t, const struct pass *p, const dar_vae_conv *c, dar_val *x)
{
    dar_val *w = weight(t, p, c);
    dar_val *y = dar_conv3d(t, x, w, dar_param_leaf(t, c->b), history(t, p, c), dar_conv_same(w));
    if (p->s && c->slot >= 0) keep_last(p, &p->s->cache[c->slot], &x->x, c->w->x.shape.d[2] - 1);
    return y;
}

/* ---------------------------------------------------------------- blocks */

static dar_val *norm_silu(dar_tape *t, const dar_param *gamma, dar_val *x)
{
    dar_val *w = dar_reshape(t, dar_param_leaf(t, gamma), DAR_SHAPE(gamma->x.shape.d[0]));
    return dar_silu(t, dar_channel_norm(t, x, w));
}

struct residual {
    struct pass p;
    const dar_vae_res *r;
};

static dar_val *residual(dar_tape *t, void *arg, dar_val *const *in)
{
    const struct residual *a = arg;
    const dar_vae_res *r = a->r;
    dar_val *h = causal(t, &a->p, &r->conv[0], norm_silu(t, r->norm[0], in[0]));
    h = causal(t, &a->p, &r->conv[1], norm_silu(t, r->norm[1], h));
    return dar_add(t, h, r->shortcut.w ? causal(t, &a->p, &r->shortcut, in[0]) : in[0]);
}

/* A recompute segment, unless everything is to be kept. */
static dar_val *segment(dar_tape *t, const dar_vae *v, dar_segment_fn *fn, void *arg, dar_val *x, dar_shape s)
{
    return t->recording && v->whole ? fn(t, arg, &x) : dar_segment(t, fn, arg, &x, 1, x->x.dtype, s);
}

static dar_val *residual_segment(dar_tape *t, const struct pass *p, const dar_vae_res *r, dar_val *x)
{
    struct residual *a = dar_tape_store(t, &(struct residual){ *p, r }, sizeof *a);
    dar_shape s = x->x.shape;
    s.d[1] = r->conv[1].w->x.shape.d[0];
    return segment(t, p->v, residual, a, x, s);
}

struct attention {
    const dar_vae *v;
    const dar_vae_half *h;
};

/* Every frame by itself, one head of all channels. */
static dar_val *attention(dar_tape *t, void *arg, dar_val *const *in)
{
    static const int to_tokens[] = { 0, 2, 3, 4, 1 }, to_channels[] = { 0, 4, 1, 2, 3 };
    const struct attention *a = arg;
    dar_dtype storage = a->v->storage;
    const dar_vae_half *h = a->h;
    const int64_t *d = in[0]->x.shape.d;
    int64_t B = d[0], C = d[1], T = d[2], H = d[3], W = d[4];
    dar_attention_opt one = { .heads = 1 };

    dar_val *x = dar_channel_norm(t, in[0], dar_reshape(t, dar_param_leaf(t, h->attn_norm), DAR_SHAPE(C)));
    x = dar_reshape(t, dar_permute(t, x, to_tokens), DAR_SHAPE(B * T, H * W, C));
    dar_val *w = dar_reshape(t, dar_param_operand(t, h->qkv.w, storage), DAR_SHAPE(3 * C, C));
    dar_val *qkv = dar_linear(t, x, w, dar_param_leaf(t, h->qkv.b), NULL);
    x = dar_attention(t, dar_slice(t, qkv, 2, 0, C), dar_slice(t, qkv, 2, C, C), dar_slice(t, qkv, 2, 2 * C, C), &one);
    w = dar_reshape(t, dar_param_operand(t, h->proj.w, storage), DAR_SHAPE(C, C));
    x = dar_linear(t, x, w, dar_param_leaf(t, h->proj.b), NULL);
    x = dar_permute(t, dar_reshape(t, x, DAR_SHAPE(B, T, H, W, C)), to_channels);
    return dar_add(t, in[0], x);
}

static dar_val *middle(dar_tape *t, const struct pass *p, const dar_vae_half *h, dar_val *x)
{
    struct attention *a = dar_tape_store(t, &(struct attention){ p->v, h }, sizeof *a);
    x = residual_segment(t, p, &h->middle[0], x);
    x = segment(t, p->v, attention, a, x, x->x.shape);
    return residual_segment(t, p, &h->middle[1], x);
}

static dar_val *head(dar_tape *t, const struct pass *p, const dar_vae_half *h, dar_val *x)
{
    return causal(t, p, &h->last, norm_silu(t, h->norm, x));
}

/* ---------------------------------------------------------------- down */

/* The first frame of a clip stands alone; of the others two become one. */
static dar_val *halve_time(dar_tape *t, const struct pass *p, const dar_vae_conv *c, dar_val *x)
{
    int64_t T = frames_of(x);
    dar_val *first = begins(p) ? dar_slice(t, x, 2, 0, 1) : NULL, *y = NULL;
    if (!first || T > 1) {
        dar_val *rest = first ? dar_slice(t, x, 2, 1, T - 1) : x;
        dar_conv_attr a = { .stride = 1, .stride_t = 2, .front = 1 };
        y = dar_conv3d(t, rest, weight(t, p, c), dar_param_leaf(t, c->b), first ? first : history(t, p, c), a);
    }
    if (p->s) keep_last(p, &p->s->cache[c->slot], &x->x, 1);
    return !first ? y : !y ? x : dar_concat(t, (dar_val *[]){ first, y }, 2, 2);
}

static dar_val *down_level(dar_tape *t, const struct pass *p, const dar_vae_level *l, dar_val *in)
{
    static const dar_conv_attr halved = { .stride = 2, .bottom = 1, .right = 1 };
    dar_val *x = in;
    for (int i = 0; i < l->blocks; i++) x = residual_segment(t, p, &l->block[i], x);
    if (l->halve) x = dar_conv2d(t, x, weight(t, p, &l->space), dar_param_leaf(t, l->space.b), halved);
    if (l->halve_time) x = halve_time(t, p, &l->time, x);
    if (l->halve || l->in != l->out) in = dar_avg_down(t, in, l->out, 1 + l->halve_time, 1 + l->halve);
    return dar_add(t, x, in);
}

static dar_val *to_channels(dar_tape *t, const dar_vae *v, dar_val *x)
{
    return dar_cast(t, dar_pixel_unshuffle(t, x, (int)v->c.patch, DAR_PIXELS_COLUMNS), v->storage);
}

/* Part i of the encoder: a level, the first with what comes before it; after them what leads to the moments. */
static dar_val *encoder_part(dar_tape *t, const struct pass *p, int i, dar_val *x)
{
    const dar_vae *v = p->v;
    if (i == 0) x = causal(t, p, &v->encoder.first, to_channels(t, v, x));
    if (i < v->c.levels) return down_level(t, p, &v->encoder.level[i], x);
    x = head(t, p, &v->encoder, middle(t, p, &v->encoder, x));
    return dar_cast(t, causal(t, p, &v->moments, x), v->main);
}

/* Blocks of pixels beside the encoder: frame 0 four times, then the rest, as for the rays of the condition. */
static dar_val *linear_encode(dar_tape *t, const struct pass *p, dar_val *x, dar_val *moments)
{
    const dar_vae *v = p->v;
    const int s = (int)dar_vae_shrink_time(&v->c);
    dar_val *part[DAR_OP_IN];
    if (!v->linear[DAR_VAE_ENCODER].w) return moments;
    if (begins(p) && s > 1) {
        for (int i = 0; i < s - 1; i++) part[i] = dar_slice(t, x, 2, 0, 1);
        part[s - 1] = x;
        x = dar_concat(t, part, s, 2);
    }
    x = dar_cast(t, dar_pixel_unshuffle(t, x, (int)dar_vae_shrink(&v->c), DAR_PIXELS_ROWS), v->storage);
    x = causal(t, p, &v->linear[DAR_VAE_ENCODER], dar_frame_unshuffle(t, x, s));
    return dar_add(t, moments, dar_cast(t, x, v->main));
}

dar_val *dar_vae_encode(dar_tape *t, const dar_vae *v, dar_val *x)
{
    dar_val *y = x;
    struct pass p = { .v = v };
    const int64_t *d = x->x.shape.d, r = dar_vae_shrink(&v->c), s = dar_vae_shrink_time(&v->c);
    DAR_ASSERT(x->x.shape.n == 5 && d[1] == 3 && (d[2] - 1) % s == 0 && d[3] % r == 0 && d[4] % r == 0,
               "vae: a clip of %lld frames, %lld x %lld, expected 1 + k %lld frames and sides that %lld divides",
               (long long)d[2], (long long)d[4], (long long)d[3], (long long)s, (long long)r);
    for (int i = 0; i <= v->c.levels; i++) y = encoder_part(t, &p, i, y);
    return linear_encode(t, &p, x, y);
}

/* ---------------------------------------------------------------- up */

/* The first frame of a clip stands alone, and the convolution does not see it; the others become two. */
static dar_val *double_time(dar_tape *t, const struct pass *p, const dar_vae_conv *c, dar_val *x)
{
    int64_t T = frames_of(x);
    if (!begins(p)) return dar_frame_shuffle(t, causal(t, p, c, x), 2);
    if (T == 1) return x;
    dar_val *rest = dar_frame_shuffle(t, causal(t, p, c, dar_slice(t, x, 2, 1, T - 1)), 2);
    return dar_concat(t, (dar_val *[]){ dar_slice(t, x, 2, 0, 1), rest }, 2, 2);
}

static dar_val *double_space(dar_tape *t, const struct pass *p, const dar_vae_level *l, dar_val *x)
{
    dar_val *b = dar_param_leaf(t, l->space.b);
    if (l->folded.w[0].data && !t->recording) return dar_double_forward(t, &l->folded, b, x);
    dar_val *w = weight(t, p, &l->space);
    return dar_conv2d(t, dar_upsample_nearest(t, x, 2), w, b, dar_conv_same(w));
}

static dar_val *up_level(dar_tape *t, const struct pass *p, const dar_vae_level *l, dar_val *in)
{
    dar_val *x = in;
    for (int i = 0; i < l->blocks; i++) x = residual_segment(t, p, &l->block[i], x);
    if (!l->halve) return x;
    if (l->halve_time) x = double_time(t, p, &l->time, x);
    x = double_space(t, p, l, x);
    int ft = 1 + l->halve_time;
    return dar_add(t, x, dar_dup_up(t, in, l->out, ft, 2, begins(p) ? ft - 1 : 0));
}

struct level {
    struct pass p;
    const dar_vae_level *l;
};

static dar_val *up_level_of(dar_tape *t, void *arg, dar_val *const *in)
{
    const struct level *a = arg;
    return up_level(t, &a->p, a->l, in[0]);
}

/* A level of which only the result stays: what it makes on the way is larger. */
static dar_val *up_level_alone(dar_tape *t, const struct pass *p, const dar_vae_level *l, dar_val *x)
{
    dar_shape s = x->x.shape;
    s.d[1] = l->out;
    if (l->halve_time) s.d[2] = 2 * s.d[2] - begins(p);
    if (l->halve) s.d[3] *= 2, s.d[4] *= 2;
    return dar_segment(t, up_level_of, &(struct level){ *p, l }, &x, 1, x->x.dtype, s);
}

static dar_val *restore(dar_tape *t, const dar_vae *v, dar_val *z)
{
    return dar_add(t, dar_mul(t, z, dar_leaf(t, v->std, NULL)), dar_leaf(t, v->mean, NULL));
}

static dar_val *decoder_begin(dar_tape *t, const struct pass *p, dar_val *z)
{
    const dar_vae *v = p->v;
    dar_val *x = causal(t, p, &v->post, dar_cast(t, z, v->storage));
    return middle(t, p, &v->decoder, causal(t, p, &v->decoder.first, x));
}

static dar_val *decoder_end(dar_tape *t, const struct pass *p, dar_val *x)
{
    const dar_vae *v = p->v;
    x = dar_cast(t, head(t, p, &v->decoder, x), v->main);
    return dar_pixel_shuffle(t, x, (int)v->c.patch, DAR_PIXELS_COLUMNS);
}

/* Pixels of latents z beside the decoder; NULL: none. */
static dar_val *linear_decode(dar_tape *t, const struct pass *p, dar_val *z)
{
    const dar_vae *v = p->v;
    const int s = (int)dar_vae_shrink_time(&v->c);
    if (!v->linear[DAR_VAE_DECODER].w) return NULL;
    dar_val *x = causal(t, p, &v->linear[DAR_VAE_DECODER], dar_cast(t, z, v->storage));
    x = dar_frame_shuffle(t, x, s);
    if (begins(p)) x = dar_slice(t, x, 2, s - 1, frames_of(x) - (s - 1));
    return dar_pixel_shuffle(t, dar_cast(t, x, v->main), (int)dar_vae_shrink(&v->c), DAR_PIXELS_ROWS);
}

dar_val *dar_vae_decode(dar_tape *t, const dar_vae *v, dar_val *z)
{
    struct pass p = { .v = v };
    z = restore(t, v, z);
    dar_val *x = decoder_begin(t, &p, z), *linear = linear_decode(t, &p, z);
    for (int i = 0; i < v->c.levels; i++) x = up_level(t, &p, &v->decoder.level[i], x);
    x = decoder_end(t, &p, x);
    return linear ? dar_add(t, x, linear) : x;
}

/* ---------------------------------------------------------------- moments */

dar_val *dar_vae_mean(dar_tape *t, const dar_vae *v, dar_val *moments)
{
    return dar_slice(t, moments, 1, 0, v->c.latent);
}

dar_val *dar_vae_log_variance(dar_tape *t, const dar_vae *v, dar_val *moments)
{
    return dar_slice(t, moments, 1, v->c.latent, v->c.latent);
}

dar_val *dar_vae_normalise(dar_tape *t, const dar_vae *v, dar_val *mean)
{
    return dar_mul(t, dar_sub(t, mean, dar_leaf(t, v->mean, NULL)), dar_leaf(t, v->rate, NULL));
}

/* ---------------------------------------------------------------- streams */

void dar_vae_stream_init(dar_vae_stream *s, const dar_vae *v, dar_vae_side side, dar_arena *a)
{
    *s = (dar_vae_stream){ .v = v, .side = side, .arena = a, .skip = true };
}

/* Keep a copy; true: it was the same already. */
static bool keep_copy(dar_arena *a, dar_tensor *kept, const dar_tensor *x)
{
    bool fits = kept->data && dar_shape_equal(&kept->shape, &x->shape);
    if (!fits) *kept = dar_tensor_push(a, x->dtype, x->shape);
    if (a->plan) return false;
    if (fits && dar_tensor_contiguous(x) && !memcmp(kept->data, x->data, dar_tensor_bytes(x))) return true;
    dar_tensor_copy(kept, x);
    return false;
}

dar_val *dar_vae_encode_next(dar_vae_stream *s, dar_tape *t, dar_val *x)
{
    DAR_ASSERT(s->side == DAR_VAE_ENCODER && !t->recording, "vae: a stream of the decoder, or a tape that records");
    DAR_ASSERT(frames_of(x) == (s->pieces ? dar_vae_shrink_time(&s->v->c) : 1), "vae: a piece of %lld frames",
               (long long)frames_of(x));
    dar_val *pixels = x;
    bool keep = s->skip && s->pieces > 0; /* the first piece has another shape */
    bool same = keep && keep_copy(s->arena, &s->pixels, &x->x);
    for (int i = 0; i <= s->v->c.levels; i++) {
        if (same && s->steady[i]) {
            x = dar_leaf(t, s->part[i], NULL);
            s->skipped++;
            continue;
        }
        same = false;
        s->steady[i] = true;
        struct pass p = { s->v, s, &s->steady[i] };
        x = encoder_part(t, &p, i, x);
        if (keep) keep_copy(s->arena, &s->part[i], &x->x);
        else s->steady[i] = false;
    }
    x = linear_encode(t, &(struct pass){ .v = s->v, .s = s }, pixels, x);
    s->pieces++;
    return x;
}

void dar_vae_clamp(const dar_tensor *x)
{
    size_t n = dar_tensor_count(x);
    float *f = x->data;
    double *d = x->data;
    if (x->dtype == DAR_F64)
        for (size_t i = 0; i < n; i++) d[i] = fmin(1, fmax(-1, d[i]));
    else
        for (size_t i = 0; i < n; i++) f[i] = fminf(1, fmaxf(-1, f[i]));
}

dar_status dar_vae_decode_next(dar_vae_stream *s, dar_tape *t, dar_val *z, dar_vae_sink *sink, void *ctx, dar_err *e)
{
    const dar_vae *v = s->v;
    struct pass p = { .v = v, .s = s };
    int last = 0; /* levels before it make frames; from there on one goes at a time */
    DAR_ASSERT(s->side == DAR_VAE_DECODER && !t->recording && frames_of(z) == 1,
               "vae: a stream of the encoder, a tape that records, or %lld latent frames", (long long)frames_of(z));
    for (int i = 0; i < v->c.levels; i++)
        if (v->decoder.level[i].halve_time) last = i + 1;

    dar_tape_place begin = dar_tape_mark(t);
    z = restore(t, v, z);
    dar_val *x = decoder_begin(t, &p, z), *linear = linear_decode(t, &p, z);
    for (int i = 0; i < last; i++) x = up_level_alone(t, &p, &v->decoder.level[i], x);
    int64_t frames = frames_of(x), first = s->pieces ? 1 + (s->pieces - 1) * dar_vae_shrink_time(&v->c) : 0;
    dar_status status = DAR_OK;
    for (int64_t f = 0; f < frames && status == DAR_OK; f++) {
        dar_tape_place m = dar_tape_mark(t);
        dar_val *y = dar_contiguous(t, dar_slice(t, x, 2, f, 1));
        for (int i = last; i < v->c.levels; i++) y = up_level_alone(t, &p, &v->decoder.level[i], y);
        y = decoder_end(t, &p, y);
        if (linear) y = dar_add(t, y, dar_slice(t, linear, 2, f, 1));
        if (!t->arena->plan) dar_vae_clamp(&y->x);
        if (sink) status = sink(ctx, &y->x, first + f, e);
        dar_tape_reset(t, m);
    }
    dar_tape_reset(t, begin);
    s->pieces++;
    return status;
}
