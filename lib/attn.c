/* attn.c: the blocks of attention: how work is cut, packed and multiplied.  Weights are made by lib/kern_attn.h.
 *
 * Forward.  A task is a range of queries of one head.  For each block of keys, K and V are packed once and meet every
 * block of queries of the range: S = Q K^T, P = weights(S), O += P V.
 *
 * Backward.  A task is a range of keys of one head (where gk or gv is wanted) or a range of queries (where not), so
 * that no two tasks add to the same gk, gv.  Blocks are transposed, keys are rows: with gy' = gy / sum and dot = gy' .
 * y per query,
 *
 *   S = K Q^T, P = 2^(c S - max)      dV += P gy'     dK += dS Q     dQ += dS^T K
 *   dP = V gy'^T, dS = P (dP - dot)
 *
 * Each range of keys but the first sums dQ in a buffer of its own; they are added in order at the end. */
#include "lib/attn.h"

#include <math.h>
#include <string.h>

#include "lib/kern.h"
#include "lib/kern_attn.h"
#include "lib/size.h"
#include "lib/status.h"
#include "lib/thread.h"
#include "lib/tile.h"

#define LOG2_E 1.4426950408889634
#define TASKS  12  /* wanted of few heads, so that many processors have work */
#define DEPTH  256 /* units of k that a product takes at a time: a stripe stays in the first-level cache */
#define EDGE   16  /* columns beside a block, so that its rows lie in different sets of the caches */

/* What both directions share. */
struct job {
    const dar_attn *a;
    const dar_kern_attn *kern;
    const dar_kern *rows;
    dar_tile_kind kind;
    dar_dtype real; /* type of numbers that are not operands */
    size_t real_size, operand_size;
    size_t B, A, E, D, Nq, Nk;
    double c;              /* scale in units of 2^ */
    size_t ranges, range;  /* of queries */
    size_t splits, split;  /* of keys */
    const dar_tile *inner; /* for products over E, as wide as a block */
    const dar_tile *outer; /* for products that are E wide */
    size_t per_thread;     /* bytes */
};

/* Cut n in about `parts` ranges of whole blocks, each between least and most. */
static size_t range_of(size_t n, size_t parts, size_t block, size_t least, size_t most)
{
    size_t r = dar_round_up(dar_blocks(n, parts), block);
    return r < least ? least : r > most ? most : r;
}

static struct job job_of(const dar_attn *a, size_t block)
{
    struct job j = { .a = a };
    bool wide = a->q.dtype == DAR_F64,
         half = a->q.dtype == DAR_BF16 && a->k.dtype == DAR_BF16 && a->v.dtype == DAR_BF16;

    DAR_ASSERT((a->k.dtype == DAR_F64) == wide && (a->v.dtype == DAR_F64) == wide && (a->y.dtype == DAR_F64) == wide,
               "attention: f64 beside other types");
    j.kind = dar_tile_kind_for(half ? DAR_BF16 : wide ? DAR_F64 : DAR_F32);
    j.kern = dar_kern_attn_for(j.kind);
    j.real = wide ? DAR_F64 : DAR_F32;
    j.rows = dar_kern_for(j.real);
    j.real_size = dar_dtype_size(j.real);
    j.operand_size = j.kind == DAR_TILE_BF16 ? 2 : j.real_size;
    j.B = (size_t)a->q.shape.d[0];
    j.Nq = (size_t)a->q.shape.d[1];
    j.D = (size_t)a->q.shape.d[2];
    j.Nk = (size_t)a->k.shape.d[1];
    j.A = a->heads;
    j.E = j.D / j.A;
    j.c = a->scale * LOG2_E;
    j.inner = dar_tile_for(j.kind, block);
    j.outer = dar_tile_for(j.kind, j.E);
    return j;
}

/* ---------------------------------------------------------------- addresses */

/* Hand out pieces of one thread's scratch; with base NULL only count. */
struct carve {
    char *base;
    size_t used;
};

static void *take(struct carve *c, size_t bytes)
{
    size_t at = c->used;
    c->used = dar_add_size(at, dar_round_up(bytes, DAR_ALIGN));
    return c->base ? c->base + at : NULL;
}

