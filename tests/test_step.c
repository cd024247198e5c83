/* test_step.c: a training step of the whole transformer: gradients in every precision, the same bits on any number of
 * threads, memory as planned. */
#include "tests/test.h"

#include "lib/kern.h"
#include "lib/rng.h"
#include "tests/model.h"

#define STEPS 3

/* What a step needs beside the network. */
struct trainer {
    model o;
    dar_arena moments;
    int t; /* steps done */
};

struct what {
    dar_dtype storage;
    unsigned train;
    dar_dit_replay replay;
    bool plan;
    bool cut; /* the feed-forward layer takes 30 of the 105 tokens at a time */
};

/* dar-test, a little wider: no tile, no vector and no chunk fits these sizes. */
static void trainer_init(struct trainer *r, struct what w)
{
    dar_config c = model_preset("dar-test");
    dar_err e;
    memset(r, 0, sizeof *r);
    c.dit.width = 48;
    c.dit.heads = 3;
    c.dit.ffn = 76;
    c.lora.rank = 5;
    model_init(&r->o, &c, w.storage, w.plan);
    if (w.train & DAR_PARAM_LORA) dar_lora_init(&r->o.m, &r->o.p, &c.lora);
    dar_params_train(&r->o.p, w.train);
    dar_params_fresh(&r->o.p, DAR_PARAM_ALL, 1);
    dar_params_gradients(&r->o.p);
    for (size_t i = 0; i < r->o.p.count && !w.plan; i++) {
        dar_param *q = r->o.p.at[i]; /* zeros would hide the rest */
        if (q->info.law == DAR_FRESH_VALUE && q->info.spread == 0) dar_rng_fill_uniform(&q->x, 9, i, -0.3, 0.3);
    }
    model_clip(&r->o, 3, 3, 5, 7);
    r->o.m.replay = w.replay;
    if (w.cut) r->o.m.piece = 30 * c.dit.ffn;
    CHECK(dar_arena_init(&r->moments, "moments", (size_t)16 << 20, &e) == DAR_OK, "%s", e.text);
}

static void trainer_free(struct trainer *r)
{
    model_free(&r->o);
    dar_arena_free(&r->moments);
}

/* Forward and backward; gradients lie in the parameters.  Returns the loss, 0 when planning. */
static double gradients(struct trainer *r)
{
    dar_val *loss = model_loss(&r->o);
    dar_backward(&r->o.tape, loss, NULL);
    return r->o.step.plan ? 0 : dar_dtype_get(loss->x.dtype, loss->x.data, 0);
}

/* Two moments of one parameter, the same ones at every step since the order is the same. */
static void update(struct trainer *r, dar_param *q)
{
    size_t count = dar_tensor_count(&q->x), bytes = count * dar_dtype_size(q->g.dtype);
    void *m = dar_arena_push(&r->moments, bytes), *v = dar_arena_push(&r->moments, bytes);
    dar_adamw a = { .rate = 1e-3, .beta1 = 0.9, .beta2 = 0.999, .eps = 1e-8, .decay = 0.01, .scale = 1 };
    a.fix1 = 1 / (1 - pow(a.beta1, r->t));
    a.fix2 = 1 / (1 - pow(a.beta2, r->t));
    dar_row_adamw(&a, q->g.dtype, q->g.dtype, count, q->x.data, m, v, q->g.data);
}

static double train(struct trainer *r)
{
    double loss = gradients(r);
    r->t++;
    dar_arena_reset(&r->moments, 0);
    for (size_t i = 0; i < r->o.p.count; i++)
        if (r->o.p.at[i]->trainable) update(r, r->o.p.at[i]);
    return loss;
}

/* ---------------------------------------------------------------- precisions */

static double loss_of(struct trainer *r, dar_dtype storage)
{
    trainer_init(r, (struct what){ storage, DAR_PARAM_LORA | DAR_PARAM_ADAPTER, DAR_REPLAY_PRODUCTS, false, false });
    return gradients(r);
}

/* Relative distance of all gradients in the Euclidean norm. */
static double distance(const struct trainer *a, const struct trainer *b)
{
    double d = 0, n = 0;
    for (size_t i = 0; i < a->o.p.count; i++) {
        const dar_tensor *x = &a->o.p.at[i]->g, *y = &b->o.p.at[i]->g;
        for (size_t j = 0; x->data && j < dar_tensor_count(x); j++) {
            double u = dar_dtype_get(x->dtype, x->data, j), v = dar_dtype_get(y->dtype, y->data, j);
            d += (u - v) * (u - v);
            n += v * v;
        }
    }
    return sqrt(d / n);
}

