/* dar_eval_paper.c: which tables there are: the paper's, and the pairs that its claims rest on. */
#include "infer/dar_eval.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

/* What is being built. */
struct paper {
    dar_eval *v;
    dar_eval_sheets *sheets;
    bool has[DAR_EVAL_MEASURES]; /* some clip has it */
    const char *set;             /* of the clips; "": no name */
    dar_eval_span span;          /* of the frames */
    double *value;               /* [rows] */
};

static dar_eval_entry *at(const dar_eval_sheet *s, size_t row, size_t column)
{
    return &s->entry[row * s->columns + column];
}

static void head(dar_eval_sheet *s, size_t column, const char *title, const char *more)
{
    snprintf(s->head[column], sizeof s->head[column], "%s%s", title, more);
}

static const char *arrow(int measure)
{
    static const char *const text[] = { [DAR_EVAL_LESS] = " ↓", [DAR_EVAL_MORE] = " ↑", [DAR_EVAL_ONE] = " → 1" };
    return text[dar_eval_table[measure].aim];
}

static void put_number(dar_eval_entry *x, const dar_interval *i, int digits, bool sign)
{
    if (isnan(i->mean)) return;
    snprintf(x->text, sizeof x->text, sign ? "%+.*f" : "%.*f", digits, i->mean);
    if (!isnan(i->lo))
        snprintf(x->range, sizeof x->range, sign ? "%+.*f, %+.*f" : "%.*f, %.*f", digits, i->lo, digits, i->hi);
}

static void put_value(dar_eval_entry *x, const dar_interval *i, int measure, bool sign)
{
    put_number(x, i, dar_eval_table[measure].digits, sign);
}

static size_t clips_in(const struct paper *p, size_t method, const dar_eval_where *w)
{
    size_t n = 0;
    for (size_t c = 0; c < p->v->clips; c++)
        n += dar_eval_is_in(&p->v->clip[c], w) && (method == p->v->methods || dar_eval_at(p->v, method, c)->there);
    return n;
}

/* Column 0: names; a dagger on those that are shown, not ranked. */
static void name_rows(const struct paper *p, dar_eval_sheet *s)
{
    head(s, 0, "Method", "");
    for (size_t m = 0; m < p->v->methods; m++) {
        const dar_eval_method *x = &p->v->method[m];
        dar_eval_entry *cell = at(s, m, 0);
        snprintf(cell->text, sizeof cell->text, "%s%s", x->name, x->external && x->kind == DAR_EVAL_GIVEN ? " †" : "");
        cell->apart = x->external;
    }
}

static dar_eval_sheet *begin(struct paper *p, const char *what, size_t rows, size_t columns)
{
    char title[160];
    snprintf(title, sizeof title, "%s%s", what, p->span == DAR_EVAL_LATER ? ", without frame 0" : "");
    return dar_eval_sheet_add(p->sheets, title, p->set, rows, columns);
}

/* A column of one measure, ranked. */
static void put_column(struct paper *p, dar_eval_sheet *s, size_t k, const dar_eval_where *w, dar_metric_area area,
                       int measure)
{
    for (size_t m = 0; m < p->v->methods; m++) {
        dar_interval i = dar_eval_interval(p->v, m, p->v->methods, w, p->span, area, measure);
        put_value(at(s, m, k), &i, measure, false);
        p->value[m] = i.mean;
    }
    dar_eval_sheet_rank(s, k, p->value, dar_eval_table[measure].aim);
}

/* ---------------------------------------------------------------- by method */

