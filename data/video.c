/* video.c: the children ffmpeg and ffprobe, their pipes and their last words. */
#include "data/video.h"

#include <errno.h>
#include <fcntl.h>
#include <math.h>
#include <signal.h>
#include <spawn.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/wait.h>
#include <unistd.h>

#include "lib/file.h"

extern char **environ;

#define WORDS 200         /* bytes of a child's last line that are kept */
#define SMALL (256 * 256) /* [px] of pictures for which threads are not worth their start */

/* A running program, its input or output in `fd`, what it says on standard error in `said`. */
struct child {
    const char *program;
    pid_t pid; /* 0: none */
    int fd, said;
};

struct dar_video {
    struct child child;
    dar_file_out out; /* writing */
    size_t bytes;     /* of a frame */
    size_t frames;
    char path[PATH_MAX];
};

/* ---------------------------------------------------------------- children */

static void shut(int *fd)
{
    if (*fd >= 0) close(*fd);
    *fd = -1;
}

/* `end` is the child's standard input (0) or output (1); the other one is /dev/null. */
static int spawn(struct child *c, char *const argv[], int end, int theirs)
{
    posix_spawn_file_actions_t a;
    posix_spawnattr_t attr;
    sigset_t none, standard;
    int error = posix_spawn_file_actions_init(&a);
    if (error) return error;
    if ((error = posix_spawnattr_init(&attr)) != 0) {
        posix_spawn_file_actions_destroy(&a);
        return error;
    }
    sigemptyset(&none);
    sigemptyset(&standard);
    sigaddset(&standard, SIGPIPE);
    posix_spawnattr_setflags(&attr, POSIX_SPAWN_SETSIGMASK | POSIX_SPAWN_SETSIGDEF);
    posix_spawnattr_setsigmask(&attr, &none);
    posix_spawnattr_setsigdefault(&attr, &standard);
    error = posix_spawn_file_actions_adddup2(&a, theirs, end);
    if (!error) error = posix_spawn_file_actions_addopen(&a, !end, "/dev/null", O_RDWR, 0);
    if (!error) error = posix_spawn_file_actions_adddup2(&a, c->said, 2);
    if (!error) error = posix_spawnp(&c->pid, argv[0], &a, &attr, argv, environ);
    if (error) c->pid = 0;
    posix_spawnattr_destroy(&attr);
    posix_spawn_file_actions_destroy(&a);
    return error;
}

/* A socket, because a write to a child that is gone can then be told not to raise SIGPIPE. */
static dar_status start(struct child *c, char *const argv[], int end, const char *path, dar_err *e)
{
    int pair[2] = { -1, -1 }, error = 0;
    *c = (struct child){ .program = argv[0], .fd = -1 };
    c->said = memfd_create("stderr", MFD_CLOEXEC);
    if (c->said < 0 || socketpair(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0, pair) != 0) error = errno;
    if (!error) error = spawn(c, argv, end, pair[1]);
    c->fd = pair[0];
    shut(&pair[1]);
    if (!error) return DAR_OK;
    shut(&c->fd);
    shut(&c->said);
    if (error == ENOENT)
        return dar_fail(e, DAR_ERR_IO, "%s: %s is not installed, expected the Debian package ffmpeg", path, argv[0]);
    return dar_fail(e, DAR_ERR_IO, "%s: cannot start %s: %s", path, argv[0], strerror(error));
}

/* The last line that is not empty, without its end. */
static void last_line(int fd, char *line)
{
    char text[4096];
    off_t size = lseek(fd, 0, SEEK_END), from = size > (off_t)sizeof text - 1 ? size - ((off_t)sizeof text - 1) : 0;
    ssize_t n = pread(fd, text, sizeof text - 1, from);
    if (n < 0) n = 0;
    while (n && (text[n - 1] == '\n' || text[n - 1] == '\r')) n--;
    text[n] = 0;
    const char *start = strrchr(text, '\n');
    snprintf(line, WORDS, "%.*s", WORDS - 1, start ? start + 1 : text);
}

