/* camera_io.h: camera paths from and to the files that people have.
 *
 *   format      file              what it holds
 *   json        cameras.json      ours: per frame K [px], c2w 4 x 4 in OpenCV axes, near; also key poses to go between
 *   transforms  transforms.json   Blender and NeRF: c2w in OpenGL axes, camera_angle_x or fl_x ..., w, h, for all
 * frames or per frame; frames in the order of the file; lenses with distortion are refused poses       *.txt
 * RealEstate10K, CameraCtrl, VideoX-Fun: the first line is passed over, whatever it is; then per frame 19 numbers: time
 * fx fy cx cy 0 0 and w2c 3 x 4 in OpenCV axes, fx, cx as shares of the width, fy, cy of the height of the pictures
 * that the poses are of gltf        *.gltf            written only: a scene of one animated camera.  Read by
 * data/gltf.h, then dar_camera_io_from_lens
 *
 * cameras.json: { "format": "dar-cameras/1", "width", "height", "cameras": [{ "K" 3 x 3, "c2w" 4 x 4, "near" }, ...] },
 * and if they are there "axes": "opencv", "frames": their number, "relative_to_first": whether the first c2w is the
 * identity.  Instead of "cameras": "keys", each with a "time" in any unit, "frames", how many to make from the first
 * key to the last, "turn": "squad" or "slerp", "move": "catmull-rom" or "linear" (data/camera.h).
 *
 * Poses and the picture's shape.  VideoX-Fun takes the numbers to be of pictures of 1280 x 720, pose_width x
 * pose_height, whatever is rendered: with their ratio P and a picture of W x H, if P > W / H then fx <- fx H P / W,
 * else fy <- fy (W / P) / H; then pixels are fx W, fy H, cx W, cy H.  So at 832 x 480 an fx of 1 is 853.33 px.  Writing
 * inverts this.  With pose_width 0 the numbers are of the picture itself.
 *
 * A file that is not sound is refused with one line: file, line or key, what was found, what was expected.  Rotations
 * come back as exact rotations.  What a format has no place for (near) is taken from the options. */
#ifndef DAR_DATA_CAMERA_IO_H
#define DAR_DATA_CAMERA_IO_H

#include <stddef.h>

#include "data/camera.h"
#include "data/mesh.h"
#include "lib/file.h"
#include "lib/json.h"
#include "lib/status.h"

#define DAR_CAMERA_IO_MAX_FRAMES 65536

typedef enum dar_camera_format {
    DAR_CAMERA_JSON,
    DAR_CAMERA_TRANSFORMS,
    DAR_CAMERA_POSES,
    DAR_CAMERA_GLTF,
    DAR_CAMERA_FORMATS,
    DAR_CAMERA_ANY = DAR_CAMERA_FORMATS, /* reading: by the content */
} dar_camera_format;

extern const char *const dar_camera_format_name[DAR_CAMERA_FORMATS + 1]; /* ends with NULL */

typedef struct dar_camera_options {
    int width, height;           /* of the picture [px]; reading: 0: the file's, else the views are fitted to it */
    int pose_width, pose_height; /* poses only */
    double near;                 /* reading, where the file has none */
    double fps;                  /* writing glTF */
    dar_camera_axes axes;        /* of transforms.json: its matrices, and the world they are in */
} dar_camera_options;

dar_camera_options dar_camera_io_standard(void); /* size 0, poses of 1280 x 720, near 0.01, 24 fps, OpenGL */

/* The caller owes one dar_camera_free, also after a failure. */
dar_status dar_camera_io_read(dar_camera_path *p, const char *path, dar_camera_format format,
                              const dar_camera_options *o, dar_err *e);

/* The same from text[0, size); `name` stands for the file in messages. */
dar_status dar_camera_io_parse(dar_camera_path *p, const char *name, const char *text, size_t size,
                               dar_camera_format format, const dar_camera_options *o, dar_err *e);

/* The options' size plays no part: a path knows its own.  glTF: fails if fx is not fy, the principal point not the
 * centre, or the lens changes from frame to frame; numbers are rounded to f32. */
dar_status dar_camera_io_write(const dar_camera_path *p, const char *path, dar_camera_format format,
                               const dar_camera_options *o, dar_err *e);

/* A glTF camera: the world matrix of its node at every frame, whose scale plays no part, and a picture of width x
 * height; the field of view is the file's vertical one.  Fails for orthographic cameras, and for matrices without
 * extent.  The caller owes one dar_camera_free, also after a failure. */
dar_status dar_camera_io_from_lens(dar_camera_path *p, const dar_lens *lens, const double (*world)[12], size_t frames,
                                   int width, int height, dar_err *e);

/* ---------------------------------------------------------------- formats, for camera_io.c */

dar_status dar_camera_io_read_json(dar_camera_path *p, const char *name, dar_json_doc *doc, const dar_camera_options *o,
                                   dar_err *e);
dar_status dar_camera_io_read_transforms(dar_camera_path *p, const char *name, dar_json_doc *doc,
                                         const dar_camera_options *o, dar_err *e);
dar_status dar_camera_io_print_json(const dar_camera_path *p, const dar_camera_options *o, dar_json_writer *w,
                                    dar_err *e);
dar_status dar_camera_io_print_transforms(const dar_camera_path *p, const dar_camera_options *o, dar_json_writer *w,
                                          dar_err *e);
dar_status dar_camera_io_print_gltf(const dar_camera_path *p, const dar_camera_options *o, dar_json_writer *w,
                                    dar_err *e);

#endif
