/* rng.c: Philox, and the normal distribution in arithmetic that is the same everywhere.
 *
 * The C library's log and cos may differ in the last bit between versions and processors, so both are written out
 * here; the polynomials are those of fdlibm (Sun Microsystems 1993). */
#include "lib/rng.h"

#include <math.h>
#include <string.h>

#include "lib/kern.h"
#include "lib/kern_random.h"
#include "lib/thread.h"

#define CHUNK (64 * 1024) /* elements per task; even, as DAR_PIECE is */

/* ---------------------------------------------------------------- bits */

/* Half 0 or 1 of a block as 64 bits, and its upper 53 as an integer. */
static inline uint64_t half(const dar_philox *b, int i)
{
    return (uint64_t)b->x[2 * i + 1] << 32 | b->x[2 * i];
}

static inline int64_t half53(const dar_philox *b, int i)
{
    return (int64_t)(half(b, i) >> 11);
}

void dar_rng_philox(const uint32_t counter[4], const uint32_t key[2], uint32_t out[4])
{
    dar_philox b = dar_philox_at((uint64_t)key[1] << 32 | key[0], (uint64_t)counter[3] << 32 | counter[2],
                                 (uint64_t)counter[1] << 32 | counter[0]);
    memcpy(out, b.x, sizeof b.x);
}

uint32_t dar_rng_u32(uint64_t seed, uint64_t stream, uint64_t index)
{
    return dar_philox_at(seed, stream, index / 4).x[index % 4];
}

uint64_t dar_rng_u64(uint64_t seed, uint64_t stream, uint64_t index)
{
    dar_philox b = dar_philox_at(seed, stream, index / 2);
    return half(&b, index % 2);
}

float dar_rng_f32(uint64_t seed, uint64_t stream, uint64_t index)
{
    return (float)(dar_rng_u32(seed, stream, index) >> 8) * 0x1p-24f;
}

double dar_rng_f64(uint64_t seed, uint64_t stream, uint64_t index)
{
    dar_philox b = dar_philox_at(seed, stream, index / 2);
    return (double)half53(&b, index % 2) * 0x1p-53;
}

uint64_t dar_rng_below(uint64_t seed, uint64_t stream, uint64_t index, uint64_t n)
{
    DAR_ASSERT(n >= 1, "rng: below 0");
    uint64_t x = dar_rng_u64(seed, stream, index), mask = UINT32_MAX;
    uint64_t low = (x & mask) * (n & mask), a = (x >> 32) * (n & mask), b = (x & mask) * (n >> 32);
    uint64_t carry = (low >> 32) + (a & mask) + (b & mask);
    return (x >> 32) * (n >> 32) + (a >> 32) + (b >> 32) + (carry >> 32); /* the upper half of x n */
}

uint64_t dar_rng_stream(const char *name)
{
    uint64_t h = 0xcbf29ce484222325u;
    for (; *name; name++) h = (h ^ (unsigned char)*name) * 0x100000001b3u;
    return h;
}

/* ---------------------------------------------------------------- numbers */

/* ln x for normal x > 0: x = 2^k (1 + f), s = f / (2 + f), ln(1 + f) = 2 s + s R(s^2). */
static inline double natural_log(double x)
{
    uint64_t u;
    memcpy(&u, &x, sizeof u);
    u += (uint64_t)(0x3ff00000 - 0x3fe6a09e) << 32; /* so that 1 + f lies in [sqrt(1/2), sqrt 2) */
    double k = (double)((int32_t)(u >> 52) - 1023);
    u = (u & 0xfffffffffffffu) + ((uint64_t)0x3fe6a09e << 32);
    memcpy(&x, &u, sizeof x);

    double f = x - 1, s = f / (2 + f), z = s * s, w = z * z, h = 0.5 * f * f;
    double even = w * (0x1.999999997fa04p-2 + w * (0x1.c71c51d8e78afp-3 + w * 0x1.39a09d078c69fp-3));
    double odd =
        z * (0x1.5555555555593p-1 + w * (0x1.2492494229359p-2 + w * (0x1.7466496cb03dep-3 + w * 0x1.2f112df3e5244p-3)));
    return s * (h + even + odd) + k * 0x1.a39ef35793c76p-33 - h + f + k * 0x1.62e42feep-1;
}

