/* sampler.c: see sampler.h. */
#include "models/sampler.h"

#include <string.h>

#include "lib/rng.h"
#include "lib/rng_torch.h"

const char *const dar_skip_name[] = { "pass", "scene", "text", "times", "padding", "lora", "repeat", NULL };

dar_sampler_config dar_sampler_default(void)
{
    return (dar_sampler_config){ .solver = dar_solver_default(), .guidance = 3, .skip = DAR_SKIPS_ALL };
}

static bool skips(const dar_sampler *s, dar_skip k)
{
    return s->c.skip >> k & 1;
}

static bool plans(const dar_sampler *s)
{
    return s->kept.arena->plan;
}

/* ---------------------------------------------------------------- what is constant over a clip */

static bool same_text(const dar_tensor *a, const dar_tensor *b)
{
    if (!a->data || !b->data) return a->data == b->data;
    return a->dtype == b->dtype && dar_shape_equal(&a->shape, &b->shape) &&
           memcmp(a->data, b->data, dar_tensor_bytes(a)) == 0;
}

/* A prompt as the network takes it: no token is a text of length 0; without `padding` the zeros are written out. */
static void write_text(dar_sampler *s, dar_tensor *x)
{
    int64_t n = x->data ? x->shape.d[1] : 0, keys = s->m->c.text_keys;
    if (x->data && skips(s, DAR_SKIP_PADDING)) return;
    dar_dtype type = x->data ? x->dtype : s->m->main;
    if (skips(s, DAR_SKIP_PADDING)) keys = 0;
    dar_tensor y = dar_tensor_push(s->kept.arena, type, DAR_SHAPE(1, keys, s->m->c.text_width));
    if (!plans(s)) {
        dar_tensor_fill(&y, 0);
        dar_tensor to = dar_tensor_narrow(&y, 1, 0, n);
        if (n) dar_tensor_copy(&to, x);
    }
    *x = y;
}

static dar_dit_clip clip_of(const dar_sampler *s)
{
    return (dar_dit_clip){ .clips = 1, .frames = s->clip.frames, .height = s->clip.height, .width = s->clip.width };
}

dar_status dar_sampler_init(dar_sampler *s, const dar_dit *m, const dar_sampler_config *c, const dar_sampler_clip *clip,
                            dar_arena *kept, dar_arena *step, dar_err *e)
{
    *s = (dar_sampler){ .m = m, .c = *c, .clip = *clip };
    dar_status status = dar_tape_init(&s->kept, kept, e);
    if (status == DAR_OK) status = dar_tape_init(&s->step, step, e);
    if (status != DAR_OK) {
        dar_sampler_free(s);
        return status;
    }
    s->kept.recording = s->step.recording = false;
    s->twice = !skips(s, DAR_SKIP_PASS) || (c->guidance != 1 && !same_text(&clip->text[0], &clip->text[1]));

    dar_dit_clip d = clip_of(s);
    d.cond = clip->cond;
    if (skips(s, DAR_SKIP_SCENE)) dar_dit_scene_prepare(&s->kept, m, &d, &s->scene);
    for (int i = 0; i <= s->twice; i++) {
        write_text(s, &s->clip.text[i]);
        if (skips(s, DAR_SKIP_TEXT)) dar_dit_text_prepare(&s->kept, m, &s->clip.text[i], NULL, &s->text[i]);
    }
    return DAR_OK;
}

void dar_sampler_free(dar_sampler *s)
{
    dar_tape_free(&s->kept);
    dar_tape_free(&s->step);
    *s = (dar_sampler){ 0 };
}

double dar_sampler_flops(const dar_sampler *s)
{
    return s->kept.cost.forward + s->step.cost.forward;
}

/* ---------------------------------------------------------------- a call */

/* A run: the clip with what is known of its video. */
struct run {
    dar_dit_clip clip;
    dar_dit_scene scene;
    double *times; /* [frames] as told to the network, in rows */
    int64_t rows;
};

/* The adapter's share was prepared with the clip; the known video's is added as dar_dit_scene_prepare adds it. */
static void prepare_run(dar_sampler *s, struct run *r, const dar_tensor *known)
{
    dar_dit_scene video;
    r->scene = s->scene;
    if (!skips(s, DAR_SKIP_SCENE)) {
        r->clip.cond = s->clip.cond;
    } else if (known) {
        dar_dit_scene_prepare(&s->kept, s->m, &r->clip, &video);
        r->scene.base = s->scene.base ? dar_add(&s->kept, s->scene.base, video.base) : video.base;
    }
}

