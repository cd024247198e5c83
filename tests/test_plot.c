/* test_plot.c: pictures are well-formed whatever the data, say what they are given, and stay small. */
#include "tests/scratch.h"

#include "lib/plot.h"

/* Tags open and close in pairs, attributes are quoted, nothing is left of a number that was none. */
static void well_formed(const char *svg)
{
    char open[32][16];
    int depth = 0;
    CHECK(!strstr(svg, "nan") && !strstr(svg, "inf"), "a number that is none: %s", svg);
    for (const char *p = svg; (p = strchr(p, '<')); p++) {
        const char *end = p;
        bool quoted = false;
        for (; *end && (*end != '>' || quoted); end++) quoted ^= *end == '"';
        CHECK(*end, "a tag without end");
        size_t name = strcspn(p + 1, " >/");
        if (p[1] == '/') {
            name = strcspn(p + 2, ">");
            CHECK(depth > 0 && strncmp(open[--depth], p + 2, name) == 0, "</%.*s>", (int)name, p + 2);
        } else if (end[-1] != '/') {
            assert_true(depth < 32 && name < 16);
            snprintf(open[depth++], 16, "%.*s", (int)name, p + 1);
        }
    }
    assert_int_equal(depth, 0);
}

static char *text_of(const dar_plot *p)
{
    dar_err e;
    char *svg;
    ok(dar_plot_text(p, &svg, &e), &e);
    well_formed(svg);
    return svg;
}

static void has(const dar_plot *p, const char *const *words)
{
    char *svg = text_of(p);
    for (; *words; words++) CHECK(strstr(svg, *words), "no %s in %s", *words, svg);
    free(svg);
}

/* Numbers at ticks, text escaped, error bars, names. */
static void what_it_says(void **state)
{
    (void)state;
    static const double x[] = { 0, 10000, 20000 }, y[] = { 0.25, 1, 0.5 }, lo[] = { 0.2, 0.9, 0.4 },
                        hi[] = { 0.3, 1.1, 0.6 };
    static const char *const names[] = { "a<b", "b&c", "c" };
    dar_plot_series s = { .label = "\"loss\" > 0", .mark = DAR_PLOT_BOTH, .n = 3, .x = x, .y = y };
    dar_plot p = { .title = "<T>", .x.label = "steps", .y.label = "loss", .series = &s, .n = 1 };
    has(&p, (const char *const[]){ ">&lt;T&gt;<", ">\"loss\" &gt; 0<", ">steps<", ">loss<", ">0<", ">10k<", ">20k<",
                                   ">0.4<", ">0.8<", ">1.0<", ">10000, 1</title>", NULL });
    s.lo = lo;
    s.hi = hi;
    s.names = names;
    has(&p, (const char *const[]){ ">a&lt;b<", ">b&amp;c: 10000, 1</title>", "h6m-3 0V", NULL });
    s.mark = DAR_PLOT_LINE;
    has(&p, (const char *const[]){ "fill-opacity=\".15\" d=\"M", NULL });

    static const double wide[] = { 1e-6, 1, 1e6 }, near[] = { 0.3, 0.35, 0.4 };
    s = (dar_plot_series){ .n = 3, .x = x, .y = wide };
    p.y.log = true;
    has(&p, (const char *const[]){ ">10\xe2\x81\xbb\xe2\x81\xb6<", ">0.01<", ">100<", ">10k<", ">1M<", NULL });
    s.y = near; /* less than a decade: round numbers all the same */
    has(&p, (const char *const[]){ ">0.30<", ">0.36<", ">0.40<", NULL });
    p.y = (dar_plot_axis){ .label = "loss", .lo = -1, .hi = 1 };
    has(&p, (const char *const[]){ ">-1.0<", ">1.0<", NULL });
}

/* Fourteen methods with wide names: each ends before the next begins, and inside; an M of DejaVu Sans is 10.4 px wide
 * at 12 px. */
