/* shade.h: pictures of a posed scene in its lights.
 *
 *     dar_shade_config c = dar_shade_default(832, 480);
 *     memcpy(c.lo, world.lo, sizeof c.lo), memcpy(c.hi, world.hi, sizeof c.hi);
 *     c.lighting = dar_lighting_of(0, false);
 *     dar_shade_init(&s, &scene, &c, arena);
 *     for (each frame) {
 *         DAR_TRY(dar_pose_at(&pose, animation, t, e));
 *         dar_shade_draw(&s, &pose, &view[frame], rgb);
 *     }
 *
 * The picture is drawn with n x n samples per pixel, on a grid, and covers what data/raster.h covers.  Of a pixel's
 * samples those of one triangle are shaded once, at their mean; samples are averaged in linear light.  Surfaces are lit
 * from the side that is seen.  How much of the sky is hidden by what lies overhead, a coarse shadow map from above
 * tells.
 *
 * Colour: texture times factor times vertex colour, in linear light.  Surface: matte if its gloss and its metallic are
 * 0, else with a highlight (GGX, roughness 1 - gloss) and a mirrored sky; what has no material is white and has
 * DAR_GLOSS_UNKNOWN.  Light: data/light.h; shadows: data/shadow.h.
 *
 * Same bits for any thread count. */
#ifndef DAR_DATA_SHADE_H
#define DAR_DATA_SHADE_H

#include "data/light.h"
#include "data/mip.h"
#include "data/shadow.h"

#define DAR_SHADE_SAMPLES 4 /* most, along each side of a pixel */

typedef struct dar_shade_config {
    dar_raster_config raster; /* of the picture; normals play no part */
    int samples;              /* n */
    int shadow_side;          /* of the shadow maps [px] */
    double lo[3], hi[3];      /* box of the world in which shadows fall: all vertices of the clip */
    dar_lighting lighting;
} dar_shade_config;

/* n = 2, the standard lighting with y up, an empty box. */
dar_shade_config dar_shade_default(int width, int height);

typedef enum dar_shade_stage {
    DAR_SHADE_DRAW,   /* triangles to samples; its parts: s->raster.stats */
    DAR_SHADE_SHADOW, /* shadow maps */
    DAR_SHADE_LIGHT,  /* samples to pixels */
    DAR_SHADE_STAGES,
} dar_shade_stage;
extern const char *const dar_shade_stage_name[];

typedef struct dar_shade {
    const dar_scene *scene;
    dar_shade_config config;
    double seconds[DAR_SHADE_STAGES]; /* sums over all frames */
    size_t frames, copied;            /* copied: nothing had moved */

    /* Of the shader itself. */
    dar_raster raster;
    dar_gbuffer g; /* instance, triangle, corner: [n H, n W] */
    dar_mip *mip;
    dar_shadow shadow[DAR_LIGHTS_MOST];
    dar_shadow overhead; /* of the sky, coarse, if it has occlusion */
    dar_srgb *srgb;
    dar_skylight *sky;
    bool drawn;
} dar_shade;

/* Memory in `a`; the scene must outlive it.  Aborts if the samples make a picture beyond DAR_RASTER_MAX_SIDE.  In a
 * planning arena: counts the bytes. */
void dar_shade_init(dar_shade *s, const dar_scene *scene, const dar_shade_config *c, dar_arena *a);

/* Draw the pose, which must have been set once, and only once, since the draw before, into rgb u8 [H, W, 3], display
 * values.  rgb holds what the draw before made, unless that was the first: if nothing has moved it stays. */
void dar_shade_draw(dar_shade *s, const dar_pose *p, const dar_view *v, uint8_t *rgb);

#endif
