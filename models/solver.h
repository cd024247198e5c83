/* solver.h: from noise to data along the flow's ODE dz/dsigma = v(z, sigma), one network call per step.
 *
 *     dar_solver s;
 *     dar_solver_init(&s, &config, &z, arena);
 *     while (s.step < s.steps) {
 *         ... v at (z, s.time[s.step]) ...
 *         dar_solver_step(&s, &v, &z);
 *     }
 *
 * Every step is a linear combination of z and what earlier calls gave, with coefficients in f64 from the grid alone:
 *
 *   euler   z + h v                                                                             h = s' - s
 *   ab2     z + h (v + h / (2 h1) (v - v1))             Adams and Bashforth, steps h1 and h of any ratio
 *   dpm++   (s' / s) z - a' E (m + r (m - m1) / 2)      DPM-Solver++(2M): Lu et al. 2022, algorithm 2
 *   unipc   the same predictor, after z was corrected with the m that was found there: B2(h) = e^h - 1, order 3 in all.
 *           Zhao et al. 2023, algorithms 1 and 2
 *
 * where m = z - s v is the clean estimate, a = 1 - s, l = log(a / s), E = exp(l - l') - 1, r = (l' - l) / (l - l1);
 * primes mark the next grid point, 1 the one before.  The first step, and the last of dpm++ and unipc, are of order 1.
 *
 * The caller may change z between steps (known frames are put back); the next step starts from what it finds. */
#ifndef DAR_MODELS_SOLVER_H
#define DAR_MODELS_SOLVER_H

#include "models/flow.h"

typedef enum dar_solver_kind { DAR_EULER, DAR_AB2, DAR_UNIPC, DAR_DPMPP, DAR_SOLVERS } dar_solver_kind;

extern const char *const dar_solver_name[DAR_SOLVERS + 1]; /* "euler", "ab2", "unipc", "dpm++", NULL */

/* The grid that each is published on: twice, even, whole, even. */
dar_flow_grid dar_solver_grid(dar_solver_kind k);

typedef struct dar_solver_config {
    dar_solver_kind kind;
    dar_flow_grid grid;
    size_t steps;
    double shift;
} dar_solver_config;

/* Euler on its grid, 50 steps, shift 5. */
dar_solver_config dar_solver_default(void);

typedef struct dar_solver {
    dar_solver_kind kind;
    size_t steps, step;  /* step: the next to be done */
    double *sigma;       /* [steps + 1] */
    double *time;        /* [steps] what the network is told */
    dar_tensor model[3]; /* v or m of the last calls, newest first; data NULL: not kept */
    dar_tensor left;     /* unipc: the corrected z from which the last step went */
} dar_solver;

/* Memory in `a`: the grid, and for euler, ab2, dpm++, unipc 0, 2, 2, 4 tensors like z (f32 or f64). */
void dar_solver_init(dar_solver *s, const dar_solver_config *c, const dar_tensor *z, dar_arena *a);

/* v: what the network said at (z, time[step]), of z's type.  z moves to sigma[step + 1]. */
void dar_solver_step(dar_solver *s, const dar_tensor *v, const dar_tensor *z);

#endif
