/* test_ops.c: what every op must do, tried on every sample of its descriptor.
 *
 * Values are compared with the f64 run at the same values (rounded to the storage types at hand).  Bounds, per tensor
 * of result, with u the unit roundoff (f64 2^-53, f32 2^-24, f16 2^-11, bf16 2^-8), K the descriptor's `terms`, max the
 * largest magnitude of the f64 result:
 *
 *   f64 f32   u (K + 8) max + 4 moved       K + 8 roundings of a sum's terms
 *   bf16 f16  u (sqrt K + 4) max + 4 moved  the result is rounded once, operands of products once each: independent
 *                                           roundings of K terms add as sqrt K;  plus the f32 bound
 *
 * moved is the condition of the sample: how far the f64 result goes when every input moves by u, in relative size and
 * with random signs.  One program argument: test only the op of that name. */
#include "tests/test.h"

#include "autograd/gradcheck.h"
#include "autograd/ops.h"
#include "lib/kern.h"

#define MAX_DIFF 1e-8
#define MAX_DOT  1e-12
#define GUARD    256
#define CANARY   0xa5
#define POISON   0xff /* NaN in every float type */
#define SEED     7

static dar_arena arena;
static double worst_diff, worst_dot;
static const char *worst_diff_op = "none", *worst_dot_op = "none";

/* ---------------------------------------------------------------- one run of a descriptor */

/* Storage types to run with: that of x[0], and of the others in turn. */
struct storage {
    const char *name;
    dar_dtype first, other;
    double unit;
};

static const struct storage storages[] = {
    { "f64", DAR_F64, DAR_F64, 0x1p-53 },           { "f32", DAR_F32, DAR_F32, 0x1p-24 },
    { "bf16", DAR_BF16, DAR_BF16, 0x1p-8 },         { "f32 with bf16", DAR_F32, DAR_BF16, 0x1p-8 },
    { "bf16 with f32", DAR_BF16, DAR_F32, 0x1p-8 }, { "f16", DAR_F16, DAR_F16, 0x1p-11 },
};

struct options {
    const struct storage *storage; /* values are rounded to these types */
    bool wide;                     /* and then the run is in f64 */
    unsigned frozen;               /* bits of inputs to leave without gradient */
    bool add;                      /* gradients on top of existing content */
    unsigned half;                 /* gradients that are bf16 where the op allows it; any: gy is in value */
    bool inference;                /* no aux, no backward */
    double jitter;                 /* move inputs and gy by this, relatively, signs from its seed */
    uint64_t jitter_seed;
};

struct result {
    dar_tensor y, gx[DAR_OP_IN];
};

struct trial {
    const dar_op *op;
    int index; /* of the sample */
    const dar_sample *sample;
    int n;
    dar_tensor x[DAR_OP_IN]; /* f64 values before rounding; data NULL: absent */
};

static void *guarded(size_t bytes)
{
    unsigned char *p = dar_arena_push(&arena, bytes + GUARD);
    memset(p, POISON, bytes);
    memset(p + bytes, CANARY, GUARD);
    return p;
}

static void check_guard(const struct trial *t, const char *what, const void *p, size_t bytes)
{
    const unsigned char *g = (const unsigned char *)p + bytes;
    for (size_t i = 0; p && i < GUARD; i++)
        CHECK(g[i] == CANARY, "%s, sample %d: wrote byte %zu behind %s (%zu bytes)", t->op->name, t->index, i, what,
              bytes);
}

static dar_tensor guarded_tensor(dar_dtype type, dar_shape s)
{
    return dar_tensor_of(type, s, guarded(dar_shape_count(&s) * dar_dtype_size(type)));
}

static void check_tensor_guard(const struct trial *t, const char *what, const dar_tensor *x)
{
    if (x->data) check_guard(t, what, x->data, dar_tensor_bytes(x));
}

static dar_tensor copied(const dar_tensor *x)
{
    if (!x->data) return *x;
    dar_tensor y = dar_tensor_push(&arena, x->dtype, x->shape);
    memcpy(y.data, x->data, dar_tensor_bytes(x));
    return y;
}

static void check_unchanged(const struct trial *t, const char *what, int i, const dar_tensor *now,
                            const dar_tensor *before)
{
    if (now->data)
        CHECK(memcmp(now->data, before->data, dar_tensor_bytes(now)) == 0, "%s, sample %d: %s changed input %d",
              t->op->name, t->index, what, i);
}

