/* conv.c: convolution by the virtual operand col: y with a stride in time, and gx with strides. */
#include "lib/conv.h"

#include <string.h>

#include "lib/conv_clip.h"
#include "lib/conv_slide.h"
#include "lib/conv_weights.h"
#include "lib/kern.h"
#include "lib/size.h"
#include "lib/thread.h"
#include "lib/tile.h"

#define DEPTH  512 /* longest piece of a sum in one tile call of forward: a stripe of B stays near */
#define PIXELS 256 /* output pixels at a time; with DEPTH of them B fills half of a 1 MiB second-level cache */
#define ROWS   512 /* most rows of the result per task */
#define TASKS  16  /* wanted at least, */
#define LITTLE 96  /* but none with fewer rows: they pay for packing B */
#define FILL   16  /* rows of col made at a time before they are packed: first-level cache */
#define BESIDE 16  /* elements between rows of col, so that they do not share their place in the cache */

/* ---------------------------------------------------------------- the job: what all products share */

struct job {
    dar_conv c;
    const dar_tile *tile;
    dar_dtype operand, col, sum;                 /* types of packed operands, of col and of the result */
    size_t taps, K, P;                           /* kt kh kw, Cin taps, To Ho Wo */
    size_t m, n;                                 /* rows and columns of the result per task */
    size_t depth;                                /* longest sum per tile call */
    bool packs_a;                                /* A is packed in scratch before the tasks start */
    size_t shared;                               /* bytes of that */
    size_t a_bytes, b_bytes, c_bytes, col_bytes; /* of one thread */
};

/* Where the operands of one thread lie. */
struct room {
    char *a, *b, *c, *col;
};

static size_t own_bytes(const struct job *j)
{
    return j->a_bytes + j->b_bytes + j->c_bytes + j->col_bytes;
}

static struct room room_of(const struct job *j, void *scratch, int thread)
{
    char *p = (char *)scratch + j->shared + (size_t)thread * own_bytes(j);
    return (struct room){ p, p + j->a_bytes, p + j->a_bytes + j->b_bytes, p + j->a_bytes + j->b_bytes + j->c_bytes };
}

/* y, by pixels: few large tasks or many small ones, A shared by all. */
static void cut_pixels(struct job *j, dar_dtype w)
{
    const dar_tile *t = j->tile;
    size_t N = j->c.B * j->P, Cout = j->c.Cout;

    j->n = dar_even_block(N, PIXELS, t->nr, TASKS, PIXELS / 2);
    j->m = dar_even_block(Cout, ROWS, t->mr, dar_blocks(TASKS, dar_most(dar_blocks(N, j->n), 1)), LITTLE);
    j->depth = DEPTH;
    j->packs_a = w != j->operand || j->K % t->unit; /* else w is read where it lies */
    if (j->packs_a) j->shared = dar_round_up(dar_blocks(Cout, t->mr) * dar_tile_bytes_a(t, j->K), DAR_ALIGN);
    j->col_bytes = dar_round_up(FILL * (j->n + BESIDE) * dar_dtype_size(j->col), DAR_ALIGN);
}

/* gcol, by channels of x: a task adds to its channels alone. */
static void cut_channels(struct job *j)
{
    size_t wide = dar_even_block(j->c.Cin, dar_most(ROWS / j->taps, 1), 1, dar_blocks(TASKS, dar_most(j->c.B, 1)), 1);
    j->n = dar_even_block(j->P, PIXELS, j->tile->nr, 1, 1);
    j->m = wide * j->taps;
    j->depth = DEPTH;
    j->a_bytes = dar_round_up(dar_blocks(j->m, j->tile->mr) * dar_tile_bytes_a(j->tile, j->c.Cout), DAR_ALIGN);
}

static struct job job_of(const dar_conv *c, dar_conv_pass pass, dar_dtype x, dar_dtype w)
{
    static const dar_dtype of[] = { [DAR_TILE_F64] = DAR_F64, [DAR_TILE_F32] = DAR_F32, [DAR_TILE_BF16] = DAR_BF16 };
    dar_tile_kind kind = dar_tile_kind_for(x == DAR_BF16 && w != DAR_BF16 ? DAR_F32 : x);
    struct job j = { .c = *c, .operand = of[kind], .sum = dar_compute_type(x), .taps = c->kt * c->kh * c->kw };

