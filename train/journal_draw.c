/* journal_draw.c: the log of a run as a table and as pictures.
 *
 * One pass over the log, into as many numbers however long it is. */
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lib/file.h"
#include "lib/plot.h"
#include "train/journal_inside.h"

#define ROWS     500 /* at most */
#define BUCKETS  10  /* of sigma, from 0 to 1 */
#define QUARTERS 4
#define POINTS   500 /* of validation */

typedef struct mean {
    double n, sum, square;
} mean;

typedef struct row {
    int64_t step; /* the last */
    int64_t skipped;
    mean loss, norm, seconds, bucket[BUCKETS];
    double smoothed, rate; /* of the last step */
} row;

typedef struct table {
    int64_t steps, every; /* steps in all; in a row */
    row row[ROWS];
    mean quarter[QUARTERS][BUCKETS];
    double look[3][POINTS];   /* step, loss with the clip's own condition, with another's */
    double sample[2][POINTS]; /* step, PSNR [dB] */
    size_t looks, samples;
} table;

static void add(mean *m, double x)
{
    if (!isfinite(x)) return;
    m->n++;
    m->sum += x;
    m->square += x * x;
}

static double of(const mean *m)
{
    return m->n > 0 ? m->sum / m->n : NAN;
}

/* Standard error of the mean; NAN of fewer than two. */
static double error_of(const mean *m)
{
    if (m->n < 2) return NAN;
    return sqrt(fmax(m->square - m->sum * m->sum / m->n, 0) / (m->n - 1) / m->n);
}

static bool count(void *ctx, const dar_journal_past *x)
{
    table *t = ctx;
    if (x->step > t->steps) t->steps = x->step;
    return true;
}

static bool collect(void *ctx, const dar_journal_past *x)
{
    table *t = ctx;
    if (isfinite(x->shuffled) && t->looks < POINTS) {
        t->look[0][t->looks] = (double)x->step;
        t->look[1][t->looks] = x->loss;
        t->look[2][t->looks++] = x->shuffled;
    }
    if (isfinite(x->psnr) && t->samples < POINTS) {
        t->sample[0][t->samples] = (double)x->step;
        t->sample[1][t->samples++] = x->psnr;
    }
    if (strcmp(x->kind, "step") != 0) return true;
    if (x->step < 1 || x->step > t->steps) return true;
    row *r = &t->row[(x->step - 1) / t->every];
    r->step = x->step;
    r->skipped += x->skipped;
    add(&r->loss, x->loss);
    add(&r->norm, x->norm);
    add(&r->seconds, x->seconds);
    r->smoothed = x->smoothed;
    r->rate = x->rate;
    if (x->sigma >= 0 && x->sigma <= 1) {
        int b = (int)fmin(x->sigma * BUCKETS, BUCKETS - 1);
        add(&r->bucket[b], x->loss);
        add(&t->quarter[(x->step - 1) * QUARTERS / t->steps][b], x->loss);
    }
    return true;
}

/* ---------------------------------------------------------------- the table */

static void put(FILE *f, double x)
{
    char digits[32];
    fprintf(f, ",%s", isfinite(x) ? dar_json_number_text(x, digits) : "");
}

static char *csv_text(const table *t)
{
    char *text;
    size_t size;
    FILE *f = open_memstream(&text, &size);
    if (!f) return NULL;
    fputs("step,loss,smoothed,norm,rate,seconds,skipped", f);
    for (int b = 0; b < BUCKETS; b++) fprintf(f, ",sigma_%.1f", (double)b / BUCKETS);
    fputc('\n', f);
    for (int i = 0; i < ROWS; i++) {
        const row *r = &t->row[i];
        if (!r->step) continue;
        fprintf(f, "%lld", (long long)r->step);
        put(f, of(&r->loss));
        put(f, r->smoothed);
        put(f, of(&r->norm));
        put(f, r->rate);
        put(f, of(&r->seconds));
        put(f, (double)r->skipped);
        for (int b = 0; b < BUCKETS; b++) put(f, of(&r->bucket[b]));
        fputc('\n', f);
    }
    bool failed = ferror(f) != 0;
    if (fclose(f) == 0 && !failed) return text;
    free(text);
    return NULL;
}

static dar_status write_csv(const table *t, const char *path, dar_err *e)
{
    dar_file_out out = { 0 };
    char *text = csv_text(t);
    if (!text) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    dar_status s = dar_file_create(&out, path, e);
    if (s == DAR_OK) s = dar_file_write(&out, text, strlen(text), e);
    if (s == DAR_OK) s = dar_file_commit(&out, e);
    dar_file_discard(&out);
    free(text);
    return s;
}

