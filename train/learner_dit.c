/* learner_dit.c: see learner.h. */
#include "train/learner.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lib/log.h"
#include "lib/program.h"
#include "models/load.h"
#include "train/validate.h"

typedef struct state {
    dar_model *m;
    dar_cache *cache;
    dar_loader *loader;
    dar_validator *validator; /* NULL: nothing is validated */
    dar_step step;
    dar_weights *empty; /* text.empty, or NULL */
    dar_tensor no_text; /* of it */
} state;

/* ---------------------------------------------------------------- opening */

static unsigned roles(const dar_train_config *c)
{
    return DAR_PARAM_ADAPTER | (c->what == DAR_TRAIN_LORA ? DAR_PARAM_LORA : DAR_PARAM_BASE);
}

static dar_status network(dar_loop *l, bool plan, dar_err *e)
{
    state *t = l->state;
    const dar_train_config *c = l->c;
    dar_model_options o = { .weights = c->weights, .storage = (dar_dtype)c->storage, .strength = 1, .apart = true };
    memcpy(o.part, c->part, sizeof o.part);
    o.plan = plan;
    o.train = roles(c);
    o.fresh = c->from_scratch;
    o.seed = (uint64_t)c->seed;
    DAR_TRY(dar_model_open(&t->m, &c->file, &o, e));
    if (plan) l->plan.weights = t->m->bytes;
    l->params = &t->m->params[0];
    l->dit = &t->m->dit;
    return DAR_OK;
}

static dar_status open_loader(dar_loop *l, bool plan, dar_err *e)
{
    state *t = l->state;
    const dar_train_config *c = l->c;
    char near[PATH_MAX];
    snprintf(near, sizeof near, "%.4000s/../cache", c->output);
    DAR_TRY(dar_cache_open(&t->cache, c->cache ? c->cache : near, &t->m->vae, &t->m->params[1], e));
    dar_loader_config o = dar_loop_loader(l, plan);
    o.cache = t->cache;
    o.dit = &t->m->c.dit;
    o.condition = t->m->dit.adapter.w ? &c->condition : NULL;
    o.posterior = c->posterior != 0;
    return dar_loader_open(&t->loader, &o, e);
}

/* What stands for no text. */
static dar_status read_empty(dar_loop *l, dar_err *e)
{
    state *t = l->state;
    const char *path = l->c->text_empty;
    if (!path) return DAR_OK;
    DAR_TRY(dar_weights_open(&t->empty, path, e));
    return dar_load_text(&l->c->file.c.dit, t->empty, path, "text", &t->no_text, e);
}

/* ---------------------------------------------------------------- planning */

static dar_status count(dar_loop *l, dar_err *e)
{
    state *t = l->state;
    const dar_train_config *c = l->c;
    const dar_dit_config *d = &t->m->c.dit;
    dar_shape z = dar_loader_latent(t->loader);
    dar_step_size size = { z.d[0], z.d[2], z.d[3], z.d[4], .pixels = dar_vae_shrink(&t->m->c.vae) };
    size.words = dar_loader_words(t->loader);
    if (t->no_text.data && t->no_text.shape.d[1] > size.words) size.words = t->no_text.shape.d[1];
    if (t->m->dit.adapter.w) size.cond = t->m->c.adapter.rays + t->m->c.adapter.geometry;
    if (size.frames < 2)
        return dar_fail(e, DAR_ERR_USAGE, "%s: found 1 frame, which is the reference itself: expected 5, 9, 13, ...",
                        l->clips.path[0]);
    l->plan.batches = dar_loader_bytes(t->loader);
    l->plan.validation = dar_validator_bytes(t->validator);
    l->plan.tokens = (double)(z.d[0] * z.d[2] * (z.d[3] / d->patch) * (z.d[4] / d->patch) * c->accumulate);
    return dar_step_count(l->plan.step, c, &t->m->dit, &size, e);
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

static dar_status describe(dar_loop *l, dar_json_doc *model, dar_err *e)
{
    const state *t = l->state;
    const dar_model *m = t->m;
    bool lora = l->c->what == DAR_TRAIN_LORA, adapter = m->dit.adapter.w != NULL;
    DAR_TRY(name_part(model, DAR_MODEL_DIT, lora ? m->path[DAR_MODEL_DIT] : "dit.safetensors", e));
    DAR_TRY(name_part(model, DAR_MODEL_VAE, m->path[DAR_MODEL_VAE], e));
    DAR_TRY(name_part(model, DAR_MODEL_ADAPTER, lora && adapter ? "adapter.safetensors" : NULL, e));
    return name_part(model, DAR_MODEL_LORA, lora ? "lora.safetensors" : NULL, e);
}

/* ---------------------------------------------------------------- a run */

static dar_status stop_asked(void *ctx, dar_err *e)
{
    const dar_loop *l = ctx;
    if (!dar_interrupted()) return DAR_OK;
    return dar_fail(e, DAR_ERR_INTERRUPTED, "%s: interrupted while latents were made; run again to go on",
                    l->c->output);
}

static dar_status fill_cache(dar_loop *l, const dar_clips *clips, dar_err *e)
{
    const state *t = l->state;
    dar_cache_report r = { 0 };
    DAR_TRY(dar_cache_fill(t->cache, (const char *const *)(uintptr_t)clips->path, clips->n, stop_asked, l, &r, e));
    if (r.damaged) dar_log(DAR_LOG_WARNING, "cache: %zu entries were damaged and made again", r.damaged);
    return DAR_OK;
}

static dar_status prepare(dar_loop *l, bool plan, dar_err *e)
{
    state *t = l->state;
    DAR_TRY(read_empty(l, e));
    DAR_TRY(open_loader(l, plan, e));
    DAR_TRY(dar_validator_open(&t->validator, l->c, t->m, t->cache, dar_loader_latent(t->loader), e));
    if (plan) return count(l, e);
    DAR_TRY(fill_cache(l, &l->clips, e));
    if (t->validator) DAR_TRY(fill_cache(l, dar_validator_clips(t->validator), e));
    DAR_TRY(dar_step_init(&t->step, l->c, &t->m->dit, l->plan.how, &l->plan.step[l->plan.how], e));
    t->step.empty = t->no_text;
    return DAR_OK;
}

static dar_status batch(dar_loop *l, int64_t step, int64_t part, dar_loop_batch *out, dar_err *e)
{
    state *t = l->state;
    const dar_batch *b;
    DAR_TRY(dar_loader_get(t->loader, step * l->c->accumulate + part, &b, e));
    dar_step_report r = dar_step_run(&t->step, b, step, part);
    *out = (dar_loop_batch){ r.loss, r.sigma };
    return DAR_OK;
}

static dar_status validate(dar_loop *l, int64_t step, dar_err *e)
{
    state *t = l->state;
    return t->validator ? dar_validator_run(t->validator, &t->step, l->journal, step, e) : DAR_OK;
}

static void drop(dar_loop *l)
{
    state *t = l->state;
    dar_step_free(&t->step);
    dar_validator_close(t->validator);
    dar_loader_close(t->loader);
    dar_cache_close(t->cache);
    dar_weights_close(t->empty);
    dar_model_close(t->m);
}

const dar_learner dar_learner_dit = { sizeof(state), network, prepare, batch, validate, describe, drop };
