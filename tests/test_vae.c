/* test_vae.c: the autoencoder against diffusers in f64, and against itself in pieces. */
#include "tests/test.h"

#include "lib/kern.h"
#include "lib/rng.h"
#include "lib/weights.h"
#include "models/tiles.h"
#include "models/vae.h"
#include "tests/distance.h"
#include "tests/fixture.h"

typedef struct net {
    dar_config c;
    dar_arena weights, step, cache;
    dar_params p;
    dar_vae v;
    dar_tape tape;
} net;

/* The test preset with the fixture's weights, trainable or not. */
static void net_init(net *n, dar_dtype storage, bool train)
{
    dar_err e;
    memset(n, 0, sizeof *n);
    CHECK(dar_config_open(&n->c, "models/presets/dar-test.json", &e) == DAR_OK, "%s", e.text);
    CHECK(dar_arena_init(&n->weights, "weights", 64 << 20, &e) == DAR_OK, "%s", e.text);
    CHECK(dar_arena_init(&n->step, "step", 256 << 20, &e) == DAR_OK, "%s", e.text);
    CHECK(dar_arena_init(&n->cache, "cache", 64 << 20, &e) == DAR_OK, "%s", e.text);
    CHECK(dar_tape_init(&n->tape, &n->step, &e) == DAR_OK, "%s", e.text);
    dar_params_init(&n->p, &n->weights, storage);
    dar_vae_init(&n->v, &n->p, &n->c.vae);
    if (train) dar_params_train(&n->p, DAR_PARAM_ALL);

    dar_weights *w = fixture_open("vae_weights.safetensors");
    assert_int_equal(dar_weights_count(w), n->p.count);
    for (size_t i = 0; i < n->p.count; i++) {
        dar_param *q = n->p.at[i];
        dar_tensor x = fixture_tensor(w, q->name);
        dar_param_push(&n->p, q);
        dar_tensor_copy(&q->x, &x);
    }
    dar_weights_close(w);
    dar_params_gradients(&n->p);
}

static void net_free(net *n)
{
    dar_params_free(&n->p);
    dar_tape_free(&n->tape);
    dar_arena_free(&n->weights);
    dar_arena_free(&n->step);
    dar_arena_free(&n->cache);
}

/* ---------------------------------------------------------------- against the reference */

static void parity(void **state)
{
    (void)state;
    static const struct {
        dar_dtype type;
        double bound;
    } runs[] = { { DAR_F64, 1e-10 }, { DAR_F32, 2e-5 }, { DAR_BF16, 6e-2 } };
    dar_weights *s = fixture_open("vae_stages.safetensors");
    dar_tensor x = fixture_tensor(s, "x"), moments = fixture_tensor(s, "moments"), z = fixture_tensor(s, "z"),
               pixels = fixture_tensor(s, "pixels");
    for (size_t i = 0; i < DAR_COUNT(runs); i++) {
        net n;
        net_init(&n, runs[i].type, false);
        n.tape.recording = false;
        dar_val *m = dar_vae_encode(&n.tape, &n.v, fixture_input(&n.tape, n.p.main, &x));
        dar_val *latent = dar_vae_normalise(&n.tape, &n.v, dar_vae_mean(&n.tape, &n.v, m));
        dar_val *y = dar_vae_decode(&n.tape, &n.v, fixture_input(&n.tape, n.p.main, &z));
        dar_vae_fold(&n.v, &n.weights);
        dar_val *folded = dar_vae_decode(&n.tape, &n.v, fixture_input(&n.tape, n.p.main, &z));
        double d[] = { test_relative(&m->x, &moments), test_relative(&latent->x, &z), test_relative(&y->x, &pixels),
                       test_relative(&folded->x, &pixels) };
        printf("%s: moments %.1e, latent %.1e, pixels %.1e, folded %.1e\n", dar_dtype_name(runs[i].type), d[0], d[1],
               d[2], d[3]);
        for (int k = 0; k < 4; k++) CHECK_NEAR(dar_dtype_name(runs[i].type), d[k], 0, runs[i].bound);
        net_free(&n);
    }
    dar_weights_close(s);
}

