/* fuzz_safetensors.c: any bytes as a safetensors file.  Of what is accepted every byte is read, every name found and
 * every view taken; what is refused must say why in one line. */
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#include "lib/safetensors.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void check_line(const dar_err *e)
{
    DAR_ASSERT(strncmp(e->text, "fuzz:", 5) == 0, "does not name the file: %s", e->text);
    for (const char *p = e->text; *p; p++) DAR_ASSERT((unsigned char)*p >= 0x20, "not one line: %s", e->text);
}

static void try(const uint8_t *data, size_t size)
{
    dar_safetensors *s;
    dar_err e = { "" };
    size_t total = 0;
    unsigned sum = 0;

    if (dar_safetensors_parse(&s, "fuzz", data, size, &e) != DAR_OK) {
        DAR_ASSERT(!s, "failed, yet open");
        check_line(&e);
        return;
    }
    for (size_t i = 0; i < dar_safetensors_count(s); i++) {
        const dar_safetensors_entry *t = dar_safetensors_at(s, i);
        const uint8_t *p = t->data;
        dar_tensor x;
        DAR_ASSERT(dar_safetensors_find(s, t->name) == t, "%s: not found", t->name);
        for (size_t k = 0; k < t->bytes; k++) sum += p[k];
        total += t->bytes;
        if (dar_safetensors_tensor(s, t->name, &x, &e) != DAR_OK) check_line(&e);
        else
            DAR_ASSERT(dar_tensor_bytes(&x) == t->bytes && memcmp(x.data, p, t->bytes) == 0, "%s: other bytes",
                       t->name);
    }
    DAR_ASSERT(total < size && sum <= 255 * total, "%zu bytes of tensors in %zu bytes", total, size);
    dar_safetensors_meta(s, "k");
    dar_safetensors_close(s);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    size_t end = size;
    try(data, size);

    /* Again with the length of the header put right, which blind changes hardly ever do. */
    while (end > 8 && data[end - 1] != '}') end--;
    if (end <= 8) return 0;
    uint8_t *sound = malloc(size);
    if (!sound) return 0;
    memcpy(sound, data, size);
    for (size_t i = 0; i < 8; i++) sound[i] = (uint8_t)((end - 8) >> (8 * i));
    try(sound, size);
    free(sound);
    return 0;
}
