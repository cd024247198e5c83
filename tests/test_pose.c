/* test_pose.c: posed vertices against values worked out by hand, and the models beside the repository against an
 * evaluation made by another program. */
#include "tests/glb.h"

#include <unistd.h>

#define EPS 6e-8 /* half a unit in the last place of f32 at 1 */

static glb g;

static void start(void)
{
    memset(&g, 0, sizeof g);
}

/* ---------------------------------------------------------------- skins */

#define RINGS 5
#define SIDES 7

/* A cylinder along y, from 0 to 2, in two joints that meet at y = 1: below 0.5 the lower one alone, above 1.5 the
 * upper, halfway in between.  The upper joint's weight sits in the second set. */
static void add_cylinder(bool bind)
{
    static float position[RINGS * SIDES][3], normal[RINGS * SIDES][3], weight[2][RINGS * SIDES][4];
    static uint8_t joint[2][RINGS * SIDES][4];
    static uint16_t index[(RINGS - 1) * SIDES][6];
    for (size_t r = 0; r < RINGS; r++)
        for (size_t k = 0; k < SIDES; k++) {
            size_t v = r * SIDES + k;
            double a = 2 * 3.141592653589793 * (double)k / SIDES, upper = r < 2 ? 0 : r == 2 ? 0.5 : 1;
            position[v][0] = normal[v][0] = (float)cos(a);
            position[v][2] = normal[v][2] = (float)sin(a);
            position[v][1] = (float)r * 0.5f;
            weight[0][v][0] = (float)(1 - upper);
            weight[1][v][2] = (float)upper;
            joint[0][v][1] = 9; /* weight 0: never looked at */
            joint[1][v][2] = 1;
            if (r + 1 == RINGS) continue;
            size_t b = r * SIDES + (k + 1) % SIDES;
            uint16_t corner[6] = { (uint16_t)v, (uint16_t)(v + SIDES), (uint16_t)b,
                                   (uint16_t)b, (uint16_t)(v + SIDES), (uint16_t)(b + SIDES) };
            memcpy(index[r * SIDES + k], corner, sizeof corner);
        }
    int p = GLB_F32(&g, 3, position), n = GLB_F32(&g, 3, normal), i = GLB_U16(&g, 1, index);
    int j0 = glb_add(&g, 4, U8, joint[0], sizeof joint[0], ""), j1 = glb_add(&g, 4, U8, joint[1], sizeof joint[1], "");
    int w0 = GLB_F32(&g, 4, weight[0]), w1 = GLB_F32(&g, 4, weight[1]);
    static const float inverse[2][16] = { { 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1 },
                                          { 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, -1, 0, 1 } };
    static const float time[2] = { 1, 2 }, turn[2][4] = { { 0, 0, 0, 1 }, { 0, 0, 0.70710678f, 0.70710678f } };
    int m = GLB_F32(&g, 16, inverse), t = GLB_F32(&g, 1, time), q = GLB_F32(&g, 4, turn);
    GLB_REST(&g,
             "\"meshes\":[{\"primitives\":[{\"indices\":%d,\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d,"
             "\"JOINTS_0\":%d,\"WEIGHTS_0\":%d,\"JOINTS_1\":%d,\"WEIGHTS_1\":%d}}]}],",
             i, p, n, j0, w0, j1, w1);
    GLB_REST(&g, "\"skins\":[{\"joints\":[1,2]");
    if (bind) GLB_REST(&g, ",\"inverseBindMatrices\":%d", m);
    GLB_REST(&g,
             "}],\"nodes\":[{\"mesh\":0,\"skin\":0,\"translation\":[100,0,0]},{\"children\":[2]},"
             "{\"translation\":[0,1,0]}],\"animations\":[{\"name\":\"bend\",\"channels\":[{\"sampler\":0,\"target\":"
             "{\"node\":2,\"path\":\"rotation\"}}],\"samplers\":[{\"input\":%d,\"output\":%d}]}]",
             t, q);
}

