/* dir.h: whole directories, replaced in one moment when written.
 *
 *     DAR_TRY(dar_dir_create(&o, "out/run", e));
 *     ... files below o.temp, each flushed by who writes it ...
 *     s = dar_dir_commit(&o, overwrite, e);
 *     dar_dir_discard(&o);
 *
 * A writer that is killed leaves its temporary directory, NAME.tmp-..., beside the target; the next writer of the same
 * target removes it.  Those of writers that live are told apart by a lock. */
#ifndef DAR_LIB_DIR_H
#define DAR_LIB_DIR_H

#include <limits.h>
#include <stdbool.h>

#include "lib/status.h"

typedef struct dar_dir_out {
    int lock; /* the temporary directory, held; -1: closed */
    char path[PATH_MAX], temp[PATH_MAX];
} dar_dir_out;

/* Make a directory, and those it lies in, where they are not there. */
dar_status dar_dir_make(const char *path, dar_err *e);

/* Make the temporary directory beside `path`, and those it lies in where they are not there.  From here to commit
 * nothing touches `path`.  After a failure of any of these the caller owes one dar_dir_discard. */
dar_status dar_dir_create(dar_dir_out *o, const char *path, dar_err *e);

/* Flush and rename to `path`.  Fails if something is there, unless it may be overwritten: then the two change places in
 * one moment, and what was there is removed with all that it holds. */
dar_status dar_dir_commit(dar_dir_out *o, bool overwrite, dar_err *e);

/* Remove what was not committed.  Accepts a committed or zeroed one. */
void dar_dir_discard(dar_dir_out *o);

/* Remove a file or directory with all that it holds: under a temporary name, so that a kill leaves no half of it under
 * its own. */
dar_status dar_dir_remove(const char *path, dar_err *e);

/* Make the directory `to`, which is not there, on the same file system, and give every file below `from` a name below
 * it too (a hard link): no bytes are copied, and what is removed at one of them stays at the other. */
dar_status dar_dir_link(const char *from, const char *to, dar_err *e);

/* Hold an existing directory: only one program at a time can.  close(*fd) gives it back; on failure *fd is -1. */
dar_status dar_dir_lock(int *fd, const char *path, dar_err *e);

/* Whether a name is one that writers of files or directories use before they rename: NAME.tmp-DIGITS, and more digits.
 */
bool dar_dir_temporary(const char *name);

#endif
