/* glb.h: writes small .glb files for tests: accessors are added one by one, the rest of the JSON is given as text. */
#ifndef DAR_TESTS_GLB_H
#define DAR_TESTS_GLB_H

#include "tests/test.h"

#include "data/gltf.h"
#include "data/pose.h"

enum { I8 = 5120, U8, I16, U16, U32 = 5125, F32 };

typedef struct glb {
    unsigned char bin[1 << 16], out[1 << 18];
    char views[1 << 15], accessors[1 << 15], rest[1 << 15];
    size_t bin_size, size; /* of out */
    int n_views, n_accessors;
} glb;

/* Text behind text. */
static inline __attribute__((format(printf, 3, 4))) void glb_print(char *to, size_t room, const char *fmt, ...)
{
    size_t n = strlen(to);
    va_list ap;
    va_start(ap, fmt);
    int m = vsnprintf(to + n, room - n, fmt, ap);
    va_end(ap);
    assert_true(m >= 0 && (size_t)m < room - n);
}

/* A view of its own for these bytes; `extra` is JSON that begins with a comma, or "". */
static inline int glb_view(glb *g, const void *data, size_t size, const char *extra)
{
    g->bin_size = (g->bin_size + 3) & ~(size_t)3;
    assert_true(g->bin_size + size <= sizeof g->bin);
    memcpy(g->bin + g->bin_size, data, size);
    glb_print(g->views, sizeof g->views, "%s{\"buffer\":0,\"byteOffset\":%zu,\"byteLength\":%zu%s}",
              g->n_views ? "," : "", g->bin_size, size, extra);
    g->bin_size += size;
    return g->n_views++;
}

/* An accessor; view -1: none. */
static inline int glb_accessor(glb *g, int view, const char *type, int component, size_t count, const char *extra)
{
    glb_print(g->accessors, sizeof g->accessors, "%s{\"type\":\"%s\",\"componentType\":%d,\"count\":%zu%s",
              g->n_accessors ? "," : "", type, component, count, extra);
    if (view >= 0) glb_print(g->accessors, sizeof g->accessors, ",\"bufferView\":%d", view);
    glb_print(g->accessors, sizeof g->accessors, "}");
    return g->n_accessors++;
}

/* View and accessor of an array of numbers; type by its width. */
static inline int glb_add(glb *g, size_t width, int component, const void *data, size_t bytes, const char *extra)
{
    static const char *const types[] = { [1] = "SCALAR", [2] = "VEC2", [3] = "VEC3", [4] = "VEC4", [16] = "MAT4" };
    static const size_t size[] = { 1, 1, 2, 2, 4, 4, 4 };
    int view = glb_view(g, data, bytes, "");
    return glb_accessor(g, view, types[width], component, bytes / size[component - I8] / width, extra);
}

#define GLB_F32(g, width, array) glb_add(g, width, F32, array, sizeof(array), "")
#define GLB_U16(g, width, array) glb_add(g, width, U16, array, sizeof(array), "")

#define GLB_REST(g, ...) glb_print((g)->rest, sizeof(g)->rest, __VA_ARGS__)

static inline void glb_u32(glb *g, size_t x)
{
    for (int i = 0; i < 4; i++) g->out[g->size++] = (unsigned char)(x >> 8 * i);
}

/* The JSON alone, with `buffer` as the only buffer. */
static inline char *glb_json(const glb *g, const char *buffer)
{
    static char text[1 << 17];
    text[0] = 0;
    glb_print(text, sizeof text,
              "{\"asset\":{\"version\":\"2.0\"},\"buffers\":[%s],\"bufferViews\":[%s],\"accessors\":[%s]", buffer,
              g->views, g->accessors);
    glb_print(text, sizeof text, "%s%s}", g->rest[0] ? "," : "", g->rest);
    return text;
}

/* Write g->out. */
static inline void glb_finish(glb *g)
{
    char buffer[64];
    g->bin_size = (g->bin_size + 3) & ~(size_t)3;
    snprintf(buffer, sizeof buffer, "{\"byteLength\":%zu}", g->bin_size);
    char *json = glb_json(g, g->bin_size ? buffer : "");
    size_t n = strlen(json), padded = (n + 3) & ~(size_t)3, chunk = g->bin_size ? 8 + g->bin_size : 0;

    assert_true(12 + 8 + padded + chunk <= sizeof g->out);
    g->size = 0;
    glb_u32(g, 0x46546c67), glb_u32(g, 2), glb_u32(g, 12 + 8 + padded + chunk);
    glb_u32(g, padded), glb_u32(g, 0x4e4f534a);
    memset(g->out + g->size, ' ', padded);
    memcpy(g->out + g->size, json, n);
    g->size += padded;
    if (!g->bin_size) return;
    glb_u32(g, g->bin_size), glb_u32(g, 0x004e4942);
    memcpy(g->out + g->size, g->bin, g->bin_size);
    g->size += g->bin_size;
}

static inline void glb_load(glb *g, dar_scene *s)
{
    dar_err e;
    glb_finish(g);
    dar_status status = dar_gltf_parse(s, "t.glb", g->out, g->size, true, &e);
    CHECK(status == DAR_OK, "refused: %s", e.text);
}

/* The file must be refused with this line. */
static inline void glb_refused(glb *g, const char *message)
{
    dar_scene s;
    dar_err e;
    glb_finish(g);
    dar_status status = dar_gltf_parse(&s, "t.glb", g->out, g->size, true, &e);
    CHECK(status != DAR_OK, "accepted, expected: %s", message);
    CHECK(strcmp(e.text, message) == 0, "found:    %s\nexpected: %s", e.text, message);
    assert_null(s.memory.base);
}

/* ---------------------------------------------------------------- a posed scene with its buffers */

typedef struct posed {
    dar_arena arena;
    dar_pose pose;
    float *position, *normal;
} posed;

static inline void posed_init(posed *p, const dar_scene *s)
{
    assert_int_equal(dar_arena_init(&p->arena, "test", (size_t)64 << 20, NULL), DAR_OK);
    dar_pose_init(&p->pose, s, &p->arena);
    p->position = dar_arena_push(&p->arena, s->vertices * 12);
    p->normal = dar_arena_push(&p->arena, s->vertices * 12);
}

static inline void posed_at(posed *p, int animation, double t)
{
    dar_err e;
    dar_status status = dar_pose_at(&p->pose, animation, t, &e);
    CHECK(status == DAR_OK, "pose: %s", e.text);
    dar_pose_vertices(&p->pose, p->position, p->normal, false);
}

static inline void posed_free(posed *p)
{
    dar_arena_free(&p->arena);
}

/* Three numbers of row v. */
static inline void check_row(const char *what, const float *rows, size_t v, double x, double y, double z, double bound)
{
    char name[96];
    const double expected[3] = { x, y, z };
    for (int c = 0; c < 3; c++) {
        snprintf(name, sizeof name, "%s, row %zu, %c", what, v, "xyz"[c]);
        CHECK_NEAR(name, rows[3 * v + (size_t)c], expected[c], bound);
    }
}

#endif
