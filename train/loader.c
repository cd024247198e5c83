/* loader.c: see loader.h. */
#include "train/loader.h"

#include <math.h>
#include <pthread.h>
#include <stdlib.h>
#include <string.h>

#include "data/bundle.h"
#include "lib/log.h"
#include "lib/rng.h"
#include "lib/thread.h"
#include "models/encode.h"
#include "models/load.h"
#include "models/model.h"

#define NO_STEP  INT64_MIN
#define NO_EPOCH UINT64_MAX

/* Bounds of the log-variance, as in diffusers. */
#define LEAST_LOG_VARIANCE (-30)
#define MOST_LOG_VARIANCE  20

/* A batch and whose it is. */
struct slot {
    int64_t step; /* NO_STEP: nobody's */
    bool ready;
    dar_batch b;
    float *words; /* memory of b.text */
    int64_t *count;
    const char **path;
    size_t *clip;
    dar_status status;
    dar_err err;
};

struct dar_loader {
    dar_loader_config c;
    size_t frames; /* of every clip */
    int height, width;
    bool text; /* a clip has one */
    dar_arena arena, scratch;
    struct slot *slot; /* [ahead + 1]: step k lies in slot k mod (ahead + 1) */
    double waited;

    /* Of who fills slots: the thread, or if there is none the caller. */
    size_t *order; /* [clips] of `epoch` */
    uint64_t epoch;
    dar_tensor moments, known; /* of one clip */
    uint8_t *rgb;              /* of one frame */
    bool *seen;                /* [frames of the video] */
    dar_weights **words;       /* [batch] */

    /* Between the two. */
    pthread_mutex_t lock;
    pthread_cond_t changed;
    dar_thread *thread; /* NULL: none */
    int64_t base;       /* steps base .. base + ahead are wanted; NO_STEP: none yet */
    bool ends;
};

/* ---------------------------------------------------------------- order */

/* Fisher and Yates: every permutation is as likely as any other. */
void dar_loader_order(uint64_t seed, uint64_t epoch, size_t clips, size_t *order)
{
    const uint64_t stream = dar_rng_stream("order") + epoch;
    for (size_t i = 0; i < clips; i++) {
        size_t j = dar_rng_below(seed, stream, i, i + 1);
        if (j < i) order[i] = order[j];
        order[j] = i;
    }
}

static size_t clip_at(dar_loader *l, uint64_t place)
{
    uint64_t epoch = place / l->c.clips;
    if (!l->c.shuffle) return place % l->c.clips;
    if (epoch != l->epoch) dar_loader_order(l->c.seed, epoch, l->c.clips, l->order);
    l->epoch = epoch;
    return l->order[place % l->c.clips];
}

/* ---------------------------------------------------------------- one clip of a batch */

/* Clip b of a batch. */
static dar_tensor part(const dar_tensor *x, int64_t b)
{
    dar_tensor y = dar_tensor_narrow(x, 0, b, 1);
    dar_shape s = { .n = x->shape.n - 1 };
    memcpy(s.d, x->shape.d + 1, (size_t)s.n * sizeof *s.d);
    return dar_tensor_reshape(&y, s);
}

/* mean + exp(log-variance / 2) eps; eps is drawn where z is. */
static void draw_posterior(const dar_loader *l, uint64_t place, const dar_tensor *z)
{
    size_t n = dar_tensor_count(z);
    const float *mean = l->moments.data, *log_variance = mean + n;
    float *y = z->data;
    dar_rng_fill_normal(z, l->c.seed, dar_rng_stream("posterior") + place, 1);
    for (size_t i = 0; i < n; i++)
        y[i] = mean[i] + expf(fminf(fmaxf(log_variance[i], LEAST_LOG_VARIANCE), MOST_LOG_VARIANCE) / 2) * y[i];
}

