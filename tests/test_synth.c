/* test_synth.c: synthetic scenes: nothing meets anything, walkers are on the ground, the subject is in view, camera
 * paths keep their bounds, the same seeds give the same bits, and sets share what they say that they share. */
#include "tests/made.h"

#include "data/synth_set.h"

enum { SCENES = 1000, T = 9, LONG_SCENES = 40, LONG_T = 81 };

static dar_synth_plan plan_of(uint64_t seed)
{
    dar_synth_plan p = dar_synth_standard();
    p.frames = T;
    p.bare = true;
    dar_synth_set_plan(&dar_synth_sets[0], seed, 0, 0, NULL, &p);
    return p;
}

static void make(dar_synth *s, const dar_synth_plan *p)
{
    dar_err e;
    dar_status status = dar_synth_make(s, p, &e);
    CHECK(status == DAR_OK, "seed %llu: %s", (unsigned long long)p->seed, e.text);
}

/* ---------------------------------------------------------------- a thousand scenes */

struct census {
    size_t walks, stands, frames, seen, things, dropped, path[64], motion[DAR_PLACE_MOTIONS];
};

static void check_places(const dar_synth *s, uint64_t seed, struct census *n)
{
    for (size_t t = 0; t < s->clip.frames; t++)
        for (size_t i = 0; i < s->things; i++) {
            const dar_synth_thing *x = &s->thing[i];
            double low = x->box[t].lo[1];
            CHECK(low >= -1e-4, "seed %llu, frame %zu: %s is %g below the ground", (unsigned long long)seed, t,
                  x->kind->name, -low);
            if (x->asset.way == DAR_ASSET_WALKS) CHECK_NEAR("height of a walker", low, 0, 1e-4);
            for (size_t k = 0; k < i; k++)
                CHECK(!dar_place_meet(&x->box[t], &s->thing[k].box[t]), "seed %llu, frame %zu: %s meets %s",
                      (unsigned long long)seed, t, x->kind->name, s->thing[k].kind->name);
        }
    for (size_t i = 0; i < s->things; i++) {
        n->motion[s->thing[i].motion]++;
        n->walks += s->thing[i].motion == DAR_PLACE_WALK;
        n->stands += s->thing[i].motion != DAR_PLACE_WALK && s->thing[i].asset.way != DAR_ASSET_STAYS;
    }
    n->things += s->things;
    n->dropped += s->dropped;
}

static void check_path(const dar_synth *s, struct census *n)
{
    const dar_trajectory *p = &s->path;
    n->path[p->kind - dar_trajectory_kinds]++;
    for (int i = 0; i < DAR_TRAJECTORY_PARTS; i++) {
        dar_span b = p->kind->bound[i];
        double x = p->part[i], sign = p->kind->mirror && (x < b.lo || x > b.hi) ? -1 : 1;
        CHECK(sign * x >= b.lo && sign * x <= b.hi, "%s: part %d is %g", p->kind->name, i, x);
    }
    for (size_t t = 0; t < s->clip.frames; t++) {
        n->seen += dar_trajectory_in_view(&s->cameras.view[t], &s->thing[0].box[t], 0);
        n->frames++;
    }
}

static void thousand_scenes(void **state)
{
    struct census n = { 0 };
    int threads = dar_threads();
    (void)state;
    dar_threads_set(1); /* work this small would be waiting for other threads */
    for (uint64_t seed = 0; seed < SCENES; seed++) {
        dar_synth_plan p = plan_of(seed);
        dar_synth s;
        if (seed < LONG_SCENES) p.frames = LONG_T;
        make(&s, &p);
        check_places(&s, seed, &n);
        check_path(&s, &n);
        dar_synth_free(&s);
    }
    dar_threads_set(threads);
    CHECK(100 * n.seen >= 99 * n.frames, "the subject is in view in %zu of %zu frames", n.seen, n.frames);
    for (size_t i = 0; i < dar_trajectory_count; i++) {
        bool benchmark = strcmp(dar_trajectory_kinds[i].family, "benchmark") == 0;
        CHECK(benchmark == (n.path[i] == 0), "%s: %zu of %d paths", dar_trajectory_kinds[i].name, n.path[i], SCENES);
    }
    for (int i = 0; i < DAR_PLACE_MOTIONS; i++) CHECK(n.motion[i] > 0, "nothing moves as %s", dar_place_motion_name[i]);
    CHECK(n.walks > 4 * n.stands, "%zu walk, %zu found no way", n.walks, n.stands);
    CHECK(n.things > 5 * n.dropped, "%zu things placed, %zu dropped", n.things, n.dropped);
    printf("%zu things, %zu dropped; %zu walk, %zu found no way; subject seen in %zu of %zu frames\n", n.things,
           n.dropped, n.walks, n.stands, n.seen, n.frames);
}

