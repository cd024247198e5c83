/* test_dar_train.c: the program dar-train as people meet it: from nothing to a backbone, from that every channel set,
 * to videos; interrupted, resumed, any number of threads; what is wrong in one line. */
#include "tests/small.h"

#include "data/condition.h"
#include "data/pictures.h"
#include "lib/json.h"
#include "lib/safetensors_write.h"
#include "models/config.h"
#include "models/model.h"

#define CLIPS 3

static char dir[] = "/tmp/dar-train-XXXXXX", program[PATH_MAX], bundler[PATH_MAX], sampler[PATH_MAX];

#define RUN(...)  RUN_PROGRAM(program, __VA_ARGS__)
#define SET(text) "--set", text

static int setup(void **state)
{
    (void)state;
    if (!mkdtemp(dir) || chdir(dir)) return -1;
    small_make(bundler);
    small_bundle(bundler, "large", "48x24", "9", "dolly-15");
    small_bundle(bundler, "one", "40x24", "1", "dolly-15");
    return 0;
}

static int teardown(void **state)
{
    (void)state;
    return chdir("/") || run_remove(dir);
}

/* The losses in a run's log, in order. */
static size_t losses(const char *run, double *x, size_t most)
{
    char path[128], line[4096];
    size_t n = 0;
    snprintf(path, sizeof path, "%s/log.jsonl", run);
    FILE *f = fopen(path, "rb");
    assert_non_null(f);
    while (fgets(line, sizeof line, f)) {
        dar_json_doc *doc;
        dar_err e;
        CHECK(dar_json_parse(&doc, path, line, strlen(line), &e) == DAR_OK, "%s", e.text);
        dar_json root = dar_json_root(doc);
        if (strcmp(dar_json_text(root, "kind", ""), "step") == 0) {
            CHECK(n < most, "%s: more than %zu steps", path, most);
            x[n++] = dar_json_number(root, "loss", NAN, -INFINITY, INFINITY);
        }
        dar_json_close(doc);
    }
    fclose(f);
    return n;
}

static void same_state(const char *a, const char *b)
{
    static const char *const files[] = { "adapter.safetensors", "lora.safetensors", "optimizer.safetensors" };
    for (size_t i = 0; i < DAR_COUNT(files); i++) {
        char x[128], y[128];
        snprintf(x, sizeof x, "%s/%s", a, files[i]);
        snprintf(y, sizeof y, "%s/%s", b, files[i]);
        run_same_file(x, y);
    }
}

static void same_picture(const char *a, const char *b)
{
    enum { W = 40, H = 24 };
    uint8_t rgb[2][3 * W * H];
    dar_err e;
    for (int i = 0; i < 2; i++) CHECK(dar_pictures_load(i ? b : a, W, H, rgb[i], &e) == DAR_OK, "%s", e.text);
    CHECK(memcmp(rgb[0], rgb[1], sizeof rgb[0]) == 0, "%s and %s differ", a, b);
}

/* ---------------------------------------------------------------- tests, in order */

/* From nothing; the others start from what it leaves. */
static void a_backbone(void **state)
{
    (void)state;
    double loss[32];
    GOOD("backbone.json", "--dry-run");
    CHECK(strstr(ran.out, "parameters") && !run_is_there("backbone"), "a dry run: %s", ran.out);
    GOOD("backbone.json");
    CHECK(!strstr(ran.err, "warning"), "%s", ran.err);
    assert_int_equal(losses("backbone", loss, 32), 20);
    CHECK(loss[19] < loss[0], "the loss goes from %g to %g", loss[0], loss[19]);
    CHECK(run_is_there("backbone/samples/step-00000020/a.png"), "no sample");
    CHECK(run_is_there("backbone/checkpoint-20/model.json"), "no model");
}

