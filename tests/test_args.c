/* test_args.c: command lines, help, events, progress, signals to stop. */
#include "tests/test.h"

#include <fcntl.h>
#include <signal.h>
#include <spawn.h>
#include <sys/wait.h>
#include <unistd.h>

#include "lib/args.h"
#include "lib/log.h"
#include "lib/program.h"

extern char **environ;

static struct {
    int64_t steps, size[2];
    double guidance;
    const char *out;
    int solver;
    bool fast;
    dar_arg_list set, pictures;
    dar_common common;
} o;

static const char *const solvers[] = { "euler", "ab2", "unipc", NULL };

static const dar_option options[] = {
    { .help = "Sampling" },
    { .name = "steps",
      .placeholder = "N",
      .type = DAR_ARG_INT,
      .target = &o.steps,
      .standard = "50",
      .lo = 1,
      .hi = 1000,
      .help = "solver steps; more of them are slower and, up to a point that depends on the solver, more exact" },
    { .name = "guidance",
      .placeholder = "X",
      .type = DAR_ARG_NUMBER,
      .target = &o.guidance,
      .standard = "3",
      .hi = 20,
      .help = "strength of the text" },
    { .name = "solver",
      .placeholder = "euler|ab2|unipc",
      .type = DAR_ARG_CHOICE,
      .target = &o.solver,
      .standard = "euler",
      .names = solvers,
      .help = "integrator" },
    { .help = "Files" },
    { .name = "out", .letter = 'o', .placeholder = "DIR", .type = DAR_ARG_TEXT, .target = &o.out, .help = "result" },
    { .name = "size",
      .placeholder = "WxH",
      .type = DAR_ARG_SIZE,
      .target = o.size,
      .standard = "64x32",
      .lo = 8,
      .hi = 4096,
      .help = "of the picture [px]" },
    { .name = "set", .placeholder = "KEY=VALUE", .type = DAR_ARG_LIST, .target = &o.set, .help = "override" },
    { .name = "picture", .placeholder = "IMG", .type = DAR_ARG_WORDS, .target = &o.pictures, .help = "several" },
    { .name = "fast", .type = DAR_ARG_FLAG, .target = &o.fast, .help = "skip" },
};

#define MAX_WORDS 80

static dar_status parse(dar_program *p, const char *const *words, dar_err *e)
{
    static char *argv[MAX_WORDS + 2];
    int argc = 1;
    memset(&o, 0, sizeof o);
    *p = (dar_program){ .name = "dar-test",
                        .summary = "Show how it is done.",
                        .options = options,
                        .n_options = DAR_COUNT(options),
                        .common = &o.common,
                        .rest_name = "BUNDLE...",
                        .rest_help = "directories to render",
                        .rest_least = 1,
                        .rest_most = 3 };
    argv[0] = (char *)(uintptr_t) "dar-test";
    for (; *words; words++) argv[argc++] = (char *)(uintptr_t)*words;
    return dar_args_parse(p, argc, argv, e);
}

#define WORDS(...) ((const char *const[]){ __VA_ARGS__, NULL })

static void defaults(void **state)
{
    (void)state;
    dar_program p;
    dar_err e;
    CHECK(parse(&p, WORDS("x"), &e) == DAR_OK, "%s", e.text);
    assert_int_equal(o.steps, 50);
    CHECK_NEAR("guidance", o.guidance, 3, 0);
    assert_int_equal(o.size[0], 64);
    assert_int_equal(o.size[1], 32);
    assert_null(o.out);
    assert_false(o.fast);
    assert_int_equal(o.common.threads, 0);
    assert_string_equal(o.common.cpu_mask, "all");
    assert_int_equal(p.rests, 1);
}

static void everything(void **state)
{
    (void)state;
    dar_program p;
    dar_err e;
    CHECK(parse(&p,
                WORDS("a", "--steps=7", "--guidance", "-0", "b", "-o", "dir", "--set", "x=1", "--set=y=", "--fast",
                      "--size=640x480", "--solver", "unipc", "--seed=18446744073709551615", "--threads", "3",
                      "--cpu-mask=avx2", "--quiet", "--json", "--dry-run", "--steps", "8", "--", "--odd"),
                &e) == DAR_OK,
          "%s", e.text);
    assert_int_equal(o.steps, 8); /* the last one wins */
    CHECK_NEAR("guidance", o.guidance, 0, 0);
    assert_string_equal(o.out, "dir");
    assert_int_equal(o.set.n, 2);
    assert_string_equal(o.set.at[0], "x=1");
    assert_string_equal(o.set.at[1], "y=");
    assert_true(o.fast);
    assert_int_equal(o.size[0], 640);
    assert_int_equal(o.size[1], 480);
    assert_int_equal(o.solver, 2);
    assert_true(o.common.seed == UINT64_MAX);
    assert_int_equal(o.common.threads, 3);
    assert_true(o.common.quiet && o.common.json && o.common.dry_run);
    assert_int_equal(p.rests, 3);
    assert_string_equal(p.rest[0], "a");
    assert_string_equal(p.rest[1], "b");
    assert_string_equal(p.rest[2], "--odd");
    assert_int_equal(parse(&p, WORDS("-odir", "-"), &e), DAR_OK);
    assert_string_equal(o.out, "dir");
    assert_string_equal(p.rest[0], "-");
}

