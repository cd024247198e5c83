/* render.h: an animated scene under a camera path becomes a bundle, frame by frame.
 *
 *     dar_render r = { .clip = ..., .cameras = &path, .raster = dar_raster_default(w, h), ... };
 *     DAR_TRY(dar_clip_survey(&r.clip, box, &r.meta.world, e));
 *     DAR_TRY(dar_render_bundle(&r, "out/robot", &report, e));
 *
 * Memory is planned and does not grow with the number of frames, but for the tracks: 9 bytes per point and frame. */
#ifndef DAR_DATA_RENDER_H
#define DAR_DATA_RENDER_H

#include "data/bundle.h"
#include "data/clip.h"
#include "data/raster.h"
#include "data/shade.h"

typedef struct dar_render {
    dar_clip clip;
    const dar_camera_path *cameras; /* of clip.frames, of the raster's size */
    dar_raster_config raster;
    dar_bundle_options bundle; /* families, rgb */
    dar_bundle_meta meta;      /* world, box and what is known of the origin; the rest is filled in */
    size_t tracks;             /* points wanted */
    int track_side;            /* of their squares in the map [px], odd */

    /* If bundle.rgb: pictures are made as this says, with the raster's size, faces and blend_cutoff, and shadows fall
     * within meta.world; NULL: they are asked for. */
    const dar_shade_config *shade;

    /* The picture of a frame, [H, W, 3], if bundle.rgb; each frame once, in order. */
    dar_status (*picture)(void *ctx, size_t frame, uint8_t *rgb, dar_err *e);
    const uint8_t *reference; /* [H, W, 3] of a bundle without rgb; NULL: none */

    /* Called after every frame; anything but DAR_OK ends the work.  NULL: nobody waits. */
    dar_status (*step)(void *ctx, size_t done, dar_err *e);
    void *ctx; /* of both */
} dar_render;

typedef enum dar_render_stage {
    DAR_RENDER_DRAW,    /* pose and raster; their parts: report.raster */
    DAR_RENDER_TRACKS,  /* follow points, draw their map */
    DAR_RENDER_PICTURE, /* read what the person gave, or shade; its parts: report.shade */
    DAR_RENDER_WRITE,   /* encode, deflate, write */
    DAR_RENDER_STAGES
} dar_render_stage;
extern const char *const dar_render_stage_name[];

typedef struct dar_render_report {
    double seconds[DAR_RENDER_STAGES];
    dar_raster_stats raster;
    double shade[DAR_SHADE_STAGES]; /* [s] */
    size_t tracks;                  /* points found */
    size_t memory;                  /* [bytes] planned */
} dar_render_report;

/* Write the bundle, whole or not at all. */
dar_status dar_render_bundle(const dar_render *r, const char *path, dar_render_report *report, dar_err *e);

/* Draw `frames` frames, spread over the clip, and write nothing: how long drawing takes, and the memory. */
dar_status dar_render_try(const dar_render *r, size_t frames, dar_render_report *report, dar_err *e);

#endif
