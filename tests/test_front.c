/* test_front.c: measured rows become a front, the front a file, the file a choice. */
#include "tests/scratch.h"

#include "tests/work.h"

/* A setting on a scene; the full run takes 10 s and 100 calls, the others as many calls in a second. */
static void add(work_table *t, const char *scene, bool still, double visible, const char *setting, const char *solver,
                double steps, double tolerance, double seconds, double error, double estimate)
{
    work_row row = { 0 };
    dar_err e;
    const char *rule = strstr(setting, "table:");
    snprintf(row.text[WORK_REUSE], WORK_TEXT, "%s", rule ? rule : "none");
    row.v[WORK_CALLS] = 10 * seconds;
    snprintf(row.text[WORK_SCENE], WORK_TEXT, "%s", scene);
    snprintf(row.text[WORK_SETTING], WORK_TEXT, "%s", setting);
    snprintf(row.text[WORK_PRECISION], WORK_TEXT, "%.4s", *setting == 'b' ? "bf16" : "f32");
    snprintf(row.text[WORK_SOLVER], WORK_TEXT, "%s", solver);
    snprintf(row.text[WORK_SKIPS], WORK_TEXT, "%s", strcmp(setting, WORK_FULL) == 0 ? "none" : "all");
    snprintf(row.text[WORK_MODEL], WORK_TEXT, "some model");
    row.v[WORK_STEPS] = steps;
    row.v[WORK_TOLERANCE] = tolerance;
    row.v[WORK_SECONDS] = seconds;
    row.v[WORK_ERROR] = error;
    row.v[WORK_ESTIMATE] = estimate;
    row.v[WORK_PSNR] = 50 - 1000 * error;
    row.v[WORK_CAMERA_STILL] = still;
    row.v[WORK_VISIBLE] = visible;
    row.v[WORK_EDGE] = NAN;
    ok(work_add(t, &row, &e), &e);
}

static void add_scene(work_table *t, const char *scene, bool still, double visible, double worse)
{
    add(t, scene, still, visible, WORK_FULL, "euler", 50, 0, 10, 0, 0);
    add(t, scene, still, visible, "bf16 euler-50", "euler", 50, 0, 4, 0.001 * worse, 0);
    add(t, scene, still, visible, "b T=0.1", "euler", 50, 0.1, 1 * worse, 0.01 * worse, 0.02);
    add(t, scene, still, visible, "b slow", "ab2", 20, 1e-12, 3, 0.02, 0.02);   /* others are better */
    add(t, scene, still, visible, "b euler-10", "euler", 10, 0, 0.1, 0.005, 0); /* nothing would guard it */
    add(t, scene, still, visible, "b late", "ab2", 40, 1e-12, 7, 0.0001, 0.01); /* could take 1.1 with its guard */
    add(t, scene, still, visible, "b table:2", "euler", 50, 0, 3, 0.1, 0);
    add(t, scene, still, visible, "b table:4", "euler", 50, 0, 2.5, 0.02 * worse, 0);
    add(t, scene, still, visible, "b table:20", "euler", 50, 0, 0.05, 0.00001, 0); /* nobody makes as few calls */
    add(t, scene, still, visible, "f table:2", "euler", 50, 0, 5, 0.1, 0);         /* nor any in that precision */
    if (still) add(t, scene, still, visible, "b rare", "ab2", 9, 1e-12, 0.5, 0.05, 0.03);
}

static void fill(work_table *t, const char *path)
{
    dar_err e;
    ok(work_open(t, path, "some model", &e), &e);
    add_scene(t, "a", true, 0.2, 1);
    add_scene(t, "b", true, 0.4, 2);
    add_scene(t, "c", false, 0.6, 4);
}

