/* dit.c: parameters, time embedding, patch embedding, head. */
#include "models/dit.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "models/patch.h"

#define SLOWEST 10000     /* the frequencies of the time encoding fall from 1 to 1 / SLOWEST */
#define PIECE   (8 << 20) /* its gradient is then 32 MB, and the weights are read often enough to be read once */

/* ---------------------------------------------------------------- parameters */

static dar_param *matrix(dar_params *p, dar_param_law law, double spread, int64_t out, int64_t in, const char *name)
{
    return dar_params_add(p, (dar_param_info){ DAR_PARAM_BASE, true, law, spread }, DAR_SHAPE(out, in), "%s", name);
}

static dar_param *vector(dar_params *p, double value, int64_t n, const char *name)
{
    return dar_params_add(p, (dar_param_info){ DAR_PARAM_BASE, false, DAR_FRESH_VALUE, value }, DAR_SHAPE(n), "%s",
                          name);
}

static dar_param *table(dar_params *p, int64_t rows, int64_t width, const char *name)
{
    dar_param_info normal = { DAR_PARAM_BASE, false, DAR_FRESH_NORMAL, 1 / sqrt((double)width) };
    return dar_params_add(p, normal, DAR_SHAPE(1, rows, width), "%s", name);
}

/* Bound of Glorot and Bengio 2010, eq. 16. */
static double glorot(int64_t out, int64_t in)
{
    return sqrt(6.0 / (double)(out + in));
}

static void declare_block(dar_dit *m, dar_params *p, int i)
{
    static const char *const attention[] = { "self_attn", "cross_attn" };
    dar_dit_block *b = &m->block[i];
    int64_t D = m->c.width;
    char name[DAR_PARAM_NAME];
#define NAME(...) (snprintf(name, sizeof name, __VA_ARGS__), name)

    b->modulation = table(p, 6, D, NAME("blocks.%d.modulation", i));
    for (int k = 0; k < DAR_PROJECTIONS; k++) {
        int64_t out = k == DAR_FFN_UP ? m->c.ffn : D, in = k == DAR_FFN_DOWN ? m->c.ffn : D;
        dar_dit_product *q = &b->product[k];
        q->w = matrix(p, DAR_FRESH_UNIFORM, glorot(out, in), out, in,
                      NAME("blocks.%d.%s.weight", i, dar_projection_names[k]));
        q->b = vector(p, 0, out, NAME("blocks.%d.%s.bias", i, dar_projection_names[k]));
    }
    for (int k = 0; k < 2; k++) {
        b->norm_q[k] = vector(p, 1, D, NAME("blocks.%d.%s.norm_q.weight", i, attention[k]));
        b->norm_k[k] = vector(p, 1, D, NAME("blocks.%d.%s.norm_k.weight", i, attention[k]));
    }
    b->norm3_w = vector(p, 1, D, NAME("blocks.%d.norm3.weight", i));
    b->norm3_b = vector(p, 0, D, NAME("blocks.%d.norm3.bias", i));
#undef NAME
}

