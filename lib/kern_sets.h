/* kern_sets.h: the sets of kernels that fill the tables; included by the files that define or choose them. */
#ifndef DAR_LIB_KERN_SETS_H
#define DAR_LIB_KERN_SETS_H

#include "lib/kern.h"

void dar_kern_ref_f32(dar_kern *k); /* fills every slot */
void dar_kern_ref_f64(dar_kern *k);

#endif
