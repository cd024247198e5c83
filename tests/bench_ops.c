/* bench_ops.c: rows of ops, forward and backward, as a network calls them. */
#include "tests/bench.h"

#include "lib/status.h"

/* ---------------------------------------------------------------- elementwise */

static void one(bench *b)
{
    bench_input(b, b->row->type, DAR_SHAPE(b->s[0], b->s[1]), true);
}

static dar_val *call_silu(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_silu(t, x[0]);
}

static dar_val *call_gelu_tanh(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_gelu_tanh(t, x[0]);
}

static dar_val *call_relu(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_relu(t, x[0]);
}

static const bench_kind silu = { BENCH_OP(silu), .inputs = one, .call = call_silu };
static const bench_kind gelu_tanh = { BENCH_OP(gelu_tanh), .inputs = one, .call = call_gelu_tanh };
static const bench_kind relu = { BENCH_OP(relu), .inputs = one, .call = call_relu };

static void two(bench *b)
{
    one(b);
    one(b);
}

static dar_val *call_add(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_add(t, x[0], x[1]);
}

static dar_val *call_mul(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_mul(t, x[0], x[1]);
}

static dar_val *call_affine(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_affine(t, x[0], 0.7, 0.3);
}

static const bench_kind add = { BENCH_OP(add), .inputs = two, .call = call_add };
static const bench_kind mul = { BENCH_OP(mul), .inputs = two, .call = call_mul };
static const bench_kind affine = { BENCH_OP(affine), .inputs = one, .call = call_affine };

/* ---------------------------------------------------------------- reductions */

static dar_val *call_softmax(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_softmax(t, x[0], NULL);
}

static dar_val *call_mean(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_mean(t, x[0], DAR_ALL_DIMS, false);
}

static dar_val *call_sum(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_sum(t, x[0], 1, false); /* as the gradient of a bias */
}

static void prediction_target(bench *b)
{
    one(b);
    bench_input(b, b->row->type, DAR_SHAPE(b->s[0], b->s[1]), false);
}

static dar_val *call_squared_error(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_squared_error(t, x[0], x[1], NULL, true);
}

static const bench_kind softmax = { BENCH_OP(softmax), .inputs = one, .call = call_softmax };
static const bench_kind mean = { BENCH_OP(mean), .inputs = one, .call = call_mean };
static const bench_kind sum = { BENCH_OP(sum), .inputs = one, .call = call_sum };
static const bench_kind squared_error = { BENCH_OP(squared_error), .inputs = prediction_target,
                                          .call = call_squared_error };

/* ---------------------------------------------------------------- norms: tokens, width */

static void tokens_and_vectors(bench *b, int vectors)
{
    bench_input(b, b->row->type, DAR_SHAPE(1, b->s[0], b->s[1]), true);
    for (int i = 0; i < vectors; i++) bench_input(b, DAR_F32, DAR_SHAPE(b->s[1]), true);
}

static void tokens_weight(bench *b)
{
    tokens_and_vectors(b, 1);
}

static void tokens_weight_bias(bench *b)
{
    tokens_and_vectors(b, 2);
}

static void tokens_rows(bench *b)
{
    bench_input(b, b->row->type, DAR_SHAPE(1, b->s[0], b->s[1]), true);
    for (int i = 0; i < 2; i++) bench_input(b, DAR_F32, DAR_SHAPE(1, 2, b->s[1]), true);
}

static const dar_norm_opt norm_opt = { .eps = 1e-6, .split = 390 }; /* tokens of a first frame of 240 x 416 */

static dar_val *call_rms_norm(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_rms_norm(t, x[0], x[1], &norm_opt);
}

static dar_val *call_layer_norm(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_layer_norm(t, x[0], x[1], x[2], &norm_opt);
}

static dar_val *call_modulate(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_modulate(t, x[0], x[1], x[2], &norm_opt);
}

static const bench_kind rms_norm = { BENCH_OP(rms_norm), .inputs = tokens_weight, .call = call_rms_norm };
static const bench_kind layer_norm = { BENCH_OP(layer_norm), .inputs = tokens_weight_bias, .call = call_layer_norm };
static const bench_kind modulate = { BENCH_OP(modulate), .inputs = tokens_rows, .call = call_modulate };

static void residual(bench *b)
{
    for (int i = 0; i < 2; i++) bench_input(b, b->row->type, DAR_SHAPE(1, b->s[0], b->s[1]), true);
    bench_input(b, DAR_F32, DAR_SHAPE(1, 2, b->s[1]), true);
}

