/* double.c: see double.h. */
#include "models/double.h"

#include "autograd/ops.h"

/* Row 2 h + parity of the large grid reads rows of the small one: tap k of three becomes tap place[parity][k] of two.
 */
static const int place[2][3] = { { 0, 1, 1 }, { 0, 0, 1 } };

static void sum_taps(const dar_tensor *w, int row, int column, const dar_tensor *out)
{
    size_t pairs = (size_t)(w->shape.d[0] * w->shape.d[1]);
    for (size_t i = 0; i < pairs; i++) {
        double sum[4] = { 0 };
        for (int y = 0; y < 3; y++)
            for (int x = 0; x < 3; x++)
                sum[2 * place[row][y] + place[column][x]] +=
                    dar_dtype_get(w->dtype, w->data, 9 * i + (size_t)(3 * y + x));
        for (size_t k = 0; k < 4; k++) dar_dtype_set(out->dtype, out->data, 4 * i + k, sum[k]);
    }
}

dar_double dar_double_fold(const dar_tensor *w, dar_dtype type, dar_arena *a)
{
    dar_double d;
    for (int k = 0; k < 4; k++) {
        d.w[k] = dar_tensor_push(a, type, DAR_SHAPE(w->shape.d[0], w->shape.d[1], 2, 2));
        if (!a->plan) sum_taps(w, k / 2, k % 2, &d.w[k]);
    }
    return d;
}

dar_val *dar_double_forward(dar_tape *t, const dar_double *f, dar_val *b, dar_val *x)
{
    const int64_t *d = x->x.shape.d;
    dar_val *y = dar_input(t, x->x.dtype, DAR_SHAPE(d[0], f->w[0].shape.d[0], d[2], 2 * d[3], 2 * d[4]));
    dar_tape_place m = dar_tape_mark(t);
    for (int k = 0; k < 4; k++) {
        int row = k / 2, column = k % 2;
        dar_conv_attr a = { .stride = 1, .top = !row, .bottom = row, .left = !column, .right = column };
        dar_val *part = dar_conv2d(t, x, dar_leaf(t, f->w[k], NULL), b, a);
        dar_tensor to = y->x;
        to.shape = part->x.shape;
        to.data = dar_tensor_at(&y->x, (size_t)(row * 2 * d[4] + column));
        to.stride[3] *= 2;
        to.stride[4] *= 2;
        if (!t->arena->plan) dar_tensor_copy(&to, &part->x);
        dar_tape_reset(t, m);
    }
    return y;
}
