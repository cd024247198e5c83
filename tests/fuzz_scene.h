/* fuzz_scene.h: what every scene promises that a loader accepted: indices in range, numbers finite, a pose at any time.
 */
#ifndef DAR_TESTS_FUZZ_SCENE_H
#define DAR_TESTS_FUZZ_SCENE_H

#include <math.h>
#include <string.h>

#include "data/pose.h"

#define FUZZ_VERTICES 100000 /* more would only cost time */

static inline void fuzz_check_line(const dar_err *e, const char *name)
{
    DAR_ASSERT(strncmp(e->text, name, strlen(name)) == 0, "does not name the file: %s", e->text);
    for (const char *p = e->text; *p; p++) DAR_ASSERT((unsigned char)*p >= 0x20, "not one line: %s", e->text);
}

static inline void fuzz_check_mesh(const dar_scene *s, const dar_mesh *m)
{
    size_t vertex = 0, triangle = 0;
    for (size_t i = 0; i < m->primitives; i++) {
        const dar_primitive *p = &m->primitive[i];
        DAR_ASSERT(p->vertex == vertex && p->triangle == triangle, "primitive %zu does not follow", i);
        DAR_ASSERT(p->material < (int)s->materials, "material %d", p->material);
        for (size_t k = 3 * triangle; k < 3 * (triangle + p->triangles); k++)
            DAR_ASSERT(m->index[k] >= vertex && m->index[k] < vertex + p->vertices, "corner %zu: %u", k, m->index[k]);
        vertex += p->vertices;
        triangle += p->triangles;
    }
    DAR_ASSERT(vertex == m->vertices && triangle == m->triangles, "%zu vertices, %zu triangles", vertex, triangle);
    for (size_t v = 0; v < m->vertices && m->influences; v++) {
        double sum = 0;
        for (size_t k = v * m->influences; k < (v + 1) * m->influences; k++) {
            DAR_ASSERT(m->joint[k] < m->joints && m->weight[k] >= 0, "joint %u of %zu", m->joint[k], m->joints);
            sum += m->weight[k];
        }
        DAR_ASSERT(fabs(sum - 1) < 1e-4, "weights sum to %g", sum);
    }
}

static inline void fuzz_check_pose(const dar_scene *s, int animation, double t)
{
    dar_arena a;
    dar_pose p;
    dar_err e;
    if (dar_arena_init(&a, "fuzz", (size_t)1 << 28, &e) != DAR_OK) return;
    dar_pose_init(&p, s, &a);
    float *x = dar_arena_push(&a, s->vertices * 12), *n = dar_arena_push(&a, s->vertices * 12);
    if (dar_pose_at(&p, animation, t, &e) == DAR_OK) {
        dar_pose_vertices(&p, x, n, false);
        for (size_t i = 0; i < 3 * s->vertices; i++) DAR_ASSERT(isfinite(x[i]), "vertex %zu: %g", i / 3, (double)x[i]);
        for (size_t v = 0; v < s->vertices; v++) {
            const float *u = n + 3 * v;
            double length = (double)u[0] * u[0] + (double)u[1] * u[1] + (double)u[2] * u[2];
            DAR_ASSERT(length == 0 || fabs(length - 1) < 1e-6, "normal %zu: length %g", v, length);
        }
    }
    dar_arena_free(&a);
}

static inline void fuzz_check_scene(const dar_scene *s)
{
    size_t vertices = 0;
    for (size_t i = 0; i < s->meshes; i++) fuzz_check_mesh(s, &s->mesh[i]);
    for (size_t i = 0; i < s->instances; i++) {
        DAR_ASSERT(s->instance[i].vertex == vertices, "instance %zu begins at %zu", i, s->instance[i].vertex);
        vertices += s->mesh[s->instance[i].mesh].vertices;
    }
    DAR_ASSERT(vertices == s->vertices, "%zu vertices of %zu", vertices, s->vertices);
    if (s->vertices > FUZZ_VERTICES || s->nodes > FUZZ_VERTICES) return;
    fuzz_check_pose(s, DAR_NONE, 0);
    for (size_t i = 0; i < s->animations && i < 4; i++) {
        const dar_animation *a = &s->animation[i];
        fuzz_check_pose(s, (int)i, a->begin);
        fuzz_check_pose(s, (int)i, a->begin + 0.4 * (a->end - a->begin));
    }
}

#endif
