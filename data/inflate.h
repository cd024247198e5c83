/* inflate.h: arrays as HDF5's filters shuffle and deflate leave them, unpacked through libdeflate.
 *
 * Shuffled, byte k of all elements comes before byte k + 1 of any. */
#ifndef DAR_DATA_INFLATE_H
#define DAR_DATA_INFLATE_H

#include <stdbool.h>
#include <stddef.h>

/* Whether in[0, packed) is a sound stream, in zlib's format, of exactly `size` bytes; writes no more than these. */
bool dar_inflate(const void *in, size_t packed, void *out, size_t size);

/* size is a multiple of `element`; in and out do not overlap. */
void dar_unshuffle(const void *in, size_t size, size_t element, void *out);

#endif
