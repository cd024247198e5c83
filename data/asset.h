/* asset.h: things that scenes are made of, each a draw inside the row of a table.
 *
 * Every kind belongs to one set of scenes alone: what is trained on is never what is measured on. */
#ifndef DAR_DATA_ASSET_H
#define DAR_DATA_ASSET_H

#include "data/make.h"

typedef enum dar_asset_set {
    DAR_ASSET_TRAIN,
    DAR_ASSET_VIS, /* 17 kinds, one for each scene of the benchmark */
    DAR_ASSET_OOD, /* 17 others */
    DAR_ASSET_SETS
} dar_asset_set;

typedef enum dar_asset_way {
    DAR_ASSET_STAYS,
    DAR_ASSET_WALKS, /* goes along paths on the ground at `speed` */
    DAR_ASSET_FLIES, /* the same, `height` above the ground */
} dar_asset_way;

/* What was made: everything is below the node `root`. */
typedef struct dar_asset {
    int root;
    dar_asset_way way;
    double speed;  /* [m/s] at which its gait does not slip */
    double height; /* [m] */
} dar_asset;

typedef struct dar_asset_kind {
    const char *name, *family; /* family: humanoid, quadruped, ... */
    dar_asset_set set;
    void (*make)(dar_maker *m, dar_dice *d, const void *row, dar_asset *out);
    const void *row;
} dar_asset_kind;

/* Animated ones, and ones that only a scene moves. */
size_t dar_asset_kinds(void);
const dar_asset_kind *dar_asset_at(size_t i);
size_t dar_asset_stills(void);
const dar_asset_kind *dar_asset_still_at(size_t i);

/* Dice decide everything but the kind and the paints, which are drawn with m->look. */
dar_asset dar_asset_make(dar_maker *m, const dar_asset_kind *kind, dar_dice *d);

#endif
