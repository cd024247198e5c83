/* fuzz_lora.c: any bytes as a safetensors file of low-rank additions to a network of one block. */
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "models/lora.h"
#include "tests/fuzz_weights.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

/* What is accepted is finite in its scale, and can be used: merged. */
static void check_product(const dar_dit_product *q)
{
    if (!q->down) return;
    int64_t rank = q->down->x.shape.d[0];
    DAR_ASSERT(rank > 0 && isfinite(q->scale), "rank %lld, scale %g", (long long)rank, q->scale);
    DAR_ASSERT(q->up->x.data && q->up->x.shape.d[1] == rank, "half an addition");
}

static void read_additions(const uint8_t *data, size_t size)
{
    static const dar_dit_config config = {
        .width = 8, .heads = 1, .layers = 1, .ffn = 5, .latent = 1, .patch = 1, .frequencies = 2, .text_width = 3
    };
    static dar_arena arena, scratch;
    dar_lora_read_options o = { .strength = 0.5 };
    dar_weights *w;
    dar_params p;
    dar_dit m;
    dar_err e = { "" };

    if (dar_weights_parse(&w, "fuzz", data, size, &e) != DAR_OK) return;
    if (!arena.base) {
        DAR_ASSERT(dar_arena_init(&arena, "weights", 1 << 20, &e) == DAR_OK, "%s", e.text);
        DAR_ASSERT(dar_arena_init(&scratch, "merging", 1 << 20, &e) == DAR_OK, "%s", e.text);
    }
    dar_params_init(&p, &arena, DAR_F32);
    dar_dit_init(&m, &p, &config, &(dar_adapter_config){ .unshuffle = 1 });
    dar_params_fresh(&p, DAR_PARAM_BASE, 1);
    if (dar_lora_read(&m, &p, w, &o, &e) != DAR_OK) {
        check_line(&e);
    } else {
        for (int k = 0; k < DAR_PROJECTIONS; k++) check_product(&m.block[0].product[k]);
        dar_lora_merge(&m, &p, &scratch);
    }
    dar_dit_free(&m);
    dar_params_free(&p);
    dar_arena_reset(&arena, 0);
    dar_weights_close(w);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    if (size <= 4096) read_additions(data, size); /* more would not fit into its memory */
    return 0;
}
