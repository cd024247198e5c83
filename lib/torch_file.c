/* torch_file.c: the two containers of torch.save: a zip of one pickle and raw storages, and the older row of pickles
 * with the storages behind them.
 *
 * Sources: APPNOTE.TXT 6.3.3 (zip, zip64); torch.serialization, caffe2/serialize. */
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lib/pickle.h"
#include "lib/weights_inside.h"

#define ENTRIES_MOST (DAR_WEIGHTS_TENSORS + 64)
#define END_SIZE     22
#define COMMENT_MOST 65535

static const char *const inner[] = { "state_dict", "model_state", "model", "ema" };

/* Bytes of the file that a key of the pickle stands for; sorted by name. */
typedef struct blob {
    const char *name; /* not terminated */
    size_t length;
    const unsigned char *data;
    size_t size;
} blob;

typedef struct blobs {
    blob *at;
    size_t n;
} blobs;

static uint64_t number(const unsigned char *b, int n)
{
    uint64_t x = 0;
    while (n-- > 0) x = x << 8 | b[n];
    return x;
}

static int by_blob_name(const void *a, const void *b)
{
    const blob *x = a, *y = b;
    size_t n = x->length < y->length ? x->length : y->length;
    int c = n ? memcmp(x->name, y->name, n) : 0;
    return c ? c : (x->length > y->length) - (x->length < y->length);
}

static const blob *find_blob(const blobs *s, const char *name, size_t length)
{
    blob key = { .name = name, .length = length };
    return s->n ? bsearch(&key, s->at, s->n, sizeof key, by_blob_name) : NULL;
}

/* ---------------------------------------------------------------- the zip container */

/* The central directory: entries, offset and size. */
typedef struct directory {
    uint64_t entries, size, offset;
} directory;

/* An end record whose comment ends with the file. */
static bool ends_here(const unsigned char *data, size_t size, size_t at)
{
    return memcmp(data + at, "PK\5\6", 4) == 0 && number(data + at + 20, 2) == size - END_SIZE - at;
}

/* A zip64 record, found through its locator before the end record, has the same fields and room for larger ones. */
static dar_status find_directory(const char *name, const unsigned char *data, size_t size, directory *d, dar_err *e)
{
    if (size < END_SIZE) return dar_fail(e, DAR_ERR_FORMAT, "%s: a zip without its end record, cut off?", name);
    size_t at = size - END_SIZE, limit = at > COMMENT_MOST ? at - COMMENT_MOST : 0;
    while (!ends_here(data, size, at) && at > limit) at--;
    if (!ends_here(data, size, at))
        return dar_fail(e, DAR_ERR_FORMAT, "%s: a zip without its end record, cut off?", name);

    const unsigned char *b = data + at;
    size_t end = at;
    bool whole = number(b + 4, 2) == 0 && number(b + 6, 2) == 0 && number(b + 8, 2) == number(b + 10, 2);
    *d = (directory){ number(b + 10, 2), number(b + 12, 4), number(b + 16, 4) };
    if (at >= 20 && memcmp(b - 20, "PK\6\7", 4) == 0) {
        uint64_t record = number(b - 12, 8);
        if (record > at - 20 || at - 20 - record < 56 || memcmp(data + record, "PK\6\6", 4) != 0)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: a large zip without its zip64 record", name);
        b = data + record;
        end = (size_t)record;
        whole = number(b + 16, 4) == 0 && number(b + 20, 4) == 0 && number(b + 24, 8) == number(b + 32, 8);
        *d = (directory){ number(b + 32, 8), number(b + 40, 8), number(b + 48, 8) };
    }
    if (!whole) return dar_fail(e, DAR_ERR_FORMAT, "%s: a zip in several parts", name);
    if (d->entries > ENTRIES_MOST)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %llu entries, expected at most %d", name,
                        (unsigned long long)d->entries, ENTRIES_MOST);
    if (d->offset > end || d->size != end - d->offset)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: the zip's directory is not where its end record says", name);
    return DAR_OK;
}

