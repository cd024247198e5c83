/* test_dar_bundle.c: the program dar-bundle as people and scripts meet it: files in, files out, exit status, one line
 * for what is wrong. */
#include "tests/glb.h"

#include <dirent.h>
#include <signal.h>
#include <sys/resource.h>
#include <time.h>

#include "data/bundle.h"
#include "data/png.h"
#include "lib/json.h"
#include "tests/scratch.h"

#define W      48
#define H      32
#define T      5
#define PIXELS ((size_t)W * H)

static char program[PATH_MAX];

/* ---------------------------------------------------------------- running it */

#define RUN(...) RUN_PROGRAM(program, __VA_ARGS__)

/* ---------------------------------------------------------------- files */

/* Entries whose names begin with `start`; of a directory. */
static int count(const char *path, const char *begin)
{
    DIR *d = opendir(path);
    int n = 0;
    assert_non_null(d);
    for (const struct dirent *x; (x = readdir(d));)
        n += strncmp(x->d_name, begin, strlen(begin)) == 0 && strcmp(x->d_name, ".") != 0 &&
             strcmp(x->d_name, "..") != 0;
    closedir(d);
    return n;
}

static void same_bundle(const char *a, const char *b)
{
    DIR *d = opendir(a);
    char x[512], y[512];
    assert_non_null(d);
    assert_int_equal(count(a, ""), count(b, ""));
    for (const struct dirent *f; (f = readdir(d));) {
        if (f->d_name[0] == '.') continue;
        snprintf(x, sizeof x, "%s/%s", a, f->d_name);
        snprintf(y, sizeof y, "%s/%s", b, f->d_name);
        run_same_file(x, y);
    }
    closedir(d);
}

/* A number in the JSON that was printed. */
static double printed(const char *object, const char *key)
{
    dar_json_doc *doc;
    dar_err e;
    CHECK(dar_json_parse(&doc, "standard output", ran.out, strlen(ran.out), &e) == DAR_OK, "%s", e.text);
    dar_json j = dar_json_root(doc);
    if (object) j = dar_json_object(j, object);
    double x = dar_json_number(j, key, NAN, -1e300, 1e300);
    dar_json_close(doc);
    return x;
}

/* ---------------------------------------------------------------- a scene */

static glb g;

/* A cube of side 2 that stands, a smaller one that goes round it, a camera 4 in front of the centre, with a field of
 * view whose tangent is 1/2. */
static void write_scene(const char *path, bool broken)
{
    static const float corner[8][3] = { { -1, -1, -1 }, { 1, -1, -1 }, { 1, 1, -1 }, { -1, 1, -1 },
                                        { -1, -1, 1 },  { 1, -1, 1 },  { 1, 1, 1 },  { -1, 1, 1 } };
    static const uint16_t face[36] = { 0, 2, 1, 0, 3, 2, 4, 5, 6, 4, 6, 7, 0, 1, 5, 0, 5, 4,
                                       2, 3, 7, 2, 7, 6, 0, 4, 7, 0, 7, 3, 1, 2, 6, 1, 6, 5 };
    float time[3] = { 0, 0.5f, 1 }, turn[3][4] = { { 0, 0, 0, 1 }, { 0, 1, 0, 0 }, { 0, 0, 0, -1 } };
    if (broken) memset(turn[1], 0xff, sizeof turn[1]); /* NaN */
    memset(&g, 0, sizeof g);
    int p = GLB_F32(&g, 3, corner), i = GLB_U16(&g, 1, face), t = GLB_F32(&g, 1, time), q = GLB_F32(&g, 4, turn);
    GLB_REST(&g, "\"meshes\":[{\"primitives\":[{\"indices\":%d,\"attributes\":{\"POSITION\":%d}}]}],", i, p);
    GLB_REST(&g, "\"cameras\":[{\"type\":\"perspective\",\"perspective\":{\"yfov\":%.17g,\"znear\":0.1}}],",
             2 * atan(0.5));
    GLB_REST(&g, "\"nodes\":[{\"mesh\":0,\"name\":\"body\"},{\"children\":[2],\"name\":\"pivot\"},"
                 "{\"mesh\":0,\"name\":\"moon\",\"translation\":[2,0,0],\"scale\":[0.25,0.25,0.25]},"
                 "{\"camera\":0,\"name\":\"eye\",\"translation\":[0,0,4]}],");
    GLB_REST(&g,
             "\"animations\":[{\"name\":\"turn\",\"channels\":[{\"sampler\":0,\"target\":{\"node\":1,\"path\":"
             "\"rotation\"}}],\"samplers\":[{\"input\":%d,\"output\":%d}]}]",
             t, q);
    glb_finish(&g);
    run_write(path, g.out, g.size);
}

