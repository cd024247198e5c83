/* safetensors.c: one file's header, read with distrust. */
#include "lib/weights_inside.h"

#include <stdlib.h>
#include <string.h>

#define COMMAS (16 * DAR_WEIGHTS_TENSORS) /* outside of strings; a full header has fewer */

/* A tensor and the place of its data in the file. */
struct range {
    dar_weight pub;
    size_t begin, end;
};

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
    return n >= 1 && n <= DAR_WEIGHTS_NAME;
}

/* The record of one tensor.  What is wrong is left in the document. */
static void read_entry(dar_json x, struct range *t)
{
    int64_t range[2] = { 0 };
    size_t i = 0;

    t->pub.name = dar_json_key(x);
    t->pub.type = dar_json_text(x, "dtype", NULL);

    dar_json shape = dar_json_get(x, "shape"), offsets = dar_json_get(x, "data_offsets");
    t->pub.dims = (int)dar_json_size(shape);
    if (dar_json_kind_of(shape) != DAR_JSON_ARRAY || t->pub.dims > DAR_WEIGHTS_DIMS) {
        dar_json_reject(x, "shape", "an array of at most %d dimensions", DAR_WEIGHTS_DIMS);
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
    const struct range *x = a, *y = b;
    if (x->begin != y->begin) return x->begin < y->begin ? -1 : 1;
    return (x->end > y->end) - (x->end < y->end);
}

static dar_status check_size(const char *name, const struct range *t, dar_err *e)
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
static dar_status check_ranges(const char *name, const struct range *t, size_t n, size_t size, dar_err *e)
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

/* The members of the header into t, which has room for them; what is wrong is left in the document. */
static dar_status read_members(struct dar_weight_file *f, struct range *t, size_t *count, dar_err *e)
{
    for (dar_json x = dar_json_first(dar_json_root(f->doc)); x.item; x = dar_json_next(x)) {
        if (strcmp(dar_json_key(x), "__metadata__") == 0) {
            f->meta = x;
            if (dar_json_kind_of(x) != DAR_JSON_OBJECT) dar_json_reject(x, NULL, "an object");
            for (dar_json m = dar_json_first(x); m.item; m = dar_json_next(m)) dar_json_text(m, NULL, NULL);
            dar_json_accept(x);
            continue;
        }
        if (!good_name(dar_json_key(x)))
            return dar_fail(e, DAR_ERR_FORMAT, "%s: a name must be 1 to %d bytes of printable UTF-8, found '%s'",
                            f->name, DAR_WEIGHTS_NAME, dar_json_key(x));
        read_entry(x, &t[(*count)++]);
    }
    return dar_json_finish(f->doc, e);
}

dar_status dar_safetensors_read(dar_weights *s, struct dar_weight_file *f, const unsigned char *data, size_t size,
                                dar_err *e)
{
    uint64_t n = 0;

    if (size < 8) return dar_fail(e, DAR_ERR_FORMAT, "%s: %zu bytes, expected at least 8", f->name, size);
    for (int i = 7; i >= 0; i--) n = n << 8 | data[i];
    if (n > size - 8 || n > DAR_WEIGHTS_HEADER)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: a header of %llu bytes, expected at most %zu", f->name,
                        (unsigned long long)n, size - 8 < DAR_WEIGHTS_HEADER ? size - 8 : DAR_WEIGHTS_HEADER);
    const char *text = (const char *)data + 8;
    DAR_TRY(check_text(f->name, text, (size_t)n, e));
    DAR_TRY(dar_json_parse(&f->doc, f->name, text, (size_t)n, e));

    size_t members = dar_json_size(dar_json_root(f->doc)), count = 0;
    if (members > DAR_WEIGHTS_TENSORS)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %zu tensors, expected at most %d", f->name, members,
                        DAR_WEIGHTS_TENSORS);
    struct range *t = calloc(members + 1, sizeof *t);
    struct dar_weight_entry *to = dar_weights_room(s, f, members, e);
    dar_status status = !to ? DAR_ERR_NOMEM : t ? read_members(f, t, &count, e) : dar_weights_no_memory(f->name, e);
    if (status == DAR_OK && count) qsort(t, count, sizeof *t, by_offset);
    if (status == DAR_OK) status = check_ranges(f->name, t, count, size - 8 - (size_t)n, e);
    for (size_t i = 0; i < count && status == DAR_OK; i++) {
        to[i].pub = t[i].pub;
        to[i].pub.file = f->name;
        to[i].pub.data = data + 8 + n + t[i].begin;
        to[i].pub.bytes = t[i].end - t[i].begin;
        s->entries++;
    }
    free(t);
    return status;
}
