/* mip.c: levels by means, lookups by two bilinear ones. */
#include "data/mip.h"

#include <math.h>
#include <string.h>

#include "data/texture.h"
#include "lib/real.h"
#include "lib/size.h"
#include "lib/thread.h"

#define FARTHEST 1e4f /* coordinates; beyond, no digits for a place within a texel are left */

/* ---------------------------------------------------------------- levels */

struct half {
    const dar_image *from;
    const dar_image *to;
    const dar_srgb *srgb;
};

/* Texels of `from` whose mean is texel i: [first, last]. */
static void span(size_t i, size_t from, size_t to, size_t *first, size_t *last)
{
    *first = i * from / to;
    *last = ((i + 1) * from - 1) / to;
}

static void mean(const struct half *h, size_t x, size_t y, uint8_t *out)
{
    size_t x0, x1, y0, y1;
    float sum[3] = { 0 }, alpha = 0, weights = 0;
    unsigned count = 0;
    span(x, h->from->width, h->to->width, &x0, &x1);
    span(y, h->from->height, h->to->height, &y0, &y1);
    for (size_t j = y0; j <= y1; j++)
        for (size_t i = x0; i <= x1; i++, count++) {
            const uint8_t *texel = h->from->rgba + 4 * (j * h->from->width + i);
            float weight = texel[3] + 0.01f;
            for (int c = 0; c < 3; c++) sum[c] += weight * h->srgb->linear[texel[c]];
            alpha += texel[3];
            weights += weight;
        }
    for (int c = 0; c < 3; c++) out[c] = dar_srgb_of(h->srgb, sum[c] / weights);
    out[3] = (uint8_t)(alpha / (float)count + 0.5f);
}

static void halve_row(void *ctx, size_t y, int thread)
{
    const struct half *h = ctx;
    (void)thread;
    for (size_t x = 0; x < h->to->width; x++) mean(h, x, y, h->to->rgba + 4 * (y * h->to->width + x));
}

static void init_one(dar_mip *m, const dar_image *picture, const dar_srgb *srgb, dar_arena *a)
{
    dar_mip made = { .levels = picture->rgba ? 1 : 0 };
    made.level[0] = *picture;
    while (made.levels && made.levels < DAR_MIP_LEVELS) {
        const dar_image *from = &made.level[made.levels - 1];
        dar_image *to = &made.level[made.levels];
        if (from->width == 1 && from->height == 1) break;
        to->width = dar_most(from->width / 2, 1);
        to->height = dar_most(from->height / 2, 1);
        to->rgba = dar_arena_push(a, 4 * to->width * to->height);
        struct half h = { from, to, srgb };
        if (!a->plan) dar_parallel(to->height, halve_row, &h);
        made.levels++;
    }
    if (!a->plan) *m = made;
}

dar_mip *dar_mip_init(const dar_scene *s, const dar_srgb *srgb, dar_arena *a)
{
    dar_mip *m = dar_arena_push(a, dar_mul_size(s->images, sizeof *m));
    for (size_t i = 0; i < s->images; i++) init_one(m + i, &s->image[i], srgb, a);
    return m;
}

/* ---------------------------------------------------------------- lookup */

static void bilinear(const dar_image *im, const dar_srgb *srgb, const dar_material *m, const float uv[2], bool nearest,
                     float share, float y[3])
{
    double x = uv[0] * (double)im->width, v = uv[1] * (double)im->height, shift = nearest ? 0 : 0.5;
    double x0 = floor(x - shift), y0 = floor(v - shift);
    float fx = (float)(x - shift - x0), fy = (float)(v - shift - y0);
    size_t column[2], row[2];
    for (int k = 0; k < 2; k++) {
        column[k] = dar_texture_wrap(x0 + k, im->width, m->wrap_u);
        row[k] = dar_texture_wrap(y0 + k, im->height, m->wrap_v);
    }
    if (nearest) fx = fy = 0;
    for (int k = 0; k < 4; k++) {
        const uint8_t *texel = im->rgba + 4 * (row[k >> 1] * im->width + column[k & 1]);
        float weight = share * (k & 1 ? fx : 1 - fx) * (k >> 1 ? fy : 1 - fy);
        for (int c = 0; c < 3; c++) y[c] += weight * srgb->linear[texel[c]];
    }
}

void dar_mip_at(const dar_mip *m, const dar_srgb *srgb, const dar_material *material, const float uv[2], float scale,
                float y[3])
{
    float last = (float)(m->levels - 1), at = dar_lesserf(dar_greaterf(scale, 0), last), low = floorf(at);
    const dar_image *level = &m->level[(size_t)low];
    bool sane = fabsf(uv[0]) <= FARTHEST && fabsf(uv[1]) <= FARTHEST;
    const float zero[2] = { 0, 0 }, *where = sane ? uv : zero;

    y[0] = y[1] = y[2] = 0;
    bilinear(level, srgb, material, where, material->nearest && at == 0, 1 - (at - low), y);
    if (at > low) bilinear(level + 1, srgb, material, where, false, at - low, y);
}