static dar_val *round_trip(net *n, dar_val *x)
{
    dar_tape *t = &n->tape;
    dar_val *z = dar_vae_normalise(t, &n->v, dar_vae_mean(t, &n->v, dar_vae_encode(t, &n->v, x)));
    return dar_squared_error(t, dar_vae_decode(t, &n->v, z), x, NULL, true);
}

static void gradients(void **state)
{
    (void)state;
    static const struct {
        dar_dtype type;
        double bound;
    } runs[] = { { DAR_F64, 1e-9 }, { DAR_F32, 1e-4 } };
    dar_weights *s = fixture_open("vae_stages.safetensors");
    dar_tensor x = fixture_tensor(s, "x"), loss = fixture_tensor(s, "loss");
    for (size_t i = 0; i < DAR_COUNT(runs); i++) {
        net n;
        net_init(&n, runs[i].type, true);
        dar_val *found = round_trip(&n, fixture_input(&n.tape, n.p.main, &x));
        CHECK_NEAR("loss", dar_dtype_get(n.p.main, found->x.data, 0), *(const double *)loss.data, runs[i].bound);
        dar_backward(&n.tape, found, NULL);
        double worst = 0;
        for (size_t k = 0; k < n.p.count; k++) {
            char name[128];
            snprintf(name, sizeof name, "grad.%s", n.p.at[k]->name);
            dar_tensor g = fixture_tensor(s, name);
            double d = test_relative(&n.p.at[k]->g, &g);
            CHECK(d <= runs[i].bound, "%s: %.2e", name, d);
            worst = fmax(worst, d);
        }
        printf("%s: worst gradient %.1e of %zu\n", dar_dtype_name(runs[i].type), worst, n.p.count);
        net_free(&n);
    }
    dar_weights_close(s);
}

/* ---------------------------------------------------------------- in pieces */

typedef struct frames {
    const dar_tensor *whole; /* [1, 3, F, H, W] */
    int64_t next;
} frames;

/* The frame is that of the whole clip, bit for bit but for the clamp. */
static dar_status compare(void *ctx, const dar_tensor *frame, int64_t index, dar_err *e)
{
    frames *f = ctx;
    (void)e;
    assert_int_equal(index, f->next++);
    size_t pixels = (size_t)(frame->shape.d[3] * frame->shape.d[4]), F = (size_t)f->whole->shape.d[2];
    for (size_t c = 0; c < 3; c++)
        for (size_t i = 0; i < pixels; i++) {
            double y = dar_dtype_get(f->whole->dtype, f->whole->data, (c * F + (size_t)index) * pixels + i);
            CHECK_NEAR("frame", dar_dtype_get(frame->dtype, frame->data, c * pixels + i), fmax(-1, fmin(1, y)), 0);
        }
    return DAR_OK;
}

static void decoding_in_pieces(void **state)
{
    (void)state;
    dar_weights *s = fixture_open("vae_stages.safetensors");
    dar_tensor z = fixture_tensor(s, "z");
    for (int type = DAR_F64; type <= DAR_BF16; type++) {
        net n;
        net_init(&n, (dar_dtype)type, false);
        dar_vae_fold(&n.v, &n.weights);
        n.tape.recording = false;
        dar_val *whole = dar_vae_decode(&n.tape, &n.v, fixture_input(&n.tape, n.p.main, &z));
        frames f = { .whole = &whole->x };
        dar_vae_stream stream;
        dar_vae_stream_init(&stream, &n.v, DAR_VAE_DECODER, &n.cache);
        for (int64_t k = 0; k < z.shape.d[2]; k++) {
            dar_tensor piece = dar_tensor_narrow(&z, 2, k, 1);
            size_t used = n.step.used;
            dar_val *in = fixture_input(&n.tape, n.p.main, &piece);
            size_t with = n.step.used;
            assert_int_equal(dar_vae_decode_next(&stream, &n.tape, in, compare, &f, NULL), DAR_OK);
            assert_int_equal(n.step.used, with);
            dar_arena_reset(&n.step, used);
        }
        assert_int_equal(f.next, 9);
        net_free(&n);
    }
    dar_weights_close(s);
}

