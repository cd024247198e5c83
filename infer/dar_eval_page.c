/* dar_eval_page.c: the report: one file of HTML with tables, plots and films. */
#include "infer/dar_eval.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "infer/dar_eval_film.h"
#include "infer/dar_eval_html.h"
#include "lib/plot.h"

#define MOMENTS 41 /* of the plots over time */
#define GREY    7  /* in the palette of plots; dashed and dotted ones are rows of reference */

/* ---------------------------------------------------------------- tables */

static const char *const rank_class[] = { "", " class=\"best\"", " class=\"second\"" };

/* Without the marks that Markdown has. */
static void put_note(FILE *f, const char *note)
{
    char plain[512];
    size_t n = 0;
    for (const char *p = note; *p && n < sizeof plain - 1; p++)
        if (*p != '*' && *p != '_') plain[n++] = *p;
    plain[n] = 0;
    fputs("<p class=\"note\">", f);
    dar_html_text(f, plain);
    fputs("</p>\n", f);
}

static void put_sheet(FILE *f, const dar_eval_sheet *s, size_t number)
{
    fprintf(f, "<h3 id=\"table-%zu\">", number);
    dar_html_text(f, s->title);
    fputs("</h3>\n", f);
    if (*s->note) put_note(f, s->note);
    fputs("<div class=\"scroll\"><table>\n<thead><tr>", f);
    for (size_t k = 0; k < s->columns; k++) {
        fputs("<th>", f);
        dar_html_text(f, s->head[k]);
        fputs("</th>", f);
    }
    fputs("</tr></thead>\n<tbody>\n", f);
    for (size_t i = 0; i < s->rows; i++) {
        const dar_eval_entry *row = s->entry + i * s->columns;
        fputs(row->apart ? "<tr class=\"apart\">" : "<tr>", f);
        for (size_t k = 0; k < s->columns; k++) {
            fprintf(f, "<td><span%s>", rank_class[row[k].rank]);
            dar_html_text(f, *row[k].text ? row[k].text : "–");
            fputs("</span>", f);
            if (*row[k].range) fprintf(f, "<small>%s</small>", row[k].range);
            fputs("</td>", f);
        }
        fputs("</tr>\n", f);
    }
    fputs("</tbody></table></div>\n", f);
}

/* Whether a set begins with sheet i. */
static bool begins(const dar_eval_sheets *s, size_t i)
{
    return i == 0 || strcmp(s->at[i].set, s->at[i - 1].set) != 0;
}

static void put_link(FILE *f, const char *kind, size_t number, const char *text)
{
    fprintf(f, "<a href=\"#%s-%zu\">", kind, number);
    dar_html_text(f, *text ? text : "Tables");
    fputs("</a>", f);
}

/* Set by set, each with a list of its tables. */
static void put_sheets(FILE *f, const dar_eval_sheets *s)
{
    for (size_t i = 0; i < s->n; i++) {
        if (begins(s, i)) {
            fprintf(f, "<h2 id=\"set-%zu\">", i);
            dar_html_text(f, *s->at[i].set ? s->at[i].set : "Tables");
            fputs("</h2>\n<p class=\"list\">", f);
            for (size_t k = i; k == i || (k < s->n && !begins(s, k)); k++) put_link(f, "table", k, s->at[k].title);
            fputs("</p>\n", f);
        }
        put_sheet(f, &s->at[i], i);
    }
}

/* ---------------------------------------------------------------- plots */

struct curves {
    dar_plot_series *series;
    double *x, *y; /* [methods, MOMENTS] */
};

/* Of a cell at a moment, between frames in a straight line; NAN for equal pictures, whose 100 dB would flatten the
 * rest.
 */
static double value_at(const dar_eval_cell *cell, size_t frames, double moment, int measure)
{
    double at = moment * (double)(frames - 1), y[2];
    size_t t = (size_t)at, next = t + 1 < frames ? t + 1 : t;
    if (!cell->there) return NAN;
    y[0] = cell->frame[t].v[DAR_METRIC_FRAME][measure];
    y[1] = cell->frame[next].v[DAR_METRIC_FRAME][measure];
    if (measure == DAR_METRIC_PSNR && (y[0] >= 100 || y[1] >= 100)) return NAN;
    return at > (double)t ? y[0] + (at - (double)t) * (y[1] - y[0]) : y[0];
}

