/* rate.c: see rate.h. */
#include "tests/rate.h"

#include <stdlib.h>
#include <sys/resource.h>
#include <time.h>

#include "tests/bench.h"

double rate_seconds(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static int by_size(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

double rate_peak(void)
{
    double sample[15];
    for (size_t i = 0; i < DAR_COUNT(sample); i++) sample[i] = bench_peak_sample(BENCH_BF16);
    qsort(sample, DAR_COUNT(sample), sizeof *sample, by_size);
    return sample[DAR_COUNT(sample) / 2] * 1e9;
}

void rate_say(const dar_run *r, const char *what, double seconds, double flops, double most)
{
    dar_run_say(r, "%-8s %8.2f s  %7.2f TFLOP  %6.1f GF/s, %.2f of the peak", what, seconds, flops * 1e-12,
                flops / seconds * 1e-9, flops / seconds / most);
}

double rate_planned(const dar_run *r, const dar_arena *a, int n, size_t *bytes)
{
    double all = 0;
    for (int i = 0; i < n; i++) {
        bytes[i] = a[i].peak;
        all += (double)bytes[i];
        dar_run_say(r, "%-8s %8.3f GB", a[i].name, (double)bytes[i] * 1e-9);
    }
    return all;
}

double rate_taken(void)
{
    struct rusage u;
    getrusage(RUSAGE_SELF, &u);
    return 1024.0 * (double)u.ru_maxrss;
}
