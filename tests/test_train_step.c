/* test_train_step.c: a training step of the transformer: what it draws, what it counts, what it costs, what it learns.
 */
#include "tests/test.h"

#include "lib/kern.h"
#include "lib/rng.h"
#include "tests/fixture.h"
#include "tests/model.h"
#include "train/optim.h"
#include "train/step.h"

enum { FRAMES = 3, ROWS = 2, COLUMNS = 3, WORDS = 4 };

/* A network, a step over it, and clips to learn from. */
struct lesson {
    dar_config model;
    dar_train_config c;
    dar_arena weights, data, moments;
    dar_params p;
    dar_dit m;
    dar_step step;
    dar_step_plan plan[DAR_RECOMPUTE_ALL + 1];
    dar_batch all; /* of CLIPS */
    int64_t count[4];
};

#define CLIPS 4

static dar_train_config standard(void)
{
    return (dar_train_config){ .seed = 11,
                               .storage = DAR_F32,
                               .recompute = DAR_RECOMPUTE_MOST,
                               .rate = 1e-3,
                               .batch = 2,
                               .accumulate = 1,
                               .shift = 5,
                               .text_dropout = 0.25 };
}

static dar_tensor push(struct lesson *l, dar_shape s, uint64_t stream)
{
    dar_tensor x = dar_tensor_push(&l->data, DAR_F32, s);
    dar_rng_fill_uniform(&x, 5, stream, -1, 1);
    return x;
}

static void make_clips(struct lesson *l)
{
    const dar_dit_config *d = &l->model.dit;
    const dar_adapter_config *a = &l->model.adapter;
    int64_t h = ROWS * d->patch, w = COLUMNS * d->patch, side = 2 * a->unshuffle / d->patch;
    l->all.z0 = push(l, DAR_SHAPE(CLIPS, d->latent, FRAMES, h, w), 1);
    l->all.known = push(l, DAR_SHAPE(CLIPS, d->mask + d->latent, FRAMES, h, w), 2);
    l->all.cond = push(l, DAR_SHAPE(CLIPS, a->rays + a->geometry, FRAMES, h * side, w * side), 3);
    l->all.text = push(l, DAR_SHAPE(CLIPS, WORDS, d->text_width), 4);
    for (int64_t i = 0; i < CLIPS; i++) l->count[i] = WORDS - i;
    l->all.count = l->count;
}

static void start(struct lesson *l, const dar_train_config *c, unsigned train)
{
    dar_err e;
    memset(l, 0, sizeof *l);
    l->model = model_preset("dar-test");
    l->c = *c;
    assert_int_equal(dar_arena_init(&l->weights, "weights", (size_t)16 << 20, &e), DAR_OK);
    assert_int_equal(dar_arena_init(&l->data, "data", (size_t)16 << 20, &e), DAR_OK);
    assert_int_equal(dar_arena_init(&l->moments, "moments", (size_t)16 << 20, &e), DAR_OK);
    dar_params_init(&l->p, &l->weights, (dar_dtype)c->storage);
    dar_dit_init(&l->m, &l->p, &l->model.dit, &l->model.adapter);
    if (train & DAR_PARAM_LORA) dar_lora_init(&l->m, &l->p, &l->model.lora);
    dar_params_train(&l->p, train);
    dar_params_fresh(&l->p, DAR_PARAM_ALL, 1);
    dar_params_gradients(&l->p);
    for (size_t i = 0; i < l->p.count; i++) {
        dar_param *q = l->p.at[i]; /* zeros would hide the rest */
        if (q->info.law == DAR_FRESH_VALUE && q->info.spread == 0) dar_rng_fill_uniform(&q->x, 9, i, -0.3, 0.3);
    }
    make_clips(l);
    dar_step_size size = { c->batch, FRAMES, ROWS * l->model.dit.patch, COLUMNS * l->model.dit.patch, .words = WORDS };
    size.cond = l->all.cond.shape.d[1];
    size.pixels = l->all.cond.shape.d[3] / size.height;
    CHECK(dar_step_count(l->plan, &l->c, &l->m, &size, &e) == DAR_OK, "%s", e.text);
    dar_recompute how = dar_step_choose(&l->c, l->plan, 0);
    CHECK(dar_step_init(&l->step, &l->c, &l->m, how, &l->plan[how], &e) == DAR_OK, "%s", e.text);
}

