/* thread.c: the only place that starts threads. */
#include "lib/thread.h"

#include <limits.h>
#include <omp.h>
#include <stdlib.h>
#include <unistd.h>
#include <pthread.h>
#include <signal.h>
#include <stdlib.h>
#include <string.h>

static _Atomic int wanted; /* 0: not known yet */
static _Thread_local int self;
static _Thread_local bool beside;

int dar_threads(void)
{
    if (!wanted) wanted = omp_get_max_threads(); /* once: others may change it */
    return wanted;
}

void dar_threads_set(int n)
{
    DAR_ASSERT(n >= 1, "threads: %d, expected at least 1", n);
    wanted = n;
}

/* Some microseconds: longer than it takes to start a task, shorter than to be put on a processor again. */
#define SPINS "1000"

void dar_threads_restart(char *const argv[])
{
    static const char *const said[] = { "OMP_WAIT_POLICY", "GOMP_SPINCOUNT", "OMP_PROC_BIND", "OMP_PLACES" };
    for (size_t i = 0; i < DAR_COUNT(said); i++) /* bound to a processor, we would hand on that one alone */
        if (getenv(said[i])) return;
    char path[PATH_MAX]; /* by its own path, which is what lists of processes then say */
    ssize_t n = readlink("/proc/self/exe", path, sizeof path - 1);
    if (n < 0 || setenv("GOMP_SPINCOUNT", SPINS, 1) != 0) return;
    path[n] = 0;
    execv(path, argv);
}

bool dar_in_task(void)
{
    return beside || omp_in_parallel();
}

void dar_parallel(size_t tasks, dar_task *fn, void *ctx)
{
    int n = dar_threads();

    if (n == 1 || tasks <= 1 || dar_in_task()) {
        for (size_t i = 0; i < tasks; i++) fn(ctx, i, self);
        return;
    }
    /* Always the same team, however few the tasks: a smaller one would end threads that the next call starts again. */
#pragma omp parallel num_threads(n)
    {
        self = omp_get_thread_num();
#pragma omp for schedule(dynamic, 1) nowait
        for (size_t i = 0; i < tasks; i++) fn(ctx, i, self);
        self = 0;
    }
}

struct dar_thread {
    pthread_t id;
    void (*fn)(void *);
    void *ctx;
};

static void *run_beside(void *arg)
{
    const struct dar_thread *t = arg;
    beside = true;
    t->fn(t->ctx);
    return NULL;
}

dar_status dar_thread_start(dar_thread **out, void (*fn)(void *), void *ctx, dar_err *e)
{
    sigset_t all, old;
    dar_thread *t = malloc(sizeof *t);
    *out = NULL;
    if (!t) return dar_fail(e, DAR_ERR_NOMEM, "a thread: out of memory");
    *t = (dar_thread){ .fn = fn, .ctx = ctx };
    sigfillset(&all);
    pthread_sigmask(SIG_SETMASK, &all, &old); /* the new thread inherits it */
    int failed = pthread_create(&t->id, NULL, run_beside, t);
    pthread_sigmask(SIG_SETMASK, &old, NULL);
    if (failed) {
        free(t);
        return dar_fail(e, DAR_ERR_NOMEM, "a thread: %s", strerror(failed));
    }
    *out = t;
    return DAR_OK;
}

void dar_thread_join(dar_thread *t)
{
    if (!t) return;
    pthread_join(t->id, NULL);
    free(t);
}

struct range {
    size_t n, chunk;
    dar_range_task *fn;
    void *ctx;
};

static void run_range(void *ctx, size_t i, int thread)
{
    const struct range *r = ctx;
    size_t begin = i * r->chunk, end = begin + r->chunk < r->n ? begin + r->chunk : r->n;
    r->fn(r->ctx, begin, end, thread);
}

void dar_parallel_range(size_t n, size_t chunk, dar_range_task *fn, void *ctx)
{
    DAR_ASSERT(chunk > 0, "threads: chunks of 0 items");
    struct range r = { n, chunk, fn, ctx };
    dar_parallel(n / chunk + (n % chunk != 0), run_range, &r);
}

double dar_sum_tree(double *x, size_t n)
{
    if (!n) return 0;
    for (size_t step = 1; step < n; step *= 2)
        for (size_t i = 0; i + step < n; i += 2 * step) x[i] += x[i + step];
    return x[0];
}

/* The chunks are summed in groups that fit on the stack, the groups by the same tree again. */
#define GROUP 256

struct sum {
    size_t n, chunk, first;
    dar_sum_task *fn;
    void *ctx;
    double part[GROUP];
};

static void run_sum(void *ctx, size_t i, int thread)
{
    struct sum *s = ctx;
    size_t begin = (s->first + i) * s->chunk, end = begin + s->chunk < s->n ? begin + s->chunk : s->n;
    (void)thread;
    s->part[i] = s->fn(s->ctx, begin, end);
}

double dar_parallel_sum(size_t n, size_t chunk, dar_sum_task *fn, void *ctx)
{
    DAR_ASSERT(chunk > 0, "threads: chunks of 0 items");
    struct sum s = { .n = n, .chunk = chunk, .fn = fn, .ctx = ctx };
    size_t chunks = n / chunk + (n % chunk != 0);
    double level[64] = { 0 }; /* binary counter of finished groups: level[k] holds a sum of 2^k groups */
    unsigned long long full = 0;

    for (; s.first < chunks; s.first += GROUP) {
        size_t m = chunks - s.first < GROUP ? chunks - s.first : GROUP;
        dar_parallel(m, run_sum, &s);
        double x = dar_sum_tree(s.part, m);
        int k = 0;
        for (; full >> k & 1; k++) x = level[k] + x;
        level[k] = x;
        full++; /* clears the levels just folded and sets level k */
    }
    double total = 0;
    for (int k = 0; k < 64; k++)
        if (full >> k & 1) total = level[k] + total;
    return total;
}