static void skin(void **state)
{
    (void)state;
    dar_scene s;
    posed p;
    start();
    add_cylinder(true);
    glb_load(&g, &s);
    assert_int_equal(s.mesh[0].influences, 8);
    assert_int_equal(s.vertices, RINGS * SIDES);
    posed_init(&p, &s);

    posed_at(&p, DAR_NONE, 0); /* the node's translation plays no part */
    for (size_t v = 0; v < s.vertices; v++) {
        const float *x = s.mesh[0].position + 3 * v;
        check_row("rest", p.position, v, x[0], x[1], x[2], EPS);
    }
    /* A quarter turn about z through (0, 1, 0) takes (x, y, z) to (1 - y, 1 + x, z), normals (x, y, z) to (-y, x, z).
     */
    posed_at(&p, 0, 2);
    for (size_t v = 0; v < s.vertices; v++) {
        const float *x = s.mesh[0].position + 3 * v, *n = s.mesh[0].normal + 3 * v;
        double u = v < 2 * SIDES ? 0 : v < 3 * SIDES ? 0.5 : 1;
        check_row("bent", p.position, v, (1 - u) * x[0] + u * (1 - x[1]), (1 - u) * x[1] + u * (1 + x[0]), x[2],
                  4 * EPS);
        if (u == 0.5) continue;
        check_row("normal", p.normal, v, (1 - u) * n[0], u * n[0], n[2], 4 * EPS);
    }
    /* Halfway an eighth of a turn: (0, 2, 0) relative to the joint is (0, 1, 0). */
    posed_at(&p, 0, 1.5);
    double r = sqrt(0.5);
    check_row("half", p.position, 4 * SIDES, r - r, 1 + r + r, 0, 4 * EPS);
    posed_free(&p);
    dar_scene_free(&s);

    start(); /* without inverse bind matrices the upper joint moves its vertices up by 1 */
    add_cylinder(false);
    glb_load(&g, &s);
    posed_init(&p, &s);
    posed_at(&p, 0, 0);
    check_row("no bind", p.position, 4 * SIDES, 1, 3, 0, EPS);
    posed_free(&p);
    dar_scene_free(&s);
}

/* ---------------------------------------------------------------- morph */

/* One triangle, two targets; positions, normals and the place of the node. */
static void morph(void **state)
{
    (void)state;
    static const float x[3][3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 } },
                       n[3][3] = { { 0, 0, 1 }, { 0, 0, 1 }, { 0, 0, 1 } };
    static const float dx[2][3][3] = { { { 0, 0, 0 }, { 1, 0, 0 }, { 0, 0, 0 } },
                                       { { 0, 0, 4 }, { 0, 0, 0 }, { 0, -1, 0 } } };
    static const float dn[3][3] = { { 1, 0, 0 }, { 0, 0, 0 }, { 0, 0, 0 } };
    static const float time[3] = { 0, 1, 3 }, weight[3][2] = { { 0, 0 }, { 1, 0 }, { 0, 0.5f } };
    dar_scene s;
    posed p;
    start();
    int a = GLB_F32(&g, 3, x), b = GLB_F32(&g, 3, n), c = GLB_F32(&g, 3, dx[0]), d = GLB_F32(&g, 3, dx[1]);
    int e = GLB_F32(&g, 3, dn), t = GLB_F32(&g, 1, time), w = GLB_F32(&g, 1, weight);
    GLB_REST(&g,
             "\"meshes\":[{\"weights\":[0.25,0],\"primitives\":[{\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d},"
             "\"targets\":[{\"POSITION\":%d},{\"POSITION\":%d,\"NORMAL\":%d}]}]}],",
             a, b, c, d, e);
    GLB_REST(&g,
             "\"nodes\":[{\"mesh\":0,\"scale\":[2,2,2]},{\"mesh\":0,\"weights\":[0,1],\"translation\":[0,0,7]}],"
             "\"animations\":[{\"channels\":[{\"sampler\":0,\"target\":{\"node\":0,\"path\":\"weights\"}}],"
             "\"samplers\":[{\"input\":%d,\"output\":%d}]}]",
             t, w);
    glb_load(&g, &s);
    posed_init(&p, &s);
    posed_at(&p, DAR_NONE, 0);
    check_row("mesh's weights", p.position, 1, 2.5, 0, 0, 0);
    check_row("node's weights", p.position, 3, 0, 0, 11, 0);
    check_row("node's weights", p.position, 5, 0, 0, 7, 0);
    check_row("normal", p.normal, 3, sqrt(0.5), 0, sqrt(0.5), EPS);
    posed_at(&p, 0, 0.5);
    check_row("t 0.5", p.position, 1, 3, 0, 0, 0);
    posed_at(&p, 0, 2); /* weights (0.5, 0.25) */
    check_row("t 2", p.position, 0, 0, 0, 2, 0);
    check_row("t 2", p.position, 1, 3, 0, 0, 0);
    check_row("t 2", p.position, 2, 0, 1.5, 0, 0);
    check_row("t 2", p.normal, 0, 0.25 / sqrt(1.0625), 0, 1 / sqrt(1.0625), EPS);
    posed_free(&p);
    dar_scene_free(&s);
}

