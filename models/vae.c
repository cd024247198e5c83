/* vae.c: parameters of the autoencoder, and its weights folded for the small grid. */
#include "models/vae.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

/* ---------------------------------------------------------------- declarations */

typedef struct maker {
    dar_params *p;
    dar_vae_half *half;
    char prefix[DAR_PARAM_NAME];
} maker;

static void set_prefix(maker *m, const char *fmt, ...) __attribute__((format(printf, 2, 3)));

static void set_prefix(maker *m, const char *fmt, ...)
{
    va_list args;
    va_start(args, fmt);
    vsnprintf(m->prefix, sizeof m->prefix, fmt, args);
    va_end(args);
}

/* Weight [out, in, kernel ..] and bias, as nn.Conv2d and nn.Conv3d begin. */
static dar_vae_conv conv(maker *m, const char *name, int64_t out, int64_t in, int dims, const int64_t *kernel)
{
    dar_shape s = { .n = 2 + dims, .d = { out, in } };
    double fan = (double)in;
    for (int i = 0; i < dims; i++) {
        s.d[2 + i] = kernel[i];
        fan *= (double)kernel[i];
    }
    dar_param_info w = { DAR_PARAM_BASE, true, DAR_FRESH_UNIFORM, 1 / sqrt(fan) }, b = w;
    b.matrix = false;
    bool back = m->half && dims == 3 && kernel[0] > 1;
    return (dar_vae_conv){ .w = dar_params_add(m->p, w, s, "%s%s.weight", m->prefix, name),
                           .b = dar_params_add(m->p, b, DAR_SHAPE(out), "%s%s.bias", m->prefix, name),
                           .slot = back ? m->half->slots++ : -1 };
}

static dar_vae_conv cube(maker *m, const char *name, int64_t out, int64_t in)
{
    return conv(m, name, out, in, 3, (int64_t[]){ 3, 3, 3 });
}

static dar_vae_conv point(maker *m, const char *name, int64_t out, int64_t in)
{
    return conv(m, name, out, in, 3, (int64_t[]){ 1, 1, 1 });
}

static dar_param *scale(maker *m, const char *name, int64_t n, int dims)
{
    dar_param_info one = { DAR_PARAM_BASE, false, DAR_FRESH_VALUE, 1 };
    dar_shape s = { .n = 1 + dims, .d = { n, 1, 1, 1 } };
    return dar_params_add(m->p, one, s, "%s%s.gamma", m->prefix, name);
}

static dar_vae_res residual(maker *m, int64_t out, int64_t in)
{
    dar_vae_res r = { .shortcut = { .slot = -1 } };
    r.norm[0] = scale(m, "residual.0", in, 3);
    r.conv[0] = cube(m, "residual.2", out, in);
    r.norm[1] = scale(m, "residual.3", out, 3);
    r.conv[1] = cube(m, "residual.6", out, out);
    if (in != out) r.shortcut = point(m, "shortcut", out, in);
    return r;
}

static void level(maker *m, dar_vae_side side, int i)
{
    dar_vae_level *l = &m->half->level[i];
    const char *names =
        side == DAR_VAE_ENCODER ? "encoder.downsamples.%d.downsamples.%d." : "decoder.upsamples.%d.upsamples.%d.";
    for (int j = 0; j < l->blocks; j++) {
        snprintf(m->prefix, sizeof m->prefix, names, i, j);
        l->block[j] = residual(m, l->out, j ? l->out : l->in);
    }
    l->space.slot = l->time.slot = -1;
    if (!l->halve) return;
    snprintf(m->prefix, sizeof m->prefix, names, i, l->blocks);
    l->space = conv(m, "resample.1", l->out, l->out, 2, (int64_t[]){ 3, 3 });
    if (l->halve_time) {
        int64_t out = side == DAR_VAE_ENCODER ? l->out : 2 * l->out;
        l->time = conv(m, "time_conv", out, l->out, 3, (int64_t[]){ 3, 1, 1 });
    }
}

static void middle(maker *m, const char *side, int64_t width)
{
    dar_vae_half *h = m->half;
    for (int i = 0; i < 2; i++) {
        set_prefix(m, "%s.middle.%d.", side, 2 * i);
        h->middle[i] = residual(m, width, width);
    }
    set_prefix(m, "%s.middle.1.", side);
    h->attn_norm = scale(m, "norm", width, 2);
    h->qkv = conv(m, "to_qkv", 3 * width, width, 2, (int64_t[]){ 1, 1 });
    h->proj = conv(m, "proj", width, width, 2, (int64_t[]){ 1, 1 });
}

