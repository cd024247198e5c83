/* test_dar_sample.c: the program dar-sample as people and scripts meet it: a small bundle and a small model with random
 * weights in, videos out; what is wrong in one line. */
#include "tests/scratch.h"

#include <glob.h>
#include <signal.h>
#include <time.h>

#include "data/bundle.h"
#include "data/pictures.h"
#include "data/png.h"
#include "data/srgb.h"
#include "data/video.h"
#include "lib/dtype.h"
#include "lib/json.h"
#include "lib/rng.h"
#include "lib/safetensors_write.h"
#include "lib/weights.h"
#include "models/dit.h"
#include "models/lora.h"
#include "models/taew.h"
#include "models/vae.h"

#define W      40
#define H      24
#define T      9
#define PIXELS ((size_t)W * H)

static char program[PATH_MAX], bundler[PATH_MAX];

#define RUN(...) RUN_PROGRAM(program, __VA_ARGS__)

/* The options of nearly every run. */
#define MODEL "--model", "model", "--precision", "f32", "--steps", "2", "--no-mp4"

/* ---------------------------------------------------------------- a model, a bundle */

/* A token is 8 x 8 pixels. */
static const char model[] = "{\"name\": \"small\","
                            "\"dit\": {\"width\": 20, \"heads\": 2, \"layers\": 2, \"ffn\": 27, \"latent\": 5,"
                            "\"frequencies\": 16, \"text_width\": 13, \"text_keys\": 11},"
                            "\"adapter\": {\"geometry\": 3, \"unshuffle\": 4},"
                            "\"vae\": {\"patch\": 1, \"multipliers\": [1, 2, 2], \"halve_time\": [true, true],"
                            "\"encoder_width\": 3, \"decoder_width\": 4, \"encoder_blocks\": 1,"
                            "\"decoder_blocks\": 1},"
                            "\"taew\": {\"encoder_width\": 6, \"decoder_width\": [8, 7, 6, 4]},"
                            "\"condition\": {\"channels\": \"world\", \"geometry_frame\": \"camera0\"}}";

static void write_weights(const char *path, const dar_params *p)
{
    dar_safetensors_item *item = calloc(p->count, sizeof *item);
    dar_err e;
    assert_non_null(item);
    for (size_t i = 0; i < p->count; i++) item[i] = (dar_safetensors_item){ p->at[i]->name, p->at[i]->x };
    CHECK(dar_safetensors_write(path, item, p->count, NULL, &e) == DAR_OK, "%s", e.text);
    free(item);
}

/* Random, none of them zero. */
static void fill(dar_params *p)
{
    dar_params_fresh(p, DAR_PARAM_ALL, 1);
    for (size_t i = 0; i < p->count; i++) {
        dar_param *q = p->at[i];
        if (q->info.law == DAR_FRESH_VALUE)
            dar_rng_fill_uniform(&q->x, 2, i, q->info.spread - 0.2, q->info.spread + 0.2);
    }
}

static void write_model(const char *path)
{
    dar_arena a;
    dar_params dit_params, vae_params, taew_params;
    dar_dit dit = { 0 };
    dar_vae vae = { 0 };
    dar_taew taew = { 0 };
    dar_config c;
    dar_condition condition;
    dar_json_doc *doc;
    dar_err e;
    char name[64];
    assert_int_equal(mkdir(path, 0777), 0);
    snprintf(name, sizeof name, "%s/model.json", path);
    run_write(name, model, sizeof model - 1);
    assert_int_equal(dar_json_open(&doc, name, &e), DAR_OK);
    dar_config_read(&c, dar_json_root(doc));
    dar_condition_read(&condition, dar_json_object(dar_json_root(doc), "condition"));
    CHECK(dar_json_finish(doc, &e) == DAR_OK, "%s", e.text);
    dar_json_close(doc);

    assert_int_equal(dar_arena_init(&a, "weights", 16 << 20, &e), DAR_OK);
    dar_params_init(&dit_params, &a, DAR_F32);
    dar_params_init(&vae_params, &a, DAR_F32);
    dar_dit_init(&dit, &dit_params, &c.dit, &c.adapter);
    dar_vae_init(&vae, &vae_params, &c.vae);
    dar_params_init(&taew_params, &a, DAR_F32);
    dar_taew_init(&taew, &taew_params, &c.taew);
    fill(&taew_params);
    fill(&dit_params);
    fill(&vae_params);
    snprintf(name, sizeof name, "%s/dit.safetensors", path);
    write_weights(name, &dit_params);
    snprintf(name, sizeof name, "%s/vae.safetensors", path);
    write_weights(name, &vae_params);
    snprintf(name, sizeof name, "%s/taew2_2.safetensors", path);
    write_weights(name, &taew_params);
    dar_dit_free(&dit);
    dar_params_free(&taew_params);
    dar_params_free(&dit_params);
    dar_params_free(&vae_params);
    dar_arena_free(&a);
}

