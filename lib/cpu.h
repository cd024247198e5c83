/* cpu.h: what the processor can do, and what the user lets us use (--cpu-mask). */
#ifndef DAR_LIB_CPU_H
#define DAR_LIB_CPU_H

#include "lib/status.h"

enum {
    DAR_CPU_AVX2 = 1,   /* AVX2, FMA, F16C */
    DAR_CPU_AVX512 = 2, /* AVX-512 F, BW, VL, DQ */
    DAR_CPU_BF16 = 4,   /* AVX-512 BF16: products of bf16 pairs */
    DAR_CPU_VNNI = 8,   /* AVX-512 VNNI: products of 8-bit quads */
    DAR_CPU_ALL = 15,
};

/* What this processor and operating system offer; each level only together with those it is built on. */
unsigned dar_cpu_detect(void);

/* Fill the kernel tables for `flags` (a subset of dar_cpu_detect(); more is cut off).  Called once by main, and by
 * tests for each level; programs that never call it get every detected level at first use. */
void dar_cpu_init(unsigned flags);

/* The flags in force. */
unsigned dar_cpu_flags(void);

/* "none", "avx2", "avx512", "bf16", "vnni" or "all", or several joined by '+', into flags.  A level brings those it is
 * built on. */
dar_status dar_cpu_parse(const char *text, unsigned *flags, dar_err *e);

#endif
