/* test_stress.c: the places where numbers break, one test each: numbers far too large, too small, or not numbers, sums
 * too long for their type, sizes too large for an int.  What is asked is a right answer, not merely a finite one.
 *
 * With the argument "full" (make stress) those follow that need gigabytes of memory. */
#include "tests/test.h"

#include <sys/mman.h>

#include "autograd/ops.h"
#include "lib/gemm.h"
#include "lib/kern.h"

static dar_arena arena;
static dar_tape tape;

static int setup(void **state)
{
    (void)state;
    dar_arena_reset(&arena, 0);
    dar_tape_clear(&tape);
    tape.check_finite = false;
    return 0;
}

/* A leaf of f32 values; g: with a zeroed gradient. */
static dar_val *leaf(dar_shape s, const float *values, bool g)
{
    dar_tensor x = dar_tensor_push(&arena, DAR_F32, s), gx = { 0 };
    if (values) memcpy(x.data, values, dar_tensor_bytes(&x));
    if (g) {
        gx = dar_tensor_push(&arena, DAR_F32, s);
        dar_tensor_fill(&gx, 0);
    }
    return dar_leaf(&tape, x, g ? &gx : NULL);
}

/* Backward from ones. */
static void sweep(dar_val *y)
{
    dar_tensor seed = dar_tensor_push(&arena, dar_compute_type(y->x.dtype), y->x.shape);
    dar_tensor_fill(&seed, 1);
    dar_backward(&tape, y, &seed);
}

static double at(const dar_tensor *x, size_t i)
{
    return dar_dtype_get(x->dtype, x->data, i);
}

/* ---------------------------------------------------------------- the compiler */

/* a b + c rounded twice, though the processor could do it with one rounding. */
#if defined __x86_64__
__attribute__((noinline, target("fma")))
#else
__attribute__((noinline))
#endif
static double
product_sum(double a, double b, double c)
{
    return a * b + c;
}

/* Error of a + b.  Source: Knuth, TAOCP 2, 4.2.2, theorem B. */
static double two_sum_error(double a, double b)
{
    double s = a + b, bb = s - a;
    return (a - (s - bb)) + (b - bb);
}

static void flags_keep_arithmetic(void **state)
{
    (void)state;
    volatile double zero = 0, one = 1, tiny = 0x1p-60;
    volatile float least = 0x1p-149f;

    CHECK(isnan(zero / zero) && !(zero / zero == zero / zero), "0/0 is not seen as NaN");
    CHECK(isinf(one / zero) && !isfinite(one / zero), "1/0 is not seen as infinite");
    CHECK(signbit(-zero) && 1 / -zero == -INFINITY, "-0 lost its sign");
    CHECK(least * 2 == 0x1p-148f && least > 0, "denormals flush to zero");
    CHECK_NEAR("(1 + tiny) - 1 by TwoSum", two_sum_error(one, tiny), 0x1p-60, 0);
    CHECK((one + tiny) - one == 0, "addition was reassociated");

    /* (1 + 2^-30)^2 = 1 + 2^-29 + 2^-60: the last term survives only in a fused operation. */
    if (dar_cpu_detect() & DAR_CPU_AVX2) {
        volatile double x = 1 + 0x1p-30;
        CHECK_NEAR("contracted product", product_sum(x, x, -(1 + 0x1p-29)), 0, 0);
    }

    /* Kahan: a million times 1e-8 onto 1, each below half a ulp of f32. */
    float sum = 1, carry = 0;
    for (int i = 0; i < 1000000; i++) {
        volatile float term = 1e-8f;
        float y = term - carry, t = sum + y;
        carry = (t - sum) - y;
        sum = t;
    }
    CHECK_NEAR("Kahan sum", sum, 1.01, 1.2e-7);
}

/* ---------------------------------------------------------------- denormals */

struct denormals {
    float out[64];
    unsigned mode[64];
};

static void halve(void *ctx, size_t i, int thread)
{
    struct denormals *d = ctx;
    volatile float x = 0x1p-126f; /* least normal number */
    (void)thread;
    d->out[i] = x / 8;
#if defined __x86_64__
    d->mode[i] = __builtin_ia32_stmxcsr() & 0x8040; /* flush to zero, denormals are zero */
#endif
}