static dar_status read_latents(dar_loader *l, const dar_bundle *bundle, struct slot *s, int64_t b, uint64_t place,
                               dar_err *e)
{
    const bool masked = s->b.known.data != NULL;
    dar_tensor z = part(&s->b.z0, b), mean = dar_tensor_narrow(&l->moments, 0, 0, z.shape.d[0]);
    DAR_TRY(dar_cache_read(l->c.cache, bundle, &l->moments, masked ? &l->known : NULL, e));
    if (l->c.posterior) draw_posterior(l, place, &z);
    else dar_tensor_copy(&z, &mean);
    dar_cache_normalise(l->c.cache, &z);
    if (!masked) return DAR_OK;
    const int64_t *d = l->known.shape.d;
    dar_tensor known = dar_tensor_narrow(&s->b.known, 0, b, 1);
    dar_tensor latent = dar_tensor_reshape(&l->known, DAR_SHAPE(1, d[0], d[1], d[2], d[3]));
    dar_cache_normalise(l->c.cache, &l->known);
    dar_dit_known(&known, &latent, l->seen);
    return DAR_OK;
}

static dar_status read_condition(dar_loader *l, dar_bundle *bundle, struct slot *s, int64_t b, dar_err *e)
{
    dar_tensor y = part(&s->b.cond, b);
    dar_condition_source source;
    DAR_TRY(dar_bundle_source(bundle, l->c.condition, &source, e));
    return dar_condition_build(l->c.condition, &source, &l->scratch, &y, e);
}

/* rgb [H, W, 3] cut to frame f of y [3, F, height, width]. */
static void cut(const dar_loader *l, const size_t at[2], int64_t f, const dar_tensor *y)
{
    const int64_t *d = y->shape.d;
    const size_t F = (size_t)d[1], H = (size_t)d[2], W = (size_t)d[3];
    float *to = y->data;
    for (size_t k = 0; k < 3; k++)
        for (size_t i = 0; i < H; i++) {
            const uint8_t *from = l->rgb + 3 * ((at[0] + i) * (size_t)l->width + at[1]) + k;
            float *row = to + ((k * F + (size_t)f) * H + i) * W;
            for (size_t j = 0; j < W; j++) row[j] = (float)(from[3 * j] / 127.5 - 1);
        }
}

static dar_status read_pixels(dar_loader *l, dar_bundle *bundle, struct slot *s, int64_t b, uint64_t place, dar_err *e)
{
    dar_tensor y = part(&s->b.pixels, b);
    const int64_t *d = y.shape.d;
    const size_t room[3] = { l->frames - (size_t)d[1], (size_t)(l->height - d[2]), (size_t)(l->width - d[3]) };
    size_t at[3];
    for (size_t k = 0; k < 3; k++) at[k] = dar_rng_below(l->c.seed, dar_rng_stream("cut"), 3 * place + k, room[k] + 1);
    for (int64_t f = 0; f < d[1]; f++) {
        DAR_TRY(dar_bundle_rgb(bundle, at[0] + (size_t)f, l->rgb, e));
        cut(l, at + 1, f, &y);
    }
    return DAR_OK;
}

static dar_status read_clip(dar_loader *l, struct slot *s, int64_t b, uint64_t place, dar_err *e)
{
    dar_bundle *bundle;
    DAR_TRY(dar_bundle_open(&bundle, l->c.path[s->clip[b]], e));
    dar_status status = DAR_OK;
    if (s->b.z0.data) status = read_latents(l, bundle, s, b, place, e);
    if (status == DAR_OK && s->b.cond.data) status = read_condition(l, bundle, s, b, e);
    if (status == DAR_OK && s->b.pixels.data) status = read_pixels(l, bundle, s, b, place, e);
    if (status == DAR_OK && bundle->text && s->words) {
        char path[PATH_MAX];
        status = dar_weights_open(&l->words[b], dar_bundle_path(bundle, "text.safetensors", path), e);
    }
    dar_bundle_close(bundle);
    return status;
}

/* The clips' texts, as long as the longest. */
static dar_status join_texts(dar_loader *l, struct slot *s, dar_err *e)
{
    const int64_t B = l->c.batch, width = l->c.dit->text_width;
    int64_t most = 0;
    for (int64_t b = 0; b < B; b++) {
        dar_tensor x = { 0 };
        if (l->words[b]) DAR_TRY(dar_load_text(l->c.dit, l->words[b], s->path[b], "text", &x, e));
        s->count[b] = x.data ? x.shape.d[1] : 0;
        if (s->count[b] > most) most = s->count[b];
    }
    s->b.text = dar_tensor_of(DAR_F32, DAR_SHAPE(B, most, width), s->words);
    if (most) dar_tensor_fill(&s->b.text, 0);
    for (int64_t b = 0; b < B; b++) {
        dar_tensor x;
        if (!s->count[b]) continue;
        DAR_TRY(dar_load_text(l->c.dit, l->words[b], s->path[b], "text", &x, e));
        dar_tensor to = dar_tensor_narrow(&s->b.text, 0, b, 1);
        to = dar_tensor_narrow(&to, 1, 0, s->count[b]);
        dar_tensor_copy(&to, &x);
    }
    return DAR_OK;
}

