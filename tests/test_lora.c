/* test_lora.c: low-rank additions: nothing at first, merged and taken back, files of every form. */
#include "tests/test.h"

#include <unistd.h>

#include "lib/rng.h"
#include "lib/safetensors_write.h"
#include "tests/distance.h"
#include "tests/model.h"

static double at(const dar_tensor *x, size_t i)
{
    return dar_dtype_get(x->dtype, x->data, i);
}

static void randomise(dar_param *q, uint64_t stream)
{
    dar_rng_fill_uniform(&q->x, 11, stream, -0.4, 0.4);
}

/* dar-test with fresh weights, no zeros among them, and additions of c's rank, not zero either. */
static void init(model *o, const dar_config *c, dar_dtype storage)
{
    model_init(o, c, storage, false);
    dar_lora_init(&o->m, &o->p, &c->lora);
    dar_params_fresh(&o->p, DAR_PARAM_ALL, 1);
    randomise(o->m.head_w, 1);
    for (size_t i = 0; i < o->p.count; i++)
        if (o->p.at[i]->info.role == DAR_PARAM_LORA) randomise(o->p.at[i], i);
    model_clip(o, 3, 2, 3, 4);
    o->tape.recording = false;
}

/* A copy of the velocity, on the arena of the weights. */
static dar_tensor velocity(model *o)
{
    dar_tensor v = model_velocity(o)->x, y = dar_tensor_push(&o->weights, v.dtype, v.shape);
    dar_tensor_copy(&y, &v);
    return y;
}

static void must(dar_status s, const dar_err *e)
{
    CHECK(s == DAR_OK, "%s", e->text);
}

/* ---------------------------------------------------------------- numbers */

static void zero_changes_no_bit(void **state)
{
    (void)state;
    for (dar_dtype type = DAR_F64; type <= DAR_BF16; type++) {
        model o;
        dar_config c = model_preset("dar-test");
        init(&o, &c, type);
        for (int i = 0; i < c.dit.layers; i++)
            for (int k = 0; k < DAR_PROJECTIONS; k++) dar_tensor_fill(&o.m.block[i].product[k].up->x, 0);
        dar_tensor with = velocity(&o);
        for (int i = 0; i < c.dit.layers; i++)
            for (int k = 0; k < DAR_PROJECTIONS; k++) o.m.block[i].product[k].down = NULL;
        dar_tensor without = velocity(&o);
        CHECK(memcmp(with.data, without.data, dar_tensor_bytes(&with)) == 0, "%s: bits differ", dar_dtype_name(type));
        model_free(&o);
    }
}

/* Merged, the network does the same; taken back, its weights are what they were. */
static void merged_is_the_same(void **state)
{
    (void)state;
    /* A sum of 20 products more or less per product, 20 of them in a chain; in bf16 W + U A is rounded to 2^-9. */
    static const double bound[] = { [DAR_F64] = 1e-13, [DAR_F32] = 5e-5, [DAR_BF16] = 0.2 };
    for (dar_dtype type = DAR_F64; type <= DAR_BF16; type++) {
        model o;
        dar_config c = model_preset("dar-test");
        init(&o, &c, type);
        dar_param *w = o.m.block[1].product[DAR_FFN_DOWN].w;
        dar_tensor before = velocity(&o), old = dar_tensor_push(&o.weights, type, w->x.shape);
        dar_tensor_copy(&old, &w->x);
        dar_lora_merge(&o.m, &o.p, &o.step);
        dar_tensor merged = velocity(&o);
        CHECK(test_distance(&w->x, &old, NULL) > 0.01, "nothing was merged");
        CHECK_NEAR("merged", test_distance(&merged, &before, NULL), 0, bound[type]);
        dar_lora_merge(&o.m, &o.p, &o.step); /* it is already */
        dar_lora_unmerge(&o.m, &o.step);
        double eps = type == DAR_F64 ? 0x1p-53 : type == DAR_F32 ? 0x1p-24 : 0x1p-9;
        CHECK_NEAR("taken back", test_distance(&w->x, &old, NULL), 0, 4 * eps);
        model_free(&o);
    }
}

