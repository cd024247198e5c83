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
    c->rope_base = dar_json_number(j, "rope_base", 10000, 1, 1e9);
    c->eps = dar_json_number(j, "eps", 1e-6, 1e-30, 1);
    c->precondition = dar_json_bool(j, "precondition", false);
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
    c->spread = dar_json_number(j, "spread", 1, 1e-6, 1e6);
    c->widen = (dar_widen)dar_json_choice(j, "widen", DAR_WIDEN_COPY, widen);
}

/* Numbers of a list that may be shorter than `most`; *n is their count. */
static void read_list(dar_json j, const char *key, int most, int *n, int64_t *out)
{
    dar_json list = dar_json_get(j, key);
    if (!list.item) return;
    *n = 0;
    for (dar_json x = dar_json_first(list); x.item; x = dar_json_next(x)) {
        int64_t value = dar_json_int(x, NULL, DAR_JSON_NEEDED, 1, MOST);
        if (*n < most) out[*n] = value < 1 ? 1 : value;
        ++*n;
    }
    if (*n < 1 || *n > most) dar_json_reject(j, key, "1 to %d numbers", most);
}

/* Shortcuts join levels of any widths whose channels, with those of the pixels that become one, make equal groups. */
static bool shortcuts_fit(const dar_vae_config *c)
{
    for (int i = 0; i < c->levels; i++) {
        int64_t before = i ? c->multipliers[i - 1] : 1, here = c->multipliers[i];
        bool halves = i < c->levels - 1;
        if ((halves || here != before) && before * (halves ? 4 << c->halve_time[i] : 1) % here) return false;
        if (i && here * (4 << c->halve_time[i - 1]) % c->multipliers[i < c->levels - 1 ? i + 1 : i]) return false;
    }
    return true;
}

static void read_vae(dar_vae_config *c, dar_json j, int64_t latent)
{
    static const int64_t multipliers[] = { 1, 2, 4, 4 };
    static const bool halve_time[] = { false, true, true };
    if (!j.item) return;

    int levels = DAR_COUNT(multipliers), i = 0;
    memcpy(c->multipliers, multipliers, sizeof multipliers);
    memcpy(c->halve_time, halve_time, sizeof halve_time);
    read_list(j, "multipliers", DAR_VAE_LEVELS, &levels, c->multipliers);
    c->levels = levels < 1 ? 1 : levels > DAR_VAE_LEVELS ? DAR_VAE_LEVELS : levels;
    dar_json halve = dar_json_get(j, "halve_time");
    for (dar_json x = dar_json_first(halve); x.item; x = dar_json_next(x), i++)
        c->halve_time[i < DAR_VAE_LEVELS ? i : 0] = dar_json_bool(x, NULL, false);
    if ((halve.item ? i : (int)DAR_COUNT(halve_time)) != c->levels - 1)
        dar_json_reject(j, "halve_time", "one value less than multipliers");
    else if (!shortcuts_fit(c))
        dar_json_reject(j, "multipliers",
                        "of two neighbours, each to divide 8 times the other (4 times where time is not halved), the "
                        "last the one before");
    c->patch = dar_json_int(j, "patch", 2, 1, 16);
    c->encoder_width = dar_json_int(j, "encoder_width", 160, 1, MOST);
    c->decoder_width = dar_json_int(j, "decoder_width", 256, 1, MOST);
    c->encoder_blocks = dar_json_int(j, "encoder_blocks", 2, 1, DAR_VAE_BLOCKS);
    c->decoder_blocks = dar_json_int(j, "decoder_blocks", 3, 1, DAR_VAE_BLOCKS);

    c->linear = dar_json_bool(j, "linear", false);
    if (c->linear && dar_vae_shrink_time(c) > 8)
        dar_json_reject(j, "linear", "false where more than 8 frames become one");
    c->latent = latent;
    for (i = 0; i < DAR_VAE_LATENT; i++) c->mean[i] = 0, c->std[i] = 1;
    if (latent > DAR_VAE_LATENT) {
        dar_json_reject(j, NULL, "dit.latent of at most %d", DAR_VAE_LATENT);
        return;
    }
    dar_json_numbers(j, "mean", c->mean, (size_t)latent);
    dar_json_numbers(j, "std", c->std, (size_t)latent);
    for (i = 0; i < (int)latent; i++)
        if (!(c->std[i] > 0)) dar_json_reject(j, "std", "numbers above 0");
}

int64_t dar_vae_shrink(const dar_vae_config *c)
{
    return c->patch << (c->levels - 1);
}

int64_t dar_vae_shrink_time(const dar_vae_config *c)
{
    int64_t n = 1;
    for (int i = 0; i < c->levels - 1; i++) n <<= c->halve_time[i];
    return n;
}

static void read_taew(dar_taew_config *c, dar_json j, int64_t latent)
{
    int n = 4;
    *c = (dar_taew_config){ .latent = latent, .decoder_width = { 256, 128, 64, 64 } };
    c->encoder_width = dar_json_int(j, "encoder_width", 64, 1, MOST);
    read_list(j, "decoder_width", 4, &n, c->decoder_width);
    if (n != 4) dar_json_reject(j, "decoder_width", "4 numbers");
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
    read_vae(&c->vae, dar_json_get(j, "vae"), c->dit.latent);
    read_taew(&c->taew, dar_json_object(j, "taew"), c->dit.latent);
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
