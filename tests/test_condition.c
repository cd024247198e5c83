/* test_condition.c: rays, channel sets, the condition tensor. */
#include "tests/test.h"

#include "data/affine.h"
#include "data/condition.h"
#include "data/rays.h"
#include "data/rigid.h"
#include "lib/rng.h"

enum { W = 37, H = 19, T = 9, F = 3, P = W * H };

static dar_arena memory;

static int setup(void **state)
{
    (void)state;
    return dar_arena_init(&memory, "test", 64 << 20, NULL) != DAR_OK;
}

static int teardown(void **state)
{
    (void)state;
    dar_arena_free(&memory);
    return 0;
}

/* A lens off the centre, pixels that are not square, poses that have nothing to do with each other. */
static dar_camera_path make_path(size_t frames)
{
    dar_camera_path p;
    assert_true(dar_camera_init(&p, frames, NULL) == DAR_OK);
    for (uint64_t t = 0; t < frames; t++) {
        double q[4], o[3];
        p.view[t] = (dar_view){ W, H, 30 + (double)t, 40, 17.25, 9, { 0 }, 0.1 };
        for (uint64_t i = 0; i < 4; i++) q[i] = dar_rng_normal(t, 1, i);
        for (uint64_t i = 0; i < 3; i++) o[i] = 4 * dar_rng_normal(t, 2, i);
        dar_quat_unit(q);
        dar_rigid_of_quat(q, o, p.view[t].c2w);
    }
    return p;
}

static float *pack(const dar_camera_path *p, dar_rays_options options)
{
    dar_tensor y = dar_tensor_push(&memory, DAR_F32, DAR_SHAPE(24, (int64_t)dar_rays_latent_frames(p->frames), H, W));
    dar_tensor_fill(&y, NAN);
    dar_rays_pack(p, options, &y);
    return y.data;
}

/* ---------------------------------------------------------------- rays */

/* Worked out by hand: f = 2, centre (2, 1), camera at (0, 0, 5) turned by 90 degrees about y, so that z points to x. */
static void by_hand(void **state)
{
    (void)state;
    dar_view v = { 4, 2, 2, 2, 2, 1, { 0, 0, 1, 0, 0, 1, 0, 0, -1, 0, 0, 5 }, 1 };
    double o[3], d[3], n = sqrt(0.25 * 0.25 + 0.75 * 0.75 + 1);
    dar_rays_at(&v, 3.5, 0.5, o, d); /* x = 0.75, y = -0.25 */
    CHECK_NEAR("d x", d[0], 1 / n, 1e-15);
    CHECK_NEAR("d y", d[1], -0.25 / n, 1e-15);
    CHECK_NEAR("d z", d[2], -0.75 / n, 1e-15);
    CHECK_NEAR("o z", o[2], 5, 0);

    dar_camera_path p = { &v, 1 };
    dar_tensor y = dar_tensor_push(&memory, DAR_F32, DAR_SHAPE(24, 1, 2, 4));
    const float *r = y.data;
    static const double moment[3] = { 5 * 0.25, 5, 0 }; /* (0, 0, 5) x (1, -0.25, .) */
    for (int plucker = 0; plucker < 2; plucker++) {
        dar_rays_pack(&p, (dar_rays_options){ (dar_plucker)plucker, DAR_RAYS_WORLD }, &y);
        for (int c = 0; c < 3; c++) {
            for (int k = 0; k < 4; k++) {
                int m = plucker == DAR_PLUCKER_WAN ? c : c + 3, b = plucker == DAR_PLUCKER_WAN ? c + 3 : c;
                CHECK_NEAR("moment", (double)r[(m * 4 + k) * 8 + 3], moment[c] / n, 3e-7);
                CHECK_NEAR("direction", (double)r[(b * 4 + k) * 8 + 3], d[c], 6e-8);
            }
        }
    }
    dar_rays_pack(&p, (dar_rays_options){ 0 }, &y); /* in its own frame: x = 0.75, y = -0.25, z = 1, no moment */
    CHECK_NEAR("own frame", (double)r[12 * 8 + 3], 0.75 / n, 6e-8);
    for (int i = 0; i < 12 * 8; i++) CHECK_NEAR("moment of frame 0", (double)r[i], 0, 0);
}

