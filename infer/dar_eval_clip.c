/* dar_eval_clip.c: the pictures of every method on one clip against the truth. */
#include "infer/dar_eval.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "data/pictures.h"
#include "infer/dar_eval_film.h"
#include "lib/log.h"
#include "lib/program.h"

struct work {
    dar_eval *v;
    size_t c, frames, pixels;
    dar_eval_clip *clip;
    dar_bundle *b;
    uint8_t *truth, *mask, *found; /* [T, H, W, 3]; [T, H, W] or NULL; [H, W, 3] */
    dar_metric *metric;
    dar_lpips *lpips[DAR_LPIPS_NETS];
    dar_eval_warp *warp;
    dar_eval_variant *variant; /* NULL: the clip is none */
    dar_eval_film *film;       /* NULL: none is wanted */
};

/* ---------------------------------------------------------------- means */

struct sums {
    double sum[DAR_METRIC_AREAS][DAR_EVAL_MEASURES];
    size_t n[DAR_METRIC_AREAS][DAR_EVAL_MEASURES];
};

static void add(struct sums *s, const dar_eval_row *row)
{
    for (int a = 0; a < DAR_METRIC_AREAS; a++)
        for (int k = 0; k < DAR_EVAL_MEASURES; k++)
            if (!isnan(row->v[a][k])) {
                s->sum[a][k] += row->v[a][k];
                s->n[a][k]++;
            }
}

static void mean(const struct sums *s, dar_eval_row *row)
{
    for (int a = 0; a < DAR_METRIC_AREAS; a++)
        for (int k = 0; k < DAR_EVAL_MEASURES; k++) row->v[a][k] = s->n[a][k] ? s->sum[a][k] / (double)s->n[a][k] : NAN;
}

static void finish_cell(const struct work *w, dar_eval_cell *cell)
{
    struct sums all = { 0 }, later = { 0 };
    for (size_t t = 0; t < w->frames; t++) {
        add(&all, &cell->frame[t]);
        if (t) add(&later, &cell->frame[t]);
    }
    mean(&all, &cell->span[DAR_EVAL_ALL]);
    mean(&later, &cell->span[DAR_EVAL_LATER]);
    cell->span[DAR_EVAL_LAST] = cell->frame[w->frames - 1];
    for (int k = 0; k < DAR_EVAL_VARIANTS; k++) cell->variant[k] = NAN;
    if (w->variant) dar_eval_variant_end(w->variant, cell->variant);
    cell->there = true;
}

/* ---------------------------------------------------------------- a frame */

static void measure(struct work *w, size_t m, size_t t)
{
    const uint8_t *truth = w->truth + 3 * w->pixels * t, *mask = w->mask ? w->mask + w->pixels * t : NULL;
    dar_eval_row *row = &dar_eval_at(w->v, m, w->c)->frame[t];
    dar_metric_row pixels;
    dar_metric_frame(w->metric, w->found, truth, mask, &pixels);
    for (int a = 0; a < DAR_METRIC_AREAS; a++)
        for (int k = 0; k < DAR_METRICS; k++) row->v[a][k] = pixels.v[a][k];
    for (int net = 0; net < DAR_LPIPS_NETS; net++) {
        double d[DAR_METRIC_AREAS] = { NAN, NAN };
        if (w->lpips[net]) dar_lpips_distance(w->lpips[net], w->found, truth, mask, d);
        for (int a = 0; a < DAR_METRIC_AREAS; a++) row->v[a][DAR_EVAL_ALEX + net] = d[a];
    }
    if (w->variant) dar_eval_variant_frame(w->variant, t, w->found);
    if (w->film) dar_eval_film_add(w->film, 1 + m, t, w->found, dar_metric_map(w->metric));
    dar_eval_sheet_show(w->v, w->c, m, t, w->found);
}

size_t dar_eval_same_time(size_t t, size_t to, size_t from)
{
    return to > 1 ? (2 * t * (from - 1) + (to - 1)) / (2 * (to - 1)) : 0;
}

