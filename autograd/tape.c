/* tape.c: calls, nodes, the backward sweep, segments. */
#include "autograd/tape.h"

#include <string.h>

#include "autograd/ops.h"
#include "lib/kern.h"
#include "lib/thread.h"

#define META_BYTES ((size_t)256 << 20) /* address space; pages are taken as they are used */
#define MAX_KEPT   8                   /* results one segment can keep */

struct kept {
    dar_tensor y, aux;
};

struct dar_keeping {
    int at; /* the next to be kept, or replayed */
    struct kept of[MAX_KEPT];
};

struct dar_node {
    dar_node *prev;
    dar_val *in[DAR_OP_IN];
    int n;
    dar_val *y;
    const dar_op *op; /* NULL: a segment */
    const void *attr;
    dar_tensor aux;
    bool own_aux; /* it is the tape's memory */
    bool over;    /* nothing that backward comes to later reads the value of input 0 */
    dar_segment_fn *fn;
    dar_rows_attr rows; /* of a segment in pieces: fn is NULL */
    void *arg;
    struct dar_keeping *kept; /* [pieces]; NULL: nothing */
    dar_mark keep, keep_end;  /* where in the keep arena its results lie */
};

/* ---------------------------------------------------------------- life */

dar_status dar_tape_init(dar_tape *t, dar_arena *arena, dar_err *e)
{
    memset(t, 0, sizeof *t);
    t->arena = arena;
    t->recording = true;
    return dar_arena_init(&t->meta, "tape", META_BYTES, e);
}

void dar_tape_free(dar_tape *t)
{
    dar_arena_free(&t->meta);
    memset(t, 0, sizeof *t);
}

void dar_tape_clear(dar_tape *t)
{
    dar_tape fresh = {
        .arena = t->arena, .keep = t->keep, .meta = t->meta, .recording = t->recording, .check_finite = t->check_finite
    };
    dar_arena_reset(&fresh.meta, 0);
    *t = fresh;
}

dar_tape_place dar_tape_mark(dar_tape *t)
{
    dar_tape_place p = { dar_arena_mark(t->arena), dar_arena_mark(&t->meta), t->spare, t->inside };
    t->inside = true;
    return p;
}

void dar_tape_reset(dar_tape *t, dar_tape_place p)
{
    DAR_ASSERT((unsigned char *)t->last < t->meta.base + p.meta, "tape: a reset of what is recorded");
    dar_arena_reset(t->arena, p.arena);
    dar_arena_reset(&t->meta, p.meta);
    t->spare = p.spare;
    t->inside = p.inside;
}

void *dar_tape_room(dar_tape *t, size_t bytes)
{
    return memset(dar_arena_push(&t->meta, bytes), 0, bytes);
}

void *dar_tape_store(dar_tape *t, const void *data, size_t bytes)
{
    return memcpy(dar_arena_push(&t->meta, bytes), data, bytes);
}

/* ---------------------------------------------------------------- memory */

static dar_tensor take(dar_tape *t, dar_dtype type, dar_shape s)
{
    dar_tensor x = dar_tensor_of(type, s, NULL);
    x.data = dar_spare_take(&t->spare, t->arena, dar_tensor_bytes(&x));
    return x;
}

static void give(dar_tape *t, void *data, size_t bytes)
{
    const dar_arena *k = t->keep;
    dar_spare_give(&t->spare, data, bytes,
                   k && (unsigned char *)data >= k->base && (unsigned char *)data < k->base + k->size);
}

static void give_value(dar_tape *t, dar_val *v)
{
    if (v->own) give(t, v->x.data, dar_tensor_bytes(&v->x));
    v->own = false;
}

void dar_drop(dar_tape *t, dar_val *v)
{
    if (!t->inside || !v->own || v->read) return;
    give_value(t, v);
    v->x.data = NULL;
}

static dar_val *push_val(dar_tape *t, dar_tensor x)
{
    dar_val *v = dar_tape_room(t, sizeof *v);
    v->x = x;
    return v;
}

