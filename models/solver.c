/* solver.c: multistep solvers as coefficients of linear combinations. */
#include "models/solver.h"

#include <math.h>

#include "lib/status.h"

#define GUARD 2.0 /* times the tolerance */

/* Where a step stands: its ends, and the call before it, as log ratios of signal to noise.  At sigma = 1 and 0 these
 * are infinite, and every coefficient takes its limit. */
typedef struct place {
    double s, s1, signal1; /* sigma here and ahead; 1 - sigma there */
    double h, back;        /* steps in log(signal / noise): the one ahead, the one behind */
    double growth;         /* exp(-h) - 1 */
    bool first, last;      /* no step behind; ahead lies sigma = 0 */
} place;

/* z' = c[0] z + c[1] model[0] + c[2] model[1] + ..., of the step to point `to`. */
typedef void predictor(const dar_solver *s, size_t to, double *c);

/* The same from where the last step went, now that the model at its end is known. */
typedef void corrector(const dar_solver *s, double *c);

typedef struct method {
    dar_flow_grid grid;
    int models[2]; /* kept from call to call: without, with a tolerance */
    int nodes;     /* of them the predictor reads, if they are there */
    bool clean;    /* kept is m, not v */
    predictor *predict;
    corrector *correct; /* NULL: z is not corrected; reads one model more than the predictor, at most all */
} method;

static double log_ratio(double sigma)
{
    return log((1 - sigma) / sigma);
}

/* Sigma of an earlier call; 0: there was none. */
static double past(const dar_solver *s, int call)
{
    return call < s->kept ? s->sigma[s->call[call]] : 0;
}

static place place_of(double before, double here, double ahead)
{
    place p = { .s = here, .s1 = ahead, .signal1 = 1 - ahead, .first = before == 0, .last = ahead == 0 };
    p.h = log_ratio(ahead) - log_ratio(here);
    p.back = p.first ? 0 : log_ratio(here) - log_ratio(before);
    p.growth = expm1(-p.h);
    return p;
}

/* w[a]: of call a's velocity in the sum of h v over the points from .. to - 1, v the polynomial through n calls. */
static void weigh(const dar_solver *s, size_t from, size_t to, int n, double *w)
{
    for (int a = 0; a < n; a++) w[a] = 0;
    for (size_t i = from; i < to; i++)
        for (int a = 0; a < n; a++) {
            double l = s->sigma[i + 1] - s->sigma[i];
            for (int b = 0; b < n; b++)
                if (b != a) l *= (s->sigma[i] - past(s, b)) / (past(s, a) - past(s, b));
            w[a] += l;
        }
}

static int parabola(const dar_solver *s)
{
    return s->kept < 3 ? s->kept : 3;
}

static void euler(const dar_solver *s, size_t to, double *c)
{
    c[0] = 1;
    weigh(s, s->call[0], to, parabola(s), c + 1);
}

static void euler_corrector(const dar_solver *s, double *c)
{
    c[0] = 1;
    weigh(s, s->call[1], s->call[0], parabola(s), c + 1);
}

static void ab2(const dar_solver *s, size_t to, double *c)
{
    double here = past(s, 0), h = s->sigma[to] - here, ratio = s->kept > 1 ? h / (here - past(s, 1)) : 0;
    c[0] = 1;
    c[1] = h * (1 + ratio / 2);
    c[2] = -h * ratio / 2;
}

static void dpmpp(const dar_solver *s, size_t to, double *c)
{
    place p = place_of(past(s, 1), past(s, 0), s->sigma[to]);
    double ratio = p.first || p.last ? 0 : p.h / p.back;
    c[0] = p.s1 / p.s;
    c[1] = -p.signal1 * p.growth * (1 + ratio / 2);
    c[2] = p.signal1 * p.growth * ratio / 2;
}

static void unipc_corrector(const dar_solver *s, double *c)
{
    place p = place_of(past(s, 2), past(s, 1), past(s, 0));
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

/* clang-format off */
static const method methods[DAR_SOLVERS] = {
    [DAR_EULER] = { DAR_GRID_TWICE, { 0, 4 }, .nodes = 3, .predict = euler, .correct = euler_corrector },
    [DAR_AB2]   = { DAR_GRID_EVEN,  { 2, 2 }, .nodes = 2, .predict = ab2 },
    [DAR_UNIPC] = { DAR_GRID_WHOLE, { 3, 3 }, .nodes = 2, .clean = true, .predict = dpmpp, .correct = unipc_corrector },
    [DAR_DPMPP] = { DAR_GRID_EVEN,  { 2, 2 }, .nodes = 2, .clean = true, .predict = dpmpp },
};
/* clang-format on */

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
    *s = (dar_solver){ .kind = c->kind, .steps = c->steps, .tolerance = c->tolerance, .budget = c->budget, .most = 1 };
    s->models = m->models[c->tolerance > 0];
    s->sigma = dar_arena_push(a, dar_mul_size(c->steps + 1, sizeof(double)));
    s->time = dar_arena_push(a, dar_mul_size(c->steps, sizeof(double)));
    if (!a->plan) dar_flow_fill(c->grid, c->steps, c->shift, s->sigma, s->time);
    for (int i = 0; i < s->models; i++) s->model[i] = dar_tensor_push(a, z->dtype, z->shape);
    if (m->correct && s->models) s->left = dar_tensor_push(a, z->dtype, z->shape);
    if (m->correct && c->tolerance > 0) s->corrected = dar_tensor_push(a, z->dtype, z->shape);
}

