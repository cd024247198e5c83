/* step.c: see step.h. */
#include "train/step.h"

#include <math.h>
#include <string.h>

#include "lib/log.h"
#include "lib/rng.h"

/* ---------------------------------------------------------------- what is drawn
 *
 * One stream per purpose; clip n of the run has place n in it.  Noise takes a stream per clip. */

static double uniform(const dar_train_config *c, const char *purpose, uint64_t n)
{
    return dar_rng_f64((uint64_t)c->seed, dar_rng_stream(purpose), n);
}

static double draw_sigma(const dar_train_config *c, uint64_t n, int64_t slot, int64_t slots)
{
    double u = uniform(c, "train.sigma", n);
    if (c->stratified) u = ((double)slot + u) / (double)slots;
    return dar_flow_sigma(dar_flow_draw((dar_flow_density)c->density, u), c->shift);
}

static void draw_noise(const dar_train_config *c, uint64_t n, const dar_tensor *eps)
{
    uint64_t seed = (uint64_t)c->seed, stream = dar_rng_u64(seed, dar_rng_stream("train.noise"), n);
    dar_rng_fill_normal(eps, seed, stream, 1);
}

/* ---------------------------------------------------------------- the batch as the network sees it */

struct given {
    dar_tensor z, target, weight; /* [B, C, F, h, w] twice, [B, 1, F, 1, 1]; main type */
    dar_tensor known, text;
    double *sigma, *time; /* [B], [B, rows] */
    int64_t *count;       /* [B] */
    int64_t rows;
};

static void weigh_clip(const dar_train_config *c, double sigma, double share, const dar_tensor *weight)
{
    int64_t F = weight->shape.d[2];
    double w = share * dar_flow_weight((dar_flow_weighting)c->weighting, sigma, c->shift);
    if (c->first == DAR_FIRST_EXCLUDE) w *= (double)F / (double)(F - 1);
    dar_tensor_fill(weight, w);
    dar_tensor first = dar_tensor_narrow(weight, 2, 0, 1);
    if (c->first == DAR_FIRST_EXCLUDE) dar_tensor_fill(&first, 0);
}

static void draw_clip(const dar_train_config *c, const struct given *g, int64_t b, uint64_t n, const dar_tensor *z0)
{
    int64_t slots = z0->shape.d[0] * c->accumulate, slot = (int64_t)(n % (uint64_t)slots);
    dar_tensor x = dar_tensor_narrow(z0, 0, b, 1), z = dar_tensor_narrow(&g->z, 0, b, 1);
    dar_tensor v = dar_tensor_narrow(&g->target, 0, b, 1), w = dar_tensor_narrow(&g->weight, 0, b, 1);
    double sigma = g->sigma[b] = draw_sigma(c, n, slot, slots);
    draw_noise(c, n, &v);
    dar_flow_mix(&x, &v, sigma, &z);
    dar_flow_target(&x, &v, &v);
    if (c->first != DAR_FIRST_NOISY) dar_dit_hold_first(&z, &x);
    weigh_clip(c, sigma, 1.0 / (double)c->accumulate, &w);
    for (int64_t r = 0; r < g->rows; r++) g->time[b * g->rows + r] = g->rows > 1 && r == 0 ? 0 : DAR_FLOW_TIMES * sigma;
}

/* Text b of the batch, or what stands for none. */
static void write_text(const dar_step *s, const struct given *g, const dar_batch *batch, int64_t b, bool dropped)
{
    const dar_tensor *from = &batch->text;
    int64_t count = dropped || !from->data ? 0 : batch->count[b], at = b;
    if (!count && s->empty.data) {
        from = &s->empty;
        count = from->shape.d[1];
        at = 0;
    }
    g->count[b] = count;
    dar_tensor to = dar_tensor_narrow(&g->text, 0, b, 1);
    dar_tensor_fill(&to, 0);
    if (!count) return;
    dar_tensor x = dar_tensor_narrow(from, 0, at, 1);
    x = dar_tensor_narrow(&x, 1, 0, count);
    to = dar_tensor_narrow(&to, 1, 0, count);
    dar_tensor_copy(&to, &x);
}

/* x itself if it is of that type, else a copy. */
static dar_tensor as_type(dar_step *s, const dar_tensor *x, dar_dtype type)
{
    if (x->dtype == type || !x->data) return *x;
    dar_tensor y = dar_tensor_push(&s->step, type, x->shape);
    if (!s->step.plan) dar_tensor_copy(&y, x);
    return y;
}

