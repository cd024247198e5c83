/* dar_bundle_exr.c: bundles from and to directories of EXR files, one per frame. */
#include <dirent.h>
#include <errno.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>

#include "data/bundle_exr.h"
#include "data/dar_bundle.h"
#include "data/objseq.h"
#include "lib/dir.h"
#include "lib/log.h"

static dar_status no_memory(const char *path, dar_err *e)
{
    return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
}

static bool has(unsigned families, int family)
{
    return families >> family & 1;
}

/* Buffers of the families in `a`, which is initialised here. */
static dar_status buffers(dar_arena *a, unsigned families, size_t pixels, dar_gbuffer *g, dar_err *e)
{
    DAR_TRY(dar_arena_init(a, "frame", dar_mul_size(pixels, 50) + 16 * DAR_ALIGN, e));
    *g = (dar_gbuffer){ .mask = dar_arena_push(a, pixels) };
    if (has(families, DAR_FAMILY_TRACKING)) g->tracking = dar_arena_push(a, 12 * pixels);
    if (has(families, DAR_FAMILY_WORLD)) g->world = dar_arena_push(a, 12 * pixels);
    if (has(families, DAR_FAMILY_NORMAL)) g->normal = dar_arena_push(a, 12 * pixels);
    if (has(families, DAR_FAMILY_DEPTH)) g->depth = dar_arena_push(a, 4 * pixels);
    if (has(families, DAR_BUNDLE_ID)) g->instance = dar_arena_push(a, 4 * pixels);
    if (has(families, DAR_BUNDLE_PART)) g->part = dar_arena_push(a, 4 * pixels);
    return DAR_OK;
}

static dar_status interrupted(const char *path, dar_err *e)
{
    return dar_fail(e, DAR_ERR_INTERRUPTED, "%s: interrupted; nothing was written", path);
}

/* ---------------------------------------------------------------- to EXR */

static dar_status read_frame(dar_bundle *b, size_t frame, const dar_gbuffer *g, dar_err *e)
{
    if (g->tracking) DAR_TRY(dar_bundle_values(b, DAR_FAMILY_TRACKING, frame, g->tracking, e));
    if (g->world) DAR_TRY(dar_bundle_values(b, DAR_FAMILY_WORLD, frame, g->world, e));
    if (g->normal) DAR_TRY(dar_bundle_values(b, DAR_FAMILY_NORMAL, frame, g->normal, e));
    if (g->depth) DAR_TRY(dar_bundle_values(b, DAR_FAMILY_DEPTH, frame, g->depth, e));
    if (g->instance) DAR_TRY(dar_bundle_numbers(b, DAR_BUNDLE_ID, frame, g->instance, e));
    if (g->part) DAR_TRY(dar_bundle_numbers(b, DAR_BUNDLE_PART, frame, g->part, e));
    return DAR_OK;
}

static dar_status write_files(dar_bundle *b, const dar_dir_out *out, dar_gbuffer *g, dar_exr_compression compression,
                              dar_err *e)
{
    char path[PATH_MAX + 32];
    dar_progress progress = dar_progress_begin("convert", "frames", (double)b->meta.frames);
    g->mask = NULL; /* EXR files tell it by id and depth */
    for (size_t t = 0; t < b->meta.frames; t++) {
        if (dar_interrupted()) return interrupted(out->path, e);
        DAR_TRY(read_frame(b, t, g, e));
        snprintf(path, sizeof path, "%s/%05zu.exr", out->temp, t);
        DAR_TRY(dar_bundle_exr_write(path, (size_t)b->meta.width, (size_t)b->meta.height, g, compression, e));
        dar_progress_step(&progress, (double)t + 1, NULL);
    }
    dar_progress_end(&progress);
    return DAR_OK;
}

