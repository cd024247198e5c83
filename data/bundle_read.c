/* bundle_read.c: what is asked for, when it is asked for. */
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "data/bundle_exr.h"
#include "data/bundle_inside.h"
#include "data/png.h"
#include "lib/file.h"

struct dar_bundle_inside {
    char path[PATH_MAX];
    dar_json_doc *doc; /* texts of the metadata */
    dar_bundle_contents c;
    dar_h5 *gbuffer, *rgb; /* NULL: not opened yet */
    unsigned checked;      /* bit 1 << family: the dataset is as the metadata says */
    bool rgb_checked;
    dar_exr *exr; /* of exr_frame */
    size_t exr_frame, pixels;
    unsigned char *plane; /* [3, pixels] of up to four bytes */
    uint8_t *cover;       /* [pixels] of cover_frame */
    size_t cover_frame;   /* NO_FRAME: none yet */
};

#define NO_FRAME SIZE_MAX

/* ---------------------------------------------------------------- opening */

static dar_status read_texts(dar_bundle *b, const char *meta, size_t meta_size, const char *cameras,
                             size_t cameras_size, dar_err *e)
{
    struct dar_bundle_inside *in = b->in;
    char path[PATH_MAX];
    const dar_camera_options o = dar_camera_io_standard();
    DAR_TRY(dar_json_parse(&in->doc, dar_bundle_path(b, DAR_BUNDLE_META, path), meta, meta_size, e));
    DAR_TRY(dar_bundle_read_meta(&in->c, in->doc, e));
    DAR_TRY(dar_camera_io_parse(&b->cameras, dar_bundle_path(b, DAR_BUNDLE_CAMERAS, path), cameras, cameras_size,
                                DAR_CAMERA_JSON, &o, e));
    const dar_bundle_meta *m = &in->c.meta;
    const dar_view *v = b->cameras.view;
    if (b->cameras.frames != m->frames)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu cameras, expected %zu, the frames of " DAR_BUNDLE_META, path,
                        b->cameras.frames, m->frames);
    if (v->width != m->width || v->height != m->height)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found pictures of %d x %d, expected %d x %d as in " DAR_BUNDLE_META,
                        path, v->width, v->height, m->width, m->height);
    in->pixels = (size_t)m->width * (size_t)m->height;
    b->meta = *m;
    b->rgb = in->c.rgb;
    b->reference = in->c.reference;
    b->text = in->c.text;
    b->tracks = in->c.tracks;
    for (int f = 0; f < DAR_BUNDLE_FAMILIES; f++) b->families |= (unsigned)in->c.store[f].there << f;
    return DAR_OK;
}

static dar_status allocate(dar_bundle **out, const char *path, dar_err *e)
{
    dar_bundle *b = *out = calloc(1, sizeof *b);
    if (b) b->in = calloc(1, sizeof *b->in);
    if (!b || !b->in) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    b->in->cover_frame = NO_FRAME;
    int n = snprintf(b->in->path, sizeof b->in->path, "%s", path);
    if (n >= (int)sizeof b->in->path) return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(ENAMETOOLONG));
    return DAR_OK;
}

static dar_status finish_open(dar_bundle **out, dar_status s)
{
    if (s == DAR_OK) return s;
    dar_bundle_close(*out);
    *out = NULL;
    return s;
}

dar_status dar_bundle_parse(dar_bundle **out, const char *path, const char *meta, size_t meta_size, const char *cameras,
                            size_t cameras_size, dar_err *e)
{
    dar_status s = allocate(out, path, e);
    if (s == DAR_OK) s = read_texts(*out, meta, meta_size, cameras, cameras_size, e);
    return finish_open(out, s);
}

/* A folder that is not there is told as such, rather than as a missing file in it. */
static dar_status open_files(dar_bundle *b, dar_err *e)
{
    char path[PATH_MAX];
    struct stat st;
    dar_file_map meta, cameras = { 0 };
    if (stat(b->in->path, &st) != 0) return dar_fail(e, DAR_ERR_IO, "%s: %s", b->in->path, strerror(errno));
    if (!S_ISDIR(st.st_mode))
        return dar_fail(e, DAR_ERR_IO, "%s: found no directory, expected a bundle, which is one", b->in->path);
    DAR_TRY(dar_file_map_open(&meta, dar_bundle_path(b, DAR_BUNDLE_META, path), e));
    dar_status s = dar_file_map_open(&cameras, dar_bundle_path(b, DAR_BUNDLE_CAMERAS, path), e);
    if (s == DAR_OK)
        s = read_texts(b, meta.data ? (const char *)meta.data : "", meta.size,
                       cameras.data ? (const char *)cameras.data : "", cameras.size, e);
    dar_file_map_close(&cameras);
    dar_file_map_close(&meta);
    return s;
}

