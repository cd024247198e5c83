/* gltf_file.h: a glTF file while it is being read; for the gltf_*.c files only.
 *
 * Reads of the JSON keep the first failure (lib/json.h); every function here that returns a status passes it on, so a
 * caller that uses values after its DAR_TRY uses good ones. */
#ifndef DAR_DATA_GLTF_FILE_H
#define DAR_DATA_GLTF_FILE_H

#include "data/gltf.h"
#include "lib/file.h"
#include "lib/json.h"

/* The arrays at the top of the file. */
typedef enum dar_gltf_list {
    DAR_GLTF_ACCESSORS,
    DAR_GLTF_ANIMATIONS,
    DAR_GLTF_BUFFERS,
    DAR_GLTF_VIEWS,
    DAR_GLTF_CAMERAS,
    DAR_GLTF_IMAGES,
    DAR_GLTF_MATERIALS,
    DAR_GLTF_MESHES,
    DAR_GLTF_NODES,
    DAR_GLTF_SAMPLERS,
    DAR_GLTF_SCENES,
    DAR_GLTF_SKINS,
    DAR_GLTF_TEXTURES,
    DAR_GLTF_LISTS
} dar_gltf_list;

typedef struct dar_gltf_bytes {
    const unsigned char *data; /* NULL: a placeholder without data */
    size_t size, stride;       /* stride 0: elements follow each other */
    dar_file_map map;          /* of a file beside the model */
} dar_gltf_bytes;

/* How the base colour texture of a material looks at texture coordinates. */
typedef struct dar_gltf_texture {
    int set;      /* TEXCOORD_<set>; DAR_NONE: no texture */
    double uv[6]; /* [2, 3] */
} dar_gltf_texture;

typedef struct dar_gltf {
    dar_scene *scene;
    const char *path;
    dar_err *err;
    dar_json_doc *doc;
    dar_json *list[DAR_GLTF_LISTS];
    size_t length[DAR_GLTF_LISTS];
    dar_gltf_bytes bin;            /* the second chunk of a .glb */
    dar_gltf_bytes *buffer, *view; /* by index */
    dar_gltf_bytes *image;         /* encoded; data NULL: not used */
    dar_gltf_texture *texture;     /* by material */
    bool *scaled;                  /* by node: an animation drives its scale */
    size_t size;                   /* of the file and the buffers beside it [bytes] */
    size_t spent;                  /* numbers read, against loops that files can build by sharing */
    dar_arena scratch;
} dar_gltf;

/* ---------------------------------------------------------------- gltf_file.c */

/* Read the container, the JSON and the buffers, unpack the views.  The caller owes dar_gltf_close. */
dar_status dar_gltf_open(dar_gltf *g, const char *path, const void *data, size_t size, dar_err *e);
void dar_gltf_close(dar_gltf *g);

/* The first failure of any read of the JSON. */
dar_status dar_gltf_check(dar_gltf *g);

/* Refuse what stands at j.key. */
#define DAR_GLTF_REJECT(g, j, key, ...) (dar_json_reject(j, key, __VA_ARGS__), dar_gltf_check(g))

/* An index of `list`; DAR_NONE if it is absent. */
int dar_gltf_index(dar_gltf *g, dar_json j, const char *key, dar_gltf_list list);

/* A size that must be there: lo if it is not. */
size_t dar_gltf_size(dar_json j, const char *key, size_t lo, size_t hi);

/* n numbers into x, which holds the defaults, none larger than DAR_GLTF_LARGEST. */
dar_status dar_gltf_numbers(dar_gltf *g, dar_json j, const char *key, double *x, size_t n);

/* j.extensions.name; item NULL if it is absent. */
dar_json dar_gltf_extension(dar_json j, const char *name);

/* Reserve the scene's memory: what the size of the file allows, and `pictures` bytes. */
dar_status dar_gltf_reserve(dar_gltf *g, size_t pictures);

/* *out: n zeroed pieces of `each` bytes, of the scene or (dar_gltf_scratch) until a reset of the scratch arena; a file
 * that wants more than its size allows is refused. */
dar_status dar_gltf_take(dar_gltf *g, void *out, size_t n, size_t each);
dar_status dar_gltf_scratch(dar_gltf *g, void *out, size_t n, size_t each);

/* Count n numbers as read; refuse a file in which they are far more than it holds. */
dar_status dar_gltf_spend(dar_gltf *g, size_t n);

/* Copy of j.name (or "") in the scene. */
dar_status dar_gltf_name(dar_gltf *g, dar_json j, const char **name);

/* The bytes behind j.uri: decoded into the scratch arena or a file mapped, which the caller closes. */
dar_status dar_gltf_uri(dar_gltf *g, dar_json j, dar_gltf_bytes *out);

/* ---------------------------------------------------------------- gltf_accessor.c */

/* Fill g->view; packed ones are unpacked. */
dar_status dar_gltf_views(dar_gltf *g);

/* Numbers in an accessor. */
typedef struct dar_gltf_accessor {
    dar_json json;
    size_t count, width; /* elements, numbers in one */
    int type;            /* as in the file: 5120 ... 5126 */
    bool normalized;
    dar_gltf_bytes at; /* data NULL: zeros */
    size_t sparse;     /* elements that are replaced */
    dar_gltf_bytes sparse_index, sparse_value;
    int sparse_type;
} dar_gltf_accessor;

/* What a reader can use. */
#define DAR_GLTF_FLOATS     1u
#define DAR_GLTF_NORMALIZED 2u
#define DAR_GLTF_SIGNED     4u /* integers of 8 and 16 bits as they are, of either sign */
#define DAR_GLTF_UNSIGNED   8u
#define DAR_GLTF_UNSIGNED32 16u

/* The accessor at j.key, which must be there, of `lo` to `hi` numbers per element and a type among `types`.  All its
 * elements are within their views afterwards. */
dar_status dar_gltf_accessor_at(dar_gltf *g, dar_json j, const char *key, unsigned types, size_t lo, size_t hi,
                                dar_gltf_accessor *a);

/* Elements at[0 .. n) (at NULL: the first n) into out [n, width].  Refuses NaN, infinity and numbers beyond
 * DAR_GLTF_LARGEST. */
dar_status dar_gltf_gather(dar_gltf *g, const dar_gltf_accessor *a, const uint32_t *at, size_t n, float *out);

/* All elements, of an integer type, into out [count, width]. */
dar_status dar_gltf_gather_u32(dar_gltf *g, const dar_gltf_accessor *a, uint32_t *out);

/* ---------------------------------------------------------------- the parts of the scene, in this order */

dar_status dar_gltf_materials(dar_gltf *g, bool images); /* gltf_material.c; images are found, not decoded */
dar_status dar_gltf_decode_images(dar_gltf *g);
dar_status dar_gltf_meshes(dar_gltf *g); /* gltf_mesh.c */
dar_status dar_gltf_skins(dar_gltf *g);  /* gltf_anim.c */
dar_status dar_gltf_animations(dar_gltf *g);

#endif
