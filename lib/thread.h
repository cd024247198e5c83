/* thread.h: work in fixed chunks, results in chunk order.
 *
 * How work is cut depends on its size alone, never on the number of threads; a chunk writes only what is its own;
 * partial sums are combined in chunk order.  So every result has the same bits for any number of threads. */
#ifndef DAR_LIB_THREAD_H
#define DAR_LIB_THREAD_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/status.h"

/* Threads that dar_parallel uses.  The default is the number of processors, or OMP_NUM_THREADS. */
int dar_threads(void);
void dar_threads_set(int n); /* n >= 1 */

/* First thing in main: start the program again, so that threads which wait for each other soon sleep.  By itself OpenMP
 * lets them spin for milliseconds, which costs whoever wants the processors, this program's own threads among them, and
 * it reads how long before main.  Once: returns in the new program, where the environment says how long, or if it did
 * already (OMP_WAIT_POLICY, GOMP_SPINCOUNT, OMP_PROC_BIND, OMP_PLACES), or if the system refuses. */
void dar_threads_restart(char *const argv[]);

/* Run fn(ctx, i, thread) for every i < tasks, in any order; thread < dar_threads() tells whose scratch to use.  Called
 * from inside a task it runs in place, as that same thread. */
typedef void dar_task(void *ctx, size_t i, int thread);
void dar_parallel(size_t tasks, dar_task *fn, void *ctx);

/* Whether the caller is a task on one of several threads, or a thread beside. */
bool dar_in_task(void);

/* A thread beside the others, such as one that reads ahead: it runs fn(ctx), and in it dar_parallel runs in place, so
 * that it takes no processor from the work it serves but its own.  Signals go to the others.  On failure *out is NULL;
 * every other one is owed a join, which waits for fn to return and accepts NULL. */
typedef struct dar_thread dar_thread;
dar_status dar_thread_start(dar_thread **out, void (*fn)(void *ctx), void *ctx, dar_err *e);
void dar_thread_join(dar_thread *t);

/* Cut n items in chunks of `chunk` and run fn(ctx, begin, end, thread) on each. */
typedef void dar_range_task(void *ctx, size_t begin, size_t end, int thread);
void dar_parallel_range(size_t n, size_t chunk, dar_range_task *fn, void *ctx);

/* Sum in a fixed binary tree: neighbours first.  Overwrites x. */
double dar_sum_tree(double *x, size_t n);

/* Sum of fn(ctx, begin, end) over chunks of `chunk` items, combined by the fixed tree. */
typedef double dar_sum_task(void *ctx, size_t begin, size_t end);
double dar_parallel_sum(size_t n, size_t chunk, dar_sum_task *fn, void *ctx);

#endif
