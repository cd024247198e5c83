/* dar_eval_html.h: pieces that the pages are made of: text, files inside of pages, style. */
#ifndef DAR_INFER_DAR_EVAL_HTML_H
#define DAR_INFER_DAR_EVAL_HTML_H

#include <stdio.h>

#include "lib/status.h"

/* Text, with what HTML reads as its own written out. */
void dar_html_text(FILE *f, const char *text);

/* A file as base64. */
dar_status dar_html_file(FILE *f, const char *path, dar_err *e);

/* From <!doctype html> to <body>: colours, type, tables, in light and dark. */
void dar_html_begin(FILE *f, const char *title);

extern const char dar_html_films[]; /* script: films are decoded when they come into view, and play only there */

#endif
