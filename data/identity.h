/* identity.h: a colour for every surface element of a scene that no other element has, at any time, from any camera.
 *
 * The colour cube is cut into side^3 equal cells.  Every part of every instance owns a cell, and inside it the element
 * with rest coordinates x has the colour
 *
 *     q = origin + scale x        each channel inside (0, 1), so never the background's 0
 *
 * Rest coordinates: the mesh's own space before skin and transforms, morph targets at the weights that the file gives
 * at rest.  Scale is one number per part: the longest side of the part's box fills the cell but for a margin of 1 / 64
 * on each side, which keeps neighbouring cells apart, in 16 bits too, up to side = 1000.
 *
 * Part: triangles that hang together by corners at equal rest positions (so seams of texture or normals do not cut).
 * Of triangles with the same three corners, such as the two faces of a doubled sheet, the first stays and each further
 * one belongs to another layer, which is a part of its own.  Numbers follow the order of triangles and instances.
 *
 * So two elements share a colour only if the same part passes twice through the same place at rest: where it crosses
 * itself (curves, without area), or where it lies on itself in different triangles, which is not detected. */
#ifndef DAR_DATA_IDENTITY_H
#define DAR_DATA_IDENTITY_H

#include "data/mesh.h"

typedef struct dar_identity_mesh {
    size_t parts;
    uint32_t *part;   /* [triangles] */
    float *rest;      /* [vertices, 3]; the mesh's own positions if it has no targets */
    double (*box)[4]; /* [parts] lowest corner, longest side */
} dar_identity_mesh;

typedef struct dar_identity {
    const dar_scene *scene;
    dar_identity_mesh *mesh; /* [meshes] */
    size_t *first;           /* [instances] cell of the instance's part 0 */
    size_t parts, side;      /* of the scene */
} dar_identity;

/* Memory in `a`, which for a while is filled further.  In a planning arena: an upper bound. */
void dar_identity_init(dar_identity *d, const dar_scene *s, dar_arena *a);

/* The colours of part `part` of an instance: q = origin + scale x. */
void dar_identity_cell(const dar_identity *d, size_t instance, uint32_t part, double origin[3], double *scale);

/* side of the cube of so many parts, and the cell that a colour lies in: with number first[instance] + part. */
size_t dar_identity_side(size_t parts);
size_t dar_identity_cell_of(size_t side, const double q[3]);

#endif
