/* clip.h: an animated scene in frames: which animation plays, and what the scene covers meanwhile. */
#ifndef DAR_DATA_CLIP_H
#define DAR_DATA_CLIP_H

#include "data/camera.h"
#include "data/mesh.h"
#include "data/trajectory.h"
#include "data/world.h"

/* The moment of frame t of an animation from begin to end. */
typedef enum dar_play {
    DAR_PLAY_LOOP,    /* t / fps after the beginning, from the start again after the end */
    DAR_PLAY_ONCE,    /* t / fps after the beginning, then the end */
    DAR_PLAY_STRETCH, /* once, the first frame at the beginning, the last at the end */
} dar_play;
extern const char *const dar_play_name[]; /* "loop", "once", "stretch", NULL */

typedef struct dar_clip {
    const dar_scene *scene;
    int animation; /* or DAR_NONE */
    size_t frames;
    double fps;
    dar_play play;
} dar_clip;

/* A file or an OBJ sequence, data/gltf.h or data/objseq.h: the latter for directories, patterns and names that end in
 * .obj.  The caller owes one dar_scene_free, also after a failure. */
dar_status dar_clip_load(dar_scene *s, const char *what, double fps, dar_err *e);

double dar_clip_time(const dar_clip *c, size_t frame); /* [s] of the animation */

/* Pose every frame: box [frames] of all vertices, and the world that holds them all.  Fails if the scene has no
 * triangles, or cannot be posed. */
dar_status dar_clip_survey(const dar_clip *c, dar_box *box, dar_world *world, dar_err *e);

/* The same by instance: box [frames, instances]. */
dar_status dar_clip_boxes(const dar_clip *c, dar_box *box, dar_err *e);

/* The path of the scene's camera of that name, or number from 0; NULL: the first.  The caller owes one dar_camera_free,
 * also after a failure. */
dar_status dar_clip_camera(const dar_clip *c, const char *name, int width, int height, dar_camera_path *p, dar_err *e);

#endif
