/* condition.c: channel sets and the condition tensor. */
#include "data/condition.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#include "data/affine.h"
#include "data/rigid.h"
#include "lib/nearest.h"
#include "lib/thread.h"

#define STRIP 256   /* pixels at a time */
#define CHUNK 16384 /* pixels per task */

const dar_family_info dar_family_table[DAR_FAMILIES] = {
    [DAR_FAMILY_TRACKING] = { "tracking", 3, true }, [DAR_FAMILY_WORLD] = { "world", 3, false },
    [DAR_FAMILY_NORMAL] = { "normal", 3, false },    [DAR_FAMILY_DEPTH] = { "depth", 1, false },
    [DAR_FAMILY_MASK] = { "mask", 1, false },        [DAR_FAMILY_SPARSE] = { "sparse", 3, true },
};

const dar_channel_alias dar_channel_aliases[] = {
    { "camera", "" },
    { "depth", "depth" },
    { "tracking", "tracking" },
    { "normal", "normal" },
    { "world", "world" },
    { "tracking+normal", "tracking+normal" },
    { "tracking+world", "tracking+world" },
    { "normal+world", "normal+world" },
    { "tracking+depth", "tracking+depth" },
    { "normal+depth", "normal+depth" },
    { "tracking+normal+depth", "tracking+normal+depth" },
    { "dar", "tracking+world+normal" },
    { "mask+world+normal", "mask+world+normal" },
    { "mask+depth+normal", "mask+depth+normal" },
};

const size_t dar_channel_alias_count = DAR_COUNT(dar_channel_aliases);

/* ---------------------------------------------------------------- sets */

static dar_status add_family(dar_channel_set *s, const char *word, size_t length, const char *text, dar_err *e)
{
    char name[64];
    snprintf(name, sizeof name, "%.*s", (int)(length < sizeof name ? length : sizeof name - 1), word);
    dar_nearest n = dar_nearest_to(name);
    for (int f = 0; f < DAR_FAMILIES; f++) {
        dar_nearest_try(&n, dar_family_table[f].name);
        if (strcmp(dar_family_table[f].name, name) != 0) continue;
        if (dar_channel_set_has(s, (dar_family)f))
            return dar_fail(e, DAR_ERR_USAGE, "channels: found \"%s\", expected %s once", text, name);
        s->family[s->families++] = (dar_family)f;
        s->channels += dar_family_table[f].channels;
        return DAR_OK;
    }
    for (size_t i = 0; i < dar_channel_alias_count; i++) dar_nearest_try(&n, dar_channel_aliases[i].name);
    return dar_fail(
        e, DAR_ERR_USAGE,
        "channels: found \"%s\" in \"%s\", expected camera, dar, or some of tracking, world, normal, depth, "
        "mask, sparse with + between them%s%s%s",
        name, text, n.best ? "; is it " : "", n.best ? n.best : "", n.best ? "?" : "");
}

dar_status dar_channel_set_parse(dar_channel_set *s, const char *text, dar_err *e)
{
    const char *p = text;
    *s = (dar_channel_set){ 0 };
    for (size_t i = 0; i < dar_channel_alias_count; i++)
        if (strcmp(dar_channel_aliases[i].name, text) == 0) p = dar_channel_aliases[i].families;
    while (*p || p == text) {
        size_t length = strcspn(p, "+");
        DAR_TRY(add_family(s, p, length, text, e));
        p += length;
        if (*p == '+' && !*++p) return add_family(s, p, 0, text, e);
    }
    return DAR_OK;
}

bool dar_channel_set_has(const dar_channel_set *s, dar_family f)
{
    for (size_t i = 0; i < s->families; i++)
        if (s->family[i] == f) return true;
    return false;
}

void dar_condition_read(dar_condition *c, dar_json j)
{
    static const char *const resample[] = { "last", "first", "mean", "masked-mean", NULL };
    static const char *const frame[] = { "scene", "camera0", NULL };
    dar_err e;
    *c = (dar_condition){ 0 };
    if (dar_channel_set_parse(&c->set, dar_json_text(j, "channels", "dar"), &e) != DAR_OK)
        dar_json_reject(j, "channels", "a set of channels: %s", e.text);
    c->rays.plucker = (dar_plucker)dar_json_choice(j, "plucker", DAR_PLUCKER_WAN, dar_plucker_name);
    c->rays.frame = (dar_rays_frame)dar_json_choice(j, "rays", DAR_RAYS_CAMERA0, dar_rays_frame_name);
    c->resample = (dar_resample)dar_json_choice(j, "resample", DAR_RESAMPLE_LAST, resample);
    c->geometry = (dar_geometry_frame)dar_json_choice(j, "geometry_frame", DAR_GEOMETRY_SCENE, frame);
}

