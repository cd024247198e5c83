/* synth_film.c: what a scene tells the renderer. */
#include "data/synth_film.h"

#include <stdio.h>

#define TRACKS     1024
#define TRACK_SIDE 3 /* [px] */

char *dar_synth_words(const dar_synth *s, char *buf, size_t size)
{
    size_t n = 0;
    for (size_t i = 0; i < s->things && n < size; i++) {
        const dar_synth_thing *x = &s->thing[i];
        bool goes = x->motion == DAR_PLACE_WALK;
        n += (size_t)snprintf(buf + n, size - n, "%s%s%s", i ? ", " : "", x->kind->name,
                              !goes                             ? ""
                              : x->asset.way == DAR_ASSET_FLIES ? " flying"
                                                                : " walking");
    }
    if (n < size) snprintf(buf + n, size - n, "; %s", s->lights);
    return buf;
}

dar_status dar_synth_film(const dar_synth *s, const dar_synth_plan *plan, const char *set, const char *path,
                          dar_render_report *report, dar_err *e)
{
    char words[512], source[128];
    dar_shade_config shade = dar_shade_default(plan->width, plan->height);
    dar_render r = {
        .clip = s->clip,
        .cameras = &s->cameras,
        .raster = dar_raster_default(plan->width, plan->height),
        .bundle = dar_bundle_standard(),
        .tracks = TRACKS,
        .track_side = TRACK_SIDE,
        .shade = &shade,
    };
    shade.lighting = s->lighting;
    r.bundle.families = (1u << DAR_BUNDLE_FAMILIES) - 1;
    r.bundle.rgb = r.bundle.overwrite = true;
    snprintf(source, sizeof source, "synthetic/%s/%s/%s", set, s->thing[0].kind->family, s->thing[0].kind->name);
    r.meta = (dar_bundle_meta){
        .unit = 1,
        .world = s->world,
        .box = s->box,
        .boxes = plan->frames,
        .source = source,
        .licence = "CC0-1.0",
        .generator = "dar-bundle synth",
        .trajectory = s->path.kind->name,
        .prompt = dar_synth_words(s, words, sizeof words),
        .seed = plan->seed,
    };
    return dar_render_bundle(&r, path, report, e);
}
