/* metric_inside.h: the parts of data/metric.h that are filters.
 *
 * Both work on bands of rows, which are tasks; what a band gives is a sum over the frame and one over the mask. */
#ifndef DAR_DATA_METRIC_INSIDE_H
#define DAR_DATA_METRIC_INSIDE_H

#include <stddef.h>
#include <stdint.h>

#include "data/metric.h"
#include "data/srgb.h"

/* ---------------------------------------------------------------- SSIM */

#define DAR_SSIM_RADIUS 5

/* Sum of the local values of the windows centred in row y, all channels; inside [3 W]: 255 where the value counts for
 * the mask, else 0.  work: dar_ssim_work(3 W) doubles.  Needs radius <= y < H - radius, W >= 2 radius + 1. */
void dar_ssim_row(const uint8_t *found, const uint8_t *truth, size_t width, size_t y, const uint8_t *inside,
                  double *work, double sum[DAR_METRIC_AREAS]);
size_t dar_ssim_work(size_t values);

/* ---------------------------------------------------------------- FLIP */

#define DAR_FLIP_RADIUS 16

/* One separable filter, taps by distance from the centre; `odd`: the left half has the other sign. */
typedef struct dar_flip_taps {
    int radius;
    float w[DAR_FLIP_RADIUS + 1];
} dar_flip_taps;

typedef struct dar_flip {
    dar_flip_taps light, red_green, blue_yellow[2]; /* what the eye still sees apart */
    dar_flip_taps smooth, edge, point;              /* what it looks for */
    float to_xyz[3][3], to_rgb[3][3];               /* linear RGB and XYZ relative to white */
    float cmax;                                     /* the largest distance of colours, compressed */
    dar_srgb srgb;
} dar_flip;

void dar_flip_init(dar_flip *f);

/* Row y of rgb as y, x - y, y - z in planes [3, H, W]. */
void dar_flip_opponent(const dar_flip *f, const uint8_t *rgb, size_t width, size_t height, size_t y, float *planes);

/* Row y of the map, [W].  work: dar_flip_work(W) floats. */
void dar_flip_row(const dar_flip *f, const float *found, const float *truth, size_t width, size_t height, size_t y,
                  float *work, float *map);
size_t dar_flip_work(size_t width);

#endif