dar_shape dar_condition_shape(const dar_condition *c, const dar_camera_path *p)
{
    return DAR_SHAPE(DAR_RAYS_CHANNELS + (int64_t)c->set.channels, (int64_t)dar_rays_latent_frames(p->frames),
                     p->view[0].height, p->view[0].width);
}

/* ---------------------------------------------------------------- from values to channels */

dar_status dar_condition_world(const dar_condition *c, const dar_condition_source *s, double m[12], dar_err *e)
{
    double scale = s->scale, middle[3];
    memcpy(middle, s->center, sizeof middle);
    memcpy(m, dar_affine_identity, sizeof dar_affine_identity);
    if (c->geometry == DAR_GEOMETRY_CAMERA0) {
        double lo[3] = { INFINITY, INFINITY, INFINITY }, hi[3] = { -INFINITY, -INFINITY, -INFINITY };
        dar_rigid_inverse(s->path->view[0].c2w, m);
        for (int k = 0; k < 8; k++) {
            const double x[3] = { k & 1 ? s->box.hi[0] : s->box.lo[0], k & 2 ? s->box.hi[1] : s->box.lo[1],
                                  k & 4 ? s->box.hi[2] : s->box.lo[2] };
            for (int i = 0; i < 3; i++) {
                double y = dar_vec_dot(m + 4 * i, x) + m[4 * i + 3];
                lo[i] = fmin(lo[i], y);
                hi[i] = fmax(hi[i], y);
            }
        }
        middle[0] = middle[1] = 0;
        middle[2] = (lo[2] + hi[2]) / 2;
        scale = 0;
        for (int i = 0; i < 3; i++) scale = fmax(scale, 2 * fmax(hi[i] - middle[i], middle[i] - lo[i]));
    }
    if (!(scale > 0 && isfinite(scale)))
        return dar_fail(e, DAR_ERR_FORMAT, "scene: found scale %g, expected more than 0", scale);
    for (int i = 0; i < 3; i++) {
        for (int j = 0; j < 4; j++) m[4 * i + j] /= scale;
        m[4 * i + 3] += 0.5 - middle[i] / scale;
    }
    return DAR_OK;
}

