/* guidance.c: see guidance.h. */
#include "models/guidance.h"

#include <math.h>

#include "lib/status.h"

void dar_guidance_init(dar_guidance *s, double g, double tolerance, const dar_tensor *z, dar_arena *a)
{
    *s = (dar_guidance){ .g = g, .tolerance = tolerance };
    for (int i = 0; i < 3 && tolerance > 0; i++) s->d[i] = dar_tensor_push(a, z->dtype, z->shape);
}

bool dar_guidance_asks(const dar_guidance *s, double sigma)
{
    if (s->tolerance <= 0 || s->kept < 3 || s->row + 1 >= DAR_GUIDANCE_CHECK) return true;
    const double *x = s->sigma;
    double grown = (sigma - x[0]) * (sigma - x[1]) / ((x[0] - x[1]) * (x[0] - x[2]));
    return !(s->error <= s->tolerance && s->error * fabs(grown) <= s->tolerance);
}

/* Of the last two d, on the line through them. */
static void line(const dar_guidance *s, double sigma, double a[2])
{
    a[1] = (s->sigma[0] - sigma) / (s->sigma[0] - s->sigma[1]);
    a[0] = 1 - a[1];
}

/* Put d in front of those before, and compare it with their line.  A call that is repeated replaces what it said. */
static void remember(dar_guidance *s, double sigma, const dar_tensor *c, const dar_tensor *u, double size)
{
    dar_tensor newest = s->d[2];
    double a[2];
    dar_flow_combine(2, (double[]){ 1, -1 }, (const dar_tensor *[]){ c, u }, &newest);
    if (s->kept && sigma == s->sigma[0]) {
        s->d[2] = s->d[0], s->d[0] = newest;
        return;
    }
    if (s->kept > 1) {
        line(s, sigma, a);
        const dar_tensor *x[] = { &newest, &s->d[0], &s->d[1] };
        s->error = (s->g - 1) * dar_flow_norm(3, (double[]){ 1, -a[0], -a[1] }, x) / size;
        if (s->row) s->worst = fmax(s->worst, s->error);
    }
    for (int i = 2; i > 0; i--) s->d[i] = s->d[i - 1], s->sigma[i] = s->sigma[i - 1];
    s->d[0] = newest;
    s->sigma[0] = sigma;
    if (s->kept < 3) s->kept++;
}

void dar_guidance_apply(dar_guidance *s, double sigma, const dar_tensor *u, const dar_tensor *v)
{
    double a[2];
    if (!u) {
        DAR_ASSERT(!dar_guidance_asks(s, sigma), "guidance: both velocities are needed at sigma %g", sigma);
        line(s, sigma, a);
        dar_flow_combine(3, (double[]){ 1, (s->g - 1) * a[0], (s->g - 1) * a[1] },
                         (const dar_tensor *[]){ v, &s->d[0], &s->d[1] }, v);
        s->left_out++;
        s->row++;
        return;
    }
    if (s->tolerance > 0) {
        double size = dar_flow_norm(2, (double[]){ s->g, 1 - s->g }, (const dar_tensor *[]){ v, u });
        remember(s, sigma, v, u, size);
        s->row = 0;
    }
    dar_flow_combine(2, (double[]){ s->g, 1 - s->g }, (const dar_tensor *[]){ v, u }, v);
}
