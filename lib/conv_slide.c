/* conv_slide.c: how the sliding convolution is cut.
 *
 *   a frame in runs     of places (lib/conv_grid.h); what those between the rows make is not stored.  Several small
 *                       frames are one run
 *   channels in blocks  of x: packed for a run in all frames of the kernel, they fit half of the second-level cache;
 *                       where all blocks do, a task goes on to the next frame and packs only what is new
 *   tiles               pixels first: rows of w stay in the first-level cache, pixels stream past them
 *
 * How channels are cut does not depend on the number of frames. */
#include "lib/conv_slide.h"

#include "lib/conv_grid.h"
#include "lib/kern.h"
#include "lib/size.h"
#include "lib/thread.h"
#include "lib/tile.h"

#define PIXELS     288                 /* of a run, at most; */
#define C_BYTES    ((size_t)512 << 10) /* more where few channels leave room for them, */
#define AROUND     2                   /* up to so many times what is read around them */
#define B_BYTES    ((size_t)448 << 10)
#define RING_BYTES ((size_t)704 << 10) /* where they stay for the next frame */
#define SHORT      64                  /* rows: a store costs as much as some columns */
#define STEPS      1024                /* of one tile call */
#define ROWS       512                 /* of w per task */
#define TASKS      16                  /* wanted at least, */
#define FEW        4                   /* at least, though frames be small, */
#define LITTLE     96                  /* but none with fewer rows: they pay for packing pixels */
#define FILL       16                  /* channels filled in before they are packed: first-level cache */
#define TURN       48                  /* rows of turned w written together, */
#define TURN_DEPTH 128                 /* from so many channels: second-level cache */

struct job {
    const dar_conv_slide *s;
    const dar_conv *c;
    const dar_tile *tile;
    dar_dtype operand, sum; /* types of packed operands and of the result */
    size_t taps, units;     /* kt kh kw; units of channels */
    dar_conv_grid grid;
    size_t stack, groups;                /* frames of a run, and how many such groups there are; */
    size_t chain, chains;                /* groups that a task goes through */
    size_t m, n, down, runs;             /* rows and places of a task, tasks along rows and along places */
    size_t ld, depth;                    /* distance of channels in packed pixels, units of a block */
    size_t lines;                        /* of a unit of channels: of frames and phases */
    bool ring;                           /* packed frames stay for the next group: frame f on line f mod kt */
    bool packs_a;                        /* w is copied; else it is read where it lies */
    size_t row;                          /* distance of its rows [units] */
    size_t at_bytes, a_bytes;            /* shared by all threads */
    size_t b_bytes, c_bytes, fill_bytes; /* of one thread */
    size_t *at; /* where the taps of w's unit read [units]; kt times, for each line that frame 0 may be on */
    char *a, *own;
};

/* Pixels in a packed run of n: whole lines, and an odd number of them, since channels would share their place in the
 * cache. */
static size_t packed_run(const struct job *j, size_t n)
{
    size_t line = DAR_ALIGN / j->tile->unit_bytes;
    return (dar_blocks(n + j->grid.around, line) | 1) * line;
}

/* Small frames follow each other on one line, if all channels of them fit. */
static void stack(struct job *j)
{
    const dar_conv *c = &j->s->c;
    const dar_conv_grid *g = &j->grid;
    size_t most = g->plane < PIXELS ? (PIXELS - g->plane) / dar_most(g->frame, 1) + 1 : 1;

    j->stack = dar_even_block(c->To, most, 1, dar_blocks(FEW, dar_most(c->B, 1)), 1);
    size_t line = packed_run(j, (j->stack - 1 + c->kt) * g->frame);
    if (j->units * g->phases * line * j->tile->unit_bytes > B_BYTES) j->stack = 1;
    j->groups = dar_blocks(c->To, j->stack);
}