/* m: y = m (value, 1) for the values of a family. */
static dar_status family_map(dar_family f, const dar_condition *c, const dar_condition_source *s, double m[12],
                             dar_err *e)
{
    memcpy(m, dar_affine_identity, sizeof dar_affine_identity);
    if (f == DAR_FAMILY_WORLD) return dar_condition_world(c, s, m, e);
    if (f == DAR_FAMILY_NORMAL) {
        if (c->geometry == DAR_GEOMETRY_CAMERA0) dar_rigid_inverse(s->path->view[0].c2w, m);
        for (int i = 0; i < 3; i++) {
            for (int j = 0; j < 3; j++) m[4 * i + j] /= 2;
            m[4 * i + 3] = 0.5;
        }
    }
    if (f == DAR_FAMILY_DEPTH) {
        double lo = s->depth[0], hi = s->depth[1];
        if (!(lo <= hi && isfinite(lo) && isfinite(hi)))
            return dar_fail(e, DAR_ERR_FORMAT, "scene: found depths from %g to %g, expected a range", lo, hi);
        m[0] = lo < hi ? 1 / (hi - lo) : 0;
        m[3] = lo < hi ? -lo / (hi - lo) : 1;
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- planes into the tensor */

/* How a frame of a group enters. */
typedef enum entry { SET, ADD, OVER } entry; /* OVER: where it is not background */

typedef struct job {
    dar_plane plane;
    double m[12]; /* from the plane's numbers */
    size_t channels, pixels, stride;
    entry how;
    unsigned char *cover; /* [pixels] of this frame */
    unsigned char *count; /* [pixels] frames of the group so far that cover; for masked means */
    float *y;             /* [channels, pixels], channels `stride` apart */
} job;

void dar_plane_numbers(const dar_plane *p, size_t at, size_t n, double *x)
{
    switch (p->type) {
    case DAR_PLANE_U8:
        for (size_t i = 0; i < n; i++) x[i] = ((const uint8_t *)p->data)[at + i];
        break;
    case DAR_PLANE_U16:
        for (size_t i = 0; i < n; i++) x[i] = ((const uint16_t *)p->data)[at + i];
        break;
    case DAR_PLANE_I16:
        for (size_t i = 0; i < n; i++) x[i] = ((const int16_t *)p->data)[at + i];
        break;
    case DAR_PLANE_F32:
        for (size_t i = 0; i < n; i++) x[i] = (double)((const float *)p->data)[at + i];
        break;
    }
}

/* Not a number stays so: whoever reads the tensor is to see it. */
static float clamp(double x)
{
    return x < 0 ? 0.0f : x > 1 ? 1.0f : (float)x;
}

static void enter(entry how, const unsigned char *cover, const double *v, size_t n, float *y)
{
    if (how == SET)
        for (size_t i = 0; i < n; i++) y[i] = cover[i] ? clamp(v[i]) : 0.0f;
    else if (how == ADD)
        for (size_t i = 0; i < n; i++) y[i] += cover[i] ? clamp(v[i]) : 0.0f;
    else
        for (size_t i = 0; i < n; i++) y[i] = cover[i] ? clamp(v[i]) : y[i];
}

static void enter_planes(void *ctx, size_t begin, size_t end, int thread)
{
    const job *b = ctx;
    double x[3][STRIP] = { { 0 } }, v[STRIP];
    (void)thread;
    for (size_t at = begin; at < end; at += STRIP) {
        size_t n = end - at < STRIP ? end - at : STRIP;
        for (size_t c = 0; c < b->channels; c++) dar_plane_numbers(&b->plane, c * b->pixels + at, n, x[c]);
        for (size_t c = 0; c < b->channels; c++) {
            const double *m = b->m + 4 * c;
            if (b->channels == 1)
                for (size_t i = 0; i < n; i++) v[i] = m[0] * x[0][i] + m[3];
            else
                for (size_t i = 0; i < n; i++) v[i] = m[0] * x[0][i] + m[1] * x[1][i] + m[2] * x[2][i] + m[3];
            enter(b->how, b->cover + at, v, n, b->y + c * b->stride + at);
        }
    }
}

static void enter_cover(void *ctx, size_t begin, size_t end, int thread)
{
    const job *b = ctx;
    double x[STRIP];
    (void)thread;
    for (size_t at = begin; at < end; at += STRIP) {
        size_t n = end - at < STRIP ? end - at : STRIP;
        dar_plane_numbers(&b->plane, at, n, x);
        for (size_t i = 0; i < n; i++) {
            b->cover[at + i] = b->plane.scale[0] * x[i] + b->plane.offset[0] > 0;
            b->count[at + i] = (unsigned char)(b->cover[at + i] + (b->how == SET ? 0 : b->count[at + i]));
        }
    }
}

/* A sum over the frames of a group becomes their mean, or that of those that cover. */
static void divide(void *ctx, size_t begin, size_t end, int thread)
{
    const job *b = ctx;
    (void)thread;
    for (size_t c = 0; c < b->channels; c++) {
        float *y = b->y + c * b->stride;
        for (size_t i = begin; i < end; i++) {
            int n = b->how == OVER ? b->count[i] : DAR_RAYS_GROUP;
            y[i] = n ? y[i] / (float)n : 0.0f;
        }
    }
}

typedef struct build {
    const dar_condition *c;
    const dar_condition_source *s;
    double map[DAR_FAMILIES][12];
    unsigned char *cover, *count;
    size_t F, pixels;
    float *y; /* the first channel after the rays */
} build;

static void enter_family(const build *b, size_t which, dar_plane plane, size_t f, bool first)
{
    const dar_family_info *info = &dar_family_table[b->c->set.family[which]];
    job k = { .plane = plane, .channels = info->channels, .pixels = b->pixels, .stride = b->F * b->pixels };
    size_t channel = 0;
    for (size_t i = 0; i < which; i++) channel += dar_family_table[b->c->set.family[i]].channels;
    k.y = b->y + channel * k.stride + f * b->pixels;
    k.cover = b->cover;
    k.how = first ? SET : info->identity ? OVER : ADD;
    for (size_t i = 0; i < info->channels; i++) {
        const double *m = b->map[b->c->set.family[which]] + 4 * i;
        k.m[4 * i + 3] = m[3];
        for (size_t j = 0; j < info->channels; j++) {
            k.m[4 * i + j] = m[j] * plane.scale[j];
            k.m[4 * i + 3] += m[j] * plane.offset[j];
        }
    }
    dar_parallel_range(b->pixels, CHUNK, enter_planes, &k);
}

/* Frame t as one of those that make latent frame f. */
static dar_status enter_frame(const build *b, size_t f, size_t t, bool first, dar_err *e)
{
    job k = { .pixels = b->pixels, .cover = b->cover, .count = b->count, .how = first ? SET : ADD };
    DAR_TRY(b->s->read(b->s->ctx, DAR_FAMILY_MASK, t, &k.plane, e));
    dar_parallel_range(b->pixels, CHUNK, enter_cover, &k);
    for (size_t i = 0; i < b->c->set.families; i++)
        if (b->c->set.family[i] == DAR_FAMILY_MASK) enter_family(b, i, k.plane, f, first);
    for (size_t i = 0; i < b->c->set.families; i++) {
        dar_plane plane;
        if (b->c->set.family[i] == DAR_FAMILY_MASK) continue;
        DAR_TRY(b->s->read(b->s->ctx, b->c->set.family[i], t, &plane, e));
        enter_family(b, i, plane, f, first);
    }
    return DAR_OK;
}

static void finish_mean(const build *b, size_t f)
{
    size_t channel = 0;
    for (size_t i = 0; i < b->c->set.families; i++) {
        const dar_family_info *info = &dar_family_table[b->c->set.family[i]];
        job k = { .channels = info->channels, .pixels = b->pixels, .stride = b->F * b->pixels, .count = b->count };
        k.y = b->y + channel * k.stride + f * b->pixels;
        k.how = b->c->resample == DAR_RESAMPLE_MASKED ? OVER : ADD;
        if (!info->identity) dar_parallel_range(b->pixels, CHUNK, divide, &k);
        channel += info->channels;
    }
}

static dar_status build_geometry(build *b, dar_err *e)
{
    const dar_condition *c = b->c;
    for (size_t i = 0; i < c->set.families; i++)
        DAR_TRY(family_map(c->set.family[i], c, b->s, b->map[c->set.family[i]], e));
    for (size_t f = 0; f < b->F; f++) {
        size_t end = DAR_RAYS_GROUP * f, begin = f ? end - (DAR_RAYS_GROUP - 1) : 0;
        if (c->resample == DAR_RESAMPLE_LAST) begin = end;
        if (c->resample == DAR_RESAMPLE_FIRST) end = begin;
        for (size_t t = begin; t <= end; t++) DAR_TRY(enter_frame(b, f, t, t == begin, e));
        if (end > begin) finish_mean(b, f);
    }
    return DAR_OK;
}

dar_status dar_condition_build(const dar_condition *c, const dar_condition_source *s, dar_arena *scratch,
                               const dar_tensor *y, dar_err *e)
{
    const dar_view *v = &s->path->view[0];
    dar_shape expected = dar_condition_shape(c, s->path);
    build b = { .c = c, .s = s, .F = (size_t)expected.d[1], .pixels = (size_t)v->width * (size_t)v->height };
    char found[96], wanted[96];
    DAR_ASSERT(y->dtype == DAR_F32 && dar_tensor_contiguous(y) && dar_shape_equal(&y->shape, &expected),
               "condition: y is %s, expected %s f32", dar_shape_text(&y->shape, found, sizeof found),
               dar_shape_text(&expected, wanted, sizeof wanted));
    dar_tensor rays = dar_tensor_narrow(y, 0, 0, DAR_RAYS_CHANNELS);
    dar_rays_pack(s->path, c->rays, &rays);
    if (c->set.families == 0) return DAR_OK;

    dar_mark mark = dar_arena_mark(scratch);
    b.cover = dar_arena_push(scratch, b.pixels);
    b.count = dar_arena_push(scratch, b.pixels);
    b.y = (float *)y->data + DAR_RAYS_CHANNELS * b.F * b.pixels;
    dar_status status = build_geometry(&b, e);
    dar_arena_reset(scratch, mark);
    return status;
}
