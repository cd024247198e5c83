/* load.c: names between our table and files. */
#include "models/load.h"

#include <ctype.h>
#include <stdio.h>
#include <string.h>

#include "lib/log.h"

/* ---------------------------------------------------------------- names in other places
 *
 * Each rule replaces its first match; '#' stands for a number, '^' for the begin of the name. */

typedef struct rule {
    const char *from, *to;
} rule;

static const rule dit_rules[] = {
    { "^text_embedding.0.", "condition_embedder.text_embedder.linear_1." },
    { "^text_embedding.2.", "condition_embedder.text_embedder.linear_2." },
    { "^time_embedding.0.", "condition_embedder.time_embedder.linear_1." },
    { "^time_embedding.2.", "condition_embedder.time_embedder.linear_2." },
    { "^time_projection.1.", "condition_embedder.time_proj." },
    { "^head.modulation", "scale_shift_table" },
    { "^head.head.", "proj_out." },
    { "^blocks.#.modulation", "blocks.#.scale_shift_table" },
    { ".self_attn.", ".attn1." },
    { ".cross_attn.", ".attn2." },
    { ".q.", ".to_q." },
    { ".k.", ".to_k." },
    { ".v.", ".to_v." },
    { ".o.", ".to_out.0." },
    { ".ffn.0.", ".ffn.net.0.proj." },
    { ".ffn.2.", ".ffn.net.2." },
    { ".norm3.", ".norm2." },
};

static const rule vae_rules[] = {
    { "^conv1.", "quant_conv." },
    { "^conv2.", "post_quant_conv." },
    { "coder.conv1.", "coder.conv_in." },
    { "coder.head.0.", "coder.norm_out." },
    { "coder.head.2.", "coder.conv_out." },
    { ".middle.0.", ".mid_block.resnets.0." },
    { ".middle.1.", ".mid_block.attentions.0." },
    { ".middle.2.", ".mid_block.resnets.1." },
    { ".downsamples.#.downsamples.#.residual.", ".down_blocks.#.resnets.#.residual." },
    { ".downsamples.#.downsamples.#.shortcut.", ".down_blocks.#.resnets.#.shortcut." },
    { ".downsamples.#.downsamples.#.", ".down_blocks.#.downsampler." },
    { ".upsamples.#.upsamples.#.residual.", ".up_blocks.#.resnets.#.residual." },
    { ".upsamples.#.upsamples.#.shortcut.", ".up_blocks.#.resnets.#.shortcut." },
    { ".upsamples.#.upsamples.#.", ".up_blocks.#.upsampler." },
    { ".residual.0.", ".norm1." },
    { ".residual.2.", ".conv1." },
    { ".residual.3.", ".norm2." },
    { ".residual.6.", ".conv2." },
    { ".shortcut.", ".conv_shortcut." },
};

/* Whether `from` matches at `at`; its numbers in number[2], the end of the match in *end. */
static bool match(const char *at, const char *from, int number[2], const char **end)
{
    int n = 0;
    for (; *from; from++) {
        if (*from != '#') {
            if (*at++ != *from) return false;
        } else {
            if (!isdigit((unsigned char)*at)) return false;
            for (number[n] = 0; isdigit((unsigned char)*at); at++) number[n] = 10 * number[n] + (*at - '0');
            n++;
        }
    }
    *end = at;
    return true;
}

static void apply(const rule *r, char *name, size_t size)
{
    char out[2 * DAR_PARAM_NAME];
    const char *from = r->from + (*r->from == '^'), *end;
    int number[2] = { 0 }, n = 0;
    for (char *at = name; *at; at++) {
        if (match(at, from, number, &end)) {
            size_t k = (size_t)(at - name);
            memcpy(out, name, k);
            for (const char *to = r->to; *to; to++) {
                if (*to == '#') k += (size_t)snprintf(out + k, sizeof out - k, "%d", number[n++]);
                else out[k++] = *to;
            }
            snprintf(out + k, sizeof out - k, "%s", end);
            snprintf(name, size, "%s", out);
            return;
        }
        if (*r->from == '^') return;
    }
}

static void apply_all(const rule *r, size_t n, const char *name, char *out, size_t size)
{
    snprintf(out, size, "%s", name);
    for (size_t i = 0; i < n; i++) apply(&r[i], out, size);
}

