/* speed_vae.c: the public autoencoder with random bf16 weights of its real shapes: a clip encoded and decoded piece by
 * piece: seconds, rate against the machine's peak, memory as planned and as taken. */
#include <string.h>

#include "lib/program.h"
#include "lib/rng.h"
#include "lib/thread.h"
#include "models/vae.h"
#include "tests/rate.h"

static int64_t frames, size[2];
static const char *preset;
static dar_common common;

/* clang-format off */
static const dar_option options[] = {
    RATE_OPTIONS(&preset, &frames, "9", size),
};
/* clang-format on */

enum { WEIGHTS, KEPT, STEP, ARENAS };
static const char *const arena_names[] = { "weights", "kept", "step" };

struct network {
    dar_arena arena[ARENAS];
    dar_params p;
    dar_vae v;
    dar_tape tape;
    dar_tensor x, z; /* of the largest piece */
};

static dar_tensor piece(struct network *n, dar_shape s)
{
    dar_tensor x = dar_tensor_push(&n->arena[WEIGHTS], n->p.main, s);
    if (!n->arena[WEIGHTS].plan) dar_rng_fill_uniform(&x, 1, 1, -1, 1);
    return x;
}

/* bytes NULL: only plan. */
static dar_status make(struct network *n, const dar_config *c, const size_t *bytes, dar_err *e)
{
    memset(n, 0, sizeof *n);
    for (int i = 0; i < ARENAS; i++)
        DAR_TRY(bytes ? dar_arena_init(&n->arena[i], arena_names[i], bytes[i], e)
                      : dar_arena_init_plan(&n->arena[i], arena_names[i], e));
    DAR_TRY(dar_tape_init(&n->tape, &n->arena[STEP], e));
    n->tape.recording = false;
    dar_params_init(&n->p, &n->arena[WEIGHTS], DAR_BF16);
    dar_vae_init(&n->v, &n->p, &c->vae);
    dar_params_fresh(&n->p, DAR_PARAM_ALL, 1);
    dar_vae_fold(&n->v, &n->arena[WEIGHTS]);
    int64_t s = dar_vae_shrink_time(&c->vae), r = dar_vae_shrink(&c->vae), h = size[1] / r, w = size[0] / r;
    n->x = piece(n, DAR_SHAPE(1, 3, frames > 1 ? s : 1, h * r, w * r));
    n->z = piece(n, DAR_SHAPE(1, c->vae.latent, 1, h, w));
    return DAR_OK;
}

static void drop(struct network *n)
{
    dar_params_free(&n->p);
    dar_tape_free(&n->tape);
    for (int i = 0; i < ARENAS; i++) dar_arena_free(&n->arena[i]);
}

/* Returns the FLOPs; every piece is computed, though all are the same. */
static double run(struct network *n, dar_vae_side side)
{
    dar_vae_stream s;
    dar_tape_clear(&n->tape);
    dar_arena_reset(&n->arena[KEPT], 0);
    dar_vae_stream_init(&s, &n->v, side, &n->arena[KEPT]);
    s.skip = false;
    for (int64_t k = 0; k <= (frames - 1) / dar_vae_shrink_time(&n->v.c); k++) {
        dar_arena_reset(&n->arena[STEP], 0);
        if (side == DAR_VAE_DECODER) {
            dar_vae_decode_next(&s, &n->tape, dar_leaf(&n->tape, n->z, NULL), NULL, NULL, NULL);
        } else {
            dar_tensor x = dar_tensor_narrow(&n->x, 2, 0, k ? n->x.shape.d[2] : 1);
            dar_vae_encode_next(&s, &n->tape, dar_contiguous(&n->tape, dar_leaf(&n->tape, x, NULL)));
        }
    }
    return n->tape.cost.forward;
}

static dar_status measure(dar_run *r, dar_err *e)
{
    static const char *const names[] = { [DAR_VAE_ENCODER] = "encode", [DAR_VAE_DECODER] = "decode" };
    struct network n;
    dar_config c;
    size_t bytes[ARENAS];

    DAR_TRY(dar_config_open(&c, preset, e));
    DAR_TRY(make(&n, &c, NULL, e));
    for (int side = 0; side < 2; side++) run(&n, (dar_vae_side)side);
    dar_run_say(r, "%s, %lld frames of %lld x %lld, %d threads", c.name, (long long)frames, (long long)size[0],
                (long long)size[1], dar_threads());
    double planned = rate_planned(r, n.arena, ARENAS, bytes);
    drop(&n);
    if (common.dry_run) return DAR_OK;

    double before = rate_taken();
    DAR_TRY(make(&n, &c, bytes, e));
    double most = rate_peak();
    for (int side = 0; side < 2; side++) {
        double start = rate_seconds(), flops = run(&n, (dar_vae_side)side);
        rate_say(r, names[side], rate_seconds() - start, flops, most);
    }
    dar_run_say(r, "peak     %8.1f GF/s of bf16", most * 1e-9);
    dar_run_say(r, "memory   %8.3f GB planned, %.3f GB taken", planned * 1e-9, (rate_taken() - before) * 1e-9);
    drop(&n);
    return DAR_OK;
}

int main(int argc, char **argv)
{
    static const dar_program program = {
        .name = "speed_vae",
        .summary = "Time the public autoencoder with random weights of its real shapes.",
        .options = options,
        .n_options = DAR_COUNT(options),
        .common = &common,
        .run = measure,
    };
    return dar_program_main(&program, argc, argv);
}
