/* safetensors.c: headers, shards, look-up. */
#include "lib/safetensors.h"

#include <dirent.h>
#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lib/file.h"
#include "lib/json.h"
#include "lib/nearest.h"

#define SUFFIX       ".safetensors"
#define INDEX_SUFFIX ".safetensors.index.json"
#define COMMAS       (16 * DAR_SAFETENSORS_TENSORS) /* outside of strings; a full header has fewer */

struct entry {
    dar_safetensors_entry pub; /* first: the two convert into each other */
    size_t begin, end;         /* in the data of its file */
    void *copy;                /* aligned, of what lies askew */
};

struct file {
    char *name;
    dar_file_map map; /* zero: the caller's memory */
    dar_json_doc *doc;
    dar_json meta;
};

struct dar_safetensors {
    char *path; /* as opened, for messages */
    struct file *file;
    size_t files;
    struct entry *entry;
    size_t entries;
    const struct entry **by_name; /* sorted: found by halving, which no choice of names can slow down */
};

static dar_status no_memory(const char *name, dar_err *e)
{
    return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name);
}

/* ---------------------------------------------------------------- one header */

/* Bits per element; 0: not a type of the format. */
static unsigned bits_of(const char *type)
{
    static const struct {
        const char *name;
        unsigned bits;
    } known[] = {
        { "F64", 64 },    { "I64", 64 },        { "U64", 64 },    { "C64", 64 },        { "F32", 32 },
        { "I32", 32 },    { "U32", 32 },        { "F16", 16 },    { "BF16", 16 },       { "I16", 16 },
        { "U16", 16 },    { "BOOL", 8 },        { "U8", 8 },      { "I8", 8 },          { "F8_E4M3", 8 },
        { "F8_E5M2", 8 }, { "F8_E4M3FNUZ", 8 }, { "F8_E8M0", 8 }, { "F8_E5M2FNUZ", 8 }, { "F6_E2M3", 6 },
        { "F6_E3M2", 6 }, { "F4", 4 },
    };
    for (size_t i = 0; i < DAR_COUNT(known); i++)
        if (strcmp(known[i].name, type) == 0) return known[i].bits;
    return 0;
}

/* Outside of strings a header holds brackets, commas, colons and plain integers.  So no sign, fraction or exponent gets
 * as far as being a number, and how much is worth parsing is known beforehand. */
static dar_status check_text(const char *name, const char *text, size_t n, dar_err *e)
{
    bool string = false;
    size_t commas = 0;

    if (!n || text[0] != '{') return dar_fail(e, DAR_ERR_FORMAT, "%s: the header does not start with '{'", name);
    for (size_t i = 0; i < n; i++) {
        char c = text[i];
        if (c == '"') string = !string;
        else if (string && c == '\\') i++;
        else if (!string && (!c || !strchr("{}[]:,0123456789 \n\r\t", c)))
            return dar_fail(e, DAR_ERR_FORMAT, "%s: byte %zu of the header is '%c', expected a plain integer or string",
                            name, i, (unsigned char)c < 0x80 ? c : '?');
        else if (!string && c == ',' && ++commas > COMMAS)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: the header has more than %d values", name, COMMAS);
    }
    return DAR_OK;
}

static bool good_name(const char *name)
{
    size_t n = strlen(name);
    for (size_t i = 0; i < n; i++) {
        unsigned char c = (unsigned char)name[i];
        if (c < 0x20 || c == 0x7f) return false;
        if (c == 0xc2 && (unsigned char)name[i + 1] < 0xa0) return false; /* U+0080 to U+009F: control, too */
    }
    return n >= 1 && n <= DAR_SAFETENSORS_NAME;
}

/* The record of one tensor.  What is wrong is left in the document. */
static void read_entry(dar_json x, struct entry *t)
{
    int64_t range[2] = { 0 };
    size_t i = 0;

    t->pub.name = dar_json_key(x);
    t->pub.type = dar_json_text(x, "dtype", NULL);

    dar_json shape = dar_json_get(x, "shape"), offsets = dar_json_get(x, "data_offsets");
    t->pub.dims = (int)dar_json_size(shape);
    if (dar_json_kind_of(shape) != DAR_JSON_ARRAY || t->pub.dims > DAR_SAFETENSORS_DIMS) {
        dar_json_reject(x, "shape", "an array of at most %d dimensions", DAR_SAFETENSORS_DIMS);
        return;
    }
    for (dar_json d = dar_json_first(shape); d.item; d = dar_json_next(d))
        t->pub.dim[i++] = dar_json_int(d, NULL, DAR_JSON_NEEDED, 1, DAR_JSON_MAX_INT);
    if (dar_json_kind_of(offsets) != DAR_JSON_ARRAY || dar_json_size(offsets) != 2) {
        dar_json_reject(x, "data_offsets", "an array of two integers");
        return;
    }
    i = 0;
    for (dar_json d = dar_json_first(offsets); d.item; d = dar_json_next(d))
        range[i++] = dar_json_int(d, NULL, DAR_JSON_NEEDED, 0, DAR_JSON_MAX_INT);
    t->begin = (size_t)range[0];
    t->end = (size_t)range[1];
}