static void declare_ends(dar_dit *m, dar_params *p)
{
    const dar_dit_config *c = &m->c;
    int64_t D = c->width, in = dar_dit_channels(c), out = c->latent * c->patch * c->patch;
    int64_t k = in * c->patch * c->patch;
    dar_param_info patch = { DAR_PARAM_BASE, true, DAR_FRESH_UNIFORM, glorot(D, k) };
    dar_param_info bias = { DAR_PARAM_BASE, false, DAR_FRESH_UNIFORM, 1 / sqrt((double)k) };

    m->patch_w = dar_params_add(p, patch, DAR_SHAPE(D, in, 1, c->patch, c->patch), "patch_embedding.weight");
    m->patch_b = dar_params_add(p, bias, DAR_SHAPE(D), "patch_embedding.bias");
    m->text_w[0] = matrix(p, DAR_FRESH_NORMAL, 0.02, D, c->text_width, "text_embedding.0.weight");
    m->text_b[0] = vector(p, 0, D, "text_embedding.0.bias");
    m->text_w[1] = matrix(p, DAR_FRESH_NORMAL, 0.02, D, D, "text_embedding.2.weight");
    m->text_b[1] = vector(p, 0, D, "text_embedding.2.bias");
    m->time_w[0] = matrix(p, DAR_FRESH_NORMAL, 0.02, D, c->frequencies, "time_embedding.0.weight");
    m->time_b[0] = vector(p, 0, D, "time_embedding.0.bias");
    m->time_w[1] = matrix(p, DAR_FRESH_NORMAL, 0.02, D, D, "time_embedding.2.weight");
    m->time_b[1] = vector(p, 0, D, "time_embedding.2.bias");
    m->time_w[2] = matrix(p, DAR_FRESH_UNIFORM, glorot(6 * D, D), 6 * D, D, "time_projection.1.weight");
    m->time_b[2] = vector(p, 0, 6 * D, "time_projection.1.bias");
    m->head_modulation = table(p, 2, D, "head.modulation");
    m->head_w = matrix(p, DAR_FRESH_VALUE, 0, out, D, "head.head.weight");
    m->head_b = vector(p, 0, out, "head.head.bias");
}

void dar_dit_init(dar_dit *m, dar_params *p, const dar_dit_config *c, const dar_adapter_config *a)
{
    *m = (dar_dit){ .c = *c, .storage = p->storage, .main = p->main, .piece = PIECE };
    m->block = calloc((size_t)c->layers, sizeof *m->block);
    DAR_ASSERT(m->block, "dit: no memory for %lld blocks", (long long)c->layers);
    declare_ends(m, p);
    for (int i = 0; i < c->layers; i++) declare_block(m, p, i);
    dar_adapter_init(&m->adapter, p, a, c->width);
}

void dar_dit_free(dar_dit *m)
{
    free(m->block);
    memset(m, 0, sizeof *m);
}

/* ---------------------------------------------------------------- time */

/* s_i = cos(t w_i), s_{n + i} = sin(t w_i), w_i = SLOWEST^(-i / n): cosines first, angles in f64. */
static void encode_time(const dar_tensor *s, const double *t)
{
    size_t rows = dar_tensor_rows(s), n = dar_tensor_cols(s) / 2;
    for (size_t r = 0; r < rows; r++)
        for (size_t i = 0; i < n; i++) {
            double a = t[r] * pow(SLOWEST, -(double)i / (double)n);
            dar_dtype_set(s->dtype, s->data, r * 2 * n + i, cos(a));
            dar_dtype_set(s->dtype, s->data, r * 2 * n + n + i, sin(a));
        }
}

dar_dit_moment dar_dit_time_embed(dar_tape *t, const dar_dit *m, int64_t clips, const dar_dit_time *time)
{
    dar_dit_moment o;
    dar_val *s = dar_input(t, m->main, DAR_SHAPE(clips, time->rows, m->c.frequencies));
    if (!t->arena->plan) encode_time(&s->x, time->t);

    dar_val *h[3];
    for (int i = 0; i < 3; i++) {
        dar_val *x = i ? dar_silu(t, h[i - 1]) : s;
        h[i] = dar_linear(t, x, dar_param_leaf(t, m->time_w[i]), dar_param_leaf(t, m->time_b[i]), NULL);
    }
    o.e = h[1];
    o.e0 = h[2];
    return o;
}

/* ---------------------------------------------------------------- ends */

/* in: z [B, C, F, h, w], base or NULL -> [B, L, D] */
static dar_val *embed(dar_tape *t, void *arg, dar_val *const *in)
{
    const dar_dit *m = arg;
    int64_t k = m->c.latent * m->c.patch * m->c.patch;
    dar_val *w = dar_reshape(t, dar_param_leaf(t, m->patch_w),
                             DAR_SHAPE(m->c.width, dar_dit_channels(&m->c) * m->c.patch * m->c.patch));
    w = dar_slice(t, w, 1, 0, k);
    dar_val *x = dar_linear(t, dar_patchify(t, in[0], m->c.patch), w, dar_param_leaf(t, m->patch_b), NULL);
    return in[1] ? dar_add(t, x, in[1]) : x;
}

