/* render.c: the loop over frames. */
#include "data/render.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/identity.h"
#include "data/tracks.h"
#include "lib/log.h"

const char *const dar_render_stage_name[] = { "draw", "tracks", "picture", "write" };

/* All that a frame needs, in one arena. */
struct painter {
    const dar_render *r;
    dar_arena arena;
    dar_identity identity;
    dar_pose pose;
    dar_raster raster;
    dar_gbuffer g;
    dar_shade shade;
    uint8_t *rgb;
    size_t tracks; /* found */
    dar_surface_point *point;
    uint8_t *color, *visible, *map;
    float *xy, *depth;
};

static bool wants(const dar_render *r, int family)
{
    return r->bundle.families >> family & 1;
}

static void *push(dar_arena *a, bool wanted, size_t n, size_t bytes)
{
    return wanted ? dar_arena_push(a, dar_mul_size(n, bytes)) : NULL;
}

static void layout_shade(struct painter *p)
{
    const dar_render *r = p->r;
    dar_shade_config c = *r->shade;
    c.raster = r->raster;
    memcpy(c.lo, r->meta.world.lo, sizeof c.lo);
    memcpy(c.hi, r->meta.world.hi, sizeof c.hi);
    dar_shade_init(&p->shade, r->clip.scene, &c, &p->arena);
}

static void layout(struct painter *p)
{
    const dar_render *r = p->r;
    const dar_scene *s = r->clip.scene;
    dar_arena *a = &p->arena;
    size_t pixels = (size_t)r->raster.width * (size_t)r->raster.height, triangles = 0;
    size_t points = wants(r, DAR_FAMILY_SPARSE) ? r->tracks : 0, rows = dar_mul_size(points, r->clip.frames);
    bool named = points || wants(r, DAR_FAMILY_TRACKING) || wants(r, DAR_BUNDLE_PART);

    if (named) dar_identity_init(&p->identity, s, a);
    dar_pose_init(&p->pose, s, a);
    dar_raster_init(&p->raster, s, named ? &p->identity : NULL, &r->raster, a);
    p->g = (dar_gbuffer){
        .tracking = push(a, wants(r, DAR_FAMILY_TRACKING), pixels, 3 * sizeof(float)),
        .instance = push(a, wants(r, DAR_BUNDLE_ID), pixels, sizeof(uint32_t)),
        .part = push(a, wants(r, DAR_BUNDLE_PART), pixels, sizeof(uint32_t)),
        .world = push(a, wants(r, DAR_FAMILY_WORLD), pixels, 3 * sizeof(float)),
        .normal = push(a, wants(r, DAR_FAMILY_NORMAL), pixels, 3 * sizeof(float)),
        .depth = push(a, wants(r, DAR_FAMILY_DEPTH), pixels, sizeof(float)),
        .mask = push(a, true, pixels, 1),
    };
    p->rgb = push(a, r->bundle.rgb, pixels, 3);
    if (r->bundle.rgb && r->shade) layout_shade(p);
    p->point = push(a, points, points, sizeof *p->point);
    p->color = push(a, points, points, 3);
    p->depth = push(a, points, points, sizeof(float));
    p->xy = push(a, points, rows, 2 * sizeof(float));
    p->visible = push(a, points, rows, 1);
    p->map = push(a, points, pixels, 3);

    /* Scratch of dar_tracks_pick and dar_tracks_map. */
    for (size_t i = 0; i < s->instances; i++) triangles += s->mesh[s->instance[i].mesh].triangles;
    dar_mark m = dar_arena_mark(a);
    push(a, points, triangles, 9);
    push(a, points, s->instances, sizeof(size_t));
    push(a, points, points, sizeof(uint32_t));
    push(a, points, 4, DAR_ALIGN);
    dar_arena_reset(a, m);
}

/* After a failure too the caller owes one dar_arena_free of p->arena. */
static dar_status init(struct painter *p, const dar_render *r, dar_err *e)
{
    *p = (struct painter){ .r = r };
    DAR_ASSERT(r->cameras->frames == r->clip.frames, "render: %zu cameras for %zu frames", r->cameras->frames,
               r->clip.frames);
    DAR_TRY(dar_arena_init_plan(&p->arena, "render", e));
    layout(p);
    size_t bytes = p->arena.peak;
    dar_arena_free(&p->arena);
    DAR_TRY(dar_arena_init(&p->arena, "render", bytes, e));
    layout(p);
    return DAR_OK;
}

/* Seconds since *mark, which moves on. */
static double lap(double *mark)
{
    double now = dar_log_clock(), d = now - *mark;
    *mark = now;
    return d;
}

/* ---------------------------------------------------------------- a frame */

/* `again`: the buffers hold the frame before. */
static dar_status draw(struct painter *p, size_t frame, bool again, dar_err *e)
{
    const dar_render *r = p->r;
    dar_status s = dar_pose_at(&p->pose, r->clip.animation, dar_clip_time(&r->clip, frame), e);
    if (s != DAR_OK) return DAR_ERR_FORMAT; /* a file that cannot be posed is bad input */
    dar_raster_draw(&p->raster, &p->pose, &r->cameras->view[frame], &p->g, again ? &p->g : NULL);
    return DAR_OK;
}

