/* lora.c: declaring, merging; files are in lora_file.c. */
#include "models/lora.h"

#include <math.h>

#include "lib/gemm.h"
#include "lib/kern.h"
#include "lib/thread.h"

#define ROWS 256 /* of W at a time when merging */

void dar_lora_declare(dar_dit *m, dar_params *p, int64_t block, dar_projection which, int64_t rank)
{
    dar_dit_product *q = &m->block[block].product[which];
    const int64_t *d = q->w->x.shape.d; /* out, in */
    char module[DAR_PARAM_NAME];
    dar_param_info down = { DAR_PARAM_LORA, true, DAR_FRESH_UNIFORM, 1 / sqrt((double)d[1]) };
    dar_param_info up = { DAR_PARAM_LORA, true, DAR_FRESH_VALUE, 0 };

    dar_lora_module(module, sizeof module, block, which);
    q->down = dar_params_add(p, down, DAR_SHAPE(rank, d[1]), "%s.lora_down.weight", module);
    q->up = dar_params_add(p, up, DAR_SHAPE(d[0], rank), "%s.lora_up.weight", module);
}

void dar_lora_init(dar_dit *m, dar_params *p, const dar_lora_config *c)
{
    if (!c->rank) return;
    for (int64_t i = 0; i < m->c.layers; i++)
        for (int k = 0; k < DAR_PROJECTIONS; k++) {
            if (!(c->targets >> k & 1)) continue;
            dar_lora_declare(m, p, i, (dar_projection)k, c->rank);
            m->block[i].product[k].scale = c->alpha / (double)c->rank;
        }
}

/* ---------------------------------------------------------------- merging */

struct quantised {
    const dar_tensor *rows, *to;
    size_t first;
};

static void quantise_rows(void *ctx, size_t begin, size_t end, int thread)
{
    const struct quantised *q = ctx;
    size_t k = dar_tensor_cols(q->rows);
    (void)thread;
    for (size_t i = begin; i < end; i++)
        q->to->scale[q->first + i] = dar_row_quantise(q->rows->dtype, dar_tensor_at(q->rows, i * k), k,
                                                      (int8_t *)q->to->data + (q->first + i) * k);
}

/* Rows of `to` from `first` on become `rows`, rounded to its type. */
static void store(const dar_tensor *to, int64_t first, const dar_tensor *rows)
{
    if (to->dtype == DAR_I8) {
        struct quantised q = { rows, to, (size_t)first };
        dar_parallel_range(dar_tensor_rows(rows), 8, quantise_rows, &q);
    } else {
        dar_tensor part = dar_tensor_narrow(to, 0, first, rows->shape.d[0]);
        dar_tensor_copy(&part, rows);
    }
}

/* sum += scale U A, rows [i, i + n) of it */
static dar_gemm addition(const dar_dit_product *q, double scale, int64_t i, int64_t n, const dar_tensor *sum)
{
    dar_tensor u = dar_tensor_narrow(&q->up->x, 0, i, n);
    size_t rank = dar_tensor_cols(&u), in = dar_tensor_cols(sum);
    return (dar_gemm){ .kind = sum->dtype == DAR_F64 ? DAR_TILE_F64 : DAR_TILE_F32,
                       .m = (size_t)n,
                       .n = in,
                       .k = rank,
                       .a = { .type = u.dtype, .data = u.data, .ld = rank },
                       .b = { .type = q->down->x.dtype, .data = q->down->x.data, .ld = in },
                       .alpha = scale,
                       .type = sum->dtype,
                       .c = sum->data,
                       .ldc = in,
                       .add = true };
}

