/* json.c: the only user of cJSON, which builds and holds the tree.
 *
 * cJSON takes much that is not JSON (any control character as space, 01, 1e999, a NUL inside a key) and, being
 * recursive, trusts its input's depth.  So it sees only what lib/json_scan.h has found good; what it still refuses is
 * for want of memory. */
#include "lib/json.h"

#include <cJSON.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lib/file.h"
#include "lib/json_scan.h"
#include "lib/nearest.h"

/* Marks in cJSON's type field, above the bits that it looks at. */
#define ASKED  (1 << 16) /* somebody read this member */
#define ACCEPT (1 << 17) /* and everything below it */

struct dar_json_doc {
    char *name;
    cJSON *root;
    dar_status status; /* of the first read that failed */
    dar_err err;
};

/* ---------------------------------------------------------------- parsing */

static dar_status fail_at(const char *name, const char *text, size_t at, const char *what, dar_err *e)
{
    size_t line = 1, column = 1;
    for (size_t i = 0; i < at; i++) {
        if (text[i] == '\n') line++, column = 0;
        if (((unsigned char)text[i] & 0xc0) != 0x80) column++;
    }
    return dar_fail(e, DAR_ERR_FORMAT, "%s:%zu:%zu: %s", name, line, column, what);
}

/* text[0, size) with its NUL after it; comments in it are blanked. */
static dar_status parse(cJSON **out, const char *name, char *text, size_t size, dar_err *e)
{
    char what[DAR_JSON_WHAT];
    size_t at;

    *out = NULL;
    if (!dar_json_scan(text, size, &at, what)) return fail_at(name, text, at, what, e);
    *out = cJSON_ParseWithLength(text, size + 1);
    return *out ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name);
}

/* Room for the keys of the largest object; one for the whole check. */
struct keys {
    const cJSON **at;
    size_t capacity;
};

static int by_key(const void *a, const void *b)
{
    return strcmp((*(const cJSON *const *)a)->string, (*(const cJSON *const *)b)->string);
}

/* The first member whose key its object holds twice, or number that no double holds; NULL: none.  *memory is false if
 * there was not enough to tell. */
static const cJSON *find_bad(const cJSON *x, struct keys *k, bool *memory)
{
    size_t n = 0;

    if (cJSON_IsNumber(x) && !isfinite(x->valuedouble)) return x;
    for (const cJSON *c = x->child; c && cJSON_IsObject(x); c = c->next) {
        if (n == k->capacity) {
            size_t capacity = n ? 2 * n : 64;
            const cJSON **at = realloc(k->at, capacity * sizeof *at);
            if (!at) {
                *memory = false;
                return NULL;
            }
            k->at = at;
            k->capacity = capacity;
        }
        k->at[n++] = c;
    }
    if (n > 1) qsort(k->at, n, sizeof *k->at, by_key);
    for (size_t i = 1; i < n; i++)
        if (strcmp(k->at[i - 1]->string, k->at[i]->string) == 0) return k->at[i];
    for (const cJSON *c = x->child; c; c = c->next) {
        const cJSON *bad = find_bad(c, k, memory);
        if (bad) return bad;
    }
    return NULL;
}

/* ---------------------------------------------------------------- messages */

/* Ancestors of `target` from `at` down, itself last; their number, 0 if it is not below `at`. */
static int trail(const cJSON *at, const cJSON *target, const cJSON *chain[DAR_JSON_DEPTH + 2], int depth)
{
    chain[depth] = at;
    if (at == target) return depth + 1;
    for (const cJSON *c = at->child; c && depth <= DAR_JSON_DEPTH; c = c->next) {
        int n = trail(c, target, chain, depth + 1);
        if (n) return n;
    }
    return 0;
}

/* "train.rank", "layers[3].size", "" for the root; `key` is appended.  cJSON knows no parents: the tree is searched,
 * which only failures pay. */
