/* status.c: messages and the last stop of a failed assertion. */
#include "lib/status.h"

#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

/* Text that came from a file stays one line, and a cut one valid UTF-8. */
static void tidy(char *text, size_t size)
{
    size_t n = strlen(text);
    if (n + 1 == size) {
        while (n && ((unsigned char)text[n - 1] & 0xc0) == 0x80) n--;
        if (n && (unsigned char)text[n - 1] >= 0xc0) n--;
        text[n] = 0;
    }
    for (size_t i = 0; i < n; i++)
        if ((unsigned char)text[i] < 0x20 || text[i] == 0x7f) text[i] = '?';
}

dar_status dar_fail(dar_err *e, dar_status s, const char *fmt, ...)
{
    if (e) {
        va_list ap;
        va_start(ap, fmt);
        vsnprintf(e->text, sizeof e->text, fmt, ap);
        va_end(ap);
        tidy(e->text, sizeof e->text);
    }
    return s;
}

int dar_status_exit(dar_status s)
{
    static const int code[] = {
        [DAR_OK] = 0,
        [DAR_ERR_USAGE] = 2,
        [DAR_ERR_IO] = 2,
        [DAR_ERR_FORMAT] = 2,
        [DAR_ERR_NOMEM] = 3,
        [DAR_ERR_NUMERIC] = 1,
        [DAR_ERR_INTERRUPTED] = 130,
        [DAR_ERR_CHECK] = 1,
    };
    return code[s];
}

static void print_and_abort(const char *text, const char *file, int line)
{
    fprintf(stderr, "%s:%d: %s\n", file, line, text);
}

dar_abort_fn *dar_abort_handler = print_and_abort;

void dar_abort(const char *file, int line, const char *fmt, ...)
{
    char text[512];
    va_list ap;
    va_start(ap, fmt);
    vsnprintf(text, sizeof text, fmt, ap);
    va_end(ap);
    dar_abort_handler(text, file, line);
    abort();
}
