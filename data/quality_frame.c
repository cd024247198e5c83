/* quality_frame.c: what is measured frame by frame: every family once, in bands of pixels whose findings are combined
 * in their order. */
#include <math.h>
#include <string.h>

#include "data/identity.h"
#include "data/quality_inside.h"
#include "data/rays.h"
#include "data/rigid.h"
#include "lib/real.h"
#include "lib/size.h"
#include "lib/thread.h"

#define BAND    8192 /* pixels */
#define STRIP   256  /* pixels whose numbers are read at a time */
#define SAMPLES 256  /* pixels whose positions are tried with other cameras */
#define FAR     32   /* depth is rounded by 2^-24: from this many sizes away on, errors are told in shares of the way */
#define FLAT    0.03 /* of the depth: neighbours that differ by more are not of one surface */

struct dar_quality_tally {
    size_t covered, odd, wrong, other; /* odd: not finite, wrong: covers what others do not, other: of the family */
    dar_quality_sums sums;
    double lo[3], hi[3];
    double most; /* of the family's error, at pixel `at` */
    size_t at;
    double total, terms;
};

typedef struct dar_quality_tally tally;

/* One family of the frame.  visit: what is its own, of a covered pixel with value x; may be NULL. */
struct scan {
    dar_quality_run *r;
    dar_plane plane;
    size_t channels;
    bool zero_is_value; /* a covered pixel may hold 0 in all channels */
    void (*visit)(const struct scan *s, size_t i, const double x[3], tally *t);
    const dar_view *view;
};

/* ---------------------------------------------------------------- bands */

static double number_at(const dar_plane *p, size_t i)
{
    switch (p->type) {
    case DAR_PLANE_U8: return ((const uint8_t *)p->data)[i];
    case DAR_PLANE_U16: return ((const uint16_t *)p->data)[i];
    case DAR_PLANE_I16: return ((const int16_t *)p->data)[i];
    default: return (double)((const float *)p->data)[i];
    }
}

static void add(dar_quality_sums *s, const double x[3], size_t channels)
{
    s->n++;
    for (size_t c = 0; c < channels; c++) s->sum[c] += x[c], s->square[c] += x[c] * x[c];
}

static void scan_pixel(const struct scan *s, size_t i, const double number[3], tally *t)
{
    double x[3] = { 0 };
    bool zero = true, finite = true;
    for (size_t c = 0; c < s->channels; c++) {
        zero = zero && number[c] == 0;
        finite = finite && isfinite(number[c]);
        x[c] = s->plane.scale[c] * number[c] + s->plane.offset[c];
    }
    bool covered = s->r->cover[i] != 0;
    t->odd += !finite;
    t->wrong += covered ? zero && !s->zero_is_value : !zero;
    if (!covered || !finite) return;
    t->covered++;
    add(&t->sums, x, s->channels);
    for (size_t c = 0; c < s->channels; c++) {
        t->lo[c] = dar_lesser(x[c], t->lo[c]);
        t->hi[c] = dar_greater(x[c], t->hi[c]);
    }
    if (s->visit) s->visit(s, i, x, t);
}

static tally nothing(void)
{
    tally t = { 0 };
    for (int c = 0; c < 3; c++) t.lo[c] = INFINITY, t.hi[c] = -INFINITY;
    return t;
}

static void scan_band(void *ctx, size_t band, int thread)
{
    const struct scan *s = ctx;
    size_t begin = band * BAND, end = begin + BAND < s->r->pixels ? begin + BAND : s->r->pixels;
    double x[3][STRIP] = { { 0 } };
    tally t = nothing();
    (void)thread;
    for (size_t at = begin; at < end; at += STRIP) {
        size_t n = dar_least(end - at, STRIP);
        for (size_t c = 0; c < s->channels; c++) dar_plane_numbers(&s->plane, c * s->r->pixels + at, n, x[c]);
        for (size_t i = 0; i < n; i++) scan_pixel(s, at + i, (const double[]){ x[0][i], x[1][i], x[2][i] }, &t);
    }
    s->r->tally[band] = t;
}

/* NaN is more than any. */
static void keep_most(tally *t, double error, size_t at)
{
    if (!isnan(t->most) && !(error <= t->most)) t->most = error, t->at = at;
}

static void merge_sums(dar_quality_sums *y, const dar_quality_sums *x)
{
    y->n += x->n;
    for (int c = 0; c < 3; c++) y->sum[c] += x->sum[c], y->square[c] += x->square[c];
}