/* What training leaves: additions that are not zero, and the adapter beside them, which is the model's own. */
static void write_trained(const char *path)
{
    dar_arena a;
    dar_params p;
    dar_dit dit = { 0 };
    dar_config c;
    dar_json_doc *doc;
    dar_err e;
    char name[64];
    assert_int_equal(mkdir(path, 0777), 0);
    assert_int_equal(dar_json_parse(&doc, "model", model, sizeof model - 1, &e), DAR_OK);
    dar_config_read(&c, dar_json_root(doc));
    dar_json_close(doc);
    assert_int_equal(dar_arena_init(&a, "weights", 16 << 20, &e), DAR_OK);
    dar_params_init(&p, &a, DAR_F32);
    dar_dit_init(&dit, &p, &c.dit, &c.adapter);
    dar_lora_init(&dit, &p, &(dar_lora_config){ .rank = 2, .alpha = 2, .targets = DAR_PROJECTIONS_ALL });
    fill(&p);
    snprintf(name, sizeof name, "%s/lora.safetensors", path);
    CHECK(dar_lora_write(&dit, name, &e) == DAR_OK, "%s", e.text);
    snprintf(name, sizeof name, "%s/adapter.safetensors", path);
    assert_int_equal(symlink("../model/dit.safetensors", name), 0);
    dar_dit_free(&dit);
    dar_params_free(&p);
    dar_arena_free(&a);
}

/* Of the clip's size, or twice as large. */
static void write_picture(const char *path, int shade, size_t times)
{
    uint8_t rgb[12 * PIXELS];
    dar_err e;
    for (size_t i = 0; i < sizeof rgb; i++) rgb[i] = (uint8_t)(i * (size_t)shade);
    assert_int_equal(dar_png_write(path, W * times, H * times, 3, rgb, &e), DAR_OK);
}

static void write_bundles(void)
{
    static const char cube[] = "v -1 -1 -1\nv 1 -1 -1\nv 1 1 -1\nv -1 1 -1\nv -1 -1 1\nv 1 -1 1\nv 1 1 1\nv -1 1 1\n"
                               "f 1 3 2\nf 1 4 3\nf 5 6 7\nf 5 7 8\nf 1 2 6\nf 1 6 5\nf 3 4 8\nf 3 8 7\nf 1 5 8\n"
                               "f 1 8 4\nf 2 3 7\nf 2 7 6\n";
    static const struct {
        const char *name, *size, *frames, *families;
    } made[] = { { "clip", "40x24", "9", "all" }, { "odd", "44x24", "9", "all" },   { "uneven", "40x24", "7", "all" },
                 { "one", "40x24", "1", "all" },  { "long", "40x24", "21", "all" }, { "poor", "40x24", "9", "depth" } };
    run_write("cube.obj", cube, sizeof cube - 1);
    for (size_t i = 0; i < DAR_COUNT(made); i++) {
        int status = RUN_PROGRAM(bundler, "render", "cube.obj", "-o", made[i].name, "--size", made[i].size, "--frames",
                                 made[i].frames, "--families", made[i].families, "--trajectory", "orbit-60");
        CHECK(status == 0, "%s: %s", made[i].name, ran.err);
    }
    assert_int_equal(mkdir("frames", 0777), 0);
    for (int t = 0; t < T; t++) {
        char name[32];
        snprintf(name, sizeof name, "frames/%d.png", t);
        write_picture(name, 3 + t, 1);
    }
    int status =
        RUN_PROGRAM(bundler, "render", "cube.obj", "-o", "seen", "--size", "40x24", "--frames", "9", "--rgb", "frames");
    CHECK(status == 0, "%s", ran.err);
    for (int i = 0; i < 5; i++)
        write_picture((const char *[]){ "a.png", "b.png", "c.png", "d.png", "e.png" }[i], 7 + 4 * i, 1 + (i == 4));
}

/* ---------------------------------------------------------------- what was made */

static double printed(const char *key)
{
    dar_json_doc *doc;
    dar_err e;
    CHECK(dar_json_parse(&doc, "standard output", ran.out, strlen(ran.out), &e) == DAR_OK, "%s", e.text);
    double x = dar_json_number(dar_json_root(doc), key, NAN, -1e300, 1e300);
    dar_json_close(doc);
    return x;
}

/* Of the first bundle. */
static double printed_in(const char *object, const char *key)
{
    dar_json_doc *doc;
    dar_err e;
    CHECK(dar_json_parse(&doc, "standard output", ran.out, strlen(ran.out), &e) == DAR_OK, "%s", e.text);
    dar_json first = dar_json_first(dar_json_array(dar_json_root(doc), "bundles"));
    double x = dar_json_number(dar_json_object(first, object), key, NAN, -1e300, 1e300);
    dar_json_close(doc);
    return x;
}

