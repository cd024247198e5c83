/* ops.h: every op, as the networks call it.
 *
 * x has any storage type unless said; y has x's storage type unless said.  Gradients are f32, or f64 where x is f64; of
 * values between two ops that allow it, stored as bf16 and read once, bf16 (autograd/op.h). Letters as in the whole
 * project: B batch, T frames, H W height and width, C channels, N tokens, D width of the model, A heads, E head size, F
 * feed-forward width.  Shapes that do not fit abort with the op's name. */
#ifndef DAR_AUTOGRAD_OPS_H
#define DAR_AUTOGRAD_OPS_H

#include "autograd/tape.h"

/* ---------------------------------------------------------------- arithmetic */

/* a + b, a - b, a b.  Either side repeats along dimensions in which it is 1 or that it lacks; shapes are aligned at the
 * last dimension, as in numpy.  The gradient of a side that repeats is summed.  Stored as a. */
dar_val *dar_add(dar_tape *t, dar_val *a, dar_val *b);
dar_val *dar_sub(dar_tape *t, dar_val *a, dar_val *b);
dar_val *dar_mul(dar_tape *t, dar_val *a, dar_val *b);

/* a x + b and a x with constants a, b. */
dar_val *dar_affine(dar_tape *t, dar_val *x, double a, double b);
dar_val *dar_scale(dar_tape *t, dar_val *x, double a);

/* ---------------------------------------------------------------- activations */

/* y = x sigmoid(x), elementwise.  Source: Elfwing et al. 2018, eq. 4. */
dar_val *dar_silu(dar_tape *t, dar_val *x);

/* y = x/2 (1 + tanh(sqrt(2/pi) (x + 0.044715 x^3))), elementwise.  Source: Hendrycks and Gimpel 2016, section 2. */
dar_val *dar_gelu_tanh(dar_tape *t, dar_val *x);

/* y = max(x, 0), elementwise; the slope at 0 is 0. */
dar_val *dar_relu(dar_tape *t, dar_val *x);

/* y = e^x, elementwise. */
dar_val *dar_exp(dar_tape *t, dar_val *x);

/* ---------------------------------------------------------------- norms and what surrounds them */

/* Variations of norms. */
typedef struct dar_norm_opt {
    double eps; /* added to the mean square */
    bool cast;  /* y has storage type `out`, not that of x */
    dar_dtype out;
    int64_t split; /* modulate: tokens per parameter row */
    int64_t first; /* modulate: place in its clip of token 0 */
} dar_norm_opt;

/* Normalise the rows of the last dimension.
 *
 *   x      [.., D]
 *   w, b   [D]       NULL: 1, 0
 *
 *   rms_norm    y = x / sqrt(mean(x^2) + eps) w
 *   layer_norm  y = (x - mean(x)) / sqrt(mean((x - mean(x))^2) + eps) w + b
 *
 * Statistics are f64 sums in two passes: rows of 1e4 + tiny come out right, rows of zeros finite.  Saves three numbers
 * per row.  Sources: Zhang and Sennrich 2019, eq. 4; Ba et al. 2016, eq. 4. */
dar_val *dar_rms_norm(dar_tape *t, dar_val *x, dar_val *w, const dar_norm_opt *o);
dar_val *dar_layer_norm(dar_tape *t, dar_val *x, dar_val *w, dar_val *b, const dar_norm_opt *o);

/* Layer norm with a scale and a shift that depend on the token's place: y = layer_norm(x) (1 + scale) + shift.
 *
 *   x              [B, N, D]
 *   scale, shift   [B, R, D]   token i takes row min((first + i) / split, R - 1); R = 1: split is not used
 *
 * R = 2 is a clip whose first frame (split tokens) has a time of its own.  Source: Peebles and Xie 2022, section 3.2.
 */
dar_val *dar_modulate(dar_tape *t, dar_val *x, dar_val *scale, dar_val *shift, const dar_norm_opt *o);

/* Gated residual: y = x + g u.
 *
 *   x, u   [B, N, D]
 *   g      [B, R, D]   rows as for dar_modulate */
