/* clips.h: the bundles that a configuration names: bundles, or directories of them. */
#ifndef DAR_TRAIN_CLIPS_H
#define DAR_TRAIN_CLIPS_H

#include <stddef.h>

#include "lib/json.h"
#include "lib/status.h"

typedef struct dar_clips {
    char **path; /* [n] */
    size_t n, room;
} dar_clips;

/* Of a list of texts; what is in a directory is sorted by name.  Fails if one of the list holds no bundle.  On failure
 * *c is empty. */
dar_status dar_clips_find(dar_clips *c, dar_json list, dar_err *e);
void dar_clips_free(dar_clips *c); /* accepts a zeroed one */

#endif
