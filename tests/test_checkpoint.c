/* test_checkpoint.c: what is saved comes back bit for bit; what is damaged, killed or does not fit on the disk is told
 * in one line and costs no older checkpoint. */
#include "tests/scratch.h"

#include <signal.h>
#include <sys/resource.h>

#include "lib/log.h"
#include "lib/rng.h"
#include "models/load.h"
#include "models/lora.h"
#include "models/vae.h"
#include "tests/model.h"
#include "train/checkpoint.h"

static dar_config config; /* dar-test */

/* ---------------------------------------------------------------- a run */

typedef struct run {
    model net;
    dar_optim optim;
    dar_checkpoint c;
} run;

/* dar-test with trained parameters of these roles; everything, moments too, random from seed.  With moments in bf16
 * weights are averaged. */
static void run_init(run *r, const char *where, unsigned roles, dar_dtype storage, bool bf16_moments, uint64_t seed)
{
    dar_optim_config o = dar_optim_default();
    o.bf16_moments = bf16_moments;
    o.average = bf16_moments ? 0.9 : 0;
    model_init(&r->net, &config, storage, false);
    dar_lora_init(&r->net.m, &r->net.p, &config.lora);
    dar_params_train(&r->net.p, roles);
    dar_params_fresh(&r->net.p, DAR_PARAM_ALL, seed);
    dar_params_gradients(&r->net.p);
    dar_optim_init(&r->optim, &o, &r->net.p, &r->net.weights);
    for (size_t i = 0; i < r->net.p.count; i++) {
        if (!r->net.p.at[i]->trainable) continue;
        dar_rng_fill_normal(&r->net.p.at[i]->x, seed, 3 * i, 1);
        dar_rng_fill_normal(&r->optim.m[i], seed, 3 * i + 1, 1e-3);
        dar_rng_fill_uniform(&r->optim.v[i], seed, 3 * i + 2, 0, 1e-6);
        if (bf16_moments) dar_rng_fill_normal(&r->optim.average[i], seed, 1000 + i, 1);
    }
    r->optim.steps = (int64_t)seed + 5;
    r->optim.skipped = 4;
    r->optim.in_a_row = 2;
    r->c = (dar_checkpoint){ .run = where,
                             .params = &r->net.p,
                             .dit = &r->net.m,
                             .optim = &r->optim,
                             .seed = UINT64_MAX - 1,
                             .keep = 3,
                             .config = "{\"rank\": 3}",
                             .model = "{\"name\": \"dar-test\"}" };
}

static void run_free(run *r)
{
    dar_checkpoint_close(&r->c);
    model_free(&r->net);
}

static void same_tensor(const char *name, const dar_tensor *a, const dar_tensor *b)
{
    CHECK(a->dtype == b->dtype && dar_tensor_bytes(a) == dar_tensor_bytes(b) &&
              memcmp(a->data, b->data, dar_tensor_bytes(a)) == 0,
          "%s differs", name);
}

/* What is trained, and the state around it. */
static void same_run(const run *a, const run *b)
{
    for (size_t i = 0; i < a->net.p.count; i++) {
        const dar_param *q = a->net.p.at[i];
        if (!q->trainable) continue;
        same_tensor(q->name, &q->x, &b->net.p.at[i]->x);
        same_tensor(q->name, &a->optim.m[i], &b->optim.m[i]);
        same_tensor(q->name, &a->optim.v[i], &b->optim.v[i]);
        if (a->optim.average[i].data) same_tensor(q->name, &a->optim.average[i], &b->optim.average[i]);
    }
    assert_int_equal(a->optim.steps, b->optim.steps);
    assert_int_equal(a->optim.skipped, b->optim.skipped);
    assert_int_equal(a->optim.in_a_row, b->optim.in_a_row);
    assert_int_equal(a->c.step, b->c.step);
}

static void open_run(run *r)
{
    dar_err e;
    ok(dar_checkpoint_open(&r->c, &e), &e);
}

static void save(run *r, int64_t step)
{
    dar_err e;
    ok(dar_checkpoint_save(&r->c, step, &e), &e);
}

/* ---------------------------------------------------------------- there and back */

