/* camera.c: camera paths. */
#include "data/camera.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/affine.h"
#include "data/rigid.h"

dar_status dar_camera_init(dar_camera_path *p, size_t frames, dar_err *e)
{
    DAR_ASSERT(frames >= 1, "camera path without frames");
    *p = (dar_camera_path){ .frames = frames, .view = calloc(frames, sizeof *p->view) };
    if (p->view) return DAR_OK;
    *p = (dar_camera_path){ 0 };
    return dar_fail(e, DAR_ERR_NOMEM, "camera path of %zu frames: out of memory", frames);
}

void dar_camera_free(dar_camera_path *p)
{
    free(p->view);
    *p = (dar_camera_path){ 0 };
}

const char *dar_camera_fault(const dar_view *v, char text[128])
{
    double askew = dar_rigid_error(v->c2w), far = fmax(fmax(fabs(v->c2w[3]), fabs(v->c2w[7])), fabs(v->c2w[11]));
    int side = v->width < v->height ? v->width : v->height;
    if (side < 1 || v->width > DAR_CAMERA_MAX_SIZE || v->height > DAR_CAMERA_MAX_SIZE)
        snprintf(text, 128, "size %d x %d, expected 1 to %d pixels", v->width, v->height, DAR_CAMERA_MAX_SIZE);
    else if (!(v->fx > 1e-6 && v->fy > 1e-6 && v->fx < 1e9 && v->fy < 1e9))
        snprintf(text, 128, "focal lengths %g, %g pixels, expected 1e-6 to 1e9", v->fx, v->fy);
    else if (!(fabs(v->cx) < 1e9 && fabs(v->cy) < 1e9))
        snprintf(text, 128, "principal point %g, %g, expected numbers below 1e9", v->cx, v->cy);
    else if (!(v->near > 0 && v->near < DAR_CAMERA_LARGEST))
        snprintf(text, 128, "near plane at %g, expected more than 0", v->near);
    else if (!(far <= DAR_CAMERA_LARGEST))
        snprintf(text, 128, "a place as far as %g, expected at most %g", far, DAR_CAMERA_LARGEST);
    else if (!(askew <= DAR_CAMERA_ASKEW))
        snprintf(text, 128, "a matrix that is off a rotation by %.3g, expected at most %g", askew, DAR_CAMERA_ASKEW);
    else return NULL;
    return text;
}

