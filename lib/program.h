/* program.h: what all programs do alike: from main to the work and back.
 *
 *     static dar_status sample(dar_run *r, dar_err *e) { ... }
 *
 *     int main(int argc, char **argv)
 *     {
 *         static const dar_program program = { .name = "dar-sample", .options = ..., .run = sample };
 *         return dar_program_main(&program, argc, argv);
 *     }
 *
 * The result goes to standard output: lines for people, or one JSON object with --json.  Everything else goes to
 * standard error (lib/log.h); a failure is one line there.  Exit status: dar_status_exit. */
#ifndef DAR_LIB_PROGRAM_H
#define DAR_LIB_PROGRAM_H

#include "lib/args.h"
#include "lib/json_write.h"

typedef struct dar_run {
    const dar_program *program; /* parsed: its rest, its common options in force */
    dar_json_writer json;       /* inside the result's object */
} dar_run;

/* Restart with patient threads (lib/thread.h), parse, answer --help and --version, choose the command, run, print.
 * Returns the exit status. */
int dar_program_main(const dar_program *program, int argc, char **argv);

/* A line of the result for people; with --json nothing. */
void dar_run_say(const dar_run *r, const char *fmt, ...) __attribute__((format(printf, 2, 3)));

/* Whether the person (SIGINT), the system (SIGTERM) or a batch queue whose time is nearly up (SIGUSR1) asked to stop:
 * save what is worth it and return DAR_ERR_INTERRUPTED.  Asked a second time in the same way, the program ends at once.
 */
bool dar_interrupted(void);

#endif