    j.col = pass == DAR_CONV_FORWARD ? x : j.sum;
    j.K = j.c.Cin * j.taps;
    j.P = j.c.To * j.c.Ho * j.c.Wo;
    j.tile = dar_tile_for(kind, c->B * j.P);
    if (pass == DAR_CONV_FORWARD) cut_pixels(&j, w);
    else cut_channels(&j);
    j.b_bytes = dar_round_up((dar_blocks(j.n, j.tile->nr) * j.tile->nr + BESIDE) * dar_tile_units(j.tile, j.depth) *
                                 j.tile->unit_bytes,
                             DAR_ALIGN);
    j.c_bytes = dar_round_up(j.m * j.n * dar_dtype_size(j.sum), DAR_ALIGN);
    return j;
}

/* Without col: gx is a convolution of gy with the kernel turned round. */
static dar_conv_slide slide_of(const dar_conv *c, dar_conv_pass pass, dar_dtype x, dar_dtype w)
{
    dar_conv_slide s = { .c = *c, .turned = pass == DAR_CONV_BACK_X, .x_type = x, .w_type = w };
    if (s.turned)
        s.c = (dar_conv){ .B = c->B,
                          .Cin = c->Cout,
                          .T = c->To,
                          .H = c->Ho,
                          .W = c->Wo,
                          .Cout = c->Cin,
                          .kt = c->kt,
                          .kh = c->kh,
                          .kw = c->kw,
                          .stride = 1,
                          .top = (int64_t)c->kh - 1 - c->top,
                          .left = (int64_t)c->kw - 1 - c->left,
                          .stride_t = 1,
                          .front = (int64_t)(c->kt + c->past) - 1 - c->front,
                          .To = c->T + c->past,
                          .Ho = c->H,
                          .Wo = c->W };
    return s;
}

static bool slides(const dar_conv *c, dar_conv_pass pass)
{
    return c->stride_t == 1 && (pass == DAR_CONV_FORWARD || (pass == DAR_CONV_BACK_X && c->stride == 1));
}

size_t dar_conv_scratch(const dar_conv *c, dar_conv_pass pass, dar_dtype x, dar_dtype w, int threads)
{
    if (slides(c, pass)) {
        dar_conv_slide s = slide_of(c, pass, x, w);
        return dar_conv_slide_scratch(&s, threads);
    }
    if (pass == DAR_CONV_BACK_W) return dar_conv_weights_scratch(c, x, w, threads);
    struct job j = job_of(c, pass, x, w);
    return j.shared + (size_t)threads * own_bytes(&j);
}

/* Operands as the tile reads them [units]: unit (i, k) of A at i row + k step, unit (k, j) of B at k step + j; stripes
 * are `stripe` apart. */
struct lhs {
    const char *data;
    size_t row, step, stripe;
};

struct rhs {
    const char *data;
    size_t step, stripe;
};

static struct rhs packed_rhs(const struct job *j, const char *data)
{
    return (struct rhs){ data, j->tile->nr, dar_tile_units(j->tile, j->depth) * j->tile->nr };
}

/* c[m, n] (+)= a b over k elements. */
static void multiply(const struct job *j, struct lhs a, struct rhs b, size_t m, size_t n, size_t k, char *c, bool add)
{
    const dar_tile *t = j->tile;
    size_t size = dar_dtype_size(j->sum), units = dar_tile_units(t, k);

    for (size_t i = 0; i < m; i += t->mr, a.data += a.stripe * t->unit_bytes)
        for (size_t q = 0; q < n; q += t->nr)
            t->mm(units, a.data, a.row, a.step, b.data + q / t->nr * b.stripe * t->unit_bytes, b.step,
                  c + (i * j->n + q) * size, j->n, dar_least(t->mr, m - i), dar_least(t->nr, n - q), add);
}

/* ---------------------------------------------------------------- rows of col */

/* One row of col: input channel ci, and how far from an output pixel (t, h, w), times the stride, it reads. */
struct tap {
    size_t ci;
    int64_t dt, dy, dx;
    size_t first, last; /* output columns that read inside the frame */
};

/* Output columns before the first that reads column `to` or a later one. */
static size_t columns_before(const dar_conv *c, int64_t to, int64_t dx)
{
    if (to <= dx) return 0;
    size_t n = (size_t)(to - dx);
    return dar_least(c->stride == 1 ? n : dar_blocks(n, c->stride), c->Wo);
}

