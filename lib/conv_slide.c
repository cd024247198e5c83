/* conv_slide.c: how the sliding convolution is cut.
 *
 *   a frame in runs     of places (lib/conv_grid.h); what those between the rows make is not stored
 *   channels in blocks  of x: packed for a run in all frames of the kernel, they fit half of the second-level cache
 *   tiles               pixels first: rows of w stay in the first-level cache, pixels stream past them
 *
 * How channels are cut does not depend on the number of frames. */
#include "lib/conv_slide.h"

#include "lib/conv_grid.h"
#include "lib/kern.h"
#include "lib/size.h"
#include "lib/thread.h"
#include "lib/tile.h"

#define PIXELS     256                 /* of a run, at most; */
#define C_BYTES    ((size_t)512 << 10) /* more where few channels leave room for them, */
#define AROUND     2                   /* up to so many times what is read around them */
#define B_BYTES    ((size_t)448 << 10)
#define STEPS      1024 /* of one tile call */
#define ROWS       512  /* of w per task */
#define TASKS      16   /* wanted at least, */
#define LITTLE     96   /* but none with fewer rows: they pay for packing pixels */
#define FILL       16   /* channels filled in before they are packed: first-level cache */
#define TURN       48   /* rows of turned w written together, */
#define TURN_DEPTH 128  /* from so many channels: second-level cache */

struct job {
    const dar_conv_slide *s;
    const dar_conv *c;
    const dar_tile *tile;
    dar_dtype operand, sum; /* types of packed operands and of the result */
    size_t taps, units;     /* kt kh kw; units of channels */
    dar_conv_grid grid;
    size_t m, n, down, runs;             /* rows and pixels of a task, tasks along rows and along pixels */
    size_t ld, depth;                    /* distance of channels in packed pixels, units of a block */
    bool packs_a;                        /* w is copied; else it is read where it lies */
    size_t row;                          /* distance of its rows [units] */
    size_t at_bytes, a_bytes;            /* shared by all threads */
    size_t b_bytes, c_bytes, fill_bytes; /* of one thread */
    size_t *at;                          /* where the taps of w's unit read [units] */
    char *a, *own;
};

/* Pixels in a packed run of n: whole lines, and an odd number of them, since channels would share their place in the
 * cache. */
static size_t packed_run(const struct job *j, size_t n)
{
    size_t line = DAR_ALIGN / j->tile->unit_bytes;
    return (dar_blocks(n + j->grid.around, line) | 1) * line;
}

static void cut(struct job *j)
{
    const dar_conv *c = j->c;
    const dar_tile *t = j->tile;
    size_t around = AROUND * (j->grid.kh - 1) * j->grid.pitch, elem = dar_dtype_size(j->sum);
    size_t limit = C_BYTES / elem / dar_most(dar_least(c->Cout, ROWS), 1), frames = c->B * c->To;

    limit = dar_most(dar_least(limit, around), PIXELS);
    j->n = dar_even_block(j->grid.plane, limit, t->nr, dar_blocks(TASKS, dar_most(frames, 1)), PIXELS);
    j->runs = dar_blocks(j->grid.plane, j->n);
    j->m = dar_even_block(c->Cout, ROWS, t->mr, dar_blocks(TASKS, dar_most(frames * j->runs, 1)), LITTLE);
    j->down = dar_blocks(c->Cout, j->m);
    j->ld = packed_run(j, j->n);

    size_t fit = B_BYTES / (c->kt * j->grid.phases * packed_run(j, dar_least(limit, j->grid.plane)) * t->unit_bytes);
    j->depth = dar_most(dar_least(fit, STEPS / j->taps), 1);
    j->depth = dar_most(dar_blocks(j->units, dar_most(dar_blocks(j->units, j->depth), 1)), 1);
}

static struct job job_of(const dar_conv_slide *s)
{
    static const dar_dtype of[] = { [DAR_TILE_F64] = DAR_F64, [DAR_TILE_F32] = DAR_F32, [DAR_TILE_BF16] = DAR_BF16 };
    const dar_conv *c = &s->c;
    dar_tile_kind kind = dar_tile_kind_for(s->x_type == DAR_BF16 && s->w_type != DAR_BF16 ? DAR_F32 : s->x_type);
    struct job j = { .s = s, .c = c, .operand = of[kind], .sum = dar_compute_type(s->x_type) };

    j.taps = c->kt * c->kh * c->kw;
    j.grid = dar_conv_grid_of(c);
    j.tile = dar_tile_fit(kind, c->Cout, dar_round_up(j.grid.plane, 32)); /* tiles of 16 columns read w too often */
    j.units = dar_tile_units(j.tile, c->Cin);
    cut(&j);

