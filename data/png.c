/* png.c: the only user of libpng. */
#include "data/png.h"

#include <png.h>
#include <setjmp.h>
#include <stdio.h>
#include <string.h>

#include "lib/file.h"

/* What libpng's callbacks need; the message is kept because the jump loses it. */
struct source {
    const unsigned char *data;
    size_t size, at;
    char why[128];
};

bool dar_png_is(const void *data, size_t size)
{
    return size >= 8 && png_sig_cmp(data, 0, 8) == 0;
}

static void take(png_structp png, png_bytep out, size_t n)
{
    struct source *s = png_get_io_ptr(png);
    if (n > s->size - s->at) png_error(png, "ends too early");
    memcpy(out, s->data + s->at, n);
    s->at += n;
}

static void failed(png_structp png, png_const_charp why)
{
    struct source *s = png_get_error_ptr(png);
    snprintf(s->why, sizeof s->why, "%s", why);
    png_longjmp(png, 1);
}

static void warned(png_structp png, png_const_charp why)
{
    (void)png;
    (void)why;
}

/* RGBA of 8 bits, whatever is stored. */
static void as_rgba(png_structp png)
{
    png_set_expand(png);
    png_set_strip_16(png);
    png_set_gray_to_rgb(png);
    png_set_add_alpha(png, 255, PNG_FILLER_AFTER);
}

/* Everything between setjmp and a jump is libpng's or in *s: no local of ours changes in between. */
static void decode_rows(png_structp png, png_infop info, dar_image *im, uint8_t *rgba)
{
    png_set_user_limits(png, DAR_IMAGE_MAX_SIDE, DAR_IMAGE_MAX_SIDE);
    png_read_info(png, info);
    im->width = png_get_image_width(png, info);
    im->height = png_get_image_height(png, info);
    if (!rgba) return;
    as_rgba(png);
    int passes = png_set_interlace_handling(png);
    png_read_update_info(png, info);
    if (png_get_rowbytes(png, info) != 4 * im->width) png_error(png, "rows of an unexpected size");
    for (int p = 0; p < passes; p++)
        for (size_t y = 0; y < im->height; y++) png_read_row(png, rgba + 4 * im->width * y, NULL);
}

/* rgba NULL: the header only. */
static dar_status read_png(dar_image *im, uint8_t *rgba, const char *name, const void *data, size_t size, dar_err *e)
{
    struct source src = { .data = data, .size = size };
    png_structp png = png_create_read_struct(PNG_LIBPNG_VER_STRING, &src, failed, warned);
    png_infop info = png ? png_create_info_struct(png) : NULL;
    dar_status s = DAR_OK;

    if (!info) {
        s = dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name);
    } else if (setjmp(png_jmpbuf(png))) {
        s = dar_fail(e, DAR_ERR_FORMAT, "%s: PNG: %s", name, src.why);
    } else {
        png_set_read_fn(png, &src, take);
        decode_rows(png, info, im, rgba);
    }
    png_destroy_read_struct(&png, &info, NULL);
    return s;
}

dar_status dar_png_probe(dar_image *im, const char *name, const void *data, size_t size, dar_err *e)
{
    return read_png(im, NULL, name, data, size, e);
}

dar_status dar_png_decode(const dar_image *im, const char *name, const void *data, size_t size, dar_err *e)
{
    dar_image again;
    DAR_TRY(read_png(&again, NULL, name, data, size, e));
    DAR_ASSERT(again.width == im->width && again.height == im->height && im->rgba, "%s: not the picture probed", name);
    return read_png(&again, im->rgba, name, data, size, e);
}

/* ---------------------------------------------------------------- writing */

struct sink {
    dar_file_out out;
    dar_err *e;
    dar_status s; /* of the file */
    char why[128];
};

static void put(png_structp png, png_bytep data, size_t n)
{
    struct sink *k = png_get_io_ptr(png);
    k->s = dar_file_write(&k->out, data, n, k->e);
    if (k->s != DAR_OK) png_error(png, "cannot write");
}

static void flush(png_structp png)
{
    (void)png;
}

static void write_failed(png_structp png, png_const_charp why)
{
    struct sink *k = png_get_error_ptr(png);
    snprintf(k->why, sizeof k->why, "%s", why);
    png_longjmp(png, 1);
}

static void set_comment(png_structp png, png_infop info, const char *comment)
{
    bool ascii = true;
    for (const char *c = comment; *c; c++) ascii &= (unsigned char)*c < 128;
    png_text text = { .compression = ascii ? PNG_TEXT_COMPRESSION_NONE : PNG_ITXT_COMPRESSION_NONE };
    text.key = (char *)(uintptr_t) "Comment";
    text.text = (char *)(uintptr_t)comment;
    png_set_text(png, info, &text, 1);
}

static void encode_rows(png_structp png, png_infop info, const dar_png *p)
{
    int color = p->channels == 1   ? PNG_COLOR_TYPE_GRAY
                : p->channels == 3 ? PNG_COLOR_TYPE_RGB
                                   : PNG_COLOR_TYPE_RGB_ALPHA;
    png_set_user_limits(png, DAR_IMAGE_MAX_SIDE, DAR_IMAGE_MAX_SIDE);
    png_set_IHDR(png, info, (png_uint_32)p->width, (png_uint_32)p->height, 8, color, PNG_INTERLACE_NONE,
                 PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
    png_set_sRGB(png, info, PNG_sRGB_INTENT_PERCEPTUAL);
    if (p->comment) set_comment(png, info, p->comment);
    png_write_info(png, info);
    for (size_t y = 0; y < p->height; y++) png_write_row(png, p->data + y * p->width * (size_t)p->channels);
    png_write_end(png, NULL);
}

static void encode(struct sink *k, const dar_png *p)
{
    png_structp png = png_create_write_struct(PNG_LIBPNG_VER_STRING, k, write_failed, warned);
    png_infop info = png ? png_create_info_struct(png) : NULL;
    if (!info) {
        k->s = dar_fail(k->e, DAR_ERR_NOMEM, "%s: out of memory", k->out.path);
    } else if (setjmp(png_jmpbuf(png))) {
        if (k->s == DAR_OK) k->s = dar_fail(k->e, DAR_ERR_IO, "%s: PNG: %s", k->out.path, k->why);
    } else {
        png_set_write_fn(png, k, put, flush);
        encode_rows(png, info, p);
    }
    png_destroy_write_struct(&png, &info);
}

dar_status dar_png_save(const char *path, const dar_png *p, dar_err *e)
{
    struct sink k = { .e = e };
    DAR_ASSERT(p->width && p->height && p->width <= DAR_IMAGE_MAX_SIDE && p->height <= DAR_IMAGE_MAX_SIDE &&
                   (p->channels == 1 || p->channels == 3 || p->channels == 4),
               "%s: %zux%zu, %d channels", path, p->width, p->height, p->channels);
    k.s = dar_file_create(&k.out, path, e);
    if (k.s == DAR_OK) encode(&k, p);
    if (k.s == DAR_OK) k.s = dar_file_commit(&k.out, e);
    dar_file_discard(&k.out);
    return k.s;
}

dar_status dar_png_write(const char *path, size_t width, size_t height, int channels, const uint8_t *data, dar_err *e)
{
    return dar_png_save(path, &(dar_png){ width, height, channels, data, NULL }, e);
}
