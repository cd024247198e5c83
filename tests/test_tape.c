/* test_tape.c: the tape: gradients of whole networks, segments, plans, memory, and what happens when something is
 * wrong.  The network is two transformer blocks, small enough to differentiate by differences. */
#include "tests/test.h"

#include <sys/mman.h>

#include "autograd/gradcheck.h"
#include "autograd/ops.h"
#include "lib/kern.h"

/* ---------------------------------------------------------------- the network */

enum { B = 2, N = 5, D = 6, A = 2, F = 7 };
enum { X, SCALE, SHIFT, GATE, SHARED, WQ = SHARED, WK, WV, WO, NORM, UP, DOWN, BLOCK = DOWN + 1 - SHARED };
enum { LEAVES = SHARED + 2 * BLOCK };
enum { OPS = 18 }; /* calls in a block */

static dar_shape shape_of(int i)
{
    if (i == X) return DAR_SHAPE(B, N, D);
    if (i < SHARED) return DAR_SHAPE(B, 2, D);
    switch (SHARED + (i - SHARED) % BLOCK) {
    case NORM: return DAR_SHAPE(D);
    case UP: return DAR_SHAPE(F, D);
    case DOWN: return DAR_SHAPE(D, F);
    default: return DAR_SHAPE(D, D);
    }
}

/* How the network is recorded: all of it, each block and each feed-forward part as a segment; that part cut in pieces;
 * attention kept. */
struct mode {
    bool whole, segments, nested, cut, kept;
    dar_val *const *leaf;
    struct half {
        const struct mode *mode;
        dar_val *const *w; /* weights of the block, from WQ on */
    } half[2];
};

/* x w^T: [B, N, I], [O, I] -> [B, N, O], from ops that know nothing of products. */
static dar_val *product(dar_tape *t, dar_val *x, dar_val *w)
{
    x = dar_reshape(t, x, DAR_SHAPE(x->x.shape.d[0], x->x.shape.d[1], 1, x->x.shape.d[2]));
    return dar_sum(t, dar_mul(t, x, w), 1u << 3, false);
}

static dar_val *feed_forward(dar_tape *t, void *arg, dar_val *const *in)
{
    const struct half *h = arg;
    dar_val *y = dar_rms_norm(t, in[0], h->w[NORM - WQ], &(dar_norm_opt){ .eps = 1e-6 });
    y = dar_gelu_tanh(t, product(t, y, h->w[UP - WQ]));
    y = product(t, y, h->w[DOWN - WQ]);
    return h->mode->cut ? dar_add(t, y, in[0]) : dar_add(t, in[0], y); /* the first is handed the gradient of the sum */
}

static dar_val *feed_forward_rows(dar_tape *t, void *arg, dar_val *const *in, dar_rows r)
{
    assert_int_equal(in[0]->x.shape.d[1], r.count);
    return feed_forward(t, arg, in);
}

static dar_val *block(dar_tape *t, void *arg, dar_val *const *in)
{
    struct half *h = arg;
    dar_rows_attr rows = { .fn = feed_forward_rows, .arg = h, .cut = DAR_KEEP_X(0), .most = 2 };
    dar_val *x = in[0];
    dar_val *y = dar_modulate(t, x, in[1], in[2], &(dar_norm_opt){ .eps = 1e-6, .split = 2 });
    dar_val *q = product(t, y, h->w[0]), *k = product(t, y, h->w[WK - WQ]), *v = product(t, y, h->w[WV - WQ]);
    y = dar_attention(t, q, k, v, &(dar_attention_opt){ .heads = A, .keep = h->mode->kept ? DAR_KEEP_ALL : 0 });
    x = dar_gate(t, x, product(t, y, h->w[WO - WQ]), in[3], (dar_gate_attr){ .split = 2 });
    if (!h->mode->nested) return feed_forward(t, h, &x);
    if (!h->mode->cut) return dar_segment(t, feed_forward, h, &x, 1, x->x.dtype, x->x.shape);
    rows.unread = h->mode->segments;
    rows.type = x->x.dtype;
    rows.shape = x->x.shape;
    return dar_segment_rows(t, &rows, &x, 1);
}

static dar_val *blocks(dar_tape *t, void *arg, dar_val *const *in)
{
    struct mode *m = arg;
    dar_val *x = in[X];
    for (int i = 0; i < 2; i++) {
        dar_val *to[] = { x, in[SCALE], in[SHIFT], in[GATE] };
        m->half[i] = (struct half){ m, m->leaf + SHARED + i * BLOCK };
        if (m->segments) x = dar_segment(t, block, &m->half[i], to, 4, x->x.dtype, x->x.shape);
        else x = block(t, &m->half[i], to);
    }
    return x;
}

