/* bundle_exr.h: families of one frame from and to an EXR file.
 *
 *   family    written            read, capitals and layers ignored (data/exr.h)
 *   tracking  tracking.R G B     tracking.R G B
 *   world     world_pos.X Y Z    world_pos.X Y Z, Position.X Y Z          in the unit of the scene
 *   normal    normal.X Y Z       normal.X Y Z                             made unit
 *   depth     depth.Z            depth.Z, Z
 *   id        id.X               id.X, IndexOB.X
 *   part      part.X             part.X
 *
 * Floats are written in 32 bits, ids as integers; read from 16 or 32 bits of either kind.  What is background in a
 * file, all families but the sparse one being 0 there, is told by id, else by depth: 0, not finite, or beyond
 * DAR_BUNDLE_EXR_FAR. */
#ifndef DAR_DATA_BUNDLE_EXR_H
#define DAR_DATA_BUNDLE_EXR_H

#include "data/exr.h"
#include "data/raster.h"

#define DAR_BUNDLE_EXR_FAR 1e9f /* Blender writes 1e10 where nothing is */

/* Which families of dar_bundle_table (bit 1 << family) the file has; the mask if it can be told. */
unsigned dar_bundle_exr_families(const dar_exr *x);

/* Read the families whose pointers are set; background becomes 0.  What the file has not fails, by name. */
dar_status dar_bundle_exr_read(dar_exr *x, const char *path, const dar_gbuffer *g, dar_err *e);

/* Write the families whose pointers are set. */
dar_status dar_bundle_exr_write(const char *path, size_t width, size_t height, const dar_gbuffer *g,
                                dar_exr_compression compression, dar_err *e);

#endif
