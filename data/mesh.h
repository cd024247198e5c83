/* mesh.h: an animated scene as everyone after the loader sees it, whatever file it came from.
 *
 * Made by data/gltf.h and data/objseq.h, posed by data/pose.h, read-only in between.  All of it, names included, lives
 * in the scene's own arena.  Every index is in range, every number finite, every quaternion and normal of unit length
 * (a normal that the file left zero stays zero): users need not check again.
 *
 * Axes and unit are those of the file; glTF says y up, metres.  Matrices are affine, f64, row-major [3, 4]: y = M x
 * with x = (x, y, z, 1).  Quaternions are (x, y, z, w).  Triangles are counter-clockwise seen from outside, unless
 * their instance is mirrored. */
#ifndef DAR_DATA_MESH_H
#define DAR_DATA_MESH_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "data/image.h"
#include "lib/arena.h"
#include "lib/status.h"

#define DAR_NONE (-1) /* where an index may be absent */

/* A part of a mesh with one material; its vertices are nobody else's. */
typedef struct dar_primitive {
    size_t vertex, vertices;    /* first and number among the mesh's vertices */
    size_t triangle, triangles; /* among the mesh's triangles */
    int material;               /* or DAR_NONE */
    bool textured;              /* has texture coordinates; else the material's texture plays no part */
    bool flat;                  /* no normals given: vertices 3k .. 3k+2 are triangle k's alone and take its normal */
} dar_primitive;

typedef struct dar_mesh {
    const char *name;
    size_t vertices, triangles;
    dar_primitive *primitive;
    size_t primitives;

    float *position; /* [vertices, 3] */
    float *normal;   /* [vertices, 3]; of flat primitives undefined */
    float *uv;       /* [vertices, 2] for the base colour texture, transformed; NULL: no primitive has them */
    float *color;    /* [vertices, 4] linear; NULL: none, else 1 where a primitive has none */
    uint32_t *index; /* [triangles, 3] into the mesh's vertices */

    size_t influences; /* joints per vertex, 0: no skin */
    uint16_t *joint;   /* [vertices, influences] into the skin's joints; 0 where the weight is 0 */
    float *weight;     /* [vertices, influences], at least 0, sum 1 */
    size_t joints;     /* largest joint + 1 */

    size_t targets;         /* morph: x = position + sum of weight[k] target_position[k], before the skin */
    float *target_position; /* [targets, vertices, 3] */
    float *target_normal;   /* [targets, vertices, 3]; NULL: none */
    double *target_weight;  /* [targets] where the node has none */
} dar_mesh;

typedef struct dar_skin {
    const char *name;
    size_t joints;
    int *joint;            /* [joints] nodes */
    double (*inverse)[12]; /* [joints] inverse bind matrices */
} dar_skin;

typedef struct dar_node {
    const char *name;
    int parent;             /* or DAR_NONE */
    int depth;              /* number of ancestors */
    int mesh, skin, camera; /* or DAR_NONE */
    bool has_matrix;        /* `matrix` holds instead of the three; such a node is never animated */
    bool in_scene;          /* below a root of the scene that is shown */
    double translation[3], rotation[4], scale[3];
    double matrix[12];
    const double *weight; /* [targets of the mesh] at rest; NULL: no morph */
    size_t first_weight;  /* of this node in a pose's weights */
} dar_node;

/* A mesh in a place.  Its posed vertices follow those of the instance before it. */
typedef struct dar_instance {
    int node, mesh;
    int skin;       /* or DAR_NONE; if there is one, the transform of the node plays no part */
    size_t vertex;  /* first among the scene's posed vertices */
    bool has_local; /* `local` is applied before the node's transform */
    double local[12];
} dar_instance;

typedef enum dar_interpolation { DAR_STEP, DAR_LINEAR, DAR_CUBIC } dar_interpolation;
typedef enum dar_channel_path { DAR_TRANSLATION, DAR_ROTATION, DAR_SCALE, DAR_WEIGHTS } dar_channel_path;

