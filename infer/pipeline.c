/* pipeline.c: see pipeline.h. */
#include "infer/pipeline.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "data/rays.h"
#include "models/encode.h"
#include "models/load.h"

const char *const dar_pipeline_precision[] = { "f64", "f32", "bf16", "int8", NULL };

/* ---------------------------------------------------------------- what comes from files */

static dar_status read_prompts(dar_pipeline *p, dar_err *e)
{
    char own[PATH_MAX];
    const dar_dit_config *c = &p->m->c.dit;
    const char *path = p->o.text, *other = p->o.negative;
    if (!path && p->b->text) path = dar_bundle_path(p->b, "text.safetensors", own);
    if (path) {
        DAR_TRY(dar_weights_open(&p->text[0], path, e));
        DAR_TRY(dar_load_text(c, p->text[0], path, "text", &p->words[0], e));
        if (!other && dar_weights_find(p->text[0], "negative"))
            DAR_TRY(dar_load_text(c, p->text[0], path, "negative", &p->words[1], e));
    }
    if (!other) return DAR_OK;
    DAR_TRY(dar_weights_open(&p->text[1], other, e));
    return dar_load_text(c, p->text[1], other, "negative", &p->words[1], e);
}

static dar_shape latent_shape(const dar_pipeline *p)
{
    return DAR_SHAPE(1, p->m->c.dit.latent, p->frames, p->height, p->width);
}

static dar_status read_noise(dar_pipeline *p, dar_err *e)
{
    const char *path = p->o.noise_file;
    char found[96], expected[96];
    dar_shape wanted = latent_shape(p);
    if (!path) return DAR_OK;
    DAR_TRY(dar_weights_open(&p->noise, path, e));
    if (dar_weights_count(p->noise) != 1)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu tensors, expected one", path, dar_weights_count(p->noise));
    DAR_TRY(dar_weights_tensor(p->noise, dar_weights_at(p->noise, 0)->name, &p->given, e));
    dar_shape s = p->given.shape;
    bool fits = s.n >= 4 && dar_shape_count(&s) == dar_shape_count(&wanted);
    for (int i = 1; i <= 4 && fits; i++) fits = s.d[s.n - i] == wanted.d[wanted.n - i];
    if (!fits)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found noise of %s, expected %s", path,
                        dar_shape_text(&s, found, sizeof found), dar_shape_text(&wanted, expected, sizeof expected));
    p->given = dar_tensor_reshape(&p->given, wanted);
    return DAR_OK;
}

/* ---------------------------------------------------------------- whether bundle and model fit */

/* The nearest size that is made of whole tokens, at least one. */
static int64_t whole_tokens(int64_t side, int64_t token)
{
    return side < token ? token : (side + token / 2) / token * token;
}

static dar_status measure(dar_pipeline *p, dar_condition_source *source, dar_err *e)
{
    const dar_bundle_meta *meta = &p->b->meta;
    const char *path = p->path;
    const int64_t token = dar_model_token(&p->m->c), shrink = dar_vae_shrink(&p->m->c.vae);
    if (meta->width % token || meta->height % token)
        return dar_fail(e, DAR_ERR_USAGE,
                        "%s: found %d x %d pixels, expected multiples of %lld, the width of a token: "
                        "render the bundle with --size %lldx%lld",
                        path, meta->width, meta->height, (long long)token, (long long)whole_tokens(meta->width, token),
                        (long long)whole_tokens(meta->height, token));
    DAR_TRY(dar_bundle_source(p->b, p->condition, source, e));
    p->frames = (int64_t)dar_rays_latent_frames(meta->frames);
    p->height = meta->height / shrink;
    p->width = meta->width / shrink;
    if (p->frames > 1) return DAR_OK;
    return dar_fail(e, DAR_ERR_USAGE, "%s: found 1 frame, which is the reference itself: expected 5, 9, 13, ...", path);
}

/* ---------------------------------------------------------------- the work, planned or real */