static int by_offset(const void *a, const void *b)
{
    const struct entry *x = a, *y = b;
    if (x->begin != y->begin) return x->begin < y->begin ? -1 : 1;
    return (x->end > y->end) - (x->end < y->end);
}

static dar_status check_size(const char *name, const struct entry *t, dar_err *e)
{
    unsigned bits = bits_of(t->pub.type);
    size_t n = bits;
    bool over = false;

    for (int i = 0; i < t->pub.dims; i++) over |= __builtin_mul_overflow(n, (size_t)t->pub.dim[i], &n);
    if (over)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: the shape has more bits than can be counted", name, t->pub.name);
    if (bits && (n % 8 || n / 8 != t->end - t->begin))
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: shape and dtype %s give %zu bits, data_offsets %zu bytes", name,
                        t->pub.name, t->pub.type, n, t->end - t->begin);
    return DAR_OK;
}

/* Sorted entries must tile [0, size). */
static dar_status check_ranges(const char *name, const struct entry *t, size_t n, size_t size, dar_err *e)
{
    size_t at = 0;
    for (size_t i = 0; i < n; at = t[i++].end) {
        if (t[i].end < t[i].begin || t[i].end > size)
            return dar_fail(e, DAR_ERR_FORMAT,
                            "%s: %s: data_offsets [%zu, %zu], expected a range in the file's %zu bytes of data", name,
                            t[i].pub.name, t[i].begin, t[i].end, size);
        if (t[i].begin != at)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: begins at %zu, expected %zu: there is %s", name, t[i].pub.name,
                            t[i].begin, at, t[i].begin > at ? "a hole before it" : "an overlap");
        DAR_TRY(check_size(name, &t[i], e));
    }
    if (at != size) return dar_fail(e, DAR_ERR_FORMAT, "%s: tensors end at %zu of %zu bytes of data", name, at, size);
    return DAR_OK;
}

/* Append the tensors of data[0, size) to s; f->name is set. */
static dar_status read_file(dar_safetensors *s, struct file *f, const unsigned char *data, size_t size, dar_err *e)
{
    uint64_t n = 0;

    if (size < 8) return dar_fail(e, DAR_ERR_FORMAT, "%s: %zu bytes, expected at least 8", f->name, size);
    for (int i = 7; i >= 0; i--) n = n << 8 | data[i];
    if (n > size - 8 || n > DAR_SAFETENSORS_HEADER)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: a header of %llu bytes, expected at most %zu", f->name,
                        (unsigned long long)n, size - 8 < DAR_SAFETENSORS_HEADER ? size - 8 : DAR_SAFETENSORS_HEADER);
    const char *text = (const char *)data + 8;
    DAR_TRY(check_text(f->name, text, (size_t)n, e));
    DAR_TRY(dar_json_parse(&f->doc, f->name, text, (size_t)n, e));

    dar_json root = dar_json_root(f->doc);
    size_t members = dar_json_size(root), first = s->entries;
    if (members > DAR_SAFETENSORS_TENSORS)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %zu tensors, expected at most %d", f->name, members,
                        DAR_SAFETENSORS_TENSORS);
    struct entry *grown = realloc(s->entry, (s->entries + members + 1) * sizeof *grown);
    if (!grown) return no_memory(f->name, e);
    s->entry = grown;
    for (dar_json x = dar_json_first(root); x.item; x = dar_json_next(x)) {
        if (strcmp(dar_json_key(x), "__metadata__") == 0) {
            f->meta = x;
            if (dar_json_kind_of(x) != DAR_JSON_OBJECT) dar_json_reject(x, NULL, "an object");
            for (dar_json m = dar_json_first(x); m.item; m = dar_json_next(m)) dar_json_text(m, NULL, NULL);
            dar_json_accept(x);
            continue;
        }
        if (!good_name(dar_json_key(x)))
            return dar_fail(e, DAR_ERR_FORMAT, "%s: a name must be 1 to %d bytes of printable UTF-8, found '%s'",
                            f->name, DAR_SAFETENSORS_NAME, dar_json_key(x));
        struct entry *t = &s->entry[s->entries++];
        memset(t, 0, sizeof *t);
        t->pub.file = f->name;
        read_entry(x, t);
    }
    DAR_TRY(dar_json_finish(f->doc, e));

    struct entry *t = s->entry + first;
    size_t count = s->entries - first;
    if (count) qsort(t, count, sizeof *t, by_offset);
    DAR_TRY(check_ranges(f->name, t, count, size - 8 - (size_t)n, e));
    for (size_t i = 0; i < count; i++) {
        t[i].pub.data = data + 8 + n + t[i].begin;
        t[i].pub.bytes = t[i].end - t[i].begin;
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- all files */

static int by_name(const void *a, const void *b)
{
    return strcmp((*(const struct entry *const *)a)->pub.name, (*(const struct entry *const *)b)->pub.name);
}

static dar_status sort_names(dar_safetensors *s, dar_err *e)
{
    s->by_name = malloc((s->entries + 1) * sizeof *s->by_name);
    if (!s->by_name) return no_memory(s->path, e);
    for (size_t i = 0; i < s->entries; i++) s->by_name[i] = &s->entry[i];
    qsort(s->by_name, s->entries, sizeof *s->by_name, by_name);
    for (size_t i = 1; i < s->entries; i++) {
        const dar_safetensors_entry *a = &s->by_name[i - 1]->pub, *b = &s->by_name[i]->pub;
        if (strcmp(a->name, b->name) == 0)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: is in %s and in %s", s->path, a->name, a->file, b->file);
    }
    return DAR_OK;
}

static dar_status set_up(dar_safetensors **out, const char *path, size_t files, dar_err *e)
{
    dar_safetensors *s = calloc(1, sizeof *s);
    *out = s;
    if (s) {
        s->path = strdup(path);
        s->file = calloc(files, sizeof *s->file);
    }
    return s && s->path && s->file ? DAR_OK : no_memory(path, e);
}

static dar_status map_file(dar_safetensors *s, const char *path, dar_err *e)
{
    struct file *f = &s->file[s->files++];
    f->name = strdup(path);
    if (!f->name) return no_memory(path, e);
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

    if (!list) return no_memory(path, e);
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

static dar_status open_index(dar_safetensors **out, const char *path, dar_json_doc *doc, dar_err *e)
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
        const dar_safetensors_entry *t = dar_safetensors_find(*out, name);
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

dar_status dar_safetensors_open(dar_safetensors **out, const char *path, dar_err *e)
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
        dar_safetensors_close(*out);
        *out = NULL;
    }
    return s;
}