/* On every thread, after every kind of work, for every CPU level. */
static void denormals_survive(void **state)
{
    (void)state;
    unsigned level[5], all = dar_cpu_flags();
    int before = dar_threads(), levels = test_levels(level);
    enum { N = 1 << 16 };
    dar_tensor x = dar_tensor_push(&arena, DAR_F32, DAR_SHAPE(N));
    float *v = x.data;
    for (int i = 0; i < N; i++) v[i] = (float)(i + 1) * 0x1p-145f;

    for (int l = 0; l < levels; l++) {
        dar_cpu_init(level[l]);
        dar_threads_set(7);
        dar_val *y = dar_silu(&tape, dar_leaf(&tape, x, NULL)); /* x/2 + x^2/4: x/2 here, to half a unit */
        for (size_t i = 0; i < N; i++) CHECK_NEAR("silu of a denormal", at(&y->x, i), 0.5 * at(&x, i), 0x1p-149);
        struct denormals d = { 0 };
        dar_parallel(64, halve, &d);
        for (int i = 0; i < 64; i++)
            CHECK(d.out[i] == 0x1p-129f && !d.mode[i], "task %d: denormals flush to zero (mode %x)", i, d.mode[i]);
    }
    dar_threads_set(before);
    dar_cpu_init(all);
}

/* ---------------------------------------------------------------- NaN and infinity have an address */

static void bad_numbers_are_named(void **state)
{
    (void)state;
    static const float bad[] = { NAN, INFINITY, -INFINITY };
    for (size_t i = 0; i < DAR_COUNT(bad); i++) {
        float x[37] = { 0 };
        x[31] = bad[i];
        setup(NULL);
        tape.check_finite = true;
        dar_val *y = dar_silu(&tape, dar_contiguous(&tape, leaf(DAR_SHAPE(37), x, true)));
        CHECK(tape.bad_op && strcmp(tape.bad_op, "contiguous") == 0 && !tape.bad_backward && tape.bad_index == 31,
              "%g: reported %s at %lld", bad[i], tape.bad_op ? tape.bad_op : "nothing", (long long)tape.bad_index);
        (void)y;
    }

    /* A gradient that overflows is named as one. */
    float x[3] = { 1, 2, 3 };
    setup(NULL);
    tape.check_finite = true;
    dar_val *y = dar_silu(&tape, leaf(DAR_SHAPE(3), x, true));
    CHECK(!tape.bad_op, "finite numbers reported as bad by %s", tape.bad_op);
    dar_tensor seed = dar_tensor_push(&arena, DAR_F32, DAR_SHAPE(3));
    dar_tensor_fill(&seed, 3.2e38);
    dar_backward(&tape, y, &seed); /* silu'(2) = 1.09 */
    CHECK(tape.bad_op && strcmp(tape.bad_op, "silu") == 0 && tape.bad_backward && tape.bad_index == 1,
          "overflow in backward: reported %s at %lld", tape.bad_op ? tape.bad_op : "nothing",
          (long long)tape.bad_index);
}

/* ---------------------------------------------------------------- softmax, inside attention */

/* Attention of one head of size E over given keys and values, gradient of ones.  Leaves: x[0] q, x[1] k, x[2] v. */
static dar_val *attend(dar_val *x[3], int64_t queries, int64_t keys, int64_t E, const float *q, const float *k,
                       const float *v, const float *log_weight)
{
    dar_val *lw = log_weight ? leaf(DAR_SHAPE(keys), log_weight, false) : NULL;
    x[0] = leaf(DAR_SHAPE(1, queries, E), q, true);
    x[1] = leaf(DAR_SHAPE(1, keys, E), k, true);
    x[2] = leaf(DAR_SHAPE(1, keys, E), v, true);
    dar_val *y =
        dar_attention(&tape, x[0], x[1], x[2], &(dar_attention_opt){ .heads = 1, .scale = 1, .log_weight = lw });
    sweep(y);
    return y;
}

static void check_all(const char *what, const dar_tensor *x, double expected, double bound)
{
    for (size_t i = 0; i < dar_tensor_count(x); i++) CHECK_NEAR(what, at(x, i), expected, bound);
}

/* Logits of +-1e4: the two largest share everything, the others get nothing. */
static void logits_of_ten_thousand(void **state)
{
    (void)state;
    enum { K = 37 };
    float q[2] = { 100, 0 }, k[K][2] = { { 0 } }, v[K][2];
    for (int j = 0; j < K; j++) {
        k[j][0] = j % 2 ? -100 : 99;
        v[j][0] = v[j][1] = (float)j;
    }
    k[4][0] = k[20][0] = 100; /* 1e4 against 9.9e3 and -1e4 */
    dar_val *x[3], *y = attend(x, 1, K, 2, q, k[0], v[0], NULL);
    check_all("mean of the two", &y->x, 12, 0);
    for (int j = 0; j < K; j++)
        CHECK_NEAR("weight", at(&x[2]->g, (size_t)(2 * j)), j == 4 || j == 20 ? 0.5 : 0, 1e-43); /* exp(-100) */
    /* l_4 = l_20 = l: gradient of q is sum_j p_j (v_j - y) k_j = 100 (0.5 (4 - 12) + 0.5 (20 - 12)) 2 = 0 */
    check_all("gradient of q", &x[0]->g, 0, 1e-3);
    for (int j = 0; j < K; j++)
        CHECK_NEAR("gradient of k", at(&x[1]->g, (size_t)(2 * j)), j == 4 ? -800 : j == 20 ? 800 : 0, 1e-3);
}