/* Mean over clips at moments of normalised time. */
static void over_time(const dar_eval *v, int measure, struct curves *c)
{
    for (size_t m = 0; m < v->methods; m++) {
        double *x = c->x + m * MOMENTS, *y = c->y + m * MOMENTS;
        for (size_t i = 0; i < MOMENTS; i++) {
            double sum = 0, n = 0;
            x[i] = (double)i / (MOMENTS - 1);
            for (size_t k = 0; k < v->clips; k++) {
                double value = value_at(&v->cell[m * v->clips + k], v->clip[k].frames, x[i], measure);
                if (!isnan(value)) sum += value, n++;
            }
            y[i] = n > 0 ? sum / n : NAN;
        }
        c->series[m] = (dar_plot_series){ .label = v->method[m].name, .mark = DAR_PLOT_LINE, .n = MOMENTS };
        c->series[m].colour = v->method[m].kind == DAR_EVAL_GIVEN ? (int)m : GREY + 8 * (int)v->method[m].kind;
        c->series[m].x = x;
        c->series[m].y = y;
    }
}

static dar_status put_plot(FILE *f, const dar_plot *p, const char *caption, dar_err *e)
{
    char *svg;
    DAR_TRY(dar_plot_text(p, &svg, e));
    fprintf(f, "<figure>\n%s\n<figcaption>%s</figcaption>\n</figure>\n", svg, caption);
    free(svg);
    return DAR_OK;
}

static dar_status put_plots(FILE *f, dar_eval *v, dar_err *e)
{
    static const struct {
        int measure;
        const char *title, *caption;
    } plots[] = {
        { DAR_METRIC_PSNR, "PSNR over a clip", "Means over clips; frames that equal the truth are left out." },
        { DAR_METRIC_FLIP, "FLIP over a clip", "Perceived difference, less is better; means over clips." },
        { DAR_METRIC_SSIM, "SSIM over a clip", "Means over clips." },
        { DAR_METRIC_TEMP_TRUTH, "Motion that is not the truth's", "TempL1 to truth, 0 to 255; means over clips." },
    };
    struct curves c = { calloc(v->methods, sizeof *c.series), NULL, NULL };
    double *numbers = calloc(2 * v->methods * MOMENTS, sizeof *numbers);
    dar_status s = c.series && numbers ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "report.html: out of memory");
    c.x = numbers;
    c.y = numbers + v->methods * MOMENTS;
    fputs("<h2 id=\"plots\">Over time</h2>\n<div class=\"plots\">\n", f);
    for (size_t i = 0; i < DAR_COUNT(plots) && s == DAR_OK; i++) {
        over_time(v, plots[i].measure, &c);
        dar_plot p = { .title = plots[i].title, .series = c.series, .n = v->methods };
        p.x.label = "time, 0 first frame, 1 last";
        p.y.label = dar_eval_table[plots[i].measure].title;
        s = put_plot(f, &p, plots[i].caption, e);
    }
    fputs("</div>\n", f);
    free(c.series);
    free(numbers);
    return s;
}

/* ---------------------------------------------------------------- films */

/* Names over the tiles; with their PSNR. */
static void put_labels(FILE *f, const dar_eval *v, size_t c, const dar_eval_tiles *t)
{
    for (size_t i = 0; i < t->n; i++) {
        const dar_eval_cell *cell = i ? &v->cell[(i - 1) * v->clips + c] : NULL;
        fprintf(f, "<b style=\"left:%.3f%%;top:%.3f%%\">", 100.0 * (double)(i % t->columns) / (double)t->columns,
                100.0 * (double)(i / t->columns) / (double)t->rows);
        dar_html_text(f, i ? v->method[i - 1].name : "truth");
        if (cell && cell->there)
            fprintf(f, "<i>%.2f dB</i>", cell->span[DAR_EVAL_ALL].v[DAR_METRIC_FRAME][DAR_METRIC_PSNR]);
        if (cell && !cell->there) fputs("<i>missing</i>", f);
        fputs("</b>", f);
    }
}

