/* gltf_accessor.c: views of buffers, and numbers in them.  Every range is checked once, when the accessor is looked
 * up; the loops that read then check values only. */
#include "data/gltf_file.h"

#include <math.h>
#include <string.h>

#include "data/meshopt.h"

/* Component types, numbered as in the file. */
enum { I8 = 5120, U8, I16, U16, I32, U32, F32 };

/* The most that the decoder makes of one byte: 64 in vertex buffers (a block of 16 equal bytes takes 2 bits), 12 in
 * index buffers. */
#define MESHOPT_GROWTH 64

/* ---------------------------------------------------------------- views */

/* byteOffset and byteLength of j, a range of its buffer. */
static dar_status range_of(dar_gltf *g, dar_json j, dar_gltf_bytes *out)
{
    int b = dar_gltf_index(g, j, "buffer", DAR_GLTF_BUFFERS);

    DAR_TRY(dar_gltf_check(g));
    if (b == DAR_NONE) return DAR_GLTF_REJECT(g, j, "buffer", "the index of a buffer");
    size_t whole = g->buffer[b].size;
    size_t offset = (size_t)dar_json_int(j, "byteOffset", 0, 0, DAR_JSON_MAX_INT);
    size_t length = dar_gltf_size(j, "byteLength", 1, SIZE_MAX);
    DAR_TRY(dar_gltf_check(g));
    if (offset > whole || length > whole - offset)
        return DAR_GLTF_REJECT(g, j, "byteLength", "at most %zu: byteOffset is %zu and the buffer has %zu bytes",
                               offset > whole ? 0 : whole - offset, offset, whole);
    out->data = g->buffer[b].data ? g->buffer[b].data + offset : NULL;
    out->size = length;
    return DAR_OK;
}

static dar_status unpack(dar_gltf *g, dar_json packed, dar_gltf_bytes *view)
{
    static const char *const modes[] = { "ATTRIBUTES", "TRIANGLES", "INDICES", NULL };
    static const char *const filters[] = { "NONE", "OCTAHEDRAL", "QUATERNION", "EXPONENTIAL", NULL };
    dar_gltf_bytes from = { 0 };
    unsigned char *out;

    DAR_TRY(range_of(g, packed, &from));
    int mode = dar_json_choice(packed, "mode", -1, modes);
    dar_meshopt_form form = {
        .mode = mode < 0 ? DAR_MESHOPT_ATTRIBUTES : (dar_meshopt_mode)mode,
        .filter = (dar_meshopt_filter)dar_json_choice(packed, "filter", 0, filters),
        .count = dar_gltf_size(packed, "count", 1, SIZE_MAX),
        .stride = dar_gltf_size(packed, "byteStride", 1, 256),
    };
    DAR_TRY(dar_gltf_check(g));
    const char *expected = dar_meshopt_check(&form);
    if (expected) return DAR_GLTF_REJECT(g, packed, NULL, "%s", expected);
    if (!from.data) return DAR_GLTF_REJECT(g, packed, "buffer", "one with data");
    if (form.count > view->size / form.stride || form.count > MESHOPT_GROWTH * from.size / form.stride)
        return DAR_GLTF_REJECT(g, packed, "count", "at most the %zu bytes of the view, and %d for each of %zu packed",
                               view->size, MESHOPT_GROWTH, from.size);
    DAR_TRY(dar_gltf_scratch(g, &out, form.count, form.stride));
    expected = dar_meshopt_decode(&form, from.data, from.size, out);
    if (expected) return DAR_GLTF_REJECT(g, packed, NULL, "%s", expected);
    view->data = out;
    view->size = form.count * form.stride;
    if (form.mode == DAR_MESHOPT_ATTRIBUTES) view->stride = form.stride;
    return DAR_OK;
}

dar_status dar_gltf_views(dar_gltf *g)
{
    size_t n = g->length[DAR_GLTF_VIEWS];

    DAR_TRY(dar_gltf_scratch(g, &g->view, n, sizeof *g->view));
    for (size_t i = 0; i < n; i++) {
        dar_json j = g->list[DAR_GLTF_VIEWS][i];
        DAR_TRY(range_of(g, j, &g->view[i]));
        g->view[i].stride = (size_t)dar_json_int(j, "byteStride", 0, 0, 252);
        DAR_TRY(dar_gltf_check(g));
        dar_json packed = dar_gltf_extension(j, "EXT_meshopt_compression");
        if (packed.item) DAR_TRY(unpack(g, packed, &g->view[i]));
    }
    return dar_gltf_check(g);
}

/* ---------------------------------------------------------------- accessors */

static size_t size_of(int type)
{
    static const unsigned char size[] = { 1, 1, 2, 2, 4, 4, 4 };
    return size[type - I8];
}

