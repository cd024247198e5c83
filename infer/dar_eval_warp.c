/* dar_eval_warp.c: what is known of a clip from frame 0 alone, if one knows where every point of every surface goes.
 *
 * Identities (data/identity.h) are points in a cube, the same for an element at any time; every part has a cell of it
 * and a scale of its own.  Those of frame 0 lie in a grid, finer or coarser by part; an element of frame t takes the
 * colour of the nearest one.  It is shown by frame 0 if that one is no farther than neighbouring pixels are from each
 * other, there or here: else it was hidden, or outside. */
#include "infer/dar_eval.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "data/identity.h"
#include "lib/size.h"
#include "lib/thread.h"

#define BAND   16    /* rows of a task */
#define WIDEST 4.f   /* a distance of neighbours counts up to so many times the usual one */
#define FINEST 1e-6f /* the usual one, at least */
#define LONELY 0.05f /* the usual one, of a pixel that has no neighbour, in cells of the cube */

struct dar_eval_warp {
    dar_bundle *b;
    const uint8_t *first;
    size_t width, height, buckets;
    size_t side;            /* cells along the cube */
    float *q[2], *reach[2]; /* identities [3, H, W], distance of neighbours [H, W]: of frame 0, of the one at hand */
    float *covered[2];      /* [H, W] */
    uint32_t *part[2];      /* [H, W] */
    float *usual;           /* [parts] distance of neighbours in frame 0; 0: it shows none of the part */
    uint32_t *start, *item; /* [buckets + 1]; [items] pixels of frame 0 by bucket */
    size_t (*lost)[2];      /* [bands] */
    uint8_t *rgb;
};

static bool is_covered(const dar_eval_warp *w, int k, size_t i)
{
    return w->covered[k][i] >= 0.5f;
}

static float squared(const dar_eval_warp *w, int k, size_t i, int l, size_t j)
{
    size_t plane = w->width * w->height;
    float sum = 0;
    for (size_t c = 0; c < 3; c++) {
        float d = w->q[k][c * plane + i] - w->q[l][c * plane + j];
        sum += d * d;
    }
    return sum;
}

static bool hang_together(const dar_eval_warp *w, int k, size_t i, size_t j)
{
    return is_covered(w, k, j) && w->part[k][i] == w->part[k][j];
}

/* Distance from a pixel to the nearer of two neighbours of its part; 0: there is none. */
static float nearer(const dar_eval_warp *w, int k, size_t i, bool before, bool after, size_t step)
{
    float a = before && hang_together(w, k, i, i - step) ? squared(w, k, i, k, i - step) : INFINITY;
    float b = after && hang_together(w, k, i, i + step) ? squared(w, k, i, k, i + step) : INFINITY;
    float least = a < b ? a : b;
    return isinf(least) ? 0 : sqrtf(least);
}

struct measuring {
    dar_eval_warp *w;
    int k;
};

static void name_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const struct measuring *m = ctx;
    const dar_eval_warp *w = m->w;
    size_t plane = w->width * w->height;
    (void)thread;
    for (size_t i = begin * w->width; i < end * w->width; i++) {
        const float *q = w->q[m->k] + i;
        const double at[3] = { q[0], q[plane], q[2 * plane] };
        w->part[m->k][i] = (uint32_t)dar_identity_cell_of(w->side, at);
    }
}

/* Along the row and down the column: the farther of the two, since surfaces are seen aslant. */
static void measure_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const struct measuring *m = ctx;
    const dar_eval_warp *w = m->w;
    (void)thread;
    for (size_t y = begin; y < end; y++)
        for (size_t x = 0; x < w->width; x++) {
            size_t i = y * w->width + x;
            float across = nearer(w, m->k, i, x > 0, x + 1 < w->width, 1);
            float down = nearer(w, m->k, i, y > 0, y + 1 < w->height, w->width);
            w->reach[m->k][i] = across > down ? across : down;
        }
}

