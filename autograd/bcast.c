/* bcast.c: walks over broadcast shapes. */
#include "autograd/bcast.h"

#include <string.h>

#include "lib/size.h"
#include "lib/thread.h"

#define TASK 16384 /* elements per task, about */

dar_shape dar_bcast_shape(const char *op, const dar_shape *a, const dar_shape *b)
{
    dar_shape y = { .n = a->n > b->n ? a->n : b->n };
    char ta[96], tb[96];

    for (int k = 1; k <= y.n; k++) {
        int64_t da = k <= a->n ? a->d[a->n - k] : 1, db = k <= b->n ? b->d[b->n - k] : 1;
        DAR_ASSERT(da == db || da == 1 || db == 1, "%s: %s does not broadcast with %s", op,
                   dar_shape_text(a, ta, sizeof ta), dar_shape_text(b, tb, sizeof tb));
        y.d[y.n - k] = da == 1 ? db : da;
    }
    return y;
}

/* A full shape and those that broadcast to it, with neighbouring dimensions merged wherever all of them allow. */
struct walk {
    int n;        /* dimensions, at least 1 */
    int operands; /* y is operand 0, then the inputs */
    size_t d[DAR_MAX_DIMS];
    size_t step[1 + DAR_BCAST_IN][DAR_MAX_DIMS]; /* elements from one index to the next; 0: repeats */
    size_t pieces;                               /* of the last dimension */
};

static void merge(struct walk *w, size_t d, const size_t *step)
{
    bool fits = w->n > 0;
    if (d == 1) return;
    for (int o = 0; fits && o < w->operands; o++) fits = w->step[o][w->n - 1] == step[o] * d;
    if (fits) {
        w->d[w->n - 1] *= d;
    } else {
        w->d[w->n++] = d;
    }
    for (int o = 0; o < w->operands; o++) w->step[o][w->n - 1] = step[o];
}

static struct walk walk_over(const dar_shape *full, const dar_bcast *b)
{
    const dar_shape *of[1 + DAR_BCAST_IN] = { &b->y->shape };
    struct walk w = { .operands = 1 };

    for (int i = 0; i < DAR_BCAST_IN && b->x[i]; i++) of[w.operands++] = &b->x[i]->shape;
    for (int k = 0; k < full->n; k++) {
        size_t step[1 + DAR_BCAST_IN];
        for (int o = 0; o < w.operands; o++) {
            int at = k - (full->n - of[o]->n); /* of this dimension in the operand's shape */
            step[o] = at >= 0 && of[o]->d[at] != 1;
            for (int j = at + 1; j < of[o]->n && step[o]; j++) step[o] *= (size_t)of[o]->d[j];
        }
        merge(&w, (size_t)full->d[k], step);
    }
    if (!w.n) w.d[w.n++] = 1;
    w.pieces = (w.d[w.n - 1] + DAR_PIECE - 1) / DAR_PIECE;
    return w;
}

static size_t piece_length(const struct walk *w, size_t piece)
{
    size_t left = w->d[w->n - 1] - piece * DAR_PIECE;
    return left < DAR_PIECE ? left : DAR_PIECE;
}

static void *at(const dar_tensor *x, size_t element)
{
    return (char *)x->data + element * dar_dtype_size(x->dtype);
}

const void *dar_bcast_get(dar_dtype c, const dar_tensor *x, size_t element, size_t step, size_t n, void *buf)
{
    if (step) return dar_row_get(c, x->dtype, at(x, element), n, buf);
    double v = dar_dtype_get(x->dtype, x->data, element);
    if (c == DAR_F64)
        for (size_t i = 0; i < n; i++) ((double *)buf)[i] = v;
    else
        for (size_t i = 0; i < n; i++) ((float *)buf)[i] = (float)v;
    return buf;
}

/* ---------------------------------------------------------------- map */

struct map {
    const dar_bcast *b;
    struct walk w;
    dar_put mode;
};

static void map_pieces(void *ctx, size_t begin, size_t end, int thread)
{
    const struct map *m = ctx;
    const struct walk *w = &m->w;
    const dar_tensor *y = m->b->y;
    dar_dtype c = dar_compute_type(y->dtype);
    int last = w->n - 1;
    double buf[DAR_BCAST_IN][DAR_PIECE], out[DAR_PIECE];
    (void)thread;

    for (size_t i = begin; i < end; i++) {
        size_t row = i / w->pieces, first = i % w->pieces * DAR_PIECE, n = piece_length(w, i % w->pieces);
        const void *x[DAR_BCAST_IN] = { NULL };
        for (int o = 1; o < w->operands; o++) {
            size_t element = first * w->step[o][last], r = row;
            for (int k = last - 1; k >= 0; r /= w->d[k--]) element += r % w->d[k] * w->step[o][k];
            x[o - 1] = dar_bcast_get(c, m->b->x[o - 1], element, w->step[o][last], n, buf[o - 1]);
        }
        void *dst = at(y, row * w->d[last] + first), *to = dar_row_out(c, y->dtype, dst, m->mode, out);
        m->b->fn(dar_kern_for(c), m->b->arg, n, x, to);
        dar_row_put(c, to, y->dtype, dst, n, m->mode);
    }
}

