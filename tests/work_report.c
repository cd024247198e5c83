/* work_report.c: what the rows say: the front, drawings, a page. */
#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "infer/dar_eval_html.h"
#include "lib/file.h"
#include "lib/plot.h"
#include "tests/work.h"

#define MOST     128  /* settings; scenes */
#define ROUNDING 1e-6 /* an error below is not drawn */

/* A setting over the scenes of a kind. */
struct mean {
    const work_row *row; /* of one of them */
    size_t scenes;
    double time, psnr_truth;     /* share of the full run's time, geometric mean; mean change [dB] */
    double error, ode, estimate; /* the largest */
    double psnr, ssim, flip;     /* the worst */
    double calls;                /* share of the full run's, mean */
    double class[WORK_CLASSES];  /* the largest */
};

static bool of_kind(const work_row *r, int kind)
{
    return kind == DAR_FRONT_ANY || (r->v[WORK_CAMERA_STILL] > 0) == (kind == DAR_FRONT_STILL);
}

/* NaN stays. */
static double larger(double a, double b)
{
    return isnan(a) || isnan(b) ? NAN : fmax(a, b);
}

static double smaller(double a, double b)
{
    return -larger(-a, -b);
}

/* Settings in the order in which they were first measured; returns how many. */
static size_t collect(const work_table *t, int kind, struct mean *m)
{
    size_t n = 0, i;
    for (size_t k = 0; k < t->n; k++) {
        const work_row *r = &t->row[k], *full = work_find(t, r->text[WORK_SCENE], WORK_FULL);
        if (!full || !of_kind(r, kind)) continue;
        for (i = 0; i < n && strcmp(m[i].row->text[WORK_SETTING], r->text[WORK_SETTING]) != 0; i++) continue;
        if (i == MOST) continue;
        if (i == n) {
            m[n++] = (struct mean){ .row = r, .ssim = INFINITY, .psnr = INFINITY };
            for (int c = 0; c < WORK_CLASSES; c++) m[i].class[c] = NAN;
        }
        m[i].scenes++;
        m[i].time += log(r->v[WORK_SECONDS] / full->v[WORK_SECONDS]);
        m[i].psnr_truth += r->v[WORK_PSNR_TRUTH] - full->v[WORK_PSNR_TRUTH];
        m[i].calls += r->v[WORK_CALLS] / full->v[WORK_CALLS];
        m[i].error = larger(m[i].error, r->v[WORK_ERROR]);
        m[i].ode = larger(m[i].ode, r->v[WORK_ODE]);
        m[i].estimate = larger(m[i].estimate, r->v[WORK_ESTIMATE]);
        m[i].flip = larger(m[i].flip, r->v[WORK_FLIP]);
        m[i].psnr = smaller(m[i].psnr, r->v[WORK_PSNR]);
        m[i].ssim = smaller(m[i].ssim, r->v[WORK_SSIM]);
        for (int c = 0; c < WORK_CLASSES; c++) m[i].class[c] = larger(m[i].class[c], r -> v[WORK_EMPTY + c]);
    }
    for (i = 0; i < n; i++) {
        m[i].time = exp(m[i].time / (double)m[i].scenes);
        m[i].psnr_truth /= (double)m[i].scenes;
        m[i].calls /= (double)m[i].scenes;
    }
    return n;
}

static const struct mean *find(const struct mean *m, size_t n, const char *setting)
{
    for (size_t i = 0; i < n; i++)
        if (strcmp(m[i].row->text[WORK_SETTING], setting) == 0) return &m[i];
    return NULL;
}

static bool is_cache(const work_row *r)
{
    return strcmp(r->text[WORK_REUSE], dar_reuse_name[DAR_REUSE_NONE]) != 0;
}

/* With all skips and threads. */
static bool is_whole(const work_row *r)
{
    return strcmp(r->text[WORK_SKIPS], "all") == 0 && r->v[WORK_THREADS] == 0;
}

/* ---------------------------------------------------------------- published caches */

static bool is_ours(const work_row *r)
{
    const bool euler = strcmp(r->text[WORK_SOLVER], dar_solver_name[DAR_EULER]) == 0;
    return is_whole(r) && !is_cache(r) && (!euler || r->v[WORK_TOLERANCE] > 0);
}

