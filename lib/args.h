/* args.h: command lines as tables, alike for all programs.
 *
 *     int main(int argc, char **argv)
 *     {
 *         static int64_t steps;
 *         static const dar_option options[] = {
 *             { .name = "steps", .placeholder = "N", .type = DAR_ARG_INT, .target = &steps, .standard = "50",
 *               .lo = 1, .hi = 1000, .help = "solver steps" },
 *         };
 *         dar_program p = { .name = "dar-sample", .summary = "...", .options = options, .n_options = 1, ... };
 *         dar_err e;
 *         dar_status s = dar_args_parse(&p, argc, argv, &e);
 *         if (s == DAR_OK && dar_args_answer(&p, stdout)) return 0;
 *         ...
 *
 * Written --name=value or --name value, -o value or -ovalue; -- ends the options; the last of several wins, but in a
 * list.  A value that begins with -- must be joined by '='.  Numbers are decimal and consumed whole. */
#ifndef DAR_LIB_ARGS_H
#define DAR_LIB_ARGS_H

#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>

#include "lib/status.h"

#define DAR_VERSION  "0.1"
#define DAR_ARG_MANY 64 /* values of one list */

typedef enum dar_arg_type {
    DAR_ARG_FLAG,   /* bool: set by its name, takes no value */
    DAR_ARG_INT,    /* int64_t from lo to hi */
    DAR_ARG_SEED,   /* uint64_t, any */
    DAR_ARG_NUMBER, /* double from lo to hi */
    DAR_ARG_TEXT,   /* const char *, not empty */
    DAR_ARG_CHOICE, /* int: index in names */
    DAR_ARG_SIZE,   /* int64_t[2]: WxH, both from lo to hi */
    DAR_ARG_LIST,   /* dar_arg_list: every value, in order */
    DAR_ARG_WORDS,  /* the same, of one or more words: all up to the next that begins with '-' */
} dar_arg_type;

typedef struct dar_arg_list {
    size_t n;
    const char *at[DAR_ARG_MANY];
} dar_arg_list;

typedef struct dar_option {
    const char *name; /* without dashes; NULL: `help` is the heading of those that follow */
    char letter;      /* short form; 0: none */
    const char *placeholder;
    dar_arg_type type;
    void *target;
    const char *standard; /* default, as the user would write it; NULL: the target keeps what it holds */
    const char *help;
    double lo, hi;            /* of numbers, both included */
    const char *const *names; /* of choices; ends with NULL */
} dar_option;

/* What every program takes: --threads --seed --dry-run --quiet --json --cpu-mask. */
typedef struct dar_common {
    int64_t threads; /* 0: all processors */
    uint64_t seed;
    bool dry_run, quiet, json;
    const char *cpu_mask;
} dar_common;

struct dar_run;
typedef dar_status dar_run_fn(struct dar_run *r, dar_err *e); /* lib/program.h */

typedef struct dar_program {
    const char *name;    /* as typed: "dar-bundle render" */
    const char *summary; /* what it does, one sentence */
    const dar_option *options;
    size_t n_options;
    dar_common *common;        /* NULL: takes none of them */
    const char *standard_seed; /* default of --seed; NULL: 0 */
    dar_run_fn *run;

    /* Instead of run: what the first argument chooses from, by the last word of their names; ends with NULL. */
    const struct dar_program *const *commands;

    /* Arguments that are not options: "BUNDLE..." */
    const char *rest_name, *rest_help;
    int rest_least, rest_most;

    /* Filled by dar_args_parse. */
    char **rest; /* rests of them, in argv, which is reordered */
    int rests;
    bool help, version; /* asked for; nothing else was checked to be complete */
} dar_program;

/* Fill the targets: defaults first, then what argv says; argv[0] is skipped.  A program of commands keeps everything
 * from the command on as its rest.  Failures are DAR_ERR_USAGE. */
dar_status dar_args_parse(dar_program *p, int argc, char **argv, dar_err *e);

/* The command that the first of the rest names.  On failure *command is NULL. */
dar_status dar_args_command(const dar_program *p, const dar_program **command, dar_err *e);

/* Print help or version, if asked for, and tell so. */
bool dar_args_answer(const dar_program *p, FILE *to);

void dar_args_help(const dar_program *p, FILE *to);

/* Put threads, processor mask and quietness in force. */
dar_status dar_common_apply(const dar_common *c, dar_err *e);

#endif