static tally merged(const dar_quality_run *r)
{
    tally y = nothing();
    for (size_t b = 0; b < r->bands; b++) {
        const tally *x = &r->tally[b];
        y.covered += x->covered, y.odd += x->odd, y.wrong += x->wrong, y.other += x->other;
        y.total += x->total, y.terms += x->terms;
        merge_sums(&y.sums, &x->sums);
        for (int c = 0; c < 3; c++) y.lo[c] = fmin(y.lo[c], x->lo[c]), y.hi[c] = fmax(y.hi[c], x->hi[c]);
        keep_most(&y, x->most, x->at);
    }
    return y;
}

/* Read a family of the frame, scan it, and note what is asked of every family. */
static dar_status scan_family(struct scan *s, dar_family family, tally *t)
{
    dar_quality_run *r = s->r;
    const char *name = dar_family_table[family].name;
    DAR_TRY(dar_bundle_plane(r->b, family, r->frame, &s->plane, r->e));
    s->channels = dar_family_table[family].channels;
    s->zero_is_value = family == DAR_FAMILY_WORLD && s->plane.type == DAR_PLANE_F32;
    dar_parallel(r->bands, scan_band, s);
    *t = merged(r);
    merge_sums(&r->sums[family], &t->sums);
    dar_quality_note(r, DAR_QUALITY_FINITE, (double)t->odd, r->frame, "%s", name);
    dar_quality_note(r, DAR_QUALITY_MASK, (double)t->wrong, r->frame, "%s", name);
    return DAR_OK;
}

/* ---------------------------------------------------------------- the point that a pixel sees */

static void point_of(const dar_view *v, size_t i, double depth, double x[3])
{
    size_t width = (size_t)v->width;
    const double ray[3] = { ((double)(i % width) + 0.5 - v->cx) / v->fx, ((double)(i / width) + 0.5 - v->cy) / v->fy,
                            1 };
    for (int c = 0; c < 3; c++)
        x[c] = v->c2w[4 * c + 3] + depth * (v->c2w[4 * c] * ray[0] + v->c2w[4 * c + 1] * ray[1] + v->c2w[4 * c + 2]);
}

static double largest_difference(const double a[3], const double b[3])
{
    return dar_greater(fabs(a[0] - b[0]), dar_greater(fabs(a[1] - b[1]), fabs(a[2] - b[2])));
}

/* Of a position against the depth of its pixel, in sizes of the scene. */
static double position_error(const dar_quality_run *r, const dar_view *v, size_t i, const double x[3])
{
    double p[3], away[3];
    point_of(v, i, (double)r->depth[i], p);
    for (int c = 0; c < 3; c++) away[c] = p[c] - v->c2w[4 * c + 3];
    return largest_difference(p, x) / dar_greater(r->size, sqrt(dar_vec_dot(away, away)) / FAR);
}

/* ---------------------------------------------------------------- families */

static void visit_depth(const struct scan *s, size_t i, const double x[3], tally *t)
{
    (void)t;
    s->r->depth[i] = (float)x[0];
}

static dar_status check_depth(dar_quality_run *r, const dar_view *v)
{
    struct scan s = { .r = r, .view = v, .visit = visit_depth };
    tally t;
    memset(r->depth, 0, r->pixels * sizeof *r->depth);
    DAR_TRY(scan_family(&s, DAR_FAMILY_DEPTH, &t));
    if (t.covered == 0) return DAR_OK;
    r->depth_range[0] = fmin(r->depth_range[0], t.lo[0]);
    r->depth_range[1] = fmax(r->depth_range[1], t.hi[0]);
    dar_quality_note(r, DAR_QUALITY_DEPTH, fmax(v->near - t.lo[0], 0) / t.hi[0], r->frame,
                     "depth %g, the near plane at %g", t.lo[0], v->near);
    return DAR_OK;
}

static void visit_world(const struct scan *s, size_t i, const double x[3], tally *t)
{
    if (s->r->depth) keep_most(t, position_error(s->r, s->view, i, x), i);
}