/* Mapped weights are not written, and come back bit by bit. */
static void mapped_weights_come_back(void **state)
{
    (void)state;
    model o, view;
    dar_config c = model_preset("dar-test");
    init(&o, &c, DAR_BF16);
    model_init(&view, &c, DAR_BF16, false);
    dar_lora_init(&view.m, &view.p, &c.lora);
    for (size_t i = 0; i < view.p.count; i++) dar_param_bind(&view.p, view.p.at[i], &o.p.at[i]->x);
    model_clip(&view, 3, 2, 3, 4);
    view.tape.recording = false;

    dar_param *w = view.m.block[0].product[DAR_CROSS_O].w;
    dar_tensor base = w->x, before = velocity(&view);
    for (int i = 0; i < 2; i++) {
        size_t used = view.weights.used;
        dar_lora_merge(&view.m, &view.p, &view.step);
        CHECK(w->x.data != base.data, "a mapped weight is not copied");
        CHECK(i == 0 || view.weights.used == used, "merging again takes memory again");
        dar_tensor merged = velocity(&view);
        CHECK(test_distance(&merged, &before, NULL) > 0, "nothing was merged");
        dar_lora_unmerge(&view.m, &view.step);
        CHECK(w->x.data == base.data, "the mapped weight is not back");
        dar_tensor after = velocity(&view);
        CHECK(memcmp(after.data, before.data, dar_tensor_bytes(&after)) == 0, "bits differ");
    }
    model_free(&view);
    model_free(&o);
}

/* Relative distance in the Euclidean norm. */
static double relative(const dar_tensor *x, const dar_tensor *y)
{
    double d = 0, n = 0;
    for (size_t i = 0; i < dar_tensor_count(y); i++) {
        d += (at(x, i) - at(y, i)) * (at(x, i) - at(y, i));
        n += at(y, i) * at(y, i);
    }
    return sqrt(d / n);
}

/* A weight is off by 1/254 of its row's largest at most, 0.4 % of what is usual there, and so is a product.  Ten of
 * them feed the second block's half of the stream: 0.4 % sqrt(10) / 2; operands of 20 numbers as much again. */
static void eight_bits(void **state)
{
    (void)state;
    static const double bound[] = { 0.007, 0.013 };
    model o;
    dar_config c = model_preset("dar-test");
    init(&o, &c, DAR_F32);
    dar_tensor before = velocity(&o);
    dar_dit_product *kept = &o.m.block[0].product[DAR_SELF_Q], *q = &o.m.block[1].product[DAR_FFN_UP];
    dar_lora_quantise(&o.m, &o.p, 1, 2, &o.step);
    assert_true(q->w->x.dtype == DAR_I8 && q->merged && kept->w->x.dtype == DAR_F32 && !kept->merged);
    for (int rounded = 0; rounded < 2; rounded++) {
        o.m.quantise = rounded;
        dar_tensor after = velocity(&o);
        double off = relative(&after, &before);
        printf("note: one block of two in 8 bits%s: %.1e\n", rounded ? ", operands too" : "", off);
        CHECK_NEAR("velocity", off, 0, bound[rounded]);
        CHECK(off > 1e-5, "nothing was rounded");
    }
    CHECK_ABORTS(dar_lora_unmerge(&o.m, &o.step));
    CHECK_ABORTS(dar_lora_quantise(&o.m, &o.p, 1, 2, &o.step));
    model_free(&o);
}

/* LoRA trains on weights of 8 bits: the gradient is that of the layer as it is. */
static void eight_bits_train(void **state)
{
    (void)state;
    model o[2];
    dar_config c = model_preset("dar-test");
    for (int i = 0; i < 2; i++) {
        model_init(&o[i], &c, DAR_F32, false);
        dar_lora_init(&o[i].m, &o[i].p, &c.lora);
        dar_params_train(&o[i].p, DAR_PARAM_LORA);
        dar_params_fresh(&o[i].p, DAR_PARAM_ALL, 1);
        dar_params_gradients(&o[i].p);
        randomise(o[i].m.head_w, 1);
        model_clip(&o[i], 3, 2, 3, 4);
        if (i) dar_lora_quantise(&o[i].m, &o[i].p, 0, c.dit.layers, &o[i].step);
        dar_val *loss = model_loss(&o[i]);
        dar_backward(&o[i].tape, loss, NULL);
    }
    const dar_tensor *exact = &o[0].m.block[0].product[DAR_SELF_V].up->g,
                     *g = &o[1].m.block[0].product[DAR_SELF_V].up->g;
    assert_false(o[1].m.block[0].product[DAR_SELF_V].merged);
    CHECK_NEAR("gradient", relative(g, exact), 0, 0.1);
    CHECK(relative(g, exact) > 1e-5, "nothing was rounded");
    model_free(&o[0]);
    model_free(&o[1]);
}

/* ---------------------------------------------------------------- files */

#define PATH "build/test_lora.safetensors"

