/* trainer.c: see trainer.h. */
#include "train/trainer.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <unistd.h>

#include "lib/log.h"
#include "lib/program.h"
#include "models/load.h"
#include "models/rate.h"

/* ---------------------------------------------------------------- opening */

static unsigned roles(const dar_train_config *c)
{
    return DAR_PARAM_ADAPTER | (c->what == DAR_TRAIN_LORA ? DAR_PARAM_LORA : DAR_PARAM_BASE);
}

static dar_status open_model(dar_trainer *t, bool plan, dar_err *e)
{
    const dar_train_config *c = t->c;
    dar_model_options o = { .weights = c->weights, .storage = (dar_dtype)c->storage, .strength = 1, .apart = true };
    memcpy(o.part, c->part, sizeof o.part);
    o.plan = plan;
    o.train = roles(c);
    o.fresh = c->from_scratch;
    o.seed = (uint64_t)c->seed;
    return dar_model_open(&t->m, &c->file, &o, e);
}

static dar_status open_loader(dar_trainer *t, bool plan, dar_err *e)
{
    const dar_train_config *c = t->c;
    char near[PATH_MAX];
    snprintf(near, sizeof near, "%.4000s/../cache", c->output);
    DAR_TRY(dar_cache_open(&t->cache, c->cache ? c->cache : near, &t->m->vae, &t->m->params[1], e));
    dar_loader_config l = { .path = (const char *const *)(uintptr_t)t->clips.path, .clips = t->clips.n };
    l.batch = c->batch;
    l.ahead = (size_t)c->ahead;
    l.shuffle = true;
    l.seed = (uint64_t)c->seed;
    l.plan = plan;
    l.cache = t->cache;
    l.dit = &t->m->c.dit;
    l.condition = t->m->dit.adapter.w ? &c->condition : NULL;
    l.posterior = c->posterior != 0;
    return dar_loader_open(&t->loader, &l, e);
}

/* What stands for no text. */
static dar_status read_empty(dar_trainer *t, dar_err *e)
{
    const char *path = t->c->text_empty;
    if (!path) return DAR_OK;
    DAR_TRY(dar_weights_open(&t->empty, path, e));
    return dar_load_text(&t->c->file.c.dit, t->empty, path, "text", &t->no_text, e);
}

static dar_status open_validator(dar_trainer *t, dar_err *e)
{
    return dar_validator_open(&t->validator, t->c, t->m, t->cache, dar_loader_latent(t->loader), e);
}

static dar_status init_optim(dar_trainer *t, dar_err *e)
{
    const dar_train_config *c = t->c;
    dar_optim_config o = { c->rate, c->beta1, c->beta2, c->eps, c->decay, c->max_norm, .warmup = c->warmup };
    o.bf16_moments = c->moments != 0;
    o.seed = (uint64_t)c->seed;
    o.patience = c->patience;
    DAR_TRY(t->m->weights.plan ? dar_arena_init_plan(&t->moments, "moments", e)
                               : dar_arena_init(&t->moments, "moments", t->plan.moments, e));
    dar_optim_init(&t->optim, &o, &t->m->params[0], &t->moments);
    return DAR_OK;
}

/* ---------------------------------------------------------------- planning */

size_t dar_trainer_budget(const dar_train_config *c)
{
    long pages = sysconf(_SC_PHYS_PAGES), size = sysconf(_SC_PAGE_SIZE);
    if (c->budget > 0) return (size_t)(c->budget * 1e9);
    return pages > 0 && size > 0 ? dar_mul_size((size_t)pages, (size_t)size) : 0;
}

size_t dar_trainer_program(void)
{
    struct rusage r;
    return getrusage(RUSAGE_SELF, &r) == 0 ? 1024 * (size_t)r.ru_maxrss : 0;
}

size_t dar_trainer_bytes(const dar_trainer_plan *p)
{
    const dar_step_plan *s = &p->step[p->how];
    return p->program + p->weights + p->moments + p->batches + p->validation + s->bytes[0] + s->bytes[1];
}

static void count_parameters(dar_trainer *t)
{
    const dar_params *p = &t->m->params[0];
    for (size_t i = 0; i < p->count; i++)
        *(p->at[i]->trainable ? &t->plan.trained : &t->plan.frozen) += dar_shape_count(&p->at[i]->x.shape);
}

