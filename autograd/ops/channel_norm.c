/* channel_norm.c: the norm of the VAE, over channels that are strided in memory.
 *
 * Work goes by blocks of places, each of which is a matrix: channels are its rows, and what belongs to a place (norm,
 * products) is a row too.  A block is read twice, the second time from the caches. */
#include <math.h>
#include <string.h>

#include "autograd/groups.h"
#include "autograd/ops.h"
#include "lib/kern.h"
#include "lib/thread.h"

#define BLOCK 131072 /* elements of a block, at most, unless there are more than 512 channels */
#define STRIP 128    /* places; blocks are whole strips */
#define LEAST 1e-24  /* of a squared norm */

enum { X, W };

struct walk {
    const dar_opctx *c;
    dar_dtype type;
    const dar_kern *k;
    size_t channels, places, block, blocks; /* of one clip */
    dar_put mode;

    /* Scratch: w in the arithmetic type, then, at `part`, the blocks' parts [clips blocks, C] of its gradient. */
    size_t part, scratch;
};

/* Places [first, first + n) of clip `clip`. */
struct block {
    size_t clip, first, n;
};

static size_t tasks(const struct walk *w)
{
    return (size_t)w->c->x[X].shape.d[0] * w->blocks;
}

static struct walk walk_of(const dar_opctx *c)
{
    const dar_tensor *x = &c->x[X];
    struct walk w = { .c = c, .type = dar_op_compute(c), .channels = (size_t)x->shape.d[1] };
    w.k = dar_kern_for(w.type);
    w.places = 1;
    for (int i = 2; i < x->shape.n; i++) w.places *= (size_t)x->shape.d[i];
    w.block = w.channels ? BLOCK / w.channels / STRIP * STRIP : DAR_PIECE;
    if (w.block < STRIP) w.block = STRIP;
    if (w.block > DAR_PIECE) w.block = DAR_PIECE;
    w.blocks = (w.places + w.block - 1) / w.block;
    w.part = w.scratch = dar_mul_size(w.channels, dar_dtype_size(w.type));
    if (c->gx[W].data) w.scratch = dar_add_size(w.part, dar_mul_size(tasks(&w), w.part));
    return w;
}

static struct block block_of(const struct walk *w, size_t i)
{
    size_t first = i % w->blocks * w->block, left = w->places - first;
    return (struct block){ i / w->blocks, first, left < w->block ? left : w->block };
}

static void *place(const struct walk *w, const struct block *b, const dar_tensor *x, size_t channel)
{
    return dar_tensor_at(x, (b->clip * w->channels + channel) * w->places + b->first);
}

static void convert_weights(const struct walk *w)
{
    dar_row_convert(w->type, w->c->scratch, w->c->x[W].dtype, w->c->x[W].data, w->channels);
}

static double weight(const struct walk *w, size_t channel)
{
    return dar_dtype_get(w->type, w->c->scratch, channel);
}

/* r = sqrt(C) / max(||x||, 1e-12) from excess = ||x||^2 - 1e-24. */
static void scale_of(const struct walk *w, size_t n, const void *excess, void *r)
{
    w->k->relu(n, excess, r);
    w->k->offset(n, LEAST, r, r);
    w->k->rsqrt(n, r, r);
    w->k->scale(n, sqrt((double)w->channels), r, r);
}

/* ---------------------------------------------------------------- forward */

static void forward_block(void *ctx, size_t i, int thread)
{
    const struct walk *w = ctx;
    const dar_tensor *x = &w->c->x[X], *y = &w->c->y, *aux = &w->c->aux;
    struct block b = block_of(w, i);
    double excess[DAR_PIECE], r[DAR_PIECE];
    (void)thread;

    w->k->column_sums[x->dtype](w->channels, b.n, w->places, NULL, place(w, &b, x, 0), NULL, excess);
    w->k->offset(b.n, -LEAST, excess, excess);
    scale_of(w, b.n, excess, r);
    if (aux->data)
        dar_row_put(w->type, excess, aux->dtype, dar_tensor_at(aux, b.clip * w->places + b.first), b.n, DAR_PUT);
    for (size_t c = 0; c < w->channels; c++)
        w->k->column_norm[x->dtype](b.n, weight(w, c), r, place(w, &b, x, c), place(w, &b, y, c),
                                    w->mode == DAR_PUT_STREAM);
}

static void channel_norm_forward(const dar_opctx *c)
{
    struct walk w = walk_of(c);
    w.mode = dar_put_for(dar_tensor_bytes(&c->y), false);
    convert_weights(&w);
    dar_parallel(tasks(&w), forward_block, &w);
}

/* ---------------------------------------------------------------- backward */

static char *part_of(const struct walk *w, size_t i)
{
    return (char *)w->c->scratch + w->part + i * w->part;
}

/* gx = w gy r - x r^3 / C Σ w gy x; where the norm is at its least, it is constant and the second part 0.  The gradient
 * of w comes with it. */
