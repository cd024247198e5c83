/* test_adapter.c: the control adapter: one product is the unshuffle and the convolution, widening, groups of pictures,
 * more blocks. */
#include "tests/test.h"

#include "autograd/ops.h"
#include "lib/rng.h"
#include "tests/model.h"

static dar_tensor random_tensor(dar_arena *a, dar_dtype type, dar_shape s, uint64_t stream)
{
    dar_tensor x = dar_tensor_push(a, type, s);
    dar_rng_fill_uniform(&x, 1, stream, -1, 1);
    return x;
}

static double at(const dar_tensor *x, int64_t i)
{
    return dar_dtype_get(x->dtype, x->data, (size_t)i);
}

static void check_equal(const char *what, const dar_tensor *x, const dar_tensor *y, double bound)
{
    assert_int_equal(dar_tensor_count(x), dar_tensor_count(y));
    for (int64_t i = 0; i < (int64_t)dar_tensor_count(x); i++) CHECK_NEAR(what, at(x, i), at(y, i), bound);
}

static dar_val *run(model *o, const dar_tensor *cond)
{
    return dar_adapter_forward(&o->tape, &o->m.adapter, cond);
}

/* ---------------------------------------------------------------- the product */

/* The convolution spelled out over unshuffled pixels. */
static void product_is_unshuffle_and_convolution(void **state)
{
    (void)state;
    dar_config c = model_preset("dar-test");
    model o;
    c.adapter.blocks = 0;
    c.adapter.unshuffle = 3;
    model_init(&o, &c, DAR_F64, false);
    dar_params_fresh(&o.p, DAR_PARAM_ADAPTER, 1);
    const dar_adapter *a = &o.m.adapter;
    int64_t C = c.adapter.rays + c.adapter.geometry, r = 3, F = 2, h = 2, w = 3, D = c.dit.width;
    int64_t H = 2 * r * h, W = 2 * r * w;
    dar_tensor cond = random_tensor(&o.weights, DAR_F64, DAR_SHAPE(2, C, F, H, W), 1);
    dar_val *y = run(&o, &cond);

    for (int64_t token = 0; token < 2 * F * h * w; token += 5)
        for (int64_t d = 0; d < D; d += 3) {
            int64_t picture = token / (h * w), i = token / w % h, j = token % w;
            double sum = at(&a->b->x, d);
            for (int64_t k = 0; k < C * r * r; k++)
                for (int64_t ky = 0; ky < 2; ky++)
                    for (int64_t kx = 0; kx < 2; kx++) {
                        int64_t ch = k / (r * r), dy = k / r % r, dx = k % r;
                        int64_t row = r * (2 * i + ky) + dy, col = r * (2 * j + kx) + dx;
                        sum += at(&a->w->x, ((d * C * r * r + k) * 2 + ky) * 2 + kx) *
                               at(&cond, (((picture / F * C + ch) * F + picture % F) * H + row) * W + col);
                    }
            CHECK_NEAR("token", at(&y->x, token * D + d), sum, 1e-13);
        }
    model_free(&o);
}

/* Fresh weights of the convolution, and they alone, are larger by the configured factor. */
static void spread_scales(void **state)
{
    (void)state;
    dar_config c = model_preset("dar-test");
    model one, eight;
    model_init(&one, &c, DAR_F64, false);
    c.adapter.spread = 8;
    model_init(&eight, &c, DAR_F64, false);
    dar_params_fresh(&one.p, DAR_PARAM_ADAPTER, 1);
    dar_params_fresh(&eight.p, DAR_PARAM_ADAPTER, 1);
    for (int64_t i = 0; i < 100; i++) {
        double w = at(&one.m.adapter.w->x, i);
        CHECK(w != 0, "weight %d is 0", (int)i);
        CHECK_NEAR("weight", at(&eight.m.adapter.w->x, i), 8 * w, 1e-13);
    }
    CHECK_NEAR("bias", at(&eight.m.adapter.b->x, 0), at(&one.m.adapter.b->x, 0), 0);
    model_free(&one);
    model_free(&eight);
}

static void pixels_must_fit(void **state)
{
    (void)state;
    dar_config c = model_preset("dar-test");
    model o;
    model_init(&o, &c, DAR_F32, false);
    dar_params_fresh(&o.p, DAR_PARAM_ADAPTER, 1);
    dar_tensor askew = random_tensor(&o.weights, DAR_F32, DAR_SHAPE(1, 26, 1, 6, 8), 1);
    dar_tensor fewer = random_tensor(&o.weights, DAR_F32, DAR_SHAPE(1, 24, 1, 8, 8), 1);
    CHECK_ABORTS(run(&o, &askew));
    CHECK_ABORTS(run(&o, &fewer));
    model_free(&o);
}

