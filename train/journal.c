/* journal.c: see journal.h.  Tables and pictures are in journal_draw.c. */
#include "train/journal.h"

#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/resource.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>

#include "lib/file.h"
#include "lib/log.h"
#include "lib/thread.h"
#include "train/journal_inside.h"

#define LINE_MOST  65536 /* bytes of a line; a longer one is none of ours */
#define DRAW_SHARE 20    /* drawing takes at most one part of so many of the time */

struct dar_journal {
    dar_journal_options o;
    char path[PATH_MAX];
    int fd;
    off_t size; /* of whole lines */
    dar_json_writer w;
    double smoothed, weight; /* of all losses so far */
    int64_t skipped;
    dar_progress progress;
    bool stale;               /* lines came after the pictures */
    double drawn, draw_takes; /* [s] */
};

/* ---------------------------------------------------------------- what is there already */

static double number_of(dar_json line, const char *key)
{
    return dar_json_get(line, key).item ? dar_json_number(line, key, NAN, -INFINITY, INFINITY) : NAN;
}

/* Whether text[0, size) is a line that says which step it is of. */
static bool read_line(const char *text, size_t size, dar_json_doc **doc, dar_journal_past *x)
{
    if (dar_json_parse(doc, DAR_JOURNAL_LOG, text, size, NULL) != DAR_OK) return false;
    dar_json j = dar_json_root(*doc);
    x->kind = dar_json_text(j, "kind", NULL);
    x->step = dar_json_int(j, "step", DAR_JSON_NEEDED, 0, DAR_JSON_MAX_INT);
    x->loss = number_of(j, "loss");
    x->smoothed = number_of(j, "smoothed");
    x->sigma = number_of(j, "sigma");
    x->norm = number_of(j, "norm");
    x->rate = number_of(j, "rate");
    x->seconds = number_of(j, "seconds");
    x->peak_bytes = number_of(j, "peak_bytes");
    x->shuffled = number_of(j, "shuffled");
    x->psnr = number_of(j, "psnr");
    dar_json_accept(j);
    x->skipped = isnan(x->norm); /* "skipped" may be null */
    return dar_json_finish(*doc, NULL) == DAR_OK;
}

/* By lines, not mapped: a log of many steps would count as memory of the program. */
dar_status dar_journal_scan(const char *path, dar_journal_fn *fn, void *ctx, dar_err *e)
{
    char line[LINE_MOST];
    size_t at = 0;
    bool more = true;
    FILE *f = fopen(path, "rb");
    if (!f) return errno == ENOENT ? DAR_OK : dar_fail(e, DAR_ERR_IO, "%s: %s", path, strerror(errno));
    while (more && fgets(line, sizeof line, f)) {
        size_t size = strlen(line);
        dar_json_doc *doc = NULL;
        dar_journal_past x;
        if (!size || line[size - 1] != '\n') break;
        x.end = at += size;
        more = read_line(line, size - 1, &doc, &x) && fn(ctx, &x);
        dar_json_close(doc);
    }
    bool failed = ferror(f) != 0;
    fclose(f);
    return failed ? dar_fail(e, DAR_ERR_IO, "%s: cannot be read", path) : DAR_OK;
}

struct taking_up {
    dar_journal *j;
    int64_t resumed;
};

/* Keep a line that is not after the step resumed. */
static bool take_up(void *ctx, const dar_journal_past *x)
{
    struct taking_up *t = ctx;
    dar_journal *j = t->j;
    if (x->step > t->resumed) return false;
    j->size = (off_t)x->end;
    if (strcmp(x->kind, "step") != 0) return true;
    j->skipped += x->skipped;
    if (isfinite(x->loss)) j->weight = DAR_JOURNAL_DECAY * j->weight + 1;
    if (isfinite(x->smoothed)) j->smoothed = x->smoothed;
    return true;
}

static dar_status refused(const dar_journal *j, int error, dar_err *e)
{
    bool full = error == ENOSPC || error == EDQUOT || error == EFBIG;
    return dar_fail(e, full ? DAR_ERR_NOMEM : DAR_ERR_IO, "%s: %s", j->path, strerror(error));
}

static dar_status take_up_log(dar_journal *j, int64_t resumed, dar_err *e)
{
    struct taking_up t = { j, resumed };
    if (snprintf(j->path, sizeof j->path, "%s/%s", j->o.run, DAR_JOURNAL_LOG) >= (int)sizeof j->path)
        return refused(j, ENAMETOOLONG, e);
    if (resumed) DAR_TRY(dar_journal_scan(j->path, take_up, &t, e));
    j->fd = open(j->path, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0666);
    if (j->fd < 0 || ftruncate(j->fd, j->size) != 0 || fsync(j->fd) != 0) return refused(j, errno, e);
    int error = dar_file_flush_entry(j->path);
    return error ? refused(j, error, e) : DAR_OK;
}

/* ---------------------------------------------------------------- lines */

dar_json_writer *dar_journal_line(dar_journal *j, const char *kind, int64_t step)
{
    dar_json_writer_reset(&j->w);
    dar_json_write_object(&j->w, NULL);
    dar_json_write_text(&j->w, "kind", kind);
    dar_json_write_int(&j->w, "step", step);
    return &j->w;
}