static const char *path_text(const cJSON *root, const cJSON *x, const char *key, char *buf, size_t size)
{
    const cJSON *chain[DAR_JSON_DEPTH + 2];
    int n = trail(root, x, chain, 0);
    size_t at = 0;

    buf[0] = 0;
    for (int i = 1; i < n && at < size; i++) {
        if (cJSON_IsObject(chain[i - 1])) {
            at += (size_t)snprintf(buf + at, size - at, "%s%s", at ? "." : "", chain[i]->string);
            continue;
        }
        size_t index = 0;
        for (const cJSON *c = chain[i - 1]->child; c != chain[i]; c = c->next) index++;
        at += (size_t)snprintf(buf + at, size - at, "[%zu]", index);
    }
    if (key && at < size) snprintf(buf + at, size - at, "%s%s", at ? "." : "", key);
    return buf;
}

static const char *brief(const cJSON *x, char *buf, size_t size)
{
    char digits[32];
    if (cJSON_IsString(x)) {
        int n = (int)strnlen(x->valuestring, 41);
        while (n > 40 || (n && ((unsigned char)x->valuestring[n] & 0xc0) == 0x80)) n--;
        snprintf(buf, size, "\"%.*s%s\"", n, x->valuestring, x->valuestring[n] ? "..." : "");
    } else if (cJSON_IsNumber(x)) {
        snprintf(buf, size, "%s", dar_json_number_text(x->valuedouble, digits));
    } else {
        snprintf(buf, size, "%s",
                 cJSON_IsObject(x)  ? "an object"
                 : cJSON_IsArray(x) ? "an array"
                 : cJSON_IsTrue(x)  ? "true"
                 : cJSON_IsFalse(x) ? "false"
                                    : "null");
    }
    return buf;
}

static void fail_memory(dar_json_doc *d)
{
    if (d->status == DAR_OK) d->status = dar_fail(&d->err, DAR_ERR_NOMEM, "%s: out of memory", d->name);
}

/* x: what stands at j.key; NULL if it is missing. */
static void fail_value(dar_json j, const char *key, const cJSON *x, const char *expected)
{
    char path[320], found[64];
    if (j.doc->status != DAR_OK) return;
    path_text(j.doc->root, j.item, key, path, sizeof path);
    j.doc->status =
        dar_fail(&j.doc->err, DAR_ERR_FORMAT, "%s: %s%s%s%s, expected %s", j.doc->name, path, *path ? ": " : "",
                 x ? "found " : "missing", x ? brief(x, found, sizeof found) : "", expected);
}

void dar_json_reject(dar_json j, const char *key, const char *expected, ...)
{
    char text[256];
    va_list ap;
    va_start(ap, expected);
    vsnprintf(text, sizeof text, expected, ap);
    va_end(ap);
    const cJSON *x = j.item && key ? cJSON_GetObjectItemCaseSensitive(j.item, key) : j.item;
    if (j.item) fail_value(j, key, key && cJSON_IsNull(x) ? NULL : x, text);
}

/* ---------------------------------------------------------------- documents */

dar_status dar_json_parse(dar_json_doc **out, const char *name, const char *text, size_t size, dar_err *e)
{
    dar_status s = DAR_OK;
    char path[320], *copy = NULL;
    struct keys keys = { 0 };
    dar_json_doc *d = calloc(1, sizeof *d);

    if (!text) text = "{}", size = 2;
    if (size > DAR_JSON_MAX_SIZE) {
        s = dar_fail(e, DAR_ERR_FORMAT, "%s: %zu bytes of JSON, at most %zu are read", name, size, DAR_JSON_MAX_SIZE);
        goto done;
    }
    copy = malloc(size + 1);
    if (!d || !copy || !(d->name = strdup(name))) {
        s = dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name);
        goto done;
    }
    memcpy(copy, text, size);
    copy[size] = 0;
    s = parse(&d->root, name, copy, size, e);
    if (s != DAR_OK) goto done;

    bool memory = true;
    const cJSON *bad = find_bad(d->root, &keys, &memory);
    if (!memory) {
        s = dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name);
    } else if (bad) {
        s = dar_fail(e, DAR_ERR_FORMAT, "%s: %s: %s", name, path_text(d->root, bad, NULL, path, sizeof path),
                     cJSON_IsNumber(bad) && !isfinite(bad->valuedouble) ? "number too large" : "given twice");
    }