typedef struct dar_gate_attr {
    int64_t split, first;
} dar_gate_attr;
dar_val *dar_gate(dar_tape *t, dar_val *x, dar_val *u, dar_val *g, dar_gate_attr a);

/* Norm over channels: y = x / max(||x||, 1e-12) sqrt(C) w at every place, ||x|| over the channels there.
 *
 *   x   [B, C, ..]   at least one dimension after C
 *   w   [C]
 *
 * Source: the reference VAE, RMS_norm. */
dar_val *dar_channel_norm(dar_tape *t, dar_val *x, dar_val *w);

/* Rotate the pairs (x[2i], x[2i + 1]) of every head by the token's position.
 *
 *   x       [B, N, D]   D = heads E
 *   table   [N, E]      cos a, sin a of pair i at [2i], [2i + 1]; f32 or f64, frozen; E even, at most DAR_PIECE
 *
 *   y[2i]     = x[2i] cos a - x[2i + 1] sin a
 *   y[2i + 1] = x[2i] sin a + x[2i + 1] cos a
 *
 * Source: Su et al. 2021, eq. 34; order of pairs as in the reference model, rope_apply(). */
dar_val *dar_rope(dar_tape *t, dar_val *x, dar_val *table);

/* How the E / 2 pairs of a head are shared between time, height and width: 22, 21, 21 for E = 128. */
void dar_rope_axes(int64_t e, int64_t pairs[3]);

/* Angles [rad] of the E / 2 pairs of a token at (t, h, w): pair i of an axis with P pairs turns by position
 * base^(-i / P). */
void dar_rope_angles(int64_t e, double base, const double position[3], double *angle);

/* Fill table [frames height width, E], any float type, for tokens in the order t, h, w, all from 0.  Computed in f64.
 */
void dar_rope_table(const dar_tensor *table, int64_t frames, int64_t height, int64_t width, double base);

/* ---------------------------------------------------------------- products */

typedef enum dar_act { DAR_ACT_NONE, DAR_ACT_GELU_TANH } dar_act;

/* Variations of linear layers. */
typedef struct dar_linear_opt {
    dar_act act; /* applied to the sums while they are in the nearest cache */
    bool cast;   /* y has storage type `out`, not that of x */
    dar_dtype out;
    bool quantise; /* linear with i8 w: forward rounds the rows of x to 8 bits too, and multiplies 8 bits by 8 bits */
    dar_keep keep; /* in a recompute segment (dar_apply_kept) */
} dar_linear_opt;

/* y = act(x W^T + b).
 *
 *   x  [.., K]      w  [N, K], i8 too      b  [N] or NULL      y  [.., N]      o  NULL: all zero
 *
 * bf16 x and w multiply as bf16 with f32 sums (gradients are rounded to bf16 as operands); any other pair in f32, or
 * f64 where x is.  i8 weights are scaled back while they are read; they get no gradient.  An activation saves its
 * argument.  `quantise` is an error of max|x| / 254 in each x of a row; backward is that of the layer without it. */
dar_val *dar_linear(dar_tape *t, dar_val *x, dar_val *w, dar_val *b, const dar_linear_opt *o);

/* y = act(x W^T + scale (x A^T) U^T + b): a layer with a low-rank addition.
 *
 *   a  [r, K]      u  [N, r]      the rest as for linear
 *
 * Saves scale x A^T.  Source: Hu et al. 2021, eq. 3. */
dar_val *dar_lora(dar_tape *t, dar_val *x, dar_val *w, dar_val *b, dar_val *a, dar_val *u, double scale,
                  const dar_linear_opt *o);

/* ---------------------------------------------------------------- attention */

/* Variations of attention. */
typedef struct dar_attention_opt {
    int64_t heads;
    double scale;        /* 0: 1 / sqrt(E) */
    dar_val *log_weight; /* [Nk] or [B, Nk], f32 or f64, frozen: added to the logits of each key; NULL: none */
    dar_keep keep;       /* in a recompute segment (dar_apply_kept) */
} dar_attention_opt;

