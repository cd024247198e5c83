/* bundle_meta.c: meta.json, and which files a bundle may hold. */
#include <ctype.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/bundle_inside.h"

#define MAX_TRACKS (1 << 24)
#define MAX_BYTES  DAR_JSON_MAX_INT

const char *const dar_bundle_files[DAR_BUNDLE_FILES + 1] = {
    DAR_BUNDLE_META,  DAR_BUNDLE_CAMERAS, DAR_BUNDLE_GBUFFER, DAR_BUNDLE_RGB,  DAR_BUNDLE_REFERENCE,
    DAR_BUNDLE_VIDEO, DAR_BUNDLE_TEXT,    DAR_BUNDLE_POSES,   DAR_BUNDLE_NERF, NULL
};

/* In the order of the enumerations. */
static const char *const formats[] = { DAR_BUNDLE_FORMAT, NULL };
static const char *const types[DAR_H5_TYPES + 1] = { "u8", "u16", "i16", "u32", "f32", NULL };
static const char *const places[] = { DAR_BUNDLE_GBUFFER, DAR_BUNDLE_EXR, NULL };
static const char *const ups[] = { "y", "z", NULL };

/* What cannot be otherwise in a bundle, said for its readers. */
static const struct convention {
    const char *key, *value;
} conventions[] = {
    { "camera", "opencv" }, { "pixel_centre", "half" }, { "depth", "view-z" },
    { "normal", "world" },  { "background", "zero" },   { "rgb", "srgb-display" },
};

const char *dar_bundle_exr_name(size_t frame, char name[32])
{
    snprintf(name, 32, DAR_BUNDLE_EXR "/%05zu.exr", frame);
    return name;
}

bool dar_bundle_is_file(const char *name, size_t frames)
{
    char exr[32];
    for (size_t i = 0; dar_bundle_files[i]; i++)
        if (strcmp(dar_bundle_files[i], name) == 0) return true;
    if (strncmp(name, DAR_BUNDLE_EXR "/", 4) != 0 || !isdigit((unsigned char)name[4])) return false;
    size_t frame = strtoul(name + 4, NULL, 10);
    return frame < frames && strcmp(dar_bundle_exr_name(frame, exr), name) == 0;
}

/* ---------------------------------------------------------------- reading */

static void read_family(dar_bundle_contents *c, int f, dar_json j)
{
    static const double most[DAR_H5_TYPES] = { 255, 65535, 32767, 1, 1 };
    dar_bundle_store *s = &c->store[f];
    bool number = f >= DAR_FAMILIES;
    int type = dar_json_choice(j, "type", -1, types);
    if (type < 0) return;
    if (number != (type == DAR_H5_U32)) {
        dar_json_reject(j, "type", "%s", number ? "u32" : "u8, u16, i16 or f32");
        return;
    }
    s->type = (dar_h5_type)type;
    s->there = true;
    if (f == DAR_FAMILY_TRACKING) dar_json_text(j, "scheme", "");
    s->exr = dar_json_choice(j, "file", 0, places) == 1;
    const char *in_exr = f == DAR_FAMILY_MASK ? "u8" : number ? "u32" : "f32";
    if (s->exr && strcmp(types[type], in_exr) != 0) dar_json_reject(j, "type", "%s in EXR files", in_exr);
    if (s->exr && f == DAR_FAMILY_SPARSE) dar_json_reject(j, "file", DAR_BUNDLE_GBUFFER);
    bool integer = !number && type != DAR_H5_F32;
    for (int k = 0; k < 3; k++) s->scale[k] = 1 / most[type], s->offset[k] = 0;
    if (!integer) return;
    if (f == DAR_FAMILY_WORLD || f == DAR_FAMILY_DEPTH) s->scale[0] = s->offset[0] = NAN; /* needed */
    dar_json_numbers(j, "scale", s->scale, dar_bundle_table[f].channels);
    dar_json_numbers(j, "offset", s->offset, dar_bundle_table[f].channels);
    for (size_t k = 0; k < dar_bundle_table[f].channels; k++)
        if (!(s->scale[k] != 0)) dar_json_reject(j, "scale", "numbers other than 0");
    s->there = true;
}

