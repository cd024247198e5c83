/* uri.h: the two kinds of URI that a model file may use for its data: base64 within, and a file beside it. */
#ifndef DAR_DATA_URI_H
#define DAR_DATA_URI_H

#include <limits.h>
#include <stdbool.h>
#include <stddef.h>

bool dar_uri_is_data(const char *uri);

/* Decode "data:[type];base64,..." into out, room for strlen(uri) bytes; *size: how many came.  Returns NULL, or what
 * was expected instead.  Padding may be absent; anything else that is not base64 is refused. */
const char *dar_uri_decode(const char *uri, unsigned char *out, size_t *size);

/* The path of a plain relative URI beside the file `base`, percent signs decoded.  Returns NULL, or what was expected
 * instead: schemes, absolute paths, backslashes, control characters and ".." are refused, so that a model cannot name a
 * file outside its own directory. */
const char *dar_uri_path(const char *uri, const char *base, char out[PATH_MAX]);

#endif
