/* plot.c: see plot.h. */
#include "lib/plot.h"

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "lib/file.h"

#define TICKS   64    /* at most on an axis, unlabelled ones included */
#define TEXT    12.0  /* height of letters [px] */
#define ROW     18.0  /* of the legend [px] */
#define RADIUS  3.5   /* of a point [px] */
#define LARGEST 1e300 /* a value; differences are finite then */
#define CLOUD   2000  /* points; more are drawn small, without what they say */

/* Told apart by people who see colours differently, after Okabe and Ito 2008. */
static const char *const palette[] = { "#0072b2", "#d55e00", "#009e73", "#b04a8f",
                                       "#e69f00", "#56b4e9", "#8c613c", "#666666" };

/* Of lines, one for each time that the palette repeats. */
static const char *const dashes[] = { "", " stroke-dasharray=\"7 3\"", " stroke-dasharray=\"2 3\"",
                                      " stroke-dasharray=\"8 3 2 3\"" };

/* Values of an axis, or their logarithms, from lo to hi, lie from px to px. */
typedef struct scale {
    bool log;
    double lo, hi, from, to;
} scale;

typedef struct picture {
    const dar_plot *p;
    FILE *f;
    scale x, y;
} picture;

static bool shown(const scale *s, double v)
{
    return fabs(v) <= LARGEST && (!s->log || v > 0);
}

static double place(const scale *s, double v)
{
    return s->from + ((s->log ? log10(v) : v) - s->lo) / (s->hi - s->lo) * (s->to - s->from);
}

static const char *colour(const dar_plot_series *s)
{
    return palette[(unsigned)s->colour % DAR_COUNT(palette)];
}

static const char *dash(const dar_plot_series *s)
{
    return dashes[(unsigned)s->colour / DAR_COUNT(palette) % DAR_COUNT(dashes)];
}

/* ---------------------------------------------------------------- text */

static void put_escaped(FILE *f, const char *text)
{
    for (; *text; text++) {
        const char *as = *text == '&' ? "&amp;" : *text == '<' ? "&lt;" : *text == '>' ? "&gt;" : NULL;
        if (as) fputs(as, f);
        else if ((unsigned char)*text >= 0x20) fputc(*text, f);
    }
}

/* Width of a text [px] in DejaVu Sans, the widest of the fonts that are likely: hundredths of an em from space to
 * tilde, a whole one for any other character. */
static double width_of(const char *text)
{
    static const uint8_t advance[95] = {
        32, 41, 46, 84, 64, 96, 78, 28, 40,  40, 50, 84, 32, 37, 32, 34, 64, 64, 64, 64, 64, 64, 64, 64,
        64, 64, 34, 34, 84, 84, 84, 54, 100, 69, 69, 70, 78, 64, 58, 78, 76, 30, 30, 66, 56, 87, 75, 79,
        61, 79, 70, 64, 62, 74, 69, 99, 69,  62, 69, 40, 34, 40, 84, 50, 50, 62, 64, 55, 64, 62, 36, 64,
        64, 28, 28, 58, 28, 98, 64, 62, 64,  64, 42, 53, 40, 64, 60, 82, 60, 60, 53, 64, 34, 64, 84,
    };
    unsigned sum = 0;
    for (; *text; text++) {
        unsigned char c = (unsigned char)*text;
        if (c >= ' ' && c <= '~') sum += advance[c - ' '];
        else if ((c & 0xc0) == 0xc0) sum += 100; /* the first byte of a character */
    }
    return TEXT * sum / 100;
}

static void put_text(const picture *c, double x, double y, const char *how, const char *text)
{
    fprintf(c->f, "<text x=\"%.1f\" y=\"%.1f\"%s>", x, y, how);
    put_escaped(c->f, text);
    fputs("</text>\n", c->f);
}