static void read_batch(dar_loader *l, struct slot *s)
{
    const int64_t B = l->c.batch;
    s->status = DAR_OK;
    for (int64_t b = 0; b < B && s->status == DAR_OK; b++) {
        uint64_t place = (uint64_t)s->step * (uint64_t)B + (uint64_t)b;
        s->clip[b] = clip_at(l, place);
        s->path[b] = l->c.path[s->clip[b]];
        s->status = read_clip(l, s, b, place, &s->err);
    }
    if (s->status == DAR_OK && s->words) s->status = join_texts(l, s, &s->err);
    for (int64_t b = 0; l->words && b < B; b++) {
        dar_weights_close(l->words[b]);
        l->words[b] = NULL;
    }
}

/* ---------------------------------------------------------------- the thread beside */

/* The first wanted step that no slot holds; NULL: there is none. */
static struct slot *next_slot(dar_loader *l, int64_t *step)
{
    if (l->base == NO_STEP) return NULL;
    const int64_t slots = (int64_t)l->c.ahead + 1;
    for (int64_t k = l->base; k < l->base + slots; k++)
        if (l->slot[k % slots].step != k) {
            *step = k;
            return &l->slot[k % slots];
        }
    return NULL;
}

/* Slots of steps that are wanted are never touched; so the batch that the caller holds stays. */
static void read_ahead(void *ctx)
{
    dar_loader *l = ctx;
    pthread_mutex_lock(&l->lock);
    while (!l->ends) {
        int64_t step;
        struct slot *s = next_slot(l, &step);
        if (!s) {
            pthread_cond_wait(&l->changed, &l->lock);
            continue;
        }
        s->step = step;
        s->ready = false;
        pthread_mutex_unlock(&l->lock);
        read_batch(l, s);
        pthread_mutex_lock(&l->lock);
        s->ready = true;
        pthread_cond_broadcast(&l->changed);
    }
    pthread_mutex_unlock(&l->lock);
}

static void wait_for(dar_loader *l, int64_t step, struct slot *s)
{
    pthread_mutex_lock(&l->lock);
    l->base = step;
    pthread_cond_broadcast(&l->changed);
    while (s->step != step || !s->ready) pthread_cond_wait(&l->changed, &l->lock);
    pthread_mutex_unlock(&l->lock);
}

dar_status dar_loader_get(dar_loader *l, int64_t step, const dar_batch **b, dar_err *e)
{
    DAR_ASSERT(step >= 0 && !l->c.plan, "loader: step %lld of one that %s", (long long)step,
               l->c.plan ? "only plans" : "reads");
    struct slot *s = &l->slot[step % ((int64_t)l->c.ahead + 1)];
    double begin = dar_log_clock();
    *b = NULL;
    if (l->c.ahead && !l->thread) DAR_TRY(dar_thread_start(&l->thread, read_ahead, l, e));
    if (l->thread) {
        wait_for(l, step, s);
    } else if (s->step != step) {
        s->step = step;
        read_batch(l, s);
    }
    l->waited += dar_log_clock() - begin;
    if (s->status != DAR_OK) return dar_fail(e, s->status, "%s", s->err.text);
    *b = &s->b;
    return DAR_OK;
}

/* ---------------------------------------------------------------- opening */

static dar_status check_tokens(const dar_loader *l, const dar_bundle_meta *m, const char *path, dar_err *e)
{
    const dar_shape s = dar_loader_latent(l);
    const int64_t patch = l->c.dit->patch;
    if (s.d[3] % patch || s.d[4] % patch || m->frames < 5)
        return dar_fail(e, DAR_ERR_USAGE, "%s: found %zu frames of %d x %d, expected 5, 9, ... of whole tokens", path,
                        m->frames, m->width, m->height);
    return DAR_OK;
}