    size_t line = DAR_ALIGN / j.tile->unit_bytes, unit = j.tile->unit_bytes;
    j.packs_a = s->turned || s->w_type != j.operand || (j.tile->unit > 1 && (j.taps > 1 || c->Cin % j.tile->unit));
    j.row = j.packs_a ? (dar_blocks(j.units * j.taps, line) | 1) * line : j.units * j.taps;
    j.at_bytes = dar_round_up(j.taps * sizeof *j.at, DAR_ALIGN);
    j.a_bytes = j.packs_a ? c->Cout * j.row * unit : 0;
    j.b_bytes = c->kt * j.grid.phases * j.depth * j.ld * unit;
    j.c_bytes = dar_round_up(j.m * j.n * dar_dtype_size(j.sum), DAR_ALIGN);
    j.fill_bytes = dar_round_up(FILL * j.ld * sizeof(double), DAR_ALIGN);
    return j;
}

static size_t own_bytes(const struct job *j)
{
    return j->b_bytes + j->c_bytes + j->fill_bytes;
}

size_t dar_conv_slide_scratch(const dar_conv_slide *s, int threads)
{
    struct job j = job_of(s);
    return j.at_bytes + j.a_bytes + (size_t)threads * own_bytes(&j);
}

/* ---------------------------------------------------------------- w */

/* Rows [begin, end): for each unit of channels its taps, which is how a tile wants columns. */
static void pack_weights(void *ctx, size_t begin, size_t end, int thread)
{
    const struct job *j = ctx;
    const dar_tensor *w = j->s->w;
    size_t Cin = j->c->Cin, Cout = j->c->Cout, unit = j->tile->unit, block = j->s->turned ? TURN_DEPTH : Cin;
    size_t ld = (j->s->turned ? Cout : 1) * j->taps;
    (void)thread;

    for (size_t c = 0; c < Cin; c += block)
        for (size_t r = begin; r < end; r++) {
            size_t at = j->s->turned ? c * Cout + r : r * Cin + c;
            dar_tile_pack_b_wide(j->tile, w->dtype, (char *)w->data + at * j->taps * dar_dtype_size(w->dtype), ld,
                                 dar_least(block, Cin - c), j->taps, j->taps,
                                 j->a + (r * j->row + c / unit * j->taps) * j->tile->unit_bytes);
        }
}

/* ---------------------------------------------------------------- pixels */

/* Rows r0.. of w, pixels q0.. of an output frame. */
struct task {
    size_t batch, t, r0, m, q0, n;
    char *b, *c, *buf;
};

/* The frame that is read at kt. */
static int64_t frame_at(const dar_conv *c, const struct task *w, size_t kt)
{
    return (int64_t)(w->t + kt) - c->front;
}

/* Channels from unit u on, of a phase in frame t: `units` rows of ld pixels. */
static void pack_frame(const struct job *j, const struct task *w, int64_t t, size_t phase, size_t u, size_t units,
                       char *b)
{
    const dar_tile *tile = j->tile;
    size_t c0 = u * tile->unit, channels = dar_least(units * tile->unit, j->c->Cin - c0);
    dar_dtype type = j->operand;

    if (!dar_clip_frame(&j->s->in, w->batch, c0, t, &type)) {
        memset(b, 0, units * j->ld * tile->unit_bytes);
        return;
    }
    bool as_is = tile->unit == 1 && type == j->operand; /* a row of pixels is a row of units */
    for (size_t i = 0; i < channels; i += FILL) {
        size_t k = dar_least(FILL, channels - i), row = j->ld * dar_dtype_size(type);
        char *rows = as_is ? b + i * row : w->buf;
        for (size_t c = 0; c < k; c++) {
            const char *frame = dar_clip_frame(&j->s->in, w->batch, c0 + i + c, t, &type);
            dar_conv_grid_read(&j->grid, phase, type, rows + c * row, frame, w->q0, j->ld);
        }
        if (!as_is)
            dar_tile_pack_b_wide(tile, type, rows, j->ld, k, j->ld, j->ld,
                                 b + i / tile->unit * j->ld * tile->unit_bytes);
    }
}

/* ---------------------------------------------------------------- tasks */

/* Ask for what a run reads of one frame and channel, counted from the first of unit u: memory would stand idle during
 * the product, and wait for every new channel afterwards. */
static void ahead(const struct job *j, const struct task *w, size_t u, size_t piece)
{
    const dar_conv *c = j->c;
    size_t channel = u * j->tile->unit + piece / c->kt, rows = dar_blocks(j->ld, j->grid.pitch) * c->stride;
    int64_t first = (int64_t)(w->q0 / j->grid.pitch * c->stride) - c->top;
    size_t row = first < 0 ? 0 : (size_t)first;
    dar_dtype type;

    if (channel >= c->Cin || row >= c->H) return;
    const char *frame = dar_clip_frame(&j->s->in, w->batch, channel, frame_at(c, w, piece % c->kt), &type);
    if (!frame) return;
    size_t size = dar_dtype_size(type) * c->W;
    rows = dar_least(rows, c->H - row);
    for (size_t i = 0; i < rows * size; i += DAR_ALIGN) __builtin_prefetch(frame + row * size + i, 0, 2);
}

