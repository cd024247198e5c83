/* sheet.c: layout, scaling, and a font of 5 x 8 pixels. */
#include "data/sheet.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "data/image.h"
#include "data/png.h"

#define MARGIN 16  /* [px] around everything */
#define GAP    6   /* between cells */
#define LABELS 212 /* width of the words left of the rows */
#define ROOM   10  /* between them and the first cell */

static const uint8_t paper[3] = { 30, 32, 38 }, bright[3] = { 236, 238, 242 }, dim[3] = { 150, 156, 168 };

/* ---------------------------------------------------------------- words */

/* '!' to '~': 40 bits each, row by row from the top, the first pixel in the highest bit. */
/* clang-format off */
static const uint64_t font[94] = {
    0x2108420080, 0x5294000000, 0x52beafa940, 0x23e8e2f880, 0xc644444c60, 0x64a88ac9a0, /* !"#$%& */
    0x2110000000, 0x1110841040, 0x4104211100, 0x012aea9000, 0x0109f21000, 0x0000003088, /* '()*+, */
    0x0001f00000, 0x0000003180, 0x0044444000, 0x74675cc5c0, 0x23084211c0, 0x74422223e0, /* -./012 */
    0xf88820c5c0, 0x11952f8840, 0xfc3c10c5c0, 0x3221e8c5c0, 0xf844442100, 0x7462e8c5c0, /* 345678 */
    0x7462f08980, 0x0318063000, 0x0018c03088, 0x1111041040, 0x003e0f8000, 0x4104111100, /* 9:;<=> */
    0x7442220080, 0x746f5bc1c0, 0x7463f8c620, 0xf463e8c7c0, 0x74610845c0, 0xf46318c7c0, /* ?@ABCD */
    0xfc21e843e0, 0xfc21e84200, 0x746178c5e0, 0x8c63f8c620, 0x71084211c0, 0x3884214980, /* EFGHIJ */
    0x8ca98a4a20, 0x84210843e0, 0x8eeb58c620, 0x8c7359c620, 0x746318c5c0, 0xf463e84200, /* KLMNOP */
    0x74631ac9a0, 0xf463ea4a20, 0x7c20e087c0, 0xf908421080, 0x8c6318c5c0, 0x8c6318a880, /* QRSTUV */
    0x8c635ad540, 0x8c54454620, 0x8c62a21080, 0xf8444443e0, 0x72108421c0, 0x0410410400, /* WXYZ[\ */
    0x70842109c0, 0x22a2000000, 0x000000001f, 0x4104000000, 0x001c17c5e0, 0x842d98c7c0, /* ]^_`ab */
    0x001d0845c0, 0x085b38c5e0, 0x001d1fc1c0, 0x3251c42100, 0x001f18bc2e, 0x842d98c620, /* cdefgh */
    0x20184211c0, 0x100c210a4c, 0x84254c5240, 0x61084211c0, 0x00355ac620, 0x002d98c620, /* ijklmn */
    0x001d18c5c0, 0x002d98fa10, 0x001b38bc21, 0x002d984200, 0x001d0707c0, 0x42388424c0, /* opqrst */
    0x002318cda0, 0x002318a880, 0x00231ad540, 0x0022a22a20, 0x002318bc2e, 0x003e2223e0, /* uvwxyz */
    0x1108821040, 0x2108421080, 0x4108221100, 0x0011510000, /* {|}~ */
};
/* clang-format on */

#define ADVANCE 6  /* from character to character, and */
#define LEADING 10 /* from line to line, in pixels of the font */

static void put_char(dar_sheet *s, size_t x, size_t y, size_t scale, const uint8_t color[3], char c)
{
    uint64_t bits = c == ' ' ? 0 : font[(c > ' ' && c <= '~' ? c : '?') - '!'];
    for (size_t i = 0; i < 40 * scale * scale; i++) {
        size_t u = i % (5 * scale), v = i / (5 * scale);
        if (!(bits >> (39 - (v / scale * 5 + u / scale)) & 1) || x + u >= s->width || y + v >= s->height) continue;
        memcpy(s->rgb + 3 * ((y + v) * s->width + x + u), color, 3);
    }
}

