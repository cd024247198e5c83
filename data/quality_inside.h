/* quality_inside.h: what quality.c and quality_frame.c share. */
#ifndef DAR_DATA_QUALITY_INSIDE_H
#define DAR_DATA_QUALITY_INSIDE_H

#include "data/quality.h"
#include "lib/arena.h"

/* Sums over the pixels of a clip, channel by channel. */
typedef struct dar_quality_sums {
    size_t n;
    double sum[3], square[3];
} dar_quality_sums;

/* Of what bands of a picture find, in their order; see quality_frame.c. */
struct dar_quality_tally;

typedef struct dar_quality_run {
    dar_quality *q;
    dar_bundle *b;
    dar_err *e;
    dar_arena memory;
    size_t frame, pixels, bands;
    struct dar_quality_tally *tally; /* [bands] */

    /* Of the frame at hand. */
    uint8_t *cover;      /* [pixels] not 0: a surface */
    float *depth;        /* [pixels]; NULL: none in the bundle, as with the next two */
    uint32_t *id, *part; /* [pixels] */
    uint8_t *rgb[2];     /* [pixels, 3] frame and reference; NULL: none */

    /* Tracks, whole; NULL: none. */
    float *xy;
    uint8_t *visible, *color;
    size_t tracks_seen, tracks_right;
    size_t disordered; /* frames */

    /* Of the clip. */
    double size;         /* of the scene; 0: unknown */
    double lo[3], hi[3]; /* of positions */
    double depth_range[2];
    double slope_sum, slopes; /* of n . surface, and their number */
    size_t parts, side;       /* of the table of objects; 0: none */
    dar_quality_sums rgb_sums, sums[DAR_FAMILIES];
} dar_quality_run;

/* A value of a check: kept with its frame and reason if it is the worst so far; NaN is worse than all. */
void dar_quality_note(dar_quality_run *r, dar_quality_name name, double found, size_t frame, const char *reason, ...)
    __attribute__((format(printf, 5, 6)));

/* Largest standard deviation of the channels. */
double dar_quality_deviation(const dar_quality_sums *s, size_t channels);

/* Memory for frames.  In a planning arena: counts the bytes. */
void dar_quality_push(dar_quality_run *r, dar_arena *a);

/* Everything of one frame. */
dar_status dar_quality_frame(dar_quality_run *r, size_t frame);

#endif
