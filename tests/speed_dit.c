/* speed_dit.c: the public model with random bf16 weights of its real shapes: one evaluation, or with --rank a training
 * step, at the size and depth asked for: seconds, rate against the machine's peak, memory as planned and as taken. */
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <time.h>

#include "lib/program.h"
#include "lib/rng.h"
#include "lib/thread.h"
#include "models/dit.h"
#include "models/lora.h"
#include "tests/bench.h"

static int64_t layers, frames, size[2], rank, words;
static const char *preset;
static bool eight;
static dar_common common;

static const dar_option options[] = {
    { .name = "model",
      .placeholder = "FILE",
      .type = DAR_ARG_TEXT,
      .target = &preset,
      .standard = "models/presets/wan22-fun-5b.json",
      .help = "sizes" },
    { .name = "layers",
      .placeholder = "N",
      .type = DAR_ARG_INT,
      .target = &layers,
      .standard = "0",
      .lo = 0,
      .hi = 4096,
      .help = "blocks; 0: all" },
    { .name = "frames",
      .placeholder = "T",
      .type = DAR_ARG_INT,
      .target = &frames,
      .standard = "49",
      .lo = 1,
      .hi = 4097,
      .help = "of the video, 4 n + 1" },
    { .name = "size",
      .placeholder = "WxH",
      .type = DAR_ARG_SIZE,
      .target = size,
      .standard = "832x480",
      .lo = 32,
      .hi = 8192,
      .help = "of the video" },
    { .name = "words",
      .placeholder = "N",
      .type = DAR_ARG_INT,
      .target = &words,
      .standard = "30",
      .lo = 0,
      .hi = 512,
      .help = "text tokens" },
    { .name = "rank",
      .placeholder = "R",
      .type = DAR_ARG_INT,
      .target = &rank,
      .standard = "0",
      .lo = 0,
      .hi = 4096,
      .help = "a training step of LoRA of this rank; 0: an evaluation" },
    { .name = "eight", .type = DAR_ARG_FLAG, .target = &eight, .help = "products of blocks in 8 bits by 8 bits" },
};

/* ---------------------------------------------------------------- a network, planned or real */

enum { WEIGHTS, CLIP, SCENE, STEP, KEEP, ARENAS };
static const char *const arena_names[] = { "weights", "clip", "scene", "step", "keep" };

struct network {
    dar_arena arena[ARENAS];
    dar_params p;
    dar_dit m;
    dar_tape scene_tape, tape;
    dar_dit_clip clip;
    dar_tensor z, text;
    dar_dit_scene scene;
    dar_dit_text words;
};

static dar_tensor clip_tensor(struct network *n, dar_dtype type, dar_shape s)
{
    dar_tensor x = dar_tensor_push(&n->arena[CLIP], type, s);
    if (!n->arena[CLIP].plan) dar_rng_fill_uniform(&x, 1, 1, -1, 1);
    return x;
}

static void make_clip(struct network *n, const dar_config *c)
{
    const dar_dit_config *d = &c->dit;
    int64_t F = (frames - 1) / 4 + 1, side = 2 * c->adapter.unshuffle;
    int64_t h = size[1] / side * d->patch, w = size[0] / side * d->patch;
    n->clip = (dar_dit_clip){ .clips = 1, .frames = F, .height = h, .width = w };
    int64_t channels = c->adapter.rays + c->adapter.geometry;
    n->clip.cond = clip_tensor(n, DAR_F32, DAR_SHAPE(1, channels, F, size[1] / side * side, size[0] / side * side));
    n->clip.known = clip_tensor(n, DAR_F32, DAR_SHAPE(1, d->mask + d->latent, F, h, w));
    n->z = clip_tensor(n, DAR_F32, DAR_SHAPE(1, d->latent, F, h, w));
    n->text = clip_tensor(n, DAR_BF16, DAR_SHAPE(1, words, d->text_width));
}

/* bytes NULL: only plan. */
static dar_status make(struct network *n, const dar_config *c, const size_t *bytes, dar_err *e)
{
    memset(n, 0, sizeof *n);
    for (int i = 0; i < ARENAS; i++)
        DAR_TRY(bytes ? dar_arena_init(&n->arena[i], arena_names[i], bytes[i], e)
                      : dar_arena_init_plan(&n->arena[i], arena_names[i], e));
    DAR_TRY(dar_tape_init(&n->scene_tape, &n->arena[SCENE], e));
    DAR_TRY(dar_tape_init(&n->tape, &n->arena[STEP], e));
    n->scene_tape.recording = n->tape.recording = rank > 0;
    n->tape.keep = &n->arena[KEEP];
    dar_params_init(&n->p, &n->arena[WEIGHTS], DAR_BF16);
    dar_dit_init(&n->m, &n->p, &c->dit, &c->adapter);
    dar_lora_init(&n->m, &n->p, &c->lora);
    if (rank) dar_params_train(&n->p, DAR_PARAM_LORA | DAR_PARAM_ADAPTER);
    n->m.replay = DAR_REPLAY_PRODUCTS;
    dar_params_fresh(&n->p, DAR_PARAM_ALL, 1);
    dar_params_gradients(&n->p);
    if (eight) dar_lora_quantise(&n->m, &n->p, 0, c->dit.layers, &n->arena[STEP]);
    n->m.quantise = eight;
    make_clip(n, c);
    return DAR_OK;
}

