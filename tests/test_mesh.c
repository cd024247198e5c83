/* test_mesh.c: glTF files, whole and damaged. */
#include "tests/glb.h"

#include <unistd.h>

static glb g;

static void start(void)
{
    memset(&g, 0, sizeof g);
}

static const float square[4][3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 0, 2, 0 }, { 1, 2, 0.5f } };
static const float up[4][3] = { { 0, 0, 1 }, { 0, 0, 1 }, { 0, 0, 1 }, { 0, 0, 1 } };
static const uint16_t two[6] = { 0, 1, 2, 2, 1, 3 };

#define NODE ",\"nodes\":[{\"mesh\":0}]"

/* Mesh 0 has one primitive with these attributes and more. */
#define MESH(fmt, ...) GLB_REST(&g, "\"meshes\":[{\"primitives\":[{" fmt "}]}]", __VA_ARGS__)

static void same_positions(const dar_mesh *m, double bound)
{
    assert_int_equal(m->vertices, 4);
    for (size_t i = 0; i < 12; i++) CHECK_NEAR("position", m->position[i], square[i / 3][i % 3], bound);
}

static void same_triangles(const dar_mesh *m, const uint32_t *expected, size_t triangles)
{
    assert_int_equal(m->triangles, triangles);
    for (size_t i = 0; i < 3 * triangles; i++)
        CHECK(m->index[i] == expected[i], "corner %zu: found %u, expected %u", i, m->index[i], expected[i]);
}

/* 2 x 1 RGBA: (255, 0, 0, 255), (0, 10, 20, 128). */
static const unsigned char png_rgba[] = { 0x89, 0x50, 0x4e, 0x47, 0x0d, 0x0a, 0x1a, 0x0a, 0x00, 0x00, 0x00, 0x0d, 0x49,
                                          0x48, 0x44, 0x52, 0x00, 0x00, 0x00, 0x02, 0x00, 0x00, 0x00, 0x01, 0x08, 0x06,
                                          0x00, 0x00, 0x00, 0xf4, 0x22, 0x7f, 0x8a, 0x00, 0x00, 0x00, 0x11, 0x49, 0x44,
                                          0x41, 0x54, 0x78, 0xda, 0x63, 0xf8, 0xcf, 0xc0, 0xf0, 0x9f, 0x81, 0x4b, 0xa4,
                                          0x01, 0x00, 0x0d, 0xc2, 0x02, 0x9d, 0xe8, 0xf9, 0x59, 0xff, 0x00, 0x00, 0x00,
                                          0x00, 0x49, 0x45, 0x4e, 0x44, 0xae, 0x42, 0x60, 0x82 };

/* ---------------------------------------------------------------- geometry */

static void accessors(void **state)
{
    (void)state;
    dar_scene s;
    /* Unused vertices around the square; positions with a stride and an offset; 8-bit indices. */
    unsigned char bytes[4 + 6 * 16];
    static const uint8_t index[6] = { 1, 2, 3, 3, 2, 4 };
    memset(bytes, 0x7e, sizeof bytes);
    for (size_t v = 0; v < 4; v++) memcpy(bytes + 4 + (v + 1) * 16, square[v], 12);
    start();
    int view = glb_view(&g, bytes, sizeof bytes, ",\"byteStride\":16");
    int p = glb_accessor(&g, view, "VEC3", F32, 6, ",\"byteOffset\":4"),
        i = glb_add(&g, 1, U8, index, sizeof index, "");
    MESH("\"indices\":%d,\"attributes\":{\"POSITION\":%d}", i, p);
    GLB_REST(&g, NODE);
    glb_load(&g, &s);
    assert_int_equal(s.vertices, 6); /* flat */
    dar_scene_free(&s);

    start();
    view = glb_view(&g, bytes, sizeof bytes, ",\"byteStride\":16");
    p = glb_accessor(&g, view, "VEC3", F32, 6, ",\"byteOffset\":4");
    i = glb_add(&g, 1, U8, index, sizeof index, "");
    static const float six[6][3] = { { 0, 0, 3 }, { 0, 0, 3 }, { 0, 0, 3 }, { 0, 0, 3 }, { 0, 0, 3 }, { 0, 0, 3 } };
    int n = GLB_F32(&g, 3, six);
    MESH("\"indices\":%d,\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d}", i, p, n);
    GLB_REST(&g, NODE);
    glb_load(&g, &s);
    same_positions(&s.mesh[0], 0);
    same_triangles(&s.mesh[0], (uint32_t[]){ 0, 1, 2, 2, 1, 3 }, 2);
    CHECK_NEAR("normal", s.mesh[0].normal[2], 1, 0);
    dar_scene_free(&s);
}

static void integers(void **state)
{
    (void)state;
    /* KHR_mesh_quantization: i16 normalised positions, i8 normalised normals, u8 normalised colours and texture
     * coordinates. */
    static const int16_t x[3][4] = { { 32767, -32768, 0, 0 }, { 0, 16384, -1, 0 }, { 1, 2, 3, 0 } };
    static const int8_t n[3][4] = { { 127, 0, 0, 0 }, { 0, -128, 0, 0 }, { 0, 0, 64, 0 } };
    static const uint8_t c[3][4] = { { 255, 0, 51, 255 }, { 1, 2, 3, 4 }, { 0, 0, 0, 0 } };
    dar_scene s;
    start();
    int a = glb_accessor(&g, glb_view(&g, x, sizeof x, ",\"byteStride\":8"), "VEC3", I16, 3, ",\"normalized\":true");
    int b = glb_accessor(&g, glb_view(&g, n, sizeof n, ",\"byteStride\":4"), "VEC3", I8, 3, ",\"normalized\":true");
    int d = glb_add(&g, 4, U8, c, sizeof c, ",\"normalized\":true");
    int plain = glb_accessor(&g, glb_view(&g, x, sizeof x, ",\"byteStride\":8"), "VEC3", I16, 3, "");
    GLB_REST(&g,
             "\"extensionsRequired\":[\"KHR_mesh_quantization\"],\"meshes\":[{\"primitives\":[{\"attributes\":"
             "{\"POSITION\":%d,\"NORMAL\":%d,\"COLOR_0\":%d}},{\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d}}]}]" NODE,
             a, b, d, plain, b);
    glb_load(&g, &s);
    const dar_mesh *m = &s.mesh[0];
    assert_int_equal(m->primitives, 2);
    assert_int_equal(m->primitive[1].vertex, 3);
    check_row("position", m->position, 0, 1, -1, 0, 0);
    check_row("position", m->position, 1, 0, 16384 / 32767.0, -1 / 32767.0, 6e-8);
    check_row("integers", m->position, 3, 32767, -32768, 0, 0);
    check_row("normal", m->normal, 1, 0, -1, 0, 0);
    check_row("normal", m->normal, 2, 0, 0, 1, 0); /* 64 / 127 made unit */
    CHECK_NEAR("colour", m->color[2], 0.2, 6e-8);
    CHECK_NEAR("colour where there is none", m->color[4 * 3 + 2], 1, 0);
    dar_scene_free(&s);
}

