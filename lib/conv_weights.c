/* conv_weights.c: the gradient of a convolution by its weights: gw^T[K, Cout] = col gy^T without col.
 *
 * x lies channel by channel on lines with the zeros that the kernel reads (lib/conv_grid.h).  A row of col is such a
 * line from another place on: what the tile reads as rows of A (dar_tile.mm_rows), while gy, on lines of the same
 * pitch, is B.
 *
 *   pixels in steps     as many as leave a stripe of B in the first-level cache: some places of a frame, or several
 *                       small frames that follow each other
 *   steps in chunks     where gw is small: each has its own sum, and these are added in order
 *   gw^T in blocks      that fit the second-level cache
 */
#include "lib/conv_weights.h"

#include <string.h>

#include "lib/conv_clip.h"
#include "lib/conv_grid.h"
#include "lib/kern.h"
#include "lib/size.h"
#include "lib/thread.h"
#include "lib/tile.h"

#define STRIPE  ((size_t)36 << 10)  /* bytes of B per tile */
#define COLUMNS 256                 /* of gw^T in a block, at most */
#define C_BYTES ((size_t)512 << 10) /* of a block, */
#define X_BYTES ((size_t)448 << 10) /* and of the lines that it reads */
#define TASKS   16                  /* wanted at least, */
#define LITTLE  384                 /* with so many rows at least: they pay for packing gy, */
#define FEW     1024                /* and so many places of a chunk: they pay for its sum */
#define PARTS   ((size_t)1 << 20)   /* bytes of gw^T up to which there are chunks */
#define TURN    64                  /* rows of gw^T added up together */
#define FLUSH   8192                /* pixels summed in one accumulator: bounds the error of long sums */
#define LINE    16                  /* columns of gw^T turned at a time: a cache line of f32 */

struct job {
    dar_conv c;
    dar_conv_grid grid;
    dar_clip x;
    const dar_tensor *gy, *gw;
    bool add;
    const dar_tile *tile;
    dar_dtype operand, sum;     /* types of packed operands and of the result */
    size_t taps, K;             /* kt kh kw, Cin taps */
    size_t m, n, down, across;  /* rows and columns of a block, blocks */
    size_t frames, places;      /* of a step: frames, each from one place to another */
    size_t runs, groups, steps; /* steps of a frame's places, of a clip's frames, and in all */
    size_t chunks, chunk;       /* and their steps */
    size_t ld, slots, line;     /* distance of frames in a line, how many there are, distance of lines */
    size_t k;                   /* longest sum per tile call */
    size_t lines;               /* of a block, at most */
    size_t block_bytes;         /* of gw^T */
    size_t rows_bytes, x_bytes, b_bytes, buf_bytes; /* of one thread */
    char *parts, *own;                              /* if there are chunks, [chunk, block]; room of the threads */
};

/* ---------------------------------------------------------------- cutting */

static void cut_steps(struct job *j, size_t unit)
{
    const dar_conv *c = &j->c;
    const dar_conv_grid *g = &j->grid;
    size_t most = STRIPE / (j->tile->nr * j->tile->unit_bytes) * unit, line = DAR_ALIGN / dar_dtype_size(j->operand);

    j->places = dar_even_block(g->plane, most, unit, 1, 1);
    j->runs = dar_blocks(g->plane, j->places);
    j->frames = 1;
    if (j->runs == 1 && c->stride_t == 1) j->frames = dar_even_block(c->To, dar_most(most / g->frame, 1), 1, 1, 1);
    j->groups = dar_blocks(c->To, j->frames);
    j->steps = c->B * j->runs * j->groups;
    j->ld = j->frames > 1 ? g->frame : dar_round_up(j->places + g->around + unit, line);
    j->slots = j->frames - 1 + c->kt;
    j->line = (dar_blocks(j->slots * j->ld + g->around + unit, line) | 1) * line; /* else lines share their place */
    j->k = (j->frames - 1) * j->ld + j->places;
}

static void cut_blocks(struct job *j)
{
    const dar_tile *t = j->tile;
    size_t elem = dar_dtype_size(j->sum);
    bool parts = j->K * j->c.Cout * elem <= PARTS;

    j->n = dar_even_block(j->c.Cout, COLUMNS, t->nr, 1, 1);
    j->across = dar_blocks(j->c.Cout, j->n);
    j->chunk = parts ? dar_most(dar_blocks(j->steps, TASKS), dar_blocks(FEW, j->k)) : j->steps;
    j->chunks = dar_blocks(j->steps, dar_most(j->chunk, 1));
    j->chunk = dar_most(dar_blocks(j->steps, dar_most(j->chunks, 1)), 1);
    size_t lines = X_BYTES / (j->grid.phases * j->line * dar_dtype_size(j->operand));
    size_t limit = dar_least(C_BYTES / elem / j->n, dar_most(lines, 1) * j->taps);
    j->m = dar_even_block(j->K, limit, t->mr, dar_blocks(TASKS, dar_most(j->across * j->chunks, 1)), LITTLE);
    j->down = dar_blocks(j->K, j->m);
    j->block_bytes = dar_round_up(j->m * j->n * elem, DAR_ALIGN);
}