static void there_and_back(void **state)
{
    (void)state;
    static const struct {
        unsigned roles;
        dar_dtype storage;
        bool bf16_moments;
        const char *files[4];
    } kinds[] = {
        { DAR_PARAM_LORA, DAR_BF16, false, { "lora", "optimizer" } },
        { DAR_PARAM_LORA | DAR_PARAM_ADAPTER, DAR_BF16, true, { "lora", "adapter", "optimizer" } },
        { DAR_PARAM_BASE | DAR_PARAM_ADAPTER, DAR_F32, false, { "dit", "optimizer" } },
        { DAR_PARAM_BASE, DAR_BF16, false, { "dit", "optimizer" } },
        { DAR_PARAM_ADAPTER, DAR_F64, false, { "adapter", "optimizer" } },
    };
    for (size_t k = 0; k < DAR_COUNT(kinds); k++) {
        run a, b;
        dar_err e;
        char path[PATH_MAX];
        run_init(&a, "kind", kinds[k].roles, kinds[k].storage, kinds[k].bf16_moments, 1);
        run_init(&b, "kind", kinds[k].roles, kinds[k].storage, kinds[k].bf16_moments, 2);
        open_run(&a);
        ok(dar_checkpoint_resume(&a.c, k % 2 ? "auto" : NULL, &e), &e);
        assert_int_equal(a.c.step, 0);
        save(&a, 70);
        for (int i = 0; kinds[k].files[i]; i++) {
            snprintf(path, sizeof path, "kind/checkpoint-70/%s.safetensors", kinds[k].files[i]);
            assert_true(run_is_there(path));
        }
        dar_checkpoint_close(&a.c);
        open_run(&b);
        ok(dar_checkpoint_resume(&b.c, "auto", &e), &e);
        same_run(&a, &b);
        run_free(&a);
        run_free(&b);
        assert_int_equal(run_remove("kind"), 0);
    }
}

/* An autoencoder has no transformer beside it. */
static void autoencoder(void **state)
{
    (void)state;
    dar_arena a;
    dar_err e;
    dar_params p[2];
    dar_vae vae[2];
    dar_optim o[2];
    ok(dar_arena_init(&a, "test", 16 << 20, &e), &e);
    for (int i = 0; i < 2; i++) {
        dar_optim_config c = dar_optim_default();
        dar_params_init(&p[i], &a, DAR_F32);
        dar_vae_init(&vae[i], &p[i], &config.vae);
        dar_params_train(&p[i], DAR_PARAM_BASE);
        dar_params_fresh(&p[i], DAR_PARAM_ALL, (uint64_t)i);
        dar_params_gradients(&p[i]);
        dar_optim_init(&o[i], &c, &p[i], &a);
        dar_checkpoint k = { .run = "vae", .params = &p[i], .optim = &o[i], .keep = 1 };
        ok(dar_checkpoint_open(&k, &e), &e);
        ok(i ? dar_checkpoint_resume(&k, "auto", &e) : dar_checkpoint_save(&k, 3, &e), &e);
        dar_checkpoint_close(&k);
    }
    for (size_t i = 0; i < p->count; i++) same_tensor(p->at[i]->name, &p[0].at[i]->x, &p[1].at[i]->x);

    dar_weights *w;
    dar_params q;
    dar_vae third;
    ok(dar_weights_open(&w, "vae/checkpoint-3/vae.safetensors", &e), &e);
    dar_params_init(&q, &a, DAR_F32);
    dar_vae_init(&third, &q, &config.vae);
    ok(dar_load_vae(&q, w, &e), &e);
    dar_weights_close(w);
    dar_params_free(&q);
    for (int i = 0; i < 2; i++) dar_params_free(&p[i]);
    dar_arena_free(&a);
    assert_int_equal(run_remove("vae"), 0);
}

/* The readers of models/ take the files: what was trained is what is sampled. */
static void others_read_it(void **state)
{
    (void)state;
    run r;
    dar_err e;
    dar_weights *w;
    model other;
    run_init(&r, "read", DAR_PARAM_LORA, DAR_BF16, false, 1);
    open_run(&r);
    save(&r, 1);
    ok(dar_weights_open(&w, "read/checkpoint-1/lora.safetensors", &e), &e);
    model_init(&other, &r.net.c, DAR_BF16, false);
    ok(dar_lora_read(&other.m, &other.p, w, &(dar_lora_read_options){ .strength = 1 }, &e), &e);
    for (size_t i = 0; i < r.net.p.count; i++) {
        const dar_param *q = r.net.p.at[i], *found = dar_params_find(&other.p, q->name);
        dar_tensor x;
        if (!q->trainable) continue;
        assert_non_null(found);
        ok(dar_weights_tensor(w, q->name, &x, &e), &e);
        same_tensor(q->name, &q->x, &x);
    }
    CHECK_NEAR("scale", other.m.block[1].product[DAR_FFN_UP].scale, r.net.m.block[1].product[DAR_FFN_UP].scale, 0);
    model_free(&other);
    dar_weights_close(w);
    run_free(&r);

    run_init(&r, "read2", DAR_PARAM_BASE | DAR_PARAM_ADAPTER, DAR_F32, false, 1);
    open_run(&r);
    save(&r, 1);
    ok(dar_weights_open(&w, "read2/checkpoint-1/dit.safetensors", &e), &e);
    model_init(&other, &r.net.c, DAR_F32, false);
    ok(dar_load_dit(&other.m, &other.p, w, 0, &e), &e);
    for (size_t i = 0; i < other.p.count; i++)
        same_tensor(other.p.at[i]->name, &other.p.at[i]->x, &dar_params_find(&r.net.p, other.p.at[i]->name)->x);
    model_free(&other);
    dar_weights_close(w);
    run_free(&r);
    assert_int_equal(run_remove("read"), 0);
    assert_int_equal(run_remove("read2"), 0);
}