static work_equal equal_of(const struct mean *m, size_t n, const struct mean *cache)
{
    const struct mean *best = NULL;
    for (size_t i = 0; i < n; i++)
        if (is_ours(m[i].row) && m[i].scenes == cache->scenes && m[i].calls <= cache->calls &&
            strcmp(m[i].row->text[WORK_PRECISION], cache->row->text[WORK_PRECISION]) == 0 &&
            m[i].error < (best ? best->error : INFINITY))
            best = &m[i];
    return (work_equal){ .cache = cache->row->text[WORK_SETTING],
                         .ours = best ? best->row->text[WORK_SETTING] : NULL,
                         .calls = { cache->calls, best ? best->calls : NAN },
                         .error = { cache->error, best ? best->error : NAN } };
}

size_t work_equals(const work_table *t, work_equal *x, size_t most)
{
    struct mean m[MOST];
    const size_t n = collect(t, DAR_FRONT_ANY, m);
    size_t k = 0;
    for (size_t i = 0; i < n && k < most; i++)
        if (is_cache(m[i].row)) x[k++] = equal_of(m, n, &m[i]);
    return k;
}

work_ratio work_equal_ratio(const work_equal *x, size_t n)
{
    work_ratio r = { .worst = NAN };
    double sum = 0;
    for (size_t i = 0; i < n; i++) {
        const double ratio = x[i].error[1] / x[i].error[0];
        if (!x[i].ours) continue;
        r.worst = r.n++ ? larger(r.worst, ratio) : ratio;
        sum += log(ratio);
    }
    r.mean = exp(sum / (double)r.n);
    return r;
}

/* ---------------------------------------------------------------- the front */

static int by_time(const void *a, const void *b)
{
    double x = ((const struct mean *)a)->time, y = ((const struct mean *)b)->time;
    return (x > y) - (x < y);
}

/* What the sampler may choose: on all threads with all skips, not a cache, and measured on every scene of the kind.  It
 * makes the full run's steps, all or those that its guard leaves; or its error is estimated, and if it is found out at
 * the last step, all of those steps after it take no longer than the full run. */
static bool eligible(const struct mean *m, size_t n, const struct mean *x, size_t scenes)
{
    const work_row *r = x->row;
    char plain[2 * WORK_TEXT];
    if (!is_whole(r) || is_cache(r)) return false;
    if (x->scenes != scenes || !isfinite(x->error)) return false;
    if (strcmp(r->text[WORK_SOLVER], dar_solver_name[DAR_EULER]) == 0) return r->v[WORK_STEPS] >= 50;
    snprintf(plain, sizeof plain, "%s euler-50", r->text[WORK_PRECISION]);
    const struct mean *after = find(m, n, plain);
    return r->v[WORK_TOLERANCE] > 0 && after && x->time + after->time <= 1;
}

static int index_of(const char *name, const char *const *names)
{
    int i = 0;
    while (names[i] && strcmp(names[i], name) != 0) i++;
    return i;
}

static dar_front_setting setting_of(const struct mean *m)
{
    const work_row *r = m->row;
    return (dar_front_setting){ .name = r->text[WORK_SETTING],
                                .precision = index_of(r->text[WORK_PRECISION], dar_pipeline_precision),
                                .solver = (dar_solver_kind)index_of(r->text[WORK_SOLVER], dar_solver_name),
                                .steps = (size_t)r->v[WORK_STEPS],
                                .tolerance = r->v[WORK_TOLERANCE],
                                .guidance_tolerance = r->v[WORK_GUIDANCE_TOLERANCE],
                                .time = m->time,
                                .error = m->error,
                                .estimate = m->estimate,
                                .psnr = m->psnr };
}