void dar_bcast_map(const dar_bcast *b)
{
    struct map m = { b, walk_over(&b->y->shape, b), dar_put_for(dar_tensor_bytes(b->y), b->add) };
    size_t count = dar_tensor_count(b->y), length = m.w.d[m.w.n - 1];
    if (count) dar_parallel_range(count / length * m.w.pieces, TASK / dar_least(length, DAR_PIECE), map_pieces, &m);
}

void dar_bcast_opposites(dar_bcast b, double *slope, const dar_tensor gx[2], const bool add[2])
{
    for (int i = 1; i >= 0; i--) { /* x[0] last: its gradient may lie there */
        *slope = -*slope;
        if (!gx[i].data) continue;
        b.y = &gx[i];
        b.add = add[i];
        dar_bcast_map(&b);
    }
}

/* ---------------------------------------------------------------- sum */

/* The work is a table of units by terms.  A unit is a piece of y: of its last dimension, or one element where that
 * dimension is summed.  A term is what it is a sum of: a row piece of fn(x).  The terms of a unit are cut in chunks,
 * whose sums lie in scratch, [chunks, elements of y], and are added in order. */
struct sum {
    const dar_bcast *b;
    struct walk w;
    bool inner; /* the last dimension is summed */
    size_t units, terms, chunks, chunk;
    size_t group; /* units per task */
    size_t count; /* elements of y */
};

#define BLOCK       32  /* terms added in f32 */
#define BESIDE      4   /* pieces of y summed side by side, so that rows of x are read in long runs */
#define LEAST_TASKS 16  /* that are left when pieces are put side by side */
#define MOST_PARTS  128 /* units x chunks, where there is more than one chunk */

static struct sum plan_sum(const dar_bcast *b)
{
    struct sum s = { .b = b, .w = walk_over(&b->x[0]->shape, b), .units = 1, .terms = 1, .chunks = 1, .group = 1 };
    int last = s.w.n - 1;
    size_t piece = dar_least(s.w.d[last], DAR_PIECE);

    s.count = dar_shape_count(&b->y->shape);
    s.inner = !s.w.step[0][last];
    for (int k = 0; k < last; k++) *(s.w.step[0][k] ? &s.units : &s.terms) *= s.w.d[k];
    *(s.inner ? &s.terms : &s.units) *= s.w.pieces;
    if (!piece || !s.units || !s.terms) return s;

    size_t least = s.inner || TASK / piece > BLOCK ? TASK / piece : BLOCK; /* terms that are worth a task */
    if (s.units < MOST_PARTS) s.chunks = dar_least((s.terms + least - 1) / least, MOST_PARTS / s.units);
    s.chunk = (s.terms + s.chunks - 1) / s.chunks;
    s.chunks = (s.terms + s.chunk - 1) / s.chunk;
    if (!s.inner) s.group = dar_least(s.units * s.chunks / LEAST_TASKS + 1, BESIDE);
    else if (s.chunks == 1) s.group = dar_least(least / s.terms + 1, DAR_PIECE);
    return s;
}

/* Row piece `term` of `unit`: fn(x) in arithmetic type c, in one of the buffers or in place. */
static const void *term_of(const struct sum *s, size_t unit, size_t term, size_t *n, double (*buf)[DAR_PIECE])
{
    const struct walk *w = &s->w;
    const dar_tensor *const *x = s->b->x;
    dar_dtype c = dar_compute_type(x[0]->dtype);
    int last = w->n - 1;
    size_t *cut = s->inner ? &term : &unit, piece = *cut % w->pieces, element[1 + DAR_BCAST_IN];
    const void *v[DAR_BCAST_IN] = { NULL };

    *n = piece_length(w, piece);
    *cut /= w->pieces;
    for (int o = 1; o < w->operands; o++) element[o] = piece * DAR_PIECE * w->step[o][last];
    for (int k = last - 1; k >= 0; k--) {
        size_t *index = w->step[0][k] ? &unit : &term;
        for (int o = 1; o < w->operands; o++) element[o] += *index % w->d[k] * w->step[o][k];
        *index /= w->d[k];
    }
    for (int o = 1; o < w->operands; o++)
        v[o - 1] = dar_bcast_get(c, x[o - 1], element[o], w->step[o][last], *n, buf[o - 1]);
    if (!s->b->fn) return v[0];
    s->b->fn(dar_kern_for(c), s->b->arg, *n, v, buf[DAR_BCAST_IN]);
    return buf[DAR_BCAST_IN];
}

