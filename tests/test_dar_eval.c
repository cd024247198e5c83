/* test_dar_eval.c: the program dar-eval: two small synthetic bundles, methods made of their own pictures, whose answers
 * are known. */
#include "tests/scratch.h"

#include "data/bundle.h"
#include "data/png.h"
#include "data/uri.h"
#include "lib/json.h"
#include "lib/rng.h"
#include "lib/safetensors_write.h"
#include "models/config.h"
#include "models/vae_start.h"

#define W 64
#define H 48
#define T 11

enum { VALUES = 3 * W * H };

static char program[PATH_MAX], bundler[PATH_MAX], weights[3][PATH_MAX];
static const char *const clip[] = { "000000", "000001" };

#define RUN(...) RUN_PROGRAM(program, __VA_ARGS__)

/* ---------------------------------------------------------------- methods */

typedef void change_fn(uint8_t *rgb, size_t t);

static void keep(uint8_t *rgb, size_t t)
{
    (void)rgb, (void)t;
}

/* Every value is off by 5. */
static void offset(uint8_t *rgb, size_t t)
{
    (void)t;
    for (size_t i = 0; i < VALUES; i++) rgb[i] = (uint8_t)(rgb[i] >= 5 ? rgb[i] - 5 : rgb[i] + 5);
}

static void write_frame(const char *method, size_t c, size_t number, const uint8_t *rgb)
{
    char path[256];
    dar_err e;
    mkdir(method, 0777);
    snprintf(path, sizeof path, "%s/%s", method, clip[c]);
    mkdir(path, 0777);
    snprintf(path, sizeof path, "%s/%s/%zu.png", method, clip[c], number);
    CHECK(dar_png_write(path, W, H, 3, rgb, &e) == DAR_OK, "%s", e.text);
}

/* Frames of the clip, changed, numbered in steps of `step`; what lies between is noise. */
static void make_method(const char *method, size_t clips, change_fn *change, size_t step)
{
    static uint8_t rgb[VALUES], noise[VALUES];
    for (size_t i = 0; i < VALUES; i++) noise[i] = (uint8_t)(i * 37);
    for (size_t c = 0; c < clips; c++) {
        char path[64];
        dar_bundle *b;
        dar_err e;
        snprintf(path, sizeof path, "set/%s", clip[c]);
        CHECK(dar_bundle_open(&b, path, &e) == DAR_OK, "%s", e.text);
        for (size_t t = 0; t < T; t++) {
            CHECK(dar_bundle_rgb(b, t, rgb, &e) == DAR_OK, "%s", e.text);
            change(rgb, t);
            write_frame(method, c, step * t, rgb);
            for (size_t k = 1; k < step && t + 1 < T; k++) write_frame(method, c, step * t + k, noise);
        }
        dar_bundle_close(b);
    }
}

static int make_all(void **state)
{
    for (int i = 0; i < 3; i++) {
        static const char *const name[] = { "alex", "alex_lin", "vgg" };
        char path[64];
        snprintf(path, sizeof path, "tests/fixtures/lpips_%s.safetensors", name[i]);
        if (!realpath(path, weights[i])) return -1;
    }
    if (scratch_enter(state) != 0) return -1;
    RUN_PROGRAM(bundler, "synth", "--set", "4d_vis", "--count", "2", "--size", "64x48", "--frames", "11", "-o", "set");
    CHECK(ran.status == 0, "%s", ran.err);
    make_method("same", 2, keep, 1);
    make_method("offset", 2, offset, 1);
    make_method("double", 2, keep, 2);
    make_method("half", 1, keep, 1);
    return 0;
}

/* ---------------------------------------------------------------- results */

static dar_json_doc *doc;

static void open_results(const char *out)
{
    char path[128];
    dar_err e;
    snprintf(path, sizeof path, "%s/metrics.json", out);
    CHECK(dar_json_open(&doc, path, &e) == DAR_OK, "%s", e.text);
}

