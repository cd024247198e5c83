/* test_scripts.c: make pretrain, demo and sweep with a small model and few steps: what they leave, and that they go on
 * where they were. */
#include "tests/small.h"

#include <stdarg.h>

#include "lib/json.h"

#define SHELL(text) RUN_PROGRAM(shell, "-c", text)

static char dir[] = "/tmp/dar-scripts-XXXXXX", bundler[PATH_MAX], root[PATH_MAX], shell[] = "/bin/sh";

static void say(const char *name, const char *fmt, ...) __attribute__((format(printf, 2, 3)));

static void say(const char *name, const char *fmt, ...)
{
    char text[2 * PATH_MAX];
    va_list v;
    va_start(v, fmt);
    vsnprintf(text, sizeof text, fmt, v);
    va_end(v);
    setenv(name, text, 1);
}

/* Configurations by the names that the scripts know; they are given all that depends on the place. */
static void write_configs(void)
{
    static const char *const sets[] = { "dar", "depth", "tracking+normal+depth" };
    char text[1024], name[64];
    assert_int_equal(mkdir("configs", 0777), 0);
    snprintf(text, sizeof text,
             "{\"model\": \"%s/small\", \"train\": \"vae\", \"from_scratch\": true, \"learning_rate\": 0.005,"
             "\"max_train_steps\": 4, \"train_batch_size\": 2, \"adam_epsilon\": 1e-14,"
             "\"vae\": {\"frames\": 5, \"height\": 16, \"width\": 24}}",
             dir);
    run_write("configs/vae.json", text, strlen(text));
    snprintf(text, sizeof text,
             "{\"base\": \"../backbone.json\", \"max_train_steps\": 4, \"cache_dir\": null,"
             "\"condition\": {\"channels\": \"camera\"}}");
    run_write("configs/pretrain.json", text, strlen(text));
    for (size_t i = 0; i <= DAR_COUNT(sets); i++) {
        bool whole = i == DAR_COUNT(sets);
        snprintf(name, sizeof name, "configs/%s.json", whole ? "full" : sets[i]);
        snprintf(text, sizeof text,
                 "{\"base\": \"../lora.json\", \"max_train_steps\": 4, \"cache_dir\": null, \"train\": \"%s\","
                 "\"condition\": {\"channels\": \"%s\"}}",
                 whole ? "full" : "lora", whole ? "dar" : sets[i]);
        run_write(name, text, strlen(text));
    }
}

static int setup(void **state)
{
    (void)state;
    if (!mkdtemp(dir) || chdir(dir)) return -1;
    small_make(bundler);
    write_configs();
    char bin[PATH_MAX];
    snprintf(bin, sizeof bin, "%s", bundler);
    *strrchr(bin, '/') = 0;
    say("BIN", "%s", bin);
    say("ROOT", "%s", root);
    say("CONFIGS", "%s/configs", dir);
    say("MODEL", "%s/model", dir);
    return 0;
}

static int teardown(void **state)
{
    (void)state;
    return chdir("/") || run_remove(dir);
}

static void run_script(const char *name)
{
    char text[256];
    snprintf(text, sizeof text, "cd \"$ROOT\" && scripts/%s.sh", name);
    int status = SHELL(text);
    CHECK(status == 0, "%s: status %d: %s\n%s", name, status, ran.err, ran.out);
}

/* ---------------------------------------------------------------- tests, in order */

/* Without weights both say in one line what makes them. */
static void no_weights(void **state)
{
    (void)state;
    int status = SHELL("cd \"$ROOT\" && OUT=$CONFIGS/../none scripts/demo.sh");
    CHECK(status == 2 && strstr(ran.err, "make pretrain") && run_one_line(ran.err), "status %d: %s", status, ran.err);
    status = SHELL("cd \"$ROOT\" && OUT=$CONFIGS/../none scripts/sweep.sh");
    CHECK(status == 2 && strstr(ran.err, "make pretrain") && run_one_line(ran.err), "status %d: %s", status, ran.err);
    CHECK(!run_is_there("none"), "what was refused left a directory");
}

