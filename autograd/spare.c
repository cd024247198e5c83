/* spare.c: best fit. */
#include "autograd/spare.h"

#include <string.h>

#define LARGE 64 /* a block this many times as large as what is wanted stays whole */

static size_t whole(size_t bytes)
{
    return dar_add_size(bytes, DAR_ALIGN - 1) & ~(size_t)(DAR_ALIGN - 1);
}

static void erase(dar_spare *s, int i)
{
    s->count--;
    memmove(s->block + i, s->block + i + 1, (size_t)(s->count - i) * sizeof *s->block);
}

void *dar_spare_take(dar_spare *s, dar_arena *a, size_t bytes)
{
    int best = -1, end = -1;

    bytes = whole(bytes);
    for (int i = 0; i < s->count; i++) {
        const dar_spare_block *b = &s->block[i];
        if (b->bytes >= bytes && b->bytes / LARGE <= bytes && (best < 0 || b->bytes < s->block[best].bytes)) best = i;
        if (a && !b->apart && b->at + b->bytes == a->base + a->used && b->bytes < bytes) end = i;
    }
    if (best < 0 && end < 0) return a ? dar_arena_push(a, bytes) : NULL;
    dar_spare_block *b = &s->block[best < 0 ? end : best];
    void *p = b->at;
    if (best < 0) { /* the last block, and some more behind it */
        dar_arena_push(a, bytes - b->bytes);
        b->bytes = bytes;
    }
    b->at += bytes;
    b->bytes -= bytes;
    if (!b->bytes) erase(s, (int)(b - s->block));
    return p;
}

static bool before(const dar_spare_block *a, const dar_spare_block *b)
{
    return a->apart != b->apart ? b->apart : a->at < b->at;
}

static bool touches(const dar_spare_block *a, const dar_spare_block *b)
{
    return a->apart == b->apart && a->at + a->bytes == b->at;
}

/* Make room for one more: the smallest goes, which may be the new one. */
static bool forget_smallest(dar_spare *s, size_t bytes)
{
    int least = 0;
    for (int i = 1; i < s->count; i++)
        if (s->block[i].bytes < s->block[least].bytes) least = i;
    if (s->block[least].bytes >= bytes) return false;
    erase(s, least);
    return true;
}

void dar_spare_give(dar_spare *s, void *at, size_t bytes, bool apart)
{
    dar_spare_block b = { at, whole(bytes), apart };
    int i = 0;

    if (!b.bytes) return;
    while (i < s->count && before(&s->block[i], &b)) i++;
    if (i > 0 && touches(&s->block[i - 1], &b)) {
        i--;
        b.at = s->block[i].at;
        b.bytes += s->block[i].bytes;
        erase(s, i);
    }
    if (i < s->count && touches(&b, &s->block[i])) {
        b.bytes += s->block[i].bytes;
        erase(s, i);
    }
    if (s->count == DAR_SPARES && !forget_smallest(s, b.bytes)) return;
    for (i = s->count; i > 0 && before(&b, &s->block[i - 1]); i--) s->block[i] = s->block[i - 1];
    s->block[i] = b;
    s->count++;
}
