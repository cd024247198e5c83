/* asset.c: the tables as one. */
#include "data/asset.h"

#include "data/asset_inside.h"

static const struct {
    const dar_asset_kind *row;
    const size_t *rows;
} table[] = {
    { dar_asset_creatures, &dar_asset_creature_count }, { dar_asset_vehicles, &dar_asset_vehicle_count },
    { dar_asset_machines, &dar_asset_machine_count },   { dar_asset_softs, &dar_asset_soft_count },
    { dar_asset_interiors, &dar_asset_interior_count },
};

size_t dar_asset_kinds(void)
{
    size_t n = 0;
    for (size_t i = 0; i < DAR_COUNT(table); i++) n += *table[i].rows;
    return n;
}

const dar_asset_kind *dar_asset_at(size_t i)
{
    for (size_t t = 0; t < DAR_COUNT(table); t++) {
        if (i < *table[t].rows) return &table[t].row[i];
        i -= *table[t].rows;
    }
    DAR_ASSERT(false, "asset: kind beyond the last by %zu", i);
    return NULL;
}

size_t dar_asset_stills(void)
{
    return dar_asset_object_count;
}

const dar_asset_kind *dar_asset_still_at(size_t i)
{
    DAR_ASSERT(i < dar_asset_object_count, "asset: still %zu of %zu", i, dar_asset_object_count);
    return &dar_asset_objects[i];
}

dar_asset dar_asset_make(dar_maker *m, const dar_asset_kind *kind, dar_dice *d)
{
    dar_asset a = { .root = dar_make_node(m, DAR_NONE, kind->name, 0, 0, 0) };
    kind->make(m, d, kind->row, &a);
    return a;
}
