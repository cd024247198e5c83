/* ulp.c: exp, tanh, rsqrt and silu at all 2^32 arguments and every CPU level.  ulp [STEP]: every STEP-th bit pattern.
 * Fails where a function is further off than kern.h says. */
#include "tests/ulp.h"

#include <stdio.h>
#include <stdlib.h>

#include "lib/thread.h"

#define CHUNK  ((uint64_t)1 << 20)
#define CHUNKS 4096

static ulp_tables tables;
static uint32_t step = 1;
static ulp_worst worst[CHUNKS][ULP_LEVELS][ULP_FUNCTIONS];

static void scan(void *ctx, size_t i, int thread)
{
    (void)ctx, (void)thread;
    uint64_t begin = (i * CHUNK + step - 1) / step, end = ((i + 1) * CHUNK + step - 1) / step;
    ulp_scan(&tables, (uint32_t)(begin * step), step, (size_t)(end - begin), worst[i]);
}

int main(int argc, char **argv)
{
    bool failed = false;
    if (argc > 1) step = (uint32_t)strtoul(argv[1], NULL, 10);
    if (!step) return 2;
    ulp_tables_init(&tables);
    dar_parallel(CHUNKS, scan, NULL);
    for (int k = 1; k < tables.n; k++)
        for (int f = 0; f < ULP_FUNCTIONS; f++) {
            ulp_worst w = { 0 };
            for (size_t i = 0; i < CHUNKS; i++)
                if (worst[i][k][f].error > w.error) w = worst[i][k][f];
            float x;
            memcpy(&x, &w.at, sizeof x);
            printf("%-7s %-6s %.3f ulp at %.9g (%08x)\n", tables.f32[k].name, ulp_name(f), w.error, (double)x, w.at);
            failed |= !(w.error <= ulp_bound(f));
        }
    return failed;
}
