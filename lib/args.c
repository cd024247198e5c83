/* args.c: parsing by table, help from the same table. */
#include "lib/args.h"

#include <errno.h>
#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "lib/cpu.h"
#include "lib/log.h"
#include "lib/nearest.h"
#include "lib/thread.h"

#define WIDTH  80 /* columns of help */
#define INDENT 26 /* column of the explanations */
#define COMMON 6

/* The block that all programs share, with its targets in c. */
static void common_options(const char *seed, dar_common *c, dar_option out[COMMON])
{
    const dar_option block[COMMON] = {
        { .name = "threads",
          .placeholder = "N",
          .type = DAR_ARG_INT,
          .target = &c->threads,
          .lo = 1,
          .hi = 4096,
          .help = "threads to run on (default: all processors)" },
        { .name = "seed",
          .placeholder = "N",
          .type = DAR_ARG_SEED,
          .target = &c->seed,
          .standard = seed ? seed : "0",
          .help = "seed of all random numbers" },
        { .name = "dry-run",
          .type = DAR_ARG_FLAG,
          .target = &c->dry_run,
          .help = "tell bytes, work and time, and stop before doing it" },
        { .name = "quiet", .type = DAR_ARG_FLAG, .target = &c->quiet, .help = "print warnings and errors only" },
        { .name = "json", .type = DAR_ARG_FLAG, .target = &c->json, .help = "print the result as JSON" },
        { .name = "cpu-mask",
          .placeholder = "SET",
          .type = DAR_ARG_TEXT,
          .target = &c->cpu_mask,
          .standard = "all",
          .help = "instruction sets to use: none, avx2, avx512, bf16, vnni or all" },
    };
    memcpy(out, block, sizeof block);
}

/* ---------------------------------------------------------------- values */

static dar_status bad_value(const dar_program *p, const dar_option *o, const char *text, dar_err *e)
{
    char expected[256] = "";
    size_t at = 0;

    switch (o->type) {
    case DAR_ARG_INT: snprintf(expected, sizeof expected, "an integer from %.0f to %.0f", o->lo, o->hi); break;
    case DAR_ARG_SEED: snprintf(expected, sizeof expected, "an integer from 0 to 2^64 - 1"); break;
    case DAR_ARG_NUMBER: snprintf(expected, sizeof expected, "a number from %g to %g", o->lo, o->hi); break;
    case DAR_ARG_SIZE: snprintf(expected, sizeof expected, "WIDTHxHEIGHT, both from %.0f to %.0f", o->lo, o->hi); break;
    case DAR_ARG_CHOICE:
        for (size_t i = 0; o->names[i] && at < sizeof expected; i++)
            at += (size_t)snprintf(expected + at, sizeof expected - at, i ? ", %s" : "one of %s", o->names[i]);
        break;
    default: snprintf(expected, sizeof expected, "a value"); break;
    }
    return dar_fail(e, DAR_ERR_USAGE, "%s: --%s: found '%s', expected %s", p->name, o->name, text, expected);
}

/* Decimal digits, with a sign if `sign`, from lo to hi; *end is the rest. */
static bool read_int(const char *text, char **end, double lo, double hi, int64_t *x)
{
    const char *digits = text + (*text == '-');
    errno = 0;
    *x = strtoll(text, end, 10);
    return *digits >= '0' && *digits <= '9' && !errno && (double)*x >= lo && (double)*x <= hi;
}

