/* tape.h: recording, the backward sweep, recompute segments.
 *
 * An op runs when it is called.  If recording is on and an input wants a gradient, a node is pushed; backward walks the
 * nodes in reverse.  Values and gradients lie in the step arena, nodes in one of the tape's own: dar_tape_clear and a
 * reset of the step arena free the step.  Inference is the same code with recording off.
 *
 * On a planning arena nothing is computed: the same calls only count bytes and FLOPs, so a program knows its peak
 * before it starts. */
#ifndef DAR_AUTOGRAD_TAPE_H
#define DAR_AUTOGRAD_TAPE_H

#include <stdbool.h>

#include "autograd/op.h"
#include "autograd/spare.h"
#include "lib/arena.h"
#include "lib/tensor.h"

/* A value on the tape, valid until dar_tape_clear; but backward gives the memory of what it has passed to gradients:
 * then x.data is NULL, but for leaves and the value that backward began with. */
typedef struct dar_val {
    dar_tensor x; /* the value */
    dar_tensor g; /* its gradient, in the arithmetic type or bf16; data NULL until backward reaches it */
    bool wants_grad;
    bool has_grad; /* g holds something to add to */
    bool leaf;     /* g is the owner's memory: kept, and added to from step to step */
    bool own;      /* x is the tape's memory and this value's alone */
    bool lent;     /* g is memory that somebody else gives back */
    bool read;     /* backward, or a view, reads x */
    bool given;    /* some call gives it a gradient */
    bool half;     /* its gradient is bf16 if it is: who made it takes such a one, and the only one to give it does */
} dar_val;

typedef struct dar_node dar_node;
struct dar_keeping;

/* What a step did, or would do. */
typedef struct dar_cost {
    double forward, backward; /* [FLOP]; recomputation counts as forward */
    size_t ops;               /* calls of forward and backward */
} dar_cost;

typedef struct dar_tape {
    dar_arena *arena; /* values, gradients, scratch: the step's memory */
    dar_arena *keep;  /* results that outlive a segment's forward (dar_apply_kept); NULL: none are kept */
    dar_arena meta;   /* nodes and val structs: small, real even when arena only plans */
    bool recording;
    bool check_finite; /* look at every result and gradient; costs a read of each */
    dar_cost cost;

    /* With check_finite: the first op that made a NaN or Inf, else NULL. */
    const char *bad_op;
    bool bad_backward; /* it was a gradient */
    int64_t bad_index;

    /* Of the tape itself. */
    dar_node *last;           /* newest node */
    dar_spare spare;          /* values and gradients that nobody reads any more */
    const void *oldest;       /* first value of the segment being replayed */
    struct dar_keeping *kept; /* of the segment being run or replayed */
    bool inside;              /* a segment, or a place to come back to */
    bool replaying;           /* a segment */
    bool touched;             /* an input of an op since the segment began wants a gradient */
} dar_tape;

/* An empty tape over an initialised arena, recording.  Reserves address space for the nodes. */
dar_status dar_tape_init(dar_tape *t, dar_arena *arena, dar_err *e);

/* Release the nodes' memory.  Accepts a zeroed tape. */
void dar_tape_free(dar_tape *t);

/* Forget nodes and values, spare memory, cost and bad_op.  The arenas `arena` and `keep` are the caller's to reset. */
void dar_tape_clear(dar_tape *t);

/* Where a tape stands, and back there: everything made since is gone.  Nothing of it may be recorded.  In between, what
 * is dropped gives its memory as inside a segment. */
typedef struct dar_tape_place {
    dar_mark arena, meta;
    dar_spare spare;
    bool inside;
} dar_tape_place;
dar_tape_place dar_tape_mark(dar_tape *t);
void dar_tape_reset(dar_tape *t, dar_tape_place p);

/* A value over memory of the caller, pushed on the arena.  g: gradient memory of the arithmetic type and x's shape that
 * backward adds to, or NULL for a frozen input. */
dar_val *dar_leaf(dar_tape *t, dar_tensor x, const dar_tensor *g);