/* Close our end, wait, and tell how it went. */
static dar_status finish(struct child *c, const char *path, dar_err *e)
{
    int how = 0;
    char said[WORDS];
    shut(&c->fd);
    while (waitpid(c->pid, &how, 0) < 0)
        if (errno != EINTR) break;
    c->pid = 0;
    last_line(c->said, said);
    shut(&c->said);
    if (WIFSIGNALED(how))
        return dar_fail(e, DAR_ERR_IO, "%s: %s was killed by signal %d%s%s", path, c->program, WTERMSIG(how),
                        *said ? ": " : "", said);
    if (WEXITSTATUS(how) != 0)
        return dar_fail(e, DAR_ERR_FORMAT, "%s: %s ended with status %d: %s", path, c->program, WEXITSTATUS(how),
                        *said ? said : "no reason given");
    return DAR_OK;
}

/* 1: all of it; 0: the child closed its end; -1: errno. */
static int receive(int fd, void *to, size_t size)
{
    for (char *p = to; size;) {
        ssize_t n = read(fd, p, size);
        if (n < 0 && errno == EINTR) continue;
        if (n <= 0) return n < 0 ? -1 : 0;
        p += n;
        size -= (size_t)n;
    }
    return 1;
}

/* "file:" keeps a name from being taken for an option or a protocol. */
static dar_status as_file(char *to, size_t size, const char *path, dar_err *e)
{
    if (snprintf(to, size, "file:%s", path) < (int)size) return DAR_OK;
    return dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(ENAMETOOLONG));
}

static dar_status allocate(dar_video **out, const char *path, dar_err *e)
{
    dar_video *v = *out = calloc(1, sizeof *v);
    if (!v) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
    v->child.fd = v->child.said = -1;
    snprintf(v->path, sizeof v->path, "%s", path);
    return DAR_OK;
}

/* ---------------------------------------------------------------- writing */

static const struct {
    const char *format, *codec, *pixels, *key;
    int value;
} codecs[DAR_VIDEO_CODECS] = {
    [DAR_VIDEO_H264] = { "mp4", "libx264", "yuv420p", "-crf", 18 },
    [DAR_VIDEO_SMALL] = { "mp4", "libx264", "yuv420p", "-crf", 30 },
    [DAR_VIDEO_FFV1] = { "matroska", "ffv1", "bgr0", "-level", 3 },
    [DAR_VIDEO_X264RGB] = { "matroska", "libx264rgb", "rgb24", "-qp", 0 },
};

static bool for_people(dar_video_codec codec)
{
    return codec == DAR_VIDEO_H264 || codec == DAR_VIDEO_SMALL;
}

/* `name=value`, or NULL if there is none; on the heap. */
static dar_status tag(char **out, const char *path, const char *name, const char *value, dar_err *e)
{
    *out = NULL;
    if (!value || asprintf(out, "%s=%s", name, value) >= 0) return DAR_OK;
    return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", path);
}