dar_status dar_camera_check(dar_camera_path *p, const char *name, dar_err *e)
{
    char text[128];
    for (size_t t = 0; t < p->frames; t++) {
        dar_view *v = &p->view[t];
        if (dar_camera_fault(v, text)) return dar_fail(e, DAR_ERR_FORMAT, "%s: frame %zu: found %s", name, t, text);
        if (v->width != p->view->width || v->height != p->view->height)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: frame %zu: found size %d x %d, expected that of frame 0, %d x %d",
                            name, t, v->width, v->height, p->view->width, p->view->height);
        if (!dar_rigid_nearest(v->c2w))
            return dar_fail(e, DAR_ERR_FORMAT, "%s: frame %zu: found a matrix that is no rotation", name, t);
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- lenses */

double dar_camera_focal(double fov, double size)
{
    return size / 2 / tan(fov / 2);
}

double dar_camera_fov(double focal, double size)
{
    return 2 * atan(size / 2 / focal);
}

void dar_camera_resize(dar_view *v, int width, int height)
{
    double s = fmax((double)width / v->width, (double)height / v->height);
    if (width == v->width && height == v->height) return; /* not even rounding */
    v->fx *= s;
    v->fy *= s;
    v->cx = (v->cx - v->width / 2.0) * s + width / 2.0;
    v->cy = (v->cy - v->height / 2.0) * s + height / 2.0;
    v->width = width;
    v->height = height;
}

/* ---------------------------------------------------------------- conventions */

const char *const dar_camera_axes_name[DAR_AXES_COUNT + 1] = { "opencv", "opengl", "blender", "unreal", NULL };

/* ours = world theirs camera, places times unit.  Signed permutations: their inverses are their transposes. */
static const struct convention {
    double world[12];  /* their world to ours */
    double camera[12]; /* our camera's axes in theirs */
    double unit;       /* [m] */
    bool rows;         /* vectors are rows */
} conventions[DAR_AXES_COUNT] = {
    [DAR_AXES_OPENCV] = { { 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0 }, { 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0 }, 1, false },
    [DAR_AXES_OPENGL] = { { 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0 }, { 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0 }, 1, false },
    [DAR_AXES_BLENDER] = { { 1, 0, 0, 0, 0, 0, 1, 0, 0, -1, 0, 0 },
                           { 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 0 },
                           1,
                           false },
    [DAR_AXES_UNREAL] = { { 1, 0, 0, 0, 0, 0, 1, 0, 0, 1, 0, 0 }, { 0, 0, 1, 0, 1, 0, 0, 0, 0, -1, 0, 0 }, 0.01, true },
};

bool dar_camera_import(dar_camera_axes axes, const double m[16], double c2w[12])
{
    const struct convention *k = &conventions[axes];
    double theirs[16];
    for (int i = 0; i < 4; i++)
        for (int j = 0; j < 4; j++) theirs[4 * i + j] = k->rows ? m[4 * j + i] : m[4 * i + j];
    for (int i = 0; i < 3; i++) theirs[4 * i + 3] *= k->unit;
    dar_affine_mul(k->world, theirs, c2w);
    dar_affine_mul(c2w, k->camera, c2w);
    return theirs[12] == 0 && theirs[13] == 0 && theirs[14] == 0 && theirs[15] == 1;
}

void dar_camera_export(dar_camera_axes axes, const double c2w[12], double m[16])
{
    const struct convention *k = &conventions[axes];
    double world[12], camera[12], theirs[12];
    dar_rigid_inverse(k->world, world);
    dar_rigid_inverse(k->camera, camera);
    dar_affine_mul(world, c2w, theirs);
    dar_affine_mul(theirs, camera, theirs);
    for (int i = 0; i < 4; i++) {
        for (int j = 0; j < 4; j++) {
            double x = i == 3 ? (j == 3) : theirs[4 * i + j] / (j == 3 ? k->unit : 1);
            m[k->rows ? 4 * j + i : 4 * i + j] = x;
        }
    }
}

/* ---------------------------------------------------------------- key poses */

const char *const dar_camera_turn_name[] = { "slerp", "squad", NULL };
const char *const dar_camera_move_name[] = { "linear", "catmull-rom", NULL };

/* Between v[1] at t[1] and v[2] at t[2]; v[0] before and v[3] after may be NULL. */
typedef struct window {
    const dar_view *v[4];
    double t[4];
} window;

/* The speed at key k, from the slopes before and after it, of which one may be missing: what the parabola through the
 * three keys has. */
static double speed(const window *w, int k, double before, double after)
{
    if (!w->v[k - 1]) return after;
    if (!w->v[k + 1]) return before;
    double h0 = w->t[k] - w->t[k - 1], h1 = w->t[k + 1] - w->t[k];
    return (before * h1 + after * h0) / (h0 + h1);
}

static double place(const window *w, int axis, double u, bool smooth)
{
    double x[4], slope[3], h = w->t[2] - w->t[1];
    for (int i = 0; i < 4; i++) x[i] = w->v[i] ? w->v[i]->c2w[4 * axis + 3] : 0;
    if (!smooth) return x[1] + (x[2] - x[1]) * u;
    for (int i = 0; i < 3; i++) slope[i] = (x[i + 1] - x[i]) / (w->t[i + 1] - w->t[i]);
    double m1 = h * speed(w, 1, slope[0], slope[1]), m2 = h * speed(w, 2, slope[1], slope[2]);
    double u2 = u * u, u3 = u2 * u;
    return (2 * u3 - 3 * u2 + 1) * x[1] + (u3 - 2 * u2 + u) * m1 + (3 * u2 - 2 * u3) * x[2] + (u3 - u2) * m2;
}

/* squad(u) = slerp(slerp(q1, q2, u), slerp(a, b, u), 2 u (1 - u)).  Its derivative at u = 0 is q1 (log(q1^-1 q2) +
 * 2 log(q1^-1 a)), at u = 1 q2 (log(q1^-1 q2) - 2 log(q2^-1 b)); a and b are chosen so that these are the speeds at the
 * keys.  Source: Shoemake 1987; for keys at equal distances these are his points. */
static void turn(const window *w, double u, bool smooth, double q[4])
{
    double k[4][4], slope[3][3], inner[2][4], chord[4], diagonal[4], h = w->t[2] - w->t[1];
    for (int i = 0; i < 4; i++)
        if (w->v[i]) dar_rigid_quat(w->v[i]->c2w, k[i]);
    if (!smooth) {
        dar_quat_slerp(k[1], k[2], u, q);
        return;
    }
    for (int i = 0; i < 3; i++) {
        if (!w->v[i] || !w->v[i + 1]) continue;
        double back[4] = { -k[i][0], -k[i][1], -k[i][2], k[i][3] }, step[4];
        dar_quat_mul(back, k[i + 1], step);
        dar_quat_log(step, slope[i]);
        for (int a = 0; a < 3; a++) slope[i][a] /= w->t[i + 1] - w->t[i];
    }
    for (int end = 0; end < 2; end++) {
        double v[3], step[4];
        for (int a = 0; a < 3; a++) {
            double before = w->v[end] ? slope[end][a] : 0, after = w->v[end + 2] ? slope[end + 1][a] : 0;
            double excess = speed(w, end + 1, before, after) - slope[1][a];
            v[a] = h * (end ? -excess : excess) / 2;
        }
        dar_quat_exp(v, step);
        dar_quat_mul(k[end + 1], step, inner[end]);
    }
    dar_quat_slerp(k[1], k[2], u, chord);
    dar_quat_slerp(inner[0], inner[1], u, diagonal);
    dar_quat_slerp(chord, diagonal, 2 * u * (1 - u), q);
}

static void blend(const window *w, dar_camera_style style, double time, dar_view *v)
{
    const dar_view *a = w->v[1], *b = w->v[2];
    double u = (time - w->t[1]) / (w->t[2] - w->t[1]), q[4], t[3];
    dar_view y = *a;
    DAR_ASSERT(a->width == b->width && a->height == b->height, "camera keys of different sizes");
    y.fx += (b->fx - a->fx) * u;
    y.fy += (b->fy - a->fy) * u;
    y.cx += (b->cx - a->cx) * u;
    y.cy += (b->cy - a->cy) * u;
    y.near += (b->near - a->near) * u;
    for (int i = 0; i < 3; i++) t[i] = place(w, i, u, style.move == DAR_MOVE_CATMULL_ROM);
    turn(w, u, style.turn == DAR_TURN_SQUAD, q);
    dar_rigid_of_quat(q, t, y.c2w);
    *v = y;
}

void dar_camera_between(const dar_camera_key *key, size_t keys, dar_camera_style style, double time, dar_view *v)
{
    size_t i = 0, above = keys; /* key i is at or before `time`, unless it is the first; key `above` is after it */
    window w = { { NULL }, { 0 } };
    DAR_ASSERT(keys >= 1, "camera path without keys");
    while (above - i > 1) {
        size_t middle = i + (above - i) / 2;
        if (key[middle].time <= time) i = middle;
        else above = middle;
    }
    if (i + 1 == keys || time <= key[i].time) {
        *v = key[i].view;
        return;
    }
    for (size_t k = 0; k < 4; k++) {
        if (i + k < 1 || i + k > keys) continue;
        w.v[k] = &key[i + k - 1].view;
        w.t[k] = key[i + k - 1].time;
        DAR_ASSERT(k == 0 || !w.v[k - 1] || w.t[k] > w.t[k - 1], "camera keys: time %g after %g", w.t[k], w.t[k - 1]);
    }
    blend(&w, style, time, v);
}

void dar_camera_fill(dar_camera_path *p, const dar_camera_key *key, size_t keys, dar_camera_style style)
{
    double begin = key[0].time, length = key[keys - 1].time - begin, last = p->frames > 1 ? (double)p->frames - 1 : 1;
    for (size_t t = 0; t < p->frames; t++)
        dar_camera_between(key, keys, style, begin + length * ((double)t / last), &p->view[t]);
}

void dar_camera_resample(const dar_camera_path *x, dar_camera_style style, dar_camera_path *y)
{
    for (size_t f = 0; f < y->frames; f++) {
        double time = y->frames > 1 ? (double)f * (double)(x->frames - 1) / (double)(y->frames - 1) : 0;
        size_t i = (size_t)time;
        window w = { { NULL }, { 0 } };
        for (size_t k = 0; k < 4; k++) {
            w.t[k] = (double)i + (double)k - 1;
            if (i + k >= 1 && i + k <= x->frames) w.v[k] = &x->view[i + k - 1];
        }
        if (time == (double)i) y->view[f] = x->view[i];
        else blend(&w, style, time, &y->view[f]);
    }
}

/* ---------------------------------------------------------------- whole paths */

void dar_camera_relative(dar_camera_path *p)
{
    double w2c[12];
    dar_rigid_inverse(p->view[0].c2w, w2c);
    dar_camera_transform(p, w2c);
    memcpy(p->view[0].c2w, dar_affine_identity, sizeof p->view[0].c2w);
}

void dar_camera_scale(dar_camera_path *p, double s)
{
    DAR_ASSERT(s > 0, "camera path scaled by %g", s);
    for (size_t t = 0; t < p->frames; t++) {
        for (int i = 0; i < 3; i++) p->view[t].c2w[4 * i + 3] *= s;
        p->view[t].near *= s;
    }
}

void dar_camera_transform(dar_camera_path *p, const double m[12])
{
    for (size_t t = 0; t < p->frames; t++) dar_affine_mul(m, p->view[t].c2w, p->view[t].c2w);
}
