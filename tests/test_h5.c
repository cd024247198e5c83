/* test_h5.c: HDF5 files: what is written comes back, what does not fit is refused in one line. */
#include "tests/scratch.h"

#include <sys/stat.h>
#include <unistd.h>

#include "data/deflate.h"
#include "data/h5.h"
#include "lib/file.h"

/* Read by the address sanitizer.  HDF5 1.10 does not give back what it holds of a damaged header that it gives up on:
 * its own objects (all that H5FL_... hands out; handles that we forget are reachable), and
 * one message.  The decoder of that has no name in the library, so it is known by its caller, whom only the slow
 * unwinder finds. */
const char *__lsan_default_suppressions(void);
const char *__lsan_default_suppressions(void)
{
    return "leak:H5FL_\nleak:H5O_msg_read_oh\n";
}

const char *__asan_default_options(void);
const char *__asan_default_options(void)
{
    return "fast_unwind_on_malloc=0";
}

/* Refused, and the line names the file and says this. */
static void refused_there(dar_status found, const dar_err *e, const char *says)
{
    refused(found, e, says);
    CHECK(strstr(e->text, scratch_dir), "message names no file: %s", e->text);
}

#define FRAMES 5

static void round_trip(void **state)
{
    (void)state;
    uint8_t x[2 * 3 * 7 * 4], y[sizeof x];
    dar_err e;
    dar_h5 *f;
    for (size_t i = 0; i < sizeof x; i++) x[i] = (uint8_t)(i * 37 + 11);
    for (int type = 0; type < DAR_H5_TYPES; type++) {
        dar_h5_array a = { .type = (dar_h5_type)type, .rank = 4, .dim = { FRAMES, 2, 3, 7 } }, b;
        size_t bytes = 2 * 3 * 7 * dar_h5_type_size(a.type);
        ok(dar_h5_create(&f, in_dir("a.h5"), &e), &e);
        ok(dar_h5_make(f, "one/two", &a, &e), &e);
        ok(dar_h5_write(f, "one/two", &a, 3, 1, x, &e), &e);
        ok(dar_h5_commit(f, &e), &e);
        dar_h5_close(f);

        ok(dar_h5_open(&f, in_dir("a.h5"), &e), &e);
        b = (dar_h5_array){ .type = a.type, .rank = 4, .dim = { 0, 2, 0, 7 } };
        ok(dar_h5_expect(f, "one/two", &b, &e), &e);
        CHECK(b.dim[0] == FRAMES && b.dim[2] == 3, "dimensions %d, %d", (int)b.dim[0], (int)b.dim[2]);
        ok(dar_h5_read(f, "one/two", &b, 3, 1, y, &e), &e);
        CHECK(memcmp(x, y, bytes) == 0, "type %d came back changed", type);
        ok(dar_h5_read(f, "one/two", &b, 2, 1, y, &e), &e);
        for (size_t i = 0; i < bytes; i++) CHECK(y[i] == 0, "never written, yet byte %zu is %d", i, y[i]);
        CHECK(dar_h5_has(f, "one") && !dar_h5_has(f, "one/three") && !dar_h5_has(f, "zero/two"), "names");
        dar_h5_close(f);
    }
}

static void several_rows(void **state)
{
    (void)state;
    float x[11][3], y[4][3];
    dar_h5_array a = { .type = DAR_H5_F32, .rank = 2, .dim = { 11, 3 }, .chunk = 4 };
    dar_err e;
    dar_h5 *f;
    for (int i = 0; i < 33; i++) x[i / 3][i % 3] = (float)i / 7;
    ok(dar_h5_create(&f, in_dir("rows.h5"), &e), &e);
    ok(dar_h5_make(f, "x", &a, &e), &e);
    ok(dar_h5_write(f, "x", &a, 0, 11, x, &e), &e);
    ok(dar_h5_commit(f, &e), &e);
    dar_h5_close(f);
    ok(dar_h5_open(&f, in_dir("rows.h5"), &e), &e);
    ok(dar_h5_expect(f, "x", &a, &e), &e);
    ok(dar_h5_read(f, "x", &a, 6, 4, y, &e), &e);
    CHECK(memcmp(y, x[6], sizeof y) == 0, "rows 6 to 9 came back changed");
    dar_h5_close(f);
}

