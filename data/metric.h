/* metric.h: how far the frames of a clip are from the true ones: pixels in, numbers out.
 *
 *   psnr          10 log10(255^2 / MSE) [dB], MSE over pixels and channels; 100 where that is more, or MSE = 0
 *   ssim          Gaussian window of 11, sigma 1.5, moments of the population; mean over windows that lie inside and
 *                 over channels.  scikit-image: gaussian_weights, sigma=1.5, use_sample_covariance=False
 *   flip          mean of the LDR-FLIP map at 67.02 pixels per degree: 0 equal, 1 as far as can be
 *   templ1        mean |p[t] - p[t-1]|: how much the result moves, by itself
 *   templ1_truth  mean |(p[t] - p[t-1]) - (g[t] - g[t-1])|: how much it moves otherwise than the truth
 *   refl1         mean |p[t] - reference|
 *   sharpness     sum |grad p| / sum |grad g|: 1 as sharp as the truth, less where it is blurred, which PSNR forgives.
 *                 |grad| = hypot of the differences to the right and below, of pixels that have both
 *
 * with p the result, g the truth, L1 distances on the scale 0 .. 255.  The paper's TempL1 may be read either way.
 *
 * Every number also exists restricted to a mask: of the same sums only the pixels where it is 128 or more, for ssim the
 * windows centred there, for templ1 the mask of frame t.  Numbers that do not exist are NAN: templ1 of the first frame,
 * ssim of pictures smaller than the window, sharpness where the truth is flat, anything of no pixel at all.
 *
 *     dar_metric_begin(m, reference);
 *     for (each frame) {
 *         dar_metric_frame(m, found, truth, mask, &row);
 *         dar_metric_clip_add(&clip, &row);
 *     }
 *     dar_metric_clip_mean(&clip, &mean);
 *
 * Sources: Wang et al. 2004; Andersson et al. 2020 (FLIP).  Same bits for any number of threads. */
#ifndef DAR_DATA_METRIC_H
#define DAR_DATA_METRIC_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"

typedef enum dar_metric_kind {
    DAR_METRIC_PSNR,
    DAR_METRIC_SSIM,
    DAR_METRIC_FLIP,
    DAR_METRIC_TEMP,
    DAR_METRIC_TEMP_TRUTH,
    DAR_METRIC_REF,
    DAR_METRIC_SHARP,
    DAR_METRICS
} dar_metric_kind;

#define DAR_METRIC_ALL ((1u << DAR_METRICS) - 1)

extern const char *const dar_metric_name[DAR_METRICS]; /* "psnr" */

typedef enum dar_metric_area { DAR_METRIC_FRAME, DAR_METRIC_MASK, DAR_METRIC_AREAS } dar_metric_area;

typedef struct dar_metric_row {
    double v[DAR_METRIC_AREAS][DAR_METRICS]; /* NAN: there is none */
} dar_metric_row;

/* ---------------------------------------------------------------- frames */

typedef struct dar_metric dar_metric;

/* For pictures of this size; `wanted`: bits 1 << kind, the others are NAN.  On failure *out is NULL. */
dar_status dar_metric_open(dar_metric **out, size_t width, size_t height, unsigned wanted, dar_err *e);
void dar_metric_close(dar_metric *m); /* accepts NULL */

/* A new clip.  reference rgb [H, W, 3], which must live as long as the clip; NULL: none, refl1 does not exist. */
void dar_metric_begin(dar_metric *m, const uint8_t *reference);

/* The next frame, found and truth rgb [H, W, 3], mask [H, W] or NULL. */
void dar_metric_frame(dar_metric *m, const uint8_t *found, const uint8_t *truth, const uint8_t *mask,
                      dar_metric_row *row);

/* The FLIP map [H, W] of the last frame, 0 .. 1, if flip is wanted. */
const float *dar_metric_map(const dar_metric *m);

/* ---------------------------------------------------------------- clips */

/* Means over frames, each over those frames in which the number exists.  Start with a zeroed one. */
typedef struct dar_metric_clip {
    double sum[DAR_METRIC_AREAS][DAR_METRICS];
    size_t n[DAR_METRIC_AREAS][DAR_METRICS];
} dar_metric_clip;

void dar_metric_clip_add(dar_metric_clip *c, const dar_metric_row *row);
void dar_metric_clip_mean(const dar_metric_clip *c, dar_metric_row *mean);

#endif