static size_t bytes_a(const dar_tile *t, size_t m, size_t k)
{
    return dar_blocks(m, t->mr) * dar_tile_bytes_a(t, k);
}

static size_t bytes_b(const dar_tile *t, size_t n, size_t k)
{
    return dar_blocks(n, t->nr) * dar_tile_bytes_b(t, k);
}

static char *row_at(const dar_tensor *x, size_t row, size_t col)
{
    return (char *)x->data + (row * (size_t)x->shape.d[2] + col) * dar_dtype_size(x->dtype);
}

/* Ask for n rows of one head from row `first` on, of those before `end`. */
static void ahead(const struct job *j, const dar_tensor *x, size_t first, size_t n, size_t end, size_t col)
{
    size_t size = dar_dtype_size(x->dtype);
    if (first + n > end) n = first < end ? end - first : 0;
    for (const char *p = row_at(x, first, col); n; n--, p += j->D * size) dar_row_ahead(p, j->E * size);
}

/* ---------------------------------------------------------------- packing and products */

/* Rows of src along stripes, its columns along k: the left operand of src x, or the right one of x src^T. */
static void pack_rows(const dar_tile *t, bool left, dar_dtype type, const void *src, size_t ld, size_t rows,
                      size_t cols, char *dst)
{
    size_t wide = left ? t->mr : t->nr;
    for (size_t i = 0; i < rows; i += wide) {
        const char *from = (const char *)src + i * ld * dar_dtype_size(type);
        size_t n = dar_least(wide, rows - i);
        if (left) dar_tile_pack_a_mk(t, type, from, ld, n, cols, dst);
        else dar_tile_pack_b_nk(t, type, from, ld, cols, n, dst);
        dst += left ? dar_tile_bytes_a(t, cols) : dar_tile_bytes_b(t, cols);
    }
}

/* Columns of src along stripes, its rows along k: the right operand of x src. */
static void pack_cols(const dar_tile *t, dar_dtype type, const void *src, size_t ld, size_t rows, size_t cols,
                      char *dst)
{
    for (size_t j = 0; j < cols; j += t->nr) {
        const char *from = (const char *)src + j * dar_dtype_size(type);
        dar_tile_pack_b_kn(t, type, from, ld, rows, dar_least(t->nr, cols - j), dst);
        dst += dar_tile_bytes_b(t, rows);
    }
}

/* A left operand: unit (i, k) at row i + k k, stripes of mr rows `stripe` bytes apart. */
struct left {
    const void *at;
    size_t row, k, stripe;
};

static struct left packed(const dar_tile *t, const void *at, size_t k)
{
    return (struct left){ at, 1, t->mr, dar_tile_bytes_a(t, k) };
}

/* C[m, n] (+)= A B over k elements; B is packed. */
static void product(const dar_tile *t, size_t m, size_t n, size_t k, struct left a, const void *b, void *c, size_t ldc,
                    bool add)
{
    size_t units = dar_tile_units(t, k), size = t->unit_bytes, c_size = t->kind == DAR_TILE_F64 ? 8 : 4;

    for (size_t k0 = 0; k0 < units; k0 += DEPTH) {
        size_t kn = dar_least(DEPTH, units - k0);
        for (size_t j = 0; j < n; j += t->nr) {
            const char *bj = (const char *)b + (j * units + k0 * t->nr) * size;
            for (size_t i = 0; i < m; i += t->mr)
                t->mm(kn, (const char *)a.at + i / t->mr * a.stripe + k0 * a.k * size, a.row, a.k, bj, t->nr,
                      (char *)c + (i * ldc + j) * c_size, ldc, dar_least(t->mr, m - i), dar_least(t->nr, n - j),
                      add || k0);
        }
    }
}

