/* inflate.c: unpacking, through libdeflate. */
#include "data/inflate.h"

#include <libdeflate.h>

#include "lib/status.h"

bool dar_inflate(const void *in, size_t packed, void *out, size_t size)
{
    struct libdeflate_decompressor *z = libdeflate_alloc_decompressor();
    DAR_ASSERT(z, "inflate: out of memory");
    bool whole = libdeflate_zlib_decompress(z, in, packed, out, size, NULL) == LIBDEFLATE_SUCCESS;
    libdeflate_free_decompressor(z);
    return whole;
}

void dar_unshuffle(const void *in, size_t size, size_t element, void *out)
{
    const unsigned char *x = in;
    unsigned char *y = out;
    for (size_t k = 0; k < element; k++)
        for (size_t i = 0; i < size / element; i++) y[i * element + k] = *x++;
}