static dar_val *network(dar_tape *t, void *arg, dar_val *const *leaf)
{
    struct mode *m = arg;
    m->leaf = leaf;
    if (!m->whole) return blocks(t, m, leaf);
    return dar_segment(t, blocks, m, leaf, SHARED, leaf[X]->x.dtype, leaf[X]->x.shape);
}

/* ---------------------------------------------------------------- a step */

/* The model's memory: values and gradients of every leaf, and a target. */
struct model {
    dar_arena memory;
    dar_tensor x[LEAVES], g[LEAVES], target;
    unsigned long frozen; /* bits of leaves */
};

struct step {
    double loss;
    size_t peak, keep_peak, keep_used;
    dar_cost cost;
};

static struct model model;
static dar_arena arena, keep, plan, plan_keep;
static dar_tape tape;

static dar_tensor random_tensor(dar_arena *a, dar_dtype type, dar_shape s, uint64_t seed)
{
    dar_tensor x = dar_tensor_push(a, type, s);
    for (size_t j = 0; j < dar_tensor_count(&x); j++)
        dar_dtype_set(type, x.data, j, (float)dar_gradcheck_random(seed, j));
    return x;
}

static void make_model(dar_dtype type)
{
    dar_arena_reset(&model.memory, 0);
    model.frozen = 0;
    for (int i = 0; i < LEAVES; i++) {
        model.x[i] = random_tensor(&model.memory, type, shape_of(i), 10 + (uint64_t)i);
        model.g[i] = dar_tensor_push(&model.memory, dar_compute_type(type), shape_of(i));
    }
    model.target = random_tensor(&model.memory, type, shape_of(X), 99);
}

static void clear_gradients(void)
{
    for (int i = 0; i < LEAVES; i++) dar_tensor_fill(&model.g[i], 0);
}

/* Forward, loss, backward; on planning arenas only counted. */
static struct step run(dar_arena *a, dar_arena *k, struct mode m)
{
    dar_val *leaf[LEAVES];
    struct step s = { 0 };

    dar_arena_reset(a, 0);
    dar_arena_reset(k, 0);
    a->peak = k->peak = 0;
    dar_tape_clear(&tape);
    tape.arena = a;
    tape.keep = k;
    tape.recording = true;
    for (int i = 0; i < LEAVES; i++) leaf[i] = dar_leaf(&tape, model.x[i], model.frozen >> i & 1 ? NULL : &model.g[i]);
    dar_val *y = network(&tape, &m, leaf);
    y = dar_squared_error(&tape, y, dar_leaf(&tape, model.target, NULL), NULL, true);
    dar_backward(&tape, y, NULL);
    if (!a->plan) s.loss = dar_dtype_get(y->x.dtype, y->x.data, 0);
    s.peak = a->peak;
    s.keep_used = k->used;
    s.keep_peak = k->peak;
    s.cost = tape.cost;
    return s;
}

static const struct mode modes[] = {
    { .segments = false },
    { .segments = true },
    { .segments = true, .kept = true },
    { .segments = true, .nested = true },
    { .segments = true, .nested = true, .kept = true },
    { .nested = true },
    { .whole = true, .segments = true, .kept = true },
    { .nested = true, .cut = true },
    { .segments = true, .nested = true, .cut = true, .kept = true },
};

#define UNCUT 7 /* of them: the others sum gradients of weights in another order */

/* The gradients of every leaf, one after the other. */
static size_t all_gradients(double *to)
{
    size_t n = 0;
    for (int i = 0; i < LEAVES; i++)
        for (size_t j = 0; j < dar_tensor_count(&model.g[i]); j++)
            to[n++] = dar_dtype_get(model.g[i].dtype, model.g[i].data, j);
    return n;
}

#define MOST 4096

static void same(const char *what, const double *found, const double *expected, size_t n)
{
    for (size_t j = 0; j < n; j++)
        CHECK(memcmp(found + j, expected + j, sizeof *found) == 0, "%s: gradient %zu is %.17g, expected %.17g", what, j,
              found[j], expected[j]);
}

/* ---------------------------------------------------------------- gradients */

static void network_gradients(void **state)
{
    bool frozen[LEAVES] = { false };
    (void)state;
    make_model(DAR_F64);
    dar_threads_set(1);
    for (size_t i = 0; i < DAR_COUNT(modes); i++) {
        struct mode m = modes[i];
        dar_gradcheck c = { .fn = network, .arg = &m, .n = LEAVES, .x = model.x, .frozen = frozen, .seed = 3 };
        frozen[X] = i == 1; /* only inner leaves */
        dar_gradcheck_result r = dar_gradcheck_run(&c, &arena);
        CHECK(r.diff <= 1e-8, "mode %zu: leaf %d[%lld]: %.17g, differences say %.17g", i, r.input, (long long)r.element,
              r.found, r.expected);
        CHECK(r.dot <= 1e-12, "mode %zu: dot test %.3g", i, r.dot);
    }
}

