/* lpips.c: see lpips.h.  Both pictures go through the trunk as one batch; a stage, from one map to the next, is a
 * segment, so that only maps are kept. */
#include "models/lpips.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "autograd/ops.h"
#include "lib/size.h"
#include "lib/thread.h"

#define STAGES 5
#define LAYERS 13
#define EPS    1e-10
#define BLOCK  256 /* places whose sums stay in the nearest cache */

const char *const dar_lpips_name[] = { "alex", "vgg", NULL };

/* ---------------------------------------------------------------- layers */

typedef struct layer {
    int index, stage; /* in torchvision's list of layers; whose map it serves */
    int kernel, stride, pad;
} layer;

/* A stage but the first begins with a pool of pool x pool, stride 2. */
typedef struct trunk {
    int pool, layers;
    layer layer[LAYERS];
} trunk;

static const trunk trunks[DAR_LPIPS_NETS] = {
    { 3, 5, { { 0, 0, 11, 4, 2 }, { 3, 1, 5, 1, 2 }, { 6, 2, 3, 1, 1 }, { 8, 3, 3, 1, 1 }, { 10, 4, 3, 1, 1 } } },
    { 2,
      13,
      { { 0, 0, 3, 1, 1 },
        { 2, 0, 3, 1, 1 },
        { 5, 1, 3, 1, 1 },
        { 7, 1, 3, 1, 1 },
        { 10, 2, 3, 1, 1 },
        { 12, 2, 3, 1, 1 },
        { 14, 2, 3, 1, 1 },
        { 17, 3, 3, 1, 1 },
        { 19, 3, 3, 1, 1 },
        { 21, 3, 3, 1, 1 },
        { 24, 4, 3, 1, 1 },
        { 26, 4, 3, 1, 1 },
        { 28, 4, 3, 1, 1 } } },
};

/* AlexNet pools before its second and third map only. */
static bool pools(dar_lpips_net net, int stage)
{
    return stage > 0 && (net == DAR_LPIPS_VGG || stage < 3);
}

struct dar_lpips {
    dar_lpips_net net;
    size_t width, height;
    dar_tensor w[LAYERS], b[LAYERS];
    dar_tensor mix[STAGES]; /* w_k [C], f32 */
    float pixel[3][256];    /* a byte as the trunk sees it */
    dar_arena mixes, step;
    dar_tape tape;

    /* Of the pair at hand. */
    const uint8_t *picture[2], *mask;
};

/* ---------------------------------------------------------------- weights */

static const char *layer_name(const layer *y, const char *part, int form, char name[64])
{
    if (form == 0) snprintf(name, 64, "features.%d.%s", y->index, part);
    else snprintf(name, 64, "net.slice%d.%d.%s", y->stage + 1, y->index, part);
    return name;
}

/* The file that holds the trunk, and which names it has; n: there is none. */
static size_t trunk_file(dar_lpips_net net, dar_weights *const *files, size_t n, int *form)
{
    const layer *first = &trunks[net].layer[0];
    char name[64];
    for (size_t i = 0; i < n; i++)
        for (*form = 0; *form < 2; ++*form) {
            const dar_weight *w = dar_weights_find(files[i], layer_name(first, "weight", *form, name));
            if (w && w->dims == 4 && w->dim[2] == first->kernel) return i;
        }
    return n;
}

bool dar_lpips_there(dar_lpips_net net, dar_weights *const *files, size_t n)
{
    int form;
    return trunk_file(net, files, n, &form) < n;
}

static dar_status tensor_of(dar_weights *w, const char *name, dar_shape s, dar_tensor *x, dar_err *e)
{
    char found[64], expected[64];
    DAR_TRY(dar_weights_tensor(w, name, x, e));
    if (s.d[0] == 0) s.d[0] = x->shape.n ? x->shape.d[0] : 0; /* any */
    if (dar_shape_equal(&x->shape, &s)) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: found shape %s, expected %s", name,
                    dar_shape_text(&x->shape, found, sizeof found), dar_shape_text(&s, expected, sizeof expected));
}

