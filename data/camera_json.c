/* camera_json.c: cameras.json and transforms.json. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/affine.h"
#include "data/camera_io.h"

#define FORMAT "dar-cameras/1"

/* A member array of `rows` rows of `columns` numbers. */
static void read_matrix(dar_json j, const char *key, int rows, int columns, double *x)
{
    dar_json a = dar_json_array(j, key), row = dar_json_first(a);
    if (dar_json_size(a) != (size_t)rows) {
        dar_json_reject(j, key, "%d rows of %d numbers", rows, columns);
        return;
    }
    for (int i = 0; i < rows; i++, row = dar_json_next(row)) {
        x[i * columns] = NAN;
        dar_json_numbers(row, NULL, x + i * columns, (size_t)columns);
    }
}

static void print_matrix(dar_json_writer *w, const char *key, int rows, int columns, const double *x)
{
    dar_json_write_array(w, key);
    for (int i = 0; i < rows; i++) {
        dar_json_write_array(w, NULL);
        for (int k = 0; k < columns; k++) dar_json_write_number(w, NULL, x[i * columns + k]);
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
}

/* A view that a failed read left unsound is not told twice: the document's failure comes first. */
static void take_matrix(dar_json j, const char *key, dar_camera_axes axes, dar_view *v)
{
    double m[16] = { 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1 };
    read_matrix(j, key, 4, 4, m);
    if (!dar_camera_import(axes, m, v->c2w)) dar_json_reject(j, key, "a matrix whose last row is 0 0 0 1");
}

/* ---------------------------------------------------------------- cameras.json */

static void read_camera(dar_json j, const dar_camera_options *o, dar_view *v)
{
    double k[9] = { 1, 0, 0, 0, 1, 0, 0, 0, 1 };
    read_matrix(j, "K", 3, 3, k);
    if (k[1] != 0 || k[3] != 0 || k[6] != 0 || k[7] != 0 || k[8] != 1)
        dar_json_reject(j, "K", "rows fx 0 cx, 0 fy cy, 0 0 1");
    v->fx = k[0];
    v->fy = k[4];
    v->cx = k[2];
    v->cy = k[5];
    take_matrix(j, "c2w", DAR_AXES_OPENCV, v);
    v->near = dar_json_number(j, "near", o->near, 0, DAR_CAMERA_LARGEST);
    if (dar_json_get(j, "far").item) dar_json_number(j, "far", INFINITY, v->near, INFINITY);
}

/* The views of an array into v, and their times if they are keys. */
static void read_views(dar_json list, const dar_camera_options *o, dar_view size, dar_view *v, double *time)
{
    size_t t = 0;
    for (dar_json j = dar_json_first(list); j.item; j = dar_json_next(j), t++) {
        v[t] = size;
        read_camera(j, o, &v[t]);
        if (!time) continue;
        time[t] = dar_json_number(j, "time", NAN, -DAR_CAMERA_LARGEST, DAR_CAMERA_LARGEST);
        if (t && !(time[t] > time[t - 1])) dar_json_reject(j, "time", "more than that of the key before");
    }
}

/* The frames between key poses p, which they replace. */
static dar_status fill_frames(dar_camera_path *p, const double *time, size_t frames, dar_camera_style style, dar_err *e)
{
    dar_camera_path keys = *p;
    dar_camera_key *key = calloc(keys.frames, sizeof *key);
    dar_status s = dar_camera_init(p, frames, e);
    if (s == DAR_OK && !key) s = dar_fail(e, DAR_ERR_NOMEM, "%zu camera keys: out of memory", keys.frames);
    if (s == DAR_OK) {
        for (size_t k = 0; k < keys.frames; k++) key[k] = (dar_camera_key){ time[k], keys.view[k] };
        dar_camera_fill(p, key, keys.frames, style);
    }
    free(key);
    dar_camera_free(&keys);
    return s;
}

static dar_status read_list(dar_camera_path *p, const char *name, dar_json_doc *doc, const dar_camera_options *o,
                            double *time, dar_err *e)
{
    static const char *const axes[] = { "opencv", NULL };
    dar_json root = dar_json_root(doc), list = dar_json_array(root, time ? "keys" : "cameras");
    size_t n = p->frames;
    dar_view size = { 0 };
    dar_camera_style style = { DAR_TURN_SQUAD, DAR_MOVE_CATMULL_ROM };

    dar_json_choice(root, "axes", 0, axes);
    size.width = (int)dar_json_int(root, "width", DAR_JSON_NEEDED, 1, DAR_CAMERA_MAX_SIZE);
    size.height = (int)dar_json_int(root, "height", DAR_JSON_NEEDED, 1, DAR_CAMERA_MAX_SIZE);
    int64_t frames = dar_json_int(root, "frames", time ? DAR_JSON_NEEDED : (int64_t)n, 1, DAR_CAMERA_IO_MAX_FRAMES);
    if (time) {
        style.turn = (dar_camera_turn)dar_json_choice(root, "turn", DAR_TURN_SQUAD, dar_camera_turn_name);
        style.move = (dar_camera_move)dar_json_choice(root, "move", DAR_MOVE_CATMULL_ROM, dar_camera_move_name);
    } else if (frames != (int64_t)n) {
        dar_json_reject(root, "frames", "the number of cameras, %zu", n);
    }
    read_views(list, o, size, p->view, time);
    if (dar_json_bool(root, "relative_to_first", false) &&
        memcmp(p->view[0].c2w, dar_affine_identity, sizeof dar_affine_identity) != 0)
        dar_json_reject(root, "relative_to_first", "false, for the first camera is not the identity");
    DAR_TRY(dar_json_finish(doc, e));
    DAR_TRY(dar_camera_check(p, name, e));
    return time ? fill_frames(p, time, (size_t)frames, style, e) : DAR_OK;
}

dar_status dar_camera_io_read_json(dar_camera_path *p, const char *name, dar_json_doc *doc, const dar_camera_options *o,
                                   dar_err *e)
{
    static const char *const formats[] = { FORMAT, NULL };
    dar_json root = dar_json_root(doc);
    bool keys = dar_json_get(root, "keys").item != NULL;
    size_t n = dar_json_size(dar_json_array(root, keys ? "keys" : "cameras"));

    dar_json_choice(root, "format", -1, formats);
    if (n < 1 || n > DAR_CAMERA_IO_MAX_FRAMES) {
        dar_json_reject(root, keys ? "keys" : "cameras", "1 to %d views", DAR_CAMERA_IO_MAX_FRAMES);
        return dar_json_finish(doc, e);
    }
    double *time = keys ? calloc(n, sizeof *time) : NULL;
    if (keys && !time) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name);
    dar_status s = dar_camera_init(p, n, e);
    if (s == DAR_OK) s = read_list(p, name, doc, o, time, e);
    free(time);
    return s;
}

