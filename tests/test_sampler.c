/* test_sampler.c: the sampler against five steps of the public reference (scripts/make-dit-fixtures.py); what must hold
 * whatever the numbers are: skips, guidance, threads, planning. */
#include "tests/test.h"

#include "models/sampler.h"
#include "lib/rng.h"
#include "lib/rng_torch.h"
#include "lib/thread.h"
#include "tests/distance.h"
#include "tests/model.h"

static dar_weights *open_fixture(const char *path)
{
    dar_weights *f;
    dar_err e;
    CHECK(dar_weights_open(&f, path, &e) == DAR_OK, "%s", e.text);
    return f;
}

/* ---------------------------------------------------------------- the fixture's first clip */

struct bench {
    model o;
    dar_weights *weights, *lora;
    dar_arena kept;
    dar_sampler_config c;
    dar_sampler_clip clip;
    dar_tensor known, first, noise;
    bool alone; /* nothing is known of the video */
};

static dar_tensor first_clip(struct bench *b, const dar_tensor *x, dar_dtype type, int64_t rows)
{
    dar_tensor from = dar_tensor_narrow(x, 0, 0, 1);
    if (rows) from = dar_tensor_narrow(&from, 1, 0, rows);
    dar_tensor y = dar_tensor_push(&b->o.weights, type, from.shape);
    dar_tensor_copy(&y, &from);
    return y;
}

static void init(struct bench *b, dar_dtype storage)
{
    dar_config c = model_preset("dar-test");
    dar_err e;
    *b = (struct bench){ .c = dar_sampler_default() };
    b->weights = open_fixture("tests/fixtures/dit_weights.safetensors");
    b->lora = open_fixture("tests/fixtures/dit_lora.safetensors");
    model_init(&b->o, &c, storage, false);
    dar_lora_init(&b->o.m, &b->o.p, &c.lora);
    model_fixture(&b->o, b->weights);
    dar_lora_read_options o = { .alpha = c.lora.alpha, .strength = 1 };
    CHECK(dar_lora_read(&b->o.m, &b->o.p, b->lora, &o, &e) == DAR_OK, "%s", e.text);
    assert_int_equal(dar_arena_init(&b->kept, "kept", (size_t)16 << 20, &e), DAR_OK);

    dar_dtype main = b->o.p.main;
    b->clip = (dar_sampler_clip){ .frames = 3, .height = 4, .width = 6 };
    b->clip.cond = first_clip(b, &b->o.clip.cond, DAR_F32, 0);
    b->clip.text[0] = first_clip(b, &b->o.text, main, 4);
    dar_tensor second = dar_tensor_narrow(&b->o.text, 0, 1, 1);
    b->clip.text[1] = first_clip(b, &second, main, 0);
    b->known = first_clip(b, &b->o.clip.known, main, 0);
    dar_tensor latent = dar_tensor_narrow(&b->known, 1, c.dit.mask, c.dit.latent);
    b->first = first_clip(b, &latent, main, 0);
    b->noise = first_clip(b, &b->o.z, main, 0);
    b->c.solver.steps = 5;
}

static void drop(struct bench *b)
{
    model_free(&b->o);
    dar_arena_free(&b->kept);
    dar_weights_close(b->weights);
    dar_weights_close(b->lora);
}

struct walk {
    dar_weights *steps; /* NULL: nobody compares */
    size_t seen, stop;  /* stop after so many; 0: never */
    bool jumps;         /* steps may be left out */
    size_t reused;
    double worst;
};

static dar_status look(void *ctx, size_t done, const dar_tensor *z, const dar_tensor *clean, dar_err *e)
{
    struct walk *w = ctx;
    w->seen = w->jumps ? done : w->seen + 1;
    assert_int_equal(done, w->seen);
    if (w->steps) {
        char name[16];
        dar_tensor y;
        snprintf(name, sizeof name, "step.%zu", done);
        assert_int_equal(dar_weights_tensor(w->steps, name, &y, e), DAR_OK);
        double off = test_relative(z, &y);
        CHECK(off >= 0, "step %zu is not finite", done);
        w->worst = fmax(w->worst, off);
        if (done == 5) CHECK_NEAR("where the last step goes", test_relative(clean, z), 0, 1e-14); /* sigma is 0 there */
    }
    return done == w->stop ? dar_fail(e, DAR_ERR_INTERRUPTED, "enough") : DAR_OK;
}