/* Up to `most` bytes; a character of several bytes is shown once. */
static void put_text(dar_sheet *s, size_t x, size_t y, size_t scale, const uint8_t color[3], const char *text,
                     size_t most)
{
    for (size_t i = 0; i < most && text[i]; i++) {
        if (((unsigned char)text[i] & 0xc0) == 0x80) continue;
        put_char(s, x, y, scale, color, text[i]);
        x += ADVANCE * scale;
    }
}

/* Bytes of the first line of text that is at most `most` characters long, broken at a space if there is one. */
static size_t line_of(const char *text, size_t most)
{
    size_t n = strcspn(text, "\n");
    if (n <= most) return n;
    for (n = most; n > 0 && text[n] != ' '; n--) {
    }
    return n ? n : most;
}

/* Lines within `width` and above `bottom`. */
static void put_lines(dar_sheet *s, size_t x, size_t y, size_t width, size_t bottom, const char *text)
{
    const size_t scale = 2;
    size_t most = width / (ADVANCE * scale);
    for (; *text && y + 8 * scale <= bottom; y += LEADING * scale) {
        size_t n = line_of(text, most ? most : 1);
        put_text(s, x, y, scale, dim, text, n);
        text += n;
        text += *text == ' ' || *text == '\n';
    }
}

/* ---------------------------------------------------------------- layout */

dar_status dar_sheet_init(dar_sheet *s, const dar_sheet_plan *plan, dar_err *e)
{
    *s = (dar_sheet){ .plan = *plan, .top = MARGIN };
    DAR_ASSERT(plan->rows && plan->columns && plan->width && plan->height, "sheet: %zu x %zu cells of %zu x %zu px",
               plan->rows, plan->columns, plan->width, plan->height);
    if (plan->title) s->top += 3 * LEADING + 4;
    if (plan->subtitle) s->top += 2 * LEADING + 4;
    s->top += 2 * LEADING + 8; /* names of the columns */
    const size_t most = DAR_IMAGE_MAX_SIDE, columns = plan->columns, rows = plan->rows;
    bool fits = columns < most && rows < most && plan->width < most && plan->height < most;
    s->width = 2 * MARGIN + LABELS + ROOM + columns * (plan->width + GAP) - GAP;
    s->height = s->top + MARGIN + rows * (plan->height + GAP) - GAP;
    dar_status status = DAR_OK;
    if (!fits || s->width > most || s->height > most)
        status = dar_fail(e, DAR_ERR_USAGE, "sheet: %zu x %zu pictures of %zu x %zu px make more than %zu px", columns,
                          rows, plan->width, plan->height, most);
    else if (!(s->rgb = malloc(3 * s->width * s->height)))
        status = dar_fail(e, DAR_ERR_NOMEM, "sheet of %zu x %zu px: out of memory", s->width, s->height);
    if (status != DAR_OK) {
        *s = (dar_sheet){ 0 };
        return status;
    }
    for (size_t i = 0; i < s->width * s->height; i++) memcpy(s->rgb + 3 * i, paper, 3);
    if (plan->title) put_text(s, MARGIN, MARGIN, 3, bright, plan->title, SIZE_MAX);
    if (plan->subtitle) put_lines(s, MARGIN, s->top - 4 * LEADING - 12, s->width, s->top - 2 * LEADING, plan->subtitle);
    return DAR_OK;
}

void dar_sheet_free(dar_sheet *s)
{
    free(s->rgb);
    *s = (dar_sheet){ 0 };
}

static void cell(const dar_sheet *s, size_t row, size_t column, size_t *x, size_t *y)
{
    DAR_ASSERT(row < s->plan.rows && column < s->plan.columns, "sheet: cell %zu, %zu of %zu x %zu", row, column,
               s->plan.rows, s->plan.columns);
    *x = MARGIN + LABELS + ROOM + column * (s->plan.width + GAP);
    *y = s->top + row * (s->plan.height + GAP);
}

