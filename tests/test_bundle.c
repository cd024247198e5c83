/* test_bundle.c: bundles: what is written comes back within the stated quantum, whole or not at all. */
#include "tests/scratch.h"

#include <dirent.h>
#include <sys/file.h>
#include <sys/time.h>

#include "data/bundle.h"
#include "data/bundle_exr.h"
#include "data/h5.h"
#include "data/tracks.h"
#include "tests/made.h"

#define W      74
#define H      46
#define PIXELS ((size_t)W * H)
#define T      5
#define TRACKS 20

/* ---------------------------------------------------------------- a clip */

/* Two spheres that stand still and a camera that moves; frame 2 equals frame 1, in frame 3 nothing is to be seen. */
typedef struct clip {
    dar_scene scene;
    drawn d[T];
    dar_camera_path cameras;
    dar_world world;
    dar_box box[T];
    size_t tracks;
    float xy[TRACKS * T * 2];
    uint8_t visible[TRACKS * T], color[TRACKS * 3], map[T][3 * PIXELS], rgb[T][3 * PIXELS];
} clip;

static clip made;

static dar_view view_at(int t)
{
    const double eye[3] = { 3 * sin(0.3 * (t == 2 ? 1 : t)), 0.5, 3 * cos(0.3 * (t == 2 ? 1 : t)) };
    const double centre[3] = { 0.2, 0.1, 0 }, away[3] = { 2 * eye[0], 2 * eye[1], 2 * eye[2] };
    return made_view(W, H, eye, t == 3 ? away : centre);
}

static void make_tracks(clip *c)
{
    dar_surface_point point[TRACKS];
    float depth[TRACKS];
    dar_arena *a = &c->d[0].arena;
    c->tracks = dar_tracks_pick(&c->d[0].raster, TRACKS, false, point, a);
    CHECK(c->tracks == TRACKS, "%zu tracks", c->tracks);
    dar_tracks_color(&c->d[0].raster, point, c->tracks, c->color);
    for (size_t t = 0; t < T; t++) {
        dar_tracks_follow(&c->d[t].raster, point, c->tracks, t, T, c->xy, c->visible, depth);
        dar_tracks_map(&c->d[t].raster, c->tracks, t, T, c->xy, c->visible, depth, c->color, 3, c->map[t], a);
    }
}

static void make_clip(clip *c)
{
    double m[12];
    dar_err e;
    dar_raster_config config = dar_raster_default(W, H);
    made_init(&c->scene);
    for (int i = 0; i < 2; i++) {
        made_sheet(&c->scene, 9, 17, false, i ? made_torus : made_sphere, made_material(&c->scene, true));
        memcpy(m, dar_affine_identity, sizeof m);
        for (int k = 0; k < 3; k++) m[5 * k] = 0.5, m[4 * k + 3] = (i ? 0.5 : -0.4) * (k + 1);
        made_instance(&c->scene, i, m);
    }
    ok(dar_camera_init(&c->cameras, T, &e), &e);
    dar_world_init(&c->world);
    for (int t = 0; t < T; t++) {
        c->cameras.view[t] = view_at(t);
        drawn_init(&c->d[t], &c->scene, &config);
        drawn_at(&c->d[t], DAR_NONE, 0, &c->cameras.view[t]);
        dar_world_add(&c->world, c->d[t].raster.position, c->scene.vertices);
        for (size_t i = 0; i < 3 * PIXELS; i++) c->rgb[t][i] = (uint8_t)(i * i * 7 + (size_t)t * 31 + (i >> 5));
    }
    dar_world_finish(&c->world);
    for (int t = 0; t < T; t++)
        for (int k = 0; k < 3; k++) c->box[t].lo[k] = c->world.lo[k] - t, c->box[t].hi[k] = c->world.hi[k] + t;
    make_tracks(c);
}

static dar_bundle_meta meta_of(const clip *c)
{
    static const dar_bundle_object object[] = { { "ball", 1 }, { "ring \"1\"", 3 } };
    return (dar_bundle_meta){ .frames = T,
                              .width = W,
                              .height = H,
                              .fps = 16,
                              .unit = 1,
                              .z_up = true,
                              .world = c->world,
                              .box = c->box,
                              .boxes = T,
                              .object = object,
                              .objects = 2,
                              .source = "made.glb",
                              .prompt = "two \xc3\xb6 shapes",
                              .seed = DAR_BUNDLE_MAX_SEED };
}

static dar_bundle_frame frame_of(const clip *c, size_t t)
{
    return (dar_bundle_frame){ .g = c->d[t].g, .sparse = c->map[t], .rgb = c->rgb[t], .copied = t == 2 };
}

static dar_bundle_options all(void)
{
    dar_bundle_options o = dar_bundle_standard();
    o.families |= 1u << DAR_FAMILY_SPARSE;
    return o;
}