static bool plans(const dar_pipeline *p)
{
    return p->kept.plan;
}

static dar_status prepare(dar_pipeline *p, const dar_condition_source *source, const dar_sampler_config *c, dar_err *e)
{
    const dar_condition *condition = p->condition;
    DAR_TRY(dar_tape_init(&p->tape, &p->step, e));
    p->tape.recording = false;
    p->cond = (dar_tensor){ 0 };
    if (p->m->dit.adapter.w) {
        dar_shape s = dar_condition_shape(condition, source->path);
        dar_mark mark = dar_arena_mark(&p->step);
        p->cond = dar_tensor_push(&p->kept, DAR_F32, s);
        if (plans(p)) dar_arena_push(&p->step, (size_t)(2 * s.d[2] * s.d[3]));
        else DAR_TRY(dar_condition_build(condition, source, &p->step, &p->cond, e));
        dar_arena_reset(&p->step, mark);
        p->cond = dar_tensor_reshape(&p->cond, DAR_SHAPE(1, s.d[0], s.d[1], s.d[2], s.d[3]));
    }
    dar_sampler_clip clip = { .frames = p->frames, .height = p->height, .width = p->width, .cond = p->cond };
    clip.window = p->o.window, clip.overlap = p->o.overlap;
    for (int i = 0; i < 2; i++) clip.text[i] = p->words[i];
    return dar_sampler_init(&p->sampler, p->dit, c, &clip, &p->kept, &p->step, e);
}

static dar_status tell(const dar_pipeline_listener *l, dar_pipeline_stage stage, int64_t done, int64_t of, dar_err *e)
{
    return l && l->told ? l->told(l->ctx, stage, (size_t)done, (size_t)of, e) : DAR_OK;
}

struct known {
    const uint8_t *rgb;
    const dar_pipeline_listener *l;
    int64_t pieces;
};

/* The picture, then grey. */
static dar_status known_pixels(void *ctx, int64_t piece, const dar_tensor *x, dar_err *e)
{
    const struct known *k = ctx;
    for (int64_t f = 0; f < x->shape.d[2]; f++) dar_encode_frame(x, f, piece ? NULL : k->rgb);
    return piece ? tell(k->l, DAR_PIPELINE_ENCODE, piece, k->pieces, e) : DAR_OK;
}

/* The latent of the known video; without mask channels that of its first frame is all that is wanted. */
static dar_status encode(dar_pipeline *p, const uint8_t *rgb, const dar_tensor *latent, const dar_pipeline_listener *l,
                         dar_err *e)
{
    const dar_vae *v = &p->m->vae;
    const int64_t F = p->m->c.dit.mask ? p->frames : 1, C = latent->shape.d[1];
    const bool skip = p->o.sampler.skip >> DAR_SKIP_REPEAT & 1;
    struct known known = { rgb, l, F };
    dar_mark kept = dar_arena_mark(&p->kept);
    dar_tensor moments = dar_tensor_push(&p->kept, v->main, DAR_SHAPE(1, 2 * C, F, p->height, p->width));
    dar_status s = dar_encode_clip(&p->tape, v, &p->kept, skip, known_pixels, &known, &moments, e);
    if (s == DAR_OK) s = tell(l, DAR_PIPELINE_ENCODE, F, F, e);

    dar_tape_place begin = dar_tape_mark(&p->tape);
    dar_val *y = dar_vae_normalise(&p->tape, v, dar_vae_mean(&p->tape, v, dar_leaf(&p->tape, moments, NULL)));
    dar_tensor to = dar_tensor_narrow(latent, 2, 0, F);
    if (!plans(p)) dar_tensor_copy(&to, &y->x);
    dar_tape_reset(&p->tape, begin);
    dar_arena_reset(&p->kept, kept);
    return s;
}

struct picture {
    const dar_pipeline_listener *l;
    int64_t frames, group; /* of the latent; frames of one of them */
};

