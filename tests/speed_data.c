/* speed_data.c: how fast an animated scene becomes G-buffers and a bundle, stage by stage: a part of `make bench`.
 *
 *     speed_data [--scene=FILE.glb] [--animation=NAME] [--output=FILE.csv]
 *
 * 81 frames of 832 x 480 with every family and 2048 tracks, on an orbit that just shows the scene.  Rows: all frames
 * kept in memory, on all threads and on one; into the same buffers over and over, as near as fills the picture, and as
 * far as leaves 90 % of the tiles empty; written as a bundle; and that checked.  Each is run several times after one
 * that warms up, and the median run is told. */
#include "tests/made.h"

#include <errno.h>
#include <unistd.h>

#include "data/clip.h"
#include "data/quality.h"
#include "data/render.h"
#include "data/tracks.h"
#include "lib/args.h"
#include "lib/log.h"
#include "tests/bench.h"

#define ROBOT "../shared/assets/robot.glb"

enum { FRAMES = 81, WIDTH = 832, HEIGHT = 480, TRACKS = 2048, RUNS = 5, FPS = 24 };

/* Stages: those of the rasteriser, then these. */
enum { FOLLOW = DAR_STAGES, WRITE, CHECK, STAGES };

static const char *const stage_name[STAGES] = { "pose", "transform", "cull",   "bin",   "cover", "resolve",
                                                "fill", "copy",      "tracks", "write", "check" };

/* Bytes that a frame leaves in memory: families and the map of tracks. */
#define FRAME_BYTES ((size_t)WIDTH * HEIGHT * (12 + 4 + 4 + 12 + 12 + 4 + 1 + 3))

/* ---------------------------------------------------------------- the clip */

static struct {
    dar_scene scene;
    char name[64];
    dar_clip clip;
    dar_arena arena;
    dar_pose pose;
    dar_identity identity;
    dar_raster raster;
    dar_gbuffer g[FRAMES];
    uint8_t *map[FRAMES];
    dar_surface_point *point;
    float *xy, *depth;
    uint8_t *visible, *color;
    dar_box box[FRAMES];
    dar_world world;
    dar_camera_path orbit, path; /* as it fits; at the distance of the row */
} c;

/* About as many vertices as a small character, turning. */
static void make_scene(void)
{
    static const double time[2] = { 0, 3 };
    static const float turn[2][4] = { { 0, 0, 0, 1 }, { 0, 1, 0, 0 } };
    static dar_channel channel[2];
    static dar_animation animation = { .name = "turn", .end = 3, .channel = channel, .channels = 2 };
    made_init(&c.scene);
    made_sheet(&c.scene, 60, 60, true, made_torus, made_material(&c.scene, false));
    made_sheet(&c.scene, 60, 60, false, made_sphere, made_material(&c.scene, false));
    for (int i = 0; i < 2; i++) {
        dar_node *n = &c.scene.node[made_instance(&c.scene, i, NULL)];
        n->has_matrix = false;
        n->translation[0] = 1.5 * i;
        n->scale[0] = n->scale[1] = n->scale[2] = n->rotation[3] = 1;
        channel[i] = (dar_channel){ .node = i,
                                    .path = DAR_ROTATION,
                                    .interpolation = DAR_LINEAR,
                                    .keys = 2,
                                    .width = 4,
                                    .time = time,
                                    .value = turn[0] };
    }
    c.scene.animation = &animation;
    c.scene.animations = 1;
    snprintf(c.name, sizeof c.name, "made of %zu vertices", c.scene.vertices);
}

static dar_status load_scene(const char *path, const char *animation, dar_err *e)
{
    c.clip = (dar_clip){ .scene = &c.scene, .frames = FRAMES, .fps = FPS };
    if (!path && access(ROBOT, R_OK) != 0) {
        make_scene();
    } else {
        if (!path) path = ROBOT;
        const char *slash = strrchr(path, '/');
        snprintf(c.name, sizeof c.name, "%s", slash ? slash + 1 : path);
        DAR_TRY(dar_clip_load(&c.scene, path, FPS, e));
    }
    return dar_scene_find_animation(&c.scene, animation, &c.clip.animation, e);
}

/* Bounds of every frame, and the orbit around them. */
static dar_status survey(dar_err *e)
{
    dar_stage stage = dar_stage_standard();
    const dar_trajectory_kind *kind;
    DAR_TRY(dar_clip_survey(&c.clip, c.box, &c.world, e));
    stage.box = c.box;
    stage.boxes = FRAMES;
    stage.width = WIDTH;
    stage.height = HEIGHT;
    DAR_TRY(dar_trajectory_find("orbit-30", &kind, e));
    dar_trajectory t = dar_trajectory_draw(kind, 0, 0);
    DAR_TRY(dar_camera_init(&c.orbit, FRAMES, e));
    DAR_TRY(dar_camera_init(&c.path, FRAMES, e));
    return dar_trajectory_path(&t, &stage, &c.orbit, e);
}

