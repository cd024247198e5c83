/* test_vae_step.c: training the autoencoder: its gradients against differences, its linear maps, one clip learned by
 * heart. */
#include "tests/test.h"

#include "lib/rng.h"
#include "models/vae_start.h"
#include "train/optim.h"
#include "train/vae_step.h"

typedef struct net {
    dar_vae_config c;
    dar_arena weights;
    dar_params p;
    dar_vae v;
    dar_tensor x; /* pixels of a batch */
    dar_vae_step s;
} net;

static const dar_vae_loss everything = { .round = 0.1, .edge = 0.5, .kl = 0.3, .noise = 0.05, .seed = 5, .parts = 1 };

/* Two levels: a latent number for 2 x 2 x 2 of three colours. */
static void net_init(net *n, dar_dtype storage, int64_t latent, const dar_vae_loss *c, dar_shape pixels)
{
    dar_err e;
    *n = (net){ .c = { .levels = 2,
                       .latent = latent,
                       .patch = 1,
                       .multipliers = { 1, 1 },
                       .halve_time = { true },
                       .linear = true,
                       .encoder_width = 3,
                       .decoder_width = 4,
                       .encoder_blocks = 1,
                       .decoder_blocks = 1 } };
    for (int i = 0; i < latent; i++) n->c.mean[i] = 0.1 * i, n->c.std[i] = 1 + 0.2 * i;
    CHECK(dar_arena_init(&n->weights, "weights", 4 << 20, &e) == DAR_OK, "%s", e.text);
    dar_params_init(&n->p, &n->weights, storage);
    dar_vae_init(&n->v, &n->p, &n->c);
    dar_params_train(&n->p, DAR_PARAM_ALL);
    dar_params_fresh(&n->p, DAR_PARAM_ALL, 3);
    dar_params_gradients(&n->p);
    n->x = dar_tensor_push(&n->weights, n->p.main, pixels);
    dar_rng_fill_uniform(&n->x, 4, 4, -1, 1);
    CHECK(dar_vae_step_init(&n->s, &n->v, c, pixels, false, &e) == DAR_OK, "%s", e.text);
}

static void net_free(net *n)
{
    dar_vae_step_free(&n->s);
    dar_params_free(&n->p);
    dar_arena_free(&n->weights);
}

static void zero_gradients(net *n)
{
    for (size_t i = 0; i < n->p.count; i++) dar_tensor_fill(&n->p.at[i]->g, 0);
}

/* ---------------------------------------------------------------- gradients */

/* x += h u, u the direction of parameter i. */
static void move(const net *n, size_t i, double h)
{
    const dar_tensor *x = &n->p.at[i]->x;
    size_t count = dar_tensor_count(x);
    for (size_t k = 0; k < count; k++) ((double *)x->data)[k] += h * dar_rng_normal(9, i, k) / sqrt((double)count);
}

/* Along a random direction of every parameter: fourth-order differences of the loss with h = 2e-5 leave h^4 of its
 * fifth derivative and 1e-11 of rounding. */
static void test_gradient(void **state)
{
    static const double weight[] = { 8.0 / 12, -1.0 / 12 };
    static double found[256];
    const double h = 2e-5;
    net n;
    (void)state;
    net_init(&n, DAR_F64, 5, &everything, DAR_SHAPE(2, 3, 3, 6, 4));
    assert_true(n.p.count <= DAR_COUNT(found));
    zero_gradients(&n);
    dar_vae_step_run(&n.s, &n.x, 7, 0);
    for (size_t i = 0; i < n.p.count; i++) {
        const dar_tensor *g = &n.p.at[i]->g;
        size_t count = dar_tensor_count(g);
        for (size_t k = 0; k < count; k++)
            found[i] += dar_rng_normal(9, i, k) / sqrt((double)count) * ((double *)g->data)[k];
    }
    for (size_t i = 0; i < n.p.count; i++) {
        double expected = 0;
        for (int k = 1; k <= 2; k++)
            for (int side = -1; side <= 1; side += 2) {
                move(&n, i, side * k * h);
                expected += side * weight[k - 1] / h * dar_vae_step_run(&n.s, &n.x, 7, 0).loss;
                move(&n, i, -side * k * h);
            }
        CHECK_NEAR(n.p.at[i]->name, found[i], expected, 1e-9);
    }
    net_free(&n);
}

