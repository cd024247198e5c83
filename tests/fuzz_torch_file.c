/* fuzz_torch_file.c: any bytes as a file of torch.save, and as the pickle of a state dict in one. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "tests/fuzz_weights.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static const uint8_t head[] =
        "\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.\x80\x02M\xe9\x03.\x80\x02}.";
    static const uint8_t tail[] = "\x80\x02]X\1\0\0\0"
                                  "0a.\2\0\0\0\0\0\0\0\0\0\x80\x3f\0\0\0\x40";
    size_t first = sizeof head - 1, last = sizeof tail - 1;
    fuzz_weights(data, size);

    uint8_t *whole = malloc(first + size + last);
    if (!whole) return 0;
    memcpy(whole, head, first);
    if (size) memcpy(whole + first, data, size);
    memcpy(whole + first + size, tail, last);
    fuzz_weights(whole, first + size + last);
    free(whole);
    return 0;
}