static dar_status write_clip(const clip *c, const char *path, const dar_bundle_options *o, dar_err *e)
{
    dar_bundle_meta m = meta_of(c);
    dar_bundle_writer *w;
    dar_status s = dar_bundle_create(&w, path, &m, &c->cameras, o, e);
    for (size_t t = 0; t < T && s == DAR_OK; t++) {
        dar_bundle_frame f = frame_of(c, t);
        s = dar_bundle_add(w, &f, e);
    }
    if (s == DAR_OK && o->families >> DAR_FAMILY_SPARSE & 1)
        s = dar_bundle_add_tracks(w, c->tracks, c->xy, c->visible, c->color, e);
    if (s == DAR_OK) s = dar_bundle_commit(w, e);
    dar_bundle_discard(w);
    return s;
}

/* ---------------------------------------------------------------- round trips */

/* Every family of every frame: half a quantum, which is 0 for what is kept as it is; then rounding to f32. */
static void check_families(dar_bundle *b, const clip *c, double world_quantum)
{
    static float y[3 * PIXELS];
    static uint32_t n[PIXELS];
    static const float empty[3 * PIXELS];
    dar_err e;
    for (size_t t = 0; t < T; t++) {
        const dar_gbuffer *g = &c->d[t].g;
        const struct {
            dar_family family;
            const float *x;
            double quantum, largest;
        } row[] = {
            { DAR_FAMILY_TRACKING, g->tracking, 1.0 / 65535, 1 },
            { DAR_FAMILY_WORLD, g->world, world_quantum, 4 },
            { DAR_FAMILY_NORMAL, g->normal, 1.0 / 32767, 1 },
            { DAR_FAMILY_DEPTH, g->depth, 0, 0 },
        };
        for (size_t k = 0; k < DAR_COUNT(row); k++) {
            size_t channels = dar_family_table[row[k].family].channels;
            ok(dar_bundle_values(b, row[k].family, t, y, &e), &e);
            for (size_t i = 0; i < channels * PIXELS; i++) {
                double bound = row[k].quantum * (0.5 + 1e-9) + (row[k].quantum > 0 ? row[k].largest * 0x1p-24 : 0);
                CHECK_NEAR(dar_family_table[row[k].family].name, (double)y[i], (double)row[k].x[i],
                           g->mask[i % PIXELS] ? bound : 0);
            }
            if (t == 3) CHECK(memcmp(y, empty, channels * PIXELS * 4) == 0, "frame 3 is not empty");
        }
        ok(dar_bundle_values(b, DAR_FAMILY_MASK, t, y, &e), &e);
        for (size_t i = 0; i < PIXELS; i++) CHECK_NEAR("mask", (double)y[i], g->mask[i], 0);
        ok(dar_bundle_numbers(b, DAR_BUNDLE_ID, t, n, &e), &e);
        CHECK(memcmp(n, g->instance, sizeof n) == 0, "frame %zu: ids changed", t);
        ok(dar_bundle_numbers(b, DAR_BUNDLE_PART, t, n, &e), &e);
        CHECK(memcmp(n, g->part, sizeof n) == 0, "frame %zu: parts changed", t);
    }
}

static void check_pictures(dar_bundle *b, const clip *c)
{
    static uint8_t rgb[3 * PIXELS];
    static float y[3 * PIXELS];
    float xy[TRACKS * T * 2];
    uint8_t visible[TRACKS * T], color[TRACKS * 3];
    dar_err e;
    for (size_t t = 0; t < T; t++) {
        ok(dar_bundle_rgb(b, t, rgb, &e), &e);
        CHECK(memcmp(rgb, c->rgb[t], sizeof rgb) == 0, "frame %zu: picture changed", t);
        ok(dar_bundle_values(b, DAR_FAMILY_SPARSE, t, y, &e), &e);
        for (size_t i = 0; i < 3 * PIXELS; i++) CHECK_NEAR("map", (double)y[i], c->map[t][i] / 255.0, 0x1p-24);
    }
    ok(dar_bundle_reference(b, rgb, &e), &e);
    CHECK(memcmp(rgb, c->rgb[0], sizeof rgb) == 0, "the reference is not frame 0");
    CHECK(b->tracks == c->tracks, "%zu tracks", b->tracks);
    ok(dar_bundle_tracks(b, xy, visible, color, &e), &e);
    CHECK(memcmp(xy, c->xy, sizeof xy) == 0 && memcmp(visible, c->visible, sizeof visible) == 0 &&
              memcmp(color, c->color, sizeof color) == 0,
          "tracks changed");
}

