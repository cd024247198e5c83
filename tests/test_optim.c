/* test_optim.c: AdamW against torch's, steps that are not finite, rates by name, averages, moments in bf16,
 * threads. */
#include "tests/test.h"

#include "lib/json.h"
#include "train/optim.h"

typedef struct net {
    dar_arena arena;
    dar_params p;
    dar_param *a, *b, *frozen;
    dar_optim o;
} net;

/* Two trained tensors, [2, 3] and [2], and one that is not. */
static void net_init(net *n, dar_dtype type, const dar_optim_config *c)
{
    dar_param_info one = { DAR_PARAM_LORA, false, DAR_FRESH_VALUE, 1 },
                   base = { DAR_PARAM_BASE, false, DAR_FRESH_VALUE, 1 };
    assert_int_equal(dar_arena_init(&n->arena, "test", 1 << 20, NULL), DAR_OK);
    dar_params_init(&n->p, &n->arena, type);
    n->a = dar_params_add(&n->p, one, DAR_SHAPE(2, 3), "a");
    n->frozen = dar_params_add(&n->p, base, DAR_SHAPE(4), "frozen");
    n->b = dar_params_add(&n->p, one, DAR_SHAPE(2), "b");
    dar_params_train(&n->p, DAR_PARAM_LORA);
    dar_params_fresh(&n->p, DAR_PARAM_ALL, 1);
    dar_params_gradients(&n->p);
    for (size_t i = 0; i < 6; i++) dar_dtype_set(type, n->a->x.data, i, -1 + 2 * (double)i / 5);
    dar_dtype_set(type, n->b->x.data, 0, 0.5);
    dar_dtype_set(type, n->b->x.data, 1, -0.25);
    dar_optim_init(&n->o, c, &n->p, &n->arena);
}

static void net_free(net *n)
{
    dar_params_free(&n->p);
    dar_arena_free(&n->arena);
}

static double weight(const net *n, size_t i)
{
    const dar_tensor *x = i < 6 ? &n->a->x : &n->b->x;
    return dar_dtype_get(x->dtype, x->data, i < 6 ? i : i - 6);
}

static void gradient(net *n, double more)
{
    for (size_t i = 0; i < 8; i++) {
        const dar_tensor *g = i < 6 ? &n->a->g : &n->b->g;
        dar_dtype_set(g->dtype, g->data, i < 6 ? i : i - 6, weight(n, i) + more);
    }
}

static void against_torch(void **state)
{
    (void)state;
    dar_json_doc *doc;
    dar_err e;
    int runs = 0;
    CHECK(dar_json_open(&doc, "tests/fixtures/adamw.json", &e) == DAR_OK, "%s", e.text);
    for (dar_json run = dar_json_first(dar_json_root(doc)); run.item; run = dar_json_next(run), runs++)
        for (int type = DAR_F64; type <= DAR_F32; type++) {
            /* f32: a rounding of a weight near 1 in each of ten steps, twice */
            double norms[10] = { NAN }, w[8], bound = type == DAR_F64 ? 1e-13 : 2e-6;
            dar_optim_config c = dar_optim_default();
            c.rate = 1e-2;
            c.decay = dar_json_number(run, "decay", NAN, 0, 1);
            c.max_norm = dar_json_number(run, "max_norm", NAN, 0, 10);
            c.warmup = dar_json_int(run, "warmup", DAR_JSON_NEEDED, 0, 100);
            dar_json_numbers(run, "norms", norms, 10);
            net n;
            net_init(&n, (dar_dtype)type, &c);
            int k = 0;
            for (dar_json at = dar_json_first(dar_json_array(run, "weights")); at.item; at = dar_json_next(at), k++) {
                gradient(&n, k / 3.0);
                dar_optim_report r = dar_optim_step(&n.o);
                CHECK_NEAR("norm", r.norm, norms[k], bound * 10);
                CHECK_NEAR("rate", r.rate, k < c.warmup ? 1e-2 * k / (double)c.warmup : 1e-2, 1e-17);
                w[0] = NAN;
                dar_json_numbers(at, NULL, w, 8);
                for (size_t i = 0; i < 8; i++) {
                    CHECK_NEAR("weight", weight(&n, i), w[i], bound);
                    if (i < 6) CHECK_NEAR("gradient", dar_dtype_get(n.a->g.dtype, n.a->g.data, i), 0, 0);
                }
            }
            assert_int_equal(k, 10);
            for (size_t i = 0; i < 4; i++)
                CHECK_NEAR("frozen", dar_dtype_get(n.frozen->x.dtype, n.frozen->x.data, i), 1, 0);
            net_free(&n);
        }
    assert_int_equal(runs, 3);
    CHECK(dar_json_finish(doc, &e) == DAR_OK, "%s", e.text);
    dar_json_close(doc);
}

