/* cache.c: see cache.h. */
#include "train/cache.h"

#include <errno.h>
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#include "data/h5.h"
#include "data/rays.h"
#include "lib/dir.h"
#include "lib/log.h"
#include "lib/sha256.h"
#include "models/encode.h"

#define FORMAT "dar-cache/1"

struct dar_cache {
    char dir[PATH_MAX];
    const dar_vae *v;
    char encoder[DAR_SHA256_TEXT];
};

/* ---------------------------------------------------------------- names */

static void add_numbers(dar_sha256 *h, size_t n, const int64_t *x)
{
    char text[32];
    for (size_t i = 0; i < n; i++) dar_sha256_add(h, text, (size_t)snprintf(text, sizeof text, "%" PRId64 ",", x[i]));
}

static bool encodes(const dar_param *q)
{
    return !strncmp(q->name, "encoder.", 8) || !strncmp(q->name, "conv1.", 6);
}

/* All that moments depend on but for the pixels. */
static void hash_encoder(const dar_vae *v, const dar_params *p, char sum[DAR_SHA256_TEXT])
{
    const dar_vae_config *c = &v->c;
    dar_sha256 h;
    dar_sha256_init(&h);
    dar_sha256_add(&h, FORMAT, sizeof FORMAT);
    add_numbers(&h, 5, (int64_t[]){ v->storage, c->latent, c->patch, c->levels, c->encoder_blocks });
    add_numbers(&h, (size_t)c->levels, c->multipliers);
    for (int i = 0; i < c->levels - 1; i++) add_numbers(&h, 1, (int64_t[]){ c->halve_time[i] });
    for (size_t i = 0; i < p->count; i++) {
        const dar_param *q = p->at[i];
        if (!encodes(q)) continue;
        dar_sha256_add(&h, q->name, strlen(q->name) + 1);
        add_numbers(&h, 1, (int64_t[]){ q->x.dtype });
        add_numbers(&h, (size_t)q->x.shape.n, q->x.shape.d);
        dar_sha256_add(&h, q->x.data, dar_tensor_bytes(&q->x));
    }
    dar_sha256_finish(&h, sum);
}

static dar_status entry_path(const dar_cache *c, const dar_bundle *b, char path[PATH_MAX], dar_err *e)
{
    char pictures[DAR_SHA256_TEXT], key[DAR_SHA256_TEXT];
    const dar_bundle_meta *m = &b->meta;
    dar_sha256 h;
    DAR_TRY(dar_bundle_sum(b, "rgb.h5", pictures, e));
    dar_sha256_init(&h);
    dar_sha256_add(&h, c->encoder, DAR_SHA256_TEXT);
    dar_sha256_add(&h, pictures, DAR_SHA256_TEXT);
    add_numbers(&h, 3, (int64_t[]){ (int64_t)m->frames, m->height, m->width });
    dar_sha256_finish(&h, key);
    if ((size_t)snprintf(path, PATH_MAX, "%s/%s.h5", c->dir, key) < PATH_MAX) return DAR_OK;
    return dar_fail(e, DAR_ERR_IO, "%.200s...: %s", c->dir, strerror(ENAMETOOLONG));
}

dar_status dar_cache_open(dar_cache **out, const char *dir, const dar_vae *v, const dar_params *p, dar_err *e)
{
    dar_cache *c = calloc(1, sizeof *c);
    *out = c;
    if (!c) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", dir);
    snprintf(c->dir, sizeof c->dir, "%s", dir);
    c->v = v;
    if (!p->arena->plan) hash_encoder(v, p, c->encoder);
    return DAR_OK;
}

void dar_cache_close(dar_cache *c)
{
    free(c);
}

dar_shape dar_cache_shape(const dar_cache *c, const dar_bundle *b)
{
    const int64_t r = dar_vae_shrink(&c->v->c);
    return DAR_SHAPE(2 * c->v->c.latent, (int64_t)dar_rays_latent_frames(b->meta.frames), b->meta.height / r,
                     b->meta.width / r);
}

void dar_cache_normalise(const dar_cache *c, const dar_tensor *x)
{
    size_t channels = (size_t)x->shape.d[0], n = dar_tensor_count(x) / channels;
    float *y = x->data;
    DAR_ASSERT(x->dtype == DAR_F32 && x->shape.d[0] == c->v->c.latent, "cache: %lld channels of type %d",
               (long long)x->shape.d[0], (int)x->dtype);
    for (size_t k = 0; k < channels; k++) {
        float mean = (float)dar_dtype_get(c->v->main, c->v->mean.data, k);
        float rate = (float)dar_dtype_get(c->v->main, c->v->rate.data, k);
        for (size_t i = 0; i < n; i++) y[k * n + i] = (y[k * n + i] - mean) * rate;
    }
}

