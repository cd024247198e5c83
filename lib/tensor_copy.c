/* tensor_copy.c: copies and sums between any strides and types.
 *
 * Dimensions that are one run of memory in both tensors are merged.  What is left is walked along the dimension in
 * which dst is dense, the row.  Where src is dense in another one, the two are cut in tiles that are read along one and
 * written along the other, so that a permutation runs at the speed of memory too. */
#include "lib/tensor.h"

#include <math.h>
#include <string.h>

#include "lib/kern.h"
#include "lib/thread.h"

#define CHUNK    65536 /* elements per task, about */
#define TILE_ROW 512   /* bytes of the row in a tile */
#define TILE_ACROSS                                                                                                    \
    256                 /* elements of the other dimension: long runs in memory, and the second-level cache holds it   \
                         */
#define MAX_WIDTH  8    /* bytes of an element */
#define STREAM_ROW 128  /* least bytes of a row that are worth streaming: its ends are parts of lines */
#define AHEAD      4096 /* bytes asked for before they are read, where shorter runs end unforeseen */

struct dim {
    size_t n;
    int64_t dst, src; /* strides [elements] */
};

struct walk {
    const dar_tensor *dst, *src;
    dar_put mode;
    bool tiles;
    struct dim row, other; /* other: in which src is dense; without tiles 1 */
    size_t m, n;           /* of a part: elements of the row by elements of the other dimension */
    int steps;             /* from part to part: the dimensions that are left, then parts of the other, of the row */
    struct dim step[DAR_MAX_DIMS + 2];
};

/* What is moved at once: offsets of its first element, and how many steps it is from the first part. */
struct part {
    int64_t dst, src;
    size_t at[DAR_MAX_DIMS + 2];
};

static char *address(const dar_tensor *x, int64_t element)
{
    return (char *)x->data + element * (int64_t)dar_dtype_size(x->dtype);
}

static struct part part_of(const struct walk *w, size_t i)
{
    struct part p = { 0 };
    for (int k = w->steps - 1; k >= 0; i /= w->step[k--].n) {
        p.at[k] = i % w->step[k].n;
        p.dst += (int64_t)p.at[k] * w->step[k].dst;
        p.src += (int64_t)p.at[k] * w->step[k].src;
    }
    return p;
}

/* The next part, without a division. */
static void advance(const struct walk *w, struct part *p)
{
    for (int k = w->steps - 1; k >= 0; k--) {
        const struct dim *step = &w->step[k];
        p->dst += step->dst;
        p->src += step->src;
        if (++p->at[k] < step->n) return;
        p->dst -= (int64_t)step->n * step->dst;
        p->src -= (int64_t)step->n * step->src;
        p->at[k] = 0;
    }
}

static size_t rest(size_t all, size_t part, size_t at)
{
    return all - at * part < part ? all - at * part : part;
}

/* Size of a part. */
static size_t part_m(const struct walk *w, const struct part *p)
{
    return rest(w->row.n, w->m, p->at[w->steps - 1]);
}

