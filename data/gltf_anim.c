/* gltf_anim.c: skins and animations. */
#include "data/gltf_file.h"

#include <math.h>
#include <string.h>

/* ---------------------------------------------------------------- skins */

/* Column-major [4, 4] as in files; false if it is not affine. */
static bool affine_of(const float *x, double m[12])
{
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 4; c++) m[4 * r + c] = x[4 * c + r];
    return fabs(x[3]) < 1e-4 && fabs(x[7]) < 1e-4 && fabs(x[11]) < 1e-4 && fabs(x[15] - 1) < 1e-4;
}

static dar_status read_inverse(dar_gltf *g, dar_json j, dar_skin *s)
{
    dar_mark mark = dar_arena_mark(&g->scratch);
    dar_gltf_accessor a;
    float *x;

    DAR_TRY(dar_gltf_accessor_at(g, j, "inverseBindMatrices", DAR_GLTF_FLOATS, 16, 16, &a));
    if (a.count < s->joints) return DAR_GLTF_REJECT(g, a.json, "count", "at least %zu, one for each joint", s->joints);
    DAR_TRY(dar_gltf_scratch(g, &x, s->joints, 16 * sizeof *x));
    DAR_TRY(dar_gltf_gather(g, &a, NULL, s->joints, x));
    for (size_t i = 0; i < s->joints; i++)
        if (!affine_of(x + 16 * i, s->inverse[i]))
            return DAR_GLTF_REJECT(g, a.json, NULL, "matrices with last row 0 0 0 1: the one at %zu has another", i);
    dar_arena_reset(&g->scratch, mark);
    return DAR_OK;
}

static dar_status read_skin(dar_gltf *g, dar_json j, dar_skin *s)
{
    dar_json list = dar_json_array(j, "joints");
    size_t i = 0;

    DAR_TRY(dar_gltf_name(g, j, &s->name));
    s->joints = dar_json_size(list);
    if (!s->joints) return DAR_GLTF_REJECT(g, j, "joints", "at least one node");
    DAR_TRY(dar_gltf_take(g, &s->joint, s->joints, sizeof *s->joint));
    DAR_TRY(dar_gltf_take(g, &s->inverse, s->joints, sizeof *s->inverse));
    for (dar_json x = dar_json_first(list); x.item; x = dar_json_next(x), i++) {
        s->joint[i] = dar_gltf_index(g, x, NULL, DAR_GLTF_NODES);
        DAR_TRY(dar_gltf_check(g));
        if (s->joint[i] == DAR_NONE) return DAR_GLTF_REJECT(g, x, NULL, "the index of a node");
        s->inverse[i][0] = s->inverse[i][5] = s->inverse[i][10] = 1;
    }
    return dar_json_get(j, "inverseBindMatrices").item ? read_inverse(g, j, s) : dar_gltf_check(g);
}

dar_status dar_gltf_skins(dar_gltf *g)
{
    dar_scene *s = g->scene;

    s->skins = g->length[DAR_GLTF_SKINS];
    DAR_TRY(dar_gltf_take(g, &s->skin, s->skins, sizeof *s->skin));
    for (size_t i = 0; i < s->skins; i++) DAR_TRY(read_skin(g, g->list[DAR_GLTF_SKINS][i], &s->skin[i]));
    return DAR_OK;
}

/* ---------------------------------------------------------------- animations */

static dar_status read_times(dar_gltf *g, dar_json sampler, dar_channel *c)
{
    dar_mark mark = dar_arena_mark(&g->scratch);
    dar_gltf_accessor a;
    double *time;
    float *x;

    DAR_TRY(dar_gltf_accessor_at(g, sampler, "input", DAR_GLTF_FLOATS, 1, 1, &a));
    c->keys = a.count;
    DAR_TRY(dar_gltf_take(g, &time, c->keys, sizeof *time));
    DAR_TRY(dar_gltf_scratch(g, &x, c->keys, sizeof *x));
    DAR_TRY(dar_gltf_gather(g, &a, NULL, c->keys, x));
    for (size_t i = 0; i < c->keys; i++) {
        time[i] = x[i];
        if (i && time[i] < time[i - 1])
            return DAR_GLTF_REJECT(g, a.json, NULL, "rising times: the one at %zu is %g after %g", i, time[i],
                                   time[i - 1]);
    }
    c->time = time;
    dar_arena_reset(&g->scratch, mark);
    return DAR_OK;
}

