/* test_lpips.c: LPIPS against its layers in f64 (scripts/make-lpips-fixtures.py). */
#include "tests/fixture.h"

#include "lib/rng.h"
#include "models/lpips.h"

enum { W = 75, H = 67 };

enum { ALEX, ALEX_LIN, VGG, PAIRS, FILES };
static dar_weights *file[FILES];
static const uint8_t *a, *b, *mask;

static int open_all(void **state)
{
    static const char *const name[FILES] = { "lpips_alex.safetensors", "lpips_alex_lin.safetensors",
                                             "lpips_vgg.safetensors", "lpips_pairs.safetensors" };
    (void)state;
    for (int i = 0; i < FILES; i++) file[i] = fixture_open(name[i]);
    a = dar_weights_find(file[PAIRS], "a")->data;
    b = dar_weights_find(file[PAIRS], "b")->data;
    mask = dar_weights_find(file[PAIRS], "mask")->data;
    return 0;
}

static int close_all(void **state)
{
    (void)state;
    for (int i = 0; i < FILES; i++) dar_weights_close(file[i]);
    return 0;
}

static dar_lpips *open_net(dar_lpips_net net)
{
    dar_weights *const files[] = { file[VGG], file[ALEX_LIN], file[ALEX] };
    dar_lpips *l;
    dar_err e;
    CHECK(dar_lpips_open(&l, net, files, 3, W, H, &e) == DAR_OK, "%s", e.text);
    return l;
}

/* f32 against f64: no sum is longer than 605 terms, eps (605 + 8) = 4e-5 of its terms' sum at most; distances are means
 * over many places of squares, and come out far nearer. */
static void test_fixture(void **state)
{
    (void)state;
    for (int net = 0; net < DAR_LPIPS_NETS; net++) {
        dar_lpips *l = open_net((dar_lpips_net)net);
        dar_tensor want;
        dar_err e;
        double d[2], back[2];
        CHECK(dar_weights_tensor(file[PAIRS], dar_lpips_name[net], &want, &e) == DAR_OK, "%s", e.text);
        for (int pass = 0; pass < 2; pass++) {
            dar_lpips_distance(l, a, b, mask, d);
            CHECK_NEAR(dar_lpips_name[net], d[0], ((const double *)want.data)[0], 1e-6);
            CHECK_NEAR("within the mask", d[1], ((const double *)want.data)[1], 1e-6);
        }
        dar_lpips_distance(l, b, a, NULL, back);
        CHECK_NEAR("the other way round", back[0], d[0], 1e-12);
        CHECK(isnan(back[1]), "no mask, but a number");
        dar_lpips_distance(l, a, a, mask, d);
        CHECK_NEAR("equal pictures", d[0], 0, 0);
        dar_lpips_close(l);
    }
}

static void test_threads(void **state)
{
    static const int threads[] = { 1, 2, 3, 7 };
    int before = dar_threads();
    double first[2], d[2];
    (void)state;
    for (size_t k = 0; k < DAR_COUNT(threads); k++) {
        dar_threads_set(threads[k]);
        dar_lpips *l = open_net(DAR_LPIPS_VGG);
        dar_lpips_distance(l, a, b, mask, k ? d : first);
        if (k) assert_memory_equal(first, d, sizeof d);
        dar_lpips_close(l);
    }
    dar_threads_set(before);
}

static void refused(dar_lpips_net net, dar_weights *const *files, size_t n, size_t w, size_t h, const char *words)
{
    dar_lpips *l;
    dar_err e;
    dar_status s = dar_lpips_open(&l, net, files, n, w, h, &e);
    CHECK(s == DAR_ERR_FORMAT && !l && strstr(e.text, words), "status %d, %s", s, e.text);
}

static void test_refused(void **state)
{
    dar_weights *const lins_of_another[] = { file[ALEX], file[VGG] };
    (void)state;
    refused(DAR_LPIPS_VGG, &file[ALEX], 2, W, H, "no file has a trunk of vgg");
    refused(DAR_LPIPS_ALEX, &file[ALEX], 1, W, H, "no file has lin0");
    refused(DAR_LPIPS_ALEX, lins_of_another, 2, W, H, "no file has lin0");
    refused(DAR_LPIPS_ALEX, &file[ALEX], 2, 30, 100, "30 x 100 are too small for alex");
    refused(DAR_LPIPS_VGG, &file[VGG], 1, 100, 15, "100 x 15 are too small for vgg");
    assert_false(dar_lpips_there(DAR_LPIPS_VGG, &file[ALEX], 2));
    assert_true(dar_lpips_there(DAR_LPIPS_VGG, file, FILES));
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_fixture),
        cmocka_unit_test(test_threads),
        cmocka_unit_test(test_refused),
    };
    return cmocka_run_group_tests(tests, open_all, close_all) != 0;
}
