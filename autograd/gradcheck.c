/* gradcheck.c: central differences and dot tests of any function on a tape. */
#include "autograd/gradcheck.h"

#include <float.h>
#include <math.h>
#include <string.h>

#define ORDER_DIRECTION 7 /* p: differences of order 2p */
#define ORDER_ELEMENT   2
#define STEPS           22 /* steps tried, each half of the one before */

/* What is evaluated: x = base + s u for every input, or for one element of one input. */
struct probe {
    const dar_gradcheck *c;
    dar_arena *arena;
    dar_tape tape;
    dar_val **in;
    dar_tensor *x, *base, *u, *g;
    double *size;  /* power of two of the order of each input's values: the unit of its steps */
    dar_tensor w;  /* cotangent, of y's shape */
    dar_tensor y;  /* f64, contiguous */
    dar_mark mark; /* what an evaluation pushes begins here */
    double weight; /* <|w|, |f(x)|> */
};

struct estimate {
    double value, error;
};

/* ---------------------------------------------------------------- values */

double dar_gradcheck_random(uint64_t seed, uint64_t index)
{
    uint64_t z = seed * 0xd1342543de82ef95u + (index + 1) * 0x9e3779b97f4a7c15u; /* splitmix64 */
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    z ^= z >> 31;
    return (double)(z >> 11) * 0x1p-52 - 1;
}

int dar_sample_inputs(const dar_op *op, const dar_sample *s)
{
    int n = 0;
    if (!op->variadic) return op->n_in;
    while (n < op->n_in && s->in[n].n >= 0) n++;
    return n;
}

void dar_sample_fill(const dar_sample *s, int i, uint64_t seed, const dar_tensor *x)
{
    double lo = s->lo, hi = s->hi, *v = x->data;
    size_t n = dar_tensor_count(x);

    if (lo == 0 && hi == 0) lo = -1, hi = 1;
    for (size_t j = 0; j < n; j++) {
        v[j] = lo + (hi - lo) * (0.5 + 0.5 * dar_gradcheck_random(seed + (uint64_t)i * 1000, j));
        if (fabs(v[j]) < s->gap) v[j] = copysign(s->gap + fabs(v[j]), v[j]);
    }
    if (s->fill) s->fill(i, x);
    for (size_t j = 0; j < n; j++) v[j] = (float)v[j];
}

/* Largest finite magnitude, rounded up to a power of two, at least 1. */
static double size_of(const dar_tensor *x)
{
    const double *v = x->data;
    double most = 0;
    for (size_t j = 0; j < dar_tensor_count(x); j++)
        if (isfinite(v[j])) most = fmax(most, fabs(v[j]));
    return most <= 1 ? 1 : exp2(ceil(log2(most)));
}

/* ---------------------------------------------------------------- evaluation */

static bool is_frozen(const struct probe *p, int i)
{
    return !p->c->x[i].data || (p->c->frozen && p->c->frozen[i]);
}

static dar_val *build(struct probe *p, bool recording)
{
    dar_arena_reset(p->arena, p->mark);
    dar_tape_clear(&p->tape);
    p->tape.recording = recording;
    for (int i = 0; i < p->c->n; i++)
        p->in[i] = p->x[i].data ? dar_leaf(&p->tape, p->x[i], recording && !is_frozen(p, i) ? &p->g[i] : NULL) : NULL;
    return p->c->fn(&p->tape, p->c->arg, p->in);
}

/* <w, f(x)>, with a sum wide enough to add no error of its own. */
static long double value(struct probe *p)
{
    dar_val *r = build(p, false);
    const double *w = p->w.data, *y = p->y.data;
    long double sum = 0;

    dar_tensor_copy(&p->y, &r->x);
    for (size_t j = 0; j < dar_tensor_count(&p->y); j++) sum += (long double)w[j] * y[j];
    return sum;
}