/* 10 to a power, with its digits raised. */
static void raised(int power, char *buf, size_t size)
{
    static const char *const digit[] = {
        "\xe2\x81\xb0", "\xc2\xb9",     "\xc2\xb2",     "\xc2\xb3",     "\xe2\x81\xb4",
        "\xe2\x81\xb5", "\xe2\x81\xb6", "\xe2\x81\xb7", "\xe2\x81\xb8", "\xe2\x81\xb9"
    };
    char digits[16];
    size_t n = (size_t)snprintf(buf, size, "10%s", power < 0 ? "\xe2\x81\xbb" : "");
    snprintf(digits, sizeof digits, "%d", abs(power));
    for (const char *d = digits; *d && n < size; d++) n += (size_t)snprintf(buf + n, size - n, "%s", digit[*d - '0']);
}

/* A round number: 0.05, 300, 20k, 1.5M, 2 x 10^-4; in thousands or millions if the largest beside it is. */
static void number(double v, double step, double largest, char buf[64])
{
    double a = fabs(v);
    int power = a > 0 ? (int)floor(log10(a) + 1e-9) : 0, decimals = (int)fmax(0, -floor(log10(step) + 1e-9));
    if (a > 0 && (power < -3 || power > 8)) {
        char ten[40];
        double digits = v / pow(10, power);
        raised(power, ten, sizeof ten);
        if (fabs(digits - 1) < 1e-9) snprintf(buf, 64, "%s", ten);
        else snprintf(buf, 64, "%.3g\xc2\xb7%s", digits, ten);
    } else if (a > 0 && largest >= 1e6) {
        snprintf(buf, 64, "%.6gM", v / 1e6);
    } else if (a > 0 && largest >= 1e4) {
        snprintf(buf, 64, "%.6gk", v / 1e3);
    } else {
        snprintf(buf, 64, "%.*f", decimals, a > 0 ? v : 0);
    }
}

/* ---------------------------------------------------------------- axes */

/* Take v into lo .. hi, in the units of the scale. */
static void reach(scale *s, double v)
{
    if (!shown(s, v)) return;
    double u = s->log ? log10(v) : v;
    s->lo = fmin(s->lo, u);
    s->hi = fmax(s->hi, u);
}

static void reach_all(const dar_plot *p, scale *x, scale *y)
{
    for (size_t i = 0; i < p->n; i++) {
        const dar_plot_series *s = &p->series[i];
        for (size_t k = 0; k < s->n; k++) {
            if (!shown(x, s->x[k]) || !shown(y, s->y[k])) continue;
            reach(x, s->x[k]);
            reach(y, s->y[k]);
            if (s->lo) reach(y, s->lo[k]);
            if (s->hi) reach(y, s->hi[k]);
        }
    }
}

/* What the caller says, else a little more than the data; never empty. */
static void settle(scale *s, const dar_plot_axis *a, double margin)
{
    bool given = a->lo < a->hi && (!a->log || a->lo > 0);
    if (given) {
        s->lo = a->log ? log10(a->lo) : a->lo;
        s->hi = a->log ? log10(a->hi) : a->hi;
        return;
    }
    if (!(s->lo <= s->hi)) s->lo = 0, s->hi = 1;
    double span = s->hi - s->lo;
    if (span <= 1e-12 * fmax(fabs(s->lo), fabs(s->hi)) || span < 1 / LARGEST) {
        span = s->log ? 0.5 : fmax(fabs(s->lo), 1) / 5;
        s->lo -= span;
        s->hi += span;
        return;
    }
    bool from_zero = !s->log && s->lo >= 0 && s->lo < 0.2 * s->hi;
    s->lo = from_zero ? 0 : s->lo - margin * span;
    s->hi += margin * span;
}

typedef struct tick {
    double at;
    bool label;
} tick;

typedef struct ticks {
    tick t[TICKS];
    int n;
    double step; /* between two of them, at the least; says how many decimals */
} ticks;

static void add_tick(ticks *k, const scale *s, double v, bool label)
{
    double u = s->log ? log10(v) : v, slack = 1e-9 * (s->hi - s->lo);
    if (u >= s->lo - slack && u <= s->hi + slack && k->n < TICKS) k->t[k->n++] = (tick){ v, label };
}

