/* output.c: see output.h. */
#include "infer/output.h"

#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "data/metric.h"
#include "data/png.h"
#include "data/sheet.h"
#include "data/video.h"
#include "infer/layers.h"
#include "lib/dir.h"
#include "lib/file.h"
#include "lib/json_write.h"
#include "lib/safetensors_write.h"
#include "lib/size.h"

#define COLUMNS 5
#define CELL    256 /* width of a picture of the sheet [px] */
#define LOUDER  4   /* distances are shown so many times as large */

enum { MP4, MKV, VIDEOS };

/* Distance from the truth; numbers that do not exist are null. */
struct eval {
    dar_metric *metric;
    dar_metric_clip clip;
    dar_json_writer json; /* inside its list of frames */
    float *cover;         /* [H, W] of the mesh */
    uint8_t *mask;
};

struct dar_output {
    dar_output_options o;
    dar_bundle *b;
    dar_dir_out dir;
    dar_video *video[VIDEOS];
    dar_sheet sheet;
    dar_layers layers;
    const char *settings;
    struct eval eval;
    size_t width, height, columns, latent; /* latent: frames of the grid that columns are chosen from */
    size_t result;                         /* row of it; after it ground truth and distance */
    uint8_t *truth, *map;                  /* [H, W, 3] */
};

static dar_status member(const dar_output *o, const char *name, char path[PATH_MAX], dar_err *e)
{
    if ((size_t)snprintf(path, PATH_MAX, "%s/%s", o->dir.temp, name) < PATH_MAX) return DAR_OK;
    return dar_fail(e, DAR_ERR_USAGE, "%s/%s: the path is too long", o->dir.path, name);
}

/* ---------------------------------------------------------------- sheet */

/* Latent frame of a column. */
static size_t latent_of(const dar_output *o, size_t column)
{
    return o->columns > 1 ? column * (o->latent - 1) / (o->columns - 1) : 0;
}

/* Channels [at, at + n) of the condition at latent frame f, in [0, 1], as a picture. */
static void paint(const dar_output *o, const dar_tensor *cond, size_t at, size_t n, size_t f)
{
    const float *x = cond->data;
    size_t pixels = o->width * o->height, frames = (size_t)cond->shape.d[2];
    for (size_t k = 0; k < 3; k++) {
        const float *plane = x + ((at + (n == 3 ? k : 0)) * frames + f) * pixels;
        for (size_t i = 0; i < pixels; i++) {
            float v = plane[i] < 0 ? 0 : plane[i] > 1 ? 1 : plane[i];
            o->map[3 * i + k] = (uint8_t)(255 * v + 0.5f);
        }
    }
}

static void draw_conditions(dar_output *o, const dar_condition *c, const dar_tensor *cond)
{
    size_t at = DAR_RAYS_CHANNELS;
    for (size_t i = 0; i < c->set.families && cond->data; i++) {
        const dar_family_info *f = &dar_family_table[c->set.family[i]];
        dar_shrink shrink = c->set.family[i] == DAR_FAMILY_SPARSE ? DAR_SHRINK_BRIGHTEST : DAR_SHRINK_MEAN;
        dar_sheet_row(&o->sheet, 1 + i, f->name, "as the network sees it");
        for (size_t k = 0; k < o->columns; k++) {
            paint(o, cond, at, f->channels, latent_of(o, k));
            dar_sheet_picture(&o->sheet, 1 + i, k, o->map, o->width, o->height, shrink);
        }
        at += f->channels;
    }
}

static dar_status begin_sheet(dar_output *o, const dar_output_shown *shown, dar_err *e)
{
    const dar_condition *c = shown->condition;
    const dar_tensor *cond = shown->cond;
    char text[64];
    const char *slash = strrchr(o->dir.path, '/');
    o->result = 1 + (cond->data ? c->set.families : 0);
    o->latent = (o->b->meta.frames - 1) / DAR_RAYS_GROUP + 1;
    o->columns = dar_least(o->latent, COLUMNS);
    snprintf(text, sizeof text, "%zu frames of %zu x %zu", o->b->meta.frames, o->width, o->height);
    dar_sheet_plan plan = { .title = slash ? slash + 1 : o->dir.path, .subtitle = text, .columns = o->columns };
    plan.rows = o->result + 1 + 2 * (size_t)o->b->rgb;
    plan.width = dar_least(CELL, o->width);
    plan.height = dar_most(1, plan.width * o->height / o->width);
    DAR_TRY(dar_sheet_init(&o->sheet, &plan, e));
    dar_sheet_row(&o->sheet, 0, "reference", "what it shall look like");
    dar_sheet_picture(&o->sheet, 0, 0, shown->reference, o->width, o->height, DAR_SHRINK_MEAN);
    draw_conditions(o, c, cond);
    dar_sheet_row(&o->sheet, o->result, "result", NULL);
    if (o->b->rgb) {
        dar_sheet_row(&o->sheet, o->result + 1, "truth", "the bundle's own frames");
        dar_sheet_row(&o->sheet, o->result + 2, "distance", "of result and truth, 4 times as large");
    }
    for (size_t k = 0; k < o->columns; k++) {
        snprintf(text, sizeof text, "frame %zu", DAR_RAYS_GROUP * latent_of(o, k));
        dar_sheet_column(&o->sheet, k, text);
    }
    return DAR_OK;
}

