/* test_quality.c: a sound bundle passes every check; one that is damaged in a known way fails the check for that, and
 * no other that the damage does not reach. */
#include "tests/scratch.h"

#include "data/h5.h"
#include "data/png.h"
#include "data/quality.h"
#include "data/rays.h"
#include "data/rigid.h"
#include "data/tracks.h"
#include "lib/json.h"
#include "tests/made.h"

enum { W = 96, H = 64, T = 9, P = W * H, N = 120, OBJECTS = 3 };

#define BIT(name) (1u << DAR_QUALITY_##name)

static char bundle[64];

/* ---------------------------------------------------------------- a clip in memory */

/* What is written; damage changes it. */
typedef struct clip {
    float tracking[T][3 * P], world[T][3 * P], normal[T][3 * P], depth[T][P];
    uint32_t id[T][P], part[T][P];
    uint8_t mask[T][P], rgb[T][3 * P];
    float xy[N][T][2];
    uint8_t visible[N][T], color[N][3];
    dar_camera_path cameras;
    dar_box box[T];
    dar_bundle_object object[OBJECTS];
    dar_bundle_meta meta;
    dar_bundle_options options;
    bool tracks;
} clip;

static clip *sound, *hurt;
static dar_camera_path paths[2]; /* of sound, of hurt */

static void build(dar_scene *s)
{
    const double right[12] = { 0.6, 0, 0, 1.6, 0, 0.6, 0, 0.3, 0, 0, 0.6, -0.4 },
                 high[12] = { 0.5, 0, 0, -1.2, 0, 0.5, 0, 0.9, 0, 0, 0.5, 0.5 };
    made_init(s);
    made_sheet(s, 24, 36, true, made_torus, made_material(s, false));
    made_sheet(s, 20, 28, false, made_sphere, made_material(s, false));
    made_instance(s, 0, NULL);
    made_instance(s, 1, right);
    made_instance(s, 1, high);
}

static void add_box(dar_box *b, dar_world *w, const float *x, size_t n)
{
    for (int c = 0; c < 3; c++) b->lo[c] = INFINITY, b->hi[c] = -INFINITY;
    for (size_t i = 0; i < 3 * n; i++) {
        b->lo[i % 3] = fmin(b->lo[i % 3], (double)x[i]);
        b->hi[i % 3] = fmax(b->hi[i % 3], (double)x[i]);
    }
    dar_world_add(w, x, n);
}

/* Instance 1 rises, the camera goes around; the picture is the normal, over grey. */
static void draw_frame(clip *x, dar_scene *s, drawn *d, dar_surface_point *point, size_t t)
{
    const double angle = 0.1 * (double)t, eye[3] = { 6 * sin(angle), 2, 6 * cos(angle) }, at[3] = { 0, 0.2, 0 };
    dar_view *v = &x->cameras.view[t];
    *v = made_view(W, H, eye, at);
    s->node[s->instance[1].node].matrix[7] = 0.3 + 0.05 * (double)t;
    drawn_at(d, DAR_NONE, 0, v);
    add_box(&x->box[t], &x->meta.world, d->raster.position, s->vertices);
    if (t == 0) {
        assert_int_equal(dar_tracks_pick(&d->raster, N, false, point, &d->arena), N);
        dar_tracks_color(&d->raster, point, N, x->color[0]);
    }
    dar_tracks_follow(&d->raster, point, N, t, T, x->xy[0][0], x->visible[0], NULL);
    memcpy(x->tracking[t], d->g.tracking, sizeof x->tracking[t]);
    memcpy(x->world[t], d->g.world, sizeof x->world[t]);
    memcpy(x->normal[t], d->g.normal, sizeof x->normal[t]);
    memcpy(x->depth[t], d->g.depth, sizeof x->depth[t]);
    memcpy(x->id[t], d->g.instance, sizeof x->id[t]);
    memcpy(x->part[t], d->g.part, sizeof x->part[t]);
    memcpy(x->mask[t], d->g.mask, sizeof x->mask[t]);
    for (size_t i = 0; i < 3 * P; i++)
        x->rgb[t][i] = x->mask[t][i / 3] ? (uint8_t)(127 + 120 * x->normal[t][i % 3 * P + i / 3]) : 90;
}