void dar_load_diffusers_dit(const char *name, char *out, size_t size)
{
    apply_all(dit_rules, DAR_COUNT(dit_rules), name, out, size);
}

void dar_load_diffusers_vae(const char *name, char *out, size_t size)
{
    apply_all(vae_rules, DAR_COUNT(vae_rules), name, out, size);
}

static void as_it_is(const char *name, char *out, size_t size)
{
    snprintf(out, size, "%s", name);
}

static void below_model(const char *name, char *out, size_t size)
{
    snprintf(out, size, "model.%s", name);
}

static void below_diffusion_model(const char *name, char *out, size_t size)
{
    snprintf(out, size, "model.diffusion_model.%s", name);
}

typedef void rename_fn(const char *name, char *out, size_t size);

/* ---------------------------------------------------------------- loading */

#define NAME_SIZE (2 * DAR_PARAM_NAME)

typedef struct loading {
    dar_params *p;
    dar_weights *w;
    const char *file;
    rename_fn *rename;
    const dar_adapter *adapter; /* NULL: there is none */
    unsigned roles;             /* what is wanted */
    uint64_t seed;
    size_t missing, wrong;
    dar_err first[2]; /* of each, in words */
} loading;

static bool wanted(const loading *l, const dar_param *q)
{
    return q->info.role & l->roles && !q->x.data;
}

static size_t hits(const loading *l, rename_fn *rename)
{
    char name[NAME_SIZE];
    size_t n = 0;
    for (size_t i = 0; i < l->p->count; i++) {
        if (!wanted(l, l->p->at[i])) continue;
        rename(l->p->at[i]->name, name, sizeof name);
        n += dar_weights_find(l->w, name) != NULL;
    }
    return n;
}

static void note(loading *l, size_t *count, dar_err *first, const char *text)
{
    if (!(*count)++) dar_fail(first, DAR_ERR_FORMAT, "%s", text);
    dar_log(DAR_LOG_WARNING, "%s: %s", l->file, text);
}

/* Residual blocks of the adapter that public weights do not have. */
static bool beyond_file(const loading *l, const dar_param *q)
{
    int block[2];
    const char *end;
    return l->adapter && match(q->name, "control_adapter.residual_blocks.#.", block, &end) && block[0] > 0;
}

static void load_one(loading *l, dar_param *q)
{
    char name[NAME_SIZE], text[512], found[96], expected[96];
    dar_tensor x;
    dar_err e;

    l->rename(q->name, name, sizeof name);
    dar_shape_text(&q->x.shape, expected, sizeof expected);
    if (!dar_weights_find(l->w, name)) {
        if (beyond_file(l, q)) {
            dar_log(DAR_LOG_INFO, "%s: %s is not there: made anew", l->file, name);
            dar_param_fresh(l->p, q, l->seed);
            return;
        }
        snprintf(text, sizeof text, "%s %s is missing", name, expected);
        note(l, &l->missing, &l->first[0], text);
        return;
    }
    if (dar_weights_tensor(l->w, name, &x, &e) != DAR_OK) {
        note(l, &l->wrong, &l->first[1], e.text);
    } else if (l->adapter && q == l->adapter->w) {
        if (dar_adapter_bind(l->p, l->adapter, &x, l->seed, &e) != DAR_OK) note(l, &l->wrong, &l->first[1], e.text);
    } else if (!dar_shape_equal(&x.shape, &q->x.shape)) {
        snprintf(text, sizeof text, "%s: found %s, expected %s", name, dar_shape_text(&x.shape, found, sizeof found),
                 expected);
        note(l, &l->wrong, &l->first[1], text);
    } else {
        dar_param_bind(l->p, q, &x);
    }
}

static void tell_unused(const loading *l)
{
    char name[NAME_SIZE];
    for (size_t i = 0; i < dar_weights_count(l->w); i++) {
        const dar_weight *x = dar_weights_at(l->w, i);
        bool used = false;
        for (size_t k = 0; k < l->p->count && !used; k++) {
            l->rename(l->p->at[k]->name, name, sizeof name);
            used = !strcmp(name, x->name);
        }
        if (!used) dar_log(DAR_LOG_WARNING, "%s: %s is not used", l->file, x->name);
    }
}