/* Log-weights of keys [k0, k0 + n) of sample b, in units of 2^. */
static const void *log_weights(const struct job *j, size_t b, size_t k0, size_t n, void *to)
{
    const dar_tensor *lw = &j->a->lw;
    if (!lw->data) return NULL;
    size_t first = (lw->shape.n == 2 ? b * j->Nk : 0) + k0;
    for (size_t i = 0; i < n; i++)
        dar_dtype_set(j->real, to, i, dar_dtype_get(lw->dtype, lw->data, first + i) * LOG2_E);
    return to;
}

/* ---------------------------------------------------------------- forward */

#define ROWS 24  /* queries of a block: its products stay in the first-level cache */
#define KEYS 256 /* keys of a block */

struct forward_scratch {
    char *q, *k, *v; /* packed: the range's blocks of queries; a block of keys */
    char *o;         /* [range, E] */
    char *max, *sum; /* [range], [range, lanes] */
    char *s, *p;     /* [ROWS, KEYS] */
    size_t ld;       /* of both */
    void *lw, *row;
};

static struct forward_scratch forward_carve(const struct job *j, struct carve *c)
{
    struct forward_scratch f = { .ld = KEYS + EDGE };
    size_t rows = dar_least(j->range, dar_round_up(j->Nq, ROWS)), keys = dar_least(KEYS, j->Nk);

    f.q = take(c, rows / ROWS * bytes_a(j->inner, ROWS, j->E));
    f.k = take(c, bytes_b(j->inner, keys, j->E));
    f.v = take(c, bytes_b(j->outer, j->E, keys));
    f.o = take(c, rows * j->E * j->real_size);
    f.max = take(c, rows * j->real_size);
    f.sum = take(c, rows * DAR_ATTN_LANES * j->real_size);
    f.s = take(c, ROWS * f.ld * j->real_size);
    f.p = j->operand_size == j->real_size ? f.s : take(c, ROWS * f.ld * j->operand_size);
    f.lw = take(c, KEYS * j->real_size);
    f.row = take(c, j->E * j->real_size);
    return f;
}

static struct job forward_job(const dar_attn *a)
{
    struct job j = job_of(a, KEYS);
    struct carve c = { 0 };
    size_t heads = j.B * j.A;

    j.range = range_of(j.Nq, dar_blocks(TASKS, heads ? heads : 1), ROWS, 8 * ROWS, 32 * ROWS);
    j.ranges = dar_blocks(j.Nq, j.range);
    forward_carve(&j, &c);
    j.per_thread = c.used;
    return j;
}

/* A block of queries against the packed block of keys. */
static void forward_block(const struct job *j, const struct forward_scratch *f, size_t i0, size_t m, size_t n,
                          const void *lw, bool first)
{
    size_t unit = j->outer->unit;
    char *o = f->o + i0 * j->E * j->real_size;

    product(j->inner, m, n, j->E, packed(j->inner, f->q + i0 / ROWS * bytes_a(j->inner, ROWS, j->E), j->E), f->k, f->s,
            f->ld, false);
    j->kern->soft(&(dar_attn_soft){
        .m = m,
        .n = n,
        .s = f->s,
        .ld = f->ld,
        .c = j->c,
        .lw = lw,
        .first = first,
        .p = f->p,
        .ldp = f->ld,
        .max = f->max + i0 * j->real_size,
        .sum = f->sum + i0 * DAR_ATTN_LANES * j->real_size,
        .o = o,
        .ldo = j->E,
        .E = j->E,
    });
    struct left p = { f->p, f->ld / unit, 1, j->outer->mr * f->ld * j->operand_size };
    product(j->outer, m, j->E, n, p, f->v, o, j->E, !first);
}

/* Divide m rows from i0 of the range by their sums, store y and the statistics. */
static void forward_finish(const struct job *j, const struct forward_scratch *f, size_t head, size_t q0, size_t i0,
                           size_t m)
{
    const dar_attn *a = j->a;
    size_t b = head / j->A, h = head % j->A;

    for (size_t i = i0; i < i0 + m; i++) {
        double sum = j->rows->sum(DAR_ATTN_LANES, f->sum + i * DAR_ATTN_LANES * j->real_size);
        char *y = row_at(&a->y, b * j->Nq + q0 + i, h * j->E);
        void *to = dar_row_out(j->real, a->y.dtype, y, DAR_PUT, f->row);
        j->rows->scale(j->E, sum == 0 ? 0 : 1 / sum, f->o + i * j->E * j->real_size, to);
        dar_row_put(j->real, to, a->y.dtype, y, j->E, DAR_PUT);
        if (!a->stats.data) continue;
        size_t at = (head * j->Nq + q0 + i) * 2;
        dar_dtype_set(j->real, a->stats.data, at, sum == 0 ? 0 : dar_dtype_get(j->real, f->max, i));
        dar_dtype_set(j->real, a->stats.data, at + 1, sum);
    }
}