static void make_sound(clip *x)
{
    dar_scene s;
    drawn d;
    dar_surface_point point[N];
    dar_raster_config c = dar_raster_default(W, H);
    build(&s);
    drawn_init(&d, &s, &c);
    assert_int_equal(dar_camera_init(&paths[0], T, NULL), DAR_OK);
    assert_int_equal(dar_camera_init(&paths[1], T, NULL), DAR_OK);
    x->cameras = paths[0];
    x->meta = (dar_bundle_meta){ .frames = T, .width = W, .height = H, .fps = 24, .boxes = T, .objects = OBJECTS };
    dar_world_init(&x->meta.world);
    for (size_t t = 0; t < T; t++) draw_frame(x, &s, &d, point, t);
    dar_world_finish(&x->meta.world);
    for (size_t i = 0; i < OBJECTS; i++)
        x->object[i] = (dar_bundle_object){ "object", d.identity.mesh[s.instance[i].mesh].parts };
    x->options = dar_bundle_standard();
    x->options.overwrite = true;
    x->tracks = true;
    dar_arena_free(&d.arena);
    dar_scene_free(&s);
}

static void copy_clip(clip *to, const clip *from)
{
    memcpy(to, from, sizeof *to);
    to->cameras = paths[1];
    memcpy(to->cameras.view, from->cameras.view, T * sizeof *to->cameras.view);
}

static void write_clip(clip *x)
{
    dar_bundle_writer *w;
    dar_err e = { "" };
    x->meta.box = x->meta.boxes ? x->box : NULL;
    x->meta.object = x->meta.objects ? x->object : NULL;
    ok(dar_bundle_create(&w, bundle, &x->meta, &x->cameras, &x->options, &e), &e);
    for (size_t t = 0; t < T; t++) {
        dar_bundle_frame f = { .g = { .tracking = x->tracking[t],
                                      .world = x->world[t],
                                      .normal = x->normal[t],
                                      .depth = x->depth[t],
                                      .instance = x->id[t],
                                      .part = x->part[t],
                                      .mask = x->mask[t] },
                               .rgb = x->options.rgb ? x->rgb[t] : NULL };
        ok(dar_bundle_add(w, &f, &e), &e);
    }
    if (x->tracks) ok(dar_bundle_add_tracks(w, N, x->xy[0][0], x->visible[0], x->color[0], &e), &e);
    ok(dar_bundle_commit(w, &e), &e);
    dar_bundle_discard(w);
}

static void check(dar_quality *q)
{
    dar_bundle *b;
    dar_err e = { "" };
    ok(dar_bundle_open(&b, bundle, &e), &e);
    ok(dar_quality_check(q, b, &e), &e);
    dar_bundle_close(b);
}

/* ---------------------------------------------------------------- damage */

static void lower_camera(clip *x) /* below the ground, where it still sees everything as it is drawn */
{
    for (size_t t = 0; t < T; t++) {
        x->box[t].lo[1] = 2.5;
        x->box[t].hi[1] = 2.6;
    }
}

static void no_tracking(clip *x)
{
    for (size_t i = 0, n = 0; i < P && n < 7; i++)
        for (size_t c = 0; c < 3 && x->mask[4][i]; c++) x->tracking[4][c * P + i] = 0, n += c == 2;
}

static void empty_frame(clip *x)
{
    memset(x->mask[4], 0, sizeof x->mask[4]);
    for (size_t i = 0; i < N; i++) x->visible[i][4] = 0;
}

static void far_plane(clip *x)
{
    x->cameras.view[3].near = 5.5;
}

static void small_box(clip *x)
{
    x->box[5].hi[0] -= 0.5;
}

static void false_bounds(clip *x)
{
    x->meta.world.lo[1] -= 10;
}