/* A unit whose last dimension is summed: one number. */
static double sum_inner(const struct sum *s, size_t unit, size_t begin, size_t end)
{
    const dar_kern *k = dar_kern_for(dar_compute_type(s->b->x[0]->dtype));
    double buf[1 + DAR_BCAST_IN][DAR_PIECE], sum = 0;
    for (size_t i = begin; i < end; i++) {
        size_t n;
        const void *v = term_of(s, unit, i, &n, buf);
        sum += k->sum(n, v);
    }
    return sum;
}

/* acc += row, of arithmetic type c; clears row. */
static void flush(dar_dtype c, size_t n, void *row, double *acc)
{
    if (c == DAR_F64)
        for (size_t i = 0; i < n; i++) acc[i] += ((double *)row)[i];
    else
        for (size_t i = 0; i < n; i++) acc[i] += (double)((float *)row)[i];
    memset(row, 0, n * dar_dtype_size(c));
}

/* Units that are pieces of the last dimension: their numbers into acc. */
static void sum_outer(const struct sum *s, size_t unit, size_t units, size_t begin, size_t end,
                      double (*acc)[DAR_PIECE])
{
    dar_dtype c = dar_compute_type(s->b->x[0]->dtype);
    const dar_kern *k = dar_kern_for(c);
    double buf[1 + DAR_BCAST_IN][DAR_PIECE], row[BESIDE][DAR_PIECE];
    size_t width = dar_least(s->w.d[s->w.n - 1], DAR_PIECE);

    for (size_t u = 0; u < units; u++) memset(row[u], 0, width * sizeof **row), memset(acc[u], 0, width * sizeof **acc);
    for (size_t i = begin; i < end; i++) {
        for (size_t u = 0; u < units; u++) {
            size_t n;
            const void *x = term_of(s, unit + u, i, &n, buf);
            k->add(n, row[u], x, row[u]);
        }
        if ((i - begin) % BLOCK == BLOCK - 1 || i + 1 == end)
            for (size_t u = 0; u < units; u++) flush(c, width, row[u], acc[u]);
    }
}

/* n elements of y, times the factor. */
static void emit(const struct sum *s, size_t element, size_t n, double *v)
{
    const dar_tensor *y = s->b->y;
    for (size_t i = 0; i < n; i++) v[i] *= s->b->factor;
    dar_row_put(DAR_F64, v, y->dtype, at(y, element), n, s->b->add ? DAR_PUT_ADD : DAR_PUT);
}

/* n elements of y summed over a chunk of their terms. */
static void store(const struct sum *s, size_t chunk, size_t element, size_t n, double *v)
{
    if (s->chunks == 1) emit(s, element, n, v);
    else memcpy((double *)s->b->scratch + chunk * s->count + element, v, n * sizeof *v);
}

static void sum_task(void *ctx, size_t i, int thread)
{
    const struct sum *s = ctx;
    size_t chunk = i % s->chunks, unit = i / s->chunks * s->group, n = dar_least(s->units - unit, s->group);
    size_t begin = chunk * s->chunk, end = dar_least(begin + s->chunk, s->terms);
    double v[BESIDE][DAR_PIECE];
    (void)thread;

    if (s->inner) {
        for (size_t j = 0; j < n; j++) v[0][j] = sum_inner(s, unit + j, begin, end);
        store(s, chunk, unit, n, v[0]);
        return;
    }
    sum_outer(s, unit, n, begin, end, v);
    for (size_t j = 0; j < n; j++) {
        size_t row = (unit + j) / s->w.pieces, piece = (unit + j) % s->w.pieces;
        store(s, chunk, row * s->w.d[s->w.n - 1] + piece * DAR_PIECE, piece_length(&s->w, piece), v[j]);
    }
}

static void add_chunks(void *ctx, size_t begin, size_t end, int thread)
{
    const struct sum *s = ctx;
    const double *part = s->b->scratch;
    double v[DAR_PIECE] = { 0 };
    (void)thread;
    for (size_t k = 0; k < s->chunks; k++)
        for (size_t i = begin; i < end; i++) v[i - begin] += part[k * s->count + i];
    emit(s, begin, end - begin, v);
}

size_t dar_bcast_sum_scratch(const dar_bcast *b)
{
    struct sum s = plan_sum(b);
    return s.chunks > 1 ? dar_mul_size(dar_mul_size(s.chunks, s.count), sizeof(double)) : 0;
}

void dar_bcast_sum(const dar_bcast *b)
{
    struct sum s = plan_sum(b);
    if (!dar_tensor_count(b->x[0])) {
        if (!b->add) dar_tensor_fill(b->y, 0);
        return;
    }
    dar_parallel((s.units + s.group - 1) / s.group * s.chunks, sum_task, &s);
    if (s.chunks > 1) dar_parallel_range(s.count, DAR_PIECE, add_chunks, &s);
}