dar_status dar_bundle_open(dar_bundle **out, const char *path, dar_err *e)
{
    dar_status s = allocate(out, path, e);
    if (s == DAR_OK) s = open_files(*out, e);
    return finish_open(out, s);
}

void dar_bundle_close(dar_bundle *b)
{
    if (!b) return;
    if (b->in) {
        dar_bundle_contents_free(&b->in->c);
        dar_json_close(b->in->doc);
        dar_h5_close(b->in->gbuffer);
        dar_h5_close(b->in->rgb);
        dar_exr_close(b->in->exr);
        free(b->in->plane);
        free(b->in->cover);
    }
    dar_camera_free(&b->cameras);
    free(b->in);
    free(b);
}

const char *dar_bundle_path(const dar_bundle *b, const char *member, char path[PATH_MAX])
{
    snprintf(path, PATH_MAX, "%.*s/%s", PATH_MAX - 64, b->in->path, member);
    return path;
}

/* ---------------------------------------------------------------- families */

bool dar_bundle_has(const dar_bundle *b, int family)
{
    DAR_ASSERT(family >= 0 && family < DAR_BUNDLE_FAMILIES, "bundle: family %d", family);
    return b->families >> family & 1;
}

dar_status dar_bundle_need(const dar_bundle *b, int family, dar_err *e)
{
    char there[128] = "none";
    size_t n = 0;
    if (dar_bundle_has(b, family)) return DAR_OK;
    if (family == DAR_FAMILY_MASK && dar_bundle_has(b, DAR_FAMILY_DEPTH)) return DAR_OK;
    for (int f = 0; f < DAR_BUNDLE_FAMILIES; f++)
        if (dar_bundle_has(b, f))
            n += (size_t)snprintf(there + n, sizeof there - n, "%s%s", n ? ", " : "", dar_bundle_table[f].name);
    return dar_fail(e, DAR_ERR_FORMAT, "%s: has no %s; its families: %s", b->in->path, dar_bundle_table[family].name,
                    there);
}

static dar_status make_buffers(dar_bundle *b, dar_err *e)
{
    struct dar_bundle_inside *in = b->in;
    if (!in->plane) in->plane = malloc(12 * in->pixels);
    if (!in->cover) in->cover = malloc(in->pixels);
    return in->plane && in->cover ? DAR_OK
                                  : dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory for a frame of %d x %d", in->path,
                                             b->meta.width, b->meta.height);
}

/* gbuffer.h5, and in it the dataset as the metadata says. */
static dar_status open_h5(dar_bundle *b, int family, dar_err *e)
{
    struct dar_bundle_inside *in = b->in;
    char path[PATH_MAX];
    dar_h5_array a = dar_bundle_array(family, in->c.store[family].type, &b->meta);
    if (in->checked >> family & 1) return DAR_OK;
    if (!in->gbuffer) DAR_TRY(dar_h5_open(&in->gbuffer, dar_bundle_path(b, DAR_BUNDLE_GBUFFER, path), e));
    DAR_TRY(dar_h5_expect(in->gbuffer, dar_bundle_table[family].dataset, &a, e));
    in->checked |= 1u << family;
    return DAR_OK;
}

/* The frame's EXR file, which stays open for its other families. */
static dar_status open_exr(dar_bundle *b, size_t frame, dar_err *e)
{
    struct dar_bundle_inside *in = b->in;
    char name[32], path[PATH_MAX];
    dar_exr *x;
    if (in->exr && in->exr_frame == frame) return DAR_OK;
    DAR_TRY(dar_exr_open(&x, dar_bundle_path(b, dar_bundle_exr_name(frame, name), path), e));
    size_t width = dar_exr_width(x), height = dar_exr_height(x);
    if (width != (size_t)b->meta.width || height != (size_t)b->meta.height) {
        dar_exr_close(x);
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu x %zu, expected %d x %d", path, width, height, b->meta.width,
                        b->meta.height);
    }
    dar_exr_close(in->exr);
    in->exr = x;
    in->exr_frame = frame;
    return DAR_OK;
}