done:
    free(keys.at);
    free(copy);
    if (s != DAR_OK) {
        dar_json_close(d);
        d = NULL;
    }
    *out = d;
    return s;
}

dar_status dar_json_open(dar_json_doc **out, const char *path, dar_err *e)
{
    dar_file_map m;
    *out = NULL;
    DAR_TRY(dar_file_map_open(&m, path, e));
    dar_status s = dar_json_parse(out, path, m.data ? (const char *)m.data : "", m.size, e);
    dar_file_map_close(&m);
    return s;
}

void dar_json_close(dar_json_doc *doc)
{
    if (!doc) return;
    cJSON_Delete(doc->root);
    free(doc->name);
    free(doc);
}

dar_json dar_json_root(dar_json_doc *doc)
{
    return (dar_json){ doc, doc->root };
}

/* ---------------------------------------------------------------- --set */

/* "value" as JSON, or else as a string. */
static cJSON *value_of(const char *text)
{
    size_t n = strlen(text);
    char *copy = strdup(text);
    struct keys keys = { 0 };
    bool memory = true;
    cJSON *x = NULL;

    if (copy && n <= DAR_JSON_MAX_SIZE && parse(&x, "", copy, n, NULL) == DAR_OK && find_bad(x, &keys, &memory)) {
        cJSON_Delete(x);
        x = NULL;
    }
    free(keys.at);
    free(copy);
    return x ? x : cJSON_CreateString(text);
}

static int levels_of(const cJSON *x)
{
    int most = 0;
    for (const cJSON *c = x->child; c; c = c->next) {
        int n = levels_of(c);
        if (n > most) most = n;
    }
    return most + (cJSON_IsObject(x) || cJSON_IsArray(x));
}

/* The member of x, made if it is absent or null and x an object; NULL if x cannot have it. */
static cJSON *step_down(cJSON *x, const char *key)
{
    if (cJSON_IsArray(x)) {
        char *end;
        long i = strtol(key, &end, 10);
        return *key >= '0' && *key <= '9' && !*end && i < cJSON_GetArraySize(x) ? cJSON_GetArrayItem(x, (int)i) : NULL;
    }
    if (!cJSON_IsObject(x)) return NULL;
    cJSON *c = cJSON_GetObjectItemCaseSensitive(x, key);
    if (!c) return cJSON_AddObjectToObject(x, key);
    if (!cJSON_IsNull(c)) return c;
    cJSON *made = cJSON_CreateObject();
    if (made) cJSON_ReplaceItemInObjectCaseSensitive(x, key, made);
    return made;
}

dar_status dar_json_set(dar_json_doc *doc, const char *assignment, dar_err *e)
{
    const char *equals = strchr(assignment, '=');
    char path[512], *key = path, *dot;
    cJSON *x = doc->root, *next;
    int levels = 1;

    if (!equals || equals == assignment || (size_t)(equals - assignment) >= sizeof path)
        return dar_fail(e, DAR_ERR_USAGE, "--set %s: expected key.path=value", assignment);
    for (const char *p = assignment, *end = p + strlen(p); p < end; p += dar_json_utf8(p, end))
        if (!dar_json_utf8(p, end)) return dar_fail(e, DAR_ERR_USAGE, "--set %s: not UTF-8", assignment);
    snprintf(path, sizeof path, "%.*s", (int)(equals - assignment), assignment);

    for (; (dot = strchr(key, '.')) && levels < DAR_JSON_DEPTH; key = dot + 1, x = next, levels++) {
        *dot = 0;
        next = *key ? step_down(x, key) : NULL;
        if (!next) return dar_fail(e, DAR_ERR_USAGE, "--set %s: there is no '%s' to go into", assignment, key);
    }
    bool array = cJSON_IsArray(x);
    cJSON *old = array ? step_down(x, key) : cJSON_GetObjectItemCaseSensitive(x, key);
    if (dot || !*key || !(array ? old != NULL : cJSON_IsObject(x)))
        return dar_fail(e, DAR_ERR_USAGE, "--set %s: there is no place for '%s'", assignment, key);

    cJSON *value = value_of(equals + 1);
    if (value && levels + levels_of(value) > DAR_JSON_DEPTH) {
        cJSON_Delete(value);
        return dar_fail(e, DAR_ERR_USAGE, "--set %s: more than 64 levels", assignment);
    }
    bool done = value && (array ? cJSON_ReplaceItemViaPointer(x, old, value)
                          : old ? cJSON_ReplaceItemInObjectCaseSensitive(x, key, value)
                                : cJSON_AddItemToObject(x, key, value));
    if (done) return DAR_OK;
    cJSON_Delete(value);
    return dar_fail(e, DAR_ERR_NOMEM, "--set %s: out of memory", assignment);
}

