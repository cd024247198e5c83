/* config.c: see config.h. */
#include "train/config.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#define PI     3.14159265358979323846
#define COUNT  ((double)((int64_t)1 << 40)) /* no count of a run is larger */
#define DEPTH  8                            /* files that are each other's base */
#define NEEDED NULL

#define MOST_RATE 1e3

const char *const dar_recompute_name[] = { "auto", "none", "cheap", "wide", "selective", "full", NULL };

static const char *const what_names[] = { "lora", "full", "vae", NULL };
static const char *const storage_names[] = { "f64", "f32", "bf16", NULL }; /* dar_dtype */
static const char *const scheduler_names[] = { "constant_with_warmup", "constant", "linear", "cosine", NULL };
static const char *const moment_names[] = { "f32", "bf16", NULL };
static const char *const first_names[] = { "exclude", "include", "noisy", NULL };
static const char *const posterior_names[] = { "mean", "sample", NULL };

/* ---------------------------------------------------------------- the table */

typedef enum kind { FLAG, INT, NUMBER, CHOICE, TEXT, NEEDED_TEXT } kind;

typedef struct row {
    const char *group, *key; /* group NULL: at the top */
    kind kind;
    size_t at; /* in dar_train_config */
    double standard, lo, hi;
    const char *const *names;
} row;

#define AT(field) offsetof(dar_train_config, field)