static void stop(struct lesson *l)
{
    dar_step_free(&l->step);
    dar_dit_free(&l->m);
    dar_params_free(&l->p);
    dar_arena_free(&l->weights);
    dar_arena_free(&l->data);
    dar_arena_free(&l->moments);
}

/* Clips [first, first + n) of all. */
static dar_batch clips(const struct lesson *l, int64_t first, int64_t n)
{
    dar_batch b = l->all;
    dar_tensor *const part[] = { &b.z0, &b.known, &b.cond, &b.text };
    for (size_t i = 0; i < DAR_COUNT(part); i++) *part[i] = dar_tensor_narrow(part[i], 0, first, n);
    b.count += first;
    return b;
}

/* Gradients of step 3 of all clips; the mean loss. */
static double learn(struct lesson *l)
{
    double loss = 0;
    for (int64_t part = 0; part < l->c.accumulate; part++) {
        dar_batch b = clips(l, part * l->c.batch, l->c.batch);
        loss += dar_step_run(&l->step, &b, 3, part).loss / (double)l->c.accumulate;
    }
    return loss;
}

/* Largest distance of gradients over the largest of b's. */
static double apart(const struct lesson *a, const struct lesson *b)
{
    double most = 0, largest = 0;
    for (size_t i = 0; i < a->p.count; i++) {
        const dar_tensor *x = &a->p.at[i]->g, *y = &b->p.at[i]->g;
        for (size_t k = 0; x->data && k < dar_tensor_count(x); k++) {
            double u = dar_dtype_get(x->dtype, x->data, k), v = dar_dtype_get(y->dtype, y->data, k);
            if (!(fabs(u - v) <= most)) most = fabs(u - v);
            largest = fmax(largest, fabs(v));
        }
    }
    return most / largest;
}

#define LORA (DAR_PARAM_LORA | DAR_PARAM_ADAPTER)

/* A step in parts is the step: same clips, same noise.  Sums in another order: 20 eps of f64, whose products of 27
 * terms are summed in any order. */
static void parts_are_the_whole(void **state)
{
    (void)state;
    struct lesson a, b;
    dar_train_config c = standard();
    c.storage = DAR_F64;
    c.batch = 4;
    start(&a, &c, LORA);
    c.batch = 1;
    c.accumulate = 4;
    start(&b, &c, LORA);
    double whole = learn(&a), parts = learn(&b);
    CHECK_NEAR("loss", parts, whole, 1e-14 * whole);
    CHECK_NEAR("gradients", apart(&b, &a), 0, 1e-13);
    stop(&a);
    stop(&b);
}

