/* test_loader.c: batches: their order and content are a pure function of seed and step; the cache that feeds them holds
 * what the autoencoder gives, whatever happened to its files. */
#include "tests/scratch.h"

#include "data/bundle.h"
#include "data/h5.h"
#include "lib/log.h"
#include "lib/safetensors_write.h"
#include "models/encode.h"
#include "tests/made.h"
#include "train/cache.h"
#include "train/loader.h"

#define W      24
#define H      16
#define T      9
#define F      3
#define PIXELS ((size_t)W * H)
#define WIDER  (W + 8) /* a clip that does not fit */
#define MOST   ((size_t)WIDER * H)
#define CLIPS  5
#define WIDTH  7 /* of text */

/* ---------------------------------------------------------------- bundles */

/* Numbers that differ everywhere; `salt` tells clips apart. */
static void make_frame(int salt, int t, dar_gbuffer *g, uint8_t *rgb)
{
    for (size_t i = 0; i < 3 * PIXELS; i++) {
        uint64_t at = (uint64_t)(salt * T + t) * 3 * PIXELS + i;
        g->tracking[i] = g->world[i] = (float)made_random(at);
        rgb[i] = (uint8_t)(256 * made_random(at + 12345));
    }
    for (size_t i = 0; i < PIXELS; i++) {
        g->depth[i] = 1 + g->world[i];
        g->mask[i] = i % 7 != 0;
    }
}

struct shape {
    int width, height, frames;
    bool rgb, world;
};

static void write_bundle(const char *path, int salt, const struct shape *s)
{
    static float tracking[3 * MOST], world[3 * MOST], depth[MOST]; /* beyond PIXELS all 0 */
    static uint8_t mask[MOST], rgb[3 * MOST];
    dar_gbuffer g = { .tracking = tracking, .world = world, .depth = depth, .mask = mask };
    dar_bundle_options o = dar_bundle_standard();
    dar_bundle_writer *w;
    dar_camera_path cameras;
    dar_err e;
    const double at[3] = { 0.5, 0.5, 0.5 };
    o.families = 1u << DAR_FAMILY_TRACKING | 1u << DAR_FAMILY_DEPTH | (unsigned)s->world << DAR_FAMILY_WORLD;
    o.rgb = s->rgb;
    o.exports = false;
    ok(dar_camera_init(&cameras, (size_t)s->frames, &e), &e);
    for (int t = 0; t < s->frames; t++) {
        const double eye[3] = { 3 * sin(0.1 * t + salt), 0.5, 3 * cos(0.1 * t + salt) };
        cameras.view[t] = made_view(s->width, s->height, eye, at);
    }
    dar_bundle_meta m = { .frames = (size_t)s->frames, .width = s->width, .height = s->height, .fps = 16 };
    m.world = (dar_world){ .hi = { 1, 1, 1 }, .centre = { 0.5, 0.5, 0.5 }, .size = 1 };
    ok(dar_bundle_create(&w, path, &m, &cameras, &o, &e), &e);
    for (int t = 0; t < s->frames; t++) {
        make_frame(salt, t, &g, rgb);
        dar_bundle_frame frame = { .g = g, .rgb = s->rgb ? rgb : NULL };
        ok(dar_bundle_add(w, &frame, &e), &e);
    }
    if (salt == 2 || salt == 3) { /* prompts of two and of one token, and a row of zeros */
        float text[3 * WIDTH] = { 0 };
        for (int i = 0; i < (4 - salt) * WIDTH; i++) text[i] = (float)(salt + i);
        dar_safetensors_item item = { "text", dar_tensor_of(DAR_F32, DAR_SHAPE(3, WIDTH), text) };
        ok(dar_safetensors_write(in_dir("text.safetensors"), &item, 1, NULL, &e), &e);
        ok(dar_bundle_add_text(w, in_dir("text.safetensors"), &e), &e);
    }
    ok(dar_bundle_commit(w, &e), &e);
    dar_bundle_discard(w);
    dar_camera_free(&cameras);
}

static char clip_path[CLIPS][64];
static const char *clips[CLIPS];

