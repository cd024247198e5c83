/* test_kill.c: dar-train killed at random moments, while saving too, and short of disk: it resumes with what it had
 * saved, and ends with the bits of a run that was left alone; long runs.  `test_kill full`, from make stress, kills 200
 * times and trains 100,000 steps. */
#include "tests/small.h"

#include <dirent.h>
#include <signal.h>
#include <sys/resource.h>
#include <time.h>

#include "lib/log.h"
#include "lib/rng.h"
#include "tests/scratch.h"
#include "train/journal_inside.h"

#define STEPS    40 /* of a run, a checkpoint after each third */
#define EVERY    3
#define TEXT(x)  TEXT_(x)
#define TEXT_(x) #x

static char program[PATH_MAX], bundler[PATH_MAX];
static int kills = 20; /* in all */
static int saving;     /* runs killed while they saved */

#define SET(text) "--set", text

static pid_t start(const char *out, const char *kind)
{
    char set[64];
    snprintf(set, sizeof set, "output_dir=%s", out);
    return run_start(program,
                     (const char *const[]){ "lora.json", SET(set), SET("max_train_steps=" TEXT(STEPS)),
                                            SET("checkpointing_steps=" TEXT(EVERY)), SET("checkpoints_total_limit=2"),
                                            SET(kind), "--resume", "auto", "--threads", "1", "--quiet", NULL });
}

/* ---------------------------------------------------------------- what a run has */

/* Step of the newest checkpoint, 0: none.  Everything else in the directory is known. */
static int64_t newest(const char *run)
{
    static const char *const known[] = { "log.jsonl", "loss.csv", "loss.svg", "loss_sigma.svg", ".", "..", "samples" };
    int64_t most = 0, step;
    DIR *d = opendir(run);
    if (!d) return 0;
    for (const struct dirent *x; (x = readdir(d));) {
        bool expected = strstr(x->d_name, ".tmp-") != NULL;
        saving += strncmp(x->d_name, "checkpoint-", 11) == 0 && expected;
        for (size_t i = 0; i < DAR_COUNT(known); i++) expected |= strcmp(x->d_name, known[i]) == 0;
        if (strncmp(x->d_name, "checkpoint-", 11) == 0 && !strchr(x->d_name, '.')) {
            step = strtoll(x->d_name + 11, NULL, 10);
            most = step > most ? step : most;
            expected = true;
        }
        CHECK(expected, "%s/%s", run, x->d_name);
    }
    closedir(d);
    return most;
}

typedef struct story {
    int64_t started; /* step of the last start */
    int64_t last;
    double loss[STEPS + 1];
} story;

/* Steps come one after the other, none twice, none left out. */
static bool note(void *ctx, const dar_journal_past *x)
{
    story *s = ctx;
    if (strcmp(x->kind, "start") == 0) {
        s->started = x->step;
        return true;
    }
    CHECK(x->step == s->last + 1 && x->step <= STEPS, "step %lld after %lld", (long long)x->step, (long long)s->last);
    s->loss[++s->last] = x->loss;
    return true;
}

static story read_log(const char *run)
{
    char path[PATH_MAX];
    story s = { .started = -1 };
    dar_err e;
    snprintf(path, sizeof path, "%s/log.jsonl", run);
    CHECK(dar_journal_scan(path, note, &s, &e) == DAR_OK, "%s", e.text);
    return s;
}

static void same_end(const char *a, const char *b)
{
    static const char *const files[] = { "adapter.safetensors", "lora.safetensors", "optimizer.safetensors" };
    char x[PATH_MAX], y[PATH_MAX];
    for (size_t i = 0; i < DAR_COUNT(files); i++) {
        snprintf(x, sizeof x, "%s/checkpoint-" TEXT(STEPS) "/%s", a, files[i]);
        snprintf(y, sizeof y, "%s/checkpoint-" TEXT(STEPS) "/%s", b, files[i]);
        run_same_file(x, y);
    }
    story p = read_log(a), q = read_log(b);
    assert_int_equal(p.last, STEPS);
    assert_int_equal(q.last, STEPS);
    for (int k = 1; k <= STEPS; k++) CHECK_NEAR("loss", p.loss[k], q.loss[k], 0);
}

static int leave_alone(pid_t pid)
{
    int status = run_finish(pid);
    CHECK(status == 0, "status %d: %s", status, ran.err);
    return status;
}

/* ---------------------------------------------------------------- kills */

/* One run, killed again and again until it ends by itself; returns how often. */
static int kill_often(const char *run, const char *kind, uint64_t which, int most)
{
    int64_t after = 0;
    double longest = 0.3; /* [s] that it lives, at most; longer where the machine is slow */
    for (int n = 0; n < most; n++) {
        int64_t before = after;
        pid_t pid = start(run, kind);
        double wait = longest * dar_rng_f64(77, which, (uint64_t)n);
        nanosleep(&(struct timespec){ (time_t)wait, (long)(1e9 * (wait - floor(wait))) }, NULL);
        kill(pid, SIGKILL);
        int status = run_finish(pid);
        if (status == 0) return n;
        CHECK(status == 128 + SIGKILL, "status %d: %s", status, ran.err);
        CHECK(!strstr(ran.err, "damaged"), "%s", ran.err);

        after = newest(run);
        story s = read_log(run);
        CHECK(after >= before, "checkpoint-%lld is lost, found %lld", (long long)before, (long long)after);
        CHECK(s.last >= after, "the log ends at %lld, the checkpoint is of %lld", (long long)s.last, (long long)after);
        if (s.started > 0)
            CHECK(s.started >= before || s.last >= before, "resumed at %lld of %lld", (long long)s.started,
                  (long long)before);
        if (after == before) longest *= 1.2;
        else longest = fmax(0.3, longest / 1.1);
    }
    leave_alone(start(run, kind));
    return most;
}

