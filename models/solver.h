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
 * The caller may change z between steps (known frames are put back); the next step starts from what it finds.
 *
 * A tolerance T > 0 lets the network be called at fewer points of the grid: a step goes to the farthest one, at most
 * twice as many away as the step before, of which the prediction of the order below, from the same calls, differs by
 * T |z| or less.  The difference costs no call.  T -> 0 is the run without it, to the bit, and error and `estimate`
 * fall as T.  What a long step does:
 *
 *   euler                the steps of the grid, with the parabola in sigma through the velocities of the last three
 *                        calls; so it follows the plain run, whose own error it shares.  Corrected where it arrives:
 * the same steps, with the parabola that the new velocity is on ab2, dpm++, unipc    itself, over the whole length; so
 * it follows the ODE
 *
 * Where there is a corrector it is the guard: if it moves z by more than 2 T |z|, the step is taken back and done again
 * half as long.  That is a call for nothing, and so done only while the calls are no more than the points passed: a run
 * never makes more calls than the grid has steps.  Source: Hairer, Norsett and Wanner 1993, II.4 (step sizes) and III.5
 * (multistep formulas of varying step). */
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
    double tolerance; /* T; 0: every point of the grid is called */
    double budget;    /* of `estimate`: a step that would take it beyond goes to the next point; 0: none */
} dar_solver_config;

/* Euler on its grid, 50 steps, shift 5. */
dar_solver_config dar_solver_default(void);

#define DAR_SOLVER_MODELS 4

typedef struct dar_solver {
    dar_solver_kind kind;
    double tolerance, budget;
    size_t steps, step;     /* of the grid; step: where the network is called next */
    size_t calls, rejected; /* calls so far; of them for steps that were taken back */
    double estimate;        /* sum over the steps of how far the order below would have gone elsewhere, relative to z */
    double *sigma;          /* [steps + 1] */
    double *time;           /* [steps] what the network is told */

    /* Of the solver itself. */
    int models, kept;                    /* how many there is room for, how many there are */
    dar_tensor model[DAR_SOLVER_MODELS]; /* v or m of the last calls, newest first */
    size_t call[DAR_SOLVER_MODELS];      /* where on the grid they were made */
    dar_tensor left;                     /* with a corrector: the z from which the last step went */
    dar_tensor corrected;                /* with a corrector and a tolerance */
    size_t most;                         /* how long the next step may be, in points */
    double last, spread;                 /* of the estimate: the last step's; what it is a multiple of */
} dar_solver;

/* Memory in `a`: the grid, and for euler, ab2, dpm++, unipc 0, 2, 2, 4 tensors like z (f32 or f64); with a tolerance 6,
 * 2, 2, 5. */
void dar_solver_init(dar_solver *s, const dar_solver_config *c, const dar_tensor *z, dar_arena *a);

/* v: what the network said at (z, time[step]), of z's type.  z moves to sigma of the step that is next; or, if a step
 * is taken back, from where that went. */
void dar_solver_step(dar_solver *s, const dar_tensor *v, const dar_tensor *z);

#endif