/* ---------------------------------------------------------------- groups */

/* Output and gradients, pictures taken together or one at a time: eleven of them need two levels of joining. */
static void groups_change_nothing(void **state)
{
    (void)state;
    static const int64_t group[] = { (int64_t)1 << 26, 1, 416 * 2 * 2 * 3 };
    dar_tensor first[8] = { 0 };
    dar_arena kept;
    dar_err e;
    CHECK(dar_arena_init(&kept, "kept", (size_t)16 << 20, &e) == DAR_OK, "%s", e.text);

    for (size_t k = 0; k < DAR_COUNT(group); k++) {
        dar_config c = model_preset("dar-test");
        model o;
        size_t n = 0;
        model_init(&o, &c, DAR_F64, false);
        dar_params_train(&o.p, DAR_PARAM_ADAPTER);
        dar_params_fresh(&o.p, DAR_PARAM_ADAPTER, 1);
        dar_params_gradients(&o.p);
        o.m.adapter.group = group[k];
        dar_tensor cond = random_tensor(&o.weights, DAR_F64, DAR_SHAPE(1, 26, 11, 8, 12), 1);
        dar_tensor seed = random_tensor(&o.weights, DAR_F64, DAR_SHAPE(1, 11 * 6, c.dit.width), 2);
        dar_val *y = run(&o, &cond);
        o.tape.recording = false;
        dar_val *same = run(&o, &cond);
        o.tape.recording = true;
        check_equal("recorded or not", &y->x, &same->x, 0);
        dar_backward(&o.tape, y, &seed);
        for (size_t i = 0; i <= o.p.count; i++) {
            const dar_tensor *x = i < o.p.count ? &o.p.at[i]->g : &y->x;
            if (!x->data) continue;
            if (!k) {
                first[n] = dar_tensor_push(&kept, DAR_F64, x->shape);
                dar_tensor_copy(&first[n], x);
            }
            check_equal("pictures at a time", x, &first[n++], 1e-12);
        }
        assert_int_equal(n, 7);
        model_free(&o);
    }
    dar_arena_free(&kept);
}

/* ---------------------------------------------------------------- widening, blocks */

/* A product of 416 terms and the same with zeros behind are summed in different pieces: 416 eps, times what two blocks
 * make of it. */
#define LONGER 1e-12

/* Velocity of the test clip with adapter weights from `narrow`, a network without geometry. */
static void init_from(model *o, const dar_config *c, const model *narrow)
{
    dar_err e;
    model_init(o, c, DAR_F64, false);
    for (size_t i = 0; i < o->p.count; i++) {
        dar_param *q = o->p.at[i], *old = dar_params_find(&narrow->p, q->name);
        if (q == o->m.adapter.w) {
            CHECK(dar_adapter_bind(&o->p, &o->m.adapter, &old->x, 7, &e) == DAR_OK, "%s", e.text);
        } else if (old) {
            dar_param_bind(&o->p, q, &old->x);
        }
    }
    dar_params_fresh(&o->p, DAR_PARAM_ALL, 7);
    o->tape.recording = false;
}

static void init_narrow(model *o)
{
    dar_config c = model_preset("dar-test");
    c.adapter.geometry = 0;
    model_init(o, &c, DAR_F64, false);
    dar_rng_fill_uniform((dar_param_push(&o->p, o->m.head_w), &o->m.head_w->x), 1, 1, -1, 1);
    dar_params_fresh(&o->p, DAR_PARAM_ALL, 1);
    model_clip(o, 3, 2, 3, 4);
    o->tape.recording = false;
}

/* The clip of `narrow` with geometry that is not zero after its rays. */
static void widen_clip(model *o, const model *narrow)
{
    model_clip(o, 3, 2, 3, 4);
    dar_tensor rays = dar_tensor_narrow(&o->clip.cond, 1, 0, narrow->c.adapter.rays);
    dar_tensor_copy(&rays, &narrow->clip.cond);
}

static void widened_by_copy_is_the_narrow_model(void **state)
{
    (void)state;
    model narrow, wide;
    dar_config c = model_preset("dar-test");
    init_narrow(&narrow);
    init_from(&wide, &c, &narrow);
    widen_clip(&wide, &narrow);
    check_equal("velocity", &model_velocity(&wide)->x, &model_velocity(&narrow)->x, LONGER);
    model_free(&wide);

    c.adapter.widen = DAR_WIDEN_FRESH;
    init_from(&wide, &c, &narrow);
    dar_tensor rays = dar_tensor_narrow(&wide.m.adapter.w->x, 1, 0, 96);
    CHECK(dar_tensor_nonfinite(&wide.m.adapter.w->x) < 0, "fresh weights are finite");
    CHECK(at(&rays, 0) != at(&narrow.m.adapter.w->x, 0), "fresh weights are not those of the file");
    model_free(&wide);
    model_free(&narrow);
}