dar_status dar_journal_end(dar_journal *j, dar_err *e)
{
    dar_json_write_end(&j->w);
    if (j->w.failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", j->path);
    char *text = j->w.text;
    size_t size = j->w.size + 1, done = 0;
    text[j->w.size] = '\n';
    while (done < size) {
        ssize_t n = write(j->fd, text + done, size - done);
        if (n < 0 && errno == EINTR) continue;
        if (n < 0) {
            int error = errno;
            if (ftruncate(j->fd, j->size) != 0) dar_log(DAR_LOG_WARNING, "%s: %s", j->path, strerror(errno));
            return refused(j, error, e);
        }
        done += (size_t)n;
    }
    j->size += (off_t)size;
    j->stale = true;
    return DAR_OK;
}

static dar_status write_start(dar_journal *j, int64_t step, dar_err *e)
{
    char text[32];
    time_t now = time(NULL);
    struct tm tm;
    dar_json_writer *w = dar_journal_line(j, "start", step);
    strftime(text, sizeof text, "%Y-%m-%dT%H:%M:%SZ", gmtime_r(&now, &tm));
    dar_json_write_text(w, "time", text);
    dar_json_write_int(w, "threads", dar_threads());
    return dar_journal_end(j, e);
}

/* Most memory that the program ever had [bytes]. */
static double peak_bytes(void)
{
    struct rusage r;
    return getrusage(RUSAGE_SELF, &r) == 0 ? 1024.0 * (double)r.ru_maxrss : 0;
}

static void show(dar_journal *j, const dar_journal_entry *x)
{
    char note[256];
    const dar_journal_options *o = &j->o;
    int n = snprintf(note, sizeof note, "loss %.4g (%.4g), norm %.3g, lr %.3g", x->loss, j->smoothed, x->norm, x->rate);
    if (o->tokens > 0) n += snprintf(note + n, sizeof note - (size_t)n, ", %.0f tokens/s", o->tokens / x->seconds);
    if (o->flops > 0 && o->peak > 0)
        n += snprintf(note + n, sizeof note - (size_t)n, ", %.0f %% of peak", 100 * o->flops / x->seconds / o->peak);
    n += snprintf(note + n, sizeof note - (size_t)n, ", %.2f GB", peak_bytes() / 1e9);
    if (j->skipped) snprintf(note + n, sizeof note - (size_t)n, ", %lld skipped", (long long)j->skipped);
    dar_progress_step(&j->progress, (double)x->step, note);
}

dar_status dar_journal_step(dar_journal *j, const dar_journal_entry *x, dar_err *e)
{
    const dar_journal_options *o = &j->o;
    if (isfinite(x->loss)) {
        j->weight = DAR_JOURNAL_DECAY * j->weight + 1;
        j->smoothed = j->weight > 1 ? j->smoothed + (x->loss - j->smoothed) / j->weight : x->loss;
    }
    dar_json_writer *w = dar_journal_line(j, "step", x->step);
    dar_json_write_number(w, "loss", x->loss);
    dar_json_write_number(w, "smoothed", j->smoothed);
    dar_json_write_number(w, "sigma", x->sigma);
    dar_json_write_number(w, "norm", x->norm);
    dar_json_write_number(w, "rate", x->rate);
    dar_json_write_number(w, "seconds", x->seconds);
    if (o->tokens > 0) dar_json_write_number(w, "tokens_per_second", o->tokens / x->seconds);
    if (o->flops > 0 && o->peak > 0) dar_json_write_number(w, "fraction_of_peak", o->flops / x->seconds / o->peak);
    dar_json_write_number(w, "peak_bytes", peak_bytes());
    if (x->skipped) {
        j->skipped++;
        if (x->nonfinite) dar_json_write_text(w, "skipped", x->nonfinite);
        else dar_json_write_null(w, "skipped");
        dar_log(DAR_LOG_WARNING, "step %lld: skipped: gradients are not finite: %s", (long long)x->step,
                x->nonfinite ? x->nonfinite : "the sum of their squares");
    }
    DAR_TRY(dar_journal_end(j, e));
    show(j, x);
    return DAR_OK;
}

double dar_journal_smoothed(const dar_journal *j)
{
    return j->smoothed;
}

/* ---------------------------------------------------------------- the rest */

static void draw(dar_journal *j)
{
    double began = dar_log_clock();
    dar_err e;
    if (dar_journal_draw(j->o.run, &e) != DAR_OK) dar_log(DAR_LOG_WARNING, "%s", e.text);
    j->stale = false;
    j->drawn = dar_log_clock();
    j->draw_takes = j->drawn - began;
}

dar_status dar_journal_flush(dar_journal *j, dar_err *e)
{
    if (fsync(j->fd) != 0) return refused(j, errno, e);
    if (j->stale && dar_log_clock() - j->drawn >= DRAW_SHARE * j->draw_takes) draw(j);
    return DAR_OK;
}

dar_status dar_journal_open(dar_journal **out, const dar_journal_options *o, int64_t resumed, dar_err *e)
{
    dar_journal *j = calloc(1, sizeof *j);
    *out = NULL;
    if (!j) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", o->run);
    *j = (dar_journal){ .o = *o, .fd = -1, .smoothed = NAN };
    dar_status s = take_up_log(j, resumed, e);
    if (s == DAR_OK) s = write_start(j, resumed, e);
    if (s != DAR_OK) {
        if (j->fd >= 0) close(j->fd);
        dar_json_writer_free(&j->w);
        free(j);
        return s;
    }
    j->stale = false;
    j->progress = dar_progress_begin("train", "steps", (double)o->steps);
    j->progress.from = j->progress.done = (double)resumed;
    *out = j;
    return DAR_OK;
}

void dar_journal_close(dar_journal *j)
{
    if (!j) return;
    dar_progress_end(&j->progress);
    if (j->stale) draw(j);
    close(j->fd);
    dar_json_writer_free(&j->w);
    free(j);
}
