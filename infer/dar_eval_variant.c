/* dar_eval_variant.c: one scene rendered with many references: does its shape stay, and does its appearance follow?
 *
 * The shape is that of objects: of what is covered, all but the object called "ground"; without object ids, all of it.
 *
 * Silhouette: a pixel of a render is taken for an object if it differs from what lies behind, wherever the geometry has
 * its objects.  What lies behind is the truth where it shows no object, and where it shows one, the mean of the nearest
 * pixels to the left, right, above and below that show none, each counting by 1 / distance; all that in the colours of
 * the render, by the affine map of colours that fits best, in squares, where there is no object.  To differ means by
 * more, in the channel that differs most, than half of what the true objects typically do: the median over their
 * pixels.  So what counts is that something is there, not which colour it or its surroundings have, and no network has
 * to be believed.  The truth itself does not reach 1, since things may look like what is behind them; how far it gets
 * is told with the table.
 *
 * Appearance: the mean L1 distance of the objects' pixels, 0 to 255, from the truth of the render's own reference, and
 * from that of the other reference that comes nearest.
 *
 * Frame 0, which is given, does not count. */
#include "infer/dar_eval.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "lib/log.h"

const char *const dar_eval_variant_name[DAR_EVAL_VARIANTS] = { "iou", "own", "other", "margin", "nearest_own" };

struct dar_eval_variant {
    size_t width, height, frames, points, clips, own; /* points: pixels of objects; own: which of the clips this is */
    uint8_t *object;                                  /* [T, H, W] 1: an object is there */
    uint8_t *behind;                                  /* [T, H, W, 3] */
    uint8_t *colour;                                  /* [clips, points, 3] of the truths */
    int threshold;                                    /* of a difference from what lies behind */

    /* Of the method at hand. */
    size_t both, either, at; /* pixels; points so far */
    uint64_t *distance;      /* [clips] */
};

/* ---------------------------------------------------------------- geometry */

static uint32_t ground_of(const dar_bundle_meta *m)
{
    for (size_t i = 0; i < m->objects; i++)
        if (m->object[i].name && strcmp(m->object[i].name, "ground") == 0) return (uint32_t)i + 1;
    return 0;
}

