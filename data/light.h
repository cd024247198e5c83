/* light.h: what lights a scene, and what is seen where it has no surface.
 *
 * Colours are linear.  A light's colour is the radiance of a white matte surface that faces it; a sky's is its own
 * radiance, which is also what the background shows.  So a matte surface of colour c and normal n shows
 *
 *     c (sum over lights: color max(0, n . l) visible  +  sky_light (1/pi) integral of sky(w) max(0, n . w) dw)
 *
 * and the picture is srgb(shoulder(exposure x)), shoulder(x) = x below 0.7, from there on rising towards 1. */
#ifndef DAR_DATA_LIGHT_H
#define DAR_DATA_LIGHT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"

#define DAR_LIGHTS_MOST 4 /* suns; bulbs */

typedef struct dar_sun {
    double toward[3]; /* from the scene to it, unit */
    double color[3];
    bool shadow;
} dar_sun;

/* Casts no shadow. */
typedef struct dar_bulb {
    double at[3]; /* in the world */
    double color[3];
    double reach; /* > 0: where color holds; the light falls off as 1 / (0.1 + 0.9 (distance / reach)^2) */
} dar_bulb;

/* What is added to the gradient of a sky. */
typedef enum dar_sky_kind {
    DAR_SKY_GRADIENT, /* nothing */
    DAR_SKY_CLOUDS,   /* above the horizon */
    DAR_SKY_HILLS,    /* two rows in front of it */
    DAR_SKY_PANELS,   /* upright bands of light, as in a studio */
} dar_sky_kind;
extern const char *const dar_sky_name[]; /* "gradient", "clouds", "hills", "panels", NULL */

/* Infinitely far away; its directions are those of the world. */
typedef struct dar_sky {
    dar_sky_kind kind;
    double zenith[3], horizon[3], ground[3]; /* radiance straight up, level, straight down */
    double haze;                             /* > 0: sine of the angle below the level at which the ground begins */
    double glow[3], glow_toward[3];          /* added around a direction, unit */
    double glow_size;                        /* > 0: half of it is left at this angle [rad] */
    double detail[3];                        /* radiance of clouds, hills, panels */
    uint64_t seed;                           /* of their places */
} dar_sky;

typedef struct dar_lighting {
    dar_sun sun[DAR_LIGHTS_MOST];
    size_t suns;
    dar_bulb bulb[DAR_LIGHTS_MOST];
    size_t bulbs;
    dar_sky sky;
    double sky_light; /* share of the sky's radiance that lights surfaces */
    double occlusion; /* share of it that is lost on what faces up and lies below something */
    double up[3];     /* unit */
    double softness;  /* width of the edges of shadows, share of the scene's size */
    double exposure;
} dar_lighting;

/* Lightings that have a name; y is up.  The first is the standard one. */
typedef struct dar_lighting_kind {
    const char *name, *help;
    dar_lighting lighting;
} dar_lighting_kind;
extern const dar_lighting_kind dar_lighting_kinds[];
extern const size_t dar_lighting_count;

/* Fails, with the nearest name, for names that are not there. */
dar_status dar_lighting_find(const char *name, size_t *kind, dar_err *e);

/* A copy of row `kind`, with z up if so. */
dar_lighting dar_lighting_of(size_t kind, bool z_up);

/* Turn all directions from y up to z up. */
void dar_lighting_z_up(dar_lighting *l);

/* With y up: move the first sun, and the sky's glow with it.  Azimuth from z towards x, height above the level, [rad].
 * What a lighting with z up needs is done afterwards. */
void dar_lighting_aim(dar_lighting *l, double azimuth, double height);

/* ---------------------------------------------------------------- prepared */

#define DAR_LIGHT_LATTICE 32 /* side of the table of noise */

/* A sky made ready: its light on surfaces in nine harmonics, and the random numbers of its detail. */
typedef struct dar_skylight {
    dar_sky sky;
    float up[3], east[3], north[3]; /* axes of azimuth */
    float glow_width;               /* 1 - cos of the angle at which the glow is half, over sqrt(2) - 1 */
    float harmonic[9][3];
    float noise[DAR_LIGHT_LATTICE][DAR_LIGHT_LATTICE];
} dar_skylight;

void dar_skylight_init(dar_skylight *s, const dar_lighting *l);

/* Radiance from direction d, unit: with all detail; without it. */
void dar_skylight_at(const dar_skylight *s, const float d[3], float y[3]);
void dar_skylight_smooth(const dar_skylight *s, const float d[3], float y[3]);

/* Light of the whole sky on a white matte surface with normal n, times sky_light.
 * Source: Ramamoorthi and Hanrahan 2001, "An efficient representation for irradiance environment maps", eq. 13. */
void dar_skylight_on(const dar_skylight *s, const float n[3], float y[3]);

#endif
