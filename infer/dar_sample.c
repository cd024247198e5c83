/* dar_sample.c: the program dar-sample: bundles, a picture and a model in, videos out. */
#include <errno.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "data/pictures.h"
#include "infer/front.h"
#include "infer/output.h"
#include "infer/pipeline.h"
#include "infer/preview.h"
#include "lib/dir.h"
#include "lib/log.h"
#include "lib/program.h"
#include "lib/sha256.h"
#include "models/rate.h"

#define MOST 1000 /* bundles of one call */

static struct {
    const char *out, *model, *weights, *part[DAR_MODEL_PARTS], *channels, *noise, *text, *negative, *front, *reuse;
    int64_t steps;
    double guidance, shift, strength, tolerance, guidance_tolerance, error_budget;
    int solver, grid, precision, skip;
    int64_t window, overlap;
    dar_arg_list references, no_skip;
    bool random, preview, eval, latent, no_png, no_mp4, no_sheet, exr, mkv, overwrite;
    dar_common common;
} o = { .overlap = -1 };

static const char *const skip_names[] = { "none", "exact", NULL };
static const char *const grid_names[] = { "even", "twice", "whole", "diffusers", "auto", NULL }; /* dar_flow_grid */

/* clang-format off */
static const dar_option options[] = {
    { .name = "out", .letter = 'o', .placeholder = "DIR", .type = DAR_ARG_TEXT, .target = &o.out,
      .help = "directory of the video; of several videos, directories in it by the names of bundle and picture" },
    { .name = "reference", .placeholder = "IMG...", .type = DAR_ARG_WORDS, .target = &o.references,
      .help = "pictures of the first frame, PNG or JPEG, instead of the bundle's: a video for each; another size is "
      "scaled to cover the frame, and its middle used" },
    { .name = "overwrite", .type = DAR_ARG_FLAG, .target = &o.overwrite,
      .help = "replace what was made with other settings; what was made with these is always kept" },

    { .help = "Model" },
    { .name = "model", .placeholder = "DIR|PRESET", .type = DAR_ARG_TEXT, .target = &o.model,
      .help = "directory with model.json, a .json file, or the name of a preset such as wan22-fun-5b" },
    { .name = "weights", .placeholder = "DIR", .type = DAR_ARG_TEXT, .target = &o.weights,
      .help = "where its weights are (default: where the model is)" },
    { .name = "dit", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &o.part[DAR_MODEL_DIT],
      .help = "transformer with adapter: safetensors, an index of shards, or a directory of one" },
    { .name = "vae", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &o.part[DAR_MODEL_VAE],
      .help = "autoencoder: safetensors or .pth" },
    { .name = "adapter", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &o.part[DAR_MODEL_ADAPTER],
      .help = "control adapter, instead of the transformer's own" },
    { .name = "taew", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &o.part[DAR_MODEL_TAEW],
      .help = "tiny decoder, for --preview: safetensors or .pth" },
    { .name = "lora", .placeholder = "FILE|DIR", .type = DAR_ARG_TEXT, .target = &o.part[DAR_MODEL_LORA],
      .help = "low-rank additions; of a directory that dar-train wrote, with the adapter beside them" },
    { .name = "lora-strength", .placeholder = "S", .type = DAR_ARG_NUMBER, .target = &o.strength, .standard = "1",
      .lo = -100, .hi = 100, .help = "how strongly they count; 1: as trained" },
    { .name = "channels", .placeholder = "SET", .type = DAR_ARG_TEXT, .target = &o.channels,
      .help = "what the adapter is given, as dar or world+normal (default: what the model says)" },
    { .name = "precision", .placeholder = "TYPE", .type = DAR_ARG_CHOICE, .target = &o.precision, .standard = "bf16",
      .names = dar_pipeline_precision, .help = "f64, f32, bf16 (sums are f32), or int8: as bf16, products of the "
      "middle blocks of 8 bits" },
    { .name = "random", .type = DAR_ARG_FLAG, .target = &o.random,
      .help = "weights that have no file are drawn by --seed: to try speed and memory" },

    { .help = "Sampling" },
    { .name = "steps", .placeholder = "N", .type = DAR_ARG_INT, .target = &o.steps, .standard = "50",
      .lo = 1, .hi = 1000, .help = "steps of the solver" },
    { .name = "guidance", .placeholder = "G", .type = DAR_ARG_NUMBER, .target = &o.guidance, .standard = "3",
      .lo = 1, .hi = 100, .help = "how much more the prompt counts than the negative one; 1: no guidance" },
    { .name = "guidance-tolerance", .placeholder = "G", .type = DAR_ARG_NUMBER, .target = &o.guidance_tolerance,
      .standard = "0", .lo = 0, .hi = 1, .help = "leave out the negative prompt where that changes the velocity by "
      "G of itself at most, as foretold (models/guidance.h); 0: never" },
    { .name = "shift", .placeholder = "S", .type = DAR_ARG_NUMBER, .target = &o.shift, .standard = "5",
      .lo = 0.01, .hi = 100, .help = "bends the steps towards noise" },
    { .name = "solver", .placeholder = "NAME", .type = DAR_ARG_CHOICE, .target = &o.solver, .standard = "euler",
      .names = dar_solver_name, .help = "euler, ab2, unipc or dpm++" },
    { .name = "grid", .placeholder = "NAME", .type = DAR_ARG_CHOICE, .target = &o.grid, .standard = "auto",
      .names = grid_names, .help = "even, twice, whole or diffusers (models/flow.h); auto: what the solver is "
      "published on" },
    { .name = "tolerance", .placeholder = "T", .type = DAR_ARG_NUMBER, .target = &o.tolerance, .standard = "0",
      .lo = 0, .hi = 1, .help = "leave out steps that earlier ones foretell: each may be off by T of the latent "
      "(models/solver.h); 0: none" },
    { .name = "reuse", .placeholder = "RULE", .type = DAR_ARG_TEXT, .target = &o.reuse, .standard = "none",
      .help = "table:N runs the network in every N-th step, change:X where its input has changed by X since it ran; "
      "else what its blocks added is added again: published rules, to compare with (models/reuse.h)" },
    { .name = "error-budget", .placeholder = "E", .type = DAR_ARG_NUMBER, .target = &o.error_budget, .standard = "0",
      .lo = 0, .hi = 1, .help = "choose precision, solver, steps and tolerances: what was measured to be fastest for "
      "the kind of scene and is off by E of the full run's latent at most (infer/front.h); 0: as these options say" },
    { .name = "front", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &o.front,
      .help = "what was measured (default: front.json beside the model's file)" },
    { .name = "noise", .placeholder = "own|torch|FILE", .type = DAR_ARG_TEXT, .target = &o.noise, .standard = "own",
      .help = "drawn by --seed as this program does, or as torch.randn on a CPU; or a safetensors file" },
    { .name = "text", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &o.text,
      .help = "embedding of the prompt, safetensors (default: the bundle's text.safetensors, else no word)" },
    { .name = "negative", .placeholder = "FILE", .type = DAR_ARG_TEXT, .target = &o.negative,
      .help = "embedding of the negative prompt (default: tensor \"negative\" beside the prompt, else no word)" },
    { .name = "skip", .placeholder = "WHICH", .type = DAR_ARG_CHOICE, .target = &o.skip, .standard = "exact",
      .names = skip_names, .help = "work that need not be done: exact: all that changes nothing; none" },
    { .name = "no-skip", .placeholder = "NAME", .type = DAR_ARG_LIST, .target = &o.no_skip,
      .help = "all but pass, scene, text, times, padding, begin, held, lora or repeat (models/sampler.h)" },
    { .name = "window", .placeholder = "T", .type = DAR_ARG_INT, .target = &o.window, .standard = "0", .lo = 0,
      .hi = 100001, .help = "clips longer than the model was trained for: through windows of T frames, 4 n + 1, "
      "each with the first frame; 0: all at once" },
    { .name = "overlap", .placeholder = "T", .type = DAR_ARG_INT, .target = &o.overlap, .lo = 0, .hi = 100000,
      .help = "frames that neighbouring windows share, 4 n (default: a quarter of a window)" },

    { .help = "Files" },
    { .name = "no-png", .type = DAR_ARG_FLAG, .target = &o.no_png, .help = "no frames/00000.png ..." },
    { .name = "no-mp4", .type = DAR_ARG_FLAG, .target = &o.no_mp4, .help = "no video.mp4" },
    { .name = "no-sheet", .type = DAR_ARG_FLAG, .target = &o.no_sheet, .help = "no contact sheet" },
    { .name = "exr", .type = DAR_ARG_FLAG, .target = &o.exr,
      .help = "exr/00000.exr ...: with depth, matte and ids of the bundle, for compositing" },
    { .name = "eval", .type = DAR_ARG_FLAG, .target = &o.eval,
      .help = "metrics.json: how far the frames are from the bundle's own (data/metric.h)" },
    { .name = "latent", .type = DAR_ARG_FLAG, .target = &o.latent,
      .help = "latent.safetensors: what the solver arrived at" },
    { .name = "preview", .type = DAR_ARG_FLAG, .target = &o.preview,
      .help = "while a video is sampled, OUT.preview.png shows what becomes of it" },
    { .name = "mkv", .type = DAR_ARG_FLAG, .target = &o.mkv, .help = "video.mkv, exact" },
};
/* clang-format on */