/* Encode a clip of F frames in pieces; every latent frame has the bits of the whole.  Returns the parts skipped. */
static int64_t encode_in_pieces(net *n, const dar_tensor *x, bool skip)
{
    dar_val *whole = dar_vae_encode(&n->tape, &n->v, fixture_input(&n->tape, n->p.main, x));
    dar_vae_stream s;
    dar_mark cache = dar_arena_mark(&n->cache);
    dar_vae_stream_init(&s, &n->v, DAR_VAE_ENCODER, &n->cache);
    s.skip = skip;
    int64_t step = dar_vae_shrink_time(&n->c.vae), at = 0;
    for (int64_t k = 0; k < whole->x.shape.d[2]; k++) {
        int64_t count = k ? step : 1;
        dar_tensor piece = dar_tensor_narrow(x, 2, at, count), expected = dar_tensor_narrow(&whole->x, 2, k, 1);
        dar_mark m = dar_arena_mark(&n->step);
        dar_val *in = fixture_input(&n->tape, n->p.main, &piece), *y = dar_vae_encode_next(&s, &n->tape, in);
        dar_tensor same = dar_tensor_push(&n->step, expected.dtype, expected.shape);
        dar_tensor_copy(&same, &expected);
        assert_memory_equal(y->x.data, same.data, dar_tensor_bytes(&same));
        dar_arena_reset(&n->step, m);
        at += count;
    }
    dar_arena_reset(&n->cache, cache);
    return s.skipped;
}

static void encoding_in_pieces(void **state)
{
    (void)state;
    for (int type = DAR_F64; type <= DAR_BF16; type++) {
        net n;
        net_init(&n, (dar_dtype)type, false);
        n.tape.recording = false;
        /* A reference picture, then nothing for a while, something, nothing: what must not be skipped is not. */
        dar_tensor x = dar_tensor_push(&n.weights, n.p.main, DAR_SHAPE(1, 3, 77, 32, 16));
        dar_rng_fill_uniform(&x, 1, 2, -1, 1);
        int64_t moving = encode_in_pieces(&n, &x, true);
        assert_int_equal(moving, 0);
        for (int k = 0; k < 2; k++) {
            dar_tensor still = dar_tensor_narrow(&x, 2, k ? 45 : 1, k ? 32 : 43);
            dar_tensor_fill(&still, 0);
        }
        int64_t skipped = encode_in_pieces(&n, &x, true);
        printf("%s: %lld of %d parts skipped\n", dar_dtype_name((dar_dtype)type), (long long)skipped, 5 * 20);
        CHECK(skipped >= 20, "%lld parts skipped", (long long)skipped);
        assert_int_equal(encode_in_pieces(&n, &x, false), 0);
        net_free(&n);
    }
}

/* Latent frame k depends on frames up to 4 k alone. */
static void causality(void **state)
{
    (void)state;
    net n;
    net_init(&n, DAR_F32, false);
    n.tape.recording = false;
    dar_tensor x = dar_tensor_push(&n.weights, DAR_F32, DAR_SHAPE(1, 3, 9, 16, 16));
    dar_rng_fill_uniform(&x, 1, 2, -1, 1);
    dar_val *before = dar_vae_encode(&n.tape, &n.v, fixture_input(&n.tape, n.p.main, &x));
    dar_tensor frame = dar_tensor_narrow(&x, 2, 5, 1);
    dar_tensor_fill(&frame, 0.5);
    dar_val *after = dar_vae_encode(&n.tape, &n.v, fixture_input(&n.tape, n.p.main, &x));
    const float *a = before->x.data, *b = after->x.data;
    int64_t C = before->x.shape.d[1];
    for (int64_t c = 0; c < C; c++) {
        for (int k = 0; k < 2; k++) CHECK_NEAR("earlier latent", b[3 * c + k], a[3 * c + k], 0);
        CHECK(b[3 * c + 2] != a[3 * c + 2], "channel %lld of the last latent frame did not see frame 5", (long long)c);
    }
    net_free(&n);
}