static void read_families(dar_bundle_contents *c, dar_json root)
{
    dar_json j = dar_json_object(root, "families");
    for (int f = 0; f < DAR_BUNDLE_FAMILIES; f++) {
        if (!dar_json_get(j, dar_bundle_table[f].name).item) continue;
        read_family(c, f, dar_json_object(j, dar_bundle_table[f].name));
    }
}

/* lo before hi in each of three. */
static bool sound_box(const double x[6])
{
    return x[0] <= x[3] && x[1] <= x[4] && x[2] <= x[5];
}

static void read_world(dar_bundle_meta *m, dar_json root)
{
    double box[6] = { NAN };
    if (!dar_json_get(root, "world").item) return;
    dar_json j = dar_json_object(root, "world");
    m->world.centre[0] = NAN;
    dar_json_numbers(j, "center", m->world.centre, 3);
    m->world.size = dar_json_number(j, "size", NAN, 0, DAR_CAMERA_LARGEST);
    dar_json_numbers(j, "box", box, 6);
    if (!(m->world.size > 0)) dar_json_reject(j, "size", "more than 0");
    if (!sound_box(box)) dar_json_reject(j, "box", "lowest x y z, then highest x y z");
    for (int k = 0; k < 3; k++) m->world.lo[k] = box[k], m->world.hi[k] = box[3 + k];
}

static dar_status read_boxes(dar_bundle_meta *m, dar_json root, dar_err *e)
{
    dar_json list = dar_json_array(root, "boxes");
    size_t n = dar_json_size(list), t = 0;
    if (!n) return DAR_OK;
    if (n != m->frames) {
        dar_json_reject(root, "boxes", "one for each of %zu frames, not %zu", m->frames, n);
        return DAR_OK;
    }
    dar_box *box = calloc(n, sizeof *box);
    if (!box) return dar_fail(e, DAR_ERR_NOMEM, "boxes of %zu frames: out of memory", n);
    m->box = box;
    m->boxes = n;
    for (dar_json j = dar_json_first(list); j.item; j = dar_json_next(j), t++) {
        double x[6] = { NAN };
        dar_json_numbers(j, NULL, x, 6);
        if (!sound_box(x)) dar_json_reject(j, NULL, "lowest x y z, then highest x y z");
        memcpy(box[t].lo, x, sizeof box[t].lo);
        memcpy(box[t].hi, x + 3, sizeof box[t].hi);
    }
    return DAR_OK;
}

static dar_status read_objects(dar_bundle_meta *m, dar_json root, dar_err *e)
{
    dar_json list = dar_json_array(root, "objects");
    size_t n = dar_json_size(list), i = 0;
    if (!n) return DAR_OK;
    dar_bundle_object *object = calloc(n, sizeof *object);
    if (!object) return dar_fail(e, DAR_ERR_NOMEM, "%zu objects: out of memory", n);
    m->object = object;
    m->objects = n;
    for (dar_json j = dar_json_first(list); j.item; j = dar_json_next(j), i++) {
        object[i].name = dar_json_text(j, "name", "");
        object[i].parts = (size_t)dar_json_int(j, "parts", 0, 0, UINT32_MAX);
    }
    return DAR_OK;
}

static dar_status read_files(dar_bundle_contents *c, dar_json root, dar_err *e)
{
    dar_json list = dar_json_object(root, "files");
    size_t n = dar_json_size(list), i = 0;
    if (!n) return DAR_OK;
    c->file = calloc(n, sizeof *c->file);
    if (!c->file) return dar_fail(e, DAR_ERR_NOMEM, "%zu files: out of memory", n);
    c->files = n;
    for (dar_json j = dar_json_first(list); j.item; j = dar_json_next(j), i++) {
        dar_bundle_file *f = &c->file[i];
        const char *name = dar_json_key(j);
        if (!dar_bundle_is_file(name, c->meta.frames)) dar_json_reject(j, NULL, "a name that a bundle's file can have");
        snprintf(f->name, sizeof f->name, "%s", name);
        f->bytes = (uint64_t)dar_json_int(j, "bytes", DAR_JSON_NEEDED, 0, MAX_BYTES);
        const char *sum = dar_json_text(j, "sha256", "");
        if (!*sum) continue;
        if (strlen(sum) != DAR_SHA256_TEXT - 1 || strspn(sum, "0123456789abcdef") != strlen(sum))
            dar_json_reject(j, "sha256", "64 of the digits 0 to f");
        snprintf(f->sha256, sizeof f->sha256, "%s", sum);
    }
    return DAR_OK;
}