/* All that one call does. */
struct job {
    dar_run *r;
    dar_model *m;
    dar_condition condition;
    dar_pipeline_options how;
    char **bundle, **reference; /* names; end with NULL */
    size_t done, kept;
    double prepare; /* [s] of the clip */

    /* With an error budget. */
    dar_front front;
    dar_front_kind_name *kind;       /* [bundles] */
    const dar_front_setting *chosen; /* of the bundle that is being rendered; NULL: the full run */
    bool fell_back;                  /* its estimate came to too much */
};

/* ---------------------------------------------------------------- what is asked for */

static dar_status read_skips(unsigned *skips, dar_err *e)
{
    *skips = o.skip ? DAR_SKIPS_ALL : 0;
    for (size_t i = 0; i < o.no_skip.n; i++) {
        int k = 0;
        while (k < DAR_SKIPS && strcmp(dar_skip_name[k], o.no_skip.at[i]) != 0) k++;
        if (k == DAR_SKIPS)
            return dar_fail(e, DAR_ERR_USAGE,
                            "--no-skip: found '%s', expected pass, scene, text, times, padding, begin, held, "
                            "lora or repeat",
                            o.no_skip.at[i]);
        *skips &= ~(1u << k);
    }
    return DAR_OK;
}

/* In latent frames. */
static dar_status read_window(dar_pipeline_options *p, dar_err *e)
{
    if (o.window == 0) return DAR_OK;
    if (o.window < 9 || o.window % DAR_RAYS_GROUP != 1)
        return dar_fail(e, DAR_ERR_USAGE, "--window: found %lld, expected 9, 13, 17, ... frames", (long long)o.window);
    p->window = (o.window - 1) / DAR_RAYS_GROUP + 1;
    p->overlap = o.overlap < 0 ? p->window / 4 : o.overlap / DAR_RAYS_GROUP;
    if (o.overlap < 0 || (o.overlap % DAR_RAYS_GROUP == 0 && p->overlap < p->window - 1)) return DAR_OK;
    return dar_fail(e, DAR_ERR_USAGE, "--overlap: found %lld, expected 0, 4, 8, ... up to %lld frames",
                    (long long)o.overlap, (long long)(o.window - 5));
}