/* Of each precision by itself, as a call of the program opens its model once for several scenes. */
static void fill_row(const work_table *t, int kind, dar_front_row *row)
{
    struct mean m[MOST];
    size_t n = collect(t, kind, m), scenes = 0;
    double least[DAR_PIPELINE_INT8 + 1];
    for (size_t i = 0; i < DAR_COUNT(least); i++) least[i] = INFINITY;
    row->visible[0] = INFINITY, row->visible[1] = 0;
    for (size_t k = 0; k < t->n; k++) {
        const work_row *r = &t->row[k];
        if (strcmp(r->text[WORK_SETTING], WORK_FULL) != 0 || !of_kind(r, kind)) continue;
        scenes++;
        row->visible[0] = fmin(row->visible[0], r->v[WORK_VISIBLE]);
        row->visible[1] = fmax(row->visible[1], r->v[WORK_VISIBLE]);
    }
    row->scenes = scenes;
    qsort(m, n, sizeof *m, by_time);
    for (size_t i = 0; i < n && row->settings < DAR_FRONT_MOST; i++) {
        dar_front_setting s = setting_of(&m[i]);
        if (!eligible(m, n, &m[i], scenes) || !(s.error < least[s.precision])) continue;
        least[s.precision] = s.error;
        row->setting[row->settings++] = s;
    }
}

void work_front(const work_table *t, const char *model, double safety, dar_front *f)
{
    *f = (dar_front){ .model = model, .safety = safety };
    for (int k = 0; k < DAR_FRONT_KINDS; k++) fill_row(t, k, &f->kind[k]);
}

/* ---------------------------------------------------------------- drawings */

/* Points of one precision and solver: with fewer steps, or with a tolerance on all of them. */
struct line {
    char label[3 * WORK_TEXT];
    size_t n;
    double x[MOST], y[MOST];
    const char *name[MOST];
};

struct drawing {
    struct line line[MOST];
    size_t lines;
    double floor[3][2], ends[2]; /* vertical lines */
};

typedef double coordinate(const struct mean *m);

static double error_of(const struct mean *m)
{
    return m->error;
}

static double ode_of(const struct mean *m)
{
    return m->ode;
}

static double psnr_of(const struct mean *m)
{
    return m->psnr;
}

static double change_of(const struct mean *m)
{
    return m->psnr_truth;
}

static void collect_lines(struct drawing *d, const struct mean *m, size_t n, coordinate *x)
{
    d->lines = 0;
    for (size_t i = 0; i < n; i++) {
        const work_row *r = m[i].row;
        char label[3 * WORK_TEXT];
        size_t k = 0;
        bool tolerance = r->v[WORK_TOLERANCE] > DAR_FRONT_WATCH, guided = r->v[WORK_GUIDANCE_TOLERANCE] > 0;
        if (!is_whole(r) || !(m[i].error > ROUNDING)) continue;
        if (is_cache(r))
            snprintf(label, sizeof label, "%s cache by %.*s", r->text[WORK_PRECISION],
                     (int)strcspn(r->text[WORK_REUSE], ":"), r->text[WORK_REUSE]);
        else
            snprintf(label, sizeof label, "%s %s, %s%s", r->text[WORK_PRECISION], r->text[WORK_SOLVER],
                     tolerance ? "tolerance" : "steps", guided ? ", guidance" : "");
        while (k < d->lines && strcmp(d->line[k].label, label) != 0) k++;
        struct line *l = &d->line[k];
        if (k == d->lines) {
            d->lines++;
            l->n = 0;
            memcpy(l->label, label, sizeof label);
        }
        l->x[l->n] = x(&m[i]);
        l->y[l->n] = m[i].time;
        l->name[l->n++] = r->text[WORK_SETTING];
    }
}

/* Settings in the order of time; with noise floors if x is the error. */
static dar_status draw(struct drawing *d, const struct mean *m, size_t n, coordinate *x, const dar_plot_axis *axis,
                       char **svg, dar_err *e)
{
    static const char *const floors[] = { "f64 euler-50", "bf16 euler-50", WORK_FULL };
    static const char *const labels[] = { "f64 against f32", "bf16 against f32", "full against the ODE" };
    dar_plot_series s[MOST + 3];
    size_t k = 0;
    collect_lines(d, m, n, x);
    d->ends[0] = n ? m[0].time : 1, d->ends[1] = 1;
    for (int i = 0; i < 3 && x == error_of; i++) {
        const struct mean *at = find(m, n, floors[i]);
        double where = !at ? NAN : i == 2 ? at->ode : at->error;
        d->floor[i][0] = d->floor[i][1] = where;
        if (where > 0)
            s[k++] = (dar_plot_series){
                .label = labels[i], .colour = 8 + i, .faint = true, .n = 2, .x = d->floor[i], .y = d->ends
            };
    }
    for (size_t i = 0; i < d->lines; i++) {
        const struct line *l = &d->line[i];
        s[k++] = (dar_plot_series){
            .label = l->label, .mark = DAR_PLOT_BOTH, .colour = (int)i, .n = l->n, .x = l->x, .y = l->y, .tips = l->name
        };
    }
    const dar_plot p = { .x = *axis,
                         .y = { "time, share of the full run's", true, 0, 0 },
                         .series = s,
                         .n = k,
                         .width = 900,
                         .height = 560 };
    return dar_plot_text(&p, svg, e);
}

