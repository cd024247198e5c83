/* resample.c: exchange of pixels, frames and channels between a fine grid and a coarse one: shuffles, shortcuts and
 * nearest up-sampling.
 *
 * All of them are one relation.  The elements of fine channel c under coarse position (t, h, w) are numbered
 *
 *   k = c step_c + a step_a + b step_b + d step_d,      element [c, t ft + a - front, h fs + b, w fs + d]
 *
 * for a < ft and b, d < fs, and coarse channel o stands for the G numbers from o G.  Down takes the mean of each group,
 * up copies the coarse value to its whole group; each is the other's gradient, but for the factor 1/G.  Fine frames
 * before frame 0, `front` of them, are zero when read and lost when written. */
#include "autograd/ops.h"

#include <string.h>

#include "lib/kern.h"
#include "lib/thread.h"

struct attr {
    int64_t channels; /* of y; 0: as many as make G = 1 */
    int ft, fs;
    int front; /* up: fine frames lost; down pads to whole groups by itself */
    dar_pixel_order order;
};

/* ---------------------------------------------------------------- rows */

/* Every step-th element of a row, and back.  Steps of 1 and 2 are constants, so that they vectorise.
 *   take     acc[i] (+)= src[i step]
 *   take2    acc[i] (+)= src[2i] + src[2i + 1]
 *   spread   dst[i step] (+)= scale v[i]
 *   spread2  dst[2i] (+)= scale v[i], dst[2i + 1] (+)= scale u[i] */
#define STEPS(CALL)                                                                                                    \
    do {                                                                                                               \
        if (step == 1) CALL(1);                                                                                        \
        else if (step == 2) CALL(2);                                                                                   \
        else CALL(step);                                                                                               \
    } while (0)
#define ADD_ALL(s)                                                                                                     \
    for (size_t i = 0; i < n; i++) acc[i] += src[i * (s)]
#define GET_ALL(s)                                                                                                     \
    for (size_t i = 0; i < n; i++) acc[i] = src[i * (s)]
#define ADD_EACH(s)                                                                                                    \
    for (size_t i = 0; i < n; i++) dst[i * (s)] += scale * v[i]
#define SCALE_EACH(s)                                                                                                  \
    for (size_t i = 0; i < n; i++) dst[i * (s)] = scale * v[i]
#define PUT_EACH(s)                                                                                                    \
    for (size_t i = 0; i < n; i++) dst[i * (s)] = v[i]

#define DEF_SUMS(NAME, TYPE)                                                                                           \
    static void take_##NAME(size_t n, const void *src_, size_t step, void *acc_, bool add)                             \
    {                                                                                                                  \
        const TYPE *src = src_;                                                                                        \
        TYPE *acc = acc_;                                                                                              \
        if (add) STEPS(ADD_ALL);                                                                                       \
        else STEPS(GET_ALL);                                                                                           \
    }                                                                                                                  \
    static void take2_##NAME(size_t n, const void *src_, void *acc_, bool add)                                         \
    {                                                                                                                  \
        const TYPE *src = src_;                                                                                        \
        TYPE *acc = acc_;                                                                                              \
        if (add)                                                                                                       \
            for (size_t i = 0; i < n; i++) acc[i] += src[2 * i] + src[2 * i + 1];                                      \
        else                                                                                                           \
            for (size_t i = 0; i < n; i++) acc[i] = src[2 * i] + src[2 * i + 1];                                       \
    }                                                                                                                  \
    static void spread_##NAME(size_t n, const void *v_, double by, void *dst_, size_t step, bool add)                  \
    {                                                                                                                  \
        const TYPE *v = v_, scale = (TYPE)by;                                                                          \
        TYPE *dst = dst_;                                                                                              \
        if (add) STEPS(ADD_EACH);                                                                                      \
        else STEPS(SCALE_EACH);                                                                                        \
    }                                                                                                                  \
    static void spread2_##NAME(size_t n, const void *v_, const void *u_, double by, void *dst_, bool add)              \
    {                                                                                                                  \
        const TYPE *v = v_, *u = u_, scale = (TYPE)by;                                                                 \
        TYPE *dst = dst_;                                                                                              \
        if (add)                                                                                                       \
            for (size_t i = 0; i < n; i++) dst[2 * i] += scale * v[i], dst[2 * i + 1] += scale * u[i];                 \
        else                                                                                                           \
            for (size_t i = 0; i < n; i++) dst[2 * i] = scale * v[i], dst[2 * i + 1] = scale * u[i];                   \
    }

