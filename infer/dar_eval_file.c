/* dar_eval_file.c: results for programs.
 *
 *   metrics.json   methods with their means and intervals, differences, clips
 *   metrics.csv    a line for each method, clip and area: means over frames
 *   frames.csv     the same for each frame
 *   table.csv      a line for each method, set and camera path: what a sweep is read from
 *   tables.md      the tables of the report */
#include "infer/dar_eval.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "lib/file.h"
#include "lib/json_write.h"

dar_status dar_eval_write(const dar_eval *v, const char *name, const char *text, size_t size, dar_err *e)
{
    char path[PATH_MAX];
    dar_file_out f;
    if (snprintf(path, sizeof path, "%s/%s", v->out, name) >= PATH_MAX)
        return dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long", v->out);
    dar_status s = dar_file_create(&f, path, e);
    if (s == DAR_OK) s = dar_file_write(&f, text, size, e);
    if (s == DAR_OK) s = dar_file_commit(&f, e);
    dar_file_discard(&f);
    return s;
}

/* ---------------------------------------------------------------- JSON */

static void print_interval(dar_json_writer *w, const char *key, const dar_interval *i)
{
    if (!i->n) return;
    dar_json_write_object(w, key);
    dar_json_write_int(w, "n", (int64_t)i->n);
    dar_json_write_number(w, "mean", i->mean);
    if (!isnan(i->lo)) {
        dar_json_write_number(w, "lo", i->lo);
        dar_json_write_number(w, "hi", i->hi);
    }
    dar_json_write_end(w);
}

/* Of m, or of m minus base, by span, area and measure. */
static void print_intervals(dar_json_writer *w, dar_eval *v, size_t m, size_t base, const dar_eval_where *where)
{
    for (int span = 0; span < DAR_EVAL_SPANS; span++) {
        dar_json_write_object(w, dar_eval_span_name[span]);
        for (int area = 0; area < DAR_METRIC_AREAS; area++) {
            dar_json_write_object(w, dar_eval_area_name[area]);
            for (int k = 0; k < DAR_EVAL_MEASURES; k++) {
                dar_interval i = dar_eval_interval(v, m, base, where, (dar_eval_span)span, (dar_metric_area)area, k);
                print_interval(w, dar_eval_table[k].name, &i);
            }
            dar_json_write_end(w);
        }
        dar_json_write_end(w);
    }
}

static void print_variants(dar_json_writer *w, dar_eval *v, size_t m, const char *set)
{
    if (!dar_eval_variant_interval(v, m, set, DAR_EVAL_VARIANT_IOU).n) return;
    dar_json_write_object(w, "variants");
    for (int k = 0; k < DAR_EVAL_VARIANTS; k++) {
        dar_interval i = dar_eval_variant_interval(v, m, set, (dar_eval_variant_number)k);
        print_interval(w, dar_eval_variant_name[k], &i);
    }
    dar_json_write_end(w);
}

/* Whether clip c is the first of its set, or of its set and path. */
static bool is_first(const dar_eval *v, size_t c, bool path)
{
    for (size_t k = 0; k < c; k++)
        if (strcmp(v->clip[k].set, v->clip[c].set) == 0 &&
            (!path || strcmp(v->clip[k].trajectory, v->clip[c].trajectory) == 0))
            return false;
    return true;
}