static struct given give(dar_step *s, const dar_batch *b, uint64_t first, bool dropout)
{
    const dar_train_config *c = s->c;
    dar_dtype main = s->m->main;
    int64_t B = b->z0.shape.d[0], F = b->z0.shape.d[2], n = b->text.data ? b->text.shape.d[1] : 0;
    if (s->empty.data && s->empty.shape.d[1] > n) n = s->empty.shape.d[1];
    struct given g = { .rows = c->first == DAR_FIRST_NOISY ? 1 : 2 };
    g.z = dar_tensor_push(&s->step, main, b->z0.shape);
    g.target = dar_tensor_push(&s->step, main, b->z0.shape);
    g.weight = dar_tensor_push(&s->step, main, DAR_SHAPE(B, 1, F, 1, 1));
    g.text = dar_tensor_push(&s->step, DAR_F32, DAR_SHAPE(B, n, s->m->c.text_width));
    g.known = as_type(s, &b->known, main);
    dar_tensor z0 = as_type(s, &b->z0, main);
    g.sigma = dar_arena_push(&s->step, (size_t)B * sizeof *g.sigma);
    g.time = dar_arena_push(&s->step, (size_t)(B * g.rows) * sizeof *g.time);
    g.count = dar_arena_push(&s->step, (size_t)B * sizeof *g.count);
    if (s->step.plan) {
        g.count = NULL;
        return g;
    }
    for (int64_t i = 0; i < B; i++) {
        uint64_t clip = first + (uint64_t)i;
        draw_clip(c, &g, i, clip, &z0);
        write_text(s, &g, b, i, dropout && uniform(c, "train.text", clip) < c->text_dropout);
    }
    return g;
}

/* ---------------------------------------------------------------- forward and backward */

static dar_val *loss_of(dar_step *s, const dar_batch *b, const struct given *g)
{
    dar_tape *t = &s->tape;
    const dar_shape *z = &b->z0.shape;
    dar_dit_scene *scene = dar_tape_room(t, sizeof *scene);
    dar_dit_text *text = dar_tape_room(t, sizeof *text);
    dar_dit_clip clip = { z->d[0], z->d[2], z->d[3], z->d[4], b->cond, g->known };
    dar_dit_time time = { g->time, g->rows };
    dar_dit_scene_prepare(t, s->m, &clip, scene);
    dar_dit_text_prepare(t, s->m, &g->text, g->count, text);
    dar_val *v = dar_dit_forward(t, s->m, scene, text, dar_leaf(t, g->z, NULL), &time);
    return dar_squared_error(t, v, dar_leaf(t, g->target, NULL), dar_leaf(t, g->weight, NULL), true);
}

static void begin(dar_step *s, bool recording)
{
    dar_tape_clear(&s->tape);
    dar_arena_reset(&s->step, 0);
    dar_arena_reset(&s->keep, 0);
    s->tape.recording = recording;
}

static dar_step_report report(const dar_step *s, const struct given *g, const dar_val *loss)
{
    int64_t B = g->z.shape.d[0];
    dar_step_report r = { .loss = dar_dtype_get(loss->x.dtype, loss->x.data, 0) * (double)s->c->accumulate };
    for (int64_t b = 0; b < B; b++) r.sigma += g->sigma[b] / (double)B;
    return r;
}

dar_step_report dar_step_run(dar_step *s, const dar_batch *b, int64_t step, int64_t part)
{
    uint64_t first = (uint64_t)((step * s->c->accumulate + part) * b->z0.shape.d[0]);
    double clock[4] = { dar_log_clock() };
    begin(s, true);
    struct given g = give(s, b, first, true);
    clock[1] = dar_log_clock();
    dar_val *loss = loss_of(s, b, &g);
    clock[2] = dar_log_clock();
    dar_step_report r = { 0 };
    if (!s->step.plan) r = report(s, &g, loss);
    dar_backward(&s->tape, loss, NULL);
    clock[3] = dar_log_clock();
    r.draw = clock[1] - clock[0], r.forward = clock[2] - clock[1], r.backward = clock[3] - clock[2];
    return r;
}

dar_step_report dar_step_look(dar_step *s, const dar_batch *b, int64_t step)
{
    begin(s, false);
    struct given g = give(s, b, (uint64_t)(step * s->c->accumulate * b->z0.shape.d[0]), false);
    return report(s, &g, loss_of(s, b, &g));
}

/* ---------------------------------------------------------------- plans */