static dar_dtype stored_as(const struct options *o, int i)
{
    return i ? o->storage->other : o->storage->first;
}

static double jittered(const struct options *o, int i, size_t j, double v)
{
    if (!o->jitter) return v;
    return v * (1 + copysign(o->jitter, dar_gradcheck_random(o->jitter_seed + 31 * (uint64_t)i, j)));
}

/* Input i as it is stored, then maybe widened again. */
static dar_tensor make_input(const struct trial *t, const struct options *o, int i)
{
    if (!t->x[i].data) return (dar_tensor){ .shape.n = -1 };
    dar_tensor x = guarded_tensor(o->wide ? DAR_F64 : stored_as(o, i), t->x[i].shape);
    for (size_t j = 0; j < dar_tensor_count(&x); j++) {
        unsigned char cell[8];
        dar_dtype_set(stored_as(o, i), cell, 0, dar_dtype_get(DAR_F64, t->x[i].data, j));
        double v = dar_dtype_get(stored_as(o, i), cell, 0);
        bool moves = o->wide && !(t->op->frozen & DAR_KEEP_X(i));
        dar_dtype_set(x.dtype, x.data, j, moves ? jittered(o, i, j, v) : v);
    }
    return x;
}

static void fill_random(const dar_tensor *x, uint64_t seed, const struct options *o)
{
    for (size_t j = 0; j < dar_tensor_count(x); j++) {
        double v = dar_gradcheck_random(seed, j);
        v = o->half ? round(v * 128) / 128 : (float)v; /* 8 bits at most */
        dar_dtype_set(x->dtype, x->data, j, jittered(o, DAR_OP_IN, j, v));
    }
}

/* What a gradient is added to. */
static void fill_content(const dar_tensor *gx, int i)
{
    fill_random(gx, SEED + 200 + (uint64_t)i, &(struct options){ 0 });
}

static bool has_gradient(const struct trial *t, const struct options *o, int i)
{
    return t->op->backward && i < t->n && t->x[i].data && !((t->op->frozen | o->frozen) & DAR_KEEP_X(i));
}

/* Of x[i], or of y (DAR_KEEP_Y). */
static dar_dtype gradient_type(const struct trial *t, const struct options *o, unsigned of, dar_dtype stored)
{
    return o->half & t->op->half & of && stored == DAR_BF16 ? DAR_BF16 : dar_compute_type(stored);
}

static void call(const struct trial *t, dar_opctx *c, bool backward)
{
    size_t bytes = t->op->scratch ? t->op->scratch(c, backward) : 0;
    c->scratch = t->op->scratch ? guarded(bytes) : NULL;
    (backward ? t->op->backward : t->op->forward)(c);
    check_guard(t, backward ? "backward's scratch" : "forward's scratch", c->scratch, bytes);
}

/* Once more with gx[0] where x[0] lies. */
static void run_over(const struct trial *t, const struct options *o, dar_opctx c, const struct result *r)
{
    c.gx[0] = c.x[0];
    for (int i = 0; i < t->n; i++)
        if (i && c.gx[i].data) c.gx[i] = guarded_tensor(c.gx[i].dtype, c.gx[i].shape);
    call(t, &c, true);
    for (int i = 0; i < t->n; i++)
        if (has_gradient(t, o, i))
            CHECK(memcmp(r->gx[i].data, c.gx[i].data, dar_tensor_bytes(&c.gx[i])) == 0,
                  "%s, sample %d: gradient %d differs with that of input 0 over its value", t->op->name, t->index, i);
}

/* Forward and backward, everything that must not be read full of NaN, canaries behind everything that is written. */
static struct result run(const struct trial *t, const struct options *o)
{
    const dar_op *op = t->op;
    dar_opctx c = { .attr = t->sample->attr, .threads = dar_threads() };
    dar_shape shape[DAR_OP_IN];
    dar_dtype type[DAR_OP_IN];
    dar_tensor before[DAR_OP_IN];
    struct result r = { 0 };

