/* op.h: what an op is.
 *
 * An op is one descriptor in one file: shape rule, forward, backward, and the samples its tests are made of.  It is
 * listed once, in ops.def.  The tape (autograd/tape.h) calls it; nothing else does.
 *
 * Contract
 *
 *   forward   Overwrites y, and aux if it is there (aux.data is NULL when nobody will call backward).
 *
 *   backward  For each i with gx[i].data: gx[i] = (add[i] ? gx[i] : 0) + J_i^T gy.  Reads aux, gy, and of the x[i]
 *             and y only those named in `keep`.  The gx[i] never overlap; gx[0] is gy itself where the op is
 *             `in_place` and nobody else needs gy, or x[0] itself where it is `over` and nobody else needs x[0].
 *
 *   both      Allocate nothing and keep no state; scratch comes with the context, of the size that `scratch` asked
 *             for.  Every tensor is contiguous.  The same bits for any number of threads.
 *
 *   types     Storage differs from input to input as it likes, but an input that gets a gradient is f64 only if x[0]
 *             is.  Arithmetic is f64 if y or x[0] is f64, else f32 or wider; aux is of that type.  A gradient is f64
 *             if its value is, else f32; or bf16 with its value, where both ops that meet there say so (`half`) and
 *             nothing is added to it. */
#ifndef DAR_AUTOGRAD_OP_H
#define DAR_AUTOGRAD_OP_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/tensor.h"

#define DAR_OP_IN 8 /* most inputs */

typedef struct dar_opctx {
    const void *attr;
    dar_tensor x[DAR_OP_IN]; /* data NULL: optional input that is absent */
    dar_tensor y;
    dar_tensor aux; /* what forward saves for backward, as asked for by the descriptor */
    dar_tensor gy;
    dar_tensor gx[DAR_OP_IN]; /* data NULL: not wanted (frozen) */
    bool add[DAR_OP_IN];
    void *scratch;
    int threads; /* scratch that is per thread is for this many */
} dar_opctx;

/* One set of inputs for the table test.  Values are uniform in [lo, hi] (both 0: [-1, 1]) unless `fill` sets them. */
typedef struct dar_sample {
    dar_shape in[DAR_OP_IN]; /* n = -1: absent; ends the inputs of a variadic op */
    const void *attr;        /* NULL if the op has none */
    double lo, hi;
    double gap;                                   /* keep |x| >= gap: distance from a kink at 0 */
    void (*fill)(int input, const dar_tensor *x); /* f64; called after the uniform fill; NULL if not needed */
} dar_sample;

/* Shapes that must abort. */
typedef struct dar_error_sample {
    dar_shape in[DAR_OP_IN];
    const void *attr;
} dar_error_sample;

#define DAR_KEEP_X(i) (1u << (i))
#define DAR_KEEP_Y    (1u << 31)

typedef struct dar_op {
    const char *name;
    int n_in; /* inputs, the optional ones last; a variadic op (concat) takes 1..n_in, all present */
    int n_optional;
    bool variadic;
    bool strided;     /* forward takes strided views as they are */
    bool in_place;    /* gx[0] may lie where gy lies, if x[0] has y's shape: then add[0] is false */
    bool over;        /* gx[0] may lie where x[0] lies: then add[0] is false */
    unsigned keep;    /* what backward reads */
    unsigned half;    /* DAR_KEEP_X bits of inputs whose gradient may be bf16, DAR_KEEP_Y: gy may be */
    unsigned frozen;  /* DAR_KEEP_X bits of inputs that never get a gradient (positions, masks) */
    size_t attr_size; /* bytes copied onto the tape */

    /* Shape of y; aborts if the inputs do not fit.  in[i].n = -1 for an absent one. */
    dar_shape (*shape)(const dar_shape *in, int n_in, const void *attr);
    /* Storage type of y; NULL: that of x[0]. */
    dar_dtype (*dtype)(const dar_dtype *in, int n_in, const void *attr);
    /* Shape of aux, in the arithmetic type; NULL: none. */
    dar_shape (*aux)(const dar_shape *in, int n_in, const void *attr);
    /* Bytes of scratch; NULL: none.  Tensors in c have shapes and types but may have no memory. */
    size_t (*scratch)(const dar_opctx *c, bool backward);
    /* Terms of the longest sum behind an element of y (of = -1) or of the gradient of x[of]; from it the tests derive
     * what f32 and bf16 may be off.  NULL: elementwise, 1. */
    double (*terms)(const dar_shape *in, int n_in, const void *attr, int of);
    /* Floating-point operations of one call, for the gradients that are wanted; NULL: not counted. */
    double (*flops)(const dar_opctx *c, bool backward);

    /* A view: y is this view of x[0], which aborts if it does not fit; shape, forward and backward are NULL.  Takes
     * strided x if `strided`. */
    dar_tensor (*view)(const dar_tensor *x, const void *attr);

    void (*forward)(const dar_opctx *c);
    void (*backward)(const dar_opctx *c); /* NULL with no_backward saying why */
    const char *no_backward;

    const dar_sample *samples;
    int n_samples;
    const dar_error_sample *errors;
    int n_errors;
} dar_op;

/* dar_op_silu, ... : every op of ops.def. */
#define DAR_OP(name) extern const dar_op dar_op_##name;
#include "autograd/ops.def"
#undef DAR_OP

/* All of them, in the order of ops.def. */
extern const dar_op *const dar_ops[];
extern const int dar_n_ops;

/* Arithmetic type of a call: f64 if y or x[0] is f64, else f32. */
dar_dtype dar_op_compute(const dar_opctx *c);

#endif
