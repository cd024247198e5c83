/* kern_attn_ref.c: the reference attention kernels, one text compiled for each kind of tile. */
#include "lib/kern_attn.h"

#include <math.h>
#include <stdint.h>

#define REAL    double
#define FN(x)   x
#define OPERAND double
#define PUT(x)  (x)
#define UNIT    1
#define NAME(x) x##_f64
#include "lib/kern_attn_ref.inc"

#define REAL    float
#define FN(x)   x##f
#define OPERAND float
#define PUT(x)  (x)
#define UNIT    1
#define NAME(x) x##_f32
#include "lib/kern_attn_ref.inc"

#define REAL    float
#define FN(x)   x##f
#define OPERAND uint16_t
#define PUT(x)  dar_bf16_from_f32(x)
#define UNIT    2
#define NAME(x) x##_bf16
#include "lib/kern_attn_ref.inc"