/* Without any key there is nothing to attend to: zeros, and nobody learns from it. */
static void masked_rows_are_zero(void **state)
{
    (void)state;
    enum { K = 67, E = 8 };
    float q[5 * E], k[K * E], v[K * E], lw[K];
    for (int i = 0; i < 5 * E; i++) q[i] = sinf((float)i);
    for (int i = 0; i < K * E; i++) k[i] = 3 * sinf((float)(i + 100)), v[i] = cosf((float)i);
    for (int j = 0; j < K; j++) lw[j] = -INFINITY;
    dar_val *x[3], *y = attend(x, 5, K, E, q, k, v, lw);
    check_all("masked row", &y->x, 0, 0);
    for (int i = 0; i < 3; i++) check_all("gradient of a masked row", &x[i]->g, 0, 0);

    /* All keys but one: its value, whatever the logit. */
    lw[40] = -3;
    y = attend(x, 5, K, E, q, k, v, lw);
    for (size_t i = 0; i < 5 * E; i++) CHECK_NEAR("the one key", at(&y->x, i), v[40 * E + (int)(i % E)], 0);
    check_all("gradient of q", &x[0]->g, 0, 1e-5);
    for (size_t i = 0; i < K * E; i++)
        CHECK_NEAR("gradient of v", at(&x[2]->g, i), i / E == 40 ? 5 : 0, 0); /* five queries */
}

/* Padding of a prompt: equal keys, one by one or folded into one with log n. */
static void equal_keys_fold(void **state)
{
    (void)state;
    enum { SAME = 512, OTHER = 3, K = SAME + OTHER, E = 16 };
    float q[7 * E], k[K * E], v[K * E], lw[1 + OTHER] = { logf(SAME) };
    for (int i = 0; i < 7 * E; i++) q[i] = sinf((float)i);
    for (int i = 0; i < K * E; i++) k[i] = cosf((float)i), v[i] = sinf((float)(3 * i));
    for (int j = 1; j < SAME; j++) {
        memcpy(k + j * E, k, E * sizeof *k);
        memcpy(v + j * E, v, E * sizeof *v);
    }
    dar_val *x[3], *z[3];
    dar_val *y = attend(x, 7, K, E, q, k, v, NULL);
    dar_val *folded = attend(z, 7, 1 + OTHER, E, q, k + (SAME - 1) * E, v + (SAME - 1) * E, lw);
    /* (K + 8) roundings of the sum and as many of log n: |v| <= 1 */
    double bound = (K + 8) * 0x1p-24;
    for (size_t i = 0; i < 7 * E; i++) CHECK_NEAR("folded", at(&folded->x, i), at(&y->x, i), bound);
    for (size_t i = 0; i < 7 * E; i++)
        CHECK_NEAR("gradient of q, folded", at(&z[0]->g, i), at(&x[0]->g, i), 2 * E * bound);

    y = attend(x, 7, SAME, E, q, k, v, NULL);
    for (size_t i = 0; i < 7 * E; i++) CHECK_NEAR("512 equal keys", at(&y->x, i), v[i % E], bound);
    y = attend(x, 7, 1, E, q, k, v, NULL);
    for (size_t i = 0; i < 7 * E; i++) CHECK_NEAR("one key", at(&y->x, i), v[i % E], 0);
    check_all("gradient of q, one key", &x[0]->g, 0, 1e-5);
}

/* The same as an op of its own. */
static void softmax_alone(void **state)
{
    (void)state;
    enum { N = 513 };
    float x[N];
    for (int i = 0; i < N; i++) x[i] = i % 2 ? -1e4f : 1e4f - 200;
    x[0] = x[100] = 1e4f;
    dar_val *in = leaf(DAR_SHAPE(1, N), x, true), *y = dar_softmax(&tape, in, NULL);
    for (size_t i = 0; i < N; i++) CHECK_NEAR("logits of 1e4", at(&y->x, i), i == 0 || i == 100 ? 0.5 : 0, 0x1p-149);
    sweep(y); /* the sum of a softmax does not move */
    check_all("gradient of ones", &in->g, 0, 0x1p-22);

    for (int i = 0; i < N; i++) x[i] = 88;
    y = dar_softmax(&tape, leaf(DAR_SHAPE(1, 512), x, false), NULL);
    check_all("512 equal logits", &y->x, 1.0 / 512, 0);

    for (int i = 0; i < N; i++) x[i] = -INFINITY;
    in = leaf(DAR_SHAPE(1, N), x, true);
    y = dar_softmax(&tape, in, NULL);
    check_all("masked row", &y->x, 0, 0);
    sweep(y);
    check_all("gradient of a masked row", &in->g, 0, 0);
    y = dar_softmax(&tape, leaf(DAR_SHAPE(3, 1), (float[]){ -1e4f, 0, 3e38f }, false), NULL);
    check_all("one key", &y->x, 1, 0);
}

