/* rays.h: one Pluecker ray per pixel and frame, packed as the network's control adapter takes them.
 *
 * For the pixel (column i, row j) of a view, with x = (i + 0.5 - cx) / fx, y = (j + 0.5 - cy) / fy:
 *
 *   d = R (x, y, 1) / |(x, y, 1)|      direction, unit
 *   m = o x d                          moment, o the camera's place: 0 for rays through the origin
 *
 * Packing takes frame 0 four times, then the rest in order: G of 4 F = T + 3 frames, so T is 1, 5, 9, ...
 *
 *   packed[c * 4 + k, f] = G[c, 4 f + k]      c: component 0 .. 5, k: frame of the group 0 .. 3
 *
 * Latent frame 0 holds frame 0 four times, latent frame f >= 1 the frames 4 f - 3 .. 4 f.
 *
 *   key      values        default
 *   plucker  wan | paper   wan      components (m, d), as the public weights want, or (d, m), as the paper writes
 *   rays     camera0 | world  camera0  poses relative to frame 0, in which its moments are 0, or as they are
 *
 * Source: the paper, eq. 2 and 3; Zhou et al. 2018 for moments and directions. */
#ifndef DAR_DATA_RAYS_H
#define DAR_DATA_RAYS_H

#include <stddef.h>

#include "data/camera.h"
#include "lib/tensor.h"

#define DAR_RAYS_COMPONENTS 6
#define DAR_RAYS_GROUP      4 /* frames that the video's latent grid packs into one */
#define DAR_RAYS_CHANNELS   (DAR_RAYS_COMPONENTS * DAR_RAYS_GROUP)

typedef enum dar_plucker { DAR_PLUCKER_WAN, DAR_PLUCKER_PAPER } dar_plucker;
typedef enum dar_rays_frame { DAR_RAYS_CAMERA0, DAR_RAYS_WORLD } dar_rays_frame;
extern const char *const dar_plucker_name[];    /* "wan", "paper", NULL */
extern const char *const dar_rays_frame_name[]; /* "camera0", "world", NULL */

typedef struct dar_rays_options {
    dar_plucker plucker;
    dar_rays_frame frame;
} dar_rays_options;

/* Origin and unit direction through (x, y) [px], in the world; a pixel's centre is at +0.5. */
void dar_rays_at(const dar_view *v, double x, double y, double o[3], double d[3]);

/* Latent frames of `frames` frames; 0 if they cannot be packed. */
size_t dar_rays_latent_frames(size_t frames);

/* Write y [24, F, H, W] f32, contiguous; H x W is the size of the views.  Computed in f64 and rounded once.  Aborts if
 * the shape does not fit.  Same bits for any thread count. */
void dar_rays_pack(const dar_camera_path *p, dar_rays_options options, const dar_tensor *y);

#endif