/* ---------------------------------------------------------------- reads */

/* What stands at j.key, marked as asked for; NULL if it is absent or null. */
static cJSON *ask(dar_json j, const char *key)
{
    cJSON *x = j.item;
    if (x && key) {
        if (!cJSON_IsObject(x)) {
            fail_value(j, NULL, x, "an object");
            return NULL;
        }
        x = cJSON_GetObjectItemCaseSensitive(x, key);
    }
    if (x) x->type |= ASKED;
    return x && !cJSON_IsNull(x) ? x : NULL;
}

/* Enter `made`, the default, at j.key, where nothing or null stands.  Returns it; NULL if there is no place. */
static cJSON *enter(dar_json j, const char *key, cJSON *made)
{
    cJSON *x = j.item, *old = x && key ? cJSON_GetObjectItemCaseSensitive(x, key) : NULL;
    bool place = x && key && cJSON_IsObject(x);

    if (place && !made) fail_memory(j.doc);
    if (place && made) {
        made->type |= ASKED;
        if (old ? cJSON_ReplaceItemInObjectCaseSensitive(x, key, made) : cJSON_AddItemToObject(x, key, made))
            return made;
        fail_memory(j.doc);
    }
    cJSON_Delete(made);
    return NULL;
}

static void forget_asked(cJSON *x)
{
    x->type &= ~(ASKED | ACCEPT);
    for (cJSON *c = x->child; c; c = c->next) forget_asked(c);
}

static void merge(dar_json_doc *doc, cJSON *to, const cJSON *from)
{
    for (const cJSON *c = from->child; c; c = c->next) {
        cJSON *old = cJSON_GetObjectItemCaseSensitive(to, c->string);
        if (old && cJSON_IsObject(old) && cJSON_IsObject(c)) merge(doc, old, c);
        else if ((old = enter((dar_json){ doc, to }, c->string, cJSON_Duplicate(c, true)))) forget_asked(old);
    }
}

void dar_json_merge(dar_json to, dar_json from)
{
    if (cJSON_IsObject((cJSON *)to.item) && cJSON_IsObject((cJSON *)from.item)) merge(to.doc, to.item, from.item);
}

/* Nothing or null stands at j.key. */
static void missing(dar_json j, const char *key, const char *expected)
{
    cJSON *x = j.item;
    if (x && key && !cJSON_IsObject(x)) return; /* told already */
    if (x) fail_value(j, key, key ? cJSON_GetObjectItemCaseSensitive(x, key) : x, expected);
}

bool dar_json_bool(dar_json j, const char *key, bool standard)
{
    cJSON *x = ask(j, key);
    if (x && cJSON_IsBool(x)) return cJSON_IsTrue(x);
    if (x) fail_value(j, key, x, "true or false");
    else enter(j, key, cJSON_CreateBool(standard));
    return standard;
}