/* Each set that has a name learns, without a word of warning, and renders. */
static void every_set(void **state)
{
    (void)state;
    double loss[64];
    for (size_t i = 0; i < dar_channel_alias_count; i++) {
        const char *name = dar_channel_aliases[i].name;
        char channels[64], out[64], model_of[64];
        snprintf(channels, sizeof channels, "condition.channels=%s", name);
        snprintf(out, sizeof out, "output_dir=set-%s", name);
        snprintf(model_of, sizeof model_of, "set-%s/checkpoint-50", name);
        GOOD("lora.json", SET(channels), SET(out), SET("max_train_steps=50"), "--threads", "1");
        CHECK(!strstr(ran.err, "warning"), "%s: %s", name, ran.err);
        assert_int_equal(losses(out + 11, loss, 64), 50);
        for (int k = 0; k < 50; k++) CHECK(isfinite(loss[k]), "%s: loss of step %d is %g", name, k, loss[k]);
        if (i % 5) continue;
        int status = RUN_PROGRAM(sampler, "clips/a", "--model", model_of, "-o", name, "--steps", "1", "--no-mp4");
        CHECK(status == 0, "%s: %s", name, ran.err);
    }
}

/* 20 steps, or 10 and 10 more, on 1, 2, 3 threads: the same bits. */
static void stopped_and_resumed(void **state)
{
    (void)state;
    static const char *const threads[] = { "1", "2", "3" };
    GOOD("lora.json", SET("output_dir=whole"), SET("max_train_steps=20"), SET("gradient_accumulation_steps=2"));
    for (size_t i = 0; i < DAR_COUNT(threads); i++) {
        char out[64], run[32], at[64];
        snprintf(run, sizeof run, "parts-%s", threads[i]);
        snprintf(out, sizeof out, "output_dir=%s", run);
        GOOD("lora.json", SET(out), SET("max_train_steps=10"), SET("gradient_accumulation_steps=2"), "--threads",
             threads[i]);
        GOOD("lora.json", SET(out), SET("max_train_steps=20"), SET("gradient_accumulation_steps=2"), "--threads",
             threads[i], "--resume", "auto");
        snprintf(at, sizeof at, "%s/checkpoint-20", run);
        same_state("whole/checkpoint-20", at);
    }
}

/* Two batches of one clip to a step are one of two: the same clips, noise and mean, but for the roundings of sums over
 * some 600 numbers. */
static void accumulated(void **state)
{
    (void)state;
    double one[8], two[8], most = 0;
    GOOD("lora.json", SET("output_dir=at-once"), SET("max_train_steps=6"), SET("train_batch_size=2"));
    GOOD("lora.json", SET("output_dir=in-turn"), SET("max_train_steps=6"), SET("gradient_accumulation_steps=2"));
    assert_int_equal(losses("at-once", one, 8), 6);
    assert_int_equal(losses("in-turn", two, 8), 6);
    for (int k = 0; k < 6; k++) most = fmax(most, fabs(two[k] / one[k] - 1));
    CHECK_NEAR("loss in turn against at once", most, 0, 600 * 0x1p-24);
}

/* Values of a part's tensors: those of `a` whose names begin with `prefix` are those of `b` without it. */
static size_t same_values(const char *a, const char *prefix, const char *b)
{
    dar_weights *x, *y;
    size_t n = 0, skip = strlen(prefix);
    dar_err e;
    CHECK(dar_weights_open(&x, a, &e) == DAR_OK && dar_weights_open(&y, b, &e) == DAR_OK, "%s", e.text);
    for (size_t i = 0; i < dar_weights_count(x); i++) {
        const dar_weight *item = dar_weights_at(x, i);
        dar_tensor p, q;
        if (strncmp(item->name, prefix, skip) != 0 || !dar_weights_find(y, item->name + skip)) continue;
        CHECK(dar_weights_tensor(x, item->name, &p, &e) == DAR_OK, "%s", e.text);
        CHECK(dar_weights_tensor(y, item->name + skip, &q, &e) == DAR_OK, "%s", e.text);
        n += dar_tensor_bytes(&p) == dar_tensor_bytes(&q) && memcmp(p.data, q.data, dar_tensor_bytes(&p)) == 0;
    }
    dar_weights_close(x);
    dar_weights_close(y);
    return n;
}

