/* checkpoint_file.c: see checkpoint.h.  checkpoint.json is written last; it sums up the other files, and itself:
 *
 *   {"state": {"step": .., "steps": .., "skipped": .., "in_a_row": .., "seed": ".."},
 *    "files": {"lora.safetensors": {"bytes": .., "sha256": ".."}, ..},
 *    "sha256": of the texts of state and files, each on one line, one after the other}
 */
#include <errno.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "lib/file.h"
#include "lib/json.h"
#include "lib/log.h"
#include "lib/safetensors_write.h"
#include "lib/sha256.h"
#include "lib/weights.h"
#include "models/lora.h"
#include "train/checkpoint_inside.h"

static const char summary[] = "checkpoint.json", config_name[] = "config.json";

static dar_status join(char path[PATH_MAX], const char *directory, const char *name, dar_err *e)
{
    if (snprintf(path, PATH_MAX, "%s/%s", directory, name) < PATH_MAX) return DAR_OK;
    return dar_fail(e, DAR_ERR_IO, "%s/%s: %s", directory, name, strerror(ENAMETOOLONG));
}

/* ---------------------------------------------------------------- which tensors are where */

typedef enum part { LORA, ADAPTER, NETWORK, OPTIMIZER, PARTS } part;

static const char *name_of(const dar_checkpoint *c, part which)
{
    static const char *const names[] = { "lora.safetensors", "adapter.safetensors", "dit.safetensors",
                                         "optimizer.safetensors" };
    return which == NETWORK && !c->dit ? "vae.safetensors" : names[which];
}

static bool trains(const dar_checkpoint *c, unsigned roles)
{
    for (size_t i = 0; i < c->params->count; i++)
        if (c->params->at[i]->trainable && (c->params->at[i]->info.role & roles)) return true;
    return false;
}

static bool has(const dar_checkpoint *c, part which)
{
    bool network = trains(c, DAR_PARAM_BASE);
    if (which == LORA) return trains(c, DAR_PARAM_LORA);
    if (which == ADAPTER) return !network && trains(c, DAR_PARAM_ADAPTER);
    return which == OPTIMIZER || network;
}

typedef struct items {
    dar_safetensors_item *item;
    bool *fixed;                      /* not trained: written, and known already when it is read */
    char (*name)[DAR_PARAM_NAME + 2]; /* of what is the optimiser's */
    size_t n;
} items;

static void items_free(items *x)
{
    free(x->item);
    free(x->fixed);
    free(x->name);
}

static void add_state(items *x, char which, const dar_param *q, const dar_tensor *state)
{
    snprintf(x->name[x->n], sizeof x->name[x->n], "%c.%s", which, q->name);
    x->item[x->n] = (dar_safetensors_item){ x->name[x->n], *state };
    x->n++;
}