static void main_table(struct paper *p, dar_metric_area area)
{
    const dar_eval_where w = { .set = p->set };
    size_t columns = 2, n = clips_in(p, p->v->methods, &w);
    for (int k = 0; k < DAR_EVAL_MEASURES; k++) columns += p->has[k];
    dar_eval_sheet *s =
        begin(p, area == DAR_METRIC_MASK ? "Methods, foreground alone" : "Methods", p->v->methods, columns);
    if (!s) return;
    snprintf(s->note, sizeof s->note,
             "%zu clip%s; mean over %s, then over clips.  %s  **Best** and _second_ among rows that are "
             "ranked; † sampled by normalised time or of another protocol, not ranked, as the rows of reference.",
             n, n == 1 ? "" : "s", p->span == DAR_EVAL_LATER ? "frames but the first, which is given" : "frames",
             n > 1 ? "With 95 % bootstrap intervals over clips." : "One clip gives no interval.");
    name_rows(p, s);
    head(s, 1, "Clips", "");
    for (size_t m = 0; m < p->v->methods; m++) {
        size_t there = clips_in(p, m, &w);
        snprintf(at(s, m, 1)->text, sizeof at(s, m, 1)->text, there < n ? "%zu/%zu" : "%zu", there, n);
    }
    for (int k = 0, column = 2; k < DAR_EVAL_MEASURES; k++) {
        if (!p->has[k]) continue;
        head(s, (size_t)column, dar_eval_table[k].title, arrow(k));
        put_column(p, s, (size_t)column++, &w, area, k);
    }
}

/* Rows minus the base, paired by clip. */
static void difference_table(struct paper *p)
{
    const dar_eval_where w = { .set = p->set };
    const dar_eval *v = p->v;
    size_t columns = 2, row = 0;
    char title[128];
    for (int k = 0; k < DAR_EVAL_MEASURES; k++) columns += p->has[k];
    if (v->methods < 2) return;
    snprintf(title, sizeof title, "Differences from %s", v->method[v->base].name);
    dar_eval_sheet *s = begin(p, title, v->methods - 1, columns);
    if (!s) return;
    snprintf(s->note, sizeof s->note,
             "Row minus %s, paired: only clips that both have.  **Bold**: the 95 %% interval does not hold 0.",
             v->method[v->base].name);
    head(s, 0, "Method", "");
    head(s, 1, "Pairs", "");
    for (size_t m = 0; m < v->methods; m++) {
        if (m == v->base) continue;
        snprintf(at(s, row, 0)->text, sizeof at(s, row, 0)->text, "%s", v->method[m].name);
        for (int k = 0, column = 2; k < DAR_EVAL_MEASURES; k++) {
            if (!p->has[k]) continue;
            dar_interval i = dar_eval_interval(p->v, m, v->base, &w, p->span, DAR_METRIC_FRAME, k);
            head(s, (size_t)column, "Δ ", dar_eval_table[k].title);
            put_value(at(s, row, (size_t)column), &i, k, true);
            if (i.lo > 0 || i.hi < 0) at(s, row, (size_t)column)->rank = DAR_EVAL_BEST;
            column++;
            if (k == DAR_METRIC_PSNR) snprintf(at(s, row, 1)->text, sizeof at(s, row, 1)->text, "%zu", i.n);
        }
        row++;
    }
}

/* ---------------------------------------------------------------- by trajectory, by checkpoint */

/* PSNR / SSIM / LPIPS, or FLIP where there is no LPIPS; returns PSNR. */
static double put_triple(struct paper *p, dar_eval_entry *x, size_t m, const dar_eval_where *w)
{
    const int third = p->has[DAR_EVAL_ALEX] ? DAR_EVAL_ALEX : DAR_METRIC_FLIP;
    double v[3];
    const int measure[3] = { DAR_METRIC_PSNR, DAR_METRIC_SSIM, third };
    for (int k = 0; k < 3; k++)
        v[k] = dar_eval_interval(p->v, m, p->v->methods, w, p->span, DAR_METRIC_FRAME, measure[k]).mean;
    if (!isnan(v[0])) snprintf(x->text, sizeof x->text, "%.2f / %.3f / %.3f", v[0], v[1], v[2]);
    return v[0];
}

static const char *triple(const struct paper *p)
{
    return p->has[DAR_EVAL_ALEX] ? "PSNR / SSIM / LPIPS; ranked by PSNR." : "PSNR / SSIM / FLIP; ranked by PSNR.";
}

/* Whether no clip of the set before this one has its trajectory. */
static bool is_new_path(const struct paper *p, size_t c)
{
    const dar_eval_clip *clip = p->v->clip;
    if (strcmp(clip[c].set, p->set) != 0) return false;
    for (size_t k = 0; k < c; k++)
        if (strcmp(clip[k].set, p->set) == 0 && strcmp(clip[k].trajectory, clip[c].trajectory) == 0) return false;
    return true;
}