/* Keeping everything changes the work, and no bit; nor does the number of threads. */
static void test_same_bits(void **state)
{
    net a, b;
    (void)state;
    for (int type = DAR_F64; type <= DAR_BF16; type++) {
        net_init(&a, (dar_dtype)type, 5, &everything, DAR_SHAPE(2, 3, 5, 6, 4));
        net_init(&b, (dar_dtype)type, 5, &everything, DAR_SHAPE(2, 3, 5, 6, 4));
        b.v.whole = true;
        dar_threads_set(1);
        dar_vae_report x = dar_vae_step_run(&a.s, &a.x, 3, 0);
        dar_threads_set(3);
        dar_vae_report y = dar_vae_step_run(&b.s, &b.x, 3, 0);
        assert_memory_equal(&x, &y, sizeof x);
        assert_true(isfinite(x.loss) && x.loss > 0);
        for (size_t i = 0; i < a.p.count; i++)
            assert_memory_equal(a.p.at[i]->g.data, b.p.at[i]->g.data, dar_tensor_bytes(&a.p.at[i]->g));
        CHECK(dar_vae_step_run(&b.s, &b.x, 4, 0).loss != x.loss, "another step draws the same noise");
        net_free(&a);
        net_free(&b);
    }
}

/* Two batches of a step: the mean of their gradients. */
static void test_parts(void **state)
{
    dar_vae_loss half = everything;
    net whole, parts;
    (void)state;
    half.parts = 2;
    net_init(&whole, DAR_F64, 5, &everything, DAR_SHAPE(2, 3, 3, 6, 4));
    net_init(&parts, DAR_F64, 5, &half, DAR_SHAPE(1, 3, 3, 6, 4));
    dar_vae_step_run(&whole.s, &whole.x, 2, 0);
    for (int64_t k = 0; k < 2; k++) {
        dar_tensor clip = dar_tensor_narrow(&whole.x, 0, k, 1);
        dar_vae_step_run(&parts.s, &clip, 2, k);
    }
    for (size_t i = 0; i < whole.p.count; i++) {
        const dar_tensor *x = &whole.p.at[i]->g, *y = &parts.p.at[i]->g;
        for (size_t k = 0; k < dar_tensor_count(x); k++)
            CHECK_NEAR(whole.p.at[i]->name, ((double *)y->data)[k], ((double *)x->data)[k], 1e-13);
    }
    net_free(&whole);
    net_free(&parts);
}

/* ---------------------------------------------------------------- the linear maps */

/* From the components of x, or from the cosine transform. */
static void start(net *n, const dar_tensor *x, double spread)
{
    dar_vae_blocks b;
    dar_err e;
    CHECK(dar_vae_blocks_init(&b, &n->v, 6, 4, &e) == DAR_OK, "%s", e.text);
    if (x) dar_vae_blocks_add(&b, x);
    dar_vae_start(&b, spread);
    dar_vae_blocks_free(&b);
}

/* Clips whose blocks are mixtures of three, all still: three components give them back, where three waves lose most,
 * and the latents' mean square is 1. */
static void test_start_finds_components(void **state)
{
    const dar_vae_loss plain = { .parts = 1 };
    dar_vae_sums sums = { 0 };
    double mean[3], std[3];
    net n;
    (void)state;
    net_init(&n, DAR_F64, 3, &plain, DAR_SHAPE(2, 3, 5, 6, 4));
    for (uint64_t i = 0; i < dar_tensor_count(&n.x); i++) {
        uint64_t x = i % 4, y = i / 4 % 6, f = i / 24 % 5, c = i / 120 % 3, clip = i / 360;
        uint64_t block = ((clip * 3 + (f + 1) / 2) * 3 + y / 2) * 2 + x / 2, place = (c * 2 + y % 2) * 2 + x % 2;
        double sum = 0;
        for (uint64_t k = 0; k < 3; k++) sum += dar_rng_normal(4, block, k) * dar_rng_normal(3, k, place) / (1 + k);
        ((double *)n.x.data)[i] = sum / 16;
    }
    start(&n, NULL, 0);
    double waves = dar_vae_step_look(&n.s, &n.x, NULL).square;
    start(&n, &n.x, 0);
    CHECK(waves > 1e-3, "three waves leave %g", waves);
    CHECK_NEAR("what three components leave", dar_vae_step_look(&n.s, &n.x, &sums).square, 0, 1e-20);
    dar_vae_standard(&sums, 3, mean, std);
    for (int k = 0; k < 3; k++) CHECK_NEAR("mean square of a latent", mean[k] * mean[k] + std[k] * std[k], 1, 1e-12);

    sums = (dar_vae_sums){ 0 };
    start(&n, &n.x, 1);
    CHECK_NEAR("with their spread", dar_vae_step_look(&n.s, &n.x, &sums).square, 0, 1e-20);
    double all = (sums.square[0] + sums.square[1] + sums.square[2]) / (3 * sums.n);
    CHECK_NEAR("mean square of all latents", all, 1, 1e-12);
    CHECK(sums.square[0] > 1.5 * sums.square[1] && sums.square[1] > 1.5 * sums.square[2], "squares %g, %g, %g",
          sums.square[0], sums.square[1], sums.square[2]);
    net_free(&n);
}

