/* obj.c: one OBJ file.  Read twice: first to count, then into memory of that size. */
#include "data/obj.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define LARGEST 1e12
#define POLYGON 65536
#define EARS    512 /* corners of a polygon whose ears are cut, which takes cubic time at worst */

struct reader {
    dar_obj *o;
    const char *path, *p, *end; /* end: of the line */
    const char *stop;           /* of the file */
    size_t line;
    bool counting;
    dar_err *err;
};

/* ---------------------------------------------------------------- text */

static dar_status bad(const struct reader *r, const char *expected)
{
    size_t n = (size_t)(r->end - r->p) < 24 ? (size_t)(r->end - r->p) : 24;
    return dar_fail(r->err, DAR_ERR_FORMAT, "%s:%zu: found \"%.*s\", expected %s", r->path, r->line, (int)n, r->p,
                    expected);
}

static bool is_space(char c)
{
    return c == ' ' || c == '\t' || c == '\r';
}

/* Set p and end to the next line; false behind the last. */
static bool next_line(struct reader *r)
{
    if (r->line) r->p = r->end < r->stop ? r->end + 1 : r->stop;
    if (r->p == r->stop) return false;
    const char *newline = memchr(r->p, '\n', (size_t)(r->stop - r->p));
    r->end = newline ? newline : r->stop;
    r->line++;
    return true;
}

static void skip_space(struct reader *r)
{
    while (r->p < r->end && is_space(*r->p)) r->p++;
}

/* Whether the line goes on with this word; passes it. */
static bool word(struct reader *r, const char *w)
{
    size_t n = strlen(w), left = (size_t)(r->end - r->p);
    if (left < n || memcmp(r->p, w, n) != 0 || (left > n && !is_space(r->p[n]))) return false;
    r->p += n;
    return true;
}

/* Digits and exponent of up to 15 digits give the exact double by one product or quotient; the rest is strtod's. */
static bool exact_number(const char *p, size_t n, double *x)
{
    static const double power[] = { 1e0,  1e1,  1e2,  1e3,  1e4,  1e5,  1e6,  1e7,  1e8,  1e9,  1e10, 1e11,
                                    1e12, 1e13, 1e14, 1e15, 1e16, 1e17, 1e18, 1e19, 1e20, 1e21, 1e22 };
    size_t i = n && (*p == '-' || *p == '+'), digits = 0, behind = 0;
    double m = 0;
    bool point = false;
    for (; i < n; i++) {
        if (p[i] == '.' && !point) {
            point = true;
            continue;
        }
        if (p[i] < '0' || p[i] > '9' || ++digits > 15) return false;
        m = 10 * m + (p[i] - '0');
        behind += point;
    }
    *x = (*p == '-' ? -m : m) / power[behind];
    return digits > 0;
}

static dar_status number(struct reader *r, float *out)
{
    char buf[64], *last;
    double x;

    skip_space(r);
    size_t n = 0;
    while (r->p + n < r->end && !is_space(r->p[n])) n++;
    if (!n || n >= sizeof buf) return bad(r, "a number");
    if (!exact_number(r->p, n, &x)) {
        memcpy(buf, r->p, n);
        buf[n] = 0;
        x = strtod(buf, &last);
        if (*last) return bad(r, "a number");
    }
    if (!(fabs(x) <= LARGEST)) return bad(r, "a finite number, at most 1e12");
    *out = (float)x;
    r->p += n;
    return DAR_OK;
}

static dar_status three(struct reader *r, float *list, size_t *n)
{
    float x[3];
    for (int c = 0; c < 3; c++) DAR_TRY(number(r, &x[c]));
    if (!r->counting) memcpy(list + 3 * *n, x, sizeof x);
    ++*n;
    return DAR_OK;
}

/* An index from 1, or from -1 backwards, among n so far; *out from 0. */
static dar_status index_of(struct reader *r, size_t n, const char *what, uint32_t *out)
{
    const char *start = r->p;
    bool back = r->p < r->end && *r->p == '-';
    size_t i = 0;

    for (r->p += back; r->p < r->end && *r->p >= '0' && *r->p <= '9' && i <= UINT32_MAX; r->p++)
        i = 10 * i + (size_t)(*r->p - '0');
    if (i && i <= n) {
        *out = (uint32_t)(back ? n - i : i - 1);
        return DAR_OK;
    }
    r->p = start;
    return bad(r, what);
}

/* ---------------------------------------------------------------- faces */

/* v, v/vt, v//vn or v/vt/vn */
static dar_status corner(struct reader *r, uint32_t *vertex, uint32_t *normal)
{
    *normal = DAR_OBJ_NONE;
    DAR_TRY(index_of(r, r->o->vertices, "the index of a vertex before it", vertex));
    if (r->p == r->end || *r->p != '/') return DAR_OK;
    for (r->p++; r->p < r->end && (*r->p == '-' || (*r->p >= '0' && *r->p <= '9'));) r->p++;
    if (r->p == r->end || *r->p != '/') return DAR_OK;
    r->p++;
    return index_of(r, r->o->normals, "the index of a normal before it", normal);
}

static dar_status face(struct reader *r)
{
    dar_obj *o = r->o;
    size_t first = o->corners;
    const char *start = r->p;

    for (skip_space(r); r->p < r->end; skip_space(r)) {
        uint32_t v, n;
        DAR_TRY(corner(r, &v, &n));
        if (r->p < r->end && !is_space(*r->p)) return bad(r, "v, v/vt, v//vn or v/vt/vn");
        if (!r->counting) o->corner[o->corners] = v, o->corner_normal[o->corners] = n;
        o->has_normals &= n != DAR_OBJ_NONE;
        o->corners++;
    }
    if (o->corners - first < 3 || o->corners - first > POLYGON) {
        r->p = start;
        return bad(r, "a face of 3 to 65536 corners");
    }
    if (!r->counting) o->face_end[o->faces] = (uint32_t)o->corners;
    o->faces++;
    return DAR_OK;
}

