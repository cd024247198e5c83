/* test_net.c: the core as a whole, on two blocks of a diffusion transformer (tests/net.h): gradients, precisions, the
 * same bits on any number of threads, memory as planned. */
#include "tests/test.h"

#include <stdint.h>

#include "autograd/gradcheck.h"
#include "lib/kern.h"
#include "tests/net.h"

#define STEPS 3

/* Odd sizes: no tile, no vector and no chunk fits them. */
static const net_size small = {
    .blocks = 2, .grid = { 3, 5, 7 }, .text = 11, .width = 48, .heads = 3, .ffn = 76, .rank = 5, .train = true
};

/* Fewer numbers still, for checks that evaluate the loss thousands of times. */
static const net_size least = {
    .blocks = 2, .grid = { 2, 3, 3 }, .text = 4, .width = 18, .heads = 3, .ffn = 23, .storage = DAR_F64
};

static net_size sized(dar_dtype storage, int64_t rank, bool keep)
{
    net_size s = small;
    s.storage = storage;
    s.rank = rank;
    s.keep = keep;
    return s;
}

/* ---------------------------------------------------------------- a training step */

/* A network with what a step needs. */
struct trainer {
    net n;
    dar_arena weights, moments, step, keep;
    dar_tape tape;
    int t;     /* steps done */
    void **at; /* moments of the weight that is next */
};

static void check(dar_status s, const dar_err *e)
{
    CHECK(s == DAR_OK, "%s", e->text);
}

static void trainer_init(struct trainer *r, net_size s, bool plan)
{
    dar_err e = { "" };
    memset(r, 0, sizeof *r);
    check(plan ? dar_arena_init_plan(&r->weights, "weights", &e)
               : dar_arena_init(&r->weights, "weights", net_bytes(s), &e),
          &e);
    net_init(&r->n, s, &r->weights);
    check(plan ? dar_arena_init_plan(&r->step, "step", &e) : dar_arena_init(&r->step, "step", (size_t)64 << 20, &e),
          &e);
    check(plan ? dar_arena_init_plan(&r->keep, "keep", &e) : dar_arena_init(&r->keep, "keep", (size_t)8 << 20, &e), &e);
    check(dar_arena_init(&r->moments, "moments", 2 * net_bytes(s), &e), &e);
    check(dar_tape_init(&r->tape, &r->step, &e), &e);
    if (s.keep) r->tape.keep = &r->keep;
}

static void trainer_free(struct trainer *r)
{
    dar_tape_free(&r->tape);
    dar_arena_free(&r->weights);
    dar_arena_free(&r->moments);
    dar_arena_free(&r->step);
    dar_arena_free(&r->keep);
}

/* Two moments of one weight, the same ones at every step since the order is the same. */
static void update(void *ctx, net_weight *w)
{
    struct trainer *r = ctx;
    size_t count = dar_tensor_count(&w->x), bytes = count * dar_dtype_size(w->g.dtype);
    void *m = dar_arena_push(&r->moments, bytes), *v = dar_arena_push(&r->moments, bytes);
    dar_adamw a = { .rate = 1e-3, .beta1 = 0.9, .beta2 = 0.999, .eps = 1e-8, .decay = 0.01, .scale = 1 };
    a.fix1 = 1 / (1 - pow(a.beta1, r->t));
    a.fix2 = 1 / (1 - pow(a.beta2, r->t));
    dar_kern_for(w->g.dtype)->adamw(count, &a, w->x.data, m, v, w->g.data);
    dar_tensor_fill(&w->g, 0);
}

/* Forward and backward; gradients lie in the weights.  Returns the loss, 0 when planning. */
static double gradients(struct trainer *r)
{
    dar_tape *t = &r->tape;
    dar_arena_reset(&r->step, 0);
    dar_arena_reset(&r->keep, 0);
    dar_tape_clear(t);
    dar_val *loss = net_loss(t, &r->n, dar_leaf(t, r->n.input, NULL));
    dar_backward(t, loss, NULL);
    return r->step.plan ? 0 : dar_dtype_get(loss->x.dtype, loss->x.data, 0);
}

static double train(struct trainer *r)
{
    double loss = gradients(r);
    r->t++;
    dar_arena_reset(&r->moments, 0);
    net_each(&r->n, update, r);
    return loss;
}

/* ---------------------------------------------------------------- gradients */

