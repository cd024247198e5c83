/* layers.h: a frame with what compositing wants of the bundle, as an OpenEXR file.
 *
 *   R G B     half    the rendered picture, linear light; not multiplied by A
 *   A         half    how much of the pixel the mesh covers: what lies outside was made by the model
 *   depth.Z   float   along the camera's z, in the unit of the scene; 0: no mesh
 *   id.X      uint    number of the instance + 1; 0: no mesh
 *
 * A, depth.Z and id.X where the bundle has them; as in bundles (data/bundle_exr.h). */
#ifndef DAR_INFER_LAYERS_H
#define DAR_INFER_LAYERS_H

#include "data/bundle.h"
#include "data/srgb.h"

typedef struct dar_layers {
    size_t pixels;
    float *depth, *mask; /* [H, W] */
    uint32_t *id;        /* [H, W] */
    uint16_t *half[4];   /* [H, W] R, G, B, A */
    void *memory;
    dar_srgb srgb;
} dar_layers;

/* Memory for frames of this bundle's size; on failure nothing is owned. */
dar_status dar_layers_init(dar_layers *l, const dar_bundle *b, dar_err *e);
void dar_layers_free(dar_layers *l); /* accepts a zeroed one */

/* Frame `index` of b with rgb [H, W, 3], display values. */
dar_status dar_layers_write(dar_layers *l, const char *path, dar_bundle *b, size_t index, const uint8_t *rgb,
                            const char *comment, dar_err *e);

#endif