static dar_status read_exr(dar_bundle *b, int family, size_t frame, void *to, dar_err *e)
{
    char name[32], path[PATH_MAX];
    dar_gbuffer g = { 0 };
    switch (family) { /* the metadata lets no other pass */
    case DAR_FAMILY_TRACKING: g.tracking = to; break;
    case DAR_FAMILY_WORLD: g.world = to; break;
    case DAR_FAMILY_NORMAL: g.normal = to; break;
    case DAR_FAMILY_DEPTH: g.depth = to; break;
    case DAR_FAMILY_MASK: g.mask = to; break;
    case DAR_BUNDLE_ID: g.instance = to; break;
    case DAR_BUNDLE_PART: g.part = to; break;
    }
    return dar_bundle_exr_read(b->in->exr, dar_bundle_path(b, dar_bundle_exr_name(frame, name), path), &g, e);
}

/* Everything that can be wrong but for the numbers is told here, before there is memory for them. */
static dar_status open_family(dar_bundle *b, int family, size_t frame, dar_err *e)
{
    DAR_ASSERT(frame < b->meta.frames, "bundle: frame %zu of %zu", frame, b->meta.frames);
    DAR_TRY(dar_bundle_need(b, family, e));
    return b->in->c.store[family].exr ? open_exr(b, frame, e) : open_h5(b, family, e);
}

static dar_status read_family(dar_bundle *b, int family, size_t frame, void *to, dar_err *e)
{
    const dar_bundle_store *s = &b->in->c.store[family];
    dar_h5_array a = dar_bundle_array(family, s->type, &b->meta);
    if (s->exr) return read_exr(b, family, frame, to, e);
    return dar_h5_read(b->in->gbuffer, dar_bundle_table[family].dataset, &a, frame, 1, to, e);
}

static dar_status read_plane(dar_bundle *b, dar_family family, size_t frame, dar_plane *plane, dar_err *e)
{
    static const dar_plane_type type[DAR_H5_TYPES] = { [DAR_H5_U8] = DAR_PLANE_U8,
                                                       [DAR_H5_U16] = DAR_PLANE_U16,
                                                       [DAR_H5_I16] = DAR_PLANE_I16,
                                                       [DAR_H5_F32] = DAR_PLANE_F32 };
    const dar_bundle_store *s = &b->in->c.store[family];
    DAR_TRY(open_family(b, family, frame, e));
    DAR_TRY(make_buffers(b, e));
    DAR_TRY(read_family(b, family, frame, b->in->plane, e));
    *plane = (dar_plane){ .type = type[s->type], .data = b->in->plane };
    memcpy(plane->scale, s->scale, sizeof plane->scale);
    memcpy(plane->offset, s->offset, sizeof plane->offset);
    return DAR_OK;
}

/* in->cover of a frame: by the mask, or else by the depth. */
static dar_status read_cover(dar_bundle *b, size_t frame, dar_err *e)
{
    struct dar_bundle_inside *in = b->in;
    dar_plane plane;
    if (in->cover_frame == frame) return DAR_OK;
    in->cover_frame = NO_FRAME;
    bool mask = dar_bundle_has(b, DAR_FAMILY_MASK);
    DAR_TRY(dar_bundle_need(b, DAR_FAMILY_MASK, e));
    DAR_TRY(read_plane(b, mask ? DAR_FAMILY_MASK : DAR_FAMILY_DEPTH, frame, &plane, e));
    dar_bundle_cover(&plane, in->pixels, in->cover);
    in->cover_frame = frame;
    return DAR_OK;
}

dar_status dar_bundle_plane(dar_bundle *b, dar_family family, size_t frame, dar_plane *plane, dar_err *e)
{
    if (family != DAR_FAMILY_MASK || dar_bundle_has(b, family)) return read_plane(b, family, frame, plane, e);
    DAR_TRY(read_cover(b, frame, e));
    *plane = (dar_plane){ .type = DAR_PLANE_U8, .data = b->in->cover, .scale = { 1.0 / 255 } };
    return DAR_OK;
}