/* With an average of the weights, checkpoints give that to others; training goes on from the weights, and does not know
 * of it: they are those of a run without.  Stopped and resumed: the same bits. */
static void averaged(void **state)
{
    (void)state;
    static const char decay[] = "ema_decay=0.8", twenty[] = "max_train_steps=20";
    static const char optimizer[] = "ema/checkpoint-20/optimizer.safetensors";
    GOOD("lora.json", SET("output_dir=plain"), SET(twenty), SET("adam_moments=bf16"), SET("lr_scheduler=cosine"));
    GOOD("lora.json", SET("output_dir=ema"), SET(twenty), SET("adam_moments=bf16"), SET("lr_scheduler=cosine"),
         SET(decay), SET("validation.steps=20"));
    assert_int_equal(same_values(optimizer, "w.", "plain/checkpoint-20/lora.safetensors"), 40);
    assert_int_equal(same_values(optimizer, "w.", "ema/checkpoint-20/lora.safetensors"), 0);
    GOOD("lora.json", SET("output_dir=ema-parts"), SET(twenty), SET("adam_moments=bf16"), SET("lr_scheduler=cosine"),
         SET(decay), SET("checkpointing_steps=7"), SET("validation.steps=0"));
    assert_int_equal(run_remove("ema-parts/checkpoint-20"), 0);
    GOOD("lora.json", SET("output_dir=ema-parts"), SET(twenty), SET("adam_moments=bf16"), SET("lr_scheduler=cosine"),
         SET(decay), SET("checkpointing_steps=7"), "--resume", "auto");
    same_state("ema/checkpoint-20", "ema-parts/checkpoint-20");
    BAD(2, "found no w.", "lora.json", SET("output_dir=bad"), SET(decay), SET("adam_moments=bf16"), "--resume",
        "plain/checkpoint-20");
    assert_int_equal(run_remove("bad"), 0);
}

/* A rate for all by pattern is a rate for all. */
static void rates(void **state)
{
    (void)state;
    GOOD("lora.json", SET("output_dir=rate"), SET("max_train_steps=5"), SET("learning_rate=0.01"));
    GOOD("lora.json", SET("output_dir=rates"), SET("max_train_steps=5"), SET("learning_rate=0"),
         SET("learning_rates={\"control_adapter.*\": 1, \"*\": 0.01}"));
    same_state("rate/checkpoint-5", "rates/checkpoint-5");
    BAD(2, "learning_rates: found \"none.*\", expected", "lora.json", SET("output_dir=bad"), "--dry-run",
        SET("learning_rates={\"none.*\": 1}"));
}

/* Asked to stop, a run saves and says so; then it goes on. */
static void interrupted(void **state)
{
    (void)state;
    pid_t pid = run_start(
        program, (const char *const[]){ "lora.json", SET("output_dir=stopped"), SET("max_train_steps=1000000"), NULL });
    for (int i = 0; i < 3000 && !run_is_there("stopped/log.jsonl"); i++) usleep(10000);
    usleep(100000);
    kill(pid, SIGTERM);
    int status = run_finish(pid);
    CHECK(status == 130 && strstr(ran.err, "saved after step"), "status %d: %s", status, ran.err);
    BAD(2, "checkpoint", "lora.json", SET("output_dir=stopped"));
}

/* The same losses in bf16, within what its operands' 8 bits do in a network of two layers: a loss is a mean of squares
 * over 600 numbers, each off by some 1e-2. */
