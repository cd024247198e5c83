/* test_attn.c: attention against a plain f64 text that also carries the bound of every number. */
#include "tests/test.h"

#include "lib/attn.h"
#include "lib/kern.h"

/* ---------------------------------------------------------------- problems */

enum weights { PLAIN, SHARED, EACH, NONE_LEFT }; /* no log-weights; [Nk]; [B, Nk]; of sample 0 every key masked */

struct problem {
    size_t B, Nq, Nk, A, E;
    enum weights weights;
    double size; /* of q and k; 0: 1 */
    bool equal;  /* all keys the same */
};

enum { FQ = 1, FK = 2, FV = 4 }; /* gradients that are left out */

struct run {
    struct problem p;
    dar_dtype type;
    int frozen;
    bool add;
    dar_attn a;
    void *guarded[32];
    size_t bytes[32];
    int n;
};

#define GUARD 128

static void *guarded(struct run *r, size_t bytes)
{
    char *p = aligned_alloc(64, (bytes + 2 * GUARD + 63) / 64 * 64);
    memset(p, 0x5a, GUARD + bytes + GUARD);
    r->guarded[r->n] = p;
    r->bytes[r->n++] = bytes;
    return p + GUARD;
}

static void check_guards(const struct run *r)
{
    for (int i = 0; i < r->n; i++) {
        const char *p = r->guarded[i];
        for (size_t k = 0; k < GUARD; k++)
            CHECK(p[k] == 0x5a && p[GUARD + r->bytes[i] + k] == 0x5a, "buffer %d: written outside, %zu", i, k);
    }
}

static dar_tensor tensor(struct run *r, dar_dtype t, dar_shape s)
{
    return dar_tensor_of(t, s, guarded(r, dar_shape_count(&s) * dar_dtype_size(t)));
}

static double noise(uint64_t seed, uint64_t i)
{
    uint64_t z = (seed << 40) + (i + 1) * 0x9e3779b97f4a7c15u;
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    return (double)((z ^ z >> 31) >> 11) * 0x1p-52 - 1;
}

static dar_tensor fresh(struct run *r, dar_dtype t, dar_shape s, uint64_t seed, double size)
{
    dar_tensor x = tensor(r, t, s);
    for (size_t i = 0; i < dar_tensor_count(&x); i++) dar_dtype_set(t, x.data, i, size * noise(seed, i));
    return x;
}

/* What gradients are added to. */
static void fill_gradients(const struct run *r)
{
    const dar_tensor *g[] = { &r->a.gq, &r->a.gk, &r->a.gv };
    for (size_t k = 0; k < DAR_COUNT(g); k++)
        for (size_t i = 0; g[k]->data && i < dar_tensor_count(g[k]); i++)
            dar_dtype_set(g[k]->dtype, g[k]->data, i, noise(5 + k, i));
}

static void fill_weights(const struct run *r, const dar_tensor *lw)
{
    for (size_t i = 0; i < dar_tensor_count(lw); i++) {
        double w = i % 3 == 1 ? -INFINITY : i % 3 == 2 ? log(5) : noise(9, i);
        if (r->p.weights == NONE_LEFT && i < r->p.Nk) w = -INFINITY;
        dar_dtype_set(lw->dtype, lw->data, i, w);
    }
}