/* ---------------------------------------------------------------- an autoencoder */

typedef struct coder {
    dar_config c;
    dar_arena weights;
    dar_params p;
    dar_vae v;
    dar_condition condition;
} coder;

static coder made;

static void coder_init(coder *x, uint64_t seed)
{
    dar_err e;
    *x = (coder){ 0 };
    x->c.dit = (dar_dit_config){ .latent = 5, .mask = 4, .patch = 2, .text_width = WIDTH, .text_keys = 4 };
    x->c.vae = (dar_vae_config){ .levels = 3,
                                 .latent = 5,
                                 .patch = 1,
                                 .multipliers = { 1, 2, 2 },
                                 .halve_time = { true, true },
                                 .encoder_width = 3,
                                 .decoder_width = 2,
                                 .encoder_blocks = 1,
                                 .decoder_blocks = 1 };
    for (int i = 0; i < 5; i++) x->c.vae.mean[i] = 0.1 * i, x->c.vae.std[i] = 1 + 0.3 * i;
    ok(dar_arena_init(&x->weights, "weights", 4 << 20, &e), &e);
    dar_params_init(&x->p, &x->weights, DAR_F32);
    dar_vae_init(&x->v, &x->p, &x->c.vae);
    dar_params_fresh(&x->p, DAR_PARAM_ALL, seed);
    ok(dar_channel_set_parse(&x->condition.set, "tracking+world", &e), &e);
}

static void coder_free(coder *x)
{
    dar_params_free(&x->p);
    dar_arena_free(&x->weights);
}

static int make_all(void **state)
{
    const struct shape s = { W, H, T, true, true };
    if (scratch_make(state) != 0) return -1;
    for (int i = 0; i < CLIPS; i++) {
        snprintf(clip_path[i], sizeof clip_path[i], "%s/clip%d", scratch_dir, i);
        clips[i] = clip_path[i];
        write_bundle(clips[i], i, &s);
    }
    coder_init(&made, 1);
    return 0;
}

static int remove_all(void **state)
{
    coder_free(&made);
    return scratch_remove(state);
}

static dar_cache_report fill(dar_cache *c)
{
    dar_cache_report r;
    dar_err e;
    ok(dar_cache_fill(c, clips, CLIPS, NULL, NULL, &r, &e), &e);
    return r;
}

static dar_cache *open_cache(const char *name, const coder *x)
{
    dar_cache *c;
    dar_err e;
    ok(dar_cache_open(&c, in_dir(name), &x->v, &x->p, &e), &e);
    return c;
}

/* ---------------------------------------------------------------- order */

static void test_order_is_a_permutation(void **state)
{
    (void)state;
    for (size_t n = 1; n <= 40; n++) {
        size_t order[40], seen[40] = { 0 };
        dar_loader_order(7, n, n, order);
        for (size_t i = 0; i < n; i++) {
            assert_true(order[i] < n);
            seen[order[i]]++;
        }
        for (size_t i = 0; i < n; i++) CHECK(seen[i] == 1, "%zu clips: %zu is there %zu times", n, i, seen[i]);
    }
}

/* Each of the 24 orders of four clips has its share: 1 / 24 +- 6 deviations of a count of 4,800. */
static void test_orders_are_equally_likely(void **state)
{
    int count[256] = { 0 }, kinds = 0;
    (void)state;
    for (uint64_t epoch = 0; epoch < 4800; epoch++) {
        size_t o[4];
        dar_loader_order(3, epoch, 4, o);
        count[o[0] | o[1] << 2 | o[2] << 4 | o[3] << 6]++;
    }
    for (int i = 0; i < 256; i++)
        if (count[i]) CHECK_NEAR("count of an order", count[i], 200, 6 * 13.9);
    for (int i = 0; i < 256; i++) kinds += count[i] > 0;
    assert_int_equal(kinds, 24);
}

/* ---------------------------------------------------------------- batches */

static dar_loader_config standard(const dar_cache *cache)
{
    return (dar_loader_config){ .path = clips,
                                .clips = CLIPS,
                                .batch = 2,
                                .ahead = 2,
                                .shuffle = true,
                                .seed = 11,
                                .cache = cache,
                                .dit = &made.c.dit,
                                .condition = &made.condition,
                                .pixels = true,
                                .frames = 5,
                                .height = 9,
                                .width = 14 };
}