/* Packed[c * 4 + k, f] = G[c, 4 f + k], frame 0 four times: every element against the formula in f64. */
static void packing(void **state)
{
    (void)state;
    dar_mark mark = dar_arena_mark(&memory);
    dar_camera_path p = make_path(T), relative = make_path(T);
    dar_camera_relative(&relative);
    for (int frame = 0; frame < 2; frame++) {
        const dar_camera_path *in = frame == DAR_RAYS_WORLD ? &p : &relative;
        const float *y = pack(&p, (dar_rays_options){ DAR_PLUCKER_WAN, (dar_rays_frame)frame });
        for (size_t i = 0; i < 24u * F * P; i++) {
            size_t pixel = i % P, f = i / P % F, channel = i / P / F, g = 4 * f + channel % 4, t = g < 3 ? 0 : g - 3;
            double o[3], d[3], m[3];
            dar_rays_at(&in->view[t], (double)(pixel % W) + 0.5, (double)(pixel / W) + 0.5, o, d);
            dar_vec_cross(o, d, m);
            /* Rounded once to f32: half a unit, and a few in f64 of what was summed. */
            double expected = channel < 12 ? m[channel / 4] : d[channel / 4 - 3], size = 1 + fabs(o[0]) + fabs(o[1]);
            CHECK_NEAR("packed ray", (double)y[i], expected, 0x1p-24 * fabs(expected) + 1e-14 * (size + fabs(o[2])));
        }
    }
    /* The self-check of the reference: component 3 of sub-frame 2 of latent frame 1 is of frame 3. */
    const float *y = pack(&p, (dar_rays_options){ DAR_PLUCKER_WAN, DAR_RAYS_WORLD });
    double o[3], d[3];
    dar_rays_at(&p.view[3], 0.5, 0.5, o, d);
    CHECK_NEAR("c = 3, k = 2, f = 1", (double)y[((3 * 4 + 2) * F + 1) * P], d[0], 6e-8);
    dar_camera_free(&p);
    dar_camera_free(&relative);
    dar_arena_reset(&memory, mark);
}

static void plucker_identities(void **state)
{
    (void)state;
    dar_mark mark = dar_arena_mark(&memory);
    dar_camera_path p = make_path(T);
    const float *y = pack(&p, (dar_rays_options){ 0 });
    for (size_t f = 0; f < F; f++) {
        for (size_t k = 0; k < 4; k++) {
            for (size_t pixel = 0; pixel < P; pixel++) {
                double m[3], d[3];
                for (size_t c = 0; c < 3; c++) {
                    m[c] = (double)y[((c * 4 + k) * F + f) * P + pixel];
                    d[c] = (double)y[(((c + 3) * 4 + k) * F + f) * P + pixel];
                }
                /* Six numbers, each off by half a unit of f32: |d| by 2^-24, the product by 2^-23 |m|. */
                CHECK_NEAR("|d|", sqrt(dar_vec_dot(d, d)), 1, 0x1p-23);
                CHECK_NEAR("d . m", dar_vec_dot(d, m), 0, 0x1p-23 * sqrt(dar_vec_dot(m, m)));
            }
        }
    }
    /* A point on the ray projects to the pixel's centre. */
    for (size_t t = 0; t < T; t++) {
        for (size_t pixel = 0; pixel < P; pixel++) {
            double o[3], d[3], x[3], q[3], w2c[12], u = (double)(pixel % W) + 0.5, v = (double)(pixel / W) + 0.5;
            const dar_view *at = &p.view[t];
            dar_rays_at(at, u, v, o, d);
            dar_rigid_inverse(at->c2w, w2c);
            for (int i = 0; i < 3; i++) x[i] = o[i] + 7 * d[i];
            for (int i = 0; i < 3; i++) q[i] = dar_vec_dot(w2c + 4 * i, x) + w2c[4 * i + 3];
            CHECK_NEAR("column", at->fx * q[0] / q[2] + at->cx, u, 1e-9);
            CHECK_NEAR("row", at->fy * q[1] / q[2] + at->cy, v, 1e-9);
        }
    }
    dar_camera_free(&p);
    dar_arena_reset(&memory, mark);
}

