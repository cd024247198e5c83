/* dar_eval_beside.c: figures that somebody published, in the columns of table.csv, beside ours. */
#include "infer/dar_eval.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "lib/file.h"

enum { SET, MODE, SEED, STEP, SPLIT, PATH, CLIPS, PSNR, LO, HI, SSIM, LPIPS, FLIP, TEMP, REF, FIELDS };

/* What is shown, and where it stands. */
static const struct {
    int field, measure;
} shown[] = { { PSNR, DAR_METRIC_PSNR },
              { SSIM, DAR_METRIC_SSIM },
              { LPIPS, DAR_EVAL_ALEX },
              { TEMP, DAR_METRIC_TEMP },
              { REF, DAR_METRIC_REF } };

/* ---------------------------------------------------------------- reading */

static dar_status read_line(dar_eval_figure *x, char *line, const char *path, size_t number, dar_err *e)
{
    char *field[FIELDS], *more = line;
    size_t n = 0;
    while (more && n < FIELDS) field[n++] = strsep(&more, ",");
    if (n < FIELDS || more)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: line %zu: expected " DAR_EVAL_COLUMNS, path, number);
    *x = (dar_eval_figure){ .step = *field[STEP] ? strtoll(field[STEP], NULL, 10) : -1 };
    dar_eval_channels(field[SET], x->set);
    if (!*x->set) return dar_fail(e, DAR_ERR_FORMAT, "%s: line %zu: found no channel set", path, number);
    snprintf(x->mode, sizeof x->mode, "%s", field[MODE]);
    snprintf(x->split, sizeof x->split, "%s", field[SPLIT]);
    snprintf(x->trajectory, sizeof x->trajectory, "%s", field[PATH]);
    for (int k = 0; k < DAR_EVAL_MEASURES; k++) x->v[k] = NAN;
    for (size_t k = 0; k < DAR_COUNT(shown); k++) {
        char *text = field[shown[k].field], *end;
        x->v[shown[k].measure] = *text ? strtod(text, &end) : NAN;
        if (*text && *end)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: line %zu: found '%s', expected a number", path, number, text);
    }
    return DAR_OK;
}

static dar_status read_lines(dar_eval *v, char *text, const char *path, dar_err *e)
{
    size_t number = 0;
    for (char *line; (line = strsep(&text, "\n"));) {
        number++;
        if (number == 1 && strcmp(line, DAR_EVAL_COLUMNS) != 0)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: line 1: expected " DAR_EVAL_COLUMNS, path);
        if (number == 1 || !*line) continue;
        DAR_TRY(read_line(&v->figure[v->figures], line, path, number, e));
        v->figures++;
    }
    return DAR_OK;
}

dar_status dar_eval_beside_open(dar_eval *v, const char *path, dar_err *e)
{
    dar_file_map f;
    size_t lines = 1;
    DAR_TRY(dar_file_map_open(&f, path, e));
    for (size_t i = 0; i < f.size; i++) lines += f.data[i] == '\n';
    char *text = calloc(f.size + 1, 1);
    v->figure = calloc(lines, sizeof *v->figure);
    dar_status s = text && v->figure ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    if (s == DAR_OK && f.size) memcpy(text, f.data, f.size);
    if (s == DAR_OK) s = read_lines(v, text, path, e);
    free(text);
    dar_file_map_close(&f);
    return s;
}

/* ---------------------------------------------------------------- finding what is alike */

static int64_t longest(const dar_eval *v)
{
    int64_t most = 0;
    for (size_t m = 0; m < v->methods; m++)
        if (v->method[m].step > most) most = v->method[m].step;
    return most;
}

static int64_t longest_figure(const dar_eval *v)
{
    int64_t most = 0;
    for (size_t i = 0; i < v->figures; i++)
        if (v->figure[i].step > most) most = v->figure[i].step;
    return most;
}

/* Our method of the same channels and training, at the same part of the longest; methods: none. */
static size_t method_like(const dar_eval *v, const dar_eval_figure *x)
{
    const double ours = (double)longest(v), theirs = (double)longest_figure(v);
    for (size_t m = 0; m < v->methods; m++) {
        const dar_eval_method *y = &v->method[m];
        if (y->kind != DAR_EVAL_GIVEN || strcmp(y->set, x->set) != 0 || strcmp(y->mode, x->mode) != 0) continue;
        if (x->step < 0 || fabs((double)y->step * theirs - (double)x->step * ours) < 0.01 * ours * theirs) return m;
    }
    return v->methods;
}