static dar_status load(dar_eval_warp *w, int k, size_t t, dar_err *e)
{
    struct measuring m = { w, k };
    DAR_TRY(dar_bundle_values(w->b, DAR_FAMILY_TRACKING, t, w->q[k], e));
    DAR_TRY(dar_bundle_values(w->b, DAR_FAMILY_MASK, t, w->covered[k], e));
    dar_parallel_range(w->height, BAND, name_rows, &m);
    dar_parallel_range(w->height, BAND, measure_rows, &m);
    return DAR_OK;
}

/* ---------------------------------------------------------------- the grid */

static uint32_t bucket_of(const dar_eval_warp *w, uint32_t part, const int32_t at[3])
{
    uint32_t h = (uint32_t)at[0] * 73856093u ^ (uint32_t)at[1] * 19349663u ^ (uint32_t)at[2] * 83492791u;
    h ^= part * 2654435761u;
    return (h ^ h >> 15) & (uint32_t)(w->buckets - 1);
}

static void place_of(const dar_eval_warp *w, int k, size_t i, int32_t at[3])
{
    size_t plane = w->width * w->height;
    float side = WIDEST * w->usual[w->part[k][i]];
    for (size_t c = 0; c < 3; c++) at[c] = (int32_t)(w->q[k][c * plane + i] / side);
}

/* The mean distance of neighbours of each part. */
static bool measure_parts(dar_eval_warp *w)
{
    size_t pixels = w->width * w->height, parts = w->side * w->side * w->side;
    uint32_t *count = calloc(parts, sizeof *count);
    w->usual = calloc(parts, sizeof *w->usual);
    for (size_t i = 0; i < pixels && count && w->usual; i++) {
        if (!is_covered(w, 0, i)) continue;
        w->usual[w->part[0][i]] += w->reach[0][i] > 0 ? w->reach[0][i] : LONELY / (float)w->side;
        count[w->part[0][i]]++;
    }
    bool ok = count && w->usual;
    for (size_t p = 0; ok && p < parts; p++)
        if (count[p]) w->usual[p] = fmaxf(w->usual[p] / (float)count[p], FINEST);
    free(count);
    return ok;
}

/* Pixels of frame 0 by bucket: counted, then placed. */
static void fill(dar_eval_warp *w)
{
    size_t pixels = w->width * w->height;
    int32_t at[3];
    for (size_t pass = 0; pass < 2; pass++) {
        for (size_t i = pixels; i-- > 0;) {
            if (!is_covered(w, 0, i)) continue;
            place_of(w, 0, i, at);
            uint32_t *s = &w->start[bucket_of(w, w->part[0][i], at)];
            if (pass) w->item[--*s] = (uint32_t)i;
            else ++*s;
        }
        for (size_t k = 0, sum = 0; k <= w->buckets && !pass; k++) w->start[k] = (uint32_t)(sum += w->start[k]);
    }
}

/* ---------------------------------------------------------------- frames */

/* The pixel of frame 0 nearest to pixel i of the frame at hand, in its part and among the cells around; SIZE_MAX: there
 * is none. */
static size_t nearest(const dar_eval_warp *w, size_t i, float *distance)
{
    size_t best = SIZE_MAX;
    int32_t mid[3], at[3];
    float least = INFINITY;
    uint32_t part = w->part[1][i];
    if (w->usual[part] == 0) return SIZE_MAX;
    place_of(w, 1, i, mid);
    for (int k = 0; k < 27; k++) {
        at[0] = mid[0] + k % 3 - 1;
        at[1] = mid[1] + k / 3 % 3 - 1;
        at[2] = mid[2] + k / 9 - 1;
        uint32_t bucket = bucket_of(w, part, at);
        for (uint32_t p = w->start[bucket]; p < w->start[bucket + 1]; p++) {
            float d = w->part[0][w->item[p]] == part ? squared(w, 1, i, 0, w->item[p]) : INFINITY;
            if (d < least || (d == least && d < INFINITY && w->item[p] < best)) {
                least = d;
                best = w->item[p];
            }
        }
    }
    *distance = sqrtf(least);
    return best;
}

