/* bundle_write.c: a bundle, frame by frame, into a directory that gets its name at the end. */
#include <dirent.h>
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "data/bundle_exr.h"
#include "data/bundle_inside.h"
#include "data/deflate.h"
#include "data/png.h"
#include "data/video.h"
#include "lib/dir.h"
#include "lib/file.h"
#include "lib/log.h"
#include "lib/sha256.h"
#include "lib/thread.h"

#define LONGEST      64 /* bytes of a member's name, temporary ones too */
#define TRACKS_CHUNK 4096

/* Families, then rgb: what is deflated at once. */
#define RGB     DAR_BUNDLE_FAMILIES
#define STREAMS (DAR_BUNDLE_FAMILIES + 1)

struct dar_bundle_writer {
    dar_bundle_contents c;
    dar_bundle_options o;
    const dar_camera_path *cameras;
    dar_dir_out dir;
    dar_h5 *gbuffer, *rgb;
    dar_video *video;
    dar_deflate *deflate;
    dar_arena arena;
    dar_deflate_stream stream[STREAMS]; /* data: encoded frame, out: its chunk, kept for copies */
    size_t pixels, frame;
    dar_bundle_stats stats;
};

static dar_h5_array rgb_array(const dar_bundle_meta *m)
{
    return (
        dar_h5_array){ .type = DAR_H5_U8, .rank = 4, .dim = { m->frames, (uint64_t)m->height, (uint64_t)m->width, 3 } };
}

dar_bundle_options dar_bundle_standard(void)
{
    return (dar_bundle_options){ .families = ((1u << DAR_BUNDLE_FAMILIES) - 1) & ~(1u << DAR_FAMILY_SPARSE),
                                 .exports = true,
                                 .compression = DAR_EXR_ZIP };
}

static const char *in_dir(const dar_bundle_writer *w, const char *member, char path[PATH_MAX])
{
    int n = snprintf(path, PATH_MAX, "%s/%s", w->dir.temp, member);
    DAR_ASSERT(n < PATH_MAX, "%s/%s: too long", w->dir.temp, member); /* begin() has seen to it */
    return path;
}

/* ---------------------------------------------------------------- what may be replaced */

static dar_status check_names(const char *path, size_t frames, dar_err *e)
{
    char inside[PATH_MAX];
    dar_status s = DAR_OK;
    DIR *d = opendir(path);
    if (!d) return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
    for (const struct dirent *x; s == DAR_OK && (x = readdir(d));) {
        const char *name = x->d_name;
        if (strcmp(name, ".") == 0 || strcmp(name, "..") == 0) continue;
        if (strcmp(name, DAR_BUNDLE_EXR) == 0 || dar_bundle_is_file(name, frames)) continue;
        snprintf(inside, sizeof inside, DAR_BUNDLE_EXR "/%.100s", name);
        if (dar_bundle_is_file(inside, frames)) continue;
        s = dar_fail(e, DAR_ERR_IO, "%s: holds %s, which is no part of a bundle: it is not overwritten", path, name);
    }
    closedir(d);
    return s;
}

/* An existing directory is replaced only if nothing in it could be anything else than a bundle. */
static dar_status check_target(const char *path, bool overwrite, dar_err *e)
{
    char exr[PATH_MAX];
    struct stat st;
    if (lstat(path, &st) != 0) return DAR_OK;
    if (!overwrite) return dar_fail(e, DAR_ERR_IO, "%s: is there already; it is not overwritten unasked", path);
    if (!S_ISDIR(st.st_mode)) return dar_fail(e, DAR_ERR_IO, "%s: found no directory, expected a bundle", path);
    DAR_TRY(check_names(path, DAR_BUNDLE_MAX_FRAMES, e));
    if (snprintf(exr, sizeof exr, "%s/" DAR_BUNDLE_EXR, path) >= (int)sizeof exr || lstat(exr, &st) != 0) return DAR_OK;
    return check_names(exr, DAR_BUNDLE_MAX_FRAMES, e);
}

/* ---------------------------------------------------------------- beginning */