static void move_to(struct probe *p, double s)
{
    for (int i = 0; i < p->c->n; i++) {
        if (is_frozen(p, i)) continue;
        double *x = p->x[i].data;
        const double *base = p->base[i].data, *u = p->u[i].data;
        for (size_t j = 0; j < dar_tensor_count(&p->x[i]); j++) x[j] = base[j] + s * u[j];
    }
}

static long double value_at(struct probe *p, double s, double *element)
{
    double before = element ? *element : 0;
    if (element) *element += s;
    else move_to(p, s);
    long double v = value(p);
    if (element) *element = before;
    return v;
}

/* a_k of order 2n. */
static long double stencil(int n, int k)
{
    long double a = (k & 1 ? 1.0L : -1.0L) / k;
    for (int i = 1; i <= k; i++) a *= (long double)(n - k + i) / (n + i); /* n!^2 / ((n-k)! (n+k)!) */
    return a;
}

/* g'(0) by order 2n; the error is its distance from order 2n - 2.  element NULL: along u. */
static struct estimate derivative(struct probe *p, int n, double h, double *element)
{
    long double high = 0, low = 0;
    for (int k = 1; k <= n; k++) {
        long double d = value_at(p, k * h, element) - value_at(p, -k * h, element);
        high += stencil(n, k) * d;
        if (k < n) low += stencil(n - 1, k) * d;
    }
    return (struct estimate){ (double)(high / h), (double)(fabsl(high - low) / h) };
}

/* J^T w into p->g. */
static void gradients(struct probe *p)
{
    for (int i = 0; i < p->c->n; i++)
        if (!is_frozen(p, i)) dar_tensor_fill(&p->g[i], 0);
    dar_val *y = build(p, true);
    dar_backward(&p->tape, y, &p->w);
}

/* ---------------------------------------------------------------- steps */

/* The largest step, in units of the inputs' sizes, that keeps a stencil of reach n on this side of a kink. */
static double first_step(const struct probe *p, int n, double size)
{
    double h = 1;
    if (p->c->gap > 0)
        while (n * h * size >= p->c->gap) h /= 2;
    return h;
}

static void random_direction(struct probe *p, uint64_t seed, int only)
{
    for (int i = 0; i < p->c->n; i++) {
        if (is_frozen(p, i)) continue;
        double *u = p->u[i].data;
        for (size_t j = 0; j < dar_tensor_count(&p->u[i]); j++) {
            double r = dar_gradcheck_random(seed + (uint64_t)i, j);
            u[j] = only >= 0 && only != i ? 0 : copysign(ceil(64 * fabs(r)), r) / 64 * p->size[i];
        }
    }
}

static void random_cotangent(struct probe *p, uint64_t seed)
{
    double *w = p->w.data;
    for (size_t j = 0; j < dar_tensor_count(&p->w); j++) w[j] = dar_gradcheck_random(seed, j);
}

/* The step for directions: the one whose two orders agree best, with the share of rounding that they cannot see. */
static double choose_step(struct probe *p)
{
    double size = 1, best = INFINITY, last = INFINITY, step = 0;
    for (int i = 0; i < p->c->n; i++)
        if (!is_frozen(p, i)) size = fmax(size, p->size[i]);
    double h = first_step(p, ORDER_DIRECTION, size);
    for (int k = 0; k < STEPS && !(best <= 1e-12 * p->weight && last > best); k++, h /= 2) {
        double e = 2 * DBL_EPSILON * p->weight / h;
        for (uint64_t trial = 0; trial < 2; trial++) {
            random_direction(p, p->c->seed + 77 + trial, -1);
            e += derivative(p, ORDER_DIRECTION, h, NULL).error;
        }
        if (e < best) best = e, step = h;
        last = e;
    }
    return step;
}

/* One element: the step starts at 1e-3 of its size and shrinks while the orders disagree by more than 1e-6 of scale,
 * where the higher one is good to 1e-11. */
