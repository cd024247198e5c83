/* test_flow.c: times of flow matching, and the solvers against closed forms and the public schedulers. */
#include "tests/test.h"

#include "lib/json.h"
#include "models/solver.h"

static dar_arena memory;

static int setup(void **state)
{
    (void)state;
    return dar_arena_init(&memory, "test", 1 << 20, NULL) != DAR_OK;
}

static int teardown(void **state)
{
    (void)state;
    dar_arena_free(&memory);
    return 0;
}

static dar_tensor vector(int64_t n)
{
    return dar_tensor_push(&memory, DAR_F64, DAR_SHAPE(n));
}

/* ---------------------------------------------------------------- times */

static void test_training_table(void **state)
{
    (void)state;
    static const struct {
        int k;
        double sigma;
    } known[] = { { 0, 1 }, { 1, 0.9997998 }, { 500, 0.8333333 }, { 999, 0.00498008 } };
    for (size_t i = 0; i < sizeof known / sizeof *known; i++)
        CHECK_NEAR("sigma", dar_flow_sigma(known[i].k, 5), known[i].sigma, 5e-8);

    double mean = 0;
    int high = 0, low = 0;
    for (int k = 0; k < DAR_FLOW_TIMES; k++) {
        double s = dar_flow_sigma(k, 5);
        mean += s / DAR_FLOW_TIMES;
        high += s > 0.9, low += s < 0.1;
    }
    CHECK_NEAR("mean", mean, 0.7476, 5e-5);
    assert_int_equal(high, 358);
    assert_int_equal(low, 21);
    CHECK_NEAR("no shift", dar_flow_sigma(250, 1), 0.75, 0);
}

/* Share of draws whose sigma before the shift lies in each half and quarter, u stepping evenly through [0, 1). */
static void test_densities(void **state)
{
    (void)state;
    /* Phi(log(q / (1 - q))); mode has no closed form here; 2 / pi atan(1 / (1 - q) - 1). */
    static const double below_quarter[] = { 0.25, 0.13598, NAN, 0.20483 };
    enum { N = 100000 };
    for (int d = 0; d < DAR_FLOW_DENSITIES; d++) {
        int quarter = 0, half = 0, before = -1;
        for (int i = 0; i < N; i++) {
            int k = dar_flow_draw((dar_flow_density)d, (i + 0.5) / N);
            assert_in_range(k, 0, DAR_FLOW_TIMES - 1);
            if (d != DAR_FLOW_MODE) CHECK(k >= before, "%s: not monotonous", dar_flow_density_name[d]);
            before = k;
            quarter += k < 250, half += k < 500;
        }
        CHECK_NEAR(dar_flow_density_name[d], half / (double)N, 0.5, 1e-4);
        if (d != DAR_FLOW_MODE) CHECK_NEAR(dar_flow_density_name[d], quarter / (double)N, below_quarter[d], 2e-4);
        else CHECK(quarter < N / 4, "mode: %d of %d below a quarter", quarter, N);
    }
    assert_int_equal(dar_flow_draw(DAR_FLOW_LOGIT_NORMAL, 0), 0);
    CHECK_ABORTS(dar_flow_draw(DAR_FLOW_UNIFORM, 1));
}

static void test_weights(void **state)
{
    (void)state;
    double mean = 0, least = 1;
    for (int k = 0; k < DAR_FLOW_TIMES; k++) {
        double s = dar_flow_sigma(k, 5), w = dar_flow_weight(DAR_FLOW_BELL, s, 5);
        mean += w / DAR_FLOW_TIMES;
        least = fmin(least, w);
        CHECK_NEAR("none", dar_flow_weight(DAR_FLOW_FLAT, s, 5), 1, 0);
    }
    CHECK_NEAR("mean", mean, 1, 1e-12);
    CHECK_NEAR("least", least, 0, 1e-15);
}