dar_status dar_bundle_values(dar_bundle *b, dar_family family, size_t frame, float *y, dar_err *e)
{
    dar_plane plane;
    bool masked = family != DAR_FAMILY_SPARSE;
    if (masked) DAR_TRY(read_cover(b, frame, e));
    DAR_TRY(dar_bundle_plane(b, family, frame, &plane, e));
    dar_bundle_decode(&plane, dar_bundle_table[family].channels, masked ? b->in->cover : NULL, b->in->pixels, y);
    return DAR_OK;
}

dar_status dar_bundle_numbers(dar_bundle *b, dar_bundle_family family, size_t frame, uint32_t *y, dar_err *e)
{
    DAR_ASSERT(family == DAR_BUNDLE_ID || family == DAR_BUNDLE_PART, "bundle: numbers of family %d", (int)family);
    DAR_TRY(open_family(b, (int)family, frame, e));
    return read_family(b, (int)family, frame, y, e);
}

/* ---------------------------------------------------------------- pictures */

dar_status dar_bundle_rgb(dar_bundle *b, size_t frame, uint8_t *rgb, dar_err *e)
{
    struct dar_bundle_inside *in = b->in;
    char path[PATH_MAX];
    dar_h5_array a = { .type = DAR_H5_U8,
                       .rank = 4,
                       .dim = { b->meta.frames, (uint64_t)b->meta.height, (uint64_t)b->meta.width, 3 } };
    DAR_ASSERT(frame < b->meta.frames, "bundle: frame %zu of %zu", frame, b->meta.frames);
    if (!b->rgb) return dar_fail(e, DAR_ERR_FORMAT, "%s: has no pictures (" DAR_BUNDLE_RGB ")", in->path);
    if (!in->rgb) DAR_TRY(dar_h5_open(&in->rgb, dar_bundle_path(b, DAR_BUNDLE_RGB, path), e));
    if (!in->rgb_checked) DAR_TRY(dar_h5_expect(in->rgb, "rgb", &a, e));
    in->rgb_checked = true;
    return dar_h5_read(in->rgb, "rgb", &a, frame, 1, rgb, e);
}

static dar_status decode_reference(const dar_bundle *b, const char *path, const dar_file_map *m, uint8_t *rgb,
                                   dar_err *e)
{
    dar_image im;
    DAR_TRY(dar_image_probe(&im, path, m->data, m->size, e));
    if (im.width != (size_t)b->meta.width || im.height != (size_t)b->meta.height)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu x %zu, expected %d x %d", path, im.width, im.height,
                        b->meta.width, b->meta.height);
    im.rgba = malloc(4 * b->in->pixels);
    if (!im.rgba) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    dar_status s = dar_image_decode(&im, path, m->data, m->size, e);
    for (size_t i = 0; i < b->in->pixels && s == DAR_OK; i++) memcpy(rgb + 3 * i, im.rgba + 4 * i, 3);
    free(im.rgba);
    return s;
}

dar_status dar_bundle_reference(dar_bundle *b, uint8_t *rgb, dar_err *e)
{
    char path[PATH_MAX];
    dar_file_map m;
    if (!b->reference) return dar_fail(e, DAR_ERR_FORMAT, "%s: has no " DAR_BUNDLE_REFERENCE, b->in->path);
    DAR_TRY(dar_file_map_open(&m, dar_bundle_path(b, DAR_BUNDLE_REFERENCE, path), e));
    dar_status s = decode_reference(b, path, &m, rgb, e);
    dar_file_map_close(&m);
    return s;
}

