/* texture.c: wrap, then fetch. */
#include "data/texture.h"

#include <math.h>

#define FARTHEST 1e9 /* texels; beyond, f64 still counts them, int does not */

size_t dar_texture_wrap(double i, size_t n, dar_wrap mode)
{
    double m = (double)n;
    if (i >= 0 && i < m) return (size_t)i; /* the same in every mode, without a division */
    if (mode == DAR_WRAP_CLAMP) return i < 0 ? 0 : n - 1;
    double period = mode == DAR_WRAP_MIRROR ? 2 * m : m, k = i - period * floor(i / period);
    if (!(k >= 0 && k < period)) k = 0;
    size_t at = (size_t)k;
    return at < n ? at : 2 * n - 1 - at;
}

double dar_texture_alpha(const dar_scene *s, const dar_material *m, double u, double v)
{
    const dar_image *im = m->image == DAR_NONE ? NULL : &s->image[m->image];
    double alpha[4];

    if (!im || !im->rgba) return 1;
    double x = u * (double)im->width, y = v * (double)im->height;
    if (!(fabs(x) <= FARTHEST && fabs(y) <= FARTHEST)) return 1;
    if (!m->nearest) x -= 0.5, y -= 0.5;
    double x0 = floor(x), y0 = floor(y);
    for (int k = 0; k < 4; k++) {
        size_t column = dar_texture_wrap(x0 + (k & 1), im->width, m->wrap_u);
        size_t row = dar_texture_wrap(y0 + (k >> 1), im->height, m->wrap_v);
        alpha[k] = im->rgba[4 * (row * im->width + column) + 3] / 255.0;
        if (m->nearest) return alpha[0];
    }
    x -= x0, y -= y0;
    return (1 - y) * ((1 - x) * alpha[0] + x * alpha[1]) + y * ((1 - x) * alpha[2] + x * alpha[3]);
}