static dar_status check_length(const struct work *w, const char *path, size_t frames, bool resized, dar_err *e)
{
    const dar_eval_clip *c = w->clip;
    if (w->v->align || (frames == w->frames && !resized)) return DAR_OK;
    if (resized)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found another size than %zu x %zu, or use --align normalized-time",
                        path, c->width, c->height);
    return dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu frames, expected %zu, or use --align normalized-time", path,
                    frames, w->frames);
}

static dar_status run_pictures(struct work *w, size_t m, const char *path, dar_err *e)
{
    dar_eval_cell *cell = dar_eval_at(w->v, m, w->c);
    dar_pictures *p;
    size_t frames, read = 0;
    DAR_TRY(dar_pictures_open_any(&p, path, w->clip->width, w->clip->height, &frames, e));
    dar_status s = check_length(w, path, frames, dar_pictures_resized(p), e);
    for (size_t t = 0; t < w->frames && s == DAR_OK; t++) {
        for (size_t last = dar_eval_same_time(t, w->frames, frames); read <= last && s == DAR_OK; read++)
            s = dar_pictures_read(p, w->found, e);
        if (s == DAR_OK) s = check_length(w, path, frames, dar_pictures_resized(p), e);
        if (s == DAR_OK) measure(w, m, t);
    }
    cell->aligned = frames != w->frames || dar_pictures_resized(p);
    dar_pictures_close(p);
    return s;
}

static dar_status run_repeat(struct work *w, size_t m)
{
    memcpy(w->found, w->truth, 3 * w->pixels);
    for (size_t t = 0; t < w->frames; t++) measure(w, m, t);
    return DAR_OK;
}

static dar_status run_warp(struct work *w, size_t m, dar_err *e)
{
    double sum = 0, n = 0;
    DAR_TRY(dar_eval_warp_open(&w->warp, w->b, w->truth, e));
    for (size_t t = 0; t < w->frames; t++) {
        size_t lost[2];
        DAR_TRY(dar_eval_warp_frame(w->warp, t, w->found, lost, e));
        measure(w, m, t);
        double share = lost[1] ? (double)lost[0] / (double)lost[1] : NAN;
        w->clip->lost[1] = share;
        if (!isnan(share)) sum += share, n++;
    }
    w->clip->lost[0] = n > 0 ? sum / n : NAN;
    return DAR_OK;
}

struct showing {
    struct work *w;
    size_t m;
};

static dar_status show_frame(void *ctx, size_t index, const uint8_t *rgb, dar_err *e)
{
    const struct showing *s = ctx;
    (void)e;
    memcpy(s->w->found, rgb, 3 * s->w->pixels);
    measure(s->w, s->m, index);
    return DAR_OK;
}

static dar_status run_codec(struct work *w, size_t m, dar_err *e)
{
    struct showing s = { w, m };
    return dar_eval_codec_run(w->v->codec, w->clip, w->truth, show_frame, &s, e);
}

static dar_status run_method(struct work *w, size_t m, dar_err *e)
{
    dar_eval_method *method = &w->v->method[m];
    dar_eval_cell *cell = dar_eval_at(w->v, m, w->c);
    char path[PATH_MAX];
    bool there = method->kind != DAR_EVAL_GIVEN || dar_eval_find(w->v, m, w->c, path);
    if (method->kind == DAR_EVAL_WARP && !(dar_bundle_has(w->b, DAR_FAMILY_TRACKING) && w->mask)) there = false;
    if (!there) return DAR_OK;
    if (!(cell->frame = calloc(w->frames, sizeof *cell->frame)))
        return dar_fail(e, DAR_ERR_NOMEM, "dar-eval: out of memory");
    dar_metric_begin(w->metric, w->truth);
    dar_status s = method->kind == DAR_EVAL_REPEAT  ? run_repeat(w, m)
                   : method->kind == DAR_EVAL_WARP  ? run_warp(w, m, e)
                   : method->kind == DAR_EVAL_CODEC ? run_codec(w, m, e)
                                                    : run_pictures(w, m, path, e);
    if (s != DAR_OK) return s;
    finish_cell(w, cell);
    method->clips++;
    if (cell->aligned) method->external = true;
    return DAR_OK;
}

