/* camera.h: a camera path: one view (data/view.h) per frame, and what is done with paths before they are used.
 *
 *     dar_camera_path p;
 *     DAR_TRY(dar_camera_init(&p, frames, e));
 *     dar_camera_fill(&p, key, keys, (dar_camera_style){ DAR_TURN_SQUAD, DAR_MOVE_CATMULL_ROM });
 *     ...
 *     dar_camera_free(&p);
 *
 * A path that came from a file or a trajectory is sound: every number finite, every rotation a rotation, sizes, focal
 * lengths and near above 0, one picture size for all frames (dar_camera_check). */
#ifndef DAR_DATA_CAMERA_H
#define DAR_DATA_CAMERA_H

#include <stdbool.h>
#include <stddef.h>

#include "data/view.h"
#include "lib/status.h"

#define DAR_CAMERA_NEAR     0.01  /* where a file says nothing; in the scene's unit */
#define DAR_CAMERA_MAX_SIZE 32768 /* of a side of the picture [px] */
#define DAR_CAMERA_LARGEST  1e12  /* of a place's coordinate */
#define DAR_CAMERA_ASKEW    1e-3  /* of dar_rigid_error: what rounding in a file may have done to a rotation */

typedef struct dar_camera_path {
    dar_view *view; /* [frames] */
    size_t frames;
} dar_camera_path;

/* Views zeroed.  frames >= 1.  On failure *p is zeroed. */
dar_status dar_camera_init(dar_camera_path *p, size_t frames, dar_err *e);
void dar_camera_free(dar_camera_path *p); /* accepts a zeroed path */

/* Whether the view is sound: NULL, or what is wrong with it, as "focal length -3, expected more than 0". */
const char *dar_camera_fault(const dar_view *v, char text[128]);

/* The same for a path, and that its pictures have one size; `name` stands for the file.  Rotations are replaced by the
 * nearest ones; those off by more than DAR_CAMERA_ASKEW are refused. */
dar_status dar_camera_check(dar_camera_path *p, const char *name, dar_err *e);

/* ---------------------------------------------------------------- lenses */

/* Focal length [px] of a field of view [rad] across `size` [px], and back. */
double dar_camera_focal(double fov, double size);
double dar_camera_fov(double focal, double size);

/* The same camera for another picture: scaled until it covers it, cut about the centre. */
void dar_camera_resize(dar_view *v, int width, int height);

/* ---------------------------------------------------------------- conventions
 *
 *   opencv   camera x right, y down, z forward; the world as it is
 *   opengl   camera x right, y up, z backward; the world as it is (glTF, NeRF)
 *   blender  camera as opengl; world z up, carried to y up: (x, z, -y), as Blender's glTF exporter does
 *   unreal   camera x forward, y right, z up; world left-handed, z up, centimetres; row vectors, so the matrix is the
 *            transpose of the others'; carried to y up, metres: (x, z, y) / 100, as Unreal's glTF exporter does */
typedef enum dar_camera_axes {
    DAR_AXES_OPENCV,
    DAR_AXES_OPENGL,
    DAR_AXES_BLENDER,
    DAR_AXES_UNREAL,
    DAR_AXES_COUNT
} dar_camera_axes;

extern const char *const dar_camera_axes_name[DAR_AXES_COUNT + 1]; /* ends with NULL */

/* Camera to world, 4 x 4 as the convention writes it, to ours and back; a world-to-camera matrix is inverted first, or
 * afterwards (dar_rigid_inverse).  Import: false if the row (unreal: the column) that must be 0 0 0 1 is not. */
bool dar_camera_import(dar_camera_axes axes, const double m[16], double c2w[12]);
void dar_camera_export(dar_camera_axes axes, const double c2w[12], double m[16]);

/* ---------------------------------------------------------------- key poses */

typedef enum dar_camera_turn { DAR_TURN_SLERP, DAR_TURN_SQUAD } dar_camera_turn;
typedef enum dar_camera_move { DAR_MOVE_LINEAR, DAR_MOVE_CATMULL_ROM } dar_camera_move;
extern const char *const dar_camera_turn_name[]; /* "slerp", "squad", NULL */
extern const char *const dar_camera_move_name[]; /* "linear", "catmull-rom", NULL */

/* How a path goes between keys.  Rotations turn along the shorter arc between neighbours: at constant speed, or as
 * squad, whose speed has no jumps at the keys.  Places go straight, or along Catmull and Rom's spline.  Keys may lie at
 * any distance in time: the speed at a key is that of the parabola through it and its neighbours, at the first and last
 * key that of the straight way.  Focal lengths and principal point are linear. */
typedef struct dar_camera_style {
    dar_camera_turn turn;
    dar_camera_move move;
} dar_camera_style;

typedef struct dar_camera_key {
    double time; /* increasing */
    dar_view view;
} dar_camera_key;

/* Between keys; before the first and after the last the view stays. */
void dar_camera_between(const dar_camera_key *key, size_t keys, dar_camera_style style, double time, dar_view *v);

/* All frames of p, from the first key (frame 0) to the last at equal distances. */
void dar_camera_fill(dar_camera_path *p, const dar_camera_key *key, size_t keys, dar_camera_style style);

/* The same way in another number of frames: y's first and last are x's. */
void dar_camera_resample(const dar_camera_path *x, dar_camera_style style, dar_camera_path *y);

/* ---------------------------------------------------------------- whole paths */

/* c2w_t <- w2c_0 c2w_t: frame 0 becomes the identity, exactly. */
void dar_camera_relative(dar_camera_path *p);

/* Another unit: places and near times s > 0. */
void dar_camera_scale(dar_camera_path *p, double s);

/* Another world: c2w_t <- m c2w_t, m rigid. */
void dar_camera_transform(dar_camera_path *p, const double m[12]);

#endif
