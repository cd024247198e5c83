/* speed_sample.c: run time against error: settings of the sampler, on scenes, as rows of a table (tests/work.h).
 *
 * Seconds are those of a video: the model is loaded and the clip prepared before. */
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "data/png.h"
#include "lib/dir.h"
#include "lib/log.h"
#include "lib/sha256.h"
#include "lib/thread.h"
#include "tests/work.h"

#define ALL    DAR_SKIPS_ALL
#define MOST   128 /* settings */
#define ROUNDS 15

static const char *out, *model_path, *vae, *front_path;
static int64_t size[2], frames, rounds, fine, scenes, held;
static double safety;
static bool quick, only_report;
static dar_common common;

/* clang-format off */
static const dar_option options[] = {
    { .name = "out", .letter = 'o', .placeholder = "DIR", .type = DAR_ARG_TEXT, .target = &out,
      .standard = "build/bench", .help = "of tables and pages, scenes and references; rows that are there stay" },
    { .name = "model", .placeholder = "DIR", .type = DAR_ARG_TEXT, .target = &model_path,
      .standard = "models/dar-tiny", .help = "as for dar-sample" },
    { .name = "vae", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &vae, .help = "as for dar-sample" },
    { .name = "front", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &front_path,
      .help = "also write the front here: front.json of the model is what dar-sample reads" },
    { .name = "size", .placeholder = "WxH", .type = DAR_ARG_SIZE, .target = size, .standard = "224x128", .lo = 8,
      .hi = 8192, .help = "of scenes [px]" },
    { .name = "frames", .placeholder = "T", .type = DAR_ARG_INT, .target = &frames, .standard = "17", .lo = 5,
      .hi = 4097, .help = "of scenes, 4 n + 1" },
    { .name = "scenes", .placeholder = "N", .type = DAR_ARG_INT, .target = &scenes, .standard = "1000", .lo = 1,
      .hi = 1000, .help = "the first N only" },
    { .name = "rounds", .placeholder = "N", .type = DAR_ARG_INT, .target = &rounds, .standard = "3", .lo = 1,
      .hi = ROUNDS, .help = "videos of a row, of whose seconds the median is kept" },
    { .name = "fine", .placeholder = "N", .type = DAR_ARG_INT, .target = &fine, .standard = "200", .lo = 1,
      .hi = 1000, .help = "steps of the reference for the ODE" },
    { .name = "safety", .placeholder = "X", .type = DAR_ARG_NUMBER, .target = &safety, .standard = "2", .lo = 1,
      .hi = 100, .help = "a setting's bound, in largest errors of any scene" },
    { .name = "held", .placeholder = "N", .type = DAR_ARG_INT, .target = &held, .standard = "0", .lo = 0, .hi = 100000,
      .help = "then try error budgets on N other scenes: held.csv; exit status 1 if one is exceeded" },
    { .name = "quick", .type = DAR_ARG_FLAG, .target = &quick, .help = "a few settings only" },
    { .name = "report", .type = DAR_ARG_FLAG, .target = &only_report, .help = "pages of what is there" },
};
/* clang-format on */

/* ---------------------------------------------------------------- settings */

enum { F64, F32, BF16, INT8, PRECISIONS };

typedef struct setting {
    char name[WORK_TEXT], skips[WORK_TEXT];
    const char *reuse;
    int precision, threads; /* threads 0: all */
    dar_sampler_config c;
} setting;

