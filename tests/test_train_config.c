/* test_train_config.c: every configuration in train/configs is read; keys, bases, overrides; what is wrong is told. */
#include "tests/test.h"

#include <dirent.h>

#include "tests/scratch.h"
#include "train/config.h"

static void same_text(const char *found, const char *expected)
{
    CHECK(strcmp(found, expected) == 0, "found   %s\nexpected %s", found, expected);
}

static size_t open_all(const char *folder, const char *model, unsigned *sets)
{
    char path[512];
    size_t n = 0;
    DIR *d = opendir(folder);
    CHECK(d, "%s is not there", folder);
    for (const struct dirent *x; (x = readdir(d));) {
        static const char *const place[] = { "output_dir=out" };
        dar_train_config c;
        dar_err e;
        if (*x->d_name == '.') continue;
        snprintf(path, sizeof path, "%s/%s", folder, x->d_name);
        ok(dar_train_config_open(&c, path, place, 1, &e), &e);
        same_text(c.file.c.name, model);
        assert_int_equal(c.file.c.adapter.geometry, c.condition.set.channels);
        assert_int_equal(c.file.c.lora.rank, c.what == DAR_TRAIN_LORA ? c.rank : 0);
        for (size_t i = 0; i < dar_channel_alias_count; i++) {
            size_t k = strlen(dar_channel_aliases[i].name);
            if (strncmp(x->d_name, dar_channel_aliases[i].name, k) == 0 && strcmp(x->d_name + k, ".json") == 0)
                *sets |= 1u << i;
        }
        dar_train_config_close(&c);
        n++;
    }
    closedir(d);
    return n;
}

/* Each of the named channel sets has a file, for both models. */
static void all_are_read(void **state)
{
    (void)state;
    static const char *const models[] = { "dar-tiny", "wan22-fun-5b" };
    for (size_t i = 0; i < DAR_COUNT(models); i++) {
        char folder[64];
        unsigned sets = 0;
        snprintf(folder, sizeof folder, "train/configs/%s", models[i]);
        size_t n = open_all(folder, models[i], &sets);
        CHECK(sets == (1u << dar_channel_alias_count) - 1, "%s: sets %x have files", folder, sets);
        CHECK(n > dar_channel_alias_count, "%s: %zu files", folder, n);
    }
}

/* The paper's recipe is what a file has that says nothing. */
static void the_papers(void **state)
{
    (void)state;
    static const char *const least[] = { "model=wan22-fun-5b", "output_dir=x" };
    dar_train_config c;
    dar_err e;
    scratch_text(in_dir("least.json"), "{}");
    ok(dar_train_config_open(&c, in_dir("least.json"), least, 2, &e), &e);
    CHECK(c.what == DAR_TRAIN_LORA && c.rank == 256 && c.file.c.lora.rank == 256, "rank %lld", (long long)c.rank);
    CHECK_NEAR("alpha", c.file.c.lora.alpha, 256, 0);
    CHECK_NEAR("rate", c.rate, 1e-4, 0);
    assert_int_equal(c.warmup, 200);
    assert_int_equal(c.steps, 10000);
    assert_int_equal(c.save_every, 2000);
    assert_int_equal(c.batch * c.accumulate, 1);
    assert_int_equal(c.storage, DAR_BF16);
    assert_int_equal(c.first, DAR_FIRST_EXCLUDE);
    CHECK_NEAR("shift", c.shift, 5, 0);
    CHECK_NEAR("schedule at the end", dar_train_schedule(&c, 9999), 1, 0);
    CHECK(c.n_rates == 0 && c.average == 0, "%zu rates, decay %g", c.n_rates, c.average);
    CHECK(c.condition.set.channels == 0, "a model without geometry got %zu channels", c.condition.set.channels);
    dar_train_config_close(&c);
}

static const char small[] =
    "{\"name\": \"small\", \"dit\": {\"width\": 20, \"heads\": 2, \"layers\": 2, \"ffn\": 27, \"latent\": 5},"
    "\"adapter\": {\"unshuffle\": 4}, \"vae\": {\"patch\": 1, \"multipliers\": [1, 2, 2], \"halve_time\": [true, "
    "true]}}";

