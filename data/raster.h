/* raster.h: triangles of a posed scene as pictures: the G-buffer.
 *
 *     dar_raster_config c = dar_raster_default(832, 480);
 *     dar_raster_init(&r, &scene, &identity, &c, arena);
 *     for (each frame) {
 *         DAR_TRY(dar_pose_at(&pose, animation, t, e));
 *         dar_raster_draw(&r, &pose, &view[frame], &buffers[frame], frame ? &buffers[frame - 1] : NULL);
 *     }
 *
 * A pixel shows the nearest triangle that the ray through its centre meets at a depth of at least view.near.  With
 * d = ((x - cx) / fx, (y - cy) / fy, 1) and corners v0, v1, v2 in the camera, f64:
 *
 *     E0 = d . (v1 x v2)   E1 = d . (v2 x v0)   E2 = d . (v0 x v1)     all of the sign of v0 . (v1 x v2): a hit
 *     b_k = E_k / (E0 + E1 + E2)                                       its barycentric coordinates
 *     1 / depth = d . n / n . v0,   n = (v1 - v0) x (v2 - v0)
 *
 * Nothing is projected or clipped, so triangles across the near plane, or the camera's own, are not special, and
 * interpolation is perspective-correct.  Two triangles with a common edge get the same E but for the sign, to the bit:
 * no gap and no double hit.  A centre on an edge (E = 0) belongs to the triangle on the right, or below a level edge
 * (the top-left rule).  At equal depth the earlier triangle stays, in the order of instances and their triangles.
 * A ray through a corner shared by several triangles, closer than rounding (1e-12 px), may miss all of them.
 *
 * Materials: ALPHA_MASK covers where texture, factor and vertex colour multiply to an alpha of at least its cutoff,
 * ALPHA_BLEND likewise with config.blend_cutoff, since a pixel holds one surface.  Texels are those of the full
 * picture, blended between four unless the material says nearest.  A primitive without material is seen from both
 * sides.
 *
 * Same bits for any thread count. */
#ifndef DAR_DATA_RASTER_H
#define DAR_DATA_RASTER_H

#include "data/identity.h"
#include "data/pose.h"
#include "data/view.h"

#define DAR_RASTER_MAX_SIDE  16384 /* [px] */
#define DAR_RASTER_MIN_NEAR  1e-9
#define DAR_RASTER_MAX_FOCAL 1e9 /* [px] */
#define DAR_TILE_WIDTH       64  /* [px] */
#define DAR_TILE_HEIGHT      16

typedef enum dar_faces {
    DAR_FACES_MATERIAL, /* backs of single-sided materials are not there, as glTF says */
    DAR_FACES_ALL,      /* every triangle from both sides */
} dar_faces;

typedef enum dar_normals {
    DAR_NORMALS_SURFACE, /* outwards; on backs of double-sided materials the other way */
    DAR_NORMALS_CAMERA,  /* never away from the camera */
} dar_normals;

typedef struct dar_raster_config {
    int width, height; /* [px] */
    dar_faces faces;
    dar_normals normals;
    double blend_cutoff; /* alpha from which ALPHA_BLEND is there; 0: everywhere */
} dar_raster_config;

/* Faces and normals as materials say, blend_cutoff 0.5. */
dar_raster_config dar_raster_default(int width, int height);

/* One frame; a family whose pointer is NULL is not asked for.  Where there is no surface everything is 0. */
typedef struct dar_gbuffer {
    float *tracking;    /* [3, H, W] colour of the surface element, data/identity.h */
    uint32_t *instance; /* [H, W] number + 1 */
    uint32_t *part;     /* [H, W] number of the part in the scene + 1 */
    float *world;       /* [3, H, W] position, in the unit of the scene; data/world.h normalises */
    float *normal;      /* [3, H, W] interpolated, unit length, in the world; the triangle's own where there is none */
    float *depth;       /* [H, W] along the camera's z */
    uint8_t *mask;      /* [H, W] 1: a surface */
    uint32_t *triangle; /* [H, W] number in the instance's mesh + 1 */
    float *corner;      /* [2, H, W] barycentric coordinates of the triangle's corners 1 and 2 */
} dar_gbuffer;

typedef enum dar_raster_stage {
    DAR_STAGE_POSE,      /* vertices of changed instances */
    DAR_STAGE_TRANSFORM, /* into the camera */
    DAR_STAGE_CULL,
    DAR_STAGE_BIN,     /* triangles to tiles */
    DAR_STAGE_COVER,   /* edges and depth */
    DAR_STAGE_RESOLVE, /* families of visible triangles */
    DAR_STAGE_FILL,    /* empty tiles */
    DAR_STAGE_COPY,    /* frames that equal the one before */
    DAR_STAGES,
} dar_raster_stage;

/* Sums over all draws. */
typedef struct dar_raster_stats {
    size_t frames, copied;                        /* copied: nothing moved */
    size_t instances, instances_outside;          /* of frames drawn; outside the view as a whole */
    size_t vertices, vertices_kept;               /* kept: neither instance nor camera moved, or outside the view */
    size_t triangles;                             /* = those of instances outside + the following */
    size_t outside_instance;                      /* triangles of instances outside */
    size_t outside, behind, back, edge_on, small; /* small: between the centres of pixels */
    size_t drawn, references;                     /* references: pairs of triangle and tile */
    size_t tiles, tiles_empty, rounds;
    double seconds[DAR_STAGES]; /* cover and resolve share the time of their common loop as their threads spent it */
} dar_raster_stats;

typedef struct dar_raster {
    const dar_scene *scene;
    const dar_identity *identity;
    dar_raster_config config;
    dar_raster_stats stats;

    /* What was drawn last. */
    dar_view view;
    float *position, *normal; /* [scene->vertices, 3] posed; normals if the family or `corner` was asked for */

    /* Of the rasteriser itself. */
    struct dar_raster_inside *in;
} dar_raster;

/* Memory in `a`; scene and identity must outlive it.  identity NULL: tracking and part cannot be asked for.  In a
 * planning arena: counts the bytes. */
void dar_raster_init(dar_raster *r, const dar_scene *s, const dar_identity *identity, const dar_raster_config *c,
                     dar_arena *a);

/* Draw the pose, which must have been set once, and only once, since the draw before.  `last`: what the draw before
 * made, in the same families; if nothing has moved since, it is copied.  It may be `out` itself: then tiles that were
 * empty and are again are not written.  NULL: not at hand.
 * Aborts if the view has another size than the config, or near or focal lengths beyond the limits above. */
void dar_raster_draw(dar_raster *r, const dar_pose *p, const dar_view *v, const dar_gbuffer *out,
                     const dar_gbuffer *last);

/* A place on a surface. */
typedef struct dar_surface_point {
    uint32_t instance, triangle; /* of the instance's mesh */
    double b[3];                 /* barycentric coordinates */
} dar_surface_point;

/* Of what was drawn last: the triangle that a pixel shows; false: none. */
bool dar_raster_at(const dar_raster *r, int x, int y, uint32_t *instance, uint32_t *triangle);

/* Of what was drawn last: whether a triangle turns a back to the camera that is not there.  Instances outside the view
 * are not asked about. */
bool dar_raster_is_back(const dar_raster *r, uint32_t instance, uint32_t triangle);

/* Of what was drawn last: depth at a pixel, 0: none. */
double dar_raster_depth(const dar_raster *r, int x, int y);

#endif
