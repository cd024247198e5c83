/* speed_bundle.c: how fast a scene becomes a bundle, all families, and what the time is spent on.
 *
 *     speed_bundle [SCENE.glb [animation [width height frames [folder]]]]
 *
 * Three cameras on an orbit: the scene fills the picture, as it comes, far away.  The last bundle stays in
 * `folder`, build unless given. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/bundle.h"
#include "data/clip.h"
#include "data/tracks.h"
#include "lib/log.h"
#include "lib/thread.h"
#include "tests/made.h"

#define TRACKS 1024

static const char *const stages[DAR_BUNDLE_STAGES] = { "encode", "deflate", "write", "pictures", "finish" };

typedef struct tracking {
    dar_surface_point point[TRACKS];
    float *xy, depth[TRACKS];
    uint8_t *visible, color[3 * TRACKS], *map;
    size_t n;
} tracking;

static void follow(tracking *k, drawn *d, size_t t, size_t frames)
{
    if (t == 0) {
        k->n = dar_tracks_pick(&d->raster, TRACKS, false, k->point, &d->arena);
        dar_tracks_color(&d->raster, k->point, k->n, k->color);
    }
    dar_tracks_follow(&d->raster, k->point, k->n, t, frames, k->xy, k->visible, k->depth);
    dar_tracks_map(&d->raster, k->n, t, frames, k->xy, k->visible, k->depth, k->color, 3, k->map, &d->arena);
}

static dar_camera_path orbit(const dar_clip *c, const dar_world *w, int width, int height, double distance)
{
    dar_camera_path p;
    double size = w->size;
    dar_camera_init(&p, c->frames, NULL);
    for (size_t t = 0; t < c->frames; t++) {
        double turn = 1.0 * (double)t / (double)c->frames;
        const double eye[3] = { w->centre[0] + distance * size * sin(turn), w->centre[1] + 0.2 * distance * size,
                                w->centre[2] + distance * size * cos(turn) };
        p.view[t] = made_view(width, height, eye, w->centre);
        p.view[t].near = 0.01 * size;
    }
    return p;
}

static dar_status run(dar_clip *c, const char *path, int width, int height, double distance, dar_err *e)
{
    size_t pixels = (size_t)width * (size_t)height, T = c->frames;
    dar_box *box = calloc(T, sizeof *box);
    tracking k = { .xy = calloc(TRACKS * T, 8), .visible = calloc(TRACKS, T), .map = calloc(pixels, 3) };
    dar_bundle_options o = dar_bundle_standard();
    dar_bundle_meta m = { .frames = T, .width = width, .height = height, .fps = c->fps, .box = box, .boxes = T };
    dar_raster_config config = dar_raster_default(width, height);
    dar_bundle_writer *w;
    drawn d;
    double begin = dar_log_clock(), drawing = 0;

    DAR_TRY(dar_clip_survey(c, box, &m.world, e));
    dar_camera_path cameras = orbit(c, &m.world, width, height, distance);
    drawn_init(&d, (dar_scene *)(uintptr_t)c->scene, &config);
    double survey = dar_log_clock() - begin;
    o.overwrite = true;
    o.families |= 1u << DAR_FAMILY_SPARSE;
    DAR_TRY(dar_bundle_create(&w, path, &m, &cameras, &o, e));
    for (size_t t = 0; t < T; t++) {
        double mark = dar_log_clock();
        drawn_at(&d, c->animation, dar_clip_time(c, t), &cameras.view[t]);
        follow(&k, &d, t, T);
        drawing += dar_log_clock() - mark;
        const dar_bundle_frame f = { .g = d.g, .sparse = k.map };
        DAR_TRY(dar_bundle_add(w, &f, e));
    }
    DAR_TRY(dar_bundle_add_tracks(w, k.n, k.xy, k.visible, k.color, e));
    DAR_TRY(dar_bundle_commit(w, e));
    double total = dar_log_clock() - begin;
    const dar_bundle_stats *n = dar_bundle_written(w);
    printf("distance %4.2f  %5.1f frames/s  %6.0f KB a frame, %zu of %zu chunks empty\n ", distance, (double)T / total,
           (double)n->bytes / (double)T / 1e3, n->empty, n->empty + n->chunks);
    printf(" survey %.1f %%  draw %.1f %%", 100 * survey / total, 100 * drawing / total);
    for (int i = 0; i < DAR_BUNDLE_STAGES; i++) printf("  %s %.1f %%", stages[i], 100 * n->seconds[i] / total);
    printf("\n");
    dar_bundle_discard(w);
    dar_camera_free(&cameras);
    dar_arena_free(&d.arena);
    free(box), free(k.xy), free(k.visible), free(k.map);
    return DAR_OK;
}

int main(int argc, char **argv)
{
    const char *path = argc > 1 ? argv[1] : "../shared/assets/robot.glb", *folder = argc > 6 ? argv[6] : "build";
    int width = argc > 5 ? (int)strtol(argv[3], NULL, 10) : 832;
    int height = argc > 5 ? (int)strtol(argv[4], NULL, 10) : 480;
    static const double distance[] = { 0.6, 1.3, 2.7 };
    dar_clip c = { .frames = argc > 5 ? strtoul(argv[5], NULL, 10) : 81, .fps = 24 };
    char bundle[512];
    dar_scene s;
    dar_err e;

    dar_status status = dar_clip_load(&s, path, c.fps, &e);
    c.scene = &s;
    if (status == DAR_OK) status = dar_scene_find_animation(&s, argc > 2 ? argv[2] : "", &c.animation, &e);
    if (status == DAR_OK) printf("%s, %d x %d, %zu frames, %d threads\n", path, width, height, c.frames, dar_threads());
    snprintf(bundle, sizeof bundle, "%s/speed", folder);
    for (size_t i = 0; i < DAR_COUNT(distance) && status == DAR_OK; i++)
        status = run(&c, bundle, width, height, distance[i], &e);
    if (status != DAR_OK) fprintf(stderr, "%s\n", e.text);
    dar_scene_free(&s);
    return dar_status_exit(status);
}
