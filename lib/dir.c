/* dir.c: directories written under another name and renamed. */
#include "lib/dir.h"

#include <dirent.h>
#include <errno.h>
#include <fcntl.h>
#include <ftw.h>
#include <stdio.h>
#include <string.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include "lib/file.h"

#define OPEN_MOST 16  /* directories that a walk holds open */
#define TRIES     100 /* names, should others take them */

static const char mark[] = ".tmp-";

static dar_status refused(const char *path, int error, dar_err *e)
{
    bool full = error == ENOSPC || error == EDQUOT;
    return dar_fail(e, full ? DAR_ERR_NOMEM : DAR_ERR_IO, "%s: %s", path, strerror(error));
}

/* ---------------------------------------------------------------- whole trees */

static int remove_entry(const char *path, const struct stat *st, int type, struct FTW *at)
{
    (void)st;
    (void)type;
    (void)at;
    return remove(path);
}

static int remove_tree(const char *path)
{
    return nftw(path, remove_entry, OPEN_MOST, FTW_DEPTH | FTW_PHYS);
}

static int flush_entry(const char *path, const struct stat *st, int type, struct FTW *at)
{
    char inside[PATH_MAX];
    (void)st;
    (void)at;
    if (type != FTW_D) return 0;
    int n = snprintf(inside, sizeof inside, "%s/.", path);
    return n < (int)sizeof inside ? dar_file_flush_entry(inside) : ENAMETOOLONG;
}

/* ---------------------------------------------------------------- temporary names */

/* Open and lock; -1 with errno EWOULDBLOCK: a writer that lives has it.  A file system without locks gives the
 * directory without one. */
static int lock_directory(const char *path, bool *locked)
{
    int fd = open(path, O_RDONLY | O_DIRECTORY | O_NOFOLLOW | O_CLOEXEC);
    *locked = false;
    if (fd < 0) return -1;
    *locked = flock(fd, LOCK_EX | LOCK_NB) == 0;
    if (*locked || errno != EWOULDBLOCK) return fd;
    close(fd);
    errno = EWOULDBLOCK;
    return -1;
}

bool dar_dir_temporary(const char *name)
{
    const char *at = strstr(name, mark);
    return at && at > name && at[strlen(mark)] && !at[strlen(mark) + strspn(at + strlen(mark), "0123456789-")];
}

/* Remove what dead writers of the target left. */
static void sweep(const char *target)
{
    char dir[PATH_MAX], path[PATH_MAX];
    const char *slash = strrchr(target, '/'), *base = slash ? slash + 1 : target;
    size_t length = strlen(base);
    if (slash) snprintf(dir, sizeof dir, "%.*s", (int)(slash - target) + 1, target);
    else snprintf(dir, sizeof dir, "./");

    DIR *d = opendir(dir);
    for (const struct dirent *x; d && (x = readdir(d));) {
        bool locked = false;
        if (strncmp(x->d_name, base, length) != 0 || strncmp(x->d_name + length, mark, strlen(mark)) != 0) continue;
        if (snprintf(path, sizeof path, "%s%s", dir, x->d_name) >= (int)sizeof path) continue;
        int fd = lock_directory(path, &locked);
        if (locked) remove_tree(path);
        if (fd >= 0) close(fd);
    }
    if (d) closedir(d);
}

/* Whether what was opened still has this name: a sweep of another writer may have come between making and locking. */
static bool still_there(int fd, const char *path)
{
    struct stat a, b;
    return fstat(fd, &a) == 0 && stat(path, &b) == 0 && a.st_dev == b.st_dev && a.st_ino == b.st_ino;
}

static int make_temp(dar_dir_out *o)
{
    for (int i = 0; i < TRIES; i++) {
        bool locked;
        int n = snprintf(o->temp, sizeof o->temp, "%s%s%ld-%d", o->path, mark, (long)getpid(), i);
        if (n >= (int)sizeof o->temp) return ENAMETOOLONG;
        if (mkdir(o->temp, 0777) != 0) {
            if (errno == EEXIST) continue;
            return errno;
        }
        o->lock = lock_directory(o->temp, &locked);
        if (o->lock >= 0 && still_there(o->lock, o->temp)) return 0;
        if (o->lock >= 0) close(o->lock);
        o->lock = -1;
    }
    return EEXIST;
}

/* ---------------------------------------------------------------- writing */

static dar_status make_one(const char *path, dar_err *e)
{
    if (mkdir(path, 0777) == 0 || errno == EEXIST) return DAR_OK;
    return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
}

/* The directories that `path` lies in. */
static dar_status make_parents(const char *path, dar_err *e)
{
    char part[PATH_MAX];
    if (snprintf(part, sizeof part, "%s", path) >= (int)sizeof part)
        return dar_fail(e, DAR_ERR_USAGE, "%s: the path is too long", path);
    for (char *p = part + 1; *p; p++) {
        if (*p != '/') continue;
        *p = 0;
        DAR_TRY(make_one(part, e));
        *p = '/';
    }
    return DAR_OK;
}