/* ---------------------------------------------------------------- sets */

static void sets(void **state)
{
    (void)state;
    static const size_t channels[] = { 0, 1, 3, 3, 3, 6, 6, 6, 4, 4, 7, 9, 7, 5 };
    static const char *const wrong[] = {
        "", "trackin", "tracking+", "+depth", "depth+depth", "depth++mask", "camera+depth", "Depth"
    };
    dar_channel_set s;
    dar_err e = { "" };
    assert_int_equal(dar_channel_alias_count, 14);
    for (size_t i = 0; i < 14; i++) {
        CHECK(dar_channel_set_parse(&s, dar_channel_aliases[i].name, &e) == DAR_OK, "%s", e.text);
        assert_int_equal(s.channels, channels[i]);
    }
    CHECK(dar_channel_set_parse(&s, "dar", &e) == DAR_OK, "%s", e.text);
    assert_true(s.families == 3 && s.family[0] == DAR_FAMILY_TRACKING && s.family[1] == DAR_FAMILY_WORLD &&
                s.family[2] == DAR_FAMILY_NORMAL);
    CHECK(dar_channel_set_parse(&s, "sparse+depth+mask", &e) == DAR_OK, "%s", e.text);
    assert_true(s.channels == 5 && s.family[0] == DAR_FAMILY_SPARSE && s.family[2] == DAR_FAMILY_MASK);
    for (size_t i = 0; i < DAR_COUNT(wrong); i++)
        CHECK(dar_channel_set_parse(&s, wrong[i], &e) == DAR_ERR_USAGE, "accepted: \"%s\"", wrong[i]);
    assert_true(dar_channel_set_parse(&s, "trackin", &e) == DAR_ERR_USAGE && strstr(e.text, "is it tracking?"));
}

static void keys(void **state)
{
    (void)state;
    static const char text[] = "{\"channels\": \"depth\", \"plucker\": \"paper\", \"rays\": \"world\", "
                               "\"resample\": \"masked-mean\", \"geometry_frame\": \"camera0\"}";
    dar_json_doc *doc;
    dar_condition c;
    dar_err e = { "" };
    assert_true(dar_json_parse(&doc, "f", "{}", 2, &e) == DAR_OK);
    dar_condition_read(&c, dar_json_root(doc));
    CHECK(dar_json_finish(doc, &e) == DAR_OK, "%s", e.text);
    assert_true(c.set.channels == 9 && c.rays.plucker == DAR_PLUCKER_WAN && c.rays.frame == DAR_RAYS_CAMERA0 &&
                c.resample == DAR_RESAMPLE_LAST && c.geometry == DAR_GEOMETRY_SCENE);
    dar_json_close(doc);
    assert_true(dar_json_parse(&doc, "f", text, strlen(text), &e) == DAR_OK);
    dar_condition_read(&c, dar_json_root(doc));
    CHECK(dar_json_finish(doc, &e) == DAR_OK, "%s", e.text);
    assert_true(c.set.channels == 1 && c.rays.plucker == DAR_PLUCKER_PAPER && c.rays.frame == DAR_RAYS_WORLD &&
                c.resample == DAR_RESAMPLE_MASKED && c.geometry == DAR_GEOMETRY_CAMERA0);
    dar_json_close(doc);
    assert_true(dar_json_parse(&doc, "f", "{\"channels\": \"x\"}", 17, &e) == DAR_OK);
    dar_condition_read(&c, dar_json_root(doc));
    assert_true(dar_json_finish(doc, &e) != DAR_OK && strstr(e.text, "channels"));
    dar_json_close(doc);
}

/* ---------------------------------------------------------------- the tensor */

/* Planes in memory, in the types of a bundle, with junk in the background.  Even pixels are covered always, every
 * fourth of the others at frames of its own. */
typedef struct clip {
    uint16_t tracking[T][3][P];
    float world[T][3][P], depth[T][P];
    int16_t normal[T][3][P];
    uint8_t mask[T][P], sparse[T][3][P];
    int reads[DAR_FAMILIES][T];
    int fail; /* a frame whose depth cannot be read; -1: none */
} clip;