/* Frames, with what they say of how they were made. */
static void same_files(const char *a, const char *b)
{
    char x[128], y[128];
    for (int t = 0; t < T; t++) {
        snprintf(x, sizeof x, "%s/frames/%05d.png", a, t);
        snprintf(y, sizeof y, "%s/frames/%05d.png", b, t);
        run_same_file(x, y);
    }
}

static bool same_picture(const char *a, const char *b, int t)
{
    static uint8_t rgb[2][3 * PIXELS];
    char path[128];
    dar_err e;
    for (int i = 0; i < 2; i++) {
        snprintf(path, sizeof path, "%s/frames/%05d.png", i ? b : a, t);
        CHECK(dar_pictures_load(path, W, H, rgb[i], &e) == DAR_OK, "%s", e.text);
    }
    return memcmp(rgb[0], rgb[1], sizeof rgb[0]) == 0;
}

static void same_frames(const char *a, const char *b)
{
    for (int t = 0; t < T; t++) CHECK(same_picture(a, b, t), "frame %d of %s and %s", t, a, b);
}

static bool frames_differ(const char *a, const char *b)
{
    return !same_picture(a, b, T - 1);
}

/* ---------------------------------------------------------------- tests */

static void a_video(void **state)
{
    (void)state;
    dar_video_info info;
    dar_video *v;
    dar_err e;
    uint8_t rgb[3 * PIXELS];
    GOOD("seen", "-o", "first", "--model", "model", "--precision", "f32", "--steps", "3", "--mkv", "--json");
    CHECK_NEAR("videos", printed("done"), 1, 0);
    assert_true(run_is_there("first/sheet.png") && run_is_there("first/sample.json"));
    assert_int_equal(dar_video_probe(&info, "first/video.mp4", &e), DAR_OK);
    assert_true(info.frames == T && info.width == W && info.height == H);

    /* The exact video and the pictures are the same. */
    assert_int_equal(dar_video_open(&v, &info, "first/video.mkv", &e), DAR_OK);
    assert_int_equal(info.frames, T);
    assert_int_equal(mkdir("read", 0777), 0);
    assert_int_equal(mkdir("read/frames", 0777), 0);
    for (int t = 0; t < T; t++) {
        char name[64];
        CHECK(dar_video_read(v, rgb, &e) == DAR_OK, "%s", e.text);
        snprintf(name, sizeof name, "read/frames/%05d.png", t);
        assert_int_equal(dar_png_write(name, W, H, 3, rgb, &e), DAR_OK);
    }
    dar_video_close(v);
    same_frames("first", "read");
}

static void any_threads(void **state)
{
    (void)state;
    GOOD("clip", "-o", "t1", MODEL, "--reference", "a.png", "--threads", "1");
    GOOD("clip", "-o", "t2", MODEL, "--reference", "a.png", "--threads", "2");
    GOOD("clip", "-o", "t3", MODEL, "--reference", "a.png", "--threads", "3");
    same_files("t1", "t2");
    same_files("t1", "t3");
    run_same_file("t1/sample.json", "t2/sample.json");
    GOOD("clip", "-o", "t4", MODEL, "--reference", "a.png", "--seed", "43");
    assert_true(frames_differ("t1", "t4"));

    /* What is not skipped changes sums by 1e-15, which 8 bits do not show. */
    GOOD("clip", "-o", "t5", MODEL, "--reference", "a.png", "--precision", "f64");
    GOOD("clip", "-o", "t6", MODEL, "--reference", "a.png", "--precision", "f64", "--skip", "none");
    same_frames("t5", "t6");
}

/* Two bundles and two pictures in one call; each video as if alone.  What is done stays. */
static void batches(void **state)
{
    (void)state;
    GOOD("clip", "seen", "-o", "all", MODEL, "--reference", "a.png", "b.png", "--json");
    CHECK_NEAR("done", printed("done"), 4, 0);
    double prepared = printed_in("flops", "prepare"), steps = printed_in("flops", "sample");
    GOOD("clip", "-o", "alone", MODEL, "--reference", "b.png", "--json");
    CHECK_NEAR("preparing for one or two", printed_in("flops", "prepare"), prepared, 0);
    CHECK_NEAR("sampling one", printed_in("flops", "sample"), steps, 0);
    same_files("all/clip-b", "alone");
    run_same_file("all/clip-b/sample.json", "alone/sample.json");
    assert_true(frames_differ("all/clip-a", "all/clip-b"));

    assert_int_equal(run_remove("all/seen-a"), 0);
    GOOD("clip", "seen", "-o", "all", MODEL, "--reference", "a.png", "--reference", "b.png", "--json");
    CHECK_NEAR("done", printed("done"), 1, 0);
    CHECK_NEAR("kept", printed("kept"), 3, 0);

    BAD(2, "--overwrite", "clip", "-o", "alone", MODEL, "--reference", "a.png");
    GOOD("clip", "-o", "alone", MODEL, "--reference", "a.png", "--overwrite");
    same_frames("all/clip-a", "alone");
}