DEF_SUMS(f64, double)
DEF_SUMS(f32, float)

/* 16-bit elements are only moved: scale is 1 and add false. */
static void take_bits(size_t n, const void *src_, size_t step, void *acc_, bool add)
{
    const uint16_t *src = src_;
    uint16_t *acc = acc_;
    (void)add;
    STEPS(GET_ALL);
}

static void spread_bits(size_t n, const void *v_, double by, void *dst_, size_t step, bool add)
{
    const uint16_t *v = v_;
    uint16_t *dst = dst_;
    (void)by, (void)add;
    STEPS(PUT_EACH);
}

static void spread2_bits(size_t n, const void *v_, const void *u_, double by, void *dst_, bool add)
{
    const uint16_t *v = v_, *u = u_;
    uint16_t *dst = dst_;
    (void)by, (void)add;
    for (size_t i = 0; i < n; i++) dst[2 * i] = v[i], dst[2 * i + 1] = u[i];
}

typedef struct row_fns {
    void (*take)(size_t n, const void *src, size_t step, void *acc, bool add);
    void (*take2)(size_t n, const void *src, void *acc, bool add);
    void (*spread)(size_t n, const void *v, double scale, void *dst, size_t step, bool add);
    void (*spread2)(size_t n, const void *v, const void *u, double scale, void *dst, bool add);
} row_fns;

static const row_fns rows[] = { [DAR_F64] = { take_f64, take2_f64, spread_f64, spread2_f64 },
                                [DAR_F32] = { take_f32, take2_f32, spread_f32, spread2_f32 },
                                [DAR_BF16] = { take_bits, NULL, spread_bits, spread2_bits },
                                [DAR_F16] = { take_bits, NULL, spread_bits, spread2_bits } };

/* ---------------------------------------------------------------- the relation */

struct grid {
    const dar_tensor *fine, *coarse;
    size_t Cf, Tf, Hf, Wf, Cc, Tc, Hc, Wc;
    size_t ft, fs, front, G;
    size_t beside; /* coarse channels made of the same fine ones: walked together, while those are near */
    size_t step_c, step_a, step_b, step_d;
    double scale;
    bool add;
    dar_dtype work; /* type of sums; the stored one where values are only moved */
};

struct digits {
    size_t c, a, b, d;
};

static struct digits digits_of(const struct grid *g, size_t k)
{
    return (struct digits){ k / g->step_c % g->Cf, k / g->step_a % g->ft, k / g->step_b % g->fs,
                            k / g->step_d % g->fs };
}

/* k + 1 without a division, except over the channels. */
static void next_digits(const struct grid *g, size_t k, struct digits *e)
{
    size_t *fast = g->step_d < g->step_b ? &e->d : &e->b, *slow = g->step_d < g->step_b ? &e->b : &e->d;
    if (g->step_c == 1 || g->fs == 1) *e = digits_of(g, k + 1);
    else if (++*fast == g->fs) {
        *fast = 0;
        if (++*slow == g->fs) *e = digits_of(g, k + 1);
    }
}

/* [B, C, H, W] is [B, C, 1, H, W]. */
static void dims(const dar_shape *s, size_t *C, size_t *T, size_t *H, size_t *W)
{
    *C = (size_t)s->d[1];
    *T = s->n == 5 ? (size_t)s->d[2] : 1;
    *H = (size_t)s->d[s->n - 2];
    *W = (size_t)s->d[s->n - 1];
}

static struct grid grid_of(const struct attr *a, const dar_tensor *fine, const dar_tensor *coarse, bool mean, bool add)
{
    struct grid g = { .fine = fine, .coarse = coarse, .ft = (size_t)a->ft, .fs = (size_t)a->fs, .add = add };
    dims(&fine->shape, &g.Cf, &g.Tf, &g.Hf, &g.Wf);
    dims(&coarse->shape, &g.Cc, &g.Tc, &g.Hc, &g.Wc);
    g.G = g.Cf * g.ft * g.fs * g.fs / g.Cc;
    g.front = g.Tc * g.ft - g.Tf;
    g.scale = mean ? 1.0 / (double)g.G : 1;
    g.work = fine->dtype;
    size_t under = g.ft * g.fs * g.fs / g.G;
    g.beside = a->order != DAR_FRAMES_FIRST && under && g.Cc % under == 0 ? under : 1;
    if (a->order == DAR_PIXELS_ROWS) {
        g.step_d = 1, g.step_b = g.fs, g.step_a = g.fs * g.fs, g.step_c = g.fs * g.fs * g.ft;
    } else if (a->order == DAR_PIXELS_COLUMNS) {
        g.step_b = 1, g.step_d = g.fs, g.step_a = g.fs * g.fs, g.step_c = g.fs * g.fs * g.ft;
    } else {
        g.step_c = 1, g.step_d = g.Cf, g.step_b = g.Cf * g.fs, g.step_a = g.Cf * g.fs * g.fs;
    }
    return g;
}

