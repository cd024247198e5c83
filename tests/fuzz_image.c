/* fuzz_image.c: any bytes as a PNG or JPEG picture. */
#include <stdint.h>
#include <stdlib.h>

#include "data/image.h"
#include "tests/fuzz_scene.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    dar_image im;
    dar_err e = { "" };
    if (dar_image_probe(&im, "fuzz", data, size, &e) != DAR_OK) {
        fuzz_check_line(&e, "fuzz");
        return 0;
    }
    if (im.width * im.height > 1 << 20) return 0; /* more would only cost time */
    im.rgba = malloc(4 * im.width * im.height);
    if (im.rgba && dar_image_decode(&im, "fuzz", data, size, &e) != DAR_OK) fuzz_check_line(&e, "fuzz");
    free(im.rgba);
    return 0;
}