static void check_meta(const dar_bundle *b, const clip *c)
{
    const dar_bundle_meta *m = &b->meta, x = meta_of(c);
    double lo = INFINITY, hi = -INFINITY;
    for (size_t t = 0; t < T; t++)
        for (size_t i = 0; i < PIXELS; i++)
            if (c->d[t].g.mask[i]) lo = fmin(lo, (double)c->d[t].g.depth[i]), hi = fmax(hi, (double)c->d[t].g.depth[i]);
    CHECK(m->frames == T && m->width == W && m->height == H && m->fps == 16 && m->z_up && m->unit == 1, "sizes");
    CHECK(memcmp(&m->world, &c->world, sizeof m->world) == 0, "world");
    CHECK(m->boxes == T && memcmp(m->box, c->box, sizeof c->box) == 0, "boxes");
    CHECK_NEAR("nearest", m->depth[0], lo, 0);
    CHECK_NEAR("farthest", m->depth[1], hi, 0);
    CHECK(m->objects == 2 && strcmp(m->object[1].name, x.object[1].name) == 0 && m->object[1].parts == 3, "objects");
    CHECK(strcmp(m->source, x.source) == 0 && strcmp(m->prompt, x.prompt) == 0 && !m->licence, "texts");
    CHECK(m->seed == x.seed, "seed %llu", (unsigned long long)m->seed);
    for (size_t t = 0; t < T; t++) {
        const dar_view *v = &b->cameras.view[t], *w = &c->cameras.view[t];
        CHECK_NEAR("fx", v->fx, w->fx, 0);
        CHECK_NEAR("near", v->near, w->near, 0);
        for (int k = 0; k < 12; k++) CHECK_NEAR("c2w", v->c2w[k], w->c2w[k], 1e-15);
    }
}

static void round_trip(void **state)
{
    (void)state;
    dar_bundle_options o = all();
    dar_bundle *b;
    dar_err e;
    o.rgb = true;
    ok(write_clip(&made, in_dir("a"), &o, &e), &e);
    ok(dar_bundle_open(&b, in_dir("a"), &e), &e);
    check_meta(b, &made);
    check_families(b, &made, made.world.size / 65535);
    check_pictures(b, &made);
    ok(dar_bundle_verify(b, &e), &e);
    CHECK(run_is_there(in_dir("a/video.mp4")) && run_is_there(in_dir("a/transforms.json")) &&
              run_is_there(in_dir("a/cameras.txt")),
          "video or exports are missing");
    dar_bundle_close(b);

    o.world_f32 = true;
    o.families &= ~(1u << DAR_FAMILY_SPARSE);
    o.rgb = false;
    ok(write_clip(&made, in_dir("f32"), &o, &e), &e);
    ok(dar_bundle_open(&b, in_dir("f32"), &e), &e);
    check_families(b, &made, 0);
    CHECK(!b->rgb && !b->reference && !b->text && b->tracks == 0, "what was not written is said to be there");
    dar_bundle_close(b);
}

/* The same bytes for any number of threads, and again. */
static void same_bytes(void **state)
{
    (void)state;
    static const int threads[] = { 1, 2, 3, 7 };
    dar_bundle_options o = all();
    dar_file_map m, first = { 0 };
    dar_err e;
    int before = dar_threads();
    o.overwrite = true;
    for (size_t i = 0; i < DAR_COUNT(threads); i++) {
        dar_threads_set(threads[i]);
        ok(write_clip(&made, in_dir("threads"), &o, &e), &e);
        ok(dar_file_map_open(&m, in_dir("threads/gbuffer.h5"), &e), &e);
        if (i == 0) first = m;
        CHECK(m.size == first.size && memcmp(m.data, first.data, m.size) == 0, "%d threads: other bytes", threads[i]);
        if (i > 0) dar_file_map_close(&m);
    }
    dar_file_map_close(&first);
    dar_threads_set(before);
}

/* ---------------------------------------------------------------- what the network gets */

static dar_condition condition_of(const char *set)
{
    dar_condition c = { 0 };
    dar_err e;
    ok(dar_channel_set_parse(&c.set, set, &e), &e);
    return c;
}

