/* tiles.c: see tiles.h. */
#include "models/tiles.h"

#include <math.h>

#include "lib/kern.h"
#include "lib/thread.h"

/* ---------------------------------------------------------------- one side */

int64_t dar_tiles_count(const dar_tiling *o, int64_t n)
{
    int64_t step = o->size - o->overlap;
    DAR_ASSERT(o->overlap >= 0 && step > 0, "tiles: an overlap of %lld in tiles of %lld", (long long)o->overlap,
               (long long)o->size);
    return n > o->size ? 1 + (n - o->size + step - 1) / step : 1;
}

int64_t dar_tiles_length(const dar_tiling *o, int64_t n)
{
    int64_t count = dar_tiles_count(o, n);
    return (n + (count - 1) * o->overlap + count - 1) / count;
}

int64_t dar_tiles_start(const dar_tiling *o, int64_t n, int64_t i)
{
    return i ? i * (n - dar_tiles_length(o, n)) / (dar_tiles_count(o, n) - 1) : 0;
}

/* Ramps over what tile i shares with its neighbours, at x [latent pixels]. */
static double ramp(const dar_tiling *o, int64_t n, int64_t i, double x)
{
    double length = (double)dar_tiles_length(o, n), start = (double)dar_tiles_start(o, n, i), end = start + length;
    double before = i > 0 ? (double)dar_tiles_start(o, n, i - 1) + length : start; /* its neighbours' ends */
    double after = i + 1 < dar_tiles_count(o, n) ? (double)dar_tiles_start(o, n, i + 1) : end;
    if (x < start || x > end) return 0;
    return fmin(x < before ? (x - start) / (before - start) : 1, x > after ? (end - x) / (end - after) : 1);
}

double dar_tiles_weight(const dar_tiling *o, int64_t n, int64_t i, int64_t scale, int64_t x)
{
    double at = (double)dar_tiles_start(o, n, i) + ((double)x + 0.5) / (double)scale, sum = 0;
    for (int64_t k = 0; k < dar_tiles_count(o, n); k++) sum += ramp(o, n, k, at);
    return ramp(o, n, i, at) / sum;
}

/* ---------------------------------------------------------------- both sides */

/* A tile of a picture, each side scaled to what is there of a latent pixel. */
struct tile {
    int64_t y, x, h, w;      /* the first row and column, and how many [latent pixels] */
    int64_t scale;           /* of results */
    dar_tensor down, across; /* weights of their rows and columns */
};

static int64_t count(const dar_tiling *o, const dar_tensor *latent)
{
    return dar_tiles_count(o, latent->shape.d[3]) * dar_tiles_count(o, latent->shape.d[4]);
}

static dar_tensor weights(dar_arena *a, dar_dtype type, const dar_tiling *o, int64_t n, int64_t i, int64_t scale)
{
    int64_t length = scale * dar_tiles_length(o, n);
    dar_tensor w = dar_tensor_push(a, type, DAR_SHAPE(length));
    for (int64_t x = 0; x < length && !a->plan; x++)
        dar_dtype_set(type, w.data, (size_t)x, dar_tiles_weight(o, n, i, scale, x));
    return w;
}

/* Tile i of a latent; weights on `a`. */
static struct tile tile_of(const dar_tiling *o, const dar_tensor *latent, int64_t i, int64_t scale, dar_arena *a)
{
    int64_t h = latent->shape.d[3], w = latent->shape.d[4], across = dar_tiles_count(o, w);
    return (struct tile){ .y = dar_tiles_start(o, h, i / across),
                          .x = dar_tiles_start(o, w, i % across),
                          .h = dar_tiles_length(o, h),
                          .w = dar_tiles_length(o, w),
                          .scale = scale,
                          .down = weights(a, latent->dtype, o, h, i / across, scale),
                          .across = weights(a, latent->dtype, o, w, i % across, scale) };
}

/* Frames [first, first + n) of the tile, copied. */
static dar_val *cut(dar_tape *t, const dar_tensor *x, const struct tile *p, int64_t scale, int64_t first, int64_t n)
{
    dar_tensor frames = dar_tensor_narrow(x, 2, first, n);
    dar_tensor rows = dar_tensor_narrow(&frames, 3, scale * p->y, scale * p->h);
    return dar_contiguous(t, dar_leaf(t, dar_tensor_narrow(&rows, 4, scale * p->x, scale * p->w), NULL));
}

struct mix {
    const struct tile *tile;
    const dar_tensor *from; /* [B, C, 1, rows, columns] of the tile */
    dar_tensor to;          /* [B, C, 1, H, W], a frame of a clip */
};

