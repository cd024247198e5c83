/* flow.h: flow matching: the straight path from data to noise, its times, and what a network learns on it.
 *
 *     z = (1 - sigma) z0 + sigma eps        a place on the path: data at sigma = 0, noise at 1
 *     v = eps - z0                          its velocity, what the network predicts
 *     z0 = z - sigma v                      the clean estimate
 *     t = 1000 sigma                        what the network is told
 *
 * Sources: Lipman et al. 2023, section 4.1; Esser et al. 2024, section 2 and 3.1 (densities), 5.3.2 (shift). */
#ifndef DAR_MODELS_FLOW_H
#define DAR_MODELS_FLOW_H

#include "lib/tensor.h"

#define DAR_FLOW_TIMES 1000

/* Bend times towards noise: shift s / (1 + (shift - 1) s).  shift > 0; 1 changes nothing. */
double dar_flow_shift(double s, double shift);

/* ---------------------------------------------------------------- learning */

/* How training draws its times. */
typedef enum dar_flow_density {
    DAR_FLOW_UNIFORM,
    DAR_FLOW_LOGIT_NORMAL, /* of the logit of the position: normal, mean 0, deviation 1 */
    DAR_FLOW_MODE,         /* scale 1.29 */
    DAR_FLOW_COSMAP,
    DAR_FLOW_DENSITIES
} dar_flow_density;

/* How the loss weighs them. */
typedef enum dar_flow_weighting {
    DAR_FLOW_FLAT,
    DAR_FLOW_BELL, /* exp(-2 (t / 1000 - 1/2)^2), its least value taken off, mean 1 over the table */
    DAR_FLOW_WEIGHTINGS
} dar_flow_weighting;

extern const char *const dar_flow_density_name[DAR_FLOW_DENSITIES + 1]; /* "uniform", "logit_normal", ...; ends NULL */
extern const char *const dar_flow_weighting_name[DAR_FLOW_WEIGHTINGS + 1];

/* Entry k of the training table, k = 0 .. DAR_FLOW_TIMES - 1, falling from 1: shift((1000 - k) / 1000). */
double dar_flow_sigma(int k, double shift);

/* Entry for a draw u in [0, 1); for logit_normal u is taken through the normal quantile. */
int dar_flow_draw(dar_flow_density d, double u);

/* Weight of the squared error at sigma, for a table with this shift. */
double dar_flow_weight(dar_flow_weighting w, double sigma, double shift);

/* z = (1 - sigma) z0 + sigma eps, and v = eps - z0.  All of one type, f32 or f64, and one shape, contiguous; an output
 * may be an input. */
void dar_flow_mix(const dar_tensor *z0, const dar_tensor *eps, double sigma, const dar_tensor *z);
void dar_flow_target(const dar_tensor *z0, const dar_tensor *eps, const dar_tensor *v);

/* y = a[0] x[0] + ... + a[n - 1] x[n - 1], n >= 1, added in this order; types and shapes as above, y may be one of the
 * x. */
void dar_flow_combine(int n, const double *a, const dar_tensor *const *x, const dar_tensor *y);

/* The Euclidean norm of such a combination, the same bits for any number of threads. */
double dar_flow_norm(int n, const double *a, const dar_tensor *const *x);

/* The sum of its absolute values, likewise. */
double dar_flow_size(int n, const double *a, const dar_tensor *const *x);

/* ---------------------------------------------------------------- grids of sigmas for sampling */

typedef enum dar_flow_grid {
    DAR_GRID_EVEN,  /* 1 to 0 evenly, shifted: what DPM++2M is run on */
    DAR_GRID_TWICE, /* between the ends of the training table, which are shifted already, evenly, and shifted again:
                     * the reference's Euler sampler; shift acts twice */
    DAR_GRID_WHOLE, /* 0.999 to 0 evenly, shifted; the network is told t cut to whole numbers: the reference's UniPC */
    DAR_GRID_DIFFUSERS, /* 1 to 0.001 evenly, shifted, the first lowered by 1e-6: UniPC of diffusers */
    DAR_GRIDS
} dar_flow_grid;

extern const char *const dar_flow_grid_name[DAR_GRIDS + 1]; /* "even", "twice", "whole", "diffusers", NULL */

/* sigma[steps + 1], strictly falling, the last 0; time[steps], what the network is told.  steps >= 1. */
void dar_flow_fill(dar_flow_grid g, size_t steps, double shift, double *sigma, double *time);

#endif