static void precisions(void **state)
{
    (void)state;
    double wide[32], narrow[32];
    GOOD("lora.json", SET("output_dir=f32"), SET("max_train_steps=30"));
    GOOD("lora.json", SET("output_dir=bf16"), SET("max_train_steps=30"), SET("mixed_precision=bf16"));
    assert_int_equal(losses("f32", wide, 32), 30);
    assert_int_equal(losses("bf16", narrow, 32), 30);
    double most = 0;
    for (int k = 0; k < 30; k++) most = fmax(most, fabs(narrow[k] / wide[k] - 1));
    printf("note: losses in bf16 off by at most %.1e\n", most);
    CHECK_NEAR("loss in bf16 against f32", most, 0, 1e-2);
}

static const char autoencoder[] =
    "{\"model\": \"small\", \"train\": \"vae\", \"from_scratch\": true, \"data\": [\"clips\"],"
    "\"output_dir\": \"vae\", \"mixed_precision\": \"f32\", \"learning_rate\": 0.005,"
    "\"lr_warmup_steps\": 2, \"max_train_steps\": 40, \"train_batch_size\": 2, \"max_grad_norm\": 1,"
    "\"checkpointing_steps\": 10, \"ema_decay\": 0.5, \"vae\": {\"frames\": 5, \"height\": 16, \"width\": 24},"
    "\"validation\": {\"data\": [\"clips\"], \"steps\": 20}}";

/* From nothing, on cuts of the clips; stopped and resumed; and a backbone learns on latents of what was learned. */
static void an_autoencoder(void **state)
{
    (void)state;
    double loss[64], least = INFINITY;
    dar_json_doc *doc;
    dar_err e;
    double std[5] = { 0 };
    run_write("vae.json", autoencoder, sizeof autoencoder - 1);
    GOOD("vae.json", "--dry-run");
    CHECK(strstr(ran.out, "parameters") && !run_is_there("vae"), "a dry run: %s", ran.out);
    GOOD("vae.json");
    CHECK(!strstr(ran.err, "warning") && strstr(ran.err, " dB over 3 clips"), "%s", ran.err);
    assert_int_equal(losses("vae", loss, 64), 40);
    for (int k = 30; k < 40; k++) least = fmin(least, loss[k]);
    CHECK(least < 0.9 * loss[0], "the loss goes from %g to %g", loss[0], least);

    GOOD("vae.json", SET("output_dir=vae-parts"), SET("max_train_steps=10"), "--threads", "1");
    GOOD("vae.json", SET("output_dir=vae-parts"), SET("gradient_checkpointing=full"), "--resume", "auto");
    run_same_file("vae/checkpoint-40/vae.safetensors", "vae-parts/checkpoint-40/vae.safetensors");
    run_same_file("vae/checkpoint-40/optimizer.safetensors", "vae-parts/checkpoint-40/optimizer.safetensors");

    CHECK(dar_json_open(&doc, "vae/checkpoint-40/model.json", &e) == DAR_OK, "%s", e.text);
    dar_json_numbers(dar_json_object(dar_json_root(doc), "vae"), "std", std, 5);
    dar_json_close(doc);
    for (int k = 0; k < 5; k++) CHECK(std[k] > 0 && std[k] != 1, "deviation of channel %d: %g", k, std[k]);
    GOOD("backbone.json", SET("model=vae/checkpoint-40"), SET("output_dir=upon"), SET("max_train_steps=2"));
    GOOD("vae.json", SET("from_scratch=false"), SET("parts.vae=vae/checkpoint-40/vae.safetensors"),
         SET("output_dir=vae-more"), SET("max_train_steps=1"), SET("validation.steps=0"));
    CHECK(!strstr(ran.err, " dB over"), "validated: %s", ran.err);
    BAD(2, "parts.vae", "vae.json", SET("from_scratch=false"), SET("output_dir=bad"));
    BAD(2, "vae.frames", "vae.json", SET("vae.width=18"), SET("output_dir=bad"));
    CHECK(!run_is_there("bad"), "what was refused left a directory");
}