static void forward_task(void *ctx, size_t task, int thread)
{
    const struct job *j = ctx;
    const dar_attn *a = j->a;
    struct carve c = { (char *)a->scratch + (size_t)thread * j->per_thread, 0 };
    struct forward_scratch f = forward_carve(j, &c);
    size_t head = task / j->ranges, b = head / j->A, col = head % j->A * j->E;
    size_t q0 = task % j->ranges * j->range, rows = dar_least(j->range, j->Nq - q0);
    size_t q_row = b * j->Nq + q0, k_row = b * j->Nk;

    for (size_t k0 = 0; k0 < j->Nk; k0 += KEYS) {
        size_t n = dar_least(KEYS, j->Nk - k0);
        pack_rows(j->inner, false, a->k.dtype, row_at(&a->k, k_row + k0, col), j->D, n, j->E, f.k);
        pack_cols(j->outer, a->v.dtype, row_at(&a->v, k_row + k0, col), j->D, n, j->E, f.v);
        const void *lw = log_weights(j, b, k0, n, f.lw);
        for (size_t i = 0; i < rows; i += ROWS) {
            size_t m = dar_least(ROWS, rows - i);
            if (!k0) {
                pack_rows(j->inner, true, a->q.dtype, row_at(&a->q, q_row + i, col), j->D, m, j->E,
                          f.q + i / ROWS * bytes_a(j->inner, ROWS, j->E));
                ahead(j, &a->q, q_row + i + m, ROWS, q_row + rows, col);
            }
            size_t part = k_row + k0 + n + i * KEYS / rows;
            ahead(j, &a->k, part, KEYS * ROWS / rows + 1, k_row + j->Nk, col);
            ahead(j, &a->v, part, KEYS * ROWS / rows + 1, k_row + j->Nk, col);
            bool last = k0 + n == j->Nk;
            if (last) ahead(j, &a->y, q_row + i, m, q_row + rows, col);
            forward_block(j, &f, i, m, n, lw, !k0);
            if (last) forward_finish(j, &f, head, q0, i, m);
        }
    }
}

void dar_attn_forward(const dar_attn *a)
{
    struct job j = forward_job(a);
    if (!j.Nk) {
        dar_tensor_fill(&a->y, 0);
        if (a->stats.data) dar_tensor_fill(&a->stats, 0);
        return;
    }
    dar_parallel(j.B * j.A * j.ranges, forward_task, &j);
}

/* ---------------------------------------------------------------- backward */

#define QUERIES    96 /* queries of a block: whole tiles of 6, 8 or 12 rows */
#define ROWS_BACK  96 /* keys of a block */
#define CHUNK_SIZE (1 << 18)

/* Keys that a task packs, and whose gradients it sums, at a time. */
static size_t chunk_of(const struct job *j)
{
    size_t n = dar_round_up(CHUNK_SIZE / j->E, ROWS_BACK);
    return dar_least(n < 4 * ROWS_BACK ? 4 * ROWS_BACK : n, dar_round_up(j->split, ROWS_BACK));
}

struct backward_scratch {
    char *k_rows, *v_rows, *k_cols;            /* packed: a chunk of keys, block by block */
    char *dk, *dv;                             /* [chunk, E] */
    char *q_rows, *q_cols, *gy_rows, *gy_cols; /* packed: a block of queries */
    char *gy, *dq;                             /* [QUERIES, E]; gy divided by the sums */
    char *max, *dot;                           /* [QUERIES] */
    char *s, *dp, *p, *ds, *pairs;             /* [ROWS_BACK, QUERIES] */
    size_t ld;                                 /* of these */
    char *lw, *row;
};