/* Run into a fresh copy of the noise; *calls (may be NULL): of the network. */
static dar_tensor sample(struct bench *b, struct walk *w, size_t *calls)
{
    dar_err e;
    dar_sampler s;
    dar_tensor z = dar_tensor_push(&b->o.weights, b->noise.dtype, b->noise.shape);
    dar_tensor_copy(&z, &b->noise);
    dar_arena_reset(&b->kept, 0);
    dar_arena_reset(&b->o.step, 0);
    assert_int_equal(dar_sampler_init(&s, &b->o.m, &b->c, &b->clip, &b->kept, &b->o.step, &e), DAR_OK);
    size_t used = b->kept.used;
    dar_status status = dar_sampler_run(&s, b->alone ? NULL : &b->known, b->alone ? NULL : &b->first, &z, look, w, &e);
    CHECK(status == (w->stop ? DAR_ERR_INTERRUPTED : DAR_OK), "%s", e.text);
    assert_int_equal(b->kept.used, used);
    assert_int_equal(b->o.step.used, 0);
    if (calls) *calls = s.calls;
    w->reused = s.reused;
    dar_sampler_free(&s);
    return z;
}

static void same_bits(const dar_tensor *x, const dar_tensor *y)
{
    assert_int_equal(dar_tensor_bytes(x), dar_tensor_bytes(y));
    assert_memory_equal(x->data, y->data, dar_tensor_bytes(x));
}

/* ---------------------------------------------------------------- tests */

static void five_steps(void **state)
{
    (void)state;
    dar_weights *steps = open_fixture("tests/fixtures/dit_steps.safetensors");
    for (int merged = 0; merged < 2; merged++) {
        struct bench b;
        struct walk w = { .steps = steps };
        init(&b, DAR_F64);
        if (merged) dar_lora_merge(&b.o.m, &b.o.p, &b.o.step);
        sample(&b, &w, NULL);
        printf("sampler: five steps, low-rank additions %s: %.2g\n", merged ? "merged" : "apart", w.worst);
        assert_int_equal(w.seen, 5);
        CHECK_NEAR("latent", w.worst, 0, 1e-11); /* the velocity itself is within 1e-13 of the reference */
        drop(&b);
    }
    dar_weights_close(steps);
}

/* Each skip by itself, and all at once. */
static void skips_change_nothing(void **state)
{
    (void)state;
    struct bench b;
    struct walk w = { 0 };
    size_t calls;
    init(&b, DAR_F32);
    dar_tensor with = sample(&b, &w, &calls);
    assert_int_equal(calls, 10);
    for (int k = 0; k <= DAR_SKIP_LORA; k++) { /* the last: none at all */
        w = (struct walk){ 0 };
        b.c.skip = k == DAR_SKIP_LORA ? 0 : DAR_SKIPS_ALL & ~(1u << k);
        dar_tensor without = sample(&b, &w, &calls);
        double off = test_relative(&without, &with);
        printf("sampler: without %s: %.2g\n", k == DAR_SKIP_LORA ? "any skip" : dar_skip_name[k], off);
        CHECK_NEAR("latent", off, 0, 1e-5);
        assert_int_equal(calls, 10);
    }
    drop(&b);
}

/* One block alone: the first is the last.  And the guess of the velocity, without the first frame. */
static void held_in_one_block(void **state)
{
    (void)state;
    struct bench b;
    struct walk w = { 0 };
    init(&b, DAR_F64);
    b.o.m.c.layers = 1;
    b.o.m.c.precondition = true;
    dar_tensor with = sample(&b, &w, NULL);
    b.c.skip = 0, w.seen = 0;
    dar_tensor without = sample(&b, &w, NULL);
    CHECK_NEAR("latent", test_relative(&without, &with), 0, 1e-13);
    b.c.skip = DAR_SKIPS_ALL, b.alone = true, w.seen = 0; /* no first frame to hold */
    with = sample(&b, &w, NULL);
    b.c.skip = 0, w.seen = 0;
    without = sample(&b, &w, NULL);
    CHECK_NEAR("latent", test_relative(&without, &with), 0, 1e-13);
    drop(&b);
}

