/* norm.c: RMS norm, layer norm, and the layer norm of a transformer block with its scale and shift: one walk over rows.
 *
 * Every row is normalised and multiplied with a gain row, plus a shift row; which rows those are is the groups' rule
 * (autograd/groups.h), trivial for the plain norms.  Gains and shifts are brought to the arithmetic type once, into
 * scratch. */
#include <math.h>
#include <string.h>

#include "autograd/groups.h"
#include "autograd/ops.h"
#include "lib/kern.h"
#include "lib/thread.h"

#define CHUNK 131072 /* elements per task of forward */

enum { X, GAIN, SHIFT };

/* aux [rows, 3]: the mean in two parts, so that it is exact enough in f32 too, and 1 / std. */
enum { MEAN, MEAN_LOW, RSTD, STATS };

/* How the three ops differ. */
struct kind {
    bool centred;     /* layer norm */
    bool grouped;     /* gain and shift are [B, R, D] */
    double gain_plus; /* y = xhat (gain_plus + gain) + shift */
};

static const struct kind rms = { .centred = false }, layer = { .centred = true },
                         modulated = { .centred = true, .grouped = true, .gain_plus = 1 };

struct walk {
    const dar_opctx *c;
    const struct kind *kind;
    dar_dtype type;
    const dar_kern *k;
    size_t d, row; /* D; its bytes in the arithmetic type */
    dar_groups groups;
    double eps;
    dar_put mode; /* of y or gx */

    /* Offsets into scratch; 0 is that of the threads' rows, two for each, so 0 elsewhere says: not there. */
    size_t gain, shift; /* [groups, D] */
    size_t part[2];     /* [chunks, D]: partial sums for the gradients of gain and shift */
    size_t scratch;     /* in all */
};

static struct walk walk_of(const dar_opctx *c, const struct kind *kind, bool backward)
{
    const dar_norm_opt *o = c->attr;
    const dar_shape *s = &c->x[X].shape, *gain = &c->x[GAIN].shape;
    struct walk w = { .c = c, .kind = kind, .type = dar_op_compute(c), .d = dar_tensor_cols(&c->x[X]), .eps = o->eps };

    w.k = dar_kern_for(w.type);
    w.row = dar_mul_size(w.d, dar_dtype_size(w.type));
    w.groups = kind->grouped
                   ? dar_groups_of((size_t)s->d[0], (size_t)s->d[1], (size_t)gain->d[1], (size_t)o->split, w.d)
                   : dar_groups_of(1, dar_tensor_rows(&c->x[X]), 1, 0, w.d);
    if (kind->grouped) w.groups.first = (size_t)o->first;

    size_t weights = dar_mul_size(w.groups.clips * w.groups.rows, w.row);
    w.scratch = dar_mul_size(2 * (size_t)c->threads, w.row);
    if (gain->n >= 0) w.gain = w.scratch, w.scratch = dar_add_size(w.scratch, weights);
    if (c->x[SHIFT].shape.n >= 0 && !backward) w.shift = w.scratch, w.scratch = dar_add_size(w.scratch, weights);
    for (int i = 0; backward && i < 2; i++)
        if (c->gx[GAIN + i].data) {
            w.part[i] = w.scratch;
            w.scratch = dar_add_size(w.scratch, dar_mul_size(dar_groups_chunks(&w.groups), w.row));
        }
    return w;
}

static void *at(const struct walk *w, size_t offset)
{
    return (char *)w->c->scratch + offset;
}

/* Row i of two that belong to this thread. */
static void *own_row(const struct walk *w, int thread, int i)
{
    return at(w, (size_t)(2 * thread + i) * w->row);
}

/* Gains and shifts in the arithmetic type. */
static void convert_weights(const struct walk *w)
{
    const dar_tensor *gain = &w->c->x[GAIN], *shift = &w->c->x[SHIFT];
    size_t n = w->d * w->groups.clips * w->groups.rows;
    if (w->gain) {
        dar_row_convert(w->type, at(w, w->gain), gain->dtype, gain->data, n);
        if (w->kind->gain_plus != 0) w->k->offset(n, w->kind->gain_plus, at(w, w->gain), at(w, w->gain));
    }
    if (w->shift) dar_row_convert(w->type, at(w, w->shift), shift->dtype, shift->data, n);
}

