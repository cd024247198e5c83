/* inflate.c: unpacking, through zlib. */
#include "data/inflate.h"

#include <zlib.h>

bool dar_inflate(const void *in, size_t packed, void *out, size_t size)
{
    uLongf found = size;
    return uncompress(out, &found, in, packed) == Z_OK && found == size;
}

void dar_unshuffle(const void *in, size_t size, size_t element, void *out)
{
    const unsigned char *x = in;
    unsigned char *y = out;
    for (size_t k = 0; k < element; k++)
        for (size_t i = 0; i < size / element; i++) y[i * element + k] = *x++;
}
