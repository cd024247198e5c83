/* test_torch_file.c: what torch.save wrote is read; every kind of damage gives one line that names the file. */
#include "tests/fixture.h"

#include "lib/file.h"
#include "lib/weights.h"

/* ---------------------------------------------------------------- sound files */

static void both_containers(void **state)
{
    (void)state;
    static const char *const names[] = { "torch_zip.pth", "torch_old.pth" };
    for (int k = 0; k < 2; k++) {
        dar_weights *w = fixture_open(names[k]);
        assert_int_equal(dar_weights_count(w), 5);
        for (size_t i = 0; i < 6; i++) {
            double x = (double)i / 4 - 0.5;
            CHECK_NEAR("f32", fixture_number(w, "f32", i), x, 0);
            CHECK_NEAR("bf16", fixture_number(w, "bf16", i), x, 0);
            CHECK_NEAR("tied", fixture_number(w, "tied", i), x, 0);
            if (i >= 3)
                CHECK_NEAR("half", fixture_number(w, "half", i - 3), x, 0); /* a view that was made one by .half() */
        }
        const dar_weight *steps = dar_weights_find(w, "steps"), *f32 = dar_weights_find(w, "f32");
        assert_string_equal(steps->type, "I64");
        assert_int_equal(steps->dims, 0);
        assert_int_equal(*(const char *)steps->data, 7);
        assert_int_equal(f32->dims, 2);
        assert_int_equal(f32->dim[0], 2);
        assert_int_equal(f32->dim[1], 3);
        assert_ptr_equal(f32->data, dar_weights_find(w, "tied")->data);
        dar_weights_close(w);
    }
}

static void inside_a_checkpoint(void **state)
{
    (void)state;
    dar_weights *w = fixture_open("torch_inner.pth");
    assert_int_equal(dar_weights_count(w), 7);
    CHECK_NEAR("0.weight", fixture_number(w, "0.weight", 5), -2, 0);
    CHECK_NEAR("1.running_var", fixture_number(w, "1.running_var", 1), 1.5, 0);
    dar_weights_close(w);
    w = fixture_open("torch_parameter.pth");
    CHECK_NEAR("p", fixture_number(w, "p", 5), 0.75, 0);
    dar_weights_close(w);
}

static void strided(void **state)
{
    (void)state;
    dar_weights *w;
    dar_err e;
    assert_int_equal(dar_weights_open(&w, "tests/fixtures/torch_strided.pth", &e), DAR_ERR_FORMAT);
    assert_null(w);
    assert_string_equal(e.text,
                        "tests/fixtures/torch_strided.pth: turned: a strided view, expected a contiguous tensor");
}

/* ---------------------------------------------------------------- damage */

/* Refused in one line, or read; either way no byte beyond the file is touched. */
static bool survives(const unsigned char *data, size_t size)
{
    unsigned char *exact = malloc(size + !size);
    dar_weights *w;
    dar_err e = { "" };
    memcpy(exact, data, size);
    dar_status s = dar_weights_parse(&w, "damaged", exact, size, &e);
    unsigned sum = 0;
    if (s == DAR_OK)
        for (size_t i = 0; i < dar_weights_count(w); i++)
            for (size_t k = 0; k < dar_weights_at(w, i)->bytes; k++)
                sum += ((const unsigned char *)dar_weights_at(w, i)->data)[k];
    else CHECK(s == DAR_ERR_FORMAT && strncmp(e.text, "damaged: ", 9) == 0, "status %d: %s", (int)s, e.text);
    (void)sum;
    dar_weights_close(w);
    free(exact);
    return s == DAR_OK;
}

static void truncated_or_flipped(void **state)
{
    (void)state;
    static const char *const names[] = { "tests/fixtures/torch_zip.pth", "tests/fixtures/torch_old.pth" };
    for (int k = 0; k < 2; k++) {
        dar_file_map m;
        assert_int_equal(dar_file_map_open(&m, names[k], NULL), DAR_OK);
        for (size_t n = 0; n < m.size; n++)
            CHECK(!survives(m.data, n), "%s: read with %zu of %zu bytes", names[k], n, m.size);
        unsigned char *copy = malloc(m.size);
        memcpy(copy, m.data, m.size);
        for (size_t i = 0; i < m.size; i++)
            for (int bit = 0; bit < 8; bit += 1 + (int)(i % 3)) {
                copy[i] ^= (unsigned char)(1 << bit);
                survives(copy, m.size);
                copy[i] = m.data[i];
            }
        assert_true(survives(copy, m.size));
        free(copy);
        dar_file_map_close(&m);
    }
}

/* ---------------------------------------------------------------- pickles by hand */

#define OLD                                                                                                            \
    "\x80\x02\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19."                                                        \
    "\x80\x02M\xe9\x03."                                                                                               \
    "\x80\x02}."
#define KEY "X\1\0\0\0"
#define REF                                                                                                            \
    "(X\7\0\0\0storagectorch\nFloatStorage\nX\1\0\0\0"                                                                 \
    "0X\3\0\0\0cpuK\2tQ"
