/* weights.c: files of weights, shards, look-up.  Formats: safetensors.c, torch_file.c. */
#include "lib/weights.h"

#include <dirent.h>
#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lib/nearest.h"
#include "lib/weights_inside.h"

#define SUFFIX       ".safetensors"
#define INDEX_SUFFIX ".safetensors.index.json"

/* ---------------------------------------------------------------- all files */

dar_status dar_weights_no_memory(const char *name, dar_err *e)
{
    return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name);
}

struct dar_weight_entry *dar_weights_room(dar_weights *s, const struct dar_weight_file *f, size_t more, dar_err *e)
{
    struct dar_weight_entry *grown = realloc(s->entry, (s->entries + more + 1) * sizeof *grown);
    if (!grown) {
        dar_weights_no_memory(f->name, e);
        return NULL;
    }
    s->entry = grown;
    memset(grown + s->entries, 0, more * sizeof *grown);
    return grown + s->entries;
}

/* Torch's files begin with a zip's local header, or with a pickle of a long integer: as the length of a safetensors
 * header, both are beyond the limit. */
static dar_status read_file(dar_weights *s, struct dar_weight_file *f, const unsigned char *data, size_t size,
                            dar_err *e)
{
    bool torch = size >= 4 && (memcmp(data, "PK\3\4", 4) == 0 || memcmp(data, "\x80\x02\x8a\x0a", 4) == 0);
    return (torch ? dar_torch_read : dar_safetensors_read)(s, f, data, size, e);
}

static int by_name(const void *a, const void *b)
{
    return strcmp((*(const struct dar_weight_entry *const *)a)->pub.name,
                  (*(const struct dar_weight_entry *const *)b)->pub.name);
}

static dar_status sort_names(dar_weights *s, dar_err *e)
{
    s->by_name = malloc((s->entries + 1) * sizeof *s->by_name);
    if (!s->by_name) return dar_weights_no_memory(s->path, e);
    for (size_t i = 0; i < s->entries; i++) s->by_name[i] = &s->entry[i];
    qsort(s->by_name, s->entries, sizeof *s->by_name, by_name);
    for (size_t i = 1; i < s->entries; i++) {
        const dar_weight *a = &s->by_name[i - 1]->pub, *b = &s->by_name[i]->pub;
        if (strcmp(a->name, b->name) == 0)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: is in %s and in %s", s->path, a->name, a->file, b->file);
    }
    return DAR_OK;
}

static dar_status set_up(dar_weights **out, const char *path, size_t files, dar_err *e)
{
    dar_weights *s = calloc(1, sizeof *s);
    *out = s;
    if (s) {
        s->path = strdup(path);
        s->file = calloc(files, sizeof *s->file);
    }
    return s && s->path && s->file ? DAR_OK : dar_weights_no_memory(path, e);
}

static dar_status map_file(dar_weights *s, const char *path, dar_err *e)
{
    struct dar_weight_file *f = &s->file[s->files++];
    f->name = strdup(path);
    if (!f->name) return dar_weights_no_memory(path, e);
    DAR_TRY(dar_file_map_open(&f->map, path, e));
    return read_file(s, f, f->map.data, f->map.size, e);
}

/* A shard lies beside its index and nowhere else. */
static bool plain_name(const char *name)
{
    return *name && !strchr(name, '/') && strcmp(name, ".") != 0 && strcmp(name, "..") != 0;
}

static int by_text(const void *a, const void *b)
{
    return strcmp(*(const char *const *)a, *(const char *const *)b);
}

/* The shards' names in `map`, each once, sorted, into *names (to be freed). */
static dar_status list_shards(dar_json map, const char *path, const char ***names, size_t *count, dar_err *e)
{
    size_t n = 0, kept = 0;
    const char **list = malloc((dar_json_size(map) + 1) * sizeof *list);

    if (!list) return dar_weights_no_memory(path, e);
    for (dar_json x = dar_json_first(map); x.item; x = dar_json_next(x)) {
        const char *name = dar_json_text(x, NULL, NULL);
        if (name && !plain_name(name)) dar_json_reject(x, NULL, "a plain file name");
        if (name) list[n++] = name;
    }
    if (n) qsort(list, n, sizeof *list, by_text);
    for (size_t i = 0; i < n; i++)
        if (!kept || strcmp(list[kept - 1], list[i]) != 0) list[kept++] = list[i];
    *names = list;
    *count = kept;
    return DAR_OK;
}