/* The part of j.bufferView, from j.byteOffset, that holds `count` elements of `size` bytes. */
static dar_status elements(dar_gltf *g, dar_json j, size_t count, size_t size, dar_gltf_bytes *out)
{
    int v = dar_gltf_index(g, j, "bufferView", DAR_GLTF_VIEWS);
    size_t offset = (size_t)dar_json_int(j, "byteOffset", 0, 0, DAR_JSON_MAX_INT);

    DAR_TRY(dar_gltf_check(g));
    if (v == DAR_NONE) return DAR_GLTF_REJECT(g, j, "bufferView", "the index of a view");
    const dar_gltf_bytes *view = &g->view[v];
    size_t stride = view->stride ? view->stride : size;
    if (!view->data) return DAR_GLTF_REJECT(g, j, "bufferView", "a view with data");
    if (stride < size)
        return DAR_GLTF_REJECT(g, j, "bufferView", "a byteStride of at least %zu, not %zu", size, stride);
    if (offset > view->size || view->size - offset < size || (view->size - offset - size) / stride < count - 1)
        return DAR_GLTF_REJECT(g, j, "bufferView",
                               "one of more than %zu bytes, for %zu elements of %zu, %zu apart, from %zu on",
                               view->size, count, size, stride, offset);
    *out = (dar_gltf_bytes){ .data = view->data + offset, .size = view->size - offset, .stride = stride };
    return DAR_OK;
}

static uint32_t index_at(const unsigned char *p, int type)
{
    if (type == U8) return *p;
    if (type == U16) return (uint32_t)(p[0] | p[1] << 8);
    uint32_t x;
    memcpy(&x, p, sizeof x);
    return x;
}

static bool is_index(int type)
{
    return type == U8 || type == U16 || type == U32;
}

static dar_status read_sparse(dar_gltf *g, dar_gltf_accessor *a)
{
    dar_json j = dar_json_get(a->json, "sparse");
    if (!j.item) return DAR_OK;
    dar_json index = dar_json_object(j, "indices"), value = dar_json_object(j, "values");

    a->sparse = dar_gltf_size(j, "count", 1, a->count);
    a->sparse_type = (int)dar_json_int(index, "componentType", 0, U8, U32);
    DAR_TRY(dar_gltf_check(g));
    if (!is_index(a->sparse_type)) return DAR_GLTF_REJECT(g, index, "componentType", "5121, 5123 or 5125");
    DAR_TRY(elements(g, index, a->sparse, size_of(a->sparse_type), &a->sparse_index));
    DAR_TRY(elements(g, value, a->sparse, size_of(a->type) * a->width, &a->sparse_value));
    for (size_t i = 0, next = 0; i < a->sparse; i++) {
        uint32_t at = index_at(a->sparse_index.data + i * a->sparse_index.stride, a->sparse_type);
        if (at < next || at >= a->count)
            return DAR_GLTF_REJECT(g, j, "indices", "rising indices below %zu: the one at %zu is %u", a->count, i, at);
        next = (size_t)at + 1;
    }
    return DAR_OK;
}

/* What of DAR_GLTF_FLOATS ... this accessor is. */
static unsigned kind_of(const dar_gltf_accessor *a)
{
    if (a->type == F32) return DAR_GLTF_FLOATS;
    if (a->type == U32) return a->normalized ? 0 : DAR_GLTF_UNSIGNED32;
    if (a->type == I32) return 0;
    if (a->normalized) return DAR_GLTF_NORMALIZED;
    return is_index(a->type) ? DAR_GLTF_UNSIGNED | DAR_GLTF_SIGNED : DAR_GLTF_SIGNED;
}

static dar_status check_kind(dar_gltf *g, const dar_gltf_accessor *a, const char *key, unsigned types)
{
    if (kind_of(a) & types) return DAR_OK;
    return DAR_GLTF_REJECT(g, a->json, "componentType", "one that fits %s:%s%s%s%s", key,
                           types & DAR_GLTF_FLOATS ? " 5126" : "",
                           types & DAR_GLTF_NORMALIZED ? " normalized 5120 to 5123" : "",
                           types & DAR_GLTF_SIGNED     ? " 5120 to 5123"
                           : types & DAR_GLTF_UNSIGNED ? " 5121 5123"
                                                       : "",
                           types & DAR_GLTF_UNSIGNED32 ? " 5125" : "");
}

