/* learner_vae.c: see learner.h. */
#include "train/learner.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lib/log.h"
#include "models/load.h"
#include "models/vae_start.h"
#include "train/vae_step.h"

#define MEASURED 64 /* clips whose latents are measured, at most */

typedef struct state {
    dar_arena weights;
    dar_params params;
    dar_vae vae;
    dar_weights *file;                    /* what values were read from; NULL: none */
    dar_clips held;                       /* of validation.data */
    dar_loader *loader, *measured, *seen; /* seen: of those clips; NULL: there are none */
    dar_vae_step step, look;
} state;

static const dar_vae_loss looked = { .parts = 0 };

/* ---------------------------------------------------------------- opening */

/* Declare; values, unless planning, from a file or fresh. */
static dar_status network(dar_loop *l, bool plan, dar_err *e)
{
    state *t = l->state;
    const dar_train_config *c = l->c;
    const char *path = c->part[DAR_MODEL_VAE];
    dar_params *p = &t->params;
    DAR_TRY(plan ? dar_arena_init_plan(&t->weights, "weights", e)
                 : dar_arena_init(&t->weights, "weights", l->plan.weights, e));
    dar_params_init(p, &t->weights, (dar_dtype)c->storage);
    dar_vae_init(&t->vae, p, &c->file.c.vae);
    dar_params_train(p, DAR_PARAM_ALL);
    if (path && !plan) {
        DAR_TRY(dar_weights_open(&t->file, path, e));
        DAR_TRY(dar_load_vae(p, t->file, e));
    }
    if (!path && !c->from_scratch)
        return dar_fail(e, DAR_ERR_USAGE,
                        "parts.vae: found none, expected weights to go on from, or from_scratch=true");
    dar_params_fresh(p, DAR_PARAM_ALL, (uint64_t)c->seed);
    dar_params_gradients(p);
    if (plan) l->plan.weights = t->weights.peak;
    l->params = p;
    return DAR_OK;
}

/* Whole clips, one by one, as they are named. */
static dar_status open_whole(dar_loader **out, const dar_clips *clips, size_t most, bool plan, dar_err *e)
{
    dar_loader_config o = { .path = (const char *const *)(uintptr_t)clips->path, .clips = clips->n, .batch = 1 };
    if (most && o.clips > most) o.clips = most;
    o.pixels = true;
    o.plan = plan;
    return dar_loader_open(out, &o, e);
}

static dar_status open_loaders(dar_loop *l, bool plan, dar_err *e)
{
    state *t = l->state;
    const dar_train_config *c = l->c;
    dar_loader_config o = dar_loop_loader(l, plan);
    o.pixels = true;
    o.frames = c->vae_frames;
    o.height = c->vae_height;
    o.width = c->vae_width;
    DAR_TRY(dar_loader_open(&t->loader, &o, e));
    DAR_TRY(open_whole(&t->measured, &l->clips, MEASURED, plan, e));
    if (!c->validate_every) return DAR_OK;
    DAR_TRY(dar_clips_find(&t->held, dar_train_config_list(c, "validation", "data"), e));
    if (!t->held.n) return DAR_OK;
    DAR_TRY(open_whole(&t->seen, &t->held, 0, plan, e));
    dar_shape a = dar_loader_pixels(t->measured), b = dar_loader_pixels(t->seen);
    if (dar_shape_equal(&a, &b)) return DAR_OK;
    return dar_fail(e, DAR_ERR_USAGE, "%s: found a clip of another size than those of data", t->held.path[0]);
}

/* ---------------------------------------------------------------- planning */

static dar_vae_loss loss_of(const dar_train_config *c)
{
    return (dar_vae_loss){ .round = c->vae_round,
                           .edge = c->vae_edge,
                           .kl = c->vae_kl,
                           .noise = c->vae_noise,
                           .seed = (uint64_t)c->seed,
                           .parts = c->accumulate };
}

static dar_status check_sides(const dar_loop *l, dar_err *e)
{
    const state *t = l->state;
    const dar_shape s = dar_loader_pixels(t->loader), all = dar_loader_pixels(t->measured);
    const int64_t r = dar_vae_shrink(&t->vae.c), f = dar_vae_shrink_time(&t->vae.c);
    for (int k = 0; k < 2; k++) {
        const int64_t *d = k ? all.d : s.d;
        if ((d[2] - 1) % f || d[3] % r || d[4] % r)
            return dar_fail(e, DAR_ERR_USAGE,
                            "%s: found %lld frames of %lld x %lld, expected 1 + %lld k and multiples of %lld",
                            k ? l->clips.path[0] : "vae.frames, .width, .height", (long long)d[2], (long long)d[4],
                            (long long)d[3], (long long)f, (long long)r);
    }
    return DAR_OK;
}