#define SCENE "scene.glb", "--size", "48x32", "--frames", "5", "--fps", "4"

/* ---------------------------------------------------------------- from a scene to a sheet */

static dar_bundle *opened(const char *path)
{
    dar_bundle *b;
    dar_err e;
    dar_status s = dar_bundle_open(&b, path, &e);
    CHECK(s == DAR_OK, "%s", e.text);
    return b;
}

static void from_scene_to_sheet(void **state)
{
    (void)state;
    float depth[PIXELS];
    dar_err e;
    dar_file_map m;
    dar_image im;
    GOOD("render", SCENE, "-o", "eye", "--camera-name", "eye", "--prompt", "two cubes", "--json");
    CHECK_NEAR("frames", printed(NULL, "frames"), T, 0);
    CHECK(printed("seconds", "draw") > 0 && printed("skipped", "triangles") == T * 24, "%s", ran.out);
    dar_bundle *b = opened("eye");
    assert_true(b->meta.frames == T && b->meta.width == W && b->meta.height == H);
    assert_string_equal(b->meta.source, "scene.glb");
    assert_string_equal(b->meta.animation, "turn");
    assert_string_equal(b->meta.prompt, "two cubes");
    assert_int_equal(b->families, (1 << DAR_BUNDLE_FAMILIES) - 1);
    assert_int_equal(b->tracks, 2048);
    assert_int_equal(b->meta.objects, 2);
    assert_string_equal(b->meta.object[1].name, "moon");
    CHECK_NEAR("focal length", b->cameras.view[0].fy, H, 1e-9);
    assert_int_equal(dar_bundle_values(b, DAR_FAMILY_DEPTH, 0, depth, &e), DAR_OK);
    CHECK_NEAR("the cube's front", depth[(H / 2) * W + W / 2], 3, 1e-6);
    CHECK_NEAR("the moon, to the right", depth[(H / 2) * W + W / 2 + 16], 3.75, 1e-6);
    assert_int_equal(dar_bundle_values(b, DAR_FAMILY_DEPTH, 2, depth, &e), DAR_OK); /* half way: to the left */
    CHECK_NEAR("nothing to the right", depth[(H / 2) * W + W / 2 + 16], 0, 0);
    CHECK_NEAR("the moon, to the left", depth[(H / 2) * W + W / 2 - 17], 3.75, 1e-6);
    dar_bundle_close(b);

    GOOD("show", "eye", "-o", "sheet.png", "--columns", "3", "--width", "40", "--json");
    assert_int_equal(dar_file_map_open(&m, "sheet.png", &e), DAR_OK);
    assert_int_equal(dar_image_probe(&im, "sheet.png", m.data, m.size, &e), DAR_OK);
    dar_file_map_close(&m);
    CHECK(printed(NULL, "width") == (double)im.width && printed(NULL, "height") == (double)im.height &&
              printed(NULL, "rows") == DAR_BUNDLE_FAMILIES + 3,
          "%zu x %zu: %s", im.width, im.height, ran.out);

    GOOD("render", "--list-trajectories");
    assert_non_null(strstr(ran.out, "\norbit-60 "));
    GOOD("render", SCENE, "-o", "few", "--trajectory", "full-orbit", "--seed", "7", "--families", "world+id");
    b = opened("few");
    assert_int_equal(b->families, 1 << DAR_FAMILY_WORLD | 1 << DAR_BUNDLE_ID | 1 << DAR_FAMILY_MASK);
    assert_string_equal(b->meta.trajectory, "full-orbit");
    assert_int_equal(b->meta.seed, 7);
    dar_bundle_close(b);
}

