/* test_guidance.c: the velocity with the negative prompt, left out where a line stands for it. */
#include "tests/test.h"

#include "models/guidance.h"

#define N     7
#define CALLS 400
#define G     3.0

/* What the prompts say at sigma; they differ by a curve, from sigma = 0.5 on by another one if it bends. */
static void say(double sigma, bool bends, double *c, double *u)
{
    for (int k = 0; k < N; k++) {
        c[k] = cos(k + sigma) + 2;
        u[k] = c[k] - 0.1 * sin(2 * sigma + k) - (bends && sigma < 0.5 ? sigma - 0.5 : 0);
    }
}

struct walk {
    dar_guidance s;
    double worst; /* of the velocity, in the Euclidean norm, relative to it */
    bool row,
        back; /* u was left out in two calls next to each other; where the guard found G exceeded, it asked again */
    double last[N];
};

static struct walk walk(double tolerance, bool bends, bool alike)
{
    struct walk w = { .back = true };
    dar_arena a;
    dar_err e;
    assert_int_equal(dar_arena_init(&a, "guidance", 1 << 16, &e), DAR_OK);
    dar_tensor c = dar_tensor_push(&a, DAR_F64, DAR_SHAPE(N)), u = dar_tensor_push(&a, DAR_F64, DAR_SHAPE(N));
    double *v = c.data, *other = u.data, truth[N];
    dar_guidance_init(&w.s, G, tolerance, &c, &a);
    bool found = false;
    for (int i = 0; i < CALLS; i++) {
        double sigma = 0.95 - 0.9 * i / CALLS, off = 0, all = 0;
        say(sigma, bends, v, other);
        if (alike) memcpy(other, v, sizeof truth);
        for (int k = 0; k < N; k++) truth[k] = G * v[k] + (1 - G) * other[k];
        bool asks = dar_guidance_asks(&w.s, sigma);
        w.back = w.back && (asks || !found);
        w.row = w.row || (!asks && w.s.row);
        dar_guidance_apply(&w.s, sigma, asks ? &u : NULL, &c);
        found = asks && tolerance > 0 && w.s.error > tolerance;
        for (int k = 0; k < N; k++) off += (v[k] - truth[k]) * (v[k] - truth[k]), all += truth[k] * truth[k];
        w.worst = fmax(w.worst, sqrt(off / all));
        memcpy(w.last, v, sizeof w.last);
    }
    dar_arena_free(&a);
    return w;
}

/* The error follows the tolerance: what is foretold is the remainder of second order; the next, over so short a way, is
 * a part of it. */
static void follows_the_tolerance(void **state)
{
    (void)state;
    size_t before = CALLS;
    for (double T = 1e-4; T > 4e-6; T /= 4) {
        struct walk w = walk(T, false, false);
        printf("guidance, tolerance %.0e: %zu of %d left out, error %.1e, found %.1e\n", T, w.s.left_out, CALLS,
               w.worst, w.s.worst);
        CHECK(w.worst <= 1.5 * T && w.s.worst <= 1.5 * T, "%g at %g", w.worst, T);
        CHECK(w.s.left_out > 0 && w.s.left_out <= before, "%zu left out", w.s.left_out);
        before = w.s.left_out;
    }
    struct walk none = walk(1e-300, false, false), plain = walk(0, false, false);
    assert_int_equal(none.s.left_out, 0);
    assert_int_equal(plain.s.left_out, 0);
    CHECK_NEAR("without", plain.worst, 0, 1e-15);
    assert_memory_equal(none.last, plain.last, sizeof plain.last);
}

/* A bend that nothing foretold is found at the next comparison, is told, and both are computed from there. */
static void guard(void **state)
{
    (void)state;
    const double T = 1e-4;
    struct walk w = walk(T, true, false);
    printf("guidance that bends: error %.1e, found %.1e\n", w.worst, w.s.worst);
    CHECK(w.worst > 10 * T, "it does not bend: %g", w.worst);
    CHECK(w.s.worst > T, "%g was not found", w.worst);
    CHECK(w.back && w.row, "after it was found, u is left out");
    struct walk same = walk(T, false, true); /* never wrong: compared all the same */
    assert_int_equal(same.s.left_out,
                     (CALLS - 3) / DAR_GUIDANCE_CHECK * (DAR_GUIDANCE_CHECK - 1) + (CALLS - 3) % DAR_GUIDANCE_CHECK);
}

int main(void)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(follows_the_tolerance),
        cmocka_unit_test(guard),
    };
    return cmocka_run_group_tests_name("guidance", tests, NULL, NULL) != 0;
}