static dar_json method_of(const char *name)
{
    dar_json j = dar_json_first(dar_json_get(dar_json_root(doc), "methods"));
    while (j.item && strcmp(dar_json_text(j, "name", ""), name) != 0) j = dar_json_next(j);
    CHECK(j.item, "no method %s", name);
    return j;
}

/* Mean over all clips and frames. */
static dar_json measure_of(const char *name, const char *measure)
{
    dar_json j = dar_json_get(dar_json_get(method_of(name), "sets"), "4d_vis");
    return dar_json_get(dar_json_get(dar_json_get(j, "all"), "frame"), measure);
}

static double mean_of(const char *name, const char *measure)
{
    return dar_json_number(measure_of(name, measure), "mean", NAN, -1e9, 1e9);
}

static char *text_of(const char *path)
{
    static dar_file_map m;
    static char *text;
    dar_err e;
    free(text);
    CHECK(dar_file_map_open(&m, path, &e) == DAR_OK, "%s", e.text);
    assert_non_null(text = malloc(m.size + 1));
    memcpy(text, m.data, m.size);
    text[m.size] = 0;
    dar_file_map_close(&m);
    return text;
}

/* ---------------------------------------------------------------- tests */

static void test_known(void **state)
{
    (void)state;
    GOOD("same", "offset", "--against", "set", "-o", "known", "--no-report", "--lpips", weights[0], weights[1],
         weights[2]);
    open_results("known");
    CHECK_NEAR("psnr of the same", mean_of("same", "psnr"), 100, 0);
    CHECK_NEAR("ssim of the same", mean_of("same", "ssim"), 1, 1e-12);
    CHECK_NEAR("flip of the same", mean_of("same", "flip"), 0, 0);
    CHECK_NEAR("lpips of the same", mean_of("same", "lpips_alex"), 0, 0);
    CHECK_NEAR("lpips of the same", mean_of("same", "lpips_vgg"), 0, 0);
    CHECK_NEAR("motion of the same", mean_of("same", "templ1_truth"), 0, 0);
    CHECK_NEAR("psnr of 5 too many", mean_of("offset", "psnr"), 20 * log10(51), 1e-10);
    CHECK(mean_of("offset", "lpips_alex") > 0 && mean_of("offset", "flip") > 0, "the offset is not seen");
    CHECK_NEAR("refl1 of frame 0", mean_of("repeat frame 0", "refl1"), 0, 0);
    CHECK_NEAR("motion of frame 0", mean_of("repeat frame 0", "templ1"), 0, 0);
    CHECK(mean_of("oracle warp", "psnr") > mean_of("repeat frame 0", "psnr"), "the oracle is no better than frame 0");
    dar_json_close(doc);
}

/* Names 0.png to 10.png are in the order of numbers; frame 2 t of twice as many is frame t. */
static void test_time(void **state)
{
    (void)state;
    BAD(2, "found 21 frames, expected 11", "double", "--against", "set", "-o", "wrong", "--quiet");
    assert_false(run_is_there("wrong"));
    GOOD("double", "same", "--against", "set", "-o", "time", "--no-report", "--align", "normalized-time");
    open_results("time");
    CHECK_NEAR("psnr", mean_of("double", "psnr"), 100, 0);
    assert_true(dar_json_bool(method_of("double"), "external", false));
    assert_false(dar_json_bool(method_of("same"), "external", true));
    dar_json_close(doc);
}

static void test_size(void **state)
{
    static uint8_t grey[3 * 32 * 24];
    dar_err e;
    (void)state;
    memset(grey, 128, sizeof grey);
    mkdir("small", 0777);
    mkdir("small/000000", 0777);
    assert_int_equal(dar_png_write("small/000000/0.png", 32, 24, 3, grey, &e), DAR_OK);
    GOOD("small", "--against", "set/000000", "-o", "size", "--no-report", "--align", "normalized-time");
    char *text = text_of("size/tables.md");
    CHECK(strstr(text, "One clip gives no interval"), "%s", text);
    CHECK(strstr(text, "small †"), "%s", text);
    mkdir("tall", 0777);
    mkdir("tall/000000", 0777);
    for (int t = 0; t < T; t++) {
        char path[64];
        snprintf(path, sizeof path, "tall/000000/%d.png", t);
        assert_int_equal(dar_png_write(path, 24, 32, 3, grey, &e), DAR_OK);
    }
    BAD(2, "found another size than 64 x 48", "tall", "--against", "set/000000", "-o", "wrong", "--quiet");
}

