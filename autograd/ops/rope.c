/* rope.c: rotation of head pairs by position in three axes. */
#include <math.h>

#include "autograd/ops.h"
#include "lib/kern.h"
#include "lib/thread.h"

#define CHUNK 65536 /* elements per task */

enum { X, TABLE };

/* ---------------------------------------------------------------- tables */

void dar_rope_axes(int64_t e, int64_t pairs[3])
{
    DAR_ASSERT(e > 0 && e % 2 == 0, "rope: head size %lld", (long long)e);
    pairs[1] = pairs[2] = e / 6;
    pairs[0] = e / 2 - 2 * (e / 6);
}

void dar_rope_angles(int64_t e, double base, const double position[3], double *angle)
{
    int64_t pairs[3];
    dar_rope_axes(e, pairs);
    for (int axis = 0; axis < 3; axis++)
        for (int64_t i = 0; i < pairs[axis]; i++)
            *angle++ = position[axis] * pow(base, -(double)i / (double)pairs[axis]);
}

struct table {
    const dar_tensor *table;
    int64_t h, w;
    double base;
};

static void table_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const struct table *p = ctx;
    size_t e = dar_tensor_cols(p->table);
    double row[DAR_PIECE];
    (void)thread;
    for (size_t i = begin; i < end; i++) {
        int64_t at = (int64_t)i;
        double position[] = { (double)(at / (p->h * p->w)), (double)(at / p->w % p->h), (double)(at % p->w) };
        dar_rope_angles((int64_t)e, p->base, position,
                        row + e / 2); /* the last pair is read before it is overwritten */
        for (size_t j = 0; j < e / 2; j++) {
            double a = row[e / 2 + j];
            row[2 * j] = cos(a);
            row[2 * j + 1] = sin(a);
        }
        dar_row_put(DAR_F64, row, p->table->dtype, dar_tensor_at(p->table, i * e), e, DAR_PUT);
    }
}

void dar_rope_table(const dar_tensor *table, int64_t frames, int64_t height, int64_t width, double base)
{
    struct table p = { table, height, width, base };
    size_t e = dar_tensor_cols(table);
    DAR_ASSERT(table->shape.n == 2 && table->shape.d[0] == frames * height * width && e <= DAR_PIECE,
               "rope_table: %lld rows of %zu for %lld x %lld x %lld tokens, heads at most %d",
               (long long)table->shape.d[0], e, (long long)frames, (long long)height, (long long)width, DAR_PIECE);
    dar_parallel_range((size_t)table->shape.d[0], 64, table_rows, &p);
}

/* ---------------------------------------------------------------- rope */

struct walk {
    dar_dtype type;
    const dar_tensor *from, *to, *table;
    size_t d, e, tokens;
    dar_put mode;
    bool backward;
};

/* In pieces of whole heads.  What is added to is a gradient, of the arithmetic type; else only gradients differ in how
 * they are stored. */
static void rotate_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const struct walk *w = ctx;
    const dar_kern *k = dar_kern_for(w->type);
    size_t step = DAR_PIECE / w->e * w->e;
    bool alike = w->from->dtype == w->to->dtype;
    dar_dtype as = alike ? w->to->dtype : w->type;
    double tbuf[DAR_PIECE], xbuf[DAR_PIECE], ybuf[DAR_PIECE];
    (void)thread;
    for (size_t row = begin; row < end; row++) {
        const void *angles = dar_tensor_at(w->table, row % w->tokens * w->e);
        const void *table = dar_row_get(w->type, w->table->dtype, angles, w->e, tbuf);
        for (size_t j = 0; j < w->d; j += step) {
            size_t n = w->d - j < step ? w->d - j : step, i = row * w->d + j;
            const void *x = dar_row_get(as, w->from->dtype, dar_tensor_at(w->from, i), n, xbuf);
            void *to = dar_tensor_at(w->to, i), *y = alike && w->mode != DAR_PUT_ADD ? to : ybuf;
            k->rope[as](n, w->e, x, table, y, w->backward, y == to && w->mode == DAR_PUT_STREAM);
            if (y != to) dar_row_put(w->type, y, w->to->dtype, to, n, w->mode);
        }
    }
}

static void rotate(const dar_opctx *c, const dar_tensor *from, const dar_tensor *to, bool add, bool backward)
{
    const dar_tensor *table = &c->x[TABLE];
    struct walk w = { .type = dar_op_compute(c),
                      .from = from,
                      .to = to,
                      .table = table,
                      .d = dar_tensor_cols(to),
                      .e = dar_tensor_cols(table),
                      .tokens = (size_t)table->shape.d[0],
                      .mode = dar_put_for(dar_tensor_bytes(to), add),
                      .backward = backward };
    dar_parallel_range(dar_tensor_rows(to), CHUNK / w.d + 1, rotate_rows, &w);
}

static void rope_forward(const dar_opctx *c)
{
    rotate(c, &c->x[X], &c->y, false, false);
}

static void rope_backward(const dar_opctx *c)
{
    if (c->gx[X].data) rotate(c, &c->gy, &c->gx[X], c->add[X], true);
}

static dar_shape rope_shape(const dar_shape *in, int n_in, const void *attr)
{
    char a[96], b[96];
    (void)n_in, (void)attr;
    DAR_ASSERT(in[X].n == 3 && in[TABLE].n == 2 && in[TABLE].d[0] == in[X].d[1] && in[TABLE].d[1] > 0 &&
                   in[TABLE].d[1] % 2 == 0 && in[TABLE].d[1] <= DAR_PIECE && in[X].d[2] % in[TABLE].d[1] == 0,
               "rope: x is %s [B, N, A E], table is %s [N, E]", dar_shape_text(&in[X], a, sizeof a),
               dar_shape_text(&in[TABLE], b, sizeof b));
    return in[X];
}

static const dar_sample rope_samples[] = {
    { .in = { { 3, { 2, 5, 12 } }, { 2, { 5, 4 } } } },     /* heads shorter than a vector */
    { .in = { { 3, { 1, 3, 66 } }, { 2, { 3, 22 } } } },    /* odd vector tail */
    { .in = { { 3, { 1, 1, 2 } }, { 2, { 1, 2 } } } },      /* one pair */
    { .in = { { 3, { 1, 2, 1280 } }, { 2, { 2, 128 } } } }, /* several pieces */
    { .in = { { 3, { 2, 40, 512 } }, { 2, { 40, 64 } } } }, /* several tasks */
};

static const dar_error_sample rope_errors[] = {
    { .in = { { 3, { 2, 5, 12 } }, { 2, { 4, 4 } } } },
    { .in = { { 3, { 2, 5, 12 } }, { 2, { 5, 3 } } } },
    { .in = { { 3, { 2, 5, 12 } }, { 2, { 5, 8 } } } },
};

const dar_op dar_op_rope = {
    .name = "rope",
    .n_in = 2,
    .in_place = true,
    .keep = DAR_KEEP_X(TABLE),
    .half = DAR_KEEP_X(X) | DAR_KEEP_Y,
    .frozen = DAR_KEEP_X(TABLE),
    .shape = rope_shape,
    .forward = rope_forward,
    .backward = rope_backward,
    .samples = rope_samples,
    .n_samples = DAR_COUNT(rope_samples),
    .errors = rope_errors,
    .n_errors = DAR_COUNT(rope_errors),
};

dar_val *dar_rope(dar_tape *t, dar_val *x, dar_val *table)
{
    return dar_apply(t, &dar_op_rope, (dar_val *[]){ x, table }, 2, NULL);
}
