/* place.h: where things go in a scene, and how they move as a whole, so that none meets another.
 *
 * A thing is a box per frame, about its own root, and becomes a place and a turn of the root per frame.  Its footprint
 * at a frame is the box of the turned box, seen from above, widened by the margin; footprints of two things are apart
 * at every frame, and inside the area.
 *
 * Source: the paper, 4.2: AABB rejection sampling with a margin; spin, tilt, bob, slide, sway, self-orbit; walks along
 * Catmull-Rom paths, rejected on collision at the same frame, else stationary. */
#ifndef DAR_DATA_PLACE_H
#define DAR_DATA_PLACE_H

#include "data/asset.h"
#include "data/trajectory.h"

typedef enum dar_place_motion {
    DAR_PLACE_STILL,
    DAR_PLACE_SPIN,
    DAR_PLACE_TILT,
    DAR_PLACE_BOB,
    DAR_PLACE_SLIDE,
    DAR_PLACE_SWAY,
    DAR_PLACE_ORBIT, /* in a small circle, turning with it */
    DAR_PLACE_WALK,
    DAR_PLACE_MOTIONS
} dar_place_motion;
extern const char *const dar_place_motion_name[];

typedef struct dar_place_thing {
    const dar_asset *asset;
    const dar_box *local; /* [frames] about the root */
    double (*at)[3];      /* [frames] of the root */
    double (*turn)[4];    /* [frames] */
    dar_box *box;         /* [frames] that hold the thing in the world */
    dar_place_motion motion;
    bool placed;
} dar_place_thing;

typedef struct dar_place_area {
    double radius; /* [m] about the origin, on the ground y = 0 */
    double margin; /* [m] between two things: half of it belongs to each */
    size_t frames;
    double fps;
    size_t tries;
} dar_place_area;

/* Fill at, turn and box of thing[n], the others of which are placed or not.  Walkers that find no way stand still.
 * wanted: of a thing that stays.  False, and not placed, if there is no room. */
bool dar_place_put(const dar_place_area *area, dar_place_thing *thing, size_t n, dar_place_motion wanted, dar_dice *d);

/* Whether two boxes share a point. */
bool dar_place_meet(const dar_box *a, const dar_box *b);

#endif
