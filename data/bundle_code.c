/* bundle_code.c: families between the numbers that are stored and the values that they stand for. */
#include <math.h>
#include <string.h>

#include "data/bundle_inside.h"
#include "lib/thread.h"

#define CHUNK 16384 /* numbers of a task */
#define STRIP 256   /* numbers at a time */

const dar_bundle_family_info dar_bundle_table[DAR_BUNDLE_FAMILIES] = {
    [DAR_FAMILY_TRACKING] = { "tracking", "tracking", 3 },
    [DAR_FAMILY_WORLD] = { "world", "world_pos", 3 },
    [DAR_FAMILY_NORMAL] = { "normal", "normal", 3 },
    [DAR_FAMILY_DEPTH] = { "depth", "depth", 1 },
    [DAR_FAMILY_MASK] = { "mask", "mask", 1 },
    [DAR_FAMILY_SPARSE] = { "sparse", "sparse_tracking/map", 3 },
    [DAR_BUNDLE_ID] = { "id", "id", 1 },
    [DAR_BUNDLE_PART] = { "part", "part", 1 },
};

dar_bundle_store dar_bundle_store_of(int family, const dar_world *world, bool world_f32)
{
    static const dar_h5_type type[DAR_BUNDLE_FAMILIES] = {
        [DAR_FAMILY_TRACKING] = DAR_H5_U16, [DAR_FAMILY_WORLD] = DAR_H5_U16, [DAR_FAMILY_NORMAL] = DAR_H5_I16,
        [DAR_FAMILY_DEPTH] = DAR_H5_F32,    [DAR_FAMILY_MASK] = DAR_H5_U8,   [DAR_FAMILY_SPARSE] = DAR_H5_U8,
        [DAR_BUNDLE_ID] = DAR_H5_U32,       [DAR_BUNDLE_PART] = DAR_H5_U32,
    };
    static const double most[DAR_H5_TYPES] = { 255, 65535, 32767, 1, 1 };
    dar_bundle_store s = { .there = true, .type = type[family] };
    bool metric = family == DAR_FAMILY_WORLD;
    if (metric && world_f32) s.type = DAR_H5_F32;
    for (int c = 0; c < 3; c++) {
        bool map = metric && !world_f32;
        s.scale[c] = (map ? world->size : 1) / most[s.type];
        s.offset[c] = map ? world->centre[c] - world->size / 2 : 0;
    }
    return s;
}

dar_h5_array dar_bundle_array(int family, dar_h5_type type, const dar_bundle_meta *m)
{
    size_t channels = dar_bundle_table[family].channels;
    dar_h5_array a = { .type = type, .rank = channels > 1 ? 4 : 3, .dim = { m->frames, channels } };
    a.dim[a.rank - 2] = (uint64_t)m->height;
    a.dim[a.rank - 1] = (uint64_t)m->width;
    return a;
}

/* ---------------------------------------------------------------- encoding */

struct encoding {
    int family;
    const dar_bundle_store *store;
    const void *x;
    const uint8_t *mask;
    size_t pixels, channels;
    unsigned char *bytes;
};

/* n = round((x - offset) / scale), from lo to hi, in two bytes `stride` apart.  Returns how many values do not fit; not
 * a number is one of them. */
static size_t encode_16(const float *x, const uint8_t *mask, size_t n, const double map[2], const double range[2],
                        unsigned char *bytes, size_t stride)
{
    const double inverse = 1 / map[0], offset = map[1], lo = range[0] - 0.5, hi = range[1] + 0.5;
    unsigned bad = 0;
    for (size_t i = 0; i < n; i++) {
        double v = ((double)x[i] - offset) * inverse;
        bool on = mask[i] != 0, in = v >= lo && v < hi;
        int k = (int)((in && on ? v : 0) + 65536.5) - 65536; /* what is cut is positive */
        bad += on && !in;
        bytes[i] = (unsigned char)k;
        bytes[stride + i] = (unsigned char)(k >> 8);
    }
    return bad;
}

