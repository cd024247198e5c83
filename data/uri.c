/* uri.c: base64 (RFC 4648, section 4) and relative references (RFC 3986, section 4.2). */
#include "data/uri.h"

#include <stdio.h>
#include <string.h>
#include <strings.h>

#define PLAIN_PATH "a relative path without \"..\", or base64 data"

bool dar_uri_is_data(const char *uri)
{
    return strncasecmp(uri, "data:", 5) == 0;
}

/* Value of a base64 digit, -1 if it is none. */
static int digit64(char c)
{
    if (c >= 'A' && c <= 'Z') return c - 'A';
    if (c >= 'a' && c <= 'z') return c - 'a' + 26;
    if (c >= '0' && c <= '9') return c - '0' + 52;
    return c == '+' ? 62 : c == '/' ? 63 : -1;
}

const char *dar_uri_decode(const char *uri, unsigned char *out, size_t *size)
{
    const char *comma = strchr(uri, ','), *p;
    size_t n = 0, digits = 0;
    unsigned bits = 0;

    *size = 0;
    if (!comma || comma - uri < 7 || strncasecmp(comma - 7, ";base64", 7) != 0) return "data:...;base64,...";
    for (p = comma + 1; *p && *p != '='; p++, digits++) {
        int d = digit64(*p);
        if (d < 0) return "base64 data";
        bits = bits << 6 | (unsigned)d;
        if (digits % 4) out[n++] = (unsigned char)(bits >> (6 - 2 * (digits % 4)));
    }
    size_t padding = strspn(p, "=");
    if (p[padding] || digits % 4 == 1 || (padding && (digits + padding) % 4) || padding > 2) return "base64 data";
    *size = n;
    return NULL;
}

static int digit16(char c)
{
    if (c >= '0' && c <= '9') return c - '0';
    if (c >= 'a' && c <= 'f') return c - 'a' + 10;
    return c >= 'A' && c <= 'F' ? c - 'A' + 10 : -1;
}

/* Whether one part of the path, the n bytes at p, leads upwards. */
static bool is_parent(const char *p, size_t n)
{
    return n == 2 && p[0] == '.' && p[1] == '.';
}

const char *dar_uri_path(const char *uri, const char *base, char out[PATH_MAX])
{
    const char *slash = strrchr(base, '/');
    size_t n = slash ? (size_t)(slash - base) + 1 : 0, start = n;

    if (n >= PATH_MAX) return "a shorter path";
    memcpy(out, base, n);
    for (const char *p = uri; *p; p++) {
        unsigned char c = (unsigned char)*p;
        if (c == '%') {
            int hi = digit16(p[1]), lo = hi < 0 ? -1 : digit16(p[2]);
            if (lo < 0) return "two hexadecimal digits after '%'";
            c = (unsigned char)(hi << 4 | lo);
            p += 2;
        } else if (c == ':') {
            return PLAIN_PATH; /* a scheme or a drive */
        }
        if (c < 0x20 || c == 0x7f || c == '\\') return PLAIN_PATH;
        if (n + 1 >= PATH_MAX) return "a shorter path";
        out[n++] = (char)c;
    }
    out[n] = 0;
    if (n == start || out[start] == '/') return PLAIN_PATH;
    for (const char *p = out + start; *p;) {
        size_t part = strcspn(p, "/");
        if (is_parent(p, part)) return PLAIN_PATH;
        p += part + (p[part] == '/');
    }
    return NULL;
}
