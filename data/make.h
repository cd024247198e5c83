/* make.h: scenes made in memory instead of read from a file: shapes, paints, nodes and how they move.
 *
 *     DAR_TRY(dar_make_open(&m, &scene, frames, fps, e));
 *     int node = dar_make_node(&m, DAR_NONE, "ball", 0, 1, 0);
 *     dar_make_begin(&m);
 *     m.paint = dar_make_paint(&m, &dar_make_any);
 *     dar_make_round(&m, 0.5, 0.5, 0.5, 1, 1);
 *     dar_make_show(&m, node, dar_make_end(&m, "ball"));
 *     dar_make_move(&m, (dar_mover){ .node = node, .path = DAR_ROTATION, .axis = { 0, 1, 0 }, .rate = 1 });
 *     dar_make_close(&m);
 *
 * Units are metres and seconds, y is up, +z the front.  Shapes are sheets of quads with texture coordinates that belong
 * to the rest pose: a texture stays where it is on a surface however that moves.
 *
 * Every limit below is one of the maker, not of scenes: going beyond it aborts. */
#ifndef DAR_DATA_MAKE_H
#define DAR_DATA_MAKE_H

#include "data/dice.h"
#include "data/mesh.h"

#define DAR_MAKE_MEMORY    ((size_t)192 << 20) /* [bytes] of addresses; used as far as needed */
#define DAR_MAKE_VERTICES  65536               /* of one mesh */
#define DAR_MAKE_TRIANGLES (2 * DAR_MAKE_VERTICES)
#define DAR_MAKE_PARTS     64 /* primitives of one mesh */
#define DAR_MAKE_NODES     1024
#define DAR_MAKE_MESHES    256
#define DAR_MAKE_PAINTS    128
#define DAR_MAKE_SKINS     32
#define DAR_MAKE_MOVERS    2048
#define DAR_MAKE_TARGETS   8   /* of one mesh */
#define DAR_MAKE_COARSE    0.4 /* of the repeats of a texture, in coarse scenes */
#define DAR_MAKE_SIDE      128 /* of a texture [px] */

/* One property of one node over time, in addition to its rest value:
 *
 *   value(t) = base + swing sin(2 pi (frequency t + phase)) + rate t
 *
 * DAR_ROTATION: an angle [rad] about axis; movers of one node turn one after the other, the last nearest to the mesh.
 * DAR_TRANSLATION: along axis [m].  DAR_SCALE: 1 + value axis.  DAR_WEIGHTS: the weight of `target`.
 * track: instead of the formula, [frames, 3] positions or [frames, 4] rotations, which replace the rest value. */
typedef struct dar_mover {
    int node;
    dar_channel_path path;
    double axis[3];
    double base, swing, frequency, phase, rate;
    size_t target;
    const double *track;
} dar_mover;

typedef struct dar_maker {
    dar_scene *scene;
    size_t frames;
    double fps;
    dar_dice look; /* of the paints: others give the same things in other colours */
    bool bare;     /* paints are left out: geometry alone is wanted */
    bool coarse;   /* patterns are of few and large figures, without fine lines */

    /* In force for the shapes that follow. */
    double at[12];  /* shape to mesh */
    int paint;      /* material */
    double density; /* repeats of the texture per metre; coarse: DAR_MAKE_COARSE of it */
    int joint;      /* that carries them; DAR_NONE: the mesh has no skin */

    dar_mover *mover;
    size_t movers;

    /* The mesh that is being made. */
    struct dar_make_mesh *mesh;
} dar_maker;

/* The scene is zeroed first.  The caller owes one dar_scene_free, also after a failure. */
dar_status dar_make_open(dar_maker *m, dar_scene *s, size_t frames, double fps, dar_err *e);

/* Movers become the scene's one animation, "clip", with a key at every frame; calling it again replaces it. */
void dar_make_close(dar_maker *m);

/* Without a parent: at the top of the scene. */
int dar_make_node(dar_maker *m, int parent, const char *name, double x, double y, double z);
void dar_make_turn(dar_maker *m, int node, double x, double y, double z,
                   double angle); /* at rest [rad], before its own */
void dar_make_move(dar_maker *m, dar_mover mover);

/* ---------------------------------------------------------------- meshes */

/* Begin an empty mesh: `at` the identity, no joint. */
void dar_make_begin(dar_maker *m);
int dar_make_end(dar_maker *m, const char *name);

