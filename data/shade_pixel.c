/* shade_pixel.c: samples to surfaces, surfaces to pixels. */
#include <math.h>
#include <string.h>

#include "data/shade_inside.h"
#include "lib/real.h"
#include "lib/thread.h"

#define SURFACES 8 /* triangles kept at hand by a row */

struct job {
    const dar_shade *s;
    const dar_view *view;
    uint8_t *rgb;
    size_t pixels; /* samples of the whole picture */
};

static float dot(const float a[3], const float b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static bool unit(float x[3])
{
    float square = dot(x, x), scale = 1 / sqrtf(square);
    if (!(square > 1e-30f)) return false;
    for (int c = 0; c < 3; c++) x[c] *= scale;
    return true;
}

/* ---------------------------------------------------------------- a triangle */

static void set_material(const dar_shade *s, dar_shade_surface *f, const dar_primitive *q)
{
    f->material = NULL;
    f->mip = NULL;
    f->factor[0] = f->factor[1] = f->factor[2] = 1;
    f->gloss = DAR_GLOSS_UNKNOWN;
    f->metallic = 0;
    if (q->material == DAR_NONE) return;
    const dar_material *m = f->material = &s->scene->material[q->material];
    for (int c = 0; c < 3; c++) f->factor[c] = (float)m->color[c];
    f->gloss = (float)m->gloss;
    f->metallic = (float)m->metallic;
    if (q->textured && m->image != DAR_NONE && s->mip[m->image].levels) f->mip = &s->mip[m->image];
}

/* From the areas of the triangle in the texture and in the world. */
static float texels_of(const dar_shade_surface *f, float area)
{
    const dar_image *im = &f->mip->level[0];
    float u1 = f->uv[1][0] - f->uv[0][0], v1 = f->uv[1][1] - f->uv[0][1];
    float u2 = f->uv[2][0] - f->uv[0][0], v2 = f->uv[2][1] - f->uv[0][1];
    float in_texture = fabsf(u1 * v2 - u2 * v1) * (float)im->width * (float)im->height;
    return 0.5f * log2f(dar_greaterf(in_texture, 1e-12f) / dar_greaterf(area, 1e-30f));
}

/* Its own normal, towards the camera; returns twice its area. */
static float set_own(dar_shade_surface *f, const dar_view *v)
{
    float p[3], q[3], toward = 0;
    for (int c = 0; c < 3; c++) {
        p[c] = f->place[1][c] - f->place[0][c];
        q[c] = f->place[2][c] - f->place[0][c];
    }
    for (int c = 0; c < 3; c++) {
        int d = (c + 1) % 3, e = (c + 2) % 3;
        f->own[c] = p[d] * q[e] - p[e] * q[d];
        toward += f->own[c] * ((float)v->c2w[4 * c + 3] - f->place[0][c]);
    }
    float area = sqrtf(dot(f->own, f->own));
    if (!unit(f->own)) f->own[0] = f->own[1] = 0, f->own[2] = 1;
    for (int c = 0; c < 3 && toward < 0; c++) f->own[c] = -f->own[c];
    return area;
}

static void set_surface(const struct job *j, dar_shade_surface *f, uint32_t instance, uint32_t triangle)
{
    const dar_shade *s = j->s;
    const dar_instance *in = &s->scene->instance[instance];
    const dar_mesh *m = &s->scene->mesh[in->mesh];
    const uint32_t *index = m->index + 3 * (size_t)triangle;
    size_t k = 0;

    while (m->primitive[k].triangle + m->primitive[k].triangles <= triangle) k++;
    set_material(s, f, &m->primitive[k]);
    for (int i = 0; i < 3; i++) {
        size_t v = index[i], posed = in->vertex + v;
        memcpy(f->place[i], s->raster.position + 3 * posed, sizeof f->place[i]);
        memcpy(f->normal[i], s->raster.normal + 3 * posed, sizeof f->normal[i]);
        for (int c = 0; c < 3; c++) f->color[i][c] = f->factor[c] * (m->color ? m->color[4 * v + (size_t)c] : 1);
        if (f->mip) memcpy(f->uv[i], m->uv + 2 * v, sizeof f->uv[i]);
    }
    float area = set_own(f, j->view);
    if (f->mip) f->texels = texels_of(f, area);
}

/* ---------------------------------------------------------------- a place */

static void blend(const float b[3], const float *x0, const float *x1, const float *x2, int n, float *y)
{
    for (int c = 0; c < n; c++) y[c] = b[0] * x0[c] + b[1] * x1[c] + b[2] * x2[c];
}

/* Radiance of `share` of a pixel, which shows the surface at b. */
static void shade(const struct job *j, const dar_shade_surface *f, const float b[3], float share, float y[3])
{
    const dar_view *v = j->view;
    dar_shade_place p = { .gloss = f->gloss, .metallic = f->metallic };

    blend(b, f->place[0], f->place[1], f->place[2], 3, p.x);
    blend(b, f->normal[0], f->normal[1], f->normal[2], 3, p.normal);
    blend(b, f->color[0], f->color[1], f->color[2], 3, p.color);
    memcpy(p.own, f->own, sizeof p.own);
    if (!unit(p.normal)) memcpy(p.normal, f->own, sizeof p.normal);
    float turn = dot(p.normal, f->own) < 0 ? -1 : 1, depth = 0;
    for (int c = 0; c < 3; c++) {
        p.normal[c] *= turn;
        p.eye[c] = (float)v->c2w[4 * c + 3] - p.x[c];
        depth -= (float)v->c2w[4 * c + 2] * p.eye[c];
    }
    unit(p.eye);
    if (f->mip) {
        float uv[2], texture[3], slant = dar_greaterf(dot(f->own, p.eye), 0.1f);
        float side = depth * sqrtf(share / (slant * (float)(v->fx * v->fy)));
        blend(b, f->uv[0], f->uv[1], f->uv[2], 2, uv);
        dar_mip_at(f->mip, j->s->srgb, f->material, uv, f->texels + log2f(side), texture);
        for (int c = 0; c < 3; c++) p.color[c] *= texture[c];
    }
    dar_shade_radiance(j->s, &p, y);
}

static void background(const struct job *j, size_t x, size_t y, float light[3])
{
    const dar_view *v = j->view;
    float ray[3] = { (float)(((double)x + 0.5 - v->cx) / v->fx), (float)(((double)y + 0.5 - v->cy) / v->fy), 1 }, d[3];
    for (int c = 0; c < 3; c++) {
        const double *m = v->c2w + 4 * c;
        d[c] = (float)m[0] * ray[0] + (float)m[1] * ray[1] + (float)m[2] * ray[2];
    }
    unit(d);
    dar_skylight_at(j->s->sky, d, light);
}

/* ---------------------------------------------------------------- a pixel */

/* Samples of one triangle. */
struct group {
    uint64_t key;
    float b[2], count;
};

/* Groups of the pixel's samples; those of no surface have key 0. */
static size_t group_samples(const struct job *j, size_t x, size_t y, struct group group[])
{
    const dar_shade *s = j->s;
    const dar_gbuffer *g = &s->g;
    size_t n = (size_t)s->config.samples, width = (size_t)s->raster.config.width, groups = 0, at, k;

    for (size_t row = 0; row < n; row++)
        for (size_t column = 0; column < n; column++) {
            at = (y * n + row) * width + x * n + column;
            uint64_t key = (uint64_t)g->instance[at] << 32 | g->triangle[at];
            for (k = 0; k < groups && group[k].key != key; k++) continue;
            if (k == groups) group[groups++] = (struct group){ .key = key };
            group[k].count++;
            for (size_t c = 0; c < 2; c++) group[k].b[c] += g->corner[c * j->pixels + at];
        }
    return groups;
}

static float shoulder(float x)
{
    const float knee = 0.7f, rest = 1 - knee;
    return x <= knee ? x : 1 - rest * expf((knee - x) / rest);
}

static void shade_pixel(const struct job *j, dar_shade_surface *cache, size_t x, size_t y)
{
    const dar_shade *s = j->s;
    struct group group[DAR_SHADE_SAMPLES * DAR_SHADE_SAMPLES];
    size_t groups = group_samples(j, x, y, group);
    float sum[3] = { 0 }, light[3], all = (float)(s->config.samples * s->config.samples);

    for (size_t k = 0; k < groups; k++) {
        const struct group *g = &group[k];
        float share = g->count / all, b[3] = { 1, g->b[0] / g->count, g->b[1] / g->count };
        dar_shade_surface *f = &cache[g->key % SURFACES];
        b[0] -= b[1] + b[2];
        if (g->key && f->key != g->key)
            set_surface(j, f, (uint32_t)(g->key >> 32) - 1, (uint32_t)g->key - 1), f->key = g->key;
        if (g->key) shade(j, f, b, share, light);
        else background(j, x, y, light);
        for (int c = 0; c < 3; c++) sum[c] += share * light[c];
    }
    uint8_t *out = j->rgb + 3 * (y * (size_t)s->config.raster.width + x);
    for (int c = 0; c < 3; c++) out[c] = dar_srgb_of(s->srgb, shoulder((float)s->config.lighting.exposure * sum[c]));
}

static void shade_row(void *ctx, size_t y, int thread)
{
    const struct job *j = ctx;
    dar_shade_surface cache[SURFACES];
    (void)thread;
    for (int k = 0; k < SURFACES; k++) cache[k].key = 0;
    for (size_t x = 0; x < (size_t)j->s->config.raster.width; x++) shade_pixel(j, cache, x, y);
}

void dar_shade_light(const dar_shade *s, const dar_view *v, uint8_t *rgb)
{
    struct job j = { s, v, rgb, (size_t)s->raster.config.width * (size_t)s->raster.config.height };
    dar_parallel((size_t)s->config.raster.height, shade_row, &j);
}
