/* conv_fold.c: how the folded convolution is cut.
 *
 *   tasks      about as many output pixels of one frame as make the kh - 1 rows above and below a third of what is read
 *   blocks     frames of the kernel, then channels of x: packed, with z they fit the second-level cache
 *   tiles      for 64 pixels the rows of the kernel, then the rows of z: z and x stay in the first-level cache */
#include "lib/conv_fold.h"

#include <string.h>

#include "lib/kern.h"
#include "lib/thread.h"
#include "lib/tile.h"

#define MOST_ROWS 128                 /* of z */
#define PIXELS    256                 /* least output pixels per task */
#define B_BYTES   ((size_t)512 << 10) /* of packed x */
#define Z_BYTES   ((size_t)256 << 10)
#define LEAST_K   16 /* channels in a block */
#define MOST_K    256

struct job {
    const dar_conv *c;
    const dar_tensor *x, *w, *b, *past, *y;
    const dar_tile *tile;
    dar_dtype operand, sum;
    size_t taps, rows, plane, pieces; /* kt kh, kw Cout, pixels of an output frame, tasks of it */
    size_t n, depth;                  /* pixels of a task, channels of a block */
    size_t ldz, ldb;                  /* distance of rows of z [elements], of packed x [units] */
    size_t stripe;                    /* bytes of a stripe of w over all channels */
    size_t a_bytes, b_bytes, z_bytes; /* a: all of w, shared; b, z: of one thread */
    char *scratch;
};

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

static size_t round_up(size_t n, size_t unit)
{
    return blocks_of(n, unit) * unit;
}

bool dar_conv_fold_fits(const dar_conv *c)
{
    bool same = c->stride == 1 && c->W == c->Wo && c->left >= 0 && c->left < (int64_t)c->kw;
    return same && c->Cin > 0 && c->Cout > 0 && c->kw * c->Cout <= MOST_ROWS;
}

static struct job job_of(const dar_conv *c, dar_dtype x, dar_dtype w)
{
    static const dar_dtype of[] = { [DAR_TILE_F64] = DAR_F64, [DAR_TILE_F32] = DAR_F32, [DAR_TILE_BF16] = DAR_BF16 };
    dar_tile_kind kind = dar_tile_kind_for(x == DAR_BF16 && w != DAR_BF16 ? DAR_F32 : x);
    struct job j = { .c = c, .operand = of[kind], .sum = dar_compute_type(x), .taps = c->kt * c->kh };
    size_t around = (c->kh - 1) * c->W, line;

    j.rows = c->kw * c->Cout;
    j.plane = c->Ho * c->Wo;
    j.n = least(most(2 * around, PIXELS), most(Z_BYTES / (j.rows * dar_dtype_size(j.sum)), PIXELS));
    const dar_tile *t = j.tile = dar_tile_fit(kind, j.rows, least(j.plane + c->kw - 1, PIXELS));
    j.ldz = round_up(blocks_of(j.plane, most(blocks_of(j.plane, j.n), 1)) + c->kw - 1, t->nr);
    j.n = j.ldz - (c->kw - 1);
    j.pieces = most(blocks_of(j.plane, j.n), 1);
    line = DAR_ALIGN / t->unit_bytes;
    j.ldb = (blocks_of(around + j.ldz, line) | 1) * line; /* odd: rows do not share their place in the cache */
    j.depth = least(most(B_BYTES / (j.ldb * t->unit_bytes) * t->unit, LEAST_K), MOST_K);
    j.depth = round_up(blocks_of(c->Cin, blocks_of(c->Cin, j.depth)), t->unit);
    j.stripe = dar_tile_bytes_a(t, c->Cin);
    j.a_bytes = round_up(j.taps * blocks_of(j.rows, t->mr) * j.stripe, DAR_ALIGN);
    j.b_bytes = (dar_tile_units(t, j.depth) + 1) * j.ldb * t->unit_bytes; /* and what a row leaves behind it */
    j.b_bytes = round_up(most(j.b_bytes, t->mr * j.depth * dar_dtype_size(w)), DAR_ALIGN);
    j.z_bytes = round_up(j.rows * j.ldz * dar_dtype_size(j.sum), DAR_ALIGN);
    return j;
}

size_t dar_conv_fold_scratch(const dar_conv *c, dar_dtype x, dar_dtype w, int threads)
{
    struct job j = job_of(c, x, w);
    return j.a_bytes + (size_t)threads * (j.b_bytes + j.z_bytes);
}

static char *own(const struct job *j, int thread)
{
    return j->scratch + j->a_bytes + (size_t)thread * (j->b_bytes + j->z_bytes);
}

/* Stripes of w, for each tap (frame and row of the kernel) by mr rows of z: row o kw + i, column c: w[o, c, tap, i]. */
static void pack_weights(void *ctx, size_t i, int thread)
{
    const struct job *j = ctx;
    const dar_tile *t = j->tile;
    size_t stripes = blocks_of(j->rows, t->mr), tap = i / stripes, r0 = i % stripes * t->mr, kw = j->c->kw;
    size_t m = least(t->mr, j->rows - r0), size = dar_dtype_size(j->w->dtype), step = j->taps * kw * size;
    char *buf = own(j, thread);

    for (size_t c = 0; c < j->c->Cin; c += j->depth) {
        size_t k = least(j->depth, j->c->Cin - c);
        for (size_t r = 0; r < m; r++) {
            size_t o = (r0 + r) / kw;
            const char *from = (char *)j->w->data + (o * j->c->Cin + c) * step + (tap * kw + (r0 + r) % kw) * size;
            for (size_t u = 0; u < k; u++) memcpy(buf + (r * j->depth + u) * size, from + u * step, size);
        }
        dar_tile_pack_a_mk(t, j->w->dtype, buf, j->depth, m, k,
                           j->scratch + i * j->stripe + c / t->unit * t->mr * t->unit_bytes);
    }
}