static uint64_t add_bytes(uint64_t h, const void *x, size_t n)
{
    const unsigned char *p = x;
    for (size_t i = 0; i < n; i++) h = (h ^ p[i]) * 0x100000001b3u;
    return h;
}

/* Of everything in a batch. */
static uint64_t print_of(const dar_batch *b)
{
    const dar_tensor *x[] = { &b->z0, &b->known, &b->cond, &b->text, &b->pixels };
    uint64_t h = 0xcbf29ce484222325u;
    for (size_t i = 0; i < DAR_COUNT(x); i++) h = add_bytes(h, x[i]->data, dar_tensor_bytes(x[i]));
    h = add_bytes(h, b->count, 2 * sizeof *b->count);
    return add_bytes(h, b->clip, 2 * sizeof *b->clip);
}

static void run(const dar_loader_config *c, int64_t first, int64_t steps, uint64_t *print)
{
    dar_loader *l;
    const dar_batch *b;
    dar_err e;
    ok(dar_loader_open(&l, c, &e), &e);
    for (int64_t k = 0; k < steps; k++) {
        ok(dar_loader_get(l, first + k, &b, &e), &e);
        print[k] = print_of(b);
    }
    dar_loader_close(l);
}

/* Twelve steps of two clips out of five: batches that lie in two epochs are among them. */
static void test_batches_depend_on_seed_and_step_alone(void **state)
{
    enum { STEPS = 12 };
    uint64_t expected[STEPS], found[STEPS];
    (void)state;
    dar_cache *cache = open_cache("cache", &made);
    fill(cache);
    for (int posterior = 0; posterior < 2; posterior++) {
        dar_loader_config c = standard(cache);
        c.posterior = posterior;
        run(&c, 0, STEPS, expected);
        for (size_t ahead = 0; ahead < 4; ahead++) {
            c.ahead = ahead;
            dar_threads_set(3 - (int)ahead % 3);
            run(&c, 0, STEPS, found);
            for (int k = 0; k < STEPS; k++) CHECK(found[k] == expected[k], "step %d, %zu ahead", k, ahead);
        }
        run(&c, 7, 3, found);
        for (int k = 0; k < 3; k++) CHECK(found[k] == expected[7 + k], "resumed at step 7, step %d", 7 + k);
        c.seed++;
        run(&c, 0, STEPS, found);
        for (int k = 0; k < STEPS; k++) CHECK(found[k] != expected[k], "step %d with another seed", k);
    }
    dar_cache_close(cache);
}

/* Backwards, and the same again. */
static void test_steps_in_any_order(void **state)
{
    static const int64_t steps[] = { 9, 3, 3, 4, 0, 100, 99, 3 };
    uint64_t print[DAR_COUNT(steps)];
    dar_loader *l;
    const dar_batch *b;
    dar_err e;
    (void)state;
    dar_cache *cache = open_cache("cache", &made);
    fill(cache);
    dar_loader_config c = standard(cache);
    ok(dar_loader_open(&l, &c, &e), &e);
    for (size_t i = 0; i < DAR_COUNT(steps); i++) {
        ok(dar_loader_get(l, steps[i], &b, &e), &e);
        print[i] = print_of(b);
    }
    dar_loader_close(l);
    assert_true(print[1] == print[2] && print[1] == print[7]);
    for (size_t i = 0; i < DAR_COUNT(steps); i++) {
        uint64_t alone;
        run(&c, steps[i], 1, &alone);
        CHECK(alone == print[i], "step %lld", (long long)steps[i]);
    }
    dar_cache_close(cache);
}

