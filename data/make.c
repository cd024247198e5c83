/* make.c: nodes, meshes out of sheets, movers to keys. */
#include "data/make.h"

#include <math.h>
#include <string.h>

#include "data/affine.h"
#include "data/rigid.h"

/* Vertices of equal place and normal share one number, `weld`: the seams of textures do not show in the light. */
struct dar_make_mesh {
    float position[DAR_MAKE_VERTICES][3], normal[DAR_MAKE_VERTICES][3], uv[DAR_MAKE_VERTICES][2];
    uint32_t weld[DAR_MAKE_VERTICES], index[DAR_MAKE_TRIANGLES][3];
    uint16_t joint[DAR_MAKE_VERTICES][2];
    float second[DAR_MAKE_VERTICES]; /* weight of joint[1] */
    double sum[DAR_MAKE_VERTICES][3];
    dar_primitive part[DAR_MAKE_PARTS];
    size_t vertices, triangles, parts, joints;
    float (*target)[3], (*target_normal)[3]; /* [targets, vertices] in the scene's memory, growing */
    size_t targets;
};

static void *zeroed(dar_arena *a, size_t bytes)
{
    return memset(dar_arena_push(a, bytes), 0, bytes);
}

dar_status dar_make_open(dar_maker *m, dar_scene *s, size_t frames, double fps, dar_err *e)
{
    *m = (dar_maker){ .scene = s, .frames = frames, .fps = fps, .paint = DAR_NONE, .density = 1, .joint = DAR_NONE };
    *s = (dar_scene){ .path = "synthetic" };
    DAR_TRY(dar_arena_init(&s->memory, "synthetic scene", DAR_MAKE_MEMORY, e));
    dar_arena *a = &s->memory;
    s->node = dar_arena_push(a, DAR_MAKE_NODES * sizeof *s->node);
    s->order = dar_arena_push(a, DAR_MAKE_NODES * sizeof *s->order);
    s->instance = dar_arena_push(a, DAR_MAKE_NODES * sizeof *s->instance);
    s->mesh = dar_arena_push(a, DAR_MAKE_MESHES * sizeof *s->mesh);
    s->skin = dar_arena_push(a, DAR_MAKE_SKINS * sizeof *s->skin);
    s->material = dar_arena_push(a, DAR_MAKE_PAINTS * sizeof *s->material);
    s->image = dar_arena_push(a, DAR_MAKE_PAINTS * sizeof *s->image);
    s->animation = dar_arena_push(a, sizeof *s->animation);
    m->mover = dar_arena_push(a, DAR_MAKE_MOVERS * sizeof *m->mover);
    m->mesh = dar_arena_push(a, sizeof *m->mesh);
    return DAR_OK;
}

/* ---------------------------------------------------------------- nodes */

int dar_make_node(dar_maker *m, int parent, const char *name, double x, double y, double z)
{
    dar_scene *s = m->scene;
    DAR_ASSERT(s->nodes < DAR_MAKE_NODES, "make: more than %d nodes", DAR_MAKE_NODES);
    s->node[s->nodes] = (dar_node){
        .name = name,
        .parent = parent,
        .depth = parent == DAR_NONE ? 0 : s->node[parent].depth + 1,
        .mesh = DAR_NONE,
        .skin = DAR_NONE,
        .camera = DAR_NONE,
        .in_scene = true,
        .translation = { x, y, z },
        .rotation = { 0, 0, 0, 1 },
        .scale = { 1, 1, 1 },
    };
    s->order[s->nodes] = (int)s->nodes; /* parents are made first */
    return (int)s->nodes++;
}

static void turn_of(const double axis[3], double angle, double q[4])
{
    double r = sqrt(dar_vec_dot(axis, axis)), sine = sin(angle / 2) / (r > 0 ? r : 1);
    for (int k = 0; k < 3; k++) q[k] = sine * axis[k];
    q[3] = cos(angle / 2);
    dar_quat_unit(q);
}

