/* video.h: video files through the programs ffmpeg and ffprobe, run as child processes.
 *
 * Nothing of FFmpeg is linked: what it may do, and under which licence, stays its own affair.  Frames are RGB, 8 bits,
 * [height, width, 3], display values, top row first.  The last line that a child prints to its standard error ends the
 * message of a failure. */
#ifndef DAR_DATA_VIDEO_H
#define DAR_DATA_VIDEO_H

#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"

#define DAR_VIDEO_MAX_SIDE 16384 /* [px] */

typedef enum dar_video_codec {
    DAR_VIDEO_H264,    /* .mp4, yuv420p, bt709, crf 18: for people; even sides only */
    DAR_VIDEO_SMALL,   /* the same with crf 30, for pages that hold many */
    DAR_VIDEO_FFV1,    /* .mkv, exact */
    DAR_VIDEO_X264RGB, /* .mkv, exact */
    DAR_VIDEO_CODECS
} dar_video_codec;

typedef struct dar_video dar_video;

typedef struct dar_video_how {
    double fps;
    dar_video_codec codec;
    int coarser;         /* added to crf; 6 halve the size, about */
    const char *comment; /* of the file; NULL: none */
} dar_video_how;

/* Start writing under a temporary name.  On failure *out is NULL. */
dar_status dar_video_create(dar_video **out, const char *path, size_t width, size_t height, const dar_video_how *how,
                            dar_err *e);
dar_status dar_video_write(dar_video *v, const uint8_t *rgb, dar_err *e);

/* Wait for the encoder, then rename to `path`.  The caller still owes dar_video_close and does nothing else. */
dar_status dar_video_commit(dar_video *v, dar_err *e);

typedef struct dar_video_info {
    size_t width, height; /* [px], as stored: a rotation noted in the file is not applied */
    double fps;
    size_t frames; /* as counted in the file */
} dar_video_info;

dar_status dar_video_probe(dar_video_info *info, const char *path, dar_err *e);

/* Start decoding; probes first.  On failure *out is NULL. */
dar_status dar_video_open(dar_video **out, dar_video_info *info, const char *path, dar_err *e);

/* The next frame.  After the last: DAR_ERR_FORMAT, so ask for info.frames and no more. */
dar_status dar_video_read(dar_video *v, uint8_t *rgb, dar_err *e);

/* Accepts NULL.  Ends the child; what was not committed is removed. */
void dar_video_close(dar_video *v);

#endif
