/* vae_step.c: see vae_step.h. */
#include "train/vae_step.h"

#include <math.h>

#include "lib/rng.h"
#include "lib/thread.h"

/* ---------------------------------------------------------------- the loss */

struct loss {
    dar_val *total, *distance, *edge, *kl, *pixels;
};

static dar_val *distance(dar_tape *t, const dar_vae_loss *c, dar_val *y, dar_val *x)
{
    return c->round > 0 ? dar_charbonnier(t, y, x, c->round) : dar_squared_error(t, y, x, NULL, true);
}

/* Differences of neighbours along a dimension. */
static dar_val *slope(dar_tape *t, dar_val *x, int dim)
{
    int64_t n = x->x.shape.d[dim] - 1;
    return dar_sub(t, dar_slice(t, x, dim, 1, n), dar_slice(t, x, dim, 0, n));
}

static dar_val *edges(dar_tape *t, const dar_vae_loss *c, dar_val *y, dar_val *x)
{
    dar_val *down = distance(t, c, slope(t, y, 3), slope(t, x, 3));
    return dar_add(t, down, distance(t, c, slope(t, y, 4), slope(t, x, 4)));
}

static dar_val *divergence(dar_tape *t, dar_val *mean, dar_val *log_variance)
{
    dar_val *x = dar_add(t, dar_mul(t, mean, mean), dar_exp(t, log_variance));
    x = dar_mean(t, dar_sub(t, x, log_variance), DAR_ALL_DIMS, false);
    return dar_affine(t, x, 0.5, -0.5);
}

/* Normal numbers for clips n, n + 1, ... of the run, one stream each. */
static dar_val *draw(dar_tape *t, const dar_vae_loss *c, const char *purpose, int64_t n, const dar_val *like,
                     double size)
{
    dar_val *y = dar_input(t, like->x.dtype, like->x.shape);
    for (int64_t b = 0; b < like->x.shape.d[0] && !t->arena->plan; b++) {
        dar_tensor clip = dar_tensor_narrow(&y->x, 0, b, 1);
        uint64_t stream = dar_rng_u64(c->seed, dar_rng_stream(purpose), (uint64_t)(n + b));
        dar_rng_fill_normal(&clip, c->seed, stream, size);
    }
    return y;
}

static struct loss forward(dar_vae_step *s, const dar_tensor *pixels, int64_t n)
{
    dar_tape *t = &s->tape;
    const dar_vae_loss *c = &s->c;
    struct loss l = { 0 };
    dar_val *x = dar_leaf(t, *pixels, NULL), *moments = dar_vae_encode(t, s->v, x);
    dar_val *mean = dar_vae_mean(t, s->v, moments), *log_variance = dar_vae_log_variance(t, s->v, moments);
    dar_val *spread = dar_exp(t, dar_scale(t, log_variance, 0.5));
    dar_val *z = dar_add(t, mean, dar_mul(t, spread, draw(t, c, "vae.posterior", n, mean, 1)));
    if (c->noise > 0) z = dar_add(t, z, draw(t, c, "vae.noise", n, mean, c->noise));
    l.pixels = dar_vae_decode(t, s->v, dar_vae_normalise(t, s->v, z));
    l.total = l.distance = distance(t, c, l.pixels, x);
    if (c->edge > 0) {
        l.edge = edges(t, c, l.pixels, x);
        l.total = dar_add(t, l.total, dar_scale(t, l.edge, c->edge));
    }
    l.kl = divergence(t, mean, log_variance);
    l.total = dar_add(t, l.total, dar_scale(t, l.kl, c->kl));
    return l;
}

/* ---------------------------------------------------------------- steps */

static void begin(dar_vae_step *s, bool recording)
{
    dar_tape_clear(&s->tape);
    dar_arena_reset(&s->step, 0);
    s->tape.recording = recording;
}

static void backward(dar_vae_step *s, dar_val *loss)
{
    dar_val *mean = dar_scale(&s->tape, loss, 1 / (double)s->c.parts);
    dar_backward(&s->tape, mean, NULL);
}

struct looked {
    dar_val *pixels, *mean, *log_variance;
};

static struct looked look(dar_vae_step *s, const dar_tensor *x)
{
    dar_tape *t = &s->tape;
    dar_val *moments = dar_vae_encode(t, s->v, dar_leaf(t, *x, NULL));
    dar_val *mean = dar_contiguous(t, dar_vae_mean(t, s->v, moments));
    return (struct looked){ dar_vae_decode(t, s->v, dar_vae_normalise(t, s->v, mean)), mean,
                            dar_vae_log_variance(t, s->v, moments) };
}