static char *element(const dar_tensor *x, size_t i)
{
    return (char *)x->data + i * dar_dtype_size(x->dtype);
}

/* A row of the coarse tensor, but for its channel. */
struct row {
    size_t batch, t, h;
};

static void *coarse_row(const struct grid *g, const struct row *r, size_t o)
{
    return element(g->coarse, (((r->batch * g->Cc + o) * g->Tc + r->t) * g->Hc + r->h) * g->Wc);
}

/* n coarse elements from column w: the sum of the G numbers from k, whose digits are e; leaves e behind them. */
static void sum_group(const struct grid *g, const struct row *r, size_t k, struct digits *e, size_t w, size_t n,
                      void *acc)
{
    const row_fns *fn = &rows[g->work];
    bool pairs = g->fs == 2 && g->step_d == 1 && g->G % 2 == 0, any = false;
    double buf[DAR_PIECE];

    for (size_t end = k + g->G; k < end; next_digits(g, k++, e)) {
        if (r->t * g->ft + e->a < g->front || (pairs && e->d)) continue;
        size_t frame = r->t * g->ft + e->a - g->front;
        size_t row = ((r->batch * g->Cf + e->c) * g->Tf + frame) * g->Hf + r->h * g->fs + e->b;
        size_t length = pairs ? 2 * n : (n - 1) * g->fs + 1;
        const void *src = element(g->fine, row * g->Wf + w * g->fs + e->d);
        if (g->work != g->fine->dtype) src = dar_row_get(g->work, g->fine->dtype, src, length, buf);
        if (pairs) fn->take2(n, src, acc, any);
        else fn->take(n, src, g->fs, acc, any);
        any = true;
    }
    if (!any) memset(acc, 0, n * dar_dtype_size(g->work));
}

static void store_sum(const struct grid *g, size_t n, void *acc, void *to)
{
    if (g->work == g->coarse->dtype) {
        rows[g->work].spread(n, acc, g->scale, to, 1, g->add);
    } else {
        rows[g->work].spread(n, acc, g->scale, acc, 1, false);
        dar_row_put(g->work, acc, g->coarse->dtype, to, n, g->add ? DAR_PUT_ADD : DAR_PUT);
    }
}

/* Items are rows of `beside` channels together. */
static void gather_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const struct grid *g = ctx;
    size_t piece = DAR_PIECE / g->fs, groups = g->Cc / g->beside;
    bool direct = g->work == g->coarse->dtype && g->scale == 1 && !g->add;
    double acc[DAR_PIECE];
    (void)thread;

    for (size_t i = begin; i < end; i++) {
        size_t far = i / g->Hc / g->Tc, o = far % groups * g->beside;
        struct row r = { far / groups, i / g->Hc % g->Tc, i % g->Hc };
        for (size_t w = 0; w < g->Wc; w += piece) {
            size_t n = g->Wc - w < piece ? g->Wc - w : piece;
            struct digits e = digits_of(g, o * g->G);
            for (size_t near = o; near < o + g->beside; near++) {
                char *to = (char *)coarse_row(g, &r, near) + w * dar_dtype_size(g->coarse->dtype);
                sum_group(g, &r, near * g->G, &e, w, n, direct ? (void *)to : acc);
                if (!direct) store_sum(g, n, acc, to);
            }
        }
    }
}

