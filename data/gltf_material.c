/* gltf_material.c: base colours and the pictures behind them. */
#include "data/gltf_file.h"

#include <math.h>
#include <stdio.h>
#include <string.h>

#define PIXELS_MAX ((size_t)1 << 30) /* of all pictures: 4 GiB */

/* ---------------------------------------------------------------- pictures */

/* The encoded bytes of image i and its size, once. */
static dar_status find_image(dar_gltf *g, int i)
{
    dar_json j = g->list[DAR_GLTF_IMAGES][i];
    dar_gltf_bytes *b = &g->image[i];
    char name[64];
    dar_err e;

    if (b->data) return DAR_OK;
    int view = dar_gltf_index(g, j, "bufferView", DAR_GLTF_VIEWS);
    DAR_TRY(dar_gltf_check(g));
    if (view == DAR_NONE) {
        DAR_TRY(dar_gltf_uri(g, j, b));
    } else {
        b->data = g->view[view].data;
        b->size = g->view[view].size;
        if (!b->data) return DAR_GLTF_REJECT(g, j, "bufferView", "a view with data");
    }
    snprintf(name, sizeof name, "images[%d]", i);
    dar_status s = dar_image_probe(&g->scene->image[i], name, b->data, b->size, &e);
    return s == DAR_OK ? s : dar_fail(g->err, s, "%s: %s", g->path, e.text);
}

static dar_status count_pixels(dar_gltf *g, const dar_image *image, size_t n, size_t *pixels)
{
    *pixels = 0;
    for (size_t i = 0; i < n; i++) {
        *pixels += image[i].width * image[i].height;
        if (*pixels > PIXELS_MAX)
            return dar_fail(g->err, DAR_ERR_FORMAT, "%s: images[%zu]: more than %zu pixels with those before it",
                            g->path, i, PIXELS_MAX);
    }
    return DAR_OK;
}

