/* json_write.h: JSON text, piece by piece, into a buffer that grows and can be used again.
 *
 *     dar_json_writer w = { .pretty = true };
 *     dar_json_write_object(&w, NULL);
 *     dar_json_write_int(&w, "step", 30);
 *     dar_json_write_end(&w);
 *     ... w.text ...
 *     dar_json_writer_free(&w);
 *
 * Order is the order of calls.  What is printed always parses: doubles come back with the same bits, NaN and infinity
 * (which JSON has not) are null, bytes that are not UTF-8 become U+FFFD.  Every function takes the key inside an
 * object, NULL inside an array and at the top. */
#ifndef DAR_LIB_JSON_WRITE_H
#define DAR_LIB_JSON_WRITE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#define DAR_JSON_DEPTH 64 /* objects and arrays inside each other, reading and writing */

typedef struct dar_json_writer {
    bool pretty; /* four spaces per level, arrays of plain values on one line; else all on one line */

    char *text; /* terminated; NULL before the first piece */
    size_t size;
    bool failed; /* memory ran out: the text is not whole */

    /* Of the writer itself: one bit per level. */
    size_t capacity;
    int depth;
    uint64_t array, begun, broken; /* is an array; has an element; has an element on a line of its own */
} dar_json_writer;

void dar_json_write_object(dar_json_writer *w, const char *key);
void dar_json_write_array(dar_json_writer *w, const char *key);
void dar_json_write_end(dar_json_writer *w); /* of the innermost object or array */

void dar_json_write_text(dar_json_writer *w, const char *key, const char *value);
void dar_json_write_int(dar_json_writer *w, const char *key, int64_t value);
void dar_json_write_number(dar_json_writer *w, const char *key, double value);
void dar_json_write_bool(dar_json_writer *w, const char *key, bool value);
void dar_json_write_null(dar_json_writer *w, const char *key);

/* Start again in the same memory: one buffer serves a whole log. */
void dar_json_writer_reset(dar_json_writer *w);
void dar_json_writer_free(dar_json_writer *w);

/* The shortest decimal that reads back as x; returns buf. */
char *dar_json_number_text(double x, char buf[32]);

/* Length of the valid UTF-8 character at p (1 to 4), 0 if there is none.  p < end. */
size_t dar_json_utf8(const char *p, const char *end);

#endif
