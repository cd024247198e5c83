/* pose.c: keys, node transforms, and the two loops over vertices. */
#include "data/pose.h"

#include <math.h>
#include <string.h>

#include "data/affine.h"
#include "lib/thread.h"

#define PIECE   3072 /* vertices of a task; a multiple of 3, so that the triangles of flat primitives stay whole */
#define LARGEST 1e12

typedef struct dar_pose_piece {
    uint32_t instance, primitive;
    size_t begin, end; /* vertices of the mesh */
} piece;

/* ---------------------------------------------------------------- keys */

/* The last key at or before t, which is not before the first nor behind the last. */
static size_t key_before(const dar_channel *c, double t)
{
    size_t lo = 0, hi = c->keys;
    while (hi - lo > 1) {
        size_t mid = lo + (hi - lo) / 2;
        if (c->time[mid] <= t) lo = mid;
        else hi = mid;
    }
    return lo;
}

static void rotation_of(const float *v, double q[4])
{
    for (int i = 0; i < 4; i++) q[i] = v[i];
    dar_quat_unit(q);
}

/* Between key k and the next, u of the way. */
static void interpolate(const dar_channel *c, size_t k, double u, double *value)
{
    size_t w = c->width;

    if (c->interpolation == DAR_CUBIC) {
        const float *p = c->value + 3 * w * k + w, *out = p + w, *in = out + w, *q = in + w;
        double dt = c->time[k + 1] - c->time[k], u2 = u * u, u3 = u2 * u;
        for (size_t i = 0; i < w; i++)
            value[i] = (2 * u3 - 3 * u2 + 1) * p[i] + dt * (u3 - 2 * u2 + u) * out[i] + (3 * u2 - 2 * u3) * q[i] +
                       dt * (u3 - u2) * in[i];
    } else if (c->path == DAR_ROTATION) {
        double a[4], b[4];
        rotation_of(c->value + 4 * k, a);
        rotation_of(c->value + 4 * k + 4, b);
        dar_quat_slerp(a, b, u, value);
    } else {
        const float *p = c->value + w * k;
        for (size_t i = 0; i < w; i++) value[i] = (1 - u) * p[i] + u * p[w + i];
    }
}

void dar_channel_sample(const dar_channel *c, double t, double *value)
{
    size_t k = key_before(c, t), last = c->keys - 1;
    double inside = k < last ? t - c->time[k] : 0;

    if (inside > 0 && c->interpolation != DAR_STEP) {
        interpolate(c, k, inside / (c->time[k + 1] - c->time[k]), value);
    } else {
        const float *v = c->value + (c->interpolation == DAR_CUBIC ? c->width * (3 * k + 1) : c->width * k);
        for (size_t i = 0; i < c->width; i++) value[i] = v[i];
    }
    /* A spline may pass through 0, where there is no rotation. */
    if (c->path == DAR_ROTATION && !dar_quat_unit(value)) rotation_of(c->value + c->width * (3 * k + 1), value);
}

/* ---------------------------------------------------------------- nodes */

static void animate(dar_pose *p, const dar_animation *a, double t)
{
    for (size_t i = 0; i < a->channels; i++) {
        static const size_t at[] = { [DAR_TRANSLATION] = 0, [DAR_ROTATION] = 3, [DAR_SCALE] = 7 };
        const dar_channel *c = &a->channel[i];
        double *value =
            c->path == DAR_WEIGHTS ? p->weight + p->scene->node[c->node].first_weight : p->trs[c->node] + at[c->path];
        dar_channel_sample(c, t, value);
    }
}

static void set_nodes(dar_pose *p, int animation, double t)
{
    const dar_scene *s = p->scene;
    double(*trs)[10] = p->trs;

    for (size_t i = 0; i < s->nodes; i++) {
        const dar_node *n = &s->node[i];
        memcpy(trs[i], n->translation, sizeof n->translation);
        memcpy(trs[i] + 3, n->rotation, sizeof n->rotation);
        memcpy(trs[i] + 7, n->scale, sizeof n->scale);
        if (n->weight) memcpy(p->weight + n->first_weight, n->weight, s->mesh[n->mesh].targets * sizeof *n->weight);
    }
    if (animation != DAR_NONE) animate(p, &s->animation[animation], t);
    for (size_t i = 0; i < s->nodes; i++) {
        int at = s->order[i];
        const dar_node *n = &s->node[at];
        double *m = p->world[at];
        if (n->has_matrix) memcpy(m, n->matrix, sizeof n->matrix);
        else dar_affine_trs(trs[at], trs[at] + 3, trs[at] + 7, m);
        if (n->parent != DAR_NONE) dar_affine_mul(p->world[n->parent], m, m);
    }
}