static void checked(void **state)
{
    (void)state;
    GOOD("render", "scene.glb", "--size", "160x96", "--frames", "5", "--fps", "4", "-o", "sound", "--trajectory",
         "orbit-30");
    GOOD("check", "sound", "--json");
    CHECK_NEAR("good", printed(NULL, "good"), 1, 0);
    GOOD("check", "sound", "--all", "--record");
    assert_non_null(strstr(ran.out, "position: good"));

    /* Another file than the one that was written: the check says no; a bundle that is none is bad input. */
    GOOD("render", SCENE, "-o", "odd");
    run_write("odd/cameras.txt", "nonsense\n", 9);
    assert_int_equal(RUN("check", "sound", "odd"), 1);
    assert_non_null(strstr(ran.out, "sound: good"));
    assert_non_null(strstr(ran.out, "odd: bad"));
    assert_non_null(strstr(ran.out, "files: bad"));
    assert_int_equal(RUN("check", "nowhere", "sound"), 2);
    assert_non_null(strstr(ran.out, "sound: good"));
    run_write("odd/meta.json", "{", 1);
    assert_int_equal(RUN("check", "odd"), 2);
}

/* ---------------------------------------------------------------- same bits */

static void any_threads(void **state)
{
    (void)state;
    static const char *const name[] = { "one", "two", "three" }, *const threads[] = { "1", "2", "3" };
    for (int i = 0; i < 3; i++) {
        GOOD("render", "scene.glb", "--size", "200x150", "--frames", "5", "--fps", "4", "--seed", "3", "--trajectory",
             "rolling-orbit", "--threads", threads[i], "-o", name[i]);
        if (i) same_bundle("one", name[i]);
    }
    assert_int_equal(RUN("render", SCENE, "-o", "two"), 2); /* it is there */
    same_bundle("one", "two");
    GOOD("render", SCENE, "-o", "two", "--overwrite");
    dar_bundle *b = opened("two");
    assert_int_equal(b->meta.width, W);
    dar_bundle_close(b);
}

/* ---------------------------------------------------------------- what a person brings */

static void fill_picture(uint8_t *rgb, size_t frame)
{
    for (size_t i = 0; i < 3 * PIXELS; i++) rgb[i] = (uint8_t)(i * 7 + frame * 31);
}

static void pictures(void **state)
{
    (void)state;
    static uint8_t rgb[3 * PIXELS], found[3 * PIXELS];
    char name[64];
    dar_err e;
    assert_int_equal(mkdir("frames", 0777), 0);
    for (size_t t = 0; t < T; t++) {
        fill_picture(rgb, t);
        snprintf(name, sizeof name, "frames/%zu.png", 8 + t); /* 9 is before 10 */
        assert_int_equal(dar_png_write(name, W, H, 3, rgb, &e), DAR_OK);
    }
    GOOD("render", SCENE, "-o", "seen", "--rgb", "frames");
    dar_bundle *b = opened("seen");
    assert_true(b->rgb && b->reference);
    for (size_t t = 0; t < T; t++) {
        fill_picture(rgb, t);
        assert_int_equal(dar_bundle_rgb(b, t, found, &e), DAR_OK);
        assert_memory_equal(found, rgb, sizeof rgb);
    }
    dar_bundle_close(b);
    GOOD("show", "seen", "-o", "seen.png", "--width", "32");

    GOOD("render", SCENE, "-o", "referred", "--reference", "frames/9.png");
    b = opened("referred");
    assert_true(!b->rgb && b->reference);
    fill_picture(rgb, 1);
    assert_int_equal(dar_bundle_reference(b, found, &e), DAR_OK);
    assert_memory_equal(found, rgb, sizeof rgb);
    dar_bundle_close(b);
}

/* Pictures of the scene itself: its surfaces where the mask is, the lighting's white elsewhere, the same for any number
 * of threads. */
static void shaded(void **state)
{
    (void)state;
    static uint8_t rgb[3 * PIXELS], reference[3 * PIXELS];
    static float mask[PIXELS];
    dar_err e;
    GOOD("render", SCENE, "-o", "lit", "--shade", "flat", "--sun", "30,40", "--samples", "1", "--threads", "2");
    GOOD("render", SCENE, "-o", "lit1", "--shade", "flat", "--sun", "30,40", "--samples", "1", "--threads", "1");
    dar_bundle *a = opened("lit"), *b = opened("lit1");
    assert_true(a->rgb && a->reference);
    for (size_t t = 0; t < T; t++) {
        size_t surface = 0;
        assert_int_equal(dar_bundle_rgb(a, t, rgb, &e), DAR_OK);
        assert_int_equal(dar_bundle_rgb(b, t, reference, &e), DAR_OK);
        assert_memory_equal(rgb, reference, sizeof rgb);
        assert_int_equal(dar_bundle_values(a, DAR_FAMILY_MASK, t, mask, &e), DAR_OK);
        for (size_t i = 0; i < PIXELS; i++) {
            surface += mask[i] > 0;
            bool white = rgb[3 * i] == 238 && rgb[3 * i + 1] == 238 && rgb[3 * i + 2] == 238;
            CHECK(white == (mask[i] == 0), "frame %zu: pixel %zu is %d %d %d, mask %g", t, i, rgb[3 * i],
                  rgb[3 * i + 1], rgb[3 * i + 2], mask[i]);
        }
        CHECK(surface > PIXELS / 50, "only %zu pixels of surfaces", surface);
    }
    assert_int_equal(dar_bundle_rgb(a, 0, rgb, &e), DAR_OK);
    assert_int_equal(dar_bundle_reference(a, reference, &e), DAR_OK);
    assert_memory_equal(rgb, reference, sizeof rgb);
    dar_bundle_close(a);
    dar_bundle_close(b);
}