/* ---------------------------------------------------------------- the page */

static void cell(FILE *f, const char *format, double x)
{
    if (isfinite(x)) {
        fputs("<td>", f);
        fprintf(f, format, x);
    } else {
        fputs("<td>&ndash;", f);
    }
}

static void table_front(FILE *f, const dar_front *front)
{
    fputs("<h2 id=front>What to use</h2><p class=note>The cheapest settings for an error, by kind of scene: what "
          "<code>dar-sample --error-budget</code> chooses from. The bound is the largest error of any scene times the "
          "safety factor.</p><div class=scroll><table><tr><th>scenes<th>setting<th>time<th>faster<th>largest error"
          "<th>bound<th>least PSNR [dB]</tr>\n",
          f);
    for (int k = 0; k < DAR_FRONT_KINDS; k++)
        for (size_t i = 0; i < front->kind[k].settings; i++) {
            const dar_front_setting *s = &front->kind[k].setting[i];
            fprintf(f, "<tr><td>%s (%zu)<td>%s", dar_front_kind[k], front->kind[k].scenes, s->name);
            cell(f, "%.3f", s->time);
            cell(f, "%.2f&times;", 1 / s->time);
            cell(f, "%.2e", s->error);
            cell(f, "%.2e", s->error * front->safety);
            cell(f, "%.1f", s->psnr);
            fputs("</tr>\n", f);
        }
    fputs("</table></div>\n", f);
}

static void table_equal(FILE *f, const work_equal *x, size_t n)
{
    const work_ratio r = work_equal_ratio(x, n);
    if (!n) return;
    fputs("<h2 id=caches>Beside published caches</h2><p class=note>A cache runs the network in every N-th of the full "
          "run's steps (table), or when its input has changed by so much (change), and else adds what the blocks added "
          "when they last ran. Ours is the setting of this project's with the least error that makes no more calls, in "
          "the same precision on the same scenes. Calls as a mean share of the full run's, errors the largest.</p>",
          f);
    if (r.n)
        fprintf(
            f,
            "<p>With no more calls of the network, our error is <b>%.3f</b> of the caches' in the geometric mean of "
            "%zu settings, <b>%.3f</b> at worst.</p>",
            r.mean, r.n, r.worst);
    fputs("<div class=scroll><table><tr><th>cache<th>calls<th>error<th>ours<th>calls<th>error<th>ours over the cache's"
          "</tr>\n",
          f);
    for (size_t i = 0; i < n; i++) {
        fprintf(f, "<tr><td>%s", x[i].cache);
        cell(f, "%.3f", x[i].calls[0]);
        cell(f, "%.2e", x[i].error[0]);
        fprintf(f, "<td>%s", x[i].ours ? x[i].ours : "&ndash;");
        cell(f, "%.3f", x[i].calls[1]);
        cell(f, "%.2e", x[i].error[1]);
        cell(f, "%.3f", x[i].error[1] / x[i].error[0]);
        fputs("</tr>\n", f);
    }
    fputs("</table></div>\n", f);
}

