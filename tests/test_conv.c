/* test_conv.c: convolution and resampling against their definitions, written out as plain loops in f64; chunks of a
 * clip against the whole clip, bit by bit. */
#include "tests/test.h"

#include "autograd/ops.h"
#include "lib/kern.h"

static dar_arena arena;
static dar_tape tape;

static int setup(void **state)
{
    (void)state;
    return dar_arena_init(&arena, "test", (size_t)256 << 20, NULL) || dar_tape_init(&tape, &arena, NULL);
}

static int teardown(void **state)
{
    (void)state;
    dar_tape_free(&tape);
    dar_arena_free(&arena);
    return 0;
}

static void fresh(void)
{
    dar_tape_clear(&tape);
    dar_arena_reset(&arena, 0);
    tape.recording = true;
}

/* Values in [-1, 1) that do not repeat over any axis. */
static double value(uint64_t seed, size_t i)
{
    uint64_t z = (seed << 40) + i + 0x9e3779b97f4a7c15u;
    z = (z ^ z >> 30) * 0xbf58476d1ce4e5b9u;
    z = (z ^ z >> 27) * 0x94d049bb133111ebu;
    return (double)((z ^ z >> 31) >> 11) * 0x1p-52 - 1;
}

static dar_tensor random_tensor(dar_dtype type, dar_shape s, uint64_t seed)
{
    dar_tensor x = dar_tensor_push(&arena, type, s);
    for (size_t i = 0; i < dar_tensor_count(&x); i++) dar_dtype_set(type, x.data, i, value(seed, i));
    return x;
}

static double get(const dar_tensor *x, size_t i)
{
    return dar_dtype_get(x->dtype, x->data, i);
}

/* ---------------------------------------------------------------- convolution by its definition */

struct shape_of_conv {
    const char *name;
    int64_t B, Cin, T, H, W, past, Cout, kt, kh, kw;
    dar_conv_attr a;
};

/* One of each geometry, sizes all different; then sizes beyond every block of the driver. */
static const struct shape_of_conv shapes[] = {
    { "1x1", 2, 3, 1, 4, 5, 0, 7, 1, 1, 1, { .stride = 1, .stride_t = 1 } },
    { "3x3", 2, 5, 3, 6, 7, 0, 4, 1, 3, 3, { 1, 1, 1, 1, 1, 1, 0 } },
    { "2x2 stride 2", 1, 6, 2, 8, 10, 0, 9, 1, 2, 2, { .stride = 2, .stride_t = 1 } },
    { "down", 2, 3, 2, 6, 8, 0, 5, 1, 3, 3, { 2, 0, 1, 0, 1, 1, 0 } },
    { "causal", 2, 3, 4, 5, 6, 0, 7, 3, 3, 3, { 1, 1, 1, 1, 1, 1, 2 } },
    { "causal, one frame known", 1, 4, 2, 3, 5, 1, 6, 3, 3, 3, { 1, 1, 1, 1, 1, 1, 2 } },
    { "causal, two frames known", 2, 2, 1, 4, 7, 2, 3, 3, 3, 3, { 1, 1, 1, 1, 1, 1, 2 } },
    { "time", 1, 5, 3, 2, 3, 2, 4, 3, 1, 1, { 1, 0, 0, 0, 0, 1, 2 } },
    { "time stride 2", 2, 3, 7, 2, 3, 0, 5, 3, 1, 1, { 1, 0, 0, 0, 0, 2, 0 } },
    { "time stride 2, one frame known", 1, 3, 4, 2, 3, 1, 5, 3, 1, 1, { 1, 0, 0, 0, 0, 2, 1 } },
    { "many channels", 1, 61, 1, 5, 7, 0, 530, 1, 3, 3, { 1, 1, 1, 1, 1, 1, 0 } },
    { "many pixels", 1, 2, 5, 47, 43, 1, 3, 2, 3, 3, { 1, 1, 1, 1, 1, 1, 1 } },
    { "many pixels, 44 channels", 1, 2, 2, 19, 43, 1, 44, 2, 3, 3, { 1, 1, 1, 1, 1, 1, 1 } },
    { "causal to 47 channels", 2, 4, 2, 3, 5, 1, 47, 3, 3, 3, { 1, 1, 1, 1, 1, 1, 2 } },
    { "stride 2, 131 channels", 1, 131, 1, 47, 51, 0, 5, 1, 3, 3, { 2, 1, 1, 1, 1, 1, 0 } },
    { "stride 2, causal, one frame known", 2, 3, 2, 6, 9, 1, 4, 3, 3, 3, { 2, 0, 1, 0, 1, 1, 2 } },
    { "stride 3 of 2x2", 1, 3, 1, 8, 11, 0, 4, 1, 2, 2, { 3, 1, 0, 0, 2, 1, 0 } },
    { "stride 2 of 4x5, wide border", 1, 2, 1, 5, 4, 0, 3, 1, 4, 5, { 2, 3, 4, 5, 1, 1, 0 } },
    { "small frames of four clips, one known", 4, 5, 5, 4, 6, 1, 9, 3, 3, 3, { 1, 1, 1, 1, 1, 1, 2 } },
    { "small frames of four clips, stride 2", 4, 3, 4, 7, 9, 0, 5, 3, 3, 3, { 2, 1, 0, 0, 1, 1, 2 } },
    { "many pixels of three clips", 3, 3, 4, 40, 41, 0, 5, 3, 3, 3, { 1, 1, 1, 1, 1, 1, 2 } },
    { "many pixels, one weight", 1, 1, 1, 380, 381, 0, 1, 1, 1, 1, { .stride = 1, .stride_t = 1 } },
    { "261 channels to 2, lopsided", 1, 261, 2, 3, 5, 1, 2, 3, 3, 4, { 1, 2, 0, 3, 0, 1, 2 } },
};