static void open_run(struct run *r)
{
    const struct problem *p = &r->p;
    int64_t B = (int64_t)p->B, Nq = (int64_t)p->Nq, Nk = (int64_t)p->Nk, D = (int64_t)(p->A * p->E);
    dar_dtype real = dar_compute_type(r->type);
    dar_attn *a = &r->a;
    double size = p->size > 0 ? p->size : 1;

    *a =
        (dar_attn){ .heads = p->A, .scale = 1 / sqrt((double)p->E), .add_q = r->add, .add_k = r->add, .add_v = r->add };
    a->q = fresh(r, r->type, DAR_SHAPE(B, Nq, D), 1, size);
    a->k = fresh(r, r->type, DAR_SHAPE(B, Nk, D), 2, size);
    a->v = fresh(r, r->type, DAR_SHAPE(B, Nk, D), 3, 1);
    a->y = tensor(r, r->type, DAR_SHAPE(B, Nq, D));
    a->stats = tensor(r, real, DAR_SHAPE(B, (int64_t)p->A, Nq, 2));
    a->gy = fresh(r, real, a->y.shape, 4, 1);
    if (!(r->frozen & FQ)) a->gq = tensor(r, real, a->q.shape);
    if (!(r->frozen & FK)) a->gk = tensor(r, real, a->k.shape);
    if (!(r->frozen & FV)) a->gv = tensor(r, real, a->v.shape);
    if (p->weights != PLAIN) {
        dar_shape s = p->weights == SHARED ? DAR_SHAPE(Nk) : DAR_SHAPE(B, Nk);
        a->lw = tensor(r, real, s);
        fill_weights(r, &a->lw);
    }
    size_t row = p->A * p->E * dar_dtype_size(r->type);
    for (size_t i = 1; p->equal && i < p->B * p->Nk; i++) memcpy((char *)a->k.data + i * row, a->k.data, row);
}

static void run_all(struct run *r)
{
    dar_attn *a = &r->a;
    fill_gradients(r);
    for (int back = 0; back < 2; back++) {
        a->threads = dar_threads();
        a->scratch = guarded(r, dar_attn_scratch(a, back));
        (back ? dar_attn_backward : dar_attn_forward)(a);
    }
    check_guards(r);
}

static void close_run(struct run *r)
{
    for (int i = 0; i < r->n; i++) free(r->guarded[i]);
    r->n = 0;
}

/* ---------------------------------------------------------------- the plain text */

/* Values and how far from them a right result may be: `of` rounding of arithmetic, `operand` of what is multiplied,
 * `store` of y.  First order: a weight w = exp(l) is off by (error of l) w, a sum of n terms by n roundings. */
struct expect {
    double *y, *y_off, *gq, *gq_off, *gk, *gk_off, *gv, *gv_off, *lse, *lse_off;
    double of, operand, store;
    double *q, *k, *v, *gy; /* the operands as they are stored */
};

static double *zeros(size_t n)
{
    return calloc(n ? n : 1, sizeof(double));
}

static double at(const dar_tensor *x, size_t i)
{
    return dar_dtype_get(x->dtype, x->data, i);
}

static double *values(const dar_tensor *x)
{
    double *v = zeros(dar_tensor_count(x));
    for (size_t i = 0; i < dar_tensor_count(x); i++) v[i] = at(x, i);
    return v;
}

static struct expect expect_open(const struct run *r)
{
    const struct problem *p = &r->p;
    size_t nq = p->B * p->Nq * p->A * p->E, nk = p->B * p->Nk * p->A * p->E, rows = p->B * p->A * p->Nq;
    struct expect x = {
        .y = zeros(nq),
        .y_off = zeros(nq),
        .gq = zeros(nq),
        .gq_off = zeros(nq),
        .gk = zeros(nk),
        .gk_off = zeros(nk),
        .gv = zeros(nk),
        .gv_off = zeros(nk),
        .lse = zeros(rows),
        .lse_off = zeros(rows),
        .q = values(&r->a.q),
        .k = values(&r->a.k),
        .v = values(&r->a.v),
        .gy = values(&r->a.gy),
    };
    x.of = r->type == DAR_F64 ? 0x1p-53 : 0x1p-24;
    if (r->type == DAR_BF16) x.operand = x.store = 0x1p-8;
    if (r->type == DAR_F16) x.store = 0x1p-11;
    return x;
}

static void expect_close(struct expect *x)
{
    double *all[] = { x->y,      x->y_off, x->gq,      x->gq_off, x->gk, x->gk_off, x->gv,
                      x->gv_off, x->lse,   x->lse_off, x->q,      x->k,  x->v,      x->gy };
    for (size_t i = 0; i < DAR_COUNT(all); i++) free(all[i]);
}