/* Attention over D = heads E columns, head by head.
 *
 *   q     [B, Nq, D]
 *   k, v  [B, Nk, D]   f64 if q is, else any
 *   y     [B, Nq, D]   l_ij = scale q_i . k_j + lw_j; y_i = sum_j softmax(l_i)_j v_j
 *
 * One key with lw = log n stands for n equal ones; lw = -inf masks a key; a row without any key gives zeros and zero
 * gradients.  bf16 q, k, v multiply as bf16, sums and exponentials are f32.  Saves two numbers per head and row.
 * Source: Vaswani et al. 2017, eq. 1; algorithm in lib/attn.h. */
dar_val *dar_attention(dar_tape *t, dar_val *q, dar_val *k, dar_val *v, const dar_attention_opt *o);

/* ---------------------------------------------------------------- convolution and resampling */

/* How a kernel is laid over its input.  Output sizes are floor((padded length - kernel length) / stride) + 1. */
typedef struct dar_conv_attr {
    int stride;                   /* in space, both directions */
    int top, bottom, left, right; /* zero rows and columns around every frame */
    int stride_t;                 /* conv3d: in time */
    int front;                    /* conv3d: frames before frame 0 */
} dar_conv_attr;

/* Stride 1 and as much padding as keeps the size of odd kernels, all of it in front in time (causal).  w: [.., kh, kw]
 * or [.., kt, kh, kw]. */
dar_conv_attr dar_conv_same(const dar_val *w);

/* Cross-correlation of every frame, as nn.Conv2d.
 *
 *   x  [B, Cin, H, W] or [B, Cin, T, H, W]      w  [Cout, Cin, kh, kw]      b  [Cout] or NULL
 *   y  [B, Cout, H', W'] or [B, Cout, T, H', W']
 *
 *   y[o, h, w] = b[o] + sum over c, i, j of w[o, c, i, j] x[c, h stride + i - top, w stride + j - left] */
dar_val *dar_conv2d(dar_tape *t, dar_val *x, dar_val *w, dar_val *b, dar_conv_attr a);

/* The same with a kernel over time that looks back.
 *
 *   x        [B, Cin, T, H, W]      w  [Cout, Cin, kt, kh, kw]      b  [Cout] or NULL
 *   history  [B, Cin, P, H, W], P <= front, or NULL: the frames right before x; what is missing of `front` is zero
 *
 * Tap k of output frame t reads frame t stride_t + k - front.  A clip cut into chunks, each with the frames before it
 * as history, gives the same bits as the whole clip.  Source: the causal convolution of the Wan VAE. */
dar_val *dar_conv3d(dar_tape *t, dar_val *x, dar_val *w, dar_val *b, dar_val *history, dar_conv_attr a);

/* All below take [B, C, H, W], or [B, C, T, H, W] frame by frame. */

/* Where element (c, dy, dx) of an r x r block of pixels, or (c, j) of r frames, stands among the coarse channels. */
typedef enum dar_pixel_order {
    DAR_PIXELS_ROWS,    /* (c r + dy) r + dx: torch's pixel_unshuffle */
    DAR_PIXELS_COLUMNS, /* (c r + dx) r + dy: patchify of the Wan VAE */
    DAR_FRAMES_FIRST,   /* j C + c: channel groups are frames */
} dar_pixel_order;

/* y[k(c, dy, dx), h, w] = x[c, r h + dy, r w + dx] and back.  r divides H and W, r r divides the channels. */
dar_val *dar_pixel_unshuffle(dar_tape *t, dar_val *x, int r, dar_pixel_order order);
dar_val *dar_pixel_shuffle(dar_tape *t, dar_val *x, int r, dar_pixel_order order);

/* y[j C + c, i] = x[c, r i + j] and back: frames to channel groups, older first. */
dar_val *dar_frame_unshuffle(dar_tape *t, dar_val *x, int r);
dar_val *dar_frame_shuffle(dar_tape *t, dar_val *x, int r);

