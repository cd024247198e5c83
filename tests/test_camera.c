/* test_camera.c: conventions, key poses, camera files, trajectories. */
#include "tests/scratch.h"

#include "data/affine.h"
#include "data/camera.h"
#include "data/camera_io.h"
#include "data/gltf.h"
#include "data/pose.h"
#include "data/rigid.h"
#include "data/trajectory.h"
#include "lib/rng.h"

#define DEGREE (M_PI / 180)

static void check_matrix(const char *what, const double *found, const double *expected, int n, double bound)
{
    for (int i = 0; i < n; i++) CHECK_NEAR(what, found[i], expected[i], bound);
}

/* A pose made of numbers from a seed. */
static void any_pose(uint64_t seed, double c2w[12])
{
    double q[4], t[3];
    for (uint64_t i = 0; i < 4; i++) q[i] = dar_rng_normal(seed, 1, i);
    for (uint64_t i = 0; i < 3; i++) t[i] = 5 * dar_rng_normal(seed, 2, i);
    dar_quat_unit(q);
    dar_rigid_of_quat(q, t, c2w);
}

static dar_view any_view(uint64_t seed)
{
    dar_view v = { 832, 480, 500 + (double)seed, 510, 400, 250, { 0 }, 0.25 };
    any_pose(seed, v.c2w);
    return v;
}

/* About the axis (0 x, 1 y, 2 z). */
static dar_view turned(int axis, double angle, double x)
{
    dar_view v = { 64, 48, 50, 50, 32, 24, { 0 }, 0.1 };
    double q[4] = { 0, 0, 0, cos(angle / 2) }, t[3] = { x, 2 * x, -x };
    q[axis] = sin(angle / 2);
    dar_rigid_of_quat(q, t, v.c2w);
    return v;
}

/* ---------------------------------------------------------------- matrices */

static void rigid(void **state)
{
    (void)state;
    for (uint64_t seed = 0; seed < 200; seed++) {
        double m[12], back[12], y[12], q[4], v[3], q2[4];
        any_pose(seed, m);
        CHECK_NEAR("error of a rotation", dar_rigid_error(m), 0, 1e-14);
        dar_rigid_inverse(m, back);
        dar_affine_mul(m, back, y);
        check_matrix("m m^-1", y, dar_affine_identity, 12, 1e-13);
        dar_rigid_quat(m, q);
        const double t[3] = { m[3], m[7], m[11] };
        dar_rigid_of_quat(q, t, y);
        check_matrix("matrix of its quaternion", y, m, 12, 1e-14);
        dar_quat_log(q, v);
        dar_quat_exp(v, q2);
        check_matrix("exp log", q2, q, 4, 1e-14);
        for (uint64_t i = 0; i < 12; i++) y[i] = m[i] + (i % 4 == 3 ? 0 : 1e-4 * dar_rng_normal(seed, 3, i));
        assert_true(dar_rigid_nearest(y));
        CHECK_NEAR("error of the nearest", dar_rigid_error(y), 0, 1e-14);
        check_matrix("nearest", y, m, 12, 1e-3);
    }
    double mirror[12] = { 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0 }, flat[12] = { 1 };
    assert_true(dar_rigid_error(mirror) >= 2 && !dar_rigid_nearest(mirror) && !dar_rigid_nearest(flat));
    /* Half a turn about each axis: w is 0, the sign of the axis free. */
    for (int axis = 0; axis < 3; axis++) {
        double q[4];
        dar_view v = turned(axis, M_PI, 0);
        dar_rigid_quat(v.c2w, q);
        CHECK_NEAR("half a turn", fabs(q[axis]), 1, 1e-15);
    }
}

static void look_at(void **state)
{
    (void)state;
    static const double eye[3] = { 0, 0, 5 }, up[3] = { 0, 1, 0 }, target[3] = { 0, 0, 0 }, below[3] = { 0, 0, -1 };
    static const double expected[12] = { 1, 0, 0, 0, 0, -1, 0, 0, 0, 0, -1, 5 };
    double m[12];
    assert_true(dar_rigid_look_at(eye, target, up, m));
    check_matrix("from +z", m, expected, 12, 1e-15);
    assert_true(dar_rigid_look_at(eye, target, below, m)); /* up along the view */
    CHECK_NEAR("straight down", dar_rigid_error(m), 0, 1e-15);
    assert_false(dar_rigid_look_at(eye, eye, up, m));
}

