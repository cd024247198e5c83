/* config.c: see config.h. */
#include "models/config.h"

#include <stdio.h>
#include <string.h>

#define MOST ((int64_t)1 << 20) /* no size of a network is larger */

const char *const dar_projection_names[] = {
    "self_attn.q",  "self_attn.k", "self_attn.v", "self_attn.o", "cross_attn.q", "cross_attn.k", "cross_attn.v",
    "cross_attn.o", "ffn.0",       "ffn.2",       NULL
};

int64_t dar_dit_channels(const dar_dit_config *c)
{
    return c->mask ? 2 * c->latent + c->mask : c->latent;
}

static void read_dit(dar_dit_config *c, dar_json j)
{
    c->width = dar_json_int(j, "width", DAR_JSON_NEEDED, 6, MOST);
    c->heads = dar_json_int(j, "heads", DAR_JSON_NEEDED, 1, MOST);
    c->layers = dar_json_int(j, "layers", DAR_JSON_NEEDED, 1, 4096);
    c->ffn = dar_json_int(j, "ffn", DAR_JSON_NEEDED, 1, MOST);
    c->latent = dar_json_int(j, "latent", 48, 1, MOST);
    c->mask = dar_json_int(j, "mask", 4, 0, MOST);
    c->patch = dar_json_int(j, "patch", 2, 1, 64);
    c->frequencies = dar_json_int(j, "frequencies", 256, 2, MOST);
    c->text_width = dar_json_int(j, "text_width", 4096, 1, MOST);
    c->text_keys = dar_json_int(j, "text_keys", 512, 0, MOST);
    c->eps = dar_json_number(j, "eps", 1e-6, 1e-30, 1);
    if (c->heads > 0 && (c->width % c->heads || c->width / c->heads < 6 || c->width / c->heads % 2))
        dar_json_reject(j, "heads", "a count whose share of %lld features is even and at least 6", (long long)c->width);
    if (c->frequencies % 2) dar_json_reject(j, "frequencies", "an even number");
}

static void read_adapter(dar_adapter_config *c, dar_json j)
{
    static const char *const widen[] = { "copy", "fresh", NULL };
    c->rays = dar_json_int(j, "rays", 24, 0, MOST);
    c->geometry = dar_json_int(j, "geometry", 0, 0, MOST);
    c->unshuffle = dar_json_int(j, "unshuffle", 16, 1, 256);
    c->blocks = dar_json_int(j, "blocks", 1, 0, DAR_ADAPTER_BLOCKS);
    c->widen = (dar_widen)dar_json_choice(j, "widen", DAR_WIDEN_COPY, widen);
}

static unsigned read_targets(dar_json j)
{
    dar_json list = dar_json_get(j, "targets");
    unsigned targets = 0;

    if (!list.item) return DAR_PROJECTIONS_ALL;
    for (dar_json x = dar_json_first(list); x.item; x = dar_json_next(x)) {
        int i = dar_json_choice(x, NULL, -1, dar_projection_names);
        if (i >= 0) targets |= 1u << i;
    }
    return targets;
}

static void read_lora(dar_lora_config *c, dar_json j)
{
    c->rank = dar_json_int(j, "rank", 0, 0, MOST);
    c->alpha = dar_json_number(j, "alpha", c->rank > 0 ? (double)c->rank : 1, 1e-30, 1e30);
    c->targets = read_targets(j);
}

void dar_config_read(dar_config *c, dar_json j)
{
    memset(c, 0, sizeof *c);
    const char *name = dar_json_text(j, "name", NULL);
    snprintf(c->name, sizeof c->name, "%s", name ? name : "");
    read_dit(&c->dit, dar_json_object(j, "dit"));
    read_adapter(&c->adapter, dar_json_object(j, "adapter"));
    read_lora(&c->lora, dar_json_object(j, "lora"));
}

dar_status dar_config_open(dar_config *c, const char *path, dar_err *e)
{
    dar_json_doc *doc;
    DAR_TRY(dar_json_open(&doc, path, e));
    dar_config_read(c, dar_json_root(doc));
    dar_status s = dar_json_finish(doc, e);
    dar_json_close(doc);
    return s;
}