static void spread_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const struct grid *g = ctx;
    const row_fns *fn = &rows[g->work];
    (void)thread;

    for (size_t i = begin; i < end; i++) {
        size_t h = i % g->Hf, f = i / g->Hf % g->Tf + g->front, c = i / g->Hf / g->Tf % g->Cf;
        size_t k = c * g->step_c + f % g->ft * g->step_a + h % g->fs * g->step_b;
        struct row r = { i / g->Hf / g->Tf / g->Cf, f / g->ft, h / g->fs };
        char *dst = element(g->fine, i * g->Wf);
        if (g->fs == 2)
            fn->spread2(g->Wc, coarse_row(g, &r, k / g->G), coarse_row(g, &r, (k + g->step_d) / g->G), g->scale, dst,
                        g->add);
        else
            for (size_t d = 0; d < g->fs; d++)
                fn->spread(g->Wc, coarse_row(g, &r, (k + d * g->step_d) / g->G), g->scale,
                           dst + d * dar_dtype_size(g->fine->dtype), g->fs, g->add);
    }
}

/* ---------------------------------------------------------------- values that only change places */

struct side {
    int64_t n, fine, coarse; /* length, strides [elements] */
};

/* Every index of the relation, neighbours merged where both grids allow; at most 8. */
static int sides_of(const struct grid *g, struct side *side)
{
    size_t row = g->Wf, frame = g->Hf * row, plane = g->Tc * g->Hc * g->Wc;
    size_t B = dar_tensor_count(g->fine) / (g->Cf * g->Tf * frame), all[][3] = {
        { B, g->Cf * g->Tf * frame, g->Cc * plane },
        { g->Cf, g->Tf * frame, g->step_c * plane },
        { g->ft, frame, g->step_a * plane },
        { g->fs, row, g->step_b * plane },
        { g->Tc, g->ft * frame, g->Hc * g->Wc },
        { g->Hc, g->fs * row, g->Wc },
        { g->Wc, g->fs, 1 },
        { g->fs, 1, g->step_d * plane },
    };
    int n = 0;
    for (size_t i = 0; i < DAR_COUNT(all); i++) {
        struct side s = { (int64_t)all[i][0], (int64_t)all[i][1], (int64_t)all[i][2] }, *last = &side[n - 1];
        if (s.n == 1) continue;
        if (n && last->fine == s.n * s.fine && last->coarse == s.n * s.coarse) {
            last->n *= s.n;
            last->fine = s.fine;
            last->coarse = s.coarse;
        } else {
            side[n++] = s;
        }
    }
    return n;
}

/* One coarse element for each fine one: a permutation, if it has few enough dimensions.  Pairs are faster apart. */
static bool permuted(const struct grid *g, bool up)
{
    struct side side[8];
    if (g->G != 1 || g->front || g->fs == 2 || !dar_tensor_count(g->fine)) return false;
    dar_tensor fine = *g->fine, coarse = *g->coarse;
    int n = sides_of(g, side);
    if (n > DAR_MAX_DIMS) return false;
    fine.shape.n = n;
    for (int i = 0; i < n; i++) {
        fine.shape.d[i] = side[i].n;
        fine.stride[i] = side[i].fine;
        coarse.stride[i] = side[i].coarse;
    }
    coarse.shape = fine.shape;
    (g->add ? dar_tensor_add : dar_tensor_copy)(up ? &fine : &coarse, up ? &coarse : &fine);
    return true;
}

/* ---------------------------------------------------------------- both ways */

#define CHUNK 32768 /* elements per task */

static void gather(struct grid *g)
{
    if (permuted(g, false)) return;
    size_t n = dar_tensor_rows(g->coarse) / g->beside, chunk = CHUNK / (g->Wc * g->G * g->beside + 1);
    if (g->G > 1) g->work = dar_compute_type(g->fine->dtype);
    dar_parallel_range(n, chunk ? chunk : 1, gather_rows, g);
}

static void spread(struct grid *g)
{
    if (permuted(g, true)) return;
    size_t n = dar_tensor_rows(g->fine), chunk = CHUNK / (g->Wf + 1);
    dar_parallel_range(n, chunk ? chunk : 1, spread_rows, g);
}

/* ---------------------------------------------------------------- down */

static void check_common(const char *name, const dar_shape *x, const struct attr *a)
{
    char text[96];
    dar_shape_text(x, text, sizeof text);
    DAR_ASSERT(x->n == 4 || x->n == 5, "%s: x is %s, expected [B, C, H, W] or [B, C, T, H, W]", name, text);
    DAR_ASSERT(a->ft >= 1 && a->fs >= 1 && a->fs <= DAR_PIECE && a->channels >= 0, "%s: factors %d, %d, %lld channels",
               name, a->ft, a->fs, (long long)a->channels);
    DAR_ASSERT(x->d[1] > 0, "%s: x is %s, without channels", name, text);
    DAR_ASSERT(x->n == 5 || a->ft == 1, "%s: x is %s and has no frames", name, text);
}