static void trajectory_table(struct paper *p)
{
    size_t paths = 0, column = 1;
    for (size_t c = 0; c < p->v->clips; c++) paths += is_new_path(p, c);
    if (paths < 2 || paths > 12) return;
    dar_eval_sheet *s = begin(p, "Camera paths", p->v->methods, 1 + paths);
    if (!s) return;
    snprintf(s->note, sizeof s->note, "%s", triple(p));
    name_rows(p, s);
    for (size_t c = 0; c < p->v->clips; c++) {
        if (!is_new_path(p, c)) continue;
        const dar_eval_where w = { .set = p->set, .trajectory = p->v->clip[c].trajectory };
        char count[32];
        snprintf(count, sizeof count, " (%zu)", clips_in(p, p->v->methods, &w));
        head(s, column, p->v->clip[c].trajectory, count);
        for (size_t m = 0; m < p->v->methods; m++) p->value[m] = put_triple(p, at(s, m, column), m, &w);
        dar_eval_sheet_rank(s, column++, p->value, DAR_EVAL_MORE);
    }
}

/* Methods of one set and mode at several steps: rows are steps. */
static void checkpoint_table(struct paper *p)
{
    const dar_eval *v = p->v;
    const dar_eval_where w = { .set = p->set };
    size_t n = 0, row = 0;
    for (size_t m = 0; m < v->methods; m++)
        for (size_t k = 0; k < v->methods; k++)
            if (v->method[m].step >= 0 && v->method[k].step > v->method[m].step && *v->method[m].set &&
                strcmp(v->method[m].set, v->method[k].set) == 0 && strcmp(v->method[m].mode, v->method[k].mode) == 0)
                n++;
    if (!n) return;
    n = 0;
    for (size_t m = 0; m < v->methods; m++) n += v->method[m].step >= 0;
    dar_eval_sheet *s = begin(p, "Checkpoints", n, 4);
    if (!s) return;
    snprintf(s->note, sizeof s->note, "%s", triple(p));
    head(s, 0, "Channels", "");
    head(s, 1, "Training", "");
    head(s, 2, "Step", "");
    head(s, 3, p->has[DAR_EVAL_ALEX] ? "PSNR / SSIM / LPIPS" : "PSNR / SSIM / FLIP", "");
    for (size_t m = 0; m < v->methods; m++) {
        const dar_eval_method *x = &v->method[m];
        if (x->step < 0) continue;
        snprintf(at(s, row, 0)->text, sizeof at(s, row, 0)->text, "%s", *x->set ? x->set : x->name);
        snprintf(at(s, row, 1)->text, sizeof at(s, row, 1)->text, "%s", x->mode);
        snprintf(at(s, row, 2)->text, sizeof at(s, row, 2)->text, "%lld", (long long)x->step);
        p->value[row] = put_triple(p, at(s, row, 3), m, &w);
        row++;
    }
    dar_eval_sheet_rank(s, 3, p->value, DAR_EVAL_MORE);
}

/* ---------------------------------------------------------------- pairs */

/* The method trained as `like` is, with other channels; methods: none. */
static size_t partner(const dar_eval *v, size_t like, const char *channels)
{
    const dar_eval_method *x = &v->method[like];
    char set[DAR_EVAL_NAME] = "";
    dar_eval_channels(channels, set);
    for (size_t m = 0; m < v->methods; m++) {
        const dar_eval_method *y = &v->method[m];
        if (y->kind == DAR_EVAL_GIVEN && strcmp(y->set, set) == 0 && strcmp(y->mode, x->mode) == 0 &&
            y->step == x->step && y->seed == x->seed)
            return m;
    }
    return v->methods;
}

static bool is_dar(const dar_eval *v, size_t m)
{
    char set[DAR_EVAL_NAME] = "";
    dar_eval_channels("dar", set);
    return strcmp(v->method[m].set, set) == 0;
}

