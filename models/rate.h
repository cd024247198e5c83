/* rate.h: how fast this machine multiplies, for estimates of time. */
#ifndef DAR_MODELS_RATE_H
#define DAR_MODELS_RATE_H

#include "lib/dtype.h"

/* Products in this storage type in a second [FLOP], tried for a moment. */
double dar_rate(dar_dtype storage);

#endif