dar_val *dar_leaf(dar_tape *t, dar_tensor x, const dar_tensor *g)
{
    dar_val *v = push_val(t, x);
    v->leaf = true;
    if (g) {
        DAR_ASSERT(dar_shape_equal(&g->shape, &x.shape) && dar_tensor_contiguous(g) &&
                       g->dtype == dar_compute_type(x.dtype),
                   "leaf: the gradient is not a contiguous %s of the value's shape",
                   dar_dtype_name(dar_compute_type(x.dtype)));
        v->g = *g;
        v->wants_grad = v->has_grad = true;
    }
    return v;
}

dar_val *dar_input(dar_tape *t, dar_dtype type, dar_shape s)
{
    dar_val *v = push_val(t, dar_tensor_push(t->arena, type, s));
    v->leaf = true;
    return v;
}

/* ---------------------------------------------------------------- a call */

static void look(dar_tape *t, const char *name, const dar_tensor *x, bool backward)
{
    if (!t->check_finite || t->bad_op || t->arena->plan) return;
    int64_t at = dar_tensor_nonfinite(x);
    if (at >= 0) {
        t->bad_op = name;
        t->bad_backward = backward;
        t->bad_index = at;
    }
}

static void run(dar_tape *t, const dar_op *op, dar_opctx *c, bool backward)
{
    dar_mark m = dar_arena_mark(t->arena);
    c->threads = dar_threads();
    size_t scratch = op->scratch ? op->scratch(c, backward) : 0;
    void *spare = scratch ? dar_spare_take(&t->spare, NULL, scratch) : NULL;
    c->scratch = spare ? spare : dar_arena_push(t->arena, scratch);
    if (op->flops) *(backward ? &t->cost.backward : &t->cost.forward) += op->flops(c, backward);
    t->cost.ops++;
    if (!t->arena->plan) (backward ? op->backward : op->forward)(c);
    if (spare) give(t, spare, scratch);
    dar_arena_reset(t->arena, m);
}

static bool grad_goes_to(const dar_op *op, const dar_val *v, int i)
{
    return v && v->wants_grad && !(op->frozen & DAR_KEEP_X(i));
}

/* A value from outside a segment would get its gradient in memory that the replay gives back. */
static void check_origin(const dar_tape *t, const dar_val *v)
{
    DAR_ASSERT(!v || !v->wants_grad || v->leaf || (const void *)v >= t->oldest,
               "segment: fn uses a value that is neither its input nor a leaf");
}

static void check_inputs(const dar_tape *t, const dar_op *op, dar_val *const *in, int n)
{
    int least = op->variadic ? 1 : op->n_in - op->n_optional;
    DAR_ASSERT(n >= least && n <= op->n_in, "%s: %d inputs, expected %d to %d", op->name, n, least, op->n_in);
    for (int i = 0; i < n; i++) {
        DAR_ASSERT(in[i] || (i >= least && !op->variadic), "%s: input %d is NULL", op->name, i);
        check_origin(t, in[i]);
        DAR_ASSERT(!grad_goes_to(op, in[i], i) || dar_compute_type(in[i]->x.dtype) == dar_compute_type(in[0]->x.dtype),
                   "%s: input %d is %s and wants a gradient, input 0 is %s", op->name, i,
                   dar_dtype_name(in[i]->x.dtype), dar_dtype_name(in[0]->x.dtype));
    }
}

static void fill_inputs(dar_opctx *c, dar_val *const *in, int n)
{
    for (int i = 0; i < DAR_OP_IN; i++) {
        if (i < n && in[i]) c->x[i] = in[i]->x;
        else c->x[i].shape.n = -1;
    }
}

/* How a call differs from a plain one. */
struct how {
    dar_arena *y, *aux;       /* where these go */
    bool save;                /* aux is made even though nothing is recorded */
    const struct kept *ready; /* y and aux are known from before */
    struct kept *made;        /* gets y and aux */
};

/* In a replay: an input without value (DAR_KEEP_AUX). */
static bool lost(const dar_tape *t, dar_val *const *in, int n)
{
    bool any = false;
    for (int i = 0; i < n; i++) any |= in[i] && !in[i]->x.data;
    return any && t->replaying;
}

static dar_tensor room_for(dar_tape *t, dar_arena *a, dar_dtype type, dar_shape s)
{
    return a == t->arena ? take(t, type, s) : dar_tensor_push(a, type, s);
}

