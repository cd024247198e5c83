/* test_dit.c: the diffusion transformer against the public reference (scripts/make-dit-fixtures.py), stage by stage:
 * values and gradients; what must hold whatever the numbers are. */
#include "tests/test.h"

#include "autograd/gradcheck.h"
#include "lib/rng.h"
#include "tests/distance.h"
#include "tests/fixture.h"
#include "tests/model.h"

/* ---------------------------------------------------------------- parity */

struct parity {
    model o;
    dar_weights *weights, *lora, *stages;
    double bound, grad_bound;
    double worst, worst_grad;
};

static void parity_init(struct parity *p, dar_dtype storage, double bound, double grad_bound)
{
    dar_config c = model_preset("dar-test");
    dar_err e;
    p->weights = fixture_open("dit_weights.safetensors");
    p->lora = fixture_open("dit_lora.safetensors");
    p->stages = fixture_open("dit_stages.safetensors");
    p->bound = bound;
    p->grad_bound = grad_bound;
    p->worst = p->worst_grad = 0;
    model_init(&p->o, &c, storage, false);
    dar_lora_init(&p->o.m, &p->o.p, &c.lora);
    dar_params_train(&p->o.p, DAR_PARAM_LORA | DAR_PARAM_ADAPTER);
    model_fixture(&p->o, p->weights);
    dar_lora_read_options o = { .alpha = c.lora.alpha, .strength = 1 };
    CHECK(dar_lora_read(&p->o.m, &p->o.p, p->lora, &o, &e) == DAR_OK, "%s", e.text);
    dar_params_gradients(&p->o.p);
}

static void parity_free(struct parity *p)
{
    model_free(&p->o);
    dar_weights_close(p->weights);
    dar_weights_close(p->lora);
    dar_weights_close(p->stages);
}

static void compare(struct parity *p, const char *name, const dar_tensor *x, double bound, double *worst)
{
    dar_tensor y;
    dar_err e;
    CHECK(dar_weights_tensor(p->stages, name, &y, &e) == DAR_OK, "%s", e.text);
    CHECK(dar_tensor_count(x) == dar_tensor_count(&y), "%s: %zu numbers, expected %zu", name, dar_tensor_count(x),
          dar_tensor_count(&y));
    double d = test_relative(x, &y);
    CHECK_NEAR(name, d, 0, bound);
    *worst = fmax(*worst, d);
}

static void stage(struct parity *p, const char *name, const dar_val *x)
{
    compare(p, name, &x->x, p->bound, &p->worst);
}

/* Keys and values of the reference's 11 rows: the real ones, and one of the padding. */
static void text_stage(struct parity *p, const char *what, int block, const dar_val *x)
{
    char name[64];
    dar_tensor y, here, there;
    dar_err e;
    snprintf(name, sizeof name, "%s.%d", what, block);
    CHECK(dar_weights_tensor(p->stages, name, &y, &e) == DAR_OK, "%s", e.text);
    for (int64_t b = 0; b < 2; b++)
        for (int64_t i = 0; i <= p->o.count[b]; i++) {
            int64_t row = i < p->o.count[b] ? i : p->o.text.shape.d[1];
            here = dar_tensor_narrow(&x->x, 0, b, 1);
            there = dar_tensor_narrow(&y, 0, b, 1);
            here = dar_tensor_narrow(&here, 1, row, 1);
            there = dar_tensor_narrow(&there, 1, i, 1);
            double d = test_relative(&here, &there);
            CHECK_NEAR(name, d, 0, p->bound);
            p->worst = fmax(p->worst, d);
        }
}

static void stages(struct parity *p)
{
    model *o = &p->o;
    dar_tape *t = &o->tape;
    dar_dit_scene s;
    dar_dit_text x;
    dar_dit_time time = { model_times, 2 };
    char name[32];

    t->recording = false;
    stage(p, "adapter", dar_adapter_forward(t, &o->m.adapter, &o->clip.cond));
    dar_dit_scene_prepare(t, &o->m, &o->clip, &s);
    dar_dit_text_prepare(t, &o->m, &o->text, o->count, &x);
    dar_dit_moment e = dar_dit_time_embed(t, &o->m, 2, &time);
    stage(p, "e", e.e);
    stage(p, "e0", e.e0);
    dar_val *tokens = dar_dit_embed(t, &o->m, &s, dar_leaf(t, o->z, NULL));
    stage(p, "embed", tokens);
    for (int i = 0; i < o->c.dit.layers; i++) {
        text_stage(p, "key", i, x.k[i]);
        text_stage(p, "value", i, x.v[i]);
        tokens = dar_dit_block_forward(t, &o->m, i, &s, &x, e.e0, tokens);
        snprintf(name, sizeof name, "block.%d", i);
        stage(p, name, tokens);
    }
    stage(p, "velocity", dar_dit_head(t, &o->m, &s, &e, tokens));
    stage(p, "velocity", model_velocity(o));
    t->recording = true;
}

