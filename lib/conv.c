/* conv.c: the virtual operand, and the three products around it. */
#include "lib/conv.h"

#include <string.h>

#include "lib/conv_fold.h"
#include "lib/kern.h"
#include "lib/thread.h"
#include "lib/tile.h"

#define DEPTH  512  /* longest piece of a sum in one tile call of forward: a stripe of B stays near */
#define PIXELS 256  /* output pixels at a time; with DEPTH of them B fills half of a 1 MiB second-level cache */
#define ROWS   512  /* most rows of the result per task */
#define TASKS  16   /* wanted at least, */
#define LITTLE 96   /* but none with fewer rows: they pay for packing B */
#define FILL   16   /* rows of col made at a time before they are packed: first-level cache */
#define BESIDE 16   /* elements between rows of col, so that they do not share their place in the cache */
#define GROUP  16   /* output channels of w turned at a time; even: whole units */
#define LANES  48   /* input channels, likewise; whole stripes of every tile */
#define FLUSH  8192 /* pixels summed in one accumulator before it goes to gw: bounds the error of long sums */
#define LINE   16   /* columns of gw^T turned at a time: a cache line of f32 */

static size_t least(size_t a, size_t b)
{
    return a < b ? a : b;
}

static size_t most(size_t a, size_t b)
{
    return a > b ? a : b;
}

static size_t blocks_of(size_t n, size_t block)
{
    return n / block + (n % block != 0);
}

/* Length of equal blocks of n: at most `limit`, a multiple of `unit`, and `wanted` of them if none is below `little`.
 */
static size_t even_block(size_t n, size_t limit, size_t unit, size_t wanted, size_t little)
{
    size_t count = most(blocks_of(n, limit), least(wanted, blocks_of(n, little)));
    return most(blocks_of(blocks_of(n, most(count, 1)), unit), 1) * unit;
}

/* ---------------------------------------------------------------- the job: what all products share */

