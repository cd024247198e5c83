/* work_held.c: error budgets on scenes that the front was not made of. */
#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "lib/file.h"
#include "tests/work.h"

static const char header[] = "scene,camera_still,visible,budget,kind,setting,bound,error,estimate,allowed,fell_back,"
                             "time,psnr_full\n";

static const double budgets[] = { 0.003, 0.01, 0.03, 0.1 };

static void held_path(const char *directory, char path[PATH_MAX])
{
    snprintf(path, PATH_MAX, "%.*s/held.csv", PATH_MAX - 16, directory);
}

/* Text of the file, to be freed; an empty one is begun. */
static dar_status read_all(const char *directory, char **text, dar_err *e)
{
    char path[PATH_MAX];
    dar_file_map m;
    held_path(directory, path);
    FILE *f = fopen(path, "a");
    if (!f) return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
    if (ftell(f) == 0) fputs(header, f);
    if (fclose(f) != 0) return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
    DAR_TRY(dar_file_map_open(&m, path, e));
    *text = calloc(m.size + 1, 1);
    if (*text) memcpy(*text, m.data, m.size);
    dar_file_map_close(&m);
    return *text ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
}

/* Choose as dar-sample does for one bundle; NULL: the full run. */
static const dar_front_setting *choose(const dar_front *f, dar_front_kind_name kind, double budget)
{
    const dar_front_setting *best = NULL;
    for (int p = 0; p <= DAR_PIPELINE_INT8; p++) {
        const dar_front_setting *s = dar_front_pick(f, kind, p, budget);
        if (s && s->time < (best ? best->time : 1)) best = s;
    }
    return best;
}

struct run {
    work_scene s;
    double *latent, full; /* full: seconds */
    uint8_t *frames;
    work_render *render;
    void *ctx;
};

static dar_status promise(struct run *r, const dar_front *f, size_t i, double budget, FILE *to, dar_err *e)
{
    const dar_front_kind_name kind = dar_front_kind_of(f, &r->s.kind);
    const dar_front_setting *s = choose(f, kind, budget);
    const int precision = s ? s->precision : DAR_F32;
    dar_sampler_config c = dar_sampler_default();
    double seconds, again = 0, estimate = 0;
    work_row row = { 0 };
    if (s) dar_front_apply(f, s, &c);
    const double allowed = c.solver.budget;
    dar_status status = r->render(r->ctx, precision, &c, &r->s, r->latent, r->frames, &seconds, &estimate, e);
    bool fell_back = status == DAR_ERR_CHECK;
    if (fell_back) {
        c = dar_sampler_default();
        status = r->render(r->ctx, precision, &c, &r->s, r->latent, r->frames, &again, &estimate, e);
    }
    DAR_TRY(status);
    DAR_TRY(work_compare(&r->s, r->latent, r->frames, &row, e));
    fprintf(to, "%zu,%d,%.4g,%g,%s,%s,%.4g,%.4g,%.4g,%.4g,%d,%.4g,%.4g\n", i, r->s.kind.still, r->s.kind.visible,
            budget, dar_front_kind[kind], s ? s->name : WORK_FULL, s ? f->safety * s->error : 0, row.v[WORK_ERROR],
            estimate, allowed, fell_back, (seconds + again) / r->full, row.v[WORK_PSNR]);
    return DAR_OK;
}

static dar_status keep_promises(struct run *r, const dar_front *f, const char *directory, size_t i, dar_err *e)
{
    const size_t pixels = 3 * r->s.b->meta.frames * (size_t)r->s.b->meta.width * (size_t)r->s.b->meta.height;
    char path[PATH_MAX], *text = NULL;
    size_t size = 0;
    dar_sampler_config full = dar_sampler_default();
    double estimate;
    full.skip = 0;
    r->latent = calloc(r->s.latent, sizeof *r->latent);
    r->frames = malloc(pixels);
    FILE *to = open_memstream(&text, &size);
    dar_status s = r->latent && r->frames && to ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "held: out of memory");
    if (s == DAR_OK) s = r->render(r->ctx, DAR_F32, &full, &r->s, r->s.full, r->s.frames, &r->full, &estimate, e);
    for (size_t k = 0; k < DAR_COUNT(budgets) && s == DAR_OK; k++) s = promise(r, f, i, budgets[k], to, e);
    if (to) fclose(to);
    held_path(directory, path);
    if (s == DAR_OK && ((to = fopen(path, "a")) == NULL || fputs(text, to) < 0 || fclose(to) != 0))
        s = dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
    free(text);
    free(r->latent);
    free(r->frames);
    return s;
}

dar_status work_held(const dar_front *f, const char *directory, size_t i, const work_size *size,
                     const dar_config *model, work_render *render, void *ctx, dar_err *e)
{
    struct run r = { .render = render, .ctx = ctx };
    char scenes[PATH_MAX], line[32], *text;
    DAR_TRY(read_all(directory, &text, e));
    snprintf(line, sizeof line, "\n%zu,", i);
    bool there = strstr(text, line) != NULL;
    free(text);
    if (there) return DAR_OK;
    snprintf(scenes, sizeof scenes, "%.*s/scenes", PATH_MAX - 16, directory);
    dar_status s = work_scene_held(&r.s, i, scenes, size, model, e);
    if (s == DAR_OK) s = keep_promises(&r, f, directory, i, e);
    work_scene_close(&r.s);
    return s;
}

dar_status work_held_sum(const char *directory, work_promise *p, dar_err *e)
{
    enum { BUDGET = 3, ERROR = 7, TIME = 11, FIELDS = 13 };
    char *text, *line, *rest, *field[FIELDS];
    *p = (work_promise){ 0 };
    DAR_TRY(read_all(directory, &text, e));
    rest = text;
    for (strsep(&rest, "\n"); (line = strsep(&rest, "\n"));) {
        size_t n = 0;
        while (n < FIELDS && (field[n] = strsep(&line, ","))) n++;
        if (n < FIELDS) continue;
        double share = strtod(field[ERROR], NULL) / strtod(field[BUDGET], NULL);
        p->rows++;
        p->broken += !(share <= 1);
        p->error = fmax(p->error, share);
        p->time = fmax(p->time, strtod(field[TIME], NULL));
    }
    free(text);
    return DAR_OK;
}