/* The name that the reference gives to a trainable parameter. */
static void reference_name(const dar_param *q, char *name, size_t size)
{
    dar_lora_key k;
    if (dar_lora_parse(&k, q->name, 100))
        snprintf(name, size, "gradient.blocks.%d.%s.lora_%c.weight", (int)k.block, dar_projection_names[k.projection],
                 k.part == DAR_LORA_DOWN ? 'A' : 'B');
    else snprintf(name, size, "gradient.%s", q->name);
}

static void gradients(struct parity *p)
{
    model *o = &p->o;
    size_t compared = 0;
    char name[256];

    dar_val *loss = model_loss(o);
    stage(p, "loss", loss);
    dar_backward(&o->tape, loss, NULL);
    for (size_t i = 0; i < o->p.count; i++) {
        dar_param *q = o->p.at[i];
        if (!q->trainable) continue;
        reference_name(q, name, sizeof name);
        compare(p, name, &q->g, p->grad_bound, &p->worst_grad);
        dar_tensor_fill(&q->g, 0);
        compared++;
    }
    assert_int_equal(compared, 2 * 10 * 2 + 6);
}

/* Against torch in float64: f64 to 1e-10 and 1e-9; f32 to 2e-5, gradients to 1e-4: some 60 roundings of 6e-8 in a
 * chain, each of which a normalisation may enlarge a few times. */
static void matches_the_reference(void **state)
{
    static const struct {
        dar_dtype type;
        double bound, grad_bound;
    } run[] = { { DAR_F64, 1e-10, 1e-9 }, { DAR_F32, 2e-5, 1e-4 } };
    (void)state;
    for (size_t i = 0; i < DAR_COUNT(run); i++)
        for (int replay = 0; replay < DAR_REPLAYS; replay++) {
            struct parity p;
            parity_init(&p, run[i].type, run[i].bound, run[i].grad_bound);
            stages(&p);
            p.o.m.replay = (dar_dit_replay)replay;
            gradients(&p);
            printf("note: transformer against the reference, %s, replaying %s: stages %.1e, gradients %.1e\n",
                   dar_dtype_name(run[i].type), dar_dit_replay_name[replay], p.worst, p.worst_grad);
            parity_free(&p);
        }
}

/* ---------------------------------------------------------------- the whole network's gradient */

struct probe {
    model *o;
    dar_param *q[200];
    int n;
};

static dar_val *probe_loss(dar_tape *t, void *arg, dar_val *const *in)
{
    struct probe *p = arg;
    model *o = p->o;
    dar_dit_scene *s = dar_tape_room(t, sizeof *s);
    dar_dit_text *x = dar_tape_room(t, sizeof *x);

    for (int i = 0; i < p->n; i++) p->q[i]->x = in[i]->x, p->q[i]->g = in[i]->g;
    dar_dit_scene_prepare(t, &o->m, &o->clip, s);
    dar_dit_text_prepare(t, &o->m, &o->text, o->count, x);
    dar_val *v = dar_dit_forward(t, &o->m, s, x, dar_leaf(t, o->z, NULL), &(dar_dit_time){ model_times, 2 });
    return dar_squared_error(t, v, dar_leaf(t, o->target, NULL), NULL, true);
}