static clip *made;

static dar_status read_plane(void *ctx, dar_family family, size_t frame, dar_plane *plane, dar_err *e)
{
    clip *c = ctx;
    c->reads[family][frame]++;
    *plane = (dar_plane){ .scale = { NAN, NAN, NAN }, .offset = { NAN, NAN, NAN } };
    double scale = 1;
    switch (family) {
    case DAR_FAMILY_TRACKING: plane->type = DAR_PLANE_U16, plane->data = c->tracking[frame], scale = 1 / 65535.0; break;
    case DAR_FAMILY_WORLD: plane->type = DAR_PLANE_F32, plane->data = c->world[frame]; break;
    case DAR_FAMILY_NORMAL: plane->type = DAR_PLANE_I16, plane->data = c->normal[frame], scale = 1 / 32767.0; break;
    case DAR_FAMILY_DEPTH:
        if (c->fail == (int)frame) return dar_fail(e, DAR_ERR_IO, "no depth");
        plane->type = DAR_PLANE_F32, plane->data = c->depth[frame];
        break;
    case DAR_FAMILY_MASK: plane->type = DAR_PLANE_U8, plane->data = c->mask[frame], scale = 1 / 255.0; break;
    default: plane->type = DAR_PLANE_U8, plane->data = c->sparse[frame], scale = 1 / 255.0; break;
    }
    for (size_t i = 0; i < dar_family_table[family].channels; i++) {
        plane->scale[i] = scale;
        plane->offset[i] = 0;
    }
    return DAR_OK;
}

static void make_clip(clip *c)
{
    memset(c, 0, sizeof *c);
    c->fail = -1;
    for (uint64_t t = 0; t < T; t++) {
        for (uint64_t i = 0; i < P; i++) {
            bool cover = i % 2 == 0 || (i / 2 + t) % 4 == 0;
            c->mask[t][i] = cover ? 255 : 0;
            c->depth[t][i] = cover ? (float)(2 + 6 * dar_rng_f64(t, 4, i)) : 1e10f;
            for (uint64_t k = 0; k < 3; k++) {
                c->tracking[t][k][i] = (uint16_t)dar_rng_below(t, k, i, 65536);
                c->sparse[t][k][i] = (uint8_t)dar_rng_below(t, 5 + k, i, 256);
                c->world[t][k][i] = cover ? (float)(1000 + dar_rng_f64(t, 10 + k, i)) : NAN;
            }
            double n[3] = { dar_rng_normal(t, 20, i), dar_rng_normal(t, 21, i), dar_rng_normal(t, 22, i) };
            double length = sqrt(dar_vec_dot(n, n));
            for (uint64_t k = 0; k < 3; k++) c->normal[t][k][i] = (int16_t)lrint(32767 * n[k] / length);
        }
    }
}

static dar_condition condition_of(const char *channels)
{
    dar_condition c = { 0 };
    assert_true(dar_channel_set_parse(&c.set, channels, NULL) == DAR_OK);
    return c;
}

/* The clip's scene: a cube of side 1 at 1000. */
static dar_condition_source source_of(const dar_camera_path *p)
{
    return (dar_condition_source){ .path = p,
                                   .center = { 1000.5, 1000.5, 1000.5 },
                                   .scale = 1,
                                   .box = { { 1000, 1000, 1000 }, { 1001, 1001, 1001 } },
                                   .depth = { 2, 8 },
                                   .read = read_plane,
                                   .ctx = made };
}

/* Returns the geometry channels [N, F, P]. */
static const float *build_tensor(const dar_condition *c, const dar_condition_source *s)
{
    dar_err e = { "" };
    dar_tensor y = dar_tensor_push(&memory, DAR_F32, dar_condition_shape(c, s->path));
    dar_tensor_fill(&y, NAN);
    CHECK(dar_condition_build(c, s, &memory, &y, &e) == DAR_OK, "%s", e.text);
    return (const float *)y.data + (size_t)24 * F * P;
}

