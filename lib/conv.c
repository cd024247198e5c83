/* conv.c: the virtual operand, and the three products around it. */
#include "lib/conv.h"

#include <string.h>

#include "lib/kern.h"
#include "lib/thread.h"
#include "lib/tile.h"

#define KC     512  /* longest piece of a sum in one tile call: a stripe of B stays near */
#define PIXELS 256  /* output pixels per task; with KC of them B fills half of a 1 MiB second-level cache */
#define ROWS   512  /* most rows of the result per task */
#define FILL   16   /* rows of col made at a time before they are packed: first-level cache */
#define FLUSH  8192 /* pixels summed in one accumulator before it goes to gw: bounds the error of long sums */

static size_t least(size_t a, size_t b)
{
    return a < b ? a : b;
}

static size_t blocks_of(size_t n, size_t block)
{
    return (n + block - 1) / block;
}

/* Length of equal blocks of n, each at most `most` and a multiple of `unit`, at least `wanted` blocks if possible. */
static size_t even_block(size_t n, size_t most, size_t unit, size_t wanted)
{
    size_t count = blocks_of(n, most);
    if (count < wanted) count = wanted;
    size_t block = blocks_of(blocks_of(n, count), unit) * unit;
    return block ? block : unit;
}

/* ---------------------------------------------------------------- the job: what all three products share */

struct job {
    const dar_conv *c;
    const dar_tile *tile;
    dar_dtype operand, sum;                      /* types of packed operands and of the result */
    size_t taps, K, P;                           /* kt kh kw, Cin taps, To Ho Wo */
    size_t m, n;                                 /* rows and columns of the result per task */
    size_t depth;                                /* longest sum per tile call */
    size_t a_bytes, b_bytes, c_bytes, col_bytes; /* of one thread */
    size_t shared;                               /* bytes before the threads' own */
};

/* Where the operands of one thread lie. */
struct room {
    char *a, *b, *c, *col;
};

static size_t aligned(size_t n)
{
    return (n + DAR_ALIGN - 1) / DAR_ALIGN * DAR_ALIGN;
}

static struct room room_of(const struct job *j, void *scratch, int thread)
{
    char *p = (char *)scratch + j->shared + (size_t)thread * (j->a_bytes + j->b_bytes + j->c_bytes + j->col_bytes);
    return (struct room){ p, p + j->a_bytes, p + j->a_bytes + j->b_bytes, p + j->a_bytes + j->b_bytes + j->c_bytes };
}

/* Weights are read where they lie if they are stored as the tile wants them. */
static bool packs_weights(const struct job *j, dar_dtype w)
{
    return w != j->operand || j->K % j->tile->unit;
}

static struct job job_of(const dar_conv *c, dar_conv_pass pass, dar_dtype x, dar_dtype w)
{
    static const dar_dtype of[] = { [DAR_TILE_F64] = DAR_F64, [DAR_TILE_F32] = DAR_F32, [DAR_TILE_BF16] = DAR_BF16 };
    dar_tile_kind kind = dar_tile_kind_for(x == DAR_BF16 && w != DAR_BF16 ? DAR_F32 : x);
    struct job j = { .c = c, .operand = of[kind], .sum = dar_compute_type(x), .taps = c->kt * c->kh * c->kw };
    size_t es = dar_dtype_size(j.operand), ss = dar_dtype_size(j.sum);

