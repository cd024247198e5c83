/* kern_attn.c: filling the table of attention kernels. */
#include "lib/kern_attn.h"

#include "lib/cpu.h"
#include "lib/status.h"

static dar_kern_attn table[DAR_TILE_KINDS];

void dar_kern_attn_init(unsigned cpu_flags)
{
    table[DAR_TILE_F64] = dar_kern_attn_ref_f64;
    table[DAR_TILE_F32] = dar_kern_attn_ref_f32;
    table[DAR_TILE_BF16] = dar_kern_attn_ref_bf16;
#if defined __x86_64__
    if (cpu_flags & DAR_CPU_AVX2) table[DAR_TILE_F32] = dar_kern_attn_f32_avx2;
    if (cpu_flags & DAR_CPU_AVX512) table[DAR_TILE_F32] = dar_kern_attn_f32_avx512;
    if (cpu_flags & DAR_CPU_BF16) table[DAR_TILE_BF16] = dar_kern_attn_bf16;
#else
    (void)cpu_flags;
#endif
}

const dar_kern_attn *dar_kern_attn_for(dar_tile_kind kind)
{
    dar_cpu_flags(); /* fills the tables at first use */
    DAR_ASSERT(kind == DAR_TILE_F64 || kind == DAR_TILE_F32 || kind == DAR_TILE_BF16,
               "attention: no weights for tile kind %d", (int)kind);
    return &table[kind];
}
