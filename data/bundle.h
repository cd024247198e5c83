/* bundle.h: a clip on disk: what the network is told about a scene, and the pictures it is compared with.
 *
 *   NAME/
 *     meta.json         "dar-bundle/1": the table below, ranges, origin, size and sha256 of the other files
 *     cameras.json      data/camera_io.h
 *     gbuffer.h5        families, the table below; one chunk is one frame of one family
 *     rgb.h5            rgb u8 [T, H, W, 3], display values, exact                     optional
 *     reference.png     [H, W] RGB; with rgb.h5 its frame 0                            optional
 *     video.mp4         rgb for people; even sides only                                with rgb.h5
 *     text.safetensors  embedding of the prompt                                        optional
 *     exr/NNNNN.exr     families in f32 for other programs (data/bundle_exr.h)         optional
 *     cameras.txt       the cameras for VideoX-Fun        } for other programs,
 *     transforms.json   the cameras for Blender and NeRF  } never read
 *
 *   family    dataset              written                    value
 *   tracking  tracking             u16 [T, 3, H, W]           n / 65535
 *   world     world_pos            u16 [T, 3, H, W], or f32   scale[c] n + offset[c] in the unit of the scene
 *   normal    normal               i16 [T, 3, H, W]           n / 32767, in the world
 *   depth     depth                f32 [T, H, W]              along the camera's z
 *   mask      mask                 u8  [T, H, W]              n / 255
 *   sparse    sparse_tracking/map  u8  [T, 3, H, W]           n / 255
 *   id        id                   u32 [T, H, W]              number of the instance + 1
 *   part      part                 u32 [T, H, W]              number of the part in the scene + 1
 *
 * and the tracks sparse_tracking/xy f32 [N, T, 2] [px], visible u8 [N, T], color u8 [N, 3].  Background is 0 in every
 * family.  u16 world positions are off by at most 1 / 131070 of world.size (7.7e-6 of the scene's longest side), and
 * their n = 65535 q with the q of data/world.h; datasets of u8, u16, i16 carry attributes scale and offset.
 *
 * Bundles of other tools: meta.json needs format, width, height, frames, fps and families, which is an object of
 * "name": { "type", "file", "scale", "offset" }: type u8, u16, i16 or f32, u32 for id and part; file "gbuffer.h5" or
 * "exr", whose families are f32, the mask u8; scale and offset per channel, of integers, with the above as defaults but
 * for world and depth.  Without a mask, what has a depth is covered.  A key that is not known is refused; "extra" may
 * hold anything.
 *
 * A bundle appears whole or not at all: it is written into a directory of another name beside it.  What a writer that
 * died left there is removed by the next writer of the same bundle. */
#ifndef DAR_DATA_BUNDLE_H
#define DAR_DATA_BUNDLE_H

#include <limits.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "data/camera.h"
#include "data/camera_io.h"
#include "data/condition.h"
#include "data/exr.h"
#include "data/raster.h"
#include "data/trajectory.h"
#include "data/world.h"
#include "lib/sha256.h"
#include "lib/status.h"

#define DAR_BUNDLE_FORMAT     "dar-bundle/1"
#define DAR_BUNDLE_MAX_SIDE   16384 /* [px] */
#define DAR_BUNDLE_MAX_FRAMES DAR_CAMERA_IO_MAX_FRAMES
#define DAR_BUNDLE_MAX_SEED   DAR_JSON_MAX_INT

/* The families of data/condition.h and two that are numbers. */
typedef enum dar_bundle_family { DAR_BUNDLE_ID = DAR_FAMILIES, DAR_BUNDLE_PART, DAR_BUNDLE_FAMILIES } dar_bundle_family;

typedef struct dar_bundle_family_info {
    const char *name, *dataset;
    size_t channels;
} dar_bundle_family_info;

extern const dar_bundle_family_info dar_bundle_table[DAR_BUNDLE_FAMILIES];

typedef struct dar_bundle_object {
    const char *name; /* of the instance whose id is its place + 1 */
    size_t parts;
} dar_bundle_object;

