/* dar_eval_answers.c: what people answered, read with the key of the study.
 *
 * For each pair of methods and question: how often the first was preferred, a bootstrap interval of that share, and the
 * exact binomial test against a half; the same by camera path and by family of the subject. */
#include "infer/dar_eval.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#include "lib/json.h"

struct answer {
    dar_json trial; /* of the key */
    const char *participant;
    int64_t number;
    int question;
    bool first; /* the first method of the pair was preferred */
};

struct answers {
    dar_eval *v;
    dar_json_doc *key, **file;
    size_t files, n, room;
    struct answer *at;
    double *value; /* [n] */
};

/* ---------------------------------------------------------------- reading */

static dar_status add(struct answers *a, const struct answer *x, const char *file, dar_err *e)
{
    for (size_t i = 0; i < a->n; i++) {
        const struct answer *y = &a->at[i];
        if (y->number == x->number && y->question == x->question && strcmp(y->participant, x->participant) == 0)
            return dar_fail(e, DAR_ERR_FORMAT, "%s: found a second answer of %s to trial %lld, %s", file,
                            x->participant, (long long)x->number, dar_eval_question[x->question][0]);
    }
    if (a->n == a->room) {
        size_t room = 2 * a->room + 64;
        struct answer *more = realloc(a->at, room * sizeof *more);
        if (!more) return dar_fail(e, DAR_ERR_NOMEM, "%s: out of memory", file);
        a->at = more;
        a->room = room;
    }
    a->at[a->n++] = *x;
    return DAR_OK;
}

static dar_json trial_of(const struct answers *a, int64_t number)
{
    dar_json j = dar_json_first(dar_json_get(dar_json_root(a->key), "trials"));
    while (j.item && number-- > 0) j = dar_json_next(j);
    return j;
}

static dar_status read_answers(struct answers *a, dar_json_doc *doc, const char *file, dar_err *e)
{
    static const char *const question[] = { "camera", "motion", "appearance", NULL };
    static const char *const side[] = { "left", "right", NULL };
    dar_json root = dar_json_root(doc), key = dar_json_root(a->key);
    const char *format = dar_json_text(root, "format", NULL), *study = dar_json_text(root, "study", NULL);
    const char *participant = dar_json_text(root, "participant", NULL);
    int64_t trials = (int64_t)dar_json_size(dar_json_get(key, "trials"));
    if (format && strcmp(format, "dar-study-answers/1") != 0) dar_json_reject(root, "format", "dar-study-answers/1");
    if (study && strcmp(study, dar_json_text(key, "study", "")) != 0)
        dar_json_reject(root, "study", "the study of the key");
    dar_status s = DAR_OK;
    for (dar_json j = dar_json_first(dar_json_array(root, "answers")); j.item && s == DAR_OK; j = dar_json_next(j)) {
        struct answer x = { .participant = participant };
        x.number = dar_json_int(j, "trial", DAR_JSON_NEEDED, 0, trials - 1);
        x.question = dar_json_choice(j, "question", -1, question);
        int choice = dar_json_choice(j, "choice", -1, side);
        dar_json_number(j, "seconds", 0, 0, 1e9);
        x.trial = trial_of(a, x.number);
        if (x.number < 0 || x.question < 0 || choice < 0 || !x.trial.item || !participant) break;
        const char *chosen = dar_json_text(x.trial, side[choice], "");
        x.first = strcmp(chosen, dar_json_text(x.trial, "first", "")) == 0;
        s = add(a, &x, file, e);
    }
    return s == DAR_OK ? dar_json_finish(doc, e) : s;
}

/* ---------------------------------------------------------------- counting */

/* Answers that count; NULL: any. */
struct which {
    const char *first, *second, *key, *value;
    int question;
};

static size_t gather(struct answers *a, const struct which *w)
{
    size_t n = 0;
    for (size_t i = 0; i < a->n; i++) {
        const struct answer *x = &a->at[i];
        if (x->question != w->question || strcmp(dar_json_text(x->trial, "first", ""), w->first) != 0 ||
            strcmp(dar_json_text(x->trial, "second", ""), w->second) != 0 ||
            (w->key && strcmp(dar_json_text(x->trial, w->key, ""), w->value) != 0))
            continue;
        a->value[n++] = x->first;
    }
    return n;
}

static void put_row(struct answers *a, dar_eval_sheet *t, size_t row, const struct which *w, dar_json_writer *out)
{
    dar_eval_entry *x = &t->entry[row * t->columns];
    size_t n = gather(a, w), heads = 0;
    for (size_t i = 0; i < n; i++) heads += a->value[i] == 1;
    dar_interval v = dar_stats_bootstrap(a->value, n, a->v->seed, a->v->work);
    double p = dar_stats_fair(heads, n);
    snprintf(x[0].text, sizeof x[0].text, "%s", w->first);
    snprintf(x[1].text, sizeof x[1].text, "%s", w->second);
    snprintf(x[2].text, sizeof x[2].text, "%s", dar_eval_question[w->question][0]);
    snprintf(x[3].text, sizeof x[3].text, "%s", w->key ? w->value : "all");
    snprintf(x[4].text, sizeof x[4].text, "%zu", n);
    snprintf(x[5].text, sizeof x[5].text, "%.1f %%", 100 * v.mean);
    if (!isnan(v.lo)) snprintf(x[5].range, sizeof x[5].range, "%.1f, %.1f", 100 * v.lo, 100 * v.hi);
    snprintf(x[6].text, sizeof x[6].text, "%.3g", p);
    dar_json_write_object(out, NULL);
    dar_json_write_text(out, "first", w->first);
    dar_json_write_text(out, "second", w->second);
    dar_json_write_text(out, "question", dar_eval_question[w->question][0]);
    if (w->key) dar_json_write_text(out, w->key, w->value);
    dar_json_write_int(out, "answers", (int64_t)n);
    dar_json_write_int(out, "first_preferred", (int64_t)heads);
    dar_json_write_number(out, "rate", v.mean);
    if (!isnan(v.lo)) {
        dar_json_write_number(out, "lo", v.lo);
        dar_json_write_number(out, "hi", v.hi);
    }
    dar_json_write_number(out, "p", p);
    dar_json_write_end(out);
}

