/* checkpoint.c: see checkpoint.h.  The files of one are in checkpoint_file.c. */
#include "train/checkpoint.h"

#include <dirent.h>
#include <errno.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "lib/dir.h"
#include "lib/file.h"
#include "lib/log.h"
#include "train/checkpoint_inside.h"

static const char stem[] = "checkpoint-";

/* ---------------------------------------------------------------- what the run has */

void dar_checkpoint_path(const dar_checkpoint *c, int64_t step, char path[PATH_MAX])
{
    if (snprintf(path, PATH_MAX, "%s/%s%" PRId64, c->run, stem, step) >= PATH_MAX) *path = 0;
}

/* The step of a name, written as we write it; -1: it is none. */
static int64_t step_of(const char *name)
{
    char again[64];
    if (strncmp(name, stem, strlen(stem)) != 0) return -1;
    int64_t step = strtoll(name + strlen(stem), NULL, 10);
    snprintf(again, sizeof again, "%s%" PRId64, stem, step);
    return step >= 0 && strcmp(again, name) == 0 ? step : -1;
}

static int newest_first(const void *a, const void *b)
{
    const int64_t *x = a, *y = b;
    return (*x < *y) - (*x > *y);
}

/* The steps of the run's checkpoints, the newest first, for the caller to free. */
static dar_status list(const dar_checkpoint *c, int64_t **steps, size_t *n, dar_err *e)
{
    size_t room = 0;
    DIR *d = opendir(c->run);
    *steps = NULL;
    *n = 0;
    if (!d) return dar_fail(e, DAR_ERR_IO, "%s: %s", c->run, strerror(errno));
    for (const struct dirent *x; (x = readdir(d));) {
        int64_t step = step_of(x->d_name);
        if (step < 0) continue;
        if (*n == room) {
            room = room ? 2 * room : 16;
            int64_t *grown = realloc(*steps, room * sizeof *grown);
            if (!grown) {
                closedir(d);
                free(*steps);
                *steps = NULL;
                return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", c->run);
            }
            *steps = grown;
        }
        (*steps)[(*n)++] = step;
    }
    closedir(d);
    if (*n) qsort(*steps, *n, sizeof **steps, newest_first);
    return DAR_OK;
}

/* ---------------------------------------------------------------- holding the run */

static void sweep(const char *run)
{
    char path[PATH_MAX];
    dar_err e;
    DIR *d = opendir(run);
    for (const struct dirent *x; d && (x = readdir(d));) {
        if (!dar_dir_temporary(x->d_name)) continue;
        if (snprintf(path, sizeof path, "%s/%s", run, x->d_name) >= (int)sizeof path) continue;
        if (dar_dir_remove(path, &e) != DAR_OK) dar_log(DAR_LOG_WARNING, "%s", e.text);
    }
    if (d) closedir(d);
}

dar_status dar_checkpoint_open(dar_checkpoint *c, dar_err *e)
{
    DAR_ASSERT(c->keep >= 1, "checkpoint: %lld kept", (long long)c->keep);
    c->step = 0;
    c->lock = -1;
    DAR_TRY(dar_dir_make(c->run, e));
    int error = dar_file_flush_entry(c->run);
    if (error) return dar_fail(e, DAR_ERR_IO, "%s: %s", c->run, strerror(error));
    DAR_TRY(dar_dir_lock(&c->lock, c->run, e));
    sweep(c->run);
    return DAR_OK;
}

void dar_checkpoint_close(dar_checkpoint *c)
{
    if (!c->run) return;
    if (c->lock >= 0) close(c->lock);
    c->lock = -1;
}

/* ---------------------------------------------------------------- going on */

static dar_status resume_auto(dar_checkpoint *c, const int64_t *steps, size_t n, dar_err *e)
{
    char path[PATH_MAX];
    for (size_t i = 0; i < n; i++) {
        dar_checkpoint_path(c, steps[i], path);
        if (dar_checkpoint_verify(path, e) == DAR_OK) return dar_checkpoint_read(c, path, e);
        dar_log(DAR_LOG_WARNING, "%s: damaged, passed over: %s", path, e->text);
    }
    if (!n) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu checkpoint%s, none of them whole, expected one to resume from",
                    c->run, n, n > 1 ? "s" : "");
}

static dar_status resume_from(dar_checkpoint *c, const char *from, const int64_t *steps, size_t n, dar_err *e)
{
    char path[PATH_MAX];
    DAR_TRY(dar_checkpoint_verify(from, e));
    DAR_TRY(dar_checkpoint_read(c, from, e));
    for (size_t i = 0; i < n && steps[i] > c->step; i++) {
        dar_err damaged;
        dar_checkpoint_path(c, steps[i], path);
        if (dar_checkpoint_verify(path, &damaged) != DAR_OK) continue;
        return dar_fail(e, DAR_ERR_USAGE,
                        "--resume: found %s of step %" PRId64
                        ", but the run has %s: expected the newest, or another run",
                        from, c->step, path);
    }
    return DAR_OK;
}

dar_status dar_checkpoint_resume(dar_checkpoint *c, const char *from, dar_err *e)
{
    int64_t *steps;
    size_t n;
    dar_err unread;
    dar_status s;
    if (!e) e = &unread;
    DAR_TRY(list(c, &steps, &n, e));
    if (from) s = strcmp(from, "auto") == 0 ? resume_auto(c, steps, n, e) : resume_from(c, from, steps, n, e);
    else if (!n) s = DAR_OK;
    else
        s = dar_fail(e, DAR_ERR_USAGE, "%s: found %s%" PRId64 ", expected --resume auto to go on, or another directory",
                     c->run, stem, steps[0]);
    free(steps);
    return s;
}

/* ---------------------------------------------------------------- saving */

/* The one just written is whole; newer ones are of a course that the run has left. */
static void prune(const dar_checkpoint *c)
{
    char path[PATH_MAX];
    int64_t *steps, kept = 0;
    size_t n;
    dar_err e;
    dar_status s = list(c, &steps, &n, &e);
    for (size_t i = 0; s == DAR_OK && i < n; i++) {
        if (steps[i] <= c->step && ++kept <= c->keep) continue;
        dar_checkpoint_path(c, steps[i], path);
        s = dar_dir_remove(path, &e);
    }
    if (s != DAR_OK) dar_log(DAR_LOG_WARNING, "%s", e.text);
    free(steps);
}

dar_status dar_checkpoint_save(dar_checkpoint *c, int64_t step, dar_err *e)
{
    dar_dir_out out = { 0 };
    dar_err why = { "" };
    char path[PATH_MAX];
    int64_t before = c->step;
    DAR_ASSERT(c->lock >= 0 && step >= 0, "checkpoint: %s is not open, or step %lld", c->run, (long long)step);
    dar_checkpoint_path(c, step, path);
    c->step = step;
    dar_status s = dar_dir_create(&out, path, &why);
    if (s == DAR_OK) s = dar_checkpoint_write(c, out.temp, &why);
    if (s == DAR_OK) s = dar_dir_commit(&out, true, &why);
    if (s != DAR_OK) {
        size_t inside = strlen(out.temp);
        const char *text = inside && strncmp(why.text, out.temp, inside) == 0 ? why.text + inside + 1 : why.text;
        c->step = before;
        dar_fail(e, s, "%s: not saved: %s; what was saved before is as it was", path, text);
    }
    dar_dir_discard(&out);
    if (s == DAR_OK) prune(c);
    return s;
}
