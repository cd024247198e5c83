/* test_config.c: configurations of networks: presets as shipped, defaults, what is refused and how it is told. */
#include "tests/test.h"

#include "tests/model.h"

static dar_status parse(dar_config *c, const char *text, dar_err *e)
{
    dar_json_doc *doc;
    dar_status s = dar_json_parse(&doc, "test.json", text, strlen(text), e);
    CHECK(s == DAR_OK, "%s", e->text);
    dar_config_read(c, dar_json_root(doc));
    s = dar_json_finish(doc, e);
    dar_json_close(doc);
    return s;
}

static void presets_are_whole(void **state)
{
    (void)state;
    static const char *const name[] = { "wan22-fun-5b", "dar-tiny", "dar-test" };
    for (size_t i = 0; i < DAR_COUNT(name); i++) {
        dar_config c = model_preset(name[i]);
        assert_string_equal(c.name, name[i]);
        /* A token is as many pixels for the adapter as for latent and patch. */
        if (i < 2) assert_int_equal(2 * c.adapter.unshuffle, c.dit.patch * dar_vae_shrink(&c.vae));
        assert_int_equal(dar_vae_shrink_time(&c.vae), c.dit.mask);
    }
    dar_config c = model_preset("wan22-fun-5b");
    assert_int_equal(dar_dit_channels(&c.dit), 100);
    CHECK_NEAR("base of the public rotation", c.dit.rope_base, 10000, 0);
}

#define SIZES "\"width\": 48, \"heads\": 3, \"layers\": 2, \"ffn\": 96"

static void defaults_are_those_of_the_public_model(void **state)
{
    (void)state;
    dar_config c, public = model_preset("wan22-fun-5b");
    dar_err e;
    CHECK(parse(&c, "{ \"name\": \"x\", \"dit\": { " SIZES " } }", &e) == DAR_OK, "%s", e.text);
    public.dit.width = 48;
    public.dit.heads = 3;
    public.dit.layers = 2;
    public.dit.ffn = 96;
    assert_memory_equal(&c.dit, &public.dit, sizeof c.dit);
    assert_memory_equal(&c.adapter, &public.adapter, sizeof c.adapter);
    assert_int_equal(c.lora.rank, 0);
}

static void lora_keys(void **state)
{
    (void)state;
    dar_config c;
    dar_err e;
    CHECK(parse(&c,
                "{ \"name\": \"x\", \"dit\": { " SIZES " }, \"lora\": { \"rank\": 16, \"targets\": "
                "[ \"self_attn.q\", \"ffn.2\" ] } }",
                &e) == DAR_OK,
          "%s", e.text);
    CHECK_NEAR("alpha is the rank", c.lora.alpha, 16, 0);
    assert_int_equal(c.lora.targets, 1u << DAR_SELF_Q | 1u << DAR_FFN_DOWN);
    CHECK(parse(&c, "{ \"name\": \"x\", \"dit\": { " SIZES " }, \"lora\": { \"rank\": 4, \"alpha\": 1 } }", &e) ==
              DAR_OK,
          "%s", e.text);
    CHECK_NEAR("alpha", c.lora.alpha, 1, 0);
    assert_int_equal(c.lora.targets, DAR_PROJECTIONS_ALL);
}

static void wrong_ones_are_told(void **state)
{
    (void)state;
    static const struct {
        const char *text, *says;
    } bad[] = {
        { "{}", "name" },
        { "{ \"name\": \"x\", \"dit\": { \"heads\": 3, \"layers\": 2, \"ffn\": 96 } }", "dit.width" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES ", \"pach\": 2 } }", "patch" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES " }, \"adaptor\": {} }", "adapter" },
        { "{ \"name\": \"x\", \"dit\": { \"width\": 48, \"heads\": 5, \"layers\": 2, \"ffn\": 96 } }", "dit.heads" },
        { "{ \"name\": \"x\", \"dit\": { \"width\": 48, \"heads\": 12, \"layers\": 2, \"ffn\": 96 } }", "dit.heads" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES ", \"frequencies\": 7 } }", "even" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES ", \"eps\": 0 } }", "dit.eps" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES ", \"rope_base\": 0.5 } }", "dit.rope_base" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES " }, \"adapter\": { \"spread\": 0 } }", "adapter.spread" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES " }, \"adapter\": { \"widen\": \"zero\" } }", "copy, fresh" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES " }, \"adapter\": { \"blocks\": 9 } }", "adapter.blocks" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES " }, \"lora\": { \"targets\": [ \"q\" ] } }", "self_attn.q" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES " }, \"vae\": { \"multipliers\": [ 1, 2 ] } }", "vae.halve_time" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES " }, \"vae\": { \"multipliers\": [ 1, 0, 4, 4 ] } }", "from 1" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES " }, \"vae\": { \"multipliers\": [ 1, 2, 4, 8 ] } }",
          "vae.multipliers" },
        { "{ \"name\": \"x\", \"dit\": { " SIZES " }, \"vae\": { \"multipliers\": [ 1, 3, 4, 4 ] } }",
          "vae.multipliers" },
    };
    for (size_t i = 0; i < DAR_COUNT(bad); i++) {
        dar_config c;
        dar_err e = { "" };
        dar_status s = parse(&c, bad[i].text, &e);
        CHECK(s == DAR_ERR_FORMAT && strstr(e.text, bad[i].says), "%s: status %d, %s", bad[i].text, (int)s, e.text);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(presets_are_whole),
        cmocka_unit_test(defaults_are_those_of_the_public_model),
        cmocka_unit_test(lora_keys),
        cmocka_unit_test(wrong_ones_are_told),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