static dar_status show_frame(void *ctx, size_t index, const uint8_t *rgb, dar_err *e)
{
    const struct picture *p = ctx;
    const int64_t i = (int64_t)index;
    DAR_TRY(p->l->frame(p->l->ctx, index, rgb, e));
    return i % p->group ? DAR_OK : tell(p->l, DAR_PIPELINE_DECODE, i / p->group + 1, p->frames, e);
}

static dar_status decode(dar_pipeline *p, const dar_tensor *z, const dar_pipeline_listener *l, dar_err *e)
{
    const dar_vae *v = &p->m->vae;
    struct picture picture = { l, p->frames, dar_vae_shrink_time(&v->c) };
    return dar_decode_clip(&p->tape, v, &p->kept, z, show_frame, &picture, e);
}

struct steps {
    const dar_pipeline *p;
    const dar_pipeline_listener *l;
};

static dar_status step_done(void *ctx, size_t done, const dar_tensor *z, const dar_tensor *clean, dar_err *e)
{
    const struct steps *s = ctx;
    if (s->l && s->l->step) DAR_TRY(s->l->step(s->l->ctx, done, z, clean, e));
    return tell(s->l, DAR_PIPELINE_SAMPLE, (int64_t)done, (int64_t)s->p->o.sampler.solver.steps, e);
}

dar_status dar_pipeline_render(dar_pipeline *p, const uint8_t *reference, const dar_pipeline_listener *l, dar_err *e)
{
    const dar_dit_config *c = &p->m->c.dit;
    dar_mark kept = dar_arena_mark(&p->kept);
    dar_dtype main = p->m->dit.main;
    dar_shape s = latent_shape(p);
    dar_tensor latent = dar_tensor_push(&p->kept, main, s), z = dar_tensor_push(&p->kept, main, s), known = { 0 };
    struct steps steps = { p, l };
    double before = p->tape.cost.forward;

    dar_status status = encode(p, reference, &latent, l, e);
    before = p->tape.cost.forward - before;
    if (plans(p)) p->encode = before;
    else p->saved[DAR_SKIP_REPEAT] = fmax(p->encode - before, 0);
    if (c->mask) {
        bool *seen = dar_arena_push(&p->kept, (size_t)(p->frames * c->mask));
        known = dar_tensor_push(&p->kept, main, DAR_SHAPE(1, c->mask + c->latent, p->frames, p->height, p->width));
        if (!plans(p) && status == DAR_OK) {
            memset(seen, 0, (size_t)(p->frames * c->mask));
            seen[0] = true;
            dar_dit_known(&known, &latent, seen);
        }
    }
    if (!p->given.data) dar_sampler_noise(p->o.noise, p->o.seed, &z, &p->step);
    else if (!plans(p)) dar_tensor_copy(&z, &p->given);
    if (status == DAR_OK)
        status = dar_sampler_run(&p->sampler, c->mask ? &known : NULL, &latent, &z, step_done, &steps, e);
    before = p->tape.cost.forward;
    if (status == DAR_OK) status = decode(p, &z, l, e);
    p->decode = p->tape.cost.forward - before;
    dar_arena_reset(&p->kept, kept);
    return status;
}

/* ---------------------------------------------------------------- planning */

static void drop(dar_pipeline *p)
{
    dar_sampler_free(&p->sampler);
    dar_tape_free(&p->tape);
    dar_arena_free(&p->kept);
    dar_arena_free(&p->step);
    p->tape = (dar_tape){ 0 };
}

/* Count one video with these skips; the FLOPs of a whole one are returned in *flops. */
static dar_status count(dar_pipeline *p, const dar_condition_source *source, unsigned skip, double *flops, dar_err *e)
{
    dar_sampler_config c = p->o.sampler;
    c.skip = skip;
    DAR_TRY(dar_arena_init_plan(&p->kept, "clip", e));
    DAR_TRY(dar_arena_init_plan(&p->step, "step", e));
    DAR_TRY(prepare(p, source, &c, e));
    p->prepare = dar_sampler_flops(&p->sampler);
    DAR_TRY(dar_pipeline_render(p, NULL, NULL, e));
    p->sample = dar_sampler_flops(&p->sampler) - p->prepare;
    *flops = p->prepare + p->encode + p->sample + p->decode;
    return DAR_OK;
}