static dar_status open_index(dar_weights **out, const char *path, dar_json_doc *doc, dar_err *e)
{
    const char *slash = strrchr(path, '/'), **shard = NULL;
    int dir = slash ? (int)(slash - path) + 1 : 0;
    char full[PATH_MAX];
    size_t shards = 0;
    dar_json root = dar_json_root(doc), map = dar_json_get(root, "weight_map");

    if (dar_json_kind_of(map) != DAR_JSON_OBJECT) dar_json_reject(root, "weight_map", "an object");
    dar_status s = list_shards(map, path, &shard, &shards, e);
    dar_json_accept(root);
    if (s == DAR_OK) s = dar_json_finish(doc, e);
    if (s == DAR_OK) s = set_up(out, path, shards + 1, e);
    for (size_t i = 0; i < shards && s == DAR_OK; i++) {
        if (snprintf(full, sizeof full, "%.*s%s", dir, path, shard[i]) >= (int)sizeof full)
            s = dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(ENAMETOOLONG));
        else s = map_file(*out, full, e);
    }
    if (s == DAR_OK) s = sort_names(*out, e);
    for (dar_json x = dar_json_first(map); x.item && s == DAR_OK; x = dar_json_next(x)) {
        const char *name = dar_json_key(x), *file = dar_json_text(x, NULL, "");
        const dar_weight *t = dar_weights_find(*out, name);
        if (!t || strcmp(t->file + dir, file) != 0)
            s = dar_fail(e, DAR_ERR_FORMAT, "%s: %s: is not in %s", path, name, file);
    }
    free(shard);
    return s;
}

static bool ends_with(const char *text, const char *end)
{
    size_t n = strlen(text), m = strlen(end);
    return n >= m && strcmp(text + n - m, end) == 0;
}

/* The one index in a directory or, if there is none, the one file. */
static dar_status look_into(const char *path, DIR *d, char *found, size_t size, dar_err *e)
{
    size_t indices = 0, files = 0;
    for (const struct dirent *x; (x = readdir(d));) {
        bool index = ends_with(x->d_name, INDEX_SUFFIX);
        if (!index && (indices || !ends_with(x->d_name, SUFFIX))) continue;
        if (index) indices++;
        else files++;
        if (snprintf(found, size, "%s/%s", path, x->d_name) >= (int)size)
            return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(ENAMETOOLONG));
    }
    if (indices == 1 || (!indices && files == 1)) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: %zu files *%s, expected one", path, indices ? indices : files,
                    indices ? INDEX_SUFFIX : SUFFIX);
}

dar_status dar_weights_open(dar_weights **out, const char *path, dar_err *e)
{
    char found[PATH_MAX];
    dar_status s = DAR_OK;
    DIR *d = opendir(path);

    *out = NULL;
    if (d) {
        s = look_into(path, d, found, sizeof found, e);
        closedir(d);
        path = found;
    }
    if (s == DAR_OK && ends_with(path, ".json")) {
        dar_json_doc *doc;
        s = dar_json_open(&doc, path, e);
        if (s == DAR_OK) s = open_index(out, path, doc, e);
        dar_json_close(doc);
    } else if (s == DAR_OK) {
        s = set_up(out, path, 1, e);
        if (s == DAR_OK) s = map_file(*out, path, e);
        if (s == DAR_OK) s = sort_names(*out, e);
    }
    if (s != DAR_OK) {
        dar_weights_close(*out);
        *out = NULL;
    }
    return s;
}

dar_status dar_weights_parse(dar_weights **out, const char *name, const void *data, size_t size, dar_err *e)
{
    dar_status s = set_up(out, name, 1, e);
    if (s == DAR_OK) {
        struct dar_weight_file *f = &(*out)->file[(*out)->files++];
        f->name = strdup(name);
        s = f->name ? read_file(*out, f, data, size, e) : dar_weights_no_memory(name, e);
    }
    if (s == DAR_OK) s = sort_names(*out, e);
    if (s != DAR_OK) {
        dar_weights_close(*out);
        *out = NULL;
    }
    return s;
}