dar_status dar_bundle_tracks(dar_bundle *b, float *xy, uint8_t *visible, uint8_t *color, dar_err *e)
{
    struct dar_bundle_inside *in = b->in;
    char path[PATH_MAX];
    const uint64_t N = b->tracks, T = b->meta.frames;
    const struct {
        const char *name;
        dar_h5_array a;
        void *to;
    } part[] = {
        { DAR_BUNDLE_XY, { .type = DAR_H5_F32, .rank = 3, .dim = { N, T, 2 } }, xy },
        { DAR_BUNDLE_VISIBLE, { .type = DAR_H5_U8, .rank = 2, .dim = { N, T } }, visible },
        { DAR_BUNDLE_COLOR, { .type = DAR_H5_U8, .rank = 2, .dim = { N, 3 } }, color },
    };
    if (!N) return dar_fail(e, DAR_ERR_FORMAT, "%s: has no tracks", in->path);
    if (!in->gbuffer) DAR_TRY(dar_h5_open(&in->gbuffer, dar_bundle_path(b, DAR_BUNDLE_GBUFFER, path), e));
    for (size_t i = 0; i < DAR_COUNT(part); i++) {
        dar_h5_array a = part[i].a;
        if (!part[i].to) continue;
        DAR_TRY(dar_h5_expect(in->gbuffer, part[i].name, &a, e));
        DAR_TRY(dar_h5_read(in->gbuffer, part[i].name, &a, 0, N, part[i].to, e));
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- the condition */

static dar_status condition_plane(void *ctx, dar_family family, size_t frame, dar_plane *plane, dar_err *e)
{
    return dar_bundle_plane(ctx, family, frame, plane, e);
}

static dar_status unknown(const dar_bundle *b, const char *key, const char *what, dar_err *e)
{
    char path[PATH_MAX];
    return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: found none, expected it for the channels %s",
                    dar_bundle_path(b, DAR_BUNDLE_META, path), key, what);
}

dar_status dar_bundle_source(dar_bundle *b, const dar_condition *c, dar_condition_source *s, dar_err *e)
{
    const dar_bundle_meta *m = &b->meta;
    *s = (dar_condition_source){ .path = &b->cameras, .read = condition_plane, .ctx = b };
    for (size_t i = 0; i < c->set.families; i++) DAR_TRY(dar_bundle_need(b, c->set.family[i], e));
    if (c->set.families > 0) DAR_TRY(dar_bundle_need(b, DAR_FAMILY_MASK, e));
    if (dar_channel_set_has(&c->set, DAR_FAMILY_WORLD) && !(m->world.size > 0)) return unknown(b, "world", "world", e);
    if (dar_channel_set_has(&c->set, DAR_FAMILY_DEPTH) && !(m->depth[0] <= m->depth[1]))
        return unknown(b, "depth_range", "depth", e);
    if (dar_rays_latent_frames(m->frames) == 0)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu frames, expected 1, 5, 9, ... for the network", b->in->path,
                        m->frames);
    memcpy(s->center, m->world.centre, sizeof s->center);
    s->scale = m->world.size;
    memcpy(s->box.lo, m->world.lo, sizeof s->box.lo);
    memcpy(s->box.hi, m->world.hi, sizeof s->box.hi);
    memcpy(s->depth, m->depth, sizeof s->depth);
    return DAR_OK;
}

/* ---------------------------------------------------------------- whether files are those that were written */

dar_status dar_bundle_sum(const dar_bundle *b, const char *member, char sum[DAR_SHA256_TEXT], dar_err *e)
{
    const dar_bundle_contents *c = &b->in->c;
    char path[PATH_MAX];
    for (size_t i = 0; i < c->files; i++) {
        if (!*c->file[i].sha256 || strcmp(c->file[i].name, member) != 0) continue;
        memcpy(sum, c->file[i].sha256, DAR_SHA256_TEXT);
        return DAR_OK;
    }
    return dar_sha256_file(dar_bundle_path(b, member, path), sum, e);
}

dar_status dar_bundle_verify(dar_bundle *b, dar_err *e)
{
    const dar_bundle_contents *c = &b->in->c;
    char path[PATH_MAX], sum[DAR_SHA256_TEXT];
    struct stat st;
    for (size_t i = 0; i < c->files; i++) {
        const dar_bundle_file *f = &c->file[i];
        dar_bundle_path(b, f->name, path);
        if (stat(path, &st) != 0) return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
        if ((uint64_t)st.st_size != f->bytes)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: found %lld bytes, expected %llu", path, (long long)st.st_size,
                            (unsigned long long)f->bytes);
        if (!*f->sha256) continue;
        DAR_TRY(dar_sha256_file(path, sum, e));
        if (strcmp(sum, f->sha256) != 0)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: found sha256 %.16s..., expected %.16s...", path, sum, f->sha256);
    }
    return DAR_OK;
}