static const row table[] = {
    { NULL, "model", NEEDED_TEXT, AT(model), 0, 0, 0, NULL },
    { NULL, "weights", TEXT, AT(weights), 0, 0, 0, NULL },
    { "parts", "dit", TEXT, AT(part[DAR_MODEL_DIT]), 0, 0, 0, NULL },
    { "parts", "vae", TEXT, AT(part[DAR_MODEL_VAE]), 0, 0, 0, NULL },
    { "parts", "adapter", TEXT, AT(part[DAR_MODEL_ADAPTER]), 0, 0, 0, NULL },
    { "parts", "lora", TEXT, AT(part[DAR_MODEL_LORA]), 0, 0, 0, NULL },
    { NULL, "train", CHOICE, AT(what), DAR_TRAIN_LORA, 0, 0, what_names },
    { NULL, "from_scratch", FLAG, AT(from_scratch), false, 0, 0, NULL },
    { NULL, "output_dir", NEEDED_TEXT, AT(output), 0, 0, 0, NULL },
    { NULL, "cache_dir", TEXT, AT(cache), 0, 0, 0, NULL },
    { NULL, "seed", INT, AT(seed), 0, 0, (double)DAR_JSON_MAX_INT, NULL },

    { NULL, "rank", INT, AT(rank), 256, 1, 1 << 20, NULL },
    { NULL, "network_alpha", NUMBER, AT(alpha), 0, 0, 1e30, NULL },
    { NULL, "mixed_precision", CHOICE, AT(storage), DAR_BF16, 0, 0, storage_names },
    { NULL, "gradient_checkpointing", CHOICE, AT(recompute), DAR_RECOMPUTE_AUTO, 0, 0, dar_recompute_name },
    { NULL, "memory_budget", NUMBER, AT(budget), 0, 0, 1e9, NULL },

    { NULL, "learning_rate", NUMBER, AT(rate), 1e-4, 0, MOST_RATE, NULL },
    { NULL, "lr_scheduler", CHOICE, AT(scheduler), DAR_LR_WARMUP, 0, 0, scheduler_names },
    { NULL, "lr_warmup_steps", INT, AT(warmup), 200, 0, COUNT, NULL },
    { NULL, "lr_decay_share", NUMBER, AT(decay_share), 0, 0, 1, NULL },
    { NULL, "lr_decay_steps", INT, AT(decay_steps), 0, 0, COUNT, NULL },
    { NULL, "adam_beta1", NUMBER, AT(beta1), 0.9, 0, 0.9999999, NULL },
    { NULL, "adam_beta2", NUMBER, AT(beta2), 0.999, 0, 0.9999999, NULL },
    { NULL, "adam_epsilon", NUMBER, AT(eps), 1e-10, 1e-30, 1, NULL },
    { NULL, "adam_weight_decay", NUMBER, AT(decay), 0.03, 0, 1e3, NULL },
    { NULL, "adam_moments", CHOICE, AT(moments), 0, 0, 0, moment_names },
    { NULL, "ema_decay", NUMBER, AT(average), 0, 0, 0.9999999, NULL },
    { NULL, "max_grad_norm", NUMBER, AT(max_norm), 0.05, 0, 1e30, NULL },
    { NULL, "max_bad_steps", INT, AT(patience), 20, 1, COUNT, NULL },
    { NULL, "max_train_steps", INT, AT(steps), 10000, 1, COUNT, NULL },
    { NULL, "train_batch_size", INT, AT(batch), 1, 1, 4096, NULL },
    { NULL, "gradient_accumulation_steps", INT, AT(accumulate), 1, 1, 1 << 20, NULL },
    { NULL, "prefetch", INT, AT(ahead), 2, 0, 64, NULL },
    { NULL, "checkpointing_steps", INT, AT(save_every), 2000, 0, COUNT, NULL },
    { NULL, "checkpoints_total_limit", INT, AT(keep), 5, 1, 1 << 20, NULL },
    { NULL, "save_merged", FLAG, AT(save_merged), false, 0, 0, NULL },

    { "loss", "shift", NUMBER, AT(shift), 5, 1e-3, 1e3, NULL },
    { "loss", "density", CHOICE, AT(density), DAR_FLOW_UNIFORM, 0, 0, dar_flow_density_name },
    { "loss", "stratified", FLAG, AT(stratified), false, 0, 0, NULL },
    { "loss", "weighting", CHOICE, AT(weighting), DAR_FLOW_FLAT, 0, 0, dar_flow_weighting_name },
    { "loss", "first_frame", CHOICE, AT(first), DAR_FIRST_EXCLUDE, 0, 0, first_names },
    { "text", "dropout", NUMBER, AT(text_dropout), 0.1, 0, 1, NULL },
    { "text", "empty", TEXT, AT(text_empty), 0, 0, 0, NULL },
    { NULL, "posterior", CHOICE, AT(posterior), 0, 0, 0, posterior_names },

    { "vae", "frames", INT, AT(vae_frames), 9, 0, 1 << 20, NULL },
    { "vae", "height", INT, AT(vae_height), 64, 0, 1 << 20, NULL },
    { "vae", "width", INT, AT(vae_width), 64, 0, 1 << 20, NULL },
    { "vae", "round", NUMBER, AT(vae_round), 0.02, 0, 1e3, NULL },
    { "vae", "edge", NUMBER, AT(vae_edge), 0, 0, 1e3, NULL },
    { "vae", "kl", NUMBER, AT(vae_kl), 1e-5, 0, 1e3, NULL },
    { "vae", "noise", NUMBER, AT(vae_noise), 0, 0, 1e3, NULL },
    { "vae", "spread", NUMBER, AT(vae_spread), 0, 0, 1, NULL },

    { "validation", "steps", INT, AT(validate_every), 1000, 0, COUNT, NULL },
    { "validation", "clips", INT, AT(validate_clips), 4, 1, 1 << 20, NULL },
    { "validation", "sampler_steps", INT, AT(validate_steps), 20, 1, 1000, NULL },
    { "validation", "sensitivity", INT, AT(sensitivity), 8, 0, 1 << 20, NULL },
};

static void read_row(dar_train_config *c, dar_json root, const row *r)
{
    dar_json j = r->group ? dar_json_object(root, r->group) : root;
    void *to = (char *)c + r->at;
    switch (r->kind) {
    case FLAG: *(bool *)to = dar_json_bool(j, r->key, r->standard != 0); break;
    case INT: *(int64_t *)to = dar_json_int(j, r->key, (int64_t)r->standard, (int64_t)r->lo, (int64_t)r->hi); break;
    case NUMBER: *(double *)to = dar_json_number(j, r->key, r->standard, r->lo, r->hi); break;
    case CHOICE: *(int *)to = dar_json_choice(j, r->key, (int)r->standard, r->names); break;
    case TEXT: *(const char **)to = dar_json_get(j, r->key).item ? dar_json_text(j, r->key, NULL) : NULL; break;
    case NEEDED_TEXT: *(const char **)to = dar_json_text(j, r->key, NULL); break;
    }
}