/* Segments, nested or not, with results kept or not: the same bits, for any number of threads; those that are cut have
 * their own, whatever is around them. */
static void segments_change_nothing(void **state)
{
    static double expected[MOST], found[MOST], whole[MOST];
    static const int threads[] = { 1, 2, 3, 7 };
    static const unsigned long frozen[] = { 0, 1ul << X, ~0ul << (SHARED + BLOCK), ~(1ul << WO) };
    (void)state;
    make_model(DAR_F32);
    for (size_t k = 0; k < DAR_COUNT(frozen); k++) {
        model.frozen = frozen[k];
        dar_threads_set(1);
        clear_gradients();
        struct step first = run(&arena, &keep, modes[0]);
        size_t n = all_gradients(expected);
        for (size_t i = 0; i < DAR_COUNT(modes); i++) {
            for (size_t j = 0; j < DAR_COUNT(threads); j++) {
                char what[64];
                snprintf(what, sizeof what, "mode %zu, frozen %#lx, %d threads", i, frozen[k], threads[j]);
                dar_threads_set(threads[j]);
                clear_gradients();
                struct step s = run(&arena, &keep, modes[i]);
                CHECK(s.loss == first.loss, "%s: loss %.17g, expected %.17g", what, s.loss, first.loss);
                assert_int_equal(all_gradients(found), n);
                if (i == UNCUT && !j) {
                    memcpy(whole, expected, n * sizeof *whole);
                    memcpy(expected, found, n * sizeof *found);
                }
                same(what, found, expected, n);
            }
        }
        /* Sums of B N terms of size 1, in f32, in another order. */
        for (size_t j = 0; j < n; j++) CHECK_NEAR("cut", expected[j], whole[j], B * N * 1.2e-7 * (1 + fabs(whole[j])));
    }
}

/* Two steps on the same gradients add up; a value used twice gets both. */
static void gradients_add_up(void **state)
{
    static double once[MOST], both[MOST];
    (void)state;
    make_model(DAR_F64);
    for (size_t i = 0; i < DAR_COUNT(modes); i++) {
        clear_gradients();
        run(&arena, &keep, modes[i]);
        size_t n = all_gradients(once);
        run(&arena, &keep, modes[i]);
        all_gradients(both);
        for (size_t j = 0; j < n; j++) CHECK_NEAR("two micro-batches", both[j], 2 * once[j], 1e-14);
    }
    double x = 3, g = 0;
    dar_tensor tx = dar_tensor_of(DAR_F64, (dar_shape){ 0 }, &x), tg = dar_tensor_of(DAR_F64, (dar_shape){ 0 }, &g);
    dar_tape_clear(&tape);
    dar_val *v = dar_leaf(&tape, tx, &tg), *w = dar_mul(&tape, v, v);
    dar_backward(&tape, dar_add(&tape, dar_mul(&tape, w, w), v), NULL); /* x^4 + x */
    CHECK_NEAR("4 x^3 + 1", g, 109, 0);
}

/* ---------------------------------------------------------------- work */

static void frozen_costs_nothing(void **state)
{
    (void)state;
    float x[3] = { 1, 2, 3 }, g[3] = { 0 };
    dar_shape s = DAR_SHAPE(3);
    dar_tensor tx = dar_tensor_of(DAR_F32, s, x), tg = dar_tensor_of(DAR_F32, s, g);

    dar_tape_clear(&tape);
    dar_val *v = dar_silu(&tape, dar_silu(&tape, dar_leaf(&tape, tx, NULL)));
    CHECK(!v->wants_grad && !tape.last, "frozen values were recorded");
    CHECK_ABORTS(dar_backward(&tape, v, &tg));
    v = dar_mul(&tape, v, dar_leaf(&tape, tx, &tg));
    v = dar_sum(&tape, v, DAR_ALL_DIMS, false);
    assert_int_equal(tape.cost.ops, 4);
    dar_backward(&tape, v, NULL);
    assert_int_equal(tape.cost.ops, 6); /* sum and mul, not the two silu */

    make_model(DAR_F32);
    model.frozen = (1ul << (SHARED + BLOCK)) - 1;         /* the second block's weights are all that learns */
    size_t forward = 2 * OPS + 1, backward = OPS - 1 + 1; /* the loss is one more, the first norm one less */
    assert_int_equal(run(&arena, &keep, modes[0]).cost.ops, forward + backward);
    assert_int_equal(run(&arena, &keep, modes[1]).cost.ops, forward + OPS + backward); /* one block is replayed */
    model.frozen = 0;
    assert_int_equal(run(&arena, &keep, modes[0]).cost.ops, 2 * forward);
    assert_int_equal(run(&arena, &keep, modes[1]).cost.ops, 2 * forward + 2 * OPS);
}

