/* dar_bundle_synth.c: sets of synthetic bundles.
 *
 * A bundle is made and checked in a directory beside the others, then renamed: one that has its own name is finished,
 * and says in meta.json, "qc", how it was made.  So a run that died goes on where it was, and the manifest is told from
 * the bundles alone.
 *
 * Every thread makes bundles of its own: frames are small, and threads that share one wait for each other. */
#include <errno.h>
#include <math.h>
#include <pthread.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "data/dar_bundle.h"
#include "data/quality.h"
#include "data/sheet.h"
#include "data/synth_film.h"
#include "data/synth_set.h"
#include "lib/dir.h"
#include "lib/file.h"
#include "lib/json.h"
#include "lib/log.h"
#include "lib/thread.h"

#define MAKING   ".making"
#define ANY      "any" /* family asked for */
#define ATTEMPTS 8     /* scenes for one bundle */
#define MOST     1e7   /* bundles */
#define COLUMNS  8     /* of the contact sheet */
#define CELLS    96    /* of the contact sheet, at most */
#define CELL     224   /* width [px] */

static struct {
    const char *out, *family, *sheet;
    int64_t count, size[2], frames;
    double fps;
    int set;
    bool coarse;
    dar_common common;
} o;

/* clang-format off */
static const dar_option options[] = {
    { .name = "out", .letter = 'o', .placeholder = "DIR", .type = DAR_ARG_TEXT, .target = &o.out,
      .help = "directory of the set; bundles that are there stay" },
    { .name = "set", .placeholder = "NAME", .type = DAR_ARG_CHOICE, .target = &o.set, .standard = "train",
      .names = dar_synth_set_names, .help = "train: any number, all different; 4d_vis: 17 scenes x 4 "
      "camera paths; ood34: 17 scenes of other kinds x 2; refvar: one scene and path, 10 appearances; "
      "motion-separation: 5 animations x 5 paths; correspondence: 16 large orbits" },
    { .name = "count", .placeholder = "N", .type = DAR_ARG_INT, .target = &o.count, .lo = 1, .hi = MOST,
      .help = "number of bundles (default: all of the set; of train 100)" },
    { .name = "family", .placeholder = "NAME", .type = DAR_ARG_TEXT, .target = &o.family,
      .help = "train: subjects of this family only, such as humanoid, quadruped, vehicle, mechanism, cloth" },
    { .name = "coarse", .type = DAR_ARG_FLAG, .target = &o.coarse,
      .help = "for small networks and pictures: one subject with little around it, seen from near, in patterns of few "
      "and large figures" },
    { .name = "size", .placeholder = "WxH", .type = DAR_ARG_SIZE, .target = o.size, .standard = "224x128",
      .lo = 16, .hi = DAR_RASTER_MAX_SIDE / DAR_SHADE_SAMPLES, .help = "of the pictures [px]" },
    { .name = "frames", .placeholder = "N", .type = DAR_ARG_INT, .target = &o.frames, .standard = "17",
      .lo = 2, .hi = DAR_BUNDLE_MAX_FRAMES, .help = "frames of a bundle" },
    { .name = "fps", .placeholder = "F", .type = DAR_ARG_NUMBER, .target = &o.fps, .standard = "16",
      .lo = 1, .hi = 1000, .help = "frames per second" },
    { .name = "sheet", .placeholder = "PNG", .type = DAR_ARG_TEXT, .target = &o.sheet,
      .help = "also draw a contact sheet: first pictures of up to 96 bundles" },
};
/* clang-format on */

/* Where the time of a bundle went [s]. */
struct times {
    double make, check, render[DAR_RENDER_STAGES];
};

/* Of the run. */
struct job {
    const dar_synth_set *set;
    dar_synth_plan plan;          /* what all bundles share */
    size_t count, *missing, todo; /* missing: numbers of the bundles, todo of them */
    dar_dir_out making;           /* never gets its name: what is in it moves out */

    /* What threads share. */
    pthread_mutex_t lock;
    dar_progress progress;
    struct times sum;
    size_t made;
    dar_status status; /* the first failure, told in e */
    dar_err *e;
};

static void name_of(char path[PATH_MAX], size_t index)
{
    snprintf(path, PATH_MAX, "%s/%06zu", o.out, index);
}