/* cos and sin of 2 pi v, 0 <= v < 1: 4 v = q + t with |t| <= 1/2, both exact; then on pi/2 t. */
static inline void turn(double v, double *cosine, double *sine)
{
    int32_t q = (int32_t)(4 * v + 0.5);
    double a = (4 * v - q) * 0x1.921fb54442d18p+0, z = a * a, h = 0.5 * z, w = 1 - h;
    double s =
        a + a * z *
                (-0x1.5555555555549p-3 +
                 z * (0x1.111111110f8a6p-7 +
                      z * (-0x1.a01a019c161d5p-13 +
                           z * (0x1.71de357b1fe7dp-19 + z * (-0x1.ae5e68a2b9cebp-26 + z * 0x1.5d93a5acfd57cp-33)))));
    double r = z * (0x1.555555555554cp-5 +
                    z * (-0x1.6c16c16c15177p-10 +
                         z * (0x1.a01a019cb159p-16 + z * (-0x1.27e4f809c52adp-22 +
                                                          z * (0x1.1ee9ebdb4b1c4p-29 + z * -0x1.8fae9be8838d4p-37)))));
    double c = w + (1 - w - h + z * r);
    double x = q & 1 ? s : c, y = q & 1 ? c : s;
    *cosine = (q + 1) & 2 ? -x : x;
    *sine = q & 2 ? -y : y;
}

static inline void uniform_pair(const dar_philox *b, double y[2])
{
    y[0] = (double)half53(b, 0) * 0x1p-53;
    y[1] = (double)half53(b, 1) * 0x1p-53;
}

static inline void normal_pair(const dar_philox *b, double y[2])
{
    double u = (double)(half53(b, 0) + 1) * 0x1p-53, v = (double)half53(b, 1) * 0x1p-53;
    double r = sqrt(-2 * natural_log(u)), c, s;
    turn(v, &c, &s);
    y[0] = r * c;
    y[1] = r * s;
}

double dar_rng_normal(uint64_t seed, uint64_t stream, uint64_t index)
{
    dar_philox b = dar_philox_at(seed, stream, index / 2);
    double y[2];
    normal_pair(&b, y);
    return y[index % 2];
}

/* ---------------------------------------------------------------- tensors */

struct fill {
    const dar_tensor *x;
    uint64_t seed, stream;
    double shift, scale;
    bool normal;
};

static void fill_range(void *ctx, size_t begin, size_t end, int thread)
{
    const struct fill *f = ctx;
    double y[DAR_PIECE];
    (void)thread;

    for (size_t at = begin; at < end; at += DAR_PIECE) {
        size_t n = end - at < DAR_PIECE ? end - at : DAR_PIECE;
        for (size_t i = 0; i < n; i += 2) {
            dar_philox b = dar_philox_at(f->seed, f->stream, (at + i) / 2);
            if (f->normal) normal_pair(&b, y + i);
            else uniform_pair(&b, y + i);
            y[i] = f->shift + f->scale * y[i];
            y[i + 1] = f->shift + f->scale * y[i + 1];
        }
        dar_row_convert(f->x->dtype, (char *)f->x->data + at * dar_dtype_size(f->x->dtype), DAR_F64, y, n);
    }
}

static void fill(const struct fill *f)
{
    DAR_ASSERT(dar_tensor_contiguous(f->x) && f->x->dtype != DAR_I8, "rng: the tensor is strided or of 8 bits");
    dar_parallel_range(dar_tensor_count(f->x), CHUNK, fill_range, (void *)(uintptr_t)f);
}

void dar_rng_fill_normal(const dar_tensor *x, uint64_t seed, uint64_t stream, double deviation)
{
    fill(&(struct fill){ x, seed, stream, 0, deviation, true });
}

void dar_rng_fill_uniform(const dar_tensor *x, uint64_t seed, uint64_t stream, double lo, double hi)
{
    fill(&(struct fill){ x, seed, stream, lo, hi - lo, false });
}