static void test_missing_clips(void **state)
{
    (void)state;
    GOOD("same", "half", "--against", "set", "-o", "half-out", "--no-report");
    CHECK(strstr(ran.err, "half: found 1 of 2 clips"), "%s", ran.err);
    CHECK(strstr(text_of("half-out/tables.md"), "| half | 1/2 |"), "no 1/2");
    open_results("half-out");
    CHECK(dar_json_get(measure_of("same", "psnr"), "lo").item, "two clips have no interval");
    CHECK(!dar_json_get(measure_of("half", "psnr"), "lo").item, "one clip has an interval");
    dar_json_close(doc);
}

static void test_refused(void **state)
{
    (void)state;
    mkdir("empty", 0777);
    BAD(2, "expected --against", "same", "-o", "wrong");
    BAD(2, "expected -o DIR", "same", "--against", "set");
    BAD(2, "found pictures of no clip", "empty", "--against", "set", "-o", "wrong", "--quiet");
    BAD(2, "a second method 'same'", "same", "./same/", "--against", "set", "-o", "wrong");
    BAD(2, "--base: found 'other'", "same", "--against", "set", "-o", "wrong", "--base", "other");
    BAD(2, "found no bundle", "same", "--against", "same", "-o", "wrong");
    BAD(2, "found no trunk", "same", "--against", "set", "-o", "wrong", "--lpips", weights[1]);
    BAD(2, "set: is there already", "same", "--against", "set", "-o", "set");
    assert_false(run_is_there("wrong"));
}

/* Right in frame 0, which is given, else off by 5. */
static void first_is_right(uint8_t *rgb, size_t t)
{
    if (t) offset(rgb, t);
}

static void test_without_frame_0(void **state)
{
    const double psnr = 20 * log10(51);
    char all[64], later[64];
    (void)state;
    make_method("later", 2, first_is_right, 1);
    GOOD("later", "same", "--against", "set", "-o", "spans", "--no-report");
    char *text = text_of("spans/tables.md");
    char *with = strstr(text, "## Methods: 4d_vis"), *without = strstr(text, "## Methods, without frame 0: 4d_vis");
    char *pairs = strstr(text, "## Differences from later, without frame 0: 4d_vis");
    assert_true(with && without && pairs && with < without && without < pairs);
    snprintf(all, sizeof all, "| later | 2 | _%.2f_ [", (100 + (T - 1) * psnr) / T);
    snprintf(later, sizeof later, "| later | 2 | _%.2f_ [", psnr);
    CHECK(strstr(with, all) && strstr(with, all) < without, "no %s in %s", all, with);
    CHECK(strstr(without, later) && strstr(without, later) < pairs, "no %s in %s", later, without);
    snprintf(later, sizeof later, "| same | 2 | **%+.2f**", 100 - psnr);
    CHECK(strstr(pairs, later), "no %s in %s", later, pairs);
}

#define DIT "\"dit\": {\"width\": 20, \"heads\": 2, \"layers\": 2, \"ffn\": 27, \"latent\": 24, \"frequencies\": 16}"