    for (int i = 0; i < DAR_OP_IN; i++) {
        c.x[i] = i < t->n ? make_input(t, o, i) : (dar_tensor){ .shape.n = -1 };
        before[i] = copied(&c.x[i]);
        shape[i] = c.x[i].shape;
        type[i] = c.x[i].dtype;
    }
    c.y = guarded_tensor(op->dtype ? op->dtype(type, t->n, c.attr) : type[0], op->shape(shape, t->n, c.attr));
    if (op->aux && !o->inference) c.aux = guarded_tensor(dar_op_compute(&c), op->aux(shape, t->n, c.attr));
    call(t, &c, false);
    check_tensor_guard(t, "y", &c.y);
    check_tensor_guard(t, "aux", &c.aux);
    for (int i = 0; i < t->n; i++) check_unchanged(t, "forward", i, &c.x[i], &before[i]);
    r.y = copied(&c.y);
    if (!op->backward || o->inference) return r;

    c.gy = dar_tensor_push(&arena, gradient_type(t, o, DAR_KEEP_Y, c.y.dtype), c.y.shape);
    fill_random(&c.gy, SEED + 100, o);
    dar_tensor gy = copied(&c.gy);
    for (int i = 0; i < t->n; i++) {
        if (c.x[i].data && !(op->keep & DAR_KEEP_X(i))) memset(c.x[i].data, POISON, dar_tensor_bytes(&c.x[i]));
        if (!has_gradient(t, o, i)) continue;
        c.gx[i] = guarded_tensor(gradient_type(t, o, DAR_KEEP_X(i), c.x[i].dtype), c.x[i].shape);
        c.add[i] = o->add;
        if (o->add) fill_content(&c.gx[i], i);
    }
    if (!(op->keep & DAR_KEEP_Y)) memset(c.y.data, POISON, dar_tensor_bytes(&c.y));
    call(t, &c, true);
    for (int i = 0; i < t->n; i++) {
        check_tensor_guard(t, "a gradient", &c.gx[i]);
        if (op->keep & DAR_KEEP_X(i)) check_unchanged(t, "backward", i, &c.x[i], &before[i]);
        r.gx[i] = c.gx[i];
    }
    CHECK(memcmp(gy.data, c.gy.data, dar_tensor_bytes(&gy)) == 0, "%s, sample %d: backward changed gy", op->name,
          t->index);
    if (op->in_place && !o->add && c.gx[0].data && dar_shape_equal(&c.gx[0].shape, &c.gy.shape) &&
        c.gx[0].dtype == c.gy.dtype) {
        c.gx[0] = c.gy;
        call(t, &c, true);
        CHECK(memcmp(r.gx[0].data, c.gy.data, dar_tensor_bytes(&gy)) == 0, "%s, sample %d: in place it differs",
              op->name, t->index);
        memcpy(c.gy.data, gy.data, dar_tensor_bytes(&gy));
    }
    if (op->over && !o->add && r.gx[0].data && r.gx[0].dtype == c.x[0].dtype) run_over(t, o, c, &r);
    return r;
}

/* ---------------------------------------------------------------- comparing runs */

static const char *of_name(int of)
{
    static const char *name[] = { "y", "gx[0]", "gx[1]", "gx[2]", "gx[3]", "gx[4]", "gx[5]", "gx[6]", "gx[7]" };
    return name[of + 1];
}

static void same_bits(const struct trial *t, const char *what, int of, const dar_tensor *found,
                      const dar_tensor *expected)
{
    if (!found->data || !expected->data) return;
    for (size_t j = 0; j < dar_tensor_count(found); j++) {
        size_t size = dar_dtype_size(found->dtype);
        const char *f = (const char *)found->data + j * size, *e = (const char *)expected->data + j * size;
        CHECK(memcmp(f, e, size) == 0, "%s, sample %d, %s: %s[%zu] is %.17g, expected the same bits as %.17g",
              t->op->name, t->index, what, of_name(of), j, dar_dtype_get(found->dtype, f, 0),
              dar_dtype_get(expected->dtype, e, 0));
    }
}

static void same_result(const struct trial *t, const char *what, const struct result *found,
                        const struct result *expected)
{
    same_bits(t, what, -1, &found->y, &expected->y);
    for (int i = 0; i < t->n; i++) same_bits(t, what, i, &found->gx[i], &expected->gx[i]);
}