static void other_lens(clip *x)
{
    x->cameras.view[2].fx *= 1.001;
}

static void radial_depth(clip *x)
{
    const dar_view *v = &x->cameras.view[1];
    for (size_t i = 0; i < P; i++) {
        double o[3], d[3], along = 0;
        dar_rays_at(v, (double)(i % W) + 0.5, (double)(i / W) + 0.5, o, d);
        for (int c = 0; c < 3; c++) along += v->c2w[4 * c + 2] * d[c];
        x->depth[1][i] /= (float)along;
    }
}

static void swap_bytes(void *a, void *b, size_t n)
{
    unsigned char *x = a, *y = b, z;
    for (size_t i = 0; i < n; i++) z = x[i], x[i] = y[i], y[i] = z;
}

static void swap_frames(clip *x)
{
    swap_bytes(x->tracking[2], x->tracking[6], sizeof x->tracking[2]);
    swap_bytes(x->world[2], x->world[6], sizeof x->world[2]);
    swap_bytes(x->normal[2], x->normal[6], sizeof x->normal[2]);
    swap_bytes(x->depth[2], x->depth[6], sizeof x->depth[2]);
    swap_bytes(x->id[2], x->id[6], sizeof x->id[2]);
    swap_bytes(x->part[2], x->part[6], sizeof x->part[2]);
    swap_bytes(x->mask[2], x->mask[6], sizeof x->mask[2]);
    swap_bytes(&x->box[2], &x->box[6], sizeof x->box[2]);
    for (size_t i = 0; i < N; i++) x->visible[i][2] = x->visible[i][6] = 0;
}

static void short_normals(clip *x)
{
    for (size_t i = 0; i < 3 * P; i++) x->normal[7][i] *= 0.99f;
}

static void camera_normals(clip *x)
{
    for (size_t i = 0; i < T * P; i++) {
        const double *m = x->cameras.view[i / P].c2w;
        float *n = x->normal[i / P] + i % P;
        const double w[3] = { (double)n[0], (double)n[P], (double)n[2 * P] };
        for (size_t c = 0; c < 3; c++) n[c * P] = (float)(m[c] * w[0] + m[4 + c] * w[1] + m[8 + c] * w[2]);
    }
}

static void swap_ids(clip *x)
{
    for (size_t i = 0; i < P; i++) x->id[4][i] = x->id[4][i] == 2 ? 3 : x->id[4][i] == 3 ? 2 : x->id[4][i];
}

static void swap_colours(clip *x) /* of parts 0 and 1, side by side in x, in one frame */
{
    for (size_t i = 0; i < P; i++) {
        if (x->part[4][i] == 1) x->tracking[4][i] += 0.5f;
        if (x->part[4][i] == 2) x->tracking[4][i] -= 0.5f;
    }
}

static void turn_tracks(clip *x)
{
    for (size_t i = 0; i < N; i++) {
        uint8_t red = x->color[i][0];
        x->color[i][0] = x->color[i][1], x->color[i][1] = x->color[i][2], x->color[i][2] = red;
    }
}

static void black_frame(clip *x)
{
    x->options.rgb = true;
    memset(x->rgb[6], 1, sizeof x->rgb[6]);
}

static void one_colour(clip *x)
{
    x->meta.objects = 0;
    x->tracks = false;
    for (size_t i = 0; i < 3 * T * P; i++) x->tracking[i / (3 * P)][i % (3 * P)] = 0.4f;
}

static void one_normal(clip *x)
{
    for (size_t i = 0; i < T * P; i++)
        for (size_t c = 0; c < 3; c++) x->normal[i / P][c * P + i % P] = c == 2;
}

static void one_depth(clip *x)
{
    for (size_t i = 0; i < T * P; i++) x->depth[i / P][i % P] = 6;
}

static void one_place(clip *x)
{
    for (size_t i = 0; i < 3 * T * P; i++) x->world[i / (3 * P)][i % (3 * P)] = 0.1f;
}