dar_status dar_camera_io_print_json(const dar_camera_path *p, const dar_camera_options *o, dar_json_writer *w,
                                    dar_err *e)
{
    (void)o;
    (void)e;
    bool relative = memcmp(p->view[0].c2w, dar_affine_identity, sizeof dar_affine_identity) == 0;
    dar_json_write_object(w, NULL);
    dar_json_write_text(w, "format", FORMAT);
    dar_json_write_text(w, "axes", "opencv");
    dar_json_write_int(w, "width", p->view[0].width);
    dar_json_write_int(w, "height", p->view[0].height);
    dar_json_write_int(w, "frames", (int64_t)p->frames);
    dar_json_write_bool(w, "relative_to_first", relative);
    dar_json_write_array(w, "cameras");
    for (size_t t = 0; t < p->frames; t++) {
        const dar_view *v = &p->view[t];
        const double k[9] = { v->fx, 0, v->cx, 0, v->fy, v->cy, 0, 0, 1 };
        double m[16];
        dar_camera_export(DAR_AXES_OPENCV, v->c2w, m);
        dar_json_write_object(w, NULL);
        print_matrix(w, "K", 3, 3, k);
        print_matrix(w, "c2w", 4, 4, m);
        dar_json_write_number(w, "near", v->near);
        dar_json_write_null(w, "far");
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
    dar_json_write_end(w);
    return DAR_OK;
}

/* ---------------------------------------------------------------- transforms.json */

/* A number of the frame, or else of the whole file; 0 if neither has it. */
static double number(dar_json root, dar_json frame, const char *key, double lo, double hi)
{
    dar_json from = dar_json_get(frame, key).item ? frame : root;
    return dar_json_get(from, key).item ? dar_json_number(from, key, 0, lo, hi) : 0;
}

/* fl, or what the angle gives, or 0. */
static double focal(dar_json root, dar_json frame, const char *fl, const char *angle, int size)
{
    double f = number(root, frame, fl, 1e-6, 1e9);
    if (f > 0) return f;
    double fov = number(root, frame, angle, 1e-6, M_PI - 1e-6);
    return fov > 0 ? dar_camera_focal(fov, size) : 0;
}

static bool has(dar_json root, dar_json frame, const char *key)
{
    return dar_json_get(frame, key).item || dar_json_get(root, key).item;
}

static void read_transform(dar_json root, dar_json j, const dar_camera_options *o, dar_view *v)
{
    static const char *const distortion[] = { "k1", "k2", "k3", "k4", "p1", "p2" };
    *v = (dar_view){ .near = o->near };
    v->width = (int)number(root, j, "w", 1, DAR_CAMERA_MAX_SIZE);
    v->height = (int)number(root, j, "h", 1, DAR_CAMERA_MAX_SIZE);
    if (!v->width && !v->height) {
        v->width = o->width;
        v->height = o->height;
    }
    if (v->width < 1 || v->height < 1) dar_json_reject(root, "w", "w and h, or that the picture's size be given");
    for (size_t i = 0; i < DAR_COUNT(distortion); i++)
        if (number(root, j, distortion[i], -DAR_CAMERA_LARGEST, DAR_CAMERA_LARGEST) != 0)
            dar_json_reject(dar_json_get(j, distortion[i]).item ? j : root, distortion[i], "a lens without distortion");
    double fx = focal(root, j, "fl_x", "camera_angle_x", v->width);
    double fy = focal(root, j, "fl_y", "camera_angle_y", v->height);
    if (!(fx > 0 || fy > 0)) dar_json_reject(root, "camera_angle_x", "camera_angle_x or fl_x");
    v->fx = fx > 0 ? fx : fy;
    v->fy = fy > 0 ? fy : fx;
    v->cx = has(root, j, "cx") ? number(root, j, "cx", -1e9, 1e9) : v->width / 2.0;
    v->cy = has(root, j, "cy") ? number(root, j, "cy", -1e9, 1e9) : v->height / 2.0;
    take_matrix(j, "transform_matrix", o->axes, v);
}

dar_status dar_camera_io_read_transforms(dar_camera_path *p, const char *name, dar_json_doc *doc,
                                         const dar_camera_options *o, dar_err *e)
{
    dar_json root = dar_json_root(doc), list = dar_json_array(root, "frames");
    size_t n = dar_json_size(list), t = 0;
    (void)name;
    dar_json_accept(root);
    if (n < 1 || n > DAR_CAMERA_IO_MAX_FRAMES) {
        dar_json_reject(root, "frames", "1 to %d frames", DAR_CAMERA_IO_MAX_FRAMES);
        return dar_json_finish(doc, e);
    }
    DAR_TRY(dar_camera_init(p, n, e));
    for (dar_json j = dar_json_first(list); j.item; j = dar_json_next(j)) read_transform(root, j, o, &p->view[t++]);
    return dar_json_finish(doc, e);
}

static void print_lens(const dar_view *v, dar_json_writer *w)
{
    dar_json_write_number(w, "camera_angle_x", dar_camera_fov(v->fx, v->width));
    dar_json_write_number(w, "camera_angle_y", dar_camera_fov(v->fy, v->height));
    dar_json_write_number(w, "fl_x", v->fx);
    dar_json_write_number(w, "fl_y", v->fy);
    dar_json_write_number(w, "cx", v->cx);
    dar_json_write_number(w, "cy", v->cy);
}

static bool same_lens(const dar_view *a, const dar_view *b)
{
    return a->fx == b->fx && a->fy == b->fy && a->cx == b->cx && a->cy == b->cy;
}

dar_status dar_camera_io_print_transforms(const dar_camera_path *p, const dar_camera_options *o, dar_json_writer *w,
                                          dar_err *e)
{
    (void)e;
    dar_json_write_object(w, NULL);
    print_lens(&p->view[0], w);
    dar_json_write_int(w, "w", p->view[0].width);
    dar_json_write_int(w, "h", p->view[0].height);
    dar_json_write_array(w, "frames");
    for (size_t t = 0; t < p->frames; t++) {
        const dar_view *v = &p->view[t];
        double m[16];
        char picture[32];
        snprintf(picture, sizeof picture, "images/%05zu", t);
        dar_camera_export(o->axes, v->c2w, m);
        dar_json_write_object(w, NULL);
        dar_json_write_text(w, "file_path", picture);
        if (!same_lens(v, &p->view[0])) print_lens(v, w);
        print_matrix(w, "transform_matrix", 4, 4, m);
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
    dar_json_write_end(w);
    return DAR_OK;
}
