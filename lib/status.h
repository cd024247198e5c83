/* status.h: how things fail.
 *
 * The world fails (files, configuration, memory at start): a function returns dar_status and leaves one line in the
 * caller's dar_err.  Programmers fail (shapes, NULL, ranges): DAR_ASSERT stops the program, in release builds too. */
#ifndef DAR_LIB_STATUS_H
#define DAR_LIB_STATUS_H

typedef enum dar_status {
    DAR_OK = 0,
    DAR_ERR_USAGE,       /* wrong command line or configuration */
    DAR_ERR_IO,          /* the system refused: open, read, write, rename */
    DAR_ERR_FORMAT,      /* a file's content is not what its format says */
    DAR_ERR_NOMEM,       /* memory or disk is too small */
    DAR_ERR_NUMERIC,     /* NaN or Inf where numbers were expected */
    DAR_ERR_INTERRUPTED, /* stopped by a signal after saving */
    DAR_ERR_CHECK,       /* the work is done; what was checked or compared does not hold */
} dar_status;

/* One line for the person: which file or key, what was found, what was expected.  Cut to fit between two characters,
 * always terminated; control characters, which names from files may hold, are shown as '?'. */
typedef struct dar_err {
    char text[512];
} dar_err;

/* Write the message to e (which may be NULL) and return s. */
dar_status dar_fail(dar_err *e, dar_status s, const char *fmt, ...) __attribute__((format(printf, 3, 4)));

/* Exit status of a program that ends with s: 0 done, 2 wrong usage or bad input, 3 memory or disk, 130 interrupted;
 * 1 a numeric failure, or a check that says no. */
int dar_status_exit(dar_status s);

/* Called by a failed DAR_ASSERT with the formatted text.  The default prints to stderr and aborts.  A handler that
 * returns leads to abort(); tests install one that jumps away. */
typedef void dar_abort_fn(const char *text, const char *file, int line);
extern dar_abort_fn *dar_abort_handler;

void dar_abort(const char *file, int line, const char *fmt, ...) __attribute__((format(printf, 3, 4), noreturn));

#define DAR_ASSERT(cond, ...)                                                                                          \
    do {                                                                                                               \
        if (__builtin_expect(!(cond), 0)) dar_abort(__FILE__, __LINE__, __VA_ARGS__);                                  \
    } while (0)

#define DAR_TRY(call)                                                                                                  \
    do {                                                                                                               \
        dar_status dar_try_status = (call);                                                                            \
        if (dar_try_status != DAR_OK) return dar_try_status;                                                           \
    } while (0)

#define DAR_COUNT(array) (sizeof(array) / sizeof *(array))

#endif