struct values {
    dar_tensor x, w, b, history, y, gy, gx, gw, gb, ghistory;
};

/* y and gradients, and in place of bounds the same sums of magnitudes. */
static void by_definition(const struct shape_of_conv *s, struct values *v, bool magnitudes)
{
#define MAG(x) (magnitudes ? fabs(x) : (x))
    int64_t To = v->y.shape.d[2], Ho = v->y.shape.d[3], Wo = v->y.shape.d[4];
    double *gx = v->gx.data, *gw = v->gw.data, *gb = v->gb.data, *gh = v->ghistory.data, *y = v->y.data;

    for (int64_t b = 0, p = 0; b < s->B; b++)
        for (int64_t o = 0; o < s->Cout; o++)
            for (int64_t t = 0; t < To; t++)
                for (int64_t h = 0; h < Ho; h++)
                    for (int64_t w = 0; w < Wo; w++, p++) {
                        double g = MAG(get(&v->gy, (size_t)p)), sum = MAG(get(&v->b, (size_t)o));
                        gb[o] += g;
                        for (int64_t e = 0; e < s->Cin * s->kt * s->kh * s->kw; e++) {
                            int64_t dx = e % s->kw, dy = e / s->kw % s->kh, dt = e / s->kw / s->kh % s->kt;
                            int64_t c = e / s->kw / s->kh / s->kt;
                            int64_t f = t * s->a.stride_t + dt - s->a.front, r = h * s->a.stride + dy - s->a.top;
                            int64_t q = w * s->a.stride + dx - s->a.left;
                            if (r < 0 || r >= s->H || q < 0 || q >= s->W || f < -s->past) continue;
                            int64_t i = ((b * s->Cin + c) * s->T + f) * s->H * s->W + r * s->W + q;
                            if (f < 0) i = ((b * s->Cin + c) * s->past + f + s->past) * s->H * s->W + r * s->W + q;
                            int64_t k = o * s->Cin * s->kt * s->kh * s->kw + e;
                            double x = MAG(get(f < 0 ? &v->history : &v->x, (size_t)i)), weight;
                            weight = MAG(get(&v->w, (size_t)k));
                            sum += weight * x;
                            gw[k] += g * x;
                            (f < 0 ? gh : gx)[i] += g * weight;
                        }
                        y[p] = sum;
                    }
}