static void check_meta(const dar_bundle_meta *m, const dar_camera_path *cameras, const dar_bundle_options *o)
{
    bool sized = true;
    for (size_t t = 0; t < cameras->frames; t++)
        sized = sized && cameras->view[t].width == m->width && cameras->view[t].height == m->height;
    DAR_ASSERT(sized && m->frames == cameras->frames && m->frames <= DAR_BUNDLE_MAX_FRAMES,
               "bundle: %zu frames of %d x %d, %zu cameras", m->frames, m->width, m->height, cameras->frames);
    DAR_ASSERT(m->width > 0 && m->height > 0 && m->width <= DAR_BUNDLE_MAX_SIDE && m->height <= DAR_BUNDLE_MAX_SIDE,
               "bundle: %d x %d", m->width, m->height);
    DAR_ASSERT(m->fps > 0 && m->seed <= DAR_BUNDLE_MAX_SEED && (m->boxes == 0 || m->boxes == m->frames),
               "bundle: %g frames per second, seed %llu, %zu boxes", m->fps, (unsigned long long)m->seed, m->boxes);
    DAR_ASSERT(!(o->families >> DAR_FAMILY_WORLD & 1) || o->world_f32 || m->world.size > 0, "bundle: world of size %g",
               m->world.size);
}

static dar_status write_cameras(dar_bundle_writer *w, dar_err *e)
{
    char path[PATH_MAX];
    dar_camera_options o = dar_camera_io_standard();
    o.fps = w->c.meta.fps;
    DAR_TRY(dar_camera_io_write(w->cameras, in_dir(w, DAR_BUNDLE_CAMERAS, path), DAR_CAMERA_JSON, &o, e));
    if (!w->o.exports) return DAR_OK;
    DAR_TRY(dar_camera_io_write(w->cameras, in_dir(w, DAR_BUNDLE_POSES, path), DAR_CAMERA_POSES, &o, e));
    return dar_camera_io_write(w->cameras, in_dir(w, DAR_BUNDLE_NERF, path), DAR_CAMERA_TRANSFORMS, &o, e);
}

static dar_status make_gbuffer(dar_bundle_writer *w, dar_err *e)
{
    char path[PATH_MAX];
    const dar_bundle_meta *m = &w->c.meta;
    DAR_TRY(dar_h5_create(&w->gbuffer, in_dir(w, DAR_BUNDLE_GBUFFER, path), e));
    for (int f = 0; f < DAR_BUNDLE_FAMILIES; f++) {
        const dar_bundle_family_info *info = &dar_bundle_table[f];
        dar_bundle_store *s = &w->c.store[f];
        if (!(w->o.families >> f & 1)) continue;
        *s = dar_bundle_store_of(f, &m->world, w->o.world_f32);
        dar_h5_array a = dar_bundle_array(f, s->type, m);
        DAR_TRY(dar_h5_make(w->gbuffer, info->dataset, &a, e));
        if (s->type == DAR_H5_F32 || s->type == DAR_H5_U32) continue;
        DAR_TRY(dar_h5_put_numbers(w->gbuffer, info->dataset, "scale", s->scale, info->channels, e));
        DAR_TRY(dar_h5_put_numbers(w->gbuffer, info->dataset, "offset", s->offset, info->channels, e));
    }
    return DAR_OK;
}

static dar_status make_rgb(dar_bundle_writer *w, dar_err *e)
{
    char path[PATH_MAX];
    const dar_bundle_meta *m = &w->c.meta;
    dar_h5_array a = rgb_array(m);
    DAR_TRY(dar_h5_create(&w->rgb, in_dir(w, DAR_BUNDLE_RGB, path), e));
    DAR_TRY(dar_h5_make(w->rgb, "rgb", &a, e));
    w->c.rgb = w->c.reference = true;
    if (m->width % 2 || m->height % 2) return DAR_OK;
    return dar_video_create(&w->video, in_dir(w, DAR_BUNDLE_VIDEO, path), (size_t)m->width, (size_t)m->height,
                            &(dar_video_how){ .fps = m->fps, .codec = DAR_VIDEO_H264 }, e);
}

static size_t stream_size(const dar_bundle_writer *w, int i)
{
    if (i == RGB) return w->rgb ? 3 * w->pixels : 0;
    const dar_bundle_store *s = &w->c.store[i];
    return s->there ? dar_bundle_table[i].channels * w->pixels * dar_h5_type_size(s->type) : 0;
}