static void encoder(dar_vae *v, dar_params *p)
{
    const dar_vae_config *c = &v->c;
    maker m = { .p = p, .half = &v->encoder };
    int64_t width = c->encoder_width, pixels = 3 * c->patch * c->patch;

    set_prefix(&m, "encoder.");
    v->encoder.first = cube(&m, "conv1", width, pixels);
    for (int i = 0; i < c->levels; i++) {
        int64_t out = c->encoder_width * c->multipliers[i];
        v->encoder.level[i] = (dar_vae_level){ .blocks = (int)c->encoder_blocks,
                                               .in = width,
                                               .out = out,
                                               .halve = i < c->levels - 1,
                                               .halve_time = i < c->levels - 1 && c->halve_time[i] };
        level(&m, DAR_VAE_ENCODER, i);
        width = out;
    }
    middle(&m, "encoder", width);
    set_prefix(&m, "encoder.");
    v->encoder.norm = scale(&m, "head.0", width, 3);
    v->encoder.last = cube(&m, "head.2", 2 * c->latent, width);
}

static void decoder(dar_vae *v, dar_params *p)
{
    const dar_vae_config *c = &v->c;
    maker m = { .p = p, .half = &v->decoder };
    int64_t width = c->decoder_width * c->multipliers[c->levels - 1], pixels = 3 * c->patch * c->patch;

    set_prefix(&m, "decoder.");
    v->decoder.first = cube(&m, "conv1", width, c->latent);
    middle(&m, "decoder", width);
    for (int i = 0; i < c->levels; i++) {
        int down = c->levels - 1 - i; /* the level of the encoder that it undoes */
        int64_t out = c->decoder_width * c->multipliers[down];
        v->decoder.level[i] = (dar_vae_level){ .blocks = (int)c->decoder_blocks,
                                               .in = width,
                                               .out = out,
                                               .halve = down > 0,
                                               .halve_time = down > 0 && c->halve_time[down - 1] };
        level(&m, DAR_VAE_DECODER, i);
        width = out;
    }
    set_prefix(&m, "decoder.");
    v->decoder.norm = scale(&m, "head.0", width, 3);
    v->decoder.last = cube(&m, "head.2", pixels, width);
}

static dar_tensor per_channel(dar_params *p, int64_t n, const double *x)
{
    dar_tensor y = dar_tensor_push(p->arena, p->main, DAR_SHAPE(n, 1, 1, 1));
    if (!p->arena->plan)
        for (int64_t i = 0; i < n; i++) dar_dtype_set(p->main, y.data, (size_t)i, x[i]);
    return y;
}

void dar_vae_init(dar_vae *v, dar_params *p, const dar_vae_config *c)
{
    DAR_ASSERT(c->levels >= 1, "vae: the configuration has none");
    *v = (dar_vae){ .c = *c, .storage = p->storage, .main = p->main };
    maker m = { .p = p };
    encoder(v, p);
    v->moments = point(&m, "conv1", 2 * c->latent, 2 * c->latent);
    v->post = point(&m, "conv2", c->latent, c->latent);
    decoder(v, p);
    if (c->linear) {
        const int64_t r = dar_vae_shrink(c), block = 3 * r * r * dar_vae_shrink_time(c);
        set_prefix(&m, "linear.");
        v->linear[DAR_VAE_ENCODER] = point(&m, "encode", 2 * c->latent, block);
        v->linear[DAR_VAE_DECODER] = point(&m, "decode", block, c->latent);
    }
    DAR_ASSERT(v->encoder.slots <= DAR_VAE_SLOTS && v->decoder.slots <= DAR_VAE_SLOTS, "vae: %d slots, at most %d",
               v->decoder.slots, DAR_VAE_SLOTS);
    v->mean = per_channel(p, c->latent, c->mean);
    v->std = per_channel(p, c->latent, c->std);
    double rate[DAR_VAE_LATENT];
    for (int64_t i = 0; i < c->latent; i++) rate[i] = 1 / c->std[i];
    v->rate = per_channel(p, c->latent, rate);
}

/* ---------------------------------------------------------------- folded up-sampling */

void dar_vae_fold(dar_vae *v, dar_arena *a)
{
    for (int i = 0; i < v->c.levels; i++) {
        dar_vae_level *l = &v->decoder.level[i];
        if (l->halve) l->folded = dar_double_fold(&l->space.w->x, v->storage, a);
    }
}