/* Every combination of steps, tolerances; lists end with 0.  tolerance[0] 0 says: DAR_FRONT_WATCH. */
static const struct group {
    int precision;
    dar_solver_kind solver;
    size_t steps[6];
    double tolerance[8], guidance[4];
    int threads;
    bool quick;
} groups[] = {
    { .precision = F32, .solver = DAR_EULER, .steps = { 50 }, .quick = true },
    { .precision = F64, .solver = DAR_EULER, .steps = { 50 } },
    { .precision = BF16, .solver = DAR_EULER, .steps = { 50 }, .quick = true },
    { .precision = INT8, .solver = DAR_EULER, .steps = { 50 } },
    { .precision = BF16, .solver = DAR_EULER, .steps = { 50 }, .threads = 1 },
    { .precision = BF16, .solver = DAR_EULER, .steps = { 35, 25, 20, 15, 10 } },
    { .precision = BF16, .solver = DAR_AB2, .steps = { 35, 25, 20, 15, 10 } },
    { .precision = BF16, .solver = DAR_AB2, .steps = { 30, 12 }, .quick = true },
    { .precision = BF16, .solver = DAR_DPMPP, .steps = { 35, 25, 20, 15, 10 } },
    { .precision = BF16, .solver = DAR_UNIPC, .steps = { 35, 25, 20, 15, 10 } },
    { .precision = F32, .solver = DAR_AB2, .steps = { 50, 35, 20 } },
    { .precision = INT8, .solver = DAR_AB2, .steps = { 25, 15 } },
    { .precision = F32,
      .solver = DAR_EULER,
      .steps = { 50 },
      .tolerance = { 1e-4, 3e-4, 1e-3, 3e-3, 6e-3, 1e-2, 3e-2, 1e-1 } },
    { .precision = BF16,
      .solver = DAR_EULER,
      .steps = { 50 },
      .tolerance = { 3e-4, 1e-3, 3e-3, 5e-3, 1e-2, 3e-2, 1e-1 } },
    { .precision = BF16, .solver = DAR_EULER, .steps = { 50 }, .tolerance = { 2e-3, 8e-3 }, .quick = true },
    { .precision = INT8, .solver = DAR_EULER, .steps = { 50 }, .tolerance = { 1e-3, 3e-3, 1e-2 } },
    { .precision = BF16, .solver = DAR_AB2, .steps = { 50 }, .tolerance = { 1e-3, 3e-3, 1e-2, 3e-2 } },
    { .precision = BF16, .solver = DAR_UNIPC, .steps = { 50 }, .tolerance = { 1e-3, 3e-3, 1e-2, 3e-2 } },
    { .precision = BF16, .solver = DAR_DPMPP, .steps = { 50 }, .tolerance = { 1e-3, 3e-3, 1e-2, 3e-2 } },
    { .precision = BF16, .solver = DAR_EULER, .steps = { 50 }, .guidance = { 1e-3, 1e-2, 5e-2 } },
    { .precision = BF16, .solver = DAR_EULER, .steps = { 50 }, .tolerance = { 3e-3, 1e-2 }, .guidance = { 1e-2 } },
};

static size_t add(setting *s, const struct group *g, size_t steps, double tolerance, double guidance)
{
    size_t n = 0;
    *s = (setting){ .precision = g->precision, .threads = g->threads, .skips = "all", .reuse = dar_reuse_name[0] };
    s->c = dar_sampler_default();
    s->c.solver.kind = g->solver;
    s->c.solver.grid = dar_solver_grid(g->solver);
    s->c.solver.steps = steps;
    s->c.solver.tolerance = tolerance > 0 ? tolerance : g->solver == DAR_EULER ? 0 : DAR_FRONT_WATCH;
    s->c.guidance_tolerance = guidance;
    n += (size_t)snprintf(s->name, WORK_TEXT, "%s %s-%zu", dar_pipeline_precision[g->precision],
                          dar_solver_name[g->solver], steps);
    if (tolerance > 0) n += (size_t)snprintf(s->name + n, WORK_TEXT - n, " T=%g", tolerance);
    if (guidance > 0) n += (size_t)snprintf(s->name + n, WORK_TEXT - n, " G=%g", guidance);
    if (g->threads) snprintf(s->name + n, WORK_TEXT - n, " %d thread%s", g->threads, g->threads > 1 ? "s" : "");
    return 1;
}

