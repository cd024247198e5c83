/* lora.c: declaring, merging; files are in lora_file.c. */
#include "models/lora.h"

#include <math.h>

#include "lib/gemm.h"
#include "lib/kern.h"

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

/* to = from + scale U A, both [out, in], possibly the same. */
static void add_product(const dar_dit_product *q, double scale, const dar_tensor *from, const dar_tensor *to,
                        dar_arena *scratch)
{
    int64_t out = from->shape.d[0], in = from->shape.d[1], rank = q->down->x.shape.d[0];
    dar_dtype wide = dar_compute_type(from->dtype);
    dar_mark m = dar_arena_mark(scratch);
    dar_tensor sum = dar_tensor_push(scratch, wide, DAR_SHAPE(ROWS, in));

    for (int64_t i = 0; i < out; i += ROWS) {
        int64_t n = out - i < ROWS ? out - i : ROWS;
        dar_tensor rows = dar_tensor_narrow(&sum, 0, 0, n);
        dar_tensor old = dar_tensor_narrow(from, 0, i, n), new = dar_tensor_narrow(to, 0, i, n);
        dar_tensor u = dar_tensor_narrow(&q->up->x, 0, i, n);
        dar_gemm g = { .kind = wide == DAR_F64 ? DAR_TILE_F64 : DAR_TILE_F32,
                       .m = (size_t)n,
                       .n = (size_t)in,
                       .k = (size_t)rank,
                       .a = { .type = u.dtype, .data = u.data, .ld = (size_t)rank },
                       .b = { .type = q->down->x.dtype, .data = q->down->x.data, .ld = (size_t)in },
                       .alpha = scale,
                       .type = wide,
                       .c = sum.data,
                       .ldc = (size_t)in,
                       .add = true };
        dar_mark inner = dar_arena_mark(scratch);
        void *work = dar_arena_push(scratch, dar_gemm_scratch(&g));
        if (!scratch->plan) {
            dar_tensor_copy(&rows, &old);
            dar_gemm_run(&g, work);
            dar_tensor_copy(&new, &rows);
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