/* ---------------------------------------------------------------- keys */

static void rows(void **state)
{
    (void)state;
    static const double time[3] = { 1, 2, 4 };
    static const float plain[3] = { 10, 20, -20 };
    static const float spline[9] = { 100, 0, 1, 2, 3, 6, -6, 5, 200 }; /* in, value, out */
    const struct {
        dar_interpolation how;
        const float *value;
        double t, expected;
    } row[] = {
        { DAR_STEP, plain, 0, 10 },
        { DAR_STEP, plain, 1.999, 10 },
        { DAR_STEP, plain, 2, 20 },
        { DAR_STEP, plain, 9, -20 },
        { DAR_LINEAR, plain, -1, 10 },
        { DAR_LINEAR, plain, 1.25, 12.5 },
        { DAR_LINEAR, plain, 3, 0 },
        { DAR_LINEAR, plain, 4, -20 },
        { DAR_CUBIC, spline, 0.5, 0 },
        /* u 1/2, dt 1: (p + q) / 2 + dt (out - in) / 8 = 1.5 + (1 - 2) / 8 */
        { DAR_CUBIC, spline, 1.5, 1.375 },
        /* u 1/4, dt 2: 27/32 3 + 2 9/64 6 + 5/32 5 - 2 3/64 (-6) */
        { DAR_CUBIC, spline, 2.5, 81.0 / 32 + 108.0 / 64 + 25.0 / 32 + 36.0 / 64 },
        { DAR_CUBIC, spline, 4, 5 },
        { DAR_CUBIC, spline, 5, 5 },
    };
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        dar_channel c = { .path = DAR_TRANSLATION,
                          .interpolation = row[i].how,
                          .keys = 3,
                          .width = 1,
                          .time = time,
                          .value = row[i].value };
        double found;
        char name[64];
        dar_channel_sample(&c, row[i].t, &found);
        snprintf(name, sizeof name, "row %zu, interpolation %d, t %g", i, (int)row[i].how, row[i].t);
        CHECK_NEAR(name, found, row[i].expected, 1e-14);
    }
    /* Equal times: the later key holds from then on. */
    static const double twice[3] = { 0, 1, 1 };
    dar_channel c = {
        .path = DAR_SCALE, .interpolation = DAR_LINEAR, .keys = 3, .width = 1, .time = twice, .value = plain
    };
    double found;
    dar_channel_sample(&c, 1, &found);
    CHECK_NEAR("equal times", found, -20, 0);
    dar_channel_sample(&c, 0.5, &found);
    CHECK_NEAR("before equal times", found, 15, 0);
}

