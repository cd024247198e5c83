/* objseq.h: Wavefront OBJ files, one per frame, as one scene (data/mesh.h).
 *
 * The scene has one node, one mesh and, if there are several frames, the animation "sequence": frame k stands at k /
 * fps seconds, between frames vertices move in straight lines.  Frames are morph targets of a mesh that is zero, so
 * frame k is posed with the very numbers of its file.
 *
 * Read: v, vn, f with polygons of any size and indices from the end; points and lines are counted, the rest (texture
 * coordinates, groups, materials) is passed over.  A file where some face has no normals gets smooth ones, weighted by
 * area.  All frames must have the vertices and faces of the first; their normals may be numbered anew.
 *
 * Source: Wavefront, Advanced Visualizer manual, appendix B1. */
#ifndef DAR_DATA_OBJSEQ_H
#define DAR_DATA_OBJSEQ_H

#include "data/mesh.h"

#define DAR_OBJSEQ_MAX_FRAMES 4096

/* `what` is one of: a file; a directory, of which all *.obj are taken; a path whose last part has * or ?, or one %d
 * (digits) or %04d (at least four digits).  Frames are in the order in which people count: 9 before 10.  The caller
 * owes one dar_scene_free, also after a failure. */
dar_status dar_objseq_load(dar_scene *s, const char *what, double fps, dar_err *e);

/* One frame from memory, as a scene without animation. */
dar_status dar_objseq_parse(dar_scene *s, const char *path, const void *data, size_t size, dar_err *e);

/* < 0, 0, > 0: the order of a and b, runs of digits as numbers. */
int dar_objseq_order(const char *a, const char *b);

/* Whether the whole name fits a pattern as above. */
bool dar_objseq_fits(const char *pattern, const char *name);

#endif
