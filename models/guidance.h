/* guidance.h: the velocity with a prompt and with the negative one, of which the second is not always asked for.
 *
 *     v = c + (g - 1) d,   d = c - u      the velocity that a step takes (models/sampler.h)
 *
 * Along a path d changes slowly.  With a tolerance G > 0 it is continued in a straight line in sigma, through the last
 * two times that u was computed, while that is foretold to be off by G |v| at most: what the line was off by when it
 * was last compared, e = (g - 1) |d - line| / |v|, grows with the product of the distances to the two,
 *
 *     e(sigma) = e0 (sigma - s0) (sigma - s1) / ((s0 - s1) (s0 - s2))
 *
 * The guard: u is computed at least every DAR_GUIDANCE_CHECK calls, and if the line was off by more than G, then at the
 * next call too.  Until three are known, always.  G -> 0 is guidance as it is, to the bit.  Source: the remainder of
 * linear interpolation; that d may be left out, Castillo et al. 2023. */
#ifndef DAR_MODELS_GUIDANCE_H
#define DAR_MODELS_GUIDANCE_H

#include "models/flow.h"

#define DAR_GUIDANCE_CHECK 8

typedef struct dar_guidance {
    double g, tolerance;
    size_t left_out; /* calls without u */
    double worst;    /* what the line was off by when it was compared and u had been left out: the largest e */

    /* Of the guidance itself. */
    dar_tensor d[3];        /* newest first; the last is room for the next */
    double sigma[3], error; /* where the last three were; e0 */
    int kept;
    size_t row; /* calls without u since the last with it */
} dar_guidance;

/* Memory in `a`: three tensors like z if there is a tolerance. */
void dar_guidance_init(dar_guidance *s, double g, double tolerance, const dar_tensor *z, dar_arena *a);

/* Whether u is to be computed at sigma. */
bool dar_guidance_asks(const dar_guidance *s, double sigma);

/* v: c at sigma becomes the velocity of a step.  u may be NULL if it was not asked for. */
void dar_guidance_apply(dar_guidance *s, double sigma, const dar_tensor *u, const dar_tensor *v);

#endif
