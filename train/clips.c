/* clips.c: see clips.h. */
#include "train/clips.h"

#include <dirent.h>
#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static bool is_bundle(const char *path)
{
    char meta[PATH_MAX];
    return snprintf(meta, sizeof meta, "%s/meta.json", path) < (int)sizeof meta && access(meta, F_OK) == 0;
}

static dar_status add(dar_clips *c, const char *path, dar_err *e)
{
    if (c->n == c->room) {
        size_t room = c->room ? 2 * c->room : 64;
        char **at = realloc(c->path, room * sizeof *at);
        if (!at) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
        c->path = at;
        c->room = room;
    }
    if (!(c->path[c->n] = strdup(path))) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    c->n++;
    return DAR_OK;
}

static int by_name(const void *a, const void *b)
{
    return strcmp(*(char *const *)a, *(char *const *)b);
}

static dar_status add_directory(dar_clips *c, const char *path, dar_err *e)
{
    char inside[PATH_MAX];
    size_t first = c->n;
    dar_status s = DAR_OK;
    DIR *d = opendir(path);
    if (!d) return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
    for (const struct dirent *x; s == DAR_OK && (x = readdir(d));) {
        if (*x->d_name == '.' || snprintf(inside, sizeof inside, "%s/%s", path, x->d_name) >= (int)sizeof inside)
            continue;
        if (is_bundle(inside)) s = add(c, inside, e);
    }
    closedir(d);
    if (s != DAR_OK) return s;
    if (c->n == first) return dar_fail(e, DAR_ERR_USAGE, "%s: found no bundle, expected one, or some in it", path);
    qsort(c->path + first, c->n - first, sizeof *c->path, by_name);
    return DAR_OK;
}

dar_status dar_clips_find(dar_clips *c, dar_json list, dar_err *e)
{
    dar_status s = DAR_OK;
    *c = (dar_clips){ 0 };
    for (dar_json x = dar_json_first(list); x.item && s == DAR_OK; x = dar_json_next(x)) {
        const char *path = dar_json_text(x, NULL, NULL);
        s = is_bundle(path) ? add(c, path, e) : add_directory(c, path, e);
    }
    if (s != DAR_OK) dar_clips_free(c);
    return s;
}

void dar_clips_free(dar_clips *c)
{
    for (size_t i = 0; i < c->n; i++) free(c->path[i]);
    free(c->path);
    *c = (dar_clips){ 0 };
}