static void sparse(void **state)
{
    (void)state;
    static const float base[4][3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 9, 9, 9 }, { 8, 8, 8 } };
    static const uint16_t where[2] = { 2, 3 };
    static const float three[1][3] = { { 0, 0, 5 } };
    static const uint8_t one[1] = { 1 };
    dar_scene s;
    start();
    int v = glb_view(&g, base, sizeof base, ""), i = glb_view(&g, where, sizeof where, "");
    int x = glb_view(&g, square[2], 2 * sizeof square[2], "");
    int i1 = glb_view(&g, one, sizeof one, ""), x1 = glb_view(&g, three, sizeof three, "");
    char text[256];
    snprintf(text, sizeof text,
             ",\"sparse\":{\"count\":2,\"indices\":{\"bufferView\":%d,\"componentType\":5123},\"values\":{"
             "\"bufferView\":%d}}",
             i, x);
    int p = glb_accessor(&g, v, "VEC3", F32, 4, text);
    snprintf(text, sizeof text,
             ",\"sparse\":{\"count\":1,\"indices\":{\"bufferView\":%d,\"componentType\":5121},\"values\":{"
             "\"bufferView\":%d}}",
             i1, x1);
    int t = glb_accessor(&g, -1, "VEC3", F32, 4, text), n = GLB_F32(&g, 3, up), k = GLB_U16(&g, 1, two);
    MESH("\"indices\":%d,\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d},\"targets\":[{\"POSITION\":%d}]", k, p, n, t);
    GLB_REST(&g, NODE);
    glb_load(&g, &s);
    same_positions(&s.mesh[0], 0);
    check_row("zeros", s.mesh[0].target_position, 0, 0, 0, 0, 0);
    check_row("replaced", s.mesh[0].target_position, 1, 0, 0, 5, 0);
    dar_scene_free(&s);
}

static void modes(void **state)
{
    (void)state;
    static const float x[5][3] = { { 0, 0, 0 }, { 1, 0, 0 }, { 0, 1, 0 }, { 1, 1, 0 }, { 0, 2, 0 } };
    static const float n[5][3] = { { 0, 0, 1 }, { 0, 0, 1 }, { 0, 0, 1 }, { 0, 0, 1 }, { 0, 0, 1 } };
    static const uint16_t strip[4] = { 4, 3, 2, 1 };
    dar_scene s;
    start();
    int p = GLB_F32(&g, 3, x), q = GLB_F32(&g, 3, n), i = GLB_U16(&g, 1, strip);
    GLB_REST(
        &g,
        "\"meshes\":[{\"primitives\":[{\"mode\":5,\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d}},"
        "{\"mode\":6,\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d}},{\"mode\":0,\"attributes\":{\"POSITION\":%d}},"
        "{\"mode\":5,\"indices\":%d,\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d}},"
        "{\"mode\":3,\"attributes\":{\"POSITION\":%d}}]}]" NODE,
        p, q, p, q, p, i, p, q, p);
    glb_load(&g, &s);
    assert_int_equal(s.notes.points_and_lines, 2);
    assert_int_equal(s.mesh[0].primitives, 3);
    same_triangles(&s.mesh[0],
                   (uint32_t[]){ 0, 1, 2, 1, 3, 2, 2, 3, 4, 6, 7, 5, 7, 8, 5, 8, 9, 5, 13, 12, 11, 12, 10, 11 }, 8);
    dar_scene_free(&s);
}

static void weights(void **state)
{
    (void)state;
    static const uint8_t joint[4][4] = { { 0, 1, 0, 0 }, { 0, 0, 0, 0 }, { 1, 200, 0, 0 }, { 1, 0, 0, 0 } };
    static const uint8_t weight[4][4] = { { 51, 204, 0, 0 }, { 0, 0, 0, 0 }, { 100, 0, 0, 0 }, { 254, 1, 0, 0 } };
    dar_scene s;
    start();
    int p = GLB_F32(&g, 3, square), n = GLB_F32(&g, 3, up), i = GLB_U16(&g, 1, two);
    int j = glb_add(&g, 4, U8, joint, sizeof joint, ""),
        w = glb_add(&g, 4, U8, weight, sizeof weight, ",\"normalized\":true");
    MESH("\"indices\":%d,\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d,\"JOINTS_0\":%d,\"WEIGHTS_0\":%d}", i, p, n, j,
         w);
    GLB_REST(&g, ",\"skins\":[{\"joints\":[1,2]}],\"nodes\":[{\"mesh\":0,\"skin\":0},{},{}]");
    glb_load(&g, &s);
    const dar_mesh *m = &s.mesh[0];
    CHECK_NEAR("weight", m->weight[1], 0.8, 6e-8);
    CHECK_NEAR("no weight", m->weight[4], 1, 0);
    CHECK_NEAR("scaled", m->weight[8], 1, 0);
    assert_int_equal(m->joint[9], 0);
    assert_int_equal(m->joints, 2);
    assert_int_equal(s.notes.unweighted, 1);
    assert_int_equal(s.notes.weights_normalised, 1);
    dar_scene_free(&s);
}

