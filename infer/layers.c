/* layers.c: see layers.h. */
#include "infer/layers.h"

#include <stdlib.h>
#include <string.h>

#include "lib/dtype.h"

dar_status dar_layers_init(dar_layers *l, const dar_bundle *b, dar_err *e)
{
    *l = (dar_layers){ .pixels = (size_t)b->meta.width * (size_t)b->meta.height };
    size_t n = l->pixels;
    if (!(l->memory = malloc(n * (2 * sizeof(float) + sizeof(uint32_t) + 4 * sizeof(uint16_t)))))
        return dar_fail(e, DAR_ERR_NOMEM, "layers of %d x %d: out of memory", b->meta.width, b->meta.height);
    l->depth = l->memory;
    l->mask = l->depth + n;
    l->id = (uint32_t *)(l->mask + n);
    l->half[0] = (uint16_t *)(l->id + n);
    for (int i = 1; i < 4; i++) l->half[i] = l->half[i - 1] + n;
    dar_srgb_init(&l->srgb);
    return DAR_OK;
}

void dar_layers_free(dar_layers *l)
{
    free(l->memory);
    *l = (dar_layers){ 0 };
}

dar_status dar_layers_write(dar_layers *l, const char *path, dar_bundle *b, size_t index, const uint8_t *rgb,
                            const char *comment, dar_err *e)
{
    static const char *const name[] = { "R", "G", "B", "A" };
    dar_exr_plane plane[6];
    size_t n = 0;
    for (int c = 0; c < 3; c++) {
        for (size_t i = 0; i < l->pixels; i++)
            dar_dtype_set(DAR_F16, l->half[c], i, (double)l->srgb.linear[rgb[3 * i + (size_t)c]]);
        plane[n++] = (dar_exr_plane){ name[c], DAR_EXR_F16, l->half[c] };
    }
    if (dar_bundle_has(b, DAR_FAMILY_MASK)) {
        DAR_TRY(dar_bundle_values(b, DAR_FAMILY_MASK, index, l->mask, e));
        for (size_t i = 0; i < l->pixels; i++) dar_dtype_set(DAR_F16, l->half[3], i, (double)l->mask[i]);
        plane[n++] = (dar_exr_plane){ name[3], DAR_EXR_F16, l->half[3] };
    }
    if (dar_bundle_has(b, DAR_FAMILY_DEPTH)) {
        DAR_TRY(dar_bundle_values(b, DAR_FAMILY_DEPTH, index, l->depth, e));
        plane[n++] = (dar_exr_plane){ "depth.Z", DAR_EXR_F32, l->depth };
    }
    if (dar_bundle_has(b, DAR_BUNDLE_ID)) {
        DAR_TRY(dar_bundle_numbers(b, DAR_BUNDLE_ID, index, l->id, e));
        plane[n++] = (dar_exr_plane){ "id.X", DAR_EXR_U32, l->id };
    }
    return dar_exr_write(path, (size_t)b->meta.width, (size_t)b->meta.height, plane, n,
                         &(dar_exr_how){ DAR_EXR_ZIP, comment }, e);
}