/* Mean error of up to SAMPLES pixels with a camera of the path. */
static double camera_error(const struct scan *s, const dar_view *v)
{
    const dar_quality_run *r = s->r;
    size_t step = r->pixels / SAMPLES + 1, n = 0;
    double sum = 0;
    for (size_t i = step / 2; i < r->pixels; i += step) {
        double x[3];
        if (!r->cover[i]) continue;
        for (size_t c = 0; c < 3; c++)
            x[c] = s->plane.scale[c] * number_at(&s->plane, c * r->pixels + i) + s->plane.offset[c];
        sum += fmin(position_error(r, v, i, x), 1);
        n++;
    }
    return n ? sum / (double)n : 0;
}

/* Asked only if the positions do not fit. */
static void check_order(const struct scan *s, double error)
{
    dar_quality_run *r = s->r;
    const dar_camera_path *p = &r->b->cameras;
    double own = camera_error(s, s->view), least = own;
    size_t best = r->frame;
    for (size_t t = 0; t < p->frames && error > 1e-4; t++) {
        double other = camera_error(s, &p->view[t]);
        if (other < least) least = other, best = t;
    }
    if (least < own / 2) r->disordered++;
    dar_quality_note(r, DAR_QUALITY_ORDER, (double)r->disordered, r->frame, "it fits the camera of frame %zu", best);
}

/* How far what is seen is outside of the clip's bounds, or of the frame's box, in sizes. */
static void check_bounds(dar_quality_run *r, const tally *t)
{
    const dar_bundle_meta *m = &r->b->meta;
    double out = 0;
    if (!(r->size > 0)) return;
    for (int c = 0; c < 3; c++) {
        out = fmax(out, fmax(m->world.lo[c] - t->lo[c], t->hi[c] - m->world.hi[c]));
        if (m->boxes == m->frames)
            out = fmax(out, fmax(m->box[r->frame].lo[c] - t->lo[c], t->hi[c] - m->box[r->frame].hi[c]));
    }
    dar_quality_note(r, DAR_QUALITY_BOUNDS, out / r->size, r->frame, "from %g %g %g to %g %g %g", t->lo[0], t->lo[1],
                     t->lo[2], t->hi[0], t->hi[1], t->hi[2]);
}

static dar_status check_world(dar_quality_run *r, const dar_view *v)
{
    struct scan s = { .r = r, .view = v, .visit = visit_world };
    tally t;
    DAR_TRY(scan_family(&s, DAR_FAMILY_WORLD, &t));
    if (t.covered == 0) return DAR_OK;
    for (int c = 0; c < 3; c++) r->lo[c] = fmin(r->lo[c], t.lo[c]), r->hi[c] = fmax(r->hi[c], t.hi[c]);
    check_bounds(r, &t);
    if (!r->depth) return DAR_OK;
    dar_quality_note(r, DAR_QUALITY_POSITION, t.most, r->frame, "column %zu, row %zu", t.at % (size_t)v->width,
                     t.at / (size_t)v->width);
    check_order(&s, t.most);
    return DAR_OK;
}

/* The normal of the surface through a pixel and its neighbours on the right and below, towards the camera; false: they
 * are not of one surface. */
static bool slope_at(const dar_quality_run *r, const dar_view *v, size_t i, double n[3])
{
    size_t width = (size_t)v->width, right = i + 1, below = i + width;
    double p[3], q[3], s[3];
    if (right % width == 0 || below >= r->pixels || !r->cover[right] || !r->cover[below]) return false;
    double z = (double)r->depth[i];
    if (dar_greater(fabs((double)r->depth[right] - z), fabs((double)r->depth[below] - z)) > FLAT * z) return false;
    point_of(v, i, z, p);
    point_of(v, right, (double)r->depth[right], q);
    point_of(v, below, (double)r->depth[below], s);
    for (int c = 0; c < 3; c++) q[c] -= p[c], s[c] -= p[c];
    dar_vec_cross(s, q, n);
    double length = sqrt(dar_vec_dot(n, n));
    for (int c = 0; c < 3; c++) n[c] /= length;
    return length > 0;
}

static void visit_normal(const struct scan *s, size_t i, const double x[3], tally *t)
{
    double n[3];
    keep_most(t, fabs(sqrt(dar_vec_dot(x, x)) - 1), i);
    if (!s->r->depth || !slope_at(s->r, s->view, i, n)) return;
    t->total += dar_vec_dot(x, n);
    t->terms++;
}