static void plan(dar_vae_step *s, dar_shape shape)
{
    begin(s, s->c.parts > 0);
    dar_val *x = dar_input(&s->tape, s->v->main, shape);
    if (s->c.parts > 0) {
        struct loss l = forward(s, &x->x, 0);
        backward(s, l.total);
        s->forward = s->tape.cost.forward;
        s->backward = s->tape.cost.backward;
        begin(s, false); /* it may be looked at, too */
        x = dar_input(&s->tape, s->v->main, shape);
    }
    struct looked l = look(s, &x->x);
    distance(&s->tape, &s->c, l.pixels, x);
    divergence(&s->tape, l.mean, l.log_variance);
}

dar_status dar_vae_step_init(dar_vae_step *s, dar_vae *v, const dar_vae_loss *c, dar_shape pixels, bool plans,
                             dar_err *e)
{
    *s = (dar_vae_step){ .c = *c, .v = v };
    dar_status status = dar_arena_init_plan(&s->step, "step", e);
    if (status == DAR_OK) status = dar_tape_init(&s->tape, &s->step, e);
    if (status == DAR_OK) plan(s, pixels);
    size_t bytes = s->step.peak;
    if (status == DAR_OK && !plans) {
        dar_tape_free(&s->tape);
        dar_arena_free(&s->step);
        status = dar_arena_init(&s->step, "step", bytes, e);
        if (status == DAR_OK) status = dar_tape_init(&s->tape, &s->step, e);
    }
    if (status != DAR_OK) dar_vae_step_free(s);
    return status;
}

void dar_vae_step_free(dar_vae_step *s)
{
    dar_tape_free(&s->tape);
    dar_arena_free(&s->step);
    *s = (dar_vae_step){ 0 };
}

static double value(const dar_val *x)
{
    return x ? dar_dtype_get(x->x.dtype, x->x.data, 0) : 0;
}

struct pair {
    const dar_tensor *x, *y;
};

static double square_sum(void *ctx, size_t first, size_t end)
{
    const struct pair *p = ctx;
    double sum = 0;
    for (size_t i = first; i < end; i++) {
        double d = dar_dtype_get(p->x->dtype, p->x->data, i) - dar_dtype_get(p->y->dtype, p->y->data, i);
        sum += d * d;
    }
    return sum;
}

static double mean_square(const dar_tensor *x, const dar_tensor *y)
{
    enum { CHUNK = 1 << 16 };
    size_t n = dar_tensor_count(x);
    return dar_parallel_sum(n, CHUNK, square_sum, &(struct pair){ x, y }) / (double)n;
}

double dar_vae_psnr(double square)
{
    return 10 * log10(4 / square);
}

dar_vae_report dar_vae_step_run(dar_vae_step *s, const dar_tensor *x, int64_t step, int64_t part)
{
    begin(s, true);
    struct loss l = forward(s, x, (step * s->c.parts + part) * x->shape.d[0]);
    dar_vae_report r = { value(l.total), value(l.distance), value(l.edge), value(l.kl), mean_square(x, &l.pixels->x) };
    backward(s, l.total);
    return r;
}

/* ---------------------------------------------------------------- looking */

static void add_sums(const dar_tensor *z, dar_vae_sums *sums)
{
    const size_t B = (size_t)z->shape.d[0], C = (size_t)z->shape.d[1], n = dar_tensor_count(z) / (B * C);
    for (size_t b = 0; b < B; b++)
        for (size_t k = 0; k < C; k++)
            for (size_t i = 0; i < n; i++) {
                double x = dar_dtype_get(z->dtype, z->data, (b * C + k) * n + i);
                sums->sum[k] += x;
                sums->square[k] += x * x;
            }
    sums->n += (double)(B * n);
}

dar_vae_report dar_vae_step_look(dar_vae_step *s, const dar_tensor *x, dar_vae_sums *sums)
{
    begin(s, false);
    struct looked l = look(s, x);
    dar_vae_clamp(&l.pixels->x);
    if (sums) add_sums(&l.mean->x, sums);
    dar_vae_report r = { .square = mean_square(x, &l.pixels->x) };
    r.distance = value(distance(&s->tape, &s->c, l.pixels, dar_leaf(&s->tape, *x, NULL)));
    r.kl = value(divergence(&s->tape, l.mean, l.log_variance));
    r.loss = r.distance + s->c.kl * r.kl;
    return r;
}

void dar_vae_standard(const dar_vae_sums *s, int64_t channels, double *mean, double *std)
{
    for (int64_t k = 0; k < channels; k++) {
        mean[k] = s->sum[k] / s->n;
        std[k] = sqrt(fmax(s->square[k] / s->n - mean[k] * mean[k], 1e-12));
    }
}