/* The checkpoint and the weights that it was merged into are one model: every bit of the last frame. */
static void merged(void **state)
{
    (void)state;
    static const char *const models[] = { "merge/checkpoint-5", "merge/merged" };
    GOOD("lora.json", SET("output_dir=merge"), SET("max_train_steps=5"), SET("save_merged=true"),
         SET("checkpointing_steps=0"));
    CHECK(!run_is_there("merge/checkpoint-4"), "a checkpoint that nobody asked for");
    for (int i = 0; i < 2; i++) {
        int status = RUN_PROGRAM(sampler, "clips/a", "--model", models[i], "-o", i ? "from-merged" : "from-checkpoint",
                                 "--steps", "1", "--no-mp4", "--precision", "f32");
        CHECK(status == 0, "%s: %s", models[i], ran.err);
    }
    same_picture("from-merged/frames/00008.png", "from-checkpoint/frames/00008.png");
}

static dar_model *open_model(const char *path)
{
    dar_model_options o = { .storage = DAR_F32, .strength = 1, .apart = true };
    dar_model_file f;
    dar_model *m;
    dar_err e;
    CHECK(dar_model_file_open(&f, path, &e) == DAR_OK, "%s", e.text);
    CHECK(dar_model_open(&m, &f, &o, &e) == DAR_OK, "%s", e.text);
    dar_model_file_close(&f);
    return m;
}

/* Every parameter of b is a's, matrices rounded to bf16. */
static void same_rounded(const char *a, const char *b)
{
    dar_model *x = open_model(a), *y = open_model(b);
    for (int k = 0; k < 2; k++) {
        CHECK(x->params[k].count == y->params[k].count, "%s: %zu parameters, %s: %zu", a, x->params[k].count, b,
              y->params[k].count);
        for (size_t i = 0; i < x->params[k].count; i++) {
            const dar_param *p = x->params[k].at[i], *q = dar_params_find(&y->params[k], p->name);
            CHECK(q && dar_shape_equal(&p->x.shape, &q->x.shape), "%s is not there, or of another shape", p->name);
            for (size_t n = 0; n < dar_shape_count(&p->x.shape); n++) {
                double want = dar_dtype_get(DAR_F32, p->x.data, n), got = dar_dtype_get(DAR_F32, q->x.data, n);
                uint16_t narrow;
                if (p->info.matrix) dar_dtype_set(DAR_BF16, &narrow, 0, want);
                if (p->info.matrix) want = dar_dtype_get(DAR_BF16, &narrow, 0);
                CHECK(want == got, "%s %zu: %.9g, expected %.9g", p->name, n, got, want);
            }
        }
    }
    dar_model_close(x);
    dar_model_close(y);
}

static void sampled(const char *model, const char *out)
{
    int status = RUN_PROGRAM(sampler, "clips/a", "--model", model, "-o", out, "--steps", "1", "--no-mp4");
    CHECK(status == 0, "%s: %s", model, ran.err);
}

/* A model that is given away is the checkpoint with its matrices in bf16, wherever it lies; with it goes what it was
 * trained on, which renders from rays alone, and is trained on again. */
static void exported(void **state)
{
    (void)state;
    GOOD("lora.json", SET("output_dir=give"), SET("max_train_steps=5"));
    GOOD("give/checkpoint-5", "--export", "given");
    same_rounded("give/checkpoint-5", "given");
    same_rounded("backbone/checkpoint-20", "given/backbone");
    assert_int_equal(rename("given", "moved"), 0);
    sampled("moved", "of-moved");
    sampled("moved/backbone", "of-rays");
    sampled("backbone/checkpoint-20", "of-backbone"); /* in bf16, where both are used as they are written */
    same_picture("of-rays/frames/00008.png", "of-backbone/frames/00008.png");
    GOOD("lora.json", SET("model=moved/backbone"), SET("output_dir=again"), SET("max_train_steps=1"));
    GOOD("lora.json", SET("model=moved"), SET("output_dir=further"), SET("max_train_steps=1"));

    assert_int_equal(mkdir("moved/results", 0777), 0);
    assert_int_equal(mkdir("moved/results/plots", 0777), 0);
    run_write("moved/results/table.csv", "told", 4);
    run_write("moved/results/plots/loss.svg", "drawn", 5);
    GOOD("backbone/checkpoint-20", "--export", "moved");
    same_rounded("backbone/checkpoint-20", "moved");
    CHECK(!run_is_there("moved/lora.safetensors"), "what was replaced is there");
    char text[8];
    run_read("moved/results/table.csv", text, sizeof text);
    assert_string_equal(text, "told");
    run_read("moved/results/plots/loss.svg", text, sizeof text);
    assert_string_equal(text, "drawn");
    BAD(2, "clips", "give/checkpoint-5", "--export", "clips");
    CHECK(run_is_there("clips/a/meta.json"), "what is no model was replaced");
    BAD(2, "no-model", "no-model", "--export", "bad");
    BAD(2, "--export", "give/checkpoint-5", "--export", "bad", "--dry-run");
    CHECK(!run_is_there("bad"), "what was refused left a directory");
}

