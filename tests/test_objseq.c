/* test_objseq.c: OBJ files, their order, their frames. */
#include "tests/test.h"

#include <unistd.h>

#include "data/objseq.h"
#include "data/obj.h"
#include "data/pose.h"

static void order(void **state)
{
    (void)state;
    static const char *const rising[] = { "",       "a",    "a1",      "a2",
                                          "a9",     "a10",  "a10b1",   "a10b2",
                                          "a10b10", "a011", "a11.obj", "a123456789012345678901234567890",
                                          "b" };
    for (size_t i = 0; i < DAR_COUNT(rising); i++)
        for (size_t k = 0; k < DAR_COUNT(rising); k++) {
            int found = dar_objseq_order(rising[i], rising[k]);
            CHECK((found > 0) - (found < 0) == (i > k) - (i < k), "%s, %s: %d", rising[i], rising[k], found);
        }
}

static void patterns(void **state)
{
    (void)state;
    static const struct {
        const char *pattern, *name;
        bool fits;
    } row[] = {
        { "*.obj", "a.obj", true },
        { "*.obj", ".obj", true },
        { "*.obj", "a.obj.gz", false },
        { "f?.obj", "f1.obj", true },
        { "f?.obj", "f12.obj", false },
        { "f_%04d.obj", "f_0012.obj", true },
        { "f_%04d.obj", "f_12345.obj", true },
        { "f_%04d.obj", "f_012.obj", false },
        { "f_%d.obj", "f_.obj", false },
        { "f_%d.obj", "f_x.obj", false },
        { "*_%d.obj", "a_b_7.obj", true },
        { "*_%d.obj", "a_7_b.obj", false },
        { "a*b*c", "aXbYbZc", true },
        { "a*b*c", "aXbYbZ", false },
        { "100%", "100%", true },
        { "", "", true },
        { "", "a", false },
    };
    for (size_t i = 0; i < DAR_COUNT(row); i++)
        CHECK(dar_objseq_fits(row[i].pattern, row[i].name) == row[i].fits, "%s, %s", row[i].pattern, row[i].name);
}

/* ---------------------------------------------------------------- one file */

static void parse(dar_scene *s, const char *text)
{
    dar_err e;
    dar_status status = dar_objseq_parse(s, "t.obj", text, strlen(text), &e);
    CHECK(status == DAR_OK, "refused: %s", e.text);
}

static void one_file(void **state)
{
    (void)state;
    dar_scene s;
    parse(&s, "# a roof: hard edge between two quads\r\n"
              "o roof\nv 0 0 0\nv 1 0 0\nv 1 1 1\nv 0 1 1\nv 0 2e0 .0\nv 1 2 0 0.5 0.5 0.5\nvt 0 0\n"
              "vn 0 -1 1\nvn 0 1 1\nusemtl x\ns off\n"
              "f 1/1/1 2/1/1 3/1/1 4/1/1\n\tf -3//-1 -4//-1 -1//-1 -2//-1  \nl 1 2\np 1\n");
    const dar_mesh *m = &s.mesh[0];
    assert_int_equal(m->vertices, 8); /* vertices 3 and 4 twice */
    assert_int_equal(m->triangles, 4);
    assert_int_equal(s.notes.points_and_lines, 2);
    assert_int_equal(s.animations, 0);
    static const uint32_t corner[12] = { 0, 1, 2, 0, 2, 3, 4, 5, 6, 4, 6, 7 };
    assert_memory_equal(m->index, corner, sizeof corner);
    CHECK_NEAR("v 5", m->position[3 * 7 + 1], 2, 0);
    CHECK_NEAR("vn 1", m->normal[3 * 2 + 1], -sqrt(0.5), 6e-8);
    CHECK_NEAR("vn 2", m->normal[3 * 5 + 1], sqrt(0.5), 6e-8);
    dar_scene_free(&s);

    /* Without normals: areas 2 (0, 0, 1) and 1 (1, 0, 0) meet along an edge. */
    parse(&s, "v 0 0 0\nv 0 1 0\nv -2 1 0\nv -2 0 0\nv 0 1 -1\nv 0 0 -1\nf 1 2 3 4\nf 1 6 5 2\n");
    m = &s.mesh[0];
    assert_int_equal(m->vertices, 6);
    assert_int_equal(s.notes.normals_made, 1);
    CHECK_NEAR("x", m->normal[0], 1 / sqrt(5), 6e-8);
    CHECK_NEAR("z", m->normal[2], 2 / sqrt(5), 6e-8);
    dar_scene_free(&s);
}

