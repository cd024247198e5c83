/* arena.c: bump allocation over one mapping. */
#include "lib/arena.h"

#include <errno.h>
#include <stdint.h>
#include <string.h>
#include <sys/mman.h>

#define HUGE_PAGE ((size_t)2 << 20)
#define PLAN_SIZE ((size_t)1 << 42) /* address space, not memory: there is room for some thirty of them */

static dar_status map(dar_arena *a, const char *name, size_t bytes, int prot, dar_err *e)
{
    memset(a, 0, sizeof *a);
    a->name = name;
    if (bytes > SIZE_MAX - HUGE_PAGE) return dar_fail(e, DAR_ERR_NOMEM, "%s: %zu bytes asked for", name, bytes);
    bytes = bytes ? (bytes + HUGE_PAGE - 1) & ~(HUGE_PAGE - 1) : HUGE_PAGE;

    /* One huge page more, so that the base can sit on a huge-page boundary. */
    void *p = mmap(NULL, bytes + HUGE_PAGE, prot, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    if (p == MAP_FAILED)
        return dar_fail(e, DAR_ERR_NOMEM, "%s: cannot reserve %.1f MiB: %s", name, (double)bytes / (1 << 20),
                        strerror(errno));
    uintptr_t lo = (uintptr_t)p, base = (lo + HUGE_PAGE - 1) & ~(uintptr_t)(HUGE_PAGE - 1);
    if (base > lo) munmap(p, base - lo);
    if (lo + HUGE_PAGE > base) munmap((void *)(base + bytes), lo + HUGE_PAGE - base);
    a->base = (unsigned char *)base;
    a->size = bytes;
    return DAR_OK;
}

dar_status dar_arena_init(dar_arena *a, const char *name, size_t bytes, dar_err *e)
{
    DAR_TRY(map(a, name, bytes, PROT_READ | PROT_WRITE, e));
    madvise(a->base, a->size, MADV_HUGEPAGE); /* a wish: without it pages are small and slower */
    return DAR_OK;
}

dar_status dar_arena_init_plan(dar_arena *a, const char *name, dar_err *e)
{
    DAR_TRY(map(a, name, PLAN_SIZE, PROT_NONE, e));
    a->plan = true;
    return DAR_OK;
}

void dar_arena_free(dar_arena *a)
{
    if (a->base) munmap(a->base, a->size);
    memset(a, 0, sizeof *a);
}

void *dar_arena_push(dar_arena *a, size_t bytes)
{
    size_t step = dar_add_size(bytes, DAR_ALIGN - 1) & ~(size_t)(DAR_ALIGN - 1);
    DAR_ASSERT(step <= a->size - a->used, "%s arena: %zu bytes wanted, %zu of %zu in use", a->name, bytes, a->used,
               a->size);
    void *p = a->base + a->used;
    a->used += step;
    if (a->used > a->peak) a->peak = a->used;
    return p;
}

dar_mark dar_arena_mark(const dar_arena *a)
{
    return a->used;
}

void dar_arena_reset(dar_arena *a, dar_mark m)
{
    DAR_ASSERT(m <= a->used, "%s arena: reset to %zu, in use %zu", a->name, m, a->used);
    a->used = m;
}

size_t dar_mul_size(size_t a, size_t b)
{
    size_t r;
    DAR_ASSERT(!__builtin_mul_overflow(a, b, &r), "size overflow: %zu x %zu", a, b);
    return r;
}

size_t dar_add_size(size_t a, size_t b)
{
    size_t r;
    DAR_ASSERT(!__builtin_add_overflow(a, b, &r), "size overflow: %zu + %zu", a, b);
    return r;
}