dar_status dar_safetensors_parse(dar_safetensors **out, const char *name, const void *data, size_t size, dar_err *e)
{
    dar_status s = set_up(out, name, 1, e);
    if (s == DAR_OK) {
        struct file *f = &(*out)->file[(*out)->files++];
        f->name = strdup(name);
        s = f->name ? read_file(*out, f, data, size, e) : no_memory(name, e);
    }
    if (s == DAR_OK) s = sort_names(*out, e);
    if (s != DAR_OK) {
        dar_safetensors_close(*out);
        *out = NULL;
    }
    return s;
}

void dar_safetensors_close(dar_safetensors *s)
{
    if (!s) return;
    for (size_t i = 0; i < s->entries; i++) free(s->entry[i].copy);
    for (size_t i = 0; i < s->files; i++) {
        dar_json_close(s->file[i].doc);
        dar_file_map_close(&s->file[i].map);
        free(s->file[i].name);
    }
    free(s->by_name);
    free(s->entry);
    free(s->file);
    free(s->path);
    free(s);
}

/* ---------------------------------------------------------------- look-up */

size_t dar_safetensors_count(const dar_safetensors *s)
{
    return s->entries;
}

const dar_safetensors_entry *dar_safetensors_at(const dar_safetensors *s, size_t i)
{
    DAR_ASSERT(i < s->entries, "%s: tensor %zu of %zu", s->path, i, s->entries);
    return &s->entry[i].pub;
}

static int to_name(const void *name, const void *b)
{
    return strcmp(name, (*(const struct entry *const *)b)->pub.name);
}

const dar_safetensors_entry *dar_safetensors_find(const dar_safetensors *s, const char *name)
{
    const struct entry **t = bsearch(name, s->by_name, s->entries, sizeof *s->by_name, to_name);
    return t ? &(*t)->pub : NULL;
}

static dar_status not_there(const dar_safetensors *s, const char *name, dar_err *e)
{
    dar_nearest near = dar_nearest_to(name);
    for (size_t i = 0; i < s->entries; i++) dar_nearest_try(&near, s->by_name[i]->pub.name);
    return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: no such tensor%s%s%s", s->path, name,
                    near.best ? "; did you mean '" : "", near.best ? near.best : "", near.best ? "'?" : "");
}

dar_status dar_safetensors_tensor(dar_safetensors *s, const char *name, dar_tensor *x, dar_err *e)
{
    static const char *const names[] = { [DAR_F64] = "F64", [DAR_F32] = "F32", [DAR_BF16] = "BF16", [DAR_F16] = "F16" };
    const dar_safetensors_entry *found = dar_safetensors_find(s, name);
    if (!found) return not_there(s, name, e);

    struct entry *t = s->entry + ((const struct entry *)found - s->entry);
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
            if (!t->copy) return no_memory(t->pub.file, e);
            memcpy(t->copy, data, t->pub.bytes);
        }
        data = t->copy;
    }
    dar_shape shape = { .n = t->pub.dims };
    memcpy(shape.d, t->pub.dim, sizeof(int64_t) * (size_t)t->pub.dims);
    *x = dar_tensor_of(type, shape, (void *)(uintptr_t)data);
    return DAR_OK;
}

const char *dar_safetensors_meta(const dar_safetensors *s, const char *key)
{
    for (size_t i = 0; i < s->files; i++)
        for (dar_json m = dar_json_first(s->file[i].meta); m.item; m = dar_json_next(m))
            if (strcmp(dar_json_key(m), key) == 0) return dar_json_text(m, NULL, NULL);
    return NULL;
}
