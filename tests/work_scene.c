/* work_scene.c: the scenes of the benchmark, and how far a run on one is from its references. */
#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "data/synth_film.h"
#include "lib/arena.h"
#include "lib/dir.h"
#include "lib/rng.h"
#include "lib/safetensors_write.h"
#include "lib/sha256.h"
#include "tests/work.h"

#define TRIES 20   /* scenes until a camera path is safe */
#define MOVES 0.01 /* of the scene's size: from frame to frame a pixel shows another point */
#define WORDS 5    /* of a prompt that is drawn */

#define HELD_STILL 3 /* of scenes that were held out, every third has a camera that stands */

/* ---------------------------------------------------------------- making them */

/* A camera that stands; one far away; one above, for which the frame is fuller. */
static const dar_trajectory_kind stands = {
    "stands", "benchmark", false, { { 30, 30 }, { 0, 0 }, { 12, 12 }, { 0, 0 }, { 0, 0 }, { 0, 0 }, { 0, 0 }, { 1, 1 } }
};
static const dar_trajectory_kind far = {
    "far",
    "benchmark",
    false,
    { { -20, -20 }, { 40, 40 }, { 10, 10 }, { 0, 0 }, { 0, 0 }, { 0, 0 }, { 0, 0 }, { 8, 8 } }
};

static const dar_trajectory_kind overhead = {
    "above",
    "benchmark",
    false,
    { { -20, -20 }, { 40, 40 }, { 72, 72 }, { 0, 0 }, { 0, 0 }, { 0, 0 }, { 0, 0 }, { 1, 1 } }
};

/* clang-format off */
static const struct recipe {
    const char *name, *what, *path, *family; /* path NULL: `own`; both NULL: drawn, as the family is */
    const dar_trajectory_kind *own;
    dar_asset_set set;
    bool alone, prompts;
    size_t frames, longer; /* frames: 0: as asked; longer: as many times the latent frames after the first */
} recipes[] = {
    { "still",   "the camera stands, something moves", .family = "humanoid", .own = &stands, .alone = true },
    { "still-2", "the camera stands, a machine works", .family = "mechanism", .own = &stands },
    { "orbit",   "the camera goes around", "orbit-60", .family = NULL },
    { "dolly",   "the camera comes nearer", "dolly-15", .family = NULL },
    { "above", "seen from above, the frame is fuller", .own = &overhead },
    { "empty",   "nearly nothing is seen", .own = &far, .alone = true },
    { "frames-5", "the fewest: a single one is the reference itself", "orbit-30", .frames = 5 },
    { "long",    "twice as long, through windows", "half-orbit", .longer = 2 },
    { "prompts", "guided by two prompts that are drawn", "orbit-0-45", .prompts = true },
    { "other",   "things of other kinds, another camera", "ue-oblique-orbit", .set = DAR_ASSET_OOD },
};
/* clang-format on */

size_t work_scenes(void)
{
    return DAR_COUNT(recipes);
}

static const dar_asset_kind *kind_of(const char *family)
{
    for (size_t i = 0; family && i < dar_asset_kinds(); i++) {
        const dar_asset_kind *k = dar_asset_at(i);
        if (k->set == DAR_ASSET_TRAIN && strcmp(k->family, family) == 0) return k;
    }
    return NULL;
}

static size_t frames_of(const struct recipe *r, const work_size *size)
{
    return r->frames ? r->frames : r->longer ? r->longer * (size->frames - 1) + 1 : size->frames;
}

static dar_status plan_of(const struct recipe *r, const work_size *size, dar_synth_plan *plan, dar_err *e)
{
    *plan = dar_synth_standard();
    plan->subject = kind_of(r->family);
    plan->path = r->own;
    plan->set = r->set;
    plan->alone = r->alone;
    plan->width = size->width, plan->height = size->height;
    plan->frames = frames_of(r, size);
    return r->path ? dar_trajectory_find(r->path, &plan->path, e) : DAR_OK;
}

