/* merge.h: a checkpoint's additions and adapter put into the weights: a model that stands by itself. */
#ifndef DAR_TRAIN_MERGE_H
#define DAR_TRAIN_MERGE_H

#include "lib/dtype.h"
#include "lib/status.h"

/* Write OUT/dit.safetensors, under the public names, matrices as `storage`, and OUT/model.json, which dar-sample opens.
 * What is at `out` is replaced in one moment. */
dar_status dar_merge(const char *checkpoint, const char *out, dar_dtype storage, dar_err *e);

#endif