static void mix_plane(void *ctx, size_t plane, int thread)
{
    const struct mix *m = ctx;
    const dar_kern *k = dar_kern_for(m->to.dtype);
    size_t h = (size_t)m->from->shape.d[3], w = (size_t)m->from->shape.d[4], C = (size_t)m->from->shape.d[1];
    size_t y0 = (size_t)(m->tile->scale * m->tile->y), x0 = (size_t)(m->tile->scale * m->tile->x);
    size_t to = plane / C * (size_t)m->to.stride[0] + plane % C * (size_t)m->to.stride[1] + x0;
    double buf[DAR_PIECE];
    (void)thread;
    for (size_t y = 0; y < h; y++)
        for (size_t x = 0; x < w; x += DAR_PIECE) {
            size_t n = w - x < DAR_PIECE ? w - x : DAR_PIECE, at = to + (y0 + y) * (size_t)m->to.stride[3] + x;
            k->mul(n, dar_tensor_at(m->from, (plane * h + y) * w + x), dar_tensor_at(&m->tile->across, x), buf);
            k->axpy(n, dar_dtype_get(m->to.dtype, m->tile->down.data, y), buf, dar_tensor_at(&m->to, at));
        }
}

/* clip += weights x, in frame f, where the tile is. */
static void mix(const struct tile *tile, const dar_tensor *x, const dar_tensor *clip, int64_t f)
{
    struct mix m = { tile, x, dar_tensor_narrow(clip, 2, f, 1) };
    dar_parallel((size_t)(x->shape.d[0] * x->shape.d[1]), mix_plane, &m);
}

/* Pixels and latent have the sizes of one clip. */
static void check(const dar_vae *v, const dar_tensor *x, const dar_tensor *latent, int64_t channels)
{
    const int64_t *p = x->shape.d, *l = latent->shape.d, r = dar_vae_shrink(&v->c), s = dar_vae_shrink_time(&v->c);
    char a[96], b[96];
    DAR_ASSERT(x->shape.n == 5 && latent->shape.n == 5 && p[0] == l[0] && p[1] == 3 && l[1] == channels &&
                   p[2] == 1 + s * (l[2] - 1) && p[3] == r * l[3] && p[4] == r * l[4] && x->dtype == v->main &&
                   latent->dtype == v->main,
               "tiles: pixels %s, latent %s", dar_shape_text(&x->shape, a, sizeof a),
               dar_shape_text(&latent->shape, b, sizeof b));
}

/* ---------------------------------------------------------------- encoder */

void dar_tiles_encode(dar_tape *t, const dar_vae *v, const dar_tiling *o, const dar_tensor *x,
                      const dar_tensor *moments, dar_arena *kept)
{
    int64_t group = dar_vae_shrink_time(&v->c), r = dar_vae_shrink(&v->c);
    check(v, x, moments, 2 * v->c.latent);
    if (!t->arena->plan) dar_tensor_fill(moments, 0);
    for (int64_t i = 0; i < count(o, moments); i++) {
        dar_tape_place begin = dar_tape_mark(t);
        dar_mark kept_before = dar_arena_mark(kept);
        struct tile tile = tile_of(o, moments, i, 1, t->arena);
        dar_vae_stream s;
        dar_vae_stream_init(&s, v, DAR_VAE_ENCODER, kept);
        for (int64_t k = 0; k < moments->shape.d[2]; k++) {
            dar_tape_place piece = dar_tape_mark(t);
            dar_val *in = cut(t, x, &tile, r, k ? 1 + (k - 1) * group : 0, k ? group : 1);
            dar_val *y = dar_vae_encode_next(&s, t, in);
            if (!t->arena->plan) mix(&tile, &y->x, moments, k);
            dar_tape_reset(t, piece);
        }
        dar_arena_reset(kept, kept_before);
        dar_tape_reset(t, begin);
    }
}

/* ---------------------------------------------------------------- decoder */

struct target {
    const struct tile *tile;
    const dar_tensor *x;
};

static dar_status add_frame(void *ctx, const dar_tensor *frame, int64_t index, dar_err *e)
{
    const struct target *a = ctx;
    (void)e;
    mix(a->tile, frame, a->x, index);
    return DAR_OK;
}

void dar_tiles_decode(dar_tape *t, const dar_vae *v, const dar_tiling *o, const dar_tensor *z, const dar_tensor *x,
                      dar_arena *kept)
{
    bool plan = t->arena->plan;
    check(v, x, z, v->c.latent);
    if (!plan) dar_tensor_fill(x, 0);
    for (int64_t i = 0; i < count(o, z); i++) {
        dar_tape_place begin = dar_tape_mark(t);
        dar_mark kept_before = dar_arena_mark(kept);
        struct tile tile = tile_of(o, z, i, dar_vae_shrink(&v->c), t->arena);
        struct target to = { &tile, x };
        dar_vae_stream s;
        dar_vae_stream_init(&s, v, DAR_VAE_DECODER, kept);
        for (int64_t k = 0; k < z->shape.d[2]; k++) {
            dar_tape_place piece = dar_tape_mark(t);
            dar_vae_decode_next(&s, t, cut(t, z, &tile, 1, k, 1), plan ? NULL : add_frame, &to, NULL);
            dar_tape_reset(t, piece);
        }
        dar_arena_reset(kept, kept_before);
        dar_tape_reset(t, begin);
    }
}
