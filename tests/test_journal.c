/* test_journal.c: the log of a run that is stopped, killed and resumed is that of one that was not. */
#include "tests/scratch.h"

#include <signal.h>
#include <sys/resource.h>

#include "lib/json.h"
#include "lib/log.h"
#include "lib/rng.h"
#include "train/journal_inside.h"

#define STEPS 60

/* A run that is its step numbers: losses fall, one is not finite, step 7 is skipped. */
static double loss_at(int64_t step)
{
    return step == 7 ? NAN : exp(-(double)step / 30) * (0.5 + dar_rng_f64(1, 1, (uint64_t)step));
}

static dar_journal *open_at(const char *run, int64_t resumed)
{
    dar_journal_options o = { .run = run, .steps = STEPS, .tokens = 560, .flops = 3e9, .peak = 1e11 };
    dar_journal *j;
    dar_err e;
    ok(dar_journal_open(&j, &o, resumed, &e), &e);
    return j;
}

static dar_status step(dar_journal *j, int64_t k, dar_err *e)
{
    dar_journal_entry x = { .step = k, .loss = loss_at(k), .sigma = dar_rng_f64(2, 2, (uint64_t)k), .rate = 1e-4 };
    x.norm = x.loss / 2;
    x.seconds = 0.01;
    x.skipped = k == 7;
    x.nonfinite = "blocks.0.modulation";
    return dar_journal_step(j, &x, e);
}

static void steps(dar_journal *j, int64_t from, int64_t to)
{
    dar_err e;
    for (int64_t k = from; k <= to; k++) {
        ok(step(j, k, &e), &e);
        if (k % 20) continue;
        dar_json_writer *w = dar_journal_line(j, "sensitivity", k);
        dar_json_write_number(w, "loss", 0.5 / (double)k);
        dar_json_write_number(w, "shuffled", 0.75 / (double)k);
        ok(dar_journal_end(j, &e), &e);
    }
}

/* ---------------------------------------------------------------- reading it */

typedef struct past {
    struct {
        char kind[16];
        int64_t step;
        double x[5];
    } line[3 * STEPS];
    int n, starts;
} past;

static bool note(void *ctx, const dar_journal_past *x)
{
    past *p = ctx;
    if (strcmp(x->kind, "start") == 0) {
        p->starts++;
        return true;
    }
    assert_in_range(p->n, 0, 3 * STEPS - 1);
    snprintf(p->line[p->n].kind, 16, "%s", x->kind);
    p->line[p->n].step = x->step;
    memcpy(p->line[p->n++].x, (double[]){ x->loss, x->smoothed, x->sigma, x->norm, x->rate }, 5 * sizeof(double));
    return true;
}

static past read_log(const char *run)
{
    char path[PATH_MAX];
    past p = { .n = 0 };
    dar_err e;
    snprintf(path, sizeof path, "%s/log.jsonl", run);
    ok(dar_journal_scan(path, note, &p, &e), &e);
    return p;
}

/* Every number with the same bits, where both are numbers. */
static void same_log(const past *a, const past *b)
{
    assert_int_equal(a->n, b->n);
    for (int i = 0; i < a->n; i++) {
        assert_string_equal(a->line[i].kind, b->line[i].kind);
        assert_int_equal(a->line[i].step, b->line[i].step);
        for (int k = 0; k < 5; k++) {
            double x = a->line[i].x[k], y = b->line[i].x[k];
            CHECK(x == y || (isnan(x) && isnan(y)), "line %d, number %d: %.17g and %.17g", i, k, x, y);
        }
    }
}

static past whole_run(const char *run)
{
    assert_int_equal(mkdir(run, 0777), 0);
    dar_journal *j = open_at(run, 0);
    steps(j, 1, STEPS);
    dar_journal_close(j);
    return read_log(run);
}

/* ---------------------------------------------------------------- */