struct job {
    dar_conv c; /* whose col is the virtual operand; for gx that of the mirrored convolution, from y to x */
    bool mirrored;
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

static size_t aligned(size_t n)
{
    return blocks_of(n, DAR_ALIGN) * DAR_ALIGN;
}

static size_t own_bytes(const struct job *j)
{
    return j->a_bytes + j->b_bytes + j->c_bytes + j->col_bytes;
}

static struct room room_of(const struct job *j, void *scratch, int thread)
{
    char *p = (char *)scratch + j->shared + (size_t)thread * own_bytes(j);
    return (struct room){ p, p + j->a_bytes, p + j->a_bytes + j->b_bytes, p + j->a_bytes + j->b_bytes + j->c_bytes };
}

static bool unit_strides(const dar_conv *c)
{
    return c->stride == 1 && c->stride_t == 1;
}

/* gx is a convolution of gy with the kernel turned round: taps are counted as in w, and read from the other end. */
static dar_conv mirror(const dar_conv *c)
{
    return (dar_conv){ .B = c->B,
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
}

/* y or gx, by pixels: few large tasks or many small ones, A shared by all. */
static void cut_pixels(struct job *j, dar_dtype w)
{
    const dar_tile *t = j->tile;
    size_t N = j->c.B * j->P, Cout = j->c.Cout;

    j->n = even_block(N, PIXELS, t->nr, TASKS, PIXELS / 2);
    j->m = even_block(Cout, ROWS, t->mr, blocks_of(TASKS, most(blocks_of(N, j->n), 1)), LITTLE);
    j->depth = DEPTH;
    j->packs_a = j->mirrored || w != j->operand || j->K % t->unit; /* else w is read where it lies */
    if (j->packs_a) j->shared = aligned(blocks_of(Cout, t->mr) * dar_tile_bytes_a(t, j->K));
    j->col_bytes =
        aligned(most(FILL * (j->n + BESIDE) * dar_dtype_size(j->col), LANES * GROUP * j->taps * dar_dtype_size(w)));
}

/* gcol, by channels of x: a task adds to its channels alone. */
static void cut_channels(struct job *j)
{
    size_t wide = even_block(j->c.Cin, most(ROWS / j->taps, 1), 1, blocks_of(TASKS, most(j->c.B, 1)), 1);
    j->n = even_block(j->P, PIXELS, j->tile->nr, 1, 1);
    j->m = wide * j->taps;
    j->depth = DEPTH;
    j->a_bytes = aligned(blocks_of(j->m, j->tile->mr) * dar_tile_bytes_a(j->tile, j->c.Cout));
}

/* gw^T, by blocks: a task sums over all pixels. */
static void cut_weights(struct job *j)
{
    j->n = even_block(j->c.Cout, PIXELS, j->tile->nr, 1, 1);
    j->m = even_block(j->K, ROWS, j->tile->mr, blocks_of(TASKS, blocks_of(j->c.Cout, j->n)), 2 * LITTLE);
    j->depth = PIXELS;
    j->a_bytes = aligned(j->m * j->depth * dar_dtype_size(j->operand));
    j->col_bytes = aligned(LINE * (j->m + LINE) * dar_dtype_size(j->sum));
}

static struct job job_of(const dar_conv *c, dar_conv_pass pass, dar_dtype x, dar_dtype w)
{
    static const dar_dtype of[] = { [DAR_TILE_F64] = DAR_F64, [DAR_TILE_F32] = DAR_F32, [DAR_TILE_BF16] = DAR_BF16 };
    dar_tile_kind kind = dar_tile_kind_for(x == DAR_BF16 && w != DAR_BF16 ? DAR_F32 : x);
    struct job j = { .c = *c, .operand = of[kind], .sum = dar_compute_type(x), .taps = c->kt * c->kh * c->kw };

    j.mirrored = pass == DAR_CONV_BACK_X && unit_strides(c);
    if (j.mirrored) j.c = mirror(c);
    j.col = pass == DAR_CONV_FORWARD ? x : pass == DAR_CONV_BACK_X ? j.sum : j.operand;
    j.K = j.c.Cin * j.taps;
    j.P = j.c.To * j.c.Ho * j.c.Wo;
    j.tile = dar_tile_for(kind, pass == DAR_CONV_BACK_W ? c->Cout : c->B * j.P);
    if (pass == DAR_CONV_FORWARD || j.mirrored) cut_pixels(&j, w);
    else if (pass == DAR_CONV_BACK_X) cut_channels(&j);
    else cut_weights(&j);
    j.b_bytes = aligned((blocks_of(j.n, j.tile->nr) * j.tile->nr + BESIDE) * dar_tile_units(j.tile, j.depth) *
                        j.tile->unit_bytes);
    j.c_bytes = aligned(j.m * j.n * dar_dtype_size(j.sum));
    return j;
}

size_t dar_conv_scratch(const dar_conv *c, dar_conv_pass pass, dar_dtype x, dar_dtype w, int threads)
{
    if (pass == DAR_CONV_FORWARD && dar_conv_fold_fits(c)) return dar_conv_fold_scratch(c, x, w, threads);
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
                  c + (i * j->n + q) * size, j->n, least(t->mr, m - i), least(t->nr, n - q), add);
}

/* ---------------------------------------------------------------- rows of col */

/* Channels by frames of x and of history before it; a frame that is nowhere is zero. */
struct clip {
    const dar_tensor *x, *past;
    size_t C, T, P; /* T frames in x, P in past */
    size_t plane;   /* pixels of a frame */
};

static char *frame_of(const struct clip *v, size_t b, size_t c, int64_t t, dar_dtype *type)
{
    const dar_tensor *of = t < 0 ? v->past : v->x;
    size_t frames = t < 0 ? v->P : v->T;
    if (t < 0) t += (int64_t)v->P;
    if (t < 0 || (size_t)t >= frames || !of->data) return NULL;
    *type = of->dtype;
    return (char *)of->data + ((b * v->C + c) * frames + (size_t)t) * v->plane * dar_dtype_size(of->dtype);
}

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
    return least(c->stride == 1 ? n : blocks_of(n, c->stride), c->Wo);
}

