/* dar_bundle_render.c: from a scene and a camera to a bundle. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "data/dar_bundle.h"
#include "data/pictures.h"
#include "data/render.h"
#include "lib/log.h"
#include "lib/nearest.h"
#include "lib/sha256.h"

#define STANDARD_FRAMES     81
#define STANDARD_TRAJECTORY "orbit-30"

/* For estimates: bytes of families that two processors encode, deflate and write in a second, and what is left of
 * them, as measured with an object that covers a tenth of the picture. */
#define WRITE_RATE  7e8
#define WRITE_RATIO 0.045

static struct {
    const char *out, *camera, *camera_name, *trajectory, *animation, *families, *rgb, *reference, *prompt, *licence;
    const char *shade, *sun;
    int64_t size[2], pose_size[2], frames, tracks, track_side, samples;
    double fps, near, fit, fov;
    int play, axes, up, faces, normals;
    bool list, world_f32, exr, overwrite;
    dar_common common;
} o;

static const char *const up_names[] = { "y", "z", NULL };
static const char *const face_names[] = { "material", "all", NULL };
static const char *const normal_names[] = { "surface", "camera", NULL };

/* clang-format off */
static const dar_option options[] = {
    { .name = "out", .letter = 'o', .placeholder = "BUNDLE", .type = DAR_ARG_TEXT, .target = &o.out,
      .help = "directory to make" },
    { .name = "size", .placeholder = "WxH", .type = DAR_ARG_SIZE, .target = o.size, .standard = "832x480",
      .lo = 1, .hi = DAR_RASTER_MAX_SIDE, .help = "of the picture [px]" },
    { .name = "frames", .placeholder = "N", .type = DAR_ARG_INT, .target = &o.frames,
      .lo = 1, .hi = DAR_BUNDLE_MAX_FRAMES, .help = "number of frames; a camera file's path is made one of so many "
      "(default: those of the camera file, else 81)" },
    { .name = "fps", .placeholder = "F", .type = DAR_ARG_NUMBER, .target = &o.fps, .standard = "24",
      .lo = 0.01, .hi = 1000, .help = "frames per second" },
    { .name = "overwrite", .type = DAR_ARG_FLAG, .target = &o.overwrite, .help = "replace a bundle of this name" },

    { .help = "Scene" },
    { .name = "animation", .placeholder = "NAME", .type = DAR_ARG_TEXT, .target = &o.animation,
      .help = "which one, by name or number; rest: none (default: the first)" },
    { .name = "play", .placeholder = "HOW", .type = DAR_ARG_CHOICE, .target = &o.play, .standard = "loop",
      .names = dar_play_name, .help = "loop: in real time, again and again; once: then the last pose; "
      "stretch: once, slowed down or sped up to the length of the clip" },
    { .name = "up", .placeholder = "AXIS", .type = DAR_ARG_CHOICE, .target = &o.up, .standard = "y",
      .names = up_names, .help = "y, as glTF says, or z" },
    { .name = "faces", .placeholder = "WHICH", .type = DAR_ARG_CHOICE, .target = &o.faces, .standard = "material",
      .names = face_names, .help = "material: backs of single-sided materials are not there; all: they are" },
    { .name = "normals", .placeholder = "SIDE", .type = DAR_ARG_CHOICE, .target = &o.normals, .standard = "surface",
      .names = normal_names, .help = "surface: outwards; camera: never away from the camera" },

    { .help = "Camera (default: the scene's first, else the trajectory " STANDARD_TRAJECTORY ")" },
    { .name = "trajectory", .placeholder = "NAME", .type = DAR_ARG_TEXT, .target = &o.trajectory,
      .help = "a path around the scene, drawn by --seed within the bounds of its name" },
    { .name = "list-trajectories", .type = DAR_ARG_FLAG, .target = &o.list, .help = "print their names and stop" },
    { .name = "fit", .placeholder = "SHARE", .type = DAR_ARG_NUMBER, .target = &o.fit, .standard = "0.05",
      .lo = 0, .hi = 0.39, .help = "trajectories: share of the picture that stays free on each side" },
    { .name = "fov", .placeholder = "DEGREES", .type = DAR_ARG_NUMBER, .target = &o.fov, .standard = "40",
      .lo = 1, .hi = 160, .help = "trajectories: field of view across the shorter side" },
    { .name = "camera", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &o.camera,
      .help = "cameras.json, transforms.json, or text as of VideoX-Fun and RealEstate10K" },
    { .name = "pose-size", .placeholder = "WxH", .type = DAR_ARG_SIZE, .target = o.pose_size, .standard = "1280x720",
      .lo = 0, .hi = DAR_CAMERA_MAX_SIZE, .help = "text: picture that its focal lengths are of; 0x0: --size" },
    { .name = "axes", .placeholder = "AXES", .type = DAR_ARG_CHOICE, .target = &o.axes, .standard = "opengl",
      .names = dar_camera_axes_name, .help = "transforms.json: opencv, opengl, blender or unreal" },
    { .name = "camera-name", .placeholder = "NAME", .type = DAR_ARG_TEXT, .target = &o.camera_name,
      .help = "a camera of the scene, by name or number" },
    { .name = "near", .placeholder = "D", .type = DAR_ARG_NUMBER, .target = &o.near, .lo = DAR_RASTER_MIN_NEAR,
      .hi = 1e9, .help = "near plane, in the unit of the scene (default: the camera file's, or a thousandth of the "
      "trajectory's distance)" },

    { .help = "Content" },
    { .name = "families", .placeholder = "LIST", .type = DAR_ARG_TEXT, .target = &o.families, .standard = "all",
      .help = "of tracking, world, normal, depth, mask, sparse, id, part: those joined by +" },
    { .name = "tracks", .placeholder = "N", .type = DAR_ARG_INT, .target = &o.tracks, .standard = "2048",
      .lo = 1, .hi = 1000000, .help = "points of the sparse tracking" },
    { .name = "track-side", .placeholder = "PX", .type = DAR_ARG_INT, .target = &o.track_side, .standard = "3",
      .lo = 1, .hi = 99, .help = "side of their squares, odd [px]" },
    { .name = "world-f32", .type = DAR_ARG_FLAG, .target = &o.world_f32,
      .help = "world positions in 32 bits instead of 16" },
    { .name = "rgb", .placeholder = "DIR|VIDEO", .type = DAR_ARG_TEXT, .target = &o.rgb,
      .help = "pictures of the same frames: PNG or JPEG files, or a video" },
    { .name = "reference", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &o.reference,
      .help = "picture of frame 0, PNG or JPEG, instead of --rgb" },
    { .name = "shade", .placeholder = "LIGHTING", .type = DAR_ARG_TEXT, .target = &o.shade,
      .help = "make pictures: day, studio, sunset, overcast, night or flat" },
    { .name = "sun", .placeholder = "AZIMUTH,HEIGHT", .type = DAR_ARG_TEXT, .target = &o.sun,
      .help = "where the sun of --shade stands, in degrees: 0,30 is before the scene, 90,30 at its right" },
    { .name = "samples", .placeholder = "N", .type = DAR_ARG_INT, .target = &o.samples, .standard = "2",
      .lo = 1, .hi = DAR_SHADE_SAMPLES, .help = "of --shade: N x N per pixel" },
    { .name = "prompt", .placeholder = "TEXT", .type = DAR_ARG_TEXT, .target = &o.prompt,
      .help = "words to keep with it" },
    { .name = "licence", .placeholder = "TEXT", .type = DAR_ARG_TEXT, .target = &o.licence,
      .help = "under which the scene may be used" },
    { .name = "exr", .type = DAR_ARG_FLAG, .target = &o.exr,
      .help = "also write exr/NNNNN.exr, exact, for other programs" },
};
/* clang-format on */

