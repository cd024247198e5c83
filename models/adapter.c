/* adapter.c: see adapter.h. */
#include "models/adapter.h"

#include <math.h>
#include <string.h>

#include "autograd/ops.h"
#include "lib/kern.h"
#include "lib/thread.h"

#define GROUP ((int64_t)1 << 26) /* 256 MB */

/* ---------------------------------------------------------------- parameters */

static dar_param *declare(dar_params *p, bool matrix, dar_param_law law, double spread, dar_shape s, const char *name)
{
    return dar_params_add(p, (dar_param_info){ DAR_PARAM_ADAPTER, matrix, law, spread }, s, "control_adapter.%s", name);
}

/* What nn.Conv2d starts with.  A second block and later ones start as the identity, so that weights for fewer blocks
 * mean the same. */
static void declare_block(dar_adapter *a, dar_params *p, int i)
{
    static const char *const names[] = { "conv1.weight", "conv1.bias", "conv2.weight", "conv2.bias" };
    double spread = 1 / sqrt(9 * (double)a->width);
    for (int k = 0; k < 4; k++) {
        bool weight = k == DAR_ADAPTER_W1 || k == DAR_ADAPTER_W2, zero = i && k >= DAR_ADAPTER_W2;
        dar_shape s = weight ? DAR_SHAPE(a->width, a->width, 3, 3) : DAR_SHAPE(a->width);
        a->block[i][k] =
            dar_params_add(p, (dar_param_info){ DAR_PARAM_ADAPTER, weight, DAR_FRESH_UNIFORM, zero ? 0 : spread }, s,
                           "control_adapter.residual_blocks.%d.%s", i, names[k]);
    }
}

void dar_adapter_init(dar_adapter *a, dar_params *p, const dar_adapter_config *c, int64_t width)
{
    int64_t channels = (c->rays + c->geometry) * c->unshuffle * c->unshuffle;
    double spread = 1 / sqrt(4 * (double)channels);

    *a = (dar_adapter){ .c = *c, .width = width, .storage = p->storage, .main = p->main, .group = GROUP };
    if (!channels) return;
    DAR_ASSERT(c->blocks <= DAR_ADAPTER_BLOCKS, "adapter: %lld blocks", (long long)c->blocks);
    a->w = declare(p, true, DAR_FRESH_UNIFORM, c->spread * spread, DAR_SHAPE(width, channels, 2, 2), "conv.weight");
    a->b = declare(p, false, DAR_FRESH_UNIFORM, spread, DAR_SHAPE(width), "conv.bias");
    for (int i = 0; i < c->blocks; i++) declare_block(a, p, i);
}

