/* obj.h: the numbers of one Wavefront OBJ file; for data/objseq.c. */
#ifndef DAR_DATA_OBJ_H
#define DAR_DATA_OBJ_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/arena.h"
#include "lib/status.h"

#define DAR_OBJ_NONE UINT32_MAX

typedef struct dar_obj {
    size_t vertices, normals, corners, faces;
    size_t points_and_lines;
    float *vertex;           /* [vertices, 3] */
    float *normal;           /* [normals, 3] */
    uint32_t *corner;        /* [corners] vertices */
    uint32_t *corner_normal; /* [corners], or DAR_OBJ_NONE */
    uint32_t *face_end;      /* [faces] corners of faces before and with this one; at least 3 each */
    bool has_normals;        /* every corner has one */
    dar_arena memory;
} dar_obj;

/* Read data[0, size).  Every index is in range, every number finite and below 1e12.  The caller owes one dar_obj_free,
 * also after a failure. */
dar_status dar_obj_parse(dar_obj *o, const char *path, const void *data, size_t size, dar_err *e);
void dar_obj_free(dar_obj *o); /* accepts a zeroed one */

/* Corners of a polygon's triangles: n corners c (vertices of `vertex`, [.., 3]) into (n - 2) * 3 numbers below n.
 * Convex ones become fans; of others of up to 512 corners ears are cut, `left` [n] being scratch.  A polygon that
 * crosses itself comes out in some way that uses every corner. */
void dar_obj_triangulate(const float *vertex, const uint32_t *c, size_t n, uint32_t *left, uint32_t *out);

#endif
