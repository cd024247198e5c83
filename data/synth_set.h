/* synth_set.h: sets of synthetic scenes by name: which scene, paint and camera the bundle with a number has.
 *
 *   set                bundles    what they share
 *   train              any        nothing: subjects of the training kinds, all archetypes of camera paths
 *   4d_vis             17 x 4     one subject each of 17 kinds, under the four paths of the benchmark
 *   ood34              17 x 2     17 other kinds, each under two archetypes
 *   refvar             10         one vehicle, one camera, ten appearances
 *   motion-separation  5 x 5      rows: one animation; columns: one camera path, the same to the bit
 *   correspondence     16         half and full orbits, whose first and last views have little in common
 *
 * No kind of thing that moves by itself is in two of train, 4d_vis and ood34.
 *
 * Source: the paper, tables of sources and of trajectories, supplement C. */
#ifndef DAR_DATA_SYNTH_SET_H
#define DAR_DATA_SYNTH_SET_H

#include "data/synth.h"

#define DAR_SYNTH_OWN 4 /* attempts that leave alone what a bundle shares with others */

/* Place of a bundle in its set, and the seeds of what it shares with others there and of what is its own. */
typedef struct dar_synth_cell {
    uint64_t shared, own;
    size_t row, column;
} dar_synth_cell;

typedef struct dar_synth_set {
    const char *name, *help;
    size_t rows, columns; /* 0: any number of bundles */
    void (*plan)(const dar_synth_cell *cell, dar_synth_plan *plan);
} dar_synth_set;

extern const dar_synth_set dar_synth_sets[];
extern const char *const dar_synth_set_names[]; /* ends with NULL */

/* Seeds, subject, path and reach of bundle `index`; the rest of the plan stays.  Another attempt draws again what the
 * bundle shares with no other: of refvar the paints and lights, of ood34 and motion-separation the camera path, else,
 * and every DAR_SYNTH_OWN attempts, the scene.  Other bundles stay as they are.
 * family: of the subjects, NULL: any; only where the set draws them. */
void dar_synth_set_plan(const dar_synth_set *set, uint64_t seed, size_t index, size_t attempt, const char *family,
                        dar_synth_plan *plan);

/* Whether subjects of that family are in the training kinds. */
bool dar_synth_set_has(const char *family);

#endif