/* ---------------------------------------------------------------- same bits */

static uint64_t hash(uint64_t h, const void *x, size_t bytes)
{
    const unsigned char *p = x;
    for (size_t i = 0; i < bytes; i++) h = (h ^ p[i]) * 0x100000001b3u;
    return h;
}

static uint64_t hash_of(const dar_synth *s)
{
    uint64_t h = 0xcbf29ce484222325u;
    for (size_t i = 0; i < s->scene.meshes; i++) h = hash(h, s->scene.mesh[i].position, s->scene.mesh[i].vertices * 12);
    for (size_t i = 0; i < s->scene.images; i++)
        h = hash(h, s->scene.image[i].rgba, 4 * s->scene.image[i].width * s->scene.image[i].height);
    for (size_t i = 0; i < s->scene.animation->channels; i++) {
        const dar_channel *c = &s->scene.animation->channel[i];
        h = hash(h, c->value, c->keys * c->width * sizeof *c->value);
    }
    h = hash(h, s->box, T * sizeof *s->box);
    return hash(h, s->cameras.view, T * sizeof *s->cameras.view);
}

static void same_bits(void **state)
{
    int threads = dar_threads();
    (void)state;
    for (uint64_t seed = 0; seed < 4; seed++) {
        uint64_t first = 0;
        for (int n = 1; n <= 3; n++) {
            dar_synth_plan p = plan_of(seed);
            dar_synth s;
            p.bare = false;
            dar_threads_set(n);
            make(&s, &p);
            if (n == 1) first = hash_of(&s);
            CHECK(hash_of(&s) == first, "seed %llu: %d threads give other bits than one", (unsigned long long)seed, n);
            dar_synth_free(&s);
        }
    }
    dar_threads_set(threads);
}

/* ---------------------------------------------------------------- sets */

static const dar_synth_set *set_named(const char *name)
{
    size_t i = 0;
    while (strcmp(dar_synth_sets[i].name, name) != 0) i++;
    return &dar_synth_sets[i];
}

static dar_synth_plan item(const dar_synth_set *set, size_t index)
{
    dar_synth_plan p = dar_synth_standard();
    p.frames = T;
    p.bare = true;
    dar_synth_set_plan(set, 5, index, 0, NULL, &p);
    return p;
}

static void kinds_are_apart(void **state)
{
    size_t n[DAR_ASSET_SETS] = { 0 };
    (void)state;
    for (size_t i = 0; i < dar_asset_kinds(); i++) {
        n[dar_asset_at(i)->set]++;
        for (size_t k = 0; k < i; k++)
            CHECK(strcmp(dar_asset_at(i)->name, dar_asset_at(k)->name) != 0, "%s is there twice",
                  dar_asset_at(i)->name);
    }
    assert_int_equal(n[DAR_ASSET_VIS], 17);
    assert_int_equal(n[DAR_ASSET_OOD], 17);
    CHECK(n[DAR_ASSET_TRAIN] >= 20, "%zu kinds to train on", n[DAR_ASSET_TRAIN]);
}

/* Every bundle of every set can be made. */
static void sets_are_whole(void **state)
{
    (void)state;
    for (int i = 1; dar_synth_set_names[i]; i++) {
        const dar_synth_set *set = &dar_synth_sets[i];
        assert_string_equal(set->name, dar_synth_set_names[i]);
        for (size_t k = 0; k < set->rows * set->columns; k++) {
            dar_synth_plan p = item(set, k);
            dar_synth s;
            make(&s, &p);
            CHECK(s.thing[0].kind == p.subject && s.path.kind == p.path, "%s, bundle %zu: another scene", set->name, k);
            dar_synth_free(&s);
        }
    }
}

/* A pixel of one camera and one of the other show points of the same rigid part: their colours are as far apart as the
 * points are, times the scale of the part, so that (tracking, position) is the same at the same point. */
