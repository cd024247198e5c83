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
    bool any, resized;    /* any size is taken; one was another */
    dar_video *video;     /* or */
    dar_video_info info;  /* of it */
    uint8_t *own;         /* a frame of it, if it is of another size */
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

/* *other: NULL: another size is refused; else told whether it was one. */
static dar_status load(const char *path, size_t width, size_t height, bool *other, uint8_t *rgb, dar_err *e)
{
    dar_file_map m;
    dar_image im;
    uint8_t *own = NULL;
    DAR_TRY(dar_file_map_open(&m, path, e));
    dar_status s = dar_image_probe(&im, path, m.data, m.size, e);
    if (s == DAR_OK && !other) s = check_size(path, im.width, im.height, width, height, e);
    if (s == DAR_OK) s = decode(path, &m, &im, &own, e);
    if (s == DAR_OK && im.width == width && im.height == height) {
        memcpy(rgb, own, 3 * width * height);
    } else if (s == DAR_OK) {
        s = dar_resize(path, own, im.width, im.height, rgb, width, height, e);
        *other = true;
    }
    free(own);
    dar_file_map_close(&m);
    return s;
}

dar_status dar_pictures_load(const char *path, size_t width, size_t height, uint8_t *rgb, dar_err *e)
{
    return load(path, width, height, NULL, rgb, e);
}

dar_status dar_pictures_fit(const char *path, size_t width, size_t height, uint8_t *rgb, dar_err *e)
{
    bool other;
    return load(path, width, height, &other, rgb, e);
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
    if (p->any) p->frames = (size_t)p->files;
    if (p->any && !p->files) return dar_fail(e, DAR_ERR_FORMAT, "%s: found no PNG and no JPEG file", p->path);
    if ((size_t)p->files == p->frames) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: found %d PNG and JPEG files, expected %zu, one for each frame", p->path,
                    p->files, p->frames);
}

static dar_status open_video(dar_pictures *p, dar_err *e)
{
    dar_video_info *i = &p->info;
    DAR_TRY(dar_video_open(&p->video, i, p->path, e));
    if (p->any) {
        p->frames = i->frames;
        p->resized = i->width != p->width || i->height != p->height;
        if (p->resized && !(p->own = malloc(3 * i->width * i->height)))
            return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", p->path);
        return i->frames ? DAR_OK : dar_fail(e, DAR_ERR_FORMAT, "%s: found no frame", p->path);
    }
    DAR_TRY(check_size(p->path, i->width, i->height, p->width, p->height, e));
    if (i->frames == p->frames) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: found %zu frames, expected %zu", p->path, i->frames, p->frames);
}

static dar_status open_all(dar_pictures **out, const dar_pictures *asked, dar_err *e)
{
    struct stat st;
    dar_pictures *p = *out = malloc(sizeof *p);
    dar_status s = DAR_OK;
    if (!p) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", asked->path);
    *p = *asked;
    if (stat(p->path, &st) != 0) s = dar_fail(e, DAR_ERR_IO, "%s: %s", p->path, strerror(errno));
    else s = S_ISDIR(st.st_mode) ? open_directory(p, e) : open_video(p, e);
    if (s != DAR_OK) {
        dar_pictures_close(p);
        *out = NULL;
    }
    return s;
}

dar_status dar_pictures_open(dar_pictures **out, const char *path, size_t width, size_t height, size_t frames,
                             dar_err *e)
{
    return open_all(out, &(dar_pictures){ .path = path, .width = width, .height = height, .frames = frames }, e);
}

dar_status dar_pictures_open_any(dar_pictures **out, const char *path, size_t width, size_t height, size_t *frames,
                                 dar_err *e)
{
    DAR_TRY(open_all(out, &(dar_pictures){ .path = path, .width = width, .height = height, .any = true }, e));
    *frames = (*out)->frames;
    return DAR_OK;
}

bool dar_pictures_resized(const dar_pictures *p)
{
    return p->resized;
}

void dar_pictures_close(dar_pictures *p)
{
    if (!p) return;
    dar_video_close(p->video);
    for (int i = 0; i < p->files; i++) free(p->file[i]);
    free(p->file);
    free(p->own);
    free(p);
}

static dar_status read_video(dar_pictures *p, uint8_t *rgb, dar_err *e)
{
    if (!p->own) return dar_video_read(p->video, rgb, e);
    DAR_TRY(dar_video_read(p->video, p->own, e));
    return dar_resize(p->path, p->own, p->info.width, p->info.height, rgb, p->width, p->height, e);
}

dar_status dar_pictures_read(dar_pictures *p, uint8_t *rgb, dar_err *e)
{
    char path[PATH_MAX];
    DAR_ASSERT(p->next < p->frames, "pictures: more than %zu asked for", p->frames);
    size_t i = p->next++;
    if (p->video) return read_video(p, rgb, e);
    if (snprintf(path, sizeof path, "%s/%s", p->path, p->file[i]->d_name) >= (int)sizeof path)
        return dar_fail(e, DAR_ERR_IO, "%s: %s", p->path, strerror(ENAMETOOLONG));
    return load(path, p->width, p->height, p->any ? &p->resized : NULL, rgb, e);
}
