/* test_scene.c: what the transformer is given (scene, text, times, known video) and what it costs: folding, orders of
 * numbers, polarity, batches, memory, sizes of the public model. */
#include "tests/test.h"

#include "autograd/ops.h"
#include "lib/rng.h"
#include "models/patch.h"
#include "tests/distance.h"
#include "tests/model.h"

static double at(const dar_tensor *x, size_t i)
{
    return dar_dtype_get(x->dtype, x->data, i);
}

static dar_tensor copy(dar_arena *a, const dar_tensor *x)
{
    dar_tensor y = dar_tensor_push(a, x->dtype, x->shape);
    dar_tensor_copy(&y, x);
    return y;
}

/* dar-test with random weights, none of them zero; sampling. */
static void init(model *o, dar_dtype storage)
{
    dar_config c = model_preset("dar-test");
    model_init(o, &c, storage, false);
    dar_params_fresh(&o->p, DAR_PARAM_ALL, 1);
    for (size_t i = 0; i < o->p.count; i++) {
        dar_param *q = o->p.at[i];
        if (q->info.law == DAR_FRESH_VALUE)
            dar_rng_fill_uniform(&q->x, 2, i, q->info.spread - 0.4, q->info.spread + 0.4);
    }
    model_clip(o, 3, 2, 3, 7);
    o->tape.recording = false;
}

/* ---------------------------------------------------------------- text */

/* Zeros written out as tokens of their own against the one weighted key. */
static void padding_is_one_key(void **state)
{
    (void)state;
    model o;
    init(&o, DAR_F64);
    int64_t keys = o.c.dit.text_keys;
    dar_tensor folded = copy(&o.weights, &model_velocity(&o)->x);
    CHECK(o.count[0] < o.count[1] && o.count[1] < keys, "nothing is folded");

    dar_tensor all = dar_tensor_push(&o.weights, DAR_F64, DAR_SHAPE(2, keys, o.c.dit.text_width));
    dar_tensor_fill(&all, 0);
    for (int64_t b = 0; b < 2; b++) {
        dar_tensor to = dar_tensor_narrow(&all, 0, b, 1), from = dar_tensor_narrow(&o.text, 0, b, 1);
        to = dar_tensor_narrow(&to, 1, 0, o.count[b]);
        from = dar_tensor_narrow(&from, 1, 0, o.count[b]);
        dar_tensor_copy(&to, &from);
        o.count[b] = keys;
    }
    o.text = all;
    CHECK_NEAR("velocity", test_distance(&model_velocity(&o)->x, &folded, NULL), 0, 1e-13);
    model_free(&o);
}

static void no_text_is_all_padding(void **state)
{
    (void)state;
    model o;
    init(&o, DAR_F64);
    o.count[0] = o.count[1] = 0;
    dar_tensor none = copy(&o.weights, &model_velocity(&o)->x);
    o.text = dar_tensor_push(&o.weights, DAR_F64, DAR_SHAPE(2, 0, o.c.dit.text_width));
    CHECK_NEAR("velocity", test_distance(&model_velocity(&o)->x, &none, NULL), 0, 1e-14);
    model_free(&o);
}

/* Keys are normalised over all features: what is large in the first head makes the second one small. */
static void norm_is_over_the_whole_width(void **state)
{
    (void)state;
    model o;
    dar_dit_text x;
    init(&o, DAR_F64);
    int64_t D = o.c.dit.width, E = D / o.c.dit.heads;
    dar_dit_product *q = &o.m.block[0].product[DAR_CROSS_K];
    dar_tensor w = dar_tensor_narrow(&q->w->x, 0, 0, E), b = dar_tensor_narrow(&q->b->x, 0, 0, E);
    dar_dit_text_prepare(&o.tape, &o.m, &o.text, o.count, &x);
    double before = fabs(at(&x.k[0]->x, (size_t)D - 1));
    for (int i = 0; i < 3; i++) { /* times 8 */
        dar_tensor_add(&w, &w);
        dar_tensor_add(&b, &b);
    }
    dar_dit_text_prepare(&o.tape, &o.m, &o.text, o.count, &x);
    CHECK(fabs(at(&x.k[0]->x, (size_t)D - 1)) < 0.5 * before, "the last head does not notice");
    model_free(&o);
}