/* With as many latent numbers as pixels the waves are all there, and the maps are each other's inverse: the
 * posterior's mean is the clip. */
static void test_start_is_a_transform(void **state)
{
    const dar_vae_loss plain = { .parts = 1 };
    net n;
    (void)state;
    net_init(&n, DAR_F64, 24, &plain, DAR_SHAPE(2, 3, 5, 6, 4));
    start(&n, NULL, 0);
    dar_rng_fill_uniform(&n.x, 4, 4, -1, 1);
    dar_vae_report r = dar_vae_step_look(&n.s, &n.x, NULL);
    CHECK_NEAR("mean squared distance of a full transform", r.square, 0, 1e-28);
    net_free(&n);
}

/* Of fewer waves, the cheapest: grey pixels come back, and noise loses what was left out. */
static void test_start_keeps_what_is_smooth(void **state)
{
    const dar_vae_loss plain = { .parts = 1 };
    net n;
    (void)state;
    net_init(&n, DAR_F64, 3, &plain, DAR_SHAPE(1, 3, 3, 6, 4));
    start(&n, NULL, 0);
    CHECK(dar_vae_step_look(&n.s, &n.x, NULL).square > 0.1, "three of 24 waves hold noise");
    dar_tensor_fill(&n.x, 0.7);
    CHECK_NEAR("grey", dar_vae_step_look(&n.s, &n.x, NULL).square, 0, 1e-28);
    net_free(&n);
}

static dar_status keep_frame(void *ctx, const dar_tensor *frame, int64_t index, dar_err *e)
{
    dar_tensor to = dar_tensor_narrow(ctx, 2, index, 1);
    (void)e;
    dar_tensor_copy(&to, frame);
    return DAR_OK;
}

/* A piece at a time gives the bits of the whole clip. */
static void test_streams(void **state)
{
    enum { F = 4, T = 2 * F - 1 };
    const dar_vae_loss plain = { .parts = 1 };
    net n;
    (void)state;
    for (int type = DAR_F64; type <= DAR_BF16; type++) {
        dar_arena kept;
        dar_err e;
        net_init(&n, (dar_dtype)type, 5, &plain, DAR_SHAPE(1, 3, T, 6, 4));
        dar_tape *t = &n.s.tape;
        assert_int_equal(dar_arena_init(&kept, "kept", 16 << 20, &e), DAR_OK);
        t->recording = false;
        dar_vae_stream in, out;
        dar_vae_stream_init(&in, &n.v, DAR_VAE_ENCODER, &kept);
        dar_vae_stream_init(&out, &n.v, DAR_VAE_DECODER, &kept);
        dar_tensor moments = dar_tensor_push(&kept, n.p.main, DAR_SHAPE(1, 10, F, 3, 2));
        dar_tensor frames = dar_tensor_push(&kept, n.p.main, n.x.shape);
        for (int64_t f = 0; f < F; f++) {
            dar_tensor x = dar_tensor_narrow(&n.x, 2, f ? 2 * f - 1 : 0, f ? 2 : 1), to;
            dar_val *y = dar_vae_encode_next(&in, t, dar_contiguous(t, dar_leaf(t, x, NULL)));
            to = dar_tensor_narrow(&moments, 2, f, 1);
            dar_tensor_copy(&to, &y->x);
            y = dar_vae_normalise(t, &n.v, dar_contiguous(t, dar_vae_mean(t, &n.v, y)));
            assert_int_equal(dar_vae_decode_next(&out, t, y, keep_frame, &frames, &e), DAR_OK);
        }
        dar_val *y = dar_vae_encode(t, &n.v, dar_leaf(t, n.x, NULL));
        assert_memory_equal(y->x.data, moments.data, dar_tensor_bytes(&moments));
        y = dar_vae_decode(t, &n.v, dar_vae_normalise(t, &n.v, dar_contiguous(t, dar_vae_mean(t, &n.v, y))));
        dar_vae_clamp(&y->x);
        assert_memory_equal(y->x.data, frames.data, dar_tensor_bytes(&frames));
        dar_arena_free(&kept);
        net_free(&n);
    }
}