/* Replace the fields that are all ones by those of the zip64 extra field, which holds just them, in this order. */
static bool read_zip64(const unsigned char *extra, size_t n, uint64_t field[3])
{
    for (size_t at = 0; n - at >= 4;) {
        size_t id = number(extra + at, 2), size = number(extra + at + 2, 2);
        at += 4;
        if (size > n - at) return false;
        if (id == 1) {
            size_t used = 0;
            for (int i = 0; i < 3; i++) {
                if (field[i] != 0xffffffff) continue;
                if (size - used < 8) return false;
                field[i] = number(extra + at + used, 8);
                used += 8;
            }
            return true;
        }
        at += size;
    }
    return field[0] != 0xffffffff && field[1] != 0xffffffff && field[2] != 0xffffffff;
}

/* One record of the directory at b[0, room); *length is its own. */
static dar_status read_record(const char *file, const unsigned char *data, size_t data_end, const unsigned char *b,
                              size_t room, blob *out, size_t *length, dar_err *e)
{
    if (room < 46 || memcmp(b, "PK\1\2", 4) != 0)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: the zip's directory ends early", file);
    size_t name = number(b + 28, 2), extra = number(b + 30, 2), comment = number(b + 32, 2);
    *length = 46 + name + extra + comment;
    if (*length > room) return dar_fail(e, DAR_ERR_FORMAT, "%s: the zip's directory ends early", file);

    uint64_t field[3] = { number(b + 24, 4), number(b + 20, 4), number(b + 42, 4) };
    const char *label = (const char *)b + 46;
    int shown = name < 64 ? (int)name : 64;
    if (number(b + 8, 2) & 1) return dar_fail(e, DAR_ERR_FORMAT, "%s: %.*s: encrypted", file, shown, label);
    if (number(b + 10, 2) != 0 || !read_zip64(b + 46 + name, extra, field) || field[0] != field[1])
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %.*s: compressed, expected a stored entry", file, shown, label);

    /* The local header has a name and an extra field of its own length: padding aligns the data. */
    size_t left = field[2] <= data_end ? data_end - field[2] : 0;
    const unsigned char *local = data + (data_end - left);
    if (left < 30 || memcmp(local, "PK\3\4", 4) != 0 || number(local + 26, 2) != name || left - 30 < name ||
        memcmp(local + 30, label, name) != 0)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %.*s: its local header is another one", file, shown, label);
    size_t head = 30 + name + number(local + 28, 2);
    if (head > left || field[0] > left - head)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %.*s: %llu bytes reach beyond the zip's data", file, shown, label,
                        (unsigned long long)field[0]);
    *out = (blob){ label, name, local + head, field[0] };
    return DAR_OK;
}

static int by_place(const void *a, const void *b)
{
    const blob *x = a, *y = b;
    if (x->data != y->data) return x->data < y->data ? -1 : 1;
    return (x->size > y->size) - (x->size < y->size);
}

/* No entry may lie in another or be named twice. */
static dar_status check_blobs(const char *file, blobs *s, dar_err *e)
{
    qsort(s->at, s->n, sizeof *s->at, by_place);
    for (size_t i = 1; i < s->n; i++)
        if (s->at[i].data < s->at[i - 1].data + s->at[i - 1].size)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: entries of the zip overlap", file);
    qsort(s->at, s->n, sizeof *s->at, by_blob_name);
    for (size_t i = 1; i < s->n; i++)
        if (by_blob_name(&s->at[i - 1], &s->at[i]) == 0)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: two entries of the zip have one name", file);
    return DAR_OK;
}

/* All entries, named without the folder they share; others are passed over. */
static dar_status read_directory(const char *file, const unsigned char *data, size_t size, blobs *s, dar_err *e)
{
    directory d = { 0 };
    DAR_TRY(find_directory(file, data, size, &d, e));
    s->at = calloc(d.entries + 1, sizeof *s->at);
    if (!s->at) return dar_weights_no_memory(file, e);

    const unsigned char *b = data + d.offset;
    size_t room = d.size, folder = 0, length = 0;
    for (uint64_t i = 0; i < d.entries; i++, b += length, room -= length) {
        blob *x = &s->at[s->n];
        DAR_TRY(read_record(file, data, d.offset, b, room, x, &length, e));
        const char *slash = memchr(x->name, '/', x->length);
        if (i == 0) folder = slash ? (size_t)(slash - x->name) + 1 : 0;
        if (x->length <= folder || (s->n && memcmp(x->name, s->at[0].name - folder, folder) != 0)) continue;
        x->name += folder;
        x->length -= folder;
        s->n++;
    }
    if (room) return dar_fail(e, DAR_ERR_FORMAT, "%s: the zip's directory has %zu bytes too many", file, room);
    return check_blobs(file, s, e);
}