/* Encoded frame and chunk of every family. */
static dar_status make_buffers(dar_bundle_writer *w, dar_err *e)
{
    size_t bytes = 0;
    for (int i = 0; i < STREAMS; i++) {
        w->stream[i].size = stream_size(w, i);
        bytes += w->stream[i].size + dar_deflate_bound(w->stream[i].size) + 2 * DAR_ALIGN;
    }
    DAR_TRY(dar_arena_init(&w->arena, "bundle", bytes, e));
    for (int i = 0; i < STREAMS; i++) {
        if (!w->stream[i].size) continue;
        w->stream[i].data = dar_arena_push(&w->arena, w->stream[i].size);
        w->stream[i].out = dar_arena_push(&w->arena, dar_deflate_bound(w->stream[i].size));
    }
    return dar_deflate_new(&w->deflate, e);
}

static dar_status begin(dar_bundle_writer *w, const char *path, dar_err *e)
{
    char exr[PATH_MAX];
    DAR_TRY(dar_dir_create(&w->dir, path, e));
    if (strlen(w->dir.temp) + LONGEST >= PATH_MAX)
        return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(ENAMETOOLONG));
    DAR_TRY(check_target(w->dir.path, w->o.overwrite, e));
    DAR_TRY(write_cameras(w, e));
    DAR_TRY(make_gbuffer(w, e));
    if (w->o.rgb) DAR_TRY(make_rgb(w, e));
    if (w->o.exr && mkdir(in_dir(w, DAR_BUNDLE_EXR, exr), 0777) != 0)
        return dar_fail(e, DAR_ERR_IO, "%s: %s", exr, strerror(errno));
    return make_buffers(w, e);
}

dar_status dar_bundle_create(dar_bundle_writer **out, const char *path, const dar_bundle_meta *meta,
                             const dar_camera_path *cameras, const dar_bundle_options *o, dar_err *e)
{
    check_meta(meta, cameras, o);
    dar_bundle_writer *w = *out = calloc(1, sizeof *w);
    if (!w) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    w->c.meta = *meta;
    w->c.meta.depth[0] = INFINITY;
    w->c.meta.depth[1] = -INFINITY;
    w->o = *o;
    w->o.families |= 1u << DAR_FAMILY_MASK;
    w->cameras = cameras;
    w->pixels = (size_t)meta->width * (size_t)meta->height;
    dar_status s = begin(w, path, e);
    if (s != DAR_OK) {
        dar_bundle_discard(w);
        *out = NULL;
    }
    return s;
}

void dar_bundle_discard(dar_bundle_writer *w)
{
    if (!w) return;
    dar_video_close(w->video);
    dar_h5_close(w->gbuffer);
    dar_h5_close(w->rgb);
    dar_dir_discard(&w->dir);
    dar_deflate_free(w->deflate);
    dar_arena_free(&w->arena);
    free(w->c.file);
    free(w);
}

/* ---------------------------------------------------------------- frames */

static const void *family_of(const dar_bundle_frame *f, int family)
{
    const void *const x[DAR_BUNDLE_FAMILIES] = {
        [DAR_FAMILY_TRACKING] = f->g.tracking, [DAR_FAMILY_WORLD] = f->g.world, [DAR_FAMILY_NORMAL] = f->g.normal,
        [DAR_FAMILY_DEPTH] = f->g.depth,       [DAR_FAMILY_MASK] = f->g.mask,   [DAR_FAMILY_SPARSE] = f->sparse,
        [DAR_BUNDLE_ID] = f->g.instance,       [DAR_BUNDLE_PART] = f->g.part,
    };
    return x[family];
}

static dar_status encode(dar_bundle_writer *w, const dar_bundle_frame *f, int family, dar_err *e)
{
    const void *x = family_of(f, family);
    size_t bad, width = (size_t)w->c.meta.width;
    const dar_bundle_store *s = &w->c.store[family];
    DAR_ASSERT(x && f->g.mask, "bundle: frame %zu lacks %s or the mask", w->frame, dar_bundle_table[family].name);
    unsigned char *to = (unsigned char *)(uintptr_t)w->stream[family].data;
    if (dar_bundle_encode(family, s, x, f->g.mask, w->pixels, to, &bad)) return DAR_OK;
    size_t at = bad % w->pixels, c = bad / w->pixels;
    double lo = s->type == DAR_H5_I16 ? -1 : s->offset[c], hi = s->type == DAR_H5_I16 ? 1 : lo + 65535 * s->scale[c];
    if (s->type == DAR_H5_F32) lo = -INFINITY, hi = INFINITY;
    return dar_fail(e, DAR_ERR_NUMERIC, "%s: frame %zu: %s: found %g at column %zu, row %zu, expected %g to %g",
                    w->dir.path, w->frame, dar_bundle_table[family].name, (double)((const float *)x)[bad], at % width,
                    at / width, lo, hi);
}

