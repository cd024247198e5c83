/* nearest.h: "did you mean": the known word that is closest to a mistyped one. */
#ifndef DAR_LIB_NEAREST_H
#define DAR_LIB_NEAREST_H

#include <stddef.h>

typedef struct dar_nearest {
    const char *word; /* the mistyped one */
    const char *best; /* closest candidate so far; NULL: none is close enough to be meant */
    size_t distance;  /* of best; candidates must be below it */
} dar_nearest;

dar_nearest dar_nearest_to(const char *word);

/* Offer a known word; it must outlive n. */
void dar_nearest_try(dar_nearest *n, const char *candidate);

/* Letters to insert, delete, replace or swap with their neighbour to get from a to b.  Words over 64 bytes: SIZE_MAX.
 * Source: Damerau 1964, restricted to one edit per place. */
size_t dar_nearest_distance(const char *a, const char *b);

#endif
