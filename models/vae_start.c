/* vae_start.c: see vae_start.h. */
#include "models/vae_start.h"

#include <math.h>
#include <string.h>

#include "lib/gemm.h"
#include "lib/size.h"

#define NARROW (-6) /* log-variance of the posterior */
#define COMMON 2.4  /* deviation of the coefficient of cost 1, of pixels in [-1, 1]; of cost c: 1 / c of it */
#define CHROMA 3    /* cost of a colour difference, in those of brightness */
#define ROUNDS 60   /* of orthogonal iteration */
#define FLAT   1e-6 /* least mean square of a component that is scaled to 1 */

/* ---------------------------------------------------------------- blocks of pixels */

static dar_matrix f64(const double *x, size_t ld, bool t)
{
    return (dar_matrix){ .type = DAR_F64, .data = x, .ld = ld, .t = t };
}

/* product += row^T row of n blocks. */
static dar_gemm outer(const dar_vae_blocks *b, size_t n)
{
    return (dar_gemm){ .kind = DAR_TILE_F64,
                       .m = b->length,
                       .n = b->length,
                       .k = n,
                       .a = f64(b->row, b->length, true),
                       .b = f64(b->row, b->length, false),
                       .alpha = 1,
                       .type = DAR_F64,
                       .c = b->product,
                       .ldc = b->length,
                       .add = true };
}

/* q[1] = q[0] product, which is symmetric. */
static dar_gemm applied(const dar_vae_blocks *b)
{
    return (dar_gemm){ .kind = DAR_TILE_F64,
                       .m = (size_t)b->v->c.latent,
                       .n = b->length,
                       .k = b->length,
                       .a = f64(b->q[0], b->length, false),
                       .b = f64(b->product, b->length, false),
                       .alpha = 1,
                       .type = DAR_F64,
                       .c = b->q[1],
                       .ldc = b->length };
}

static double *push_rows(dar_vae_blocks *b, size_t rows)
{
    return dar_arena_push(&b->arena, dar_mul_size(dar_mul_size(rows, b->length), sizeof(double)));
}

static void push(dar_vae_blocks *b)
{
    const dar_gemm g = outer(b, b->most), a = applied(b);
    b->product = push_rows(b, b->length);
    b->row = push_rows(b, b->most);
    for (int i = 0; i < 2; i++) b->q[i] = push_rows(b, (size_t)b->v->c.latent);
    b->scratch = dar_arena_push(&b->arena, dar_most(dar_gemm_scratch(&g), dar_gemm_scratch(&a)));
}

dar_status dar_vae_blocks_init(dar_vae_blocks *b, dar_vae *v, int64_t height, int64_t width, dar_err *e)
{
    const int64_t r = dar_vae_shrink(&v->c), s = dar_vae_shrink_time(&v->c);
    *b = (dar_vae_blocks){ .v = v, .most = (size_t)(height / r * (width / r)), .length = (size_t)(3 * r * r * s) };
    if (!v->c.linear) return DAR_OK;
    DAR_TRY(dar_arena_init_plan(&b->arena, "blocks", e));
    push(b);
    size_t bytes = b->arena.peak;
    dar_arena_free(&b->arena);
    DAR_TRY(dar_arena_init(&b->arena, "blocks", bytes, e));
    push(b);
    memset(b->product, 0, b->length * b->length * sizeof(double));
    return DAR_OK;
}

void dar_vae_blocks_free(dar_vae_blocks *b)
{
    dar_arena_free(&b->arena);
    *b = (dar_vae_blocks){ 0 };
}

/* Where number i of a block is: as frame_unshuffle of pixel_unshuffle counts. */
struct place {
    int64_t t, y, x, colour;
};

static struct place place_of(int64_t i, int64_t r)
{
    return (struct place){ i / (3 * r * r), i / r % r, i % r, i / (r * r) % 3 };
}

