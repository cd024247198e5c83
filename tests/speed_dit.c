/* speed_dit.c: the public model with random bf16 weights of its real shapes: one evaluation, or with --rank a training
 * step, at the size and depth asked for: seconds, rate against the machine's peak, memory as planned and as taken. */
#include <fcntl.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "lib/program.h"
#include "lib/rng.h"
#include "lib/thread.h"
#include "models/dit.h"
#include "lib/safetensors_write.h"
#include "lib/weights.h"
#include "models/load.h"
#include "models/lora.h"
#include "tests/rate.h"

static int64_t layers, frames, size[2], rank, words;
static const char *preset;
static const char *file, *written;
static bool eight;
static dar_common common;

/* clang-format off */
static const dar_option options[] = {
    RATE_OPTIONS(&preset, &frames, "49", size),
    { .name = "layers", .placeholder = "N", .type = DAR_ARG_INT, .target = &layers, .standard = "0", .lo = 0,
      .hi = 4096, .help = "blocks; 0: all" },
    { .name = "words", .placeholder = "N", .type = DAR_ARG_INT, .target = &words, .standard = "30", .lo = 0, .hi = 512,
      .help = "text tokens" },
    { .name = "rank", .placeholder = "R", .type = DAR_ARG_INT, .target = &rank, .standard = "0", .lo = 0, .hi = 4096,
      .help = "a training step of LoRA of this rank; 0: an evaluation" },
    { .name = "weights", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &file,
      .help = "of the network; read, and timed, instead of made" },
    { .name = "write", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &written,
      .help = "write the weights that are made, and stop" },
    { .name = "eight", .type = DAR_ARG_FLAG, .target = &eight, .help = "products of blocks in 8 bits by 8 bits" },
};
/* clang-format on */

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
    dar_weights *file;
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

/* ---------------------------------------------------------------- files */

/* Every page once, in the order in which they lie in the file. */
static double touch(const dar_params *p)
{
    double sum = 0;
    for (size_t i = 0; i < p->count; i++) {
        const dar_tensor *x = &p->at[i]->x;
        for (size_t k = 0; x->data && k < dar_tensor_bytes(x); k += 4096) sum += ((const char *)x->data)[k];
    }
    return sum;
}

static dar_status load(struct network *n, dar_err *e)
{
    DAR_TRY(dar_weights_open(&n->file, file, e));
    return dar_load_dit(&n->m, &n->p, n->file, 1, e);
}

/* Ask the system to forget what it holds of the file. */
static int open_cold(void)
{
    int fd = open(file, O_RDONLY | O_CLOEXEC);
    if (fd >= 0) posix_fadvise(fd, 0, 0, POSIX_FADV_DONTNEED);
    return fd;
}

/* Seconds to read the whole file, from the disk. */
static double read_through(void)
{
    static char buffer[1 << 20];
    double start = rate_seconds();
    int fd = open_cold();
    while (fd >= 0 && read(fd, buffer, sizeof buffer) > 0) {
    }
    if (fd >= 0) close(fd);
    return rate_seconds() - start;
}

static dar_status write_weights(const struct network *n, dar_err *e)
{
    dar_safetensors_item *item = calloc(n->p.count, sizeof *item);
    DAR_ASSERT(item, "no memory for %zu names", n->p.count);
    for (size_t i = 0; i < n->p.count; i++) item[i] = (dar_safetensors_item){ n->p.at[i]->name, n->p.at[i]->x };
    dar_status s = dar_safetensors_write(written, item, n->p.count, NULL, e);
    free(item);
    return s;
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
    if (bytes && file) DAR_TRY(load(n, e));
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
    dar_weights_close(n->file);
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

static double flops(const dar_tape *t)
{
    return t->cost.forward + t->cost.backward;
}

static dar_status make_timed(const dar_run *r, struct network *n, const dar_config *c, const size_t *bytes, dar_err *e)
{
    if (!file) return make(n, c, bytes, e);
    dar_run_say(r, "read     %8.2f s  %s, from the disk", read_through(), file);
    close(open_cold());
    double start = rate_seconds();
    DAR_TRY(make(n, c, bytes, e));
    double sum = touch(&n->p);
    dar_run_say(r, "load     %8.2f s  the same, every page touched (%g)", rate_seconds() - start, sum);
    return DAR_OK;
}

static double plan(const dar_run *r, struct network *n, const dar_config *c, size_t bytes[ARENAS])
{
    if (rank) {
        train(n);
    } else {
        prepare(n, &n->scene_tape);
        evaluate(n);
    }
    dar_run_say(r, "%s, %lld blocks, %lld tokens, %d threads", c->name, (long long)c->dit.layers,
                (long long)(n->clip.frames * n->scene.frame), dar_threads());
    return rate_planned(r, n->arena, ARENAS, bytes);
}

static dar_status measure(dar_run *r, dar_err *e)
{
    struct network n;
    dar_config c;
    size_t bytes[ARENAS];

    DAR_TRY(dar_config_open(&c, preset, e));
    if (layers) c.dit.layers = layers;
    if (c.adapter.geometry == 0) c.adapter.geometry = 9;
    c.lora = (dar_lora_config){ .rank = rank, .alpha = (double)rank, .targets = DAR_PROJECTIONS_ALL };
    DAR_TRY(make(&n, &c, NULL, e));
    double planned = plan(r, &n, &c, bytes);
    drop(&n);
    if (common.dry_run) return DAR_OK;

    double before = rate_taken();
    DAR_TRY(make_timed(r, &n, &c, bytes, e));
    if (written) {
        dar_status s = write_weights(&n, e);
        drop(&n);
        return s;
    }
    double most = rate_peak(), start = rate_seconds();
    if (rank) {
        train(&n);
        rate_say(r, "step", rate_seconds() - start, flops(&n.tape), most);
    } else {
        prepare(&n, &n.scene_tape);
        rate_say(r, "scene", rate_seconds() - start, flops(&n.scene_tape), most);
        start = rate_seconds();
        evaluate(&n);
        rate_say(r, "step", rate_seconds() - start, flops(&n.tape), most);
    }
    dar_run_say(r, "peak     %8.1f GF/s of bf16", most * 1e-9);
    dar_run_say(r, "memory   %8.3f GB planned, %.3f GB taken", planned * 1e-9, (rate_taken() - before) * 1e-9);
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
