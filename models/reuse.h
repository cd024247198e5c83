/* reuse.h: the network is not run in every step: what its blocks added to their input is used again.  Rules that others
 * publish, to be compared with; each is off by what it does not know, and nothing watches it.
 *
 *     asked   y = blocks(x),  r = y - x
 *     held    y = x + r           with the r of the last step that was asked
 *
 * What is held is the residual of all blocks, not the velocity, as where the rules are published: patch embedding, time
 * and head still see the step.  To hold the velocity would be a run of fewer steps of Euler.  The first step and the
 * last are asked, and of the others
 *
 *     none     all
 *     table    those whose number, from 0, is a multiple of N
 *     change   those at which f(d), summed over the steps since one was asked, is no longer below a threshold:
 *              d = |m - m'| / |m'| in the L1 norm, m what the first block reads, normed and modulated by the time, m'
 *              the same a step before, and f a polynomial, d itself unless it is given
 *
 * N = 1 and a threshold of 0 are the run as it is, to the bit.  Sources: Selvaraju et al. 2024, FORA, section 3
 * (table); Liu et al. 2025, Timestep Embedding Tells, section 3.3 (change). */
#ifndef DAR_MODELS_REUSE_H
#define DAR_MODELS_REUSE_H

#include "lib/status.h"
#include "lib/tensor.h"

typedef enum dar_reuse_rule { DAR_REUSE_NONE, DAR_REUSE_TABLE, DAR_REUSE_CHANGE, DAR_REUSE_RULES } dar_reuse_rule;

extern const char *const dar_reuse_name[DAR_REUSE_RULES + 1]; /* "none", "table", "change", NULL */

#define DAR_REUSE_COEFFICIENTS 5

typedef struct dar_reuse_config {
    dar_reuse_rule rule;
    double at;                        /* N; the threshold */
    double f[DAR_REUSE_COEFFICIENTS]; /* of change: f(d) = f[0] + f[1] d + ...; all 0: d */
} dar_reuse_config;

/* "none", "table:N", "change:THRESHOLD", "change:THRESHOLD:F0,F1,..." */
dar_status dar_reuse_read(dar_reuse_config *c, const char *text, dar_err *e);

typedef struct dar_reuse {
    dar_reuse_config c;
    size_t steps, step; /* of the run; the next */
    size_t held;        /* of those before */

    /* Of the rule itself. */
    double sum;         /* since a step was asked */
    double moved, size; /* of the next step's input: numerator and denominator of d */
} dar_reuse;

void dar_reuse_init(dar_reuse *r, const dar_reuse_config *c, size_t steps);

/* A part of m at the next step; the rule of change wants to see all parts before it is asked.  `before`, of its shape,
 * is that part of m' and becomes m. */
void dar_reuse_see(dar_reuse *r, const dar_tensor *m, const dar_tensor *before);

/* Whether the blocks are run in the next step, which is then past.  Where nothing was seen, change says yes. */
bool dar_reuse_asks(dar_reuse *r);

#endif
