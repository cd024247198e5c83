/* stats.h: how sure a mean is, and whether a coin is fair. */
#ifndef DAR_LIB_STATS_H
#define DAR_LIB_STATS_H

#include <stddef.h>
#include <stdint.h>

/* A mean and the interval that holds 95 % of the means of resampled sets. */
typedef struct dar_interval {
    size_t n;      /* values */
    double mean;   /* NAN: n = 0 */
    double lo, hi; /* NAN: n < 2, one value tells nothing about others */
} dar_interval;

#define DAR_BOOTSTRAP 10000 /* resampled sets */

/* Percentile bootstrap of the mean: DAR_BOOTSTRAP sets of n values drawn from x with repetition; lo and hi are
 * their 2.5 and 97.5 percentiles, linear between neighbours.  Sets drawn with one seed and n are the same for every x,
 * so that differences may be taken before or after.  work: DAR_BOOTSTRAP numbers.  Source: Efron 1979. */
dar_interval dar_stats_bootstrap(const double *x, size_t n, uint64_t seed, double *work);

/* Probability that n tosses of a fair coin are at least as far from n / 2 as `heads` is: the exact two-sided binomial
 * test.  1 for n = 0. */
double dar_stats_fair(size_t heads, size_t n);

#endif
