/* dar_eval_film.c: small pictures side by side, as videos. */
#include "infer/dar_eval_film.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>

#include "data/video.h"
#include "lib/size.h"

#define FRAMES 81 /* of a video, at most: of longer clips every second, third, ... is shown */
#define AROUND 2  /* between tiles [px] */
#define STEP   5  /* of crf, by which a film that is too large is made coarser */
#define STEPS  4  /* at most; then it stays as it is */

enum { PICTURES, ERRORS, FILMS };

struct dar_eval_film {
    dar_eval_tiles tiles[FILMS];
    size_t width, height, frames, step;
    uint8_t *rgb[FILMS]; /* [frames, rows, columns, 3] whole pictures */
};

dar_eval_tiles dar_eval_film_tiles(size_t n, const dar_eval_clip *c, size_t width)
{
    dar_eval_tiles t = { .n = n, .width = dar_round_up(dar_least(width, c->width), 2) };
    t.columns = n <= 4 ? n : n <= 12 ? 4 : 5;
    t.rows = dar_blocks(n, t.columns);
    t.height = dar_most(2, t.width * c->height / c->width / 2 * 2);
    return t;
}

static size_t across(const dar_eval_tiles *t)
{
    return t->columns * (t->width + AROUND) - AROUND;
}

static size_t down(const dar_eval_tiles *t)
{
    return t->rows * (t->height + AROUND) - AROUND;
}

/* The mean of the pixels that become one. */
static void shrink(const uint8_t *x, size_t w, size_t h, uint8_t *y, size_t stride, size_t width, size_t height)
{
    for (size_t i = 0; i < height; i++)
        for (size_t j = 0; j < width; j++) {
            size_t top = i * h / height, bottom = dar_most(top + 1, (i + 1) * h / height);
            size_t left = j * w / width, right = dar_most(left + 1, (j + 1) * w / width);
            uint32_t sum[3] = { 0 }, n = (uint32_t)((bottom - top) * (right - left));
            for (size_t p = top; p < bottom; p++)
                for (size_t q = left; q < right; q++)
                    for (size_t k = 0; k < 3; k++) sum[k] += x[3 * (p * w + q) + k];
            for (size_t k = 0; k < 3; k++) y[i * stride + 3 * j + k] = (uint8_t)((sum[k] + n / 2) / n);
        }
}

static void shrink_map(const float *x, size_t w, size_t h, uint8_t *y, size_t stride, size_t width, size_t height)
{
    for (size_t i = 0; i < height; i++)
        for (size_t j = 0; j < width; j++) {
            size_t top = i * h / height, bottom = dar_most(top + 1, (i + 1) * h / height);
            size_t left = j * w / width, right = dar_most(left + 1, (j + 1) * w / width);
            float sum = 0;
            for (size_t p = top; p < bottom; p++)
                for (size_t q = left; q < right; q++) sum += x[p * w + q];
            dar_eval_film_colour(sum / (float)((bottom - top) * (right - left)), y + i * stride + 3 * j);
        }
}

void dar_eval_film_colour(float error, uint8_t rgb[3])
{
    static const uint8_t stops[][3] = { { 0, 0, 4 },      { 28, 16, 68 },    { 79, 18, 123 },
                                        { 129, 37, 129 }, { 181, 54, 122 },  { 229, 80, 100 },
                                        { 251, 135, 97 }, { 254, 194, 135 }, { 252, 253, 191 } };
    float at = fminf(fmaxf(error, 0), 1) * (float)(DAR_COUNT(stops) - 1);
    size_t i = dar_least((size_t)at, DAR_COUNT(stops) - 2);
    for (size_t k = 0; k < 3; k++)
        rgb[k] = (uint8_t)(stops[i][k] + (at - (float)i) * ((float)stops[i + 1][k] - stops[i][k]) + 0.5f);
}

void dar_eval_film_add(dar_eval_film *f, size_t tile, size_t t, const uint8_t *rgb, const float *map)
{
    if (t % f->step) return;
    for (int k = 0; k < FILMS; k++) {
        const dar_eval_tiles *l = &f->tiles[k];
        size_t stride = 3 * across(l), top = tile / l->columns * (l->height + AROUND);
        uint8_t *y = f->rgb[k] + (t / f->step * down(l) + top) * stride + tile % l->columns * 3 * (l->width + AROUND);
        if (k == PICTURES) shrink(rgb, f->width, f->height, y, stride, l->width, l->height);
        else if (map) shrink_map(map, f->width, f->height, y, stride, l->width, l->height);
    }
}

dar_status dar_eval_film_open(dar_eval_film **out, size_t tiles, const dar_eval_clip *c, size_t width, dar_err *e)
{
    dar_eval_film *f = *out = calloc(1, sizeof *f);
    if (!f) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", c->path);
    f->width = c->width;
    f->height = c->height;
    f->step = dar_blocks(c->frames, FRAMES);
    f->frames = dar_blocks(c->frames, f->step);
    for (int k = 0; k < FILMS; k++) {
        f->tiles[k] = dar_eval_film_tiles(tiles, c, k == ERRORS ? width / 2 : width);
        size_t bytes = f->frames * 3 * across(&f->tiles[k]) * down(&f->tiles[k]);
        if ((f->rgb[k] = malloc(bytes))) {
            memset(f->rgb[k], 20, bytes);
            continue;
        }
        dar_eval_film_close(f);
        *out = NULL;
        return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory for the pictures of the report", c->path);
    }
    return DAR_OK;
}

void dar_eval_film_close(dar_eval_film *f)
{
    if (!f) return;
    for (int k = 0; k < FILMS; k++) free(f->rgb[k]);
    free(f);
}

static dar_status write_film(const dar_eval_film *f, int k, const char *path, double fps, int coarser, dar_err *e)
{
    size_t w = across(&f->tiles[k]), h = down(&f->tiles[k]);
    dar_video *video;
    const dar_video_how how = { .fps = fps / (double)f->step, .codec = DAR_VIDEO_SMALL, .coarser = coarser };
    DAR_TRY(dar_video_create(&video, path, w, h, &how, e));
    dar_status s = DAR_OK;
    for (size_t t = 0; t < f->frames && s == DAR_OK; t++) s = dar_video_write(video, f->rgb[k] + 3 * t * w * h, e);
    if (s == DAR_OK) s = dar_video_commit(video, e);
    dar_video_close(video);
    return s;
}

/* What compresses badly, as noise does, is told by its size alone. */
static dar_status write_small(const dar_eval_film *f, int k, const char *path, double fps, double most, dar_err *e)
{
    struct stat st;
    for (int i = 0; i <= STEPS; i++) {
        DAR_TRY(write_film(f, k, path, fps, i * STEP, e));
        if (stat(path, &st) != 0) return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
        if ((double)st.st_size <= most) break;
    }
    return DAR_OK;
}

dar_status dar_eval_film_write(const dar_eval_film *f, const char *out, size_t number, const dar_eval_clip *c,
                               double most, dar_err *e)
{
    static const char *const ending[FILMS] = { "", "-error" };
    static const double share[FILMS] = { 0.75, 0.25 };
    char path[PATH_MAX];
    if (snprintf(path, sizeof path, "%s/clips", out) >= PATH_MAX - 32)
        return dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long", out);
    if (mkdir(path, 0777) != 0 && errno != EEXIST) return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
    size_t n = strlen(path);
    for (int k = 0; k < FILMS; k++) {
        snprintf(path + n, sizeof path - n, "/%05zu%s.mp4", number, ending[k]);
        DAR_TRY(write_small(f, k, path, c->fps, share[k] * most, e));
    }
    return DAR_OK;
}
