/* quality.c: the checks with their limits, those of the clip as a whole, and how they are told. */
#include "data/quality.h"

#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "data/identity.h"
#include "data/quality_inside.h"

#define UNIFORM 0.01 /* of 1: 2.5 of the 255 steps of a picture */

/* clang-format off */
const dar_quality_limit dar_quality_table[DAR_QUALITY_CHECKS] = {
    [DAR_QUALITY_FILES] = { "files", false, 0, " files",
        "a file is missing or was changed", "sizes of files in meta.json" },
    [DAR_QUALITY_REFERENCE] = { "reference", false, 0, " bytes",
        "reference.png is not frame 0 of rgb.h5", "reference.png and rgb.h5" },
    [DAR_QUALITY_PATH] = { "path", false, 0, " frames",
        "the camera path is not safe to render", "world, or boxes, in meta.json" },
    [DAR_QUALITY_FINITE] = { "finite", false, 0, " numbers",
        "numbers are not finite", "a family" },
    [DAR_QUALITY_MASK] = { "mask", false, 0, " px",
        "families do not cover the same pixels", "mask or depth, and another family" },
    [DAR_QUALITY_COVERAGE] = { "coverage", true, 0.001, " of the picture",
        "hardly anything of the scene is seen", "mask or depth" },
    [DAR_QUALITY_DEPTH] = { "depth", false, 1e-6, " of the farthest",
        "depth is nearer than the near plane, or its range is not that of meta.json", "depth" },
    [DAR_QUALITY_BOUNDS] = { "bounds", false, 1e-5, " sizes of the scene",
        "positions are outside of the bounds that meta.json gives", "world positions, and world in meta.json" },
    [DAR_QUALITY_SCALE] = { "scale", false, 1e-6, " sizes of the scene",
        "world positions are not normalised by one number for all axes that takes the bounds into (0, 1)",
        "world positions, and world in meta.json" },
    [DAR_QUALITY_POSITION] = { "position", false, 1e-5, " sizes of the scene",
        "camera, ray and depth do not lead to the stored position: another camera, unit, or depth that is not along z",
        "depth and world positions" },
    [DAR_QUALITY_ORDER] = { "order", false, 0, " frames",
        "frames are those of other cameras of the path", "depth and world positions" },
    [DAR_QUALITY_NORMAL] = { "normal", false, 1e-3, "",
        "normals are not of unit length: averaged, or coloured", "normals" },
    [DAR_QUALITY_SLOPE] = { "slope", true, 0.8, "",
        "normals do not stand on the surface that depth describes: not in the world, or inwards",
        "depth and normals" },
    [DAR_QUALITY_IDENTITY] = { "identity", false, 0, " px",
        "a surface element has not one colour, part and instance at all times",
        "tracking, part or id, and objects in meta.json" },
    [DAR_QUALITY_TRACKS] = { "tracks", true, 0.5, " of the visible",
        "tracks do not meet their own colour", "tracks and tracking" },
    [DAR_QUALITY_UNIFORM_RGB] = { "uniform-rgb", true, UNIFORM, "", "a picture is all of one colour", "rgb.h5" },
    [DAR_QUALITY_UNIFORM_TRACKING] = { "uniform-tracking", true, UNIFORM, "", "tracking is all of one colour",
        "tracking" },
    [DAR_QUALITY_UNIFORM_NORMAL] = { "uniform-normal", true, UNIFORM, "", "normals are all the same", "normals" },
    [DAR_QUALITY_UNIFORM_DEPTH] = { "uniform-depth", true, UNIFORM, " sizes of the scene", "depth is all the same",
        "depth" },
    [DAR_QUALITY_UNIFORM_WORLD] = { "uniform-world", true, UNIFORM, " sizes of the scene",
        "positions are all the same", "world positions" },
};
/* clang-format on */

/* ---------------------------------------------------------------- results */

static bool within(dar_quality_name name, double found)
{
    const dar_quality_limit *l = &dar_quality_table[name];
    return l->at_least ? found >= l->limit : found <= l->limit; /* NaN is not */
}

void dar_quality_note(dar_quality_run *r, dar_quality_name name, double found, size_t frame, const char *reason, ...)
{
    dar_quality_result *x = &r->q->result[name];
    va_list ap;
    bool worse = dar_quality_table[name].at_least ? found < x->found : found > x->found;
    if (x->state != DAR_QUALITY_UNCHECKED && !isnan(found) && (isnan(x->found) || !worse)) return;
    *x = (dar_quality_result){ .state = within(name, found) ? DAR_QUALITY_GOOD : DAR_QUALITY_BAD,
                               .found = found,
                               .frame = frame };
    va_start(ap, reason);
    if (x->state == DAR_QUALITY_BAD) vsnprintf(x->reason, sizeof x->reason, reason, ap);
    va_end(ap);
}