static bool read_value(const dar_option *o, const char *text)
{
    char *end;
    int64_t n;
    switch (o->type) {
    case DAR_ARG_INT: return read_int(text, &end, o->lo, o->hi, o->target) && !*end;
    case DAR_ARG_SEED:
        errno = 0;
        *(uint64_t *)o->target = strtoull(text, &end, 10);
        return *text >= '0' && *text <= '9' && !*end && !errno;
    case DAR_ARG_NUMBER: {
        double *x = o->target;
        *x = strtod(text, &end);
        return *text && !text[strspn(text, "0123456789.eE+-")] && !*end && *x >= o->lo && *x <= o->hi;
    }
    case DAR_ARG_SIZE: {
        int64_t *size = o->target;
        return read_int(text, &end, o->lo, o->hi, &size[0]) && *end == 'x' &&
               read_int(end + 1, &end, o->lo, o->hi, &size[1]) && !*end;
    }
    case DAR_ARG_CHOICE:
        for (n = 0; o->names[n]; n++)
            if (strcmp(o->names[n], text) == 0) {
                *(int *)o->target = (int)n;
                return true;
            }
        return false;
    case DAR_ARG_TEXT: *(const char **)o->target = text; return *text;
    default: return false;
    }
}

static dar_status set_value(const dar_program *p, const dar_option *o, const char *text, dar_err *e)
{
    if (o->type != DAR_ARG_LIST && o->type != DAR_ARG_WORDS)
        return read_value(o, text) ? DAR_OK : bad_value(p, o, text, e);
    dar_arg_list *list = o->target;
    if (list->n == DAR_ARG_MANY)
        return dar_fail(e, DAR_ERR_USAGE, "%s: --%s: given more than %d times", p->name, o->name, DAR_ARG_MANY);
    list->at[list->n++] = text;
    return DAR_OK;
}

/* ---------------------------------------------------------------- parsing */

struct parser {
    dar_program *p;
    dar_option common[COMMON];
    size_t n; /* options of the program and in common */
    int argc, at;
    char **argv;
};

static const dar_option *option_at(const struct parser *s, size_t i)
{
    return i < s->p->n_options ? &s->p->options[i] : &s->common[i - s->p->n_options];
}

static const dar_option *find_long(const struct parser *s, const char *name, size_t n)
{
    for (size_t i = 0; i < s->n; i++) {
        const dar_option *o = option_at(s, i);
        if (o->name && strncmp(o->name, name, n) == 0 && !o->name[n]) return o;
    }
    return NULL;
}

static const dar_option *find_letter(const struct parser *s, char letter)
{
    for (size_t i = 0; i < s->n; i++)
        if (letter && option_at(s, i)->letter == letter) return option_at(s, i);
    return NULL;
}

static dar_status unknown(const struct parser *s, const char *name, size_t n, dar_err *e)
{
    char word[65];
    snprintf(word, sizeof word, "%.*s", (int)(n < 64 ? n : 64), name);
    dar_nearest near = dar_nearest_to(word);
    for (size_t i = 0; i < s->n; i++)
        if (option_at(s, i)->name) dar_nearest_try(&near, option_at(s, i)->name);
    dar_nearest_try(&near, "help");
    dar_nearest_try(&near, "version");
    return dar_fail(e, DAR_ERR_USAGE, "%s: --%s: unknown option; %s%s%s", s->p->name, word,
                    near.best ? "did you mean --" : "--help lists them", near.best ? near.best : "",
                    near.best ? "?" : "");
}

/* `joined`: the value in the same word, or NULL. */
static dar_status take(struct parser *s, const dar_option *o, const char *joined, dar_err *e)
{
    if (o->type == DAR_ARG_FLAG) {
        if (joined) return dar_fail(e, DAR_ERR_USAGE, "%s: --%s: takes no value", s->p->name, o->name);
        *(bool *)o->target = true;
        return DAR_OK;
    }
    if (!joined) {
        if (s->at == s->argc || strncmp(s->argv[s->at], "--", 2) == 0)
            return dar_fail(e, DAR_ERR_USAGE, "%s: --%s: expected a value %s", s->p->name, o->name, o->placeholder);
        joined = s->argv[s->at++];
        for (; o->type == DAR_ARG_WORDS && s->at < s->argc && s->argv[s->at][0] != '-'; joined = s->argv[s->at++])
            DAR_TRY(set_value(s->p, o, joined, e));
    }
    return set_value(s->p, o, joined, e);
}