static dar_status encode(dar_video *v, size_t width, size_t height, const dar_video_how *how, dar_err *e)
{
    const dar_video_codec codec = how->codec;
    char to[PATH_MAX + 8], size[32], rate[32], value[16], *comment;
    const char *argv[48] = { "ffmpeg",
                             "-nostdin",
                             "-v",
                             "error",
                             "-f",
                             "rawvideo",
                             "-pix_fmt",
                             "rgb24",
                             "-s",
                             size,
                             "-r",
                             rate,
                             "-i",
                             "pipe:0",
                             "-an",
                             "-c:v",
                             codecs[codec].codec,
                             codecs[codec].key,
                             value,
                             "-pix_fmt",
                             codecs[codec].pixels };
    static const char *const colour[] = { "-vf",
                                          "scale=out_color_matrix=bt709:out_range=tv",
                                          "-colorspace",
                                          "bt709",
                                          "-color_primaries",
                                          "bt709",
                                          "-color_trc",
                                          "bt709",
                                          "-color_range",
                                          "tv",
                                          "-movflags",
                                          "+faststart" };
    static const char *const alone[] = { "-threads", "1", "-filter_threads", "1" };
    size_t n = 21;
    DAR_TRY(as_file(to, sizeof to, v->out.temp, e));
    DAR_TRY(tag(&comment, v->path, "comment", how->comment, e));
    snprintf(size, sizeof size, "%zux%zu", width, height);
    snprintf(rate, sizeof rate, "%.6f", how->fps);
    snprintf(value, sizeof value, "%d", codecs[codec].value + how->coarser);
    for (size_t i = 0; i < DAR_COUNT(colour) && for_people(codec); i++) argv[n++] = colour[i];
    for (size_t i = 0; i < DAR_COUNT(alone) && width * height <= SMALL; i++) argv[n++] = alone[i];
    if (comment) {
        argv[n++] = "-metadata";
        argv[n++] = comment;
    }
    argv[n++] = "-f";
    argv[n++] = codecs[codec].format;
    argv[n++] = "-y";
    argv[n++] = to;
    dar_status s = start(&v->child, (char *const *)(uintptr_t)argv, 0, v->path, e);
    free(comment);
    return s;
}

dar_status dar_video_create(dar_video **out, const char *path, size_t width, size_t height, const dar_video_how *how,
                            dar_err *e)
{
    DAR_ASSERT((unsigned)how->codec < DAR_VIDEO_CODECS, "%s: codec %d", path, (int)how->codec);
    DAR_ASSERT(width && height && width <= DAR_VIDEO_MAX_SIDE && height <= DAR_VIDEO_MAX_SIDE, "%s: %zux%zu", path,
               width, height);
    DAR_ASSERT(how->fps > 0 && how->fps <= 1000, "%s: %g frames per second", path, how->fps);
    *out = NULL;
    DAR_ASSERT(!how->coarser || for_people(how->codec), "%s: codec %d is exact", path, (int)how->codec);
    if (for_people(how->codec) && (width | height) & 1)
        return dar_fail(e, DAR_ERR_USAGE, "%s: found %zux%zu, expected even sides for yuv420p", path, width, height);
    dar_status s = allocate(out, path, e);
    if (s == DAR_OK) s = dar_file_create(&(*out)->out, path, e);
    if (s == DAR_OK) s = encode(*out, width, height, how, e);
    if (s == DAR_OK) {
        (*out)->bytes = 3 * width * height;
    } else {
        dar_video_close(*out);
        *out = NULL;
    }
    return s;
}

dar_status dar_video_write(dar_video *v, const uint8_t *rgb, dar_err *e)
{
    size_t left = v->bytes;
    while (left) {
        ssize_t n = v->child.fd < 0 ? -1 : send(v->child.fd, rgb, left, MSG_NOSIGNAL);
        if (n < 0 && errno == EINTR) continue;
        if (n < 0) {
            int error = errno;
            if (v->child.pid) DAR_TRY(finish(&v->child, v->path, e)); /* its own words are the better reason */
            return dar_fail(e, DAR_ERR_IO, "%s: ffmpeg takes no more frames: %s", v->path, strerror(error));
        }
        rgb += n;
        left -= (size_t)n;
    }
    v->frames++;
    return DAR_OK;
}

dar_status dar_video_commit(dar_video *v, dar_err *e)
{
    DAR_ASSERT(v->out.temp[0], "%s: not open for writing", v->path);
    if (!v->frames) return dar_fail(e, DAR_ERR_USAGE, "%s: no frame was written", v->path);
    if (!v->child.pid) return dar_fail(e, DAR_ERR_IO, "%s: ffmpeg ended early", v->path);
    DAR_TRY(finish(&v->child, v->path, e));
    return dar_file_commit(&v->out, e);
}