void dar_weights_close(dar_weights *s)
{
    if (!s) return;
    for (size_t i = 0; i < s->entries; i++) free(s->entry[i].copy);
    for (size_t i = 0; i < s->files; i++) {
        dar_json_close(s->file[i].doc);
        free(s->file[i].text);
        dar_file_map_close(&s->file[i].map);
        free(s->file[i].name);
    }
    free(s->by_name);
    free(s->entry);
    free(s->file);
    free(s->path);
    free(s);
}

void dar_weights_rest(const dar_weights *s)
{
    for (size_t i = 0; s && i < s->files; i++) dar_file_map_rest(&s->file[i].map);
}

/* ---------------------------------------------------------------- look-up */

size_t dar_weights_count(const dar_weights *s)
{
    return s->entries;
}

const dar_weight *dar_weights_at(const dar_weights *s, size_t i)
{
    DAR_ASSERT(i < s->entries, "%s: tensor %zu of %zu", s->path, i, s->entries);
    return &s->entry[i].pub;
}

static int to_name(const void *name, const void *b)
{
    return strcmp(name, (*(const struct dar_weight_entry *const *)b)->pub.name);
}

const dar_weight *dar_weights_find(const dar_weights *s, const char *name)
{
    const struct dar_weight_entry **t = bsearch(name, s->by_name, s->entries, sizeof *s->by_name, to_name);
    return t ? &(*t)->pub : NULL;
}

static dar_status not_there(const dar_weights *s, const char *name, dar_err *e)
{
    dar_nearest near = dar_nearest_to(name);
    for (size_t i = 0; i < s->entries; i++) dar_nearest_try(&near, s->by_name[i]->pub.name);
    return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: no such tensor%s%s%s", s->path, name,
                    near.best ? "; did you mean '" : "", near.best ? near.best : "", near.best ? "'?" : "");
}

dar_status dar_weights_tensor(dar_weights *s, const char *name, dar_tensor *x, dar_err *e)
{
    static const char *const names[] = { [DAR_F64] = "F64", [DAR_F32] = "F32", [DAR_BF16] = "BF16", [DAR_F16] = "F16" };
    const dar_weight *found = dar_weights_find(s, name);
    if (!found) return not_there(s, name, e);

    struct dar_weight_entry *t = s->entry + ((const struct dar_weight_entry *)found - s->entry);
    dar_dtype type = 0;
    while (type < DAR_COUNT(names) && strcmp(names[type], t->pub.type) != 0) type++;
    if (type == DAR_COUNT(names))
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: dtype %s, expected F64, F32, BF16 or F16", t->pub.file, name,
                        t->pub.type);
    if (t->pub.dims > DAR_MAX_DIMS)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: %d dimensions, expected at most %d", t->pub.file, name, t->pub.dims,
                        DAR_MAX_DIMS);

    const void *data = t->pub.data;
    if ((uintptr_t)data % dar_dtype_size(type)) {
        if (!t->copy) {
            t->copy = aligned_alloc(DAR_ALIGN, (t->pub.bytes + DAR_ALIGN - 1) / DAR_ALIGN * DAR_ALIGN);
            if (!t->copy) return dar_weights_no_memory(t->pub.file, e);
            memcpy(t->copy, data, t->pub.bytes);
        }
        data = t->copy;
    }
    dar_shape shape = { .n = t->pub.dims };
    memcpy(shape.d, t->pub.dim, sizeof(int64_t) * (size_t)t->pub.dims);
    *x = dar_tensor_of(type, shape, (void *)(uintptr_t)data);
    return DAR_OK;
}

const char *dar_weights_meta(const dar_weights *s, const char *key)
{
    for (size_t i = 0; i < s->files; i++)
        for (dar_json m = dar_json_first(s->file[i].meta); m.item; m = dar_json_next(m))
            if (strcmp(dar_json_key(m), key) == 0) return dar_json_text(m, NULL, NULL);
    return NULL;
}