static struct job job_of(const dar_conv *c, dar_dtype x, dar_dtype w)
{
    static const dar_dtype of[] = { [DAR_TILE_F64] = DAR_F64, [DAR_TILE_F32] = DAR_F32, [DAR_TILE_BF16] = DAR_BF16 };
    dar_tile_kind kind = dar_tile_kind_for(x == DAR_BF16 && w != DAR_BF16 ? DAR_F32 : x);
    struct job j = { .c = *c, .operand = of[kind], .sum = dar_compute_type(x), .taps = c->kt * c->kh * c->kw };

    j.grid = dar_conv_grid_of(c);
    j.K = c->Cin * j.taps;
    j.tile = dar_tile_for(kind, c->Cout);
    cut_steps(&j, j.tile->unit);
    cut_blocks(&j);
    size_t size = dar_dtype_size(j.operand);
    j.lines = dar_least((j.m + j.taps - 2) / j.taps + 1, c->Cin);
    j.rows_bytes = dar_round_up((j.m + j.taps) * sizeof(size_t), DAR_ALIGN);
    j.x_bytes = dar_round_up(j.lines * j.grid.phases * j.line * size, DAR_ALIGN);
    j.b_bytes = dar_round_up(dar_blocks(j.n, j.tile->nr) * dar_tile_bytes_b(j.tile, j.k), DAR_ALIGN);
    j.buf_bytes = dar_most(j.tile->nr * j.k, dar_most(j.line, LINE * (j.m + LINE))) * sizeof(double);
    return j;
}

static size_t own_bytes(const struct job *j)
{
    return j->rows_bytes + j->x_bytes + j->b_bytes + j->block_bytes + j->buf_bytes;
}

static size_t parts_bytes(const struct job *j)
{
    return j->chunks > 1 ? j->chunks * j->down * j->across * j->block_bytes : 0;
}

size_t dar_conv_weights_scratch(const dar_conv *c, dar_dtype x, dar_dtype w, int threads)
{
    struct job j = job_of(c, x, w);
    return parts_bytes(&j) + (size_t)threads * own_bytes(&j);
}

/* ---------------------------------------------------------------- operands */

/* Rows k0.., columns o0.. of gw^T, and the step that is summed. */
struct task {
    size_t k0, m, o0, n, c0, channels;
    size_t batch, t, frames, q, places; /* frames from t on, places from q on */
    size_t known;                       /* frames of x before this one, counted from the first in front, are there */
    size_t *at, *rows;                  /* where taps are in a line; where rows begin [elements] */
    char *x, *b, *c, *buf;
};

/* Frames go round where one at a time is summed: those that the next one reads, too, stay. */
static size_t slot_of(const struct job *j, const struct task *w, size_t frame)
{
    return j->frames > 1 ? frame - w->t : frame % j->c.kt;
}

static void read_line(const struct job *j, const struct task *w, size_t channel, size_t phase, size_t frame, char *dst,
                      size_t n)
{
    dar_dtype type = j->operand;
    const char *src = dar_clip_frame(&j->x, w->batch, w->c0 + channel, (int64_t)frame - j->c.front, &type);
    char *to = type == j->operand ? dst : w->buf;

    if (!src) {
        dar_clip_zero(dst, n, dar_dtype_size(j->operand));
        return;
    }
    dar_conv_grid_read(&j->grid, phase, type, to, src, w->q, n);
    if (to != dst) dar_row_convert(j->operand, dst, type, to, n);
}

static void read_x(const struct job *j, struct task *w)
{
    size_t first = w->t * j->c.stride_t, end = first + w->frames - 1 + j->c.kt, size = dar_dtype_size(j->operand);
    size_t from = j->frames > 1 ? first : dar_most(first, w->known), rest = j->grid.around + j->tile->unit;

    for (size_t c = 0; c < w->channels; c++)
        for (size_t p = 0; p < j->grid.phases; p++)
            for (size_t f = from; f < end; f++)
                read_line(j, w, c, p, f, w->x + ((c * j->grid.phases + p) * j->line + slot_of(j, w, f) * j->ld) * size,
                          j->ld + (j->frames > 1 && f + 1 == end ? rest : 0));
    w->known = end;
}

