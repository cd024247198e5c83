/* test_optim.c: AdamW against torch's, steps that are not finite, threads. */
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

int main(void)
{
    static const struct CMUnitTest tests[] = { cmocka_unit_test(against_torch), cmocka_unit_test(not_finite),
                                               cmocka_unit_test(too_many) };
    return cmocka_run_group_tests_name("optim", tests, NULL, NULL) != 0;
}