dar_status dar_convert_to_exr(const char *bundle, const char *path, dar_exr_compression compression, size_t *frames,
                              dar_err *e)
{
    dar_bundle *b;
    dar_arena a = { 0 };
    dar_gbuffer g;
    dar_dir_out out = { .lock = -1 };
    DAR_TRY(dar_bundle_open(&b, bundle, e));
    *frames = b->meta.frames;
    dar_status s = buffers(&a, b->families, (size_t)b->meta.width * (size_t)b->meta.height, &g, e);
    if (s == DAR_OK && !(g.tracking || g.world || g.normal || g.depth || g.instance || g.part))
        s = dar_fail(e, DAR_ERR_FORMAT, "%s: found no families that an EXR file holds", bundle);
    if (s == DAR_OK) s = dar_dir_create(&out, path, e);
    if (s == DAR_OK) s = write_files(b, &out, &g, compression, e);
    if (s == DAR_OK) s = dar_dir_commit(&out, false, e);
    dar_dir_discard(&out);
    dar_arena_free(&a);
    dar_bundle_close(b);
    return s;
}

/* ---------------------------------------------------------------- from EXR */

/* The files of a directory, in the order in which people count. */
struct files {
    const char *directory;
    struct dirent **entry;
    int count;
};

static int is_exr(const struct dirent *d)
{
    const char *dot = strrchr(d->d_name, '.');
    return d->d_name[0] != '.' && dot && strcasecmp(dot, ".exr") == 0;
}

static int in_order(const struct dirent **a, const struct dirent **b)
{
    return dar_objseq_order((*a)->d_name, (*b)->d_name);
}

static dar_status open_file(const struct files *f, int i, dar_exr **x, char path[PATH_MAX], dar_err *e)
{
    *x = NULL;
    if (snprintf(path, PATH_MAX, "%s/%s", f->directory, f->entry[i]->d_name) >= PATH_MAX)
        return dar_fail(e, DAR_ERR_IO, "%s: %s", f->directory, strerror(ENAMETOOLONG));
    return dar_exr_open(x, path, e);
}

static dar_status read_file(const struct files *f, int i, const dar_bundle_meta *m, const dar_gbuffer *g, dar_err *e)
{
    char path[PATH_MAX];
    dar_exr *x;
    dar_status s = open_file(f, i, &x, path, e);
    if (s == DAR_OK && (dar_exr_width(x) != (size_t)m->width || dar_exr_height(x) != (size_t)m->height))
        s = dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu x %zu pixels, expected %d x %d as in the first file", path,
                     dar_exr_width(x), dar_exr_height(x), m->width, m->height);
    if (s == DAR_OK) s = dar_bundle_exr_read(x, path, g, e);
    dar_exr_close(x);
    return s;
}

/* Bounds of all positions, frame by frame. */
static dar_status survey(const struct files *f, dar_bundle_meta *m, const dar_gbuffer *g, dar_box *box, dar_err *e)
{
    size_t pixels = (size_t)m->width * (size_t)m->height, seen = 0;
    const dar_gbuffer positions = { .world = g->world, .mask = g->mask };
    dar_world_init(&m->world);
    for (int t = 0; t < f->count; t++) {
        dar_world w;
        if (dar_interrupted()) return interrupted(f->directory, e);
        DAR_TRY(read_file(f, t, m, &positions, e));
        dar_world_init(&w);
        for (size_t i = 0; i < pixels; i++) {
            if (!g->mask[i]) continue;
            dar_world_add(&w, (float[3]){ g->world[i], g->world[pixels + i], g->world[2 * pixels + i] }, 1);
        }
        if (!(w.lo[0] <= w.hi[0])) continue;
        memcpy(box[t].lo, w.lo, sizeof w.lo);
        memcpy(box[t].hi, w.hi, sizeof w.hi);
        seen++;
        for (int k = 0; k < 3; k++) {
            m->world.lo[k] = fmin(m->world.lo[k], w.lo[k]);
            m->world.hi[k] = fmax(m->world.hi[k], w.hi[k]);
        }
    }
    dar_world_finish(&m->world);
    if (seen == (size_t)f->count) m->box = box, m->boxes = seen;
    return DAR_OK;
}