void dar_sheet_row(dar_sheet *s, size_t row, const char *name, const char *note)
{
    size_t x, y, scale = strlen(name) * ADVANCE * 3 <= LABELS ? 3 : 2;
    cell(s, row, 0, &x, &y);
    put_text(s, MARGIN, y, scale, bright, name, LABELS / (ADVANCE * scale));
    y += scale * LEADING + 4;
    if (note) put_lines(s, MARGIN, y, LABELS, s->top + row * (s->plan.height + GAP) + s->plan.height, note);
}

void dar_sheet_column(dar_sheet *s, size_t column, const char *name)
{
    size_t x, y;
    cell(s, 0, column, &x, &y);
    put_text(s, x, y - 2 * LEADING, 2, dim, name, s->plan.width / (ADVANCE * 2));
}

void dar_sheet_words(dar_sheet *s, size_t row, size_t column, const char *words)
{
    size_t x, y;
    cell(s, row, column, &x, &y);
    put_lines(s, x, y, s->plan.width, y + s->plan.height, words);
}

/* ---------------------------------------------------------------- pictures */

/* Pixels [x0, x1) x [y0, y1) of a picture, whose bounds may lie inside pixels, as one. */
static void mean_of(const uint8_t *rgb, size_t width, const double at[4], uint8_t *y)
{
    double sum[3] = { 0 }, area = (at[1] - at[0]) * (at[3] - at[2]);
    for (double v = floor(at[2]); v < at[3]; v++)
        for (double u = floor(at[0]); u < at[1]; u++) {
            double share = (fmin(u + 1, at[1]) - fmax(u, at[0])) * (fmin(v + 1, at[3]) - fmax(v, at[2]));
            for (size_t c = 0; c < 3; c++) sum[c] += share * rgb[3 * ((size_t)v * width + (size_t)u) + c];
        }
    for (int c = 0; c < 3; c++) y[c] = (uint8_t)(sum[c] / area + 0.5);
}

static void brightest_of(const uint8_t *rgb, size_t width, const double at[4], uint8_t *y)
{
    int most = -1;
    for (double v = floor(at[2]); v < at[3]; v++)
        for (double u = floor(at[0]); u < at[1]; u++) {
            const uint8_t *p = rgb + 3 * ((size_t)v * width + (size_t)u);
            int sum = p[0] + p[1] + p[2];
            if (sum > most) memcpy(y, p, 3);
            most = sum > most ? sum : most;
        }
}

void dar_sheet_picture(dar_sheet *s, size_t row, size_t column, const uint8_t *rgb, size_t width, size_t height,
                       dar_shrink shrink)
{
    size_t left, top;
    double scale = fmin((double)s->plan.width / (double)width, (double)s->plan.height / (double)height);
    size_t w = (size_t)fmax(1, (double)width * scale + 1e-9), h = (size_t)fmax(1, (double)height * scale + 1e-9);
    double dx = (double)width / (double)w, dy = (double)height / (double)h;
    cell(s, row, column, &left, &top);
    left += (s->plan.width - w) / 2;
    top += (s->plan.height - h) / 2;
    for (size_t v = 0; v < h; v++)
        for (size_t u = 0; u < w; u++) {
            const double at[4] = { (double)u * dx, fmin((double)(u + 1) * dx, (double)width), (double)v * dy,
                                   fmin((double)(v + 1) * dy, (double)height) };
            uint8_t *y = s->rgb + 3 * ((top + v) * s->width + left + u);
            (shrink == DAR_SHRINK_MEAN ? mean_of : brightest_of)(rgb, width, at, y);
        }
}

dar_status dar_sheet_write(const dar_sheet *s, const char *path, dar_err *e)
{
    return dar_png_write(path, s->width, s->height, 3, s->rgb, e);
}