/* ---------------------------------------------------------------- tokens */

static void orders_of_a_token(void **state)
{
    (void)state;
    enum { B = 2, C = 3, F = 2, H = 4, W = 6, P = 2, H1 = H / P, W1 = W / P, L = F * H1 * W1, K = C * P * P };
    model o;
    init(&o, DAR_F64);
    dar_val *x = dar_input(&o.tape, DAR_F64, DAR_SHAPE(B, C, F, H, W));
    for (size_t i = 0; i < B * C * F * H * W; i++) dar_dtype_set(DAR_F64, x->x.data, i, (double)i);
    dar_val *y = dar_patchify(&o.tape, x, P);
    assert_true(dar_shape_equal(&y->x.shape, &DAR_SHAPE(B, L, K)));
    for (int b = 0; b < B; b++)
        for (int l = 0; l < L; l++)
            for (int k = 0; k < K; k++) {
                int f = l / (H1 * W1), i = l / W1 % H1, j = l % W1, c = k / (P * P), p = k / P % P, q = k % P;
                double expected = (((b * C + c) * F + f) * H + P * i + p) * W + P * j + q;
                CHECK_NEAR("patchify", at(&y->x, (size_t)((b * L + l) * K + k)), expected, 0);
            }

    dar_val *v = dar_contiguous(&o.tape, dar_unpatchify(&o.tape, y, x->x.shape, P));
    for (int b = 0; b < B; b++)
        for (int l = 0; l < L; l++)
            for (int k = 0; k < K; k++) {
                int f = l / (H1 * W1), i = l / W1 % H1, j = l % W1, p = k / (P * C), q = k / C % P, c = k % C;
                size_t to = (size_t)((((b * C + c) * F + f) * H + P * i + p) * W + P * j + q);
                CHECK_NEAR("unpatchify", at(&v->x, to), at(&y->x, (size_t)((b * L + l) * K + k)), 0);
            }
    model_free(&o);
}

/* ---------------------------------------------------------------- time */

static void time_zero_is_the_bias_path(void **state)
{
    (void)state;
    model o;
    init(&o, DAR_F64);
    int64_t n = o.c.dit.frequencies, D = o.c.dit.width;
    dar_tape *t = &o.tape;
    dar_dit_moment e = dar_dit_time_embed(t, &o.m, 1, &(dar_dit_time){ (double[]){ 0 }, 1 });
    dar_val *s = dar_input(t, DAR_F64, DAR_SHAPE(1, n));
    for (int64_t i = 0; i < n; i++) dar_dtype_set(DAR_F64, s->x.data, (size_t)i, i < n / 2);
    dar_val *h = dar_linear(t, s, dar_param_leaf(t, o.m.time_w[0]), dar_param_leaf(t, o.m.time_b[0]), NULL);
    h = dar_linear(t, dar_silu(t, h), dar_param_leaf(t, o.m.time_w[1]), dar_param_leaf(t, o.m.time_b[1]), NULL);
    assert_int_equal(dar_tensor_count(&e.e->x), D);
    CHECK_NEAR("e", test_distance(&e.e->x, &h->x, NULL), 0, 0);
    model_free(&o);
}

