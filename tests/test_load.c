/* test_load.c: weights find their places under every name they go by; what does not fit is told. */
#include "tests/test.h"

#include <unistd.h>

#include "lib/json.h"
#include "lib/log.h"
#include "lib/safetensors_write.h"
#include "models/load.h"
#include "models/vae.h"
#include "tests/model.h"

/* Every name of diffusers' autoencoder, as its own state dict lists them. */
static void vae_names(void **state)
{
    (void)state;
    dar_json_doc *doc;
    dar_err e;
    char name[256];
    int n = 0;
    CHECK(dar_json_open(&doc, "tests/fixtures/vae_names.json", &e) == DAR_OK, "%s", e.text);
    for (dar_json x = dar_json_first(dar_json_root(doc)); x.item; x = dar_json_next(x), n++) {
        dar_load_diffusers_vae(dar_json_text(x, NULL, NULL), name, sizeof name);
        assert_string_equal(name, dar_json_key(x));
    }
    assert_int_equal(n, 144);
    dar_json_close(doc);
}

static void dit_names(void **state)
{
    (void)state;
    static const char *const known[][2] = {
        { "patch_embedding.weight", "patch_embedding.weight" },
        { "text_embedding.2.bias", "condition_embedder.text_embedder.linear_2.bias" },
        { "time_projection.1.weight", "condition_embedder.time_proj.weight" },
        { "head.modulation", "scale_shift_table" },
        { "head.head.weight", "proj_out.weight" },
        { "blocks.12.modulation", "blocks.12.scale_shift_table" },
        { "blocks.3.self_attn.q.weight", "blocks.3.attn1.to_q.weight" },
        { "blocks.3.cross_attn.o.bias", "blocks.3.attn2.to_out.0.bias" },
        { "blocks.3.cross_attn.norm_k.weight", "blocks.3.attn2.norm_k.weight" },
        { "blocks.29.ffn.0.weight", "blocks.29.ffn.net.0.proj.weight" },
        { "blocks.29.ffn.2.weight", "blocks.29.ffn.net.2.weight" },
        { "blocks.0.norm3.bias", "blocks.0.norm2.bias" },
        { "control_adapter.conv.weight", "control_adapter.conv.weight" },
    };
    char name[256];
    for (size_t i = 0; i < DAR_COUNT(known); i++) {
        dar_load_diffusers_dit(known[i][0], name, sizeof name);
        assert_string_equal(name, known[i][1]);
    }
}

/* ---------------------------------------------------------------- whole files */

typedef enum damage { NONE, MISSING, MISSHAPEN, EXTRA, NO_ADAPTER } damage;

static char path[64];

/* Write the test network's weights under names that `rename` makes, with one thing wrong. */
static void write_file(model *o, void (*rename)(const char *, char *, size_t), damage d)
{
    enum { MOST = 128 };
    static char name[MOST][256];
    dar_safetensors_item item[MOST];
    dar_err e;
    size_t n = 0;
    static float two[2] = { 1, 2 };
    for (size_t i = 0; i < o->p.count; i++) {
        const dar_param *q = o->p.at[i];
        bool adapter = strncmp(q->name, "control_adapter", 15) == 0;
        if ((d == MISSING && !strcmp(q->name, "blocks.1.ffn.2.bias")) || (d == NO_ADAPTER && adapter)) continue;
        rename(q->name, name[n], sizeof name[n]);
        item[n] = (dar_safetensors_item){ name[n], q->x };
        if (d == MISSHAPEN && !strcmp(q->name, "blocks.0.norm3.bias"))
            item[n].x = dar_tensor_of(DAR_F32, DAR_SHAPE(2), two);
        n++;
    }
    if (d == EXTRA)
        item[n++] = (dar_safetensors_item){ "img_emb.proj.weight", dar_tensor_of(DAR_F32, DAR_SHAPE(2), two) };
    CHECK(dar_safetensors_write(path, item, n, NULL, &e) == DAR_OK, "%s", e.text);
}

static void same(const char *name, char *out, size_t size)
{
    snprintf(out, size, "%s", name);
}
static void below(const char *name, char *out, size_t size)
{
    snprintf(out, size, "model.%s", name);
}

static dar_status load_file(model *o, const dar_config *c, dar_weights **w, dar_err *e)
{
    model_init(o, c, DAR_F32, false);
    CHECK(dar_weights_open(w, path, e) == DAR_OK, "%s", e->text);
    return dar_load_dit(&o->m, &o->p, *w, 1, e);
}

