/* gltf.c: nodes, cameras, instances; the order in which a file is read. */
#include "data/gltf.h"

#include <math.h>
#include <string.h>

#include "data/affine.h"
#include "data/gltf_file.h"

/* ---------------------------------------------------------------- nodes */

static dar_status read_matrix(dar_gltf *g, dar_json j, dar_node *n)
{
    double x[16] = { NAN };
    DAR_TRY(dar_gltf_numbers(g, j, "matrix", x, 16));
    if (x[3] != 0 || x[7] != 0 || x[11] != 0 || x[15] != 1)
        return DAR_GLTF_REJECT(g, j, "matrix", "a last row 0 0 0 1 (every fourth number)");
    for (int r = 0; r < 3; r++)
        for (int c = 0; c < 4; c++) n->matrix[4 * r + c] = x[4 * c + r];
    n->has_matrix = true;
    return DAR_OK;
}

static dar_status read_transform(dar_gltf *g, dar_json j, dar_node *n)
{
    n->rotation[3] = n->scale[0] = n->scale[1] = n->scale[2] = 1;
    memcpy(n->matrix, dar_affine_identity, sizeof n->matrix);
    if (dar_json_get(j, "matrix").item) return read_matrix(g, j, n);
    DAR_TRY(dar_gltf_numbers(g, j, "translation", n->translation, 3));
    DAR_TRY(dar_gltf_numbers(g, j, "rotation", n->rotation, 4));
    DAR_TRY(dar_gltf_numbers(g, j, "scale", n->scale, 3));
    return dar_quat_unit(n->rotation) ? DAR_OK : DAR_GLTF_REJECT(g, j, "rotation", "a quaternion that is not 0");
}

/* The node's morph weights: its own, or the mesh's. */
static dar_status read_weights(dar_gltf *g, dar_json j, dar_node *n)
{
    dar_scene *s = g->scene;
    const dar_mesh *m = n->mesh == DAR_NONE ? NULL : &s->mesh[n->mesh];
    double *weight;

    if (!m || !m->targets) return DAR_OK;
    n->first_weight = s->weights;
    s->weights += m->targets;
    n->weight = m->target_weight;
    if (!dar_json_get(j, "weights").item) return DAR_OK;
    DAR_TRY(dar_gltf_take(g, &weight, m->targets, sizeof *weight));
    DAR_TRY(dar_gltf_numbers(g, j, "weights", weight, m->targets));
    n->weight = weight;
    return DAR_OK;
}

static dar_status read_children(dar_gltf *g, dar_json j, int parent)
{
    for (dar_json x = dar_json_first(dar_json_get(j, "children")); x.item; x = dar_json_next(x)) {
        int child = dar_gltf_index(g, x, NULL, DAR_GLTF_NODES);
        DAR_TRY(dar_gltf_check(g));
        if (child == DAR_NONE || g->scene->node[child].parent != DAR_NONE)
            return DAR_GLTF_REJECT(g, x, NULL, "a node that has no other parent");
        g->scene->node[child].parent = parent;
    }
    return dar_gltf_check(g);
}

static dar_status read_nodes(dar_gltf *g)
{
    dar_scene *s = g->scene;

    s->nodes = g->length[DAR_GLTF_NODES];
    DAR_TRY(dar_gltf_take(g, &s->node, s->nodes, sizeof *s->node));
    DAR_TRY(dar_gltf_take(g, &s->order, s->nodes, sizeof *s->order));
    DAR_TRY(dar_gltf_scratch(g, &g->scaled, s->nodes, sizeof *g->scaled));
    for (size_t i = 0; i < s->nodes; i++) s->node[i].parent = DAR_NONE;
    for (size_t i = 0; i < s->nodes; i++) {
        dar_json j = g->list[DAR_GLTF_NODES][i];
        dar_node *n = &s->node[i];
        DAR_TRY(dar_gltf_name(g, j, &n->name));
        n->mesh = dar_gltf_index(g, j, "mesh", DAR_GLTF_MESHES);
        n->skin = dar_gltf_index(g, j, "skin", DAR_GLTF_SKINS);
        n->camera = dar_gltf_index(g, j, "camera", DAR_GLTF_CAMERAS);
        DAR_TRY(dar_gltf_check(g));
        DAR_TRY(read_transform(g, j, n));
        DAR_TRY(read_weights(g, j, n));
        DAR_TRY(read_children(g, j, (int)i));
    }
    int circle = dar_scene_order(s);
    if (circle == DAR_NONE) return DAR_OK;
    return DAR_GLTF_REJECT(g, g->list[DAR_GLTF_NODES][circle], "children", "a tree: node %d is its own ancestor",
                           circle);
}

