/* program.c: the frame around the work of a program. */
#include "lib/program.h"

#include <errno.h>
#include <signal.h>
#include <stdarg.h>
#include <string.h>

#include "lib/log.h"
#include "lib/thread.h"

static volatile sig_atomic_t asked_to_stop;

static void on_signal(int number)
{
    asked_to_stop = number;
}

static void catch_signals(void)
{
    struct sigaction a = { .sa_handler = on_signal, .sa_flags = SA_RESTART | (int)SA_RESETHAND };
    sigemptyset(&a.sa_mask);
    sigaction(SIGINT, &a, NULL);
    sigaction(SIGTERM, &a, NULL);
    sigaction(SIGUSR1, &a, NULL);
    signal(SIGXFSZ, SIG_IGN); /* a file that may not grow is a failed write, as on a full disk */
}

bool dar_interrupted(void)
{
    return asked_to_stop != 0;
}

void dar_run_say(const dar_run *r, const char *fmt, ...)
{
    va_list ap;
    if (r->program->common && r->program->common->json) return;
    va_start(ap, fmt);
    vprintf(fmt, ap);
    va_end(ap);
    putchar('\n');
}

static dar_status print_result(const dar_run *r, dar_err *e)
{
    if (r->json.failed) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", r->program->name);
    if (r->program->common && r->program->common->json) printf("%s\n", r->json.text);
    if (fflush(stdout) == 0) return DAR_OK;
    return dar_fail(e, errno == ENOSPC ? DAR_ERR_NOMEM : DAR_ERR_IO, "standard output: %s", strerror(errno));
}

static dar_status run(const dar_program *p, dar_err *e)
{
    dar_run r = { .program = p, .json = { .pretty = true } };
    dar_err why;
    if (p->common) DAR_TRY(dar_common_apply(p->common, e));
    catch_signals();
    dar_json_write_object(&r.json, NULL);
    dar_status s = p->run(&r, e), printed = DAR_OK;
    dar_json_write_end(&r.json);
    /* A child that the terminal's Ctrl-C ended too may have been the first to complain. */
    if (s != DAR_OK && s != DAR_ERR_INTERRUPTED && dar_interrupted())
        s = dar_fail(e, DAR_ERR_INTERRUPTED, "%s: interrupted", p->name);
    if (s == DAR_OK || s == DAR_ERR_CHECK) printed = print_result(&r, &why);
    if (printed != DAR_OK) s = dar_fail(e, printed, "%s", why.text);
    dar_json_writer_free(&r.json);
    return s;
}

int dar_program_main(const dar_program *program, int argc, char **argv)
{
    dar_program p = *program;
    const dar_program *command;
    dar_err e;
    dar_threads_restart(argv);
    dar_status s = dar_args_parse(&p, argc, argv, &e);
    if (s == DAR_OK && dar_args_answer(&p, stdout)) return 0;
    if (s == DAR_OK && p.commands) {
        s = dar_args_command(&p, &command, &e);
        if (s == DAR_OK) return dar_program_main(command, p.rests, p.rest);
    } else if (s == DAR_OK) {
        s = run(&p, &e);
    }
    if (s != DAR_OK) dar_log(DAR_LOG_ERROR, "%s", e.text);
    return dar_status_exit(s);
}
