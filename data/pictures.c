/* pictures.c: pictures from files, one after the other. */
#include "data/pictures.h"

#include <dirent.h>
#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <sys/stat.h>

#include "data/image.h"
#include "data/objseq.h"
#include "data/resize.h"
#include "data/video.h"
#include "lib/file.h"

struct dar_pictures {
    const char *path;
    size_t width, height, frames, next;
    dar_video *video;     /* or */
    struct dirent **file; /* [files] of the directory */
    int files;
};

/* ---------------------------------------------------------------- a file */

static dar_status check_size(const char *path, size_t w, size_t h, size_t width, size_t height, dar_err *e)
{
    if (w == width && h == height) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu x %zu pixels, expected %zu x %zu", path, w, h, width, height);
}

/* The picture as RGB in memory of its own, of its own size. */
static dar_status decode(const char *path, const dar_file_map *m, dar_image *im, uint8_t **rgb, dar_err *e)
{
    size_t pixels = im->width * im->height;
    im->rgba = malloc(4 * pixels);
    if (!im->rgba) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    dar_status s = dar_image_decode(im, path, m->data, m->size, e);
    if (s == DAR_OK && !(*rgb = malloc(3 * pixels))) s = dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    for (size_t i = 0; s == DAR_OK && i < pixels; i++)
        for (size_t c = 0; c < 3; c++)
            (*rgb)[3 * i + c] = (uint8_t)((im->rgba[4 * i + c] * im->rgba[4 * i + 3] + 127) / 255);
    free(im->rgba);
    return s;
}

static dar_status load(const char *path, size_t width, size_t height, bool any, uint8_t *rgb, dar_err *e)
{
    dar_file_map m;
    dar_image im;
    uint8_t *own = NULL;
    DAR_TRY(dar_file_map_open(&m, path, e));
    dar_status s = dar_image_probe(&im, path, m.data, m.size, e);
    if (s == DAR_OK && !any) s = check_size(path, im.width, im.height, width, height, e);
    if (s == DAR_OK) s = decode(path, &m, &im, &own, e);
    if (s == DAR_OK && im.width == width && im.height == height) memcpy(rgb, own, 3 * width * height);
    else if (s == DAR_OK) s = dar_resize(path, own, im.width, im.height, rgb, width, height, e);
    free(own);
    dar_file_map_close(&m);
    return s;
}

dar_status dar_pictures_load(const char *path, size_t width, size_t height, uint8_t *rgb, dar_err *e)
{
    return load(path, width, height, false, rgb, e);
}

dar_status dar_pictures_fit(const char *path, size_t width, size_t height, uint8_t *rgb, dar_err *e)
{
    return load(path, width, height, true, rgb, e);
}

/* ---------------------------------------------------------------- many */

static int is_picture(const struct dirent *d)
{
    const char *dot = strrchr(d->d_name, '.');
    return d->d_name[0] != '.' && dot &&
           (strcasecmp(dot, ".png") == 0 || strcasecmp(dot, ".jpg") == 0 || strcasecmp(dot, ".jpeg") == 0);
}

static int in_order(const struct dirent **a, const struct dirent **b)
{
    return dar_objseq_order((*a)->d_name, (*b)->d_name);
}

static dar_status open_directory(dar_pictures *p, dar_err *e)
{
    p->files = scandir(p->path, &p->file, is_picture, in_order);
    if (p->files < 0) return dar_fail(e, DAR_ERR_IO, "%s: %s", p->path, strerror(errno));
    if ((size_t)p->files == p->frames) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: found %d PNG and JPEG files, expected %zu, one for each frame", p->path,
                    p->files, p->frames);
}

static dar_status open_video(dar_pictures *p, dar_err *e)
{
    dar_video_info info;
    DAR_TRY(dar_video_open(&p->video, &info, p->path, e));
    DAR_TRY(check_size(p->path, info.width, info.height, p->width, p->height, e));
    if (info.frames == p->frames) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu frames, expected %zu", p->path, info.frames, p->frames);
}

dar_status dar_pictures_open(dar_pictures **out, const char *path, size_t width, size_t height, size_t frames,
                             dar_err *e)
{
    struct stat st;
    dar_pictures *p = *out = calloc(1, sizeof *p);
    dar_status s = DAR_OK;
    if (!p) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    *p = (dar_pictures){ .path = path, .width = width, .height = height, .frames = frames };
    if (stat(path, &st) != 0) s = dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
    else s = S_ISDIR(st.st_mode) ? open_directory(p, e) : open_video(p, e);
    if (s != DAR_OK) {
        dar_pictures_close(p);
        *out = NULL;
    }
    return s;
}

void dar_pictures_close(dar_pictures *p)
{
    if (!p) return;
    dar_video_close(p->video);
    for (int i = 0; i < p->files; i++) free(p->file[i]);
    free(p->file);
    free(p);
}

dar_status dar_pictures_read(dar_pictures *p, uint8_t *rgb, dar_err *e)
{
    char path[PATH_MAX];
    DAR_ASSERT(p->next < p->frames, "pictures: more than %zu asked for", p->frames);
    size_t i = p->next++;
    if (p->video) return dar_video_read(p->video, rgb, e);
    if (snprintf(path, sizeof path, "%s/%s", p->path, p->file[i]->d_name) >= (int)sizeof path)
        return dar_fail(e, DAR_ERR_IO, "%s: %s", p->path, strerror(ENAMETOOLONG));
    return dar_pictures_load(path, p->width, p->height, rgb, e);
}
