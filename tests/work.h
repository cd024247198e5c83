/* work.h: run time against error: settings of the sampler on scenes, each measured against two references.
 *
 *   full   f32, 50 steps of Euler, no skip: the paper's run
 *   ode    f64, many steps of Adams and Bashforth on an even grid: what solvers approximate
 *
 * A row is a setting on a scene; rows lie in a CSV file, and one that is there is not measured again.  Pages and the
 * front that the sampler reads (infer/front.h) are made of that file alone. */
#ifndef DAR_TESTS_WORK_H
#define DAR_TESTS_WORK_H

#include "data/metric.h"
#include "infer/front.h"
#include "lib/program.h"

/* ---------------------------------------------------------------- rows */

/* Errors are relative L2 of the latent against full; of classes, of the places in it that are (frame 0 left out):
 * empty, nothing is seen there; still, every pixel shows the same point of the world in all frames of the place and the
 * one before; moving, it does not; edge, part of it is empty.  Metrics are of frames but the first, which is given. */
typedef enum work_column {
    WORK_SCENE,
    WORK_SETTING,
    WORK_PRECISION,
    WORK_SOLVER,
    WORK_STEPS,
    WORK_SKIPS,   /* "all", "none" or the only one */
    WORK_REUSE,   /* rule of models/reuse.h: "none" but for the caches that others publish */
    WORK_THREADS, /* 0: all */
    WORK_SECONDS, /* median, of a video: encoding, sampling, decoding */
    WORK_FLOPS,
    WORK_PEAK, /* memory, weights included [byte] */
    WORK_ERROR,
    WORK_PSNR,
    WORK_PSNR_TRUTH, /* against the bundle's own frames */
    WORK_SSIM,
    WORK_FLIP,
    WORK_TEMP,
    WORK_TOLERANCE,
    WORK_GUIDANCE_TOLERANCE,
    WORK_SAMPLING, /* seconds of the solver alone */
    WORK_CALLS,    /* of the network */
    WORK_BYTES,    /* at least: of weights, read once a call; activations not counted */
    WORK_ESTIMATE, /* models/solver.h */
    WORK_ODE,      /* relative L2 of the latent against ode */
    WORK_TEMP_TRUTH,
    WORK_EMPTY,
    WORK_STILL,
    WORK_MOVING,
    WORK_EDGE,
    WORK_CAMERA_STILL, /* of the scene: 1 or 0 */
    WORK_VISIBLE,
    WORK_MODEL,
    WORK_COLUMNS
} work_column;

#define WORK_CLASSES 4 /* from WORK_EMPTY on */
#define WORK_FULL    "full"
#define WORK_TEXT    64

typedef struct work_row {
    char text[WORK_COLUMNS][WORK_TEXT]; /* of columns that are texts */
    double v[WORK_COLUMNS];             /* of the others; NAN: there is none */
} work_row;

typedef struct work_table {
    const char *path;
    work_row *row;
    size_t n, room;
} work_table;

/* Read what is there; it must have these columns, and every row be of this model.  The caller owes work_close. */
dar_status work_open(work_table *t, const char *path, const char *model, dar_err *e);
void work_close(work_table *t);

const work_row *work_find(const work_table *t, const char *scene, const char *setting);
dar_status work_add(work_table *t, const work_row *row, dar_err *e); /* to the file too, at once */

void work_print(const work_table *t, dar_json_writer *w); /* an array "rows" */

/* ---------------------------------------------------------------- scenes */

typedef struct work_size {
    int width, height; /* [px] */
    size_t frames;
    uint64_t seed;
} work_size;

typedef struct work_scene {
    const char *name;
    char path[PATH_MAX];
    const char *text; /* with two prompts; NULL: none */
    size_t window;    /* in latent frames; 0: none */
    dar_bundle *b;
    dar_front_scene kind;
    uint8_t *truth, *reference; /* [T, H, W, 3], [H, W, 3] */

    /* Once they are known. */
    double *full, *ode; /* latents */
    uint8_t *frames;    /* of full */
    uint8_t *class;     /* [F, h, w] */
    size_t latent;      /* numbers of a latent */
    int64_t shape[4];   /* [C, F, h, w] */
} work_scene;

size_t work_scenes(void);

/* What all scenes of this size are made by, in a few digits.  A scene's file has its own in its name. */
#define WORK_KEY 9
dar_status work_recipes(const work_size *size, char key[WORK_KEY], dar_err *e);

/* Scene i below `directory`, made if it is not there. */
dar_status work_scene_open(work_scene *s, size_t i, const char *directory, const work_size *size,
                           const dar_config *model, dar_err *e);
/* Scene i of those that the front was not made of. */
dar_status work_scene_held(work_scene *s, size_t i, const char *directory, const work_size *size,
                           const dar_config *model, dar_err *e);
void work_scene_close(work_scene *s); /* accepts a zeroed one */

/* References from the scene's file, if they are there and of this model. */
dar_status work_scene_load(work_scene *s, const char *model, bool *there, dar_err *e);
dar_status work_scene_save(const work_scene *s, const char *model, dar_err *e);

/* What a run arrived at against full, ode and truth. */
dar_status work_compare(const work_scene *s, const double *latent, const uint8_t *frames, work_row *row, dar_err *e);

/* ---------------------------------------------------------------- what is made of the rows */

/* The settings worth using; their names are the table's. */
void work_front(const work_table *t, const char *model, double safety, dar_front *f);

/* A published cache beside what this project does with as many calls of the network: of the settings on the same scenes
 * in the same precision, whose solvers have several steps or leave some out, the one with the least error that makes no
 * more calls. */
typedef struct work_equal {
    const char *cache, *ours;  /* settings; ours NULL: all make more calls */
    double calls[2], error[2]; /* of both: share of the full run's, mean of the scenes; the largest of any scene */
} work_equal;

size_t work_equals(const work_table *t, work_equal *x, size_t most); /* returns how many, in the order of the rows */

/* Our error over the caches': how many could be compared, geometric mean, the largest. */
typedef struct work_ratio {
    size_t n;
    double mean, worst; /* NAN if n is 0 */
} work_ratio;

work_ratio work_equal_ratio(const work_equal *x, size_t n);

/* equal_calls.csv; work_precision.json, .svg, .html and pareto.json in `directory`; the last also as `front`, unless
 * that is NULL. */
dar_status work_report(const work_table *t, const char *directory, const char *model, double safety, const char *front,
                       dar_err *e);

/* PATH of the picture of a setting on a scene, or of "truth": the last frame. */
const char *work_picture(const char *directory, const char *scene, const char *setting, char path[PATH_MAX]);

/* ---------------------------------------------------------------- whether promises are kept */

/* Render s in this precision.  DAR_ERR_CHECK: it came to more than its budget. */
typedef dar_status work_render(void *ctx, int precision, const dar_sampler_config *c, work_scene *s, double *latent,
                               uint8_t *frames, double *seconds, double *estimate, dar_err *e);

/* What dar-sample would do with several error budgets on scene i of those held out, if held.csv in `directory` does not
 * say already: a row for each, and what it came to against the full run. */
dar_status work_held(const dar_front *f, const char *directory, size_t i, const work_size *size,
                     const dar_config *model, work_render *render, void *ctx, dar_err *e);

/* Of the rows in held.csv: how many there are, how many exceed their budget, the largest share of it, and the largest
 * time as a share of the full run's. */
typedef struct work_promise {
    size_t rows, broken;
    double error, time;
} work_promise;
dar_status work_held_sum(const char *directory, work_promise *p, dar_err *e);

#endif