static void extend_depth(dar_bundle_writer *w, const dar_bundle_frame *f)
{
    float lo = INFINITY, hi = -INFINITY;
    for (size_t i = 0; i < w->pixels; i++) {
        float z = f->g.depth[i];
        bool on = f->g.mask[i] != 0;
        lo = on && z < lo ? z : lo;
        hi = on && z > hi ? z : hi;
    }
    double *range = w->c.meta.depth;
    range[0] = fmin(range[0], (double)lo);
    range[1] = fmax(range[1], (double)hi);
}

static dar_status write_exr(dar_bundle_writer *w, const dar_bundle_frame *f, dar_err *e)
{
    char name[32], path[PATH_MAX];
    dar_gbuffer g = f->g;
    const unsigned keep = w->o.families;
    if (!(keep >> DAR_FAMILY_TRACKING & 1)) g.tracking = NULL;
    if (!(keep >> DAR_FAMILY_WORLD & 1)) g.world = NULL;
    if (!(keep >> DAR_FAMILY_NORMAL & 1)) g.normal = NULL;
    if (!(keep >> DAR_FAMILY_DEPTH & 1)) g.depth = NULL;
    if (!(keep >> DAR_BUNDLE_ID & 1)) g.instance = NULL;
    if (!(keep >> DAR_BUNDLE_PART & 1)) g.part = NULL;
    return dar_bundle_exr_write(in_dir(w, dar_bundle_exr_name(w->frame, name), path), (size_t)w->c.meta.width,
                                (size_t)w->c.meta.height, &g, w->o.compression, e);
}

static dar_status write_chunks(dar_bundle_writer *w, dar_err *e)
{
    for (int i = 0; i < STREAMS; i++) {
        const dar_deflate_stream *x = &w->stream[i];
        bool rgb = i == RGB;
        if (!x->size) continue;
        w->stats.empty += x->zero;
        if (x->zero) continue; /* what is not written reads as zero */
        dar_h5_array a = rgb ? rgb_array(&w->c.meta) : dar_bundle_array(i, w->c.store[i].type, &w->c.meta);
        DAR_TRY(dar_h5_write_chunk(rgb ? w->rgb : w->gbuffer, rgb ? "rgb" : dar_bundle_table[i].dataset, &a, w->frame,
                                   x->out, x->out_size, e));
        w->stats.chunks++;
        w->stats.bytes += x->out_size;
    }
    return DAR_OK;
}

static dar_status add_rgb(dar_bundle_writer *w, const uint8_t *rgb, dar_err *e)
{
    DAR_ASSERT(rgb, "bundle: frame %zu lacks its picture", w->frame);
    memcpy((void *)(uintptr_t)w->stream[RGB].data, rgb, w->stream[RGB].size);
    if (w->frame == 0) {
        char path[PATH_MAX];
        const dar_bundle_meta *m = &w->c.meta;
        DAR_TRY(dar_png_write(in_dir(w, DAR_BUNDLE_REFERENCE, path), (size_t)m->width, (size_t)m->height, 3, rgb, e));
    }
    return w->video ? dar_video_write(w->video, rgb, e) : DAR_OK;
}

/* The time since *mark, which moves on, belongs to a stage. */
static void lap(dar_bundle_writer *w, dar_bundle_stage stage, double *mark)
{
    double now = dar_log_clock();
    w->stats.seconds[stage] += now - *mark;
    *mark = now;
}