static dar_status plan_step(dar_trainer *t, dar_err *e)
{
    const dar_train_config *c = t->c;
    const dar_dit_config *d = &t->m->c.dit;
    dar_trainer_plan *p = &t->plan;
    dar_shape z = dar_loader_latent(t->loader);
    dar_step_size size = { z.d[0], z.d[2], z.d[3], z.d[4], .pixels = dar_vae_shrink(&t->m->c.vae) };
    size.words = dar_loader_words(t->loader);
    if (t->no_text.data && t->no_text.shape.d[1] > size.words) size.words = t->no_text.shape.d[1];
    if (t->m->dit.adapter.w) size.cond = t->m->c.adapter.rays + t->m->c.adapter.geometry;
    if (size.frames < 2)
        return dar_fail(e, DAR_ERR_USAGE, "%s: found 1 frame, which is the reference itself: expected 5, 9, 13, ...",
                        t->clips.path[0]);
    DAR_TRY(dar_step_count(p->step, c, &t->m->dit, &size, e));
    size_t rest = p->program + p->weights + p->moments + p->batches + p->validation;
    p->how = dar_step_choose(c, p->step, p->budget > rest ? p->budget - rest : 0);
    p->tokens = (double)(z.d[0] * z.d[2] * (z.d[3] / d->patch) * (z.d[4] / d->patch) * c->accumulate);
    p->flops = (p->step[p->how].forward + p->step[p->how].backward) * (double)c->accumulate;
    return DAR_OK;
}

/* Everything on planning arenas; closes what it opened. */
static dar_status plan(dar_trainer *t, dar_err *e)
{
    t->plan.budget = dar_trainer_budget(t->c);
    t->plan.program = dar_trainer_program();
    t->plan.peak = dar_rate((dar_dtype)t->c->storage);
    DAR_TRY(open_model(t, true, e));
    count_parameters(t);
    t->plan.weights = t->m->bytes;
    DAR_TRY(init_optim(t, e));
    t->plan.moments = t->moments.peak;
    DAR_TRY(open_loader(t, true, e));
    t->plan.batches = dar_loader_bytes(t->loader);
    DAR_TRY(open_validator(t, e));
    t->plan.validation = dar_validator_bytes(t->validator);
    return plan_step(t, e);
}

static void drop_plan(dar_trainer *t)
{
    dar_validator_close(t->validator);
    dar_loader_close(t->loader);
    dar_cache_close(t->cache);
    dar_arena_free(&t->moments);
    dar_model_close(t->m);
    t->validator = NULL;
    t->loader = NULL;
    t->cache = NULL;
    t->m = NULL;
}

/* ---------------------------------------------------------------- what checkpoints say */

/* Paths of frozen parts are absolute, so that a checkpoint may be moved; trained ones lie in it. */
static dar_status name_part(dar_json_doc *doc, dar_model_part part, const char *path, dar_err *e)
{
    char text[PATH_MAX + 64], real[PATH_MAX];
    const char *name = dar_model_part_name[part];
    if (!path) snprintf(text, sizeof text, "weights.%s=null", name);
    else snprintf(text, sizeof text, "weights.%s=%s", name, *path == '/' || !realpath(path, real) ? path : real);
    return dar_json_set(doc, text, e);
}