static const struct {
    const char *name;
    void (*damage)(clip *x);
    unsigned bad;
    size_t frame; /* of the first of them; T: whichever */
} damages[] = {
    { "camera below the ground", lower_camera, BIT(PATH) | BIT(BOUNDS), 0 },
    { "pixels without identity", no_tracking, BIT(MASK) | BIT(IDENTITY), 4 },
    { "a frame without anything", empty_frame, BIT(COVERAGE), 4 },
    { "near plane in the scene", far_plane, BIT(PATH) | BIT(DEPTH), 3 },
    { "a box that is too small", small_box, BIT(BOUNDS), 5 },
    { "bounds beyond the normalisation", false_bounds, BIT(SCALE), DAR_QUALITY_CLIP },
    { "another lens", other_lens, BIT(POSITION), 2 },
    { "radial depth", radial_depth, BIT(POSITION), 1 },
    { "two frames changed places", swap_frames, BIT(POSITION) | BIT(ORDER), 2 },
    { "normals that are short", short_normals, BIT(NORMAL), 7 },
    { "normals in the camera", camera_normals, BIT(SLOPE), DAR_QUALITY_CLIP },
    { "instances changed places", swap_ids, BIT(IDENTITY), 4 },
    { "colours changed places", swap_colours, BIT(IDENTITY), 4 },
    { "tracks of other colours", turn_tracks, BIT(TRACKS), DAR_QUALITY_CLIP },
    { "a black picture", black_frame, BIT(UNIFORM_RGB), 6 },
    { "one colour", one_colour, BIT(UNIFORM_TRACKING), DAR_QUALITY_CLIP },
    { "one normal", one_normal, BIT(SLOPE) | BIT(UNIFORM_NORMAL), DAR_QUALITY_CLIP },
    { "one depth", one_depth, BIT(POSITION) | BIT(SLOPE) | BIT(UNIFORM_DEPTH), T },
    { "one place", one_place, BIT(POSITION) | BIT(UNIFORM_WORLD), T },
};

static void expect(const char *what, const dar_quality *q, unsigned bad)
{
    char text[DAR_QUALITY_TEXT];
    for (int i = 0; i < DAR_QUALITY_CHECKS; i++) {
        bool found = q->result[i].state == DAR_QUALITY_BAD;
        if (found != (bad >> i & 1))
            fail_msg("%s: expected %s: %s", what, bad >> i & 1 ? "bad" : "not bad",
                     dar_quality_text(q, (dar_quality_name)i, text));
    }
}

static void damaged(void **state)
{
    (void)state;
    unsigned reached = 0;
    for (size_t i = 0; i < DAR_COUNT(damages); i++) {
        dar_quality q;
        char text[DAR_QUALITY_TEXT];
        copy_clip(hurt, sound);
        damages[i].damage(hurt);
        write_clip(hurt);
        check(&q);
        expect(damages[i].name, &q, damages[i].bad);
        int first = __builtin_ctz(damages[i].bad);
        CHECK(damages[i].frame == T || q.result[first].frame == damages[i].frame,
              "%s: worst frame %zu, expected %zu: %s", damages[i].name, q.result[first].frame, damages[i].frame,
              dar_quality_text(&q, (dar_quality_name)first, text));
        reached |= damages[i].bad;
    }
    /* The three others take files that were changed after writing. */
    assert_int_equal(reached | BIT(FILES) | BIT(REFERENCE) | BIT(FINITE), (1u << DAR_QUALITY_CHECKS) - 1);
}

/* ---------------------------------------------------------------- files that were changed after writing */

static void change_byte(const char *member)
{
    char path[96];
    snprintf(path, sizeof path, "%s/%s", bundle, member);
    FILE *f = fopen(path, "r+b");
    assert_non_null(f);
    int c = fgetc(f);
    rewind(f);
    fputc(c ^ 1, f);
    assert_int_equal(fclose(f), 0);
}