static void table_all(FILE *f, const struct mean *m, size_t n)
{
    fputs("<h2 id=all>Every setting</h2><p class=note>Over all scenes: time as geometric mean, everything else the "
          "worst, but the change of PSNR against the bundle's own frames, a mean. Errors of the latent, relative L2 "
          "against the full run, also by what its places show. In the CSV the column <code>bytes</code> is a lower "
          "bound: weights, read once in a call of the network; activations come on top.</p><div "
          "class=scroll><table><tr><th>setting<th>scenes"
          "<th>time<th>error<th>against the ODE<th>empty<th>still<th>moving<th>edge<th>PSNR<th>SSIM<th>FLIP"
          "<th>PSNR of truth</tr>\n",
          f);
    for (size_t i = 0; i < n; i++) {
        fprintf(f, "<tr><td>%s<td>%zu", m[i].row->text[WORK_SETTING], m[i].scenes);
        cell(f, "%.3f", m[i].time);
        cell(f, "%.2e", m[i].error);
        cell(f, "%.2e", m[i].ode);
        for (int c = 0; c < WORK_CLASSES; c++) cell(f, "%.2e", m[i].class[c]);
        cell(f, "%.1f", m[i].psnr);
        cell(f, "%.4f", m[i].ssim);
        cell(f, "%.4f", m[i].flip);
        cell(f, "%+.3f", m[i].psnr_truth);
        fputs("</tr>\n", f);
    }
    fputs("</table></div>\n", f);
}

static void table_scenes(FILE *f, const work_table *t)
{
    fputs("<h2 id=scenes>Scenes</h2><div class=scroll><table><tr><th>scene<th>camera<th>visible<th>full run [s]"
          "<th>TFLOP<th>calls<th>memory [MB]<th>PSNR of truth [dB]</tr>\n",
          f);
    for (size_t i = 0; i < t->n; i++) {
        const work_row *r = &t->row[i];
        if (strcmp(r->text[WORK_SETTING], WORK_FULL) != 0) continue;
        fprintf(f, "<tr><td>%s<td>%s", r->text[WORK_SCENE], r->v[WORK_CAMERA_STILL] > 0 ? "still" : "moving");
        cell(f, "%.0f %%", 100 * r->v[WORK_VISIBLE]);
        cell(f, "%.2f", r->v[WORK_SECONDS]);
        cell(f, "%.3f", 1e-12 * r->v[WORK_FLOPS]);
        cell(f, "%.0f", r->v[WORK_CALLS]);
        cell(f, "%.0f", 1e-6 * r->v[WORK_PEAK]);
        cell(f, "%.2f", r->v[WORK_PSNR_TRUTH]);
        fputs("</tr>\n", f);
    }
    fputs("</table></div>\n", f);
}

/* ---------------------------------------------------------------- pictures */

const char *work_picture(const char *directory, const char *scene, const char *setting, char path[PATH_MAX])
{
    snprintf(path, PATH_MAX, "%.*s/pictures/%s %s.png", PATH_MAX / 2, directory, scene, setting);
    return path;
}

/* Nothing if there is no such picture. */
static dar_status picture(FILE *f, const work_table *t, const char *directory, const char *scene, const char *setting,
                          dar_err *e)
{
    char path[PATH_MAX];
    const work_row *r = work_find(t, scene, setting), *full = work_find(t, scene, WORK_FULL);
    if (access(work_picture(directory, scene, setting, path), R_OK) != 0) return DAR_OK;
    fputs("<figure><img style=\"width:100%;image-rendering:pixelated\" alt=\"\" src=\"data:image/png;base64,", f);
    DAR_TRY(dar_html_file(f, path, e));
    fprintf(f, "\"><figcaption>%s", setting);
    if (r && full && r != full)
        fprintf(f, "<br>%.1f&times; faster, off by %.2g, %.1f dB", full->v[WORK_SECONDS] / r->v[WORK_SECONDS],
                r->v[WORK_ERROR], r->v[WORK_PSNR]);
    fputs("</figcaption></figure>\n", f);
    return DAR_OK;
}

