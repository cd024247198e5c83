/* world.c: bounds, and the map they define. */
#include "data/world.h"

#include <math.h>

#include "lib/thread.h"

#define MARGIN (1.0 / 256)
#define CHUNK  65536 /* pixels of a task */

void dar_world_init(dar_world *w)
{
    *w = (dar_world){ .size = 1 };
    for (int c = 0; c < 3; c++) w->lo[c] = INFINITY, w->hi[c] = -INFINITY;
}

void dar_world_add(dar_world *w, const float *position, size_t n)
{
    for (size_t i = 0; i < n; i++)
        for (int c = 0; c < 3; c++) {
            double x = position[3 * i + (size_t)c];
            w->lo[c] = x < w->lo[c] ? x : w->lo[c];
            w->hi[c] = x > w->hi[c] ? x : w->hi[c];
        }
}

void dar_world_finish(dar_world *w)
{
    double side = 0;
    for (int c = 0; c < 3; c++) {
        bool some = w->lo[c] <= w->hi[c];
        w->centre[c] = some ? (w->lo[c] + w->hi[c]) / 2 : 0;
        if (some) side = fmax(side, w->hi[c] - w->lo[c]);
    }
    w->size = side > 0 ? side / (1 - 2 * MARGIN) : 1;
}

struct job {
    const dar_world *w;
    const float *x;
    const unsigned char *mask;
    size_t pixels;
    float *q;
};

static void normalise(void *ctx, size_t begin, size_t end, int thread)
{
    const struct job *j = ctx;
    (void)thread;
    for (size_t c = 0; c < 3; c++)
        for (size_t i = begin; i < end; i++) {
            size_t at = c * j->pixels + i;
            j->q[at] = j->mask[i] ? (float)(0.5 + (j->x[at] - j->w->centre[c]) / j->w->size) : 0;
        }
}

void dar_world_normalise(const dar_world *w, const float *x, const unsigned char *mask, size_t pixels, float *q)
{
    struct job j = { w, x, mask, pixels, q };
    dar_parallel_range(pixels, CHUNK, normalise, &j);
}