/* Multiples of 1, 2 or 5 times a power of ten between lo and hi: about `most` of them. */
static void linear_ticks(ticks *k, const scale *s, double lo, double hi, double most)
{
    double raw = (hi - lo) / fmax(most, 1), ten = pow(10, floor(log10(raw))), r = raw / ten;
    k->step = ten * (r <= 1 ? 1 : r <= 2 ? 2 : r <= 5 ? 5 : 10);
    double first = ceil(lo / k->step - 1e-9);
    for (int i = 0; i < TICKS && (first + i) * k->step <= hi + 1e-9 * (hi - lo); i++)
        add_tick(k, s, (first + i) * k->step, true);
}

/* Powers of ten; between them 2 and 5 where there is room, and the rest without number. */
static void log_ticks(ticks *k, const scale *s, double most)
{
    double decades = s->hi - s->lo;
    int every = (int)ceil(decades / fmax(most, 1));
    for (int power = (int)floor(s->lo); power <= (int)ceil(s->hi); power++)
        for (int digit = 1; digit < 10; digit++) {
            bool round = digit == 1 ? power % every == 0 : decades * 3 <= most && (digit == 2 || digit == 5);
            if (digit == 1 || decades < 5) add_tick(k, s, digit * pow(10, power), round);
        }
    k->step = pow(10, floor(s->lo));
}

static ticks ticks_of(const scale *s, double spacing)
{
    ticks k = { .n = 0 };
    double most = fabs(s->to - s->from) / spacing;
    if (!s->log) linear_ticks(&k, s, s->lo, s->hi, most);
    else if (s->hi - s->lo < 0.7) linear_ticks(&k, s, pow(10, s->lo), pow(10, s->hi), most);
    else log_ticks(&k, s, most);
    return k;
}

static void tick_text(const scale *s, const ticks *k, double v, char buf[64])
{
    bool decade = s->log && s->hi - s->lo >= 0.7;
    double largest = decade || !k->n ? v : fmax(fabs(k->t[0].at), fabs(k->t[k->n - 1].at));
    number(v, decade ? v : k->step, largest, buf);
}

/* Lines of the grid and their numbers. */
static void put_axis(const picture *c, const scale *s, const ticks *k, bool across)
{
    char text[64];
    for (int i = 0; i < k->n; i++) {
        double at = place(s, k->t[i].at), x = across ? c->x.from : at, y = across ? at : c->y.from;
        fprintf(c->f, "<path d=\"M%.1f %.1f%s%.1f\" stroke=\"%s\"/>\n", x, y, across ? "H" : "V",
                across ? c->x.to : c->y.to, k->t[i].label ? "#dedede" : "#f1f1f1");
        if (!k->t[i].label) continue;
        tick_text(s, k, k->t[i].at, text);
        if (across) put_text(c, x - 8, y + 4, " text-anchor=\"end\"", text);
        else put_text(c, x, y + 18, " text-anchor=\"middle\"", text);
    }
}

/* ---------------------------------------------------------------- series */

/* A line through the points, broken where one is not shown.  Of more than two points in a column of pixels only the
 * first, lowest, highest and last are drawn. */