static void read_origin(dar_bundle_meta *m, dar_json root)
{
    dar_json source = dar_json_object(root, "source");
    m->source = dar_json_text(source, "path", "");
    m->source_sha256 = dar_json_text(source, "sha256", "");
    m->licence = dar_json_text(source, "licence", "");
    m->animation = dar_json_text(source, "animation", "");
    m->generator = dar_json_text(root, "generator", "");
    m->trajectory = dar_json_text(root, "trajectory", "");
    m->prompt = dar_json_text(root, "prompt", "");
    m->seed = (uint64_t)dar_json_int(root, "seed", 0, 0, DAR_BUNDLE_MAX_SEED);
    const char **text[] = { &m->source,    &m->source_sha256, &m->licence, &m->animation,
                            &m->generator, &m->trajectory,    &m->prompt };
    for (size_t i = 0; i < DAR_COUNT(text); i++)
        if (*text[i] && !**text[i]) *text[i] = NULL;
}

static void read_depth(dar_bundle_meta *m, dar_json root)
{
    m->depth[0] = m->depth[1] = NAN;
    if (!dar_json_get(root, "depth_range").item) return;
    dar_json_numbers(root, "depth_range", m->depth, 2);
    if (!(m->depth[0] >= 0 && m->depth[0] <= m->depth[1]))
        dar_json_reject(root, "depth_range", "nearest, then farthest depth");
}

dar_status dar_bundle_read_meta(dar_bundle_contents *c, dar_json_doc *doc, dar_err *e)
{
    dar_bundle_meta *m = &c->meta;
    dar_json root = dar_json_root(doc);
    *c = (dar_bundle_contents){ 0 };
    if (dar_json_choice(root, "format", -1, formats) < 0) return dar_json_finish(doc, e); /* not ours to judge */
    m->frames = (size_t)dar_json_int(root, "frames", DAR_JSON_NEEDED, 1, DAR_BUNDLE_MAX_FRAMES);
    m->width = (int)dar_json_int(root, "width", DAR_JSON_NEEDED, 1, DAR_BUNDLE_MAX_SIDE);
    m->height = (int)dar_json_int(root, "height", DAR_JSON_NEEDED, 1, DAR_BUNDLE_MAX_SIDE);
    m->fps = dar_json_number(root, "fps", NAN, 1e-3, 1e6);
    m->z_up = dar_json_choice(root, "up", 0, ups) == 1;
    m->unit = dar_json_number(root, "unit", 0, 0, DAR_CAMERA_LARGEST);
    read_families(c, root);
    read_world(m, root);
    read_depth(m, root);
    read_origin(m, root);
    c->rgb = dar_json_bool(root, "rgb", false);
    c->reference = dar_json_bool(root, "reference", false);
    c->text = dar_json_bool(root, "text", false);
    c->tracks = (size_t)dar_json_int(root, "tracks", 0, 0, MAX_TRACKS);
    dar_json fixed = dar_json_object(root, "conventions");
    for (size_t i = 0; i < DAR_COUNT(conventions); i++) {
        const char *const only[] = { conventions[i].value, NULL };
        if (dar_json_get(fixed, conventions[i].key).item) dar_json_choice(fixed, conventions[i].key, -1, only);
    }
    dar_json_accept(dar_json_get(root, "qc"));
    dar_json_accept(dar_json_get(root, "extra"));
    dar_status s = read_boxes(m, root, e);
    if (s == DAR_OK) s = read_objects(m, root, e);
    if (s == DAR_OK) s = read_files(c, root, e);
    return s == DAR_OK ? dar_json_finish(doc, e) : s;
}

void dar_bundle_contents_free(dar_bundle_contents *c)
{
    free((void *)(uintptr_t)c->meta.box);
    free((void *)(uintptr_t)c->meta.object);
    free(c->file);
    *c = (dar_bundle_contents){ 0 };
}

/* ---------------------------------------------------------------- writing */

static void print_numbers(dar_json_writer *w, const char *key, const double *x, size_t n)
{
    dar_json_write_array(w, key);
    for (size_t i = 0; i < n; i++) dar_json_write_number(w, NULL, x[i]);
    dar_json_write_end(w);
}

