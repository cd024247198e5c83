/* test_rng.c: known answers, moments, threads, rounding at random, and PyTorch's stream. */
#include "tests/test.h"

#include "lib/json.h"
#include "lib/kern.h"
#include "lib/rng.h"
#include "lib/rng_torch.h"

/* From the distribution of Random123 1.14, kat_vectors. */
static void known_answers(void **state)
{
    (void)state;
    static const struct {
        uint32_t counter[4], key[2], out[4];
    } kat[] = {
        { { 0, 0, 0, 0 }, { 0, 0 }, { 0x6627e8d5, 0xe169c58d, 0xbc57ac4c, 0x9b00dbd8 } },
        { { 0xffffffff, 0xffffffff, 0xffffffff, 0xffffffff },
          { 0xffffffff, 0xffffffff },
          { 0x408f276d, 0x41c83b0e, 0xa20bc7c6, 0x6d5451fd } },
        { { 0x243f6a88, 0x85a308d3, 0x13198a2e, 0x03707344 },
          { 0xa4093822, 0x299f31d0 },
          { 0xd16cfe09, 0x94fdcceb, 0x5001e420, 0x24126ea1 } },
    };
    for (size_t i = 0; i < DAR_COUNT(kat); i++) {
        uint32_t out[4];
        dar_rng_philox(kat[i].counter, kat[i].key, out);
        assert_memory_equal(out, kat[i].out, sizeof out);
    }
    uint64_t seed = 0x299f31d0a4093822, stream = 0x0370734413198a2e, block = 0x85a308d3243f6a88 & ~(3ull << 62);
    uint32_t out[4], counter[4] = { (uint32_t)block, (uint32_t)(block >> 32), 0x13198a2e, 0x03707344 };
    dar_rng_philox(counter, kat[2].key, out);
    for (uint64_t i = 0; i < 4; i++) assert_int_equal(dar_rng_u32(seed, stream, 4 * block + i), out[i]);
    assert_true(dar_rng_u64(seed, stream, 2 * block + 1) == ((uint64_t)out[3] << 32 | out[2]));
    assert_true(dar_rng_stream("a") == 0xaf63dc4c8601ec8cu);
}

static void ranges(void **state)
{
    (void)state;
    size_t count[7] = { 0 };
    for (uint64_t i = 0; i < 70000; i++) {
        double x = dar_rng_f64(1, 2, i), y = dar_rng_f32(1, 2, i);
        CHECK(x >= 0 && x < 1 && y >= 0 && y < 1, "%.17g, %.17g at %llu", x, y, (unsigned long long)i);
        uint64_t k = dar_rng_below(1, 2, i, 7);
        assert_true(k < 7);
        count[k]++;
        CHECK(k == (uint64_t)(7 * x) || fabs(7 * x - round(7 * x)) < 1e-9, "below 7: %llu, %.17g",
              (unsigned long long)k, x);
    }
    for (int k = 0; k < 7; k++) CHECK_NEAR("share of 7", (double)count[k], 10000, 5 * sqrt(10000 * 6 / 7.0));
    uint64_t big = dar_rng_below(1, 2, 3, UINT64_MAX), whole = dar_rng_u64(1, 2, 3);
    assert_true(big == whole - 1 || big == whole);
}

/* cos (k = 0) or sin (k = 1) of 2 pi v in long double; quarters of a turn are taken off exactly. */
static long double turn(long double v, uint64_t k)
{
    long double quarters = roundl(4 * v), a = (4 * v - quarters) * acosl(0);
    switch (((int)quarters + 4 - (int)k) % 4) {
    case 0: return cosl(a);
    case 1: return -sinl(a);
    case 2: return -cosl(a);
    default: return sinl(a);
    }
}

static void normal_formula(void **state)
{
    (void)state;
    for (uint64_t i = 0; i < 200000; i++) {
        uint64_t a = dar_rng_u64(7, 8, 2 * i) >> 11, b = dar_rng_u64(7, 8, 2 * i + 1) >> 11;
        long double r = sqrtl(-2 * logl((long double)(a + 1) * 0x1p-53L));
        for (uint64_t k = 0; k < 2; k++) {
            long double x = r * turn((long double)b * 0x1p-53L, k), y = dar_rng_normal(7, 8, 2 * i + k);
            double off = (double)(fabsl(x - y) / (fabsl(x) * 0x1p-52L));
            CHECK(off <= 3, "normal: off by %.2f of 2^-52 relative", off);
        }
    }
}