/* Which nodes are below the roots of the scene that is shown. */
static dar_status mark_scene(dar_gltf *g)
{
    dar_scene *s = g->scene;
    size_t scenes = g->length[DAR_GLTF_SCENES];
    int shown = dar_gltf_index(g, dar_json_root(g->doc), "scene", DAR_GLTF_SCENES);

    DAR_TRY(dar_gltf_check(g));
    if (shown == DAR_NONE && scenes) shown = 0;
    dar_json roots = shown == DAR_NONE ? (dar_json){ 0 } : dar_json_array(g->list[DAR_GLTF_SCENES][shown], "nodes");
    for (dar_json x = dar_json_first(roots); x.item; x = dar_json_next(x)) {
        int root = dar_gltf_index(g, x, NULL, DAR_GLTF_NODES);
        DAR_TRY(dar_gltf_check(g));
        if (root == DAR_NONE) return DAR_GLTF_REJECT(g, x, NULL, "the index of a node");
        s->node[root].in_scene = true;
    }
    for (size_t i = 0; i < s->nodes; i++) {
        dar_node *n = &s->node[s->order[i]];
        if (n->parent == DAR_NONE) n->in_scene |= shown == DAR_NONE;
        else n->in_scene |= s->node[n->parent].in_scene;
    }
    return dar_gltf_check(g);
}

/* ---------------------------------------------------------------- cameras */

static dar_status read_camera(dar_gltf *g, dar_json j, dar_lens *c)
{
    static const char *const types[] = { "perspective", "orthographic", NULL };
    const double most = DAR_GLTF_LARGEST;
    int type = dar_json_choice(j, "type", -1, types);

    DAR_TRY(dar_gltf_name(g, j, &c->name));
    dar_json p = dar_json_get(j, types[type]);
    if (!p.item) return DAR_GLTF_REJECT(g, j, types[type], "an object");
    c->orthographic = type == 1;
    if (c->orthographic) {
        c->xmag = dar_json_number(p, "xmag", NAN, 1e-9, most);
        c->ymag = dar_json_number(p, "ymag", NAN, 1e-9, most);
        c->near = dar_json_number(p, "znear", NAN, 0, most);
        c->far = dar_json_number(p, "zfar", NAN, 0, most);
    } else {
        c->yfov = dar_json_number(p, "yfov", NAN, 1e-6, 3.14159);
        c->aspect = dar_json_number(p, "aspectRatio", 0, 0, most);
        c->near = dar_json_number(p, "znear", NAN, 0, most);
        c->far = dar_json_number(p, "zfar", 0, 0, most);
    }
    DAR_TRY(dar_gltf_check(g));
    if (c->far != 0 && c->far <= c->near) return DAR_GLTF_REJECT(g, p, "zfar", "more than znear, %g", c->near);
    return DAR_OK;
}

static dar_status read_cameras(dar_gltf *g)
{
    dar_scene *s = g->scene;

    s->cameras = g->length[DAR_GLTF_CAMERAS];
    DAR_TRY(dar_gltf_take(g, &s->camera, s->cameras, sizeof *s->camera));
    for (size_t i = 0; i < s->cameras; i++) DAR_TRY(read_camera(g, g->list[DAR_GLTF_CAMERAS][i], &s->camera[i]));
    return DAR_OK;
}

/* ---------------------------------------------------------------- instances */