#define V2   "ctorch._utils\n_rebuild_tensor_v2\n("
#define REST "\x89}tR"
#define ROW                                                                                                            \
    "\x80\x02]X\1\0\0\0"                                                                                               \
    "0a."                                                                                                              \
    "\2\0\0\0\0\0\0\0"                                                                                                 \
    "\0\0\x80\x3f\0\0\0\x40"

typedef struct crafted {
    const char *bytes;
    size_t size;
    const char *says; /* part of the message; NULL: is read */
} crafted;

#define CRAFTED(text, says)                                                                                            \
    {                                                                                                                  \
        text, sizeof(text) - 1, says                                                                                   \
    }
#define TENSOR(offset, shape, stride) V2 REF offset shape stride REST

static void crafted_pickles(void **state)
{
    (void)state;
    static const crafted all[] = {
        CRAFTED(OLD "\x80\x02}" KEY "a" TENSOR("K\0", "K\2\x85", "K\1\x85") "s." ROW, NULL),
        CRAFTED(OLD "\x80\x02}" KEY "a" TENSOR("K\1", "K\1\x85", "K\5\x85") "s." ROW,
                NULL), /* one element: any stride */
        CRAFTED(OLD "\x80\x02}" KEY "a" TENSOR("K\0", ")", ")") "s." ROW, NULL),
        CRAFTED(OLD "\x80\x02}" KEY "a" TENSOR("K\0", "K\3\x85", "K\1\x85") "s." ROW, "beyond its storage"),
        CRAFTED(OLD "\x80\x02}" KEY "a" TENSOR("K\1", "K\2\x85", "K\1\x85") "s." ROW, "beyond its storage"),
        CRAFTED(OLD "\x80\x02}" KEY "a" TENSOR("J\xff\xff\xff\xff", "K\2\x85", "K\1\x85") "s." ROW, "unknown way"),
        CRAFTED(OLD "\x80\x02}" KEY "a" TENSOR("K\0", "K\0\x85", "K\1\x85") "s." ROW, "at least 1"),
        CRAFTED(OLD "\x80\x02}" KEY "a" TENSOR("K\0", "K\2\x85", "K\0\x85") "s." ROW, "strided"),
        CRAFTED(OLD "\x80\x02}" KEY "a" TENSOR("K\0", "K\2\x85", "K\1K\1\x86") "s." ROW, "shape and strides"),
        CRAFTED(OLD "\x80\x02}" KEY "a" TENSOR("K\0", "J\xff\xff\xff\x7fJ\xff\xff\xff\x7fJ\xff\xff\xff\x7f\x87",
                                               "\x8a\x08\1\0\0\0\xff\xff\xff\x3fJ\xff\xff\xff\x7fK\1\x87") "s." ROW,
                "counted"),
        CRAFTED(OLD "\x80\x02}" KEY
                    "a" TENSOR("K\0", "K\2\x85", "K\1\x85") "s" KEY "a" TENSOR("K\0", "K\2\x85", "K\1\x85") "s." ROW,
                "is in"),
        CRAFTED(OLD "\x80\x02}" KEY "a" TENSOR("K\0", "K\2\x85", "K\1\x85") "s." ROW "\0", "behind the last storage"),
        CRAFTED(OLD "\x80\x02}X\0\0\0\0" TENSOR("K\0", "K\2\x85", "K\1\x85") "s." ROW, "a name must be"),
        CRAFTED(OLD "\x80\x02"
                    "cos\nsystem\nX\2\0\0\0ls\x85R." ROW,
                "os.system"),
        CRAFTED(OLD "\x80\x02"
                    "ctorch\nFloatStorage\n)R." ROW,
                "a call of what"),
        CRAFTED(OLD "\x80\x02(ios\nsystem\n." ROW, "opcode 0x69"),
        CRAFTED(OLD "\x80\x02N\x81." ROW, "opcode 0x81"),
        CRAFTED(OLD "\x80\x02h\5." ROW, "memo 5 is not defined"),
        CRAFTED(OLD "\x80\x02}r\xff\xff\xff\xff." ROW, "memo 4294967295"),
        CRAFTED(OLD "\x80\x02}K\1K\2u." ROW, "no mark"),
        CRAFTED(OLD "\x80\x02}(K\1u." ROW, "a key without a value"),
        CRAFTED(OLD "\x80\x02](K\1u." ROW, "no dict"),
        CRAFTED(OLD "\x80\x02]}b." ROW, "no dict"),
        CRAFTED(OLD "\x80\x02.", "0 values on the stack"),
        CRAFTED(OLD "\x80\x02(.", "1 values on the stack"),
        CRAFTED(OLD "\x80\x02(R.", "an empty stack"),
        CRAFTED(OLD "\x80\x02X\xff\xff\xff\x7f.", "a text of"),
        CRAFTED(OLD "\x80\x02\x8a\xff.", "an integer of 255 bytes"),
        CRAFTED(OLD "\x80\x04}.", "protocol 4"),
        CRAFTED(OLD "\x80\x02K\1."
                    "\x80\x02].",
                "no dict of tensors"),
        CRAFTED(OLD "\x80\x02]q\0h\0a."
                    "\x80\x02].",
                "no dict of tensors"), /* a list in itself */
        CRAFTED(OLD "\x80\x02" REF "." ROW, "no dict of tensors"),
    };
    for (size_t i = 0; i < DAR_COUNT(all); i++) {
        dar_weights *w;
        dar_err e = { "" };
        dar_status s = dar_weights_parse(&w, "crafted", all[i].bytes, all[i].size, &e);
        if (!all[i].says) CHECK(s == DAR_OK, "case %zu: %s", i, e.text);
        else
            CHECK(s == DAR_ERR_FORMAT && strstr(e.text, all[i].says), "case %zu: %s, expected %s", i, e.text,
                  all[i].says);
        dar_weights_close(w);
    }
}