static void rotations(void **state)
{
    (void)state;
    static const double time[2] = { 0, 3 };
    double q[4], r = sqrt(0.5);
    /* 30 degrees about x of 90, with the second quaternion negated: still the short way, and a third of the angle. */
    const float turn[8] = { 0, 0, 0, 1, -0.70710678f, 0, 0, -0.70710678f };
    dar_channel c = {
        .path = DAR_ROTATION, .interpolation = DAR_LINEAR, .keys = 2, .width = 4, .time = time, .value = turn
    };
    dar_channel_sample(&c, 1, q);
    CHECK_NEAR("x", q[0], sin(3.141592653589793 / 12), EPS);
    CHECK_NEAR("w", q[3], cos(3.141592653589793 / 12), EPS);
    dar_channel_sample(&c, 5, q);
    CHECK_NEAR("unit", q[0] * q[0] + q[3] * q[3], 1, 1e-15);

    /* Nearly equal, and not unit in the file. */
    const float near[8] = { 0, 0, 0, 2, 0, 2e-6f, 0, 2 };
    c.value = near;
    dar_channel_sample(&c, 1.5, q);
    CHECK_NEAR("near y", q[1], 5e-7, 1e-12);
    CHECK_NEAR("near w", q[3], 1, 1e-12);

    /* Cubic with zero tangents, halfway: the mean of both, made unit. */
    const float spline[24] = { 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0 };
    c.interpolation = DAR_CUBIC;
    c.value = spline;
    dar_channel_sample(&c, 1.5, q);
    CHECK_NEAR("cubic z", q[2], r, 1e-15);
    CHECK_NEAR("cubic w", q[3], r, 1e-15);
    /* The mean of q and -q is no rotation: the key before it is. */
    const float opposite[24] = { [7] = 1, [19] = -1 };
    c.value = opposite;
    dar_channel_sample(&c, 1.5, q);
    CHECK_NEAR("opposite w", q[3], 1, 0);
}

/* ---------------------------------------------------------------- places */

#define TRIANGLE "{\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d}}"

static void add_triangle(int *position, int *normal)
{
    static const float x[3][3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 } },
                       n[3][3] = { { 0, 0, 1 }, { 0, 0, 1 }, { 0.6f, 0, 0.8f } };
    *position = GLB_F32(&g, 3, x);
    *normal = GLB_F32(&g, 3, n);
}

/* A spline moves, turns and morphs a triangle.  Halfway between keys 2 s apart Hermite's weights are 1/2, 1/4, 1/2,
 * -1/4, so values are (p + q) / 2 + (out - in) / 4. */
static void cubic(void **state)
{
    (void)state;
    static const float time[2] = { 1, 3 };
    static const float move[2][3][3] = { { { 9, 9, 9 }, { 1, 2, 3 }, { 4, 0, -8 } },
                                         { { 0, 4, 8 }, { 5, 2, -3 }, { 9, 9, 9 } } };
    /* From no turn to half a turn about z; tangents that leave (0, 0, 0.3, 0.4) halfway. */
    static const float turn[2][3][4] = { { { 9, 9, 9, 9 }, { 0, 0, 0, 1 }, { 0, 0, -0.8f, -0.4f } },
                                         { { 0, 0, 0, 0 }, { 0, 0, 1, 0 }, { 9, 9, 9, 9 } } };
    static const float weight[2][3][2] = { { { 9, 9 }, { 0, 0 }, { 0, 2 } }, { { 0, 0 }, { 0.5f, 0 }, { 9, 9 } } };
    static const float dx[2][3][3] = { { { 0, 0, 0 }, { 4, 0, 0 }, { 0, 0, 0 } },
                                       { { 0, 0, 2 }, { 0, 0, 0 }, { 0, 0, 0 } } };
    dar_scene s;
    posed p;
    int a, b;
    start();
    add_triangle(&a, &b);
    int t = GLB_F32(&g, 1, time), m = GLB_F32(&g, 3, move), q = GLB_F32(&g, 4, turn), w = GLB_F32(&g, 1, weight),
        d0 = GLB_F32(&g, 3, dx[0]), d1 = GLB_F32(&g, 3, dx[1]);
    GLB_REST(
        &g,
        "\"meshes\":[{\"primitives\":[{\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d},\"targets\":[{\"POSITION\":%d},"
        "{\"POSITION\":%d}]}]}],\"nodes\":[{\"mesh\":0}],",
        a, b, d0, d1);
    GLB_REST(&g, "\"animations\":[{\"channels\":[");
    for (int k = 0; k < 3; k++)
        GLB_REST(&g, "%s{\"sampler\":%d,\"target\":{\"node\":0,\"path\":\"%s\"}}", k ? "," : "", k,
                 k == 0   ? "translation"
                 : k == 1 ? "rotation"
                          : "weights");
    GLB_REST(&g, "],\"samplers\":[");
    for (int k = 0; k < 3; k++)
        GLB_REST(&g, "%s{\"input\":%d,\"output\":%d,\"interpolation\":\"CUBICSPLINE\"}", k ? "," : "", t,
                 k == 0   ? m
                 : k == 1 ? q
                          : w);
    GLB_REST(&g, "]}]");
    glb_load(&g, &s);
    posed_init(&p, &s);
    posed_at(&p, 0, 1);
    check_row("first key", p.position, 1, 2, 2, 3, EPS);
    /* Place (3, 2, 0) + ((4, 0, -8) - (0, 4, 8)) / 4 = (4, 1, -4); turn (0, 0, 0.6, 0.8) once unit: cosine 0.28, sine
     * 0.96; weights 1/4 and 1/2: corners (0, 0, 1), (2, 0, 0), (0, 1, 0) before it. */
    posed_at(&p, 0, 2);
    check_row("halfway", p.position, 0, 4, 1, -3, 8 * EPS);
    check_row("halfway", p.position, 1, 4 + 2 * 0.28, 1 + 2 * 0.96, -4, 8 * EPS);
    check_row("halfway", p.position, 2, 4 - 0.96, 1 + 0.28, -4, 8 * EPS);
    check_row("halfway", p.normal, 2, 0.6 * 0.28, 0.6 * 0.96, 0.8, 4 * EPS);
    posed_at(&p, 0, 9);
    check_row("last key", p.position, 1, 5 - 3, 2, -3, 4 * EPS);
    posed_free(&p);
    dar_scene_free(&s);
}

