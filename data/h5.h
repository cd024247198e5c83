/* h5.h: HDF5 files of plain arrays, through the serial HDF5 library: read and written some leading indices at a time.
 *
 * A file is used by one thread at a time.  Threads with files of their own wait for each other, but where chunks are
 * unpacked, since HDF5 is not re-entrant on every system.  The type in memory is the type in the file; nothing is
 * converted.  Names of datasets are paths inside the file, without a leading slash: "tracking", "sparse_tracking/xy".
 */
#ifndef DAR_DATA_H5_H
#define DAR_DATA_H5_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"

#define DAR_H5_RANK      5
#define DAR_H5_CHUNK_MAX ((uint64_t)1 << 30) /* [bytes] of one chunk in a file that is read */

typedef enum dar_h5_type { DAR_H5_U8, DAR_H5_U16, DAR_H5_I16, DAR_H5_U32, DAR_H5_F32, DAR_H5_TYPES } dar_h5_type;

typedef struct dar_h5_array {
    dar_h5_type type;
    int rank; /* 1 to DAR_H5_RANK */
    uint64_t dim[DAR_H5_RANK];
    uint64_t chunk; /* leading indices per chunk; 0: one */
} dar_h5_array;

typedef struct dar_h5 dar_h5;

/* Create under a temporary name.  On failure *out is NULL. */
dar_status dar_h5_create(dar_h5 **out, const char *path, dar_err *e);

/* Flush and rename to `path`.  Whatever the outcome, the caller still owes dar_h5_close and does nothing else. */
dar_status dar_h5_commit(dar_h5 *f, dar_err *e);

/* Open for reading.  On failure *out is NULL. */
dar_status dar_h5_open(dar_h5 **out, const char *path, dar_err *e);

/* Accepts NULL.  What was created and not committed is removed. */
void dar_h5_close(dar_h5 *f);

/* ---------------------------------------------------------------- arrays */

size_t dar_h5_type_size(dar_h5_type type); /* [bytes] */

/* Make a dataset, shuffled and deflated; what is never written reads as zero and takes no room.  Groups on the way are
 * made. */
dar_status dar_h5_make(dar_h5 *f, const char *name, const dar_h5_array *a, dar_err *e);

bool dar_h5_has(dar_h5 *f, const char *name);

/* The dataset must have this type, rank and dimensions; a dimension of 0 stands for any and is filled in.  `chunk` is
 * not compared: chunks may have any shape, plain or shuffled and deflated, or there are none.  Nothing is allocated
 * before that. */
dar_status dar_h5_expect(dar_h5 *f, const char *name, dar_h5_array *a, dar_err *e);

/* Leading indices [first, first + count) of an array made or expected as `a`; `data` holds count elements of
 * dim[1] ... dim[rank - 1] each. */
dar_status dar_h5_write(dar_h5 *f, const char *name, const dar_h5_array *a, uint64_t first, uint64_t count,
                        const void *data, dar_err *e);
dar_status dar_h5_read(dar_h5 *f, const char *name, const dar_h5_array *a, uint64_t first, uint64_t count, void *data,
                       dar_err *e);

/* Chunk number `index` of an array made with one leading index per chunk: data[0, size) is what HDF5's filters would
 * make of it, its bytes shuffled (first bytes of all elements, then second bytes ...), then deflated. */
dar_status dar_h5_write_chunk(dar_h5 *f, const char *name, const dar_h5_array *a, uint64_t index, const void *data,
                              size_t size, dar_err *e);

/* ---------------------------------------------------------------- attributes of a dataset */

dar_status dar_h5_put_numbers(dar_h5 *f, const char *name, const char *key, const double *x, size_t n, dar_err *e);
dar_status dar_h5_put_text(dar_h5 *f, const char *name, const char *key, const char *text, dar_err *e);

/* Exactly n numbers; a text that fits into size bytes with its end. */
dar_status dar_h5_get_numbers(dar_h5 *f, const char *name, const char *key, double *x, size_t n, dar_err *e);
dar_status dar_h5_get_text(dar_h5 *f, const char *name, const char *key, char *text, size_t size, dar_err *e);

#endif