/* Everything that a scene is made by, but the code. */
static void hash(dar_sha256 *h, const struct recipe *r, const dar_synth_plan *p, uint64_t seed)
{
    char text[512];
    snprintf(text, sizeof text, "%s %s %s %d %d %d %d %g %d %d %zu %g %d %llu", r->name,
             p->subject ? p->subject->name : "", p->path ? p->path->name : "", (int)p->set, p->alone, p->coarse,
             p->bare, p->reach, p->width, p->height, p->frames, p->fps, r->prompts, (unsigned long long)seed);
    dar_sha256_add(h, text, strlen(text));
    if (!p->path) return;
    dar_sha256_add(h, &p->path->mirror, sizeof p->path->mirror);
    dar_sha256_add(h, p->path->bound, sizeof p->path->bound);
}

static void finish_key(dar_sha256 *h, char key[WORK_KEY])
{
    char sum[DAR_SHA256_TEXT];
    dar_sha256_finish(h, sum);
    snprintf(key, WORK_KEY, "%.*s", WORK_KEY - 1, sum);
}

dar_status work_recipes(const work_size *size, char key[WORK_KEY], dar_err *e)
{
    dar_synth_plan plan;
    dar_sha256 h;
    dar_status s = DAR_OK;
    dar_sha256_init(&h);
    for (size_t i = 0; i < DAR_COUNT(recipes) && s == DAR_OK; i++) {
        s = plan_of(&recipes[i], size, &plan, e);
        if (s == DAR_OK) hash(&h, &recipes[i], &plan, size->seed);
    }
    finish_key(&h, key);
    return s;
}

static dar_status film(const struct recipe *r, dar_synth_plan plan, const char *path, uint64_t seed, dar_err *e)
{
    dar_synth s;
    dar_render_report report;
    dar_status status = DAR_ERR_CHECK;
    for (uint64_t i = 0; i < TRIES && status == DAR_ERR_CHECK; i++) {
        plan.seed = plan.look = plan.view = dar_rng_u64(seed, dar_rng_stream(r->name), i) >> 12;
        status = dar_synth_make(&s, &plan, e);
        if (status == DAR_OK) status = dar_synth_film(&s, &plan, "bench", path, &report, e);
        dar_synth_free(&s);
    }
    return status;
}

/* Two embeddings, drawn; beside the bundle. */
static dar_status draw_prompts(const char *path, int64_t width, dar_err *e)
{
    dar_arena a;
    dar_safetensors_item item[2] = { { .name = "text" }, { .name = "negative" } };
    DAR_TRY(dar_arena_init(&a, "prompts", dar_mul_size(4 * WORDS * 2, (size_t)width) + 4096, e));
    for (int i = 0; i < 2; i++) {
        item[i].x = dar_tensor_push(&a, DAR_F32, DAR_SHAPE(WORDS, width));
        dar_rng_fill_normal(&item[i].x, 1, dar_rng_stream(item[i].name), 1);
    }
    dar_status s = dar_safetensors_write(path, item, 2, NULL, e);
    dar_arena_free(&a);
    return s;
}

/* ---------------------------------------------------------------- classes of places */

enum { EMPTY, STILL, MOVING, EDGE };

/* One frame of a group: how many pixels of each place are covered, and whether one shows another point than before. */
static void look(const work_scene *s, const float *mask, const float *now, const float *before, uint32_t *covered,
                 bool *moves)
{
    const size_t w = (size_t)s->b->meta.width, h = (size_t)s->b->meta.height, W = (size_t)s->shape[3];
    const size_t sx = w / W, sy = h / (size_t)s->shape[2];
    const double most = MOVES * s->b->meta.world.size;
    for (size_t y = 0; y < h; y++)
        for (size_t x = 0; x < w; x++) {
            size_t at = y * w + x, place = y / sy * W + x / sx;
            double d = 0;
            for (size_t c = 0; c < 3; c++) d = fmax(d, fabs((double)now[c * w * h + at] - before[c * w * h + at]));
            covered[place] += mask[at] >= 0.5F;
            moves[place] |= d > most;
        }
}

