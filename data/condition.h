/* condition.h: the tensor that tells the network where the camera and the surfaces are: [24 + N, F, H, W] f32.
 *
 * Channels 0 .. 23 are packed rays (data/rays.h), the N after them the families of a channel set, in the order of its
 * name, at full resolution on the latent time grid.
 *
 *   key             values                            default
 *   channels        a set's name, or families a+b+c   dar      which N channels
 *   plucker         wan | paper                       wan      (o x d, d), as public weights want, or (d, o x d)
 *   rays            camera0 | world                   camera0  poses relative to frame 0, or as they are
 *   resample        last | first | mean | masked-mean last     which of a group's four frames geometry is taken from
 *   geometry_frame  scene | camera0                   scene    what positions and normals are relative to
 *
 *   family    channels  in the tensor, in [0, 1]
 *   tracking  3         identity of the surface element, as stored
 *   world     3         position: see below
 *   normal    3         (n + 1) / 2
 *   depth     1         view-z from the clip's nearest (0) to its farthest (1); 1 where these are the same
 *   mask      1         coverage, as stored
 *   sparse    3         map of point tracks, as stored
 *
 * Background, the pixels whose mask is 0, is 0 in every geometry channel; the mask alone decides, and is read for every
 * set that has geometry.
 *
 * resample: latent frame 0 is frame 0; f >= 1 is of the frames 4 f - 3 .. 4 f the last, the first, the mean (background
 * counting as 0), or the mean of those that are not background.  Identities (tracking, sparse) are never averaged: with
 * both means they are those of the last frame that is not background, so that all families cover the same pixels. Means
 * of normals are shorter than 1.
 *
 * geometry_frame scene: X' = (X - center) / scale + 1/2 with the scene's own center and scale.  camera0: the rigid
 * transform that takes camera 0 to the origin, then X' = (X_0 - (0, 0, z)) / S + 1/2 with z the depth of the box's
 * centre and S the smallest at which the whole box stays in [0, 1]; normals are turned likewise.  Both are
 * similarities, hence injective.
 *
 * Source: the paper, eq. 4 and 6, table of ablations; what it leaves open is a key. */
#ifndef DAR_DATA_CONDITION_H
#define DAR_DATA_CONDITION_H

#include <stdbool.h>
#include <stddef.h>

#include "data/camera.h"
#include "data/rays.h"
#include "data/trajectory.h"
#include "lib/json.h"
#include "lib/status.h"
#include "lib/tensor.h"

typedef enum dar_family {
    DAR_FAMILY_TRACKING,
    DAR_FAMILY_WORLD,
    DAR_FAMILY_NORMAL,
    DAR_FAMILY_DEPTH,
    DAR_FAMILY_MASK,
    DAR_FAMILY_SPARSE,
    DAR_FAMILIES
} dar_family;

typedef struct dar_family_info {
    const char *name;
    size_t channels;
    bool identity; /* values name something: a mean of two is a third */
} dar_family_info;

extern const dar_family_info dar_family_table[DAR_FAMILIES];

typedef struct dar_channel_set {
    dar_family family[DAR_FAMILIES];
    size_t families, channels; /* channels: N */
} dar_channel_set;

/* The sets that have a name: the paper's twelve and the two of its stress test. */
typedef struct dar_channel_alias {
    const char *name, *families; /* families "": rays only */
} dar_channel_alias;

extern const dar_channel_alias dar_channel_aliases[];
extern const size_t dar_channel_alias_count;

/* Fails, with the nearest name, for families that are unknown or given twice. */
dar_status dar_channel_set_parse(dar_channel_set *s, const char *text, dar_err *e);

/* Whether the set's planes are ever read. */
bool dar_channel_set_has(const dar_channel_set *s, dar_family f);

typedef enum dar_resample {
    DAR_RESAMPLE_LAST,
    DAR_RESAMPLE_FIRST,
    DAR_RESAMPLE_MEAN,
    DAR_RESAMPLE_MASKED
} dar_resample;
typedef enum dar_geometry_frame { DAR_GEOMETRY_SCENE, DAR_GEOMETRY_CAMERA0 } dar_geometry_frame;

typedef struct dar_condition {
    dar_channel_set set;
    dar_rays_options rays;
    dar_resample resample;
    dar_geometry_frame geometry;
} dar_condition;

/* Read the keys above from an object of a configuration; what is wrong is told by dar_json_finish. */
void dar_condition_read(dar_condition *c, dar_json j);

/* [24 + N, F, H, W]. */
dar_shape dar_condition_shape(const dar_condition *c, const dar_camera_path *p);

/* ---------------------------------------------------------------- where the planes come from */

typedef enum dar_plane_type { DAR_PLANE_U8, DAR_PLANE_U16, DAR_PLANE_I16, DAR_PLANE_F32 } dar_plane_type;

/* One family of one frame.  value = scale[c] number + offset[c]: position and depth in the scene's unit, unit normals
 * in the world, the rest in [0, 1]. */
typedef struct dar_plane {
    dar_plane_type type;
    const void *data; /* [channels, H, W], the reader's, valid until its next call */
    double scale[3], offset[3];
} dar_plane;

/* Numbers [at, at + n) of a plane. */
void dar_plane_numbers(const dar_plane *p, size_t at, size_t n, double *x);

typedef dar_status dar_plane_read(void *ctx, dar_family family, size_t frame, dar_plane *plane, dar_err *e);

typedef struct dar_condition_source {
    const dar_camera_path *path; /* frames, size, poses */
    double center[3], scale;     /* of the scene; needed for world */
    dar_box box;                 /* of all positions over the clip; needed for world in camera0 */
    double depth[2];             /* nearest and farthest over the clip; needed for depth */
    dar_plane_read *read;        /* called by one thread, in the order of frames */
    void *ctx;
} dar_condition_source;

/* Write y, contiguous f32 of dar_condition_shape.  Only needed families of needed frames are read, each once. `scratch`
 * holds 2 H W bytes during the call.  On failure y is undefined.  Same bits for any thread count. */
dar_status dar_condition_build(const dar_condition *c, const dar_condition_source *s, dar_arena *scratch,
                               const dar_tensor *y, dar_err *e);

/* The affine map from world positions to what the tensor holds. */
dar_status dar_condition_world(const dar_condition *c, const dar_condition_source *s, double m[12], dar_err *e);

#endif
