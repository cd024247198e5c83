/* checkpoint_inside.h: the files of one checkpoint; for checkpoint.c. */
#ifndef DAR_TRAIN_CHECKPOINT_INSIDE_H
#define DAR_TRAIN_CHECKPOINT_INSIDE_H

#include "train/checkpoint.h"

/* All files of c->step into a directory, each flushed. */
dar_status dar_checkpoint_write(const dar_checkpoint *c, const char *directory, dar_err *e);

/* Whether the files are those that were written. */
dar_status dar_checkpoint_verify(const char *directory, dar_err *e);

/* Take parameters, moments, counts and c->step from a directory that was verified. */
dar_status dar_checkpoint_read(dar_checkpoint *c, const char *directory, dar_err *e);

#endif
