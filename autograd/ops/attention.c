/* attention.c: softmax(scale q k^T + lw) v, head by head; the work is in lib/attn.c. */
#include "autograd/ops.h"

#include <math.h>

#include "lib/attn.h"

enum { Q, K, V, LW };

struct attr {
    int64_t heads;
    double scale;
};

static dar_shape shape(const dar_shape *in, int n_in, const void *attr)
{
    const struct attr *at = attr;
    const dar_shape *q = &in[Q], *k = &in[K], *lw = &in[LW];
    char a[96], b[96];

    DAR_ASSERT(q->n == 3 && k->n == 3, "attention: q %s, k %s, expected [B, N, D]", dar_shape_text(q, a, sizeof a),
               dar_shape_text(k, b, sizeof b));
    DAR_ASSERT(dar_shape_equal(k, &in[V]), "attention: k %s, v %s", dar_shape_text(k, a, sizeof a),
               dar_shape_text(&in[V], b, sizeof b));
    DAR_ASSERT(q->d[0] == k->d[0] && q->d[2] == k->d[2], "attention: q %s, k %s", dar_shape_text(q, a, sizeof a),
               dar_shape_text(k, b, sizeof b));
    DAR_ASSERT(at->heads > 0 && q->d[2] > 0 && q->d[2] % at->heads == 0, "attention: %lld columns, %lld heads",
               (long long)q->d[2], (long long)at->heads);
    DAR_ASSERT(at->scale >= 0, "attention: scale %g", at->scale);
    if (n_in > LW && lw->n >= 0) {
        bool ok = lw->n >= 1 && lw->n <= 2 && lw->d[lw->n - 1] == k->d[1] && (lw->n == 1 || lw->d[0] == k->d[0]);
        DAR_ASSERT(ok, "attention: log-weights %s for k %s", dar_shape_text(lw, a, sizeof a),
                   dar_shape_text(k, b, sizeof b));
    }
    return *q;
}

static dar_shape aux(const dar_shape *in, int n_in, const void *attr)
{
    const struct attr *at = attr;
    (void)n_in;
    return DAR_SHAPE(in[Q].d[0], at->heads, in[Q].d[1], 2);
}

static dar_attn call_of(const dar_opctx *c)
{
    const struct attr *at = c->attr;
    return (dar_attn){
        .q = c->x[Q],
        .k = c->x[K],
        .v = c->x[V],
        .lw = c->x[LW],
        .y = c->y,
        .heads = (size_t)at->heads,
        .scale = at->scale > 0 ? at->scale : 1 / sqrt((double)(c->y.shape.d[2] / at->heads)),
        .stats = c->aux,
        .gy = c->gy,
        .gq = c->gx[Q],
        .gk = c->gx[K],
        .gv = c->gx[V],
        .add_q = c->add[Q],
        .add_k = c->add[K],
        .add_v = c->add[V],
        .scratch = c->scratch,
        .threads = c->threads,
    };
}

static size_t scratch(const dar_opctx *c, bool backward)
{
    dar_attn a = call_of(c);
    return dar_attn_scratch(&a, backward);
}

/* A product of every query with every key, over D columns: two forward; in backward the weights again, dP unless only
 * gv is wanted, and one for each gradient. */
static double flops(const dar_opctx *c, bool backward)
{
    double one = 2 * (double)dar_tensor_count(&c->y) * (double)c->x[K].shape.d[1];
    bool gq = c->gx[Q].data, gk = c->gx[K].data, gv = c->gx[V].data;
    return backward ? one * (1 + (gq || gk) + gq + gk + gv) : 2 * one;
}

/* A logit or dP sums E terms, y and gq a key each, gk and gv a query each. */
static double terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    const struct attr *at = attr;
    (void)n_in;
    return (double)(in[Q].d[2] / at->heads + in[of == K || of == V ? Q : K].d[1]);
}

static void forward(const dar_opctx *c)
{
    dar_attn a = call_of(c);
    dar_attn_forward(&a);
}

static void backward(const dar_opctx *c)
{
    dar_attn a = call_of(c);
    if (a.gq.data || a.gk.data || a.gv.data) dar_attn_backward(&a);
}

/* ---------------------------------------------------------------- samples */

/* Keys 1 and 3 count more, key 2 is masked. */
static void weigh(int input, const dar_tensor *x)
{
    size_t n = dar_tensor_count(x), cols = dar_tensor_cols(x);
    if (input != LW) return;
    for (size_t i = 0; i < n; i++) dar_dtype_set(x->dtype, x->data, i, i % cols == 2 ? -INFINITY : i % 2 ? log(3) : 0);
}

