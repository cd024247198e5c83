/* sheet.h: pictures in a grid with words beside them, as one PNG: what people look at to see whether all is well.
 *
 *     dar_sheet_plan plan = { .title = "robot", .rows = 3, .columns = 5, .width = 256, .height = 148 };
 *     DAR_TRY(dar_sheet_init(&s, &plan, e));
 *     dar_sheet_row(&s, 0, "depth", "near is bright");
 *     dar_sheet_column(&s, 0, "frame 0");
 *     dar_sheet_picture(&s, 0, 0, rgb, 832, 480, DAR_SHRINK_MEAN);
 *     ...
 *     s = dar_sheet_write(&s, "sheet.png", e);
 *     dar_sheet_free(&s);
 *
 * Words are in ASCII; any other character is shown as '?'. */
#ifndef DAR_DATA_SHEET_H
#define DAR_DATA_SHEET_H

#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"

typedef struct dar_sheet_plan {
    const char *title, *subtitle; /* or NULL */
    size_t rows, columns;         /* at least 1 */
    size_t width, height;         /* of a cell [px] */
} dar_sheet_plan;

typedef struct dar_sheet {
    dar_sheet_plan plan;
    size_t width, height, top; /* [px]; top: where the first row begins */
    uint8_t *rgb;              /* [height, width, 3] */
} dar_sheet;

/* Fails if the sheet is larger than a PNG may be, or memory is short; then s is zeroed. */
dar_status dar_sheet_init(dar_sheet *s, const dar_sheet_plan *plan, dar_err *e);
void dar_sheet_free(dar_sheet *s); /* accepts a zeroed one */

/* Words left of a row: its name, below it a note (or NULL), broken into lines. */
void dar_sheet_row(dar_sheet *s, size_t row, const char *name, const char *note);

/* A word above a column. */
void dar_sheet_column(dar_sheet *s, size_t column, const char *name);

typedef enum dar_shrink {
    DAR_SHRINK_MEAN,     /* of the pixels that become one */
    DAR_SHRINK_BRIGHTEST /* of them: keeps thin lines and points */
} dar_shrink;

/* Show rgb [height, width, 3] in a cell, as large as it fits. */
void dar_sheet_picture(dar_sheet *s, size_t row, size_t column, const uint8_t *rgb, size_t width, size_t height,
                       dar_shrink shrink);

/* Words in a cell, lines broken at its edge and at '\n'. */
void dar_sheet_words(dar_sheet *s, size_t row, size_t column, const char *words);

dar_status dar_sheet_write(const dar_sheet *s, const char *path, dar_err *e);

#endif