static bool shows(const dar_eval_warp *w, size_t here, size_t there, float distance)
{
    float reach = fmaxf(w->reach[0][there], w->reach[1][here]), usual = w->usual[w->part[1][here]];
    return distance <= fminf(fmaxf(reach, usual), WIDEST * usual);
}

static void carry_rows(void *ctx, size_t begin, size_t end, int thread)
{
    dar_eval_warp *w = ctx;
    size_t *lost = w->lost[begin / BAND];
    (void)thread;
    lost[0] = lost[1] = 0;
    for (size_t i = begin * w->width; i < end * w->width; i++) {
        float distance;
        size_t from = i;
        if (is_covered(w, 1, i)) {
            size_t found = nearest(w, i, &distance);
            if (found != SIZE_MAX) from = found;
            lost[0] += found == SIZE_MAX || !shows(w, i, found, distance);
            lost[1]++;
        }
        memcpy(w->rgb + 3 * i, w->first + 3 * from, 3);
    }
}

dar_status dar_eval_warp_frame(dar_eval_warp *w, size_t t, uint8_t *rgb, size_t lost[2], dar_err *e)
{
    DAR_TRY(load(w, 1, t, e));
    w->rgb = rgb;
    dar_parallel_range(w->height, BAND, carry_rows, w);
    lost[0] = lost[1] = 0;
    for (size_t i = 0; i < dar_blocks(w->height, BAND); i++)
        for (int k = 0; k < 2; k++) lost[k] += w->lost[i][k];
    return DAR_OK;
}

dar_status dar_eval_warp_open(dar_eval_warp **out, dar_bundle *b, const uint8_t *first, dar_err *e)
{
    dar_eval_warp *w = *out = calloc(1, sizeof *w);
    size_t pixels = (size_t)b->meta.width * (size_t)b->meta.height;
    if (!w) return dar_fail(e, DAR_ERR_NOMEM, "oracle warp: out of memory");
    *w = (dar_eval_warp){ .b = b, .first = first, .buckets = 1 };
    w->width = (size_t)b->meta.width;
    w->height = (size_t)b->meta.height;
    while (w->buckets < pixels) w->buckets *= 2;
    size_t parts = 0;
    for (size_t i = 0; i < b->meta.objects; i++) parts += b->meta.object[i].parts;
    w->side = parts ? dar_identity_side(parts) : 1;
    bool ok = true;
    for (int k = 0; k < 2; k++) {
        ok = (w->q[k] = malloc(3 * pixels * sizeof *w->q[k])) && ok;
        ok = (w->reach[k] = malloc(pixels * sizeof *w->reach[k])) && ok;
        ok = (w->part[k] = malloc(pixels * sizeof *w->part[k])) && ok;
        ok = (w->covered[k] = malloc(pixels * sizeof *w->covered[k])) && ok;
    }
    w->start = calloc(w->buckets + 1, sizeof *w->start);
    w->item = malloc(pixels * sizeof *w->item);
    w->lost = malloc(dar_blocks(w->height, BAND) * sizeof *w->lost);
    dar_status s =
        ok && w->start && w->item && w->lost ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "oracle warp: out of memory");
    if (s == DAR_OK) s = load(w, 0, 0, e);
    if (s == DAR_OK && !measure_parts(w)) s = dar_fail(e, DAR_ERR_NOMEM, "oracle warp: out of memory");
    if (s == DAR_OK) {
        fill(w);
    } else {
        dar_eval_warp_close(w);
        *out = NULL;
    }
    return s;
}

void dar_eval_warp_close(dar_eval_warp *w)
{
    if (!w) return;
    for (int k = 0; k < 2; k++) {
        free(w->q[k]);
        free(w->reach[k]);
        free(w->part[k]);
        free(w->covered[k]);
    }
    free(w->usual);
    free(w->start);
    free(w->item);
    free(w->lost);
    free(w);
}
