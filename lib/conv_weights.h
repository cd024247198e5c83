/* conv_weights.h: room for the gradient by weights.  Part of lib/conv.h. */
#ifndef DAR_LIB_CONV_WEIGHTS_H
#define DAR_LIB_CONV_WEIGHTS_H

#include "lib/conv.h"

/* Bytes of scratch of dar_conv_back_w. */
size_t dar_conv_weights_scratch(const dar_conv *c, dar_dtype x, dar_dtype w, int threads);

#endif