/* A bad gradient leaves weights, moments and the count of steps as they were: the run goes on as if it had not been. */
static void not_finite(void **state)
{
    (void)state;
    static const double bad[] = { NAN, INFINITY, -INFINITY, 1e300 };
    dar_optim_config c = dar_optim_default();
    net with, without;
    c.warmup = 2;
    net_init(&with, DAR_F64, &c);
    net_init(&without, DAR_F64, &c);
    for (int k = 0; k < 4; k++) {
        gradient(&with, k);
        for (size_t i = 0; i < 2; i++) dar_dtype_set(DAR_F64, with.b->g.data, i, bad[k]);
        dar_optim_report r = dar_optim_step(&with.o);
        assert_true(r.skipped);
        if (k < 3) assert_string_equal(r.nonfinite, "b");
        else assert_null(r.nonfinite); /* finite, but not its square */
        gradient(&with, k);
        gradient(&without, k);
        assert_false(dar_optim_step(&with.o).skipped);
        assert_false(dar_optim_step(&without.o).skipped);
        for (size_t i = 0; i < 8; i++) CHECK_NEAR("weight", weight(&with, i), weight(&without, i), 0);
    }
    assert_int_equal(with.o.skipped, 4);
    assert_int_equal(with.o.steps, 4);
    net_free(&with);
    net_free(&without);
}

/* Bad steps are passed over, but not for ever; a good one between them counts from the start. */
static void too_many(void **state)
{
    (void)state;
    dar_optim_config c = dar_optim_default();
    dar_err e;
    net n;
    c.patience = 2;
    net_init(&n, DAR_F32, &c);
    for (int k = 0; k < 6; k++) {
        gradient(&n, 0);
        if (k != 2) dar_dtype_set(DAR_F32, n.a->g.data, 5, NAN);
        dar_optim_report r = dar_optim_step(&n.o);
        dar_status s = dar_optim_check(&n.o, &r, &e);
        assert_int_equal(s, k < 5 ? DAR_OK : DAR_ERR_NUMERIC);
    }
    CHECK(strstr(e.text, "3 times in a row") && strstr(e.text, " a:"), "%s", e.text);
    net_free(&n);
}

/* A tensor with a rate of its own learns as in a net where all have it; the last pattern that matches counts. */
static void rates_by_name(void **state)
{
    (void)state;
    dar_optim_config c = dar_optim_default();
    net mixed, fast, slow;
    c.max_norm = 0;
    c.warmup = 3;
    c.rate = 1e-3;
    net_init(&mixed, DAR_F64, &c);
    net_init(&slow, DAR_F64, &c);
    c.rate = 1e-1;
    net_init(&fast, DAR_F64, &c);
    assert_int_equal(dar_optim_set_rate(&mixed.o, "*", 1e-1), 2);
    assert_int_equal(dar_optim_set_rate(&mixed.o, "[b-z]*", 1e-3), 1);
    assert_int_equal(dar_optim_set_rate(&mixed.o, "froz*", 1), 0);
    assert_int_equal(dar_optim_set_rate(&mixed.o, "aa", 1), 0);
    for (int k = 0; k < 6; k++) {
        net *all[] = { &mixed, &fast, &slow };
        for (size_t i = 0; i < DAR_COUNT(all); i++) {
            gradient(all[i], k);
            all[i]->o.schedule = k < 4 ? 1 : 0.5;
            dar_optim_report r = dar_optim_step(&all[i]->o);
            double factor = k < 3 ? k / 3.0 : k < 4 ? 1 : 0.5;
            CHECK_NEAR("rate", r.rate, factor * all[i]->o.config.rate, 1e-17);
        }
        for (size_t i = 0; i < 8; i++) CHECK_NEAR("weight", weight(&mixed, i), weight(i < 6 ? &fast : &slow, i), 0);
    }
    CHECK(weight(&fast, 0) != weight(&slow, 0), "both rates give %g", weight(&fast, 0));
    net_free(&mixed);
    net_free(&fast);
    net_free(&slow);
}

/* The average follows the weights, which do not know of it.  f32: each step rounds three numbers below 2. */
static void averages(void **state)
{
    (void)state;
    enum { STEPS = 40 };
    for (int type = DAR_F64; type <= DAR_F32; type++) {
        dar_optim_config c = dar_optim_default();
        net with, without;
        double bound = 3 * STEPS * (type == DAR_F64 ? 0x1p-53 : 0x1p-24), a[8];
        c.rate = 1e-2;
        c.warmup = 2;
        net_init(&without, (dar_dtype)type, &c);
        c.average = 0.7;
        net_init(&with, (dar_dtype)type, &c);
        dar_dtype_set((dar_dtype)type, without.a->x.data, 0, 0.75);
        dar_dtype_set((dar_dtype)type, with.a->x.data, 0, 0.75);
        dar_optim_restart_average(&with.o);
        dar_optim_swap(&with.o);
        CHECK_NEAR("average at the start", weight(&with, 0), 0.75, 0);
        dar_optim_swap(&with.o);
        for (int k = 0; k < STEPS; k++) {
            gradient(&with, k / 3.0);
            gradient(&without, k / 3.0);
            dar_optim_step(&with.o);
            dar_optim_step(&without.o);
            double decay = k ? fmin(0.7, (1.0 + k) / (10 + k)) : 0;
            for (size_t i = 0; i < 8; i++) a[i] = (k ? decay * a[i] : 0) + (1 - decay) * weight(&with, i);
            gradient(&with, NAN);
            assert_true(dar_optim_step(&with.o).skipped);
            dar_optim_swap(&with.o);
            for (size_t i = 0; i < 8; i++) CHECK_NEAR("average", weight(&with, i), a[i], bound);
            dar_optim_swap(&with.o);
            dar_optim_swap(&without.o);
            for (size_t i = 0; i < 8; i++) CHECK_NEAR("weight", weight(&with, i), weight(&without, i), 0);
        }
        CHECK(fabs(a[0] - weight(&with, 0)) > 1e-3, "the average is %g, the weight %g", a[0], weight(&with, 0));
        net_free(&with);
        net_free(&without);
    }
}