/* However little is kept, the result has the same bits. */
static void ways_agree(void **state)
{
    (void)state;
    struct lesson a, b;
    dar_train_config c = standard();
    c.recompute = DAR_RECOMPUTE_NONE;
    start(&a, &c, LORA);
    double first = learn(&a);
    for (int how = DAR_RECOMPUTE_CHEAP; how <= DAR_RECOMPUTE_ALL; how++) {
        c.recompute = how;
        start(&b, &c, LORA);
        CHECK_NEAR("loss", learn(&b), first, 0);
        CHECK_NEAR("gradients", apart(&b, &a), 0, 0);
        stop(&b);
    }
    const dar_step_plan *p = a.plan;
    size_t bytes[DAR_RECOMPUTE_ALL + 1];
    for (int how = DAR_RECOMPUTE_NONE; how <= DAR_RECOMPUTE_ALL; how++) {
        bytes[how] = p[how].bytes[0] + p[how].bytes[1];
        printf("note: %s: %zu bytes, %g FLOP\n", dar_recompute_name[how], bytes[how], p[how].forward);
        if (how == DAR_RECOMPUTE_NONE) continue;
        CHECK(bytes[how] < bytes[how - 1], "%s: %zu bytes, %zu before", dar_recompute_name[how], bytes[how],
              bytes[how - 1]);
        bool more = p[how].forward > p[how - 1].forward;
        CHECK(more == (how > DAR_RECOMPUTE_CHEAP), "%s: %g FLOP, %g before", dar_recompute_name[how], p[how].forward,
              p[how - 1].forward);
    }
    a.c.recompute = DAR_RECOMPUTE_AUTO;
    assert_int_equal(dar_step_choose(&a.c, p, bytes[DAR_RECOMPUTE_NONE]), DAR_RECOMPUTE_CHEAP);
    assert_int_equal(dar_step_choose(&a.c, p, bytes[DAR_RECOMPUTE_CHEAP] - 1), DAR_RECOMPUTE_WIDE);
    assert_int_equal(dar_step_choose(&a.c, p, bytes[DAR_RECOMPUTE_WIDE] - 1), DAR_RECOMPUTE_MOST);
    assert_int_equal(dar_step_choose(&a.c, p, bytes[DAR_RECOMPUTE_MOST] - 1), DAR_RECOMPUTE_ALL);
    assert_int_equal(dar_step_choose(&a.c, p, 0), DAR_RECOMPUTE_ALL);
    stop(&a);
}

/* The plan is what a step takes, to the byte, whatever it keeps. */
static void memory_is_as_planned(void **state)
{
    (void)state;
    static const int storage[] = { DAR_F64, DAR_F32, DAR_BF16 };
    for (int how = DAR_RECOMPUTE_NONE; how <= DAR_RECOMPUTE_ALL; how++)
        for (size_t k = 0; k < DAR_COUNT(storage); k++) {
            struct lesson l;
            dar_train_config c = standard();
            c.storage = storage[k];
            c.recompute = how;
            start(&l, &c, k == 1 ? DAR_PARAM_BASE | DAR_PARAM_ADAPTER : LORA);
            learn(&l);
            assert_int_equal(l.step.step.peak, l.plan[how].bytes[0]);
            assert_int_equal(l.step.keep.peak, l.plan[how].bytes[1]);
            CHECK_NEAR("forward", l.step.tape.cost.forward, l.plan[how].forward, 0);
            CHECK_NEAR("backward", l.step.tape.cost.backward, l.plan[how].backward, 0);
            stop(&l);
        }
}

/* What becomes of the first frame. */
static void first_frame(void **state)
{
    (void)state;
    double loss[3], moved[3];
    for (int first = DAR_FIRST_EXCLUDE; first <= DAR_FIRST_NOISY; first++) {
        struct lesson l;
        dar_train_config c = standard();
        c.storage = DAR_F64;
        c.first = first;
        start(&l, &c, LORA);
        loss[first] = learn(&l);
        /* Another clean first frame changes the target there, and what the network sees everywhere: the known video and
         * the text say nothing of it. */
        dar_tensor z = dar_tensor_narrow(&l.all.z0, 2, 0, 1);
        dar_tensor_fill(&z, 40);
        moved[first] = learn(&l);
        stop(&l);
    }
    /* A target of -40 counts 1600 on a third of the numbers, where it counts at all. */
    CHECK(moved[DAR_FIRST_EXCLUDE] < 100, "excluded, yet the loss is %g", moved[DAR_FIRST_EXCLUDE]);
    CHECK(moved[DAR_FIRST_INCLUDE] > 400, "included, yet the loss is %g", moved[DAR_FIRST_INCLUDE]);
    CHECK(moved[DAR_FIRST_NOISY] > 400, "noisy, yet the loss is %g", moved[DAR_FIRST_NOISY]);
    CHECK(loss[0] != loss[1] && loss[1] != loss[2] && loss[0] != loss[2], "losses %g, %g, %g", loss[0], loss[1],
          loss[2]);
}