static void put_line(const picture *c, const dar_plot_series *s)
{
    bool pen = false, thin = (double)s->n > 2 * fabs(c->x.to - c->x.from);
    fprintf(c->f, "<path fill=\"none\" stroke=\"%s\" stroke-width=\"%s\"%s%s stroke-linejoin=\"round\" d=\"", colour(s),
            s->faint ? "1" : "2", s->faint ? " stroke-opacity=\".3\"" : "", dash(s));
    for (size_t i = 0; i < s->n;) {
        if (!shown(&c->x, s->x[i]) || !shown(&c->y, s->y[i])) {
            pen = false;
            i++;
            continue;
        }
        double x = place(&c->x, s->x[i]), y = place(&c->y, s->y[i]), low = y, high = y, last = y;
        size_t k = i + 1;
        for (; thin && k < s->n && shown(&c->x, s->x[k]) && shown(&c->y, s->y[k]); k++) {
            if (floor(place(&c->x, s->x[k])) != floor(x)) break;
            last = place(&c->y, s->y[k]);
            low = fmin(low, last);
            high = fmax(high, last);
        }
        fprintf(c->f, "%s%.1f %.1f", pen ? "L" : "M", x, y);
        if (k > i + 1) fprintf(c->f, "V%.1fV%.1fV%.1f", low, high, last);
        pen = true;
        i = k;
    }
    fputs("\"/>\n", c->f);
}

/* Whether point i has a bar whose ends can be drawn. */
static bool has_bar(const picture *c, const dar_plot_series *s, size_t i)
{
    return s->lo && s->hi && shown(&c->x, s->x[i]) && shown(&c->y, s->lo[i]) && shown(&c->y, s->hi[i]);
}

/* One shape per stretch without gap: there along the upper ends, back along the lower ones. */
static void put_band(const picture *c, const dar_plot_series *s)
{
    for (size_t i = 0, end; i < s->n; i = end + 1) {
        for (end = i; end < s->n && has_bar(c, s, end);) end++;
        if (end == i) continue;
        fprintf(c->f, "<path fill=\"%s\" fill-opacity=\".15\" d=\"", colour(s));
        for (size_t k = i; k < end; k++)
            fprintf(c->f, "%s%.1f %.1f", k == i ? "M" : "L", place(&c->x, s->x[k]), place(&c->y, s->hi[k]));
        for (size_t k = end; k-- > i;) fprintf(c->f, "L%.1f %.1f", place(&c->x, s->x[k]), place(&c->y, s->lo[k]));
        fputs("Z\"/>\n", c->f);
    }
}

static void put_bars(const picture *c, const dar_plot_series *s)
{
    fprintf(c->f, "<path stroke=\"%s\" stroke-opacity=\".6\" d=\"", colour(s));
    for (size_t i = 0; i < s->n; i++) {
        if (!has_bar(c, s, i)) continue;
        double x = place(&c->x, s->x[i]), lo = place(&c->y, s->lo[i]), hi = place(&c->y, s->hi[i]);
        fprintf(c->f, "M%.1f %.1fh6m-3 0V%.1fm-3 0h6", x - 3, lo, hi);
    }
    fputs("\"/>\n", c->f);
}

static void put_point(const picture *c, const dar_plot_series *s, size_t i)
{
    double x = place(&c->x, s->x[i]), y = place(&c->y, s->y[i]);
    fprintf(c->f, "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"%g\" fill=\"%s\"%s><title>", x, y, s->faint ? 1.5 : RADIUS,
            colour(s), s->faint ? " fill-opacity=\".35\"" : " stroke=\"#fff\"");
    if (s->tips) {
        put_escaped(c->f, s->tips[i]);
    } else {
        if (s->names) put_escaped(c->f, s->names[i]);
        fprintf(c->f, "%s%g, %g", s->names ? ": " : "", s->x[i], s->y[i]);
    }
    fputs("</title></circle>\n", c->f);
}

/* One dot per pixel that has a point. */
static bool put_cloud(const picture *c, const dar_plot_series *s)
{
    size_t width = (size_t)(c->x.to - c->x.from) + 1, height = (size_t)(c->y.from - c->y.to) + 1;
    unsigned char *taken = calloc(width, height);
    if (!taken) return false;
    fprintf(c->f, "<path stroke=\"%s\" stroke-width=\"2\" stroke-linecap=\"round\" stroke-opacity=\"%s\" d=\"",
            colour(s), s->faint ? ".25" : ".7");
    for (size_t i = 0; i < s->n; i++) {
        if (!shown(&c->x, s->x[i]) || !shown(&c->y, s->y[i])) continue;
        double x = place(&c->x, s->x[i]) - c->x.from, y = place(&c->y, s->y[i]) - c->y.to;
        if (!(x >= 0 && y >= 0 && x < (double)width && y < (double)height)) continue;
        unsigned char *at = &taken[(size_t)y * width + (size_t)x];
        if (!*at) fprintf(c->f, "M%.1f %.1fh0", x + c->x.from, y + c->y.to);
        *at = 1;
    }
    fputs("\"/>\n", c->f);
    free(taken);
    return true;
}