static dar_status read_reuse(dar_sampler_config *c, dar_err *e)
{
    dar_err why;
    if (dar_reuse_read(&c->reuse, o.reuse, &why) != DAR_OK) return dar_fail(e, DAR_ERR_USAGE, "--reuse: %s", why.text);
    if (!c->reuse.rule || !(o.tolerance > 0 || o.guidance_tolerance > 0 || o.error_budget > 0)) return DAR_OK;
    return dar_fail(e, DAR_ERR_USAGE, "--reuse: found a tolerance or an error budget too, expected one of them");
}

static dar_status read_options(struct job *j, dar_err *e)
{
    const char *name = j->r->program->name;
    dar_pipeline_options *p = &j->how;
    if (!o.out) return dar_fail(e, DAR_ERR_USAGE, "%s: expected -o DIR", name);
    if (!o.model) return dar_fail(e, DAR_ERR_USAGE, "%s: expected --model DIR or PRESET", name);
    *p = (dar_pipeline_options){ .sampler = dar_sampler_default(), .seed = o.common.seed };
    p->text = o.text, p->negative = o.negative;
    p->sampler.guidance = o.guidance;
    p->sampler.guidance_tolerance = o.guidance_tolerance;
    p->sampler.solver.kind = (dar_solver_kind)o.solver;
    p->sampler.solver.grid = o.grid == DAR_GRIDS ? dar_solver_grid(p->sampler.solver.kind) : (dar_flow_grid)o.grid;
    p->sampler.solver.steps = (size_t)o.steps;
    p->sampler.solver.shift = o.shift;
    p->sampler.solver.tolerance = o.tolerance;
    if (strcmp(o.noise, "torch") == 0) p->noise = DAR_NOISE_TORCH;
    else if (strcmp(o.noise, "own") != 0) p->noise_file = o.noise;
    DAR_TRY(read_window(p, e));
    DAR_TRY(read_reuse(&p->sampler, e));
    return read_skips(&p->sampler.skip, e);
}

/* Channels: those of --channels, else of the model; if it says none, camera where the adapter takes no geometry. */
static dar_status read_condition(struct job *j, const dar_model_file *f, dar_err *e)
{
    dar_json condition = dar_json_object(dar_json_root(f->doc), "condition");
    bool said = dar_json_get(condition, "channels").item != NULL;
    dar_condition_read(&j->condition, condition);
    DAR_TRY(dar_json_finish(f->doc, e));
    const char *channels = o.channels || said || f->c.adapter.geometry ? o.channels : "camera";
    if (channels) DAR_TRY(dar_channel_set_parse(&j->condition.set, channels, e));
    dar_model_feed feed = { DAR_RAYS_GROUP, DAR_RAYS_CHANNELS, (int64_t)j->condition.set.channels };
    return dar_model_file_check(f, &feed, e);
}

static dar_dtype storage(void)
{
    return o.precision == DAR_PIPELINE_INT8 ? DAR_BF16 : (dar_dtype)o.precision;
}

/* --lora DIR: its lora.safetensors, and the adapter that was trained with it, if no other is named. */
static void find_trained(const char *part[DAR_MODEL_PARTS])
{
    static char path[2][PATH_MAX];
    static const dar_model_part parts[] = { DAR_MODEL_LORA, DAR_MODEL_ADAPTER };
    const char *directory = part[DAR_MODEL_LORA];
    struct stat st;
    if (!directory || stat(directory, &st) != 0 || !S_ISDIR(st.st_mode)) return;
    for (int i = 0; i < 2; i++) {
        int n = snprintf(path[i], PATH_MAX, "%s/%s.safetensors", directory, dar_model_part_name[parts[i]]);
        bool there = n < PATH_MAX && stat(path[i], &st) == 0;
        if (i == 0 || (there && !part[parts[i]])) part[parts[i]] = path[i];
    }
}

/* ---------------------------------------------------------------- an error budget */

static dar_status look_at_bundles(struct job *j, dar_err *e)
{
    const dar_program *p = j->r->program;
    if (!(j->kind = calloc((size_t)p->rests, sizeof *j->kind)))
        return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", o.out);
    for (int i = 0; i < p->rests; i++) {
        dar_front_scene scene;
        dar_bundle *b;
        DAR_TRY(dar_bundle_open(&b, p->rest[i], e));
        dar_status s = dar_front_look(&scene, b, e);
        dar_bundle_close(b);
        DAR_TRY(s);
        j->kind[i] = dar_front_kind_of(&j->front, &scene);
    }
    return DAR_OK;
}

