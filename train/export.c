/* export.c: see export.h. */
#include "train/export.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "lib/dir.h"
#include "lib/file.h"
#include "lib/safetensors_write.h"
#include "models/lora.h"
#include "models/model.h"

#define NETWORK (DAR_PARAM_BASE | DAR_PARAM_ADAPTER)
#define RESULTS "results"

/* A directory that is being written. */
typedef struct place {
    char directory[PATH_MAX + 32], path[PATH_MAX + 64];
    size_t bytes;
} place;

static const char *name(place *p, const char *file)
{
    snprintf(p->path, sizeof p->path, "%s/%s", p->directory, file);
    return p->path;
}

/* ---------------------------------------------------------------- files */

static size_t bytes_of(const dar_params *p, unsigned roles)
{
    size_t n = 0;
    for (size_t i = 0; i < p->count; i++)
        if (p->at[i]->info.role & roles) n += dar_tensor_bytes(&p->at[i]->x);
    return n;
}

/* Parameters of these roles as they are stored. */
static dar_status write_weights(place *at, const char *file, const dar_params *p, unsigned roles, dar_err *e)
{
    dar_safetensors_item *item = calloc(p->count, sizeof *item);
    size_t n = 0;
    if (!item) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name(at, file));
    for (size_t i = 0; i < p->count; i++)
        if (p->at[i]->info.role & roles) item[n++] = (dar_safetensors_item){ p->at[i]->name, p->at[i]->x };
    dar_status s = dar_safetensors_write(name(at, file), item, n, NULL, e);
    free(item);
    at->bytes += bytes_of(p, roles);
    return s;
}

static dar_status write_description(place *at, const dar_model_file *f, dar_err *e)
{
    const char *path = name(at, "model.json");
    dar_json_writer w = { .pretty = true };
    dar_file_out out;
    dar_json_write_value(&w, NULL, dar_json_root(f->doc));
    dar_status s = w.failed ? dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path) : dar_file_create(&out, path, e);
    if (!w.failed) {
        if (s == DAR_OK) s = dar_file_write(&out, w.text, w.size, e);
        if (s == DAR_OK) s = dar_file_write(&out, "\n", 1, e);
        if (s == DAR_OK) s = dar_file_commit(&out, e);
        dar_file_discard(&out);
    }
    dar_json_writer_free(&w);
    return s;
}

static dar_status open_file(dar_model_file *f, const char *model, dar_err *e)
{
    DAR_TRY(dar_model_file_open(f, model, e));
    dar_json_accept(dar_json_object(dar_json_root(f->doc), "condition"));
    return DAR_OK;
}

/* ---------------------------------------------------------------- networks and additions */

static dar_status write_networks(place *at, dar_model_file *f, const dar_model *m, dar_err *e)
{
    DAR_TRY(dar_json_set(f->doc, "lora=null", e));
    DAR_TRY(dar_json_set(f->doc, "weights=null", e));
    DAR_TRY(write_weights(at, "dit.safetensors", &m->params[0], NETWORK, e));
    DAR_TRY(write_weights(at, "vae.safetensors", &m->params[1], DAR_PARAM_ALL, e));
    return write_description(at, f, e);
}

/* The checkpoint's model without what was trained: rays are what every backbone knows.  An adapter that stands by
 * itself is the checkpoint's, so it is sought where the transformer lies. */
static dar_status open_backbone(dar_model_file *f, dar_model **b, const dar_model *m, const char *checkpoint,
                                dar_dtype storage, dar_err *e)
{
    static const char *const set[] = { "adapter.geometry=0", "condition.channels=camera", "weights=null" };
    char directory[PATH_MAX];
    dar_model_options o = { .weights = directory, .storage = storage };
    snprintf(directory, sizeof directory, "%s", m->path[DAR_MODEL_DIT]);
    *strrchr(directory, '/') = 0;
    o.part[DAR_MODEL_DIT] = m->path[DAR_MODEL_DIT];
    o.part[DAR_MODEL_VAE] = m->path[DAR_MODEL_VAE];
    DAR_TRY(open_file(f, checkpoint, e));
    for (size_t i = 0; i < DAR_COUNT(set); i++) DAR_TRY(dar_json_set(f->doc, set[i], e));
    dar_model_file_read(f);
    return dar_model_open(b, f, &o, e);
}