static void kept_results_save_work(void **state)
{
    static double expected[MOST], found[MOST];
    (void)state;
    make_model(DAR_F32);
    for (size_t i = 1; i < 5; i += 2) {
        clear_gradients();
        struct step computed = run(&arena, &keep, modes[i]);
        size_t n = all_gradients(expected);
        clear_gradients();
        struct step kept = run(&arena, &keep, modes[i + 1]);
        all_gradients(found);
        same("kept", found, expected, n);
        assert_int_equal(kept.cost.ops, computed.cost.ops - 2); /* one attention per block */
        assert_int_equal(computed.keep_peak, 0);
        assert_true(kept.keep_peak >= 2 * B * N * D * sizeof(float));
    }
    struct step whole = run(&arena, &keep, modes[6]); /* what inner segments keep lives as long as the replay */
    assert_true(whole.keep_peak >= 2 * B * N * D * sizeof(float));
    assert_int_equal(whole.keep_used, 0);
}

/* ---------------------------------------------------------------- memory */

/* A plan costs nothing and knows everything. */
static void plans_are_exact(void **state)
{
    (void)state;
    make_model(DAR_F32);
    for (size_t i = 0; i < DAR_COUNT(modes); i++) {
        struct step real = run(&arena, &keep, modes[i]), planned = run(&plan, &plan_keep, modes[i]);
        CHECK(real.peak == planned.peak, "mode %zu: %zu bytes, planned %zu", i, real.peak, planned.peak);
        assert_int_equal(real.keep_peak, planned.keep_peak);
        assert_int_equal(real.cost.ops, planned.cost.ops);
        assert_true(real.cost.forward == planned.cost.forward && real.cost.backward == planned.cost.backward);
        assert_true(real.cost.forward > 0 && real.cost.backward > 0);
    }
    size_t recorded = run(&arena, &keep, modes[0]).peak, replayed = run(&arena, &keep, modes[1]).peak;
    CHECK(replayed < recorded, "segments need %zu bytes, recording everything %zu", replayed, recorded);
}

static size_t infer(struct mode m, double *y)
{
    dar_val *leaf[LEAVES];
    dar_arena_reset(&arena, 0);
    arena.peak = 0;
    dar_tape_clear(&tape);
    tape.recording = y == NULL;
    for (int i = 0; i < LEAVES; i++) leaf[i] = dar_leaf(&tape, model.x[i], &model.g[i]);
    dar_val *r = network(&tape, &m, leaf);
    CHECK(r->wants_grad == tape.recording, "recording is %d", tape.recording);
    for (size_t j = 0; y && j < B * N * D; j++) y[j] = dar_dtype_get(r->x.dtype, r->x.data, j);
    return arena.peak;
}

static void inference_is_the_same(void **state)
{
    double y[B * N * D], z[B * N * D];
    (void)state;
    make_model(DAR_F32);
    size_t recorded = infer(modes[0], NULL), straight = infer(modes[0], y), segmented = infer(modes[1], z);
    same("inference", z, y, B * N * D);
    CHECK(straight < recorded, "inference: %zu bytes, recorded %zu", straight, recorded);
    CHECK(segmented < straight, "inference in segments: %zu bytes, without %zu", segmented, straight);
    tape.recording = true;
}

/* Every allocation of the library passes here (the Makefile wraps them).  volatile: compilers know that malloc touches
 * no variable of ours. */
static volatile size_t allocations;
static volatile bool counting;

#define WRAPPED(type, name, params, ...)                                                                               \
    type __real_##name params;                                                                                         \
    type __wrap_##name params;                                                                                         \
    type __wrap_##name params                                                                                          \
    {                                                                                                                  \
        allocations += counting;                                                                                       \
        return __real_##name(__VA_ARGS__);                                                                             \
    }

WRAPPED(void *, malloc, (size_t n), n)
WRAPPED(void *, calloc, (size_t n, size_t size), n, size)
WRAPPED(void *, realloc, (void *p, size_t n), p, n)
WRAPPED(void *, aligned_alloc, (size_t align, size_t n), align, n)
WRAPPED(int, posix_memalign, (void **p, size_t align, size_t n), p, align, n)
WRAPPED(void *, mmap, (void *p, size_t n, int prot, int flags, int fd, off_t at), p, n, prot, flags, fd, at)

static void steps_do_not_allocate(void **state)
{
    size_t meta = 0, peak = 0;
    (void)state;
    make_model(DAR_F32);
    counting = true;
    allocations = 0;
    void *volatile p = malloc(1); /* the count works */
    free(p);
    assert_int_equal(allocations, 1);
    for (size_t i = 0; i < DAR_COUNT(modes); i++) {
        for (int k = 0; k < 3; k++) {
            allocations = 0;
            struct step s = run(&arena, &keep, modes[i]);
            if (k) assert_int_equal(allocations, 0);
            if (k) assert_int_equal(tape.meta.used, meta); /* a step leaves nothing behind */
            if (k) assert_int_equal(s.peak, peak);
            meta = tape.meta.used;
            peak = s.peak;
        }
    }
    counting = false;
}

