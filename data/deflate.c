/* deflate.c: the only user of zlib. */
#include "data/deflate.h"

#include <zlib.h>

size_t dar_deflate_bound(size_t size)
{
    return compressBound(size);
}

size_t dar_deflate(const void *in, size_t size, int level, void *out)
{
    uLongf packed = compressBound(size);
    return compress2(out, &packed, in, size, level) == Z_OK ? packed : 0;
}

bool dar_inflate(const void *in, size_t packed, void *out, size_t size)
{
    uLongf found = size;
    return uncompress(out, &found, in, packed) == Z_OK && found == size;
}

void dar_shuffle(const void *in, size_t size, size_t element, void *out)
{
    const unsigned char *x = in;
    unsigned char *y = out;
    for (size_t k = 0; k < element; k++)
        for (size_t i = 0; i < size / element; i++) *y++ = x[i * element + k];
}

void dar_unshuffle(const void *in, size_t size, size_t element, void *out)
{
    const unsigned char *x = in;
    unsigned char *y = out;
    for (size_t k = 0; k < element; k++)
        for (size_t i = 0; i < size / element; i++) y[i * element + k] = *x++;
}