/* The interpolant's own identities, in both types. */
static void test_path(void **state)
{
    (void)state;
    enum { N = 5000 }; /* more than one piece, and a tail */
    for (int type = DAR_F64; type <= DAR_F32; type++) {
        double eps = type == DAR_F64 ? 4.5e-16 : 2.4e-7, sigma = 0.3;
        dar_mark m = dar_arena_mark(&memory);
        dar_tensor t[4];
        for (int i = 0; i < 4; i++) t[i] = dar_tensor_push(&memory, (dar_dtype)type, DAR_SHAPE(N));
        for (size_t i = 0; i < N; i++) {
            dar_dtype_set(t[0].dtype, t[0].data, i, sin((double)i));
            dar_dtype_set(t[0].dtype, t[1].data, i, cos(3 * (double)i));
        }
        dar_flow_mix(&t[0], &t[1], sigma, &t[2]);
        dar_flow_target(&t[0], &t[1], &t[3]);
        for (size_t i = 0; i < N; i++) {
            double z0 = dar_dtype_get(t[0].dtype, t[0].data, i), noise = dar_dtype_get(t[0].dtype, t[1].data, i);
            double z = dar_dtype_get(t[0].dtype, t[2].data, i), v = dar_dtype_get(t[0].dtype, t[3].data, i);
            CHECK_NEAR("z", z, 0.7 * z0 + 0.3 * noise, eps);
            CHECK_NEAR("v", v, noise - z0, eps);
        }
        dar_flow_mix(&t[0], &t[1], sigma, &t[0]); /* in place */
        assert_memory_equal(t[0].data, t[2].data, dar_tensor_bytes(&t[0]));
        dar_arena_reset(&memory, m);
    }
}

/* ---------------------------------------------------------------- grids */

static void test_grids(void **state)
{
    (void)state;
    /* First and last points of 50 steps with shift 5: those of "twice" and "whole" as the references print them. */
    static const struct {
        double first[5], last[5];
    } known[DAR_GRIDS] = {
        [DAR_GRID_EVEN] = { { 1, 0.995935, 0.991736, 0.987395, 0.982906 },
                            { 0.30303, 0.241935, 0.172414, 0.092593, 0 } },
        [DAR_GRID_TWICE] = { { 1, 0.995872, 0.991605, 0.987192, 0.982626 },
                             { 0.260762, 0.192804, 0.114819, 0.024414, 0 } },
        [DAR_GRID_WHOLE] = { { 0.9998, 0.995732, 0.99153, 0.987187, 0.982696 },
                             { 0.302801, 0.24174, 0.172265, 0.092507, 0 } },
        [DAR_GRID_DIFFUSERS] = { { 0.999999, 0.995939, 0.991744, 0.987408, 0.982924 },
                                 { 0.305663, 0.244983, 0.175969, 0.096778, 0 } },
    };
    double sigma[51], time[50];
    for (int g = 0; g < DAR_GRIDS; g++) {
        dar_flow_fill((dar_flow_grid)g, 50, 5, sigma, time);
        for (int i = 0; i < 5; i++) {
            CHECK_NEAR(dar_flow_grid_name[g], sigma[i], known[g].first[i], 6e-7);
            CHECK_NEAR(dar_flow_grid_name[g], sigma[46 + i], known[g].last[i], 6e-7);
        }
        for (int i = 0; i < 50; i++) {
            CHECK(sigma[i] > sigma[i + 1], "%s: sigma %d does not fall", dar_flow_grid_name[g], i);
            CHECK_NEAR("time", time[i], g == DAR_GRID_WHOLE ? floor(1000 * sigma[i]) : 1000 * sigma[i], 0);
        }
        dar_flow_fill((dar_flow_grid)g, 1, 5, sigma, time);
        CHECK(sigma[0] > 0.99 && sigma[1] == 0, "%s: one step from %g to %g", dar_flow_grid_name[g], sigma[0],
              sigma[1]);
    }
    static const double whole[] = { 999, 995, 991, 987, 982, 978 };
    dar_flow_fill(DAR_GRID_WHOLE, 50, 5, sigma, time);
    for (int i = 0; i < 6; i++) CHECK_NEAR("time", time[i], whole[i], 0);
}

