/* image.c: which decoder. */
#include "data/image.h"

#include "data/jpeg.h"
#include "data/png.h"

static dar_status unknown(const char *name, dar_err *e)
{
    return dar_fail(e, DAR_ERR_FORMAT, "%s: neither a PNG nor a JPEG picture", name);
}

dar_status dar_image_probe(dar_image *im, const char *name, const void *data, size_t size, dar_err *e)
{
    *im = (dar_image){ 0 };
    if (dar_png_is(data, size)) DAR_TRY(dar_png_probe(im, name, data, size, e));
    else if (dar_jpeg_is(data, size)) DAR_TRY(dar_jpeg_probe(im, name, data, size, e));
    else return unknown(name, e);
    if (im->width - 1 < DAR_IMAGE_MAX_SIDE && im->height - 1 < DAR_IMAGE_MAX_SIDE) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: %zu x %zu pixels, expected 1 to %d each way", name, im->width, im->height,
                    DAR_IMAGE_MAX_SIDE);
}

dar_status dar_image_decode(const dar_image *im, const char *name, const void *data, size_t size, dar_err *e)
{
    if (dar_png_is(data, size)) return dar_png_decode(im, name, data, size, e);
    if (dar_jpeg_is(data, size)) return dar_jpeg_decode(im, name, data, size, e);
    return unknown(name, e);
}
