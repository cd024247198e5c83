/* front.c: see front.h. */
#include "infer/front.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define FORMAT "dar-front/1"
#define STILL  1e-6 /* of the camera's numbers, relative: what rounding in files may have done */

const char *const dar_front_kind[] = { "still", "moving", "any", NULL };

/* ---------------------------------------------------------------- the file */

static void read_setting(dar_front_setting *s, dar_json j)
{
    s->name = dar_json_text(j, "name", NULL);
    s->precision = dar_json_choice(j, "precision", -1, dar_pipeline_precision);
    s->solver = (dar_solver_kind)dar_json_choice(j, "solver", -1, dar_solver_name);
    s->steps = (size_t)dar_json_int(j, "steps", DAR_JSON_NEEDED, 1, 1000);
    s->tolerance = dar_json_number(j, "tolerance", NAN, 0, 1);
    s->guidance_tolerance = dar_json_number(j, "guidance_tolerance", NAN, 0, 1);
    s->time = dar_json_number(j, "time", NAN, 0, 1e6);
    s->error = dar_json_number(j, "error", NAN, 0, 1e6);
    s->estimate = dar_json_number(j, "estimate", NAN, 0, 1e6);
    s->psnr = dar_json_number(j, "psnr", NAN, 0, 100);
}

static void read_row(dar_front *f, dar_json j)
{
    int kind = dar_json_choice(j, "name", -1, dar_front_kind);
    dar_json list = dar_json_array(j, "settings");
    if (kind < 0) return;
    dar_front_row *r = &f->kind[kind];
    r->scenes = (size_t)dar_json_int(j, "scenes", DAR_JSON_NEEDED, 1, 1000000);
    r->visible[0] = NAN;
    dar_json_numbers(j, "visible", r->visible, 2);
    for (dar_json x = dar_json_first(list); x.item; x = dar_json_next(x)) {
        if (r->settings == DAR_FRONT_MOST) {
            dar_json_reject(j, "settings", "%d at most", DAR_FRONT_MOST);
            return;
        }
        read_setting(&r->setting[r->settings++], x);
    }
}

static dar_status read_front(dar_front *f, const char *path, const char *model, dar_err *e)
{
    DAR_TRY(dar_json_open(&f->doc, path, e));
    dar_json root = dar_json_root(f->doc), kinds = dar_json_array(root, "kinds");
    const char *format = dar_json_text(root, "format", NULL);
    if (format && strcmp(format, FORMAT) != 0) dar_json_reject(root, "format", "\"" FORMAT "\"");
    f->model = dar_json_text(root, "model", NULL);
    f->safety = dar_json_number(root, "safety", NAN, 1, 1e6);
    for (dar_json x = dar_json_first(kinds); x.item; x = dar_json_next(x)) read_row(f, x);
    DAR_TRY(dar_json_finish(f->doc, e));
    if (strcmp(f->model, model) == 0) return DAR_OK;
    return dar_fail(e, DAR_ERR_FORMAT, "%s: model: found \"%s\", expected \"%s\"", path, f->model, model);
}

dar_status dar_front_open(dar_front *f, const char *path, const char *model, dar_err *e)
{
    *f = (dar_front){ 0 };
    dar_status s = read_front(f, path, model, e);
    if (s != DAR_OK) dar_front_close(f);
    return s;
}

void dar_front_close(dar_front *f)
{
    dar_json_close(f->doc);
    *f = (dar_front){ 0 };
}

static void print_setting(const dar_front_setting *s, dar_json_writer *w)
{
    dar_json_write_object(w, NULL);
    dar_json_write_text(w, "name", s->name);
    dar_json_write_text(w, "precision", dar_pipeline_precision[s->precision]);
    dar_json_write_text(w, "solver", dar_solver_name[s->solver]);
    dar_json_write_int(w, "steps", (int64_t)s->steps);
    dar_json_write_number(w, "tolerance", s->tolerance);
    dar_json_write_number(w, "guidance_tolerance", s->guidance_tolerance);
    dar_json_write_number(w, "time", s->time);
    dar_json_write_number(w, "error", s->error);
    dar_json_write_number(w, "estimate", s->estimate);
    dar_json_write_number(w, "psnr", s->psnr);
    dar_json_write_end(w);
}

