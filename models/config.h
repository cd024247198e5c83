/* config.h: sizes of the networks and what the paper leaves open about them, read from JSON (models/presets).
 *
 *   key                values          default  what
 *   name               text            needed   of the preset
 *
 *   dit.width          6 ..            needed   D: features of a token
 *   dit.heads          1 ..            needed   A: attention heads; D / A is even and at least 6
 *   dit.layers         1 ..            needed   L: blocks
 *   dit.ffn            1 ..            needed   F: features inside the feed-forward layer
 *   dit.latent         1 ..            48       channels of the latent, and of the velocity
 *   dit.mask           0 ..            4        mask channels beside the known video: frames in a latent frame; 0: the
 *                                               input is the noisy latent alone, as in models without known video
 *   dit.patch          1 ..            2        latent rows and columns in a token; always one frame
 *   dit.frequencies    even            256      numbers that encode the time
 *   dit.text_width     1 ..            4096     features of a text token
 *   dit.text_keys      0 ..            512      keys that cross-attention sees: shorter texts are filled up with zeros
 *   dit.rope_base      > 1             10000    the frequencies of the positions fall from 1 towards 1 / rope_base
 *   dit.eps            > 0             1e-6     of every norm
 *   dit.precondition   true | false    false    its result is added to a guess of the velocity (dar_dit_velocity)
 *
 *   adapter.rays       0 ..            24       packed ray channels; 0 with no geometry: there is no adapter
 *   adapter.geometry   0 ..            0        N: geometry channels after them
 *   adapter.unshuffle  1 ..            16       r: a token sees 2 r x 2 r pixels
 *   adapter.blocks     0 .. 8          1        residual blocks; the public weights have 1, the paper's count fits 2
 *   adapter.spread     > 0             1        fresh weights of its 2x2 convolution are those of nn.Conv2d, times this
 *   adapter.widen      copy | fresh    copy     what becomes of weights for fewer channels: copied, with zeros for the
 *                                               new ones, so that nothing changes at first; or made anew
 *
 *   vae                object          absent   of the autoencoder, whose latent has dit.latent channels
 *   vae.patch          1 .. 16         2        p: rows and columns of pixels made channels before anything else
 *   vae.multipliers    list            1 2 4 4  widths of the levels; every level but the last halves the picture
 *   vae.halve_time     list of bool    F T T    whether the step down from each level but the last halves time too
 *   vae.encoder_width  1 ..            160      times multiplier: channels of a level
 *   vae.decoder_width  1 ..            256
 *   vae.encoder_blocks 1 .. 8          2        residual blocks per level
 *   vae.decoder_blocks 1 .. 8          3
 *   vae.linear         bool            false    a linear map of every block of pixels to its latent and back, added to
 *                                               what the networks give: small ones learn the rest sooner
 *   vae.mean, vae.std  lists           0, 1     per latent channel: the transformer sees (z - mean) / std
 *
 *   taew               object          public   of the tiny decoder of the same latent, for previews
 *   taew.encoder_width 1 ..            64
 *   taew.decoder_width list of 4       256 128 64 64
 *
 *   lora.rank          0 ..            0        0: none
 *   lora.alpha         > 0             rank     the low-rank term counts alpha / rank times
 *   lora.targets       list of names   all ten  self_attn.q .k .v .o, cross_attn.q .k .v .o, ffn.0, ffn.2
 */
#ifndef DAR_MODELS_CONFIG_H
#define DAR_MODELS_CONFIG_H

#include <stdbool.h>
#include <stdint.h>

#include "lib/json.h"
#include "lib/status.h"

/* The products of a block that carry weights, in the order of the tables below. */
typedef enum dar_projection {
    DAR_SELF_Q,
    DAR_SELF_K,
    DAR_SELF_V,
    DAR_SELF_O,
    DAR_CROSS_Q,
    DAR_CROSS_K,
    DAR_CROSS_V,
    DAR_CROSS_O,
    DAR_FFN_UP,
    DAR_FFN_DOWN,
    DAR_PROJECTIONS
} dar_projection;

extern const char *const dar_projection_names[DAR_PROJECTIONS + 1]; /* "self_attn.q", ..., NULL */

#define DAR_PROJECTIONS_ALL ((1u << DAR_PROJECTIONS) - 1)

typedef struct dar_dit_config {
    int64_t width, heads, layers, ffn;
    int64_t latent, mask, patch;
    int64_t frequencies, text_width, text_keys;
    double rope_base, eps;
    bool precondition;
} dar_dit_config;

#define DAR_ADAPTER_BLOCKS 8

typedef enum dar_widen { DAR_WIDEN_COPY, DAR_WIDEN_FRESH } dar_widen;

typedef struct dar_adapter_config {
    int64_t rays, geometry, unshuffle, blocks;
    double spread;
    dar_widen widen;
} dar_adapter_config;

typedef struct dar_lora_config {
    int64_t rank;
    double alpha;
    unsigned targets; /* bits 1 << dar_projection */
} dar_lora_config;

#define DAR_VAE_LEVELS 6
#define DAR_VAE_BLOCKS 8
#define DAR_VAE_LATENT 256

typedef struct dar_vae_config {
    int levels; /* 0: there is none */
    int64_t latent, patch;
    int64_t multipliers[DAR_VAE_LEVELS];
    bool halve_time[DAR_VAE_LEVELS];
    bool linear;
    int64_t encoder_width, decoder_width, encoder_blocks, decoder_blocks;
    double mean[DAR_VAE_LATENT], std[DAR_VAE_LATENT];
} dar_vae_config;

typedef struct dar_taew_config {
    int64_t latent, encoder_width;
    int64_t decoder_width[4]; /* before the first up-sampling, after each */
} dar_taew_config;

typedef struct dar_config {
    char name[64];
    dar_dit_config dit;
    dar_adapter_config adapter;
    dar_vae_config vae;
    dar_taew_config taew;
    dar_lora_config lora;
} dar_config;

/* Read the keys above from an object.  What is wrong, a key nobody knows included, is told by dar_json_finish. */
void dar_config_read(dar_config *c, dar_json j);

/* Read a file that holds nothing else.  On failure *c is undefined. */
dar_status dar_config_open(dar_config *c, const char *path, dar_err *e);

/* Pixels per latent row and column, and frames per latent frame after the first. */
int64_t dar_vae_shrink(const dar_vae_config *c);
int64_t dar_vae_shrink_time(const dar_vae_config *c);

/* Channels of the patch embedding: noisy latent, mask, known latent. */
int64_t dar_dit_channels(const dar_dit_config *c);

#endif
