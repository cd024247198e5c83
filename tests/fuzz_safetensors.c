/* fuzz_safetensors.c: any bytes as a safetensors file. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "tests/fuzz_weights.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    size_t end = size;
    fuzz_weights(data, size);

    /* Again with the length of the header put right, which blind changes hardly ever do. */
    while (end > 8 && data[end - 1] != '}') end--;
    if (end <= 8) return 0;
    uint8_t *sound = malloc(size);
    if (!sound) return 0;
    memcpy(sound, data, size);
    for (size_t i = 0; i < 8; i++) sound[i] = (uint8_t)((end - 8) >> (8 * i));
    fuzz_weights(sound, size);
    free(sound);
    return 0;
}