static dar_status load_trunk(dar_lpips *l, dar_weights *w, int form, int64_t width[STAGES], dar_err *e)
{
    const trunk *k = &trunks[l->net];
    int64_t in = 3;
    char name[64];
    for (int i = 0; i < k->layers; i++) {
        const layer *y = &k->layer[i];
        dar_shape s = DAR_SHAPE(0, in, y->kernel, y->kernel);
        DAR_TRY(tensor_of(w, layer_name(y, "weight", form, name), s, &l->w[i], e));
        width[y->stage] = in = l->w[i].shape.d[0];
        DAR_TRY(tensor_of(w, layer_name(y, "bias", form, name), DAR_SHAPE(in), &l->b[i], e));
    }
    return DAR_OK;
}

/* Whether the file has all w_k, of these widths. */
static bool mixes_fit(const dar_weights *w, const int64_t width[STAGES])
{
    char name[64];
    for (int k = 0; k < STAGES; k++) {
        snprintf(name, sizeof name, "lin%d.model.1.weight", k);
        const dar_weight *x = dar_weights_find(w, name);
        if (!x || x->dims != 4 || x->dim[0] != 1 || x->dim[1] != width[k] || x->dim[2] != 1 || x->dim[3] != 1)
            return false;
    }
    return true;
}

