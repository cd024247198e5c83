/* camera_gltf.c: cameras of glTF 2.0 files (3.10 of the specification). */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/camera_io.h"
#include "data/rigid.h"

/* Look along -z, y up: the direction of view is kept if the axes are not at right angles. */
static bool orient(const double world[12], double c2w[12])
{
    double eye[3], target[3], up[3];
    for (int i = 0; i < 3; i++) {
        eye[i] = world[4 * i + 3];
        up[i] = world[4 * i + 1];
    }
    double length = sqrt(world[2] * world[2] + world[6] * world[6] + world[10] * world[10]);
    double forward[3] = { -world[2] / length, -world[6] / length, -world[10] / length }, origin[3] = { 0 };
    memcpy(target, forward, sizeof target);
    if (!(length > 0) || !isfinite(length) || !dar_rigid_look_at(origin, target, up, c2w)) return false;
    for (int i = 0; i < 3; i++) c2w[4 * i + 3] = eye[i];
    return true;
}

dar_status dar_camera_io_from_lens(dar_camera_path *p, const dar_lens *lens, const double (*world)[12], size_t frames,
                                   int width, int height, dar_err *e)
{
    *p = (dar_camera_path){ 0 };
    if (lens->orthographic)
        return dar_fail(e, DAR_ERR_FORMAT, "camera \"%s\": found an orthographic one, expected perspective",
                        lens->name);
    DAR_TRY(dar_camera_init(p, frames, e));
    double f = dar_camera_focal(lens->yfov, height);
    for (size_t t = 0; t < frames; t++) {
        p->view[t] = (dar_view){ .width = width, .height = height, .fx = f, .fy = f, .cx = width / 2.0 };
        p->view[t].cy = height / 2.0;
        p->view[t].near = lens->near > 0 ? lens->near : DAR_CAMERA_NEAR;
        if (!orient(world[t], p->view[t].c2w))
            return dar_fail(e, DAR_ERR_NUMERIC, "camera \"%s\": frame %zu: found a node without extent", lens->name, t);
    }
    return dar_camera_check(p, lens->name, e);
}

/* ---------------------------------------------------------------- writing */

