/* tile.h: register tiles, the one place where products are computed.
 *
 * A tile multiplies a packed stripe of A (mr rows) with a packed stripe of B (nr columns) into C.  Operands are packed
 * in units of 8 bytes (f64) or 4: one f32, a bf16 pair, or an 8-bit quad, consecutive along k.  Everything that
 * multiplies (matrix product, attention, convolution) packs its operands for a tile and calls it, so precision and
 * instruction set are chosen here alone.
 *
 *   kind         A          B          C     how
 *   DAR_TILE_F64  f64        f64        f64   reference
 *   DAR_TILE_F32  f32        f32        f32   fused multiply-add where the processor has it
 *   DAR_TILE_BF16 bf16       bf16       f32   pairs; denormals flush to zero
 *   DAR_TILE_I8   u8         s8         i32   quads, exact
 *
 * Order of summation: from zero, k ascending, one accumulator per element of C (bf16: pairs added as the processor
 * does); then, if asked to add, that sum to what C holds.  So a result depends on how the caller cuts k and on nothing
 * else.
 */
#ifndef DAR_LIB_TILE_H
#define DAR_LIB_TILE_H

#include <stdbool.h>
#include <stddef.h>

#include "lib/dtype.h"
#include "lib/kern.h"

typedef enum dar_tile_kind { DAR_TILE_F64, DAR_TILE_F32, DAR_TILE_BF16, DAR_TILE_I8, DAR_TILE_KINDS } dar_tile_kind;

/* Pack `lanes` lanes of k elements into stripes of `wide` lanes; see dar_tile_pack_*.  Along k: one stripe. */
typedef void dar_pack_fn(const void *src, size_t ld, size_t lanes, size_t k, size_t wide, void *dst);

typedef struct dar_packers {
    dar_pack_fn *along[DAR_DTYPES];  /* by stored type, a lane's elements consecutive; NULL: by plain loops */
    dar_pack_fn *across[DAR_DTYPES]; /* the lanes of one k consecutive */
    dar_pack_fn *rows[DAR_DTYPES];   /* from and to lanes that lie along k; NULL: not to be had */
} dar_packers;

typedef void dar_mm_fn(size_t k, const void *a, size_t a_row, size_t a_k, const void *b, size_t b_k, void *c,
                       size_t ldc, size_t m, size_t n, dar_put put);

typedef void dar_mm_taps_fn(size_t k, size_t taps, const size_t *at, const void *a, size_t a_row, const void *b,
                            size_t b_k, void *c, size_t ldc, size_t m, size_t n, dar_put put);

typedef void dar_mm_rows_fn(size_t k, const void *a, const size_t *rows, const void *b, size_t b_k, void *c, size_t ldc,
                            size_t m, size_t n, dar_put put);

typedef struct dar_tile {
    const char *name; /* "f32 6x64 avx512" */
    dar_tile_kind kind;
    size_t unit;       /* elements along k per unit: 1, 1, 2, 4 */
    size_t unit_bytes; /* 8, 4, 4, 4 */
    size_t mr, nr;     /* rows of A, columns of B in a stripe */

    /* C[m, n] (+)= A B with m <= mr, n <= nr over k units.
     *
     *   A: unit (i, k) at a + i * a_row + k * a_k [units].  The packed stripe has a_row = 1, a_k = mr, and mr rows are
     *      readable; with any other strides rows past m are not read.
     *   B: unit (k, j) at b + k * b_k + j [units]; nr columns are readable.  The packed stripe has b_k = nr.
     *   C: element (i, j) at c + i * ldc + j; elements outside [m, n] are neither read nor written.
     *
     * k = 0 clears C unless put is to add.  Past the caches go whole tiles whose rows are aligned to 64 bytes. */
    dar_mm_fn *mm;
    const dar_packers *pack; /* NULL: by plain loops */

    /* The same where B's next stripe lies beside this one, at b + nr: asks for it meanwhile, since pieces a row apart
     * are nothing that the hardware foresees.  NULL: there is none. */
    dar_mm_fn *mm_beside;

    /* Convolution: each of k units of B's channels is read at several places, and the sum runs over k taps units: unit
     * (i, k taps + s) of A at a + i * a_row + k * taps + s, with B's unit (k, j) at b + k * b_k + at[s] + j; the rest
     * as mm.  NULL for DAR_TILE_I8. */
    dar_mm_taps_fn *mm_taps;

    /* Its gradient by weights: row i of A begins rows[i] elements behind a, whole units or not; the rest as mm.  NULL
     * for DAR_TILE_I8. */
    dar_mm_rows_fn *mm_rows;
} dar_tile;

/* The kind that multiplies operands stored as t fastest here: f64 -> F64; bf16 -> BF16 where the processor has it, else
 * F32; everything else F32.  i8 is asked for by name. */
dar_tile_kind dar_tile_kind_for(dar_dtype t);

/* The tile of that kind that wastes least on n columns; dar_tile_fit: on m rows and n columns. */
const dar_tile *dar_tile_for(dar_tile_kind kind, size_t n);
const dar_tile *dar_tile_fit(dar_tile_kind kind, size_t m, size_t n);

/* Units of k that hold k elements, and bytes of a packed stripe over them. */
size_t dar_tile_units(const dar_tile *t, size_t k);
size_t dar_tile_bytes_a(const dar_tile *t, size_t k);
size_t dar_tile_bytes_b(const dar_tile *t, size_t k);

/* Pack, converting from the stored type: one stripe, or where m > mr or n > nr several, one after the other.  The rest
 * of the last stripe (rows past m, columns past n, k to a whole unit) is zero.  `ld` is the distance between stored
 * rows [elements].  Sources: f64, f32, bf16, f16 for the float kinds; bytes (DAR_I8) for DAR_TILE_I8.
 *
 *   a_mk: src[m][k]    a_km: src[k][m] (A is stored transposed)
 *   b_kn: src[k][n]    b_nk: src[n][k] (B is stored transposed: weights [out, in]) */
void dar_tile_pack_a_mk(const dar_tile *t, dar_dtype src_type, const void *src, size_t ld, size_t m, size_t k,
                        void *dst);
void dar_tile_pack_a_km(const dar_tile *t, dar_dtype src_type, const void *src, size_t ld, size_t m, size_t k,
                        void *dst);
void dar_tile_pack_b_kn(const dar_tile *t, dar_dtype src_type, const void *src, size_t ld, size_t k, size_t n,
                        void *dst);
void dar_tile_pack_b_nk(const dar_tile *t, dar_dtype src_type, const void *src, size_t ld, size_t k, size_t n,
                        void *dst);

/* As b_kn, into stripes of `wide` columns: mm reads such a stripe from any column with b_k = wide. */
void dar_tile_pack_b_wide(const dar_tile *t, dar_dtype src_type, const void *src, size_t ld, size_t k, size_t n,
                          size_t wide, void *dst);

/* Rows of A, src[m][k], converted but left rows, each filled up to whole units with zeros: for dar_tile.mm with a_row =
 * dar_tile_units(k) and a_k = 1.  Cheaper than stripes where there is a conversion for it. */
bool dar_tile_takes_rows(const dar_tile *t, dar_dtype src_type);
void dar_tile_pack_a_rows(const dar_tile *t, dar_dtype src_type, const void *src, size_t ld, size_t m, size_t k,
                          void *dst);

/* Fill the table for a set of DAR_CPU_ flags; called by dar_cpu_init. */
void dar_tile_init(unsigned cpu_flags);

#endif
