/* test_reuse.c: which steps a rule asks for, where the answer is known; what a rule is called. */
#include "tests/test.h"

#include "lib/arena.h"
#include "models/reuse.h"

#define MOST 64

static dar_reuse_config rule_of(const char *text)
{
    dar_reuse_config c;
    dar_err e;
    CHECK(dar_reuse_read(&c, text, &e) == DAR_OK, "%s", e.text);
    return c;
}

/* ---------------------------------------------------------------- table */

/* 'x' asked, '-' held; a run of as many steps. */
static void check_table(const char *text, const char *expected)
{
    const size_t steps = strlen(expected);
    char found[MOST] = "";
    size_t held = 0;
    dar_reuse r;
    dar_reuse_config c = rule_of(text);
    dar_reuse_init(&r, &c, steps);
    for (size_t i = 0; i < steps; i++) found[i] = dar_reuse_asks(&r) ? 'x' : '-', held += found[i] == '-';
    CHECK(strcmp(found, expected) == 0, "%s: %s, expected %s", text, found, expected);
    assert_int_equal(r.held, held);
}

static void tables(void **state)
{
    (void)state;
    check_table("none", "xxxxx");
    check_table("table:1", "xxxxx");
    check_table("table:2", "x-x-x");
    check_table("table:2", "x-x-xx");
    check_table("table:3", "x--x--x-x");
    check_table("table:1000", "x----x");
    check_table("table:7", "x");
    check_table("table:2", "xx");
    check_table("change:0.5", "xxxx"); /* of an input that nobody showed */
}

/* ---------------------------------------------------------------- change */

/* The input is two parts, of mixed signs and unlike sizes; |m| = 16 before the first change.  At every step each part
 * takes its share of change[i] |m'| in one element: in the L1 norm that is change[i] in all, in no other. */
static void check_change(const char *text, size_t steps, const double *change, const char *expected)
{
    double m[2][3] = { { 3, -1, 4 }, { -1, 5, -2 } }, before[2][3];
    char found[MOST] = "";
    dar_reuse r;
    dar_reuse_config c = rule_of(text);
    dar_reuse_init(&r, &c, steps);
    for (size_t i = 0; i < steps; i++) {
        double size = 0;
        for (int k = 0; k < 6; k++) size += fabs(m[k / 3][k % 3]);
        if (i) m[0][2] += change[i] * size / 4, m[1][0] -= change[i] * size * 3 / 4;
        for (int p = 0; p < 2; p++) {
            dar_tensor now = dar_tensor_of(DAR_F64, DAR_SHAPE(3), m[p]);
            dar_tensor last = dar_tensor_of(DAR_F64, DAR_SHAPE(3), before[p]);
            dar_reuse_see(&r, &now, &last);
            assert_memory_equal(m[p], before[p], sizeof m[p]);
        }
        if (i) CHECK_NEAR("change", r.moved / r.size, change[i], 1e-15);
        found[i] = dar_reuse_asks(&r) ? 'x' : '-';
    }
    CHECK(strcmp(found, expected) == 0, "%s: %s, expected %s", text, found, expected);
}

static void changes(void **state)
{
    (void)state;
    static const double d[] = { 0, 0.1, 0.1, 0.1, 0.5, 0.01, 0.02, 0.3, 0.1, 0.001 };
    check_change("change:0.25", 10, d, "x--xx--x-x");
    check_change("change:0.05", 10, d, "xxxxx--xxx");
    check_change("change:10", 10, d, "x--------x");
    check_change("change:0", 10, d, "xxxxxxxxxx");
    check_change("change:0.25:0,1", 10, d, "x--xx--x-x");
    check_change("change:0.25:0,2.0", 10, d, "x-x-x--x-x");   /* sums .2 .4 | .2 1.2 | .02 .06 .66 | .2 */
    check_change("change:0.25:0,0,10", 10, d, "x--xx--x-x");  /* .1 .2 .3 | 2.5 | .001 .005 .905 | .1 */
    check_change("change:0.25:0.1,0,5", 10, d, "x-x-x--x-x"); /* .15 .3 | .15 1.35 | .1005 .2025 .7525 | .15 */
    check_change("change:0.75:0.25", 10, d, "x--x--x--x");    /* every third, whatever the input does */
    static const double still[] = { 0, 0, 0, 0, 0 };
    check_change("change:0", 5, still, "xxxxx"); /* 0 is not below 0 */
    check_change("change:1e-9", 5, still, "x---x");
    static const double broken[] = { 0, 0.1, NAN, 0.1, 0.1, 0.1, 0.1 };
    dar_reuse r;
    dar_reuse_config c = rule_of("change:10");
    dar_reuse_init(&r, &c, 7);
    for (int i = 0; i < 7; i++) {
        r.moved = broken[i], r.size = 1;
        assert_int_equal(dar_reuse_asks(&r), i == 0 || i == 2 || i == 6);
    }
}

/* ---------------------------------------------------------------- as text */

static void texts(void **state)
{
    (void)state;
    static const char *const wrong[] = { "",          "non",        "none:",       "none:1",     "table",
                                         "table:",    "table:0",    "table:-2",    "table:2.5",  "table:2:1",
                                         "table:2x",  "table:nan",  "change",      "change:",    "change:-1",
                                         "change:1:", "change:1,2", "change:1:1,", "change:inf", "change:1:1,2,3,4,5,6",
                                         "Table:2",   "table:1001" };
    dar_err e;
    for (size_t i = 0; i < DAR_COUNT(wrong); i++) {
        dar_reuse_config c = { .rule = DAR_REUSE_TABLE };
        CHECK(dar_reuse_read(&c, wrong[i], &e) == DAR_ERR_USAGE, "'%s' is a rule", wrong[i]);
        CHECK(strstr(e.text, "table:N") && c.rule == DAR_REUSE_NONE, "%s", e.text);
    }
    assert_int_equal(rule_of("none").rule, DAR_REUSE_NONE);
    assert_int_equal(rule_of("table:12").rule, DAR_REUSE_TABLE);
    CHECK_NEAR("N", rule_of("table:12").at, 12, 0);
    dar_reuse_config c = rule_of("change:0.15:1,-2.5,3e2,0,-4");
    static const double f[] = { 1, -2.5, 300, 0, -4 };
    assert_int_equal(c.rule, DAR_REUSE_CHANGE);
    CHECK_NEAR("threshold", c.at, 0.15, 0);
    for (int i = 0; i < DAR_REUSE_COEFFICIENTS; i++) CHECK_NEAR("coefficient", c.f[i], f[i], 0);
}

int main(void)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(tables),
        cmocka_unit_test(changes),
        cmocka_unit_test(texts),
    };
    return cmocka_run_group_tests_name("reuse", tests, NULL, NULL) != 0;
}