/* Targets that play a part: of a sequence of meshes only two do. */
static void set_active(dar_pose *p)
{
    const dar_scene *s = p->scene;
    for (size_t i = 0; i < s->nodes; i++) {
        const dar_node *n = &s->node[i];
        size_t targets = n->weight ? s->mesh[n->mesh].targets : 0, count = 0;
        for (size_t k = 0; k < targets; k++)
            if (p->weight[n->first_weight + k] != 0) p->active[n->first_weight + count++] = (uint32_t)k;
        p->actives[i] = count;
    }
}

static bool fits(const double *x, size_t n)
{
    for (size_t i = 0; i < n; i++)
        if (!(fabs(x[i]) <= LARGEST)) return false;
    return true;
}

static dar_status check_nodes(const dar_pose *p, int animation, double t, dar_err *e)
{
    const dar_scene *s = p->scene;
    const char *name = animation == DAR_NONE ? "rest" : s->animation[animation].name;

    for (size_t i = 0; i < s->nodes; i++)
        if (!fits(p->world[i], 12))
            return dar_fail(e, DAR_ERR_NUMERIC, "%s: animation '%s' at %g s: the transform of nodes[%zu] is not finite",
                            s->path, name, t, i);
    if (!fits(p->weight, s->weights))
        return dar_fail(e, DAR_ERR_NUMERIC, "%s: animation '%s' at %g s: a morph weight is not finite", s->path, name,
                        t);
    return DAR_OK;
}

/* ---------------------------------------------------------------- instances */

static void set_skins(dar_pose *p)
{
    const dar_scene *s = p->scene;
    for (size_t i = 0; i < s->skins; i++) {
        const dar_skin *skin = &s->skin[i];
        p->skin_changed[i] = false;
        for (size_t k = 0; k < skin->joints; k++) {
            if (!p->node_changed[skin->joint[k]]) continue;
            dar_affine_mul(p->world[skin->joint[k]], skin->inverse[k], p->joint[i][k]);
            p->skin_changed[i] = true;
        }
    }
}

/* A skin mirrors if most of its joints do. */
static bool skin_mirrors(const dar_pose *p, int skin)
{
    size_t n = p->scene->skin[skin].joints, against = 0;
    for (size_t k = 0; k < n; k++) against += dar_affine_det(p->joint[skin][k]) < 0;
    return 2 * against > n;
}

static void set_instances(dar_pose *p)
{
    const dar_scene *s = p->scene;
    for (size_t i = 0; i < s->instances; i++) {
        const dar_instance *in = &s->instance[i];
        const dar_node *n = &s->node[in->node];
        size_t weights = s->mesh[in->mesh].targets * sizeof(double);
        bool moved = in->skin == DAR_NONE ? p->node_changed[in->node] : p->skin_changed[in->skin];
        bool morphed = weights && memcmp(p->weight + n->first_weight, p->last_weight + n->first_weight, weights) != 0;

        p->changed[i] = p->fresh || moved || morphed;
        if (!moved) continue;
        if (in->skin != DAR_NONE) {
            p->mirrored[i] = skin_mirrors(p, in->skin);
            continue;
        }
        memcpy(p->place[i], p->world[in->node], sizeof p->place[i]);
        if (in->has_local) dar_affine_mul(p->place[i], in->local, p->place[i]);
        p->mirrored[i] = dar_affine_det(p->place[i]) < 0;
    }
}