/* A row for all tokens, two, or one per frame: the same where the times are. */
static void rows_of_times(void **state)
{
    (void)state;
    static const double equal[] = { 500, 500, 500, 500, 500, 500 }, first[] = { 0, 300, 0, 700 },
                        frames[] = { 0, 300, 300, 0, 700, 700 };
    model o;
    dar_dit_scene s;
    dar_dit_text x;
    init(&o, DAR_F64);
    dar_tape *t = &o.tape;
    dar_dit_scene_prepare(t, &o.m, &o.clip, &s);
    dar_dit_text_prepare(t, &o.m, &o.text, o.count, &x);
    dar_val *z = dar_leaf(t, o.z, NULL), *v[5];
    const dar_dit_time time[] = { { equal, 1 }, { equal, 2 }, { equal, 3 }, { first, 2 }, { frames, 3 } };
    for (int i = 0; i < 5; i++) v[i] = dar_dit_forward(t, &o.m, &s, &x, z, &time[i]);
    CHECK_NEAR("2 rows", test_distance(&v[1]->x, &v[0]->x, NULL), 0, 1e-13);
    CHECK_NEAR("3 rows", test_distance(&v[2]->x, &v[0]->x, NULL), 0, 1e-13);
    CHECK_NEAR("first frame", test_distance(&v[4]->x, &v[3]->x, NULL), 0, 1e-13);
    CHECK(test_distance(&v[3]->x, &v[0]->x, NULL) > 1e-3, "times change nothing");
    model_free(&o);
}

/* ---------------------------------------------------------------- known video */

/* The concatenated mask is 1 where the video is known; what is held is what is known. */
static void polarity_of_the_masks(void **state)
{
    (void)state;
    enum { C = 5, MASK = 4, F = 3, HW = 6 };
    model o;
    init(&o, DAR_F32);
    dar_tensor latent = dar_tensor_push(&o.weights, DAR_F32, DAR_SHAPE(1, C, F, 2, 3));
    dar_tensor y = dar_tensor_push(&o.weights, DAR_F32, DAR_SHAPE(1, MASK + C, F, 2, 3));
    dar_rng_fill_uniform(&latent, 1, 1, -1, 1);

    bool image[(F - 1) * MASK + 1] = { true }, odd[(F - 1) * MASK + 1] = { 0, 1, 0, 0, 0, 0, 0, 1, 0 };
    static const int is[MASK][F] = { { 0, 1, 0 }, { 0, 0, 0 }, { 0, 0, 1 }, { 0, 0, 0 } };
    for (int run = 0; run < 2; run++) {
        dar_dit_known(&y, &latent, run ? odd : image);
        for (int k = 0; k < MASK; k++)
            for (int f = 0; f < F; f++)
                for (int i = 0; i < HW; i++)
                    CHECK_NEAR("mask", at(&y, (size_t)((k * F + f) * HW + i)), run ? is[k][f] : f == 0, 0);
        dar_tensor video = dar_tensor_narrow(&y, 1, MASK, C);
        video = copy(&o.weights, &video);
        CHECK_NEAR("known video", test_distance(&video, &latent, NULL), 0, 0);
    }

    dar_tensor z = dar_tensor_push(&o.weights, DAR_F32, latent.shape);
    dar_tensor_fill(&z, 7);
    dar_dit_hold_first(&z, &latent);
    for (int c = 0; c < C; c++)
        for (int f = 0; f < F; f++)
            for (int i = 0; i < HW; i++) {
                size_t k = (size_t)((c * F + f) * HW + i);
                CHECK_NEAR("held", at(&z, k), f ? 7 : at(&latent, k), 0);
            }
    model_free(&o);
}

/* ---------------------------------------------------------------- one function */