static void place_rows(const struct job *j, const struct task *w)
{
    const dar_conv *c = &j->c;
    size_t first = w->t * c->stride_t, tap = w->k0 % j->taps, from = 0;

    for (size_t i = 0; i < j->taps; i++) {
        size_t y = i / c->kw % c->kh, x = i % c->kw;
        w->at[i] = dar_conv_grid_phase(&j->grid, y, x) * j->line + dar_conv_grid_place(&j->grid, y, x) +
                   slot_of(j, w, first + i / c->kw / c->kh) * j->ld;
    }
    for (size_t i = 0; i < w->m; i++) {
        w->rows[i] = from + w->at[tap];
        if (++tap == j->taps) tap = 0, from += j->grid.phases * j->line;
    }
}

static void read_gy(const struct job *j, const struct task *w, size_t k)
{
    const dar_tile *t = j->tile;
    dar_dtype type = j->gy->dtype;
    size_t frame = j->grid.Ho * j->grid.Wo, size = dar_dtype_size(type);

    for (size_t q = 0; q < w->n; q += t->nr) {
        size_t lanes = dar_least(t->nr, w->n - q);
        for (size_t o = 0; o < lanes; o++)
            for (size_t f = 0; f < w->frames; f++) {
                size_t channel = w->batch * j->c.Cout + w->o0 + q + o;
                dar_conv_grid_spread(&j->grid, type, w->buf + (o * k + f * j->ld) * size,
                                     (char *)j->gy->data + (channel * j->c.To + w->t + f) * frame * size, w->q,
                                     f + 1 < w->frames ? j->ld : w->places);
            }
        dar_tile_pack_b_nk(t, type, w->buf, k, k, lanes, w->b + q / t->nr * dar_tile_bytes_b(t, k));
    }
}

/* ---------------------------------------------------------------- tasks */

/* Ask for one channel of what a step reads, of gy or behind them of x: memory would stand idle during the product, and
 * wait for every new channel afterwards. */
static void ahead(const struct job *j, const struct task *w, size_t piece)
{
    const dar_conv_grid *g = &j->grid;
    bool of_gy = piece < w->n;
    size_t frames = w->frames, row = w->q / g->pitch, rows = dar_blocks(j->places + (of_gy ? 0 : g->around), g->pitch);
    size_t H = g->Ho, W = g->Wo;
    dar_dtype type = j->gy->dtype;
    const char *from;

    if (of_gy) {
        from = (char *)j->gy->data +
               ((w->batch * j->c.Cout + w->o0 + piece) * j->c.To + w->t) * H * W * dar_dtype_size(type);
    } else {
        int64_t t = (int64_t)(w->t * j->c.stride_t + j->c.kt) - 1 - j->c.front;
        from = dar_clip_frame(&j->x, w->batch, w->c0 + piece - w->n, t, &type);
        H = g->H, W = g->W;
        row *= g->stride, rows *= g->stride;
    }
    if (!from || row >= H) return;
    if (frames > 1) rows = H * frames;
    else rows = dar_least(rows, H - row);
    size_t size = dar_dtype_size(type) * W;
    dar_row_ahead(from + row * size, rows * size);
}

/* Meanwhile the next step is asked for; NULL: there is none. */
static void multiply(const struct job *j, const struct task *w, size_t k, bool add, const struct task *next)
{
    const dar_tile *t = j->tile;
    size_t size = dar_dtype_size(j->sum), units = dar_tile_units(t, k), stripe = dar_tile_bytes_b(t, k);
    size_t calls = dar_blocks(w->n, t->nr) * dar_blocks(w->m, t->mr), call = 0, piece = 0;
    size_t pieces = next ? w->n + w->channels : 0;

    for (size_t q = 0; q < w->n; q += t->nr)
        for (size_t i = 0; i < w->m; i += t->mr) {
            for (call++; piece * calls < call * pieces; piece++) ahead(j, next, piece);
            t->mm_rows(units, w->x, w->rows + i, w->b + q / t->nr * stripe, t->nr, w->c + (i * j->n + q) * size, j->n,
                       dar_least(t->mr, w->m - i), dar_least(t->nr, w->n - q), add ? DAR_PUT_ADD : DAR_PUT);
        }
}

/* Rows k0.., columns o0.. of gw^T at c to gw, a line of c at a time. */
static void store(const struct job *j, size_t k0, size_t m, size_t o0, size_t n, const char *c, char *buf, bool add)
{
    size_t ld = m + LINE, size = dar_dtype_size(j->sum); /* not a power of two: rows would share their place */

    for (size_t o = 0; o < n; o += LINE) {
        size_t lines = dar_least(LINE, n - o);
        dar_kern_for(j->sum)->transpose[j->sum](m, lines, c + o * size, j->n, buf, ld);
        for (size_t u = 0; u < lines; u++)
            dar_row_put(j->sum, buf + u * ld * size, j->gw->dtype,
                        (char *)j->gw->data + ((o0 + o + u) * j->K + k0) * dar_dtype_size(j->gw->dtype), m,
                        add ? DAR_PUT_ADD : DAR_PUT);
    }
}

