/* fuzz_gltf.c: any bytes as a glTF file; again as the JSON and, after a zero byte, the binary chunk of a .glb whose
 * lengths are right. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "data/gltf.h"
#include "tests/fuzz_scene.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void try(const uint8_t *data, size_t size)
{
    dar_scene s;
    dar_err e = { "" };
    if (dar_gltf_parse(&s, "nowhere/fuzz", data, size, true, &e) == DAR_OK) {
        fuzz_check_scene(&s);
    } else {
        DAR_ASSERT(!s.memory.base, "failed, yet open");
        fuzz_check_line(&e, "nowhere/fuzz");
    }
    dar_scene_free(&s);
}

static uint8_t *put_u32(uint8_t *p, size_t x)
{
    for (int i = 0; i < 4; i++) *p++ = (uint8_t)(x >> 8 * i);
    return p;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    const uint8_t *zero = size ? memchr(data, 0, size) : NULL;
    size_t json = zero ? (size_t)(zero - data) : size, bin = zero ? size - json - 1 : 0;
    uint8_t *glb = malloc(28 + size), *p = glb;

    try(data, size);
    if (!glb) return 0;
    p = put_u32(put_u32(put_u32(p, 0x46546c67), 2), 28 + json + bin);
    p = put_u32(put_u32(p, json), 0x4e4f534a);
    if (json) memcpy(p, data, json);
    p = put_u32(put_u32(p + json, bin), 0x004e4942);
    if (bin) memcpy(p, zero + 1, bin);
    try(glb, 28 + json + bin);
    free(glb);
    return 0;
}
