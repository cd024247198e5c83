/* dar_eval.c: the program dar-eval: pictures of several methods and the truth in; tables, plots, pictures out. */
#include "infer/dar_eval.h"

#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "lib/dir.h"
#include "lib/log.h"
#include "lib/program.h"

static struct {
    const char *out, *base, *beside, *key;
    dar_eval_codec_files codec;
    dar_arg_list against, lpips, study, answers;
    int align;
    bool masked, no_reference, no_report, overwrite;
    int64_t tile;
    double size;
    dar_common common;
} o;

static const char *const align_names[] = { "none", "normalized-time", NULL };

/* clang-format off */
static const dar_option options[] = {
    { .name = "against", .placeholder = "BUNDLES", .type = DAR_ARG_WORDS, .target = &o.against,
      .help = "bundles with true pictures, or directories of them" },
    { .name = "out", .letter = 'o', .placeholder = "DIR", .type = DAR_ARG_TEXT, .target = &o.out,
      .help = "directory of the results: report.html, sheet.png, tables.md, metrics.json, metrics.csv, frames.csv, "
      "table.csv" },
    { .name = "overwrite", .type = DAR_ARG_FLAG, .target = &o.overwrite, .help = "replace what is there" },

    { .help = "Measures" },
    { .name = "masked", .type = DAR_ARG_FLAG, .target = &o.masked,
      .help = "tables of the foreground alone, too; metrics.json and the CSV files always have it" },
    { .name = "align", .placeholder = "HOW", .type = DAR_ARG_CHOICE, .target = &o.align, .standard = "none",
      .names = align_names, .help = "normalized-time: pictures of other length are sampled at frame "
      "round(t / (T - 1) (T' - 1)), of other size resized; such methods are shown, not ranked" },
    { .name = "lpips", .placeholder = "FILE...", .type = DAR_ARG_WORDS, .target = &o.lpips,
      .help = "weights of LPIPS: of AlexNet or VGG16 as torchvision has them and of the lpips package, or one file of "
      "both; .pth or .safetensors, in any order" },
    { .name = "model", .placeholder = "DIR|PRESET", .type = DAR_ARG_TEXT, .target = &o.codec.model,
      .help = "adds the row 'codec': the truth through the autoencoder of this model, which its renders cannot excel" },
    { .name = "weights", .placeholder = "DIR", .type = DAR_ARG_TEXT, .target = &o.codec.weights,
      .help = "where its weights are (default: where the model is)" },
    { .name = "vae", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &o.codec.vae,
      .help = "weights of its autoencoder" },
    { .name = "base", .placeholder = "NAME", .type = DAR_ARG_TEXT, .target = &o.base,
      .help = "the method that others are compared with, clip by clip (default: the first)" },
    { .name = "beside", .placeholder = "CSV", .type = DAR_ARG_TEXT, .target = &o.beside,
      .help = "published figures, in the columns of table.csv, to show beside ours: infer/paper.csv" },
    { .name = "no-reference", .type = DAR_ARG_FLAG, .target = &o.no_reference,
      .help = "without the rows 'repeat frame 0', 'oracle warp' and 'codec'" },

    { .help = "Report" },
    { .name = "no-report", .type = DAR_ARG_FLAG, .target = &o.no_report, .help = "numbers only: no report.html" },
    { .name = "tile", .placeholder = "PX", .type = DAR_ARG_INT, .target = &o.tile, .lo = 16, .hi = 4096,
      .help = "width of a picture in it (default: what its size has room for, at most 320)" },
    { .name = "report-size", .placeholder = "MB", .type = DAR_ARG_NUMBER, .target = &o.size, .standard = "60",
      .lo = 0.01, .hi = 10000, .help = "what it stays below: of many clips and methods pictures are smaller, then "
      "coarser" },

    { .help = "People" },
    { .name = "study", .placeholder = "A:B...", .type = DAR_ARG_WORDS, .target = &o.study,
      .help = "measure nothing: make study.html, which shows pairs of videos of A and B without their names and asks "
      "three questions, in an order drawn from --seed, and study-key.json, which it is read with" },
    { .name = "answers", .placeholder = "FILE...", .type = DAR_ARG_WORDS, .target = &o.answers,
      .help = "what people saved from study.html: preferences with intervals and tests, answers.md and .json" },
    { .name = "key", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &o.key,
      .help = "study-key.json of their study" },
};
/* clang-format on */

/* ---------------------------------------------------------------- what is asked for */

static dar_status check_options(const dar_run *r, dar_err *e)
{
    struct stat st;
    if (o.answers.n && !o.key) return dar_fail(e, DAR_ERR_USAGE, "--answers: expected --key study-key.json with it");
    if (!o.answers.n && !r->program->rests)
        return dar_fail(e, DAR_ERR_USAGE, "%s: expected a method's directory", r->program->name);
    if (!o.answers.n && !o.against.n)
        return dar_fail(e, DAR_ERR_USAGE, "%s: expected --against BUNDLES", r->program->name);
    if (!o.out) return dar_fail(e, DAR_ERR_USAGE, "%s: expected -o DIR", r->program->name);
    if (!o.overwrite && lstat(o.out, &st) == 0)
        return dar_fail(e, DAR_ERR_USAGE, "%s: is there already; it is not overwritten unasked", o.out);
    return DAR_OK;
}