static size_t part_n(const struct walk *w, const struct part *p)
{
    return rest(w->other.n, w->n, p->at[w->steps - 2]);
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

/* ---------------------------------------------------------------- rows */

/* n consecutive elements of `type` to or onto n consecutive ones of dst. */
static void put_row(const struct walk *w, dar_put mode, char *to, dar_dtype type, const char *from, size_t n)
{
    bool wide = type == DAR_F64 || type == DAR_F32;
    dar_dtype c = mode != DAR_PUT_ADD && wide ? type : dar_compute_type(w->dst->dtype);
    double buf[DAR_PIECE];

    if (mode == DAR_PUT) {
        dar_row_convert(w->dst->dtype, to, type, from, n);
        return;
    }
    if (mode == DAR_PUT_STREAM && type == w->dst->dtype) {
        dar_kern_for(DAR_F32)->stream(n * dar_dtype_size(type), from, to);
        return;
    }
    for (size_t i = 0; i < n; i += DAR_PIECE) {
        size_t m = n - i < DAR_PIECE ? n - i : DAR_PIECE;
        const void *x = dar_row_get(c, type, from + i * dar_dtype_size(type), m, buf);
        dar_row_put(c, x, w->dst->dtype, to + i * dar_dtype_size(w->dst->dtype), m, mode);
    }
}

/* A piece of a row whose elements may lie apart in either tensor. */
static void put_apart(const struct walk *w, int64_t dst, int64_t src, size_t n)
{
    size_t ds = dar_dtype_size(w->dst->dtype), ss = dar_dtype_size(w->src->dtype);
    char from[DAR_PIECE * MAX_WIDTH], to[DAR_PIECE * MAX_WIDTH];

    for (size_t i = 0; i < n; i += DAR_PIECE) {
        size_t m = n - i < DAR_PIECE ? n - i : DAR_PIECE;
        char *at = address(w->dst, dst + (int64_t)i * w->row.dst);
        move(ss, m, address(w->src, src + (int64_t)i * w->row.src), w->row.src, from, 1);
        if (w->mode == DAR_PUT_ADD) move(ds, m, at, w->row.dst, to, 1);
        put_row(w, w->mode == DAR_PUT_ADD ? DAR_PUT_ADD : DAR_PUT, to, w->src->dtype, from, m);
        move(ds, m, to, 1, at, w->row.dst);
    }
}

/* A part of one row. */
static void put_piece(const struct walk *w, const struct part *p)
{
    size_t m = part_m(w, p);
    if (w->row.dst != 1 || w->row.src != 1) put_apart(w, p->dst, p->src, m);
    else put_row(w, w->mode, address(w->dst, p->dst), w->src->dtype, address(w->src, p->src), m);
}

/* A part of both dimensions. */
static void put_tile(const struct walk *w, const struct part *p)
{
    dar_dtype type = w->src->dtype;
    size_t size = dar_dtype_size(type), m = part_m(w, p), n = part_n(w, p);
    bool beside = w->other.dst == (int64_t)m; /* rows of dst lie one behind the other */
    size_t ld = beside ? m : TILE_ROW / size;
    _Alignas(64) char y[TILE_ROW * TILE_ACROSS];

    dar_kern_for(DAR_F32)->transpose[type](m, n, address(w->src, p->src), (size_t)w->row.src, y, ld);
    if (beside) m *= n, n = 1;
    for (size_t j = 0; j < n; j++)
        put_row(w, w->mode, address(w->dst, p->dst + (int64_t)j * w->other.dst), type, y + j * ld * size, m);
}

static void ask(const struct walk *w, const struct part *p)
{
    size_t size = dar_dtype_size(w->src->dtype), m = part_m(w, p), n = part_n(w, p);
    if (!w->tiles || w->row.src == (int64_t)n) n *= m, m = 1; /* one run */
    for (size_t i = 0; i < m; i++) dar_row_ahead(address(w->src, p->src + (int64_t)i * w->row.src), n * size);
}

static void parts(void *ctx, size_t begin, size_t end, int thread)
{
    const struct walk *w = ctx;
    size_t bytes = w->m * w->n * dar_dtype_size(w->src->dtype);
    size_t ahead = (w->tiles || w->row.src == 1) && bytes < AHEAD ? AHEAD / bytes : end;
    struct part p = part_of(w, begin), later = part_of(w, begin + ahead);
    (void)thread;
    for (size_t i = begin; i < end; i++, advance(w, &p)) {
        if (i + ahead < end) {
            ask(w, &later);
            advance(w, &later);
        }
        if (w->tiles) put_tile(w, &p);
        else put_piece(w, &p);
    }
}

/* ---------------------------------------------------------------- the plan */

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

static struct dim take(struct dim *dim, int *n, int i)
{
    struct dim d = dim[i];
    for (--*n; i < *n; i++) dim[i] = dim[i + 1];
    return d;
}

/* Cut row and other dimension in parts, and move them. */
static void move_parts(struct walk *w)
{
    size_t m = w->tiles ? TILE_ROW / dar_dtype_size(w->src->dtype) : CHUNK, count = 1;

    w->m = w->row.n < m ? w->row.n : m;
    w->n = w->other.n < TILE_ACROSS ? w->other.n : TILE_ACROSS;
    if (w->mode == DAR_PUT_STREAM && w->m * dar_dtype_size(w->dst->dtype) < STREAM_ROW) w->mode = DAR_PUT;
    w->step[w->steps++] =
        (struct dim){ (w->other.n + w->n - 1) / w->n, (int64_t)w->n * w->other.dst, (int64_t)w->n * w->other.src };
    w->step[w->steps++] =
        (struct dim){ (w->row.n + w->m - 1) / w->m, (int64_t)w->m * w->row.dst, (int64_t)w->m * w->row.src };
    for (int i = 0; i < w->steps; i++) count *= w->step[i].n;
    dar_parallel_range(count, (CHUNK + w->m * w->n - 1) / (w->m * w->n), parts, w);
}

static void put(const dar_tensor *dst, const dar_tensor *src, bool add)
{
    char a[96], b[96];
    DAR_ASSERT(dar_shape_equal(&dst->shape, &src->shape), "copy: %s from %s", dar_shape_text(&dst->shape, a, sizeof a),
               dar_shape_text(&src->shape, b, sizeof b));
    DAR_ASSERT(dst->dtype != DAR_I8 && src->dtype != DAR_I8, "copy: i8 rows are quantised, not copied");
    if (!dar_tensor_count(dst)) return;

    struct walk w = { .dst = dst, .src = src, .mode = dar_put_for(dar_tensor_bytes(dst), add) };
    int n = merged_dims(dst, src, w.step), row = n - 1, dense = -1;
    for (int i = 0; i < n; i++)
        if (w.step[i].dst == 1) row = i;
    for (int i = 0; i < n; i++)
        if (w.step[i].src == 1) dense = i;
    w.tiles = dense >= 0 && dense != row && w.step[row].dst == 1;
    w.row = take(w.step, &n, row);
    w.other = w.tiles ? take(w.step, &n, dense > row ? dense - 1 : dense) : (struct dim){ 1, 0, 0 };
    w.steps = n;
    move_parts(&w);
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
