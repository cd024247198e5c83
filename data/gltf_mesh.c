/* gltf_mesh.c: primitives become ranges of one mesh.
 *
 * A mesh is read twice: first the triangles of every primitive, which say how many vertices are used, then the vertices
 * themselves into arrays of the right size. */
#include "data/gltf_file.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

enum { TRIANGLES = 4, STRIP, FAN };

/* A primitive between the two readings. */
struct part {
    dar_json json, attributes, targets; /* targets.item NULL: none */
    dar_gltf_accessor position;
    bool flat;
    size_t sets; /* of four joints */
    size_t vertices, triangles;
    uint32_t *from;  /* [vertices] elements of the accessors */
    uint32_t *index; /* [triangles, 3] into from */
};

static bool has(dar_json j, const char *key)
{
    return j.item && dar_json_get(j, key).item;
}

/* "JOINTS_2" */
static const char *numbered(char buf[32], const char *name, size_t n)
{
    snprintf(buf, 32, "%s_%zu", name, n);
    return buf;
}

/* An attribute, with as many elements as there are positions. */
static dar_status attribute_at(dar_gltf *g, const struct part *p, dar_json j, const char *key, unsigned types,
                               size_t lo, size_t hi, dar_gltf_accessor *a)
{
    DAR_TRY(dar_gltf_accessor_at(g, j, key, types, lo, hi, a));
    if (a->count == p->position.count) return DAR_OK;
    return DAR_GLTF_REJECT(g, a->json, "count", "%zu, as POSITION has, for %s", p->position.count, key);
}

/* ---------------------------------------------------------------- triangles */

/* Corners of the triangles of a list, strip or fan of n vertices, as positions in it. */
static void corners(int mode, size_t i, size_t c[3])
{
    if (mode == TRIANGLES) c[0] = 3 * i, c[1] = 3 * i + 1, c[2] = 3 * i + 2;
    else if (mode == STRIP) c[0] = i, c[1] = i + 1 + i % 2, c[2] = i + 2 - i % 2;
    else c[0] = i + 1, c[1] = i + 2, c[2] = 0;
}

/* p->index: corners as elements of the accessors. */
static dar_status read_triangles(dar_gltf *g, struct part *p, int mode)
{
    size_t n = p->position.count;
    uint32_t *list = NULL;

    if (has(p->json, "indices")) {
        dar_gltf_accessor a;
        DAR_TRY(dar_gltf_accessor_at(g, p->json, "indices", DAR_GLTF_UNSIGNED | DAR_GLTF_UNSIGNED32, 1, 1, &a));
        n = a.count;
        DAR_TRY(dar_gltf_scratch(g, &list, n, sizeof *list));
        DAR_TRY(dar_gltf_gather_u32(g, &a, list));
        for (size_t i = 0; i < n; i++)
            if (list[i] >= p->position.count)
                return DAR_GLTF_REJECT(g, p->json, "indices", "indices below the %zu vertices: the one at %zu is %u",
                                       p->position.count, i, list[i]);
    }
    if (n < 3 || (mode == TRIANGLES && n % 3))
        return DAR_GLTF_REJECT(g, p->json, list ? "indices" : "mode", "whole triangles: there are %zu corners", n);
    p->triangles = mode == TRIANGLES ? n / 3 : n - 2;
    DAR_TRY(dar_gltf_scratch(g, &p->index, p->triangles, 3 * sizeof *p->index));
    for (size_t i = 0; i < p->triangles; i++) {
        size_t c[3];
        corners(mode, i, c);
        for (int k = 0; k < 3; k++) p->index[3 * i + k] = list ? list[c[k]] : (uint32_t)c[k];
    }
    return DAR_OK;
}

/* p->from: the elements that triangles use, in order, or every corner by itself; p->index follows. */
static dar_status choose_vertices(dar_gltf *g, struct part *p)
{
    size_t n = p->position.count, corner = 3 * p->triangles;
    uint32_t *to;

    if (p->flat) {
        DAR_TRY(dar_gltf_scratch(g, &p->from, corner, sizeof *p->from));
        memcpy(p->from, p->index, corner * sizeof *p->from);
        for (size_t i = 0; i < corner; i++) p->index[i] = (uint32_t)i;
        p->vertices = corner;
        return DAR_OK;
    }
    DAR_TRY(dar_gltf_spend(g, n));
    DAR_TRY(dar_gltf_scratch(g, &to, n, sizeof *to));
    for (size_t i = 0; i < corner; i++) to[p->index[i]] = 1;
    for (size_t i = 0; i < n; i++) p->vertices += to[i];
    DAR_TRY(dar_gltf_scratch(g, &p->from, p->vertices, sizeof *p->from));
    for (size_t i = 0, k = 0; i < n; i++) {
        if (!to[i]) continue;
        p->from[k] = (uint32_t)i;
        to[i] = (uint32_t)k++;
    }
    for (size_t i = 0; i < corner; i++) p->index[i] = to[p->index[i]];
    return DAR_OK;
}