void dar_make_turn(dar_maker *m, int node, double x, double y, double z, double angle)
{
    double q[4], axis[3] = { x, y, z };
    turn_of(axis, angle, q);
    dar_quat_mul(q, m->scene->node[node].rotation, m->scene->node[node].rotation);
}

void dar_make_move(dar_maker *m, dar_mover mover)
{
    DAR_ASSERT(m->movers < DAR_MAKE_MOVERS, "make: more than %d movers", DAR_MAKE_MOVERS);
    m->mover[m->movers++] = mover;
}

void dar_make_show(dar_maker *m, int node, int mesh)
{
    dar_scene *s = m->scene;
    dar_mesh *x = &s->mesh[mesh];
    s->node[node].mesh = mesh;
    if (x->targets) {
        s->node[node].weight = x->target_weight;
        s->node[node].first_weight = s->weights;
        s->weights += x->targets;
    }
    s->instance[s->instances++] = (dar_instance){ .node = node, .mesh = mesh, .skin = DAR_NONE, .vertex = s->vertices };
    s->vertices += x->vertices;
}

/* Joints have no rotation at rest, so that the way to the top is a sum of translations. */
void dar_make_skin(dar_maker *m, int node, int mesh, const int *joint, size_t joints)
{
    dar_scene *s = m->scene;
    DAR_ASSERT(s->skins < DAR_MAKE_SKINS, "make: more than %d skins", DAR_MAKE_SKINS);
    dar_skin *k = &s->skin[s->skins];
    k->name = s->node[node].name;
    k->joints = joints;
    k->joint = dar_arena_push(&s->memory, joints * sizeof *k->joint);
    k->inverse = dar_arena_push(&s->memory, joints * sizeof *k->inverse);
    memcpy(k->joint, joint, joints * sizeof *joint);
    for (size_t i = 0; i < joints; i++) {
        memcpy(k->inverse[i], dar_affine_identity, sizeof *k->inverse);
        for (int n = joint[i]; n != DAR_NONE && n != node; n = s->node[n].parent)
            for (int c = 0; c < 3; c++) k->inverse[i][4 * c + 3] -= s->node[n].translation[c];
    }
    dar_make_show(m, node, mesh);
    s->node[node].skin = s->instance[s->instances - 1].skin = (int)s->skins++;
}

/* ---------------------------------------------------------------- a mesh out of sheets */

void dar_make_begin(dar_maker *m)
{
    struct dar_make_mesh *b = m->mesh;
    b->vertices = b->triangles = b->parts = b->targets = b->joints = 0;
    m->joint = DAR_NONE;
    dar_make_home(m);
}

/* The primitive of the paint in force; vertices of one primitive are contiguous. */
static dar_primitive *part_of(dar_maker *m)
{
    struct dar_make_mesh *b = m->mesh;
    if (!b->parts || b->part[b->parts - 1].material != m->paint) {
        DAR_ASSERT(b->parts < DAR_MAKE_PARTS, "make: more than %d parts", DAR_MAKE_PARTS);
        b->part[b->parts++] =
            (dar_primitive){ .vertex = b->vertices, .triangle = b->triangles, .material = m->paint, .textured = true };
    }
    return &b->part[b->parts - 1];
}

static void carry(dar_maker *m, const dar_sheet_shape *s, double u, double v, size_t vertex)
{
    struct dar_make_mesh *b = m->mesh;
    int joint[2] = { m->joint, m->joint };
    double second = 0;
    if (s->joints) s->joints(s->ctx, u, v, joint, &second);
    for (int k = 0; k < 2; k++) {
        b->joint[vertex][k] = (uint16_t)(joint[k] < 0 ? 0 : joint[k]);
        if (joint[k] >= (int)b->joints) b->joints = (size_t)joint[k] + 1;
    }
    if (second <= 0) b->joint[vertex][1] = 0;
    b->second[vertex] = (float)fmax(second, 0);
}