/* At sigma 1 the best guess of the velocity is z itself, so that one step ends at -y instead of z - y. */
static void guess_is_taken_along(void **state)
{
    (void)state;
    struct bench b;
    struct walk w = { 0 };
    init(&b, DAR_F64);
    b.c.solver.steps = 1, b.alone = true;
    dar_tensor plain = sample(&b, &w, NULL);
    b.o.m.c.precondition = true, w.seen = 0;
    dar_tensor guessed = sample(&b, &w, NULL);
    const double *z = b.noise.data, *x = plain.data, *y = guessed.data;
    for (size_t i = 0; i < dar_tensor_count(&plain); i++) CHECK_NEAR("end", y[i], x[i] - z[i], 1e-12);
    drop(&b);
}

/* ---------------------------------------------------------------- windows */

/* Every frame is seen; neighbours share what was asked for or more; all are of one length. */
static void windows_cover(void **state)
{
    (void)state;
    for (int64_t F = 2; F < 40; F++)
        for (int64_t n = 3; n < 12; n++)
            for (int64_t shared = 0; shared < n - 1; shared++) {
                dar_sampler_clip c = { .frames = F, .window = n, .overlap = shared };
                int64_t count = dar_sampler_windows(&c), before = 1;
                if (n >= F) assert_int_equal(count, 1);
                for (int64_t i = 0; i < count; i++) {
                    int64_t first = dar_sampler_window_first(&c, i);
                    if (i) CHECK(first > before && before + n - 1 - first >= shared, "F %d n %d", (int)F, (int)n);
                    else assert_int_equal(first, 1);
                    before = first;
                }
                if (count > 1) assert_int_equal(before + n - 1, F);
            }
}

/* Another clip, of these frames of the fixture's. */
static void edit(struct bench *b, const struct bench *from, const int *frame, int64_t frames)
{
    const dar_tensor *x[] = { &from->clip.cond, &from->known, &from->noise };
    dar_tensor *y[] = { &b->clip.cond, &b->known, &b->noise };
    for (int i = 0; i < 3; i++) {
        dar_shape s = x[i]->shape;
        s.d[2] = frames;
        *y[i] = dar_tensor_push(&b->o.weights, x[i]->dtype, s);
        for (int64_t f = 0; f < frames; f++) {
            dar_tensor to = dar_tensor_narrow(y[i], 2, f, 1), frame_of = dar_tensor_narrow(x[i], 2, frame[f] % 3, 1);
            dar_tensor_copy(&to, &frame_of);
        }
    }
    b->clip.frames = frames;
}

static double apart(const dar_tensor *x, int64_t i, const dar_tensor *y, int64_t k)
{
    dar_arena a;
    dar_err e;
    dar_tensor f[2] = { dar_tensor_narrow(x, 2, i, 1), dar_tensor_narrow(y, 2, k, 1) }, own[2];
    assert_int_equal(dar_arena_init(&a, "frames", 1 << 16, &e), DAR_OK);
    for (int p = 0; p < 2; p++) {
        own[p] = dar_tensor_push(&a, x->dtype, f[p].shape);
        dar_tensor_copy(&own[p], &f[p]);
    }
    double off = test_relative(&own[0], &own[1]);
    dar_arena_free(&a);
    return off;
}

static const int line[] = { 0, 1, 2, 3, 4, 5, 6, 7, 8 };

/* Windows as long as the clip are the plain run. */
static void one_window(void **state)
{
    (void)state;
    struct bench b;
    struct walk w = { 0 };
    size_t calls;
    init(&b, DAR_F64);
    struct bench from = { .clip = b.clip, .known = b.known, .noise = b.noise };
    edit(&b, &from, line, 9);
    dar_tensor plain = sample(&b, &w, &calls);
    assert_int_equal(calls, 10);
    b.clip.window = 9, b.clip.overlap = 4, w.seen = 0;
    dar_tensor one = sample(&b, &w, &calls);
    assert_int_equal(calls, 10);
    same_bits(&plain, &one);
    drop(&b);
}

