/* channel_norm.c: the norm of the VAE, over channels that are strided in memory.
 *
 * Work goes by blocks of places.  The first pass brings all channels of a block together in scratch of the thread,
 * which the second-level cache holds (where they lie, their distance is often a power of two, and they would push each
 * other out); the second pass reads no memory.  Within a block every channel is a row, and what belongs to a place
 * (norm, products) is a row too. */
#include <math.h>
#include <string.h>

#include "autograd/groups.h"
#include "autograd/ops.h"
#include "lib/kern.h"
#include "lib/thread.h"

#define BLOCK 65536 /* elements of a block, at most, unless there are more than 1024 channels */
#define RUN   32    /* channels added in a row; then the sums of the runs: short sums lose less */
#define AHEAD 4     /* channels asked for before they are needed: no prefetcher follows from one to the next */
#define LEAST 1e-24 /* of a squared norm */

enum { X, W };

struct walk {
    const dar_opctx *c;
    dar_dtype type;
    const dar_kern *k;
    size_t channels, places, block, blocks; /* of one clip */
    dar_put mode;
    size_t staged;  /* bytes of one tensor's block in scratch; each thread has two */
    size_t scratch; /* in all; partial sums for the gradient of w, [clips blocks, C], are at the end */
    size_t part;    /* where; 0: that gradient is not wanted */
};

/* Places [first, first + n) of clip `clip`. */
struct block {
    size_t clip, first, n;
    char *staged[2]; /* [C, n] of x, of gy */
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
    w.block = w.channels ? BLOCK / w.channels / 64 * 64 : DAR_PIECE;
    if (w.block < 64) w.block = 64;
    if (w.block > DAR_PIECE) w.block = DAR_PIECE;
    w.blocks = (w.places + w.block - 1) / w.block;
    w.staged = dar_mul_size(w.channels, w.block * dar_dtype_size(w.type));
    w.scratch = dar_mul_size(2 * (size_t)c->threads, w.staged);
    if (c->gx[W].data) {
        w.part = w.scratch;
        w.scratch = dar_add_size(w.scratch, dar_mul_size(tasks(&w), w.channels * dar_dtype_size(w.type)));
    }
    return w;
}

static struct block block_of(const struct walk *w, size_t i, int thread)
{
    size_t first = i % w->blocks * w->block, left = w->places - first;
    char *own = (char *)w->c->scratch + 2 * (size_t)thread * w->staged;
    return (struct block){ i / w->blocks, first, left < w->block ? left : w->block, { own, own + w->staged } };
}

static void *place(const struct walk *w, const struct block *b, const dar_tensor *x, size_t channel)
{
    return dar_tensor_at(x, (b->clip * w->channels + channel) * w->places + b->first);
}

static char *staged(const struct walk *w, const struct block *b, int which, size_t channel)
{
    return b->staged[which] + channel * b->n * dar_dtype_size(w->type);
}

/* Bring a channel of the block into scratch. */
static const void *stage(const struct walk *w, const struct block *b, int which, const dar_tensor *x, size_t channel)
{
    void *row = staged(w, b, which, channel);
    if (channel + AHEAD < w->channels) dar_row_ahead(place(w, b, x, channel + AHEAD), b->n * dar_dtype_size(x->dtype));
    dar_row_convert(w->type, row, x->dtype, place(w, b, x, channel), b->n);
    return row;
}

