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

static inline void unshuffle(const unsigned char *restrict x, size_t n, size_t element, unsigned char *restrict y)
{
    for (size_t i = 0; i < n; i++)
        for (size_t k = 0; k < element; k++) y[i * element + k] = x[k * n + i];
}

/* The element's size is constant in the two loops that occur, so that the compiler can use vectors. */
void dar_unshuffle(const void *in, size_t size, size_t element, void *out)
{
    if (element == 2) unshuffle(in, size / 2, 2, out);
    else if (element == 4) unshuffle(in, size / 4, 4, out);
    else unshuffle(in, size / element, element, out);
}