/* A node shows a mesh, and what is below it in the order of these calls are the scene's instances. */
void dar_make_show(dar_maker *m, int node, int mesh);

/* A skin of nodes that stand where they stand at rest: joint[k] carries what was made with m->joint == k. */
void dar_make_skin(dar_maker *m, int node, int mesh, const int *joint, size_t joints);

/* A morph target: where(ctx, x, y) is the place y of the vertex that is at x.  Before dar_make_end. */
typedef void dar_make_bend(const void *ctx, const double x[3], double y[3]);
void dar_make_target(dar_maker *m, dar_make_bend *where, const void *ctx);

/* ---------------------------------------------------------------- shapes, appended to the mesh through m->at */

/* A sheet of rows x columns quads: x(u, v) for u, v in [0, 1]; outside is where d/du x d/dv points. */
typedef struct dar_sheet_shape {
    size_t rows, columns; /* quads along v, along u */
    bool closed_u, closed_v;
    double repeat_u, repeat_v; /* of the texture; planar: per metre of x and z */
    bool planar;               /* the texture lies level */
    void (*point)(const void *ctx, double u, double v, double x[3]);
    void (*joints)(const void *ctx, double u, double v, int joint[2],
                   double *second); /* NULL: m->joint; share of [1] */
    const void *ctx;
} dar_sheet_shape;
void dar_make_sheet(dar_maker *m, const dar_sheet_shape *s);

/* Back to the origin of the mesh; then translate, turn, scale what follows, in this order of reading. */
void dar_make_home(dar_maker *m);
void dar_make_shift(dar_maker *m, double x, double y, double z);
void dar_make_rotate(dar_maker *m, double x, double y, double z, double angle);
void dar_make_stretch(dar_maker *m, double x, double y, double z);

void dar_make_box(dar_maker *m, double x, double y, double z); /* sides, about the origin */
/* Superquadric with half axes x, y, z; exponents 1, 1: an ellipsoid; towards 0: a box; 2: an octahedron. */
void dar_make_round(dar_maker *m, double x, double y, double z, double north, double east);
void dar_make_torus(dar_maker *m, double radius, double tube);
/* From y = 0 to height, with flat ends where a radius is not 0. */
void dar_make_cone(dar_maker *m, double bottom, double top, double height);
/* Around y: profile [n] of (radius, y), from below upwards on the outside. */
void dar_make_lathe(dar_maker *m, const double (*profile)[2], size_t n);
/* Around a curve of n points of (x, y, z, radius), with round ends; joint [n], or NULL, carries each point. */
void dar_make_tube(dar_maker *m, const double (*spine)[4], size_t n, const int *joint);
/* About z, thickness in z. */
void dar_make_gear(dar_maker *m, size_t teeth, double radius, double depth, double thickness);
/* A sphere displaced by noise of a seed. */
void dar_make_rock(dar_maker *m, double radius, double rough, uint64_t seed);
/* In x and z, about the origin, upwards; lying also as a disc. */
void dar_make_plate(dar_maker *m, double x, double z, size_t quads);
void dar_make_disc(dar_maker *m, double radius); /* its texture lies level, too */

/* ---------------------------------------------------------------- paints */

typedef struct dar_paint_style {
    unsigned patterns; /* bit 1 << pattern; 0: any */
    int palette;       /* DAR_NONE: any */
    double contrast;   /* of the colours to their mean, 1: as they are */
    bool double_sided;
} dar_paint_style;

typedef enum dar_pattern {
    DAR_PATTERN_PLAIN,
    DAR_PATTERN_CHECKER,
    DAR_PATTERN_STRIPES,
    DAR_PATTERN_SLANTED,
    DAR_PATTERN_DOTS,
    DAR_PATTERN_BRICKS,
    DAR_PATTERN_TILES,
    DAR_PATTERN_WOOD,
    DAR_PATTERN_CLOUDS,
    DAR_PATTERN_MARBLE,
    DAR_PATTERN_GRADIENT,
    DAR_PATTERN_ZIGZAG,
    DAR_PATTERN_RINGS,
    DAR_PATTERN_PLAID,
    DAR_PATTERN_SPOTS,
    DAR_PATTERNS
} dar_pattern;

extern const dar_paint_style dar_make_any;

/* A material with a texture of its own, drawn with m->look.  Returns its number. */
int dar_make_paint(dar_maker *m, const dar_paint_style *style);

/* A material of one colour, sRGB. */
int dar_make_plain(dar_maker *m, double r, double g, double b);

#endif