/* A camera that stands before a scene at rest: one frame is drawn, the others are copies. */
static void still(void **state)
{
    (void)state;
    FILE *f = fopen("still.txt", "w");
    assert_non_null(f);
    fprintf(f, "url\n");
    for (int t = 0; t < T; t++) fprintf(f, "%d 1 1 0.5 0.5 0 0 1 0 0 0 0 -1 0 0 0 0 -1 5\n", t);
    assert_int_equal(fclose(f), 0);
    GOOD("render", "scene.glb", "--size", "48x32", "--camera", "still.txt", "--pose-size", "0x0", "--animation", "rest",
         "-o", "still", "--json");
    CHECK_NEAR("frames of the camera file", printed(NULL, "frames"), T, 0);
    CHECK_NEAR("copied", printed("skipped", "frames_copied"), T - 1, 0);
    dar_bundle *b = opened("still");
    float first[PIXELS], last[PIXELS];
    dar_err e;
    assert_int_equal(dar_bundle_values(b, DAR_FAMILY_DEPTH, 0, first, &e), DAR_OK);
    assert_int_equal(dar_bundle_values(b, DAR_FAMILY_DEPTH, T - 1, last, &e), DAR_OK);
    CHECK_NEAR("the cube's front", last[(H / 2) * W + W / 2], 4, 1e-6);
    assert_memory_equal(first, last, sizeof first);
    dar_bundle_close(b);
}

/* ---------------------------------------------------------------- conversions */

static void conversions(void **state)
{
    (void)state;
    static const char *const way[] = { "way.txt", "transforms.json", "way.gltf", "way.json" };
    dar_camera_options o = dar_camera_io_standard();
    dar_camera_path x, y;
    dar_err e;
    GOOD("render", SCENE, "-o", "round", "--trajectory", "half-orbit");
    const char *from = "round";
    for (size_t i = 0; i < DAR_COUNT(way); from = way[i++])
        GOOD("convert", from, "-o", way[i], "--size", "48x32", "--fps", "4");
    assert_int_equal(dar_camera_io_read(&x, "round/cameras.json", DAR_CAMERA_JSON, &o, &e), DAR_OK);
    assert_int_equal(dar_camera_io_read(&y, "way.json", DAR_CAMERA_JSON, &o, &e), DAR_OK);
    assert_int_equal(y.frames, T);
    for (size_t t = 0; t < T; t++) {
        CHECK_NEAR("focal length", y.view[t].fx, x.view[t].fx, 1e-4); /* glTF holds f32 */
        for (int k = 0; k < 12; k++) CHECK_NEAR("pose", y.view[t].c2w[k], x.view[t].c2w[k], 1e-5);
    }
    dar_camera_free(&x);
    dar_camera_free(&y);

    /* To EXR and back: the same numbers. */
    static float a[3 * PIXELS], b[3 * PIXELS];
    GOOD("convert", "round", "-o", "round-exr");
    assert_int_equal(count("round-exr", "0000"), T);
    GOOD("convert", "round-exr", "-o", "again", "--camera", "round/cameras.json", "--fps", "4");
    dar_bundle *p = opened("round"), *q = opened("again");
    assert_int_equal(q->families, p->families & ~(1u << DAR_FAMILY_SPARSE));
    for (size_t t = 0; t < T; t++)
        for (int f = 0; f < DAR_FAMILY_SPARSE; f++) {
            memset(a, 0, sizeof a), memset(b, 0, sizeof b);
            assert_int_equal(dar_bundle_values(p, (dar_family)f, t, a, &e), DAR_OK);
            assert_int_equal(dar_bundle_values(q, (dar_family)f, t, b, &e), DAR_OK);
            double bound = f == DAR_FAMILY_NORMAL ? 1e-4 : 0; /* of unit length again, then rounded once more */
            for (size_t i = 0; i < 3 * PIXELS; i++) CHECK_NEAR(dar_family_table[f].name, b[i], a[i], bound);
        }
    dar_bundle_close(p);
    dar_bundle_close(q);
}

