/* fuzz_weights.h: any bytes as a file of weights.  Of what is accepted every byte is read, every name found and every
 * view taken; what is refused must say why in one line. */
#ifndef DAR_TESTS_FUZZ_WEIGHTS_H
#define DAR_TESTS_FUZZ_WEIGHTS_H

#include <stdint.h>
#include <string.h>

#include "lib/weights.h"

static inline void check_line(const dar_err *e)
{
    DAR_ASSERT(strncmp(e->text, "fuzz:", 5) == 0, "does not name the file: %s", e->text);
    for (const char *p = e->text; *p; p++) DAR_ASSERT((unsigned char)*p >= 0x20, "not one line: %s", e->text);
}

static inline void fuzz_weights(const uint8_t *data, size_t size)
{
    dar_weights *s;
    dar_err e = { "" };
    size_t total = 0;
    unsigned sum = 0;

    if (dar_weights_parse(&s, "fuzz", data, size, &e) != DAR_OK) {
        DAR_ASSERT(!s, "failed, yet open");
        check_line(&e);
        return;
    }
    for (size_t i = 0; i < dar_weights_count(s); i++) {
        const dar_weight *t = dar_weights_at(s, i);
        const uint8_t *p = t->data;
        dar_tensor x;
        DAR_ASSERT(dar_weights_find(s, t->name) == t, "%s: not found", t->name);
        for (size_t k = 0; k < t->bytes; k++) sum += p[k];
        DAR_ASSERT(t->bytes < size, "%s: %zu bytes of %zu", t->name, t->bytes, size);
        total += t->bytes;
        if (dar_weights_tensor(s, t->name, &x, &e) != DAR_OK) check_line(&e);
        else
            DAR_ASSERT(dar_tensor_bytes(&x) == t->bytes && memcmp(x.data, p, t->bytes) == 0, "%s: other bytes",
                       t->name);
    }
    DAR_ASSERT(sum <= 255 * total, "every byte is read");
    dar_weights_meta(s, "k");
    dar_weights_close(s);
}

#endif
