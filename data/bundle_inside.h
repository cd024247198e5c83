/* bundle_inside.h: what the files of the bundle share. */
#ifndef DAR_DATA_BUNDLE_INSIDE_H
#define DAR_DATA_BUNDLE_INSIDE_H

#include "data/bundle.h"
#include "data/h5.h"
#include "lib/json.h"
#include "lib/sha256.h"

/* Members; dar_bundle_files ends with NULL.  */
#define DAR_BUNDLE_META      "meta.json"
#define DAR_BUNDLE_CAMERAS   "cameras.json"
#define DAR_BUNDLE_GBUFFER   "gbuffer.h5"
#define DAR_BUNDLE_RGB       "rgb.h5"
#define DAR_BUNDLE_REFERENCE "reference.png"
#define DAR_BUNDLE_VIDEO     "video.mp4"
#define DAR_BUNDLE_TEXT      "text.safetensors"
#define DAR_BUNDLE_POSES     "cameras.txt"
#define DAR_BUNDLE_NERF      "transforms.json"
#define DAR_BUNDLE_EXR       "exr"
#define DAR_BUNDLE_XY        "sparse_tracking/xy"
#define DAR_BUNDLE_VISIBLE   "sparse_tracking/visible"
#define DAR_BUNDLE_COLOR     "sparse_tracking/color"

#define DAR_BUNDLE_FILES 9
extern const char *const dar_bundle_files[DAR_BUNDLE_FILES + 1];

/* "exr/NNNNN.exr"; returns `name`. */
const char *dar_bundle_exr_name(size_t frame, char name[32]);

/* Whether `name` is a file of a bundle of `frames` frames. */
bool dar_bundle_is_file(const char *name, size_t frames);

/* ---------------------------------------------------------------- how a family is stored */

typedef struct dar_bundle_store {
    bool there, exr; /* exr: in exr/, as values; else in gbuffer.h5 */
    dar_h5_type type;
    double scale[3], offset[3]; /* value = scale[c] n + offset[c] */
} dar_bundle_store;

/* As written here. */
dar_bundle_store dar_bundle_store_of(int family, const dar_world *world, bool world_f32);

/* The dataset [T, H, W], or [T, channels, H, W]. */
dar_h5_array dar_bundle_array(int family, dar_h5_type type, const dar_bundle_meta *m);

/* x [channels, pixels] f32, u8 (mask: 1 is all) or u32, as the family's in a dar_gbuffer, to shuffled bytes: of all
 * numbers the first, then of all the second ...; pixels whose mask is 0 become 0.  False: a value is not finite or
 * outside of what the type holds; then *bad is where, among the channels * pixels. */
bool dar_bundle_encode(int family, const dar_bundle_store *s, const void *x, const uint8_t *mask, size_t pixels,
                       unsigned char *bytes, size_t *bad);

/* Numbers as stored to values; background, where cover is 0, to 0.  cover NULL: there is none. */
void dar_bundle_decode(const dar_plane *p, size_t channels, const uint8_t *cover, size_t pixels, float *y);

/* cover [pixels] of a mask or a depth: 255 where its value is more than 0, else 0. */
void dar_bundle_cover(const dar_plane *p, size_t pixels, uint8_t *cover);

/* ---------------------------------------------------------------- meta.json */

typedef struct dar_bundle_file {
    char name[32];
    uint64_t bytes;
    char sha256[DAR_SHA256_TEXT]; /* "": unknown */
} dar_bundle_file;

typedef struct dar_bundle_contents {
    dar_bundle_meta meta;
    dar_bundle_store store[DAR_BUNDLE_FAMILIES];
    bool rgb, reference, text;
    size_t tracks;
    dar_bundle_file *file; /* [files] */
    size_t files;
} dar_bundle_contents;

/* Texts live as long as the document; tables are the caller's, for dar_bundle_contents_free, also after a failure. */
dar_status dar_bundle_read_meta(dar_bundle_contents *c, dar_json_doc *doc, dar_err *e);
void dar_bundle_contents_free(dar_bundle_contents *c);

void dar_bundle_print_meta(const dar_bundle_contents *c, dar_json_writer *w);

/* dar_bundle_open from the text of meta.json and of cameras.json; `path` stands for the bundle. */
dar_status dar_bundle_parse(dar_bundle **out, const char *path, const char *meta, size_t meta_size, const char *cameras,
                            size_t cameras_size, dar_err *e);

#endif
