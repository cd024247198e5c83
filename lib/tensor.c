/* tensor.c: shapes, views, and copies between strides and types. */
#include "lib/tensor.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "lib/kern.h"
#include "lib/thread.h"

size_t dar_shape_count(const dar_shape *s)
{
    size_t n = 1;
    DAR_ASSERT(s->n >= 0 && s->n <= DAR_MAX_DIMS, "shape: %d dimensions, at most %d", s->n, DAR_MAX_DIMS);
    for (int i = 0; i < s->n; i++) {
        DAR_ASSERT(s->d[i] >= 0, "shape: dimension %d is %lld", i, (long long)s->d[i]);
        n = dar_mul_size(n, (size_t)s->d[i]);
    }
    DAR_ASSERT(n <= INT64_MAX, "shape: %zu elements, strides hold %lld", n, (long long)INT64_MAX);
    return n;
}

bool dar_shape_equal(const dar_shape *a, const dar_shape *b)
{
    if (a->n != b->n) return false;
    for (int i = 0; i < a->n; i++)
        if (a->d[i] != b->d[i]) return false;
    return true;
}

char *dar_shape_text(const dar_shape *s, char *buf, size_t size)
{
    size_t at = (size_t)snprintf(buf, size, "[");
    for (int i = 0; i < s->n && at < size; i++)
        at += (size_t)snprintf(buf + at, size - at, i ? ", %lld" : "%lld", (long long)s->d[i]);
    if (at < size) snprintf(buf + at, size - at, "]");
    return buf;
}

dar_tensor dar_tensor_of(dar_dtype t, dar_shape s, void *data)
{
    dar_tensor x = { .dtype = t, .shape = s, .data = data };
    int64_t step = 1;
    for (int i = s.n - 1; i >= 0; i--) {
        x.stride[i] = step;
        step *= s.d[i];
    }
    return x;
}

dar_tensor dar_tensor_push(dar_arena *a, dar_dtype t, dar_shape s)
{
    size_t n = dar_shape_count(&s);
    dar_tensor x = dar_tensor_of(t, s, dar_arena_push(a, dar_mul_size(n, dar_dtype_size(t))));
    if (t == DAR_I8) x.scale = dar_arena_push(a, dar_mul_size(dar_tensor_rows(&x), sizeof(float)));
    return x;
}

size_t dar_tensor_count(const dar_tensor *x)
{
    return dar_shape_count(&x->shape);
}

size_t dar_tensor_bytes(const dar_tensor *x)
{
    size_t n = dar_mul_size(dar_tensor_count(x), dar_dtype_size(x->dtype));
    return x->dtype == DAR_I8 ? dar_add_size(n, dar_mul_size(dar_tensor_rows(x), sizeof(float))) : n;
}

bool dar_tensor_contiguous(const dar_tensor *x)
{
    int64_t step = 1;
    for (int i = x->shape.n - 1; i >= 0; i--) {
        if (x->shape.d[i] != 1 && x->stride[i] != step) return false;
        step *= x->shape.d[i];
    }
    return true;
}

size_t dar_tensor_cols(const dar_tensor *x)
{
    return x->shape.n ? (size_t)x->shape.d[x->shape.n - 1] : 1;
}

size_t dar_tensor_rows(const dar_tensor *x)
{
    size_t n = 1;
    for (int i = 0; i + 1 < x->shape.n; i++) n = dar_mul_size(n, (size_t)x->shape.d[i]);
    return n;
}

dar_tensor dar_tensor_narrow(const dar_tensor *x, int dim, int64_t start, int64_t length)
{
    DAR_ASSERT(dim >= 0 && dim < x->shape.n, "narrow: dimension %d of %d", dim, x->shape.n);
    DAR_ASSERT(start >= 0 && length >= 0 && start <= x->shape.d[dim] - length, "narrow: [%lld, +%lld) of %lld",
               (long long)start, (long long)length, (long long)x->shape.d[dim]);
    DAR_ASSERT(x->dtype != DAR_I8, "narrow: i8 rows carry scales");
    dar_tensor y = *x;
    y.shape.d[dim] = length;
    y.data = (char *)x->data + start * x->stride[dim] * (int64_t)dar_dtype_size(x->dtype);
    return y;
}

dar_tensor dar_tensor_permute(const dar_tensor *x, const int *order)
{
    dar_tensor y = *x;
    unsigned seen = 0;
    for (int i = 0; i < x->shape.n; i++) {
        DAR_ASSERT(order[i] >= 0 && order[i] < x->shape.n && !(seen >> order[i] & 1), "permute: order[%d] is %d", i,
                   order[i]);
        seen |= 1u << order[i];
        y.shape.d[i] = x->shape.d[order[i]];
        y.stride[i] = x->stride[order[i]];
    }
    return y;
}

dar_tensor dar_tensor_reshape(const dar_tensor *x, dar_shape s)
{
    DAR_ASSERT(dar_tensor_contiguous(x), "reshape: the tensor is a strided view");
    DAR_ASSERT(dar_shape_count(&s) == dar_tensor_count(x), "reshape: %zu elements to %zu", dar_tensor_count(x),
               dar_shape_count(&s));
    dar_tensor y = dar_tensor_of(x->dtype, s, x->data);
    y.scale = x->scale;
    return y;
}

