/* groups.c: groups of tokens, and sums over them. */
#include "autograd/groups.h"

#include "lib/kern.h"
#include "lib/thread.h"

#define CHUNK_TOKENS   64   /* at least: partial sums are then 1/64 of the work */
#define CHUNK_ELEMENTS 8192 /* at least, of the work */

dar_groups dar_groups_of(size_t clips, size_t tokens, size_t rows, size_t split, size_t width)
{
    size_t chunk = CHUNK_ELEMENTS / (width ? width : 1);
    DAR_ASSERT(rows && (split || rows == 1), "groups: %zu rows, split %zu", rows, split);
    return (dar_groups){ clips, tokens, rows, split, chunk > CHUNK_TOKENS ? chunk : CHUNK_TOKENS, 0 };
}

size_t dar_group_of(const dar_groups *g, size_t token)
{
    size_t clip = token / g->tokens, r = g->rows == 1 ? 0 : (g->first + token % g->tokens) / g->split;
    return clip * g->rows + (r < g->rows ? r : g->rows - 1);
}

static size_t within(size_t i, size_t least, size_t most)
{
    return i < least ? least : i > most ? most : i;
}

/* Tokens [begin, end) of a clip that take row r. */
static void span(const dar_groups *g, size_t r, size_t *begin, size_t *end)
{
    size_t all = g->first + g->tokens, b = r * g->split, e = r + 1 < g->rows ? b + g->split : all;
    *begin = within(b, g->first, all) - g->first;
    *end = within(e, g->first, all) - g->first;
}

static size_t span_chunks(const dar_groups *g, size_t r)
{
    size_t begin, end;
    span(g, r, &begin, &end);
    return (end - begin + g->chunk - 1) / g->chunk;
}

/* Chunks of a clip before row r. */
static size_t chunks_before(const dar_groups *g, size_t r)
{
    size_t n = 0;
    for (size_t i = 0; i < r; i++) n += span_chunks(g, i);
    return n;
}

size_t dar_groups_chunks(const dar_groups *g)
{
    return g->clips * chunks_before(g, g->rows);
}

dar_chunk dar_groups_chunk(const dar_groups *g, size_t i)
{
    size_t per_clip = chunks_before(g, g->rows), clip = i / per_clip, r = 0, n, begin, end;
    i %= per_clip;
    for (; i >= (n = span_chunks(g, r)); r++) i -= n;
    span(g, r, &begin, &end);
    begin += i * g->chunk;
    if (end > begin + g->chunk) end = begin + g->chunk;
    return (dar_chunk){ clip * g->rows + r, clip * g->tokens + begin, clip * g->tokens + end };
}

/* ---------------------------------------------------------------- combination */

struct combine {
    const dar_groups *g;
    dar_dtype type;
    char *parts;
    size_t width, pieces; /* columns, and pieces of columns */
    const dar_tensor *dst;
    dar_put mode;
};

static void combine_piece(void *ctx, size_t i, int thread)
{
    const struct combine *c = ctx;
    const dar_kern *k = dar_kern_for(c->type);
    size_t size = dar_dtype_size(c->type), group = i / c->pieces, column = i % c->pieces * DAR_PIECE;
    size_t n = c->width - column < DAR_PIECE ? c->width - column : DAR_PIECE;
    size_t r = group % c->g->rows, count = span_chunks(c->g, r);
    size_t first = group / c->g->rows * chunks_before(c->g, c->g->rows) + chunks_before(c->g, r);
    static const double zeros[DAR_PIECE];
    (void)thread;
#define PART(j) (c->parts + ((first + (j)) * c->width + column) * size)
    for (size_t step = 1; step < count; step *= 2)
        for (size_t j = 0; j + step < count; j += 2 * step) k->add(n, PART(j), PART(j + step), PART(j));
    dar_row_put(c->type, count ? (const void *)PART(0) : zeros, c->dst->dtype,
                dar_tensor_at(c->dst, group * c->width + column), n, c->mode);
#undef PART
}

void dar_groups_combine(const dar_groups *g, dar_dtype c, void *parts, size_t width, const dar_tensor *dst, bool add)
{
    size_t pieces = (width + DAR_PIECE - 1) / DAR_PIECE;
    struct combine x = { g, c, parts, width, pieces, dst, add ? DAR_PUT_ADD : DAR_PUT };
    dar_parallel(g->clips * g->rows * pieces, combine_piece, &x);
}