/* The same for a network whose low-rank additions were not merged. */
static dar_status count_apart(dar_pipeline *p, const dar_condition_source *source, double *flops, dar_err *e)
{
    const size_t layers = (size_t)p->m->c.dit.layers;
    dar_dit dit = p->m->dit;
    if (!(dit.block = malloc(layers * sizeof *dit.block)))
        return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", p->path);
    memcpy(dit.block, p->m->dit.block, layers * sizeof *dit.block);
    for (size_t i = 0; i < layers; i++)
        for (int k = 0; k < DAR_PROJECTIONS; k++) dit.block[i].product[k].merged = false;
    p->dit = &dit;
    dar_status s = count(p, source, p->o.sampler.skip, flops, e);
    p->dit = &p->m->dit;
    free(dit.block);
    return s;
}

/* What a video costs with all skips but k; repeat is told by the encoder when it has run. */
static dar_status count_without(dar_pipeline *p, const dar_condition_source *source, int k, double *flops, dar_err *e)
{
    const unsigned skip = p->o.sampler.skip;
    *flops = 0;
    if (k == DAR_SKIP_REPEAT || !(skip >> k & 1)) return DAR_OK;
    dar_status s =
        k == DAR_SKIP_LORA ? count_apart(p, source, flops, e) : count(p, source, skip & ~(1u << k), flops, e);
    drop(p);
    return s;
}

static dar_status plan(dar_pipeline *p, const dar_condition_source *source, size_t bytes[2], dar_err *e)
{
    double all;
    for (int k = 0; k < DAR_SKIPS; k++) DAR_TRY(count_without(p, source, k, &p->saved[k], e));
    dar_status s = count(p, source, p->o.sampler.skip, &all, e);
    for (int k = 0; k < DAR_SKIPS; k++) p->saved[k] = fmax(p->saved[k] - all, 0);
    bytes[0] = p->kept.peak;
    bytes[1] = p->step.peak;
    p->bytes = bytes[0] + bytes[1];
    drop(p);
    return s;
}

static dar_status open_clip(dar_pipeline *p, dar_err *e)
{
    dar_condition_source source;
    size_t bytes[2];
    DAR_TRY(measure(p, &source, e));
    DAR_TRY(read_prompts(p, e));
    DAR_TRY(read_noise(p, e));
    DAR_TRY(plan(p, &source, bytes, e));
    if (p->m->weights.plan) return DAR_OK;
    DAR_TRY(dar_arena_init(&p->kept, "clip", bytes[0], e));
    DAR_TRY(dar_arena_init(&p->step, "step", bytes[1], e));
    return prepare(p, &source, &p->o.sampler, e);
}

dar_status dar_pipeline_open(dar_pipeline **out, const dar_model *m, const dar_condition *c, const char *path,
                             dar_bundle *b, const dar_pipeline_options *o, dar_err *e)
{
    dar_pipeline *p = calloc(1, sizeof *p);
    *out = NULL;
    if (!p) return dar_fail(e, DAR_ERR_NOMEM, "sampling: out of memory");
    p->m = m;
    p->dit = &m->dit;
    p->condition = c;
    p->path = path;
    p->b = b;
    p->o = *o;
    dar_status s = open_clip(p, e);
    if (s == DAR_OK) *out = p;
    else dar_pipeline_close(p);
    return s;
}

void dar_pipeline_close(dar_pipeline *p)
{
    if (!p) return;
    drop(p);
    for (int i = 0; i < 2; i++) dar_weights_close(p->text[i]);
    dar_weights_close(p->noise);
    free(p);
}