static dar_status read_values(dar_gltf *g, dar_json sampler, dar_channel *c)
{
    bool weights = c->path == DAR_WEIGHTS;
    size_t width = weights ? 1 : c->width, triple = c->interpolation == DAR_CUBIC ? 3 : 1, elements;
    unsigned types = DAR_GLTF_FLOATS | (c->path == DAR_ROTATION || weights ? DAR_GLTF_NORMALIZED : 0);
    dar_gltf_accessor a;
    float *value;

    DAR_TRY(dar_gltf_accessor_at(g, sampler, "output", types, width, width, &a));
    if (__builtin_mul_overflow(c->keys * triple, weights ? c->width : 1, &elements) || a.count != elements)
        return DAR_GLTF_REJECT(g, a.json, "count", "%zu times %zu values for %zu keys", triple, weights ? c->width : 1,
                               c->keys);
    DAR_TRY(dar_gltf_take(g, &value, a.count, width * sizeof *value));
    DAR_TRY(dar_gltf_gather(g, &a, NULL, a.count, value));
    for (size_t k = 0; c->path == DAR_ROTATION && k < c->keys; k++) {
        const float *q = value + 4 * (triple * k + triple / 2);
        if (q[0] == 0 && q[1] == 0 && q[2] == 0 && q[3] == 0)
            return DAR_GLTF_REJECT(g, a.json, NULL, "quaternions that are not 0: the one of key %zu is", k);
    }
    c->value = value;
    return DAR_OK;
}

/* *used: whether the channel moves something that is known. */
static dar_status read_channel(dar_gltf *g, dar_json j, const dar_json *samplers, size_t n_samplers, dar_channel *c,
                               bool *used)
{
    static const char *const modes[] = { "STEP", "LINEAR", "CUBICSPLINE", NULL };
    static const char *const paths[] = { "translation", "rotation", "scale", "weights" };
    dar_json target = dar_json_object(j, "target");
    const char *path = dar_json_text(target, "path", NULL);
    size_t which = dar_gltf_size(j, "sampler", 0, SIZE_MAX), known = 0;
    int node = dar_gltf_index(g, target, "node", DAR_GLTF_NODES);

    DAR_TRY(dar_gltf_check(g));
    while (known < DAR_COUNT(paths) && strcmp(path, paths[known]) != 0) known++;
    *used = node != DAR_NONE && known < DAR_COUNT(paths);
    if (!*used) {
        g->scene->notes.channels++;
        return DAR_OK;
    }
    if (which >= n_samplers) return DAR_GLTF_REJECT(g, j, "sampler", "one of %zu samplers", n_samplers);
    dar_json sampler = samplers[which];
    const dar_node *n = &g->scene->node[node];
    size_t targets = n->mesh == DAR_NONE ? 0 : g->scene->mesh[n->mesh].targets;

    *c = (dar_channel){ .node = node, .path = (dar_channel_path)known };
    c->interpolation = (dar_interpolation)dar_json_choice(sampler, "interpolation", DAR_LINEAR, modes);
    c->width = known == DAR_WEIGHTS ? targets : known == DAR_ROTATION ? 4 : 3;
    DAR_TRY(dar_gltf_check(g));
    if (!c->width) return DAR_GLTF_REJECT(g, target, "node", "a node whose mesh has morph targets");
    if (n->has_matrix && known != DAR_WEIGHTS)
        return DAR_GLTF_REJECT(g, target, "node", "a node without a matrix: matrices cannot be animated");
    if (known == DAR_SCALE) g->scaled[node] = true;
    DAR_TRY(read_times(g, sampler, c));
    return read_values(g, sampler, c);
}

static dar_status read_animation(dar_gltf *g, dar_json j, dar_animation *a)
{
    dar_json list = dar_json_array(j, "channels"), samplers = dar_json_array(j, "samplers"), *sampler = NULL;
    size_t n = dar_json_size(samplers), k = 0;
    dar_mark mark = dar_arena_mark(&g->scratch);
    unsigned char *seen;

    DAR_TRY(dar_gltf_name(g, j, &a->name));
    DAR_TRY(dar_gltf_take(g, &a->channel, dar_json_size(list), sizeof *a->channel));
    DAR_TRY(dar_gltf_scratch(g, &seen, g->length[DAR_GLTF_NODES], 1));
    DAR_TRY(dar_gltf_scratch(g, &sampler, n, sizeof *sampler));
    for (dar_json x = dar_json_first(samplers); x.item; x = dar_json_next(x)) sampler[k++] = x;
    for (dar_json x = dar_json_first(list); x.item; x = dar_json_next(x)) {
        dar_channel *c = &a->channel[a->channels];
        bool used;
        DAR_TRY(read_channel(g, x, sampler, n, c, &used));
        if (!used) continue;
        if (seen[c->node] >> c->path & 1)
            return DAR_GLTF_REJECT(g, x, "target", "a property that no other channel drives");
        seen[c->node] |= (unsigned char)(1u << c->path);
        if (!a->channels || c->time[0] < a->begin) a->begin = c->time[0];
        if (!a->channels || c->time[c->keys - 1] > a->end) a->end = c->time[c->keys - 1];
        a->channels++;
    }
    dar_arena_reset(&g->scratch, mark);
    return dar_gltf_check(g);
}

dar_status dar_gltf_animations(dar_gltf *g)
{
    dar_scene *s = g->scene;

    s->animations = g->length[DAR_GLTF_ANIMATIONS];
    DAR_TRY(dar_gltf_take(g, &s->animation, s->animations, sizeof *s->animation));
    for (size_t i = 0; i < s->animations; i++)
        DAR_TRY(read_animation(g, g->list[DAR_GLTF_ANIMATIONS][i], &s->animation[i]));
    return DAR_OK;
}