/* Channels [c, c + k) of a frame of x or of history, ldb pixels from `at`; zero outside the frame, and where there is
 * no frame. */
static void pack_pixels(const struct job *j, size_t batch, int64_t frame, size_t c, size_t k, int64_t at, char *b)
{
    const dar_tensor *of = frame < 0 ? j->past : j->x;
    size_t frames = frame < 0 ? j->c->past : j->c->T, plane = j->c->H * j->c->W;
    size_t low = at < 0 ? least((size_t)-at, j->ldb) : 0;
    size_t high = at < (int64_t)plane ? least(j->ldb, (size_t)((int64_t)plane - at)) : 0, unit = j->tile->unit_bytes;

    if (frame < 0) frame += (int64_t)frames;
    if (frame < 0 || (size_t)frame >= frames || !of->data || low >= high) {
        memset(b, 0, dar_tile_units(j->tile, k) * j->ldb * unit);
        return;
    }
    size_t from = ((batch * j->c->Cin + c) * frames + (size_t)frame) * plane + (size_t)(at + (int64_t)low);
    memset(b, 0, low * unit); /* in the other rows it is what remains of the row before */
    dar_tile_pack_b_wide(j->tile, of->dtype, (char *)of->data + from * dar_dtype_size(of->dtype), frames * plane, k,
                         high - low, j->ldb, b + low * unit);
}

/* z (+)= w x for the rows of the kernel in one frame, over channels [c, c + k). */
static void multiply(const struct job *j, size_t kt, size_t c, size_t k, size_t n, const char *b, char *z, bool add)
{
    const dar_tile *t = j->tile;
    size_t size = dar_dtype_size(j->sum), stripes = blocks_of(j->rows, t->mr);

    for (size_t q = 0; q < n; q += t->nr)
        for (size_t y = 0; y < j->c->kh; y++) {
            const char *a =
                j->scratch + (kt * j->c->kh + y) * stripes * j->stripe + c / t->unit * t->mr * t->unit_bytes;
            for (size_t i = 0; i < j->rows; i += t->mr, a += j->stripe)
                t->mm(dar_tile_units(t, k), a, 1, t->mr, b + (y * j->c->W + q) * t->unit_bytes, j->ldb,
                      z + (i * j->ldz + q) * size, j->ldz, least(t->mr, j->rows - i), least(t->nr, n - q), add || y);
        }
}

/* z: the kw rows of channel o.  Their sum and b, n pixels from pixel q of a frame, in the row that is not shifted. */
static char *unfold(const struct job *j, size_t o, size_t q, size_t n, char *z)
{
    const dar_kern *k = dar_kern_for(j->sum);
    size_t size = dar_dtype_size(j->sum), W = j->c->W, left = (size_t)j->c->left;
    double bias = j->b && j->b->data ? dar_dtype_get(j->b->dtype, j->b->data, o) : 0;
    char *sum = z + left * (j->ldz + 1) * size;

    k->offset(n, bias, sum, sum);
    for (size_t x = 0; x < j->c->kw; x++, z += j->ldz * size) {
        if (x == left) continue;
        size_t first = x < left ? left - x : 0, end = x > left ? W - least(W, x - left) : W; /* columns that read x */
        for (size_t i = 0, length; i < n; i += length) {                                     /* one row of the frame */
            size_t w = (q + i) % W;
            length = least(W - w, n - i);
            size_t low = most(first, w), high = least(end, w + length), at = i + low - w;
            if (low < high) k->add(high - low, sum + at * size, z + (at + x) * size, sum + at * size);
        }
    }
    return sum;
}

static void task(void *ctx, size_t i, int thread)
{
    const struct job *j = ctx;
    const dar_conv *c = j->c;
    size_t q0 = i % j->pieces * j->n, frame = i / j->pieces, t = frame % c->To, batch = frame / c->To;
    size_t n = least(j->n, j->plane - q0), size = dar_dtype_size(j->sum);
    char *b = own(j, thread), *z = b + j->b_bytes;
    int64_t at = (int64_t)q0 - c->left - c->top * (int64_t)c->W;

    for (size_t kt = 0; kt < c->kt; kt++)
        for (size_t k = 0; k < c->Cin; k += j->depth) {
            size_t depth = least(j->depth, c->Cin - k);
            pack_pixels(j, batch, (int64_t)(t * c->stride_t + kt) - c->front, k, depth, at, b);
            multiply(j, kt, k, depth, n + c->kw - 1, b, z, kt || k);
        }
    for (size_t o = 0; o < c->Cout; o++) {
        size_t to = ((batch * c->Cout + o) * c->To + t) * j->plane + q0;
        dar_row_put(j->sum, unfold(j, o, q0, n, z + o * c->kw * j->ldz * size), j->y->dtype,
                    (char *)j->y->data + to * dar_dtype_size(j->y->dtype), n, DAR_PUT);
    }
}

void dar_conv_fold_forward(const dar_conv *c, const dar_tensor *x, const dar_tensor *w, const dar_tensor *b,
                           const dar_tensor *history, const dar_tensor *y, void *scratch)
{
    struct job j = job_of(c, x->dtype, w->dtype);
    j.x = x, j.w = w, j.b = b, j.past = history, j.y = y;
    j.scratch = scratch;
    if (!c->B || !c->To || !j.plane) return;
    dar_parallel(j.taps * blocks_of(j.rows, j.tile->mr), pack_weights, &j);
    dar_parallel(c->B * c->To * j.pieces, task, &j);
}
