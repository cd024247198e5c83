/* metric.c: metrics of a frame from sums over bands of rows, and their means over clips.
 *
 * Differences of bytes are summed as integers, so these sums are exact in any order; the others are added up band by
 * band. */
#include "data/metric.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "data/metric_inside.h"
#include "lib/size.h"
#include "lib/thread.h"

#define BAND 16    /* rows of a task */
#define BEST 1e-10 /* MSE that is as good as none, on the scale 0 .. 1 */

const char *const dar_metric_name[DAR_METRICS] = {
    [DAR_METRIC_PSNR] = "psnr",
    [DAR_METRIC_SSIM] = "ssim",
    [DAR_METRIC_FLIP] = "flip",
    [DAR_METRIC_TEMP] = "templ1",
    [DAR_METRIC_TEMP_TRUTH] = "templ1_truth",
    [DAR_METRIC_REF] = "refl1",
    [DAR_METRIC_SHARP] = "sharpness",
};

/* What a band, and then the frame, adds up. */
typedef struct sums {
    uint64_t pixels[DAR_METRIC_AREAS], windows[DAR_METRIC_AREAS];
    uint64_t whole[DAR_METRIC_AREAS][DAR_METRICS]; /* of integers */
    double real[DAR_METRIC_AREAS][DAR_METRICS];
    double slope[DAR_METRIC_AREAS]; /* of the truth; that of the result is real[DAR_METRIC_SHARP] */
} sums;

struct dar_metric {
    size_t width, height, bands;
    unsigned wanted;
    bool begun; /* the clip has a frame before this one */
    const uint8_t *reference;
    dar_flip flip;
    int threads;
    uint8_t *before[2]; /* the last frame of result and truth, rgb */
    uint8_t *inside;    /* [threads, 3 W] */
    double *window;     /* [threads, dar_ssim_work] */
    float *planes, *map, *row;
    sums *band;

    /* Of the frame at hand. */
    const uint8_t *found, *truth, *mask;
};

static bool wants(const dar_metric *m, dar_metric_kind k)
{
    return m->wanted >> k & 1;
}

/* ---------------------------------------------------------------- differences of bytes */

/* sum[k] += of all values, of those inside; a row at most, so that 32 bits hold it. */
static void squares(size_t n, const uint8_t *a, const uint8_t *b, const uint8_t *inside, uint64_t sum[2])
{
    uint32_t all = 0, in = 0;
    for (size_t i = 0; i < n; i++) {
        int32_t d = a[i] - b[i];
        uint32_t q = (uint32_t)(d * d);
        all += q;
        in += inside[i] ? q : 0;
    }
    sum[0] += all;
    sum[1] += in;
}

static void distances(size_t n, const uint8_t *a, const uint8_t *b, const uint8_t *inside, uint64_t sum[2])
{
    uint32_t all = 0, in = 0;
    for (size_t i = 0; i < n; i++) {
        uint32_t d = (uint32_t)abs(a[i] - b[i]);
        all += d;
        in += inside[i] ? d : 0;
    }
    sum[0] += all;
    sum[1] += in;
}

/* Of differences in time: (a - b) - (c - d). */
static void double_distances(size_t n, const uint8_t *a, const uint8_t *b, const uint8_t *c, const uint8_t *d,
                             const uint8_t *inside, uint64_t sum[2])
{
    uint32_t all = 0, in = 0;
    for (size_t i = 0; i < n; i++) {
        uint32_t v = (uint32_t)abs((a[i] - b[i]) - (c[i] - d[i]));
        all += v;
        in += inside[i] ? v : 0;
    }
    sum[0] += all;
    sum[1] += in;
}

static void differences(const dar_metric *m, size_t y, const uint8_t *inside, sums *s)
{
    size_t n = 3 * m->width, at = y * n;
    const uint8_t *found = m->found + at, *truth = m->truth + at;
    uint64_t got[DAR_METRICS][2] = { { 0 } };
    if (wants(m, DAR_METRIC_PSNR)) squares(n, found, truth, inside, got[DAR_METRIC_PSNR]);
    if (m->begun && wants(m, DAR_METRIC_TEMP)) distances(n, found, m->before[0] + at, inside, got[DAR_METRIC_TEMP]);
    if (m->begun && wants(m, DAR_METRIC_TEMP_TRUTH))
        double_distances(n, found, m->before[0] + at, truth, m->before[1] + at, inside, got[DAR_METRIC_TEMP_TRUTH]);
    if (m->reference && wants(m, DAR_METRIC_REF)) distances(n, found, m->reference + at, inside, got[DAR_METRIC_REF]);
    for (int k = 0; k < DAR_METRICS; k++)
        for (int a = 0; a < DAR_METRIC_AREAS; a++) s->whole[a][k] += got[k][a];
}

