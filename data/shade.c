/* shade.c: memory, and the stages of a frame in their order. */
#include "data/shade.h"

#include <math.h>
#include <string.h>

#include "data/shade_inside.h"
#include "lib/log.h"
#include "lib/thread.h"

#define OVERHEAD 64 /* [px] side of the map from above: its edges are an eighth of the scene wide */

const char *const dar_shade_stage_name[] = { "samples", "shadows", "light" };

/* Texels of shadow maps are about as large as pixels when the scene fills the picture. */
static int shadow_side(int width, int height)
{
    int side = 2 * (width < height ? width : height);
    return side < 256 ? 256 : side > 2048 ? 2048 : side;
}

dar_shade_config dar_shade_default(int width, int height)
{
    return (dar_shade_config){ .raster = dar_raster_default(width, height),
                               .samples = 2,
                               .shadow_side = shadow_side(width, height),
                               .lighting = dar_lighting_of(0, false) };
}

static void init_shadow(const dar_shade *s, dar_shadow *shadow, const double toward[3], int side, double width,
                        dar_arena *a)
{
    dar_shadow_config w = { .side = side, .width = width, .blend_cutoff = s->config.raster.blend_cutoff };
    memcpy(w.toward, toward, sizeof w.toward);
    memcpy(w.lo, s->config.lo, sizeof w.lo);
    memcpy(w.hi, s->config.hi, sizeof w.hi);
    dar_shadow_init(shadow, s->scene, &w, a);
}

static void init_shadows(dar_shade *s, dar_arena *a)
{
    const dar_shade_config *c = &s->config;
    const dar_lighting *l = &c->lighting;
    double size = 0;
    for (int k = 0; k < 3; k++) size = fmax(size, c->hi[k] - c->lo[k]);
    for (size_t i = 0; i < l->suns; i++)
        if (l->sun[i].shadow) init_shadow(s, &s->shadow[i], l->sun[i].toward, c->shadow_side, l->softness * size, a);
    if (l->occlusion > 0) init_shadow(s, &s->overhead, l->up, OVERHEAD, size, a);
}

void dar_shade_init(dar_shade *s, const dar_scene *scene, const dar_shade_config *c, dar_arena *a)
{
    dar_raster_config r = c->raster;
    DAR_ASSERT(c->samples >= 1 && c->samples <= DAR_SHADE_SAMPLES, "shade: %d samples", c->samples);
    DAR_ASSERT(r.width <= DAR_RASTER_MAX_SIDE / c->samples && r.height <= DAR_RASTER_MAX_SIDE / c->samples,
               "shade: picture of %d x %d with %d x %d samples", r.width, r.height, c->samples, c->samples);
    DAR_ASSERT(c->lighting.suns <= DAR_LIGHTS_MOST && c->lighting.bulbs <= DAR_LIGHTS_MOST,
               "shade: %zu suns, %zu bulbs", c->lighting.suns, c->lighting.bulbs);

    *s = (dar_shade){ .scene = scene, .config = *c };
    r.width *= c->samples;
    r.height *= c->samples;
    size_t samples = (size_t)r.width * (size_t)r.height;
    s->srgb = dar_arena_push(a, sizeof *s->srgb);
    s->sky = dar_arena_push(a, sizeof *s->sky);
    if (!a->plan) {
        dar_srgb_init(s->srgb);
        dar_skylight_init(s->sky, &c->lighting);
    }
    dar_raster_init(&s->raster, scene, NULL, &r, a);
    s->g.instance = dar_arena_push(a, dar_mul_size(samples, sizeof(uint32_t)));
    s->g.triangle = dar_arena_push(a, dar_mul_size(samples, sizeof(uint32_t)));
    s->g.corner = dar_arena_push(a, dar_mul_size(samples, 2 * sizeof(float)));
    s->mip = dar_mip_init(scene, s->srgb, a);
    init_shadows(s, a);
}

/* ---------------------------------------------------------------- a frame */

/* Seconds since *mark, which moves on. */
static double lap(double *mark)
{
    double now = dar_log_clock(), d = now - *mark;
    *mark = now;
    return d;
}

static dar_view finer(const dar_view *v, int n)
{
    dar_view y = *v;
    y.width *= n, y.height *= n;
    y.fx *= n, y.fy *= n, y.cx *= n, y.cy *= n;
    return y;
}

void dar_shade_draw(dar_shade *s, const dar_pose *p, const dar_view *v, uint8_t *rgb)
{
    const dar_lighting *l = &s->config.lighting;
    double mark = dar_log_clock();
    size_t copied = s->raster.stats.copied;
    dar_view fine = finer(v, s->config.samples);

    s->frames++;
    dar_raster_draw(&s->raster, p, &fine, &s->g, s->drawn ? &s->g : NULL);
    s->drawn = true;
    s->seconds[DAR_SHADE_DRAW] += lap(&mark);
    if (s->raster.stats.copied > copied) {
        s->copied++;
        return;
    }
    for (size_t i = 0; i < l->suns; i++)
        if (l->sun[i].shadow) dar_shadow_draw(&s->shadow[i], p);
    if (l->occlusion > 0) dar_shadow_draw(&s->overhead, p);
    s->seconds[DAR_SHADE_SHADOW] += lap(&mark);
    dar_shade_light(s, v, rgb);
    s->seconds[DAR_SHADE_LIGHT] += lap(&mark);
}
