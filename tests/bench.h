/* bench.h: the frame of `make bench-kernels`.
 *
 * A measurement is one row of a table: what runs (a kind), on which type and sizes.  The frame repeats a row in rounds,
 * measures the machine's peak between the rounds, and reports medians: neighbours and clocks drift, so a rate is only
 * compared with a peak of the same seconds. */
#ifndef DAR_TESTS_BENCH_H
#define DAR_TESTS_BENCH_H

#include "autograd/ops.h"

/* ---------------------------------------------------------------- peaks */

typedef enum bench_peak {
    BENCH_F32,    /* fused multiply-adds on registers [GFLOP/s] */
    BENCH_BF16,   /* dot products of bf16 pairs; that of f32 where the processor has none */
    BENCH_I8,     /* dot products of 8-bit quads, likewise */
    BENCH_COPY,   /* memcpy from memory to memory, read and written bytes [GB/s] */
    BENCH_READ,   /* reading memory [GB/s] */
    BENCH_STREAM, /* copy with stores past the caches [GB/s] */
    BENCH_PEAKS
} bench_peak;

const char *bench_peak_name(bench_peak p);

/* One sample of a few milliseconds on dar_threads() threads [1e9/s]. */
double bench_peak_sample(bench_peak p);

bool bench_peak_is_bytes(bench_peak p);

/* ---------------------------------------------------------------- rows */

#define BENCH_PARTS 2

typedef struct bench bench;

/* What is measured.  A round calls run[0], run[1], then rival, and times each; reset is not timed. */
typedef struct bench_kind {
    const char *part[BENCH_PARTS]; /* names of the kernels; the second may be NULL */
    void (*setup)(bench *b);       /* allocate and fill operands, state flops and bytes */
    void (*run[BENCH_PARTS])(bench *b);
    void (*reset)(bench *b); /* after each round; NULL: nothing */
    void (*rival)(bench *b); /* the same as run[0] by OpenBLAS in f32; NULL: not comparable */

    /* Of an op (bench_op): what to call, and on which inputs. */
    const dar_op *op;
    void (*inputs)(bench *b);
    dar_val *(*call)(dar_tape *t, dar_val *const *x, const int64_t *s);
} bench_kind;

typedef struct bench_row {
    const bench_kind *kind;
    dar_dtype type;
    int64_t s[6];            /* sizes; what they mean is the kind's */
    bench_peak peak;         /* what the row is compared with */
    double bar[BENCH_PARTS]; /* least fraction of the peak; 0: none */
    bool against_rival;      /* measure the rival too; bar: not slower */
} bench_row;

/* A row being measured. */
struct bench {
    const bench_row *row;
    const int64_t *s;
    dar_arena *arena;
    double flops[BENCH_PARTS], bytes[BENCH_PARTS]; /* per call */

    dar_tensor x[DAR_OP_IN], gx[DAR_OP_IN], y, gy; /* operands; gx[i].data NULL: no gradient wanted */
    int n;
    dar_mark mark; /* everything above it is a round's */
    dar_tape tape;
    void *state; /* of the kind */
};

/* The processor that OpenBLAS takes this one for. */
const char *bench_blas_core(void);

/* The tables. */
extern const bench_row bench_product_rows[], bench_op_rows[], bench_row_rows[], bench_net_rows[], bench_vae_rows[];
extern const size_t bench_n_product_rows, bench_n_op_rows, bench_n_row_rows, bench_n_net_rows, bench_n_vae_rows;

/* ---------------------------------------------------------------- help for kinds */

/* Push a tensor filled with numbers in [-1, 1]. */
dar_tensor bench_tensor(bench *b, dar_dtype type, dar_shape s);

/* Push the next input of an op; wanted: with a gradient. */
void bench_input(bench *b, dar_dtype type, dar_shape s, bool wanted);

/* setup, run and reset of an op: forward recorded on a tape, and its backward. */
void bench_op_setup(bench *b);
void bench_op_forward(bench *b);
void bench_op_backward(bench *b);
void bench_op_reset(bench *b);

#define BENCH_OP(name)                                                                                                 \
    .part = { #name, #name "_back" }, .setup = bench_op_setup, .run = { bench_op_forward, bench_op_backward },         \
    .reset = bench_op_reset, .op = &dar_op_##name

#endif