/* ---------------------------------------------------------------- meshopt */

/* Written by libmeshoptimizer 0.18's encoder: `square` as it is and through the exponential filter (15 bits), `two` as
 * triangles and as indices, four normals through the octahedral filter (16 bits), two rotations (12 bits). */
static const unsigned char packed_positions[] = {
    0xa0, 0x00, 0x00, 0x01, 0x3f, 0x00, 0x00, 0x00, 0xff, 0xff, 0xff, 0x01, 0x3f, 0x00, 0x00, 0x00, 0x7e, 0x7d,
    0x7e, 0x00, 0x00, 0x00, 0x01, 0x0c, 0x00, 0x00, 0x00, 0x80, 0x00, 0x00, 0x00, 0x01, 0x03, 0x00, 0x00, 0x00,
    0x7e, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00,
    0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00
};
static const unsigned char packed_triangles[] = { 0xe0, 0xf0, 0x10, 0x00, 0x76, 0x87, 0x56, 0x67, 0x78, 0xa9,
                                                  0x86, 0x65, 0x89, 0x68, 0x98, 0x01, 0x69, 0x00, 0x00 };
static const unsigned char packed_indices[] = { 0xd0, 0x00, 0x04, 0x04, 0x00, 0x02, 0x08, 0x00, 0x00, 0x00, 0x00 };
static const unsigned char packed_normals[] = { 0xa0, 0x01, 0x1b, 0x00, 0x00, 0x00, 0x49, 0x01, 0x3f, 0x00, 0x00,
                                                0x00, 0xfe, 0xfd, 0x6c, 0x01, 0x09, 0x00, 0x00, 0x00, 0x01, 0x0f,
                                                0x00, 0x00, 0x00, 0xff, 0xff, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00,
                                                0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00,
                                                0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00,
                                                0x00, 0x00, 0x00, 0x00, 0xff, 0x7f, 0x00, 0x00 };
static const unsigned char packed_exponential[] = {
    0xa0, 0x00, 0x01, 0x3f, 0x00, 0x00, 0x00, 0x40, 0x3f, 0x20, 0x00, 0x01, 0x28, 0x00, 0x00, 0x00, 0x00, 0x01, 0x0c,
    0x00, 0x00, 0x00, 0x40, 0x00, 0x01, 0x28, 0x00, 0x00, 0x00, 0x00, 0x01, 0x03, 0x00, 0x00, 0x00, 0x10, 0x00, 0x01,
    0x28, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00,
    0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0xf2, 0x00, 0x00, 0x00, 0xf2, 0x00, 0x00, 0x00, 0xf2
};
static const unsigned char packed_rotations[] = { 0xa0, 0x01, 0x10, 0x00, 0x00, 0x00, 0x01, 0x30, 0x00, 0x00, 0x00,
                                                  0x0e, 0x00, 0x00, 0x00, 0x00, 0x01, 0x10, 0x00, 0x00, 0x00, 0x00,
                                                  0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00,
                                                  0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00,
                                                  0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0x00, 0xff, 0x07 };

/* A view whose bytes come unpacked from elsewhere: buffer 1 is a placeholder. */
static int packed_view(size_t offset, size_t size, size_t count, size_t stride, const char *mode, const char *filter)
{
    glb_print(
        g.views, sizeof g.views,
        "%s{\"buffer\":1,\"byteLength\":%zu,\"extensions\":{\"EXT_meshopt_compression\":{\"buffer\":0,"
        "\"byteOffset\":%zu,\"byteLength\":%zu,\"count\":%zu,\"byteStride\":%zu,\"mode\":\"%s\",\"filter\":\"%s\"}}}",
        g.n_views ? "," : "", count * stride, offset, size, count, stride, mode, filter);
    return g.n_views++;
}

static size_t put(const unsigned char *data, size_t size)
{
    size_t at = g.bin_size;
    memcpy(g.bin + at, data, size);
    g.bin_size += size;
    return at;
}

#define PACKED(array, ...) packed_view(put(array, sizeof(array)), sizeof(array), __VA_ARGS__)

static void finish_packed(dar_scene *s, const char *expected)
{
    dar_err e;
    char buffers[512], bin[32768];
    size_t n = 0;
    for (size_t i = 0; i < g.bin_size; i += 3) { /* base64 */
        static const char digit[] = "ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
        unsigned x = (unsigned)g.bin[i] << 16 | (unsigned)g.bin[i + 1] << 8 | g.bin[i + 2];
        for (int k = 18; k >= 0; k -= 6) bin[n++] = digit[x >> k & 63];
    }
    bin[n] = 0;
    static char all[40000];
    snprintf(buffers, sizeof buffers,
             "{\"byteLength\":9999,\"extensions\":{\"EXT_meshopt_compression\":{\"fallback\":true}}}");
    snprintf(all, sizeof all, "{\"byteLength\":%zu,\"uri\":\"data:application/octet-stream;base64,%s\"},%s", g.bin_size,
             bin, buffers);
    const char *json = glb_json(&g, all);
    dar_status status = dar_gltf_parse(s, "t.gltf", json, strlen(json), true, &e);
    if (expected)
        CHECK(status != DAR_OK && strcmp(e.text, expected) == 0, "found:    %s\nexpected: %s", e.text, expected);
    else CHECK(status == DAR_OK, "refused: %s", e.text);
}

