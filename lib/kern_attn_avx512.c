/* kern_attn_avx512.c: attention kernels for f32 tiles, in vectors of 16. */
#include "lib/kern_attn_avx512.inc"

typedef float operand;

#define put(p, a, b) (v_store(p, a), v_store((p) + LANES, b))

#include "lib/kern_attn_simd.inc"

const dar_kern_attn dar_kern_attn_f32_avx512 = { "avx512", soft, grad };