static bool is_there(const char *path)
{
    struct stat st;
    return lstat(path, &st) == 0;
}

/* ---------------------------------------------------------------- one bundle */

/* Of one attempt; why: empty if it is good. */
struct attempt {
    struct times times;
    dar_quality quality;
    char why[DAR_QUALITY_TEXT];
};

static dar_status judge(const char *path, struct attempt *a, dar_err *e)
{
    dar_bundle *b;
    DAR_TRY(dar_bundle_open(&b, path, e));
    dar_status s = dar_quality_check(&a->quality, b, e);
    dar_bundle_close(b);
    for (int i = 0; s == DAR_OK && i < DAR_QUALITY_CHECKS && !a->why[0]; i++)
        if (a->quality.result[i].state == DAR_QUALITY_BAD) dar_quality_text(&a->quality, (dar_quality_name)i, a->why);
    return s;
}

static void say_what(const dar_synth *s, dar_json_writer *w)
{
    dar_json_write_text(w, "kind", s->thing[0].kind->name);
    dar_json_write_text(w, "family", s->thing[0].kind->family);
    dar_json_write_text(w, "asked", o.family ? o.family : ANY);
    if (o.coarse) dar_json_write_bool(w, "coarse", true);
    dar_json_write_text(w, "lights", s->lights);
    dar_json_write_int(w, "things", (int64_t)s->things);
    dar_json_write_int(w, "dropped", (int64_t)s->dropped);
}

/* Make bundle `index` at path.  A scene that cannot be filmed, or a bundle that is not fit, is no failure. */
static dar_status attempt(const struct job *j, size_t index, size_t n, const char *path, struct attempt *a,
                          dar_json_writer *w, dar_err *e)
{
    dar_synth s;
    dar_synth_plan plan = j->plan;
    dar_render_report report;
    double begun = dar_log_clock();
    a->why[0] = 0;
    dar_synth_set_plan(j->set, o.common.seed, index, n, o.family, &plan);
    dar_status status = dar_synth_make(&s, &plan, e);
    a->times.make += dar_log_clock() - begun;
    if (status == DAR_OK) {
        status = dar_synth_film(&s, &plan, j->set->name, path, &report, e);
        for (int i = 0; i < DAR_RENDER_STAGES; i++) a->times.render[i] += report.seconds[i];
        begun = dar_log_clock();
        if (status == DAR_OK) status = judge(path, a, e);
        a->times.check += dar_log_clock() - begun;
    } else if (status == DAR_ERR_CHECK) {
        snprintf(a->why, sizeof a->why, "camera: %s", e->text);
        status = DAR_OK;
    }
    if (status == DAR_OK && !a->why[0]) say_what(&s, w);
    dar_synth_free(&s);
    return status;
}

static dar_status finish(const char *from, const char *to, dar_json_writer *w, dar_err *e)
{
    int error = 0;
    if (w->failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", to);
    DAR_TRY(dar_bundle_set_quality(from, w->text, e));
    if (rename(from, to) != 0) error = errno;
    if (!error) error = dar_file_flush_entry(to);
    return error ? dar_fail(e, DAR_ERR_IO, "%s: %s", to, strerror(error)) : DAR_OK;
}

static dar_status make_one(const struct job *j, size_t index, struct attempt *a, dar_err *e)
{
    char making[PATH_MAX], path[PATH_MAX];
    dar_json_writer w = { 0 }, good = { 0 };
    dar_status s = DAR_OK;
    size_t n = 0;
    name_of(path, index);
    if (snprintf(making, sizeof making, "%s/%06zu", j->making.temp, index) >= (int)sizeof making)
        return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(ENAMETOOLONG));
    dar_json_write_object(&w, NULL);
    dar_json_write_array(&w, "rejected");
    for (; n < ATTEMPTS; n++) {
        dar_json_writer_reset(&good);
        dar_json_write_object(&good, NULL);
        s = attempt(j, index, n, making, a, &good, e);
        dar_json_write_end(&good);
        if (s != DAR_OK || !a->why[0]) break;
        dar_json_write_text(&w, NULL, a->why);
    }
    dar_json_write_end(&w);
    if (s == DAR_OK && n == ATTEMPTS)
        s = dar_fail(e, DAR_ERR_CHECK, "%s: none of %d scenes was fit; the last: %s", path, ATTEMPTS, a->why);
    if (s == DAR_OK) {
        dar_json_doc *doc;
        s = dar_json_parse(&doc, "made", good.text, good.size, e);
        if (s == DAR_OK) dar_json_write_value(&w, "made", dar_json_root(doc));
        dar_json_close(s == DAR_OK ? doc : NULL);
        dar_quality_print(&a->quality, &w, "quality");
        dar_json_write_end(&w);
    }
    if (s == DAR_OK) s = finish(making, path, &w, e);
    dar_json_writer_free(&good);
    dar_json_writer_free(&w);
    return s;
}