/* y and, where backward will want it, aux: computed, or known from before. */
static void compute(dar_tape *t, const dar_op *op, dar_opctx *c, int n, bool without, const struct how *how)
{
    dar_shape shape[DAR_OP_IN];
    dar_dtype type[DAR_OP_IN];

    if (how->ready) {
        c->y = how->ready->y;
        c->aux = how->ready->aux;
        return;
    }
    if (op->view) {
        c->y = op->view(&c->x[0], c->attr);
        return;
    }
    for (int i = 0; i < DAR_OP_IN; i++) {
        shape[i] = c->x[i].shape;
        type[i] = c->x[i].dtype;
    }
    c->y = dar_tensor_of(op->dtype ? op->dtype(type, n, c->attr) : type[0], op->shape(shape, n, c->attr), NULL);
    DAR_ASSERT(!without || !op->aux, "%s: an input has no value in the replay, and backward needs it", op->name);
    if (without) return;
    c->y = room_for(t, how->y, c->y.dtype, c->y.shape);
    if (op->aux && how->save) c->aux = room_for(t, how->aux, dar_op_compute(c), op->aux(shape, n, c->attr));
    run(t, op, c, false);
    look(t, op->name, &c->y, false);
}

/* A call will give v a gradient, recorded now or in the replay of a segment: where segments begin and end changes no
 * type. */
static void gives_grad(dar_val *v, bool half)
{
    v->half &= half && !v->given;
    v->given = true;
}

static void push_node(dar_tape *t, const dar_op *op, const dar_opctx *c, dar_val *const *in, int n, dar_val *y,
                      bool own_aux)
{
    dar_node *node = dar_tape_room(t, sizeof *node);
    void *attr = op->attr_size ? dar_tape_store(t, c->attr, op->attr_size) : NULL;
    *node = (dar_node){ .prev = t->last, .n = n, .y = y, .op = op, .attr = attr, .aux = c->aux, .own_aux = own_aux };
    memcpy(node->in, in, (size_t)n * sizeof *in);
    node->over = op->over && !in[0]->read;
    for (int i = 0; i < n; i++) {
        if (in[i] && op->keep & DAR_KEEP_X(i)) in[i]->read = true;
        if (i && in[i] == in[0]) node->over = false;
    }
    y->read = op->keep & DAR_KEEP_Y;
    t->last = node;
}

static dar_val *call(dar_tape *t, const dar_op *op, dar_val *const *given, int n, const void *attr, struct how how)
{
    dar_val *in[DAR_OP_IN] = { 0 };
    dar_opctx c = { .attr = attr };
    bool wants = false;

    check_inputs(t, op, given, n);
    for (int i = 0; i < n; i++) {
        in[i] = given[i];
        if (in[i] && !op->strided && !dar_tensor_contiguous(&in[i]->x)) in[i] = dar_contiguous(t, in[i]);
        if (!grad_goes_to(op, in[i], i)) continue;
        gives_grad(in[i], op->half & DAR_KEEP_X(i));
        wants = true;
    }
    t->touched |= wants;
    wants &= t->recording;
    DAR_ASSERT(!wants || op->backward || op->view, "%s: no gradient: %s", op->name, op->no_backward);
    fill_inputs(&c, in, n);
    how.save |= wants;
    compute(t, op, &c, n, lost(t, in, n), &how);
    dar_val *y = push_val(t, c.y);
    y->wants_grad = wants;
    y->half = op->half & DAR_KEEP_Y;
    y->own = y->x.data && !op->view && !how.ready && how.y == t->arena;
    if (op->view) in[0]->read = true;
    if (wants) push_node(t, op, &c, in, n, y, c.aux.data && !how.ready && how.aux == t->arena);
    if (how.made) *how.made = (struct kept){ c.y, c.aux };
    return y;
}

dar_val *dar_apply(dar_tape *t, const dar_op *op, dar_val *const *in, int n, const void *attr)
{
    return call(t, op, in, n, attr, (struct how){ .y = t->arena, .aux = t->arena });
}

/* ---------------------------------------------------------------- backward */

static dar_dtype grad_type(const dar_val *v)
{
    return v->half && v->x.dtype == DAR_BF16 ? DAR_BF16 : dar_compute_type(v->x.dtype);
}

static void ensure_grad(dar_tape *t, dar_val *v)
{
    if (!v->g.data) v->g = take(t, grad_type(v), v->x.shape);
}

