/* jpeg.c: the only user of libjpeg.  Its own error handler ends the program and prints; ours jumps back. */
#include "data/jpeg.h"

#include <stdio.h>

#include <jpeglib.h>
#include <jerror.h>
#include <setjmp.h>
#include <string.h>

#define MEMORY_MAX ((long)1 << 30) /* of the decoder: a progressive picture of the largest side takes 0.8 GB */
#define SCANS_MAX  500             /* a file of scans without content would be decoded for minutes */

struct failure {
    struct jpeg_error_mgr base; /* first: libjpeg knows only this */
    jmp_buf back;
    char why[JMSG_LENGTH_MAX];
};

bool dar_jpeg_is(const void *data, size_t size)
{
    return size >= 3 && memcmp(data, "\xff\xd8\xff", 3) == 0;
}

static void failed(j_common_ptr j)
{
    struct failure *f = (struct failure *)j->err;
    f->base.format_message(j, f->why);
    longjmp(f->back, 1);
}

/* Warnings (level -1) are mostly data that libjpeg invents in place of damaged ones: not for us. */
static void message(j_common_ptr j, int level)
{
    int code = j->err->msg_code;
    bool harmless = code == JWRN_EXTRANEOUS_DATA || code == JWRN_JFIF_MAJOR || code == JWRN_ADOBE_XFORM;
    if (level < 0 && !harmless) failed(j);
}

static void print_nothing(j_common_ptr j)
{
    (void)j;
}

static void watch_scans(j_common_ptr j)
{
    struct failure *f = (struct failure *)j->err;
    if (!j->is_decompressor || ((j_decompress_ptr)j)->input_scan_number <= SCANS_MAX) return;
    snprintf(f->why, sizeof f->why, "more than %d scans", SCANS_MAX);
    longjmp(f->back, 1);
}

/* rgba NULL: the header only.  false: f->why says what is wrong. */
static bool decode(j_decompress_ptr j, struct failure *f, const void *data, size_t size, dar_image *im, uint8_t *rgba)
{
    if (setjmp(f->back)) return false;
    jpeg_create_decompress(j);
    j->mem->max_memory_to_use = MEMORY_MAX;
    jpeg_mem_src(j, data, (unsigned long)size);
    jpeg_read_header(j, TRUE);
    im->width = j->image_width;
    im->height = j->image_height;
    if (!rgba) return true;
    struct jpeg_progress_mgr progress = { .progress_monitor = watch_scans };
    j->progress = &progress;
    j->out_color_space = JCS_EXT_RGBA;
    j->dct_method = JDCT_ISLOW; /* the exact one */
    jpeg_start_decompress(j);
    while (j->output_scanline < j->output_height) {
        JSAMPROW row = rgba + 4 * im->width * j->output_scanline;
        jpeg_read_scanlines(j, &row, 1);
    }
    jpeg_finish_decompress(j);
    return true;
}

static dar_status read_jpeg(dar_image *im, uint8_t *rgba, const char *name, const void *data, size_t size, dar_err *e)
{
    struct jpeg_decompress_struct j = { 0 };
    struct failure f = { 0 };

    j.err = jpeg_std_error(&f.base);
    f.base.error_exit = failed;
    f.base.emit_message = message;
    f.base.output_message = print_nothing;
    bool good = decode(&j, &f, data, size, im, rgba);
    jpeg_destroy_decompress(&j);
    return good ? DAR_OK : dar_fail(e, DAR_ERR_FORMAT, "%s: JPEG: %s", name, f.why);
}

dar_status dar_jpeg_probe(dar_image *im, const char *name, const void *data, size_t size, dar_err *e)
{
    return read_jpeg(im, NULL, name, data, size, e);
}

dar_status dar_jpeg_decode(const dar_image *im, const char *name, const void *data, size_t size, dar_err *e)
{
    dar_image again;
    DAR_TRY(read_jpeg(&again, NULL, name, data, size, e));
    DAR_ASSERT(again.width == im->width && again.height == im->height && im->rgba, "%s: not the picture probed", name);
    return read_jpeg(&again, im->rgba, name, data, size, e);
}
