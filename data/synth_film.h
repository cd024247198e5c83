/* synth_film.h: a synthetic scene becomes a bundle, with pictures in its lights. */
#ifndef DAR_DATA_SYNTH_FILM_H
#define DAR_DATA_SYNTH_FILM_H

#include "data/render.h"
#include "data/shade.h"
#include "data/synth.h"

typedef struct dar_film_report {
    dar_render_report render;
    double shade[DAR_SHADE_STAGES]; /* [s] */
    size_t memory;                  /* [bytes] for shading, beside the renderer's */
} dar_film_report;

/* What the scene is, in words: "a dog and a tree, noon"; returns buf. */
char *dar_synth_words(const dar_synth *s, char *buf, size_t size);

/* Write the bundle of `set` at path, whole or not at all; what was there is replaced. */
dar_status dar_synth_film(const dar_synth *s, const dar_synth_plan *plan, const char *set, const char *path,
                          dar_film_report *report, dar_err *e);

#endif
