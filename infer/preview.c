/* preview.c: see preview.h. */
#include "infer/preview.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/sheet.h"
#include "lib/log.h"
#include "lib/size.h"

#define SHRINK  16  /* pixels in a latent row or column */
#define GROUP   4   /* frames in a latent frame */
#define COLUMNS 5   /* pictures, at most */
#define CELL    256 /* width of a picture [px] */
#define SHARE   10  /* of the time at most a tenth */

/* Where frames of the decoder go. */
struct wall {
    dar_preview *p;
    dar_sheet *sheet;
    size_t frames, next; /* next: column */
};

static size_t frame_of(const struct wall *w, size_t column)
{
    return w->p->columns > 1 ? column * (w->frames - 1) / (w->p->columns - 1) : 0;
}

static dar_status hang(void *ctx, const dar_tensor *frame, int64_t index, dar_err *e)
{
    struct wall *w = ctx;
    size_t width = (size_t)frame->shape.d[4], height = (size_t)frame->shape.d[3], n = width * height;
    (void)e;
    if (w->next == w->p->columns || (size_t)index != frame_of(w, w->next)) return DAR_OK;
    for (size_t i = 0; i < 3 * n; i++) {
        double x = dar_dtype_get(frame->dtype, frame->data, i % 3 * n + i / 3);
        w->p->rgb[i] = x > -1 ? (uint8_t)(127.5 * ((x < 1 ? x : 1) + 1) + 0.5) : 0;
    }
    dar_sheet_picture(w->sheet, 0, w->next++, w->p->rgb, width, height, DAR_SHRINK_MEAN);
    return DAR_OK;
}

/* z NULL: planning. */
static dar_status decode(dar_preview *p, dar_shape latent, const dar_tensor *z, struct wall *w, dar_err *e)
{
    dar_taew_stream stream;
    dar_status s = DAR_OK;
    dar_mark kept = dar_arena_mark(&p->kept);
    const int64_t F = latent.d[2];
    latent.d[2] = 1;
    dar_taew_stream_init(&stream, p->v, DAR_VAE_DECODER, &p->kept);
    for (int64_t f = 0; f < F && s == DAR_OK; f++) {
        dar_tape_place begin = dar_tape_mark(&p->tape);
        dar_val *x = dar_input(&p->tape, p->v->main, latent);
        if (z) {
            dar_tensor from = dar_tensor_narrow(z, 2, f, 1);
            dar_tensor_copy(&x->x, &from);
        }
        s = dar_taew_decode_next(&stream, &p->tape, x, z ? hang : NULL, w, e);
        dar_tape_reset(&p->tape, begin);
    }
    dar_arena_reset(&p->kept, kept);
    return s;
}

static dar_status begin(dar_preview *p, const size_t *bytes, dar_err *e)
{
    DAR_TRY(bytes ? dar_arena_init(&p->kept, "preview", bytes[0], e) : dar_arena_init_plan(&p->kept, "preview", e));
    DAR_TRY(bytes ? dar_arena_init(&p->step, "preview", bytes[1], e) : dar_arena_init_plan(&p->step, "preview", e));
    DAR_TRY(dar_tape_init(&p->tape, &p->step, e));
    p->tape.recording = false;
    return DAR_OK;
}

static void end(dar_preview *p)
{
    dar_tape_free(&p->tape);
    dar_arena_free(&p->kept);
    dar_arena_free(&p->step);
    p->tape = (dar_tape){ 0 };
}

dar_status dar_preview_plan(const dar_taew *v, dar_shape latent, size_t bytes[3], dar_err *e)
{
    dar_preview p = { .v = v };
    dar_status s = begin(&p, NULL, e);
    if (s == DAR_OK) s = decode(&p, latent, NULL, NULL, e);
    bytes[0] = p.kept.peak, bytes[1] = p.step.peak;
    bytes[2] = 3 * SHRINK * SHRINK * (size_t)(latent.d[3] * latent.d[4]);
    end(&p);
    return s;
}

dar_status dar_preview_init(dar_preview *p, const dar_taew *v, dar_shape latent, size_t steps, const char *path,
                            dar_err *e)
{
    size_t bytes[3];
    *p = (dar_preview){ .v = v, .steps = steps, .columns = dar_least(COLUMNS, (size_t)latent.d[2]) };
    dar_status s = dar_preview_plan(v, latent, bytes, e);
    if (s == DAR_OK && (size_t)snprintf(p->path, sizeof p->path, "%s", path) >= sizeof p->path)
        s = dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long", path);
    if (s == DAR_OK) s = begin(p, bytes, e);
    if (s == DAR_OK && !(p->rgb = malloc(bytes[2]))) s = dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    if (s != DAR_OK) dar_preview_free(p);
    return s;
}

void dar_preview_free(dar_preview *p)
{
    end(p);
    free(p->rgb);
    *p = (dar_preview){ 0 };
}

static dar_status draw(dar_preview *p, size_t done, const dar_tensor *clean, dar_err *e)
{
    const int64_t *d = clean->shape.d;
    dar_sheet sheet = { 0 };
    struct wall w = { .p = p, .sheet = &sheet, .frames = GROUP * (size_t)(d[2] - 1) + 1 };
    char text[64];
    snprintf(text, sizeof text, "after %zu of %zu steps", done, p->steps);
    dar_sheet_plan plan = { .title = "preview", .subtitle = text, .rows = 1, .columns = p->columns };
    plan.width = dar_least(CELL, SHRINK * (size_t)d[4]);
    plan.height = dar_most(1, plan.width * (size_t)d[3] / (size_t)d[4]);
    DAR_TRY(dar_sheet_init(&sheet, &plan, e));
    for (size_t k = 0; k < p->columns; k++) {
        snprintf(text, sizeof text, "frame %zu", frame_of(&w, k));
        dar_sheet_column(&sheet, k, text);
    }
    dar_status s = decode(p, clean->shape, clean, &w, e);
    if (s == DAR_OK) s = dar_sheet_write(&sheet, p->path, e);
    dar_sheet_free(&sheet);
    return s;
}

dar_status dar_preview_show(dar_preview *p, size_t done, const dar_tensor *clean, dar_err *e)
{
    double now = dar_log_clock();
    if (p->took > 0 && now - p->ready < SHARE * p->took) return DAR_OK;
    DAR_TRY(draw(p, done, clean, e));
    p->ready = dar_log_clock();
    p->took = p->ready - now;
    return DAR_OK;
}