static dar_status classify(work_scene *s, dar_err *e)
{
    const size_t pixels = (size_t)s->b->meta.width * (size_t)s->b->meta.height;
    const size_t places = (size_t)(s->shape[2] * s->shape[3]), whole = DAR_RAYS_GROUP * (pixels / places);
    float *x = calloc(7 * pixels, sizeof *x), *mask = x + 6 * pixels;
    uint32_t *covered = calloc(places, sizeof *covered);
    bool *moves = calloc(places, sizeof *moves);
    dar_status status = x && covered && moves ? dar_bundle_values(s->b, DAR_FAMILY_WORLD, 0, x, e)
                                              : dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", s->path);
    for (size_t t = 1; t < s->b->meta.frames && status == DAR_OK; t++) {
        float *now = x + t % 2 * 3 * pixels, *before = x + (t - 1) % 2 * 3 * pixels;
        uint8_t *class = s->class + ((t - 1) / DAR_RAYS_GROUP + 1) * places;
        if (t % DAR_RAYS_GROUP == 1) {
            memset(covered, 0, places * sizeof *covered);
            memset(moves, 0, places * sizeof *moves);
        }
        status = dar_bundle_values(s->b, DAR_FAMILY_WORLD, t, now, e);
        if (status == DAR_OK) status = dar_bundle_values(s->b, DAR_FAMILY_MASK, t, mask, e);
        if (status == DAR_OK) look(s, mask, now, before, covered, moves);
        for (size_t i = 0; i < places; i++)
            class[i] = (uint8_t)(!covered[i] ? EMPTY : covered[i] < whole ? EDGE : moves[i] ? MOVING : STILL);
    }
    free(x);
    free(covered);
    free(moves);
    return status;
}

/* ---------------------------------------------------------------- opening */

static dar_status read_pictures(work_scene *s, dar_err *e)
{
    const size_t picture = 3 * (size_t)s->b->meta.width * (size_t)s->b->meta.height;
    DAR_TRY(dar_bundle_reference(s->b, s->reference, e));
    for (size_t t = 0; t < s->b->meta.frames; t++) DAR_TRY(dar_bundle_rgb(s->b, t, s->truth + t * picture, e));
    return DAR_OK;
}

static dar_status reserve(work_scene *s, const dar_config *model, dar_err *e)
{
    const dar_bundle_meta *m = &s->b->meta;
    const size_t picture = 3 * (size_t)m->width * (size_t)m->height;
    const int64_t shrink = dar_vae_shrink(&model->vae);
    s->shape[0] = model->dit.latent;
    s->shape[1] = (int64_t)dar_rays_latent_frames(m->frames);
    s->shape[2] = m->height / shrink;
    s->shape[3] = m->width / shrink;
    s->latent = (size_t)(s->shape[0] * s->shape[1] * s->shape[2] * s->shape[3]);
    s->truth = malloc(m->frames * picture);
    s->frames = malloc(m->frames * picture);
    s->reference = malloc(picture);
    s->full = calloc(s->latent, sizeof *s->full);
    s->ode = calloc(s->latent, sizeof *s->ode);
    s->class = calloc(s->latent, 1);
    return s->truth && s->frames && s->reference && s->full && s->ode && s->class ? DAR_OK
                                                                                  : dar_fail(e, DAR_ERR_NOMEM,
                                                                                             "%s: out of memory",
                                                                                             s->path);
}

static dar_status open_scene(work_scene *s, const struct recipe *r, const char *directory, const work_size *size,
                             const dar_config *model, dar_err *e)
{
    static const char prompts[] = ".text.safetensors";
    struct stat st;
    char file[PATH_MAX], key[WORK_KEY];
    dar_synth_plan plan;
    dar_sha256 h;
    DAR_TRY(plan_of(r, size, &plan, e));
    dar_sha256_init(&h);
    hash(&h, r, &plan, size->seed);
    finish_key(&h, key);
    if (snprintf(s->path, PATH_MAX, "%s/%s-%dx%dx%zu-%s", directory, r->name, size->width, size->height, plan.frames,
                 key) >= PATH_MAX - (int)sizeof prompts)
        return dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long", directory);
    if (stat(s->path, &st) != 0) DAR_TRY(film(r, plan, s->path, size->seed, e));
    if (r->prompts) {
        snprintf(file, sizeof file, "%.*s%s", PATH_MAX - (int)sizeof prompts, s->path, prompts);
        if (stat(file, &st) != 0) DAR_TRY(draw_prompts(file, model->dit.text_width, e));
        if (!(s->text = strdup(file))) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", file);
    }
    DAR_TRY(dar_bundle_open(&s->b, s->path, e));
    DAR_TRY(reserve(s, model, e));
    DAR_TRY(read_pictures(s, e));
    DAR_TRY(classify(s, e));
    return dar_front_look(&s->kind, s->b, e);
}

