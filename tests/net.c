/* net.c: see net.h.  Formulas as in the reference model, WanAttentionBlock. */
#include "tests/net.h"

#include <math.h>
#include <string.h>

#include "lib/kern.h"

enum { SELF_Q, SELF_K, SELF_V, SELF_O, CROSS_Q, CROSS_K, CROSS_V, CROSS_O, FFN_UP, FFN_DOWN };
enum { SHIFT_SA, SCALE_SA, GATE_SA, SHIFT_FFN, SCALE_FFN, GATE_FFN };

/* ---------------------------------------------------------------- weights */

struct maker {
    dar_arena *arena;
    uint64_t seed;
};

static double uniform(uint64_t seed, size_t i)
{
    uint64_t z = seed * 0xd1342543de82ef95u + (i + 1) * 0x9e3779b97f4a7c15u;
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    return (double)((z ^ z >> 31) >> 11) * 0x1p-52 - 1;
}

/* Uniform around `mean`, of the given spread, rounded to bf16 so that every storage type holds the same. */
static dar_tensor make(struct maker *m, dar_dtype type, dar_shape s, double mean, double spread)
{
    dar_tensor x = dar_tensor_push(m->arena, type, s);
    size_t n = dar_tensor_count(&x);
    m->seed++;
    for (size_t i = 0; i < n && !m->arena->plan; i++)
        dar_dtype_set(type, x.data, i,
                      dar_bf16_to_f32(dar_bf16_from_f32((float)(mean + spread * uniform(m->seed, i)))));
    return x;
}

static net_weight weight(struct maker *m, dar_dtype type, dar_shape s, double mean, double spread, bool trained)
{
    net_weight w = { .x = make(m, type, s, mean, spread) };
    if (trained) {
        w.g = dar_tensor_push(m->arena, dar_compute_type(type), s);
        if (!m->arena->plan) dar_tensor_fill(&w.g, 0);
    }
    return w;
}

static void make_block(net *n, net_block *b, struct maker *m)
{
    const net_size *s = &n->s;
    int64_t d = s->width;
    bool full = s->train && !s->rank, lora = s->train && s->rank;
    dar_dtype stored = full ? n->main : s->storage; /* what is trained is wide */

    for (int i = 0; i < NET_PROJECTIONS; i++) {
        int64_t in = i == FFN_DOWN ? s->ffn : d, out = i == FFN_UP ? s->ffn : d;
        b->w[i] = weight(m, stored, DAR_SHAPE(out, in), 0, sqrt(3.0 / (double)in), full);
        b->b[i] = weight(m, n->main, DAR_SHAPE(out), 0, 0.1, full);
        if (!s->rank) continue;
        b->down[i] = weight(m, n->main, DAR_SHAPE(s->rank, in), 0, 1 / sqrt((double)in), lora);
        b->up[i] = weight(m, n->main, DAR_SHAPE(out, s->rank), 0, 0.1 / sqrt((double)s->rank), lora);
    }
    for (int i = 0; i < 4; i++) b->norm[i] = weight(m, n->main, DAR_SHAPE(d), 1, 0.2, full);
    b->norm3_w = weight(m, n->main, DAR_SHAPE(d), 1, 0.2, full);
    b->norm3_b = weight(m, n->main, DAR_SHAPE(d), 0, 0.2, full);
    for (int i = 0; i < 6; i++) b->modulation[i] = weight(m, n->main, DAR_SHAPE(1, 2, d), 0, 0.5, full);
}

void net_init(net *n, net_size s, dar_arena *a)
{
    struct maker m = { a, 1 };

    DAR_ASSERT(s.blocks <= NET_MAX_BLOCKS, "net: %d blocks, at most %d", s.blocks, NET_MAX_BLOCKS);
    memset(n, 0, sizeof *n);
    n->s = s;
    n->main = dar_compute_type(s.storage);
    n->tokens = s.grid[0] * s.grid[1] * s.grid[2];
    for (int i = 0; i < s.blocks; i++) make_block(n, &n->block[i], &m);
    n->input = make(&m, n->main, DAR_SHAPE(1, n->tokens, s.width), 0, 1);
    n->target = make(&m, n->main, DAR_SHAPE(1, n->tokens, s.width), 0, 1);
    n->context = make(&m, s.storage, DAR_SHAPE(1, s.text, s.width), 0, 1);
    n->rope = dar_tensor_push(a, n->main, DAR_SHAPE(n->tokens, s.width / s.heads));
    if (!a->plan) dar_rope_table(&n->rope, s.grid[0], s.grid[1], s.grid[2]);
}

size_t net_bytes(net_size s)
{
    dar_arena plan;
    net n;
    DAR_ASSERT(dar_arena_init_plan(&plan, "net", NULL) == DAR_OK, "net: no address space");
    net_init(&n, s, &plan);
    size_t bytes = plan.peak;
    dar_arena_free(&plan);
    return bytes;
}

