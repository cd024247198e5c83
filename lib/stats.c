/* stats.c: see stats.h. */
#include "lib/stats.h"

#include <math.h>
#include <stdlib.h>

#include "lib/rng.h"
#include "lib/size.h"
#include "lib/thread.h"

#define CHUNK 256 /* resampled sets of a task */

struct resampling {
    const double *x;
    size_t n;
    uint64_t seed;
    double *mean;
};

/* Four draws of one block of random numbers; that n does not divide 2^32 makes some values likelier by n / 2^32. */
static void resample(void *ctx, size_t begin, size_t end, int thread)
{
    const struct resampling *r = ctx;
    const uint32_t key[2] = { (uint32_t)r->seed, (uint32_t)(r->seed >> 32) };
    (void)thread;
    for (size_t set = begin; set < end; set++) {
        double sum = 0;
        uint32_t draw[4];
        for (size_t i = 0; i < r->n; i++) {
            const uint32_t counter[4] = { (uint32_t)(i / 4), (uint32_t)set, (uint32_t)r->n, 0 };
            if (i % 4 == 0) dar_rng_philox(counter, key, draw);
            sum += r->x[(uint64_t)draw[i % 4] * r->n >> 32];
        }
        r->mean[set] = sum / (double)r->n;
    }
}

static int ascending(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static double percentile(const double *sorted, size_t n, double share)
{
    double at = share * (double)(n - 1);
    size_t i = (size_t)at, next = dar_least(i + 1, n - 1);
    return sorted[i] + (at - (double)i) * (sorted[next] - sorted[i]);
}

dar_interval dar_stats_bootstrap(const double *x, size_t n, uint64_t seed, double *work)
{
    dar_interval v = { n, NAN, NAN, NAN };
    double sum = 0;
    for (size_t i = 0; i < n; i++) sum += x[i];
    if (n) v.mean = sum / (double)n;
    if (n < 2) return v;
    dar_parallel_range(DAR_BOOTSTRAP, CHUNK, resample, &(struct resampling){ x, n, seed, work });
    qsort(work, DAR_BOOTSTRAP, sizeof *work, ascending);
    v.lo = percentile(work, DAR_BOOTSTRAP, 0.025);
    v.hi = percentile(work, DAR_BOOTSTRAP, 0.975);
    return v;
}

double dar_stats_fair(size_t heads, size_t n)
{
    size_t few = dar_least(heads, n - heads);
    double p = 0, all = (double)n;
    if (2 * few == n) return 1;
    for (size_t k = 0; k <= few; k++)
        p += exp(lgamma(all + 1) - lgamma((double)k + 1) - lgamma(all - (double)k + 1) - all * 0.69314718055994530942);
    return fmin(1, 2 * p);
}