dar_status work_scene_open(work_scene *s, size_t i, const char *directory, const work_size *size,
                           const dar_config *model, dar_err *e)
{
    const struct recipe *r = &recipes[i];
    *s = (work_scene){ .name = r->name };
    if (r->longer) s->window = dar_rays_latent_frames(size->frames);
    return open_scene(s, r, directory, size, model, e);
}

dar_status work_scene_held(work_scene *s, size_t i, const char *directory, const work_size *size,
                           const dar_config *model, dar_err *e)
{
    static const struct recipe still = { .name = "held", .own = &stands }, moving = { .name = "held" };
    work_size own = *size;
    own.seed = dar_rng_u64(size->seed, dar_rng_stream("held"), i) >> 12;
    *s = (work_scene){ .name = "held" };
    return open_scene(s, i % HELD_STILL ? &moving : &still, directory, &own, model, e);
}

void work_scene_close(work_scene *s)
{
    dar_bundle_close(s->b);
    free((char *)(uintptr_t)s->text);
    free(s->truth);
    free(s->reference);
    free(s->frames);
    free(s->full);
    free(s->ode);
    free(s->class);
    *s = (work_scene){ 0 };
}

/* ---------------------------------------------------------------- references */

static dar_shape picture_shape(const work_scene *s)
{
    const dar_bundle_meta *m = &s->b->meta;
    return DAR_SHAPE((int64_t)m->frames, m->height, m->width, 3);
}

static void references_path(const work_scene *s, char path[PATH_MAX])
{
    snprintf(path, PATH_MAX, "%.*s.references.safetensors", PATH_MAX - 32, s->path);
}

dar_status work_scene_load(work_scene *s, const char *model, bool *there, dar_err *e)
{
    char path[PATH_MAX];
    struct stat st;
    dar_weights *w;
    dar_tensor x[3];
    *there = false;
    references_path(s, path);
    if (stat(path, &st) != 0) return DAR_OK;
    DAR_TRY(dar_weights_open(&w, path, e));
    const char *of = dar_weights_meta(w, "model");
    dar_status status = DAR_OK;
    if (of && strcmp(of, model) == 0) {
        static const char *const name[] = { "full", "ode", "frames" };
        for (int i = 0; i < 3 && status == DAR_OK; i++) status = dar_weights_tensor(w, name[i], &x[i], e);
        const size_t bytes = s->latent * sizeof *s->full;
        dar_shape pictures = picture_shape(s);
        *there = status == DAR_OK && dar_tensor_bytes(&x[0]) == bytes && dar_tensor_bytes(&x[1]) == bytes &&
                 dar_shape_equal(&x[2].shape, &pictures);
        if (*there) {
            memcpy(s->full, x[0].data, bytes);
            memcpy(s->ode, x[1].data, bytes);
            for (size_t i = 0; i < (size_t)dar_shape_count(&pictures); i++)
                s->frames[i] = (uint8_t)dar_dtype_get(x[2].dtype, x[2].data, i);
        }
    }
    dar_weights_close(w);
    return status;
}