/* ---------------------------------------------------------------- segments at their edges */

static dar_val *hand_through(dar_tape *t, void *arg, dar_val *const *in)
{
    (void)t, (void)arg;
    return in[0];
}

static dar_val *view_through(dar_tape *t, void *arg, dar_val *const *in)
{
    (void)arg;
    return dar_permute(t, in[0], (int[]){ 1, 0 });
}

static dar_val *hand_leaf(dar_tape *t, void *arg, dar_val *const *in)
{
    (void)t, (void)in;
    return *(dar_val **)arg;
}

static dar_val *square(dar_tape *t, void *arg, dar_val *const *in)
{
    (void)arg;
    return dar_mul(t, in[0], in[1]);
}

static dar_val *times_leaf(dar_tape *t, void *arg, dar_val *const *in)
{
    return dar_mul(t, in[0], *(dar_val **)arg);
}

static dar_val *both_ways(dar_tape *t, void *arg, dar_val *const *in)
{
    (void)arg;
    return dar_mul(t, dar_silu(t, in[0]), dar_gelu_tanh(t, in[1]));
}

static dar_val *half_used(dar_tape *t, void *arg, dar_val *const *in)
{
    (void)arg;
    dar_silu(t, in[1]); /* whose result nobody wants */
    return dar_silu(t, in[0]);
}

/* f(x, z) for leaves x and z [2, 3], each case with a segment in the middle. */
static dar_val *edges(dar_tape *t, void *arg, dar_val *const *in)
{
    dar_shape s = DAR_SHAPE(2, 3);
    dar_val *x = in[0], *z = in[1], *h = dar_silu(t, x);
    static dar_val *leaf; /* outlives this call, as what a segment's arg points to must */
    leaf = z;
    switch (*(const int *)arg) {
    case 0: return dar_segment(t, hand_through, NULL, &h, 1, DAR_F64, s);
    case 1: return dar_segment(t, hand_through, NULL, &x, 1, DAR_F64, s);
    case 2: return dar_segment(t, view_through, NULL, &h, 1, DAR_F64, DAR_SHAPE(3, 2));
    case 3: return dar_add(t, h, dar_segment(t, hand_leaf, &leaf, &h, 1, DAR_F64, s));
    case 4: return dar_segment(t, square, NULL, (dar_val *[]){ h, h }, 2, DAR_F64, s);
    case 5: return dar_segment(t, square, NULL, (dar_val *[]){ z, z }, 2, DAR_F64, s);
    case 6: return dar_segment(t, times_leaf, &leaf, &z, 1, DAR_F64, s); /* input and leaf are one value */
    case 7: return dar_add(t, h, dar_segment(t, half_used, NULL, (dar_val *[]){ h, dar_silu(t, z) }, 2, DAR_F64, s));
    case 8:
        h = dar_segment(t, times_leaf, &leaf, &h, 1, DAR_F64, s); /* one segment after the other */
        return dar_mul(t, h, dar_segment(t, times_leaf, &leaf, &h, 1, DAR_F64, s));
    default: return dar_segment(t, both_ways, NULL, (dar_val *[]){ h, h }, 2, DAR_F64, s);
    }
}

/* Views of all kinds, read by ops that take them strided and by ops that do not, and used more than once. */
static dar_val *views(dar_tape *t, void *arg, dar_val *const *in)
{
    (void)arg;
    dar_val *x = dar_silu(t, in[0]);                                              /* [2, 3] */
    dar_val *flat = dar_reshape(t, x, DAR_SHAPE(6));                              /* the same memory */
    dar_val *part = dar_slice(t, flat, 0, 1, 4);                                  /* [4] */
    dar_val *turned = dar_permute(t, x, (int[]){ 1, 0 });                         /* [3, 2], strided */
    dar_val *back = dar_reshape(t, turned, DAR_SHAPE(2, 3));                      /* copied */
    dar_val *two = dar_slice(t, dar_permute(t, in[1], (int[]){ 1, 0 }), 1, 1, 1); /* [3, 1] */
    dar_val *y = dar_mul(t, dar_add(t, x, back), dar_reshape(t, flat, DAR_SHAPE(2, 3)));
    y = dar_add(t, dar_permute(t, y, (int[]){ 1, 0 }), two);
    return dar_concat(t, (dar_val *[]){ dar_reshape(t, y, DAR_SHAPE(6)), part }, 2, 0);
}

