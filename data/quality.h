/* quality.h: whether a bundle is fit to train on and to be compared with: named checks with a limit each.
 *
 *     DAR_TRY(dar_quality_check(&q, bundle, e));
 *     for (size_t i = 0; i < DAR_QUALITY_CHECKS; i++)
 *         puts(dar_quality_text(&q, i, text));
 *     return q.bad ? 1 : 0;
 *
 *   check        what is found                                                                       limit
 *   files        1 if a file that meta.json names is missing or another than when it was written      <= 0
 *   reference    bytes in which reference.png differs from frame 0 of rgb                              <= 0
 *   path         1 if the camera path is not safe to render (data/trajectory.h), by the boxes of
 *                the frames, or else the bounds                                                        <= 0
 *   finite       numbers that are not finite                                                           <= 0
 *   mask         pixels that some families cover and others do not: background is 0 everywhere,
 *                and 0 nowhere else                                                                    <= 0
 *   coverage     least share of a picture that is covered                                              >= 0.001
 *   depth        the nearest and farthest depth against meta.json's and the near plane, in shares
 *                of the farthest                                                                       <= 1e-6
 *   bounds       how far a position is outside of the clip's bounds, or of its frame's box, in
 *                sizes of the scene                                                                    <= 1e-5
 *   scale        the normalisation is one for all axes, takes the bounds into (0, 1), and is that of
 *                the stored numbers: largest departure, in sizes                                       <= 1e-6
 *   position     distance along an axis between camera + ray * depth and the stored position, in
 *                sizes of the scene, or in 1 / 32 of the distance if that is more                      <= 1e-5
 *   order        frames whose positions fit another frame's camera better than their own               <= 0
 *   normal       | |n| - 1 |                                                                           <= 1e-3
 *   slope        mean of n . (normal of the surface that depth describes): 1 if normals are in the
 *                world and towards the outside                                                         >= 0.8
 *   identity     pixels whose colour is not in the cell of their part, or whose part is not of their
 *                instance: constant over time, since cells are (data/identity.h)                       <= 0
 *   tracks       share of visible tracks whose colour is there where they are; that of a surface
 *                seen so flat that no pixel shows it is not                                            >= 0.5
 *   uniform-...  standard deviation over the clip of rgb (the least of all frames), tracking and
 *                normal as in [0, 1], depth and world in sizes of the scene; the largest of channels   >= 0.01
 *
 * What a check needs may be missing from the bundle: it is then unchecked, and its text says what is missing.  The
 * order of pictures cannot be told from them.  Memory: 19 bytes per pixel and the tracks.  Frames are
 * read one at a time, families one after the other.  Same results for any thread count.
 *
 * Source: the paper, 4.3: near-uniform statistics, unsafe camera paths, scene-level normalisation, consistency. */
#ifndef DAR_DATA_QUALITY_H
#define DAR_DATA_QUALITY_H

#include <stdbool.h>
#include <stddef.h>

#include "data/bundle.h"
#include "lib/json_write.h"
#include "lib/status.h"

typedef enum dar_quality_name {
    DAR_QUALITY_FILES,
    DAR_QUALITY_REFERENCE,
    DAR_QUALITY_PATH,
    DAR_QUALITY_FINITE,
    DAR_QUALITY_MASK,
    DAR_QUALITY_COVERAGE,
    DAR_QUALITY_DEPTH,
    DAR_QUALITY_BOUNDS,
    DAR_QUALITY_SCALE,
    DAR_QUALITY_POSITION,
    DAR_QUALITY_ORDER,
    DAR_QUALITY_NORMAL,
    DAR_QUALITY_SLOPE,
    DAR_QUALITY_IDENTITY,
    DAR_QUALITY_TRACKS,
    DAR_QUALITY_UNIFORM_RGB,
    DAR_QUALITY_UNIFORM_TRACKING,
    DAR_QUALITY_UNIFORM_NORMAL,
    DAR_QUALITY_UNIFORM_DEPTH,
    DAR_QUALITY_UNIFORM_WORLD,
    DAR_QUALITY_CHECKS
} dar_quality_name;

typedef struct dar_quality_limit {
    const char *name;
    bool at_least; /* else at most */
    double limit;
    const char *unit;    /* of what is found, with a space before it, or "" */
    const char *meaning; /* what is wrong if it is beyond the limit */
    const char *needs;   /* of the bundle */
} dar_quality_limit;

extern const dar_quality_limit dar_quality_table[DAR_QUALITY_CHECKS];

typedef enum dar_quality_state { DAR_QUALITY_UNCHECKED, DAR_QUALITY_GOOD, DAR_QUALITY_BAD } dar_quality_state;

typedef struct dar_quality_result {
    dar_quality_state state;
    double found;
    size_t frame;     /* the worst; DAR_QUALITY_CLIP: of no one frame */
    char reason[240]; /* bad: in detail, or ""; unchecked: what is missing */
} dar_quality_result;

#define DAR_QUALITY_CLIP SIZE_MAX

typedef struct dar_quality {
    dar_quality_result result[DAR_QUALITY_CHECKS];
    size_t good, bad, unchecked;
} dar_quality;

/* Fails only if the bundle cannot be read. */
dar_status dar_quality_check(dar_quality *q, dar_bundle *b, dar_err *e);

#define DAR_QUALITY_TEXT 640

/* One line: "position: bad: 0.034 sizes of the scene at frame 17, expected at most 1e-05: ...".  Returns text. */
const char *dar_quality_text(const dar_quality *q, dar_quality_name name, char text[DAR_QUALITY_TEXT]);

/* { "passed": ..., "checks": { "files": { "state", "found", "limit", "frame", "reason" }, ... } } under `key`: what
 * dar_bundle_set_quality takes. */
void dar_quality_print(const dar_quality *q, dar_json_writer *w, const char *key);

#endif
