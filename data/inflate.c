/* inflate.c: unpacking, through ISA-L. */
#include "data/inflate.h"

#include <isa-l/igzip_lib.h>
#include <stdint.h>

#include "lib/cpu.h"

bool dar_inflate(const void *in, size_t packed, void *out, size_t size)
{
    struct inflate_state z;
    DAR_ASSERT(packed <= UINT32_MAX && size <= UINT32_MAX, "inflate: %zu bytes to %zu", packed, size);
    isal_inflate_init(&z);
    z.crc_flag = ISAL_ZLIB;
    z.next_in = (unsigned char *)(uintptr_t)in;
    z.avail_in = (uint32_t)packed;
    z.next_out = out;
    z.avail_out = (uint32_t)size;
    bool whole = isal_inflate_stateless(&z) == ISAL_DECOMP_OK && z.total_out == size;
    dar_cpu_settle();
    return whole;
}

void dar_unshuffle(const void *in, size_t size, size_t element, void *out)
{
    const unsigned char *x = in;
    unsigned char *y = out;
    for (size_t k = 0; k < element; k++)
        for (size_t i = 0; i < size / element; i++) y[i * element + k] = *x++;
}