static bool same(const float *a, const float *b)
{
    return a[0] == b[0] && a[1] == b[1] && a[2] == b[2];
}

static void add_vertices(dar_maker *m, const dar_sheet_shape *s)
{
    struct dar_make_mesh *b = m->mesh;
    size_t first = b->vertices, across = s->columns + 1;
    DAR_ASSERT(first + (s->rows + 1) * across <= DAR_MAKE_VERTICES, "make: more than %d vertices", DAR_MAKE_VERTICES);
    for (size_t r = 0; r <= s->rows; r++) {
        double v = (double)r / (double)s->rows, row = s->closed_v && r == s->rows ? 0 : v;
        bool pole = true;
        size_t begin = b->vertices;
        for (size_t c = 0; c <= s->columns; c++) {
            double x[3], u = (double)c / (double)s->columns, column = s->closed_u && c == s->columns ? 0 : u;
            size_t i = b->vertices++;
            s->point(s->ctx, column, row, x);
            for (int k = 0; k < 3; k++) b->position[i][k] = (float)(dar_vec_dot(m->at + 4 * k, x) + m->at[4 * k + 3]);
            b->uv[i][0] = (float)((s->planar ? x[0] : u) * s->repeat_u);
            b->uv[i][1] = (float)((s->planar ? x[2] : v) * s->repeat_v);
            b->weld[i] = (uint32_t)i;
            if (s->closed_u && c == s->columns) b->weld[i] = (uint32_t)begin;
            if (s->closed_v && r == s->rows) b->weld[i] = b->weld[first + c];
            pole = pole && same(b->position[i], b->position[begin]);
            carry(m, s, column, row, i);
        }
        for (size_t i = begin; pole && i < b->vertices; i++) b->weld[i] = (uint32_t)begin;
    }
}

static void add_triangle(struct dar_make_mesh *b, size_t i, size_t j, size_t k)
{
    uint32_t t[3] = { (uint32_t)i, (uint32_t)j, (uint32_t)k };
    if (same(b->position[i], b->position[j]) || same(b->position[j], b->position[k]) ||
        same(b->position[k], b->position[i]))
        return;
    DAR_ASSERT(b->triangles < DAR_MAKE_TRIANGLES, "make: more than %d triangles", DAR_MAKE_TRIANGLES);
    memcpy(b->index[b->triangles++], t, sizeof t);
}

/* Normals of places x, area-weighted over the triangles around each weld. */
static void find_normals(struct dar_make_mesh *b, float (*x)[3], size_t vertex, size_t triangle, float (*n)[3])
{
    memset(b->sum + vertex, 0, (b->vertices - vertex) * sizeof *b->sum);
    for (size_t t = triangle; t < b->triangles; t++) {
        const uint32_t *i = b->index[t];
        double p[3], q[3], y[3];
        for (int k = 0; k < 3; k++) p[k] = (double)x[i[1]][k] - x[i[0]][k], q[k] = (double)x[i[2]][k] - x[i[0]][k];
        dar_vec_cross(p, q, y);
        for (int c = 0; c < 3; c++)
            for (int k = 0; k < 3; k++) b->sum[b->weld[i[c]]][k] += y[k];
    }
    for (size_t v = vertex; v < b->vertices; v++) {
        const double *y = b->sum[b->weld[v]];
        double r = sqrt(dar_vec_dot(y, y));
        for (int k = 0; k < 3; k++) n[v][k] = (float)(r > 0 ? y[k] / r : k == 1);
    }
}

void dar_make_sheet(dar_maker *m, const dar_sheet_shape *s)
{
    struct dar_make_mesh *b = m->mesh;
    dar_primitive *p = part_of(m);
    size_t first = b->vertices, triangle = b->triangles, across = s->columns + 1;
    bool mirrored = dar_affine_det(m->at) < 0;
    DAR_ASSERT(!b->targets, "make: a shape after a morph target");
    add_vertices(m, s);
    for (size_t r = 0; r < s->rows; r++)
        for (size_t c = 0; c < s->columns; c++) {
            size_t i = first + r * across + c, j = i + 1, k = j + across, l = i + across;
            if (mirrored) add_triangle(b, i, k, j), add_triangle(b, i, l, k);
            else add_triangle(b, i, j, k), add_triangle(b, i, k, l);
        }
    p->vertices = b->vertices - p->vertex;
    p->triangles = b->triangles - p->triangle;
    find_normals(b, b->position, first, triangle, b->normal);
}