/* ---------------------------------------------------------------- entries */

enum { MOMENTS, KNOWN, PARTS };
static const char *const part_name[PARTS] = { "moments", "known" };

static dar_h5_array array_of(const dar_shape *s)
{
    dar_h5_array a = { .type = DAR_H5_F32, .rank = s->n, .chunk = (uint64_t)s->d[0] };
    for (int i = 0; i < s->n; i++) a.dim[i] = (uint64_t)s->d[i];
    return a;
}

static dar_shape part_shape(dar_shape moments, int part)
{
    if (part == KNOWN) moments.d[0] /= 2;
    return moments;
}

static void sum_of(const dar_tensor *x, char sum[DAR_SHA256_TEXT])
{
    dar_sha256 h;
    dar_sha256_init(&h);
    dar_sha256_add(&h, x->data, dar_tensor_bytes(x));
    dar_sha256_finish(&h, sum);
}

static dar_status read_part(dar_h5 *f, const char *path, int part, const dar_tensor *x, dar_err *e)
{
    const char *name = part_name[part];
    char found[DAR_SHA256_TEXT], expected[DAR_SHA256_TEXT];
    dar_h5_array a = array_of(&x->shape);
    DAR_TRY(dar_h5_expect(f, name, &a, e));
    DAR_TRY(dar_h5_get_text(f, name, "sha256", expected, sizeof expected, e));
    DAR_TRY(dar_h5_read(f, name, &a, 0, a.dim[0], x->data, e));
    sum_of(x, found);
    if (!strcmp(found, expected)) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: found sha256 %.16s..., expected %.16s...", path, name, found, expected);
}

dar_status dar_cache_read(const dar_cache *c, const dar_bundle *b, const dar_tensor *moments, const dar_tensor *known,
                          dar_err *e)
{
    char path[PATH_MAX];
    dar_h5 *f;
    DAR_TRY(entry_path(c, b, path, e));
    DAR_TRY(dar_h5_open(&f, path, e));
    dar_status s = read_part(f, path, MOMENTS, moments, e);
    if (s == DAR_OK && known) s = read_part(f, path, KNOWN, known, e);
    dar_h5_close(f);
    return s;
}

static dar_status write_entry(const char *path, const dar_tensor x[PARTS], dar_err *e)
{
    char sum[DAR_SHA256_TEXT];
    dar_h5 *f;
    DAR_TRY(dar_h5_create(&f, path, e));
    dar_status s = DAR_OK;
    for (int k = 0; k < PARTS && s == DAR_OK; k++) {
        dar_h5_array a = array_of(&x[k].shape);
        sum_of(&x[k], sum);
        s = dar_h5_make(f, part_name[k], &a, e);
        if (s == DAR_OK) s = dar_h5_write(f, part_name[k], &a, 0, a.dim[0], x[k].data, e);
        if (s == DAR_OK) s = dar_h5_put_text(f, part_name[k], "sha256", sum, e);
    }
    if (s == DAR_OK) s = dar_h5_commit(f, e);
    dar_h5_close(f);
    return s;
}

/* ---------------------------------------------------------------- making them */

/* For clips of one size; made again for another. */
struct encoder {
    const dar_cache *c;
    dar_arena kept, step;
    dar_tape tape;
    size_t frames;
    int height, width;
    uint8_t *rgb;           /* of a frame */
    dar_tensor moments;     /* [1, ..], main type */
    dar_tensor part[PARTS]; /* as they are stored */
    dar_bundle *b;
    bool known;
};

static dar_status clip_pixels(void *ctx, int64_t piece, const dar_tensor *x, dar_err *e)
{
    struct encoder *n = ctx;
    for (int64_t k = 0; k < x->shape.d[2]; k++) {
        size_t frame = piece ? (size_t)((piece - 1) * x->shape.d[2] + 1 + k) : 0;
        bool grey = n->known && piece;
        if (!grey) DAR_TRY(dar_bundle_rgb(n->b, frame, n->rgb, e));
        dar_encode_frame(x, k, grey ? NULL : n->rgb);
    }
    return DAR_OK;
}

static dar_status encode_part(struct encoder *n, int part, dar_err *e)
{
    n->known = part == KNOWN;
    DAR_TRY(dar_encode_clip(&n->tape, n->c->v, &n->kept, true, clip_pixels, n, &n->moments, e));
    if (n->kept.plan) return DAR_OK;
    dar_tensor from = dar_tensor_narrow(&n->moments, 1, 0, n->part[part].shape.d[0]);
    from = dar_tensor_reshape(&from, n->part[part].shape);
    dar_tensor_copy(&n->part[part], &from);
    if (dar_tensor_nonfinite(&n->part[part]) < 0) return DAR_OK;
    return dar_fail(e, DAR_ERR_NUMERIC, "the autoencoder gives numbers that are not finite: are its weights right?");
}

