/* test_linear.c: linear layers whose weights are stored in 8 bits, which the table test of the ops cannot fill. */
#include "tests/test.h"

#include <float.h>

#include "autograd/ops.h"
#include "lib/kern.h"
#include "lib/rng.h"

enum { M = 13, N = 9, K = 70 };

static dar_arena arena;

static dar_tensor random_tensor(dar_dtype type, dar_shape s, uint64_t stream)
{
    dar_tensor x = dar_tensor_push(&arena, type, s);
    dar_rng_fill_uniform(&x, 7, stream, -1, 1);
    return x;
}

/* w in 8 bits, and what its rows are worth. */
static dar_tensor quantised(const dar_tensor *w, double *value)
{
    dar_tensor q = dar_tensor_push(&arena, DAR_I8, w->shape);
    for (size_t i = 0; i < dar_tensor_rows(w); i++) {
        size_t k = dar_tensor_cols(w);
        int8_t *row = (int8_t *)q.data + i * k;
        q.scale[i] = dar_row_quantise(w->dtype, (const float *)w->data + i * k, k, row);
        for (size_t j = 0; j < k; j++) value[i * k + j] = (double)row[j] * q.scale[i];
    }
    return q;
}

/* y and gx for one type of x; quantise: x's rows are rounded to 8 bits before, exactly as forward does. */
static void check(dar_dtype type, bool quantise)
{
    dar_tape t;
    double w_value[N * K], x_value[M * K];
    assert_int_equal(dar_arena_init(&arena, "test", (size_t)256 << 20, NULL), DAR_OK);
    assert_int_equal(dar_tape_init(&t, &arena, NULL), DAR_OK);
    dar_tensor wf = random_tensor(DAR_F32, DAR_SHAPE(N, K), 1), w = quantised(&wf, w_value);
    dar_tensor x = random_tensor(type, DAR_SHAPE(M, K), 2), seed = random_tensor(DAR_F32, DAR_SHAPE(M, N), 3);
    dar_tensor gx = dar_tensor_push(&arena, DAR_F32, x.shape);
    dar_tensor_fill(&gx, 0);
    for (size_t i = 0; i < M; i++) {
        int8_t q[K];
        float s = dar_row_quantise(type, dar_tensor_at(&x, i * K), K, q);
        for (size_t j = 0; j < K; j++)
            x_value[i * K + j] = quantise ? (double)q[j] * s : dar_dtype_get(type, x.data, i * K + j);
    }
    dar_val *y = dar_linear(&t, dar_leaf(&t, x, &gx), dar_leaf(&t, w, NULL), NULL,
                            &(dar_linear_opt){ .quantise = quantise, .cast = true, .out = DAR_F32 });
    dar_backward(&t, y, &seed);

    /* bf16 rounds w and gy once; f32 only sums, and 8 bits only scale. */
    double unit = type == DAR_BF16 ? 0x1p-8 : FLT_EPSILON;
    for (size_t i = 0; i < M; i++)
        for (size_t j = 0; j < N; j++) {
            double sum = 0, size = 0;
            for (size_t k = 0; k < K; k++) {
                sum += x_value[i * K + k] * w_value[j * K + k];
                size += fabs(x_value[i * K + k] * w_value[j * K + k]);
            }
            double bound = (quantise ? 0 : unit) * size + FLT_EPSILON * (K + 8) * size;
            CHECK_NEAR("y", ((float *)y->x.data)[i * N + j], sum, bound);
        }
    for (size_t i = 0; i < M; i++)
        for (size_t k = 0; k < K; k++) {
            double sum = 0, size = 0;
            for (size_t j = 0; j < N; j++) {
                double g = ((float *)seed.data)[i * N + j] * w_value[j * K + k];
                sum += g;
                size += fabs(g);
            }
            CHECK_NEAR("gx", ((float *)gx.data)[i * K + k], sum, (2 * unit + FLT_EPSILON * (N + 8)) * size);
        }
    dar_tape_free(&t);
    dar_arena_free(&arena);
}

static void eight_bit_weights(void **state)
{
    unsigned level[5];
    (void)state;
    for (int i = 0, n = test_levels(level); i < n; i++) {
        dar_cpu_init(level[i]);
        for (int v = 0; v < 4; v++) check(v & 1 ? DAR_BF16 : DAR_F32, v & 2);
    }
    dar_cpu_init(DAR_CPU_ALL);
}

int main(void)
{
    const struct CMUnitTest tests[] = { cmocka_unit_test(eight_bit_weights) };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
