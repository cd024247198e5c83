/* camera_io.c: which format, and the one that is plain text. */
#include "data/camera_io.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/rigid.h"

#define POSE_NUMBERS 19

const char *const dar_camera_format_name[DAR_CAMERA_FORMATS + 1] = { "json", "transforms", "poses", "gltf", NULL };

dar_camera_options dar_camera_io_standard(void)
{
    return (dar_camera_options){
        .pose_width = 1280, .pose_height = 720, .near = DAR_CAMERA_NEAR, .fps = 24, .axes = DAR_AXES_OPENGL
    };
}

/* ---------------------------------------------------------------- poses */

/* What fx and fy are multiplied with before they are shares of the picture. */
static void pose_ratio(const dar_camera_options *o, int width, int height, double k[2])
{
    double picture = (double)width / height, pose = picture;
    if (o->pose_width > 0) pose = (double)o->pose_width / o->pose_height;
    k[0] = pose > picture ? height * pose / width : 1;
    k[1] = pose > picture ? 1 : width / pose / height;
}

/* The numbers of one line.  Returns how many there are, at most `most` + 1, or -1 at something else. */
static int read_numbers(const char *p, const char *end, double *x, int most)
{
    static const char space[] = " \t\r";
    char word[64];
    int n = 0;
    for (;; n++) {
        while (p < end && strchr(space, *p)) p++;
        if (p == end || n > most) return n;
        size_t length = 0;
        for (; p < end && !strchr(space, *p); p++) {
            if (!strchr("+-.0123456789eE", *p) || length + 1 == sizeof word) return -1;
            word[length++] = *p;
        }
        word[length] = 0;
        char *rest;
        double value = strtod(word, &rest);
        if (*rest || !isfinite(value)) return -1;
        if (n < most) x[n] = value;
    }
}

static dar_status read_pose(dar_view *v, const char *p, const char *end, const dar_camera_options *o, const char *name,
                            size_t line, dar_err *e)
{
    double x[POSE_NUMBERS], k[2];
    char fault[128];
    int n = read_numbers(p, end, x, POSE_NUMBERS);
    if (n < 0) return dar_fail(e, DAR_ERR_FORMAT, "%s:%zu: found something else than numbers", name, line);
    if (n != POSE_NUMBERS)
        return dar_fail(e, DAR_ERR_FORMAT, "%s:%zu: found %s%d numbers, expected 19: time fx fy cx cy 0 0, w2c 3 x 4",
                        name, line, n > POSE_NUMBERS ? "more than " : "", n > POSE_NUMBERS ? POSE_NUMBERS : n);
    pose_ratio(o, o->width, o->height, k);
    *v = (dar_view){ .width = o->width, .height = o->height, .near = o->near };
    v->fx = x[1] * k[0] * v->width;
    v->fy = x[2] * k[1] * v->height;
    v->cx = x[3] * v->width;
    v->cy = x[4] * v->height;
    memcpy(v->c2w, x + 7, sizeof v->c2w);
    if (dar_camera_fault(v, fault)) return dar_fail(e, DAR_ERR_FORMAT, "%s:%zu: found %s", name, line, fault);
    if (!dar_rigid_nearest(v->c2w))
        return dar_fail(e, DAR_ERR_FORMAT, "%s:%zu: found a matrix that is no rotation", name, line);
    dar_rigid_inverse(v->c2w, v->c2w);
    return DAR_OK;
}

static bool is_blank(const char *p, const char *end)
{
    while (p < end && strchr(" \t\r", *p)) p++;
    return p == end;
}

static dar_status read_poses(dar_camera_path *p, const char *name, const char *text, size_t size,
                             const dar_camera_options *o, dar_err *e)
{
    const char *end = text + size;
    size_t frames = 0, line = 0, t = 0;
    if (memchr(text, 0, size)) return dar_fail(e, DAR_ERR_FORMAT, "%s: found a zero byte, expected text", name);
    if (o->width < 1 || o->height < 1)
        return dar_fail(e, DAR_ERR_USAGE, "%s: poses do not tell the picture's size: expected one", name);
    for (int pass = 0; pass < 2; pass++) {
        line = 0;
        for (const char *q = text; q < end; line++) {
            const char *stop = memchr(q, '\n', (size_t)(end - q));
            if (!stop) stop = end;
            if (line > 0 && !is_blank(q, stop)) {
                if (pass) DAR_TRY(read_pose(&p->view[t++], q, stop, o, name, line + 1, e));
                frames += !pass;
            }
            q = stop < end ? stop + 1 : end;
        }
        if (pass) break;
        if (frames < 1 || frames > DAR_CAMERA_IO_MAX_FRAMES)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu poses after the first line, expected 1 to %d", name,
                            frames, DAR_CAMERA_IO_MAX_FRAMES);
        DAR_TRY(dar_camera_init(p, frames, e));
    }
    return DAR_OK;
}