/* What channel `k` of a family is at one frame, by the definitions in condition.h. */
static double value_of(const clip *x, const dar_condition *c, const dar_condition_source *s, dar_family family,
                       size_t k, size_t t, size_t i)
{
    double world[12], n[3];
    if (!x->mask[t][i]) return 0;
    switch (family) {
    case DAR_FAMILY_TRACKING: return x->tracking[t][k][i] / 65535.0;
    case DAR_FAMILY_SPARSE: return x->sparse[t][k][i] / 255.0;
    case DAR_FAMILY_MASK: return x->mask[t][i] / 255.0;
    case DAR_FAMILY_DEPTH: return ((double)x->depth[t][i] - 2) / 6;
    case DAR_FAMILY_NORMAL:
        for (int a = 0; a < 3; a++) n[a] = x->normal[t][a][i] / 32767.0;
        const double *r = c->geometry == DAR_GEOMETRY_SCENE ? dar_affine_identity : s->path->view[0].c2w;
        /* Rounded to 16 bits, a unit vector may be a little longer. */
        return fmin(fmax((r[k] * n[0] + r[4 + k] * n[1] + r[8 + k] * n[2] + 1) / 2, 0), 1);
    default:
        for (int a = 0; a < 3; a++) n[a] = (double)x->world[t][a][i];
        if (c->geometry == DAR_GEOMETRY_SCENE) return n[k] - 1000;
        assert_true(dar_condition_world(c, s, world, NULL) == DAR_OK);
        return dar_vec_dot(world + 4 * k, n) + world[4 * k + 3];
    }
}

/* What the tensor holds of latent frame f, by the definitions again. */
static double resampled(const clip *x, const dar_condition *c, const dar_condition_source *s, dar_family family,
                        size_t k, size_t f, size_t i)
{
    size_t last = 4 * f, first = f ? last - 3 : 0, covered = 0, at = last;
    double sum = 0;
    if (c->resample == DAR_RESAMPLE_LAST) return value_of(x, c, s, family, k, last, i);
    if (c->resample == DAR_RESAMPLE_FIRST) return value_of(x, c, s, family, k, first, i);
    for (size_t t = first; t <= last; t++) {
        if (!x->mask[t][i]) continue;
        covered++;
        at = t;
        sum += value_of(x, c, s, family, k, t, i);
    }
    if (dar_family_table[family].identity) return value_of(x, c, s, family, k, at, i);
    if (c->resample == DAR_RESAMPLE_MEAN) return sum / (double)(last - first + 1);
    return covered ? sum / (double)covered : 0;
}

static void tensor(void **state)
{
    (void)state;
    dar_camera_path p = make_path(T);
    dar_condition_source s = source_of(&p);
    dar_condition c = condition_of("world+sparse+depth+tracking+mask+normal");
    size_t background = 0;
    for (int way = 0; way < 8; way++) {
        dar_mark mark = dar_arena_mark(&memory);
        c.resample = (dar_resample)(way % 4);
        c.geometry = (dar_geometry_frame)(way / 4);
        const float *y = build_tensor(&c, &s);
        size_t channel = 0;
        for (size_t w = 0; w < c.set.families; w++) {
            for (size_t k = 0; k < dar_family_table[c.set.family[w]].channels; k++, channel++) {
                for (size_t i = 0; i < (size_t)F * P; i++) {
                    double found = (double)y[channel * F * P + i];
                    double expected = resampled(made, &c, &s, c.set.family[w], k, i / P, i % P);
                    background += expected == 0;
                    /* Values in [0, 1] are rounded by 2^-25 at most, sums of 2, 3, 4 by 2, 4, 4 times that, the
                     * quotient once more: (3 + 2 + 4) / 3 + 1 = 4 for the worst, a mean of three. */
                    CHECK_NEAR(dar_family_table[c.set.family[w]].name, found, expected, 4 * 0x1p-25);
                    CHECK(found >= 0 && found <= 1, "%g", found);
                }
            }
        }
        dar_arena_reset(&memory, mark);
    }
    assert_true(background > 1000);
    dar_camera_free(&p);
}

