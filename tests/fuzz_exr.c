/* fuzz_exr.c: any bytes as an OpenEXR file, every channel decoded. */
#include <stdint.h>
#include <stdlib.h>

#include "data/exr.h"
#include "tests/fuzz_scene.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    dar_exr *x;
    dar_err e = { "" };
    if (dar_exr_parse(&x, "fuzz", data, size, &e) != DAR_OK) {
        DAR_ASSERT(!x, "failed, yet open");
        fuzz_check_line(&e, "fuzz");
        return 0;
    }
    size_t pixels = dar_exr_width(x) * dar_exr_height(x);
    void *plane = pixels <= 1 << 16 ? malloc(4 * pixels) : NULL; /* more would only cost time */
    for (size_t c = 0; c < dar_exr_channels(x) && plane; c++)
        if (dar_exr_read(x, c, plane, &e) != DAR_OK) fuzz_check_line(&e, "fuzz");
    free(plane);
    dar_exr_close(x);
    return 0;
}
