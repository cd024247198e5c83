/* exr.c: the only user of OpenEXR. */
#include "data/exr.h"

#include <errno.h>
#include <openexr.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <strings.h>
#include <unistd.h>

#include "lib/file.h"

#define NAME_MAX_SIZE 512

struct channel {
    int part, index; /* of the part's list */
    dar_exr_type type;
    char name[NAME_MAX_SIZE];
};

/* What the C core's callbacks need. */
struct stream {
    const unsigned char *data;
    size_t size;
    dar_file_out out;
    char why[160]; /* its last message */
};

struct dar_exr {
    exr_context_t ctx;
    struct stream stream;
    dar_file_map map;
    char path[PATH_MAX];
    size_t width, height, channels;
    exr_attr_box2i_t display;
    struct channel *channel;
};

static size_t type_size(dar_exr_type t)
{
    return t == DAR_EXR_F16 ? 2 : 4;
}

/* ---------------------------------------------------------------- callbacks */

static struct stream *stream_of(exr_const_context_t ctx)
{
    void *s = NULL;
    exr_get_user_data(ctx, &s);
    return s;
}

static void keep_message(exr_const_context_t ctx, exr_result_t code, const char *msg)
{
    struct stream *s = stream_of(ctx);
    (void)code;
    if (s) snprintf(s->why, sizeof s->why, "%s", msg ? msg : "");
}

static int64_t read_at(exr_const_context_t ctx, void *user, void *to, uint64_t n, uint64_t at,
                       exr_stream_error_func_ptr_t error)
{
    const struct stream *s = user;
    (void)ctx;
    (void)error;
    if (at >= s->size) return 0;
    if (n > s->size - at) n = s->size - at;
    memcpy(to, s->data + at, n);
    return (int64_t)n;
}

static int64_t size_of(exr_const_context_t ctx, void *user)
{
    (void)ctx;
    return (int64_t)((const struct stream *)user)->size;
}

static int64_t write_at(exr_const_context_t ctx, void *user, const void *from, uint64_t n, uint64_t at,
                        exr_stream_error_func_ptr_t error)
{
    const struct stream *s = user;
    for (uint64_t done = 0; done < n;) {
        ssize_t k = pwrite(s->out.fd, (const char *)from + done, n - done, (off_t)(at + done));
        if (k < 0 && errno == EINTR) continue;
        if (k < 0) {
            error(ctx, EXR_ERR_WRITE_IO, "%s", strerror(errno));
            return -1;
        }
        done += (uint64_t)k;
    }
    return (int64_t)n;
}

static exr_context_initializer_t setup(struct stream *s)
{
    exr_context_initializer_t c = EXR_DEFAULT_CONTEXT_INITIALIZER;
    c.error_handler_fn = keep_message;
    c.user_data = s;
    c.max_image_width = c.max_image_height = DAR_EXR_MAX_SIDE;
    c.zip_level = 4;
    return c;
}

static dar_status refused(const char *path, const struct stream *s, exr_result_t r, dar_err *e)
{
    if (r == EXR_ERR_OUT_OF_MEMORY) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    return dar_fail(e, s->out.path[0] ? DAR_ERR_IO : DAR_ERR_FORMAT, "%s: OpenEXR: %s", path,
                    *s->why ? s->why : exr_get_default_error_message(r));
}

/* ---------------------------------------------------------------- writing */

/* In pieces: ffmpeg 5 loses its way in a header with a longer text. */
static exr_result_t set_comment(exr_context_t ctx, int part, const char *comment)
{
    exr_result_t r = EXR_ERR_SUCCESS;
    char name[32] = "comments", piece[256];
    for (int i = 2; r == EXR_ERR_SUCCESS && *comment; i++) {
        snprintf(piece, sizeof piece, "%s", comment);
        r = exr_attr_set_string(ctx, part, name, piece);
        comment += strlen(piece);
        snprintf(name, sizeof name, "comments%d", i);
    }
    return r;
}

static exr_result_t define(exr_context_t ctx, size_t width, size_t height, const dar_exr_plane *plane, size_t planes,
                           const dar_exr_how *how)
{
    static const exr_compression_t code[] = { EXR_COMPRESSION_NONE, EXR_COMPRESSION_ZIP, EXR_COMPRESSION_PXR24 };
    static const exr_pixel_type_t type[] = { EXR_PIXEL_UINT, EXR_PIXEL_HALF, EXR_PIXEL_FLOAT };
    int part;
    exr_result_t r = exr_add_part(ctx, NULL, EXR_STORAGE_SCANLINE, &part);
    if (r == EXR_ERR_SUCCESS)
        r = exr_initialize_required_attr_simple(ctx, part, (int)width, (int)height, code[how->compression]);
    if (r == EXR_ERR_SUCCESS && how->comment) r = set_comment(ctx, part, how->comment);
    for (size_t i = 0; i < planes && r == EXR_ERR_SUCCESS; i++)
        r = exr_add_channel(ctx, part, plane[i].name, type[plane[i].type], EXR_PERCEPTUALLY_LOGARITHMIC, 1, 1);
    return r == EXR_ERR_SUCCESS ? exr_write_header(ctx) : r;
}