static void conventions(void **state)
{
    (void)state;
    /* A camera at (1, 2, 3) that looks along the world's -z, y up, as glTF writes it: the identity. */
    static const double gl[16] = { 1, 0, 0, 1, 0, 1, 0, 2, 0, 0, 1, 3, 0, 0, 0, 1 };
    static const double gl_ours[12] = { 1, 0, 0, 1, 0, -1, 0, 2, 0, 0, -1, 3 };
    /* Blender's front view from 3 m: at (0, -3, 1), looking along +y, up +z.  In a world with y up: at (0, 1, 3),
     * looking along -z. */
    static const double blender[16] = { 1, 0, 0, 0, 0, 0, -1, -3, 0, 1, 0, 1, 0, 0, 0, 1 };
    static const double blender_ours[12] = { 1, 0, 0, 0, 0, -1, 0, 1, 0, 0, -1, 3 };
    /* Unreal, no rotation: at x = 100, y = 200, z = 300 cm, looking along +x, right +y, up +z.  As glTF: at (1, 3, 2),
     * looking along +x, right +z, up +y. */
    static const double unreal[16] = { 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 100, 200, 300, 1 };
    static const double unreal_ours[12] = { 0, 0, 1, 1, 0, -1, 0, 3, 1, 0, 0, 2 };
    double m[12], back[16];
    assert_true(dar_camera_import(DAR_AXES_OPENGL, gl, m));
    check_matrix("opengl", m, gl_ours, 12, 0);
    assert_true(dar_camera_import(DAR_AXES_BLENDER, blender, m));
    check_matrix("blender", m, blender_ours, 12, 0);
    assert_true(dar_camera_import(DAR_AXES_UNREAL, unreal, m));
    check_matrix("unreal", m, unreal_ours, 12, 1e-15);
    assert_false(dar_camera_import(DAR_AXES_OPENCV, unreal, m)); /* translation where 0 0 0 1 should be */
    for (int axes = 0; axes < DAR_AXES_COUNT; axes++) {
        for (uint64_t seed = 0; seed < 20; seed++) {
            double x[12];
            any_pose(seed, x);
            dar_camera_export((dar_camera_axes)axes, x, back);
            assert_true(dar_camera_import((dar_camera_axes)axes, back, m));
            check_matrix(dar_camera_axes_name[axes], m, x, 12, 1e-14);
        }
    }
}

static void lenses(void **state)
{
    (void)state;
    CHECK_NEAR("90 degrees over 200 px", dar_camera_focal(M_PI / 2, 200), 100, 1e-12);
    CHECK_NEAR("and back", dar_camera_fov(100, 200), M_PI / 2, 1e-15);
    dar_view v = { 1280, 720, 1000, 1000, 640, 350, { 0 }, 1 };
    dar_camera_resize(&v, 832, 480); /* 480 / 720 covers; 21.33 px go at the sides */
    CHECK_NEAR("fx", v.fx, 1000 * 2 / 3.0, 1e-10);
    CHECK_NEAR("cx", v.cx, 416, 1e-10);
    CHECK_NEAR("cy", v.cy, 240 - 10 * 2 / 3.0, 1e-10);
}

/* ---------------------------------------------------------------- key poses */

static double angle_between(const dar_view *a, const dar_view *b)
{
    double w2c[12], m[12], q[4], v[3];
    dar_rigid_inverse(a->c2w, w2c);
    dar_affine_mul(w2c, b->c2w, m);
    dar_rigid_quat(m, q);
    dar_quat_log(q, v);
    return 2 * sqrt(dar_vec_dot(v, v));
}

static void between(void **state)
{
    (void)state;
    static const dar_camera_style plain = { DAR_TURN_SLERP, DAR_MOVE_LINEAR };
    static const dar_camera_style smooth = { DAR_TURN_SQUAD, DAR_MOVE_CATMULL_ROM };
    dar_camera_key two[2] = { { 1, turned(1, 0, 0) }, { 3, turned(1, 90 * DEGREE, 4) } };
    dar_view v, expected = turned(1, 45 * DEGREE, 2);
    dar_camera_between(two, 2, plain, 2, &v);
    check_matrix("half way", v.c2w, expected.c2w, 12, 1e-15);
    dar_camera_between(two, 2, plain, 0, &v);
    check_matrix("before the first", v.c2w, two[0].view.c2w, 12, 0);
    dar_camera_between(two, 2, plain, 9, &v);
    check_matrix("after the last", v.c2w, two[1].view.c2w, 12, 0);

    /* 350 degrees are 10 the other way round. */
    dar_camera_key around[2] = { { 0, turned(2, 0, 0) }, { 1, turned(2, 350 * DEGREE, 0) } };
    dar_camera_between(around, 2, plain, 0.5, &v);
    expected = turned(2, -5 * DEGREE, 0);
    check_matrix("the shorter way", v.c2w, expected.c2w, 12, 1e-15);

    /* Turning and moving at constant speed, keys at any distance: every style agrees. */
    dar_camera_key even[5];
    static const double time[5] = { 0, 1, 1.5, 4, 6 };
    for (int i = 0; i < 5; i++) even[i] = (dar_camera_key){ time[i], turned(0, 0.3 * time[i], 0.7 * time[i]) };
    for (double t = 0; t <= 6; t += 0.125) {
        expected = turned(0, 0.3 * t, 0.7 * t);
        dar_camera_between(even, 5, smooth, t, &v);
        check_matrix("constant speed", v.c2w, expected.c2w, 12, 1e-14);
    }
}

