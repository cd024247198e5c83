/* test_front.c: measured rows become a front, the front a file, the file a choice. */
#include "tests/scratch.h"

#include "tests/work.h"

/* A setting on a scene; the full run takes 10 s. */
static void add(work_table *t, const char *scene, bool still, double visible, const char *setting, const char *solver,
                double steps, double tolerance, double seconds, double error, double estimate)
{
    work_row row = { 0 };
    dar_err e;
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
        cmocka_unit_test(choice),
    };
    return cmocka_run_group_tests_name("front", tests, scratch_make, scratch_remove) != 0;
}