static void keys_are_understood(void **state)
{
    (void)state;
    static const struct {
        const char *name;
        int block, projection, part; /* block -1: not a key */
    } key[] = {
        { "lora_unet__blocks_0_self_attn_q.lora_down.weight", 0, DAR_SELF_Q, DAR_LORA_DOWN },
        { "lora_unet__blocks_29_cross_attn_o.lora_up.weight", 29, DAR_CROSS_O, DAR_LORA_UP },
        { "lora_unet__blocks_7_ffn_0.alpha", 7, DAR_FFN_UP, DAR_LORA_ALPHA },
        { "blocks.3.ffn.2.lora_A.weight", 3, DAR_FFN_DOWN, DAR_LORA_DOWN },
        { "diffusion_model.blocks.3.cross_attn.k.lora_B.weight", 3, DAR_CROSS_K, DAR_LORA_UP },
        { "base_model.model.blocks.3.cross_attn.v.lora_B.weight", 3, DAR_CROSS_V, DAR_LORA_UP },
        { "pipe.dit.blocks.12.self_attn.o.lora_A.default.weight", 12, DAR_SELF_O, DAR_LORA_DOWN },
        { "lora_unet_blocks_11_cross_attn_k.alpha", 11, DAR_CROSS_K, DAR_LORA_ALPHA },
        { "transformer.blocks.1.attn1.to_out.0.lora_A.weight", 1, DAR_SELF_O, DAR_LORA_DOWN },
        { "transformer.blocks.11.attn2.to_k.lora_B.weight", 11, DAR_CROSS_K, DAR_LORA_UP },
        { "blocks.1.ffn.net.0.proj.lora_A.weight", 1, DAR_FFN_UP, DAR_LORA_DOWN },
        { "blocks.1.ffn.net.2.lora_B.weight", 1, DAR_FFN_DOWN, DAR_LORA_UP },
        { "blocks.30.self_attn.o.lora_A.weight", -1, 0, 0 },
        { "blocks.-1.self_attn.o.lora_A.weight", -1, 0, 0 },
        { "blocks..self_attn.o.lora_A.weight", -1, 0, 0 },
        { "blocks.99999999999999999999.self_attn.o.lora_A.weight", -1, 0, 0 },
        { "blocks.3.self_attn.o.weight", -1, 0, 0 },
        { "blocks.3.self_attn.o.lora_A.weights", -1, 0, 0 },
        { "blocks.3.self_attn.norm_q.lora_A.weight", -1, 0, 0 },
        { "blocks.3", -1, 0, 0 },
        { "text_embedding.0.lora_A.weight", -1, 0, 0 },
        { "", -1, 0, 0 },
    };
    for (size_t i = 0; i < DAR_COUNT(key); i++) {
        dar_lora_key k;
        bool ok = dar_lora_parse(&k, key[i].name, 30);
        CHECK(ok == (key[i].block >= 0), "%s: %s", key[i].name, ok ? "taken" : "not taken");
        if (!ok) continue;
        CHECK(k.block == key[i].block && (int)k.projection == key[i].projection && (int)k.part == key[i].part,
              "%s: block %lld, projection %d, part %d", key[i].name, (long long)k.block, (int)k.projection,
              (int)k.part);
    }
}

static void read_back(model *o, const dar_config *c, const char *path, const dar_lora_read_options *options)
{
    dar_weights *f;
    dar_err e;
    dar_config plain = *c;
    plain.lora.rank = 0;
    init(o, &plain, DAR_F32);
    must(dar_weights_open(&f, path, &e), &e);
    must(dar_lora_read(&o->m, &o->p, f, options, &e), &e);
    dar_tensor v = velocity(o); /* parameters may view the file: before it goes */
    o->target = v;
    dar_weights_close(f);
}

static void written_is_read(void **state)
{
    (void)state;
    model o, back;
    dar_config c = model_preset("dar-test");
    dar_err e;
    c.lora.targets = 1u << DAR_SELF_K | 1u << DAR_CROSS_V | 1u << DAR_FFN_DOWN;
    init(&o, &c, DAR_F32);
    must(dar_lora_write(&o.m, PATH, &e), &e);
    dar_tensor before = velocity(&o);

    read_back(&back, &c, PATH, &(dar_lora_read_options){ .alpha = 100, .strength = 1 });
    CHECK(memcmp(back.target.data, before.data, dar_tensor_bytes(&before)) == 0, "read back, it does something else");
    assert_null(back.m.block[0].product[DAR_SELF_Q].down);
    model_free(&back);

    read_back(&back, &c, PATH, &(dar_lora_read_options){ .strength = 0.5 });
    CHECK_NEAR("scale", back.m.block[0].product[DAR_SELF_K].scale, 0.5 * 1.5 / 3, 1e-15);
    model_free(&back);
    model_free(&o);
    unlink(PATH);
}