static void lines(void **state)
{
    (void)state;
    const char *run = in_dir("lines");
    past p = whole_run(run);
    assert_int_equal(p.n, STEPS + STEPS / 20);
    double sum = 0, weight = 0;
    for (int i = 0, k = 1; i < p.n; i++) {
        if (strcmp(p.line[i].kind, "step") != 0) continue;
        assert_int_equal(p.line[i].step, k);
        if (isfinite(loss_at(k))) {
            sum = 0.99 * sum + loss_at(k);
            weight = 0.99 * weight + 1;
        }
        CHECK_NEAR("smoothed", p.line[i].x[1], sum / weight, 1e-14);
        if (k != 7) CHECK_NEAR("loss", p.line[i].x[0], loss_at(k), 0);
        k++;
    }
    char text[1 << 16];
    run_read(in_dir("lines/log.jsonl"), text, sizeof text);
    assert_non_null(strstr(text, "\"step\": 7, \"loss\": null, "));
    assert_non_null(strstr(text, "\"skipped\": \"blocks.0.modulation\"}\n"));
    assert_non_null(strstr(text, "\"tokens_per_second\": 56000, \"fraction_of_peak\": 3, "));

    /* A row per step: the mean over its one loss, in the bucket of its sigma. */
    run_read(in_dir("lines/loss.csv"), text, sizeof text);
    char *at = strchr(text, '\n') + 1;
    for (int64_t k = 1; k <= STEPS; k++, at = strchr(at, '\n') + 1) {
        double bucket = NAN, sigma = dar_rng_f64(2, 2, (uint64_t)k);
        char *cell = at;
        for (int i = 0; i < 7 + (int)(10 * sigma); i++) cell = strchr(cell, ',') + 1;
        assert_int_equal(strtoll(at, NULL, 10), k);
        if (*cell != ',' && *cell != '\n') bucket = strtod(cell, NULL);
        if (k == 7) CHECK(isnan(bucket), "step 7: %g", bucket);
        else CHECK_NEAR("bucket", bucket, loss_at(k), 0);
    }
    assert_int_equal(*at, 0);
    assert_true(run_is_there(in_dir("lines/loss_sigma.svg")) && !run_is_there(in_dir("lines/psnr.svg")));
    run_read(in_dir("lines/loss.svg"), text, sizeof text);
    assert_non_null(strstr(text, ">40, 0.0125</title>"));
    assert_non_null(strstr(text, ">40, 0.01875</title>"));
}

/* However a line ends early, what is before it stays; what is after the checkpoint goes. */
static void resumed(void **state)
{
    (void)state;
    past whole = whole_run(in_dir("whole"));
    assert_int_equal(mkdir(in_dir("cut"), 0777), 0);
    for (int64_t at = 0; at < STEPS; at += 11)
        for (int64_t more = 0; more <= 4; more += 2) {
            dar_journal *j = open_at(in_dir("cut"), 0);
            steps(j, 1, at + more);
            dar_journal_close(j);
            struct stat st;
            assert_int_equal(stat(in_dir("cut/log.jsonl"), &st), 0);
            /* A kill cuts the last line, which is of a step that no checkpoint has. */
            off_t cut = more ? (off_t)(dar_rng_u64(3, (uint64_t)at, (uint64_t)more) % 100) : 0;
            assert_int_equal(truncate(in_dir("cut/log.jsonl"), st.st_size - cut), 0);
            j = open_at(in_dir("cut"), at);
            steps(j, at + 1, STEPS);
            dar_journal_close(j);
            past p = read_log(in_dir("cut"));
            same_log(&p, &whole);
            assert_int_equal(p.starts, at ? 2 : 1);
        }
}

/* A log that grows no further ends the run with one line and holds whole lines only. */
static void disk_full(void **state)
{
    (void)state;
    struct rlimit old, limit;
    dar_err e;
    assert_int_equal(mkdir(in_dir("full"), 0777), 0);
    signal(SIGXFSZ, SIG_IGN);
    assert_int_equal(getrlimit(RLIMIT_FSIZE, &old), 0);
    for (rlim_t most = 2000; most < 2300; most += 37) {
        dar_journal *j = open_at(in_dir("full"), 0);
        dar_status s = DAR_OK;
        limit = (struct rlimit){ most, old.rlim_max };
        assert_int_equal(setrlimit(RLIMIT_FSIZE, &limit), 0);
        int64_t k = 0;
        while (s == DAR_OK && k < STEPS) s = step(j, ++k, &e);
        assert_int_equal(setrlimit(RLIMIT_FSIZE, &old), 0);
        CHECK(s == DAR_ERR_NOMEM && strstr(e.text, "full/log.jsonl: File too large"), "%s", e.text);
        past p = read_log(in_dir("full"));
        assert_int_equal(p.n, k - 1);
        ok(step(j, k, &e), &e); /* there is room again */
        dar_journal_close(j);
        p = read_log(in_dir("full"));
        assert_int_equal(p.n, k);
    }
}

int main(void)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(lines),
        cmocka_unit_test(resumed),
        cmocka_unit_test(disk_full),
    };
    dar_log_set(DAR_LOG_ERROR);
    return cmocka_run_group_tests_name("journal", tests, scratch_make, scratch_remove) != 0;
}