static void meshopt(void **state)
{
    (void)state;
    for (int variant = 0; variant < 2; variant++) {
        dar_scene s;
        start();
        int a = variant ? PACKED(packed_exponential, 4, 12, "ATTRIBUTES", "EXPONENTIAL")
                        : PACKED(packed_positions, 4, 12, "ATTRIBUTES", "NONE");
        int b = PACKED(packed_normals, 4, 8, "ATTRIBUTES", "OCTAHEDRAL");
        int c = variant ? PACKED(packed_indices, 6, 4, "INDICES", "NONE")
                        : PACKED(packed_triangles, 6, 4, "TRIANGLES", "NONE");
        int r = PACKED(packed_rotations, 2, 8, "ATTRIBUTES", "QUATERNION");
        float times[2] = { 0, 1 };
        size_t at = put((unsigned char *)times, sizeof times);
        glb_print(g.views, sizeof g.views, ",{\"buffer\":0,\"byteOffset\":%zu,\"byteLength\":8}", at);
        int p = glb_accessor(&g, a, "VEC3", F32, 4, ""), i = glb_accessor(&g, c, "SCALAR", U32, 6, "");
        glb_print(g.accessors, sizeof g.accessors,
                  ",{\"type\":\"VEC3\",\"componentType\":5122,\"normalized\":true,\"count\":4,\"bufferView\":%d},"
                  "{\"type\":\"VEC4\",\"componentType\":5122,\"normalized\":true,\"count\":2,\"bufferView\":%d},"
                  "{\"type\":\"SCALAR\",\"componentType\":5126,\"count\":2,\"bufferView\":%d}",
                  b, r, r + 1);
        GLB_REST(&g, "\"extensionsRequired\":[\"EXT_meshopt_compression\"],");
        MESH("\"indices\":%d,\"attributes\":{\"POSITION\":%d,\"NORMAL\":2}", i, p);
        GLB_REST(&g,
                 NODE ",\"animations\":[{\"channels\":[{\"sampler\":0,\"target\":{\"node\":0,\"path\":\"rotation\"}}],"
                      "\"samplers\":[{\"input\":4,\"output\":3}]}]");
        finish_packed(&s, NULL);
        same_positions(&s.mesh[0], 0);
        same_triangles(&s.mesh[0], (uint32_t[]){ 0, 1, 2, 2, 1, 3 }, 2);
        /* 16 bits of an octahedron: steps of 1 / 32767 in each of two directions. */
        check_row("normal", s.mesh[0].normal, 2, 0, -1, 0, 1e-4);
        check_row("normal", s.mesh[0].normal, 3, 0.6, 0, 0.8, 1e-4);
        /* 12 bits: sqrt(1/2) / 2047 per component. */
        CHECK_NEAR("rotation", s.animation[0].channel[0].value[4 + 2], sqrt(0.5), 1e-3);
        dar_scene_free(&s);
    }
    dar_scene s;
    start();
    g.bin_size = sizeof packed_positions;
    memcpy(g.bin, packed_positions, sizeof packed_positions);
    packed_view(0, sizeof packed_positions - 1, 4, 12, "ATTRIBUTES", "NONE");
    finish_packed(
        &s, "t.gltf: bufferViews[0].extensions.EXT_meshopt_compression: found an object, expected meshopt data that "
            "its decoder can read");
    start();
    g.bin_size = sizeof packed_positions;
    packed_view(0, sizeof packed_positions, 400, 12, "ATTRIBUTES", "QUATERNION");
    finish_packed(
        &s, "t.gltf: bufferViews[0].extensions.EXT_meshopt_compression: found an object, expected the byteStride of "
            "its filter");
    start();
    g.bin_size = 4;
    packed_view(0, 4, 400, 12, "ATTRIBUTES", "NONE");
    finish_packed(
        &s, "t.gltf: bufferViews[0].extensions.EXT_meshopt_compression.count: found 400, expected at most the 4800 "
            "bytes of the view, and 64 for each of 4 packed");
}

/* ---------------------------------------------------------------- files beside, materials, cameras */

static void write_file(const char *path, const void *data, size_t size)
{
    FILE *f = fopen(path, "wb");
    assert_non_null(f);
    assert_int_equal(fwrite(data, 1, size, f), size);
    fclose(f);
}

static void external(void **state)
{
    (void)state;
    char dir[] = "/tmp/mesh-XXXXXX", path[64], bin[64];
    dar_scene s;
    dar_err e;
    assert_non_null(mkdtemp(dir));
    snprintf(path, sizeof path, "%s/t.gltf", dir);
    snprintf(bin, sizeof bin, "%s/a b.bin", dir);
    start();
    int p = GLB_F32(&g, 3, square), i = GLB_U16(&g, 1, two);
    MESH("\"indices\":%d,\"attributes\":{\"POSITION\":%d}", i, p);
    GLB_REST(&g, NODE);
    write_file(bin, g.bin, g.bin_size);
    const struct {
        const char *uri, *expected;
    } row[] = {
        { "a%20b.bin", NULL },
        { "./a b.bin", NULL },
        { "../a", "found \"../a\", expected a relative path without \"..\", or base64 data" },
        { "x/%2e%2e/a", "found \"x/%2e%2e/a\", expected a relative path without \"..\", or base64 data" },
        { "/etc/passwd", "found \"/etc/passwd\", expected a relative path without \"..\", or base64 data" },
        { "file:a", "found \"file:a\", expected a relative path without \"..\", or base64 data" },
        { "a%00", "found \"a%00\", expected a relative path without \"..\", or base64 data" },
        { "a%2", "found \"a%2\", expected two hexadecimal digits after '%'" },
        { "data:,a", "found \"data:,a\", expected data:...;base64,..." },
        { "data:;base64,A", "found \"data:;base64,A\", expected base64 data" },
        { "data:;base64,AAA*", "found \"data:;base64,AAA*\", expected base64 data" },
    };
    for (size_t k = 0; k < DAR_COUNT(row); k++) {
        char buffer[256], expected[512];
        snprintf(buffer, sizeof buffer, "{\"byteLength\":%zu,\"uri\":\"%s\"}", g.bin_size, row[k].uri);
        const char *json = glb_json(&g, buffer);
        write_file(path, json, strlen(json));
        dar_status status = dar_gltf_load(&s, path, true, &e);
        snprintf(expected, sizeof expected, "%s: buffers[0].uri: %s", path, row[k].expected ? row[k].expected : "");
        if (row[k].expected)
            CHECK(status != DAR_OK && strcmp(e.text, expected) == 0, "found:    %s\nexpected: %s", e.text, expected);
        else CHECK(status == DAR_OK, "%s: refused: %s", row[k].uri, e.text);
        if (!row[k].expected) assert_int_equal(s.vertices, 6);
        dar_scene_free(&s);
    }
    unlink(bin);
    unlink(path);
    rmdir(dir);
}