static dar_tensor zeros(dar_shape s)
{
    dar_tensor x = dar_tensor_push(&arena, DAR_F64, s);
    dar_tensor_fill(&x, 0);
    return x;
}

static void clear_results(struct values *v, dar_shape y)
{
    v->y = zeros(y);
    v->gx = zeros(v->x.shape);
    v->gw = zeros(v->w.shape);
    v->gb = zeros(v->b.shape);
    v->ghistory = zeros(v->history.shape);
}

static dar_val *leaf(const dar_tensor *x)
{
    dar_tensor g = dar_tensor_push(&arena, dar_compute_type(x->dtype), x->shape);
    dar_tensor_fill(&g, 0);
    return dar_leaf(&tape, *x, &g);
}

static dar_val *run_conv(const struct shape_of_conv *s, dar_val *x, dar_val *w, dar_val *b, dar_val *history)
{
    if (s->B == 1) w = dar_contiguous(&tape, w); /* a gradient that is written; else it is added to the leaf's */
    if (s->kt > 1) return dar_conv3d(&tape, x, w, b, history, s->a);
    w = dar_reshape(&tape, w, DAR_SHAPE(s->Cout, s->Cin, s->kh, s->kw));
    return dar_conv2d(&tape, x, w, b, s->a);
}

/* A sum of K products is off by at most u (K + 8) times the sum of their magnitudes; where operands of products are
 * rounded to bf16 (gy is) and the result as well, by 2^-8 for each more. */
static void compare(const char *name, const char *what, const dar_tensor *found, const dar_tensor *expected,
                    const dar_tensor *magnitude, double relative)
{
    char text[128];
    for (size_t i = 0; i < dar_tensor_count(expected); i++) {
        snprintf(text, sizeof text, "%s: %s[%zu]", name, what, i);
        CHECK_NEAR(text, get(found, i), get(expected, i), relative * get(magnitude, i));
    }
}

static void check_level(const struct shape_of_conv *s, const struct values *v, const struct values *size)
{
    dar_mark m = dar_arena_mark(&arena);
    dar_dtype type = v->x.dtype;
    dar_val *x = leaf(&v->x), *w = leaf(&v->w), *b = leaf(&v->b), *history = leaf(&v->history);
    dar_val *y = run_conv(s, x, w, b, s->past ? history : NULL);
    dar_backward(&tape, y, &v->gy);

    double u = type == DAR_F64 ? 0x1p-53 : 0x1p-24, half = type == DAR_BF16 ? 0x1p-8 : 0;
    double taps = (double)(s->kt * s->kh * s->kw), P = (double)dar_tensor_count(&v->y) / (double)s->Cout;
    compare(s->name, "y", &y->x, &v->y, &size->y, u * (taps * (double)s->Cin + 8) + half);
    compare(s->name, "gx", &x->g, &v->gx, &size->gx, u * (taps * (double)s->Cout + 8) + half);
    compare(s->name, "gw", &w->g, &v->gw, &size->gw, u * (P + 8) + half);
    compare(s->name, "gb", &b->g, &v->gb, &size->gb, u * (P + 8));
    compare(s->name, "ghistory", &history->g, &v->ghistory, &size->ghistory, u * (taps * (double)s->Cout + 8) + half);
    dar_tape_clear(&tape);
    dar_arena_reset(&arena, m);
}

static void check_shape(const struct shape_of_conv *s, dar_dtype type)
{
    unsigned level[5];
    int64_t H = s->H + s->a.top + s->a.bottom, W = s->W + s->a.left + s->a.right;
    dar_shape y = DAR_SHAPE(s->B, s->Cout, (s->T + s->a.front - s->kt) / s->a.stride_t + 1,
                            (H - s->kh) / s->a.stride + 1, (W - s->kw) / s->a.stride + 1);
    fresh();
    struct values v = { .x = random_tensor(type, DAR_SHAPE(s->B, s->Cin, s->T, s->H, s->W), 1),
                        .w = random_tensor(type, DAR_SHAPE(s->Cout, s->Cin, s->kt, s->kh, s->kw), 2),
                        .b = random_tensor(type, DAR_SHAPE(s->Cout), 3),
                        .history = random_tensor(type, DAR_SHAPE(s->B, s->Cin, s->past, s->H, s->W), 4),
                        .gy = random_tensor(dar_compute_type(type), y, 5) };
    struct values size = v;
    clear_results(&v, y);
    clear_results(&size, y);
    by_definition(s, &v, false);
    by_definition(s, &size, true);
    for (int k = 0, n = test_levels(level); k < n; k++) {
        dar_cpu_init(level[k]);
        check_level(s, &v, &size);
    }
    dar_cpu_init(DAR_CPU_ALL);
}

