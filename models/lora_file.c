/* lora_file.c: names of low-rank additions in files; reading and writing them. */
#include "models/lora.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lib/safetensors_write.h"
#include "models/load.h"

/* ---------------------------------------------------------------- names */

/* x if s begins with what, '.' and '_' counting as one; else NULL. */
static const char *after(const char *s, const char *what)
{
    for (; *what; s++, what++) {
        bool dots = (*s == '.' || *s == '_') && (*what == '.' || *what == '_');
        if (*s != *what && !dots) return NULL;
    }
    return s;
}

static const char *skip_prefixes(const char *s)
{
    static const char *const prefix[] = { "lora_unet__", "lora_unet_",   "diffusion_model.",
                                          "pipe.dit.",   "transformer.", "base_model.model." };
    for (size_t i = 0; i < DAR_COUNT(prefix); i++) {
        size_t n = strlen(prefix[i]);
        if (strncmp(s, prefix[i], n) != 0) continue;
        s += n;
        i = (size_t)-1; /* from the first again */
    }
    return s;
}

/* What follows the name of a product, the public one or that of diffusers; NULL: s does not begin with it. */
static const char *after_product(const char *s, int64_t block, int which)
{
    char own[DAR_PARAM_NAME], other[2 * DAR_PARAM_NAME];
    snprintf(own, sizeof own, "blocks.%lld.%s.weight", (long long)block, dar_projection_names[which]);
    dar_load_diffusers_dit(own, other, sizeof other);
    own[strlen(own) - strlen(".weight")] = other[strlen(other) - strlen(".weight")] = 0;
    const char *rest = after(s, own);
    return rest ? rest : after(s, other);
}

bool dar_lora_parse(dar_lora_key *k, const char *name, int64_t layers)
{
    static const struct {
        const char *text;
        dar_lora_part part;
    } suffix[] = {
        { ".lora_down.weight", DAR_LORA_DOWN },
        { ".lora_up.weight", DAR_LORA_UP },
        { ".lora_A.weight", DAR_LORA_DOWN },
        { ".lora_B.weight", DAR_LORA_UP },
        { ".lora_A.default.weight", DAR_LORA_DOWN },
        { ".lora_B.default.weight", DAR_LORA_UP },
        { ".alpha", DAR_LORA_ALPHA },
    };
    const char *s = skip_prefixes(name), *number = after(s, "blocks.");

    if (!number || *number < '0' || *number > '9') return false;
    k->block = strtol(number, NULL, 10);
    if (k->block >= layers) return false;
    for (int i = 0; i < DAR_PROJECTIONS; i++) {
        const char *rest = after_product(s, k->block, i);
        if (!rest) continue;
        for (size_t j = 0; j < DAR_COUNT(suffix); j++) {
            if (strcmp(rest, suffix[j].text) != 0) continue;
            k->projection = (dar_projection)i;
            k->part = suffix[j].part;
            return true;
        }
    }
    return false;
}

void dar_lora_module(char *name, size_t size, int64_t block, dar_projection which)
{
    snprintf(name, size, "lora_unet__blocks_%lld_%s", (long long)block, dar_projection_names[which]);
    for (char *c = name; *c; c++)
        if (*c == '.') *c = '_';
}

/* ---------------------------------------------------------------- reading */

/* What a file says about one product. */
struct found {
    const dar_weight *part[3]; /* NULL: nothing */
};

static dar_status collect(struct found *found, int64_t layers, dar_weights *f, dar_err *e)
{
    for (size_t i = 0; i < dar_weights_count(f); i++) {
        const dar_weight *x = dar_weights_at(f, i);
        dar_lora_key k;
        if (!dar_lora_parse(&k, x->name, layers))
            return dar_fail(e, DAR_ERR_FORMAT,
                            "%s: %s: expected the low-rank addition of a product of blocks 0 to %lld", x->file, x->name,
                            (long long)layers - 1);
        const dar_weight **part = &found[k.block * DAR_PROJECTIONS + k.projection].part[k.part];
        if (*part) return dar_fail(e, DAR_ERR_FORMAT, "%s: %s and %s mean the same", x->file, (*part)->name, x->name);
        *part = x;
    }
    return DAR_OK;
}

static dar_status wrong_shape(const dar_weight *w, const dar_tensor *x, dar_shape want, dar_err *e)
{
    char found[96], expected[96];
    return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: found %s, expected %s", w->file, w->name,
                    dar_shape_text(&x->shape, found, sizeof found), dar_shape_text(&want, expected, sizeof expected));
}

