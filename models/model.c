/* model.c: see model.h. */
#include "models/model.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "models/load.h"
#include "models/lora.h"

const char *const dar_model_part_name[] = { "dit", "vae", "adapter", "lora", "taew", NULL };

/* ---------------------------------------------------------------- files */

static bool is_there(const char *path)
{
    return access(path, F_OK) == 0;
}

static bool is_directory(const char *path)
{
    struct stat st;
    return stat(path, &st) == 0 && S_ISDIR(st.st_mode);
}

static void join(char path[PATH_MAX], const char *directory, const char *name)
{
    if ((size_t)snprintf(path, PATH_MAX, "%s/%s", directory, name) >= PATH_MAX) *path = 0;
}

/* The directory that a file lies in, in place. */
static void directory_of(char *path)
{
    char *slash = strrchr(path, '/');
    snprintf(slash ? slash : path, 2, "%s", slash ? "" : ".");
}

/* Presets are sought from where the program is run, then beside where it was built. */
static dar_status find_file(dar_model_file *f, const char *model, dar_err *e)
{
    size_t n = strlen(model);
    char name[PATH_MAX], program[PATH_MAX];
    snprintf(f->path, sizeof f->path, "%s", model);
    if (is_directory(model)) {
        join(f->path, model, "model.json");
        if (is_there(f->path)) return DAR_OK;
        return dar_fail(e, DAR_ERR_USAGE, "%s: found no model.json, expected one that says what the weights are",
                        model);
    }
    if (n > 5 && strcmp(model + n - 5, ".json") == 0) return DAR_OK;
    snprintf(name, sizeof name, "models/presets/%.200s.json", model);
    snprintf(f->path, sizeof f->path, "%s", name);
    if (is_there(f->path)) return DAR_OK;
    ssize_t k = readlink("/proc/self/exe", program, sizeof program - 1);
    if (k > 0) {
        program[k] = 0;
        for (int i = 0; i < 4; i++) { /* build/MODE/dar-sample, or one deeper */
            directory_of(program);
            join(f->path, program, name);
            if (is_there(f->path)) return DAR_OK;
        }
    }
    return dar_fail(e, DAR_ERR_USAGE,
                    "--model: found '%s', expected a directory with a model.json, a .json file or the "
                    "name of a preset",
                    model);
}

dar_status dar_model_file_open(dar_model_file *f, const char *model, dar_err *e)
{
    memset(f, 0, sizeof *f);
    DAR_TRY(find_file(f, model, e));
    DAR_TRY(dar_json_open(&f->doc, f->path, e));
    dar_model_file_read(f);
    return DAR_OK;
}

void dar_model_file_close(dar_model_file *f)
{
    dar_json_close(f->doc);
    memset(f, 0, sizeof *f);
}

void dar_model_file_read(dar_model_file *f)
{
    dar_json root = dar_json_root(f->doc), weights = dar_json_object(root, "weights");
    dar_config_read(&f->c, root);
    for (int i = 0; i < DAR_MODEL_PARTS; i++)
        f->part[i] = dar_json_get(weights, dar_model_part_name[i]).item
                         ? dar_json_text(weights, dar_model_part_name[i], NULL)
                         : NULL;
}

int64_t dar_model_token(const dar_config *c)
{
    return dar_vae_shrink(&c->vae) * c->dit.patch;
}

dar_status dar_model_file_check(const dar_model_file *f, const dar_model_feed *feed, dar_err *e)
{
    const dar_adapter_config *a = &f->c.adapter;
    DAR_TRY(dar_json_finish(f->doc, e));
    if (!f->c.vae.levels)
        return dar_fail(e, DAR_ERR_USAGE, "%s: found no vae, expected one: frames are its latents", f->path);
    const int64_t frames = dar_vae_shrink_time(&f->c.vae), token = dar_model_token(&f->c);
    if (frames != feed->frames || (f->c.dit.mask && f->c.dit.mask != frames))
        return dar_fail(e, DAR_ERR_USAGE, "%s: found vae.halve_time for %lld frames and dit.mask %lld, expected %lld",
                        f->path, (long long)frames, (long long)f->c.dit.mask, (long long)feed->frames);
    if (a->rays + a->geometry == 0) return DAR_OK;
    if (2 * a->unshuffle != token)
        return dar_fail(e, DAR_ERR_USAGE,
                        "%s: found adapter.unshuffle %lld, expected %lld: a token is %lld pixels wide", f->path,
                        (long long)a->unshuffle, (long long)token / 2, (long long)token);
    if (a->rays != feed->rays)
        return dar_fail(e, DAR_ERR_USAGE, "%s: found adapter.rays %lld, expected %lld", f->path, (long long)a->rays,
                        (long long)feed->rays);
    if (a->geometry != feed->geometry)
        return dar_fail(e, DAR_ERR_USAGE,
                        "%s: found adapter.geometry %lld, but the channel set has %lld: expected the set "
                        "that the model was trained with",
                        f->path, (long long)a->geometry, (long long)feed->geometry);
    return DAR_OK;
}