dar_status dar_bundle_add(dar_bundle_writer *w, const dar_bundle_frame *f, dar_err *e)
{
    double mark = dar_log_clock();
    DAR_ASSERT(w->frame < w->c.meta.frames, "bundle: more than %zu frames", w->c.meta.frames);
    DAR_ASSERT(!f->copied || w->frame > 0, "bundle: frame 0 has nothing before it");
    if (w->rgb) DAR_TRY(add_rgb(w, f->rgb, e));
    if (w->o.exr) DAR_TRY(write_exr(w, f, e));
    lap(w, DAR_BUNDLE_PICTURES, &mark);
    for (int i = 0; i < DAR_BUNDLE_FAMILIES && !f->copied; i++)
        if (w->stream[i].size) DAR_TRY(encode(w, f, i, e));
    if (!f->copied && w->c.store[DAR_FAMILY_DEPTH].there) extend_depth(w, f);
    lap(w, DAR_BUNDLE_ENCODE, &mark);
    if (f->copied) dar_deflate_run(w->deflate, w->stream + RGB, 1);
    else dar_deflate_run(w->deflate, w->stream, STREAMS);
    lap(w, DAR_BUNDLE_DEFLATE, &mark);
    DAR_TRY(write_chunks(w, e));
    lap(w, DAR_BUNDLE_WRITE, &mark);
    w->frame++;
    w->stats.frames++;
    w->stats.copied += f->copied;
    return DAR_OK;
}

const dar_bundle_stats *dar_bundle_written(const dar_bundle_writer *w)
{
    return &w->stats;
}

/* ---------------------------------------------------------------- what comes once */

dar_status dar_bundle_add_tracks(dar_bundle_writer *w, size_t tracks, const float *xy, const uint8_t *visible,
                                 const uint8_t *color, dar_err *e)
{
    const uint64_t N = tracks, T = w->c.meta.frames;
    const struct {
        const char *name;
        dar_h5_array a;
        const void *data;
    } part[] = {
        { DAR_BUNDLE_XY, { .type = DAR_H5_F32, .rank = 3, .dim = { N, T, 2 }, .chunk = TRACKS_CHUNK }, xy },
        { DAR_BUNDLE_VISIBLE, { .type = DAR_H5_U8, .rank = 2, .dim = { N, T }, .chunk = TRACKS_CHUNK }, visible },
        { DAR_BUNDLE_COLOR, { .type = DAR_H5_U8, .rank = 2, .dim = { N, 3 }, .chunk = TRACKS_CHUNK }, color },
    };
    DAR_ASSERT(w->c.tracks == 0, "bundle: tracks twice");
    for (size_t i = 0; i < DAR_COUNT(part) && tracks > 0; i++) {
        DAR_TRY(dar_h5_make(w->gbuffer, part[i].name, &part[i].a, e));
        DAR_TRY(dar_h5_write(w->gbuffer, part[i].name, &part[i].a, 0, N, part[i].data, e));
    }
    w->c.tracks = tracks;
    return DAR_OK;
}

dar_status dar_bundle_add_reference(dar_bundle_writer *w, const uint8_t *rgb, dar_err *e)
{
    char path[PATH_MAX];
    const dar_bundle_meta *m = &w->c.meta;
    DAR_ASSERT(!w->rgb, "bundle: the reference of a bundle with rgb is its frame 0");
    w->c.reference = true;
    return dar_png_write(in_dir(w, DAR_BUNDLE_REFERENCE, path), (size_t)m->width, (size_t)m->height, 3, rgb, e);
}

static dar_status write_file(dar_bundle_writer *w, const char *member, const void *data, size_t size, dar_err *e)
{
    char path[PATH_MAX];
    dar_file_out out;
    dar_status s = dar_file_create(&out, in_dir(w, member, path), e);
    if (s == DAR_OK) s = dar_file_write(&out, data, size, e);
    if (s == DAR_OK) s = dar_file_commit(&out, e);
    dar_file_discard(&out);
    return s;
}

dar_status dar_bundle_add_text(dar_bundle_writer *w, const char *path, dar_err *e)
{
    dar_file_map m;
    DAR_TRY(dar_file_map_open(&m, path, e));
    dar_status s = write_file(w, DAR_BUNDLE_TEXT, m.data, m.size, e);
    dar_file_map_close(&m);
    w->c.text = s == DAR_OK;
    return s;
}

/* ---------------------------------------------------------------- end */

#define FAILED UINT64_MAX

static dar_status hash_file(const dar_bundle_writer *w, dar_bundle_file *f, dar_err *e)
{
    char path[PATH_MAX];
    struct stat st;
    DAR_TRY(dar_sha256_file(in_dir(w, f->name, path), f->sha256, e));
    if (stat(path, &st) != 0) return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
    f->bytes = (uint64_t)st.st_size;
    return DAR_OK;
}

