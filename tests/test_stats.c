/* test_stats.c: intervals and the binomial test against scipy (scripts/make-stats-fixtures.py). */
#include "tests/test.h"

#include "lib/json.h"
#include "lib/stats.h"

static double work[DAR_BOOTSTRAP];

static dar_json_doc *open_fixture(void)
{
    dar_json_doc *doc;
    dar_err e;
    CHECK(dar_json_open(&doc, "tests/fixtures/stats.json", &e) == DAR_OK, "%s", e.text);
    return doc;
}

/* Both intervals are drawn, ours from 10000 sets, scipy's from 200000.  The 2.5 percentile of N draws has the deviation
 * sqrt(0.025 0.975 / N) / density = sqrt(0.0244 / N) / 0.058 standard errors of the mean: 0.028 together; five of them.
 */
static void test_bootstrap(void **state)
{
    dar_json_doc *doc = open_fixture();
    (void)state;
    for (dar_json j = dar_json_first(dar_json_get(dar_json_root(doc), "sets")); j.item; j = dar_json_next(j)) {
        dar_json values = dar_json_get(j, "x");
        size_t n = dar_json_size(values);
        double x[68], want[2] = { NAN, NAN }, mean = 0, square = 0;
        assert_true(n <= DAR_COUNT(x));
        x[0] = NAN;
        dar_json_numbers(j, "x", x, n);
        dar_json_numbers(j, "interval", want, 2);
        for (size_t i = 0; i < n; i++) mean += x[i] / (double)n;
        for (size_t i = 0; i < n; i++) square += (x[i] - mean) * (x[i] - mean) / (double)n;
        double bound = 5 * 0.028 * sqrt(square / (double)n);
        dar_interval v = dar_stats_bootstrap(x, n, 42, work);
        CHECK_NEAR("mean", v.mean, mean, 1e-14);
        CHECK_NEAR("lo", v.lo, want[0], bound);
        CHECK_NEAR("hi", v.hi, want[1], bound);
    }
    dar_json_close(doc);
}

static void test_seed(void **state)
{
    static const int threads[] = { 2, 3, 7 };
    const double x[] = { 1, 2, 4, 8, 16, 32, 64 };
    int before = dar_threads();
    (void)state;
    dar_threads_set(1);
    dar_interval a = dar_stats_bootstrap(x, 7, 1, work), other = dar_stats_bootstrap(x, 7, 2, work);
    CHECK(a.lo != other.lo || a.hi != other.hi, "the seed is not used");
    for (size_t k = 0; k < DAR_COUNT(threads); k++) {
        dar_threads_set(threads[k]);
        dar_interval b = dar_stats_bootstrap(x, 7, 1, work);
        assert_memory_equal(&a, &b, sizeof a);
    }
    dar_threads_set(before);
}

static void test_few(void **state)
{
    const double x[] = { 3, 3 };
    (void)state;
    dar_interval none = dar_stats_bootstrap(x, 0, 1, work), one = dar_stats_bootstrap(x, 1, 1, work);
    CHECK(none.n == 0 && isnan(none.mean) && isnan(none.lo), "an interval of nothing");
    CHECK(one.mean == 3 && isnan(one.lo) && isnan(one.hi), "an interval of one value");
    dar_interval equal = dar_stats_bootstrap(x, 2, 1, work);
    CHECK(equal.lo == 3 && equal.hi == 3, "equal values, %g to %g", equal.lo, equal.hi);
}

static void test_binomial(void **state)
{
    dar_json_doc *doc = open_fixture();
    (void)state;
    for (dar_json j = dar_json_first(dar_json_get(dar_json_root(doc), "coins")); j.item; j = dar_json_next(j)) {
        size_t heads = (size_t)dar_json_int(j, "heads", DAR_JSON_NEEDED, 0, 1000);
        size_t n = (size_t)dar_json_int(j, "n", DAR_JSON_NEEDED, 0, 1000);
        double p = dar_json_number(j, "p", NAN, 0, 1);
        CHECK_NEAR("p", dar_stats_fair(heads, n), p, 1e-11 * p);
        CHECK_NEAR("p of tails", dar_stats_fair(n - heads, n), p, 1e-11 * p);
    }
    CHECK_NEAR("no toss", dar_stats_fair(0, 0), 1, 0);
    dar_json_close(doc);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_bootstrap),
        cmocka_unit_test(test_seed),
        cmocka_unit_test(test_few),
        cmocka_unit_test(test_binomial),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