/* World matrices at rest: finite, of numbers that fit, and not flat above a mesh that they place. */
static dar_status check_rest(dar_gltf *g, double (*world)[12])
{
    dar_scene *s = g->scene;
    for (size_t i = 0; i < s->nodes; i++) {
        int at = s->order[i];
        dar_node *n = &s->node[at];
        if (n->has_matrix) memcpy(world[at], n->matrix, sizeof world[at]);
        else dar_affine_trs(n->translation, n->rotation, n->scale, world[at]);
        if (n->parent != DAR_NONE) dar_affine_mul(world[n->parent], world[at], world[at]);
        for (int k = 0; k < 12; k++)
            if (!(fabs(world[at][k]) <= DAR_GLTF_LARGEST))
                return DAR_GLTF_REJECT(g, g->list[DAR_GLTF_NODES][at], NULL,
                                       "transforms that stay below %g: with those above it one number is %g",
                                       DAR_GLTF_LARGEST, world[at][k]);
    }
    return DAR_OK;
}

static bool is_flat(const dar_node *n)
{
    return n->has_matrix ? dar_affine_det(n->matrix) == 0 : n->scale[0] == 0 || n->scale[1] == 0 || n->scale[2] == 0;
}

/* A mesh without extent at rest has no surface to tell places on it apart; an animation may open it up. */
static dar_status check_scale(dar_gltf *g, int node)
{
    for (int n = node; n != DAR_NONE; n = g->scene->node[n].parent) {
        const dar_node *p = &g->scene->node[n];
        if (is_flat(p) && !g->scaled[n])
            return DAR_GLTF_REJECT(g, g->list[DAR_GLTF_NODES][n], p->has_matrix ? "matrix" : "scale",
                                   "one that is not zero: nodes[%d] has a mesh", node);
    }
    return DAR_OK;
}

static dar_status check_skin(dar_gltf *g, int node)
{
    const dar_node *n = &g->scene->node[node];
    const dar_mesh *m = &g->scene->mesh[n->mesh];
    size_t joints = g->scene->skin[n->skin].joints;
    dar_json j = g->list[DAR_GLTF_NODES][node];

    if (!m->influences) return DAR_GLTF_REJECT(g, j, "skin", "none, or JOINTS_0 in meshes[%d]", n->mesh);
    if (m->joints > joints)
        return DAR_GLTF_REJECT(g, j, "skin", "one of more than %zu joints: meshes[%d] uses joint %zu", joints, n->mesh,
                               m->joints - 1);
    return DAR_OK;
}

/* Whether a node shows a mesh. */
static bool shows(const dar_scene *s, const dar_node *n)
{
    return n->in_scene && n->mesh != DAR_NONE && s->mesh[n->mesh].triangles;
}

/* Attributes of EXT_mesh_gpu_instancing: translation, rotation, scale. */
struct copies {
    dar_gltf_accessor at[3];
    bool has[3];
    size_t count; /* 0: the extension is not used */
};

static dar_status read_copies(dar_gltf *g, int node, struct copies *c)
{
    static const char *const keys[3] = { "TRANSLATION", "ROTATION", "SCALE" };
    static const size_t widths[3] = { 3, 4, 3 };
    dar_json j = g->list[DAR_GLTF_NODES][node], ext = dar_gltf_extension(j, "EXT_mesh_gpu_instancing");

    *c = (struct copies){ 0 };
    if (!ext.item) return dar_gltf_check(g);
    if (g->scene->node[node].skin != DAR_NONE) return DAR_GLTF_REJECT(g, j, "skin", "none on a node that is instanced");
    dar_json attributes = dar_json_object(ext, "attributes");
    for (int k = 0; k < 3; k++) {
        c->has[k] = dar_json_get(attributes, keys[k]).item;
        if (!c->has[k]) continue;
        unsigned types = DAR_GLTF_FLOATS | (k == 1 ? DAR_GLTF_NORMALIZED : 0);
        DAR_TRY(dar_gltf_accessor_at(g, attributes, keys[k], types, widths[k], widths[k], &c->at[k]));
        if (c->count && c->at[k].count != c->count)
            return DAR_GLTF_REJECT(g, c->at[k].json, "count", "%zu, as the other attributes have", c->count);
        c->count = c->at[k].count;
    }
    return dar_gltf_check(g);
}

