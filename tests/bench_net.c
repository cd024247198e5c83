/* bench_net.c: rows of whole blocks of a diffusion transformer (tests/net.h): inference, and a training step of rank-32
 * LoRA (forward, loss, backward; nothing recomputed). */
#include "tests/bench.h"

#include "lib/status.h"
#include "tests/net.h"

#define RANK 32

/* Sizes of a row: blocks, tokens (frames of 16 x 16), text tokens, width, heads, feed-forward width. */
struct state {
    net trained, plain; /* with LoRA; with its own weights alone, as after merging */
};

static void forward(bench *b)
{
    struct state *s = b->state;
    b->tape.recording = false;
    net_forward(&b->tape, &s->plain, dar_leaf(&b->tape, s->plain.input, NULL));
}

static void step(bench *b)
{
    struct state *s = b->state;
    b->tape.recording = true;
    dar_val *loss = net_loss(&b->tape, &s->trained, dar_leaf(&b->tape, s->trained.input, NULL));
    dar_backward(&b->tape, loss, NULL);
}

static double planned(bench *b, void (*run)(bench *b))
{
    run(b);
    double flops = b->tape.cost.forward + b->tape.cost.backward;
    dar_tape_clear(&b->tape);
    dar_arena_reset(b->tape.arena, 0);
    return flops;
}

static void setup(bench *b)
{
    const int64_t *s = b->s;
    dar_arena plan;
    dar_err e;
    net_size size = { .blocks = (int)s[0],
                      .grid = { s[1] / 256, 16, 16 },
                      .text = s[2],
                      .width = s[3],
                      .heads = s[4],
                      .ffn = s[5],
                      .storage = b->row->type,
                      .whole = true };
    struct state *st = b->state = dar_arena_push(b->arena, sizeof *st);
    net_init(&st->plain, size, b->arena);
    size.rank = RANK;
    size.train = true;
    net_init(&st->trained, size, b->arena);

    DAR_ASSERT(dar_arena_init_plan(&plan, "plan", &e) == DAR_OK, "%s", e.text);
    DAR_ASSERT(dar_tape_init(&b->tape, &plan, &e) == DAR_OK, "%s", e.text);
    b->flops[0] = planned(b, forward);
    b->flops[1] = planned(b, step);
    dar_arena_free(&plan);
    b->tape.arena = b->arena;
    b->mark = dar_arena_mark(b->arena);
}

static const bench_kind blocks = {
    .part = { "blocks", "blocks_step" }, .setup = setup, .run = { forward, step }, .reset = bench_op_reset
};

const bench_row bench_net_rows[] = {
    { &blocks, DAR_F32, { 8, 1536, 64, 384, 6, 1536 }, BENCH_F32, { 0 }, false },
    { &blocks, DAR_BF16, { 8, 1536, 64, 384, 6, 1536 }, BENCH_BF16, { 0 }, false },
    { &blocks, DAR_F32, { 1, 2048, 512, 3072, 24, 14336 }, BENCH_F32, { 0 }, false },
    { &blocks, DAR_BF16, { 1, 2048, 512, 3072, 24, 14336 }, BENCH_BF16, { 0 }, false },
};
const size_t bench_n_net_rows = DAR_COUNT(bench_net_rows);