static void smooth_keys(void **state)
{
    (void)state;
    static const dar_camera_style smooth = { DAR_TURN_SQUAD, DAR_MOVE_CATMULL_ROM };
    static const double time[5] = { 0, 1, 2.5, 3, 5 };
    dar_camera_key key[5];
    dar_view v, a, b;
    /* Places on a parabola: the spline is that parabola between inner keys. */
    for (int i = 0; i < 5; i++) {
        key[i] = (dar_camera_key){ time[i], any_view((uint64_t)i) };
        key[i].view.c2w[3] = time[i] * time[i];
    }
    for (double t = 1; t <= 3; t += 0.0625) {
        dar_camera_between(key, 5, smooth, t, &v);
        CHECK_NEAR("parabola", v.c2w[3], t * t, 1e-13);
        CHECK_NEAR("rotation", dar_rigid_error(v.c2w), 0, 1e-14);
    }
    /* At the keys the pose is the key's; the speeds on both sides are equal.  The difference quotient over h is off by
     * the curvature times h, below 1e-4 here. */
    double h = 1e-6;
    for (int i = 1; i < 4; i++) {
        dar_camera_between(key, 5, smooth, time[i], &v);
        check_matrix("key", v.c2w, key[i].view.c2w, 12, 0);
        dar_camera_between(key, 5, smooth, time[i] - h, &a);
        dar_camera_between(key, 5, smooth, time[i] + h, &b);
        for (int k = 0; k < 12; k++) CHECK_NEAR("speed", (b.c2w[k] - v.c2w[k]) / h, (v.c2w[k] - a.c2w[k]) / h, 1e-4);
    }
    CHECK_ABORTS(dar_camera_between((dar_camera_key[]){ key[0], key[2], key[1], key[3] }, 4, smooth, 0.5, &v));
}

static void paths(void **state)
{
    (void)state;
    static const dar_camera_style smooth = { DAR_TURN_SQUAD, DAR_MOVE_CATMULL_ROM };
    dar_camera_path x, y;
    assert_true(dar_camera_init(&x, 5, NULL) == DAR_OK && dar_camera_init(&y, 17, NULL) == DAR_OK);
    for (size_t t = 0; t < 5; t++) x.view[t] = any_view(t);
    dar_camera_resample(&x, smooth, &y);
    for (size_t t = 0; t < 5; t++) check_matrix("every fourth", y.view[4 * t].c2w, x.view[t].c2w, 12, 0);
    CHECK_NEAR("focal length", y.view[2].fx, 500.5, 1e-12);
    double angle = angle_between(&x.view[1], &x.view[3]), before[12], after[12], m[12];
    dar_rigid_inverse(x.view[1].c2w, before);
    dar_affine_mul(before, x.view[3].c2w, before);
    dar_camera_relative(&x);
    check_matrix("frame 0", x.view[0].c2w, dar_affine_identity, 12, 0);
    CHECK_NEAR("angles stay", angle_between(&x.view[1], &x.view[3]), angle, 1e-13);
    dar_rigid_inverse(x.view[1].c2w, m);
    dar_affine_mul(m, x.view[3].c2w, after);
    check_matrix("poses to each other stay", after, before, 12, 1e-13);
    double place = x.view[3].c2w[7];
    dar_camera_scale(&x, 0.01);
    CHECK_NEAR("place", x.view[3].c2w[7], place * 0.01, 1e-15);
    CHECK_NEAR("near", x.view[3].near, 0.0025, 1e-15);
    dar_camera_free(&x);
    dar_camera_free(&y);
}

/* ---------------------------------------------------------------- files */

static void check_views(const char *what, const dar_camera_path *x, const dar_camera_path *y, double bound, bool near)
{
    CHECK(x->frames == y->frames, "%s: %zu frames, expected %zu", what, x->frames, y->frames);
    for (size_t t = 0; t < x->frames; t++) {
        const dar_view *a = &x->view[t], *b = &y->view[t];
        CHECK(a->width == b->width && a->height == b->height, "%s: size %d x %d", what, a->width, a->height);
        CHECK_NEAR(what, a->fx, b->fx, bound * 1000);
        CHECK_NEAR(what, a->fy, b->fy, bound * 1000);
        CHECK_NEAR(what, a->cx, b->cx, bound * 1000);
        CHECK_NEAR(what, a->cy, b->cy, bound * 1000);
        check_matrix(what, a->c2w, b->c2w, 12, bound * 10);
        if (near) CHECK_NEAR(what, a->near, b->near, bound);
    }
}