/* The figure of DAR under the same circumstances; NULL: there is none. */
static const dar_eval_figure *dar_like(const dar_eval *v, const dar_eval_figure *x)
{
    char set[DAR_EVAL_NAME] = "";
    dar_eval_channels("dar", set);
    for (size_t i = 0; i < v->figures; i++) {
        const dar_eval_figure *y = &v->figure[i];
        if (strcmp(y->set, set) == 0 && strcmp(y->mode, x->mode) == 0 && strcmp(y->split, x->split) == 0 &&
            strcmp(y->trajectory, x->trajectory) == 0 && y->step == x->step)
            return y;
    }
    return NULL;
}

/* ---------------------------------------------------------------- the table */

static void put(dar_eval_sheet *s, size_t row, size_t column, double x, int digits, bool sign)
{
    dar_eval_entry *to = &s->entry[row * s->columns + column];
    if (!isnan(x)) snprintf(to->text, sizeof to->text, sign ? "%+.*f" : "%.*f", digits, x);
}

static void put_row(dar_eval *v, dar_eval_sheet *s, size_t row, const dar_eval_figure *x, size_t m)
{
    const bool all = strcmp(x->trajectory, "all") == 0;
    const dar_eval_where w = { .set = x->split, .trajectory = all ? NULL : x->trajectory };
    const dar_eval_figure *dar = dar_like(v, x);
    const size_t base = dar ? method_like(v, dar) : v->methods;
    dar_eval_entry *to = &s->entry[row * s->columns];
    snprintf(to[0].text, sizeof to[0].text, "%s", v->method[m].name);
    snprintf(to[1].text, sizeof to[1].text, "%s", x->trajectory);
    if (base < v->methods && base != m) {
        double ours = dar_eval_interval(v, m, base, &w, DAR_EVAL_ALL, DAR_METRIC_FRAME, DAR_METRIC_PSNR).mean;
        put(s, row, 2, ours, 2, true);
        put(s, row, 3, x->v[DAR_METRIC_PSNR] - dar->v[DAR_METRIC_PSNR], 2, true);
    }
    for (size_t k = 0; k < DAR_COUNT(shown); k++) {
        const int measure = shown[k].measure, digits = dar_eval_table[measure].digits;
        double ours = dar_eval_interval(v, m, v->methods, &w, DAR_EVAL_ALL, DAR_METRIC_FRAME, measure).mean;
        put(s, row, 4 + 2 * k, ours, digits, false);
        put(s, row, 5 + 2 * k, x->v[measure], digits, false);
    }
}

void dar_eval_beside(dar_eval *v, dar_eval_sheets *sheets, const char *split)
{
    static const char *const head[] = { "Method", "Camera path", "PSNR minus DAR's" };
    size_t rows = 0;
    for (size_t i = 0; i < v->figures; i++)
        rows += strcmp(v->figure[i].split, split) == 0 && method_like(v, &v->figure[i]) < v->methods;
    if (!rows) return;
    dar_eval_sheet *s = dar_eval_sheet_add(sheets, "Beside published figures", split, rows, 4 + 2 * DAR_COUNT(shown));
    if (!s) return;
    snprintf(s->note, sizeof s->note,
             "Columns marked ‡ are published, of another scale: other network, scenes, size of picture and steps.  "
             "Values do not compare across, differences between rows may; methods are matched by channels, training "
             "and part of the steps.");
    for (size_t k = 0; k < s->columns; k++) {
        const char *what = k < 2 ? head[k] : k < 4 ? head[2] : dar_eval_table[shown[(k - 4) / 2].measure].title;
        snprintf(s->head[k], sizeof s->head[k], "%s%s", what, k % 2 && k > 2 ? " ‡" : "");
    }
    for (size_t i = 0, row = 0; i < v->figures; i++) {
        size_t m = strcmp(v->figure[i].split, split) == 0 ? method_like(v, &v->figure[i]) : v->methods;
        if (m < v->methods) put_row(v, s, row++, &v->figure[i], m);
    }
}