int64_t dar_json_int(dar_json j, const char *key, int64_t standard, int64_t lo, int64_t hi)
{
    char expected[96];
    cJSON *x = ask(j, key);
    double v = x ? x->valuedouble : 0;
    double least = (double)(lo < -DAR_JSON_MAX_INT ? -DAR_JSON_MAX_INT : lo);
    double most = (double)(hi > DAR_JSON_MAX_INT ? DAR_JSON_MAX_INT : hi);

    if (x && cJSON_IsNumber(x) && v == floor(v) && v >= least && v <= most) return (int64_t)v;
    if (hi >= DAR_JSON_MAX_INT) snprintf(expected, sizeof expected, "an integer, at least %.0f and below 2^53", least);
    else snprintf(expected, sizeof expected, "an integer from %.0f to %.0f", least, most);
    if (x) fail_value(j, key, x, expected);
    else if (standard == DAR_JSON_NEEDED) missing(j, key, expected);
    else enter(j, key, cJSON_CreateNumber((double)standard));
    return standard;
}

double dar_json_number(dar_json j, const char *key, double standard, double lo, double hi)
{
    char expected[96], a[32], b[32];
    cJSON *x = ask(j, key);

    if (x && cJSON_IsNumber(x) && x->valuedouble >= lo && x->valuedouble <= hi) return x->valuedouble;
    dar_json_number_text(lo, a);
    dar_json_number_text(hi, b);
    if (!isfinite(lo) && !isfinite(hi)) snprintf(expected, sizeof expected, "a number");
    else if (!isfinite(hi)) snprintf(expected, sizeof expected, "a number, at least %s", a);
    else if (!isfinite(lo)) snprintf(expected, sizeof expected, "a number, at most %s", b);
    else snprintf(expected, sizeof expected, "a number from %s to %s", a, b);
    if (x) fail_value(j, key, x, expected);
    else if (isnan(standard)) missing(j, key, expected);
    else enter(j, key, cJSON_CreateNumber(standard));
    return standard;
}

const char *dar_json_text(dar_json j, const char *key, const char *standard)
{
    cJSON *x = ask(j, key);
    if (x && cJSON_IsString(x)) return x->valuestring;
    if (x) fail_value(j, key, x, "a string");
    else if (!standard) missing(j, key, "a string");
    else enter(j, key, cJSON_CreateString(standard));
    return standard;
}

int dar_json_choice(dar_json j, const char *key, int standard, const char *const *names)
{
    char expected[256] = "one of";
    cJSON *x = ask(j, key);

    for (int i = 0; names[i]; i++) {
        size_t at = strlen(expected);
        if (x && cJSON_IsString(x) && strcmp(x->valuestring, names[i]) == 0) return i;
        snprintf(expected + at, sizeof expected - at, "%s %s", i ? "," : "", names[i]);
    }
    if (x) fail_value(j, key, x, expected);
    else if (standard < 0) missing(j, key, expected);
    else enter(j, key, cJSON_CreateString(names[standard]));
    return standard;
}

void dar_json_numbers(dar_json j, const char *key, double *x, size_t n)
{
    char expected[64];
    cJSON *a = ask(j, key);
    size_t i = 0;

    snprintf(expected, sizeof expected, "an array of %zu numbers", n);
    if (!a) {
        if (n && isnan(x[0])) missing(j, key, expected);
        else enter(j, key, cJSON_CreateDoubleArray(x, (int)n));
        return;
    }
    if (!cJSON_IsArray(a) || (size_t)cJSON_GetArraySize(a) != n) {
        fail_value(j, key, a, expected);
        return;
    }
    for (const cJSON *c = a->child; c; c = c->next)
        if (!cJSON_IsNumber(c)) {
            fail_value((dar_json){ j.doc, (cJSON *)(uintptr_t)c }, NULL, c, "a number");
            return;
        }
    for (const cJSON *c = a->child; c; c = c->next) x[i++] = c->valuedouble;
}

dar_json dar_json_object(dar_json j, const char *key)
{
    cJSON *x = ask(j, key);
    if (x && !cJSON_IsObject(x)) {
        fail_value(j, key, x, "an object");
        return (dar_json){ j.doc, NULL };
    }
    return (dar_json){ j.doc, x ? x : enter(j, key, cJSON_CreateObject()) };
}