static dar_status check_cut(const dar_loader *l, const dar_bundle_meta *m, const char *path, dar_err *e)
{
    if (l->c.frames <= (int64_t)m->frames && l->c.height <= m->height && l->c.width <= m->width) return DAR_OK;
    return dar_fail(e, DAR_ERR_USAGE, "%s: found %zu frames of %d x %d, expected at least %lld of %lld x %lld", path,
                    m->frames, m->width, m->height, (long long)l->c.frames, (long long)l->c.width,
                    (long long)l->c.height);
}

/* Whether a batch can hold this clip; the first one says what size they all have. */
static dar_status check_clip(dar_loader *l, dar_bundle *b, const char *path, dar_err *e)
{
    const dar_bundle_meta *m = &b->meta;
    dar_condition_source source;
    if (!l->frames) {
        l->frames = m->frames;
        l->height = m->height;
        l->width = m->width;
    }
    if (m->frames != l->frames || m->height != l->height || m->width != l->width)
        return dar_fail(e, DAR_ERR_USAGE,
                        "%s: found %zu frames of %d x %d, expected %zu of %d x %d as in %s: a run takes one size", path,
                        m->frames, m->width, m->height, l->frames, l->width, l->height, l->c.path[0]);
    if (!b->rgb && (l->c.cache || l->c.pixels))
        return dar_fail(e, DAR_ERR_FORMAT, "%s: has no pictures (rgb.h5) to learn from", path);
    if (l->c.condition) DAR_TRY(dar_bundle_source(b, l->c.condition, &source, e));
    if (l->c.cache) DAR_TRY(check_tokens(l, m, path, e));
    if (l->c.pixels) DAR_TRY(check_cut(l, m, path, e));
    l->text |= b->text;
    return DAR_OK;
}

static dar_status look(dar_loader *l, dar_err *e)
{
    if (!l->c.clips) return dar_fail(e, DAR_ERR_USAGE, "found no clip to learn from");
    for (size_t i = 0; i < l->c.clips; i++) {
        dar_bundle *b;
        DAR_TRY(dar_bundle_open(&b, l->c.path[i], e));
        dar_status s = check_clip(l, b, l->c.path[i], e);
        dar_bundle_close(b);
        DAR_TRY(s);
    }
    return DAR_OK;
}

dar_shape dar_loader_latent(const dar_loader *l)
{
    if (!l->c.cache) return (dar_shape){ 0 };
    const dar_bundle size = { .meta = { .frames = l->frames, .width = l->width, .height = l->height } };
    const dar_shape s = dar_cache_shape(l->c.cache, &size);
    return DAR_SHAPE(l->c.batch, s.d[0] / 2, s.d[1], s.d[2], s.d[3]);
}

static dar_tensor push(dar_loader *l, dar_shape s)
{
    return dar_tensor_push(&l->arena, DAR_F32, s);
}

static void make_slot(dar_loader *l, struct slot *slot)
{
    const dar_loader_config *c = &l->c;
    const int64_t B = c->batch;
    struct slot s = { .step = NO_STEP };
    s.count = dar_arena_push(&l->arena, (size_t)B * sizeof *s.count);
    s.path = dar_arena_push(&l->arena, (size_t)B * sizeof *s.path);
    s.clip = dar_arena_push(&l->arena, (size_t)B * sizeof *s.clip);
    if (c->cache) {
        dar_shape z = dar_loader_latent(l), known = z;
        known.d[1] += c->dit->mask;
        s.b.z0 = push(l, z);
        if (c->dit->mask) s.b.known = push(l, known);
    }
    if (c->cache && l->text) s.words = push(l, DAR_SHAPE(B, c->dit->text_keys, c->dit->text_width)).data;
    if (c->cache) s.b.text = dar_tensor_of(DAR_F32, DAR_SHAPE(B, 0, c->dit->text_width), s.words);
    if (c->condition) {
        const int64_t channels = DAR_RAYS_CHANNELS + (int64_t)c->condition->set.channels;
        s.b.cond = push(l, DAR_SHAPE(B, channels, (int64_t)dar_rays_latent_frames(l->frames), l->height, l->width));
    }
    if (c->pixels) s.b.pixels = push(l, dar_loader_pixels(l));
    s.b.count = s.count;
    s.b.path = s.path;
    s.b.clip = s.clip;
    if (l->arena.plan) return;
    memset(s.count, 0, (size_t)B * sizeof *s.count);
    *slot = s;
}