static dar_status load_mixes(dar_lpips *l, dar_weights *const *files, size_t n, const int64_t width[STAGES], dar_err *e)
{
    char name[64];
    size_t file = 0, bytes = 0;
    while (file < n && !mixes_fit(files[file], width)) file++;
    if (file == n)
        return dar_fail(e, DAR_ERR_FORMAT,
                        "LPIPS: no file has lin0.model.1.weight to lin4.model.1.weight of the widths of its %s trunk",
                        dar_lpips_name[l->net]);
    for (int k = 0; k < STAGES; k++) bytes += dar_round_up((size_t)width[k] * sizeof(float), DAR_ALIGN);
    DAR_TRY(dar_arena_init(&l->mixes, "LPIPS weights", bytes, e));
    for (int k = 0; k < STAGES; k++) {
        dar_tensor x, flat;
        snprintf(name, sizeof name, "lin%d.model.1.weight", k);
        DAR_TRY(dar_weights_tensor(files[file], name, &x, e));
        flat = dar_tensor_reshape(&x, DAR_SHAPE(width[k]));
        l->mix[k] = dar_tensor_push(&l->mixes, DAR_F32, DAR_SHAPE(width[k]));
        dar_tensor_copy(&l->mix[k], &flat);
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- the trunk */

struct pooling {
    const float *x;
    float *y;
    size_t side, H, W, h, w;
};

static void pool_planes(void *ctx, size_t begin, size_t end, int thread)
{
    const struct pooling *p = ctx;
    (void)thread;
    for (size_t plane = begin; plane < end; plane++)
        for (size_t i = 0; i < p->h; i++)
            for (size_t j = 0; j < p->w; j++) {
                const float *x = p->x + (plane * p->H + 2 * i) * p->W + 2 * j;
                float most = *x;
                for (size_t k = 0; k < p->side * p->side; k++) {
                    float v = x[k / p->side * p->W + k % p->side];
                    most = v > most ? v : most;
                }
                p->y[(plane * p->h + i) * p->w + j] = most;
            }
}

/* Largest of side x side, stride 2; windows lie inside.  [B, C, H, W] -> [B, C, h, w] */
static dar_val *pool(dar_tape *t, const dar_val *x, int side)
{
    const int64_t *d = x->x.shape.d;
    dar_val *y = dar_input(t, DAR_F32, DAR_SHAPE(d[0], d[1], (d[2] - side) / 2 + 1, (d[3] - side) / 2 + 1));
    struct pooling p = {
        x->x.data, y->x.data, (size_t)side, (size_t)d[2], (size_t)d[3], (size_t)y->x.shape.d[2], (size_t)y->x.shape.d[3]
    };
    if (!t->arena->plan) dar_parallel_range((size_t)(d[0] * d[1]), 4, pool_planes, &p);
    return y;
}

struct stage {
    const dar_lpips *l;
    int number;
};

static dar_val *run_stage(dar_tape *t, void *arg, dar_val *const *in)
{
    const struct stage *s = arg;
    const trunk *k = &trunks[s->l->net];
    dar_val *x = in[0];
    if (pools(s->l->net, s->number)) x = pool(t, x, k->pool);
    for (int i = 0; i < k->layers; i++) {
        const layer *y = &k->layer[i];
        dar_conv_attr a = { .stride = y->stride, .top = y->pad, .bottom = y->pad, .left = y->pad, .right = y->pad };
        if (y->stage != s->number) continue;
        x = dar_conv2d(t, x, dar_leaf(t, s->l->w[i], NULL), dar_leaf(t, s->l->b[i], NULL), a);
        x = dar_relu(t, x);
    }
    return x;
}

/* Shape of a stage's map; false: nothing is left of the picture. */
static bool shape_after(const dar_lpips *l, int stage, dar_shape *s)
{
    const trunk *k = &trunks[l->net];
    for (int d = 2; pools(l->net, stage) && d < 4; d++) {
        if (s->d[d] < k->pool) return false;
        s->d[d] = (s->d[d] - k->pool) / 2 + 1;
    }
    for (int i = 0; i < k->layers; i++) {
        const layer *y = &k->layer[i];
        if (y->stage != stage) continue;
        s->d[1] = l->w[i].shape.d[0];
        for (int d = 2; d < 4; d++) {
            if (s->d[d] + 2 * y->pad < y->kernel) return false;
            s->d[d] = (s->d[d] + 2 * y->pad - y->kernel) / y->stride + 1;
        }
    }
    return true;
}

/* ---------------------------------------------------------------- distance */

struct comparison {
    const float *f, *g, *w; /* [C, places], [C] */
    size_t channels, places;
    double *d; /* [places] */
};

static void compare(void *ctx, size_t begin, size_t end, int thread)
{
    const struct comparison *p = ctx;
    double nf[BLOCK] = { 0 }, ng[BLOCK] = { 0 };
    size_t n = end - begin;
    (void)thread;
    for (size_t c = 0; c < p->channels; c++) {
        const float *f = p->f + c * p->places + begin, *g = p->g + c * p->places + begin;
        for (size_t i = 0; i < n; i++) {
            nf[i] += (double)f[i] * f[i];
            ng[i] += (double)g[i] * g[i];
        }
    }
    for (size_t i = 0; i < n; i++) {
        nf[i] = 1 / (sqrt(nf[i]) + EPS);
        ng[i] = 1 / (sqrt(ng[i]) + EPS);
        p->d[begin + i] = 0;
    }
    for (size_t c = 0; c < p->channels; c++) {
        const float *f = p->f + c * p->places + begin, *g = p->g + c * p->places + begin;
        for (size_t i = 0; i < n; i++) {
            double v = f[i] * nf[i] - g[i] * ng[i];
            p->d[begin + i] += p->w[c] * (v * v);
        }
    }
}

/* Share of a place's pixels that the mask has.  Every place has a pixel: no map is finer than the picture. */
static double share(const dar_lpips *l, size_t h, size_t w, size_t place)
{
    size_t i = place / w, j = place % w, in = 0, all = 0;
    for (size_t y = i * l->height / h; y < (i + 1) * l->height / h; y++)
        for (size_t x = j * l->width / w; x < (j + 1) * l->width / w; x++, all++)
            in += l->mask[y * l->width + x] >= 128;
    return (double)in / (double)all;
}

static void add_map(dar_lpips *l, int k, const dar_tensor *maps, double distance[2])
{
    const int64_t *d = maps->shape.d;
    size_t h = (size_t)d[2], w = (size_t)d[3];
    dar_tensor map = dar_tensor_push(&l->step, DAR_F64, DAR_SHAPE(d[2], d[3]));
    struct comparison p = { maps->data, NULL, l->mix[k].data, (size_t)d[1], h * w, map.data };
    double sum = 0, masked = 0, weight = 0;
    if (l->step.plan) return;
    p.g = p.f + p.channels * p.places;
    dar_parallel_range(p.places, BLOCK, compare, &p);
    for (size_t i = 0; i < p.places; i++) {
        double m = l->mask ? share(l, h, w, i) : 0;
        sum += p.d[i];
        masked += m * p.d[i];
        weight += m;
    }
    distance[0] += sum / (double)p.places;
    distance[1] += masked / weight;
}

/* [2, 3, H, W]: both pictures. */
static dar_val *input(dar_lpips *l)
{
    size_t pixels = l->width * l->height;
    dar_val *x = dar_input(&l->tape, DAR_F32, DAR_SHAPE(2, 3, (int64_t)l->height, (int64_t)l->width));
    float *to = x->x.data;
    for (size_t p = 0; p < 2 && !l->step.plan; p++)
        for (size_t c = 0; c < 3; c++, to += pixels)
            for (size_t i = 0; i < pixels; i++) to[i] = l->pixel[c][l->picture[p][3 * i + c]];
    return x;
}

static void run(dar_lpips *l, double distance[2])
{
    dar_mark mark = dar_arena_mark(&l->step);
    dar_tape_clear(&l->tape);
    distance[0] = distance[1] = 0;
    dar_val *x = input(l);
    for (int k = 0; k < STAGES; k++) {
        dar_shape s = x->x.shape;
        bool fits = shape_after(l, k, &s);
        DAR_ASSERT(fits, "lpips: the picture is too small");
        x = dar_segment(&l->tape, run_stage, &(struct stage){ l, k }, &x, 1, DAR_F32, s);
        add_map(l, k, &x->x, distance);
    }
    dar_arena_reset(&l->step, mark);
}

void dar_lpips_distance(dar_lpips *l, const uint8_t *a, const uint8_t *b, const uint8_t *mask, double distance[2])
{
    l->picture[0] = a;
    l->picture[1] = b;
    l->mask = mask;
    run(l, distance);
}

/* ---------------------------------------------------------------- opening */

/* ImageNet's mean and deviation for pixels in [-1, 1]. */
static void set_pixels(dar_lpips *l)
{
    static const double shift[3] = { -0.030, -0.088, -0.188 }, scale[3] = { 0.458, 0.448, 0.450 };
    for (int c = 0; c < 3; c++)
        for (int v = 0; v < 256; v++) l->pixel[c][v] = (float)((v / 127.5 - 1 - shift[c]) / scale[c]);
}

static dar_status reserve(dar_lpips *l, dar_err *e)
{
    double none[2];
    dar_shape s = DAR_SHAPE(2, 3, (int64_t)l->height, (int64_t)l->width);
    for (int k = 0; k < STAGES; k++)
        if (!shape_after(l, k, &s))
            return dar_fail(e, DAR_ERR_FORMAT, "LPIPS: pictures of %zu x %zu are too small for %s", l->width, l->height,
                            dar_lpips_name[l->net]);
    DAR_TRY(dar_arena_init_plan(&l->step, "LPIPS", e));
    DAR_TRY(dar_tape_init(&l->tape, &l->step, e));
    l->tape.recording = false;
    run(l, none);
    size_t peak = l->step.peak;
    dar_arena_free(&l->step);
    return dar_arena_init(&l->step, "LPIPS", peak, e);
}

dar_status dar_lpips_open(dar_lpips **out, dar_lpips_net net, dar_weights *const *files, size_t n, size_t width,
                          size_t height, dar_err *e)
{
    int64_t channels[STAGES];
    int form;
    size_t file = trunk_file(net, files, n, &form);
    dar_lpips *l = *out = NULL;
    if (file == n)
        return dar_fail(e, DAR_ERR_FORMAT, "LPIPS: no file has a trunk of %s (features.0.weight)", dar_lpips_name[net]);
    if (!(l = calloc(1, sizeof *l))) return dar_fail(e, DAR_ERR_NOMEM, "LPIPS: out of memory");
    *l = (dar_lpips){ .net = net, .width = width, .height = height };
    set_pixels(l);
    dar_status s = load_trunk(l, files[file], form, channels, e);
    if (s == DAR_OK) s = load_mixes(l, files, n, channels, e);
    if (s == DAR_OK) s = reserve(l, e);
    if (s != DAR_OK) {
        dar_lpips_close(l);
        l = NULL;
    }
    *out = l;
    return s;
}

void dar_lpips_close(dar_lpips *l)
{
    if (!l) return;
    dar_tape_free(&l->tape);
    dar_arena_free(&l->step);
    dar_arena_free(&l->mixes);
    free(l);
}
