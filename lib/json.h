/* json.h: JSON read strictly and by type: configurations, manifests, headers of other formats.
 *
 *     dar_json train = dar_json_object(dar_json_root(doc), "train");
 *     c->rank = dar_json_int(train, "rank", 16, 1, 4096);
 *     c->rate = dar_json_number(train, "rate", 1e-4, 0, 1);
 *     ...
 *     return dar_json_finish(doc, e);
 *
 * The first thing that is wrong is kept, later ones are not; a read that fails returns its default and dar_json_finish
 * tells: "config.json: train.rank: found "abc", expected an integer from 1 to 4096".  dar_json_finish also refuses keys
 * that nobody asked for and names the nearest that somebody did.
 *
 * A key that is absent, or null, is entered into the document with its default (as null if it has none), so a document
 * that was read is the resolved configuration: write it with dar_json_write_value.
 *
 * Accepted: RFC 8259 and comments of both kinds, // and slash-star.  Refused, with line and column: what is not UTF-8,
 * a key given twice, more than 64 levels, anything after the value, numbers that no double holds, U+0000.  Comments are
 * for configurations that people write.  A document belongs to one thread. */
#ifndef DAR_LIB_JSON_H
#define DAR_LIB_JSON_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/json_write.h"
#include "lib/status.h"

#define DAR_JSON_MAX_SIZE ((size_t)64 << 20) /* of a text [bytes]; a value takes some 80 bytes of memory */
#define DAR_JSON_MAX_INT  (((int64_t)1 << 53) - 1)

typedef struct dar_json_doc dar_json_doc;

/* A value in a document, valid until it is closed. */
typedef struct dar_json {
    dar_json_doc *doc;
    void *item; /* NULL: absent; every read of it gives the default */
} dar_json;

/* Read a file.  On failure *out is NULL. */
dar_status dar_json_open(dar_json_doc **out, const char *path, dar_err *e);

/* Parse text[0, size), which need not be terminated; `name` stands for the file in messages.  NULL text: an empty
 * object. */
dar_status dar_json_parse(dar_json_doc **out, const char *name, const char *text, size_t size, dar_err *e);

void dar_json_close(dar_json_doc *doc); /* accepts NULL */

/* Override from a command line: "train.rank=32".  The value is JSON, or else a string as it stands.  Objects on the way
 * are made; [i] of an array is written a.i.b. */
dar_status dar_json_set(dar_json_doc *doc, const char *assignment, dar_err *e);

/* The first failure of any read; then keys that were never asked for. */
dar_status dar_json_finish(dar_json_doc *doc, dar_err *e);

/* ---------------------------------------------------------------- reads
 *
 * `key` names a member of the object j; NULL reads j itself (elements of arrays).  A default of DAR_JSON_NEEDED, NAN or
 * NULL by type says that the key must be there. */
#define DAR_JSON_NEEDED INT64_MIN

dar_json dar_json_root(dar_json_doc *doc);

bool dar_json_bool(dar_json j, const char *key, bool standard);

/* lo <= value <= hi, and below 2^53 so that it is exact. */
int64_t dar_json_int(dar_json j, const char *key, int64_t standard, int64_t lo, int64_t hi);
double dar_json_number(dar_json j, const char *key, double standard, double lo, double hi);

/* Lives as long as the document. */
const char *dar_json_text(dar_json j, const char *key, const char *standard);

/* Index of the value in `names`, which ends with NULL; -1 as standard: needed. */
int dar_json_choice(dar_json j, const char *key, int standard, const char *const *names);

/* Exactly n numbers into x, which holds the defaults (x[0] NAN: needed). */
void dar_json_numbers(dar_json j, const char *key, double *x, size_t n);

/* A member object or array; an absent one is made, empty. */
dar_json dar_json_object(dar_json j, const char *key);
dar_json dar_json_array(dar_json j, const char *key);

/* A member of any type; item NULL if it is absent or null. */
dar_json dar_json_get(dar_json j, const char *key);

/* Elements or members, in order: for (dar_json x = dar_json_first(a); x.item; x = dar_json_next(x)). */
dar_json dar_json_first(dar_json j);
dar_json dar_json_next(dar_json x);
size_t dar_json_size(dar_json j);
const char *dar_json_key(dar_json x); /* "" in arrays; marks a member as asked for */

typedef enum dar_json_kind {
    DAR_JSON_NULL,
    DAR_JSON_BOOL,
    DAR_JSON_NUMBER,
    DAR_JSON_TEXT,
    DAR_JSON_ARRAY,
    DAR_JSON_OBJECT,
} dar_json_kind;
dar_json_kind dar_json_kind_of(dar_json j); /* absent: DAR_JSON_NULL */

/* j and all below it count as asked for: free-form content. */
void dar_json_accept(dar_json j);

/* Leave "file: path: found ..., expected ..." as the failure of this document, if it is the first: for rules that the
 * reads above cannot express. */
void dar_json_reject(dar_json j, const char *key, const char *expected, ...) __attribute__((format(printf, 3, 4)));

/* Members of `from`, an object of any document, take the place of those of `to` with the same name, or are added; where
 * both are objects, so do theirs.  Short of memory, dar_json_finish of `to` tells. */
void dar_json_merge(dar_json to, dar_json from);

/* Print a value with everything below it. */
void dar_json_write_value(dar_json_writer *w, const char *key, dar_json j);

#endif