static void read_list(dar_json list)
{
    for (dar_json x = dar_json_first(list); x.item; x = dar_json_next(x)) dar_json_text(x, NULL, NULL);
}

static void read_rates(dar_train_config *c, dar_json rates)
{
    if (dar_json_size(rates) > DAR_TRAIN_RATES) dar_json_reject(rates, NULL, "at most %d patterns", DAR_TRAIN_RATES);
    else
        for (dar_json x = dar_json_first(rates); x.item; x = dar_json_next(x)) {
            c->rates[c->n_rates].pattern = dar_json_key(x);
            c->rates[c->n_rates++].rate = dar_json_number(x, NULL, NAN, 0, MOST_RATE);
        }
}

static dar_status read_keys(dar_train_config *c, dar_err *e)
{
    dar_json root = dar_json_root(c->doc);
    for (size_t i = 0; i < DAR_COUNT(table); i++) read_row(c, root, &table[i]);
    if (c->scheduler == DAR_LR_CONSTANT) c->warmup = 0;
    read_rates(c, dar_json_object(root, "learning_rates"));
    read_list(dar_json_array(root, "data"));
    read_list(dar_json_array(dar_json_object(root, "validation"), "data"));
    read_list(dar_json_get(root, "target_modules"));
    dar_json_accept(dar_json_object(root, "condition"));
    dar_json_accept(dar_json_object(root, "adapter"));
    dar_json_get(root, "base");
    return dar_json_finish(c->doc, e);
}

/* ---------------------------------------------------------------- files and their bases */

static dar_status merge_file(dar_json to, const char *path, int depth, dar_err *e)
{
    dar_json_doc *doc;
    char base[PATH_MAX];
    if (depth == DEPTH) return dar_fail(e, DAR_ERR_USAGE, "%s: base: found %d files, one of the other", path, DEPTH);
    DAR_TRY(dar_json_open(&doc, path, e));
    dar_json root = dar_json_root(doc);
    const char *name = dar_json_get(root, "base").item ? dar_json_text(root, "base", NULL) : NULL;
    const char *slash = strrchr(path, '/');
    dar_status s = DAR_OK;
    if (name) {
        int n = *name == '/' || !slash ? 0 : (int)(slash - path) + 1;
        if (snprintf(base, sizeof base, "%.*s%s", n, path, name) >= (int)sizeof base)
            s = dar_fail(e, DAR_ERR_USAGE, "%s: base: the path is too long", path);
        else s = merge_file(to, base, depth + 1, e);
    }
    if (s == DAR_OK) dar_json_merge(to, root);
    dar_json_close(doc);
    return s;
}

static dar_status read_files(dar_train_config *c, const char *path, const char *const *set, size_t n, dar_err *e)
{
    DAR_TRY(dar_json_parse(&c->doc, path, NULL, 0, e));
    DAR_TRY(merge_file(dar_json_root(c->doc), path, 0, e));
    DAR_TRY(dar_json_set(c->doc, "base=null", e));
    for (size_t i = 0; i < n; i++) DAR_TRY(dar_json_set(c->doc, set[i], e));
    return read_keys(c, e);
}

/* ---------------------------------------------------------------- the model */

static dar_status set(dar_json_doc *doc, dar_err *e, const char *fmt, double value)
{
    char text[96];
    snprintf(text, sizeof text, fmt, value);
    return dar_json_set(doc, text, e);
}