/* f32: 1e-5, since a gradient passes about 60 roundings of 6e-8, most of them averaged over hundreds of terms, and the
 * goal for a whole step is 1e-4.  bf16: every operand of a product is rounded to 2^-9, about 2.3e-3 relative in each
 * product (forward and backward, in a chain of about 20): 2.3e-3 sqrt(40) = 1.5e-2. */
static void precisions_agree(void **state)
{
    (void)state;
    struct trainer wide, f32, bf16;
    double loss = loss_of(&wide, DAR_F64), loss32 = loss_of(&f32, DAR_F32), loss16 = loss_of(&bf16, DAR_BF16);
    double d32 = distance(&f32, &wide), d16 = distance(&bf16, &wide);
    printf("note: gradient of a step against f64: f32 %.1e, bf16 %.1e\n", d32, d16);
    CHECK_NEAR("f32 gradient against f64", d32, 0, 1e-5);
    CHECK_NEAR("bf16 gradient against f64", d16, 0, 1.5e-2);
    CHECK_NEAR("f32 loss", loss32, loss, 1e-6 * loss);
    CHECK_NEAR("bf16 loss", loss16, loss, 1e-2 * loss);
    trainer_free(&wide);
    trainer_free(&f32);
    trainer_free(&bf16);
}

/* ---------------------------------------------------------------- what is computed again */

/* The same numbers again.  But bf16 rounds the argument of an activation that is kept: its bound is that of a step.
 * Where nothing is computed again nothing is cut, and f32 sums gradients of weights over all tokens at once. */
static void replays_agree(void **state)
{
    (void)state;
    for (int run = 0; run < 8; run++)
        for (int replay = 1; replay < DAR_REPLAYS; replay++) {
            struct what w = { run & 1 ? DAR_BF16 : DAR_F32, DAR_PARAM_ADAPTER, DAR_REPLAY_ALL, false, run & 4 };
            struct trainer all, some;
            w.train |= run & 2 ? DAR_PARAM_BASE : DAR_PARAM_LORA;
            trainer_init(&all, w);
            w.replay = (dar_dit_replay)replay;
            trainer_init(&some, w);
            gradients(&all);
            gradients(&some);
            bool rounds = w.storage == DAR_BF16 && (replay == DAR_REPLAY_CHEAP || replay == DAR_REPLAY_WIDE);
            double most = rounds ? 1.5e-2 : w.cut && replay == DAR_REPLAY_NOTHING ? 1e-6 : 0;
            CHECK_NEAR(dar_dit_replay_name[replay], distance(&some, &all), 0, most);
            trainer_free(&all);
            trainer_free(&some);
        }
}

/* ---------------------------------------------------------------- threads */

static void same_bits(struct what w)
{
    static const int threads[] = { 1, 2, 3, 7 };
    int before = dar_threads();
    void *first = NULL;
    double loss0[STEPS];
    for (size_t k = 0; k < DAR_COUNT(threads); k++) {
        struct trainer r;
        dar_threads_set(threads[k]);
        trainer_init(&r, w);
        for (int i = 0; i < STEPS; i++) {
            double loss = train(&r);
            if (!k) loss0[i] = loss;
            CHECK(memcmp(&loss, &loss0[i], sizeof loss) == 0,
                  "%s: loss of step %d is %.17g with %d threads, %.17g with 1", dar_dtype_name(w.storage), i, loss,
                  threads[k], loss0[i]);
        }
        const dar_arena *a = &r.o.weights;
        if (!k) {
            first = malloc(a->used);
            memcpy(first, a->base, a->used);
        }
        CHECK(memcmp(first, a->base, a->used) == 0, "%s: weights differ with %d threads", dar_dtype_name(w.storage),
              threads[k]);
        trainer_free(&r);
    }
    CHECK(loss0[STEPS - 1] < loss0[0], "%s: the loss does not fall: %.9g to %.9g", dar_dtype_name(w.storage), loss0[0],
          loss0[STEPS - 1]);
    free(first);
    dar_threads_set(before);
}

