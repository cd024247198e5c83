/* deflate.c: packing, through libdeflate. */
#include "data/deflate.h"

#include <libdeflate.h>
#include <stdlib.h>
#include <string.h>

#include "lib/thread.h"

#define LEVEL 1

struct dar_deflate {
    struct libdeflate_compressor **worker; /* [threads] */
    int threads;
    dar_deflate_stream *stream; /* of the present run */
};

size_t dar_deflate_bound(size_t size)
{
    return libdeflate_zlib_compress_bound(NULL, size);
}

dar_status dar_deflate_new(dar_deflate **out, dar_err *e)
{
    dar_deflate *d = *out = calloc(1, sizeof *d);
    if (!d) return dar_fail(e, DAR_ERR_NOMEM, "deflate: out of memory");
    d->threads = dar_threads();
    d->worker = calloc((size_t)d->threads, sizeof(struct libdeflate_compressor *));
    bool made = d->worker;
    for (int i = 0; made && i < d->threads; i++) made = (d->worker[i] = libdeflate_alloc_compressor(LEVEL));
    if (made) return DAR_OK;
    dar_deflate_free(d);
    *out = NULL;
    return dar_fail(e, DAR_ERR_NOMEM, "deflate: out of memory for %d threads", dar_threads());
}

void dar_deflate_free(dar_deflate *d)
{
    if (!d) return;
    for (int i = 0; d->worker && i < d->threads; i++) libdeflate_free_compressor(d->worker[i]);
    free(d->worker);
    free(d);
}

static bool all_zero(const unsigned char *x, size_t n)
{
    return n == 0 || (x[0] == 0 && memcmp(x, x + 1, n - 1) == 0);
}

static void run_stream(void *ctx, size_t i, int thread)
{
    const dar_deflate *d = ctx;
    dar_deflate_stream *s = &d->stream[i];
    if (!s->out) return;
    size_t room = dar_deflate_bound(s->size);
    s->zero = all_zero(s->data, s->size);
    s->out_size = libdeflate_zlib_compress(d->worker[thread], s->data, s->size, s->out, room);
    DAR_ASSERT(s->out_size > 0, "deflate: %zu bytes did not fit %zu", s->size, room);
}

void dar_deflate_run(dar_deflate *d, dar_deflate_stream *stream, size_t n)
{
    DAR_ASSERT(dar_threads() <= d->threads, "deflate: %d threads, made for %d", dar_threads(), d->threads);
    d->stream = stream;
    dar_parallel(n, run_stream, d);
}