/* ---------------------------------------------------------------- solvers */

/* States of the public schedulers in f64 (but those of Euler and DPM++ store f32: so is their bound). */
static void test_references(void **state)
{
    (void)state;
    dar_json_doc *doc;
    dar_err e;
    CHECK(dar_json_open(&doc, "tests/fixtures/solvers.json", &e) == DAR_OK, "%s", e.text);
    int runs = 0;
    for (dar_json run = dar_json_first(dar_json_root(doc)); run.item; run = dar_json_next(run), runs++) {
        int kind = dar_json_choice(run, "solver", -1, dar_solver_name);
        size_t steps = dar_json_size(dar_json_array(run, "sigma")) - 1, i = 0;
        double x[7], sigma[16], bound = kind == DAR_UNIPC ? 1e-12 : 2e-6;
        dar_mark m = dar_arena_mark(&memory);
        dar_tensor z = vector(7), v = vector(7);
        dar_solver s;
        dar_solver_config c = { .kind = (dar_solver_kind)kind, .grid = DAR_GRID_EVEN, .steps = steps, .shift = 5 };
        if (kind == DAR_UNIPC) c.grid = DAR_GRID_DIFFUSERS;
        if (kind == DAR_EULER) c.grid = DAR_GRID_TWICE;
        dar_solver_init(&s, &c, &z, &memory);
        sigma[0] = NAN;
        dar_json_numbers(run, "sigma", sigma, steps + 1);
        for (size_t k = 0; k <= steps; k++) {
            if (kind != DAR_DPMPP) CHECK_NEAR("grid", s.sigma[k], sigma[k], 1e-7); /* it is f32 there */
            s.sigma[k] = sigma[k];
        }
        for (dar_json at = dar_json_first(dar_json_array(run, "states")); at.item; at = dar_json_next(at), i++) {
            x[0] = NAN;
            dar_json_numbers(at, NULL, x, 7);
            double *now = z.data, *say = v.data;
            for (int k = 0; k < 7; k++) {
                if (i == 0) now[k] = x[k];
                CHECK_NEAR(dar_solver_name[kind], now[k], x[k], bound);
                say[k] = tanh(2 * now[k]) + s.sigma[i];
            }
            if (i < steps) dar_solver_step(&s, &v, &z);
        }
        assert_int_equal(i, steps + 1);
        dar_arena_reset(&memory, m);
    }
    assert_int_equal(runs, 12);
    CHECK(dar_json_finish(doc, &e) == DAR_OK, "%s", e.text);
    dar_json_close(doc);
}

/* Data normal with mean mu and deviation tau: on the path z - (1 - sigma) mu grows as sqrt(var(sigma)). */
static const double mu = 0.7, tau = 0.4, start = -1.3;

static double variance(double sigma)
{
    return (1 - sigma) * (1 - sigma) * tau * tau + sigma * sigma;
}

static double exact(double sigma)
{
    return (1 - sigma) * mu + sqrt(variance(sigma)) * start;
}

/* Distance from the exact end of the way from sigma = `from` to `to` in even steps. */
static double distance(dar_solver_kind kind, size_t steps, double from, double to)
{
    dar_mark m = dar_arena_mark(&memory);
    dar_tensor z = vector(1), v = vector(1);
    double *at = z.data, *say = v.data;
    dar_solver s;
    dar_solver_config c = { .kind = kind, .grid = DAR_GRID_EVEN, .steps = steps, .shift = 1 };
    dar_solver_init(&s, &c, &z, &memory);
    for (size_t i = 0; i <= steps; i++) s.sigma[i] = from + (to - from) * (double)i / (double)steps;
    s.sigma[steps] = to;

    *at = exact(from);
    while (s.step < s.steps) {
        double g = s.sigma[s.step], slope = (g - (1 - g) * tau * tau) / variance(g);
        *say = -mu + slope * (*at - (1 - g) * mu);
        dar_solver_step(&s, &v, &z);
    }
    double d = fabs(*at - exact(to));
    dar_arena_reset(&memory, m);
    return d;
}