/* ---------------------------------------------------------------- a clip */

static dar_status load_truth(struct work *w, dar_err *e)
{
    float *cover = w->clip->masks ? malloc(w->pixels * sizeof *cover) : NULL;
    dar_status s = DAR_OK;
    w->truth = malloc(3 * w->pixels * w->frames);
    w->found = malloc(3 * w->pixels);
    w->mask = w->clip->masks ? malloc(w->pixels * w->frames) : NULL;
    if (!w->truth || !w->found || (w->clip->masks && !(w->mask && cover)))
        s = dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory for %zu frames", w->clip->path, w->frames);
    for (size_t t = 0; t < w->frames && s == DAR_OK; t++) {
        s = dar_bundle_rgb(w->b, t, w->truth + 3 * w->pixels * t, e);
        if (s == DAR_OK && w->film) dar_eval_film_add(w->film, 0, t, w->truth + 3 * w->pixels * t, NULL);
        if (s == DAR_OK) dar_eval_sheet_show(w->v, w->c, w->v->methods, t, w->truth + 3 * w->pixels * t);
        if (s == DAR_OK && w->mask) s = dar_bundle_values(w->b, DAR_FAMILY_MASK, t, cover, e);
        for (size_t i = 0; i < w->pixels && s == DAR_OK && w->mask; i++)
            w->mask[w->pixels * t + i] = cover[i] >= 0.5f ? 255 : 0;
    }
    free(cover);
    return s;
}

static dar_status open_all(struct work *w, dar_err *e)
{
    const dar_eval *v = w->v;
    const dar_eval_clip *c = w->clip;
    DAR_TRY(dar_bundle_open(&w->b, c->path, e));
    if (v->tile) DAR_TRY(dar_eval_film_open(&w->film, v->methods + 1, c, v->tile, e));
    DAR_TRY(load_truth(w, e));
    DAR_TRY(dar_eval_variant_open(&w->variant, w->v, w->c, w->b, w->truth, e));
    DAR_TRY(dar_metric_open(&w->metric, c->width, c->height, DAR_METRIC_ALL, e));
    for (int k = 0; k < DAR_LPIPS_NETS; k++)
        if (dar_lpips_there((dar_lpips_net)k, v->weights, v->files))
            DAR_TRY(dar_lpips_open(&w->lpips[k], (dar_lpips_net)k, v->weights, v->files, c->width, c->height, e));
    return DAR_OK;
}

static void close_all(struct work *w)
{
    dar_eval_film_close(w->film);
    dar_eval_warp_close(w->warp);
    dar_eval_variant_close(w->variant);
    dar_metric_close(w->metric);
    for (int k = 0; k < DAR_LPIPS_NETS; k++) dar_lpips_close(w->lpips[k]);
    dar_bundle_close(w->b);
    free(w->truth);
    free(w->found);
    free(w->mask);
}

dar_status dar_eval_clip_run(dar_eval *v, size_t c, dar_err *e)
{
    dar_eval_clip *clip = &v->clip[c];
    struct work w = { .v = v, .c = c, .clip = clip, .frames = clip->frames, .pixels = clip->width * clip->height };
    dar_status s = open_all(&w, e);
    for (size_t m = 0; m < v->methods && s == DAR_OK; m++) {
        s = run_method(&w, m, e);
        if (s == DAR_OK && dar_interrupted())
            s = dar_fail(e, DAR_ERR_INTERRUPTED, "dar-eval: interrupted at %s; nothing was written", clip->name);
    }
    if (s == DAR_OK && w.film) s = dar_eval_film_write(w.film, v->out, c, clip, v->report / (double)v->clips, e);
    close_all(&w);
    return s;
}
