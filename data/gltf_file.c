/* gltf_file.c: the container, the JSON at its top, buffers, and memory that a file cannot exhaust. */
#include "data/gltf_file.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/uri.h"

#define GLB_MAGIC  0x46546c67u
#define CHUNK_JSON 0x4e4f534au
#define CHUNK_BIN  0x004e4942u
#define SLACK      ((size_t)64 << 20)

/* ---------------------------------------------------------------- helpers */

dar_status dar_gltf_check(dar_gltf *g)
{
    return dar_json_finish(g->doc, g->err);
}

int dar_gltf_index(dar_gltf *g, dar_json j, const char *key, dar_gltf_list list)
{
    dar_json x = dar_json_get(j, key);
    if (!x.item) return DAR_NONE;
    if (!g->length[list]) {
        dar_json_reject(j, key, "nothing: there are none");
        return DAR_NONE;
    }
    return (int)dar_json_int(x, NULL, 0, 0, (int64_t)g->length[list] - 1);
}

size_t dar_gltf_size(dar_json j, const char *key, size_t lo, size_t hi)
{
    int64_t most = hi < (size_t)DAR_JSON_MAX_INT ? (int64_t)hi : DAR_JSON_MAX_INT;
    int64_t n = dar_json_int(j, key, DAR_JSON_NEEDED, (int64_t)lo, most);
    return n < (int64_t)lo ? lo : (size_t)n;
}

dar_status dar_gltf_numbers(dar_gltf *g, dar_json j, const char *key, double *x, size_t n)
{
    dar_json_numbers(j, key, x, n);
    DAR_TRY(dar_gltf_check(g));
    for (size_t i = 0; i < n; i++)
        if (!(fabs(x[i]) <= DAR_GLTF_LARGEST))
            return DAR_GLTF_REJECT(g, j, key, "no number beyond %g: the one at %zu is %g", DAR_GLTF_LARGEST, i, x[i]);
    return DAR_OK;
}

dar_json dar_gltf_extension(dar_json j, const char *name)
{
    dar_json all = dar_json_get(j, "extensions");
    return all.item ? dar_json_get(all, name) : all;
}

/* The most that a file of this size may grow to. */
static size_t limit(size_t size)
{
    return size > (SIZE_MAX - SLACK) / DAR_GLTF_GROWTH ? SIZE_MAX : size * DAR_GLTF_GROWTH + SLACK;
}

static dar_status too_much(dar_gltf *g, const char *what)
{
    return dar_fail(g->err, DAR_ERR_FORMAT,
                    "%s: %s more than %d times the file's %zu bytes, expected a file whose "
                    "parts are not shared thousands of times",
                    g->path, what, DAR_GLTF_GROWTH, g->size);
}

dar_status dar_gltf_reserve(dar_gltf *g, size_t pictures)
{
    size_t content = limit(g->size);
    return dar_arena_init(&g->scene->memory, "scene", content > SIZE_MAX - pictures ? SIZE_MAX : content + pictures,
                          g->err);
}

static dar_status push(dar_gltf *g, dar_arena *a, void *out, size_t n, size_t each)
{
    size_t bytes;
    void *p = NULL;
    memcpy(out, &p, sizeof p);
    if (__builtin_mul_overflow(n, each, &bytes) || bytes > a->size - a->used || a->size - a->used - bytes < DAR_ALIGN)
        return too_much(g, "its content takes");
    p = dar_arena_push(a, bytes);
    memcpy(out, &p, sizeof p);
    return DAR_OK;
}

dar_status dar_gltf_take(dar_gltf *g, void *out, size_t n, size_t each)
{
    return push(g, &g->scene->memory, out, n, each); /* never reset while loading, so it is zero */
}

dar_status dar_gltf_scratch(dar_gltf *g, void *out, size_t n, size_t each)
{
    void *p = NULL;
    DAR_TRY(push(g, &g->scratch, &p, n, each));
    memset(p, 0, n * each);
    memcpy(out, &p, sizeof p);
    return DAR_OK;
}