/* ---------------------------------------------------------------- learning */

/* One clip of noise, 24 numbers for 5: half of the squared distance that the best five waves leave is gone. */
static void test_overfits(void **state)
{
    const dar_vae_loss c = { .round = 0.05, .kl = 1e-4, .parts = 1 };
    dar_optim_config o = { .rate = 4e-3, .beta1 = 0.9, .beta2 = 0.99, .eps = 1e-8, .max_norm = 1, .warmup = 10 };
    dar_optim optim;
    net n;
    (void)state;
    net_init(&n, DAR_F32, 5, &c, DAR_SHAPE(1, 3, 3, 6, 4));
    start(&n, NULL, 0);
    dar_optim_init(&optim, &o, &n.p, &n.weights);
    double first = dar_vae_step_look(&n.s, &n.x, NULL).square;
    for (int64_t k = 0; k < 300; k++) {
        optim.schedule = fmin(1, (300 - (double)k) / 150);
        dar_vae_step_run(&n.s, &n.x, k, 0);
        CHECK(!dar_optim_step(&optim).skipped, "step %d is not finite", (int)k);
    }
    double last = dar_vae_step_look(&n.s, &n.x, NULL).square;
    CHECK(last < first / 2, "squared distance: %g at first, %g at last", first, last);
    net_free(&n);
}

/* Latents normalised by what was measured have mean 0 and deviation 1; their divergence is that of the formula. */
static void test_standard(void **state)
{
    const dar_vae_loss plain = { .parts = 1 };
    dar_vae_sums sums = { 0 }, again = { 0 };
    double mean[5], std[5];
    net n;
    (void)state;
    net_init(&n, DAR_F64, 5, &plain, DAR_SHAPE(2, 3, 5, 6, 4));
    dar_vae_report r = dar_vae_step_look(&n.s, &n.x, &sums);
    assert_true(sums.n == 2 * 3 * 3 * 2);
    dar_vae_standard(&sums, 5, mean, std);
    dar_val *moments = dar_vae_encode(&n.s.tape, &n.v, dar_leaf(&n.s.tape, n.x, NULL));
    dar_val *z = dar_contiguous(&n.s.tape, dar_vae_mean(&n.s.tape, &n.v, moments));
    dar_val *log_variance = dar_contiguous(&n.s.tape, dar_vae_log_variance(&n.s.tape, &n.v, moments));
    double kl = 0;
    for (size_t i = 0; i < dar_tensor_count(&z->x); i++) {
        size_t k = i / 18 % 5;
        double m = ((double *)z->x.data)[i], v = ((double *)log_variance->x.data)[i], x = (m - mean[k]) / std[k];
        kl += (m * m + exp(v) - 1 - v) / 2 / 180;
        again.sum[k] += x / 36;
        again.square[k] += x * x / 36;
    }
    CHECK_NEAR("divergence", r.kl, kl, 1e-13);
    for (int k = 0; k < 5; k++) {
        CHECK_NEAR("mean", again.sum[k], 0, 1e-12);
        CHECK_NEAR("square", again.square[k], 1, 1e-12);
    }
    net_free(&n);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_gradient),
        cmocka_unit_test(test_same_bits),
        cmocka_unit_test(test_parts),
        cmocka_unit_test(test_start_is_a_transform),
        cmocka_unit_test(test_start_finds_components),
        cmocka_unit_test(test_start_keeps_what_is_smooth),
        cmocka_unit_test(test_streams),
        cmocka_unit_test(test_overfits),
        cmocka_unit_test(test_standard),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