/* ---------------------------------------------------------------- all bundles */

static void note(struct job *j, const struct times *x, dar_status s, const dar_err *e)
{
    pthread_mutex_lock(&j->lock);
    if (s == DAR_OK) {
        j->sum.make += x->make;
        j->sum.check += x->check;
        for (int i = 0; i < DAR_RENDER_STAGES; i++) j->sum.render[i] += x->render[i];
        dar_progress_step(&j->progress, (double)++j->made, NULL);
    } else if (j->status == DAR_OK) {
        j->status = s;
        *j->e = *e;
    }
    pthread_mutex_unlock(&j->lock);
}

static bool goes_on(struct job *j)
{
    pthread_mutex_lock(&j->lock);
    bool good = j->status == DAR_OK;
    pthread_mutex_unlock(&j->lock);
    return good && !dar_interrupted();
}

static void make_task(void *ctx, size_t i, int thread)
{
    struct job *j = ctx;
    struct attempt a = { 0 };
    dar_err e;
    (void)thread;
    if (!goes_on(j)) return;
    dar_status s = make_one(j, j->missing[i], &a, &e);
    note(j, &a.times, s, &e);
}

/* Every thread makes a bundle at a time, and waits for its encoder and for the disk meanwhile: for every eight there is
 * one more.  With fewer bundles than threads all threads make one. */
static void make_missing(struct job *j)
{
    const int threads = dar_threads();
    if (j->todo < (size_t)threads) {
        for (size_t i = 0; i < j->todo; i++) make_task(j, i, 0);
        return;
    }
    if (threads > 1) dar_threads_set(threads + (threads + 7) / 8);
    dar_parallel(j->todo, make_task, j);
    dar_threads_set(threads);
}

static dar_status make_all(struct job *j, dar_err *e)
{
    char path[PATH_MAX];
    snprintf(path, sizeof path, "%s/" MAKING, o.out);
    DAR_TRY(dar_dir_create(&j->making, path, e));
    j->e = e;
    j->progress = dar_progress_begin("synth", "bundles", (double)j->todo);
    make_missing(j);
    if (dar_interrupted())
        return dar_fail(e, DAR_ERR_INTERRUPTED, "%s: interrupted after %zu of %zu bundles; the same command goes on",
                        o.out, j->count - j->todo + j->made, j->count);
    if (j->status == DAR_OK) dar_progress_end(&j->progress);
    return j->status;
}

/* A bundle that is there must be the one that would be made. */
static dar_status check_found(const struct job *j, size_t index, const char *path, dar_err *e)
{
    char file[PATH_MAX + 16];
    dar_synth_plan p = j->plan;
    dar_json_doc *doc;
    dar_status s = DAR_OK;
    snprintf(file, sizeof file, "%s/meta.json", path);
    DAR_TRY(dar_json_open(&doc, file, e));
    dar_json root = dar_json_root(doc), qc = dar_json_object(root, "qc"), made = dar_json_object(qc, "made");
    dar_synth_set_plan(j->set, o.common.seed, index, dar_json_size(dar_json_array(qc, "rejected")), o.family, &p);
    const struct {
        const char *option;
        bool same;
    } check[] = {
        { "--size", dar_json_int(root, "width", 0, 0, INT32_MAX) == p.width &&
                        dar_json_int(root, "height", 0, 0, INT32_MAX) == p.height },
        { "--frames", dar_json_int(root, "frames", 0, 0, INT32_MAX) == (int64_t)p.frames },
        { "--fps", dar_json_number(root, "fps", 0, 0, INFINITY) == p.fps },
        { "--family", strcmp(dar_json_text(made, "asked", ANY), o.family ? o.family : ANY) == 0 },
        { "--coarse", dar_json_bool(made, "coarse", false) == p.coarse },
        { "--set or --seed", (uint64_t)dar_json_int(root, "seed", -1, 0, DAR_BUNDLE_MAX_SEED) == p.seed &&
                                 (!p.subject || strcmp(dar_json_text(made, "kind", ""), p.subject->name) == 0) },
    };
    for (size_t i = 0; i < DAR_COUNT(check) && s == DAR_OK; i++)
        if (!check[i].same)
            s = dar_fail(e, DAR_ERR_USAGE, "%s: found a bundle made with another %s, expected what this command makes",
                         path, check[i].option);
    dar_json_close(doc);
    return s;
}