/* A model of an autoencoder alone, whose lowest frequencies are all that comes back; frames go in groups of four. */
static void write_codec(void)
{
    static const char model[] = "{\"name\": \"codec\", " DIT ", \"vae\": {\"patch\": 1, \"linear\": true,"
                                "\"multipliers\": [1, 2, 2], \"halve_time\": [true, true],"
                                "\"encoder_width\": 3, \"decoder_width\": 4, \"encoder_blocks\": 1,"
                                "\"decoder_blocks\": 1}}";
    static const char none[] = "{\"name\": \"none\", " DIT "}";
    dar_config c;
    dar_arena a;
    dar_params p;
    dar_vae vae = { 0 };
    dar_vae_blocks blocks;
    dar_err e;
    assert_int_equal(mkdir("codec-model", 0777), 0);
    run_write("codec-model/none.json", none, sizeof none - 1);
    run_write("codec-model/model.json", model, sizeof model - 1);
    CHECK(dar_config_open(&c, "codec-model/model.json", &e) == DAR_OK, "%s", e.text);
    assert_int_equal(dar_arena_init(&a, "weights", 16 << 20, &e), DAR_OK);
    dar_params_init(&p, &a, DAR_F32);
    dar_vae_init(&vae, &p, &c.vae);
    dar_params_fresh(&p, DAR_PARAM_ALL, 1);
    CHECK(dar_vae_blocks_init(&blocks, &vae, H, W, &e) == DAR_OK, "%s", e.text);
    dar_vae_start(&blocks, 1);
    dar_vae_blocks_free(&blocks);
    dar_safetensors_item *item = calloc(p.count, sizeof *item);
    assert_non_null(item);
    for (size_t i = 0; i < p.count; i++) item[i] = (dar_safetensors_item){ p.at[i]->name, p.at[i]->x };
    CHECK(dar_safetensors_write("codec-model/vae.safetensors", item, p.count, NULL, &e) == DAR_OK, "%s", e.text);
    free(item);
    dar_params_free(&p);
    dar_arena_free(&a);
}

/* The row needs nothing but the autoencoder; it is blurred, and nearer to the truth than frame 0; without a model it is
 * missed once. */
static void test_codec(void **state)
{
    (void)state;
    write_codec();
    RUN_PROGRAM(bundler, "synth", "--set", "4d_vis", "--count", "2", "--size", "64x48", "--frames", "9", "-o", "nine");
    CHECK(ran.status == 0, "%s", ran.err);
    GOOD("video=nine", "--against", "nine", "-o", "codec", "--no-report", "--model", "codec-model", "--threads", "3");
    CHECK(!strstr(ran.err, "codec"), "%s", ran.err);
    open_results("codec");
    double psnr = mean_of("codec", "psnr"), sharpness = mean_of("codec", "sharpness");
    CHECK(psnr > mean_of("repeat frame 0", "psnr") && psnr < 60, "PSNR of the codec: %g", psnr);
    CHECK(sharpness > 0.3 && sharpness < 0.95, "sharpness of the codec: %g", sharpness);
    assert_true(dar_json_bool(method_of("codec"), "external", false));
    dar_json_close(doc);
    char *text = text_of("codec/tables.md");
    CHECK(strstr(text, "| codec | 2 |"), "%s", text);
    GOOD("video=nine", "--against", "nine", "-o", "codec-1", "--no-report", "--model", "codec-model", "--threads", "1");
    run_same_file("codec/metrics.json", "codec-1/metrics.json");
    GOOD("same", "--against", "set", "-o", "no-codec", "--no-report");
    const char *once = strstr(ran.err, "no row 'codec'");
    CHECK(once && !strstr(once + 1, "no row 'codec'"), "%s", ran.err);
    BAD(2, "found 11 frames of 64 x 48, expected 1, 5, 9, ... of sides that 4 divides", "same", "--against", "set",
        "-o", "wrong", "--model", "codec-model");
    BAD(2, "found no vae", "same", "--against", "set", "-o", "wrong", "--model", "codec-model/none.json");
    assert_false(run_is_there("wrong"));
}

/* ---------------------------------------------------------------- reference variants */

static void negative(uint8_t *rgb, size_t t)
{
    (void)t;
    for (size_t i = 0; i < VALUES; i++) rgb[i] = (uint8_t)(255 - rgb[i]);
}

static void empty(uint8_t *rgb, size_t t)
{
    (void)t;
    memset(rgb, 90, VALUES);
}