/* ---------------------------------------------------------------- a step */

/* y = c[0] z + c[1] models[0] + ...; zeros at the end do not count. */
static void combine(const double *c, const dar_tensor *z, const dar_tensor *models, const dar_tensor *y)
{
    const dar_tensor *x[DAR_SOLVER_MODELS + 1] = { z };
    int n = DAR_SOLVER_MODELS;
    while (n > 1 && c[n] == 0) n--;
    for (int i = 0; i < n; i++) x[i + 1] = &models[i];
    dar_flow_combine(n + 1, c, x, y);
}

/* Put what the network said in front of what it said before. */
static void remember(dar_solver *s, const method *m, const dar_tensor *v, const dar_tensor *z)
{
    const int room = s->models ? s->models : 1;
    dar_tensor newest = s->model[room - 1];
    for (int i = room - 1; i > 0; i--) s->model[i] = s->model[i - 1], s->call[i] = s->call[i - 1];
    s->model[0] = newest;
    s->call[0] = s->step;
    if (s->kept < room) s->kept++;
    if (!s->models) return;
    if (m->clean) dar_flow_combine(2, (double[]){ 1, -s->sigma[s->step] }, (const dar_tensor *[]){ z, v }, &newest);
    else dar_tensor_copy(&newest, v);
}

/* The last call and the step that led to it have not been. */
static void take_back(dar_solver *s, const dar_tensor *z)
{
    dar_tensor newest = s->model[0];
    s->most = (s->call[0] - s->call[1]) / 2;
    for (int i = 1; i < s->models; i++) s->model[i - 1] = s->model[i], s->call[i - 1] = s->call[i];
    s->model[s->models - 1] = newest;
    s->kept--;
    s->rejected++;
    s->estimate -= s->last;
    dar_tensor_copy(z, &s->left);
}

static double distance(const dar_tensor *x, const dar_tensor *y)
{
    return dar_flow_norm(2, (double[]){ 1, -1 }, (const dar_tensor *[]){ x, y });
}

static double norm(const dar_tensor *x)
{
    return dar_flow_norm(1, (double[]){ 1 }, (const dar_tensor *[]){ x });
}

/* The last step, with what is known of its end. */
static void correct(dar_solver *s, const method *m, const dar_tensor *z)
{
    double c[DAR_SOLVER_MODELS + 1] = { 0 };
    const size_t length = s->call[0] - s->call[1];
    m->correct(s, c);
    if (s->tolerance <= 0) {
        combine(c, &s->left, s->model, z);
        return;
    }
    combine(c, &s->left, s->model, &s->corrected);
    s->most = 2 * length;
    if (length > 1 && s->calls <= s->call[1] + 1 && !(distance(z, &s->corrected) <= GUARD * s->tolerance * norm(z)))
        take_back(s, z);
    else dar_tensor_copy(z, &s->corrected);
}

/* The difference of orders is the divided difference of the models that are read, times a number that tells how far the
 * step goes: here, scaled so that the number is the last model's coefficient. */
static double spread_of(const dar_solver *s, int n, const dar_tensor *z)
{
    double a[DAR_SOLVER_MODELS];
    const dar_tensor *x[DAR_SOLVER_MODELS];
    for (int i = 0; i < n; i++) {
        x[i] = &s->model[i];
        a[i] = 1;
        for (int k = 0; k < n - 1; k++) a[i] *= past(s, n - 1) - past(s, k);
        for (int k = 0; k < n; k++)
            if (k != i) a[i] /= past(s, i) - past(s, k);
    }
    return dar_flow_norm(n, a, x) / norm(z);
}

/* Of the step to point `to`.  Where a log ratio is infinite, orders do not differ: then what m changes by in that time,
 * at the rate at which it changed before. */
static double estimate(const dar_solver *s, const method *m, int n, size_t to)
{
    double c[DAR_SOLVER_MODELS + 1], here = past(s, 0);
    if (n < 2) return 0;
    m->predict(s, to, c);
    double most = m->clean && c[n] == 0 ? c[1] * (here - s->sigma[to]) / (past(s, 1) - here) : c[n];
    return fabs(most) * s->spread;
}

/* Where the next step goes. */
static size_t choose(dar_solver *s, const method *m, const dar_tensor *z)
{
    const int n = m->nodes < s->kept ? m->nodes : s->kept;
    const size_t here = s->call[0];
    size_t to = here + 1;
    if (s->tolerance <= 0) return to;
    if (n > 1) s->spread = spread_of(s, n, z);
    const double left = s->budget > 0 ? s->budget - s->estimate : INFINITY, most = fmin(s->tolerance, left);
    while (n > 1 && to < s->steps && to - here < s->most && estimate(s, m, n, to + 1) <= most) to++;
    s->last = estimate(s, m, n, to);
    s->estimate += s->last;
    s->most = 2 * (to - here);
    return to;
}

void dar_solver_step(dar_solver *s, const dar_tensor *v, const dar_tensor *z)
{
    DAR_ASSERT(s->step < s->steps, "solver: step %zu of %zu", s->step, s->steps);
    const method *m = &methods[s->kind];
    double c[DAR_SOLVER_MODELS + 1] = { 0 };

    remember(s, m, v, z);
    s->calls++;
    if (m->correct && s->kept > 1) correct(s, m, z);
    if (m->correct && s->models) dar_tensor_copy(&s->left, z);
    size_t to = choose(s, m, z);
    m->predict(s, to, c);
    combine(c, z, s->models ? s->model : v, z);
    s->step = to;
}