/* One row of one head: query row qi, keys from row kj. */
static void expect_row(const struct run *r, struct expect *x, size_t b, size_t h, size_t i)
{
    const dar_attn *a = &r->a;
    size_t Nk = r->p.Nk, E = r->p.E, D = r->p.A * E, q = (b * r->p.Nq + i) * D + h * E, k = b * Nk * D + h * E;
    double *l = zeros(Nk), *off = zeros(Nk), most = -INFINITY, sum = 0, sum_off = 0;

    for (size_t j = 0; j < Nk; j++) {
        double s = 0, abs = 0;
        double lw = a->lw.data ? at(&a->lw, (a->lw.shape.n == 2 ? b * Nk : 0) + j) : 0;
        for (size_t e = 0; e < E; e++) {
            double t = x->q[q + e] * x->k[k + j * D + e];
            s += t;
            abs += fabs(t);
        }
        l[j] = a->scale * s + lw;
        off[j] = (double)(E + 8) * x->of * a->scale * abs;
        if (lw > -INFINITY) off[j] += 4 * x->of * fabs(lw);
        most = fmax(most, l[j]);
    }
    size_t row = (b * r->p.A + h) * r->p.Nq + i;
    x->lse[row] = most;
    for (size_t j = 0; j < Nk && most > -INFINITY; j++) sum += exp(l[j] - most);
    for (size_t j = 0; j < Nk && sum > 0; j++) {
        l[j] = exp(l[j] - most) / sum; /* from here on: the weight */
        off[j] += x->of * (8 + 4 * fabs(most));
        sum_off += l[j] * off[j];
    }
    if (sum > 0) x->lse[row] = most + log(sum);
    x->lse_off[row] = sum_off + (double)(Nk + 16) * x->of;

    double dot = 0, dot_off = 0;
    for (size_t e = 0; e < E && sum > 0; e++) {
        double y = 0, y_off = 0;
        for (size_t j = 0; j < Nk; j++) y += l[j] * x->v[k + j * D + e];
        for (size_t j = 0; j < Nk; j++) {
            double v = fabs(x->v[k + j * D + e]);
            y_off += l[j] * (off[j] * (v + fabs(y)) + v * (x->operand + 2 * (double)(Nk + 16) * x->of));
        }
        x->y[q + e] = y;
        x->y_off[q + e] = y_off += (x->store + x->of) * fabs(y);
        dot += x->gy[q + e] * y;
        dot_off += fabs(x->gy[q + e]) * (y_off + (double)(E + 8) * x->of * fabs(y));
    }
    for (size_t j = 0; j < Nk && sum > 0; j++) {
        double dp = 0, dp_off = 0, w_off = off[j] + sum_off + (double)(Nk + 16) * x->of;
        for (size_t e = 0; e < E; e++) {
            double t = x->gy[q + e] * x->v[k + j * D + e];
            dp += t;
            dp_off += fabs(t) * (x->operand + (double)(E + 8) * x->of);
        }
        double ds = l[j] * (dp - dot), ds_off = l[j] * (dp_off + dot_off + w_off * fabs(dp - dot));
        ds_off += fabs(ds) * (x->operand + (double)(Nk + r->p.Nq + 16) * x->of);
        for (size_t e = 0; e < E; e++) {
            size_t kj = k + j * D + e;
            x->gq[q + e] += a->scale * ds * x->k[kj];
            x->gq_off[q + e] += a->scale * ds_off * fabs(x->k[kj]);
            x->gk[kj] += a->scale * ds * x->q[q + e];
            x->gk_off[kj] += a->scale * ds_off * fabs(x->q[q + e]);
            double g = l[j] * x->gy[q + e];
            x->gv[kj] += g;
            x->gv_off[kj] += fabs(g) * (w_off + 2 * x->operand + (double)(r->p.Nq + 16) * x->of);
        }
    }
    free(l);
    free(off);
}

static struct expect expect(const struct run *r)
{
    struct expect x = expect_open(r);
    for (size_t b = 0; b < r->p.B; b++)
        for (size_t h = 0; h < r->p.A; h++)
            for (size_t i = 0; i < r->p.Nq; i++) expect_row(r, &x, b, h, i);
    return x;
}

/* x as a value of type t. */
static double held(dar_dtype t, double x)
{
    double h;
    dar_dtype_set(t, &h, 0, x);
    return dar_dtype_get(t, &h, 0);
}