/* ---------------------------------------------------------------- norms */

/* 1e4 + tiny: the mean has all the digits that x has, the spread a few of the last. */
static void norms_far_from_zero(void **state)
{
    (void)state;
    enum { D = 3072 };
    static float x[D];
    dar_norm_opt o = { .eps = 1e-6 };
    long double mean = 0, square = 0, spread = 0;
    for (int i = 0; i < D; i++) x[i] = 1e4f + (float)(i * 37 % 11 - 5) * 0x1p-10f; /* units of the last place */
    for (int i = 0; i < D; i++) mean += x[i] / (long double)D, square += (long double)x[i] * x[i] / D;
    for (int i = 0; i < D; i++) spread += (x[i] - mean) * (x[i] - mean) / D;

    dar_val *in = leaf(DAR_SHAPE(1, D), x, true), *y = dar_layer_norm(&tape, in, NULL, NULL, &o);
    for (size_t i = 0; i < D; i++)
        CHECK_NEAR("layer norm of 1e4 + tiny", at(&y->x, i), (double)((x[i] - mean) / sqrtl(spread + 1e-6L)),
                   4 * 0x1p-23);
    sweep(y); /* of ones: a layer norm does not change when x moves as a whole; 1 / sqrt of the spread is 270 */
    check_all("gradient of a constant", &in->g, 0, 1e-3);

    in = leaf(DAR_SHAPE(1, D), x, true);
    y = dar_rms_norm(&tape, in, NULL, &o);
    for (size_t i = 0; i < D; i++)
        CHECK_NEAR("RMS norm of 1e4 + tiny", at(&y->x, i), (double)(x[i] / sqrtl(square + 1e-6L)), 4 * 0x1p-23);
}

/* eps keeps rows of zeros, and rows that do not vary, finite in both directions. */
static void norms_of_nothing(void **state)
{
    (void)state;
    enum { D = 37 };
    static const float value[] = { 0, 1e-30f, 3, -1e4f, 1e18f };
    dar_norm_opt o = { .eps = 1e-6 };
    for (size_t k = 0; k < DAR_COUNT(value); k++) {
        float x[D];
        for (int i = 0; i < D; i++) x[i] = value[k];
        double size = sqrt((double)value[k] * value[k] + 1e-6);

        dar_val *in = leaf(DAR_SHAPE(1, D), x, true), *y = dar_layer_norm(&tape, in, NULL, NULL, &o);
        check_all("layer norm of a constant row", &y->x, 0, 0);
        sweep(y); /* 1 / sqrt(eps) = 1000 times ones without their mean */
        check_all("gradient of a constant row", &in->g, 0, 1000 * 0x1p-23);

        in = leaf(DAR_SHAPE(1, D), x, true);
        y = dar_rms_norm(&tape, in, NULL, &o);
        check_all("RMS norm of a constant row", &y->x, value[k] / size, 0x1p-22);
        sweep(y); /* 1/r - x^2/r^3 = eps/r^3 for equal x */
        check_all("gradient of RMS norm", &in->g, 1e-6 / (size * size * size), 0x1p-20 / size);

        float w[D];
        for (int i = 0; i < D; i++) w[i] = 1;
        in = leaf(DAR_SHAPE(1, D, 1), x, true);
        y = dar_channel_norm(&tape, in, leaf(DAR_SHAPE(D), w, true));
        check_all("channel norm of a constant row", &y->x, value[k] / fmax(fabs(value[k]), 1e-12 / sqrt(D)), 0x1p-21);
        sweep(y);
        for (size_t i = 0; i < D; i++) CHECK(isfinite(at(&in->g, i)), "gradient of channel norm at %g", value[k]);
    }
}

/* ---------------------------------------------------------------- positions */

