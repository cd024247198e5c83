/* raster.c: memory, and the stages of a frame in their order. */
#include "data/raster.h"

#include <math.h>
#include <string.h>

#include "data/raster_inside.h"
#include "lib/log.h"
#include "lib/thread.h"

#define RUN 2048 /* vertices of a task */

dar_raster_config dar_raster_default(int width, int height)
{
    return (dar_raster_config){ .width = width, .height = height, .blend_cutoff = 0.5 };
}

/* ---------------------------------------------------------------- memory */

static dar_raster_piece piece_of(const dar_raster *r, size_t instance, const dar_primitive *q, size_t begin)
{
    size_t left = q->triangle + q->triangles - begin;
    dar_raster_piece p = { .instance = (uint32_t)instance,
                           .triangle = (uint32_t)begin,
                           .count = (uint32_t)(left < DAR_RASTER_PIECE ? left : DAR_RASTER_PIECE),
                           .material = q->material,
                           .double_sided = true };
    if (q->material == DAR_NONE) return p;
    const dar_material *m = &r->scene->material[q->material];
    p.double_sided = m->double_sided;
    p.cutoff = m->alpha == DAR_ALPHA_BLEND ? r->config.blend_cutoff : m->cutoff;
    p.masked = m->alpha != DAR_ALPHA_OPAQUE && p.cutoff > 0;
    return p;
}

/* Pieces of all primitives in order; out NULL: only count. */
static size_t cut_pieces(const dar_raster *r, dar_raster_piece *out)
{
    const dar_scene *s = r->scene;
    size_t n = 0;
    for (size_t i = 0; i < s->instances; i++) {
        const dar_mesh *m = &s->mesh[s->instance[i].mesh];
        for (size_t k = 0; k < m->primitives; k++) {
            const dar_primitive *q = &m->primitive[k];
            for (size_t t = 0; t < q->triangles; t += DAR_RASTER_PIECE, n++)
                if (out) out[n] = piece_of(r, i, q, q->triangle + t);
        }
    }
    return n;
}

static size_t cut_runs(const dar_scene *s, dar_raster_run *out)
{
    size_t n = 0;
    for (size_t i = 0; i < s->instances; i++) {
        size_t begin = s->instance[i].vertex, end = begin + s->mesh[s->instance[i].mesh].vertices;
        for (; begin < end; begin += RUN, n++)
            if (out) out[n] = (dar_raster_run){ (uint32_t)i, begin, end - begin < RUN ? end : begin + RUN, { 0 } };
    }
    return n;
}

static void *push(dar_arena *a, size_t n, size_t size)
{
    return dar_arena_push(a, dar_mul_size(n, size));
}

static void push_inside(struct dar_raster_inside *in, const dar_raster *r, dar_arena *a)
{
    const dar_scene *s = r->scene;
    size_t width = (size_t)r->config.width, height = (size_t)r->config.height;

    in->tiles_x = (width + DAR_TILE_WIDTH - 1) / DAR_TILE_WIDTH;
    in->tiles_y = (height + DAR_TILE_HEIGHT - 1) / DAR_TILE_HEIGHT;
    size_t tiles = in->tiles_x * in->tiles_y;
    in->pieces = cut_pieces(r, NULL);
    in->runs = cut_runs(s, NULL);
    in->piece = push(a, in->pieces, sizeof *in->piece);
    in->run = push(a, in->runs, sizeof *in->run);
    in->seen = push(a, s->instances, sizeof *in->seen);
    in->kept = push(a, s->instances, sizeof *in->kept);
    in->box = push(a, s->instances, sizeof *in->box);
    in->cam = push(a, s->vertices, sizeof *in->cam);
    in->px = push(a, s->vertices, sizeof *in->px);
    in->dx = push(a, width, sizeof *in->dx);
    in->dy = push(a, height, sizeof *in->dy);
    in->bounds = push(a, in->pieces, DAR_RASTER_PIECE * sizeof *in->bounds);

    /* Room for one piece in every tile, so that a round always makes progress, and for most scenes in one round. */
    size_t most = dar_mul_size(tiles, DAR_RASTER_PIECE), usual = dar_mul_size(in->pieces, 4 * (size_t)DAR_RASTER_PIECE);
    in->capacity = most > usual ? most : usual;
    in->reference = push(a, in->capacity, sizeof *in->reference);
    in->start = push(a, tiles + 1, sizeof *in->start);
    in->next = push(a, tiles, DAR_RASTER_GROUPS * sizeof *in->next);
    in->used = push(a, tiles, sizeof *in->used);
    in->zero = push(a, tiles, sizeof *in->zero);
    in->nearest = push(a, tiles, DAR_TILE_PIXELS * sizeof *in->nearest);
    in->shown = push(a, tiles, DAR_TILE_PIXELS * sizeof *in->shown);
    in->spent = push(a, tiles, sizeof *in->spent);
    in->mirrored = push(a, r->scene->instances, sizeof *in->mirrored);
}

