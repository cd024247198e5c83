/* validate.c: see validate.h. */
#include "train/validate.h"

#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/metric.h"
#include "data/sheet.h"
#include "lib/dir.h"
#include "lib/log.h"
#include "lib/program.h"
#include "models/encode.h"
#include "models/sampler.h"

#define MOMENTS 5   /* columns of a sheet */
#define CELL    224 /* [px] */

struct dar_validator {
    const dar_train_config *c;
    const dar_model *m;
    dar_clips clips;
    dar_loader *loader;
    dar_arena kept, step;
    dar_tape tape;
    size_t bytes[2];
    dar_metric *metric;
    uint8_t *rgb; /* a picture */
    size_t width, height, frames;
};

/* ---------------------------------------------------------------- a clip rendered */

/* What is seen of a clip while its frames come. */
struct showing {
    dar_validator *v;
    dar_bundle *b;
    dar_sheet sheet;
    dar_metric_clip clip;
};

static size_t moment(const dar_validator *v, size_t column)
{
    return column * (v->frames - 1) / (MOMENTS - 1);
}

static dar_status show_frame(void *ctx, size_t index, const uint8_t *found, dar_err *e)
{
    struct showing *s = ctx;
    dar_validator *v = s->v;
    uint8_t *truth = v->rgb;
    dar_metric_row row;
    DAR_TRY(dar_bundle_rgb(s->b, index, truth, e));
    dar_metric_frame(v->metric, found, truth, NULL, &row);
    dar_metric_clip_add(&s->clip, &row);
    for (size_t column = 0; column < MOMENTS; column++)
        if (moment(v, column) == index) {
            dar_sheet_picture(&s->sheet, 0, column, truth, v->width, v->height, DAR_SHRINK_MEAN);
            dar_sheet_picture(&s->sheet, 1, column, found, v->width, v->height, DAR_SHRINK_MEAN);
        }
    return DAR_OK;
}

static dar_tensor as_main(dar_validator *v, const dar_tensor *x)
{
    dar_tensor y = *x;
    if (!x->data) return y;
    y = dar_tensor_push(&v->kept, v->m->dit.main, x->shape);
    if (!v->kept.plan) dar_tensor_copy(&y, x);
    return y;
}

static dar_tensor words_of(const dar_batch *b)
{
    dar_tensor none = { 0 };
    if (!b->text.data || !b->count[0]) return none;
    return dar_tensor_narrow(&b->text, 1, 0, b->count[0]);
}

/* Relative distance of latents in the Euclidean norm, without the first frame, which is given. */
static double distance(const dar_tensor *z, const dar_tensor *truth)
{
    int64_t F = z->shape.d[2], C = z->shape.d[1], n = z->shape.d[3] * z->shape.d[4];
    double d = 0, all = 0;
    for (int64_t c = 0; c < C; c++)
        for (int64_t i = n; i < F * n; i++) {
            size_t at = (size_t)(c * F * n + i);
            double x = dar_dtype_get(z->dtype, z->data, at), y = dar_dtype_get(truth->dtype, truth->data, at);
            d += (x - y) * (x - y);
            all += y * y;
        }
    return sqrt(d / all);
}

/* On planning arenas b only has shapes. */
static dar_status render(dar_validator *v, const dar_batch *b, struct showing *show, double *latent, dar_err *e)
{
    const dar_train_config *c = v->c;
    const dar_shape *d = &b->z0.shape;
    dar_sampler_config how = dar_sampler_default();
    dar_sampler sampler;
    how.solver.steps = (size_t)c->validate_steps;
    how.solver.shift = c->shift;
    how.guidance = 1;
    dar_arena_reset(&v->kept, 0);
    dar_arena_reset(&v->step, 0);
    dar_tape_clear(&v->tape);
    v->tape.recording = false;
    dar_tensor known = as_main(v, &b->known), z0 = as_main(v, &b->z0);
    dar_tensor z = dar_tensor_push(&v->kept, v->m->dit.main, *d);
    dar_sampler_clip clip = { d->d[2], d->d[3], d->d[4], b->cond, .text = { words_of(b) } };
    DAR_TRY(dar_sampler_init(&sampler, &v->m->dit, &how, &clip, &v->kept, &v->step, e));
    dar_sampler_noise(DAR_NOISE_OWN, (uint64_t)c->seed, &z, &v->step);
    dar_status s = dar_sampler_run(&sampler, known.data ? &known : NULL, c->first == DAR_FIRST_NOISY ? NULL : &z0, &z,
                                   NULL, NULL, e);
    dar_sampler_free(&sampler);
    if (s == DAR_OK && !v->kept.plan) *latent = distance(&z, &z0);
    return s == DAR_OK ? dar_decode_clip(&v->tape, &v->m->vae, &v->kept, &z, show_frame, show, e) : s;
}

