/* test_metric.c: metrics against scikit-image and FLIP's formulas (scripts/make-metric-fixtures.py), and where the
 * answer is known. */
#include "tests/test.h"

#include "data/metric.h"
#include "lib/json.h"
#include "lib/rng.h"
#include "lib/weights.h"

enum { W = 43, H = 31, T = 3, VALUES = 3 * W * H };

static dar_metric *open_metric(size_t width, size_t height)
{
    dar_metric *m;
    dar_err e;
    CHECK(dar_metric_open(&m, width, height, DAR_METRIC_ALL, &e) == DAR_OK, "%s", e.text);
    return m;
}

static dar_metric_row once(size_t width, size_t height, const uint8_t *found, const uint8_t *truth, const uint8_t *mask)
{
    dar_metric *m = open_metric(width, height);
    dar_metric_row row;
    dar_metric_begin(m, truth);
    dar_metric_frame(m, found, truth, mask, &row);
    dar_metric_close(m);
    return row;
}

static const uint8_t *bytes(const dar_weights *w, const char *name)
{
    const dar_weight *x = dar_weights_find(w, name);
    assert_non_null(x);
    return x->data;
}

/* ---------------------------------------------------------------- against others */

/* Sums of the fixture are f64.  FLIP is f32: at its steepest, d^0.7 at a distance of 1e-4 that f32 leaves of Lab values
 * up to 100, single pixels are off by some 1e-4; means and measured maps stay well below. */
static void check_frame(dar_json j, const dar_metric_row *row, int t)
{
    for (int k = 0; k < DAR_METRICS; k++) {
        double want[2] = { NAN, NAN };
        const char *name = dar_metric_name[k];
        if (!dar_json_get(j, name).item) {
            CHECK(isnan(row->v[0][k]) && isnan(row->v[1][k]), "frame %d has %s", t, name);
            continue;
        }
        dar_json_numbers(j, name, want, 2);
        for (int a = 0; a < DAR_METRIC_AREAS; a++) CHECK_NEAR(name, row->v[a][k], want[a], 1e-6);
    }
}

static void test_fixture(void **state)
{
    dar_weights *w;
    dar_json_doc *doc;
    dar_metric_row row;
    dar_err e;
    (void)state;
    CHECK(dar_weights_open(&w, "tests/fixtures/metric.safetensors", &e) == DAR_OK, "%s", e.text);
    CHECK(dar_json_open(&doc, "tests/fixtures/metric.json", &e) == DAR_OK, "%s", e.text);
    const uint8_t *found = bytes(w, "found"), *truth = bytes(w, "truth"), *mask = bytes(w, "mask");
    dar_metric *m = open_metric(W, H);
    dar_metric_begin(m, truth);
    dar_json j = dar_json_first(dar_json_get(dar_json_root(doc), "frames"));
    for (int t = 0; t < T; t++, j = dar_json_next(j)) {
        dar_metric_frame(m, found + t * VALUES, truth + t * VALUES, mask + t * W * H, &row);
        check_frame(j, &row, t);
    }
    CHECK(!j.item && dar_json_finish(doc, &e) == DAR_OK, "the fixture has more than is tested");
    dar_tensor map;
    CHECK(dar_weights_tensor(w, "map", &map, &e) == DAR_OK, "%s", e.text);
    for (int i = 0; i < W * H; i++) CHECK_NEAR("map", dar_metric_map(m)[i], ((const float *)map.data)[i], 2e-5);
    dar_metric_close(m);
    dar_json_close(doc);
    dar_weights_close(w);
}

/* ---------------------------------------------------------------- known answers */

static uint8_t picture[2][VALUES], mask[W * H];

static void draw(void)
{
    for (size_t i = 0; i < VALUES; i++) picture[0][i] = (uint8_t)(10 + dar_rng_below(1, 2, i, 200));
}

static void test_identical(void **state)
{
    (void)state;
    draw();
    dar_metric_row r = once(W, H, picture[0], picture[0], NULL);
    CHECK_NEAR("psnr", r.v[0][DAR_METRIC_PSNR], 100, 0);
    CHECK_NEAR("ssim", r.v[0][DAR_METRIC_SSIM], 1, 1e-12);
    CHECK_NEAR("flip", r.v[0][DAR_METRIC_FLIP], 0, 0);
    CHECK_NEAR("refl1", r.v[0][DAR_METRIC_REF], 0, 0);
    CHECK(isnan(r.v[0][DAR_METRIC_TEMP]), "the first frame moves");
    for (int k = 0; k < DAR_METRICS; k++) CHECK(isnan(r.v[DAR_METRIC_MASK][k]), "no mask, but a number");
}