dar_val *dar_dit_embed(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, dar_val *z)
{
    dar_shape tokens = DAR_SHAPE(s->latent.d[0], s->latent.d[2] * s->frame, m->c.width);
    DAR_ASSERT(dar_shape_equal(&z->x.shape, &s->latent) && z->x.dtype == m->main,
               "dit: the latent is not as in the scene");
    return dar_segment(t, embed, (void *)m, (dar_val *[]){ z, s->base }, 2, m->main, tokens);
}

struct head {
    const dar_dit *m;
    int64_t frame;    /* tokens in a frame */
    dar_shape latent; /* of the velocity */
};

/* in: tokens [B, L, D], e [B, R, D] -> [B, C, F, h, w] */
static dar_val *head(dar_tape *t, void *arg, dar_val *const *in)
{
    const struct head *a = arg;
    const dar_dit *m = a->m;
    int64_t B = a->latent.d[0], R = in[1]->x.shape.d[1], D = m->c.width;

    dar_val *e = dar_reshape(t, in[1], DAR_SHAPE(B, R, 1, D)), *part[2];
    e = dar_add(t, e, dar_param_leaf(t, m->head_modulation)); /* [B, R, 2, D] */
    for (int i = 0; i < 2; i++) part[i] = dar_reshape(t, dar_slice(t, e, 2, i, 1), DAR_SHAPE(B, R, D));
    dar_norm_opt norm = { .eps = m->c.eps, .split = a->frame };
    dar_val *x = dar_modulate(t, in[0], part[1], part[0], &norm);
    x = dar_linear(t, x, dar_param_leaf(t, m->head_w), dar_param_leaf(t, m->head_b), NULL);
    return dar_unpatchify(t, x, a->latent, m->c.patch);
}

dar_val *dar_dit_head(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_moment *e, dar_val *tokens)
{
    struct head *a = dar_tape_store(t, &(struct head){ m, s->frame, s->latent }, sizeof *a);
    dar_val *rows = e->e;
    if (s->held) {
        int64_t R = rows->x.shape.d[1];
        if (R > 1) rows = dar_slice(t, rows, 1, 1, R - 1);
        a->latent.d[2]--;
    }
    return dar_segment(t, head, a, (dar_val *[]){ tokens, rows }, 2, m->main, a->latent);
}

dar_val *dar_dit_velocity(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, dar_val *y, dar_val *z,
                          const dar_dit_time *time)
{
    int64_t B = s->latent.d[0], F = y->x.shape.d[2], first = s->latent.d[2] - F;
    if (!m->c.precondition) return y;
    dar_val *guess = dar_input(t, m->main, DAR_SHAPE(B, 1, F, 1, 1)), *gain = dar_input(t, m->main, guess->x.shape);
    for (int64_t i = 0; i < B * F && !t->arena->plan; i++) {
        int64_t f = first + i % F, row = f < time->rows ? f : time->rows - 1;
        double sigma = time->t[i / F * time->rows + row] / 1000, n = sigma * sigma + (1 - sigma) * (1 - sigma);
        dar_dtype_set(m->main, guess->x.data, (size_t)i, (2 * sigma - 1) / n);
        dar_dtype_set(m->main, gain->x.data, (size_t)i, 1 / sqrt(n));
    }
    return dar_add(t, dar_mul(t, y, gain), dar_mul(t, dar_slice(t, z, 2, first, F), guess));
}

dar_val *dar_dit_forward(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_text *x, dar_val *z,
                         const dar_dit_time *time)
{
    dar_dit_moment e = dar_dit_time_embed(t, m, s->latent.d[0], time);
    dar_val *tokens = dar_dit_embed(t, m, s, z);
    return dar_dit_velocity(t, m, s, dar_dit_head(t, m, s, &e, dar_dit_blocks(t, m, s, x, &e, tokens)), z, time);
}