/* The loss as a function of the input and of four weights of the second block, one of each kind. */
struct probe {
    net n;
    net_weight *w[4];
};

static dar_val *probe_loss(dar_tape *t, void *arg, dar_val *const *in)
{
    struct probe *p = arg;
    for (int i = 0; i < 4; i++) p->w[i]->x = in[i + 1]->x, p->w[i]->g = in[i + 1]->g;
    return net_loss(t, &p->n, in[0]);
}

static void network_gradient(net_size s, const char *what)
{
    dar_arena a;
    struct probe p;
    dar_err e;
    check(dar_arena_init(&a, "test", (size_t)256 << 20, &e), &e);
    net_init(&p.n, s, &a);
    net_block *b = &p.n.block[1];
    p.w[0] = s.rank ? &b->down[2] : &b->w[2];
    p.w[1] = s.rank ? &b->up[7] : &b->b[8];
    p.w[2] = &p.n.block[0].norm[1];
    p.w[3] = &p.n.block[0].modulation[2];

    dar_tensor x[5] = { p.n.input };
    for (int i = 0; i < 4; i++) x[i + 1] = p.w[i]->x;
    dar_gradcheck_result r =
        dar_gradcheck_run(&(dar_gradcheck){ .fn = probe_loss, .arg = &p, .n = 5, .x = x, .seed = 7 }, &a);
    printf("note: gradient of two blocks, %s: %.1e, dot test %.1e\n", what, r.diff, r.dot);
    CHECK(r.diff < 1e-8, "%s: input %d, element %lld: backward %.17g, differences %.17g", what, r.input,
          (long long)r.element, r.found, r.expected);
    CHECK(r.dot < 1e-12, "%s: dot test %.3g", what, r.dot);
    dar_arena_free(&a);
}

static void gradient_is_right(void **state)
{
    net_size s = least;
    int before = dar_threads();
    (void)state;
    dar_threads_set(1); /* waking threads would cost more than the work */
    network_gradient(s, "full");
    s.rank = 2;
    network_gradient(s, "LoRA");
    dar_threads_set(before);
}

/* ---------------------------------------------------------------- precisions */

struct collected {
    double *x;
    size_t n;
};

static void collect(void *ctx, net_weight *w)
{
    struct collected *c = ctx;
    for (size_t i = 0; i < dar_tensor_count(&w->g); i++) c->x[c->n++] = dar_dtype_get(w->g.dtype, w->g.data, i);
}

static struct collected gradient_of(dar_dtype storage)
{
    struct trainer r;
    trainer_init(&r, sized(storage, 5, true), false);
    struct collected c = { calloc(1 << 20, sizeof(double)), 0 };
    c.x[c.n++] = gradients(&r);
    net_each(&r.n, collect, &c);
    trainer_free(&r);
    return c;
}

/* Relative distance in the Euclidean norm; the loss, element 0, apart. */
static double distance(const struct collected *a, const struct collected *b)
{
    double d = 0, n = 0;
    for (size_t i = 1; i < a->n; i++) d += (a->x[i] - b->x[i]) * (a->x[i] - b->x[i]), n += b->x[i] * b->x[i];
    return sqrt(d / n);
}

/* f32: 1e-5, since a gradient passes about 60 roundings of 6e-8, most of them averaged over hundreds of terms, and the
 * goal for a whole step is 1e-4.  bf16: every operand of a product is rounded to 2^-9, about 2.3e-3 relative in each
 * product (forward and backward, in a chain of about 20): 2.3e-3 sqrt(40) = 1.5e-2. */
static void precisions_agree(void **state)
{
    (void)state;
    struct collected wide = gradient_of(DAR_F64), f32 = gradient_of(DAR_F32), bf16 = gradient_of(DAR_BF16);
    assert_int_equal(wide.n, f32.n);
    assert_int_equal(wide.n, bf16.n);
    double d32 = distance(&f32, &wide), d16 = distance(&bf16, &wide);
    printf("note: gradient of a step against f64: f32 %.1e, bf16 %.1e\n", d32, d16);
    CHECK_NEAR("f32 gradient against f64", d32, 0, 1e-5);
    CHECK_NEAR("bf16 gradient against f64", d16, 0, 1.5e-2);
    CHECK_NEAR("f32 loss", f32.x[0], wide.x[0], 1e-6 * wide.x[0]);
    CHECK_NEAR("bf16 loss", bf16.x[0], wide.x[0], 1e-2 * wide.x[0]);
    free(wide.x);
    free(f32.x);
    free(bf16.x);
}

