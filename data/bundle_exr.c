/* bundle_exr.c: families and the passes that renderers name differently. */
#include "data/bundle_exr.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/bundle.h"
#include "lib/dtype.h"

static const struct pass {
    int family;
    const char *name, *component; /* one letter per channel; the first pass of a family is the one written */
} passes[] = {
    { DAR_FAMILY_TRACKING, "tracking", "RGB" },
    { DAR_FAMILY_WORLD, "world_pos", "XYZ" },
    { DAR_FAMILY_WORLD, "Position", "XYZ" },
    { DAR_FAMILY_NORMAL, "normal", "XYZ" },
    { DAR_FAMILY_DEPTH, "depth", "Z" },
    { DAR_FAMILY_DEPTH, "", "Z" },
    { DAR_BUNDLE_ID, "id", "X" },
    { DAR_BUNDLE_ID, "IndexOB", "X" },
    { DAR_BUNDLE_PART, "part", "X" },
};

static int find(const dar_exr *x, const struct pass *p, size_t channel)
{
    const char component[2] = { p->component[channel] };
    return dar_exr_find(x, p->name, component);
}

/* The pass that holds a family; NULL: none. */
static const struct pass *pass_of(const dar_exr *x, int family)
{
    for (size_t i = 0; i < DAR_COUNT(passes); i++) {
        bool whole = passes[i].family == family;
        for (size_t c = 0; whole && passes[i].component[c]; c++) whole = find(x, &passes[i], c) >= 0;
        if (whole) return &passes[i];
    }
    return NULL;
}

unsigned dar_bundle_exr_families(const dar_exr *x)
{
    unsigned families = 0;
    for (int f = 0; f < DAR_BUNDLE_FAMILIES; f++) families |= (unsigned)(pass_of(x, f) != NULL) << f;
    if (families & (1u << DAR_BUNDLE_ID | 1u << DAR_FAMILY_DEPTH)) families |= 1u << DAR_FAMILY_MASK;
    return families;
}

/* ---------------------------------------------------------------- reading */

/* One channel, of any type, as f32 or as u32.  Halves are read into the end and spread from the front. */
static dar_status read_channel(dar_exr *x, int channel, size_t pixels, void *to, bool number, dar_err *e)
{
    dar_exr_type type = dar_exr_type_of(x, (size_t)channel);
    unsigned char *out = to, *raw = type == DAR_EXR_F16 ? out + 2 * pixels : out;
    DAR_TRY(dar_exr_read(x, (size_t)channel, raw, e));
    if (type == (number ? DAR_EXR_U32 : DAR_EXR_F32)) return DAR_OK;
    for (size_t i = 0; i < pixels; i++) {
        uint16_t h;
        uint32_t k = 0;
        float v = 0;
        if (type == DAR_EXR_F16) memcpy(&h, raw + 2 * i, 2), v = dar_f16_to_f32(h);
        if (type == DAR_EXR_F32) memcpy(&v, raw + 4 * i, 4);
        if (type == DAR_EXR_U32) memcpy(&k, raw + 4 * i, 4), v = (float)k;
        k = v >= 0 && v < 0x1p32f ? (uint32_t)v : 0;
        memcpy(out + 4 * i, number ? (void *)&k : (void *)&v, 4);
    }
    return DAR_OK;
}

static dar_status read_pass(dar_exr *x, const char *path, int family, void *to, dar_err *e)
{
    const struct pass *p = pass_of(x, family);
    size_t pixels = dar_exr_width(x) * dar_exr_height(x);
    if (!p) return dar_fail(e, DAR_ERR_FORMAT, "%s: found no channels of %s", path, dar_bundle_table[family].name);
    for (size_t c = 0; p->component[c]; c++)
        DAR_TRY(
            read_channel(x, find(x, p, c), pixels, (unsigned char *)to + 4 * c * pixels, family >= DAR_FAMILIES, e));
    return DAR_OK;
}

