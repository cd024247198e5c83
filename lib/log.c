/* log.c: one lock, one line at a time. */
#include "lib/log.h"

#include <pthread.h>
#include <stdarg.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/ioctl.h>
#include <time.h>
#include <unistd.h>

#define LINE_MAX_BYTES 1024

static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static dar_log_level most = DAR_LOG_INFO;
static bool line_open; /* a progress line stands on the terminal, without its end */

static bool on_terminal(void)
{
    const char *term = getenv("TERM");
    return isatty(STDERR_FILENO) && term && strcmp(term, "dumb") != 0;
}

/* Called with the lock held. */
static void put_line(const char *text, bool keep_open)
{
    char line[LINE_MAX_BYTES + 32];
    int n = snprintf(line, sizeof line, "%s%s%s", line_open ? "\r\033[K" : "", text, keep_open ? "" : "\n");
    line_open = keep_open;
    fwrite(line, 1, (size_t)n < sizeof line ? (size_t)n : sizeof line - 1, stderr);
    fflush(stderr);
}

void dar_log_set(dar_log_level level)
{
    pthread_mutex_lock(&lock);
    most = level;
    pthread_mutex_unlock(&lock);
}

void dar_log(dar_log_level level, const char *fmt, ...)
{
    static const char *const prefix[] = { "error: ", "warning: ", "", "debug: " };
    char text[LINE_MAX_BYTES];
    int n = snprintf(text, sizeof text, "%s", prefix[level]);
    va_list ap;

    va_start(ap, fmt);
    vsnprintf(text + n, sizeof text - (size_t)n, fmt, ap);
    va_end(ap);
    for (char *p = text; *p; p++)
        if ((unsigned char)*p < 0x20) *p = ' ';

    pthread_mutex_lock(&lock);
    if (level <= most) put_line(text, false);
    pthread_mutex_unlock(&lock);
}

/* ---------------------------------------------------------------- progress */

double dar_log_clock(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

char *dar_log_duration(double seconds, char *buf, size_t size)
{
    if (seconds < 9.95) {
        snprintf(buf, size, "%.1f s", seconds);
        return buf;
    }
    double s = seconds < 1e9 ? (double)(long)(seconds + 0.5) : 1e9;
    long n = (long)s;
    if (n < 60) snprintf(buf, size, "%ld s", n);
    else if (n < 3600) snprintf(buf, size, "%ld min %ld s", n / 60, n % 60);
    else if (n < 86400) snprintf(buf, size, "%ld h %ld min", n / 3600, n % 3600 / 60);
    else snprintf(buf, size, "%ld d %ld h", n / 86400, n % 86400 / 3600);
    return buf;
}

char *dar_progress_text(const dar_progress *p, double seconds, const char *note, char *buf, size_t size)
{
    char rate[64] = "", left[64] = "", time[32];
    if (p->done > p->from && seconds > 0) {
        double r = (p->done - p->from) / seconds;
        if (r >= 1) snprintf(rate, sizeof rate, ", %.3g %s/s", r, p->unit);
        else snprintf(rate, sizeof rate, ", %s each", dar_log_duration(1 / r, time, sizeof time));
        if (p->done < p->total)
            snprintf(left, sizeof left, ", %s left", dar_log_duration((p->total - p->done) / r, time, sizeof time));
        else snprintf(left, sizeof left, ", %s in all", dar_log_duration(seconds, time, sizeof time));
    }
    snprintf(buf, size, "%s: %.10g/%.10g %s, %.0f %%%s%s%s%s", p->what, p->done, p->total, p->unit,
             p->total > 0 ? 100 * p->done / p->total : 100, rate, left, note ? ", " : "", note ? note : "");
    return buf;
}

static void show(dar_progress *p, double at, const char *note, bool last)
{
    char text[LINE_MAX_BYTES];
    struct winsize w;
    bool terminal = on_terminal();

    p->shown = at;
    dar_progress_text(p, at - p->begun, note, text, sizeof text);
    if (terminal && !last && ioctl(STDERR_FILENO, TIOCGWINSZ, &w) == 0 && w.ws_col > 1 && w.ws_col < sizeof text)
        text[w.ws_col - 1] = 0; /* a line that wraps cannot be rewritten */
    pthread_mutex_lock(&lock);
    if (most >= DAR_LOG_INFO) put_line(text, terminal && !last);
    pthread_mutex_unlock(&lock);
}

dar_progress dar_progress_begin(const char *what, const char *unit, double total)
{
    bool terminal = on_terminal();
    dar_progress p = {
        .what = what, .unit = unit, .total = total, .begun = dar_log_clock(), .interval = terminal ? 0.1 : 10
    };
    p.shown = p.begun;
    if (terminal) show(&p, p.begun, NULL, false);
    return p;
}

void dar_progress_step(dar_progress *p, double done, const char *note)
{
    double at = dar_log_clock();
    p->done = done;
    if (at - p->shown >= p->interval) show(p, at, note, false);
}

void dar_progress_end(dar_progress *p)
{
    show(p, dar_log_clock(), NULL, true);
}
