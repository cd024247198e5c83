/* dar_bundle_show.c: a contact sheet of a bundle: families in rows, moments in columns. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "data/bundle.h"
#include "data/dar_bundle.h"
#include "data/rays.h"
#include "data/rigid.h"
#include "data/sheet.h"

static struct {
    const char *out;
    int64_t columns, width;
    dar_common common;
} o;

/* clang-format off */
static const dar_option options[] = {
    { .name = "out", .letter = 'o', .placeholder = "PNG", .type = DAR_ARG_TEXT, .target = &o.out,
      .help = "sheet to write" },
    { .name = "columns", .placeholder = "N", .type = DAR_ARG_INT, .target = &o.columns, .standard = "5",
      .lo = 1, .hi = 64, .help = "moments to show, from the first frame to the last" },
    { .name = "width", .placeholder = "PX", .type = DAR_ARG_INT, .target = &o.width, .standard = "256",
      .lo = 16, .hi = 4096, .help = "of one picture" },
};
/* clang-format on */

/* What a row is filled from. */
struct show {
    dar_bundle *b;
    size_t width, height, pixels;
    float *x;       /* [3, H, W] */
    uint32_t *id;   /* [H, W] */
    uint8_t *cover; /* [H, W] 0: background */
    uint8_t *rgb;   /* [H, W, 3] */
    double depth[2], moment;
    size_t frame;
};

static uint8_t shade(double x)
{
    return (uint8_t)(255 * fmin(fmax(x, 0), 1) + 0.5);
}

/* ---------------------------------------------------------------- pictures of a frame */

typedef dar_status paint_fn(struct show *s, int family, dar_err *e);

static dar_status paint_rgb(struct show *s, int family, dar_err *e)
{
    (void)family;
    return dar_bundle_rgb(s->b, s->frame, s->rgb, e);
}

/* Three channels as red, green, blue: a x + b[c]. */
static dar_status paint_channels(struct show *s, int family, double a, const double b[3], dar_err *e)
{
    DAR_TRY(dar_bundle_values(s->b, (dar_family)family, s->frame, s->x, e));
    for (size_t i = 0; i < s->pixels; i++)
        for (size_t c = 0; c < 3; c++) s->rgb[3 * i + c] = s->cover[i] ? shade(a * s->x[c * s->pixels + i] + b[c]) : 0;
    return DAR_OK;
}

static dar_status paint_colors(struct show *s, int family, dar_err *e)
{
    return paint_channels(s, family, 1, (const double[3]){ 0 }, e);
}

static dar_status paint_normal(struct show *s, int family, dar_err *e)
{
    return paint_channels(s, family, 0.5, (const double[3]){ 0.5, 0.5, 0.5 }, e);
}

static dar_status paint_world(struct show *s, int family, dar_err *e)
{
    const dar_world *w = &s->b->meta.world;
    double size = w->size > 0 ? w->size : 1, b[3];
    for (int c = 0; c < 3; c++) b[c] = 0.5 - w->centre[c] / size;
    return paint_channels(s, family, 1 / size, b, e);
}

/* Of one channel; depth: near is bright. */
static dar_status paint_grey(struct show *s, int family, dar_err *e)
{
    double a = 1, b = 0;
    DAR_TRY(dar_bundle_values(s->b, (dar_family)family, s->frame, s->x, e));
    if (family == DAR_FAMILY_DEPTH) {
        double span = s->depth[1] - s->depth[0];
        a = span > 0 ? -0.85 / span : 0;
        b = 1 - a * s->depth[0];
    }
    for (size_t i = 0; i < s->pixels; i++) memset(s->rgb + 3 * i, s->cover[i] ? shade(a * s->x[i] + b) : 0, 3);
    return DAR_OK;
}

/* Numbers get hues that are far apart for neighbours: steps of the golden section. */
static dar_status paint_numbers(struct show *s, int family, dar_err *e)
{
    DAR_TRY(dar_bundle_numbers(s->b, (dar_bundle_family)family, s->frame, s->id, e));
    for (size_t i = 0; i < s->pixels; i++) {
        double hue = fmod(0.6180339887498949 * s->id[i], 1),
               light = 0.75 + 0.25 * fmod(0.7548776662466927 * s->id[i], 1);
        for (size_t c = 0; c < 3; c++) {
            double wave = fabs(fmod(6 * hue + 2.0 * (double)c, 6) - 3) - 1; /* Travis 1991, HSV */
            s->rgb[3 * i + c] = s->id[i] ? shade(light * (1 - 0.65 * (1 - fmin(fmax(wave, 0), 1)))) : 0;
        }
    }
    return DAR_OK;
}