/* Every trainable tensor along random directions, through the segments. */
static void check_gradient(unsigned roles, bool precondition, const char *what)
{
    dar_config c = model_preset("dar-test");
    c.dit.precondition = precondition;
    model o;
    struct probe p = { .o = &o };
    dar_tensor x[200];

    model_init(&o, &c, DAR_F64, false);
    if (roles & DAR_PARAM_LORA) dar_lora_init(&o.m, &o.p, &c.lora);
    dar_params_train(&o.p, roles);
    dar_params_fresh(&o.p, DAR_PARAM_ALL, 5);
    model_clip(&o, 2, 1, 2, 4);
    for (size_t i = 0; i < o.p.count; i++) {
        dar_param *q = o.p.at[i];
        /* What starts at zero would hide the rest. */
        if (q->info.law == DAR_FRESH_VALUE && q->info.spread == 0) dar_rng_fill_uniform(&q->x, 9, i, -0.4, 0.4);
        if (!q->trainable) continue;
        CHECK(p.n < 200, "too many parameters");
        p.q[p.n] = q;
        x[p.n++] = q->x;
    }
    /* Steps of 1e-4 at most: the adapter's ReLUs have kinks, a few hundred of them. */
    dar_gradcheck_result r = dar_gradcheck_run(
        &(dar_gradcheck){ .fn = probe_loss, .arg = &p, .n = p.n, .x = x, .gap = 1e-4, .directions = true, .seed = 3 },
        &o.step);
    printf("note: gradient of dar-test, %s, %d tensors: %.1e in %s, dot test %.1e\n", what, p.n, r.diff,
           p.q[r.input]->name, r.dot);
    CHECK(r.diff < 1e-7, "%s: %s: backward %.17g, differences %.17g", what, p.q[r.input]->name, r.found, r.expected);
    CHECK(r.dot < 1e-7, "%s: dot test %.3g", what, r.dot);
    model_free(&o);
}

static void gradient_is_right(void **state)
{
    int before = dar_threads();
    (void)state;
    dar_threads_set(1); /* waking threads would cost more than the work */
    check_gradient(DAR_PARAM_LORA | DAR_PARAM_ADAPTER, false, "LoRA and adapter");
    check_gradient(DAR_PARAM_BASE | DAR_PARAM_ADAPTER, false, "all weights");
    check_gradient(DAR_PARAM_LORA | DAR_PARAM_ADAPTER, true, "LoRA and adapter, preconditioned");
    dar_threads_set(before);
}

/* ---------------------------------------------------------------- preconditioning */

#define AT(x, i) (((const double *)(x)->data)[i])

/* The formula of dar_dit_velocity, each frame at its own time, with and without the first. */
static void guess_is_added(void **state)
{
    (void)state;
    dar_config c = model_preset("dar-test");
    model o;
    model_init(&o, &c, DAR_F64, false);
    dar_params_fresh(&o.p, DAR_PARAM_ALL, 5);
    dar_rng_fill_uniform(&o.m.head_w->x, 9, 0, -1, 1);
    model_clip(&o, 3, 1, 2, 4);
    dar_tensor plain = dar_tensor_push(&o.weights, DAR_F64, o.z.shape);
    dar_tensor_copy(&plain, &model_velocity(&o)->x);
    o.m.c.precondition = true;
    dar_tensor whole = dar_tensor_push(&o.weights, DAR_F64, o.z.shape);
    dar_tensor_copy(&whole, &model_velocity(&o)->x);
    dar_tape *t = &o.tape;
    dar_dit_scene s = { .latent = o.z.shape };
    dar_tensor rest = dar_tensor_narrow(&plain, 2, 1, 2);
    dar_val *held = dar_dit_velocity(t, &o.m, &s, dar_leaf(t, rest, NULL), dar_leaf(t, o.z, NULL),
                                     &(dar_dit_time){ model_times, 2 });
    size_t C = (size_t)o.z.shape.d[1], n = (size_t)(o.z.shape.d[3] * o.z.shape.d[4]);
    for (size_t i = 0; i < 2 * C * 3 * n; i++) {
        size_t b = i / (C * 3 * n), f = i / n % 3;
        double sigma = model_times[2 * b + (f > 0)] / 1000, square = sigma * sigma + (1 - sigma) * (1 - sigma);
        double want = (2 * sigma - 1) / square * AT(&o.z, i) + AT(&plain, i) / sqrt(square);
        CHECK_NEAR("velocity", AT(&whole, i), want, 1e-13);
        if (!f) continue;
        CHECK_NEAR("without the first", AT(&held->x, (i / n / 3 * 2 + f - 1) * n + i % n), want, 1e-13);
    }
    model_free(&o);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(matches_the_reference),
        cmocka_unit_test(gradient_is_right),
        cmocka_unit_test(guess_is_added),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