static dar_status pictures(FILE *f, const work_table *t, const char *directory, const dar_front *front, dar_err *e)
{
    const dar_front_row *any = &front->kind[DAR_FRONT_ANY];
    fputs("<h2 id=pictures>The last frame</h2>\n", f);
    for (size_t i = 0; i < t->n; i++) {
        const char *scene = t->row[i].text[WORK_SCENE];
        if (strcmp(t->row[i].text[WORK_SETTING], WORK_FULL) != 0) continue;
        fprintf(f, "<h3>%s</h3><div class=plots style=\"grid-template-columns:repeat(auto-fill,minmax(200px,1fr))\">\n",
                scene);
        DAR_TRY(picture(f, t, directory, scene, "truth", e));
        DAR_TRY(picture(f, t, directory, scene, WORK_FULL, e));
        for (size_t k = any->settings; k-- > 0;) DAR_TRY(picture(f, t, directory, scene, any->setting[k].name, e));
        fputs("</div>\n", f);
    }
    return DAR_OK;
}

static dar_status figure(FILE *f, struct drawing *d, const struct mean *m, size_t n, coordinate *x,
                         const dar_plot_axis *axis, const char *caption, dar_err *e)
{
    char *svg;
    DAR_TRY(draw(d, m, n, x, axis, &svg, e));
    fprintf(f, "<figure>%s<figcaption>%s</figcaption></figure>\n", svg, caption);
    free(svg);
    return DAR_OK;
}

static const dar_plot_axis by_error = { "largest error of a scene: relative L2 of the latent", true, 0, 0 };
static const dar_plot_axis by_ode = { "largest error of a scene against the ODE", true, 0, 0 };
static const dar_plot_axis by_psnr = { "least PSNR of a scene against the full run [dB]", false, 0, 0 };
static const dar_plot_axis by_change = { "mean change of PSNR against the bundle's own frames [dB]", false, 0, 0 };

static dar_status print_page(FILE *f, const work_table *t, const char *directory, const dar_front *front,
                             struct drawing *d, dar_err *e)
{
    struct mean m[MOST];
    work_equal equal[MOST];
    const size_t n = collect(t, DAR_FRONT_ANY, m);
    qsort(m, n, sizeof *m, by_time);
    dar_html_begin(f, "Run time against error");
    fputs("<header><h1>Run time against error</h1><p>", f);
    dar_html_text(f, t->n ? t->row[0].text[WORK_MODEL] : "");
    fprintf(f,
            ": %zu rows on %zu scenes. The full run is f32, 50 steps of Euler, no skip. Below and to the left is "
            "better.</p></header>\n<main>\n",
            t->n, front->kind[DAR_FRONT_ANY].scenes);
    DAR_TRY(
        figure(f, d, m, n, error_of, &by_error,
               "Vertical: how far precisions are from each other, and the full run from what it approximates. Caches "
               "are published rules, for comparison; to hold a velocity by a table is to take fewer steps of Euler.",
               e));
    fputs("<div class=plots>\n", f);
    DAR_TRY(figure(f, d, m, n, ode_of, &by_ode, "The same against f64 with many steps, which the full run is not.", e));
    DAR_TRY(figure(f, d, m, n, psnr_of, &by_psnr, "Frames; to the right is better.", e));
    DAR_TRY(figure(f, d, m, n, change_of, &by_change, "What it costs against the truth; 0 is nothing.", e));
    fputs("</div>\n", f);
    table_front(f, front);
    table_equal(f, equal, work_equals(t, equal, MOST));
    DAR_TRY(pictures(f, t, directory, front, e));
    table_scenes(f, t);
    table_all(f, m, n);
    fputs("</main></body></html>\n", f);
    return DAR_OK;
}

/* ---------------------------------------------------------------- files */

static dar_status write_text(const char *directory, const char *name, const char *text, dar_err *e)
{
    char path[PATH_MAX];
    dar_file_out o = { .fd = -1 };
    snprintf(path, sizeof path, "%.*s%s%s", PATH_MAX - 64, directory ? directory : "", directory ? "/" : "", name);
    dar_status s = dar_file_create(&o, path, e);
    if (s == DAR_OK) s = dar_file_write(&o, text, strlen(text), e);
    if (s == DAR_OK) s = dar_file_write(&o, "\n", 1, e);
    if (s == DAR_OK) s = dar_file_commit(&o, e);
    dar_file_discard(&o);
    return s;
}

