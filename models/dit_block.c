/* dit_block.c: one block of the transformer, and the stack of them. */
#include "models/dit.h"

enum { SHIFT, SCALE, GATE };

const char *const dar_dit_replay_name[] = { "all", "products", "wide", "cheap", "nothing", NULL };

dar_val *dar_dit_multiply(dar_tape *t, const dar_dit *m, const dar_dit_product *p, dar_act act, dar_keep keep,
                          dar_val *x)
{
    dar_linear_opt o = { .act = act, .quantise = m->quantise, .keep = keep };
    dar_val *w = dar_param_operand(t, p->w, m->storage), *b = dar_param_leaf(t, p->b);
    if (!p->down || p->merged) return dar_linear(t, x, w, b, &o);
    return dar_lora(t, x, w, b, dar_param_leaf(t, p->down), dar_param_leaf(t, p->up), p->scale, &o);
}

struct block {
    const dar_dit *m;
    const dar_dit_block *b;
    const dar_dit_scene *s;
    dar_val *log_weight; /* a leaf */
    dar_val *e0, *k, *v; /* inputs of a segment: in a replay, what stands for them */
    bool rest;           /* of the first frame nothing is wanted but that the others see it */
    bool cheap;          /* a segment that keeps its products */
    int64_t first;       /* place of the first token, where they are a piece of a clip */
};

/* Rows [B, R, ..] of modulations, as the frames after the first take them. */
static dar_val *later(dar_tape *t, dar_val *e)
{
    int64_t R = e->x.shape.d[1];
    return R > 1 ? dar_slice(t, e, 1, 1, R - 1) : e;
}

/* Rows of dimension dim that are tokens, without those of the first frame. */
static dar_val *others(dar_tape *t, const struct block *a, int dim, dar_val *x)
{
    return dar_slice(t, x, dim, a->s->frame, x->x.shape.d[dim] - a->s->frame);
}

/* Three rows of modulation + e0, from `first`: [B, R, D] each */
static void modulations(dar_tape *t, const struct block *a, int first, dar_val *out[3])
{
    int64_t B = a->e0->x.shape.d[0], R = a->e0->x.shape.d[1], D = a->m->c.width;
    dar_val *e = dar_slice(t, dar_reshape(t, a->e0, DAR_SHAPE(B, R, 6, D)), 2, first, 3);
    e = dar_add(t, e, dar_slice(t, dar_param_leaf(t, a->b->modulation), 1, first, 3));
    for (int i = 0; i < 3; i++) out[i] = dar_reshape(t, dar_slice(t, e, 2, i, 1), DAR_SHAPE(B, R, D));
}

static dar_val *product(dar_tape *t, const struct block *a, dar_projection which, dar_val *x)
{
    dar_keep keep = a->cheap ? DAR_KEEP_ALL : DAR_KEEP_NOTHING;
    return dar_dit_multiply(t, a->m, &a->b->product[which], DAR_ACT_NONE, keep, x);
}

/* The last product of a part, whose result only the residual reads: backward needs it for the gradient of its gate. */
static dar_val *last_product(dar_tape *t, const struct block *a, dar_projection which, dar_val *x, bool gated)
{
    bool trained = gated && (a->e0->wants_grad || a->b->modulation->g.data);
    dar_keep keep = !a->cheap ? DAR_KEEP_NOTHING : trained ? DAR_KEEP_ALL : DAR_KEEP_AUX;
    dar_val *y = dar_dit_multiply(t, a->m, &a->b->product[which], DAR_ACT_NONE, keep, x);
    dar_drop(t, x);
    return y;
}

/* gelu(x W^T + b).  The activation is part of the product but where it is computed again: its argument, in the storage
 * type, is then all that is kept. */