/* ---------------------------------------------------------------- which one */

static void resume_fails(run *r, const char *from, const char *words)
{
    dar_err e;
    refused(dar_checkpoint_resume(&r->c, from, &e), &e, words);
}

static void newest_ones_stay(void **state)
{
    (void)state;
    run r, other;
    dar_err e;
    run_init(&r, "keep", DAR_PARAM_LORA, DAR_F32, false, 1);
    open_run(&r);
    for (int64_t step = 8; step <= 12; step++) save(&r, step);
    assert_false(run_is_there("keep/checkpoint-9"));
    for (int64_t step = 10; step <= 12; step++) {
        char path[64];
        snprintf(path, sizeof path, "keep/checkpoint-%d", (int)step);
        assert_true(run_is_there(path));
    }
    save(&r, 12); /* again: replaced in one moment */
    resume_fails(&r, NULL, "checkpoint-12, expected --resume auto");
    resume_fails(&r, "keep/checkpoint-11", "the run has keep/checkpoint-12");
    resume_fails(&r, "keep/checkpoint-7", "checkpoint-7/checkpoint.json: No such file");
    ok(dar_checkpoint_resume(&r.c, "keep/checkpoint-12", &e), &e);

    run_init(&other, "elsewhere", DAR_PARAM_LORA, DAR_F32, false, 2);
    open_run(&other);
    ok(dar_checkpoint_resume(&other.c, "keep/checkpoint-10", &e), &e);
    other.c.step = r.c.step;
    same_run(&other, &r);
    run_free(&other);
    run_free(&r);
    assert_int_equal(run_remove("keep"), 0);
    assert_int_equal(run_remove("elsewhere"), 0);
}

/* Whose tensors, seed or strength are others is refused, not half read. */
static void another_run(void **state)
{
    (void)state;
    run r, other;
    run_init(&r, "one", DAR_PARAM_LORA, DAR_F32, false, 1);
    open_run(&r);
    save(&r, 5);
    dar_checkpoint_close(&r.c);

    static const struct {
        unsigned roles;
        dar_dtype storage;
        bool bf16_moments;
        uint64_t seed;
        double strength;
        const char *words;
    } others[] = {
        { DAR_PARAM_LORA, DAR_F32, false, 5, 1, "state.seed: found \"18446744073709551614\"" },
        { DAR_PARAM_LORA, DAR_F32, true, 0, 1, "found f32 [3, 20], expected bf16 [3, 20]" },
        { DAR_PARAM_LORA, DAR_F64, false, 0, 1, "found f32 [3, 20], expected f64 [3, 20]" },
        { DAR_PARAM_LORA, DAR_F32, false, 0, 2, "alpha: found 1.5, expected 3" },
        { DAR_PARAM_LORA | DAR_PARAM_ADAPTER, DAR_F32, false, 0, 1, "adapter.safetensors: No such file" },
        { DAR_PARAM_BASE, DAR_F32, false, 0, 1, "dit.safetensors: No such file" },
    };
    for (size_t i = 0; i < DAR_COUNT(others); i++) {
        run_init(&other, "one", others[i].roles, others[i].storage, others[i].bf16_moments, 2);
        if (others[i].seed) other.c.seed = others[i].seed;
        for (int k = 0; k < DAR_PROJECTIONS; k++) other.net.m.block[1].product[k].scale *= others[i].strength;
        open_run(&other);
        resume_fails(&other, "auto", others[i].words);
        run_free(&other);
    }
    run_free(&r);
    assert_int_equal(run_remove("one"), 0);
}

