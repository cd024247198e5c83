/* model.c: see model.h. */
#include "tests/model.h"

#include <stdio.h>

#include "lib/rng.h"

const double model_times[] = { 0, 731.25, 0, 38.5 };

static void must(dar_status s, const dar_err *e)
{
    DAR_ASSERT(s == DAR_OK, "%s", e->text);
}

dar_config model_preset(const char *name)
{
    char path[256];
    dar_config c;
    dar_err e;
    snprintf(path, sizeof path, "models/presets/%s.json", name);
    must(dar_config_open(&c, path, &e), &e);
    return c;
}

static void arena(dar_arena *a, const char *name, size_t bytes, bool plan)
{
    dar_err e;
    must(plan ? dar_arena_init_plan(a, name, &e) : dar_arena_init(a, name, bytes, &e), &e);
}

void model_init(model *o, const dar_config *c, dar_dtype storage, bool plan)
{
    dar_err e;
    *o = (model){ .c = *c };
    arena(&o->weights, "weights", (size_t)64 << 20, plan);
    arena(&o->step, "step", (size_t)256 << 20, plan);
    arena(&o->keep, "keep", (size_t)64 << 20, plan);
    must(dar_tape_init(&o->tape, &o->step, &e), &e);
    o->tape.keep = &o->keep;
    dar_params_init(&o->p, &o->weights, storage);
    dar_dit_init(&o->m, &o->p, &c->dit, &c->adapter);
}

void model_free(model *o)
{
    dar_dit_free(&o->m);
    dar_params_free(&o->p);
    dar_tape_free(&o->tape);
    dar_arena_free(&o->weights);
    dar_arena_free(&o->step);
    dar_arena_free(&o->keep);
}

static dar_tensor push(model *o, dar_dtype type, dar_shape s, uint64_t stream)
{
    dar_tensor x = dar_tensor_push(&o->weights, type, s);
    if (!o->weights.plan) dar_rng_fill_uniform(&x, 3, stream, -1, 1);
    return x;
}

void model_clip(model *o, int64_t frames, int64_t rows, int64_t columns, int64_t text)
{
    const dar_dit_config *d = &o->c.dit;
    const dar_adapter_config *a = &o->c.adapter;
    int64_t B = o->c.dit.width < 1000 ? 2 : 1, h = rows * d->patch, w = columns * d->patch, side = 2 * a->unshuffle;
    dar_dtype main = o->p.main;

    o->clip = (dar_dit_clip){ .clips = B, .frames = frames, .height = h, .width = w };
    o->clip.cond = push(o, main, DAR_SHAPE(B, a->rays + a->geometry, frames, rows * side, columns * side), 1);
    o->clip.known = push(o, main, DAR_SHAPE(B, d->mask + d->latent, frames, h, w), 2);
    o->z = push(o, main, DAR_SHAPE(B, d->latent, frames, h, w), 3);
    o->target = push(o, main, o->z.shape, 4);
    o->text = push(o, main, DAR_SHAPE(B, text, d->text_width), 5);
    o->count[0] = text > 3 ? text - 3 : text;
    o->count[1] = text;
}

static void read(dar_weights *f, const char *name, dar_tensor *x)
{
    dar_err e;
    dar_tensor y;
    must(dar_weights_tensor(f, name, &y, &e), &e);
    dar_tensor_copy(x, &y);
}

void model_fixture(model *o, dar_weights *weights)
{
    dar_err e;
    dar_tensor x;
    for (size_t i = 0; i < o->p.count; i++) {
        dar_param *q = o->p.at[i];
        if (q->info.role == DAR_PARAM_LORA) continue;
        must(dar_weights_tensor(weights, q->name, &x, &e), &e);
        dar_param_bind(&o->p, q, &x);
    }
    model_clip(o, 3, 2, 3, 7);
    read(weights, "in.cond", &o->clip.cond);
    read(weights, "in.known", &o->clip.known);
    read(weights, "in.z", &o->z);
    read(weights, "in.target", &o->target);
    read(weights, "in.text", &o->text);
}

dar_val *model_velocity(model *o)
{
    dar_tape *t = &o->tape;
    dar_tape_clear(t);
    dar_arena_reset(&o->step, 0);
    dar_arena_reset(&o->keep, 0);
    dar_dit_scene *s = dar_tape_room(t, sizeof *s);
    dar_dit_text *x = dar_tape_room(t, sizeof *x);
    dar_dit_scene_prepare(t, &o->m, &o->clip, s);
    dar_dit_text_prepare(t, &o->m, &o->text, o->count, x);
    return dar_dit_forward(t, &o->m, s, x, dar_leaf(t, o->z, NULL), &(dar_dit_time){ model_times, 2 });
}

dar_val *model_loss(model *o)
{
    dar_val *v = model_velocity(o);
    return dar_squared_error(&o->tape, v, dar_leaf(&o->tape, o->target, NULL), NULL, true);
}
