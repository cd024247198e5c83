/* dar_eval_table.c: tables as rows of cells, and numbers of sets of clips. */
#include "infer/dar_eval.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

const dar_eval_measure dar_eval_table[DAR_EVAL_MEASURES] = {
    [DAR_METRIC_PSNR] = { "psnr", "PSNR", 2, DAR_EVAL_MORE },
    [DAR_METRIC_SSIM] = { "ssim", "SSIM", 3, DAR_EVAL_MORE },
    [DAR_METRIC_FLIP] = { "flip", "FLIP", 3, DAR_EVAL_LESS },
    [DAR_METRIC_TEMP] = { "templ1", "TempL1", 2, DAR_EVAL_LESS },
    [DAR_METRIC_TEMP_TRUTH] = { "templ1_truth", "TempL1 to truth", 2, DAR_EVAL_LESS },
    [DAR_METRIC_REF] = { "refl1", "RefL1", 2, DAR_EVAL_LESS },
    [DAR_METRIC_SHARP] = { "sharpness", "Sharpness", 3, DAR_EVAL_ONE },
    [DAR_EVAL_ALEX] = { "lpips_alex", "LPIPS", 3, DAR_EVAL_LESS },
    [DAR_EVAL_VGG] = { "lpips_vgg", "LPIPS (VGG)", 3, DAR_EVAL_LESS },
};

const char *const dar_eval_span_name[DAR_EVAL_SPANS] = { "all", "later", "last" };
const char *const dar_eval_area_name[DAR_METRIC_AREAS] = { "frame", "mask" };

/* ---------------------------------------------------------------- sheets */

dar_eval_sheet *dar_eval_sheet_add(dar_eval_sheets *s, const char *title, const char *set, size_t rows, size_t columns)
{
    dar_eval_sheet *more = realloc(s->at, (s->n + 1) * sizeof *more);
    if (more) {
        s->at = more;
        dar_eval_sheet *t = &more[s->n++];
        *t = (dar_eval_sheet){ .rows = rows, .columns = columns };
        snprintf(t->title, sizeof t->title, "%s", title);
        snprintf(t->set, sizeof t->set, "%s", set);
        t->head = calloc(columns, sizeof *t->head);
        t->entry = calloc(rows * columns, sizeof *t->entry);
        if (t->head && t->entry) return t;
    }
    s->failed = true;
    return NULL;
}

void dar_eval_sheets_free(dar_eval_sheets *s)
{
    for (size_t i = 0; i < s->n; i++) {
        free(s->at[i].head);
        free(s->at[i].entry);
    }
    free(s->at);
    *s = (dar_eval_sheets){ 0 };
}

static bool is_better(double a, double b, dar_eval_aim aim)
{
    return aim == DAR_EVAL_MORE ? a > b : aim == DAR_EVAL_LESS ? a < b : fabs(log(a)) < fabs(log(b));
}

void dar_eval_sheet_rank(dar_eval_sheet *s, size_t k, const double *value, dar_eval_aim aim)
{
    for (size_t i = 0; i < s->rows; i++) {
        size_t better = 0, ranked = 0;
        for (size_t j = 0; j < s->rows; j++) {
            if (isnan(value[j]) || s->entry[j * s->columns].apart) continue;
            ranked++;
            better += is_better(value[j], value[i], aim);
        }
        if (isnan(value[i]) || s->entry[i * s->columns].apart || ranked < 2) continue;
        s->entry[i * s->columns + k].rank = better == 0   ? DAR_EVAL_BEST
                                            : better == 1 ? DAR_EVAL_SECOND
                                                          : DAR_EVAL_PLAIN;
    }
}

/* A bar would end the cell. */
static void put(FILE *f, const char *text)
{
    for (; *text; text++) {
        if (*text == '|') fputc('\\', f);
        fputc(*text, f);
    }
}

static void put_entry(FILE *f, const dar_eval_entry *x)
{
    static const char *const mark[] = { "", "**", "_" };
    const char *m = *x->text ? mark[x->rank] : "";
    fprintf(f, " %s", m);
    put(f, x->text);
    fputs(m, f);
    if (*x->range) fprintf(f, " [%s]", x->range);
    fputs(" |", f);
}

void dar_eval_sheet_markdown(const dar_eval_sheet *s, FILE *f)
{
    fprintf(f, "## %s%s%s\n\n", s->title, *s->set ? ": " : "", s->set);
    if (*s->note) fprintf(f, "%s\n\n", s->note);
    fputc('|', f);
    for (size_t k = 0; k < s->columns; k++) {
        fputc(' ', f);
        put(f, s->head[k]);
        fputs(" |", f);
    }
    fputs("\n|", f);
    for (size_t k = 0; k < s->columns; k++) fputs(k ? "---:|" : "---|", f);
    for (size_t i = 0; i < s->rows; i++) {
        fputs("\n|", f);
        for (size_t k = 0; k < s->columns; k++) put_entry(f, &s->entry[i * s->columns + k]);
    }
    fputs("\n\n", f);
}

/* ---------------------------------------------------------------- numbers of sets of clips */

bool dar_eval_is_in(const dar_eval_clip *c, const dar_eval_where *w)
{
    if (!w) return true;
    if (w->set && strcmp(w->set, c->set) != 0) return false;
    if (w->trajectory && strcmp(w->trajectory, c->trajectory) != 0) return false;
    if (w->divide && c->number / w->divide != w->row) return false;
    return !w->modulo || c->number % w->modulo == w->column;
}

dar_interval dar_eval_interval(dar_eval *v, size_t m, size_t base, const dar_eval_where *w, dar_eval_span span,
                               dar_metric_area area, int measure)
{
    size_t n = 0;
    for (size_t c = 0; c < v->clips; c++) {
        const dar_eval_cell *x = dar_eval_at(v, m, c), *y = base < v->methods ? dar_eval_at(v, base, c) : NULL;
        if (!x->there || (y && !y->there) || !dar_eval_is_in(&v->clip[c], w)) continue;
        double d = x->span[span].v[area][measure] - (y ? y->span[span].v[area][measure] : 0);
        if (!isnan(d)) v->value[n++] = d;
    }
    return dar_stats_bootstrap(v->value, n, v->seed, v->work);
}