/* Everything that one run holds. */
struct job {
    const char *what;
    dar_scene scene;
    dar_box *box;
    dar_camera_path path;
    dar_pictures *pictures;
    uint8_t *reference;
    const char *trajectory; /* NULL: from a file or the scene */
    dar_render render;
    dar_shade_config shade;
    dar_progress progress;
    char sha256[DAR_SHA256_TEXT];
    double begun, prepared; /* [s] */
};

/* ---------------------------------------------------------------- what is asked for */

static dar_status parse_families(const char *text, unsigned *families, dar_err *e)
{
    if (strcmp(text, "all") == 0) {
        *families = (1u << DAR_BUNDLE_FAMILIES) - 1;
        return DAR_OK;
    }
    *families = 0;
    for (const char *p = text; *p;) {
        char word[32];
        size_t n = strcspn(p, "+,"), f = 0;
        snprintf(word, sizeof word, "%.*s", (int)(n < 31 ? n : 31), p);
        dar_nearest near = dar_nearest_to(word);
        for (; f < DAR_BUNDLE_FAMILIES && strcmp(dar_bundle_table[f].name, word) != 0; f++)
            dar_nearest_try(&near, dar_bundle_table[f].name);
        if (f == DAR_BUNDLE_FAMILIES)
            return dar_fail(e, DAR_ERR_USAGE, "--families: found '%s', expected families such as %s", word,
                            near.best ? near.best : "tracking+world+normal");
        *families |= 1u << f;
        p += n + (p[n] != 0);
    }
    return DAR_OK;
}

