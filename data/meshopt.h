/* meshopt.h: buffers packed by EXT_meshopt_compression, through libmeshoptimizer. */
#ifndef DAR_DATA_MESHOPT_H
#define DAR_DATA_MESHOPT_H

#include <stddef.h>

typedef enum dar_meshopt_mode { DAR_MESHOPT_ATTRIBUTES, DAR_MESHOPT_TRIANGLES, DAR_MESHOPT_INDICES } dar_meshopt_mode;
typedef enum dar_meshopt_filter {
    DAR_MESHOPT_NONE,
    DAR_MESHOPT_OCTAHEDRAL,
    DAR_MESHOPT_QUATERNION,
    DAR_MESHOPT_EXPONENTIAL
} dar_meshopt_filter;

typedef struct dar_meshopt_form {
    dar_meshopt_mode mode;
    dar_meshopt_filter filter;
    size_t count, stride; /* elements, bytes of one */
} dar_meshopt_form;

/* What is wrong with the form, or NULL: counts and strides that the decoder has not been written for. */
const char *dar_meshopt_check(const dar_meshopt_form *f);

/* Decode `size` bytes of data into out, count * stride bytes.  The form has been checked.  Returns NULL, or what is
 * wrong with the data. */
const char *dar_meshopt_decode(const dar_meshopt_form *f, const void *data, size_t size, void *out);

#endif