/* Tensors and tape; planning, a clip is encoded too. */
static dar_status prepare(struct encoder *n, const dar_shape *s, dar_err *e)
{
    DAR_TRY(dar_tape_init(&n->tape, &n->step, e));
    n->tape.recording = false;
    n->rgb = dar_arena_push(&n->kept, 3 * (size_t)n->height * (size_t)n->width);
    n->moments = dar_tensor_push(&n->kept, n->c->v->main, DAR_SHAPE(1, s->d[0], s->d[1], s->d[2], s->d[3]));
    for (int k = 0; k < PARTS; k++) n->part[k] = dar_tensor_push(&n->kept, DAR_F32, part_shape(*s, k));
    return n->kept.plan ? encode_part(n, MOMENTS, e) : DAR_OK;
}

static void encoder_free(struct encoder *n)
{
    dar_tape_free(&n->tape);
    dar_arena_free(&n->kept);
    dar_arena_free(&n->step);
    *n = (struct encoder){ .c = n->c, .b = n->b };
}

static dar_status encoder_fit(struct encoder *n, const dar_bundle *b, dar_err *e)
{
    const dar_bundle_meta *m = &b->meta;
    const dar_shape s = dar_cache_shape(n->c, b);
    if (n->tape.arena && n->frames == m->frames && n->height == m->height && n->width == m->width) return DAR_OK;
    encoder_free(n);
    n->frames = m->frames;
    n->height = m->height;
    n->width = m->width;
    DAR_TRY(dar_arena_init_plan(&n->kept, "encoder", e));
    DAR_TRY(dar_arena_init_plan(&n->step, "piece", e));
    DAR_TRY(prepare(n, &s, e));
    size_t kept = n->kept.peak, step = n->step.peak;
    dar_tape_free(&n->tape);
    dar_arena_free(&n->kept);
    dar_arena_free(&n->step);
    DAR_TRY(dar_arena_init(&n->kept, "encoder", kept, e));
    DAR_TRY(dar_arena_init(&n->step, "piece", step, e));
    return prepare(n, &s, e);
}

static dar_status check_size(const dar_cache *c, const dar_bundle *b, const char *path, dar_err *e)
{
    const dar_bundle_meta *m = &b->meta;
    const int64_t r = dar_vae_shrink(&c->v->c);
    if (!b->rgb) return dar_fail(e, DAR_ERR_FORMAT, "%s: has no pictures (rgb.h5) to learn from", path);
    if (m->width % r || m->height % r || !dar_rays_latent_frames(m->frames))
        return dar_fail(e, DAR_ERR_USAGE,
                        "%s: found %zu frames of %d x %d, expected 1, 5, 9, ... of sides that %" PRId64 " divides",
                        path, m->frames, m->width, m->height, r);
    return DAR_OK;
}

static dar_status fill_clip(struct encoder *n, const char *path, dar_cache_report *r, dar_err *e)
{
    char entry[PATH_MAX];
    struct stat st;
    DAR_TRY(check_size(n->c, n->b, path, e));
    DAR_TRY(encoder_fit(n, n->b, e));
    DAR_TRY(entry_path(n->c, n->b, entry, e));
    bool there = access(entry, F_OK) == 0;
    if (there && dar_cache_read(n->c, n->b, &n->part[MOMENTS], &n->part[KNOWN], NULL) == DAR_OK) {
        r->found++;
        return DAR_OK;
    }
    for (int k = 0; k < PARTS; k++) DAR_TRY(encode_part(n, k, e));
    DAR_TRY(write_entry(entry, n->part, e));
    r->made++;
    r->damaged += there;
    if (stat(entry, &st) == 0) r->bytes += (uint64_t)st.st_size;
    return DAR_OK;
}

dar_status dar_cache_fill(dar_cache *c, const char *const *path, size_t n, dar_status (*told)(void *ctx, dar_err *e),
                          void *ctx, dar_cache_report *r, dar_err *e)
{
    struct encoder encoder = { .c = c };
    dar_progress progress = dar_progress_begin("latents", "clips", (double)n);
    dar_status s = DAR_OK;
    *r = (dar_cache_report){ 0 };
    DAR_TRY(dar_dir_make(c->dir, e));
    for (size_t i = 0; i < n && s == DAR_OK; i++) {
        s = dar_bundle_open(&encoder.b, path[i], e);
        if (s == DAR_OK) s = fill_clip(&encoder, path[i], r, e);
        dar_bundle_close(encoder.b);
        if (s == DAR_OK && told) s = told(ctx, e);
        dar_progress_step(&progress, (double)(i + 1), NULL);
    }
    dar_progress_end(&progress);
    encoder_free(&encoder);
    return s;
}
