/* bench_peak.c: what the machine can do at most: arithmetic on registers, and memory.
 *
 * The arithmetic loops are assembly, because a compiler spills or shortens them: twelve independent accumulators, two
 * operands, no memory. */
#include "tests/bench.h"

#include <string.h>
#include <time.h>

#include "lib/cpu.h"
#include "lib/status.h"
#include "lib/thread.h"

#define LOOPS       500000L
#define ACCUMULATE  24                 /* instructions per loop */
#define MEMORY_SIZE ((size_t)64 << 20) /* [bytes] of each array: more than the caches hold */

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* ---------------------------------------------------------------- arithmetic */

#if defined __x86_64__

#    define ONE(op, r, n) op " %%" r "14, %%" r "15, %%" r #    n "\n\t"
#    define SIX(op, r, a, b, c, d, e, f)                                                                               \
        ONE(op, r, a) ONE(op, r, b) ONE(op, r, c) ONE(op, r, d) ONE(op, r, e) ONE(op, r, f)
#    define TWELVE(op, r) SIX(op, r, 0, 1, 2, 3, 4, 5) SIX(op, r, 6, 7, 8, 9, 10, 11)
#    define ZERO(n)       "vpxor %%xmm" #    n ", %%xmm" #    n ", %%xmm" #    n "\n\t"

/* Small normal numbers in every lane, whatever their type. */
#    define LOOP(name, features, op, r)                                                                                \
        __attribute__((noinline, target(features))) static void name(void)                                             \
        {                                                                                                              \
            long n = LOOPS;                                                                                            \
            __asm__ volatile("vmovd %1, %%xmm15\n\t"                                                                   \
                             "vpbroadcastd %%xmm15, %%" r "14\n\t"                                                     \
                             "vpbroadcastd %%xmm15, %%" r "15\n\t" ZERO(0) ZERO(1) ZERO(2) ZERO(3) ZERO(4) ZERO(5)     \
                                 ZERO(6) ZERO(7) ZERO(8) ZERO(9) ZERO(10) ZERO(11) "1:\n\t" TWELVE(op, r)              \
                                     TWELVE(op, r) "dec %0\n\tjnz 1b\n\tvzeroupper\n\t"                                \
                             : "+r"(n)                                                                                 \
                             : "r"(0x3c013c01)                                                                         \
                             : "xmm0", "xmm1", "xmm2", "xmm3", "xmm4", "xmm5", "xmm6", "xmm7", "xmm8", "xmm9",         \
                               "xmm10", "xmm11", "xmm14", "xmm15", "cc");                                              \
        }

LOOP(fma_avx2, "avx2,fma", "vfmadd231ps", "ymm")
LOOP(fma_avx512, "avx2,avx512f", "vfmadd231ps", "zmm")
LOOP(dot_bf16, "avx2,avx512f,avx512bf16", "vdpbf16ps", "zmm")
LOOP(dot_vnni, "avx2,avx512f,avx512vnni", "vpdpbusd", "zmm")

#endif

/* Any processor: multiply and add as the compiler vectorises them. */
static void fma_plain(void)
{
    enum { LANES = 16, SUMS = 4 };
    static volatile float out;
    float sum[SUMS * LANES] = { 0 };
    volatile float seed = 0.0079f;
    float a = seed, b = seed;

    for (long n = 0; n < LOOPS; n++)
        for (int i = 0; i < SUMS * LANES; i++) sum[i] = sum[i] * a + b;
    for (int i = 0; i < SUMS * LANES; i++) out = sum[i];
    (void)out;
}

/* First of its peak whose instructions the CPU mask allows. */
static const struct arithmetic {
    bench_peak peak;
    unsigned cpu;
    void (*run)(void);
    double flop; /* per loop */
} loops[] = {
#if defined __x86_64__
    { BENCH_I8, DAR_CPU_VNNI, dot_vnni, ACCUMULATE * 64 * 2 },
    { BENCH_BF16, DAR_CPU_BF16, dot_bf16, ACCUMULATE * 32 * 2 },
    { BENCH_F32, DAR_CPU_AVX512, fma_avx512, ACCUMULATE * 16 * 2 },
    { BENCH_F32, DAR_CPU_AVX2, fma_avx2, ACCUMULATE * 8 * 2 },
#endif
    { BENCH_F32, 0, fma_plain, 4 * 16 * 2 },
};

