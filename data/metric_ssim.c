/* metric_ssim.c: structural similarity of one row of windows.
 *
 *   S = (2 ux uy + C1) (2 sxy + C2) / ((ux^2 + uy^2 + C1) (sxx + syy + C2)),   C1 = (0.01 255)^2, C2 = (0.03 255)^2
 *
 * sxx and syy enter as their sum, so four maps are filtered, not five.  Down the columns first: sums of products of
 * bytes are exact in f32, and no row is kept for the next.  Moments are doubles: E[x^2] - E[x]^2 cancels.
 *
 * Source: Wang et al. 2004, eq. 13. */
#include "data/metric_inside.h"

#include "lib/size.h"

#define TAPS  (2 * DAR_SSIM_RADIUS + 1)
#define MAPS  4
#define BLOCK 256 /* values whose sums stay in the nearest cache */

/* exp(-i^2 / (2 1.5^2)), i = -5 .. 0, over their sum. */
static const double window[DAR_SSIM_RADIUS + 1] = { 0.001028380084479911, 0.007598758135239187, 0.036000772128431216,
                                                    0.10936068950970003,  0.21300553771125368,  0.2660117248617943 };

/* Maps of n values, `apart` from each other in m. */
static void down(const uint8_t *found, const uint8_t *truth, size_t stride, size_t n, double *m, size_t apart)
{
    double *restrict mx = m, *restrict my = m + apart, *restrict mq = my + apart, *restrict mp = mq + apart;
    for (size_t i = 0; i < n; i++) mx[i] = my[i] = mq[i] = mp[i] = 0;
    for (size_t k = 0; k <= DAR_SSIM_RADIUS; k++) {
        const uint8_t *restrict xa = found + k * stride, *restrict xb = found + (TAPS - 1 - k) * stride;
        const uint8_t *restrict ya = truth + k * stride, *restrict yb = truth + (TAPS - 1 - k) * stride;
        double w = k < DAR_SSIM_RADIUS ? window[k] : window[k] / 2; /* the middle row comes twice */
        for (size_t i = 0; i < n; i++) {
            float p = xa[i], q = xb[i], r = ya[i], s = yb[i];
            mx[i] += w * (double)(p + q);
            my[i] += w * (double)(r + s);
            mq[i] += w * (double)(p * p + q * q + (r * r + s * s));
            mp[i] += w * (double)(p * r + q * s);
        }
    }
}

static inline double across(const double *m)
{
    double sum = window[DAR_SSIM_RADIUS] * m[3 * DAR_SSIM_RADIUS];
    for (size_t k = 0; k < DAR_SSIM_RADIUS; k++) sum += window[k] * (m[3 * k] + m[3 * (TAPS - 1 - k)]);
    return sum;
}

static void similarity(size_t n, const double *x, const double *y, const double *squares, const double *products,
                       double *restrict s)
{
    const double c1 = 0.01 * 255 * (0.01 * 255), c2 = 0.03 * 255 * (0.03 * 255);
    for (size_t i = 0; i < n; i++) {
        double ux = across(x + i), uy = across(y + i);
        double both = ux * uy, own = ux * ux + uy * uy;
        double covariance = across(products + i) - both, variances = across(squares + i) - own;
        s[i] = (2 * both + c1) * (2 * covariance + c2) / ((own + c1) * (variances + c2));
    }
}

size_t dar_ssim_work(size_t values)
{
    return (MAPS + 1) * values;
}

void dar_ssim_row(const uint8_t *found, const uint8_t *truth, size_t width, size_t y, const uint8_t *inside,
                  double *work, double sum[DAR_METRIC_AREAS])
{
    size_t values = 3 * width, n = values - 3 * (TAPS - 1), first = (y - DAR_SSIM_RADIUS) * values;
    double *s = work + MAPS * values;
    for (size_t i = 0; i < values; i += BLOCK)
        down(found + first + i, truth + first + i, values, dar_least(BLOCK, values - i), work + i, values);
    similarity(n, work, work + values, work + 2 * values, work + 3 * values, s);
    for (size_t i = 0; i < n; i++) {
        sum[DAR_METRIC_FRAME] += s[i];
        if (inside[3 * DAR_SSIM_RADIUS + i]) sum[DAR_METRIC_MASK] += s[i];
    }
}