static void set_weights(const struct walk *w, size_t group, dar_norm *p)
{
    p->w = w->gain ? at(w, w->gain + group * w->row) : NULL;
    p->b = w->shift ? at(w, w->shift + group * w->row) : NULL;
}

/* ---------------------------------------------------------------- forward */

static void save(const struct walk *w, size_t row, const dar_norm *p)
{
    double high = w->type == DAR_F64 ? p->mean : (float)p->mean, s[STATS] = { high, p->mean - high, p->rstd };
    if (w->c->aux.data) dar_row_convert(w->type, dar_tensor_at(&w->c->aux, row * STATS), DAR_F64, s, STATS);
}

/* Ask for row i + 1 of x where row i is read. */
static void ask(dar_norm *p, int which, const dar_tensor *x, size_t d, size_t i)
{
    p->ahead[which] = dar_tensor_at(x, (i + 1) * d);
    p->ahead_size[which] = dar_dtype_size(x->dtype);
}

static void forward_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const struct walk *w = ctx;
    const dar_tensor *x = &w->c->x[X], *y = &w->c->y;
    size_t d = w->d;
    (void)thread;

    for (size_t i = begin; i < end; i++) {
        double m[2];
        w->k->moments[x->dtype](d, dar_tensor_at(x, i * d), w->kind->centred, m);
        dar_norm p = { .mean = m[0], .rstd = 1 / sqrt(m[1] / (double)d + w->eps) };
        set_weights(w, dar_group_of(&w->groups, i), &p);
        ask(&p, 0, x, d, i);
        w->k->norm[x->dtype](d, &p, dar_tensor_at(x, i * d), y->dtype, dar_tensor_at(y, i * d),
                             w->mode == DAR_PUT_STREAM);
        save(w, i, &p);
    }
}

static void forward(const dar_opctx *c, const struct kind *kind)
{
    struct walk w = walk_of(c, kind, false);
    if (!dar_tensor_count(&c->y)) return;
    w.mode = dar_put_for(dar_tensor_bytes(&c->y), false);
    convert_weights(&w);
    dar_parallel_range(dar_tensor_rows(&c->x[X]), CHUNK / w.d + 1, forward_rows, &w);
}

/* ---------------------------------------------------------------- backward */

static dar_norm saved(const struct walk *w, size_t row)
{
    double s[STATS];
    dar_row_convert(DAR_F64, s, w->type, dar_tensor_at(&w->c->aux, row * STATS), STATS);
    return (dar_norm){ .mean = s[MEAN] + s[MEAN_LOW], .rstd = s[RSTD] };
}

/* gx = rstd (g - mean(g) - xhat mean(g xhat)) with g = gain gy; mean(g) only where the mean was taken out. */
static void backward_row(const struct walk *w, size_t row, size_t group, void *const part[2], int thread)
{
    const dar_opctx *c = w->c;
    const dar_tensor *x = &c->x[X], *gy = &c->gy, *gx = &c->gx[X];
    size_t d = w->d, i = row * d;
    const void *g = dar_row_get(w->type, gy->dtype, dar_tensor_at(gy, i), d, own_row(w, thread, 0));
    double sum[2] = { 0 };
    dar_norm p = saved(w, row);

    set_weights(w, group, &p);
    ask(&p, 0, x, d, row);
    ask(&p, 1, gy, d, row);
    w->k->norm_sums[x->dtype](d, &p, dar_tensor_at(x, i), g, sum, part[0], part[1]);
    if (!gx->data) return;
    double mean[2] = { w->kind->centred ? sum[0] / (double)d : 0, sum[1] / (double)d };
    void *dst = dar_tensor_at(gx, i);
    bool direct = gx->dtype == w->type && w->mode != DAR_PUT_ADD;
    void *to = direct ? dst : own_row(w, thread, 1);
    w->k->norm_back[x->dtype](d, &p, dar_tensor_at(x, i), g, mean, to, direct && w->mode == DAR_PUT_STREAM);
    dar_row_put(w->type, to, gx->dtype, dst, d, w->mode);
}