static void conv_by_definition(void **state)
{
    static const dar_dtype types[] = { DAR_F64, DAR_F32, DAR_BF16 };
    (void)state;
    for (size_t i = 0; i < DAR_COUNT(shapes); i++)
        for (size_t t = 0; t < DAR_COUNT(types); t++) check_shape(&shapes[i], types[t]);
}

/* ---------------------------------------------------------------- chunks */

static bool same_frames(const dar_tensor *chunk, const dar_tensor *whole, int64_t first)
{
    dar_tensor part = dar_tensor_narrow(whole, 2, first, chunk->shape.d[2]);
    dar_tensor copy = dar_tensor_push(&arena, part.dtype, part.shape);
    dar_tensor_copy(&copy, &part);
    return memcmp(copy.data, chunk->data, dar_tensor_bytes(&copy)) == 0;
}

/* frames before `first`, at most `front` of them, as history. */
static dar_val *frames_before(dar_val *x, int64_t first, int64_t front)
{
    int64_t n = first < front ? first : front;
    return n ? dar_leaf(&tape, dar_tensor_narrow(&x->x, 2, first - n, n), NULL) : NULL;
}

static void chunks_are_the_clip(void **state)
{
    static const dar_dtype types[] = { DAR_F64, DAR_F32, DAR_BF16 };
    static const int64_t cuts[][6] = { { 0, 1, 5, 9 }, { 0, 1, 2, 3, 4, 9 }, { 0, 4, 6, 9 } };
    unsigned level[5];
    (void)state;
    for (int k = 0, n = test_levels(level); k < n; k++)
        for (size_t t = 0; t < DAR_COUNT(types); t++)
            for (size_t i = 0; i < DAR_COUNT(cuts); i++) {
                dar_cpu_init(level[k]);
                fresh();
                dar_tensor xs = random_tensor(types[t], DAR_SHAPE(2, 67, 9, 7, 5), 1);
                dar_tensor ws = random_tensor(types[t], DAR_SHAPE(11, 67, 3, 3, 3), 2);
                dar_tensor bs = random_tensor(types[t], DAR_SHAPE(11), 3);
                dar_val *x = dar_leaf(&tape, xs, NULL), *w = dar_leaf(&tape, ws, NULL), *b = dar_leaf(&tape, bs, NULL);
                dar_val *whole = dar_conv3d(&tape, x, w, b, NULL, dar_conv_same(w));
                for (int j = 0; cuts[i][j] < 9; j++) {
                    int64_t first = cuts[i][j], frames = cuts[i][j + 1] - first;
                    dar_val *part = dar_leaf(&tape, dar_tensor_narrow(&xs, 2, first, frames), NULL);
                    dar_val *y = dar_conv3d(&tape, part, w, b, frames_before(x, first, 2), dar_conv_same(w));
                    CHECK(same_frames(&y->x, &whole->x, first), "%s, level %d: frames %lld to %lld differ",
                          dar_dtype_name(types[t]), k, (long long)first, (long long)(first + frames));
                }
            }
    dar_cpu_init(DAR_CPU_ALL);
}

