/* fuzz_obj.c: any bytes as an OBJ file, and as a pattern and, after a zero byte, a name. */
#include <stdint.h>
#include <string.h>

#include "data/objseq.h"
#include "tests/fuzz_scene.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    dar_scene s;
    dar_err e = { "" };
    char text[2][64] = { { 0 } };
    const uint8_t *zero = size ? memchr(data, 0, size) : NULL;
    size_t first = zero ? (size_t)(zero - data) : size, second = zero ? size - first - 1 : 0;

    if (dar_objseq_parse(&s, "fuzz", data, size, &e) == DAR_OK) {
        fuzz_check_scene(&s);
    } else {
        DAR_ASSERT(!s.memory.base, "failed, yet open");
        fuzz_check_line(&e, "fuzz");
    }
    dar_scene_free(&s);

    if (first && first < sizeof text[0]) memcpy(text[0], data, first);
    if (second && second < sizeof text[1]) memcpy(text[1], zero + 1, second);
    dar_objseq_fits(text[0], text[1]);
    int there = dar_objseq_order(text[0], text[1]), back = dar_objseq_order(text[1], text[0]);
    DAR_ASSERT((there > 0) == (back < 0) && (there < 0) == (back > 0), "'%s', '%s': %d, %d", text[0], text[1], there,
               back);
    return 0;
}
