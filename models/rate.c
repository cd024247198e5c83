/* rate.c: see rate.h. */
#include "models/rate.h"

#include <math.h>

#include "autograd/ops.h"
#include "lib/log.h"

double dar_rate(dar_dtype storage)
{
    enum { ROWS = 512, WIDTH = 1024, TRIED = 3 };
    dar_arena a;
    dar_tape t;
    double best = 0;
    if (dar_arena_init(&a, "trial", (size_t)64 << 20, NULL) != DAR_OK) return 0;
    if (dar_tape_init(&t, &a, NULL) == DAR_OK) {
        t.recording = false;
        dar_val *x = dar_input(&t, storage, DAR_SHAPE(ROWS, WIDTH)),
                *w = dar_input(&t, storage, DAR_SHAPE(WIDTH, WIDTH));
        for (int i = 0; i < TRIED; i++) {
            dar_tape_place begin = dar_tape_mark(&t);
            double before = t.cost.forward, clock = dar_log_clock();
            dar_linear(&t, x, w, NULL, NULL);
            best = fmax(best, (t.cost.forward - before) / (dar_log_clock() - clock));
            dar_tape_reset(&t, begin);
        }
    }
    dar_tape_free(&t);
    dar_arena_free(&a);
    return best;
}