static void drop(struct network *n)
{
    dar_dit_free(&n->m);
    dar_params_free(&n->p);
    dar_tape_free(&n->scene_tape);
    dar_tape_free(&n->tape);
    for (int i = 0; i < ARENAS; i++) dar_arena_free(&n->arena[i]);
}

/* ---------------------------------------------------------------- what is measured */

static void prepare(struct network *n, dar_tape *t)
{
    dar_dit_scene_prepare(t, &n->m, &n->clip, &n->scene);
    dar_dit_text_prepare(t, &n->m, &n->text, NULL, &n->words);
}

static dar_val *evaluate(struct network *n)
{
    static const double times[] = { 0, 750 };
    return dar_dit_forward(&n->tape, &n->m, &n->scene, &n->words, dar_leaf(&n->tape, n->z, NULL),
                           &(dar_dit_time){ times, 2 });
}

static void train(struct network *n)
{
    prepare(n, &n->tape);
    dar_val *loss = dar_squared_error(&n->tape, evaluate(n), dar_leaf(&n->tape, n->z, NULL), NULL, true);
    dar_backward(&n->tape, loss, NULL);
}

static double seconds(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static double flops(const dar_tape *t)
{
    return t->cost.forward + t->cost.backward;
}

static int by_size(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static double peak(void)
{
    double sample[15];
    for (size_t i = 0; i < DAR_COUNT(sample); i++) sample[i] = bench_peak_sample(BENCH_BF16);
    qsort(sample, DAR_COUNT(sample), sizeof *sample, by_size);
    return sample[DAR_COUNT(sample) / 2] * 1e9;
}

static double taken(void)
{
    struct rusage u;
    getrusage(RUSAGE_SELF, &u);
    return 1024.0 * (double)u.ru_maxrss;
}

static void say_rate(const dar_run *r, const char *what, double s, double work, double most)
{
    dar_run_say(r, "%-8s %8.2f s  %7.2f TFLOP  %6.1f GF/s, %.2f of the peak", what, s, work * 1e-12, work / s * 1e-9,
                work / s / most);
}

static dar_status measure(dar_run *r, dar_err *e)
{
    struct network n;
    dar_config c;
    size_t bytes[ARENAS];
    double planned = 0;

    DAR_TRY(dar_config_open(&c, preset, e));
    if (layers) c.dit.layers = layers;
    c.adapter.geometry = 9;
    c.lora = (dar_lora_config){ .rank = rank, .alpha = (double)rank, .targets = DAR_PROJECTIONS_ALL };
    DAR_TRY(make(&n, &c, NULL, e));
    if (rank) {
        train(&n);
    } else {
        prepare(&n, &n.scene_tape);
        evaluate(&n);
    }
    dar_run_say(r, "%s, %lld blocks, %lld tokens, %d threads", c.name, (long long)c.dit.layers,
                (long long)(n.clip.frames * n.scene.frame), dar_threads());
    for (int i = 0; i < ARENAS; i++) {
        bytes[i] = n.arena[i].peak;
        planned += (double)bytes[i];
        dar_run_say(r, "%-8s %8.3f GB", arena_names[i], (double)bytes[i] * 1e-9);
    }
    drop(&n);
    if (common.dry_run) return DAR_OK;

    double before = taken();
    DAR_TRY(make(&n, &c, bytes, e));
    double most = peak(), start = seconds();
    if (rank) {
        train(&n);
        say_rate(r, "step", seconds() - start, flops(&n.tape), most);
    } else {
        prepare(&n, &n.scene_tape);
        say_rate(r, "scene", seconds() - start, flops(&n.scene_tape), most);
        start = seconds();
        evaluate(&n);
        say_rate(r, "step", seconds() - start, flops(&n.tape), most);
    }
    dar_run_say(r, "peak     %8.1f GF/s of bf16", most * 1e-9);
    dar_run_say(r, "memory   %8.3f GB planned, %.3f GB taken", planned * 1e-9, (taken() - before) * 1e-9);
    drop(&n);
    return DAR_OK;
}

int main(int argc, char **argv)
{
    static const dar_program program = {
        .name = "speed_dit",
        .summary = "Time the public model with random weights of its real shapes.",
        .options = options,
        .n_options = DAR_COUNT(options),
        .common = &common,
        .run = measure,
    };
    return dar_program_main(&program, argc, argv);
}