/* The blocks of latent frame f: its first pixel frame s times, then s each. */
static void gather(dar_vae_blocks *b, const dar_tensor *x, int64_t clip, int64_t f)
{
    const int64_t r = dar_vae_shrink(&b->v->c), s = dar_vae_shrink_time(&b->v->c);
    const int64_t *d = x->shape.d, F = d[2], H = d[3], W = d[4], w = W / r;
    for (int64_t i = 0; i < (int64_t)b->length; i++) {
        struct place p = place_of(i, r);
        int64_t frame = f ? 1 + (f - 1) * s + p.t : 0;
        size_t plane = (size_t)(((clip * 3 + p.colour) * F + frame) * H);
        for (int64_t k = 0; k < H / r * w; k++) {
            size_t at = (plane + (size_t)(k / w * r + p.y)) * (size_t)W + (size_t)(k % w * r + p.x);
            b->row[(size_t)k * b->length + (size_t)i] = dar_dtype_get(x->dtype, x->data, at);
        }
    }
}

void dar_vae_blocks_add(dar_vae_blocks *b, const dar_tensor *x)
{
    const int64_t *d = x->shape.d, r = dar_vae_shrink(&b->v->c), s = dar_vae_shrink_time(&b->v->c);
    const size_t n = (size_t)(d[3] / r * (d[4] / r));
    DAR_ASSERT(n <= b->most && dar_tensor_contiguous(x), "vae: %zu blocks of a frame, at most %zu", n, b->most);
    if (!b->v->c.linear) return;
    for (int64_t clip = 0; clip < d[0]; clip++)
        for (int64_t f = 0; f <= (d[2] - 1) / s; f++) {
            gather(b, x, clip, f);
            dar_gemm g = outer(b, n);
            dar_gemm_run(&g, b->scratch);
            b->n += n;
        }
}

/* ---------------------------------------------------------------- the cosine transform */

/* One wave over s frames of r x r pixels and the colours, orthonormal. */
struct wave {
    struct place k;
    double cost;
};

static double cosine(int64_t k, int64_t n, int64_t at)
{
    return cos(acos(-1) * ((double)at + 0.5) * (double)k / (double)n) * sqrt((k ? 2.0 : 1.0) / (double)n);
}

/* The next one in the order of cost, then of number; of cost 0 before the first. */
static struct wave next_wave(int64_t s, int64_t r, struct wave last)
{
    struct wave best = { 0 };
    bool passed = last.cost == 0; /* `last` itself, among those of its cost */
    for (int64_t i = 0; i < s * r * r * 3; i++) {
        struct wave w = { { i / (3 * r * r), i / (3 * r) % r, i / 3 % r, i % 3 }, 0 };
        w.cost = (double)((1 + w.k.t * w.k.t + w.k.y * w.k.y + w.k.x * w.k.x) * (w.k.colour ? CHROMA : 1));
        bool after = w.cost > last.cost || (w.cost == last.cost && passed);
        if (after && (best.cost == 0 || w.cost < best.cost)) best = w;
        if (!memcmp(&w.k, &last.k, sizeof w.k)) passed = true;
    }
    return best;
}

static void write_wave(double *x, const struct wave *w, int64_t s, int64_t r)
{
    static const double colour[3][3] = { { 1, 1, 1 }, { 1, 0, -1 }, { 1, -2, 1 } };
    const double length[3] = { sqrt(3), sqrt(2), sqrt(6) };
    for (int64_t i = 0; i < 3 * r * r * s; i++) {
        struct place p = place_of(i, r);
        x[i] = cosine(w->k.t, s, p.t) * cosine(w->k.y, r, p.y) * cosine(w->k.x, r, p.x) *
               colour[w->k.colour][p.colour] / length[w->k.colour];
    }
}

/* ---------------------------------------------------------------- principal components */

static double dot(size_t n, const double *x, const double *y)
{
    double sum = 0;
    for (size_t i = 0; i < n; i++) sum += x[i] * y[i];
    return sum;
}

