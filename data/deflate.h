/* deflate.h: arrays packed as HDF5's filters shuffle and deflate leave them, through zlib.
 *
 * Shuffled, byte k of all elements comes before byte k + 1 of any, which makes numbers that resemble each other short.
 */
#ifndef DAR_DATA_DEFLATE_H
#define DAR_DATA_DEFLATE_H

#include <stdbool.h>
#include <stddef.h>

/* The most that `size` bytes become. */
size_t dar_deflate_bound(size_t size);

/* Returns the packed size, 0 if out of memory.  out holds dar_deflate_bound(size). */
size_t dar_deflate(const void *in, size_t size, int level, void *out);

/* Whether in[0, packed) is a sound stream of exactly `size` bytes; writes no more than these. */
bool dar_inflate(const void *in, size_t packed, void *out, size_t size);

/* size is a multiple of `element`; in and out do not overlap. */
void dar_shuffle(const void *in, size_t size, size_t element, void *out);
void dar_unshuffle(const void *in, size_t size, size_t element, void *out);

#endif