/* In the order of the paths: latents, text, pixels of clip 2 and 3 are those clips' own. */
static void test_content(void **state)
{
    dar_loader *l;
    const dar_batch *b;
    dar_bundle *bundle;
    dar_condition_source source;
    dar_arena a;
    dar_err e;
    uint8_t rgb[3 * PIXELS];
    (void)state;
    dar_cache *cache = open_cache("cache", &made);
    fill(cache);
    dar_loader_config c = standard(cache);
    c.shuffle = false;
    c.frames = c.height = c.width = 0;
    ok(dar_loader_open(&l, &c, &e), &e);
    ok(dar_loader_get(l, 1, &b, &e), &e);
    assert_int_equal(b->clip[0], 2);
    assert_int_equal(b->clip[1], 3);
    assert_string_equal(b->path[1], clips[3]);

    assert_int_equal(b->count[0], 2);
    assert_int_equal(b->count[1], 1);
    assert_int_equal(b->text.shape.d[1], 2);
    for (int i = 0; i < 2 * WIDTH; i++) CHECK_NEAR("text", ((float *)b->text.data)[i], 2 + i, 0);
    for (int i = 0; i < 2 * WIDTH; i++)
        CHECK_NEAR("shorter text", ((float *)b->text.data)[2 * WIDTH + i], i < WIDTH ? 3 + i : 0, 0);

    ok(dar_bundle_open(&bundle, clips[3], &e), &e);
    for (size_t t = 0; t < T; t++) {
        ok(dar_bundle_rgb(bundle, t, rgb, &e), &e);
        for (size_t k = 0; k < 3; k++)
            for (size_t i = 0; i < PIXELS; i++)
                CHECK_NEAR("pixel", ((float *)b->pixels.data)[((3 + k) * T + t) * PIXELS + i],
                           rgb[3 * i + k] / 127.5 - 1, 1e-7);
    }
    ok(dar_arena_init(&a, "cond", 4 << 20, &e), &e);
    dar_tensor y = dar_tensor_push(&a, DAR_F32, dar_condition_shape(&made.condition, &bundle->cameras));
    ok(dar_bundle_source(bundle, &made.condition, &source, &e), &e);
    ok(dar_condition_build(&made.condition, &source, &a, &y, &e), &e);
    size_t n = dar_tensor_bytes(&y);
    assert_memory_equal((char *)b->cond.data + n, y.data, n);

    /* Latents: frame 0 is known, and is the clip's; masks are 1 there and 0 elsewhere. */
    const float *z = b->z0.data, *known = b->known.data;
    const size_t frame = (size_t)(b->z0.shape.d[3] * b->z0.shape.d[4]), C = 5, M = 4;
    for (size_t k = 0; k < M + C; k++)
        for (size_t i = 0; i < frame; i++) {
            float x = known[((M + C + k) * F) * frame + i];
            CHECK_NEAR("first frame", x, k < M ? 1 : z[((C + k - M) * F) * frame + i], 0);
            if (k < M) CHECK_NEAR("mask", known[((M + C + k) * F + 1) * frame + i], 0, 0);
        }
    dar_arena_free(&a);
    dar_bundle_close(bundle);
    dar_loader_close(l);
    dar_cache_close(cache);
}

/* Over 200 epochs, draws have the mean and the deviation that the cache holds: within 6 deviations of such estimates.
 */
static void test_posterior(void **state)
{
    enum { DRAWS = 200 };
    dar_loader *l;
    const dar_batch *b;
    dar_bundle *bundle;
    dar_err e;
    (void)state;
    dar_cache *cache = open_cache("cache", &made);
    fill(cache);
    dar_loader_config c = { .path = clips, .clips = 1, .batch = 1, .cache = cache, .dit = &made.c.dit };
    c.posterior = true;
    ok(dar_bundle_open(&bundle, clips[0], &e), &e);
    dar_shape s = dar_cache_shape(cache, bundle);
    size_t n = dar_shape_count(&s) / 2;
    float *moments = calloc(2 * n, sizeof *moments);
    double *sum = calloc(2 * n, sizeof *sum);
    dar_tensor m = dar_tensor_of(DAR_F32, s, moments);
    ok(dar_cache_read(cache, bundle, &m, NULL, &e), &e);
    ok(dar_loader_open(&l, &c, &e), &e);
    for (int k = 0; k < DRAWS; k++) {
        ok(dar_loader_get(l, k, &b, &e), &e);
        for (size_t i = 0; i < n; i++) {
            size_t channel = i / (n / 5);
            double x = ((float *)b->z0.data)[i] * made.c.vae.std[channel] + made.c.vae.mean[channel] - moments[i];
            sum[2 * i] += x / DRAWS;
            sum[2 * i + 1] += x * x / DRAWS;
        }
    }
    for (size_t i = 0; i < n; i++) {
        double deviation = exp(moments[n + i] / 2.0);
        CHECK_NEAR("mean of draws", sum[2 * i] / deviation, 0, 6 / sqrt(DRAWS));
        CHECK_NEAR("square of draws", sum[2 * i + 1] / (deviation * deviation), 1, 6 * sqrt(2.0 / DRAWS));
    }
    free(moments);
    free(sum);
    dar_loader_close(l);
    dar_bundle_close(bundle);
    dar_cache_close(cache);
}

