/* kern.h: the table of row kernels, and row conversions.
 *
 * A row kernel works on n consecutive elements of one arithmetic type, f32 or f64.  The reference text
 * (lib/kern_ref.inc) fills every slot for both types; faster kernels replace f32 slots according to the processor.
 * Storage types come in and go out through dar_row_get and dar_row_put, a piece of a row at a time, so that every op
 * works on every storage type and mixes them freely:
 *
 *     const void *x = dar_row_get(c, x_type, src, n, xbuf);           src itself, or converted into xbuf
 *     void *y = dar_row_out(c, y_type, dst, mode, ybuf);              dst itself, or ybuf
 *     k->silu(n, x, y);
 *     dar_row_put(c, y, y_type, dst, n, mode);                        store, add or stream what is in ybuf
 *
 * Bits: kernels that are not marked "bound" give the same bits at every CPU level, the reference included: they round
 * after every operation.  FTZ and DAZ are never set: denormals are numbers, on every thread. */
#ifndef DAR_LIB_KERN_H
#define DAR_LIB_KERN_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/dtype.h"

/* Normalisation of one row: xhat = (x - mean) rstd, y = xhat w + b.  w NULL: 1; b NULL: 0.  The mean is subtracted in
 * two parts, so that rows far from zero keep every bit they have; RMS norm is the same with mean 0.
 *
 * A row is read twice, the second time from the cache; memory would stand idle meanwhile.  So norm and norm_sums ask
 * for ahead[0], norm_back for ahead[1], which will be read next (NULL: nothing): ahead_size bytes per element of this
 * row.
 */
typedef struct dar_norm {
    double mean, rstd;
    const void *w, *b;
    const void *ahead[2];
    size_t ahead_size[2];
} dar_norm;

/* One step of AdamW.  m = beta1 m + (1 - beta1) g scale, v likewise of squares,
 * w -= rate (m fix1 / (sqrt(v fix2) + eps) + decay w).  fix1 = 1 / (1 - beta1^t), fix2 = 1 / (1 - beta2^t) for step
 * t = 1, 2, ...; scale is that of gradient clipping, else 1.  Source: Loshchilov and Hutter 2019, algorithm 2. */
typedef struct dar_adamw {
    double rate, beta1, beta2, eps, decay, fix1, fix2, scale;

    /* Of dar_row_adamw with moments in bf16: those of element i are rounded by the halves of dar_rng_u32(seed, stream,
     * index + i), the lower one for m; index is a multiple of 4. */
    uint64_t seed, stream, index;
} dar_adamw;

/* A tile of sums of 8-bit products, rows ld apart, with the scales of its rows and columns. */
typedef struct dar_sums {
    const int32_t *sum;
    size_t ld;
    const int32_t *offset;
    const float *a, *b;
} dar_sums;

/* Pointers are to rows of the table's type unless said, and need no alignment.  An output may be the same row as an
 * input, never one that overlaps it otherwise. */
typedef void dar_kern_map(size_t n, const void *x, void *y);
typedef void dar_kern_map_back(size_t n, const void *x, const void *gy, void *gx);

typedef void dar_kern_map_stored(size_t n, const void *x, void *y, bool stream);

