/* linear.c: y = act(x W^T + b), and the same with a low-rank addition to W.
 *
 * Both are one computation on parts: without A and U it is the plain layer.
 *
 *   h = s x A^T             [M, r]   saved in aux (it is small, and gU needs it)
 *   p = x W^T + h U^T + b   [M, N]   saved in aux if there is an activation
 *   y = act(p)
 *
 *   gp = act'(p) gy         gb = sum of gp over rows
 *   gh = s gp U             gx = gp W + gh A
 *   gW = gp^T x             gU = gp^T h           gA = gh^T x
 *
 * With an activation gp is made for ROWS rows at a time, so that it never exists as a whole. */
#include "autograd/ops.h"

#include "autograd/bcast.h"
#include "lib/gemm.h"
#include "lib/thread.h"

enum { X, W, B, A = 2, U, LORA_B };

#define ROWS 2048

struct attr {
    dar_linear_opt o;
    double scale;
};

struct parts {
    const dar_opctx *c;
    const struct attr *at;
    size_t m, n, k, r;     /* r: 0 without LoRA */
    int bias;              /* index of the bias among the inputs */
    dar_dtype type, g;     /* arithmetic; of gp */
    dar_tile_kind kind;    /* of the products */
    char *h, *p;           /* in aux; NULL: not saved */
    char *own_h, *gp, *gh; /* in scratch */
    void *rest;            /* scratch of the products and sums */
    size_t head;           /* bytes of scratch before it */
};

static bool is_lora(const dar_opctx *c)
{
    return c->attr && c->x[A].shape.n == 2; /* a bias has one dimension */
}

static size_t bytes(const struct parts *s, size_t rows, size_t cols)
{
    size_t n = dar_mul_size(dar_mul_size(rows, cols), dar_dtype_size(s->type));
    return (n + DAR_ALIGN - 1) / DAR_ALIGN * DAR_ALIGN;
}

/* Rows that backward handles at a time. */
static size_t piece(const struct parts *s)
{
    return s->at->o.act && s->m > ROWS ? ROWS : s->m;
}

static struct parts parts_of(const dar_opctx *c, bool backward)
{
    const dar_tensor *x = &c->x[X], *w = &c->x[W];
    bool lora = is_lora(c);
    struct parts s = { .c = c, .at = c->attr, .type = dar_op_compute(c), .bias = lora ? LORA_B : B };

    s.m = dar_tensor_rows(x);
    s.k = dar_tensor_cols(x);
    s.n = (size_t)w->shape.d[0];
    s.r = lora ? (size_t)c->x[A].shape.d[0] : 0;
    s.g = s.at->o.act ? s.type : c->gy.dtype;
    s.kind = s.type == DAR_F64 ? DAR_TILE_F64 : dar_gemm_kind(x->dtype, w->dtype == DAR_I8 ? x->dtype : w->dtype);
    if (c->aux.data) {
        s.h = s.r ? c->aux.data : NULL;
        s.p = s.at->o.act ? (char *)c->aux.data + s.m * s.r * dar_dtype_size(s.type) : NULL;
    }
    size_t gp = s.at->o.act ? bytes(&s, piece(&s), s.n) : 0;
    s.head = backward ? gp + bytes(&s, piece(&s), s.r) : bytes(&s, s.m, s.r);
    if (c->scratch) {
        s.own_h = s.gp = c->scratch;
        s.gh = s.gp + gp;
        s.rest = s.gp + s.head;
    }
    return s;
}

static dar_matrix matrix(dar_dtype type, const void *data, size_t ld, bool transposed)
{
    return (dar_matrix){ .type = type, .data = data, .ld = ld, .t = transposed };
}

static dar_matrix matrix_of(const dar_tensor *x, bool transposed)
{
    dar_matrix a = matrix(x->dtype, x->data, dar_tensor_cols(x), transposed);
    a.scale = x->scale;
    return a;
}