/* ---------------------------------------------------------------- from values to tensors */

/* Where the bytes of a storage are.  On failure NULL. */
typedef const unsigned char *locate(void *where, const dar_pickle *p, const dar_pickle_value *storage, size_t *bytes);

static bool sizes(const dar_pickle *p, uint32_t tuple, int64_t least, int64_t *out, int *n)
{
    *n = 0;
    for (uint32_t c = dar_pickle_first(p, tuple); c; c = p->cell[c].next) {
        const dar_pickle_value *x = &p->value[p->cell[c].value];
        if (*n == DAR_WEIGHTS_DIMS || x->kind != DAR_PICKLE_INT || x->number < least) return false;
        out[(*n)++] = x->number;
    }
    return true;
}

/* Fill w but for its name.  NULL, or what is wrong. */
static const char *read_tensor(const dar_pickle *p, const dar_pickle_value *t, locate *find, void *where, dar_weight *w)
{
    int64_t stride[DAR_WEIGHTS_DIMS];
    int strides;
    size_t count = 1, bytes, end;
    const dar_pickle_value *storage = &p->value[t->storage];

    if (!sizes(p, t->shape, 1, w->dim, &w->dims) || !sizes(p, t->stride, 0, stride, &strides) || strides != w->dims)
        return "shape and strides, expected at most 8 dimensions of at least 1 each";
    for (int i = w->dims; i-- > 0;) {
        if (w->dim[i] > 1 && (uint64_t)stride[i] != count) return "a strided view, expected a contiguous tensor";
        if (__builtin_mul_overflow(count, (size_t)w->dim[i], &count)) return "more elements than can be counted";
    }
    if (__builtin_mul_overflow(count, t->type->size, &w->bytes) ||
        __builtin_mul_overflow((size_t)t->offset, t->type->size, &end) || __builtin_add_overflow(end, w->bytes, &end))
        return "more elements than can be counted";
    const unsigned char *data = find(where, p, storage, &bytes);
    if (!data) return "its storage is not in the file, or not of the size the pickle says";
    if (end > bytes) return "reaches beyond its storage";
    w->data = data + (end - w->bytes);
    w->type = t->type->name;
    return NULL;
}

/* Bytes that the pickle promises; false: more than can be counted. */
static bool promised(const dar_pickle_value *storage, size_t *bytes)
{
    size_t size = storage->element ? storage->element->size : 1;
    return !__builtin_mul_overflow((size_t)storage->elements, size, bytes);
}

static bool has_tensors(const dar_pickle *p, uint32_t dict)
{
    for (uint32_t c = dar_pickle_first(p, dict); c; c = p->cell[c].next)
        if (p->value[p->cell[c].value].kind == DAR_PICKLE_TENSOR) return true;
    return false;
}

/* The dict whose tensors are meant; 0: none. */
static uint32_t find_dict(const dar_pickle *p, uint32_t top)
{
    if (p->value[top].kind != DAR_PICKLE_DICT) return 0;
    if (has_tensors(p, top)) return top;
    for (size_t i = 0; i < DAR_COUNT(inner); i++)
        for (uint32_t c = dar_pickle_first(p, top); c; c = p->cell[p->cell[c].next].next) {
            uint32_t v = p->cell[p->cell[c].next].value;
            if (dar_pickle_is(p, p->cell[c].value, inner[i]) && p->value[v].kind == DAR_PICKLE_DICT &&
                has_tensors(p, v))
                return v;
        }
    return 0;
}

static bool good_name(const dar_pickle_value *k)
{
    if (k->kind != DAR_PICKLE_TEXT || k->size < 1 || k->size > DAR_WEIGHTS_NAME) return false;
    for (size_t i = 0; i < k->size; i++)
        if (k->text[i] < 0x20 || k->text[i] == 0x7f) return false; /* beyond ASCII is negative */
    return true;
}

