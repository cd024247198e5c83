/* shape.c: ops that move values and compute nothing.  Copies convert between storage types and strides
 * (lib/tensor.h). */
#include "autograd/ops.h"

#include <string.h>

static dar_shape same_shape(const dar_shape *in, int n_in, const void *attr)
{
    (void)n_in, (void)attr;
    return in[0];
}

/* gx (+)= g, through whatever strides. */
static void give(const dar_tensor *gx, const dar_tensor *g, bool add)
{
    if (add) dar_tensor_add(gx, g);
    else dar_tensor_copy(gx, g);
}

static void copy_forward(const dar_opctx *c)
{
    dar_tensor_copy(&c->y, &c->x[0]);
}

static void copy_backward(const dar_opctx *c)
{
    if (c->gx[0].data) give(&c->gx[0], &c->gy, c->add[0]);
}

/* ---------------------------------------------------------------- contiguous */

static const dar_sample contiguous_samples[] = {
    { .in = { { 0, { 0 } } } },
    { .in = { { 3, { 2, 3, 5 } } } },
    { .in = { { 2, { 301, 257 } } } },
};

const dar_op dar_op_contiguous = {
    .name = "contiguous",
    .n_in = 1,
    .strided = true,
    .shape = same_shape,
    .forward = copy_forward,
    .backward = copy_backward,
    .samples = contiguous_samples,
    .n_samples = DAR_COUNT(contiguous_samples),
};

dar_val *dar_contiguous(dar_tape *t, dar_val *x)
{
    return dar_apply(t, &dar_op_contiguous, &x, 1, NULL);
}

/* ---------------------------------------------------------------- cast */

static dar_dtype cast_dtype(const dar_dtype *in, int n_in, const void *attr)
{
    (void)in, (void)n_in;
    return *(const dar_dtype *)attr;
}

static const dar_dtype to_f64 = DAR_F64, to_f32 = DAR_F32, to_bf16 = DAR_BF16, to_f16 = DAR_F16;

static const dar_sample cast_samples[] = {
    { .in = { { 1, { 1 } } }, .attr = &to_f64 },     { .in = { { 2, { 3, 7 } } }, .attr = &to_f64 },
    { .in = { { 2, { 3, 7 } } }, .attr = &to_f32 },  { .in = { { 2, { 3, 7 } } }, .attr = &to_bf16 },
    { .in = { { 2, { 2, 33 } } }, .attr = &to_f16 },
};

const dar_op dar_op_cast = {
    .name = "cast",
    .n_in = 1,
    .strided = true,
    .attr_size = sizeof(dar_dtype),
    .shape = same_shape,
    .dtype = cast_dtype,
    .forward = copy_forward,
    .backward = copy_backward,
    .samples = cast_samples,
    .n_samples = DAR_COUNT(cast_samples),
};

dar_val *dar_cast(dar_tape *t, dar_val *x, dar_dtype type)
{
    DAR_ASSERT(type != DAR_I8, "cast: i8 rows are quantised, not cast");
    return type == x->x.dtype ? x : dar_apply(t, &dar_op_cast, &x, 1, &type);
}

/* ---------------------------------------------------------------- views */

static dar_tensor reshape_view(const dar_tensor *x, const void *attr)
{
    return dar_tensor_reshape(x, *(const dar_shape *)attr);
}

static const dar_shape flat_30 = { 1, { 30 } }, cube_30 = { 3, { 5, 1, 6 } }, scalar = { 0, { 0 } };

static const dar_sample reshape_samples[] = {
    { .in = { { 3, { 2, 3, 5 } } }, .attr = &flat_30 },
    { .in = { { 2, { 3, 10 } } }, .attr = &cube_30 },
    { .in = { { 2, { 1, 1 } } }, .attr = &scalar },
};

static const dar_error_sample reshape_errors[] = { { .in = { { 2, { 3, 5 } } }, .attr = &flat_30 } };

const dar_op dar_op_reshape = {
    .name = "reshape",
    .n_in = 1,
    .attr_size = sizeof(dar_shape),
    .view = reshape_view,
    .samples = reshape_samples,
    .n_samples = DAR_COUNT(reshape_samples),
    .errors = reshape_errors,
    .n_errors = DAR_COUNT(reshape_errors),
};

dar_val *dar_reshape(dar_tape *t, dar_val *x, dar_shape s)
{
    return dar_apply(t, &dar_op_reshape, &x, 1, &s);
}

struct slice {
    int dim;
    int64_t start, length;
};

static dar_tensor slice_view(const dar_tensor *x, const void *attr)
{
    const struct slice *a = attr;
    return dar_tensor_narrow(x, a->dim, a->start, a->length);
}

static const struct slice slice_head = { 0, 0, 1 }, slice_mid = { 1, 1, 3 }, slice_tail = { 2, 5, 2 },
                          slice_all = { 1, 0, 5 }, slice_over = { 2, 6, 2 }, slice_dim = { 3, 0, 1 };

