/* deflate.h: streams in zlib's format, deflated side by side.
 *
 * A stream is one thread's, so its bytes depend on nothing but its data.  Source: RFC 1950, RFC 1951. */
#ifndef DAR_DATA_DEFLATE_H
#define DAR_DATA_DEFLATE_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/status.h"

typedef struct dar_deflate_stream {
    const unsigned char *data;
    size_t size;
    unsigned char *out; /* room for dar_deflate_bound(size); NULL, with size 0: no stream */
    size_t out_size;    /* written */
    bool zero;          /* data is all zeros; there is an out nevertheless */
} dar_deflate_stream;

typedef struct dar_deflate dar_deflate;

size_t dar_deflate_bound(size_t size);

/* For as many threads as there are now.  On failure *out is NULL. */
dar_status dar_deflate_new(dar_deflate **out, dar_err *e);
void dar_deflate_free(dar_deflate *d); /* accepts NULL */

/* Deflate n streams. */
void dar_deflate_run(dar_deflate *d, dar_deflate_stream *stream, size_t n);

#endif