static void several_windows(void **state)
{
    (void)state;
    struct bench b;
    struct walk w = { 0 };
    size_t calls;
    init(&b, DAR_F64);
    struct bench from = { .clip = b.clip, .known = b.known, .noise = b.noise };
    edit(&b, &from, line, 9);
    b.clip.window = 5, b.clip.overlap = 2; /* frames 1 2 3 4, 3 4 5 6, 5 6 7 8 */
    dar_tensor many = sample(&b, &w, &calls);
    assert_int_equal(calls, 30);
    CHECK_NEAR("first frame", apart(&many, 0, &b.first, 0), 0, 0);
    b.c.skip = 0, w.seen = 0;
    dar_tensor slow = sample(&b, &w, NULL);
    CHECK_NEAR("without skips", test_relative(&slow, &many), 0, 1e-12);

    /* Without overlap, of frames that repeat, each window gives the same: positions are those of the window. */
    b.c.skip = DAR_SKIPS_ALL, w.seen = 0;
    edit(&b, &from, line, 7);
    b.clip.window = 4, b.clip.overlap = 0; /* 1 2 3, 4 5 6 */
    many = sample(&b, &w, &calls);
    assert_int_equal(calls, 20);
    for (int f = 1; f < 4; f++) CHECK_NEAR("three frames later", apart(&many, f, &many, f + 3), 0, 0);
    drop(&b);
}

/* In a step, frames that two windows share lie between what each makes of them alone, and go over from one to the other
 * in equal parts: no frame differs from the next by more than one part of what the windows differ by. */
static void no_seam(void **state)
{
    (void)state;
    struct bench b;
    struct walk w = { 0 };
    dar_tensor alone[2];
    init(&b, DAR_F64);
    struct bench from = { .clip = b.clip, .known = b.known, .noise = b.noise };
    b.c.solver.steps = 1;
    for (int i = 0; i < 2; i++) {
        w.seen = 0;
        edit(&b, &from, (const int[2][5]){ { 0, 1, 2, 3, 4 }, { 0, 3, 4, 5, 6 } }[i], 5);
        alone[i] = sample(&b, &w, NULL);
    }
    w.seen = 0;
    edit(&b, &from, line, 7);
    b.clip.window = 5, b.clip.overlap = 2;
    dar_tensor both = sample(&b, &w, NULL);
    for (int64_t f = 1; f < 7; f++)
        for (int64_t c = 0; c < 5; c++)
            for (int64_t i = 0; i < 4 * 6; i++) {
                double x = dar_dtype_get(DAR_F64, both.data, (size_t)((c * 7 + f) * 24 + i));
                double p = f < 5 ? dar_dtype_get(DAR_F64, alone[0].data, (size_t)((c * 5 + f) * 24 + i)) : 0;
                double q = f > 2 ? dar_dtype_get(DAR_F64, alone[1].data, (size_t)((c * 5 + f - 2) * 24 + i)) : 0;
                double share = f < 3 ? 0 : f > 4 ? 1 : (double)(f - 2) / 3;
                CHECK_NEAR("between its windows", x, (1 - share) * p + share * q, 1e-13);
            }
    drop(&b);
}

static void equal_prompts_are_one(void **state)
{
    (void)state;
    struct bench b;
    struct walk w = { 0 };
    size_t calls;
    init(&b, DAR_F32);
    b.clip.text[1] = first_clip(&b, &b.clip.text[0], b.o.p.main, 0);
    dar_tensor one = sample(&b, &w, &calls);
    assert_int_equal(calls, 5);
    b.c.guidance = 1, w.seen = 0;
    dar_tensor off = sample(&b, &w, &calls);
    assert_int_equal(calls, 5);
    same_bits(&one, &off);

    b.c.guidance = 3, b.c.skip &= ~(1u << DAR_SKIP_PASS), w.seen = 0;
    dar_tensor both = sample(&b, &w, &calls);
    assert_int_equal(calls, 10);
    CHECK_NEAR("both passes", test_relative(&both, &one), 0, 1e-5);

    b.clip.text[0] = b.clip.text[1] = (dar_tensor){ 0 }; /* no token is equal to no token */
    b.c.skip = DAR_SKIPS_ALL, w.seen = 0;
    sample(&b, &w, &calls);
    assert_int_equal(calls, 5);
    drop(&b);
}