static void materials(void **state)
{
    (void)state;
    static const float uv[4][2] = { { 0, 0 }, { 1, 0 }, { 0, 1 }, { 1, 1 } };
    dar_scene s;
    start();
    int p = GLB_F32(&g, 3, square), n = GLB_F32(&g, 3, up), i = GLB_U16(&g, 1, two), t = GLB_F32(&g, 2, uv);
    int v = glb_view(&g, png_rgba, sizeof png_rgba, "");
    MESH("\"material\":1,\"indices\":%d,\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d,\"TEXCOORD_1\":%d}", i, p, n, t);
    GLB_REST(&g,
             NODE
             ",\"images\":[{\"uri\":\"nowhere.png\"},{\"bufferView\":%d,\"mimeType\":\"image/png\"}],"
             "\"samplers\":[{\"wrapS\":33071,\"wrapT\":33648,\"magFilter\":9728}],"
             "\"textures\":[{\"source\":1,\"sampler\":0},{\"extensions\":{\"KHR_texture_basisu\":{\"source\":0}}}],"
             "\"materials\":[{},{\"name\":\"skin\",\"alphaMode\":\"MASK\",\"alphaCutoff\":0.25,\"doubleSided\":true,"
             "\"pbrMetallicRoughness\":{\"baseColorFactor\":[0.5,0.25,1,1],\"baseColorTexture\":{\"index\":0,"
             "\"texCoord\":0,\"extensions\":{\"KHR_texture_transform\":{\"offset\":[1,2],\"scale\":[2,4],"
             "\"rotation\":1.5707963267948966,\"texCoord\":1}}}}},"
             "{\"pbrMetallicRoughness\":{\"baseColorTexture\":{\"index\":1}}}]",
             v);
    glb_load(&g, &s);
    const dar_material *m = &s.material[1];
    assert_string_equal(m->name, "skin");
    assert_int_equal(m->image, 1);
    assert_int_equal(m->wrap_u, DAR_WRAP_CLAMP);
    assert_int_equal(m->wrap_v, DAR_WRAP_MIRROR);
    assert_int_equal(m->alpha, DAR_ALPHA_MASK);
    assert_true(m->nearest && m->double_sided);
    assert_true(s.mesh[0].primitive[0].textured);
    CHECK_NEAR("cutoff", m->cutoff, 0.25, 0);
    CHECK_NEAR("factor", m->color[1], 0.25, 0);
    assert_int_equal(s.image[1].width, 2);
    assert_int_equal(s.image[1].rgba[5], 10);
    assert_null(s.image[0].rgba); /* used only by a texture in another form */
    assert_int_equal(s.notes.textures, 1);
    /* Scale, then a quarter turn (u, v) -> (v, -u), then the offset: (1, 1) -> (2, 4) -> (4, -2) -> (5, 0). */
    CHECK_NEAR("u", s.mesh[0].uv[6], 5, 1e-6);
    CHECK_NEAR("v", s.mesh[0].uv[7], 0, 1e-6);
    dar_scene_free(&s);

    dar_err e; /* the same without pictures */
    assert_int_equal(dar_gltf_parse(&s, "t.glb", g.out, g.size, false, &e), DAR_OK);
    assert_int_equal(s.material[1].image, DAR_NONE);
    assert_int_equal(s.notes.textures, 2);
    assert_null(s.mesh[0].uv);
    dar_scene_free(&s);
}

static void cameras(void **state)
{
    (void)state;
    dar_scene s;
    start();
    GLB_REST(&g,
             "\"cameras\":[{\"name\":\"eye\",\"type\":\"perspective\",\"perspective\":{\"yfov\":0.5,\"znear\":0.1}},"
             "{\"type\":\"orthographic\",\"orthographic\":{\"xmag\":2,\"ymag\":1,\"znear\":0,\"zfar\":9}}],"
             "\"nodes\":[{\"camera\":1,\"translation\":[0,0,4]}]");
    glb_load(&g, &s);
    assert_int_equal(s.cameras, 2);
    assert_int_equal(s.node[0].camera, 1);
    assert_string_equal(s.camera[0].name, "eye");
    CHECK_NEAR("yfov", s.camera[0].yfov, 0.5, 0);
    CHECK_NEAR("far", s.camera[0].far, 0, 0);
    assert_true(s.camera[1].orthographic);
    CHECK_NEAR("xmag", s.camera[1].xmag, 2, 0);
    dar_scene_free(&s);
}

/* ---------------------------------------------------------------- what is refused */

/* One square, with more JSON behind; views 0, 1, accessors 0 (positions), 1 (indices). */
static void square_and(const char *rest)
{
    start();
    int p = GLB_F32(&g, 3, square), i = GLB_U16(&g, 1, two);
    MESH("\"indices\":%d,\"attributes\":{\"POSITION\":%d}", i, p);
    GLB_REST(&g, "%s", rest);
}