dar_status dar_gltf_decode_images(dar_gltf *g)
{
    for (size_t i = 0; i < g->scene->images; i++) {
        dar_image *im = &g->scene->image[i];
        char name[64];
        dar_err e;
        if (!im->width) continue;
        DAR_TRY(dar_gltf_take(g, &im->rgba, im->width * im->height, 4));
        snprintf(name, sizeof name, "images[%zu]", i);
        dar_status s = dar_image_decode(im, name, g->image[i].data, g->image[i].size, &e);
        if (s != DAR_OK) return dar_fail(g->err, s, "%s: %s", g->path, e.text);
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- materials */

static dar_wrap wrap_of(dar_gltf *g, dar_json sampler, const char *key)
{
    int64_t mode = dar_json_int(sampler, key, 10497, 0, 65535);
    if (mode == 10497) return DAR_WRAP_REPEAT;
    if (mode == 33071) return DAR_WRAP_CLAMP;
    if (mode != 33648) (void)DAR_GLTF_REJECT(g, sampler, key, "10497, 33071 or 33648");
    return DAR_WRAP_MIRROR;
}

/* uv' = T R S uv, as KHR_texture_transform says. */
static dar_status read_transform(dar_gltf *g, dar_json j, dar_gltf_texture *t)
{
    double offset[2] = { 0, 0 }, scale[2] = { 1, 1 }, angle = 0;
    if (j.item) {
        DAR_TRY(dar_gltf_numbers(g, j, "offset", offset, 2));
        DAR_TRY(dar_gltf_numbers(g, j, "scale", scale, 2));
        angle = dar_json_number(j, "rotation", 0, -DAR_GLTF_LARGEST, DAR_GLTF_LARGEST);
        t->set = (int)dar_json_int(j, "texCoord", t->set, 0, 999);
        DAR_TRY(dar_gltf_check(g));
    }
    const double uv[6] = { cos(angle) * scale[0],  sin(angle) * scale[1], offset[0],
                           -sin(angle) * scale[0], cos(angle) * scale[1], offset[1] };
    memcpy(t->uv, uv, sizeof uv);
    return DAR_OK;
}

static dar_status read_texture(dar_gltf *g, dar_json info, bool images, dar_material *m, dar_gltf_texture *t)
{
    int texture = dar_gltf_index(g, info, "index", DAR_GLTF_TEXTURES);
    DAR_TRY(dar_gltf_check(g));
    if (texture == DAR_NONE) return DAR_GLTF_REJECT(g, info, "index", "the index of a texture");
    dar_json j = g->list[DAR_GLTF_TEXTURES][texture];
    int image = dar_gltf_index(g, j, "source", DAR_GLTF_IMAGES);
    int sampler = dar_gltf_index(g, j, "sampler", DAR_GLTF_SAMPLERS);
    DAR_TRY(dar_gltf_check(g));
    if (image == DAR_NONE || !images) { /* only in a form that some extension brings */
        g->scene->notes.textures++;
        return DAR_OK;
    }
    if (sampler != DAR_NONE) {
        dar_json s = g->list[DAR_GLTF_SAMPLERS][sampler];
        m->wrap_u = wrap_of(g, s, "wrapS");
        m->wrap_v = wrap_of(g, s, "wrapT");
        m->nearest = dar_json_int(s, "magFilter", 9729, 9728, 9729) == 9728;
    }
    t->set = (int)dar_json_int(info, "texCoord", 0, 0, 999);
    DAR_TRY(dar_gltf_check(g));
    DAR_TRY(read_transform(g, dar_gltf_extension(info, "KHR_texture_transform"), t));
    m->image = image;
    return find_image(g, image);
}

static double share(dar_json j, const char *key)
{
    return fmin(fmax(dar_json_number(j, key, 1, -DAR_GLTF_LARGEST, DAR_GLTF_LARGEST), 0), 1);
}

/* Where a texture varies them, factors say little: then as if nothing were known. */
static void read_surface(dar_json j, bool glossy, dar_material *m)
{
    if (dar_json_get(j, glossy ? "specularGlossinessTexture" : "metallicRoughnessTexture").item) {
        m->gloss = DAR_GLOSS_UNKNOWN;
    } else if (glossy) {
        m->gloss = share(j, "glossinessFactor");
    } else {
        m->gloss = 1 - share(j, "roughnessFactor");
        m->metallic = share(j, "metallicFactor");
    }
}

static dar_status read_material(dar_gltf *g, dar_json j, bool images, dar_material *m, dar_gltf_texture *t)
{
    static const char *const modes[] = { "OPAQUE", "MASK", "BLEND", NULL };
    dar_json rough = dar_gltf_extension(j, "KHR_materials_pbrSpecularGlossiness");
    bool glossy = rough.item;

    *m = (dar_material){ .color = { 1, 1, 1, 1 }, .image = DAR_NONE };
    t->set = DAR_NONE;
    if (!glossy) rough = dar_json_get(j, "pbrMetallicRoughness");
    m->alpha = (dar_alpha)dar_json_choice(j, "alphaMode", 0, modes);
    m->cutoff = dar_json_number(j, "alphaCutoff", 0.5, 0, DAR_GLTF_LARGEST);
    m->double_sided = dar_json_bool(j, "doubleSided", false);
    DAR_TRY(dar_gltf_check(g));
    if (!rough.item) return DAR_OK;
    DAR_TRY(dar_gltf_numbers(g, rough, glossy ? "diffuseFactor" : "baseColorFactor", m->color, 4));
    read_surface(rough, glossy, m);
    DAR_TRY(dar_gltf_check(g));
    dar_json info = dar_json_get(rough, glossy ? "diffuseTexture" : "baseColorTexture");
    return info.item ? read_texture(g, info, images, m, t) : dar_gltf_check(g);
}

/* In the scratch arena first: the pictures they name decide how much memory the scene takes. */
dar_status dar_gltf_materials(dar_gltf *g, bool images)
{
    dar_scene *s = g->scene;
    size_t n = g->length[DAR_GLTF_MATERIALS], pictures = g->length[DAR_GLTF_IMAGES], pixels;
    dar_material *material;

    DAR_TRY(dar_gltf_scratch(g, &material, n, sizeof *material));
    DAR_TRY(dar_gltf_scratch(g, &g->texture, n, sizeof *g->texture));
    DAR_TRY(dar_gltf_scratch(g, &g->image, pictures, sizeof *g->image));
    DAR_TRY(dar_gltf_scratch(g, &s->image, pictures, sizeof *s->image));
    for (size_t i = 0; i < n; i++)
        DAR_TRY(read_material(g, g->list[DAR_GLTF_MATERIALS][i], images, &material[i], &g->texture[i]));
    DAR_TRY(count_pixels(g, s->image, pictures, &pixels));
    DAR_TRY(dar_gltf_reserve(g, 4 * pixels));

    const dar_image *found = s->image;
    DAR_TRY(dar_gltf_take(g, &s->material, n, sizeof *material));
    DAR_TRY(dar_gltf_take(g, &s->image, pictures, sizeof *s->image));
    if (n) memcpy(s->material, material, n * sizeof *material);
    if (pictures) memcpy(s->image, found, pictures * sizeof *found);
    s->materials = n;
    s->images = pictures;
    for (size_t i = 0; i < n; i++) DAR_TRY(dar_gltf_name(g, g->list[DAR_GLTF_MATERIALS][i], &s->material[i].name));
    return DAR_OK;
}