/* All bundles are rendered by one model, in the precision in which that costs least; in f32 the full run always may. */
static dar_status choose_precision(struct job *j, const dar_model_file *f, dar_err *e)
{
    char path[PATH_MAX];
    double least = INFINITY;
    const char *slash = strrchr(f->path, '/');
    if (!(o.error_budget > 0)) return DAR_OK;
    if (snprintf(path, sizeof path, "%.*sfront.json", slash ? (int)(slash + 1 - f->path) : 0, f->path) >= PATH_MAX)
        return dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long", f->path);
    const char *front = o.front ? o.front : path;
    if (access(front, R_OK) != 0)
        return dar_fail(e, DAR_ERR_USAGE, "%s: %s: --error-budget expects what make bench measured of the model", front,
                        strerror(errno));
    DAR_TRY(dar_front_open(&j->front, front, f->c.name, e));
    DAR_TRY(look_at_bundles(j, e));
    for (int p = 0; p <= DAR_PIPELINE_INT8; p++) {
        double time = 0;
        for (int i = 0; i < j->r->program->rests; i++) {
            const dar_front_setting *s = dar_front_pick(&j->front, j->kind[i], p, o.error_budget);
            time += s ? s->time : p == DAR_F32 ? 1 : INFINITY;
        }
        if (!(time < least)) continue;
        least = time;
        o.precision = p;
    }
    return DAR_OK;
}

/* The full run is the paper's, but for guidance, shift and skips, which stay as they were asked for. */
static void choose_setting(struct job *j, int bundle)
{
    if (!(o.error_budget > 0)) return;
    dar_sampler_config full = dar_sampler_default();
    full.guidance = o.guidance;
    full.solver.shift = o.shift;
    full.skip = j->how.sampler.skip;
    j->how.sampler = full;
    j->fell_back = false;
    j->chosen = dar_front_pick(&j->front, j->kind[bundle], o.precision, o.error_budget);
    if (j->chosen) dar_front_apply(&j->front, j->chosen, &j->how.sampler);
}

/* What was chosen and, unless ran is NULL, what came of it. */
static void tell_choice(struct job *j, const char *path, const dar_sampler *ran, int bundle)
{
    const dar_front_setting *s = j->chosen;
    dar_json_writer *w = &j->r->json;
    char estimated[64] = "";
    if (!(o.error_budget > 0)) return;
    if (s && ran && s->estimate > 0)
        snprintf(estimated, sizeof estimated, "; estimated %.2g of %.2g allowed", ran->estimate,
                 j->front.safety * s->estimate);
    dar_json_write_object(w, "error_budget");
    dar_json_write_number(w, "budget", o.error_budget);
    dar_json_write_text(w, "kind", dar_front_kind[j->kind[bundle]]);
    dar_json_write_text(w, "setting", s ? s->name : "full");
    dar_json_write_bool(w, "fell_back", j->fell_back);
    if (s) dar_json_write_number(w, "bound", j->front.safety * s->error);
    if (s) dar_json_write_number(w, "estimate_allowed", j->front.safety * s->estimate);
    dar_json_write_end(w);
    if (!s)
        dar_run_say(j->r, "%s: no setting for '%s' is known to be within %g: the full run", path,
                    dar_front_kind[j->kind[bundle]], o.error_budget);
    else if (j->fell_back)
        dar_run_say(j->r, "%s: the estimated error of %s came to more than it ever did: 50 steps of euler", path,
                    s->name);
    else
        dar_run_say(j->r, "%s: %s, %.2f of the full run's time, error at most %.2g of %g%s", path, s->name, s->time,
                    j->front.safety * s->error, o.error_budget, estimated);
}

static dar_status open_model(struct job *j, dar_err *e)
{
    dar_model_options m = { .weights = o.weights, .strength = o.strength, .plan = o.common.dry_run };
    dar_model_file f;
    memcpy(m.part, o.part, sizeof m.part);
    find_trained(m.part);
    dar_status s = dar_model_file_open(&f, o.model, e);
    if (s == DAR_OK) s = choose_precision(j, &f, e);
    m.storage = storage();
    m.eight = o.precision == DAR_PIPELINE_INT8;
    m.random = o.random, m.seed = o.common.seed;
    m.preview = o.preview;
    m.apart = !(j->how.sampler.skip >> DAR_SKIP_LORA & 1);
    if (s == DAR_OK) s = read_condition(j, &f, e);
    if (s == DAR_OK) s = dar_model_open(&j->m, &f, &m, e);
    dar_model_file_close(&f);
    return s;
}

/* ---------------------------------------------------------------- names */

/* The last part of a path, without slashes at its end; a file's without what follows its last dot. */
static char *last_part(const char *path, bool file)
{
    size_t n = strlen(path), at;
    while (n > 1 && path[n - 1] == '/') n--;
    for (at = n; at > 0 && path[at - 1] != '/'; at--) continue;
    for (size_t k = n; file && k > at + 1; k--)
        if (path[k - 1] == '.') {
            n = k - 1;
            break;
        }
    return strndup(path + at, n - at);
}