/* ---------------------------------------------------------------- threads */

static void same_bits(net_size s)
{
    static const int threads[] = { 1, 2, 3, 7 };
    int before = dar_threads();
    void *first = NULL;
    double loss0[STEPS];
    for (size_t k = 0; k < DAR_COUNT(threads); k++) {
        struct trainer r;
        dar_threads_set(threads[k]);
        trainer_init(&r, s, false);
        for (int i = 0; i < STEPS; i++) {
            double loss = train(&r);
            if (!k) loss0[i] = loss;
            CHECK(memcmp(&loss, &loss0[i], sizeof loss) == 0,
                  "%s: loss of step %d is %.17g with %d threads, %.17g with 1", dar_dtype_name(s.storage), i, loss,
                  threads[k], loss0[i]);
        }
        if (!k) {
            first = malloc(r.weights.used);
            memcpy(first, r.weights.base, r.weights.used);
        }
        CHECK(memcmp(first, r.weights.base, r.weights.used) == 0, "%s: weights differ with %d threads",
              dar_dtype_name(s.storage), threads[k]);
        trainer_free(&r);
    }
    CHECK(loss0[STEPS - 1] < loss0[0], "%s: the loss does not fall: %.9g to %.9g", dar_dtype_name(s.storage), loss0[0],
          loss0[STEPS - 1]);
    free(first);
    dar_threads_set(before);
}

static void threads_give_the_same_bits(void **state)
{
    (void)state;
    same_bits(sized(DAR_F32, 5, true));
    same_bits(sized(DAR_F32, 0, false));
    same_bits(sized(DAR_BF16, 5, false));
    same_bits(sized(DAR_F64, 5, false));
}

/* ---------------------------------------------------------------- memory */

static void peak_is_as_planned(void **state)
{
    (void)state;
    for (int keep = 0; keep < 2; keep++) {
        struct trainer plan, real;
        trainer_init(&plan, sized(DAR_BF16, 5, keep), true);
        trainer_init(&real, sized(DAR_BF16, 5, keep), false);
        gradients(&plan);
        for (int i = 0; i < 2; i++) gradients(&real);
        assert_int_equal(real.step.peak, plan.step.peak);
        assert_int_equal(real.keep.peak, plan.keep.peak);
        assert_int_equal(real.weights.peak, plan.weights.peak);
        CHECK_NEAR("forward FLOPs", plan.tape.cost.forward, real.tape.cost.forward, 0);
        CHECK_NEAR("backward FLOPs", plan.tape.cost.backward, real.tape.cost.backward, 0);
        assert_int_equal(real.tape.cost.ops, plan.tape.cost.ops);
        trainer_free(&plan);
        trainer_free(&real);
    }
}

/* A network of the 5B model's width planned on a machine that could not hold its activations unsegmented. */
static void plan_of_the_large_model(void **state)
{
    (void)state;
    struct trainer r;
    net_size s = { .blocks = 2,
                   .grid = { 21, 15, 26 },
                   .text = 512,
                   .width = 3072,
                   .heads = 24,
                   .ffn = 14336,
                   .rank = 256,
                   .storage = DAR_BF16,
                   .train = true };
    trainer_init(&r, s, true);
    gradients(&r);
    double flops = r.tape.cost.forward + r.tape.cost.backward;
    printf("note: two blocks of the 5B model at 81 frames: %.2f GB a step, %.1f TFLOP\n", (double)r.step.peak * 1e-9,
           flops * 1e-12);
    /* 98 TFLOP for 30 blocks forward (skipping_and_numerics.md 0), LoRA 9 % more; forward twice, backward about 1.6. */
    CHECK_NEAR("TFLOP of a step", flops * 1e-12, 2.0 / 30 * 98 * 1.09 * 3.6, 4);
    CHECK(r.step.peak < (size_t)8 << 30, "%zu bytes for a step of two blocks", r.step.peak);
    trainer_free(&r);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(gradient_is_right),          cmocka_unit_test(precisions_agree),
        cmocka_unit_test(threads_give_the_same_bits), cmocka_unit_test(peak_is_as_planned),
        cmocka_unit_test(plan_of_the_large_model),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