/* Largest finite magnitude; with b, of the difference. */
static double largest(const dar_tensor *a, const dar_tensor *b)
{
    double most = 0;
    for (size_t j = 0; j < dar_tensor_count(a); j++) {
        double v = dar_dtype_get(a->dtype, a->data, j) - (b ? dar_dtype_get(b->dtype, b->data, j) : 0);
        if (isfinite(v)) most = fmax(most, fabs(v));
    }
    return most;
}

static double terms_of(const struct trial *t, int of)
{
    dar_shape shape[DAR_OP_IN];
    for (int i = 0; i < DAR_OP_IN; i++) shape[i] = i < t->n ? t->x[i].shape : (dar_shape){ .n = -1 };
    return t->op->terms ? t->op->terms(shape, t->n, t->sample->attr, of) : 1;
}

static void near(const struct trial *t, const char *what, const char *where, int of, const dar_tensor *found,
                 const dar_tensor *expected, double bound)
{
    for (size_t j = 0; j < dar_tensor_count(found); j++) {
        double f = dar_dtype_get(found->dtype, found->data, j), e = dar_dtype_get(expected->dtype, expected->data, j);
        if (f == e) continue; /* infinities too */
        CHECK(fabs(f - e) <= bound, "%s, sample %d, %s %s: %s[%zu] is %.9g, expected %.9g, off by %.3g, bound %.3g",
              t->op->name, t->index, what, where, of_name(of), j, f, e, fabs(f - e), bound);
    }
}

/* f64 runs at the values of a storage: the result, and how far it moves. */
struct arbiter {
    struct result r;
    double moved[1 + DAR_OP_IN];
};

static struct arbiter arbitrate(const struct trial *t, struct options o)
{
    struct arbiter a = { 0 };
    o.wide = true;
    a.r = run(t, &o);
    for (uint64_t k = 0; k < 2; k++) {
        dar_mark m = dar_arena_mark(&arena);
        o.jitter = o.storage->unit;
        o.jitter_seed = 1000 + 100 * k;
        struct result moved = run(t, &o);
        a.moved[0] = fmax(a.moved[0], largest(&a.r.y, &moved.y));
        for (int i = 0; i < t->n; i++)
            if (a.r.gx[i].data) a.moved[1 + i] = fmax(a.moved[1 + i], largest(&a.r.gx[i], &moved.gx[i]));
        dar_arena_reset(&arena, m);
    }
    return a;
}

/* What is expected where gradients are added to their content. */
static void add_content(const struct trial *t, const struct arbiter *a)
{
    for (int i = 0; i < t->n; i++) {
        if (!a->r.gx[i].data) continue;
        dar_tensor content = dar_tensor_push(&arena, DAR_F64, a->r.gx[i].shape);
        fill_content(&content, i);
        dar_tensor_add(&a->r.gx[i], &content);
    }
}

static double bound_of(const struct trial *t, const struct storage *s, const struct arbiter *a, int of)
{
    double k = terms_of(t, of), most = largest(of < 0 ? &a->r.y : &a->r.gx[of], NULL);
    double bound = fmin(s->unit, 0x1p-24) * (k + 8) * most + 4 * a->moved[1 + of];
    return s->unit > 0x1p-24 ? bound + s->unit * (sqrt(k) + 4) * most : bound;
}

static void near_result(const struct trial *t, const char *what, const char *where, const struct storage *s,
                        const struct result *found, const struct arbiter *a)
{
    near(t, what, where, -1, &found->y, &a->r.y, bound_of(t, s, a, -1));
    for (int i = 0; i < t->n; i++)
        if (found->gx[i].data) near(t, what, where, i, &found->gx[i], &a->r.gx[i], bound_of(t, s, a, i));
}

/* ---------------------------------------------------------------- the checks */

/* Differences see only functions: not the steps of a result rounded to fewer bits, as some casts give. */
static bool can_differ(const struct trial *t)
{
    static const dar_dtype f64[DAR_OP_IN] = { DAR_F64 };
    if (t->op->dtype && t->op->dtype(f64, t->n, t->sample->attr) != DAR_F64) return false;
    for (int i = 0; i < t->n; i++)
        if (t->x[i].data && !(t->op->frozen & DAR_KEEP_X(i))) return t->op->backward || t->op->view;
    return false;
}

