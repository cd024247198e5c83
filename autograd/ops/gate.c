/* gate.c: the gated residual of a transformer block. */
#include <string.h>

#include "autograd/groups.h"
#include "autograd/ops.h"
#include "lib/kern.h"
#include "lib/thread.h"

#define CHUNK 65536 /* elements per task of forward */

enum { X, U, G };

struct walk {
    const dar_opctx *c;
    dar_dtype type;
    const dar_kern *k;
    size_t d, row; /* D; its bytes in the arithmetic type */
    dar_groups groups;
    dar_put mode[2]; /* of y; of gx[X], gx[U] */

    /* Scratch: gates [groups, D] in the arithmetic type, then, at `part`, partial sums [chunks, D] of their gradient.
     */
    size_t part, scratch;
};

static struct walk walk_of(const dar_opctx *c, bool backward)
{
    const dar_gate_attr *a = c->attr;
    const dar_shape *s = &c->x[X].shape;
    struct walk w = { .c = c, .type = dar_op_compute(c), .d = dar_tensor_cols(&c->x[X]) };

    w.k = dar_kern_for(w.type);
    w.row = dar_mul_size(w.d, dar_dtype_size(w.type));
    w.groups = dar_groups_of((size_t)s->d[0], (size_t)s->d[1], (size_t)c->x[G].shape.d[1], (size_t)a->split, w.d);
    w.groups.first = (size_t)a->first;
    w.part = w.scratch = dar_mul_size(w.groups.clips * w.groups.rows, w.row);
    if (backward && c->gx[G].data)
        w.scratch = dar_add_size(w.scratch, dar_mul_size(dar_groups_chunks(&w.groups), w.row));
    return w;
}

static void convert_gates(const struct walk *w)
{
    dar_row_convert(w->type, w->c->scratch, w->c->x[G].dtype, w->c->x[G].data, dar_tensor_count(&w->c->x[G]));
}

static void *gate_at(const struct walk *w, size_t group, size_t column)
{
    return (char *)w->c->scratch + group * w->row + column * dar_dtype_size(w->type);
}

/* Elements of a piece that starts at column j. */
static size_t piece(const struct walk *w, size_t j)
{
    return w->d - j < DAR_PIECE ? w->d - j : DAR_PIECE;
}

static void forward_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const struct walk *w = ctx;
    const dar_tensor *x = &w->c->x[X], *u = &w->c->x[U], *y = &w->c->y;
    double xbuf[DAR_PIECE], ubuf[DAR_PIECE];
    (void)thread;
    for (size_t row = begin; row < end; row++) {
        size_t group = dar_group_of(&w->groups, row);
        for (size_t j = 0, n; j < w->d; j += n) {
            size_t i = row * w->d + j;
            n = piece(w, j);
            const void *xs = dar_row_get(w->type, x->dtype, dar_tensor_at(x, i), n, xbuf);
            const void *us = dar_row_get(w->type, u->dtype, dar_tensor_at(u, i), n, ubuf);
            void *to = dar_row_out(w->type, y->dtype, dar_tensor_at(y, i), w->mode[0], xbuf);
            w->k->mul_add(n, gate_at(w, group, j), us, xs, to);
            dar_row_put(w->type, to, y->dtype, dar_tensor_at(y, i), n, w->mode[0]);
        }
    }
}

static void gate_forward(const dar_opctx *c)
{
    struct walk w = walk_of(c, false);
    if (!w.d) return;
    w.mode[0] = dar_put_for(dar_tensor_bytes(&c->y), false);
    convert_gates(&w);
    dar_parallel_range(dar_tensor_rows(&c->x[X]), CHUNK / w.d + 1, forward_rows, &w);
}

static void backward_piece(const struct walk *w, size_t row, size_t j, size_t group, char *part)
{
    const dar_tensor *u = &w->c->x[U], *gy = &w->c->gy, *gx = &w->c->gx[X], *gu = &w->c->gx[U];
    size_t i = row * w->d + j, n = piece(w, j);
    double gbuf[DAR_PIECE], ubuf[DAR_PIECE];
    const void *g = dar_row_get(w->type, gy->dtype, dar_tensor_at(gy, i), n, gbuf);

    if (gx->data && gx->data != gy->data) dar_row_put(w->type, g, gx->dtype, dar_tensor_at(gx, i), n, w->mode[0]);
    if (part) {
        void *sum = part + j * dar_dtype_size(w->type);
        w->k->mul_add(n, dar_row_get(w->type, u->dtype, dar_tensor_at(u, i), n, ubuf), g, sum, sum);
    }
    if (gu->data) {
        void *to = dar_row_out(w->type, gu->dtype, dar_tensor_at(gu, i), w->mode[1], ubuf);
        w->k->mul(n, gate_at(w, group, j), g, to);
        dar_row_put(w->type, to, gu->dtype, dar_tensor_at(gu, i), n, w->mode[1]);
    }
}

static void backward_chunk(void *ctx, size_t i, int thread)
{
    const struct walk *w = ctx;
    dar_chunk chunk = dar_groups_chunk(&w->groups, i);
    char *part = w->c->gx[G].data ? (char *)w->c->scratch + w->part + i * w->row : NULL;
    (void)thread;
    if (part) memset(part, 0, w->row);
    for (size_t row = chunk.begin; row < chunk.end; row++)
        for (size_t j = 0; j < w->d; j += DAR_PIECE) backward_piece(w, row, j, chunk.group, part);
}