static dar_val *call_gate(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_gate(t, x[0], x[1], x[2], (dar_gate_attr){ .split = norm_opt.split });
}

/* Channels, height, width. */
static void picture(bench *b)
{
    bench_input(b, b->row->type, DAR_SHAPE(1, b->s[0], b->s[1], b->s[2]), true);
    bench_input(b, DAR_F32, DAR_SHAPE(b->s[0]), true);
}

static dar_val *call_channel_norm(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_channel_norm(t, x[0], x[1]);
}

/* Tokens, heads, head size. */
static void tokens_angles(bench *b)
{
    bench_input(b, b->row->type, DAR_SHAPE(1, b->s[0], b->s[1] * b->s[2]), true);
    bench_input(b, DAR_F32, DAR_SHAPE(b->s[0], b->s[2]), false);
    dar_rope_table(&b->x[1], b->s[0] / 512, 16, 32, 10000);
}

static dar_val *call_rope(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_rope(t, x[0], x[1]);
}

static const bench_kind gate = { BENCH_OP(gate), .inputs = residual, .call = call_gate };
static const bench_kind channel_norm = { BENCH_OP(channel_norm), .inputs = picture, .call = call_channel_norm };
static const bench_kind rope = { BENCH_OP(rope), .inputs = tokens_angles, .call = call_rope };

/* ---------------------------------------------------------------- shape: heads to the front, a slice, a concatenation
 */

static void heads(bench *b)
{
    bench_input(b, b->row->type, DAR_SHAPE(b->s[0], b->s[1], b->s[2]), true);
}

static dar_val *call_permute(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_contiguous(t, dar_permute(t, x[0], (int[]){ 1, 0, 2 }));
}

static dar_val *call_transpose(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_contiguous(t, dar_permute(t, x[0], (int[]){ 1, 0 }));
}

static const bench_kind permute = { .part = { "permute" },
                                    .setup = bench_op_setup,
                                    .run = { bench_op_forward },
                                    .reset = bench_op_reset,
                                    .op = &dar_op_contiguous,
                                    .inputs = heads,
                                    .call = call_permute };
static const bench_kind transpose = { .part = { "transpose" },
                                      .setup = bench_op_setup,
                                      .run = { bench_op_forward },
                                      .reset = bench_op_reset,
                                      .op = &dar_op_contiguous,
                                      .inputs = one,
                                      .call = call_transpose };

/* Channels of two clips, frames, height, width: skip connections, and what the condition is made of. */
static void two_clips(bench *b)
{
    for (int i = 0; i < 2; i++) bench_input(b, b->row->type, DAR_SHAPE(1, b->s[i], b->s[2], b->s[3], b->s[4]), true);
}

static dar_val *call_concat(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_concat(t, x, 2, 1);
}

static const bench_kind concat = { BENCH_OP(concat), .inputs = two_clips, .call = call_concat };

/* ---------------------------------------------------------------- pixels and frames to channels and back: channels,
 * frames, height, width of x; then the factor in space, or channels of y and the factor in time beside 2 in space */

static void one_clip(bench *b)
{
    bench_input(b, b->row->type, DAR_SHAPE(1, b->s[0], b->s[1], b->s[2], b->s[3]), true);
}

static dar_val *call_unshuffle(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    return dar_pixel_unshuffle(t, x[0], (int)s[4], DAR_PIXELS_ROWS);
}

static dar_val *call_patchify(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    return dar_pixel_unshuffle(t, x[0], (int)s[4], DAR_PIXELS_COLUMNS);
}

static dar_val *call_avg_down(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    return dar_avg_down(t, x[0], s[4], (int)s[5], 2);
}

static dar_val *call_dup_up(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    return dar_dup_up(t, x[0], s[4], (int)s[5], 2, 0);
}