dar_status dar_gltf_accessor_at(dar_gltf *g, dar_json j, const char *key, unsigned types, size_t lo, size_t hi,
                                dar_gltf_accessor *a)
{
    static const char *const names[] = { "SCALAR", "VEC2", "VEC3", "VEC4", "MAT4", NULL };
    static const size_t widths[] = { 1, 2, 3, 4, 16 };
    int i = dar_gltf_index(g, j, key, DAR_GLTF_ACCESSORS);

    DAR_TRY(dar_gltf_check(g));
    if (i == DAR_NONE) return DAR_GLTF_REJECT(g, j, key, "the index of an accessor");
    *a = (dar_gltf_accessor){ .json = g->list[DAR_GLTF_ACCESSORS][i] };
    int shape = dar_json_choice(a->json, "type", -1, names);
    a->count = dar_gltf_size(a->json, "count", 1, UINT32_MAX);
    a->type = (int)dar_gltf_size(a->json, "componentType", I8, F32);
    a->normalized = dar_json_bool(a->json, "normalized", false);
    DAR_TRY(dar_gltf_check(g));
    a->width = widths[shape];
    if (a->width < lo || a->width > hi)
        return DAR_GLTF_REJECT(g, a->json, "type", lo == hi ? "%zu numbers for %s" : "%zu or more numbers for %s", lo,
                               key);
    DAR_TRY(check_kind(g, a, key, types));
    if (dar_json_get(a->json, "bufferView").item)
        DAR_TRY(elements(g, a->json, a->count, size_of(a->type) * a->width, &a->at));
    else if (a->count > g->size)
        return DAR_GLTF_REJECT(g, a->json, "count", "at most the file's %zu bytes where there is no bufferView",
                               g->size);
    return read_sparse(g, a);
}

/* ---------------------------------------------------------------- reading */

static double number_at(const unsigned char *p, int type, bool normalized)
{
    float f;
    double x, most;

    switch (type) {
    case I8: x = (int8_t)*p, most = INT8_MAX; break;
    case U8: x = *p, most = UINT8_MAX; break;
    case I16: x = (int16_t)(p[0] | p[1] << 8), most = INT16_MAX; break;
    case U16: x = p[0] | p[1] << 8, most = UINT16_MAX; break;
    case U32: return index_at(p, U32);
    default: memcpy(&f, p, sizeof f); return f;
    }
    if (!normalized) return x;
    return x < -most ? -1 : x / most; /* the least signed integer would be below -1 */
}

/* One element into out; false if a number is not fit for use. */
static bool read_element(const dar_gltf_accessor *a, const unsigned char *p, float *out)
{
    size_t step = size_of(a->type);
    bool good = true;
    for (size_t c = 0; c < a->width; c++) {
        double x = number_at(p + c * step, a->type, a->normalized);
        good = good && fabs(x) <= DAR_GLTF_LARGEST;
        out[c] = (float)x;
    }
    return good;
}

static dar_status reject_element(dar_gltf *g, const dar_gltf_accessor *a, size_t i)
{
    return DAR_GLTF_REJECT(g, a->json, NULL, "finite numbers, none beyond %g: element %zu holds something else",
                           DAR_GLTF_LARGEST, i);
}

/* The place of sparse element k. */
static size_t replaced(const dar_gltf_accessor *a, size_t k)
{
    return index_at(a->sparse_index.data + k * a->sparse_index.stride, a->sparse_type);
}

/* The sparse element that replaces element i, NULL if none does. */
static const unsigned char *replacement(const dar_gltf_accessor *a, size_t i)
{
    size_t lo = 0, hi = a->sparse;
    while (lo < hi) {
        size_t mid = lo + (hi - lo) / 2;
        if (replaced(a, mid) < i) lo = mid + 1;
        else hi = mid;
    }
    return lo < a->sparse && replaced(a, lo) == i ? a->sparse_value.data + lo * a->sparse_value.stride : NULL;
}

dar_status dar_gltf_gather(dar_gltf *g, const dar_gltf_accessor *a, const uint32_t *at, size_t n, float *out)
{
    DAR_TRY(dar_gltf_spend(g, n));
    for (size_t k = 0; k < n; k++) {
        size_t i = at ? at[k] : k;
        const unsigned char *p = a->sparse ? replacement(a, i) : NULL;
        if (!p && a->at.data) p = a->at.data + i * a->at.stride;
        if (!p) memset(out + k * a->width, 0, a->width * sizeof *out);
        else if (!read_element(a, p, out + k * a->width)) return reject_element(g, a, i);
    }
    return DAR_OK;
}

dar_status dar_gltf_gather_u32(dar_gltf *g, const dar_gltf_accessor *a, uint32_t *out)
{
    size_t step = size_of(a->type);

    DAR_TRY(dar_gltf_spend(g, a->count));
    for (size_t i = 0; i < a->count; i++) {
        const unsigned char *p = a->sparse ? replacement(a, i) : NULL;
        if (!p && a->at.data) p = a->at.data + i * a->at.stride;
        for (size_t c = 0; c < a->width; c++) out[i * a->width + c] = p ? index_at(p + c * step, a->type) : 0;
    }
    return DAR_OK;
}
