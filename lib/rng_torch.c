/* rng_torch.c: MT19937 and three ways from its bits to normal numbers. */
#include "lib/rng_torch.h"

#include <math.h>

#include "lib/thread.h"

#define N     624
#define GROUP 16  /* values that are made together: 8 radii, 8 angles */
#define CHUNK 512 /* groups per task */

#define TWO_PI 6.283185307179586

/* ---------------------------------------------------------------- MT19937 */

void dar_rng_torch_seed(dar_rng_torch *g, uint64_t seed)
{
    g->state[0] = (uint32_t)seed;
    for (uint32_t i = 1; i < N; i++) g->state[i] = 1812433253u * (g->state[i - 1] ^ g->state[i - 1] >> 30) + i;
    g->used = N;
    g->spare = false;
}

static void twist(uint32_t *x)
{
    for (int i = 0; i < N; i++) {
        uint32_t y = (x[i] & 0x80000000u) | (x[(i + 1) % N] & 0x7fffffffu);
        x[i] = x[(i + 397) % N] ^ y >> 1 ^ (y & 1 ? 0x9908b0dfu : 0);
    }
}

static uint32_t next32(dar_rng_torch *g)
{
    if (g->used == N) {
        twist(g->state);
        g->used = 0;
    }
    uint32_t y = g->state[g->used++];
    y ^= y >> 11;
    y ^= y << 7 & 0x9d2c5680u;
    y ^= y << 15 & 0xefc60000u;
    return y ^ y >> 18;
}

static float uniform32(dar_rng_torch *g)
{
    return (float)(next32(g) & 0xffffff) * 0x1p-24f;
}

static double uniform64(dar_rng_torch *g)
{
    uint64_t high = next32(g);
    return (double)(int64_t)((high << 32 | next32(g)) & 0x1fffffffffffffu) * 0x1p-53;
}

/* ---------------------------------------------------------------- f32
 *
 * Which sums are fused with which products decides the last bit, so it is written out. */

/* ln x for normal x > 0: x = m 2^e, polynomial in m - 1. */
static float log32(float x)
{
    static const float p[] = { 7.0376836292e-2f,  -1.1514610310e-1f, 1.1676998740e-1f,
                               -1.2420140846e-1f, 1.4249322787e-1f,  -1.6668057665e-1f,
                               2.0000714765e-1f,  -2.4999993993e-1f, 3.3333331174e-1f };
    int exponent;
    float m = frexpf(x, &exponent), e = (float)exponent, y = p[0];

    if (m < 0.707106781186547524f) {
        e -= 1;
        m += m;
    }
    m -= 1;
    float z = m * m;
    for (int i = 1; i < 9; i++) y = fmaf(y, m, p[i]);
    y = fmaf(y * m, z, e * -2.12194440e-4f);
    y = fmaf(-0.5f, z, y);
    return fmaf(e, 0.693359375f, m + y);
}

/* cos x and sin x for 0 <= x <= 2 pi: x less j pi/4, j even, in three steps. */
static void turn32(float x, float *cosine, float *sine)
{
    int j = ((int)(x * 1.27323954473516f) + 1) & ~1;
    float q = (float)j;

    x = fmaf(q, -0.78515625f, x);
    x = fmaf(q, -2.4187564849853515625e-4f, x);
    x = fmaf(q, -3.77489497744594108e-8f, x);
    float z = x * x;
    float c = fmaf(fmaf(2.443315711809948e-5f, z, -1.388731625493765e-3f), z, 4.166664568298827e-2f) * z;
    float s = fmaf(fmaf(-1.9515295891e-4f, z, 8.3321608736e-3f), z, -1.6666654611e-1f) * z;
    c = fmaf(c, z, -0.5f * z) + 1;
    s = fmaf(s, x, x);
    *cosine = (j + 2) & 4 ? -(j & 2 ? s : c) : j & 2 ? s : c;
    *sine = j & 4 ? -(j & 2 ? c : s) : j & 2 ? c : s;
}

/* 16 uniform numbers become normal: 8 radii, then 8 angles. */
static void group32(float *x)
{
    for (int i = 0; i < GROUP / 2; i++) {
        float r = sqrtf(-2 * log32(1 - x[i])), c, s;
        turn32((float)TWO_PI * x[i + GROUP / 2], &c, &s);
        x[i] = r * c;
        x[i + GROUP / 2] = r * s;
    }
}

static void groups32(void *ctx, size_t begin, size_t end, int thread)
{
    (void)thread;
    for (size_t i = begin; i < end; i++) group32((float *)ctx + i * GROUP);
}

/* ---------------------------------------------------------------- f64 */

static void group64(double *x)
{
    for (int i = 0; i < GROUP / 2; i++) {
        double r = sqrt(-2 * log(1 - x[i])), a = TWO_PI * x[i + GROUP / 2];
        x[i] = r * cos(a);
        x[i + GROUP / 2] = r * sin(a);
    }
}

static void groups64(void *ctx, size_t begin, size_t end, int thread)
{
    (void)thread;
    for (size_t i = begin; i < end; i++) group64((double *)ctx + i * GROUP);
}

/* One number; every second one is left over from the call before. */
static double one(dar_rng_torch *g)
{
    g->spare = !g->spare;
    if (!g->spare) return g->value;
    double a = TWO_PI * uniform64(g), r = sqrt(-2 * log1p(-uniform64(g)));
    g->value = r * sin(a);
    return r * cos(a);
}

/* ---------------------------------------------------------------- */

/* A length that is no multiple of 16 has its last 16 values drawn anew. */
void dar_rng_torch_normal(dar_rng_torch *g, const dar_tensor *x)
{
    size_t n = dar_tensor_count(x);
    bool tail = n % GROUP;

    DAR_ASSERT(dar_tensor_contiguous(x) && (x->dtype == DAR_F32 || x->dtype == DAR_F64),
               "rng_torch: the tensor is strided or not of f32 or f64");
    if (n < GROUP) {
        for (size_t i = 0; i < n; i++) dar_dtype_set(x->dtype, x->data, i, one(g));
    } else if (x->dtype == DAR_F32) {
        float *y = x->data;
        for (size_t i = 0; i < n; i++) y[i] = uniform32(g);
        dar_parallel_range(n / GROUP, CHUNK, groups32, y);
        for (size_t i = n - GROUP; tail && i < n; i++) y[i] = uniform32(g);
        if (tail) group32(y + n - GROUP);
    } else {
        double *y = x->data;
        for (size_t i = 0; i < n; i++) y[i] = uniform64(g);
        dar_parallel_range(n / GROUP, CHUNK, groups64, y);
        for (size_t i = n - GROUP; tail && i < n; i++) y[i] = uniform64(g);
        if (tail) group64(y + n - GROUP);
    }
}