static dar_status read_product(dar_dit *m, dar_params *p, int64_t index, const struct found *in, dar_weights *f,
                               const dar_lora_read_options *o, dar_err *e)
{
    int64_t block = index / DAR_PROJECTIONS;
    dar_projection which = (dar_projection)(index % DAR_PROJECTIONS);
    dar_dit_product *q = &m->block[block].product[which];
    const int64_t *d = q->w->x.shape.d; /* out, in */
    const dar_weight *const *w = in->part, *any = w[0] ? w[0] : w[1] ? w[1] : w[2];
    dar_tensor down, up, alpha;

    if (!w[DAR_LORA_DOWN] || !w[DAR_LORA_UP])
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found %s alone, expected both factors", any->file, any->name);
    DAR_TRY(dar_weights_tensor(f, w[DAR_LORA_DOWN]->name, &down, e));
    DAR_TRY(dar_weights_tensor(f, w[DAR_LORA_UP]->name, &up, e));
    int64_t rank = q->down ? q->down->x.shape.d[0] : down.shape.d[0];
    dar_shape want[] = { DAR_SHAPE(rank, d[1]), DAR_SHAPE(d[0], rank) };
    if (!dar_shape_equal(&down.shape, &want[0])) return wrong_shape(w[DAR_LORA_DOWN], &down, want[0], e);
    if (!dar_shape_equal(&up.shape, &want[1])) return wrong_shape(w[DAR_LORA_UP], &up, want[1], e);

    double a = o->alpha > 0 ? o->alpha : (double)rank;
    if (w[DAR_LORA_ALPHA]) {
        DAR_TRY(dar_weights_tensor(f, w[DAR_LORA_ALPHA]->name, &alpha, e));
        if (dar_tensor_count(&alpha) != 1) return wrong_shape(w[DAR_LORA_ALPHA], &alpha, (dar_shape){ 0 }, e);
        a = dar_dtype_get(alpha.dtype, alpha.data, 0);
        if (!isfinite(a))
            return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: found %g, expected a number", any->file,
                            w[DAR_LORA_ALPHA]->name, a);
    }
    if (!q->down) dar_lora_declare(m, p, block, which, rank);
    q->scale = o->strength * a / (double)rank;
    dar_param_bind(p, q->down, &down);
    dar_param_bind(p, q->up, &up);
    return DAR_OK;
}

dar_status dar_lora_read(dar_dit *m, dar_params *p, dar_weights *f, const dar_lora_read_options *o, dar_err *e)
{
    int64_t n = m->c.layers * DAR_PROJECTIONS;
    struct found *found = calloc((size_t)n, sizeof *found);
    dar_status s = found ? collect(found, m->c.layers, f, e) : dar_fail(e, DAR_ERR_NOMEM, "lora: out of memory");

    for (int64_t i = 0; s == DAR_OK && i < n; i++)
        if (found[i].part[0] || found[i].part[1] || found[i].part[2]) s = read_product(m, p, i, &found[i], f, o, e);
    free(found);
    return s;
}

/* ---------------------------------------------------------------- writing */

struct written {
    char name[DAR_PARAM_NAME];
    float alpha;
};

dar_status dar_lora_write(const dar_dit *m, const char *path, dar_err *e)
{
    size_t n = 0, most = (size_t)m->c.layers * DAR_PROJECTIONS;
    dar_safetensors_item *item = calloc(3 * most, sizeof *item);
    struct written *alpha = calloc(most, sizeof *alpha);
    const char *const meta[] = { "format", "pt", NULL };
    char module[DAR_PARAM_NAME - sizeof ".alpha"];
    dar_status s;

    for (size_t i = 0; item && alpha && i < most; i++) {
        const dar_dit_product *q = &m->block[i / DAR_PROJECTIONS].product[i % DAR_PROJECTIONS];
        if (!q->down) continue;
        dar_lora_module(module, sizeof module, (int64_t)(i / DAR_PROJECTIONS), (dar_projection)(i % DAR_PROJECTIONS));
        snprintf(alpha[i].name, sizeof alpha[i].name, "%s.alpha", module);
        alpha[i].alpha = (float)(q->scale * (double)q->down->x.shape.d[0]);
        item[n++] = (dar_safetensors_item){ q->down->name, q->down->x };
        item[n++] = (dar_safetensors_item){ q->up->name, q->up->x };
        item[n++] = (dar_safetensors_item){ alpha[i].name, dar_tensor_of(DAR_F32, (dar_shape){ 0 }, &alpha[i].alpha) };
    }
    if (!item || !alpha) s = dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    else s = dar_safetensors_write(path, item, n, &(dar_safetensors_options){ .meta = meta }, e);
    free(item);
    free(alpha);
    return s;
}