static void refused_scenes(void **state)
{
    (void)state;
    static const struct {
        const char *rest, *message;
    } row[] = {
        { ",\"extensionsRequired\":[\"KHR_draco_mesh_compression\"]",
          "extensionsRequired[0]: found \"KHR_draco_mesh_compression\", expected an extension that is read "
          "(EXT_mesh_gpu_instancing, EXT_meshopt_compression, KHR_mesh_quantization, KHR_texture_transform); Blender "
          "can "
          "write the file without" },
        { ",\"nodes\":[{\"mesh\":1}]", "nodes[0].mesh: found 1, expected an integer from 0 to 0" },
        { ",\"nodes\":[{\"mesh\":0,\"skin\":0}]", "nodes[0].skin: found 0, expected nothing: there are none" },
        { ",\"nodes\":[{\"children\":[1]},{\"children\":[2]},{\"children\":[1]}]",
          "nodes[2].children[0]: found 1, expected a node that has no other parent" },
        { ",\"nodes\":[{\"mesh\":0},{\"children\":[2]},{\"children\":[1]}]",
          "nodes[2].children: found an array, expected a tree: node 2 is its own ancestor" },
        { ",\"nodes\":[{\"children\":[0]}]",
          "nodes[0].children: found an array, expected a tree: node 0 is its own ancestor" },
        { ",\"nodes\":[{\"mesh\":0,\"translation\":[0,1e300,0]}]",
          "nodes[0].translation: found an array, expected no number beyond 1e+12: the one at 1 is 1e+300" },
        { ",\"nodes\":[{\"mesh\":0,\"scale\":[1e12,1,1],\"children\":[1]},{\"scale\":[1e12,1,1]}]",
          "nodes[1]: found an object, expected transforms that stay below 1e+12: with those above it one number is "
          "1e+24" },
        { ",\"nodes\":[{\"mesh\":0,\"rotation\":[0,0,0,0]}]",
          "nodes[0].rotation: found an array, expected a quaternion that is not 0" },
        { ",\"nodes\":[{\"scale\":[1,0,1],\"children\":[1]},{\"mesh\":0}]",
          "nodes[0].scale: found an array, expected one that is not zero: nodes[1] has a mesh" },
        { ",\"nodes\":[{\"mesh\":0,\"matrix\":[1,0,0,0,0,1,0,0,0,0,0,0,0,0,0,1]}]",
          "nodes[0].matrix: found an array, expected one that is not zero: nodes[0] has a mesh" },
        { ",\"nodes\":[{\"mesh\":0,\"matrix\":[1,0,0,0,0,1,0,0,0,0,1,0,0,0,0]}]",
          "nodes[0].matrix: found an array, expected an array of 16 numbers" },
        { ",\"nodes\":[{\"mesh\":0,\"matrix\":[1,0,0,1,0,1,0,0,0,0,1,0,0,0,0,1]}]",
          "nodes[0].matrix: found an array, expected a last row 0 0 0 1 (every fourth number)" },
        { ",\"nodes\":[{\"mesh\":0,\"skin\":0}],\"skins\":[{\"joints\":[0]}]",
          "nodes[0].skin: found 0, expected none, or JOINTS_0 in meshes[0]" },
        { ",\"skins\":[{\"joints\":[0]}]", "skins[0].joints[0]: found 0, expected nothing: there are none" },
        { ",\"nodes\":[{}],\"skins\":[{\"joints\":[]}]",
          "skins[0].joints: found an array, expected at least one node" },
        { ",\"nodes\":[{}],\"scenes\":[{\"nodes\":[4]}]",
          "scenes[0].nodes[0]: found 4, expected an integer from 0 to 0" },
        { ",\"scene\":0", "scene: found 0, expected nothing: there are none" },
        { ",\"nodes\":[{}],\"animations\":[{\"channels\":[{\"sampler\":0,\"target\":{\"node\":0,\"path\":\"scale\"}}]}"
          "]",
          "animations[0].channels[0].sampler: found 0, expected one of 0 samplers" },
        { ",\"nodes\":[{}],\"animations\":[{\"samplers\":[{}],\"channels\":[{\"sampler\":0,\"target\":{\"node\":0,"
          "\"path\":\"weights\"}}]}]",
          "animations[0].channels[0].target.node: found 0, expected a node whose mesh has morph targets" },
        { ",\"nodes\":[{}],\"animations\":[{\"samplers\":[{\"input\":1,\"output\":0}],\"channels\":[{\"sampler\":0,"
          "\"target\":{\"node\":0,\"path\":\"scale\"}}]}]",
          "accessors[1].componentType: found 5123, expected one that fits input: 5126" },
        { ",\"materials\":[{\"pbrMetallicRoughness\":{\"baseColorTexture\":{\"index\":0}}}],\"textures\":[{\"source\":"
          "0}],"
          "\"images\":[{\"uri\":\"nowhere/skin.png\"}]",
          "images[0].uri: found \"nowhere/skin.png\", expected a file beside the model (nowhere/skin.png: No such file "
          "or "
          "directory)" },
        { ",\"materials\":[{\"pbrMetallicRoughness\":{\"baseColorTexture\":{\"index\":0}}}],\"textures\":[{\"source\":"
          "0}],"
          "\"images\":[{\"bufferView\":0}]",
          "images[0]: neither a PNG nor a JPEG picture" },
        { ",\"cameras\":[{\"type\":\"perspective\",\"perspective\":{\"yfov\":4,\"znear\":1}}]",
          "cameras[0].perspective.yfov: found 4, expected a number from 1e-06 to 3.14159" },
        { ",\"cameras\":[{\"type\":\"perspective\",\"perspective\":{\"yfov\":1,\"znear\":1,\"zfar\":1}}]",
          "cameras[0].perspective.zfar: found 1, expected more than znear, 1" },
    };
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        char message[512];
        snprintf(message, sizeof message, "t.glb: %s", row[i].message);
        square_and(row[i].rest);
        glb_refused(&g, message);
    }
}