/* ---------------------------------------------------------------- what does not work */

static void refusals(void **state)
{
    (void)state;
    static const struct {
        const char *words[12];
        const char *says;
    } bad[] = {
        { { "rendre" }, "did you mean render?" },
        { { "render", "-o", "no" }, "expected SCENE" },
        { { "render", "scene.glb" }, "expected -o BUNDLE" },
        { { "render", "nowhere.glb", "-o", "no" }, "nowhere.glb: No such file" },
        { { "render", "short.glb", "-o", "no" }, "short.glb: " },
        { { "render", "nan.glb", "-o", "no" }, "nan.glb: " },
        { { "render", "junk.glb", "-o", "no" }, "junk.glb: " },
        { { "render", "scene.glb", "-o", "no", "--size", "99999x1" }, "--size: found '99999x1'" },
        { { "render", "scene.glb", "-o", "no", "--trajectory", "orbit" }, "expected one of 34 names" },
        { { "render", "scene.glb", "-o", "no", "--animation", "jump" }, "no animation 'jump'" },
        { { "render", "scene.glb", "-o", "no", "--camera-name", "ear" }, "found no camera 'ear'; there are 1: eye" },
        { { "render", "scene.glb", "-o", "no", "--camera", "junk.glb" }, "junk.glb" },
        { { "render", "scene.glb", "-o", "no", "--camera", "x", "--trajectory", "y" }, "expected one of --camera" },
        { { "render", "scene.glb", "-o", "no", "--families", "wrold" }, "found 'wrold'" },
        { { "render", "scene.glb", "-o", "no", "--rgb", "." }, "PNG and JPEG files, expected 81" },
        { { "render", "scene.glb", "-o", "no", "--reference", "junk.glb" }, "junk.glb: neither a PNG nor a JPEG" },
        { { "render", "scene.glb", "-o", "no", "--shade", "studo" }, "found 'studo', expected a name such as studio" },
        { { "render", "scene.glb", "-o", "no", "--shade", "day", "--sun", "north" }, "--sun: found 'north'" },
        { { "render", "scene.glb", "-o", "no", "--shade", "day", "--rgb", "." }, "expected one of --shade, --rgb" },
        { { "render", "scene.glb", "-o", "no", "--track-side", "2" }, "found 2, expected an odd number" },
        { { "render", "scene.glb", "-o", "scene.glb/no" }, "scene.glb/no: Not a directory" },
        { { "render", "scene.glb", "-o", "scene.glb" }, "scene.glb: is there already" },
        { { "show", "scene.glb", "-o", "no" }, "scene.glb" },
        { { "show", ".", "-o", "no" }, "meta.json" },
        { { "check" }, "expected BUNDLE" },
        { { "check", "." }, "meta.json" },
        { { "convert", ".", "-o", "no" }, "found neither meta.json, of a bundle, nor EXR files" },
        { { "convert", "junk.glb", "-o", "no.json" }, "junk.glb: " },
        { { "convert", "scene.glb", "-o", "no.json" }, "expected --size" },
    };
    write_scene("nan.glb", true);
    write_scene("scene.glb", false);
    run_write("short.glb", g.out, g.size / 2);
    run_write("junk.glb", "glTF what is this", 17);
    for (size_t i = 0; i < DAR_COUNT(bad); i++) {
        int status = run_finish(run_start(program, bad[i].words));
        CHECK(status == 2, "%s %s: status %d: %s", bad[i].words[0], bad[i].says, status, ran.err);
        CHECK(run_one_line(ran.err) && !*ran.out, "%s: more or less than a line: %s%s", bad[i].says, ran.err, ran.out);
        CHECK(strstr(ran.err, bad[i].says), "found:    %sexpected: %s", ran.err, bad[i].says);
        CHECK(count(".", "no") == 0, "%s: something is left", bad[i].says);
    }
    GOOD("render", SCENE, "-o", "no", "--dry-run");
    CHECK(strstr(ran.out, "5 frames of 48 x 32, about") && count(".", "no") == 0, "%s", ran.out);
}