/* ---------------------------------------------------------------- sheets and numbers */

static const char *name_of(const char *path)
{
    const char *slash = strrchr(path, '/');
    return slash && slash[1] ? slash + 1 : path;
}

static dar_status make_place(const dar_validator *v, int64_t step, char path[PATH_MAX], dar_err *e)
{
    int n = snprintf(path, PATH_MAX, "%s/samples/step-%08lld", v->c->output, (long long)step);
    if (n >= PATH_MAX) return dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long", v->c->output);
    return dar_dir_make(path, e);
}

static dar_status write_sheet(struct showing *s, const char *place, const char *name, dar_err *e)
{
    char path[PATH_MAX], moments[32];
    for (size_t column = 0; column < MOMENTS; column++) {
        snprintf(moments, sizeof moments, "frame %zu", moment(s->v, column));
        dar_sheet_column(&s->sheet, column, moments);
    }
    if (snprintf(path, sizeof path, "%s/%s.png", place, name) >= (int)sizeof path)
        return dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long", place);
    return dar_sheet_write(&s->sheet, path, e);
}

static dar_status sample_clip(dar_validator *v, int64_t clip, const char *place, dar_metric_row *mean, double *latent,
                              dar_err *e)
{
    const char *path = v->clips.path[clip];
    struct showing s = { .v = v };
    dar_sheet_plan plan = { .title = name_of(path), .rows = 2, .columns = MOMENTS, .width = CELL };
    const dar_batch *b;
    char note[64];
    plan.height = CELL * v->height / v->width + 1;
    DAR_TRY(dar_loader_get(v->loader, clip, &b, e));
    DAR_TRY(dar_bundle_open(&s.b, path, e));
    dar_status status = dar_sheet_init(&s.sheet, &plan, e);
    if (status == DAR_OK) {
        dar_metric_begin(v->metric, NULL);
        status = render(v, b, &s, latent, e);
    }
    if (status == DAR_OK) {
        dar_metric_clip_mean(&s.clip, mean);
        snprintf(note, sizeof note, "PSNR %.2f dB, SSIM %.3f", mean->v[DAR_METRIC_FRAME][DAR_METRIC_PSNR],
                 mean->v[DAR_METRIC_FRAME][DAR_METRIC_SSIM]);
        dar_sheet_row(&s.sheet, 0, "truth", NULL);
        dar_sheet_row(&s.sheet, 1, "result", note);
        status = write_sheet(&s, place, name_of(path), e);
    }
    dar_sheet_free(&s.sheet);
    dar_bundle_close(s.b);
    return status;
}

static dar_status sample_all(dar_validator *v, dar_journal *j, int64_t step, dar_err *e)
{
    int64_t n = v->c->validate_clips < (int64_t)v->clips.n ? v->c->validate_clips : (int64_t)v->clips.n;
    char place[PATH_MAX];
    double psnr = 0, ssim = 0, latent = 0;
    DAR_TRY(make_place(v, step, place, e));
    for (int64_t i = 0; i < n && !dar_interrupted(); i++) {
        dar_metric_row mean;
        double d = 0;
        DAR_TRY(sample_clip(v, i, place, &mean, &d, e));
        psnr += mean.v[DAR_METRIC_FRAME][DAR_METRIC_PSNR] / (double)n;
        ssim += mean.v[DAR_METRIC_FRAME][DAR_METRIC_SSIM] / (double)n;
        latent += d / (double)n;
    }
    if (dar_interrupted()) return DAR_OK;
    dar_json_writer *w = dar_journal_line(j, "validate", step);
    dar_json_write_int(w, "clips", n);
    dar_json_write_number(w, "psnr", psnr);
    dar_json_write_number(w, "ssim", ssim);
    dar_json_write_number(w, "latent_error", latent);
    dar_log(DAR_LOG_INFO, "step %lld: %lld clips rendered: PSNR %.2f dB, SSIM %.3f, latent off by %.3f: %s",
            (long long)step, (long long)n, psnr, ssim, latent, place);
    return dar_journal_end(j, e);
}