static struct tap tap_of(const struct job *j, size_t k)
{
    const dar_conv *c = &j->c;
    size_t tap = k % j->taps;
    struct tap e = { k / j->taps,
                     (int64_t)(tap / c->kw / c->kh) - c->front,
                     (int64_t)(tap / c->kw % c->kh) - c->top,
                     (int64_t)(tap % c->kw) - c->left,
                     0,
                     0 };
    e.first = columns_before(c, 0, e.dx);
    e.last = columns_before(c, (int64_t)c->W, e.dx);
    return e;
}

/* An output pixel. */
struct at {
    size_t b, t, h, w;
};

static struct at at_of(const dar_conv *c, size_t q)
{
    return (struct at){ q / c->Wo / c->Ho / c->To, q / c->Wo / c->Ho % c->To, q / c->Wo % c->Ho, q % c->Wo };
}

static void next_frame(const dar_conv *c, struct at *p)
{
    p->h = p->w = 0;
    if (++p->t < c->To) return;
    p->t = 0;
    p->b++;
}

/* A run of output pixels of one frame, row by row. */
#define EACH_ROW(c, p, n, length)                                                                                      \
    for (size_t length = dar_least((c)->Wo - (p).w, n); n;                                                             \
         n -= length, (p).w = 0, (p).h++, length = dar_least((c)->Wo, n))

/* n pixels of one frame where output and input rows are equally long and dense: one shifted copy, then the columns that
 * it took from neighbouring rows. */
static void fill_shifted(const struct job *j, const struct tap *e, struct at p, size_t n, dar_dtype type,
                         const char *frame, char *dst)
{
    const dar_conv *c = &j->c;
    int64_t at = ((int64_t)p.h + e->dy) * (int64_t)c->W + (int64_t)p.w + e->dx, end = (int64_t)(c->H * c->W);
    size_t size = dar_dtype_size(j->col), low = at < 0 ? dar_least((size_t)-at, n) : 0;
    size_t high = at >= end ? low : dar_most(low, dar_least(n, (size_t)(end - at)));

    dar_clip_zero(dst, low, size);
    if (high > low)
        dar_row_convert(j->col, dst + low * size, type, frame + (at + (int64_t)low) * (int64_t)dar_dtype_size(type),
                        high - low);
    dar_clip_zero(dst + high * size, n - high, size);
    if (e->first == 0 && e->last == c->Wo) return;
    EACH_ROW(c, p, n, length)
    {
        if (p.w < e->first) dar_clip_zero(dst, dar_least(e->first - p.w, length), size);
        if (p.w + length > e->last) {
            size_t from = dar_most(e->last, p.w) - p.w;
            dar_clip_zero(dst + from * size, length - from, size);
        }
        dst += length * size;
    }
}

/* Any stride. */
static void fill_rows(const struct job *j, const struct tap *e, struct at p, size_t n, dar_dtype type,
                      const char *frame, char *dst)
{
    const dar_conv *c = &j->c;
    size_t size = dar_dtype_size(j->col), from = dar_dtype_size(type);

    EACH_ROW(c, p, n, length)
    {
        int64_t row = (int64_t)(p.h * c->stride) + e->dy;
        bool inside = row >= 0 && row < (int64_t)c->H;
        size_t low = dar_most(e->first, p.w), high = dar_least(e->last, p.w + length);
        if (!inside || low >= high) {
            dar_clip_zero(dst, length, size);
        } else {
            const char *src = frame + (row * (int64_t)c->W + (int64_t)(low * c->stride) + e->dx) * (int64_t)from;
            dar_clip_zero(dst, low - p.w, size);
            if (c->stride == 1) dar_row_convert(j->col, dst + (low - p.w) * size, type, src, high - low);
            else
                for (size_t i = low; i < high; i++, src += c->stride * from)
                    dar_row_convert(j->col, dst + (i - p.w) * size, type, src, 1);
            dar_clip_zero(dst + (high - p.w) * size, p.w + length - high, size);
        }
        dst += length * size;
    }
}

/* Ask for the same pixels of the next channel: far away in memory, soon wanted. */
static void ahead(const struct job *j, const struct tap *e, const struct at *p, size_t n, dar_dtype type,
                  const char *frame)
{
    int64_t W = (int64_t)j->c.W, at = ((int64_t)(p->h * j->c.stride) + e->dy) * W + (int64_t)(p->w * j->c.stride);
    if (at >= 0 && at + (int64_t)n <= (int64_t)j->c.H * W)
        dar_row_ahead(frame + at * (int64_t)dar_dtype_size(type), n * dar_dtype_size(type));
}