/* A frame far into a clip, rows and columns of a large picture; heads whose pairs do not divide by three. */
static void positions_stay_exact(void **state)
{
    (void)state;
    static const int64_t sizes[] = { 128, 64, 10, 2 };
    static const int64_t last[3] = { 1024, 3, 5 }; /* frames, rows, columns */
    for (size_t k = 0; k < DAR_COUNT(sizes); k++) {
        int64_t E = sizes[k], pairs[3], N = last[0] * last[1] * last[2];
        setup(NULL);
        dar_rope_axes(E, pairs);
        assert_int_equal(pairs[0] + pairs[1] + pairs[2], E / 2);
        if (E == 128) assert_true(pairs[0] == 22 && pairs[1] == 21 && pairs[2] == 21);

        dar_tensor table = dar_tensor_push(&arena, DAR_F32, DAR_SHAPE(N, E)),
                   x = dar_tensor_push(&arena, DAR_F32, DAR_SHAPE(1, N, E));
        dar_rope_table(&table, last[0], last[1], last[2], 10000);
        dar_tensor_fill(&x, 0);
        float *v = x.data;
        for (int64_t i = 0; i < E; i += 2) v[(N - 1) * E + i] = 1; /* turns into (cos, sin) */
        dar_val *y = dar_rope(&tape, dar_leaf(&tape, x, NULL), dar_leaf(&tape, table, NULL));
        int64_t i = 0;
        for (int axis = 0; axis < 3; axis++)
            for (int64_t p = 0; p < pairs[axis]; p++, i++) {
                long double a = (long double)(last[axis] - 1) * powl(10000, -(long double)p / (long double)pairs[axis]);
                size_t at_pair = (size_t)((N - 1) * E + 2 * i);
                CHECK_NEAR("cos", at(&y->x, at_pair), (double)cosl(a), 0x1p-24);
                CHECK_NEAR("sin", at(&y->x, at_pair + 1), (double)sinl(a), 0x1p-24);
            }
    }
}

/* ---------------------------------------------------------------- tails of activations */

struct activation {
    const char *name;
    dar_val *(*op)(dar_tape *t, dar_val *x);
    bool cubic; /* inner argument 2 sqrt(2/pi) (x + 0.044715 x^3), else x */
};

/* Both are x s(z), s the logistic function: the form that neither cancels nor overflows. */
static void exact(const struct activation *a, double x, double *y, double *slope, double *unit, double *unit_slope)
{
    double c = 2 * sqrt(2 / M_PI), z = a->cubic ? c * (x + 0.044715 * x * x * x) : x;
    double dz = a->cubic ? c * (1 + 3 * 0.044715 * x * x) : 1;
    double s = z < 0 ? exp(z) / (1 + exp(z)) : 1 / (1 + exp(-z)),
           rest = z < 0 ? 1 / (1 + exp(z)) : exp(-z) / (1 + exp(-z));
    double inner = isfinite(x) && s * rest > 0 ? x * dz * s * rest : 0;
    *y = s > 0 ? x * s : 0;
    *slope = s + inner;
    /* z in f32 is off by 2 |z| 2^-24, and so are exp(z) and what is made of it in relative size; a logistic function
     * below the normal numbers is off by 2^-149. */
    double relative = (2 * fabs(z) + 8) * 0x1p-24, least = 0x1p-148 * (1 + fabs(x) * (1 + fabs(dz)));
    *unit = relative * fabs(*y) + least;
    *unit_slope = relative * (s + fabs(inner)) + (isfinite(least) ? least : 0);
}

static void tails_stay_relative(void **state)
{
    (void)state;
    static const struct activation activations[] = { { "silu", dar_silu, false }, { "gelu", dar_gelu_tanh, true } };
    static const float far[] = { 89, 104, 500, 1e4f, 1e13f, 1e30f, 3e38f };
    enum { N = 2 * 60 * 64, FAR = 2 * DAR_COUNT(far) };
    static float x[N + FAR];

    for (int i = 0; i < N; i++) x[i] = (float)(i - N / 2) / 64;
    for (int i = 0; i < FAR; i++) x[N + i] = i % 2 ? -far[i / 2] : far[i / 2];
    for (size_t k = 0; k < DAR_COUNT(activations); k++) {
        const struct activation *a = &activations[k];
        setup(NULL);
        dar_val *in = leaf(DAR_SHAPE(N + FAR), x, true), *out = a->op(&tape, in);
        sweep(out);
        for (size_t i = 0; i < N + FAR; i++) {
            double y, slope, unit, unit_slope;
            char what[64];
            exact(a, x[i], &y, &slope, &unit, &unit_slope);
            snprintf(what, sizeof what, "%s(%g)", a->name, x[i]);
            CHECK_NEAR(what, at(&out->x, i), y, unit);
            snprintf(what, sizeof what, "slope of %s at %g", a->name, x[i]);
            CHECK_NEAR(what, at(&in->g, i), slope, unit_slope);
        }
        float ends[2] = { INFINITY, -INFINITY };
        dar_val *limit = a->op(&tape, leaf(DAR_SHAPE(2), ends, false));
        CHECK(at(&limit->x, 0) == INFINITY && at(&limit->x, 1) == 0, "%s: limits %g and %g", a->name, at(&limit->x, 0),
              at(&limit->x, 1));
    }
}

/* ---------------------------------------------------------------- the optimiser */

