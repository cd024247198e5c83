/* json_scan.c: one state and one bit per level: what may come next. */
#include "lib/json_scan.h"

#include <stdint.h>
#include <stdio.h>
#include <string.h>

#include "lib/json_write.h"

#define NUMBER_MAX 63 /* characters; the tree builder cuts longer numbers in two */

/* What may come next. */
enum state { VALUE, VALUE_OR_END, KEY, KEY_OR_END, COLON, AFTER };

struct scan {
    char *text;
    size_t size, at;
    const char *wrong; /* what is wrong at `at` */
    char buf[96];
    enum state state;
    int depth;
    uint64_t array; /* one bit per level */
};

static bool refuse(struct scan *s, size_t at, const char *what)
{
    s->at = at;
    s->wrong = what;
    return false;
}

static char peek(const struct scan *s, size_t ahead)
{
    return ahead < s->size - s->at ? s->text[s->at + ahead] : 0;
}

static bool inside_array(const struct scan *s)
{
    return s->depth && s->array >> (s->depth - 1) & 1;
}

static bool unexpected(struct scan *s)
{
    static const char *const expected[] = {
        [VALUE] = "a value",       [VALUE_OR_END] = "a value or ']'",
        [KEY] = "a key in quotes", [KEY_OR_END] = "a key in quotes or '}'",
        [COLON] = "':'",
    };
    const char *p = s->text + s->at;
    unsigned char c = (unsigned char)*p;
    const char *want = s->state != AFTER ? expected[s->state]
                       : !s->depth       ? "nothing more"
                       : inside_array(s) ? "',' or ']'"
                                         : "',' or '}'";
    if (c < 0x20) snprintf(s->buf, sizeof s->buf, "unexpected character %d, expected %s", c, want);
    else
        snprintf(s->buf, sizeof s->buf, "unexpected '%.*s', expected %s", (int)dar_json_utf8(p, s->text + s->size), p,
                 want);
    return refuse(s, s->at, s->buf);
}

static bool skip_comment(struct scan *s)
{
    size_t start = s->at, end = start + 2;
    bool block = peek(s, 1) == '*';

    if (!block && peek(s, 1) != '/') return unexpected(s);
    while (end < s->size &&
           (block ? s->text[end] != '*' || end + 1 >= s->size || s->text[end + 1] != '/' : s->text[end] != '\n'))
        end++;
    if (block && end >= s->size) return refuse(s, start, "comment without end");
    if (block) end += 2;
    for (size_t i = start; i < end; i++)
        if (s->text[i] != '\n') s->text[i] = ' ';
    s->at = end;
    return true;
}

/* The four digits of \uXXXX, or -1. */
static int hex4(const struct scan *s, size_t ahead)
{
    int value = 0;
    for (size_t i = 0; i < 4; i++) {
        char c = peek(s, ahead + i);
        int digit = c >= '0' && c <= '9' ? c - '0' : (c | 32) >= 'a' && (c | 32) <= 'f' ? (c | 32) - 'a' + 10 : -1;
        if (digit < 0) return -1;
        value = value << 4 | digit;
    }
    return value;
}

static bool skip_escape(struct scan *s)
{
    char c = peek(s, 1);

    if (c != 'u') {
        if (!c || !strchr("\"\\/bfnrt", c)) return refuse(s, s->at, "unknown escape in a string");
        s->at += 2;
        return true;
    }
    int code = hex4(s, 2), low = peek(s, 6) == '\\' && peek(s, 7) == 'u' ? hex4(s, 8) : -1;
    bool high = code >= 0xd800 && code < 0xdc00;
    if (code < 0) return refuse(s, s->at, "\\u without four hexadecimal digits");
    if (code == 0) return refuse(s, s->at, "\\u0000 in a string");
    if ((code >= 0xdc00 && code < 0xe000) || (high && (low < 0xdc00 || low >= 0xe000)))
        return refuse(s, s->at, "half of a surrogate pair");
    s->at += high ? 12 : 6;
    return true;
}

static bool skip_string(struct scan *s)
{
    size_t start = s->at++;
    while (s->at < s->size && s->text[s->at] != '"') {
        if ((unsigned char)s->text[s->at] < 0x20) return refuse(s, s->at, "control character in a string");
        if (s->text[s->at] != '\\') s->at++;
        else if (!skip_escape(s)) return false;
    }
    if (s->at >= s->size) return refuse(s, start, "string without end");
    s->at++;
    return true;
}