static void release_grad(dar_tape *t, dar_val *v)
{
    if (v->leaf || !v->g.data) return;
    if (!v->lent) give(t, v->g.data, dar_tensor_bytes(&v->g));
    v->g.data = NULL;
    v->has_grad = v->lent = false;
}

static void view_backward(dar_tape *t, const dar_node *node)
{
    dar_val *x = node->in[0], *y = node->y;
    bool whole = dar_tensor_count(&x->x) == dar_tensor_count(&y->x);

    if (whole && !x->g.data && !y->leaf && dar_tensor_contiguous(&x->x) && dar_tensor_contiguous(&y->x)) {
        x->g = dar_tensor_reshape(&y->g, x->x.shape); /* the same numbers in the same order: hand the buffer on */
        x->lent = y->lent;
        y->g.data = NULL;
    } else {
        ensure_grad(t, x);
        dar_tensor part = node->op->view(&x->g, node->attr);
        if (!x->has_grad && !whole && !t->arena->plan) dar_tensor_fill(&x->g, 0);
        if (!t->arena->plan) (x->has_grad ? dar_tensor_add : dar_tensor_copy)(&part, &y->g);
    }
    x->has_grad = true;
}

/* The gradient memory that an earlier input of the same call gets. */
static bool taken(const dar_opctx *c, int i, const dar_val *v)
{
    for (int j = 0; j < i; j++)
        if (c->gx[j].data == v->g.data) return true;
    return false;
}

/* Where an op works in place and nobody else has given x[0] a gradient yet, the buffer is handed on. */
static void hand_on(const dar_op *op, dar_val *x, dar_val *y)
{
    if (!op->in_place || !grad_goes_to(op, x, 0) || x->g.data || y->leaf) return;
    if (!dar_shape_equal(&x->x.shape, &y->x.shape) || grad_type(x) != y->g.dtype) return;
    x->g = y->g;
    x->lent = y->lent;
    y->g.data = NULL;
}

/* Where an op works over x[0] and nobody else reads that, its memory becomes the gradient's. */
static void lay_over(const dar_node *node)
{
    dar_val *x = node->in[0];
    if (!node->over || !grad_goes_to(node->op, x, 0) || x->g.data || !x->own) return;
    if (grad_type(x) != x->x.dtype || !dar_tensor_contiguous(&x->x)) return;
    x->g = x->x;
    x->own = false;
}

static void op_backward(dar_tape *t, const dar_node *node)
{
    const dar_op *op = node->op;
    dar_opctx c = { .attr = node->attr, .y = node->y->x, .aux = node->aux, .gy = node->y->g };
    bool apart[DAR_OP_IN] = { false };

    fill_inputs(&c, node->in, node->n);
    hand_on(op, node->in[0], node->y);
    lay_over(node);
    for (int i = 0; i < node->n; i++)
        if (grad_goes_to(op, node->in[i], i)) ensure_grad(t, node->in[i]);
    dar_mark m = dar_arena_mark(t->arena);
    for (int i = 0; i < node->n; i++) {
        dar_val *v = node->in[i];
        if (!grad_goes_to(op, v, i)) continue;
        apart[i] = taken(&c, i, v); /* one value as two inputs: the op need not know */
        c.gx[i] = apart[i] ? dar_tensor_push(t->arena, v->g.dtype, v->g.shape) : v->g;
        c.add[i] = !apart[i] && v->has_grad;
    }
    run(t, op, &c, true);
    for (int i = 0; i < node->n; i++) {
        if (!c.gx[i].data) continue;
        look(t, op->name, &c.gx[i], true);
        if (apart[i] && !t->arena->plan) dar_tensor_add(&node->in[i]->g, &c.gx[i]);
        node->in[i]->has_grad = true;
    }
    dar_arena_reset(t->arena, m);
}

static void sweep(dar_tape *t, const dar_val *from);

/* Where the tape stands before a segment, so that it can stand there again. */
struct place {
    dar_tape was;
    dar_mark arena, keep, meta;
};

static struct place enter(const dar_tape *t)
{
    return (struct place){ *t, dar_arena_mark(t->arena), t->keep ? dar_arena_mark(t->keep) : 0,
                           dar_arena_mark(&t->meta) };
}