/* What meta.json says.  Texts are NULL where there is nothing to say. */
typedef struct dar_bundle_meta {
    size_t frames;
    int width, height; /* [px] */
    double fps;

    bool z_up;          /* else y */
    double unit;        /* [m]; 0: unknown */
    dar_world world;    /* bounds over the clip, centre, size; size 0: unknown */
    const dar_box *box; /* [boxes] of everything visible, frame by frame */
    size_t boxes;       /* frames, or 0: unknown */
    double depth[2];    /* nearest and farthest over the clip; NAN: unknown; writing: found by the writer */
    const dar_bundle_object *object;
    size_t objects;

    const char *source, *source_sha256, *licence, *animation; /* the file that was rendered */
    const char *generator;                                    /* program and version */
    const char *trajectory, *prompt;
    uint64_t seed; /* up to DAR_BUNDLE_MAX_SEED */
} dar_bundle_meta;

/* ---------------------------------------------------------------- reading
 *
 *     DAR_TRY(dar_bundle_open(&b, path, e));
 *     DAR_TRY(dar_bundle_source(b, &condition, &source, e));
 *     DAR_TRY(dar_condition_build(&condition, &source, scratch, tensor, e));
 *     dar_bundle_close(b);
 *
 * Opening reads meta.json and cameras.json alone; a dataset is opened and checked when its family is first asked for.
 * One thread at a time. */
typedef struct dar_bundle {
    dar_bundle_meta meta;
    dar_camera_path cameras;
    unsigned families; /* bit 1 << family */
    bool rgb, reference, text;
    size_t tracks; /* N; 0: none */

    /* Of the reader itself. */
    struct dar_bundle_inside *in;
} dar_bundle;

/* On failure *out is NULL. */
dar_status dar_bundle_open(dar_bundle **out, const char *path, dar_err *e);
void dar_bundle_close(dar_bundle *b); /* accepts NULL */

bool dar_bundle_has(const dar_bundle *b, int family);

/* Fails, with the families that are there, if one is not. */
dar_status dar_bundle_need(const dar_bundle *b, int family, dar_err *e);

/* One family of one frame as it is stored; plane->data is valid until the next call.  Not for id and part. */
dar_status dar_bundle_plane(dar_bundle *b, dar_family family, size_t frame, dar_plane *plane, dar_err *e);

/* The same as values, y [channels, H, W]. */
dar_status dar_bundle_values(dar_bundle *b, dar_family family, size_t frame, float *y, dar_err *e);

/* DAR_BUNDLE_ID or DAR_BUNDLE_PART, y [H, W]. */
dar_status dar_bundle_numbers(dar_bundle *b, dar_bundle_family family, size_t frame, uint32_t *y, dar_err *e);

/* Frame of rgb.h5, and reference.png: rgb [H, W, 3]. */
dar_status dar_bundle_rgb(dar_bundle *b, size_t frame, uint8_t *rgb, dar_err *e);
dar_status dar_bundle_reference(dar_bundle *b, uint8_t *rgb, dar_err *e);

/* xy [tracks, frames, 2], visible [tracks, frames], color [tracks, 3]; NULL: not wanted. */
dar_status dar_bundle_tracks(dar_bundle *b, float *xy, uint8_t *visible, uint8_t *color, dar_err *e);

/* Path of a member of the bundle: "text.safetensors". */
const char *dar_bundle_path(const dar_bundle *b, const char *member, char path[PATH_MAX]);

/* sha256 of a file of the bundle as meta.json has it; else computed. */
dar_status dar_bundle_sum(const dar_bundle *b, const char *member, char sum[DAR_SHA256_TEXT], dar_err *e);

/* What dar_condition_build wants of this bundle; checks that all that `c` needs is there.  Lives as long as b. */
dar_status dar_bundle_source(dar_bundle *b, const dar_condition *c, dar_condition_source *s, dar_err *e);