static dar_status check_options(const dar_run *r, dar_err *e)
{
    const char *name = r->program->name;
    int cameras = (o.camera != NULL) + (o.camera_name != NULL) + (o.trajectory != NULL);
    if (!o.out) return dar_fail(e, DAR_ERR_USAGE, "%s: expected -o BUNDLE", name);
    if (cameras > 1)
        return dar_fail(e, DAR_ERR_USAGE, "%s: expected one of --camera, --camera-name and --trajectory", name);
    if (o.rgb && o.reference)
        return dar_fail(e, DAR_ERR_USAGE, "%s: expected one of --rgb and --reference: the first frame is one", name);
    if (o.shade && (o.rgb || o.reference))
        return dar_fail(e, DAR_ERR_USAGE, "%s: expected one of --shade, --rgb and --reference", name);
    if (o.track_side % 2 == 0)
        return dar_fail(e, DAR_ERR_USAGE, "%s: --track-side: found %d, expected an odd number", name,
                        (int)o.track_side);
    return DAR_OK;
}

/* ---------------------------------------------------------------- the camera */

static dar_status read_camera_file(struct job *j, dar_err *e)
{
    dar_camera_options c = dar_camera_io_standard();
    dar_camera_path p;
    c.width = (int)o.size[0], c.height = (int)o.size[1];
    c.pose_width = (int)o.pose_size[0], c.pose_height = (int)o.pose_size[1];
    c.axes = (dar_camera_axes)o.axes;
    DAR_TRY(dar_camera_io_read(&j->path, o.camera, DAR_CAMERA_ANY, &c, e));
    if (!o.frames) o.frames = (int64_t)j->path.frames;
    if (j->path.frames == (size_t)o.frames) return DAR_OK;
    dar_log(DAR_LOG_INFO, "%s: %zu cameras, turned into %d", o.camera, j->path.frames, (int)o.frames);
    DAR_TRY(dar_camera_init(&p, (size_t)o.frames, e));
    dar_camera_resample(&j->path, (dar_camera_style){ DAR_TURN_SQUAD, DAR_MOVE_CATMULL_ROM }, &p);
    dar_camera_free(&j->path);
    j->path = p;
    return DAR_OK;
}

static dar_status follow_trajectory(struct job *j, dar_err *e)
{
    const dar_trajectory_kind *kind;
    dar_stage stage = dar_stage_standard();
    stage.box = j->box, stage.boxes = j->render.clip.frames;
    stage.z_up = o.up == 1;
    stage.width = (int)o.size[0], stage.height = (int)o.size[1];
    stage.fov = o.fov * M_PI / 180;
    stage.margin = o.fit;
    stage.near = o.near;
    j->trajectory = o.trajectory ? o.trajectory : STANDARD_TRAJECTORY;
    DAR_TRY(dar_trajectory_find(j->trajectory, &kind, e));
    DAR_TRY(dar_camera_init(&j->path, j->render.clip.frames, e));
    dar_trajectory t = dar_trajectory_draw(kind, o.common.seed, 0);
    return dar_trajectory_path(&t, &stage, &j->path, e);
}

