/* srgb.h: display values of 8 bits and the linear light that they stand for.
 *
 *     linear = s / 12.92 if s <= 0.04045, else ((s + 0.055) / 1.055)^2.4,   s = value / 255
 *
 * Source: IEC 61966-2-1. */
#ifndef DAR_DATA_SRGB_H
#define DAR_DATA_SRGB_H

#include <stdint.h>

#define DAR_SRGB_GUESSES 4096

typedef struct dar_srgb {
    float linear[256];               /* of each value */
    float least[257];                /* smallest light that rounds to the value; the last is infinite */
    uint8_t guess[DAR_SRGB_GUESSES]; /* value at sqrt(light) = i / DAR_SRGB_GUESSES */
} dar_srgb;

void dar_srgb_init(dar_srgb *s);

/* The value nearest to a light, on the scale of values; 0 below 0 and for NaN, 255 from 1 on. */
uint8_t dar_srgb_of(const dar_srgb *s, float light);

#endif