static struct backward_scratch backward_carve(const struct job *j, struct carve *c)
{
    struct backward_scratch f = { .ld = QUERIES + EDGE };
    size_t chunk = chunk_of(j), blocks = chunk / ROWS_BACK, block = ROWS_BACK * f.ld;
    bool same = j->operand_size == j->real_size;

    f.k_rows = take(c, blocks * bytes_a(j->inner, ROWS_BACK, j->E));
    f.v_rows = take(c, blocks * bytes_a(j->inner, ROWS_BACK, j->E));
    f.k_cols = take(c, blocks * bytes_b(j->outer, j->E, ROWS_BACK));
    f.dk = take(c, chunk * j->E * j->real_size);
    f.dv = take(c, chunk * j->E * j->real_size);
    f.q_rows = take(c, bytes_b(j->inner, QUERIES, j->E));
    f.gy_rows = take(c, bytes_b(j->inner, QUERIES, j->E));
    f.q_cols = take(c, bytes_b(j->outer, j->E, QUERIES));
    f.gy_cols = take(c, bytes_b(j->outer, j->E, QUERIES));
    f.gy = take(c, QUERIES * j->E * j->real_size);
    f.dq = take(c, QUERIES * j->E * j->real_size);
    f.max = take(c, QUERIES * j->real_size);
    f.dot = take(c, QUERIES * j->real_size);
    f.s = take(c, block * j->real_size);
    f.dp = take(c, block * j->real_size);
    f.p = same ? f.s : take(c, block * j->operand_size);
    f.ds = same ? f.dp : take(c, block * j->operand_size);
    f.pairs = same ? NULL : take(c, block * j->operand_size);
    f.lw = take(c, chunk * j->real_size);
    f.row = take(c, j->E * j->real_size);
    return f;
}

static struct job backward_job(const dar_attn *a)
{
    struct job j = job_of(a, QUERIES);
    struct carve c = { 0 };
    size_t heads = j.B * j.A, parts = dar_blocks(TASKS, heads ? heads : 1);
    bool keys = a->gk.data || a->gv.data;

    j.range = keys ? dar_round_up(j.Nq, QUERIES) : range_of(j.Nq, parts, QUERIES, 4 * QUERIES, 32 * QUERIES);
    j.split = keys ? range_of(j.Nk, parts, ROWS_BACK, 4 * ROWS_BACK, SIZE_MAX) : dar_round_up(j.Nk, ROWS_BACK);
    j.ranges = j.range ? dar_blocks(j.Nq, j.range) : 0;
    if (keys) j.ranges = 1; /* no query: their gradients are 0 */
    j.splits = j.split ? dar_blocks(j.Nk, j.split) : 0;
    backward_carve(&j, &c);
    j.per_thread = c.used;
    return j;
}

size_t dar_attn_scratch(const dar_attn *a, bool backward)
{
    struct job j = backward ? backward_job(a) : forward_job(a);
    size_t bytes = dar_mul_size(j.per_thread, (size_t)a->threads);
    if (backward && a->gq.data && j.splits > 1)
        bytes = dar_add_size(bytes, dar_mul_size(j.splits - 1, dar_tensor_bytes(&a->gq)));
    return bytes;
}

/* Where range `split` of keys sums dQ. */
static dar_tensor dq_of(const struct job *j, size_t split)
{
    dar_tensor t = j->a->gq;
    size_t first = (size_t)j->a->threads * j->per_thread;
    if (split) t.data = (char *)j->a->scratch + first + (split - 1) * dar_tensor_bytes(&t);
    return t;
}