static void gate_backward(const dar_opctx *c)
{
    struct walk w = walk_of(c, true);
    for (int i = 0; i < 2; i++)
        if (c->gx[i].data) w.mode[i] = dar_put_for(dar_tensor_bytes(&c->gx[i]), c->add[i]);
    convert_gates(&w);
    if (w.d) dar_parallel(dar_groups_chunks(&w.groups), backward_chunk, &w);
    if (c->gx[G].data) dar_groups_combine(&w.groups, w.type, (char *)c->scratch + w.part, w.d, &c->gx[G], c->add[G]);
}

static size_t gate_scratch(const dar_opctx *c, bool backward)
{
    return walk_of(c, backward).scratch;
}

static double gate_terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    (void)n_in, (void)attr;
    return of == G ? (double)in[X].d[1] : 2;
}

static dar_shape gate_shape(const dar_shape *in, int n_in, const void *attr)
{
    const dar_gate_attr *o = attr;
    char a[96], b[96];
    (void)n_in;
    DAR_ASSERT(in[X].n == 3 && dar_shape_equal(&in[U], &in[X]), "gate: x is %s [B, N, D], u is %s",
               dar_shape_text(&in[X], a, sizeof a), dar_shape_text(&in[U], b, sizeof b));
    DAR_ASSERT(in[G].n == 3 && in[G].d[0] == in[X].d[0] && in[G].d[1] >= 1 && in[G].d[2] == in[X].d[2],
               "gate: x is %s [B, N, D], g is %s, expected [B, R, D]", dar_shape_text(&in[X], a, sizeof a),
               dar_shape_text(&in[G], b, sizeof b));
    DAR_ASSERT(o->first >= 0 && (o->split > 0 || in[G].d[1] == 1),
               "gate: %lld rows need a split, and a place from 0 on", (long long)in[G].d[1]);
    return in[X];
}

static const dar_gate_attr unsplit = { 0 }, split_3 = { .split = 3 }, split_9 = { .split = 9 },
                           split_66 = { .split = 66 }, later = { .split = 3, .first = 2 },
                           later_still = { .split = 3, .first = 7 };

#define GATE(B, N, R, D)                                                                                               \
    {                                                                                                                  \
        { 3, { B, N, D } }, { 3, { B, N, D } },                                                                        \
        {                                                                                                              \
            3,                                                                                                         \
            {                                                                                                          \
                B, R, D                                                                                                \
            }                                                                                                          \
        }                                                                                                              \
    }

static const dar_sample gate_samples[] = {
    { .in = GATE(2, 5, 1, 9), .attr = &unsplit },     /* one row for all */
    { .in = GATE(2, 5, 2, 19), .attr = &split_3 },    /* the first three tokens have their own */
    { .in = GATE(1, 8, 4, 7), .attr = &split_3 },     /* a row for each frame; the last frame is short */
    { .in = GATE(2, 5, 2, 3), .attr = &split_9 },     /* a row that nobody uses */
    { .in = GATE(1, 2, 1, 1030), .attr = &unsplit },  /* pieces of columns */
    { .in = GATE(1, 68, 2, 129), .attr = &split_66 }, /* several chunks in each group */
    { .in = GATE(2, 5, 3, 7), .attr = &later },       /* a piece of a clip: its first token is the third */
    { .in = GATE(1, 5, 2, 7), .attr = &later_still }, /* and one that begins after the first row's */
};

static const dar_error_sample gate_errors[] = {
    { .in = GATE(2, 5, 2, 3), .attr = &unsplit },
    { .in = GATE(2, 5, 2, 3), .attr = &(const dar_gate_attr){ .split = 3, .first = -1 } },
    { .in = { { 3, { 2, 5, 3 } }, { 3, { 2, 4, 3 } }, { 3, { 2, 1, 3 } } }, .attr = &unsplit },
    { .in = { { 3, { 2, 5, 3 } }, { 3, { 2, 5, 3 } }, { 3, { 1, 1, 3 } } }, .attr = &unsplit },
};

const dar_op dar_op_gate = {
    .name = "gate",
    .n_in = 3,
    .in_place = true,
    .keep = DAR_KEEP_X(U) | DAR_KEEP_X(G),
    .half = DAR_KEEP_X(X) | DAR_KEEP_X(U) | DAR_KEEP_Y,
    .attr_size = sizeof(dar_gate_attr),
    .shape = gate_shape,
    .scratch = gate_scratch,
    .terms = gate_terms,
    .forward = gate_forward,
    .backward = gate_backward,
    .samples = gate_samples,
    .n_samples = DAR_COUNT(gate_samples),
    .errors = gate_errors,
    .n_errors = DAR_COUNT(gate_errors),
};

dar_val *dar_gate(dar_tape *t, dar_val *x, dar_val *u, dar_val *g, dar_gate_attr a)
{
    return dar_apply(t, &dar_op_gate, (dar_val *[]){ x, u, g }, 3, &a);
}