    j.K = c->Cin * j.taps;
    j.P = c->To * c->Ho * c->Wo;
    j.tile = dar_tile_for(kind, pass == DAR_CONV_BACK_W ? c->Cout : c->B * j.P);
    size_t nr = j.tile->nr, mr = j.tile->mr, wide;
    switch (pass) {
    case DAR_CONV_FORWARD:
        j.n = even_block(c->B * j.P, PIXELS, nr, 1);
        j.m = even_block(c->Cout, ROWS, mr, blocks_of(8, blocks_of(c->B * j.P, j.n)));
        j.depth = KC;
        j.col_bytes = aligned(FILL * j.n * es);
        if (packs_weights(&j, w)) j.shared = aligned(blocks_of(c->Cout, mr) * dar_tile_bytes_a(j.tile, j.K));
        break;
    case DAR_CONV_BACK_X:
        j.n = even_block(j.P, PIXELS, nr, 1);
        wide = even_block(c->Cin, ROWS / j.taps ? ROWS / j.taps : 1, 1, blocks_of(8, c->B));
        j.m = wide * j.taps;
        j.depth = KC;
        j.a_bytes = aligned(blocks_of(j.m, mr) * dar_tile_bytes_a(j.tile, c->Cout));
        break;
    case DAR_CONV_BACK_W:
        j.n = even_block(c->Cout, PIXELS, nr, 1);
        j.m = even_block(j.K, ROWS, mr, blocks_of(8, blocks_of(c->Cout, j.n)));
        j.depth = PIXELS;
        j.a_bytes = aligned(j.m * j.depth * es);
        j.col_bytes = aligned(j.m * ss);
        break;
    }
    j.b_bytes = aligned(blocks_of(j.n, nr) * dar_tile_bytes_b(j.tile, j.depth));
    j.c_bytes = aligned(j.m * j.n * ss);
    return j;
}

size_t dar_conv_scratch(const dar_conv *c, dar_conv_pass pass, dar_dtype x, dar_dtype w, int threads)
{
    struct job j = job_of(c, pass, x, w);
    return j.shared + (size_t)threads * (j.a_bytes + j.b_bytes + j.c_bytes + j.col_bytes);
}

/* A as the tile reads it [units]: unit (i, k) at i row + k step, stripe s at s stripe. */
struct lhs {
    const char *data;
    size_t row, step, stripe;
};

/* c[m, n] (+)= a b over k elements; b is packed, its stripes b_stripe bytes apart. */
static void multiply(const struct job *j, struct lhs a, const char *b, size_t b_stripe, size_t m, size_t n, size_t k,
                     char *c, bool add)
{
    const dar_tile *t = j->tile;
    size_t ss = dar_dtype_size(j->sum), units = dar_tile_units(t, k);

    for (size_t i = 0; i < m; i += t->mr)
        for (size_t q = 0; q < n; q += t->nr)
            t->mm(units, a.data + i / t->mr * a.stripe * t->unit_bytes, a.row, a.step, b + q / t->nr * b_stripe, t->nr,
                  c + (i * j->n + q) * ss, j->n, least(t->mr, m - i), least(t->nr, n - q), add);
}

/* ---------------------------------------------------------------- rows of col */

/* One row k of col: tap (dt, dy, dx) of channel ci. */
struct tap {
    size_t ci, dt, dy, dx;
    size_t first, last; /* output columns that read inside the frame */
};

/* An output pixel. */
struct at {
    size_t b, t, h, w;
};

static struct tap tap_of(const dar_conv *c, size_t k)
{
    struct tap e = { .dx = k % c->kw, .dy = k / c->kw % c->kh, .dt = k / c->kw / c->kh % c->kt };
    e.ci = k / c->kw / c->kh / c->kt;
    e.first = c->left > e.dx ? blocks_of(c->left - e.dx, c->stride) : 0;
    e.last = c->W + c->left > e.dx ? least(blocks_of(c->W + c->left - e.dx, c->stride), c->Wo) : 0;
    if (e.first > e.last) e.first = e.last;
    return e;
}

static struct at at_of(const dar_conv *c, size_t q)
{
    return (struct at){ q / c->Wo / c->Ho / c->To, q / c->Wo / c->Ho % c->To, q / c->Wo % c->Ho, q % c->Wo };
}

static void next_row(const dar_conv *c, struct at *p)
{
    p->w = 0;
    if (++p->h < c->Ho) return;
    p->h = 0;
    if (++p->t < c->To) return;
    p->t = 0;
    p->b++;
}

