/* gradcheck.h: is a gradient right?
 *
 * A function of tensors is built on a tape from f64 leaves.  Two checks, both with random cotangents w:
 *
 *   differences   backward's (J^T w)_j against g'(0), g(s) = <w, f(x + s e_j)>, for every element of an input of up to
 *                 DAR_GRADCHECK_ALL elements and along DAR_GRADCHECK_DIRECTIONS random directions of a larger one.
 *                 Figure: largest deviation over the largest derivative of that input.
 *   dot test      <J u, w> against <u, J^T w> for DAR_GRADCHECK_PAIRS random pairs over all inputs at once.
 *                 Figure: largest deviation over sum_j |u_j (J^T w)_j|.
 *
 * Neither denominator counts as smaller than what differences can resolve: DAR_GRADCHECK_FLOOR times <|w|, |f(x)|>
 * (per unit of the input's size), because f itself is known to about 1e-16 of that.
 *
 * Derivatives along a line are central differences of order 2p,
 *
 *   g'(0) = 1/h sum_{k=1..p} a_k (g(kh) - g(-kh)),   a_k = (-1)^(k+1) p!^2 / (k (p-k)! (p+k)!)
 *
 * (Fornberg 1988, table 1).  Where f is analytic with radius R along the line, truncation is (p h / (e R))^2p and
 * rounding 3e-16 |g| / h: p = 6 and h = R/30 leave about 3e-14, which is what makes a dot test to 1e-12 possible
 * without a second arithmetic.  The step is the power of two for which orders 2p and 2p - 2 agree best; backward is not
 * looked at.  Values are rounded to f32 and directions to multiples of 1/64, so that x + k h u is exact. */
#ifndef DAR_AUTOGRAD_GRADCHECK_H
#define DAR_AUTOGRAD_GRADCHECK_H

#include <stdbool.h>
#include <stdint.h>

#include "autograd/tape.h"

#define DAR_GRADCHECK_ALL        512
#define DAR_GRADCHECK_DIRECTIONS 3
#define DAR_GRADCHECK_PAIRS      20
#define DAR_GRADCHECK_FLOOR      1e-2

typedef struct dar_gradcheck {
    dar_segment_fn *fn; /* builds the result; called several thousand times */
    void *arg;
    int n;
    const dar_tensor *x; /* n inputs, f64, contiguous; data NULL: absent, fn gets NULL */
    const bool *frozen;  /* inputs without gradient; NULL: none */
    double gap;          /* distance to the next kink, in every input; 0: none */
    bool directions;     /* small inputs too are checked along random directions only */
    uint64_t seed;
} dar_gradcheck;

typedef struct dar_gradcheck_result {
    double diff;            /* figure of the differences; NaN if anything was */
    double dot;             /* figure of the dot test */
    int input;              /* where diff is worst */
    int64_t element;        /* -1: along a random direction */
    double found, expected; /* there: backward's value, the difference's */
} dar_gradcheck_result;

/* Check fn at x.  Works in `a` and gives it back as it was.  Aborts if no input wants a gradient. */
dar_gradcheck_result dar_gradcheck_run(const dar_gradcheck *c, dar_arena *a);

/* Check a sample of an op. */
dar_gradcheck_result dar_gradcheck_op(const dar_op *op, const dar_sample *s, uint64_t seed, dar_arena *a);

/* Inputs of a sample: the shape's n is -1 where absent; a variadic op's end at the first absent one. */
int dar_sample_inputs(const dar_op *op, const dar_sample *s);

/* The values of input i of a sample, rounded to f32, into x: f64, contiguous. */
void dar_sample_fill(const dar_sample *s, int i, uint64_t seed, const dar_tensor *x);

/* Uniform in [-1, 1): a pure function of (seed, index). */
double dar_gradcheck_random(uint64_t seed, uint64_t index);

#endif