static void segment_edges(void **state)
{
    dar_tensor x[2];
    (void)state;
    dar_arena_reset(&model.memory, 0);
    for (uint64_t i = 0; i < 2; i++) x[i] = random_tensor(&model.memory, DAR_F64, DAR_SHAPE(2, 3), 5 + i);
    for (int kind = 0; kind < 11; kind++) {
        dar_gradcheck c = { .fn = kind < 10 ? edges : views, .arg = &kind, .n = 2, .x = x, .seed = 8 };
        dar_gradcheck_result r = dar_gradcheck_run(&c, &arena);
        CHECK(r.diff <= 1e-8, "case %d: input %d[%lld]: %.17g, differences say %.17g", kind, r.input,
              (long long)r.element, r.found, r.expected);
        CHECK(r.dot <= 1e-12, "case %d: dot test %.3g", kind, r.dot);
    }
}

/* ---------------------------------------------------------------- gradients in bf16 */

#define LINKS 7

static dar_val *link_of(dar_tape *t, int i, dar_val *x, dar_val *aside)
{
    switch (i) {
    case 0: return dar_silu(t, x);
    case 1: return dar_rms_norm(t, x, NULL, &(dar_norm_opt){ .eps = 1e-6 });
    case 2: return dar_add(t, x, aside);
    case 3: return dar_add(t, dar_silu(t, x), x);
    case 4: return dar_gelu_tanh(t, x);
    case 5: return dar_reshape(t, dar_reshape(t, x, DAR_SHAPE(8, 5)), DAR_SHAPE(5, 8));
    default: return dar_silu(t, dar_gelu_tanh(t, x));
    }
}

struct links {
    int from, to;
};

/* in: x, and what one link alone reads */
static dar_val *links(dar_tape *t, void *arg, dar_val *const *in)
{
    const struct links *l = arg;
    dar_val *x = in[0];
    for (int i = l->from; i < l->to; i++) x = link_of(t, i, x, in[1]);
    return x;
}

/* arg: bits of links before which a segment ends */
static dar_val *cut_links(dar_tape *t, void *arg, dar_val *const *in)
{
    dar_val *x = in[0];
    for (int from = 0, to; from < LINKS; from = to) {
        to = from + 1;
        while (to < LINKS && !(*(unsigned *)arg >> to & 1)) to++;
        struct links *l = dar_tape_store(t, &(struct links){ from, to }, sizeof *l);
        x = dar_segment(t, links, l, (dar_val *[]){ x, in[1] }, 2, x->x.dtype, x->x.shape);
    }
    return x;
}

/* Which gradients are bf16 does not depend on where segments begin and end: wherever the links are cut, alone or inside
 * one more segment, the leaves' gradients are the same bits. */
static void half_gradients_stay(void **state)
{
    static double expected[MOST], found[MOST];
    dar_tensor x[2], g[2], seed;
    (void)state;
    dar_arena_reset(&model.memory, 0);
    for (uint64_t i = 0; i < 2; i++) {
        x[i] = random_tensor(&model.memory, DAR_BF16, DAR_SHAPE(5, 8), 5 + i);
        g[i] = dar_tensor_push(&model.memory, DAR_F32, x[i].shape);
    }
    seed = random_tensor(&model.memory, DAR_F32, x[0].shape, 7);
    size_t n = dar_tensor_count(&seed);
    for (unsigned run = 0; run < 1u << LINKS; run++) {
        unsigned cuts = run & ~1u; /* 0: none */
        bool nested = run & 1;
        dar_val *in[2], *y;
        char what[64];
        dar_tape_clear(&tape);
        dar_arena_reset(&arena, 0);
        for (int i = 0; i < 2; i++) {
            dar_tensor_fill(&g[i], 0);
            in[i] = dar_silu(&tape, dar_leaf(&tape, x[i], &g[i]));
        }
        if (nested) y = dar_segment(&tape, cut_links, &cuts, in, 2, DAR_BF16, x[0].shape);
        else if (cuts) y = cut_links(&tape, &cuts, in);
        else y = links(&tape, &(struct links){ 0, LINKS }, in);
        dar_backward(&tape, dar_gelu_tanh(&tape, y), &seed);
        for (int i = 0; i < 2; i++)
            for (size_t j = 0; j < n; j++) found[i * n + j] = dar_dtype_get(DAR_F32, g[i].data, j);
        if (run == 0) memcpy(expected, found, 2 * n * sizeof *found);
        snprintf(what, sizeof what, "cut %#x%s", cuts, nested ? ", nested" : "");
        same(what, found, expected, 2 * n);
    }
}

/* ---------------------------------------------------------------- memory that is free again */