/* Words end where an option begins, or at --. */
static void words(void **state)
{
    (void)state;
    dar_program p;
    dar_err e;
    assert_int_equal(
        parse(&p, WORDS("x", "--picture", "a", "b", "--fast", "y", "--picture=c", "z", "--picture", "d", "--", "-w"),
              &e),
        DAR_ERR_USAGE);
    assert_int_equal(
        parse(&p, WORDS("x", "--picture", "a", "b", "--fast", "--picture=c", "z", "--picture", "d", "--", "-w"), &e),
        DAR_OK);
    assert_int_equal(o.pictures.n, 4);
    for (size_t i = 0; i < 4; i++) assert_string_equal(o.pictures.at[i], ((const char *[]){ "a", "b", "c", "d" })[i]);
    assert_int_equal(p.rests, 3);
    assert_string_equal(p.rest[1], "z");
    assert_string_equal(p.rest[2], "-w");
    assert_int_equal(parse(&p, WORDS("--picture", "a", "x"), &e), DAR_ERR_USAGE);
    assert_string_equal(e.text, "dar-test: expected BUNDLE..., before --picture, which takes all words that follow");
}

static void refusals(void **state)
{
    (void)state;
    static const struct {
        const char *words[3];
        const char *message;
    } bad[] = {
        { { "--stesp", "3" }, "dar-test: --stesp: unknown option; did you mean --steps?" },
        { { "--dryrun" }, "dar-test: --dryrun: unknown option; did you mean --dry-run?" },
        { { "--hepl" }, "dar-test: --hepl: unknown option; did you mean --help?" },
        { { "--qwertz=1" }, "dar-test: --qwertz: unknown option; --help lists them" },
        { { "-x" }, "dar-test: -x: unknown option; --help lists them" },
        { { "--step=1" }, "dar-test: --step: unknown option; did you mean --steps?" },
        { { "--steps" }, "dar-test: --steps: expected a value N" },
        { { "--steps", "--fast" }, "dar-test: --steps: expected a value N" },
        { { "--steps=" }, "dar-test: --steps: found '', expected an integer from 1 to 1000" },
        { { "--steps=0" }, "dar-test: --steps: found '0', expected an integer from 1 to 1000" },
        { { "--steps=5x" }, "dar-test: --steps: found '5x', expected an integer from 1 to 1000" },
        { { "--steps= 5" }, "dar-test: --steps: found ' 5', expected an integer from 1 to 1000" },
        { { "--steps=99999999999999999999" },
          "dar-test: --steps: found '99999999999999999999', expected an integer from 1 to 1000" },
        { { "--guidance=nan" }, "dar-test: --guidance: found 'nan', expected a number from 0 to 20" },
        { { "--guidance=1e999" }, "dar-test: --guidance: found '1e999', expected a number from 0 to 20" },
        { { "--guidance=0x1" }, "dar-test: --guidance: found '0x1', expected a number from 0 to 20" },
        { { "--seed=-1" }, "dar-test: --seed: found '-1', expected an integer from 0 to 2^64 - 1" },
        { { "--seed=18446744073709551616" },
          "dar-test: --seed: found '18446744073709551616', expected an integer from 0 to 2^64 - 1" },
        { { "--solver=heun" }, "dar-test: --solver: found 'heun', expected one of euler, ab2, unipc" },
        { { "--size=64" }, "dar-test: --size: found '64', expected WIDTHxHEIGHT, both from 8 to 4096" },
        { { "--size=64x7" }, "dar-test: --size: found '64x7', expected WIDTHxHEIGHT, both from 8 to 4096" },
        { { "--size=64x64x" }, "dar-test: --size: found '64x64x', expected WIDTHxHEIGHT, both from 8 to 4096" },
        { { "--out=" }, "dar-test: --out: found '', expected a value" },
        { { "--fast=yes" }, "dar-test: --fast: takes no value" },
        { { "--quiet" }, "dar-test: expected BUNDLE...; --help tells more" },
    };
    dar_program p;
    dar_err e;
    for (size_t i = 0; i < DAR_COUNT(bad); i++) {
        dar_status s = parse(&p, bad[i].words, &e);
        CHECK(s == DAR_ERR_USAGE && dar_status_exit(s) == 2, "%s: accepted", bad[i].words[0]);
        CHECK(strcmp(e.text, bad[i].message) == 0, "found:    %s\nexpected: %s", e.text, bad[i].message);
    }
    assert_int_equal(parse(&p, WORDS("a", "b", "c", "d"), &e), DAR_ERR_USAGE);
    assert_string_equal(e.text, "dar-test: unexpected argument 'd'");

    const char *many[MAX_WORDS] = { NULL };
    for (size_t i = 0; i <= DAR_ARG_MANY; i++) many[i] = "--set=a=1";
    assert_int_equal(parse(&p, many, &e), DAR_ERR_USAGE);
    assert_string_equal(e.text, "dar-test: --set: given more than 64 times");
}