/* Names that videos are told apart by; fails if two are the same. */
static dar_status name_all(char ***name, char *const *path, size_t n, bool file, dar_err *e)
{
    if (!(*name = calloc(n + 1, sizeof **name))) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", o.out);
    for (size_t i = 0; i < n; i++) {
        if (!((*name)[i] = last_part(path[i], file))) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", o.out);
        for (size_t k = 0; k < i; k++)
            if (strcmp((*name)[k], (*name)[i]) == 0)
                return dar_fail(e, DAR_ERR_USAGE, "%s and %s: found one name, expected different ones for their videos",
                                path[k], path[i]);
    }
    return DAR_OK;
}

static void free_names(char **name)
{
    for (size_t i = 0; name && name[i]; i++) free(name[i]);
    free(name);
}

/* Where a video goes. */
static dar_status place_of(const struct job *j, int bundle, size_t reference, char path[PATH_MAX], dar_err *e)
{
    const char *name = j->bundle[bundle];
    int n = o.references.n > 1         ? snprintf(path, PATH_MAX, "%s/%s-%s", o.out, name, j->reference[reference])
            : j->r->program->rests > 1 ? snprintf(path, PATH_MAX, "%s/%s", o.out, name)
                                       : snprintf(path, PATH_MAX, "%s", o.out);
    return n < PATH_MAX ? DAR_OK : dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long", o.out);
}

/* ---------------------------------------------------------------- how it was made */

static void print_file(dar_json_writer *w, const char *key, const char *path)
{
    struct stat st;
    char *name = last_part(path, false);
    dar_json_write_object(w, key);
    dar_json_write_text(w, "name", name ? name : "");
    if (stat(path, &st) == 0) dar_json_write_int(w, "bytes", (int64_t)st.st_size);
    dar_json_write_end(w);
    free(name);
}

/* A file, or a directory as one file in it tells. */
static dar_status print_hashed(dar_json_writer *w, const char *key, const char *named, const char *path, dar_err *e)
{
    char sha256[DAR_SHA256_TEXT];
    if (!path) return DAR_OK;
    DAR_TRY(dar_sha256_file(path, sha256, e));
    char *name = last_part(named, false);
    dar_json_write_object(w, key);
    dar_json_write_text(w, "name", name ? name : "");
    dar_json_write_text(w, "sha256", sha256);
    dar_json_write_end(w);
    free(name);
    return DAR_OK;
}

static void print_sampler(dar_json_writer *w, const struct job *j)
{
    const dar_sampler_config *c = &j->how.sampler;
    dar_json_write_text(w, "precision", dar_pipeline_precision[o.precision]);
    dar_json_write_int(w, "steps", (int64_t)c->solver.steps);
    dar_json_write_number(w, "guidance", c->guidance);
    if (c->guidance_tolerance > 0) dar_json_write_number(w, "guidance_tolerance", c->guidance_tolerance);
    dar_json_write_number(w, "shift", c->solver.shift);
    dar_json_write_text(w, "solver", dar_solver_name[c->solver.kind]);
    if (c->solver.tolerance > 0) dar_json_write_number(w, "tolerance", c->solver.tolerance);
    if (c->reuse.rule) dar_json_write_text(w, "reuse", o.reuse);
    if (c->solver.budget > 0) dar_json_write_number(w, "estimate_allowed", c->solver.budget);
    dar_json_write_text(w, "grid", dar_flow_grid_name[c->solver.grid]);
    dar_json_write_text(w, "noise", j->how.noise_file ? "file" : o.noise);
    if (!j->how.noise_file) {
        char seed[32]; /* any 64 bits, which a number of JSON does not hold */
        snprintf(seed, sizeof seed, "%llu", (unsigned long long)j->how.seed);
        dar_json_write_text(w, "seed", seed);
    }
    if (j->how.window) {
        dar_json_write_int(w, "window", o.window);
        dar_json_write_int(w, "overlap", DAR_RAYS_GROUP * j->how.overlap);
    }
    dar_json_write_array(w, "skips");
    for (int k = 0; k < DAR_SKIPS; k++)
        if (c->skip >> k & 1) dar_json_write_text(w, NULL, dar_skip_name[k]);
    dar_json_write_end(w);
}

static void print_model(dar_json_writer *w, const dar_model *m, const dar_condition *c)
{
    char set[128] = "camera";
    for (size_t i = 0, n = 0; i < c->set.families; i++)
        n += (size_t)snprintf(set + n, sizeof set - n, "%s%s", i ? "+" : "", dar_family_table[c->set.family[i]].name);
    dar_json_write_text(w, "model", m->c.name);
    if (o.random) dar_json_write_text(w, "weights", "random where there is no file");
    for (int i = 0; i < DAR_MODEL_TAEW; i++)
        if (*m->path[i]) print_file(w, dar_model_part_name[i], m->path[i]);
    if (*m->path[DAR_MODEL_LORA]) dar_json_write_number(w, "lora_strength", o.strength);
    dar_json_write_text(w, "channels", set);
    dar_json_write_text(w, "geometry_frame", c->geometry == DAR_GEOMETRY_SCENE ? "scene" : "camera0");
}

