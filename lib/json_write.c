/* json_write.c: the printer. */
#include "lib/json_write.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lib/status.h"

static void put(dar_json_writer *w, const char *s, size_t n)
{
    if (w->failed) return;
    if (n >= w->capacity - w->size) {
        size_t capacity = w->capacity ? w->capacity : 256;
        while (n >= capacity - w->size) capacity *= 2;
        char *text = realloc(w->text, capacity);
        if (!text) {
            w->failed = true;
            return;
        }
        w->text = text;
        w->capacity = capacity;
    }
    memcpy(w->text + w->size, s, n);
    w->size += n;
    w->text[w->size] = 0;
}

static void puts_text(dar_json_writer *w, const char *s)
{
    put(w, s, strlen(s));
}

static void put_line(dar_json_writer *w)
{
    put(w, "\n", 1);
    for (int i = 0; i < w->depth; i++) put(w, "    ", 4);
}

static void put_quoted(dar_json_writer *w, const char *s)
{
    const char *end = s + strlen(s);

    put(w, "\"", 1);
    while (s < end) {
        unsigned char c = (unsigned char)*s;
        size_t n = dar_json_utf8(s, end);
        if (!n) {
            puts_text(w, "\xef\xbf\xbd");
        } else if (c == '"' || c == '\\') {
            put(w, (char[]){ '\\', *s }, 2);
        } else if (c == '\n') {
            puts_text(w, "\\n");
        } else if (c < 0x20) {
            char escape[8];
            put(w, escape, (size_t)snprintf(escape, sizeof escape, "\\u%04x", c));
        } else {
            put(w, s, n);
        }
        s += n ? n : 1;
    }
    put(w, "\"", 1);
}

/* Comma, line and key before an element; `block`: it is an object or array. */
static void begin(dar_json_writer *w, const char *key, bool block)
{
    if (!w->depth) {
        DAR_ASSERT(!key, "json: key '%s' outside of an object", key);
        return;
    }
    uint64_t bit = (uint64_t)1 << (w->depth - 1);
    bool array = w->array & bit;
    DAR_ASSERT(array == !key, "json: %s in an %s", key ? key : "no key", array ? "array" : "object");

    if (w->begun & bit) put(w, ",", 1);
    if (w->pretty && (block || !array)) {
        put_line(w);
        w->broken |= bit;
    } else if (w->begun & bit) {
        put(w, " ", 1);
    }
    w->begun |= bit;
    if (key) {
        put_quoted(w, key);
        puts_text(w, ": ");
    }
}

static void open_level(dar_json_writer *w, const char *key, bool array)
{
    DAR_ASSERT(w->depth < DAR_JSON_DEPTH, "json: %d levels, at most %d", w->depth + 1, DAR_JSON_DEPTH);
    begin(w, key, true);
    put(w, array ? "[" : "{", 1);
    uint64_t bit = (uint64_t)1 << w->depth++;
    w->array = array ? w->array | bit : w->array & ~bit;
    w->begun &= ~bit;
    w->broken &= ~bit;
}

void dar_json_write_object(dar_json_writer *w, const char *key)
{
    open_level(w, key, false);
}

void dar_json_write_array(dar_json_writer *w, const char *key)
{
    open_level(w, key, true);
}

void dar_json_write_end(dar_json_writer *w)
{
    DAR_ASSERT(w->depth > 0, "json: nothing to end");
    uint64_t bit = (uint64_t)1 << --w->depth;
    if (w->broken & bit) put_line(w);
    put(w, w->array & bit ? "]" : "}", 1);
}

void dar_json_write_text(dar_json_writer *w, const char *key, const char *value)
{
    begin(w, key, false);
    put_quoted(w, value);
}

void dar_json_write_int(dar_json_writer *w, const char *key, int64_t value)
{
    char digits[32];
    begin(w, key, false);
    put(w, digits, (size_t)snprintf(digits, sizeof digits, "%lld", (long long)value));
}

void dar_json_write_number(dar_json_writer *w, const char *key, double value)
{
    char digits[32];
    begin(w, key, false);
    puts_text(w, isfinite(value) ? dar_json_number_text(value, digits) : "null");
}

void dar_json_write_bool(dar_json_writer *w, const char *key, bool value)
{
    begin(w, key, false);
    puts_text(w, value ? "true" : "false");
}

void dar_json_write_null(dar_json_writer *w, const char *key)
{
    begin(w, key, false);
    puts_text(w, "null");
}

void dar_json_writer_reset(dar_json_writer *w)
{
    w->size = 0;
    w->depth = 0;
    w->failed = false;
    if (w->text) w->text[0] = 0;
}

void dar_json_writer_free(dar_json_writer *w)
{
    free(w->text);
    *w = (dar_json_writer){ .pretty = w->pretty };
}

char *dar_json_number_text(double x, char buf[32])
{
    if (fabs(x) < 1e15 && x == floor(x) && !(x == 0 && signbit(x))) {
        snprintf(buf, 32, "%.0f", x); /* whole numbers without exponent */
        return buf;
    }
    for (int digits = 1; digits <= 17; digits++) {
        snprintf(buf, 32, "%.*g", digits, x);
        if (strtod(buf, NULL) == x) break;
    }
    return buf;
}

size_t dar_json_utf8(const char *p, const char *end)
{
    /* Smallest code point per length: what needs fewer bytes must not use more. */
    static const uint32_t least[] = { 0, 0, 0x80, 0x800, 0x10000 };
    unsigned char c = (unsigned char)*p;
    size_t n = c < 0x80 ? 1 : c >> 5 == 6 ? 2 : c >> 4 == 14 ? 3 : c >> 3 == 30 ? 4 : 0;

    if (n < 2) return n;
    if ((size_t)(end - p) < n) return 0;
    uint32_t code = c & (0x7fu >> n);
    for (size_t i = 1; i < n; i++) {
        if (((unsigned char)p[i] & 0xc0) != 0x80) return 0;
        code = code << 6 | ((unsigned char)p[i] & 0x3f);
    }
    return code < least[n] || code > 0x10ffff || (code >= 0xd800 && code < 0xe000) ? 0 : n;
}