/* Blocks are disjoint, joined where they touch, and what is taken from them lies in them. */
static void spare_memory(void **state)
{
    (void)state;
    static dar_spare s;
    unsigned char *p[8];
    dar_arena_reset(&arena, 0);
    memset(&s, 0, sizeof s);
    for (int i = 0; i < 8; i++) p[i] = dar_spare_take(&s, &arena, 1000);
    size_t used = arena.used;
    assert_int_equal(used, 8 * 1024);
    dar_spare_give(&s, p[1], 1000, false);
    dar_spare_give(&s, p[3], 1000, false);
    dar_spare_give(&s, p[5], 1000, true); /* as if of another arena */
    dar_spare_give(&s, p[4], 1000, false);
    assert_int_equal(s.count, 3);
    assert_ptr_equal(dar_spare_take(&s, &arena, 2000), p[3]);
    assert_ptr_equal(dar_spare_take(&s, &arena, 1024), p[1]);
    dar_spare_give(&s, p[3], 2048, false);
    dar_spare_give(&s, p[1], 1024, false);
    dar_spare_give(&s, p[2], 1024, false); /* between the two */
    assert_int_equal(s.count, 2);
    assert_ptr_equal(dar_spare_take(&s, &arena, 4096), p[1]);
    assert_int_equal(arena.used, used);
    dar_spare_give(&s, p[7], 1000, false);
    assert_ptr_equal(dar_spare_take(&s, &arena, 3072), p[7]); /* the last block, and more behind it */
    assert_int_equal(arena.used, used + 2048);
    dar_spare_give(&s, p[0], 1000, false);
    dar_spare_give(&s, p[1], 4096, false);
    assert_ptr_equal(dar_spare_take(&s, &arena, 1024), p[5]);     /* the smallest that is large enough */
    assert_ptr_equal(dar_spare_take(&s, &arena, 1), p[7] + 3072); /* a large one stays whole */
    assert_int_equal(s.count, 1);
}

/* What is dropped is free at once, unless backward reads it. */
static dar_val *drop(dar_tape *t, void *arg, dar_val *const *in)
{
    dar_val *y = dar_silu(t, in[0]), *z = dar_affine(t, y, 2, 0);
    (void)arg;
    dar_drop(t, z);
    dar_val *w = dar_mul(t, y, y);
    CHECK(!z->x.data && y->x.data && w->x.data, "recording is %d: the wrong values are there", t->recording);
    dar_drop(t, y);
    CHECK((y->x.data != NULL) == t->recording, "recording is %d, and what backward reads is %s", t->recording,
          y->x.data ? "there" : "gone");
    return w;
}

static void dropped_values(void **state)
{
    double x[4] = { 1, 2, 3, 4 }, g[4] = { 0 }, one[4] = { 1, 1, 1, 1 };
    dar_tensor tx = dar_tensor_of(DAR_F64, DAR_SHAPE(4), x), tg = dar_tensor_of(DAR_F64, DAR_SHAPE(4), g);
    (void)state;
    dar_arena_reset(&arena, 0);
    dar_tape_clear(&tape);
    dar_val *v = dar_leaf(&tape, tx, &tg), *y = dar_silu(&tape, v);
    dar_drop(&tape, y);
    assert_non_null(y->x.data); /* not in a segment */
    tape.recording = false;
    dar_tape_place place = dar_tape_mark(&tape);
    dar_val *z = dar_silu(&tape, v);
    dar_drop(&tape, z);
    assert_null(z->x.data);
    size_t used = arena.used;
    dar_silu(&tape, v); /* where z was */
    assert_int_equal(arena.used, used);
    dar_tape_reset(&tape, place);
    assert_int_equal(tape.spare.count, 0);
    tape.recording = true;
    y = dar_segment(&tape, drop, NULL, &v, 1, DAR_F64, DAR_SHAPE(4));
    dar_backward(&tape, y, &(dar_tensor){ .dtype = DAR_F64, .shape = tx.shape, .stride = { 1 }, .data = one });
    for (int i = 0; i < 4; i++) {
        double s = 1 / (1 + exp(-x[i]));
        CHECK_NEAR("gradient of silu(x)^2", g[i], 2 * x[i] * s * (s + x[i] * s * (1 - s)), 1e-12);
    }
}

/* ---------------------------------------------------------------- wrong calls */