static void round_trips(void **state)
{
    (void)state;
    void (*const names[])(const char *, char *, size_t) = { same, below, dar_load_diffusers_dit };
    dar_config c = model_preset("dar-test");
    model made, read;
    model_init(&made, &c, DAR_F32, false);
    dar_params_fresh(&made.p, DAR_PARAM_ALL, 7);
    for (size_t k = 0; k < DAR_COUNT(names); k++) {
        dar_weights *w;
        dar_err e;
        write_file(&made, names[k], k == 1 ? EXTRA : NONE); /* what is not used is no failure */
        CHECK(load_file(&read, &c, &w, &e) == DAR_OK, "%s", e.text);
        for (size_t i = 0; i < made.p.count; i++) {
            const dar_param *a = made.p.at[i], *b = read.p.at[i];
            CHECK(b->x.data && b->mapped, "%s is no view of the file", b->name);
            assert_memory_equal(a->x.data, b->x.data, dar_tensor_bytes(&a->x));
        }
        model_free(&read);
        dar_weights_close(w);
    }
    model_free(&made);
}

/* A file for fewer channels and blocks than the network has. */
static void widened(void **state)
{
    (void)state;
    dar_config c = model_preset("dar-test"), narrow = c;
    narrow.adapter.geometry = 0;
    model made, read;
    dar_weights *w;
    dar_err e;
    model_init(&made, &narrow, DAR_F32, false);
    dar_params_fresh(&made.p, DAR_PARAM_ALL, 7);
    write_file(&made, same, NONE);
    c.adapter.blocks = 2;
    CHECK(load_file(&read, &c, &w, &e) == DAR_OK, "%s", e.text);
    const dar_tensor *x = &read.m.adapter.w->x, *old = &made.m.adapter.w->x;
    size_t row = (size_t)(x->shape.d[1] * 4), old_row = (size_t)(old->shape.d[1] * 4);
    for (size_t i = 0; i < row; i++)
        CHECK_NEAR("conv", ((float *)x->data)[row + i], i < old_row ? ((float *)old->data)[old_row + i] : 0, 0);
    const dar_tensor *second = &read.m.adapter.block[1][DAR_ADAPTER_W2]->x;
    for (size_t i = 0; i < dar_tensor_count(second); i++) CHECK_NEAR("second block", ((float *)second->data)[i], 0, 0);
    model_free(&read);
    dar_weights_close(w);
    model_free(&made);
}

static void damaged(void **state)
{
    (void)state;
    static const struct {
        damage d;
        const char *says;
    } all[] = {
        { MISSING, "1 tensors missing, 0 of another shape or type: blocks.1.ffn.2.bias [20] is missing" },
        { MISSHAPEN, "0 tensors missing, 1 of another shape or type: blocks.0.norm3.bias: found [2], expected [20]" },
        { NO_ADAPTER, "control_adapter.conv.weight is missing: weights without a camera adapter cannot use rays" },
    };
    dar_config c = model_preset("dar-test");
    model made, read;
    model_init(&made, &c, DAR_F32, false);
    dar_params_fresh(&made.p, DAR_PARAM_ALL, 7);
    dar_log_set(DAR_LOG_ERROR);
    for (size_t i = 0; i < DAR_COUNT(all); i++) {
        dar_weights *w;
        dar_err e;
        write_file(&made, same, all[i].d);
        assert_int_equal(load_file(&read, &c, &w, &e), DAR_ERR_FORMAT);
        CHECK(strstr(e.text, all[i].says) && !strncmp(e.text, path, strlen(path)), "'%s', expected '%s'", e.text,
              all[i].says);
        model_free(&read);
        dar_weights_close(w);
    }

    /* Weights of another network altogether. */
    dar_weights *w;
    dar_err e;
    model_init(&read, &c, DAR_F32, false);
    CHECK(dar_weights_open(&w, "tests/fixtures/vae_weights.safetensors", &e) == DAR_OK, "%s", e.text);
    assert_int_equal(dar_load_dit(&read.m, &read.p, w, 1, &e), DAR_ERR_FORMAT);
    CHECK(strstr(e.text, "none of its tensors is of this network"), "%s", e.text);
    dar_weights_close(w);
    model_free(&read);
    dar_log_set(DAR_LOG_INFO);
    model_free(&made);
}

static int setup(void **state)
{
    (void)state;
    snprintf(path, sizeof path, "build/load-%d.safetensors", (int)getpid());
    return 0;
}

static int teardown(void **state)
{
    (void)state;
    unlink(path);
    return 0;
}

int main(void)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(vae_names), cmocka_unit_test(dit_names), cmocka_unit_test(round_trips),
        cmocka_unit_test(widened),   cmocka_unit_test(damaged),
    };
    return cmocka_run_group_tests_name("load", tests, setup, teardown) != 0;
}
