/* test_taew.c: the tiny autoencoder against its formulas in f64, and against itself in pieces. */
#include "tests/test.h"

#include "lib/rng.h"
#include "lib/weights.h"
#include "models/load.h"
#include "models/taew.h"
#include "tests/distance.h"
#include "tests/fixture.h"

/* Widths of scripts/make-taew-fixtures.py. */
static const dar_taew_config small = { .latent = 5, .encoder_width = 6, .decoder_width = { 8, 7, 6, 4 } };

typedef struct net {
    dar_arena weights, step, cache;
    dar_params p;
    dar_taew v;
    dar_tape tape;
    dar_weights *file;
} net;

static void declare(net *n, const dar_taew_config *c, dar_dtype storage)
{
    dar_err e;
    CHECK(dar_tape_init(&n->tape, &n->step, &e) == DAR_OK, "%s", e.text);
    n->tape.recording = false;
    dar_params_init(&n->p, &n->weights, storage);
    dar_taew_init(&n->v, &n->p, c);
}

static void net_init(net *n, dar_dtype storage)
{
    dar_err e;
    memset(n, 0, sizeof *n);
    CHECK(dar_arena_init(&n->weights, "weights", 8 << 20, &e) == DAR_OK, "%s", e.text);
    CHECK(dar_arena_init(&n->step, "step", 64 << 20, &e) == DAR_OK, "%s", e.text);
    CHECK(dar_arena_init(&n->cache, "cache", 8 << 20, &e) == DAR_OK, "%s", e.text);
    declare(n, &small, storage);
    n->file = fixture_open("taew_weights.safetensors");
    CHECK(dar_load_vae(&n->p, n->file, &e) == DAR_OK, "%s", e.text);
    dar_taew_prepare(&n->v, &n->weights);
}

static void net_free(net *n)
{
    dar_weights_close(n->file);
    dar_params_free(&n->p);
    dar_tape_free(&n->tape);
    dar_arena_free(&n->weights);
    dar_arena_free(&n->step);
    dar_arena_free(&n->cache);
}

/* ---------------------------------------------------------------- against the formulas */

static void parity(void **state)
{
    (void)state;
    static const struct {
        dar_dtype type;
        double bound;
    } runs[] = { { DAR_F64, 1e-10 }, { DAR_F32, 2e-5 }, { DAR_BF16, 6e-2 } };
    dar_weights *s = fixture_open("taew_stages.safetensors");
    dar_tensor x = fixture_tensor(s, "x"), latent = fixture_tensor(s, "latent"), z = fixture_tensor(s, "z"),
               pixels = fixture_tensor(s, "pixels");
    for (size_t i = 0; i < DAR_COUNT(runs); i++) {
        net n;
        net_init(&n, runs[i].type);
        double d[] = { test_relative(&dar_taew_encode(&n.tape, &n.v, fixture_input(&n.tape, n.p.main, &x))->x, &latent),
                       test_relative(&dar_taew_decode(&n.tape, &n.v, fixture_input(&n.tape, n.p.main, &z))->x,
                                     &pixels) };
        printf("%s: latent %.1e, pixels %.1e\n", dar_dtype_name(runs[i].type), d[0], d[1]);
        for (int k = 0; k < 2; k++) CHECK_NEAR(dar_dtype_name(runs[i].type), d[k], 0, runs[i].bound);
        net_free(&n);
    }
    dar_weights_close(s);
}

/* ---------------------------------------------------------------- in pieces */

/* Bits of the frames from `at` on. */
static void same_frames(const dar_tensor *whole, int64_t at, const dar_tensor *piece)
{
    size_t frame = (size_t)(whole->shape.d[3] * whole->shape.d[4]) * dar_dtype_size(whole->dtype);
    size_t C = (size_t)whole->shape.d[1], T = (size_t)whole->shape.d[2], n = (size_t)piece->shape.d[2];
    for (size_t c = 0; c < C; c++)
        assert_memory_equal((char *)piece->data + c * n * frame, (char *)whole->data + (c * T + (size_t)at) * frame,
                            n * frame);
}

typedef struct frames {
    const dar_tensor *whole;
    int64_t next;
} frames;

static dar_status compare(void *ctx, const dar_tensor *frame, int64_t index, dar_err *e)
{
    frames *f = ctx;
    (void)e;
    assert_int_equal(index, f->next++);
    same_frames(f->whole, index, frame);
    return DAR_OK;
}

static void decoding_in_pieces(void **state)
{
    (void)state;
    for (int type = DAR_F64; type <= DAR_BF16; type++) {
        net n;
        net_init(&n, (dar_dtype)type);
        dar_tensor z = dar_tensor_push(&n.weights, n.p.main, DAR_SHAPE(1, 5, 4, 3, 2));
        dar_rng_fill_uniform(&z, 1, 2, -4, 4);
        frames f = { .whole = &dar_taew_decode(&n.tape, &n.v, fixture_input(&n.tape, n.p.main, &z))->x };
        assert_int_equal(f.whole->shape.d[2], 13);
        dar_taew_stream s;
        dar_taew_stream_init(&s, &n.v, DAR_VAE_DECODER, &n.cache);
        for (int64_t k = 0; k < 4; k++) {
            dar_tensor piece = dar_tensor_narrow(&z, 2, k, 1);
            dar_val *in = fixture_input(&n.tape, n.p.main, &piece);
            size_t used = n.step.used;
            assert_int_equal(dar_taew_decode_next(&s, &n.tape, in, compare, &f, NULL), DAR_OK);
            assert_int_equal(n.step.used, used);
        }
        assert_int_equal(f.next, 13);
        net_free(&n);
    }
}

