/* conv.c: convolution of frames (conv2d) and of clips (conv3d, causal); the arithmetic is in lib/conv.c. */
#include "autograd/ops.h"
#include "lib/conv.h"
#include "lib/kern.h"

enum { X, WEIGHT, BIAS, HISTORY };

/* x as [B, C, T, H, W]: a picture is a clip of one frame. */
static dar_shape as_clip(const dar_shape *x)
{
    if (x->n == 5) return *x;
    return DAR_SHAPE(x->d[0], x->d[1], 1, x->d[2], x->d[3]);
}

static size_t out_length(const char *what, int64_t length, int64_t kernel, int stride)
{
    DAR_ASSERT(length >= kernel, "conv: %s: %lld with padding, the kernel has %lld", what, (long long)length,
               (long long)kernel);
    return (size_t)((length - kernel) / stride + 1);
}

/* Geometry of a call; aborts if the inputs do not fit. */
static dar_conv geometry(const dar_shape *in, const dar_conv_attr *a)
{
    char t[2][96];
    dar_shape_text(&in[X], t[0], sizeof t[0]);
    dar_shape_text(&in[WEIGHT], t[1], sizeof t[1]);
    bool clip = in[WEIGHT].n == 5;
    dar_shape x = as_clip(&in[X]), w = as_clip(&in[WEIGHT]);

    DAR_ASSERT(x.d[1] == w.d[1], "conv: x is %s, w expects %s", t[0], t[1]);
    DAR_ASSERT(a->stride >= 1 && a->top >= 0 && a->bottom >= 0 && a->left >= 0 && a->right >= 0,
               "conv: stride %d, padding %d %d %d %d", a->stride, a->top, a->bottom, a->left, a->right);
    DAR_ASSERT(!clip || (a->stride_t >= 1 && a->front >= 0), "conv: stride in time %d, %d frames in front", a->stride_t,
               a->front);
    DAR_ASSERT(in[BIAS].n < 0 || (in[BIAS].n == 1 && in[BIAS].d[0] == w.d[0]), "conv: b is %s, w is %s",
               dar_shape_text(&in[BIAS], t[0], sizeof t[0]), t[1]);
    dar_conv c = { .B = (size_t)x.d[0],
                   .Cin = (size_t)x.d[1],
                   .T = (size_t)x.d[2],
                   .H = (size_t)x.d[3],
                   .W = (size_t)x.d[4],
                   .Cout = (size_t)w.d[0],
                   .kt = (size_t)w.d[2],
                   .kh = (size_t)w.d[3],
                   .kw = (size_t)w.d[4],
                   .stride = (size_t)a->stride,
                   .top = a->top,
                   .left = a->left,
                   .stride_t = clip ? (size_t)a->stride_t : 1,
                   .front = clip ? a->front : 0 };
    if (clip && in[HISTORY].n >= 0) {
        const dar_shape *h = &in[HISTORY];
        DAR_ASSERT(h->n == 5 && h->d[0] == x.d[0] && h->d[1] == x.d[1] && h->d[3] == x.d[3] && h->d[4] == x.d[4] &&
                       h->d[2] <= a->front,
                   "conv3d: history is %s, x is %s, %d frames in front", dar_shape_text(h, t[1], sizeof t[1]), t[0],
                   a->front);
        c.past = (size_t)h->d[2];
    }
    c.To = clip ? out_length("frames", x.d[2] + a->front, w.d[2], a->stride_t) : c.T;
    c.Ho = out_length("rows", x.d[3] + a->top + a->bottom, w.d[3], a->stride);
    c.Wo = out_length("columns", x.d[4] + a->left + a->right, w.d[4], a->stride);
    return c;
}

static dar_conv geometry_of(const dar_opctx *c)
{
    dar_shape in[] = { c->x[X].shape, c->x[WEIGHT].shape, c->x[BIAS].shape, c->x[HISTORY].shape };
    return geometry(in, c->attr);
}

static dar_shape out_shape(const dar_shape *in, const dar_conv_attr *a)
{
    dar_conv c = geometry(in, a);
    int64_t d[] = { (int64_t)c.B, (int64_t)c.Cout, (int64_t)c.To, (int64_t)c.Ho, (int64_t)c.Wo };
    if (in[X].n == 5) return DAR_SHAPE(d[0], d[1], d[2], d[3], d[4]);
    return DAR_SHAPE(d[0], d[1], d[3], d[4]);
}

/* For the gradients of x and history: without the frames of a history that wants none. */
static dar_conv geometry_back_x(const dar_opctx *c)
{
    dar_conv g = geometry_of(c);
    if (!c->gx[HISTORY].data) g.past = 0;
    return g;
}