dar_status dar_pose_at(dar_pose *p, int animation, double t, dar_err *e)
{
    const dar_scene *s = p->scene;
    DAR_ASSERT(animation == DAR_NONE || (animation >= 0 && (size_t)animation < s->animations),
               "pose: animation %d of %zu", animation, s->animations);
    DAR_ASSERT(isfinite(t), "pose: time %g", t);

    memcpy(p->last_world, p->world, s->nodes * sizeof *p->world);
    memcpy(p->last_weight, p->weight, s->weights * sizeof *p->weight);
    set_nodes(p, animation, t);
    dar_status status = check_nodes(p, animation, t, e);
    if (status != DAR_OK) {
        p->fresh = true; /* nothing to compare the next one with */
        return status;
    }
    for (size_t i = 0; i < s->nodes; i++)
        p->node_changed[i] = p->fresh || memcmp(p->world[i], p->last_world[i], sizeof *p->world) != 0;
    set_active(p);
    set_skins(p);
    set_instances(p);
    p->fresh = false;
    return DAR_OK;
}

/* ---------------------------------------------------------------- vertices */

/* What one piece works on. */
struct job {
    const dar_pose *pose;
    float *position, *normal;
    bool changed_only;
};

/* The morph of one mesh: which targets, how much of each. */
struct morph {
    const double *weight;
    const uint32_t *active;
    size_t actives;
};

/* base and targets at vertex v. */
static void morph(const dar_mesh *m, const struct morph *w, const float *base, const float *target, size_t v,
                  double x[3])
{
    for (int c = 0; c < 3; c++) x[c] = base[3 * v + c];
    for (size_t i = 0; target && i < w->actives; i++) {
        size_t k = w->active[i];
        const float *d = target + 3 * (k * m->vertices + v);
        for (int c = 0; c < 3; c++) x[c] += w->weight[k] * d[c];
    }
}

static void blend(const dar_mesh *m, double (*joint)[12], size_t v, double y[12])
{
    const float *w = m->weight + v * m->influences;
    const uint16_t *index = m->joint + v * m->influences;
    for (int c = 0; c < 12; c++) y[c] = 0;
    for (size_t k = 0; k < m->influences; k++) {
        const double *x = joint[index[k]], wk = w[k];
        if (wk == 0) continue;
        for (int c = 0; c < 12; c++) y[c] += wk * x[c];
    }
}

/* n / |n|; zero stays zero. */
static void store_unit(double x, double y, double z, float *out)
{
    double most = fmax(fabs(x), fmax(fabs(y), fabs(z)));
    if (most > 0) x /= most, y /= most, z /= most; /* squares of 1e-200 would vanish */
    double r = most > 0 ? sqrt(x * x + y * y + z * z) : 1;
    out[0] = (float)(x / r);
    out[1] = (float)(y / r);
    out[2] = (float)(z / r);
}

static void pose_vertices(const struct job *job, const piece *pc)
{
    const dar_pose *p = job->pose;
    const dar_instance *in = &p->scene->instance[pc->instance];
    const dar_mesh *m = &p->scene->mesh[in->mesh];
    size_t first = p->scene->node[in->node].first_weight;
    struct morph w = { p->weight + first, p->active + first, p->actives[in->node] };
    bool want = job->normal && !m->primitive[pc->primitive].flat, skinned = in->skin != DAR_NONE;
    double own[12], n[9] = { 0 };
    const double *a = skinned ? own : p->place[pc->instance];

    if (want && !skinned) dar_affine_normals(a, n);
    for (size_t v = pc->begin; v < pc->end; v++) {
        float *y = job->position + 3 * (in->vertex + v);
        double x[3];
        if (skinned) blend(m, p->joint[in->skin], v, own);
        morph(m, &w, m->position, m->target_position, v, x);
        for (int r = 0; r < 3; r++)
            y[r] = (float)(a[4 * r] * x[0] + a[4 * r + 1] * x[1] + a[4 * r + 2] * x[2] + a[4 * r + 3]);
        if (!want) continue;
        if (skinned) dar_affine_normals(a, n);
        morph(m, &w, m->normal, m->target_normal, v, x);
        store_unit(n[0] * x[0] + n[1] * x[1] + n[2] * x[2], n[3] * x[0] + n[4] * x[1] + n[5] * x[2],
                   n[6] * x[0] + n[7] * x[1] + n[8] * x[2], job->normal + 3 * (in->vertex + v));
    }
}