static void any_threads(void **state)
{
    (void)state;
    int threads = dar_threads();
    for (int type = DAR_F32; type <= DAR_BF16; type++) {
        struct bench b;
        dar_tensor z[3];
        init(&b, (dar_dtype)type);
        for (int n = 0; n < 3; n++) {
            struct walk w = { 0 };
            dar_threads_set(n + 1);
            z[n] = sample(&b, &w, NULL);
            same_bits(&z[n], &z[0]);
        }
        drop(&b);
    }
    dar_threads_set(threads);
}

/* With a tolerance: fewer calls, the same bits for any number of threads and with any skip left off that is exact, the
 * plain run where it is nothing. */
static void tolerance(void **state)
{
    (void)state;
    int threads = dar_threads();
    for (int k = 0; k < DAR_SOLVERS; k++) {
        struct bench b;
        struct walk w = { .jumps = true };
        dar_tensor z[3];
        size_t calls;
        init(&b, DAR_F32);
        b.c.solver.kind = (dar_solver_kind)k, b.c.solver.steps = 20;
        b.c.solver.grid = dar_solver_grid(b.c.solver.kind);
        dar_tensor plain = sample(&b, &w, NULL);
        b.c.solver.tolerance = 1e-300;
        z[0] = sample(&b, &w, &calls);
        same_bits(&z[0], &plain);
        assert_int_equal(calls, 40);
        b.c.solver.tolerance = 3e-2;
        for (int n = 0; n < 3; n++) {
            dar_threads_set(n + 1);
            z[n] = sample(&b, &w, &calls);
            same_bits(&z[n], &z[0]);
            assert_int_equal(w.seen, 20);
        }
        double off = test_relative(&z[0], &plain);
        printf("sampler: %s with a tolerance: %zu calls, %.2g from the plain run\n", dar_solver_name[k], calls, off);
        CHECK(calls < 40, "%s: %zu calls", dar_solver_name[k], calls);
        CHECK(off > 0 && off <= 3 * b.c.solver.tolerance, "%s: %g from the plain run", dar_solver_name[k], off);
        drop(&b);
    }
    dar_threads_set(threads);
}

static void guidance_tolerance(void **state)
{
    (void)state;
    int threads = dar_threads();
    struct bench b;
    struct walk w = { .jumps = true };
    size_t calls;
    init(&b, DAR_F32);
    b.c.solver.steps = 20;
    b.clip.text[1] = first_clip(&b, &b.clip.text[0], b.o.p.main, 0); /* prompts that differ little */
    dar_flow_combine(1, (double[]){ 1.02 }, (const dar_tensor *[]){ &b.clip.text[0] }, &b.clip.text[1]);
    dar_tensor plain = sample(&b, &w, NULL), z[3];
    b.c.guidance_tolerance = 1e-300;
    z[0] = sample(&b, &w, &calls);
    same_bits(&z[0], &plain);
    assert_int_equal(calls, 40);
    b.c.guidance_tolerance = 1e-2;
    for (int n = 0; n < 3; n++) {
        dar_threads_set(n + 1);
        z[n] = sample(&b, &w, &calls);
        same_bits(&z[n], &z[0]);
    }
    dar_threads_set(threads);
    double off = test_relative(&z[0], &plain);
    printf("sampler: guidance with a tolerance: %zu calls, %.2g from the plain run\n", calls, off);
    CHECK(calls > 20 && calls < 40, "%zu calls", calls);
    CHECK(off > 0 && off <= 1e-2, "%g from the plain run", off);
    b.c.skip = 0; /* nothing is shared between the prompts */
    dar_tensor slow = sample(&b, &w, NULL);
    off = test_relative(&slow, &plain); /* rounding may decide otherwise */
    CHECK(off > 0 && off <= 1e-2, "without skips: %g from the plain run", off);
    drop(&b);
}

