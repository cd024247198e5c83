/* synth.c: choose things, make them, place them, light them, look at them. */
#include "data/synth.h"

#include <math.h>
#include <string.h>

#include "data/affine.h"

#define MARGIN  0.08 /* [m] between two things */
#define TRIES   96   /* places, or ways, of one thing */
#define PATHS   24   /* camera paths */
#define LONGEST 2    /* [m] of a way that the area makes room for */
#define STILLS  9    /* things beside the animated ones, at most */

#define HIDDEN 0.25 /* share of the frames in which something may stand before the subject */
#define ZOOMS  4    /* lenses, each ZOOM as wide as the one before, that are tried on a path */
#define ZOOM   0.75

#define GROUND_DEPTH   0.3  /* [m] */
#define LARGEST_GROUND 1.43 /* half its longest side, in radii of the area, where the camera keeps its reach */

dar_synth_plan dar_synth_standard(void)
{
    return (dar_synth_plan){ .set = DAR_ASSET_TRAIN, .width = 224, .height = 128, .frames = 17, .fps = 16 };
}

void dar_synth_free(dar_synth *s)
{
    dar_camera_free(&s->cameras);
    dar_scene_free(&s->scene);
    memset(s, 0, sizeof *s);
}

/* A scene that is being made. */
struct work {
    const dar_synth_plan *plan;
    dar_synth *out;
    dar_maker maker;
    dar_dice dice;
    dar_place_thing place[DAR_SYNTH_THINGS];
};

static void *room(struct work *w, size_t n, size_t bytes)
{
    return memset(dar_arena_push(&w->out->scene.memory, dar_mul_size(n, bytes)), 0, n * bytes);
}

/* ---------------------------------------------------------------- things */

/* A room is a subject, never beside one. */
static const dar_asset_kind *draw_kind(dar_asset_set set, bool subject, dar_dice *d)
{
    for (;;) {
        const dar_asset_kind *k = dar_asset_at(dar_dice_below(d, dar_asset_kinds()));
        if (k->set == set && (subject || strcmp(k->family, "interior") != 0)) return k;
    }
}

static void add_thing(struct work *w, const dar_asset_kind *kind, size_t number)
{
    dar_scene *s = &w->out->scene;
    dar_synth_thing *x = &w->out->thing[w->out->things++];
    dar_dice d = dar_dice_for(w->plan->seed, "thing", number);
    x->kind = kind;
    x->node = s->nodes;
    w->maker.look = dar_dice_for(w->plan->look, "paint", number);
    x->asset = dar_asset_make(&w->maker, kind, &d);
    x->nodes = s->nodes - x->node;
    x->box = room(w, w->plan->frames, sizeof *x->box);
}

/* The subject, up to two more that move by themselves, and what stands around. */
static void add_things(struct work *w)
{
    dar_dice *d = &w->dice;
    const dar_asset_kind *subject = w->plan->subject ? w->plan->subject : draw_kind(w->plan->set, true, d);
    bool indoors = strcmp(subject->family, "interior") == 0;
    size_t others = dar_dice_below(d, 3), stills = 1 + dar_dice_below(d, STILLS - 2), n = 0;
    if (w->plan->alone || w->plan->coarse) others = 0, stills = stills / 2;
    add_thing(w, subject, n++);
    for (size_t i = 0; i < others && !indoors; i++) add_thing(w, draw_kind(w->plan->set, false, d), n++);
    for (size_t i = 0; i < stills && !indoors; i++)
        add_thing(w, dar_asset_still_at(dar_dice_below(d, dar_asset_stills())), n++);
}

/* ---------------------------------------------------------------- boxes */

static const dar_box nowhere = { { INFINITY, INFINITY, INFINITY }, { -INFINITY, -INFINITY, -INFINITY } };

static void grow(dar_box *b, const dar_box *x)
{
    for (int k = 0; k < 3; k++) {
        b->lo[k] = fmin(b->lo[k], x->lo[k]);
        b->hi[k] = fmax(b->hi[k], x->hi[k]);
    }
}