enum { LOOKS = 3, LOOK_FRAMES = 5 };

/* Of each of refvar's clips the truth of the one that is `shift` further, changed. */
static void make_looks(const char *method, size_t shift, change_fn *change)
{
    static uint8_t rgb[VALUES];
    mkdir(method, 0777);
    for (size_t c = 0; c < LOOKS; c++) {
        char path[64];
        dar_bundle *b;
        dar_err e;
        snprintf(path, sizeof path, "looks/%06zu", (c + shift) % LOOKS);
        CHECK(dar_bundle_open(&b, path, &e) == DAR_OK, "%s", e.text);
        snprintf(path, sizeof path, "%s/%06zu", method, c);
        mkdir(path, 0777);
        for (size_t t = 0; t < LOOK_FRAMES; t++) {
            CHECK(dar_bundle_rgb(b, t, rgb, &e) == DAR_OK, "%s", e.text);
            change(rgb, t);
            snprintf(path, sizeof path, "%s/%06zu/%zu.png", method, c, t);
            CHECK(dar_png_write(path, W, H, 3, rgb, &e) == DAR_OK, "%s", e.text);
        }
        dar_bundle_close(b);
    }
}

static double variant_of(const char *method, const char *number)
{
    dar_json j = dar_json_get(dar_json_get(method_of(method), "sets"), "refvar");
    return dar_json_number(dar_json_get(dar_json_get(j, "variants"), number), "mean", NAN, -1e9, 1e9);
}

/* What has the truth's shape in other colours is seen as well as the truth; what shows nothing is not; what shows
 * another's appearance is next to that one. */
static void test_variants(void **state)
{
    double truth = 0;
    (void)state;
    RUN_PROGRAM(bundler, "synth", "--set", "refvar", "--count", "3", "--size", "64x48", "--frames", "5", "-o", "looks");
    CHECK(ran.status == 0, "%s", ran.err);
    make_looks("own", 0, keep);
    make_looks("negative", 0, negative);
    make_looks("empty", 0, empty);
    make_looks("swapped", 1, keep);
    GOOD("own", "negative", "empty", "swapped", "--against", "looks", "-o", "variants", "--no-report");
    open_results("variants");
    for (dar_json j = dar_json_first(dar_json_get(dar_json_root(doc), "clips")); j.item; j = dar_json_next(j))
        truth += dar_json_number(j, "iou_of_truth", NAN, 0, 1) / LOOKS;
    CHECK(truth > 0.5, "IoU of the truth: %g", truth);
    CHECK_NEAR("IoU of its own", variant_of("own", "iou"), truth, 1e-12);
    CHECK_NEAR("IoU of its negative", variant_of("negative", "iou"), truth, 0.02); /* the map is held a little */
    CHECK_NEAR("IoU of nothing", variant_of("empty", "iou"), 0, 0.02);
    CHECK_NEAR("own to own", variant_of("own", "own"), 0, 0);
    CHECK(variant_of("own", "margin") > 1, "all look the same");
    CHECK_NEAR("own is nearest", variant_of("own", "nearest_own"), 1, 0);
    CHECK_NEAR("swapped to another", variant_of("swapped", "other"), 0, 0);
    CHECK_NEAR("swapped to own", variant_of("swapped", "own"), -variant_of("swapped", "margin"), 1e-12);
    CHECK_NEAR("swapped is nearest to own", variant_of("swapped", "nearest_own"), 0, 0);
    dar_json_close(doc);
    char *text = text_of("variants/tables.md");
    CHECK(strstr(text, "## Shape stays, appearance follows: refvar"), "%s", text);
    CHECK(!strstr(text_of("known/tables.md"), "Shape stays"), "variants of 4d_vis");
}