static dar_status write_bundle(const struct files *f, const char *path, const dar_bundle_meta *m,
                               const dar_camera_path *cameras, const dar_bundle_options *o, const dar_gbuffer *g,
                               dar_err *e)
{
    dar_bundle_writer *w;
    const dar_bundle_frame frame = { .g = *g };
    dar_status s = dar_bundle_create(&w, path, m, cameras, o, e);
    dar_progress progress = dar_progress_begin("convert", "frames", f->count);
    for (int t = 0; s == DAR_OK && t < f->count; t++) {
        s = dar_interrupted() ? interrupted(path, e) : read_file(f, t, m, g, e);
        if (s == DAR_OK) s = dar_bundle_add(w, &frame, e);
        dar_progress_step(&progress, t + 1, NULL);
    }
    if (s == DAR_OK) s = dar_bundle_commit(w, e);
    if (s == DAR_OK) dar_progress_end(&progress);
    dar_bundle_discard(w);
    return s;
}

static dar_status convert(const struct files *f, const char *path, const dar_convert *c, size_t *frames, dar_err *e)
{
    char name[PATH_MAX];
    dar_exr *x;
    dar_arena a = { 0 };
    dar_gbuffer g;
    dar_camera_path cameras = { 0 };
    dar_bundle_options o = dar_bundle_standard();
    dar_bundle_meta m = { .fps = c->camera.fps, .z_up = c->z_up, .generator = "dar-bundle " DAR_VERSION };
    const char *slash = strrchr(f->directory, '/');

    DAR_TRY(open_file(f, 0, &x, name, e));
    o.families = dar_bundle_exr_families(x);
    o.world_f32 = true; /* as the files have it: they may have been rounded before */
    o.overwrite = c->overwrite;
    m.width = (int)dar_exr_width(x), m.height = (int)dar_exr_height(x);
    m.frames = *frames = (size_t)f->count;
    m.source = slash && slash[1] ? slash + 1 : f->directory;
    m.depth[0] = m.depth[1] = NAN;
    dar_exr_close(x);
    if (!has(o.families, DAR_FAMILY_MASK))
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found neither depth nor id: what is background cannot be told", name);

    dar_camera_options co = c->camera;
    co.width = m.width, co.height = m.height;
    dar_status s = dar_camera_io_read(&cameras, c->cameras, DAR_CAMERA_ANY, &co, e);
    if (s == DAR_OK && cameras.frames != m.frames)
        s = dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu cameras, expected %zu, one for each file of %s", c->cameras,
                     cameras.frames, m.frames, f->directory);
    dar_box *box = calloc(m.frames, sizeof *box);
    if (s == DAR_OK && !box) s = no_memory(path, e);
    if (s == DAR_OK) s = buffers(&a, o.families, (size_t)m.width * (size_t)m.height, &g, e);
    if (s == DAR_OK && g.world) s = survey(f, &m, &g, box, e);
    if (s == DAR_OK) s = write_bundle(f, path, &m, &cameras, &o, &g, e);
    free(box);
    dar_arena_free(&a);
    dar_camera_free(&cameras);
    return s;
}

dar_status dar_convert_from_exr(const char *directory, const char *path, const dar_convert *c, size_t *frames,
                                dar_err *e)
{
    struct files f = { .directory = directory };
    dar_status s = DAR_OK;
    f.count = scandir(directory, &f.entry, is_exr, in_order);
    if (f.count < 0) s = dar_fail(e, DAR_ERR_IO, "%s: %s", directory, strerror(errno));
    else if (f.count == 0)
        s = dar_fail(e, DAR_ERR_FORMAT, "%s: found neither meta.json, of a bundle, nor EXR files", directory);
    else if (!c->cameras)
        s = dar_fail(e, DAR_ERR_USAGE, "%s: EXR files do not tell their cameras: expected --camera FILE", directory);
    else s = convert(&f, path, c, frames, e);
    for (int i = 0; i < f.count; i++) free(f.entry[i]);
    free(f.entry);
    return s;
}
