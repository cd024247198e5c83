/* sha256.h: SHA-256, to tell whether a file is the one that was written.  Source: FIPS 180-4. */
#ifndef DAR_LIB_SHA256_H
#define DAR_LIB_SHA256_H

#include <stddef.h>

#include "lib/status.h"

#define DAR_SHA256_TEXT 65 /* 64 digits and the end */

typedef struct dar_sha256 {
    void *state; /* on the heap from init to finish */
} dar_sha256;

void dar_sha256_init(dar_sha256 *h);
void dar_sha256_add(dar_sha256 *h, const void *data, size_t size);

/* Digits 0-9a-f.  Owed to every init, after which h must be initialised again before it is used again. */
void dar_sha256_finish(dar_sha256 *h, char text[DAR_SHA256_TEXT]);

/* Of a whole file. */
dar_status dar_sha256_file(const char *path, char text[DAR_SHA256_TEXT], dar_err *e);

#endif
