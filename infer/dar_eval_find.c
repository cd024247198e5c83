/* dar_eval_find.c: bundles with what is known of them, methods with what is known of them, pictures of one for the
 * other. */
#include "infer/dar_eval.h"

#include <ctype.h>
#include <dirent.h>
#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "data/objseq.h"
#include "lib/json.h"

static bool join(char path[PATH_MAX], const char *a, const char *b)
{
    return (size_t)snprintf(path, PATH_MAX, "%s/%s", a, b) < PATH_MAX;
}

static bool is_there(const char *path)
{
    struct stat st;
    return stat(path, &st) == 0;
}

/* The last part of a path, without slashes at its end. */
static void last_part(const char *path, char name[DAR_EVAL_NAME])
{
    size_t n = strlen(path), at;
    while (n > 1 && path[n - 1] == '/') n--;
    for (at = n; at > 0 && path[at - 1] != '/'; at--) continue;
    snprintf(name, DAR_EVAL_NAME, "%.*s", (int)(n - at), path + at);
}

static void copy(char to[DAR_EVAL_NAME], const char *text)
{
    snprintf(to, DAR_EVAL_NAME, "%s", text);
}

/* ---------------------------------------------------------------- clips */

static dar_status no_memory(dar_err *e)
{
    return dar_fail(e, DAR_ERR_NOMEM, "dar-eval: out of memory");
}

static dar_status add_clip(dar_eval *v, const char *path, const char *name, const char *set, dar_err *e)
{
    dar_bundle *b;
    dar_eval_clip *more = realloc(v->clip, (v->clips + 1) * sizeof *more);
    if (!more) return no_memory(e);
    v->clip = more;
    dar_eval_clip *c = &more[v->clips];
    *c = (dar_eval_clip){ .number = v->clips, .lost = { NAN, NAN }, .seen = NAN };
    snprintf(c->path, sizeof c->path, "%s", path);
    copy(c->name, name);
    copy(c->set, set);
    if (*name && strspn(name, "0123456789") == strlen(name)) c->number = strtoul(name, NULL, 10);
    DAR_TRY(dar_bundle_open(&b, path, e));
    const dar_bundle_meta *m = &b->meta;
    c->frames = m->frames;
    c->width = (size_t)m->width;
    c->height = (size_t)m->height;
    c->fps = m->fps;
    c->masks = dar_bundle_has(b, DAR_FAMILY_MASK);
    copy(c->trajectory, m->trajectory ? m->trajectory : "unknown");
    copy(c->family, "unknown");
    bool rgb = b->rgb;
    dar_bundle_close(b);
    if (!rgb) return dar_fail(e, DAR_ERR_FORMAT, "%s: found no rgb.h5, the true pictures", path);
    v->clips++;
    return DAR_OK;
}

/* Name of the set and families of the clips from `first` on. */
static dar_status read_manifest(dar_eval *v, const char *file, size_t first, dar_err *e)
{
    dar_json_doc *doc;
    DAR_TRY(dar_json_open(&doc, file, e));
    dar_json root = dar_json_root(doc);
    const char *set = dar_json_text(root, "set", "");
    for (size_t i = first; i < v->clips && *set; i++) copy(v->clip[i].set, set);
    for (dar_json x = dar_json_first(dar_json_array(root, "list")); x.item; x = dar_json_next(x)) {
        const char *name = dar_json_text(x, "bundle", ""), *family = dar_json_text(x, "family", "unknown");
        for (size_t i = first; i < v->clips; i++)
            if (strcmp(v->clip[i].name, name) == 0) copy(v->clip[i].family, family);
    }
    dar_json_close(doc);
    return DAR_OK;
}

static int in_order(const struct dirent **a, const struct dirent **b)
{
    return dar_objseq_order((*a)->d_name, (*b)->d_name);
}

static int not_hidden(const struct dirent *d)
{
    return d->d_name[0] != '.';
}