/* The input row that the output row of p reads through a tap: of x or of history; NULL where it is zero. */
static char *input_row(const dar_conv *c, const struct tap *e, const struct at *p, const dar_tensor *x,
                       const dar_tensor *history, dar_dtype *type)
{
    size_t f = p->t * c->stride_t + e->dt, row = p->h * c->stride + e->dy;
    if (row < c->top || row - c->top >= c->H || f + c->past < c->front) return NULL;
    const dar_tensor *from = f >= c->front ? x : history;
    size_t frames = f >= c->front ? c->T : c->past, frame = f >= c->front ? f - c->front : f + c->past - c->front;
    if (!from->data) return NULL;
    *type = from->dtype;
    return (char *)from->data +
           (((p->b * c->Cin + e->ci) * frames + frame) * c->H + row - c->top) * c->W * dar_dtype_size(from->dtype);
}

/* n elements step apart at src, as `type`. */
static void fetch(dar_dtype type, char *dst, dar_dtype from, const char *src, size_t step, size_t n)
{
    if (step == 1) {
        dar_row_convert(type, dst, from, src, n);
        return;
    }
    size_t to_size = dar_dtype_size(type), size = dar_dtype_size(from);
    for (size_t i = 0; i < n; i++) dar_row_convert(type, dst + i * to_size, from, src + i * step * size, 1);
}

/* n pixels of a row of col from pixel p. */
static void fill_row(const struct job *j, const struct tap *e, struct at p, size_t n, const dar_tensor *x,
                     const dar_tensor *history, char *dst)
{
    const dar_conv *c = j->c;
    size_t es = dar_dtype_size(j->operand);

    while (n) {
        size_t length = least(c->Wo - p.w, n), end = p.w + length;
        size_t first = e->first < p.w ? p.w : least(e->first, end),
               last = e->last < first ? first : least(e->last, end);
        dar_dtype type;
        const char *src = input_row(c, e, &p, x, history, &type);
        if (!src) first = last = end;
        memset(dst, 0, (first - p.w) * es);
        if (last > first)
            fetch(j->operand, dst + (first - p.w) * es, type,
                  src + (first * c->stride + e->dx - c->left) * dar_dtype_size(type), c->stride, last - first);
        memset(dst + (last - p.w) * es, 0, (end - last) * es);
        dst += length * es;
        n -= length;
        next_row(c, &p);
    }
}

/* The reverse: add n pixels of a row of gcol to where they came from. */
static void spill_row(const struct job *j, const struct tap *e, struct at p, size_t n, const dar_tensor *gx,
                      const dar_tensor *ghistory, const char *src)
{
    const dar_conv *c = j->c;
    size_t ss = dar_dtype_size(j->sum);

    while (n) {
        size_t length = least(c->Wo - p.w, n), end = p.w + length;
        size_t first = e->first < p.w ? p.w : least(e->first, end),
               last = e->last < first ? first : least(e->last, end);
        dar_dtype type;
        char *dst = input_row(c, e, &p, gx, ghistory, &type);
        const char *from = src + (first - p.w) * ss;
        if (dst) dst += (first * c->stride + e->dx - c->left) * ss;
        size_t m = dst ? last - first : 0;
        if (j->sum == DAR_F64)
            for (size_t i = 0; i < m; i++) ((double *)dst)[i * c->stride] += ((const double *)from)[i];
        else if (c->stride == 1)
            for (size_t i = 0; i < m; i++) ((float *)dst)[i] += ((const float *)from)[i];
        else
            for (size_t i = 0; i < m; i++) ((float *)dst)[i * c->stride] += ((const float *)from)[i];
        src += length * ss;
        n -= length;
        next_row(c, &p);
    }
}

/* ---------------------------------------------------------------- forward */

struct forward {
    struct job j;
    const dar_tensor *x, *w, *b, *history, *y;
    void *scratch;
};