static dar_status put_clip(FILE *f, const dar_eval *v, size_t c, dar_err *e)
{
    static const char *const ending[] = { "", "-error" };
    const dar_eval_clip *x = &v->clip[c];
    dar_eval_tiles t = dar_eval_film_tiles(v->methods + 1, x, v->tile);
    char path[PATH_MAX];
    fprintf(f, "<section class=\"clip\" id=\"clip-%zu\"><h3>", c);
    dar_html_text(f, x->name);
    fputs("<span>", f);
    dar_html_text(f, x->set);
    fprintf(f, "%s", *x->set ? " · " : "");
    dar_html_text(f, x->trajectory);
    fprintf(f, " · %zu frames of %zu × %zu</span><button aria-pressed=\"false\">errors</button></h3>\n", x->frames,
            x->width, x->height);
    fprintf(f, "<div class=\"film\" style=\"aspect-ratio:%zu/%zu;--n:%zu\">", t.columns * t.width, t.rows * t.height,
            t.columns);
    for (int k = 0; k < 2; k++)
        fprintf(f, "<video data-film=\"film-%zu%s\"%s muted loop playsinline></video>", c, ending[k],
                k ? "" : " class=\"on\"");
    put_labels(f, v, c, &t);
    fputs("</div>\n", f);
    for (int k = 0; k < 2; k++) {
        if (snprintf(path, sizeof path, "%s/clips/%05zu%s.mp4", v->out, c, ending[k]) >= PATH_MAX)
            return dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long", v->out);
        fprintf(f, "<script type=\"text/plain\" id=\"film-%zu%s\">", c, ending[k]);
        DAR_TRY(dar_html_file(f, path, e));
        fputs("</script>\n", f);
    }
    fputs("</section>\n", f);
    return DAR_OK;
}

static dar_status put_clips(FILE *f, const dar_eval *v, dar_err *e)
{
    fputs(
        "<h2 id=\"clips\">Clips</h2>\n<p class=\"note\">Truth and methods play in step; the number is the mean PSNR.  "
        "Errors are maps of FLIP: <span class=\"scale\">0<span class=\"ramp\"></span>1</span>.  <button id=\"all\" "
        "aria-pressed=\"false\">errors of "
        "all</button></p>\n",
        f);
    for (size_t c = 0; c < v->clips; c++) DAR_TRY(put_clip(f, v, c, e));
    return DAR_OK;
}

static const char script[] =
    "function turn(s,on){const b=s.querySelector('h3 button');b.setAttribute('aria-pressed',on);"
    "s.querySelectorAll('video').forEach((v,i)=>{v.classList.toggle('on',i==on);show(v)})}\n"
    "document.querySelectorAll('.clip').forEach(s=>s.querySelector('h3 button').onclick=e=>"
    "turn(s,e.target.getAttribute('aria-pressed')=='false'?1:0));\n"
    "document.getElementById('all').onclick=e=>{const on=e.target.getAttribute('aria-pressed')=='false'?1:0;"
    "e.target.setAttribute('aria-pressed',on==1);document.querySelectorAll('.clip').forEach(s=>turn(s,on))};\n";

/* ---------------------------------------------------------------- the page */

static void put_head(FILE *f, const dar_eval *v, const dar_eval_sheets *s)
{
    size_t given = 0;
    for (size_t m = 0; m < v->methods; m++) given += v->method[m].kind == DAR_EVAL_GIVEN;
    dar_html_begin(f, "Evaluation");
    fprintf(f,
            "<header><h1>Evaluation</h1><p class=\"dim\">%zu method%s on %zu clip%s, frame by frame against the true "
            "pictures.  SSIM: Gaussian window of 11, σ 1.5, population covariance, interior.  TempL1, RefL1: 0 to "
            "255.  Methods are given frame 0; tables come with and without it.</p></header>\n<nav><div>",
            given, given == 1 ? "" : "s", v->clips, v->clips == 1 ? "" : "s");
    for (size_t i = 0; i < s->n; i++)
        if (begins(s, i)) put_link(f, "set", i, s->at[i].set);
    fputs("<a href=\"#plots\">Over time</a><a href=\"#clips\">Clips</a></div></nav>\n<main>\n", f);
}

dar_status dar_eval_page(dar_eval *v, const dar_eval_sheets *sheets, dar_err *e)
{
    char *text = NULL;
    size_t size = 0;
    FILE *f = open_memstream(&text, &size);
    if (!f) return dar_fail(e, DAR_ERR_NOMEM, "report.html: out of memory");
    put_head(f, v, sheets);
    put_sheets(f, sheets);
    dar_status s = put_plots(f, v, e);
    if (s == DAR_OK) s = put_clips(f, v, e);
    fprintf(f, "</main>\n<script>\n%s%s</script>\n</body>\n</html>\n", dar_html_films, script);
    bool bad = ferror(f) != 0;
    bad = fclose(f) != 0 || bad;
    if (s == DAR_OK && bad) s = dar_fail(e, DAR_ERR_NOMEM, "report.html: out of memory");
    if (s == DAR_OK) s = dar_eval_write(v, "report.html", text, size, e);
    free(text);
    return s;
}