/* n pixels of a row of col from pixel p. */
static void fill_row(const struct job *j, const struct tap *e, struct at p, size_t n, const dar_clip *v, char *dst)
{
    const dar_conv *c = &j->c;
    size_t size = dar_dtype_size(j->col);

    for (size_t m; n; n -= m, dst += m * size, next_frame(c, &p)) {
        m = dar_least(n, (c->Ho - p.h) * c->Wo - p.w);
        dar_dtype type;
        const char *frame = dar_clip_frame(v, p.b, e->ci, (int64_t)(p.t * c->stride_t) + e->dt, &type);
        if (frame && e->dx == 0 && e->ci + 1 < v->C)
            ahead(j, e, &p, m, type, frame + v->T * v->plane * dar_dtype_size(type));
        if (!frame) dar_clip_zero(dst, m, size);
        else if (c->stride == 1 && c->W == c->Wo) fill_shifted(j, e, p, m, type, frame, dst);
        else fill_rows(j, e, p, m, type, frame, dst);
    }
}

/* The reverse: add n pixels of a row of gcol to where they came from. */
static void spill_row(const struct job *j, const struct tap *e, struct at p, size_t n, const dar_clip *v,
                      const char *src)
{
    const dar_conv *c = &j->c;
    size_t size = dar_dtype_size(j->sum);

    for (size_t m; n; n -= m, next_frame(c, &p)) {
        m = dar_least(n, (c->Ho - p.h) * c->Wo - p.w);
        dar_dtype type;
        char *frame = dar_clip_frame(v, p.b, e->ci, (int64_t)(p.t * c->stride_t) + e->dt, &type);
        struct at r = p;
        size_t left = m;
        EACH_ROW(c, r, left, length)
        {
            int64_t row = (int64_t)(r.h * c->stride) + e->dy;
            size_t low = dar_most(e->first, r.w), high = dar_least(e->last, r.w + length);
            const char *from = src - r.w * size;
            src += length * size;
            if (!frame || row < 0 || row >= (int64_t)c->H) continue;
            char *to = frame + (row * (int64_t)c->W + e->dx) * (int64_t)size;
            if (j->sum == DAR_F64)
                for (size_t i = low; i < high; i++) ((double *)(void *)to)[i * c->stride] += ((const double *)from)[i];
            else
                for (size_t i = low; i < high; i++) ((float *)(void *)to)[i * c->stride] += ((const float *)from)[i];
        }
    }
}

/* ---------------------------------------------------------------- y */

struct forward {
    struct job j;
    dar_clip x;
    const dar_tensor *w, *b, *y; /* b may have no data */
    char *scratch;
};

/* B: rows k0.. of col at pixels q0...  Packed; or, where a unit is one element of col, row by row as they are. */
static struct rhs make_col(const struct forward *f, size_t q0, size_t n, size_t k0, size_t k, const struct room *r)
{
    const struct job *j = &f->j;
    const dar_tile *t = j->tile;
    size_t size = dar_dtype_size(j->col), ld = j->n + BESIDE;
    struct rhs b = j->col == j->operand && t->unit == 1 ? (struct rhs){ r->b, ld, t->nr } : packed_rhs(j, r->b);
    bool as_is = b.step == ld;
    struct at p = at_of(&j->c, q0);

    for (size_t i = 0; i < k; i += FILL) {
        size_t m = dar_least(FILL, k - i);
        char *rows = as_is ? r->b + i * ld * size : r->col;
        for (size_t u = 0; u < m; u++) {
            struct tap e = tap_of(j, k0 + i + u);
            fill_row(j, &e, p, n, &f->x, rows + u * ld * size);
        }
        for (size_t q = 0; q < n && !as_is; q += t->nr)
            dar_tile_pack_b_kn(t, j->col, rows + q * size, ld, m, dar_least(t->nr, n - q),
                               r->b + (q / t->nr * b.stripe + i / t->unit * t->nr) * t->unit_bytes);
    }
    return b;
}

