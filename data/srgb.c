/* srgb.c: tables; a guess from the square root of the light is at most a few values too low. */
#include "data/srgb.h"

#include <math.h>

static double light_of(double value)
{
    double s = value / 255;
    return s <= 0.04045 ? s / 12.92 : pow((s + 0.055) / 1.055, 2.4);
}

void dar_srgb_init(dar_srgb *s)
{
    for (int v = 0; v < 256; v++) {
        s->linear[v] = (float)light_of(v);
        s->least[v] = v ? (float)light_of(v - 0.5) : -INFINITY;
    }
    s->least[256] = INFINITY;
    for (int i = 0, v = 0; i < DAR_SRGB_GUESSES; i++) {
        float light = (float)i / DAR_SRGB_GUESSES * ((float)i / DAR_SRGB_GUESSES);
        while (light >= s->least[v + 1]) v++;
        s->guess[i] = (uint8_t)v;
    }
}

uint8_t dar_srgb_of(const dar_srgb *s, float light)
{
    if (!(light > 0)) return 0;
    if (light >= 1) return 255;
    int v = s->guess[(int)(sqrtf(light) * (DAR_SRGB_GUESSES - 1))];
    while (light >= s->least[v + 1]) v++;
    return (uint8_t)v;
}