/* The weights of bell matter, sigma is one of the table, stratified ones lie in their part. */
static void what_is_drawn(void **state)
{
    (void)state;
    struct lesson l;
    dar_train_config c = standard();
    c.stratified = true;
    c.batch = 4;
    start(&l, &c, LORA);
    dar_batch b = clips(&l, 0, 4);
    double mean = 0;
    for (int64_t k = 0; k < 8; k++) mean += dar_step_look(&l.step, &b, k).sigma / 8;
    /* The mean of a table is 0.7476 (shift 5); quarters of it, 32 draws: within a quarter's spread over sqrt(32). */
    CHECK_NEAR("mean sigma", mean, 0.7476, 0.05);
    double before = dar_step_look(&l.step, &b, 5).loss;
    CHECK_NEAR("looked at twice", dar_step_look(&l.step, &b, 5).loss, before, 0);
    CHECK(dar_step_look(&l.step, &b, 6).loss != before, "two steps draw the same");
    l.c.seed++;
    CHECK(dar_step_look(&l.step, &b, 5).loss != before, "two seeds draw the same");
    l.c.seed--;
    l.c.weighting = DAR_FLOW_BELL;
    CHECK(dar_step_look(&l.step, &b, 5).loss != before, "weights do not count");
    stop(&l);
}

/* Text left out is no text: the loss of a clip that has none. */
static void text_is_dropped(void **state)
{
    (void)state;
    struct lesson l;
    dar_train_config c = standard();
    c.text_dropout = 1;
    start(&l, &c, LORA);
    dar_batch b = clips(&l, 0, 2);
    double dropped = dar_step_run(&l.step, &b, 0, 0).loss;
    CHECK(dar_step_look(&l.step, &b, 0).loss != dropped, "the text does not count");
    b.text = (dar_tensor){ 0 };
    CHECK_NEAR("no text", dar_step_look(&l.step, &b, 0).loss, dropped, 1e-6 * dropped);

    dar_batch other = clips(&l, 2, 2); /* one that stands for none */
    l.step.empty = dar_tensor_narrow(&other.text, 0, 0, 1);
    double empty = dar_step_look(&l.step, &b, 0).loss;
    CHECK(empty != dropped, "the empty prompt does not count");
    stop(&l);
}

/* One clip, its noise and sigma the same at every step, is learned: dar-test to a hundredth of the loss it begins
 * with. */
static void overfits(void **state)
{
    (void)state;
    struct lesson l;
    dar_train_config c = standard();
    c.batch = 1;
    start(&l, &c, DAR_PARAM_BASE | DAR_PARAM_ADAPTER);
    dar_optim_config how = { .rate = 1e-2, .beta1 = 0.9, .beta2 = 0.99, .eps = 1e-8, .max_norm = 1, .patience = 1 };
    dar_optim optim;
    dar_optim_init(&optim, &how, &l.p, &l.moments);
    dar_batch b = clips(&l, 0, 1);
    double first = 0, loss = 0;
    for (int k = 0; k < 400; k++) {
        loss = dar_step_run(&l.step, &b, 0, 0).loss;
        if (!k) first = loss;
        dar_optim_step(&optim);
    }
    printf("note: loss of one clip: %.3g at first, %.3g after 400 steps\n", first, loss);
    CHECK(loss < 0.01 * first, "the loss falls from %g to %g alone", first, loss);
    stop(&l);
}

/* ---------------------------------------------------------------- PyTorch */

/* Largest distance of a trained parameter from the fixture's, over the largest of these; the worst of all. */
static double distance_after(dar_weights *w, const dar_params *p)
{
    double worst = 0;
    for (size_t i = 0; i < p->count; i++) {
        const dar_param *q = p->at[i];
        char name[2 * DAR_PARAM_NAME];
        dar_lora_key key;
        if (!q->trainable) continue;
        if (q->info.role != DAR_PARAM_LORA) snprintf(name, sizeof name, "after.%s", q->name);
        else if (dar_lora_parse(&key, q->name, 2))
            snprintf(name, sizeof name, "after.blocks.%d.%s.lora_%c.weight", (int)key.block,
                     dar_projection_names[key.projection], key.part == DAR_LORA_DOWN ? 'A' : 'B');
        double most = 0, largest = 0;
        for (size_t k = 0; k < dar_tensor_count(&q->x); k++) {
            double x = dar_dtype_get(q->x.dtype, q->x.data, k), y = fixture_number(w, name, k);
            if (!(fabs(x - y) <= most)) most = fabs(x - y);
            largest = fmax(largest, fabs(y));
        }
        if (!(most / largest <= worst)) worst = most / largest;
    }
    return worst;
}