static void backward_block(void *ctx, size_t i, int thread)
{
    const struct walk *w = ctx;
    const dar_tensor *x = &w->c->x[X], *gy = &w->c->gy, *gx = &w->c->gx[X], *aux = &w->c->aux;
    struct block b = block_of(w, i);
    double r[DAR_PIECE], q[DAR_PIECE], buf[DAR_PIECE];
    const void *excess = dar_tensor_at(aux, b.clip * w->places + b.first);
    (void)thread;

    scale_of(w, b.n, excess, r);
    w->k->column_sums[x->dtype](w->channels, b.n, w->places, w->c->scratch, place(w, &b, x, 0), place(w, &b, gy, 0), q);
    w->k->relu_back(b.n, excess, q, q);
    for (int power = 0; power < 3; power++) w->k->mul(b.n, q, r, q);
    w->k->scale(b.n, -1 / (double)w->channels, q, q);
    for (size_t c = 0; c < w->channels; c++) {
        void *dst = gx->data ? place(w, &b, gx, c) : NULL, *to = w->mode == DAR_PUT_ADD || !dst ? buf : dst;
        double sum = w->k->column_back[x->dtype](b.n, weight(w, c), r, q, place(w, &b, x, c), place(w, &b, gy, c), to,
                                                 w->mode == DAR_PUT_STREAM);
        if (dst) dar_row_put(w->type, to, gx->dtype, dst, b.n, w->mode);
        if (w->c->gx[W].data) dar_dtype_set(w->type, part_of(w, i), c, sum);
    }
}

static void channel_norm_backward(const dar_opctx *c)
{
    struct walk w = walk_of(c);
    dar_groups all = { .clips = 1, .tokens = tasks(&w), .rows = 1, .chunk = 1 };
    if (c->gx[X].data) w.mode = dar_put_for(dar_tensor_bytes(&c->gx[X]), c->add[X]);
    convert_weights(&w);
    dar_parallel(tasks(&w), backward_block, &w);
    if (c->gx[W].data) dar_groups_combine(&all, w.type, part_of(&w, 0), w.channels, &c->gx[W], c->add[W]);
}

/* ---------------------------------------------------------------- the op */

static size_t channel_norm_scratch(const dar_opctx *c, bool backward)
{
    (void)backward;
    return walk_of(c).scratch;
}

static dar_shape channel_norm_shape(const dar_shape *in, int n_in, const void *attr)
{
    char a[96], b[96];
    (void)n_in, (void)attr;
    DAR_ASSERT(in[X].n >= 3 && in[W].n == 1 && in[W].d[0] == in[X].d[1], "channel_norm: x is %s [B, C, ..], w is %s",
               dar_shape_text(&in[X], a, sizeof a), dar_shape_text(&in[W], b, sizeof b));
    return in[X];
}

/* ||x||^2 - 1e-24 at every place. */
static dar_shape channel_norm_aux(const dar_shape *in, int n_in, const void *attr)
{
    dar_shape s = in[X];
    (void)n_in, (void)attr;
    s.d[1] = 1;
    return s;
}

static double channel_norm_terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    double places = 1;
    (void)n_in, (void)attr;
    for (int i = 0; i < in[X].n; i++) places *= i == 1 ? 1 : (double)in[X].d[i];
    return of == W ? places : (double)in[X].d[1];
}

static const dar_sample channel_norm_samples[] = {
    { .in = { { 5, { 2, 3, 2, 3, 5 } }, { 1, { 3 } } } },
    { .in = { { 3, { 1, 40, 7 } }, { 1, { 40 } } } },      /* two runs */
    { .in = { { 4, { 1, 2, 1, 1 } }, { 1, { 2 } } } },     /* one place */
    { .in = { { 3, { 1, 1030, 66 } }, { 1, { 1030 } } } }, /* two blocks, pieces of channels */
    { .in = { { 4, { 1, 5, 40, 60 } }, { 1, { 5 } } } },   /* several blocks */
};

static const dar_error_sample channel_norm_errors[] = {
    { .in = { { 2, { 2, 3 } }, { 1, { 3 } } } },
    { .in = { { 3, { 2, 3, 4 } }, { 1, { 4 } } } },
};

const dar_op dar_op_channel_norm = {
    .name = "channel_norm",
    .n_in = 2,
    .keep = DAR_KEEP_X(X) | DAR_KEEP_X(W),
    .shape = channel_norm_shape,
    .aux = channel_norm_aux,
    .scratch = channel_norm_scratch,
    .terms = channel_norm_terms,
    .forward = channel_norm_forward,
    .backward = channel_norm_backward,
    .samples = channel_norm_samples,
    .n_samples = DAR_COUNT(channel_norm_samples),
    .errors = channel_norm_errors,
    .n_errors = DAR_COUNT(channel_norm_errors),
};

dar_val *dar_channel_norm(dar_tape *t, dar_val *x, dar_val *w)
{
    return dar_apply(t, &dar_op_channel_norm, (dar_val *[]){ x, w }, 2, NULL);
}