/* Bounds are first order, and denormals may flush: hence 1.1 and 1e-35. */
static void compare(const char *what, const struct run *r, const dar_tensor *x, const double *want, const double *off,
                    uint64_t added)
{
    if (!x->data) return;
    double of = x->dtype == DAR_F64 ? 0x1p-53 : 0x1p-24;
    for (size_t i = 0; i < dar_tensor_count(x); i++) {
        double before = added && r->add ? held(x->dtype, noise(added, i)) : 0;
        double w = want[i] + before, bound = 1.1 * (off[i] + (added ? 2 * of * (fabs(w) + fabs(before)) : 0)) + 1e-35;
        double found = at(x, i);
        if (!(fabs(found - w) <= bound))
            fail_msg("%s[%zu], %s level %u, B %zu Nq %zu Nk %zu A %zu E %zu weights %d frozen %d: found %.9g, expected "
                     "%.9g, off by %.3g, bound %.3g",
                     what, i, dar_dtype_name(r->type), dar_cpu_flags(), r->p.B, r->p.Nq, r->p.Nk, r->p.A, r->p.E,
                     (int)r->p.weights, r->frozen, found, w, fabs(found - w), bound);
    }
}

static void compare_stats(const struct run *r, const struct expect *x)
{
    for (size_t i = 0; i < r->p.B * r->p.A * r->p.Nq; i++) {
        double u = at(&r->a.stats, 2 * i), s = at(&r->a.stats, 2 * i + 1);
        if (x->lse[i] == -INFINITY) CHECK(u == 0 && s == 0, "stats of a row without keys: %g, %g", u, s);
        else
            CHECK_NEAR("log-sum-exp", log(s) + u * (r->a.lw.data ? log(2) : r->a.scale), x->lse[i],
                       1.1 * x->lse_off[i] + 4e-16 * fabs(x->lse[i]));
    }
}

static void check(struct run *r, const struct expect *x)
{
    compare("y", r, &r->a.y, x->y, x->y_off, 0);
    compare_stats(r, x);
    compare("gq", r, &r->a.gq, x->gq, x->gq_off, 5);
    compare("gk", r, &r->a.gk, x->gk, x->gk_off, 6);
    compare("gv", r, &r->a.gv, x->gv, x->gv_off, 7);
}

/* At every CPU level; f64 is the same at all of them. */
static void solve(struct problem p, dar_dtype type, int frozen, bool add)
{
    struct run r = { .p = p, .type = type, .frozen = frozen, .add = add };
    unsigned level[5];
    open_run(&r);
    struct expect x = expect(&r);
    for (int i = 0, n = test_levels(level); i < (type == DAR_F64 ? 1 : n); i++) {
        dar_cpu_init(level[i]);
        run_all(&r);
        check(&r, &x);
    }
    expect_close(&x);
    close_run(&r);
}

static void solve_all(struct problem p, int frozen, bool add)
{
    static const dar_dtype types[] = { DAR_F64, DAR_F32, DAR_BF16, DAR_F16 };
    for (size_t t = 0; t < DAR_COUNT(types); t++) solve(p, types[t], frozen, add);
}

/* ---------------------------------------------------------------- tests */

static const struct problem problems[] = {
    { 1, 1, 1, 1, 1, PLAIN, 0, false },      { 2, 5, 5, 3, 3, PLAIN, 0, false },
    { 2, 7, 13, 2, 8, SHARED, 0, false },    { 1, 100, 37, 3, 40, EACH, 0, false },
    { 2, 97, 97, 2, 64, PLAIN, 0, false },   { 1, 33, 300, 1, 128, SHARED, 0, false },
    { 1, 130, 259, 2, 40, PLAIN, 0, false }, { 2, 17, 31, 2, 8, NONE_LEFT, 0, false },
    { 1, 40, 40, 1, 640, PLAIN, 0, false },  { 2, 3, 600, 1, 3, EACH, 0, false },
    { 1, 700, 2, 1, 8, PLAIN, 0, false },    { 1, 20, 1100, 1, 16, EACH, 0, false },
    { 1, 129, 257, 1, 1, PLAIN, 0, false },
};

