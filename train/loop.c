/* loop.c: see loop.h. */
#include "train/loop.h"

#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <unistd.h>

#include "lib/log.h"
#include "lib/program.h"
#include "models/rate.h"

/* ---------------------------------------------------------------- planning */

/* Bytes that the configuration allows, or that the machine has. */
static size_t budget(const dar_train_config *c)
{
    long pages = sysconf(_SC_PHYS_PAGES), size = sysconf(_SC_PAGE_SIZE);
    if (c->budget > 0) return (size_t)(c->budget * 1e9);
    return pages > 0 && size > 0 ? dar_mul_size((size_t)pages, (size_t)size) : 0;
}

/* Bytes that the program has taken so far. */
static size_t program(void)
{
    struct rusage r;
    return getrusage(RUSAGE_SELF, &r) == 0 ? 1024 * (size_t)r.ru_maxrss : 0;
}

static size_t without_step(const dar_loop_plan *p)
{
    return p->program + p->weights + p->moments + p->batches + p->validation;
}

size_t dar_loop_bytes(const dar_loop_plan *p)
{
    const dar_step_plan *s = &p->step[p->how];
    return without_step(p) + s->bytes[0] + s->bytes[1];
}

dar_loader_config dar_loop_loader(const dar_loop *l, bool plan)
{
    const dar_train_config *c = l->c;
    return (dar_loader_config){ .path = (const char *const *)(uintptr_t)l->clips.path,
                                .clips = l->clips.n,
                                .batch = c->batch,
                                .ahead = (size_t)c->ahead,
                                .shuffle = true,
                                .seed = (uint64_t)c->seed,
                                .plan = plan };
}

static void count_parameters(dar_loop *l)
{
    for (size_t i = 0; i < l->params->count; i++) {
        const dar_param *q = l->params->at[i];
        *(q->trainable ? &l->plan.trained : &l->plan.frozen) += dar_shape_count(&q->x.shape);
    }
}

static const char *a_trained_name(const dar_params *p)
{
    for (size_t i = 0; i < p->count; i++)
        if (p->at[i]->trainable) return p->at[i]->name;
    return "none";
}

static dar_status init_optim(dar_loop *l, bool plan, dar_err *e)
{
    const dar_train_config *c = l->c;
    dar_optim_config o = { c->rate, c->beta1, c->beta2, c->eps, c->decay, c->max_norm, .warmup = c->warmup };
    o.bf16_moments = c->moments != 0;
    o.seed = (uint64_t)c->seed;
    o.patience = c->patience;
    o.average = c->average;
    DAR_TRY(plan ? dar_arena_init_plan(&l->moments, "moments", e)
                 : dar_arena_init(&l->moments, "moments", l->plan.moments, e));
    dar_optim_init(&l->optim, &o, l->params, &l->moments);
    for (size_t i = 0; i < c->n_rates; i++)
        if (!dar_optim_set_rate(&l->optim, c->rates[i].pattern, c->rates[i].rate))
            return dar_fail(e, DAR_ERR_USAGE, "learning_rates: found \"%s\", expected a pattern of names such as %s",
                            c->rates[i].pattern, a_trained_name(l->params));
    return DAR_OK;
}

/* Everything on planning arenas. */
static dar_status plan(dar_loop *l, dar_err *e)
{
    dar_loop_plan *p = &l->plan;
    p->budget = budget(l->c);
    p->program = program();
    p->peak = dar_rate((dar_dtype)l->c->storage);
    DAR_TRY(l->learner->network(l, true, e));
    count_parameters(l);
    DAR_TRY(init_optim(l, true, e));
    p->moments = l->moments.peak;
    DAR_TRY(l->learner->prepare(l, true, e));
    size_t rest = without_step(p);
    p->how = dar_step_choose(l->c, p->step, p->budget > rest ? p->budget - rest : 0);
    p->flops = (p->step[p->how].forward + p->step[p->how].backward) * (double)l->c->accumulate;
    return DAR_OK;
}

/* Of what was planned, or is run. */
static void drop(dar_loop *l)
{
    l->learner->drop(l);
    dar_arena_free(&l->moments);
    memset(l->state, 0, l->learner->size);
}

/* ---------------------------------------------------------------- opening */

