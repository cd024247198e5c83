/* speed_train.c: a training step with random weights and clips: seconds by stage, rate against the machine's peak,
 * memory as planned and as taken. */
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>

#include "lib/log.h"
#include "lib/program.h"
#include "lib/rng.h"
#include "lib/thread.h"
#include "models/lora.h"
#include "tests/bench.h"
#include "train/optim.h"
#include "train/step.h"

static int64_t rank, batch, frames, size[2], rounds;
static int precision, recompute;
static const char *preset;
static dar_common common;

static const char *const recompute_names[] = { "none", "cheap", "wide", "selective", "full", NULL };

static const char *const precision_names[] = { "f64", "f32", "bf16", NULL }; /* dar_dtype */

/* clang-format off */
static const dar_option options[] = {
    { .name = "model", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &preset,
      .standard = "models/presets/dar-tiny.json", .help = "sizes" },
    { .name = "precision", .placeholder = "TYPE", .type = DAR_ARG_CHOICE, .target = &precision, .standard = "bf16",
      .names = precision_names, .help = "f64, f32 or bf16" },
    { .name = "recompute", .placeholder = "WAY", .type = DAR_ARG_CHOICE, .target = &recompute, .standard = "none",
      .names = recompute_names, .help = "none, cheap, wide, selective or full" },
    { .name = "rank", .placeholder = "R", .type = DAR_ARG_INT, .target = &rank, .standard = "32", .lo = 0, .hi = 4096,
      .help = "of additions; 0: all weights are trained" },
    { .name = "batch", .placeholder = "B", .type = DAR_ARG_INT, .target = &batch, .standard = "4", .lo = 1, .hi = 256,
      .help = "clips" },
    { .name = "frames", .placeholder = "T", .type = DAR_ARG_INT, .target = &frames, .standard = "17", .lo = 5,
      .hi = 4097, .help = "of a clip, 4 n + 1" },
    { .name = "size", .placeholder = "WxH", .type = DAR_ARG_SIZE, .target = size, .standard = "224x128", .lo = 8,
      .hi = 8192, .help = "of a clip" },
    { .name = "rounds", .placeholder = "N", .type = DAR_ARG_INT, .target = &rounds, .standard = "9", .lo = 1,
      .hi = 1000, .help = "steps after the first, of which the median is told" },
};
/* clang-format on */

/* ---------------------------------------------------------------- a network, planned or real */

enum { WEIGHTS, MOMENTS, CLIPS, ARENAS };

struct trainer {
    dar_arena arena[ARENAS];
    dar_train_config c;
    dar_params p;
    dar_dit m;
    dar_optim optim;
    dar_batch b;
    dar_step step;
    dar_step_plan plan[DAR_RECOMPUTE_ALL + 1];
    dar_step_size size;
};

static dar_tensor clip_tensor(struct trainer *t, dar_shape s)
{
    dar_tensor x = dar_tensor_push(&t->arena[CLIPS], DAR_F32, s);
    if (!t->arena[CLIPS].plan) dar_rng_fill_uniform(&x, 1, 1, -1, 1);
    return x;
}

static void make_clips(struct trainer *t, const dar_config *c)
{
    const dar_dit_config *d = &c->dit;
    int64_t F = (frames - 1) / 4 + 1, side = 2 * c->adapter.unshuffle, channels = c->adapter.rays + c->adapter.geometry;
    int64_t h = size[1] / side * d->patch, w = size[0] / side * d->patch;
    t->size = (dar_step_size){ batch, F, h, w, .cond = channels, .pixels = side / d->patch };
    t->b.z0 = clip_tensor(t, DAR_SHAPE(batch, d->latent, F, h, w));
    t->b.known = clip_tensor(t, DAR_SHAPE(batch, d->mask + d->latent, F, h, w));
    t->b.cond = clip_tensor(t, DAR_SHAPE(batch, channels, F, h / d->patch * side, w / d->patch * side));
}

/* bytes NULL: only plan. */
static dar_status make(struct trainer *t, const dar_config *c, const size_t *bytes, dar_err *e)
{
    static const char *const names[] = { "weights", "moments", "clips" };
    const dar_optim_config how = { .rate = 1e-4, .beta1 = 0.9, .beta2 = 0.999, .eps = 1e-8, .max_norm = 1 };
    memset(t, 0, sizeof *t);
    for (int i = 0; i < ARENAS; i++)
        DAR_TRY(bytes ? dar_arena_init(&t->arena[i], names[i], bytes[i], e)
                      : dar_arena_init_plan(&t->arena[i], names[i], e));
    t->c = (dar_train_config){ .storage = precision, .batch = batch, .accumulate = 1, .shift = 3 };
    dar_params_init(&t->p, &t->arena[WEIGHTS], (dar_dtype)precision);
    dar_dit_init(&t->m, &t->p, &c->dit, &c->adapter);
    dar_lora_init(&t->m, &t->p, &c->lora);
    dar_params_train(&t->p, DAR_PARAM_ADAPTER | (rank ? DAR_PARAM_LORA : DAR_PARAM_BASE));
    dar_params_fresh(&t->p, DAR_PARAM_ALL, 1);
    dar_params_gradients(&t->p);
    dar_optim_init(&t->optim, &how, &t->p, &t->arena[MOMENTS]);
    make_clips(t, c);
    return dar_step_count(t->plan, &t->c, &t->m, &t->size, e);
}