/* Only what the set needs, of the frames it needs, once. */
static void reads(void **state)
{
    (void)state;
    static const struct {
        const char *channels;
        dar_resample resample;
        int planes;
    } want[] = {
        { "camera", DAR_RESAMPLE_MEAN, 0 },
        { "depth", DAR_RESAMPLE_LAST, 2 * F },
        { "mask", DAR_RESAMPLE_FIRST, F },
        { "dar", DAR_RESAMPLE_LAST, 4 * F },
        { "mask+depth+normal", DAR_RESAMPLE_MEAN, 3 * T },
    };
    dar_camera_path p = make_path(T);
    dar_condition_source s = source_of(&p);
    for (size_t i = 0; i < DAR_COUNT(want); i++) {
        dar_mark mark = dar_arena_mark(&memory);
        dar_condition c = condition_of(want[i].channels);
        int planes = 0;
        c.resample = want[i].resample;
        memset(made->reads, 0, sizeof made->reads);
        build_tensor(&c, &s);
        for (int f = 0; f < DAR_FAMILIES; f++) {
            for (int t = 0; t < T; t++) {
                planes += made->reads[f][t];
                assert_true(made->reads[f][t] <= 1);
                if (c.resample == DAR_RESAMPLE_LAST && t % 4) assert_int_equal(made->reads[f][t], 0);
            }
        }
        CHECK(planes == want[i].planes, "%s: %d planes, expected %d", want[i].channels, planes, want[i].planes);
        dar_arena_reset(&memory, mark);
    }
    dar_camera_free(&p);
}

/* camera0: what a pixel of frame 0 holds lies on that pixel's ray, up to the one scale and shift along z. */
static void frame_of_rays(void **state)
{
    (void)state;
    dar_camera_path p = make_path(T);
    dar_condition_source s = source_of(&p);
    dar_condition c = condition_of("world");
    double scene[12], camera[12], linear[9], lo = INFINITY, hi = -INFINITY;
    assert_true(dar_condition_world(&c, &s, scene, NULL) == DAR_OK);
    c.geometry = DAR_GEOMETRY_CAMERA0;
    for (int a = 0; a < 3; a++) p.view[0].c2w[4 * a + 3] += 1000;
    assert_true(dar_condition_world(&c, &s, camera, NULL) == DAR_OK);
    double size = 1 / cbrt(dar_affine_det(camera));
    for (int i = 0; i < 9; i++) linear[i] = camera[i / 3 * 4 + i % 3] * size;
    const double rotation[12] = { linear[0], linear[1], linear[2], 0,         linear[3], linear[4],
                                  linear[5], 0,         linear[6], linear[7], linear[8], 0 };
    CHECK_NEAR("a similarity", dar_rigid_error(rotation), 0, 1e-14);
    for (int k = 0; k < 8; k++) {
        const double x[3] = { 1000 + (k & 1), 1000 + (k >> 1 & 1), 1000 + (k >> 2) };
        for (int i = 0; i < 3; i++) {
            double y = dar_vec_dot(camera + 4 * i, x) + camera[4 * i + 3], u = dar_vec_dot(scene + 4 * i, x);
            lo = fmin(lo, y);
            hi = fmax(hi, y);
            CHECK_NEAR("scene", u + scene[4 * i + 3], x[i] - 1000, 1e-12);
        }
    }
    /* The box just fits, on one side at least. */
    CHECK(lo >= -1e-12 && hi <= 1 + 1e-12 && fmin(lo, 1 - hi) <= 1e-12, "box from %g to %g", lo, hi);
    for (size_t pixel = 0; pixel < P; pixel++) {
        double o[3], d[3], x[3], y[3], u = (double)(pixel % W) + 0.5, v = (double)(pixel / W) + 0.5;
        dar_rays_at(&p.view[0], u, v, o, d);
        for (int i = 0; i < 3; i++) x[i] = o[i] + 3 * d[i];
        for (int i = 0; i < 3; i++) y[i] = (dar_vec_dot(camera + 4 * i, x) + camera[4 * i + 3] - 0.5) * size;
        double z = 3 / sqrt(pow((u - p.view[0].cx) / p.view[0].fx, 2) + pow((v - p.view[0].cy) / p.view[0].fy, 2) + 1);
        CHECK_NEAR("x / z", y[0] / z, (u - p.view[0].cx) / p.view[0].fx, 1e-11);
        CHECK_NEAR("y / z", y[1] / z, (v - p.view[0].cy) / p.view[0].fy, 1e-11);
    }
    dar_camera_free(&p);
}

