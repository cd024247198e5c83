/* arith.c: sums and products, with broadcasting of either side. */
#include "autograd/bcast.h"
#include "autograd/ops.h"

static dar_shape sum_shape(const dar_shape *in, int n_in, const void *attr)
{
    (void)n_in, (void)attr;
    return dar_bcast_shape("add", &in[0], &in[1]);
}

static dar_shape product_shape(const dar_shape *in, int n_in, const void *attr)
{
    (void)n_in, (void)attr;
    return dar_bcast_shape("mul", &in[0], &in[1]);
}

static double terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    dar_shape y = sum_shape(in, n_in, attr);
    return of < 0 ? 1 : (double)dar_shape_count(&y) / (double)dar_shape_count(&in[of]);
}

static void map(const dar_opctx *c, dar_bcast_fn *fn, const void *arg)
{
    dar_bcast_map(&(dar_bcast){ .fn = fn, .arg = arg, .x = { &c->x[0], &c->x[1] }, .y = &c->y });
}

/* gx[i] (+)= fn(gy, other), summed where x[i] repeats; other is NULL if fn takes one operand. */
static dar_bcast gradient(const dar_opctx *c, int i, dar_bcast_fn *fn, const dar_tensor *other)
{
    return (dar_bcast){
        .fn = fn, .x = { &c->gy, other }, .y = &c->gx[i], .add = c->add[i], .factor = 1, .scratch = c->scratch
    };
}

static void give(const dar_opctx *c, int i, dar_bcast_fn *fn, const dar_tensor *other)
{
    dar_bcast g = gradient(c, i, fn, other);
    if (!c->gx[i].data) return;              /* frozen */
    if (c->gx[i].data == c->gy.data) return; /* in place: a sum hands gy on */
    if (dar_shape_equal(&c->gy.shape, &c->gx[i].shape)) dar_bcast_map(&g);
    else dar_bcast_sum(&g);
}

static size_t scratch_for(const dar_opctx *c, bool product)
{
    size_t most = 0;
    for (int i = 0; i < 2; i++) {
        if (!c->gx[i].data || dar_shape_equal(&c->gy.shape, &c->gx[i].shape)) continue;
        dar_bcast g = gradient(c, i, NULL, product ? &c->x[1 - i] : NULL);
        size_t bytes = dar_bcast_sum_scratch(&g);
        if (bytes > most) most = bytes;
    }
    return most;
}

static size_t sum_scratch(const dar_opctx *c, bool backward)
{
    return backward ? scratch_for(c, false) : 0;
}

static size_t product_scratch(const dar_opctx *c, bool backward)
{
    return backward ? scratch_for(c, true) : 0;
}

static void add_rows(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    (void)arg;
    k->add(n, x[0], x[1], y);
}

static void mul_rows(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    (void)arg;
    k->mul(n, x[0], x[1], y);
}

static void same_row(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    (void)arg;
    k->scale(n, 1, x[0], y);
}

static void minus_row(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    (void)arg;
    k->scale(n, -1, x[0], y);
}

static void sub_rows(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    minus_row(k, arg, n, x + 1, y);
    k->add(n, x[0], y, y);
}

/* Every way two shapes can meet. */
static const dar_sample pairs[] = {
    { .in = { { 1, { 1 } }, { 1, { 1 } } } },                      /* one element */
    { .in = { { 2, { 3, 37 } }, { 2, { 3, 37 } } } },              /* the same shape, odd vector tail */
    { .in = { { 2, { 5, 7 } }, { 1, { 7 } } } },                   /* a row for every row */
    { .in = { { 2, { 5, 7 } }, { 2, { 5, 1 } } } },                /* a number for every row */
    { .in = { { 2, { 5, 7 } }, { 0, { 0 } } } },                   /* a scalar */
    { .in = { { 1, { 7 } }, { 2, { 5, 7 } } } },                   /* the first one repeats */
    { .in = { { 2, { 5, 1 } }, { 2, { 1, 7 } } } },                /* both repeat */
    { .in = { { 4, { 2, 3, 2, 5 } }, { 4, { 1, 3, 1, 5 } } } },    /* repeated and kept in turn */
    { .in = { { 4, { 2, 3, 2, 5 } }, { 4, { 2, 1, 2, 1 } } } },    /* and the other way round */
    { .in = { { 5, { 2, 3, 2, 2, 3 } }, { 4, { 3, 1, 1, 1 } } } }, /* a number for every channel */
    { .in = { { 2, { 90, 331 } }, { 1, { 331 } } } },              /* rows summed in chunks */
    { .in = { { 2, { 2, 17001 } }, { 2, { 2, 1 } } } },            /* pieces of a row summed in chunks */
    { .in = { { 2, { 15, 1100 } }, { 1, { 1100 } } } },            /* more than one piece */
    { .in = { { 2, { 700, 31 } }, { 2, { 700, 1 } } } },           /* many short sums */
};

static const dar_error_sample misfits[] = {
    { .in = { { 2, { 5, 7 } }, { 1, { 5 } } } },
    { .in = { { 2, { 5, 7 } }, { 2, { 2, 7 } } } },
};

/* ---------------------------------------------------------------- add, sub */