static void refused_accessors(void **state)
{
    (void)state;
    static const float nan[4][3] = { { 0, 0, 0 }, { 0, 0, 0 }, { 0, NAN, 0 }, { 0, 0, 0 } };
    static const float far[3][3] = { { 0, 0, 0 }, { 0, 0, 0 }, { 0, 0, 1e13f } };
    static const uint16_t beyond[3] = { 0, 1, 4 };

    start();
    MESH("\"attributes\":{\"POSITION\":%d}", GLB_F32(&g, 3, nan));
    glb_refused(&g, "t.glb: meshes[0].primitives[0].mode: found 4, expected whole triangles: there are 4 corners");
    start();
    MESH("\"mode\":5,\"attributes\":{\"POSITION\":%d}", GLB_F32(&g, 3, nan));
    glb_refused(&g, "t.glb: accessors[0]: found an object, expected finite numbers, none beyond 1e+12: element 2 holds "
                    "something else");
    start();
    MESH("\"attributes\":{\"POSITION\":%d}", GLB_F32(&g, 3, far));
    glb_refused(&g, "t.glb: accessors[0]: found an object, expected finite numbers, none beyond 1e+12: element 2 holds "
                    "something else");
    start();
    int p = GLB_F32(&g, 3, square);
    MESH("\"indices\":%d,\"attributes\":{\"POSITION\":%d}", GLB_U16(&g, 1, beyond), p);
    glb_refused(
        &g, "t.glb: meshes[0].primitives[0].indices: found 1, expected indices below the 4 vertices: the one at 2 is "
            "4");
    const struct {
        const char *accessors, *message;
    } row[] = {
        { "{\"type\":\"VEC3\",\"componentType\":5126,\"count\":5,\"bufferView\":0}",
          "accessors[0].bufferView: found 0, expected one of more than 48 bytes, for 5 elements of 12, 12 apart, from "
          "0 on" },
        { "{\"type\":\"VEC3\",\"componentType\":5126,\"count\":4,\"bufferView\":0,\"byteOffset\":1}",
          "accessors[0].bufferView: found 0, expected one of more than 48 bytes, for 4 elements of 12, 12 apart, from "
          "1 on" },
        { "{\"type\":\"VEC3\",\"componentType\":5126,\"count\":4294967295,\"bufferView\":0}",
          "accessors[0].bufferView: found 0, expected one of more than 48 bytes, for 4294967295 elements of 12, 12 "
          "apart, "
          "from 0 on" },
        { "{\"type\":\"VEC3\",\"componentType\":5126,\"count\":4294967295}",
          "accessors[0].count: found 4294967295, expected at most the file's SIZE bytes where there is no bufferView" },
        { "{\"type\":\"VEC3\",\"componentType\":5126,\"count\":0,\"bufferView\":0}",
          "accessors[0].count: found 0, expected an integer from 1 to 4294967295" },
        { "{\"type\":\"VEC2\",\"componentType\":5126,\"count\":3,\"bufferView\":0}",
          "accessors[0].type: found \"VEC2\", expected 3 numbers for POSITION" },
        { "{\"type\":\"VEC3\",\"componentType\":5125,\"count\":3,\"bufferView\":0}",
          "accessors[0].componentType: found 5125, expected one that fits POSITION: 5126 normalized 5120 to 5123 5120 "
          "to 5123" },
        { "{\"type\":\"MAT3\",\"componentType\":5126,\"count\":3,\"bufferView\":0}",
          "accessors[0].type: found \"MAT3\", expected one of SCALAR, VEC2, VEC3, VEC4, MAT4" },
        { "{\"type\":\"VEC3\",\"componentType\":5126,\"count\":3,\"bufferView\":-1}",
          "accessors[0].bufferView: found -1, expected an integer from 0 to 0" },
        { "{\"type\":\"VEC3\",\"componentType\":5126,\"count\":3,\"sparse\":{\"count\":1,\"indices\":{\"bufferView\":0,"
          "\"componentType\":5123,\"byteOffset\":6},\"values\":{\"bufferView\":0}}}",
          "accessors[0].sparse.indices: found an object, expected rising indices below 3: the one at 0 is 16256" },
        { "{\"type\":\"VEC3\",\"componentType\":5126,\"count\":3,\"sparse\":{\"count\":4}}",
          "accessors[0].sparse.count: found 4, expected an integer from 1 to 3" },
    };
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        char message[512], expected[512];
        static const float x[4][3] = { { 0, 1, 0 }, { 0, 0, 0 } };
        start();
        glb_view(&g, x, sizeof x, "");
        glb_print(g.accessors, sizeof g.accessors, "%s", row[i].accessors);
        MESH("\"attributes\":{\"POSITION\":%d}", 0);
        glb_finish(&g);
        const char *size = strstr(row[i].message, "SIZE");
        if (size)
            snprintf(message, sizeof message, "%.*s%zu%s", (int)(size - row[i].message), row[i].message, g.size,
                     size + 4);
        else snprintf(message, sizeof message, "%s", row[i].message);
        snprintf(expected, sizeof expected, "t.glb: %.500s", message);
        glb_refused(&g, expected);
    }
}

static void refused_views(void **state)
{
    (void)state;
    static const struct {
        const char *view, *message;
    } row[] = {
        { "{\"buffer\":1,\"byteLength\":4}", "bufferViews[2].buffer: found 1, expected an integer from 0 to 0" },
        { "{\"buffer\":0,\"byteLength\":61}",
          "bufferViews[2].byteLength: found 61, expected at most 60: byteOffset is 0 and the buffer has 60 bytes" },
        { "{\"buffer\":0,\"byteOffset\":9007199254740991,\"byteLength\":9007199254740991}",
          "bufferViews[2].byteLength: found 9007199254740991, expected at most 0: byteOffset is 9007199254740991 and "
          "the "
          "buffer has 60 bytes" },
        { "{\"buffer\":0,\"byteLength\":4,\"byteStride\":256}",
          "bufferViews[2].byteStride: found 256, expected an integer from 0 to 252" },
        { "{\"buffer\":0,\"byteLength\":4,\"byteOffset\":-1}",
          "bufferViews[2].byteOffset: found -1, expected an integer, at least 0 and below 2^53" },
    };
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        char message[512];
        square_and("");
        glb_print(g.views, sizeof g.views, ",%s", row[i].view);
        snprintf(message, sizeof message, "t.glb: %s", row[i].message);
        glb_refused(&g, message);
    }
}

/* Thousands of primitives that share one accessor must not become thousands of copies of it. */
static void absurd(void **state)
{
    (void)state;
    size_t room = 16 << 20, n;
    char *text = malloc(room);
    dar_scene s;
    dar_err e;
    assert_non_null(text);
    n = (size_t)snprintf(text, room,
                         "{\"asset\":{\"version\":\"2.0\"},\"accessors\":[{\"type\":\"VEC3\",\"componentType\":5126,"
                         "\"count\":300000}],\"meshes\":[{\"primitives\":[");
    for (int i = 0; i < 10000; i++)
        n += (size_t)snprintf(text + n, room - n, "%s{\"attributes\":{\"POSITION\":0}}", i ? "," : "");
    n += (size_t)snprintf(text + n, room - n, "]}]}");
    assert_int_equal(dar_gltf_parse(&s, "t.gltf", text, n, true, &e), DAR_ERR_FORMAT);
    CHECK(strstr(e.text, "more than 64 times the file's"), "found: %s", e.text);
    free(text);
}

