/* synth.h: a scene, its motion, its lights and a camera path, all drawn from three seeds.
 *
 *     dar_synth_plan plan = dar_synth_standard();
 *     plan.seed = 7;
 *     DAR_TRY(dar_synth_make(&s, &plan, e));
 *     ... s.clip, s.cameras, s.lighting, s.box, s.world: what data/render.h and data/shade.h want ...
 *     dar_synth_free(&s);
 *
 * A subject in the middle, other things around it, a ground below.  The camera path is fitted to the subject and as
 * much around it as the scene draws, so other things and the ground may be cut by the picture's edge.  Same plan, same
 * bits, on any number of threads.
 *
 * Source: the paper, 4.2. */
#ifndef DAR_DATA_SYNTH_H
#define DAR_DATA_SYNTH_H

#include "data/clip.h"
#include "data/light.h"
#include "data/place.h"

#define DAR_SYNTH_THINGS 16

typedef struct dar_synth_plan {
    uint64_t seed; /* of things, their places and motions */
    uint64_t look; /* of paints and lights */
    uint64_t view; /* of the camera path */
    dar_asset_set set;
    const dar_asset_kind *subject;   /* NULL: drawn from the set */
    const dar_trajectory_kind *path; /* NULL: drawn from the archetypes, all but those of the benchmark */
    bool alone;                      /* no second thing that moves by itself, and few others */
    bool coarse;                     /* alone, seen from nearer, in patterns of few and large figures */
    double reach;      /* > 0: the camera goes around this box, whatever is in it: x, z to +-reach, y to reach [m] */
    int width, height; /* [px] */
    size_t frames;
    double fps;
    bool bare; /* without textures: geometry alone is wanted */
} dar_synth_plan;

dar_synth_plan dar_synth_standard(void); /* seeds 0, training set, 224 x 128, 17 frames, 16 a second */

/* A thing that was placed. */
typedef struct dar_synth_thing {
    const dar_asset_kind *kind;
    dar_asset asset;
    dar_place_motion motion;
    size_t node, nodes; /* those of the thing */
    dar_box *box;       /* [frames] exact */
} dar_synth_thing;

typedef struct dar_synth {
    dar_scene scene; /* owns all of the following */
    dar_clip clip;
    dar_box *box; /* [frames] of everything */
    dar_world world;
    dar_lighting lighting;
    const char *lights;                      /* name of the lighting */
    dar_synth_thing thing[DAR_SYNTH_THINGS]; /* the subject first */
    size_t things, dropped;                  /* dropped: no room */
    double radius;                           /* of the area [m] */

    dar_camera_path cameras; /* of its own */
    dar_trajectory path;
    size_t paths; /* tried until one was safe */
} dar_synth;

/* DAR_ERR_CHECK: no safe camera path was found in the tries that there are; another seed will do.  The caller owes one
 * dar_synth_free, also after a failure. */
dar_status dar_synth_make(dar_synth *s, const dar_synth_plan *plan, dar_err *e);
void dar_synth_free(dar_synth *s); /* accepts a zeroed one */

#endif
