/* ulp.h: how far the f32 functions of the kernel table are from the truth, in units in the last place.
 *
 * The truth is the f64 table at the same argument.  A unit is the spacing of f32 at the truth, at least 2^-149;
 * overflow counts as 2^128.  NaN must give NaN, and a zero keeps its sign. */
#ifndef DAR_TESTS_ULP_H
#define DAR_TESTS_ULP_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#include "lib/cpu.h"
#include "lib/kern_sets.h"
#include "lib/status.h"

/* The f32 tables of the levels that this processor has; [0], the reference, calls the C library and is not scanned. */
#define ULP_LEVELS 4

typedef struct ulp_tables {
    dar_kern f32[ULP_LEVELS], f64;
    int n;
} ulp_tables;

static inline void ulp_tables_init(ulp_tables *t)
{
    unsigned flags = dar_cpu_detect();
    t->n = flags & DAR_CPU_BF16 ? 4 : flags & DAR_CPU_AVX512 ? 3 : flags & DAR_CPU_AVX2 ? 2 : 1;
    dar_kern_ref_f64(&t->f64);
    for (int i = 0; i < t->n; i++) {
        dar_kern_ref_f32(&t->f32[i]);
        if (i == 1) dar_kern_avx2(&t->f32[i]);
        if (i == 2) dar_kern_avx512(&t->f32[i]);
        if (i == 3) dar_kern_bf16(&t->f32[i]);
    }
}

enum { ULP_EXP, ULP_TANH, ULP_RSQRT, ULP_SILU, ULP_FUNCTIONS };

/* The bound of kern.h. */
static inline double ulp_bound(int f)
{
    return f == ULP_SILU ? 2.5 : 2;
}

static inline const char *ulp_name(int f)
{
    static const char *const name[] = { "exp", "tanh", "rsqrt", "silu" };
    return name[f];
}

static inline dar_kern_map *ulp_function(const dar_kern *k, int f)
{
    dar_kern_map *const fn[] = { k->exp, k->tanh, k->rsqrt, k->silu };
    return fn[f];
}

static inline double ulp_error(float found, double truth)
{
    if (isnan(truth) || isnan(found)) return isnan(truth) && isnan(found) ? 0 : INFINITY;
    if (truth == 0 && (found != 0 || !signbit(found) != !signbit(truth))) return INFINITY;
    if (fabs(truth) > 0x1p128) truth = copysign(0x1p128, truth);
    double f = isinf(found) ? copysign(0x1p128, found) : found;
    int e;
    frexp(truth, &e); /* |truth| in [2^(e-1), 2^e) */
    if (fabs(truth) == 0x1p128) e = 128;
    return fabs(f - truth) / ldexp(1, e - 24 > -149 ? e - 24 : -149);
}

typedef struct ulp_worst {
    double error;
    uint32_t at; /* the argument's bits */
} ulp_worst;

#define ULP_BLOCK 1024

/* Look at the arguments with bits first, first + step, ... (n of them) and raise worst[level][function]. */
static inline void ulp_scan(const ulp_tables *t, uint32_t first, uint32_t step, size_t n,
                            ulp_worst worst[ULP_LEVELS][ULP_FUNCTIONS])
{
    float x[ULP_BLOCK], y[ULP_BLOCK];
    double x64[ULP_BLOCK], truth[ULP_BLOCK];

    for (size_t done = 0; done < n; done += ULP_BLOCK) {
        size_t m = n - done < ULP_BLOCK ? n - done : ULP_BLOCK;
        for (size_t i = 0; i < m; i++) {
            uint32_t bits = first + (uint32_t)(done + i) * step;
            memcpy(&x[i], &bits, sizeof bits);
            x64[i] = x[i];
        }
        for (int f = 0; f < ULP_FUNCTIONS; f++) {
            ulp_function(&t->f64, f)(m, x64, truth);
            for (int k = 1; k < t->n; k++) {
                ulp_function(&t->f32[k], f)(m, x, y);
                for (size_t i = 0; i < m; i++) {
                    double e = ulp_error(y[i], truth[i]);
                    if (e <= worst[k][f].error) continue;
                    worst[k][f].error = e;
                    memcpy(&worst[k][f].at, &x[i], sizeof x[i]);
                }
            }
        }
    }
}

#endif