static void stopped(void **state)
{
    (void)state;
    static const int how[] = { SIGINT, SIGKILL };
    GOOD("seen", "-o", "whole", "--model", "model", "--steps", "60", "--no-mp4");
    for (size_t i = 0; i < DAR_COUNT(how); i++) {
        pid_t pid = run_start(program, (const char *const[]){ "seen", "-o", "cut", "--model", "model", "--steps", "60",
                                                              "--no-mp4", NULL });
        nanosleep(&(struct timespec){ .tv_nsec = 60000000 }, NULL);
        kill(pid, how[i]);
        int status = run_finish(pid);
        CHECK(status == (how[i] == SIGINT ? 130 : 128 + SIGKILL) || status == 0, "status %d: %s", status, ran.err);
        if (status) assert_false(run_is_there("cut/sample.json"));
    }
    GOOD("seen", "-o", "cut", "--model", "model", "--steps", "60", "--no-mp4");
    same_files("whole", "cut");
    run_same_file("whole/sample.json", "cut/sample.json");
}

#define CLIPS    10
#define TEN(out) "clip", "seen", "-o", out, MODEL, "--json", "--reference", "a.png", "b.png", "c.png", "d.png", "e.png"

static size_t found(const char *pattern)
{
    glob_t g;
    size_t n = glob(pattern, GLOB_NOSORT, NULL, &g) == 0 ? g.gl_pathc : 0;
    globfree(&g);
    return n;
}

static void clip_path(char path[64], const char *out, size_t i, const char *member)
{
    static const char *const bundle[] = { "clip", "seen" };
    snprintf(path, 64, "%s/%s-%c%s", out, bundle[i / 5], (char)('a' + (char)(i % 5)), member);
}

/* How many are finished, and which file each is: one that is made again is another. */
static size_t look_at(ino_t seen[CLIPS])
{
    char path[64];
    struct stat st;
    size_t n = 0;
    for (size_t i = 0; i < CLIPS; i++) {
        clip_path(path, "ten", i, "/sample.json");
        ino_t now = stat(path, &st) == 0 ? st.st_ino : 0;
        CHECK(!seen[i] || seen[i] == now, "%s is another", path);
        seen[i] = now;
        n += now != 0;
    }
    return n;
}

/* Ten clips, interrupted by a person and killed by the system, between clips and while the frames of one are written:
 * nothing is done twice, nothing is left over, and all files are those of a run that nobody disturbed. */
static void ten_clips(void **state)
{
    (void)state;
    static const struct {
        int signal, expected;
        bool writing;
    } how[] = { { SIGKILL, 128 + SIGKILL, true },
                { SIGINT, 130, false },
                { SIGINT, 130, true },
                { SIGKILL, 128 + SIGKILL, false } };
    ino_t seen[CLIPS] = { 0 };
    char a[64], b[64];
    size_t done = 0;
    GOOD(TEN("straight"));
    CHECK_NEAR("done", printed("done"), CLIPS, 0);
    for (size_t k = 0; k < DAR_COUNT(how); k++) {
        pid_t pid = run_start(program, (const char *const[]){ TEN("ten"), NULL });
        for (int wait = 0; wait < 40000; wait++) {
            if (look_at(seen) > done && (!how[k].writing || found("ten/*.tmp-*/frames/00001.png"))) break;
            nanosleep(&(struct timespec){ .tv_nsec = 500000 }, NULL);
        }
        kill(pid, how[k].signal);
        int status = run_finish(pid);
        CHECK(status == how[k].expected, "status %d: %s", status, ran.err);
        done = look_at(seen);
    }
    GOOD(TEN("ten"));
    CHECK_NEAR("done", printed("done"), (double)(CLIPS - done), 0);
    CHECK_NEAR("kept", printed("kept"), (double)done, 0);
    look_at(seen);
    GOOD(TEN("ten"));
    CHECK_NEAR("kept", printed("kept"), CLIPS, 0);
    look_at(seen);
    assert_int_equal(found("ten/*"), CLIPS);
    for (size_t i = 0; i < CLIPS; i++) {
        clip_path(a, "straight", i, "");
        clip_path(b, "ten", i, "");
        same_files(a, b);
        clip_path(a, "straight", i, "/sheet.png");
        clip_path(b, "ten", i, "/sheet.png");
        run_same_file(a, b);
        clip_path(a, "straight", i, "/sample.json");
        clip_path(b, "ten", i, "/sample.json");
        run_same_file(a, b);
    }
}