/* A path of 5 frames through the format; numbers are written so that they come back, and a place is rotated twice. */
static void round_trips(void **state)
{
    (void)state;
    for (int format = 0; format < DAR_CAMERA_GLTF; format++) {
        for (int way = 0; way < 4; way++) {
            dar_camera_options o = dar_camera_io_standard();
            dar_camera_path x, y;
            dar_err e = { "" };
            const char *path = in_dir("camera");
            if (way == 1) o.pose_width = o.pose_height = 0;
            if (way == 2) o.axes = DAR_AXES_BLENDER;
            assert_true(dar_camera_init(&x, 5, NULL) == DAR_OK);
            for (size_t t = 0; t < 5; t++) {
                x.view[t] = any_view(way == 3 ? 7 : t);
                if (way == 3) x.view[t].width = 300; /* taller than 16:9 is wide */
            }
            CHECK(dar_camera_io_write(&x, path, (dar_camera_format)format, &o, &e) == DAR_OK, "%s", e.text);
            if (format == DAR_CAMERA_POSES) {
                o.width = x.view[0].width;
                o.height = x.view[0].height;
            }
            CHECK(dar_camera_io_read(&y, path, DAR_CAMERA_ANY, &o, &e) == DAR_OK, "%s", e.text);
            check_views(dar_camera_format_name[format], &y, &x, 1e-15, format == DAR_CAMERA_JSON);
            dar_camera_free(&x);
            dar_camera_free(&y);
            unlink(path);
        }
    }
}

static dar_status parse(dar_camera_path *p, const char *text, const dar_camera_options *o, dar_err *e)
{
    return dar_camera_io_parse(p, "f", text, strlen(text), DAR_CAMERA_ANY, o, e);
}

/* The figures of the presets that are around: 81 frames, "pan" along x. */
static void poses(void **state)
{
    (void)state;
    static const char text[] = "https://somewhere\n"
                               "0 0.532139961 0.946026558 0.5 0.5 0 0 1 0 0 0 0 1 0 0 0 0 1 0\r\n"
                               "1 0.532139961 0.946026558 0.5 0.5 0 0  0 0 1 0.25 0 1 0 0 -1 0 0 2\n\n";
    dar_camera_options o = dar_camera_io_standard();
    dar_camera_path p;
    dar_err e = { "" };
    o.width = 832;
    o.height = 480;
    CHECK(parse(&p, text, &o, &e) == DAR_OK, "%s", e.text);
    assert_int_equal(p.frames, 2);
    CHECK_NEAR("fx", p.view[0].fx, 0.532139961 * 480 * 16 / 9, 1e-10);
    CHECK_NEAR("fx, as the reference gives it", p.view[0].fx, 454.09, 0.005);
    CHECK_NEAR("fy", p.view[0].fy, 454.09, 0.005);
    CHECK_NEAR("cx", p.view[0].cx, 416, 0);
    CHECK_NEAR("cy", p.view[0].cy, 240, 0);
    /* w2c: x_c = z + 0.25, y_c = y, z_c = -x + 2: the camera is at x = 2, z = -0.25. */
    static const double c2w[12] = { 0, 0, -1, 2, 0, 1, 0, 0, 1, 0, 0, -0.25 };
    check_matrix("c2w", p.view[1].c2w, c2w, 12, 1e-15);
    dar_camera_free(&p);
    o.width = 480; /* taller than 16:9 no more: fy gives way in pictures that are wider only */
    o.height = 240;
    CHECK(parse(&p, text, &o, &e) == DAR_OK, "%s", e.text);
    CHECK_NEAR("fx of a wide picture", p.view[0].fx, 0.532139961 * 480, 1e-10);
    CHECK_NEAR("fy of a wide picture", p.view[0].fy, 0.946026558 * 480 * 9 / 16, 1e-10);
    dar_camera_free(&p);
}

static void transforms(void **state)
{
    (void)state;
    static const char text[] =
        "{\"camera_angle_x\": 1.5707963267948966, \"aabb_scale\": 16, \"k1\": 0, \"frames\": ["
        "{\"file_path\": \"a\", \"transform_matrix\": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]},"
        "{\"fl_x\": 70, \"fl_y\": 80, \"cx\": 40, \"transform_matrix\": [[1,0,0,1],[0,1,0,2],[0,0,1,3],[0,0,0,1]]}]}";
    static const double c2w[12] = { 1, 0, 0, 1, 0, -1, 0, 2, 0, 0, -1, 3 };
    dar_camera_options o = dar_camera_io_standard();
    dar_camera_path p;
    dar_err e = { "" };
    o.width = 100;
    o.height = 60;
    CHECK(parse(&p, text, &o, &e) == DAR_OK, "%s", e.text);
    check_matrix("c2w", p.view[0].c2w, c2w, 12, 0);
    CHECK_NEAR("fx", p.view[0].fx, 50, 1e-12);
    CHECK_NEAR("fy", p.view[0].fy, 50, 1e-12);
    CHECK_NEAR("cy", p.view[0].cy, 30, 0);
    CHECK_NEAR("fx of a frame", p.view[1].fx, 70, 0);
    CHECK_NEAR("fy of a frame", p.view[1].fy, 80, 0);
    CHECK_NEAR("cx of a frame", p.view[1].cx, 40, 0);
    dar_camera_free(&p);
}