/* ---------------------------------------------------------------- the pictures */

static dar_status draw_loss(const table *t, const char *path, dar_err *e)
{
    double x[ROWS], mean_of[ROWS], smoothed[ROWS];
    char faint[64];
    size_t n = 0;
    for (int i = 0; i < ROWS; i++) {
        if (!t->row[i].step) continue;
        x[n] = (double)t->row[i].step;
        mean_of[n] = of(&t->row[i].loss);
        smoothed[n++] = t->row[i].smoothed;
    }
    snprintf(faint, sizeof faint, t->every > 1 ? "mean of %lld steps" : "each step", (long long)t->every);
    const dar_plot_series series[] = {
        { .label = faint, .faint = true, .n = n, .x = x, .y = mean_of },
        { .label = "smoothed", .n = n, .x = x, .y = smoothed },
        { .label = "validation", .mark = DAR_PLOT_BOTH, .colour = 1, .n = t->looks, .x = t->look[0], .y = t->look[1] },
        { .label = "with another clip's condition",
          .mark = DAR_PLOT_BOTH,
          .colour = 4,
          .n = t->looks,
          .x = t->look[0],
          .y = t->look[2] },
    };
    dar_plot p = { .title = "Loss", .x.label = "step", .y.label = "loss", .series = series, .n = t->looks ? 4 : 2 };
    p.y.log = true;
    return dar_plot_write(&p, path, e);
}

static dar_status draw_psnr(const table *t, const char *path, dar_err *e)
{
    const dar_plot_series series = { .mark = DAR_PLOT_BOTH, .n = t->samples, .x = t->sample[0], .y = t->sample[1] };
    dar_plot p = { .title = "Samples", .x.label = "step", .y.label = "PSNR [dB]", .series = &series, .n = 1 };
    return t->samples ? dar_plot_write(&p, path, e) : DAR_OK;
}

static dar_status draw_sigma(const table *t, const char *path, dar_err *e)
{
    double x[BUCKETS], y[QUARTERS][BUCKETS], lo[QUARTERS][BUCKETS], hi[QUARTERS][BUCKETS];
    char label[QUARTERS][64];
    dar_plot_series series[QUARTERS];
    for (int b = 0; b < BUCKETS; b++) x[b] = (b + 0.5) / BUCKETS;
    for (int q = 0; q < QUARTERS; q++) {
        for (int b = 0; b < BUCKETS; b++) {
            double error = error_of(&t->quarter[q][b]);
            y[q][b] = of(&t->quarter[q][b]);
            lo[q][b] = y[q][b] - error;
            hi[q][b] = y[q][b] + error;
        }
        snprintf(label[q], sizeof label[q], "steps %lld to %lld", (long long)((q * t->steps + 3) / QUARTERS + 1),
                 (long long)(((q + 1) * t->steps + 3) / QUARTERS));
        series[q] = (dar_plot_series){ .label = label[q], .mark = DAR_PLOT_BOTH, .colour = q, .n = BUCKETS, .x = x };
        series[q].y = y[q];
        series[q].lo = lo[q];
        series[q].hi = hi[q];
    }
    dar_plot p = { .title = "Loss by noise", .x.label = "sigma", .y.label = "loss", .series = series, .n = QUARTERS };
    p.x.hi = 1;
    return dar_plot_write(&p, path, e);
}

static dar_status draw_all(const char *run, table *t, dar_err *e)
{
    static const struct {
        const char *name;
        dar_status (*make)(const table *t, const char *path, dar_err *e);
    } files[] = { { "loss.csv", write_csv },
                  { "loss.svg", draw_loss },
                  { "loss_sigma.svg", draw_sigma },
                  { "psnr.svg", draw_psnr } };
    char path[PATH_MAX];
    snprintf(path, sizeof path, "%.4000s/%s", run, DAR_JOURNAL_LOG);
    DAR_TRY(dar_journal_scan(path, count, t, e));
    t->every = (t->steps + ROWS - 1) / ROWS + !t->steps;
    DAR_TRY(dar_journal_scan(path, collect, t, e));
    for (size_t i = 0; i < DAR_COUNT(files); i++) {
        snprintf(path, sizeof path, "%.4000s/%s", run, files[i].name);
        DAR_TRY(files[i].make(t, path, e));
    }
    return DAR_OK;
}

dar_status dar_journal_draw(const char *run, dar_err *e)
{
    table *t = calloc(1, sizeof *t);
    if (!t) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", run);
    dar_status s = draw_all(run, t, e);
    free(t);
    return s;
}