/* *used: whether it has triangles. */
static dar_status read_part(dar_gltf *g, dar_json j, struct part *p, bool *used)
{
    int mode = (int)dar_json_int(j, "mode", TRIANGLES, 0, FAN);
    char key[32];

    *p = (struct part){ .json = j, .attributes = dar_json_object(j, "attributes") };
    DAR_TRY(dar_gltf_check(g));
    *used = mode >= TRIANGLES && has(p->attributes, "POSITION");
    if (!*used) {
        g->scene->notes.points_and_lines++;
        return DAR_OK;
    }
    DAR_TRY(dar_gltf_accessor_at(g, p->attributes, "POSITION", DAR_GLTF_FLOATS | DAR_GLTF_NORMALIZED | DAR_GLTF_SIGNED,
                                 3, 3, &p->position));
    p->flat = !has(p->attributes, "NORMAL");
    g->scene->notes.normals_made += p->flat;
    while (has(p->attributes, numbered(key, "JOINTS", p->sets))) p->sets++;
    if (has(j, "targets")) p->targets = dar_json_array(j, "targets");
    DAR_TRY(read_triangles(g, p, mode));
    return choose_vertices(g, p);
}

/* ---------------------------------------------------------------- vertices */

static dar_status read_normals(dar_gltf *g, const struct part *p, float *out)
{
    dar_gltf_accessor a;
    DAR_TRY(attribute_at(g, p, p->attributes, "NORMAL", DAR_GLTF_FLOATS | DAR_GLTF_NORMALIZED, 3, 3, &a));
    DAR_TRY(dar_gltf_gather(g, &a, p->from, p->vertices, out));
    for (size_t v = 0; v < p->vertices; v++) {
        float *x = out + 3 * v;
        double r = sqrt((double)x[0] * x[0] + (double)x[1] * x[1] + (double)x[2] * x[2]);
        for (int c = 0; c < 3 && r > 0; c++) x[c] = (float)(x[c] / r);
    }
    return DAR_OK;
}

/* Texture coordinates as the material wants them. */
static dar_status read_uv(dar_gltf *g, const struct part *p, const dar_gltf_texture *t, float *out)
{
    char key[32];
    dar_gltf_accessor a;
    numbered(key, "TEXCOORD", (size_t)t->set);
    DAR_TRY(attribute_at(g, p, p->attributes, key, DAR_GLTF_FLOATS | DAR_GLTF_NORMALIZED | DAR_GLTF_SIGNED, 2, 2, &a));
    DAR_TRY(dar_gltf_gather(g, &a, p->from, p->vertices, out));
    for (size_t v = 0; v < p->vertices; v++) {
        double x = out[2 * v], y = out[2 * v + 1];
        for (int c = 0; c < 2; c++)
            out[2 * v + c] = (float)(t->uv[3 * c] * x + t->uv[3 * c + 1] * y + t->uv[3 * c + 2]);
    }
    return DAR_OK;
}

static dar_status read_colors(dar_gltf *g, const struct part *p, float *out)
{
    dar_gltf_accessor a;
    if (!has(p->attributes, "COLOR_0")) {
        for (size_t i = 0; i < 4 * p->vertices; i++) out[i] = 1;
        return DAR_OK;
    }
    DAR_TRY(attribute_at(g, p, p->attributes, "COLOR_0", DAR_GLTF_FLOATS | DAR_GLTF_NORMALIZED, 3, 4, &a));
    DAR_TRY(dar_gltf_gather(g, &a, p->from, p->vertices, out));
    for (size_t v = p->vertices; a.width == 3 && v-- > 0;) { /* from the end: rows grow from 3 to 4 */
        memmove(out + 4 * v, out + 3 * v, 3 * sizeof *out);
        out[4 * v + 3] = 1;
    }
    return DAR_OK;
}

/* Sum 1, joint 0 where the weight is 0; a vertex without weights follows its first joint. */
static dar_status settle_weights(dar_gltf *g, dar_mesh *m, const struct part *p, size_t first)
{
    dar_scene_notes *notes = &g->scene->notes;
    for (size_t v = first; v < first + p->vertices; v++) {
        float *w = m->weight + v * m->influences;
        uint16_t *joint = m->joint + v * m->influences;
        double sum = 0;
        for (size_t k = 0; k < m->influences; k++) {
            if (w[k] < 0)
                return DAR_GLTF_REJECT(g, p->attributes, "WEIGHTS_0", "weights of at least 0: vertex %u has %g",
                                       p->from[v - first], (double)w[k]);
            sum += w[k];
        }
        notes->unweighted += sum == 0;
        notes->weights_normalised += sum != 0 && fabs(sum - 1) > 0.01; /* 8-bit weights may be off by 4 / 510 */
        if (sum == 0) w[0] = 1, sum = 1;
        for (size_t k = 0; k < m->influences; k++) {
            w[k] = (float)(w[k] / sum);
            if (w[k] == 0) joint[k] = 0;
            if (joint[k] >= m->joints) m->joints = (size_t)joint[k] + 1;
        }
    }
    return DAR_OK;
}

