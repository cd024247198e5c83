/* optim.h: AdamW over the trainable parameters of a table, with warm-up, clipping by the global norm, rates by name and
 * an average of the weights.
 *
 *     dar_optim_init(&o, &config, &params, arena);
 *     for (...) {
 *         ... gradients ...
 *         dar_optim_report r = dar_optim_step(&o);       gradients are zero again
 *     }
 *
 * Step k = 0, 1, ... runs at rate min(1, k / warmup) schedule config.rate, or with another rate of the parameter in
 * that one's place: the first one of a warm-up changes nothing but the moments, as in the public scripts.  The gradient
 * is scaled by min(1, max_norm / (norm + 1e-6)).  A step whose gradient is not finite is skipped: weights, moments and
 * k stay, its gradients are thrown away.
 *
 * Weights are those of the table (f32, or f64 in an f64 network), moments likewise or, to halve their memory, bf16;
 * sums are f64 in a fixed order: same bits for any thread count.  Moments in bf16 are rounded up or down at random,
 * with the odds that make the mean right, as a pure function of seed, step and place: rounded to the nearest, v would
 * stand still at beta2 0.999, where it changes by less than half of its last digit.
 *
 * The average is a -= (1 - d_k) (a - w) after each step, d_k = min(config.average, (1 + k) / (10 + k)), d_0 = 0: short
 * at first, so that what the weights were at the start is soon forgotten.  It is of the weights' type; steps of a that
 * are below its last digit are lost, so in f32 it follows to within 2^-24 / (1 - d) of a weight.  Training does not
 * look at it.
 *
 * Source: Loshchilov and Hutter 2019, algorithm 2; Pascanu et al. 2013, algorithm 1;
 * diffusers, EMAModel. */
#ifndef DAR_TRAIN_OPTIM_H
#define DAR_TRAIN_OPTIM_H

#include "models/params.h"

typedef struct dar_optim_config {
    double rate, beta1, beta2, eps, decay;
    double max_norm; /* 0: no clipping */
    int64_t warmup;  /* steps */
    bool bf16_moments;
    uint64_t seed;    /* of their rounding */
    int64_t patience; /* steps in a row that may be skipped */
    double average;   /* decay of the average of the weights; 0: there is none */
} dar_optim_config;

/* The paper's rate 1e-4 after 200 steps; what it leaves open as in the scripts of the backbone: betas 0.9 and 0.999,
 * eps 1e-10, decay 0.03, norm 0.05; patience 20. */
dar_optim_config dar_optim_default(void);

typedef struct dar_optim {
    dar_optim_config config;
    dar_params *params;
    dar_tensor *m, *v;   /* [params.count]; data NULL where nothing is trained */
    dar_tensor *average; /* likewise, and if there is none; or of the weights, see dar_optim_swap */
    double *rate;        /* [params.count] instead of config.rate */
    bool plan;           /* only counted: the arrays above are not there */
    double schedule;     /* of the next step's rates; 1 at first */
    int64_t steps;       /* done: k of the next */
    int64_t skipped;     /* not finite */
    int64_t in_a_row;    /* of them, the last ones */
} dar_optim;

/* Moments are pushed on `a`, zeroed, and the average, which is the weights; the parameters have values and gradients
 * already. */
void dar_optim_init(dar_optim *o, const dar_optim_config *c, dar_params *p, dar_arena *a);

/* Trained parameters whose names match a shell pattern (fnmatch: "linear.*") get this rate.  Returns how many there
 * are.
 */
size_t dar_optim_set_rate(dar_optim *o, const char *pattern, double rate);

/* The average is the weights as they are now: after they were set by others. */
void dar_optim_restart_average(dar_optim *o);

/* Weights and their average change places, to look at the average or to save it; a second time, back again.  In between
 * no step is made.  Without an average nothing happens. */
void dar_optim_swap(dar_optim *o);

typedef struct dar_optim_report {
    double norm;           /* of the gradient, before clipping */
    double rate;           /* of this step, where a parameter has no other */
    bool skipped;          /* the norm is not finite */
    const char *nonfinite; /* the first parameter whose gradient is not; NULL: all are, yet their squares overflow */
} dar_optim_report;

dar_optim_report dar_optim_step(dar_optim *o);

/* After a step: DAR_ERR_NUMERIC, with the name of a parameter, if more than the configured patience were skipped in a
 * row. */
dar_status dar_optim_check(const dar_optim *o, const dar_optim_report *r, dar_err *e);

/* Euclidean norm of all gradients. */
double dar_optim_norm(const dar_params *p);

#endif
