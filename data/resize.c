/* resize.c: rows first, then columns, each output number a weighted sum. */
#include "data/resize.h"

#include <math.h>
#include <stdbool.h>
#include <stdlib.h>

#define LOBES 3
#define PI    3.14159265358979323846

/* Weights of one direction: output i is the sum of weight[i room + k] x[first[i] + k], k < count[i]. */
struct taps {
    size_t room, *first, *count;
    float *weight;
};

static double lanczos(double x)
{
    if (fabs(x) >= LOBES) return 0;
    return x == 0 ? 1 : LOBES * sin(PI * x) * sin(PI * x / LOBES) / (PI * PI * x * x);
}

static void free_taps(struct taps *t)
{
    free(t->first);
    free(t->count);
    free(t->weight);
}

/* n outputs that cover [from, from + length) of `size` inputs. */
static bool make_taps(struct taps *t, size_t size, double from, double length, size_t n)
{
    double scale = length / (double)n, wide = fmax(scale, 1), reach = LOBES * wide;
    t->room = (size_t)ceil(2 * reach) + 1;
    t->first = malloc(n * sizeof *t->first);
    t->count = malloc(n * sizeof *t->count);
    t->weight = malloc(n * t->room * sizeof *t->weight);
    if (!t->first || !t->count || !t->weight) return false;
    for (size_t i = 0; i < n; i++) {
        double centre = from + ((double)i + 0.5) * scale - 0.5, sum = 0;
        double begin = fmax(ceil(centre - reach), 0), end = fmin(floor(centre + reach), (double)size - 1);
        t->first[i] = (size_t)begin;
        t->count[i] = (size_t)(end - begin) + 1;
        for (size_t k = 0; k < t->count[i]; k++) sum += lanczos((begin + (double)k - centre) / wide);
        for (size_t k = 0; k < t->count[i]; k++)
            t->weight[i * t->room + k] = (float)(lanczos((begin + (double)k - centre) / wide) / sum);
    }
    return true;
}

/* A row of x, 3 numbers a pixel, in the new width. */
static void shrink_row(const struct taps *t, const uint8_t *x, float *y, size_t width)
{
    for (size_t i = 0; i < width; i++) {
        const uint8_t *from = x + 3 * t->first[i];
        float sum[3] = { 0 };
        for (size_t k = 0; k < t->count[i]; k++)
            for (size_t c = 0; c < 3; c++) sum[c] += t->weight[i * t->room + k] * (float)from[3 * k + c];
        for (size_t c = 0; c < 3; c++) y[3 * i + c] = sum[c];
    }
}

static void shrink_column(const struct taps *t, size_t row, const float *x, float *sum, uint8_t *y, size_t n)
{
    for (size_t i = 0; i < n; i++) sum[i] = 0;
    for (size_t k = 0; k < t->count[row]; k++) {
        const float *from = x + (t->first[row] + k) * n, w = t->weight[row * t->room + k];
        for (size_t i = 0; i < n; i++) sum[i] += w * from[i];
    }
    for (size_t i = 0; i < n; i++) y[i] = (uint8_t)(fminf(fmaxf(sum[i], 0), 255) + 0.5f);
}

dar_resize_part dar_resize_cover(size_t w, size_t h, size_t width, size_t height)
{
    double scale = fmin((double)w / (double)width, (double)h / (double)height);
    dar_resize_part p = { .width = scale * (double)width, .height = scale * (double)height };
    p.left = ((double)w - p.width) / 2;
    p.top = ((double)h - p.height) / 2;
    return p;
}

dar_status dar_resize(const char *name, const uint8_t *x, size_t w, size_t h, uint8_t *y, size_t width, size_t height,
                      dar_err *e)
{
    dar_resize_part p = dar_resize_cover(w, h, width, height);
    struct taps across = { 0 }, down = { 0 };
    float *rows = malloc(3 * width * (h + 1) * sizeof *rows); /* and one to sum in */
    bool good = make_taps(&across, w, p.left, p.width, width) && make_taps(&down, h, p.top, p.height, height) && rows;
    for (size_t i = 0; i < h && good; i++) shrink_row(&across, x + 3 * w * i, rows + 3 * width * i, width);
    for (size_t i = 0; i < height && good; i++)
        shrink_column(&down, i, rows, rows + 3 * width * h, y + 3 * width * i, 3 * width);
    free_taps(&across);
    free_taps(&down);
    free(rows);
    return good ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name);
}