void dar_raster_init(dar_raster *r, const dar_scene *s, const dar_identity *identity, const dar_raster_config *c,
                     dar_arena *a)
{
    struct dar_raster_inside in = { 0 };
    DAR_ASSERT(c->width > 0 && c->width <= DAR_RASTER_MAX_SIDE && c->height > 0 && c->height <= DAR_RASTER_MAX_SIDE,
               "raster: picture of %d x %d", c->width, c->height);
    DAR_ASSERT(s->vertices < UINT32_MAX, "raster: %zu vertices", s->vertices);

    *r = (dar_raster){ .scene = s, .identity = identity, .config = *c };
    r->position = push(a, s->vertices, 12);
    r->normal = push(a, s->vertices, 12);
    r->in = push(a, 1, sizeof *r->in);
    push_inside(&in, r, a);
    DAR_ASSERT(in.pieces < UINT32_MAX / DAR_RASTER_PIECE, "raster: %zu pieces of %d triangles", in.pieces,
               DAR_RASTER_PIECE);
    if (a->plan) return;
    *r->in = in;
    cut_pieces(r, in.piece);
    cut_runs(s, in.run);
    memset(in.kept, 0, s->instances * sizeof *in.kept);
}

/* ---------------------------------------------------------------- families */

/* Every family as bytes: bytes per pixel and planes. */
struct family {
    void *data;
    size_t bytes;
};

#define FAMILIES 9

static void families_of(const dar_gbuffer *g, struct family f[FAMILIES])
{
    const struct family all[FAMILIES] = { { g->tracking, 12 }, { g->instance, 4 }, { g->part, 4 },
                                          { g->triangle, 4 },  { g->corner, 8 },   { g->world, 12 },
                                          { g->normal, 12 },   { g->depth, 4 },    { g->mask, 1 } };
    memcpy(f, all, sizeof all);
}

struct copy {
    unsigned char *to;
    const unsigned char *from;
};

static void copy_range(void *ctx, size_t begin, size_t end, int thread)
{
    const struct copy *c = ctx;
    (void)thread;
    memcpy(c->to + begin, c->from + begin, end - begin);
}

/* Whether `out` is `last`, family by family: what was empty there is zero already. */
static bool same_buffers(const dar_gbuffer *out, const dar_gbuffer *last)
{
    struct family to[FAMILIES], from[FAMILIES];
    if (!last) return false;
    families_of(out, to);
    families_of(last, from);
    for (int i = 0; i < FAMILIES; i++)
        if (to[i].data && to[i].data != from[i].data) return false;
    return true;
}

/* Whether `last` has what `out` asks for. */
static bool copy_frame(const dar_raster *r, const dar_gbuffer *out, const dar_gbuffer *last)
{
    size_t pixels = (size_t)r->config.width * (size_t)r->config.height;
    struct family to[FAMILIES], from[FAMILIES];

    families_of(out, to);
    families_of(last, from);
    for (int i = 0; i < FAMILIES; i++)
        if (to[i].data && !from[i].data) return false;
    for (int i = 0; i < FAMILIES; i++) {
        struct copy c = { to[i].data, from[i].data };
        if (c.to && c.to != c.from) dar_parallel_range(pixels * to[i].bytes, (size_t)1 << 18, copy_range, &c);
    }
    return true;
}