static void solvers_and_noise(void **state)
{
    (void)state;
    static const char *const solver[] = { "ab2", "unipc", "dpm++" };
    for (size_t i = 0; i < DAR_COUNT(solver); i++)
        GOOD("seen", "-o", solver[i], "--model", "model", "--no-mp4", "--no-sheet", "--steps", "3", "--solver",
             solver[i]);
    assert_true(frames_differ("ab2", "unipc") && frames_differ("unipc", "dpm++"));

    GOOD("seen", "-o", "reuse", "--model", "model", "--no-mp4", "--no-sheet", "--steps", "5", "--reuse", "table:2",
         "--json");
    CHECK(strstr(ran.out, "\"steps_reused\": 2"), "%s", ran.out);

    /* Noise of a file: the numbers that the program itself draws give the same video. */
    dar_arena a;
    dar_err e;
    assert_int_equal(dar_arena_init(&a, "noise", 1 << 20, &e), DAR_OK);
    dar_safetensors_item item = { "noise", dar_tensor_push(&a, DAR_F32, DAR_SHAPE(5, 3, H / 4, W / 4)) };
    dar_rng_fill_normal(&item.x, 42, dar_rng_stream("noise"), 1);
    assert_int_equal(dar_safetensors_write("noise.safetensors", &item, 1, NULL, &e), DAR_OK);
    GOOD("clip", "-o", "given", MODEL, "--reference", "a.png", "--noise", "noise.safetensors");
    same_frames("given", "t1");
    GOOD("clip", "-o", "torch", MODEL, "--reference", "a.png", "--noise", "torch");
    assert_true(frames_differ("torch", "t1"));
    item.x = dar_tensor_of(DAR_F32, DAR_SHAPE(5, 2, H / 4, W / 4), item.x.data);
    assert_int_equal(dar_safetensors_write("short.safetensors", &item, 1, NULL, &e), DAR_OK);
    BAD(2, "expected [1, 5, 3, 6, 10]", "clip", "-o", "x", MODEL, "--reference", "a.png", "--noise",
        "short.safetensors");

    /* A prompt matters, through guidance too. */
    item = (dar_safetensors_item){ "text", dar_tensor_push(&a, DAR_F32, DAR_SHAPE(4, 13)) };
    dar_rng_fill_uniform(&item.x, 1, 1, -3, 3);
    assert_int_equal(dar_safetensors_write("text.safetensors", &item, 1, NULL, &e), DAR_OK);
    GOOD("clip", "-o", "told", MODEL, "--reference", "a.png", "--text", "text.safetensors");
    GOOD("clip", "-o", "told1", MODEL, "--reference", "a.png", "--text", "text.safetensors", "--guidance", "1");
    GOOD("clip", "-o", "equal", MODEL, "--reference", "a.png", "--text", "text.safetensors", "--negative",
         "text.safetensors");
    assert_true(frames_differ("told", "t1") && frames_differ("told", "told1"));
    same_frames("equal", "told1");
    dar_arena_free(&a);
}

/* It is there while the video is made, and gone when that is. */
static void preview(void **state)
{
    (void)state;
    dar_image im;
    dar_file_map m;
    dar_err e;
    bool shown = false;
    const char *const words[] = { "seen",    "-o",  "film/",    "--model",   "model",
                                  "--steps", "200", "--no-mp4", "--preview", NULL };
    for (int tries = 0; tries < 5 && !shown; tries++) {
        pid_t pid = run_start(program, words);
        for (int wait = 0; wait < 4000 && !shown; wait++) {
            shown = dar_file_map_open(&m, "film.preview.png", NULL) == DAR_OK;
            nanosleep(&(struct timespec){ .tv_nsec = 500000 }, NULL);
        }
        if (shown) {
            CHECK(dar_png_probe(&im, "preview", m.data, m.size, &e) == DAR_OK, "%s", e.text);
            CHECK(im.width > 200 && im.height > 50, "%zu x %zu", im.width, im.height);
            dar_file_map_close(&m);
        }
        if (tries == 0) kill(pid, SIGINT);
        run_finish(pid);
        assert_false(run_is_there("film.preview.png"));
    }
    CHECK(shown, "never shown: %s", ran.err);
    int status = run_finish(run_start(program, words));
    CHECK(status == 0, "status %d: %s", status, ran.err);
    assert_false(run_is_there("film.preview.png"));
    BAD(2, "--taew FILE", "seen", "-o", "x", MODEL, "--preview", "--weights", "frames", "--dit",
        "model/dit.safetensors", "--vae", "model/vae.safetensors");
    GOOD("clip", "-o", "never", MODEL, "--preview", "--dry-run");
}

/* Additions matter; merged or apart they give the same, and merging is told as saved. */
static void trained(void **state)
{
    (void)state;
    write_trained("trained");
    GOOD("clip", "-o", "l1", MODEL, "--reference", "a.png", "--lora", "trained", "--precision", "f64", "--json");
    CHECK(printed_in("flops_saved", "lora") > 0, "%s", ran.out);
    GOOD("clip", "-o", "l2", MODEL, "--reference", "a.png", "--lora", "trained", "--precision", "f64", "--no-skip",
         "lora");
    same_frames("l1", "l2");
    assert_true(frames_differ("l1", "t1"));
    GOOD("clip", "-o", "l3", MODEL, "--reference", "a.png", "--lora", "trained", "--precision", "int8");
    BAD(2, "frames/lora.safetensors: No such", "clip", "-o", "x", MODEL, "--reference", "a.png", "--lora", "frames");
}