/* All memory; planning, only its size. */
static void make_room(dar_loader *l)
{
    const dar_loader_config *c = &l->c;
    const size_t pixels = (size_t)l->height * (size_t)l->width;
    if (c->shuffle) l->order = dar_arena_push(&l->arena, c->clips * sizeof *l->order);
    if (c->pixels) l->rgb = dar_arena_push(&l->arena, 3 * pixels);
    if (c->cache) {
        const dar_shape z = dar_loader_latent(l), s = DAR_SHAPE(2 * z.d[1], z.d[2], z.d[3], z.d[4]);
        l->moments = push(l, s);
        l->known = push(l, DAR_SHAPE(z.d[1], z.d[2], z.d[3], z.d[4]));
        l->seen = dar_arena_push(&l->arena, l->frames + 3);
        l->words = dar_arena_push(&l->arena, (size_t)c->batch * sizeof *l->words);
        if (!l->arena.plan) {
            memset(l->seen, 0, l->frames + 3);
            l->seen[0] = true;
            memset(l->words, 0, (size_t)c->batch * sizeof *l->words);
        }
    }
    l->slot = dar_arena_push(&l->arena, (c->ahead + 1) * sizeof *l->slot);
    for (size_t i = 0; i <= c->ahead; i++) make_slot(l, l->slot + i);
}

static dar_status reserve(dar_loader *l, dar_err *e)
{
    DAR_TRY(dar_arena_init_plan(&l->arena, "batches", e));
    make_room(l);
    size_t bytes = l->arena.peak;
    if (l->c.plan) return DAR_OK;
    dar_arena_free(&l->arena);
    if (l->c.condition)
        DAR_TRY(dar_arena_init(&l->scratch, "condition", 2 * (size_t)l->height * (size_t)l->width + DAR_ALIGN, e));
    DAR_TRY(dar_arena_init(&l->arena, "batches", bytes, e));
    make_room(l);
    return DAR_OK;
}

dar_status dar_loader_open(dar_loader **out, const dar_loader_config *c, dar_err *e)
{
    DAR_ASSERT(c->batch >= 1 && (!c->cache || c->dit), "loader: batches of %lld", (long long)c->batch);
    dar_loader *l = calloc(1, sizeof *l);
    *out = NULL;
    if (!l) return dar_fail(e, DAR_ERR_NOMEM, "the loader: out of memory");
    l->c = *c;
    l->epoch = NO_EPOCH;
    l->base = NO_STEP;
    pthread_mutex_init(&l->lock, NULL);
    pthread_cond_init(&l->changed, NULL);
    dar_status s = look(l, e);
    if (!l->c.frames) l->c.frames = (int64_t)l->frames;
    if (!l->c.height) l->c.height = l->height;
    if (!l->c.width) l->c.width = l->width;
    if (s == DAR_OK) s = reserve(l, e);
    if (s == DAR_OK) *out = l;
    else dar_loader_close(l);
    return s;
}

void dar_loader_close(dar_loader *l)
{
    if (!l) return;
    pthread_mutex_lock(&l->lock);
    l->ends = true;
    pthread_cond_broadcast(&l->changed);
    pthread_mutex_unlock(&l->lock);
    dar_thread_join(l->thread);
    pthread_cond_destroy(&l->changed);
    pthread_mutex_destroy(&l->lock);
    dar_arena_free(&l->arena);
    dar_arena_free(&l->scratch);
    free(l);
}

dar_shape dar_loader_pixels(const dar_loader *l)
{
    return DAR_SHAPE(l->c.batch, 3, l->c.frames, l->c.height, l->c.width);
}

int64_t dar_loader_words(const dar_loader *l)
{
    return l->c.cache && l->text ? l->c.dit->text_keys : 0;
}

size_t dar_loader_bytes(const dar_loader *l)
{
    return l->arena.peak + l->scratch.size;
}

double dar_loader_waited(const dar_loader *l)
{
    return l->waited;
}