static dar_status copy_matrix(dar_gltf *g, const struct copies *c, uint32_t i, double m[12])
{
    double trs[3][4] = { { 0 }, { 0, 0, 0, 1 }, { 1, 1, 1 } };
    for (int k = 0; k < 3; k++) {
        float x[4];
        if (!c->has[k]) continue;
        DAR_TRY(dar_gltf_gather(g, &c->at[k], &i, 1, x));
        for (size_t w = 0; w < c->at[k].width; w++) trs[k][w] = x[w];
    }
    if (!dar_quat_unit(trs[1]))
        return DAR_GLTF_REJECT(g, c->at[1].json, NULL, "quaternions that are not 0: the one at %u is", i);
    if (trs[2][0] == 0 || trs[2][1] == 0 || trs[2][2] == 0)
        return DAR_GLTF_REJECT(g, c->at[2].json, NULL, "scales that are not 0: the one at %u is", i);
    dar_affine_trs(trs[0], trs[1], trs[2], m);
    return DAR_OK;
}

static dar_status add_instances(dar_gltf *g, int node)
{
    dar_scene *s = g->scene;
    const dar_node *n = &s->node[node];
    struct copies copies;

    if (n->skin == DAR_NONE) DAR_TRY(check_scale(g, node));
    else DAR_TRY(check_skin(g, node));
    DAR_TRY(read_copies(g, node, &copies));
    for (uint32_t i = 0; i < (copies.count ? copies.count : 1); i++) {
        dar_instance *in = &s->instance[s->instances++];
        *in = (dar_instance){ .node = node, .mesh = n->mesh, .skin = n->skin, .vertex = s->vertices };
        in->has_local = copies.count > 0;
        if (in->has_local) DAR_TRY(copy_matrix(g, &copies, i, in->local));
        s->vertices += s->mesh[n->mesh].vertices;
        if (s->vertices > UINT32_MAX)
            return DAR_GLTF_REJECT(g, g->list[DAR_GLTF_NODES][node], "mesh",
                                   "fewer than 2^32 vertices in all instances");
    }
    return DAR_OK;
}

static dar_status make_instances(dar_gltf *g)
{
    dar_scene *s = g->scene;
    size_t n = 0;

    for (size_t i = 0; i < s->nodes; i++) {
        struct copies copies;
        if (!shows(s, &s->node[i])) continue;
        DAR_TRY(read_copies(g, (int)i, &copies));
        n += copies.count ? copies.count : 1;
    }
    DAR_TRY(dar_gltf_take(g, &s->instance, n, sizeof *s->instance));
    for (size_t i = 0; i < s->nodes; i++)
        if (shows(s, &s->node[i])) DAR_TRY(add_instances(g, (int)i));
    return DAR_OK;
}

/* ---------------------------------------------------------------- */

static dar_status read_scene(dar_gltf *g, bool images)
{
    dar_scene *s = g->scene;
    double(*world)[12];
    char *path;

    DAR_TRY(dar_gltf_materials(g, images)); /* reserves the scene's memory */
    DAR_TRY(dar_gltf_take(g, &path, strlen(g->path) + 1, 1));
    memcpy(path, g->path, strlen(g->path) + 1);
    s->path = path;
    DAR_TRY(dar_gltf_meshes(g));
    DAR_TRY(read_nodes(g));
    DAR_TRY(mark_scene(g));
    DAR_TRY(dar_gltf_skins(g));
    DAR_TRY(dar_gltf_animations(g));
    DAR_TRY(read_cameras(g));
    DAR_TRY(dar_gltf_scratch(g, &world, s->nodes, sizeof *world));
    DAR_TRY(check_rest(g, world));
    DAR_TRY(make_instances(g));
    DAR_TRY(dar_gltf_decode_images(g));
    return dar_gltf_check(g);
}

dar_status dar_gltf_parse(dar_scene *s, const char *path, const void *data, size_t size, bool images, dar_err *e)
{
    dar_gltf g = { .scene = s };

    *s = (dar_scene){ 0 };
    dar_status status = dar_gltf_open(&g, path, data, size, e);
    if (status == DAR_OK) status = read_scene(&g, images);
    dar_gltf_close(&g);
    if (status != DAR_OK) dar_scene_free(s);
    return status;
}

dar_status dar_gltf_load(dar_scene *s, const char *path, bool images, dar_err *e)
{
    dar_file_map map;

    *s = (dar_scene){ 0 };
    DAR_TRY(dar_file_map_open(&map, path, e));
    dar_status status = dar_gltf_parse(s, path, map.data ? map.data : (const unsigned char *)"", map.size, images, e);
    dar_file_map_close(&map);
    return status;
}