/* Where frame t shows an object, y [H, W]; work [H, W] of 4 bytes. */
static dar_status objects_of(dar_bundle *b, size_t t, uint8_t *y, void *work, dar_err *e)
{
    size_t pixels = (size_t)b->meta.width * (size_t)b->meta.height;
    const uint32_t *id = work, ground = ground_of(&b->meta);
    const float *cover = work;
    if (dar_bundle_has(b, DAR_BUNDLE_ID)) {
        DAR_TRY(dar_bundle_numbers(b, DAR_BUNDLE_ID, t, work, e));
        for (size_t i = 0; i < pixels; i++) y[i] = id[i] && id[i] != ground;
    } else {
        DAR_TRY(dar_bundle_values(b, DAR_FAMILY_MASK, t, work, e));
        for (size_t i = 0; i < pixels; i++) y[i] = cover[i] >= 0.5f;
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- what lies behind */

/* Along n pixels: sum [.., 4] of colours of the last pixel without object, and of their weights. */
static void sweep(const uint8_t *rgb, const uint8_t *object, float *sum, size_t from, ptrdiff_t step, size_t n)
{
    const uint8_t *last = NULL;
    float distance = 0;
    for (size_t k = 0, i = from; k < n; k++, i += (size_t)step) {
        distance++;
        if (!object[i]) {
            last = rgb + 3 * i;
            distance = 0;
        } else if (last) {
            for (int c = 0; c < 3; c++) sum[4 * i + (size_t)c] += (float)last[c] / distance;
            sum[4 * i + 3] += 1 / distance;
        }
    }
}

/* y [H, W, 3]; grey where nothing tells. */
static void look_behind(const dar_eval_variant *x, const uint8_t *rgb, const uint8_t *object, float *sum, uint8_t *y)
{
    const size_t w = x->width, h = x->height;
    memset(sum, 0, 4 * w * h * sizeof *sum);
    for (size_t i = 0; i < h; i++) {
        sweep(rgb, object, sum, i * w, 1, w);
        sweep(rgb, object, sum, i * w + w - 1, -1, w);
    }
    for (size_t i = 0; i < w; i++) {
        sweep(rgb, object, sum, i, (ptrdiff_t)w, h);
        sweep(rgb, object, sum, (h - 1) * w + i, -(ptrdiff_t)w, h);
    }
    memcpy(y, rgb, 3 * w * h);
    for (size_t i = 0; i < w * h; i++)
        for (size_t c = 0; c < 3 && object[i]; c++)
            y[3 * i + c] = sum[4 * i + 3] > 0 ? (uint8_t)(sum[4 * i + c] / sum[4 * i + 3] + 0.5f) : 128;
}

static int difference(const uint8_t *a, const uint8_t *b)
{
    int most = 0;
    for (int c = 0; c < 3; c++) most = abs(a[c] - b[c]) > most ? abs(a[c] - b[c]) : most;
    return most;
}

#define STIFF 2    /* the map tends to the identity as if values were off by so much: flat pictures say nothing */
#define TINY  1e-9 /* there may be objects everywhere */

/* map [3, 4] of colours before to those of a frame, by least squares where there is no object. */
static void fit_colours(const uint8_t *before, const uint8_t *found, const uint8_t *object, size_t n, double map[3][4])
{
    double a[4][7] = { { 0 } };
    for (size_t i = 0; i < n; i++) {
        if (object[i]) continue;
        const double x[4] = { before[3 * i], before[3 * i + 1], before[3 * i + 2], 1 };
        for (int r = 0; r < 4; r++) {
            for (int c = 0; c < 4; c++) a[r][c] += x[r] * x[c];
            for (int c = 0; c < 3; c++) a[r][4 + c] += x[r] * found[3 * i + (size_t)c];
        }
    }
    for (int r = 0; r < 3; r++) {
        a[r][r] += STIFF * STIFF * (double)n;
        a[r][4 + r] += STIFF * STIFF * (double)n;
    }
    a[3][3] += TINY;
    for (int k = 0; k < 4; k++) /* Gauss and Jordan; the matrix is positive definite */
        for (int r = 0; r < 4; r++)
            for (int c = 6; r != k && c >= k; c--) a[r][c] -= a[r][k] / a[k][k] * a[k][c];
    for (int c = 0; c < 3; c++)
        for (int k = 0; k < 4; k++) map[c][k] = a[k][4 + c] / a[k][k];
}

/* In the channel that differs most, after the map. */
static double mapped_difference(const uint8_t *found, const uint8_t *behind, double map[3][4])
{
    double most = 0;
    for (int c = 0; c < 3; c++) {
        const double *m = map[c];
        most = fmax(most, fabs(found[c] - (m[0] * behind[0] + m[1] * behind[1] + m[2] * behind[2] + m[3])));
    }
    return most;
}

static int find_threshold(const dar_eval_variant *x, const uint8_t *truth)
{
    const size_t pixels = x->width * x->height;
    size_t count[256] = { 0 }, sum = 0;
    int median = 0;
    for (size_t i = pixels; i < x->frames * pixels; i++)
        if (x->object[i]) count[difference(truth + 3 * i, x->behind + 3 * i)]++;
    while (median < 255 && 2 * (sum + count[median]) < x->points) sum += count[median++];
    return median / 2;
}

/* ---------------------------------------------------------------- a clip */

/* The truth of clip j of the set where objects are; *same: it has the geometry of this clip. */
static dar_status read_truth(dar_eval_variant *x, const dar_eval_clip *clip, size_t j, uint8_t *work, bool *same,
                             dar_err *e)
{
    const size_t pixels = x->width * x->height;
    uint8_t *to = x->colour + j * 3 * x->points, *object = work, *rgb = work + pixels;
    dar_bundle *b;
    *same = clip->width == x->width && clip->height == x->height && clip->frames == x->frames;
    if (!*same) return DAR_OK;
    DAR_TRY(dar_bundle_open(&b, clip->path, e));
    dar_status s = DAR_OK;
    for (size_t t = 1; t < x->frames && s == DAR_OK && *same; t++) {
        s = objects_of(b, t, object, rgb, e);
        *same = s == DAR_OK && memcmp(object, x->object + t * pixels, pixels) == 0;
        if (*same) s = dar_bundle_rgb(b, t, rgb, e);
        for (size_t i = 0; i < pixels && *same && s == DAR_OK; i++) {
            if (!object[i]) continue;
            memcpy(to, rgb + 3 * i, 3);
            to += 3;
        }
    }
    dar_bundle_close(b);
    return s;
}

/* Objects, what lies behind them, and their colours in all truths of the set; *same: all have one geometry. */
static dar_status read_all(dar_eval_variant *x, const dar_eval *v, size_t c, dar_bundle *b, const uint8_t *truth,
                           bool *same, dar_err *e)
{
    const size_t pixels = x->width * x->height;
    float *work = malloc(4 * pixels * sizeof *work);
    size_t j = 0;
    x->object = malloc(x->frames * pixels);
    x->behind = malloc(x->frames * 3 * pixels);
    x->distance = calloc(x->clips, sizeof *x->distance);
    dar_status s = work && x->object && x->behind && x->distance ? DAR_OK : DAR_ERR_NOMEM;
    for (size_t t = 0; t < x->frames && s == DAR_OK; t++) {
        uint8_t *object = x->object + t * pixels;
        s = objects_of(b, t, object, work, e);
        look_behind(x, truth + 3 * t * pixels, object, work, x->behind + 3 * t * pixels);
        for (size_t i = 0; i < pixels && t; i++) x->points += object[i];
    }
    if (s == DAR_OK) {
        x->threshold = find_threshold(x, truth);
        if (!(x->colour = malloc(x->clips * 3 * x->points + 1))) s = DAR_ERR_NOMEM;
    }
    for (size_t i = 0; i < v->clips && s == DAR_OK && *same; i++) {
        if (strcmp(v->clip[i].set, v->clip[c].set) != 0) continue;
        if (i == c) x->own = j;
        s = read_truth(x, &v->clip[i], j++, (uint8_t *)work, same, e);
        if (s == DAR_OK && !*same)
            dar_log(DAR_LOG_WARNING, "%s: its geometry is not that of %s: nothing is told of variants", v->clip[i].path,
                    v->clip[c].path);
    }
    free(work);
    return s == DAR_ERR_NOMEM ? dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory for variants", v->clip[c].path) : s;
}

dar_status dar_eval_variant_open(dar_eval_variant **out, dar_eval *v, size_t c, dar_bundle *b, const uint8_t *truth,
                                 dar_err *e)
{
    dar_eval_clip *clip = &v->clip[c];
    bool same = true;
    *out = NULL;
    if (strcmp(clip->set, "refvar") != 0 || clip->frames < 2) return DAR_OK;
    if (!dar_bundle_has(b, DAR_BUNDLE_ID) && !clip->masks) return DAR_OK;
    dar_eval_variant *x = calloc(1, sizeof *x);
    if (!x) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", clip->path);
    *x = (dar_eval_variant){ .width = clip->width, .height = clip->height, .frames = clip->frames };
    for (size_t i = 0; i < v->clips; i++) x->clips += strcmp(v->clip[i].set, clip->set) == 0;
    dar_status s = read_all(x, v, c, b, truth, &same, e);
    if (s == DAR_OK && same && x->points) {
        const size_t size = 3 * x->width * x->height;
        double row[DAR_EVAL_VARIANTS];
        for (size_t t = 0; t < x->frames; t++) dar_eval_variant_frame(x, t, truth + t * size);
        dar_eval_variant_end(x, row);
        clip->seen = row[DAR_EVAL_VARIANT_IOU];
        *out = x;
    } else {
        dar_eval_variant_close(x);
    }
    return s;
}

void dar_eval_variant_close(dar_eval_variant *x)
{
    if (!x) return;
    free(x->object);
    free(x->behind);
    free(x->colour);
    free(x->distance);
    free(x);
}

/* ---------------------------------------------------------------- renders */

void dar_eval_variant_frame(dar_eval_variant *x, size_t t, const uint8_t *found)
{
    const size_t pixels = x->width * x->height;
    const uint8_t *object = x->object + t * pixels, *behind = x->behind + 3 * t * pixels;
    double map[3][4];
    if (t) fit_colours(behind, found, object, pixels, map);
    for (size_t i = 0; i < pixels && t; i++) {
        bool seen = mapped_difference(found + 3 * i, behind + 3 * i, map) > x->threshold;
        x->both += seen && object[i];
        x->either += seen || object[i];
        if (!object[i]) continue;
        for (size_t j = 0; j < x->clips; j++) {
            const uint8_t *truth = x->colour + 3 * (j * x->points + x->at);
            for (size_t c = 0; c < 3; c++) x->distance[j] += (uint64_t)abs(found[3 * i + c] - truth[c]);
        }
        x->at++;
    }
}

void dar_eval_variant_end(dar_eval_variant *x, double row[DAR_EVAL_VARIANTS])
{
    double other = NAN, values = 3 * (double)x->points;
    for (size_t j = 0; j < x->clips; j++)
        if (j != x->own) other = fmin(other, (double)x->distance[j] / values); /* of a number and NAN, the number */
    double own = (double)x->distance[x->own] / values;
    row[DAR_EVAL_VARIANT_IOU] = (double)x->both / (double)x->either;
    row[DAR_EVAL_VARIANT_OWN] = own;
    row[DAR_EVAL_VARIANT_OTHER] = other;
    row[DAR_EVAL_VARIANT_MARGIN] = other - own;
    row[DAR_EVAL_VARIANT_NEAREST] = isnan(other) ? NAN : own < other;
    x->both = x->either = x->at = 0;
    memset(x->distance, 0, x->clips * sizeof *x->distance);
}

dar_interval dar_eval_variant_interval(dar_eval *v, size_t m, const char *set, dar_eval_variant_number k)
{
    size_t n = 0;
    for (size_t c = 0; c < v->clips; c++) {
        const dar_eval_cell *x = dar_eval_at(v, m, c);
        if (x->there && strcmp(v->clip[c].set, set) == 0 && !isnan(x->variant[k])) v->value[n++] = x->variant[k];
    }
    return dar_stats_bootstrap(v->value, n, v->seed, v->work);
}