/* The tensor's last latent frame is frame 4. */
static void condition(void **state)
{
    (void)state;
    enum { N = 3 + 3 + 3 + 1 + 1 };
    static float y[(24 + N) * 2 * PIXELS], q[3 * PIXELS];
    dar_condition c = condition_of("tracking+world+normal+depth+mask");
    dar_bundle_options o = all();
    dar_condition_source s;
    dar_arena scratch;
    dar_bundle *b;
    dar_err e;
    const dar_gbuffer *g = &made.d[4].g;
    ok(dar_arena_init(&scratch, "scratch", (size_t)1 << 20, &e), &e);
    ok(write_clip(&made, in_dir("condition"), &o, &e), &e);
    ok(dar_bundle_open(&b, in_dir("condition"), &e), &e);
    ok(dar_bundle_source(b, &c, &s, &e), &e);
    dar_tensor x = dar_tensor_of(DAR_F32, dar_condition_shape(&c, &b->cameras), y);
    ok(dar_condition_build(&c, &s, &scratch, &x, &e), &e);
    dar_world_normalise(&made.world, g->world, g->mask, PIXELS, q);
    for (size_t i = 0; i < PIXELS; i++) {
        const float *at = y + (24 * 2 + 1) * PIXELS + i;
        double depth = g->mask[i] ? ((double)g->depth[i] - s.depth[0]) / (s.depth[1] - s.depth[0]) : 0;
        for (size_t k = 0; k < 3; k++) {
            double normal = g->mask[i] ? ((double)g->normal[k * PIXELS + i] + 1) / 2 : 0;
            CHECK_NEAR("tracking", (double)at[2 * k * PIXELS], (double)g->tracking[k * PIXELS + i], 0.51 / 65535);
            CHECK_NEAR("world", (double)at[2 * (3 + k) * PIXELS], (double)q[k * PIXELS + i], 0.51 / 65535);
            CHECK_NEAR("normal", (double)at[2 * (6 + k) * PIXELS], normal, 0.26 / 32767);
        }
        CHECK_NEAR("depth", (double)at[2 * 9 * PIXELS], depth, 1e-6);
        CHECK_NEAR("mask", (double)at[2 * 10 * PIXELS], g->mask[i], 0);
    }
    dar_bundle_close(b);
    dar_arena_free(&scratch);
}

/* ---------------------------------------------------------------- bundles of other tools */

#define SIZES "\"format\":\"dar-bundle/1\",\"width\":74,\"height\":46,\"frames\":5,\"fps\":24"

/* Depth and normals in f32, no mask, nothing else said. */
static void of_others(void **state)
{
    (void)state;
    static float y[3 * PIXELS];
    dar_condition c = condition_of("normal"), depth = condition_of("depth"), world = condition_of("dar");
    dar_camera_options o = dar_camera_io_standard();
    dar_h5_array a = { .type = DAR_H5_F32, .rank = 3, .dim = { T, H, W } },
                 n = { .type = DAR_H5_F32, .rank = 4, .dim = { T, 3, H, W } };
    dar_condition_source s;
    dar_bundle *b;
    dar_h5 *f;
    dar_err e;
    CHECK(mkdir(in_dir("others"), 0777) == 0, "mkdir");
    scratch_text(in_dir("others/meta.json"),
                 "{" SIZES ",\"families\":{\"depth\":{\"type\":\"f32\"},\"normal\":{\"type\":\"f32\"}}}");
    ok(dar_camera_io_write(&made.cameras, in_dir("others/cameras.json"), DAR_CAMERA_JSON, &o, &e), &e);
    ok(dar_h5_create(&f, in_dir("others/gbuffer.h5"), &e), &e);
    ok(dar_h5_make(f, "depth", &a, &e), &e);
    ok(dar_h5_make(f, "normal", &n, &e), &e);
    for (size_t t = 0; t < T; t++) {
        ok(dar_h5_write(f, "depth", &a, t, 1, made.d[t].g.depth, &e), &e);
        ok(dar_h5_write(f, "normal", &n, t, 1, made.d[t].g.normal, &e), &e);
    }
    ok(dar_h5_commit(f, &e), &e);
    dar_h5_close(f);

    ok(dar_bundle_open(&b, in_dir("others"), &e), &e);
    for (size_t t = 0; t < T; t++) {
        ok(dar_bundle_values(b, DAR_FAMILY_NORMAL, t, y, &e), &e);
        CHECK(memcmp(y, made.d[t].g.normal, sizeof y) == 0, "frame %zu: normals changed", t);
        ok(dar_bundle_values(b, DAR_FAMILY_MASK, t, y, &e), &e);
        for (size_t i = 0; i < PIXELS; i++) CHECK_NEAR("mask", (double)y[i], made.d[t].g.mask[i], 0);
    }
    ok(dar_bundle_source(b, &c, &s, &e), &e);
    refused(dar_bundle_source(b, &depth, &s, &e), &e, "depth_range: found none, expected it for the channels depth");
    refused(dar_bundle_source(b, &world, &s, &e), &e, "has no tracking; its families: normal, depth");
    refused(dar_bundle_rgb(b, 0, (uint8_t *)y, &e), &e, "has no pictures");
    dar_bundle_close(b);
}