static dar_status load(loading *l, rename_fn *const *renames, size_t n, dar_err *e)
{
    size_t most = 0;
    if (!dar_weights_count(l->w)) return dar_fail(e, DAR_ERR_FORMAT, "a file of weights without a tensor");
    l->file = dar_weights_at(l->w, 0)->file;
    for (size_t i = 0; i < n; i++) {
        size_t k = hits(l, renames[i]);
        if (k > most || !i) {
            most = k;
            l->rename = renames[i];
        }
    }
    if (!most)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: none of its tensors is of this network: found %s, expected %s", l->file,
                        dar_weights_at(l->w, 0)->name, l->p->at[0]->name);
    if (l->adapter && l->adapter->w && !l->adapter->w->x.data) {
        char name[NAME_SIZE];
        l->rename(l->adapter->w->name, name, sizeof name);
        if (!dar_weights_find(l->w, name))
            return dar_fail(e, DAR_ERR_FORMAT, "%s: %s is missing: weights without a camera adapter cannot use rays",
                            l->file, name);
    }
    for (size_t i = 0; i < l->p->count; i++)
        if (wanted(l, l->p->at[i])) load_one(l, l->p->at[i]);
    tell_unused(l);
    if (!l->missing && !l->wrong) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: %zu tensors missing, %zu of another shape or type: %s", l->file, l->missing,
                    l->wrong, l->first[!l->missing].text);
}

dar_status dar_load_dit(dar_dit *m, dar_params *p, dar_weights *w, uint64_t seed, dar_err *e)
{
    static rename_fn *const renames[] = { as_it_is, below_model, below_diffusion_model, dar_load_diffusers_dit };
    loading l = { .p = p, .w = w, .adapter = &m->adapter, .seed = seed };
    l.roles = DAR_PARAM_BASE | DAR_PARAM_ADAPTER;
    return load(&l, renames, DAR_COUNT(renames), e);
}

dar_status dar_load_adapter(dar_dit *m, dar_params *p, dar_weights *w, uint64_t seed, dar_err *e)
{
    static rename_fn *const renames[] = { as_it_is, below_model, below_diffusion_model };
    loading l = { .p = p, .w = w, .adapter = &m->adapter, .seed = seed, .roles = DAR_PARAM_ADAPTER };
    return load(&l, renames, DAR_COUNT(renames), e);
}

dar_status dar_load_vae(dar_params *p, dar_weights *w, dar_err *e)
{
    static rename_fn *const renames[] = { as_it_is, below_model, dar_load_diffusers_vae };
    loading l = { .p = p, .w = w, .roles = DAR_PARAM_ALL };
    return load(&l, renames, DAR_COUNT(renames), e);
}

/* ---------------------------------------------------------------- prompts */

static bool is_zero_row(const dar_tensor *x, int64_t row)
{
    int64_t n = x->shape.d[2];
    for (int64_t i = 0; i < n; i++)
        if (dar_dtype_get(x->dtype, x->data, (size_t)(row * n + i)) != 0) return false;
    return true;
}

dar_status dar_load_text(const dar_dit_config *c, dar_weights *w, const char *path, const char *name, dar_tensor *x,
                         dar_err *e)
{
    char found[96];
    if (!dar_weights_find(w, name) && dar_weights_count(w) == 1) name = dar_weights_at(w, 0)->name;
    DAR_TRY(dar_weights_tensor(w, name, x, e));
    int n = x->shape.n;
    if (!(n == 2 || (n == 3 && x->shape.d[0] == 1)) || x->shape.d[n - 1] != c->text_width ||
        x->shape.d[n - 2] > c->text_keys)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: found %s, expected [n, %lld], n at most %lld", path, name,
                        dar_shape_text(&x->shape, found, sizeof found), (long long)c->text_width,
                        (long long)c->text_keys);
    int64_t rows = x->shape.d[n - 2];
    *x = dar_tensor_reshape(x, DAR_SHAPE(1, rows, c->text_width));
    while (rows > 0 && is_zero_row(x, rows - 1)) rows--;
    if (rows == 0) *x = (dar_tensor){ 0 };
    else *x = dar_tensor_of(x->dtype, DAR_SHAPE(1, rows, c->text_width), x->data);
    return DAR_OK;
}
