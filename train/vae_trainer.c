/* vae_trainer.c: see vae_trainer.h. */
#include "train/vae_trainer.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "lib/log.h"
#include "lib/program.h"
#include "models/load.h"
#include "models/rate.h"

#define MEASURED 64 /* clips whose latents are measured, at most */

/* ---------------------------------------------------------------- opening */

/* Declare; values, unless planning, from a file or fresh. */
static dar_status open_network(dar_vae_trainer *t, bool plan, dar_err *e)
{
    const dar_train_config *c = t->c;
    const char *path = c->part[DAR_MODEL_VAE];
    dar_params *p = &t->params;
    DAR_TRY(plan ? dar_arena_init_plan(&t->weights, "weights", e)
                 : dar_arena_init(&t->weights, "weights", t->plan.weights, e));
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
    if (!path && !plan) dar_vae_start(&t->vae);
    dar_params_gradients(p);
    return DAR_OK;
}

static dar_status init_optim(dar_vae_trainer *t, dar_err *e)
{
    const dar_train_config *c = t->c;
    dar_optim_config o = { c->rate, c->beta1, c->beta2, c->eps, c->decay, c->max_norm, .warmup = c->warmup };
    o.bf16_moments = c->moments != 0;
    o.seed = (uint64_t)c->seed;
    o.patience = c->patience;
    DAR_TRY(t->weights.plan ? dar_arena_init_plan(&t->moments, "moments", e)
                            : dar_arena_init(&t->moments, "moments", t->plan.moments, e));
    dar_optim_init(&t->optim, &o, &t->params, &t->moments);
    return DAR_OK;
}

static dar_status open_loader(dar_loader **out, const dar_clips *clips, size_t most, bool plan, dar_err *e)
{
    dar_loader_config l = { .path = (const char *const *)(uintptr_t)clips->path, .clips = clips->n, .batch = 1 };
    if (most && l.clips > most) l.clips = most;
    l.pixels = true;
    l.plan = plan;
    return dar_loader_open(out, &l, e);
}

