/* kern.c: filling the table of row kernels, and what moves rows between storage types. */
#include "lib/kern.h"

#include <math.h>
#include <stdatomic.h>
#include <string.h>

#include "lib/cpu.h"
#include "lib/kern_sets.h"
#include "lib/status.h"
#include "lib/thread.h"

static dar_kern f32, f64;

void dar_kern_init(unsigned cpu_flags)
{
    dar_kern_ref_f32(&f32); /* every slot filled first, then better ones over them */
    dar_kern_ref_f64(&f64);
    if (cpu_flags & DAR_CPU_AVX2) dar_kern_avx2(&f32);
    if (cpu_flags & DAR_CPU_AVX512) dar_kern_avx512(&f32);
    if (cpu_flags & DAR_CPU_BF16) dar_kern_bf16(&f32);
    for (int i = 0; i < 2; i++) {
        dar_kern *k = i ? &f64 : &f32;
        dar_kern_move_ref(k);
        if (cpu_flags & DAR_CPU_AVX2) dar_kern_move_avx2(k);
        if (cpu_flags & DAR_CPU_AVX512) dar_kern_move_avx512(k);
        dar_kern_random_ref(k);
        if (cpu_flags & DAR_CPU_AVX2) dar_kern_random_avx2(k);
        if (cpu_flags & DAR_CPU_AVX512) dar_kern_random_avx512(k);
    }
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

/* ---------------------------------------------------------------- storage */

/* What systems report as the last-level cache is the whole machine's: a slice of it is what a few cores can use. */
#define CACHED ((size_t)24 << 20)

dar_put dar_put_for(size_t bytes, bool add)
{
    return add ? DAR_PUT_ADD : bytes >= CACHED ? DAR_PUT_STREAM : DAR_PUT;
}

void dar_row_convert(dar_dtype dst_type, void *dst, dar_dtype src_type, const void *src, size_t n)
{
    size_t ds = dar_dtype_size(dst_type), ss = dar_dtype_size(src_type);
    float buf[DAR_PIECE];

    if (dst_type == src_type) {
        memcpy(dst, src, n * ds);
    } else if (dst_type == DAR_F64 || dst_type == DAR_F32) {
        dar_kern_for(dst_type)->get[src_type](n, src, dst);
    } else if (src_type == DAR_F64 || src_type == DAR_F32) {
        dar_kern_for(src_type)->put[dst_type](n, src, dst, false);
    } else {
        for (size_t i = 0; i < n; i += DAR_PIECE) {
            size_t m = n - i < DAR_PIECE ? n - i : DAR_PIECE;
            dar_kern_for(DAR_F32)->get[src_type](m, (const char *)src + i * ss, buf);
            dar_kern_for(DAR_F32)->put[dst_type](m, buf, (char *)dst + i * ds, false);
        }
    }
}

const void *dar_row_get(dar_dtype c, dar_dtype stored, const void *src, size_t n, void *buf)
{
    if (stored == c) return src;
    dar_kern_for(c)->get[stored](n, src, buf);
    return buf;
}

void *dar_row_out(dar_dtype c, dar_dtype stored, void *dst, dar_put mode, void *buf)
{
    return stored == c && mode == DAR_PUT ? dst : buf;
}

static void add_row(dar_dtype c, const void *x, dar_dtype stored, void *dst, size_t n)
{
    const dar_kern *k = dar_kern_for(c);
    size_t cs = dar_dtype_size(c), ss = dar_dtype_size(stored);
    double buf[DAR_PIECE];

    for (size_t i = 0; i < n; i += DAR_PIECE) {
        size_t m = n - i < DAR_PIECE ? n - i : DAR_PIECE;
        void *to = (char *)dst + i * ss, *sum = stored == c ? to : (void *)buf;
        k->add(m, dar_row_get(c, stored, to, m, buf), (const char *)x + i * cs, sum);
        if (sum != to) k->put[stored](m, sum, to, false);
    }
}

void dar_row_put(dar_dtype c, const void *x, dar_dtype stored, void *dst, size_t n, dar_put mode)
{
    if (mode == DAR_PUT_ADD) add_row(c, x, stored, dst, n);
    else if (x != dst) dar_kern_for(c)->put[stored](n, x, dst, mode == DAR_PUT_STREAM);
}

/* ---------------------------------------------------------------- whole rows */

float dar_row_scale(dar_dtype stored, const void *x, size_t n)
{
    double most = dar_kern_for(dar_compute_type(stored))->max_abs[stored](n, x);
    float scale = isfinite(most) ? (float)(most / 127) : NAN;
    return scale < 0x1p-126f ? 0 : scale; /* its inverse may be no number */
}

float dar_row_quantise(dar_dtype stored, const void *x, size_t n, int8_t *q)
{
    float scale = dar_row_scale(stored, x, n);
    dar_kern_for(dar_compute_type(stored))->quantise[stored](n, x, scale, 0, q);
    return scale;
}

struct adamw {
    const dar_adamw *a;
    dar_dtype c, moments;
    char *w, *m, *v, *g;
};

/* n moments x of f32 as bf16, rounded by one half of as many random numbers. */
static void put_moments(const struct adamw *p, size_t i, size_t n, const float *m, const float *v)
{
    const dar_kern *k = dar_kern_for(DAR_F32);
    uint32_t random[DAR_PIECE];
    k->philox((n + 3) / 4, p->a->seed, p->a->stream, p->a->index / 4 + i / 4, random);
    k->dither(n, random, 0, m, (uint16_t *)(void *)p->m + i);
    k->dither(n, random, 1, v, (uint16_t *)(void *)p->v + i);
}

static void adamw_range(void *ctx, size_t begin, size_t end, int thread)
{
    const struct adamw *p = ctx;
    const dar_kern *k = dar_kern_for(p->c);
    size_t size = dar_dtype_size(p->c), stored = dar_dtype_size(p->moments);
    bool random = p->c == DAR_F32 && p->moments == DAR_BF16;
    double mbuf[DAR_PIECE], vbuf[DAR_PIECE];
    (void)thread;
    for (size_t i = begin; i < end; i += DAR_PIECE) {
        size_t n = end - i < DAR_PIECE ? end - i : DAR_PIECE;
        void *m_at = p->m + i * stored, *v_at = p->v + i * stored;
        void *m = dar_row_out(p->c, p->moments, m_at, DAR_PUT, mbuf);
        void *v = dar_row_out(p->c, p->moments, v_at, DAR_PUT, vbuf);
        dar_row_get(p->c, p->moments, m_at, n, m);
        dar_row_get(p->c, p->moments, v_at, n, v);
        k->adamw(n, p->a, p->w + i * size, m, v, p->g + i * size);
        memset(p->g + i * size, 0, n * size);
        if (random) {
            put_moments(p, i, n, m, v);
            continue;
        }
        dar_row_put(p->c, m, p->moments, m_at, n, DAR_PUT);
        dar_row_put(p->c, v, p->moments, v_at, n, DAR_PUT);
    }
}

void dar_row_adamw(const dar_adamw *a, dar_dtype c, dar_dtype moments, size_t n, void *w, void *m, void *v, void *g)
{
    struct adamw p = { a, c, moments, w, m, v, g };
    DAR_ASSERT(a->index % 4 == 0, "adamw: random numbers from %llu on", (unsigned long long)a->index);
    dar_parallel_range(n, 16 * DAR_PIECE, adamw_range, &p);
}

struct scan {
    dar_dtype type;
    const char *x;
    _Atomic int64_t first; /* INT64_MAX: none yet */
};

static void scan_range(void *ctx, size_t begin, size_t end, int thread)
{
    struct scan *s = ctx;
    dar_dtype c = dar_compute_type(s->type);
    double buf[DAR_PIECE];
    (void)thread;
    for (size_t i = begin; i < end && (int64_t)i < s->first; i += DAR_PIECE) {
        size_t m = end - i < DAR_PIECE ? end - i : DAR_PIECE;
        const void *x = dar_row_get(c, s->type, s->x + i * dar_dtype_size(s->type), m, buf);
        ptrdiff_t at = dar_kern_for(c)->nonfinite(m, x);
        if (at < 0) continue;
        int64_t found = (int64_t)i + at, first = s->first;
        while (found < first && !atomic_compare_exchange_weak(&s->first, &first, found)) continue;
        return;
    }
}

int64_t dar_row_nonfinite(dar_dtype t, const void *x, size_t n)
{
    struct scan s = { .type = t, .x = x, .first = INT64_MAX };
    dar_parallel_range(n, 64 * DAR_PIECE, scan_range, &s);
    return s.first == INT64_MAX ? -1 : s.first;
}