static dar_status describe(dar_trainer *t, dar_err *e)
{
    const dar_model *m = t->m;
    dar_json_doc *doc = t->c->file.doc;
    bool lora = t->c->what == DAR_TRAIN_LORA, adapter = m->dit.adapter.w != NULL;
    DAR_TRY(name_part(doc, DAR_MODEL_DIT, lora ? m->path[DAR_MODEL_DIT] : "dit.safetensors", e));
    DAR_TRY(name_part(doc, DAR_MODEL_VAE, m->path[DAR_MODEL_VAE], e));
    DAR_TRY(name_part(doc, DAR_MODEL_ADAPTER, lora && adapter ? "adapter.safetensors" : NULL, e));
    DAR_TRY(name_part(doc, DAR_MODEL_LORA, lora ? "lora.safetensors" : NULL, e));
    t->text[0].pretty = t->text[1].pretty = true;
    dar_train_config_print(t->c, &t->text[0]);
    dar_json_write_value(&t->text[1], NULL, dar_json_root(doc));
    if (t->text[0].failed || t->text[1].failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", t->c->output);
    return DAR_OK;
}

/* ---------------------------------------------------------------- a run */

static dar_status stop_asked(void *ctx, dar_err *e)
{
    const dar_trainer *t = ctx;
    if (!dar_interrupted()) return DAR_OK;
    return dar_fail(e, DAR_ERR_INTERRUPTED, "%s: interrupted while latents were made; run again to go on",
                    t->c->output);
}

static dar_status fill_cache(dar_trainer *t, const dar_clips *clips, dar_err *e)
{
    dar_cache_report r = { 0 };
    DAR_TRY(dar_cache_fill(t->cache, (const char *const *)(uintptr_t)clips->path, clips->n, stop_asked, t, &r, e));
    if (r.damaged) dar_log(DAR_LOG_WARNING, "cache: %zu entries were damaged and made again", r.damaged);
    return DAR_OK;
}

static dar_status open_run(dar_trainer *t, const dar_trainer_options *o, dar_err *e)
{
    const dar_train_config *c = t->c;
    const dar_trainer_plan *p = &t->plan;
    if (dar_trainer_bytes(p) > p->budget)
        return dar_fail(e, DAR_ERR_NOMEM, "this run needs %.2f GB of memory, found %.2f GB to use",
                        (double)dar_trainer_bytes(p) / 1e9, (double)p->budget / 1e9);
    DAR_TRY(open_model(t, false, e));
    DAR_TRY(init_optim(t, e));
    DAR_TRY(describe(t, e));
    t->saver = (dar_checkpoint){ .run = c->output, .params = &t->m->params[0], .dit = &t->m->dit, .optim = &t->optim };
    t->saver.seed = (uint64_t)c->seed;
    t->saver.config = t->text[0].text;
    t->saver.model = t->text[1].text;
    t->saver.keep = c->keep;
    DAR_TRY(dar_checkpoint_open(&t->saver, e));
    DAR_TRY(dar_checkpoint_resume(&t->saver, o->resume, e));
    DAR_TRY(open_loader(t, false, e));
    DAR_TRY(open_validator(t, e));
    DAR_TRY(fill_cache(t, &t->clips, e));
    if (t->validator) DAR_TRY(fill_cache(t, dar_validator_clips(t->validator), e));
    DAR_TRY(dar_step_init(&t->step, c, &t->m->dit, t->plan.how, &t->plan.step[t->plan.how], e));
    t->step.empty = t->no_text;
    dar_journal_options j = { c->output, c->steps, t->plan.tokens, t->plan.flops, t->plan.peak };
    return dar_journal_open(&t->journal, &j, t->saver.step, e);
}

dar_status dar_trainer_open(dar_trainer **out, const dar_train_config *c, const dar_trainer_options *o, dar_err *e)
{
    dar_trainer *t = calloc(1, sizeof *t);
    *out = NULL;
    if (!t) return dar_fail(e, DAR_ERR_NOMEM, "training: out of memory");
    t->c = c;
    dar_status s = dar_clips_find(&t->clips, dar_train_config_list(c, NULL, "data"), e);
    if (s == DAR_OK && !t->clips.n) s = dar_fail(e, DAR_ERR_USAGE, "data: found [], expected bundles to train on");
    if (s == DAR_OK) s = read_empty(t, e);
    if (s == DAR_OK) s = plan(t, e);
    drop_plan(t);
    if (s == DAR_OK && !o->plan) s = open_run(t, o, e);
    if (s == DAR_OK) *out = t;
    else dar_trainer_close(t);
    return s;
}

void dar_trainer_close(dar_trainer *t)
{
    if (!t) return;
    dar_journal_close(t->journal);
    dar_checkpoint_close(&t->saver);
    dar_step_free(&t->step);
    drop_plan(t);
    dar_weights_close(t->empty);
    dar_clips_free(&t->clips);
    for (int i = 0; i < 2; i++) dar_json_writer_free(&t->text[i]);
    free(t);
}

static dar_status run_step(dar_trainer *t, int64_t k, dar_err *e)
{
    const dar_train_config *c = t->c;
    double began = dar_log_clock();
    dar_journal_entry x = { .step = k + 1 };
    for (int64_t part = 0; part < c->accumulate; part++) {
        const dar_batch *b;
        DAR_TRY(dar_loader_get(t->loader, k * c->accumulate + part, &b, e));
        dar_step_report r = dar_step_run(&t->step, b, k, part);
        x.loss += r.loss / (double)c->accumulate;
        x.sigma += r.sigma / (double)c->accumulate;
    }
    t->optim.config.rate = dar_train_rate(c, k);
    dar_optim_report r = dar_optim_step(&t->optim);
    x.norm = r.norm, x.rate = r.rate, x.skipped = r.skipped, x.nonfinite = r.nonfinite;
    x.seconds = dar_log_clock() - began;
    DAR_TRY(dar_journal_step(t->journal, &x, e));
    return dar_optim_check(&t->optim, &r, e);
}

static dar_status save(dar_trainer *t, int64_t done, dar_err *e)
{
    if (t->saver.step == done && done) return DAR_OK;
    DAR_TRY(dar_journal_flush(t->journal, e));
    return dar_checkpoint_save(&t->saver, done, e);
}

static bool every(int64_t k, int64_t steps)
{
    return steps && k % steps == 0;
}

dar_status dar_trainer_run(dar_trainer *t, dar_err *e)
{
    const dar_train_config *c = t->c;
    for (int64_t k = t->saver.step; k < c->steps;) {
        DAR_TRY(run_step(t, k++, e));
        bool last = k == c->steps;
        if (t->validator && !dar_interrupted() && (last || every(k, c->validate_every)))
            DAR_TRY(dar_validator_run(t->validator, &t->step, t->journal, k, e));
        bool stop = dar_interrupted();
        if (stop || last || every(k, c->save_every)) DAR_TRY(save(t, k, e));
        if (stop && !last)
            return dar_fail(e, DAR_ERR_INTERRUPTED, "%s: stopped and saved after step %lld; --resume auto goes on",
                            c->output, (long long)k);
    }
    return DAR_OK;
}