static dar_val *activated(dar_tape *t, const struct block *a, dar_val *x)
{
    const dar_dit_product *up = &a->b->product[DAR_FFN_UP];
    dar_keep keep = a->m->replay == DAR_REPLAY_CHEAP ? DAR_KEEP_ALL : DAR_KEEP_NOTHING;
    dar_val *h = dar_dit_multiply(t, a->m, up, a->cheap ? DAR_ACT_NONE : DAR_ACT_GELU_TANH, keep, x);
    dar_drop(t, x);
    if (!a->cheap) return h;
    dar_val *y = dar_gelu_tanh(t, h);
    dar_drop(t, h);
    return y;
}

static dar_keep keep_attention(const struct block *a)
{
    return a->m->replay == DAR_REPLAY_ALL ? DAR_KEEP_NOTHING : DAR_KEEP_ALL;
}

static dar_val *rms(dar_tape *t, const struct block *a, const dar_param *w, dar_val *x)
{
    dar_val *y = dar_rms_norm(t, x, dar_param_leaf(t, w), &(dar_norm_opt){ .eps = a->m->c.eps });
    dar_drop(t, x);
    return y;
}

/* Rotated; nobody looks at x again. */
static dar_val *turned(dar_tape *t, dar_val *x, dar_val *rope)
{
    dar_val *y = dar_rope(t, x, rope);
    dar_drop(t, x);
    return y;
}

/* The norms before products: from the stream to the products' type. */
static dar_norm_opt norm_before(const struct block *a)
{
    return (dar_norm_opt){
        .eps = a->m->c.eps, .cast = true, .out = a->m->storage, .split = a->s->frame, .first = a->first
    };
}

static dar_val *gate(dar_tape *t, const struct block *a, dar_val *x, dar_val *u, dar_val *g)
{
    dar_val *y = dar_gate(t, x, u, g, (dar_gate_attr){ a->s->frame, a->first });
    dar_drop(t, u);
    return y;
}

/* x [B, L, D] -> [B, L, D], all three; with a->rest self-attention gives the tokens after the first frame's alone */
static dar_val *self_attention(dar_tape *t, const struct block *a, dar_val *x)
{
    dar_attention_opt o = { .heads = a->m->c.heads, .keep = keep_attention(a) };
    dar_norm_opt norm = norm_before(a);
    dar_val *mod[3];

    modulations(t, a, 0, mod);
    dar_val *h = dar_modulate(t, x, mod[SCALE], mod[SHIFT], &norm), *rope = a->s->rope;
    dar_val *k = turned(t, rms(t, a, a->b->norm_k[0], product(t, a, DAR_SELF_K, h)), rope);
    dar_val *v = product(t, a, DAR_SELF_V, h);
    if (a->rest) {
        h = others(t, a, 1, h), x = others(t, a, 1, x), rope = others(t, a, 0, rope);
        mod[GATE] = later(t, mod[GATE]);
    }
    dar_val *q = turned(t, rms(t, a, a->b->norm_q[0], product(t, a, DAR_SELF_Q, h)), rope);
    dar_drop(t, h);
    h = dar_attention(t, q, k, v, &o);
    dar_drop(t, q);
    dar_drop(t, k);
    dar_drop(t, v);
    return gate(t, a, x, last_product(t, a, DAR_SELF_O, h, true), mod[GATE]);
}

static dar_val *cross_attention(dar_tape *t, const struct block *a, dar_val *x)
{
    dar_attention_opt o = { .heads = a->m->c.heads, .keep = keep_attention(a), .log_weight = a->log_weight };
    dar_norm_opt norm = norm_before(a);
    dar_val *h = dar_layer_norm(t, x, dar_param_leaf(t, a->b->norm3_w), dar_param_leaf(t, a->b->norm3_b), &norm);
    dar_val *q = rms(t, a, a->b->norm_q[1], product(t, a, DAR_CROSS_Q, h));
    dar_drop(t, h);
    h = dar_attention(t, q, a->k, a->v, &o);
    dar_drop(t, q); /* keys and values belong to the text */
    h = last_product(t, a, DAR_CROSS_O, h, false);
    x = dar_add(t, x, h);
    dar_drop(t, h);
    return x;
}