static size_t add_group(setting *s, const struct group *g)
{
    size_t n = 0;
    for (size_t i = 0; i < DAR_COUNT(g->steps) && g->steps[i]; i++)
        for (size_t k = 0; k == 0 || (k < DAR_COUNT(g->tolerance) && g->tolerance[k] > 0); k++)
            for (size_t j = 0; j == 0 || (j < DAR_COUNT(g->guidance) && g->guidance[j] > 0); j++)
                n += add(&s[n], g, g->steps[i], g->tolerance[k], g->guidance[j]);
    return n;
}

/* The full run, with one exact skip or none. */
static size_t add_skips(setting *s)
{
    static const int skips[] = { -1,
                                 DAR_SKIP_PASS,
                                 DAR_SKIP_SCENE,
                                 DAR_SKIP_TEXT,
                                 DAR_SKIP_TIMES,
                                 DAR_SKIP_PADDING,
                                 DAR_SKIP_BEGIN,
                                 DAR_SKIP_HELD,
                                 DAR_SKIP_REPEAT };
    size_t n = 0;
    for (size_t i = 0; i < DAR_COUNT(skips) && (!quick || !i); i++) {
        const char *name = i ? dar_skip_name[skips[i]] : "none";
        add(&s[n], &groups[0], 50, 0, 0);
        s[n].c.skip = i ? 1u << skips[i] : 0;
        snprintf(s[n].skips, WORK_TEXT, "%.20s", name);
        snprintf(s[n++].name, WORK_TEXT, "%s%.20s", i ? WORK_FULL " skip " : WORK_FULL, i ? name : "");
    }
    return n;
}

/* The full run's steps, held by the rules that others publish. */
static size_t add_caches(setting *s)
{
    static const char *const rules[] = { "table:2", "change:0.1",  "table:3",    "table:4",   "table:5",
                                         "table:8", "change:0.05", "change:0.2", "change:0.4" };
    size_t n = 0;
    for (int p = F32; p <= BF16; p++)
        for (size_t i = 0; i < DAR_COUNT(rules) && (!quick || (p == BF16 && i < 2)); i++) {
            setting *x = &s[n++];
            add(x, &(struct group){ .precision = p, .solver = DAR_EULER }, 50, 0, 0);
            const size_t end = strlen(x->name);
            snprintf(x->name + end, sizeof x->name - end, " %s", rules[i]);
            DAR_ASSERT(dar_reuse_read(&x->c.reuse, rules[i], NULL) == DAR_OK, "no rule %s", rules[i]);
            x->reuse = rules[i];
        }
    return n;
}

static size_t list_settings(setting *s)
{
    size_t n = add_skips(s);
    for (size_t i = 0; i < DAR_COUNT(groups); i++)
        if (!quick || groups[i].quick) n += add_group(&s[n], &groups[i]);
    n += add_caches(&s[n]);
    DAR_ASSERT(n <= MOST, "%zu settings", n);
    return n;
}

/* ---------------------------------------------------------------- a video */

struct job {
    dar_run *r;
    dar_model_file file;
    dar_condition condition;
    char model[WORK_TEXT]; /* as the rows have it: weights, size and recipes of scenes */
    work_table table;
    work_scene *scene; /* [scenes] */
    size_t scenes;
    double *latent; /* of the longest scene */
    uint8_t *frames;
    dar_progress progress;
    size_t done;
};

/* What a video arrives at. */
struct hearing {
    const work_scene *s;
    double *latent, ended[3];
    uint8_t *frames;
    size_t steps;
};

static dar_status hear_frame(void *ctx, size_t index, const uint8_t *rgb, dar_err *e)
{
    struct hearing *h = ctx;
    const size_t picture = 3 * (size_t)h->s->b->meta.width * (size_t)h->s->b->meta.height;
    (void)e;
    memcpy(h->frames + index * picture, rgb, picture);
    return DAR_OK;
}

static dar_status hear_step(void *ctx, size_t done, const dar_tensor *z, const dar_tensor *clean, dar_err *e)
{
    struct hearing *h = ctx;
    (void)clean, (void)e;
    for (size_t i = 0; done == h->steps && i < h->s->latent; i++) h->latent[i] = dar_dtype_get(z->dtype, z->data, i);
    return DAR_OK;
}

