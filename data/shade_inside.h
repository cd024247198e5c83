/* shade_inside.h: what the files of the shader share.  Nobody else includes it. */
#ifndef DAR_DATA_SHADE_INSIDE_H
#define DAR_DATA_SHADE_INSIDE_H

#include "data/shade.h"

/* One triangle.  Attribute k of corner c is x[c][k]. */
typedef struct dar_shade_surface {
    uint64_t key; /* instance + 1, triangle + 1; 0: none */
    const dar_material *material;
    const dar_mip *mip; /* NULL: no texture */
    float place[3][3], normal[3][3], uv[3][2], color[3][3];
    float own[3];          /* its own normal, unit, towards the camera */
    float factor[3];       /* base colour */
    float gloss, metallic; /* as the material's */
    float texels;          /* log2 of texels per unit of length */
} dar_shade_surface;

/* A place on a surface as light meets it. */
typedef struct dar_shade_place {
    float x[3], normal[3], own[3], eye[3]; /* unit; eye: towards the camera */
    float color[3];
    float gloss, metallic;
} dar_shade_place;

/* shade_light.c */
void dar_shade_radiance(const dar_shade *s, const dar_shade_place *p, float y[3]);

/* shade_pixel.c: the whole picture from the samples that were drawn. */
void dar_shade_light(const dar_shade *s, const dar_view *v, uint8_t *rgb);

#endif
