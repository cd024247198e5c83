/* product.c: how a product is cut.
 *
 *   k in spans                  of SPAN_UNITS, the later ones adding to C; one only where sums are kept apart from C
 *   columns of C in panels      so that B, packed over a span, fits PANEL_BYTES; packed once, shared by all threads
 *   a panel in tasks            about TASK_ROWS rows each; where there are few rows, columns are split too
 *   k in blocks                 a stripe of B over a block and a task's rows of A stay in the second-level cache
 *   tiles                       along the rows first: the stripe of B is read again and again, A streams past it
 *
 * With few rows (thin) the packing of B outweighs its use by the tiles: each task packs its own piece of B and uses it
 * at once, while A is packed once and shared.
 *
 * B that lies ready is not packed for up to IN_PLACE_ROWS: the first tile of a stripe brings the next stripe near, from
 * where the other tiles read it as fast as if it were packed. */
#include "lib/product.h"

#include <stdint.h>

#include "lib/arena.h"
#include "lib/status.h"
#include "lib/thread.h"

#define THIN_ROWS        96
#define TASK_ROWS        192
#define TASK_ROWS_APART  96   /* where sums are kept apart from C */
#define IN_PLACE_ROWS    1536 /* of A, that read B where it lies */
#define BLOCK_UNITS      512
#define BLOCK_UNITS_THIN 128
#define SPAN_UNITS       1024
#define PANEL_BYTES      ((size_t)12 << 20)
#define GROUP            16 /* stripes packed together, each read in long pieces */
#define ALIAS            4096
#define PIECE_BYTES      ((size_t)256 << 10) /* of B, packed by a thin task */
#define ACC_COLS         384                 /* columns summed in scratch at a time */

struct plan {
    const dar_product *p;
    const dar_tile *t;
    bool thin;
    bool share;        /* stripes are packed for all threads */
    bool stream;       /* C past the caches, being written once and not read */
    size_t rows, cols; /* stripes of A, of B */
    size_t panel;      /* stripes of B packed at a time */
    size_t tm, tn;     /* tasks along rows, and along the columns of a panel */
    size_t task_rows;  /* most stripes of A in a task */
    size_t piece;      /* stripes of B that a task finishes before the next */
    size_t kc[2];      /* elements per block of each term */
    size_t blocks;     /* of both terms */
    size_t depth;      /* most units in a block */
    size_t spans;      /* of blocks, whose B is packed at a time */
    size_t shared_bytes, a_bytes, b_bytes, c_bytes;
    char *shared, *own; /* own: a_bytes, b_bytes, c_bytes for each thread */
    size_t b0, b1;      /* blocks of the span */
    size_t first;       /* stripe of B where the panel begins */
    size_t groups;      /* of stripes, packed by one task each */
};

static size_t ceil_div(size_t a, size_t b)
{
    return a / b + (a % b != 0);
}

static size_t min(size_t a, size_t b)
{
    return a < b ? a : b;
}

static size_t align(size_t bytes)
{
    return (bytes + DAR_ALIGN - 1) / DAR_ALIGN * DAR_ALIGN;
}

/* Block b of the sum: its term, first element and length. */
static const dar_term *block(const struct plan *s, size_t b, size_t *k0, size_t *k)
{
    const dar_term *term = s->p->term;
    size_t first = term[0].k ? ceil_div(term[0].k, s->kc[0]) : 0, i = b >= first && term[1].k;
    *k0 = (b - (i ? first : 0)) * s->kc[i];
    *k = min(term[i].k - *k0, s->kc[i]);
    return &term[i];
}

/* Equal blocks of whole cache lines, about `units` at most.  Stripes are packed side by side: a whole number of pages
 * apart, they would all want the same few lines of the first-level cache. */