/* 20 log10(255 / 1) and (255 / 5). */
static void test_offset(void **state)
{
    static const struct {
        int by;
        double psnr;
    } cases[] = { { 1, 48.130803608679 }, { 5, 34.151403521959 } };
    (void)state;
    draw();
    for (size_t k = 0; k < DAR_COUNT(cases); k++) {
        for (size_t i = 0; i < VALUES; i++) picture[1][i] = (uint8_t)(picture[0][i] + cases[k].by);
        dar_metric_row r = once(W, H, picture[1], picture[0], NULL);
        CHECK_NEAR("psnr", r.v[0][DAR_METRIC_PSNR], cases[k].psnr, 1e-11);
        CHECK_NEAR("refl1", r.v[0][DAR_METRIC_REF], cases[k].by, 0);
    }
}

/* Flat pictures: ssim = C1 / (255^2 + C1); flip = 1 for the farthest colours, a known value for black and white. */
static void test_black_and_white(void **state)
{
    (void)state;
    memset(picture[0], 0, VALUES);
    memset(picture[1], 255, VALUES);
    dar_metric_row r = once(W, H, picture[0], picture[1], NULL);
    CHECK_NEAR("psnr", r.v[0][DAR_METRIC_PSNR], 0, 1e-12);
    CHECK_NEAR("ssim", r.v[0][DAR_METRIC_SSIM], 1e-4 / (1 + 1e-4), 1e-15);
    for (size_t i = 0; i < VALUES; i++) {
        picture[0][i] = i % 3 == 1 ? 255 : 0;
        picture[1][i] = i % 3 == 2 ? 255 : 0;
    }
    r = once(W, H, picture[0], picture[1], NULL);
    CHECK_NEAR("flip of green and blue", r.v[0][DAR_METRIC_FLIP], 1, 1e-5);
}

/* Steps of 10 per column, moved by one: every value is off by 10 but those of the first column, which is repeated. */
static void test_shift(void **state)
{
    (void)state;
    for (size_t i = 0; i < VALUES; i++) {
        size_t column = i / 3 % W;
        picture[0][i] = (uint8_t)(5 * column);
        picture[1][i] = (uint8_t)(5 * (column ? column - 1 : 0));
    }
    dar_metric_row r = once(W, H, picture[1], picture[0], NULL);
    CHECK_NEAR("psnr", r.v[0][DAR_METRIC_PSNR], -10 * log10(25.0 * (W - 1) / W / 65025), 1e-11);
    CHECK_NEAR("refl1", r.v[0][DAR_METRIC_REF], 5.0 * (W - 1) / W, 1e-12);
}

/* A ramp twice as steep, and a flat truth. */
static void test_sharpness(void **state)
{
    (void)state;
    for (size_t i = 0; i < VALUES; i++) {
        size_t slope = 3 * (i / 3 % W) + 4 * (i / 3 / W); /* 5 a pixel, 3 across and 4 down */
        picture[0][i] = (uint8_t)(slope / 2);
        picture[1][i] = (uint8_t)slope;
    }
    memset(mask, 0, sizeof mask);
    mask[W * H - 1] = 255; /* no pixel to the right of it */
    dar_metric_row r = once(W, H, picture[1], picture[1], mask);
    CHECK_NEAR("sharpness of the same", r.v[0][DAR_METRIC_SHARP], 1, 0);
    CHECK(isnan(r.v[1][DAR_METRIC_SHARP]), "a slope of the last pixel");
    r = once(W, H, picture[0], picture[1], NULL); /* 1.5 across is 1 or 2 in bytes, in turn */
    CHECK_NEAR("sharpness of half", r.v[0][DAR_METRIC_SHARP], (sqrt(5) + sqrt(8)) / 2 / 5, 1e-12);
    memset(picture[1], 9, VALUES);
    r = once(W, H, picture[0], picture[1], NULL);
    CHECK(isnan(r.v[0][DAR_METRIC_SHARP]), "sharper than nothing");
}