/* Pack a chunk of keys; clear its gradients. */
static void load_keys(const struct job *j, const struct backward_scratch *f, size_t row, size_t col, size_t n)
{
    const dar_attn *a = j->a;
    for (size_t i = 0; i < n; i += ROWS_BACK) {
        size_t m = dar_least(ROWS_BACK, n - i), block = i / ROWS_BACK;
        pack_rows(j->inner, true, a->k.dtype, row_at(&a->k, row + i, col), j->D, m, j->E,
                  f->k_rows + block * bytes_a(j->inner, ROWS_BACK, j->E));
        if (a->gq.data || a->gk.data)
            pack_rows(j->inner, true, a->v.dtype, row_at(&a->v, row + i, col), j->D, m, j->E,
                      f->v_rows + block * bytes_a(j->inner, ROWS_BACK, j->E));
        if (a->gq.data)
            pack_cols(j->outer, a->k.dtype, row_at(&a->k, row + i, col), j->D, m, j->E,
                      f->k_cols + block * bytes_b(j->outer, j->E, ROWS_BACK));
    }
    if (a->gk.data) memset(f->dk, 0, n * j->E * j->real_size);
    if (a->gv.data) memset(f->dv, 0, n * j->E * j->real_size);
}

/* Pack a block of queries and their gy / sum. */
static void load_queries(const struct job *j, const struct backward_scratch *f, size_t head, size_t q0, size_t n)
{
    const dar_attn *a = j->a;
    size_t row = head / j->A * j->Nq + q0, col = head % j->A * j->E;

    for (size_t i = 0; i < n; i++) {
        size_t at = (head * j->Nq + q0 + i) * 2;
        double sum = dar_dtype_get(j->real, a->stats.data, at + 1);
        const void *y = dar_row_get(j->real, a->y.dtype, row_at(&a->y, row + i, col), j->E, f->row);
        char *gy = f->gy + i * j->E * j->real_size;
        const void *g = dar_row_get(j->real, a->gy.dtype, row_at(&a->gy, row + i, col), j->E, gy);
        j->rows->scale(j->E, sum == 0 ? 0 : 1 / sum, g, gy);
        dar_dtype_set(j->real, f->max, i, dar_dtype_get(j->real, a->stats.data, at));
        dar_dtype_set(j->real, f->dot, i, j->rows->dot(j->E, gy, y));
    }
    const void *q = row_at(&a->q, row, col);
    pack_rows(j->inner, false, a->q.dtype, q, j->D, n, j->E, f->q_rows);
    if (a->gq.data || a->gk.data) pack_rows(j->inner, false, j->real, f->gy, j->E, n, j->E, f->gy_rows);
    if (a->gk.data) pack_cols(j->outer, a->q.dtype, q, j->D, n, j->E, f->q_cols);
    if (a->gv.data) pack_cols(j->outer, j->real, f->gy, j->E, n, j->E, f->gy_cols);
}

/* m keys from k0 of the chunk against the n packed queries. */
static void backward_block(const struct job *j, const struct backward_scratch *f, size_t k0, size_t m, size_t n,
                           bool lw)
{
    const dar_attn *a = j->a;
    const dar_tile *in = j->inner, *out = j->outer;
    size_t block = k0 / ROWS_BACK, stripes = block * bytes_a(in, ROWS_BACK, j->E), at = k0 * j->E * j->real_size;
    bool weights_only = !a->gq.data && !a->gk.data;

    product(in, m, n, j->E, packed(in, f->k_rows + stripes, j->E), f->q_rows, f->s, f->ld, false);
    if (!weights_only) product(in, m, n, j->E, packed(in, f->v_rows + stripes, j->E), f->gy_rows, f->dp, f->ld, false);
    j->kern->grad(&(dar_attn_grad){
        .m = m,
        .n = n,
        .s = f->s,
        .dp = weights_only ? NULL : f->dp,
        .ld = f->ld,
        .c = j->c,
        .lw = lw ? f->lw + k0 * j->real_size : NULL,
        .max = f->max,
        .dot = f->dot,
        .p = a->gv.data ? f->p : NULL,
        .ds = a->gk.data || (a->gq.data && !f->pairs) ? f->ds : NULL,
        .ldp = f->ld,
        .ds_pairs = a->gq.data ? f->pairs : NULL,
    });
    struct left p = { f->p, f->ld / out->unit, 1, out->mr * f->ld * j->operand_size }, ds = p;
    struct left ds_t = { f->pairs ? f->pairs : f->ds, 1, f->ld, out->mr * out->unit_bytes };
    ds.at = f->ds;
    if (a->gv.data) product(out, m, j->E, n, p, f->gy_cols, f->dv + at, j->E, true);
    if (a->gk.data) product(out, m, j->E, n, ds, f->q_cols, f->dk + at, j->E, true);
    if (a->gq.data)
        product(out, n, j->E, m, ds_t, f->k_cols + block * bytes_b(out, j->E, ROWS_BACK), f->dq, j->E, k0 > 0);
}

