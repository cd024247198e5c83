/* sampler.c: see sampler.h. */
#include "models/sampler.h"

#include <string.h>

#include "lib/rng.h"
#include "lib/rng_torch.h"

const char *const dar_skip_name[] = { "pass",  "scene", "text", "times",  "padding",
                                      "begin", "held",  "lora", "repeat", NULL };

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

/* ---------------------------------------------------------------- prompts */

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

/* ---------------------------------------------------------------- windows */

static int64_t window_frames(const dar_sampler_clip *c)
{
    return c->window && c->window < c->frames ? c->window : c->frames;
}

int64_t dar_sampler_windows(const dar_sampler_clip *c)
{
    int64_t n = window_frames(c), step = n - 1 - c->overlap;
    if (n == c->frames) return 1;
    DAR_ASSERT(c->overlap >= 0 && step > 0, "sampler: windows of %lld frames overlap by %lld", (long long)n,
               (long long)c->overlap);
    return 1 + (c->frames - n + step - 1) / step;
}

int64_t dar_sampler_window_first(const dar_sampler_clip *c, int64_t i)
{
    int64_t gaps = dar_sampler_windows(c) - 1;
    return 1 + (gaps ? (i * (c->frames - window_frames(c)) + gaps / 2) / gaps : 0);
}

/* How much of frame f window i stands for: 1 where it is alone.  Where it meets a neighbour, in equal steps from one to
 * the other; f = 0 is that of the first. */
static double window_share(const dar_sampler_clip *c, int64_t i, int64_t f)
{
    int64_t n = window_frames(c) - 1, first = dar_sampler_window_first(c, i);
    if (f == 0) return i == 0;
    if (i > 0) {
        int64_t both = dar_sampler_window_first(c, i - 1) + n - first;
        if (f - first < both) return (double)(f - first + 1) / (double)(both + 1);
    }
    if (first + n < c->frames) {
        int64_t next = dar_sampler_window_first(c, i + 1), both = first + n - next;
        if (f >= next) return 1 - (double)(f - next + 1) / (double)(both + 1);
    }
    return 1;
}

/* The frames of window i, of a tensor [1, C, F, ..], in memory of `a`; the tensor itself if there is one window. */
static dar_tensor gather(const dar_sampler *s, int64_t i, const dar_tensor *x, dar_arena *a)
{
    if (s->windows == 1 || !x->data) return *x;
    dar_shape shape = x->shape;
    int64_t n = shape.d[2] = window_frames(&s->clip);
    dar_tensor y = dar_tensor_push(a, x->dtype, shape);
    for (int k = 0; k < 2 && !a->plan; k++) {
        dar_tensor to = dar_tensor_narrow(&y, 2, k, k ? n - 1 : 1);
        dar_tensor from = dar_tensor_narrow(x, 2, k ? dar_sampler_window_first(&s->clip, i) : 0, k ? n - 1 : 1);
        dar_tensor_copy(&to, &from);
    }
    return y;
}

/* v += share of window i times u, frame by frame. */
static void scatter(const dar_sampler *s, int64_t i, const dar_tensor *u, const dar_tensor *v)
{
    size_t pixels = (size_t)(u->shape.d[3] * u->shape.d[4]);
    int64_t C = u->shape.d[1], n = u->shape.d[2], F = v->shape.d[2], first = dar_sampler_window_first(&s->clip, i);
    for (int64_t j = 0; j < n; j++) {
        int64_t f = j ? first + j - 1 : 0;
        double share = window_share(&s->clip, i, f);
        for (int64_t c = 0; c < C; c++)
            for (size_t p = 0, from = (size_t)(c * n + j) * pixels, to = (size_t)(c * F + f) * pixels; p < pixels;
                 p++) {
                double x = dar_dtype_get(u->dtype, u->data, from + p), y = dar_dtype_get(v->dtype, v->data, to + p);
                dar_dtype_set(v->dtype, v->data, to + p, y + share * x);
            }
    }
}

