/* world.h: one normalisation of world positions for a whole clip.
 *
 *     q = 1/2 + (X - centre) / size       size: longest side of the bounds, widened by 1/256 on each side
 *
 * One number scales all axes, so shapes stay what they are; q is inside (0, 1), never the background's 0, for every
 * point within the bounds; and X = centre + (q - 1/2) size: no two points share a q. */
#ifndef DAR_DATA_WORLD_H
#define DAR_DATA_WORLD_H

#include <stddef.h>

typedef struct dar_world {
    double lo[3], hi[3]; /* bounds of what was added */
    double centre[3], size;
} dar_world;

void dar_world_init(dar_world *w);

/* Add positions [n, 3] of a frame: those of all vertices, so that the bounds hold whatever the camera sees. */
void dar_world_add(dar_world *w, const float *position, size_t n);

/* Set centre and size; 0 and 1 if nothing was added, size 1 if all points are one. */
void dar_world_finish(dar_world *w);

/* World positions [3, pixels] to q, in place or not; pixels with mask 0 become 0. */
void dar_world_normalise(const dar_world *w, const float *x, const unsigned char *mask, size_t pixels, float *q);

#endif