/* A configuration of the small model with these keys too. */
static const char *write_config(const char *name, const char *keys)
{
    char text[1024];
    const char *model = in_dir("small.json"), *path = in_dir(name);
    scratch_text(model, small);
    snprintf(text, sizeof text, "{\"model\": \"%s\", %s}", model, keys);
    scratch_text(path, text);
    return path;
}

static void bases_and_overrides(void **state)
{
    (void)state;
    static const char *const set[] = { "learning_rate=0.5",
                                       "condition.channels=world+normal",
                                       "adapter.blocks=2",
                                       "target_modules=[\"ffn.0\"]",
                                       "rank=7",
                                       "lr_scheduler=linear",
                                       "lr_decay_steps=10",
                                       "max_train_steps=100" };
    dar_train_config c;
    dar_err e;
    write_config("a.json", "\"output_dir\": \"a\", \"rank\": 3, "
                           "\"condition\": {\"channels\": \"depth\", \"plucker\": \"paper\"}");
    scratch_text(in_dir("b.json"), "{\"base\": \"a.json\", \"output_dir\": \"b\"}");
    scratch_text(in_dir("c.json"), "{\"base\": \"b.json\", \"seed\": 4}");
    ok(dar_train_config_open(&c, in_dir("c.json"), set, DAR_COUNT(set), &e), &e);
    same_text(c.output, "b");
    assert_int_equal(c.seed, 4);
    assert_int_equal(c.condition.set.channels, 6);
    assert_int_equal(c.condition.rays.plucker, DAR_PLUCKER_PAPER);
    assert_int_equal(c.file.c.adapter.blocks, 2);
    assert_int_equal(c.file.c.adapter.geometry, 6);
    assert_int_equal(c.file.c.lora.targets, 1u << DAR_FFN_UP);
    assert_int_equal(c.file.c.lora.rank, 7);
    CHECK_NEAR("schedule before", dar_train_schedule(&c, 90), 1, 0);
    CHECK_NEAR("schedule of the last", dar_train_schedule(&c, 99), 0.1, 1e-15);

    /* What is stored is read as the same. */
    dar_json_writer w = { 0 }, again = { 0 };
    dar_train_config_print(&c, &w);
    scratch_text(in_dir("d.json"), w.text);
    dar_train_config_close(&c);
    ok(dar_train_config_open(&c, in_dir("d.json"), NULL, 0, &e), &e);
    dar_train_config_print(&c, &again);
    same_text(again.text, w.text);
    dar_train_config_close(&c);
    dar_json_writer_free(&w);
    dar_json_writer_free(&again);
}

/* The factor on rates, at some steps of 1000. */
static void schedules(void **state)
{
    (void)state;
    static const struct {
        const char *set[3];
        int64_t warmup;
        double at[4]; /* steps 0, 500, 750, 999 */
    } kinds[] = {
        { { "lr_scheduler=constant_with_warmup", "lr_decay_share=0.5", "lr_warmup_steps=20" }, 20, { 1, 1, 1, 1 } },
        { { "lr_scheduler=constant", "lr_decay_share=0.5", "lr_warmup_steps=20" }, 0, { 1, 1, 1, 1 } },
        { { "lr_scheduler=linear", "lr_decay_share=0", "lr_warmup_steps=0" }, 0, { 1, 0.5, 0.25, 0.001 } },
        { { "lr_scheduler=linear", "lr_decay_share=0.5", "lr_warmup_steps=20" }, 20, { 1, 1, 0.5, 0.002 } },
        { { "lr_scheduler=linear", "lr_decay_share=0.5", "lr_decay_steps=250" }, 200, { 1, 1, 1, 0.004 } },
        { { "lr_scheduler=linear", "lr_decay_share=0", "lr_warmup_steps=500" }, 500, { 1, 1, 0.5, 0.002 } },
        { { "lr_scheduler=cosine", "lr_decay_share=1", "lr_warmup_steps=20" },
          20,
          { 1, 0.5, 0.14644660940672624, 2.4674e-6 } },
    };
    static const int64_t steps[] = { 0, 500, 750, 999 };
    const char *path = write_config("s.json", "\"output_dir\": \"s\", \"max_train_steps\": 1000");
    for (size_t i = 0; i < DAR_COUNT(kinds); i++) {
        dar_train_config c;
        dar_err e;
        ok(dar_train_config_open(&c, path, kinds[i].set, 3, &e), &e);
        assert_int_equal(c.warmup, kinds[i].warmup);
        for (size_t k = 0; k < DAR_COUNT(steps); k++)
            CHECK_NEAR(kinds[i].set[0], dar_train_schedule(&c, steps[k]), kinds[i].at[k], 1e-10);
        dar_train_config_close(&c);
    }
}