static dar_status write_page(const work_table *t, const char *directory, const dar_front *front, struct drawing *d,
                             dar_err *e)
{
    char *text = NULL;
    size_t size = 0;
    FILE *f = open_memstream(&text, &size);
    if (!f) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory for the page", directory);
    dar_status s = print_page(f, t, directory, front, d, e);
    if (fclose(f) != 0 && s == DAR_OK) s = dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory for the page", directory);
    if (s == DAR_OK) s = write_text(directory, "work_precision.html", text, e);
    free(text);
    return s;
}

static dar_status write_svg(const work_table *t, const char *directory, struct drawing *d, dar_err *e)
{
    struct mean m[MOST];
    char *svg;
    const size_t n = collect(t, DAR_FRONT_ANY, m);
    qsort(m, n, sizeof *m, by_time);
    DAR_TRY(draw(d, m, n, error_of, &by_error, &svg, e));
    dar_status s = write_text(directory, "work_precision.svg", svg, e);
    free(svg);
    return s;
}

static void print_equal(const work_table *t, dar_json_writer *w)
{
    work_equal x[MOST];
    const size_t n = work_equals(t, x, MOST);
    const work_ratio r = work_equal_ratio(x, n);
    dar_json_write_object(w, "equal_calls");
    dar_json_write_int(w, "compared", (int64_t)r.n);
    dar_json_write_number(w, "ratio_mean", r.mean);
    dar_json_write_number(w, "ratio_worst", r.worst);
    dar_json_write_array(w, "caches");
    for (size_t i = 0; i < n; i++) {
        dar_json_write_object(w, NULL);
        dar_json_write_text(w, "cache", x[i].cache);
        dar_json_write_number(w, "calls", x[i].calls[0]);
        dar_json_write_number(w, "error", x[i].error[0]);
        if (x[i].ours) dar_json_write_text(w, "ours", x[i].ours);
        dar_json_write_number(w, "ours_calls", x[i].calls[1]);
        dar_json_write_number(w, "ours_error", x[i].error[1]);
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
    dar_json_write_end(w);
}

static dar_status write_equal(const work_table *t, const char *directory, dar_err *e)
{
    work_equal x[MOST];
    const size_t n = work_equals(t, x, MOST);
    char *text = NULL;
    size_t size = 0;
    FILE *f = open_memstream(&text, &size);
    if (!f) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", directory);
    fputs("cache,calls,error,ours,ours_calls,ours_error,ratio", f);
    for (size_t i = 0; i < n; i++) {
        fprintf(f, "\n%s,%.6g,%.6g", x[i].cache, x[i].calls[0], x[i].error[0]);
        if (x[i].ours)
            fprintf(f, ",%s,%.6g,%.6g,%.6g", x[i].ours, x[i].calls[1], x[i].error[1], x[i].error[1] / x[i].error[0]);
        else fputs(",,,,", f);
    }
    dar_status s = fclose(f) == 0 ? write_text(directory, "equal_calls.csv", text, e)
                                  : dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", directory);
    free(text);
    return s;
}

static dar_status write_json(const work_table *t, const char *directory, const dar_front *f, const char *front,
                             dar_err *e)
{
    dar_json_writer rows = { .pretty = true }, w = { .pretty = true };
    dar_json_write_object(&rows, NULL);
    work_print(t, &rows);
    print_equal(t, &rows);
    dar_json_write_end(&rows);
    dar_front_print(f, &w);
    dar_status s = rows.failed || w.failed ? dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", directory) : DAR_OK;
    if (s == DAR_OK) s = write_text(directory, "work_precision.json", rows.text, e);
    if (s == DAR_OK) s = write_text(directory, "pareto.json", w.text, e);
    if (s == DAR_OK && front) s = write_text(NULL, front, w.text, e);
    dar_json_writer_free(&rows);
    dar_json_writer_free(&w);
    return s;
}

dar_status work_report(const work_table *t, const char *directory, const char *model, double safety, const char *front,
                       dar_err *e)
{
    dar_front f;
    struct drawing *d = calloc(1, sizeof *d);
    if (!d) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", directory);
    work_front(t, model, safety, &f);
    dar_status s = write_json(t, directory, &f, front, e);
    if (s == DAR_OK) s = write_equal(t, directory, e);
    if (s == DAR_OK) s = write_svg(t, directory, d, e);
    if (s == DAR_OK) s = write_page(t, directory, &f, d, e);
    free(d);
    return s;
}