static dar_status read_dict(dar_weights *s, struct dar_weight_file *f, const dar_pickle *p, uint32_t top, locate *find,
                            void *where, dar_err *e)
{
    uint32_t dict = find_dict(p, top);
    if (!dict) return dar_fail(e, DAR_ERR_FORMAT, "%s: no dict of tensors, expected a state dict", f->name);

    size_t pairs = p->value[dict].count / 2, letters = 0;
    if (pairs > DAR_WEIGHTS_TENSORS)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %zu tensors, expected at most %d", f->name, pairs, DAR_WEIGHTS_TENSORS);
    struct dar_weight_entry *to = dar_weights_room(s, f, pairs, e);
    f->text = malloc(pairs * (DAR_WEIGHTS_NAME + 1) + 1);
    if (!to || !f->text) return dar_weights_no_memory(f->name, e);
    for (uint32_t c = dar_pickle_first(p, dict); c; c = p->cell[p->cell[c].next].next) {
        const dar_pickle_value *k = &p->value[p->cell[c].value], *v = &p->value[p->cell[p->cell[c].next].value];
        if (v->kind != DAR_PICKLE_TENSOR) continue;
        if (!good_name(k))
            return dar_fail(e, DAR_ERR_FORMAT, "%s: a name must be 1 to %d printable ASCII characters", f->name,
                            DAR_WEIGHTS_NAME);
        dar_weight w = { .name = f->text + letters, .file = f->name };
        memcpy(f->text + letters, k->text, k->size);
        f->text[letters + k->size] = 0;
        letters += k->size + 1;
        const char *fault = read_tensor(p, v, find, where, &w);
        if (fault) return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: %s", f->name, w.name, fault);
        (to++)->pub = w;
        s->entries++;
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- both containers */

static const unsigned char *in_zip(void *where, const dar_pickle *p, const dar_pickle_value *storage, size_t *bytes)
{
    const dar_pickle_value *key = &p->value[storage->key];
    char name[64];
    if (key->size > 50) return NULL; /* they are small numbers */
    int n = snprintf(name, sizeof name, "data/%.*s", (int)key->size, key->text);
    const blob *b = find_blob(where, name, (size_t)n);
    return b && promised(storage, bytes) && *bytes == b->size ? b->data : NULL;
}

static dar_status read_zip(dar_weights *s, struct dar_weight_file *f, const unsigned char *data, size_t size,
                           blobs *all, dar_pickle *p, dar_err *e)
{
    uint32_t top;
    DAR_TRY(read_directory(f->name, data, size, all, e));
    const blob *order = find_blob(all, "byteorder", 9), *pickle = find_blob(all, "data.pkl", 8);
    if (order && (order->size != 6 || memcmp(order->data, "little", 6) != 0))
        return dar_fail(e, DAR_ERR_FORMAT, "%s: byteorder, expected little", f->name);
    if (!pickle || pickle->size > DAR_WEIGHTS_HEADER)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: data.pkl of %zu bytes, expected 1 to %zu", f->name,
                        pickle ? pickle->size : 0, DAR_WEIGHTS_HEADER);
    DAR_TRY(dar_pickle_init(p, f->name, pickle->data, pickle->size, e));
    DAR_TRY(dar_pickle_next(p, &top, e));
    if (p->at != p->size) return dar_fail(e, DAR_ERR_FORMAT, "%s: data.pkl goes on behind its end", f->name);
    return read_dict(s, f, p, top, in_zip, all, e);
}

/* In the older container storages follow in the order of a list of their keys: a count, then the elements, whose type
 * only the pickle before knows. */
static const unsigned char *in_row(void *where, const dar_pickle *p, const dar_pickle_value *storage, size_t *bytes)
{
    const dar_pickle_value *key = &p->value[storage->key];
    const blob *b = find_blob(where, key->text, key->size);
    return b && promised(storage, bytes) && *bytes == b->size ? b->data : NULL;
}

static int by_key(const void *a, const void *b, void *pickle)
{
    const dar_pickle *p = pickle;
    const dar_pickle_value *x = &p->value[p->value[*(const uint32_t *)a].key];
    const dar_pickle_value *y = &p->value[p->value[*(const uint32_t *)b].key];
    blob bx = { .name = x->text, .length = x->size }, by = { .name = y->text, .length = y->size };
    return by_blob_name(&bx, &by);
}

/* The storages that the pickle names, each once, sorted by key.  Two of one key must agree. */
static dar_status list_storages(const dar_pickle *p, uint32_t *list, size_t *n, dar_err *e)
{
    size_t all = 0, kept = 0;
    for (uint32_t v = 0; v < p->values; v++)
        if (p->value[v].kind == DAR_PICKLE_STORAGE) list[all++] = v;
    qsort_r(list, all, sizeof *list, by_key, (void *)(uintptr_t)p);
    for (size_t i = 0; i < all; i++) {
        const dar_pickle_value *x = &p->value[list[i]], *y = kept ? &p->value[list[kept - 1]] : NULL;
        if (!y || by_key(&list[kept - 1], &list[i], (void *)(uintptr_t)p) != 0) list[kept++] = list[i];
        else if (x->element != y->element || x->elements != y->elements)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: two storages have one key", p->name);
    }
    *n = kept;
    return DAR_OK;
}

/* Behind the last pickle: the storages of `keys`, to the end of the file exactly. */
static dar_status read_row(const dar_pickle *p, uint32_t keys, const uint32_t *list, blobs *all, dar_err *e)
{
    size_t at = p->at, i = 0;
    if (p->value[keys].kind != DAR_PICKLE_LIST || p->value[keys].count != all->n)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: the list of storages is not that of the tensors", p->name);
    for (uint32_t c = dar_pickle_first(p, keys); c; c = p->cell[c].next, i++) {
        const dar_pickle_value *key = &p->value[p->cell[c].value], *storage = &p->value[list[i]];
        const dar_pickle_value *own = &p->value[storage->key];
        size_t bytes;
        if (key->kind != DAR_PICKLE_TEXT || key->size != own->size || memcmp(key->text, own->text, key->size) != 0)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: the list of storages is not that of the tensors", p->name);
        if (p->size - at < 8 || number(p->data + at, 8) != (uint64_t)storage->elements || !promised(storage, &bytes) ||
            bytes > p->size - at - 8)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: storage %.*s has another size than the pickle says", p->name,
                            key->size < 40 ? (int)key->size : 40, key->text);
        all->at[i] = (blob){ own->text, own->size, p->data + at + 8, bytes };
        at += 8 + bytes;
    }
    if (at != p->size)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %zu bytes behind the last storage", p->name, p->size - at);
    return DAR_OK;
}