/* A walk over two tensors of one shape as rows: as many trailing dimensions as are contiguous in both form the row. */
struct walk {
    const dar_tensor *dst, *src;
    int outer;                 /* leading dimensions that are stepped through */
    size_t row;                /* elements per row */
    size_t dst_step, src_step; /* of the last dimension, where even that one is strided; else 1 */
    bool add;
};

#define COPY_CHUNK 65536 /* elements per task */

static void element_offsets(const struct walk *w, size_t i, int64_t *dst, int64_t *src)
{
    *dst = *src = 0;
    for (int k = w->outer - 1; k >= 0; k--) {
        int64_t at = (int64_t)(i % (size_t)w->dst->shape.d[k]);
        i /= (size_t)w->dst->shape.d[k];
        *dst += at * w->dst->stride[k];
        *src += at * w->src->stride[k];
    }
}

static void put_row(const struct walk *w, char *to, const char *from, size_t n)
{
    dar_dtype c = dar_compute_type(w->dst->dtype);
    double buf[DAR_PIECE];

    if (!w->add) {
        dar_row_convert(w->dst->dtype, to, w->src->dtype, from, n);
        return;
    }
    for (size_t i = 0; i < n; i += DAR_PIECE) {
        size_t m = n - i < DAR_PIECE ? n - i : DAR_PIECE;
        const void *x = dar_row_get(c, w->src->dtype, from + i * dar_dtype_size(w->src->dtype), m, buf);
        dar_row_put(c, x, w->dst->dtype, to + i * dar_dtype_size(w->dst->dtype), m, DAR_PUT_ADD);
    }
}

static void copy_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const struct walk *w = ctx;
    size_t ds = dar_dtype_size(w->dst->dtype), ss = dar_dtype_size(w->src->dtype);
    (void)thread;
    for (size_t i = begin; i < end; i++) {
        int64_t d, s;
        element_offsets(w, i, &d, &s);
        char *to = (char *)w->dst->data + d * (int64_t)ds;
        const char *from = (const char *)w->src->data + s * (int64_t)ss;
        if (w->dst_step == 1 && w->src_step == 1) {
            put_row(w, to, from, w->row);
        } else {
            for (size_t j = 0; j < w->row; j++) put_row(w, to + j * w->dst_step * ds, from + j * w->src_step * ss, 1);
        }
    }
}

/* One row as two dimensions would have it: cut a single long row in pieces. */
static void copy_piece(void *ctx, size_t begin, size_t end, int thread)
{
    const struct walk *w = ctx;
    (void)thread;
    put_row(w, (char *)w->dst->data + begin * dar_dtype_size(w->dst->dtype),
            (const char *)w->src->data + begin * dar_dtype_size(w->src->dtype), end - begin);
}

static void put(const dar_tensor *dst, const dar_tensor *src, bool add)
{
    char a[96], b[96];
    DAR_ASSERT(dar_shape_equal(&dst->shape, &src->shape), "copy: %s from %s", dar_shape_text(&dst->shape, a, sizeof a),
               dar_shape_text(&src->shape, b, sizeof b));
    DAR_ASSERT(dst->dtype != DAR_I8 && src->dtype != DAR_I8, "copy: i8 rows are quantised, not copied");
    if (!dar_tensor_count(dst)) return;

    struct walk w = {
        .dst = dst, .src = src, .outer = dst->shape.n, .row = 1, .dst_step = 1, .src_step = 1, .add = add
    };
    while (w.outer > 0 && (dst->shape.d[w.outer - 1] == 1 ||
                           (dst->stride[w.outer - 1] == (int64_t)w.row && src->stride[w.outer - 1] == (int64_t)w.row)))
        w.row *= (size_t)dst->shape.d[--w.outer];
    if (w.row == 1 && w.outer > 0) { /* the last dimension itself is strided */
        w.outer--;
        w.row = (size_t)dst->shape.d[w.outer];
        w.dst_step = (size_t)dst->stride[w.outer];
        w.src_step = (size_t)src->stride[w.outer];
    }
    size_t rows = dar_tensor_count(dst) / w.row;
    if (rows == 1 && w.dst_step == 1 && w.src_step == 1) dar_parallel_range(w.row, COPY_CHUNK, copy_piece, &w);
    else dar_parallel_range(rows, COPY_CHUNK / w.row ? COPY_CHUNK / w.row : 1, copy_rows, &w);
}

void dar_tensor_copy(const dar_tensor *dst, const dar_tensor *src)
{
    put(dst, src, false);
}

void dar_tensor_add(const dar_tensor *dst, const dar_tensor *src)
{
    put(dst, src, true);
}

void dar_tensor_fill(const dar_tensor *x, double value)
{
    DAR_ASSERT(x->dtype != DAR_I8, "fill: i8 rows carry scales");
    unsigned char one[8];
    dar_dtype_set(x->dtype, one, 0, value);
    dar_tensor c = { .dtype = x->dtype, .shape = x->shape, .data = one }; /* every stride 0 */
    if (dar_tensor_contiguous(x) && value == 0 && !signbit(value)) memset(x->data, 0, dar_tensor_bytes(x));
    else dar_tensor_copy(x, &c);
}

int64_t dar_tensor_nonfinite(const dar_tensor *x)
{
    DAR_ASSERT(dar_tensor_contiguous(x), "nonfinite: the tensor is a strided view");
    return x->dtype == DAR_I8 ? -1 : dar_row_nonfinite(x->dtype, x->data, dar_tensor_count(x));
}
