/* shadow.h: which places a sun reaches: depths as the sun sees them, drawn by the rasteriser.
 *
 * The map looks at a box of the world from a thousand times its size away.  A place is compared with a square of
 * texels around it, each against the plane that the place's surface continues in, and the comparisons are weighted by a
 * tent: edges are soft, and a flat surface does not shade itself.  Beyond the box everything is lit. */
#ifndef DAR_DATA_SHADOW_H
#define DAR_DATA_SHADOW_H

#include "data/raster.h"

typedef struct dar_shadow_config {
    double toward[3];    /* from the scene to the sun, unit */
    double lo[3], hi[3]; /* box of the world */
    int side;            /* [px] of the map */
    double width;        /* of soft edges, in the unit of the world; at least three texels, at most eight */
    double blend_cutoff; /* as of the pictures */
} dar_shadow_config;

typedef struct dar_shadow {
    dar_raster raster;
    dar_gbuffer map; /* depth alone */
    dar_view view;
    float bias;     /* [unit of the world] */
    float slope[2]; /* [unit of the world / px] of columns and rows */
    float reach;    /* half the side of the square [px] */
} dar_shadow;

/* Memory in `a`; the scene must outlive it.  In a planning arena: counts the bytes. */
void dar_shadow_init(dar_shadow *s, const dar_scene *scene, const dar_shadow_config *c, dar_arena *a);

/* Draw the map of a pose, which must have been set once, and only once, since the draw before.  Nothing is done if
 * nothing has moved. */
void dar_shadow_draw(dar_shadow *s, const dar_pose *p);

/* Share of the light, 0 to 1, at a place x whose surface has the normal n, unit. */
float dar_shadow_at(const dar_shadow *s, const float x[3], const float n[3]);

#endif