/* tests/fixtures/foreign.h5: 1000, 1001, ... in layouts of another writer. */
static void foreign(void **state)
{
    (void)state;
    static const struct {
        const char *name;
        dar_h5_type type;
    } row[] = { { "odd", DAR_H5_U16 }, { "shuffled", DAR_H5_F32 }, { "bare", DAR_H5_U32 }, { "whole", DAR_H5_I16 } };
    dar_err e;
    dar_h5 *f;
    ok(dar_h5_open(&f, "tests/fixtures/foreign.h5", &e), &e);
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        dar_h5_array a = { .type = row[i].type, .rank = 3 };
        union {
            uint16_t u16[5 * 21];
            int16_t i16[5 * 21];
            uint32_t u32[5 * 21];
            float f32[5 * 21];
        } x;
        ok(dar_h5_expect(f, row[i].name, &a, &e), &e);
        CHECK(a.dim[0] == 5 && a.dim[1] == 3 && a.dim[2] == 7, "%s: dimensions", row[i].name);
        for (uint64_t first = 0; first < 5; first++)
            for (uint64_t count = 1; first + count <= 5; count++) {
                memset(&x, 0xff, sizeof x);
                ok(dar_h5_read(f, row[i].name, &a, first, count, &x, &e), &e);
                for (size_t k = 0; k < 21 * count; k++) {
                    double found = a.type == DAR_H5_U16   ? x.u16[k]
                                   : a.type == DAR_H5_I16 ? x.i16[k]
                                   : a.type == DAR_H5_U32 ? x.u32[k]
                                                          : (double)x.f32[k];
                    CHECK_NEAR(row[i].name, found, 1000 + 21 * (double)first + (double)k, 0);
                }
                size_t end = 21 * count * dar_h5_type_size(a.type);
                CHECK(end == sizeof x || ((unsigned char *)&x)[end] == 0xff, "%s: written past the end", row[i].name);
            }
    }
    dar_h5_array a = { .type = DAR_H5_U16, .rank = 3 };
    CHECK(dar_h5_expect(f, "summed", &a, &e) == DAR_ERR_FORMAT && strstr(e.text, "unknown filter"), "%s", e.text);
    dar_h5_close(f);
}

/* Chunks deflated by us: HDF5's own filters read them. */
static void own_chunks(void **state)
{
    (void)state;
    enum { MOST = 400001, CHUNKS = 3 };
    static const size_t sizes[] = { 1, 131071, 131072, 131073, 262144, MOST };
    static uint8_t x[CHUNKS][MOST], y[MOST], out[CHUNKS][2 * MOST];
    dar_deflate *d;
    dar_err e;
    dar_h5 *f;
    ok(dar_deflate_new(&d, &e), &e);
    for (size_t i = 0; i < MOST; i++) {
        x[0][i] = (uint8_t)(((i + 9) * 2654435761u) >> 13 ^ i >> 3); /* does not shrink */
        x[2][i] = i == MOST - 1 || i % 150000 == 0;                  /* all but zeros */
    }
    for (size_t k = 0; k < DAR_COUNT(sizes); k++) {
        dar_h5_array a = { .type = DAR_H5_U8, .rank = 2, .dim = { CHUNKS, sizes[k] } };
        dar_deflate_stream s[CHUNKS];
        CHECK(dar_deflate_bound(sizes[k]) <= sizeof out[0], "bound of %zu", sizes[k]);
        for (int c = 0; c < CHUNKS; c++) s[c] = (dar_deflate_stream){ .data = x[c], .size = sizes[k], .out = out[c] };
        dar_deflate_run(d, s, CHUNKS);
        CHECK(!s[0].zero && s[1].zero && !s[2].zero, "zeros");
        ok(dar_h5_create(&f, in_dir("a.h5"), &e), &e);
        ok(dar_h5_make(f, "x", &a, &e), &e);
        for (uint64_t c = 0; c < CHUNKS; c++) ok(dar_h5_write_chunk(f, "x", &a, c, s[c].out, s[c].out_size, &e), &e);
        ok(dar_h5_commit(f, &e), &e);
        dar_h5_close(f);
        ok(dar_h5_open(&f, in_dir("a.h5"), &e), &e);
        ok(dar_h5_expect(f, "x", &a, &e), &e);
        for (uint64_t c = 0; c < CHUNKS; c++) {
            ok(dar_h5_read(f, "x", &a, c, 1, y, &e), &e);
            CHECK(memcmp(x[c], y, sizes[k]) == 0, "%zu bytes of chunk %d came back changed", sizes[k], (int)c);
        }
        dar_h5_close(f);
    }
    dar_deflate_free(d);
}