static dar_tensor sample_reuse(struct bench *b, const char *rule, size_t *calls, size_t *reused)
{
    struct walk w = { 0 };
    dar_err e;
    CHECK(dar_reuse_read(&b->c.reuse, rule, &e) == DAR_OK, "%s", e.text);
    dar_tensor z = sample(b, &w, calls);
    *reused = w.reused;
    return z;
}

/* Rules that hold nothing are the plain run; those that do hold what they say, with the same bits for any number of
 * threads and with every skip left off. */
static void reuse(void **state)
{
    (void)state;
    static const char *const none[] = { "none", "table:1", "change:0" }, *const some[] = { "table:3", "change:0.6" };
    const int threads = dar_threads();
    size_t calls, reused;
    for (int windows = 0; windows < 2; windows++) {
        struct bench b;
        init(&b, DAR_F32);
        struct bench from = { .clip = b.clip, .known = b.known, .noise = b.noise };
        const size_t each = windows ? 6 : 2; /* calls of a step */
        b.c.solver.steps = 12;
        if (windows) edit(&b, &from, line, 9), b.clip.window = 5, b.clip.overlap = 2;
        dar_tensor plain = sample_reuse(&b, "none", &calls, &reused);
        for (size_t i = 0; i < DAR_COUNT(none); i++) {
            dar_tensor z = sample_reuse(&b, none[i], &calls, &reused);
            same_bits(&z, &plain);
            assert_int_equal(calls, 12 * each);
            assert_int_equal(reused, 0);
        }
        for (size_t i = 0; i < DAR_COUNT(some); i++) {
            dar_tensor z[3];
            for (int n = 0; n < 3; n++) {
                dar_threads_set(n + 1);
                z[n] = sample_reuse(&b, some[i], &calls, &reused);
                same_bits(&z[n], &z[0]);
            }
            dar_threads_set(threads);
            double off = test_relative(&z[0], &plain);
            printf("sampler: %s: %zu of 12 steps held, %.2g from the plain run\n", some[i], reused, off);
            assert_int_equal(calls, (12 - reused) * each);
            if (i == 0) assert_int_equal(reused, 7); /* 0, 3, 6, 9, 11 are asked */
            CHECK(reused > 0 && off > 1e-4 && off < 0.5, "%s: %zu held, off by %g", some[i], reused, off);
            b.c.skip = 0;
            dar_tensor slow = sample_reuse(&b, some[i], &calls, &reused);
            CHECK_NEAR("without skips", test_relative(&slow, &z[0]), 0, 1e-5);
            b.c.skip = DAR_SKIPS_ALL;
        }
        drop(&b);
    }
}

/* Blocks that add nothing: what is held is exact, if embedding, time and head see every step. */
static void nothing_to_reuse(void **state)
{
    (void)state;
    static const dar_projection last[] = { DAR_SELF_O, DAR_CROSS_O, DAR_FFN_DOWN };
    struct bench b;
    size_t calls, reused;
    init(&b, DAR_F64);
    for (int i = 0; i < b.o.c.dit.layers; i++)
        for (size_t k = 0; k < DAR_COUNT(last); k++) {
            dar_dit_product *p = &b.o.m.block[i].product[last[k]];
            dar_tensor_fill(&p->w->x, 0);
            dar_tensor_fill(&p->b->x, 0);
            dar_tensor_fill(&p->up->x, 0);
        }
    dar_tensor plain = sample_reuse(&b, "none", &calls, &reused), z = sample_reuse(&b, "table:4", &calls, &reused);
    assert_int_equal(reused, 3);
    same_bits(&z, &plain);
    drop(&b);
}