static dar_status hear_stage(void *ctx, dar_pipeline_stage stage, size_t done, size_t of, dar_err *e)
{
    struct hearing *h = ctx;
    (void)done, (void)of;
    h->ended[stage] = dar_log_clock();
    return dar_interrupted() ? dar_fail(e, DAR_ERR_INTERRUPTED, "interrupted; the same command goes on") : DAR_OK;
}

static int by_size(const void *a, const void *b)
{
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

static double median(double *x, size_t n)
{
    qsort(x, n, sizeof *x, by_size);
    return n % 2 ? x[n / 2] : (x[n / 2 - 1] + x[n / 2]) / 2;
}

/* n videos, all the same; row NULL: for a reference. */
static dar_status render(dar_pipeline *p, const work_scene *s, struct hearing *h, size_t n, work_row *row, dar_err *e)
{
    const dar_pipeline_listener l = { hear_frame, hear_stage, hear_step, h };
    double all[ROUNDS], sampling[ROUNDS];
    const double flops = dar_sampler_flops(&p->sampler);
    const size_t calls = p->sampler.calls;
    for (size_t i = 0; i < n; i++) {
        double begun = dar_log_clock();
        DAR_TRY(dar_pipeline_render(p, s->reference, &l, e));
        all[i] = h->ended[DAR_PIPELINE_DECODE] - begun;
        sampling[i] = h->ended[DAR_PIPELINE_SAMPLE] - h->ended[DAR_PIPELINE_ENCODE];
    }
    if (!row) return DAR_OK;
    row->v[WORK_SECONDS] = median(all, n);
    row->v[WORK_SAMPLING] = median(sampling, n);
    row->v[WORK_FLOPS] = (dar_sampler_flops(&p->sampler) - flops) / (double)n + p->encode + p->decode;
    row->v[WORK_CALLS] = (double)((p->sampler.calls - calls) / n);
    row->v[WORK_BYTES] = row->v[WORK_CALLS] * (double)p->m->bytes;
    row->v[WORK_PEAK] = (double)(p->m->bytes + p->bytes);
    row->v[WORK_ESTIMATE] = p->sampler.estimate;
    return DAR_OK;
}

static dar_status run(const struct job *j, const dar_model *m, const setting *set, work_scene *s, double *latent,
                      uint8_t *pictures, size_t n, work_row *row, dar_err *e)
{
    const int threads = dar_threads();
    dar_pipeline_options o = { .sampler = set->c, .seed = common.seed, .text = s->text, .window = (int64_t)s->window };
    struct hearing h = { .s = s, .latent = latent, .frames = pictures, .steps = set->c.solver.steps };
    dar_pipeline *p;
    o.overlap = o.window / 4;
    DAR_TRY(dar_pipeline_open(&p, m, &j->condition, s->path, s->b, &o, e));
    if (set->threads) dar_threads_set(set->threads);
    dar_status status = render(p, s, &h, n, row, e);
    dar_threads_set(threads);
    dar_pipeline_close(p);
    return status;
}

/* ---------------------------------------------------------------- rows */

static dar_status open_model(struct job *j, int precision, bool plan, dar_model **m, dar_err *e)
{
    dar_model_options o = { .strength = 1, .plan = plan, .seed = common.seed };
    o.part[DAR_MODEL_VAE] = vae;
    o.storage = precision == DAR_PIPELINE_INT8 ? DAR_BF16 : (dar_dtype)precision;
    o.eight = precision == DAR_PIPELINE_INT8;
    return dar_model_open(m, &j->file, &o, e);
}

/* Beside the tables. */
static dar_status write_picture(const work_scene *s, const char *name, const uint8_t *video, dar_err *e)
{
    char path[PATH_MAX];
    const size_t w = (size_t)s->b->meta.width, h = (size_t)s->b->meta.height;
    work_picture(out, s->name, name, path);
    return dar_png_write(path, w, h, 3, video + (s->b->meta.frames - 1) * 3 * w * h, e);
}

static dar_status measure_row(struct job *j, const dar_model *m, const setting *set, work_scene *s, dar_err *e)
{
    work_row row = { 0 };
    const dar_sampler_config *c = &set->c;
    snprintf(row.text[WORK_SCENE], WORK_TEXT, "%s", s->name);
    memcpy(row.text[WORK_SETTING], set->name, WORK_TEXT);
    snprintf(row.text[WORK_PRECISION], WORK_TEXT, "%s", dar_pipeline_precision[set->precision]);
    snprintf(row.text[WORK_SOLVER], WORK_TEXT, "%s", dar_solver_name[c->solver.kind]);
    memcpy(row.text[WORK_SKIPS], set->skips, WORK_TEXT);
    snprintf(row.text[WORK_REUSE], WORK_TEXT, "%s", set->reuse);
    memcpy(row.text[WORK_MODEL], j->model, WORK_TEXT);
    row.v[WORK_STEPS] = (double)c->solver.steps;
    row.v[WORK_THREADS] = set->threads;
    row.v[WORK_TOLERANCE] = c->solver.tolerance;
    row.v[WORK_GUIDANCE_TOLERANCE] = c->guidance_tolerance;
    DAR_TRY(run(j, m, set, s, j->latent, j->frames, (size_t)rounds, &row, e));
    DAR_TRY(work_compare(s, j->latent, j->frames, &row, e));
    DAR_TRY(write_picture(s, set->name, j->frames, e));
    DAR_TRY(work_add(&j->table, &row, e));
    dar_progress_step(&j->progress, (double)++j->done, row.text[WORK_SETTING]);
    return DAR_OK;
}

static bool wanted(const struct job *j, const setting *set, const work_scene *s)
{
    if (set->c.guidance_tolerance > 0 && !s->text) return false; /* there is nothing to leave out */
    return !work_find(&j->table, s->name, set->name);
}

static size_t missing(const struct job *j, const setting *set, size_t n, int precision)
{
    size_t todo = 0;
    for (size_t k = 0; k < n; k++)
        for (size_t i = 0; i < j->scenes; i++)
            todo += (precision < 0 || set[k].precision == precision) && wanted(j, &set[k], &j->scene[i]);
    return todo;
}

static dar_status measure_rows(struct job *j, const setting *set, size_t n, dar_err *e)
{
    dar_status s = DAR_OK;
    j->progress = dar_progress_begin("bench", "rows", (double)missing(j, set, n, -1));
    for (int p = PRECISIONS - 1; p >= 0 && s == DAR_OK; p--) {
        dar_model *m = NULL;
        if (!missing(j, set, n, p)) continue;
        s = open_model(j, p, false, &m, e);
        for (size_t i = 0; i < j->scenes; i++)
            for (size_t k = 0; k < n && s == DAR_OK; k++)
                if (set[k].precision == p && wanted(j, &set[k], &j->scene[i]))
                    s = measure_row(j, m, &set[k], &j->scene[i], e);
        dar_model_close(m);
    }
    if (s == DAR_OK) dar_progress_end(&j->progress);
    return s;
}

/* ---------------------------------------------------------------- references */

/* Of scenes that have rows to be measured; set[0] is the full run. */
static dar_status refer(struct job *j, const setting *set, size_t n, dar_err *e)
{
    setting ode = *set;
    dar_status s = DAR_OK;
    ode.c.solver = (dar_solver_config){ DAR_AB2, DAR_GRID_EVEN, (size_t)fine, set->c.solver.shift, 0, 0 };
    ode.c.skip = ALL;
    for (size_t i = 0; i < j->scenes && s == DAR_OK; i++) {
        dar_model *m = NULL;
        work_scene *x = &j->scene[i];
        bool there = true;
        for (size_t k = 0; k < n && there; k++) there = !wanted(j, &set[k], x);
        if (!there) DAR_TRY(work_scene_load(x, j->model, &there, e));
        if (there) continue;
        dar_log(DAR_LOG_INFO, "references of %s", x->name);
        s = open_model(j, F64, false, &m, e);
        if (s == DAR_OK) s = run(j, m, &ode, x, x->ode, x->frames, 1, NULL, e);
        dar_model_close(m);
        m = NULL;
        if (s == DAR_OK) s = open_model(j, F32, false, &m, e);
        if (s == DAR_OK) s = run(j, m, set, x, x->full, x->frames, 1, NULL, e);
        dar_model_close(m);
        if (s == DAR_OK) s = work_scene_save(x, j->model, e);
    }
    return s;
}

/* ---------------------------------------------------------------- scenes that were held out */

struct kept {
    struct job *j;
    dar_model *m[PRECISIONS]; /* NULL: not opened yet */
};

static dar_status render_held(void *ctx, int precision, const dar_sampler_config *c, work_scene *s, double *latent,
                              uint8_t *pictures, double *seconds, double *estimate, dar_err *e)
{
    struct kept *k = ctx;
    setting set = { .precision = precision, .c = *c };
    work_row row = { 0 };
    *seconds = 0;
    if (!k->m[precision]) DAR_TRY(open_model(k->j, precision, false, &k->m[precision], e));
    double begun = dar_log_clock();
    dar_status status = run(k->j, k->m[precision], &set, s, latent, pictures, 1, &row, e);
    *seconds = status == DAR_OK ? row.v[WORK_SECONDS] : dar_log_clock() - begun;
    *estimate = row.v[WORK_ESTIMATE];
    return status;
}

static dar_status hold(struct job *j, dar_err *e)
{
    const work_size how = { (int)size[0], (int)size[1], (size_t)frames, common.seed };
    struct kept k = { .j = j };
    dar_front f;
    work_promise p;
    dar_status s = DAR_OK;
    work_front(&j->table, j->file.c.name, safety, &f);
    j->progress = dar_progress_begin("held", "scenes", (double)held);
    for (size_t i = 0; i < (size_t)held && s == DAR_OK; i++) {
        s = work_held(&f, out, i, &how, &j->file.c, render_held, &k, e);
        if (s == DAR_OK) dar_progress_step(&j->progress, (double)(i + 1), NULL);
    }
    for (int i = 0; i < PRECISIONS; i++) dar_model_close(k.m[i]);
    if (s == DAR_OK) s = work_held_sum(out, &p, e);
    if (s != DAR_OK) return s;
    dar_progress_end(&j->progress);
    dar_run_say(j->r,
                "held out: %zu budgets, %zu exceeded; the largest error is %.2f of its budget, the longest time %.2f "
                "of the full run's",
                p.rows, p.broken, p.error, p.time);
    if (!p.broken) return DAR_OK;
    return dar_fail(e, DAR_ERR_CHECK, "%s/held.csv: %zu of %zu errors exceed their budgets", out, p.broken, p.rows);
}

/* ---------------------------------------------------------------- all */

static dar_status read_model(struct job *j, dar_err *e)
{
    const work_size how = { (int)size[0], (int)size[1], (size_t)frames, common.seed };
    char sum[DAR_SHA256_TEXT], recipes[WORK_KEY];
    dar_model *m;
    dar_condition_read(&j->condition, dar_json_object(dar_json_root(j->file.doc), "condition"));
    DAR_TRY(dar_json_finish(j->file.doc, e));
    dar_model_feed feed = { DAR_RAYS_GROUP, DAR_RAYS_CHANNELS, (int64_t)j->condition.set.channels };
    DAR_TRY(dar_model_file_check(&j->file, &feed, e));
    DAR_TRY(open_model(j, F32, true, &m, e));
    dar_status s = DAR_OK;
    if (*m->path[DAR_MODEL_DIT]) s = dar_sha256_file(m->path[DAR_MODEL_DIT], sum, e);
    else s = dar_fail(e, DAR_ERR_USAGE, "%s: found no weights", model_path);
    dar_model_close(m);
    if (s == DAR_OK) s = work_recipes(&how, recipes, e);
    if (s == DAR_OK)
        snprintf(j->model, sizeof j->model, "%.20s %.8s %dx%dx%d %s", j->file.c.name, sum, (int)size[0], (int)size[1],
                 (int)frames, recipes);
    return s;
}

static dar_status open_scenes(struct job *j, dar_err *e)
{
    const work_size how = { (int)size[0], (int)size[1], (size_t)frames, common.seed };
    char directory[PATH_MAX];
    size_t latent = 0, pixels = 0;
    snprintf(directory, sizeof directory, "%.*s/scenes", PATH_MAX - 16, out);
    DAR_TRY(dar_dir_make(directory, e));
    snprintf(directory, sizeof directory, "%.*s/pictures", PATH_MAX - 16, out);
    DAR_TRY(dar_dir_make(directory, e));
    snprintf(directory, sizeof directory, "%.*s/scenes", PATH_MAX - 16, out);
    j->scenes = (size_t)scenes < work_scenes() ? (size_t)scenes : work_scenes();
    if (!(j->scene = calloc(j->scenes, sizeof *j->scene))) return dar_fail(e, DAR_ERR_NOMEM, "out of memory");
    for (size_t i = 0; i < j->scenes; i++) {
        work_scene *s = &j->scene[i];
        DAR_TRY(work_scene_open(s, i, directory, &how, &j->file.c, e));
        DAR_TRY(write_picture(s, "truth", s->truth, e));
        size_t n = 3 * s->b->meta.frames * (size_t)(size[0] * size[1]);
        if (s->latent > latent) latent = s->latent;
        if (n > pixels) pixels = n;
    }
    j->latent = calloc(latent, sizeof *j->latent);
    j->frames = malloc(pixels);
    return j->latent && j->frames ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "out of memory");
}