static void same_bits(void **state)
{
    (void)state;
    dar_weights *s = fixture_open("vae_stages.safetensors");
    dar_tensor z = fixture_tensor(s, "z");
    int before = dar_threads();
    static const int threads[] = { 1, 2, 3, 7 };
    unsigned char *kept = NULL;
    for (int i = 0; i < 4; i++) {
        net n;
        dar_threads_set(threads[i]);
        net_init(&n, DAR_F32, false);
        n.tape.recording = false;
        dar_val *y = dar_vae_decode(&n.tape, &n.v, fixture_input(&n.tape, n.p.main, &z));
        size_t bytes = dar_tensor_bytes(&y->x);
        if (!kept) memcpy(kept = malloc(bytes), y->x.data, bytes);
        else assert_memory_equal(kept, y->x.data, bytes);
        net_free(&n);
    }
    free(kept);
    dar_threads_set(before);
    dar_weights_close(s);
}

/* ---------------------------------------------------------------- in tiles */

static void tile_weights(void **state)
{
    (void)state;
    static const struct {
        dar_tiling o;
        int64_t n, count, length;
    } runs[] = {
        { { 8, 0 }, 24, 3, 8 }, { { 8, 3 }, 24, 5, 8 },    { { 8, 7 }, 11, 4, 8 },   { { 8, 2 }, 8, 1, 8 },
        { { 8, 2 }, 5, 1, 5 },  { { 34, 16 }, 52, 2, 34 }, { { 26, 6 }, 52, 3, 22 }, { { 26, 6 }, 30, 2, 18 }
    };
    for (size_t r = 0; r < DAR_COUNT(runs); r++) {
        const dar_tiling *o = &runs[r].o;
        int64_t n = runs[r].n, count = dar_tiles_count(o, n), length = dar_tiles_length(o, n), scale = 3;
        double sum[256] = { 0 };
        assert_int_equal(count, runs[r].count);
        assert_int_equal(length, runs[r].length);
        assert_int_equal(dar_tiles_start(o, n, 0), 0);
        assert_int_equal(dar_tiles_start(o, n, count - 1), n - length);
        for (int64_t i = 0; i < count; i++) {
            int64_t start = dar_tiles_start(o, n, i);
            if (i) assert_true(start - dar_tiles_start(o, n, i - 1) <= length - o->overlap);
            for (int64_t x = 0; x < scale * length; x++) {
                double w = dar_tiles_weight(o, n, i, scale, x);
                CHECK(w > 0 && w <= 1, "weight %g", w);
                sum[scale * start + x] += w;
            }
        }
        for (int64_t x = 0; x < scale * n; x++) CHECK_NEAR("sum of weights", sum[x], 1, 1e-14);
    }
}

/* Root of the mean square of the change, over that of the whole. */
static double change(const dar_tensor *whole, const dar_tensor *tiled)
{
    double off = 0, all = 0;
    for (size_t i = 0; i < dar_tensor_count(whole); i++) {
        double x = dar_dtype_get(whole->dtype, whole->data, i), y = dar_dtype_get(tiled->dtype, tiled->data, i);
        off += (x - y) * (x - y);
        all += x * x;
    }
    return sqrt(off / all);
}