/* Four bytes, `stride` apart.  Returns how many are not finite, if they are floats. */
static size_t encode_32(const unsigned char *x, const uint8_t *mask, size_t n, bool is_float, unsigned char *bytes,
                        size_t stride)
{
    const uint32_t exponent = is_float ? 0x7f800000u : 0;
    unsigned bad = 0;
    for (size_t i = 0; i < n; i++) {
        uint32_t k;
        memcpy(&k, x + 4 * i, 4);
        k = mask[i] ? k : 0;
        bad += is_float && (k & exponent) == exponent;
        bytes[i] = (unsigned char)k;
        bytes[stride + i] = (unsigned char)(k >> 8);
        bytes[2 * stride + i] = (unsigned char)(k >> 16);
        bytes[3 * stride + i] = (unsigned char)(k >> 24);
    }
    return bad;
}

/* Pixels [at, at + n) of channel c. */
static size_t encode_run(const struct encoding *j, size_t c, size_t at, size_t n)
{
    static const double range[DAR_H5_TYPES][2] = { [DAR_H5_U16] = { 0, 65535 }, [DAR_H5_I16] = { -32767, 32767 } };
    const dar_bundle_store *s = j->store;
    const uint8_t *mask = j->mask + at;
    size_t first = c * j->pixels + at, stride = j->channels * j->pixels;
    const double map[2] = { s->scale[c], s->offset[c] };
    unsigned char *to = j->bytes + first;

    if (j->family == DAR_FAMILY_MASK) {
        for (size_t i = 0; i < n; i++) to[i] = mask[i] ? 255 : 0;
        return 0;
    }
    if (j->family == DAR_FAMILY_SPARSE) { /* squares of tracks reach over outlines */
        memcpy(to, (const uint8_t *)j->x + first, n);
        return 0;
    }
    if (s->type == DAR_H5_U16 || s->type == DAR_H5_I16)
        return encode_16((const float *)j->x + first, mask, n, map, range[s->type], to, stride);
    return encode_32((const unsigned char *)j->x + 4 * first, mask, n, s->type == DAR_H5_F32, to, stride);
}

static double encode_range(void *ctx, size_t begin, size_t end)
{
    const struct encoding *j = ctx;
    size_t bad = 0;
    while (begin < end) {
        size_t c = begin / j->pixels, at = begin % j->pixels, n = j->pixels - at;
        if (n > end - begin) n = end - begin;
        bad += encode_run(j, c, at, n);
        begin += n;
    }
    return (double)bad;
}

bool dar_bundle_encode(int family, const dar_bundle_store *s, const void *x, const uint8_t *mask, size_t pixels,
                       unsigned char *bytes, size_t *bad)
{
    size_t channels = dar_bundle_table[family].channels, n = channels * pixels;
    struct encoding j = { family, s, x, mask, pixels, channels, bytes };
    if (dar_parallel_sum(n, CHUNK, encode_range, &j) == 0) return true;
    for (*bad = 0; encode_range(&j, *bad, *bad + 1) == 0;) ++*bad;
    return false;
}

/* ---------------------------------------------------------------- decoding */

struct decoding {
    const dar_plane *plane;
    const uint8_t *cover;
    size_t pixels;
    float *y;
};

static void decode_range(void *ctx, size_t begin, size_t end, int thread)
{
    const struct decoding *j = ctx;
    double x[STRIP];
    (void)thread;
    while (begin < end) {
        size_t c = begin / j->pixels, at = begin % j->pixels, n = j->pixels - at;
        if (n > end - begin) n = end - begin;
        if (n > STRIP) n = STRIP;
        const double scale = j->plane->scale[c], offset = j->plane->offset[c];
        dar_plane_numbers(j->plane, begin, n, x);
        for (size_t i = 0; i < n; i++) j->y[begin + i] = (float)(scale * x[i] + offset);
        for (size_t i = 0; i < n && j->cover; i++) j->y[begin + i] = j->cover[at + i] ? j->y[begin + i] : 0;
        begin += n;
    }
}

void dar_bundle_decode(const dar_plane *p, size_t channels, const uint8_t *cover, size_t pixels, float *y)
{
    struct decoding j = { p, cover, pixels, y };
    dar_parallel_range(channels * pixels, CHUNK, decode_range, &j);
}

void dar_bundle_cover(const dar_plane *p, size_t pixels, uint8_t *cover)
{
    double x[STRIP];
    for (size_t at = 0; at < pixels; at += STRIP) {
        size_t n = pixels - at < STRIP ? pixels - at : STRIP;
        dar_plane_numbers(p, at, n, x);
        for (size_t i = 0; i < n; i++) cover[at + i] = p->scale[0] * x[i] + p->offset[0] > 0 ? 255 : 0;
    }
}
