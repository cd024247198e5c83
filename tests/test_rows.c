/* test_rows.c: what the samples of the row ops do not show: copies between all layouts, positions of RoPE, rows far
 * from zero and rows of zeros. */
#include "tests/test.h"

#include "autograd/ops.h"
#include "lib/cpu.h"
#include "lib/kern.h"

static dar_arena arena;
static dar_tape tape;

/* Small whole numbers: every type holds them and their sums exactly. */
static void fill_whole(const dar_tensor *x, int factor)
{
    for (size_t i = 0; i < dar_tensor_count(x); i++)
        dar_dtype_set(x->dtype, x->data, i, (double)((int)(i * 7 % 61) * factor - 30));
}

static double element(const dar_tensor *x, const int64_t *at)
{
    int64_t offset = 0;
    for (int i = 0; i < x->shape.n; i++) offset += at[i] * x->stride[i];
    return dar_dtype_get(x->dtype, x->data, (size_t)offset);
}

/* dst (+)= src where both are the inside of a larger block, in every order of dimensions. */
static void check_copy(dar_dtype to, dar_dtype from, const int64_t *size, const int *order, bool add)
{
    dar_mark m = dar_arena_mark(&arena);
    dar_shape outer = { 3, { 0 } }, permuted = { 3, { 0 } };
    int back[3];
    for (int i = 0; i < 3; i++) permuted.d[i] = outer.d[i] = size[i] + (size[i] > 1 ? 2 : 0);
    for (int i = 0; i < 3; i++) permuted.d[i] = outer.d[order[i]], back[order[i]] = i;
    dar_tensor all = dar_tensor_push(&arena, to, outer), before = dar_tensor_push(&arena, to, outer);
    dar_tensor source = dar_tensor_push(&arena, from, permuted);
    fill_whole(&all, 1);
    fill_whole(&before, 1);
    fill_whole(&source, -1);
    dar_tensor dst = all, src = dar_tensor_permute(&source, back), was = before;
    for (int i = 0; i < 3; i++) {
        if (size[i] == 1) continue;
        dst = dar_tensor_narrow(&dst, i, 1, size[i]);
        was = dar_tensor_narrow(&was, i, 1, size[i]);
        src = dar_tensor_narrow(&src, i, 1, size[i]);
    }
    (add ? dar_tensor_add : dar_tensor_copy)(&dst, &src);
    for (int64_t i = 0; i < size[0]; i++)
        for (int64_t j = 0; j < size[1]; j++)
            for (int64_t k = 0; k < size[2]; k++) {
                int64_t at[] = { i, j, k };
                double expected = element(&src, at) + (add ? element(&was, at) : 0);
                CHECK(element(&dst, at) == expected, "%s from %s, order %d %d %d, add %d: [%d, %d, %d] is %g, not %g",
                      dar_dtype_name(to), dar_dtype_name(from), order[0], order[1], order[2], add, (int)i, (int)j,
                      (int)k, element(&dst, at), expected);
                int64_t offset = i * dst.stride[0] + j * dst.stride[1] + k * dst.stride[2];
                dar_dtype_set(to, dst.data, (size_t)offset, element(&was, at));
            }
    CHECK(memcmp(all.data, before.data, dar_tensor_bytes(&all)) == 0, "%s from %s: wrote outside the view",
          dar_dtype_name(to), dar_dtype_name(from));
    dar_arena_reset(&arena, m);
}

