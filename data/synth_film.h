/* synth_film.h: a synthetic scene becomes a bundle, with pictures in its lights. */
#ifndef DAR_DATA_SYNTH_FILM_H
#define DAR_DATA_SYNTH_FILM_H

#include "data/render.h"
#include "data/synth.h"

/* What the scene is, in words: "dog walking, tree, crate; noon"; returns buf. */
char *dar_synth_words(const dar_synth *s, char *buf, size_t size);

/* Write a bundle of all families at path, whole or not at all; what was there is replaced. */
dar_status dar_synth_film(const dar_synth *s, const dar_synth_plan *plan, const char *set, const char *path,
                          dar_render_report *report, dar_err *e);

#endif