static void cut(struct job *j)
{
    const dar_conv *c = j->c;
    const dar_conv_grid *g = &j->grid;
    const dar_tile *t = j->tile;
    size_t around = AROUND * (g->kh - 1) * g->pitch, elem = dar_dtype_size(j->sum);
    size_t limit = C_BYTES / elem / dar_most(dar_least(c->Cout, ROWS), 1), frames = c->B * j->groups;
    size_t places = (j->stack - 1) * g->frame + g->plane;

    limit = dar_most(dar_least(limit, around), PIXELS);
    j->n = dar_even_block(places, limit, t->nr, dar_blocks(TASKS, dar_most(frames, 1)), PIXELS);
    j->runs = dar_blocks(places, j->n);
    j->m = dar_even_block(c->Cout, ROWS, t->mr, dar_blocks(TASKS, dar_most(frames * j->runs, 1)), LITTLE);
    j->down = dar_blocks(c->Cout, j->m);
    j->lines = g->phases * (j->stack > 1 ? 1 : c->kt);
    j->ld = packed_run(j, j->n + (j->stack > 1 ? c->kt * g->frame : 0));

    size_t fit = B_BYTES / (c->kt * g->phases * packed_run(j, dar_least(limit, g->plane)) * t->unit_bytes);
    j->depth = dar_most(dar_least(fit, STEPS / j->taps), 1);
    j->depth = dar_most(dar_blocks(j->units, dar_most(dar_blocks(j->units, j->depth), 1)), 1);

    size_t blocks = dar_most(dar_blocks(j->units, j->depth), 1), one = j->lines * j->depth * j->ld * t->unit_bytes;
    j->ring = c->kt > 1 && j->stack == 1 && blocks * one <= RING_BYTES;
    j->chains = j->ring ? dar_least(dar_blocks(TASKS, dar_most(c->B * j->runs * j->down, 1)), j->groups) : j->groups;
    j->chain = dar_most(dar_blocks(j->groups, dar_most(j->chains, 1)), 1);
    j->chains = dar_blocks(j->groups, j->chain);
    j->b_bytes = one * (j->ring ? blocks : 1);
}

static struct job job_of(const dar_conv_slide *s)
{
    static const dar_dtype of[] = { [DAR_TILE_F64] = DAR_F64, [DAR_TILE_F32] = DAR_F32, [DAR_TILE_BF16] = DAR_BF16 };
    const dar_conv *c = &s->c;
    dar_tile_kind kind = dar_tile_kind_for(s->x_type == DAR_BF16 && s->w_type != DAR_BF16 ? DAR_F32 : s->x_type);
    struct job j = { .s = s, .c = c, .operand = of[kind], .sum = dar_compute_type(s->x_type) };

    j.taps = c->kt * c->kh * c->kw;
    j.grid = dar_conv_grid_of(c);
    j.tile = dar_tile_for(kind, j.grid.plane);
    j.units = dar_tile_units(j.tile, c->Cin);
    stack(&j);
    size_t places = (j.stack - 1) * j.grid.frame + j.grid.plane;
    j.tile = dar_tile_fit(kind, c->Cout, dar_round_up(places, 32)); /* tiles of 16 columns read w too often */
    cut(&j);