/* OpenEXR sorts channels by name. */
static const dar_exr_plane *plane_named(const dar_exr_plane *plane, size_t planes, const char *name)
{
    for (size_t i = 0; i < planes; i++)
        if (strcmp(plane[i].name, name) == 0) return &plane[i];
    return NULL;
}

static exr_result_t write_chunks(exr_context_t ctx, size_t width, size_t height, const dar_exr_plane *plane,
                                 size_t planes)
{
    int lines;
    bool begun = false;
    exr_encode_pipeline_t pipe = EXR_ENCODE_PIPELINE_INITIALIZER;
    exr_result_t r = exr_get_scanlines_per_chunk(ctx, 0, &lines);
    for (size_t y = 0; y < height && r == EXR_ERR_SUCCESS; y += (size_t)lines) {
        exr_chunk_info_t info;
        r = exr_write_scanline_chunk_info(ctx, 0, (int)y, &info);
        if (r == EXR_ERR_SUCCESS)
            r = begun ? exr_encoding_update(ctx, 0, &info, &pipe) : exr_encoding_initialize(ctx, 0, &info, &pipe);
        if (r != EXR_ERR_SUCCESS) break;
        for (int i = 0; i < pipe.channel_count; i++) {
            exr_coding_channel_info_t *c = &pipe.channels[i];
            const dar_exr_plane *p = plane_named(plane, planes, c->channel_name);
            size_t size = type_size(p->type);
            c->user_pixel_stride = (int32_t)size;
            c->user_line_stride = (int32_t)(size * width);
            c->encode_from_ptr = (const uint8_t *)p->data + size * width * y;
        }
        if (!begun) r = exr_encoding_choose_default_routines(ctx, 0, &pipe);
        begun = true;
        if (r == EXR_ERR_SUCCESS) r = exr_encoding_run(ctx, 0, &pipe);
    }
    if (begun) exr_encoding_destroy(ctx, &pipe);
    return r;
}

dar_status dar_exr_write(const char *path, size_t width, size_t height, const dar_exr_plane *plane, size_t planes,
                         const dar_exr_how *how, dar_err *e)
{
    struct stream stream = { 0 };
    exr_context_t ctx = NULL;
    DAR_ASSERT(width && height && width <= DAR_EXR_MAX_SIDE && height <= DAR_EXR_MAX_SIDE && planes &&
                   planes <= DAR_EXR_MAX_CHANNELS,
               "%s: %zux%zu, %zu planes", path, width, height, planes);
    for (size_t i = 0; i < planes; i++)
        DAR_ASSERT(plane_named(plane, planes, plane[i].name) == &plane[i], "%s: two %s", path, plane[i].name);

    dar_status s = dar_file_create(&stream.out, path, e);
    if (s == DAR_OK) {
        exr_context_initializer_t c = setup(&stream);
        c.write_fn = write_at;
        exr_result_t r = exr_start_write(&ctx, path, EXR_WRITE_FILE_DIRECTLY, &c);
        if (r == EXR_ERR_SUCCESS) r = define(ctx, width, height, plane, planes, how);
        if (r == EXR_ERR_SUCCESS) r = write_chunks(ctx, width, height, plane, planes);
        exr_result_t last = ctx ? exr_finish(&ctx) : r;
        if (r == EXR_ERR_SUCCESS) r = last;
        s = r == EXR_ERR_SUCCESS ? dar_file_commit(&stream.out, e) : refused(path, &stream, r, e);
    }
    dar_file_discard(&stream.out);
    return s;
}

/* ---------------------------------------------------------------- headers */

static const char *unreadable(exr_storage_t storage, exr_compression_t c)
{
    if (storage != EXR_STORAGE_SCANLINE) return "found a tiled or deep part, expected scanlines";
    if (c == EXR_COMPRESSION_DWAA || c == EXR_COMPRESSION_DWAB)
        return "found DWAA or DWAB compression, expected ZIP, PIZ, PXR24, RLE, B44 or none";
    return NULL;
}

