/* run.h: programs as people and scripts meet them: words in; exit status and what was printed out. */
#ifndef DAR_TESTS_RUN_H
#define DAR_TESTS_RUN_H

#include "tests/test.h"

#include <fcntl.h>
#include <ftw.h>
#include <spawn.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include "lib/file.h"

extern char **environ;

typedef struct run_result {
    int status; /* or 128 + signal */
    char out[1 << 16], err[1 << 14];
} run_result;

static run_result ran;

static inline void run_read(const char *path, char *text, size_t size)
{
    FILE *f = fopen(path, "rb");
    assert_non_null(f);
    text[fread(text, 1, size - 1, f)] = 0;
    fclose(f);
}

/* In the directory of the test; words end with NULL. */
static inline pid_t run_start(char *program, const char *const *words)
{
    char *argv[48] = { program };
    posix_spawn_file_actions_t a;
    pid_t pid;
    for (int i = 0; words[i]; i++) {
        assert_true(i < 46);
        argv[i + 1] = (char *)(uintptr_t)words[i];
    }
    posix_spawn_file_actions_init(&a);
    posix_spawn_file_actions_addopen(&a, 1, "out", O_WRONLY | O_CREAT | O_TRUNC, 0666);
    posix_spawn_file_actions_addopen(&a, 2, "err", O_WRONLY | O_CREAT | O_TRUNC, 0666);
    assert_int_equal(posix_spawn(&pid, program, &a, NULL, argv, environ), 0);
    posix_spawn_file_actions_destroy(&a);
    return pid;
}

static inline int run_finish(pid_t pid)
{
    int how;
    assert_int_equal(waitpid(pid, &how, 0), pid);
    run_read("out", ran.out, sizeof ran.out);
    run_read("err", ran.err, sizeof ran.err);
    return ran.status = WIFSIGNALED(how) ? 128 + WTERMSIG(how) : WEXITSTATUS(how);
}

/* PROGRAM from beside the test's own, whose name argv[0] is. */
static inline bool run_find(char path[PATH_MAX], const char *self, const char *program)
{
    char full[PATH_MAX];
    if (!realpath(self, full)) return false;
    *strrchr(full, '/') = 0;
    return (size_t)snprintf(path, PATH_MAX, "%s/%s", full, program) < PATH_MAX;
}

#define RUN_PROGRAM(program, ...) run_finish(run_start(program, (const char *const[]){ __VA_ARGS__, NULL }))

/* A test says what RUN runs.  GOOD: it does all there is to do; BAD: it ends with this status, and one line that has
 * these words in it. */
#define GOOD(...)                                                                                                      \
    do {                                                                                                               \
        int good_status = RUN(__VA_ARGS__);                                                                            \
        CHECK(good_status == 0, "status %d: %s", good_status, ran.err);                                                \
    } while (0)

#define BAD(expected, words, ...)                                                                                      \
    do {                                                                                                               \
        int bad_status = RUN(__VA_ARGS__);                                                                             \
        CHECK(bad_status == (expected) && strstr(ran.err, words) && run_one_line(ran.err), "status %d: %s",            \
              bad_status, ran.err);                                                                                    \
    } while (0)

static inline bool run_one_line(const char *text)
{
    const char *end = strchr(text, '\n');
    return end && !end[1] && end > text;
}

static inline int run_remove_entry(const char *path, const struct stat *st, int type, struct FTW *at)
{
    (void)st, (void)type, (void)at;
    return remove(path);
}

static inline int run_remove(const char *path)
{
    return nftw(path, run_remove_entry, 8, FTW_DEPTH | FTW_PHYS);
}

static inline void run_write(const char *path, const void *data, size_t size)
{
    FILE *f = fopen(path, "wb");
    assert_non_null(f);
    assert_int_equal(fwrite(data, 1, size, f), size);
    assert_int_equal(fclose(f), 0);
}

static inline bool run_is_there(const char *path)
{
    struct stat st;
    return lstat(path, &st) == 0;
}

static inline void run_same_file(const char *a, const char *b)
{
    dar_file_map x, y;
    dar_err e;
    CHECK(dar_file_map_open(&x, a, &e) == DAR_OK, "%s", e.text);
    CHECK(dar_file_map_open(&y, b, &e) == DAR_OK, "%s", e.text);
    CHECK(x.size == y.size && memcmp(x.data, y.data, x.size) == 0, "%s and %s differ", a, b);
    dar_file_map_close(&x);
    dar_file_map_close(&y);
}

#endif