/* What was said on standard error while a run is resumed with another configuration. */
static void another_configuration(void **state)
{
    (void)state;
    run r;
    dar_err e;
    char text[4096];
    run_init(&r, "changed", DAR_PARAM_LORA, DAR_F32, false, 1);
    open_run(&r);
    r.c.config = "{\"rate\": 0.1, \"list\": [1, 2], \"in\": {\"side\": true, \"same\": \"x\"}, \"gone\": 1}";
    save(&r, 1);
    r.c.config = "{\"rate\": 0.2, \"list\": [1, 2], \"in\": {\"side\": \"no\", \"same\": \"x\"}, \"new\": null}";
    int saved = dup(STDERR_FILENO), file = open("told", O_RDWR | O_CREAT | O_TRUNC, 0666);
    assert_true(saved >= 0 && file >= 0 && dup2(file, STDERR_FILENO) >= 0);
    dar_status s = dar_checkpoint_resume(&r.c, "auto", &e);
    assert_true(dup2(saved, STDERR_FILENO) >= 0);
    close(saved);
    close(file);
    ok(s, &e);
    run_read("told", text, sizeof text);
    assert_string_equal(text, "rate: 0.1 before, 0.2 now\nin.side: true before, \"no\" now\n");
    run_free(&r);
    assert_int_equal(run_remove("changed"), 0);
}

/* ---------------------------------------------------------------- damage */

/* A file of a checkpoint, and what it was before. */
typedef struct victim {
    char path[PATH_MAX], text[1 << 18];
    size_t size;
} victim;

static victim harmed;

static void read_victim(const char *path)
{
    FILE *f = fopen(path, "rb");
    assert_non_null(f);
    snprintf(harmed.path, sizeof harmed.path, "%s", path);
    harmed.size = fread(harmed.text, 1, sizeof harmed.text, f);
    assert_in_range(harmed.size, 1, sizeof harmed.text - 1);
    fclose(f);
}

/* One bit at a place, given in percent, or the end of the file there. */
static void damage(size_t percent, bool cut)
{
    size_t at = (harmed.size - 1) * percent / 100;
    harmed.text[at] ^= 4;
    run_write(harmed.path, harmed.text, cut ? at : harmed.size);
    harmed.text[at] ^= 4;
}

/* Every file, one bit at many places, cut at many, gone: the older one is taken, and the next save puts things right.
 */
static void damaged(void **state)
{
    (void)state;
    static const char *const files[] = { "checkpoint.json",  "config.json",         "model.json",
                                         "lora.safetensors", "adapter.safetensors", "optimizer.safetensors" };
    run a, b;
    dar_err e;
    char path[PATH_MAX];
    run_init(&a, "bad", DAR_PARAM_LORA | DAR_PARAM_ADAPTER, DAR_F32, false, 1);
    run_init(&b, "bad", DAR_PARAM_LORA | DAR_PARAM_ADAPTER, DAR_F32, false, 2);
    a.c.keep = 2;
    open_run(&a);
    save(&a, 10);
    save(&a, 20);
    dar_log_set(DAR_LOG_ERROR);
    for (size_t i = 0; i < DAR_COUNT(files); i++) {
        snprintf(path, sizeof path, "bad/checkpoint-20/%s", files[i]);
        read_victim(path);
        for (size_t at = 0; at <= 100; at += 4) {
            if (at == 48) unlink(path);
            else damage(at, at % 3 == 0);
            ok(dar_checkpoint_resume(&b.c, "auto", &e), &e);
            CHECK(b.c.step == 10, "%s: damage at %zu %% is not noticed", path, at);
        }
        run_write(path, harmed.text, harmed.size);
        ok(dar_checkpoint_resume(&b.c, "auto", &e), &e);
        assert_int_equal(b.c.step, 20);
    }
    same_run(&a, &b);

    damage(50, false); /* 20 is damaged: after a save at 15 it is 10 that is kept */
    ok(dar_checkpoint_resume(&a.c, "auto", &e), &e);
    save(&a, 15);
    assert_false(run_is_there("bad/checkpoint-20"));
    assert_true(run_is_there("bad/checkpoint-10"));
    read_victim("bad/checkpoint-10/config.json");
    damage(50, false);
    read_victim("bad/checkpoint-15/lora.safetensors");
    damage(50, false);
    resume_fails(&a, "auto", "found 2 checkpoints, none of them whole");
    resume_fails(&a, "bad/checkpoint-15", "lora.safetensors: found SHA-256");
    dar_log_set(DAR_LOG_INFO);
    run_free(&a);
    run_free(&b);
    assert_int_equal(run_remove("bad"), 0);
}

/* ---------------------------------------------------------------- the disk, other programs */

