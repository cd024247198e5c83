/* scratch.h: a directory of a test program's own, and what a call that reads or writes there must answer.
 *
 *     cmocka_run_group_tests(tests, scratch_make, scratch_remove) */
#ifndef DAR_TESTS_SCRATCH_H
#define DAR_TESTS_SCRATCH_H

#include "tests/run.h"

static char scratch_dir[32];

static inline int scratch_make(void **state)
{
    (void)state;
    snprintf(scratch_dir, sizeof scratch_dir, "/tmp/dar-test-XXXXXX");
    return mkdtemp(scratch_dir) ? 0 : -1;
}

static inline int scratch_remove(void **state)
{
    (void)state;
    return run_remove(scratch_dir);
}

/* The same, and the program works there. */
static inline int scratch_enter(void **state)
{
    return scratch_make(state) == 0 ? chdir(scratch_dir) : -1;
}

static inline int scratch_leave(void **state)
{
    return chdir("/") == 0 ? scratch_remove(state) : -1;
}

/* NAME in it; the four last answers stay. */
static inline const char *in_dir(const char *name)
{
    static char path[4][512];
    static int turn;
    turn = (turn + 1) % 4;
    snprintf(path[turn], sizeof path[turn], "%s/%s", scratch_dir, name);
    return path[turn];
}

/* A file of this text. */
static inline void scratch_text(const char *path, const char *text)
{
    run_write(path, text, strlen(text));
}

static inline void ok(dar_status s, const dar_err *e)
{
    CHECK(s == DAR_OK, "refused: %s", e->text);
}

/* The one line has these words in it. */
static inline void refused(dar_status found, const dar_err *e, const char *says)
{
    CHECK(found != DAR_OK, "accepted, expected: %s", says);
    CHECK(strstr(e->text, says), "message: %s; expected: %s", e->text, says);
}

#endif