static dar_status draw_result(dar_output *o, size_t column, size_t index, const uint8_t *rgb, dar_err *e)
{
    size_t n = 3 * o->width * o->height;
    dar_sheet_picture(&o->sheet, o->result, column, rgb, o->width, o->height, DAR_SHRINK_MEAN);
    if (!o->b->rgb) return DAR_OK;
    DAR_TRY(dar_bundle_rgb(o->b, index, o->truth, e));
    for (size_t i = 0; i < n; i++) {
        int d = LOUDER * abs(rgb[i] - o->truth[i]);
        o->map[i] = (uint8_t)(d < 255 ? d : 255);
    }
    dar_sheet_picture(&o->sheet, o->result + 1, column, o->truth, o->width, o->height, DAR_SHRINK_MEAN);
    dar_sheet_picture(&o->sheet, o->result + 2, column, o->map, o->width, o->height, DAR_SHRINK_MEAN);
    return DAR_OK;
}

/* ---------------------------------------------------------------- metrics */

static dar_status begin_eval(dar_output *o, const uint8_t *reference, dar_err *e)
{
    struct eval *v = &o->eval;
    size_t n = o->width * o->height;
    if (!o->b->rgb)
        return dar_fail(e, DAR_ERR_USAGE, "%s: --eval: the bundle has no rgb.h5 to compare with", o->dir.path);
    v->cover = malloc(n * sizeof *v->cover);
    v->mask = malloc(n);
    if (!v->cover || !v->mask) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", o->dir.path);
    DAR_TRY(dar_metric_open(&v->metric, o->width, o->height, DAR_METRIC_ALL, e));
    dar_metric_begin(v->metric, reference);
    v->json.pretty = true;
    dar_json_write_object(&v->json, NULL);
    dar_json_write_array(&v->json, "frames");
    return DAR_OK;
}