/* ---------------------------------------------------------------- slopes */

/* Of row y, which is not the last, and whose pixels but the last are looked at. */
static void slopes(const dar_metric *m, size_t y, const uint8_t *picture, const uint8_t *inside,
                   double sum[DAR_METRIC_AREAS])
{
    const size_t n = 3 * m->width;
    const uint8_t *here = picture + y * n, *below = here + n;
    for (size_t i = 0; i + 3 < n; i++) {
        int32_t across = here[i + 3] - here[i], down = below[i] - here[i];
        double slope = sqrt((double)(across * across + down * down));
        sum[DAR_METRIC_FRAME] += slope;
        sum[DAR_METRIC_MASK] += inside[i] ? slope : 0;
    }
}

static void sharpness(const dar_metric *m, size_t y, const uint8_t *inside, sums *s)
{
    double found[DAR_METRIC_AREAS] = { 0 };
    if (!wants(m, DAR_METRIC_SHARP) || y + 1 == m->height) return;
    slopes(m, y, m->found, inside, found);
    slopes(m, y, m->truth, inside, s->slope);
    for (int a = 0; a < DAR_METRIC_AREAS; a++) s->real[a][DAR_METRIC_SHARP] += found[a];
}

/* ---------------------------------------------------------------- bands */

static bool has_windows(const dar_metric *m)
{
    return wants(m, DAR_METRIC_SSIM) && dar_least(m->width, m->height) > 2 * DAR_SSIM_RADIUS;
}

static void count(const dar_metric *m, size_t y, uint8_t *inside, sums *s)
{
    size_t r = DAR_SSIM_RADIUS, in = 0, windows = 0;
    bool row = has_windows(m) && y >= r && y < m->height - r;
    for (size_t i = 0; i < m->width; i++) {
        bool here = m->mask && m->mask[y * m->width + i] >= 128;
        memset(inside + 3 * i, here ? 255 : 0, 3);
        in += here;
        windows += here && row && i >= r && i < m->width - r;
    }
    s->pixels[DAR_METRIC_FRAME] += m->width;
    s->pixels[DAR_METRIC_MASK] += in;
    s->windows[DAR_METRIC_FRAME] += row ? m->width - 2 * r : 0;
    s->windows[DAR_METRIC_MASK] += windows;
}

static void flip(dar_metric *m, size_t y, const uint8_t *inside, float *work, sums *s)
{
    size_t w = m->width, size = 3 * w * m->height;
    float *map = m->map + y * w;
    dar_flip_row(&m->flip, m->planes, m->planes + size, w, m->height, y, work, map);
    for (size_t i = 0; i < w; i++) {
        s->real[DAR_METRIC_FRAME][DAR_METRIC_FLIP] += map[i];
        if (inside[3 * i]) s->real[DAR_METRIC_MASK][DAR_METRIC_FLIP] += map[i];
    }
}

static void run_band(void *ctx, size_t i, int thread)
{
    dar_metric *m = ctx;
    sums *s = m->band + i;
    size_t values = 3 * m->width, r = DAR_SSIM_RADIUS;
    uint8_t *inside = m->inside + (size_t)thread * values;
    memset(s, 0, sizeof *s);
    for (size_t y = i * BAND; y < dar_least((i + 1) * BAND, m->height); y++) {
        double got[DAR_METRIC_AREAS] = { 0 };
        count(m, y, inside, s);
        differences(m, y, inside, s);
        sharpness(m, y, inside, s);
        if (has_windows(m) && y >= r && y < m->height - r)
            dar_ssim_row(m->found, m->truth, m->width, y, inside, m->window + (size_t)thread * dar_ssim_work(values),
                         got);
        for (int a = 0; a < DAR_METRIC_AREAS; a++) s->real[a][DAR_METRIC_SSIM] += got[a];
        if (wants(m, DAR_METRIC_FLIP)) flip(m, y, inside, m->row + (size_t)thread * dar_flip_work(m->width), s);
    }
}

static void run_opponent(void *ctx, size_t i, int thread)
{
    dar_metric *m = ctx;
    size_t size = 3 * m->width * m->height;
    (void)thread;
    for (size_t y = i * BAND; y < dar_least((i + 1) * BAND, m->height); y++) {
        dar_flip_opponent(&m->flip, m->found, m->width, m->height, y, m->planes);
        dar_flip_opponent(&m->flip, m->truth, m->width, m->height, y, m->planes + size);
    }
}

static sums total(const dar_metric *m)
{
    sums t = { 0 };
    for (size_t i = 0; i < m->bands; i++)
        for (int a = 0; a < DAR_METRIC_AREAS; a++) {
            t.pixels[a] += m->band[i].pixels[a];
            t.windows[a] += m->band[i].windows[a];
            t.slope[a] += m->band[i].slope[a];
            for (int k = 0; k < DAR_METRICS; k++) {
                t.whole[a][k] += m->band[i].whole[a][k];
                t.real[a][k] += m->band[i].real[a][k];
            }
        }
    return t;
}

