/* solver.c: multistep solvers as coefficients of linear combinations. */
#include "models/solver.h"

#include <math.h>

#include "lib/status.h"

/* Where step `i` stands: its grid points and those before, as log ratios of signal to noise.  At sigma = 1 and 0 these
 * are infinite, and every coefficient takes its limit. */
typedef struct place {
    double s, s1, signal1; /* sigma here and at the next point; 1 - sigma there */
    double h, back;        /* steps in log(signal / noise): the one ahead, the one behind */
    double growth;         /* exp(-h) - 1 */
    bool first, last;      /* no step behind; ahead lies sigma = 0 */
} place;

/* z' = z[0] z + z[1] model[0] + z[2] model[1]. */
typedef void predictor(const dar_solver *s, size_t i, double c[3]);

typedef struct method {
    dar_flow_grid grid;
    int models;   /* kept from call to call */
    bool clean;   /* kept is m, not v */
    bool correct; /* z is corrected before the step */
    predictor *predict;
} method;

static double log_ratio(double sigma)
{
    return log((1 - sigma) / sigma);
}

static place place_at(const dar_solver *s, size_t i)
{
    const double *g = s->sigma + i;
    place p = { .s = g[0], .s1 = g[1], .signal1 = 1 - g[1], .first = i == 0, .last = g[1] == 0 };
    p.h = log_ratio(g[1]) - log_ratio(g[0]);
    p.back = i ? log_ratio(g[0]) - log_ratio(g[-1]) : 0;
    p.growth = expm1(-p.h);
    return p;
}

static void euler(const dar_solver *s, size_t i, double c[3])
{
    c[0] = 1;
    c[1] = s->sigma[i + 1] - s->sigma[i];
    c[2] = 0;
}

static void ab2(const dar_solver *s, size_t i, double c[3])
{
    euler(s, i, c);
    if (i == 0) return;
    double h = c[1], ratio = h / (s->sigma[i] - s->sigma[i - 1]);
    c[1] = h * (1 + ratio / 2);
    c[2] = -h * ratio / 2;
}

static void dpmpp(const dar_solver *s, size_t i, double c[3])
{
    place p = place_at(s, i);
    double ratio = p.first || p.last ? 0 : p.h / p.back;
    c[0] = p.s1 / p.s;
    c[1] = -p.signal1 * p.growth * (1 + ratio / 2);
    c[2] = p.signal1 * p.growth * ratio / 2;
}

/* Redo the step before, now that the model at its end is known: z = c[0] left + c[1] m + c[2] m1 + c[3] m2. */
static void unipc_corrector(const dar_solver *s, size_t i, double c[4])
{
    place p = place_at(s, i - 1);
    double g = -p.signal1 * p.growth, rho2 = 0.5, slope = 0; /* slope: rho1 / r1 */
    if (!p.first) {
        double hh = -p.h, r1 = -p.back / p.h;
        double phi1 = p.growth / hh - 1, phi2 = phi1 / hh - 0.5;
        double b1 = phi1 / p.growth, b2 = 2 * phi2 / p.growth;
        double rho1 = (b2 - b1) / (r1 - 1); /* rho1 + rho2 = b1, r1 rho1 + rho2 = b2 */
        rho2 = b1 - rho1;
        slope = rho1 / r1;
    }
    c[0] = p.s1 / p.s;
    c[1] = g * rho2;
    c[2] = g * (1 - rho2 - slope);
    c[3] = g * slope;
}

static const method methods[DAR_SOLVERS] = {
    [DAR_EULER] = { DAR_GRID_TWICE, .models = 0, .predict = euler },
    [DAR_AB2] = { DAR_GRID_EVEN, .models = 2, .predict = ab2 },
    [DAR_UNIPC] = { DAR_GRID_WHOLE, .models = 3, .clean = true, .correct = true, .predict = dpmpp },
    [DAR_DPMPP] = { DAR_GRID_EVEN, .models = 2, .clean = true, .predict = dpmpp },
};

const char *const dar_solver_name[] = { "euler", "ab2", "unipc", "dpm++", NULL };

dar_flow_grid dar_solver_grid(dar_solver_kind k)
{
    return methods[k].grid;
}

dar_solver_config dar_solver_default(void)
{
    return (dar_solver_config){ .kind = DAR_EULER, .grid = DAR_GRID_TWICE, .steps = 50, .shift = 5 };
}

void dar_solver_init(dar_solver *s, const dar_solver_config *c, const dar_tensor *z, dar_arena *a)
{
    const method *m = &methods[c->kind];
    *s = (dar_solver){ .kind = c->kind, .steps = c->steps };
    s->sigma = dar_arena_push(a, dar_mul_size(c->steps + 1, sizeof(double)));
    s->time = dar_arena_push(a, dar_mul_size(c->steps, sizeof(double)));
    if (!a->plan) dar_flow_fill(c->grid, c->steps, c->shift, s->sigma, s->time);
    for (int i = 0; i < m->models; i++) s->model[i] = dar_tensor_push(a, z->dtype, z->shape);
    if (m->correct) s->left = dar_tensor_push(a, z->dtype, z->shape);
}

/* Put what the network said in front of what it said before. */
static void remember(dar_solver *s, const method *m, const dar_tensor *v, const dar_tensor *z)
{
    dar_tensor newest = s->model[m->models - 1];
    for (int i = m->models - 1; i > 0; i--) s->model[i] = s->model[i - 1];
    s->model[0] = newest;
    if (m->clean) dar_flow_combine(2, (double[]){ 1, -s->sigma[s->step] }, (const dar_tensor *[]){ z, v }, &newest);
    else dar_tensor_copy(&newest, v);
}

void dar_solver_step(dar_solver *s, const dar_tensor *v, const dar_tensor *z)
{
    DAR_ASSERT(s->step < s->steps, "solver: step %zu of %zu", s->step, s->steps);
    const method *m = &methods[s->kind];
    double c[4];

    if (m->models) remember(s, m, v, z);
    if (m->correct && s->step > 0) {
        unipc_corrector(s, s->step, c);
        dar_flow_combine(s->step > 1 ? 4 : 3, c,
                         (const dar_tensor *[]){ &s->left, &s->model[0], &s->model[1], &s->model[2] }, z);
    }
    if (m->correct) dar_tensor_copy(&s->left, z);

    m->predict(s, s->step, c);
    dar_flow_combine(c[2] == 0 ? 2 : 3, c, (const dar_tensor *[]){ z, m->models ? &s->model[0] : v, &s->model[1] }, z);
    s->step++;
}