/* ---------------------------------------------------------------- weights */

static void find_part(dar_model *m, const dar_model_file *f, const dar_model_options *o, dar_model_part part)
{
    static const char *const names[DAR_MODEL_PARTS][5] = {
        { "dit.safetensors", "dit.safetensors.index.json", "diffusion_pytorch_model.safetensors",
          "diffusion_pytorch_model.safetensors.index.json" },
        { "vae.safetensors", "vae.pth", "Wan2.2_VAE.pth" },
        { "adapter.safetensors" },
        { "lora.safetensors" },
        { "taew.safetensors", "taew2_2.safetensors", "taew2_2.pth" },
    };
    char directory[PATH_MAX], *path = m->path[part];
    snprintf(directory, sizeof directory, "%s", f->path);
    directory_of(directory);
    if (o->part[part]) {
        snprintf(path, PATH_MAX, "%s", o->part[part]);
        return;
    }
    if (f->part[part]) {
        if (*f->part[part] == '/') snprintf(path, PATH_MAX, "%s", f->part[part]);
        else join(path, directory, f->part[part]);
        return;
    }
    if (o->weights) snprintf(directory, sizeof directory, "%s", o->weights);
    for (int i = 0; names[part][i]; i++) {
        join(path, directory, names[part][i]);
        if (is_there(path)) return;
    }
    *path = 0;
}

static bool needs(const dar_model_options *o, int part)
{
    if (o->plan || o->random) return false;
    return part == DAR_MODEL_VAE || part == DAR_MODEL_DIT || (part == DAR_MODEL_TAEW && o->preview);
}