static dar_status measure(struct job *j, dar_err *e)
{
    setting set[MOST];
    const size_t n = list_settings(set);
    DAR_TRY(open_scenes(j, e));
    dar_run_say(j->r, "%s: %zu settings, %zu scenes; %zu rows are to be measured", j->model, n, j->scenes,
                missing(j, set, n, -1));
    if (common.dry_run) return DAR_OK;
    DAR_TRY(refer(j, set, n, e));
    return measure_rows(j, set, n, e);
}

static void say_equal(const struct job *j)
{
    work_equal x[MOST];
    const work_ratio r = work_equal_ratio(x, work_equals(&j->table, x, MOST));
    dar_run_say(j->r, "%s/work_precision.html, .svg, .csv, .json; equal_calls.csv, pareto.json", out);
    if (r.n)
        dar_run_say(j->r, "with no more calls, our error is %.2g of that of %zu published caches, at worst %.2g",
                    r.mean, r.n, r.worst);
}

static dar_status bench(dar_run *r, dar_err *e)
{
    struct job j = { .r = r };
    char path[PATH_MAX];
    snprintf(path, sizeof path, "%.*s/work_precision.csv", PATH_MAX - 32, out);
    dar_status s = dar_model_file_open(&j.file, model_path, e);
    if (s == DAR_OK) s = read_model(&j, e);
    if (s == DAR_OK) s = dar_dir_make(out, e);
    if (s == DAR_OK) s = work_open(&j.table, path, j.model, e);
    if (s == DAR_OK && !only_report) s = measure(&j, e);
    if (s == DAR_OK && !common.dry_run) s = work_report(&j.table, out, j.file.c.name, safety, front_path, e);
    if (s == DAR_OK && !common.dry_run) say_equal(&j);
    if (s == DAR_OK && !common.dry_run && held) s = hold(&j, e);
    for (size_t i = 0; j.scene && i < j.scenes; i++) work_scene_close(&j.scene[i]);
    work_close(&j.table);
    dar_model_file_close(&j.file);
    free(j.scene);
    free(j.latent);
    free(j.frames);
    return s;
}

int main(int argc, char **argv)
{
    static const dar_program program = {
        .name = "speed_sample",
        .summary = "Measure run time against error.",
        .options = options,
        .n_options = DAR_COUNT(options),
        .common = &common,
        .standard_seed = "42",
        .run = bench,
    };
    return dar_program_main(&program, argc, argv);
}