/* The embedding of the empty prompt counts where a clip has no text. */
static void empty_prompt(void **state)
{
    (void)state;
    float words[2 * 13];
    double without[4], with[4];
    dar_err e;
    for (size_t i = 0; i < DAR_COUNT(words); i++) words[i] = (float)(i % 7) - 3;
    dar_safetensors_item item = { "text", dar_tensor_of(DAR_F32, DAR_SHAPE(2, 13), words) };
    CHECK(dar_safetensors_write("empty.safetensors", &item, 1, NULL, &e) == DAR_OK, "%s", e.text);
    GOOD("lora.json", SET("output_dir=without"), SET("max_train_steps=2"));
    GOOD("lora.json", SET("output_dir=with"), SET("max_train_steps=2"), SET("text.empty=empty.safetensors"));
    assert_int_equal(losses("without", without, 4), 2);
    assert_int_equal(losses("with", with, 4), 2);
    CHECK(without[0] != with[0], "both losses are %g", with[0]);
    BAD(2, "small.bad", "lora.json", SET("output_dir=bad"), SET("text.empty=small.bad"));
}

static void refusals(void **state)
{
    (void)state;
    BAD(2, "expected bundles", "lora.json", SET("data=[]"));
    BAD(2, "found no bundle", "lora.json", SET("data=[\"small\"]"));
    BAD(2, "large", "lora.json", SET("data=[\"clips\", \"large\"]"), SET("output_dir=bad"));
    BAD(2, "found 1 frame", "lora.json", SET("data=[\"one\"]"), SET("output_dir=bad"));
    BAD(2, "did you mean 'rank'?", "lora.json", SET("ran=5"));
    BAD(2, "no weights of the dit", "lora.json", SET("model=small"), SET("output_dir=bad"));
    BAD(3, "this run needs", "lora.json", SET("output_dir=bad"), "--mem-budget", "0.000001");
    GOOD("lora.json", SET("output_dir=bad"), "--mem-budget", "0.000001", "--dry-run");
    CHECK(strstr(ran.out, "it would not start"), "a dry run: %s", ran.out);
    CHECK(!run_is_there("bad"), "what was refused left a directory");
}

int main(int argc, char **argv)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_backbone),  cmocka_unit_test(every_set),  cmocka_unit_test(stopped_and_resumed),
        cmocka_unit_test(accumulated), cmocka_unit_test(averaged),   cmocka_unit_test(rates),
        cmocka_unit_test(interrupted), cmocka_unit_test(precisions), cmocka_unit_test(an_autoencoder),
        cmocka_unit_test(merged),      cmocka_unit_test(exported),   cmocka_unit_test(empty_prompt),
        cmocka_unit_test(refusals),
    };
    (void)argc;
    if (!run_find(program, argv[0], "dar-train") || !run_find(bundler, argv[0], "dar-bundle") ||
        !run_find(sampler, argv[0], "dar-sample"))
        return 1;
    return cmocka_run_group_tests(tests, setup, teardown) != 0;
}