enum { RAY_DIRECTION, RAY_MOMENT };

/* The ray of a pixel in the frame of camera 0. */
static void ray_at(const struct show *s, const double w2c0[12], size_t i, double d[3], double m[3])
{
    double o0[3], d0[3], place[3];
    dar_rays_at(&s->b->cameras.view[s->frame], (double)(i % s->width) + 0.5, (double)(i / s->width) + 0.5, o0, d0);
    for (int k = 0; k < 3; k++) {
        d[k] = dar_vec_dot(w2c0 + 4 * k, d0);
        place[k] = dar_vec_dot(w2c0 + 4 * k, o0) + w2c0[4 * k + 3];
    }
    dar_vec_cross(place, d, m);
}

static dar_status paint_rays(struct show *s, int component, dar_err *e)
{
    double w2c0[12], d[3], m[3];
    (void)e;
    dar_rigid_inverse(s->b->cameras.view[0].c2w, w2c0);
    for (size_t i = 0; i < s->pixels; i++) {
        ray_at(s, w2c0, i, d, m);
        for (size_t c = 0; c < 3; c++)
            s->rgb[3 * i + c] = shade(0.5 + 0.5 * (component == RAY_DIRECTION ? d[c]
                                                   : s->moment > 0            ? m[c] / s->moment
                                                                              : 0));
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- the path from above */

/* Of the world's two level axes to the picture: x to the right; z, or with z up -y, downwards. */
struct map {
    double lo[2], hi[2], scale, left, top;
};

static void level(const struct show *s, const double x[3], double y[2])
{
    y[0] = x[0];
    y[1] = s->b->meta.z_up ? -x[1] : x[2];
}

static void reach(const struct show *s, struct map *m, const double x[3])
{
    double y[2];
    level(s, x, y);
    for (int k = 0; k < 2; k++) {
        m->lo[k] = fmin(m->lo[k], y[k]);
        m->hi[k] = fmax(m->hi[k], y[k]);
    }
}

static void place_of(const dar_view *v, double x[3])
{
    for (int k = 0; k < 3; k++) x[k] = v->c2w[4 * k + 3];
}

/* The box of the frame; false: unknown. */
static bool box_of(const struct show *s, dar_box *box)
{
    const dar_bundle_meta *m = &s->b->meta;
    if (m->boxes) *box = m->box[m->boxes > 1 ? s->frame : 0];
    else if (m->world.size > 0)
        memcpy(box->lo, m->world.lo, sizeof box->lo), memcpy(box->hi, m->world.hi, sizeof box->hi);
    return m->boxes || m->world.size > 0;
}

/* All cameras and boxes, with a margin around them. */
static struct map map_of(struct show *s)
{
    struct map m = { { INFINITY, INFINITY }, { -INFINITY, -INFINITY }, 1, 0, 0 };
    double x[3], w = (double)s->width, h = (double)s->height;
    size_t frame = s->frame;
    dar_box box;
    for (s->frame = 0; s->frame < s->b->meta.frames; s->frame++) {
        place_of(&s->b->cameras.view[s->frame], x);
        reach(s, &m, x);
        if (!box_of(s, &box)) continue;
        reach(s, &m, box.lo);
        reach(s, &m, box.hi);
    }
    s->frame = frame;
    double across = fmax(m.hi[0] - m.lo[0], 1e-9), down = fmax(m.hi[1] - m.lo[1], 1e-9);
    m.scale = 0.86 * fmin(w / across, h / down);
    m.left = (w - m.scale * across) / 2;
    m.top = (h - m.scale * down) / 2;
    return m;
}

/* A line between two places of the world, as wide as will be seen when the picture is shrunk. */
static void draw_line(struct show *s, const struct map *m, const double a[3], const double b[3], const uint8_t color[3])
{
    double p[2], q[2], width = fmax(1, (double)s->width / (double)o.width);
    level(s, a, p);
    level(s, b, q);
    double steps = ceil(m->scale * fmax(fabs(q[0] - p[0]), fabs(q[1] - p[1]))) + 1;
    for (double i = 0; i <= steps; i++) {
        double x = m->left + m->scale * (p[0] + (q[0] - p[0]) * i / steps - m->lo[0]);
        double y = m->top + m->scale * (p[1] + (q[1] - p[1]) * i / steps - m->lo[1]);
        for (double v = floor(y - width / 2 + 0.5); v < y + width / 2; v++)
            for (double u = floor(x - width / 2 + 0.5); u < x + width / 2; u++)
                if (u >= 0 && v >= 0 && u < (double)s->width && v < (double)s->height)
                    memcpy(s->rgb + 3 * ((size_t)v * s->width + (size_t)u), color, 3);
    }
}

static void draw_box(struct show *s, const struct map *m, const dar_box *box, const uint8_t color[3])
{
    const int up = s->b->meta.z_up ? 2 : 1, side = 3 - up;
    double corner[4][3];
    for (int i = 0; i < 4; i++) {
        memcpy(corner[i], box->lo, sizeof corner[i]);
        corner[i][0] = i == 1 || i == 2 ? box->hi[0] : box->lo[0];
        corner[i][side] = i >= 2 ? box->hi[side] : box->lo[side];
    }
    for (int i = 0; i < 4; i++) draw_line(s, m, corner[i], corner[(i + 1) % 4], color);
}

static dar_status paint_path(struct show *s, int family, dar_err *e)
{
    static const uint8_t way[3] = { 90, 110, 150 }, surface[3] = { 110, 200, 120 }, view[3] = { 255, 190, 70 };
    const dar_view *now = &s->b->cameras.view[s->frame];
    const struct map m = map_of(s);
    double a[3], b[3], d[3], centre[3], far = 0;
    dar_box box;
    (void)family, (void)e;
    memset(s->rgb, 0, 3 * s->pixels);
    for (size_t t = 1; t < s->b->cameras.frames; t++) {
        place_of(&s->b->cameras.view[t - 1], a);
        place_of(&s->b->cameras.view[t], b);
        draw_line(s, &m, a, b, way);
    }
    place_of(now, a);
    if (box_of(s, &box)) {
        draw_box(s, &m, &box, surface);
        for (int k = 0; k < 3; k++) {
            centre[k] = (box.lo[k] + box.hi[k]) / 2;
            far += (centre[k] - a[k]) * now->c2w[4 * k + 2];
        }
    }
    for (int edge = 0; edge < 2; edge++) { /* left and right edge of the picture, as deep as the box */
        double x = ((edge ? now->width : 0) - now->cx) / now->fx;
        for (int k = 0; k < 3; k++) {
            d[k] = x * now->c2w[4 * k] + now->c2w[4 * k + 2];
            b[k] = a[k] + fmax(far, 0.1 * (double)s->height / m.scale) * d[k];
        }
        draw_line(s, &m, a, b, view);
    }
    return DAR_OK;
}

/* ---------------------------------------------------------------- rows */

struct row {
    const char *name;
    paint_fn *paint;
    int family; /* or component of rays */
    dar_shrink shrink;
    char note[128];
};

#define MOST_ROWS (DAR_BUNDLE_FAMILIES + 5)

static const struct row families[DAR_BUNDLE_FAMILIES] = {
    { "tracking", paint_colors, DAR_FAMILY_TRACKING, DAR_SHRINK_MEAN,
      "which point of a surface: one color each, always" },
    { "world", paint_world, DAR_FAMILY_WORLD, DAR_SHRINK_MEAN,
      "where it is in the scene: x, y, z as red, green, blue" },
    { "normal", paint_normal, DAR_FAMILY_NORMAL, DAR_SHRINK_MEAN, "where it faces: x, y, z; -1 is dark, 1 bright" },
    { "depth", paint_grey, DAR_FAMILY_DEPTH, DAR_SHRINK_MEAN, "" },
    { "mask", paint_grey, DAR_FAMILY_MASK, DAR_SHRINK_MEAN, "white: a surface" },
    { "sparse", paint_colors, DAR_FAMILY_SPARSE, DAR_SHRINK_BRIGHTEST, "" },
    { "id", paint_numbers, DAR_BUNDLE_ID, DAR_SHRINK_MEAN, "" },
    { "part", paint_numbers, DAR_BUNDLE_PART, DAR_SHRINK_MEAN, "pieces that hang together" },
};

static void note_of(const struct show *s, struct row *r)
{
    if (r->family == DAR_FAMILY_DEPTH)
        snprintf(r->note, sizeof r->note, "near is bright: %.3g to %.3g", s->depth[0], s->depth[1]);
    if (r->family == DAR_FAMILY_SPARSE)
        snprintf(r->note, sizeof r->note, "%zu points followed, where they are seen", s->b->tracks);
    if (r->family == DAR_BUNDLE_ID && s->b->meta.objects)
        snprintf(r->note, sizeof r->note, "%zu object%s", s->b->meta.objects, s->b->meta.objects == 1 ? "" : "s");
}

static size_t list_rows(const struct show *s, struct row *row)
{
    size_t n = 0;
    if (s->b->rgb) row[n++] = (struct row){ "rgb", paint_rgb, 0, DAR_SHRINK_MEAN, "the picture to learn" };
    for (int f = 0; f < DAR_BUNDLE_FAMILIES; f++) {
        if (!dar_bundle_has(s->b, f)) continue;
        row[n] = families[f];
        note_of(s, &row[n++]);
    }
    row[n++] =
        (struct row){ "path", paint_path, 0, DAR_SHRINK_BRIGHTEST, "from above: camera, its view, box of the scene" };
    row[n++] = (struct row){ "ray", paint_rays, RAY_DIRECTION, DAR_SHRINK_MEAN,
                             "direction, seen from camera 0: x right, y down, z ahead" };
    row[n] = (struct row){ "moment", paint_rays, RAY_MOMENT, DAR_SHRINK_MEAN, "" };
    snprintf(row[n++].note, sizeof row->note, "place x direction; grey: 0, full: %.3g", s->moment);
    return n;
}

static size_t frame_of(size_t column, size_t columns, size_t frames)
{
    return columns > 1 ? column * (frames - 1) / (columns - 1) : 0;
}

/* ---------------------------------------------------------------- what is known before */

/* Largest moment of any ray: of the place farthest from camera 0. */
static double largest_moment(const dar_camera_path *p)
{
    double most = 0;
    for (size_t t = 0; t < p->frames; t++) {
        double d = 0;
        for (int k = 3; k < 12; k += 4) d += pow(p->view[t].c2w[k] - p->view[0].c2w[k], 2);
        most = fmax(most, sqrt(d));
    }
    return most;
}

/* cover of the frame: from the mask, else from the depth, else all. */
static dar_status find_cover(struct show *s, dar_err *e)
{
    dar_family f = dar_bundle_has(s->b, DAR_FAMILY_MASK) ? DAR_FAMILY_MASK : DAR_FAMILY_DEPTH;
    memset(s->cover, 1, s->pixels);
    if (!dar_bundle_has(s->b, f)) return DAR_OK;
    DAR_TRY(dar_bundle_values(s->b, f, s->frame, s->x, e));
    for (size_t i = 0; i < s->pixels; i++) s->cover[i] = s->x[i] > 0;
    return DAR_OK;
}

/* Where meta.json does not tell the range of depth: that of the frames shown. */
static dar_status find_depth(struct show *s, size_t columns, dar_err *e)
{
    memcpy(s->depth, s->b->meta.depth, sizeof s->depth);
    if (isfinite(s->depth[0]) && isfinite(s->depth[1])) return DAR_OK;
    s->depth[0] = INFINITY, s->depth[1] = 0;
    for (size_t c = 0; c < columns && dar_bundle_has(s->b, DAR_FAMILY_DEPTH); c++) {
        s->frame = frame_of(c, columns, s->b->meta.frames);
        DAR_TRY(dar_bundle_values(s->b, DAR_FAMILY_DEPTH, s->frame, s->x, e));
        for (size_t i = 0; i < s->pixels; i++) {
            if (!(s->x[i] > 0)) continue;
            s->depth[0] = fmin(s->depth[0], s->x[i]);
            s->depth[1] = fmax(s->depth[1], s->x[i]);
        }
    }
    if (!(s->depth[0] <= s->depth[1])) s->depth[0] = s->depth[1] = 0;
    return DAR_OK;
}

static dar_status show_init(struct show *s, dar_bundle *b, size_t columns, dar_err *e)
{
    *s = (struct show){ .b = b, .width = (size_t)b->meta.width, .height = (size_t)b->meta.height };
    s->pixels = s->width * s->height;
    s->x = malloc(3 * s->pixels * sizeof *s->x);
    s->id = malloc(s->pixels * sizeof *s->id);
    s->cover = malloc(s->pixels);
    s->rgb = malloc(3 * s->pixels);
    if (!s->x || !s->id || !s->cover || !s->rgb)
        return dar_fail(e, DAR_ERR_NOMEM, "%s: pictures of %zu x %zu pixels: out of memory", o.out, s->width,
                        s->height);
    s->moment = largest_moment(&b->cameras);
    return find_depth(s, columns, e);
}

static void show_free(struct show *s)
{
    free(s->x);
    free(s->id);
    free(s->cover);
    free(s->rgb);
}

/* ---------------------------------------------------------------- the sheet */

static void describe(const dar_bundle *b, char *title, char *text, size_t size)
{
    const dar_bundle_meta *m = &b->meta;
    int n = snprintf(text, size, "%zu frames of %d x %d, %.4g/s", m->frames, m->width, m->height, m->fps);
    const struct {
        const char *what, *value;
    } known[] = { { "camera", m->trajectory }, { "animation", m->animation }, { "from", m->source } };
    for (size_t i = 0; i < DAR_COUNT(known); i++)
        if (known[i].value && n < (int)size)
            n += snprintf(text + n, size - (size_t)n, ", %s %s", known[i].what, known[i].value);
    const char *end = title + strlen(title);
    while (end > title + 1 && end[-1] == '/') title[--end - title] = 0;
}

static dar_status fill(struct show *s, dar_sheet *sheet, struct row *row, size_t rows, size_t columns, dar_err *e)
{
    size_t first = s->b->reference;
    for (size_t r = 0; r < rows; r++) dar_sheet_row(sheet, first + r, row[r].name, row[r].note);
    if (first) {
        DAR_TRY(dar_bundle_reference(s->b, s->rgb, e));
        dar_sheet_row(sheet, 0, "reference", "what it shall look like");
        dar_sheet_picture(sheet, 0, 0, s->rgb, s->width, s->height, DAR_SHRINK_MEAN);
    }
    for (size_t c = 0; c < columns; c++) {
        char text[32];
        s->frame = frame_of(c, columns, s->b->meta.frames);
        snprintf(text, sizeof text, "frame %zu", s->frame);
        dar_sheet_column(sheet, c, text);
        DAR_TRY(find_cover(s, e));
        for (size_t r = 0; r < rows; r++) {
            DAR_TRY(row[r].paint(s, row[r].family, e));
            dar_sheet_picture(sheet, first + r, c, s->rgb, s->width, s->height, row[r].shrink);
        }
    }
    return DAR_OK;
}

static dar_status draw(dar_bundle *b, const char *path, dar_run *r, dar_err *e)
{
    struct show s;
    struct row row[MOST_ROWS];
    dar_sheet sheet = { 0 };
    char title[256], subtitle[512];
    size_t columns = b->meta.frames < (size_t)o.columns ? b->meta.frames : (size_t)o.columns;
    dar_status status = show_init(&s, b, columns, e);
    size_t rows = list_rows(&s, row);
    snprintf(title, sizeof title, "%s", path);
    describe(b, title, subtitle, sizeof subtitle);
    const char *slash = strrchr(title, '/');
    dar_sheet_plan plan = { slash ? slash + 1 : title, subtitle, rows + b->reference, columns, (size_t)o.width, 0 };
    plan.height = (size_t)fmax(1, floor((double)plan.width * b->meta.height / b->meta.width + 0.5));
    if (status == DAR_OK) status = dar_sheet_init(&sheet, &plan, e);
    if (status == DAR_OK && !o.common.dry_run) status = fill(&s, &sheet, row, rows, columns, e);
    if (status == DAR_OK && !o.common.dry_run) status = dar_sheet_write(&sheet, o.out, e);
    if (status == DAR_OK) {
        dar_run_say(r, "%s: %zu x %zu px, %zu rows, %zu moments", o.out, sheet.width, sheet.height, plan.rows, columns);
        dar_json_write_text(&r->json, "sheet", o.out);
        dar_json_write_int(&r->json, "width", (int64_t)sheet.width);
        dar_json_write_int(&r->json, "height", (int64_t)sheet.height);
        dar_json_write_int(&r->json, "rows", (int64_t)plan.rows);
    }
    dar_sheet_free(&sheet);
    show_free(&s);
    return status;
}

static dar_status show(dar_run *r, dar_err *e)
{
    const char *path = r->program->rest[0];
    dar_bundle *b;
    if (!o.out) return dar_fail(e, DAR_ERR_USAGE, "%s: expected -o PNG", r->program->name);
    DAR_TRY(dar_bundle_open(&b, path, e));
    dar_status s = draw(b, path, r, e);
    dar_bundle_close(b);
    return s;
}

const dar_program dar_command_show = {
    .name = "dar-bundle show",
    .summary = "Draw a contact sheet of a bundle: every family at several moments.",
    .options = options,
    .n_options = DAR_COUNT(options),
    .common = &o.common,
    .run = show,
    .rest_name = "BUNDLE",
    .rest_help = "directory to show",
    .rest_least = 1,
    .rest_most = 1,
};