#define VIEW(rest) "{\"K\": [[50,0,32],[0,50,24],[0,0,1]], \"c2w\": " rest "}"
#define UNIT       "[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]"
#define HEAD       "{\"format\": \"dar-cameras/1\", \"width\": 64, \"height\": 48, "

static void key_poses(void **state)
{
    (void)state;
    static const char text[] = HEAD "\"frames\": 5, \"turn\": \"slerp\", \"keys\": [" VIEW(
        UNIT ", \"time\": 0") "," VIEW("[[0,0,1,8],[0,1,0,0],[-1,0,0,0],[0,0,0,1]], \"time\": 2") "]}";
    dar_camera_options o = dar_camera_io_standard();
    dar_camera_path p;
    dar_err e = { "" };
    CHECK(parse(&p, text, &o, &e) == DAR_OK, "%s", e.text);
    assert_int_equal(p.frames, 5);
    CHECK_NEAR("place", p.view[2].c2w[3], 4, 1e-15);
    CHECK_NEAR("cosine", p.view[2].c2w[0], sqrt(0.5), 1e-15);
    CHECK_NEAR("quarter", angle_between(&p.view[0], &p.view[1]), M_PI / 8, 1e-14);
    dar_camera_free(&p);
}

static void gltf(void **state)
{
    (void)state;
    dar_camera_options o = dar_camera_io_standard();
    dar_camera_path x, y;
    dar_scene s;
    dar_pose pose;
    dar_arena a;
    dar_err e = { "" };
    const char *path = in_dir("camera.gltf");
    double(*world)[12] = calloc(9, sizeof *world);
    assert_true(dar_camera_init(&x, 9, NULL) == DAR_OK);
    for (size_t t = 0; t < 9; t++) {
        x.view[t] = (dar_view){ 832, 480, 700, 700, 416, 240, { 0 }, 0.25 };
        any_pose(t, x.view[t].c2w);
    }
    CHECK(dar_camera_io_write(&x, path, DAR_CAMERA_GLTF, &o, &e) == DAR_OK, "%s", e.text);
    CHECK(dar_gltf_load(&s, path, false, &e) == DAR_OK, "%s", e.text);
    CHECK(dar_arena_init(&a, "pose", 1 << 20, &e) == DAR_OK, "%s", e.text);
    assert_true(s.cameras == 1 && s.animations == 1);
    dar_pose_init(&pose, &s, &a);
    for (size_t t = 0; t < 9; t++) {
        CHECK(dar_pose_at(&pose, 0, (double)t / o.fps, &e) == DAR_OK, "%s", e.text);
        memcpy(world[t], pose.world[0], sizeof world[t]);
        for (int i = 0; i < 12; i++)
            if (i % 4 != 3) world[t][i] *= 3; /* scale plays no part */
    }
    CHECK(dar_camera_io_from_lens(&y, &s.camera[0], (const double(*)[12])world, 9, 832, 480, &e) == DAR_OK, "%s",
          e.text);
    /* Numbers of up to 16 in f32: 1e-6; times are f32 too, and 8 / 24 s is off by 1e-8 of a key's distance. */
    check_views("gltf", &y, &x, 3e-7, true);
    x.view[3].fx = 1;
    assert_true(dar_camera_io_write(&x, path, DAR_CAMERA_GLTF, &o, &e) == DAR_ERR_USAGE);
    s.camera[0].orthographic = true;
    dar_camera_free(&y);
    assert_true(dar_camera_io_from_lens(&y, &s.camera[0], (const double(*)[12])world, 9, 832, 480, &e) ==
                DAR_ERR_FORMAT);
    dar_camera_free(&x);
    dar_camera_free(&y);
    dar_scene_free(&s);
    dar_arena_free(&a);
    free(world);
    unlink(path);
}

