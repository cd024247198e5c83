/* fuzz_bundle.c: any bytes as the metadata of a bundle: meta.json, a form feed, cameras.json.  What is accepted is
 * sound, and printed and read again the same; what is refused must say why in one line. */
#include <stdint.h>
#include <string.h>

#include "data/bundle_inside.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void check_line(const dar_err *e)
{
    DAR_ASSERT(*e->text, "no message");
    for (const char *p = e->text; *p; p++) DAR_ASSERT((unsigned char)*p >= 0x20, "not one line: %s", e->text);
}

/* What users of a bundle rely on without asking. */
static void check_contents(const dar_bundle_contents *c)
{
    const dar_bundle_meta *m = &c->meta;
    DAR_ASSERT(m->frames >= 1 && m->frames <= DAR_BUNDLE_MAX_FRAMES, "%zu frames", m->frames);
    DAR_ASSERT(m->width >= 1 && m->width <= DAR_BUNDLE_MAX_SIDE && m->height >= 1 && m->height <= DAR_BUNDLE_MAX_SIDE,
               "%d x %d", m->width, m->height);
    DAR_ASSERT(m->fps > 0 && m->world.size >= 0 && (m->boxes == 0 || m->boxes == m->frames), "numbers");
    for (size_t t = 0; t < m->boxes; t++)
        for (int k = 0; k < 3; k++) DAR_ASSERT(m->box[t].lo[k] <= m->box[t].hi[k], "box %zu", t);
    for (int f = 0; f < DAR_BUNDLE_FAMILIES; f++)
        if (c->store[f].there)
            DAR_ASSERT((c->store[f].type == DAR_H5_U32) == (f >= DAR_FAMILIES), "%s", dar_bundle_table[f].name);
    for (size_t i = 0; i < c->files; i++)
        DAR_ASSERT(dar_bundle_is_file(c->file[i].name, m->frames), "file %s", c->file[i].name);
}

static void check_again(const dar_bundle_contents *c)
{
    dar_json_writer w = { 0 };
    dar_json_doc *doc;
    dar_bundle_contents again = { 0 };
    dar_err e;
    dar_bundle_print_meta(c, &w);
    dar_status s = dar_json_parse(&doc, "again", w.text, w.size, &e);
    if (s == DAR_OK) s = dar_bundle_read_meta(&again, doc, &e);
    DAR_ASSERT(s == DAR_OK, "printed, then refused: %s: %s", e.text, w.text);
    DAR_ASSERT(again.meta.frames == c->meta.frames && again.files == c->files && again.tracks == c->tracks &&
                   again.meta.seed == c->meta.seed && again.meta.objects == c->meta.objects,
               "printed and read: other numbers: %s", w.text);
    for (int f = 0; f < DAR_BUNDLE_FAMILIES; f++) {
        const dar_bundle_store *a = &c->store[f], *b = &again.store[f];
        size_t n = dar_bundle_table[f].channels * sizeof(double);
        DAR_ASSERT(a->there == b->there && a->exr == b->exr && a->type == b->type &&
                       memcmp(a->scale, b->scale, n) == 0 && memcmp(a->offset, b->offset, n) == 0,
                   "printed and read: another %s: %s", dar_bundle_table[f].name, w.text);
    }
    dar_bundle_contents_free(&again);
    dar_json_close(doc);
    dar_json_writer_free(&w);
}

static void check_meta(const char *meta, size_t size)
{
    dar_bundle_contents c = { 0 };
    dar_json_doc *doc;
    dar_err e = { "" };
    dar_status s = dar_json_parse(&doc, "fuzz", meta, size, &e);
    if (s == DAR_OK) s = dar_bundle_read_meta(&c, doc, &e);
    if (s != DAR_OK) {
        check_line(&e);
    } else {
        check_contents(&c);
        check_again(&c);
    }
    dar_bundle_contents_free(&c);
    dar_json_close(doc);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static const char *const sets[] = { "camera", "dar", "mask+depth+normal" };
    const char *text = (const char *)data, *cut = size ? memchr(text, '\f', size) : NULL;
    size_t meta_size = cut ? (size_t)(cut - text) : size, rest = cut ? size - meta_size - 1 : 0;
    dar_bundle *b;
    dar_err e = { "" };

    check_meta(text, meta_size);
    if (dar_bundle_parse(&b, "fuzz", text, meta_size, cut ? cut + 1 : "", rest, &e) != DAR_OK) check_line(&e);
    for (size_t i = 0; i < DAR_COUNT(sets) && b; i++) {
        dar_condition c = { 0 };
        dar_condition_source s;
        DAR_ASSERT(dar_channel_set_parse(&c.set, sets[i], &e) == DAR_OK, "%s", e.text);
        if (dar_bundle_source(b, &c, &s, &e) != DAR_OK) check_line(&e);
    }
    dar_bundle_close(b);
    return 0;
}