dar_status dar_adapter_bind(dar_params *p, const dar_adapter *a, const dar_tensor *x, uint64_t seed, dar_err *e)
{
    char found[96], expected[96];
    const dar_shape *have = &x->shape, *want = &a->w->x.shape;
    int64_t step = a->c.unshuffle * a->c.unshuffle;
    bool fits = have->n == 4 && have->d[0] == want->d[0] && have->d[1] <= want->d[1] && have->d[1] % step == 0 &&
                have->d[2] == 2 && have->d[3] == 2;

    if (!fits)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found %s, expected %s, or fewer times %lld channels", a->w->name,
                        dar_shape_text(have, found, sizeof found), dar_shape_text(want, expected, sizeof expected),
                        (long long)step);
    if (have->d[1] == want->d[1]) {
        dar_param_bind(p, a->w, x);
    } else if (a->c.widen == DAR_WIDEN_FRESH) {
        dar_param_fresh(p, a->w, seed);
    } else {
        dar_param_push(p, a->w);
        if (p->arena->plan) return DAR_OK;
        dar_tensor old = dar_tensor_narrow(&a->w->x, 1, 0, have->d[1]);
        dar_tensor_fill(&a->w->x, 0);
        dar_tensor_copy(&old, x);
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- patches */

struct patches {
    const dar_tensor *cond, *out;
    int64_t first, r, h, w;
};

/* A line of 2 r pixels into every fourth number: pixel k r + dx to place 4 dx + k. */
#define SPREAD(type)                                                                                                   \
    static void spread_##type(type *to, const type *line, int64_t r)                                                   \
    {                                                                                                                  \
        for (int64_t dx = 0; dx < r; dx++) {                                                                           \
            to[4 * dx] = line[dx];                                                                                     \
            to[4 * dx + 1] = line[r + dx];                                                                             \
        }                                                                                                              \
    }
SPREAD(float)
SPREAD(double)

/* Token `row` of `out`: 2 r x 2 r pixels of every channel, a line of pixels at a time. */
static void patch(const struct patches *p, int64_t row)
{
    const dar_shape *s = &p->cond->shape;
    int64_t C = s->d[1], F = s->d[2], H = s->d[3], W = s->d[4], r = p->r;
    int64_t picture = p->first + row / (p->h * p->w), i = row / p->w % p->h, j = row % p->w;
    dar_dtype type = p->out->dtype;
    size_t k = dar_tensor_cols(p->out);
    double buf[DAR_PIECE];

    for (int64_t c = 0; c < C; c++)
        for (int64_t y = 0; y < 2 * r; y++) {
            int64_t at = (((picture / F * C + c) * F + picture % F) * H + 2 * r * i + y) * W + 2 * r * j;
            const void *line =
                dar_row_get(type, p->cond->dtype, dar_tensor_at(p->cond, (size_t)at), (size_t)(2 * r), buf);
            void *to = dar_tensor_at(p->out, (size_t)row * k + (size_t)((c * r + y % r) * r * 4 + y / r * 2));
            if (type == DAR_F64) spread_double(to, line, r);
            else spread_float(to, line, r);
        }
}

static void patch_rows(void *ctx, size_t begin, size_t end, int thread)
{
    (void)thread;
    for (size_t i = begin; i < end; i++) patch(ctx, (int64_t)i);
}

void dar_adapter_patches(const dar_tensor *cond, int64_t r, int64_t first, const dar_tensor *out)
{
    const dar_shape *s = &cond->shape;
    struct patches p = { cond, out, first, r, s->d[3] / (2 * r), s->d[4] / (2 * r) };
    int64_t rows = out->shape.d[0];

    DAR_ASSERT(s->n == 5 && s->d[3] % (2 * r) == 0 && s->d[4] % (2 * r) == 0 && dar_tensor_contiguous(cond),
               "adapter: pictures of %lld x %lld pixels, tokens of %lld", (long long)s->d[3], (long long)s->d[4],
               (long long)(2 * r));
    DAR_ASSERT(out->shape.n == 2 && out->shape.d[1] == 4 * r * r * s->d[1] && rows % (p.h * p.w) == 0 &&
                   first + rows / (p.h * p.w) <= s->d[0] * s->d[2] && 2 * r <= DAR_PIECE,
               "adapter: patches do not fit");
    dar_parallel_range((size_t)rows, 4, patch_rows, &p);
}

/* ---------------------------------------------------------------- forward */

struct group {
    const dar_adapter *a;
    dar_tensor cond;
    int64_t first, n, h, w; /* pictures; tokens of one */
};

/* tokens [n h w, D] -> [n, D, h, w] */
static dar_val *as_maps(dar_tape *t, const struct group *g, dar_val *x)
{
    x = dar_reshape(t, x, DAR_SHAPE(g->n, g->h, g->w, g->a->width));
    return dar_contiguous(t, dar_permute(t, x, (int[]){ 0, 3, 1, 2 }));
}

static dar_val *as_tokens(dar_tape *t, const struct group *g, dar_val *x)
{
    x = dar_permute(t, x, (int[]){ 0, 2, 3, 1 });
    return dar_reshape(t, x, DAR_SHAPE(g->n * g->h * g->w, g->a->width));
}

static dar_val *residual(dar_tape *t, const dar_adapter *a, dar_param *const *b, dar_val *x) /* [n, D, h, w] */
{
    dar_val *w1 = dar_param_operand(t, b[DAR_ADAPTER_W1], a->storage);
    dar_val *w2 = dar_param_operand(t, b[DAR_ADAPTER_W2], a->storage);
    dar_val *h = dar_cast(t, x, a->storage);
    h = dar_conv2d(t, h, w1, dar_param_leaf(t, b[DAR_ADAPTER_B1]), dar_conv_same(w1));
    h = dar_conv2d(t, dar_relu(t, h), w2, dar_param_leaf(t, b[DAR_ADAPTER_B2]), dar_conv_same(w2));
    return dar_add(t, x, h);
}

static dar_val *group_forward(dar_tape *t, void *arg, dar_val *const *in) /* -> [n h w, D] */
{
    const struct group *g = arg;
    const dar_adapter *a = g->a;
    int64_t k = (int64_t)dar_shape_count(&a->w->x.shape) / a->width;
    (void)in;

    dar_val *x = dar_input(t, a->main, DAR_SHAPE(g->n * g->h * g->w, k));
    if (!t->arena->plan) dar_adapter_patches(&g->cond, a->c.unshuffle, g->first, &x->x);
    dar_val *w = dar_reshape(t, dar_param_leaf(t, a->w), DAR_SHAPE(a->width, k));
    x = dar_linear(t, x, w, dar_param_leaf(t, a->b), NULL);
    if (!a->c.blocks) return x;
    x = as_maps(t, g, x);
    for (int i = 0; i < a->c.blocks; i++) x = residual(t, a, a->block[i], x);
    return as_tokens(t, g, x);
}

/* Rows of n values one after the other: eight at a time, then eights of those. */
static dar_val *join(dar_tape *t, dar_val **x, int64_t n)
{
    while (n > 1) {
        int64_t made = 0;
        for (int64_t i = 0; i < n; i += DAR_OP_IN)
            x[made++] = dar_concat(t, x + i, (int)(n - i < DAR_OP_IN ? n - i : DAR_OP_IN), 0);
        n = made;
    }
    return x[0];
}

/* Every group of at most `most` pictures as a segment. */
static dar_val *recorded(dar_tape *t, const struct group *all, int64_t most)
{
    int64_t count = (all->n + most - 1) / most, rows = all->h * all->w;
    dar_val **x = dar_tape_room(t, (size_t)count * sizeof(dar_val *));
    for (int64_t i = 0; i < count; i++) {
        struct group *g = dar_tape_store(t, all, sizeof *all);
        g->first = i * most;
        g->n = all->n - g->first < most ? all->n - g->first : most;
        x[i] = dar_segment(t, group_forward, g, NULL, 0, all->a->main, DAR_SHAPE(g->n * rows, all->a->width));
    }
    return join(t, x, count);
}

/* The same with nothing to remember: each group's rows go where they belong. */
static dar_val *computed(dar_tape *t, const struct group *all, int64_t most)
{
    int64_t rows = all->h * all->w;
    dar_val *y = dar_input(t, all->a->main, DAR_SHAPE(all->n * rows, all->a->width));
    for (int64_t first = 0; first < all->n; first += most) {
        struct group g = *all;
        g.first = first;
        g.n = all->n - first < most ? all->n - first : most;
        dar_mark m = dar_arena_mark(t->arena);
        dar_val *x = group_forward(t, &g, NULL);
        dar_tensor part = dar_tensor_narrow(&y->x, 0, first * rows, g.n * rows);
        if (!t->arena->plan) dar_tensor_copy(&part, &x->x);
        dar_arena_reset(t->arena, m);
    }
    return y;
}

dar_val *dar_adapter_forward(dar_tape *t, const dar_adapter *a, const dar_tensor *cond)
{
    const dar_shape *s = &cond->shape;
    int64_t side = 2 * a->c.unshuffle, channels = a->c.rays + a->c.geometry;

    DAR_ASSERT(s->n == 5 && s->d[1] == channels && s->d[3] % side == 0 && s->d[4] % side == 0,
               "adapter: %lld channels of %lld x %lld pixels, expected %lld and multiples of %lld", (long long)s->d[1],
               (long long)s->d[3], (long long)s->d[4], (long long)channels, (long long)side);
    struct group all = { a, *cond, 0, s->d[0] * s->d[2], s->d[3] / side, s->d[4] / side };
    int64_t most = a->group / (all.h * all.w * side * side * channels);
    dar_val *y = (t->recording ? recorded : computed)(t, &all, most < 1 ? 1 : most);
    return dar_reshape(t, y, DAR_SHAPE(s->d[0], s->d[2] * all.h * all.w, a->width));
}