/* The tensors of a part; of the LoRA without its alphas. */
static dar_status collect(items *x, const dar_checkpoint *c, part which, dar_err *e)
{
    size_t most = 3 * c->params->count + 1;
    *x = (items){ calloc(most, sizeof *x->item), calloc(most, sizeof *x->fixed), calloc(most, sizeof *x->name), 0 };
    if (!x->item || !x->fixed || !x->name) {
        items_free(x);
        return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name_of(c, which));
    }
    for (size_t i = 0; i < c->params->count; i++) {
        const dar_param *q = c->params->at[i];
        bool lora = q->info.role == DAR_PARAM_LORA;
        if (which == OPTIMIZER && q->trainable) {
            add_state(x, 'm', q, &c->optim->m[i]);
            add_state(x, 'v', q, &c->optim->v[i]);
            if (c->optim->average[i].data) add_state(x, 'w', q, &c->optim->average[i]);
        } else if (which == NETWORK ? !lora : which != OPTIMIZER && q->trainable && lora == (which == LORA)) {
            x->fixed[x->n] = !q->trainable;
            x->item[x->n++] = (dar_safetensors_item){ q->name, q->x };
        }
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- writing */

static dar_status write_part(const dar_checkpoint *c, part which, const char *path, dar_err *e)
{
    static const char *const meta[] = { "format", "pt", NULL };
    items x;
    if (which == LORA && c->dit) return dar_lora_write(c->dit, path, e);
    DAR_TRY(collect(&x, c, which, e));
    dar_status s = dar_safetensors_write(path, x.item, x.n, &(dar_safetensors_options){ .meta = meta }, e);
    items_free(&x);
    return s;
}

static dar_status write_text(const char *path, const char *text, size_t size, dar_err *e)
{
    dar_file_out out = { 0 };
    dar_status s = dar_file_create(&out, path, e);
    if (s == DAR_OK) s = dar_file_write(&out, text, size, e);
    if (s == DAR_OK) s = dar_file_write(&out, "\n", 1, e);
    if (s == DAR_OK) s = dar_file_commit(&out, e);
    dar_file_discard(&out);
    return s;
}

static dar_status sum_file(const char *path, size_t *bytes, char sum[DAR_SHA256_TEXT], dar_err *e)
{
    dar_file_map m;
    dar_sha256 h;
    DAR_TRY(dar_file_map_open(&m, path, e));
    *bytes = m.size;
    dar_sha256_init(&h);
    if (m.size) dar_sha256_add(&h, m.data, m.size);
    dar_sha256_finish(&h, sum);
    dar_file_map_close(&m);
    return DAR_OK;
}

/* "files" gets one more. */
static dar_status sum_up(dar_json_writer *w, const char *directory, const char *name, dar_err *e)
{
    char path[PATH_MAX], sum[DAR_SHA256_TEXT];
    size_t bytes;
    DAR_TRY(join(path, directory, name, e));
    DAR_TRY(sum_file(path, &bytes, sum, e));
    dar_json_write_object(w, name);
    dar_json_write_int(w, "bytes", (int64_t)bytes);
    dar_json_write_text(w, "sha256", sum);
    dar_json_write_end(w);
    return DAR_OK;
}

static dar_status write_files(const dar_checkpoint *c, const char *directory, dar_json_writer *w, dar_err *e)
{
    const struct {
        const char *name, *text;
    } texts[] = { { config_name, c->config }, { "model.json", c->model } };
    char path[PATH_MAX];
    for (int i = 0; i < PARTS; i++) {
        if (!has(c, (part)i)) continue;
        DAR_TRY(join(path, directory, name_of(c, (part)i), e));
        DAR_TRY(write_part(c, (part)i, path, e));
        DAR_TRY(sum_up(w, directory, name_of(c, (part)i), e));
    }
    for (size_t i = 0; i < DAR_COUNT(texts); i++) {
        if (!texts[i].text) continue;
        DAR_TRY(join(path, directory, texts[i].name, e));
        DAR_TRY(write_text(path, texts[i].text, strlen(texts[i].text), e));
        DAR_TRY(sum_up(w, directory, texts[i].name, e));
    }
    return DAR_OK;
}

static void write_state(const dar_checkpoint *c, dar_json_writer *w)
{
    char seed[32];
    snprintf(seed, sizeof seed, "%" PRIu64, c->seed);
    dar_json_write_int(w, "step", c->step);
    dar_json_write_int(w, "steps", c->optim->steps);
    dar_json_write_int(w, "skipped", c->optim->skipped);
    dar_json_write_int(w, "in_a_row", c->optim->in_a_row);
    dar_json_write_text(w, "seed", seed); /* 64 bits, which a JSON number has not */
}

/* Of the two objects as they will be read again. */
static dar_status sum_summary(dar_json root, char sum[DAR_SHA256_TEXT], dar_err *e)
{
    static const char *const keys[] = { "state", "files" };
    dar_json_writer w = { 0 };
    dar_sha256 h;
    bool failed = false;
    dar_sha256_init(&h);
    for (size_t i = 0; i < DAR_COUNT(keys); i++) {
        dar_json_writer_reset(&w);
        dar_json_write_value(&w, NULL, dar_json_object(root, keys[i]));
        failed |= w.failed;
        if (!failed) dar_sha256_add(&h, w.text, w.size);
    }
    dar_sha256_finish(&h, sum);
    dar_json_writer_free(&w);
    return failed ? dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", summary) : DAR_OK;
}

/* The summary without its own sum, as text in w, becomes the file with it. */
static dar_status write_summary(dar_json_writer *w, const char *directory, dar_err *e)
{
    char path[PATH_MAX], sum[DAR_SHA256_TEXT];
    dar_json_doc *doc;
    if (w->failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", summary);
    DAR_TRY(join(path, directory, summary, e));
    DAR_TRY(dar_json_parse(&doc, summary, w->text, w->size, e));
    dar_status s = sum_summary(dar_json_root(doc), sum, e);
    dar_json_writer_reset(w);
    w->pretty = true;
    dar_json_write_object(w, NULL);
    dar_json_write_value(w, "state", dar_json_object(dar_json_root(doc), "state"));
    dar_json_write_value(w, "files", dar_json_object(dar_json_root(doc), "files"));
    if (s == DAR_OK) dar_json_write_text(w, "sha256", sum);
    dar_json_write_end(w);
    dar_json_close(doc);
    if (s != DAR_OK) return s;
    if (w->failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", summary);
    return write_text(path, w->text, w->size, e);
}

dar_status dar_checkpoint_write(const dar_checkpoint *c, const char *directory, dar_err *e)
{
    dar_json_writer w = { 0 };
    dar_json_write_object(&w, NULL);
    dar_json_write_object(&w, "state");
    write_state(c, &w);
    dar_json_write_end(&w);
    dar_json_write_object(&w, "files");
    dar_status s = write_files(c, directory, &w, e);
    dar_json_write_end(&w);
    dar_json_write_end(&w);
    if (s == DAR_OK) s = write_summary(&w, directory, e);
    dar_json_writer_free(&w);
    return s;
}

/* ---------------------------------------------------------------- verifying */

static dar_status verify_file(dar_json file, const char *directory, dar_err *e)
{
    const char *name = dar_json_key(file), *expected = dar_json_text(file, "sha256", NULL);
    int64_t size = dar_json_int(file, "bytes", DAR_JSON_NEEDED, 0, DAR_JSON_MAX_INT);
    char path[PATH_MAX], sum[DAR_SHA256_TEXT];
    size_t bytes;
    if (strchr(name, '/')) return dar_fail(e, DAR_ERR_FORMAT, "%s: found a file '%s'", summary, name);
    DAR_TRY(join(path, directory, name, e));
    DAR_TRY(sum_file(path, &bytes, sum, e));
    if ((int64_t)bytes != size)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu bytes, expected %lld", path, bytes, (long long)size);
    if (expected && strcmp(expected, sum) == 0) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: found SHA-256 %.12s..., expected %.12s...", path, sum,
                    expected ? expected : "none");
}

static dar_status open_summary(dar_json_doc **doc, const char *directory, dar_err *e)
{
    char path[PATH_MAX];
    *doc = NULL;
    DAR_TRY(join(path, directory, summary, e));
    return dar_json_open(doc, path, e);
}

dar_status dar_checkpoint_verify(const char *directory, dar_err *e)
{
    dar_json_doc *doc;
    char sum[DAR_SHA256_TEXT];
    DAR_TRY(open_summary(&doc, directory, e));
    dar_json root = dar_json_root(doc), files = dar_json_object(root, "files");
    const char *expected = dar_json_text(root, "sha256", "none");
    dar_status s = sum_summary(root, sum, e);
    if (s == DAR_OK && strcmp(expected, sum) != 0)
        s = dar_fail(e, DAR_ERR_FORMAT, "%s/%s: found SHA-256 %.12s..., expected %.12s...", directory, summary, sum,
                     expected);
    for (dar_json x = dar_json_first(files); s == DAR_OK && x.item; x = dar_json_next(x))
        s = verify_file(x, directory, e);
    dar_json_accept(dar_json_object(root, "state"));
    if (s == DAR_OK) s = dar_json_finish(doc, e);
    dar_json_close(doc);
    return s;
}

/* ---------------------------------------------------------------- reading */

static dar_status read_state(dar_checkpoint *c, const char *directory, dar_err *e)
{
    dar_json_doc *doc;
    char seed[32];
    DAR_TRY(open_summary(&doc, directory, e));
    dar_json root = dar_json_root(doc), state = dar_json_object(root, "state");
    int64_t step = dar_json_int(state, "step", DAR_JSON_NEEDED, 0, DAR_JSON_MAX_INT);
    int64_t steps = dar_json_int(state, "steps", DAR_JSON_NEEDED, 0, DAR_JSON_MAX_INT);
    int64_t skipped = dar_json_int(state, "skipped", DAR_JSON_NEEDED, 0, DAR_JSON_MAX_INT);
    int64_t in_a_row = dar_json_int(state, "in_a_row", DAR_JSON_NEEDED, 0, DAR_JSON_MAX_INT);
    const char *found = dar_json_text(state, "seed", NULL);
    snprintf(seed, sizeof seed, "%" PRIu64, c->seed);
    if (found && strcmp(found, seed) != 0) dar_json_reject(state, "seed", "that of the run, %s", seed);
    dar_json_accept(root);
    dar_status s = dar_json_finish(doc, e);
    dar_json_close(doc);
    if (s != DAR_OK) return s;
    c->step = step;
    c->optim->steps = steps;
    c->optim->skipped = skipped;
    c->optim->in_a_row = in_a_row;
    return DAR_OK;
}

static dar_status read_tensor(dar_weights *f, const items *of, size_t i, const char *path, dar_err *e)
{
    const dar_safetensors_item *item = &of->item[i];
    char found[96], expected[96];
    dar_tensor x;
    if (!dar_weights_find(f, item->name))
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found no %s, expected what this run trains", path, item->name);
    DAR_TRY(dar_weights_tensor(f, item->name, &x, e));
    if (!dar_shape_equal(&x.shape, &item->x.shape) || x.dtype != item->x.dtype)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: found %s %s, expected %s %s", path, item->name,
                        dar_dtype_name(x.dtype), dar_shape_text(&x.shape, found, sizeof found),
                        dar_dtype_name(item->x.dtype), dar_shape_text(&item->x.shape, expected, sizeof expected));
    if (!of->fixed[i]) dar_tensor_copy(&item->x, &x);
    return DAR_OK;
}

/* The additions count for as much as they did. */
static dar_status check_alpha(const dar_checkpoint *c, dar_weights *f, const char *path, size_t *alphas, dar_err *e)
{
    char module[DAR_PARAM_NAME], name[DAR_PARAM_NAME + sizeof ".alpha"];
    dar_tensor x;
    for (int64_t i = 0; c->dit && i < c->dit->c.layers; i++)
        for (int k = 0; k < DAR_PROJECTIONS; k++) {
            const dar_dit_product *q = &c->dit->block[i].product[k];
            if (!q->down) continue;
            dar_lora_module(module, sizeof module, i, (dar_projection)k);
            snprintf(name, sizeof name, "%s.alpha", module);
            DAR_TRY(dar_weights_tensor(f, name, &x, e));
            double found = dar_dtype_get(x.dtype, x.data, 0);
            float expected = (float)(q->scale * (double)q->down->x.shape.d[0]);
            if (!(found == (double)expected))
                return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: found %g, expected %g", path, name, found,
                                (double)expected);
            (*alphas)++;
        }
    return DAR_OK;
}