/* One clear line: the place, what was found, what was expected. */
static void bad_files(void **state)
{
    (void)state;
    static const struct {
        const char *text, *told;
    } bad[] = {
        { "", "f:1:1" },
        { "head only\n", "0 poses" },
        { "head\n1 2 3\n", "f:2: found 3 numbers, expected 19" },
        { "head\n0 1 1 .5 .5 0 0 1 0 0 0 0 1 0 0 0 0 1 0 7\n", "f:2: found more than 19" },
        { "head\n\n0 1 1 .5 .5 0 0 1 0 0 0 0 1 0 0 0 0 1 x\n", "f:3: found something else" },
        { "head\n0 1 1 .5 .5 0 0 1 0 0 0 0 1 0 0 0 0 1 nan\n", "f:2: found something else" },
        { "head\n0 1 1 .5 .5 0 0 1 0 0 0 0 1 0 0 0 0 1 1e999\n", "f:2: found something else" },
        { "head\n0 -1 1 .5 .5 0 0 1 0 0 0 0 1 0 0 0 0 1 0\n", "f:2: found focal lengths" },
        { "head\n0 1 1 .5 .5 0 0 2 0 0 0 0 1 0 0 0 0 1 0\n", "f:2: found a matrix that is off a rotation by 3" },
        { "head\n0 1 1 .5 .5 0 0 -1 0 0 0 0 1 0 0 0 0 1 0\n", "f:2: found a matrix that is off a rotation by 2" },
        { "{}", "frames" },
        { "{\"frames\": []}", "1 to 65536 frames" },
        { "{\"frames\": [{\"transform_matrix\": " UNIT "}]}", "camera_angle_x" },
        { "{\"camera_angle_x\": 9, \"frames\": [{\"transform_matrix\": " UNIT "}]}", "camera_angle_x" },
        { "{\"fl_x\": 9, \"k2\": 0.1, \"frames\": [{\"transform_matrix\": " UNIT "}]}", "k2" },
        { "{\"fl_x\": 9, \"frames\": [{\"transform_matrix\": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,1,1]]}]}",
          "frames[0].transform_matrix" },
        { "{\"fl_x\": 9, \"frames\": [{\"transform_matrix\": [[1,0,0,0],[0,1,0,0],[0,0,1,0]]}]}",
          "frames[0].transform_matrix" },
        { "{\"fl_x\": 9, \"frames\": [{\"transform_matrix\": [[1,0,0],[0,1,0],[0,0,1],[0,0,0]]}]}",
          "frames[0].transform_matrix" },
        { HEAD "\"cameras\": []}", "cameras" },
        { HEAD "\"cameras\": [" VIEW(UNIT) "], \"frames\": 2}", "frames" },
        { HEAD "\"cameras\": [" VIEW(UNIT) "], \"extra\": 2}", "extra" },
        { HEAD "\"cameras\": [" VIEW(UNIT ", \"near\": 0") "]}", "near plane" },
        { HEAD "\"cameras\": [{\"K\": [[50,1,32],[0,50,24],[0,0,1]], \"c2w\": " UNIT "}]}", "cameras[0].K" },
        { HEAD "\"cameras\": [" VIEW("[[1,0,0,5],[0,1,0,0],[0,0,1,0],[0,0,0,1]]") "], \"relative_to_first\": true}",
          "relative_to_first" },
        { HEAD "\"keys\": [" VIEW(UNIT ", \"time\": 0") "]}", "frames" },
        { HEAD "\"frames\": 3, \"keys\": [" VIEW(UNIT ", \"time\": 1") "," VIEW(UNIT ", \"time\": 1") "]}", "time" },
        { "{\"format\": \"dar-cameras/2\", \"width\": 64, \"height\": 48, \"cameras\": [" VIEW(UNIT) "]}", "format" },
        { "{ not json", "f:1" },
    };
    dar_camera_options o = dar_camera_io_standard();
    o.width = 64;
    o.height = 48;
    for (size_t i = 0; i < DAR_COUNT(bad); i++) {
        dar_camera_path p;
        dar_err e = { "" };
        dar_status s = parse(&p, bad[i].text, &o, &e);
        CHECK(s == DAR_ERR_FORMAT || s == DAR_ERR_USAGE, "accepted: %s", bad[i].text);
        CHECK(strstr(e.text, bad[i].told), "%s: said \"%s\", expected \"%s\" in it", bad[i].text, e.text, bad[i].told);
        dar_camera_free(&p);
    }
}

/* ---------------------------------------------------------------- trajectories */

static const dar_box boxes[] = {
    { { -0.5, 0, -0.3 }, { 0.5, 1.8, 0.3 } },
    { { -2, 0, -0.2 }, { 1, 0.4, 0.2 } },
    { { 3, -1, 7 }, { 3, 2, 9 } },
    { { -100, -100, -100 }, { -99.9, -99.8, -99.7 } },
};