    size_t line = DAR_ALIGN / j.tile->unit_bytes, unit = j.tile->unit_bytes;
    j.packs_a = s->turned || s->w_type != j.operand || (j.tile->unit > 1 && (j.taps > 1 || c->Cin % j.tile->unit));
    j.row = j.packs_a ? (dar_blocks(j.units * j.taps, line) | 1) * line : j.units * j.taps;
    j.at_bytes = dar_round_up(c->kt * j.taps * sizeof *j.at, DAR_ALIGN);
    j.a_bytes = j.packs_a ? c->Cout * j.row * unit : 0;
    j.c_bytes = dar_round_up(j.m * j.n * dar_dtype_size(j.sum), DAR_ALIGN);
    j.fill_bytes = dar_round_up((FILL + 1) * j.ld * sizeof(double), DAR_ALIGN);
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

/* Rows r0.. of w, places q0.. of `frames` output frames from t on. */
struct task {
    size_t batch, t, frames, r0, m, q0, n;
    char *b, *c, *buf;
};

/* The frame that is read at kt. */
static int64_t frame_at(const dar_conv *c, const struct task *w, size_t kt)
{
    return (int64_t)(w->t + kt) - c->front;
}

/* How a line is stored before it is packed: as its frame is, or as what all frames of a stack are. */
static dar_dtype line_type(const struct job *j, const struct task *w, size_t channel, size_t kt)
{
    const dar_clip *v = &j->s->in;
    dar_dtype type = v->x->dtype;
    if (j->stack == 1) dar_clip_frame(v, w->batch, channel, frame_at(j->c, w, kt), &type);
    else if (v->P && v->past->data && v->past->dtype != type) type = j->operand;
    return type;
}

/* One channel of a line: one frame, or those of a stack. */
static void read_line(const struct job *j, const struct task *w, size_t kt, size_t phase, size_t channel,
                      dar_dtype line, char *to)
{
    size_t frames = j->stack > 1 ? w->frames - 1 + j->c->kt : 1, size = dar_dtype_size(line);
    char *other = w->buf + FILL * j->ld * sizeof(double);
    for (size_t f = 0, at = 0, n; f < frames; f++, at += n) {
        dar_dtype type = line;
        const char *frame = dar_clip_frame(&j->s->in, w->batch, channel, frame_at(j->c, w, kt + f), &type);
        char *dst = to + at * size;
        n = f + 1 < frames ? j->grid.frame : j->ld - at;
        if (frame) dar_conv_grid_read(&j->grid, phase, type, type == line ? dst : other, frame, w->q0, n);
        else dar_clip_zero(dst, n, size);
        if (type != line) dar_row_convert(line, dst, type, other, n);
    }
}

/* Channels from unit u on, of a phase in the line of frames from kt on: `units` rows of ld pixels. */
static void pack_line(const struct job *j, const struct task *w, size_t kt, size_t phase, size_t u, size_t units,
                      char *b)
{
    const dar_tile *tile = j->tile;
    size_t c0 = u * tile->unit, channels = dar_least(units * tile->unit, j->c->Cin - c0);
    dar_dtype type = line_type(j, w, c0, kt);
    if (j->stack == 1 && !dar_clip_frame(&j->s->in, w->batch, c0, frame_at(j->c, w, kt), &type)) {
        memset(b, 0, units * j->ld * tile->unit_bytes);
        return;
    }
    bool as_is = tile->unit == 1 && type == j->operand; /* a row of pixels is a row of units */
    for (size_t i = 0; i < channels; i += FILL) {
        size_t k = dar_least(FILL, channels - i), row = j->ld * dar_dtype_size(type);
        char *rows = as_is ? b + i * row : w->buf;
        for (size_t c = 0; c < k; c++) read_line(j, w, kt, phase, c0 + i + c, type, rows + c * row);
        if (!as_is)
            dar_tile_pack_b_wide(tile, type, rows, j->ld, k, j->ld, j->ld,
                                 b + i / tile->unit * j->ld * tile->unit_bytes);
    }
}

/* ---------------------------------------------------------------- tasks */

/* Ask for what a run reads of one channel in the frame at kt: memory would stand idle during the product, and wait for
 * every new channel afterwards. */
static void ahead(const struct job *j, const struct task *w, size_t channel, size_t kt)
{
    const dar_conv *c = j->c;
    size_t rows = dar_blocks(j->ld, j->grid.pitch) * c->stride;
    int64_t first = (int64_t)(w->q0 / j->grid.pitch * c->stride) - c->top;
    size_t row = first < 0 ? 0 : (size_t)first;
    dar_dtype type;

    if (channel >= c->Cin || row >= c->H) return;
    const char *frame = dar_clip_frame(&j->s->in, w->batch, channel, frame_at(c, w, kt), &type);
    if (!frame) return;
    size_t size = dar_dtype_size(type) * c->W;
    rows = dar_least(rows, c->H - row);
    for (size_t i = 0; i < rows * size; i += DAR_ALIGN) __builtin_prefetch(frame + row * size + i, 0, 2);
}

/* A piece of what is packed next: the next block in all frames, or, where packed frames stay, this one in the next. */
static void ahead_piece(const struct job *j, const struct task *w, size_t u, size_t units, size_t piece)
{
    size_t kt = j->c->kt;
    if (j->ring) ahead(j, w, u * j->tile->unit + piece, kt);
    else ahead(j, w, (u + units) * j->tile->unit + piece / kt, piece % kt);
}

/* c (+)= the block of `units` at u, packed at b.  Meanwhile the next one is asked for. */
static void multiply(const struct job *j, const struct task *w, size_t u, size_t units, const char *b)
{
    const dar_tile *t = j->tile;
    size_t size = dar_dtype_size(j->sum), bytes = t->unit_bytes;
    size_t calls = dar_blocks(w->m, t->mr) * dar_blocks(w->n, t->nr), call = 0, piece = 0;
    size_t next = j->ring ? units : dar_least(j->depth, j->units - u - units) * j->c->kt, pieces = next * t->unit;
    const char *a = (j->packs_a ? j->a : (char *)j->s->w->data) + (w->r0 * j->row + u * j->taps) * bytes;
    const size_t *at = j->at + (j->ring ? w->t % j->c->kt * j->taps : 0);

    for (size_t i = 0; i < w->m; i += t->mr)
        for (size_t q = 0; q < w->n; q += t->nr) {
            for (call++; piece * calls < call * pieces; piece++) ahead_piece(j, w, u, units, piece);
            t->mm_taps(units, j->taps, at, a + i * j->row * bytes, j->row, b + q * bytes, j->ld,
                       w->c + (i * j->n + q) * size, j->n, dar_least(t->mr, w->m - i), dar_least(t->nr, w->n - q),
                       u ? DAR_PUT_ADD : DAR_PUT);
        }
}

/* n places from q on lose those between the rows; returns how many are left. */
static size_t close_rows(const struct job *j, char *c, size_t q, size_t n)
{
    size_t size = dar_dtype_size(j->sum), Wo = j->c->Wo, pitch = j->grid.pitch, kept = 0;
    for (size_t i = 0, step; i < n; i += step) {
        size_t x = (q + i) % pitch, part = x < Wo ? dar_least(Wo - x, n - i) : 0;
        step = pitch - x;
        if (kept < i) memmove(c + kept * size, c + i * size, part * size);
        kept += part;
    }
    return kept;
}

/* Places q0.. of one frame to `to`, whose rows are dense; short ones are moved together first, to be stored as one. */
static void store_frame(const struct job *j, const struct task *w, char *c, dar_dtype type, char *to, dar_put mode)
{
    size_t Wo = j->c->Wo, pitch = j->grid.pitch, size = dar_dtype_size(j->sum), n = dar_least(w->n, j->grid.plane);
    size_t first = w->q0 / pitch * Wo + dar_least(w->q0 % pitch, Wo), part;

    to += first * dar_dtype_size(type);
    if (Wo < SHORT) {
        dar_row_put(j->sum, c, type, to, close_rows(j, c, w->q0, n), mode);
        return;
    }
    for (size_t i = 0; i < n; i += pitch - (w->q0 + i) % pitch, to += part * dar_dtype_size(type)) {
        size_t x = (w->q0 + i) % pitch;
        part = x < Wo ? dar_least(Wo - x, n - i) : 0;
        if (part) dar_row_put(j->sum, c + i * size, type, to, part, mode);
    }
}

/* out = c + b. */
static void store(const struct job *j, const struct task *w)
{
    const dar_conv_slide *s = j->s;
    const dar_clip *v = &s->out;
    dar_put all = dar_put_for(v->x->data ? dar_tensor_bytes(v->x) : 0, s->add);
    bool bias = s->b && s->b->data;
    dar_dtype type;

    for (size_t o = w->r0; o < w->r0 + w->m; o++) {
        char *c = w->c + (o - w->r0) * j->n * dar_dtype_size(j->sum);
        if (bias) dar_kern_for(j->sum)->offset(w->n, dar_dtype_get(s->b->dtype, s->b->data, o), c, c);
        for (size_t f = 0; f < w->frames; f++, c += j->grid.frame * dar_dtype_size(j->sum)) {
            char *to = dar_clip_frame(v, w->batch, o, (int64_t)(w->t + f) - (int64_t)v->P, &type);
            dar_put mode = w->t + f >= v->P ? all : s->add_past ? DAR_PUT_ADD : DAR_PUT;
            if (to) store_frame(j, w, c, type, to, mode);
        }
    }
}

/* Frames on lines below `known` are packed already. */
static void run_group(const struct job *j, const struct task *w, size_t known)
{
    const dar_conv *c = j->c;
    size_t phases = j->grid.phases, line = phases * j->depth * j->ld * j->tile->unit_bytes;
    char *b = w->b;

    for (size_t u = 0; u == 0 || u < j->units; u += j->depth) { /* of no channels: zeros */
        size_t units = dar_least(j->depth, j->units - u), lines = j->stack > 1 ? 1 : c->kt;
        for (size_t k = 0; k < lines; k++)
            for (size_t p = 0; p < phases && w->t + k >= known; p++)
                pack_line(j, w, k, p, u, units, b + (j->ring ? (w->t + k) % c->kt : k) * line + p * (line / phases));
        multiply(j, w, u, units, b);
        if (j->ring) b += c->kt * line;
    }
    store(j, w);
}

static void task(void *ctx, size_t i, int thread)
{
    const struct job *j = ctx;
    const dar_conv *c = j->c;
    struct task w = { .r0 = i % j->down * j->m, .q0 = i / j->down % j->runs * j->n };
    size_t chain = i / j->down / j->runs, end = dar_least((chain % j->chains + 1) * j->chain, j->groups);

    w.batch = chain / j->chains;
    w.m = dar_least(j->m, c->Cout - w.r0);
    w.b = j->own + (size_t)thread * own_bytes(j);
    w.c = w.b + j->b_bytes;
    w.buf = w.c + j->c_bytes;
    for (size_t g = chain % j->chains * j->chain, known = 0; g < end; g++) {
        w.t = g * j->stack;
        w.frames = dar_least(j->stack, c->To - w.t);
        w.n = dar_least(j->n, (w.frames - 1) * j->grid.frame + j->grid.plane - w.q0);
        run_group(j, &w, known);
        if (j->ring) known = w.t + c->kt;
    }
}

/* Where tap i of the unit reads, if the first frame is on line `first`. */
static size_t place_of(const struct job *j, size_t i, size_t first)
{
    const dar_conv *c = j->c;
    size_t tap = j->s->turned ? j->taps - 1 - i : i, kt = tap / c->kw / c->kh;
    size_t y = tap / c->kw % c->kh, x = tap % c->kw, place = dar_conv_grid_place(&j->grid, y, x);
    size_t phase = dar_conv_grid_phase(&j->grid, y, x);
    if (j->stack > 1) return phase * j->depth * j->ld + kt * j->grid.frame + place;
    return ((kt + first) % c->kt * j->grid.phases + phase) * j->depth * j->ld + place;
}

void dar_conv_slide_run(const dar_conv_slide *s, void *scratch)
{
    struct job j = job_of(s);
    const dar_conv *c = &s->c;
    size_t all = c->B * j.chains * j.runs * j.down;

    if (!all) return;
    j.at = scratch;
    j.a = (char *)scratch + j.at_bytes;
    j.own = j.a + j.a_bytes;
    for (size_t i = 0; i < c->kt * j.taps; i++) j.at[i] = place_of(&j, i % j.taps, i / j.taps);
    if (j.packs_a) dar_parallel_range(c->Cout, TURN, pack_weights, &j);
    dar_parallel(all, task, &j);
}