static void common_block(void **state)
{
    (void)state;
    dar_program p;
    dar_err e;
    unsigned flags = dar_cpu_flags();
    int threads = dar_threads();
    assert_int_equal(parse(&p, WORDS("x", "--cpu-mask", "none", "--threads=3"), &e), DAR_OK);
    assert_int_equal(dar_common_apply(&o.common, &e), DAR_OK);
    assert_int_equal(dar_cpu_flags(), 0);
    assert_int_equal(dar_threads(), 3);
    dar_cpu_init(flags);
    dar_threads_set(threads);
    assert_int_equal(parse(&p, WORDS("x", "--cpu-mask", "sse9"), &e), DAR_OK);
    assert_int_equal(dar_common_apply(&o.common, &e), DAR_ERR_USAGE);
}

static char *contents(FILE *f, char *buf, size_t size)
{
    rewind(f);
    buf[fread(buf, 1, size - 1, f)] = 0;
    return buf;
}

static void help(void **state)
{
    (void)state;
    dar_program p;
    dar_err e;
    char text[4096], *line = text;
    FILE *f = tmpfile();
    assert_int_equal(parse(&p, WORDS("--help", "--fast"), &e), DAR_OK); /* though BUNDLE is missing */
    assert_true(dar_args_answer(&p, f));
    contents(f, text, sizeof text);
    assert_non_null(strstr(text, "usage: dar-test BUNDLE... [options]\n\nShow how it is done.\n"));
    assert_non_null(strstr(text, "\n  BUNDLE...               directories to render\n"));
    assert_non_null(strstr(text, "\nSampling:\n"
                                 "  --steps N               solver steps; more of them are slower and, up to a\n"
                                 "                          point that depends on the solver, more exact (default:\n"
                                 "                          50)\n"));
    assert_non_null(
        strstr(text, "\n  --solver euler|ab2|unipc\n                          integrator (default: euler)\n"));
    assert_non_null(strstr(text, "\n  -o, --out DIR           result\n"));
    assert_non_null(strstr(text, "\nOptions of every program:\n  --threads N "));
    for (char *end; (end = strchr(line, '\n')); line = end + 1)
        CHECK(end - line <= 80, "line of %d columns: %.*s", (int)(end - line), (int)(end - line), line);
    fclose(f);

    f = tmpfile();
    assert_int_equal(parse(&p, WORDS("--version"), &e), DAR_OK);
    assert_true(dar_args_answer(&p, f));
    assert_string_equal(contents(f, text, sizeof text), "dar-test " DAR_VERSION "\n");
    assert_int_equal(parse(&p, WORDS("x"), &e), DAR_OK);
    assert_false(dar_args_answer(&p, f));
    fclose(f);
}

