/* file.h: whole files: mapped for reading; replaced in one moment when written.
 *
 * A mapped file must not be truncated by somebody else while it is read: the system answers that with SIGBUS. */
#ifndef DAR_LIB_FILE_H
#define DAR_LIB_FILE_H

#include <limits.h>
#include <stddef.h>

#include "lib/status.h"

typedef struct dar_file_map {
    const unsigned char *data; /* read-only, page-aligned; NULL if the file is empty */
    size_t size;               /* [bytes] */
} dar_file_map;

/* Map a regular file; anything else is refused.  On failure *m is zeroed. */
dar_status dar_file_map_open(dar_file_map *m, const char *path, dar_err *e);

/* Accepts a zeroed map. */
void dar_file_map_close(dar_file_map *m);

/* Give back the memory of what was read so far; it is read again when it is touched.  Accepts a zeroed map. */
void dar_file_map_rest(const dar_file_map *m);

/* A file being written under a temporary name in the same directory. */
typedef struct dar_file_out {
    int fd; /* -1: closed */
    char path[PATH_MAX], temp[PATH_MAX];
} dar_file_out;

/* Create the temporary file.  From here to commit nothing touches `path`.  After a failure of any of these the caller
 * owes one dar_file_discard. */
dar_status dar_file_create(dar_file_out *o, const char *path, dar_err *e);

/* Append.  A full disk or quota is DAR_ERR_NOMEM. */
dar_status dar_file_write(dar_file_out *o, const void *data, size_t size, dar_err *e);

/* Flush to the disk and close; the file still has its temporary name. */
dar_status dar_file_flush(dar_file_out *o, dar_err *e);

/* Flush if that is still to be done, rename to `path`, flush the directory. */
dar_status dar_file_commit(dar_file_out *o, dar_err *e);

/* Remove what was not committed.  Accepts a committed or zeroed one. */
void dar_file_discard(dar_file_out *o);

/* A name that was made or changed is on the disk when its directory is: flush that.  0, or an errno. */
int dar_file_flush_entry(const char *path);

#endif
