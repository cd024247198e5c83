/* clip.c: moments, bounds and the scene's own cameras. */
#include "data/clip.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "data/camera_io.h"
#include "data/gltf.h"
#include "data/objseq.h"
#include "data/pose.h"

const char *const dar_play_name[] = { "loop", "once", "stretch", NULL };

dar_status dar_clip_load(dar_scene *s, const char *what, double fps, dar_err *e)
{
    size_t n = strlen(what);
    struct stat st;
    bool many = strpbrk(what, "*?%") || (stat(what, &st) == 0 && S_ISDIR(st.st_mode));
    if (many || (n > 4 && strcmp(what + n - 4, ".obj") == 0)) return dar_objseq_load(s, what, fps, e);
    return dar_gltf_load(s, what, true, e);
}

double dar_clip_time(const dar_clip *c, size_t frame)
{
    if (c->animation == DAR_NONE) return 0;
    const dar_animation *a = &c->scene->animation[c->animation];
    double length = a->end - a->begin, t = (double)frame / c->fps;
    if (c->play == DAR_PLAY_STRETCH) t = c->frames > 1 ? length * (double)frame / (double)(c->frames - 1) : 0;
    else if (c->play == DAR_PLAY_LOOP) t = length > 0 ? fmod(t, length) : 0;
    return fmin(a->begin + t, a->end);
}

/* Poses of a clip, one after the other, in memory of their own. */
struct poses {
    dar_arena arena;
    dar_pose pose;
    float *position;
    dar_box *instance; /* [instances] bounds as they were posed last */
};

static void poses_layout(struct poses *p, const dar_scene *s)
{
    dar_pose_init(&p->pose, s, &p->arena);
    p->position = dar_arena_push(&p->arena, dar_mul_size(s->vertices, 3 * sizeof *p->position));
    p->instance = dar_arena_push(&p->arena, dar_mul_size(s->instances, sizeof *p->instance));
}

static dar_status poses_init(struct poses *p, const dar_scene *s, dar_err *e)
{
    DAR_TRY(dar_arena_init_plan(&p->arena, "poses", e));
    poses_layout(p, s);
    size_t bytes = p->arena.peak;
    dar_arena_free(&p->arena);
    DAR_TRY(dar_arena_init(&p->arena, "poses", bytes, e));
    poses_layout(p, s);
    return DAR_OK;
}

/* ---------------------------------------------------------------- bounds */

static const dar_box nowhere = { { INFINITY, INFINITY, INFINITY }, { -INFINITY, -INFINITY, -INFINITY } };

static void grow(dar_box *b, const double lo[3], const double hi[3])
{
    for (int k = 0; k < 3; k++) {
        b->lo[k] = fmin(b->lo[k], lo[k]);
        b->hi[k] = fmax(b->hi[k], hi[k]);
    }
}

static dar_box bounds(const float *x, size_t n)
{
    dar_box b = nowhere;
    for (size_t i = 0; i < n; i++) {
        double at[3] = { x[3 * i], x[3 * i + 1], x[3 * i + 2] };
        grow(&b, at, at);
    }
    return b;
}

/* Pose every frame: box [frames, instances] and all [frames]; NULL: not wanted. */
static dar_status survey(const dar_clip *c, dar_box *box, dar_box *all, dar_err *e)
{
    const dar_scene *s = c->scene;
    struct poses p = { 0 };
    if (!s->vertices) return dar_fail(e, DAR_ERR_FORMAT, "%s: found no triangles in the scene", s->path);
    dar_status status = poses_init(&p, s, e);
    for (size_t t = 0; status == DAR_OK && t < c->frames; t++) {
        status = dar_pose_at(&p.pose, c->animation, dar_clip_time(c, t), e);
        if (status != DAR_OK) break;
        dar_pose_vertices(&p.pose, p.position, NULL, true);
        if (all) all[t] = nowhere;
        for (size_t i = 0; i < s->instances; i++) {
            const dar_instance *in = &s->instance[i];
            if (p.pose.changed[i]) p.instance[i] = bounds(p.position + 3 * in->vertex, s->mesh[in->mesh].vertices);
            if (all) grow(&all[t], p.instance[i].lo, p.instance[i].hi);
            if (box) box[t * s->instances + i] = p.instance[i];
        }
    }
    dar_arena_free(&p.arena);
    return status == DAR_ERR_NUMERIC ? DAR_ERR_FORMAT : status; /* a file that cannot be posed is bad input */
}

dar_status dar_clip_boxes(const dar_clip *c, dar_box *box, dar_err *e)
{
    return survey(c, box, NULL, e);
}

dar_status dar_clip_survey(const dar_clip *c, dar_box *box, dar_world *world, dar_err *e)
{
    dar_box all = nowhere;
    dar_world_init(world);
    DAR_TRY(survey(c, NULL, box, e));
    for (size_t t = 0; t < c->frames; t++) grow(&all, box[t].lo, box[t].hi);
    memcpy(world->lo, all.lo, sizeof all.lo);
    memcpy(world->hi, all.hi, sizeof all.hi);
    dar_world_finish(world);
    return DAR_OK;
}

/* ---------------------------------------------------------------- cameras */

/* A node of the shown scene that carries the camera `name`. */
static dar_status find_camera(const dar_scene *s, const char *name, size_t *node, dar_err *e)
{
    char known[256] = "", *end = NULL;
    size_t at = 0, seen = 0, numbered = SIZE_MAX;
    unsigned long number = name ? strtoul(name, &end, 10) : 0;
    bool by_number = !name || (*name >= '0' && *name <= '9' && !*end);
    for (*node = 0; *node < s->nodes; ++*node) {
        const dar_node *n = &s->node[*node];
        if (n->camera == DAR_NONE || !n->in_scene) continue;
        if (name && (strcmp(n->name, name) == 0 || strcmp(s->camera[n->camera].name, name) == 0)) return DAR_OK;
        if (by_number && seen == number) numbered = *node;
        if (at < sizeof known) at += (size_t)snprintf(known + at, sizeof known - at, "%s%s", seen ? ", " : "", n->name);
        seen++;
    }
    *node = numbered;
    if (numbered != SIZE_MAX) return DAR_OK;
    if (!seen) return dar_fail(e, DAR_ERR_USAGE, "%s: the scene has no camera", s->path);
    return dar_fail(e, DAR_ERR_USAGE, "%s: found no camera '%s'; there are %zu: %s", s->path, name ? name : "0", seen,
                    known);
}

dar_status dar_clip_camera(const dar_clip *c, const char *name, int width, int height, dar_camera_path *p, dar_err *e)
{
    struct poses q = { 0 };
    size_t node;
    *p = (dar_camera_path){ 0 };
    DAR_TRY(find_camera(c->scene, name, &node, e));
    double(*world)[12] = calloc(c->frames, sizeof *world);
    dar_status s =
        world ? poses_init(&q, c->scene, e) : dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", c->scene->path);
    for (size_t t = 0; s == DAR_OK && t < c->frames; t++) {
        s = dar_pose_at(&q.pose, c->animation, dar_clip_time(c, t), e);
        if (s == DAR_OK) memcpy(world[t], q.pose.world[node], sizeof *world);
    }
    if (s == DAR_OK)
        s = dar_camera_io_from_lens(p, &c->scene->camera[c->scene->node[node].camera], (const double(*)[12])world,
                                    c->frames, width, height, e);
    dar_arena_free(&q.arena);
    free(world);
    return s == DAR_ERR_NUMERIC ? DAR_ERR_FORMAT : s;
}