static size_t skip_digits(struct scan *s)
{
    size_t start = s->at;
    while (peek(s, 0) >= '0' && peek(s, 0) <= '9') s->at++;
    return s->at - start;
}

static bool skip_number(struct scan *s)
{
    size_t start = s->at;

    if (peek(s, 0) == '-') s->at++;
    bool zero = peek(s, 0) == '0';
    size_t digits = skip_digits(s);
    bool good = digits == 1 || (digits && !zero);
    if (good && peek(s, 0) == '.') {
        s->at++;
        good = skip_digits(s) > 0;
    }
    if (good && (peek(s, 0) | 32) == 'e') {
        s->at++;
        if (peek(s, 0) == '+' || peek(s, 0) == '-') s->at++;
        good = skip_digits(s) > 0;
    }
    if (!good) return refuse(s, start, "not a number as JSON writes them");
    if (s->at - start > NUMBER_MAX) return refuse(s, start, "number of more than 63 characters");
    return true;
}

static bool skip_word(struct scan *s)
{
    static const char *const words[] = { "true", "false", "null" };
    for (size_t i = 0; i < 3; i++) {
        size_t n = strlen(words[i]);
        if (s->size - s->at < n || memcmp(s->text + s->at, words[i], n) != 0) continue;
        s->at += n;
        return true;
    }
    return unexpected(s);
}

static bool push(struct scan *s, bool array)
{
    if (s->depth == DAR_JSON_DEPTH) return refuse(s, s->at, "more than 64 levels");
    uint64_t bit = (uint64_t)1 << s->depth++;
    s->array = array ? s->array | bit : s->array & ~bit;
    s->state = array ? VALUE_OR_END : KEY_OR_END;
    s->at++;
    return true;
}

/* A closing bracket; it must be the one that belongs here. */
static bool pop(struct scan *s)
{
    if (!s->depth || (s->text[s->at] == ']') != inside_array(s)) return unexpected(s);
    s->depth--;
    s->state = AFTER;
    s->at++;
    return true;
}

static bool value(struct scan *s, char c)
{
    if (c == '{' || c == '[') return push(s, c == '[');
    if (c == ']' && s->state == VALUE_OR_END) return pop(s);
    bool good = c == '"' ? skip_string(s) : c == '-' || (c >= '0' && c <= '9') ? skip_number(s) : skip_word(s);
    s->state = AFTER;
    return good;
}

static bool token(struct scan *s, char c)
{
    switch (s->state) {
    case VALUE:
    case VALUE_OR_END: return value(s, c);
    case KEY:
    case KEY_OR_END:
        if (c == '}' && s->state == KEY_OR_END) return pop(s);
        if (c != '"') return unexpected(s);
        s->state = COLON;
        return skip_string(s);
    case COLON:
        if (c != ':') return unexpected(s);
        s->state = VALUE;
        s->at++;
        return true;
    case AFTER:
        if (c == ']' || c == '}') return pop(s);
        if (c != ',' || !s->depth) return unexpected(s);
        s->state = inside_array(s) ? VALUE : KEY;
        s->at++;
        return true;
    }
    return false;
}

static bool run(struct scan *s)
{
    for (const char *p = s->text, *end = p + s->size; p < end;) {
        size_t n = dar_json_utf8(p, end);
        if (!n) return refuse(s, (size_t)(p - s->text), "not UTF-8");
        p += n;
    }
    if (s->size >= 3 && memcmp(s->text, "\xef\xbb\xbf", 3) == 0) memset(s->text, ' ', 3); /* byte order mark */
    while (s->at < s->size) {
        char c = s->text[s->at];
        if (c == ' ' || c == '\n' || c == '\r' || c == '\t') s->at++;
        else if (c == '/' ? !skip_comment(s) : !token(s, c)) return false;
    }
    return (s->state == AFTER && !s->depth) || refuse(s, s->size, "ends too early");
}

bool dar_json_scan(char *text, size_t size, size_t *at, char what[DAR_JSON_WHAT])
{
    struct scan s = { .text = text, .size = size };
    bool good = run(&s);
    *at = s.at;
    snprintf(what, DAR_JSON_WHAT, "%s", good ? "" : s.wrong);
    return good;
}