static void print_text(dar_json_writer *w, const char *key, const char *text)
{
    if (text) dar_json_write_text(w, key, text);
}

static void print_box(dar_json_writer *w, const char *key, const double lo[3], const double hi[3])
{
    const double x[6] = { lo[0], lo[1], lo[2], hi[0], hi[1], hi[2] };
    print_numbers(w, key, x, 6);
}

static void print_families(const dar_bundle_contents *c, dar_json_writer *w)
{
    dar_json_write_object(w, "families");
    for (int f = 0; f < DAR_BUNDLE_FAMILIES; f++) {
        const dar_bundle_store *s = &c->store[f];
        if (!s->there) continue;
        dar_json_write_object(w, dar_bundle_table[f].name);
        dar_json_write_text(w, "type", types[s->type]);
        dar_json_write_text(w, "file", places[s->exr]);
        if (f == DAR_FAMILY_TRACKING) print_text(w, "scheme", "rest-cells");
        if (s->type != DAR_H5_F32 && s->type != DAR_H5_U32) {
            print_numbers(w, "scale", s->scale, dar_bundle_table[f].channels);
            print_numbers(w, "offset", s->offset, dar_bundle_table[f].channels);
        }
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
}

static void print_origin(const dar_bundle_meta *m, dar_json_writer *w)
{
    print_text(w, "generator", m->generator);
    dar_json_write_object(w, "source");
    print_text(w, "path", m->source);
    print_text(w, "sha256", m->source_sha256);
    print_text(w, "licence", m->licence);
    print_text(w, "animation", m->animation);
    dar_json_write_end(w);
    print_text(w, "trajectory", m->trajectory);
    print_text(w, "prompt", m->prompt);
    dar_json_write_int(w, "seed", (int64_t)m->seed);
}

static void print_scene(const dar_bundle_meta *m, dar_json_writer *w)
{
    dar_json_write_text(w, "up", ups[m->z_up]);
    dar_json_write_number(w, "unit", m->unit);
    if (m->world.size > 0) {
        dar_json_write_object(w, "world");
        print_numbers(w, "center", m->world.centre, 3);
        dar_json_write_number(w, "size", m->world.size);
        print_box(w, "box", m->world.lo, m->world.hi);
        dar_json_write_end(w);
    }
    if (m->depth[0] <= m->depth[1]) print_numbers(w, "depth_range", m->depth, 2);
    dar_json_write_array(w, "objects");
    for (size_t i = 0; i < m->objects; i++) {
        dar_json_write_object(w, NULL);
        dar_json_write_text(w, "name", m->object[i].name ? m->object[i].name : "");
        dar_json_write_int(w, "parts", (int64_t)m->object[i].parts);
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
    dar_json_write_array(w, "boxes");
    for (size_t t = 0; t < m->boxes; t++) print_box(w, NULL, m->box[t].lo, m->box[t].hi);
    dar_json_write_end(w);
}

void dar_bundle_print_meta(const dar_bundle_contents *c, dar_json_writer *w)
{
    const dar_bundle_meta *m = &c->meta;
    dar_json_write_object(w, NULL);
    dar_json_write_text(w, "format", DAR_BUNDLE_FORMAT);
    dar_json_write_int(w, "frames", (int64_t)m->frames);
    dar_json_write_int(w, "width", m->width);
    dar_json_write_int(w, "height", m->height);
    dar_json_write_number(w, "fps", m->fps);
    print_families(c, w);
    dar_json_write_bool(w, "rgb", c->rgb);
    dar_json_write_bool(w, "reference", c->reference);
    dar_json_write_bool(w, "text", c->text);
    dar_json_write_int(w, "tracks", (int64_t)c->tracks);
    dar_json_write_object(w, "conventions");
    for (size_t i = 0; i < DAR_COUNT(conventions); i++)
        dar_json_write_text(w, conventions[i].key, conventions[i].value);
    dar_json_write_end(w);
    print_origin(m, w);
    print_scene(m, w);
    dar_json_write_object(w, "files");
    for (size_t i = 0; i < c->files; i++) {
        dar_json_write_object(w, c->file[i].name);
        dar_json_write_int(w, "bytes", (int64_t)c->file[i].bytes);
        if (*c->file[i].sha256) dar_json_write_text(w, "sha256", c->file[i].sha256);
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
    dar_json_write_end(w);
}