static const dar_sample slice_samples[] = {
    { .in = { { 3, { 3, 5, 7 } } }, .attr = &slice_head },
    { .in = { { 3, { 3, 5, 7 } } }, .attr = &slice_mid },
    { .in = { { 3, { 3, 5, 7 } } }, .attr = &slice_tail },
    { .in = { { 3, { 3, 5, 7 } } }, .attr = &slice_all },
};

static const dar_error_sample slice_errors[] = {
    { .in = { { 3, { 3, 5, 7 } } }, .attr = &slice_over },
    { .in = { { 3, { 3, 5, 7 } } }, .attr = &slice_dim },
};

const dar_op dar_op_slice = {
    .name = "slice",
    .n_in = 1,
    .strided = true,
    .attr_size = sizeof(struct slice),
    .view = slice_view,
    .samples = slice_samples,
    .n_samples = DAR_COUNT(slice_samples),
    .errors = slice_errors,
    .n_errors = DAR_COUNT(slice_errors),
};

dar_val *dar_slice(dar_tape *t, dar_val *x, int dim, int64_t start, int64_t length)
{
    struct slice a = { dim, start, length };
    return dar_apply(t, &dar_op_slice, &x, 1, &a);
}

struct order {
    int of[DAR_MAX_DIMS];
};

static dar_tensor permute_view(const dar_tensor *x, const void *attr)
{
    return dar_tensor_permute(x, ((const struct order *)attr)->of);
}

static const struct order order_102 = { { 1, 0, 2 } }, order_201 = { { 2, 0, 1 } }, order_same = { { 0, 1, 2 } },
                          order_10 = { { 1, 0 } }, order_03142 = { { 0, 3, 1, 4, 2 } }, order_twice = { { 0, 1, 1 } };

static const dar_sample permute_samples[] = {
    { .in = { { 3, { 2, 3, 5 } } }, .attr = &order_102 },         { .in = { { 3, { 2, 3, 5 } } }, .attr = &order_201 },
    { .in = { { 3, { 2, 3, 5 } } }, .attr = &order_same },        { .in = { { 2, { 67, 35 } } }, .attr = &order_10 },
    { .in = { { 5, { 2, 3, 4, 5, 7 } } }, .attr = &order_03142 },
};

static const dar_error_sample permute_errors[] = { { .in = { { 3, { 2, 3, 5 } } }, .attr = &order_twice } };

const dar_op dar_op_permute = {
    .name = "permute",
    .n_in = 1,
    .strided = true,
    .attr_size = sizeof(struct order),
    .view = permute_view,
    .samples = permute_samples,
    .n_samples = DAR_COUNT(permute_samples),
    .errors = permute_errors,
    .n_errors = DAR_COUNT(permute_errors),
};

dar_val *dar_permute(dar_tape *t, dar_val *x, const int *order)
{
    struct order a = { { 0 } };
    memcpy(a.of, order, (size_t)x->x.shape.n * sizeof *order);
    return dar_apply(t, &dar_op_permute, &x, 1, &a);
}

/* ---------------------------------------------------------------- concat */

static dar_shape concat_shape(const dar_shape *in, int n_in, const void *attr)
{
    int dim = *(const int *)attr;
    char a[96], b[96];
    dar_shape s = in[0];
    DAR_ASSERT(dim >= 0 && dim < s.n, "concat: dimension %d of %d", dim, s.n);
    for (int i = 1; i < n_in; i++) {
        bool fits = in[i].n == s.n;
        for (int k = 0; fits && k < s.n; k++) fits = k == dim || in[i].d[k] == s.d[k];
        DAR_ASSERT(fits, "concat: %s with %s along dimension %d", dar_shape_text(&s, a, sizeof a),
                   dar_shape_text(&in[i], b, sizeof b), dim);
        s.d[dim] += in[i].d[dim];
    }
    return s;
}

static void concat_forward(const dar_opctx *c)
{
    int dim = *(const int *)c->attr;
    int64_t at = 0;
    for (int i = 0; i < DAR_OP_IN && c->x[i].shape.n >= 0; i++) {
        dar_tensor part = dar_tensor_narrow(&c->y, dim, at, c->x[i].shape.d[dim]);
        dar_tensor_copy(&part, &c->x[i]);
        at += c->x[i].shape.d[dim];
    }
}

static void concat_backward(const dar_opctx *c)
{
    int dim = *(const int *)c->attr;
    int64_t at = 0;
    for (int i = 0; i < DAR_OP_IN && c->x[i].shape.n >= 0; i++) {
        dar_tensor part = dar_tensor_narrow(&c->gy, dim, at, c->x[i].shape.d[dim]);
        if (c->gx[i].data) give(&c->gx[i], &part, c->add[i]);
        at += c->x[i].shape.d[dim];
    }
}

static const int dim_0 = 0, dim_1 = 1, dim_2 = 2;

#define LINE(n)                                                                                                        \
    {                                                                                                                  \
        2,                                                                                                             \
        {                                                                                                              \
            3, n                                                                                                       \
        }                                                                                                              \
    }