/* Rows of y made orthonormal, in order; one that the others span already stays as it was in q. */
static void orthonormal(size_t rows, size_t n, const double *q, double *y)
{
    for (size_t k = 0; k < rows; k++) {
        double *x = y + k * n, first = sqrt(dot(n, x, x));
        for (int twice = 0; twice < 2; twice++)
            for (size_t j = 0; j < k; j++) {
                double part = dot(n, x, y + j * n);
                for (size_t i = 0; i < n; i++) x[i] -= part * y[j * n + i];
            }
        double left = sqrt(dot(n, x, x));
        if (left > 1e-10 * first)
            for (size_t i = 0; i < n; i++) x[i] /= left;
        else memcpy(x, q + k * n, n * sizeof *x);
    }
}

/* From waves to components. */
static void iterate(dar_vae_blocks *b)
{
    const size_t C = (size_t)b->v->c.latent;
    const dar_gemm g = applied(b);
    for (int round = 0; round < ROUNDS; round++) {
        dar_gemm_run(&g, b->scratch);
        orthonormal(C, b->length, b->q[0], b->q[1]);
        memcpy(b->q[0], b->q[1], C * b->length * sizeof(double));
    }
    dar_gemm_run(&g, b->scratch); /* for mean_square */
}

static double mean_square(const dar_vae_blocks *b, size_t k)
{
    const size_t at = k * b->length;
    return dot(b->length, b->q[0] + at, b->q[1] + at) / (double)b->n;
}

/* ---------------------------------------------------------------- the start */

/* Row k of the encoder's map and column k of the decoder's. */
static void write_maps(const dar_vae *v, size_t k, const double *x, double scale)
{
    const dar_tensor *to = &v->linear[DAR_VAE_ENCODER].w->x, *from = &v->linear[DAR_VAE_DECODER].w->x;
    const size_t P = (size_t)from->shape.d[0], C = (size_t)v->c.latent;
    for (size_t i = 0; i < P; i++) {
        dar_dtype_set(to->dtype, to->data, k * P + i, x[i] / scale);
        dar_dtype_set(from->dtype, from->data, i * C + k, x[i] * scale);
    }
}

/* Directions in q[0], and their deviations. */
static void find_directions(dar_vae_blocks *b, size_t n, double *deviation)
{
    const int64_t s = dar_vae_shrink_time(&b->v->c), r = dar_vae_shrink(&b->v->c);
    struct wave w = { 0 };
    memset(b->q[0], 0, (size_t)b->v->c.latent * b->length * sizeof(double));
    for (size_t k = 0; k < n; k++) {
        w = next_wave(s, r, w);
        write_wave(b->q[0] + k * b->length, &w, s, r);
        deviation[k] = COMMON / w.cost;
    }
    if (!b->n) return;
    iterate(b);
    for (size_t k = 0; k < n; k++) deviation[k] = sqrt(fmax(mean_square(b, k), FLAT));
}

static void start_maps(dar_vae_blocks *b, double spread)
{
    const dar_vae *v = b->v;
    const dar_tensor *bias = &v->moments.b->x;
    const size_t C = (size_t)v->c.latent, n = dar_least(C, b->length); /* further latent numbers stay 0 */
    double deviation[DAR_VAE_LATENT], sum = 0;
    find_directions(b, n, deviation);
    for (size_t k = 0; k < n; k++) sum += pow(deviation[k], 2 * spread);
    for (size_t k = 0; k < n; k++) {
        double wanted = pow(deviation[k], spread) / sqrt(sum / (double)n);
        write_maps(v, k, b->q[0] + k * b->length, deviation[k] / wanted);
        dar_dtype_set(bias->dtype, bias->data, C + k, NARROW + 2 * log(wanted));
    }
}

static void clear(const dar_vae_conv *c)
{
    dar_tensor_fill(&c->w->x, 0);
    dar_tensor_fill(&c->b->x, 0);
}

void dar_vae_start(dar_vae_blocks *b, double spread)
{
    dar_vae *v = b->v;
    const dar_tensor *bias = &v->moments.b->x;
    clear(&v->moments);
    for (int64_t i = v->c.latent; i < 2 * v->c.latent; i++) dar_dtype_set(bias->dtype, bias->data, (size_t)i, NARROW);
    if (!v->c.linear) return;
    clear(&v->decoder.last);
    for (int i = 0; i < 2; i++) clear(&v->linear[i]);
    start_maps(b, spread);
}