/* Mean of groups: number all (c, a, b, d), a < ft frames, b, d < fs rows and columns, as ((c ft + a) fs + b) fs + d;
 * output channel o is the mean of the C ft fs fs / channels consecutive numbers from o times that.  If T is no multiple
 * of ft, zero frames in front complete it.  Source: AvgDown3D of the Wan2.2 VAE. */
dar_val *dar_avg_down(dar_tape *t, dar_val *x, int64_t channels, int ft, int fs);

/* The reverse: each channel fills its group of the same numbers.  The first `drop` < ft frames are left out: ft - 1 at
 * the start of a clip, else 0.  Source: DupUp3D of the Wan2.2 VAE. */
dar_val *dar_dup_up(dar_tape *t, dar_val *x, int64_t channels, int ft, int fs, int drop);

/* y[c, h, w] = x[c, h / r, w / r]. */
dar_val *dar_upsample_nearest(dar_tape *t, dar_val *x, int r);

/* ---------------------------------------------------------------- shape */

/* The same values in contiguous memory: always a copy. */
dar_val *dar_contiguous(dar_tape *t, dar_val *x);

/* The same values stored as `type` (f64, f32, bf16 or f16; 16 bits round to nearest even).  x itself if it is stored so
 * already. */
dar_val *dar_cast(dar_tape *t, dar_val *x, dar_dtype type);

/* Views: no copy, y shares x's memory.  Ops that need contiguous memory copy a strided view when they get it.
 *
 *   reshape   s has as many elements; a strided view is copied first
 *   slice     length indices of dimension dim, from start
 *   permute   y.d[i] = x.d[order[i]]; order has one entry per dimension */
dar_val *dar_reshape(dar_tape *t, dar_val *x, dar_shape s);
dar_val *dar_slice(dar_tape *t, dar_val *x, int dim, int64_t start, int64_t length);
dar_val *dar_permute(dar_tape *t, dar_val *x, const int *order);

/* n (1 to 8) tensors one after the other along dimension dim; the other dimensions are equal.  Stored as x[0]. */
dar_val *dar_concat(dar_tape *t, dar_val *const *x, int n, int dim);

/* Zeros around x: before[k], after[k] >= 0 of them at the ends of dimension k. */
dar_val *dar_pad(dar_tape *t, dar_val *x, const int64_t *before, const int64_t *after);

/* ---------------------------------------------------------------- reductions */

#define DAR_ALL_DIMS (~0u)

/* Sum and mean over the dimensions whose bits are set in dims (1u << 0 is the first).  keep: they stay as 1, else they
 * go.  y is f32, or f64 where x is; sums are formed in f64 but for at most 32 neighbours. */
dar_val *dar_sum(dar_tape *t, dar_val *x, unsigned dims, bool keep);
dar_val *dar_mean(dar_tape *t, dar_val *x, unsigned dims, bool keep);

/* y = sum w (x - target)^2, or with as_mean that divided by the number of elements of x (not by the sum of w).
 *
 *   x, target   of one shape
 *   w           broadcasts to it; frozen; NULL: 1
 *   y           scalar, f32, or f64 where x is; summed in f64 */
dar_val *dar_squared_error(dar_tape *t, dar_val *x, dar_val *target, dar_val *w, bool as_mean);

/* y = mean of sqrt((x - target)^2 + eps^2), eps > 0: |x - target| with a round corner.
 *
 *   x, target   of one shape
 *   y           scalar, f32, or f64 where x is; summed in f64
 *
 * Source: Charbonnier et al. 1994, table 1. */
dar_val *dar_charbonnier(dar_tape *t, dar_val *x, dar_val *target, double eps);

/* y = exp(x + mask) / sum of it, along the last dimension.  mask broadcasts to x's shape; frozen; NULL: 0.  A row that
 * is -inf throughout gives zeros and zero gradients. */
dar_val *dar_softmax(dar_tape *t, dar_val *x, dar_val *mask);

#endif
