/* tensor_copy.c: copies and sums between any strides and types.
 *
 * Dimensions that are one run of memory in both tensors are merged.  What is left is walked along the dimension in
 * which dst is dense.  Where src is dense in another one, the two are cut in square tiles that are read along one and
 * written along the other, so that a permutation runs at the speed of memory too. */
#include "lib/tensor.h"

#include <math.h>
#include <string.h>

#include "lib/kern.h"
#include "lib/thread.h"

#define CHUNK     65536 /* elements per task */
#define TILE      64    /* rows and columns of a tile: whole cache lines of any type */
#define MAX_WIDTH 8     /* bytes of an element */

struct dim {
    size_t n;
    int64_t dst, src; /* strides [elements] */
};

struct walk {
    const dar_tensor *dst, *src;
    bool add;
    int outer;                        /* dimensions stepped through: dim[0] to dim[outer - 1] */
    struct dim dim[DAR_MAX_DIMS + 2]; /* then the row, then, in tiles, the one in which src is dense */
    size_t pieces, piece;             /* of a row, and their length */
};

static char *address(const dar_tensor *x, int64_t element)
{
    return (char *)x->data + element * (int64_t)dar_dtype_size(x->dtype);
}

/* Offsets of the i-th combination of the outer dimensions. */
static void offsets(const struct walk *w, size_t i, int64_t *dst, int64_t *src)
{
    *dst = *src = 0;
    for (int k = w->outer - 1; k >= 0; k--) {
        int64_t at = (int64_t)(i % w->dim[k].n);
        i /= w->dim[k].n;
        *dst += at * w->dim[k].dst;
        *src += at * w->dim[k].src;
    }
}

/* ---------------------------------------------------------------- elements, whatever they mean */

/* y[i * y_step] = x[i * x_step] for n elements of `size` bytes. */
static void move(size_t size, size_t n, const void *x, int64_t x_step, void *y, int64_t y_step)
{
#define MOVE(T)                                                                                                        \
    for (int64_t i = 0; i < (int64_t)n; i++) ((T *)y)[i * y_step] = ((const T *)x)[i * x_step]
    if (size == 2) MOVE(uint16_t);
    else if (size == 4) MOVE(uint32_t);
    else MOVE(uint64_t);
#undef MOVE
}

/* y[j][i] = x[i][j] in tiles of `size` bytes. */
static void transpose(size_t size, const void *x, void *y)
{
#define TRANSPOSE(T)                                                                                                   \
    for (size_t j = 0; j < TILE; j++)                                                                                  \
        for (size_t i = 0; i < TILE; i++) ((T *)y)[j * TILE + i] = ((const T *)x)[i * TILE + j]
    if (size == 2) TRANSPOSE(uint16_t);
    else if (size == 4) TRANSPOSE(uint32_t);
    else TRANSPOSE(uint64_t);
#undef TRANSPOSE
}

/* ---------------------------------------------------------------- rows */

/* n consecutive elements of `type` to or onto n consecutive ones of dst. */
static void put_row(const struct walk *w, char *to, dar_dtype type, const char *from, size_t n)
{
    dar_dtype c = dar_compute_type(w->dst->dtype);
    double buf[DAR_PIECE];

    if (!w->add) {
        dar_row_convert(w->dst->dtype, to, type, from, n);
        return;
    }
    for (size_t i = 0; i < n; i += DAR_PIECE) {
        size_t m = n - i < DAR_PIECE ? n - i : DAR_PIECE;
        const void *x = dar_row_get(c, type, from + i * dar_dtype_size(type), m, buf);
        dar_row_put(c, x, w->dst->dtype, to + i * dar_dtype_size(w->dst->dtype), m, DAR_PUT_ADD);
    }
}