static bool wants_back_x(const dar_opctx *c)
{
    return c->gx[X].data || c->gx[HISTORY].data;
}

static size_t scratch(const dar_opctx *c, bool backward)
{
    dar_conv g = geometry_of(c), gx = geometry_back_x(c);
    dar_dtype x = c->x[X].dtype, w = c->x[WEIGHT].dtype;
    if (!backward) return dar_conv_scratch(&g, DAR_CONV_FORWARD, x, w, c->threads);

    size_t bytes[] = { wants_back_x(c) ? dar_conv_scratch(&gx, DAR_CONV_BACK_X, x, w, c->threads) : 0,
                       c->gx[WEIGHT].data ? dar_conv_scratch(&g, DAR_CONV_BACK_W, x, w, c->threads) : 0 };
    return bytes[0] > bytes[1] ? bytes[0] : bytes[1];
}

static double flops(const dar_opctx *c, bool backward)
{
    dar_conv g = geometry_of(c);
    double one = 2.0 * (double)g.B * (double)g.Cout * (double)g.Cin * (double)(g.kt * g.kh * g.kw) *
                 (double)(g.To * g.Ho * g.Wo);
    if (!backward) return one;
    return one * (wants_back_x(c) + (c->gx[WEIGHT].data != NULL));
}

static double terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    dar_conv g = geometry(in, attr);
    double taps = (double)(g.kt * g.kh * g.kw);
    (void)n_in;
    if (of < 0) return taps * (double)g.Cin;
    if (of == X || of == HISTORY) return taps * (double)g.Cout;
    return (double)g.B * (double)g.To * (double)(g.Ho * g.Wo);
}

static void forward(const dar_opctx *c)
{
    dar_conv g = geometry_of(c);
    dar_conv_forward(&g, &c->x[X], &c->x[WEIGHT], &c->x[BIAS], &c->x[HISTORY], &c->y, c->scratch);
}

static void backward(const dar_opctx *c)
{
    dar_conv g = geometry_of(c), gx = geometry_back_x(c);
    const dar_tensor *x = &c->x[X], *w = &c->x[WEIGHT];

    if (wants_back_x(c))
        dar_conv_back_x(&gx, x->dtype, w, &c->gy, &c->gx[X], c->add[X], &c->gx[HISTORY], c->add[HISTORY], c->scratch);
    if (c->gx[WEIGHT].data)
        dar_conv_back_w(&g, x, &c->x[HISTORY], w->dtype, &c->gy, &c->gx[WEIGHT], c->add[WEIGHT], c->scratch);
    if (c->gx[BIAS].data) dar_conv_back_b(&g, &c->gy, &c->gx[BIAS], c->add[BIAS]);
}

/* ---------------------------------------------------------------- conv2d */

static dar_shape conv2d_shape(const dar_shape *in, int n_in, const void *attr)
{
    char t[2][96];
    (void)n_in;
    DAR_ASSERT((in[X].n == 4 || in[X].n == 5) && in[WEIGHT].n == 4, "conv2d: x is %s, w is %s",
               dar_shape_text(&in[X], t[0], sizeof t[0]), dar_shape_text(&in[WEIGHT], t[1], sizeof t[1]));
    return out_shape(in, attr);
}

static const dar_conv_attr plain = { .stride = 1 }, same_3 = { 1, 1, 1, 1, 1, 0, 0 };
static const dar_conv_attr stride_2 = { .stride = 2 }, vae_down = { 2, 0, 1, 0, 1, 0, 0 };
static const dar_conv_attr lopsided = { 3, 2, 0, 1, 3, 0, 0 }, wide_border = { 1, 3, 3, 4, 4, 0, 0 };