void dar_make_target(dar_maker *m, dar_make_bend *where, const void *ctx)
{
    struct dar_make_mesh *b = m->mesh;
    size_t bytes = b->vertices * sizeof *b->target;
    if (!b->targets) {
        b->target = dar_arena_push(&m->scene->memory, DAR_MAKE_TARGETS * bytes);
        b->target_normal = dar_arena_push(&m->scene->memory, DAR_MAKE_TARGETS * bytes);
    }
    DAR_ASSERT(b->targets < DAR_MAKE_TARGETS, "make: more than %d targets", DAR_MAKE_TARGETS);
    float(*x)[3] = b->target + b->targets * b->vertices, (*n)[3] = b->target_normal + b->targets++ * b->vertices;
    for (size_t i = 0; i < b->vertices; i++) {
        double from[3] = { b->position[i][0], b->position[i][1], b->position[i][2] }, to[3];
        where(ctx, from, to);
        for (int k = 0; k < 3; k++) x[i][k] = (float)to[k];
    }
    find_normals(b, x, 0, 0, n);
    for (size_t i = 0; i < b->vertices; i++)
        for (int k = 0; k < 3; k++) x[i][k] -= b->position[i][k], n[i][k] -= b->normal[i][k];
}

static void *kept(dar_arena *a, const void *x, size_t bytes)
{
    return memcpy(dar_arena_push(a, bytes), x, bytes);
}

int dar_make_end(dar_maker *m, const char *name)
{
    struct dar_make_mesh *b = m->mesh;
    dar_scene *s = m->scene;
    dar_arena *a = &s->memory;
    DAR_ASSERT(s->meshes < DAR_MAKE_MESHES, "make: more than %d meshes", DAR_MAKE_MESHES);
    DAR_ASSERT(b->triangles, "make: mesh %s has no triangles", name);
    dar_mesh *x = &s->mesh[s->meshes];
    *x = (dar_mesh){ .name = name, .vertices = b->vertices, .triangles = b->triangles, .primitives = b->parts };
    x->primitive = kept(a, b->part, b->parts * sizeof *b->part);
    x->position = kept(a, b->position, b->vertices * sizeof *b->position);
    x->normal = kept(a, b->normal, b->vertices * sizeof *b->normal);
    x->uv = kept(a, b->uv, b->vertices * sizeof *b->uv);
    x->index = kept(a, b->index, b->triangles * sizeof *b->index);
    if (b->joints) {
        x->influences = 2;
        x->joints = b->joints;
        x->joint = kept(a, b->joint, b->vertices * sizeof *b->joint);
        x->weight = dar_arena_push(a, 2 * b->vertices * sizeof *x->weight);
        for (size_t i = 0; i < b->vertices; i++) {
            x->weight[2 * i] = 1 - b->second[i];
            x->weight[2 * i + 1] = b->second[i];
        }
    }
    if (b->targets) {
        x->targets = b->targets;
        x->target_position = b->target[0];
        x->target_normal = b->target_normal[0];
        x->target_weight = zeroed(a, b->targets * sizeof *x->target_weight);
    }
    return (int)s->meshes++;
}

/* ---------------------------------------------------------------- where shapes go */

void dar_make_home(dar_maker *m)
{
    memcpy(m->at, dar_affine_identity, sizeof m->at);
}

static void then(dar_maker *m, const double t[3], const double q[4], const double s[3])
{
    double y[12];
    dar_affine_trs(t, q, s, y);
    dar_affine_mul(m->at, y, m->at);
}