/* Mean 0 +- 5 / sqrt n; variance 1 +- 5 sqrt(2 / n); fourth moment 3 +- 5 sqrt(96 / n). */
static void moments(void **state)
{
    (void)state;
    size_t n = 1 << 20;
    double *p = malloc(n * sizeof *p), m1 = 0, m2 = 0, m4 = 0, pairs = 0, least = 1, most = 0;
    dar_tensor x = dar_tensor_of(DAR_F64, DAR_SHAPE(1 << 20), p);
    dar_rng_fill_normal(&x, 3, 4, 2);
    for (size_t i = 0; i < n; i++) {
        double y = p[i] / 2;
        m1 += y;
        m2 += y * y;
        m4 += y * y * y * y;
        if (i) pairs += y * p[i - 1] / 2;
    }
    double root = sqrt((double)n);
    CHECK_NEAR("mean", m1 / (double)n, 0, 5 / root);
    CHECK_NEAR("variance", m2 / (double)n, 1, 5 * sqrt(2) / root);
    CHECK_NEAR("fourth moment", m4 / (double)n, 3, 5 * sqrt(96) / root);
    CHECK_NEAR("neighbours", pairs / (double)n, 0, 5 / root);
    dar_rng_fill_uniform(&x, 3, 5, -1, 3);
    m1 = 0;
    for (size_t i = 0; i < n; i++) {
        m1 += p[i];
        least = fmin(least, p[i]);
        most = fmax(most, p[i]);
    }
    CHECK_NEAR("uniform mean", m1 / (double)n, 1, 5 * 4 / sqrt(12) / root);
    CHECK(least >= -1 && least < -0.999 && most <= 3 && most > 2.999, "from %g to %g", least, most);
    free(p);
}

static void fills(void **state)
{
    (void)state;
    static const int threads[] = { 1, 2, 3, 7 };
    static const dar_dtype types[] = { DAR_F64, DAR_F32, DAR_BF16, DAR_F16 };
    size_t n = 200003;
    int before = dar_threads();
    char *p = malloc(8 * n), *first = malloc(8 * n);
    for (size_t t = 0; t < DAR_COUNT(types); t++) {
        dar_tensor x = dar_tensor_of(types[t], DAR_SHAPE((int64_t)n), p);
        for (size_t k = 0; k < DAR_COUNT(threads); k++) {
            dar_threads_set(threads[k]);
            memset(p, 0xff, 8 * n);
            dar_rng_fill_normal(&x, 5, 6, 0.02);
            if (!k) memcpy(first, p, 8 * n);
            CHECK(memcmp(first, p, 8 * n) == 0, "%s: other bits with %d threads", dar_dtype_name(types[t]), threads[k]);
        }
        for (size_t i = 0; i < n; i += 997) { /* the same numbers in every precision, and element by element */
            unsigned char one[8];
            dar_dtype_set(types[t], one, 0, 0.02 * dar_rng_normal(5, 6, i));
            CHECK_NEAR("element", dar_dtype_get(types[t], p, i), dar_dtype_get(types[t], one, 0), 0);
        }
    }
    dar_tensor x = dar_tensor_of(DAR_F64, DAR_SHAPE(5), p);
    dar_rng_fill_uniform(&x, 5, 6, 2, 4);
    for (size_t i = 0; i < 5; i++) CHECK_NEAR("uniform", ((double *)p)[i], 2 + 2 * dar_rng_f64(5, 6, i), 0);
    dar_threads_set(before);
    free(first);
    free(p);
}

/* ---------------------------------------------------------------- tests/fixtures/torch_rng.json */

static void check_values(dar_json call, const dar_tensor *x)
{
    char hash[20];
    size_t i = 0, bytes = dar_tensor_bytes(x);
    dar_json values = dar_json_get(call, "values");
    for (dar_json v = dar_json_first(values); v.item; v = dar_json_next(v), i++) {
        double expected = strtod(dar_json_text(v, NULL, NULL), NULL), found = dar_dtype_get(x->dtype, x->data, i);
        bool bits = x->dtype == DAR_F32 && dar_tensor_count(x) >= 16;
        double ulp = x->dtype == DAR_F32 ? 0x1p-23 : 0x1p-52;
        CHECK_NEAR(x->dtype == DAR_F32 ? "randn f32" : "randn f64", found, expected,
                   bits ? 0 : 4 * ulp * fabs(expected));
    }
    if (values.item) {
        assert_int_equal(i, dar_tensor_count(x));
        return;
    }
    uint64_t h = 0xcbf29ce484222325u;
    for (const unsigned char *p = x->data; bytes; bytes--) h = (h ^ *p++) * 0x100000001b3u;
    snprintf(hash, sizeof hash, "%016llx", (unsigned long long)h);
    assert_string_equal(hash, dar_json_text(call, "hash", NULL));
}