static bool inside(const exr_attr_box2i_t *a, const exr_attr_box2i_t *b)
{
    return a->min.x >= b->min.x && a->min.y >= b->min.y && a->max.x <= b->max.x && a->max.y <= b->max.y &&
           a->min.x <= a->max.x && a->min.y <= a->max.y;
}

/* Differences of corners may not fit 32 bits. */
static dar_status check_windows(dar_exr *x, int part, dar_err *e)
{
    exr_attr_box2i_t data, display;
    exr_result_t r = exr_get_data_window(x->ctx, part, &data);
    if (r == EXR_ERR_SUCCESS) r = exr_get_display_window(x->ctx, part, &display);
    if (r != EXR_ERR_SUCCESS) return refused(x->path, &x->stream, r, e);
    int64_t w = (int64_t)display.max.x - display.min.x + 1, h = (int64_t)display.max.y - display.min.y + 1;
    if (w < 1 || h < 1 || w > DAR_EXR_MAX_SIDE || h > DAR_EXR_MAX_SIDE)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found %lldx%lld pixels, expected sides from 1 to %d", x->path,
                        (long long)w, (long long)h, DAR_EXR_MAX_SIDE);
    if (!inside(&data, &display))
        return dar_fail(e, DAR_ERR_FORMAT, "%s: the data window is not inside the display window", x->path);
    if (part && memcmp(&display, &x->display, sizeof display) != 0)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: parts of different sizes", x->path);
    x->display = display;
    x->width = (size_t)w;
    x->height = (size_t)h;
    return DAR_OK;
}

static dar_status add_channels(dar_exr *x, int part, bool several, dar_err *e)
{
    const exr_attr_chlist_t *list;
    const char *part_name = NULL;
    exr_result_t r = exr_get_channels(x->ctx, part, &list);
    if (r != EXR_ERR_SUCCESS) return refused(x->path, &x->stream, r, e);
    if (several) exr_get_name(x->ctx, part, &part_name);
    if (list->num_channels < 1 || (size_t)list->num_channels > DAR_EXR_MAX_CHANNELS - x->channels)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found %d channels, expected 1 to %d", x->path, list->num_channels,
                        DAR_EXR_MAX_CHANNELS);
    for (int i = 0; i < list->num_channels; i++) {
        const exr_attr_chlist_entry_t *in = &list->entries[i];
        struct channel *c = &x->channel[x->channels++];
        *c = (struct channel){ .part = part, .index = i };
        c->type = in->pixel_type == EXR_PIXEL_HALF   ? DAR_EXR_F16
                  : in->pixel_type == EXR_PIXEL_UINT ? DAR_EXR_U32
                                                     : DAR_EXR_F32;
        snprintf(c->name, sizeof c->name, "%s%s%s", part_name ? part_name : "", part_name ? "." : "", in->name.str);
        if (in->x_sampling != 1 || in->y_sampling != 1)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: %s: found fewer samples than pixels", x->path, c->name);
    }
    return DAR_OK;
}

static dar_status read_header(dar_exr *x, dar_err *e)
{
    int parts = 0;
    exr_context_initializer_t c = setup(&x->stream);
    c.read_fn = read_at;
    c.size_fn = size_of;
    exr_result_t r = exr_start_read(&x->ctx, x->path, &c);
    if (r == EXR_ERR_SUCCESS) r = exr_get_count(x->ctx, &parts);
    if (r != EXR_ERR_SUCCESS) return refused(x->path, &x->stream, r, e);
    x->channel = malloc(DAR_EXR_MAX_CHANNELS * sizeof *x->channel);
    if (!x->channel) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", x->path);
    for (int p = 0; p < parts; p++) {
        exr_storage_t storage;
        exr_compression_t compression = EXR_COMPRESSION_NONE;
        r = exr_get_storage(x->ctx, p, &storage);
        if (r == EXR_ERR_SUCCESS) r = exr_get_compression(x->ctx, p, &compression);
        if (r != EXR_ERR_SUCCESS) return refused(x->path, &x->stream, r, e);
        const char *why = unreadable(storage, compression);
        if (why) return dar_fail(e, DAR_ERR_FORMAT, "%s: %s", x->path, why);
        DAR_TRY(check_windows(x, p, e));
        DAR_TRY(add_channels(x, p, parts > 1, e));
    }
    return DAR_OK;
}

dar_status dar_exr_parse(dar_exr **out, const char *name, const void *data, size_t size, dar_err *e)
{
    dar_exr *x = *out = calloc(1, sizeof *x);
    if (!x) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", name);
    x->stream.data = data;
    x->stream.size = size;
    snprintf(x->path, sizeof x->path, "%s", name);
    dar_status s = read_header(x, e);
    if (s != DAR_OK) {
        dar_exr_close(x);
        *out = NULL;
    }
    return s;
}