static void killed(void **state)
{
    (void)state;
    static const char *const kinds[] = { "adam_moments=f32", "adam_moments=bf16", "ema_decay=0.9" };
    char run[32], whole[32];
    int done = 0;
    for (int i = 0; i < 3; i++) {
        snprintf(whole, sizeof whole, "whole-%d", i);
        leave_alone(start(whole, kinds[i]));
    }
    for (int i = 0; done < kills; i++) {
        snprintf(run, sizeof run, "killed-%d", i);
        snprintf(whole, sizeof whole, "whole-%d", i % 3);
        done += kill_often(run, kinds[i % 3], (uint64_t)i, kills - done);
        same_end(run, whole);
        assert_int_equal(run_remove(run), 0);
    }
    printf("note: %d kills, %d of them while a checkpoint was written or removed\n", done, saving);
}

/* ---------------------------------------------------------------- a full disk */

/* A limit on the size of files that lets the log grow but not a checkpoint be written: one line, status 3; with more
 * room the run ends as if nothing had been. */
static void disk_full(void **state)
{
    (void)state;
    struct rlimit old, limit;
    pid_t pid = start("full", "max_train_steps=" TEXT(EVERY));
    leave_alone(pid);
    assert_int_equal(getrlimit(RLIMIT_FSIZE, &old), 0);
    limit = (struct rlimit){ 30000, old.rlim_max };
    assert_int_equal(setrlimit(RLIMIT_FSIZE, &limit), 0);
    pid = start("full", "adam_moments=f32");
    assert_int_equal(setrlimit(RLIMIT_FSIZE, &old), 0);
    int status = run_finish(pid);
    CHECK(status == 3 && strstr(ran.err, "full/checkpoint-6: not saved: ") && strstr(ran.err, "File too large") &&
              run_one_line(ran.err),
          "status %d: %s", status, ran.err);
    assert_int_equal(newest("full"), EVERY);
    leave_alone(start("full", "adam_moments=f32"));
    same_end("full", "whole-0");
}

/* ---------------------------------------------------------------- long runs */

typedef struct growth {
    int64_t steps, last;
    double peak[2]; /* [bytes] after a third of the steps, at the end */
} growth;

static bool watch(void *ctx, const dar_journal_past *x)
{
    growth *g = ctx;
    if (strcmp(x->kind, "step") != 0) return true;
    CHECK(isfinite(x->loss) && isfinite(x->norm), "step %lld: loss %g, norm %g", (long long)x->step, x->loss, x->norm);
    if (3 * x->step <= g->steps) g->peak[0] = x->peak_bytes;
    g->peak[1] = x->peak_bytes;
    g->last = x->step;
    return true;
}

/* A sanitizer keeps what is freed: there memory tells nothing. */
#ifdef __SANITIZE_ADDRESS__
enum { SANITIZED = 1 };
#else
enum { SANITIZED = 0 };
#endif

/* Losses stay numbers and memory what it is: a log that were kept, or mapped, would show. */
static void no_growth(void **state)
{
    (void)state;
    char steps[64], every[64];
    growth g = { .steps = kills == 200 ? 100000 : 1500 };
    dar_err e;
    snprintf(steps, sizeof steps, "max_train_steps=%lld", (long long)g.steps);
    snprintf(every, sizeof every, "checkpointing_steps=%lld", (long long)g.steps / 6);
    int status =
        RUN_PROGRAM(program, "lora.json", SET("output_dir=long"), SET(steps), SET(every), "--threads", "1", "--quiet");
    CHECK(status == 0, "status %d: %s", status, ran.err);
    CHECK(dar_journal_scan("long/log.jsonl", watch, &g, &e) == DAR_OK, "%s", e.text);
    assert_int_equal(g.last, g.steps);
    CHECK(SANITIZED || g.peak[1] <= g.peak[0] + 1.3e5, "memory grew from %.0f to %.0f bytes", g.peak[0], g.peak[1]);
}

static int setup(void **state)
{
    if (scratch_make(state) || chdir(scratch_dir)) return -1;
    small_make(bundler);
    return RUN_PROGRAM(program, "backbone.json");
}

int main(int argc, char **argv)
{
    static const struct CMUnitTest tests[] = { cmocka_unit_test(killed), cmocka_unit_test(disk_full),
                                               cmocka_unit_test(no_growth) };
    if (argc > 1 && strcmp(argv[1], "full") == 0) kills = 200;
    if (!run_find(program, argv[0], "dar-train") || !run_find(bundler, argv[0], "dar-bundle")) return 2;
    return cmocka_run_group_tests_name("kill", tests, setup, scratch_remove) != 0;
}