/* Rows o0.., pixels q0.. of y = c + b. */
static void store(const struct forward *f, size_t o0, size_t m, size_t q0, size_t n, char *c)
{
    const struct job *j = &f->j;
    const dar_kern *k = dar_kern_for(j->sum);
    size_t size = dar_dtype_size(j->sum);
    dar_put mode = dar_put_for(dar_tensor_bytes(f->y), false);

    for (size_t o = 0; o < m; o++) {
        char *row = c + o * j->n * size;
        if (f->b->data) k->offset(n, dar_dtype_get(f->b->dtype, f->b->data, o0 + o), row, row);
        for (size_t i = 0, length; i < n; i += length) {
            size_t batch = (q0 + i) / j->P, p = (q0 + i) % j->P, at = (batch * j->c.Cout + o0 + o) * j->P + p;
            length = dar_least(n - i, j->P - p);
            dar_row_put(j->sum, row + i * size, f->y->dtype, (char *)f->y->data + at * dar_dtype_size(f->y->dtype),
                        length, mode);
        }
    }
}

static void forward_task(void *ctx, size_t i, int thread)
{
    const struct forward *f = ctx;
    const struct job *j = &f->j;
    const dar_tile *t = j->tile;
    size_t down = dar_blocks(j->c.Cout, j->m), o0 = i % down * j->m, q0 = i / down * j->n;
    size_t m = dar_least(j->m, j->c.Cout - o0), n = dar_least(j->n, j->c.B * j->P - q0);
    struct room r = room_of(j, f->scratch, thread);
    struct lhs a = { f->scratch, 1, t->mr, dar_tile_units(t, j->K) * t->mr };

    if (!j->packs_a) a = (struct lhs){ f->w->data, j->K / t->unit, 1, j->K / t->unit * t->mr };
    a.data += o0 / t->mr * a.stripe * t->unit_bytes;
    for (size_t k = 0; k < j->K; k += j->depth) {
        size_t depth = dar_least(j->depth, j->K - k);
        struct rhs b = make_col(f, q0, n, k, depth, &r);
        multiply(j, a, b, m, n, depth, r.c, k > 0);
        a.data += depth / t->unit * a.step * t->unit_bytes;
    }
    store(f, o0, m, q0, n, r.c);
}

static void pack_weights(void *ctx, size_t begin, size_t end, int thread)
{
    const struct forward *f = ctx;
    const struct job *j = &f->j;
    size_t row = j->K * dar_dtype_size(f->w->dtype);
    (void)thread;
    dar_tile_pack_a_mk(j->tile, f->w->dtype, (char *)f->w->data + begin * row, j->K, end - begin, j->K,
                       f->scratch + begin / j->tile->mr * dar_tile_bytes_a(j->tile, j->K));
}

static dar_clip clip_of(const dar_conv *c, const dar_tensor *x, const dar_tensor *past)
{
    return (dar_clip){ x, past, c->Cin, c->T, c->past, c->H * c->W };
}

static const dar_tensor none;

static dar_clip clip_of_y(const dar_conv *c, const dar_tensor *y)
{
    return (dar_clip){ y, &none, c->Cout, c->To, 0, c->Ho * c->Wo };
}

void dar_conv_forward(const dar_conv *c, const dar_tensor *x, const dar_tensor *w, const dar_tensor *b,
                      const dar_tensor *history, const dar_tensor *y, void *scratch)
{
    if (slides(c, DAR_CONV_FORWARD)) {
        dar_conv_slide s = slide_of(c, DAR_CONV_FORWARD, x->dtype, w->dtype);
        s.in = clip_of(c, x, history);
        s.out = clip_of_y(c, y);
        s.w = w, s.b = b;
        dar_conv_slide_run(&s, scratch);
        return;
    }
    struct forward f = { job_of(c, DAR_CONV_FORWARD, x->dtype, w->dtype), clip_of(c, x, history), w, b, y, scratch };
    const struct job *j = &f.j;
    size_t N = c->B * j->P;
    if (j->packs_a && N) dar_parallel_range(c->Cout, j->tile->mr, pack_weights, &f);
    dar_parallel(dar_blocks(c->Cout, j->m) * dar_blocks(N, j->n), forward_task, &f);
}

/* ---------------------------------------------------------------- gx for any stride */

struct back_x {
    struct job j;
    const dar_tensor *w, *gy;
    dar_clip gx;
    bool add, add_past;
    char *scratch;
};

static void clear(const dar_clip *v, const dar_tensor *g, size_t frames, size_t batch, size_t c0, size_t n)
{
    size_t channel = frames * v->plane * (g->data ? dar_dtype_size(g->dtype) : 0);
    if (channel) memset((char *)g->data + (batch * v->C + c0) * channel, 0, n * channel);
}