static dar_status find_missing(struct job *j, dar_err *e)
{
    char path[PATH_MAX];
    j->missing = calloc(j->count, sizeof *j->missing);
    if (!j->missing) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory for %zu bundles", o.out, j->count);
    for (size_t i = 0; i < j->count; i++) {
        name_of(path, i);
        if (is_there(path)) DAR_TRY(check_found(j, i, path, e));
        else j->missing[j->todo++] = i;
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- the manifest */

/* How often a text was met. */
struct tally {
    struct {
        char name[64];
        int64_t n;
    } row[128];
    size_t rows;
};

static void count(struct tally *t, const char *name)
{
    size_t i = 0;
    while (i < t->rows && strncmp(t->row[i].name, name, sizeof t->row[i].name - 1) != 0) i++;
    if (i == DAR_COUNT(t->row)) return;
    if (i == t->rows) snprintf(t->row[t->rows++].name, sizeof t->row[i].name, "%s", name);
    t->row[i].n++;
}

static int by_name(const void *a, const void *b)
{
    return strcmp(a, b); /* a row begins with its name */
}

static void print_tally(struct tally *t, dar_json_writer *w, const char *key)
{
    qsort(t->row, t->rows, sizeof *t->row, by_name);
    dar_json_write_object(w, key);
    for (size_t i = 0; i < t->rows; i++) dar_json_write_int(w, t->row[i].name, t->row[i].n);
    dar_json_write_end(w);
}

struct manifest {
    dar_json_writer w;
    struct tally family, kind, path, lights, reason;
    int64_t rejected;
};

static dar_status list_one(struct manifest *m, size_t index, dar_err *e)
{
    char path[PATH_MAX], file[PATH_MAX + 16];
    dar_json_doc *doc;
    name_of(path, index);
    snprintf(file, sizeof file, "%s/meta.json", path);
    DAR_TRY(dar_json_open(&doc, file, e));
    dar_json root = dar_json_root(doc), qc = dar_json_object(root, "qc"), made = dar_json_object(qc, "made");
    dar_json rejected = dar_json_array(qc, "rejected");
    const char *kind = dar_json_text(made, "kind", "unknown"), *family = dar_json_text(made, "family", "unknown");
    const char *trajectory = dar_json_text(root, "trajectory", "unknown");
    dar_json_write_object(&m->w, NULL);
    dar_json_write_text(&m->w, "bundle", strrchr(path, '/') + 1);
    dar_json_write_text(&m->w, "family", family);
    dar_json_write_text(&m->w, "kind", kind);
    dar_json_write_text(&m->w, "trajectory", trajectory);
    dar_json_write_int(&m->w, "rejected", (int64_t)dar_json_size(rejected));
    dar_json_write_end(&m->w);
    count(&m->family, family);
    count(&m->kind, kind);
    count(&m->path, trajectory);
    count(&m->lights, dar_json_text(made, "lights", "unknown"));
    for (dar_json x = dar_json_first(rejected); x.item; x = dar_json_next(x)) {
        char check[32];
        const char *why = dar_json_text(x, NULL, "unknown");
        snprintf(check, sizeof check, "%.*s", (int)strcspn(why, ":"), why);
        count(&m->reason, check);
        m->rejected++;
    }
    dar_json_close(doc);
    return DAR_OK;
}

static dar_status write_text(const char *path, const char *text, size_t size, dar_err *e)
{
    dar_file_out f;
    dar_status s = dar_file_create(&f, path, e);
    if (s == DAR_OK) s = dar_file_write(&f, text, size, e);
    if (s == DAR_OK) s = dar_file_commit(&f, e);
    dar_file_discard(&f);
    return s;
}

static dar_status write_manifest(struct job *j, struct manifest *m, dar_err *e)
{
    char path[PATH_MAX];
    dar_json_write_object(&m->w, NULL);
    dar_json_write_text(&m->w, "set", j->set->name);
    dar_json_write_int(&m->w, "seed", (int64_t)(o.common.seed & DAR_BUNDLE_MAX_SEED));
    dar_json_write_int(&m->w, "bundles", (int64_t)j->count);
    dar_json_write_int(&m->w, "width", j->plan.width);
    dar_json_write_int(&m->w, "height", j->plan.height);
    dar_json_write_int(&m->w, "frames", (int64_t)j->plan.frames);
    dar_json_write_number(&m->w, "fps", j->plan.fps);
    if (o.coarse) dar_json_write_bool(&m->w, "coarse", true);
    dar_json_write_array(&m->w, "list");
    for (size_t i = 0; i < j->count; i++) DAR_TRY(list_one(m, i, e));
    dar_json_write_end(&m->w);
    dar_json_write_int(&m->w, "rejected", m->rejected);
    print_tally(&m->reason, &m->w, "reasons");
    print_tally(&m->family, &m->w, "families");
    print_tally(&m->kind, &m->w, "kinds");
    print_tally(&m->path, &m->w, "trajectories");
    print_tally(&m->lights, &m->w, "lights");
    dar_json_write_end(&m->w);
    if (m->w.failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", o.out);
    snprintf(path, sizeof path, "%s/manifest.json", o.out);
    return write_text(path, m->w.text, m->w.size, e);
}

/* ---------------------------------------------------------------- the contact sheet */

static dar_status draw_one(dar_sheet *sheet, size_t cell, size_t index, dar_err *e)
{
    char path[PATH_MAX];
    dar_bundle *b;
    name_of(path, index);
    DAR_TRY(dar_bundle_open(&b, path, e));
    size_t width = (size_t)b->meta.width, height = (size_t)b->meta.height;
    uint8_t *rgb = malloc(3 * width * height);
    dar_status s = rgb ? dar_bundle_rgb(b, 0, rgb, e) : dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    if (s == DAR_OK) dar_sheet_picture(sheet, cell / COLUMNS, cell % COLUMNS, rgb, width, height, DAR_SHRINK_MEAN);
    free(rgb);
    dar_bundle_close(b);
    return s;
}

static dar_status draw_sheet(const struct job *j, dar_err *e)
{
    char title[128];
    size_t cells = j->count < CELLS ? j->count : CELLS;
    double height = floor((double)CELL * j->plan.height / j->plan.width + 0.5);
    dar_sheet sheet;
    snprintf(title, sizeof title, "%s, seed %llu: %zu of %zu bundles", j->set->name, (unsigned long long)o.common.seed,
             cells, j->count);
    const dar_sheet_plan plan = { title, NULL, (cells + COLUMNS - 1) / COLUMNS, COLUMNS, CELL, (size_t)height };
    DAR_TRY(dar_sheet_init(&sheet, &plan, e));
    dar_status s = DAR_OK;
    for (size_t i = 0; i < cells && s == DAR_OK; i++) {
        size_t index = i * j->count / cells;
        if (i % COLUMNS == 0) {
            snprintf(title, sizeof title, "%06zu", index);
            dar_sheet_row(&sheet, i / COLUMNS, title, NULL);
        }
        s = draw_one(&sheet, i, index, e);
    }
    if (s == DAR_OK) s = dar_sheet_write(&sheet, o.sheet, e);
    dar_sheet_free(&sheet);
    return s;
}

/* ---------------------------------------------------------------- */

static dar_status prepare(struct job *j, const dar_run *r, dar_err *e)
{
    j->set = &dar_synth_sets[o.set];
    size_t all = j->set->rows * j->set->columns;
    if (!o.out) return dar_fail(e, DAR_ERR_USAGE, "%s: expected -o DIR", r->program->name);
    if (all && o.count > (int64_t)all)
        return dar_fail(e, DAR_ERR_USAGE, "%s: --count: found %lld, the set %s has %zu", r->program->name,
                        (long long)o.count, j->set->name, all);
    if (o.family && (all || !dar_synth_set_has(o.family)))
        return dar_fail(e, DAR_ERR_USAGE,
                        "%s: --family: found '%s', expected a family of the set train, such as "
                        "humanoid, quadruped, vehicle, mechanism",
                        r->program->name, o.family);
    j->count = o.count ? (size_t)o.count : all ? all : 100;
    j->plan = dar_synth_standard();
    j->plan.width = (int)o.size[0], j->plan.height = (int)o.size[1];
    j->plan.frames = (size_t)o.frames;
    j->plan.fps = o.fps;
    j->plan.coarse = o.coarse;
    return DAR_OK;
}

static void tell(const struct job *j, const struct manifest *m, dar_run *r, double seconds)
{
    const struct times *x = &j->sum;
    double each = j->made ? 1.0 / (double)j->made : 0;
    dar_run_say(r, "%s: %zu bundles of %d x %d, %zu frames: %zu made, %zu were there, %lld scenes rejected, %.1f s",
                o.out, j->count, j->plan.width, j->plan.height, j->plan.frames, j->made, j->count - j->made,
                (long long)m->rejected, seconds);
    dar_json_write_text(&r->json, "set", j->set->name);
    dar_json_write_int(&r->json, "bundles", (int64_t)j->count);
    dar_json_write_int(&r->json, "made", (int64_t)j->made);
    dar_json_write_int(&r->json, "rejected", m->rejected);
    if (!j->made) return;
    dar_run_say(r, "each: %.3f s; of one thread: make %.3f, draw %.3f, tracks %.3f, shade %.3f, write %.3f, check %.3f",
                seconds * each, x->make * each, x->render[DAR_RENDER_DRAW] * each, x->render[DAR_RENDER_TRACKS] * each,
                x->render[DAR_RENDER_PICTURE] * each, x->render[DAR_RENDER_WRITE] * each, x->check * each);
    dar_json_write_object(&r->json, "seconds");
    dar_json_write_number(&r->json, "all", seconds);
    dar_json_write_number(&r->json, "make", x->make);
    for (int i = 0; i < DAR_RENDER_STAGES; i++) dar_json_write_number(&r->json, dar_render_stage_name[i], x->render[i]);
    dar_json_write_number(&r->json, "check", x->check);
    dar_json_write_end(&r->json);
}

static dar_status fill(struct job *j, dar_run *r, dar_err *e)
{
    struct manifest *m = calloc(1, sizeof *m);
    double begun = dar_log_clock();
    if (!m) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", r->program->name);
    dar_status s = find_missing(j, e);
    if (s == DAR_OK) s = make_all(j, e);
    dar_dir_discard(&j->making);
    double seconds = dar_log_clock() - begun;
    if (s == DAR_OK) s = write_manifest(j, m, e);
    if (s == DAR_OK && o.sheet) s = draw_sheet(j, e);
    if (s == DAR_OK) tell(j, m, r, seconds);
    dar_json_writer_free(&m->w);
    free(m);
    return s;
}

static dar_status synth(dar_run *r, dar_err *e)
{
    struct job j = { .lock = PTHREAD_MUTEX_INITIALIZER };
    int lock;
    DAR_TRY(prepare(&j, r, e));
    if (o.common.dry_run) {
        dar_run_say(r, "%s: %zu bundles of the set %s", o.out, j.count, j.set->name);
        return DAR_OK;
    }
    DAR_TRY(dar_dir_make(o.out, e));
    DAR_TRY(dar_dir_lock(&lock, o.out, e));
    dar_status s = fill(&j, r, e);
    close(lock);
    free(j.missing);
    return s;
}

const dar_program dar_command_synth = {
    .name = "dar-bundle synth",
    .summary = "Make synthetic bundles with pictures: animated scenes, cameras and lights drawn from a seed.",
    .options = options,
    .n_options = DAR_COUNT(options),
    .common = &o.common,
    .run = synth,
};