static dar_shape down_shape(const dar_shape *in, int n_in, const void *attr)
{
    const struct attr *a = attr;
    dar_shape y = in[0];
    char text[96];
    (void)n_in;
    check_common("resample_down", in, a);
    dar_shape_text(in, text, sizeof text);
    int64_t *H = &y.d[y.n - 2], *W = &y.d[y.n - 1], all = y.d[1] * a->ft * a->fs * a->fs;
    DAR_ASSERT(*H % a->fs == 0 && *W % a->fs == 0, "resample_down: %s does not divide by %d", text, a->fs);
    y.d[1] = a->channels ? a->channels : all;
    DAR_ASSERT(all % y.d[1] == 0, "resample_down: %s by %d x %d x %d makes no %lld equal groups", text, a->ft, a->fs,
               a->fs, (long long)y.d[1]);
    if (y.n == 5) y.d[2] = (y.d[2] + a->ft - 1) / a->ft;
    *H /= a->fs;
    *W /= a->fs;
    return y;
}

static double down_terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    const struct attr *a = attr;
    (void)n_in;
    return of < 0 && a->channels ? (double)(in[0].d[1] * a->ft * a->fs * a->fs / a->channels) : 1;
}

static void down_forward(const dar_opctx *c)
{
    struct grid g = grid_of(c->attr, &c->x[0], &c->y, true, false);
    gather(&g);
}

static void down_backward(const dar_opctx *c)
{
    if (!c->gx[0].data) return; /* frozen */
    struct grid g = grid_of(c->attr, &c->gx[0], &c->gy, true, c->add[0]);
    spread(&g);
}

static const struct attr unshuffle_2 = { 0, 1, 2, 0, DAR_PIXELS_ROWS }, unshuffle_3 = { 0, 1, 3, 0, DAR_PIXELS_ROWS };
static const struct attr patchify = { 0, 1, 2, 0, DAR_PIXELS_COLUMNS };
static const struct attr frames_2 = { 0, 2, 1, 0, DAR_FRAMES_FIRST }, frames_1 = { 0, 1, 1, 0, DAR_FRAMES_FIRST };
static const struct attr down_space = { 3, 1, 2, 0, DAR_PIXELS_ROWS }, down_both = { 6, 2, 2, 0, DAR_PIXELS_ROWS };
static const struct attr down_one = { 3, 1, 1, 0, DAR_PIXELS_ROWS }, down_three = { 2, 3, 1, 0, DAR_PIXELS_ROWS };
static const struct attr all_apart = { 36, 2, 3, 0, DAR_PIXELS_ROWS }, all_together = { 2, 2, 3, 0, DAR_PIXELS_ROWS };

static const dar_sample down_samples[] = {
    { .in = { { 4, { 1, 1, 2, 2 } } }, .attr = &unshuffle_2 },     /* one coarse pixel */
    { .in = { { 4, { 2, 3, 4, 10 } } }, .attr = &unshuffle_2 },    /* torch's order */
    { .in = { { 5, { 2, 2, 3, 6, 15 } } }, .attr = &unshuffle_3 }, /* per frame, odd factor */
    { .in = { { 4, { 2, 3, 4, 10 } } }, .attr = &patchify },       /* columns first */
    { .in = { { 5, { 1, 3, 2, 4, 6 } } }, .attr = &patchify },     /* per frame */
    { .in = { { 5, { 2, 3, 4, 2, 5 } } }, .attr = &frames_2 },     /* frames to channels */
    { .in = { { 5, { 1, 3, 3, 2, 5 } } }, .attr = &frames_2 },     /* half a group in front */
    { .in = { { 5, { 1, 2, 3, 2, 5 } } }, .attr = &frames_1 },     /* nothing to do */
    { .in = { { 5, { 1, 3, 2, 4, 6 } } }, .attr = &down_space },   /* plain 2 x 2 mean */
    { .in = { { 5, { 2, 3, 1, 4, 6 } } }, .attr = &down_both },    /* lone first frame */
    { .in = { { 5, { 1, 3, 4, 4, 6 } } }, .attr = &down_both },    /* whole groups */
    { .in = { { 5, { 1, 3, 5, 4, 6 } } }, .attr = &down_both },    /* both */
    { .in = { { 4, { 2, 3, 2, 5 } } }, .attr = &down_one },        /* identity */
    { .in = { { 5, { 2, 2, 4, 6, 9 } } }, .attr = &all_apart },    /* a permutation of seven dimensions */
    { .in = { { 5, { 1, 2, 3, 6, 9 } } }, .attr = &all_apart },    /* half a group in front */
    { .in = { { 5, { 1, 4, 4, 2, 3 } } }, .attr = &down_three },   /* groups cross channels, two zero frames */
};