/* Depth and rays give back the position: a wall seen by frame 0 and by frame 4, both from the tensor. */
static void back_projection(void **state)
{
    (void)state;
    dar_mark mark = dar_arena_mark(&memory);
    dar_camera_path p = make_path(T);
    dar_condition_source s = source_of(&p);
    dar_condition c = condition_of("world+depth");
    c.geometry = DAR_GEOMETRY_CAMERA0;
    clip *x = calloc(1, sizeof *x);
    x->fail = -1;
    s.ctx = x;
    s.center[0] = s.center[1] = s.center[2] = 0;
    s.box = (dar_box){ { -40, -40, -40 }, { 40, 40, 40 } };
    s.scale = 80;
    for (size_t t = 0; t < T; t++) {
        for (size_t i = 0; i < P; i++) {
            double o[3], d[3], z = 3 + 0.1 * (double)(i % 29);
            const double *m = p.view[t].c2w;
            dar_rays_at(&p.view[t], (double)(i % W) + 0.5, (double)(i / W) + 0.5, o, d);
            double along = m[2] * d[0] + m[6] * d[1] + m[10] * d[2];
            x->mask[t][i] = 255;
            x->depth[t][i] = (float)z;
            for (int a = 0; a < 3; a++) x->world[t][a][i] = (float)(o[a] + z / along * d[a]);
        }
    }
    const float *y = build_tensor(&c, &s), *rays = y - (size_t)24 * F * P;
    double world[12], w2c[12], forward[3], place[3];
    assert_true(dar_condition_world(&c, &s, world, NULL) == DAR_OK);
    dar_rigid_inverse(p.view[0].c2w, w2c);
    for (size_t f = 0; f < 2; f++) {
        double relative[12];
        dar_affine_mul(w2c, p.view[4 * f].c2w, relative);
        for (int a = 0; a < 3; a++) forward[a] = relative[4 * a + 2], place[a] = relative[4 * a + 3];
        for (size_t i = 0; i < P; i++) {
            double d[3], found[3], depth = 2 + 6 * (double)y[((size_t)3 * F + f) * P + i];
            for (size_t a = 0; a < 3; a++) d[a] = (double)rays[((12 + 4 * a + 3) * F + f) * P + i];
            for (int a = 0; a < 3; a++) found[a] = place[a] + depth / dar_vec_dot(forward, d) * d[a];
            /* To where the tensor says that this surface is; both in camera 0, up to the one scale and shift. */
            double scale = cbrt(dar_affine_det(world));
            for (size_t a = 0; a < 3; a++) {
                double shift = world[4 * a + 3] - 0.5;
                for (size_t b = 0; b < 3; b++) shift += world[4 * a + b] * p.view[0].c2w[4 * b + 3];
                CHECK_NEAR("position", scale * found[a] + shift + 0.5, (double)y[(a * F + f) * P + i], 1e-6);
            }
        }
    }
    free(x);
    dar_camera_free(&p);
    dar_arena_reset(&memory, mark);
}

/* View-z of a point. */
static double depth_of(const dar_view *v, const double x[3])
{
    double w2c[12];
    dar_rigid_inverse(v->c2w, w2c);
    return dar_vec_dot(w2c + 8, x) + w2c[11];
}

/* The paper's proposition 1.  Depth: two points that differ by what is at right angles to the view have the same;
 * the camera that steps back by a sees the same point a farther.  Tracking and world: equal channels mean the same
 * element at the same place, whoever looks. */
