/* gltf.h: glTF 2.0 files, .gltf and .glb, as scenes (data/mesh.h).
 *
 * Read: node animation, skins with any number of joint sets, morph targets, sparse accessors, integer attributes, data
 * URIs, files beside the model, triangles, strips and fans, base colour with its texture, cameras, and of extensions
 * KHR_mesh_quantization, EXT_meshopt_compression, KHR_texture_transform, EXT_mesh_gpu_instancing,
 * KHR_materials_pbrSpecularGlossiness (its diffuse part stands for the base colour).
 *
 * Not read, because nothing here depends on it: the rest of materials, tangents, lights.  An extension that is required
 * and not known is refused by name.
 *
 * Where the file leaves a choice, or breaks a rule in a way that many files do: the scene shown is `scene`, or the
 * first, or all roots; vertices that no triangle uses are left out; joint weights are scaled to sum 1; a primitive
 * without normals gets those of its triangles, its vertices split, as the specification asks.
 *
 * Everything else that breaks a rule is refused with one line: the file, the place in its JSON, what was found, what
 * was expected.  So are numbers beyond DAR_GLTF_LARGEST, and files whose content would take more than DAR_GLTF_GROWTH
 * times their size (pictures apart) plus 64 MiB.
 *
 * Source: glTF 2.0 specification, Khronos, version 2.0.1. */
#ifndef DAR_DATA_GLTF_H
#define DAR_DATA_GLTF_H

#include "data/mesh.h"

#define DAR_GLTF_LARGEST 1e12 /* coordinates, matrix elements, times: products of three still fit in f32 */
#define DAR_GLTF_GROWTH  64

/* Load.  images false: textures are passed over (and counted), their files not even looked for.  The caller owes one
 * dar_scene_free, also after a failure. */
dar_status dar_gltf_load(dar_scene *s, const char *path, bool images, dar_err *e);

/* The same from memory, which may be released afterwards; `path` stands for the file in messages and files beside it
 * are looked for there. */
dar_status dar_gltf_parse(dar_scene *s, const char *path, const void *data, size_t size, bool images, dar_err *e);

#endif