static dar_val *feed_forward(dar_tape *t, const struct block *a, dar_val *x)
{
    dar_norm_opt norm = norm_before(a);
    dar_val *mod[3];

    modulations(t, a, 3, mod);
    dar_val *h = dar_modulate(t, x, mod[SCALE], mod[SHIFT], &norm);
    h = last_product(t, a, DAR_FFN_DOWN, activated(t, a, h), true);
    return gate(t, a, x, h, mod[GATE]);
}

/* ---------------------------------------------------------------- the feed-forward layer in pieces */

static int64_t rows_at_a_time(const dar_dit *m)
{
    return m->piece > m->c.ffn ? m->piece / m->c.ffn : 1;
}

/* What a piece of the tokens sees. */
static struct block piece_of(dar_tape *t, const struct block *a, dar_rows r)
{
    struct block p = *a;
    if (r.clips < a->e0->x.shape.d[0]) p.e0 = dar_slice(t, a->e0, 0, r.clip, r.clips);
    p.first = r.first;
    return p;
}

/* in: x, e0 */
static dar_val *feed_forward_rows(dar_tape *t, void *arg, dar_val *const *in, dar_rows r)
{
    struct block a = *(const struct block *)arg;
    a.e0 = in[1];
    a = piece_of(t, &a, r);
    return feed_forward(t, &a, in[0]);
}

static dar_val *feed_forward_pieces(dar_tape *t, const struct block *a, dar_val *x, bool unread)
{
    dar_rows_attr rows = { .fn = feed_forward_rows,
                           .arg = dar_tape_store(t, a, sizeof *a),
                           .cut = DAR_KEEP_X(0),
                           .most = rows_at_a_time(a->m),
                           .unread = unread,
                           .type = x->x.dtype,
                           .shape = x->x.shape };
    return dar_segment_rows(t, &rows, (dar_val *[]){ x, a->e0 }, 2);
}

/* ---------------------------------------------------------------- the stack */

static struct block block_of(const dar_dit *m, int i, const dar_dit_scene *s, const dar_dit_text *x, dar_val *e0)
{
    return (struct block){
        .m = m, .b = &m->block[i], .s = s, .log_weight = x->log_weight, .e0 = e0, .k = x->k[i], .v = x->v[i]
    };
}

dar_val *dar_dit_block_forward(dar_tape *t, const dar_dit *m, int i, const dar_dit_scene *s, const dar_dit_text *x,
                               dar_val *e0, dar_val *tokens)
{
    struct block a = block_of(m, i, s, x, e0);
    tokens = self_attention(t, &a, tokens);
    tokens = cross_attention(t, &a, tokens);
    return feed_forward(t, &a, tokens);
}

/* Segments: in: x, e0, k, v */
static struct block block_in(const void *arg, dar_val *const *in)
{
    struct block a = *(const struct block *)arg;
    a.e0 = in[1], a.k = in[2], a.v = in[3];
    return a;
}

static dar_val *self_segment(dar_tape *t, void *arg, dar_val *const *in)
{
    struct block a = block_in(arg, in);
    return self_attention(t, &a, in[0]);
}

static dar_val *cross_segment(dar_tape *t, void *arg, dar_val *const *in)
{
    struct block a = block_in(arg, in);
    return cross_attention(t, &a, in[0]);
}

static dar_val *block_segment(dar_tape *t, void *arg, dar_val *const *in)
{
    struct block a = block_in(arg, in);
    dar_val *x = cross_attention(t, &a, self_attention(t, &a, in[0]));
    return feed_forward_pieces(t, &a, x, true);
}

static dar_val *segment(dar_tape *t, dar_segment_fn *fn, struct block *a, dar_val *x)
{
    dar_val *in[] = { x, a->e0, a->k, a->v };
    return dar_segment(t, fn, a, in, DAR_COUNT(in), x->x.dtype, x->x.shape);
}