/* Stripes of B: rows k0.. of col at pixels q0... */
static void pack_col(const struct forward *f, size_t q0, size_t n, size_t k0, size_t k, const struct room *r)
{
    const struct job *j = &f->j;
    const dar_tile *t = j->tile;
    size_t es = dar_dtype_size(j->operand), stripe = dar_tile_bytes_b(t, j->depth);
    struct at p = at_of(j->c, q0);

    for (size_t i = 0; i < k; i += FILL) {
        size_t m = least(FILL, k - i);
        for (size_t u = 0; u < m; u++) {
            struct tap e = tap_of(j->c, k0 + i + u);
            fill_row(j, &e, p, n, f->x, f->history, r->col + u * j->n * es);
        }
        for (size_t q = 0; q < n; q += t->nr)
            dar_tile_pack_b_kn(t, j->operand, r->col + q * es, j->n, m, least(t->nr, n - q),
                               r->b + q / t->nr * stripe + i / t->unit * t->nr * t->unit_bytes);
    }
}

/* y[o0.., q0..] = c + b; pixels are contiguous within a batch element. */
static void store_y(const struct forward *f, size_t o0, size_t m, size_t q0, size_t n, char *c)
{
    const struct job *j = &f->j;
    size_t ss = dar_dtype_size(j->sum), ys = dar_dtype_size(f->y->dtype);

    for (size_t o = 0; o < m; o++) {
        char *row = c + o * j->n * ss;
        double bias = f->b->data ? dar_dtype_get(f->b->dtype, f->b->data, o0 + o) : 0;
        if (j->sum == DAR_F64)
            for (size_t i = 0; i < n; i++) ((double *)row)[i] += bias;
        else
            for (size_t i = 0; i < n; i++) ((float *)row)[i] += (float)bias;
        for (size_t i = 0, length; i < n; i += length) {
            size_t batch = (q0 + i) / j->P, p = (q0 + i) % j->P;
            length = least(n - i, j->P - p);
            dar_row_put(j->sum, row + i * ss, f->y->dtype,
                        (char *)f->y->data + ((batch * j->c->Cout + o0 + o) * j->P + p) * ys, length, false);
        }
    }
}

static void forward_task(void *ctx, size_t i, int thread)
{
    const struct forward *f = ctx;
    const struct job *j = &f->j;
    const dar_tile *t = j->tile;
    size_t down = blocks_of(j->c->Cout, j->m), o0 = i % down * j->m, q0 = i / down * j->n;
    size_t m = least(j->m, j->c->Cout - o0), n = least(j->n, j->c->B * j->P - q0);
    struct room r = room_of(j, f->scratch, thread);
    struct lhs a = { f->scratch, 1, t->mr, dar_tile_units(t, j->K) * t->mr };

    if (!packs_weights(j, f->w->dtype)) a = (struct lhs){ f->w->data, j->K / t->unit, 1, j->K / t->unit * t->mr };
    a.data += o0 / t->mr * a.stripe * t->unit_bytes;
    for (size_t k = 0; k < j->K; k += j->depth) {
        size_t depth = least(j->depth, j->K - k);
        pack_col(f, q0, n, k, depth, &r);
        multiply(j, a, r.b, dar_tile_bytes_b(t, j->depth), m, n, depth, r.c, k > 0);
        a.data += depth / t->unit * a.step * t->unit_bytes;
    }
    store_y(f, o0, m, q0, n, r.c);
}

static void pack_weights(void *ctx, size_t i, int thread)
{
    const struct forward *f = ctx;
    const dar_tile *t = f->j.tile;
    size_t K = f->j.K;
    (void)thread;
    dar_tile_pack_a_mk(t, f->w->dtype, (char *)f->w->data + i * t->mr * K * dar_dtype_size(f->w->dtype), K,
                       least(t->mr, f->j.c->Cout - i * t->mr), K, (char *)f->scratch + i * dar_tile_bytes_a(t, K));
}