static void gradients(const struct trial *t)
{
    const char *op = t->op->name;
    if (!can_differ(t)) return;
    dar_threads_set(1);
    dar_gradcheck_result r = dar_gradcheck_op(t->op, t->sample, SEED, &arena);
    if (!(r.diff <= worst_diff)) worst_diff = r.diff, worst_diff_op = op;
    if (!(r.dot <= worst_dot)) worst_dot = r.dot, worst_dot_op = op;
    CHECK(r.diff <= MAX_DIFF,
          "%s, sample %d: gradient of input %d, element %lld is %.17g, differences say %.17g: %.3g, bound %.3g", op,
          t->index, r.input, (long long)r.element, r.found, r.expected, r.diff, MAX_DIFF);
    CHECK(r.dot <= MAX_DOT, "%s, sample %d: dot test %.3g, bound %.3g", op, t->index, r.dot, MAX_DOT);
}

/* Every storage, at every CPU level, written and added. */
static void precision(const struct trial *t)
{
    unsigned level[5];
    int levels = test_levels(level);
    static const char *name[2][5] = { { "level 0", "level 1", "level 2", "level 3", "level 4" },
                                      { "added, level 0", "added, level 1", "added, level 2", "added, level 3",
                                        "added, level 4" } };

    for (size_t s = 0; s < DAR_COUNT(storages); s++) {
        if (t->n == 1 && storages[s].first != storages[s].other) continue;
        dar_mark m = dar_arena_mark(&arena);
        struct options o = { .storage = &storages[s] };
        struct arbiter a = arbitrate(t, o);
        for (int add = 0; add < 2; add++) {
            o.add = add;
            if (add) add_content(t, &a);
            for (int k = 0; k < levels; k++) {
                dar_cpu_init(level[k]);
                struct result r = run(t, &o);
                near_result(t, storages[s].name, name[add][k], &storages[s], &r, &a);
            }
        }
        dar_cpu_init(DAR_CPU_ALL);
        dar_arena_reset(&arena, m);
    }
}

/* Gradients stored as bf16: all that may be, at every CPU level and for any number of threads; on one side only. */
static void half(const struct trial *t, const struct storage *s)
{
    static const int threads[] = { 1, 3 };
    unsigned level[5];
    int levels = test_levels(level);
    dar_mark m = dar_arena_mark(&arena);
    struct options o = { .storage = s, .half = ~0u };
    struct arbiter a = arbitrate(t, o);
    struct result all;

    for (int k = levels - 1; k >= 0; k--) {
        dar_cpu_init(level[k]);
        all = run(t, &o);
        near_result(t, s->name, "gradients in bf16", s, &all, &a);
    }
    for (size_t k = 0; k < DAR_COUNT(threads); k++) {
        dar_threads_set(threads[k]);
        struct result r = run(t, &o);
        same_result(t, "gradients in bf16, threads", &r, &all);
    }
    dar_threads_set(2);
    dar_cpu_init(DAR_CPU_ALL);
    for (unsigned only_y = 0; only_y < 2; only_y++) {
        o.half = only_y ? DAR_KEEP_Y : ~DAR_KEEP_Y;
        struct result r = run(t, &o);
        near_result(t, s->name, only_y ? "gy in bf16" : "gx in bf16", s, &r, &a);
    }
    dar_arena_reset(&arena, m);
}

/* What must not change a bit: threads, inference, which inputs are frozen. */
static void bits(const struct trial *t, const struct storage *s)
{
    static const int threads[] = { 2, 3, 7 };
    dar_mark m = dar_arena_mark(&arena);
    struct options o = { .storage = s };

    dar_threads_set(1);
    struct result one = run(t, &o);
    for (size_t k = 0; k < DAR_COUNT(threads); k++) {
        char what[64];
        snprintf(what, sizeof what, "%s with %d threads", s->name, threads[k]);
        dar_threads_set(threads[k]);
        struct result r = run(t, &o);
        same_result(t, what, &r, &one);
    }
    dar_threads_set(2);
    o.inference = true;
    struct result r = run(t, &o);
    same_result(t, "without aux", &r, &one);
    o.inference = false;
    for (int i = 0; i < t->n && t->n > 1; i++) {
        o.frozen = DAR_KEEP_X(i);
        r = run(t, &o);
        same_result(t, "one input frozen", &r, &one);
        o.frozen = ~DAR_KEEP_X(i);
        r = run(t, &o);
        same_result(t, "one input not frozen", &r, &one);
    }
    dar_arena_reset(&arena, m);
}