static void test_clips_that_do_not_fit(void **state)
{
    static const struct {
        struct shape s;
        const char *says;
    } bad[] = {
        { { WIDER, H, T, true, true }, "found 9 frames of 32 x 16, expected 9 of 24 x 16 as in" },
        { { W, H, 5, true, true }, "found 5 frames" },
        { { W, H, T, false, true }, "has no pictures" },
        { { W, H, T, true, false }, "has no world" },
    };
    dar_err e;
    (void)state;
    dar_cache *cache = open_cache("cache", &made);
    for (size_t i = 0; i < DAR_COUNT(bad); i++) {
        char path[64];
        const char *list[] = { clips[0], path };
        dar_loader *l;
        snprintf(path, sizeof path, "%s/bad%zu", scratch_dir, i);
        write_bundle(path, 9, &bad[i].s);
        dar_loader_config c = standard(cache);
        c.path = list;
        c.clips = 2;
        refused(dar_loader_open(&l, &c, &e), &e, bad[i].says);
        assert_null(l);
    }
    dar_cache_close(cache);
}

/* A cache that lacks an entry, a bundle that is gone: the step that wants them says so, the others are there. */
static void test_failures_reach_their_step(void **state)
{
    dar_loader *l;
    const dar_batch *b;
    dar_err e;
    dar_cache_report r;
    (void)state;
    dar_cache *cache = open_cache("lacking", &made);
    ok(dar_cache_fill(cache, clips, 2, NULL, NULL, &r, &e), &e);
    dar_loader_config c = standard(cache);
    c.shuffle = false;
    c.batch = 1;
    ok(dar_loader_open(&l, &c, &e), &e);
    for (int k = 0; k < 2; k++) {
        ok(dar_loader_get(l, 1, &b, &e), &e);
        refused(dar_loader_get(l, 2, &b, &e), &e, "lacking/");
        assert_null(b);
        ok(dar_loader_get(l, 5, &b, &e), &e);
    }
    dar_loader_close(l);
    dar_cache_close(cache);
}

/* ---------------------------------------------------------------- the cache */

/* What is read is what encoding the whole clip at once gives, bit for bit; and again after it was read once. */
static void test_hit_equals_miss(void **state)
{
    static float pixels[3 * T * PIXELS];
    dar_bundle *b;
    dar_arena a;
    dar_tape t;
    dar_err e;
    uint8_t rgb[3 * PIXELS];
    (void)state;
    dar_cache *cache = open_cache("hits", &made);
    dar_cache_report r = fill(cache);
    assert_int_equal(r.made, CLIPS);
    assert_true(r.bytes > 0);
    r = fill(cache);
    assert_int_equal(r.found, CLIPS);
    assert_int_equal(r.made, 0);

    ok(dar_arena_init(&a, "step", 64 << 20, &e), &e);
    ok(dar_tape_init(&t, &a, &e), &e);
    t.recording = false;
    ok(dar_bundle_open(&b, clips[4], &e), &e);
    dar_shape s = dar_cache_shape(cache, b), half = s;
    half.d[0] /= 2;
    dar_tensor moments = dar_tensor_push(&a, DAR_F32, s), known = dar_tensor_push(&a, DAR_F32, half);
    dar_tensor x = dar_tensor_of(DAR_F32, DAR_SHAPE(1, 3, T, H, W), pixels);
    ok(dar_cache_read(cache, b, &moments, &known, &e), &e);
    for (int grey = 0; grey < 2; grey++) {
        for (int64_t f = 0; f < T; f++) {
            ok(dar_bundle_rgb(b, (size_t)f, rgb, &e), &e);
            dar_encode_frame(&x, f, grey && f ? NULL : rgb);
        }
        dar_val *y = dar_vae_encode(&t, &made.v, dar_leaf(&t, x, NULL));
        if (grey) y = dar_contiguous(&t, dar_vae_mean(&t, &made.v, y));
        const dar_tensor *found = grey ? &known : &moments;
        assert_int_equal(dar_tensor_bytes(&y->x), dar_tensor_bytes(found));
        assert_memory_equal(found->data, y->x.data, dar_tensor_bytes(found));
    }
    dar_bundle_close(b);
    dar_tape_free(&t);
    dar_arena_free(&a);
    dar_cache_close(cache);
}