/* "data:...;base64," and the bytes; NULL: no memory.  The caller frees it. */
static char *data_uri(const void *data, size_t size)
{
    static const char digit[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    static const char head[] = "data:application/octet-stream;base64,";
    const unsigned char *x = data;
    char *uri = malloc(sizeof head + (size + 2) / 3 * 4), *p = uri;
    if (!uri) return NULL;
    memcpy(p, head, sizeof head - 1);
    p += sizeof head - 1;
    for (size_t i = 0; i < size; i += 3) {
        unsigned bits = (unsigned)x[i] << 16, n = size - i < 3 ? (unsigned)(size - i) : 3;
        if (n > 1) bits |= (unsigned)x[i + 1] << 8;
        if (n > 2) bits |= x[i + 2];
        for (unsigned k = 0; k < 4; k++) *p++ = k <= n ? digit[bits >> (18 - 6 * k) & 63] : '=';
    }
    *p = 0;
    return uri;
}

static dar_status check_lens(const dar_camera_path *p, dar_err *e)
{
    const dar_view *a = &p->view[0];
    if (a->fx != a->fy || a->cx != a->width / 2.0 || a->cy != a->height / 2.0)
        return dar_fail(e, DAR_ERR_USAGE,
                        "glTF: found fx %g, fy %g, cx %g, cy %g, expected square pixels about the centre", a->fx, a->fy,
                        a->cx, a->cy);
    for (size_t t = 1; t < p->frames; t++)
        if (p->view[t].fx != a->fx || p->view[t].fy != a->fy || p->view[t].cx != a->cx || p->view[t].cy != a->cy)
            return dar_fail(e, DAR_ERR_USAGE, "glTF: frame %zu: found another lens, expected that of frame 0", t);
    return DAR_OK;
}

/* Translation and rotation of the node, rotations on one side of the sphere. */
static void node_at(const dar_camera_path *p, size_t t, float translation[3], float rotation[4])
{
    double m[16], c2w[12], q[4], dot = 0;
    dar_camera_export(DAR_AXES_OPENGL, p->view[t].c2w, m);
    memcpy(c2w, m, sizeof c2w);
    dar_rigid_quat(c2w, q);
    if (t > 0)
        for (int i = 0; i < 4; i++) dot += q[i] * (double)rotation[i - 4];
    for (int i = 0; i < 3; i++) translation[i] = (float)c2w[4 * i + 3];
    for (int i = 0; i < 4; i++) rotation[i] = (float)(dot < 0 ? -q[i] : q[i]);
}

static void print_floats(dar_json_writer *w, const char *key, const float *x, int n)
{
    dar_json_write_array(w, key);
    for (int i = 0; i < n; i++) dar_json_write_number(w, NULL, (double)x[i]);
    dar_json_write_end(w);
}

static void print_node(const dar_view *v, const float *translation, const float *rotation, dar_json_writer *w)
{
    dar_json_write_object(w, "asset");
    dar_json_write_text(w, "version", "2.0");
    dar_json_write_end(w);
    dar_json_write_int(w, "scene", 0);
    dar_json_write_array(w, "scenes");
    dar_json_write_object(w, NULL);
    dar_json_write_array(w, "nodes");
    dar_json_write_int(w, NULL, 0);
    dar_json_write_end(w);
    dar_json_write_end(w);
    dar_json_write_end(w);
    dar_json_write_array(w, "cameras");
    dar_json_write_object(w, NULL);
    dar_json_write_text(w, "type", "perspective");
    dar_json_write_object(w, "perspective");
    dar_json_write_number(w, "yfov", dar_camera_fov(v->fy, v->height));
    dar_json_write_number(w, "aspectRatio", (double)v->width / v->height);
    dar_json_write_number(w, "znear", v->near);
    dar_json_write_end(w);
    dar_json_write_end(w);
    dar_json_write_end(w);
    dar_json_write_array(w, "nodes");
    dar_json_write_object(w, NULL);
    dar_json_write_text(w, "name", "camera");
    dar_json_write_int(w, "camera", 0);
    print_floats(w, "translation", translation, 3);
    print_floats(w, "rotation", rotation, 4);
    dar_json_write_end(w);
    dar_json_write_end(w);
}

/* The three pieces of the buffer: times, translations, rotations. */
static void print_accessors(size_t n, const float *time, dar_json_writer *w)
{
    static const char *const type[] = { "SCALAR", "VEC3", "VEC4" };
    static const size_t width[] = { 1, 3, 4 }, begin[] = { 0, 1, 4 };
    dar_json_write_array(w, "bufferViews");
    for (int i = 0; i < 3; i++) {
        dar_json_write_object(w, NULL);
        dar_json_write_int(w, "buffer", 0);
        dar_json_write_int(w, "byteOffset", (int64_t)(begin[i] * n * sizeof(float)));
        dar_json_write_int(w, "byteLength", (int64_t)(width[i] * n * sizeof(float)));
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
    dar_json_write_array(w, "accessors");
    for (int i = 0; i < 3; i++) {
        dar_json_write_object(w, NULL);
        dar_json_write_int(w, "bufferView", i);
        dar_json_write_int(w, "componentType", 5126); /* FLOAT */
        dar_json_write_int(w, "count", (int64_t)n);
        dar_json_write_text(w, "type", type[i]);
        if (i == 0) {
            print_floats(w, "min", &time[0], 1);
            print_floats(w, "max", &time[n - 1], 1);
        }
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
}

static void print_animation(dar_json_writer *w)
{
    static const char *const path[] = { "translation", "rotation" };
    dar_json_write_array(w, "animations");
    dar_json_write_object(w, NULL);
    dar_json_write_text(w, "name", "camera");
    dar_json_write_array(w, "samplers");
    for (int i = 0; i < 2; i++) {
        dar_json_write_object(w, NULL);
        dar_json_write_int(w, "input", 0);
        dar_json_write_int(w, "output", i + 1);
        dar_json_write_text(w, "interpolation", "LINEAR");
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
    dar_json_write_array(w, "channels");
    for (int i = 0; i < 2; i++) {
        dar_json_write_object(w, NULL);
        dar_json_write_int(w, "sampler", i);
        dar_json_write_object(w, "target");
        dar_json_write_int(w, "node", 0);
        dar_json_write_text(w, "path", path[i]);
        dar_json_write_end(w);
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
    dar_json_write_end(w);
    dar_json_write_end(w);
}

dar_status dar_camera_io_print_gltf(const dar_camera_path *p, const dar_camera_options *o, dar_json_writer *w,
                                    dar_err *e)
{
    size_t n = p->frames, bytes = 8 * n * sizeof(float);
    DAR_TRY(check_lens(p, e));
    DAR_ASSERT(o->fps > 0, "glTF camera at %g frames per second", o->fps);
    float *time = malloc(bytes);
    if (!time) return dar_fail(e, DAR_ERR_NOMEM, "glTF camera of %zu frames: out of memory", n);
    float *translation = time + n, *rotation = time + 4 * n;
    for (size_t t = 0; t < n; t++) {
        time[t] = (float)((double)t / o->fps);
        node_at(p, t, translation + 3 * t, rotation + 4 * t);
    }
    char *uri = data_uri(time, bytes);
    dar_status s = uri ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "glTF camera of %zu frames: out of memory", n);
    if (uri) {
        dar_json_write_object(w, NULL);
        print_node(&p->view[0], translation, rotation, w);
        dar_json_write_array(w, "buffers");
        dar_json_write_object(w, NULL);
        dar_json_write_int(w, "byteLength", (int64_t)bytes);
        dar_json_write_text(w, "uri", uri);
        dar_json_write_end(w);
        dar_json_write_end(w);
        print_accessors(n, time, w);
        print_animation(w);
        dar_json_write_end(w);
    }
    free(uri);
    free(time);
    return s;
}