/* A clip of 5 frames, 4 x 40 latent pixels: its moments, and pixels of a latent, in tiles or (o NULL) whole. */
static void run_tiles(net *n, const dar_tiling *o, dar_tensor *moments, dar_tensor *pixels)
{
    dar_tensor x = dar_tensor_push(&n->weights, n->p.main, DAR_SHAPE(1, 3, 5, 64, 640));
    dar_tensor z = dar_tensor_push(&n->weights, n->p.main, DAR_SHAPE(1, 5, 2, 4, 40));
    dar_rng_fill_uniform(&x, 1, 2, -1, 1);
    dar_rng_fill_normal(&z, 3, 4, 1);
    *pixels = dar_tensor_push(&n->weights, x.dtype, x.shape);
    *moments = dar_tensor_push(&n->weights, z.dtype, DAR_SHAPE(1, 10, 2, 4, 40));
    if (o) {
        dar_tiles_encode(&n->tape, &n->v, o, &x, moments, &n->cache);
        dar_tiles_decode(&n->tape, &n->v, o, &z, pixels, &n->cache);
        assert_int_equal(n->step.used + n->cache.used + n->tape.meta.used, 0);
    } else {
        dar_tensor_copy(moments, &dar_vae_encode(&n->tape, &n->v, fixture_input(&n->tape, n->p.main, &x))->x);
        dar_tensor_copy(pixels, &dar_vae_decode(&n->tape, &n->v, fixture_input(&n->tape, n->p.main, &z))->x);
        dar_vae_clamp(pixels);
        dar_tape_clear(&n->tape);
        dar_arena_reset(&n->step, 0);
    }
}

/* One tile changes nothing.  Of several, the change shrinks as they overlap more; that of decoded pixels goes on being
 * large with the attention, which sees its tile alone. */
static void tiles_of_a_picture(void **state)
{
    (void)state;
    static const dar_tiling o[] = { { 40, 0 }, { 20, 0 }, { 20, 10 }, { 20, 15 } };
    double d[2][DAR_COUNT(o)][2];
    for (int blind = 0; blind < 2; blind++) {
        net n;
        dar_tensor whole[2], tiled[2];
        net_init(&n, DAR_F32, false);
        n.tape.recording = false;
        if (blind) dar_tensor_fill(&n.v.encoder.proj.w->x, 0);
        if (blind) dar_tensor_fill(&n.v.decoder.proj.w->x, 0);
        run_tiles(&n, NULL, &whole[0], &whole[1]);
        for (size_t i = 0; i < DAR_COUNT(o); i++) {
            run_tiles(&n, &o[i], &tiled[0], &tiled[1]);
            for (int k = 0; k < 2; k++) d[blind][i][k] = change(&whole[k], &tiled[k]);
            printf("tiles of %lld, overlap %2lld%s: moments change by %.1e, pixels by %.1e\n", (long long)o[i].size,
                   (long long)o[i].overlap, blind ? ", no attention" : "", d[blind][i][0], d[blind][i][1]);
        }
        for (int k = 0; k < 2; k++) {
            CHECK_NEAR("one tile", d[blind][0][k], 0, 0);
            CHECK(d[blind][2][k] < 0.5 * d[blind][1][k], "overlap 10: change of %d by %.1e", k, d[blind][2][k]);
            CHECK(d[blind][3][k] < d[blind][2][k], "overlap 15: change of %d by %.1e", k, d[blind][3][k]);
        }
        net_free(&n);
    }
    CHECK(d[1][3][1] < 0.5 * d[0][3][1], "pixels change by %.1e without attention", d[1][3][1]);
}

/* ---------------------------------------------------------------- the real sizes */

/* The public network, with its weights, on arenas that only count. */
static void plan_init(net *n, dar_dtype storage)
{
    dar_err e;
    memset(n, 0, sizeof *n);
    CHECK(dar_config_open(&n->c, "models/presets/wan22-fun-5b.json", &e) == DAR_OK, "%s", e.text);
    assert_int_equal(dar_arena_init_plan(&n->weights, "weights", &e), DAR_OK);
    assert_int_equal(dar_arena_init_plan(&n->step, "step", &e), DAR_OK);
    assert_int_equal(dar_arena_init_plan(&n->cache, "cache", &e), DAR_OK);
    assert_int_equal(dar_tape_init(&n->tape, &n->step, &e), DAR_OK);
    n->tape.recording = false;
    dar_params_init(&n->p, &n->weights, storage);
    dar_vae_init(&n->v, &n->p, &n->c.vae);
    dar_params_fresh(&n->p, DAR_PARAM_ALL, 0);
}

