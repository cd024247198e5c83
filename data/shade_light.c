/* shade_light.c: light that a place sends towards the camera. */
#include <math.h>

#include "data/shade_inside.h"
#include "lib/real.h"

#define GLOSSIEST 0.85f /* sharper highlights would flicker between samples */
#define PLAIN     0.04f /* share of light that what is no metal mirrors straight back */

static float dot(const float a[3], const float b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static float fifth(float x)
{
    return x * x * x * x * x;
}

/* What a surface makes of light, once per place. */
struct lobe {
    float matte[3], mirror[3]; /* colours */
    float a2;                  /* fourth power of the roughness */
    float gloss;
    bool shiny;
};

static struct lobe lobe_of(const dar_shade_place *p)
{
    struct lobe l = { .gloss = dar_lesserf(p->gloss, GLOSSIEST), .shiny = p->gloss > 0 || p->metallic > 0 };
    float rough = 1 - l.gloss;
    l.a2 = rough * rough * rough * rough;
    for (int c = 0; c < 3; c++) {
        l.mirror[c] = PLAIN + p->metallic * (p->color[c] - PLAIN);
        l.matte[c] = p->color[c] * (l.shiny ? (1 - p->metallic) * (1 - PLAIN) : 1);
    }
    return l;
}

/* Add a light of that colour from direction d, unit.
 * Source: Walter et al. 2007 for the distribution; Schlick 1994; Kelemen and Szirmay-Kalos 2001 for the masking. */
static void add_light(const dar_shade_place *p, const struct lobe *l, const float d[3], const float color[3],
                      float y[3])
{
    float facing = dot(p->normal, d), half[3], length = 0;
    if (facing <= 0) return;
    for (int c = 0; c < 3; c++) y[c] += facing * color[c] * l->matte[c];
    if (!l->shiny) return;
    for (int c = 0; c < 3; c++) half[c] = d[c] + p->eye[c], length += half[c] * half[c];
    float scale = 1 / sqrtf(dar_greaterf(length, 1e-8f)), nh = dot(p->normal, half) * scale, lh = dot(d, half) * scale;
    float spread = nh * nh * (l->a2 - 1) + 1;
    float strength = facing * l->a2 / (spread * spread * 4 * dar_greaterf(lh * lh, 0.1f)),
          edge = fifth(1 - dar_lesserf(lh, 1));
    for (int c = 0; c < 3; c++) y[c] += strength * color[c] * (l->mirror[c] + (1 - l->mirror[c]) * edge);
}

static void add_suns(const dar_shade *s, const dar_shade_place *p, const struct lobe *l, float y[3])
{
    const dar_lighting *lighting = &s->config.lighting;
    for (size_t i = 0; i < lighting->suns; i++) {
        const dar_sun *sun = &lighting->sun[i];
        float d[3] = { (float)sun->toward[0], (float)sun->toward[1], (float)sun->toward[2] }, color[3];
        if (dot(d, p->normal) <= 0) continue;
        float lit = sun->shadow ? dar_shadow_at(&s->shadow[i], p->x, p->own) : 1;
        for (int c = 0; c < 3; c++) color[c] = lit * (float)sun->color[c];
        add_light(p, l, d, color, y);
    }
}

static void add_bulbs(const dar_lighting *lighting, const dar_shade_place *p, const struct lobe *l, float y[3])
{
    for (size_t i = 0; i < lighting->bulbs; i++) {
        const dar_bulb *bulb = &lighting->bulb[i];
        float d[3], color[3];
        for (int c = 0; c < 3; c++) d[c] = (float)bulb->at[c] - p->x[c];
        float square = dot(d, d), scale = 1 / sqrtf(dar_greaterf(square, 1e-12f)), reach = (float)bulb->reach;
        for (int c = 0; c < 3; c++) {
            d[c] *= scale;
            color[c] = (float)bulb->color[c] / (0.1f + 0.9f * square / (reach * reach));
        }
        add_light(p, l, d, color, y);
    }
}

/* Share of the sky's light that arrives. */
static float open_sky(const dar_shade *s, const dar_shade_place *p)
{
    float up = dot(p->normal, s->sky->up), most = up * (float)s->config.lighting.occlusion;
    return most > 0 ? 1 - most * (1 - dar_shadow_at(&s->overhead, p->x, p->own)) : 1;
}

static void add_sky(const dar_shade *s, const dar_shade_place *p, const struct lobe *l, float y[3])
{
    float light[3], wide[3], sharp[3], mirrored[3], across = dot(p->normal, p->eye), open = open_sky(s, p);

    dar_skylight_on(s->sky, p->normal, light);
    for (int c = 0; c < 3; c++) y[c] += open * light[c] * l->matte[c];
    if (!l->shiny) return;
    for (int c = 0; c < 3; c++) mirrored[c] = 2 * across * p->normal[c] - p->eye[c];
    dar_skylight_on(s->sky, mirrored, wide);
    dar_skylight_smooth(s->sky, mirrored, sharp);
    float edge = fifth(1 - dar_lesserf(dar_greaterf(across, 0), 1)), share = l->gloss * l->gloss;
    for (int c = 0; c < 3; c++) {
        float most = dar_greaterf(l->gloss, l->mirror[c]);
        y[c] += open * (wide[c] + share * (sharp[c] - wide[c])) * (l->mirror[c] + (most - l->mirror[c]) * edge);
    }
}

void dar_shade_radiance(const dar_shade *s, const dar_shade_place *p, float y[3])
{
    struct lobe l = lobe_of(p);
    y[0] = y[1] = y[2] = 0;
    add_sky(s, p, &l, y);
    add_suns(s, p, &l, y);
    add_bulbs(&s->config.lighting, p, &l, y);
}
