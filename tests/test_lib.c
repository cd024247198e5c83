/* test_lib.c: the foundation: arenas, shapes, types, threads. */
#include "tests/test.h"

#include "lib/arena.h"
#include "lib/dtype.h"
#include "lib/tensor.h"

static void arena_marks(void **state)
{
    dar_arena a;
    (void)state;
    assert_int_equal(dar_arena_init(&a, "test", 1000, NULL), DAR_OK);
    dar_mark m = dar_arena_mark(&a);
    char *p = dar_arena_push(&a, 100), *q = dar_arena_push(&a, 1);
    assert_int_equal((uintptr_t)p % DAR_ALIGN, 0);
    assert_int_equal(q - p, 128);
    dar_arena_reset(&a, m);
    assert_ptr_equal(dar_arena_push(&a, 1), p);
    assert_int_equal(a.peak, 192);
    CHECK_ABORTS(dar_arena_push(&a, a.size));
    CHECK_ABORTS(dar_arena_push(&a, SIZE_MAX));
    dar_arena_free(&a);
    dar_arena_free(&a);
}

static void plan_counts(void **state)
{
    dar_arena a;
    (void)state;
    assert_int_equal(dar_arena_init_plan(&a, "plan", NULL), DAR_OK);
    dar_tensor_push(&a, DAR_F32, DAR_SHAPE(1 << 20, 1 << 10)); /* 4 GiB that nobody has */
    assert_int_equal(a.peak, (size_t)1 << 32);
    dar_arena_free(&a);
}

static void f16_all(void **state)
{
    (void)state;
    for (uint32_t h = 0; h < 65536; h++) {
        float x = dar_f16_to_f32((uint16_t)h);
        uint16_t back = dar_f16_from_f32(x);
        if (isnan(x)) CHECK((back & 0x7fff) > 0x7c00, "f16 %04x: NaN came back as %04x", h, back);
        else CHECK(back == h, "f16 %04x: came back as %04x", h, back);
        uint16_t b = dar_bf16_from_f32(dar_bf16_to_f32((uint16_t)h));
        CHECK(b == h || isnan(dar_bf16_to_f32((uint16_t)h)), "bf16 %04x: came back as %04x", h, b);
    }
    assert_int_equal(dar_f16_from_f32(65519.996f), 0x7bff);
    assert_int_equal(dar_f16_from_f32(65520.0f), 0x7c00);
    assert_int_equal(dar_f16_from_f32(0x1.8p-25f), 1);
    assert_int_equal(dar_f16_from_f32(0x1p-25f), 0); /* half of the smallest: to even */
    assert_int_equal(dar_bf16_from_f32(1.00390625f), 0x3f80);
    assert_int_equal(dar_bf16_from_f32(1.01171875f), 0x3f82);
}

static double ones(void *ctx, size_t begin, size_t end)
{
    (void)ctx;
    double s = 0;
    for (size_t i = begin; i < end; i++) s += 1.0 / (double)(i + 1);
    return s;
}

static void sums_ignore_threads(void **state)
{
    (void)state;
    int before = dar_threads();
    static const size_t sizes[] = { 0, 1, 4095, 4096, 4097, 1 << 20, (1 << 21) + 17 };
    for (size_t i = 0; i < DAR_COUNT(sizes); i++) {
        double first = 0;
        static const int threads[] = { 1, 2, 3, 7 };
        for (size_t k = 0; k < DAR_COUNT(threads); k++) {
            dar_threads_set(threads[k]);
            double s = dar_parallel_sum(sizes[i], 4096, ones, NULL);
            if (!k) first = s;
            CHECK(memcmp(&s, &first, sizeof s) == 0, "sum of %zu: %.17g with %d threads, %.17g with 1", sizes[i], s,
                  threads[k], first);
        }
        CHECK_NEAR("harmonic sum", first, ones(NULL, 0, sizes[i]), 1e-10);
    }
    dar_threads_set(before);
}

static void copies(void **state)
{
    (void)state;
    float x[2 * 3 * 5];
    uint16_t y[5 * 2 * 3];
    for (int i = 0; i < 30; i++) x[i] = (float)i;
    dar_tensor a = dar_tensor_of(DAR_F32, DAR_SHAPE(2, 3, 5), x), b = dar_tensor_of(DAR_BF16, DAR_SHAPE(5, 2, 3), y);
    dar_tensor v = dar_tensor_permute(&a, (int[]){ 2, 0, 1 });
    dar_tensor_copy(&b, &v);
    for (int i = 0; i < 5; i++)
        for (int j = 0; j < 2; j++)
            for (int k = 0; k < 3; k++)
                CHECK_NEAR("permuted", dar_bf16_to_f32(y[(i * 2 + j) * 3 + k]), x[(j * 3 + k) * 5 + i], 0);
    dar_tensor_add(&b, &v);
    CHECK_NEAR("added", dar_bf16_to_f32(y[29]), 58, 0);
    dar_tensor_fill(&b, 3);
    CHECK_NEAR("filled", dar_bf16_to_f32(y[17]), 3, 0);
    CHECK_ABORTS(dar_tensor_copy(&b, &a));
    x[7] = NAN;
    assert_int_equal(dar_tensor_nonfinite(&a), 7);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(arena_marks),         cmocka_unit_test(plan_counts), cmocka_unit_test(f16_all),
        cmocka_unit_test(sums_ignore_threads), cmocka_unit_test(copies),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