static struct tap tap_of(const struct job *j, size_t k)
{
    const dar_conv *c = &j->c;
    size_t tap = k % j->taps;
    if (j->mirrored) tap = j->taps - 1 - tap;
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
    for (size_t length = least((c)->Wo - (p).w, n); n; n -= length, (p).w = 0, (p).h++, length = least((c)->Wo, n))

static void zero(char *dst, size_t n, size_t size)
{
    if (n == 1 && size == 4) *(uint32_t *)(void *)dst = 0; /* the usual border */
    else if (n == 1 && size == 2) *(uint16_t *)(void *)dst = 0;
    else if (n) memset(dst, 0, n * size);
}

/* n pixels of one frame where output and input rows are equally long and dense: one shifted copy, then the columns that
 * it took from neighbouring rows. */
static void fill_shifted(const struct job *j, const struct tap *e, struct at p, size_t n, dar_dtype type,
                         const char *frame, char *dst)
{
    const dar_conv *c = &j->c;
    int64_t at = ((int64_t)p.h + e->dy) * (int64_t)c->W + (int64_t)p.w + e->dx, end = (int64_t)(c->H * c->W);
    size_t size = dar_dtype_size(j->col), low = at < 0 ? least((size_t)-at, n) : 0;
    size_t high = at >= end ? low : most(low, least(n, (size_t)(end - at)));

    zero(dst, low, size);
    if (high > low)
        dar_row_convert(j->col, dst + low * size, type, frame + (at + (int64_t)low) * (int64_t)dar_dtype_size(type),
                        high - low);
    zero(dst + high * size, n - high, size);
    if (e->first == 0 && e->last == c->Wo) return;
    EACH_ROW(c, p, n, length)
    {
        if (p.w < e->first) zero(dst, least(e->first - p.w, length), size);
        if (p.w + length > e->last) {
            size_t from = most(e->last, p.w) - p.w;
            zero(dst + from * size, length - from, size);
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
        size_t low = most(e->first, p.w), high = least(e->last, p.w + length);
        if (!inside || low >= high) {
            zero(dst, length, size);
        } else {
            const char *src = frame + (row * (int64_t)c->W + (int64_t)(low * c->stride) + e->dx) * (int64_t)from;
            zero(dst, low - p.w, size);
            if (c->stride == 1) dar_row_convert(j->col, dst + (low - p.w) * size, type, src, high - low);
            else
                for (size_t i = low; i < high; i++, src += c->stride * from)
                    dar_row_convert(j->col, dst + (i - p.w) * size, type, src, 1);
            zero(dst + (high - p.w) * size, p.w + length - high, size);
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
static void fill_row(const struct job *j, const struct tap *e, struct at p, size_t n, const struct clip *v, char *dst)
{
    const dar_conv *c = &j->c;
    size_t size = dar_dtype_size(j->col);

    for (size_t m; n; n -= m, dst += m * size, next_frame(c, &p)) {
        m = least(n, (c->Ho - p.h) * c->Wo - p.w);
        dar_dtype type;
        const char *frame = frame_of(v, p.b, e->ci, (int64_t)(p.t * c->stride_t) + e->dt, &type);
        if (frame && e->dx == 0 && e->ci + 1 < v->C)
            ahead(j, e, &p, m, type, frame + v->T * v->plane * dar_dtype_size(type));
        if (!frame) zero(dst, m, size);
        else if (c->stride == 1 && c->W == c->Wo) fill_shifted(j, e, p, m, type, frame, dst);
        else fill_rows(j, e, p, m, type, frame, dst);
    }
}

/* The reverse: add n pixels of a row of gcol to where they came from. */
static void spill_row(const struct job *j, const struct tap *e, struct at p, size_t n, const struct clip *v,
                      const char *src)
{
    const dar_conv *c = &j->c;
    size_t size = dar_dtype_size(j->sum);

    for (size_t m; n; n -= m, next_frame(c, &p)) {
        m = least(n, (c->Ho - p.h) * c->Wo - p.w);
        dar_dtype type;
        char *frame = frame_of(v, p.b, e->ci, (int64_t)(p.t * c->stride_t) + e->dt, &type);
        struct at r = p;
        size_t left = m;
        EACH_ROW(c, r, left, length)
        {
            int64_t row = (int64_t)(r.h * c->stride) + e->dy;
            size_t low = most(e->first, r.w), high = least(e->last, r.w + length);
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

/* ---------------------------------------------------------------- y, and gx where strides are 1 */

struct correlate {
    struct job j;
    struct clip in, out;
    bool add, add_past;
    const dar_tensor *w, *b; /* b NULL or without data: none */
    char *scratch;
};

/* B: rows k0.. of col at pixels q0...  Packed; or, where a unit is one element of col, row by row as they are. */
static struct rhs make_col(const struct correlate *f, size_t q0, size_t n, size_t k0, size_t k, const struct room *r)
{
    const struct job *j = &f->j;
    const dar_tile *t = j->tile;
    size_t size = dar_dtype_size(j->col), ld = j->n + BESIDE;
    struct rhs b = j->col == j->operand && t->unit == 1 ? (struct rhs){ r->b, ld, t->nr } : packed_rhs(j, r->b);
    bool as_is = b.step == ld;
    struct at p = at_of(&j->c, q0);

    for (size_t i = 0; i < k; i += FILL) {
        size_t m = least(FILL, k - i);
        char *rows = as_is ? r->b + i * ld * size : r->col;
        for (size_t u = 0; u < m; u++) {
            struct tap e = tap_of(j, k0 + i + u);
            fill_row(j, &e, p, n, &f->in, rows + u * ld * size);
        }
        for (size_t q = 0; q < n && !as_is; q += t->nr)
            dar_tile_pack_b_kn(t, j->col, rows + q * size, ld, m, least(t->nr, n - q),
                               r->b + (q / t->nr * b.stripe + i / t->unit * t->nr) * t->unit_bytes);
    }
    return b;
}

/* Rows o0.., pixels q0.. of the output = c + b.  A channel's pixels are dense in past and in x. */
static void store(const struct correlate *f, size_t o0, size_t m, size_t q0, size_t n, char *c)
{
    const struct job *j = &f->j;
    const struct clip *v = &f->out;
    const dar_kern *k = dar_kern_for(j->sum);
    size_t size = dar_dtype_size(j->sum), past = v->P * v->plane;
    dar_put mode = dar_put_for(v->x->data ? dar_tensor_bytes(v->x) : 0, f->add);
    dar_put mode_past = f->add_past ? DAR_PUT_ADD : DAR_PUT;

    for (size_t o = 0; o < m; o++) {
        char *row = c + o * j->n * size;
        double bias = f->b && f->b->data ? dar_dtype_get(f->b->dtype, f->b->data, o0 + o) : 0;
        if (f->b && f->b->data) k->offset(n, bias, row, row);
        for (size_t i = 0, length; i < n; i += length) {
            size_t batch = (q0 + i) / j->P, p = (q0 + i) % j->P;
            bool before = p < past;
            const dar_tensor *to = before ? v->past : v->x;
            length = least(n - i, (before ? past : j->P) - p);
            if (!to->data) continue;
            size_t at = (batch * v->C + o0 + o) * (before ? past : j->P - past) + (before ? p : p - past);
            dar_row_put(j->sum, row + i * size, to->dtype, (char *)to->data + at * dar_dtype_size(to->dtype), length,
                        before ? mode_past : mode);
        }
    }
}

static void correlate_task(void *ctx, size_t i, int thread)
{
    const struct correlate *f = ctx;
    const struct job *j = &f->j;
    const dar_tile *t = j->tile;
    size_t down = blocks_of(j->c.Cout, j->m), o0 = i % down * j->m, q0 = i / down * j->n;
    size_t m = least(j->m, j->c.Cout - o0), n = least(j->n, j->c.B * j->P - q0);
    struct room r = room_of(j, f->scratch, thread);
    struct lhs a = { f->scratch, 1, t->mr, dar_tile_units(t, j->K) * t->mr };

    if (!j->packs_a) a = (struct lhs){ f->w->data, j->K / t->unit, 1, j->K / t->unit * t->mr };
    a.data += o0 / t->mr * a.stripe * t->unit_bytes;
    for (size_t k = 0; k < j->K; k += j->depth) {
        size_t depth = least(j->depth, j->K - k);
        struct rhs b = make_col(f, q0, n, k, depth, &r);
        multiply(j, a, b, m, n, depth, r.c, k > 0);
        a.data += depth / t->unit * a.step * t->unit_bytes;
    }
    store(f, o0, m, q0, n, r.c);
}

/* Stripes of w for gx from c0: row i is input channel c0 + i, column o taps + tap is w[o, c0 + i, tap]. */
static void turn_weights(const struct correlate *f, size_t c0, size_t lanes, char *dst, char *buf)
{
    const struct job *j = &f->j;
    const dar_tile *t = j->tile;
    size_t size = dar_dtype_size(f->w->dtype), run = j->taps * size, row = GROUP * run;

    for (size_t o = 0; o < j->c.Cin; o += GROUP) {
        size_t n = least(GROUP, j->c.Cin - o);
        for (size_t u = 0; u < n; u++) {
            const char *src = (char *)f->w->data + ((o + u) * j->c.Cout + c0) * run;
            for (size_t i = 0; i < lanes; i++) memcpy(buf + i * row + u * run, src + i * run, run);
        }
        for (size_t i = 0; i < lanes; i += t->mr)
            dar_tile_pack_a_mk(t, f->w->dtype, buf + i * row, GROUP * j->taps, least(t->mr, lanes - i), n * j->taps,
                               dst + i / t->mr * dar_tile_bytes_a(t, j->K) +
                                   o * j->taps / t->unit * t->mr * t->unit_bytes);
    }
}

static void pack_weights(void *ctx, size_t begin, size_t end, int thread)
{
    const struct correlate *f = ctx;
    const struct job *j = &f->j;
    const dar_tile *t = j->tile;
    size_t row = j->K * dar_dtype_size(f->w->dtype), stripe = dar_tile_bytes_a(t, j->K);

    if (j->mirrored)
        turn_weights(f, begin, end - begin, f->scratch + begin / t->mr * stripe, room_of(j, f->scratch, thread).col);
    else
        for (size_t o = begin; o < end; o += t->mr)
            dar_tile_pack_a_mk(t, f->w->dtype, (char *)f->w->data + o * row, j->K, least(t->mr, end - o), j->K,
                               f->scratch + o / t->mr * stripe);
}

static void correlate(struct correlate *f)
{
    const struct job *j = &f->j;
    size_t N = j->c.B * j->P;
    if (j->packs_a && N) dar_parallel_range(j->c.Cout, LANES, pack_weights, f);
    dar_parallel(blocks_of(j->c.Cout, j->m) * blocks_of(N, j->n), correlate_task, f);
}

static struct clip clip_of(const dar_conv *c, const dar_tensor *x, const dar_tensor *past)
{
    return (struct clip){ x, past, c->Cin, c->T, c->past, c->H * c->W };
}

static const dar_tensor none;

static struct clip clip_of_y(const dar_conv *c, const dar_tensor *y)
{
    return (struct clip){ y, &none, c->Cout, c->To, 0, c->Ho * c->Wo };
}

void dar_conv_forward(const dar_conv *c, const dar_tensor *x, const dar_tensor *w, const dar_tensor *b,
                      const dar_tensor *history, const dar_tensor *y, void *scratch)
{
    if (dar_conv_fold_fits(c)) { /* few channels */
        dar_conv_fold_forward(c, x, w, b, history, y, scratch);
        return;
    }
    struct correlate f = { .j = job_of(c, DAR_CONV_FORWARD, x->dtype, w->dtype),
                           .in = clip_of(c, x, history),
                           .out = clip_of_y(c, y),
                           .w = w,
                           .b = b,
                           .scratch = scratch };
    correlate(&f);
}

/* ---------------------------------------------------------------- gx for any stride */

struct back_x {
    struct job j;
    const dar_tensor *w, *gy;
    struct clip gx;
    bool add, add_past;
    char *scratch;
};

static void clear(const struct clip *v, const dar_tensor *g, size_t frames, size_t batch, size_t c0, size_t n)
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
    size_t Cout = j->c.Cout, wide = j->m / j->taps, across = blocks_of(j->c.Cin, wide);
    size_t batch = i / across, c0 = i % across * wide, channels = least(wide, j->c.Cin - c0), m = channels * j->taps;
    size_t ws = dar_dtype_size(f->w->dtype), gs = dar_dtype_size(f->gy->dtype), ss = dar_dtype_size(j->sum);
    struct room r = room_of(j, f->scratch, thread);

    if (!f->add) clear(&f->gx, f->gx.x, f->gx.T, batch, c0, channels);
    if (!f->add_past) clear(&f->gx, f->gx.past, f->gx.P, batch, c0, channels);
    for (size_t k = 0; k < m; k += t->mr)
        dar_tile_pack_a_km(t, f->w->dtype, (char *)f->w->data + (c0 * j->taps + k) * ws, j->K, least(t->mr, m - k),
                           Cout, r.a + k / t->mr * dar_tile_bytes_a(t, Cout));
    for (size_t p = 0; p < j->P; p += j->n) {
        size_t n = least(j->n, j->P - p);
        for (size_t o = 0; o < Cout; o += j->depth) {
            size_t depth = least(j->depth, Cout - o);
            const char *gy = (char *)f->gy->data + ((batch * Cout + o) * j->P + p) * gs;
            for (size_t q = 0; q < n; q += t->nr)
                dar_tile_pack_b_kn(t, f->gy->dtype, gy + q * gs, j->P, depth, least(t->nr, n - q),
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
    struct job j = job_of(c, DAR_CONV_BACK_X, x_type, w->dtype);
    struct clip out = clip_of(c, gx, ghistory);
    if (j.mirrored) {
        struct correlate f = { j, clip_of_y(c, gy), out, add, add_history, w, NULL, scratch };
        correlate(&f);
    } else {
        struct back_x f = { j, w, gy, out, add, add_history, scratch };
        dar_parallel(c->B * blocks_of(c->Cin, j.m / j.taps), back_x_task, &f);
    }
}

/* ---------------------------------------------------------------- gw, gb */

struct back_w {
    struct job j;
    struct clip x;
    const dar_tensor *gy, *gw;
    bool add;
    char *scratch;
};

/* gw[o0.., k0..] (+)= c transposed, a line of c at a time. */
static void store_gw(const struct back_w *f, size_t k0, size_t m, size_t o0, size_t n, const struct room *r, bool add)
{
    const struct job *j = &f->j;
    size_t ld = j->m + LINE; /* not a power of two: the rows would share their place in the cache */

    for (size_t o = 0; o < n; o += LINE) {
        size_t lines = least(LINE, n - o);
        for (size_t k = 0; k < m; k++)
            for (size_t u = 0; u < lines; u++)
                if (j->sum == DAR_F64)
                    ((double *)(void *)r->col)[u * ld + k] = ((double *)(void *)r->c)[k * j->n + o + u];
                else ((float *)(void *)r->col)[u * ld + k] = ((float *)(void *)r->c)[k * j->n + o + u];
        for (size_t u = 0; u < lines; u++)
            dar_row_put(j->sum, r->col + u * ld * dar_dtype_size(j->sum), f->gw->dtype,
                        (char *)f->gw->data + ((o0 + o + u) * j->K + k0) * dar_dtype_size(f->gw->dtype), m,
                        add ? DAR_PUT_ADD : DAR_PUT);
    }
}

/* Rows k0.. of col at n pixels of one batch element, as the tile reads them: whole units, the rest zero.  Meanwhile
 * `rows` of gy are asked for, `bytes` each, for the next pixels. */
static void fill_col(const struct back_w *f, size_t k0, size_t m, size_t q, size_t n, char *a, const char *gy,
                     size_t rows, size_t bytes)
{
    const struct job *j = &f->j;
    size_t size = dar_dtype_size(j->operand), pad = dar_tile_units(j->tile, n) * j->tile->unit - n;
    struct at p = at_of(&j->c, q);

    for (size_t k = 0; k < m; k++, a += j->depth * size) {
        struct tap e = tap_of(j, k0 + k);
        fill_row(j, &e, p, n, &f->x, a);
        zero(a + n * size, pad, size);
        if (k < rows) dar_row_ahead(gy + k * j->P * dar_dtype_size(f->gy->dtype), bytes);
    }
}

static void back_w_task(void *ctx, size_t i, int thread)
{
    const struct back_w *f = ctx;
    const struct job *j = &f->j;
    const dar_tile *t = j->tile;
    size_t Cout = j->c.Cout, across = blocks_of(Cout, j->n), o0 = i % across * j->n, k0 = i / across * j->m;
    size_t m = least(j->m, j->K - k0), n = least(j->n, Cout - o0), gs = dar_dtype_size(f->gy->dtype), summed = 0;
    struct room r = room_of(j, f->scratch, thread);
    struct lhs a = { r.a, j->depth / t->unit, 1, j->depth / t->unit * t->mr };
    bool add = f->add;

    for (size_t batch = 0; batch < j->c.B; batch++)
        for (size_t p = 0; p < j->P; p += j->depth) {
            size_t depth = least(j->depth, j->P - p);
            const char *gy = (char *)f->gy->data + ((batch * Cout + o0) * j->P + p) * gs;
            for (size_t q = 0; q < n; q += t->nr)
                dar_tile_pack_b_nk(t, f->gy->dtype, gy + q * j->P * gs, j->P, depth, least(t->nr, n - q),
                                   r.b + q / t->nr * dar_tile_bytes_b(t, j->depth));
            fill_col(f, k0, m, batch * j->P + p, depth, r.a, gy + depth * gs, n,
                     least(j->depth, j->P - p - depth) * gs);
            multiply(j, a, packed_rhs(j, r.b), m, n, depth, r.c, summed > 0);
            summed += depth;
            if (summed < FLUSH && (p + depth < j->P || batch + 1 < j->c.B)) continue;
            store_gw(f, k0, m, o0, n, &r, add);
            add = true;
            summed = 0;
        }
}

void dar_conv_back_w(const dar_conv *c, const dar_tensor *x, const dar_tensor *history, dar_dtype w_type,
                     const dar_tensor *gy, const dar_tensor *gw, bool add, void *scratch)
{
    struct back_w f = { job_of(c, DAR_CONV_BACK_W, x->dtype, w_type), clip_of(c, x, history), gy, gw, add, scratch };
    dar_parallel(blocks_of(f.j.K, f.j.m) * blocks_of(c->Cout, f.j.n), back_w_task, &f);
}

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