static dar_status write_backbone(place *above, const dar_model *m, const char *checkpoint, dar_dtype storage,
                                 dar_err *e)
{
    dar_model *b = NULL;
    dar_model_file f = { 0 };
    place at = { 0 };
    dar_status s = open_backbone(&f, &b, m, checkpoint, storage, e);
    if (s == DAR_OK) {
        snprintf(at.directory, sizeof at.directory, "%.*s/backbone", PATH_MAX, above->directory);
        s = dar_dir_make(at.directory, e);
    }
    if (s == DAR_OK) s = write_networks(&at, &f, b, e);
    above->bytes += at.bytes;
    dar_model_close(b);
    dar_model_file_close(&f);
    return s;
}

static dar_status write_additions(place *at, dar_model_file *f, const dar_model *m, dar_err *e)
{
    static const char where[] =
        "weights={\"dit\": \"backbone/dit.safetensors\", \"vae\": \"backbone/vae.safetensors\"}";
    DAR_TRY(dar_lora_write(&m->dit, name(at, "lora.safetensors"), e));
    at->bytes += bytes_of(&m->params[0], DAR_PARAM_LORA);
    if (m->dit.adapter.w) DAR_TRY(write_weights(at, "adapter.safetensors", &m->params[0], DAR_PARAM_ADAPTER, e));
    DAR_TRY(dar_json_set(f->doc, where, e));
    return write_description(at, f, e);
}

/* The autoencoder stays where it is. */
static dar_status write_merged(place *at, dar_model_file *f, const dar_model *m, dar_err *e)
{
    char vae[PATH_MAX + 16];
    DAR_TRY(dar_json_set(f->doc, "lora=null", e));
    DAR_TRY(write_weights(at, "dit.safetensors", &m->params[0], NETWORK, e));
    DAR_TRY(dar_json_set(f->doc, "weights={\"dit\": \"dit.safetensors\"}", e));
    snprintf(vae, sizeof vae, "weights.vae=%s", m->path[DAR_MODEL_VAE]);
    DAR_TRY(dar_json_set(f->doc, vae, e));
    return write_description(at, f, e);
}

/* ---------------------------------------------------------------- directories */

static bool is_there(const char *directory, const char *file)
{
    char path[PATH_MAX + 64];
    snprintf(path, sizeof path, "%s/%s", directory, file);
    return access(path, F_OK) == 0;
}

static dar_status write_model(place *at, const char *checkpoint, dar_dtype storage, bool merge, dar_err *e)
{
    dar_model_options o = { .storage = storage, .strength = 1, .apart = !merge };
    dar_model *m = NULL;
    dar_model_file f;
    DAR_TRY(open_file(&f, checkpoint, e));
    dar_status s = dar_model_open(&m, &f, &o, e);
    if (s == DAR_OK && merge) s = write_merged(at, &f, m, e);
    else if (s == DAR_OK && !*m->path[DAR_MODEL_LORA]) s = write_networks(at, &f, m, e);
    else if (s == DAR_OK) {
        s = write_backbone(at, m, checkpoint, storage, e);
        if (s == DAR_OK) s = write_additions(at, &f, m, e);
    }
    dar_model_close(m);
    dar_model_file_close(&f);
    return s;
}

/* What is known about a model outlives an exchange of its weights. */
static dar_status keep_results(place *at, const char *out, dar_err *e)
{
    char from[PATH_MAX + 64];
    snprintf(from, sizeof from, "%s/" RESULTS, out);
    return is_there(out, RESULTS "/.") ? dar_dir_link(from, name(at, RESULTS), e) : DAR_OK;
}

static dar_status replace(const char *checkpoint, const char *out, dar_dtype storage, bool merge, size_t *bytes,
                          dar_err *e)
{
    dar_dir_out dir;
    place at = { 0 };
    dar_status s = dar_dir_create(&dir, out, e);
    if (s == DAR_OK) {
        snprintf(at.directory, sizeof at.directory, "%s", dir.temp);
        s = write_model(&at, checkpoint, storage, merge, e);
    }
    if (s == DAR_OK) s = keep_results(&at, out, e);
    if (s == DAR_OK) s = dar_dir_commit(&dir, is_there(out, "model.json"), e);
    dar_dir_discard(&dir);
    if (s == DAR_OK && bytes) *bytes = at.bytes;
    return s;
}

dar_status dar_export(const char *checkpoint, const char *out, dar_dtype storage, size_t *bytes, dar_err *e)
{
    return replace(checkpoint, out, storage, false, bytes, e);
}

dar_status dar_export_merged(const char *checkpoint, const char *out, dar_dtype storage, dar_err *e)
{
    return replace(checkpoint, out, storage, true, NULL, e);
}
