/* merge.c: see merge.h. */
#include "train/merge.h"

#include <stdio.h>
#include <stdlib.h>

#include "lib/dir.h"
#include "lib/file.h"
#include "lib/safetensors_write.h"
#include "models/model.h"

static dar_status write_weights(const dar_model *m, const char *path, dar_err *e)
{
    const dar_params *p = &m->params[0];
    dar_safetensors_item *item = calloc(p->count, sizeof *item);
    size_t n = 0;
    if (!item) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    for (size_t i = 0; i < p->count; i++)
        if (p->at[i]->info.role != DAR_PARAM_LORA) item[n++] = (dar_safetensors_item){ p->at[i]->name, p->at[i]->x };
    dar_status s = dar_safetensors_write(path, item, n, NULL, e);
    free(item);
    return s;
}

/* The checkpoint's description, but for where its weights are. */
static dar_status write_description(dar_model_file *f, const dar_model *m, const char *path, dar_err *e)
{
    char vae[PATH_MAX + 16];
    dar_json_writer w = { .pretty = true };
    dar_file_out out;
    DAR_TRY(dar_json_set(f->doc, "weights={\"dit\": \"dit.safetensors\"}", e));
    snprintf(vae, sizeof vae, "weights.vae=%s", m->path[DAR_MODEL_VAE]);
    DAR_TRY(dar_json_set(f->doc, vae, e));
    DAR_TRY(dar_json_set(f->doc, "lora=null", e));
    dar_json_write_value(&w, NULL, dar_json_root(f->doc));
    dar_status s = w.failed ? dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path) : dar_file_create(&out, path, e);
    if (!w.failed) {
        if (s == DAR_OK) s = dar_file_write(&out, w.text, w.size, e);
        if (s == DAR_OK) s = dar_file_commit(&out, e);
        dar_file_discard(&out);
    }
    dar_json_writer_free(&w);
    return s;
}

static dar_status write_all(dar_model_file *f, const dar_model *m, const char *out, dar_err *e)
{
    char path[PATH_MAX + 32];
    dar_dir_out dir;
    dar_status s = dar_dir_create(&dir, out, e);
    if (s == DAR_OK) {
        snprintf(path, sizeof path, "%s/dit.safetensors", dir.temp);
        s = write_weights(m, path, e);
    }
    if (s == DAR_OK) {
        snprintf(path, sizeof path, "%s/model.json", dir.temp);
        s = write_description(f, m, path, e);
    }
    if (s == DAR_OK) s = dar_dir_commit(&dir, true, e);
    dar_dir_discard(&dir);
    return s;
}

dar_status dar_merge(const char *checkpoint, const char *out, dar_dtype storage, dar_err *e)
{
    dar_model_options o = { .storage = storage, .strength = 1 };
    dar_model *m = NULL;
    dar_model_file f;
    DAR_TRY(dar_model_file_open(&f, checkpoint, e));
    dar_json_accept(dar_json_object(dar_json_root(f.doc), "condition"));
    dar_status s = dar_model_open(&m, &f, &o, e);
    if (s == DAR_OK) s = write_all(&f, m, out, e);
    dar_model_close(m);
    dar_model_file_close(&f);
    return s;
}