/* Back to p: all that was pushed since is gone, what happened since is remembered. */
static void leave(dar_tape *t, const struct place *p)
{
    t->recording = p->was.recording;
    t->last = p->was.last;
    t->spare = p->was.spare;
    t->oldest = p->was.oldest;
    t->kept = p->was.kept;
    t->inside = p->was.inside;
    t->replaying = p->was.replaying;
    t->touched |= p->was.touched;
    dar_arena_reset(t->arena, p->arena);
    if (t->keep) dar_arena_reset(t->keep, p->keep);
    dar_arena_reset(&t->meta, p->meta);
}

static int64_t pieces_of(const dar_node *node)
{
    return node->fn ? 1 : dar_rows_count(&node->rows.shape, node->rows.most);
}

static bool is_cut(const dar_node *node, int i)
{
    return !node->fn && node->rows.cut & DAR_KEEP_X(i);
}

/* What the pieces of a segment find. */
struct found {
    bool had[DAR_OP_IN]; /* inputs with a gradient from others */
    bool pass;           /* the gradient of input 0 becomes what that of y was */
};

/* Where input 0 is like y and nobody else has given it a gradient yet, as around a residual, one buffer is enough. */
static bool passes(const dar_node *node)
{
    const dar_val *x = node->n ? node->in[0] : NULL, *y = node->y;
    if (!x || !x->wants_grad || x->g.data || !(node->fn || is_cut(node, 0))) return false;
    for (int i = 1; i < node->n; i++)
        if (node->in[i] == x) return false;
    return dar_shape_equal(&x->x.shape, &y->x.shape) && grad_type(x) == y->g.dtype;
}

/* Stand-ins for the segment's inputs, or for a piece of them, sharing value and gradient; the same value stays one
 * value. */
static void stand_in(dar_tape *t, const dar_node *node, const struct found *f, const dar_rows *rows, dar_val **in)
{
    for (int i = 0; i < node->n; i++) {
        for (int j = 0; j < i; j++)
            if (node->in[j] == node->in[i] && is_cut(node, j) == is_cut(node, i)) in[i] = in[j];
        if (!node->in[i] || in[i]) continue;
        in[i] = dar_tape_room(t, sizeof *in[i]);
        *in[i] = *node->in[i];
        in[i]->leaf = true; /* its memory is not the segment's to free */
        in[i]->own = in[i]->given = false;
        if (!is_cut(node, i)) continue;
        in[i]->x = dar_rows_view(&in[i]->x, *rows);
        if (in[i]->g.data) in[i]->g = dar_rows_view(&in[i]->g, *rows);
        in[i]->has_grad = f->had[i];
    }
}

/* The result is made inside, so that it has a gradient of its own. */
static dar_val *run_piece(dar_tape *t, const dar_node *node, dar_val *const *in, const dar_rows *rows)
{
    dar_val *y = node->fn ? node->fn(t, node->arg, in) : node->rows.fn(t, node->arg, in, *rows);
    bool inside = !y->leaf;
    for (int i = 0; i < node->n; i++) inside &= y != in[i];
    return inside ? y : dar_contiguous(t, y);
}

static void piece_backward(dar_tape *t, const dar_node *node, const struct found *f, int64_t i)
{
    dar_rows rows = node->fn ? (dar_rows){ 0 } : dar_rows_of(&node->rows.shape, node->rows.most, i);
    dar_tensor g = node->fn ? node->y->g : dar_rows_view(&node->y->g, rows);
    dar_val *in[DAR_OP_IN] = { 0 };
    struct place p = enter(t);

    t->inside = true;
    t->last = NULL;
    t->oldest = t->meta.base + t->meta.used;
    t->kept = t->keep && node->kept ? &node->kept[i] : NULL;
    if (t->kept) t->kept->at = 0;
    t->replaying = true;
    stand_in(t, node, f, &rows, in);
    dar_val *y = run_piece(t, node, in, &rows);
    y->g = g;
    y->lent = f->pass || !node->fn; /* a part of it is not free before the rest is */
    y->has_grad = true;
    sweep(t, NULL);
    if (f->pass && in[0]->g.data && in[0]->g.data != g.data && !t->arena->plan) dar_tensor_copy(&g, &in[0]->g);
    for (int k = 0; k < node->n; k++)
        if (in[k]) node->in[k]->has_grad = in[k]->has_grad;
    leave(t, &p);
}