/* Rates by pattern, those of a base first. */
static void rates(void **state)
{
    (void)state;
    dar_train_config c;
    dar_err e;
    write_config("r.json", "\"output_dir\": \"r\", \"learning_rates\": {\"linear.*\": 3e-5, \"a.b\": 1}");
    scratch_text(in_dir("q.json"), "{\"base\": \"r.json\", \"learning_rates\": {\"*\": 2, \"a.b\": 0}}");
    ok(dar_train_config_open(&c, in_dir("q.json"), NULL, 0, &e), &e);
    static const char *const patterns[] = { "linear.*", "a.b", "*" };
    static const double expected[] = { 3e-5, 0, 2 };
    assert_int_equal(c.n_rates, 3);
    for (size_t i = 0; i < 3; i++) {
        same_text(c.rates[i].pattern, patterns[i]);
        CHECK_NEAR(patterns[i], c.rates[i].rate, expected[i], 0);
    }
    dar_train_config_close(&c);
}

static void refusals(void **state)
{
    (void)state;
    static const struct {
        const char *keys, *says;
    } bad[] = {
        { "\"rank\": 3", "bad.json: output_dir: missing, expected a string" },
        { "\"output_dir\": \"x\", \"learning_rat\": 1", "bad.json: learning_rat: unknown key; did you mean "
                                                        "'learning_rate'?" },
        { "\"output_dir\": \"x\", \"train\": \"all\"", "bad.json: train: found \"all\", expected" },
        { "\"output_dir\": \"x\", \"learning_rates\": {\"a.*\": \"b\"}",
          "learning_rates.a.*: found \"b\", expected a number" },
        { "\"output_dir\": \"x\", \"learning_rates\": 3", "learning_rates: found 3, expected an object" },
        { "\"output_dir\": \"x\", \"lr_decay_share\": 2", "lr_decay_share: found 2, expected a number from 0 to 1" },
        { "\"output_dir\": \"x\", \"data\": [3]", "bad.json: data[0]: found 3, expected a string" },
        { "\"output_dir\": \"x\", \"condition\": {\"chanels\": \"dar\"}",
          "small.json: condition.chanels: unknown key; did you mean 'channels'?" },
        { "\"output_dir\": \"x\", \"condition\": {\"channels\": \"word\"}", "is it world?" },
        { "\"output_dir\": \"x\", \"target_modules\": [\"ffn\"]", "small.json: lora.targets[0]: found \"ffn\"" },
        { "\"output_dir\": \"x\", \"adapter\": {\"unshuffle\": 8}", "a token is 8 pixels wide" },
        { "\"base\": \"bad.json\"", "base: found 8 files" },
        { "\"base\": \"none.json\"", "none.json: No such file" },
    };
    for (size_t i = 0; i < DAR_COUNT(bad); i++) {
        dar_train_config c;
        dar_err e;
        refused(dar_train_config_open(&c, write_config("bad.json", bad[i].keys), NULL, 0, &e), &e, bad[i].says);
        CHECK(!c.doc && !c.file.doc, "%s: left open", bad[i].keys);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(all_are_read), cmocka_unit_test(the_papers), cmocka_unit_test(bases_and_overrides),
        cmocka_unit_test(schedules),    cmocka_unit_test(rates),      cmocka_unit_test(refusals),
    };
    return cmocka_run_group_tests(tests, scratch_make, scratch_remove) != 0;
}