dar_status dar_gltf_spend(dar_gltf *g, size_t n)
{
    size_t left = limit(g->size) - g->spent;
    if (n > left) return too_much(g, "reading it takes");
    g->spent += n;
    return DAR_OK;
}

dar_status dar_gltf_name(dar_gltf *g, dar_json j, const char **name)
{
    const char *text = dar_json_text(j, "name", "");
    char *copy = NULL;
    DAR_TRY(dar_gltf_check(g));
    DAR_TRY(dar_gltf_take(g, &copy, strlen(text) + 1, 1));
    memcpy(copy, text, strlen(text) + 1);
    *name = copy;
    return DAR_OK;
}

/* ---------------------------------------------------------------- bytes from outside the JSON */

static dar_status map_beside(dar_gltf *g, dar_json j, const char *uri, dar_gltf_bytes *out)
{
    char path[PATH_MAX];
    dar_err e;
    const char *expected = dar_uri_path(uri, g->path, path);

    if (expected) return DAR_GLTF_REJECT(g, j, "uri", "%s", expected);
    if (dar_file_map_open(&out->map, path, &e) != DAR_OK)
        return DAR_GLTF_REJECT(g, j, "uri", "a file beside the model (%s)", e.text);
    out->data = out->map.data ? out->map.data : (const unsigned char *)"";
    out->size = out->map.size;
    return DAR_OK;
}

dar_status dar_gltf_uri(dar_gltf *g, dar_json j, dar_gltf_bytes *out)
{
    const char *uri = dar_json_text(j, "uri", NULL);
    unsigned char *bytes = NULL;

    DAR_TRY(dar_gltf_check(g));
    if (!dar_uri_is_data(uri)) return map_beside(g, j, uri, out);
    DAR_TRY(dar_gltf_scratch(g, &bytes, strlen(uri), 1));
    const char *expected = dar_uri_decode(uri, bytes, &out->size);
    if (expected) return DAR_GLTF_REJECT(g, j, "uri", "%s", expected);
    out->data = bytes;
    return DAR_OK;
}

/* Files beside the model come first: their sizes count for what the scene may take. */
static dar_status map_buffers(dar_gltf *g, dar_json buffers)
{
    size_t i = 0, n = dar_json_size(buffers);

    g->buffer = calloc(n ? n : 1, sizeof *g->buffer);
    if (!g->buffer) return dar_fail(g->err, DAR_ERR_NOMEM, "%s: out of memory", g->path);
    g->length[DAR_GLTF_BUFFERS] = n;
    for (dar_json b = dar_json_first(buffers); b.item; b = dar_json_next(b), i++) {
        dar_json uri = dar_json_get(b, "uri");
        if (dar_json_kind_of(uri) != DAR_JSON_TEXT || dar_uri_is_data(dar_json_text(uri, NULL, ""))) continue;
        DAR_TRY(map_beside(g, b, dar_json_text(uri, NULL, ""), &g->buffer[i]));
        if (g->buffer[i].size > SIZE_MAX / 2 - g->size) return too_much(g, "its buffers take");
        g->size += g->buffer[i].size;
    }
    return dar_gltf_check(g);
}