/* Three steps of Euler with two prompts, by hand: in the second the blocks are not run. */
static void reuse_by_hand(void **state)
{
    (void)state;
    struct bench b;
    size_t calls, reused;
    dar_tape t;
    dar_solver solver;
    dar_dit_scene scene;
    dar_dit_text text[2];
    dar_val *added[2] = { NULL }, *v[2];
    dar_err e;
    init(&b, DAR_F64);
    b.c.solver.steps = 3, b.alone = true;
    dar_tensor found = sample_reuse(&b, "table:9", &calls, &reused);
    assert_int_equal(calls, 4);

    const dar_dit *m = &b.o.m;
    dar_dit_clip clip = { .clips = 1, .frames = 3, .height = 4, .width = 6, .cond = b.clip.cond };
    assert_int_equal(dar_tape_init(&t, &b.kept, &e), DAR_OK);
    t.recording = false;
    dar_dit_scene_prepare(&t, m, &clip, &scene);
    for (int p = 0; p < 2; p++) dar_dit_text_prepare(&t, m, &b.clip.text[p], NULL, &text[p]);
    dar_solver_init(&solver, &b.c.solver, &b.noise, &b.kept);
    for (int i = 0; i < 3; i++) {
        dar_dit_time time = { &solver.time[i], 1 };
        dar_val *z = dar_leaf(&t, b.noise, NULL), *x = dar_dit_embed(&t, m, &scene, z);
        dar_dit_moment moment = dar_dit_time_embed(&t, m, 1, &time);
        for (int p = 0; p < 2; p++) {
            dar_val *y = i == 1 ? dar_add(&t, x, added[p])
                                : dar_dit_blocks(&t, m, &scene, &text[p], &moment, dar_contiguous(&t, x));
            if (i == 0) added[p] = dar_sub(&t, y, x);
            v[p] = dar_dit_velocity(&t, m, &scene, dar_dit_head(&t, m, &scene, &moment, y), z, &time);
        }
        const double h = solver.sigma[i + 1] - solver.sigma[i], g = b.c.guidance;
        dar_flow_combine(3, (double[]){ 1, h * g, h * (1 - g) }, (const dar_tensor *[]){ &b.noise, &v[0]->x, &v[1]->x },
                         &b.noise);
    }
    CHECK_NEAR("latent", test_relative(&found, &b.noise), 0, 1e-13);
    dar_tape_free(&t);
    drop(&b);
}

/* One preparation, several runs: each as if alone.  A run that was stopped leaves nothing behind. */
static void prepared_once(void **state)
{
    (void)state;
    struct bench b;
    struct walk w = { 0 };
    dar_err e;
    dar_sampler s;
    init(&b, DAR_F32);
    dar_tensor alone = sample(&b, &w, NULL);
    w = (struct walk){ .stop = 2 };
    sample(&b, &w, NULL);
    assert_int_equal(w.seen, 2);

    dar_arena_reset(&b.kept, 0);
    assert_int_equal(dar_sampler_init(&s, &b.o.m, &b.c, &b.clip, &b.kept, &b.o.step, &e), DAR_OK);
    for (int i = 0; i < 3; i++) {
        dar_tensor z = dar_tensor_push(&b.o.weights, DAR_F32, b.noise.shape);
        dar_tensor_copy(&z, &b.noise);
        bool other = i == 1; /* nothing known, in between */
        assert_int_equal(dar_sampler_run(&s, other ? NULL : &b.known, other ? NULL : &b.first, &z, NULL, NULL, &e),
                         DAR_OK);
        if (!other) same_bits(&z, &alone);
        else CHECK(test_relative(&z, &alone) > 1e-3, "the known video does not matter");
    }
    dar_sampler_free(&s);
    drop(&b);
}

