/* params.c: see params.h. */
#include "models/params.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "autograd/ops.h"
#include "lib/kern.h"
#include "lib/rng.h"

void dar_params_init(dar_params *p, dar_arena *arena, dar_dtype storage)
{
    *p = (dar_params){ .arena = arena, .storage = storage, .main = dar_compute_type(storage) };
}

void dar_params_free(dar_params *p)
{
    for (size_t i = 0; i < p->count; i++) free(p->at[i]);
    free(p->at);
    memset(p, 0, sizeof *p);
}

static void *have(void *memory)
{
    DAR_ASSERT(memory, "params: no memory for the table");
    return memory;
}

dar_param *dar_params_add(dar_params *p, dar_param_info info, dar_shape s, const char *name, ...)
{
    dar_param *q = have(calloc(1, sizeof *q));
    va_list args;

    va_start(args, name);
    int length = vsnprintf(q->name, sizeof q->name, name, args);
    va_end(args);
    DAR_ASSERT(length > 0 && (size_t)length < sizeof q->name, "params: the name %s is too long", q->name);
    DAR_ASSERT(!dar_params_find(p, q->name), "params: %s is declared twice", q->name);
    q->info = info;
    q->x = dar_tensor_of(info.matrix ? p->storage : p->main, s, NULL);
    if (p->count == p->room) {
        p->room = p->room ? 2 * p->room : 256;
        p->at = have(realloc(p->at, p->room * sizeof *p->at));
    }
    return p->at[p->count++] = q;
}

dar_param *dar_params_find(const dar_params *p, const char *name)
{
    for (size_t i = 0; i < p->count; i++)
        if (!strcmp(p->at[i]->name, name)) return p->at[i];
    return NULL;
}

void dar_params_train(dar_params *p, unsigned roles)
{
    for (size_t i = 0; i < p->count; i++) {
        dar_param *q = p->at[i];
        if (!(q->info.role & roles)) continue;
        DAR_ASSERT(!q->x.data, "params: %s has a value already", q->name);
        q->trainable = true;
        q->x.dtype = p->main;
    }
}

void dar_param_push(dar_params *p, dar_param *q)
{
    if (!q->x.data) q->x = dar_tensor_push(p->arena, q->x.dtype, q->x.shape);
}

void dar_param_bind(dar_params *p, dar_param *q, const dar_tensor *x)
{
    DAR_ASSERT(dar_shape_equal(&q->x.shape, &x->shape), "params: %s has another shape", q->name);
    DAR_ASSERT(!q->x.data, "params: %s has a value already", q->name);
    if (!q->trainable && q->x.dtype == x->dtype && dar_tensor_contiguous(x)) {
        q->x = *x;
        q->mapped = true;
        return;
    }
    dar_param_push(p, q);
    if (!p->arena->plan) dar_tensor_copy(&q->x, x);
}

static void fill(const dar_param *q, uint64_t seed)
{
    uint64_t stream = dar_rng_stream(q->name);
    double s = q->info.spread;
    if (q->info.law == DAR_FRESH_VALUE) dar_tensor_fill(&q->x, s);
    else if (q->info.law == DAR_FRESH_UNIFORM) dar_rng_fill_uniform(&q->x, seed, stream, -s, s);
    else dar_rng_fill_normal(&q->x, seed, stream, s);
}

void dar_param_fresh(dar_params *p, dar_param *q, uint64_t seed)
{
    if (q->x.data) return;
    dar_param_push(p, q);
    if (!p->arena->plan) fill(q, seed);
}

void dar_params_fresh(dar_params *p, unsigned roles, uint64_t seed)
{
    for (size_t i = 0; i < p->count; i++)
        if (p->at[i]->info.role & roles) dar_param_fresh(p, p->at[i], seed);
}

void dar_params_gradients(dar_params *p)
{
    for (size_t i = 0; i < p->count; i++) {
        dar_param *q = p->at[i];
        if (!q->trainable || q->g.data) continue;
        q->g = dar_tensor_push(p->arena, p->main, q->x.shape);
        if (!p->arena->plan) dar_tensor_fill(&q->g, 0);
    }
}

size_t dar_params_count(const dar_params *p, unsigned roles)
{
    size_t n = 0;
    for (size_t i = 0; i < p->count; i++)
        if (p->at[i]->info.role & roles) n += dar_shape_count(&p->at[i]->x.shape);
    return n;
}

dar_val *dar_param_leaf(dar_tape *t, const dar_param *q)
{
    if (!q) return NULL;
    DAR_ASSERT(q->x.data, "%s has no value", q->name);
    return dar_leaf(t, q->x, q->g.data ? &q->g : NULL);
}

dar_val *dar_param_operand(dar_tape *t, const dar_param *q, dar_dtype type)
{
    dar_val *w = dar_param_leaf(t, q);
    return w && dar_dtype_size(w->x.dtype) > dar_dtype_size(type) ? dar_cast(t, w, type) : w;
}