/* Steps with everything kept, or run again in backward: there is nothing in between. */
static dar_status count(dar_loop *l, dar_err *e)
{
    state *t = l->state;
    dar_loop_plan *p = &l->plan;
    const dar_vae_loss loss = loss_of(l->c);
    DAR_TRY(check_sides(l, e));
    p->batches = dar_loader_bytes(t->loader) + dar_loader_bytes(t->measured);
    DAR_TRY(dar_vae_step_init(&t->look, &t->vae, &looked, dar_loader_pixels(t->measured), true, e));
    p->validation = t->look.step.peak + (t->seen ? dar_loader_bytes(t->seen) : 0);
    for (int how = DAR_RECOMPUTE_NONE; how <= DAR_RECOMPUTE_ALL; how++) {
        t->vae.whole = how == DAR_RECOMPUTE_NONE;
        DAR_TRY(dar_vae_step_init(&t->step, &t->vae, &loss, dar_loader_pixels(t->loader), true, e));
        p->step[how] = (dar_step_plan){ { t->step.step.peak, 0 }, t->step.forward, t->step.backward };
        dar_vae_step_free(&t->step);
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- what checkpoints say */

static dar_status set_numbers(dar_json_doc *doc, const char *key, const double *x, int64_t n, dar_err *e)
{
    dar_json_writer w = { 0 };
    dar_json_write_array(&w, NULL);
    for (int64_t i = 0; i < n; i++) dar_json_write_number(&w, NULL, x[i]);
    dar_json_write_end(&w);
    size_t size = w.failed ? 0 : strlen(key) + w.size + 2;
    char *text = size ? malloc(size) : NULL;
    dar_status s = text ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", key);
    if (s == DAR_OK) {
        snprintf(text, size, "%s=%s", key, w.text);
        s = dar_json_set(doc, text, e);
    }
    free(text);
    dar_json_writer_free(&w);
    return s;
}

/* Numbers that differ in size on purpose stay so: they share the root of their mean square. */
static void one_deviation(double *std, int64_t n)
{
    double sum = 0;
    for (int64_t i = 0; i < n; i++) sum += std[i] * std[i];
    for (int64_t i = 0; i < n; i++) std[i] = sqrt(sum / (double)n);
}

/* Latents of whole clips, and what that says of the model. */
static dar_status describe(dar_loop *l, dar_json_doc *model, dar_err *e)
{
    state *t = l->state;
    const int64_t C = t->vae.c.latent;
    dar_vae_sums sums = { 0 };
    double mean[DAR_VAE_LATENT], std[DAR_VAE_LATENT];
    for (size_t i = 0; i < l->clips.n && i < MEASURED; i++) {
        const dar_batch *b;
        DAR_TRY(dar_loader_get(t->measured, (int64_t)i, &b, e));
        dar_vae_step_look(&t->look, &b->pixels, &sums);
    }
    dar_vae_standard(&sums, C, mean, std);
    if (l->c->vae_spread > 0) one_deviation(std, C);
    DAR_TRY(set_numbers(model, "vae.mean", mean, C, e));
    DAR_TRY(set_numbers(model, "vae.std", std, C, e));
    return dar_json_set(model, "weights.vae=vae.safetensors", e);
}

/* ---------------------------------------------------------------- a run */

/* From nothing: from what linear maps can do for the clips. */
static dar_status start(dar_loop *l, dar_err *e)
{
    state *t = l->state;
    const dar_shape all = dar_loader_pixels(t->measured);
    dar_vae_blocks b;
    dar_status s = dar_vae_blocks_init(&b, &t->vae, all.d[3], all.d[4], e);
    for (size_t i = 0; s == DAR_OK && i < l->clips.n && i < MEASURED; i++) {
        const dar_batch *clip;
        s = dar_loader_get(t->measured, (int64_t)i, &clip, e);
        if (s == DAR_OK) dar_vae_blocks_add(&b, &clip->pixels);
    }
    if (s == DAR_OK) dar_vae_start(&b, l->c->vae_spread);
    dar_vae_blocks_free(&b);
    return s;
}

static dar_status prepare(dar_loop *l, bool plan, dar_err *e)
{
    state *t = l->state;
    const dar_vae_loss loss = loss_of(l->c);
    DAR_TRY(open_loaders(l, plan, e));
    if (plan) return count(l, e);
    if (!t->file && !l->saver.step) DAR_TRY(start(l, e));
    t->vae.whole = l->plan.how == DAR_RECOMPUTE_NONE;
    DAR_TRY(dar_vae_step_init(&t->step, &t->vae, &loss, dar_loader_pixels(t->loader), false, e));
    return dar_vae_step_init(&t->look, &t->vae, &looked, dar_loader_pixels(t->measured), false, e);
}

static dar_status batch(dar_loop *l, int64_t step, int64_t part, dar_loop_batch *out, dar_err *e)
{
    state *t = l->state;
    const dar_batch *b;
    DAR_TRY(dar_loader_get(t->loader, step * l->c->accumulate + part, &b, e));
    out->loss = dar_vae_step_run(&t->step, &b->pixels, step, part).loss;
    return DAR_OK;
}

static dar_status validate(dar_loop *l, int64_t step, dar_err *e)
{
    state *t = l->state;
    double psnr = 0, least = INFINITY;
    if (!t->seen) return DAR_OK;
    for (size_t i = 0; i < t->held.n; i++) {
        const dar_batch *b;
        DAR_TRY(dar_loader_get(t->seen, (int64_t)i, &b, e));
        double x = dar_vae_psnr(dar_vae_step_look(&t->look, &b->pixels, NULL).square);
        psnr += x / (double)t->held.n;
        least = fmin(least, x);
    }
    dar_json_writer *w = dar_journal_line(l->journal, "validate", step);
    dar_json_write_int(w, "clips", (int64_t)t->held.n);
    dar_json_write_number(w, "psnr", psnr);
    dar_json_write_number(w, "psnr_least", least);
    DAR_TRY(dar_journal_end(l->journal, e));
    dar_log(DAR_LOG_INFO, "step %lld: %.2f dB over %zu clips that are not learned from, the worst %.2f",
            (long long)step, psnr, t->held.n, least);
    return DAR_OK;
}

static void drop(dar_loop *l)
{
    state *t = l->state;
    dar_vae_step_free(&t->step);
    dar_vae_step_free(&t->look);
    dar_loader_close(t->loader);
    dar_loader_close(t->measured);
    dar_loader_close(t->seen);
    dar_clips_free(&t->held);
    dar_params_free(&t->params);
    dar_arena_free(&t->weights);
    dar_weights_close(t->file);
}

const dar_learner dar_learner_vae = { sizeof(state), network, prepare, batch, validate, describe, drop };