void dar_video_close(dar_video *v)
{
    dar_err ignored;
    if (!v) return;
    if (v->child.pid) {
        kill(v->child.pid, SIGKILL);
        finish(&v->child, v->path, &ignored);
    }
    shut(&v->child.fd);
    shut(&v->child.said);
    dar_file_discard(&v->out);
    free(v);
}

/* ---------------------------------------------------------------- reading */

/* "width=5\nheight=4\nr_frame_rate=25/1\nnb_read_packets=3\n", in any order. */
static double field(const char *text, const char *key)
{
    const char *p = strstr(text, key);
    char *end;
    if (!p) return NAN;
    double x = strtod(p + strlen(key), &end);
    if (*end == '/') x /= strtod(end + 1, NULL);
    return x;
}

dar_status dar_video_probe(dar_video_info *info, const char *path, dar_err *e)
{
    char from[PATH_MAX + 8], text[1024] = "";
    struct child c;
    dar_file_map m;
    *info = (dar_video_info){ 0 };
    DAR_TRY(dar_file_map_open(&m, path, e)); /* says clearly that there is no such file */
    dar_file_map_close(&m);
    DAR_TRY(as_file(from, sizeof from, path, e));
    const char *argv[] = { "ffprobe",
                           "-v",
                           "error",
                           "-select_streams",
                           "v:0",
                           "-count_packets",
                           "-show_entries",
                           "stream=width,height,r_frame_rate,nb_read_packets",
                           "-of",
                           "default=nw=1",
                           from,
                           NULL };
    DAR_TRY(start(&c, (char *const *)(uintptr_t)argv, 1, path, e));
    receive(c.fd, text, sizeof text - 1);
    DAR_TRY(finish(&c, path, e));
    double w = field(text, "width="), h = field(text, "height="), n = field(text, "nb_read_packets=");
    info->fps = field(text, "r_frame_rate=");
    if (!(w >= 1 && h >= 1 && w <= DAR_VIDEO_MAX_SIDE && h <= DAR_VIDEO_MAX_SIDE && n >= 1 && n < 1e9 &&
          info->fps > 0 && info->fps < 1e6))
        return dar_fail(e, DAR_ERR_FORMAT, "%s: found no video that can be read (%gx%g, %g frames, %g per second)",
                        path, w, h, n, info->fps);
    info->width = (size_t)w;
    info->height = (size_t)h;
    info->frames = (size_t)n;
    return DAR_OK;
}

dar_status dar_video_open(dar_video **out, dar_video_info *info, const char *path, dar_err *e)
{
    char from[PATH_MAX + 8];
    *out = NULL;
    DAR_TRY(dar_video_probe(info, path, e));
    DAR_TRY(as_file(from, sizeof from, path, e));
    DAR_TRY(allocate(out, path, e));
    const char *argv[] = { "ffmpeg", "-nostdin", "-v",          "error", "-noautorotate", "-i",       from,    "-map",
                           "0:v:0",  "-vsync",   "passthrough", "-f",    "rawvideo",      "-pix_fmt", "rgb24", "pipe:1",
                           NULL };
    dar_status s = start(&(*out)->child, (char *const *)(uintptr_t)argv, 1, path, e);
    if (s == DAR_OK) {
        (*out)->bytes = 3 * info->width * info->height;
    } else {
        dar_video_close(*out);
        *out = NULL;
    }
    return s;
}

dar_status dar_video_read(dar_video *v, uint8_t *rgb, dar_err *e)
{
    int got = v->child.fd < 0 ? 0 : receive(v->child.fd, rgb, v->bytes);
    if (got > 0) {
        v->frames++;
        return DAR_OK;
    }
    if (got < 0) return dar_fail(e, DAR_ERR_IO, "%s: %s", v->path, strerror(errno));
    if (v->child.pid) DAR_TRY(finish(&v->child, v->path, e));
    return dar_fail(e, DAR_ERR_FORMAT, "%s: ends after %zu frames", v->path, v->frames);
}