/* to = from + scale U A, both [out, in], possibly the same; scale 0: without the addition. */
static void add_product(const dar_dit_product *q, double scale, const dar_tensor *from, const dar_tensor *to,
                        dar_arena *scratch)
{
    int64_t out = from->shape.d[0], in = from->shape.d[1];
    dar_mark m = dar_arena_mark(scratch);
    dar_tensor sum = dar_tensor_push(scratch, dar_compute_type(from->dtype), DAR_SHAPE(ROWS, in));

    for (int64_t i = 0; i < out; i += ROWS) {
        int64_t n = out - i < ROWS ? out - i : ROWS;
        dar_tensor rows = dar_tensor_narrow(&sum, 0, 0, n), old = dar_tensor_narrow(from, 0, i, n);
        dar_gemm g = scale != 0 ? addition(q, scale, i, n, &sum) : (dar_gemm){ .type = sum.dtype };
        dar_mark inner = dar_arena_mark(scratch);
        void *work = dar_arena_push(scratch, dar_gemm_scratch(&g));
        if (!scratch->plan) {
            dar_tensor_copy(&rows, &old);
            dar_gemm_run(&g, work);
            store(to, i, &rows);
        }
        dar_arena_reset(scratch, inner);
    }
    dar_arena_reset(scratch, m);
}

static void swap(dar_tensor *a, dar_tensor *b)
{
    dar_tensor t = *a;
    *a = *b;
    *b = t;
}

static void merge(dar_dit_product *q, dar_params *p, dar_arena *scratch)
{
    DAR_ASSERT(q->w->x.dtype != DAR_I8, "lora: %s is stored in 8 bits", q->w->name);
    if (q->w->mapped) {
        if (!q->other.data) q->other = dar_tensor_push(p->arena, q->w->x.dtype, q->w->x.shape);
        add_product(q, q->scale, &q->w->x, &q->other, scratch);
        swap(&q->w->x, &q->other);
    } else {
        add_product(q, q->scale, &q->w->x, &q->w->x, scratch);
    }
    q->merged = true;
}

static void unmerge(dar_dit_product *q, dar_arena *scratch)
{
    DAR_ASSERT(q->w->x.dtype != DAR_I8, "lora: %s is stored in 8 bits", q->w->name);
    if (q->w->mapped) swap(&q->w->x, &q->other);
    else add_product(q, -q->scale, &q->w->x, &q->w->x, scratch);
    q->merged = false;
}

void dar_lora_merge(dar_dit *m, dar_params *p, dar_arena *scratch)
{
    for (int64_t i = 0; i < m->c.layers; i++)
        for (int k = 0; k < DAR_PROJECTIONS; k++) {
            dar_dit_product *q = &m->block[i].product[k];
            if (q->down && !q->merged) merge(q, p, scratch);
        }
}

void dar_lora_unmerge(dar_dit *m, dar_arena *scratch)
{
    for (int64_t i = 0; i < m->c.layers; i++)
        for (int k = 0; k < DAR_PROJECTIONS; k++) {
            dar_dit_product *q = &m->block[i].product[k];
            if (q->merged) unmerge(q, scratch);
        }
}

/* ---------------------------------------------------------------- 8 bits */

static void to_8_bits(dar_dit_product *q, dar_params *p, dar_arena *scratch)
{
    bool merge = q->down && !q->merged && !q->down->trainable;
    DAR_ASSERT(!q->w->trainable && q->w->x.dtype != DAR_I8, "lora: %s is %s, cannot be stored in 8 bits", q->w->name,
               q->w->trainable ? "trained" : "so already");
    dar_tensor x = dar_tensor_push(p->arena, DAR_I8, q->w->x.shape);
    add_product(q, merge ? q->scale : 0, &q->w->x, &x, scratch);
    q->w->x = x;
    q->w->mapped = false;
    q->merged |= merge;
}

void dar_lora_quantise(dar_dit *m, dar_params *p, int64_t from, int64_t to, dar_arena *scratch)
{
    DAR_ASSERT(from >= 0 && to <= m->c.layers, "lora: blocks %lld to %lld of %lld", (long long)from, (long long)to,
               (long long)m->c.layers);
    for (int64_t i = from; i < to; i++)
        for (int k = 0; k < DAR_PROJECTIONS; k++) to_8_bits(&m->block[i].product[k], p, scratch);
}