static dar_status find_camera(struct job *j, dar_err *e)
{
    const dar_clip *clip = &j->render.clip;
    if (!o.camera) {
        bool own = o.camera_name || (!o.trajectory && j->scene.cameras);
        if (own) DAR_TRY(dar_clip_camera(clip, o.camera_name, (int)o.size[0], (int)o.size[1], &j->path, e));
        else DAR_TRY(follow_trajectory(j, e));
    }
    for (size_t t = 0; t < j->path.frames; t++) {
        dar_view *v = &j->path.view[t];
        if (o.near > 0) v->near = o.near;
        if (!(v->near >= DAR_RASTER_MIN_NEAR && v->fx <= DAR_RASTER_MAX_FOCAL && v->fy <= DAR_RASTER_MAX_FOCAL))
            return dar_fail(e, DAR_ERR_FORMAT,
                            "camera of frame %zu: found near plane %g and focal lengths %g, %g, expected at least %g "
                            "and at most %g",
                            t, v->near, v->fx, v->fy, DAR_RASTER_MIN_NEAR, DAR_RASTER_MAX_FOCAL);
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- the work */

static dar_status next_picture(void *ctx, size_t frame, uint8_t *rgb, dar_err *e)
{
    struct job *j = ctx;
    (void)frame;
    return dar_pictures_read(j->pictures, rgb, e);
}

static dar_status step(void *ctx, size_t done, dar_err *e)
{
    struct job *j = ctx;
    dar_progress_step(&j->progress, (double)done, NULL);
    if (!dar_interrupted()) return DAR_OK;
    return dar_fail(e, DAR_ERR_INTERRUPTED, "%s: interrupted after %zu of %zu frames; nothing was written", o.out, done,
                    j->render.clip.frames);
}

static dar_status load(struct job *j, dar_err *e)
{
    dar_render *r = &j->render;
    struct stat st;
    DAR_TRY(dar_clip_load(&j->scene, j->what, o.fps, e));
    if (o.camera) DAR_TRY(read_camera_file(j, e));
    r->clip = (dar_clip){ .scene = &j->scene, .fps = o.fps, .play = (dar_play)o.play };
    r->clip.frames = o.frames ? (size_t)o.frames : STANDARD_FRAMES;
    DAR_TRY(dar_scene_find_animation(&j->scene, o.animation, &r->clip.animation, e));
    if (!(j->box = calloc(r->clip.frames, sizeof *j->box)))
        return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", j->what);
    DAR_TRY(dar_clip_survey(&r->clip, j->box, &r->meta.world, e));
    if (stat(j->what, &st) == 0 && S_ISREG(st.st_mode)) DAR_TRY(dar_sha256_file(j->what, j->sha256, e));
    return find_camera(j, e);
}

static dar_status load_pictures(struct job *j, dar_err *e)
{
    size_t width = (size_t)o.size[0], height = (size_t)o.size[1];
    if (o.rgb) return dar_pictures_open(&j->pictures, o.rgb, width, height, j->render.clip.frames, e);
    if (!o.reference) return DAR_OK;
    if (!(j->reference = malloc(3 * width * height)))
        return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", o.reference);
    return dar_pictures_load(o.reference, width, height, j->reference, e);
}

static dar_status find_lights(struct job *j, dar_err *e)
{
    size_t kind;
    if (!o.shade) return DAR_OK;
    DAR_TRY(dar_lighting_find(o.shade, &kind, e));
    if (o.size[0] * o.samples > DAR_RASTER_MAX_SIDE || o.size[1] * o.samples > DAR_RASTER_MAX_SIDE)
        return dar_fail(e, DAR_ERR_USAGE, "--samples: found %d, expected at most %d samples along a side of --size",
                        (int)o.samples, DAR_RASTER_MAX_SIDE);
    j->shade = dar_shade_default((int)o.size[0], (int)o.size[1]);
    j->shade.samples = (int)o.samples;
    j->shade.lighting = dar_lighting_of(kind, false);
    if (o.sun) {
        double azimuth, height;
        int end = 0;
        if (sscanf(o.sun, "%lf,%lf%n", &azimuth, &height, &end) != 2 || o.sun[end] || !(fabs(azimuth) <= 360) ||
            !(fabs(height) <= 90))
            return dar_fail(e, DAR_ERR_USAGE, "--sun: found '%s', expected two angles such as 30,45", o.sun);
        dar_lighting_aim(&j->shade.lighting, azimuth * M_PI / 180, height * M_PI / 180);
    }
    if (o.up == 1) dar_lighting_z_up(&j->shade.lighting);
    j->render.shade = &j->shade;
    return DAR_OK;
}

static void describe(struct job *j)
{
    dar_render *r = &j->render;
    const char *slash = strrchr(j->what, '/');
    bool gltf = j->sha256[0] && j->scene.nodes && !strstr(j->what, ".obj");
    r->meta.z_up = o.up == 1;
    r->meta.unit = gltf ? 1 : 0;
    r->meta.box = j->box;
    r->meta.boxes = r->clip.frames;
    r->meta.source = slash && slash[1] ? slash + 1 : j->what;
    r->meta.source_sha256 = j->sha256[0] ? j->sha256 : NULL;
    r->meta.animation = r->clip.animation == DAR_NONE ? NULL : j->scene.animation[r->clip.animation].name;
    r->meta.generator = "dar-bundle " DAR_VERSION;
    r->meta.trajectory = j->trajectory;
    r->meta.prompt = o.prompt;
    r->meta.licence = o.licence;
    r->meta.seed = o.common.seed;
    r->cameras = &j->path;
    r->raster = dar_raster_default((int)o.size[0], (int)o.size[1]);
    r->raster.faces = (dar_faces)o.faces;
    r->raster.normals = (dar_normals)o.normals;
    r->tracks = (size_t)o.tracks;
    r->track_side = (int)o.track_side;
    r->bundle.rgb = j->pictures || r->shade;
    r->bundle.world_f32 = o.world_f32;
    r->bundle.overwrite = o.overwrite;
    r->bundle.exr = o.exr;
    r->reference = j->reference;
    r->picture = next_picture;
    r->step = step;
    r->ctx = j;
}

/* ---------------------------------------------------------------- what is told */

static double raw_bytes(const dar_render *r)
{
    static const double bytes[DAR_BUNDLE_FAMILIES] = {
        [DAR_FAMILY_TRACKING] = 6, [DAR_FAMILY_WORLD] = 6,  [DAR_FAMILY_NORMAL] = 6, [DAR_FAMILY_DEPTH] = 4,
        [DAR_FAMILY_MASK] = 1,     [DAR_FAMILY_SPARSE] = 3, [DAR_BUNDLE_ID] = 4,     [DAR_BUNDLE_PART] = 4
    };
    double sum = r->bundle.rgb ? 3 : 0, pixels = (double)r->raster.width * r->raster.height * (double)r->clip.frames;
    const unsigned families = r->bundle.families | 1u << DAR_FAMILY_MASK; /* always written */
    for (int f = 0; f < DAR_BUNDLE_FAMILIES; f++) sum += families >> f & 1 ? bytes[f] : 0;
    return pixels * sum;
}

static dar_status plan(struct job *j, dar_run *r, dar_err *e)
{
    enum { TRIED = 3 };
    dar_render_report report;
    char time[32];
    double raw = raw_bytes(&j->render), frames = (double)j->render.clip.frames;
    DAR_TRY(dar_render_try(&j->render, TRIED, &report, e));
    double seconds = report.seconds[DAR_RENDER_DRAW] / TRIED * frames + raw / WRITE_RATE;
    dar_run_say(r, "%s: %.0f frames of %d x %d, about %.0f MB on the disk (at most %.0f), %.0f MB of memory, about %s",
                o.out, frames, j->render.raster.width, j->render.raster.height, 1e-6 * WRITE_RATIO * raw, 1e-6 * raw,
                1e-6 * (double)report.memory, dar_log_duration(seconds, time, sizeof time));
    dar_json_write_number(&r->json, "frames", frames);
    dar_json_write_number(&r->json, "bytes_estimated", floor(WRITE_RATIO * raw));
    dar_json_write_number(&r->json, "bytes_most", raw);
    dar_json_write_number(&r->json, "memory_bytes", (double)report.memory);
    dar_json_write_number(&r->json, "seconds_estimated", seconds);
    return DAR_OK;
}

static double percent(double part, double whole)
{
    return whole > 0 ? 100 * part / whole : 0;
}

static void tell_times(const struct job *j, dar_run *r, const dar_render_report *p)
{
    static const char *const part[DAR_STAGES] = {
        "pose", "transform", "cull", "bin", "cover", "resolve", "fill", "copy"
    };
    char line[512];
    double whole = dar_log_clock() - j->begun;
    int n = snprintf(line, sizeof line, "time: %.0f %% load and survey", percent(j->prepared - j->begun, whole));
    dar_json_write_object(&r->json, "seconds");
    dar_json_write_number(&r->json, "all", whole);
    dar_json_write_number(&r->json, "load", j->prepared - j->begun);
    for (int i = 0; i < DAR_RENDER_STAGES; i++) {
        dar_json_write_number(&r->json, dar_render_stage_name[i], p->seconds[i]);
        if (percent(p->seconds[i], whole) < 0.5) continue;
        n += snprintf(line + n, sizeof line - (size_t)n, ", %.0f %% %s", percent(p->seconds[i], whole),
                      dar_render_stage_name[i]);
        for (int k = 0, some = 0; i == DAR_RENDER_DRAW && k < DAR_STAGES; k++) {
            if (percent(p->raster.seconds[k], whole) < 0.5) continue;
            n += snprintf(line + n, sizeof line - (size_t)n, "%s%s %.0f", some++ ? ", " : " (", part[k],
                          percent(p->raster.seconds[k], whole));
        }
        if (i == DAR_RENDER_DRAW && line[n - 1] != 'w') n += snprintf(line + n, sizeof line - (size_t)n, ")");
    }
    for (int k = 0; k < DAR_STAGES; k++) dar_json_write_number(&r->json, part[k], p->raster.seconds[k]);
    for (int k = 0; k < DAR_SHADE_STAGES; k++) dar_json_write_number(&r->json, dar_shade_stage_name[k], p->shade[k]);
    dar_json_write_end(&r->json);
    dar_run_say(r, "%s", line);
}

static void tell_skips(dar_run *r, const dar_raster_stats *n)
{
    double all = (double)n->triangles;
    dar_run_say(
        r,
        "skipped: %zu of %zu frames copied, %.0f %% of vertices kept, %.0f %% of tiles empty, of triangles %.0f "
        "%% outside, %.0f %% backs, %.0f %% smaller than a pixel",
        n->copied, n->frames, percent((double)n->vertices_kept, (double)n->vertices),
        percent((double)n->tiles_empty, (double)n->tiles),
        percent((double)(n->outside + n->outside_instance + n->behind), all),
        percent((double)(n->back + n->edge_on), all), percent((double)n->small, all));
    dar_json_write_object(&r->json, "skipped");
    dar_json_write_int(&r->json, "frames_copied", (int64_t)n->copied);
    dar_json_write_int(&r->json, "vertices", (int64_t)n->vertices);
    dar_json_write_int(&r->json, "vertices_kept", (int64_t)n->vertices_kept);
    dar_json_write_int(&r->json, "tiles", (int64_t)n->tiles);
    dar_json_write_int(&r->json, "tiles_empty", (int64_t)n->tiles_empty);
    dar_json_write_int(&r->json, "triangles", (int64_t)n->triangles);
    dar_json_write_int(&r->json, "triangles_outside", (int64_t)(n->outside + n->outside_instance + n->behind));
    dar_json_write_int(&r->json, "triangles_back", (int64_t)(n->back + n->edge_on));
    dar_json_write_int(&r->json, "triangles_small", (int64_t)n->small);
    dar_json_write_int(&r->json, "triangles_drawn", (int64_t)n->drawn);
    dar_json_write_end(&r->json);
}

static void tell_notes(const dar_scene *s)
{
    const dar_scene_notes *n = &s->notes;
    const struct {
        size_t count;
        const char *what;
    } note[] = {
        { n->points_and_lines, "primitives of points or lines were passed over" },
        { n->textures, "textures could not be read" },
        { n->channels, "channels of animations were passed over" },
        { n->weights_normalised, "vertices had joint weights that did not sum to 1" },
        { n->unweighted, "vertices had no joint weights: they follow their first joint" },
    };
    for (size_t i = 0; i < DAR_COUNT(note); i++)
        if (note[i].count) dar_log(DAR_LOG_WARNING, "%s: %zu %s", s->path, note[i].count, note[i].what);
}

static void tell(const struct job *j, dar_run *r, const dar_render_report *p)
{
    size_t frames = j->render.clip.frames;
    double seconds = dar_log_clock() - j->begun;
    dar_run_say(r, "%s: %zu frames of %d x %d, %s%s, %.1f s, %.1f frames/s", o.out, frames, j->render.raster.width,
                j->render.raster.height,
                j->trajectory ? "trajectory "
                : o.camera    ? "camera "
                              : "camera of the scene",
                j->trajectory ? j->trajectory
                : o.camera    ? o.camera
                              : "",
                seconds, (double)frames / seconds);
    dar_json_write_text(&r->json, "bundle", o.out);
    dar_json_write_int(&r->json, "frames", (int64_t)frames);
    dar_json_write_int(&r->json, "width", j->render.raster.width);
    dar_json_write_int(&r->json, "height", j->render.raster.height);
    dar_json_write_int(&r->json, "tracks", (int64_t)p->tracks);
    dar_json_write_number(&r->json, "memory_bytes", (double)p->memory);
    tell_times(j, r, p);
    tell_skips(r, &p->raster);
}

static void list_trajectories(dar_run *r)
{
    dar_json_write_array(&r->json, "trajectories");
    for (size_t i = 0; i < dar_trajectory_count; i++) {
        dar_run_say(r, "%-20s %s", dar_trajectory_kinds[i].name, dar_trajectory_kinds[i].family);
        dar_json_write_text(&r->json, NULL, dar_trajectory_kinds[i].name);
    }
    dar_json_write_end(&r->json);
}

/* ---------------------------------------------------------------- */

static dar_status work(struct job *j, dar_run *r, dar_err *e)
{
    dar_render_report report;
    j->render.bundle = dar_bundle_standard();
    DAR_TRY(parse_families(o.families, &j->render.bundle.families, e));
    DAR_TRY(find_lights(j, e));
    DAR_TRY(load(j, e));
    DAR_TRY(load_pictures(j, e));
    describe(j);
    tell_notes(&j->scene);
    j->prepared = dar_log_clock();
    if (o.common.dry_run) return plan(j, r, e);
    if (j->render.clip.frames % 4 != 1)
        dar_log(DAR_LOG_WARNING, "%s: %zu frames: the network takes 1, 5, 9, ... of them", o.out,
                j->render.clip.frames);
    j->progress = dar_progress_begin("render", "frames", (double)j->render.clip.frames);
    DAR_TRY(dar_render_bundle(&j->render, o.out, &report, e));
    dar_progress_end(&j->progress);
    tell(j, r, &report);
    return DAR_OK;
}

static dar_status render(dar_run *r, dar_err *e)
{
    struct job j = { .begun = dar_log_clock() };
    if (o.list) {
        list_trajectories(r);
        return DAR_OK;
    }
    if (!r->program->rests)
        return dar_fail(e, DAR_ERR_USAGE, "%s: expected SCENE; --help tells more", r->program->name);
    j.what = r->program->rest[0];
    dar_status s = check_options(r, e);
    if (s == DAR_OK) s = work(&j, r, e);
    dar_pictures_close(j.pictures);
    dar_camera_free(&j.path);
    dar_scene_free(&j.scene);
    free(j.reference);
    free(j.box);
    return s;
}

const dar_program dar_command_render = {
    .name = "dar-bundle render",
    .summary = "Make a bundle from an animated scene and a camera path.",
    .options = options,
    .n_options = DAR_COUNT(options),
    .common = &o.common,
    .run = render,
    .rest_name = "SCENE",
    .rest_help = "a glTF or GLB file; OBJ files of one topology: a directory, or a pattern such as 'body_%04d.obj'",
    .rest_most = 1,
};