/* ---------------------------------------------------------------- products */

/* h = s x A^T; m = 0 without LoRA. */
static dar_gemm down(const struct parts *s)
{
    if (!s->r) return (dar_gemm){ .kind = s->kind, .type = s->type };
    return (dar_gemm){
        .kind = s->kind,
        .m = s->m,
        .n = s->r,
        .k = s->k,
        .a = matrix_of(&s->c->x[X], false),
        .b = matrix_of(&s->c->x[A], true),
        .alpha = s->at->scale,
        .type = s->type,
        .c = s->h ? s->h : s->own_h,
        .ldc = s->r,
    };
}

static dar_gemm up(const struct parts *s)
{
    const dar_tensor *b = &s->c->x[s->bias];
    dar_gemm g = {
        .kind = s->kind,
        .m = s->m,
        .n = s->n,
        .k = s->k,
        .a = matrix_of(&s->c->x[X], false),
        .b = matrix_of(&s->c->x[W], true),
        .alpha = 1,
        .type = s->c->y.dtype,
        .c = s->c->y.data,
        .ldc = s->n,
        .bias = b->data,
        .bias_type = b->dtype,
        .pre = s->p,
        .act = s->at->o.act ? dar_kern_for(s->type)->gelu_tanh : NULL,
    };
    if (!s->r) return g;
    g.k2 = s->r;
    g.a2 = matrix(s->type, s->h ? s->h : s->own_h, s->r, false);
    g.b2 = matrix_of(&s->c->x[U], true);
    return g;
}

/* 8 bits by 8 bits: not where the arbiter computes, nor on top of a low-rank term. */
static bool quantised(const struct parts *s)
{
    return s->at->o.quantise && s->c->x[W].dtype == DAR_I8 && s->type == DAR_F32 && !s->r;
}

static dar_gemm_i8 up_i8(const struct parts *s)
{
    const dar_tensor *x = &s->c->x[X], *w = &s->c->x[W];
    dar_gemm g = up(s);
    return (dar_gemm_i8){
        .m = g.m,
        .n = g.n,
        .k = g.k,
        .a_type = x->dtype,
        .a = x->data,
        .lda = s->k,
        .w = w->data,
        .w_scale = w->scale,
        .type = g.type,
        .c = g.c,
        .ldc = g.ldc,
        .bias = g.bias,
        .bias_type = g.bias_type,
        .pre = g.pre,
        .act = g.act,
    };
}

/* The products of backward over rows [i, i + m), whose gp lies at `gp`.  m = 0: none is wanted. */
static dar_gemm back(const struct parts *s, int of, size_t i, size_t m, const char *gp)
{
    const dar_opctx *c = s->c;
    const dar_tensor *x = &c->x[X];
    size_t e = dar_dtype_size(s->type);
    dar_matrix g = matrix(s->g, gp, s->n, false), gt = matrix(s->g, gp, s->n, true);
    dar_matrix rows = matrix(x->dtype, (const char *)x->data + i * s->k * dar_dtype_size(x->dtype), s->k, false);
    dar_gemm p = { .kind = s->kind, .alpha = 1, .type = s->type, .add = i || c->add[of] };

    if (!c->gx[of].data) return p;
    p.c = c->gx[of].data;
    if (of == X) {
        p.m = m, p.n = s->k, p.k = s->n;
        p.a = g, p.b = matrix_of(&c->x[W], false);
        if (s->r) p.k2 = s->r, p.a2 = matrix(s->type, s->gh, s->r, false), p.b2 = matrix_of(&c->x[A], false);
        p.type = c->gx[X].dtype;
        p.c = (char *)p.c + i * s->k * dar_dtype_size(p.type);
        p.add = c->add[X];
    } else if (of == W) {
        p.m = s->n, p.n = s->k, p.k = m;
        p.a = gt, p.b = rows;
    } else if (of == A) {
        p.m = s->r, p.n = s->k, p.k = m;
        p.a = matrix(s->type, s->gh, s->r, true), p.b = rows;
    } else {
        p.m = s->n, p.n = s->r, p.k = m;
        p.a = gt, p.b = matrix(s->type, s->h ? s->h + i * s->r * e : NULL, s->r, false);
    }
    p.ldc = p.n;
    return p;
}

