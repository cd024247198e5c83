/* kern.h: the table of row kernels, and row conversions.
 *
 * A row kernel works on n consecutive elements of one arithmetic type, f32 or f64.  The reference text
 * (lib/kern_ref.inc) fills every slot for both types; faster kernels replace f32 slots according to the processor.
 * Storage types come in and go out through dar_row_get and dar_row_put, a piece of a row at a time, so that every op
 * works on every storage type and mixes them freely. */
#ifndef DAR_LIB_KERN_H
#define DAR_LIB_KERN_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/dtype.h"

/* Pointers are to rows of the table's type.  y may equal x.  "_back": gx = (add ? gx : 0) + derivative * gy. */
typedef struct dar_kern {
    const char *name; /* of the fastest set used: "ref", "avx2", "avx512" */

    void (*silu)(size_t n, const void *x, void *y);
    void (*silu_back)(size_t n, const void *x, const void *gy, void *gx, bool add);
} dar_kern;

/* The table for arithmetic in t: DAR_F32 or DAR_F64. */
const dar_kern *dar_kern_for(dar_dtype t);

/* Arithmetic type of a storage type: f64 for f64, f32 for the rest. */
dar_dtype dar_compute_type(dar_dtype storage);

/* Elements per piece: what dar_row_get buffers should hold.  A piece of every operand fits the first-level cache. */
#define DAR_PIECE 1024

/* n elements at src as arithmetic type c (f32 or f64): src itself if it is stored so, else converted into buf. */
const void *dar_row_get(dar_dtype c, dar_dtype stored, const void *src, size_t n, void *buf);

/* Store n elements x of arithmetic type c at dst; add: to what is there.  Does nothing if dst == x and !add. */
void dar_row_put(dar_dtype c, const void *x, dar_dtype stored, void *dst, size_t n, bool add);

/* Convert n elements; any pair of f64, f32, bf16, f16. */
void dar_row_convert(dar_dtype dst_type, void *dst, dar_dtype src_type, const void *src, size_t n);

/* Index of the first NaN or Inf of n elements, or -1.  Runs on all threads. */
int64_t dar_row_nonfinite(dar_dtype t, const void *x, size_t n);

/* Fill the tables for a set of DAR_CPU_ flags; called by dar_cpu_init. */
void dar_kern_init(unsigned cpu_flags);

#endif