/* What c holds goes to the chunk's sum, or to gw. */
static void flush(const struct job *j, const struct task *w, char *part, bool again)
{
    size_t n = w->m * j->n, size = dar_dtype_size(j->sum);

    if (!part) store(j, w->k0, w->m, w->o0, w->n, w->c, w->buf, j->add || again);
    else if (!again) memcpy(part, w->c, n * size);
    else dar_kern_for(j->sum)->add(n, part, w->c, part);
}

static struct task task_of(const struct job *j, size_t block, int thread)
{
    struct task w = { .k0 = block / j->across * j->m, .o0 = block % j->across * j->n };

    w.m = dar_least(j->m, j->K - w.k0);
    w.n = dar_least(j->n, j->c.Cout - w.o0);
    w.c0 = w.k0 / j->taps;
    w.channels = (w.k0 + w.m - 1) / j->taps + 1 - w.c0;
    w.at = (size_t *)(void *)(j->own + (size_t)thread * own_bytes(j));
    w.rows = w.at + j->taps;
    w.x = (char *)w.at + j->rows_bytes;
    w.b = w.x + j->x_bytes;
    w.c = w.b + j->b_bytes;
    w.buf = w.c + j->block_bytes;
    return w;
}

static void locate(const struct job *j, struct task *w, size_t step)
{
    w->batch = step / j->groups / j->runs;
    w->q = step / j->groups % j->runs * j->places;
    w->t = step % j->groups * j->frames;
    w->places = dar_least(j->places, j->grid.plane - w->q);
    w->frames = dar_least(j->frames, j->c.To - w->t);
}

static void task(void *ctx, size_t i, int thread)
{
    const struct job *j = ctx;
    size_t blocks = j->down * j->across, chunk = i / blocks, end = dar_least((chunk + 1) * j->chunk, j->steps);
    struct task w = task_of(j, i % blocks, thread);
    char *part = j->chunks > 1 ? j->parts + i * j->block_bytes : NULL;
    bool again = false;

    for (size_t s = chunk * j->chunk, summed = 0; s < end; s++) {
        locate(j, &w, s);
        if (w.t == 0) w.known = 0;
        size_t k = (w.frames - 1) * j->ld + w.places;
        read_x(j, &w);
        place_rows(j, &w);
        read_gy(j, &w, k);
        struct task next = w;
        if (s + 1 < end) locate(j, &next, s + 1);
        multiply(j, &w, k, summed > 0, s + 1 < end ? &next : NULL);
        summed += k;
        if (summed < FLUSH && s + 1 < end) continue;
        flush(j, &w, part, again);
        again = true;
        summed = 0;
    }
}

/* Rows of a block in all chunks. */
static void add_up(void *ctx, size_t i, int thread)
{
    const struct job *j = ctx;
    size_t turns = dar_blocks(j->m, TURN), blocks = j->down * j->across, first = i % turns * TURN;
    struct task w = task_of(j, i / turns, thread);
    size_t size = dar_dtype_size(j->sum), at = (i / turns) * j->block_bytes + first * j->n * size;

    if (first >= w.m) return;
    w.m = dar_least(TURN, w.m - first);
    memcpy(w.c, j->parts + at, w.m * j->n * size);
    for (size_t c = 1; c < j->chunks; c++)
        dar_kern_for(j->sum)->add(w.m * j->n, w.c, j->parts + c * blocks * j->block_bytes + at, w.c);
    store(j, w.k0 + first, w.m, w.o0, w.n, w.c, w.buf, j->add);
}

void dar_conv_back_w(const dar_conv *c, const dar_tensor *x, const dar_tensor *history, dar_dtype w_type,
                     const dar_tensor *gy, const dar_tensor *gw, bool add, void *scratch)
{
    struct job j = job_of(c, x->dtype, w_type);
    j.x = (dar_clip){ x, history, c->Cin, c->T, c->past, c->H * c->W };
    j.gy = gy, j.gw = gw, j.add = add;
    j.parts = scratch;
    j.own = j.parts + parts_bytes(&j);
    dar_parallel(j.down * j.across * j.chunks, task, &j);
    if (j.chunks > 1) dar_parallel(j.down * j.across * dar_blocks(j.m, TURN), add_up, &j);
}