static void segment_backward(dar_tape *t, const dar_node *node)
{
    struct found f = { .pass = passes(node) };
    dar_val *x = node->in[0], *y = node->y;

    for (int i = 0; i < node->n; i++) {
        dar_val *v = node->in[i];
        if (v && v->wants_grad && !(f.pass && i == 0)) ensure_grad(t, v); /* before the mark: it stays */
        f.had[i] = v && v->has_grad;
    }
    for (int64_t i = 0; i < pieces_of(node); i++) {
        if (f.pass) x->has_grad = false;
        piece_backward(t, node, &f, i);
    }
    if (!f.pass || !x->has_grad) return;
    x->g = y->g;
    x->lent = y->lent;
    y->g.data = NULL;
}

/* What only this node and what came after it have read is free. */
static void release(dar_tape *t, dar_node *node, const dar_val *from)
{
    if (node->y != from) {
        give_value(t, node->y);
        node->y->x.data = NULL;
    }
    if (node->own_aux) give(t, node->aux.data, dar_tensor_bytes(&node->aux));
    if (node->keep_end > node->keep) give(t, t->keep->base + node->keep, node->keep_end - node->keep);
    release_grad(t, node->y);
}

/* from: the value that backward began with, whose x stays; or NULL */
static void sweep(dar_tape *t, const dar_val *from)
{
    bool recording = t->recording;
    t->recording = true; /* for the replay of segments */
    for (dar_node *node = t->last; node; node = node->prev) {
        if (node->y->has_grad) {
            bool reads = node->op && node->op->keep & DAR_KEEP_Y;
            if (!reads && node->y != from) give_value(t, node->y);
            if (!node->op) segment_backward(t, node);
            else if (node->op->view) view_backward(t, node);
            else op_backward(t, node);
        }
        release(t, node, from);
        if (node->y == from && node->op && node->op->view) from = node->in[0]; /* whose memory it is */
    }
    t->last = NULL;
    t->recording = recording;
}

void dar_backward(dar_tape *t, dar_val *y, const dar_tensor *seed)
{
    DAR_ASSERT(y->wants_grad && !y->leaf, "backward: nothing that led here wants a gradient");
    DAR_ASSERT(seed || dar_tensor_count(&y->x) == 1, "backward: %zu elements need a seed", dar_tensor_count(&y->x));
    y->half = false;
    ensure_grad(t, y);
    if (!t->arena->plan) {
        if (seed) dar_tensor_copy(&y->g, seed);
        else dar_tensor_fill(&y->g, 1);
    }
    y->has_grad = true;
    sweep(t, y);
}

/* ---------------------------------------------------------------- segments */

int64_t dar_rows_count(const dar_shape *y, int64_t most)
{
    return y->d[0] * y->d[1] <= most ? 1 : y->d[0] * ((y->d[1] + most - 1) / most);
}

dar_rows dar_rows_of(const dar_shape *y, int64_t most, int64_t i)
{
    int64_t B = y->d[0], N = y->d[1], n = (N + most - 1) / most, k = i % n;
    if (B * N <= most) return (dar_rows){ 0, B, 0, N };
    return (dar_rows){ i / n, 1, N * k / n, N * (k + 1) / n - N * k / n };
}

dar_tensor dar_rows_view(const dar_tensor *x, dar_rows r)
{
    dar_tensor clips = dar_tensor_narrow(x, 0, r.clip, r.clips);
    return dar_tensor_narrow(&clips, 1, r.first, r.count);
}