static dar_status read_influences(dar_gltf *g, dar_mesh *m, const struct part *p, size_t first)
{
    dar_mark mark = dar_arena_mark(&g->scratch);
    float *four;

    if (!p->sets) return DAR_GLTF_REJECT(g, p->attributes, NULL, "JOINTS_0, which other primitives of the mesh have");
    DAR_TRY(dar_gltf_scratch(g, &four, p->vertices, 4 * sizeof *four));
    for (size_t s = 0; s < p->sets; s++) {
        dar_gltf_accessor joint, weight;
        char joints[32], weights[32];
        numbered(joints, "JOINTS", s);
        numbered(weights, "WEIGHTS", s);
        DAR_TRY(attribute_at(g, p, p->attributes, joints, DAR_GLTF_UNSIGNED, 4, 4, &joint));
        DAR_TRY(attribute_at(g, p, p->attributes, weights, DAR_GLTF_FLOATS | DAR_GLTF_NORMALIZED, 4, 4, &weight));
        DAR_TRY(dar_gltf_gather(g, &joint, p->from, p->vertices, four));
        for (size_t i = 0; i < 4 * p->vertices; i++)
            m->joint[(first + i / 4) * m->influences + 4 * s + i % 4] = (uint16_t)four[i];
        DAR_TRY(dar_gltf_gather(g, &weight, p->from, p->vertices, four));
        for (size_t i = 0; i < 4 * p->vertices; i++)
            m->weight[(first + i / 4) * m->influences + 4 * s + i % 4] = four[i];
    }
    dar_arena_reset(&g->scratch, mark);
    return settle_weights(g, m, p, first);
}

static dar_status read_targets(dar_gltf *g, dar_mesh *m, const struct part *p, size_t first)
{
    size_t k = 0;
    if (!m->targets) return DAR_OK;
    for (dar_json t = dar_json_first(p->targets); t.item; t = dar_json_next(t), k++) {
        size_t at = 3 * (k * m->vertices + first);
        dar_gltf_accessor a;
        if (has(t, "POSITION")) {
            DAR_TRY(
                attribute_at(g, p, t, "POSITION", DAR_GLTF_FLOATS | DAR_GLTF_NORMALIZED | DAR_GLTF_SIGNED, 3, 3, &a));
            DAR_TRY(dar_gltf_gather(g, &a, p->from, p->vertices, m->target_position + at));
        }
        if (has(t, "NORMAL") && !p->flat) {
            DAR_TRY(attribute_at(g, p, t, "NORMAL", DAR_GLTF_FLOATS | DAR_GLTF_NORMALIZED, 3, 3, &a));
            DAR_TRY(dar_gltf_gather(g, &a, p->from, p->vertices, m->target_normal + at));
        }
    }
    return dar_gltf_check(g);
}

/* ---------------------------------------------------------------- meshes */

static dar_gltf_texture texture_of(const dar_gltf *g, const struct part *p, int material)
{
    char key[32];
    if (material == DAR_NONE || g->texture[material].set == DAR_NONE) return (dar_gltf_texture){ .set = DAR_NONE };
    bool there = has(p->attributes, numbered(key, "TEXCOORD", (size_t)g->texture[material].set));
    return there ? g->texture[material] : (dar_gltf_texture){ .set = DAR_NONE };
}

