/* bench_net.c: rows of whole blocks of the transformer (models/dit.h): inference, and a training step of rank-32 LoRA
 * (forward, loss, backward; only what is cheap is computed again).  Keys and values of the text are made each time. */
#include <string.h>

#include "lib/status.h"
#include "models/dit.h"
#include "models/lora.h"
#include "tests/bench.h"

#define RANK 32

struct network {
    dar_params p;
    dar_dit m;
};

/* Sizes of a row: blocks, tokens (frames of 16 x 16), text tokens, width, heads, feed-forward width. */
struct state {
    struct network trained, plain; /* with LoRA; with the same weights alone, as after merging */
    dar_tensor tokens, text, target, rope, e0;
    dar_arena keep;
};

static dar_val *run(bench *b, const dar_dit *m)
{
    struct state *s = b->state;
    dar_tape *t = &b->tape;
    dar_dit_scene *scene = dar_tape_room(t, sizeof *scene);
    dar_dit_text *x = dar_tape_room(t, sizeof *x);
    dar_dit_moment e = { .e0 = dar_leaf(t, s->e0, NULL) };
    *scene = (dar_dit_scene){ .frame = 256, .rope = dar_leaf(t, s->rope, NULL) };
    dar_dit_text_prepare(t, m, &s->text, NULL, x);
    dar_val *tokens = dar_leaf(t, s->tokens, NULL);
    if (!t->recording) tokens = dar_contiguous(t, tokens); /* it is written over */
    return dar_dit_blocks(t, m, scene, x, &e, tokens);
}

static void forward(bench *b)
{
    struct state *s = b->state;
    b->tape.recording = false;
    run(b, &s->plain.m);
}

static void reset(bench *b)
{
    bench_op_reset(b);
    dar_arena_reset(b->tape.keep, 0);
}

static void step(bench *b)
{
    struct state *s = b->state;
    if (!b->tape.arena->plan) reset(b); /* what forward made is not the step's */
    b->tape.recording = true;
    dar_val *target = dar_leaf(&b->tape, s->target, NULL);
    dar_backward(&b->tape, dar_squared_error(&b->tape, run(b, &s->trained.m), target, NULL, true), NULL);
}

static double planned(bench *b, void (*fn)(bench *b))
{
    fn(b);
    double flops = b->tape.cost.forward + b->tape.cost.backward;
    dar_tape_clear(&b->tape);
    dar_arena_reset(b->tape.arena, 0);
    return flops;
}

/* share: whose weights it has; NULL: its own. */
static void make(bench *b, struct network *n, int64_t rank, const struct network *share)
{
    const int64_t *s = b->s;
    dar_dit_config c = { .layers = s[0], .width = s[3], .heads = s[4], .ffn = s[5] };
    c.latent = c.patch = 1;
    c.frequencies = 2;
    c.text_width = 64;
    c.text_keys = s[2];
    c.eps = 1e-6;
    dar_params_free(&n->p); /* of the row before */
    dar_dit_free(&n->m);
    dar_params_init(&n->p, b->arena, b->row->type);
    dar_dit_init(&n->m, &n->p, &c, &(dar_adapter_config){ .unshuffle = 1 });
    dar_lora_init(&n->m, &n->p, &(dar_lora_config){ .rank = rank, .alpha = 1, .targets = DAR_PROJECTIONS_ALL });
    dar_params_train(&n->p, DAR_PARAM_LORA);
    for (size_t i = 0; share && i < n->p.count; i++)
        if (share->p.at[i]->x.data) dar_param_bind(&n->p, n->p.at[i], &share->p.at[i]->x);
    for (size_t i = 0; i < n->p.count; i++) { /* what runs: not time, head, patches */
        dar_param *q = n->p.at[i];
        if (q->info.role == DAR_PARAM_LORA || !strncmp(q->name, "blocks.", 7) || !strncmp(q->name, "text_", 5))
            dar_param_fresh(&n->p, q, 1);
    }
    dar_params_gradients(&n->p);
    n->m.replay = DAR_REPLAY_CHEAP;
}

static void setup(bench *b)
{
    static struct state only;
    struct state *s = b->state = &only;
    dar_arena plan, plan_keep;
    dar_err e;

    make(b, &s->trained, RANK, NULL);
    make(b, &s->plain, 0, &s->trained);
    dar_dtype type = s->plain.p.main;
    s->tokens = bench_tensor(b, type, DAR_SHAPE(1, b->s[1], b->s[3]));
    s->target = bench_tensor(b, type, s->tokens.shape);
    s->text = bench_tensor(b, type, DAR_SHAPE(1, b->s[2], 64));
    s->e0 = bench_tensor(b, type, DAR_SHAPE(1, 2, 6 * b->s[3]));
    s->rope = dar_tensor_push(b->arena, type, DAR_SHAPE(b->s[1], b->s[3] / b->s[4]));
    dar_rope_table(&s->rope, b->s[1] / 256, 16, 16, 10000);

    DAR_ASSERT(dar_arena_init_plan(&plan, "plan", &e) == DAR_OK, "%s", e.text);
    DAR_ASSERT(dar_arena_init_plan(&plan_keep, "plan", &e) == DAR_OK, "%s", e.text);
    DAR_ASSERT(dar_tape_init(&b->tape, &plan, &e) == DAR_OK, "%s", e.text);
    b->tape.keep = &plan_keep;
    b->flops[0] = planned(b, forward);
    b->flops[1] = planned(b, step);
    dar_arena_free(&s->keep); /* of the row before */
    DAR_ASSERT(dar_arena_init(&s->keep, "keep", plan_keep.peak, &e) == DAR_OK, "%s", e.text);
    dar_arena_free(&plan);
    dar_arena_free(&plan_keep);
    b->tape.arena = b->arena;
    b->tape.keep = &s->keep;
    b->mark = dar_arena_mark(b->arena);
}

static const bench_kind blocks = {
    .part = { "blocks", "blocks_step" }, .setup = setup, .run = { forward, step }, .reset = reset
};

const bench_row bench_net_rows[] = {
    { &blocks, DAR_F32, { 8, 1536, 64, 384, 6, 1536 }, BENCH_F32, { 0 }, false },
    { &blocks, DAR_BF16, { 8, 1536, 64, 384, 6, 1536 }, BENCH_BF16, { 0 }, false },
    { &blocks, DAR_F32, { 2, 2048, 512, 1536, 12, 8960 }, BENCH_F32, { 0 }, false },
    { &blocks, DAR_BF16, { 2, 2048, 512, 1536, 12, 8960 }, BENCH_BF16, { 0 }, false },
    { &blocks, DAR_F32, { 1, 2048, 512, 3072, 24, 14336 }, BENCH_F32, { 0 }, false },
    { &blocks, DAR_BF16, { 1, 2048, 512, 3072, 24, 14336 }, BENCH_BF16, { 0 }, false },
    { &blocks, DAR_F32, { 1, 8192, 512, 3072, 24, 14336 }, BENCH_F32, { 0 }, false },
    { &blocks, DAR_BF16, { 1, 8192, 512, 3072, 24, 14336 }, BENCH_BF16, { 0 }, false },
};
const size_t bench_n_net_rows = DAR_COUNT(bench_net_rows);