static dar_status init(dar_err *e)
{
    const dar_raster_config config = dar_raster_default(WIDTH, HEIGHT);
    DAR_TRY(dar_arena_init(&c.arena, "clip", FRAMES * FRAME_BYTES + ((size_t)1 << 29), e));
    dar_pose_init(&c.pose, &c.scene, &c.arena);
    dar_identity_init(&c.identity, &c.scene, &c.arena);
    dar_raster_init(&c.raster, &c.scene, &c.identity, &config, &c.arena);
    for (size_t f = 0; f < FRAMES; f++) {
        c.g[f] = drawn_buffers(&c.arena, (size_t)WIDTH * HEIGHT);
        c.map[f] = dar_arena_push(&c.arena, (size_t)3 * WIDTH * HEIGHT);
    }
    c.point = dar_arena_push(&c.arena, TRACKS * sizeof *c.point);
    c.xy = dar_arena_push(&c.arena, (size_t)TRACKS * FRAMES * 8);
    c.depth = dar_arena_push(&c.arena, (size_t)TRACKS * 4);
    c.visible = dar_arena_push(&c.arena, (size_t)TRACKS * FRAMES);
    c.color = dar_arena_push(&c.arena, (size_t)TRACKS * 3);
    return survey(e);
}

/* The orbit at `distance` times that which fits. */
static void set_distance(double distance)
{
    for (size_t f = 0; f < FRAMES; f++) {
        c.path.view[f] = c.orbit.view[f];
        for (int i = 0; i < 3; i++) {
            double centre = (c.world.lo[i] + c.world.hi[i]) / 2, *x = &c.path.view[f].c2w[4 * i + 3];
            *x = centre + distance * (*x - centre);
        }
    }
}

/* ---------------------------------------------------------------- one run */

typedef struct run {
    double seconds, stage[STAGES];
    double empty, bytes; /* share of the tiles; written to memory, 0: not told */
} run;

static double lap(double *mark)
{
    double now = dar_log_clock(), d = now - *mark;
    *mark = now;
    return d;
}

static void add_stats(run *x, const dar_raster_stats *s)
{
    for (int k = 0; k < DAR_STAGES; k++) x->stage[k] = s->seconds[k];
    x->empty = (double)s->tiles_empty / fmax(1, (double)s->tiles);
}

/* to: number of the buffers, which those of the frame before are, or precede. */
static dar_status draw_frame(size_t f, size_t to, run *x, dar_err *e)
{
    const dar_gbuffer *last = f == 0 ? NULL : to ? &c.g[to - 1] : &c.g[0];
    DAR_TRY(dar_pose_at(&c.pose, c.clip.animation, dar_clip_time(&c.clip, f), e));
    dar_raster_draw(&c.raster, &c.pose, &c.path.view[f], &c.g[to], last);
    double mark = dar_log_clock();
    dar_mark m = dar_arena_mark(&c.arena);
    if (f == 0) {
        dar_tracks_pick(&c.raster, TRACKS, true, c.point, &c.arena);
        dar_tracks_color(&c.raster, c.point, TRACKS, c.color);
    }
    dar_tracks_follow(&c.raster, c.point, TRACKS, f, FRAMES, c.xy, c.visible, c.depth);
    dar_tracks_map(&c.raster, TRACKS, f, FRAMES, c.xy, c.visible, c.depth, c.color, 3, c.map[to], &c.arena);
    dar_arena_reset(&c.arena, m);
    x->stage[FOLLOW] += lap(&mark);
    return DAR_OK;
}

static dar_status draw_clip(bool kept, run *x, dar_err *e)
{
    double mark = dar_log_clock();
    *x = (run){ 0 };
    c.raster.stats = (dar_raster_stats){ 0 };
    for (size_t f = 0; f < FRAMES; f++) DAR_TRY(draw_frame(f, kept ? f : 0, x, e));
    x->seconds = lap(&mark);
    x->bytes = kept ? (double)(FRAMES * FRAME_BYTES) : 0;
    add_stats(x, &c.raster.stats);
    return DAR_OK;
}

static dar_status keep_frames(const char *unused, run *x, dar_err *e)
{
    (void)unused;
    return draw_clip(true, x, e);
}

/* One after the other into the same buffers, as for a bundle. */
static dar_status stream_frames(const char *unused, run *x, dar_err *e)
{
    (void)unused;
    return draw_clip(false, x, e);
}