static void shade(struct painter *p, size_t frame)
{
    dar_shade_draw(&p->shade, &p->pose, &p->r->cameras->view[frame], p->rgb);
}

static void follow(struct painter *p, size_t frame, bool copied)
{
    const dar_render *r = p->r;
    if (frame == 0) {
        p->tracks = dar_tracks_pick(&p->raster, r->tracks, true, p->point, &p->arena);
        dar_tracks_color(&p->raster, p->point, p->tracks, p->color);
    }
    dar_tracks_follow(&p->raster, p->point, p->tracks, frame, r->clip.frames, p->xy, p->visible, p->depth);
    if (!copied)
        dar_tracks_map(&p->raster, p->tracks, frame, r->clip.frames, p->xy, p->visible, p->depth, p->color,
                       r->track_side, p->map, &p->arena);
}

static dar_status add_frame(struct painter *p, size_t frame, dar_bundle_writer *w, double *seconds, dar_err *e)
{
    const dar_render *r = p->r;
    double mark = dar_log_clock();
    size_t copied = p->raster.stats.copied;
    dar_bundle_frame f = { .g = p->g, .sparse = p->map, .rgb = p->rgb };

    DAR_TRY(draw(p, frame, frame > 0, e));
    f.copied = p->raster.stats.copied > copied;
    seconds[DAR_RENDER_DRAW] += lap(&mark);
    if (p->point) follow(p, frame, f.copied);
    seconds[DAR_RENDER_TRACKS] += lap(&mark);
    if (r->bundle.rgb && !r->shade) DAR_TRY(r->picture(r->ctx, frame, p->rgb, e));
    if (r->bundle.rgb && r->shade) shade(p, frame);
    seconds[DAR_RENDER_PICTURE] += lap(&mark);
    DAR_TRY(dar_bundle_add(w, &f, e));
    seconds[DAR_RENDER_WRITE] += lap(&mark);
    return r->step ? r->step(r->ctx, frame + 1, e) : DAR_OK;
}

/* ---------------------------------------------------------------- a bundle */

/* What the scene says about its instances.  The caller frees the array. */
static dar_status name_objects(const struct painter *p, dar_bundle_meta *m, dar_err *e)
{
    const dar_scene *s = p->r->clip.scene;
    dar_bundle_object *o = calloc(s->instances, sizeof *o);
    if (!o) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", s->path);
    for (size_t i = 0; i < s->instances; i++) {
        const dar_instance *in = &s->instance[i];
        const char *node = s->node[in->node].name, *mesh = s->mesh[in->mesh].name;
        o[i].name = node && *node ? node : mesh;
        o[i].parts = p->identity.mesh ? p->identity.mesh[in->mesh].parts : 1;
    }
    m->object = o;
    m->objects = s->instances;
    return DAR_OK;
}

static dar_status write_frames(struct painter *p, dar_bundle_writer *w, double *seconds, dar_err *e)
{
    const dar_render *r = p->r;
    for (size_t t = 0; t < r->clip.frames; t++) DAR_TRY(add_frame(p, t, w, seconds, e));
    double mark = dar_log_clock();
    if (p->point) DAR_TRY(dar_bundle_add_tracks(w, p->tracks, p->xy, p->visible, p->color, e));
    if (r->reference) DAR_TRY(dar_bundle_add_reference(w, r->reference, e));
    DAR_TRY(dar_bundle_commit(w, e));
    seconds[DAR_RENDER_WRITE] += lap(&mark);
    return DAR_OK;
}

static void finish(struct painter *p, dar_render_report *report)
{
    report->raster = p->raster.stats;
    memcpy(report->shade, p->shade.seconds, sizeof report->shade);
    report->tracks = p->tracks;
    report->memory = p->arena.peak;
    dar_arena_free(&p->arena);
}

dar_status dar_render_bundle(const dar_render *r, const char *path, dar_render_report *report, dar_err *e)
{
    struct painter p;
    dar_bundle_writer *w = NULL;
    dar_bundle_meta meta = r->meta;
    *report = (dar_render_report){ 0 };
    meta.object = NULL;
    meta.frames = r->clip.frames;
    meta.width = r->raster.width;
    meta.height = r->raster.height;
    meta.fps = r->clip.fps;
    dar_status s = init(&p, r, e);
    if (s == DAR_OK) s = name_objects(&p, &meta, e);
    if (s == DAR_OK) s = dar_bundle_create(&w, path, &meta, r->cameras, &r->bundle, e);
    if (s == DAR_OK) s = write_frames(&p, w, report->seconds, e);
    dar_bundle_discard(w);
    free((void *)(uintptr_t)meta.object);
    finish(&p, report);
    return s;
}

dar_status dar_render_try(const dar_render *r, size_t frames, dar_render_report *report, dar_err *e)
{
    struct painter p;
    *report = (dar_render_report){ 0 };
    dar_status s = init(&p, r, e);
    double mark = dar_log_clock();
    for (size_t i = 0; s == DAR_OK && i < frames; i++) {
        size_t frame = i * (r->clip.frames - 1) / frames;
        s = draw(&p, frame, false, e);
        if (s == DAR_OK && r->bundle.rgb && r->shade) shade(&p, frame);
    }
    report->seconds[DAR_RENDER_DRAW] = lap(&mark);
    finish(&p, report);
    return s;
}