static void legend(void **state)
{
    (void)state;
    enum { N = 14 };
    static const double v[] = { 1, 2 };
    dar_plot_series s[N];
    char label[N][40];
    for (int i = 0; i < N; i++) {
        snprintf(label[i], sizeof label[i], "%d-%.*s", i, 15 - i % 5 * 3, "MMMMMMMMMMMMMMMMMMM");
        s[i] = (dar_plot_series){ .label = label[i], .colour = i, .n = 2, .x = v, .y = v };
    }
    dar_plot p = { .series = s, .n = N };
    char *svg = text_of(&p);
    double end = 0, row = 0;
    for (int i = 0; i < N; i++) {
        char text[56];
        double x = NAN, y = NAN;
        snprintf(text, sizeof text, ">%s</text>", label[i]);
        const char *at = strstr(svg, text);
        assert_non_null(at);
        while (at > svg && *at != '<') at--;
        assert_int_equal(sscanf(at, "<text x=\"%lf\" y=\"%lf\"", &x, &y), 2);
        CHECK(y > row || x - 28 >= end, "%s begins at %g, before %g", label[i], x - 28, end);
        end = x + 10.4 * (15 - i % 5 * 3), row = y;
        CHECK(end < 720, "%s ends at %g", label[i], end);
    }
    CHECK(strstr(svg, "stroke=\"#0072b2\" stroke-width=\"2\" stroke-dasharray"), "the ninth looks like the first");
    free(svg);
}

static void hostile(void **state)
{
    (void)state;
    static const double odd[] = { NAN, INFINITY, -INFINITY, 0, -1, 1e308, -1e308, 1e-308, 5, 5, 5 };
    const dar_plot_series kinds[] = {
        { .n = 0 },
        { .n = 1, .x = odd, .y = odd },
        { .n = DAR_COUNT(odd), .x = odd, .y = odd, .lo = odd, .hi = odd },
        { .n = 1, .x = odd + 8, .y = odd + 8 },
        { .n = 3, .x = odd + 8, .y = odd + 8 },
        { .n = 2, .x = odd + 3, .y = odd + 3 },
    };
    for (size_t i = 0; i < DAR_COUNT(kinds); i++)
        for (int k = 0; k < 12; k++) {
            dar_plot_series s = kinds[i];
            s.mark = (dar_plot_mark)(k % 3);
            dar_plot p = { .x = { .log = k & 1 }, .y = { .log = k / 3 & 1 }, .series = &s, .n = 1 };
            free(text_of(&p));
        }
    dar_plot none = { .title = "" };
    free(text_of(&none));
}

/* Of a hundred thousand points as many are drawn as there are pixels, the extreme ones among them. */
static void many_points(void **state)
{
    (void)state;
    enum { N = 100000 };
    double *x = malloc(N * sizeof *x), *y = malloc(N * sizeof *y);
    assert_true(x && y);
    for (int i = 0; i < N; i++) {
        x[i] = i;
        y[i] = sin(i * 0.7) + (i == 54321 ? 9 : 0);
    }
    for (int mark = DAR_PLOT_LINE; mark <= DAR_PLOT_POINTS; mark++) {
        dar_plot_series s = { .mark = (dar_plot_mark)mark, .n = N, .x = x, .y = y };
        dar_plot p = { .series = &s, .n = 1 };
        char *svg = text_of(&p), *again = text_of(&p);
        assert_string_equal(svg, again);
        CHECK(strlen(svg) < (mark == DAR_PLOT_LINE ? 60000u : 500000u), "%zu bytes", strlen(svg));
        p.y = (dar_plot_axis){ .lo = -1, .hi = 10 }; /* 374 px in all: the peak is 34 px below the top */
        free(again);
        again = text_of(&p);
        double peak = 420 - 30 - (420 - 30 - 20) * 11.0 / 11, top = INFINITY;
        for (const char *at = again; (at = strpbrk(at, "VM")); at++) {
            double a, b,
                v = *at == 'V' && sscanf(at, "V%lf", &a) == 1 ? a
                    : sscanf(at, "M%lf %lf", &a, &b) == 2     ? b
                                                              : top;
            if (v > peak + 1) top = fmin(top, v);
        }
        CHECK_NEAR("the peak", top, 20 + (10 - y[54321]) / 11 * 370, 1.5);
        free(svg);
        free(again);
    }
    free(x);
    free(y);
}

static void to_a_file(void **state)
{
    (void)state;
    static const double x[] = { 1, 2 };
    dar_plot_series s = { .n = 2, .x = x, .y = x };
    dar_plot p = { .series = &s, .n = 1 };
    dar_err e;
    char *svg = text_of(&p), found[1 << 14];
    ok(dar_plot_write(&p, in_dir("a.svg"), &e), &e);
    run_read(in_dir("a.svg"), found, sizeof found);
    assert_string_equal(found, svg);
    refused(dar_plot_write(&p, in_dir("no/a.svg"), &e), &e, "no/a.svg: No such file");
    free(svg);
}

int main(void)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(what_it_says), cmocka_unit_test(legend),    cmocka_unit_test(hostile),
        cmocka_unit_test(many_points),  cmocka_unit_test(to_a_file),
    };
    return cmocka_run_group_tests_name("plot", tests, scratch_make, scratch_remove) != 0;
}