typedef struct dar_kern {
    const char *name; /* of the fastest set used: "ref", "avx2", "avx512", "bf16" */

    /* Bits, whatever they mean; the same in both tables.  transpose, by stored type (i8 is NULL): y[j ldy + i] =
     * x[i ldx + j] for i < m, j < n.  stream: copy past the caches, at any alignment. */
    void (*transpose[DAR_DTYPES])(size_t m, size_t n, const void *x, size_t ldx, void *y, size_t ldy);
    void (*stream)(size_t bytes, const void *x, void *y);

    /* Likewise the same in both.  philox: the four numbers of each block index, index + 1, ... (lib/rng.h).  dither: x
     * as bf16, rounded away from zero with the odds of what is cut off, by the lower or upper `half` (0, 1) of
     * random[i]; infinity and NaN stay. */
    void (*philox)(size_t blocks, uint64_t seed, uint64_t stream, uint64_t index, uint32_t *out);
    void (*dither)(size_t n, const uint32_t *random, int half, const float *x, uint16_t *y);

    /* From and to storage, by stored type (i8 is NULL).  To 16 bits: nearest even, NaN stays NaN.  stream: write past
     * the caches. */
    void (*get[DAR_DTYPES])(size_t n, const void *src, void *x);
    void (*put[DAR_DTYPES])(size_t n, const void *x, void *dst, bool stream);

    /* y = f(x).  exp, tanh, rsqrt: bound 2 ULP for every argument; silu: 2.5; exact for NaN, infinities (silu: its
     * limits) and zeros with their sign.  gelu_tanh: bound (5 |z| + 5) 2^-24 relative, z = 2 sqrt(2/pi)
     * (x + 0.044715 x^3).  "_back": gx = f'(x) gy. */
    dar_kern_map *exp, *tanh, *rsqrt, *silu, *gelu_tanh, *relu;
    dar_kern_map_back *silu_back, *gelu_tanh_back, *relu_back;

    /* The same from and to rows stored as bf16, at one go: bits as by way of dar_row_get and dar_row_put.  stream:
     * write past the caches where y is aligned as cache lines are. */
    dar_kern_map_stored *silu_bf16, *gelu_tanh_bf16;

    void (*add)(size_t n, const void *a, const void *b, void *y);                    /* y = a + b */
    void (*mul)(size_t n, const void *a, const void *b, void *y);                    /* y = a b */
    void (*offset)(size_t n, double a, const void *x, void *y);                      /* y = a + x */
    void (*scale)(size_t n, double a, const void *x, void *y);                       /* y = a x */
    void (*axpy)(size_t n, double a, const void *x, void *y);                        /* y += a x */
    void (*mul_add)(size_t n, const void *a, const void *b, const void *c, void *y); /* y = a b + c */

    /* Reductions.  Element i goes to f64 accumulator i mod 32; the 32 are added as a tree: j and j + 16, then 8, 4, 2,
     * 1.  Products of f32 are exact in f64. */
    double (*sum)(size_t n, const void *x);
    double (*dot)(size_t n, const void *a, const void *b);
    double (*max)(size_t n, const void *x);          /* ignores NaN; -inf if n = 0 */
    ptrdiff_t (*nonfinite)(size_t n, const void *x); /* index of the first NaN or infinity, or -1 */

    /* Softmax of a row in pieces: m = max, s = sum of exp_sum, y scaled by 1 / s.  exp_sum: y = exp(x - m), returns the
     * sum; m = -inf (nothing but masked elements): zeros, 0.  Bound 2 ULP of exp.  softmax_back: gx = y (gy - dot) with
     * dot = <y, gy>. */
    double (*exp_sum)(size_t n, const void *x, double m, void *y);
    void (*softmax_back)(size_t n, const void *y, const void *gy, double dot, void *gx);

    /* Norms, by stored type of x, i8 NULL.
     *
     *   moments      m[0] = the mean if `centred`, else 0; m[1] = Σ (x - m[0])^2, as sums of differences from x[0],
     *                which lose at most a factor n, their squares fused with the sum; not centred: of x itself.  bf16:
     *                within 2^-16, by way of runs of 8 elements in the table's type (lib/kern_sets.h)
     *   norm         y = xhat w + b, stored as y_type
     *   norm_sums    sum[0] += Σ w gy, sum[1] += Σ w gy xhat; gw += gy xhat, gb += gy where they are not NULL
     *   norm_back    gx = rstd (w gy - mean[0] - xhat mean[1])
     *
     * stream, here and below: write past the caches where y or gx is aligned as cache lines are. */
    void (*moments[DAR_DTYPES])(size_t n, const void *x, bool centred, double m[2]);
    void (*norm[DAR_DTYPES])(size_t n, const dar_norm *s, const void *x, dar_dtype y_type, void *y, bool stream);
    void (*norm_sums[DAR_DTYPES])(size_t n, const dar_norm *s, const void *x, const void *gy, double sum[2], void *gw,
                                  void *gb);
    void (*norm_back[DAR_DTYPES])(size_t n, const dar_norm *s, const void *x, const void *gy, const double mean[2],
                                  void *gx, bool stream);

    /* Norm of the columns of a matrix whose rows lie ld apart, by stored type of x, i8 NULL.
     *
     *   column_sums    sum[j] = Σ_i w[i] x[i][j] z[i][j], or Σ_i x[i][j]^2 if z is NULL; in runs of 32 rows
     *   column_norm    of one row: y[j] = x[j] r[j] w, y stored as x
     *   column_back    of one row: gx[j] = gy[j] r[j] w + x[j] q[j]; returns Σ_j x[j] gy[j] r[j], in the accumulators
     *                  of a reduction but of the table's type
     */
    void (*column_sums[DAR_DTYPES])(size_t rows, size_t n, size_t ld, const void *w, const void *x, const void *z,
                                    void *sum);
    void (*column_norm[DAR_DTYPES])(size_t n, double w, const void *r, const void *x, void *y, bool stream);
    double (*column_back[DAR_DTYPES])(size_t n, double w, const void *r, const void *q, const void *x, const void *gy,
                                      void *gx, bool stream);

    /* By stored type of x and y, i8 NULL: rotate pairs (x[2i], x[2i+1]) by the angles whose cos, sin are the pairs of
     * table; backward: by their negatives.  n elements, n even; the table's `period` elements (even) repeat. */
    void (*rope[DAR_DTYPES])(size_t n, size_t period, const void *x, const void *table, void *y, bool backward,
                             bool stream);

    /* w, m, v in place. */
    void (*adamw)(size_t n, const dar_adamw *a, void *w, void *m, void *v, const void *g);

    /* Rows of 8 bits, by stored type of x, i8 NULL.  max_abs: 0 if n = 0; NaN or inf if an element is.  quantise: q = x
     * (1 / scale) to the nearest, ties to even, for |x| <= 127 scale; q = 0 where scale is not finite or 1 / scale is
     * not.  Each q is stored as q ^ flip: 0, or 128 for q + 128 as an unsigned byte. */
    double (*max_abs[DAR_DTYPES])(size_t n, const void *x);
    void (*quantise[DAR_DTYPES])(size_t n, const void *x, float scale, uint8_t flip, void *q);
    void (*dequantise)(size_t n, const int8_t *q, float scale, void *x);

    /* By stored type, f64 and i8 NULL: y[i][j] = (sum[i][j] - offset[j]) (a[i] b[j]), rows ldy apart, j < n. */
    void (*scale_sums[DAR_DTYPES])(size_t m, size_t n, const dar_sums *s, void *y, size_t ldy);
} dar_kern;

