/* front.h: which settings of the sampler are worth using: what each costs, and how far it was ever found from the full
 * run.
 *
 * The full run is f32, 50 steps of Euler, no skip; error is |z - z*| / |z*| of the latent z against the full run's z*.
 * A benchmark (make bench) runs many settings on several scenes and keeps, for every kind of scene, those that no
 * cheaper one is as exact as: the front.  What holds for a scene that was not tried:
 *
 *   bound   safety times the largest error of any scene of the kind
 *   guard   safety times the largest estimate (models/solver.h) of any scene of the kind: a run that comes to more is
 *           unlike those that were measured
 *
 * The file, format "dar-front/1", lies beside the model's as front.json:
 *
 *   { "format", "model": its name, "safety",
 *     "kinds": [ { "name": "still" | "moving" | "any", "scenes": how many, "visible": [least, most],
 *                  "settings": [ { "name", "precision", "solver", "steps", "tolerance", "guidance_tolerance",
 *                                  "time": share of the full run's, geometric mean over scenes,
 *                                  "error", "estimate", "psnr": of the frames against the full run's [dB] } ] } ] }
 *
 * with settings in the order of time; error, estimate and psnr are the worst of all scenes. */
#ifndef DAR_INFER_FRONT_H
#define DAR_INFER_FRONT_H

#include "infer/pipeline.h"

/* What a setting that makes every call is given as tolerance, so that its error is estimated: it leaves none out. */
#define DAR_FRONT_WATCH 1e-12

typedef struct dar_front_setting {
    const char *name;
    int precision; /* index in dar_pipeline_precision */
    dar_solver_kind solver;
    size_t steps;
    double tolerance, guidance_tolerance;
    double time, error, estimate, psnr;
} dar_front_setting;

typedef enum dar_front_kind_name {
    DAR_FRONT_STILL,
    DAR_FRONT_MOVING,
    DAR_FRONT_ANY,
    DAR_FRONT_KINDS
} dar_front_kind_name;

extern const char *const dar_front_kind[DAR_FRONT_KINDS + 1]; /* "still", "moving", "any", NULL */

#define DAR_FRONT_MOST 64 /* settings of a kind */

typedef struct dar_front_row {
    size_t scenes;     /* 0: the kind was not measured */
    double visible[2]; /* least and largest share of visible pixels of those scenes */
    size_t settings;
    dar_front_setting setting[DAR_FRONT_MOST];
} dar_front_row;

typedef struct dar_front {
    const char *model;
    double safety;
    dar_front_row kind[DAR_FRONT_KINDS];
    dar_json_doc *doc; /* holds the texts */
} dar_front;

/* Read the file of this model.  On failure *f is closed. */
dar_status dar_front_open(dar_front *f, const char *path, const char *model, dar_err *e);
void dar_front_close(dar_front *f); /* accepts a zeroed one */

void dar_front_print(const dar_front *f, dar_json_writer *w);

/* ---------------------------------------------------------------- scenes */

typedef struct dar_front_scene {
    bool still;     /* the camera is */
    double visible; /* share of the pixels of all frames that show something; NAN: the bundle does not tell */
} dar_front_scene;

dar_status dar_front_look(dar_front_scene *s, dar_bundle *b, dar_err *e);

/* Still or moving, if scenes with as many visible pixels were measured; else any. */
dar_front_kind_name dar_front_kind_of(const dar_front *f, const dar_front_scene *s);

/* ---------------------------------------------------------------- settings */

/* The cheapest of that precision whose bound is `budget` at most; NULL: there is none. */
const dar_front_setting *dar_front_pick(const dar_front *f, dar_front_kind_name kind, int precision, double budget);

/* Put it into c, with its guard. */
void dar_front_apply(const dar_front *f, const dar_front_setting *s, dar_sampler_config *c);

#endif