static void count(dar_quality *q)
{
    for (int i = 0; i < DAR_QUALITY_CHECKS; i++) {
        dar_quality_result *x = &q->result[i];
        q->good += x->state == DAR_QUALITY_GOOD;
        q->bad += x->state == DAR_QUALITY_BAD;
        q->unchecked += x->state == DAR_QUALITY_UNCHECKED;
        if (x->state == DAR_QUALITY_UNCHECKED)
            snprintf(x->reason, sizeof x->reason, "it takes %s", dar_quality_table[i].needs);
    }
}

const char *dar_quality_text(const dar_quality *q, dar_quality_name name, char text[DAR_QUALITY_TEXT])
{
    const dar_quality_limit *l = &dar_quality_table[name];
    const dar_quality_result *x = &q->result[name];
    char frame[32] = "";
    if (x->frame != DAR_QUALITY_CLIP) snprintf(frame, sizeof frame, " at frame %zu", x->frame);
    if (x->state == DAR_QUALITY_UNCHECKED) snprintf(text, DAR_QUALITY_TEXT, "%s: not checked: %s", l->name, x->reason);
    else if (x->state == DAR_QUALITY_GOOD)
        snprintf(text, DAR_QUALITY_TEXT, "%s: good: %.3g%s%s", l->name, x->found, l->unit, frame);
    else
        snprintf(text, DAR_QUALITY_TEXT, "%s: bad: %.3g%s%s, expected %s %g: %s%s%s%s", l->name, x->found, l->unit,
                 frame, l->at_least ? "at least" : "at most", l->limit, l->meaning, *x->reason ? " (" : "", x->reason,
                 *x->reason ? ")" : "");
    return text;
}

void dar_quality_print(const dar_quality *q, dar_json_writer *w, const char *key)
{
    static const char *const state[] = { "unchecked", "good", "bad" };
    dar_json_write_object(w, key);
    dar_json_write_bool(w, "passed", q->bad == 0);
    dar_json_write_object(w, "checks");
    for (int i = 0; i < DAR_QUALITY_CHECKS; i++) {
        const dar_quality_result *x = &q->result[i];
        dar_json_write_object(w, dar_quality_table[i].name);
        dar_json_write_text(w, "state", state[x->state]);
        if (x->state != DAR_QUALITY_UNCHECKED) {
            dar_json_write_number(w, "found", x->found);
            dar_json_write_number(w, "limit", dar_quality_table[i].limit);
            if (x->frame != DAR_QUALITY_CLIP) dar_json_write_int(w, "frame", (int64_t)x->frame);
        }
        if (*x->reason) dar_json_write_text(w, "reason", x->reason);
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
    dar_json_write_end(w);
}

/* ---------------------------------------------------------------- the clip as a whole */

double dar_quality_deviation(const dar_quality_sums *s, size_t channels)
{
    double most = 0, n = (double)s->n;
    for (size_t c = 0; c < channels && s->n > 0; c++)
        most = fmax(most, s->square[c] / n - s->sum[c] / n * (s->sum[c] / n));
    return sqrt(most);
}

static void check_path(dar_quality_run *r)
{
    const dar_bundle_meta *m = &r->b->meta;
    dar_box whole;
    dar_stage stage = dar_stage_standard();
    size_t frame;
    memcpy(whole.lo, m->world.lo, sizeof whole.lo);
    memcpy(whole.hi, m->world.hi, sizeof whole.hi);
    stage.box = m->boxes ? m->box : &whole;
    stage.boxes = m->boxes ? m->boxes : 1;
    stage.z_up = m->z_up;
    if (!m->boxes && !(m->world.size > 0)) return;
    dar_path_fault fault = dar_trajectory_check(&r->b->cameras, &stage, &frame);
    bool safe = fault == DAR_PATH_SAFE;
    dar_quality_note(r, DAR_QUALITY_PATH, safe ? 0 : 1, safe ? DAR_QUALITY_CLIP : frame, "%s",
                     dar_path_fault_text[fault]);
}

/* Of the numbers that are stored, and of the bounds. */
static dar_status check_scale(dar_quality_run *r)
{
    const dar_world *w = &r->b->meta.world;
    dar_plane p;
    double most = 0;
    if (!(w->size > 0) || !dar_bundle_has(r->b, DAR_FAMILY_WORLD)) return DAR_OK;
    DAR_TRY(dar_bundle_plane(r->b, DAR_FAMILY_WORLD, 0, &p, r->e));
    for (int c = 0; c < 3; c++) {
        double low = w->centre[c] - w->size / 2;
        most = fmax(most, fmax((low - w->lo[c]) / w->size, (w->hi[c] - low) / w->size - 1));
        if (p.type == DAR_PLANE_F32) continue;
        most = fmax(most, fabs(p.scale[c] / p.scale[0] - 1));
        if (p.type == DAR_PLANE_U16) most = fmax(most, fabs(65535 * p.scale[c] / w->size - 1));
        if (p.type == DAR_PLANE_U16) most = fmax(most, fabs(p.offset[c] - low) / w->size);
    }
    dar_quality_note(r, DAR_QUALITY_SCALE, most, DAR_QUALITY_CLIP, "size %g, bounds %g %g %g to %g %g %g", w->size,
                     w->lo[0], w->lo[1], w->lo[2], w->hi[0], w->hi[1], w->hi[2]);
    return DAR_OK;
}

static void finish_depth(dar_quality_run *r)
{
    const double *found = r->depth_range, *meta = r->b->meta.depth;
    if (!(found[0] <= found[1] && meta[0] <= meta[1])) return;
    double off = fmax(fabs(found[0] - meta[0]), fabs(found[1] - meta[1]));
    dar_quality_note(r, DAR_QUALITY_DEPTH, off / found[1], DAR_QUALITY_CLIP, "from %g to %g, in meta.json %g to %g",
                     found[0], found[1], meta[0], meta[1]);
}

static void finish_uniform(dar_quality_run *r)
{
    static const struct {
        dar_family family;
        dar_quality_name name;
        bool metric;
    } row[] = { { DAR_FAMILY_TRACKING, DAR_QUALITY_UNIFORM_TRACKING, false },
                { DAR_FAMILY_NORMAL, DAR_QUALITY_UNIFORM_NORMAL, false },
                { DAR_FAMILY_DEPTH, DAR_QUALITY_UNIFORM_DEPTH, true },
                { DAR_FAMILY_WORLD, DAR_QUALITY_UNIFORM_WORLD, true } };
    double size = r->size;
    for (int c = 0; c < 3 && r->size <= 0; c++) size = fmax(size, r->hi[c] - r->lo[c]);
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        const dar_quality_sums *s = &r->sums[row[i].family];
        double scale = row[i].metric ? (size > 0 ? 1 / size : 1) : row[i].family == DAR_FAMILY_NORMAL ? 0.5 : 1;
        if (s->n > 0)
            dar_quality_note(r, row[i].name, scale * dar_quality_deviation(s, dar_family_table[row[i].family].channels),
                             DAR_QUALITY_CLIP, "over the clip");
    }
}