/* Between the ends, where the log ratio of signal to noise is bounded, each has its order; over the whole way, of which
 * dpm++ and unipc do the first two steps and the last at order 1 in an infinite log ratio, they still converge. */
static void test_orders(void **state)
{
    (void)state;
    static const double order[DAR_SOLVERS] = { [DAR_EULER] = 1, [DAR_AB2] = 2, [DAR_UNIPC] = 3, [DAR_DPMPP] = 2 };
    for (int i = 0; i < DAR_SOLVERS; i++) {
        dar_solver_kind k = (dar_solver_kind)i;
        double coarse = distance(k, 400, 0.95, 0.05), fine = distance(k, 800, 0.95, 0.05);
        double whole = distance(k, 400, 1, 0), found = log2(coarse / fine);
        printf("%s: order %.2f; whole way in 400 steps: %.2g\n", dar_solver_name[k], found, whole);
        CHECK_NEAR(dar_solver_name[k], found, order[k], 0.15);
        CHECK(whole < 0.01 && distance(k, 800, 1, 0) < 0.6 * whole, "%s: does not converge", dar_solver_name[k]);
    }
}

/* ---------------------------------------------------------------- a tolerance */

#define POINTS  2000
#define STARTS  5
#define HARDEST 1e-7

typedef double field(double sigma, double z);

static double normal_flow(double sigma, double z)
{
    return -mu + (sigma - (1 - sigma) * tau * tau) / variance(sigma) * (z - (1 - sigma) * mu);
}

/* The same until it turns, within four points of the grid. */
static double turning_flow(double sigma, double z)
{
    return normal_flow(sigma, z) + 2 * tanh((0.5 - sigma) * POINTS);
}

/* Nothing foretells this. */
static double rough_flow(double sigma, double z)
{
    return normal_flow(sigma, z) + sin(1e6 * sigma);
}

struct ride {
    dar_solver s;
    double end[STARTS];
};

/* Of several starts at once, so that the norm of z stays away from 0. */
static struct ride ride_within(dar_solver_kind kind, double tolerance, double budget, size_t steps, field *f)
{
    struct ride r;
    dar_mark m = dar_arena_mark(&memory);
    dar_tensor z = vector(STARTS), v = vector(STARTS);
    double *at = z.data, *say = v.data;
    dar_solver_config c = { .kind = kind, .grid = DAR_GRID_EVEN, .steps = steps, .shift = 1 };
    c.tolerance = tolerance, c.budget = budget;
    dar_solver_init(&r.s, &c, &z, &memory);
    for (size_t i = 0; i <= steps; i++) r.s.sigma[i] = 0.95 - 0.9 * (double)i / (double)steps;
    for (int k = 0; k < STARTS; k++) at[k] = 0.95 * (k - 2) + 0.1;
    while (r.s.step < r.s.steps) {
        for (int k = 0; k < STARTS; k++) say[k] = f(r.s.sigma[r.s.step], at[k]);
        dar_solver_step(&r.s, &v, &z);
    }
    memcpy(r.end, at, sizeof r.end);
    dar_arena_reset(&memory, m);
    return r;
}

static struct ride ride(dar_solver_kind kind, double tolerance, size_t steps, field *f)
{
    return ride_within(kind, tolerance, 0, steps, f);
}

/* In the Euclidean norm, relative. */
static double apart(const double *x, const double *y)
{
    double d = 0, all = 0;
    for (int k = 0; k < STARTS; k++) d += (x[k] - y[k]) * (x[k] - y[k]), all += y[k] * y[k];
    return sqrt(d / all);
}