/* Everything that the video depends on, and nothing else. */
static dar_status print_settings(dar_json_writer *w, const struct job *j, const char *path, const dar_bundle *b,
                                 const char *reference, dar_err *e)
{
    char meta[PATH_MAX];
    dar_json_writer_reset(w);
    dar_json_write_object(w, NULL);
    dar_json_write_text(w, "made_by", "dar-sample " DAR_VERSION);
    DAR_TRY(print_hashed(w, "bundle", path, dar_bundle_path(b, "meta.json", meta), e));
    DAR_TRY(print_hashed(w, "reference", reference, reference, e));
    DAR_TRY(print_hashed(w, "model_file", j->m->file, j->m->file, e));
    print_model(w, j->m, &j->condition);
    DAR_TRY(print_hashed(w, "text", o.text, o.text, e));
    DAR_TRY(print_hashed(w, "negative", o.negative, o.negative, e));
    DAR_TRY(print_hashed(w, "noise_file", j->how.noise_file, j->how.noise_file, e));
    print_sampler(w, j);
    dar_json_write_bool(w, "png", !o.no_png);
    dar_json_write_bool(w, "exr", o.exr);
    dar_json_write_bool(w, "latent", o.latent);
    dar_json_write_bool(w, "eval", o.eval);
    dar_json_write_bool(w, "mp4", !o.no_mp4);
    dar_json_write_bool(w, "mkv", o.mkv);
    dar_json_write_bool(w, "sheet", !o.no_sheet);
    dar_json_write_end(w);
    return w->failed ? dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", o.out) : DAR_OK;
}

/* ---------------------------------------------------------------- one video */

/* What is heard of a video while it is made. */
struct hearing {
    dar_output *output;
    dar_preview preview; /* .v NULL: none */
    const char *path;
    dar_progress progress;
    double begun, ended[3]; /* [s] of the stages */
    size_t steps;
};

static dar_status hear_frame(void *ctx, size_t index, const uint8_t *rgb, dar_err *e)
{
    struct hearing *h = ctx;
    return dar_output_frame(h->output, index, rgb, e);
}

static dar_status hear_step(void *ctx, size_t done, const dar_tensor *z, const dar_tensor *clean, dar_err *e)
{
    struct hearing *h = ctx;
    if (h->preview.v) DAR_TRY(dar_preview_show(&h->preview, done, clean, e));
    return o.latent && done == h->steps ? dar_output_latent(h->output, z, e) : DAR_OK;
}

static dar_status hear_stage(void *ctx, dar_pipeline_stage stage, size_t done, size_t of, dar_err *e)
{
    static const char *const what[] = { "encoding", "sampling", "decoding" };
    struct hearing *h = ctx;
    size_t steps = stage == DAR_PIPELINE_SAMPLE ? done : stage == DAR_PIPELINE_DECODE ? h->steps : 0;
    char note[64];
    snprintf(note, sizeof note, "%s %zu of %zu", what[stage], done, of);
    dar_progress_step(&h->progress, (double)steps, note);
    h->ended[stage] = dar_log_clock();
    if (!dar_interrupted()) return DAR_OK;
    return dar_fail(e, DAR_ERR_INTERRUPTED, "%s: interrupted while %s; run again to go on", h->path, what[stage]);
}

static dar_status load_reference(dar_bundle *b, const char *path, const char *bundle, uint8_t **rgb, dar_err *e)
{
    size_t width = (size_t)b->meta.width, height = (size_t)b->meta.height;
    if (!path && !b->reference)
        return dar_fail(e, DAR_ERR_USAGE, "%s: found no reference.png, expected --reference IMG", bundle);
    if (!(*rgb = malloc(3 * width * height))) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", bundle);
    return path ? dar_pictures_fit(path, width, height, *rgb, e) : dar_bundle_reference(b, *rgb, e);
}

static void tell_video(struct job *j, const dar_pipeline *p, const struct hearing *h)
{
    const double encode = h->ended[0] - h->begun, sample = h->ended[1] - h->ended[0],
                 decode = h->ended[2] - h->ended[1];
    const dar_bundle_meta *m = &p->b->meta;
    char time[32];
    const dar_sampler *ran = &p->sampler;
    dar_run_say(j->r, "%s: %zu frames of %d x %d in %s: encoding %.2f s, %zu steps %.2f s, decoding %.2f s", h->path,
                m->frames, m->width, m->height, dar_log_duration(encode + sample + decode, time, sizeof time), encode,
                ran->steps, sample, decode);
    dar_json_write_int(&j->r->json, "steps", (int64_t)ran->steps);
    dar_json_write_int(&j->r->json, "steps_rejected", (int64_t)ran->rejected);
    dar_json_write_number(&j->r->json, "estimated_error", ran->estimate);
    dar_json_write_int(&j->r->json, "steps_reused", (int64_t)ran->reused);
    dar_json_write_int(&j->r->json, "guidance_left_out", (int64_t)ran->left_out);
    dar_json_write_number(&j->r->json, "guidance_error", ran->worst);
    dar_json_write_object(&j->r->json, "seconds");
    dar_json_write_number(&j->r->json, "encode", encode);
    dar_json_write_number(&j->r->json, "sample", sample);
    dar_json_write_number(&j->r->json, "decode", decode);
    dar_json_write_end(&j->r->json);
}

static dar_shape latent_of(const dar_pipeline *p)
{
    return DAR_SHAPE(1, p->m->c.dit.latent, p->frames, p->height, p->width);
}