static size_t compare(const drawn *a, const drawn *b, const dar_view *vb, size_t *deeper)
{
    size_t pairs = 0, n = a->pixels;
    for (size_t i = 0; i < n; i++) {
        double x[3], c[3], apart = 0, q = 0, scale, origin[3];
        if (!a->g.mask[i]) continue;
        for (size_t k = 0; k < 3; k++) x[k] = (double)a->g.world[k * n + i] - vb->c2w[4 * k + 3];
        for (size_t k = 0; k < 3; k++) c[k] = vb->c2w[k] * x[0] + vb->c2w[4 + k] * x[1] + vb->c2w[8 + k] * x[2];
        double u = vb->fx * c[0] / c[2] + vb->cx, v = vb->fy * c[1] / c[2] + vb->cy;
        if (!(c[2] > 0 && u >= 0 && v >= 0 && u < vb->width && v < vb->height)) continue;
        size_t j = (size_t)v * (size_t)vb->width + (size_t)u, instance = a->g.instance[i] - 1;
        const dar_instance *in = &a->scene->instance[instance];
        if (b->g.part[j] != a->g.part[i] || in->skin != DAR_NONE || a->scene->mesh[in->mesh].targets) continue;
        for (size_t k = 0; k < 3; k++) {
            apart += pow((double)a->g.world[k * n + i] - b->g.world[k * n + j], 2);
            q += pow((double)a->g.tracking[k * n + i] - b->g.tracking[k * n + j], 2);
        }
        dar_identity_cell(&a->identity, instance, (uint32_t)(a->g.part[i] - 1 - a->identity.first[instance]), origin,
                          &scale);
        CHECK_NEAR("distance of tracking colours", sqrt(q), scale * sqrt(apart), 2e-6);
        *deeper += fabs((double)a->g.depth[i] - b->g.depth[j]) > 0.1;
        pairs++;
    }
    return pairs;
}

static void motion_separates(void **state)
{
    const dar_synth_set *set = set_named("motion-separation");
    size_t pairs = 0, deeper = 0, columns = set->columns;
    (void)state;
    for (size_t row = 0; row < set->rows; row++) {
        dar_synth_plan pa = item(set, row * columns), pb = item(set, row * columns + 1), pc = item(set, 1);
        dar_synth a, b, c;
        drawn da, db;
        make(&a, &pa), make(&b, &pb), make(&c, &pc);
        CHECK(memcmp(b.cameras.view, c.cameras.view, T * sizeof *b.cameras.view) == 0, "row %zu: another camera", row);
        CHECK(memcmp(a.box, b.box, T * sizeof *a.box) == 0, "row %zu: another animation", row);
        CHECK(memcmp(a.cameras.view, b.cameras.view, T * sizeof *b.cameras.view) != 0, "row %zu: one camera", row);
        dar_raster_config config = dar_raster_default(pa.width, pa.height);
        drawn_init(&da, &a.scene, &config);
        drawn_init(&db, &b.scene, &config);
        for (size_t t = 0; t < T; t += 4) {
            drawn_at(&da, 0, dar_clip_time(&a.clip, t), &a.cameras.view[t]);
            drawn_at(&db, 0, dar_clip_time(&b.clip, t), &b.cameras.view[t]);
            pairs += compare(&da, &db, &b.cameras.view[t], &deeper);
        }
        dar_arena_free(&da.arena), dar_arena_free(&db.arena);
        dar_synth_free(&a), dar_synth_free(&b), dar_synth_free(&c);
    }
    printf("%zu pairs of pixels at one place, %zu of them at depths more than 0.1 m apart\n", pairs, deeper);
    CHECK(pairs > 20000 && 2 * deeper > pairs, "%zu pairs, %zu at other depths", pairs, deeper);
}

/* Another attempt at a bundle draws again what is its own, and nothing that it shares; at last the scene too. */
static void attempts_stay_apart(void **state)
{
    static const struct {
        const char *set;
        bool seed, look, view; /* shared with others */
    } rule[] = { { "train", false, false, false },
                 { "4d_vis", false, false, false },
                 { "ood34", true, true, false },
                 { "refvar", true, false, true },
                 { "motion-separation", true, true, false },
                 { "correspondence", false, false, false } };
    (void)state;
    for (size_t i = 0; i < DAR_COUNT(rule); i++)
        for (size_t index = 0; index < 10; index++) {
            const dar_synth_set *set = set_named(rule[i].set);
            dar_synth_plan first = item(set, index), p = first;
            uint64_t view[DAR_SYNTH_OWN];
            for (size_t n = 0; n < DAR_SYNTH_OWN; n++) {
                dar_synth_set_plan(set, 5, index, n, NULL, &p);
                view[n] = p.view + 3 * p.look;
                for (size_t k = 0; k < n; k++) CHECK(view[k] != view[n], "%s: attempt %zu is not new", set->name, n);
                if (n == 0) continue;
                CHECK((p.seed == first.seed) == rule[i].seed && (p.look == first.look) == rule[i].look &&
                          (p.view == first.view) == rule[i].view && p.subject == first.subject,
                      "%s, bundle %zu, attempt %zu: what is shared changes, or what is its own stays", set->name, index,
                      n);
            }
            dar_synth_set_plan(set, 5, index, DAR_SYNTH_OWN, NULL, &p);
            CHECK(p.seed != first.seed, "%s, bundle %zu: the scene stays for ever", set->name, index);
        }
}