static void write_times(const dar_sampler *s, struct run *r, bool hold, double time)
{
    r->rows = skips(s, DAR_SKIP_TIMES) ? 1 + hold : s->clip.frames;
    if (plans(s)) return;
    for (int64_t i = 0; i < r->rows; i++) r->times[i] = hold && i == 0 ? 0 : time;
}

static void call(dar_sampler *s, const struct run *r, int prompt, const dar_tensor *z, const dar_tensor *v)
{
    dar_tape *t = &s->step;
    dar_tape_place begin = dar_tape_mark(t);
    dar_dit_scene scene = r->scene;
    dar_dit_text text = s->text[prompt];
    if (!skips(s, DAR_SKIP_SCENE)) dar_dit_scene_prepare(t, s->m, &r->clip, &scene);
    if (!skips(s, DAR_SKIP_TEXT)) dar_dit_text_prepare(t, s->m, &s->clip.text[prompt], NULL, &text);
    dar_val *y = dar_dit_forward(t, s->m, &scene, &text, dar_leaf(t, *z, NULL), &(dar_dit_time){ r->times, r->rows });
    if (!plans(s)) dar_tensor_copy(v, &y->x);
    dar_tape_reset(t, begin);
    s->calls++;
}

/* ---------------------------------------------------------------- a run */

static dar_status check_finite(const dar_solver *solver, const dar_tensor *v, dar_err *e)
{
    int64_t i = dar_tensor_nonfinite(v);
    if (i < 0) return DAR_OK;
    return dar_fail(e, DAR_ERR_NUMERIC, "step %zu of %zu, sigma %g: element %lld of the velocity is not finite",
                    solver->step + 1, solver->steps, solver->sigma[solver->step], (long long)i);
}

static dar_status run_steps(dar_sampler *s, struct run *r, const dar_tensor *first, const dar_tensor *z,
                            dar_sampler_told *told, void *ctx, dar_err *e)
{
    const double g = s->c.guidance, weight[] = { g, 1 - g };
    dar_solver solver;
    dar_tensor v = dar_tensor_push(s->kept.arena, z->dtype, z->shape), u = v;
    if (s->twice) u = dar_tensor_push(s->kept.arena, z->dtype, z->shape);
    dar_solver_init(&solver, &s->c.solver, z, s->kept.arena);
    if (first && !plans(s)) dar_dit_hold_first(z, first);
    for (size_t i = 0; i < solver.steps; i++) {
        write_times(s, r, first != NULL, plans(s) ? 0 : solver.time[i]);
        call(s, r, 0, z, &v);
        if (s->twice) call(s, r, 1, z, &u);
        if (plans(s)) continue;
        if (s->twice) dar_flow_combine(2, weight, (const dar_tensor *const[]){ &v, &u }, &v);
        DAR_TRY(check_finite(&solver, &v, e));
        dar_solver_step(&solver, &v, z);
        if (first) dar_dit_hold_first(z, first);
        if (told) DAR_TRY(told(ctx, solver.step, z, e));
    }
    return DAR_OK;
}

dar_status dar_sampler_run(dar_sampler *s, const dar_tensor *known, const dar_tensor *first, const dar_tensor *z,
                           dar_sampler_told *told, void *ctx, dar_err *e)
{
    dar_shape latent = DAR_SHAPE(1, s->m->c.latent, s->clip.frames, s->clip.height, s->clip.width);
    DAR_ASSERT(dar_shape_equal(&z->shape, &latent) && z->dtype == s->m->main, "sampler: the noise is not of the clip");
    dar_tape_place begin = dar_tape_mark(&s->kept);
    struct run r = { .clip = clip_of(s) };
    if (known) r.clip.known = *known;
    r.times = dar_arena_push(s->kept.arena, (size_t)s->clip.frames * sizeof *r.times);
    prepare_run(s, &r, known);
    dar_status status = run_steps(s, &r, first, z, told, ctx, e);
    dar_tape_reset(&s->kept, begin);
    return status;
}

void dar_sampler_noise(dar_noise kind, uint64_t seed, const dar_tensor *z, dar_arena *scratch)
{
    dar_rng_torch g;
    dar_mark m = dar_arena_mark(scratch);
    if (kind == DAR_NOISE_OWN) {
        if (!scratch->plan) dar_rng_fill_normal(z, seed, dar_rng_stream("noise"), 1);
        return;
    }
    dar_tensor x = dar_tensor_push(scratch, DAR_F32, z->shape);
    if (!scratch->plan) {
        dar_rng_torch_seed(&g, seed);
        dar_rng_torch_normal(&g, &x);
        dar_tensor_copy(z, &x);
    }
    dar_arena_reset(scratch, m);
}