static dar_status open_parts(dar_model *m, const dar_model_file *f, const dar_model_options *o, dar_err *e)
{
    for (int i = 0; i < DAR_MODEL_PARTS; i++) {
        if (((o->fresh || o->codec) && i != DAR_MODEL_VAE) || (i == DAR_MODEL_TAEW && !o->preview)) continue;
        find_part(m, f, o, (dar_model_part)i);
        if (*m->path[i]) DAR_TRY(dar_weights_open(&m->open[i], m->path[i], e));
        else if (needs(o, i))
            return dar_fail(e, DAR_ERR_USAGE,
                            "%s: found no weights of the %s, expected --%s FILE or --weights DIR with "
                            "%s.safetensors",
                            m->file, dar_model_part_name[i], dar_model_part_name[i], dar_model_part_name[i]);
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- networks */

/* Planning, fresh values stand for those of files: what is mapped then counts as memory, and nothing is told twice. */
static dar_status fill(dar_model *m, const dar_model_options *o, dar_err *e)
{
    dar_params *dit = &m->params[0], *vae = &m->params[1], *taew = &m->params[2];
    const unsigned networks = DAR_PARAM_BASE | DAR_PARAM_ADAPTER;
    dar_weights *const *open = m->open;
    if (!m->weights.plan) {
        if (open[DAR_MODEL_ADAPTER]) DAR_TRY(dar_load_adapter(&m->dit, dit, open[DAR_MODEL_ADAPTER], o->seed, e));
        if (open[DAR_MODEL_DIT]) DAR_TRY(dar_load_dit(&m->dit, dit, open[DAR_MODEL_DIT], o->seed, e));
        if (open[DAR_MODEL_VAE]) DAR_TRY(dar_load_vae(vae, open[DAR_MODEL_VAE], e));
        if (open[DAR_MODEL_TAEW]) DAR_TRY(dar_load_vae(taew, open[DAR_MODEL_TAEW], e));
    }
    dar_params_fresh(dit, networks, o->seed);
    dar_params_fresh(vae, DAR_PARAM_ALL, o->seed);
    dar_params_fresh(taew, DAR_PARAM_ALL, o->seed);
    return DAR_OK;
}

/* The first two blocks and the last three, which suffer most, stay as they are; of few blocks a quarter at each end. */
static void quantise(dar_model *m, dar_arena *scratch)
{
    const int64_t layers = m->c.dit.layers, few = layers / 4;
    dar_lora_quantise(&m->dit, &m->params[0], few < 2 ? few : 2, layers - (few < 3 ? few : 3), scratch);
    m->dit.quantise = true;
}

static dar_status build(dar_model *m, const dar_model_options *o, dar_arena *scratch, dar_err *e)
{
    dar_params *dit = &m->params[0], *vae = &m->params[1], *taew = &m->params[2];
    for (size_t i = 0; i < DAR_COUNT(m->params); i++) dar_params_init(&m->params[i], &m->weights, o->storage);
    if (o->preview) dar_taew_init(&m->taew, taew, &m->c.taew);
    if (!o->codec) dar_dit_init(&m->dit, dit, &m->c.dit, &m->c.adapter);
    dar_vae_init(&m->vae, vae, &m->c.vae);
    if (o->train & DAR_PARAM_LORA) dar_lora_init(&m->dit, dit, &m->c.lora);
    dar_params_train(dit, o->train);
    DAR_TRY(fill(m, o, e));
    if (m->open[DAR_MODEL_LORA]) {
        dar_lora_read_options read = { .alpha = m->c.lora.rank ? m->c.lora.alpha : 0, .strength = o->strength };
        DAR_TRY(dar_lora_read(&m->dit, dit, m->open[DAR_MODEL_LORA], &read, e));
        if (!o->apart) dar_lora_merge(&m->dit, dit, scratch);
    }
    dar_params_fresh(dit, DAR_PARAM_LORA, o->seed);
    dar_params_gradients(dit);
    if (o->eight) quantise(m, scratch);
    dar_vae_fold(&m->vae, &m->weights);
    if (o->preview) dar_taew_prepare(&m->taew, &m->weights);
    for (int i = 0; i < DAR_MODEL_PARTS; i++) dar_weights_rest(m->open[i]); /* what was copied need not stay */
    return DAR_OK;
}

static void drop_networks(dar_model *m)
{
    dar_dit_free(&m->dit);
    for (size_t i = 0; i < DAR_COUNT(m->params); i++) dar_params_free(&m->params[i]);
    dar_arena_free(&m->weights);
    memset(&m->dit, 0, sizeof m->dit);
    memset(&m->vae, 0, sizeof m->vae);
}

static dar_status load(dar_model *m, const dar_model_options *o, dar_err *e)
{
    dar_arena scratch = { 0 };
    dar_status s = dar_arena_init_plan(&m->weights, "weights", e);
    if (s == DAR_OK) s = dar_arena_init_plan(&scratch, "merging", e);
    if (s == DAR_OK) s = build(m, o, &scratch, e);
    size_t merging = scratch.peak;
    m->bytes = m->weights.peak;
    dar_arena_free(&scratch);
    if (s != DAR_OK || o->plan) return s;

    drop_networks(m);
    DAR_TRY(dar_arena_init(&m->weights, "weights", m->bytes, e));
    s = dar_arena_init(&scratch, "merging", merging, e);
    if (s == DAR_OK) s = build(m, o, &scratch, e);
    dar_arena_free(&scratch);
    return s;
}

dar_status dar_model_open(dar_model **out, const dar_model_file *f, const dar_model_options *o, dar_err *e)
{
    dar_model *m = calloc(1, sizeof *m);
    dar_status s = m ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", f->path);
    if (s == DAR_OK) {
        m->c = f->c;
        memcpy(m->file, f->path, sizeof m->file);
        s = open_parts(m, f, o, e);
    }
    if (s == DAR_OK) s = load(m, o, e);
    if (s != DAR_OK) {
        dar_model_close(m);
        m = NULL;
    }
    *out = m;
    return s;
}

void dar_model_close(dar_model *m)
{
    if (!m) return;
    drop_networks(m);
    for (int i = 0; i < DAR_MODEL_PARTS; i++) dar_weights_close(m->open[i]);
    free(m);
}