static dar_status take_word(struct parser *s, char *word, dar_err *e)
{
    if (word[1] != '-') {
        const dar_option *o = find_letter(s, word[1]);
        if (!o) return dar_fail(e, DAR_ERR_USAGE, "%s: %s: unknown option; --help lists them", s->p->name, word);
        return take(s, o, word[2] ? word + 2 : NULL, e);
    }
    const char *name = word + 2;
    size_t n = strcspn(name, "=");
    const dar_option *o = find_long(s, name, n);
    if (o) return take(s, o, name[n] ? name + n + 1 : NULL, e);
    if (strcmp(name, "help") == 0) s->p->help = true;
    else if (strcmp(name, "version") == 0) s->p->version = true;
    else return unknown(s, name, n, e);
    return DAR_OK;
}

static dar_status check_rest(const dar_program *p, dar_err *e)
{
    if (p->rests > p->rest_most)
        return dar_fail(e, DAR_ERR_USAGE, "%s: unexpected argument '%s'", p->name, p->rest[p->rest_most]);
    for (size_t i = 0; p->rests < p->rest_least && i < p->n_options; i++) {
        const dar_option *o = &p->options[i];
        if (o->type == DAR_ARG_WORDS && ((dar_arg_list *)o->target)->n > 1)
            return dar_fail(e, DAR_ERR_USAGE, "%s: expected %s, before --%s, which takes all words that follow",
                            p->name, p->rest_name, o->name);
    }
    if (p->rests < p->rest_least)
        return dar_fail(e, DAR_ERR_USAGE, "%s: expected %s; --help tells more", p->name, p->rest_name);
    return DAR_OK;
}

dar_status dar_args_parse(dar_program *p, int argc, char **argv, dar_err *e)
{
    struct parser s = { .p = p, .n = p->n_options, .argc = argc, .at = 1, .argv = argv };
    bool options = true;

    if (p->common) {
        *p->common = (dar_common){ 0 };
        common_options(p->standard_seed, p->common, s.common);
        s.n += COMMON;
    }
    p->rest = argv + 1;
    p->rests = 0;
    p->help = p->version = false;
    for (size_t i = 0; i < s.n; i++) {
        const dar_option *o = option_at(&s, i);
        bool good = !o->name || !o->standard || set_value(p, o, o->standard, e) == DAR_OK;
        DAR_ASSERT(good, "args: default of --%s: '%s'", o->name, o->standard);
    }
    while (s.at < argc) {
        char *word = argv[s.at++];
        if (p->commands && word[0] != '-') {
            p->rest = argv + s.at - 1;
            p->rests = argc - s.at + 1;
            break;
        }
        if (!options || word[0] != '-' || !word[1]) p->rest[p->rests++] = word;
        else if (strcmp(word, "--") == 0) options = false;
        else DAR_TRY(take_word(&s, word, e));
    }
    return p->help || p->version || p->commands ? DAR_OK : check_rest(p, e);
}

static const char *command_name(const dar_program *command)
{
    const char *space = strrchr(command->name, ' ');
    return space ? space + 1 : command->name;
}

dar_status dar_args_command(const dar_program *p, const dar_program **command, dar_err *e)
{
    const char *word = p->rests ? p->rest[0] : "";
    char known[256] = "";
    size_t at = 0;
    dar_nearest near = dar_nearest_to(word);
    for (size_t i = 0; p->commands[i]; i++) {
        const char *name = command_name(*command = p->commands[i]);
        if (strcmp(name, word) == 0) return DAR_OK;
        dar_nearest_try(&near, name);
        if (at < sizeof known) at += (size_t)snprintf(known + at, sizeof known - at, "%s%s", i ? ", " : "", name);
    }
    *command = NULL;
    if (!*word) return dar_fail(e, DAR_ERR_USAGE, "%s: expected a command: %s", p->name, known);
    if (!near.best) return dar_fail(e, DAR_ERR_USAGE, "%s: found '%s', expected a command: %s", p->name, word, known);
    return dar_fail(e, DAR_ERR_USAGE, "%s: found '%s', expected a command; did you mean %s?", p->name, word, near.best);
}