/* OUT.preview.png */
static dar_status begin_preview(struct hearing *h, const dar_pipeline *p, dar_err *e)
{
    char path[PATH_MAX];
    size_t n = strlen(h->path);
    if (!o.preview) return DAR_OK;
    while (n > 1 && h->path[n - 1] == '/') n--;
    if (snprintf(path, sizeof path, "%.*s.preview.png", (int)n, h->path) >= PATH_MAX)
        return dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long", h->path);
    return dar_preview_init(&h->preview, &p->m->taew, latent_of(p), h->steps, path, e);
}

static void end_preview(struct hearing *h)
{
    if (h->preview.v) remove(h->preview.path);
    dar_preview_free(&h->preview);
}

static dar_status render(struct job *j, dar_pipeline *p, const char *path, const uint8_t *rgb, const char *settings,
                         dar_err *e)
{
    const dar_output_options files = { !o.no_png, o.exr, !o.no_mp4, o.mkv, !o.no_sheet, o.eval, o.overwrite };
    const dar_output_shown shown = { &j->condition, &p->cond, rgb };
    struct hearing h = { .path = path, .begun = dar_log_clock(), .steps = p->o.sampler.solver.steps };
    const dar_pipeline_listener listener = { hear_frame, hear_stage, hear_step, &h };
    h.progress = dar_progress_begin(path, "steps", (double)h.steps);
    dar_status s = dar_output_create(&h.output, path, p->b, &shown, settings, &files, e);
    if (s == DAR_OK) s = begin_preview(&h, p, e);
    if (s == DAR_OK) s = dar_pipeline_render(p, rgb, &listener, e);
    if (h.output) dar_progress_end(&h.progress);
    if (s == DAR_OK) s = dar_output_commit(h.output, e);
    end_preview(&h);
    dar_output_discard(h.output);
    if (s == DAR_OK) tell_video(j, p, &h);
    return s;
}

/* This clip is unlike those that were measured: the model's own precision, every step of Euler. */
static dar_status fall_back(struct job *j, const char *in, dar_bundle *b, dar_pipeline **p, dar_err *e)
{
    dar_pipeline_options how = j->how;
    const dar_solver_config *asked = &j->how.sampler.solver;
    how.sampler.solver = dar_solver_default();
    how.sampler.solver.shift = asked->shift;
    how.sampler.guidance_tolerance = 0;
    j->fell_back = true;
    dar_pipeline_close(*p);
    *p = NULL;
    return dar_pipeline_open(p, j->m, &j->condition, in, b, &how, e);
}

/* One reference of a bundle; *p is made when it is first needed. */
static dar_status make_video(struct job *j, int bundle, dar_bundle *b, size_t i, dar_pipeline **p, const char *settings,
                             dar_err *e)
{
    const char *in = j->r->program->rest[bundle], *reference = o.references.n ? o.references.at[i] : NULL;
    char path[PATH_MAX];
    uint8_t *rgb = NULL;
    DAR_TRY(place_of(j, bundle, i, path, e));
    dar_output_state found = dar_output_look(path, settings);
    dar_json_write_text(&j->r->json, "out", path);
    dar_json_write_bool(&j->r->json, "kept", found == DAR_OUTPUT_DONE);
    if (found == DAR_OUTPUT_DONE) {
        dar_run_say(j->r, "%s: is done already", path);
        j->kept++;
        return DAR_OK;
    }
    if (found == DAR_OUTPUT_OTHER && !o.overwrite)
        return dar_fail(e, DAR_ERR_USAGE, "%s: found something made otherwise, expected --overwrite or another -o",
                        path);
    dar_status s = load_reference(b, reference, in, &rgb, e);
    if (j->fell_back) { /* for another picture, which is tried as if it were alone */
        dar_pipeline_close(*p);
        *p = NULL;
        j->fell_back = false;
    }
    if (s == DAR_OK && !*p) {
        double begun = dar_log_clock();
        s = dar_pipeline_open(p, j->m, &j->condition, in, b, &j->how, e);
        j->prepare = dar_log_clock() - begun;
    }
    if (s == DAR_OK) s = render(j, *p, path, rgb, settings, e);
    if (s == DAR_ERR_CHECK && o.error_budget > 0) {
        s = fall_back(j, in, b, p, e);
        if (s == DAR_OK) s = render(j, *p, path, rgb, settings, e);
    }
    free(rgb);
    if (s != DAR_OK) return s;
    tell_choice(j, path, &(*p)->sampler, bundle);
    j->done++;
    return DAR_OK;
}

/* ---------------------------------------------------------------- a bundle */