static void set_way(dar_step *s, dar_recompute how)
{
    static const dar_dit_replay replay[] = {
        [DAR_RECOMPUTE_NONE] = DAR_REPLAY_NOTHING, [DAR_RECOMPUTE_CHEAP] = DAR_REPLAY_CHEAP,
        [DAR_RECOMPUTE_WIDE] = DAR_REPLAY_WIDE,    [DAR_RECOMPUTE_MOST] = DAR_REPLAY_PRODUCTS,
        [DAR_RECOMPUTE_ALL] = DAR_REPLAY_ALL,
    };
    s->how = how;
    s->m->replay = replay[how];
    s->tape.keep = &s->keep;
}

/* A batch without memory behind it. */
static dar_batch imagine(const dar_dit *m, const dar_step_size *z, dar_arena *a)
{
    int64_t B = z->clips, F = z->frames, h = z->height, w = z->width;
    dar_batch b = { .z0 = dar_tensor_push(a, DAR_F32, DAR_SHAPE(B, m->c.latent, F, h, w)) };
    if (m->c.mask) b.known = dar_tensor_push(a, DAR_F32, DAR_SHAPE(B, m->c.mask + m->c.latent, F, h, w));
    if (z->cond) b.cond = dar_tensor_push(a, DAR_F32, DAR_SHAPE(B, z->cond, F, h * z->pixels, w * z->pixels));
    if (z->words) b.text = dar_tensor_push(a, DAR_F32, DAR_SHAPE(B, z->words, m->c.text_width));
    return b;
}

static dar_status count_way(dar_step_plan *plan, const dar_train_config *c, dar_dit *m, const dar_step_size *size,
                            dar_recompute how, dar_err *e)
{
    dar_step s = { .c = c, .m = m };
    dar_arena batch = { 0 };
    dar_status status = dar_arena_init_plan(&batch, "batch", e);
    if (status == DAR_OK) status = dar_arena_init_plan(&s.step, "step", e);
    if (status == DAR_OK) status = dar_arena_init_plan(&s.keep, "keep", e);
    if (status == DAR_OK) status = dar_tape_init(&s.tape, &s.step, e);
    if (status == DAR_OK) {
        dar_batch b = imagine(m, size, &batch);
        set_way(&s, how);
        dar_step_run(&s, &b, 0, 0);
        *plan = (dar_step_plan){ { s.step.peak, s.keep.peak }, s.tape.cost.forward, s.tape.cost.backward };
    }
    dar_step_free(&s);
    dar_arena_free(&batch);
    return status;
}

dar_status dar_step_count(dar_step_plan plan[DAR_RECOMPUTE_ALL + 1], const dar_train_config *c, dar_dit *m,
                          const dar_step_size *size, dar_err *e)
{
    memset(plan, 0, (DAR_RECOMPUTE_ALL + 1) * sizeof *plan);
    for (int k = DAR_RECOMPUTE_NONE; k <= DAR_RECOMPUTE_ALL; k++)
        DAR_TRY(count_way(&plan[k], c, m, size, (dar_recompute)k, e));
    return DAR_OK;
}

static size_t bytes_of(const dar_step_plan *p)
{
    return p->bytes[0] + p->bytes[1];
}

dar_recompute dar_step_choose(const dar_train_config *c, const dar_step_plan plan[DAR_RECOMPUTE_ALL + 1], size_t bytes)
{
    int best = DAR_RECOMPUTE_NONE;
    if (c->recompute != DAR_RECOMPUTE_AUTO) return (dar_recompute)c->recompute;
    for (int k = DAR_RECOMPUTE_NONE + 1; k <= DAR_RECOMPUTE_ALL; k++) {
        double work = plan[k].forward + plan[k].backward, least = plan[best].forward + plan[best].backward;
        bool fits = bytes_of(&plan[k]) <= bytes, best_fits = bytes_of(&plan[best]) <= bytes;
        if (best_fits ? fits && work <= least : bytes_of(&plan[k]) < bytes_of(&plan[best])) best = k;
    }
    return (dar_recompute)best;
}

dar_status dar_step_init(dar_step *s, const dar_train_config *c, dar_dit *m, dar_recompute how,
                         const dar_step_plan *plan, dar_err *e)
{
    *s = (dar_step){ .c = c, .m = m, .plan = *plan };
    dar_status status = dar_arena_init(&s->step, "step", plan->bytes[0], e);
    if (status == DAR_OK) status = dar_arena_init(&s->keep, "kept results", plan->bytes[1], e);
    if (status == DAR_OK) status = dar_tape_init(&s->tape, &s->step, e);
    if (status == DAR_OK) set_way(s, how);
    else dar_step_free(s);
    return status;
}

void dar_step_free(dar_step *s)
{
    dar_tape_free(&s->tape);
    dar_arena_free(&s->step);
    dar_arena_free(&s->keep);
    memset(s, 0, sizeof *s);
}