static const struct arithmetic *find(bench_peak p)
{
    for (size_t i = 0; i < DAR_COUNT(loops); i++)
        if (loops[i].peak == p && (dar_cpu_flags() & loops[i].cpu) == loops[i].cpu) return &loops[i];
    return find(BENCH_F32);
}

static void run_loop(void *ctx, size_t i, int thread)
{
    (void)i;
    (void)thread;
    ((const struct arithmetic *)ctx)->run();
}

/* ---------------------------------------------------------------- memory */

static unsigned char *memory; /* two arrays */

static void copy(void *ctx, size_t begin, size_t end, int thread)
{
    (void)ctx;
    (void)thread;
    memcpy(memory + begin, memory + MEMORY_SIZE + begin, end - begin);
}

/* Eight independent sums, enough to keep the loads in flight. */
static void read(void *ctx, size_t begin, size_t end, int thread)
{
    const uint64_t *x = (const uint64_t *)(memory + begin), *last = (const uint64_t *)(memory + end);
    uint64_t sum[8] = { 0 };

    (void)ctx;
    (void)thread;
    for (; x + 8 <= last; x += 8)
        for (int k = 0; k < 8; k++) sum[k] += x[k];
    for (int k = 1; k < 8; k++) sum[0] += sum[k];
    __asm__ volatile("" : : "r"(sum[0])); /* used */
}

static void stream(void *ctx, size_t begin, size_t end, int thread)
{
    (void)ctx;
    (void)thread;
#if defined __x86_64__
    const long long *x = (const long long *)(memory + MEMORY_SIZE + begin);
    long long *y = (long long *)(memory + begin);
    for (size_t i = 0; i < (end - begin) / sizeof *x; i++) __builtin_ia32_movnti64(y + i, x[i]);
    __builtin_ia32_sfence();
#else
    memcpy(memory + begin, memory + MEMORY_SIZE + begin, end - begin);
#endif
}

/* ---------------------------------------------------------------- samples */

static const struct {
    const char *name;
    dar_range_task *move; /* NULL: arithmetic */
    double bytes;
} peaks[BENCH_PEAKS] = {
    [BENCH_F32] = { "f32", NULL, 0 },
    [BENCH_BF16] = { "bf16", NULL, 0 },
    [BENCH_I8] = { "i8", NULL, 0 },
    [BENCH_COPY] = { "copy", copy, 2.0 * (double)MEMORY_SIZE },
    [BENCH_READ] = { "read", read, (double)MEMORY_SIZE },
    [BENCH_STREAM] = { "stream", stream, 2.0 * (double)MEMORY_SIZE },
};

const char *bench_peak_name(bench_peak p)
{
    return peaks[p].name;
}

bool bench_peak_is_bytes(bench_peak p)
{
    return peaks[p].move != NULL;
}

double bench_peak_sample(bench_peak p)
{
    int threads = dar_threads();
    double begin, work;

    if (peaks[p].move) {
        if (!memory) {
            static dar_arena a;
            dar_err e;
            DAR_ASSERT(dar_arena_init(&a, "peak", 2 * MEMORY_SIZE, &e) == DAR_OK, "%s", e.text);
            memory = memset(dar_arena_push(&a, 2 * MEMORY_SIZE), 1, 2 * MEMORY_SIZE);
        }
        begin = now();
        dar_parallel_range(MEMORY_SIZE, MEMORY_SIZE / 64 / (size_t)threads * 64, peaks[p].move, NULL);
        work = peaks[p].bytes;
    } else {
        const struct arithmetic *l = find(p);
        begin = now();
        dar_parallel((size_t)threads, run_loop, (void *)l);
        work = l->flop * (double)LOOPS * threads;
    }
    return 1e-9 * work / (now() - begin);
}