/* The error falls with the tolerance, decade by decade, until every point is called.  What the order below differs by
 * is h^2 (euler: h^3), at most T, of which the step itself is off by a part of order h; steps are as many as 1 / h; so
 * all of them are off by a few T.  And what is told is no less: it is the error of the order below.  Euler follows its
 * plain run, which is compared with; so do the others, which are then near the ODE. */
static void test_tolerance(void **state)
{
    (void)state;
    for (int i = 0; i < DAR_SOLVERS; i++) {
        dar_solver_kind k = (dar_solver_kind)i;
        struct ride plain = ride(k, 0, POINTS, normal_flow);
        size_t before = 0;
        double largest = 0;
        assert_int_equal(plain.s.calls, POINTS);
        for (double T = 1e-2; T >= HARDEST; T /= 10) {
            struct ride r = ride(k, T, POINTS, normal_flow);
            double off = apart(r.end, plain.end);
            printf("%s, tolerance %.0e: %zu calls, error %.1e, estimate %.1e\n", dar_solver_name[k], T, r.s.calls, off,
                   r.s.estimate);
            CHECK(off <= 3 * T, "%s: %g is more than 3 times the tolerance %g", dar_solver_name[k], off, T);
            CHECK(off <= r.s.estimate, "%s: %g is more than was estimated, %g", dar_solver_name[k], off, r.s.estimate);
            CHECK(r.s.calls > before, "%s: %zu calls at %g", dar_solver_name[k], r.s.calls, T);
            before = r.s.calls;
            largest = fmax(largest, off / T);
        }
        CHECK(largest > 1e-3, "%s: the error does not depend on the tolerance", dar_solver_name[k]);
    }
}

/* No tolerance to speak of: the plain run, to the bit. */
static void test_tolerance_of_nothing(void **state)
{
    (void)state;
    for (int i = 0; i < DAR_SOLVERS; i++) {
        struct ride plain = ride((dar_solver_kind)i, 0, 40, normal_flow);
        struct ride r = ride((dar_solver_kind)i, 1e-300, 40, normal_flow);
        assert_int_equal(r.s.calls, 40);
        assert_memory_equal(r.end, plain.end, sizeof r.end);
    }
}

/* What is estimated stays within the budget, and the error with it: Euler's steps of one point are the plain run's. */
static void test_budget(void **state)
{
    (void)state;
    const double T = 1e-2;
    struct ride plain = ride(DAR_EULER, 0, POINTS, normal_flow), free = ride(DAR_EULER, T, POINTS, normal_flow);
    size_t before = free.s.calls;
    for (double part = 0.5; part > 1e-3; part /= 8) {
        double budget = part * free.s.estimate;
        struct ride r = ride_within(DAR_EULER, T, budget, POINTS, normal_flow);
        double off = apart(r.end, plain.end);
        printf("euler, budget %.1e: %zu calls, error %.1e, estimate %.1e\n", budget, r.s.calls, off, r.s.estimate);
        CHECK(r.s.estimate <= budget * (1 + 1e-12), "%g was estimated, of %g", r.s.estimate, budget);
        CHECK(off <= budget, "%g is more than the budget %g", off, budget);
        CHECK(r.s.calls > before && r.s.calls <= POINTS, "%zu calls, before %zu", r.s.calls, before);
        before = r.s.calls;
    }
}

/* Where the flow turns, steps are taken back: without that the error is 0.05.  Where nothing can be foretold, a run
 * costs no more calls than the plain one. */
