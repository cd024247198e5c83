/* optim.c: see optim.h. */
#include "train/optim.h"

#include <fnmatch.h>
#include <math.h>

#include "lib/kern.h"
#include "lib/rng.h"
#include "lib/thread.h"

#define CHUNK     ((size_t)64 * 1024) /* elements of a partial sum */
#define PLACES    40                  /* bits of an index that say which element of a tensor, the rest which step */
#define CLIP_TINY 1e-6                /* keeps the scale finite, as in torch */

dar_optim_config dar_optim_default(void)
{
    return (dar_optim_config){ .rate = 1e-4,
                               .beta1 = 0.9,
                               .beta2 = 0.999,
                               .eps = 1e-10,
                               .decay = 0.03,
                               .max_norm = 0.05,
                               .warmup = 200,
                               .patience = 20 };
}

void dar_optim_init(dar_optim *o, const dar_optim_config *c, dar_params *p, dar_arena *a)
{
    *o = (dar_optim){ .config = *c, .params = p, .schedule = 1, .plan = a->plan };
    o->m = dar_arena_push(a, dar_mul_size(p->count, sizeof *o->m));
    o->v = dar_arena_push(a, dar_mul_size(p->count, sizeof *o->v));
    o->average = dar_arena_push(a, dar_mul_size(p->count, sizeof *o->average));
    o->rate = dar_arena_push(a, dar_mul_size(p->count, sizeof *o->rate));
    for (size_t i = 0; i < p->count; i++) {
        const dar_param *q = p->at[i];
        dar_tensor m = { 0 }, v = { 0 }, average = { 0 };
        if (q->trainable) {
            DAR_ASSERT(q->g.data, "optim: %s has no gradient memory", q->name);
            dar_dtype type = c->bf16_moments ? DAR_BF16 : p->main;
            m = dar_tensor_push(a, type, q->x.shape);
            v = dar_tensor_push(a, type, q->x.shape);
            if (c->average > 0) average = dar_tensor_push(a, p->main, q->x.shape);
        }
        if (a->plan) continue;
        if (m.data) dar_tensor_fill(&m, 0);
        if (v.data) dar_tensor_fill(&v, 0);
        o->m[i] = m;
        o->v[i] = v;
        o->average[i] = average;
        o->rate[i] = c->rate;
    }
    if (!a->plan) dar_optim_restart_average(o);
}

size_t dar_optim_set_rate(dar_optim *o, const char *pattern, double rate)
{
    size_t n = 0;
    for (size_t i = 0; i < o->params->count; i++) {
        const dar_param *q = o->params->at[i];
        if (!q->trainable || fnmatch(pattern, q->name, 0) != 0) continue;
        if (!o->plan) o->rate[i] = rate;
        n++;
    }
    return n;
}

void dar_optim_restart_average(dar_optim *o)
{
    for (size_t i = 0; i < o->params->count; i++)
        if (o->average[i].data) dar_tensor_copy(&o->average[i], &o->params->at[i]->x);
}

void dar_optim_swap(dar_optim *o)
{
    for (size_t i = 0; o->config.average > 0 && i < o->params->count; i++) {
        dar_param *q = o->params->at[i];
        if (!q->trainable) continue;
        dar_tensor x = q->x;
        q->x = o->average[i];
        o->average[i] = x;
    }
}

static double square_sum(void *ctx, size_t begin, size_t end)
{
    const dar_tensor *g = ctx;
    const void *x = dar_tensor_at(g, begin);
    return dar_kern_for(g->dtype)->dot(end - begin, x, x);
}

double dar_optim_norm(const dar_params *p)
{
    double sum = 0;
    for (size_t i = 0; i < p->count; i++) {
        dar_tensor g = p->at[i]->g;
        if (p->at[i]->trainable) sum += dar_parallel_sum(dar_tensor_count(&g), CHUNK, square_sum, &g);
    }
    return sqrt(sum);
}

static const char *find_nonfinite(const dar_params *p)
{
    for (size_t i = 0; i < p->count; i++)
        if (p->at[i]->trainable && dar_tensor_nonfinite(&p->at[i]->g) >= 0) return p->at[i]->name;
    return NULL;
}

/* ---------------------------------------------------------------- the average */

typedef struct following {
    double share; /* of the way from a to w */
    dar_dtype type;
    void *a;
    const void *w;
} following;

static void follow_range(void *ctx, size_t begin, size_t end, int thread)
{
    const following *f = ctx;
    (void)thread;
    if (f->type == DAR_F64) {
        double *a = f->a;
        const double *w = f->w;
        for (size_t i = begin; i < end; i++) a[i] -= f->share * (a[i] - w[i]);
    } else {
        float *a = f->a, share = (float)f->share;
        const float *w = f->w;
        for (size_t i = begin; i < end; i++) a[i] -= share * (a[i] - w[i]);
    }
}

static void follow(dar_optim *o)
{
    const double k = (double)o->steps, decay = o->steps ? fmin(o->config.average, (1 + k) / (10 + k)) : 0;
    for (size_t i = 0; i < o->params->count; i++) {
        const dar_param *q = o->params->at[i];
        following f = { 1 - decay, o->params->main, o->average[i].data, q->x.data };
        if (q->trainable) dar_parallel_range(dar_tensor_count(&q->x), CHUNK, follow_range, &f);
    }
}

/* ---------------------------------------------------------------- a step */

dar_optim_report dar_optim_step(dar_optim *o)
{
    const dar_optim_config *c = &o->config;
    dar_params *p = o->params;
    double k = (double)o->steps, t = k + 1;
    double schedule = o->schedule * (o->steps < c->warmup ? k / (double)c->warmup : 1);
    dar_optim_report r = { .norm = dar_optim_norm(p), .rate = schedule * c->rate };
    r.skipped = !isfinite(r.norm);
    if (r.skipped) r.nonfinite = find_nonfinite(p);

    dar_adamw a = { .beta1 = c->beta1, .beta2 = c->beta2, .eps = c->eps, .decay = c->decay };
    a.fix1 = 1 / (1 - pow(c->beta1, t));
    a.fix2 = 1 / (1 - pow(c->beta2, t));
    a.seed = c->seed;
    a.index = (uint64_t)o->steps << PLACES;
    a.scale = c->max_norm > 0 ? fmin(1, c->max_norm / (r.norm + CLIP_TINY)) : 1;
    for (size_t i = 0; i < p->count; i++) {
        dar_param *q = p->at[i];
        if (!q->trainable) continue;
        a.rate = schedule * o->rate[i];
        a.stream = dar_rng_stream(q->name) ^ dar_rng_stream("moments"); /* not that of fresh values */
        if (r.skipped) dar_tensor_fill(&q->g, 0);
        else
            dar_row_adamw(&a, p->main, o->m[i].dtype, dar_tensor_count(&q->x), q->x.data, o->m[i].data, o->v[i].data,
                          q->g.data);
    }
    if (!r.skipped && c->average > 0) follow(o);
    o->in_a_row = r.skipped ? o->in_a_row + 1 : 0;
    if (r.skipped) o->skipped++;
    else o->steps++;
    return r;
}

dar_status dar_optim_check(const dar_optim *o, const dar_optim_report *r, dar_err *e)
{
    if (o->in_a_row <= o->config.patience) return DAR_OK;
    return dar_fail(e, DAR_ERR_NUMERIC,
                    "step %lld: gradients were not finite %lld times in a row, the last time that of %s: found norm %g",
                    (long long)o->steps, (long long)o->in_a_row, r->nonfinite ? r->nonfinite : "no single parameter",
                    r->norm);
}
