/* kern_avx512.c: the row kernels in vectors of 16. */
#include "lib/kern_sets.h"

#include <math.h>
#include <string.h>

#if defined __AVX512F__ && defined __AVX512BW__ && defined __AVX512VL__ && defined __AVX512DQ__
#    include "lib/kern_avx512.inc"

#    define NAME(x)  x##_avx512
#    define SET_NAME "avx512"

#    define v_to_bf16 v_rounded

#    include "lib/kern_simd.inc"
#else
void dar_kern_avx512(dar_kern *k)
{
    (void)k;
}
#endif