static void copies_of_all_layouts(void **state)
{
    (void)state;
    static const int orders[][3] = { { 0, 1, 2 }, { 0, 2, 1 }, { 1, 0, 2 }, { 1, 2, 0 }, { 2, 0, 1 }, { 2, 1, 0 } };
    static const int64_t sizes[][3] = { { 3, 5, 7 }, { 1, 70, 66 }, { 65, 1, 130 }, { 2, 3, 2100 }, { 2050, 2, 1 } };
    static const dar_dtype types[] = { DAR_F64, DAR_F32, DAR_BF16, DAR_F16 };
    unsigned level[5];
    for (int l = 0, n = test_levels(level); l < n; l++) {
        dar_cpu_init(level[l]);
        for (size_t s = 0; s < DAR_COUNT(sizes); s++)
            for (size_t o = 0; o < DAR_COUNT(orders); o++)
                for (size_t t = 0; t < DAR_COUNT(types); t++)
                    for (size_t f = 0; f < DAR_COUNT(types); f++)
                        for (int add = 0; add < 2; add++) check_copy(types[t], types[f], sizes[s], orders[o], add);
    }
    dar_cpu_init(DAR_CPU_ALL);
}

/* Too large for the caches, so stored past them: rows at every alignment, every bit pattern, NaN of every kind among
 * them. */
static void large_copies(void **state)
{
    (void)state;
    static const dar_dtype types[] = { DAR_F64, DAR_F32, DAR_BF16, DAR_F16 };
    unsigned level[5];
    for (int l = 0, levels = test_levels(level); l < levels; l++)
        for (size_t t = 0; t < DAR_COUNT(types); t++) {
            dar_mark mark = dar_arena_mark(&arena);
            size_t size = dar_dtype_size(types[t]), rows = 4099, cols = ((size_t)25 << 20) / size / rows;
            dar_tensor x = dar_tensor_push(&arena, types[t], DAR_SHAPE((int64_t)rows, (int64_t)cols));
            dar_tensor whole = dar_tensor_push(&arena, types[t], DAR_SHAPE((int64_t)cols, (int64_t)rows + 2));
            dar_tensor y = dar_tensor_narrow(&whole, 1, 1, (int64_t)rows);
            dar_tensor z = dar_tensor_push(&arena, types[t], x.shape);
            dar_tensor back = dar_tensor_permute(&y, (int[]){ 1, 0 });
            uint16_t *bits = x.data;
            for (size_t i = 0; i < dar_tensor_bytes(&x) / 2; i++) bits[i] = (uint16_t)(i * 40503 + i / 65536);
            dar_cpu_init(level[l]);
            dar_tensor flipped = dar_tensor_permute(&x, (int[]){ 1, 0 });
            dar_tensor_copy(&y, &flipped);
            for (size_t i = 0; i < rows; i += 61)
                for (size_t j = 0; j < cols; j++)
                    CHECK(memcmp(dar_tensor_at(&x, i * cols + j), dar_tensor_at(&whole, j * (rows + 2) + i + 1),
                                 size) == 0,
                          "%s at level %d: [%zu, %zu] has other bits", dar_dtype_name(types[t]), l, i, j);
            dar_tensor_copy(&z, &back);
            CHECK(memcmp(x.data, z.data, dar_tensor_bytes(&x)) == 0, "%s at level %d: not the same bits after two",
                  dar_dtype_name(types[t]), l);
            dar_arena_reset(&arena, mark);
        }
    dar_cpu_init(DAR_CPU_ALL);
}

static void fills(void **state)
{
    (void)state;
    static float x[5000];
    dar_tensor all = dar_tensor_of(DAR_F32, DAR_SHAPE(50, 100), x), part = dar_tensor_narrow(&all, 1, 3, 90);
    dar_tensor_fill(&all, 1.5);
    dar_tensor_fill(&part, -0.0);
    for (size_t i = 0; i < 5000; i++) {
        bool inside = i % 100 >= 3 && i % 100 < 93;
        CHECK(x[i] == (inside ? 0 : 1.5F) && !signbit(x[i]) == !inside, "element %zu is %g", i, (double)x[i]);
    }
}

/* ---------------------------------------------------------------- sums */