static void cut_k(struct plan *s, size_t units)
{
    s->blocks = 0;
    s->depth = 1;
    for (int i = 0; i < 2; i++) {
        size_t k = s->p->term[i].k, line = DAR_ALIGN / s->t->unit_bytes * s->t->unit;
        size_t n = ceil_div(k, units * s->t->unit);
        s->kc[i] = n ? ceil_div(ceil_div(k, n), line) * line : 1;
        if (dar_tile_bytes_a(s->t, s->kc[i]) % ALIAS == 0) s->kc[i] += line;
        s->blocks += ceil_div(k, s->kc[i]);
        if (k && s->kc[i] / s->t->unit > s->depth) s->depth = s->kc[i] / s->t->unit;
    }
    if (!s->blocks) s->blocks = 1; /* nothing to sum: C is cleared, or kept */
}

/* Whether an operand is read where it lies. */
static bool lies(const dar_product *p, const dar_operand *x, bool of_a)
{
    return x->in_place && (of_a || p->m <= IN_PLACE_ROWS);
}

static bool packs(const dar_product *p, bool of_a)
{
    bool some = false;
    for (int i = 0; i < 2; i++) some |= p->term[i].k && !lies(p, of_a ? &p->term[i].a : &p->term[i].b, of_a);
    return some;
}

static void cut(struct plan *s, const dar_product *p)
{
    const dar_tile *t = p->tile;
    size_t threads = (size_t)dar_threads();

    *s = (struct plan){ .p = p, .t = t, .rows = ceil_div(p->m, t->mr), .cols = ceil_div(p->n, t->nr) };
    s->thin = p->m <= THIN_ROWS;
    s->share = packs(p, s->thin);
    s->spans = 1;
    cut_k(s, s->thin ? BLOCK_UNITS_THIN : BLOCK_UNITS);

    size_t stripe_a = s->depth * t->mr * t->unit_bytes, stripe_b = s->depth * t->nr * t->unit_bytes;
    size_t elem = t->kind == DAR_TILE_F64 ? 8 : 4;
    bool pack_a = packs(p, true);
    bool apart = !p->direct && s->blocks > 1; /* else a finished tile leaves its scratch at once */
    size_t task_rows = apart ? TASK_ROWS_APART : TASK_ROWS;
    size_t want = threads * (s->thin ? 2 : pack_a ? 1 : 8); /* tasks: many even out, few pack less often */

    if (s->thin) {
        s->panel = s->cols;
        s->tm = 1;
        s->tn = ceil_div(s->cols, 1 + PIECE_BYTES / stripe_b);
        s->tn = min(s->cols, s->tn < want ? want : ceil_div(s->tn, threads) * threads);
        s->piece = ceil_div(s->cols, s->tn);
    } else {
        size_t units = dar_tile_units(t, p->term[0].k) + dar_tile_units(t, p->term[1].k);
        if (s->share && p->direct && units > SPAN_UNITS) s->spans = min(s->blocks, units / SPAN_UNITS);
        size_t fit = s->share ? 1 + PANEL_BYTES / (ceil_div(s->blocks, s->spans) * stripe_b) : s->cols;
        s->panel = ceil_div(s->cols, ceil_div(s->cols, fit));
        s->tm = ceil_div(p->m, task_rows);
        if (s->tm > threads) s->tm = min(s->rows, ceil_div(s->tm, threads) * threads);
        s->tn = min(s->panel, ceil_div(want, s->tm));
        s->piece = apart ? min(s->panel, 1 + (ACC_COLS - 1) / t->nr) : s->panel;
    }
    s->stream = p->direct && !p->done && s->blocks == 1 && dar_put_for(p->m * p->n * elem, p->add) == DAR_PUT_STREAM;
    s->task_rows = ceil_div(s->rows, s->tm);
    size_t shared = ceil_div(s->blocks, s->spans) * (s->thin ? s->rows * stripe_a : s->panel * stripe_b);
    s->shared_bytes = s->share ? align(shared) : 0;
    s->a_bytes = s->thin || !pack_a ? 0 : align(s->task_rows * stripe_a);
    s->b_bytes = s->thin ? align(s->piece * stripe_b) : 0;
    s->c_bytes = p->direct ? 0 : align((apart ? s->task_rows * s->piece : 1) * t->mr * t->nr * elem);
}