/* ---------------------------------------------------------------- stopped half way */

/* Start a render that would take a minute, and wait until it writes frames: a minute at most, since others may have the
 * processors.  Quiet, for after ten seconds it would tell how far it is. */
static pid_t start_long(void)
{
    pid_t pid =
        run_start(program, (const char *const[]){ "render", "scene.glb", "--size", "320x200", "--frames", "20001", "-o",
                                                  "long", "--trajectory", "full-orbit", "--quiet", NULL });
    for (int i = 0; i < 12000 && count(".", "long") == 0; i++)
        nanosleep(&(struct timespec){ .tv_nsec = 5000000 }, NULL);
    nanosleep(&(struct timespec){ .tv_nsec = 100000000 }, NULL);
    CHECK(waitpid(pid, NULL, WNOHANG) == 0 && count(".", "long.tmp") == 1 && !run_is_there("long"), "it does not run");
    return pid;
}

static void killed(void **state)
{
    (void)state;
    pid_t pid = start_long();
    kill(pid, SIGKILL);
    assert_int_equal(run_finish(pid), 128 + SIGKILL);
    CHECK(!run_is_there("long") && count(".", "long") == 1, "a bundle, or nothing, is left");
    GOOD("render", SCENE, "-o", "long");
    CHECK(run_is_there("long/meta.json") && count(".", "long") == 1, "leftovers");
}

static void interrupted(void **state)
{
    (void)state;
    run_remove("long");
    pid_t pid = start_long();
    kill(pid, SIGINT);
    assert_int_equal(run_finish(pid), 130);
    CHECK(count(".", "long") == 0, "something is left");
    CHECK(run_one_line(ran.err) && strstr(ran.err, "interrupted after "), "%s", ran.err);
}

#define SYNTH "synth", "--count", "6", "--size", "48x32", "--frames", "5", "--seed", "3"

#define FEW "synth", "--count", "1", "--size", "48x32", "--frames", "5", "--seed", "3"

/* A run that is killed when bundle `index` appears. */
static void kill_at(const char *threads, const char *bundle)
{
    pid_t pid = run_start(program, (const char *const[]){ SYNTH, "-o", "torn", "--threads", threads, NULL });
    for (int i = 0; i < 24000 && !run_is_there(bundle); i++) nanosleep(&(struct timespec){ .tv_nsec = 2500000 }, NULL);
    kill(pid, SIGKILL);
    run_finish(pid);
    CHECK(run_is_there(bundle), "%s is not there: %s", bundle, ran.err);
}

static void synthetic(void **state)
{
    struct stat before, after;
    char a[64], b[64];
    (void)state;
    GOOD(SYNTH, "-o", "calm", "--threads", "1", "--sheet", "calm.png");
    CHECK(run_is_there("calm.png"), "no sheet");
    kill_at("2", "torn/000000");
    assert_int_equal(stat("torn/000000/gbuffer.h5", &before), 0);
    kill_at("1", "torn/000003");
    GOOD(SYNTH, "-o", "torn", "--threads", "3", "--json");
    CHECK(printed(NULL, "made") <= 2, "bundles were made again");
    assert_int_equal(stat("torn/000000/gbuffer.h5", &after), 0);
    CHECK(before.st_ino == after.st_ino && before.st_mtim.tv_nsec == after.st_mtim.tv_nsec,
          "a finished bundle changed");
    for (int i = 0; i < 6; i++) {
        snprintf(a, sizeof a, "calm/%06d", i);
        snprintf(b, sizeof b, "torn/%06d", i);
        same_bundle(a, b);
        GOOD("check", b);
    }
    run_same_file("calm/manifest.json", "torn/manifest.json");
    assert_int_equal(count("torn", ""), 7);
    assert_int_equal(count("torn", ".making"), 0);
    run_same_file("calm/manifest.json", "torn/manifest.json");
    assert_int_equal(RUN("synth", "-o", "x", "--set", "4d_vis", "--count", "69"), 2);
    assert_int_equal(RUN("synth", "-o", "x", "--family", "unicorn"), 2);
    CHECK(!run_is_there("x"), "a refused set has a directory");
}