/* Size and sha256 of every file that meta.json names. */
dar_status dar_bundle_verify(dar_bundle *b, dar_err *e);

/* ---------------------------------------------------------------- writing
 *
 *     dar_bundle_options o = dar_bundle_standard();
 *     DAR_TRY(dar_bundle_create(&w, path, &meta, &cameras, &o, e));
 *     for (each frame) DAR_TRY(dar_bundle_add(w, &frame, e));
 *     DAR_TRY(dar_bundle_commit(w, e));
 *     dar_bundle_discard(w);                       whatever happened
 */
typedef struct dar_bundle_options {
    unsigned families; /* bit 1 << family; the mask is always written */
    bool rgb;          /* every frame has a picture */
    bool world_f32;
    bool exports;   /* cameras.txt and transforms.json */
    bool overwrite; /* replace a bundle of this name */
    bool exr;       /* write exr/ too */
    dar_exr_compression compression;
} dar_bundle_options;

dar_bundle_options dar_bundle_standard(void); /* all families but sparse, no rgb, u16, exports, no exr */

typedef struct dar_bundle_frame {
    dar_gbuffer g;         /* those of the families, and the mask */
    const uint8_t *sparse; /* [3, H, W] map of tracks */
    const uint8_t *rgb;    /* [H, W, 3] */
    bool copied;           /* g and sparse equal the frame before: they are looked at for EXR files alone */
} dar_bundle_frame;

typedef enum dar_bundle_stage {
    DAR_BUNDLE_ENCODE,   /* values to numbers */
    DAR_BUNDLE_DEFLATE,  /* numbers to chunks */
    DAR_BUNDLE_WRITE,    /* chunks to HDF5 */
    DAR_BUNDLE_PICTURES, /* rgb to PNG and video, EXR files */
    DAR_BUNDLE_FINISH,   /* flush, sha256, rename */
    DAR_BUNDLE_STAGES
} dar_bundle_stage;

/* Sums so far. */
typedef struct dar_bundle_stats {
    size_t frames, copied, chunks, empty; /* empty: chunks of zeros, not written */
    uint64_t bytes;                       /* of chunks */
    double seconds[DAR_BUNDLE_STAGES];
} dar_bundle_stats;

typedef struct dar_bundle_writer dar_bundle_writer;

/* Everything that meta points to must live until the writer ends.  Frames, width and height are those of the cameras.
 * Fails if `path` is there, unless it is a bundle and may be overwritten.  On failure *out is NULL. */
dar_status dar_bundle_create(dar_bundle_writer **out, const char *path, const dar_bundle_meta *meta,
                             const dar_camera_path *cameras, const dar_bundle_options *o, dar_err *e);

/* The next frame.  DAR_ERR_NUMERIC: a value is not finite, or outside of what its family holds. */
dar_status dar_bundle_add(dar_bundle_writer *w, const dar_bundle_frame *frame, dar_err *e);

/* Once, before commit: as dar_bundle_tracks gives them. */
dar_status dar_bundle_add_tracks(dar_bundle_writer *w, size_t tracks, const float *xy, const uint8_t *visible,
                                 const uint8_t *color, dar_err *e);

/* A reference of a bundle without rgb; a copy of a file as text.safetensors. */
dar_status dar_bundle_add_reference(dar_bundle_writer *w, const uint8_t *rgb, dar_err *e);
dar_status dar_bundle_add_text(dar_bundle_writer *w, const char *path, dar_err *e);

const dar_bundle_stats *dar_bundle_written(const dar_bundle_writer *w);

/* All frames are there: finish the files, flush, rename.  The caller still owes dar_bundle_discard. */
dar_status dar_bundle_commit(dar_bundle_writer *w, dar_err *e);

/* Accepts NULL.  What was not committed is removed. */
void dar_bundle_discard(dar_bundle_writer *w);

/* Set "qc" in the meta.json of a bundle to a JSON value: results of quality control, free in form. */
dar_status dar_bundle_set_quality(const char *path, const char *json, dar_err *e);

#endif