/* What the metadata says and the files are not. */
static void lies(void **state)
{
    (void)state;
    static float y[3 * PIXELS];
    static const struct {
        const char *meta, *says;
    } row[] = {
        { "{\"format\":\"dar-bundle/2\"}", "format: found \"dar-bundle/2\", expected one of dar-bundle/1" },
        { "{" SIZES "}", "has no mask; its families: none" },
        { "{" SIZES ",\"families\":{\"dept\":{}}}", "families.dept: unknown key; did you mean 'depth'?" },
        { "{" SIZES ",\"families\":{\"depth\":{\"type\":\"u16\"}}}", "families.depth.scale: missing" },
        { "{" SIZES ",\"families\":{\"depth\":{\"type\":\"u32\"}}}", "expected u8, u16, i16 or f32" },
        { "{" SIZES ",\"families\":{\"depth\":{\"type\":\"u16\",\"scale\":[1],\"offset\":[0]}}}",
          "gbuffer.h5: depth: found f32[5,46,74], expected u16[5,46,74]" },
        { "{" SIZES ",\"families\":{\"depth\":{\"type\":\"f32\",\"file\":\"exr\"}}}", "exr/00000.exr: No such file" },
        { "{" SIZES ",\"boxes\":[[0,0,0,1,1,1]]}", "boxes: found" },
        { "{" SIZES ",\"world\":{\"center\":[0,0,0],\"size\":1,\"box\":[1,0,0,0,1,1]}}", "lowest x y z, then highest" },
        { "{" SIZES ",\"files\":{\"../a\":{\"bytes\":1}}}", "a name that a bundle's file can have" },
        { "{" SIZES ",\"conventions\":{\"depth\":\"radial\"}}", "expected one of view-z" },
        { "{\"format\":\"dar-bundle/1\",\"width\":74,\"height\":99999,\"frames\":5,\"fps\":24}", "from 1 to 16384" },
        { "{\"format\":\"dar-bundle/1\",\"width\":74,\"height\":46,\"frames\":6,\"fps\":24}",
          "cameras.json: found 5 cameras, expected 6" },
        { "{\"format\":\"dar-bundle/1\",\"width\":75,\"height\":46,\"frames\":5,\"fps\":24}",
          "found pictures of 74 x 46, expected 75 x 46" },
    };
    dar_bundle *b;
    dar_err e;
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        scratch_text(in_dir("others/meta.json"), row[i].meta);
        dar_status s = dar_bundle_open(&b, in_dir("others"), &e);
        if (s == DAR_OK) s = dar_bundle_values(b, DAR_FAMILY_DEPTH, 0, y, &e);
        refused(s, &e, row[i].says);
        CHECK(strstr(e.text, scratch_dir), "names no file: %s", e.text);
        dar_bundle_close(b);
    }
    refused(dar_bundle_open(&b, in_dir("none"), &e), &e, "none: No such file");
    refused(dar_bundle_open(&b, in_dir("others/meta.json"), &e), &e, "found no directory");
    CHECK(!b, "failed, yet open");
}

/* ---------------------------------------------------------------- whole or not at all */

static size_t entries(const char *path)
{
    size_t n = 0;
    DIR *d = opendir(path);
    while (d && readdir(d)) n++;
    if (d) closedir(d);
    return n;
}

static void atomic(void **state)
{
    (void)state;
    dar_bundle_options o = all();
    dar_bundle_meta m = meta_of(&made);
    dar_bundle_writer *w, *other;
    dar_bundle_frame f = frame_of(&made, 0);
    dar_bundle *b;
    dar_err e;
    const char *path = in_dir("once");
    size_t before = entries(scratch_dir);
    ok(dar_bundle_create(&w, path, &m, &made.cameras, &o, &e), &e);
    ok(dar_bundle_add(w, &f, &e), &e);
    CHECK(!run_is_there(path) && entries(scratch_dir) == before + 1, "there before commit");
    ok(dar_bundle_create(&other, path, &m, &made.cameras, &o, &e), &e);
    CHECK(entries(scratch_dir) == before + 2, "one writer swept away another that lives");
    dar_bundle_discard(other);
    dar_bundle_discard(w);
    CHECK(entries(scratch_dir) == before, "something is left");

    ok(write_clip(&made, path, &o, &e), &e);
    refused(write_clip(&made, path, &o, &e), &e, "once: is there already");
    o.overwrite = true;
    o.exports = false;
    ok(write_clip(&made, in_dir("once/"), &o, &e), &e);
    ok(dar_bundle_open(&b, path, &e), &e);
    CHECK(!run_is_there(in_dir("once/cameras.txt")), "not replaced");
    dar_bundle_close(b);
    scratch_text(in_dir("once/thesis.txt"), "the only copy");
    refused(write_clip(&made, path, &o, &e), &e, "holds thesis.txt, which is no part of a bundle");
    CHECK(run_is_there(in_dir("once/thesis.txt")) && entries(scratch_dir) == before + 1,
          "what is left of a refused writer");
}