static const dar_adamw adamw_first = { .rate = 1e-3,
                                       .beta1 = 0.9,
                                       .beta2 = 0.999,
                                       .eps = 1e-8,
                                       .decay = 0.1,
                                       .fix1 = 1 / (1 - 0.9),
                                       .fix2 = 1 / (1 - 0.999),
                                       .scale = 1 };

static void adamw_corners(void **state)
{
    (void)state;
    unsigned level[5], all = dar_cpu_flags();
    int levels = test_levels(level);
    /* gradient, and what the first step should do to a weight of 1 beyond its decay */
    static const struct {
        float g;
        double step, bound;
    } corner[] = {
        { 0, 0, 0 },                /* only decay */
        { 1, -1e-3, 1e-9 },         /* m fix1 / sqrt(v fix2) = sign of g */
        { -1e18f, 1e-3, 1e-9 },     /* v = 1e33, near the top of f32 */
        { 1e-8f, -1e-3 / 2, 1e-9 }, /* as large as eps */
        { 1e-25f, -1e-20, 1e-26 },  /* g^2 is no f32: eps carries the division */
        { 0x1p-149f, 0, 1e-39 },    /* least number */
    };
    for (int l = 0; l < levels; l++) {
        dar_cpu_init(level[l]);
        for (size_t i = 0; i < DAR_COUNT(corner); i++) {
            enum { N = 21 };
            float w[N], m[N] = { 0 }, v[N] = { 0 }, g[N];
            char what[64];
            for (int k = 0; k < N; k++) w[k] = 0, g[k] = corner[i].g;
            snprintf(what, sizeof what, "first step of gradient %g, %s", corner[i].g, dar_kern_for(DAR_F32)->name);
            dar_kern_for(DAR_F32)->adamw(N, &adamw_first, w, m, v, g);
            for (int k = 0; k < N; k++) CHECK_NEAR(what, w[k], corner[i].step, corner[i].bound);
            for (int k = 0; k < N; k++)
                CHECK(isfinite(m[k]) && isfinite(v[k]) && v[k] >= 0, "%s: moments %g %g", what, m[k], v[k]);
        }
        /* Nothing to learn: the weight decays by exactly rate decay, for ever. */
        float w = 2, m = 0, v = 0, g = 0;
        for (int t = 0; t < 100; t++) dar_kern_for(DAR_F32)->adamw(1, &adamw_first, &w, &m, &v, &g);
        CHECK_NEAR("decay alone", w, 2 * pow(1 - 1e-4, 100), 100 * 0x1p-23);
    }
    dar_cpu_init(all);
}

/* ---------------------------------------------------------------- sizes */

#define BEYOND ((int64_t)1 << 31) /* the first index that an int cannot hold */