static void hash_task(void *ctx, size_t i, int thread)
{
    dar_bundle_writer *w = ctx;
    (void)thread;
    if (hash_file(w, &w->c.file[i], NULL) != DAR_OK) w->c.file[i].bytes = FAILED;
}

/* Every member but meta.json, which will hold the list. */
static dar_status list_files(dar_bundle_writer *w, dar_err *e)
{
    char path[PATH_MAX];
    struct stat st;
    size_t most = DAR_BUNDLE_FILES + (w->o.exr ? w->frame : 0);
    w->c.file = calloc(most, sizeof *w->c.file);
    if (!w->c.file) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory for %zu files", w->dir.path, most);
    for (size_t i = 0; dar_bundle_files[i]; i++)
        if (stat(in_dir(w, dar_bundle_files[i], path), &st) == 0)
            snprintf(w->c.file[w->c.files++].name, 32, "%s", dar_bundle_files[i]);
    for (size_t t = 0; t < w->frame && w->o.exr; t++) dar_bundle_exr_name(t, w->c.file[w->c.files++].name);
    dar_parallel(w->c.files, hash_task, w);
    for (size_t i = 0; i < w->c.files; i++)
        if (w->c.file[i].bytes == FAILED) DAR_TRY(hash_file(w, &w->c.file[i], e));
    return DAR_OK;
}

static dar_status write_meta(dar_bundle_writer *w, dar_err *e)
{
    dar_json_writer text = { .pretty = true };
    dar_bundle_print_meta(&w->c, &text);
    dar_status s = text.failed ? dar_fail(e, DAR_ERR_NOMEM, "%s: " DAR_BUNDLE_META ": out of memory", w->dir.path)
                               : write_file(w, DAR_BUNDLE_META, text.text, text.size, e);
    dar_json_writer_free(&text);
    return s;
}

dar_status dar_bundle_commit(dar_bundle_writer *w, dar_err *e)
{
    double mark = dar_log_clock();
    DAR_ASSERT(w->frame == w->c.meta.frames, "bundle: %zu of %zu frames", w->frame, w->c.meta.frames);
    if (w->video) DAR_TRY(dar_video_commit(w->video, e));
    DAR_TRY(dar_h5_commit(w->gbuffer, e));
    if (w->rgb) DAR_TRY(dar_h5_commit(w->rgb, e));
    DAR_TRY(list_files(w, e));
    DAR_TRY(write_meta(w, e));
    DAR_TRY(dar_dir_commit(&w->dir, w->o.overwrite, e));
    lap(w, DAR_BUNDLE_FINISH, &mark);
    return DAR_OK;
}

/* ---------------------------------------------------------------- afterwards */

/* The document again, with another "qc". */
static void print_quality(dar_json_writer *w, dar_json root, dar_json quality)
{
    dar_json_write_object(w, NULL);
    for (dar_json j = dar_json_first(root); j.item; j = dar_json_next(j))
        if (strcmp(dar_json_key(j), "qc") != 0) dar_json_write_value(w, dar_json_key(j), j);
    dar_json_write_value(w, "qc", quality);
    dar_json_write_end(w);
}

dar_status dar_bundle_set_quality(const char *path, const char *json, dar_err *e)
{
    char meta[PATH_MAX];
    dar_json_doc *old = NULL, *quality = NULL;
    dar_json_writer text = { .pretty = true };
    dar_file_out out = { .fd = -1 };
    if (snprintf(meta, sizeof meta, "%s/" DAR_BUNDLE_META, path) >= (int)sizeof meta)
        return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(ENAMETOOLONG));
    dar_status s = dar_json_open(&old, meta, e);
    if (s == DAR_OK) s = dar_json_parse(&quality, "qc", json, strlen(json), e);
    if (s == DAR_OK) print_quality(&text, dar_json_root(old), dar_json_root(quality));
    if (s == DAR_OK && text.failed) s = dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", meta);
    if (s == DAR_OK) s = dar_file_create(&out, meta, e);
    if (s == DAR_OK) s = dar_file_write(&out, text.text, text.size, e);
    if (s == DAR_OK) s = dar_file_commit(&out, e);
    dar_file_discard(&out);
    dar_json_writer_free(&text);
    dar_json_close(quality);
    dar_json_close(old);
    return s;
}