static void print_method(dar_json_writer *w, dar_eval *v, size_t m)
{
    const dar_eval_method *x = &v->method[m];
    dar_json_write_object(w, NULL);
    dar_json_write_text(w, "name", x->name);
    dar_json_write_text(w, "channels", x->set);
    dar_json_write_text(w, "mode", x->mode);
    if (x->step >= 0) dar_json_write_int(w, "step", x->step);
    if (x->seed >= 0) dar_json_write_int(w, "seed", x->seed);
    dar_json_write_bool(w, "external", x->external);
    dar_json_write_int(w, "clips", (int64_t)x->clips);
    dar_json_write_object(w, "sets");
    for (size_t c = 0; c < v->clips; c++) {
        const dar_eval_where where = { .set = v->clip[c].set };
        if (!is_first(v, c, false)) continue;
        dar_json_write_object(w, v->clip[c].set);
        print_intervals(w, v, m, v->methods, &where);
        print_variants(w, v, m, where.set);
        if (m != v->base) {
            dar_json_write_object(w, "minus_base");
            print_intervals(w, v, m, v->base, &where);
            dar_json_write_end(w);
        }
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
    dar_json_write_end(w);
}

static void print_clip(dar_json_writer *w, const dar_eval *v, size_t c)
{
    const dar_eval_clip *x = &v->clip[c];
    dar_json_write_object(w, NULL);
    dar_json_write_text(w, "name", x->name);
    dar_json_write_text(w, "set", x->set);
    dar_json_write_text(w, "trajectory", x->trajectory);
    dar_json_write_text(w, "family", x->family);
    dar_json_write_int(w, "frames", (int64_t)x->frames);
    dar_json_write_int(w, "width", (int64_t)x->width);
    dar_json_write_int(w, "height", (int64_t)x->height);
    if (!isnan(x->lost[0])) dar_json_write_number(w, "not_in_frame_0", x->lost[0]);
    if (!isnan(x->lost[1])) dar_json_write_number(w, "not_in_frame_0_at_the_end", x->lost[1]);
    if (!isnan(x->seen)) dar_json_write_number(w, "iou_of_truth", x->seen);
    dar_json_write_object(w, "aligned");
    for (size_t m = 0; m < v->methods; m++)
        if (v->cell[m * v->clips + c].aligned) dar_json_write_bool(w, v->method[m].name, true);
    dar_json_write_end(w);
    dar_json_write_array(w, "missing");
    for (size_t m = 0; m < v->methods; m++)
        if (!v->cell[m * v->clips + c].there) dar_json_write_text(w, NULL, v->method[m].name);
    dar_json_write_end(w);
    dar_json_write_end(w);
}

static dar_status write_json(dar_eval *v, dar_err *e)
{
    dar_json_writer w = { .pretty = true };
    dar_json_write_object(&w, NULL);
    dar_json_write_text(&w, "format", "dar-eval/1");
    dar_json_write_text(&w, "ssim", "Gaussian window of 11, sigma 1.5, population covariance, interior, RGB");
    dar_json_write_text(&w, "interval", "95 %, percentile bootstrap over clips, 10000 sets");
    dar_json_write_int(&w, "seed", (int64_t)(v->seed & DAR_BUNDLE_MAX_SEED));
    dar_json_write_text(&w, "base", v->method[v->base].name);
    dar_json_write_array(&w, "methods");
    for (size_t m = 0; m < v->methods; m++) print_method(&w, v, m);
    dar_json_write_end(&w);
    dar_json_write_array(&w, "clips");
    for (size_t c = 0; c < v->clips; c++) print_clip(&w, v, c);
    dar_json_write_end(&w);
    dar_json_write_end(&w);
    dar_status s = w.failed ? dar_fail(e, DAR_ERR_NOMEM, "metrics.json: out of memory")
                            : dar_eval_write(v, "metrics.json", w.text, w.size, e);
    dar_json_writer_free(&w);
    return s;
}

/* ---------------------------------------------------------------- CSV */

static void put_text(FILE *f, const char *text)
{
    if (!strpbrk(text, ",\"\n")) {
        fputs(text, f);
        return;
    }
    fputc('"', f);
    for (; *text; text++) {
        if (*text == '"') fputc('"', f);
        fputc(*text, f);
    }
    fputc('"', f);
}

/* ",1.25", or "," where there is none. */
static void put_number(FILE *f, double x)
{
    char text[32];
    fputc(',', f);
    if (isfinite(x)) fputs(dar_json_number_text(x, text), f);
}

static void put_measures(FILE *f, const char *first)
{
    fputs(first, f);
    for (int k = 0; k < DAR_EVAL_MEASURES; k++) fprintf(f, ",%s", dar_eval_table[k].name);
    fputc('\n', f);
}

static void put_line(FILE *f, const dar_eval *v, size_t m, size_t c, int span, size_t frame, int area,
                     const dar_eval_row *row)
{
    const dar_eval_clip *x = &v->clip[c];
    put_text(f, v->method[m].name);
    fputc(',', f);
    put_text(f, x->set);
    fputc(',', f);
    put_text(f, x->name);
    fputc(',', f);
    if (span >= 0) {
        put_text(f, x->trajectory);
        fprintf(f, ",%d,%s", v->cell[m * v->clips + c].aligned, dar_eval_span_name[span]);
    } else {
        fprintf(f, "%zu", frame);
    }
    fprintf(f, ",%s", dar_eval_area_name[area]);
    for (int k = 0; k < DAR_EVAL_MEASURES; k++) put_number(f, row->v[area][k]);
    fputc('\n', f);
}

static void put_clips(FILE *f, const dar_eval *v)
{
    put_measures(f, "method,set,clip,trajectory,aligned,frames,area");
    for (size_t i = 0; i < v->methods * v->clips; i++)
        for (int span = 0; span < DAR_EVAL_SPANS && v->cell[i].there; span++)
            for (int area = 0; area <= (int)v->clip[i % v->clips].masks; area++)
                put_line(f, v, i / v->clips, i % v->clips, span, 0, area, &v->cell[i].span[span]);
}

static void put_frames(FILE *f, const dar_eval *v)
{
    put_measures(f, "method,set,clip,frame,area");
    for (size_t i = 0; i < v->methods * v->clips; i++)
        for (size_t t = 0; t < v->clip[i % v->clips].frames && v->cell[i].there; t++)
            for (int area = 0; area <= (int)v->clip[i % v->clips].masks; area++)
                put_line(f, v, i / v->clips, i % v->clips, -1, t, area, &v->cell[i].frame[t]);
}

static void put_sweep_line(FILE *f, dar_eval *v, size_t m, const dar_eval_where *w)
{
    static const int measure[] = { DAR_METRIC_SSIM, DAR_EVAL_ALEX, DAR_METRIC_FLIP, DAR_METRIC_TEMP, DAR_METRIC_REF };
    const dar_eval_method *x = &v->method[m];
    dar_interval psnr = dar_eval_interval(v, m, v->methods, w, DAR_EVAL_ALL, DAR_METRIC_FRAME, DAR_METRIC_PSNR);
    if (!psnr.n) return;
    put_text(f, *x->set ? x->set : x->name);
    fprintf(f, ",%s,", x->mode);
    if (x->seed >= 0) fprintf(f, "%lld", (long long)x->seed);
    fputc(',', f);
    if (x->step >= 0) fprintf(f, "%lld", (long long)x->step);
    fputc(',', f);
    put_text(f, w->set);
    fputc(',', f);
    put_text(f, w->trajectory ? w->trajectory : "all");
    fprintf(f, ",%zu", psnr.n);
    put_number(f, psnr.mean);
    put_number(f, psnr.lo);
    put_number(f, psnr.hi);
    for (size_t k = 0; k < DAR_COUNT(measure); k++)
        put_number(f, dar_eval_interval(v, m, v->methods, w, DAR_EVAL_ALL, DAR_METRIC_FRAME, measure[k]).mean);
    fputc('\n', f);
}

static void put_sweep(FILE *f, dar_eval *v)
{
    fputs(DAR_EVAL_COLUMNS "\n", f);
    for (size_t m = 0; m < v->methods; m++)
        for (size_t c = 0; c < v->clips; c++) {
            dar_eval_where w = { .set = v->clip[c].set };
            if (is_first(v, c, false)) put_sweep_line(f, v, m, &w);
            w.trajectory = v->clip[c].trajectory;
            if (is_first(v, c, true)) put_sweep_line(f, v, m, &w);
        }
}

/* ---------------------------------------------------------------- */

dar_status dar_eval_files(dar_eval *v, const dar_eval_sheets *sheets, dar_err *e)
{
    static const char *const name[] = { "metrics.csv", "frames.csv", "table.csv", "tables.md" };
    DAR_TRY(write_json(v, e));
    for (size_t i = 0; i < DAR_COUNT(name); i++) {
        char *text = NULL;
        size_t size = 0;
        FILE *f = open_memstream(&text, &size);
        if (!f) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name[i]);
        if (i == 0) put_clips(f, v);
        if (i == 1) put_frames(f, v);
        if (i == 2) put_sweep(f, v);
        for (size_t k = 0; i == 3 && k < sheets->n; k++) dar_eval_sheet_markdown(&sheets->at[k], f);
        bool bad = ferror(f) != 0;
        bad = fclose(f) != 0 || bad;
        dar_status s =
            bad ? dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name[i]) : dar_eval_write(v, name[i], text, size, e);
        free(text);
        DAR_TRY(s);
    }
    return DAR_OK;
}