/* Work of a clip: 597 and 113.5 TFLOP at 480 x 832 x 81. */
static void real_sizes(void **state)
{
    (void)state;
    net n;
    plan_init(&n, DAR_F32);
    assert_int_equal(dar_vae_shrink(&n.c.vae), 16);
    assert_int_equal(dar_vae_shrink_time(&n.c.vae), 4);
    assert_int_equal(n.p.count, 196);
    assert_int_equal(dar_params_count(&n.p, DAR_PARAM_ALL), 704688668);

    dar_vae_decode(&n.tape, &n.v, dar_input(&n.tape, DAR_F32, DAR_SHAPE(1, 48, 21, 30, 52)));
    CHECK_NEAR("decoder [TFLOP]", n.tape.cost.forward / 1e12, 597, 6);
    dar_tape_clear(&n.tape);
    dar_vae_encode(&n.tape, &n.v, dar_input(&n.tape, DAR_F32, DAR_SHAPE(1, 3, 81, 480, 832)));
    CHECK_NEAR("encoder [TFLOP]", n.tape.cost.forward / 1e12, 113.5, 1.5);
    net_free(&n);
}

/* Peak of 9 frames of 480 x 832: weights, what is kept, a step. */
static void plan_pieces(net *n, dar_vae_side side, const dar_tiling *o, double gb[3])
{
    dar_tensor x = dar_tensor_push(&n->step, DAR_F32, DAR_SHAPE(1, 3, 9, 480, 832));
    dar_tensor z = dar_tensor_push(&n->step, DAR_F32, DAR_SHAPE(1, side == DAR_VAE_ENCODER ? 96 : 48, 3, 30, 52));
    if (side == DAR_VAE_DECODER) dar_vae_fold(&n->v, &n->weights);
    if (side == DAR_VAE_ENCODER) dar_tiles_encode(&n->tape, &n->v, o, &x, &z, &n->cache);
    else dar_tiles_decode(&n->tape, &n->v, o, &z, &x, &n->cache);
    gb[0] = 1e-9 * (double)n->weights.peak;
    gb[1] = 1e-9 * (double)n->cache.peak;
    gb[2] = 1e-9 * (double)n->step.peak;
}

static void planned_memory(void **state)
{
    (void)state;
    static const char *const sides[] = { "encoding", "decoding" };
    static const dar_dtype types[] = { DAR_F32, DAR_BF16 };
    static const dar_tiling tilings[] = { { 52, 0 }, { 26, 6 } };
    for (size_t i = 0; i < DAR_COUNT(types); i++)
        for (int side = DAR_VAE_ENCODER; side <= DAR_VAE_DECODER; side++)
            for (size_t k = 0; k < DAR_COUNT(tilings); k++) {
                net n;
                double gb[3];
                plan_init(&n, types[i]);
                plan_pieces(&n, (dar_vae_side)side, &tilings[k], gb);
                printf("%s 9 frames of 480 x 832 in %s, tiles of %lld: weights %.2f, kept %.2f, step %.2f GB\n",
                       sides[side], dar_dtype_name(types[i]), (long long)tilings[k].size, gb[0], gb[1], gb[2]);
                CHECK(gb[0] + gb[1] + gb[2] < 8.5, "%.1f GB", gb[0] + gb[1] + gb[2]);
                net_free(&n);
            }
}

int main(void)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(parity),
        cmocka_unit_test(gradients),
        cmocka_unit_test(decoding_in_pieces),
        cmocka_unit_test(encoding_in_pieces),
        cmocka_unit_test(causality),
        cmocka_unit_test(same_bits),
        cmocka_unit_test(tile_weights),
        cmocka_unit_test(tiles_of_a_picture),
        cmocka_unit_test(real_sizes),
        cmocka_unit_test(planned_memory),
    };
    return cmocka_run_group_tests_name("vae", tests, NULL, NULL) != 0;
}