/* Address space without memory: pages come where they are touched. */
static void *reserve(size_t bytes)
{
    void *p = mmap(NULL, bytes, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    CHECK(p != MAP_FAILED, "cannot reserve %zu bytes of address space", bytes);
    madvise(p, bytes, MADV_HUGEPAGE); /* fewer pages of zeros to map where it is only read */
    return p;
}

/* Rows far apart: the second one begins past 2^31 elements. */
static void views_reach_beyond_int(void **state)
{
    (void)state;
    int64_t row = BEYOND + 5;
    size_t bytes = (size_t)(2 * row) * sizeof(float);
    float *p = reserve(bytes);
    dar_tensor x = dar_tensor_of(DAR_F32, DAR_SHAPE(2, row), p);
    assert_int_equal(dar_tensor_count(&x), 2 * row);
    assert_int_equal(dar_tensor_bytes(&x), bytes);

    for (int i = 0; i < 7; i++) p[2 * row - 7 + i] = (float)(i + 1);
    dar_tensor v = dar_tensor_narrow(&x, 1, row - 7, 7);
    dar_val *y = dar_contiguous(&tape, dar_leaf(&tape, v, NULL));
    for (size_t i = 0; i < 14; i++) CHECK_NEAR("narrowed", at(&y->x, i), i < 7 ? 0 : (double)(i - 6), 0);
    dar_tensor w = dar_tensor_permute(&v, (int[]){ 1, 0 });
    y = dar_silu(&tape, dar_leaf(&tape, w, NULL));
    for (size_t i = 0; i < 7; i++)
        CHECK_NEAR("silu of a view", at(&y->x, 2 * i + 1), (double)(i + 1) / (1 + exp(-(double)(i + 1))), 1e-6 * 7);

    /* Written through a view: only what it covers. */
    dar_tensor_fill(&y->x, 3);
    dar_tensor_copy(&w, &y->x);
    dar_tensor_add(&w, &y->x);
    CHECK_NEAR("last of row 1", p[2 * row - 1], 6, 0);
    CHECK_NEAR("last of row 0", p[row - 1], 6, 0);
    CHECK_NEAR("before the view", p[2 * row - 8], 0, 0);
    munmap(p, bytes);
}

/* Operands and result whose rows lie 2^31 elements apart. */
static void products_reach_beyond_int(void **state)
{
    (void)state;
    enum { M = 2, N = 3, K = 5 };
    size_t ld = (size_t)BEYOND + 5, bytes = N * ld * sizeof(float);
    float *a = reserve(bytes), *b = reserve(bytes), *c = reserve(bytes);
    for (size_t k = 0; k < K; k++) {
        for (size_t i = 0; i < M; i++) a[i * ld + k] = (float)(i + k + 1);
        for (size_t j = 0; j < N; j++) b[j * ld + k] = (float)(10 * j + k);
    }
    dar_gemm g = { .kind = DAR_TILE_F32, .m = M, .n = N, .k = K, .alpha = 1, .type = DAR_F32, .c = c, .ldc = ld };
    g.a = (dar_matrix){ .type = DAR_F32, .data = a, .ld = ld };
    g.b = (dar_matrix){ .type = DAR_F32, .data = b, .ld = ld, .t = true };
    dar_gemm_run(&g, dar_arena_push(&arena, dar_gemm_scratch(&g)));
    for (size_t i = 0; i < M; i++)
        for (size_t j = 0; j < N; j++) {
            double sum = 0;
            for (size_t k = 0; k < K; k++) sum += (double)a[i * ld + k] * b[j * ld + k];
            CHECK_NEAR("product", c[i * ld + j], sum, 0);
        }
    CHECK_NEAR("beside the product", c[ld + N], 0, 0);
    munmap(a, bytes);
    munmap(b, bytes);
    munmap(c, bytes);
}

/* One contiguous tensor past 2^31 elements; its pages are the kernel's page of zeros until written. */
static void scans_reach_beyond_int(void **state)
{
    (void)state;
    int64_t n = BEYOND + 1001;
    uint16_t *p = reserve((size_t)n * 2);
    dar_tensor x = dar_tensor_of(DAR_BF16, DAR_SHAPE(n), p);
    p[n - 1] = dar_bf16_from_f32(INFINITY);
    assert_int_equal(dar_tensor_nonfinite(&x), n - 1);
    p[n - 1] = dar_bf16_from_f32(2);
    assert_int_equal(dar_tensor_nonfinite(&x), -1);
    munmap(p, (size_t)n * 2);
}

/* An op over as many elements, 4 GiB in and 4 GiB out: only at full size. */
static void ops_reach_beyond_int(void **state)
{
    (void)state;
    int64_t n = BEYOND + 1001;
    uint16_t *p = reserve((size_t)n * 2);
    dar_arena large;
    dar_tape t;
    assert_int_equal(dar_arena_init(&large, "large", ((size_t)n + 4096) * 2, NULL), DAR_OK);
    assert_int_equal(dar_tape_init(&t, &large, NULL), DAR_OK);
    for (int64_t i = n - 5; i < n; i++) p[i] = dar_bf16_from_f32((float)(i - n + 3));
    dar_val *y = dar_relu(&t, dar_leaf(&t, dar_tensor_of(DAR_BF16, DAR_SHAPE(n), p), NULL));
    for (int64_t i = n - 5; i < n; i++) CHECK_NEAR("relu", at(&y->x, (size_t)i), fmax(0, (double)(i - n + 3)), 0);
    assert_int_equal(dar_tensor_nonfinite(&y->x), -1);
    dar_tape_free(&t);
    dar_arena_free(&large);
    munmap(p, (size_t)n * 2);
}

/* 249 frames: 24570 tokens of 18432 values. */
static void plans_count_beyond_int(void **state)
{
    (void)state;
    dar_arena plan;
    dar_tape t;
    assert_int_equal(dar_arena_init_plan(&plan, "plan", NULL), DAR_OK);
    assert_int_equal(dar_tape_init(&t, &plan, NULL), DAR_OK);
    dar_val *x = dar_input(&t, DAR_F32, DAR_SHAPE(3, 24570, 18432));
    dar_silu(&t, x);
    assert_int_equal(plan.peak, (size_t)2 * 3 * 24570 * 18432 * 4);
    CHECK_ABORTS(dar_input(&t, DAR_F32, DAR_SHAPE((int64_t)1 << 40, (int64_t)1 << 40)));
    dar_tape_free(&t);
    dar_arena_free(&plan);
}

static void sizes_do_not_wrap(void **state)
{
    (void)state;
    int64_t big = (int64_t)1 << 32;
    CHECK_ABORTS(dar_shape_count(&DAR_SHAPE(big, big)));
    CHECK_ABORTS(dar_shape_count(&DAR_SHAPE(big, big / 2)));
    CHECK_ABORTS(dar_shape_count(&DAR_SHAPE(3, -1)));
    CHECK_ABORTS(dar_tensor_push(&arena, DAR_I8, DAR_SHAPE(big, big - 1)));
    CHECK_ABORTS(dar_tensor_push(&arena, DAR_F32, DAR_SHAPE(big, big / 4)));
    CHECK_ABORTS(dar_tensor_push(&arena, DAR_F64, DAR_SHAPE(big, big / 8)));
    CHECK_ABORTS(dar_mul_size(SIZE_MAX / 2, 3));
    CHECK_ABORTS(dar_add_size(SIZE_MAX, 1));
    assert_int_equal(dar_mul_size(SIZE_MAX / 3, 3), SIZE_MAX);
    assert_int_equal(dar_mul_size(0, SIZE_MAX), 0);
}

/* ---------------------------------------------------------------- sums */

/* Of four million squares, among them a thousand large ones: a running f32 sum loses the small ones beside them. */
static void long_sums_keep_digits(void **state)
{
    (void)state;
    enum { N = 4200000 };
    dar_tensor x = dar_tensor_push(&arena, DAR_F32, DAR_SHAPE(N)),
               zero = dar_tensor_push(&arena, DAR_F32, DAR_SHAPE(N));
    float *v = x.data, naive = 0;
    long double exact[3] = { 0 };
    dar_tensor_fill(&zero, 0);
    for (size_t i = 0; i < N; i++) {
        v[i] = i % 4096 ? sinf((float)(i % 100003) * 0.7f) : 1000;
        naive += v[i] * v[i];
        exact[0] += v[i];
        exact[1] += v[i] / (long double)N;
        exact[2] += (long double)v[i] * v[i];
    }
    CHECK(fabsl(naive - exact[2]) > 1e-4L * exact[2], "the sample is too easy: a running f32 sum has it right");

    int before = dar_threads();
    static const int threads[] = { 1, 2, 3, 7 };
    static const char *const name[3] = { "sum", "mean", "squared_error" };
    double first[3] = { 0 };
    for (size_t k = 0; k < DAR_COUNT(threads); k++) {
        dar_threads_set(threads[k]);
        dar_val *in = dar_leaf(&tape, x, NULL);
        double y[3] = { at(&dar_sum(&tape, in, DAR_ALL_DIMS, false)->x, 0),
                        at(&dar_mean(&tape, in, DAR_ALL_DIMS, false)->x, 0),
                        at(&dar_squared_error(&tape, in, dar_leaf(&tape, zero, NULL), NULL, false)->x, 0) };
        for (int i = 0; i < 3; i++) {
            if (!k) first[i] = y[i];
            CHECK_NEAR(name[i], y[i], (double)exact[i], 1e-7 * fabs((double)exact[i]));
            CHECK(y[i] == first[i], "%s: %.9g with %d threads, %.9g with 1", name[i], y[i], threads[k], first[i]);
        }
    }
    dar_threads_set(before);
}

int main(int argc, char **argv)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup(flags_keep_arithmetic, setup),
        cmocka_unit_test_setup(denormals_survive, setup),
        cmocka_unit_test_setup(bad_numbers_are_named, setup),
        cmocka_unit_test_setup(long_sums_keep_digits, setup),
        cmocka_unit_test_setup(logits_of_ten_thousand, setup),
        cmocka_unit_test_setup(masked_rows_are_zero, setup),
        cmocka_unit_test_setup(equal_keys_fold, setup),
        cmocka_unit_test_setup(norms_far_from_zero, setup),
        cmocka_unit_test_setup(norms_of_nothing, setup),
        cmocka_unit_test_setup(positions_stay_exact, setup),
        cmocka_unit_test_setup(softmax_alone, setup),
        cmocka_unit_test_setup(tails_stay_relative, setup),
        cmocka_unit_test_setup(adamw_corners, setup),
        cmocka_unit_test_setup(views_reach_beyond_int, setup),
        cmocka_unit_test_setup(products_reach_beyond_int, setup),
        cmocka_unit_test_setup(scans_reach_beyond_int, setup),
        cmocka_unit_test_setup(plans_count_beyond_int, setup),
        cmocka_unit_test_setup(sizes_do_not_wrap, setup),
    };
    const struct CMUnitTest large[] = {
        cmocka_unit_test_setup(ops_reach_beyond_int, setup),
    };
    dar_err e;
    if (dar_arena_init(&arena, "stress", (size_t)4 << 30, &e) != DAR_OK || dar_tape_init(&tape, &arena, &e) != DAR_OK) {
        fprintf(stderr, "test_stress: %s\n", e.text);
        return 3;
    }
    int failures = cmocka_run_group_tests(tests, NULL, NULL);
    if (argc > 1 && strcmp(argv[1], "full") == 0) failures += cmocka_run_group_tests(large, NULL, NULL);
    dar_tape_free(&tape);
    dar_arena_free(&arena);
    return failures != 0;
}
