/* deflate.c: packing, through zlib. */
#include "data/deflate.h"

#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <zlib.h>

#include "lib/thread.h"

#define LEVEL  1
#define PIECE  ((size_t)1 << 17) /* [bytes] */
#define HEADER 2
#define FOOTER 6 /* a last, empty block; the sum */

struct piece {
    size_t stream, begin, size, out_size;
    uLong sum;
    bool zero;
};

struct dar_deflate {
    z_stream *z; /* [threads] */
    int threads;
    unsigned char *zeros; /* a whole piece of zeros, deflated */
    size_t zeros_size;
    uLong zeros_sum;
    struct piece *piece; /* [most_pieces] */
    size_t most_pieces;
    size_t bound; /* of a deflated piece */
    dar_deflate_stream *stream;
};

static size_t pieces_of(size_t size)
{
    return (size + PIECE - 1) / PIECE;
}

/* Any data grows by less than 1 / 64 and some bytes: stored blocks of level 1 hold 16 KiB and more. */
static size_t piece_bound(void)
{
    return PIECE + PIECE / 64 + 64;
}

size_t dar_deflate_bound(size_t size)
{
    return HEADER + pieces_of(size) * piece_bound() + FOOTER;
}

/* One piece as blocks that end on a byte and are not the last. */
static size_t deflate_piece(z_stream *z, const unsigned char *data, size_t size, unsigned char *out, size_t room)
{
    deflateReset(z);
    z->next_in = (unsigned char *)(uintptr_t)data;
    z->avail_in = (uInt)size;
    z->next_out = out;
    z->avail_out = (uInt)room;
    int status = deflate(z, Z_SYNC_FLUSH);
    DAR_ASSERT(status == Z_OK && z->avail_in == 0 && z->avail_out > 0, "deflate: status %d, %u bytes left", status,
               z->avail_in);
    return room - z->avail_out;
}

static dar_status fill(dar_deflate *d, dar_err *e)
{
    d->threads = dar_threads();
    d->bound = piece_bound();
    d->z = calloc((size_t)d->threads, sizeof *d->z);
    d->zeros = malloc(d->bound);
    d->piece = calloc(d->most_pieces, sizeof *d->piece);
    unsigned char *nothing = calloc(1, PIECE);
    bool done = d->z && d->zeros && d->piece && nothing;
    for (int i = 0; i < d->threads && done; i++)
        done = deflateInit2(&d->z[i], LEVEL, Z_DEFLATED, -MAX_WBITS, MAX_MEM_LEVEL, Z_DEFAULT_STRATEGY) == Z_OK;
    if (done) {
        d->zeros_size = deflate_piece(&d->z[0], nothing, PIECE, d->zeros, d->bound);
        d->zeros_sum = adler32(1, nothing, PIECE);
    }
    free(nothing);
    return done ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "deflate: out of memory for %d threads", d->threads);
}

dar_status dar_deflate_new(dar_deflate **out, size_t most, dar_err *e)
{
    dar_deflate *d = *out = calloc(1, sizeof *d);
    if (!d) return dar_fail(e, DAR_ERR_NOMEM, "deflate: out of memory");
    d->most_pieces = pieces_of(most) + 64; /* a stream's last piece may be short */
    dar_status s = fill(d, e);
    if (s != DAR_OK) {
        dar_deflate_free(d);
        *out = NULL;
    }
    return s;
}

void dar_deflate_free(dar_deflate *d)
{
    if (!d) return;
    for (int i = 0; i < d->threads && d->z; i++) deflateEnd(&d->z[i]);
    free(d->z);
    free(d->zeros);
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
    unsigned char *out = s->out + HEADER + p->begin / PIECE * d->bound;
    const unsigned char *data = s->data + p->begin;
    p->zero = all_zero(data, p->size);
    if (p->zero && p->size == PIECE) {
        memcpy(out, d->zeros, d->zeros_size);
        p->out_size = d->zeros_size;
        p->sum = d->zeros_sum;
    } else {
        p->out_size = deflate_piece(&d->z[thread], data, p->size, out, d->bound);
        p->sum = adler32(1, data, (uInt)p->size);
    }
}

/* Move a stream's pieces together and close it. */
static void join(dar_deflate *d, dar_deflate_stream *s, const struct piece *p)
{
    static const unsigned char header[HEADER] = { 0x78, 0x01 }, last[2] = { 0x03, 0x00 };
    unsigned char *to = s->out;
    uLong sum = 1;
    memcpy(to, header, HEADER);
    to += HEADER;
    s->zero = true;
    for (size_t i = 0; i < pieces_of(s->size); i++) {
        memmove(to, s->out + HEADER + i * d->bound, p[i].out_size);
        to += p[i].out_size;
        sum = adler32_combine(sum, p[i].sum, (z_off_t)p[i].size);
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
        join(d, &stream[i], d->piece + first);
        first += pieces_of(stream[i].size);
    }
}