static void archetypes(void **state)
{
    (void)state;
    size_t blender = 0, unreal = 0, benchmark = 0;
    dar_camera_path p;
    dar_err e = { "" };
    assert_true(dar_camera_init(&p, 9, NULL) == DAR_OK);
    for (size_t k = 0; k < dar_trajectory_count; k++) {
        const dar_trajectory_kind *kind = &dar_trajectory_kinds[k], *found;
        blender += strcmp(kind->family, "blender") == 0;
        unreal += strcmp(kind->family, "unreal") == 0;
        benchmark += strcmp(kind->family, "benchmark") == 0;
        assert_true(dar_trajectory_find(kind->name, &found, &e) == DAR_OK && found == kind);
        double lo[DAR_TRAJECTORY_PARTS], hi[DAR_TRAJECTORY_PARTS];
        size_t mirrored = 0;
        for (int i = 0; i < DAR_TRAJECTORY_PARTS; i++) lo[i] = INFINITY, hi[i] = -INFINITY;
        for (uint64_t seed = 0; seed < 1000; seed++) {
            dar_trajectory t = dar_trajectory_draw(kind, seed, 3), same = dar_trajectory_draw(kind, seed, 3);
            dar_stage stage = dar_stage_standard();
            assert_memory_equal(&t, &same, sizeof t);
            bool flip = t.part[DAR_TRAJECTORY_SPAN] < 0 || t.part[DAR_TRAJECTORY_PAN] < 0;
            mirrored += flip;
            for (int i = 0; i < DAR_TRAJECTORY_PARTS; i++) {
                bool sided = i == DAR_TRAJECTORY_SPAN || i == DAR_TRAJECTORY_ROLL || i == DAR_TRAJECTORY_PAN;
                double x = sided && flip ? -t.part[i] : t.part[i];
                CHECK(x >= kind->bound[i].lo && x <= kind->bound[i].hi, "%s: part %d: %g out of bounds, seed %d",
                      kind->name, i, x, (int)seed);
                lo[i] = fmin(lo[i], x);
                hi[i] = fmax(hi[i], x);
            }
            stage.box = &boxes[seed % 4];
            stage.boxes = 1;
            stage.z_up = seed & 4;
            stage.fov = (20 + 5 * (double)(seed % 9)) * DEGREE;
            if (seed & 8) stage.width = 480, stage.height = 832;
            CHECK(dar_trajectory_path(&t, &stage, &p, &e) == DAR_OK, "%s, seed %d", e.text, (int)seed);
            for (size_t f = 0; f < p.frames; f++) {
                CHECK_NEAR("rotation", dar_rigid_error(p.view[f].c2w), 0, 1e-14);
                CHECK(dar_trajectory_in_view(&p.view[f], stage.box, stage.margin - 1e-9),
                      "%s: frame %zu out of view, seed %d", kind->name, f, (int)seed);
            }
        }
        /* 1000 draws come within 2 % of both ends, and mirror in half of the cases: 6 deviations are 0.095. */
        for (int i = 0; i < DAR_TRAJECTORY_PARTS; i++) {
            double width = kind->bound[i].hi - kind->bound[i].lo;
            CHECK_NEAR(kind->name, lo[i], kind->bound[i].lo, 0.02 * width);
            CHECK_NEAR(kind->name, hi[i], kind->bound[i].hi, 0.02 * width);
        }
        if (kind->mirror && (kind->bound[DAR_TRAJECTORY_SPAN].hi > 0 || kind->bound[DAR_TRAJECTORY_PAN].hi > 0))
            CHECK_NEAR("mirrored", (double)mirrored, 500, 95);
    }
    assert_true(blender == 16 && unreal == 14 && benchmark == 4);
    const dar_trajectory_kind *none;
    assert_true(dar_trajectory_find("orbit-06", &none, &e) == DAR_ERR_USAGE && strstr(e.text, "orbit-60"));
    dar_camera_free(&p);
}

/* The benchmark's four: azimuth from the camera's place, distance, and the tightest fit. */
static void benchmark_paths(void **state)
{
    (void)state;
    static const struct {
        const char *name;
        double begin, end, dolly;
    } four[] = { { "dolly-15", -15, 15, 0.75 },
                 { "orbit-30", -30, 30, 1 },
                 { "orbit-60", -60, 60, 1 },
                 { "orbit-0-45", 0, 45, 1 } };
    dar_camera_path p;
    dar_err e = { "" };
    dar_stage stage = dar_stage_standard();
    stage.box = boxes;
    stage.boxes = 1;
    assert_true(dar_camera_init(&p, 81, NULL) == DAR_OK);
    for (size_t k = 0; k < 4; k++) {
        const dar_trajectory_kind *kind;
        CHECK(dar_trajectory_find(four[k].name, &kind, &e) == DAR_OK, "%s", e.text);
        dar_trajectory t = dar_trajectory_draw(kind, k, k);
        CHECK(dar_trajectory_path(&t, &stage, &p, &e) == DAR_OK, "%s", e.text);
        double first = 0;
        bool tight = false;
        for (size_t f = 0; f < 81; f++) {
            const double *m = p.view[f].c2w, s = (double)f / 80, x = m[3], y = m[7] - 0.9, z = m[11];
            double distance = sqrt(x * x + y * y + z * z);
            if (f == 0) first = distance;
            CHECK_NEAR("azimuth", atan2(x, z) / DEGREE, four[k].begin + (four[k].end - four[k].begin) * s, 1e-10);
            CHECK_NEAR("elevation", asin(y / distance) / DEGREE, 10, 1e-10);
            CHECK_NEAR("distance", distance / first, 1 + (four[k].dolly - 1) * s, 1e-12);
            for (int i = 0; i < 3; i++) /* towards the centre */
                CHECK_NEAR("view", m[4 * i + 2] * distance, (i == 1 ? 0.9 : 0) - m[4 * i + 3], 1e-12);
            CHECK(m[5] < 0, "upside down");
            tight = tight || !dar_trajectory_in_view(&p.view[f], boxes, stage.margin + 1e-6);
        }
        CHECK(tight, "%s: could be nearer", four[k].name);
    }
    dar_camera_free(&p);
}