static const dar_sample conv2d_samples[] = {
    { .in = { { 4, { 1, 1, 1, 1 } }, { 4, { 1, 1, 1, 1 } }, { 1, { 1 } } }, .attr = &plain },    /* one of each */
    { .in = { { 4, { 2, 3, 5, 7 } }, { 4, { 4, 3, 1, 1 } }, { 1, { 4 } } }, .attr = &plain },    /* 1 x 1 */
    { .in = { { 4, { 2, 3, 5, 7 } }, { 4, { 2, 3, 3, 3 } }, { 1, { 2 } } }, .attr = &same_3 },   /* 3 x 3, pad 1 */
    { .in = { { 4, { 1, 2, 4, 6 } }, { 4, { 3, 2, 2, 2 } }, { 1, { 3 } } }, .attr = &stride_2 }, /* 2 x 2, stride 2 */
    { .in = { { 4, { 1, 2, 5, 7 } }, { 4, { 3, 2, 2, 2 } }, { .n = -1 } }, .attr = &stride_2 },  /* a row left over */
    { .in = { { 4, { 2, 2, 6, 8 } }, { 4, { 3, 2, 3, 3 } }, { 1, { 3 } } }, .attr = &vae_down }, /* right and bottom */
    { .in = { { 4, { 1, 2, 5, 7 } }, { 4, { 3, 2, 2, 3 } }, { 1, { 3 } } }, .attr = &lopsided }, /* all different */
    { .in = { { 4, { 1, 2, 2, 1 } }, { 4, { 2, 2, 3, 3 } }, { .n = -1 } }, .attr = &wide_border }, /* mostly zero */
    { .in = { { 5, { 2, 2, 3, 4, 5 } }, { 4, { 3, 2, 3, 3 } }, { 1, { 3 } } }, .attr = &same_3 },  /* frame by frame */
    { .in = { { 5, { 1, 2, 2, 4, 6 } }, { 4, { 3, 2, 3, 3 } }, { .n = -1 } }, .attr = &vae_down },
    { .in = { { 4, { 1, 67, 9, 33 } }, { 4, { 43, 67, 3, 3 } }, { 1, { 43 } } }, .attr = &same_3 }, /* several blocks */
    { .in = { { 4, { 1, 3, 17, 33 } }, { 4, { 2, 3, 3, 3 } }, { 1, { 2 } } }, .attr = &same_3 }, /* to few channels */
};

static const dar_error_sample conv2d_errors[] = {
    { .in = { { 3, { 3, 5, 7 } }, { 4, { 2, 3, 3, 3 } }, { .n = -1 } }, .attr = &same_3 },
    { .in = { { 4, { 1, 2, 5, 7 } }, { 4, { 2, 3, 3, 3 } }, { .n = -1 } }, .attr = &same_3 },  /* channels */
    { .in = { { 4, { 1, 3, 5, 7 } }, { 4, { 2, 3, 3, 3 } }, { 1, { 3 } } }, .attr = &same_3 }, /* bias */
    { .in = { { 4, { 1, 3, 2, 7 } }, { 4, { 2, 3, 3, 3 } }, { .n = -1 } }, .attr = &plain },   /* kernel too large */
    { .in = { { 5, { 1, 3, 2, 7, 7 } }, { 5, { 2, 3, 1, 3, 3 } }, { .n = -1 } }, .attr = &plain }, /* a 3-D kernel */
};

const dar_op dar_op_conv2d = {
    .name = "conv2d",
    .n_in = 3,
    .n_optional = 1,
    .keep = DAR_KEEP_X(X) | DAR_KEEP_X(WEIGHT),
    .attr_size = sizeof(dar_conv_attr),
    .shape = conv2d_shape,
    .scratch = scratch,
    .terms = terms,
    .flops = flops,
    .forward = forward,
    .backward = backward,
    .samples = conv2d_samples,
    .n_samples = DAR_COUNT(conv2d_samples),
    .errors = conv2d_errors,
    .n_errors = DAR_COUNT(conv2d_errors),
};

dar_val *dar_conv2d(dar_tape *t, dar_val *x, dar_val *w, dar_val *b, dar_conv_attr a)
{
    return dar_apply(t, &dar_op_conv2d, (dar_val *[]){ x, w, b }, 3, &a);
}

/* ---------------------------------------------------------------- conv3d */

static dar_shape conv3d_shape(const dar_shape *in, int n_in, const void *attr)
{
    char t[2][96];
    (void)n_in;
    DAR_ASSERT(in[X].n == 5 && in[WEIGHT].n == 5, "conv3d: x is %s, w is %s", dar_shape_text(&in[X], t[0], sizeof t[0]),
               dar_shape_text(&in[WEIGHT], t[1], sizeof t[1]));
    return out_shape(in, attr);
}

static const dar_conv_attr causal_3 = { 1, 1, 1, 1, 1, 1, 2 }, pointwise = { 1, 0, 0, 0, 0, 1, 0 };
static const dar_conv_attr time_3 = { 1, 0, 0, 0, 0, 1, 2 }, time_half = { 1, 0, 0, 0, 0, 2, 0 };
static const dar_conv_attr time_half_on = { 1, 0, 0, 0, 0, 2, 1 }, patches = { 2, 0, 0, 0, 0, 1, 0 };

#define NONE                                                                                                           \
    {                                                                                                                  \
        .n = -1                                                                                                        \
    }