/* Ten steps of AdamW with warm-up and clipping, noise and times drawn alike, against the same in float64. */
static void against_torch(dar_dtype storage, double bound_loss, double bound_after)
{
    dar_train_config c = standard();
    dar_lora_read_options read = { .alpha = 1.5, .strength = 1 };
    dar_config preset = model_preset("dar-test");
    dar_weights *lora = fixture_open("dit_lora.safetensors"), *weights = fixture_open("dit_weights.safetensors"),
                *expected = fixture_open("dit_train.safetensors");
    dar_step_plan plan[DAR_RECOMPUTE_ALL + 1];
    dar_arena moments;
    dar_optim optim;
    dar_step step;
    dar_err e;
    model o;
    c.seed = 5;
    c.storage = storage;
    c.text_dropout = 0;
    model_init(&o, &preset, storage, false);
    dar_lora_init(&o.m, &o.p, &preset.lora);
    dar_params_train(&o.p, LORA);
    model_fixture(&o, weights);
    CHECK(dar_lora_read(&o.m, &o.p, lora, &read, &e) == DAR_OK, "%s", e.text);
    dar_params_gradients(&o.p);

    dar_step_size size = {
        2, 3, 4, 6, .words = 7, .cond = o.clip.cond.shape.d[1], .pixels = o.clip.cond.shape.d[3] / 4
    };
    CHECK(dar_step_count(plan, &c, &o.m, &size, &e) == DAR_OK, "%s", e.text);
    CHECK(dar_step_init(&step, &c, &o.m, DAR_RECOMPUTE_MOST, &plan[DAR_RECOMPUTE_MOST], &e) == DAR_OK, "%s", e.text);
    assert_int_equal(dar_arena_init(&moments, "moments", (size_t)16 << 20, &e), DAR_OK);
    dar_optim_config how = { .rate = 1e-3, .beta1 = 0.9, .beta2 = 0.999, .eps = 1e-8, .decay = 0.03, .max_norm = 1 };
    how.warmup = 3;
    dar_optim_init(&optim, &how, &o.p, &moments);
    dar_batch b = { .z0 = o.z, .known = o.clip.known, .cond = o.clip.cond, .text = o.text, .count = o.count };
    double worst = 0;
    for (int k = 0; k < 10; k++) {
        double loss = dar_step_run(&step, &b, k, 0).loss, norm = dar_optim_step(&optim).norm;
        worst = fmax(worst, fabs(loss / fixture_number(expected, "loss", (size_t)k) - 1));
        CHECK_NEAR("loss", loss, fixture_number(expected, "loss", (size_t)k), bound_loss);
        CHECK_NEAR("norm", norm, fixture_number(expected, "norm", (size_t)k), 10 * bound_loss);
    }
    double after = distance_after(expected, &o.p);
    printf("note: ten steps against PyTorch, %s: losses %.1e, parameters %.1e\n", dar_dtype_name(storage), worst,
           after);
    CHECK_NEAR("parameters after ten steps", after, 0, bound_after);
    dar_step_free(&step);
    dar_arena_free(&moments);
    model_free(&o);
    dar_weights_close(lora);
    dar_weights_close(weights);
    dar_weights_close(expected);
}

static void ten_steps_of_torch(void **state)
{
    (void)state;
    against_torch(DAR_F64, 1e-13, 1e-12);
    against_torch(DAR_F32, 1e-5, 1e-5);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(parts_are_the_whole),
        cmocka_unit_test(ways_agree),
        cmocka_unit_test(memory_is_as_planned),
        cmocka_unit_test(first_frame),
        cmocka_unit_test(what_is_drawn),
        cmocka_unit_test(text_is_dropped),
        cmocka_unit_test(overfits),
        cmocka_unit_test(ten_steps_of_torch),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