/* Pose the clip: the boxes of every thing, and of all. */
static dar_status find_boxes(struct work *w, dar_err *e)
{
    dar_synth *o = w->out;
    const dar_scene *s = &o->scene;
    dar_box *box = room(w, w->plan->frames * s->instances, sizeof *box);
    o->clip = (dar_clip){ s, s->animations ? 0 : DAR_NONE, w->plan->frames, w->plan->fps, DAR_PLAY_ONCE };
    DAR_TRY(dar_clip_boxes(&o->clip, box, e));
    dar_box all = nowhere;
    for (size_t t = 0; t < w->plan->frames; t++) {
        o->box[t] = nowhere;
        for (size_t k = 0; k < o->things; k++) o->thing[k].box[t] = nowhere;
        for (size_t i = 0; i < s->instances; i++) {
            const dar_box *b = &box[t * s->instances + i];
            size_t node = (size_t)s->instance[i].node;
            grow(&o->box[t], b);
            for (size_t k = 0; k < o->things; k++)
                if (node - o->thing[k].node < o->thing[k].nodes) grow(&o->thing[k].box[t], b);
        }
        grow(&all, &o->box[t]);
    }
    dar_world_init(&o->world);
    memcpy(o->world.lo, all.lo, sizeof all.lo);
    memcpy(o->world.hi, all.hi, sizeof all.hi);
    dar_world_finish(&o->world);
    return DAR_OK;
}

/* ---------------------------------------------------------------- places */

/* Radius of a thing's footprint about its root, over the clip. */
static double reach_of(const dar_box *b, size_t frames)
{
    double r = 0;
    for (size_t t = 0; t < frames; t++)
        r = fmax(r, hypot(fmax(fabs(b[t].lo[0]), fabs(b[t].hi[0])), fmax(fabs(b[t].lo[2]), fabs(b[t].hi[2]))));
    return r;
}

static double area_radius(const struct work *w)
{
    const dar_synth *o = w->out;
    double sum = 0, most = 0, seconds = (double)(w->plan->frames - 1) / w->plan->fps;
    for (size_t i = 0; i < o->things; i++) {
        double r = reach_of(o->thing[i].box, w->plan->frames);
        double way = o->thing[i].asset.way == DAR_ASSET_STAYS ? 0 : fmin(o->thing[i].asset.speed * seconds, LONGEST);
        sum += r * (r + way);
        most = fmax(most, r + 0.6 * way);
    }
    if (w->plan->reach > 0) return w->plan->reach / LARGEST_GROUND;
    return fmax(1.15 * most, 1.34 * sqrt(sum));
}

/* Nodes of things without a place are taken out of the scene, with their instances. */
static void drop(struct work *w)
{
    dar_synth *o = w->out;
    dar_scene *s = &o->scene;
    size_t kept = 0, things = 0;
    s->vertices = 0;
    for (size_t i = 0; i < s->instances; i++) {
        size_t node = (size_t)s->instance[i].node;
        bool stays = true;
        for (size_t k = 0; k < o->things; k++)
            if (node - o->thing[k].node < o->thing[k].nodes) stays = w->place[k].placed;
        if (!stays) continue;
        s->instance[kept] = s->instance[i];
        s->instance[kept].vertex = s->vertices;
        s->vertices += s->mesh[s->instance[kept++].mesh].vertices;
    }
    s->instances = kept;
    for (size_t k = 0; k < o->things; k++)
        if (w->place[k].placed) o->thing[things++] = o->thing[k];
    o->dropped = o->things - things;
    o->things = things;
}

static dar_place_motion draw_motion(dar_dice *d)
{
    return dar_dice_chance(d, 0.5) ? DAR_PLACE_STILL : (dar_place_motion)(1 + dar_dice_below(d, DAR_PLACE_WALK - 1));
}

static void put_things(struct work *w)
{
    dar_synth *o = w->out;
    size_t frames = w->plan->frames;
    dar_place_area area = { o->radius, MARGIN, frames, w->plan->fps, TRIES };
    for (size_t i = 0; i < o->things; i++) {
        dar_synth_thing *x = &o->thing[i];
        dar_dice d = dar_dice_for(w->plan->seed, "place", i);
        bool animated = strcmp(x->kind->family, "object") != 0;
        w->place[i] = (dar_place_thing){
            .asset = &x->asset,
            .local = x->box,
            .at = room(w, frames, sizeof *w->place->at),
            .turn = room(w, frames, sizeof *w->place->turn),
            .box = room(w, frames, sizeof *w->place->box),
        };
        if (!dar_place_put(&area, w->place, i, animated ? DAR_PLACE_STILL : draw_motion(&d), &d)) continue;
        const dar_mover at = { x->asset.root, .path = DAR_TRANSLATION, .track = w->place[i].at[0] };
        const dar_mover turn = { x->asset.root, .path = DAR_ROTATION, .track = w->place[i].turn[0] };
        dar_node *root = &o->scene.node[x->asset.root];
        memcpy(root->translation, w->place[i].at[0], sizeof root->translation);
        memcpy(root->rotation, w->place[i].turn[0], sizeof root->rotation);
        x->motion = w->place[i].motion;
        if (x->motion == DAR_PLACE_STILL && x->asset.way == DAR_ASSET_STAYS) continue;
        dar_make_move(&w->maker, at);
        dar_make_move(&w->maker, turn);
    }
}