/* A leaf without memory of its own: x is pushed, content undefined (planning: only counted). */
dar_val *dar_input(dar_tape *t, dar_dtype type, dar_shape s);

/* A copy of `bytes` that lives as long as the values made now: arguments of segments. */
void *dar_tape_store(dar_tape *t, const void *data, size_t bytes);
void *dar_tape_room(dar_tape *t, size_t bytes); /* the same, zeroed */

/* Run op on n inputs (NULL: absent).  attr is copied.  Inputs that are strided views are copied to contiguous memory
 * first. */
dar_val *dar_apply(dar_tape *t, const dar_op *op, dar_val *const *in, int n, const void *attr);

/* Say that v is not used any more: inside a segment, or after dar_tape_mark, its memory is free for others, unless
 * backward will read it. */
void dar_drop(dar_tape *t, dar_val *v);

/* Gradients of the scalar (or, with seed, of <seed, y>) with respect to every leaf that wants one.  Clears the tape's
 * nodes.  seed: y's shape, arithmetic type; NULL only for one element. */
void dar_backward(dar_tape *t, dar_val *y, const dar_tensor *seed);

/* A recompute segment: y = fn(inputs).  Only inputs and y are kept; backward runs fn again, recording, and sweeps it.
 * fn must depend on nothing but its inputs, arg and leaves (aborts if it uses another value that wants a gradient), and
 * may be called several times; arg must live until backward.  It returns the result, of type and shape given here.
 * Temporaries of fn are freed before this returns, with recording off too. */
typedef dar_val *dar_segment_fn(dar_tape *t, void *arg, dar_val *const *in);
dar_val *dar_segment(dar_tape *t, dar_segment_fn *fn, void *arg, dar_val *const *in, int n, dar_dtype type,
                     dar_shape shape);

/* Of [B, N, ..]: of `clips` clips, from `clip` on, rows [first, first + count). */
typedef struct dar_rows {
    int64_t clip, clips, first, count;
} dar_rows;

/* A segment cut along N: y [B, N, ..] = fn(inputs), where a row of y depends on its own row of the inputs that are cut.
 * fn is given one piece of them after the other and makes y's, so that forward and backward hold what is made of one
 * piece.  Inputs that are not cut, and leaves, get the sum of the pieces' gradients, in order; how they are cut depends
 * on B, N and `most` alone. */
typedef dar_val *dar_rows_fn(dar_tape *t, void *arg, dar_val *const *in, dar_rows rows);
typedef struct dar_rows_attr {
    dar_rows_fn *fn;
    void *arg;
    unsigned cut; /* DAR_KEEP_X bits of inputs [B, N, ..] */
    int64_t most; /* rows in a piece */
    bool unread;  /* nobody reads y's value in the replay of a segment around this one: there it is not computed */
    dar_dtype type;
    dar_shape shape; /* of y */
} dar_rows_attr;
dar_val *dar_segment_rows(dar_tape *t, const dar_rows_attr *a, dar_val *const *in, int n);

/* How many pieces those are, and piece i: all of [B, N, ..] if it fits, else of one clip each, all about as long. */
int64_t dar_rows_count(const dar_shape *y, int64_t most);
dar_rows dar_rows_of(const dar_shape *y, int64_t most, int64_t i);
dar_tensor dar_rows_view(const dar_tensor *x, dar_rows r);

/* What a call inside a segment leaves in the keep arena, so that the replay need not run it again.  Worth it where
 * recomputation is dear and results are small: products, attention. */
typedef enum dar_keep {
    DAR_KEEP_NOTHING,
    DAR_KEEP_ALL, /* the result and what backward saves */
    DAR_KEEP_AUX, /* what backward saves: in the replay the result, and all that is made of it, has no value (data
                     NULL), so nobody's backward may read it */
} dar_keep;

/* Run op as dar_apply does.  Outside of segments nothing is kept; in a segment, at most 8 results are. */
dar_val *dar_apply_kept(dar_tape *t, const dar_op *op, dar_val *const *in, int n, const void *attr, dar_keep keep);

#endif