static void rows(void **state)
{
    (void)state;
    work_table t, again;
    dar_err e;
    char path[PATH_MAX];
    snprintf(path, sizeof path, "%s", in_dir("rows.csv"));
    fill(&t, path);

    /* What a kill leaves of a line is no row, and the next is whole. */
    FILE *f = fopen(path, "a");
    assert_non_null(f);
    fputs("a,cut,bf16,eul", f);
    fclose(f);
    ok(work_open(&again, path, "some model", &e), &e);
    assert_int_equal(again.n, t.n);
    assert_null(work_find(&again, "a", "cut"));
    add(&again, "a", true, 0.2, "b new", "euler", 50, 0.2, 1, 0.125, 0);
    work_close(&again);
    ok(work_open(&again, path, "some model", &e), &e);
    assert_int_equal(again.n, t.n + 1);
    const work_row *r = work_find(&again, "a", "b new");
    assert_non_null(r);
    CHECK_NEAR("error", r->v[WORK_ERROR], 0.125, 0);
    assert_true(isnan(r->v[WORK_EDGE]));
    work_close(&again);
    refused(work_open(&again, path, "another", &e), &e, "found rows of some model");
    work_close(&again);

    /* A table with other columns is not taken for one with few rows. */
    static const char other[] = "scene,setting,steps\na,full,50\n";
    run_write(in_dir("other.csv"), other, sizeof other - 1);
    refused(work_open(&again, in_dir("other.csv"), "some model", &e), &e, "found no column 'precision'");
    work_close(&again);
    work_close(&t);
}

static void check_setting(const dar_front_row *r, size_t i, const char *name, double time, double error)
{
    assert_true(i < r->settings);
    CHECK(strcmp(r->setting[i].name, name) == 0, "setting %zu: %s, expected %s", i, r->setting[i].name, name);
    CHECK_NEAR(name, r->setting[i].time, time, 1e-6);
    CHECK_NEAR(name, r->setting[i].error, error, 1e-12);
}

static void front(void **state)
{
    (void)state;
    work_table t;
    dar_front f, read;
    dar_err e;
    char path[PATH_MAX], directory[PATH_MAX];
    snprintf(path, sizeof path, "%s", in_dir("front.csv"));
    snprintf(directory, sizeof directory, "%s", scratch_dir);
    fill(&t, path);
    work_front(&t, "m", 1.5, &f);

    /* Geometric means of shares of time, largest errors, in the order of time. */
    const dar_front_row *still = &f.kind[DAR_FRONT_STILL], *any = &f.kind[DAR_FRONT_ANY];
    assert_int_equal(still->scenes, 2);
    assert_int_equal(still->settings, 3);
    check_setting(still, 0, "b rare", 0.05, 0.05);
    check_setting(still, 1, "b T=0.1", sqrt(0.1 * 0.2), 0.02);
    check_setting(still, 2, "bf16 euler-50", 0.4, 0.002);
    assert_int_equal(any->scenes, 3);
    assert_int_equal(any->settings, 3);
    check_setting(any, 0, "b T=0.1", 0.2, 0.04);
    check_setting(any, 1, "b slow", 0.3, 0.02);
    check_setting(any, 2, "bf16 euler-50", 0.4, 0.004);
    CHECK_NEAR("visible", any->visible[1], 0.6, 0);

    ok(work_report(&t, directory, "m", 1.5, in_dir("front.json"), &e), &e);
    assert_true(run_is_there(in_dir("work_precision.html")) && run_is_there(in_dir("work_precision.svg")));
    ok(dar_front_open(&read, in_dir("pareto.json"), "m", &e), &e);
    dar_front_close(&read);
    refused(dar_front_open(&read, in_dir("front.json"), "n", &e), &e, "found \"m\", expected \"n\"");
    ok(dar_front_open(&read, in_dir("front.json"), "m", &e), &e);
    for (int k = 0; k < DAR_FRONT_KINDS; k++) {
        assert_int_equal(read.kind[k].settings, f.kind[k].settings);
        for (size_t i = 0; i < f.kind[k].settings; i++) {
            const dar_front_setting *a = &f.kind[k].setting[i], *b = &read.kind[k].setting[i];
            CHECK_NEAR(a->name, b->error, a->error, 0);
            assert_true(a->solver == b->solver && a->precision == b->precision && a->steps == b->steps);
        }
    }
    dar_front_close(&read);
    work_close(&t);
}