/* ---------------------------------------------------------------- forward */

static dar_val *leaf(dar_tape *t, const net_weight *w)
{
    return dar_leaf(t, w->x, w->g.data ? &w->g : NULL);
}

static dar_val *project(dar_tape *t, const net *n, const net_block *b, int i, dar_val *x)
{
    dar_linear_opt o = { .act = i == FFN_UP ? DAR_ACT_GELU_TANH : DAR_ACT_NONE };
    dar_val *w = leaf(t, &b->w[i]), *bias = leaf(t, &b->b[i]);
    if (!n->s.rank) return dar_linear(t, x, w, bias, &o);
    return dar_lora(t, x, w, bias, leaf(t, &b->down[i]), leaf(t, &b->up[i]), 1, &o);
}

static dar_val *rms(dar_tape *t, const net_block *b, int i, dar_val *x)
{
    return dar_rms_norm(t, x, leaf(t, &b->norm[i]), &(dar_norm_opt){ .eps = 1e-6 });
}

struct block_arg {
    net *n;
    const net_block *b;
};

/* in: x [1, N, D], context [1, text, D] */
static dar_val *block_forward(dar_tape *t, void *arg, dar_val *const *in)
{
    const struct block_arg *a = arg;
    const net *n = a->n;
    const net_block *b = a->b;
    int64_t first = n->s.grid[1] * n->s.grid[2]; /* tokens of frame 0 */
    dar_norm_opt norm = { .eps = 1e-6, .cast = true, .out = n->s.storage, .split = first };
    dar_attention_opt attn = { .heads = n->s.heads, .keep = n->s.keep };
    dar_val *rope = dar_leaf(t, n->rope, NULL), *x = in[0], *m[6];
    for (int i = 0; i < 6; i++) m[i] = leaf(t, &b->modulation[i]);

    dar_val *h = dar_modulate(t, x, m[SCALE_SA], m[SHIFT_SA], &norm);
    dar_val *q = dar_rope(t, rms(t, b, 0, project(t, n, b, SELF_Q, h)), rope);
    dar_val *k = dar_rope(t, rms(t, b, 1, project(t, n, b, SELF_K, h)), rope);
    h = dar_attention(t, q, k, project(t, n, b, SELF_V, h), &attn);
    x = dar_gate(t, x, project(t, n, b, SELF_O, h), m[GATE_SA], first);

    h = dar_layer_norm(t, x, leaf(t, &b->norm3_w), leaf(t, &b->norm3_b), &norm);
    q = rms(t, b, 2, project(t, n, b, CROSS_Q, h));
    k = rms(t, b, 3, project(t, n, b, CROSS_K, in[1]));
    h = dar_attention(t, q, k, project(t, n, b, CROSS_V, in[1]), &attn);
    x = dar_add(t, x, project(t, n, b, CROSS_O, h));

    h = dar_modulate(t, x, m[SCALE_FFN], m[SHIFT_FFN], &norm);
    h = project(t, n, b, FFN_DOWN, project(t, n, b, FFN_UP, h));
    return dar_gate(t, x, h, m[GATE_FFN], first);
}

dar_val *net_forward(dar_tape *t, net *n, dar_val *input)
{
    dar_val *x = input, *context = dar_leaf(t, n->context, NULL);
    for (int i = 0; i < n->s.blocks; i++) {
        struct block_arg *a = dar_tape_store(t, &(struct block_arg){ n, &n->block[i] }, sizeof *a);
        dar_val *in[] = { x, context };
        if (n->s.whole && t->recording) x = block_forward(t, a, in);
        else x = dar_segment(t, block_forward, a, in, 2, x->x.dtype, x->x.shape);
    }
    return x;
}

dar_val *net_loss(dar_tape *t, net *n, dar_val *input)
{
    return dar_squared_error(t, net_forward(t, n, input), dar_leaf(t, n->target, NULL), NULL, true);
}

static void each(net_weight *w, int count, void (*fn)(void *ctx, net_weight *w), void *ctx)
{
    for (int i = 0; i < count; i++)
        if (w[i].g.data) fn(ctx, &w[i]);
}

void net_each(net *n, void (*fn)(void *ctx, net_weight *w), void *ctx)
{
    for (int i = 0; i < n->s.blocks; i++) {
        net_block *b = &n->block[i];
        each(b->w, NET_PROJECTIONS, fn, ctx);
        each(b->b, NET_PROJECTIONS, fn, ctx);
        each(b->down, NET_PROJECTIONS, fn, ctx);
        each(b->up, NET_PROJECTIONS, fn, ctx);
        each(b->norm, 4, fn, ctx);
        each(&b->norm3_w, 1, fn, ctx);
        each(&b->norm3_b, 1, fn, ctx);
        each(b->modulation, 6, fn, ctx);
    }
}