static dar_status open_weights(dar_eval *v, dar_err *e)
{
    if (!(v->weights = calloc(o.lpips.n + 1, sizeof *v->weights))) return dar_fail(e, DAR_ERR_NOMEM, "out of memory");
    for (; v->files < o.lpips.n; v->files++) DAR_TRY(dar_weights_open(&v->weights[v->files], o.lpips.at[v->files], e));
    for (int k = 0; k < DAR_LPIPS_NETS; k++)
        if (dar_lpips_there((dar_lpips_net)k, v->weights, v->files)) return DAR_OK;
    if (!v->files) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: found no trunk of alex or vgg (features.0.weight)", o.lpips.at[0]);
}

static dar_status find_base(dar_eval *v, dar_err *e)
{
    while (o.base && v->base < v->methods && strcmp(v->method[v->base].name, o.base) != 0) v->base++;
    if (v->base < v->methods) return DAR_OK;
    return dar_fail(e, DAR_ERR_USAGE, "--base: found '%s', expected a method's name, such as '%s'", o.base,
                    v->method[0].name);
}

/* The model of the row 'codec', if all clips fit it. */
static dar_status open_codec(dar_eval *v, dar_err *e)
{
    if (o.study.n || o.no_reference || !o.codec.model) return DAR_OK;
    DAR_TRY(dar_eval_codec_open(&v->codec, &o.codec, e));
    for (size_t c = 0; c < v->clips; c++) DAR_TRY(dar_eval_codec_check(v->codec, &v->clip[c], e));
    return DAR_OK;
}

/* Pixels that the report has room for: some 0.02 bytes each, errors and base64 with them. */
static size_t tile_width(const dar_eval *v)
{
    static const size_t width[] = { 320, 288, 256, 224, 192, 160, 128, 96 };
    for (size_t i = 0; i + 1 < DAR_COUNT(width); i++) {
        double pixels = 0;
        for (size_t c = 0; c < v->clips; c++) {
            double frames = v->clip[c].frames < 81 ? (double)v->clip[c].frames : 81;
            double w = v->clip[c].width < width[i] ? (double)v->clip[c].width : (double)width[i];
            pixels += frames * w * w * (double)v->clip[c].height / (double)v->clip[c].width * (double)v->methods;
        }
        if (pixels < 40e6 * o.size) return width[i];
    }
    return width[DAR_COUNT(width) - 1];
}

static dar_status find_all(dar_eval *v, const dar_run *r, dar_err *e)
{
    if (o.answers.n) return DAR_OK;
    DAR_TRY(dar_eval_find_clips(v, o.against.at, o.against.n, e));
    DAR_TRY(open_codec(v, e));
    DAR_TRY(dar_eval_find_methods(v, r->program->rest, (size_t)r->program->rests, !o.no_reference, e));
    DAR_TRY(find_base(v, e));
    DAR_TRY(open_weights(v, e));
    v->report = 0.7 * 1e6 * o.size; /* as base64 four thirds, and there are tables */
    if (o.beside) DAR_TRY(dar_eval_beside_open(v, o.beside, e));
    v->tile = o.no_report ? 0 : o.tile ? (size_t)o.tile : tile_width(v);
    return DAR_OK;
}

/* ---------------------------------------------------------------- the work */

static void plan(dar_eval *v, dar_run *r)
{
    char path[PATH_MAX];
    size_t frames = 0, missing = 0;
    for (size_t m = 0; m < v->methods; m++)
        for (size_t c = 0; c < v->clips; c++) {
            bool there = v->method[m].kind != DAR_EVAL_GIVEN || dar_eval_find(v, m, c, path);
            frames += there ? v->clip[c].frames : 0;
            missing += !there;
        }
    dar_run_say(r, "%zu methods on %zu clips: %zu frames, %zu clips missing", v->methods, v->clips, frames, missing);
    dar_json_write_int(&r->json, "methods", (int64_t)v->methods);
    dar_json_write_int(&r->json, "clips", (int64_t)v->clips);
    dar_json_write_int(&r->json, "frames", (int64_t)frames);
    dar_json_write_int(&r->json, "missing", (int64_t)missing);
}

static void tell(dar_eval *v, dar_run *r)
{
    const int measure[] = { DAR_METRIC_PSNR, DAR_METRIC_SSIM, DAR_METRIC_FLIP };
    plan(v, r);
    dar_json_write_object(&r->json, "psnr");
    for (size_t m = 0; m < v->methods; m++) {
        double x[3];
        for (size_t k = 0; k < 3; k++)
            x[k] = dar_eval_interval(v, m, v->methods, NULL, DAR_EVAL_ALL, DAR_METRIC_FRAME, measure[k]).mean;
        dar_run_say(r, "%-24s %3zu clips   psnr %6.2f   ssim %.3f   flip %.3f", v->method[m].name, v->method[m].clips,
                    x[0], x[1], x[2]);
        dar_json_write_number(&r->json, v->method[m].name, x[0]);
    }
    dar_json_write_end(&r->json);
    dar_json_write_text(&r->json, "out", o.out);
    if (!v->codec && !o.no_reference)
        dar_log(DAR_LOG_INFO, "no row 'codec', which is the most that renders can reach: it needs --model");
}