static dar_status measure_sensitivity(dar_validator *v, dar_step *s, dar_journal *j, int64_t step, dar_err *e)
{
    int64_t clips = (int64_t)v->clips.n, n = v->c->sensitivity < clips ? v->c->sensitivity : clips;
    double own = 0, other = 0;
    const dar_batch *b;
    if (n < 1 || clips < 2 || !v->m->dit.adapter.w) return DAR_OK;
    for (int64_t i = 0; i < n; i++) {
        DAR_TRY(dar_loader_get(v->loader, (i + 1) % clips, &b, e));
        dar_arena_reset(&v->kept, 0);
        dar_tensor cond = dar_tensor_push(&v->kept, b->cond.dtype, b->cond.shape);
        dar_tensor_copy(&cond, &b->cond);
        DAR_TRY(dar_loader_get(v->loader, i, &b, e));
        dar_batch swapped = *b;
        swapped.cond = cond;
        own += dar_step_look(s, b, i).loss / (double)n;
        other += dar_step_look(s, &swapped, i).loss / (double)n;
    }
    dar_json_writer *w = dar_journal_line(j, "sensitivity", step);
    dar_json_write_int(w, "clips", n);
    dar_json_write_number(w, "loss", own);
    dar_json_write_number(w, "shuffled", other);
    dar_log(DAR_LOG_INFO, "step %lld: loss of %lld other clips %.4f, with another's condition %.4f (%+.1f %%)",
            (long long)step, (long long)n, own, other, 100 * (other / own - 1));
    return dar_journal_end(j, e);
}

dar_status dar_validator_run(dar_validator *v, dar_step *s, dar_journal *j, int64_t step, dar_err *e)
{
    DAR_TRY(measure_sensitivity(v, s, j, step, e));
    return sample_all(v, j, step, e);
}

/* ---------------------------------------------------------------- opening */

static dar_status open_loader(dar_validator *v, dar_cache *cache, dar_err *e)
{
    dar_loader_config l = { .path = (const char *const *)(uintptr_t)v->clips.path, .clips = v->clips.n, .batch = 1 };
    l.seed = (uint64_t)v->c->seed;
    l.plan = v->m->weights.plan;
    l.cache = cache;
    l.dit = &v->m->c.dit;
    l.condition = v->m->dit.adapter.w ? &v->c->condition : NULL;
    return dar_loader_open(&v->loader, &l, e);
}

/* The peaks of rendering a clip. */
static dar_status plan(dar_validator *v, dar_shape z, dar_err *e)
{
    const dar_config *m = &v->m->c;
    dar_arena batch = { 0 };
    dar_status s = dar_arena_init_plan(&v->kept, "validation", e);
    if (s == DAR_OK) s = dar_arena_init_plan(&v->step, "validation step", e);
    if (s == DAR_OK) s = dar_arena_init_plan(&batch, "batch", e);
    if (s == DAR_OK) s = dar_tape_init(&v->tape, &v->step, e);
    if (s == DAR_OK) {
        int64_t F = z.d[2], H = (int64_t)v->height, W = (int64_t)v->width, words = dar_loader_words(v->loader);
        int64_t one[] = { 1 > words ? 1 : words };
        dar_batch b = { .z0 = dar_tensor_push(&batch, DAR_F32, DAR_SHAPE(1, z.d[1], F, z.d[3], z.d[4])), .count = one };
        if (m->dit.mask)
            b.known = dar_tensor_push(&batch, DAR_F32, DAR_SHAPE(1, m->dit.mask + z.d[1], F, z.d[3], z.d[4]));
        if (v->m->dit.adapter.w)
            b.cond = dar_tensor_push(&batch, DAR_F32, DAR_SHAPE(1, m->adapter.rays + m->adapter.geometry, F, H, W));
        if (words) b.text = dar_tensor_push(&batch, DAR_F32, DAR_SHAPE(1, words, m->dit.text_width));
        s = render(v, &b, NULL, NULL, e);
        v->bytes[0] = v->kept.peak > dar_tensor_bytes(&b.cond) ? v->kept.peak : dar_tensor_bytes(&b.cond);
        v->bytes[1] = v->step.peak;
    }
    dar_tape_free(&v->tape);
    dar_arena_free(&v->kept);
    dar_arena_free(&v->step);
    dar_arena_free(&batch);
    v->tape = (dar_tape){ 0 };
    return s;
}