static void matches_plain_text(void **state)
{
    (void)state;
    for (size_t k = 0; k < DAR_COUNT(problems); k++) solve_all(problems[k], 0, k % 2);
}

static void frozen_inputs(void **state)
{
    (void)state;
    for (int frozen = 0; frozen < 8; frozen++) {
        solve_all((struct problem){ 2, 150, 135, 2, 8, SHARED, 0, false }, frozen, false);
        solve_all((struct problem){ 1, 1030, 5, 1, 3, PLAIN, 0, false }, frozen, true);
    }
}

static void hard_numbers(void **state)
{
    (void)state;
    solve_all((struct problem){ 1, 9, 70, 1, 8, PLAIN, 100, false }, 0, false); /* logits to 1e4 */
    solve_all((struct problem){ 1, 9, 300, 2, 64, EACH, 60, false }, 0, false);
    solve_all((struct problem){ 1, 5, 512, 1, 64, PLAIN, 0, true }, 0, false); /* equal keys */
    solve_all((struct problem){ 1, 5, 512, 1, 8, PLAIN, 100, true }, 0, false);
    solve_all((struct problem){ 2, 5, 1, 2, 8, PLAIN, 0, false }, 0, false); /* one key */
    solve_all((struct problem){ 2, 5, 0, 2, 8, PLAIN, 0, false }, 0, false); /* no key */
    solve_all((struct problem){ 2, 5, 0, 2, 8, PLAIN, 0, false }, FK | FV, true);
    solve_all((struct problem){ 2, 0, 5, 2, 8, PLAIN, 0, false }, 0, false); /* no query */
    solve_all((struct problem){ 2, 0, 5, 2, 8, PLAIN, 0, false }, FK | FV, false);
    solve_all((struct problem){ 0, 5, 5, 2, 8, PLAIN, 0, false }, 0, true); /* nothing */
}

/* A key of another block raises the maximum by far, or is the only one that is not masked. */
static void maximum_moves(void **state)
{
    unsigned level[5];
    static const dar_dtype types[] = { DAR_F64, DAR_F32, DAR_BF16 };
    (void)state;
    for (int i = 0, n = test_levels(level); i < n; i++) {
        dar_cpu_init(level[i]);
        for (size_t t = 0; t < 3 * DAR_COUNT(types); t++) {
            struct run r = { .p = { 1, 7, 900, 1, 16, SHARED, 0, false }, .type = types[t / 3] };
            open_run(&r);
            for (size_t k = 0; k < r.p.Nk; k++) {
                double w = t % 3 == 0 ? (k == 888 ? 0 : -INFINITY) : t % 3 == 1 ? (double)k / 3 : k == 600 ? 3e4 : 0;
                dar_dtype_set(r.a.lw.dtype, r.a.lw.data, k, w);
            }
            struct expect x = expect(&r);
            run_all(&r);
            check(&r, &x);
            expect_close(&x);
            close_run(&r);
        }
    }
}

static void nan_is_seen(void **state)
{
    unsigned level[5];
    static const dar_dtype types[] = { DAR_F64, DAR_F32, DAR_BF16 };
    (void)state;
    for (int i = 0, n = test_levels(level); i < n; i++) {
        dar_cpu_init(level[i]);
        for (size_t t = 0; t < DAR_COUNT(types); t++) {
            struct run r = { .p = { 1, 3, 300, 1, 8, PLAIN, 0, false }, .type = types[t] };
            open_run(&r);
            dar_dtype_set(r.type, r.a.k.data, 288 * 8 + 3, NAN);
            run_all(&r);
            for (size_t k = 0; k < 24; k++) CHECK(isnan(at(&r.a.y, k)), "y[%zu] = %g", k, at(&r.a.y, k));
            for (size_t k = 0; k < 24; k++) CHECK(isnan(at(&r.a.gq, k)), "gq[%zu] = %g", k, at(&r.a.gq, k));
            close_run(&r);
        }
    }
}