/* c (+)= the block of `units` at u.  Meanwhile the next one is asked for. */
static void multiply(const struct job *j, const struct task *w, size_t u, size_t units)
{
    const dar_tile *t = j->tile;
    size_t size = dar_dtype_size(j->sum), bytes = t->unit_bytes;
    size_t calls = dar_blocks(w->m, t->mr) * dar_blocks(w->n, t->nr), call = 0, next = u + units, piece = 0;
    size_t pieces = next < j->units ? dar_least(j->depth, j->units - next) * t->unit * j->c->kt : 0;
    const char *a = (j->packs_a ? j->a : (char *)j->s->w->data) + (w->r0 * j->row + u * j->taps) * bytes;

    for (size_t i = 0; i < w->m; i += t->mr)
        for (size_t q = 0; q < w->n; q += t->nr) {
            for (call++; piece * calls < call * pieces; piece++) ahead(j, w, next, piece);
            t->mm_taps(units, j->taps, j->at, a + i * j->row * bytes, j->row, w->b + q * bytes, j->ld,
                       w->c + (i * j->n + q) * size, j->n, dar_least(t->mr, w->m - i), dar_least(t->nr, w->n - q),
                       u ? DAR_PUT_ADD : DAR_PUT);
        }
}

/* out = c + b, without what lies between the rows. */
static void store(const struct job *j, const struct task *w)
{
    const dar_conv_slide *s = j->s;
    const dar_clip *v = &s->out;
    const dar_kern *k = dar_kern_for(j->sum);
    size_t size = dar_dtype_size(j->sum), Wo = j->c->Wo;
    bool past = w->t < v->P, bias = s->b && s->b->data;
    dar_put mode = dar_put_for(v->x->data ? dar_tensor_bytes(v->x) : 0, s->add);
    dar_dtype type;

    if (past) mode = s->add_past ? DAR_PUT_ADD : DAR_PUT;
    for (size_t o = w->r0; o < w->r0 + w->m; o++) {
        char *row = w->c + (o - w->r0) * j->n * size;
        char *to = dar_clip_frame(v, w->batch, o, (int64_t)w->t - (int64_t)v->P, &type);
        if (!to) return;
        if (bias) k->offset(w->n, dar_dtype_get(s->b->dtype, s->b->data, o), row, row);
        for (size_t i = 0, step; i < w->n; i += step) {
            size_t h = (w->q0 + i) / j->grid.pitch, x = (w->q0 + i) % j->grid.pitch,
                   n = x < Wo ? dar_least(Wo - x, w->n - i) : 0;
            step = j->grid.pitch - x;
            if (n) dar_row_put(j->sum, row + i * size, type, to + (h * Wo + x) * dar_dtype_size(type), n, mode);
        }
    }
}

static void task(void *ctx, size_t i, int thread)
{
    const struct job *j = ctx;
    const dar_conv *c = j->c;
    struct task w = { .r0 = i % j->down * j->m, .q0 = i / j->down % j->runs * j->n };
    size_t frame = i / j->down / j->runs, bytes = j->tile->unit_bytes;

    w.t = frame % c->To;
    w.batch = frame / c->To;
    w.m = dar_least(j->m, c->Cout - w.r0);
    w.n = dar_least(j->n, j->grid.plane - w.q0);
    w.b = j->own + (size_t)thread * own_bytes(j);
    w.c = w.b + j->b_bytes;
    w.buf = w.c + j->c_bytes;
    for (size_t u = 0; u == 0 || u < j->units; u += j->depth) { /* of no channels: zeros */
        size_t units = dar_least(j->depth, j->units - u);
        for (size_t k = 0; k < c->kt * j->grid.phases; k++)
            pack_frame(j, &w, frame_at(c, &w, k / j->grid.phases), k % j->grid.phases, u, units,
                       w.b + k * j->depth * j->ld * bytes);
        multiply(j, &w, u, units);
    }
    store(j, &w);
}

void dar_conv_slide_run(const dar_conv_slide *s, void *scratch)
{
    struct job j = job_of(s);
    const dar_conv *c = &s->c;
    size_t all = c->B * c->To * j.runs * j.down;

    if (!all) return;
    j.at = scratch;
    j.a = (char *)scratch + j.at_bytes;
    j.own = j.a + j.a_bytes;
    for (size_t i = 0; i < j.taps; i++) {
        size_t tap = s->turned ? j.taps - 1 - i : i, kt = tap / c->kw / c->kh, y = tap / c->kw % c->kh, x = tap % c->kw;
        size_t phase = dar_conv_grid_phase(&j.grid, y, x);
        j.at[i] = (kt * j.grid.phases + phase) * j.depth * j.ld + dar_conv_grid_place(&j.grid, y, x);
    }
    if (j.packs_a) dar_parallel_range(c->Cout, TURN, pack_weights, &j);
    dar_parallel(all, task, &j);
}