/* y[j] = W0 x[2j-2] + W1 x[2j-1] + W2 x[2j]: frame 0 apart, then pairs with the frame before them. */
static void strided_time_in_chunks(void **state)
{
    (void)state;
    fresh();
    dar_tensor xs = random_tensor(DAR_F32, DAR_SHAPE(1, 5, 9, 3, 4), 1),
               ws = random_tensor(DAR_F32, DAR_SHAPE(6, 5, 3, 1, 1), 2);
    dar_val *x = dar_leaf(&tape, xs, NULL), *w = dar_leaf(&tape, ws, NULL);
    dar_conv_attr whole = { .stride = 1, .stride_t = 2 }, on = { .stride = 1, .stride_t = 2, .front = 1 };
    dar_val *y = dar_conv3d(&tape, x, w, NULL, NULL, whole);
    assert_int_equal(y->x.shape.d[2], 4);
    for (int64_t first = 1; first < 9; first += 4) {
        dar_val *part = dar_leaf(&tape, dar_tensor_narrow(&xs, 2, first, 4), NULL);
        dar_val *z = dar_conv3d(&tape, part, w, NULL, frames_before(x, first, 1), on);
        assert_int_equal(z->x.shape.d[2], 2);
        CHECK(same_frames(&z->x, &y->x, (first - 1) / 2), "frames from %lld differ", (long long)first);
    }
}

/* ---------------------------------------------------------------- resampling */

static size_t index5(const dar_tensor *x, size_t b, size_t c, size_t t, size_t h, size_t w)
{
    const int64_t *d = x->shape.d;
    return (((b * (size_t)d[1] + c) * (size_t)d[2] + t) * (size_t)d[3] + h) * (size_t)d[4] + w;
}

#define EACH(v)                                                                                                        \
    for (size_t b = 0; b < (size_t)(v)->x.shape.d[0]; b++)                                                             \
        for (size_t c = 0; c < (size_t)(v)->x.shape.d[1]; c++)                                                         \
            for (size_t f = 0; f < (size_t)(v)->x.shape.d[2]; f++)                                                     \
                for (size_t h = 0; h < (size_t)(v)->x.shape.d[3]; h++)                                                 \
                    for (size_t w = 0; w < (size_t)(v)->x.shape.d[4]; w++)

#define AT(v, ...) get(&(v)->x, index5(&(v)->x, __VA_ARGS__))

static const dar_dtype moved_types[] = { DAR_F64, DAR_F32, DAR_BF16, DAR_F16 };

static void shuffles(void **state)
{
    (void)state;
    for (size_t t = 0; t < DAR_COUNT(moved_types); t++) {
        fresh();
        dar_val *x = dar_leaf(&tape, random_tensor(moved_types[t], DAR_SHAPE(2, 3, 4, 6, 10), 1), NULL);
        dar_val *rows = dar_pixel_unshuffle(&tape, x, 2, DAR_PIXELS_ROWS);
        dar_val *columns = dar_pixel_unshuffle(&tape, x, 2, DAR_PIXELS_COLUMNS);
        dar_val *frames = dar_frame_unshuffle(&tape, x, 2);
        EACH(x)
        {
            CHECK_NEAR("torch's order", AT(rows, b, c * 4 + h % 2 * 2 + w % 2, f, h / 2, w / 2), AT(x, b, c, f, h, w),
                       0);
            CHECK_NEAR("patchify", AT(columns, b, c * 4 + w % 2 * 2 + h % 2, f, h / 2, w / 2), AT(x, b, c, f, h, w), 0);
            CHECK_NEAR("frames", AT(frames, b, f % 2 * 3 + c, f / 2, h, w), AT(x, b, c, f, h, w), 0);
        }
        dar_val *back[] = { dar_pixel_shuffle(&tape, rows, 2, DAR_PIXELS_ROWS),
                            dar_pixel_shuffle(&tape, columns, 2, DAR_PIXELS_COLUMNS),
                            dar_frame_shuffle(&tape, frames, 2) };
        for (size_t i = 0; i < DAR_COUNT(back); i++)
            CHECK(dar_shape_equal(&back[i]->x.shape, &x->x.shape) &&
                      memcmp(back[i]->x.data, x->x.data, dar_tensor_bytes(&x->x)) == 0,
                  "%s: shuffle %zu does not undo unshuffle", dar_dtype_name(moved_types[t]), i);
    }
}