/* As dar-bundle render does it: a frame at a time. */
static dar_status write_bundle(const char *path, run *x, dar_err *e)
{
    double mark = dar_log_clock();
    dar_render_report report;
    dar_render r = { .clip = c.clip,
                     .cameras = &c.path,
                     .raster = dar_raster_default(WIDTH, HEIGHT),
                     .bundle = dar_bundle_standard(),
                     .meta = { .world = c.world, .box = c.box, .boxes = FRAMES },
                     .tracks = TRACKS,
                     .track_side = 3 };
    r.bundle.families |= 1u << DAR_FAMILY_SPARSE;
    r.bundle.overwrite = true;
    DAR_TRY(dar_render_bundle(&r, path, &report, e));
    *x = (run){ .seconds = lap(&mark) };
    add_stats(x, &report.raster);
    x->stage[FOLLOW] = report.seconds[DAR_RENDER_TRACKS];
    x->stage[WRITE] = report.seconds[DAR_RENDER_WRITE];
    return DAR_OK;
}

/* Quality control of what was written. */
static dar_status check_bundle(const char *path, run *x, dar_err *e)
{
    dar_bundle *b;
    dar_quality q;
    char text[DAR_QUALITY_TEXT];
    double mark = dar_log_clock();
    DAR_TRY(dar_bundle_open(&b, path, e));
    dar_status s = dar_quality_check(&q, b, e);
    dar_bundle_close(b);
    *x = (run){ .seconds = lap(&mark) };
    x->stage[CHECK] = x->seconds;
    for (int i = 0; s == DAR_OK && i < DAR_QUALITY_CHECKS; i++)
        if (q.result[i].state == DAR_QUALITY_BAD) printf("%s\n", dar_quality_text(&q, (dar_quality_name)i, text));
    return s;
}

static int by_seconds(const void *a, const void *b)
{
    const run *x = a, *y = b;
    return (x->seconds > y->seconds) - (x->seconds < y->seconds);
}

/* ---------------------------------------------------------------- rows */

static FILE *csv;
static double copy_rate; /* [GB/s], of all threads */

static void report(const char *row, const run *x, double bar)
{
    double rate = FRAMES / x->seconds, gbps = 1e-9 * x->bytes / x->seconds;
    int longest = 0;
    char met[32] = "";
    for (int k = 0; k < STAGES; k++)
        if (x->stage[k] > x->stage[longest]) longest = k;
    if (bar > 0) snprintf(met, sizeof met, ", %s %g", rate >= bar ? "met:" : "MISSED:", bar);
    printf("%-10s %d threads %7.1f frames/s%s; %.1f ms each, %.0f %% of tiles empty, most in %s\n          ", row,
           dar_threads(), rate, met, 1e3 / rate, 100 * x->empty, stage_name[longest]);
    for (int k = 0; k < STAGES; k++)
        if (x->stage[k] > 0.001 * x->seconds) printf(" %s %.1f %%", stage_name[k], 100 * x->stage[k] / x->seconds);
    if (gbps > 0) printf("; families are written at %.1f GB/s, %.0f %% of copying", gbps, 100 * gbps / copy_rate);
    printf("\n");
    fprintf(csv, "%s,%s,%dx%d,%d,%d,%.5g,%.5g,%g,%s,%.4g,%.4g,%s", row, c.name, WIDTH, HEIGHT, FRAMES, dar_threads(),
            rate, 1e3 / rate, bar,
            bar <= 0      ? ""
            : rate >= bar ? "yes"
                          : "no",
            x->empty, gbps, stage_name[longest]);
    for (int k = 0; k < STAGES; k++) fprintf(csv, ",%.4g", x->stage[k] / x->seconds);
    fprintf(csv, "\n");
}

struct row {
    const char *name;
    dar_status (*run)(const char *path, run *x, dar_err *e);
    int threads, runs;
    double bar; /* [frames/s], 0: none */
};

/* The median of the runs, after one that warms up. */
static dar_status measure(const struct row *row, double distance, const char *path, run *x, dar_err *e)
{
    run runs[RUNS];
    int before = dar_threads();
    set_distance(distance);
    dar_threads_set(row->threads);
    dar_status s = row->runs > 1 ? row->run(path, x, e) : DAR_OK;
    for (int i = 0; i < row->runs && s == DAR_OK; i++) s = row->run(path, &runs[i], e);
    if (s == DAR_OK) {
        qsort(runs, (size_t)row->runs, sizeof *runs, by_seconds);
        *x = runs[row->runs / 2];
        report(row->name, x, row->bar);
    }
    dar_threads_set(before);
    return s;
}

/* Share of empty tiles at a distance, from every tenth frame. */
static dar_status share_empty(double distance, double *share, dar_err *e)
{
    run x = { 0 };
    set_distance(distance);
    c.raster.stats = (dar_raster_stats){ 0 };
    for (size_t f = 0; f < FRAMES; f += 10) DAR_TRY(draw_frame(f, 0, &x, e));
    add_stats(&x, &c.raster.stats);
    *share = x.empty;
    return DAR_OK;
}