/* The rest of the buffers, and the length that each says it has. */
static dar_status read_buffers(dar_gltf *g)
{
    for (size_t i = 0; i < g->length[DAR_GLTF_BUFFERS]; i++) {
        dar_json j = g->list[DAR_GLTF_BUFFERS][i];
        dar_gltf_bytes *b = &g->buffer[i];
        size_t length = dar_gltf_size(j, "byteLength", 1, SIZE_MAX);
        bool has_uri = dar_json_get(j, "uri").item, placeholder = false;

        DAR_TRY(dar_gltf_check(g));
        if (has_uri && !b->data) {
            DAR_TRY(dar_gltf_uri(g, j, b));
        } else if (!has_uri && i == 0 && g->bin.data) {
            *b = g->bin;
        } else if (!has_uri) {
            placeholder = dar_json_bool(dar_gltf_extension(j, "EXT_meshopt_compression"), "fallback", false);
            if (!placeholder) return DAR_GLTF_REJECT(g, j, "uri", "one, or a .glb with a binary chunk");
        }
        if (!placeholder && length > b->size)
            return DAR_GLTF_REJECT(g, j, "byteLength", "at most the %zu bytes that are there", b->size);
        b->size = length;
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- container */

static uint32_t u32_at(const unsigned char *p)
{
    return (uint32_t)p[0] | (uint32_t)p[1] << 8 | (uint32_t)p[2] << 16 | (uint32_t)p[3] << 24;
}

/* Find the JSON text and g->bin in a .glb. */
static dar_status split_glb(dar_gltf *g, const unsigned char *data, size_t size, dar_gltf_bytes *json)
{
    size_t length = size >= 12 ? u32_at(data + 8) : 0;

    if (size < 12) return dar_fail(g->err, DAR_ERR_FORMAT, "%s: %zu bytes, expected a header of 12", g->path, size);
    if (u32_at(data + 4) != 2)
        return dar_fail(g->err, DAR_ERR_FORMAT, "%s: GLB version %u, expected 2", g->path, u32_at(data + 4));
    if (length < 12 || length > size)
        return dar_fail(g->err, DAR_ERR_FORMAT, "%s: header says %zu bytes, found %zu", g->path, length, size);
    for (size_t at = 12, chunk = 0; at < length; chunk++) {
        size_t n = length - at >= 8 ? u32_at(data + at) : SIZE_MAX;
        uint32_t type = length - at >= 8 ? u32_at(data + at + 4) : 0;
        if (n > length - at - 8)
            return dar_fail(g->err, DAR_ERR_FORMAT, "%s: chunk %zu ends behind the end of the file", g->path, chunk);
        dar_gltf_bytes b = { .data = data + at + 8, .size = n };
        if (chunk == 0 && type == CHUNK_JSON) *json = b;
        else if (chunk == 1 && type == CHUNK_BIN) g->bin = b;
        at += 8 + n;
    }
    if (!json->data) return dar_fail(g->err, DAR_ERR_FORMAT, "%s: first chunk is not JSON", g->path);
    while (json->size && json->data[json->size - 1] == 0) json->size--; /* some writers pad with NUL, not spaces */
    return DAR_OK;
}

static bool is_known(const char *extension)
{
    static const char *const known[] = {
        "EXT_mesh_gpu_instancing",
        "EXT_meshopt_compression",
        "KHR_materials_pbrSpecularGlossiness",
        "KHR_mesh_quantization",
        "KHR_texture_transform",
        /* Nothing that is read here depends on these. */
        "EXT_texture_webp",
        "KHR_lights_punctual",
        "KHR_materials_anisotropy",
        "KHR_materials_clearcoat",
        "KHR_materials_dispersion",
        "KHR_materials_emissive_strength",
        "KHR_materials_ior",
        "KHR_materials_iridescence",
        "KHR_materials_sheen",
        "KHR_materials_specular",
        "KHR_materials_transmission",
        "KHR_materials_unlit",
        "KHR_materials_variants",
        "KHR_materials_volume",
        "KHR_texture_basisu",
        "KHR_xmp_json_ld",
    };
    for (size_t i = 0; i < DAR_COUNT(known); i++)
        if (strcmp(extension, known[i]) == 0) return true;
    return false;
}

static dar_status check_asset(dar_gltf *g, dar_json root)
{
    dar_json asset = dar_json_get(root, "asset"), required = dar_json_array(root, "extensionsRequired");
    const char *version = asset.item ? dar_json_text(asset, "version", NULL) : NULL;

    DAR_TRY(dar_gltf_check(g));
    if (!version || strncmp(version, "2.", 2) != 0)
        return DAR_GLTF_REJECT(g, root, "asset", "an object with version \"2.0\"%s%s", version ? ", not " : "",
                               version ? version : "");
    for (dar_json x = dar_json_first(required); x.item; x = dar_json_next(x)) {
        const char *name = dar_json_text(x, NULL, "");
        DAR_TRY(dar_gltf_check(g));
        if (!is_known(name))
            return DAR_GLTF_REJECT(g, x, NULL,
                                   "an extension that is read (EXT_mesh_gpu_instancing, EXT_meshopt_compression, "
                                   "KHR_mesh_quantization, KHR_texture_transform); Blender can write the file without");
    }
    return DAR_OK;
}

static dar_status list_all(dar_gltf *g, dar_json root)
{
    static const char *const key[DAR_GLTF_LISTS] = {
        [DAR_GLTF_ACCESSORS] = "accessors", [DAR_GLTF_ANIMATIONS] = "animations", [DAR_GLTF_BUFFERS] = "buffers",
        [DAR_GLTF_VIEWS] = "bufferViews",   [DAR_GLTF_CAMERAS] = "cameras",       [DAR_GLTF_IMAGES] = "images",
        [DAR_GLTF_MATERIALS] = "materials", [DAR_GLTF_MESHES] = "meshes",         [DAR_GLTF_NODES] = "nodes",
        [DAR_GLTF_SAMPLERS] = "samplers",   [DAR_GLTF_SCENES] = "scenes",         [DAR_GLTF_SKINS] = "skins",
        [DAR_GLTF_TEXTURES] = "textures",
    };
    for (int k = 0; k < DAR_GLTF_LISTS; k++) {
        dar_json array = dar_json_array(root, key[k]);
        size_t i = 0, n = dar_json_size(array);
        DAR_TRY(dar_gltf_check(g));
        g->length[k] = n;
        DAR_TRY(dar_gltf_scratch(g, &g->list[k], n, sizeof **g->list));
        for (dar_json x = dar_json_first(array); x.item; x = dar_json_next(x)) {
            if (dar_json_kind_of(x) != DAR_JSON_OBJECT) return DAR_GLTF_REJECT(g, x, NULL, "an object");
            g->list[k][i++] = x;
        }
    }
    return DAR_OK;
}

dar_status dar_gltf_open(dar_gltf *g, const char *path, const void *data, size_t size, dar_err *e)
{
    dar_gltf_bytes json = { .data = data, .size = size };

    g->path = path;
    g->err = e;
    g->size = size;
    if (size >= 4 && u32_at(data) == GLB_MAGIC) {
        json.data = NULL;
        DAR_TRY(split_glb(g, data, size, &json));
    }
    DAR_TRY(dar_json_parse(&g->doc, path, (const char *)json.data, json.size, e));
    dar_json root = dar_json_root(g->doc);
    dar_json_accept(root); /* glTF allows keys that nobody knows */
    if (dar_json_kind_of(root) != DAR_JSON_OBJECT) return DAR_GLTF_REJECT(g, root, NULL, "an object");
    DAR_TRY(check_asset(g, root));
    DAR_TRY(map_buffers(g, dar_json_array(root, "buffers")));
    DAR_TRY(dar_arena_init(&g->scratch, "glTF scratch", limit(g->size), e));
    DAR_TRY(list_all(g, root));
    DAR_TRY(read_buffers(g));
    return dar_gltf_views(g);
}

void dar_gltf_close(dar_gltf *g)
{
    for (size_t i = 0; g->buffer && i < g->length[DAR_GLTF_BUFFERS]; i++) dar_file_map_close(&g->buffer[i].map);
    for (size_t i = 0; g->image && i < g->length[DAR_GLTF_IMAGES]; i++) dar_file_map_close(&g->image[i].map);
    free(g->buffer);
    dar_json_close(g->doc);
    dar_arena_free(&g->scratch);
}
