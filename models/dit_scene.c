/* dit_scene.c: what is constant over a clip and over a prompt, and what is known of the video. */
#include "models/dit.h"

#include <math.h>

#include "models/patch.h"

/* ---------------------------------------------------------------- scene */

/* in: known [B, mask + C, F, h, w] -> [B, L, D]: its share of the patch embedding */
static dar_val *embed_known(dar_tape *t, void *arg, dar_val *const *in)
{
    const dar_dit *m = arg;
    int64_t square = m->c.patch * m->c.patch, z = m->c.latent * square, all = dar_dit_channels(&m->c) * square;
    dar_val *w = dar_reshape(t, dar_param_leaf(t, m->patch_w), DAR_SHAPE(m->c.width, all));
    w = dar_slice(t, w, 1, z, all - z);
    return dar_linear(t, dar_patchify(t, in[0], m->c.patch), w, NULL, NULL);
}

static void check_clip(const dar_dit *m, const dar_dit_clip *c)
{
    const dar_adapter_config *a = &m->adapter.c;
    const int64_t *d = c->cond.shape.d, *k = c->known.shape.d;
    int64_t side = 2 * a->unshuffle, p = m->c.patch;

    DAR_ASSERT(c->height % p == 0 && c->width % p == 0, "dit: latents of %lld x %lld, patches of %lld",
               (long long)c->height, (long long)c->width, (long long)p);
    DAR_ASSERT(!c->cond.data || (m->adapter.w && d[0] == c->clips && d[2] == c->frames &&
                                 d[3] * p == c->height * side && d[4] * p == c->width * side),
               "dit: the condition does not fit a latent of %lld x %lld x %lld", (long long)c->frames,
               (long long)c->height, (long long)c->width);
    DAR_ASSERT(!c->known.data ||
                   (m->c.mask && c->known.dtype == m->main && k[0] == c->clips && k[1] == m->c.mask + m->c.latent &&
                    k[2] == c->frames && k[3] == c->height && k[4] == c->width),
               "dit: the known video does not fit the latent");
}

void dar_dit_scene_prepare(dar_tape *t, const dar_dit *m, const dar_dit_clip *c, dar_dit_scene *s)
{
    int64_t p = m->c.patch, h = c->height / p, w = c->width / p;

    check_clip(m, c);
    *s = (dar_dit_scene){ .latent = DAR_SHAPE(c->clips, m->c.latent, c->frames, c->height, c->width), .frame = h * w };
    if (c->cond.data) s->base = dar_adapter_forward(t, &m->adapter, &c->cond);
    if (c->known.data) {
        dar_val *known = dar_leaf(t, c->known, NULL);
        dar_shape tokens = DAR_SHAPE(c->clips, c->frames * s->frame, m->c.width);
        dar_val *x = dar_segment(t, embed_known, (void *)m, &known, 1, m->main, tokens);
        s->base = s->base ? dar_add(t, s->base, x) : x;
    }
    s->rope = dar_input(t, m->main, DAR_SHAPE(c->frames * s->frame, m->c.width / m->c.heads));
    if (!t->arena->plan) dar_rope_table(&s->rope->x, c->frames, h, w, m->c.rope_base);
}

/* ---------------------------------------------------------------- text */

static int64_t real_tokens(const dar_tensor *text, const int64_t *count, int64_t clip)
{
    int64_t n = text->shape.d[1], real = count ? count[clip] : n;
    DAR_ASSERT(real >= 0 && real <= n, "dit: %lld of %lld text tokens are real", (long long)real, (long long)n);
    return real;
}

/* The rows of the text with one of zeros after them. */
static void pad_text(const dar_tensor *rows, const dar_tensor *text)
{
    int64_t n = text->shape.d[1];
    dar_tensor real = dar_tensor_narrow(rows, 1, 0, n);
    dar_tensor_fill(rows, 0);
    if (n) dar_tensor_copy(&real, text);
}

