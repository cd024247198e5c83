/* asset_inside.h: what the files of asset.h share. */
#ifndef DAR_DATA_ASSET_INSIDE_H
#define DAR_DATA_ASSET_INSIDE_H

#include "data/asset.h"

/* Tables of the files, one row a kind. */
extern const dar_asset_kind dar_asset_creatures[], dar_asset_vehicles[], dar_asset_machines[], dar_asset_softs[],
    dar_asset_interiors[], dar_asset_objects[];
extern const size_t dar_asset_creature_count, dar_asset_vehicle_count, dar_asset_machine_count, dar_asset_soft_count,
    dar_asset_interior_count, dar_asset_object_count;

/* A paint of one of the patterns: DAR_PAINT(DOTS) | DAR_PAINT(PLAIN). */
#define DAR_PAINT(name) (1u << DAR_PATTERN_##name)
static inline int dar_asset_paint(dar_maker *m, unsigned patterns)
{
    dar_paint_style style = dar_make_any;
    style.patterns = patterns;
    return dar_make_paint(m, &style);
}

#endif