static void test_mask_of_one_pixel(void **state)
{
    size_t at = 12 * W + 30;
    (void)state;
    draw();
    memcpy(picture[1], picture[0], VALUES);
    for (size_t c = 0; c < 3; c++) picture[1][3 * at + c] = (uint8_t)(picture[0][3 * at + c] + 8);
    memset(mask, 127, sizeof mask); /* less than half */
    mask[at] = 128;
    dar_metric_row r = once(W, H, picture[1], picture[0], mask);
    CHECK_NEAR("psnr", r.v[1][DAR_METRIC_PSNR], 20 * log10(255 / 8.0), 1e-11);
    CHECK_NEAR("refl1", r.v[1][DAR_METRIC_REF], 8, 0);
    CHECK(r.v[1][DAR_METRIC_SSIM] < 1 && r.v[1][DAR_METRIC_FLIP] > 0, "the pixel is not seen");
    mask[at] = 0;
    mask[W + 1] = 255; /* in the border: no window lies inside */
    r = once(W, H, picture[1], picture[0], mask);
    CHECK_NEAR("psnr elsewhere", r.v[1][DAR_METRIC_PSNR], 100, 0);
    CHECK(isnan(r.v[1][DAR_METRIC_SSIM]), "a window outside of the picture");
}

/* A result that moves by 3 each frame, truth by 5: 3 by itself, 2 otherwise than the truth. */
static void test_time(void **state)
{
    dar_metric *m = open_metric(W, H);
    dar_metric_clip clip = { 0 };
    dar_metric_row r;
    (void)state;
    for (int pass = 0; pass < 2; pass++) {
        dar_metric_begin(m, NULL);
        for (int t = 0; t < 4; t++) {
            memset(picture[0], 100 + 3 * t, VALUES);
            memset(picture[1], 100 + 5 * t, VALUES);
            dar_metric_frame(m, picture[0], picture[1], NULL, &r);
            CHECK(isnan(r.v[0][DAR_METRIC_REF]), "no reference, but a distance");
            CHECK(isnan(r.v[0][DAR_METRIC_TEMP]) == !t, "frame %d", t);
            dar_metric_clip_add(&clip, &r);
        }
    }
    dar_metric_clip_mean(&clip, &r);
    CHECK_NEAR("templ1", r.v[0][DAR_METRIC_TEMP], 3, 0);
    CHECK_NEAR("templ1_truth", r.v[0][DAR_METRIC_TEMP_TRUTH], 2, 0);
    CHECK(isnan(r.v[1][DAR_METRIC_PSNR]), "a mean of nothing");
    dar_metric_close(m);
}

static void test_small(void **state)
{
    (void)state;
    draw();
    for (size_t w = 1; w <= 12; w++)
        for (size_t h = 1; h <= 12; h++) {
            dar_metric_row r = once(w, h, picture[0], picture[0] + 300, NULL);
            CHECK(r.v[0][DAR_METRIC_PSNR] > 0 && r.v[0][DAR_METRIC_FLIP] > 0, "%zu x %zu", w, h);
            CHECK(isnan(r.v[0][DAR_METRIC_SSIM]) == (w < 11 || h < 11), "%zu x %zu", w, h);
        }
}

static void test_threads(void **state)
{
    static const int threads[] = { 1, 2, 3, 7 };
    dar_metric_row first, r;
    int before = dar_threads();
    (void)state;
    draw();
    for (size_t i = 0; i < VALUES; i++) picture[1][i] = (uint8_t)dar_rng_below(3, 4, i, 256);
    for (size_t i = 0; i < W * H; i++) mask[i] = (uint8_t)dar_rng_below(5, 6, i, 256);
    for (size_t k = 0; k < DAR_COUNT(threads); k++) {
        dar_threads_set(threads[k]);
        r = once(W, H, picture[0], picture[1], mask);
        if (!k) first = r;
        assert_memory_equal(&first, &r, sizeof r);
    }
    dar_threads_set(before);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_fixture), cmocka_unit_test(test_identical),
        cmocka_unit_test(test_offset),  cmocka_unit_test(test_black_and_white),
        cmocka_unit_test(test_shift),   cmocka_unit_test(test_sharpness),
        cmocka_unit_test(test_time),    cmocka_unit_test(test_mask_of_one_pixel),
        cmocka_unit_test(test_threads), cmocka_unit_test(test_small),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
