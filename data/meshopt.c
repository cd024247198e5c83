/* meshopt.c: the only user of libmeshoptimizer.  Its decoders check the packed data; the forms they take are checked
 * here, because they answer a wrong one with assert(). */
#include "data/meshopt.h"

#include <meshoptimizer.h>

const char *dar_meshopt_check(const dar_meshopt_form *f)
{
    static const size_t filter_stride[][2] = {
        [DAR_MESHOPT_OCTAHEDRAL] = { 4, 8 },
        [DAR_MESHOPT_QUATERNION] = { 8, 8 },
    };
    if (f->mode == DAR_MESHOPT_ATTRIBUTES) {
        if (f->stride < 4 || f->stride > 256 || f->stride % 4) return "a byteStride of 4, 8, ... 256";
        if (f->filter == DAR_MESHOPT_OCTAHEDRAL || f->filter == DAR_MESHOPT_QUATERNION) {
            const size_t *s = filter_stride[f->filter];
            if (f->stride != s[0] && f->stride != s[1]) return "the byteStride of its filter";
        }
        return NULL;
    }
    if (f->filter != DAR_MESHOPT_NONE) return "no filter on indices";
    if (f->stride != 2 && f->stride != 4) return "a byteStride of 2 or 4";
    if (f->mode == DAR_MESHOPT_TRIANGLES && f->count % 3) return "a count of whole triangles";
    return NULL;
}

const char *dar_meshopt_decode(const dar_meshopt_form *f, const void *data, size_t size, void *out)
{
    int failed = f->mode == DAR_MESHOPT_ATTRIBUTES  ? meshopt_decodeVertexBuffer(out, f->count, f->stride, data, size)
                 : f->mode == DAR_MESHOPT_TRIANGLES ? meshopt_decodeIndexBuffer(out, f->count, f->stride, data, size)
                                                    : meshopt_decodeIndexSequence(out, f->count, f->stride, data, size);
    if (failed) return "meshopt data that its decoder can read";
    switch (f->filter) {
    case DAR_MESHOPT_OCTAHEDRAL: meshopt_decodeFilterOct(out, f->count, f->stride); break;
    case DAR_MESHOPT_QUATERNION: meshopt_decodeFilterQuat(out, f->count, f->stride); break;
    case DAR_MESHOPT_EXPONENTIAL: meshopt_decodeFilterExp(out, f->count, f->stride); break;
    case DAR_MESHOPT_NONE: break;
    }
    return NULL;
}