/* gh = s gp U */
static dar_gemm back_h(const struct parts *s, size_t m, const char *gp)
{
    if (!s->r || !(s->c->gx[X].data || s->c->gx[A].data)) return (dar_gemm){ .kind = s->kind, .type = s->type };
    return (dar_gemm){
        .kind = s->kind,
        .m = m,
        .n = s->r,
        .k = s->n,
        .a = matrix(s->g, gp, s->n, false),
        .b = matrix_of(&s->c->x[U], false),
        .alpha = s->at->scale,
        .type = s->type,
        .c = s->gh,
        .ldc = s->r,
    };
}

static dar_bcast bias_sum(const struct parts *s, dar_tensor *rows, size_t i, size_t m, char *gp)
{
    *rows = dar_tensor_of(s->g, DAR_SHAPE((int64_t)m, (int64_t)s->n), gp);
    return (dar_bcast){
        .x = { rows }, .y = &s->c->gx[s->bias], .add = i || s->c->add[s->bias], .factor = 1, .scratch = s->rest
    };
}

/* ---------------------------------------------------------------- forward, backward */

static void forward(const dar_opctx *c)
{
    struct parts s = parts_of(c, false);
    dar_gemm h = down(&s), y = up(&s);

    if (quantised(&s)) {
        dar_gemm_i8 q = up_i8(&s);
        dar_gemm_i8_run(&q, s.rest);
        return;
    }
    dar_gemm_run(&h, s.rest);
    dar_gemm_run(&y, s.rest);
}

struct act_back {
    const struct parts *s;
    size_t first; /* element of gy where this piece begins */
};

static void act_range(void *ctx, size_t begin, size_t end, int thread)
{
    const struct act_back *a = ctx;
    const struct parts *s = a->s;
    const dar_tensor *gy = &s->c->gy;
    size_t e = dar_dtype_size(s->type);
    double buf[DAR_PIECE];
    (void)thread;
    for (size_t i = begin, n; i < end; i += n) {
        n = end - i < DAR_PIECE ? end - i : DAR_PIECE;
        const void *g = dar_row_get(s->type, gy->dtype, dar_tensor_at(gy, a->first + i), n, buf);
        dar_kern_for(s->type)->gelu_tanh_back(n, s->p + (a->first + i) * e, g, s->gp + i * e);
    }
}

static void backward(const dar_opctx *c)
{
    struct parts s = parts_of(c, true);

    for (size_t i = 0; i < s.m; i += piece(&s)) {
        size_t m = s.m - i < piece(&s) ? s.m - i : piece(&s);
        char *gp = dar_tensor_at(&c->gy, i * s.n);
        if (s.at->o.act) {
            struct act_back a = { &s, i * s.n };
            dar_parallel_range(m * s.n, 16 * DAR_PIECE, act_range, &a);
            gp = s.gp;
        }
        if (c->gx[s.bias].data) {
            dar_tensor rows;
            dar_bcast b = bias_sum(&s, &rows, i, m, gp);
            dar_bcast_sum(&b);
        }
        dar_gemm gh = back_h(&s, m, gp);
        dar_gemm_run(&gh, s.rest);
        for (int of = (s.r ? LORA_B : B) - 1; of >= X; of--) { /* gx last: it may lie over x */
            dar_gemm g = back(&s, of, i, m, gp);
            dar_gemm_run(&g, s.rest);
        }
    }
}

static size_t larger(size_t a, size_t b)
{
    return a > b ? a : b;
}