static dar_status add_directory(dar_eval *v, const char *path, dar_err *e)
{
    struct dirent **entry;
    char bundle[PATH_MAX], file[PATH_MAX], set[DAR_EVAL_NAME];
    size_t first = v->clips;
    dar_status s = DAR_OK;
    int n = scandir(path, &entry, not_hidden, in_order);
    if (n < 0) return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
    last_part(path, set);
    for (int i = 0; i < n; i++) {
        if (s == DAR_OK && join(bundle, path, entry[i]->d_name) && join(file, bundle, "meta.json") && is_there(file))
            s = add_clip(v, bundle, entry[i]->d_name, set, e);
        free(entry[i]);
    }
    free(entry);
    if (s == DAR_OK && v->clips == first) return dar_fail(e, DAR_ERR_FORMAT, "%s: found no bundle", path);
    if (s == DAR_OK && join(file, path, "manifest.json") && is_there(file)) s = read_manifest(v, file, first, e);
    return s;
}

dar_status dar_eval_find_clips(dar_eval *v, const char *const *path, size_t n, dar_err *e)
{
    char file[PATH_MAX], name[DAR_EVAL_NAME];
    for (size_t i = 0; i < n; i++) {
        last_part(path[i], name);
        if (join(file, path[i], "meta.json") && is_there(file)) DAR_TRY(add_clip(v, path[i], name, "", e));
        else DAR_TRY(add_directory(v, path[i], e));
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- methods */

void dar_eval_channels(const char *text, char set[DAR_EVAL_NAME])
{
    dar_channel_set s;
    size_t n = 0;
    if (dar_channel_set_parse(&s, text, NULL) != DAR_OK) return;
    copy(set, s.families ? "" : "camera");
    for (int f = 0; f < DAR_FAMILIES && n < DAR_EVAL_NAME; f++)
        if (dar_channel_set_has(&s, (dar_family)f))
            n += (size_t)snprintf(set + n, DAR_EVAL_NAME - n, "%s%s", n ? "+" : "", dar_family_table[f].name);
}

/* NAME or SET or SET@STEP. */
static void read_name(dar_eval_method *m)
{
    char set[DAR_EVAL_NAME];
    const char *at = strchr(m->name, '@');
    size_t n = at ? (size_t)(at - m->name) : strlen(m->name);
    snprintf(set, sizeof set, "%.*s", (int)n, m->name);
    if (at && isdigit((unsigned char)at[1])) m->step = strtoll(at + 1, NULL, 10);
    dar_eval_channels(set, m->set);
}

/* method.json: what a name does not say. */
static dar_status read_file(dar_eval_method *m, const char *file, bool named, dar_err *e)
{
    dar_json_doc *doc;
    DAR_TRY(dar_json_open(&doc, file, e));
    dar_json root = dar_json_root(doc);
    const char *name = dar_json_text(root, "name", m->name), *set = dar_json_text(root, "set", "");
    if (!named) {
        copy(m->name, name);
        read_name(m);
    }
    if (*set) dar_eval_channels(set, m->set);
    snprintf(m->mode, sizeof m->mode, "%s", dar_json_text(root, "mode", m->mode));
    m->step = dar_json_int(root, "step", m->step, -1, DAR_JSON_MAX_INT);
    m->seed = dar_json_int(root, "seed", m->seed, -1, DAR_JSON_MAX_INT);
    m->external = dar_json_bool(root, "external", m->external);
    dar_status s = dar_json_finish(doc, e);
    dar_json_close(doc);
    return s;
}

/* sample.json of the first clip that has one: what dar-sample was given. */
static void read_sample(const dar_eval *v, size_t method)
{
    dar_eval_method *m = &v->method[method];
    char path[PATH_MAX], file[PATH_MAX];
    for (size_t c = 0; c < v->clips; c++) {
        dar_json_doc *doc;
        if (!join(path, m->path, v->clip[c].name) || !join(file, path, "sample.json") || !is_there(file)) continue;
        if (dar_json_open(&doc, file, NULL) != DAR_OK) return;
        dar_json root = dar_json_root(doc);
        if (!*m->set) dar_eval_channels(dar_json_text(root, "channels", ""), m->set);
        if (!*m->mode && dar_json_get(root, "lora").item) snprintf(m->mode, sizeof m->mode, "lora");
        dar_json_close(doc);
        return;
    }
}

static dar_status add_method(dar_eval *v, const char *word, dar_err *e)
{
    dar_eval_method *m = &v->method[v->methods++];
    const char *is = strchr(word, '='), *slash = strchr(word, '/');
    bool named = is && is > word && (!slash || is < slash);
    char file[PATH_MAX];
    *m = (dar_eval_method){ .path = named ? is + 1 : word, .step = -1, .seed = -1 };
    if (named) snprintf(m->name, sizeof m->name, "%.*s", (int)(is - word), word);
    else last_part(word, m->name);
    read_name(m);
    if (!is_there(m->path)) return dar_fail(e, DAR_ERR_IO, "%s: %s", m->path, strerror(errno));
    if (join(file, m->path, "method.json") && is_there(file)) DAR_TRY(read_file(m, file, named, e));
    read_sample(v, v->methods - 1);
    for (size_t i = 0; i + 1 < v->methods; i++)
        if (strcmp(v->method[i].name, m->name) == 0)
            return dar_fail(e, DAR_ERR_USAGE, "%s: found a second method '%s', expected NAME=PATH", m->path, m->name);
    return DAR_OK;
}

dar_status dar_eval_find_methods(dar_eval *v, char *const *word, size_t n, bool reference, dar_err *e)
{
    static const struct {
        dar_eval_kind kind;
        const char *name;
    } rows[] = { { DAR_EVAL_REPEAT, "repeat frame 0" }, { DAR_EVAL_WARP, "oracle warp" }, { DAR_EVAL_CODEC, "codec" } };
    v->method = calloc(n + DAR_COUNT(rows), sizeof *v->method);
    v->cell = calloc((n + DAR_COUNT(rows)) * v->clips, sizeof *v->cell);
    v->value = calloc(v->clips, sizeof *v->value);
    if (!v->method || !v->cell || !v->value) return no_memory(e);
    for (size_t i = 0; i < n; i++) DAR_TRY(add_method(v, word[i], e));
    for (size_t i = 0; i < DAR_COUNT(rows) && reference; i++) {
        if (rows[i].kind == DAR_EVAL_CODEC && !v->codec) continue;
        dar_eval_method *m = &v->method[v->methods++];
        *m = (dar_eval_method){ .kind = rows[i].kind, .path = "", .step = -1, .seed = -1, .external = true };
        copy(m->name, rows[i].name);
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- pictures */

/* base, if it is a video, or what dar-sample leaves in it, or pictures. */
static bool look_in(const char *base, bool plain, char path[PATH_MAX])
{
    static const char *const within[] = { "frames", "video.mkv", "video.mp4" };
    struct stat st;
    if (stat(base, &st) != 0) return false;
    for (size_t i = 0; S_ISDIR(st.st_mode) && i < DAR_COUNT(within); i++)
        if (join(path, base, within[i]) && is_there(path)) return true;
    if (S_ISDIR(st.st_mode) && !plain) return false;
    return (size_t)snprintf(path, PATH_MAX, "%s", base) < PATH_MAX;
}

bool dar_eval_find(const dar_eval *v, size_t m, size_t c, char path[PATH_MAX])
{
    static const char *const ending[] = { "", ".mkv", ".mp4", ".mov", ".webm", ".avi", ".gif" };
    const dar_eval_clip *clip = &v->clip[c];
    char base[PATH_MAX];
    for (int with_set = 1; with_set >= 0; with_set--)
        for (size_t i = 0; i < DAR_COUNT(ending); i++) {
            const char *set = with_set ? clip->set : "";
            int n = snprintf(base, sizeof base, "%s/%s%s%s%s", v->method[m].path, set, *set ? "/" : "", clip->name,
                             ending[i]);
            if (n < PATH_MAX && look_in(base, true, path)) return true;
        }
    return v->clips == 1 && look_in(v->method[m].path, true, path);
}