static double element_derivative(struct probe *p, int i, size_t j, double scale)
{
    double *x = (double *)p->x[i].data + j;
    double size = fmax(1, exp2(ceil(log2(fmax(1, fabs(*x))))));
    double h = fmin(size / 1024, first_step(p, ORDER_ELEMENT, 1));
    struct estimate best = { NAN, INFINITY };

    for (int k = 0; k < 6; k++, h /= 8) {
        struct estimate e = derivative(p, ORDER_ELEMENT, h, x);
        if (e.error < best.error) best = e;
        if (best.error <= 1e-6 * scale) break;
    }
    return best.value;
}

/* ---------------------------------------------------------------- checks */

/* Keep the worst; NaN is worse than anything. */
static void note(dar_gradcheck_result *r, int input, int64_t element, double found, double expected, double scale)
{
    double d = fabs(found - expected), figure = d == 0 ? 0 : d / scale;
    if (r->diff >= figure || isnan(r->diff)) return;
    *r = (dar_gradcheck_result){ figure, r->dot, input, element, found, expected };
}

static double largest(const dar_tensor *x)
{
    const double *v = x->data;
    double most = 0;
    for (size_t j = 0; j < dar_tensor_count(x); j++) most = fmax(most, fabs(v[j]));
    return most;
}

static double dot(const struct probe *p, double *weight)
{
    long double sum = 0, all = 0;
    for (int i = 0; i < p->c->n; i++) {
        if (is_frozen(p, i)) continue;
        const double *u = p->u[i].data, *g = p->g[i].data;
        for (size_t j = 0; j < dar_tensor_count(&p->u[i]); j++) {
            sum += (long double)u[j] * g[j];
            all += fabsl((long double)u[j] * g[j]);
        }
    }
    *weight = (double)all;
    return (double)sum;
}

static void check_elements(struct probe *p, int i, double floor, dar_gradcheck_result *r)
{
    const double *g = p->g[i].data;
    double scale = fmax(largest(&p->g[i]), floor);
    for (size_t j = 0; j < dar_tensor_count(&p->g[i]); j++)
        note(r, i, (int64_t)j, g[j], element_derivative(p, i, j, scale), scale);
}

static void check_directions(struct probe *p, int i, double h, dar_gradcheck_result *r)
{
    for (uint64_t k = 0; k < DAR_GRADCHECK_DIRECTIONS; k++) {
        double all;
        random_direction(p, p->c->seed + 500 + 64 * k, i);
        double found = dot(p, &all), expected = derivative(p, ORDER_DIRECTION, h, NULL).value;
        note(r, i, -1, found, expected, fmax(all, DAR_GRADCHECK_FLOOR * p->weight));
    }
    move_to(p, 0);
}

static void check_pairs(struct probe *p, double h, dar_gradcheck_result *r)
{
    for (uint64_t k = 0; k < DAR_GRADCHECK_PAIRS; k++) {
        double all;
        random_direction(p, p->c->seed + 10000 + 64 * k, -1);
        random_cotangent(p, p->c->seed + 20000 + k);
        move_to(p, 0);
        gradients(p);
        double found = dot(p, &all), expected = derivative(p, ORDER_DIRECTION, h, NULL).value;
        double d = fabs(found - expected), figure = d == 0 ? 0 : d / fmax(all, DAR_GRADCHECK_FLOOR * p->weight);
        if (!(figure <= r->dot)) r->dot = figure;
        if (isnan(figure)) break;
    }
}