dar_json dar_json_array(dar_json j, const char *key)
{
    cJSON *x = ask(j, key);
    if (x && !cJSON_IsArray(x)) {
        fail_value(j, key, x, "an array");
        return (dar_json){ j.doc, NULL };
    }
    return (dar_json){ j.doc, x ? x : enter(j, key, cJSON_CreateArray()) };
}

dar_json dar_json_get(dar_json j, const char *key)
{
    cJSON *x = ask(j, key);
    if (!x) enter(j, key, cJSON_CreateNull());
    return (dar_json){ j.doc, x };
}

dar_json dar_json_first(dar_json j)
{
    const cJSON *x = j.item;
    return (dar_json){ j.doc, x ? x->child : NULL };
}

dar_json dar_json_next(dar_json x)
{
    return (dar_json){ x.doc, ((const cJSON *)x.item)->next };
}

size_t dar_json_size(dar_json j)
{
    return j.item ? (size_t)cJSON_GetArraySize(j.item) : 0;
}

const char *dar_json_key(dar_json x)
{
    cJSON *c = x.item;
    c->type |= ASKED;
    return c->string ? c->string : "";
}

dar_json_kind dar_json_kind_of(dar_json j)
{
    const cJSON *x = j.item;
    if (!x || cJSON_IsNull(x)) return DAR_JSON_NULL;
    if (cJSON_IsBool(x)) return DAR_JSON_BOOL;
    if (cJSON_IsNumber(x)) return DAR_JSON_NUMBER;
    if (cJSON_IsString(x)) return DAR_JSON_TEXT;
    return cJSON_IsArray(x) ? DAR_JSON_ARRAY : DAR_JSON_OBJECT;
}

void dar_json_accept(dar_json j)
{
    if (j.item) ((cJSON *)j.item)->type |= ASKED | ACCEPT;
}

/* ---------------------------------------------------------------- */

/* The first member, in order, that nobody asked for; *owner is its object. */
static const cJSON *unasked(const cJSON *x, const cJSON **owner)
{
    if (x->type & ACCEPT) return NULL;
    for (const cJSON *c = x->child; c; c = c->next) {
        bool unknown = cJSON_IsObject(x) && !(c->type & ASKED);
        const cJSON *found = unknown ? c : unasked(c, owner);
        if (unknown) *owner = x;
        if (found) return found;
    }
    return NULL;
}

dar_status dar_json_finish(dar_json_doc *doc, dar_err *e)
{
    char path[320];
    const cJSON *owner = NULL, *x = doc->status == DAR_OK ? unasked(doc->root, &owner) : NULL;

    if (x) {
        dar_nearest near = dar_nearest_to(x->string);
        for (const cJSON *c = owner->child; c; c = c->next)
            if (c->type & ASKED) dar_nearest_try(&near, c->string);
        path_text(doc->root, x, NULL, path, sizeof path);
        doc->status = dar_fail(&doc->err, DAR_ERR_FORMAT, "%s: %s: unknown key%s%s%s", doc->name, path,
                               near.best ? "; did you mean '" : "", near.best ? near.best : "", near.best ? "'?" : "");
    }
    return doc->status == DAR_OK ? DAR_OK : dar_fail(e, doc->status, "%s", doc->err.text);
}

void dar_json_write_value(dar_json_writer *w, const char *key, dar_json j)
{
    const cJSON *x = j.item;

    if (!x || cJSON_IsNull(x)) {
        dar_json_write_null(w, key);
    } else if (cJSON_IsBool(x)) {
        dar_json_write_bool(w, key, cJSON_IsTrue(x));
    } else if (cJSON_IsNumber(x)) {
        dar_json_write_number(w, key, x->valuedouble);
    } else if (cJSON_IsString(x)) {
        dar_json_write_text(w, key, x->valuestring);
    } else {
        bool array = cJSON_IsArray(x);
        if (array) dar_json_write_array(w, key);
        else dar_json_write_object(w, key);
        for (cJSON *c = x->child; c; c = c->next)
            dar_json_write_value(w, array ? NULL : c->string, (dar_json){ j.doc, c });
        dar_json_write_end(w);
    }
}