/* Two camera paths are two geometries. */
static void test_no_variants(void **state)
{
    (void)state;
    mkdir("other", 0777);
    mkdir("other/refvar", 0777);
    for (int i = 0; i < 2; i++) {
        char from[32], to[32];
        snprintf(from, sizeof from, "../../set/%s", clip[i]);
        snprintf(to, sizeof to, "other/refvar/%s", clip[i]);
        assert_int_equal(symlink(from, to), 0);
    }
    GOOD("same", "--against", "other/refvar", "-o", "other-out", "--no-report");
    CHECK(strstr(ran.err, "its geometry is not that of"), "%s", ran.err);
    CHECK(!strstr(text_of("other-out/tables.md"), "Shape stays"), "variants of two geometries");
}

static void test_names(void **state)
{
    (void)state;
    GOOD("dar@2000=same", "tracking+normal+depth@2000=offset", "--against", "set", "-o", "names", "--no-report");
    char *text = text_of("names/tables.md");
    CHECK(strstr(text, "World position against depth"), "%s", text);
    text = text_of("names/table.csv");
    CHECK(strncmp(text,
                  "set,mode,seed,step,split,trajectory,clips,psnr,psnr_lo,psnr_hi,ssim,lpips,flip,templ1,refl1\n"
                  "tracking+world+normal,,,2000,4d_vis,all,2,100,100,100,1,,0,",
                  148) == 0,
          "%s", text);
}

/* Published figures stand beside the method of the same channels at the same part of its steps, and no other. */
static void test_beside(void **state)
{
    static const char published[] =
        "set,mode,seed,step,split,trajectory,clips,psnr,psnr_lo,psnr_hi,ssim,lpips,flip,templ1,refl1\n"
        "world+tracking+normal,,,10000,4d_vis,all,68,23.22,,,0.895,0.134,,9.10,38.77\n"
        "tracking+normal+depth,,,10000,4d_vis,all,68,21.80,,,0.861,0.157,,10.12,43.13\n"
        "dar,,,2000,4d_vis,all,68,1.23,,,,,,,\n"
        "depth,,,10000,4d_vis,all,68,1.23,,,,,,,\n"
        "dar,,,10000,ood34,all,34,1.23,,,,,,,\n";
    (void)state;
    run_write("published.csv", published, sizeof published - 1);
    run_write("published.bad", published, sizeof published - 3);
    GOOD("dar@50=same", "tracking+normal+depth@50=offset", "--against", "set", "-o", "beside", "--no-report",
         "--beside", "published.csv");
    char *text = text_of("beside/tables.md");
    CHECK((text = strstr(text, "## Beside published figures: 4d_vis")), "no table");
    CHECK(strstr(text, "| dar@50 | all |  |  | 100.00 | 23.22 | 1.000 | 0.895 |  | 0.134 |"), "%s", text);
    CHECK(strstr(text, "| tracking+normal+depth@50 | all | -") && strstr(text, " | -1.42 | "), "%s", text);
    CHECK(!strstr(text, "1.23"), "what has no partner is shown: %s", text);
    BAD(2, "published.bad: line 6: expected set,mode", "same", "--against", "set", "-o", "wrong", "--beside",
        "published.bad");
    BAD(2, "line 1: expected set,mode", "same", "--against", "set", "-o", "wrong", "--beside", "set/manifest.json");
    assert_false(run_is_there("wrong"));
}

static void test_threads(void **state)
{
    (void)state;
    GOOD("offset", "--against", "set", "-o", "t1", "--no-report", "--threads", "1");
    GOOD("offset", "--against", "set", "-o", "t3", "--no-report", "--threads", "3");
    run_same_file("t1/metrics.json", "t3/metrics.json");
    run_same_file("t1/frames.csv", "t3/frames.csv");
}

/* ---------------------------------------------------------------- the report */

/* Whether the page has id="NAME", NAME up to a quote. */
static bool has_id(const char *page, const char *name)
{
    char id[80];
    size_t n = strcspn(name, "\"");
    snprintf(id, sizeof id, "id=\"%.*s\"", (int)(n < 64 ? n : 64), name);
    return strstr(page, id) != NULL;
}