/* Every method with the channels `ours` minus the one with `theirs`. */
static void pair_table(struct paper *p, const char *what, const char *const *theirs, size_t n, const char *note)
{
    const dar_eval *v = p->v;
    const dar_eval_where w = { .set = p->set };
    const int measure[] = { DAR_METRIC_PSNR, DAR_METRIC_SSIM, DAR_EVAL_ALEX,
                            DAR_METRIC_FLIP, DAR_METRIC_TEMP, DAR_METRIC_SHARP };
    size_t rows = 0, columns = 4, row = 0;
    for (size_t m = 0; m < v->methods; m++)
        for (size_t k = 0; k < n && is_dar(v, m); k++) rows += partner(v, m, theirs[k]) < v->methods;
    for (size_t k = 0; k < DAR_COUNT(measure); k++) columns += p->has[measure[k]];
    if (!rows) return;
    dar_eval_sheet *s = begin(p, what, rows, columns);
    if (!s) return;
    snprintf(s->note, sizeof s->note, "%s  **Bold**: the 95 %% interval does not hold 0.", note);
    head(s, 0, "Ours", "");
    head(s, 1, "Theirs", "");
    head(s, 2, "PSNR ours", "");
    head(s, 3, "PSNR theirs", "");
    for (size_t m = 0; m < v->methods; m++)
        for (size_t k = 0; k < n && is_dar(v, m); k++) {
            size_t other = partner(v, m, theirs[k]), column = 4;
            if (other == v->methods) continue;
            const size_t both[2] = { m, other };
            for (size_t i = 0; i < 2; i++) {
                dar_interval x =
                    dar_eval_interval(p->v, both[i], v->methods, &w, p->span, DAR_METRIC_FRAME, DAR_METRIC_PSNR);
                snprintf(at(s, row, i)->text, sizeof at(s, row, i)->text, "%s", v->method[both[i]].name);
                put_value(at(s, row, 2 + i), &x, DAR_METRIC_PSNR, false);
                at(s, row, 2 + i)->range[0] = 0;
            }
            for (size_t q = 0; q < DAR_COUNT(measure); q++) {
                if (!p->has[measure[q]]) continue;
                dar_interval x = dar_eval_interval(p->v, m, other, &w, p->span, DAR_METRIC_FRAME, measure[q]);
                head(s, column, "Δ ", dar_eval_table[measure[q]].title);
                put_value(at(s, row, column), &x, measure[q], true);
                if (x.lo > 0 || x.hi < 0) at(s, row, column)->rank = DAR_EVAL_BEST;
                column++;
            }
            row++;
        }
}

/* ---------------------------------------------------------------- stress tests */

/* The last frame, farthest from the reference. */
static void end_table(struct paper *p)
{
    static const int measure[] = { DAR_METRIC_PSNR, DAR_METRIC_SSIM, DAR_METRIC_FLIP, DAR_EVAL_ALEX };
    const dar_eval_where w = { .set = p->set };
    size_t columns = 1, column = 1, n = 0;
    double lost = 0;
    for (size_t k = 0; k < DAR_COUNT(measure); k++) columns += 2 * (size_t)p->has[measure[k]];
    dar_eval_sheet *s = begin(p, "Last frames", p->v->methods, columns);
    if (!s) return;
    for (size_t c = 0; c < p->v->clips; c++)
        if (dar_eval_is_in(&p->v->clip[c], &w) && !isnan(p->v->clip[c].lost[1])) lost += p->v->clip[c].lost[1], n++;
    snprintf(s->note, sizeof s->note, "The last frame of each clip, whole and foreground alone.");
    if (n)
        snprintf(
            s->note, sizeof s->note,
            "The last frame of each clip, whole and foreground alone.  Frame 0 does not show %.0f %% of the surface "
            "that the last one shows: there even the oracle guesses.",
            100 * lost / (double)n);
    name_rows(p, s);
    for (int area = 0; area < DAR_METRIC_AREAS; area++)
        for (size_t k = 0; k < DAR_COUNT(measure); k++) {
            if (!p->has[measure[k]]) continue;
            head(s, column, dar_eval_table[measure[k]].title,
                 area == DAR_METRIC_MASK ? " foreground" : arrow(measure[k]));
            put_column(p, s, column++, &w, (dar_metric_area)area, measure[k]);
        }
}