/* Whether no answer before i is of the same pair, question and stratum. */
static bool is_new(const struct answers *a, size_t i, const char *key)
{
    static const char *const parts[] = { "first", "second" };
    for (size_t k = 0; k < i; k++) {
        bool same = a->at[k].question == a->at[i].question;
        for (size_t p = 0; p < DAR_COUNT(parts) && same; p++)
            same =
                strcmp(dar_json_text(a->at[k].trial, parts[p], ""), dar_json_text(a->at[i].trial, parts[p], "")) == 0;
        if (same && key)
            same = strcmp(dar_json_text(a->at[k].trial, key, ""), dar_json_text(a->at[i].trial, key, "")) == 0;
        if (same) return false;
    }
    return true;
}

static void put_table(struct answers *a, dar_eval_sheets *sheets, const char *key, const char *title,
                      dar_json_writer *out)
{
    static const char *const head[] = { "First", "Second", "Question", "Of", "Answers", "First preferred", "p" };
    size_t rows = 0, row = 0;
    for (size_t i = 0; i < a->n; i++) rows += is_new(a, i, key);
    dar_eval_sheet *t = dar_eval_sheet_add(sheets, title, "", rows, DAR_COUNT(head));
    if (!t) return;
    for (size_t k = 0; k < DAR_COUNT(head); k++) snprintf(t->head[k], sizeof t->head[k], "%s", head[k]);
    snprintf(t->note, sizeof t->note,
             "In brackets: 95 %% bootstrap interval over answers.  p: exact binomial test against a half, two-sided.");
    for (size_t i = 0; i < a->n; i++) {
        const dar_json j = a->at[i].trial;
        if (!is_new(a, i, key)) continue;
        struct which w = { dar_json_text(j, "first", ""), dar_json_text(j, "second", ""), key, NULL, 0 };
        if (key) w.value = dar_json_text(j, key, "");
        w.question = a->at[i].question;
        put_row(a, t, row++, &w, out);
    }
}

static dar_status write_results(struct answers *a, dar_err *e)
{
    dar_eval_sheets sheets = { 0 };
    dar_json_writer w = { .pretty = true };
    char *text = NULL;
    size_t size = 0;
    dar_json_write_object(&w, NULL);
    dar_json_write_text(&w, "format", "dar-study/1");
    dar_json_write_array(&w, "results");
    put_table(a, &sheets, NULL, "Preferences", &w);
    put_table(a, &sheets, "trajectory", "Preferences by camera path", &w);
    put_table(a, &sheets, "family", "Preferences by family", &w);
    dar_json_write_end(&w);
    dar_json_write_end(&w);
    FILE *f = open_memstream(&text, &size);
    for (size_t i = 0; i < sheets.n && f && !sheets.failed; i++) dar_eval_sheet_markdown(&sheets.at[i], f);
    bool bad = !f || ferror(f) != 0 || sheets.failed || w.failed;
    if (f) bad = fclose(f) != 0 || bad;
    dar_status s = bad ? dar_fail(e, DAR_ERR_NOMEM, "answers.md: out of memory") : DAR_OK;
    if (s == DAR_OK) s = dar_eval_write(a->v, "answers.md", text, size, e);
    if (s == DAR_OK) s = dar_eval_write(a->v, "answers.json", w.text, w.size, e);
    free(text);
    dar_json_writer_free(&w);
    dar_eval_sheets_free(&sheets);
    return s;
}

/* ---------------------------------------------------------------- */

dar_status dar_eval_answers(dar_eval *v, const char *key, const char *const *file, size_t n, size_t *answers,
                            dar_err *e)
{
    struct answers a = { .v = v, .file = calloc(n, sizeof *a.file) };
    dar_status s = a.file ? dar_json_open(&a.key, key, e) : dar_fail(e, DAR_ERR_NOMEM, "answers: out of memory");
    for (; a.files < n && s == DAR_OK; a.files++) {
        s = dar_json_open(&a.file[a.files], file[a.files], e);
        if (s == DAR_OK) s = read_answers(&a, a.file[a.files], file[a.files], e);
    }
    if (s == DAR_OK && !a.n) s = dar_fail(e, DAR_ERR_FORMAT, "%s: found no answer", file[0]);
    if (s == DAR_OK && !(a.value = malloc(a.n * sizeof *a.value)))
        s = dar_fail(e, DAR_ERR_NOMEM, "answers: out of memory");
    if (s == DAR_OK) s = write_results(&a, e);
    *answers = a.n;
    for (size_t i = 0; i < a.files; i++) dar_json_close(a.file[i]);
    dar_json_close(a.key);
    free(a.file);
    free(a.at);
    free(a.value);
    return s;
}