static void prepare(struct probe *p, const dar_gradcheck *c, dar_arena *a)
{
    size_t n = (size_t)c->n;
    dar_err e;

    *p = (struct probe){ .c = c, .arena = a };
    DAR_ASSERT(dar_tape_init(&p->tape, a, &e) == DAR_OK, "gradcheck: %s", e.text);
    p->in = dar_arena_push(a, n * sizeof *p->in);
    p->size = dar_arena_push(a, n * sizeof *p->size);
    p->x = dar_arena_push(a, n * sizeof *p->x);
    p->base = dar_arena_push(a, n * sizeof *p->base);
    p->u = dar_arena_push(a, n * sizeof *p->u);
    p->g = dar_arena_push(a, n * sizeof *p->g);
    for (int i = 0; i < c->n; i++) {
        p->x[i] = p->base[i] = c->x[i];
        if (!c->x[i].data) continue;
        DAR_ASSERT(c->x[i].dtype == DAR_F64 && dar_tensor_contiguous(&c->x[i]),
                   "gradcheck: input %d is not f64, contiguous", i);
        p->size[i] = size_of(&c->x[i]);
        p->x[i] = dar_tensor_push(a, DAR_F64, c->x[i].shape);
        p->u[i] = dar_tensor_push(a, DAR_F64, c->x[i].shape);
        p->g[i] = dar_tensor_push(a, DAR_F64, c->x[i].shape);
        dar_tensor_copy(&p->x[i], &c->x[i]);
    }
    p->mark = dar_arena_mark(a);
    dar_shape s = build(p, false)->x.shape;
    dar_arena_reset(a, p->mark);
    p->w = dar_tensor_push(a, DAR_F64, s);
    p->y = dar_tensor_push(a, DAR_F64, s);
    p->mark = dar_arena_mark(a);
}

dar_gradcheck_result dar_gradcheck_run(const dar_gradcheck *c, dar_arena *a)
{
    dar_mark m = dar_arena_mark(a);
    dar_gradcheck_result r = { .diff = -1, .input = -1 };
    struct probe p;

    prepare(&p, c, a);
    random_cotangent(&p, c->seed + 1);
    value(&p);
    const double *w = p.w.data, *y = p.y.data;
    double most = 0;
    for (size_t j = 0; j < dar_tensor_count(&p.y); j++) {
        p.weight += fabs(w[j] * y[j]);
        most = fmax(most, fabs(w[j] * y[j]));
    }
    double h = choose_step(&p);
    move_to(&p, 0);
    gradients(&p);
    for (int i = 0; i < c->n; i++) {
        if (is_frozen(&p, i)) continue;
        if (dar_tensor_count(&p.x[i]) <= DAR_GRADCHECK_ALL && !c->directions)
            check_elements(&p, i, DAR_GRADCHECK_FLOOR * most / p.size[i], &r);
        else check_directions(&p, i, h, &r);
    }
    check_pairs(&p, h, &r);
    dar_tape_free(&p.tape);
    dar_arena_reset(a, m);
    return r;
}

/* ---------------------------------------------------------------- ops */

struct op_call {
    const dar_op *op;
    const void *attr;
    int n;
};

static dar_val *call_op(dar_tape *t, void *arg, dar_val *const *in)
{
    const struct op_call *c = arg;
    return dar_apply(t, c->op, in, c->n, c->attr);
}

dar_gradcheck_result dar_gradcheck_op(const dar_op *op, const dar_sample *s, uint64_t seed, dar_arena *a)
{
    dar_mark m = dar_arena_mark(a);
    struct op_call call = { op, s->attr, dar_sample_inputs(op, s) };
    dar_tensor x[DAR_OP_IN] = { 0 };
    bool frozen[DAR_OP_IN];

    for (int i = 0; i < call.n; i++) {
        frozen[i] = op->frozen & DAR_KEEP_X(i);
        if (s->in[i].n < 0) continue;
        x[i] = dar_tensor_push(a, DAR_F64, s->in[i]);
        dar_sample_fill(s, i, seed, &x[i]);
    }
    dar_gradcheck c = {
        .fn = call_op, .arg = &call, .n = call.n, .x = x, .frozen = frozen, .gap = s->gap, .seed = seed
    };
    dar_gradcheck_result r = dar_gradcheck_run(&c, a);
    dar_arena_reset(a, m);
    return r;
}