/* 8 bits change little; weights may be drawn; the latent is what frames are decoded from. */
static void precisions(void **state)
{
    (void)state;
    dar_weights *f;
    dar_tensor z;
    dar_err e;
    GOOD("clip", "-o", "p16", "--model", "model", "--steps", "2", "--no-mp4", "--reference", "a.png", "--latent");
    GOOD("clip", "-o", "p8", "--model", "model", "--steps", "2", "--no-mp4", "--reference", "a.png", "--latent",
         "--precision", "int8");
    double sum[2] = { 0 };
    for (int i = 0; i < 2; i++) {
        assert_int_equal(dar_weights_open(&f, i ? "p8/latent.safetensors" : "p16/latent.safetensors", &e), DAR_OK);
        assert_int_equal(dar_weights_tensor(f, "z", &z, &e), DAR_OK);
        static double before[5 * 3 * 60];
        assert_int_equal(dar_tensor_count(&z), DAR_COUNT(before));
        for (size_t k = 0; k < DAR_COUNT(before); k++) {
            double x = dar_dtype_get(z.dtype, z.data, k);
            if (i) sum[0] += (x - before[k]) * (x - before[k]), sum[1] += x * x;
            before[k] = x;
        }
        dar_weights_close(f);
    }
    double off = sqrt(sum[0] / sum[1]);
    printf("note: int8 against bf16, latent of two blocks after two steps: %.1e\n", off);
    CHECK(off > 1e-6, "nothing is rounded");
    CHECK_NEAR("int8", off, 0, 0.05);

    assert_int_equal(mkdir("bare", 0777), 0);
    run_write("bare/model.json", model, sizeof model - 1);
    GOOD("clip", "-o", "drawn", "--model", "bare", "--random", "--steps", "2", "--no-mp4", "--reference", "a.png");
    BAD(2, "--dit FILE", "clip", "-o", "x", "--model", "bare", "--reference", "a.png");
}

/* The first frame is nearly the reference, which is the truth's first. */
static void against_the_truth(void **state)
{
    (void)state;
    dar_json_doc *doc;
    dar_err e;
    GOOD("seen", "-o", "judged", MODEL, "--eval");
    CHECK(dar_json_open(&doc, "judged/metrics.json", &e) == DAR_OK, "%s", e.text);
    dar_json root = dar_json_root(doc), mean = dar_json_object(dar_json_object(root, "mean"), "frame");
    size_t frames = 0;
    double sum = 0;
    for (dar_json x = dar_json_first(dar_json_array(root, "frames")); x.item; x = dar_json_next(x)) {
        sum += dar_json_number(dar_json_object(x, "frame"), "psnr", NAN, 0, 100);
        frames++;
    }
    assert_int_equal(frames, T);
    CHECK_NEAR("mean", dar_json_number(mean, "psnr", NAN, 0, 100), sum / T, 1e-9);
    CHECK(dar_json_number(mean, "refl1", NAN, 0, 255) > 0, "no distance from the reference");
    dar_json_close(doc);
    BAD(2, "no rgb.h5", "clip", "-o", "x", MODEL, "--reference", "a.png", "--eval");
}

static bool holds(const char *path, const char *words)
{
    dar_file_map m;
    assert_int_equal(dar_file_map_open(&m, path, NULL), DAR_OK);
    bool there = memmem(m.data, m.size, words, strlen(words)) != NULL;
    dar_file_map_close(&m);
    return there;
}