/* Nested pairs of what was remembered double with every byte when they are copied; here they are not. */
static void laughing_tuples(void **state)
{
    (void)state;
    char bytes[4096] = OLD "\x80\x02)";
    size_t n = sizeof(OLD "\x80\x02)") - 1;
    for (int i = 0; i < 200; i++) {
        memcpy(bytes + n, (char[]){ 'q', (char)i, 'h', (char)i, (char)0x86 }, 5);
        n += 5;
    }
    bytes[n++] = '.';
    memcpy(bytes + n, "\x80\x02].", 4);
    assert_false(survives((unsigned char *)bytes, n + 4));
}

/* ---------------------------------------------------------------- zips by hand */

static void patch(const char *what, const unsigned char *sound, size_t size, size_t place, const char *bytes, size_t n,
                  const char *says)
{
    unsigned char *copy = malloc(size);
    dar_weights *w;
    dar_err e = { "" };
    memcpy(copy, sound, size);
    memcpy(copy + place, bytes, n);
    dar_status s = dar_weights_parse(&w, "patched", copy, size, &e);
    CHECK(s == DAR_ERR_FORMAT && strstr(e.text, says), "%s: '%s', expected '%s'", what, e.text, says);
    dar_weights_close(w);
    free(copy);
}

static void lying_zips(void **state)
{
    (void)state;
    dar_file_map m;
    assert_int_equal(dar_file_map_open(&m, "tests/fixtures/torch_zip.pth", NULL), DAR_OK);
    const unsigned char *z = m.data, *second = NULL;
    size_t end = m.size - 22, record = 0;
    memcpy(&record, z + end - 12, 8); /* the zip64 record, which torch always writes */
    size_t first = 0;
    memcpy(&first, z + record + 48, 8);
    assert_memory_equal(z + first, "PK\1\2", 4);
    for (const unsigned char *p = z + first + 4; !second; p++)
        if (memcmp(p, "PK\1\2", 4) == 0) second = p;
    size_t next = (size_t)(second - z);

    patch("method", z, m.size, first + 10, "\10", 1, "compressed");
    patch("flag", z, m.size, first + 8, "\1", 1, "encrypted");
    patch("packed size", z, m.size, first + 20, "\1\0\0\0", 4, "compressed");
    patch("local name", z, m.size, 30, "X", 1, "local header");
    patch("local header", z, m.size, 0, "PK\3\4\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\1", 27, "local header");
    patch("both in one place", z, m.size, next + 42, "\0\0\0\0", 4, "local header");
    patch("place", z, m.size, next + 42, "\xfe\xff\xff\x7f", 4, "local header");
    patch("size", z, m.size, next + 20, "\xfe\xff\xff\x7f\xfe\xff\xff\x7f", 8, "beyond the zip's data");
    patch("size into the next entry", z, m.size, first + 20, "\0\3\0\0\0\3\0\0", 8, "overlap");
    patch("entries", z, m.size, record + 24, "\xff\xff\xff\xff\0\0\0\0\xff\xff\xff\xff\0\0\0\0", 16, "entries");
    patch("one too many", z, m.size, record + 24, "\x7f\0\0\0\0\0\0\0\x7f\0\0\0\0\0\0\0", 16, "ends early");
    patch("directory", z, m.size, record + 48, "\xff\xff\xff\xff\xff\xff\xff\xff", 8, "not where");
    patch("record", z, m.size, end - 12, "\xff\xff\xff\xff\xff\xff\xff\xff", 8, "zip64 record");
    patch("disks", z, m.size, record + 16, "\1", 1, "several parts");
    dar_file_map_close(&m);
}

int main(void)
{
    static const struct CMUnitTest tests[] = {
        cmocka_unit_test(both_containers), cmocka_unit_test(inside_a_checkpoint),
        cmocka_unit_test(strided),         cmocka_unit_test(truncated_or_flipped),
        cmocka_unit_test(crafted_pickles), cmocka_unit_test(laughing_tuples),
        cmocka_unit_test(lying_zips),
    };
    return cmocka_run_group_tests_name("torch_file", tests, NULL, NULL) != 0;
}