static dar_status check_normal(dar_quality_run *r, const dar_view *v)
{
    struct scan s = { .r = r, .view = v, .visit = visit_normal };
    tally t;
    DAR_TRY(scan_family(&s, DAR_FAMILY_NORMAL, &t));
    r->slope_sum += t.total;
    r->slopes += t.terms;
    if (t.covered > 0)
        dar_quality_note(r, DAR_QUALITY_NORMAL, t.most, r->frame, "column %zu, row %zu", t.at % (size_t)v->width,
                         t.at / (size_t)v->width);
    return DAR_OK;
}

/* The object that a part, counted from 0, is of. */
static size_t object_of(const dar_bundle_meta *m, size_t part)
{
    size_t i = 0;
    while (i < m->objects && part >= m->object[i].parts) part -= m->object[i++].parts;
    return i;
}

static void visit_tracking(const struct scan *s, size_t i, const double x[3], tally *t)
{
    const dar_quality_run *r = s->r;
    if (r->parts == 0) return;
    size_t cell = dar_identity_cell_of(r->side, x);
    bool same = (!r->part || r->part[i] == cell + 1) && (!r->id || r->id[i] == object_of(&r->b->meta, cell) + 1);
    t->other += !same;
    keep_most(t, !same, i);
}

/* Whether the colour of a track lies within those of the covered pixels around it, rounded to 8 bits. */
static bool meets_colour(const struct scan *s, double x, double y, const uint8_t color[3])
{
    const dar_quality_run *r = s->r;
    int width = s->view->width, height = s->view->height, column = (int)x, row = (int)y;
    double lo[3] = { INFINITY, INFINITY, INFINITY }, hi[3] = { -INFINITY, -INFINITY, -INFINITY };
    for (int k = 0; k < 9; k++) {
        int u = column + k % 3 - 1, v = row + k / 3 - 1;
        if (u < 0 || v < 0 || u >= width || v >= height) continue;
        size_t i = (size_t)v * (size_t)width + (size_t)u;
        for (size_t c = 0; c < 3 && r->cover[i]; c++) {
            double q = s->plane.scale[c] * number_at(&s->plane, c * r->pixels + i) + s->plane.offset[c];
            lo[c] = fmin(lo[c], q);
            hi[c] = fmax(hi[c], q);
        }
    }
    for (int c = 0; c < 3; c++)
        if (!(color[c] / 255.0 >= lo[c] - 2 / 255.0 && color[c] / 255.0 <= hi[c] + 2 / 255.0)) return false;
    return true;
}

static void check_tracks(const struct scan *s)
{
    dar_quality_run *r = s->r;
    size_t T = r->b->meta.frames;
    for (size_t i = 0; i < r->b->tracks; i++) {
        double x = (double)r->xy[2 * (i * T + r->frame)], y = (double)r->xy[2 * (i * T + r->frame) + 1];
        if (!r->visible[i * T + r->frame]) continue;
        bool inside = x >= 0 && y >= 0 && x < s->view->width && y < s->view->height;
        r->tracks_seen++;
        r->tracks_right += inside && meets_colour(s, x, y, r->color + 3 * i);
    }
}

static dar_status check_tracking(dar_quality_run *r, const dar_view *v)
{
    struct scan s = { .r = r, .view = v, .visit = visit_tracking };
    tally t;
    DAR_TRY(scan_family(&s, DAR_FAMILY_TRACKING, &t));
    if (r->parts > 0 && (r->part || r->id) && t.covered > 0)
        dar_quality_note(r, DAR_QUALITY_IDENTITY, (double)t.other, r->frame, "column %zu, row %zu",
                         t.at % (size_t)v->width, t.at / (size_t)v->width);
    if (r->xy) check_tracks(&s);
    return DAR_OK;
}

/* Numbers cover what the others do. */
static dar_status check_numbers(dar_quality_run *r, dar_bundle_family family, uint32_t *number)
{
    size_t wrong = 0;
    DAR_TRY(dar_bundle_numbers(r->b, family, r->frame, number, r->e));
    for (size_t i = 0; i < r->pixels; i++) wrong += (number[i] != 0) != (r->cover[i] != 0);
    dar_quality_note(r, DAR_QUALITY_MASK, (double)wrong, r->frame, "%s", dar_bundle_table[family].name);
    return DAR_OK;
}

/* ---------------------------------------------------------------- pictures */

