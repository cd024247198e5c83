/* kern.c: filling the table of row kernels, and what moves rows between storage types. */
#include "lib/kern.h"

#include <math.h>
#include <string.h>

#include "lib/cpu.h"
#include "lib/kern_sets.h"
#include "lib/status.h"
#include "lib/thread.h"

static dar_kern f32, f64;

void dar_kern_init(unsigned cpu_flags)
{
    (void)cpu_flags;
    dar_kern_ref_f32(&f32); /* every slot filled first, then better ones over them */
    dar_kern_ref_f64(&f64);
}

const dar_kern *dar_kern_for(dar_dtype t)
{
    dar_cpu_flags(); /* fills the tables at first use */
    DAR_ASSERT(t == DAR_F32 || t == DAR_F64, "kernels: no arithmetic in %s", dar_dtype_name(t));
    return t == DAR_F64 ? &f64 : &f32;
}

dar_dtype dar_compute_type(dar_dtype storage)
{
    return storage == DAR_F64 ? DAR_F64 : DAR_F32;
}

void dar_row_convert(dar_dtype dst_type, void *dst, dar_dtype src_type, const void *src, size_t n)
{
    if (dst_type == src_type) {
        memcpy(dst, src, n * dar_dtype_size(dst_type));
        return;
    }
    for (size_t i = 0; i < n; i++) dar_dtype_set(dst_type, dst, i, dar_dtype_get(src_type, src, i));
}

const void *dar_row_get(dar_dtype c, dar_dtype stored, const void *src, size_t n, void *buf)
{
    if (stored == c) return src;
    dar_row_convert(c, buf, stored, src, n);
    return buf;
}

void dar_row_put(dar_dtype c, const void *x, dar_dtype stored, void *dst, size_t n, bool add)
{
    if (!add) {
        if (x != dst) dar_row_convert(stored, dst, c, x, n);
        return;
    }
    for (size_t i = 0; i < n; i++)
        dar_dtype_set(stored, dst, i, dar_dtype_get(stored, dst, i) + dar_dtype_get(c, x, i));
}

int64_t dar_row_nonfinite(dar_dtype t, const void *x, size_t n)
{
    for (size_t i = 0; i < n; i++)
        if (!isfinite(dar_dtype_get(t, x, i))) return (int64_t)i;
    return -1;
}
