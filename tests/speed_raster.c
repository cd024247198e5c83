/* speed_raster.c: how fast G-buffers are drawn, and what the time is spent on.
 *
 *     speed_raster [SCENE.glb [animation [width height frames]]]
 *
 * Three clips of the scene in memory, all families: the camera as it comes, on an orbit; so near that the scene fills
 * the picture; so far that 90 % of the tiles are empty. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/gltf.h"
#include "data/tracks.h"
#include "lib/thread.h"
#include "tests/made.h"

static const char *const stages[DAR_STAGES] = {
    "pose", "transform", "cull", "bin", "cover", "resolve", "fill", "copy"
};

static double clip(dar_scene *s, int animation, int width, int height, int frames, double distance)
{
    dar_raster_config c = dar_raster_default(width, height);
    double begin = 0, length = 0, lo[3] = { 1e30, 1e30, 1e30 }, hi[3] = { -1e30, -1e30, -1e30 }, total = 0;
    drawn d;

    drawn_init(&d, s, &c);
    dar_pose_at(&d.pose, DAR_NONE, 0, NULL);
    dar_pose_vertices(&d.pose, d.raster.position, NULL, false);
    for (size_t i = 0; i < 3 * s->vertices; i++) {
        lo[i % 3] = fmin(lo[i % 3], d.raster.position[i]);
        hi[i % 3] = fmax(hi[i % 3], d.raster.position[i]);
    }
    double at[3], size = fmax(hi[0] - lo[0], fmax(hi[1] - lo[1], hi[2] - lo[2]));
    for (int k = 0; k < 3; k++) at[k] = (lo[k] + hi[k]) / 2;
    if (animation != DAR_NONE) {
        begin = s->animation[animation].begin;
        length = s->animation[animation].end - begin;
    }
    for (int f = 0; f < frames; f++) {
        double turn = 1.0 * f / frames;
        const double eye[3] = { at[0] + distance * size * sin(turn), at[1] + 0.2 * distance * size,
                                at[2] + distance * size * cos(turn) };
        dar_view v = made_view(width, height, eye, at);
        v.near = 0.01 * size;
        drawn_at(&d, animation, begin + length * f / frames, &v);
    }
    const dar_raster_stats *n = &d.raster.stats;
    for (int k = 0; k < DAR_STAGES; k++) total += n->seconds[k];
    printf(
        "distance %4.2f  %6.1f frames/s  %5.2f ms  empty tiles %4.1f %%  drawn %zu of %zu triangles, %.2f tiles each\n",
        distance, frames / total, 1e3 * total / frames, 100.0 * (double)n->tiles_empty / (double)n->tiles,
        n->drawn / (size_t)frames, n->triangles / (size_t)frames, (double)n->references / fmax(1, (double)n->drawn));
    for (int k = 0; k < DAR_STAGES; k++) printf("  %s %.1f %%", stages[k], 100 * n->seconds[k] / total);
    printf("\n");
    dar_arena_free(&d.arena);
    return total;
}

int main(int argc, char **argv)
{
    const char *path = argc > 1 ? argv[1] : "../shared/assets/robot.glb";
    int width = argc > 5 ? (int)strtol(argv[3], NULL, 10) : 832,
        height = argc > 5 ? (int)strtol(argv[4], NULL, 10) : 480;
    int frames = argc > 5 ? (int)strtol(argv[5], NULL, 10) : 81, animation;
    dar_scene s;
    dar_err e;

    dar_status status = dar_gltf_load(&s, path, true, &e);
    if (status == DAR_OK) status = dar_scene_find_animation(&s, argc > 2 ? argv[2] : "", &animation, &e);
    if (status != DAR_OK) {
        fprintf(stderr, "%s\n", e.text);
        return dar_status_exit(status);
    }
    printf("%s, %d x %d, %d frames, %d threads\n", path, width, height, frames, dar_threads());
    double full = clip(&s, animation, width, height, frames, 0.6);
    clip(&s, animation, width, height, frames, 1.3);
    double empty = clip(&s, animation, width, height, frames, 2.7);
    printf("nearly empty / full: %.2f\n", empty / full);
    dar_scene_free(&s);
    return 0;
}