/* Killed in the middle, then gone on with: the weights of a run that nothing happened to. */
static void pretrain(void **state)
{
    (void)state;
    say("OUT", "%s/whole", dir);
    say("DATA", "%s/data", dir);
    setenv("CLIPS", "2", 1);
    setenv("HELD", "2", 1);
    setenv("SET", "--size 64x40 --frames 9", 1);
    run_script("pretrain");
    static const char *const left[] = { "model/model.json", "model/lora.safetensors", "model/backbone/vae.safetensors",
                                        "model/results/summary.json", "model/results/dar-loss.svg" };
    for (size_t i = 0; i < DAR_COUNT(left); i++) CHECK(run_is_there(left[i]), "no %s: %s", left[i], ran.out);
    dar_json_doc *doc;
    dar_err e;
    CHECK(dar_json_open(&doc, "model/results/summary.json", &e) == DAR_OK, "%s", e.text);
    dar_json vae = dar_json_object(dar_json_root(doc), "vae");
    CHECK(dar_json_int(vae, "steps", 0, 0, 100) == 4, "%s", ran.out);
    CHECK(dar_json_number(vae, "held_out_psnr", 0, 0, 100) > 0, "%s", ran.out);
    dar_json_close(doc);

    say("OUT", "%s/parts", dir);
    say("MODEL", "%s/again", dir);
    for (int i = 0; i < 3; i++) SHELL("cd \"$ROOT\" && timeout -s KILL 0.7 scripts/pretrain.sh");
    run_script("pretrain");
    run_same_file("model/lora.safetensors", "again/lora.safetensors");
    run_same_file("model/backbone/dit.safetensors", "again/backbone/dit.safetensors");
    say("MODEL", "%s/model", dir);
}

static void demo(void **state)
{
    (void)state;
    say("OUT", "%s/demo", dir);
    setenv("SIZE", "64x40", 1);
    setenv("FRAMES", "9", 1);
    setenv("STEPS", "3", 1);
    setenv("SAMPLE", "--steps 1", 1);
    setenv("COUNT", "4", 1);
    setenv("SHOWN", "0 3", 1);
    setenv("SCENE", "0", 1);
    run_script("demo");
    static const char *const left[] = { "demo/report.html", "demo/sheet.png", "demo/metrics.json",
                                        "demo/scene/report.html", "demo/train/scene/loss.svg" };
    for (size_t i = 0; i < DAR_COUNT(left); i++) CHECK(run_is_there(left[i]), "no %s: %s", left[i], ran.out);
    CHECK(strstr(ran.out, "demo/report.html") && strstr(ran.out, "\nbefore ") && strstr(ran.out, "\nafter "), "%s",
          ran.out);
    run_script("demo");
    CHECK(!strstr(ran.err, "evaluate:"), "a second call measures again: %s", ran.err);

    say("MESH", "%s/cube.obj", dir);
    say("REFERENCE", "%s/clips/b/reference.png", dir);
    run_script("demo");
    CHECK(run_is_there("demo-cube/report.html") && run_is_there("demo-cube/picture/cube/video.mp4"), "%s", ran.out);
    unsetenv("MESH");
    unsetenv("REFERENCE");
}

static void sweep(void **state)
{
    (void)state;
    say("OUT", "%s/sweep", dir);
    say("DATA", "%s/sweep/data", dir);
    setenv("SIZE", "--size 64x40 --frames 9", 1);
    setenv("SCALE", "smoke", 1);
    setenv("SETS", "dar tracking+normal+depth dar:full", 1);
    setenv("STEPS", "5", 1);
    setenv("SPLITS", "4d_vis=2 refvar=2", 1);
    run_script("sweep");
    static const char *const left[] = { "sweep/report.html", "sweep/table.csv", "sweep/table.md",
                                        "sweep/configs/dar-full.json", "sweep/eval/refvar/report.html" };
    char text[1 << 15];
    for (size_t i = 0; i < DAR_COUNT(left); i++) CHECK(run_is_there(left[i]), "no %s: %s", left[i], ran.out);
    run_read("sweep/table.csv", text, sizeof text);
    static const char *const lines[] = { "\ncamera,none,0,0,4d_vis,all,2,", "\ncodec,,,,refvar,all,2,",
                                         "\ntracking+world+normal,lora,0,5,refvar,all,2,",
                                         "\ntracking+normal+depth,lora,0,1,4d_vis,all,2,",
                                         "\ntracking+world+normal,full,0,2,4d_vis,all,2," };
    for (size_t i = 0; i < DAR_COUNT(lines); i++) CHECK(strstr(text, lines[i]), "no %s in %s", lines[i] + 1, text);
    run_read("sweep/table.md", text, sizeof text);
    CHECK(strstr(text, "| codec |") && strstr(text, "World position against depth") &&
              strstr(text, "Beside published figures"),
          "%s", text);
    run_script("sweep");
    CHECK(!strstr(ran.err, "evaluate:") && !strstr(ran.out, "train dar"), "done again: %s%s", ran.out, ran.err);
    int status = SHELL("cd \"$ROOT\" && STEPS=10 scripts/sweep.sh");
    CHECK(status == 2 && strstr(ran.err, "other steps") && run_one_line(ran.err), "status %d: %s", status, ran.err);
}

int main(int argc, char **argv)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(no_weights),
        cmocka_unit_test(pretrain),
        cmocka_unit_test(demo),
        cmocka_unit_test(sweep),
    };
    (void)argc;
    if (!run_find(bundler, argv[0], "dar-bundle") || !realpath(".", root)) return 1;
    return cmocka_run_group_tests(tests, setup, teardown);
}
