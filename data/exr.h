/* exr.h: OpenEXR scanline files, one plane per channel, through OpenEXR's C core.
 *
 * Written: one part, NONE, ZIP or PXR24.  Read: one part or several, as Blender and others write them, whole images in
 * 16- and 32-bit float or 32-bit integers.  Refused in one line: tiled and deep parts, DWAA and DWAB (the C core of
 * OpenEXR 3.1 has no decoder for them), channels of fewer samples than pixels. */
#ifndef DAR_DATA_EXR_H
#define DAR_DATA_EXR_H

#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"

#define DAR_EXR_MAX_SIDE     16384 /* [px] */
#define DAR_EXR_MAX_CHANNELS 1024

typedef enum dar_exr_type { DAR_EXR_U32, DAR_EXR_F16, DAR_EXR_F32 } dar_exr_type; /* OpenEXR's uint, half, float */

typedef enum dar_exr_compression { DAR_EXR_NONE, DAR_EXR_ZIP, DAR_EXR_PXR24 } dar_exr_compression; /* PXR24: 24 bits */

typedef struct dar_exr_plane {
    const char *name; /* "world_pos.X" */
    dar_exr_type type;
    const void *data; /* [height, width] */
} dar_exr_plane;

typedef struct dar_exr_how {
    dar_exr_compression compression;
    const char *comment; /* attributes "comments", "comments2", ... of at most 255 bytes each; NULL: none */
} dar_exr_how;

/* Replace the file in one moment.  Names must differ. */
dar_status dar_exr_write(const char *path, size_t width, size_t height, const dar_exr_plane *plane, size_t planes,
                         const dar_exr_how *how, dar_err *e);

typedef struct dar_exr dar_exr;

/* Read the headers.  On failure *out is NULL.  `data` must outlive the object; `name` stands for the file. */
dar_status dar_exr_open(dar_exr **out, const char *path, dar_err *e);
dar_status dar_exr_parse(dar_exr **out, const char *name, const void *data, size_t size, dar_err *e);
void dar_exr_close(dar_exr *x); /* accepts NULL */

size_t dar_exr_width(const dar_exr *x); /* of the display window [px] */
size_t dar_exr_height(const dar_exr *x);

/* Channels of all parts, in order; in a file of several parts a name begins with the part's. */
size_t dar_exr_channels(const dar_exr *x);
const char *dar_exr_name(const dar_exr *x, size_t channel);
dar_exr_type dar_exr_type_of(const dar_exr *x, size_t channel);

/* The channel of a pass, "Depth" "Z" or "" "R": a name is split at its last dot, what stands before the last dot of the
 * rest is a layer's name and ignored, capitals are ignored.  An empty pass: only a name without one.  -1: none. */
int dar_exr_find(const dar_exr *x, const char *pass, const char *component);

/* Decode one channel as stored into plane [height, width]; pixels outside the data window are 0. */
dar_status dar_exr_read(dar_exr *x, size_t channel, void *plane, dar_err *e);

#endif