static void instances(void **state)
{
    (void)state;
    static const float at[2][3] = { { 0, 0, 5 }, { 0, 0, 6 } }, size[2][3] = { { 1, 1, 1 }, { 2, 4, 8 } };
    static const int16_t turn[2][4] = { { 0, 0, 0, 32767 }, { 0, 0, 32767, 0 } }; /* 180 degrees about z */
    dar_scene s;
    posed p;
    int a, b;
    start();
    add_triangle(&a, &b);
    int t = GLB_F32(&g, 3, at), r = glb_add(&g, 4, I16, turn, sizeof turn, ",\"normalized\":true"),
        z = GLB_F32(&g, 3, size);
    GLB_REST(&g, "\"meshes\":[{\"primitives\":[" TRIANGLE "]}],", a, b);
    GLB_REST(&g,
             "\"scenes\":[{\"nodes\":[3]},{\"nodes\":[0,1]}],\"scene\":1,"
             "\"nodes\":[{\"mesh\":0,\"scale\":[-1,1,2]},{\"translation\":[1,0,0],\"children\":[2]},"
             "{\"mesh\":0,\"matrix\":[0,1,0,0,-1,0,0,0,0,0,1,0,10,20,30,1],\"extensions\":{\"EXT_mesh_gpu_instancing\":"
             "{\"attributes\":{\"TRANSLATION\":%d,\"ROTATION\":%d,\"SCALE\":%d}}}},{\"mesh\":0}]",
             t, r, z);
    glb_load(&g, &s);
    assert_int_equal(s.instances, 3); /* node 3 is in the other scene */
    posed_init(&p, &s);
    posed_at(&p, DAR_NONE, 0);
    check_row("mirrored", p.position, 1, -1, 0, 0, 0);
    check_row("mirrored", p.normal, 0, 0, 0, 1, 0);
    /* Inverse transpose of diag(-1, 1, 2): (-0.6, 0, 0.4) made unit. */
    check_row("mirrored", p.normal, 2, -0.6 / sqrt(0.52), 0, 0.4 / sqrt(0.52), EPS);
    assert_true(p.pose.mirrored[0]);
    assert_false(p.pose.mirrored[1]);
    /* The matrix takes (x, y, z) to (10 - y, 20 + x, 30 + z), its parent adds 1. */
    check_row("copy 0", p.position, 3 + 1, 11, 21, 35, 0);
    check_row("copy 1", p.position, 6 + 1, 11, 18, 36, 0);
    check_row("copy 1", p.position, 6 + 2, 15, 20, 36, 0);
    posed_free(&p);
    dar_scene_free(&s);
}