/* Whatever the weights of the geometry channels are: where there is no geometry, the rays decide alone. */
static void without_geometry_only_the_camera_counts(void **state)
{
    (void)state;
    model narrow, wide;
    dar_config c = model_preset("dar-test");
    init_narrow(&narrow);
    init_from(&wide, &c, &narrow);
    widen_clip(&wide, &narrow);
    dar_tensor more = dar_tensor_narrow(&wide.m.adapter.w->x, 1, 96, 8);
    dar_tensor none = dar_tensor_narrow(&wide.clip.cond, 1, 24, 2);
    dar_tensor_fill(&more, 0.5);
    dar_tensor_fill(&none, 0);
    check_equal("velocity", &model_velocity(&wide)->x, &model_velocity(&narrow)->x, LONGER);
    dar_tensor_fill(&none, 0.25);
    dar_val *moved = model_velocity(&wide), *still = model_velocity(&narrow);
    CHECK(fabs(at(&moved->x, 0) - at(&still->x, 0)) > 1e-3, "geometry moves nothing");
    model_free(&wide);
    model_free(&narrow);
}

static void a_second_block_starts_as_the_identity(void **state)
{
    (void)state;
    model narrow, two;
    dar_config c = model_preset("dar-test");
    c.adapter.geometry = 0;
    c.adapter.blocks = 2;
    init_narrow(&narrow);
    init_from(&two, &c, &narrow);
    widen_clip(&two, &narrow);
    check_equal("velocity", &model_velocity(&two)->x, &model_velocity(&narrow)->x, 0);
    model_free(&two);
    model_free(&narrow);
}

/* No adapter output, or one that is zero: the network without an adapter. */
static void silent_adapter_is_none(void **state)
{
    (void)state;
    model o, none;
    dar_config c = model_preset("dar-test");
    init_narrow(&none);
    c.adapter.geometry = 0;
    init_from(&o, &c, &none);
    widen_clip(&o, &none);
    none.clip.cond.data = NULL;
    dar_param *last[] = { o.m.adapter.w, o.m.adapter.b, o.m.adapter.block[0][DAR_ADAPTER_W2],
                          o.m.adapter.block[0][DAR_ADAPTER_B2] };
    for (size_t i = 0; i < DAR_COUNT(last); i++) {
        last[i]->x = dar_tensor_push(&o.weights, DAR_F64, last[i]->x.shape);
        dar_tensor_fill(&last[i]->x, 0);
    }
    check_equal("velocity", &model_velocity(&o)->x, &model_velocity(&none)->x, 0);
    model_free(&o);
    model_free(&none);
}

static void files_that_do_not_fit_are_told(void **state)
{
    (void)state;
    dar_config c = model_preset("dar-test");
    model o;
    dar_err e;
    model_init(&o, &c, DAR_F32, false);
    static const int64_t wrong[][4] = { { 20, 108, 2, 2 }, { 20, 95, 2, 2 }, { 19, 96, 2, 2 }, { 20, 96, 2, 3 } };
    for (size_t i = 0; i < DAR_COUNT(wrong); i++) {
        dar_tensor x =
            random_tensor(&o.weights, DAR_F32, DAR_SHAPE(wrong[i][0], wrong[i][1], wrong[i][2], wrong[i][3]), 1);
        CHECK(dar_adapter_bind(&o.p, &o.m.adapter, &x, 1, &e) == DAR_ERR_FORMAT, "wrong shape %zu", i);
        CHECK(strstr(e.text, "control_adapter.conv.weight: found [") && strstr(e.text, "expected [20, 104, 2, 2]"),
              "message: %s", e.text);
    }
    model_free(&o);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(product_is_unshuffle_and_convolution),
        cmocka_unit_test(spread_scales),
        cmocka_unit_test(pixels_must_fit),
        cmocka_unit_test(groups_change_nothing),
        cmocka_unit_test(widened_by_copy_is_the_narrow_model),
        cmocka_unit_test(without_geometry_only_the_camera_counts),
        cmocka_unit_test(a_second_block_starts_as_the_identity),
        cmocka_unit_test(silent_adapter_is_none),
        cmocka_unit_test(files_that_do_not_fit_are_told),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