/* ---------------------------------------------------------------- a frame */

static void set_view(dar_raster *r, const dar_view *v)
{
    DAR_ASSERT(v->width == r->config.width && v->height == r->config.height,
               "raster: view of %d x %d, expected %d x %d", v->width, v->height, r->config.width, r->config.height);
    DAR_ASSERT(v->near >= DAR_RASTER_MIN_NEAR && v->fx > 0 && v->fy > 0 && v->fx <= DAR_RASTER_MAX_FOCAL &&
                   v->fy <= DAR_RASTER_MAX_FOCAL,
               "raster: near %g, fx %g, fy %g", v->near, v->fx, v->fy);
    r->view = *v;
    for (int x = 0; x < v->width; x++) r->in->dx[x] = (x + 0.5 - v->cx) / v->fx;
    for (int y = 0; y < v->height; y++) r->in->dy[y] = (y + 0.5 - v->cy) / v->fy;
}

static bool same_view(const dar_view *a, const dar_view *b)
{
    bool same = a->fx == b->fx && a->fy == b->fy && a->cx == b->cx && a->cy == b->cy && a->near == b->near;
    for (int i = 0; i < 12; i++) same = same && a->c2w[i] == b->c2w[i];
    return same;
}

struct tiles {
    dar_raster *r;
    const dar_pose *pose;
    const dar_gbuffer *out;
    bool last; /* round */
};

static void draw_tile(void *ctx, size_t tile, int thread)
{
    const struct tiles *j = ctx;
    struct dar_raster_inside *in = j->r->in;
    bool some = in->start[tile] < in->start[tile + 1];
    (void)thread;

    if (!some && !(j->last && in->used[tile])) return;
    double begin = dar_log_clock();
    if (some) dar_raster_cover(j->r, tile, !in->used[tile]);
    in->used[tile] = true;
    double middle = dar_log_clock();
    if (j->last) dar_raster_resolve(j->r, j->pose, j->out, tile);
    in->spent[tile][0] += middle - begin;
    in->spent[tile][1] += dar_log_clock() - middle;
}

/* Seconds since *mark, which moves on. */
static double lap(double *mark)
{
    double now = dar_log_clock(), d = now - *mark;
    *mark = now;
    return d;
}

static void draw_rounds(dar_raster *r, const dar_pose *p, const dar_gbuffer *out, double *mark)
{
    struct dar_raster_inside *in = r->in;
    size_t tiles = in->tiles_x * in->tiles_y, piece = 0;
    double *seconds = r->stats.seconds, spent[2] = { 0 }, common = 0;

    memset(in->used, 0, tiles * sizeof *in->used);
    memset(in->spent, 0, tiles * sizeof *in->spent);
    do {
        piece = dar_raster_bin(r, piece);
        seconds[DAR_STAGE_BIN] += lap(mark);
        struct tiles j = { r, p, out, piece == in->pieces };
        dar_parallel(tiles, draw_tile, &j);
        common += lap(mark);
        r->stats.rounds++;
    } while (piece < in->pieces);

    for (size_t i = 0; i < tiles; i++) {
        r->stats.tiles_empty += !in->used[i];
        for (int k = 0; k < 2; k++) spent[k] += in->spent[i][k];
    }
    r->stats.tiles += tiles;
    double share = spent[0] + spent[1] > 0 ? spent[0] / (spent[0] + spent[1]) : 0;
    seconds[DAR_STAGE_COVER] += share * common;
    seconds[DAR_STAGE_RESOLVE] += (1 - share) * common;
}

static bool still(const dar_raster *r, const dar_pose *p)
{
    for (size_t i = 0; i < r->scene->instances; i++)
        if (p->changed[i]) return false;
    return true;
}

