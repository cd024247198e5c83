/* test.h: what every test program includes: cmocka, and number checks in which NaN fails.
 *
 * Never use cmocka's own float checks: they let NaN pass. */
#ifndef DAR_TESTS_TEST_H
#define DAR_TESTS_TEST_H

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#include "lib/cpu.h"
#include "lib/status.h"
#include "lib/thread.h"

/* found within bound of expected; says what was compared. */
#define CHECK_NEAR(what, found, expected, bound)                                                                       \
    do {                                                                                                               \
        double check_f = (found), check_e = (expected), check_b = (bound);                                             \
        if (!(fabs(check_f - check_e) <= check_b))                                                                     \
            fail_msg("%s: found %.17g, expected %.17g, off by %.3g, bound %.3g", (what), check_f, check_e,             \
                     fabs(check_f - check_e), check_b);                                                                \
    } while (0)

#define CHECK(cond, ...)                                                                                               \
    do {                                                                                                               \
        if (!(cond)) fail_msg(__VA_ARGS__);                                                                            \
    } while (0)

/* A call whose DAR_ASSERT must fire.  Only outside parallel regions. */
static inline void test_abort(const char *text, const char *file, int line)
{
    static char kept[512]; /* cmocka prints it when the caller's buffer is gone */
    snprintf(kept, sizeof kept, "%s", text);
    mock_assert(0, kept, file, line);
}

#define CHECK_ABORTS(call)                                                                                             \
    do {                                                                                                               \
        dar_abort_fn *check_old = dar_abort_handler;                                                                   \
        dar_abort_handler = test_abort;                                                                                \
        expect_assert_failure(call);                                                                                   \
        dar_abort_handler = check_old;                                                                                 \
    } while (0)

/* End the test as skipped; the reason is printed and counted. */
#define SKIP(reason)                                                                                                   \
    do {                                                                                                               \
        printf("skip: %s: %s\n", __func__, reason);                                                                    \
        skip();                                                                                                        \
    } while (0)

/* Every CPU level that this machine has, weakest first: for (int i = 0; i < test_levels(level); i++). */
static inline int test_levels(unsigned level[5])
{
    static const unsigned all[] = { 0, DAR_CPU_AVX2, DAR_CPU_AVX2 | DAR_CPU_AVX512,
                                    DAR_CPU_AVX2 | DAR_CPU_AVX512 | DAR_CPU_BF16, DAR_CPU_ALL };
    int n = 0;
    for (int i = 0; i < 5; i++)
        if ((all[i] & dar_cpu_detect()) == all[i]) level[n++] = all[i];
    return n;
}

#endif