struct files {
    char path[CLIPS + 2][300];
    int n;
};

static struct files listed;

static int list_entry(const char *path, const struct stat *st, int type, struct FTW *at)
{
    (void)st, (void)at;
    if (type == FTW_F && listed.n < CLIPS + 2) snprintf(listed.path[listed.n++], 300, "%s", path);
    return 0;
}

static void list(const char *dir)
{
    listed.n = 0;
    nftw(dir, list_entry, 8, FTW_PHYS);
}

static void poke(const char *path, long from_end, int mask)
{
    FILE *f = fopen(path, "r+b");
    assert_non_null(f);
    assert_int_equal(fseek(f, -from_end, SEEK_END), 0);
    int c = fgetc(f);
    assert_int_equal(fseek(f, -from_end, SEEK_END), 0);
    fputc(c ^ mask, f);
    assert_int_equal(fclose(f), 0);
}

/* A flipped bit in the numbers, half a file, an empty one: made again, with the same bytes. */
static void test_damage(void **state)
{
    char whole[CLIPS][DAR_SHA256_TEXT], sum[DAR_SHA256_TEXT];
    dar_err e;
    struct stat st;
    (void)state;
    dar_cache *cache = open_cache("damage", &made);
    fill(cache);
    list(in_dir("damage"));
    assert_int_equal(listed.n, CLIPS);
    for (int i = 0; i < CLIPS; i++) ok(dar_sha256_file(listed.path[i], whole[i], &e), &e);
    for (long back = 40; back < 3000; back += 407) {
        assert_int_equal(stat(listed.path[0], &st), 0);
        poke(listed.path[0], back, 0x10);
        assert_int_equal(truncate(listed.path[1], st.st_size / 2), 0);
        assert_int_equal(truncate(listed.path[2], 0), 0);
        dar_cache_report r = fill(cache);
        CHECK(r.made >= 2 && r.made == r.damaged && r.found + r.made == CLIPS, "made %zu, damaged %zu", r.made,
              r.damaged);
        for (int i = 0; i < CLIPS; i++) {
            if (i == 0 && r.made == 2) { /* the bit lay in nothing that is read */
                poke(listed.path[0], back, 0x10);
                continue;
            }
            ok(dar_sha256_file(listed.path[i], sum, &e), &e);
            assert_string_equal(sum, whole[i]);
        }
    }
    dar_cache_close(cache);
}