size_t dar_product_scratch(const dar_product *p)
{
    struct plan s;
    if (!p->m || !p->n) return 0;
    cut(&s, p);
    return s.shared_bytes + (size_t)dar_threads() * (s.a_bytes + s.b_bytes + s.c_bytes);
}

/* ---------------------------------------------------------------- packing */

/* Bytes of a stripe over block b. */
static size_t stripe_bytes(const struct plan *s, bool of_a, size_t b)
{
    size_t k0, k;
    block(s, b, &k0, &k);
    return of_a ? dar_tile_bytes_a(s->t, k) : dar_tile_bytes_b(s->t, k);
}

/* Stripes [begin, end) over block b. */
static void pack(const struct plan *s, bool of_a, size_t begin, size_t end, size_t b, char *dst)
{
    size_t k0, k, wide = of_a ? s->t->mr : s->t->nr, lanes = of_a ? s->p->m : s->p->n;
    const dar_term *term = block(s, b, &k0, &k);
    const dar_operand *x = of_a ? &term->a : &term->b;
    size_t step = x->many ? end - begin : 1, bytes = stripe_bytes(s, of_a, b);

    if (!k || lies(s->p, x, of_a)) return;
    for (size_t i = begin; i < end; i += step, dst += bytes * step) {
        size_t at = i * wide, last = min(lanes, (i + step) * wide);
        x->pack(x->ctx, s->t, at, last - at, k0, k, dst);
    }
}

/* The shared stripes of block b: of B in this panel, or if thin of A. */
static char *shared_block(const struct plan *s, size_t b)
{
    size_t stripes = s->thin ? s->rows : s->panel, wide = s->thin ? s->t->mr : s->t->nr;
    return s->shared + (b - s->b0) * stripes * s->depth * wide * s->t->unit_bytes;
}

static void pack_shared(void *ctx, size_t i, int thread)
{
    const struct plan *s = ctx;
    size_t all = s->thin ? s->rows : min(s->panel, s->cols - s->first), first = s->thin ? 0 : s->first;
    size_t b = s->b0 + i / s->groups, g = i % s->groups, begin = all * g / s->groups, end = all * (g + 1) / s->groups;
    (void)thread;
    pack(s, s->thin, first + begin, first + end, b, shared_block(s, b) + begin * stripe_bytes(s, s->thin, b));
}

static void share(struct plan *s, size_t stripes)
{
    size_t blocks = s->b1 - s->b0, many = ceil_div(4 * (size_t)dar_threads(), blocks), wide = ceil_div(stripes, GROUP);
    s->groups = min(stripes, many > wide ? many : wide);
    dar_parallel(blocks * s->groups, pack_shared, s);
}

/* ---------------------------------------------------------------- multiplying */

/* A task: stripes [r0, r1) of A by [c0, c1) of B.  a, b: packed for this block, or NULL: shared, or in place. */
struct task {
    size_t r0, r1, c0, c1;
    char *a, *b, *c; /* this thread's memory */
};

/* Where C's tile (i, j) is summed. */
static char *sum_at(const struct plan *s, const struct task *w, size_t i, size_t j, size_t *ldc)
{
    size_t elem = s->t->kind == DAR_TILE_F64 ? 8 : 4, row = i * s->t->mr, col = j * s->t->nr;
    if (!s->p->direct && s->blocks == 1) {
        *ldc = s->t->nr;
        return w->c;
    }
    *ldc = s->p->direct ? s->p->ldc : s->piece * s->t->nr;
    if (!s->p->direct) row -= w->r0 * s->t->mr, col -= w->c0 * s->t->nr;
    return (s->p->direct ? (char *)s->p->c : w->c) + (row * *ldc + col) * elem;
}