/* A piece of a row whose elements may lie apart in either tensor. */
static void put_apart(const struct walk *w, int64_t dst, int64_t src, size_t n)
{
    const struct dim *row = &w->dim[w->outer];
    size_t ds = dar_dtype_size(w->dst->dtype), ss = dar_dtype_size(w->src->dtype);
    char from[DAR_PIECE * MAX_WIDTH], to[DAR_PIECE * MAX_WIDTH];

    for (size_t i = 0; i < n; i += DAR_PIECE) {
        size_t m = n - i < DAR_PIECE ? n - i : DAR_PIECE;
        char *at = address(w->dst, dst + (int64_t)i * row->dst);
        move(ss, m, address(w->src, src + (int64_t)i * row->src), row->src, from, 1);
        if (w->add) move(ds, m, at, row->dst, to, 1);
        put_row(w, to, w->src->dtype, from, m);
        move(ds, m, to, 1, at, row->dst);
    }
}

static void put_piece(const struct walk *w, size_t i)
{
    const struct dim *row = &w->dim[w->outer];
    size_t first = i % w->pieces * w->piece, n = row->n - first < w->piece ? row->n - first : w->piece;
    int64_t dst, src;
    offsets(w, i / w->pieces, &dst, &src);
    dst += (int64_t)first * row->dst;
    src += (int64_t)first * row->src;
    if (row->dst == 1 && row->src == 1) put_row(w, address(w->dst, dst), w->src->dtype, address(w->src, src), n);
    else put_apart(w, dst, src, n);
}

/* ---------------------------------------------------------------- tiles */

/* One tile: m elements of the row (dst is dense) by n of the other dimension (src is dense). */
static void put_tile(const struct walk *w, int64_t dst, int64_t src, size_t m, size_t n)
{
    const struct dim *row = &w->dim[w->outer], *other = row + 1;
    dar_dtype type = w->add ? dar_compute_type(w->dst->dtype) : w->dst->dtype;
    size_t size = dar_dtype_size(type);
    _Alignas(64) char x[TILE * TILE * MAX_WIDTH], y[TILE * TILE * MAX_WIDTH];

    for (size_t i = 0; i < m; i++)
        dar_row_convert(type, x + i * TILE * size, w->src->dtype, address(w->src, src + (int64_t)i * row->src), n);
    transpose(size, x, y);
    for (size_t j = 0; j < n; j++)
        put_row(w, address(w->dst, dst + (int64_t)j * other->dst), type, y + j * TILE * size, m);
}

/* A stripe of tiles. */
static void put_stripe(const struct walk *w, size_t i)
{
    const struct dim *row = &w->dim[w->outer], *other = row + 1;
    size_t across = (other->n + TILE - 1) / TILE, first = i % w->pieces * w->piece, j = i / w->pieces % across * TILE;
    size_t end = row->n - first < w->piece ? row->n : first + w->piece, n = other->n - j < TILE ? other->n - j : TILE;
    int64_t dst, src;
    offsets(w, i / w->pieces / across, &dst, &src);
    dst += (int64_t)j * other->dst;
    src += (int64_t)j * other->src;
    for (size_t k = first; k < end; k += TILE)
        put_tile(w, dst + (int64_t)k * row->dst, src + (int64_t)k * row->src, end - k < TILE ? end - k : TILE, n);
}

/* ---------------------------------------------------------------- the plan */

static void pieces(void *ctx, size_t begin, size_t end, int thread)
{
    (void)thread;
    for (size_t i = begin; i < end; i++) put_piece(ctx, i);
}

static void stripes(void *ctx, size_t begin, size_t end, int thread)
{
    (void)thread;
    for (size_t i = begin; i < end; i++) put_stripe(ctx, i);
}