static void flat(void **state)
{
    (void)state;
    static const float x[4][3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 }, { 0, 0, 1 } };
    static const uint16_t index[6] = { 0, 1, 2, 0, 2, 3 };
    static const float time[2] = { 0, 1 }, size[2][3] = { { 1, 1, 1 }, { 0, 0, 0 } };
    dar_scene s;
    posed p;
    start();
    int a = GLB_F32(&g, 3, x), b = GLB_U16(&g, 1, index), t = GLB_F32(&g, 1, time), z = GLB_F32(&g, 3, size);
    GLB_REST(&g, "\"meshes\":[{\"primitives\":[{\"indices\":%d,\"attributes\":{\"POSITION\":%d}}]}],", b, a);
    GLB_REST(&g,
             "\"nodes\":[{\"mesh\":0},{\"mesh\":0,\"scale\":[1,1,-1]}],\"animations\":[{\"channels\":[{\"sampler\":0,"
             "\"target\":{\"node\":0,\"path\":\"scale\"}}],\"samplers\":[{\"input\":%d,\"output\":%d}]}]",
             t, z);
    glb_load(&g, &s);
    assert_int_equal(s.vertices, 12); /* corners are split */
    assert_int_equal(s.notes.normals_made, 1);
    posed_init(&p, &s);
    posed_at(&p, 0, 0);
    for (size_t v = 0; v < 3; v++) check_row("first", p.normal, v, 0, 0, 1, 0);
    for (size_t v = 3; v < 6; v++) check_row("second", p.normal, v, 1, 0, 0, 0);
    for (size_t v = 6; v < 9; v++) check_row("mirrored", p.normal, v, 0, 0, -1, 0);
    for (size_t v = 9; v < 12; v++) check_row("mirrored", p.normal, v, 1, 0, 0, 0);
    posed_at(&p, 0, 1); /* without extent: nothing, and no NaN */
    check_row("vanished", p.normal, 0, 0, 0, 0, 0);
    posed_free(&p);
    dar_scene_free(&s);
}

/* ---------------------------------------------------------------- what changed; threads */

static void changes(void **state)
{
    (void)state;
    dar_scene s;
    posed p;
    int a, b;
    static const float time[3] = { 0, 1, 2 }, move[3][3] = { { 0, 0, 0 }, { 0, 0, 0 }, { 5, 0, 0 } };
    start();
    add_triangle(&a, &b);
    int t = GLB_F32(&g, 1, time), m = GLB_F32(&g, 3, move);
    GLB_REST(&g, "\"meshes\":[{\"primitives\":[" TRIANGLE "]}],", a, b);
    GLB_REST(&g,
             "\"nodes\":[{\"mesh\":0},{\"children\":[2]},{\"mesh\":0}],\"animations\":[{\"name\":\"go\",\"channels\":"
             "[{\"sampler\":0,\"target\":{\"node\":1,\"path\":\"translation\"}}],\"samplers\":[{\"input\":%d,"
             "\"output\":%d}]}]",
             t, m);
    glb_load(&g, &s);
    posed_init(&p, &s);
    CHECK_ABORTS(dar_pose_vertices(&p.pose, p.position, p.normal, false));
    const struct {
        double t;
        bool changed[2];
    } step[] = { { 0, { true, true } },
                 { 1, { false, false } },
                 { 1.5, { false, true } },
                 { 2, { false, true } },
                 { 3, { false, false } } };
    for (size_t i = 0; i < DAR_COUNT(step); i++) {
        assert_int_equal(dar_pose_at(&p.pose, 0, step[i].t, NULL), DAR_OK);
        for (int k = 0; k < 2; k++)
            CHECK(p.pose.changed[k] == step[i].changed[k], "t %g, instance %d: changed %d", step[i].t, k,
                  (int)p.pose.changed[k]);
    }
    posed_at(&p, 0, 1.5);
    memset(p.position, 0xff, s.vertices * 12);
    assert_int_equal(dar_pose_at(&p.pose, 0, 2, NULL), DAR_OK);
    dar_pose_vertices(&p.pose, p.position, NULL, true);
    CHECK(isnan(p.position[0]), "an instance that did not move was written");
    check_row("moved", p.position, 4, 6, 0, 0, 0);
    CHECK_ABORTS(dar_pose_at(&p.pose, 1, 0, NULL));
    posed_free(&p);
    dar_scene_free(&s);
}