/* Where fewest tiles are empty, and the least distance at which 90 % are. */
static dar_status find_distances(double *near, double *far, dar_err *e)
{
    double share, least = 1;
    for (double d = 1; d > 0.1; d *= 0.9) {
        DAR_TRY(share_empty(d, &share, e));
        if (share < least) least = share, *near = d;
    }
    share = 0;
    for (*far = 1; share < 0.9; *far *= 1.1) DAR_TRY(share_empty(*far * 1.1, &share, e));
    return DAR_OK;
}

static dar_status measure_all(const char *bundle, dar_err *e)
{
    run x, full, empty;
    double near = 1, far = 1;
    int threads = dar_threads();
    const struct row memory = { "memory", keep_frames, threads, RUNS, 60 },
                     alone = { "one thread", keep_frames, 1, RUNS, 0 },
                     filled = { "full", stream_frames, threads, RUNS, 0 },
                     sparse = { "empty", stream_frames, threads, RUNS, 0 },
                     written = { "bundle", write_bundle, threads, 3, 12 },
                     checked = { "check", check_bundle, threads, 1, 0 };
    DAR_TRY(measure(&memory, 1, NULL, &x, e));
    DAR_TRY(measure(&alone, 1, NULL, &x, e));
    DAR_TRY(find_distances(&near, &far, e));
    DAR_TRY(measure(&filled, near, NULL, &full, e));
    DAR_TRY(measure(&sparse, far, NULL, &empty, e));
    double share = empty.seconds / full.seconds;
    printf("nearly empty / full: %.3f, %s 0.25\n", share, share <= 0.25 ? "met:" : "MISSED:");
    fprintf(csv, "empty/full,%s,%dx%d,%d,%d,,,0.25,%s,%.4g,,\n", c.name, WIDTH, HEIGHT, FRAMES, threads,
            share <= 0.25 ? "yes" : "no", share);
    DAR_TRY(measure(&written, 1, bundle, &x, e));
    return measure(&checked, 1, bundle, &x, e);
}

static void print_head(void)
{
    double most = 0;
    for (int i = 0; i < 8; i++) most = fmax(most, bench_peak_sample(BENCH_COPY));
    copy_rate = most;
    printf("%s, %d x %d, %d frames, %d tracks; copying %.1f GB/s\n", c.name, WIDTH, HEIGHT, FRAMES, TRACKS, copy_rate);
    fprintf(csv, "row,scene,size,frames,threads,frames_per_s,ms_per_frame,bar,met,empty_tiles,gbps,longest_stage");
    for (int k = 0; k < STAGES; k++) fprintf(csv, ",%s", stage_name[k]);
    fprintf(csv, "\n");
}

int main(int argc, char **argv)
{
    static const char *scene, *animation, *output, *bundle;
    static const dar_option options[] = {
        { .name = "scene",
          .placeholder = "FILE",
          .type = DAR_ARG_TEXT,
          .target = &scene,
          .help = "glTF; else ../shared/assets/robot.glb, else one that is made" },
        { .name = "animation",
          .placeholder = "NAME",
          .type = DAR_ARG_TEXT,
          .target = &animation,
          .help = "else the first" },
        { .name = "output",
          .placeholder = "FILE",
          .type = DAR_ARG_TEXT,
          .target = &output,
          .standard = "build/bench/data.csv",
          .help = "the table as CSV" },
        { .name = "bundle",
          .placeholder = "DIR",
          .type = DAR_ARG_TEXT,
          .target = &bundle,
          .standard = "build/bench/bundle",
          .help = "where it is written" },
    };
    dar_program p = { .name = "speed_data",
                      .summary = "Measure how fast scenes become G-buffers and bundles.",
                      .options = options,
                      .n_options = DAR_COUNT(options) };
    dar_err e;
    dar_status s = dar_args_parse(&p, argc, argv, &e);
    if (s == DAR_OK && dar_args_answer(&p, stdout)) return 0;
    if (s == DAR_OK) s = load_scene(scene, animation, &e);
    if (s == DAR_OK) s = init(&e);
    if (s == DAR_OK && !(csv = fopen(output, "w"))) s = dar_fail(&e, DAR_ERR_IO, "%s: %s", output, strerror(errno));
    if (s == DAR_OK) {
        print_head();
        s = measure_all(bundle, &e);
    }
    if (s != DAR_OK) fprintf(stderr, "speed_data: %s\n", e.text);
    if (csv && fclose(csv) != 0 && s == DAR_OK) s = DAR_ERR_IO;
    dar_camera_free(&c.orbit);
    dar_camera_free(&c.path);
    dar_arena_free(&c.arena);
    dar_scene_free(&c.scene);
    return dar_status_exit(s);
}
