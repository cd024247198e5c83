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
    CHECK_NEAR("rate at the end", dar_train_rate(&c, 9999), 1e-4, 0);
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
    CHECK_NEAR("rate before", dar_train_rate(&c, 90), 0.5, 0);
    CHECK_NEAR("rate of the last", dar_train_rate(&c, 99), 0.05, 1e-15);

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
        cmocka_unit_test(all_are_read),
        cmocka_unit_test(the_papers),
        cmocka_unit_test(bases_and_overrides),
        cmocka_unit_test(refusals),
    };
    return cmocka_run_group_tests(tests, scratch_make, scratch_remove) != 0;
}