static void print_row(dar_json_writer *w, const char *key, const dar_metric_row *row)
{
    static const char *const area[DAR_METRIC_AREAS] = { "frame", "mask" };
    dar_json_write_object(w, key);
    for (int a = 0; a < DAR_METRIC_AREAS; a++) {
        dar_json_write_object(w, area[a]);
        for (int k = 0; k < DAR_METRICS; k++) dar_json_write_number(w, dar_metric_name[k], row->v[a][k]);
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
}

static dar_status eval_frame(dar_output *o, size_t index, const uint8_t *rgb, dar_err *e)
{
    struct eval *v = &o->eval;
    dar_metric_row row;
    bool mask = dar_bundle_has(o->b, DAR_FAMILY_MASK);
    DAR_TRY(dar_bundle_rgb(o->b, index, o->truth, e));
    if (mask) DAR_TRY(dar_bundle_values(o->b, DAR_FAMILY_MASK, index, v->cover, e));
    for (size_t i = 0; mask && i < o->width * o->height; i++) v->mask[i] = (uint8_t)(255 * v->cover[i] + 0.5f);
    dar_metric_frame(v->metric, rgb, o->truth, mask ? v->mask : NULL, &row);
    dar_metric_clip_add(&v->clip, &row);
    print_row(&v->json, NULL, &row);
    return DAR_OK;
}

static void free_eval(struct eval *v)
{
    dar_metric_close(v->metric);
    dar_json_writer_free(&v->json);
    free(v->cover);
    free(v->mask);
}

/* ---------------------------------------------------------------- files */

static dar_status make_directory(const dar_output *o, const char *name, dar_err *e)
{
    char path[PATH_MAX];
    DAR_TRY(member(o, name, path, e));
    return mkdir(path, 0777) == 0 ? DAR_OK : dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
}

static dar_status begin_files(dar_output *o, dar_err *e)
{
    static const char *const name[VIDEOS] = { "video.mp4", "video.mkv" };
    static const dar_video_codec codec[VIDEOS] = { DAR_VIDEO_H264, DAR_VIDEO_FFV1 };
    const bool wanted[VIDEOS] = { o->o.mp4, o->o.mkv };
    char path[PATH_MAX];
    if (o->o.png) DAR_TRY(make_directory(o, "frames", e));
    if (o->o.exr) DAR_TRY(make_directory(o, "exr", e));
    if (o->o.exr) DAR_TRY(dar_layers_init(&o->layers, o->b, e));
    for (int i = 0; i < VIDEOS; i++) {
        if (!wanted[i]) continue;
        DAR_TRY(member(o, name[i], path, e));
        dar_video_how how = { .fps = o->b->meta.fps, .codec = codec[i], .comment = o->settings };
        DAR_TRY(dar_video_create(&o->video[i], path, o->width, o->height, &how, e));
    }
    return DAR_OK;
}

dar_status dar_output_create(dar_output **out, const char *path, dar_bundle *b, const dar_output_shown *shown,
                             const char *settings, const dar_output_options *options, dar_err *e)
{
    dar_output *o = calloc(1, sizeof *o);
    *out = NULL;
    if (!o) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    o->o = *options;
    o->b = b;
    o->settings = settings;
    o->width = (size_t)b->meta.width, o->height = (size_t)b->meta.height;
    o->truth = malloc(3 * o->width * o->height);
    o->map = malloc(3 * o->width * o->height);
    dar_status s = dar_dir_create(&o->dir, path, e);
    if (s == DAR_OK && !(o->truth && o->map)) s = dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    if (s == DAR_OK) s = begin_files(o, e);
    if (s == DAR_OK && o->o.eval) s = begin_eval(o, shown->reference, e);
    if (s == DAR_OK && o->o.sheet) s = begin_sheet(o, shown, e);
    if (s == DAR_OK) *out = o;
    else dar_output_discard(o);
    return s;
}

dar_status dar_output_frame(dar_output *o, size_t index, const uint8_t *rgb, dar_err *e)
{
    char name[32], path[PATH_MAX];
    if (o->o.png) {
        snprintf(name, sizeof name, "frames/%05zu.png", index);
        DAR_TRY(member(o, name, path, e));
        DAR_TRY(dar_png_save(path, &(dar_png){ o->width, o->height, 3, rgb, o->settings }, e));
    }
    if (o->o.exr) {
        snprintf(name, sizeof name, "exr/%05zu.exr", index);
        DAR_TRY(member(o, name, path, e));
        DAR_TRY(dar_layers_write(&o->layers, path, o->b, index, rgb, o->settings, e));
    }
    for (int i = 0; i < VIDEOS; i++)
        if (o->video[i]) DAR_TRY(dar_video_write(o->video[i], rgb, e));
    if (o->o.eval) DAR_TRY(eval_frame(o, index, rgb, e));
    for (size_t k = 0; k < o->columns; k++)
        if (index == DAR_RAYS_GROUP * latent_of(o, k)) DAR_TRY(draw_result(o, k, index, rgb, e));
    return DAR_OK;
}

dar_status dar_output_latent(dar_output *o, const dar_tensor *z, dar_err *e)
{
    char path[PATH_MAX];
    const dar_safetensors_item item = { "z", *z };
    DAR_TRY(member(o, "latent.safetensors", path, e));
    return dar_safetensors_write(path, &item, 1, NULL, e);
}

static dar_status write_text(const char *path, const char *text, dar_err *e)
{
    dar_file_out f;
    dar_status s = dar_file_create(&f, path, e);
    if (s == DAR_OK) s = dar_file_write(&f, text, strlen(text), e);
    if (s == DAR_OK) s = dar_file_write(&f, "\n", 1, e);
    if (s == DAR_OK) s = dar_file_commit(&f, e);
    dar_file_discard(&f);
    return s;
}

static dar_status finish_eval(dar_output *o, dar_err *e)
{
    struct eval *v = &o->eval;
    dar_metric_row mean;
    char path[PATH_MAX];
    dar_json_write_end(&v->json);
    dar_metric_clip_mean(&v->clip, &mean);
    print_row(&v->json, "mean", &mean);
    dar_json_write_end(&v->json);
    if (v->json.failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", o->dir.path);
    DAR_TRY(member(o, "metrics.json", path, e));
    return write_text(path, v->json.text, e);
}

dar_status dar_output_commit(dar_output *o, dar_err *e)
{
    char path[PATH_MAX];
    for (int i = 0; i < VIDEOS; i++)
        if (o->video[i]) DAR_TRY(dar_video_commit(o->video[i], e));
    if (o->o.sheet) {
        DAR_TRY(member(o, "sheet.png", path, e));
        DAR_TRY(dar_sheet_write(&o->sheet, path, e));
    }
    if (o->o.eval) DAR_TRY(finish_eval(o, e));
    DAR_TRY(member(o, "sample.json", path, e));
    DAR_TRY(write_text(path, o->settings, e));
    return dar_dir_commit(&o->dir, o->o.overwrite, e);
}

void dar_output_discard(dar_output *o)
{
    if (!o) return;
    for (int i = 0; i < VIDEOS; i++) dar_video_close(o->video[i]);
    dar_dir_discard(&o->dir);
    dar_sheet_free(&o->sheet);
    dar_layers_free(&o->layers);
    free_eval(&o->eval);
    free(o->truth);
    free(o->map);
    free(o);
}

dar_output_state dar_output_look(const char *path, const char *settings)
{
    char name[PATH_MAX];
    struct stat st;
    dar_file_map m;
    if (lstat(path, &st) != 0) return DAR_OUTPUT_NONE;
    if ((size_t)snprintf(name, sizeof name, "%s/sample.json", path) >= sizeof name) return DAR_OUTPUT_OTHER;
    if (dar_file_map_open(&m, name, NULL) != DAR_OK) return DAR_OUTPUT_OTHER;
    size_t n = strlen(settings);
    bool same = m.size == n + 1 && memcmp(m.data, settings, n) == 0;
    dar_file_map_close(&m);
    return same ? DAR_OUTPUT_DONE : DAR_OUTPUT_OTHER;
}