static size_t scratch(const dar_opctx *c, bool backward)
{
    struct parts s = parts_of(c, backward);
    size_t rest = 0;
    dar_gemm h = down(&s), y = up(&s);

    if (!backward) {
        dar_gemm_i8 q = up_i8(&s);
        rest = larger(dar_gemm_scratch(&h), dar_gemm_scratch(&y));
        return s.head + (quantised(&s) ? dar_gemm_i8_scratch(&q) : rest);
    }
    for (size_t i = 0; i < s.m; i += piece(&s)) { /* the last piece may be cut otherwise than the first */
        size_t m = s.m - i < piece(&s) ? s.m - i : piece(&s);
        dar_gemm gh = back_h(&s, m, NULL);
        rest = larger(rest, dar_gemm_scratch(&gh));
        for (int of = 0; of < (s.r ? LORA_B : B); of++) {
            dar_gemm g = back(&s, of, i, m, NULL);
            rest = larger(rest, dar_gemm_scratch(&g));
        }
        if (c->gx[s.bias].data) {
            dar_tensor rows;
            dar_bcast b = bias_sum(&s, &rows, i, m, NULL);
            rest = larger(rest, dar_bcast_sum_scratch(&b));
        }
    }
    return s.head + rest;
}

static double flops(const dar_opctx *c, bool backward)
{
    struct parts s = parts_of(c, backward);
    double full = 2 * (double)s.m * (double)s.n * (double)s.k;
    double narrow_k = 2 * (double)s.m * (double)s.r * (double)s.k,
           narrow_n = 2 * (double)s.m * (double)s.r * (double)s.n;
    bool gx = c->gx[X].data, ga = s.r && c->gx[A].data, gu = s.r && c->gx[U].data;

    if (!backward) return full + narrow_k + narrow_n;
    return full * (gx + (c->gx[W].data != NULL)) + narrow_k * (gx + ga) + narrow_n * ((gx || ga) + gu);
}

/* ---------------------------------------------------------------- shapes */

static dar_shape shape_of(const char *name, const dar_shape *in, int n_in, int bias)
{
    const dar_shape *x = &in[X], *w = &in[W];
    dar_shape y = *x;
    char a[96], b[96];

    DAR_ASSERT(x->n >= 1 && w->n == 2 && x->d[x->n - 1] == w->d[1], "%s: x %s, w %s", name,
               dar_shape_text(x, a, sizeof a), dar_shape_text(w, b, sizeof b));
    if (n_in > bias && in[bias].n >= 0)
        DAR_ASSERT(in[bias].n == 1 && in[bias].d[0] == w->d[0], "%s: bias %s for w %s", name,
                   dar_shape_text(&in[bias], a, sizeof a), dar_shape_text(w, b, sizeof b));
    y.d[y.n - 1] = w->d[0];
    return y;
}

static dar_shape linear_shape(const dar_shape *in, int n_in, const void *attr)
{
    (void)attr;
    return shape_of("linear", in, n_in, B);
}

static dar_shape lora_shape(const dar_shape *in, int n_in, const void *attr)
{
    const dar_shape *w = &in[W], *a = &in[A], *u = &in[U];
    char s[96], v[96];
    (void)attr;
    DAR_ASSERT(a->n == 2 && u->n == 2 && w->n == 2 && a->d[0] == u->d[1] && a->d[1] == w->d[1] && u->d[0] == w->d[0],
               "lora: a %s, u %s do not fit w", dar_shape_text(a, s, sizeof s), dar_shape_text(u, v, sizeof v));
    return shape_of("lora", in, n_in, LORA_B);
}

static dar_dtype type_of(const dar_dtype *in, int n_in, const void *attr)
{
    const struct attr *at = attr;
    (void)n_in;
    return at->o.cast ? at->o.out : in[X];
}

/* h and p, one after the other. */
static dar_shape aux_of(const dar_shape *in, const struct attr *at, int64_t rank)
{
    int64_t rows = 1;
    for (int i = 0; i + 1 < in[X].n; i++) rows *= in[X].d[i];
    return DAR_SHAPE(rows * (rank + (at->o.act ? in[W].d[0] : 0)));
}

