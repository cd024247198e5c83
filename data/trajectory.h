/* trajectory.h: camera paths by name: what the paper's data sets and its benchmark are rendered with.
 *
 * A kind is a row of bounds; a trajectory is one draw inside them, a pure function of (seed, index); a path is the
 * trajectory around a scene: at s = frame / (frames - 1)
 *
 *   yaw       yaw + span s                [deg] about the vertical, 0 in front of the scene, positive to the camera's
 *                                         right
 *   pitch     pitch + rise s              [deg] above the horizon
 *   roll      roll s                      [deg] the camera turns clockwise
 *   distance  D radius (1 + dolly s)
 *   shift     D radius pan (s - 1/2)      of camera and target to the camera's right, in half-widths of the view at 1
 *
 * and the camera looks at the target, the centre of everything that the scene's boxes cover.  D is the smallest
 * distance at which every frame's box is in view at its frame, with the margin, and no nearer than a tenth of the way;
 * radius >= 1 only steps back from there.
 *
 * The front is +z in a world with y up, -y in one with z up: where glTF and Blender say that a model looks.
 *
 * Source: the paper, 4.2 and table of trajectories: "16 trajectory families, including short/half/full orbits,
 * orbit+dolly, top-down orbits, low arcs, pure dolly, lateral pan, rolling orbit, orbit+pan, and vertical arcs", "14
 * ... orbit, corridor, dolly, top-spin, and oblique motions".  It gives no bounds; those in the table are this
 * project's. */
#ifndef DAR_DATA_TRAJECTORY_H
#define DAR_DATA_TRAJECTORY_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "data/camera.h"
#include "lib/status.h"

typedef struct dar_span {
    double lo, hi;
} dar_span;

/* In the order of the formulas above. */
typedef enum dar_trajectory_part {
    DAR_TRAJECTORY_YAW,
    DAR_TRAJECTORY_SPAN,
    DAR_TRAJECTORY_PITCH,
    DAR_TRAJECTORY_RISE,
    DAR_TRAJECTORY_ROLL,
    DAR_TRAJECTORY_DOLLY,
    DAR_TRAJECTORY_PAN,
    DAR_TRAJECTORY_RADIUS,
    DAR_TRAJECTORY_PARTS
} dar_trajectory_part;

typedef struct dar_trajectory_kind {
    const char *name, *family; /* family: "blender", "unreal" or "benchmark" */
    bool mirror;               /* span, roll and pan change sign, together, in half of the draws */
    dar_span bound[DAR_TRAJECTORY_PARTS];
} dar_trajectory_kind;

extern const dar_trajectory_kind dar_trajectory_kinds[];
extern const size_t dar_trajectory_count;

/* Fails with the names that are nearest. */
dar_status dar_trajectory_find(const char *name, const dar_trajectory_kind **kind, dar_err *e);

typedef struct dar_trajectory {
    const dar_trajectory_kind *kind;
    double part[DAR_TRAJECTORY_PARTS];
} dar_trajectory;

dar_trajectory dar_trajectory_draw(const dar_trajectory_kind *kind, uint64_t seed, uint64_t index);

typedef struct dar_box {
    double lo[3], hi[3];
} dar_box;

/* What a path goes around, and what it is filmed with. */
typedef struct dar_stage {
    const dar_box *box; /* [boxes] of everything visible; box[t] at frame t if boxes == frames, else they hold always */
    size_t boxes;
    bool z_up;         /* else y */
    bool has_ground;   /* the camera stays above the lowest point of all boxes */
    int width, height; /* [px] */
    double fov;        /* [rad] across the shorter side of the picture */
    double margin;     /* share of the picture on each side that stays free */
    double near;       /* 0: a thousandth of the distance */
} dar_stage;

dar_stage dar_stage_standard(void); /* 832 x 480, 40 degrees, margin 0.05, near 0, y up, ground; no boxes */

/* Fill p, whose frames are set.  Fails if the path is not safe (below), or if the boxes are not finite or empty. */
dar_status dar_trajectory_path(const dar_trajectory *t, const dar_stage *stage, dar_camera_path *p, dar_err *e);

/* Whether a path, of whatever origin, is safe to render: at every frame the camera is outside the box, its near plane
 * does not reach into it, it is not below the ground, and some of the box is in front of it.  Else the first frame at
 * which it is not, and why.  boxes as in dar_stage. */
typedef enum dar_path_fault {
    DAR_PATH_SAFE,
    DAR_PATH_INSIDE, /* of the box */
    DAR_PATH_NEAR,   /* the near plane cuts the box */
    DAR_PATH_GROUND,
    DAR_PATH_BEHIND, /* nothing is in front of the camera */
} dar_path_fault;

extern const char *const dar_path_fault_text[];
dar_path_fault dar_trajectory_check(const dar_camera_path *p, const dar_stage *stage, size_t *frame);

/* Whether the whole box projects into the picture, less `margin` of its size on each side. */
bool dar_trajectory_in_view(const dar_view *v, const dar_box *box, double margin);

#endif