/* Another camera of a rejected cell: other pictures of the same animation.  Paths of the benchmark, in the first two
 * columns, leave nothing to be drawn. */
static void rejected_cells_move_on(void **state)
{
    static const char *const name[] = { "motion-separation", "ood34" };
    (void)state;
    for (size_t i = 0; i < DAR_COUNT(name); i++) {
        const dar_synth_set *set = set_named(name[i]);
        for (size_t index = 2; index < 5; index++) {
            dar_synth_plan p = item(set, index);
            dar_synth first, s;
            make(&first, &p);
            dar_synth_set_plan(set, 5, index, 1, NULL, &p);
            make(&s, &p);
            CHECK(memcmp(s.box, first.box, T * sizeof *s.box) == 0, "%s: another animation", set->name);
            CHECK(memcmp(s.cameras.view, first.cameras.view, T * sizeof *s.cameras.view) != 0,
                  "%s, bundle %zu: the same camera again", set->name, index);
            dar_synth_free(&first), dar_synth_free(&s);
        }
    }
}

/* Appearances differ, geometry does not. */
static void looks_separate(void **state)
{
    const dar_synth_set *set = set_named("refvar");
    dar_synth first, s;
    (void)state;
    dar_synth_plan p = item(set, 0);
    p.bare = false;
    make(&first, &p);
    for (size_t i = 1; i < 3; i++) {
        p = item(set, i);
        p.bare = false;
        make(&s, &p);
        assert_int_equal(s.scene.images, first.scene.images);
        CHECK(memcmp(s.box, first.box, T * sizeof *s.box) == 0, "variant %zu: another animation", i);
        CHECK(memcmp(s.cameras.view, first.cameras.view, T * sizeof *s.cameras.view) == 0, "variant %zu: camera", i);
        for (size_t k = 0; k < s.scene.images; k++)
            CHECK(memcmp(s.scene.image[k].rgba, first.scene.image[k].rgba, (size_t)4 * DAR_MAKE_SIDE * DAR_MAKE_SIDE),
                  "variant %zu: texture %zu is the same", i, k);
        dar_synth_free(&s);
    }
    dar_synth_free(&first);
}

/* Steps from one texel to the next, in all textures of a scene. */
static double roughness(const dar_scene *s)
{
    double sum = 0;
    for (size_t i = 0; i < s->images; i++)
        for (size_t k = 4; k < (size_t)4 * DAR_MAKE_SIDE * DAR_MAKE_SIDE; k++)
            sum += abs(s->image[i].rgba[k] - s->image[i].rgba[k - 4]);
    return sum / fmax(1, (double)s->images);
}

/* Largest angle at which the camera sees the subject, over the clip [rad]. */
static double angle(const dar_synth *s)
{
    double most = 0;
    for (size_t t = 0; t < T; t++) {
        const dar_box *b = &s->thing[0].box[t];
        double far = 0, size = 0;
        for (int k = 0; k < 3; k++) {
            far += pow(s->cameras.view[t].c2w[4 * k + 3] - (b->lo[k] + b->hi[k]) / 2, 2);
            size += pow(b->hi[k] - b->lo[k], 2);
        }
        most = fmax(most, 2 * atan(sqrt(size / far) / 2));
    }
    return most;
}