/* ---------------------------------------------------------------- damage */

/* A file with everything in it. */
static void everything(void)
{
    static const float time[2] = { 0, 1 }, turn[2][4] = { { 0, 0, 0, 1 }, { 0, 0, 1, 0 } },
                       w[4][4] = { { 1 }, { 1 }, { 1 }, { 1 } };
    static const uint8_t joint[4][4] = { { 1 }, { 0 }, { 1 }, { 0 } };
    start();
    int p = GLB_F32(&g, 3, square), n = GLB_F32(&g, 3, up), i = GLB_U16(&g, 1, two), t = GLB_F32(&g, 1, time);
    int q = GLB_F32(&g, 4, turn), a = glb_add(&g, 4, U8, joint, sizeof joint, ""), b = GLB_F32(&g, 4, w);
    int v = glb_view(&g, png_rgba, sizeof png_rgba, "");
    MESH(
        "\"material\":0,\"indices\":%d,\"attributes\":{\"POSITION\":%d,\"NORMAL\":%d,\"JOINTS_0\":%d,\"WEIGHTS_0\":%d},"
        "\"targets\":[{\"POSITION\":%d}]",
        i, p, n, a, b, n);
    GLB_REST(
        &g,
        ",\"nodes\":[{\"mesh\":0,\"skin\":0},{\"children\":[2],\"scale\":[1,2,-1]},{\"camera\":0}],\"skins\":[{"
        "\"joints\":"
        "[1,2]}],\"cameras\":[{\"type\":\"perspective\",\"perspective\":{\"yfov\":0.5,\"znear\":0.1}}],\"animations\":"
        "[{\"channels\":[{\"sampler\":0,\"target\":{\"node\":2,\"path\":\"rotation\"}}],\"samplers\":[{\"input\":%d,"
        "\"output\":%d}]}],\"images\":[{\"bufferView\":%d}],\"textures\":[{\"source\":0}],\"materials\":"
        "[{\"pbrMetallicRoughness\":{\"baseColorTexture\":{\"index\":0}}}]",
        t, q, v);
    glb_finish(&g);
}

/* Load a copy of just this size; if it is accepted, pose it. */
static bool try_file(const unsigned char *data, size_t size, dar_err *e)
{
    dar_scene s;
    unsigned char *copy = malloc(size ? size : 1);
    assert_non_null(copy);
    memcpy(copy, data, size);
    e->text[0] = 0;
    dar_status status = dar_gltf_parse(&s, "t.glb", copy, size, true, e);
    free(copy);
    if (status != DAR_OK) {
        CHECK(strncmp(e->text, "t.glb:", 6) == 0, "a message without the file's name: \"%s\"", e->text);
        return false;
    }
    posed p;
    posed_init(&p, &s);
    if (dar_pose_at(&p.pose, s.animations ? 0 : DAR_NONE, 0.5, e) == DAR_OK)
        dar_pose_vertices(&p.pose, p.position, p.normal, false);
    posed_free(&p);
    dar_scene_free(&s);
    return true;
}

static void damaged(void **state)
{
    (void)state;
    dar_err e;
    everything();
    static unsigned char whole[sizeof g.out];
    size_t size = g.size, json = 20 + (g.out[12] | (size_t)g.out[13] << 8);
    memcpy(whole, g.out, size);
    CHECK(try_file(whole, size, &e), "refused: %s", e.text);
    for (size_t n = 0; n < size; n++) CHECK(!try_file(whole, n, &e), "cut to %zu of %zu bytes: accepted", n, size);
    /* The length says that the file ends where it was cut. */
    for (size_t n = 12; n < size; n++) {
        whole[8] = (unsigned char)n, whole[9] = (unsigned char)(n >> 8);
        CHECK(!try_file(whole, n, &e), "cut to %zu of %zu bytes, told: accepted", n, size);
    }
    whole[8] = (unsigned char)size, whole[9] = (unsigned char)(size >> 8);
    for (size_t at = 0; at < size; at += at < json ? 1 : 3) { /* anything but a crash */
        static const unsigned char instead[] = { 0, '9', '-', 0xff };
        for (size_t k = 0; k < DAR_COUNT(instead); k++) {
            unsigned char old = whole[at];
            whole[at] = instead[k];
            try_file(whole, size, &e);
            whole[at] = old;
        }
    }
    static const struct {
        size_t at;
        unsigned char value;
        const char *message;
    } row[] = {
        { 4, 1, "t.glb: GLB version 1, expected 2" },
        { 11, 1, "t.glb: header says %zu bytes, found %zu" },
        { 15, 1, "t.glb: chunk 0 ends behind the end of the file" },
        { 16, 'K', "t.glb: first chunk is not JSON" },
    };
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        char message[128];
        unsigned char old = whole[row[i].at];
        whole[row[i].at] = row[i].value;
        assert_false(try_file(whole, size, &e));
        if (i == 1)
            snprintf(message, sizeof message, "t.glb: header says %zu bytes, found %zu", size + ((size_t)1 << 24),
                     size);
        else snprintf(message, sizeof message, "%s", row[i].message);
        assert_string_equal(e.text, message);
        whole[row[i].at] = old;
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(accessors),      cmocka_unit_test(integers),          cmocka_unit_test(sparse),
        cmocka_unit_test(modes),          cmocka_unit_test(weights),           cmocka_unit_test(meshopt),
        cmocka_unit_test(external),       cmocka_unit_test(materials),         cmocka_unit_test(cameras),
        cmocka_unit_test(refused_scenes), cmocka_unit_test(refused_accessors), cmocka_unit_test(refused_views),
        cmocka_unit_test(absurd),         cmocka_unit_test(damaged),
    };
    return cmocka_run_group_tests_name("mesh", tests, NULL, NULL) != 0;
}