static void mask_all(int input, const dar_tensor *x)
{
    if (input == LW) dar_tensor_fill(x, -INFINITY);
}

#define SELF(B, N, D)                                                                                                  \
    { 3, { B, N, D } }, { 3, { B, N, D } },                                                                            \
    {                                                                                                                  \
        3,                                                                                                             \
        {                                                                                                              \
            B, N, D                                                                                                    \
        }                                                                                                              \
    }
#define CROSS(B, NQ, NK, D)                                                                                            \
    { 3, { B, NQ, D } }, { 3, { B, NK, D } },                                                                          \
    {                                                                                                                  \
        3,                                                                                                             \
        {                                                                                                              \
            B, NK, D                                                                                                   \
        }                                                                                                              \
    }
#define NONE                                                                                                           \
    {                                                                                                                  \
        .n = -1                                                                                                        \
    }

static const struct attr one = { 1, 0 }, two = { 2, 0 }, three = { 3, 0 }, hot = { 2, 1.5 };

static const dar_sample samples[] = {
    { .in = { SELF(2, 5, 6), NONE }, .attr = &two },                               /* two heads of 3 */
    { .in = { CROSS(2, 3, 7, 9), NONE }, .attr = &three },                         /* fewer queries than keys */
    { .in = { CROSS(1, 2, 130, 4), NONE }, .attr = &two },                         /* two blocks of keys */
    { .in = { CROSS(1, 131, 3, 4), NONE }, .attr = &two },                         /* two blocks of queries */
    { .in = { SELF(1, 7, 8), NONE }, .attr = &hot, .lo = -3, .hi = 3 },            /* own scale, sharp weights */
    { .in = { CROSS(2, 3, 5, 4), { 1, { 5 } } }, .attr = &two, .fill = weigh },    /* log-weights for all */
    { .in = { CROSS(2, 3, 5, 4), { 2, { 2, 5 } } }, .attr = &two, .fill = weigh }, /* and of each sample */
    { .in = { CROSS(1, 3, 2, 4), { 1, { 2 } } }, .attr = &two, .fill = mask_all }, /* no key left */
    { .in = { SELF(1, 300, 40), NONE }, .attr = &one },                            /* head of 40, several blocks */
};

static const dar_error_sample errors[] = {
    { .in = { SELF(1, 2, 5), NONE }, .attr = &two },                                              /* D / heads */
    { .in = { { 3, { 1, 2, 4 } }, { 3, { 1, 3, 4 } }, { 3, { 1, 2, 4 } }, NONE }, .attr = &two }, /* k, v */
    { .in = { { 3, { 1, 2, 4 } }, { 3, { 2, 3, 4 } }, { 3, { 2, 3, 4 } }, NONE }, .attr = &two }, /* batch */
    { .in = { { 3, { 1, 2, 4 } }, { 3, { 1, 3, 6 } }, { 3, { 1, 3, 6 } }, NONE }, .attr = &two }, /* width */
    { .in = { { 2, { 2, 4 } }, { 2, { 3, 4 } }, { 2, { 3, 4 } }, NONE }, .attr = &two },          /* no batch */
    { .in = { SELF(1, 2, 4), { 1, { 3 } } }, .attr = &two },                                      /* weights */
};

const dar_op dar_op_attention = {
    .name = "attention",
    .n_in = 4,
    .n_optional = 1,
    .keep = DAR_KEEP_X(Q) | DAR_KEEP_X(K) | DAR_KEEP_X(V) | DAR_KEEP_X(LW) | DAR_KEEP_Y,
    .half = DAR_KEEP_X(K) | DAR_KEEP_X(V) | DAR_KEEP_Y,
    .frozen = DAR_KEEP_X(LW),
    .attr_size = sizeof(struct attr),
    .shape = shape,
    .aux = aux,
    .scratch = scratch,
    .terms = terms,
    .flops = flops,
    .forward = forward,
    .backward = backward,
    .samples = samples,
    .n_samples = DAR_COUNT(samples),
    .errors = errors,
    .n_errors = DAR_COUNT(errors),
};

dar_val *dar_attention(dar_tape *t, dar_val *q, dar_val *k, dar_val *v, const dar_attention_opt *o)
{
    dar_val *in[] = { q, k, v, o->log_weight };
    struct attr at = { o->heads, o->scale };
    return dar_apply_kept(t, &dar_op_attention, in, DAR_COUNT(in), &at, o->keep);
}