static void put_names(const picture *c, const dar_plot_series *s)
{
    fputs("<g stroke=\"#fff\" stroke-width=\"3\" stroke-linejoin=\"round\" paint-order=\"stroke\">\n", c->f);
    for (size_t i = 0; i < s->n; i++) {
        if (!shown(&c->x, s->x[i]) || !shown(&c->y, s->y[i])) continue;
        double x = place(&c->x, s->x[i]), y = place(&c->y, s->y[i]);
        bool left = x + 8 + width_of(s->names[i]) > c->x.to;
        put_text(c, left ? x - 7 : x + 7, y - 5, left ? " text-anchor=\"end\"" : "", s->names[i]);
    }
    fputs("</g>\n", c->f);
}

static bool put_series(const picture *c, const dar_plot_series *s)
{
    bool points = s->mark != DAR_PLOT_LINE;
    if (s->lo && s->hi && !points) put_band(c, s);
    if (s->mark != DAR_PLOT_POINTS) put_line(c, s);
    if (s->lo && s->hi && points) put_bars(c, s);
    if (points && s->n > CLOUD) return put_cloud(c, s);
    for (size_t i = 0; points && i < s->n; i++)
        if (shown(&c->x, s->x[i]) && shown(&c->y, s->y[i])) put_point(c, s, i);
    if (s->names) put_names(c, s);
    return true;
}

/* ---------------------------------------------------------------- the whole */

/* The legend in rows from `top`; returns where it ends.  Only measures if c->f is NULL. */
static double put_legend(const picture *c, double left, double right, double top)
{
    double x = left, y = top;
    for (size_t i = 0; i < c->p->n; i++) {
        const dar_plot_series *s = &c->p->series[i];
        if (!s->label) continue;
        double width = 30 + width_of(s->label) + 14;
        if (x > left && x + width > right) x = left, y += ROW;
        if (c->f) {
            const char *pale = s->faint ? " opacity=\".45\"" : "";
            if (s->mark != DAR_PLOT_POINTS)
                fprintf(c->f, "<path d=\"M%.1f %.1fh22\" stroke=\"%s\" stroke-width=\"2\"%s%s/>\n", x, y + 9, colour(s),
                        dash(s), pale);
            if (s->mark != DAR_PLOT_LINE)
                fprintf(c->f, "<circle cx=\"%.1f\" cy=\"%.1f\" r=\"%g\" fill=\"%s\"%s/>\n", x + 11, y + 9, RADIUS,
                        colour(s), pale);
            put_text(c, x + 28, y + 13, "", s->label);
        }
        x += width;
    }
    return x > left ? y + ROW + 6 : y;
}

static double widest(const scale *s, const ticks *k)
{
    char text[64];
    double most = 0;
    for (int i = 0; i < k->n; i++) {
        if (!k->t[i].label) continue;
        tick_text(s, k, k->t[i].at, text);
        most = fmax(most, width_of(text));
    }
    return most;
}