static void add_forward(const dar_opctx *c)
{
    map(c, add_rows, NULL);
}

static void add_backward(const dar_opctx *c)
{
    for (int i = 0; i < 2; i++) give(c, i, same_row, NULL);
}

const dar_op dar_op_add = {
    .name = "add",
    .n_in = 2,
    .in_place = true,
    .half = DAR_KEEP_X(0) | DAR_KEEP_X(1) | DAR_KEEP_Y,
    .shape = sum_shape,
    .scratch = sum_scratch,
    .terms = terms,
    .forward = add_forward,
    .backward = add_backward,
    .samples = pairs,
    .n_samples = DAR_COUNT(pairs),
    .errors = misfits,
    .n_errors = DAR_COUNT(misfits),
};

dar_val *dar_add(dar_tape *t, dar_val *a, dar_val *b)
{
    return dar_apply(t, &dar_op_add, (dar_val *[]){ a, b }, 2, NULL);
}

static void sub_forward(const dar_opctx *c)
{
    map(c, sub_rows, NULL);
}

static void sub_backward(const dar_opctx *c)
{
    give(c, 0, same_row, NULL);
    give(c, 1, minus_row, NULL);
}

const dar_op dar_op_sub = {
    .name = "sub",
    .n_in = 2,
    .in_place = true,
    .shape = sum_shape,
    .scratch = sum_scratch,
    .terms = terms,
    .forward = sub_forward,
    .backward = sub_backward,
    .samples = pairs,
    .n_samples = DAR_COUNT(pairs),
    .errors = misfits,
    .n_errors = DAR_COUNT(misfits),
};

dar_val *dar_sub(dar_tape *t, dar_val *a, dar_val *b)
{
    return dar_apply(t, &dar_op_sub, (dar_val *[]){ a, b }, 2, NULL);
}

/* ---------------------------------------------------------------- mul */

static void mul_forward(const dar_opctx *c)
{
    map(c, mul_rows, NULL);
}

static void mul_backward(const dar_opctx *c)
{
    for (int i = 0; i < 2; i++) give(c, i, mul_rows, &c->x[1 - i]);
}

const dar_op dar_op_mul = {
    .name = "mul",
    .n_in = 2,
    .keep = DAR_KEEP_X(0) | DAR_KEEP_X(1),
    .shape = product_shape,
    .scratch = product_scratch,
    .terms = terms,
    .forward = mul_forward,
    .backward = mul_backward,
    .samples = pairs,
    .n_samples = DAR_COUNT(pairs),
    .errors = misfits,
    .n_errors = DAR_COUNT(misfits),
};

dar_val *dar_mul(dar_tape *t, dar_val *a, dar_val *b)
{
    return dar_apply(t, &dar_op_mul, (dar_val *[]){ a, b }, 2, NULL);
}

/* ---------------------------------------------------------------- affine */

struct affine {
    double a, b;
};

static dar_shape same_shape(const dar_shape *in, int n_in, const void *attr)
{
    (void)n_in, (void)attr;
    return in[0];
}

static void scale_row(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    k->scale(n, *(const double *)arg, x[0], y);
}

static void affine_row(const dar_kern *k, const void *arg, size_t n, const void *const *x, void *y)
{
    scale_row(k, arg, n, x, y);
    k->add(n, y, x[1], y);
}

static void affine_forward(const dar_opctx *c)
{
    struct affine f = *(const struct affine *)c->attr;
    dar_tensor b = dar_tensor_of(DAR_F64, (dar_shape){ 0 }, &f.b);
    dar_bcast_map(&(dar_bcast){
        .fn = f.b == 0 ? scale_row : affine_row, .arg = &f.a, .x = { &c->x[0], f.b == 0 ? NULL : &b }, .y = &c->y });
}

static void affine_backward(const dar_opctx *c)
{
    const struct affine *f = c->attr;
    if (!c->gx[0].data) return;
    dar_bcast_map(&(dar_bcast){ .fn = scale_row, .arg = &f->a, .x = { &c->gy }, .y = &c->gx[0], .add = c->add[0] });
}

static const struct affine twice = { 2, 0 }, other_way = { -1, 1 }, third = { 1.0 / 3, -0.25 }, none = { 0, 0 };

static const dar_sample affine_samples[] = {
    { .in = { { 1, { 1 } } }, .attr = &twice },       { .in = { { 2, { 3, 37 } } }, .attr = &other_way },
    { .in = { { 1, { 9 } } }, .attr = &third },       { .in = { { 1, { 9 } } }, .attr = &none },
    { .in = { { 2, { 5, 4001 } } }, .attr = &third },
};

const dar_op dar_op_affine = {
    .name = "affine",
    .n_in = 1,
    .attr_size = sizeof(struct affine),
    .shape = same_shape,
    .forward = affine_forward,
    .backward = affine_backward,
    .samples = affine_samples,
    .n_samples = DAR_COUNT(affine_samples),
};

dar_val *dar_affine(dar_tape *t, dar_val *x, double a, double b)
{
    struct affine f = { a, b };
    return dar_apply(t, &dar_op_affine, &x, 1, &f);
}

dar_val *dar_scale(dar_tape *t, dar_val *x, double a)
{
    return dar_affine(t, x, a, 0);
}