/* Work of a clip with all its videos, and what was not done for one of them [FLOP]. */
static void tell_plan(struct job *j, const dar_pipeline *p, const char *bundle)
{
    dar_json_writer *w = &j->r->json;
    char time[32];
    const double video = p->encode + p->sample + p->decode;
    size_t preview[3] = { 0 };
    if (o.preview && dar_preview_plan(&j->m->taew, latent_of(p), preview, NULL) != DAR_OK) *preview = 0;
    const size_t videos = o.references.n ? o.references.n : 1;
    const size_t bytes = j->m->bytes + p->bytes + preview[0] + preview[1] + preview[2];
    dar_json_write_int(w, "memory_bytes", (int64_t)bytes);
    dar_json_write_int(w, "weights_bytes", (int64_t)j->m->bytes);
    dar_json_write_object(w, "flops");
    dar_json_write_number(w, "prepare", p->prepare);
    dar_json_write_number(w, "encode", p->encode);
    dar_json_write_number(w, "sample", p->sample);
    dar_json_write_number(w, "decode", p->decode);
    dar_json_write_end(w);
    dar_json_write_object(w, "flops_saved");
    for (int k = 0; k < DAR_SKIPS; k++) dar_json_write_number(w, dar_skip_name[k], p->saved[k]);
    dar_json_write_end(w);
    if (!o.common.dry_run) {
        dar_json_write_number(w, "seconds_prepare", j->prepare);
        return;
    }
    double seconds = (p->prepare + (double)videos * video) / dar_rate((dar_dtype)o.precision);
    dar_run_say(j->r,
                "%s: %zu video%s of %zu frames of %d x %d: %.2f GB of memory (weights %.2f), %.3g TFLOP, at least %s",
                bundle, videos, videos == 1 ? "" : "s", p->b->meta.frames, p->b->meta.width, p->b->meta.height,
                1e-9 * (double)bytes, 1e-9 * (double)j->m->bytes, 1e-12 * (p->prepare + (double)videos * video),
                dar_log_duration(seconds, time, sizeof time));
    for (int k = 0; k < DAR_SKIPS; k++)
        if (p->saved[k] > 0)
            dar_run_say(j->r, "  without skipping %s: %.3g TFLOP more for a video", dar_skip_name[k],
                        1e-12 * p->saved[k]);
    dar_json_write_number(w, "seconds_estimated", seconds);
}

static dar_status make_videos(struct job *j, int bundle, dar_bundle *b, dar_pipeline **p, dar_err *e)
{
    dar_json_writer settings = { .pretty = true };
    dar_status s = DAR_OK;
    dar_json_write_array(&j->r->json, "videos");
    for (size_t i = 0; s == DAR_OK && i < (o.references.n ? o.references.n : 1); i++) {
        const char *reference = o.references.n ? o.references.at[i] : NULL;
        dar_json_write_object(&j->r->json, NULL);
        s = print_settings(&settings, j, j->r->program->rest[bundle], b, reference, e);
        if (s == DAR_OK) s = make_video(j, bundle, b, i, p, settings.text, e);
        dar_json_write_end(&j->r->json);
    }
    dar_json_write_end(&j->r->json);
    dar_json_writer_free(&settings);
    return s;
}

static dar_status sample_bundle(struct job *j, int bundle, dar_err *e)
{
    const char *path = j->r->program->rest[bundle];
    dar_pipeline *p = NULL;
    dar_bundle *b;
    DAR_TRY(dar_bundle_open(&b, path, e));
    dar_json_write_text(&j->r->json, "bundle", path);
    choose_setting(j, bundle);
    dar_status s = o.common.dry_run ? dar_pipeline_open(&p, j->m, &j->condition, path, b, &j->how, e)
                                    : make_videos(j, bundle, b, &p, e);
    if (p) tell_plan(j, p, path);
    if (p && o.common.dry_run) tell_choice(j, path, NULL, bundle);
    dar_pipeline_close(p);
    dar_bundle_close(b);
    return s;
}

static dar_status sample_all(struct job *j, dar_err *e)
{
    const dar_program *p = j->r->program;
    dar_status s = DAR_OK;
    if ((p->rests > 1 || o.references.n > 1) && !o.common.dry_run) DAR_TRY(dar_dir_make(o.out, e));
    dar_json_write_array(&j->r->json, "bundles");
    for (int i = 0; i < p->rests && s == DAR_OK; i++) {
        dar_json_write_object(&j->r->json, NULL);
        s = sample_bundle(j, i, e);
        dar_json_write_end(&j->r->json);
    }
    dar_json_write_end(&j->r->json);
    dar_json_write_int(&j->r->json, "done", (int64_t)j->done);
    dar_json_write_int(&j->r->json, "kept", (int64_t)j->kept);
    return s;
}

static dar_status sample(dar_run *r, dar_err *e)
{
    struct job j = { .r = r };
    dar_status s = read_options(&j, e);
    char *const *references = (char *const *)(uintptr_t)o.references.at;
    if (s == DAR_OK) s = name_all(&j.bundle, r->program->rest, (size_t)r->program->rests, false, e);
    if (s == DAR_OK) s = name_all(&j.reference, references, o.references.n, true, e);
    if (s == DAR_OK) s = open_model(&j, e);
    if (s == DAR_OK) s = sample_all(&j, e);
    dar_model_close(j.m);
    dar_front_close(&j.front);
    free(j.kind);
    free_names(j.bundle);
    free_names(j.reference);
    return s;
}

int main(int argc, char **argv)
{
    static const dar_program program = {
        .name = "dar-sample",
        .summary = "Render bundles: the motion and camera of the bundle, the appearance of a picture.",
        .options = options,
        .n_options = DAR_COUNT(options),
        .common = &o.common,
        .standard_seed = "42",
        .run = sample,
        .rest_name = "BUNDLE...",
        .rest_help = "clips to render (dar-bundle)",
        .rest_least = 1,
        .rest_most = MOST,
    };
    return dar_program_main(&program, argc, argv);
}