static dar_status read_lines(struct reader *r)
{
    dar_obj *o = r->o;
    o->vertices = o->normals = o->corners = o->faces = o->points_and_lines = 0;
    o->has_normals = true;
    r->line = 0;
    while (next_line(r)) {
        skip_space(r);
        if (word(r, "v")) DAR_TRY(three(r, o->vertex, &o->vertices));
        else if (word(r, "vn")) DAR_TRY(three(r, o->normal, &o->normals));
        else if (word(r, "f")) DAR_TRY(face(r));
        else if (word(r, "p") || word(r, "l")) o->points_and_lines++;
    }
    o->has_normals &= o->corners > 0;
    return DAR_OK;
}

dar_status dar_obj_parse(dar_obj *o, const char *path, const void *data, size_t size, dar_err *e)
{
    const char *text = size ? data : "";
    struct reader r = { .o = o, .path = path, .p = text, .stop = text + size, .counting = true, .err = e };

    *o = (dar_obj){ 0 };
    DAR_TRY(read_lines(&r));
    if (o->corners >= UINT32_MAX || o->vertices >= UINT32_MAX)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %zu vertices and %zu corners, expected fewer than 2^32", path,
                        o->vertices, o->corners);
    size_t rows = o->vertices + o->normals, words = 3 * rows + 2 * o->corners + o->faces;
    DAR_TRY(dar_arena_init(&o->memory, "OBJ file", 4 * words + 5 * DAR_ALIGN, e));
    o->vertex = dar_arena_push(&o->memory, o->vertices * 12);
    o->normal = dar_arena_push(&o->memory, o->normals * 12);
    o->corner = dar_arena_push(&o->memory, o->corners * 4);
    o->corner_normal = dar_arena_push(&o->memory, o->corners * 4);
    o->face_end = dar_arena_push(&o->memory, o->faces * 4);
    r.p = text;
    r.counting = false;
    return read_lines(&r);
}

void dar_obj_free(dar_obj *o)
{
    dar_arena_free(&o->memory);
    *o = (dar_obj){ 0 };
}

/* ---------------------------------------------------------------- polygons */

/* A polygon projected along its normal's largest direction: corner i is at (x, y). */
struct flat {
    const float *vertex;
    const uint32_t *corner;
    int x, y;
    double sign; /* so that it runs counter-clockwise */
};

/* Newell's normal tells where to look from. */
static struct flat flatten(const float *vertex, const uint32_t *c, size_t n)
{
    double normal[3] = { 0 };
    for (size_t i = 0; i < n; i++) {
        const float *a = vertex + 3 * (size_t)c[i], *b = vertex + 3 * (size_t)c[(i + 1) % n];
        for (int k = 0; k < 3; k++) {
            int u = (k + 1) % 3, v = (k + 2) % 3;
            normal[k] += ((double)a[u] - b[u]) * ((double)a[v] + b[v]);
        }
    }
    int k = fabs(normal[0]) > fabs(normal[1]) ? 0 : 1;
    if (fabs(normal[2]) > fabs(normal[k])) k = 2;
    return (struct flat){ vertex, c, (k + 1) % 3, (k + 2) % 3, normal[k] < 0 ? -1 : 1 };
}

/* Twice the area of corners i, j, k, positive if they turn left. */
static double turn(const struct flat *f, size_t i, size_t j, size_t k)
{
    const float *a = f->vertex + 3 * (size_t)f->corner[i], *b = f->vertex + 3 * (size_t)f->corner[j];
    const float *c = f->vertex + 3 * (size_t)f->corner[k];
    return f->sign * (((double)b[f->x] - a[f->x]) * ((double)c[f->y] - a[f->y]) -
                      ((double)b[f->y] - a[f->y]) * ((double)c[f->x] - a[f->x]));
}

/* Whether the corner at place i of the n left can be cut: it turns left and no other lies inside. */
static bool is_ear(const struct flat *f, const uint32_t *left, size_t n, size_t i)
{
    size_t a = left[(i + n - 1) % n], b = left[i], c = left[(i + 1) % n];
    if (!(turn(f, a, b, c) > 0)) return false;
    for (size_t k = 0; k < n; k++) {
        size_t v = left[k];
        if (v == a || v == b || v == c) continue;
        if (turn(f, a, b, v) >= 0 && turn(f, b, c, v) >= 0 && turn(f, c, a, v) >= 0) return false;
    }
    return true;
}

void dar_obj_triangulate(const float *vertex, const uint32_t *c, size_t n, uint32_t *left, uint32_t *out)
{
    struct flat f = flatten(vertex, c, n);
    bool convex = true;

    for (size_t i = 0; i < n && n > 3; i++) convex &= turn(&f, i, (i + 1) % n, (i + 2) % n) >= 0;
    for (size_t i = 0; i < n; i++) left[i] = (uint32_t)i;
    for (size_t k = 0, tried; n > 3 && n <= EARS && !convex; k = k < n ? k : 0) {
        for (tried = 0; tried < n && !is_ear(&f, left, n, k); tried++) k = (k + 1) % n;
        if (tried == n) break; /* it crosses itself: what is left becomes a fan */
        *out++ = left[(k + n - 1) % n];
        *out++ = left[k];
        *out++ = left[(k + 1) % n];
        n--;
        memmove(left + k, left + k + 1, (n - k) * sizeof *left);
    }
    for (size_t i = 2; i < n; i++) {
        *out++ = left[0];
        *out++ = left[i - 1];
        *out++ = left[i];
    }
}