static bool draw(picture *c, double width, double height)
{
    const dar_plot *p = c->p;
    FILE *f = c->f;
    double below = p->x.label ? 48 : 30, legend = p->title ? 38 : 14;
    bool whole = true;

    c->f = NULL; /* where things are depends on the legend, and on the numbers of the other axis */
    double top = put_legend(c, 16, width - 16, legend) + 6;
    c->f = f;
    c->y.from = height - below;
    c->y.to = top;
    ticks up = ticks_of(&c->y, 44);
    c->x.from = widest(&c->y, &up) + (p->y.label ? 42 : 22);
    c->x.to = width - 22;
    ticks right = ticks_of(&c->x, 80);

    fprintf(f,
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"%g\" height=\"%g\" viewBox=\"0 0 %g %g\" "
            "font-family=\"system-ui, 'Helvetica Neue', Arial, sans-serif\" font-size=\"12\" fill=\"#444\">\n"
            "<rect width=\"%g\" height=\"%g\" fill=\"#fff\"/>\n",
            width, height, width, height, width, height);
    if (p->title) put_text(c, 16, 24, " font-size=\"15\" font-weight=\"600\" fill=\"#222\"", p->title);
    put_legend(c, 16, width - 16, legend);
    put_axis(c, &c->y, &up, true);
    put_axis(c, &c->x, &right, false);
    fprintf(f, "<path d=\"M%.1f %.1fH%.1f\" stroke=\"#999\"/>\n", c->x.from, c->y.from, c->x.to);
    if (p->x.label)
        put_text(c, (c->x.from + c->x.to) / 2, height - 12, " text-anchor=\"middle\" fill=\"#222\"", p->x.label);
    if (p->y.label) {
        char how[128];
        double x = 18, y = (c->y.from + c->y.to) / 2;
        snprintf(how, sizeof how, " text-anchor=\"middle\" fill=\"#222\" transform=\"rotate(-90 %.1f %.1f)\"", x, y);
        put_text(c, x, y, how, p->y.label);
    }
    /* An inner picture cuts off what given axes do not hold. */
    double w = c->x.to - c->x.from + 2 * RADIUS, h = c->y.from - c->y.to + 2 * RADIUS;
    fprintf(f, "<svg x=\"%.1f\" y=\"%.1f\" width=\"%.1f\" height=\"%.1f\" viewBox=\"%.1f %.1f %.1f %.1f\">\n",
            c->x.from - RADIUS, c->y.to - RADIUS, w, h, c->x.from - RADIUS, c->y.to - RADIUS, w, h);
    for (size_t i = 0; i < p->n; i++) whole &= put_series(c, &p->series[i]);
    fputs("</svg>\n</svg>\n", f);
    return whole;
}

dar_status dar_plot_text(const dar_plot *p, char **svg, dar_err *e)
{
    size_t size;
    picture c = { .p = p, .f = open_memstream(svg, &size) };
    bool points = false;
    *svg = c.f ? *svg : NULL;
    if (!c.f) return dar_fail(e, DAR_ERR_NOMEM, "plot: out of memory");
    for (size_t i = 0; i < p->n; i++) points |= p->series[i].mark != DAR_PLOT_LINE;
    c.x = (scale){ .log = p->x.log, .lo = INFINITY, .hi = -INFINITY };
    c.y = (scale){ .log = p->y.log, .lo = INFINITY, .hi = -INFINITY };
    reach_all(p, &c.x, &c.y);
    settle(&c.x, &p->x, points ? 0.03 : 0);
    settle(&c.y, &p->y, 0.05);
    bool whole = draw(&c, p->width ? p->width : 720, p->height ? p->height : 420);
    whole &= !ferror(c.f);
    whole &= fclose(c.f) == 0;
    if (whole) return DAR_OK;
    free(*svg);
    *svg = NULL;
    return dar_fail(e, DAR_ERR_NOMEM, "plot: out of memory");
}

dar_status dar_plot_write(const dar_plot *p, const char *path, dar_err *e)
{
    dar_file_out out = { 0 };
    char *svg;
    DAR_TRY(dar_plot_text(p, &svg, e));
    dar_status s = dar_file_create(&out, path, e);
    if (s == DAR_OK) s = dar_file_write(&out, svg, strlen(svg), e);
    if (s == DAR_OK) s = dar_file_commit(&out, e);
    dar_file_discard(&out);
    free(svg);
    return s;
}