/* A program of commands stops at the first word; what follows is the command's. */
static void commands(void **state)
{
    (void)state;
    static const dar_program render = { .name = "dar-test render", .summary = "Draw it." },
                             check = { .name = "dar-test check", .summary = "Judge it." };
    static const dar_program *const both[] = { &render, &check, NULL };
    static char *argv[][4] = { { "dar-test", "check", "--json", "render" },
                               { "dar-test", "--help", "chekc" },
                               { "dar-test", "chekc" },
                               { "dar-test", "paint" },
                               { "dar-test", "" },
                               { "dar-test" } };
    static const char *const message[] = { [2] = "dar-test: found 'chekc', expected a command; did you mean check?",
                                           [3] = "dar-test: found 'paint', expected a command: render, check",
                                           [4] = "dar-test: expected a command: render, check",
                                           [5] = "dar-test: expected a command: render, check" };
    const dar_program *c;
    char text[4096];
    dar_err e;
    for (size_t i = 0; i < DAR_COUNT(argv); i++) {
        dar_program p = { .name = "dar-test", .summary = "Show how it is done.", .commands = both };
        int argc = 0;
        while (argc < 4 && argv[i][argc]) argc++;
        assert_int_equal(dar_args_parse(&p, argc, argv[i], &e), DAR_OK);
        dar_status s = dar_args_command(&p, &c, &e);
        if (message[i]) {
            CHECK(s == DAR_ERR_USAGE && !c, "'%s': accepted", argv[i][1]);
            CHECK(strcmp(e.text, message[i]) == 0, "found:    %s\nexpected: %s", e.text, message[i]);
        } else if (i == 0) {
            assert_ptr_equal(c, &check);
            assert_int_equal(p.rests, 3);
            assert_string_equal(p.rest[1], "--json");
        } else {
            FILE *f = tmpfile();
            assert_true(dar_args_answer(&p, f));
            contents(f, text, sizeof text);
            assert_non_null(strstr(text, "usage: dar-test COMMAND [options]\n"));
            assert_non_null(
                strstr(text, "\n  render                  Draw it.\n  check                   Judge it.\n"));
            fclose(f);
        }
    }
}

/* What fn prints to standard error. */
static char *printed(void (*fn)(void), char *buf, size_t size)
{
    FILE *f = tmpfile();
    int old = dup(STDERR_FILENO);
    fflush(stderr);
    dup2(fileno(f), STDERR_FILENO);
    fn();
    fflush(stderr);
    dup2(old, STDERR_FILENO);
    close(old);
    contents(f, buf, size);
    fclose(f);
    return buf;
}

static void some_events(void)
{
    dar_log(DAR_LOG_INFO, "%d clips", 3);
    dar_log(DAR_LOG_WARNING, "two\nlines");
    dar_log(DAR_LOG_ERROR, "%s", "bad");
    dar_log(DAR_LOG_DEBUG, "unseen");
}

static void some_progress(void)
{
    dar_progress p = dar_progress_begin("sample", "steps", 4);
    for (int i = 1; i <= 4; i++) dar_progress_step(&p, i, NULL); /* too fast to be told */
    dar_progress_end(&p);
    p.interval = 0;
    dar_progress_step(&p, 2, "loss 0.5");
}

static void events(void **state)
{
    (void)state;
    char text[1024];
    assert_string_equal(printed(some_events, text, sizeof text), "3 clips\nwarning: two lines\nerror: bad\n");
    printed(some_progress, text, sizeof text);
    assert_int_equal(strncmp(text, "sample: 4/4 steps, 100 %, ", 26), 0);
    char *second = strchr(text, '\n') + 1;
    assert_int_equal(strncmp(second, "sample: 2/4 steps, 50 %, ", 25), 0);
    assert_string_equal(second + strlen(second) - 11, ", loss 0.5\n");
    dar_log_set(DAR_LOG_WARNING);
    assert_string_equal(printed(some_events, text, sizeof text), "warning: two lines\nerror: bad\n");
    assert_string_equal(printed(some_progress, text, sizeof text), "");
    dar_log_set(DAR_LOG_INFO);
}

static void progress_text(void **state)
{
    (void)state;
    static const struct {
        double seconds;
        const char *text;
    } spans[] = { { 0, "0.0 s" },        { 9.94, "9.9 s" },     { 9.96, "10 s" },      { 59.6, "1 min 0 s" },
                  { 200, "3 min 20 s" }, { 7500, "2 h 5 min" }, { 273600, "3 d 4 h" }, { 1e30, "11574 d 1 h" } };
    char buf[128];
    for (size_t i = 0; i < DAR_COUNT(spans); i++)
        assert_string_equal(dar_log_duration(spans[i].seconds, buf, sizeof buf), spans[i].text);

    dar_progress p = { .what = "train", .unit = "steps", .total = 1300 };
    assert_string_equal(dar_progress_text(&p, 0, NULL, buf, sizeof buf), "train: 0/1300 steps, 0 %");
    p.done = 130;
    assert_string_equal(dar_progress_text(&p, 65, "loss 0.031", buf, sizeof buf),
                        "train: 130/1300 steps, 10 %, 2 steps/s, 9 min 45 s left, loss 0.031");
    assert_string_equal(dar_progress_text(&p, 260, NULL, buf, sizeof buf),
                        "train: 130/1300 steps, 10 %, 2.0 s each, 39 min 0 s left");
    p.from = 100; /* a run that was taken up there */
    assert_string_equal(dar_progress_text(&p, 60, NULL, buf, sizeof buf),
                        "train: 130/1300 steps, 10 %, 2.0 s each, 39 min 0 s left");
    p.from = 0;
    p.done = 1300;
    assert_string_equal(dar_progress_text(&p, 650, NULL, buf, sizeof buf),
                        "train: 1300/1300 steps, 100 %, 2 steps/s, 10 min 50 s in all");
}

