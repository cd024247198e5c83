/* mip.h: base colour textures at every scale, looked up in linear light.
 *
 * Level 0 is the picture itself; a texel of each further level is the mean of those it covers below, in linear light
 * and weighted by alpha, so that what is transparent does not bleed. */
#ifndef DAR_DATA_MIP_H
#define DAR_DATA_MIP_H

#include "data/mesh.h"
#include "data/srgb.h"

#define DAR_MIP_LEVELS 16

typedef struct dar_mip {
    dar_image level[DAR_MIP_LEVELS];
    size_t levels; /* 0: the picture has no texels */
} dar_mip;

/* One per picture of the scene, [scene->images].  Memory in `a`; the scene must outlive it.  In a planning arena:
 * counts the bytes. */
dar_mip *dar_mip_init(const dar_scene *s, const dar_srgb *srgb, dar_arena *a);

/* Colour at uv, v downwards, blended between four texels of each of the two levels around `scale`, the logarithm to
 * base 2 of the side of the area wanted, in texels of level 0.  Where it is magnified and the material says nearest:
 * one texel. */
void dar_mip_at(const dar_mip *m, const dar_srgb *srgb, const dar_material *material, const float uv[2], float scale,
                float y[3]);

#endif