dar_status dar_exr_open(dar_exr **out, const char *path, dar_err *e)
{
    dar_file_map m;
    *out = NULL;
    DAR_TRY(dar_file_map_open(&m, path, e));
    dar_status s = dar_exr_parse(out, path, m.data, m.size, e);
    if (s == DAR_OK) (*out)->map = m;
    else dar_file_map_close(&m);
    return s;
}

void dar_exr_close(dar_exr *x)
{
    if (!x) return;
    if (x->ctx) exr_finish(&x->ctx);
    dar_file_map_close(&x->map);
    free(x->channel);
    free(x);
}

size_t dar_exr_width(const dar_exr *x)
{
    return x->width;
}

size_t dar_exr_height(const dar_exr *x)
{
    return x->height;
}

size_t dar_exr_channels(const dar_exr *x)
{
    return x->channels;
}

const char *dar_exr_name(const dar_exr *x, size_t channel)
{
    DAR_ASSERT(channel < x->channels, "%s: channel %zu of %zu", x->path, channel, x->channels);
    return x->channel[channel].name;
}

dar_exr_type dar_exr_type_of(const dar_exr *x, size_t channel)
{
    DAR_ASSERT(channel < x->channels, "%s: channel %zu of %zu", x->path, channel, x->channels);
    return x->channel[channel].type;
}

int dar_exr_find(const dar_exr *x, const char *pass, const char *component)
{
    size_t length = strlen(pass);
    for (size_t i = 0; i < x->channels; i++) {
        const char *name = x->channel[i].name, *dot = strrchr(name, '.'), *from = dot;
        if (!dot) {
            if (!length && strcasecmp(name, component) == 0) return (int)i;
            continue;
        }
        while (from > name && from[-1] != '.') from--;
        if (strcasecmp(dot + 1, component) == 0 && (size_t)(dot - from) == length &&
            strncasecmp(from, pass, length) == 0)
            return (int)i;
    }
    return -1;
}

/* ---------------------------------------------------------------- pixels */

static exr_result_t read_chunks(const dar_exr *x, const struct channel *c, const exr_attr_box2i_t *data, uint8_t *plane)
{
    int lines;
    bool begun = false;
    size_t size = type_size(c->type), left = (size_t)(data->min.x - x->display.min.x);
    exr_decode_pipeline_t pipe = EXR_DECODE_PIPELINE_INITIALIZER;
    exr_result_t r = exr_get_scanlines_per_chunk(x->ctx, c->part, &lines);
    for (int64_t y = data->min.y; y <= data->max.y && r == EXR_ERR_SUCCESS; y += lines) {
        exr_chunk_info_t info;
        r = exr_read_scanline_chunk_info(x->ctx, c->part, (int)y, &info);
        if (r == EXR_ERR_SUCCESS)
            r = begun ? exr_decoding_update(x->ctx, c->part, &info, &pipe)
                      : exr_decoding_initialize(x->ctx, c->part, &info, &pipe);
        if (r != EXR_ERR_SUCCESS) break;
        for (int i = 0; i < pipe.channel_count; i++) {
            pipe.channels[i].decode_to_ptr = NULL;
            if (i != c->index) continue;
            pipe.channels[i].user_pixel_stride = (int32_t)size;
            pipe.channels[i].user_line_stride = (int32_t)(size * x->width);
            pipe.channels[i].decode_to_ptr = plane + size * (x->width * (size_t)(y - x->display.min.y) + left);
        }
        if (!begun) r = exr_decoding_choose_default_routines(x->ctx, c->part, &pipe);
        begun = true;
        if (r == EXR_ERR_SUCCESS) r = exr_decoding_run(x->ctx, c->part, &pipe);
    }
    if (begun) exr_decoding_destroy(x->ctx, &pipe);
    return r;
}

dar_status dar_exr_read(dar_exr *x, size_t channel, void *plane, dar_err *e)
{
    exr_attr_box2i_t data;
    DAR_ASSERT(channel < x->channels, "%s: channel %zu of %zu", x->path, channel, x->channels);
    const struct channel *c = &x->channel[channel];
    x->stream.why[0] = 0;
    memset(plane, 0, x->width * x->height * type_size(c->type));
    exr_result_t r = exr_get_data_window(x->ctx, c->part, &data);
    if (r == EXR_ERR_SUCCESS) r = read_chunks(x, c, &data, plane);
    return r == EXR_ERR_SUCCESS ? DAR_OK : refused(x->path, &x->stream, r, e);
}
