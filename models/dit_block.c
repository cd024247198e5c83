/* dit_block.c: one block of the transformer, and the stack of them. */
#include "models/dit.h"

enum { SHIFT_SELF, SCALE_SELF, GATE_SELF, SHIFT_FFN, SCALE_FFN, GATE_FFN, MODULATIONS };

dar_val *dar_dit_multiply(dar_tape *t, const dar_dit *m, const dar_dit_product *p, dar_act act, dar_val *x)
{
    dar_linear_opt o = { .act = act };
    dar_val *w = dar_param_operand(t, p->w, m->storage), *b = dar_param_leaf(t, p->b);
    if (!p->down || p->merged) return dar_linear(t, x, w, b, &o);
    return dar_lora(t, x, w, b, dar_param_leaf(t, p->down), dar_param_leaf(t, p->up), p->scale, &o);
}

/* modulation + e0, taken apart: [B, R, D] each */
static void modulations(dar_tape *t, const dar_dit *m, const dar_dit_block *b, dar_val *e0, dar_val **out)
{
    int64_t B = e0->x.shape.d[0], R = e0->x.shape.d[1], D = m->c.width;
    dar_val *e = dar_reshape(t, e0, DAR_SHAPE(B, R, MODULATIONS, D));
    e = dar_add(t, e, dar_param_leaf(t, b->modulation));
    for (int i = 0; i < MODULATIONS; i++) out[i] = dar_reshape(t, dar_slice(t, e, 2, i, 1), DAR_SHAPE(B, R, D));
}

struct block {
    const dar_dit *m;
    const dar_dit_block *b;
    const dar_dit_scene *s;
    dar_val *log_weight;
};

/* in: x [B, L, D], e0 [B, R, 6 D], keys and values of the text [B, n + 1, D] -> [B, L, D] */
static dar_val *block(dar_tape *t, void *arg, dar_val *const *in)
{
    const struct block *a = arg;
    const dar_dit *m = a->m;
    const dar_dit_block *b = a->b;
    const dar_dit_product *p = b->product;
    int64_t frame = a->s->frame;
    dar_norm_opt norm = { .eps = m->c.eps, .cast = true, .out = m->storage, .split = frame }, rms = { .eps = m->c.eps };
    dar_attention_opt self = { .heads = m->c.heads, .keep = m->keep }, cross = self;
    dar_val *x = in[0], *mod[MODULATIONS];

    modulations(t, m, b, in[1], mod);
    dar_val *h = dar_modulate(t, x, mod[SCALE_SELF], mod[SHIFT_SELF], &norm);
    dar_val *q = dar_dit_multiply(t, m, &p[DAR_SELF_Q], DAR_ACT_NONE, h);
    dar_val *k = dar_dit_multiply(t, m, &p[DAR_SELF_K], DAR_ACT_NONE, h);
    dar_val *v = dar_dit_multiply(t, m, &p[DAR_SELF_V], DAR_ACT_NONE, h);
    q = dar_rope(t, dar_rms_norm(t, q, dar_param_leaf(t, b->norm_q[0]), &rms), a->s->rope);
    k = dar_rope(t, dar_rms_norm(t, k, dar_param_leaf(t, b->norm_k[0]), &rms), a->s->rope);
    h = dar_attention(t, q, k, v, &self);
    x = dar_gate(t, x, dar_dit_multiply(t, m, &p[DAR_SELF_O], DAR_ACT_NONE, h), mod[GATE_SELF], frame);

    cross.log_weight = a->log_weight;
    h = dar_layer_norm(t, x, dar_param_leaf(t, b->norm3_w), dar_param_leaf(t, b->norm3_b), &norm);
    q = dar_dit_multiply(t, m, &p[DAR_CROSS_Q], DAR_ACT_NONE, h);
    q = dar_rms_norm(t, q, dar_param_leaf(t, b->norm_q[1]), &rms);
    h = dar_attention(t, q, in[2], in[3], &cross);
    x = dar_add(t, x, dar_dit_multiply(t, m, &p[DAR_CROSS_O], DAR_ACT_NONE, h));

    h = dar_modulate(t, x, mod[SCALE_FFN], mod[SHIFT_FFN], &norm);
    h = dar_dit_multiply(t, m, &p[DAR_FFN_UP], DAR_ACT_GELU_TANH, h);
    h = dar_dit_multiply(t, m, &p[DAR_FFN_DOWN], DAR_ACT_NONE, h);
    return dar_gate(t, x, h, mod[GATE_FFN], frame);
}

dar_val *dar_dit_block_forward(dar_tape *t, const dar_dit *m, int i, const dar_dit_scene *s, const dar_dit_text *x,
                               dar_val *e0, dar_val *tokens)
{
    struct block a = { m, &m->block[i], s, x->log_weight };
    return block(t, &a, (dar_val *[]){ tokens, e0, x->k[i], x->v[i] });
}

static dar_val *segment(dar_tape *t, const dar_dit *m, int i, const dar_dit_scene *s, const dar_dit_text *x,
                        dar_val *e0, dar_val *tokens)
{
    struct block *a = dar_tape_store(t, &(struct block){ m, &m->block[i], s, x->log_weight }, sizeof *a);
    dar_val *in[] = { tokens, e0, x->k[i], x->v[i] };
    return dar_segment(t, block, a, in, DAR_COUNT(in), tokens->x.dtype, tokens->x.shape);
}

dar_val *dar_dit_blocks(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_text *x,
                        const dar_dit_moment *e, dar_val *tokens)
{
    for (int i = 0; i < m->c.layers; i++) {
        if (t->recording) {
            tokens = (m->whole ? dar_dit_block_forward : segment)(t, m, i, s, x, e->e0, tokens);
            continue;
        }
        dar_mark mark = dar_arena_mark(t->arena); /* nothing looks back: one stream, written over */
        dar_val *y = dar_dit_block_forward(t, m, i, s, x, e->e0, tokens);
        if (!t->arena->plan) dar_tensor_copy(&tokens->x, &y->x);
        dar_arena_reset(t->arena, mark);
    }
    return tokens;
}