static void threads_do_not_matter(void **state)
{
    static const int threads[] = { 1, 2, 3, 7 };
    static const struct problem cases[] = { { 2, 200, 1200, 2, 8, EACH, 0, false },
                                            { 1, 1100, 70, 1, 40, PLAIN, 0, false } };
    static const dar_dtype types[] = { DAR_F64, DAR_F32, DAR_BF16 };
    int before = dar_threads();
    (void)state;
    for (size_t n = 0; n < 2 * DAR_COUNT(cases) * DAR_COUNT(types); n++) {
        struct run r[DAR_COUNT(threads)];
        for (size_t i = 0; i < DAR_COUNT(threads); i++) {
            r[i] = (struct run){ .p = cases[n % 2], .type = types[n / 2 % 3], .frozen = n < 6 ? 0 : FK | FV };
            dar_threads_set(threads[i]);
            open_run(&r[i]);
            run_all(&r[i]);
            const dar_tensor *now[] = { &r[i].a.y, &r[i].a.stats, &r[i].a.gq, &r[i].a.gk, &r[i].a.gv };
            const dar_tensor *one[] = { &r[0].a.y, &r[0].a.stats, &r[0].a.gq, &r[0].a.gk, &r[0].a.gv };
            for (size_t k = 0; k < DAR_COUNT(now); k++)
                CHECK(!now[k]->data || memcmp(now[k]->data, one[k]->data, dar_tensor_bytes(one[k])) == 0,
                      "case %zu: result %zu differs between 1 and %d threads", n, k, threads[i]);
        }
        for (size_t i = 0; i < DAR_COUNT(threads); i++) close_run(&r[i]);
    }
    dar_threads_set(before);
}

/* n copies of a key, or one with lw = log n: y and gq the same, gk and gv of the one the sum over the copies. */
static void folded_keys(void **state)
{
    static const dar_dtype types[] = { DAR_F64, DAR_F32, DAR_BF16 };
    static const double bounds[] = { 1e-13, 2e-5, 2e-2 }; /* roundings of sums of 512 terms of size 1; two of bf16 */
    (void)state;
    for (size_t t = 0; t < DAR_COUNT(types); t++) {
        struct run many = { .p = { 1, 9, 515, 2, 24, PLAIN, 0, false }, .type = types[t] };
        struct run few = { .p = { 1, 9, 4, 2, 24, SHARED, 0, false }, .type = types[t] };
        size_t D = 48, row = D * dar_dtype_size(types[t]);
        open_run(&many);
        open_run(&few);
        for (size_t j = 0; j < 515; j++) {
            memcpy((char *)many.a.k.data + j * row, (char *)few.a.k.data + (j < 3 ? j : 3) * row, row);
            memcpy((char *)many.a.v.data + j * row, (char *)few.a.v.data + (j < 3 ? j : 3) * row, row);
        }
        for (size_t j = 0; j < 4; j++) dar_dtype_set(few.a.lw.dtype, few.a.lw.data, j, j < 3 ? 0 : log(512));
        run_all(&many);
        run_all(&few);
        for (size_t i = 0; i < 9 * D; i++) {
            CHECK_NEAR("y", at(&few.a.y, i), at(&many.a.y, i), bounds[t]);
            CHECK_NEAR("gq", at(&few.a.gq, i), at(&many.a.gq, i), bounds[t]);
        }
        for (size_t e = 0; e < D; e++) {
            double gk = 0, gv = 0;
            for (size_t j = 3; j < 515; j++) {
                gk += at(&many.a.gk, j * D + e);
                gv += at(&many.a.gv, j * D + e);
            }
            CHECK_NEAR("gk", at(&few.a.gk, 3 * D + e), gk, 10 * bounds[t]);
            CHECK_NEAR("gv", at(&few.a.gv, 3 * D + e), gv, 10 * bounds[t]);
        }
        close_run(&many);
        close_run(&few);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(matches_plain_text), cmocka_unit_test(frozen_inputs), cmocka_unit_test(hard_numbers),
        cmocka_unit_test(maximum_moves),      cmocka_unit_test(nan_is_seen),   cmocka_unit_test(threads_do_not_matter),
        cmocka_unit_test(folded_keys),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