static dar_status check_found(const dar_eval *v, dar_err *e)
{
    for (size_t m = 0; m < v->methods; m++) {
        const dar_eval_method *x = &v->method[m];
        if (x->kind != DAR_EVAL_GIVEN || x->clips == v->clips) continue;
        if (!x->clips)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: found pictures of no clip, expected %s/%s and so on", x->path,
                            x->path, v->clip[0].name);
        dar_log(DAR_LOG_WARNING, "%s: found %zu of %zu clips; its row is a mean over these", x->name, x->clips,
                v->clips);
    }
    return DAR_OK;
}

static dar_status work(dar_eval *v, dar_err *e)
{
    dar_eval_sheets sheets = { 0 };
    dar_progress p = dar_progress_begin("evaluate", "clips", (double)v->clips);
    dar_status s = v->tile ? dar_eval_sheet_begin(v, e) : DAR_OK;
    for (size_t c = 0; c < v->clips && s == DAR_OK; c++) {
        s = dar_eval_clip_run(v, c, e);
        dar_progress_step(&p, (double)c + 1, v->clip[c].name);
    }
    dar_progress_end(&p);
    if (s == DAR_OK) s = check_found(v, e);
    if (s == DAR_OK) dar_eval_paper(v, &sheets);
    if (s == DAR_OK && sheets.failed) s = dar_fail(e, DAR_ERR_NOMEM, "dar-eval: out of memory for tables");
    if (s == DAR_OK) s = dar_eval_files(v, &sheets, e);
    if (s == DAR_OK && v->tile) s = dar_eval_page(v, &sheets, e);
    if (s == DAR_OK && v->tile) s = dar_eval_sheet_end(v, e);
    dar_eval_sheets_free(&sheets);
    return s;
}

/* Into v->out; *n: trials or answers. */
static dar_status ask(dar_eval *v, size_t *n, dar_err *e)
{
    return o.answers.n ? dar_eval_answers(v, o.key, o.answers.at, o.answers.n, n, e)
                       : dar_eval_study(v, o.study.at, o.study.n, n, e);
}

static void tell_people(dar_run *r, size_t n)
{
    const char *what = o.answers.n ? "answers" : "trials";
    dar_run_say(r, "%s: %zu %s", o.out, n, what);
    dar_json_write_int(&r->json, what, (int64_t)n);
    dar_json_write_text(&r->json, "out", o.out);
}

static void free_all(dar_eval *v)
{
    for (size_t i = 0; v->cell && i < v->methods * v->clips; i++) free(v->cell[i].frame);
    for (size_t i = 0; i < v->files; i++) dar_weights_close(v->weights[i]);
    dar_eval_codec_close(v->codec);
    free(v->weights);
    dar_sheet_free(&v->sheet);
    free(v->figure);
    free(v->method);
    free(v->clip);
    free(v->cell);
    free(v->value);
    free(v->work);
}

static dar_status evaluate(dar_run *r, dar_err *e)
{
    dar_eval v = { .align = o.align != 0, .masked = o.masked, .seed = o.common.seed };
    dar_dir_out dir = { .lock = -1 };
    DAR_TRY(check_options(r, e));
    v.work = malloc(DAR_BOOTSTRAP * sizeof *v.work);
    dar_status s = v.work ? find_all(&v, r, e) : dar_fail(e, DAR_ERR_NOMEM, "dar-eval: out of memory");
    bool people = o.answers.n || o.study.n;
    size_t n = 0;
    if (s == DAR_OK && o.common.dry_run) {
        if (!o.answers.n) plan(&v, r);
    } else if (s == DAR_OK) {
        s = dar_dir_create(&dir, o.out, e);
        v.out = dir.temp;
        if (s == DAR_OK) s = people ? ask(&v, &n, e) : work(&v, e);
        if (s == DAR_OK) s = dar_dir_commit(&dir, o.overwrite, e);
        dar_dir_discard(&dir);
        if (s == DAR_OK && people) tell_people(r, n);
        else if (s == DAR_OK) tell(&v, r);
    }
    free_all(&v);
    return s;
}

int main(int argc, char **argv)
{
    static const dar_program program = {
        .name = "dar-eval",
        .summary = "Compare pictures of animated scenes, of one or several methods, with the true ones of their "
                   "bundles: tables with intervals, plots and pictures.",
        .options = options,
        .n_options = DAR_COUNT(options),
        .common = &o.common,
        .run = evaluate,
        .rest_name = "[NAME=]OUT...",
        .rest_help = "methods: a directory with pictures or a video for each bundle, by the bundle's name, such as "
                     "dar-sample leaves; NAME may be a channel set, with @STEP after it; method.json in the directory "
                     "may say name, set, mode, step, seed, external",
        .rest_least = 0,
        .rest_most = 1000,
    };
    return dar_program_main(&program, argc, argv);
}