/* One property of one node over time. */
typedef struct dar_channel {
    int node;
    dar_channel_path path;
    dar_interpolation interpolation;
    size_t keys, width; /* numbers per value: 3, 4, or the morph targets of the node's mesh */
    const double *time; /* [keys] [s], never decreasing */
    const float *value; /* [keys, width]; DAR_CUBIC: [keys, 3, width]: in-tangent, value, out-tangent */
} dar_channel;

typedef struct dar_animation {
    const char *name;
    double begin, end; /* first and last key of all channels [s] */
    dar_channel *channel;
    size_t channels;
} dar_animation;

/* Looks along -z of its node, y up.  near, far as in the file: what is shown is the rasteriser's choice. */
typedef struct dar_lens {
    const char *name;
    bool orthographic;
    double yfov;       /* [rad], perspective */
    double aspect;     /* width / height; 0: that of the picture */
    double xmag, ymag; /* half the width and height of the view, orthographic */
    double near, far;  /* far 0: infinite */
} dar_lens;

typedef enum dar_alpha { DAR_ALPHA_OPAQUE, DAR_ALPHA_MASK, DAR_ALPHA_BLEND } dar_alpha;
typedef enum dar_wrap { DAR_WRAP_REPEAT, DAR_WRAP_CLAMP, DAR_WRAP_MIRROR } dar_wrap;

#define DAR_GLOSS_UNKNOWN 0.4 /* of surfaces about which nothing is said */

typedef struct dar_material {
    const char *name;
    double color[4]; /* base colour, linear, times the texture's and the vertex's */
    int image;       /* sRGB, or DAR_NONE */
    double gloss;    /* 1 - roughness; 0: matte */
    double metallic; /* 0 to 1 */
    dar_wrap wrap_u, wrap_v;
    bool nearest; /* texels are not blended when the texture is magnified */
    dar_alpha alpha;
    double cutoff; /* of DAR_ALPHA_MASK */
    bool double_sided;
} dar_material;

/* What a loader passed over or mended; for a line of the program's report. */
typedef struct dar_scene_notes {
    size_t points_and_lines;   /* primitives that have no triangles */
    size_t textures;           /* base colour textures in forms that are not read, or not asked for */
    size_t channels;           /* of animations: without a node, or of a property that is not known */
    size_t weights_normalised; /* vertices whose joint weights did not sum to 1 */
    size_t unweighted;         /* vertices whose joint weights are all 0: they follow their first joint */
    size_t normals_made;       /* primitives (of an OBJ sequence: frames) without normals */
} dar_scene_notes;

typedef struct dar_scene {
    dar_arena memory;
    const char *path;
    dar_node *node;
    size_t nodes;
    int *order; /* [nodes] parents before children */
    dar_mesh *mesh;
    size_t meshes;
    dar_skin *skin;
    size_t skins;
    dar_instance *instance;
    size_t instances;
    size_t vertices; /* of all instances */
    size_t weights;  /* of all nodes */
    dar_animation *animation;
    size_t animations;
    dar_lens *camera;
    size_t cameras;
    dar_material *material;
    size_t materials;
    dar_image *image; /* those that no material uses have no texels */
    size_t images;
    dar_scene_notes notes;
} dar_scene;

/* Accepts a zeroed scene. */
void dar_scene_free(dar_scene *s);

/* The animation of that name, or with that number (from 0) if no name is equal; NULL or "": the first, "rest": none.
 * *index is DAR_NONE if there is none.  Fails, with the names that exist, if nothing fits. */
dar_status dar_scene_find_animation(const dar_scene *s, const char *name, int *index, dar_err *e);

/* ---------------------------------------------------------------- for loaders */

/* Fill order and depths from the parents.  Returns a node that is its own ancestor, else DAR_NONE. */
int dar_scene_order(dar_scene *s);

#endif