static dar_status open_loaders(dar_vae_trainer *t, bool plan, dar_err *e)
{
    const dar_train_config *c = t->c;
    dar_loader_config l = { .path = (const char *const *)(uintptr_t)t->clips.path, .clips = t->clips.n };
    l.batch = c->batch;
    l.ahead = (size_t)c->ahead;
    l.shuffle = true;
    l.seed = (uint64_t)c->seed;
    l.plan = plan;
    l.pixels = true;
    l.frames = c->vae_frames;
    l.height = c->vae_height;
    l.width = c->vae_width;
    DAR_TRY(dar_loader_open(&t->loader, &l, e));
    DAR_TRY(open_loader(&t->measured, &t->clips, MEASURED, plan, e));
    if (!t->held.n) return DAR_OK;
    DAR_TRY(open_loader(&t->seen, &t->held, 0, plan, e));
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

static dar_status check_sides(const dar_vae_trainer *t, dar_err *e)
{
    const dar_shape s = dar_loader_pixels(t->loader), all = dar_loader_pixels(t->measured);
    const int64_t r = dar_vae_shrink(&t->vae.c), f = dar_vae_shrink_time(&t->vae.c);
    for (int k = 0; k < 2; k++) {
        const int64_t *d = k ? all.d : s.d;
        if ((d[2] - 1) % f || d[3] % r || d[4] % r)
            return dar_fail(e, DAR_ERR_USAGE,
                            "%s: found %lld frames of %lld x %lld, expected 1 + %lld k and multiples of %lld",
                            k ? t->clips.path[0] : "vae.frames, .width, .height", (long long)d[2], (long long)d[4],
                            (long long)d[3], (long long)f, (long long)r);
    }
    return DAR_OK;
}

/* Everything kept, and run again in backward: there is nothing in between. */
static dar_status count_steps(dar_vae_trainer *t, dar_err *e)
{
    dar_trainer_plan *p = &t->plan;
    dar_vae_loss c = loss_of(t->c);
    for (int how = DAR_RECOMPUTE_NONE; how <= DAR_RECOMPUTE_ALL; how++) {
        t->vae.whole = how == DAR_RECOMPUTE_NONE;
        DAR_TRY(dar_vae_step_init(&t->step, &t->vae, &c, dar_loader_pixels(t->loader), true, e));
        p->step[how] = (dar_step_plan){ { t->step.step.peak, 0 }, t->step.forward, t->step.backward };
        dar_vae_step_free(&t->step);
    }
    size_t rest = p->program + p->weights + p->moments + p->batches + p->validation;
    p->how = dar_step_choose(t->c, p->step, p->budget > rest ? p->budget - rest : 0);
    p->flops = (p->step[p->how].forward + p->step[p->how].backward) * (double)t->c->accumulate;
    return DAR_OK;
}

static dar_status plan(dar_vae_trainer *t, dar_err *e)
{
    dar_trainer_plan *p = &t->plan;
    p->budget = dar_trainer_budget(t->c);
    p->program = dar_trainer_program();
    p->peak = dar_rate((dar_dtype)t->c->storage);
    DAR_TRY(open_network(t, true, e));
    DAR_TRY(init_optim(t, e));
    DAR_TRY(open_loaders(t, true, e));
    DAR_TRY(check_sides(t, e));
    p->trained = dar_params_count(&t->params, DAR_PARAM_ALL);
    p->weights = t->weights.peak;
    p->moments = t->moments.peak;
    p->batches = dar_loader_bytes(t->loader) + dar_loader_bytes(t->measured);
    dar_vae_loss looked = { .parts = 0 };
    DAR_TRY(dar_vae_step_init(&t->look, &t->vae, &looked, dar_loader_pixels(t->measured), true, e));
    p->validation = t->look.step.peak + (t->seen ? dar_loader_bytes(t->seen) : 0);
    return count_steps(t, e);
}

static void drop(dar_vae_trainer *t)
{
    dar_vae_step_free(&t->step);
    dar_vae_step_free(&t->look);
    dar_loader_close(t->loader);
    dar_loader_close(t->measured);
    dar_loader_close(t->seen);
    dar_params_free(&t->params);
    dar_arena_free(&t->weights);
    dar_arena_free(&t->moments);
    dar_weights_close(t->file);
    t->loader = t->measured = t->seen = NULL;
    t->params = (dar_params){ 0 };
    t->file = NULL;
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

/* Latents of whole clips, and what that says of the model. */
static dar_status measure(dar_vae_trainer *t, dar_err *e)
{
    const int64_t C = t->vae.c.latent;
    dar_json_doc *doc = t->c->file.doc;
    dar_vae_sums sums = { 0 };
    double mean[DAR_VAE_LATENT], std[DAR_VAE_LATENT];
    for (size_t i = 0; i < t->clips.n && i < MEASURED; i++) {
        const dar_batch *b;
        DAR_TRY(dar_loader_get(t->measured, (int64_t)i, &b, e));
        dar_vae_step_look(&t->look, &b->pixels, &sums);
    }
    dar_vae_standard(&sums, C, mean, std);
    DAR_TRY(set_numbers(doc, "vae.mean", mean, C, e));
    DAR_TRY(set_numbers(doc, "vae.std", std, C, e));
    DAR_TRY(dar_json_set(doc, "weights.vae=vae.safetensors", e));
    dar_json_writer_reset(&t->text[1]);
    dar_json_write_value(&t->text[1], NULL, dar_json_root(doc));
    if (t->text[1].failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", t->c->output);
    t->saver.model = t->text[1].text;
    return DAR_OK;
}

static dar_status validate(dar_vae_trainer *t, int64_t step, dar_err *e)
{
    double psnr = 0, least = INFINITY;
    for (size_t i = 0; i < t->held.n; i++) {
        const dar_batch *b;
        DAR_TRY(dar_loader_get(t->seen, (int64_t)i, &b, e));
        double x = dar_vae_psnr(dar_vae_step_look(&t->look, &b->pixels, NULL).square);
        psnr += x / (double)t->held.n;
        least = fmin(least, x);
    }
    dar_json_writer *w = dar_journal_line(t->journal, "validate", step);
    dar_json_write_int(w, "clips", (int64_t)t->held.n);
    dar_json_write_number(w, "psnr", psnr);
    dar_json_write_number(w, "psnr_least", least);
    DAR_TRY(dar_journal_end(t->journal, e));
    dar_log(DAR_LOG_INFO, "step %lld: %.2f dB over %zu clips that are not learned from, the worst %.2f",
            (long long)step, psnr, t->held.n, least);
    return DAR_OK;
}

/* ---------------------------------------------------------------- a run */

static dar_status open_run(dar_vae_trainer *t, const dar_trainer_options *o, dar_err *e)
{
    const dar_train_config *c = t->c;
    const dar_trainer_plan *p = &t->plan;
    dar_vae_loss loss = loss_of(c), looked = { .parts = 0 };
    if (dar_trainer_bytes(p) > p->budget)
        return dar_fail(e, DAR_ERR_NOMEM, "this run needs %.2f GB of memory, found %.2f GB to use",
                        (double)dar_trainer_bytes(p) / 1e9, (double)p->budget / 1e9);
    DAR_TRY(open_network(t, false, e));
    DAR_TRY(init_optim(t, e));
    t->text[0].pretty = t->text[1].pretty = true;
    dar_train_config_print(c, &t->text[0]);
    if (t->text[0].failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", c->output);
    t->saver = (dar_checkpoint){ .run = c->output, .params = &t->params, .optim = &t->optim, .keep = c->keep };
    t->saver.seed = (uint64_t)c->seed;
    t->saver.config = t->text[0].text;
    DAR_TRY(dar_checkpoint_open(&t->saver, e));
    DAR_TRY(dar_checkpoint_resume(&t->saver, o->resume, e));
    DAR_TRY(open_loaders(t, false, e));
    t->vae.whole = p->how == DAR_RECOMPUTE_NONE;
    DAR_TRY(dar_vae_step_init(&t->step, &t->vae, &loss, dar_loader_pixels(t->loader), false, e));
    DAR_TRY(dar_vae_step_init(&t->look, &t->vae, &looked, dar_loader_pixels(t->measured), false, e));
    dar_journal_options j = { c->output, c->steps, 0, p->flops, p->peak };
    return dar_journal_open(&t->journal, &j, t->saver.step, e);
}

dar_status dar_vae_trainer_open(dar_vae_trainer **out, const dar_train_config *c, const dar_trainer_options *o,
                                dar_err *e)
{
    dar_vae_trainer *t = calloc(1, sizeof *t);
    *out = NULL;
    if (!t) return dar_fail(e, DAR_ERR_NOMEM, "training: out of memory");
    t->c = c;
    dar_status s = dar_clips_find(&t->clips, dar_train_config_list(c, NULL, "data"), e);
    if (s == DAR_OK && !t->clips.n) s = dar_fail(e, DAR_ERR_USAGE, "data: found [], expected bundles to train on");
    if (s == DAR_OK) s = dar_clips_find(&t->held, dar_train_config_list(c, "validation", "data"), e);
    if (s == DAR_OK) s = plan(t, e);
    drop(t);
    if (s == DAR_OK && !o->plan) s = open_run(t, o, e);
    if (s == DAR_OK) *out = t;
    else dar_vae_trainer_close(t);
    return s;
}

void dar_vae_trainer_close(dar_vae_trainer *t)
{
    if (!t) return;
    dar_journal_close(t->journal);
    dar_checkpoint_close(&t->saver);
    drop(t);
    dar_clips_free(&t->clips);
    dar_clips_free(&t->held);
    for (int i = 0; i < 2; i++) dar_json_writer_free(&t->text[i]);
    free(t);
}

static dar_status run_step(dar_vae_trainer *t, int64_t k, dar_err *e)
{
    const dar_train_config *c = t->c;
    double began = dar_log_clock();
    dar_journal_entry x = { .step = k + 1 };
    for (int64_t part = 0; part < c->accumulate; part++) {
        const dar_batch *b;
        DAR_TRY(dar_loader_get(t->loader, k * c->accumulate + part, &b, e));
        x.loss += dar_vae_step_run(&t->step, &b->pixels, k, part).loss / (double)c->accumulate;
    }
    t->optim.config.rate = dar_train_rate(c, k);
    dar_optim_report r = dar_optim_step(&t->optim);
    x.norm = r.norm, x.rate = r.rate, x.skipped = r.skipped, x.nonfinite = r.nonfinite;
    x.seconds = dar_log_clock() - began;
    DAR_TRY(dar_journal_step(t->journal, &x, e));
    return dar_optim_check(&t->optim, &r, e);
}

static dar_status save(dar_vae_trainer *t, int64_t done, dar_err *e)
{
    DAR_TRY(measure(t, e));
    DAR_TRY(dar_journal_flush(t->journal, e));
    return dar_checkpoint_save(&t->saver, done, e);
}

static bool every(int64_t k, int64_t steps)
{
    return steps && k % steps == 0;
}

dar_status dar_vae_trainer_run(dar_vae_trainer *t, dar_err *e)
{
    const dar_train_config *c = t->c;
    for (int64_t k = t->saver.step; k < c->steps;) {
        DAR_TRY(run_step(t, k++, e));
        bool last = k == c->steps;
        if (t->seen && !dar_interrupted() && (last || every(k, c->validate_every))) DAR_TRY(validate(t, k, e));
        bool stop = dar_interrupted();
        if (stop || last || every(k, c->save_every)) DAR_TRY(save(t, k, e));
        if (stop && !last)
            return dar_fail(e, DAR_ERR_INTERRUPTED, "%s: stopped and saved after step %lld; --resume auto goes on",
                            c->output, (long long)k);
    }
    return DAR_OK;
}