static void numbers(void **state)
{
    (void)state;
    static const char *const text[] = {
        "0.1", "-123456.789012", "1e-3", "123456789.012345678", "-.5", "+7.", "3.4028235e11", "0.000000000000000123"
    };
    for (size_t i = 0; i < DAR_COUNT(text); i++) {
        char file[256];
        dar_scene s;
        snprintf(file, sizeof file, "v %s 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3", text[i]);
        parse(&s, file);
        CHECK_NEAR(text[i], s.mesh[0].position[0], (float)strtod(text[i], NULL), 0);
        dar_scene_free(&s);
    }
}

/* Area of the triangles, which a wrong ear would change. */
static double area(const float *x, const uint32_t *t, size_t triangles)
{
    double sum = 0;
    for (size_t i = 0; i < triangles; i++) {
        const float *a = x + 3 * t[3 * i], *b = x + 3 * t[3 * i + 1], *c = x + 3 * t[3 * i + 2];
        double twice = ((double)b[0] - a[0]) * ((double)c[1] - a[1]) - ((double)b[1] - a[1]) * ((double)c[0] - a[0]);
        CHECK(twice >= 0, "triangle %zu is turned over", i);
        sum += twice / 2;
    }
    return sum;
}

static void polygons(void **state)
{
    (void)state;
    static const struct {
        size_t n;
        float x[12][2];
        double area;
    } row[] = {
        { 4, { { 0, 0 }, { 2, 0 }, { 2, 1 }, { 0, 1 } }, 2 },
        { 4, { { 0, 0 }, { 2, 0 }, { 0.5f, 0.5f }, { 0, 2 } }, 1 },               /* dart */
        { 4, { { 0.5f, 0.5f }, { 0, 2 }, { 0, 0 }, { 2, 0 } }, 1 },               /* from its notch */
        { 6, { { 0, 0 }, { 3, 0 }, { 3, 1 }, { 1, 1 }, { 1, 3 }, { 0, 3 } }, 5 }, /* L */
        { 8, { { 0, 0 }, { 3, 0 }, { 3, 3 }, { 2, 3 }, { 2, 1 }, { 1, 1 }, { 1, 3 }, { 0, 3 } }, 7 }, /* U */
        { 5, { { 0, 0 }, { 1, 0 }, { 2, 0 }, { 2, 2 }, { 0, 2 } }, 4 }, /* straight corner */
    };
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        float x[12][3] = { { 0 } };
        uint32_t c[12], left[12], out[30];
        bool used[12] = { 0 };
        for (size_t k = 0; k < row[i].n; k++)
            x[k][0] = row[i].x[k][0], x[k][1] = row[i].x[k][1], x[k][2] = 5, c[k] = (uint32_t)k;
        dar_obj_triangulate(x[0], c, row[i].n, left, out);
        CHECK_NEAR("area", area(x[0], out, row[i].n - 2), row[i].area, 1e-12);
        for (size_t k = 0; k < 3 * (row[i].n - 2); k++) used[out[k]] = true;
        for (size_t k = 0; k < row[i].n; k++) CHECK(used[k], "polygon %zu: corner %zu is in no triangle", i, k);
    }
}