static dar_status reserve(dar_validator *v, dar_err *e)
{
    DAR_TRY(dar_arena_init(&v->kept, "validation", v->bytes[0], e));
    DAR_TRY(dar_arena_init(&v->step, "validation step", v->bytes[1], e));
    DAR_TRY(dar_tape_init(&v->tape, &v->step, e));
    if (!(v->rgb = malloc(3 * v->width * v->height)))
        return dar_fail(e, DAR_ERR_NOMEM, "validation: out of memory for two pictures");
    return dar_metric_open(&v->metric, v->width, v->height, 1u << DAR_METRIC_PSNR | 1u << DAR_METRIC_SSIM, e);
}

static dar_status open_clips(dar_validator *v, dar_cache *cache, dar_shape latent, dar_err *e)
{
    char found[96], expected[96];
    DAR_TRY(open_loader(v, cache, e));
    dar_shape z = dar_loader_latent(v->loader);
    latent.d[0] = 1;
    if (!dar_shape_equal(&z, &latent))
        return dar_fail(e, DAR_ERR_USAGE, "%s: found latents of %s, expected %s as in training", v->clips.path[0],
                        dar_shape_text(&z, found, sizeof found), dar_shape_text(&latent, expected, sizeof expected));
    int64_t shrink = dar_vae_shrink(&v->m->c.vae);
    v->height = (size_t)(z.d[3] * shrink);
    v->width = (size_t)(z.d[4] * shrink);
    v->frames = 1 + (size_t)((z.d[2] - 1) * dar_vae_shrink_time(&v->m->c.vae));
    DAR_TRY(plan(v, z, e));
    return v->m->weights.plan ? DAR_OK : reserve(v, e);
}

dar_status dar_validator_open(dar_validator **out, const dar_train_config *c, const dar_model *m, dar_cache *cache,
                              dar_shape latent, dar_err *e)
{
    dar_validator *v = calloc(1, sizeof *v);
    *out = NULL;
    if (!v) return dar_fail(e, DAR_ERR_NOMEM, "validation: out of memory");
    v->c = c;
    v->m = m;
    dar_status s = DAR_OK;
    if (c->validate_every) s = dar_clips_find(&v->clips, dar_train_config_list(c, "validation", "data"), e);
    bool any = v->clips.n > 0;
    if (s == DAR_OK && any) s = open_clips(v, cache, latent, e);
    if (s == DAR_OK && any) *out = v;
    else dar_validator_close(v);
    return s;
}

void dar_validator_close(dar_validator *v)
{
    if (!v) return;
    dar_loader_close(v->loader);
    dar_metric_close(v->metric);
    free(v->rgb);
    dar_tape_free(&v->tape);
    dar_arena_free(&v->kept);
    dar_arena_free(&v->step);
    dar_clips_free(&v->clips);
    free(v);
}

const dar_clips *dar_validator_clips(const dar_validator *v)
{
    return &v->clips;
}

size_t dar_validator_bytes(const dar_validator *v)
{
    return v ? v->bytes[0] + v->bytes[1] + dar_loader_bytes(v->loader) : 0;
}