/* ---------------------------------------------------------------- ground */

static void add_ground(struct work *w)
{
    dar_maker *m = &w->maker;
    dar_dice *d = &w->dice;
    double r = w->out->radius * dar_dice_in(d, 1.06, w->plan->reach > 0 ? 1.3 : 1.6),
           thick = dar_dice_in(d, 0.08, GROUND_DEPTH - 0.01), top = -0.004;
    size_t form = dar_dice_below(d, 3);
    m->look = dar_dice_for(w->plan->look, "ground", 0);
    const dar_paint_style style = { .palette = DAR_NONE, .contrast = dar_dice_in(&m->look, 0.35, 0.9) };
    dar_make_begin(m);
    m->density = dar_dice_in(d, 0.25, 0.7);
    m->paint = dar_make_paint(m, &style);
    dar_make_shift(m, 0, top, 0);
    if (form == 0) dar_make_disc(m, r);
    else dar_make_plate(m, 2 * r, (form == 1 ? 2 : 2.2) * r, 1);
    m->paint = dar_make_paint(m, &style);
    dar_make_home(m);
    dar_make_shift(m, 0, top - thick - 0.001, 0);
    if (form == 0) dar_make_lathe(m, (const double[][2]){ { 0, 0 }, { r, 0 }, { r, thick } }, 3);
    else dar_make_shift(m, 0, thick / 2, 0), dar_make_box(m, 2 * r, thick, (form == 1 ? 2 : 2.2) * r);
    dar_make_show(m, dar_make_node(m, DAR_NONE, "ground", 0, 0, 0), dar_make_end(m, "ground"));
}

/* ---------------------------------------------------------------- lights */

static void draw_lights(struct work *w)
{
    dar_dice d = dar_dice_for(w->plan->look, "light", 0);
    size_t kind = dar_dice_below(&d, dar_lighting_count);
    dar_lighting *l = &w->out->lighting;
    *l = dar_lighting_of(kind, false);
    w->out->lights = dar_lighting_kinds[kind].name;
    double turn = dar_dice_in(&d, -M_PI, M_PI), c = cos(turn), s = sin(turn), tint[3];
    for (int k = 0; k < 3; k++) tint[k] = dar_dice_in(&d, 0.92, 1.08);
    for (size_t i = 0; i < l->suns; i++) {
        double *x = l->sun[i].toward, old = x[0];
        x[0] = c * old + s * x[2], x[2] = c * x[2] - s * old;
    }
    double *g = l->sky.glow_toward, old = g[0];
    g[0] = c * old + s * g[2], g[2] = c * g[2] - s * old;
    for (int k = 0; k < 3; k++) l->sky.zenith[k] *= tint[k], l->sky.horizon[k] *= tint[k];
    l->sky.seed = dar_rng_u64(w->plan->look, dar_rng_stream("sky"), 0);
    l->exposure *= dar_dice_in(&d, 0.9, 1.15);
}

/* ---------------------------------------------------------------- camera */

static const dar_trajectory_kind *draw_path(dar_dice *d)
{
    for (;;) {
        const dar_trajectory_kind *k = &dar_trajectory_kinds[dar_dice_below(d, dar_trajectory_count)];
        if (strcmp(k->family, "benchmark") != 0) return k;
    }
}

/* The boxes of all things, frame by frame: what is to stay in view. */
static dar_box *cover_things(struct work *w)
{
    dar_box *box = room(w, w->plan->frames, sizeof *box);
    for (size_t t = 0; t < w->plan->frames; t++) {
        box[t] = nowhere;
        for (size_t k = 0; k < w->out->things; k++) grow(&box[t], &w->out->thing[k].box[t]);
    }
    return box;
}

/* What fills the picture: the subject, and of the way from it to all the others a share that is the scene's. */
static dar_box *cover_subject(struct work *w, const dar_box *things)
{
    dar_dice d = dar_dice_for(w->plan->seed, "frame", 0);
    dar_box *box = room(w, w->plan->frames, sizeof *box);
    double share = dar_dice_in(&d, 0, w->plan->coarse ? 0.1 : 0.6);
    for (size_t t = 0; t < w->plan->frames; t++) {
        box[t] = w->out->thing[0].box[t];
        for (int k = 0; k < 3; k++) {
            box[t].lo[k] += share * (things[t].lo[k] - box[t].lo[k]);
            box[t].hi[k] += share * (things[t].hi[k] - box[t].hi[k]);
        }
    }
    return box;
}