static void refused(void **state)
{
    (void)state;
    static const struct {
        const char *text, *message;
    } row[] = {
        { "", "t.obj: no faces" },
        { "v 0 0 0\n", "t.obj: no faces" },
        { "v 0 0\n", "t.obj:1: found \"\", expected a number" },
        { "v 0 0 nan\n", "t.obj:1: found \"nan\", expected a finite number, at most 1e12" },
        { "v 0 0 1e13\n", "t.obj:1: found \"1e13\", expected a finite number, at most 1e12" },
        { "\nv 0 0 -\n", "t.obj:2: found \"-\", expected a number" },
        { "v 0 0 1x\n", "t.obj:1: found \"1x\", expected a number" },
        { "v 0 0 0\nv 0 0 0\nf 1 2\n", "t.obj:3: found \" 1 2\", expected a face of 3 to 65536 corners" },
        { "v 0 0 0\nf 1 1 2\n", "t.obj:2: found \"2\", expected the index of a vertex before it" },
        { "v 0 0 0\nf 1 1 0\n", "t.obj:2: found \"0\", expected the index of a vertex before it" },
        { "v 0 0 0\nf -1 -1 -2\n", "t.obj:2: found \"-2\", expected the index of a vertex before it" },
        { "v 0 0 0\nf 1 1 99999999999999999999999\n",
          "t.obj:2: found \"999999999999999999999999\", expected the index of a vertex before it" },
        { "v 0 0 0\nf 1//1 1 1\n", "t.obj:2: found \"1 1 1\", expected the index of a normal before it" },
        { "v 0 0 0\nf 1 1 1x\n", "t.obj:2: found \"x\", expected v, v/vt, v//vn or v/vt/vn" },
    };
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        dar_scene s;
        dar_err e;
        assert_int_equal(dar_objseq_parse(&s, "t.obj", row[i].text, strlen(row[i].text), &e), DAR_ERR_FORMAT);
        size_t n = strlen(row[i].message);
        bool cut = i == 11; /* 24 characters of what was found */
        CHECK(cut || strcmp(e.text, row[i].message) == 0, "found:    %s\nexpected: %s", e.text, row[i].message);
        CHECK(!cut || strncmp(e.text, row[i].message, n < 30 ? n : 30) == 0, "found: %s", e.text);
        assert_null(s.memory.base);
    }
    /* Cut anywhere, in memory of just that size. */
    static const char whole[] = "v 0 0 0\nv 1 0 0\nv 1 1 0.5e0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1 3//1 -1//-1\n";
    for (size_t n = 0; n < sizeof whole - 1; n++) {
        dar_scene s;
        dar_err e;
        char *copy = malloc(n ? n : 1);
        assert_non_null(copy);
        memcpy(copy, whole, n);
        dar_objseq_parse(&s, "t.obj", copy, n, &e);
        free(copy);
        dar_scene_free(&s);
    }
}

/* ---------------------------------------------------------------- sequences */

static char dir[64];

static const char *file_of(int frame)
{
    static char path[96];
    snprintf(path, sizeof path, "%s/f_%d.obj", dir, frame);
    return path;
}

static void write_frame(int frame, const char *text)
{
    FILE *f = fopen(file_of(frame), "w");
    assert_non_null(f);
    fputs(text, f);
    fclose(f);
}

/* Vertex 1 rises by a number that no f32 difference keeps. */
static void write_frames(void)
{
    static const char *const normal[3] = { "vn 0 0 1\nvn 1 0 0\n", "vn 1 0 0\nvn 0 0 1\n", "" }; /* numbered anew */
    static const char *const face[3] = { "f 1//1 2//1 3//1\n", "f 1//2 2//2 3//2\n", "f 1 2 3\n" };
    for (int k = 0; k < 3; k++) {
        char text[256];
        snprintf(text, sizeof text, "v %.9g 0 0\nv 1 0 0\nv 0 1 0\n%s%s", k * 0.1, normal[k], face[k]);
        write_frame(k == 2 ? 10 : 8 + k, text);
    }
}