/* gbuffer.h5 once more, with one depth that is not a number, and one outside of the mask. */
static void change_depth(void)
{
    char path[96];
    float *depth = malloc(sizeof sound->depth);
    dar_h5_array a = { .type = DAR_H5_F32, .rank = 3, .dim = { T, H, W } }, mask = a;
    dar_h5 *f;
    dar_err e = { "" };
    assert_non_null(depth);
    memcpy(depth, sound->depth, sizeof sound->depth);
    mask.type = DAR_H5_U8;
    size_t on = 0, off = 0;
    while (!sound->mask[3][on]) on++;
    while (sound->mask[3][off]) off++;
    depth[3 * P + on] = NAN;
    depth[3 * P + off] = 1e10f;
    snprintf(path, sizeof path, "%s/gbuffer.h5", bundle);
    ok(dar_h5_create(&f, path, &e), &e);
    ok(dar_h5_make(f, "depth", &a, &e), &e);
    ok(dar_h5_make(f, "mask", &mask, &e), &e);
    ok(dar_h5_write(f, "depth", &a, 0, T, depth, &e), &e);
    ok(dar_h5_write(f, "mask", &mask, 0, T, sound->mask, &e), &e);
    ok(dar_h5_commit(f, &e), &e);
    dar_h5_close(f);
    free(depth);
}

static void changed_files(void **state)
{
    (void)state;
    char path[96];
    dar_quality q;
    dar_err e;
    copy_clip(hurt, sound);
    write_clip(hurt);
    change_byte("transforms.json");
    check(&q);
    expect("a file with another byte", &q, BIT(FILES));
    CHECK(strstr(q.result[DAR_QUALITY_FILES].reason, "transforms.json"), "%s", q.result[DAR_QUALITY_FILES].reason);

    copy_clip(hurt, sound);
    hurt->options.rgb = true;
    write_clip(hurt);
    snprintf(path, sizeof path, "%s/reference.png", bundle);
    ok(dar_png_write(path, W, H, 3, hurt->rgb[1], &e), &e);
    check(&q);
    expect("another reference", &q, BIT(FILES) | BIT(REFERENCE));

    copy_clip(hurt, sound);
    hurt->options.families = 1u << DAR_FAMILY_DEPTH;
    hurt->tracks = false;
    write_clip(hurt);
    change_depth();
    check(&q);
    expect("depth that is none", &q, BIT(FILES) | BIT(FINITE) | BIT(MASK));
    assert_int_equal(q.result[DAR_QUALITY_FINITE].frame, 3);
    CHECK_NEAR("not finite", q.result[DAR_QUALITY_FINITE].found, 1, 0);
    CHECK_NEAR("pixels that differ", q.result[DAR_QUALITY_MASK].found, 1, 0);

    dar_bundle *b; /* what cannot be read has no quality */
    snprintf(path, sizeof path, "%s/gbuffer.h5", bundle);
    assert_int_equal(truncate(path, 3000), 0);
    ok(dar_bundle_open(&b, bundle, &e), &e);
    CHECK(dar_quality_check(&q, b, &e) == DAR_ERR_FORMAT && strstr(e.text, "gbuffer.h5"), "%s", e.text);
    dar_bundle_close(b);
}

/* ---------------------------------------------------------------- what passes, and how it is told */