static const dar_error_sample down_errors[] = {
    { .in = { { 3, { 2, 4, 6 } } }, .attr = &unshuffle_2 },
    { .in = { { 4, { 1, 2, 4, 5 } } }, .attr = &unshuffle_2 },
    { .in = { { 4, { 1, 2, 4, 4 } } }, .attr = &down_both },  /* no frames */
    { .in = { { 4, { 1, 2, 4, 4 } } }, .attr = &down_space }, /* 8 into 3 groups */
};

const dar_op dar_op_resample_down = {
    .name = "resample_down",
    .n_in = 1,
    .attr_size = sizeof(struct attr),
    .shape = down_shape,
    .terms = down_terms,
    .forward = down_forward,
    .backward = down_backward,
    .samples = down_samples,
    .n_samples = DAR_COUNT(down_samples),
    .errors = down_errors,
    .n_errors = DAR_COUNT(down_errors),
};

/* ---------------------------------------------------------------- up */

static dar_shape up_shape(const dar_shape *in, int n_in, const void *attr)
{
    const struct attr *a = attr;
    dar_shape y = in[0];
    char text[96];
    (void)n_in;
    check_common("resample_up", in, a);
    dar_shape_text(in, text, sizeof text);
    int64_t block = (int64_t)a->ft * a->fs * a->fs;
    if (!a->channels)
        DAR_ASSERT(y.d[1] % block == 0, "resample_up: %s: channels do not divide by %lld", text, (long long)block);
    int64_t channels = a->channels ? a->channels : y.d[1] / block;
    DAR_ASSERT(channels * block % y.d[1] == 0, "resample_up: %s to %lld channels by %d x %d x %d", text,
               (long long)channels, a->ft, a->fs, a->fs);
    y.d[1] = channels;
    DAR_ASSERT(a->front >= 0 && a->front < a->ft, "resample_up: drops %d of each %d frames", a->front, a->ft);
    if (y.n == 5) y.d[2] = y.d[2] ? y.d[2] * a->ft - a->front : 0;
    y.d[y.n - 2] *= a->fs;
    y.d[y.n - 1] *= a->fs;
    return y;
}

static double up_terms(const dar_shape *in, int n_in, const void *attr, int of)
{
    const struct attr *a = attr;
    (void)n_in;
    return of == 0 && a->channels ? (double)(a->channels * a->ft * a->fs * a->fs / in[0].d[1]) : 1;
}

static void up_forward(const dar_opctx *c)
{
    struct grid g = grid_of(c->attr, &c->y, &c->x[0], false, false);
    spread(&g);
}

static void up_backward(const dar_opctx *c)
{
    if (!c->gx[0].data) return; /* frozen */
    struct grid g = grid_of(c->attr, &c->gy, &c->gx[0], false, c->add[0]);
    gather(&g);
}

static const struct attr nearest_2 = { 3, 1, 2, 0, DAR_PIXELS_ROWS }, nearest_3 = { 2, 1, 3, 0, DAR_PIXELS_ROWS };
static const struct attr up_both = { 2, 2, 2, 0, DAR_PIXELS_ROWS }, up_first = { 2, 2, 2, 1, DAR_PIXELS_ROWS };
static const struct attr up_halve = { 2, 1, 2, 0, DAR_PIXELS_ROWS };

