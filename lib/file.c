/* file.c: mapping, and replacing by rename. */
#include "lib/file.h"

#include <errno.h>
#include <fcntl.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#define WRITE_MAX ((size_t)1 << 30) /* one write(2) takes just under 2 GiB */

dar_status dar_file_map_open(dar_file_map *m, const char *path, dar_err *e)
{
    dar_status s = DAR_OK;
    struct stat st;
    int fd = open(path, O_RDONLY | O_CLOEXEC | O_NONBLOCK); /* a pipe without a writer must not hang */

    *m = (dar_file_map){ 0 };
    if (fd < 0) return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
    if (fstat(fd, &st) != 0) {
        s = dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
    } else if (!S_ISREG(st.st_mode)) {
        s = dar_fail(e, DAR_ERR_IO, "%s: not a regular file", path);
    } else if (st.st_size > 0) {
        void *p = mmap(NULL, (size_t)st.st_size, PROT_READ, MAP_PRIVATE, fd, 0);
        if (p == MAP_FAILED) {
            s = dar_fail(e, DAR_ERR_IO, "%s: cannot map %lld bytes: %s", path, (long long)st.st_size, strerror(errno));
        } else {
            m->data = p;
            m->size = (size_t)st.st_size;
        }
    }
    close(fd);
    return s;
}

void dar_file_map_close(dar_file_map *m)
{
    if (m->data) munmap((void *)(uintptr_t)m->data, m->size);
    *m = (dar_file_map){ 0 };
}

void dar_file_map_rest(const dar_file_map *m)
{
    if (m->data) madvise((void *)(uintptr_t)m->data, m->size, MADV_DONTNEED);
}

static dar_status refused(const dar_file_out *o, int error, dar_err *e)
{
    bool full = error == ENOSPC || error == EDQUOT || error == EFBIG;
    return dar_fail(e, full ? DAR_ERR_NOMEM : DAR_ERR_IO, "%s: %s", o->path, strerror(error));
}

dar_status dar_file_create(dar_file_out *o, const char *path, dar_err *e)
{
    o->fd = -1;
    o->temp[0] = 0;
    int n = snprintf(o->path, sizeof o->path, "%s", path);
    int m = snprintf(o->temp, sizeof o->temp, "%s.tmp-%ld", path, (long)getpid());
    if (n >= (int)sizeof o->path || m >= (int)sizeof o->temp) {
        o->temp[0] = 0;
        return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(ENAMETOOLONG));
    }
    o->fd = open(o->temp, O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666);
    if (o->fd >= 0) return DAR_OK;
    o->temp[0] = 0;
    return refused(o, errno, e);
}

dar_status dar_file_write(dar_file_out *o, const void *data, size_t size, dar_err *e)
{
    const char *p = data;
    while (size) {
        ssize_t n = write(o->fd, p, size < WRITE_MAX ? size : WRITE_MAX);
        if (n < 0 && errno == EINTR) continue;
        if (n < 0) return refused(o, errno, e);
        p += n;
        size -= (size_t)n;
    }
    return DAR_OK;
}

dar_status dar_file_flush(dar_file_out *o, dar_err *e)
{
    if (o->fd < 0) return DAR_OK;
    int error = fsync(o->fd) != 0 ? errno : 0;
    if (close(o->fd) != 0 && !error) error = errno; /* some file systems tell of a full disk only here */
    o->fd = -1;
    return error ? refused(o, error, e) : DAR_OK;
}

int dar_file_flush_entry(const char *path)
{
    char dir[PATH_MAX];
    const char *slash = strrchr(path, '/');
    if (!slash) snprintf(dir, sizeof dir, ".");
    else snprintf(dir, sizeof dir, "%.*s", slash == path ? 1 : (int)(slash - path), path);

    int fd = open(dir, O_RDONLY | O_DIRECTORY | O_CLOEXEC), error = 0;
    if (fd < 0) return errno;
    if (fsync(fd) != 0 && errno != EINVAL) error = errno; /* EINVAL: this file system has nothing to flush */
    close(fd);
    return error;
}

dar_status dar_file_commit(dar_file_out *o, dar_err *e)
{
    DAR_TRY(dar_file_flush(o, e));
    if (rename(o->temp, o->path) != 0) return refused(o, errno, e);
    o->temp[0] = 0;
    int error = dar_file_flush_entry(o->path);
    return error ? refused(o, error, e) : DAR_OK;
}

void dar_file_discard(dar_file_out *o)
{
    if (!o->path[0]) return; /* zeroed: fd 0 is not ours */
    if (o->fd >= 0) close(o->fd);
    o->fd = -1;
    if (o->temp[0]) unlink(o->temp);
    o->temp[0] = 0;
}
