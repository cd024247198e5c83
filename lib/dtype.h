/* dtype.h: element types: what a tensor stores, and scalar conversions between them.  Rows are converted by kernels
 * (lib/kern.h).
 *
 * Arithmetic is f32 or f64; bf16, f16 and i8 are storage.  An i8 matrix stores rows q with one f32 scale per row:
 * value = q * scale, q in [-127, 127]. */
#ifndef DAR_LIB_DTYPE_H
#define DAR_LIB_DTYPE_H

#include <stddef.h>
#include <stdint.h>

typedef enum dar_dtype { DAR_F64, DAR_F32, DAR_BF16, DAR_F16, DAR_I8, DAR_DTYPES } dar_dtype;

size_t dar_dtype_size(dar_dtype t);      /* bytes per element */
const char *dar_dtype_name(dar_dtype t); /* "f64" "f32" "bf16" "f16" "i8" */

/* Round to nearest even; NaN stays NaN (quiet); overflow of f16 gives infinity. */
uint16_t dar_bf16_from_f32(float x);
float dar_bf16_to_f32(uint16_t h);
uint16_t dar_f16_from_f32(float x);
float dar_f16_to_f32(uint16_t h);

/* Element i of a row of any type but i8, read and written as double. */
double dar_dtype_get(dar_dtype t, const void *row, size_t i);
void dar_dtype_set(dar_dtype t, void *row, size_t i, double x);

#endif