void dar_raster_draw(dar_raster *r, const dar_pose *p, const dar_view *v, const dar_gbuffer *out,
                     const dar_gbuffer *last)
{
    struct dar_raster_inside *in = r->in;
    double *seconds = r->stats.seconds, mark = dar_log_clock();
    bool moved = !in->drawn || !same_view(v, &r->view), normals = out->normal || out->corner;
    bool fresh = !in->drawn || (normals && !in->has_normals);

    DAR_ASSERT(p->scene == r->scene, "raster: pose of another scene");
    DAR_ASSERT(r->identity || (!out->tracking && !out->part), "raster: no identity, but tracking or part asked for");
    set_view(r, v);
    r->stats.frames++;
    if (!moved && last && still(r, p) && copy_frame(r, out, last)) {
        r->stats.copied++;
        seconds[DAR_STAGE_COPY] += lap(&mark);
        return;
    }
    in->has_normals = normals;
    memcpy(in->mirrored, p->mirrored, r->scene->instances * sizeof *in->mirrored);
    dar_pose_vertices(p, r->position, normals ? r->normal : NULL, !fresh);
    seconds[DAR_STAGE_POSE] += lap(&mark);
    dar_raster_transform(r, p, moved);
    seconds[DAR_STAGE_TRANSFORM] += lap(&mark);
    dar_raster_cull(r, p);
    seconds[DAR_STAGE_CULL] += lap(&mark);
    draw_rounds(r, p, out, &mark);
    if (!in->drawn || !same_buffers(out, last)) memset(in->zero, 0, in->tiles_x * in->tiles_y * sizeof *in->zero);
    dar_raster_fill(r, out);
    seconds[DAR_STAGE_FILL] += lap(&mark);
    in->drawn = true;
}

/* ---------------------------------------------------------------- what was drawn */

/* Of a pixel in the tiles; false: an empty tile. */
static bool pixel_of(const dar_raster *r, int x, int y, size_t *at)
{
    const struct dar_raster_inside *in = r->in;
    DAR_ASSERT(in->drawn && x >= 0 && x < r->config.width && y >= 0 && y < r->config.height, "raster: pixel %d, %d", x,
               y);
    size_t tile = (size_t)(y / DAR_TILE_HEIGHT) * in->tiles_x + (size_t)(x / DAR_TILE_WIDTH);
    *at = tile * DAR_TILE_PIXELS + (size_t)(y % DAR_TILE_HEIGHT) * DAR_TILE_WIDTH + (size_t)(x % DAR_TILE_WIDTH);
    return in->used[tile];
}

bool dar_raster_at(const dar_raster *r, int x, int y, uint32_t *instance, uint32_t *triangle)
{
    size_t at;
    if (!pixel_of(r, x, y, &at) || !r->in->shown[at]) return false;
    size_t id = (size_t)r->in->shown[at] - 1;
    const dar_raster_piece *p = &r->in->piece[id / DAR_RASTER_PIECE];
    *instance = p->instance;
    *triangle = p->triangle + (uint32_t)(id % DAR_RASTER_PIECE);
    return true;
}

bool dar_raster_is_back(const dar_raster *r, uint32_t instance, uint32_t triangle)
{
    const dar_scene *s = r->scene;
    const dar_mesh *m = &s->mesh[s->instance[instance].mesh];
    size_t corner[3], k = 0;
    while (m->primitive[k].triangle + m->primitive[k].triangles <= triangle) k++;
    int material = m->primitive[k].material;
    if (r->config.faces == DAR_FACES_ALL || material == DAR_NONE || s->material[material].double_sided) return false;
    dar_raster_corners(r, instance, triangle, corner);
    return (dar_raster_side(r, corner) > 0) != r->in->mirrored[instance];
}

double dar_raster_depth(const dar_raster *r, int x, int y)
{
    size_t at;
    return pixel_of(r, x, y, &at) && r->in->shown[at] ? 1 / r->in->nearest[at] : 0;
}