static dar_status read_part(const dar_checkpoint *c, part which, const char *directory, dar_err *e)
{
    char path[PATH_MAX];
    dar_weights *f = NULL;
    items x;
    size_t alphas = 0;
    DAR_TRY(join(path, directory, name_of(c, which), e));
    DAR_TRY(collect(&x, c, which, e));
    dar_status s = dar_weights_open(&f, path, e);
    for (size_t i = 0; s == DAR_OK && i < x.n; i++) s = read_tensor(f, &x, i, path, e);
    if (s == DAR_OK && which == LORA) s = check_alpha(c, f, path, &alphas, e);
    if (s == DAR_OK && dar_weights_count(f) != x.n + alphas)
        s = dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu tensors, expected the %zu that this run trains", path,
                     dar_weights_count(f), x.n + alphas);
    dar_weights_close(f);
    items_free(&x);
    return s;
}

/* Name the keys whose values are others than they were.  `path` is that of the two objects. */
static void tell_changes(dar_json was, dar_json is, const char *path)
{
    dar_json_writer w[2] = { { .pretty = false }, { .pretty = false } };
    for (dar_json x = dar_json_first(is); x.item; x = dar_json_next(x)) {
        char at[256];
        dar_json old = dar_json_get(was, dar_json_key(x));
        snprintf(at, sizeof at, "%s%s%s", path, *path ? "." : "", dar_json_key(x));
        if (dar_json_kind_of(x) == DAR_JSON_OBJECT && dar_json_kind_of(old) == DAR_JSON_OBJECT) {
            tell_changes(old, x, at);
            continue;
        }
        for (int i = 0; i < 2; i++) {
            dar_json_writer_reset(&w[i]);
            if (i || old.item) dar_json_write_value(&w[i], NULL, i ? x : old);
            else dar_json_write_null(&w[i], NULL);
        }
        if (w[0].failed || w[1].failed || strcmp(w[0].text, w[1].text) == 0) continue;
        dar_log(DAR_LOG_INFO, "%s: %s before, %s now", at, w[0].text, w[1].text);
    }
    for (int i = 0; i < 2; i++) dar_json_writer_free(&w[i]);
}

/* A run may go on with another configuration, but not unawares. */
static dar_status compare_configs(const dar_checkpoint *c, const char *directory, dar_err *e)
{
    char path[PATH_MAX];
    dar_json_doc *was, *is;
    if (!c->config) return DAR_OK;
    DAR_TRY(join(path, directory, config_name, e));
    if (access(path, F_OK) != 0) return DAR_OK;
    DAR_TRY(dar_json_open(&was, path, e));
    dar_status s = dar_json_parse(&is, config_name, c->config, strlen(c->config), e);
    if (s == DAR_OK) tell_changes(dar_json_root(was), dar_json_root(is), "");
    dar_json_close(was);
    dar_json_close(is);
    return s;
}

dar_status dar_checkpoint_read(dar_checkpoint *c, const char *directory, dar_err *e)
{
    for (int i = 0; i < PARTS; i++)
        if (has(c, (part)i)) DAR_TRY(read_part(c, (part)i, directory, e));
    DAR_TRY(read_state(c, directory, e));
    return compare_configs(c, directory, e);
}