/* The dimensions longer than 1, neighbours merged where both tensors run through them. */
static int merged_dims(const dar_tensor *dst, const dar_tensor *src, struct dim *dim)
{
    int n = 0;
    for (int i = 0; i < dst->shape.n; i++) {
        struct dim d = { (size_t)dst->shape.d[i], dst->stride[i], src->stride[i] };
        if (d.n == 1) continue;
        struct dim *last = n ? &dim[n - 1] : NULL;
        if (last && last->dst == d.dst * (int64_t)d.n && last->src == d.src * (int64_t)d.n) {
            last->n *= d.n;
            last->dst = d.dst;
            last->src = d.src;
        } else {
            dim[n++] = d;
        }
    }
    if (!n) dim[n++] = (struct dim){ 1, 1, 1 };
    return n;
}

/* Move dim[i] to place `to`, keeping the order of the others. */
static void move_dim(struct dim *dim, int i, int to)
{
    struct dim d = dim[i];
    for (; i < to; i++) dim[i] = dim[i + 1];
    dim[to] = d;
}

static void put(const dar_tensor *dst, const dar_tensor *src, bool add)
{
    char a[96], b[96];
    DAR_ASSERT(dar_shape_equal(&dst->shape, &src->shape), "copy: %s from %s", dar_shape_text(&dst->shape, a, sizeof a),
               dar_shape_text(&src->shape, b, sizeof b));
    DAR_ASSERT(dst->dtype != DAR_I8 && src->dtype != DAR_I8, "copy: i8 rows are quantised, not copied");
    if (!dar_tensor_count(dst)) return;

    struct walk w = { .dst = dst, .src = src, .add = add };
    int n = merged_dims(dst, src, w.dim), dense = -1, row = n - 1;
    for (int i = 0; i < n; i++)
        if (w.dim[i].dst == 1) row = i;
    for (int i = 0; i < n; i++)
        if (w.dim[i].src == 1) dense = i;
    bool tiles = dense >= 0 && dense != row && w.dim[row].dst == 1;
    size_t parts = 1, length = w.dim[row].n;
    move_dim(w.dim, row, n - 1);
    if (tiles) {
        move_dim(w.dim, dense > row ? dense - 1 : dense, n - 2);
        struct dim other = w.dim[n - 2];
        w.dim[n - 2] = w.dim[n - 1];
        w.dim[n - 1] = other;
        parts = (other.n + TILE - 1) / TILE;
    }
    w.outer = n - (tiles ? 2 : 1);
    w.piece = tiles ? CHUNK / TILE : CHUNK;
    w.pieces = (length + w.piece - 1) / w.piece;
    parts *= w.pieces;
    for (int i = 0; i < w.outer; i++) parts *= w.dim[i].n;
    dar_parallel_range(parts, w.piece / (length < w.piece ? length : w.piece), tiles ? stripes : pieces, &w);
}

void dar_tensor_copy(const dar_tensor *dst, const dar_tensor *src)
{
    put(dst, src, false);
}

void dar_tensor_add(const dar_tensor *dst, const dar_tensor *src)
{
    put(dst, src, true);
}

/* ---------------------------------------------------------------- fill */

struct pattern {
    char *data;
    char bytes[4096];
};

static void fill_range(void *ctx, size_t begin, size_t end, int thread)
{
    const struct pattern *p = ctx;
    (void)thread;
    for (size_t i = begin; i < end; i += sizeof p->bytes)
        memcpy(p->data + i, p->bytes, end - i < sizeof p->bytes ? end - i : sizeof p->bytes);
}

void dar_tensor_fill(const dar_tensor *x, double value)
{
    DAR_ASSERT(x->dtype != DAR_I8, "fill: i8 rows carry scales");
    struct pattern p = { .data = x->data };
    size_t size = dar_dtype_size(x->dtype);
    for (size_t i = 0; i < sizeof p.bytes / size; i++) dar_dtype_set(x->dtype, p.bytes, i, value);
    dar_tensor c = { .dtype = x->dtype, .shape = x->shape, .data = p.bytes }; /* every stride 0 */
    if (dar_tensor_contiguous(x)) dar_parallel_range(dar_tensor_bytes(x), (size_t)64 * sizeof p.bytes, fill_range, &p);
    else dar_tensor_copy(x, &c);
}