/* The table for arithmetic in t: DAR_F32 or DAR_F64. */
const dar_kern *dar_kern_for(dar_dtype t);

/* Arithmetic type of a storage type: f64 for f64, f32 for the rest. */
dar_dtype dar_compute_type(dar_dtype storage);

/* Elements per piece: what dar_row_get buffers should hold.  A piece of every operand fits the first-level cache. */
#define DAR_PIECE 1024

/* How a row is stored: over what is there, added to it, or past the caches. */
typedef enum dar_put { DAR_PUT, DAR_PUT_ADD, DAR_PUT_STREAM } dar_put;

/* The mode for an output of `bytes` in all: add if asked; stream what is larger than the caches, where the next reader
 * would not find it anyway. */
dar_put dar_put_for(size_t bytes, bool add);

/* n elements at src as arithmetic type c (f32 or f64): src itself if it is stored so, else converted into buf. */
const void *dar_row_get(dar_dtype c, dar_dtype stored, const void *src, size_t n, void *buf);

/* Where to compute a row that dar_row_put will store: dst itself if that needs no put, else buf. */
void *dar_row_out(dar_dtype c, dar_dtype stored, void *dst, dar_put mode, void *buf);

/* Store n elements x of arithmetic type c at dst.  Does nothing if dst == x and the mode is not to add. */
void dar_row_put(dar_dtype c, const void *x, dar_dtype stored, void *dst, size_t n, dar_put mode);

/* Convert n elements; any pair of f64, f32, bf16, f16. */
void dar_row_convert(dar_dtype dst_type, void *dst, dar_dtype src_type, const void *src, size_t n);

/* Ask for bytes that will be read soon. */
static inline void dar_row_ahead(const void *p, size_t bytes)
{
    for (size_t i = 0; i < bytes; i += 64) __builtin_prefetch((const char *)p + i);
}

/* The scale of n stored elements as 8 bits: max |x| / 127.  A zero row, or one below 2^-119, gives 0; a row that is not
 * finite gives NaN, so that it stays visible. */
float dar_row_scale(dar_dtype stored, const void *x, size_t n);

/* Quantise n stored elements: q = x / scale, zeros where the scale is 0 or NaN.  Returns the scale. */
float dar_row_quantise(dar_dtype stored, const void *x, size_t n, int8_t *q);

/* A step of AdamW over n parameters w with gradients g of arithmetic type c, which become 0; the moments m, v are
 * stored as `moments`: c, or bf16, rounded at random where c is f32.  Runs on all threads. */
void dar_row_adamw(const dar_adamw *a, dar_dtype c, dar_dtype moments, size_t n, void *w, void *m, void *v, void *g);

/* Index of the first NaN or Inf of n elements, or -1.  Runs on all threads. */
int64_t dar_row_nonfinite(dar_dtype t, const void *x, size_t n);

/* Fill the tables for a set of DAR_CPU_ flags; called by dar_cpu_init. */
void dar_kern_init(unsigned cpu_flags);

#endif