static dar_status write_poses(const dar_camera_path *p, const dar_camera_options *o, dar_file_out *f, dar_err *e)
{
    static const char head[] = "time fx fy cx cy 0 0 w2c[3][4]\n";
    DAR_TRY(dar_file_write(f, head, strlen(head), e));
    for (size_t t = 0; t < p->frames; t++) {
        const dar_view *v = &p->view[t];
        double k[2], x[POSE_NUMBERS] = { (double)t };
        char line[POSE_NUMBERS * 32], number[32];
        size_t n = 0;
        pose_ratio(o, v->width, v->height, k);
        x[1] = v->fx / (k[0] * v->width);
        x[2] = v->fy / (k[1] * v->height);
        x[3] = v->cx / v->width;
        x[4] = v->cy / v->height;
        dar_rigid_inverse(v->c2w, x + 7);
        for (int i = 0; i < POSE_NUMBERS; i++)
            n += (size_t)snprintf(line + n, sizeof line - n, "%s%s", dar_json_number_text(x[i], number),
                                  i + 1 < POSE_NUMBERS ? " " : "\n");
        DAR_TRY(dar_file_write(f, line, n, e));
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- any format */

static dar_status read_document(dar_camera_path *p, const char *name, const char *text, size_t size,
                                dar_camera_format format, const dar_camera_options *o, dar_err *e)
{
    dar_json_doc *doc;
    DAR_TRY(dar_json_parse(&doc, name, text, size, e));
    if (format == DAR_CAMERA_ANY) {
        dar_json root = dar_json_root(doc);
        bool ours = dar_json_get(root, "cameras").item || dar_json_get(root, "keys").item;
        format = ours ? DAR_CAMERA_JSON : DAR_CAMERA_TRANSFORMS;
    }
    dar_status s = format == DAR_CAMERA_JSON ? dar_camera_io_read_json(p, name, doc, o, e)
                                             : dar_camera_io_read_transforms(p, name, doc, o, e);
    dar_json_close(doc);
    return s;
}

dar_status dar_camera_io_parse(dar_camera_path *p, const char *name, const char *text, size_t size,
                               dar_camera_format format, const dar_camera_options *o, dar_err *e)
{
    size_t first = 0;
    *p = (dar_camera_path){ 0 };
    while (first < size && strchr(" \t\r\n", text[first])) first++;
    if (format == DAR_CAMERA_GLTF)
        return dar_fail(e, DAR_ERR_USAGE, "%s: a glTF camera is read with its scene, not as a camera file", name);
    if (format == DAR_CAMERA_ANY && first < size && text[first] != '{' && text[first] != '/') format = DAR_CAMERA_POSES;
    if (format == DAR_CAMERA_POSES) DAR_TRY(read_poses(p, name, text, size, o, e));
    else DAR_TRY(read_document(p, name, text, size, format, o, e));
    DAR_TRY(dar_camera_check(p, name, e));
    if (o->width < 1 || o->height < 1) return DAR_OK;
    for (size_t t = 0; t < p->frames; t++) dar_camera_resize(&p->view[t], o->width, o->height);
    return dar_camera_check(p, name, e);
}

dar_status dar_camera_io_read(dar_camera_path *p, const char *path, dar_camera_format format,
                              const dar_camera_options *o, dar_err *e)
{
    dar_file_map m;
    *p = (dar_camera_path){ 0 };
    DAR_TRY(dar_file_map_open(&m, path, e));
    dar_status s =
        m.size <= DAR_JSON_MAX_SIZE
            ? dar_camera_io_parse(p, path, m.data ? (const char *)m.data : "", m.size, format, o, e)
            : dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu bytes, expected at most %zu", path, m.size, DAR_JSON_MAX_SIZE);
    dar_file_map_close(&m);
    return s;
}

typedef dar_status print_fn(const dar_camera_path *, const dar_camera_options *, dar_json_writer *, dar_err *);

static print_fn *const print[DAR_CAMERA_FORMATS] = {
    [DAR_CAMERA_JSON] = dar_camera_io_print_json,
    [DAR_CAMERA_TRANSFORMS] = dar_camera_io_print_transforms,
    [DAR_CAMERA_GLTF] = dar_camera_io_print_gltf,
};

static dar_status write_any(const dar_camera_path *p, dar_camera_format format, const dar_camera_options *o,
                            dar_file_out *f, dar_err *e)
{
    dar_json_writer w = { .pretty = true };
    if (format == DAR_CAMERA_POSES) return write_poses(p, o, f, e);
    dar_status s = print[format](p, o, &w, e);
    if (s == DAR_OK && w.failed) s = dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", f->path);
    if (s == DAR_OK) s = dar_file_write(f, w.text, w.size, e);
    if (s == DAR_OK) s = dar_file_write(f, "\n", 1, e);
    dar_json_writer_free(&w);
    return s;
}

dar_status dar_camera_io_write(const dar_camera_path *p, const char *path, dar_camera_format format,
                               const dar_camera_options *o, dar_err *e)
{
    dar_file_out f = { .fd = -1 };
    DAR_ASSERT(format < DAR_CAMERA_FORMATS, "camera format %d", (int)format);
    dar_status s = dar_file_create(&f, path, e);
    if (s == DAR_OK) s = write_any(p, format, o, &f, e);
    if (s == DAR_OK) s = dar_file_commit(&f, e);
    dar_file_discard(&f);
    return s;
}