static void attributes(void **state)
{
    (void)state;
    const double scale[3] = { 0.1, -2, 3e100 };
    double back[3] = { 0 };
    char text[16], small[4];
    dar_h5_array a = { .type = DAR_H5_U8, .rank = 1, .dim = { 2 } };
    dar_err e;
    dar_h5 *f;
    ok(dar_h5_create(&f, in_dir("attr.h5"), &e), &e);
    ok(dar_h5_make(f, "x", &a, &e), &e);
    ok(dar_h5_put_numbers(f, "x", "scale", scale, 3, &e), &e);
    ok(dar_h5_put_numbers(f, "x", "one", scale, 1, &e), &e);
    ok(dar_h5_put_text(f, "x", "space", "world", &e), &e);
    ok(dar_h5_commit(f, &e), &e);
    dar_h5_close(f);
    ok(dar_h5_open(&f, in_dir("attr.h5"), &e), &e);
    ok(dar_h5_get_numbers(f, "x", "scale", back, 3, &e), &e);
    CHECK(memcmp(scale, back, sizeof back) == 0, "numbers came back changed");
    ok(dar_h5_get_numbers(f, "x", "one", back, 1, &e), &e);
    ok(dar_h5_get_text(f, "x", "space", text, sizeof text, &e), &e);
    CHECK(strcmp(text, "world") == 0, "found %s", text);
    refused_there(dar_h5_get_text(f, "x", "space", small, sizeof small, &e), &e, "at most 4");
    refused_there(dar_h5_get_text(f, "x", "scale", text, sizeof text, &e), &e, "attribute scale");
    refused_there(dar_h5_get_numbers(f, "x", "space", back, 3, &e), &e, "attribute space");
    refused_there(dar_h5_get_numbers(f, "x", "scale", back, 2, &e), &e, "expected 2 numbers");
    refused_there(dar_h5_get_numbers(f, "x", "none", back, 1, &e), &e, "missing");
    dar_h5_close(f);
}

static void does_not_fit(void **state)
{
    (void)state;
    static const struct {
        dar_h5_array a;
        const char *says;
    } row[] = {
        { { .type = DAR_H5_I16, .rank = 3, .dim = { 5, 3, 7 } }, "found u16[5,3,7], expected i16[5,3,7]" },
        { { .type = DAR_H5_U16, .rank = 2, .dim = { 5, 3 } }, "found u16[5,3,7], expected u16[5,3]" },
        { { .type = DAR_H5_U16, .rank = 3, .dim = { 5, 7, 3 } }, "found u16[5,3,7], expected u16[5,7,3]" },
        { { .type = DAR_H5_U16, .rank = 3, .dim = { 0, 4, 7 } }, "found u16[5,3,7], expected u16[any,4,7]" },
    };
    dar_h5_array a = { .type = DAR_H5_U16, .rank = 3, .dim = { 5, 3, 7 } };
    dar_err e;
    dar_h5 *f;
    ok(dar_h5_create(&f, in_dir("fit.h5"), &e), &e);
    ok(dar_h5_make(f, "x", &a, &e), &e);
    refused_there(dar_h5_make(f, "x", &a, &e), &e, "x: cannot make: HDF5: ");
    ok(dar_h5_commit(f, &e), &e);
    dar_h5_close(f);
    ok(dar_h5_open(&f, in_dir("fit.h5"), &e), &e);
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        dar_h5_array want = row[i].a;
        refused_there(dar_h5_expect(f, "x", &want, &e), &e, row[i].says);
    }
    refused_there(dar_h5_expect(f, "y/z", &a, &e), &e, "y/z: found nothing");
    dar_h5_close(f);
}

