/* synth_set.c: a row of a table for each set. */
#include "data/synth_set.h"

#include <string.h>

#include "data/bundle.h"

/* A seed that fits the metadata of a bundle. */
static uint64_t seed_of(uint64_t seed, const char *purpose, uint64_t number)
{
    return dar_rng_u64(seed, dar_rng_stream(purpose), number) & DAR_BUNDLE_MAX_SEED;
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

static void plan_train(uint64_t seed, size_t row, size_t column, dar_synth_plan *p)
{
    (void)column;
    p->seed = p->look = p->view = seed_of(seed, "train", row);
}

static void plan_vis(uint64_t seed, size_t row, size_t column, dar_synth_plan *p)
{
    p->seed = p->look = p->view = seed_of(seed, "4d_vis", row);
    p->set = DAR_ASSET_VIS;
    p->subject = kind_of(DAR_ASSET_VIS, row);
    p->alone = row % 2 == 0;
    p->path = path_named(benchmark[column]);
}

static void plan_ood(uint64_t seed, size_t row, size_t column, dar_synth_plan *p)
{
    dar_dice d = dar_dice_for(seed, "ood34 path", 2 * row + column);
    p->seed = p->look = seed_of(seed, "ood34", row);
    p->view = seed_of(seed, "ood34 view", 2 * row + column);
    p->set = DAR_ASSET_OOD;
    p->subject = kind_of(DAR_ASSET_OOD, row);
    p->path = path_of(column ? "unreal" : "blender", &d);
}

static const dar_asset_kind *kind_named(const char *name)
{
    for (size_t i = 0; i < dar_asset_kinds(); i++)
        if (strcmp(dar_asset_at(i)->name, name) == 0) return dar_asset_at(i);
    DAR_ASSERT(false, "synth: no kind %s", name);
    return NULL;
}

static void plan_refvar(uint64_t seed, size_t row, size_t column, dar_synth_plan *p)
{
    (void)column;
    p->seed = p->view = seed_of(seed, "refvar", 0);
    p->look = seed_of(seed, "refvar look", row);
    p->set = DAR_ASSET_VIS;
    p->subject = kind_named("racer");
    p->alone = true;
    p->path = path_named("orbit-30");
}

static void plan_separation(uint64_t seed, size_t row, size_t column, dar_synth_plan *p)
{
    static const char *const path[] = { "orbit-30", "orbit-60", "dolly-in", "vertical-arc-up", "ue-oblique-orbit" };
    static const char *const subject[] = { "dancer", "cat", "racer", "ferris wheel", "twisting tower" };
    p->seed = p->look = seed_of(seed, "separation", row);
    p->view = seed_of(seed, "separation view", column);
    p->set = DAR_ASSET_VIS;
    p->subject = kind_named(subject[row]);
    p->path = path_named(path[column]);
    p->alone = true;
    p->reach = 3;
}

static void plan_correspondence(uint64_t seed, size_t row, size_t column, dar_synth_plan *p)
{
    static const char *const path[] = { "half-orbit", "ue-orbit-half", "low-arc-half", "full-orbit" };
    (void)column;
    p->seed = p->look = p->view = seed_of(seed, "correspondence", row);
    p->set = DAR_ASSET_VIS;
    p->subject = kind_of(DAR_ASSET_VIS, row);
    p->path = path_named(path[row % 4]);
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
    if (attempt) seed = seed_of(seed, "attempt", attempt);
    p->set = DAR_ASSET_TRAIN;
    p->subject = NULL, p->path = NULL;
    p->reach = 0;
    p->alone = false;
    set->plan(seed, index / columns, index % columns, p);
    if (!family || p->subject) return;
    dar_dice d = dar_dice_for(p->seed, "subject", 0);
    do {
        p->subject = dar_asset_at(dar_dice_below(&d, dar_asset_kinds()));
    } while (p->subject->set != p->set || strcmp(p->subject->family, family) != 0);
}