static void proposition(void **state)
{
    (void)state;
    dar_camera_path p = make_path(T);
    dar_condition_source s = source_of(&p);
    dar_condition c = condition_of("world");
    double m[12], other[12];
    for (size_t t = 0; t < T; t++) {
        dar_view v = p.view[t];
        const double x[3] = { 1000.25, 1000.5, 1000.75 }, a = 0.625;
        double beside[3], depth = depth_of(&v, x);
        for (int i = 0; i < 3; i++) beside[i] = x[i] + 3 * v.c2w[4 * i] - 2 * v.c2w[4 * i + 1];
        CHECK_NEAR("depth of another point", depth_of(&v, beside), depth, 1e-12);
        for (int i = 0; i < 3; i++) v.c2w[4 * i + 3] += a * v.c2w[4 * i + 2];
        CHECK_NEAR("depth of the same point", depth_of(&v, x), depth - a, 1e-12);
    }
    assert_true(dar_condition_world(&c, &s, m, NULL) == DAR_OK);
    CHECK(fabs(dar_affine_det(m)) > 0, "world position is not injective");
    for (size_t t = 1; t < T; t++) p.view[t].c2w[3] += 1;
    assert_true(dar_condition_world(&c, &s, other, NULL) == DAR_OK);
    assert_memory_equal(m, other, sizeof m);
    p.view[0].c2w[3] += 1; /* in the scene's frame no camera matters */
    assert_true(dar_condition_world(&c, &s, other, NULL) == DAR_OK);
    assert_memory_equal(m, other, sizeof m);
    dar_camera_free(&p);
}

static void failures(void **state)
{
    (void)state;
    dar_mark mark = dar_arena_mark(&memory);
    dar_camera_path p = make_path(T);
    dar_condition_source s = source_of(&p);
    dar_condition c = condition_of("depth+world");
    dar_tensor y = dar_tensor_push(&memory, DAR_F32, dar_condition_shape(&c, &p));
    dar_err e = { "" };
    size_t used = memory.used;
    made->fail = 4;
    assert_true(dar_condition_build(&c, &s, &memory, &y, &e) == DAR_ERR_IO && strstr(e.text, "no depth"));
    made->fail = -1;
    s.depth[1] = 1;
    assert_true(dar_condition_build(&c, &s, &memory, &y, &e) == DAR_ERR_FORMAT);
    s.depth[1] = 2; /* one depth only */
    assert_true(dar_condition_build(&c, &s, &memory, &y, &e) == DAR_OK);
    CHECK_NEAR("one depth", (double)((float *)y.data)[(size_t)24 * F * P], 1, 0);
    s.scale = 0;
    assert_true(dar_condition_build(&c, &s, &memory, &y, &e) == DAR_ERR_FORMAT);
    assert_true(memory.used == used);
    CHECK_ABORTS(dar_rays_pack(&p, c.rays, &y));
    dar_camera_free(&p);
    dar_arena_reset(&memory, mark);
}

static void threads(void **state)
{
    (void)state;
    static const int n[] = { 1, 2, 3, 7 };
    dar_camera_path p = make_path(T);
    dar_condition_source s = source_of(&p);
    dar_condition c = condition_of("tracking+world+normal+depth");
    int before = dar_threads();
    size_t bytes = sizeof(float) * (24 + c.set.channels) * F * P;
    const char *first = NULL;
    c.resample = DAR_RESAMPLE_MASKED;
    for (size_t i = 0; i < DAR_COUNT(n); i++) {
        dar_threads_set(n[i]);
        const char *y = (const char *)(build_tensor(&c, &s) - (size_t)24 * F * P);
        if (!first) first = y;
        CHECK(memcmp(y, first, bytes) == 0, "%d threads: other bits", n[i]);
    }
    dar_threads_set(before);
    dar_camera_free(&p);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(by_hand),     cmocka_unit_test(packing),       cmocka_unit_test(plucker_identities),
        cmocka_unit_test(sets),        cmocka_unit_test(keys),          cmocka_unit_test(tensor),
        cmocka_unit_test(reads),       cmocka_unit_test(frame_of_rays), cmocka_unit_test(back_projection),
        cmocka_unit_test(proposition), cmocka_unit_test(failures),      cmocka_unit_test(threads),
    };
    made = malloc(sizeof *made);
    make_clip(made);
    int failed = cmocka_run_group_tests(tests, setup, teardown);
    free(made);
    return failed != 0;
}