/* Beside each cache what makes no more calls: with a solver of several steps, or with a tolerance. */
static void equal_calls(void **state)
{
    (void)state;
    static const struct {
        const char *cache, *ours;
        double calls[2], error[2];
    } expected[] = {
        { "b table:2", "b slow", { 0.3, 0.3 }, { 0.1, 0.02 } },
        { "b table:4", "b T=0.1", { 0.25, 0.7 / 3 }, { 0.08, 0.04 } },
        { "b table:20", NULL, { 0.005, NAN }, { 0.00001, NAN } },
        { "f table:2", NULL, { 0.5, NAN }, { 0.1, NAN } },
    };
    work_table t;
    work_equal x[8];
    dar_err e;
    char path[PATH_MAX], directory[PATH_MAX], text[512] = "";
    snprintf(path, sizeof path, "%s", in_dir("equal.csv"));
    snprintf(directory, sizeof directory, "%s", scratch_dir);
    fill(&t, path);
    assert_int_equal(work_equals(&t, x, DAR_COUNT(x)), DAR_COUNT(expected));
    for (size_t i = 0; i < DAR_COUNT(expected); i++) {
        const char *found = x[i].ours ? x[i].ours : "none", *right = expected[i].ours ? expected[i].ours : "none";
        CHECK(strcmp(x[i].cache, expected[i].cache) == 0, "%s, expected %s", x[i].cache, expected[i].cache);
        CHECK(strcmp(found, right) == 0, "%s: %s, expected %s", x[i].cache, found, right);
        for (int k = 0; k < (x[i].ours ? 2 : 1); k++) {
            CHECK_NEAR(x[i].cache, x[i].calls[k], expected[i].calls[k], 1e-12);
            CHECK_NEAR(x[i].cache, x[i].error[k], expected[i].error[k], 1e-12);
        }
    }
    const work_ratio r = work_equal_ratio(x, DAR_COUNT(expected)), none = work_equal_ratio(x + 2, 2);
    assert_int_equal(r.n, 2);
    CHECK_NEAR("mean", r.mean, sqrt(0.2 * 0.5), 1e-12);
    CHECK_NEAR("worst", r.worst, 0.5, 1e-12);
    assert_true(none.n == 0 && isnan(none.mean) && isnan(none.worst));

    ok(work_report(&t, directory, "m", 1.5, NULL, &e), &e);
    FILE *f = fopen(in_dir("equal_calls.csv"), "r");
    assert_non_null(f);
    assert_true(fread(text, 1, sizeof text - 1, f) > 0);
    fclose(f);
    CHECK(strstr(text, "\nb table:2,0.3,0.1,b slow,0.3,0.02,0.2\n"), "%s", text);
    CHECK(strstr(text, "\nf table:2,0.5,0.1,,,,\n"), "%s", text);
    work_close(&t);
}

/* By kind of scene: a share of visible pixels that was not measured is any. */
static void choice(void **state)
{
    (void)state;
    work_table t;
    dar_front f;
    char path[PATH_MAX];
    snprintf(path, sizeof path, "%s", in_dir("choice.csv"));
    fill(&t, path);
    work_front(&t, "m", 1.5, &f);
    assert_int_equal(dar_front_kind_of(&f, &(dar_front_scene){ true, 0.3 }), DAR_FRONT_STILL);
    assert_int_equal(dar_front_kind_of(&f, &(dar_front_scene){ true, 0.5 }), DAR_FRONT_ANY);
    assert_int_equal(dar_front_kind_of(&f, &(dar_front_scene){ true, NAN }), DAR_FRONT_ANY);
    assert_int_equal(dar_front_kind_of(&f, &(dar_front_scene){ false, 0.6 }), DAR_FRONT_MOVING);

    assert_null(dar_front_pick(&f, DAR_FRONT_STILL, DAR_BF16, 0.0029));
    assert_null(dar_front_pick(&f, DAR_FRONT_STILL, DAR_F32, 1));
    const dar_front_setting *s = dar_front_pick(&f, DAR_FRONT_STILL, DAR_BF16, 0.0749);
    assert_non_null(s);
    CHECK(strcmp(s->name, "b T=0.1") == 0, "%s", s->name);
    dar_sampler_config c = dar_sampler_default();
    dar_front_apply(&f, s, &c);
    CHECK_NEAR("guard", c.solver.budget, 1.5 * 0.02, 1e-15);
    CHECK_NEAR("tolerance", c.solver.tolerance, 0.1, 0);
    work_close(&t);
}

int main(void)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(rows),
        cmocka_unit_test(front),
        cmocka_unit_test(equal_calls),
        cmocka_unit_test(choice),
    };
    return cmocka_run_group_tests_name("front", tests, scratch_make, scratch_remove) != 0;
}