/* The cases that occur in the Wan2.2 VAE, by their closed forms. */
static void shortcuts_down(void **state)
{
    (void)state;
    for (size_t t = 0; t < DAR_COUNT(moved_types); t++) {
        fresh();
        double u = moved_types[t] == DAR_F64 ? 0x1p-51 : moved_types[t] == DAR_F32 ? 0x1p-22 : 0x1p-8;
        dar_val *x = dar_leaf(&tape, random_tensor(moved_types[t], DAR_SHAPE(2, 3, 5, 4, 6), 1), NULL);
        dar_val *space = dar_avg_down(&tape, x, 3, 1, 2), *both = dar_avg_down(&tape, x, 6, 2, 2);
        dar_val *same = dar_avg_down(&tape, x, 3, 1, 1);
        EACH(space)
        {
            double mean = 0;
            for (size_t i = 0; i < 4; i++) mean += AT(x, b, c, f, 2 * h + i / 2, 2 * w + i % 2) / 4;
            CHECK_NEAR("2 x 2 mean", AT(space, b, c, f, h, w), mean, u);
            CHECK_NEAR("frame 2t + a to channel 2c + a", AT(both, b, 2 * c + (f + 1) % 2, (f + 1) / 2, h, w), mean, u);
            CHECK_NEAR("zero frame in front", AT(both, b, 2 * c, 0, h, w), 0, 0);
        }
        CHECK(memcmp(same->x.data, x->x.data, dar_tensor_bytes(&x->x)) == 0, "identity is not");
    }
}

static void shortcuts_up(void **state)
{
    (void)state;
    for (size_t t = 0; t < DAR_COUNT(moved_types); t++) {
        fresh();
        dar_val *x = dar_leaf(&tape, random_tensor(moved_types[t], DAR_SHAPE(2, 4, 3, 2, 5), 1), NULL);
        dar_val *whole = dar_dup_up(&tape, x, 4, 2, 2, 1), *later = dar_dup_up(&tape, x, 4, 2, 2, 0);
        dar_val *parity = dar_dup_up(&tape, x, 2, 1, 2, 0), *nearest = dar_upsample_nearest(&tape, x, 2);
        assert_int_equal(whole->x.shape.d[2], 5);
        EACH(whole)
        CHECK_NEAR("first chunk", AT(whole, b, c, f, h, w), AT(x, b, c, (f + 1) / 2, h / 2, w / 2), 0);
        EACH(later)
        CHECK_NEAR("later chunk", AT(later, b, c, f, h, w), AT(x, b, c, f / 2, h / 2, w / 2), 0);
        EACH(parity)
        CHECK_NEAR("row parity", AT(parity, b, c, f, h, w), AT(x, b, 2 * c + h % 2, f, h / 2, w / 2), 0);
        EACH(nearest)
        CHECK_NEAR("nearest", AT(nearest, b, c, f, h, w), AT(x, b, c, f, h / 2, w / 2), 0);
    }
}

/* Rows longer than any buffer. */
static void long_rows(void **state)
{
    (void)state;
    fresh();
    dar_val *x = dar_leaf(&tape, random_tensor(DAR_BF16, DAR_SHAPE(1, 1, 1, 2, 5002), 1), NULL);
    dar_val *mean = dar_avg_down(&tape, x, 1, 1, 2), *parts = dar_pixel_unshuffle(&tape, x, 2, DAR_PIXELS_ROWS);
    EACH(mean)
    {
        double sum = 0;
        for (size_t i = 0; i < 4; i++) {
            double v = AT(x, 0, 0, 0, i / 2, 2 * w + i % 2);
            CHECK_NEAR("long row", AT(parts, b, i, f, h, w), v, 0);
            sum += v / 4;
        }
        CHECK_NEAR("long mean", AT(mean, b, c, f, h, w), sum, 0x1p-8);
    }
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(conv_by_definition),
        cmocka_unit_test(chunks_are_the_clip),
        cmocka_unit_test(strided_time_in_chunks),
        cmocka_unit_test(shuffles),
        cmocka_unit_test(shortcuts_down),
        cmocka_unit_test(shortcuts_up),
        cmocka_unit_test(long_rows),
    };
    return cmocka_run_group_tests(tests, setup, teardown) != 0;
}