/* Run piece i into its part of y. */
static void piece_forward(dar_tape *t, const dar_node *node, int64_t i)
{
    dar_rows rows = node->fn ? (dar_rows){ 0 } : dar_rows_of(&node->rows.shape, node->rows.most, i);
    dar_tensor y = node->fn ? node->y->x : dar_rows_view(&node->y->x, rows);
    dar_val *in[DAR_OP_IN] = { 0 };
    struct place p = enter(t);
    char a[96], b[96];

    t->inside = true;
    t->recording = t->touched = t->replaying = false;
    t->kept = p.was.recording && node->kept ? &node->kept[i] : NULL;
    for (int k = 0; k < node->n; k++) {
        in[k] = node->in[k];
        if (!in[k] || !is_cut(node, k)) continue;
        in[k] = push_val(t, dar_rows_view(&in[k]->x, rows));
        in[k]->wants_grad = node->in[k]->wants_grad;
        in[k]->leaf = true;
    }
    dar_val *r = run_piece(t, node, in, &rows);
    DAR_ASSERT(r->x.dtype == y.dtype && dar_shape_equal(&r->x.shape, &y.shape),
               "segment: result %s %s, announced %s %s", dar_dtype_name(r->x.dtype),
               dar_shape_text(&r->x.shape, a, sizeof a), dar_dtype_name(y.dtype),
               dar_shape_text(&y.shape, b, sizeof b));
    if (!t->arena->plan) dar_tensor_copy(&y, &r->x);
    node->y->half = node->fn && r->half;
    node->y->wants_grad |= p.was.recording && t->touched;
    if (t->kept && t->touched) p.keep = dar_arena_mark(t->keep); /* the replay needs what was kept */
    leave(t, &p);
}

/* like: a node that says what is to run, and its result's type and shape */
static dar_val *segment(dar_tape *t, const dar_node *like, dar_val *const *in, bool unread)
{
    const dar_rows_attr *a = &like->rows;
    dar_node *node = dar_tape_room(t, sizeof *node);
    DAR_ASSERT(like->n >= 0 && like->n <= DAR_OP_IN, "segment: %d inputs, at most %d", like->n, DAR_OP_IN);
    *node = *like;
    node->prev = t->last;
    for (int i = 0; i < node->n; i++) {
        check_origin(t, in[i]);
        node->in[i] = in[i];
        if (!in[i]) continue;
        in[i]->read = true;
        in[i]->half &= node->fn != NULL; /* pieces add to it */
    }
    unread &= t->replaying;
    node->y = push_val(t, unread ? dar_tensor_of(a->type, a->shape, NULL) : take(t, a->type, a->shape));
    node->y->own = !unread;
    if (unread) {
        node->y->wants_grad = true;
    } else {
        int64_t pieces = pieces_of(node);
        if (t->keep) node->kept = dar_tape_room(t, (size_t)pieces * sizeof *node->kept);
        if (t->keep) node->keep = dar_arena_mark(t->keep);
        for (int64_t i = 0; i < pieces; i++) piece_forward(t, node, i);
        if (t->keep) node->keep_end = dar_arena_mark(t->keep);
    }
    if (node->y->wants_grad) t->last = node;
    return node->y;
}

dar_val *dar_segment(dar_tape *t, dar_segment_fn *fn, void *arg, dar_val *const *in, int n, dar_dtype type,
                     dar_shape shape)
{
    return segment(t, &(dar_node){ .n = n, .fn = fn, .arg = arg, .rows = { .type = type, .shape = shape } }, in, false);
}

dar_val *dar_segment_rows(dar_tape *t, const dar_rows_attr *a, dar_val *const *in, int n)
{
    DAR_ASSERT(a->shape.n >= 2 && a->most > 0, "segment: no rows to cut");
    for (int i = 0; i < n; i++)
        DAR_ASSERT(!(a->cut & DAR_KEEP_X(i)) || (in[i]->x.shape.n >= 2 && in[i]->x.shape.d[0] == a->shape.d[0] &&
                                                 in[i]->x.shape.d[1] == a->shape.d[1]),
                   "segment: input %d has not the result's rows", i);
    return segment(t, &(dar_node){ .n = n, .arg = a->arg, .rows = *a }, in, a->unread);
}

dar_val *dar_apply_kept(dar_tape *t, const dar_op *op, dar_val *const *in, int n, const void *attr, dar_keep keep)
{
    struct dar_keeping *k = t->kept;
    struct how how = { .y = t->arena, .aux = t->arena };

    if (!k || !keep || k->at == MAX_KEPT) return call(t, op, in, n, attr, how);
    struct kept *slot = &k->of[k->at++];
    if (t->replaying) {
        how.ready = slot;
        return call(t, op, in, n, attr, how);
    }
    how.aux = t->keep;
    if (keep == DAR_KEEP_ALL) how.y = t->keep;
    how.save = true;
    how.made = slot;
    dar_val *y = call(t, op, in, n, attr, how);
    if (keep == DAR_KEEP_AUX) slot->y.data = NULL;
    return y;
}