/* The same numbers under the names of each tool. */
static void every_form_is_read(void **state)
{
    (void)state;
    static const char *const form[][2] = {
        { "blocks.1.cross_attn.q.lora_A.weight", "blocks.1.cross_attn.q.lora_B.weight" },
        { "pipe.dit.blocks.1.cross_attn.q.lora_A.default.weight",
          "pipe.dit.blocks.1.cross_attn.q.lora_B.default.weight" },
        { "lora_unet__blocks_1_cross_attn_q.lora_down.weight", "lora_unet__blocks_1_cross_attn_q.lora_up.weight" },
    };
    model o;
    dar_config c = model_preset("dar-test");
    dar_err e;
    init(&o, &c, DAR_F32);
    dar_dit_product *q = &o.m.block[1].product[DAR_CROSS_Q];
    for (size_t i = 0; i < DAR_COUNT(form); i++) {
        model back;
        dar_safetensors_item item[] = { { form[i][0], q->down->x }, { form[i][1], q->up->x } };
        must(dar_safetensors_write(PATH, item, 2, NULL, &e), &e);
        read_back(&back, &c, PATH, &(dar_lora_read_options){ .strength = 1 });
        CHECK_NEAR("scale where alpha is not said", back.m.block[1].product[DAR_CROSS_Q].scale, 1, 0);
        model_free(&back);
        read_back(&back, &c, PATH, &(dar_lora_read_options){ .alpha = 1.5, .strength = 1 });
        CHECK_NEAR("scale", back.m.block[1].product[DAR_CROSS_Q].scale, 0.5, 0);
        model_free(&back);
    }
    model_free(&o);
    unlink(PATH);
}

static void bad_files_are_told(void **state)
{
    (void)state;
    float x[64] = { 0 };
#define ITEM(name, ...)                                                                                                \
    {                                                                                                                  \
        name, dar_tensor_of(DAR_F32, DAR_SHAPE(__VA_ARGS__), x)                                                        \
    }
    const struct {
        int n;
        dar_safetensors_item item[3];
        const char *text;
    } bad[] = {
        { 1, { ITEM("blocks.2.self_attn.q.lora_A.weight", 3, 20) }, "blocks.2.self_attn.q.lora_A.weight: expected" },
        { 1, { ITEM("blocks.1.self_attn.q.lora_A.weight", 3, 20) }, "alone, expected both factors" },
        { 1, { ITEM("blocks.1.self_attn.q.alpha", 1) }, "alone, expected both factors" },
        { 2,
          { ITEM("blocks.1.self_attn.q.lora_A.weight", 3, 19), ITEM("blocks.1.self_attn.q.lora_B.weight", 20, 3) },
          "lora_A.weight: found [3, 19], expected [3, 20]" },
        { 2,
          { ITEM("blocks.1.self_attn.q.lora_A.weight", 3, 20), ITEM("blocks.1.self_attn.q.lora_B.weight", 20, 2) },
          "lora_B.weight: found [20, 2], expected [20, 3]" },
        { 3,
          { ITEM("blocks.1.self_attn.q.lora_A.weight", 1, 20), ITEM("blocks.1.self_attn.q.lora_B.weight", 20, 1),
            ITEM("blocks.1.self_attn.q.alpha", 2) },
          "alpha: found [2], expected []" },
        { 2,
          { ITEM("blocks.1.self_attn.q.lora_A.weight", 3, 20),
            ITEM("lora_unet__blocks_1_self_attn_q.lora_down.weight", 3, 20) },
          "mean the same" },
    };
    for (size_t i = 0; i < DAR_COUNT(bad); i++) {
        model o;
        dar_config c = model_preset("dar-test");
        dar_weights *f;
        dar_err e;
        must(dar_safetensors_write(PATH, bad[i].item, (size_t)bad[i].n, NULL, &e), &e);
        must(dar_weights_open(&f, PATH, &e), &e);
        model_init(&o, &c, DAR_F32, false);
        dar_status s = dar_lora_read(&o.m, &o.p, f, &(dar_lora_read_options){ .strength = 1 }, &e);
        CHECK(s == DAR_ERR_FORMAT && strstr(e.text, bad[i].text), "file %zu: status %d, %s", i, (int)s, e.text);
        dar_weights_close(f);
        model_free(&o);
    }
    unlink(PATH);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(zero_changes_no_bit),      cmocka_unit_test(merged_is_the_same),
        cmocka_unit_test(mapped_weights_come_back), cmocka_unit_test(eight_bits),
        cmocka_unit_test(eight_bits_train),         cmocka_unit_test(keys_are_understood),
        cmocka_unit_test(written_is_read),          cmocka_unit_test(every_form_is_read),
        cmocka_unit_test(bad_files_are_told),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
