/* kern_ref.c: the reference kernels, one text compiled for float and for double. */
#include "lib/kern_sets.h"

#include <math.h>

#define REAL    float
#define FN(x)   x##f
#define NAME(x) x##_f32
#include "lib/kern_ref.inc"
#undef REAL
#undef FN
#undef NAME

#define REAL    double
#define FN(x)   x
#define NAME(x) x##_f64
#include "lib/kern_ref.inc"
