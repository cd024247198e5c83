/* dar_eval_codec.c: the truth to latents and back: the best that a model which renders latents can do. */
#include "infer/dar_eval.h"

#include <inttypes.h>
#include <stdlib.h>
#include <string.h>

#include "models/encode.h"
#include "models/model.h"

struct dar_eval_codec {
    dar_model *m;
    dar_arena kept, step;
    dar_tape tape;
    size_t frames, width, height; /* that memory is reserved for */
};

/* ---------------------------------------------------------------- the model */

static dar_status read_model(dar_model_file *f, dar_err *e)
{
    dar_condition condition;
    dar_condition_read(&condition, dar_json_object(dar_json_root(f->doc), "condition"));
    DAR_TRY(dar_json_finish(f->doc, e));
    if (f->c.vae.levels) return DAR_OK;
    return dar_fail(e, DAR_ERR_USAGE, "%s: found no vae, expected one for the row 'codec'", f->path);
}

dar_status dar_eval_codec_open(dar_eval_codec **out, const dar_eval_codec_files *files, dar_err *e)
{
    dar_model_options o = { .weights = files->weights, .storage = DAR_BF16, .codec = true };
    dar_model_file f;
    dar_eval_codec *c = *out = calloc(1, sizeof *c);
    if (!c) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", files->model);
    o.part[DAR_MODEL_VAE] = files->vae;
    dar_status s = dar_model_file_open(&f, files->model, e);
    if (s == DAR_OK) s = read_model(&f, e);
    if (s == DAR_OK) s = dar_model_open(&c->m, &f, &o, e);
    dar_model_file_close(&f);
    if (s == DAR_OK) return DAR_OK;
    dar_eval_codec_close(c);
    *out = NULL;
    return s;
}

static void drop(dar_eval_codec *c)
{
    dar_tape_free(&c->tape);
    dar_arena_free(&c->kept);
    dar_arena_free(&c->step);
    c->frames = 0;
}

void dar_eval_codec_close(dar_eval_codec *c)
{
    if (!c) return;
    drop(c);
    dar_model_close(c->m);
    free(c);
}

dar_status dar_eval_codec_check(const dar_eval_codec *c, const dar_eval_clip *clip, dar_err *e)
{
    const size_t r = (size_t)dar_vae_shrink(&c->m->vae.c), s = (size_t)dar_vae_shrink_time(&c->m->vae.c);
    if (clip->width % r == 0 && clip->height % r == 0 && clip->frames % s == 1 % s) return DAR_OK;
    return dar_fail(e, DAR_ERR_USAGE,
                    "%s: found %zu frames of %zu x %zu, expected 1, %zu, %zu, ... of sides that %zu divides: without "
                    "--model there is no row 'codec'",
                    clip->path, clip->frames, clip->width, clip->height, 1 + s, 1 + 2 * s, r);
}

/* ---------------------------------------------------------------- a clip */

struct truth {
    const uint8_t *rgb;
    size_t values; /* of a frame */
};

static dar_status truth_pixels(void *ctx, int64_t piece, const dar_tensor *x, dar_err *e)
{
    const struct truth *truth = ctx;
    int64_t n = x->shape.d[2], first = piece ? 1 + (piece - 1) * n : 0;
    (void)e;
    for (int64_t k = 0; k < n; k++) dar_encode_frame(x, k, truth->rgb + (size_t)(first + k) * truth->values);
    return DAR_OK;
}

/* There and back; planning, only shapes. */
static dar_status pass(dar_eval_codec *c, struct truth *truth, dar_decode_sink *sink, void *ctx, dar_err *e)
{
    const dar_vae *v = &c->m->vae;
    const int64_t r = dar_vae_shrink(&v->c), C = v->c.latent;
    const int64_t F = 1 + ((int64_t)c->frames - 1) / dar_vae_shrink_time(&v->c);
    const int64_t h = (int64_t)c->height / r, w = (int64_t)c->width / r;
    dar_mark begin = dar_arena_mark(&c->kept);
    dar_tensor moments = dar_tensor_push(&c->kept, v->main, DAR_SHAPE(1, 2 * C, F, h, w));
    dar_tensor z = dar_tensor_push(&c->kept, v->main, DAR_SHAPE(1, C, F, h, w));
    dar_status s = dar_encode_clip(&c->tape, v, &c->kept, true, truth_pixels, truth, &moments, e);
    dar_tape_place m = dar_tape_mark(&c->tape);
    dar_val *y = dar_vae_normalise(&c->tape, v, dar_vae_mean(&c->tape, v, dar_leaf(&c->tape, moments, NULL)));
    if (!c->kept.plan) dar_tensor_copy(&z, &y->x);
    dar_tape_reset(&c->tape, m);
    if (s == DAR_OK) s = dar_decode_clip(&c->tape, v, &c->kept, &z, sink, ctx, e);
    dar_arena_reset(&c->kept, begin);
    return s;
}

/* Memory for clips of this size. */
static dar_status fit(dar_eval_codec *c, const dar_eval_clip *clip, dar_err *e)
{
    if (c->frames == clip->frames && c->width == clip->width && c->height == clip->height) return DAR_OK;
    drop(c);
    c->frames = clip->frames;
    c->width = clip->width;
    c->height = clip->height;
    DAR_TRY(dar_arena_init_plan(&c->kept, "codec", e));
    DAR_TRY(dar_arena_init_plan(&c->step, "piece", e));
    DAR_TRY(dar_tape_init(&c->tape, &c->step, e));
    c->tape.recording = false;
    DAR_TRY(pass(c, NULL, NULL, NULL, e));
    size_t kept = c->kept.peak, step = c->step.peak;
    dar_tape_free(&c->tape);
    dar_arena_free(&c->kept);
    dar_arena_free(&c->step);
    DAR_TRY(dar_arena_init(&c->kept, "codec", kept, e));
    DAR_TRY(dar_arena_init(&c->step, "piece", step, e));
    DAR_TRY(dar_tape_init(&c->tape, &c->step, e));
    c->tape.recording = false;
    return DAR_OK;
}

dar_status dar_eval_codec_run(dar_eval_codec *c, const dar_eval_clip *clip, const uint8_t *rgb, dar_decode_sink *sink,
                              void *ctx, dar_err *e)
{
    struct truth truth = { rgb, 3 * clip->width * clip->height };
    dar_status s = fit(c, clip, e);
    if (s != DAR_OK) drop(c);
    return s == DAR_OK ? pass(c, &truth, sink, ctx, e) : s;
}