/* ---------------------------------------------------------------- moments in bf16 */

#define N 50000

typedef struct large {
    dar_arena arena;
    dar_params p;
    dar_param *w;
    dar_optim o;
} large;

static void large_init(large *l, bool bf16_moments)
{
    dar_optim_config c = dar_optim_default();
    c.max_norm = 0;
    c.warmup = 0;
    c.decay = 0;
    c.bf16_moments = bf16_moments;
    c.seed = 5;
    c.average = 0.9;
    assert_int_equal(dar_arena_init(&l->arena, "test", 8 << 20, NULL), DAR_OK);
    dar_params_init(&l->p, &l->arena, DAR_F32);
    l->w = dar_params_add(&l->p, (dar_param_info){ DAR_PARAM_LORA, false, DAR_FRESH_VALUE, 0 }, DAR_SHAPE(N), "w");
    dar_params_train(&l->p, DAR_PARAM_LORA);
    dar_params_fresh(&l->p, DAR_PARAM_ALL, 1);
    dar_params_gradients(&l->p);
    dar_optim_init(&l->o, &c, &l->p, &l->arena);
}

static void large_free(large *l)
{
    dar_params_free(&l->p);
    dar_arena_free(&l->arena);
}

static void large_steps(large *l, int from, int to)
{
    for (int k = from; k < to; k++) {
        dar_tensor_fill(&l->w->g, 1 + 0.3 * sin(k));
        assert_false(dar_optim_step(&l->o).skipped);
    }
}

static double mean_of(const dar_tensor *x)
{
    double sum = 0;
    for (size_t i = 0; i < N; i++) sum += dar_dtype_get(x->dtype, x->data, i);
    return sum / N;
}

/* All elements have the same gradients, so the mean over them shows what rounding adds: a digit of bf16, 2^-8, at
 * random at each step, of which v forgets a thousandth; over N elements, with five deviations, that is
 * 5 * 2^-8 / 2 * sqrt(500 / N).  To the nearest, v stands still once a thousandth of it is less than half a digit. */
static void unbiased(void **state)
{
    (void)state;
    large wide, narrow;
    large_init(&wide, false);
    large_init(&narrow, true);
    large_steps(&wide, 0, 400);
    large_steps(&narrow, 0, 400);
    double m = mean_of(&wide.o.m[0]), v = mean_of(&wide.o.v[0]), bound = 5 * 0x1p-9 * sqrt(500.0 / N);
    CHECK_NEAR("m", mean_of(&narrow.o.m[0]) / m, 1, bound);
    CHECK_NEAR("v", mean_of(&narrow.o.v[0]) / v, 1, bound);
    CHECK_NEAR("w", mean_of(&narrow.w->x) / mean_of(&wide.w->x), 1, 2 * bound);
    assert_int_equal(narrow.o.m[0].dtype, DAR_BF16);
    large_free(&wide);
    large_free(&narrow);
}

/* Whatever the threads and the processor can do, and from moments that were saved as they are. */
static void same_bits(void **state)
{
    (void)state;
    static const int threads[] = { 1, 2, 3, 7 };
    unsigned level[5];
    large first, other;
    large_init(&first, true);
    large_steps(&first, 0, 6);
    int levels = test_levels(level), before = dar_threads();
    for (int i = 0; i < 4 + levels; i++) {
        large_init(&other, true);
        if (i < 4) dar_threads_set(threads[i]);
        else dar_cpu_init(level[i - 4]);
        large_steps(&other, 0, 6);
        assert_memory_equal(first.o.m[0].data, other.o.m[0].data, 2 * N);
        assert_memory_equal(first.o.v[0].data, other.o.v[0].data, 2 * N);
        assert_memory_equal(first.w->x.data, other.w->x.data, 4 * N);
        assert_memory_equal(first.o.average[0].data, other.o.average[0].data, 4 * N);
        large_free(&other);
        dar_threads_set(before);
    }
    dar_cpu_init(DAR_CPU_ALL);
    large_free(&first);
}

int main(void)
{
    static const struct CMUnitTest tests[] = { cmocka_unit_test(against_torch), cmocka_unit_test(not_finite),
                                               cmocka_unit_test(too_many),      cmocka_unit_test(rates_by_name),
                                               cmocka_unit_test(averages),      cmocka_unit_test(unbiased),
                                               cmocka_unit_test(same_bits) };
    return cmocka_run_group_tests_name("optim", tests, NULL, NULL) != 0;
}