static void never_half(void **state)
{
    (void)state;
    dar_h5_array a = { .type = DAR_H5_U8, .rank = 1, .dim = { 4096 } };
    struct stat st;
    dar_err e;
    dar_h5 *f;
    ok(dar_h5_create(&f, in_dir("half.h5"), &e), &e);
    ok(dar_h5_make(f, "x", &a, &e), &e);
    dar_h5_close(f);
    CHECK(stat(in_dir("half.h5"), &st) != 0, "a file that was not committed is there");
    refused_there(dar_h5_open(&f, in_dir("half.h5"), &e), &e, "No such file");
    CHECK(!f, "failed, yet open");
    refused_there(dar_h5_create(&f, in_dir("none/half.h5"), &e), &e, "No such file");
}

/* Written plainly: flushing thousands of files to the disk takes seconds. */
static void write_hurt(const unsigned char *data, size_t size, size_t at, bool cut)
{
    FILE *o = fopen(in_dir("hurt.h5"), "wb");
    assert_non_null(o);
    fwrite(data, 1, at, o);
    if (!cut) fputc(~data[at] & 0xff, o);
    if (!cut) fwrite(data + at + 1, 1, size - at - 1, o);
    assert_int_equal(fclose(o), 0);
}

/* A file cut short, or with any one byte changed: a status, never a fault. */
static void damaged(void **state)
{
    (void)state;
    uint8_t x[600], y[600];
    dar_h5_array a = { .type = DAR_H5_U8, .rank = 2, .dim = { 2, 300 } };
    dar_file_map m;
    dar_err e;
    dar_h5 *f;
    for (size_t i = 0; i < sizeof x; i++) x[i] = (uint8_t)(i * i >> 3);
    ok(dar_h5_create(&f, in_dir("whole.h5"), &e), &e);
    ok(dar_h5_make(f, "x", &a, &e), &e);
    ok(dar_h5_write(f, "x", &a, 0, 2, x, &e), &e);
    ok(dar_h5_commit(f, &e), &e);
    dar_h5_close(f);
    ok(dar_file_map_open(&m, in_dir("whole.h5"), &e), &e);
    for (size_t i = 0; i < 2 * m.size; i += i < m.size ? 1 : 13) {
        bool cut = i >= m.size;
        size_t at = i % m.size;
        write_hurt(m.data, m.size, at, cut);
        dar_status s = dar_h5_open(&f, in_dir("hurt.h5"), &e);
        dar_h5_array b = a;
        if (s == DAR_OK) s = dar_h5_expect(f, "x", &b, &e);
        if (s == DAR_OK) s = dar_h5_read(f, "x", &b, 0, 2, y, &e);
        CHECK(!cut || s != DAR_OK, "cut to %zu bytes, yet read", at);
        if (s != DAR_OK) refused_there(s, &e, "hurt.h5");
        dar_h5_close(f);
    }
    dar_file_map_close(&m);
}

int main(void)
{
    const struct CMUnitTest tests[] = { cmocka_unit_test(round_trip), cmocka_unit_test(several_rows),
                                        cmocka_unit_test(foreign),    cmocka_unit_test(own_chunks),
                                        cmocka_unit_test(attributes), cmocka_unit_test(does_not_fit),
                                        cmocka_unit_test(never_half), cmocka_unit_test(damaged) };
    return cmocka_run_group_tests(tests, scratch_make, scratch_remove) != 0;
}