/* Key values are finite, but their product along the tree is not drawable. */
static void too_large(void **state)
{
    (void)state;
    dar_scene s;
    dar_err e;
    posed p;
    int a, b;
    static const float time[2] = { 0, 1 }, size[2][3] = { { 1, 1, 1 }, { 1e10f, 1e10f, 1e10f } };
    start();
    add_triangle(&a, &b);
    int t = GLB_F32(&g, 1, time), z = GLB_F32(&g, 3, size);
    GLB_REST(&g, "\"meshes\":[{\"primitives\":[" TRIANGLE "]}],", a, b);
    GLB_REST(
        &g,
        "\"nodes\":[{\"children\":[1]},{\"mesh\":0}],\"animations\":[{\"name\":\"grow\",\"channels\":[{\"sampler\":0,"
        "\"target\":{\"node\":0,\"path\":\"scale\"}},{\"sampler\":0,\"target\":{\"node\":1,\"path\":\"scale\"}}],"
        "\"samplers\":[{\"input\":%d,\"output\":%d}]}]",
        t, z);
    glb_load(&g, &s);
    posed_init(&p, &s);
    posed_at(&p, 0, 0);
    assert_int_equal(dar_pose_at(&p.pose, 0, 1, &e), DAR_ERR_NUMERIC);
    assert_string_equal(e.text, "t.glb: animation 'grow' at 1 s: the transform of nodes[1] is not finite");
    posed_at(&p, 0, 0);
    assert_true(p.pose.changed[0]);
    posed_free(&p);
    dar_scene_free(&s);
}

/* ---------------------------------------------------------------- real models */

#define ASSETS "../shared/assets/"

/* Bounds of the whole model at a moment: from a separate evaluation in Python (numpy, f64, keys by arccos slerp). */
static const struct known {
    const char *file, *animation;
    double t, lo[3], hi[3];
} known[] = {
    { "robot.glb", "rest", 0, { -3.31199, -0.0203044, -1.308376 }, { 3.308916, 4.539135, 1.308376 } },
    { "robot.glb", "Robot_Dance", 0, { -1.520695, -0.02030439, -1.320942 }, { 1.574969, 4.500353, 1.346107 } },
    { "robot.glb", "Robot_Dance", 0.5, { -1.520695, -0.02030439, -0.85144 }, { 1.574968, 4.489111, 1.817783 } },
    { "robot.glb", "Robot_Dance", 1.5, { -2.177654, -0.02030439, -0.8870239 }, { 2.091412, 4.611298, 1.728888 } },
    { "robot.glb", "Robot_Death", 0.77, { -3.336997, -0.157189, -6.280971 }, { 2.773905, 1.94783, 1.262072 } },
    { "robot.glb", "Robot_Walking", 0.4, { -1.515174, -0.04507326, -1.338092 }, { 1.57437, 4.367887, 1.694727 } },
    { "robot.glb", "Robot_Wave", 1.03, { -2.457414, -0.02030439, -1.320942 }, { 1.574968, 4.471718, 1.337134 } },
    { "AnimatedMorphCube/AnimatedMorphCube.gltf", "rest", 0, { -1, -1, -1 }, { 1, 1, 1 } },
    { "AnimatedMorphCube/AnimatedMorphCube.gltf", "Square", 0.5, { -1, -1, -1 }, { 1, 1, 0.5608915 } },
    { "AnimatedMorphCube/AnimatedMorphCube.gltf", "Square", 1.5, { -1, -1, -1 }, { 1, 0.9999999, -0.8719904 } },
    { "AnimatedMorphCube/AnimatedMorphCube.gltf", "Square", 3.21, { -1, -1, -1 }, { 1, 0.9999998, 0.9409141 } },
    { "AnimatedMorphCube/AnimatedMorphCube.gltf", "Square", 9, { -1, -1, -1 }, { 1, 1, 1.000001 } },
};