dar_status work_scene_save(const work_scene *s, const char *model, dar_err *e)
{
    char path[PATH_MAX];
    dar_arena a;
    const dar_shape latent = DAR_SHAPE(s->shape[0], s->shape[1], s->shape[2], s->shape[3]), shape = picture_shape(s);
    const size_t pixels = (size_t)dar_shape_count(&shape);
    const char *const meta[] = { "model", model, NULL };
    references_path(s, path);
    DAR_TRY(dar_arena_init(&a, "references", 4 * pixels + 16 * s->latent + 4096, e));
    dar_safetensors_item item[3] = { { "full", dar_tensor_push(&a, DAR_F64, latent) },
                                     { "ode", dar_tensor_push(&a, DAR_F64, latent) },
                                     { "frames", dar_tensor_push(&a, DAR_F32, shape) } };
    memcpy(item[0].x.data, s->full, s->latent * sizeof *s->full);
    memcpy(item[1].x.data, s->ode, s->latent * sizeof *s->ode);
    for (size_t i = 0; i < pixels; i++) dar_dtype_set(DAR_F32, item[2].x.data, i, s->frames[i]);
    dar_status status = dar_safetensors_write(path, item, 3, &(dar_safetensors_options){ .meta = meta }, e);
    dar_arena_free(&a);
    return status;
}

/* ---------------------------------------------------------------- comparing */

static double distance(const double *x, const double *y, size_t n)
{
    double above = 0, below = 0;
    for (size_t i = 0; i < n; i++) above += (x[i] - y[i]) * (x[i] - y[i]), below += y[i] * y[i];
    return sqrt(above / below);
}

static void compare_classes(const work_scene *s, const double *x, work_row *row)
{
    const size_t C = (size_t)s->shape[0], first = (size_t)(s->shape[2] * s->shape[3]), n = s->latent / C;
    double above[WORK_CLASSES] = { 0 }, below[WORK_CLASSES] = { 0 };
    for (size_t c = 0; c < C; c++)
        for (size_t i = first; i < n; i++) {
            double y = s->full[c * n + i], d = x[c * n + i] - y;
            above[s->class[i]] += d * d;
            below[s->class[i]] += y * y;
        }
    for (int k = 0; k < WORK_CLASSES; k++) row->v[WORK_EMPTY + k] = below[k] > 0 ? sqrt(above[k] / below[k]) : NAN;
}

static void mean_of(dar_metric *m, const work_scene *s, const uint8_t *found, const uint8_t *truth,
                    dar_metric_row *mean)
{
    const size_t picture = 3 * (size_t)s->b->meta.width * (size_t)s->b->meta.height;
    dar_metric_clip clip = { 0 };
    dar_metric_row row;
    dar_metric_begin(m, NULL);
    for (size_t t = 0; t < s->b->meta.frames; t++) {
        dar_metric_frame(m, found + t * picture, truth + t * picture, NULL, &row);
        if (t) dar_metric_clip_add(&clip, &row);
    }
    dar_metric_clip_mean(&clip, mean);
}

dar_status work_compare(const work_scene *s, const double *latent, const uint8_t *frames, work_row *row, dar_err *e)
{
    dar_metric *m;
    dar_metric_row full, truth;
    DAR_TRY(dar_metric_open(&m, (size_t)s->b->meta.width, (size_t)s->b->meta.height, DAR_METRIC_ALL, e));
    mean_of(m, s, frames, s->frames, &full);
    mean_of(m, s, frames, s->truth, &truth);
    dar_metric_close(m);
    const double *f = full.v[DAR_METRIC_FRAME], *g = truth.v[DAR_METRIC_FRAME];
    row->v[WORK_ERROR] = distance(latent, s->full, s->latent);
    row->v[WORK_ODE] = distance(latent, s->ode, s->latent);
    row->v[WORK_PSNR] = f[DAR_METRIC_PSNR];
    row->v[WORK_SSIM] = f[DAR_METRIC_SSIM];
    row->v[WORK_FLIP] = f[DAR_METRIC_FLIP];
    row->v[WORK_PSNR_TRUTH] = g[DAR_METRIC_PSNR];
    row->v[WORK_TEMP] = g[DAR_METRIC_TEMP];
    row->v[WORK_TEMP_TRUTH] = g[DAR_METRIC_TEMP_TRUTH];
    row->v[WORK_CAMERA_STILL] = s->kind.still;
    row->v[WORK_VISIBLE] = s->kind.visible;
    compare_classes(s, latent, row);
    return DAR_OK;
}