void dar_conv_forward(const dar_conv *c, const dar_tensor *x, const dar_tensor *w, const dar_tensor *b,
                      const dar_tensor *history, const dar_tensor *y, void *scratch, int threads)
{
    struct forward f = { job_of(c, DAR_CONV_FORWARD, x->dtype, w->dtype), x, w, b, history, y, scratch };
    (void)threads;
    if (!c->B || !f.j.P || !c->Cout) return;
    if (packs_weights(&f.j, w->dtype)) dar_parallel(blocks_of(c->Cout, f.j.tile->mr), pack_weights, &f);
    dar_parallel(blocks_of(c->Cout, f.j.m) * blocks_of(c->B * f.j.P, f.j.n), forward_task, &f);
}

/* ---------------------------------------------------------------- gradient of x */

struct back_x {
    struct job j;
    const dar_tensor *w, *gy, *gx, *ghistory;
    bool add_x, add_history;
    void *scratch;
};

static void clear_channels(const dar_conv *c, const dar_tensor *g, size_t frames, size_t batch, size_t c0, size_t n)
{
    size_t plane = frames * c->H * c->W * dar_dtype_size(g->dtype);
    if (g->data) memset((char *)g->data + (batch * c->Cin + c0) * plane, 0, n * plane);
}

/* One task owns some channels of one batch element, so that what is added to them comes in one order. */
static void back_x_task(void *ctx, size_t i, int thread)
{
    const struct back_x *f = ctx;
    const struct job *j = &f->j;
    const dar_tile *t = j->tile;
    size_t Cout = j->c->Cout, wide = j->m / j->taps, across = blocks_of(j->c->Cin, wide);
    size_t batch = i / across, c0 = i % across * wide, channels = least(wide, j->c->Cin - c0), m = channels * j->taps;
    size_t ws = dar_dtype_size(f->w->dtype), gs = dar_dtype_size(f->gy->dtype), ss = dar_dtype_size(j->sum);
    size_t stripe = dar_tile_bytes_b(t, j->depth);
    struct room r = room_of(j, f->scratch, thread);

    if (!f->add_x) clear_channels(j->c, f->gx, j->c->T, batch, c0, channels);
    if (!f->add_history) clear_channels(j->c, f->ghistory, j->c->past, batch, c0, channels);
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
                                   r.b + q / t->nr * stripe);
            struct lhs a = { r.a + o / t->unit * t->mr * t->unit_bytes, 1, t->mr, dar_tile_units(t, Cout) * t->mr };
            multiply(j, a, r.b, stripe, m, n, depth, r.c, o > 0);
        }
        for (size_t k = 0; k < m; k++) {
            struct tap e = tap_of(j->c, c0 * j->taps + k);
            spill_row(j, &e, at_of(j->c, batch * j->P + p), n, f->gx, f->ghistory, r.c + k * j->n * ss);
        }
    }
}

void dar_conv_back_x(const dar_conv *c, dar_dtype x_type, const dar_tensor *w, const dar_tensor *gy,
                     const dar_tensor *gx, bool add_x, const dar_tensor *ghistory, bool add_history, void *scratch,
                     int threads)
{
    struct back_x f = {
        job_of(c, DAR_CONV_BACK_X, x_type, w->dtype), w, gy, gx, ghistory, add_x, add_history, scratch
    };
    (void)threads;
    dar_parallel(c->B * blocks_of(c->Cin, f.j.m / f.j.taps), back_x_task, &f);
}

/* ---------------------------------------------------------------- gradients of w and b */

struct back_w {
    struct job j;
    const dar_tensor *x, *history, *gy, *gw;
    bool add;
    void *scratch;
};

/* gw[o0.., k0..] (+)= c transposed. */
static void store_gw(const struct back_w *f, size_t k0, size_t m, size_t o0, size_t n, const struct room *r, bool add)
{
    const struct job *j = &f->j;
    size_t ws = dar_dtype_size(f->gw->dtype);

    for (size_t o = 0; o < n; o++) {
        if (j->sum == DAR_F64)
            for (size_t k = 0; k < m; k++) ((double *)r->col)[k] = ((double *)r->c)[k * j->n + o];
        else
            for (size_t k = 0; k < m; k++) ((float *)r->col)[k] = ((float *)r->c)[k * j->n + o];
        dar_row_put(j->sum, r->col, f->gw->dtype, (char *)f->gw->data + ((o0 + o) * j->K + k0) * ws, m, add);
    }
}