/* ---------------------------------------------------------------- what is constant over a clip */

static dar_dit_clip clip_of(const dar_sampler *s)
{
    return (dar_dit_clip){
        .clips = 1, .frames = window_frames(&s->clip), .height = s->clip.height, .width = s->clip.width
    };
}

/* The condition of window i is gathered for the moment. */
static void prepare_scene(dar_sampler *s, dar_tape *t, dar_dit_clip d, int64_t i, dar_dit_scene *scene)
{
    dar_mark m = dar_arena_mark(s->step.arena);
    d.cond = gather(s, i, &s->clip.cond, s->step.arena);
    dar_dit_scene_prepare(t, s->m, &d, scene);
    if (t != &s->step) dar_arena_reset(s->step.arena, m);
}

dar_status dar_sampler_init(dar_sampler *s, const dar_dit *m, const dar_sampler_config *c, const dar_sampler_clip *clip,
                            dar_arena *kept, dar_arena *step, dar_err *e)
{
    DAR_ASSERT(!c->reuse.rule || (c->solver.tolerance <= 0 && c->guidance_tolerance <= 0),
               "sampler: steps are held by a rule, and others left out by a tolerance");
    *s = (dar_sampler){ .m = m, .c = *c, .clip = *clip, .windows = dar_sampler_windows(clip) };
    dar_status status = dar_tape_init(&s->kept, kept, e);
    if (status == DAR_OK) status = dar_tape_init(&s->step, step, e);
    if (status != DAR_OK) {
        dar_sampler_free(s);
        return status;
    }
    s->kept.recording = s->step.recording = false;
    s->twice = !skips(s, DAR_SKIP_PASS) || (c->guidance != 1 && !same_text(&clip->text[0], &clip->text[1]));

    s->scene = dar_tape_room(&s->kept, (size_t)s->windows * sizeof *s->scene);
    for (int64_t i = 0; i < s->windows && skips(s, DAR_SKIP_SCENE); i++)
        prepare_scene(s, &s->kept, clip_of(s), i, &s->scene[i]);
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

/* A window of a run: with what is known of its video. */
struct view {
    dar_dit_clip clip;
    dar_dit_scene scene;

    /* To be used again (models/reuse.h). */
    dar_tensor read;     /* [1, L, D] by the first block in the step before */
    dar_tensor added[2]; /* [1, L', D] by the blocks, with both prompts, to the tokens that come out of them */
};

struct run {
    struct view *view; /* [windows] */
    double *times;     /* [frames of a window] as told to the network, in rows */
    int64_t rows;
    bool hold; /* the first frame is known */
    bool both; /* prompts are asked */
    bool asks; /* the blocks are run */
    dar_reuse reuse;
    dar_tensor z, v[2];         /* of a window: latent, velocities with both prompts */
    dar_tensor whole[2], clean; /* of the clip: velocities, where the step saw it go */
};

/* The adapter's share was prepared with the clip; the known video's is added as dar_dit_scene_prepare adds it. */
static void prepare_view(dar_sampler *s, struct view *w, int64_t i, const dar_tensor *known, bool hold)
{
    dar_dit_scene video;
    *w = (struct view){ .clip = clip_of(s) };
    if (known) w->clip.known = gather(s, i, known, s->kept.arena);
    if (skips(s, DAR_SKIP_SCENE)) w->scene = s->scene[i];
    if (skips(s, DAR_SKIP_SCENE) && known) {
        dar_dit_scene_prepare(&s->kept, s->m, &w->clip, &video);
        w->scene.base = w->scene.base ? dar_add(&s->kept, w->scene.base, video.base) : video.base;
    }
    w->scene.held = hold && skips(s, DAR_SKIP_HELD);
}

static void prepare_reuse(dar_sampler *s, struct view *w)
{
    const int64_t p = s->m->c.patch, frame = s->clip.height / p * (s->clip.width / p), D = s->m->c.width;
    const int64_t F = window_frames(&s->clip);
    if (s->c.reuse.rule == DAR_REUSE_CHANGE)
        w->read = dar_tensor_push(s->kept.arena, s->m->main, DAR_SHAPE(1, F * frame, D));
    for (int i = 0; i <= s->twice && s->c.reuse.rule; i++)
        w->added[i] = dar_tensor_push(s->kept.arena, s->m->main, DAR_SHAPE(1, (F - w->scene.held) * frame, D));
}

static void write_times(const dar_sampler *s, struct run *r, double time)
{
    r->rows = skips(s, DAR_SKIP_TIMES) ? 1 + r->hold : window_frames(&s->clip);
    if (plans(s)) return;
    for (int64_t i = 0; i < r->rows; i++) r->times[i] = r->hold && i == 0 ? 0 : time;
}

/* What comes before a prompt: on the tape of the step. */
struct begun {
    const struct view *view;
    dar_dit_scene scene;
    dar_dit_time time;
    dar_dit_moment e;
    dar_val *z, *tokens;
};

static void begin(dar_sampler *s, const struct run *r, int64_t i, struct begun *b)
{
    const struct view *w = &r->view[i];
    dar_tape *t = &s->step;
    b->view = w;
    b->scene = w->scene;
    if (!skips(s, DAR_SKIP_SCENE)) {
        prepare_scene(s, t, w->clip, i, &b->scene);
        b->scene.held = w->scene.held;
    }
    b->time = (dar_dit_time){ r->times, r->rows };
    b->z = dar_leaf(t, r->z, NULL);
    b->e = dar_dit_time_embed(t, s->m, 1, &b->time);
    b->tokens = dar_dit_embed(t, s->m, &b->scene, b->z);
    if (r->asks) dar_dit_blocks_begin(t, s->m, &b->scene, &b->e, b->tokens);
}

/* Without those that do not come out of the blocks. */
static dar_val *outgoing(dar_tape *t, const struct begun *b, dar_val *tokens)
{
    const int64_t first = b->scene.held ? b->scene.frame : 0;
    return dar_slice(t, tokens, 1, first, tokens->x.shape.d[1] - first);
}

/* Tokens behind the blocks, run with a prompt; the tokens before them are embedded once more, to be subtracted. */
static dar_val *run_blocks(dar_sampler *s, const struct begun *b, int prompt, dar_val *tokens)
{
    dar_tape *t = &s->step;
    const dar_tensor *added = &b->view->added[prompt];
    dar_dit_text text = s->text[prompt];
    if (!skips(s, DAR_SKIP_TEXT)) dar_dit_text_prepare(t, s->m, &s->clip.text[prompt], NULL, &text);
    dar_val *y = dar_dit_blocks_end(t, s->m, &b->scene, &text, &b->e, tokens);
    s->calls++;
    if (!s->c.reuse.rule) return y;
    dar_val *r = dar_sub(t, y, outgoing(t, b, dar_dit_embed(t, s->m, &b->scene, b->z)));
    if (!plans(s)) dar_tensor_copy(added, &r->x);
    return y;
}

/* v: the velocity with a prompt; of a first frame that is held 0.  `keep`: what was begun is needed again. */
static void finish(dar_sampler *s, const struct run *r, const struct begun *b, int prompt, bool keep,
                   const dar_tensor *v)
{
    dar_tape *t = &s->step;
    dar_tape_place place = dar_tape_mark(t);
    dar_val *x = b->tokens;
    if (!r->asks) x = dar_add(t, outgoing(t, b, x), dar_leaf(t, b->view->added[prompt], NULL));
    else x = run_blocks(s, b, prompt, keep ? dar_contiguous(t, x) : x);
    dar_val *y = dar_dit_head(t, s->m, &b->scene, &b->e, x);
    y = dar_dit_velocity(t, s->m, &b->scene, y, b->z, &b->time);
    if (!plans(s)) {
        int64_t n = y->x.shape.d[2], held = v->shape.d[2] - n;
        dar_tensor first = dar_tensor_narrow(v, 2, 0, 1), to = dar_tensor_narrow(v, 2, held, n);
        if (held) dar_tensor_fill(&first, 0);
        dar_tensor_copy(&to, &y->x);
    }
    dar_tape_reset(t, place);
}

/* The velocities of window i. */
static void call(dar_sampler *s, const struct run *r, int64_t i)
{
    dar_tape_place place = dar_tape_mark(&s->step);
    struct begun b;
    for (int prompt = 0; prompt <= r->both; prompt++) {
        bool share = r->both && skips(s, DAR_SKIP_BEGIN);
        if (prompt == 0 || !share) begin(s, r, i, &b);
        finish(s, r, &b, prompt, share && prompt == 0, &r->v[prompt]);
        if (!share) dar_tape_reset(&s->step, place);
    }
    dar_tape_reset(&s->step, place);
}

/* The velocities of the clip: r->whole. */
static void call_all(dar_sampler *s, struct run *r, const dar_tensor *z)
{
    for (int p = 0; p <= r->both && !plans(s) && s->windows > 1; p++) dar_tensor_fill(&r->whole[p], 0);
    for (int64_t i = 0; i < s->windows; i++) {
        dar_mark m = dar_arena_mark(s->kept.arena);
        r->z = gather(s, i, z, s->kept.arena);
        call(s, r, i);
        for (int p = 0; p <= r->both && !plans(s) && s->windows > 1; p++) scatter(s, i, &r->v[p], &r->whole[p]);
        dar_arena_reset(s->kept.arena, m);
    }
}

/* Whether the blocks are run in the step that is next; all windows decide as one. */
static bool asks(dar_sampler *s, struct run *r, const dar_tensor *z)
{
    r->asks = false;
    for (int64_t i = 0; i < s->windows && s->c.reuse.rule == DAR_REUSE_CHANGE; i++) {
        dar_mark m = dar_arena_mark(s->kept.arena);
        dar_tape_place place = dar_tape_mark(&s->step);
        struct begun b;
        r->z = gather(s, i, z, s->kept.arena);
        begin(s, r, i, &b);
        dar_val *read = dar_dit_blocks_read(&s->step, s->m, &b.scene, &b.e, b.tokens);
        if (!plans(s)) dar_reuse_see(&r->reuse, &read->x, &r->view[i].read);
        dar_tape_reset(&s->step, place);
        dar_arena_reset(s->kept.arena, m);
    }
    return dar_reuse_asks(&r->reuse);
}

/* ---------------------------------------------------------------- a run */

static dar_status check_finite(const dar_solver *solver, const dar_tensor *v, dar_err *e)
{
    int64_t i = dar_tensor_nonfinite(v);
    if (i < 0) return DAR_OK;
    return dar_fail(e, DAR_ERR_NUMERIC, "step %zu of %zu, sigma %g: element %lld of the velocity is not finite",
                    solver->step + 1, solver->steps, solver->sigma[solver->step], (long long)i);
}

/* Steps of one point add to the estimate too, but Euler's. */
static dar_status check_budget(const dar_solver *s, dar_err *e)
{
    if (!(s->budget > 0) || s->estimate <= s->budget * (1 + 1e-9)) return DAR_OK;
    return dar_fail(e, DAR_ERR_CHECK, "step %zu of %zu: the estimated error is %.3g, expected at most %.3g", s->step,
                    s->steps, s->estimate, s->budget);
}

/* Of a first frame that is held nothing changes. */
static void hold_still(const dar_tensor *v)
{
    dar_tensor first = dar_tensor_narrow(v, 2, 0, 1);
    dar_tensor_fill(&first, 0);
}

static dar_status run_steps(dar_sampler *s, struct run *r, const dar_tensor *first, const dar_tensor *z,
                            dar_sampler_told *told, void *ctx, dar_err *e)
{
    const dar_tensor *v = &r->whole[0], *u = &r->whole[1];
    dar_solver solver;
    dar_guidance guidance;
    dar_solver_init(&solver, &s->c.solver, z, s->kept.arena);
    dar_guidance_init(&guidance, s->c.guidance, s->twice ? s->c.guidance_tolerance : 0, z, s->kept.arena);
    dar_reuse_init(&r->reuse, &s->c.reuse, solver.steps);
    r->both = s->twice;
    if (first && !plans(s)) dar_dit_hold_first(z, first);
    for (size_t i = 0; i < solver.steps && plans(s); i++) {
        write_times(s, r, 0);
        r->asks = asks(s, r, z);
        call_all(s, r, z);
    }
    while (solver.step < solver.steps && !plans(s)) {
        const double sigma = solver.sigma[solver.step], to_clean[] = { 1, -sigma };
        r->both = s->twice && dar_guidance_asks(&guidance, sigma);
        write_times(s, r, solver.time[solver.step]);
        r->asks = asks(s, r, z);
        call_all(s, r, z);
        if (s->twice) dar_guidance_apply(&guidance, sigma, r->both ? u : NULL, v);
        DAR_TRY(check_finite(&solver, v, e));
        if (first) hold_still(v);
        if (told) dar_flow_combine(2, to_clean, (const dar_tensor *const[]){ z, v }, &r->clean);
        if (told && first) dar_dit_hold_first(&r->clean, first);
        dar_solver_step(&solver, v, z);
        DAR_TRY(check_budget(&solver, e));
        if (first) dar_dit_hold_first(z, first);
        if (told) DAR_TRY(told(ctx, solver.step, z, &r->clean, e));
    }
    s->steps = solver.calls, s->rejected = solver.rejected, s->estimate = solver.estimate;
    s->left_out = guidance.left_out, s->worst = guidance.worst;
    s->reused = r->reuse.held;
    return DAR_OK;
}

/* Memory of a run, like the latent or like a window of it. */
static void prepare_run(dar_sampler *s, struct run *r, const dar_tensor *known, const dar_tensor *z)
{
    dar_arena *a = s->kept.arena;
    dar_shape window = z->shape;
    window.d[2] = window_frames(&s->clip);
    r->times = dar_arena_push(a, (size_t)s->clip.frames * sizeof *r->times);
    r->view = dar_tape_room(&s->kept, (size_t)s->windows * sizeof *r->view);
    for (int64_t i = 0; i < s->windows; i++) {
        prepare_view(s, &r->view[i], i, known, r->hold);
        prepare_reuse(s, &r->view[i]);
    }
    for (int p = 0; p <= s->twice; p++) {
        r->v[p] = dar_tensor_push(a, z->dtype, window);
        r->whole[p] = s->windows > 1 ? dar_tensor_push(a, z->dtype, z->shape) : r->v[p];
    }
    r->clean = dar_tensor_push(a, z->dtype, z->shape);
}

dar_status dar_sampler_run(dar_sampler *s, const dar_tensor *known, const dar_tensor *first, const dar_tensor *z,
                           dar_sampler_told *told, void *ctx, dar_err *e)
{
    dar_shape latent = DAR_SHAPE(1, s->m->c.latent, s->clip.frames, s->clip.height, s->clip.width);
    DAR_ASSERT(dar_shape_equal(&z->shape, &latent) && z->dtype == s->m->main, "sampler: the noise is not of the clip");
    dar_tape_place begin_of_run = dar_tape_mark(&s->kept);
    struct run r = { .hold = first != NULL };
    prepare_run(s, &r, known, z);
    dar_status status = run_steps(s, &r, first, z, told, ctx, e);
    dar_tape_reset(&s->kept, begin_of_run);
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
