/* dar_bundle_convert.c: cameras from one convention to another, bundles from and to EXR files. */
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "data/camera_io.h"
#include "data/clip.h"
#include "data/dar_bundle.h"
#include "data/gltf.h"

static struct {
    const char *out, *camera_name, *animation, *camera;
    int to, from, axes, axes_out, up;
    int64_t size[2], pose_size[2], frames;
    double near, fps;
    bool relative, pxr24, overwrite;
    dar_common common;
} o;

/* dar_camera_format by name. */
static const char *const formats[] = { "json", "transforms", "poses", "gltf", "auto", NULL };

static const char *const up_names[] = { "y", "z", NULL };

/* clang-format off */
static const dar_option options[] = {
    { .name = "out", .letter = 'o', .placeholder = "PATH", .type = DAR_ARG_TEXT, .target = &o.out, .help = "result" },
    { .name = "overwrite", .type = DAR_ARG_FLAG, .target = &o.overwrite, .help = "replace a bundle of this name" },

    { .help = "Cameras to cameras" },
    { .name = "to", .placeholder = "FORMAT", .type = DAR_ARG_CHOICE, .target = &o.to, .standard = "auto",
      .names = formats, .help = "json (cameras.json), transforms (NeRF, Blender), poses (text of VideoX-Fun, "
      "RealEstate10K) or gltf; auto: by the name of the result: .txt poses, .gltf gltf, transforms*.json transforms, "
      "other .json json, anything else a directory of EXR files" },
    { .name = "from", .placeholder = "FORMAT", .type = DAR_ARG_CHOICE, .target = &o.from, .standard = "auto",
      .names = formats, .help = "the same; auto: .glb and .gltf are scenes, others are known by their content" },
    { .name = "size", .placeholder = "WxH", .type = DAR_ARG_SIZE, .target = o.size, .lo = 1, .hi = DAR_CAMERA_MAX_SIZE,
      .help = "size of the picture [px], which poses and scenes do not tell; others are scaled and cut to it" },
    { .name = "frames", .placeholder = "N", .type = DAR_ARG_INT, .target = &o.frames,
      .lo = 1, .hi = DAR_CAMERA_IO_MAX_FRAMES, .help = "make the path one of so many frames" },
    { .name = "relative", .type = DAR_ARG_FLAG, .target = &o.relative, .help = "make the first pose the identity" },
    { .name = "camera-name", .placeholder = "NAME", .type = DAR_ARG_TEXT, .target = &o.camera_name,
      .help = "of a scene: which camera, by name or number (default: the first)" },
    { .name = "animation", .placeholder = "NAME", .type = DAR_ARG_TEXT, .target = &o.animation,
      .help = "of a scene: which animation moves it (default: the first)" },

    { .help = "EXR files to a bundle, a bundle to EXR files" },
    { .name = "camera", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &o.camera,
      .help = "cameras of the EXR files, in their world" },
    { .name = "up", .placeholder = "AXIS", .type = DAR_ARG_CHOICE, .target = &o.up, .standard = "y",
      .names = up_names, .help = "of that world: y or z" },
    { .name = "pxr24", .type = DAR_ARG_FLAG, .target = &o.pxr24,
      .help = "write 24 bits of each number: a fifth of the size" },

    { .help = "Conventions" },
    { .name = "pose-size", .placeholder = "WxH", .type = DAR_ARG_SIZE, .target = o.pose_size, .standard = "1280x720",
      .lo = 0, .hi = DAR_CAMERA_MAX_SIZE,
      .help = "poses: picture that their focal lengths are of; 0x0: the picture itself" },
    { .name = "axes", .placeholder = "AXES", .type = DAR_ARG_CHOICE, .target = &o.axes, .standard = "opengl",
      .names = dar_camera_axes_name, .help = "transforms that are read: opencv, opengl, blender or unreal" },
    { .name = "axes-out", .placeholder = "AXES", .type = DAR_ARG_CHOICE, .target = &o.axes_out, .standard = "opengl",
      .names = dar_camera_axes_name, .help = "transforms that are written" },
    { .name = "near", .placeholder = "D", .type = DAR_ARG_NUMBER, .target = &o.near, .standard = "0.01",
      .lo = 1e-9, .hi = 1e9, .help = "near plane where the file has none, in the unit of the scene" },
    { .name = "fps", .placeholder = "F", .type = DAR_ARG_NUMBER, .target = &o.fps, .standard = "24",
      .lo = 0.01, .hi = 1000, .help = "frames per second of a glTF camera, and of a bundle that is made" },
};
/* clang-format on */

static bool ends_with(const char *text, const char *end)
{
    size_t n = strlen(text), m = strlen(end);
    return n >= m && strcmp(text + n - m, end) == 0;
}

static int format_of(const char *path)
{
    const char *slash = strrchr(path, '/'), *name = slash ? slash + 1 : path;
    if (ends_with(name, ".txt")) return DAR_CAMERA_POSES;
    if (ends_with(name, ".gltf")) return DAR_CAMERA_GLTF;
    if (!ends_with(name, ".json")) return DAR_CAMERA_ANY;
    return strncmp(name, "transforms", 10) == 0 ? DAR_CAMERA_TRANSFORMS : DAR_CAMERA_JSON;
}