static void multiply_block(const struct plan *s, const struct task *w, size_t b)
{
    const dar_tile *t = s->t;
    size_t k0, k, stripe_a = stripe_bytes(s, true, b), stripe_b = stripe_bytes(s, false, b), ldc;
    const dar_term *term = block(s, b, &k0, &k);
    const dar_operand *in_a = term->a.in_place ? &term->a : NULL, *in_b = lies(s->p, &term->b, false) ? &term->b : NULL;
    const char *as = s->thin ? shared_block(s, b) + w->r0 * stripe_a : w->a;
    const char *bs = s->thin ? w->b : shared_block(s, b) + (w->c0 - s->first) * stripe_b;
    dar_put put = b || (s->p->direct && s->p->add) ? DAR_PUT_ADD : s->stream ? DAR_PUT_STREAM : DAR_PUT;
    bool last = b + 1 == s->blocks;

    for (size_t j = w->c0; j < w->c1; j++) {
        const char *pb = bs + (j - w->c0) * stripe_b;
        size_t b_k = in_b ? in_b->row : t->nr;
        size_t n = min(s->p->n - j * t->nr, t->nr);
        if (in_b) pb = (const char *)in_b->units + (k0 / t->unit * b_k + j * t->nr) * t->unit_bytes;
        for (size_t i = w->r0; i < w->r1; i++) {
            const char *pa = as + (i - w->r0) * stripe_a;
            size_t m = min(s->p->m - i * t->mr, t->mr), a_row = 1, a_k = t->mr;
            char *c = sum_at(s, w, i, j, &ldc);
            if (in_a) {
                pa = (const char *)in_a->units + (i * t->mr * in_a->row + k0 / t->unit) * t->unit_bytes;
                a_row = in_a->row, a_k = 1;
            } else if (term->a.by_row) {
                a_row = dar_tile_units(t, k), a_k = 1;
            }
            (in_b && i == w->r0 ? t->mm_beside : t->mm)(dar_tile_units(t, k), pa, a_row, a_k, pb, b_k, c, ldc, m, n,
                                                        put);
            if (last && s->p->done) s->p->done(s->p->ctx, i * t->mr, j * t->nr, m, n, c, ldc);
        }
    }
}

static void multiply(void *ctx, size_t i, int thread)
{
    const struct plan *s = ctx;
    char *own = s->own + (size_t)thread * (s->a_bytes + s->b_bytes + s->c_bytes);
    size_t r = i / s->tn, c = i % s->tn, panel = min(s->panel, s->cols - s->first);
    struct task w = { .a = own, .b = own + s->a_bytes, .c = own + s->a_bytes + s->b_bytes };
    size_t end = s->first + panel * (c + 1) / s->tn;

    w.r0 = s->rows * r / s->tm;
    w.r1 = s->rows * (r + 1) / s->tm;
    for (w.c0 = s->first + panel * c / s->tn; w.c0 < end; w.c0 = w.c1) {
        w.c1 = min(w.c0 + s->piece, end);
        for (size_t b = s->b0; b < s->b1; b++) {
            if (s->thin) pack(s, false, w.c0, w.c1, b, w.b);
            else pack(s, true, w.r0, w.r1, b, w.a);
            multiply_block(s, &w, b);
        }
    }
}

void dar_product_run(const dar_product *p, void *scratch)
{
    struct plan s;
    if (!p->m || !p->n) return;
    cut(&s, p);
    s.shared = scratch;
    s.own = s.shared + s.shared_bytes;
    s.b1 = s.blocks;
    if (s.thin) {
        if (s.share) share(&s, s.rows);
        dar_parallel(s.tn, multiply, &s);
        return;
    }
    for (size_t i = 0; i < s.spans; i++) {
        s.b0 = s.blocks * i / s.spans;
        s.b1 = s.blocks * (i + 1) / s.spans;
        for (s.first = 0; s.first < s.cols; s.first += s.panel) {
            size_t panel = min(s.panel, s.cols - s.first);
            if (s.share) share(&s, panel);
            dar_parallel(s.tm * s.tn, multiply, &s);
        }
    }
}