#define RESAMPLE(name, of)                                                                                             \
    {                                                                                                                  \
        .part = { #name, #name "_back" }, .setup = bench_op_setup, .run = { bench_op_forward, bench_op_backward },     \
        .reset = bench_op_reset, .op = &dar_op_##of, .inputs = one_clip, .call = call_##name                           \
    }
static const bench_kind unshuffle = RESAMPLE(unshuffle, resample_down);
static const bench_kind patchify = RESAMPLE(patchify, resample_down);
static const bench_kind avg_down = RESAMPLE(avg_down, resample_down);
static const bench_kind dup_up = RESAMPLE(dup_up, resample_up);

/* ---------------------------------------------------------------- linear layers: tokens, outputs, inputs, rank */

static void layer(bench *b)
{
    bench_input(b, b->row->type, DAR_SHAPE(b->s[0], b->s[2]), true);
    bench_input(b, b->row->type, DAR_SHAPE(b->s[1], b->s[2]), true);
    bench_input(b, b->row->type, DAR_SHAPE(b->s[1]), true);
}

static dar_val *call_linear(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_linear(t, x[0], x[1], x[2], &(dar_linear_opt){ .act = DAR_ACT_GELU_TANH });
}

/* Base weights frozen, as they are in training. */
static void layer_with_rank(bench *b)
{
    bench_input(b, b->row->type, DAR_SHAPE(b->s[0], b->s[2]), true);
    bench_input(b, b->row->type, DAR_SHAPE(b->s[1], b->s[2]), false);
    bench_input(b, b->row->type, DAR_SHAPE(b->s[1]), false);
    bench_input(b, DAR_F32, DAR_SHAPE(b->s[3], b->s[2]), true);
    bench_input(b, DAR_F32, DAR_SHAPE(b->s[1], b->s[3]), true);
}

static dar_val *call_lora(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_lora(t, x[0], x[1], x[2], x[3], x[4], 1, NULL);
}

static const bench_kind linear_gelu = { BENCH_OP(linear), .inputs = layer, .call = call_linear };
static const bench_kind lora = { BENCH_OP(lora), .inputs = layer_with_rank, .call = call_lora };

/* ---------------------------------------------------------------- attention: tokens, heads, head size */

static void queries_keys_values(bench *b)
{
    for (int i = 0; i < 3; i++) bench_input(b, b->row->type, DAR_SHAPE(1, b->s[0], b->s[1] * b->s[2]), true);
}

static dar_val *call_attention(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    return dar_attention(t, x[0], x[1], x[2], &(dar_attention_opt){ .heads = s[1] });
}

static const bench_kind attention = { BENCH_OP(attention), .inputs = queries_keys_values, .call = call_attention };

/* ---------------------------------------------------------------- convolution: Cin, Cout, T, H, W, history */

static void frames(bench *b)
{
    bench_input(b, b->row->type, DAR_SHAPE(1, b->s[0], b->s[2], b->s[3], b->s[4]), true);
    bench_input(b, b->row->type, DAR_SHAPE(b->s[1], b->s[0], 3, 3), true);
    bench_input(b, b->row->type, DAR_SHAPE(b->s[1]), true);
}

static void clip(bench *b)
{
    bench_input(b, b->row->type, DAR_SHAPE(1, b->s[0], b->s[2], b->s[3], b->s[4]), true);
    bench_input(b, b->row->type, DAR_SHAPE(b->s[1], b->s[0], 3, 3, 3), true);
    bench_input(b, b->row->type, DAR_SHAPE(b->s[1]), true);
    if (b->s[5]) bench_input(b, b->row->type, DAR_SHAPE(1, b->s[0], b->s[5], b->s[3], b->s[4]), false);
}

static dar_val *call_conv2d(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    (void)s;
    return dar_conv2d(t, x[0], x[1], x[2], dar_conv_same(x[1]));
}

static dar_val *call_conv3d(dar_tape *t, dar_val *const *x, const int64_t *s)
{
    return dar_conv3d(t, x[0], x[1], x[2], s[5] ? x[3] : NULL, dar_conv_same(x[1]));
}

static const bench_kind conv2d = { BENCH_OP(conv2d), .inputs = frames, .call = call_conv2d };
static const bench_kind conv3d = { BENCH_OP(conv3d), .inputs = clip, .call = call_conv3d };

/* ---------------------------------------------------------------- rows */

/* In the two types that networks use.  Memory-bound rows are larger than the caches; PLAIN: without a bar. */
#define BOTH(kind, peak_f32, peak_bf16, bar, bar_back, ...)                                                            \
    { &kind, DAR_F32, { __VA_ARGS__ }, peak_f32, { bar, bar_back }, false },                                           \
    {                                                                                                                  \
        &kind, DAR_BF16, { __VA_ARGS__ }, peak_bf16, { bar, bar_back }, false                                          \
    }
#define ATTN(...)         BOTH(attention, BENCH_F32, BENCH_BF16, 0.80, 0.68, __VA_ARGS__)
#define CONV(kind, ...)   BOTH(kind, BENCH_F32, BENCH_BF16, 0.70, 0.70, __VA_ARGS__)
#define DECODE(...)       BOTH(conv3d, BENCH_F32, BENCH_BF16, 0.70, 0, __VA_ARGS__) /* never trained */
#define LINEAR(kind, ...) BOTH(kind, BENCH_F32, BENCH_BF16, 0, 0, __VA_ARGS__)
#define STREAM(kind, ...) BOTH(kind, BENCH_COPY, BENCH_COPY, 0.80, 0.80, __VA_ARGS__)
#define PLAIN(kind, ...)  BOTH(kind, BENCH_COPY, BENCH_COPY, 0, 0, __VA_ARGS__)

const bench_row bench_op_rows[] = {
    LINEAR(linear_gelu, 2048, 1536, 384),
    LINEAR(linear_gelu, 2048, 3072, 3072),
    LINEAR(lora, 2048, 384, 384, 32),
    LINEAR(lora, 2048, 3072, 3072, 32),
    LINEAR(lora, 2048, 3072, 3072, 256),

    ATTN(1536, 6, 64),
    ATTN(2048, 24, 128),
    ATTN(8192, 24, 128),
    BOTH(attention, BENCH_F32, BENCH_BF16, 0, 0, 1560, 1, 1024), /* the VAE's, one frame of 480 x 832 */

    CONV(conv2d, 384, 384, 5, 8, 14),       /* adapter, small model */
    CONV(conv2d, 3072, 3072, 1, 15, 26),    /* adapter */
    CONV(conv2d, 1024, 1024, 1, 32, 56),    /* VAE decoder, up-sampling */
    DECODE(48, 1024, 1, 8, 14, 2),          /* VAE decoder, a latent frame of 128 x 224: first */
    DECODE(1024, 1024, 1, 8, 14, 2),        /* first stage */
    CONV(conv3d, 1024, 1024, 2, 16, 28, 2), /* second */
    CONV(conv3d, 512, 512, 2, 32, 56, 2),   /* third */
    CONV(conv3d, 256, 256, 1, 64, 112, 2),  /* fourth */
    DECODE(256, 256, 1, 240, 416, 2),       /* of 480 x 832: fourth */
    DECODE(256, 12, 1, 240, 416, 2),        /* last */
    CONV(conv3d, 12, 160, 4, 64, 112),      /* VAE encoder, first */
    CONV(conv3d, 160, 160, 4, 64, 112),     /* first stage */

    STREAM(rms_norm, 8192, 3072),
    STREAM(layer_norm, 8192, 3072),
    STREAM(modulate, 8192, 3072),
    STREAM(gate, 8192, 3072),
    STREAM(channel_norm, 256, 256, 448),
    STREAM(rope, 8192, 24, 128),
    STREAM(silu, 8192, 3072),
    STREAM(gelu_tanh, 8192, 3072),
    STREAM(relu, 8192, 3072),
    PLAIN(add, 8192, 3072),
    PLAIN(mul, 8192, 3072),
    PLAIN(affine, 8192, 3072),
    PLAIN(softmax, 8192, 3072),
    PLAIN(mean, 8192, 3072),
    PLAIN(sum, 8192, 3072),
    PLAIN(squared_error, 8192, 3072),
    PLAIN(permute, 8192, 24, 128),
    PLAIN(transpose, 8192, 3072),
    PLAIN(concat, 128, 128, 4, 128, 224),

    PLAIN(unshuffle, 24, 4, 512, 896, 16), /* adapter */
    PLAIN(unshuffle, 24, 4, 512, 896, 8),
    PLAIN(patchify, 3, 17, 512, 896, 2),       /* VAE encoder */
    PLAIN(avg_down, 160, 4, 256, 448, 320, 1), /* VAE encoder, first stage */
    PLAIN(avg_down, 320, 4, 128, 224, 640, 2), /* second */
    PLAIN(avg_down, 640, 4, 64, 112, 640, 2),  /* third */
    PLAIN(dup_up, 1024, 4, 32, 56, 1024, 2),   /* VAE decoder, first and second stage */
    PLAIN(dup_up, 1024, 4, 64, 112, 512, 1),   /* third */
};
const size_t bench_n_op_rows = DAR_COUNT(bench_op_rows);