/* Columns of several pieces, rows of several chunks; whole numbers, so that every order has the same sum. */
static void sums_of_columns(void **state)
{
    (void)state;
    static const dar_dtype types[] = { DAR_F64, DAR_F32, DAR_BF16 };
    static const int64_t sizes[][2] = { { 300, 5003 }, { 7, 40000 }, { 5000, 3 } };
    for (size_t s = 0; s < DAR_COUNT(sizes); s++)
        for (size_t t = 0; t < DAR_COUNT(types); t++) {
            dar_mark mark = dar_arena_mark(&arena);
            size_t rows = (size_t)sizes[s][0], cols = (size_t)sizes[s][1];
            dar_tensor x = dar_tensor_push(&arena, types[t], DAR_SHAPE(sizes[s][0], sizes[s][1]));
            fill_whole(&x, 1);
            dar_val *y = dar_sum(&tape, dar_leaf(&tape, x, NULL), 1, false);
            for (size_t j = 0; j < cols; j++) {
                double sum = 0;
                for (size_t i = 0; i < rows; i++) sum += (double)((int)((i * cols + j) * 7 % 61) - 30);
                CHECK_NEAR("sum of a column", dar_dtype_get(y->x.dtype, y->x.data, j), sum, 0);
            }
            dar_tape_clear(&tape);
            dar_arena_reset(&arena, mark);
        }
}

/* ---------------------------------------------------------------- softmax */

/* A result too large for the caches is stored past them: the bits of a small one. */
static void large_softmax(void **state)
{
    (void)state;
    dar_mark mark = dar_arena_mark(&arena);
    dar_tensor x = dar_tensor_push(&arena, DAR_F32, DAR_SHAPE(2100, 3001));
    float *v = x.data;
    for (size_t i = 0; i < dar_tensor_count(&x); i++) v[i] = (float)(i * 2654435761u % 4096) * 0x1p-9f;
    dar_val *y = dar_softmax(&tape, dar_leaf(&tape, x, NULL), NULL);
    for (int64_t row = 0; row < 2100; row += 2099) {
        dar_val *one = dar_softmax(&tape, dar_leaf(&tape, dar_tensor_narrow(&x, 0, row, 1), NULL), NULL);
        CHECK(memcmp(one->x.data, dar_tensor_at(&y->x, (size_t)row * 3001), 3001 * sizeof(float)) == 0,
              "row %d of a large softmax has other bits", (int)row);
    }
    dar_tape_clear(&tape);
    dar_arena_reset(&arena, mark);
}

/* ---------------------------------------------------------------- rope */

static void positions(void **state)
{
    (void)state;
    int64_t pairs[3];
    dar_rope_axes(128, pairs);
    CHECK(pairs[0] == 22 && pairs[1] == 21 && pairs[2] == 21, "pairs of 128");
    dar_rope_axes(64, pairs);
    CHECK(pairs[0] == 12 && pairs[1] == 10 && pairs[2] == 10, "pairs of 64");

    double a[64];
    dar_rope_angles(128, 10000, (double[]){ 3, 5, 1023 }, a);
    CHECK_NEAR("first of time", a[0], 3, 0);
    CHECK_NEAR("last of time", a[21], 3 * pow(10000, -2 * 21 / 44.0), 1e-15); /* pos 10000^(-2i / 44) */
    CHECK_NEAR("first of height", a[22], 5, 0);
    CHECK_NEAR("last of height", a[42], 5 * pow(10000, -2 * 20 / 42.0), 1e-15);
    CHECK_NEAR("second of width", a[44], 1023 * pow(10000, -2 / 42.0), 1e-12);

    static double table[2 * 3 * 5 * 128];
    dar_tensor t = dar_tensor_of(DAR_F64, DAR_SHAPE(2 * 3 * 5, 128), table);
    dar_rope_table(&t, 2, 3, 5, 100);
    for (int i = 0; i < 30; i++) { /* token i at frame i / 15, row i / 5 % 3, column i % 5 */
        dar_rope_angles(128, 100, (double[]){ i / 15, i / 5 % 3, i % 5 }, a);
        for (int j = 0; j < 64; j++) {
            CHECK_NEAR("cos", table[i * 128 + 2 * j], cos(a[j]), 0);
            CHECK_NEAR("sin", table[i * 128 + 2 * j + 1], sin(a[j]), 0);
        }
    }
}