#define CLIP(...)                                                                                                      \
    {                                                                                                                  \
        5,                                                                                                             \
        {                                                                                                              \
            __VA_ARGS__                                                                                                \
        }                                                                                                              \
    }
#define BIAS_OF(count)                                                                                                 \
    {                                                                                                                  \
        1,                                                                                                             \
        {                                                                                                              \
            count                                                                                                      \
        }                                                                                                              \
    }
static const dar_sample conv3d_samples[] = {
    { .in = { CLIP(1, 1, 1, 1, 1), CLIP(1, 1, 1, 1, 1), BIAS_OF(1), NONE }, .attr = &pointwise },
    { .in = { CLIP(2, 3, 2, 3, 5), CLIP(4, 3, 1, 1, 1), BIAS_OF(4), NONE }, .attr = &pointwise },
    { .in = { CLIP(2, 2, 3, 4, 5), CLIP(3, 2, 3, 3, 3), BIAS_OF(3), NONE }, .attr = &causal_3 }, /* zeros in front */
    { .in = { CLIP(1, 2, 1, 3, 4), CLIP(3, 2, 3, 3, 3), NONE, CLIP(1, 2, 1, 3, 4) },
      .attr = &causal_3 }, /* one frame */
    { .in = { CLIP(2, 2, 2, 3, 4), CLIP(3, 2, 3, 3, 3), BIAS_OF(3), CLIP(2, 2, 2, 3, 4) }, .attr = &causal_3 },
    { .in = { CLIP(1, 3, 2, 2, 3), CLIP(4, 3, 3, 1, 1), BIAS_OF(4), CLIP(1, 3, 2, 2, 3) }, .attr = &time_3 },
    { .in = { CLIP(1, 2, 5, 2, 3), CLIP(3, 2, 3, 1, 1), BIAS_OF(3), NONE }, .attr = &time_half },
    { .in = { CLIP(2, 2, 4, 2, 3), CLIP(3, 2, 3, 1, 1), BIAS_OF(3), CLIP(2, 2, 1, 2, 3) }, .attr = &time_half_on },
    { .in = { CLIP(2, 3, 2, 4, 6), CLIP(5, 3, 1, 2, 2), BIAS_OF(5), NONE }, .attr = &patches }, /* the DiT's patches */
};

static const dar_error_sample conv3d_errors[] = {
    { .in = { { 4, { 1, 2, 3, 4 } }, CLIP(3, 2, 3, 3, 3), NONE, NONE }, .attr = &causal_3 },
    { .in = { CLIP(1, 2, 2, 3, 4), CLIP(3, 2, 3, 3, 3), NONE, CLIP(1, 2, 3, 3, 4) }, .attr = &causal_3 }, /* too long */
    { .in = { CLIP(1, 2, 2, 3, 4), CLIP(3, 2, 3, 3, 3), NONE, CLIP(1, 2, 2, 4, 3) }, .attr = &causal_3 },
    { .in = { CLIP(1, 2, 2, 3, 4), CLIP(3, 2, 3, 1, 1), NONE, NONE }, .attr = &time_half }, /* too few frames */
};

const dar_op dar_op_conv3d = {
    .name = "conv3d",
    .n_in = 4,
    .n_optional = 2,
    .keep = DAR_KEEP_X(X) | DAR_KEEP_X(WEIGHT) | DAR_KEEP_X(HISTORY),
    .attr_size = sizeof(dar_conv_attr),
    .shape = conv3d_shape,
    .scratch = scratch,
    .terms = terms,
    .flops = flops,
    .forward = forward,
    .backward = backward,
    .samples = conv3d_samples,
    .n_samples = DAR_COUNT(conv3d_samples),
    .errors = conv3d_errors,
    .n_errors = DAR_COUNT(conv3d_errors),
};

dar_val *dar_conv3d(dar_tape *t, dar_val *x, dar_val *w, dar_val *b, dar_val *history, dar_conv_attr a)
{
    return dar_apply(t, &dar_op_conv3d, (dar_val *[]){ x, w, b, history }, 4, &a);
}

dar_conv_attr dar_conv_same(const dar_val *w)
{
    const dar_shape *s = &w->x.shape;
    int kh = (int)s->d[s->n - 2], kw = (int)s->d[s->n - 1];
    return (dar_conv_attr){ .stride = 1,
                            .top = kh / 2,
                            .bottom = kh / 2,
                            .left = kw / 2,
                            .right = kw / 2,
                            .stride_t = 1,
                            .front = s->n == 5 ? (int)s->d[2] - 1 : 0 };
}