static const dar_sample concat_samples[] = {
    { .in = { { 1, { 1 } }, { -1, { 0 } } }, .attr = &dim_0 },
    { .in = { { 2, { 2, 3 } }, { 2, { 5, 3 } }, { -1, { 0 } } }, .attr = &dim_0 },
    { .in = { { 3, { 2, 3, 5 } }, { 3, { 2, 1, 5 } }, { 3, { 2, 4, 5 } }, { -1, { 0 } } }, .attr = &dim_1 },
    { .in = { { 3, { 2, 3, 5 } }, { 3, { 2, 3, 5 } }, { -1, { 0 } } }, .attr = &dim_2 },
    { .in = { LINE(1), LINE(3), LINE(2), LINE(1), LINE(5), LINE(1), LINE(2), LINE(4) }, .attr = &dim_1 }, /* the most */
};
#undef LINE

static const dar_error_sample concat_errors[] = {
    { .in = { { 2, { 2, 3 } }, { 2, { 2, 4 } }, { -1, { 0 } } }, .attr = &dim_0 },
    { .in = { { 2, { 2, 3 } }, { 1, { 3 } }, { -1, { 0 } } }, .attr = &dim_0 },
    { .in = { { 2, { 2, 3 } }, { 2, { 2, 3 } }, { -1, { 0 } } }, .attr = &dim_2 },
};

const dar_op dar_op_concat = {
    .name = "concat",
    .n_in = DAR_OP_IN,
    .variadic = true,
    .strided = true,
    .attr_size = sizeof(int),
    .shape = concat_shape,
    .forward = concat_forward,
    .backward = concat_backward,
    .samples = concat_samples,
    .n_samples = DAR_COUNT(concat_samples),
    .errors = concat_errors,
    .n_errors = DAR_COUNT(concat_errors),
};

dar_val *dar_concat(dar_tape *t, dar_val *const *x, int n, int dim)
{
    return dar_apply(t, &dar_op_concat, x, n, &dim);
}

/* ---------------------------------------------------------------- pad */

struct pad {
    int64_t before[DAR_MAX_DIMS], after[DAR_MAX_DIMS];
};

static dar_shape pad_shape(const dar_shape *in, int n_in, const void *attr)
{
    const struct pad *p = attr;
    dar_shape s = in[0];
    (void)n_in;
    for (int k = 0; k < s.n; k++) {
        DAR_ASSERT(p->before[k] >= 0 && p->after[k] >= 0, "pad: %lld before and %lld after dimension %d",
                   (long long)p->before[k], (long long)p->after[k], k);
        s.d[k] += p->before[k] + p->after[k];
    }
    return s;
}

/* The part of the padded tensor that x fills. */
static dar_tensor pad_inside(const dar_opctx *c, dar_tensor y)
{
    const struct pad *p = c->attr;
    for (int k = 0; k < y.shape.n; k++) y = dar_tensor_narrow(&y, k, p->before[k], c->x[0].shape.d[k]);
    return y;
}

static void pad_forward(const dar_opctx *c)
{
    const struct pad *p = c->attr;
    dar_tensor rest = c->y; /* what the borders so far have left */
    for (int k = 0; k < rest.shape.n; k++) {
        int64_t inside = c->x[0].shape.d[k];
        dar_tensor before = dar_tensor_narrow(&rest, k, 0, p->before[k]);
        dar_tensor after = dar_tensor_narrow(&rest, k, p->before[k] + inside, p->after[k]);
        dar_tensor_fill(&before, 0);
        dar_tensor_fill(&after, 0);
        rest = dar_tensor_narrow(&rest, k, p->before[k], inside);
    }
    dar_tensor_copy(&rest, &c->x[0]);
}

static void pad_backward(const dar_opctx *c)
{
    dar_tensor inside = pad_inside(c, c->gy);
    if (c->gx[0].data) give(&c->gx[0], &inside, c->add[0]);
}

static const struct pad pad_none = { { 0 }, { 0 } }, pad_last = { { 0, 2 }, { 0, 1 } },
                        pad_all = { { 2, 0, 1 }, { 0, 3, 1 } }, pad_less = { { 0, -1 }, { 0, 0 } };

static const dar_sample pad_samples[] = {
    { .in = { { 1, { 5 } } }, .attr = &pad_none },
    { .in = { { 2, { 3, 5 } } }, .attr = &pad_last },
    { .in = { { 3, { 2, 3, 5 } } }, .attr = &pad_all },
};

static const dar_error_sample pad_errors[] = { { .in = { { 2, { 3, 5 } } }, .attr = &pad_less } };

const dar_op dar_op_pad = {
    .name = "pad",
    .n_in = 1,
    .strided = true,
    .attr_size = sizeof(struct pad),
    .shape = pad_shape,
    .forward = pad_forward,
    .backward = pad_backward,
    .samples = pad_samples,
    .n_samples = DAR_COUNT(pad_samples),
    .errors = pad_errors,
    .n_errors = DAR_COUNT(pad_errors),
};

dar_val *dar_pad(dar_tape *t, dar_val *x, const int64_t *before, const int64_t *after)
{
    struct pad p = { { 0 }, { 0 } };
    memcpy(p.before, before, (size_t)x->x.shape.n * sizeof *before);
    memcpy(p.after, after, (size_t)x->x.shape.n * sizeof *after);
    return dar_apply(t, &dar_op_pad, &x, 1, &p);
}