/* The base64 of the element with this id is a video. */
static void check_film(const char *page, const char *name)
{
    char id[80], *uri;
    unsigned char *data;
    size_t size, length;
    snprintf(id, sizeof id, "<script type=\"text/plain\" id=\"%.*s\">", (int)strcspn(name, "\""), name);
    const char *at = strstr(page, id);
    CHECK(at, "no %s", id);
    at += strlen(id);
    length = strcspn(at, "<");
    assert_non_null(uri = malloc(length + 64));
    assert_non_null(data = malloc(length + 64));
    snprintf(uri, length + 64, "data:video/mp4;base64,%.*s", (int)length, at);
    const char *wrong = dar_uri_decode(uri, data, &size);
    CHECK(!wrong && size > 100 && memcmp(data + 4, "ftyp", 4) == 0, "%s is no video", id);
    free(data);
    free(uri);
}

static void test_report(void **state)
{
    size_t links = 0, films = 0;
    (void)state;
    GOOD("same", "a<b>&c=offset", "--against", "set", "-o", "page", "--masked");
    const char *page = text_of("page/report.html");
    CHECK(!strstr(page, "href=\"http") && !strstr(page, "url(") && !strstr(page, " src="), "something from elsewhere");
    CHECK(strstr(page, "a&lt;b&gt;&amp;c") && !strstr(page, "<b>&c"), "a name is read as HTML");
    for (const char *p = page; (p = strstr(p, "href=\"#")); links++)
        CHECK(has_id(page, p += 7), "%.40s leads nowhere", p);
    for (const char *p = page; (p = strstr(p, "data-film=\"")); films++) check_film(page, p += 11);
    CHECK(links >= 6 && films == 4, "%zu links, %zu films", links, films);
    CHECK(run_is_there("page/sheet.png"), "no sheet");
}

static void noise(uint8_t *rgb, size_t t)
{
    for (size_t i = 0; i < VALUES; i++) rgb[i] = (uint8_t)dar_rng_below(7, t, i, 256);
}

/* Films of noise are made coarser until they have room: seven tenths of 50 kB, of which pictures have three quarters,
 * for two clips. */
static void test_report_size(void **state)
{
    const long long room = 50000 * 7 / 10 * 3 / 4 / 2;
    struct stat st[2];
    (void)state;
    make_method("noise", 2, noise, 1);
    GOOD("noise", "--against", "set", "-o", "wide", "--tile", "64");
    GOOD("noise", "--against", "set", "-o", "narrow", "--tile", "64", "--report-size", "0.05");
    assert_int_equal(stat("wide/clips/00000.mp4", &st[0]), 0);
    assert_int_equal(stat("narrow/clips/00000.mp4", &st[1]), 0);
    CHECK(st[0].st_size > room && st[1].st_size <= room, "%lld and %lld bytes, room for %lld", (long long)st[0].st_size,
          (long long)st[1].st_size, room);
}

/* ---------------------------------------------------------------- people */

/* The page says no name and no clip, and is the same for one seed. */
static void test_study(void **state)
{
    (void)state;
    GOOD("zebra=same", "quagga=offset", "--against", "set", "--study", "zebra:quagga", "-o", "study", "--seed", "1");
    GOOD("zebra=same", "quagga=offset", "--against", "set", "--study", "zebra:quagga", "-o", "again", "--seed", "1");
    run_same_file("study/study.html", "again/study.html");
    run_same_file("study/study-key.json", "again/study-key.json");
    const char *page = text_of("study/study.html");
    static const char *const secret[] = {
        "zebra", "quagga", "000000", "000001", "4d_vis", "dar-eval-", "dolly", "orbit"
    };
    for (size_t i = 0; i < DAR_COUNT(secret); i++) CHECK(!strstr(page, secret[i]), "the page says %s", secret[i]);
    size_t films = 0;
    for (const char *p = page; (p = strstr(p, "data-film=\"")); films++) check_film(page, p += 11);
    CHECK(films == 6, "%zu films", films);
    assert_false(run_is_there("study/film.mp4"));
    bool differs = false;
    for (int seed = 2; seed < 10; seed++) {
        char number[16], out[32], key[64];
        snprintf(number, sizeof number, "%d", seed);
        snprintf(out, sizeof out, "seed%d", seed);
        snprintf(key, sizeof key, "%s/study-key.json", out);
        GOOD("zebra=same", "quagga=offset", "--against", "set", "--study", "zebra:quagga", "-o", out, "--seed", number);
        char *first = strdup(text_of(key));
        differs |= strcmp(first, text_of("study/study-key.json")) != 0;
        free(first);
    }
    CHECK(differs, "the seed changes nothing");
    BAD(2, "expected two methods as NAME:NAME", "same", "--against", "set", "--study", "same:other", "-o", "wrong");
}

