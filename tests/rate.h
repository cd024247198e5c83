/* rate.h: what the programs that time whole networks say: seconds, rate against the machine's peak, memory. */
#ifndef DAR_TESTS_RATE_H
#define DAR_TESTS_RATE_H

#include "lib/arena.h"
#include "lib/program.h"

/* Options of all of them, and where they go. */
#define RATE_OPTIONS(model, frames, many, size)                                                                        \
    { .name = "model",                                                                                                 \
      .placeholder = "FILE",                                                                                           \
      .type = DAR_ARG_TEXT,                                                                                            \
      .target = (model),                                                                                               \
      .standard = "models/presets/wan22-fun-5b.json",                                                                  \
      .help = "sizes" },                                                                                               \
        { .name = "frames",                                                                                            \
          .placeholder = "T",                                                                                          \
          .type = DAR_ARG_INT,                                                                                         \
          .target = (frames),                                                                                          \
          .standard = (many),                                                                                          \
          .lo = 1,                                                                                                     \
          .hi = 4097,                                                                                                  \
          .help = "of the video, 4 n + 1" },                                                                           \
    {                                                                                                                  \
        .name = "size", .placeholder = "WxH", .type = DAR_ARG_SIZE, .target = (size), .standard = "832x480", .lo = 32, \
        .hi = 8192, .help = "of the video"                                                                             \
    }

double rate_seconds(void); /* of a clock that only goes forward */

/* What products of bf16 reach on all threads [FLOP/s]: median of a few tries. */
double rate_peak(void);

/* "what  seconds  TFLOP  GF/s, fraction of the peak `most`" */
void rate_say(const dar_run *r, const char *what, double seconds, double flops, double most);

/* Tell the planned peak of n arenas, put them in bytes, return their sum. */
double rate_planned(const dar_run *r, const dar_arena *a, int n, size_t *bytes);

double rate_taken(void); /* most memory the program ever had [byte] */

#endif
