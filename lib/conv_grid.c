/* conv_grid.c: see conv_grid.h. */
#include "lib/conv_grid.h"

#include "lib/conv_clip.h"
#include "lib/size.h"

/* Zeros after a row, or a column, are those before the next one, and enough for the last output pixels. */
static size_t shared(size_t in, size_t out, size_t kernel, int64_t before)
{
    size_t first = before > 0 ? (size_t)before : 0;
    int64_t end = (int64_t)(out + kernel) - 1 - before;
    return dar_most(dar_most(in + first, out), end > 0 ? (size_t)end : 0);
}

dar_conv_grid dar_conv_grid_of(const dar_conv *c)
{
    dar_conv_grid g = { .stride = c->stride, c->H, c->W, c->Ho, c->Wo, c->top, c->left };
    g.tall = dar_least(c->stride, c->kh);
    g.wide = dar_least(c->stride, c->kw);
    g.phases = g.tall * g.wide;
    g.kh = dar_blocks(c->kh, c->stride);
    g.kw = dar_blocks(c->kw, c->stride);
    g.pitch = c->stride > 1 ? c->Wo + g.kw - 1 : shared(c->W, c->Wo, c->kw, c->left);
    g.frame = g.pitch * (c->stride > 1 ? c->Ho + g.kh - 1 : shared(c->H, c->Ho, c->kh, c->top));
    g.plane = c->Ho && c->Wo ? (c->Ho - 1) * g.pitch + c->Wo : 0;
    g.around = (g.kh - 1) * g.pitch + g.kw - 1;
    return g;
}

size_t dar_conv_grid_phase(const dar_conv_grid *g, size_t y, size_t x)
{
    return y % g->stride * g->wide + x % g->stride;
}

size_t dar_conv_grid_place(const dar_conv_grid *g, size_t y, size_t x)
{
    return y / g->stride * g->pitch + x / g->stride;
}

/* n elements from place `at` of a line of H rows of W. */
static void fill(size_t H, size_t W, size_t pitch, dar_dtype type, char *dst, const char *frame, int64_t at, size_t n)
{
    size_t size = dar_dtype_size(type), before = at < 0 ? dar_least((size_t)-at, n) : 0;

    if (W == pitch) W *= H, pitch = W, H = 1;
    dar_clip_zero(dst, before, size);
    dst += before * size;
    n -= before;
    size_t p = at < 0 ? 0 : (size_t)at, h = pitch ? p / pitch : H, w = pitch ? p % pitch : 0;
    for (; n && h < H; h++, w = 0) {
        size_t copy = w < W ? dar_least(W - w, n) : 0, gap = dar_least(pitch - w - copy, n - copy);
        if (copy) memcpy(dst, frame + (h * W + w) * size, copy * size);
        dar_clip_zero(dst + copy * size, gap, size);
        dst += (copy + gap) * size;
        n -= copy + gap;
    }
    dar_clip_zero(dst, n, size);
}

/* n elements, `step` apart in src. */
static void take(size_t size, size_t n, const void *src, size_t step, void *dst)
{
#define TAKE(T)                                                                                                        \
    if (step == 2)                                                                                                     \
        for (size_t i = 0; i < n; i++) ((T *)dst)[i] = ((const T *)src)[2 * i];                                        \
    else                                                                                                               \
        for (size_t i = 0; i < n; i++) ((T *)dst)[i] = ((const T *)src)[i * step]
    if (size == 2) TAKE(uint16_t);
    else if (size == 4) TAKE(uint32_t);
    else TAKE(uint64_t);
#undef TAKE
}

/* Row h, column w of a phase are row h S + y, column w S + x of the frame; a row begins with what the first output
 * column reads. */
static void fill_phase(const dar_conv_grid *g, dar_dtype type, char *dst, const char *frame, size_t phase, size_t at,
                       size_t n)
{
    size_t size = dar_dtype_size(type), S = g->stride;
    int64_t y = (int64_t)(phase / g->wide + at / g->pitch * S) - g->top, x = (int64_t)(phase % g->wide) - g->left;
    size_t first = x < 0 ? dar_blocks((size_t)-x, S) : 0;
    size_t last = (int64_t)g->W > x ? dar_blocks((size_t)((int64_t)g->W - x), S) : 0;

    for (size_t w = at % g->pitch; n; y += (int64_t)S, w = 0) {
        size_t end = dar_least(g->pitch, w + n), low = dar_least(dar_most(w, first), end);
        size_t high = dar_most(dar_least(last, end), low);
        if (y < 0 || y >= (int64_t)g->H) low = high = end;
        dar_clip_zero(dst, low - w, size);
        if (high > low)
            take(size, high - low, frame + (y * (int64_t)g->W + (int64_t)(low * S) + x) * (int64_t)size, S,
                 dst + (low - w) * size);
        dar_clip_zero(dst + (high - w) * size, end - high, size);
        dst += (end - w) * size;
        n -= end - w;
    }
}

void dar_conv_grid_read(const dar_conv_grid *g, size_t phase, dar_dtype type, char *dst, const char *frame, size_t q,
                        size_t n)
{
    if (g->stride > 1) fill_phase(g, type, dst, frame, phase, q, n);
    else fill(g->H, g->W, g->pitch, type, dst, frame, (int64_t)q - g->left - g->top * (int64_t)g->pitch, n);
}

void dar_conv_grid_spread(const dar_conv_grid *g, dar_dtype type, char *dst, const char *frame, size_t q, size_t n)
{
    fill(g->Ho, g->Wo, g->pitch, type, dst, frame, (int64_t)q, n);
}