/* A sound file whose numbers are not those that its sums are of. */
static void test_wrong_numbers(void **state)
{
    static float numbers[10 * F * 4 * 6];
    char sum[2][DAR_SHA256_TEXT], whole[DAR_SHA256_TEXT], again[DAR_SHA256_TEXT];
    static const char *const part[] = { "moments", "known" };
    dar_h5 *f;
    dar_err e;
    (void)state;
    dar_cache *cache = open_cache("wrong", &made);
    fill(cache);
    list(in_dir("wrong"));
    ok(dar_sha256_file(listed.path[0], whole, &e), &e);
    ok(dar_h5_open(&f, listed.path[0], &e), &e);
    for (int k = 0; k < 2; k++) ok(dar_h5_get_text(f, part[k], "sha256", sum[k], sizeof sum[k], &e), &e);
    dar_h5_close(f);
    ok(dar_h5_create(&f, listed.path[0], &e), &e);
    for (int k = 0; k < 2; k++) {
        dar_h5_array a = { .type = DAR_H5_F32, .rank = 4, .dim = { k ? 5 : 10, F, H / 4, W / 4 } };
        ok(dar_h5_make(f, part[k], &a, &e), &e);
        ok(dar_h5_write(f, part[k], &a, 0, a.dim[0], numbers, &e), &e);
        ok(dar_h5_put_text(f, part[k], "sha256", sum[k], &e), &e);
    }
    ok(dar_h5_commit(f, &e), &e);
    dar_h5_close(f);
    assert_int_equal(fill(cache).damaged, 1);
    ok(dar_sha256_file(listed.path[0], again, &e), &e);
    assert_string_equal(again, whole);
    dar_cache_close(cache);
}

/* Another picture, another autoencoder, another way to multiply: nothing of it is taken. */
static void test_what_changed_is_not_taken(void **state)
{
    const struct shape s = { W, H, T, true, true };
    coder other;
    (void)state;
    dar_cache *cache = open_cache("change", &made);
    assert_int_equal(fill(cache).made, CLIPS);
    assert_int_equal(rename(clips[1], in_dir("away")), 0);
    write_bundle(clips[1], 77, &s);
    dar_cache_report r = fill(cache);
    assert_int_equal(r.made, 1);
    assert_int_equal(r.damaged, 0);
    assert_int_equal(run_remove(clips[1]), 0);
    assert_int_equal(rename(in_dir("away"), clips[1]), 0);
    assert_int_equal(fill(cache).made, 0);
    dar_cache_close(cache);

    coder_init(&other, 1);
    ((float *)dar_params_find(&other.p, "encoder.conv1.bias")->x.data)[1] += 1;
    cache = open_cache("change", &other);
    assert_int_equal(fill(cache).made, CLIPS);
    dar_cache_close(cache);
    coder_free(&other);

    coder_init(&other, 1);
    ((float *)dar_params_find(&other.p, "decoder.conv1.bias")->x.data)[1] += 1;
    cache = open_cache("change", &other);
    assert_int_equal(fill(cache).made, 0);
    dar_cache_close(cache);
    coder_free(&other);
}

static dar_status stop_at_third(void *ctx, dar_err *e)
{
    return ++*(int *)ctx == 3 ? dar_fail(e, DAR_ERR_INTERRUPTED, "stopped") : DAR_OK;
}

static void test_filling_goes_on_where_it_stopped(void **state)
{
    dar_cache_report r;
    dar_err e;
    int done = 0;
    (void)state;
    dar_cache *cache = open_cache("stop", &made);
    assert_int_equal(dar_cache_fill(cache, clips, CLIPS, stop_at_third, &done, &r, &e), DAR_ERR_INTERRUPTED);
    assert_int_equal(r.made, 3);
    r = fill(cache);
    assert_int_equal(r.found, 3);
    assert_int_equal(r.made, 2);
    dar_cache_close(cache);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_order_is_a_permutation),
        cmocka_unit_test(test_orders_are_equally_likely),
        cmocka_unit_test(test_batches_depend_on_seed_and_step_alone),
        cmocka_unit_test(test_steps_in_any_order),
        cmocka_unit_test(test_content),
        cmocka_unit_test(test_posterior),
        cmocka_unit_test(test_clips_that_do_not_fit),
        cmocka_unit_test(test_failures_reach_their_step),
        cmocka_unit_test(test_hit_equals_miss),
        cmocka_unit_test(test_damage),
        cmocka_unit_test(test_wrong_numbers),
        cmocka_unit_test(test_what_changed_is_not_taken),
        cmocka_unit_test(test_filling_goes_on_where_it_stopped),
    };
    dar_log_set(DAR_LOG_WARNING);
    return cmocka_run_group_tests(tests, make_all, remove_all);
}