static dar_status read_pickles(dar_weights *s, struct dar_weight_file *f, const unsigned char *data, size_t size,
                               blobs *all, dar_pickle *p, dar_err *e)
{
    static const unsigned char magic[] = { 0x80, 2,    0x8a, 10,   0x6c, 0xfc, 0x9c, 0x46,
                                           0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19, '.' };
    uint32_t version, system, top, keys;
    if (size < sizeof magic || memcmp(data, magic, sizeof magic) != 0)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: a pickle, but none of torch.save", f->name);
    DAR_TRY(dar_pickle_init(p, f->name, data, size, e));
    p->at = sizeof magic;
    DAR_TRY(dar_pickle_next(p, &version, e));
    DAR_TRY(dar_pickle_next(p, &system, e));
    if (p->value[version].kind != DAR_PICKLE_INT || p->value[version].number != 1001)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: protocol of torch.save, expected 1001", f->name);
    for (uint32_t c = p->value[system].kind == DAR_PICKLE_DICT ? dar_pickle_first(p, system) : 0; c;
         c = p->cell[p->cell[c].next].next) {
        const dar_pickle_value *v = &p->value[p->cell[p->cell[c].next].value];
        if (dar_pickle_is(p, p->cell[c].value, "little_endian") && (v->kind != DAR_PICKLE_BOOL || !v->number))
            return dar_fail(e, DAR_ERR_FORMAT, "%s: byteorder, expected little", f->name);
    }
    DAR_TRY(dar_pickle_next(p, &top, e));

    uint32_t *list = malloc(p->values * sizeof *list);
    dar_status status = list ? list_storages(p, list, &all->n, e) : dar_weights_no_memory(f->name, e);
    if (status == DAR_OK) {
        all->at = calloc(all->n + 1, sizeof *all->at);
        status = all->at ? dar_pickle_next(p, &keys, e) : dar_weights_no_memory(f->name, e);
    }
    if (status == DAR_OK) status = read_row(p, keys, list, all, e);
    free(list);
    return status == DAR_OK ? read_dict(s, f, p, top, in_row, all, e) : status;
}

dar_status dar_torch_read(dar_weights *s, struct dar_weight_file *f, const unsigned char *data, size_t size, dar_err *e)
{
    blobs all = { 0 };
    dar_pickle p = { 0 };
    bool zip = memcmp(data, "PK", 2) == 0;
    dar_status status = (zip ? read_zip : read_pickles)(s, f, data, size, &all, &p, e);
    dar_pickle_free(&p);
    free(all.at);
    return status;
}