void dar_make_shift(dar_maker *m, double x, double y, double z)
{
    then(m, (const double[]){ x, y, z }, (const double[]){ 0, 0, 0, 1 }, (const double[]){ 1, 1, 1 });
}

void dar_make_rotate(dar_maker *m, double x, double y, double z, double angle)
{
    double q[4];
    turn_of((const double[]){ x, y, z }, angle, q);
    then(m, (const double[]){ 0, 0, 0 }, q, (const double[]){ 1, 1, 1 });
}

void dar_make_stretch(dar_maker *m, double x, double y, double z)
{
    then(m, (const double[]){ 0, 0, 0 }, (const double[]){ 0, 0, 0, 1 }, (const double[]){ x, y, z });
}

/* ---------------------------------------------------------------- movers to keys */

static double value_at(const dar_mover *v, double t)
{
    return v->base + v->swing * sin(2 * M_PI * (v->frequency * t + v->phase)) + v->rate * t;
}

/* The value of the channel of first's node and path: rest, and all movers of the two. */
static void sample(const dar_maker *m, const dar_mover *first, size_t frame, double *y)
{
    const dar_node *n = &m->scene->node[first->node];
    double t = (double)frame / m->fps;
    size_t width = first->path == DAR_ROTATION ? 4 : first->path == DAR_WEIGHTS ? m->scene->mesh[n->mesh].targets : 3;
    const double *rest = first->path == DAR_ROTATION  ? n->rotation
                         : first->path == DAR_SCALE   ? n->scale
                         : first->path == DAR_WEIGHTS ? n->weight
                                                      : n->translation;
    memcpy(y, rest, width * sizeof *y);
    for (const dar_mover *v = first; v < m->mover + m->movers; v++) {
        if (v->node != first->node || v->path != first->path) continue;
        double x = value_at(v, t), q[4];
        if (v->track) {
            memcpy(y, v->track + width * frame, width * sizeof *y);
        } else if (v->path == DAR_ROTATION) {
            turn_of(v->axis, x, q);
            dar_quat_mul(y, q, y);
        } else if (v->path == DAR_WEIGHTS) {
            y[v->target] += x;
        } else {
            for (int k = 0; k < 3; k++)
                y[k] = v->path == DAR_SCALE ? y[k] * (1 + x * v->axis[k]) : y[k] + x * v->axis[k];
        }
    }
    if (first->path == DAR_ROTATION) dar_quat_unit(y);
}

static bool is_first(const dar_maker *m, const dar_mover *v)
{
    for (const dar_mover *w = m->mover; w < v; w++)
        if (w->node == v->node && w->path == v->path) return false;
    return true;
}

void dar_make_close(dar_maker *m)
{
    dar_scene *s = m->scene;
    dar_arena *a = &s->memory;
    double *time = dar_arena_push(a, m->frames * sizeof *time), y[DAR_MAKE_TARGETS];
    dar_animation *x = s->animation;
    for (size_t t = 0; t < m->frames; t++) time[t] = (double)t / m->fps;
    *x = (dar_animation){ .name = "clip", .begin = 0, .end = time[m->frames - 1] };
    x->channel = dar_arena_push(a, m->movers * sizeof *x->channel);
    for (const dar_mover *v = m->mover; v < m->mover + m->movers; v++) {
        if (!is_first(m, v)) continue;
        size_t width = v->path == DAR_ROTATION  ? 4
                       : v->path == DAR_WEIGHTS ? s->mesh[s->node[v->node].mesh].targets
                                                : 3;
        float *value = dar_arena_push(a, m->frames * width * sizeof *value);
        for (size_t t = 0; t < m->frames; t++) {
            sample(m, v, t, y);
            for (size_t k = 0; k < width; k++) value[t * width + k] = (float)y[k];
        }
        x->channel[x->channels++] = (dar_channel){ v->node, v->path, DAR_LINEAR, m->frames, width, time, value };
    }
    s->animations = x->channels > 0;
}