void dar_front_print(const dar_front *f, dar_json_writer *w)
{
    dar_json_write_object(w, NULL);
    dar_json_write_text(w, "format", FORMAT);
    dar_json_write_text(w, "model", f->model);
    dar_json_write_number(w, "safety", f->safety);
    dar_json_write_array(w, "kinds");
    for (int k = 0; k < DAR_FRONT_KINDS; k++) {
        const dar_front_row *r = &f->kind[k];
        if (!r->scenes) continue;
        dar_json_write_object(w, NULL);
        dar_json_write_text(w, "name", dar_front_kind[k]);
        dar_json_write_int(w, "scenes", (int64_t)r->scenes);
        dar_json_write_array(w, "visible");
        for (int i = 0; i < 2; i++) dar_json_write_number(w, NULL, r->visible[i]);
        dar_json_write_end(w);
        dar_json_write_array(w, "settings");
        for (size_t i = 0; i < r->settings; i++) print_setting(&r->setting[i], w);
        dar_json_write_end(w);
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
    dar_json_write_end(w);
}

/* ---------------------------------------------------------------- scenes */

static bool near(double a, double b)
{
    return fabs(a - b) <= STILL * fmax(1, fabs(b));
}

static bool same_view(const dar_view *a, const dar_view *b)
{
    bool same = near(a->fx, b->fx) && near(a->fy, b->fy) && near(a->cx, b->cx) && near(a->cy, b->cy);
    for (int i = 0; i < 12; i++) same = same && near(a->c2w[i], b->c2w[i]);
    return same;
}

dar_status dar_front_look(dar_front_scene *s, dar_bundle *b, dar_err *e)
{
    const size_t pixels = (size_t)b->meta.width * (size_t)b->meta.height;
    double seen = 0;
    *s = (dar_front_scene){ .still = true, .visible = NAN };
    for (size_t t = 1; t < b->cameras.frames; t++)
        s->still = s->still && same_view(&b->cameras.view[t], &b->cameras.view[0]);
    if (!dar_bundle_has(b, DAR_FAMILY_MASK)) return DAR_OK;
    float *mask = malloc(pixels * sizeof *mask);
    dar_status status = mask ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "out of memory for a mask");
    for (size_t t = 0; t < b->meta.frames && status == DAR_OK; t++) {
        status = dar_bundle_values(b, DAR_FAMILY_MASK, t, mask, e);
        for (size_t i = 0; i < pixels && status == DAR_OK; i++) seen += mask[i] >= 0.5F;
    }
    free(mask);
    s->visible = seen / ((double)pixels * (double)b->meta.frames);
    return status;
}

dar_front_kind_name dar_front_kind_of(const dar_front *f, const dar_front_scene *s)
{
    dar_front_kind_name kind = s->still ? DAR_FRONT_STILL : DAR_FRONT_MOVING;
    const dar_front_row *r = &f->kind[kind];
    return r->scenes && s->visible >= r->visible[0] && s->visible <= r->visible[1] ? kind : DAR_FRONT_ANY;
}

/* ---------------------------------------------------------------- settings */

const dar_front_setting *dar_front_pick(const dar_front *f, dar_front_kind_name kind, int precision, double budget)
{
    const dar_front_row *r = &f->kind[kind];
    const dar_front_setting *best = NULL;
    for (size_t i = 0; i < r->settings; i++) {
        const dar_front_setting *s = &r->setting[i];
        if (s->precision != precision || !(f->safety * s->error <= budget)) continue;
        if (!best || s->time < best->time) best = s;
    }
    return best;
}

void dar_front_apply(const dar_front *f, const dar_front_setting *s, dar_sampler_config *c)
{
    c->solver.kind = s->solver;
    c->solver.grid = dar_solver_grid(s->solver);
    c->solver.steps = s->steps;
    c->solver.tolerance = s->tolerance;
    c->solver.budget = f->safety * s->estimate;
    c->guidance_tolerance = s->guidance_tolerance;
}
