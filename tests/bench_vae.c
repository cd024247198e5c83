/* bench_vae.c: rows of the autoencoder (models/vae.h): a piece in the middle of a stream, decoded and encoded. */
#include "tests/bench.h"

#include "lib/status.h"
#include "models/vae.h"

/* Sizes of a row: width of the decoder, latent rows and columns.  All else is as in the public network. */
struct state {
    dar_params p;
    dar_vae v;
    dar_arena kept;
    dar_vae_stream encoder, decoder;
    dar_tensor x, z;
};

static void decode(bench *b)
{
    struct state *s = b->state;
    DAR_ASSERT(dar_vae_decode_next(&s->decoder, &b->tape, dar_leaf(&b->tape, s->z, NULL), NULL, NULL, NULL) == DAR_OK,
               "vae: it failed");
}

static void encode(bench *b)
{
    struct state *s = b->state;
    int64_t frames = s->encoder.pieces ? s->x.shape.d[2] : 1;
    dar_tensor x = dar_tensor_narrow(&s->x, 2, 0, frames);
    dar_vae_encode_next(&s->encoder, &b->tape, dar_contiguous(&b->tape, dar_leaf(&b->tape, x, NULL)));
}

static void make(struct state *s, const bench *b)
{
    dar_config c;
    dar_err e;
    DAR_ASSERT(dar_config_open(&c, "models/presets/wan22-fun-5b.json", &e) == DAR_OK, "%s", e.text);
    c.vae.decoder_width = b->s[0];
    c.vae.encoder_width = b->s[0] * 5 / 8;
    if (!s->kept.base) DAR_ASSERT(dar_arena_init(&s->kept, "kept", (size_t)1 << 30, &e) == DAR_OK, "%s", e.text);
    dar_arena_reset(&s->kept, 0);
    dar_params_free(&s->p); /* of the row before */
    dar_params_init(&s->p, b->arena, b->row->type);
    dar_vae_init(&s->v, &s->p, &c.vae);
    dar_params_fresh(&s->p, DAR_PARAM_ALL, 1);
    dar_vae_fold(&s->v, b->arena);
}

/* Two pieces of each stream: all that will be kept is there.  The work of a piece is that of the second. */
static void setup(bench *b)
{
    static struct state only;
    static void (*const run[])(bench *) = { decode, encode };
    struct state *s = b->state = &only;
    dar_err e;

    make(s, b);
    s->x = bench_tensor(b, s->p.main, DAR_SHAPE(1, 3, 4, 16 * b->s[1], 16 * b->s[2]));
    s->z = bench_tensor(b, s->p.main, DAR_SHAPE(1, s->v.c.latent, 1, b->s[1], b->s[2]));
    DAR_ASSERT(dar_tape_init(&b->tape, b->arena, &e) == DAR_OK, "%s", e.text);
    b->tape.recording = false;
    b->mark = dar_arena_mark(b->arena);
    dar_vae_stream_init(&s->decoder, &s->v, DAR_VAE_DECODER, &s->kept);
    dar_vae_stream_init(&s->encoder, &s->v, DAR_VAE_ENCODER, &s->kept);
    s->encoder.skip = false;
    for (int i = 0; i < 2 * BENCH_PARTS; i++) {
        run[i / 2](b);
        b->flops[i / 2] = b->tape.cost.forward;
        bench_op_reset(b);
    }
}

static const bench_kind pieces = {
    .part = { "vae_decode", "vae_encode" }, .setup = setup, .run = { decode, encode }, .reset = bench_op_reset
};

const bench_row bench_vae_rows[] = {
    { &pieces, DAR_F32, { 32, 8, 14 }, BENCH_F32, { 0 }, false }, /* of a small model, 128 x 224 */
    { &pieces, DAR_BF16, { 32, 8, 14 }, BENCH_BF16, { 0 }, false },
    { &pieces, DAR_F32, { 256, 4, 7 }, BENCH_F32, { 0 }, false }, /* the public one, a part of a picture */
    { &pieces, DAR_BF16, { 256, 4, 7 }, BENCH_BF16, { 0 }, false },
};
const size_t bench_n_vae_rows = DAR_COUNT(bench_vae_rows);