/* A block as a segment; where little is computed again, a segment for each part: only one at a time is then whole. */
static dar_val *segments(dar_tape *t, const struct block *b, dar_val *tokens)
{
    struct block *a = dar_tape_store(t, b, sizeof *b);
    a->cheap = b->m->replay >= DAR_REPLAY_WIDE && t->keep;
    if (!a->cheap) return segment(t, block_segment, a, tokens);
    tokens = segment(t, cross_segment, a, segment(t, self_segment, a, tokens));
    return feed_forward_pieces(t, a, tokens, false);
}

typedef dar_val *part_fn(dar_tape *t, const struct block *a, dar_val *x);

static void in_place(dar_tape *t, part_fn *part, const struct block *a, dar_val *from, dar_val *to)
{
    dar_tape_place m = dar_tape_mark(t);
    dar_val *y = part(t, a, from);
    if (!t->arena->plan) dar_tensor_copy(&to->x, &y->x);
    dar_tape_reset(t, m);
}

/* Nothing looks back: one stream, written over after every part.  begun: self-attention has been. */
static dar_val *parts_in_place(dar_tape *t, struct block a, bool begun, dar_val *tokens)
{
    if (!begun) {
        dar_val *to = a.rest ? others(t, &a, 1, tokens) : tokens;
        in_place(t, self_attention, &a, tokens, to);
        if (a.rest) a.e0 = later(t, a.e0);
        a.rest = false;
        tokens = to;
    }
    in_place(t, cross_attention, &a, tokens, tokens);
    const dar_shape *s = &tokens->x.shape;
    for (int64_t i = 0; i < dar_rows_count(s, rows_at_a_time(a.m)); i++) {
        dar_rows r = dar_rows_of(s, rows_at_a_time(a.m), i);
        struct block piece = piece_of(t, &a, r);
        dar_val *x = dar_slice(t, dar_slice(t, tokens, 0, r.clip, r.clips), 1, r.first, r.count);
        in_place(t, feed_forward, &piece, x, x);
    }
    return tokens;
}

void dar_dit_blocks_begin(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_moment *e,
                          dar_val *tokens)
{
    struct block a = { .m = m, .b = &m->block[0], .s = s, .e0 = e->e0 };
    DAR_ASSERT(!t->recording, "dit: halves are not recorded");
    in_place(t, self_attention, &a, tokens, tokens);
}

dar_val *dar_dit_blocks_read(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_moment *e,
                             dar_val *tokens)
{
    struct block a = { .m = m, .b = &m->block[0], .s = s, .e0 = e->e0 };
    dar_norm_opt norm = { .eps = m->c.eps, .split = s->frame };
    dar_val *mod[3];
    modulations(t, &a, 0, mod);
    return dar_modulate(t, tokens, mod[SCALE], mod[SHIFT], &norm);
}

dar_val *dar_dit_blocks_end(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_text *x,
                            const dar_dit_moment *e, dar_val *tokens)
{
    for (int i = 0; i < m->c.layers; i++) {
        struct block a = block_of(m, i, s, x, e->e0);
        a.rest = s->held && i == m->c.layers - 1;
        if (a.rest && i == 0) {
            a.e0 = later(t, a.e0), tokens = others(t, &a, 1, tokens);
            a.rest = false;
        }
        tokens = parts_in_place(t, a, i == 0, tokens);
    }
    return tokens;
}

dar_val *dar_dit_blocks(dar_tape *t, const dar_dit *m, const dar_dit_scene *s, const dar_dit_text *x,
                        const dar_dit_moment *e, dar_val *tokens)
{
    if (!t->recording) {
        dar_dit_blocks_begin(t, m, s, e, tokens);
        return dar_dit_blocks_end(t, m, s, x, e, tokens);
    }
    for (int i = 0; i < m->c.layers; i++) {
        struct block a = block_of(m, i, s, x, e->e0);
        if (m->replay == DAR_REPLAY_NOTHING) tokens = dar_dit_block_forward(t, m, i, s, x, e->e0, tokens);
        else tokens = segments(t, &a, tokens);
    }
    return tokens;
}