static void test_guard(void **state)
{
    (void)state;
    static const dar_solver_kind guarded[] = { DAR_EULER, DAR_UNIPC };
    for (int i = 0; i < 2; i++) {
        dar_solver_kind k = guarded[i];
        struct ride plain = ride(k, 0, POINTS, turning_flow), r = ride(k, 1e-4, POINTS, turning_flow);
        double off = apart(r.end, plain.end);
        printf("%s: %zu calls, %zu taken back, error %.1e\n", dar_solver_name[k], r.s.calls, r.s.rejected, off);
        CHECK(r.s.rejected > 0 && r.s.calls < POINTS / 4, "%s: nothing is taken back", dar_solver_name[k]);
        CHECK(off <= 1e-3, "%s: %g", dar_solver_name[k], off);
    }
    for (int i = 0; i < DAR_SOLVERS; i++)
        for (double T = 1; T > 1e-6; T /= 7) {
            struct ride r = ride((dar_solver_kind)i, T, 60, rough_flow);
            CHECK(r.s.calls <= 60, "%s: %zu calls of 60", dar_solver_name[i], r.s.calls);
        }
}

/* A planning arena counts what a real one is asked for; f32 follows f64. */
static void test_memory_and_types(void **state)
{
    (void)state;
    for (int i = 0; i < 2 * DAR_SOLVERS; i++) {
        dar_solver_config c = dar_solver_default();
        int k = i % DAR_SOLVERS;
        c.kind = (dar_solver_kind)k, c.steps = 6;
        c.tolerance = i < DAR_SOLVERS ? 0 : 1e-2;
        c.grid = dar_solver_grid(c.kind);
        dar_arena plan;
        assert_int_equal(dar_arena_init_plan(&plan, "plan", NULL), DAR_OK);
        dar_tensor like = dar_tensor_push(&plan, DAR_F32, DAR_SHAPE(48, 2, 3));
        size_t before = plan.used;
        dar_solver s;
        dar_solver_init(&s, &c, &like, &plan);

        double end[2] = { 0, 0 };
        for (int type = DAR_F64; type <= DAR_F32; type++) {
            dar_mark m = dar_arena_mark(&memory);
            dar_tensor z = dar_tensor_push(&memory, (dar_dtype)type, DAR_SHAPE(48, 2, 3));
            dar_tensor v = dar_tensor_push(&memory, (dar_dtype)type, DAR_SHAPE(48, 2, 3));
            size_t used = memory.used;
            dar_solver_init(&s, &c, &z, &memory);
            if (type == DAR_F32) assert_int_equal(memory.used - used, plan.used - before);
            dar_tensor_fill(&z, 1.5);
            while (s.step < s.steps) {
                dar_tensor_fill(&v, cos(3 * s.sigma[s.step]));
                dar_solver_step(&s, &v, &z);
            }
            end[type] = dar_dtype_get((dar_dtype)type, z.data, 287);
            dar_arena_reset(&memory, m);
        }
        CHECK_NEAR(dar_solver_name[k], end[DAR_F32], end[DAR_F64], 4e-6);
        dar_arena_free(&plan);
    }
}

static void test_one_step_too_many(void **state)
{
    (void)state;
    static dar_solver s;
    static dar_tensor z;
    dar_solver_config c = dar_solver_default();
    z = vector(3);
    c.steps = 1;
    dar_solver_init(&s, &c, &z, &memory);
    dar_tensor_fill(&z, 0);
    dar_solver_step(&s, &z, &z);
    CHECK_ABORTS(dar_solver_step(&s, &z, &z));
}

int main(void)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_training_table),
        cmocka_unit_test(test_densities),
        cmocka_unit_test(test_weights),
        cmocka_unit_test(test_path),
        cmocka_unit_test(test_grids),
        cmocka_unit_test(test_references),
        cmocka_unit_test(test_orders),
        cmocka_unit_test(test_tolerance),
        cmocka_unit_test(test_tolerance_of_nothing),
        cmocka_unit_test(test_budget),
        cmocka_unit_test(test_guard),
        cmocka_unit_test(test_memory_and_types),
        cmocka_unit_test(test_one_step_too_many),
    };
    return cmocka_run_group_tests_name("flow", tests, setup, teardown) != 0;
}