/* gx[row + i, col ...] = (add ? that : 0) + scale x[i] for n rows of one head.  bf16 is not added to, and x is
 * overwritten then. */
static void store(const struct job *j, const dar_tensor *gx, size_t row, size_t col, size_t n, double scale, char *x,
                  bool add)
{
    bool half = gx->dtype != j->real;
    DAR_ASSERT(!(half && add), "attention: a gradient in bf16 is added to");
    for (size_t i = 0; i < n; i++, x += j->E * j->real_size) {
        char *to = row_at(gx, row + i, col);
        (add ? j->rows->axpy : j->rows->scale)(j->E, scale, x, half ? x : to);
        if (half) dar_row_put(j->real, x, gx->dtype, to, j->E, DAR_PUT);
    }
}

static void backward_task(void *ctx, size_t task, int thread)
{
    const struct job *j = ctx;
    const dar_attn *a = j->a;
    struct carve c = { (char *)a->scratch + (size_t)thread * j->per_thread, 0 };
    struct backward_scratch f = backward_carve(j, &c);
    size_t range = task % j->ranges, split = task / j->ranges % j->splits, head = task / j->ranges / j->splits;
    size_t b = head / j->A, col = head % j->A * j->E, chunk = chunk_of(j);
    size_t q_end = dar_least(j->Nq, (range + 1) * j->range), k_begin = split * j->split;
    size_t k_end = dar_least(j->Nk, k_begin + j->split);
    dar_tensor gq = dq_of(j, split);

    for (size_t k0 = k_begin; k0 < k_end; k0 += chunk) {
        size_t keys = dar_least(chunk, k_end - k0);
        load_keys(j, &f, b * j->Nk + k0, col, keys);
        bool lw = log_weights(j, b, k0, keys, f.lw);
        for (size_t q0 = range * j->range; q0 < q_end; q0 += QUERIES) {
            size_t n = dar_least(QUERIES, q_end - q0);
            load_queries(j, &f, head, q0, n);
            for (size_t i = 0; i < keys; i += ROWS_BACK)
                backward_block(j, &f, i, dar_least(ROWS_BACK, keys - i), n, lw);
            bool add = k0 > k_begin || (!split && a->add_q);
            if (gq.data) store(j, &gq, b * j->Nq + q0, col, n, a->scale, f.dq, add);
        }
        if (a->gk.data) store(j, &a->gk, b * j->Nk + k0, col, keys, a->scale, f.dk, a->add_k);
        if (a->gv.data) store(j, &a->gv, b * j->Nk + k0, col, keys, 1, f.dv, a->add_v);
    }
}

static void add_splits(void *ctx, size_t begin, size_t end, int thread)
{
    const struct job *j = ctx;
    (void)thread;
    for (size_t s = 1; s < j->splits; s++) {
        dar_tensor part = dq_of(j, s);
        char *to = (char *)j->a->gq.data + begin * j->real_size;
        j->rows->add(end - begin, to, (char *)part.data + begin * j->real_size, to);
    }
}

void dar_attn_backward(const dar_attn *a)
{
    struct job j = backward_job(a);
    if (!j.Nk && a->gq.data && !a->add_q) dar_tensor_fill(&a->gq, 0);
    dar_parallel(j.B * j.A * j.splits * j.ranges, backward_task, &j);
    if (a->gq.data && j.splits > 1) dar_parallel_range(dar_tensor_count(&a->gq), 1 << 14, add_splits, &j);
}