/* Colour of the render in linear light, the bundle's depth, matte and ids; how it was made in every file. */
static void layers(void **state)
{
    (void)state;
    static float depth[PIXELS], own[PIXELS], mask[PIXELS];
    static uint32_t id[PIXELS];
    static uint16_t half[PIXELS];
    static uint8_t rgb[3 * PIXELS];
    dar_bundle *b;
    dar_exr *x;
    dar_srgb srgb;
    dar_err e;
    size_t covered = 0;
    GOOD("clip", "-o", "comp", "--model", "model", "--steps", "2", "--reference", "a.png", "--exr", "--mkv");
    static const char *const files[] = { "frames/00000.png", "exr/00008.exr", "video.mp4", "video.mkv" };
    for (size_t i = 0; i < DAR_COUNT(files); i++) {
        char path[64];
        snprintf(path, sizeof path, "comp/%s", files[i]);
        CHECK(holds(path, "\"made_by\": \"dar-sample"), "%s does not tell how it was made", path);
    }
    dar_video_info info;
    CHECK(dar_video_probe(&info, "comp/exr/00004.exr", &e) == DAR_OK && info.width == W, "%s", e.text);
    dar_srgb_init(&srgb);
    assert_int_equal(dar_pictures_load("comp/frames/00004.png", W, H, rgb, &e), DAR_OK);
    assert_int_equal(dar_bundle_open(&b, "clip", &e), DAR_OK);
    CHECK(dar_exr_open(&x, "comp/exr/00004.exr", &e) == DAR_OK, "%s", e.text);
    assert_int_equal(dar_exr_channels(x), 6);
    for (size_t c = 0; c < 4; c++) {
        assert_int_equal(
            dar_exr_read(x, (size_t)dar_exr_find(x, "", (const char *[]){ "R", "G", "B", "A" }[c]), half, &e), DAR_OK);
        assert_int_equal(dar_bundle_values(b, DAR_FAMILY_MASK, 4, mask, &e), DAR_OK);
        for (size_t i = 0; i < PIXELS; i++) {
            double y = c < 3 ? (double)srgb.linear[rgb[3 * i + c]] : (double)mask[i];
            CHECK_NEAR("half", dar_dtype_get(DAR_F16, half, i), y, y / 2048 + 1e-7);
        }
    }
    assert_int_equal(dar_exr_read(x, (size_t)dar_exr_find(x, "depth", "Z"), depth, &e), DAR_OK);
    assert_int_equal(dar_bundle_values(b, DAR_FAMILY_DEPTH, 4, own, &e), DAR_OK);
    assert_memory_equal(depth, own, sizeof depth);
    assert_int_equal(dar_exr_read(x, (size_t)dar_exr_find(x, "id", "X"), id, &e), DAR_OK);
    for (size_t i = 0; i < PIXELS; i++) {
        CHECK((id[i] != 0) == (depth[i] > 0), "pixel %zu", i);
        covered += id[i] != 0;
    }
    CHECK(covered > PIXELS / 20, "only %zu pixels", covered);
    dar_exr_close(x);
    dar_bundle_close(b);
}

/* One window is the plain run; several are another video, whatever the threads. */
static void windows(void **state)
{
    (void)state;
    GOOD("long", "-o", "w0", MODEL, "--reference", "a.png", "--json");
    CHECK(printed_in("flops_saved", "begin") == 0 && printed_in("flops_saved", "held") > 0, "%s", ran.out);
    CHECK(printed_in("flops_saved", "repeat") > 0, "%s", ran.out); /* grey after grey */
    GOOD("long", "-o", "w1", MODEL, "--reference", "a.png", "--window", "21");
    same_frames("w0", "w1");
    GOOD("long", "-o", "w2", MODEL, "--reference", "a.png", "--window", "13", "--threads", "1");
    GOOD("long", "-o", "w3", MODEL, "--reference", "a.png", "--window", "13", "--overlap", "4", "--threads", "2");
    same_frames("w2", "w3");
    assert_true(frames_differ("w0", "w2"));
    GOOD("long", "-o", "never", MODEL, "--window", "13", "--dry-run");
    BAD(2, "expected 9, 13", "long", "-o", "x", MODEL, "--window", "12");
    BAD(2, "up to 8 frames", "long", "-o", "x", MODEL, "--window", "13", "--overlap", "12");
}

static void dry_run(void **state)
{
    (void)state;
    GOOD("clip", "seen", "-o", "never", MODEL, "--dry-run");
    assert_non_null(strstr(ran.out, "GB of memory"));
    assert_non_null(strstr(ran.out, "without skipping scene"));
    assert_false(run_is_there("never"));
    GOOD("--version");
    GOOD("--help");
}

static void refusals(void **state)
{
    (void)state;
    BAD(2, "expected -o DIR", "clip", MODEL);
    BAD(2, "expected --model", "clip", "-o", "x");
    BAD(2, "preset", "clip", "-o", "x", "--model", "nothing");
    static const char blind[] =
        "{ \"name\": \"x\", \"dit\": { \"width\": 20, \"heads\": 2, \"layers\": 1, \"ffn\": 8 } }";
    run_write("blind.json", blind, sizeof blind - 1);
    BAD(2, "no vae", "clip", "-o", "x", "--model", "blind.json");
    BAD(2, "--dit FILE", "clip", "-o", "x", "--model", "wan22-fun-5b");
    BAD(2, "nowhere: No such", "nowhere", "-o", "x", MODEL);
    BAD(2, "expected 1, 5, 9", "uneven", "-o", "x", MODEL, "--reference", "a.png");
    BAD(2, "expected 5, 9, 13", "one", "-o", "x", MODEL, "--reference", "a.png");
    BAD(2, "--reference IMG", "clip", "-o", "x", MODEL);
    BAD(2, "world", "poor", "-o", "x", MODEL, "--reference", "a.png");
    BAD(2, "adapter.geometry 3", "clip", "-o", "x", MODEL, "--channels", "dar");
    BAD(2, "found 'pas'", "clip", "-o", "x", MODEL, "--no-skip", "pas");
    BAD(2, "--reuse: found rule 'table:0'", "clip", "-o", "x", MODEL, "--reuse", "table:0");
    BAD(2, "expected one of them", "clip", "-o", "x", MODEL, "--reuse", "table:2", "--tolerance", "0.1");
    BAD(2, "one name", "clip", "./clip/", "-o", "x", MODEL);
    BAD(2, "one name", "clip", "-o", "x", MODEL, "--reference", "a.png", "--reference", "frames/../a.png");
    assert_int_equal(
        RUN_PROGRAM(bundler, "render", "cube.obj", "-o", "wide", "--size", "44x24", "--frames", "9", "--rgb", "frames"),
        2);
    BAD(2, "--size 48x24", "odd", "-o", "x", MODEL, "--dry-run");
    assert_false(run_is_there("x"));

    /* Weights of another network. */
    BAD(2, "vae.safetensors", "seen", "-o", "x", MODEL, "--dit", "model/vae.safetensors");
}