dar_status dar_common_apply(const dar_common *c, dar_err *e)
{
    unsigned flags;
    DAR_TRY(dar_cpu_parse(c->cpu_mask, &flags, e));
    dar_cpu_init(flags);
    if (c->threads) dar_threads_set((int)c->threads);
    if (c->quiet) dar_log_set(DAR_LOG_WARNING);
    return DAR_OK;
}

/* ---------------------------------------------------------------- help */

/* Words of text from column `at` on, lines broken before WIDTH and indented. */
static void wrap(FILE *to, const char *text, int at, int indent)
{
    while (*text) {
        int n = (int)strcspn(text, " ");
        if (at > indent && at + 1 + n > WIDTH) at = fprintf(to, "\n%*s", indent, "") - 1;
        else if (at > indent) at += fprintf(to, " ");
        at += fprintf(to, "%.*s", n, text);
        text += n;
        text += strspn(text, " ");
    }
    fprintf(to, "\n");
}

static void help_command(FILE *to, const dar_program *command)
{
    int at = fprintf(to, "  %s", command_name(command));
    fprintf(to, "%*s", at < INDENT ? INDENT - at : 1, "");
    wrap(to, command->summary, INDENT, INDENT);
}

static void help_option(FILE *to, const dar_option *o)
{
    char text[512];
    int at;

    if (!o->name) {
        fprintf(to, "\n%s:\n", o->help);
        return;
    }
    at = o->letter ? fprintf(to, "  -%c, --%s", o->letter, o->name) : fprintf(to, "  --%s", o->name);
    if (o->placeholder) at += fprintf(to, " %s", o->placeholder);
    if (at >= INDENT - 1) at = fprintf(to, "\n") - 1;
    fprintf(to, "%*s", INDENT - at, "");
    snprintf(text, sizeof text, "%s%s%s%s", o->help, o->standard ? " (default: " : "", o->standard ? o->standard : "",
             o->standard ? ")" : "");
    wrap(to, text, INDENT, INDENT);
}

void dar_args_help(const dar_program *p, FILE *to)
{
    static const dar_option last[] = {
        { .name = "help", .help = "print this and stop" },
        { .name = "version", .help = "print the version and stop" },
    };
    dar_common unused;
    dar_option common[COMMON];

    const char *rest = p->commands ? "COMMAND" : p->rest_name;
    fprintf(to, "usage: %s%s%s [options]\n\n", p->name, rest ? " " : "", rest ? rest : "");
    wrap(to, p->summary, 0, 0);
    if (p->commands) fprintf(to, "\nCommands; COMMAND --help tells more:\n");
    for (size_t i = 0; p->commands && p->commands[i]; i++) help_command(to, p->commands[i]);
    if (p->rest_help) {
        int at = fprintf(to, "\n  %s", p->rest_name) - 1;
        if (at >= INDENT - 1) at = fprintf(to, "\n") - 1;
        fprintf(to, "%*s", INDENT - at, "");
        wrap(to, p->rest_help, INDENT, INDENT);
    }
    if (p->n_options && p->options[0].name) fprintf(to, "\nOptions:\n");
    for (size_t i = 0; i < p->n_options; i++) help_option(to, &p->options[i]);
    fprintf(to, "\n%s:\n", p->commands ? "Options" : "Options of every program");
    if (p->common) common_options(p->standard_seed, &unused, common);
    for (size_t i = 0; p->common && i < COMMON; i++) help_option(to, &common[i]);
    for (size_t i = 0; i < DAR_COUNT(last); i++) help_option(to, &last[i]);
}

bool dar_args_answer(const dar_program *p, FILE *to)
{
    if (p->help) dar_args_help(p, to);
    else if (p->version) fprintf(to, "%s %s\n", p->name, DAR_VERSION);
    return p->help || p->version;
}