static void drop(struct trainer *t)
{
    dar_step_free(&t->step);
    dar_dit_free(&t->m);
    dar_params_free(&t->p);
    for (int i = 0; i < ARENAS; i++) dar_arena_free(&t->arena[i]);
}

/* ---------------------------------------------------------------- what is measured */

enum { DRAW, FORWARD, BACKWARD, OPTIMISER, ALL, STAGES };
static const char *const stage_names[] = { "draw", "forward", "backward", "optimiser", "step" };

static int by_size(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static double median(double *x, size_t n)
{
    qsort(x, n, sizeof *x, by_size);
    return x[n / 2];
}

static double peak(void)
{
    double sample[15];
    for (size_t i = 0; i < DAR_COUNT(sample); i++)
        sample[i] = bench_peak_sample(precision == DAR_BF16 ? BENCH_BF16 : BENCH_F32);
    return median(sample, DAR_COUNT(sample)) * 1e9;
}

static double taken(void)
{
    struct rusage u;
    getrusage(RUSAGE_SELF, &u);
    return 1024.0 * (double)u.ru_maxrss;
}

static void run_steps(struct trainer *t, double *second[STAGES])
{
    for (int64_t k = 0; k <= rounds; k++) {
        double begun = dar_log_clock();
        dar_step_report r = dar_step_run(&t->step, &t->b, k, 0);
        double between = dar_log_clock();
        dar_optim_step(&t->optim);
        double ended = dar_log_clock();
        if (!k) continue; /* touches memory for the first time */
        const double of[STAGES] = { r.draw, r.forward, r.backward, ended - between, ended - begun };
        for (int i = 0; i < STAGES; i++) second[i][k - 1] = of[i];
    }
}

static void tell(dar_run *r, struct trainer *t, double *second[STAGES], double planned, double took)
{
    const dar_step_plan *plan = &t->plan[t->step.how];
    double flops = plan->forward + plan->backward, most = peak(), all = median(second[ALL], (size_t)rounds);
    dar_json_write_number(&r->json, "seconds", all);
    dar_json_write_number(&r->json, "fraction_of_peak", flops / all / most);
    dar_json_write_number(&r->json, "planned_bytes", planned);
    dar_json_write_number(&r->json, "taken_bytes", took);
    for (int i = 0; i < STAGES; i++) {
        double s = median(second[i], (size_t)rounds);
        dar_run_say(r, "%-10s %8.4f s  %3.0f %%", stage_names[i], s, 100 * s / all);
    }
    dar_run_say(r, "%.3f TFLOP, %.1f GF/s, %.2f of the peak; memory: planned %.3f GB, taken %.3f GB", flops * 1e-12,
                flops / all * 1e-9, flops / all / most, planned * 1e-9, took * 1e-9);
}

static dar_status measure(dar_run *r, dar_err *e)
{
    struct trainer t;
    dar_config c;
    size_t bytes[ARENAS];
    double planned = 0, *second[STAGES] = { 0 };
    dar_recompute how = (dar_recompute)(recompute + DAR_RECOMPUTE_NONE);

    DAR_TRY(dar_config_open(&c, preset, e));
    c.adapter.geometry = 9;
    c.lora = (dar_lora_config){ .rank = rank, .alpha = (double)rank, .targets = DAR_PROJECTIONS_ALL };
    DAR_TRY(make(&t, &c, NULL, e));
    for (int i = 0; i < ARENAS; i++) planned += (double)(bytes[i] = t.arena[i].peak);
    planned += (double)(t.plan[how].bytes[0] + t.plan[how].bytes[1]);
    drop(&t);

    double before = taken();
    dar_status s = make(&t, &c, bytes, e);
    if (s == DAR_OK) s = dar_step_init(&t.step, &t.c, &t.m, how, &t.plan[how], e);
    for (int i = 0; i < STAGES && s == DAR_OK; i++)
        if (!(second[i] = calloc((size_t)rounds, sizeof **second))) s = dar_fail(e, DAR_ERR_NOMEM, "out of memory");
    if (s == DAR_OK) {
        run_steps(&t, second);
        tell(r, &t, second, planned, taken() - before);
    }
    for (int i = 0; i < STAGES; i++) free(second[i]);
    drop(&t);
    return s;
}

int main(int argc, char **argv)
{
    static const dar_program program = {
        .name = "speed_train",
        .summary = "Measure a training step.",
        .options = options,
        .n_options = DAR_COUNT(options),
        .common = &common,
        .run = measure,
    };
    return dar_program_main(&program, argc, argv);
}