/* ---------------------------------------------------------------- norms */

/* x = 1e4 + tiny: in f32 the spacing there is 2^-10.  The f64 run at the same values is the truth. */
static void norm_far_from_zero(void **state)
{
    (void)state;
    static float x[4 * 3072];
    static double wide[4 * 3072];
    static const dar_norm_opt o = { .eps = 1e-6 };
    for (size_t i = 0; i < DAR_COUNT(x); i++) {
        x[i] = 1e4f + (float)(i * 2654435761u % 9) * 0x1p-10f;
        wide[i] = x[i];
    }
    dar_shape s = DAR_SHAPE(4, 3072);
    dar_val *y = dar_layer_norm(&tape, dar_leaf(&tape, dar_tensor_of(DAR_F32, s, x), NULL), NULL, NULL, &o);
    dar_val *e = dar_layer_norm(&tape, dar_leaf(&tape, dar_tensor_of(DAR_F64, s, wide), NULL), NULL, NULL, &o);
    for (size_t i = 0; i < DAR_COUNT(x); i++) /* |y| < 2, five roundings */
        CHECK_NEAR("1e4 + tiny", ((float *)y->x.data)[i], ((double *)e->x.data)[i], 2 * 5 * 0x1p-24);
}

static void zero_rows(void **state)
{
    (void)state;
    static float x[3 * 64], w[64], gx[3 * 64], gy[3 * 64];
    static const dar_norm_opt o = { .eps = 1e-6 };
    dar_shape s = DAR_SHAPE(1, 3, 64);
    dar_tensor g = dar_tensor_of(DAR_F32, s, gx), seed = dar_tensor_of(DAR_F32, s, gy);
    for (size_t i = 0; i < DAR_COUNT(gy); i++) gy[i] = (float)(i % 5) - 2;
    for (size_t i = 0; i < 64; i++) w[i] = 1;
    for (int op = 0; op < 3; op++) {
        dar_val *leaf = dar_leaf(&tape, dar_tensor_of(DAR_F32, s, x), &g);
        dar_val *one = dar_leaf(&tape, dar_tensor_of(DAR_F32, DAR_SHAPE(64), w), NULL);
        dar_val *three = dar_leaf(&tape, dar_tensor_of(DAR_F32, DAR_SHAPE(3), w), NULL);
        dar_val *y = op == 0   ? dar_rms_norm(&tape, leaf, one, &o)
                     : op == 1 ? dar_layer_norm(&tape, leaf, one, NULL, &o)
                               : dar_channel_norm(&tape, leaf, three);
        for (size_t i = 0; i < DAR_COUNT(x); i++) CHECK_NEAR("zero row", ((float *)y->x.data)[i], 0, 0);
        dar_backward(&tape, y, &seed);
        CHECK(dar_tensor_nonfinite(&g) < 0, "op %d: the gradient at zero is not finite", op);
    }
}

static int setup(void **state)
{
    (void)state;
    return dar_arena_init(&arena, "test", (size_t)96 << 20, NULL) != DAR_OK ||
           dar_tape_init(&tape, &arena, NULL) != DAR_OK;
}

static int teardown(void **state)
{
    (void)state;
    dar_tape_free(&tape);
    dar_arena_free(&arena);
    return 0;
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(copies_of_all_layouts), cmocka_unit_test(large_copies),  cmocka_unit_test(fills),
        cmocka_unit_test(sums_of_columns),       cmocka_unit_test(large_softmax), cmocka_unit_test(positions),
        cmocka_unit_test(norm_far_from_zero),    cmocka_unit_test(zero_rows),
    };
    return cmocka_run_group_tests(tests, setup, teardown) != 0;
}