/* ---------------------------------------------------------------- frames */

static double value(const dar_metric *m, const sums *s, int area, dar_metric_kind k)
{
    double values = 3 * (double)s->pixels[area], mean = (double)s->whole[area][k] / values;
    if (!wants(m, k) || !s->pixels[area]) return NAN;
    switch (k) {
    case DAR_METRIC_PSNR: return -10 * log10(fmax(mean / (255 * 255), BEST));
    case DAR_METRIC_SSIM: return s->windows[area] ? s->real[area][k] / (3 * (double)s->windows[area]) : NAN;
    case DAR_METRIC_FLIP: return s->real[area][k] / (double)s->pixels[area];
    case DAR_METRIC_REF: return m->reference ? mean : NAN;
    case DAR_METRIC_SHARP: return s->slope[area] > 0 ? s->real[area][k] / s->slope[area] : NAN;
    default: return m->begun ? mean : NAN;
    }
}

void dar_metric_frame(dar_metric *m, const uint8_t *found, const uint8_t *truth, const uint8_t *mask,
                      dar_metric_row *row)
{
    DAR_ASSERT(dar_threads() <= m->threads, "metric: opened for %d threads", m->threads);
    m->found = found;
    m->truth = truth;
    m->mask = mask;
    if (wants(m, DAR_METRIC_FLIP)) dar_parallel(m->bands, run_opponent, m);
    dar_parallel(m->bands, run_band, m);
    sums s = total(m);
    for (int a = 0; a < DAR_METRIC_AREAS; a++)
        for (int k = 0; k < DAR_METRICS; k++) row->v[a][k] = value(m, &s, a, (dar_metric_kind)k);
    memcpy(m->before[0], found, 3 * m->width * m->height);
    memcpy(m->before[1], truth, 3 * m->width * m->height);
    m->begun = true;
}

const float *dar_metric_map(const dar_metric *m)
{
    return m->map;
}

void dar_metric_begin(dar_metric *m, const uint8_t *reference)
{
    m->reference = reference;
    m->begun = false;
}

dar_status dar_metric_open(dar_metric **out, size_t width, size_t height, unsigned wanted, dar_err *e)
{
    dar_metric *m = *out = calloc(1, sizeof *m);
    size_t pixels = width * height, threads = (size_t)dar_threads();
    if (!m) return dar_fail(e, DAR_ERR_NOMEM, "metrics: out of memory");
    *m = (dar_metric){ .width = width, .height = height, .wanted = wanted, .threads = (int)threads };
    m->bands = dar_blocks(height, BAND);
    m->band = calloc(m->bands, sizeof *m->band);
    m->before[0] = malloc(3 * pixels);
    m->before[1] = malloc(3 * pixels);
    m->inside = malloc(threads * 3 * width);
    m->window = malloc(threads * dar_ssim_work(3 * width) * sizeof *m->window);
    bool ok = m->band && m->before[0] && m->before[1] && m->inside && m->window;
    if (wants(m, DAR_METRIC_FLIP)) {
        dar_flip_init(&m->flip);
        m->planes = malloc(2 * 3 * pixels * sizeof *m->planes);
        m->map = malloc(pixels * sizeof *m->map);
        m->row = malloc(threads * dar_flip_work(width) * sizeof *m->row);
        ok = ok && m->planes && m->map && m->row;
    }
    if (ok) return DAR_OK;
    dar_metric_close(m);
    *out = NULL;
    return dar_fail(e, DAR_ERR_NOMEM, "metrics: out of memory for pictures of %zu x %zu", width, height);
}

void dar_metric_close(dar_metric *m)
{
    if (!m) return;
    free(m->before[0]);
    free(m->before[1]);
    free(m->inside);
    free(m->window);
    free(m->planes);
    free(m->map);
    free(m->row);
    free(m->band);
    free(m);
}

/* ---------------------------------------------------------------- clips */

void dar_metric_clip_add(dar_metric_clip *c, const dar_metric_row *row)
{
    for (int a = 0; a < DAR_METRIC_AREAS; a++)
        for (int k = 0; k < DAR_METRICS; k++)
            if (!isnan(row->v[a][k])) {
                c->sum[a][k] += row->v[a][k];
                c->n[a][k]++;
            }
}

void dar_metric_clip_mean(const dar_metric_clip *c, dar_metric_row *mean)
{
    for (int a = 0; a < DAR_METRIC_AREAS; a++)
        for (int k = 0; k < DAR_METRICS; k++) mean->v[a][k] = c->n[a][k] ? c->sum[a][k] / (double)c->n[a][k] : NAN;
}
