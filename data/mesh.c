/* mesh.c: what scenes from all files share. */
#include "data/mesh.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

void dar_scene_free(dar_scene *s)
{
    dar_arena_free(&s->memory);
    memset(s, 0, sizeof *s);
}

/* "'Walk', 'Run'", as many as there is room for. */
static const char *names_of(const dar_scene *s, char *buf, size_t size)
{
    size_t at = 0;
    snprintf(buf, size, "none");
    for (size_t i = 0; i < s->animations && at < size; i++)
        at += (size_t)snprintf(buf + at, size - at, "%s'%s'", i ? ", " : "", s->animation[i].name);
    return buf;
}

dar_status dar_scene_find_animation(const dar_scene *s, const char *name, int *index, dar_err *e)
{
    char names[320], *end;

    *index = DAR_NONE;
    if (!name || !*name) {
        if (s->animations) *index = 0;
        return DAR_OK;
    }
    for (size_t i = 0; i < s->animations; i++)
        if (strcmp(s->animation[i].name, name) == 0) {
            *index = (int)i;
            return DAR_OK;
        }
    if (strcmp(name, "rest") == 0) return DAR_OK;
    unsigned long i = strtoul(name, &end, 10);
    if (*name >= '0' && *name <= '9' && !*end && i < s->animations) {
        *index = (int)i;
        return DAR_OK;
    }
    return dar_fail(e, DAR_ERR_USAGE, "%s: no animation '%s'; there are %zu: %s", s->path, name, s->animations,
                    names_of(s, names, sizeof names));
}

/* A walk up from each node ends at one that has its place; the walk's nodes follow, uppermost first.  A walk longer
 * than there are nodes runs in a circle. */
int dar_scene_order(dar_scene *s)
{
    size_t placed = 0;
    for (size_t i = 0; i < s->nodes; i++) s->node[i].depth = -1;
    for (size_t i = 0; i < s->nodes; i++) {
        size_t steps = 0;
        int n = (int)i;
        for (; n != DAR_NONE && s->node[n].depth < 0; n = s->node[n].parent)
            if (++steps > s->nodes) return n;
        int depth = (n == DAR_NONE ? 0 : s->node[n].depth + 1) + (int)steps;
        n = (int)i;
        for (size_t k = steps; k-- > 0; n = s->node[n].parent) {
            s->node[n].depth = --depth;
            s->order[placed + k] = n;
        }
        placed += steps;
    }
    return DAR_NONE;
}