static dar_status open_run(dar_loop *l, const char *resume, dar_err *e)
{
    const dar_train_config *c = l->c;
    const dar_loop_plan *p = &l->plan;
    if (dar_loop_bytes(p) > p->budget)
        return dar_fail(e, DAR_ERR_NOMEM, "this run needs %.2f GB of memory, found %.2f GB to use",
                        (double)dar_loop_bytes(p) / 1e9, (double)p->budget / 1e9);
    DAR_TRY(l->learner->network(l, false, e));
    DAR_TRY(init_optim(l, false, e));
    l->text[0].pretty = l->text[1].pretty = true;
    dar_train_config_print(c, &l->text[0]);
    if (l->text[0].failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", c->output);
    l->saver = (dar_checkpoint){ .run = c->output, .params = l->params, .dit = l->dit, .optim = &l->optim };
    l->saver.seed = (uint64_t)c->seed;
    l->saver.config = l->text[0].text;
    l->saver.keep = c->keep;
    DAR_TRY(dar_checkpoint_open(&l->saver, e));
    dar_optim_swap(&l->optim);
    DAR_TRY(dar_checkpoint_resume(&l->saver, resume, e));
    dar_optim_swap(&l->optim);
    DAR_TRY(l->learner->prepare(l, false, e));
    if (!l->saver.step) dar_optim_restart_average(&l->optim);
    dar_journal_options j = { c->output, c->steps, p->tokens, p->flops, p->peak };
    return dar_journal_open(&l->journal, &j, l->saver.step, e);
}

dar_status dar_loop_open(dar_loop **out, const dar_learner *learner, const dar_train_config *c,
                         const dar_loop_options *o, dar_err *e)
{
    dar_loop *l = calloc(1, sizeof *l);
    *out = NULL;
    if (l) *l = (dar_loop){ .learner = learner, .c = c, .state = calloc(1, learner->size) };
    if (!l || !l->state) {
        free(l);
        return dar_fail(e, DAR_ERR_NOMEM, "training: out of memory");
    }
    dar_status s = dar_clips_find(&l->clips, dar_train_config_list(c, NULL, "data"), e);
    if (s == DAR_OK && !l->clips.n) s = dar_fail(e, DAR_ERR_USAGE, "data: found [], expected bundles to train on");
    if (s == DAR_OK) s = plan(l, e);
    drop(l);
    if (s == DAR_OK && !o->plan) s = open_run(l, o->resume, e);
    if (s == DAR_OK) *out = l;
    else dar_loop_close(l);
    return s;
}

void dar_loop_close(dar_loop *l)
{
    if (!l) return;
    dar_journal_close(l->journal);
    dar_checkpoint_close(&l->saver);
    drop(l);
    free(l->state);
    dar_clips_free(&l->clips);
    for (int i = 0; i < 2; i++) dar_json_writer_free(&l->text[i]);
    free(l);
}

/* ---------------------------------------------------------------- running */

static dar_status run_step(dar_loop *l, int64_t k, dar_err *e)
{
    const dar_train_config *c = l->c;
    double began = dar_log_clock();
    dar_journal_entry x = { .step = k + 1 };
    for (int64_t part = 0; part < c->accumulate; part++) {
        dar_loop_batch b = { 0 };
        DAR_TRY(l->learner->batch(l, k, part, &b, e));
        x.loss += b.loss / (double)c->accumulate;
        x.sigma += b.sigma / (double)c->accumulate;
    }
    l->optim.schedule = dar_train_schedule(c, k);
    dar_optim_report r = dar_optim_step(&l->optim);
    x.norm = r.norm, x.rate = r.rate, x.skipped = r.skipped, x.nonfinite = r.nonfinite;
    x.seconds = dar_log_clock() - began;
    DAR_TRY(dar_journal_step(l->journal, &x, e));
    return dar_optim_check(&l->optim, &r, e);
}

static dar_status save(dar_loop *l, int64_t done, dar_err *e)
{
    dar_json_doc *model = l->c->file.doc;
    DAR_TRY(l->learner->describe(l, model, e));
    dar_json_writer_reset(&l->text[1]);
    dar_json_write_value(&l->text[1], NULL, dar_json_root(model));
    if (l->text[1].failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", l->c->output);
    l->saver.model = l->text[1].text;
    DAR_TRY(dar_journal_flush(l->journal, e));
    return dar_checkpoint_save(&l->saver, done, e);
}

static bool every(int64_t k, int64_t steps)
{
    return steps && k % steps == 0;
}

/* After `done` steps: look and save, if it is time; stop, if that is asked. */
static dar_status look_up(dar_loop *l, int64_t done, dar_err *e)
{
    const dar_train_config *c = l->c;
    bool last = done == c->steps;
    if (!dar_interrupted() && (last || every(done, c->validate_every))) DAR_TRY(l->learner->validate(l, done, e));
    bool stop = dar_interrupted();
    if (stop || last || every(done, c->save_every)) DAR_TRY(save(l, done, e));
    if (!stop || last) return DAR_OK;
    return dar_fail(e, DAR_ERR_INTERRUPTED, "%s: stopped and saved after step %lld; --resume auto goes on", c->output,
                    (long long)done);
}

dar_status dar_loop_run(dar_loop *l, dar_err *e)
{
    for (int64_t k = l->saver.step; k < l->c->steps;) {
        DAR_TRY(run_step(l, k++, e));
        dar_optim_swap(&l->optim);
        DAR_TRY(look_up(l, k, e));
        dar_optim_swap(&l->optim);
    }
    return DAR_OK;
}