static void rgb_band(void *ctx, size_t band, int thread)
{
    const dar_quality_run *r = ctx;
    size_t begin = band * BAND, end = begin + BAND < r->pixels ? begin + BAND : r->pixels;
    tally t = nothing();
    (void)thread;
    for (size_t i = begin; i < end; i++) {
        const uint8_t *p = r->rgb[0] + 3 * i;
        add(&t.sums, (const double[3]){ p[0] / 255.0, p[1] / 255.0, p[2] / 255.0 }, 3);
    }
    r->tally[band] = t;
}

static dar_status check_rgb(dar_quality_run *r)
{
    size_t bytes = 3 * r->pixels, wrong = 0;
    DAR_TRY(dar_bundle_rgb(r->b, r->frame, r->rgb[0], r->e));
    dar_parallel(r->bands, rgb_band, r);
    tally t = merged(r);
    dar_quality_note(r, DAR_QUALITY_UNIFORM_RGB, dar_quality_deviation(&t.sums, 3), r->frame, "the picture alone");
    if (r->frame > 0 || !r->b->reference) return DAR_OK;
    DAR_TRY(dar_bundle_reference(r->b, r->rgb[1], r->e));
    for (size_t i = 0; i < bytes; i++) wrong += r->rgb[0][i] != r->rgb[1][i];
    dar_quality_note(r, DAR_QUALITY_REFERENCE, (double)wrong, 0, "of %zu", bytes);
    return DAR_OK;
}

/* ---------------------------------------------------------------- a frame */

void dar_quality_push(dar_quality_run *r, dar_arena *a)
{
    const dar_bundle *b = r->b;
    const dar_bundle_meta *m = &b->meta;
    size_t n = r->pixels;
    bool tracks = b->tracks > 0 && dar_bundle_has(b, DAR_FAMILY_TRACKING);
    r->bands = (n + BAND - 1) / BAND;
    r->tally = dar_arena_push(a, dar_mul_size(r->bands, sizeof *r->tally));
    r->cover = dar_arena_push(a, n);
    r->depth = dar_bundle_has(b, DAR_FAMILY_DEPTH) ? dar_arena_push(a, 4 * n) : NULL;
    r->id = dar_bundle_has(b, DAR_BUNDLE_ID) ? dar_arena_push(a, 4 * n) : NULL;
    r->part = dar_bundle_has(b, DAR_BUNDLE_PART) ? dar_arena_push(a, 4 * n) : NULL;
    for (int i = 0; i < 2; i++) r->rgb[i] = b->rgb ? dar_arena_push(a, 3 * n) : NULL;
    if (!tracks) return;
    r->xy = dar_arena_push(a, dar_mul_size(dar_mul_size(b->tracks, m->frames), 8));
    r->visible = dar_arena_push(a, dar_mul_size(b->tracks, m->frames));
    r->color = dar_arena_push(a, dar_mul_size(b->tracks, 3));
}

static dar_status check_cover(dar_quality_run *r)
{
    dar_plane p;
    size_t covered = 0;
    DAR_TRY(dar_bundle_plane(r->b, DAR_FAMILY_MASK, r->frame, &p, r->e));
    for (size_t i = 0; i < r->pixels; i++) {
        r->cover[i] = number_at(&p, i) > 0;
        covered += r->cover[i];
    }
    dar_quality_note(r, DAR_QUALITY_COVERAGE, (double)covered / (double)r->pixels, r->frame, "%zu pixels", covered);
    return DAR_OK;
}

dar_status dar_quality_frame(dar_quality_run *r, size_t frame)
{
    const dar_view *v = &r->b->cameras.view[frame];
    r->frame = frame;
    if (r->rgb[0]) DAR_TRY(check_rgb(r));
    if (!dar_bundle_has(r->b, DAR_FAMILY_MASK) && !r->depth) return DAR_OK;
    DAR_TRY(check_cover(r));
    if (r->depth) DAR_TRY(check_depth(r, v));
    if (r->id) DAR_TRY(check_numbers(r, DAR_BUNDLE_ID, r->id));
    if (r->part) DAR_TRY(check_numbers(r, DAR_BUNDLE_PART, r->part));
    if (dar_bundle_has(r->b, DAR_FAMILY_WORLD)) DAR_TRY(check_world(r, v));
    if (dar_bundle_has(r->b, DAR_FAMILY_NORMAL)) DAR_TRY(check_normal(r, v));
    if (dar_bundle_has(r->b, DAR_FAMILY_TRACKING)) DAR_TRY(check_tracking(r, v));
    return DAR_OK;
}