static void backward_chunk(void *ctx, size_t i, int thread)
{
    const struct walk *w = ctx;
    dar_chunk chunk = dar_groups_chunk(&w->groups, i);
    void *part[2] = { 0 };

    for (int j = 0; j < 2; j++)
        if (w->part[j]) part[j] = memset(at(w, w->part[j] + i * w->row), 0, w->row);
    for (size_t row = chunk.begin; row < chunk.end; row++) backward_row(w, row, chunk.group, part, thread);
}

static void backward(const dar_opctx *c, const struct kind *kind)
{
    struct walk w = walk_of(c, kind, true);
    if (c->gx[X].data) w.mode = dar_put_for(dar_tensor_bytes(&c->gx[X]), c->add[X]);
    convert_weights(&w);
    if (w.d) dar_parallel(dar_groups_chunks(&w.groups), backward_chunk, &w);
    for (int j = 0; j < 2; j++)
        if (w.part[j])
            dar_groups_combine(&w.groups, w.type, at(&w, w.part[j]), w.d, &c->gx[GAIN + j], c->add[GAIN + j]);
}

/* ---------------------------------------------------------------- what the three ops share */

static dar_dtype out_type(const dar_dtype *in, int n_in, const void *attr)
{
    const dar_norm_opt *o = attr;
    (void)n_in;
    return o->cast ? o->out : in[X];
}

static dar_shape stats(const dar_shape *in, int n_in, const void *attr)
{
    dar_tensor x = { .shape = in[X] };
    (void)n_in, (void)attr;
    return DAR_SHAPE((int64_t)dar_tensor_rows(&x), STATS);
}

static double terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    dar_tensor x = { .shape = in[X] };
    (void)n_in, (void)attr;
    return (double)(of == GAIN || of == SHIFT ? dar_tensor_rows(&x) : dar_tensor_cols(&x));
}

static dar_shape plain_shape(const char *name, const dar_shape *in, int n_in)
{
    DAR_ASSERT(in[X].n >= 1, "%s: x is a scalar", name);
    int64_t d = in[X].d[in[X].n - 1];
    for (int i = GAIN; i < n_in; i++)
        DAR_ASSERT(in[i].n < 0 || (in[i].n == 1 && in[i].d[0] == d), "%s: x has %lld columns, input %d is not [%lld]",
                   name, (long long)d, i, (long long)d);
    return in[X];
}

/* The three functions of an op that know its kind. */
#define KIND(NAME)                                                                                                     \
    static size_t NAME##_scratch(const dar_opctx *c, bool back)                                                        \
    {                                                                                                                  \
        return walk_of(c, &NAME, back).scratch;                                                                        \
    }                                                                                                                  \
    static void NAME##_forward(const dar_opctx *c)                                                                     \
    {                                                                                                                  \
        forward(c, &NAME);                                                                                             \
    }                                                                                                                  \
    static void NAME##_backward(const dar_opctx *c)                                                                    \
    {                                                                                                                  \
        backward(c, &NAME);                                                                                            \
    }
KIND(rms)
KIND(layer)
KIND(modulated)

static const dar_norm_opt plain = { .eps = 1e-6 }, soft = { .eps = 0.5 },
                          to_bf16 = { .eps = 1e-6, .cast = true, .out = DAR_BF16 };

/* ---------------------------------------------------------------- rms_norm */

static dar_shape rms_shape(const dar_shape *in, int n_in, const void *attr)
{
    (void)attr;
    return plain_shape("rms_norm", in, n_in);
}

static const dar_sample rms_samples[] = {
    { .in = { { 2, { 3, 37 } }, { 1, { 37 } } }, .attr = &plain },     /* odd vector tail */
    { .in = { { 1, { 1 } }, { 1, { 1 } } }, .attr = &soft },           /* one element */
    { .in = { { 3, { 2, 5, 16 } }, { -1, { 0 } } }, .attr = &plain },  /* no weight */
    { .in = { { 2, { 2, 33 } }, { 1, { 33 } } }, .attr = &to_bf16 },   /* cast on the way out */
    { .in = { { 2, { 150, 7 } }, { 1, { 7 } } }, .attr = &plain },     /* many rows of few */
    { .in = { { 2, { 70, 129 } }, { 1, { 129 } } }, .attr = &plain },  /* several chunks */
    { .in = { { 2, { 2, 1030 } }, { 1, { 1030 } } }, .attr = &plain }, /* pieces of columns */
};