/* Where a segment from a to b is in the box: whether it is. */
static bool is_between(const dar_box *box, const double a[3], const double b[3])
{
    double in = 0, out = 1;
    for (int k = 0; k < 3; k++) {
        double way = b[k] - a[k], lo = (box->lo[k] - a[k]) / way, hi = (box->hi[k] - a[k]) / way;
        if (way == 0 && (a[k] < box->lo[k] || a[k] > box->hi[k])) return false;
        if (way == 0) continue;
        in = fmax(in, fmin(lo, hi));
        out = fmin(out, fmax(lo, hi));
    }
    return in <= out;
}

/* Whether the subject's middle is seen most of the time. */
static bool is_seen(const struct work *w)
{
    const dar_synth *o = w->out;
    size_t hidden = 0;
    for (size_t t = 0; t < w->plan->frames; t++) {
        double eye[3], middle[3];
        bool seen = true;
        for (int k = 0; k < 3; k++) {
            eye[k] = o->cameras.view[t].c2w[4 * k + 3];
            middle[k] = (o->thing[0].box[t].lo[k] + o->thing[0].box[t].hi[k]) / 2;
        }
        for (size_t i = 1; i < o->things; i++) seen = seen && !is_between(&o->thing[i].box[t], eye, middle);
        hidden += !seen;
    }
    return (double)hidden <= HIDDEN * (double)w->plan->frames;
}

/* The path around the stage's boxes, from outside of `all`: the nearer, the wider the lens. */
static bool goes_around(struct work *w, dar_stage stage, const dar_stage *all)
{
    dar_synth *o = w->out;
    size_t frame;
    for (int i = 0; i < ZOOMS; i++, stage.fov *= ZOOM)
        if (dar_trajectory_path(&o->path, &stage, &o->cameras, NULL) == DAR_OK &&
            dar_trajectory_check(&o->cameras, all, &frame) == DAR_PATH_SAFE)
            return true;
    return false;
}

/* First close to the subject; if that is not safe, or hides it, around all things, then around the ground too. */
static dar_status find_path(struct work *w, dar_err *e)
{
    dar_synth *o = w->out;
    const dar_synth_plan *p = w->plan;
    const double r = p->reach, m = 0.45 * r;
    const dar_box within = { { -r, -GROUND_DEPTH, -r }, { r, r, r } }, amid = { { -m, 0, -m }, { m, m, m } };
    dar_dice d = dar_dice_for(p->view, "camera", 0);
    dar_stage all = dar_stage_standard();
    all.boxes = p->frames, all.box = o->box, all.width = p->width, all.height = p->height;
    if (!p->path) all.fov = dar_dice_in(&d, 28, 50) * M_PI / 180;
    dar_stage things = all, near = all;
    things.box = cover_things(w);
    near.box = cover_subject(w, things.box);
    if (p->coarse) near.margin = 0;
    if (r > 0) all.box = &within, near.box = &amid, all.boxes = near.boxes = 1;
    DAR_TRY(dar_camera_init(&o->cameras, p->frames, e));
    for (o->paths = 0; o->paths < PATHS; o->paths++) {
        o->path = dar_trajectory_draw(p->path ? p->path : draw_path(&d), p->view, o->paths);
        if (goes_around(w, near, &all) && (r > 0 || is_seen(w))) return DAR_OK;
        if (r > 0 || (!p->path && o->paths < PATHS / 2)) continue;
        if (goes_around(w, things, &all) || dar_trajectory_path(&o->path, &all, &o->cameras, NULL) == DAR_OK)
            return DAR_OK;
    }
    return dar_fail(e, DAR_ERR_CHECK, "seed %llu: found no safe camera path in %d", (unsigned long long)p->view, PATHS);
}

/* ---------------------------------------------------------------- */

dar_status dar_synth_make(dar_synth *s, const dar_synth_plan *plan, dar_err *e)
{
    struct work w = { .plan = plan, .out = s, .dice = dar_dice_for(plan->seed, "scene", 0) };
    *s = (dar_synth){ 0 };
    DAR_ASSERT(plan->frames >= 1 && plan->fps > 0, "synth: %zu frames, %g a second", plan->frames, plan->fps);
    DAR_TRY(dar_make_open(&w.maker, &s->scene, plan->frames, plan->fps, e));
    w.maker.bare = plan->bare;
    w.maker.coarse = plan->coarse;
    s->box = room(&w, plan->frames, sizeof *s->box);
    add_things(&w);
    dar_make_close(&w.maker);
    DAR_TRY(find_boxes(&w, e)); /* about their roots */
    s->radius = area_radius(&w);
    put_things(&w);
    drop(&w);
    add_ground(&w);
    dar_make_close(&w.maker);
    DAR_TRY(find_boxes(&w, e));
    draw_lights(&w);
    return find_path(&w, e);
}