static void check_files(dar_quality_run *r)
{
    dar_err e = { "" };
    bool good = dar_bundle_verify(r->b, &e) == DAR_OK;
    dar_quality_note(r, DAR_QUALITY_FILES, good ? 0 : 1, DAR_QUALITY_CLIP, "%s", e.text);
}

static dar_status check_all(dar_quality_run *r)
{
    check_files(r);
    check_path(r);
    DAR_TRY(check_scale(r));
    if (r->xy) DAR_TRY(dar_bundle_tracks(r->b, r->xy, r->visible, r->color, r->e));
    for (size_t t = 0; t < r->b->meta.frames; t++) DAR_TRY(dar_quality_frame(r, t));
    finish_depth(r);
    finish_uniform(r);
    if (r->slopes > 0)
        dar_quality_note(r, DAR_QUALITY_SLOPE, r->slope_sum / r->slopes, DAR_QUALITY_CLIP, "over the clip");
    if (r->tracks_seen > 0)
        dar_quality_note(r, DAR_QUALITY_TRACKS, (double)r->tracks_right / (double)r->tracks_seen, DAR_QUALITY_CLIP,
                         "%zu of %zu", r->tracks_right, r->tracks_seen);
    return DAR_OK;
}

dar_status dar_quality_check(dar_quality *q, dar_bundle *b, dar_err *e)
{
    const dar_bundle_meta *m = &b->meta;
    dar_quality_run r = { .q = q, .b = b, .e = e, .pixels = (size_t)m->width * (size_t)m->height };
    dar_arena plan;
    *q = (dar_quality){ 0 };
    for (int i = 0; i < DAR_QUALITY_CHECKS; i++) q->result[i].frame = DAR_QUALITY_CLIP;
    r.size = m->world.size > 0 ? m->world.size : 0;
    for (int c = 0; c < 3; c++) r.lo[c] = INFINITY, r.hi[c] = -INFINITY;
    r.depth_range[0] = INFINITY, r.depth_range[1] = -INFINITY;
    for (size_t i = 0; i < m->objects; i++) r.parts += m->object[i].parts;
    r.side = r.parts ? dar_identity_side(r.parts) : 0;

    DAR_TRY(dar_arena_init_plan(&plan, "quality", e));
    dar_quality_push(&r, &plan);
    size_t bytes = plan.peak;
    dar_arena_free(&plan);
    DAR_TRY(dar_arena_init(&r.memory, "quality", bytes, e));
    dar_quality_push(&r, &r.memory);
    dar_status s = check_all(&r);
    dar_arena_free(&r.memory);
    if (s == DAR_OK) count(q);
    return s;
}