dar_status dar_dir_make(const char *path, dar_err *e)
{
    DAR_TRY(make_parents(path, e));
    return make_one(path, e);
}

dar_status dar_dir_create(dar_dir_out *o, const char *path, dar_err *e)
{
    size_t length = strlen(path);
    o->lock = -1;
    o->temp[0] = o->path[0] = 0;
    while (length > 1 && path[length - 1] == '/') length--;
    if (length >= sizeof o->path) return refused(path, ENAMETOOLONG, e);
    snprintf(o->path, sizeof o->path, "%.*s", (int)length, path);
    DAR_TRY(make_parents(o->path, e));
    sweep(o->path);
    int error = make_temp(o);
    if (!error) return DAR_OK;
    o->temp[0] = 0;
    return refused(o->path, error, e);
}

/* Rename to a name that nobody has.  Where the file system knows no such call, a plain rename keeps the promise but for
 * an empty directory, which it replaces. */
static int rename_new(const dar_dir_out *o)
{
    if (renameat2(AT_FDCWD, o->temp, AT_FDCWD, o->path, RENAME_NOREPLACE) == 0) return 0;
    if (errno != EINVAL && errno != ENOSYS) return errno;
    return rename(o->temp, o->path) == 0 ? 0 : errno;
}

dar_status dar_dir_commit(dar_dir_out *o, bool overwrite, dar_err *e)
{
    DAR_ASSERT(o->lock >= 0 && o->temp[0], "%s: not open for writing", o->path);
    int error = nftw(o->temp, flush_entry, OPEN_MOST, FTW_PHYS);
    if (error) return refused(o->temp, error < 0 ? errno : error, e);
    error = rename_new(o);
    bool exchanged = false;
    if (error == EEXIST || error == ENOTEMPTY || error == ENOTDIR) {
        if (!overwrite) return dar_fail(e, DAR_ERR_IO, "%s: is there already; it is not overwritten unasked", o->path);
        exchanged = renameat2(AT_FDCWD, o->temp, AT_FDCWD, o->path, RENAME_EXCHANGE) == 0;
        error = exchanged ? 0 : errno;
        if (error == EINVAL || error == ENOSYS)
            return dar_fail(e, DAR_ERR_IO, "%s: this file system cannot replace a directory: remove it first", o->path);
    }
    if (error) return refused(o->path, error, e);
    if (!exchanged) o->temp[0] = 0; /* else it holds what was replaced, for dar_dir_discard */
    error = dar_file_flush_entry(o->path);
    return error ? refused(o->path, error, e) : DAR_OK;
}

void dar_dir_discard(dar_dir_out *o)
{
    if (!o->path[0]) return; /* zeroed: descriptor 0 is not ours */
    if (o->temp[0]) remove_tree(o->temp);
    if (o->lock >= 0) close(o->lock);
    o->lock = -1;
    o->temp[0] = 0;
}

/* ---------------------------------------------------------------- directories that are there */

dar_status dar_dir_remove(const char *path, dar_err *e)
{
    char gone[PATH_MAX];
    int n = snprintf(gone, sizeof gone, "%s%s%ld", path, mark, (long)getpid());
    bool moved = n < (int)sizeof gone && rename(path, gone) == 0;
    if (moved) dar_file_flush_entry(gone);
    return remove_tree(moved ? gone : path) == 0 ? DAR_OK : refused(path, errno, e);
}

static dar_status link_entry(const char *from, const char *to, dar_err *e)
{
    struct stat st;
    if (lstat(from, &st) != 0) return refused(from, errno, e);
    if (S_ISDIR(st.st_mode)) return dar_dir_link(from, to, e);
    return link(from, to) == 0 ? DAR_OK : refused(to, errno, e);
}

dar_status dar_dir_link(const char *from, const char *to, dar_err *e)
{
    char a[PATH_MAX], b[PATH_MAX];
    dar_status s = DAR_OK;
    DIR *d = opendir(from);
    if (!d) return refused(from, errno, e);
    if (mkdir(to, 0777) != 0) s = refused(to, errno, e);
    for (const struct dirent *x; s == DAR_OK && (x = readdir(d));) {
        if (strcmp(x->d_name, ".") == 0 || strcmp(x->d_name, "..") == 0) continue;
        if (snprintf(a, sizeof a, "%s/%s", from, x->d_name) >= (int)sizeof a ||
            snprintf(b, sizeof b, "%s/%s", to, x->d_name) >= (int)sizeof b)
            s = refused(to, ENAMETOOLONG, e);
        else s = link_entry(a, b, e);
    }
    closedir(d);
    return s;
}

dar_status dar_dir_lock(int *fd, const char *path, dar_err *e)
{
    bool locked;
    *fd = lock_directory(path, &locked);
    if (*fd >= 0) return DAR_OK;
    if (errno != EWOULDBLOCK) return refused(path, errno, e);
    return dar_fail(e, DAR_ERR_USAGE, "%s: another program is writing there", path);
}