static void models(void **state)
{
    (void)state;
    if (access(ASSETS "robot.glb", R_OK) != 0) SKIP("no models at " ASSETS);
    for (size_t i = 0; i < DAR_COUNT(known); i++) {
        char path[128];
        dar_scene s;
        dar_err e;
        posed p;
        int animation;
        snprintf(path, sizeof path, ASSETS "%s", known[i].file);
        dar_status status = dar_gltf_load(&s, path, true, &e);
        CHECK(status == DAR_OK, "%s", e.text);
        assert_int_equal(dar_scene_find_animation(&s, known[i].animation, &animation, &e), DAR_OK);
        posed_init(&p, &s);
        posed_at(&p, animation, known[i].t);
        for (int c = 0; c < 3; c++) {
            double lo = INFINITY, hi = -INFINITY;
            for (size_t v = 0; v < s.vertices; v++) {
                lo = fmin(lo, p.position[3 * v + (size_t)c]);
                hi = fmax(hi, p.position[3 * v + (size_t)c]);
            }
            CHECK_NEAR(known[i].animation, lo, known[i].lo[c], 5 * 1e-6); /* seven digits were written down */
            CHECK_NEAR(known[i].animation, hi, known[i].hi[c], 5 * 1e-6);
        }
        posed_free(&p);
        dar_scene_free(&s);
    }
}

static void robot(void **state)
{
    (void)state;
    dar_scene s;
    dar_err e;
    posed p;
    int animation;
    if (access(ASSETS "robot.glb", R_OK) != 0) SKIP("no models at " ASSETS);
    dar_status status = dar_gltf_load(&s, ASSETS "robot.glb", true, &e);
    CHECK(status == DAR_OK, "%s", e.text);
    assert_int_equal(s.vertices, 7218);
    assert_int_equal(s.nodes, 58);
    assert_int_equal(s.skin[0].joints, 43);
    assert_int_equal(s.animations, 14);
    assert_int_equal(s.instances, 14);
    assert_int_equal(dar_scene_find_animation(&s, "Robot_Walking", &animation, &e), DAR_OK);
    assert_int_equal(animation, 10);
    assert_int_equal(dar_scene_find_animation(&s, "3", &animation, &e), DAR_OK);
    assert_string_equal(s.animation[animation].name, "Robot_Jump");
    assert_int_equal(dar_scene_find_animation(&s, "rest", &animation, &e), DAR_OK);
    assert_int_equal(animation, DAR_NONE);
    assert_int_equal(dar_scene_find_animation(&s, "Walk", &animation, &e), DAR_ERR_USAGE);

    posed_init(&p, &s);
    float *first = dar_arena_push(&p.arena, s.vertices * 24);
    static const int threads[] = { 1, 2, 3, 7 };
    int before = dar_threads();
    for (size_t i = 0; i < DAR_COUNT(threads); i++) {
        dar_threads_set(threads[i]);
        posed_at(&p, 0, 0.7);
        if (!i) memcpy(first, p.position, s.vertices * 12), memcpy(first + 3 * s.vertices, p.normal, s.vertices * 12);
        CHECK(memcmp(first, p.position, s.vertices * 12) == 0, "%d threads: other positions", threads[i]);
        CHECK(memcmp(first + 3 * s.vertices, p.normal, s.vertices * 12) == 0, "%d threads: other normals", threads[i]);
    }
    dar_threads_set(before);
    for (size_t v = 0; v < s.vertices; v++) {
        const float *n = p.normal + 3 * v;
        CHECK_NEAR("length", (double)n[0] * n[0] + (double)n[1] * n[1] + (double)n[2] * n[2], 1, 4 * EPS);
    }
    posed_free(&p);
    dar_scene_free(&s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(skin),      cmocka_unit_test(morph),     cmocka_unit_test(rows),  cmocka_unit_test(rotations),
        cmocka_unit_test(cubic),     cmocka_unit_test(instances), cmocka_unit_test(flat),  cmocka_unit_test(changes),
        cmocka_unit_test(too_large), cmocka_unit_test(models),    cmocka_unit_test(robot),
    };
    return cmocka_run_group_tests_name("pose", tests, NULL, NULL) != 0;
}
