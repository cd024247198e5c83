/* tensor.c: shapes and views. */
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

int64_t dar_tensor_nonfinite(const dar_tensor *x)
{
    DAR_ASSERT(dar_tensor_contiguous(x), "nonfinite: the tensor is a strided view");
    return x->dtype == DAR_I8 ? -1 : dar_row_nonfinite(x->dtype, x->data, dar_tensor_count(x));
}
