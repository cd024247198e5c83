/* dar_bundle.h: the commands of dar-bundle, each in a file of its own, and what two of them are made of. */
#ifndef DAR_DATA_DAR_BUNDLE_H
#define DAR_DATA_DAR_BUNDLE_H

#include "data/bundle.h"
#include "lib/program.h"

extern const dar_program dar_command_render;
extern const dar_program dar_command_check;
extern const dar_program dar_command_show;
extern const dar_program dar_command_convert;
extern const dar_program dar_command_synth;

/* ---------------------------------------------------------------- EXR, for convert */

typedef struct dar_convert {
    const char *cameras;       /* file */
    dar_camera_options camera; /* how it is read */
    bool z_up, overwrite;
} dar_convert;

/* The families of a bundle as files path/00000.exr ..., which appear all at once; path must not be there. */
dar_status dar_convert_to_exr(const char *bundle, const char *path, dar_exr_compression compression, size_t *frames,
                              dar_err *e);

/* A bundle from the EXR files of a directory; their channels as in data/bundle_exr.h, one file per frame. */
dar_status dar_convert_from_exr(const char *directory, const char *path, const dar_convert *c, size_t *frames,
                                dar_err *e);

#endif