/* The box moves away to the side: every frame keeps its own box in view, and no other is asked for. */
static void animated_bounds(void **state)
{
    (void)state;
    dar_box moving[5];
    dar_camera_path p;
    dar_err e = { "" };
    dar_stage stage = dar_stage_standard();
    const dar_trajectory_kind *kind;
    assert_true(dar_camera_init(&p, 5, NULL) == DAR_OK);
    for (int t = 0; t < 5; t++) moving[t] = (dar_box){ { (double)t - 0.5, 0, -0.5 }, { (double)t + 0.5, 1, 0.5 } };
    stage.box = moving;
    stage.boxes = 5;
    assert_true(dar_trajectory_find("orbit-0-45", &kind, &e) == DAR_OK);
    dar_trajectory t = dar_trajectory_draw(kind, 0, 0);
    CHECK(dar_trajectory_path(&t, &stage, &p, &e) == DAR_OK, "%s", e.text);
    for (size_t f = 0; f < 5; f++) assert_true(dar_trajectory_in_view(&p.view[f], &moving[f], stage.margin - 1e-9));

    moving[2].hi[0] = NAN;
    assert_true(dar_trajectory_path(&t, &stage, &p, &e) == DAR_ERR_NUMERIC);
    static const dar_box point = { { 1, 1, 1 }, { 1, 1, 1 } };
    stage.box = &point;
    stage.boxes = 1;
    assert_true(dar_trajectory_path(&t, &stage, &p, &e) == DAR_ERR_NUMERIC);
    stage.box = boxes;
    stage.near = 100;
    assert_true(dar_trajectory_path(&t, &stage, &p, &e) == DAR_ERR_USAGE && strstr(e.text, "near plane"));
    dar_camera_free(&p);
}

static void safety(void **state)
{
    (void)state;
    static const dar_box cube = { { -1, -1, -1 }, { 1, 1, 1 } };
    static const double up[3] = { 0, 1, 0 }, origin[3] = { 0, 0, 0 };
    static const struct {
        double eye[3], target[3], near;
        dar_path_fault fault;
    } at[] = {
        { { 0, 0, 5 }, { 0, 0, 0 }, 0.1, DAR_PATH_SAFE },    { { 0, 0, 0.5 }, { 0, 0, 0 }, 0.1, DAR_PATH_INSIDE },
        { { 0, 0, 1.05 }, { 0, 0, 0 }, 0.1, DAR_PATH_NEAR }, { { 0, -3, 5 }, { 0, 0, 0 }, 0.1, DAR_PATH_GROUND },
        { { 0, 0, 5 }, { 0, 0, 9 }, 0.1, DAR_PATH_BEHIND },  { { 0, 0, 5 }, { 0, 0, 0 }, 5, DAR_PATH_NEAR },
        { { 0, -0.9, 5 }, { 0, 0, 0 }, 0.1, DAR_PATH_SAFE },
    };
    dar_stage stage = dar_stage_standard();
    dar_camera_path p;
    stage.box = &cube;
    stage.boxes = 1;
    assert_true(dar_camera_init(&p, 2, NULL) == DAR_OK);
    for (size_t i = 0; i < DAR_COUNT(at); i++) {
        size_t frame;
        for (size_t f = 0; f < 2; f++) p.view[f] = (dar_view){ 64, 48, 50, 50, 32, 24, { 0 }, at[i].near };
        p.view[0].near = 0.1;
        dar_rigid_look_at((const double[3]){ 9, 9, 9 }, origin, up, p.view[0].c2w);
        dar_rigid_look_at(at[i].eye, at[i].target, up, p.view[1].c2w);
        dar_path_fault fault = dar_trajectory_check(&p, &stage, &frame);
        CHECK(fault == at[i].fault, "view %zu: %s, expected %s", i, dar_path_fault_text[fault],
              dar_path_fault_text[at[i].fault]);
        if (fault != DAR_PATH_SAFE) assert_int_equal(frame, 1);
    }
    stage.has_ground = false;
    size_t frame;
    dar_rigid_look_at(at[3].eye, origin, up, p.view[1].c2w);
    assert_true(dar_trajectory_check(&p, &stage, &frame) == DAR_PATH_SAFE);
    dar_camera_free(&p);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(rigid),           cmocka_unit_test(look_at),     cmocka_unit_test(conventions),
        cmocka_unit_test(lenses),          cmocka_unit_test(between),     cmocka_unit_test(smooth_keys),
        cmocka_unit_test(paths),           cmocka_unit_test(round_trips), cmocka_unit_test(poses),
        cmocka_unit_test(transforms),      cmocka_unit_test(key_poses),   cmocka_unit_test(gltf),
        cmocka_unit_test(bad_files),       cmocka_unit_test(archetypes),  cmocka_unit_test(benchmark_paths),
        cmocka_unit_test(animated_bounds), cmocka_unit_test(safety),
    };
    return cmocka_run_group_tests(tests, scratch_make, scratch_remove) != 0;
}