/* What came to the target's place while a bundle was written is not replaced unasked, be it empty. */
static void race(void **state)
{
    (void)state;
    dar_bundle_options o = all();
    dar_bundle_meta m = meta_of(&made);
    dar_bundle_writer *w[2];
    dar_err e;
    for (int i = 0; i < 2; i++) ok(dar_bundle_create(&w[i], in_dir("race"), &m, &made.cameras, &o, &e), &e);
    for (int i = 0; i < 2; i++)
        for (size_t t = 0; t < T; t++) {
            dar_bundle_frame f = frame_of(&made, t);
            ok(dar_bundle_add(w[i], &f, &e), &e);
        }
    CHECK(mkdir(in_dir("race"), 0777) == 0, "mkdir");
    refused(dar_bundle_commit(w[0], &e), &e, "race: is there already");
    CHECK(rmdir(in_dir("race")) == 0, "an empty directory was replaced");
    ok(dar_bundle_commit(w[1], &e), &e);
    for (int i = 0; i < 2; i++) dar_bundle_discard(w[i]);
    CHECK(run_is_there(in_dir("race/meta.json")), "the winner's bundle is gone");
}

/* A directory that nobody holds locked is what a killed writer leaves. */
static void leftovers(void **state)
{
    (void)state;
    dar_bundle_options o = all();
    dar_err e;
    CHECK(mkdir(in_dir("left.tmp-1-0"), 0777) == 0 && mkdir(in_dir("left.tmp-1-0/exr"), 0777) == 0, "mkdir");
    CHECK(mkdir(in_dir("leftover.tmp-1-0"), 0777) == 0, "mkdir");
    scratch_text(in_dir("left.tmp-1-0/exr/00000.exr"), "half");
    ok(write_clip(&made, in_dir("left"), &o, &e), &e);
    CHECK(!run_is_there(in_dir("left.tmp-1-0")), "the leftover is there");
    CHECK(run_is_there(in_dir("leftover.tmp-1-0")), "another target's is gone");
}

/* A program that writes this clip, killed at any moment. */
static void killed(void **state)
{
    (void)state;
    char delay[16];
    int died = 0, done = 0;
    dar_bundle_options o = all();
    dar_bundle *b;
    dar_err e;
    const char *target = in_dir("killed");
    for (double us = 200; us < 1e7 && done < 1; us *= 1.7) {
        pid_t pid;
        int status;
        snprintf(delay, sizeof delay, "%.0f", us);
        char *argv[] = { "test_bundle", "write", (char *)(uintptr_t)target, delay, NULL };
        CHECK(posix_spawn(&pid, "/proc/self/exe", NULL, NULL, argv, environ) == 0, "spawn");
        CHECK(waitpid(pid, &status, 0) == pid, "wait");
        died += WIFSIGNALED(status) != 0;
        done += WIFEXITED(status) && WEXITSTATUS(status) == 0;
        CHECK(!WIFEXITED(status) || WEXITSTATUS(status) == 0, "the writer failed by itself");
        if (WIFEXITED(status)) CHECK(run_is_there(target), "the writer lived, its bundle is not there");
        if (!run_is_there(target)) continue;
        ok(dar_bundle_open(&b, target, &e), &e);
        ok(dar_bundle_verify(b, &e), &e);
        dar_bundle_close(b);
    }
    CHECK(died >= 3 && done > 0, "%d died, %d lived: the delays do not fit this machine", died, done);
    o.overwrite = true;
    ok(write_clip(&made, target, &o, &e), &e);
    DIR *d = opendir(scratch_dir);
    for (const struct dirent *x; (x = readdir(d));)
        CHECK(strncmp(x->d_name, "killed.tmp-", 11) != 0, "%s is left", x->d_name);
    closedir(d);
}

/* The child of the test above: dies of the signal after so many microseconds. */
static int write_and_die(const char *path, const char *delay)
{
    dar_bundle_options o = all();
    dar_err e;
    long us = strtol(delay, NULL, 10);
    const struct itimerval timer = { .it_value = { us / 1000000, us % 1000000 } };
    o.overwrite = true;
    make_clip(&made);
    setitimer(ITIMER_REAL, &timer, NULL);
    return write_clip(&made, path, &o, &e) != DAR_OK;
}

/* ---------------------------------------------------------------- damage */

static void damaged(void **state)
{
    (void)state;
    dar_bundle_options o = all();
    dar_bundle *b;
    dar_err e;
    o.overwrite = true;
    ok(write_clip(&made, in_dir("hurt"), &o, &e), &e);
    ok(dar_bundle_set_quality(in_dir("hurt"), "{\"ok\": true, \"reasons\": []}", &e), &e);
    ok(dar_bundle_set_quality(in_dir("hurt"), "{\"ok\": false, \"reasons\": [\"dark\"]}", &e), &e);
    ok(dar_bundle_open(&b, in_dir("hurt"), &e), &e);
    ok(dar_bundle_verify(b, &e), &e);
    check_meta(b, &made);

    int fd = open(in_dir("hurt/gbuffer.h5"), O_RDWR);
    unsigned char x;
    CHECK(pread(fd, &x, 1, 4000) == 1, "pread");
    x ^= 1;
    CHECK(pwrite(fd, &x, 1, 4000) == 1, "pwrite");
    refused(dar_bundle_verify(b, &e), &e, "gbuffer.h5: found sha256");
    CHECK(ftruncate(fd, 5000) == 0, "ftruncate");
    refused(dar_bundle_verify(b, &e), &e, "gbuffer.h5: found 5000 bytes");
    close(fd);
    unlink(in_dir("hurt/gbuffer.h5"));
    refused(dar_bundle_values(b, DAR_FAMILY_DEPTH, 0, NULL, &e), &e, "gbuffer.h5: No such file");
    dar_bundle_close(b);
}

