/* texture.h: looking up base colour textures. */
#ifndef DAR_DATA_TEXTURE_H
#define DAR_DATA_TEXTURE_H

#include "data/mesh.h"

/* Texel i of n, wrapped.  i is whole. */
size_t dar_texture_wrap(double i, size_t n, dar_wrap mode);

/* Alpha in [0, 1] of the material's texture at uv, v downwards: blended between four texels, or that of one if the
 * material says nearest.  1 if it has no texture. */
double dar_texture_alpha(const dar_scene *s, const dar_material *m, double u, double v);

#endif