/* Normals of triangles from their posed corners. */
static void flat_normals(const struct job *job, const piece *pc)
{
    const dar_instance *in = &job->pose->scene->instance[pc->instance];
    double sign = job->pose->mirrored[pc->instance] ? -1 : 1;

    for (size_t v = pc->begin; v < pc->end; v += 3) {
        const float *a = job->position + 3 * (in->vertex + v), *b = a + 3, *c = a + 6;
        double u[3], w[3];
        float *n = job->normal + 3 * (in->vertex + v);
        for (int k = 0; k < 3; k++) {
            u[k] = sign * ((double)b[k] - a[k]);
            w[k] = (double)c[k] - a[k];
        }
        store_unit(u[1] * w[2] - u[2] * w[1], u[2] * w[0] - u[0] * w[2], u[0] * w[1] - u[1] * w[0], n);
        memcpy(n + 3, n, 3 * sizeof *n);
        memcpy(n + 6, n, 3 * sizeof *n);
    }
}

static void run_piece(void *ctx, size_t i, int thread)
{
    const struct job *job = ctx;
    const piece *pc = &job->pose->piece[i];
    const dar_scene *s = job->pose->scene;
    (void)thread;

    if (job->changed_only && !job->pose->changed[pc->instance]) return;
    pose_vertices(job, pc);
    if (job->normal && s->mesh[s->instance[pc->instance].mesh].primitive[pc->primitive].flat) flat_normals(job, pc);
}

void dar_pose_vertices(const dar_pose *p, float *position, float *normal, bool changed_only)
{
    struct job job = { p, position, normal, changed_only };
    DAR_ASSERT(!p->fresh, "pose: vertices before a moment is set");
    dar_parallel(p->pieces, run_piece, &job);
}

/* ---------------------------------------------------------------- memory */

/* Cut every primitive of every instance; piece NULL: only count. */
static size_t cut(const dar_scene *s, piece *out)
{
    size_t n = 0;
    for (size_t i = 0; i < s->instances; i++) {
        const dar_mesh *m = &s->mesh[s->instance[i].mesh];
        for (size_t k = 0; k < m->primitives; k++) {
            const dar_primitive *q = &m->primitive[k];
            size_t end = q->vertex + q->vertices;
            for (size_t v = q->vertex; v < end; v += PIECE, n++)
                if (out) out[n] = (piece){ (uint32_t)i, (uint32_t)k, v, end - v < PIECE ? end : v + PIECE };
        }
    }
    return n;
}

void dar_pose_init(dar_pose *p, const dar_scene *s, dar_arena *a)
{
    *p = (dar_pose){ .scene = s, .fresh = true };
    p->world = dar_arena_push(a, s->nodes * sizeof *p->world);
    p->last_world = dar_arena_push(a, s->nodes * sizeof *p->world);
    p->trs = dar_arena_push(a, s->nodes * sizeof *p->trs);
    p->weight = dar_arena_push(a, s->weights * sizeof *p->weight);
    p->last_weight = dar_arena_push(a, s->weights * sizeof *p->weight);
    p->active = dar_arena_push(a, s->weights * sizeof *p->active);
    p->actives = dar_arena_push(a, s->nodes * sizeof *p->actives);
    p->node_changed = dar_arena_push(a, s->nodes);
    p->skin_changed = dar_arena_push(a, s->skins);
    p->place = dar_arena_push(a, s->instances * sizeof *p->place);
    p->changed = dar_arena_push(a, s->instances);
    p->mirrored = dar_arena_push(a, s->instances);
    p->joint = dar_arena_push(a, s->skins * sizeof *p->joint);
    for (size_t i = 0; i < s->skins; i++) {
        double(*joint)[12] = dar_arena_push(a, s->skin[i].joints * sizeof *joint);
        if (!a->plan) p->joint[i] = joint;
    }
    p->pieces = cut(s, NULL);
    p->piece = dar_arena_push(a, p->pieces * sizeof *p->piece);
    if (a->plan) return;
    cut(s, p->piece);
    memset(p->world, 0, s->nodes * sizeof *p->world);
    memset(p->weight, 0, s->weights * sizeof *p->weight);
}