static const dar_error_sample rms_errors[] = {
    { .in = { { 0 }, { -1, { 0 } } }, .attr = &plain },
    { .in = { { 2, { 3, 4 } }, { 1, { 3 } } }, .attr = &plain },
    { .in = { { 2, { 3, 4 } }, { 2, { 1, 4 } } }, .attr = &plain },
};

const dar_op dar_op_rms_norm = {
    .name = "rms_norm",
    .n_in = 2,
    .n_optional = 1,
    .in_place = true,
    .keep = DAR_KEEP_X(X) | DAR_KEEP_X(GAIN),
    .half = DAR_KEEP_X(X) | DAR_KEEP_Y,
    .attr_size = sizeof(dar_norm_opt),
    .shape = rms_shape,
    .dtype = out_type,
    .aux = stats,
    .scratch = rms_scratch,
    .terms = terms,
    .forward = rms_forward,
    .backward = rms_backward,
    .samples = rms_samples,
    .n_samples = DAR_COUNT(rms_samples),
    .errors = rms_errors,
    .n_errors = DAR_COUNT(rms_errors),
};

dar_val *dar_rms_norm(dar_tape *t, dar_val *x, dar_val *w, const dar_norm_opt *o)
{
    return dar_apply(t, &dar_op_rms_norm, (dar_val *[]){ x, w }, 2, o);
}

/* ---------------------------------------------------------------- layer_norm */

static dar_shape layer_shape(const dar_shape *in, int n_in, const void *attr)
{
    (void)attr;
    return plain_shape("layer_norm", in, n_in);
}

static const dar_sample layer_samples[] = {
    { .in = { { 2, { 3, 37 } }, { 1, { 37 } }, { 1, { 37 } } }, .attr = &plain },
    { .in = { { 3, { 2, 5, 16 } }, { -1, { 0 } }, { -1, { 0 } } }, .attr = &plain },
    { .in = { { 2, { 3, 9 } }, { 1, { 9 } }, { -1, { 0 } } }, .attr = &plain },
    { .in = { { 2, { 3, 9 } }, { -1, { 0 } }, { 1, { 9 } } }, .attr = &plain },
    { .in = { { 2, { 2, 33 } }, { 1, { 33 } }, { 1, { 33 } } }, .attr = &to_bf16 },
    { .in = { { 2, { 70, 129 } }, { 1, { 129 } }, { 1, { 129 } } }, .attr = &plain },
    { .in = { { 2, { 3, 65 } }, { 1, { 65 } }, { 1, { 65 } } }, .attr = &plain, .lo = 90, .hi = 110 }, /* far from 0 */
};

static const dar_error_sample layer_errors[] = {
    { .in = { { 2, { 3, 4 } }, { 1, { 4 } }, { 1, { 3 } } }, .attr = &plain },
};

const dar_op dar_op_layer_norm = {
    .name = "layer_norm",
    .n_in = 3,
    .n_optional = 2,
    .in_place = true,
    .keep = DAR_KEEP_X(X) | DAR_KEEP_X(GAIN),
    .half = DAR_KEEP_X(X) | DAR_KEEP_Y,
    .attr_size = sizeof(dar_norm_opt),
    .shape = layer_shape,
    .dtype = out_type,
    .aux = stats,
    .scratch = layer_scratch,
    .terms = terms,
    .forward = layer_forward,
    .backward = layer_backward,
    .samples = layer_samples,
    .n_samples = DAR_COUNT(layer_samples),
    .errors = layer_errors,
    .n_errors = DAR_COUNT(layer_errors),
};

dar_val *dar_layer_norm(dar_tape *t, dar_val *x, dar_val *w, dar_val *b, const dar_norm_opt *o)
{
    return dar_apply(t, &dar_op_layer_norm, (dar_val *[]){ x, w, b }, 3, o);
}

/* ---------------------------------------------------------------- modulate */