#define GRID 5 /* animations, and camera paths, of the set motion-separation */

/* What is left of PSNR when means of animation and camera path are taken away: root mean square. */
static double interaction(double x[GRID][GRID], double rows[GRID], double columns[GRID])
{
    double all = 0, sum = 0;
    for (int i = 0; i < GRID; i++) rows[i] = columns[i] = 0;
    for (int i = 0; i < GRID; i++)
        for (int j = 0; j < GRID; j++) {
            rows[i] += x[i][j] / GRID;
            columns[j] += x[i][j] / GRID;
            all += x[i][j] / (GRID * GRID);
        }
    for (int i = 0; i < GRID; i++)
        for (int j = 0; j < GRID; j++) {
            double d = x[i][j] - rows[i] - columns[j] + all;
            sum += d * d;
        }
    return sqrt(sum / ((GRID - 1) * (GRID - 1)));
}

static void spread_of(const double *x, double *least, double *width)
{
    double most = *least = x[0];
    for (int i = 1; i < GRID; i++) {
        *least = fmin(*least, x[i]);
        most = fmax(most, x[i]);
    }
    *width = most - *least;
}

static void separation_table(struct paper *p)
{
    static const char *const title[] = { "Method",         "PSNR ↑",       "Worst animation ↑", "Its spread ↓",
                                         "Worst camera ↑", "Its spread ↓", "Recombination ↓" };
    if (strcmp(p->set, "motion-separation") != 0) return;
    dar_eval_sheet *s = begin(p, "Motion and camera apart", p->v->methods, DAR_COUNT(title));
    if (!s) return;
    snprintf(s->note, sizeof s->note,
             "%d animations, each under the same %d camera paths.  PSNR; means of an animation and of a path; "
             "recombination: what is left of a clip's PSNR when both are taken away, root mean square.",
             GRID, GRID);
    name_rows(p, s);
    for (size_t k = 0; k < DAR_COUNT(title); k++) head(s, k, title[k], "");
    double *value[6];
    for (size_t k = 0; k < 6; k++) value[k] = p->value + k * p->v->methods;
    for (size_t m = 0; m < p->v->methods; m++) {
        double x[GRID][GRID], rows[GRID], columns[GRID], v[6] = { 0 };
        for (size_t i = 0; i < GRID; i++)
            for (size_t j = 0; j < GRID; j++) {
                const dar_eval_where w = { p->set, NULL, GRID, i, GRID, j };
                x[i][j] =
                    dar_eval_interval(p->v, m, p->v->methods, &w, p->span, DAR_METRIC_FRAME, DAR_METRIC_PSNR).mean;
                v[0] += x[i][j] / (GRID * GRID);
            }
        v[5] = interaction(x, rows, columns);
        spread_of(rows, &v[1], &v[2]);
        spread_of(columns, &v[3], &v[4]);
        for (size_t k = 0; k < 6; k++) {
            value[k][m] = isnan(v[5]) ? NAN : v[k];
            if (!isnan(v[5])) snprintf(at(s, m, k + 1)->text, sizeof at(s, m, k + 1)->text, "%.2f", v[k]);
        }
    }
    for (size_t k = 0; k < 6; k++)
        dar_eval_sheet_rank(s, k + 1, value[k], k == 0 || k == 1 || k == 3 ? DAR_EVAL_MORE : DAR_EVAL_LESS);
}