static int signal_number;

static dar_status until_asked(dar_run *r, dar_err *e)
{
    assert_false(dar_interrupted());
    raise(signal_number);
    assert_true(dar_interrupted());
    return dar_fail(e, DAR_ERR_INTERRUPTED, "%s: saved", r->program->name);
}

/* Each of the signals lets the program save and end with 130.  The flag stays, so each has a process of its own. */
static int asked_to_stop(const char *number)
{
    static const dar_program program = { .name = "saver", .run = until_asked };
    char *argv[] = { "saver", NULL };
    signal_number = (int)strtol(number, NULL, 10);
    setenv("GOMP_SPINCOUNT", "0", 1); /* the test is not to be started again as the program */
    return dar_program_main(&program, 1, argv);
}

/* The program starts again once, with its words and its name, and finds the environment set; where one of these says
 * how threads run, it does not. */
static const char *const said[] = { "OMP_WAIT_POLICY", "OMP_PROC_BIND", "OMP_PLACES" };

/* Whether lists of processes name it still. */
static bool has_its_name(void)
{
    char name[16] = "";
    FILE *f = fopen("/proc/self/comm", "r");
    if (!f) return false;
    bool read = fgets(name, sizeof name, f);
    fclose(f);
    return read && strncmp(name, "test_args", 9) == 0;
}

static int restarted(char **argv)
{
    if (getenv("GOMP_SPINCOUNT")) return has_its_name() ? 7 : 2;
    for (size_t i = 0; i < DAR_COUNT(said); i++) unsetenv(said[i]);
    if (strcmp(argv[1], "none") != 0) setenv(argv[1], "true", 1);
    dar_threads_restart(argv);
    return getenv("GOMP_SPINCOUNT") ? 1 : 8;
}

static char *self;

static void restart(void **state)
{
    (void)state;
    for (size_t i = 0; i <= DAR_COUNT(said); i++) {
        char word[16];
        snprintf(word, sizeof word, "%s", i ? said[i - 1] : "none");
        char *argv[] = { self, word, "again", NULL };
        pid_t pid;
        int how;
        unsetenv("GOMP_SPINCOUNT");
        assert_int_equal(posix_spawn(&pid, self, NULL, NULL, argv, environ), 0);
        assert_int_equal(waitpid(pid, &how, 0), pid);
        CHECK(WIFEXITED(how) && WEXITSTATUS(how) == (i ? 8 : 7), "%s: ended as %d", word, how);
    }
}

static void stop_signals(void **state)
{
    (void)state;
    static const int asked[] = { SIGINT, SIGTERM, SIGUSR1 };
    for (size_t i = 0; i < DAR_COUNT(asked); i++) {
        char number[16];
        snprintf(number, sizeof number, "%d", asked[i]);
        char *argv[] = { self, number, NULL };
        pid_t pid;
        int how;
        assert_int_equal(posix_spawn(&pid, self, NULL, NULL, argv, environ), 0);
        assert_int_equal(waitpid(pid, &how, 0), pid);
        CHECK(WIFEXITED(how) && WEXITSTATUS(how) == 130, "signal %s: ended as %d", number, how);
    }
}

int main(int argc, char **argv)
{
    if (argc == 2) return asked_to_stop(argv[1]);
    if (argc == 3) return restarted(argv);
    self = argv[0];
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(defaults),     cmocka_unit_test(everything),    cmocka_unit_test(words),
        cmocka_unit_test(refusals),     cmocka_unit_test(help),          cmocka_unit_test(common_block),
        cmocka_unit_test(events),       cmocka_unit_test(progress_text), cmocka_unit_test(commands),
        cmocka_unit_test(stop_signals), cmocka_unit_test(restart),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