/* What no family holds is told where it is. */
static void not_numbers(void **state)
{
    (void)state;
    static float x[3 * PIXELS];
    dar_bundle_options o = dar_bundle_standard();
    dar_bundle_meta m = meta_of(&made);
    dar_bundle_writer *w;
    dar_err e;
    size_t at = 0;
    while (!made.d[0].g.mask[at]) at++;
    static const struct {
        int family;
        float value;
        const char *says;
    } row[] = {
        { DAR_FAMILY_WORLD, NAN, "frame 0: world: found nan at" },
        { DAR_FAMILY_WORLD, 1e6f, "frame 0: world: found 1e+06 at" },
        { DAR_FAMILY_TRACKING, 1.5f, "frame 0: tracking: found 1.5 at" },
        { DAR_FAMILY_NORMAL, -1.1f, "expected -1 to 1" },
        { DAR_FAMILY_DEPTH, INFINITY, "frame 0: depth: found inf at" },
    };
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        char place[64];
        size_t channels = dar_bundle_table[row[i].family].channels;
        dar_bundle_frame f = frame_of(&made, 0);
        float **slot[] = { [DAR_FAMILY_TRACKING] = &f.g.tracking,
                           [DAR_FAMILY_WORLD] = &f.g.world,
                           [DAR_FAMILY_NORMAL] = &f.g.normal,
                           [DAR_FAMILY_DEPTH] = &f.g.depth };
        memcpy(x, *slot[row[i].family], channels * PIXELS * 4);
        x[(channels - 1) * PIXELS + at] = row[i].value;
        *slot[row[i].family] = x;
        snprintf(place, sizeof place, "at column %zu, row %zu", at % W, at / W);
        ok(dar_bundle_create(&w, in_dir("nan"), &m, &made.cameras, &o, &e), &e);
        dar_status s = dar_bundle_add(w, &f, &e);
        refused(s, &e, row[i].says);
        refused(s, &e, place);
        dar_bundle_discard(w);
    }
}

/* ---------------------------------------------------------------- EXR */

/* Written beside, then read as the only source: ZIP is exact. */
static void exr(void **state)
{
    (void)state;
    static float y[3 * PIXELS];
    static uint32_t n[PIXELS];
    dar_bundle_options o = dar_bundle_standard();
    dar_bundle *b;
    dar_err e;
    o.exr = true;
    ok(write_clip(&made, in_dir("exr"), &o, &e), &e);
    ok(dar_bundle_open(&b, in_dir("exr"), &e), &e);
    ok(dar_bundle_verify(b, &e), &e);
    dar_bundle_close(b);
    unlink(in_dir("exr/gbuffer.h5"));
    scratch_text(in_dir("exr/meta.json"), "{" SIZES ",\"families\":{\"depth\":{\"type\":\"f32\",\"file\":\"exr\"},"
                                          "\"normal\":{\"type\":\"f32\",\"file\":\"exr\"},"
                                          "\"mask\":{\"type\":\"u8\",\"file\":\"exr\"},"
                                          "\"tracking\":{\"type\":\"f32\",\"file\":\"exr\"},"
                                          "\"part\":{\"type\":\"u32\",\"file\":\"exr\"},"
                                          "\"world\":{\"type\":\"f32\",\"file\":\"exr\"}}}");
    ok(dar_bundle_open(&b, in_dir("exr"), &e), &e);
    for (size_t t = 0; t < T; t++) {
        const dar_gbuffer *g = &made.d[t].g;
        ok(dar_bundle_values(b, DAR_FAMILY_WORLD, t, y, &e), &e);
        CHECK(memcmp(y, g->world, sizeof y) == 0, "frame %zu: positions changed", t);
        ok(dar_bundle_values(b, DAR_FAMILY_TRACKING, t, y, &e), &e);
        CHECK(memcmp(y, g->tracking, sizeof y) == 0, "frame %zu: tracking changed", t);
        ok(dar_bundle_values(b, DAR_FAMILY_DEPTH, t, y, &e), &e);
        CHECK(memcmp(y, g->depth, 4 * PIXELS) == 0, "frame %zu: depth changed", t);
        ok(dar_bundle_values(b, DAR_FAMILY_NORMAL, t, y, &e), &e);
        for (size_t i = 0; i < 3 * PIXELS; i++) CHECK_NEAR("normal", (double)y[i], (double)g->normal[i], 1e-7);
        ok(dar_bundle_numbers(b, DAR_BUNDLE_PART, t, n, &e), &e);
        CHECK(memcmp(n, g->part, sizeof n) == 0, "frame %zu: parts changed", t);
    }
    dar_bundle_close(b);
}

