/* fuzz_json.c: any bytes as JSON, then, each after a zero byte, overrides.  What is accepted must print to a text that
 * is accepted and prints the same; what is refused must say why in one line. */
#include <stdint.h>
#include <string.h>

#include "lib/json.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void check_line(const dar_err *e)
{
    DAR_ASSERT(*e->text, "no message");
    for (const char *p = e->text; *p; p++) DAR_ASSERT((unsigned char)*p >= 0x20, "not one line: %s", e->text);
}

/* Every read that there is, of every value, by the wrong type too. */
static void read_all(dar_json j)
{
    static const char *const names[] = { "d", "text", NULL };
    double two[2] = { 1, 2 };
    dar_json_int(j, NULL, 0, -5, 5);
    dar_json_number(j, NULL, 0, 0, 1);
    dar_json_text(j, NULL, "");
    dar_json_choice(j, NULL, 0, names);
    dar_json_numbers(j, NULL, two, 2);
    dar_json_reject(j, NULL, "something else than %s", "this");
    for (dar_json x = dar_json_first(j); x.item; x = dar_json_next(x)) read_all(x);
}

static void round_trip(dar_json_doc *doc, bool pretty)
{
    dar_json_writer a = { .pretty = pretty }, b = { .pretty = pretty };
    dar_json_doc *again;
    dar_err e = { "" };
    dar_json_write_value(&a, NULL, dar_json_root(doc));
    dar_status s = dar_json_parse(&again, "again", a.text, a.size, &e);
    DAR_ASSERT(s == DAR_OK, "printed, then refused: %s: %s", e.text, a.text);
    dar_json_write_value(&b, NULL, dar_json_root(again));
    DAR_ASSERT(strcmp(a.text, b.text) == 0, "printed %s, then %s", a.text, b.text);
    dar_json_close(again);
    dar_json_writer_free(&a);
    dar_json_writer_free(&b);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    const uint8_t *zero = size ? memchr(data, 0, size) : NULL, *end = data + size;
    dar_json_doc *doc;
    dar_err e = { "" };
    char set[256];

    if (dar_json_parse(&doc, "fuzz", (const char *)data, zero ? (size_t)(zero - data) : size, &e) != DAR_OK) {
        check_line(&e);
        return 0;
    }
    while (zero) {
        const uint8_t *text = zero + 1;
        zero = text < end ? memchr(text, 0, (size_t)(end - text)) : NULL;
        size_t n = (size_t)((zero ? zero : end) - text);
        if (n >= sizeof set) n = sizeof set - 1;
        memcpy(set, text, n);
        set[n] = 0;
        if (dar_json_set(doc, set, &e) != DAR_OK) check_line(&e);
    }
    round_trip(doc, false);
    round_trip(doc, true);
    read_all(dar_json_root(doc));
    dar_json_object(dar_json_root(doc), "new");
    if (dar_json_finish(doc, &e) != DAR_OK) check_line(&e);
    dar_json_close(doc);
    return 0;
}