/* Somebody who prefers the first method in both trials, whose sides the key tells. */
static void write_answers(const char *path, const char *participant, const char *study)
{
    FILE *f = fopen(path, "w");
    assert_non_null(f);
    fprintf(f, "{\"format\": \"dar-study-answers/1\", \"study\": \"%s\", \"participant\": \"%s\", \"answers\": [",
            study, participant);
    int i = 0;
    for (dar_json j = dar_json_first(dar_json_get(dar_json_root(doc), "trials")); j.item; j = dar_json_next(j), i++)
        fprintf(f, "%s{\"trial\": %d, \"question\": \"motion\", \"choice\": \"%s\", \"seconds\": 2}", i ? "," : "", i,
                strcmp(dar_json_text(j, "left", ""), dar_json_text(j, "first", "")) == 0 ? "left" : "right");
    fputs("]}", f);
    assert_int_equal(fclose(f), 0);
}

static void test_answers(void **state)
{
    dar_err e;
    (void)state;
    GOOD("same", "offset", "--against", "set", "--study", "same:offset", "-o", "asked", "--seed", "5");
    assert_int_equal(dar_json_open(&doc, "asked/study-key.json", &e), DAR_OK);
    const char *study = dar_json_text(dar_json_root(doc), "study", "");
    write_answers("a.json", "ada", study);
    write_answers("b.json", "bob", study);
    write_answers("c.json", "eve", "of something else");
    GOOD("--answers", "a.json", "b.json", "--key", "asked/study-key.json", "-o", "told");
    char *text = text_of("told/answers.md"); /* four of four: p = 2 / 2^4 */
    CHECK(strstr(text, "| same | offset | motion | all | 4 | 100.0 % [100.0, 100.0] | 0.125 |"), "%s", text);
    CHECK(strstr(text, "by camera path"), "%s", text);
    BAD(2, "a second answer of ada", "--answers", "a.json", "a.json", "--key", "asked/study-key.json", "-o", "wrong");
    BAD(2, "expected the study of the key", "--answers", "c.json", "--key", "asked/study-key.json", "-o", "wrong");
    BAD(2, "expected --key", "--answers", "a.json", "-o", "wrong");
    run_write("none.json", "{\"format\": \"dar-study-answers/1\"}", 34);
    BAD(2, "none.json", "--answers", "none.json", "--key", "asked/study-key.json", "-o", "wrong");
    dar_json_close(doc);
}

int main(int argc, char **argv)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_known),    cmocka_unit_test(test_time),
        cmocka_unit_test(test_size),     cmocka_unit_test(test_missing_clips),
        cmocka_unit_test(test_refused),  cmocka_unit_test(test_names),
        cmocka_unit_test(test_beside),   cmocka_unit_test(test_threads),
        cmocka_unit_test(test_report),   cmocka_unit_test(test_study),
        cmocka_unit_test(test_answers),  cmocka_unit_test(test_without_frame_0),
        cmocka_unit_test(test_codec),    cmocka_unit_test(test_report_size),
        cmocka_unit_test(test_variants), cmocka_unit_test(test_no_variants),
    };
    (void)argc;
    if (!run_find(program, argv[0], "dar-eval") || !run_find(bundler, argv[0], "dar-bundle")) return 1;
    return cmocka_run_group_tests(tests, make_all, scratch_leave) != 0;
}