static double weight(const struct walk *w, size_t channel)
{
    return dar_dtype_get(w->c->x[W].dtype, w->c->x[W].data, channel);
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

/* ||x||^2 - 1e-24 at every place. */
static void squares(const struct walk *w, const struct block *b, void *excess)
{
    const dar_tensor *x = &w->c->x[X];
    size_t bytes = b->n * dar_dtype_size(w->type);
    double run[DAR_PIECE];

    memset(excess, 0, bytes);
    for (size_t c = 0; c < w->channels;) {
        memset(run, 0, bytes);
        for (size_t end = c + RUN < w->channels ? c + RUN : w->channels; c < end; c++) {
            const void *row = stage(w, b, 0, x, c);
            w->k->mul_add(b->n, row, row, run, run);
        }
        w->k->add(b->n, excess, run, excess);
    }
    w->k->offset(b->n, -LEAST, excess, excess);
}

static void forward_block(void *ctx, size_t i, int thread)
{
    const struct walk *w = ctx;
    const dar_tensor *y = &w->c->y, *aux = &w->c->aux;
    struct block b = block_of(w, i, thread);
    double excess[DAR_PIECE], r[DAR_PIECE], buf[DAR_PIECE];

    squares(w, &b, excess);
    scale_of(w, b.n, excess, r);
    if (aux->data)
        dar_row_put(w->type, excess, aux->dtype, dar_tensor_at(aux, b.clip * w->places + b.first), b.n, DAR_PUT);
    for (size_t c = 0; c < w->channels; c++) {
        void *to = dar_row_out(w->type, y->dtype, place(w, &b, y, c), w->mode, buf);
        w->k->mul(b.n, staged(w, &b, 0, c), r, to);
        w->k->scale(b.n, weight(w, c), to, to);
        dar_row_put(w->type, to, y->dtype, place(w, &b, y, c), b.n, w->mode);
    }
}

static void channel_norm_forward(const dar_opctx *c)
{
    struct walk w = walk_of(c);
    w.mode = dar_put_for(dar_tensor_bytes(&c->y), false);
    dar_parallel(tasks(&w), forward_block, &w);
}

/* ---------------------------------------------------------------- backward */

/* dot = sum over channels of w gy x at every place; the block's part of the gradient of w. */
static void products(const struct walk *w, const struct block *b, const void *r, void *dot, char *part)
{
    const dar_tensor *x = &w->c->x[X], *gy = &w->c->gy;
    size_t size = dar_dtype_size(w->type), bytes = b->n * size;
    double buf[DAR_PIECE], run[DAR_PIECE];

    memset(dot, 0, bytes);
    for (size_t c = 0; c < w->channels;) {
        memset(run, 0, bytes);
        for (size_t end = c + RUN < w->channels ? c + RUN : w->channels; c < end; c++) {
            w->k->mul(b->n, stage(w, b, 0, x, c), stage(w, b, 1, gy, c), buf);
            if (part) dar_dtype_set(w->type, part, c, w->k->dot(b->n, buf, r));
            w->k->axpy(b->n, weight(w, c), buf, run);
        }
        w->k->add(b->n, dot, run, dot);
    }
}

static char *part_of(const struct walk *w, size_t i)
{
    return w->part ? (char *)w->c->scratch + w->part + i * w->channels * dar_dtype_size(w->type) : NULL;
}

/* gx = w gy r - x r^3 / C dot; where the norm is at its least, it is constant and the second part 0. */
static void backward_block(void *ctx, size_t i, int thread)
{
    const struct walk *w = ctx;
    const dar_tensor *gx = &w->c->gx[X], *aux = &w->c->aux;
    struct block b = block_of(w, i, thread);
    double r[DAR_PIECE], q[DAR_PIECE], buf[DAR_PIECE];
    const void *excess = dar_tensor_at(aux, b.clip * w->places + b.first);

    scale_of(w, b.n, excess, r);
    products(w, &b, r, q, part_of(w, i));
    if (!gx->data) return;
    w->k->relu_back(b.n, excess, q, q);
    for (int power = 0; power < 3; power++) w->k->mul(b.n, q, r, q);
    w->k->scale(b.n, -1 / (double)w->channels, q, q);
    for (size_t c = 0; c < w->channels; c++) {
        void *to = dar_row_out(w->type, gx->dtype, place(w, &b, gx, c), w->mode, buf), *g = staged(w, &b, 1, c);
        w->k->mul(b.n, g, r, g);
        w->k->scale(b.n, weight(w, c), g, g);
        w->k->mul_add(b.n, staged(w, &b, 0, c), q, g, to);
        dar_row_put(w->type, to, gx->dtype, place(w, &b, gx, c), b.n, w->mode);
    }
}

static void channel_norm_backward(const dar_opctx *c)
{
    struct walk w = walk_of(c);
    dar_groups all = { .clips = 1, .tokens = tasks(&w), .rows = 1, .chunk = 1 };
    if (c->gx[X].data) w.mode = dar_put_for(dar_tensor_bytes(&c->gx[X]), c->add[X]);
    dar_parallel(tasks(&w), backward_block, &w);
    if (w.part) dar_groups_combine(&all, w.type, part_of(&w, 0), w.channels, &c->gx[W], c->add[W]);
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