/* Additions are those of the run, or none. */
static dar_status set_lora(dar_train_config *c, dar_json_doc *doc, dar_err *e)
{
    bool wanted = c->what == DAR_TRAIN_LORA;
    double rank = wanted ? (double)c->rank : 0;
    DAR_TRY(set(doc, e, "lora.rank=%.0f", rank));
    DAR_TRY(set(doc, e, "lora.alpha=%.17g", wanted ? (c->alpha > 0 ? c->alpha : rank) : 1));
    dar_json targets = dar_json_get(dar_json_root(c->doc), "target_modules");
    if (!targets.item) return DAR_OK;
    dar_json_writer w = { 0 };
    dar_json_write_object(&w, NULL);
    dar_json_write_value(&w, "targets", targets);
    dar_json_write_end(&w);
    dar_json_doc *list = NULL;
    dar_status s = w.failed ? dar_fail(e, DAR_ERR_NOMEM, "target_modules: out of memory")
                            : dar_json_parse(&list, "target_modules", w.text, w.size, e);
    if (s == DAR_OK) dar_json_merge(dar_json_object(dar_json_root(doc), "lora"), dar_json_root(list));
    dar_json_close(list);
    dar_json_writer_free(&w);
    return s;
}

/* Channels are those of the run, else of the model; if neither says any, camera where the adapter takes no geometry. */
static dar_status read_model(dar_train_config *c, dar_err *e)
{
    DAR_TRY(dar_model_file_open(&c->file, c->model, e));
    dar_json_doc *doc = c->file.doc;
    dar_json root = dar_json_root(doc), mine = dar_json_root(c->doc);
    dar_json condition = dar_json_object(root, "condition");
    dar_json_merge(condition, dar_json_object(mine, "condition"));
    dar_json_merge(dar_json_object(root, "adapter"), dar_json_object(mine, "adapter"));
    if (!dar_json_get(condition, "channels").item && c->file.c.adapter.geometry == 0)
        DAR_TRY(dar_json_set(doc, "condition.channels=camera", e));
    dar_condition_read(&c->condition, dar_json_object(root, "condition"));
    DAR_TRY(set_lora(c, doc, e));
    if (c->file.c.adapter.rays) DAR_TRY(set(doc, e, "adapter.geometry=%.0f", (double)c->condition.set.channels));
    dar_model_file_read(&c->file);
    dar_model_feed feed = { DAR_RAYS_GROUP, DAR_RAYS_CHANNELS, (int64_t)c->condition.set.channels };
    return dar_model_file_check(&c->file, &feed, e);
}

dar_status dar_train_config_open(dar_train_config *c, const char *path, const char *const *assignments, size_t n,
                                 dar_err *e)
{
    memset(c, 0, sizeof *c);
    dar_status s = read_files(c, path, assignments, n, e);
    if (s == DAR_OK) s = read_model(c, e);
    if (s != DAR_OK) dar_train_config_close(c);
    return s;
}

void dar_train_config_close(dar_train_config *c)
{
    dar_model_file_close(&c->file);
    dar_json_close(c->doc);
    memset(c, 0, sizeof *c);
}

dar_json dar_train_config_list(const dar_train_config *c, const char *group, const char *key)
{
    dar_json root = dar_json_root(c->doc);
    return dar_json_array(group ? dar_json_object(root, group) : root, key);
}

static int64_t decay_steps(const dar_train_config *c)
{
    if (c->decay_steps) return c->decay_steps;
    return c->decay_share > 0 ? llround(c->decay_share * (double)c->steps) : c->steps - c->warmup;
}

double dar_train_schedule(const dar_train_config *c, int64_t k)
{
    int64_t n = decay_steps(c), begin = c->steps - n;
    bool falls = c->scheduler == DAR_LR_LINEAR || c->scheduler == DAR_LR_COSINE;
    if (!falls || k <= begin || n <= 0) return 1;
    double f = fmin(1, (double)(k - begin) / (double)n);
    return c->scheduler == DAR_LR_LINEAR ? 1 - f : 0.5 * (1 + cos(PI * f));
}

void dar_train_config_print(const dar_train_config *c, dar_json_writer *w)
{
    dar_json_write_value(w, NULL, dar_json_root(c->doc));
}