/* However much fits: the failure says so, what was there before is whole, and nothing else is left. */
static void disk_full(void **state)
{
    (void)state;
    struct rlimit old, limit;
    run a, b;
    dar_err e;
    int failed = 0;
    run_init(&a, "full", DAR_PARAM_LORA, DAR_F32, false, 1);
    run_init(&b, "full", DAR_PARAM_LORA, DAR_F32, false, 1);
    open_run(&a);
    save(&a, 10);
    dar_checkpoint_close(&a.c);
    open_run(&b);
    dar_rng_fill_normal(&b.net.p.at[b.net.p.count - 1]->x, 9, 9, 1);
    signal(SIGXFSZ, SIG_IGN);
    assert_int_equal(getrlimit(RLIMIT_FSIZE, &old), 0);
    for (rlim_t most = 0; most < 60000; most = most * 3 / 2 + 10) {
        limit = (struct rlimit){ most, old.rlim_max };
        assert_int_equal(setrlimit(RLIMIT_FSIZE, &limit), 0);
        dar_status s = dar_checkpoint_save(&b.c, 20, &e);
        assert_int_equal(setrlimit(RLIMIT_FSIZE, &old), 0);
        if (s == DAR_OK) break;
        failed++;
        CHECK(s == DAR_ERR_NOMEM && strstr(e.text, "full/checkpoint-20: not saved: ") &&
                  strstr(e.text, "File too large; what was saved before"),
              "%s", e.text);
        assert_false(run_is_there("full/checkpoint-20"));
        assert_int_equal(b.c.step, 0);
    }
    CHECK(failed > 10, "only %d limits were too small", failed);
    ok(dar_checkpoint_resume(&b.c, "full/checkpoint-20", &e), &e);
    assert_int_equal(run_remove("full/checkpoint-20"), 0);
    ok(dar_checkpoint_resume(&b.c, "auto", &e), &e);
    same_run(&a, &b);
    run_free(&a);
    run_free(&b);
    assert_int_equal(run_remove("full/checkpoint-10"), 0);
    assert_int_equal(rmdir("full"), 0); /* nothing else was in it */
}

static void left_overs(void **state)
{
    (void)state;
    run a, b;
    dar_err e;
    run_init(&a, "left", DAR_PARAM_LORA, DAR_F32, false, 1);
    run_init(&b, "left", DAR_PARAM_LORA, DAR_F32, false, 1);
    open_run(&a);
    save(&a, 3);
    assert_int_equal(mkdir("left/checkpoint-4.tmp-123-0", 0777), 0);
    run_write("left/checkpoint-4.tmp-123-0/lora.safetensors", "x", 1);
    run_write("left/loss.csv.tmp-77", "x", 1);
    run_write("left/notes.tmp-mine", "x", 1);

    CHECK(dar_checkpoint_open(&b.c, &e) == DAR_ERR_USAGE && strstr(e.text, "another program"), "%s", e.text);
    assert_true(run_is_there("left/checkpoint-4.tmp-123-0")); /* whose run it is not sweeps nothing */
    dar_checkpoint_close(&a.c);
    open_run(&b);
    assert_false(run_is_there("left/checkpoint-4.tmp-123-0"));
    assert_false(run_is_there("left/loss.csv.tmp-77"));
    assert_true(run_is_there("left/notes.tmp-mine"));
    assert_true(run_is_there("left/checkpoint-3"));
    run_free(&a);
    run_free(&b);
    assert_int_equal(run_remove("left"), 0);

    run_init(&a, "in/the/way", DAR_PARAM_LORA, DAR_F32, false, 1); /* directories above are made, files stay */
    open_run(&a);
    dar_checkpoint_close(&a.c);
    run_free(&a);
    run_write("in/file", "x", 1);
    run_init(&a, "in/file/run", DAR_PARAM_LORA, DAR_F32, false, 1);
    CHECK(dar_checkpoint_open(&a.c, &e) == DAR_ERR_IO && strstr(e.text, "in/file/run: Not a directory"), "%s", e.text);
    run_free(&a);
}

static int in_directory(void **state)
{
    config = model_preset("dar-test");
    return scratch_make(state) || chdir(scratch_dir);
}

int main(void)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(there_and_back),   cmocka_unit_test(autoencoder), cmocka_unit_test(others_read_it),
        cmocka_unit_test(newest_ones_stay), cmocka_unit_test(another_run), cmocka_unit_test(another_configuration),
        cmocka_unit_test(damaged),          cmocka_unit_test(disk_full),   cmocka_unit_test(left_overs),
    };
    return cmocka_run_group_tests_name("checkpoint", tests, in_directory, scratch_remove) != 0;
}