/* Rows k0.. of col at n pixels of one batch element, as they lie in A: a whole number of units, the rest zero. */
static void fill_col(const struct back_w *f, size_t k0, size_t m, size_t q, size_t n, char *a)
{
    const struct job *j = &f->j;
    size_t es = dar_dtype_size(j->operand), pad = dar_tile_units(j->tile, n) * j->tile->unit - n;
    struct at p = at_of(j->c, q);

    for (size_t k = 0; k < m; k++, a += j->depth * es) {
        struct tap e = tap_of(j->c, k0 + k);
        fill_row(j, &e, p, n, f->x, f->history, a);
        memset(a + n * es, 0, pad * es);
    }
}

static void back_w_task(void *ctx, size_t i, int thread)
{
    const struct back_w *f = ctx;
    const struct job *j = &f->j;
    const dar_tile *t = j->tile;
    size_t Cout = j->c->Cout, across = blocks_of(Cout, j->n), o0 = i % across * j->n, k0 = i / across * j->m;
    size_t m = least(j->m, j->K - k0), n = least(j->n, Cout - o0), gs = dar_dtype_size(f->gy->dtype);
    size_t stripe = dar_tile_bytes_b(t, j->depth), summed = 0;
    struct room r = room_of(j, f->scratch, thread);
    struct lhs a = { r.a, j->depth / t->unit, 1, j->depth / t->unit * t->mr };
    bool add = f->add;

    for (size_t batch = 0; batch < j->c->B; batch++)
        for (size_t p = 0; p < j->P; p += j->depth) {
            size_t depth = least(j->depth, j->P - p);
            const char *gy = (char *)f->gy->data + ((batch * Cout + o0) * j->P + p) * gs;
            for (size_t q = 0; q < n; q += t->nr)
                dar_tile_pack_b_nk(t, f->gy->dtype, gy + q * j->P * gs, j->P, depth, least(t->nr, n - q),
                                   r.b + q / t->nr * stripe);
            fill_col(f, k0, m, batch * j->P + p, depth, r.a);
            multiply(j, a, r.b, stripe, m, n, depth, r.c, summed > 0);
            summed += depth;
            if (summed < FLUSH && (p + depth < j->P || batch + 1 < j->c->B)) continue;
            store_gw(f, k0, m, o0, n, &r, add);
            add = true;
            summed = 0;
        }
}

void dar_conv_back_w(const dar_conv *c, const dar_tensor *x, const dar_tensor *history, dar_dtype w_type,
                     const dar_tensor *gy, const dar_tensor *gw, bool add, void *scratch, int threads)
{
    struct back_w f = { job_of(c, DAR_CONV_BACK_W, x->dtype, w_type), x, history, gy, gw, add, scratch };
    (void)threads;
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
    size_t P = f->c->To * f->c->Ho * f->c->Wo;
    double sum[8] = { 0 }; /* lanes, so that additions overlap */
    (void)thread;

    for (size_t batch = 0; batch < f->c->B; batch++) {
        size_t at = (batch * f->c->Cout + o) * P;
        if (f->gy->dtype == DAR_F64)
            for (size_t p = 0; p < P; p++) sum[p % 8] += ((const double *)f->gy->data + at)[p];
        else
            for (size_t p = 0; p < P; p++) sum[p % 8] += ((const float *)f->gy->data + at)[p];
    }
    double total = dar_sum_tree(sum, 8);
    if (f->add) total += dar_dtype_get(f->gb->dtype, f->gb->data, o);
    dar_dtype_set(f->gb->dtype, f->gb->data, o, total);
}

void dar_conv_back_b(const dar_conv *c, const dar_tensor *gy, const dar_tensor *gb, bool add)
{
    struct back_b f = { c, gy, gb, add };
    dar_parallel(c->Cout, back_b_task, &f);
}