/* A set is gone on with by the command that began it, whatever that left open; another one says what differs. */
static void another_set(void **state)
{
    (void)state;
    static const struct {
        const char *word, *says;
    } other[] = {
        { "--seed=4", "another --set or --seed" }, { "--set=refvar", "another --set or --seed" },
        { "--size=32x32", "another --size" },      { "--frames=6", "another --frames" },
        { "--fps=24", "another --fps" },           { "--family=vehicle", "another --family" },
        { "--coarse", "another --coarse" },
    };
    GOOD(FEW, "-o", "few");
    for (size_t i = 0; i < DAR_COUNT(other); i++) {
        BAD(2, other[i].says, FEW, "--count=2", "-o", "few", other[i].word);
        CHECK(!run_is_there("few/000001"), "%s: a bundle was added", other[i].word);
    }
    GOOD(FEW, "-o", "cars", "--family", "vehicle");
    BAD(2, "cars/000000: found a bundle made with another --family", FEW, "--count=2", "-o", "cars");
    GOOD(FEW, "--count=2", "-o", "cars", "--family", "vehicle");
}

/* Directories that an output is to lie in are made. */
static void new_directories(void **state)
{
    (void)state;
    GOOD("render", SCENE, "-o", "new/one/bundle");
    GOOD(FEW, "-o", "new/two/set");
    CHECK(run_is_there("new/one/bundle/meta.json") && run_is_there("new/two/set/manifest.json"), "nothing is there");
    BAD(2, "scene.glb/set: Not a directory", FEW, "-o", "scene.glb/set");
}

/* While one process, stopped here, is at work in a directory, another leaves it alone. */
static void two_at_once(void **state)
{
    (void)state;
    pid_t pid = run_start(program, (const char *const[]){ SYNTH, "-o", "shared", "--threads", "2", NULL });
    for (int i = 0; i < 24000 && !run_is_there("shared/000000"); i++)
        nanosleep(&(struct timespec){ .tv_nsec = 2500000 }, NULL);
    kill(pid, SIGSTOP);
    int status = RUN(SYNTH, "-o", "shared");
    bool told = run_one_line(ran.err) && strstr(ran.err, "shared: another program is writing there");
    kill(pid, SIGCONT);
    CHECK(status == 2 && told, "status %d: %s", status, ran.err);
    assert_int_equal(run_finish(pid), 0);
    assert_int_equal(count("shared", ""), 7);
    GOOD(SYNTH, "-o", "shared", "--json");
    assert_int_equal((int)printed(NULL, "made"), 0);
}

/* Files may not grow beyond 16 kB: as on a full disk, writing fails half way. */
static void full_disk(void **state)
{
    (void)state;
    struct rlimit old, small;
    assert_int_equal(getrlimit(RLIMIT_FSIZE, &old), 0);
    small = old;
    small.rlim_cur = 1 << 14;
    void (*handler)(int) = signal(SIGXFSZ, SIG_IGN); /* the child inherits both */
    assert_int_equal(setrlimit(RLIMIT_FSIZE, &small), 0);
    pid_t pid = run_start(program, (const char *const[]){ "render", "scene.glb", "-o", "full", NULL });
    assert_int_equal(setrlimit(RLIMIT_FSIZE, &old), 0);
    signal(SIGXFSZ, handler);
    CHECK(run_finish(pid) == 3, "status %d: %s", ran.status, ran.err);
    CHECK(run_one_line(ran.err) && strstr(ran.err, "File too large"), "%s", ran.err);
    CHECK(count(".", "full") == 0, "something is left");
}

/* ---------------------------------------------------------------- */

static int in_directory(void **state)
{
    if (scratch_enter(state) != 0) return -1;
    write_scene("scene.glb", false);
    return 0;
}

int main(int argc, char **argv)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(from_scene_to_sheet),
        cmocka_unit_test(checked),
        cmocka_unit_test(any_threads),
        cmocka_unit_test(pictures),
        cmocka_unit_test(shaded),
        cmocka_unit_test(still),
        cmocka_unit_test(conversions),
        cmocka_unit_test(refusals),
        cmocka_unit_test(killed),
        cmocka_unit_test(interrupted),
        cmocka_unit_test(synthetic),
        cmocka_unit_test(another_set),
        cmocka_unit_test(new_directories),
        cmocka_unit_test(two_at_once),
        cmocka_unit_test(full_disk),
    };
    if (argc < 1 || !run_find(program, argv[0], "dar-bundle")) return 2;
    return cmocka_run_group_tests(tests, in_directory, scratch_leave) != 0;
}
