/* dar_eval_sheet.c: last frames of some clips, methods side by side: a report at a glance. */
#include "infer/dar_eval.h"

#define ROWS  8
#define WIDTH 224 /* of a picture at most [px] */

static size_t rows_of(const dar_eval *v)
{
    return v->clips < ROWS ? v->clips : ROWS;
}

/* Rows are clips of equal distance. */
static size_t clip_of(const dar_eval *v, size_t row)
{
    return row * v->clips / rows_of(v);
}

dar_status dar_eval_sheet_begin(dar_eval *v, dar_err *e)
{
    const dar_eval_clip *first = &v->clip[0];
    dar_sheet_plan plan = { .title = "last frames", .rows = rows_of(v), .columns = 2 + v->methods };
    plan.width = first->width < WIDTH ? first->width : WIDTH;
    plan.height = plan.width * first->height / first->width;
    DAR_TRY(dar_sheet_init(&v->sheet, &plan, e));
    dar_sheet_column(&v->sheet, 0, "frame 0");
    dar_sheet_column(&v->sheet, 1, "truth");
    for (size_t m = 0; m < v->methods; m++) dar_sheet_column(&v->sheet, 2 + m, v->method[m].name);
    for (size_t k = 0; k < plan.rows; k++) {
        const dar_eval_clip *c = &v->clip[clip_of(v, k)];
        dar_sheet_row(&v->sheet, k, c->name, c->trajectory);
    }
    return DAR_OK;
}

void dar_eval_sheet_show(dar_eval *v, size_t c, size_t m, size_t t, const uint8_t *rgb)
{
    const dar_eval_clip *clip = &v->clip[c];
    const bool truth = m == v->methods;
    if (!v->sheet.rgb || !(t + 1 == clip->frames || (truth && t == 0))) return;
    for (size_t k = 0; k < rows_of(v); k++) {
        if (clip_of(v, k) != c) continue;
        size_t column = !truth ? 2 + m : t == 0 ? 0 : 1;
        dar_sheet_picture(&v->sheet, k, column, rgb, clip->width, clip->height, DAR_SHRINK_MEAN);
    }
}

dar_status dar_eval_sheet_end(dar_eval *v, dar_err *e)
{
    char path[PATH_MAX + 16];
    snprintf(path, sizeof path, "%s/sheet.png", v->out);
    return dar_sheet_write(&v->sheet, path, e);
}