/* Two prompts on one scene that was prepared once, and both steps on another tape; with and without recording. */
static void scene_is_prepared_once(void **state)
{
    (void)state;
    static const dar_dtype type[] = { DAR_F64, DAR_F32, DAR_BF16 };
    for (size_t k = 0; k < DAR_COUNT(type); k++) {
        model o;
        dar_tape once;
        dar_arena room;
        dar_dit_scene s;
        dar_dit_text x[2];
        dar_err e;
        init(&o, type[k]);
        dar_tensor expected = copy(&o.weights, &model_velocity(&o)->x);
        CHECK(dar_arena_init(&room, "scene", (size_t)16 << 20, &e) == DAR_OK, "%s", e.text);
        CHECK(dar_tape_init(&once, &room, &e) == DAR_OK, "%s", e.text);
        once.recording = false;
        dar_dit_scene_prepare(&once, &o.m, &o.clip, &s);
        dar_dit_text_prepare(&once, &o.m, &o.text, o.count, &x[0]);
        dar_dit_text_prepare(&once, &o.m, &o.text, (int64_t[]){ 0, 0 }, &x[1]);
        for (int i = 0; i < 4; i++) {
            dar_tape_clear(&o.tape);
            dar_arena_reset(&o.step, 0);
            o.tape.recording = i >= 2;
            dar_val *v = dar_dit_forward(&o.tape, &o.m, &s, &x[i % 2], dar_leaf(&o.tape, o.z, NULL),
                                         &(dar_dit_time){ model_times, 2 });
            bool same = memcmp(v->x.data, expected.data, dar_tensor_bytes(&expected)) == 0;
            CHECK(same == (i % 2 == 0), "%s, run %d: the bits %s", dar_dtype_name(type[k]), i,
                  same ? "are the same for another text" : "differ");
        }
        dar_tape_free(&once);
        dar_arena_free(&room);
        model_free(&o);
    }
}

/* The clips of a batch do not see each other. */
static void clips_are_independent(void **state)
{
    (void)state;
    model o;
    init(&o, DAR_F64);
    dar_tensor both = copy(&o.weights, &model_velocity(&o)->x), second = dar_tensor_narrow(&both, 0, 1, 1);
    dar_dit_scene s;
    dar_dit_text x;
    dar_dit_clip one = o.clip;
    one.clips = 1;
    one.cond = dar_tensor_narrow(&o.clip.cond, 0, 1, 1);
    one.known = dar_tensor_narrow(&o.clip.known, 0, 1, 1);
    dar_tensor text = dar_tensor_narrow(&o.text, 0, 1, 1), z = dar_tensor_narrow(&o.z, 0, 1, 1);
    dar_dit_scene_prepare(&o.tape, &o.m, &one, &s);
    dar_dit_text_prepare(&o.tape, &o.m, &text, &o.count[1], &x);
    dar_val *v =
        dar_dit_forward(&o.tape, &o.m, &s, &x, dar_leaf(&o.tape, z, NULL), &(dar_dit_time){ model_times + 2, 2 });
    CHECK_NEAR("velocity", test_distance(&v->x, &second, NULL), 0, 1e-13);
    model_free(&o);
}

static void wrong_calls_abort(void **state)
{
    (void)state;
    model o;
    init(&o, DAR_F32);
    o.clip.width += 2;
    CHECK_ABORTS(model_velocity(&o));
    o.clip.width -= 2;
    o.count[0] = 8;
    CHECK_ABORTS(model_velocity(&o));
    o.count[0] = 1;
    o.z.shape.d[2] = 2;
    CHECK_ABORTS(model_velocity(&o));
    model_free(&o);
}

/* ---------------------------------------------------------------- the public model */

