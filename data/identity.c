/* identity.c: parts by union and find over equal positions, cells in order. */
#include "data/identity.h"

#include <math.h>
#include <string.h>

#define EMPTY  UINT32_MAX
#define MARGIN (1.0 / 64)

/* ---------------------------------------------------------------- table */

/* Three numbers to one, open addressing; never full. */
struct table {
    uint32_t (*key)[3], *value;
    size_t mask;
};

static struct table table_of(size_t keys, dar_arena *a)
{
    size_t cap = 16;
    while (cap < 2 * keys) cap *= 2;
    struct table t = { dar_arena_push(a, dar_mul_size(cap, 12)), dar_arena_push(a, dar_mul_size(cap, 4)), cap - 1 };
    if (!a->plan) memset(t.value, 0xff, cap * sizeof *t.value);
    return t;
}

/* The value of a key; EMPTY, to be set by the caller, if the key is new. */
static uint32_t *table_at(struct table *t, uint32_t x, uint32_t y, uint32_t z)
{
    uint64_t h = (x * 0x9e3779b97f4a7c15u) ^ (y * 0xc2b2ae3d27d4eb4fu) ^ (z * 0x165667b19e3779f9u);
    size_t i = (size_t)((h ^ h >> 29) * 0xbf58476d1ce4e5b9u >> 20) & t->mask;
    for (; t->value[i] != EMPTY; i = (i + 1) & t->mask)
        if (t->key[i][0] == x && t->key[i][1] == y && t->key[i][2] == z) return &t->value[i];
    t->key[i][0] = x, t->key[i][1] = y, t->key[i][2] = z;
    return &t->value[i];
}

/* ---------------------------------------------------------------- parts */

static uint32_t bits(float x)
{
    uint32_t u;
    x += 0.0f; /* -0 is 0 */
    memcpy(&u, &x, sizeof u);
    return u;
}

/* same[v] = first vertex at the place of v */
static void merge(const float *rest, size_t vertices, struct table *t, uint32_t *same)
{
    for (size_t v = 0; v < vertices; v++) {
        uint32_t *first = table_at(t, bits(rest[3 * v]), bits(rest[3 * v + 1]), bits(rest[3 * v + 2]));
        if (*first == EMPTY) *first = (uint32_t)v;
        same[v] = *first;
    }
}

static uint32_t find(uint32_t *parent, uint32_t v)
{
    while (parent[v] != v) v = parent[v] = parent[parent[v]];
    return v;
}

/* How many triangles before this one have the same corners; degenerate ones are all the first of their kind. */
static uint32_t layer_of(struct table *t, const uint32_t corner[3])
{
    uint32_t a = corner[0], b = corner[1], c = corner[2], swap;
    if (a > b) swap = a, a = b, b = swap;
    if (b > c) swap = b, b = c, c = swap;
    if (a > b) swap = a, a = b, b = swap;
    if (a == b || b == c) return 0;
    uint32_t *count = table_at(t, a, b, c);
    return *count = *count == EMPTY ? 0 : *count + 1;
}

static void find_parts(const dar_mesh *m, dar_identity_mesh *d, dar_arena *a)
{
    struct table places = table_of(m->vertices, a), faces = table_of(m->triangles, a),
                 parts = table_of(m->triangles, a);
    uint32_t *same = dar_arena_push(a, m->vertices * sizeof *same);
    uint32_t *parent = dar_arena_push(a, m->vertices * sizeof *parent);

    if (a->plan) return;
    DAR_ASSERT(m->vertices < EMPTY && m->triangles < EMPTY, "identity: %zu vertices, %zu triangles", m->vertices,
               m->triangles);
    merge(d->rest, m->vertices, &places, same);
    for (size_t v = 0; v < m->vertices; v++) parent[v] = (uint32_t)v;
    for (size_t t = 0; t < m->triangles; t++) {
        const uint32_t *index = m->index + 3 * t;
        for (int k = 1; k < 3; k++) {
            uint32_t x = find(parent, same[index[0]]), y = find(parent, same[index[k]]);
            if (x < y) parent[y] = x;
            else parent[x] = y;
        }
    }
    for (size_t t = 0; t < m->triangles; t++) {
        const uint32_t *index = m->index + 3 * t;
        const uint32_t corner[3] = { same[index[0]], same[index[1]], same[index[2]] };
        uint32_t *part = table_at(&parts, find(parent, corner[0]), layer_of(&faces, corner), 0);
        if (*part == EMPTY) *part = (uint32_t)d->parts++;
        d->part[t] = *part;
    }
}

