/* synth_set.c: a row of a table for each set. */
#include "data/synth_set.h"

#include <string.h>

#include "data/bundle.h"

/* A seed that fits the metadata of a bundle. */
static uint64_t seed_of(uint64_t seed, const char *purpose, uint64_t number)
{
    return dar_rng_u64(seed, dar_rng_stream(purpose), number) & DAR_BUNDLE_MAX_SEED;
}

/* The seed of a set for another attempt. */
static uint64_t again(uint64_t seed, size_t attempt)
{
    return attempt ? seed_of(seed, "attempt", attempt) : seed;
}

/* The n-th kind of a set. */
static const dar_asset_kind *kind_of(dar_asset_set set, size_t n)
{
    for (size_t i = 0; i < dar_asset_kinds(); i++)
        if (dar_asset_at(i)->set == set && n-- == 0) return dar_asset_at(i);
    DAR_ASSERT(false, "synth: set %d has not so many kinds", (int)set);
    return NULL;
}

static const dar_trajectory_kind *path_named(const char *name)
{
    const dar_trajectory_kind *k;
    dar_status s = dar_trajectory_find(name, &k, NULL);
    DAR_ASSERT(s == DAR_OK, "synth: no trajectory %s", name);
    return k;
}

/* A path of "blender" or "unreal". */
static const dar_trajectory_kind *path_of(const char *family, dar_dice *d)
{
    for (;;) {
        const dar_trajectory_kind *k = &dar_trajectory_kinds[dar_dice_below(d, dar_trajectory_count)];
        if (strcmp(k->family, family) == 0) return k;
    }
}

static const char *const benchmark[] = { "dolly-15", "orbit-30", "orbit-60", "orbit-0-45" };

static void plan_train(const dar_synth_cell *c, dar_synth_plan *p)
{
    p->seed = p->look = p->view = seed_of(c->own, "train", c->row);
}

static void plan_vis(const dar_synth_cell *c, dar_synth_plan *p)
{
    p->seed = p->look = p->view = seed_of(c->own, "4d_vis", c->row); /* its paths leave nothing to be drawn */
    p->set = DAR_ASSET_VIS;
    p->subject = kind_of(DAR_ASSET_VIS, c->row);
    p->alone = c->row % 2 == 0;
    p->path = path_named(benchmark[c->column]);
}

static void plan_ood(const dar_synth_cell *c, dar_synth_plan *p)
{
    dar_dice d = dar_dice_for(c->own, "ood34 path", 2 * c->row + c->column);
    p->seed = p->look = seed_of(c->shared, "ood34", c->row);
    p->view = seed_of(c->own, "ood34 view", 2 * c->row + c->column);
    p->set = DAR_ASSET_OOD;
    p->subject = kind_of(DAR_ASSET_OOD, c->row);
    p->path = path_of(c->column ? "unreal" : "blender", &d);
}

static const dar_asset_kind *kind_named(const char *name)
{
    for (size_t i = 0; i < dar_asset_kinds(); i++)
        if (strcmp(dar_asset_at(i)->name, name) == 0) return dar_asset_at(i);
    DAR_ASSERT(false, "synth: no kind %s", name);
    return NULL;
}

static void plan_refvar(const dar_synth_cell *c, dar_synth_plan *p)
{
    p->seed = p->view = seed_of(c->shared, "refvar", 0);
    p->look = seed_of(c->own, "refvar look", c->row);
    p->set = DAR_ASSET_VIS;
    p->subject = kind_named("racer");
    p->alone = true;
    p->path = path_named("orbit-30");
}

static void plan_separation(const dar_synth_cell *c, dar_synth_plan *p)
{
    static const char *const path[] = { "orbit-30", "orbit-60", "dolly-in", "vertical-arc-up", "ue-oblique-orbit" };
    static const char *const subject[] = { "dancer", "cat", "racer", "ferris wheel", "twisting tower" };
    p->seed = p->look = seed_of(c->shared, "separation", c->row);
    p->view = seed_of(c->own, "separation view", c->column);
    p->set = DAR_ASSET_VIS;
    p->subject = kind_named(subject[c->row]);
    p->path = path_named(path[c->column]);
    p->alone = true;
    p->reach = 3;
}

static void plan_correspondence(const dar_synth_cell *c, dar_synth_plan *p)
{
    static const char *const path[] = { "half-orbit", "ue-orbit-half", "low-arc-half", "full-orbit" };
    p->seed = p->look = p->view = seed_of(c->own, "correspondence", c->row);
    p->set = DAR_ASSET_VIS;
    p->subject = kind_of(DAR_ASSET_VIS, c->row);
    p->path = path_named(path[c->row % 4]);
}

const dar_synth_set dar_synth_sets[] = {
    { "train", "any number of bundles, all different", 0, 0, plan_train },
    { "4d_vis", "17 scenes x 4 camera paths of the benchmark", 17, 4, plan_vis },
    { "ood34", "17 scenes of other kinds x 2 camera paths", 17, 2, plan_ood },
    { "refvar", "one scene and camera path, 10 appearances", 10, 1, plan_refvar },
    { "motion-separation", "5 animations x 5 camera paths", 5, 5, plan_separation },
    { "correspondence", "16 large orbits", 16, 1, plan_correspondence },
};
const char *const dar_synth_set_names[] = { "train",          "4d_vis", "ood34", "refvar", "motion-separation",
                                            "correspondence", NULL };

bool dar_synth_set_has(const char *family)
{
    for (size_t i = 0; i < dar_asset_kinds(); i++)
        if (dar_asset_at(i)->set == DAR_ASSET_TRAIN && strcmp(dar_asset_at(i)->family, family) == 0) return true;
    return false;
}

void dar_synth_set_plan(const dar_synth_set *set, uint64_t seed, size_t index, size_t attempt, const char *family,
                        dar_synth_plan *p)
{
    size_t columns = set->columns ? set->columns : 1;
    const dar_synth_cell cell = { again(seed, attempt / DAR_SYNTH_OWN * DAR_SYNTH_OWN), again(seed, attempt),
                                  index / columns, index % columns };
    p->set = DAR_ASSET_TRAIN;
    p->subject = NULL, p->path = NULL;
    p->reach = 0;
    p->alone = false;
    set->plan(&cell, p);
    if (!family || p->subject) return;
    dar_dice d = dar_dice_for(p->seed, "subject", 0);
    do {
        p->subject = dar_asset_at(dar_dice_below(&d, dar_asset_kinds()));
    } while (p->subject->set != p->set || strcmp(p->subject->family, family) != 0);
}