/* cover [pixels], 1 where a surface is; scratch [pixels] of four bytes. */
static dar_status read_cover(dar_exr *x, const char *path, uint8_t *cover, void *scratch, dar_err *e)
{
    size_t pixels = dar_exr_width(x) * dar_exr_height(x);
    if (pass_of(x, DAR_BUNDLE_ID)) {
        const uint32_t *id = scratch;
        DAR_TRY(read_pass(x, path, DAR_BUNDLE_ID, scratch, e));
        for (size_t i = 0; i < pixels; i++) cover[i] = id[i] != 0;
    } else if (pass_of(x, DAR_FAMILY_DEPTH)) {
        const float *z = scratch;
        DAR_TRY(read_pass(x, path, DAR_FAMILY_DEPTH, scratch, e));
        for (size_t i = 0; i < pixels; i++) cover[i] = z[i] > 0 && z[i] < DAR_BUNDLE_EXR_FAR;
    } else {
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found no channels of id or depth: what is background cannot be told",
                        path);
    }
    return DAR_OK;
}

/* Averaged normals of renderers are too short. */
static void make_unit(float *n, size_t pixels)
{
    for (size_t i = 0; i < pixels; i++) {
        double x = (double)n[i], y = (double)n[pixels + i], z = (double)n[2 * pixels + i];
        double r = sqrt(x * x + y * y + z * z);
        if (!(r > 0)) continue;
        n[i] = (float)(x / r), n[pixels + i] = (float)(y / r), n[2 * pixels + i] = (float)(z / r);
    }
}

static dar_status read_all(dar_exr *x, const char *path, const dar_gbuffer *g, uint8_t *cover, dar_err *e)
{
    size_t pixels = dar_exr_width(x) * dar_exr_height(x);
    const struct {
        int family;
        void *to;
    } want[] = {
        { DAR_FAMILY_TRACKING, g->tracking }, { DAR_FAMILY_WORLD, g->world }, { DAR_FAMILY_NORMAL, g->normal },
        { DAR_FAMILY_DEPTH, g->depth },       { DAR_BUNDLE_ID, g->instance }, { DAR_BUNDLE_PART, g->part },
    };
    for (size_t i = 0; i < DAR_COUNT(want); i++) {
        unsigned char *to = want[i].to;
        if (!to) continue;
        DAR_TRY(read_pass(x, path, want[i].family, to, e));
        for (size_t k = 0; k < dar_bundle_table[want[i].family].channels * pixels; k++)
            if (!cover[k % pixels]) memset(to + 4 * k, 0, 4);
    }
    if (g->normal) make_unit(g->normal, pixels);
    if (g->mask) memcpy(g->mask, cover, pixels);
    return DAR_OK;
}

dar_status dar_bundle_exr_read(dar_exr *x, const char *path, const dar_gbuffer *g, dar_err *e)
{
    size_t pixels = dar_exr_width(x) * dar_exr_height(x);
    unsigned char *scratch = malloc(5 * pixels);
    if (!scratch) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory for %zu pixels", path, pixels);
    uint8_t *cover = scratch + 4 * pixels;
    dar_status s = read_cover(x, path, cover, scratch, e);
    if (s == DAR_OK) s = read_all(x, path, g, cover, e);
    free(scratch);
    return s;
}

/* ---------------------------------------------------------------- writing */

dar_status dar_bundle_exr_write(const char *path, size_t width, size_t height, const dar_gbuffer *g,
                                dar_exr_compression compression, dar_err *e)
{
    const void *const data[DAR_BUNDLE_FAMILIES] = {
        [DAR_FAMILY_TRACKING] = g->tracking, [DAR_FAMILY_WORLD] = g->world, [DAR_FAMILY_NORMAL] = g->normal,
        [DAR_FAMILY_DEPTH] = g->depth,       [DAR_BUNDLE_ID] = g->instance, [DAR_BUNDLE_PART] = g->part,
    };
    char name[3 * DAR_COUNT(passes)][16];
    dar_exr_plane plane[3 * DAR_COUNT(passes)];
    size_t n = 0;
    for (size_t i = 0; i < DAR_COUNT(passes); i++) {
        int f = passes[i].family;
        if (!data[f] || (i && passes[i - 1].family == f)) continue;
        for (size_t c = 0; passes[i].component[c]; c++, n++) {
            snprintf(name[n], sizeof name[n], "%s.%c", passes[i].name, passes[i].component[c]);
            plane[n] = (dar_exr_plane){ name[n], f >= DAR_FAMILIES ? DAR_EXR_U32 : DAR_EXR_F32,
                                        (const unsigned char *)data[f] + 4 * c * width * height };
        }
    }
    DAR_ASSERT(n > 0, "%s: no families", path);
    return dar_exr_write(path, width, height, plane, n, &(dar_exr_how){ .compression = compression }, e);
}