static void measure_parts(const dar_mesh *m, dar_identity_mesh *d, double (*hi)[3])
{
    for (size_t p = 0; p < d->parts; p++)
        for (int c = 0; c < 3; c++) d->box[p][c] = INFINITY, hi[p][c] = -INFINITY;
    for (size_t i = 0; i < 3 * m->triangles; i++) {
        const float *x = d->rest + 3 * (size_t)m->index[i];
        size_t p = d->part[i / 3];
        for (int c = 0; c < 3; c++) {
            d->box[p][c] = fmin(d->box[p][c], x[c]);
            hi[p][c] = fmax(hi[p][c], x[c]);
        }
    }
    for (size_t p = 0; p < d->parts; p++) {
        d->box[p][3] = 0;
        for (int c = 0; c < 3; c++) d->box[p][3] = fmax(d->box[p][3], hi[p][c] - d->box[p][c]);
    }
}

/* ---------------------------------------------------------------- scene */

/* Weights at rest: those of the first instance, so that all instances of a mesh have the same rest coordinates. */
static const double *rest_weights(const dar_scene *s, size_t mesh)
{
    for (size_t i = 0; i < s->instances; i++)
        if ((size_t)s->instance[i].mesh == mesh) return s->node[s->instance[i].node].weight;
    return s->mesh[mesh].target_weight;
}

static void rest_shape(const dar_mesh *m, const double *weight, float *rest)
{
    for (size_t i = 0; i < 3 * m->vertices; i++) {
        double x = m->position[i];
        for (size_t k = 0; m->target_position && k < m->targets; k++)
            if (weight[k] != 0) x += weight[k] * m->target_position[3 * k * m->vertices + i];
        rest[i] = (float)x;
    }
}

static void init_mesh(const dar_scene *s, size_t mesh, dar_identity_mesh *d, dar_arena *a)
{
    const dar_mesh *m = &s->mesh[mesh];
    const double *weight = m->targets ? rest_weights(s, mesh) : NULL;

    *d = (dar_identity_mesh){ .rest = m->position };
    d->part = dar_arena_push(a, m->triangles * sizeof *d->part);
    if (weight) d->rest = dar_arena_push(a, dar_mul_size(m->vertices, 12));
    if (weight && !a->plan) rest_shape(m, weight, d->rest);

    dar_mark scratch = dar_arena_mark(a);
    find_parts(m, d, a);
    dar_arena_reset(a, scratch);

    size_t parts = a->plan ? m->triangles : d->parts;
    d->box = dar_arena_push(a, parts * sizeof *d->box);
    scratch = dar_arena_mark(a);
    double(*hi)[3] = dar_arena_push(a, parts * sizeof *hi);
    if (!a->plan) measure_parts(m, d, hi);
    dar_arena_reset(a, scratch);
}

void dar_identity_init(dar_identity *d, const dar_scene *s, dar_arena *a)
{
    dar_identity_mesh own;
    *d = (dar_identity){ .scene = s };
    d->mesh = dar_arena_push(a, s->meshes * sizeof *d->mesh);
    d->first = dar_arena_push(a, s->instances * sizeof *d->first);
    for (size_t i = 0; i < s->meshes; i++) {
        init_mesh(s, i, &own, a);
        if (!a->plan) d->mesh[i] = own;
    }
    for (size_t i = 0; i < s->instances && !a->plan; i++) {
        d->first[i] = d->parts;
        d->parts += d->mesh[s->instance[i].mesh].parts;
    }
    d->side = dar_identity_side(d->parts);
}

size_t dar_identity_side(size_t parts)
{
    size_t side = 1;
    while (side * side * side < parts) side++;
    return side;
}

size_t dar_identity_cell_of(size_t side, const double q[3])
{
    size_t cell = 0;
    for (int c = 2; c >= 0; c--) {
        double x = floor(q[c] * (double)side);
        cell = cell * side + (x > 0 ? x < (double)side ? (size_t)x : side - 1 : 0);
    }
    return cell;
}

void dar_identity_cell(const dar_identity *d, size_t instance, uint32_t part, double origin[3], double *scale)
{
    const double *box = d->mesh[d->scene->instance[instance].mesh].box[part];
    size_t cell = d->first[instance] + part, n = d->side;
    size_t at[3] = { cell % n, cell / n % n, cell / (n * n) };

    *scale = box[3] > 0 ? (1 - 2 * MARGIN) / (box[3] * (double)n) : 0;
    for (int c = 0; c < 3; c++) origin[c] = ((double)at[c] + MARGIN) / (double)n - *scale * box[c];
}