/* ---------------------------------------------------------------- checks through the tape */

static dar_tensor rounded(const struct trial *t, int i, dar_dtype type)
{
    dar_tensor x = dar_tensor_push(&arena, type, t->x[i].shape);
    dar_tensor_copy(&x, &t->x[i]);
    return x;
}

/* The same values with the dimensions in reverse order in memory, or inside a larger block. */
static dar_tensor strided(const dar_tensor *x, bool permuted)
{
    dar_shape s = x->shape;
    int order[DAR_MAX_DIMS];

    if (permuted) {
        for (int i = 0; i < s.n; i++) {
            s.d[i] = x->shape.d[x->shape.n - 1 - i];
            order[i] = x->shape.n - 1 - i;
        }
    } else {
        for (int i = 0; i < s.n; i++) s.d[i] += 3;
    }
    dar_tensor y = dar_tensor_push(&arena, x->dtype, s);
    memset(y.data, POISON, dar_tensor_bytes(&y));
    if (permuted) y = dar_tensor_permute(&y, order);
    else
        for (int i = 0; i < s.n; i++) y = dar_tensor_narrow(&y, i, 1, x->shape.d[i]);
    dar_tensor_copy(&y, x);
    return y;
}

static struct result run_tape(const struct trial *t, const dar_tensor *x, unsigned same_as_first)
{
    dar_tape tape;
    dar_val *in[DAR_OP_IN] = { 0 };
    struct result r = { 0 };
    bool wants = false;

    assert_int_equal(dar_tape_init(&tape, &arena, NULL), DAR_OK);
    for (int i = 0; i < t->n; i++) {
        if (!x[i].data) continue;
        dar_tensor *g = NULL;
        if (!(t->op->frozen & DAR_KEEP_X(i)) && (t->op->backward || t->op->view)) {
            r.gx[i] = dar_tensor_push(&arena, dar_compute_type(x[i].dtype), x[i].shape);
            dar_tensor_fill(&r.gx[i], 0);
            g = &r.gx[i];
            wants = true;
        }
        in[i] = same_as_first >> i & 1 ? in[0] : dar_leaf(&tape, x[i], g);
    }
    dar_val *y = dar_apply(&tape, t->op, in, t->n, t->sample->attr);
    r.y = dar_tensor_push(&arena, y->x.dtype, y->x.shape);
    dar_tensor_copy(&r.y, &y->x);
    if (wants) {
        dar_tensor gy = dar_tensor_push(&arena, dar_compute_type(y->x.dtype), y->x.shape);
        fill_random(&gy, SEED + 300, &(struct options){ 0 });
        dar_backward(&tape, y, &gy);
    }
    dar_tape_free(&tape);
    return r;
}

static void views(const struct trial *t)
{
    dar_mark m = dar_arena_mark(&arena);
    dar_tensor x[DAR_OP_IN] = { 0 }, v[DAR_OP_IN] = { 0 };

    for (int i = 0; i < t->n; i++)
        if (t->x[i].data) x[i] = rounded(t, i, DAR_F32);
    struct result expected = run_tape(t, x, 0);
    for (int permuted = 0; permuted < 2; permuted++) {
        for (int i = 0; i < t->n; i++)
            if (x[i].data) v[i] = strided(&x[i], permuted);
        struct result r = run_tape(t, v, 0);
        same_result(t, permuted ? "permuted inputs" : "narrowed inputs", &r, &expected);
    }
    dar_arena_reset(&arena, m);
}

/* Input i > 0 is the value that is input 0: its gradient is the sum of both. */
static void twice(const struct trial *t)
{
    for (int i = 1; i < t->n; i++) {
        if (!t->x[0].data || !t->x[i].data || !dar_shape_equal(&t->x[0].shape, &t->x[i].shape)) continue;
        if (t->op->frozen & (DAR_KEEP_X(0) | DAR_KEEP_X(i))) continue;
        dar_mark m = dar_arena_mark(&arena);
        dar_tensor x[DAR_OP_IN];
        memcpy(x, t->x, sizeof x);
        x[i] = x[0];
        struct result apart = run_tape(t, x, 0), both = run_tape(t, x, 1u << i);
        double most = fmax(largest(&apart.gx[0], NULL), largest(&apart.gx[i], NULL));
        dar_tensor_add(&apart.gx[0], &apart.gx[i]);
        same_bits(t, "one value as two inputs", -1, &both.y, &apart.y);
        near(t, "one value as", "two inputs", 0, &both.gx[0], &apart.gx[0], 4 * 0x1p-52 * most);
        dar_arena_reset(&arena, m);
    }
}

