/* deflate.c: packing, through ISA-L. */
#include "data/deflate.h"

#include <isa-l/igzip_lib.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "lib/cpu.h"
#include "lib/thread.h"

#define LEVEL  1
#define PIECE  ((size_t)1 << 17) /* [bytes] */
#define HEADER 2
#define FOOTER 6     /* a last, empty block; the sum */
#define BASE   65521 /* of the sum */

struct piece {
    size_t stream, begin, size, out_size;
    uint32_t sum;
    bool zero;
};

/* What a thread works with. */
struct worker {
    struct isal_zstream z;
    uint8_t scratch[ISAL_DEF_LVL1_DEFAULT];
};

struct dar_deflate {
    struct worker *worker; /* [threads] */
    int threads;
    struct piece *piece; /* [most_pieces] */
    size_t most_pieces;
    dar_deflate_stream *stream;
};

static size_t pieces_of(size_t size)
{
    return (size + PIECE - 1) / PIECE;
}

/* Of a deflated piece: what does not shrink is stored, in blocks of up to 64 KiB with a header each. */
static size_t piece_bound(void)
{
    return PIECE + PIECE / 64 + 64;
}

size_t dar_deflate_bound(size_t size)
{
    return HEADER + pieces_of(size) * piece_bound() + FOOTER;
}

/* One piece as blocks that end on a byte and are not the last. */
static size_t deflate_piece(struct worker *w, const unsigned char *data, size_t size, unsigned char *out)
{
    struct isal_zstream *z = &w->z;
    isal_deflate_stateless_init(z);
    z->level = LEVEL;
    z->level_buf = w->scratch;
    z->level_buf_size = sizeof w->scratch;
    z->flush = FULL_FLUSH;
    z->next_in = (unsigned char *)(uintptr_t)data;
    z->avail_in = (uint32_t)size;
    z->next_out = out;
    z->avail_out = (uint32_t)piece_bound();
    int status = isal_deflate_stateless(z);
    DAR_ASSERT(status == COMP_OK && z->avail_in == 0, "deflate: status %d, %u bytes left", status, z->avail_in);
    return z->total_out;
}

dar_status dar_deflate_new(dar_deflate **out, size_t most, dar_err *e)
{
    dar_deflate *d = *out = calloc(1, sizeof *d);
    if (!d) return dar_fail(e, DAR_ERR_NOMEM, "deflate: out of memory");
    d->most_pieces = pieces_of(most) + 64; /* a stream's last piece may be short */
    d->threads = dar_threads();
    d->worker = calloc((size_t)d->threads, sizeof *d->worker);
    d->piece = calloc(d->most_pieces, sizeof *d->piece);
    if (d->worker && d->piece) return DAR_OK;
    dar_deflate_free(d);
    *out = NULL;
    return dar_fail(e, DAR_ERR_NOMEM, "deflate: out of memory for %d threads", dar_threads());
}

void dar_deflate_free(dar_deflate *d)
{
    if (!d) return;
    free(d->worker);
    free(d->piece);
    free(d);
}

static bool all_zero(const unsigned char *x, size_t n)
{
    return n == 0 || (x[0] == 0 && memcmp(x, x + 1, n - 1) == 0);
}

static void run_piece(void *ctx, size_t i, int thread)
{
    dar_deflate *d = ctx;
    struct piece *p = &d->piece[i];
    const dar_deflate_stream *s = &d->stream[p->stream];
    const unsigned char *data = s->data + p->begin;
    p->zero = all_zero(data, p->size);
    p->out_size = deflate_piece(&d->worker[thread], data, p->size, s->out + HEADER + p->begin / PIECE * piece_bound());
    p->sum = isal_adler32(1, data, p->size);
    dar_cpu_settle();
}

/* The sum of two runs of bytes, the second of that size, from theirs.  Source: RFC 1950, section 9: the low half is 1
 * plus the bytes, the high half the sum of the low half after each of them. */
static uint32_t join_sums(uint32_t a, uint32_t b, size_t size)
{
    uint64_t before = (a & 0xffff) + BASE - 1, low = (before + (b & 0xffff)) % BASE;
    uint64_t high = (a >> 16) + (b >> 16) + before % BASE * (size % BASE);
    return (uint32_t)(high % BASE << 16 | low);
}

/* Move a stream's pieces together and close it. */
static void join(dar_deflate_stream *s, const struct piece *p)
{
    static const unsigned char header[HEADER] = { 0x78, 0x01 }, last[2] = { 0x03, 0x00 };
    unsigned char *to = s->out;
    uint32_t sum = 1;
    memcpy(to, header, HEADER);
    to += HEADER;
    s->zero = true;
    for (size_t i = 0; i < pieces_of(s->size); i++) {
        memmove(to, s->out + HEADER + i * piece_bound(), p[i].out_size);
        to += p[i].out_size;
        sum = join_sums(sum, p[i].sum, p[i].size);
        s->zero = s->zero && p[i].zero;
    }
    memcpy(to, last, sizeof last);
    for (int k = 0; k < 4; k++) to[2 + k] = (unsigned char)(sum >> (24 - 8 * k));
    s->out_size = (size_t)(to - s->out) + FOOTER;
}

void dar_deflate_run(dar_deflate *d, dar_deflate_stream *stream, size_t n)
{
    size_t pieces = 0, first = 0;
    DAR_ASSERT(dar_threads() <= d->threads, "deflate: %d threads, made for %d", dar_threads(), d->threads);
    for (size_t i = 0; i < n; i++)
        for (size_t begin = 0; begin < stream[i].size; begin += PIECE) {
            size_t left = stream[i].size - begin;
            DAR_ASSERT(pieces < d->most_pieces, "deflate: more than %zu pieces", d->most_pieces);
            d->piece[pieces++] = (struct piece){ .stream = i, .begin = begin, .size = left < PIECE ? left : PIECE };
        }
    d->stream = stream;
    dar_parallel(pieces, run_piece, d);
    for (size_t i = 0; i < n; i++) {
        if (!stream[i].out) continue;
        join(&stream[i], d->piece + first);
        first += pieces_of(stream[i].size);
    }
}
