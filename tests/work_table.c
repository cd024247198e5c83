/* work_table.c: rows as a CSV file that grows. */
#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "lib/file.h"
#include "tests/work.h"

static const struct {
    const char *name;
    bool text;
} column[WORK_COLUMNS] = {
    [WORK_SCENE] = { "scene", true },
    [WORK_SETTING] = { "setting", true },
    [WORK_PRECISION] = { "precision", true },
    [WORK_SOLVER] = { "solver", true },
    [WORK_STEPS] = { "steps", false },
    [WORK_SKIPS] = { "skips", true },
    [WORK_REUSE] = { "reuse", true },
    [WORK_THREADS] = { "threads", false },
    [WORK_SECONDS] = { "median_s", false },
    [WORK_FLOPS] = { "flops", false },
    [WORK_PEAK] = { "peak_bytes", false },
    [WORK_ERROR] = { "latent_rel_l2", false },
    [WORK_PSNR] = { "psnr_full", false },
    [WORK_PSNR_TRUTH] = { "psnr_gt", false },
    [WORK_SSIM] = { "ssim_full", false },
    [WORK_FLIP] = { "flip_full", false },
    [WORK_TEMP] = { "templ1", false },
    [WORK_TOLERANCE] = { "tolerance", false },
    [WORK_GUIDANCE_TOLERANCE] = { "guidance_tolerance", false },
    [WORK_SAMPLING] = { "sampling_s", false },
    [WORK_CALLS] = { "calls", false },
    [WORK_BYTES] = { "bytes", false },
    [WORK_ESTIMATE] = { "estimate", false },
    [WORK_ODE] = { "latent_rel_l2_ode", false },
    [WORK_TEMP_TRUTH] = { "templ1_gt", false },
    [WORK_EMPTY] = { "error_empty", false },
    [WORK_STILL] = { "error_still", false },
    [WORK_MOVING] = { "error_moving", false },
    [WORK_EDGE] = { "error_edge", false },
    [WORK_CAMERA_STILL] = { "camera_still", false },
    [WORK_VISIBLE] = { "visible", false },
    [WORK_MODEL] = { "model", true },
};

static dar_status push(work_table *t, const work_row *row, dar_err *e)
{
    if (t->n == t->room) {
        size_t room = t->room ? 2 * t->room : 64;
        work_row *more = realloc(t->row, room * sizeof *more);
        if (!more) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", t->path);
        t->row = more;
        t->room = room;
    }
    t->row[t->n++] = *row;
    return DAR_OK;
}

/* A line that was cut by a kill is none. */
static bool read_line(work_row *row, char *line)
{
    for (int k = 0; k < WORK_COLUMNS; k++) {
        char *field = strsep(&line, ","), *end;
        if (!field) return false;
        if (column[k].text) {
            snprintf(row->text[k], WORK_TEXT, "%s", field);
            continue;
        }
        row->v[k] = *field ? strtod(field, &end) : NAN;
        if (*field && *end) return false;
    }
    return !line;
}

static dar_status read_lines(work_table *t, char *text, const char *model, dar_err *e)
{
    const char *head = strsep(&text, "\n");
    for (int k = 0; k < WORK_COLUMNS; k++) {
        const size_t n = strlen(column[k].name);
        if (strncmp(head, column[k].name, n) != 0 || head[n] != (k + 1 < WORK_COLUMNS ? ',' : '\0'))
            return dar_fail(e, DAR_ERR_USAGE,
                            "%s: found no column '%s' where it is expected: remove it, or give another --out", t->path,
                            column[k].name);
        head += n + 1;
    }
    for (char *line; (line = strsep(&text, "\n"));) {
        work_row row = { 0 };
        if (!*line || !read_line(&row, line)) continue;
        if (strcmp(row.text[WORK_MODEL], model) != 0)
            return dar_fail(e, DAR_ERR_USAGE, "%s: found rows of %s, expected of %s: remove it, or give another --out",
                            t->path, row.text[WORK_MODEL], model);
        DAR_TRY(push(t, &row, e));
    }
    return DAR_OK;
}

static dar_status append(const work_table *t, const char *mode, const work_row *row, dar_err *e)
{
    FILE *f = fopen(t->path, mode);
    if (!f) return dar_fail(e, DAR_ERR_IO, "%s: %s", t->path, strerror(errno));
    for (int k = 0; k < WORK_COLUMNS; k++) {
        if (k) fputc(',', f);
        if (!row) fputs(column[k].name, f);
        else if (column[k].text) fputs(row->text[k], f);
        else if (isfinite(row->v[k])) fprintf(f, "%.6g", row->v[k]);
    }
    fputc('\n', f);
    bool bad = ferror(f);
    if (fclose(f) != 0 || bad) return dar_fail(e, DAR_ERR_IO, "%s: %s", t->path, strerror(errno));
    return DAR_OK;
}

dar_status work_open(work_table *t, const char *path, const char *model, dar_err *e)
{
    dar_file_map f;
    *t = (work_table){ .path = path };
    FILE *there = fopen(path, "rb");
    if (!there) return append(t, "w", NULL, e);
    fclose(there);
    DAR_TRY(dar_file_map_open(&f, path, e));
    char *text = calloc(f.size + 1, 1);
    dar_status s = text ? DAR_OK : dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    if (s == DAR_OK) {
        memcpy(text, f.data, f.size);
        bool whole = f.size && text[f.size - 1] == '\n';
        s = read_lines(t, text, model, e);
        if (s == DAR_OK && !whole && !(there = fopen(path, "a")))
            s = dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
        else if (s == DAR_OK && !whole) {
            fputc('\n', there);
            fclose(there);
        }
    }
    free(text);
    dar_file_map_close(&f);
    return s;
}

void work_close(work_table *t)
{
    free(t->row);
    *t = (work_table){ 0 };
}

const work_row *work_find(const work_table *t, const char *scene, const char *setting)
{
    for (size_t i = 0; i < t->n; i++)
        if (strcmp(t->row[i].text[WORK_SCENE], scene) == 0 && strcmp(t->row[i].text[WORK_SETTING], setting) == 0)
            return &t->row[i];
    return NULL;
}

dar_status work_add(work_table *t, const work_row *row, dar_err *e)
{
    DAR_TRY(push(t, row, e));
    return append(t, "a", row, e);
}

void work_print(const work_table *t, dar_json_writer *w)
{
    dar_json_write_array(w, "rows");
    for (size_t i = 0; i < t->n; i++) {
        dar_json_write_object(w, NULL);
        for (int k = 0; k < WORK_COLUMNS; k++) {
            if (column[k].text) dar_json_write_text(w, column[k].name, t->row[i].text[k]);
            else dar_json_write_number(w, column[k].name, t->row[i].v[k]);
        }
        dar_json_write_end(w);
    }
    dar_json_write_end(w);
}