static dar_shape modulated_shape(const dar_shape *in, int n_in, const void *attr)
{
    const dar_norm_opt *o = attr;
    char a[96], b[96];
    (void)n_in;
    for (int i = GAIN; i <= SHIFT; i++)
        DAR_ASSERT(in[X].n == 3 && in[i].n == 3 && in[i].d[0] == in[X].d[0] && in[i].d[1] >= 1 &&
                       in[i].d[2] == in[X].d[2] && in[i].d[1] == in[GAIN].d[1],
                   "modulate: x is %s [B, N, D], input %d is %s, expected [B, R, D]",
                   dar_shape_text(&in[X], a, sizeof a), i, dar_shape_text(&in[i], b, sizeof b));
    DAR_ASSERT(o->first >= 0 && (o->split > 0 || in[GAIN].d[1] == 1),
               "modulate: %lld rows need a split, and a place from 0 on", (long long)in[GAIN].d[1]);
    return in[X];
}

static const dar_norm_opt split_3 = { .eps = 1e-6, .split = 3 }, split_9 = { .eps = 1e-6, .split = 9 };
static const dar_norm_opt split_66 = { .eps = 1e-6, .split = 66 };
static const dar_norm_opt later = { .eps = 1e-6, .split = 3, .first = 2 };
static const dar_norm_opt later_still = { .eps = 1e-6, .split = 3, .first = 7 };
static const dar_norm_opt split_to_bf16 = { .eps = 1e-6, .split = 2, .cast = true, .out = DAR_BF16 };

#define MODULATE(B, N, R, D)                                                                                           \
    {                                                                                                                  \
        { 3, { B, N, D } }, { 3, { B, R, D } },                                                                        \
        {                                                                                                              \
            3,                                                                                                         \
            {                                                                                                          \
                B, R, D                                                                                                \
            }                                                                                                          \
        }                                                                                                              \
    }

static const dar_sample modulated_samples[] = {
    { .in = MODULATE(2, 5, 1, 9), .attr = &plain },    /* one row for all */
    { .in = MODULATE(2, 5, 2, 19), .attr = &split_3 }, /* the first three tokens have their own */
    { .in = MODULATE(1, 8, 4, 7), .attr = &split_3 },  /* a row for each frame; the last frame is short */
    { .in = MODULATE(2, 5, 2, 3), .attr = &split_9 },  /* a row that nobody uses */
    { .in = MODULATE(2, 5, 2, 17), .attr = &split_to_bf16 },
    { .in = MODULATE(1, 68, 2, 129), .attr = &split_66 }, /* several chunks in each group */
    { .in = MODULATE(2, 5, 3, 7), .attr = &later },       /* a piece of a clip: its first token is the third */
    { .in = MODULATE(1, 5, 2, 7), .attr = &later_still }, /* and one that begins after the first row's */
};

static const dar_error_sample modulated_errors[] = {
    { .in = MODULATE(2, 5, 2, 3), .attr = &plain },
    { .in = { { 3, { 2, 5, 3 } }, { 3, { 2, 2, 3 } }, { 3, { 2, 1, 3 } } }, .attr = &split_3 },
    { .in = { { 3, { 2, 5, 3 } }, { 3, { 1, 2, 3 } }, { 3, { 1, 2, 3 } } }, .attr = &split_3 },
    { .in = { { 2, { 5, 3 } }, { 3, { 1, 2, 3 } }, { 3, { 1, 2, 3 } } }, .attr = &split_3 },
};

const dar_op dar_op_modulate = {
    .name = "modulate",
    .n_in = 3,
    .in_place = true,
    .keep = DAR_KEEP_X(X) | DAR_KEEP_X(GAIN),
    .half = DAR_KEEP_X(X) | DAR_KEEP_Y,
    .attr_size = sizeof(dar_norm_opt),
    .shape = modulated_shape,
    .dtype = out_type,
    .aux = stats,
    .scratch = modulated_scratch,
    .terms = terms,
    .forward = modulated_forward,
    .backward = modulated_backward,
    .samples = modulated_samples,
    .n_samples = DAR_COUNT(modulated_samples),
    .errors = modulated_errors,
    .n_errors = DAR_COUNT(modulated_errors),
};

dar_val *dar_modulate(dar_tape *t, dar_val *x, dar_val *scale, dar_val *shift, const dar_norm_opt *o)
{
    return dar_apply(t, &dar_op_modulate, (dar_val *[]){ x, scale, shift }, 3, o);
}