static int in_directory(void **state)
{
    if (scratch_enter(state) != 0) return 1;
    write_model("model");
    write_bundles();
    return 0;
}

/* ---------------------------------------------------------------- an error budget */

static void write_front(const char *model_name, const char *solver, int steps, double tolerance, double estimate)
{
    char text[1024];
    int n = snprintf(text, sizeof text,
                     "{\"format\": \"dar-front/1\", \"model\": \"%s\", \"safety\": 2, \"kinds\": [{\"name\": "
                     "\"any\", \"scenes\": 3, \"visible\": [0, 1], \"settings\": [{\"name\": \"made\", "
                     "\"precision\": \"f32\", \"solver\": \"%s\", \"steps\": %d, \"tolerance\": %g, "
                     "\"guidance_tolerance\": 0, \"time\": 0.1, \"error\": 0.01, \"estimate\": %g, \"psnr\": 40}]}]}",
                     model_name, solver, steps, tolerance, estimate);
    run_write("model/front.json", text, (size_t)n);
}

#define BUDGET(out, e)                                                                                                 \
    "clip", "-o", out, "--model", "model", "--no-mp4", "--reference", "a.png", "--error-budget", e, "--json"

static bool said(const char *words)
{
    return strstr(ran.out, words) != NULL;
}

static void budgets(void **state)
{
    (void)state;
    remove("model/front.json");
    BAD(2, "front.json", BUDGET("b0", "0.02"));
    write_front("other", "ab2", 4, 1e-12, 1e6);
    BAD(2, "expected \"small\"", BUDGET("b0", "0.02"));

    /* Twice the error is the bound. */
    write_front("small", "ab2", 4, 1e-12, 1e6);
    GOOD(BUDGET("b1", "0.02"));
    CHECK(said("\"setting\": \"made\"") && said("\"fell_back\": false"), "%s", ran.out);
    GOOD("clip", "-o", "b2", "--model", "model", "--no-mp4", "--reference", "a.png", "--precision", "f32", "--solver",
         "ab2", "--steps", "4");
    same_frames("b1", "b2");
    GOOD(BUDGET("b3", "0.019"));
    CHECK(said("\"setting\": \"full\""), "%s", ran.out);
    GOOD("clip", "-o", "b4", "--model", "model", "--no-mp4", "--reference", "a.png", "--precision", "f32");
    same_frames("b3", "b4");
    assert_true(frames_differ("b1", "b3"));

    /* A run that is estimated to be off by more than any was is done again; Euler's goes on without long steps. */
    write_front("small", "ab2", 4, 1e-12, 1e-9);
    GOOD(BUDGET("b5", "0.02"));
    CHECK(said("\"fell_back\": true"), "%s", ran.out);
    same_frames("b5", "b4");
    write_front("small", "euler", 50, 1, 1e6);
    GOOD(BUDGET("b6", "0.02"));
    assert_true(frames_differ("b6", "b4"));
    write_front("small", "euler", 50, 1, 1e-30);
    GOOD(BUDGET("b7", "0.02"));
    CHECK(said("\"fell_back\": false"), "%s", ran.out);
    same_frames("b7", "b4");
}

int main(int argc, char **argv)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(a_video), cmocka_unit_test(any_threads),       cmocka_unit_test(batches),
        cmocka_unit_test(stopped), cmocka_unit_test(ten_clips),         cmocka_unit_test(solvers_and_noise),
        cmocka_unit_test(layers),  cmocka_unit_test(against_the_truth), cmocka_unit_test(trained),
        cmocka_unit_test(preview), cmocka_unit_test(precisions),        cmocka_unit_test(windows),
        cmocka_unit_test(dry_run), cmocka_unit_test(budgets),           cmocka_unit_test(refusals),
    };
    if (argc < 1 || !run_find(program, argv[0], "dar-sample") || !run_find(bundler, argv[0], "dar-bundle")) return 2;
    return cmocka_run_group_tests_name("dar-sample", tests, in_directory, scratch_leave) != 0;
}
