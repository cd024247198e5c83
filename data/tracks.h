/* tracks.h: sparse tracking: points on surfaces, followed through the clip.
 *
 *     dar_raster_draw(...);                                       frame 0
 *     n = dar_tracks_pick(&r, wanted, false, point, arena);
 *     dar_tracks_color(&r, point, n, color);
 *     for (each frame t, after it is drawn)
 *         dar_tracks_follow(&r, point, n, t, T, xy, visible), dar_tracks_map(...);
 *
 * Points are picked by area: equal areas hold equal numbers, spread evenly by the sequence R3 (Roberts 2018: multiples
 * of 1/g, 1/g^2, 1/g^3 with g^4 = g + 1).  No seed: the same scene and frame give the same points. */
#ifndef DAR_DATA_TRACKS_H
#define DAR_DATA_TRACKS_H

#include "data/raster.h"

#define DAR_TRACKS_TOLERANCE 1e-3 /* of the depth */
#define DAR_TRACKS_TRIES     64   /* candidates for a point */

/* Pick up to `wanted` points on what was drawn last; returns their number.  everywhere: on all surfaces of the scene;
 * else on those that a pixel shows, where they are visible.  Fewer than wanted: DAR_TRACKS_TRIES times as many
 * candidates were not enough, or nothing is visible.  Scratch in `a`: 9 bytes per triangle of all instances. */
size_t dar_tracks_pick(const dar_raster *r, size_t wanted, bool everywhere, dar_surface_point *point, dar_arena *a);

/* color [n, 3] u8: the tracking colour of each point, at least 1: the background is 0. */
void dar_tracks_color(const dar_raster *r, const dar_surface_point *point, size_t n, uint8_t *color);

/* Frame `frame` of `frames`, as drawn last.
 *
 *   xy       [n, frames, 2] f32 [px]; (-1, -1) nearer than the near plane
 *   visible  [n, frames] u8: 1 if the point is on the picture, does not lie on a back that is not there, and is no
 *            deeper, by DAR_TRACKS_TOLERANCE, than the deepest of the pixels whose centres are around it, a pixel
 *            without surface being infinitely deep: at outlines of what has two sides a point stays visible up to one
 *            pixel too long
 *   depth    [n] f32 of this frame, 0 nearer than the near plane; NULL: not wanted */
void dar_tracks_follow(const dar_raster *r, const dar_surface_point *point, size_t n, size_t frame, size_t frames,
                       float *xy, uint8_t *visible, float *depth);

/* The map of a frame: map [3, height, width] u8, black, with a square of `side` pixels (odd) for every visible point,
 * the nearest on top, of equals the first.  Scratch in `a`: 4 bytes per point. */
void dar_tracks_map(const dar_raster *r, size_t n, size_t frame, size_t frames, const float *xy, const uint8_t *visible,
                    const float *depth, const uint8_t *color, int side, uint8_t *map, dar_arena *a);

#endif