/* As Blender writes: half colours, far background, averaged normals, ids in floats. */
static void blender(void **state)
{
    (void)state;
    static float z[4] = { 2, 1e10f, 3, 1e10f }, id[4] = { 7, 0, 1, 0 }, n[3][4], y[3][4], depth[4];
    static uint16_t half[4] = { 0x3c00, 0x3800, 0xc000, 0x0001 }; /* 1, 1/2, -2, 2^-24 */
    static uint32_t ids[4];
    static uint8_t mask[4];
    for (int i = 0; i < 4; i++) n[0][i] = 0.3f, n[1][i] = 0, n[2][i] = -0.4f;
    const dar_exr_plane plane[] = {
        { "ViewLayer.Depth.Z", DAR_EXR_F32, z },       { "ViewLayer.IndexOB.X", DAR_EXR_F32, id },
        { "ViewLayer.Normal.X", DAR_EXR_F32, n[0] },   { "ViewLayer.Normal.Y", DAR_EXR_F32, n[1] },
        { "ViewLayer.Normal.Z", DAR_EXR_F32, n[2] },   { "ViewLayer.tracking.R", DAR_EXR_F16, half },
        { "ViewLayer.tracking.G", DAR_EXR_F16, half }, { "ViewLayer.tracking.B", DAR_EXR_F16, half },
    };
    dar_gbuffer g = { .normal = y[0], .depth = depth, .instance = ids, .mask = mask };
    const char *path = in_dir("blender.exr");
    dar_exr *x;
    dar_err e;
    ok(dar_exr_write(path, 2, 2, plane, DAR_COUNT(plane), &(dar_exr_how){ DAR_EXR_ZIP, NULL }, &e), &e);
    ok(dar_exr_open(&x, path, &e), &e);
    unsigned expected = 1u << DAR_FAMILY_DEPTH | 1u << DAR_BUNDLE_ID | 1u << DAR_FAMILY_NORMAL |
                        1u << DAR_FAMILY_TRACKING | 1u << DAR_FAMILY_MASK;
    CHECK(dar_bundle_exr_families(x) == expected, "families %#x", dar_bundle_exr_families(x));
    ok(dar_bundle_exr_read(x, path, &g, &e), &e);
    for (int i = 0; i < 4; i++) {
        bool on = i % 2 == 0;
        CHECK(mask[i] == on && ids[i] == (uint32_t)id[i], "pixel %d: mask %d, id %u", i, mask[i], ids[i]);
        CHECK_NEAR("depth", (double)depth[i], on ? (double)z[i] : 0, 0);
        CHECK_NEAR("normal x", (double)y[0][i], on ? 0.6 : 0, 1e-7);
        CHECK_NEAR("normal z", (double)y[2][i], on ? -0.8 : 0, 1e-7);
    }
    g = (dar_gbuffer){ .tracking = y[0] };
    ok(dar_bundle_exr_read(x, path, &g, &e), &e);
    CHECK_NEAR("half", (double)y[1][0], 1, 0);
    CHECK_NEAR("half", (double)y[1][2], -2, 0);
    g = (dar_gbuffer){ .world = y[0] };
    refused(dar_bundle_exr_read(x, path, &g, &e), &e, "found no channels of world");
    dar_exr_close(x);
}

/* ---------------------------------------------------------------- */

static int set_up(void **state)
{
    (void)state;
    if (scratch_make(state)) return -1;
    make_clip(&made);
    return 0;
}

static int tear_down(void **state)
{
    (void)state;
    run_remove(scratch_dir);
    for (int t = 0; t < T; t++) dar_arena_free(&made.d[t].arena);
    dar_camera_free(&made.cameras);
    dar_scene_free(&made.scene);
    return run_is_there(scratch_dir);
}

int main(int argc, char **argv)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(round_trip), cmocka_unit_test(same_bytes),  cmocka_unit_test(condition),
        cmocka_unit_test(of_others),  cmocka_unit_test(lies),        cmocka_unit_test(atomic),
        cmocka_unit_test(race),       cmocka_unit_test(leftovers),   cmocka_unit_test(killed),
        cmocka_unit_test(damaged),    cmocka_unit_test(not_numbers), cmocka_unit_test(exr),
        cmocka_unit_test(blender),
    };
    if (argc == 4 && strcmp(argv[1], "write") == 0) return write_and_die(argv[2], argv[3]);
    return cmocka_run_group_tests(tests, set_up, tear_down) != 0;
}