/* Keys after the real ones and before text_keys are equal: one stands for them all. */
static void weigh_keys(const dar_tensor *w, const dar_tensor *text, const int64_t *count, int64_t keys)
{
    int64_t B = text->shape.d[0], n = text->shape.d[1];
    for (int64_t b = 0; b < B; b++) {
        int64_t real = real_tokens(text, count, b);
        for (int64_t i = 0; i <= n; i++) {
            double l = i < real ? 0 : i < n || real == keys ? -INFINITY : log((double)(keys - real));
            dar_dtype_set(w->dtype, w->data, (size_t)(b * (n + 1) + i), l);
        }
    }
}

void dar_dit_text_prepare(dar_tape *t, const dar_dit *m, const dar_tensor *text, const int64_t *count, dar_dit_text *x)
{
    int64_t B = text->shape.d[0], n = text->shape.d[1];
    size_t pointers = (size_t)m->c.layers * sizeof(dar_val *);
    dar_norm_opt rms = { .eps = m->c.eps };
    dar_linear_opt gelu = { .act = DAR_ACT_GELU_TANH };

    DAR_ASSERT(text->shape.n == 3 && text->shape.d[2] == m->c.text_width && n <= m->c.text_keys,
               "dit: text of %lld tokens, at most %lld", (long long)n, (long long)m->c.text_keys);
    dar_val *rows = dar_input(t, m->storage, DAR_SHAPE(B, n + 1, m->c.text_width));
    x->log_weight = dar_input(t, m->main, DAR_SHAPE(B, n + 1));
    if (!t->arena->plan) {
        pad_text(&rows->x, text);
        weigh_keys(&x->log_weight->x, text, count, m->c.text_keys);
    }
    dar_val *w0 = dar_param_operand(t, m->text_w[0], m->storage), *w1 = dar_param_operand(t, m->text_w[1], m->storage);
    dar_val *h = dar_linear(t, rows, w0, dar_param_leaf(t, m->text_b[0]), &gelu);
    h = dar_linear(t, h, w1, dar_param_leaf(t, m->text_b[1]), NULL);

    x->k = dar_tape_room(t, pointers);
    x->v = dar_tape_room(t, pointers);
    for (int i = 0; i < m->c.layers; i++) {
        const dar_dit_block *b = &m->block[i];
        dar_val *k = dar_dit_multiply(t, m, &b->product[DAR_CROSS_K], DAR_ACT_NONE, DAR_KEEP_NOTHING, h);
        x->k[i] = dar_rms_norm(t, k, dar_param_leaf(t, b->norm_k[1]), &rms);
        x->v[i] = dar_dit_multiply(t, m, &b->product[DAR_CROSS_V], DAR_ACT_NONE, DAR_KEEP_NOTHING, h);
    }
}

/* ---------------------------------------------------------------- what is known of the video */

void dar_dit_known(const dar_tensor *y, const dar_tensor *latent, const bool *seen)
{
    int64_t mask = y->shape.d[1] - latent->shape.d[1], F = latent->shape.d[2];
    for (int64_t k = 0; k < mask; k++)
        for (int64_t f = 0; f < F; f++) {
            int64_t frame = f * mask + k - mask + 1;
            dar_tensor channel = dar_tensor_narrow(y, 1, k, 1);
            channel = dar_tensor_narrow(&channel, 2, f, 1);
            dar_tensor_fill(&channel, seen[frame > 0 ? frame : 0]);
        }
    dar_tensor video = dar_tensor_narrow(y, 1, mask, latent->shape.d[1]);
    dar_tensor_copy(&video, latent);
}

void dar_dit_hold_first(const dar_tensor *z, const dar_tensor *latent)
{
    dar_tensor to = dar_tensor_narrow(z, 2, 0, 1), from = dar_tensor_narrow(latent, 2, 0, 1);
    dar_tensor_copy(&to, &from);
}