/* Scenes for small networks: the same subject alone, nearer, in plainer patterns, and still in view. */
static void coarse_is_plain(void **state)
{
    (void)state;
    double rough[2] = { 0 }, large[2] = { 0 };
    size_t seen = 0, scenes = 60;
    for (uint64_t seed = 0; seed < scenes; seed++)
        for (int coarse = 0; coarse < 2; coarse++) {
            dar_synth s;
            dar_synth_plan p = plan_of(seed);
            p.coarse = coarse, p.bare = false;
            make(&s, &p);
            rough[coarse] += roughness(&s.scene), large[coarse] += angle(&s);
            for (size_t i = 1; coarse && i < s.things; i++)
                CHECK(strcmp(s.thing[i].kind->family, "object") == 0, "seed %d: %s is there", (int)seed,
                      s.thing[i].kind->name);
            for (size_t t = 0; coarse && t < T; t++)
                seen += dar_trajectory_in_view(&s.cameras.view[t], &s.thing[0].box[t], -0.001);
            dar_synth_free(&s);
        }
    printf("coarse: textures %.2f as rough, subjects %.2f as large, seen in %zu of %zu frames\n", rough[1] / rough[0],
           large[1] / large[0], seen, scenes * T);
    CHECK(rough[1] < 0.6 * rough[0] && large[1] > 1.2 * large[0], "roughness %g, size %g", rough[1] / rough[0],
          large[1] / large[0]);
    CHECK(100 * seen >= 99 * scenes * T, "the subject is in view in %zu of %zu frames", seen, scenes * T);
}

/* ---------------------------------------------------------------- shapes */

/* A closed shape about the origin: its faces look outwards. */
static void check_shape(dar_maker *m, const char *name)
{
    const dar_mesh *x = &m->scene->mesh[dar_make_end(m, name)];
    double volume = 0;
    for (size_t t = 0; t < x->triangles; t++) {
        double p[3][3], n[3], g[3] = { 0 }, e1[3], e2[3];
        for (int c = 0; c < 3; c++)
            for (int k = 0; k < 3; k++) {
                p[c][k] = x->position[3 * x->index[3 * t + (size_t)c] + (size_t)k];
                g[k] += x->normal[3 * x->index[3 * t + (size_t)c] + (size_t)k];
            }
        for (int k = 0; k < 3; k++) e1[k] = p[1][k] - p[0][k], e2[k] = p[2][k] - p[0][k];
        made_cross(e1, e2, n);
        volume += made_dot(p[0], n) / 6;
        CHECK(made_dot(n, g) > 0, "%s: triangle %zu turns away from its normals", name, t);
    }
    CHECK(volume > 0.01, "%s: volume %g", name, volume);
    for (size_t i = 0; i < 3 * x->vertices; i++) CHECK(isfinite(x->normal[i]), "%s: normal %zu", name, i);
}

static void shapes_face_outwards(void **state)
{
    dar_scene s;
    dar_maker m;
    dar_err e;
    (void)state;
    assert_int_equal(dar_make_open(&m, &s, 2, 24, &e), DAR_OK);
    m.paint = dar_make_plain(&m, 1, 1, 1);
    dar_make_begin(&m), dar_make_box(&m, 1, 2, 3), check_shape(&m, "box");
    dar_make_begin(&m), dar_make_round(&m, 1, 2, 3, 1, 1), check_shape(&m, "ellipsoid");
    dar_make_begin(&m), dar_make_round(&m, 1, 2, 1, 0.3, 0.5), check_shape(&m, "superquadric");
    dar_make_begin(&m), dar_make_torus(&m, 1, 0.3), check_shape(&m, "torus");
    dar_make_begin(&m), dar_make_cone(&m, 1, 0.5, 2), check_shape(&m, "cone");
    dar_make_begin(&m), dar_make_gear(&m, 11, 1, 0.2, 0.4), check_shape(&m, "gear");
    dar_make_begin(&m), dar_make_rock(&m, 1, 0.4, 3), check_shape(&m, "rock");
    const double upright[3][4] = { { 0, 0, 0, 0.3 }, { 0.2, 1, 0, 0.3 }, { 0, 2, 0.2, 0.2 } };
    const double level[3][4] = { { 0, 0, 0, 0.3 }, { 1, 0.2, 0, 0.3 }, { 2, 0, 0.5, 0.2 } };
    dar_make_begin(&m), dar_make_tube(&m, upright, 3, NULL), check_shape(&m, "tube upright");
    dar_make_begin(&m), dar_make_tube(&m, level, 3, NULL), check_shape(&m, "tube level");
    dar_make_begin(&m), dar_make_stretch(&m, -1, 1, 1), dar_make_box(&m, 1, 2, 3), check_shape(&m, "mirrored box");
    dar_scene_free(&s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(shapes_face_outwards),
        cmocka_unit_test(thousand_scenes),
        cmocka_unit_test(same_bits),
        cmocka_unit_test(kinds_are_apart),
        cmocka_unit_test(sets_are_whole),
        cmocka_unit_test(motion_separates),
        cmocka_unit_test(looks_separate),
        cmocka_unit_test(coarse_is_plain),
        cmocka_unit_test(attempts_stay_apart),
        cmocka_unit_test(rejected_cells_move_on),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