static void plan_is_what_is_taken(void **state)
{
    (void)state;
    for (int k = 0; k < 2 * DAR_SOLVERS + DAR_REUSE_RULES; k++) {
        struct bench b;
        struct walk w = { .jumps = true };
        dar_arena kept, step;
        dar_sampler s;
        dar_err e;
        init(&b, DAR_F32);
        b.c.solver.kind = (dar_solver_kind)(k % DAR_SOLVERS);
        const bool reuses = k >= 2 * DAR_SOLVERS;
        b.c.solver.tolerance = b.c.guidance_tolerance = k < DAR_SOLVERS || reuses ? 0 : 0.1;
        if (reuses) b.c.reuse = (dar_reuse_config){ .rule = (dar_reuse_rule)(k - 2 * DAR_SOLVERS), .at = 2 };
        b.c.solver.grid = dar_solver_grid(b.c.solver.kind);
        b.kept.peak = b.o.step.peak = 0;
        sample(&b, &w, NULL);

        assert_int_equal(dar_arena_init_plan(&kept, "kept", &e), DAR_OK);
        assert_int_equal(dar_arena_init_plan(&step, "step", &e), DAR_OK);
        assert_int_equal(dar_sampler_init(&s, &b.o.m, &b.c, &b.clip, &kept, &step, &e), DAR_OK);
        assert_int_equal(dar_sampler_run(&s, &b.known, &b.first, &b.noise, NULL, NULL, &e), DAR_OK);
        assert_int_equal(kept.peak, b.kept.peak);
        assert_int_equal(step.peak, b.o.step.peak);
        assert_int_equal(s.calls, b.c.reuse.rule == DAR_REUSE_TABLE ? 6 : 10);
        CHECK(dar_sampler_flops(&s) > 0, "nothing is counted");
        dar_sampler_free(&s);
        dar_arena_free(&kept);
        dar_arena_free(&step);
        drop(&b);
    }
}

static void numbers_must_be_finite(void **state)
{
    (void)state;
    struct bench b;
    dar_err e;
    dar_sampler s;
    init(&b, DAR_F32);
    assert_int_equal(dar_sampler_init(&s, &b.o.m, &b.c, &b.clip, &b.kept, &b.o.step, &e), DAR_OK);
    ((float *)b.noise.data)[100] = NAN;
    assert_int_equal(dar_sampler_run(&s, NULL, NULL, &b.noise, NULL, NULL, &e), DAR_ERR_NUMERIC);
    CHECK(strstr(e.text, "step 1 of 5"), "%s", e.text);
    dar_sampler_free(&s);
    drop(&b);
}

static void noise(void **state)
{
    (void)state;
    dar_arena a;
    dar_rng_torch g;
    dar_err e;
    assert_int_equal(dar_arena_init(&a, "noise", 1 << 20, &e), DAR_OK);
    dar_shape shape = DAR_SHAPE(1, 5, 3, 4, 6);
    dar_tensor x = dar_tensor_push(&a, DAR_F32, shape), y = dar_tensor_push(&a, DAR_F64, shape);
    for (int kind = DAR_NOISE_OWN; kind <= DAR_NOISE_TORCH; kind++) {
        dar_sampler_noise((dar_noise)kind, 42, &x, &a);
        dar_sampler_noise((dar_noise)kind, 42, &y, &a);
        CHECK_NEAR("f32 and f64", test_relative(&x, &y), 0, kind == DAR_NOISE_TORCH ? 0 : 6e-8);
    }
    dar_tensor z = dar_tensor_push(&a, DAR_F32, shape);
    dar_rng_torch_seed(&g, 42);
    dar_rng_torch_normal(&g, &z);
    same_bits(&x, &z);
    dar_sampler_noise(DAR_NOISE_OWN, 43, &z, &a);
    dar_sampler_noise(DAR_NOISE_OWN, 42, &x, &a);
    CHECK(test_relative(&x, &z) > 0.1, "seeds do not matter");
    dar_arena_free(&a);
}

int main(void)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(five_steps),
        cmocka_unit_test(skips_change_nothing),
        cmocka_unit_test(held_in_one_block),
        cmocka_unit_test(guess_is_taken_along),
        cmocka_unit_test(windows_cover),
        cmocka_unit_test(one_window),
        cmocka_unit_test(several_windows),
        cmocka_unit_test(no_seam),
        cmocka_unit_test(equal_prompts_are_one),
        cmocka_unit_test(any_threads),
        cmocka_unit_test(tolerance),
        cmocka_unit_test(guidance_tolerance),
        cmocka_unit_test(reuse),
        cmocka_unit_test(nothing_to_reuse),
        cmocka_unit_test(reuse_by_hand),
        cmocka_unit_test(prepared_once),
        cmocka_unit_test(plan_is_what_is_taken),
        cmocka_unit_test(numbers_must_be_finite),
        cmocka_unit_test(noise),
    };
    return cmocka_run_group_tests_name("sampler", tests, NULL, NULL) != 0;
}
