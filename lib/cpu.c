/* cpu.c: detection, mask, and the one call that fills every kernel table. */
#include "lib/cpu.h"

#include <pthread.h>
#include <string.h>

#include "lib/kern.h"
#include "lib/kern_attn.h"
#include "lib/tile.h"

static unsigned in_force;
static pthread_once_t once = PTHREAD_ONCE_INIT;

/* A level is kept only if what it stands on is kept: AVX2 <- AVX-512 <- BF16, VNNI. */
static unsigned close_down(unsigned f)
{
    if (!(f & DAR_CPU_AVX2)) return 0;
    if (!(f & DAR_CPU_AVX512)) return f & DAR_CPU_AVX2;
    return f & DAR_CPU_ALL;
}

unsigned dar_cpu_detect(void)
{
    unsigned f = 0;
#if defined __x86_64__
    __builtin_cpu_init();
    if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) f |= DAR_CPU_AVX2;
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl") &&
        __builtin_cpu_supports("avx512dq"))
        f |= DAR_CPU_AVX512;
    if (__builtin_cpu_supports("avx512bf16")) f |= DAR_CPU_BF16;
    if (__builtin_cpu_supports("avx512vnni")) f |= DAR_CPU_VNNI;
#endif
    return close_down(f);
}

static void fill(unsigned flags)
{
    in_force = close_down(flags & dar_cpu_detect());
    dar_kern_init(in_force);
    dar_tile_init(in_force);
    dar_kern_attn_init(in_force);
}

static void fill_all(void)
{
    fill(DAR_CPU_ALL);
}

void dar_cpu_init(unsigned flags)
{
    pthread_once(&once, fill_all); /* so that a later first use does not undo the choice */
    fill(flags);
}

unsigned dar_cpu_flags(void)
{
    pthread_once(&once, fill_all);
    return in_force;
}

dar_status dar_cpu_parse(const char *text, unsigned *flags, dar_err *e)
{
    static const struct {
        const char *name;
        unsigned flags;
    } level[] = {
        { "none", 0 },
        { "avx2", DAR_CPU_AVX2 },
        { "avx512", DAR_CPU_AVX2 | DAR_CPU_AVX512 },
        { "bf16", DAR_CPU_AVX2 | DAR_CPU_AVX512 | DAR_CPU_BF16 },
        { "vnni", DAR_CPU_AVX2 | DAR_CPU_AVX512 | DAR_CPU_VNNI },
        { "all", DAR_CPU_ALL },
    };
    *flags = 0;
    for (const char *p = text;;) {
        size_t n = strcspn(p, "+"), i = 0;
        while (i < DAR_COUNT(level) && (strlen(level[i].name) != n || memcmp(level[i].name, p, n) != 0)) i++;
        if (i == DAR_COUNT(level))
            return dar_fail(e, DAR_ERR_USAGE, "--cpu-mask: '%.*s', expected none, avx2, avx512, bf16, vnni or all",
                            (int)n, p);
        *flags |= level[i].flags;
        if (!p[n]) return DAR_OK;
        p += n + 1;
    }
}
