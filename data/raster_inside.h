/* raster_inside.h: what the files of the rasteriser share.  Nobody else includes it. */
#ifndef DAR_DATA_RASTER_INSIDE_H
#define DAR_DATA_RASTER_INSIDE_H

#include "data/raster.h"

#define DAR_RASTER_PIECE  256 /* triangles; an id is number of piece * 256 + triangle of the piece, + 1 */
#define DAR_RASTER_GROUPS 16  /* of pieces, binned in parallel */
#define DAR_TILE_PIXELS   (DAR_TILE_WIDTH * DAR_TILE_HEIGHT)

/* Triangles of one primitive. */
typedef struct dar_raster_piece {
    uint32_t instance, triangle, count; /* first of the mesh, number */
    int material;
    bool double_sided, masked; /* masked: coverage depends on alpha */
    double cutoff;
    size_t references; /* pairs of triangle and tile in this frame */
    uint32_t outside, behind, back, edge_on, small;
} dar_raster_piece;

/* Vertices of one instance. */
typedef struct dar_raster_run {
    uint32_t instance;
    size_t begin, end; /* posed vertices */
    double box[6];     /* lowest and highest corner */
} dar_raster_run;

/* Pixels that a triangle may cover, both ends included; x1 < x0: none. */
typedef struct dar_raster_box {
    uint16_t x0, y0, x1, y1;
} dar_raster_box;

/* E_k = a_k dx + b_k dy + c_k >= least_k on all three: inside.  1 / depth = w[0] dx + w[1] dy + w[2]. */
typedef struct dar_raster_edges {
    double a[3], b[3], c[3], least[3], w[3];
    bool back; /* seen from behind, unless mirrored */
} dar_raster_edges;

struct dar_raster_inside {
    dar_raster_piece *piece;
    dar_raster_run *run;
    size_t pieces, runs;
    bool *seen;       /* [instances] not wholly outside the view */
    bool *kept;       /* [instances] cam and px are of this view */
    double (*box)[6]; /* [instances] */
    double (*cam)[3]; /* [vertices] in the camera */
    double (*px)[2];  /* [vertices] on the picture, where depth >= near */
    double *dx, *dy;  /* [width], [height] rays of columns and rows */

    dar_raster_box *bounds; /* [pieces, DAR_RASTER_PIECE] */
    uint32_t *reference;    /* [capacity] ids of triangles, by tile */
    size_t capacity;
    size_t *start;                       /* [tiles + 1] of each tile in `reference`, this round */
    size_t *next;                        /* [groups, tiles] where the group writes */
    size_t group[DAR_RASTER_GROUPS + 1]; /* first piece of each group */
    size_t tiles_x, tiles_y;
    bool *used;              /* [tiles] drawn into in this frame */
    bool *zero;              /* [tiles] empty in what was drawn last */
    double *nearest;         /* [tiles, DAR_TILE_PIXELS] 1 / depth */
    double *shown;           /* [tiles, DAR_TILE_PIXELS] id, exact; f64 so that both are selected by one mask */
    double (*spent)[2];      /* [tiles] seconds of cover and resolve */
    bool *mirrored;          /* [instances] in the pose drawn last */
    bool drawn, has_normals; /* something; with normals */
};

/* Corners of triangle t of a mesh: number of posed vertices of its instance. */
static inline void dar_raster_corners(const dar_raster *r, uint32_t instance, size_t t, size_t corner[3])
{
    const dar_instance *in = &r->scene->instance[instance];
    const uint32_t *index = r->scene->mesh[in->mesh].index + 3 * t;
    for (int k = 0; k < 3; k++) corner[k] = in->vertex + index[k];
}

/* raster_bin.c */
void dar_raster_transform(dar_raster *r, const dar_pose *p, bool moved);
void dar_raster_cull(dar_raster *r, const dar_pose *p);
size_t dar_raster_bin(dar_raster *r, size_t first); /* from this piece on; returns the first that is left */

/* raster_cover.c: the round's triangles into `nearest` and `shown` of one tile; fresh: it held nothing. */
double dar_raster_side(const dar_raster *r, const size_t corner[3]); /* > 0: seen from behind, 0: edge-on */
void dar_raster_edges_of(const dar_raster *r, const size_t corner[3], dar_raster_edges *e); /* of one not edge-on */
void dar_raster_cover(dar_raster *r, size_t tile, bool fresh);

/* raster_resolve.c */
void dar_raster_resolve(const dar_raster *r, const dar_pose *p, const dar_gbuffer *out, size_t tile);
void dar_raster_fill(const dar_raster *r, const dar_gbuffer *out); /* of empty tiles */

#endif