static void torch_stream(void **state)
{
    (void)state;
    static const char *const types[] = { "f32", "f64", NULL };
    static const int threads[] = { 1, 3 };
    dar_json_doc *doc;
    dar_err e;
    int before = dar_threads(), calls = 0;
    double *p = malloc(100003 * sizeof *p);
    CHECK(dar_json_open(&doc, "tests/fixtures/torch_rng.json", &e) == DAR_OK, "%s", e.text);
    for (int k = 0; k < 2; k++) {
        dar_threads_set(threads[k]);
        for (dar_json run = dar_json_first(dar_json_root(doc)); run.item; run = dar_json_next(run)) {
            dar_rng_torch g;
            dar_rng_torch_seed(&g, (uint64_t)dar_json_int(run, "seed", DAR_JSON_NEEDED, 0, DAR_JSON_MAX_INT));
            for (dar_json c = dar_json_first(dar_json_array(run, "calls")); c.item; c = dar_json_next(c), calls++) {
                dar_dtype type = dar_json_choice(c, "dtype", -1, types) == 1 ? DAR_F64 : DAR_F32;
                dar_tensor x = dar_tensor_of(type, DAR_SHAPE(dar_json_int(c, "n", DAR_JSON_NEEDED, 1, 100003)), p);
                dar_rng_torch_normal(&g, &x);
                check_values(c, &x);
            }
        }
    }
    dar_threads_set(before);
    CHECK(dar_json_finish(doc, &e) == DAR_OK, "%s", e.text);
    assert_int_equal(calls, 2 * 16);
    dar_json_close(doc);
    free(p);
}

/* Blocks in rows are the same blocks at every level of the processor, also where the index carries into its upper half,
 * and none is written beyond the last. */
static void rows_of_blocks(void **state)
{
    (void)state;
    static const uint64_t at[] = { 0, 5, 0xfffffffd, 0xffffffffffffff00 };
    unsigned level[5];
    for (int l = 0; l < test_levels(level); l++) {
        dar_cpu_init(level[l]);
        for (size_t i = 0; i < DAR_COUNT(at); i++)
            for (size_t n = 1; n <= 19; n++) {
                uint32_t x[4 * 19 + 1], want[4];
                x[4 * n] = 77;
                dar_kern_for(DAR_F32)->philox(n, 0x123456789abcdef, 0xfedcba9876543210, at[i], x);
                for (size_t k = 0; k < n; k++) {
                    uint64_t index = at[i] + k;
                    dar_rng_philox((uint32_t[]){ (uint32_t)index, (uint32_t)(index >> 32), 0x76543210, 0xfedcba98 },
                                   (uint32_t[]){ 0x89abcdef, 0x1234567 }, want);
                    assert_memory_equal(x + 4 * k, want, sizeof want);
                }
                assert_int_equal(x[4 * n], 77);
            }
    }
    dar_cpu_init(DAR_CPU_ALL);
}

/* Of the 2^16 random halves exactly as many carry as there are units cut off: the mean is x, whatever x is. */
static void dithered(void **state)
{
    (void)state;
    static const float xs[] = { 0, 1, -1, 1.00390625f, 1.001f, -1.001f, 3.1e-38f, 1e-40f, -1e-45f, 3e38f, 0x1.8p-20f };
    static uint32_t random[65536 + 7];
    static float x[65536 + 7];
    static uint16_t y[65536 + 7];
    unsigned level[5];
    for (int l = 0; l < test_levels(level); l++) {
        dar_cpu_init(level[l]);
        for (size_t i = 0; i < DAR_COUNT(random); i++) random[i] = (uint32_t)i * 40503 % 65536 | (uint32_t)i << 16;
        for (size_t k = 0; k < DAR_COUNT(xs); k++)
            for (int half = 0; half < 2; half++) {
                uint32_t bits, ups = 0;
                memcpy(&bits, &xs[k], sizeof bits);
                for (size_t i = 0; i < DAR_COUNT(x); i++) x[i] = xs[k];
                dar_kern_for(DAR_F32)->dither(65536, random, half, x, y);
                for (size_t i = 0; i < 65536; i++) ups += y[i] != bits >> 16;
                assert_int_equal(ups, bits & 0xffff);
                for (size_t i = 0; i < 65536; i++) assert_in_range(y[i], bits >> 16, (bits >> 16) + 1);
            }
        /* Among others, at every place of a vector. */
        for (size_t i = 0; i < DAR_COUNT(x); i++) x[i] = 1;
        for (size_t i = 0; i < 64; i++) {
            x[17 * i + 3] = i % 3 == 0 ? NAN : i % 3 == 1 ? INFINITY : -INFINITY;
            random[17 * i + 3] = UINT32_MAX;
        }
        y[17 * 64] = 9;
        dar_kern_for(DAR_F32)->dither(17 * 64, random, 1, x, y);
        for (size_t i = 0; i < 17 * 64; i++) {
            float z = dar_bf16_to_f32(y[i]);
            CHECK(z == x[i] || (isnan(z) && isnan(x[i])), "level %d, %zu: found %g, expected %g", l, i, (double)z,
                  (double)x[i]);
        }
        assert_int_equal(y[17 * 64], 9);
    }
    dar_cpu_init(DAR_CPU_ALL);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(known_answers),  cmocka_unit_test(ranges),   cmocka_unit_test(normal_formula),
        cmocka_unit_test(moments),        cmocka_unit_test(fills),    cmocka_unit_test(torch_stream),
        cmocka_unit_test(rows_of_blocks), cmocka_unit_test(dithered),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