static void sequence(void **state)
{
    (void)state;
    char what[128];
    dar_scene s;
    dar_pose p;
    dar_arena a;
    dar_err e;
    float x[9], n[9];
    snprintf(dir, sizeof dir, "/tmp/objseq-XXXXXX");
    assert_non_null(mkdtemp(dir));
    write_frames();
    static const char *const pattern[] = { "", "/*.obj", "/f_%d.obj", "/f_?*.obj" };
    for (size_t k = 0; k < DAR_COUNT(pattern); k++) {
        snprintf(what, sizeof what, "%s%s", dir, pattern[k]);
        dar_status status = dar_objseq_load(&s, what, 10, &e);
        CHECK(status == DAR_OK, "%s", e.text);
        assert_int_equal(s.animations, 1);
        assert_int_equal(s.mesh[0].targets, 3);
        CHECK_NEAR("end", s.animation[0].end, 0.2, 1e-15);
        dar_scene_free(&s);
    }
    assert_int_equal(dar_objseq_load(&s, what, 10, &e), DAR_OK);
    assert_int_equal(dar_arena_init(&a, "test", 1 << 20, NULL), DAR_OK);
    dar_pose_init(&p, &s, &a);
    for (int k = 0; k < 3; k++) { /* the very numbers of the file */
        assert_int_equal(dar_pose_at(&p, 0, k / 10.0, &e), DAR_OK);
        dar_pose_vertices(&p, x, n, false);
        CHECK_NEAR("frame", x[0], (float)(k * 0.1), 0);
        CHECK_NEAR("normal", n[2], 1, 0);
    }
    assert_int_equal(dar_pose_at(&p, 0, 0.05, &e), DAR_OK);
    dar_pose_vertices(&p, x, n, false);
    CHECK_NEAR("between", x[0], 0.05, 1e-8);
    assert_int_equal(dar_pose_at(&p, DAR_NONE, 0, &e), DAR_OK);
    dar_pose_vertices(&p, x, n, false);
    CHECK_NEAR("rest", x[0], 0, 0);
    dar_arena_free(&a);
    dar_scene_free(&s);

    static const struct {
        const char *text, *message;
    } row[] = {
        { "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 3 2\n", ": faces join other vertices than in " },
        { "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 0\nf 1 2 3\n",
          ": 4 vertices, 1 faces, 3 corners, expected 3, 1, 3 as in " },
    };
    for (size_t k = 0; k < DAR_COUNT(row); k++) {
        char expected[256];
        write_frame(9, row[k].text);
        assert_int_equal(dar_objseq_load(&s, dir, 10, &e), DAR_ERR_FORMAT);
        int at = snprintf(expected, sizeof expected, "%s%s", file_of(9), row[k].message);
        snprintf(expected + at, sizeof expected - (size_t)at, "%s%s", file_of(8), k ? "" : ", expected the same");
        assert_string_equal(e.text, expected);
        assert_null(s.memory.base);
    }
    assert_int_equal(dar_objseq_load(&s, "/nowhere/x.obj", 10, &e), DAR_ERR_IO);
    assert_int_equal(dar_objseq_load(&s, "/nowhere/*.obj", 10, &e), DAR_ERR_IO);
    snprintf(what, sizeof what, "%s/g_%%d.obj", dir);
    assert_int_equal(dar_objseq_load(&s, what, 10, &e), DAR_ERR_IO);
    for (int k = 8; k <= 10; k++) unlink(file_of(k));
    rmdir(dir);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(order),    cmocka_unit_test(patterns), cmocka_unit_test(one_file), cmocka_unit_test(numbers),
        cmocka_unit_test(polygons), cmocka_unit_test(refused),  cmocka_unit_test(sequence),
    };
    return cmocka_run_group_tests_name("objseq", tests, NULL, NULL) != 0;
}