static dar_shape linear_aux(const dar_shape *in, int n_in, const void *attr)
{
    (void)n_in;
    return aux_of(in, attr, 0);
}

static dar_shape lora_aux(const dar_shape *in, int n_in, const void *attr)
{
    (void)n_in;
    return aux_of(in, attr, in[A].d[0]);
}

static double terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    double m = 1, n = (double)in[W].d[0], k = (double)in[W].d[1];
    double r = n_in > U && in[U].n == 2 ? (double)in[U].d[1] : 0;
    (void)attr;
    for (int i = 0; i + 1 < in[X].n; i++) m *= (double)in[X].d[i];
    if (of < 0) return k + (r > 0 ? r + k : 0);
    if (of == X) return n + (r > 0 ? r + n : 0);
    return m + (r > 0 ? n + k : 0);
}

/* ---------------------------------------------------------------- samples */

#define PLAIN                                                                                                          \
    &(const struct attr)                                                                                               \
    {                                                                                                                  \
        .scale = 1                                                                                                     \
    }
#define GELU                                                                                                           \
    &(const struct attr)                                                                                               \
    {                                                                                                                  \
        { .act = DAR_ACT_GELU_TANH }, 1                                                                                \
    }
#define HALF                                                                                                           \
    &(const struct attr)                                                                                               \
    {                                                                                                                  \
        .scale = 0.5                                                                                                   \
    }
#define GELU_3                                                                                                         \
    &(const struct attr)                                                                                               \
    {                                                                                                                  \
        { .act = DAR_ACT_GELU_TANH }, 3                                                                                \
    }
#define ABSENT                                                                                                         \
    {                                                                                                                  \
        -1,                                                                                                            \
        {                                                                                                              \
            0                                                                                                          \
        }                                                                                                              \
    }

static const dar_sample linear_samples[] = {
    { .in = { { 2, { 1, 1 } }, { 2, { 1, 1 } }, ABSENT }, .attr = PLAIN },
    { .in = { { 1, { 7 } }, { 2, { 3, 7 } }, { 1, { 3 } } }, .attr = PLAIN },        /* a single row */
    { .in = { { 2, { 9, 33 } }, { 2, { 17, 33 } }, { 1, { 17 } } }, .attr = PLAIN }, /* odd everywhere */
    { .in = { { 3, { 2, 5, 8 } }, { 2, { 70, 8 } }, ABSENT }, .attr = PLAIN },       /* past one tile */
    { .in = { { 3, { 2, 5, 6 } }, { 2, { 7, 6 } }, { 1, { 7 } } }, .attr = GELU },
    { .in = { { 2, { 3, 4 } }, { 2, { 5, 4 } }, ABSENT }, .attr = GELU },
    { .in = { { 2, { ROWS + 3, 2 } }, { 2, { 3, 2 } }, { 1, { 3 } } }, .attr = GELU }, /* two pieces */
    { .in = { { 2, { 3, 1500 } }, { 2, { 2, 1500 } }, { 1, { 2 } } }, .attr = PLAIN }, /* blocks of k */
};

static const dar_error_sample linear_errors[] = {
    { .in = { { 2, { 3, 4 } }, { 2, { 5, 3 } }, ABSENT }, .attr = PLAIN },
    { .in = { { 2, { 3, 4 } }, { 2, { 5, 4 } }, { 1, { 4 } } }, .attr = PLAIN },
    { .in = { { 2, { 3, 4 } }, { 3, { 1, 5, 4 } }, ABSENT }, .attr = PLAIN },
    { .in = { { 0 }, { 2, { 5, 1 } }, ABSENT }, .attr = PLAIN },
};