/* One scene, many references. */
static void variant_table(struct paper *p)
{
    static const struct {
        const char *title;
        dar_eval_aim aim;
        int digits;
    } column[DAR_EVAL_VARIANTS] = {
        [DAR_EVAL_VARIANT_IOU] = { "Silhouette IoU ↑", DAR_EVAL_MORE, 3 },
        [DAR_EVAL_VARIANT_OWN] = { "L1 to own truth ↓", DAR_EVAL_LESS, 2 },
        [DAR_EVAL_VARIANT_OTHER] = { "L1 to nearest other", DAR_EVAL_MORE, 2 },
        [DAR_EVAL_VARIANT_MARGIN] = { "Margin ↑", DAR_EVAL_MORE, 2 },
        [DAR_EVAL_VARIANT_NEAREST] = { "Own is nearest ↑", DAR_EVAL_MORE, 2 },
    };
    double seen = 0, n = 0;
    for (size_t c = 0; c < p->v->clips; c++)
        if (strcmp(p->v->clip[c].set, p->set) == 0 && !isnan(p->v->clip[c].seen)) seen += p->v->clip[c].seen, n++;
    if (n == 0) return;
    dar_eval_sheet *s = begin(p, "Shape stays, appearance follows", p->v->methods, 1 + DAR_EVAL_VARIANTS);
    if (!s) return;
    snprintf(
        s->note, sizeof s->note,
        "One scene with %.0f references, objects without the ground.  IoU with their geometry of what differs from "
        "what lies behind them; the truth itself has %.3f.  L1, 0 to 255, of their pixels to the truth of the "
        "render's own reference and to the nearest of the others'; margin: their difference; the share of clips "
        "whose own is the nearest, by chance %.2f.",
        n, seen / n, 1 / n);
    name_rows(p, s);
    for (int k = 0; k < DAR_EVAL_VARIANTS; k++) {
        head(s, (size_t)k + 1, column[k].title, "");
        for (size_t m = 0; m < p->v->methods; m++) {
            dar_interval i = dar_eval_variant_interval(p->v, m, p->set, (dar_eval_variant_number)k);
            put_number(at(s, m, (size_t)k + 1), &i, column[k].digits, false);
            p->value[m] = i.mean;
        }
        if (k != DAR_EVAL_VARIANT_OTHER) dar_eval_sheet_rank(s, (size_t)k + 1, p->value, column[k].aim);
    }
}

/* ---------------------------------------------------------------- all of them */

static void methods_table(struct paper *p)
{
    main_table(p, DAR_METRIC_FRAME);
}

static void foreground_table(struct paper *p)
{
    if (p->v->masked) main_table(p, DAR_METRIC_MASK);
}

static void swap_table(struct paper *p)
{
    static const char *const swap[] = { "tracking+normal+depth" };
    pair_table(p, "World position against depth", swap, DAR_COUNT(swap),
               "Tracking and normal stay; world position is replaced by depth.  Ours minus theirs, paired by clip.");
}

static void mask_table(struct paper *p)
{
    static const char *const masks[] = { "mask+world+normal", "mask+depth+normal" };
    pair_table(p, "Tracking against a mask", masks, DAR_COUNT(masks),
               "Persistent identity is replaced by a mask of the foreground.  Ours minus theirs, paired by clip.");
}

static void tables_of_set(struct paper *p)
{
    static void (*const table[])(struct paper *) = {
        methods_table,    foreground_table, difference_table, trajectory_table,
        checkpoint_table, swap_table,       mask_table,       separation_table,
    };
    for (size_t i = 0; i < DAR_COUNT(table); i++)
        for (p->span = DAR_EVAL_ALL; p->span <= DAR_EVAL_LATER; p->span++) table[i](p);
    p->span = DAR_EVAL_LAST;
    end_table(p);
    variant_table(p);
    dar_eval_beside(p->v, p->sheets, p->set);
}

void dar_eval_paper(dar_eval *v, dar_eval_sheets *sheets)
{
    struct paper p = { .v = v, .sheets = sheets, .value = malloc(6 * v->methods * sizeof(double)) };
    if (!p.value) sheets->failed = true;
    for (size_t i = 0; i < v->methods * v->clips; i++)
        for (int k = 0; k < DAR_EVAL_MEASURES && v->cell[i].there; k++)
            p.has[k] |= !isnan(v->cell[i].span[DAR_EVAL_ALL].v[DAR_METRIC_FRAME][k]);
    for (size_t c = 0; c < v->clips && p.value; c++) {
        bool seen = false;
        for (size_t k = 0; k < c; k++) seen |= strcmp(v->clip[k].set, v->clip[c].set) == 0;
        if (seen) continue;
        p.set = v->clip[c].set;
        tables_of_set(&p);
    }
    free(p.value);
}