static void aborts(const dar_op *op, int index)
{
    const dar_error_sample *s = &op->errors[index];
    dar_sample shapes = { 0 };
    dar_val *in[DAR_OP_IN] = { 0 };
    dar_arena plan;
    dar_tape tape;

    memcpy(shapes.in, s->in, sizeof shapes.in);
    int n = dar_sample_inputs(op, &shapes);
    assert_int_equal(dar_arena_init_plan(&plan, "plan", NULL), DAR_OK);
    assert_int_equal(dar_tape_init(&tape, &plan, NULL), DAR_OK);
    for (int i = 0; i < n; i++) in[i] = s->in[i].n < 0 ? NULL : dar_input(&tape, DAR_F32, s->in[i]);
    printf("%s: error sample %d\n", op->name, index); /* cmocka says only that nothing aborted */
    CHECK_ABORTS(dar_apply(&tape, op, in, n, s->attr));
    dar_tape_free(&tape);
    dar_arena_free(&plan);
}

/* ---------------------------------------------------------------- the table */

static struct trial trial_of(const dar_op *op, int index)
{
    struct trial t = { .op = op, .index = index, .sample = &op->samples[index] };
    t.n = dar_sample_inputs(op, t.sample);
    for (int i = 0; i < DAR_OP_IN; i++) {
        t.x[i].shape = i < t.n ? t.sample->in[i] : (dar_shape){ .n = -1 };
        if (i >= t.n || t.sample->in[i].n < 0) continue;
        t.x[i] = dar_tensor_push(&arena, DAR_F64, t.sample->in[i]);
        dar_sample_fill(t.sample, i, SEED, &t.x[i]);
    }
    return t;
}

static void check_op(void **state)
{
    const dar_op *op = *state;

    CHECK(op->n_samples > 0, "%s: no samples", op->name);
    CHECK(op->backward || op->view || op->no_backward, "%s: no backward, and no reason why", op->name);
    CHECK(op->forward || op->view, "%s: no forward", op->name);
    for (int i = 0; i < op->n_samples; i++) {
        dar_mark m = dar_arena_mark(&arena);
        struct trial t = trial_of(op, i);
        gradients(&t);
        if (!op->view) {
            precision(&t);
            for (size_t k = 0; k < DAR_COUNT(storages); k++)
                if (storages[k].first == storages[k].other) bits(&t, &storages[k]);
            for (size_t k = 0; op->half && k < DAR_COUNT(storages); k++)
                if (storages[k].other == DAR_BF16) half(&t, &storages[k]);
        }
        views(&t);
        twice(&t);
        dar_arena_reset(&arena, m);
    }
    for (int i = 0; i < op->n_errors; i++) aborts(op, i);
}

static int before_op(void **state)
{
    (void)state;
    dar_arena_reset(&arena, 0);
    dar_cpu_init(DAR_CPU_ALL);
    dar_threads_set(2);
    return 0;
}

int main(int argc, char **argv)
{
    struct CMUnitTest tests[256];

    if (dar_arena_init(&arena, "test", (size_t)1 << 30, NULL) != DAR_OK || dar_n_ops > 256) return 1;
    for (int i = 0; i < dar_n_ops; i++)
        tests[i] = (struct CMUnitTest){ dar_ops[i]->name, check_op, before_op, NULL, (void *)(uintptr_t)dar_ops[i] };
    if (argc > 1) cmocka_set_test_filter(argv[1]);
    int failures = _cmocka_run_group_tests("ops", tests, (size_t)dar_n_ops, NULL, NULL);
    printf("note: dot test: worst %.1e in %s\n", worst_dot, worst_dot_op);
    printf("gradcheck: worst %.1e in %s\n", worst_diff, worst_diff_op);
    return failures != 0;
}