static void numbers_of_the_public_model(void **state)
{
    (void)state;
    static const struct {
        int64_t mask, rays, geometry, blocks;
        size_t base, adapter, tensors;
    } of[] = {
        { 0, 0, 0, 1, 4999787712, 0, 825 },
        { 4, 24, 0, 1, 5000426688, 245376000, 831 },
        { 4, 24, 9, 1, 5000426688, 273687552, 831 },
        { 4, 24, 9, 2, 5000426688, 443563008, 835 },
    };
    for (size_t i = 0; i < DAR_COUNT(of); i++) {
        model o;
        dar_config c = model_preset("wan22-fun-5b");
        c.dit.mask = of[i].mask;
        c.adapter.rays = of[i].rays;
        c.adapter.geometry = of[i].geometry;
        c.adapter.blocks = of[i].blocks;
        c.lora = (dar_lora_config){ .rank = 256, .alpha = 256, .targets = DAR_PROJECTIONS_ALL };
        model_init(&o, &c, DAR_BF16, true);
        assert_int_equal(dar_params_count(&o.p, DAR_PARAM_BASE), of[i].base);
        assert_int_equal(dar_params_count(&o.p, DAR_PARAM_ADAPTER), of[i].adapter);
        assert_int_equal(o.p.count, of[i].tensors);
        dar_lora_init(&o.m, &o.p, &c.lora);
        assert_int_equal(dar_params_count(&o.p, DAR_PARAM_LORA), 644874240);
        model_free(&o);
    }
}

/* The paper's lengths at 480 x 832, with rank 256 and the twelve-channel geometry: shapes fit, for sampling and
 * training; FLOPs are those of skipping_and_numerics.md. */
static void lengths_of_the_paper(void **state)
{
    (void)state;
    static const int length[] = { 49, 77, 81, 89, 93, 117, 249 };
    static const double tflop[] = { 55, 0, 98, 0, 0, 0, 441 }; /* one evaluation; 0: not given */
    for (size_t i = 0; i < DAR_COUNT(length); i++) {
        model o;
        dar_config c = model_preset("wan22-fun-5b");
        c.adapter.geometry = 9;
        c.lora = (dar_lora_config){ .rank = 256, .alpha = 256, .targets = DAR_PROJECTIONS_ALL };
        model_init(&o, &c, DAR_BF16, true);
        dar_lora_init(&o.m, &o.p, &c.lora);
        dar_params_train(&o.p, DAR_PARAM_LORA | DAR_PARAM_ADAPTER);
        dar_params_fresh(&o.p, DAR_PARAM_ALL, 1);
        dar_params_gradients(&o.p);
        size_t weights = o.weights.used;
        model_clip(&o, (length[i] - 1) / 4 + 1, 15, 26, 30);
        o.m.replay = DAR_REPLAY_PRODUCTS;
        dar_val *loss = model_loss(&o);
        dar_backward(&o.tape, loss, NULL);
        size_t training = o.step.peak, kept = o.keep.peak;
        double step = o.tape.cost.forward + o.tape.cost.backward;

        o.tape.recording = false;
        dar_lora_merge(&o.m, &o.p, &o.step);
        dar_arena_reset(&o.step, 0);
        o.step.peak = 0;
        dar_val *v = model_velocity(&o);
        assert_true(dar_shape_equal(&v->x.shape, &o.z.shape));
        printf("note: 5B at %d frames: weights %.1f GB, training %.1f + %.1f GB, %.0f TFLOP; sampling %.2f GB, %.1f "
               "TFLOP\n",
               length[i], (double)weights * 1e-9, (double)training * 1e-9, (double)kept * 1e-9, step * 1e-12,
               (double)o.step.peak * 1e-9, o.tape.cost.forward * 1e-12);
        if (tflop[i] > 0) CHECK_NEAR("TFLOP", o.tape.cost.forward * 1e-12, tflop[i], 0.1 * tflop[i]);
        model_free(&o);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(padding_is_one_key),           cmocka_unit_test(no_text_is_all_padding),
        cmocka_unit_test(norm_is_over_the_whole_width), cmocka_unit_test(orders_of_a_token),
        cmocka_unit_test(time_zero_is_the_bias_path),   cmocka_unit_test(rows_of_times),
        cmocka_unit_test(polarity_of_the_masks),        cmocka_unit_test(scene_is_prepared_once),
        cmocka_unit_test(clips_are_independent),        cmocka_unit_test(wrong_calls_abort),
        cmocka_unit_test(numbers_of_the_public_model),  cmocka_unit_test(lengths_of_the_paper),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