/* One task owns some channels of one batch element, so that what is added to them comes in one order. */
static void back_x_task(void *ctx, size_t i, int thread)
{
    const struct back_x *f = ctx;
    const struct job *j = &f->j;
    const dar_tile *t = j->tile;
    size_t Cout = j->c.Cout, wide = j->m / j->taps, across = dar_blocks(j->c.Cin, wide);
    size_t batch = i / across, c0 = i % across * wide, channels = dar_least(wide, j->c.Cin - c0),
           m = channels * j->taps;
    size_t ws = dar_dtype_size(f->w->dtype), gs = dar_dtype_size(f->gy->dtype), ss = dar_dtype_size(j->sum);
    struct room r = room_of(j, f->scratch, thread);

    if (!f->add) clear(&f->gx, f->gx.x, f->gx.T, batch, c0, channels);
    if (!f->add_past) clear(&f->gx, f->gx.past, f->gx.P, batch, c0, channels);
    for (size_t k = 0; k < m; k += t->mr)
        dar_tile_pack_a_km(t, f->w->dtype, (char *)f->w->data + (c0 * j->taps + k) * ws, j->K, dar_least(t->mr, m - k),
                           Cout, r.a + k / t->mr * dar_tile_bytes_a(t, Cout));
    for (size_t p = 0; p < j->P; p += j->n) {
        size_t n = dar_least(j->n, j->P - p);
        for (size_t o = 0; o < Cout; o += j->depth) {
            size_t depth = dar_least(j->depth, Cout - o);
            const char *gy = (char *)f->gy->data + ((batch * Cout + o) * j->P + p) * gs;
            for (size_t q = 0; q < n; q += t->nr)
                dar_tile_pack_b_kn(t, f->gy->dtype, gy + q * gs, j->P, depth, dar_least(t->nr, n - q),
                                   r.b + q / t->nr * dar_tile_bytes_b(t, j->depth));
            struct lhs a = { r.a + o / t->unit * t->mr * t->unit_bytes, 1, t->mr, dar_tile_units(t, Cout) * t->mr };
            multiply(j, a, packed_rhs(j, r.b), m, n, depth, r.c, o > 0);
        }
        for (size_t k = 0; k < m; k++) {
            struct tap e = tap_of(j, c0 * j->taps + k);
            spill_row(j, &e, at_of(&j->c, batch * j->P + p), n, &f->gx, r.c + k * j->n * ss);
        }
    }
}

void dar_conv_back_x(const dar_conv *c, dar_dtype x_type, const dar_tensor *w, const dar_tensor *gy,
                     const dar_tensor *gx, bool add, const dar_tensor *ghistory, bool add_history, void *scratch)
{
    if (slides(c, DAR_CONV_BACK_X)) {
        dar_conv_slide s = slide_of(c, DAR_CONV_BACK_X, x_type, w->dtype);
        s.in = clip_of_y(c, gy);
        s.out = clip_of(c, gx, ghistory);
        s.w = w, s.add = add, s.add_past = add_history;
        dar_conv_slide_run(&s, scratch);
        return;
    }
    struct back_x f = {
        job_of(c, DAR_CONV_BACK_X, x_type, w->dtype), w, gy, clip_of(c, gx, ghistory), add, add_history, scratch
    };
    dar_parallel(c->B * dar_blocks(c->Cin, f.j.m / f.j.taps), back_x_task, &f);
}

/* ---------------------------------------------------------------- gb */

struct back_b {
    const dar_conv *c;
    const dar_tensor *gy, *gb;
    bool add;
};

static void back_b_task(void *ctx, size_t o, int thread)
{
    const struct back_b *f = ctx;
    const dar_kern *k = dar_kern_for(f->gy->dtype);
    size_t P = f->c->To * f->c->Ho * f->c->Wo;
    double total = f->add ? dar_dtype_get(f->gb->dtype, f->gb->data, o) : 0;
    (void)thread;

    for (size_t batch = 0; batch < f->c->B; batch++)
        total += k->sum(P, (char *)f->gy->data + (batch * f->c->Cout + o) * P * dar_dtype_size(f->gy->dtype));
    dar_dtype_set(f->gb->dtype, f->gb->data, o, total);
}

void dar_conv_back_b(const dar_conv *c, const dar_tensor *gy, const dar_tensor *gb, bool add)
{
    struct back_b f = { c, gy, gb, add };
    dar_parallel(c->Cout, back_b_task, &f);
}