static void passes(void **state)
{
    (void)state;
    static const int threads[] = { 1, 2, 3, 7 };
    dar_quality q, again;
    char text[DAR_QUALITY_TEXT];
    int before = dar_threads();
    copy_clip(hurt, sound);
    hurt->options.rgb = true;
    write_clip(hurt);
    check(&q);
    expect("sound", &q, 0);
    CHECK(q.unchecked == 0 && q.good == DAR_QUALITY_CHECKS, "%zu good, %zu unchecked", q.good, q.unchecked);
    for (size_t i = 0; i < DAR_COUNT(threads); i++) {
        dar_threads_set(threads[i]);
        check(&again);
        assert_memory_equal(&q, &again, sizeof q);
    }
    dar_threads_set(before);
    CHECK_NEAR("position", q.result[DAR_QUALITY_POSITION].found, 7e-6, 1e-6); /* 16 bits: 7.63e-6 at most */
    CHECK_NEAR("normal", q.result[DAR_QUALITY_NORMAL].found, 2e-5, 1e-5);     /* sqrt(3) / 2 / 32767 at most */
    assert_string_equal(dar_quality_text(&q, DAR_QUALITY_MASK, text), "mask: good: 0 px at frame 0");

    /* As other tools may write it: positions in f32, no objects, no boxes, no mask of its own. */
    copy_clip(hurt, sound);
    hurt->options.world_f32 = true;
    hurt->options.families = 1u << DAR_FAMILY_WORLD | 1u << DAR_FAMILY_DEPTH;
    hurt->meta.boxes = hurt->meta.objects = 0;
    hurt->tracks = false;
    write_clip(hurt);
    check(&q);
    expect("in f32", &q, 0);
    CHECK(q.result[DAR_QUALITY_POSITION].found < 5e-7, "position %g", q.result[DAR_QUALITY_POSITION].found);
    static const dar_quality_name missing[] = {
        DAR_QUALITY_REFERENCE,        DAR_QUALITY_NORMAL,        DAR_QUALITY_SLOPE,
        DAR_QUALITY_IDENTITY,         DAR_QUALITY_TRACKS,        DAR_QUALITY_UNIFORM_RGB,
        DAR_QUALITY_UNIFORM_TRACKING, DAR_QUALITY_UNIFORM_NORMAL
    };
    assert_int_equal(q.unchecked, DAR_COUNT(missing));
    for (size_t i = 0; i < DAR_COUNT(missing); i++) assert_int_equal(q.result[missing[i]].state, DAR_QUALITY_UNCHECKED);
    assert_string_equal(dar_quality_text(&q, DAR_QUALITY_NORMAL, text), "normal: not checked: it takes normals");
}

static void told(void **state)
{
    (void)state;
    dar_quality q;
    dar_json_doc *doc;
    dar_json_writer w = { .pretty = true };
    char text[DAR_QUALITY_TEXT];
    dar_err e = { "" };
    copy_clip(hurt, sound);
    short_normals(hurt);
    write_clip(hurt);
    check(&q);
    dar_quality_text(&q, DAR_QUALITY_NORMAL, text);
    CHECK(strncmp(text, "normal: bad: 0.01", 17) == 0 &&
              strstr(text, " at frame 7, expected at most 0.001: normals are "),
          "%s", text);
    dar_quality_print(&q, &w, NULL);
    ok(dar_json_parse(&doc, "quality", w.text, w.size, &e), &e);
    dar_json root = dar_json_root(doc), checks = dar_json_object(root, "checks");
    assert_false(dar_json_bool(root, "passed", true));
    dar_json normal = dar_json_object(checks, "normal");
    CHECK_NEAR("found", dar_json_number(normal, "found", 0, 0, 1), q.result[DAR_QUALITY_NORMAL].found, 0);
    assert_int_equal(dar_json_int(normal, "frame", 0, 0, 100), 7);
    ok(dar_bundle_set_quality(bundle, w.text, &e), &e);
    check(&q);
    expect("with results in meta.json", &q, BIT(NORMAL));
    dar_json_close(doc);
    dar_json_writer_free(&w);
}

static int set_up(void **state)
{
    if (scratch_make(state)) return -1;
    snprintf(bundle, sizeof bundle, "%s/b", scratch_dir);
    sound = calloc(1, sizeof *sound);
    hurt = calloc(1, sizeof *hurt);
    if (!sound || !hurt) return -1;
    make_sound(sound);
    return 0;
}

static int tear_down(void **state)
{
    dar_camera_free(&paths[0]);
    dar_camera_free(&paths[1]);
    free(sound);
    free(hurt);
    return scratch_remove(state);
}

int main(void)
{
    const struct CMUnitTest tests[] = { cmocka_unit_test(passes), cmocka_unit_test(damaged),
                                        cmocka_unit_test(changed_files), cmocka_unit_test(told) };
    return cmocka_run_group_tests(tests, set_up, tear_down) != 0;
}