static dar_status read_scene_camera(dar_camera_path *p, const char *path, dar_err *e)
{
    dar_scene scene;
    dar_clip c = { .scene = &scene, .frames = (size_t)o.frames, .fps = o.fps, .play = DAR_PLAY_ONCE };
    dar_status s = dar_gltf_load(&scene, path, false, e);
    if (s == DAR_OK) s = dar_scene_find_animation(&scene, o.animation, &c.animation, e);
    if (s == DAR_OK && !o.size[0])
        s = dar_fail(e, DAR_ERR_USAGE, "%s: a scene does not tell the picture's size: expected --size", path);
    if (s == DAR_OK && !c.frames && c.animation != DAR_NONE) {
        const dar_animation *a = &scene.animation[c.animation];
        c.frames = (size_t)((a->end - a->begin) * o.fps + 1.5);
    }
    if (!c.frames) c.frames = 1;
    if (s == DAR_OK) s = dar_clip_camera(&c, o.camera_name, (int)o.size[0], (int)o.size[1], p, e);
    dar_scene_free(&scene);
    return s;
}

static dar_status read_cameras(dar_camera_path *p, const char *path, const dar_camera_options *c, dar_err *e)
{
    *p = (dar_camera_path){ 0 };
    bool scene = o.from == DAR_CAMERA_ANY && (ends_with(path, ".glb") || ends_with(path, ".gltf"));
    if (scene || o.from == DAR_CAMERA_GLTF) return read_scene_camera(p, path, e);
    return dar_camera_io_read(p, path, (dar_camera_format)o.from, c, e);
}

/* The same way in o.frames frames, in place. */
static dar_status resample(dar_camera_path *p, dar_err *e)
{
    dar_camera_path q;
    DAR_TRY(dar_camera_init(&q, (size_t)o.frames, e));
    dar_camera_resample(p, (dar_camera_style){ DAR_TURN_SQUAD, DAR_MOVE_CATMULL_ROM }, &q);
    dar_camera_free(p);
    *p = q;
    return DAR_OK;
}

static dar_status convert_cameras(dar_run *r, const char *in, int to, dar_camera_options c, dar_err *e)
{
    dar_camera_path p;
    dar_status s = read_cameras(&p, in, &c, e);
    if (s == DAR_OK && o.frames && p.frames != (size_t)o.frames) s = resample(&p, e);
    if (s == DAR_OK && o.relative) dar_camera_relative(&p);
    c.axes = (dar_camera_axes)o.axes_out;
    if (s == DAR_OK && !o.common.dry_run) s = dar_camera_io_write(&p, o.out, (dar_camera_format)to, &c, e);
    if (s == DAR_OK) {
        const dar_view *v = &p.view[0];
        dar_json_write_text(&r->json, "format", formats[to]);
        dar_json_write_int(&r->json, "frames", (int64_t)p.frames);
        dar_json_write_int(&r->json, "width", v->width);
        dar_json_write_int(&r->json, "height", v->height);
        dar_run_say(r, "%s: %zu cameras, %d x %d, %s", o.out, p.frames, v->width, v->height, formats[to]);
    }
    dar_camera_free(&p);
    return s;
}

static dar_status convert_exr(dar_run *r, const char *in, bool bundle, const dar_camera_options *c, dar_err *e)
{
    const dar_convert how = { o.camera, *c, o.up == 1, o.overwrite };
    size_t frames = 0;
    if (o.common.dry_run) dar_run_say(r, "%s: %s", o.out, bundle ? "EXR files of a bundle" : "a bundle of EXR files");
    else if (bundle) DAR_TRY(dar_convert_to_exr(in, o.out, o.pxr24 ? DAR_EXR_PXR24 : DAR_EXR_ZIP, &frames, e));
    else DAR_TRY(dar_convert_from_exr(in, o.out, &how, &frames, e));
    dar_json_write_text(&r->json, "format", bundle ? "exr" : "bundle");
    if (frames) dar_json_write_int(&r->json, "frames", (int64_t)frames);
    if (frames) dar_run_say(r, "%s: %zu frames, %s", o.out, frames, bundle ? "EXR" : "a bundle");
    return DAR_OK;
}

/* What is asked for follows from what is there: a bundle, a directory of EXR files, or a file with cameras. */
static dar_status convert(dar_run *r, dar_err *e)
{
    const char *in = r->program->rest[0];
    char meta[PATH_MAX], cameras[PATH_MAX];
    struct stat st;
    dar_camera_options c = dar_camera_io_standard();
    if (!o.out) return dar_fail(e, DAR_ERR_USAGE, "%s: expected -o PATH", r->program->name);
    c.width = (int)o.size[0], c.height = (int)o.size[1];
    c.pose_width = (int)o.pose_size[0], c.pose_height = (int)o.pose_size[1];
    c.near = o.near, c.fps = o.fps, c.axes = (dar_camera_axes)o.axes;
    int to = o.to == DAR_CAMERA_ANY ? format_of(o.out) : o.to;
    bool directory = stat(in, &st) == 0 && S_ISDIR(st.st_mode);
    snprintf(meta, sizeof meta, "%s/meta.json", in);
    snprintf(cameras, sizeof cameras, "%s/cameras.json", in);
    bool bundle = directory && access(meta, F_OK) == 0;
    dar_json_write_text(&r->json, "out", o.out);
    if (directory && (!bundle || to == DAR_CAMERA_ANY)) return convert_exr(r, in, bundle, &c, e);
    return convert_cameras(r, bundle ? cameras : in, to == DAR_CAMERA_ANY ? DAR_CAMERA_JSON : to, c, e);
}

const dar_program dar_command_convert = {
    .name = "dar-bundle convert",
    .summary = "Convert cameras between conventions, and bundles from and to EXR files.",
    .options = options,
    .n_options = DAR_COUNT(options),
    .common = &o.common,
    .run = convert,
    .rest_name = "INPUT",
    .rest_help = "cameras: cameras.json, transforms.json, a text file of poses, a glTF scene with a camera; a bundle; "
                 "or a directory of EXR files",
    .rest_least = 1,
    .rest_most = 1,
};
