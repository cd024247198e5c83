/* pose.h: a scene at one moment: the transform of every node, then every vertex.
 *
 *     dar_pose_init(&p, &scene, arena);
 *     for (each frame) {
 *         DAR_TRY(dar_pose_at(&p, animation, t, e));
 *         dar_pose_vertices(&p, position, normal, false);
 *     }
 *
 * The rest pose is the animation DAR_NONE: nodes and morph weights as the file gives them.
 *
 * Keys: before the first and after the last the value stays; DAR_STEP holds the key before; rotations turn along the
 * shorter arc; DAR_CUBIC is Hermite's spline with tangents times the distance of the keys, rotations made unit
 * afterwards.  Order: morph, then skin or the instance's transform.  A skin's joint matrix is world(joint) times the
 * inverse bind matrix, and the transform of the node that carries the mesh plays no part.
 *
 * Everything is computed in f64 and rounded once to f32.  Same bits for any thread count.
 * Source: glTF 2.0 specification, 3.7.2, 3.7.3, 3.11, appendix C. */
#ifndef DAR_DATA_POSE_H
#define DAR_DATA_POSE_H

#include "data/mesh.h"

typedef struct dar_pose {
    const dar_scene *scene;
    double (*world)[12];  /* [nodes] to world */
    double *weight;       /* [scene->weights] of morph targets; a node's begin at its first_weight */
    double (**joint)[12]; /* [skins] [joints of the skin] rest mesh to world */
    double (*place)[12];  /* [instances] mesh to world, of those without skin */

    /* Since the pose before, by instance; all true at first.  What did not change needs not be drawn again. */
    bool *changed;
    bool *mirrored; /* triangles are clockwise seen from outside */

    /* Of the pose itself. */
    struct dar_pose_piece *piece; /* vertices that one task poses */
    size_t pieces;
    uint32_t *active;                       /* at first_weight of each node: its targets whose weight is not 0 */
    size_t *actives;                        /* [nodes] their number */
    double (*trs)[10];                      /* [nodes] local: translation, rotation, scale */
    double (*last_world)[12], *last_weight; /* of the pose before */
    bool *node_changed, *skin_changed, fresh;
} dar_pose;

/* Memory in `a`.  The pose lives as long as it and the scene.  In a planning arena: counts the bytes. */
void dar_pose_init(dar_pose *p, const dar_scene *s, dar_arena *a);

/* Set the moment: `animation` at t [s], or DAR_NONE.  DAR_ERR_NUMERIC: transforms that cannot be drawn, because a
 * number is not finite or beyond 1e12; the pose is then not to be used until the next one succeeds. */
dar_status dar_pose_at(dar_pose *p, int animation, double t, dar_err *e);

/* Vertices of all instances, or of the changed ones alone, in world space.
 *
 *   position  [scene->vertices, 3] f32
 *   normal    [scene->vertices, 3] f32, unit; (0, 0, 0) where there is none: a triangle without area, a normal that the
 *             file left zero, or a transform without extent.  NULL: not wanted
 *
 * Instance i owns rows from instance[i].vertex on. */
void dar_pose_vertices(const dar_pose *p, float *position, float *normal, bool changed_only);

/* Value of a channel at t: `width` numbers. */
void dar_channel_sample(const dar_channel *c, double t, double *value);

#endif