/* What arrays the parts need together; takes them. */
static dar_status take_arrays(dar_gltf *g, dar_mesh *m, const struct part *part, dar_json j)
{
    bool uv = false, color = false, normals = false;
    size_t sets = 0;

    m->targets = m->primitives ? dar_json_size(part->targets) : 0;
    for (size_t i = 0; i < m->primitives; i++) {
        const struct part *p = &part[i];
        if (dar_json_size(p->targets) != m->targets)
            return DAR_GLTF_REJECT(g, p->json, "targets", "%zu, as the mesh's first primitive has", m->targets);
        for (dar_json t = dar_json_first(p->targets); t.item; t = dar_json_next(t))
            normals |= !p->flat && has(t, "NORMAL");
        uv |= texture_of(g, p, m->primitive[i].material).set != DAR_NONE;
        color |= has(p->attributes, "COLOR_0");
        sets = p->sets > sets ? p->sets : sets;
        m->vertices += p->vertices;
        m->triangles += p->triangles;
    }
    m->influences = 4 * sets;
    if (m->vertices > UINT32_MAX) return DAR_GLTF_REJECT(g, j, "primitives", "fewer than 2^32 vertices");
    DAR_TRY(dar_gltf_take(g, &m->position, m->vertices, 3 * sizeof(float)));
    DAR_TRY(dar_gltf_take(g, &m->normal, m->vertices, 3 * sizeof(float)));
    DAR_TRY(dar_gltf_take(g, &m->index, m->triangles, 3 * sizeof *m->index));
    if (uv) DAR_TRY(dar_gltf_take(g, &m->uv, m->vertices, 2 * sizeof(float)));
    if (color) DAR_TRY(dar_gltf_take(g, &m->color, m->vertices, 4 * sizeof(float)));
    if (sets) DAR_TRY(dar_gltf_take(g, &m->joint, m->vertices, 4 * sets * sizeof *m->joint));
    if (sets) DAR_TRY(dar_gltf_take(g, &m->weight, m->vertices, 4 * sets * sizeof(float)));
    if (m->targets) DAR_TRY(dar_gltf_take(g, &m->target_position, m->targets * 3 * sizeof(float), m->vertices));
    if (normals) DAR_TRY(dar_gltf_take(g, &m->target_normal, m->targets * 3 * sizeof(float), m->vertices));
    return DAR_OK;
}

static dar_status fill_arrays(dar_gltf *g, dar_mesh *m, const struct part *part)
{
    size_t vertex = 0, triangle = 0;
    for (size_t i = 0; i < m->primitives; i++) {
        const struct part *p = &part[i];
        dar_primitive *q = &m->primitive[i];
        dar_gltf_texture t = texture_of(g, p, q->material);
        *q = (dar_primitive){ vertex, p->vertices, triangle, p->triangles, q->material, t.set != DAR_NONE, p->flat };
        DAR_TRY(dar_gltf_gather(g, &p->position, p->from, p->vertices, m->position + 3 * vertex));
        if (!p->flat) DAR_TRY(read_normals(g, p, m->normal + 3 * vertex));
        if (t.set != DAR_NONE) DAR_TRY(read_uv(g, p, &t, m->uv + 2 * vertex));
        if (m->color) DAR_TRY(read_colors(g, p, m->color + 4 * vertex));
        if (m->influences) DAR_TRY(read_influences(g, m, p, vertex));
        DAR_TRY(read_targets(g, m, p, vertex));
        for (size_t k = 0; k < 3 * p->triangles; k++) m->index[3 * triangle + k] = (uint32_t)vertex + p->index[k];
        vertex += p->vertices;
        triangle += p->triangles;
    }
    return DAR_OK;
}

static dar_status read_mesh(dar_gltf *g, dar_json j, dar_mesh *m)
{
    dar_json list = dar_json_array(j, "primitives");
    size_t n = dar_json_size(list);
    struct part *part;

    DAR_TRY(dar_gltf_name(g, j, &m->name));
    DAR_TRY(dar_gltf_scratch(g, &part, n, sizeof *part));
    DAR_TRY(dar_gltf_take(g, &m->primitive, n, sizeof *m->primitive));
    for (dar_json x = dar_json_first(list); x.item; x = dar_json_next(x)) {
        bool used;
        m->primitive[m->primitives].material = dar_gltf_index(g, x, "material", DAR_GLTF_MATERIALS);
        DAR_TRY(dar_gltf_check(g));
        DAR_TRY(read_part(g, x, &part[m->primitives], &used));
        m->primitives += used;
    }
    DAR_TRY(take_arrays(g, m, part, j));
    DAR_TRY(fill_arrays(g, m, part));
    if (m->targets) {
        DAR_TRY(dar_gltf_take(g, &m->target_weight, m->targets, sizeof(double)));
        DAR_TRY(dar_gltf_numbers(g, j, "weights", m->target_weight, m->targets));
    }
    return DAR_OK;
}

dar_status dar_gltf_meshes(dar_gltf *g)
{
    dar_scene *s = g->scene;

    s->meshes = g->length[DAR_GLTF_MESHES];
    DAR_TRY(dar_gltf_take(g, &s->mesh, s->meshes, sizeof *s->mesh));
    for (size_t i = 0; i < s->meshes; i++) {
        dar_mark mark = dar_arena_mark(&g->scratch);
        DAR_TRY(read_mesh(g, g->list[DAR_GLTF_MESHES][i], &s->mesh[i]));
        dar_arena_reset(&g->scratch, mark);
    }
    return DAR_OK;
}