static void wrong_calls_abort(void **state)
{
    double x[6] = { 1, 2, 3, 4, 5, 6 }, g[6] = { 0 };
    float f[6] = { 1, 2, 3, 4, 5, 6 }, gf[6] = { 0 };
    dar_shape s = DAR_SHAPE(2, 3);
    dar_tensor tx = dar_tensor_of(DAR_F64, s, x), tg = dar_tensor_of(DAR_F64, s, g);
    dar_tensor tf = dar_tensor_of(DAR_F32, s, f), tgf = dar_tensor_of(DAR_F32, s, gf);
    (void)state;

    dar_tape_clear(&tape);
    CHECK_ABORTS(dar_leaf(&tape, tx, &tgf));
    dar_val *v = dar_leaf(&tape, tx, &tg), *w = dar_leaf(&tape, tf, &tgf);
    CHECK_ABORTS(dar_mul(&tape, v, w)); /* gradients of two types */
    CHECK_ABORTS(dar_mul(&tape, v, NULL));
    CHECK_ABORTS(dar_backward(&tape, dar_silu(&tape, v), NULL)); /* six elements and no seed */
    CHECK_ABORTS(dar_segment(&tape, hand_through, NULL, &v, 1, DAR_F64, DAR_SHAPE(6)));
    CHECK_ABORTS(dar_segment(&tape, hand_through, NULL, &v, 1, DAR_F32, s));

    dar_tape_clear(&tape);
    tape.recording = true; /* it was off in the segments that were left by a jump */
    v = dar_leaf(&tape, tx, &tg);
    dar_val *outside = dar_silu(&tape, v);
    v = dar_segment(&tape, times_leaf, &outside, &v, 1, DAR_F64, s); /* neither input nor leaf */
    CHECK_ABORTS(dar_backward(&tape, v, &tx));
    dar_tape_clear(&tape);
}

static void bad_numbers_are_named(void **state)
{
    float x[3] = { 1, 2, 3 }, g[3] = { 0 }, one = 1;
    dar_tensor tx = dar_tensor_of(DAR_F32, DAR_SHAPE(3), x), tg = dar_tensor_of(DAR_F32, DAR_SHAPE(3), g);
    dar_tensor to = dar_tensor_of(DAR_F32, DAR_SHAPE(1), &one);
    (void)state;

    dar_tape_clear(&tape);
    tape.check_finite = true;
    dar_val *v = dar_leaf(&tape, tx, &tg);
    dar_backward(&tape, dar_mean(&tape, dar_silu(&tape, v), DAR_ALL_DIMS, false), NULL);
    assert_null(tape.bad_op);
    x[1] = 3e38f;
    dar_scale(&tape, dar_add(&tape, dar_relu(&tape, v), v), 2);
    assert_string_equal(tape.bad_op, "add");
    assert_false(tape.bad_backward);
    assert_int_equal(tape.bad_index, 1);
    dar_tape_clear(&tape);
    assert_null(tape.bad_op);

    x[1] = 0;
    v = dar_slice(&tape, dar_scale(&tape, dar_silu(&tape, dar_leaf(&tape, tx, &tg)), 1e30), 0, 1, 1);
    dar_val *z = dar_scale(&tape, v, 1e10); /* 0, with a slope of 1e40 */
    dar_backward(&tape, z, &to);
    assert_string_equal(tape.bad_op, "affine");
    assert_true(tape.bad_backward);
    tape.check_finite = false;
    dar_tape_clear(&tape);
}

/* ---------------------------------------------------------------- */

static int before(void **state)
{
    (void)state;
    dar_threads_set(2);
    tape.arena = &arena;
    tape.keep = &keep;
    tape.recording = true;
    tape.check_finite = false;
    dar_tape_clear(&tape);
    dar_arena_reset(&arena, 0);
    dar_arena_reset(&keep, 0);
    return 0;
}

static int open_arenas(void **state)
{
    (void)state;
    return dar_arena_init(&model.memory, "model", 1 << 20, NULL) != DAR_OK ||
           dar_arena_init(&arena, "step", 64 << 20, NULL) != DAR_OK ||
           dar_arena_init(&keep, "keep", 1 << 20, NULL) != DAR_OK ||
           dar_arena_init_plan(&plan, "plan", NULL) != DAR_OK ||
           dar_arena_init_plan(&plan_keep, "plan", NULL) != DAR_OK || dar_tape_init(&tape, &arena, NULL) != DAR_OK;
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test_setup(network_gradients, before),      cmocka_unit_test_setup(segments_change_nothing, before),
        cmocka_unit_test_setup(gradients_add_up, before),       cmocka_unit_test_setup(frozen_costs_nothing, before),
        cmocka_unit_test_setup(kept_results_save_work, before), cmocka_unit_test_setup(plans_are_exact, before),
        cmocka_unit_test_setup(inference_is_the_same, before),  cmocka_unit_test_setup(steps_do_not_allocate, before),
        cmocka_unit_test_setup(segment_edges, before),          cmocka_unit_test_setup(half_gradients_stay, before),
        cmocka_unit_test_setup(spare_memory, before),           cmocka_unit_test_setup(dropped_values, before),
        cmocka_unit_test_setup(wrong_calls_abort, before),      cmocka_unit_test_setup(bad_numbers_are_named, before),
    };
    return cmocka_run_group_tests(tests, open_arenas, NULL) != 0;
}
