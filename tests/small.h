/* small.h: a small model, three clips and the configurations to train it, in the directory of a test. */
#ifndef DAR_TESTS_SMALL_H
#define DAR_TESTS_SMALL_H

#include "tests/run.h"

#include "lib/safetensors_write.h"
#include "models/config.h"
#include "models/vae.h"

/* A token is 8 x 8 pixels. */
static const char small_model[] = "{\"name\": \"small\","
                                  "\"dit\": {\"width\": 20, \"heads\": 2, \"layers\": 2, \"ffn\": 27, \"latent\": 5,"
                                  "\"frequencies\": 16, \"text_width\": 13, \"text_keys\": 11},"
                                  "\"adapter\": {\"unshuffle\": 4},"
                                  "\"vae\": {\"patch\": 1, \"multipliers\": [1, 2, 2], \"halve_time\": [true, true],"
                                  "\"encoder_width\": 3, \"decoder_width\": 4, \"encoder_blocks\": 1,"
                                  "\"decoder_blocks\": 1}}";

/* From nothing, 20 steps; then additions to what that leaves. */
static const char small_backbone[] =
    "{\"model\": \"small\", \"train\": \"full\", \"from_scratch\": true, \"data\": [\"clips\"],"
    "\"output_dir\": \"backbone\", \"cache_dir\": \"cache\", \"mixed_precision\": \"f32\","
    "\"learning_rate\": 0.003, \"lr_warmup_steps\": 2, \"max_train_steps\": 20,"
    "\"train_batch_size\": 2, \"max_grad_norm\": 1, \"adam_epsilon\": 1e-8,"
    "\"validation\": {\"data\": [\"clips\"], \"steps\": 20, \"clips\": 1, \"sampler_steps\": 2}}";

static const char small_additions[] =
    "{\"base\": \"backbone.json\", \"model\": \"backbone/checkpoint-20\", \"train\": \"lora\","
    "\"from_scratch\": false, \"rank\": 4, \"output_dir\": \"lora\", \"train_batch_size\": 1,"
    "\"condition\": {\"channels\": \"dar\"}, \"validation\": {\"steps\": 0}}";

static inline void small_vae(void)
{
    dar_arena a;
    dar_params p;
    dar_vae vae = { 0 };
    dar_config c;
    dar_err e;
    assert_int_equal(mkdir("small", 0777), 0);
    run_write("small/model.json", small_model, sizeof small_model - 1);
    CHECK(dar_config_open(&c, "small/model.json", &e) == DAR_OK, "%s", e.text);
    assert_int_equal(dar_arena_init(&a, "weights", 16 << 20, &e), DAR_OK);
    dar_params_init(&p, &a, DAR_F32);
    dar_vae_init(&vae, &p, &c.vae);
    dar_params_fresh(&p, DAR_PARAM_ALL, 1);
    dar_safetensors_item *item = calloc(p.count, sizeof *item);
    assert_non_null(item);
    for (size_t i = 0; i < p.count; i++) item[i] = (dar_safetensors_item){ p.at[i]->name, p.at[i]->x };
    CHECK(dar_safetensors_write("small/vae.safetensors", item, p.count, NULL, &e) == DAR_OK, "%s", e.text);
    free(item);
    dar_params_free(&p);
    dar_arena_free(&a);
}

/* A bundle of 9 frames, unless said. */
static inline void small_bundle(char *bundler, const char *name, const char *size, const char *frames, const char *path)
{
    static const char cube[] = "v -1 -1 -1\nv 1 -1 -1\nv 1 1 -1\nv -1 1 -1\nv -1 -1 1\nv 1 -1 1\nv 1 1 1\nv -1 1 1\n"
                               "f 1 3 2\nf 1 4 3\nf 5 6 7\nf 5 7 8\nf 1 2 6\nf 1 6 5\nf 3 4 8\nf 3 8 7\nf 1 5 8\n"
                               "f 1 8 4\nf 2 3 7\nf 2 7 6\n";
    run_write("cube.obj", cube, sizeof cube - 1);
    int status = RUN_PROGRAM(bundler, "render", "cube.obj", "-o", name, "--size", size, "--frames", frames,
                             "--families", "all", "--trajectory", path, "--shade", "day");
    CHECK(status == 0, "%s: %s", name, ran.err);
}

/* small, clips, backbone.json, lora.json */
static inline void small_make(char *bundler)
{
    small_vae();
    assert_int_equal(mkdir("clips", 0777), 0);
    small_bundle(bundler, "clips/a", "40x24", "9", "orbit-60");
    small_bundle(bundler, "clips/b", "40x24", "9", "orbit-0-45");
    small_bundle(bundler, "clips/c", "40x24", "9", "dolly-15");
    run_write("backbone.json", small_backbone, sizeof small_backbone - 1);
    run_write("lora.json", small_additions, sizeof small_additions - 1);
}

#endif