static const dar_sample up_samples[] = {
    { .in = { { 4, { 1, 4, 1, 1 } } }, .attr = &unshuffle_2 },      /* one coarse pixel */
    { .in = { { 4, { 2, 12, 2, 5 } } }, .attr = &unshuffle_2 },     /* torch's order */
    { .in = { { 5, { 1, 18, 2, 2, 3 } } }, .attr = &unshuffle_3 },  /* per frame, odd factor */
    { .in = { { 4, { 2, 12, 2, 5 } } }, .attr = &patchify },        /* columns first */
    { .in = { { 5, { 1, 4, 3, 2, 3 } } }, .attr = &patchify },      /* per frame */
    { .in = { { 5, { 2, 6, 2, 2, 5 } } }, .attr = &frames_2 },      /* channels to frames */
    { .in = { { 4, { 2, 3, 2, 5 } } }, .attr = &nearest_2 },        /* nearest */
    { .in = { { 5, { 1, 2, 2, 3, 5 } } }, .attr = &nearest_3 },     /* per frame, odd factor */
    { .in = { { 5, { 2, 2, 3, 2, 3 } } }, .attr = &up_both },       /* duplicate in time and space */
    { .in = { { 5, { 1, 2, 3, 2, 3 } } }, .attr = &up_first },      /* first frame lost */
    { .in = { { 5, { 1, 4, 1, 2, 3 } } }, .attr = &up_first },      /* lone first frame */
    { .in = { { 5, { 2, 36, 2, 2, 3 } } }, .attr = &all_together }, /* a permutation of seven dimensions */
    { .in = { { 5, { 1, 4, 2, 2, 3 } } }, .attr = &up_halve },      /* row parity picks the channel */
};

static const struct attr up_bad_front = { 2, 2, 1, 2, DAR_PIXELS_ROWS };
static const dar_error_sample up_errors[] = {
    { .in = { { 3, { 4, 4, 6 } } }, .attr = &unshuffle_2 },
    { .in = { { 4, { 1, 6, 4, 5 } } }, .attr = &unshuffle_2 },
    { .in = { { 4, { 1, 2, 4, 4 } } }, .attr = &up_both },    /* no frames */
    { .in = { { 5, { 1, 3, 1, 4, 4 } } }, .attr = &up_both }, /* 16 copies of 3 channels */
    { .in = { { 5, { 1, 2, 1, 4, 4 } } }, .attr = &up_bad_front },
};

const dar_op dar_op_resample_up = {
    .name = "resample_up",
    .n_in = 1,
    .attr_size = sizeof(struct attr),
    .shape = up_shape,
    .terms = up_terms,
    .forward = up_forward,
    .backward = up_backward,
    .samples = up_samples,
    .n_samples = DAR_COUNT(up_samples),
    .errors = up_errors,
    .n_errors = DAR_COUNT(up_errors),
};

/* ---------------------------------------------------------------- by name */

dar_val *dar_pixel_unshuffle(dar_tape *t, dar_val *x, int r, dar_pixel_order order)
{
    struct attr a = { .ft = 1, .fs = r, .order = order };
    return dar_apply(t, &dar_op_resample_down, &x, 1, &a);
}

dar_val *dar_pixel_shuffle(dar_tape *t, dar_val *x, int r, dar_pixel_order order)
{
    struct attr a = { .ft = 1, .fs = r, .order = order };
    return dar_apply(t, &dar_op_resample_up, &x, 1, &a);
}

dar_val *dar_frame_unshuffle(dar_tape *t, dar_val *x, int r)
{
    struct attr a = { .ft = r, .fs = 1, .order = DAR_FRAMES_FIRST };
    DAR_ASSERT(x->x.shape.n == 5 && r > 0 && x->x.shape.d[2] % r == 0, "frame_unshuffle: frames do not divide by %d",
               r);
    return dar_apply(t, &dar_op_resample_down, &x, 1, &a);
}

dar_val *dar_frame_shuffle(dar_tape *t, dar_val *x, int r)
{
    struct attr a = { .ft = r, .fs = 1, .order = DAR_FRAMES_FIRST };
    return dar_apply(t, &dar_op_resample_up, &x, 1, &a);
}

dar_val *dar_avg_down(dar_tape *t, dar_val *x, int64_t channels, int ft, int fs)
{
    struct attr a = { .channels = channels, .ft = ft, .fs = fs };
    return dar_apply(t, &dar_op_resample_down, &x, 1, &a);
}

dar_val *dar_dup_up(dar_tape *t, dar_val *x, int64_t channels, int ft, int fs, int drop)
{
    struct attr a = { .channels = channels, .ft = ft, .fs = fs, .front = drop };
    return dar_apply(t, &dar_op_resample_up, &x, 1, &a);
}

dar_val *dar_upsample_nearest(dar_tape *t, dar_val *x, int r)
{
    DAR_ASSERT(x->x.shape.n >= 2, "upsample_nearest: x has %d dimensions", x->x.shape.n);
    return dar_dup_up(t, x, x->x.shape.d[1], 1, r, 0);
}