/* Of every length within a group. */
static void encoding_in_pieces(void **state)
{
    (void)state;
    for (int64_t F = 9; F < 13; F++) {
        net n;
        net_init(&n, F % 2 ? DAR_F32 : DAR_F64);
        dar_tensor x = dar_tensor_push(&n.weights, n.p.main, DAR_SHAPE(1, 3, F, 48, 32));
        dar_rng_fill_uniform(&x, 1, 2, -1, 1);
        dar_val *whole = dar_taew_encode(&n.tape, &n.v, fixture_input(&n.tape, n.p.main, &x));
        assert_int_equal(whole->x.shape.d[2], 3);
        dar_taew_stream s;
        dar_taew_stream_init(&s, &n.v, DAR_VAE_ENCODER, &n.cache);
        for (int64_t k = 0; k < 3; k++) {
            dar_tensor piece = dar_tensor_narrow(&x, 2, 4 * k, k < 2 ? 4 : F - 8);
            same_frames(&whole->x, k, &dar_taew_encode_next(&s, &n.tape, fixture_input(&n.tape, n.p.main, &piece))->x);
        }
        net_free(&n);
    }
}

static void same_bits(void **state)
{
    (void)state;
    static const int threads[] = { 1, 2, 3, 7 };
    dar_weights *s = fixture_open("taew_stages.safetensors");
    dar_tensor z = fixture_tensor(s, "z");
    int before = dar_threads();
    unsigned char *kept = NULL;
    for (int i = 0; i < 4; i++) {
        net n;
        dar_threads_set(threads[i]);
        net_init(&n, DAR_F32);
        dar_val *y = dar_taew_decode(&n.tape, &n.v, fixture_input(&n.tape, n.p.main, &z));
        size_t bytes = dar_tensor_bytes(&y->x);
        if (!kept) memcpy(kept = malloc(bytes), y->x.data, bytes);
        else assert_memory_equal(kept, y->x.data, bytes);
        net_free(&n);
    }
    free(kept);
    dar_threads_set(before);
    dar_weights_close(s);
}

/* ---------------------------------------------------------------- the public size */

static size_t count(const dar_params *p, const char *side)
{
    size_t n = 0;
    for (size_t i = 0; i < p->count; i++)
        if (!strncmp(p->at[i]->name, side, strlen(side))) n += dar_shape_count(&p->at[i]->x.shape);
    return n;
}

static void public_size(void **state)
{
    (void)state;
    net n = { 0 };
    dar_err e;
    assert_int_equal(dar_arena_init_plan(&n.weights, "weights", &e), DAR_OK);
    assert_int_equal(dar_arena_init_plan(&n.step, "step", &e), DAR_OK);
    assert_int_equal(dar_arena_init_plan(&n.cache, "cache", &e), DAR_OK);
    declare(&n, &dar_taew_public, DAR_F32);
    assert_int_equal(count(&n.p, "encoder."), 1494576);
    assert_int_equal(count(&n.p, "decoder."), 9923532);
    dar_params_fresh(&n.p, DAR_PARAM_ALL, 0);
    dar_taew_prepare(&n.v, &n.weights);

    /* Published: 1.36 and 2.95 TFLOP for 480 x 832 x 81; products before up-sampling and folded taps save a fifth of
     * the decoder's. */
    dar_taew_encode(&n.tape, &n.v, dar_input(&n.tape, DAR_F32, DAR_SHAPE(1, 3, 81, 480, 832)));
    CHECK_NEAR("encoder [TFLOP]", n.tape.cost.forward / 1e12, 1.36, 0.02);
    dar_tape_clear(&n.tape);
    dar_taew_decode(&n.tape, &n.v, dar_input(&n.tape, DAR_F32, DAR_SHAPE(1, 48, 21, 30, 52)));
    CHECK_NEAR("decoder [TFLOP]", n.tape.cost.forward / 1e12, 2.37, 0.02);
    dar_tape_clear(&n.tape);

    /* A stream takes the memory of one latent frame. */
    dar_arena_reset(&n.step, 0);
    n.step.peak = 0;
    dar_taew_stream s;
    dar_taew_stream_init(&s, &n.v, DAR_VAE_DECODER, &n.cache);
    for (int k = 0; k < 21; k++)
        dar_taew_decode_next(&s, &n.tape, dar_input(&n.tape, DAR_F32, DAR_SHAPE(1, 48, 1, 30, 52)), NULL, NULL, &e);
    double mb = 1e-6 * (double)(n.weights.peak + n.step.peak + n.cache.peak);
    printf("decoding 480 x 832: weights %.0f, kept %.0f, step %.0f MB\n", 1e-6 * (double)n.weights.peak,
           1e-6 * (double)n.cache.peak, 1e-6 * (double)n.step.peak);
    CHECK(mb < 600, "%.0f MB", mb);
    dar_tape_free(&n.tape);
    dar_params_free(&n.p);
    dar_arena_free(&n.weights);
    dar_arena_free(&n.step);
    dar_arena_free(&n.cache);
}

int main(void)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(parity),    cmocka_unit_test(decoding_in_pieces), cmocka_unit_test(encoding_in_pieces),
        cmocka_unit_test(same_bits), cmocka_unit_test(public_size),
    };
    return cmocka_run_group_tests_name("taew", tests, NULL, NULL) != 0;
}