static const dar_sample lora_samples[] = {
    { .in = { { 2, { 1, 1 } }, { 2, { 1, 1 } }, { 2, { 1, 1 } }, { 2, { 1, 1 } }, ABSENT }, .attr = PLAIN },
    { .in = { { 3, { 2, 5, 9 } }, { 2, { 7, 9 } }, { 2, { 3, 9 } }, { 2, { 7, 3 } }, { 1, { 7 } } }, .attr = HALF },
    { .in = { { 2, { 9, 33 } }, { 2, { 17, 33 } }, { 2, { 20, 33 } }, { 2, { 17, 20 } }, ABSENT }, .attr = HALF },
    { .in = { { 2, { 5, 6 } }, { 2, { 7, 6 } }, { 2, { 2, 6 } }, { 2, { 7, 2 } }, { 1, { 7 } } }, .attr = GELU_3 },
    { .in = { { 2, { ROWS + 3, 2 } }, { 2, { 3, 2 } }, { 2, { 1, 2 } }, { 2, { 3, 1 } }, { 1, { 3 } } },
      .attr = GELU_3 },
};

static const dar_error_sample lora_errors[] = {
    { .in = { { 2, { 5, 6 } }, { 2, { 7, 6 } }, { 2, { 2, 6 } }, { 2, { 7, 3 } }, ABSENT }, .attr = PLAIN },
    { .in = { { 2, { 5, 6 } }, { 2, { 7, 6 } }, { 2, { 2, 5 } }, { 2, { 7, 2 } }, ABSENT }, .attr = PLAIN },
    { .in = { { 2, { 5, 6 } }, { 2, { 7, 6 } }, { 2, { 2, 6 } }, { 2, { 6, 2 } }, ABSENT }, .attr = PLAIN },
};

const dar_op dar_op_linear = {
    .name = "linear",
    .n_in = 3,
    .n_optional = 1,
    .keep = DAR_KEEP_X(X) | DAR_KEEP_X(W),
    .over = true,
    .half = DAR_KEEP_X(X) | DAR_KEEP_Y,
    .attr_size = sizeof(struct attr),
    .shape = linear_shape,
    .dtype = type_of,
    .aux = linear_aux,
    .scratch = scratch,
    .terms = terms,
    .flops = flops,
    .forward = forward,
    .backward = backward,
    .samples = linear_samples,
    .n_samples = DAR_COUNT(linear_samples),
    .errors = linear_errors,
    .n_errors = DAR_COUNT(linear_errors),
};

const dar_op dar_op_lora = {
    .name = "lora",
    .n_in = 5,
    .n_optional = 1,
    .keep = DAR_KEEP_X(X) | DAR_KEEP_X(W) | DAR_KEEP_X(A) | DAR_KEEP_X(U),
    .over = true,
    .half = DAR_KEEP_X(X) | DAR_KEEP_Y,
    .attr_size = sizeof(struct attr),
    .shape = lora_shape,
    .dtype = type_of,
    .aux = lora_aux,
    .scratch = scratch,
    .terms = terms,
    .flops = flops,
    .forward = forward,
    .backward = backward,
    .samples = lora_samples,
    .n_samples = DAR_COUNT(lora_samples),
    .errors = lora_errors,
    .n_errors = DAR_COUNT(lora_errors),
};

dar_val *dar_linear(dar_tape *t, dar_val *x, dar_val *w, dar_val *b, const dar_linear_opt *o)
{
    struct attr at = { .scale = 1 };
    if (o) at.o = *o;
    return dar_apply_kept(t, &dar_op_linear, (dar_val *[]){ x, w, b }, 3, &at, at.o.keep);
}

dar_val *dar_lora(dar_tape *t, dar_val *x, dar_val *w, dar_val *b, dar_val *a, dar_val *u, double scale,
                  const dar_linear_opt *o)
{
    struct attr at = { .scale = scale };
    if (o) at.o = *o;
    return dar_apply_kept(t, &dar_op_lora, (dar_val *[]){ x, w, a, u, b }, 5, &at, at.o.keep);
}