static void threads_give_the_same_bits(void **state)
{
    (void)state;
    same_bits((struct what){ DAR_F32, DAR_PARAM_LORA | DAR_PARAM_ADAPTER, DAR_REPLAY_PRODUCTS, false, false });
    same_bits((struct what){ DAR_F32, DAR_PARAM_BASE | DAR_PARAM_ADAPTER, DAR_REPLAY_ALL, false, false });
    same_bits((struct what){ DAR_BF16, DAR_PARAM_LORA | DAR_PARAM_ADAPTER, DAR_REPLAY_CHEAP, false, false });
    same_bits((struct what){ DAR_BF16, DAR_PARAM_BASE | DAR_PARAM_ADAPTER, DAR_REPLAY_PRODUCTS, false, false });
    same_bits((struct what){ DAR_F64, DAR_PARAM_LORA, DAR_REPLAY_NOTHING, false, false });
    same_bits((struct what){ DAR_BF16, DAR_PARAM_LORA | DAR_PARAM_ADAPTER, DAR_REPLAY_CHEAP, false, true });
    same_bits((struct what){ DAR_F32, DAR_PARAM_BASE | DAR_PARAM_ADAPTER, DAR_REPLAY_PRODUCTS, false, true });
}

/* ---------------------------------------------------------------- memory */

static void peak_is_as_planned(void **state)
{
    (void)state;
    for (int run = 0; run < 4 * DAR_REPLAYS; run++) {
        struct trainer plan, real;
        struct what w = { DAR_BF16, DAR_PARAM_ADAPTER | DAR_PARAM_LORA, (dar_dit_replay)(run / 4), true, run & 2 };
        if (run & 1) w.train = DAR_PARAM_ADAPTER | DAR_PARAM_BASE;
        trainer_init(&plan, w);
        w.plan = false;
        trainer_init(&real, w);
        gradients(&plan);
        for (int i = 0; i < 2; i++) gradients(&real);
        assert_int_equal(real.o.step.peak, plan.o.step.peak);
        assert_int_equal(real.o.keep.peak, plan.o.keep.peak);
        assert_int_equal(real.o.weights.peak, plan.o.weights.peak);
        CHECK_NEAR("forward FLOPs", plan.o.tape.cost.forward, real.o.tape.cost.forward, 0);
        CHECK_NEAR("backward FLOPs", plan.o.tape.cost.backward, real.o.tape.cost.backward, 0);
        assert_int_equal(real.o.tape.cost.ops, plan.o.tape.cost.ops);
        trainer_free(&plan);
        trainer_free(&real);
    }
}

/* A step of one block of the public model: bytes, with this many tokens of the feed-forward layer at a time. */
static size_t public_step(dar_dit_replay replay, int64_t tokens)
{
    model o;
    dar_config c = model_preset("wan22-fun-5b");
    c.dit.layers = 1;
    c.lora.rank = 16;
    model_init(&o, &c, DAR_BF16, true);
    dar_lora_init(&o.m, &o.p, &c.lora);
    dar_params_train(&o.p, DAR_PARAM_LORA);
    dar_params_fresh(&o.p, DAR_PARAM_ALL, 1);
    dar_params_gradients(&o.p);
    model_clip(&o, 13, 15, 26, 30);
    o.m.replay = replay;
    o.m.piece = tokens * c.dit.ffn;
    dar_backward(&o.tape, model_loss(&o), NULL);
    size_t bytes = o.step.peak;
    model_free(&o);
    return bytes;
}

/* The activation of the feed-forward layer, and its gradient, exist for a piece of the tokens only; half of that is
 * saved, since attention then takes the most.  Replaying cheap, the gradient lies where the activation lay: no more is
 * there to be saved. */
static void pieces_save_memory(void **state)
{
    (void)state;
    const size_t N = 13 * 15 * 26, F = 14336, one = N * F * dar_dtype_size(DAR_BF16);
    for (int replay = 0; replay < DAR_REPLAY_NOTHING; replay++) {
        size_t whole = public_step((dar_dit_replay)replay, (int64_t)N);
        size_t cut = public_step((dar_dit_replay)replay, (int64_t)N / 13);
        printf("note: replaying %s: %zu MB, in pieces %zu\n", dar_dit_replay_name[replay], whole >> 20, cut >> 20);
        bool over = replay == DAR_REPLAY_CHEAP;
        CHECK(whole - cut > (over ? one / 2 : one) && (!over || whole - cut < one),
              "replaying %s: %zu bytes, in pieces %zu", dar_dit_replay_name[replay], whole, cut);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(precisions_agree),           cmocka_unit_test(replays_agree),
        cmocka_unit_test(threads_give_the_same_bits), cmocka_unit_test(peak_is_as_planned),
        cmocka_unit_test(pieces_save_memory),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
