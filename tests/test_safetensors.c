/* test_safetensors.c: what is written is read; every kind of damage gives one line that names the file. */
#include "tests/scratch.h"

#include <dirent.h>
#include <signal.h>
#include <sys/resource.h>

#include "lib/safetensors_write.h"
#include "lib/weights.h"

static size_t files_there(void)
{
    size_t n = 0;
    DIR *d = opendir(scratch_dir);
    for (const struct dirent *x; (x = readdir(d));) n += x->d_name[0] != '.';
    closedir(d);
    return n;
}

static int empty_dir(void **state)
{
    (void)state;
    return run_remove(scratch_dir) || mkdir(scratch_dir, 0777);
}

static void same_text(const char *found, const char *expected)
{
    CHECK(strcmp(found, expected) == 0, "found:    %s\nexpected: %s", found, expected);
}

/* ---------------------------------------------------------------- in memory */

/* A file of header and `data` zero bytes in memory of exactly its size, so that reading past it is seen. */
static unsigned char *file_of(const char *header, size_t length, size_t data, size_t *size)
{
    *size = 8 + length + data;
    unsigned char *p = calloc(*size, 1);
    for (size_t i = 0; i < 8; i++) p[i] = (unsigned char)(length >> (8 * i));
    memcpy(p + 8, header, length);
    return p;
}

static dar_status parse_copy(const unsigned char *data, size_t size, dar_err *e)
{
    dar_weights *s;
    unsigned char *exact = malloc(size ? size : 1);
    memcpy(exact, data, size);
    dar_status status = dar_weights_parse(&s, "t.st", exact, size, e);
    if (status == DAR_OK)
        for (size_t i = 0; i < dar_weights_count(s); i++) {
            const dar_weight *t = dar_weights_at(s, i);
            const unsigned char *p = t->data;
            CHECK(p >= exact + 8 && t->bytes <= size && p + t->bytes <= exact + size, "%s: outside of the file",
                  t->name);
            assert_ptr_equal(dar_weights_find(s, t->name), t);
        }
    else assert_null(s);
    dar_weights_close(s);
    free(exact);
    return status;
}

/* One line, of this file. */
static void check_line(const char *text)
{
    CHECK(strncmp(text, "t.st: ", 6) == 0 || strncmp(text, "t.st:1:", 7) == 0, "does not name the file: %s", text);
    for (const char *p = text; *p; p++) CHECK((unsigned char)*p >= 0x20, "more than a line: %s", text);
}

static void header_refused(const char *header, size_t data, const char *message)
{
    size_t size;
    dar_err e = { "" };
    unsigned char *p = file_of(header, strlen(header), data, &size);
    CHECK(parse_copy(p, size, &e) == DAR_ERR_FORMAT, "accepted: %s", header);
    same_text(e.text, message);
    check_line(e.text);
    free(p);
}

#define T(dtype, shape, offsets) "{\"dtype\":\"" dtype "\",\"shape\":[" shape "],\"data_offsets\":[" offsets "]}"

static void damaged_headers(void **state)
{
    (void)state;
    static const struct {
        const char *header;
        size_t data;
        const char *message;
    } bad[] = {
        { "", 0, "t.st: the header does not start with '{'" },
        { " {}", 0, "t.st: the header does not start with '{'" },
        { "[]", 0, "t.st: the header does not start with '{'" },
        { "{}", 1, "t.st: tensors end at 0 of 1 bytes of data" },
        { "{", 0, "t.st:1:2: ends too early" },
        { "{} {}", 0, "t.st:1:4: unexpected '{', expected nothing more" },
        { "{\"a\":" T("F32", "2", "0,8") "}", 9, "t.st: tensors end at 8 of 9 bytes of data" },
        { "{\"a\":" T("F32", "2", "0,8") "}", 7,
          "t.st: a: data_offsets [0, 8], expected a range in the file's 7 bytes of data" },
        { "{\"a\":" T("F32", "2", "8,0") "}", 8,
          "t.st: a: data_offsets [8, 0], expected a range in the file's 8 bytes of data" },
        { "{\"a\":" T("F32", "2", "4,12") "}", 12, "t.st: a: begins at 4, expected 0: there is a hole before it" },
        { "{\"a\":" T("F32", "2", "0,8") ",\"b\":" T("F32", "1", "12,16") "}", 16,
          "t.st: b: begins at 12, expected 8: there is a hole before it" },
        { "{\"a\":" T("F32", "2", "0,8") ",\"b\":" T("F32", "1", "4,8") "}", 8,
          "t.st: b: begins at 4, expected 8: there is an overlap" },
        { "{\"a\":" T("F32", "2", "0,8") ",\"b\":" T("F32", "2", "0,8") "}", 8,
          "t.st: b: begins at 0, expected 8: there is an overlap" },
        { "{\"a\":" T("F32", "3", "0,8") "}", 8, "t.st: a: shape and dtype F32 give 96 bits, data_offsets 8 bytes" },
        { "{\"a\":" T("F4", "3", "0,1") "}", 1, "t.st: a: shape and dtype F4 give 12 bits, data_offsets 1 bytes" },
        { "{\"a\":" T("F32", "4294967296,4294967296", "0,0") "}", 0,
          "t.st: a: the shape has more bits than can be counted" },
        { "{\"a\":" T("U8", "4194304,4194304,2097152", "0,8") "}", 8,
          "t.st: a: the shape has more bits than can be counted" },
        { "{\"a\":" T("F32", "0", "0,0") "}", 0,
          "t.st: a.shape[0]: found 0, expected an integer, at least 1 and below 2^53" },
        { "{\"a\":" T("F32", "18446744073709551616", "0,8") "}", 8,
          "t.st: a.shape[0]: found 1.8446744073709552e+19, expected an integer, at least 1 and below 2^53" },
        { "{\"a\":" T("F32", "2", "0,9007199254740993") "}", 8,
          "t.st: a.data_offsets[1]: found 9007199254740992, expected an integer, at least 0 and below 2^53" },
        { "{\"a\":" T("F32", "-2", "0,8") "}", 8,
          "t.st: byte 29 of the header is '-', expected a plain integer or string" },
        { "{\"a\":" T("F32", "2.0", "0,8") "}", 8,
          "t.st: byte 30 of the header is '.', expected a plain integer or string" },
        { "{\"a\":" T("F32", "2", "0,8e0") "}", 8,
          "t.st: byte 51 of the header is 'e', expected a plain integer or string" },
        { "{\"a\":null}", 0, "t.st: byte 5 of the header is 'n', expected a plain integer or string" },
        { "{/**/}", 0, "t.st: byte 1 of the header is '/', expected a plain integer or string" },
        { "{\"a\":" T("F32", "\"2\"", "0,8") "}", 8,
          "t.st: a.shape[0]: found \"2\", expected an integer, at least 1 and below 2^53" },
        { "{\"a\":" T("F32", "1,1,1,1,1,1,1,1,1", "0,4") "}", 4,
          "t.st: a.shape: found an array, expected an array of at most 8 dimensions" },
        { "{\"a\":" T("F32", "2", "0,8,8") "}", 8,
          "t.st: a.data_offsets: found an array, expected an array of two integers" },
        { "{\"a\":" T("F32", "2", "[0],8") "}", 8,
          "t.st: a.data_offsets[0]: found an array, expected an integer, at least 0 and below 2^53" },
        { "{\"a\":{\"dtype\":\"F32\",\"data_offsets\":[0,4]}}", 4,
          "t.st: a.shape: missing, expected an array of at most 8 dimensions" },
        { "{\"a\":{\"dtype\":\"F32\",\"shape\":[]}}", 4,
          "t.st: a.data_offsets: missing, expected an array of two integers" },
        { "{\"a\":{\"dtype\":3,\"shape\":[],\"data_offsets\":[0,4]}}", 4, "t.st: a.dtype: found 3, expected a string" },
        { "{\"a\":{\"dtyp\":\"F32\",\"shape\":[],\"data_offsets\":[0,4]}}", 4,
          "t.st: a.dtype: missing, expected a string" },
        { "{\"a\":{\"dtype\":\"F32\",\"shape\":[],\"data_offsets\":[0,4],\"x\":1}}", 4, "t.st: a.x: unknown key" },
        { "{\"a\":7}", 0, "t.st: a: found 7, expected an object" },
        { "{\"a\":" T("F32", "1", "0,4") ",\"a\":" T("F32", "1", "4,8") "}", 8, "t.st: a: given twice" },
        { "{\"a\":{\"dtype\":\"F32\",\"shape\":[],\"shape\":[1],\"data_offsets\":[0,4]}}", 4,
          "t.st: a.shape: given twice" },
        { "{\"\":" T("F32", "1", "0,4") "}", 4, "t.st: a name must be 1 to 512 bytes of printable UTF-8, found ''" },
        { "{\"a\\nb\":" T("F32", "1", "0,4") "}", 4,
          "t.st: a name must be 1 to 512 bytes of printable UTF-8, found 'a?b'" },
        { "{\"\\u0085\":" T("F32", "1", "0,4") "}", 4,
          "t.st: a name must be 1 to 512 bytes of printable UTF-8, found '\xc2\x85'" },
        { "{\"a\xff\":" T("F32", "1", "0,4") "}", 4, "t.st:1:4: not UTF-8" },
        { "{\"a\\u0000\":" T("F32", "1", "0,4") "}", 4, "t.st:1:4: \\u0000 in a string" },
        { "{\"__metadata__\":{\"a\":1}}", 0, "t.st: __metadata__.a: found 1, expected a string" },
        { "{\"__metadata__\":[\"a\"]}", 0, "t.st: __metadata__: found an array, expected an object" },
        { "{\"__metadata__\":{\"a\":\"1\",\"a\":\"2\"}}", 0, "t.st: __metadata__.a: given twice" },
    };
    for (size_t i = 0; i < DAR_COUNT(bad); i++) header_refused(bad[i].header, bad[i].data, bad[i].message);
}

static void damaged_lengths(void **state)
{
    (void)state;
    size_t size;
    dar_err e;
    unsigned char *p = file_of("{}", 2, 0, &size);
    for (size_t n = 0; n < 8; n++) {
        assert_int_equal(parse_copy(p, n, &e), DAR_ERR_FORMAT);
        check_line(e.text);
    }
    memset(p, 0xff, 8);
    assert_int_equal(parse_copy(p, size, &e), DAR_ERR_FORMAT);
    same_text(e.text, "t.st: a header of 18446744073709551615 bytes, expected at most 2");
    free(p);

    char *deep = malloc(4096);
    memset(deep, '[', 4096);
    memcpy(deep, "{\"a\":", 5);
    p = file_of(deep, 4096, 0, &size);
    assert_int_equal(parse_copy(p, size, &e), DAR_ERR_FORMAT);
    same_text(e.text, "t.st:1:69: more than 64 levels");
    free(p);
    free(deep);

    size_t huge = DAR_WEIGHTS_HEADER + 1;
    char *wide = malloc(huge);
    memset(wide, ' ', huge);
    memcpy(wide, "{}", 2);
    p = file_of(wide, huge, 0, &size);
    assert_int_equal(parse_copy(p, size, &e), DAR_ERR_FORMAT);
    same_text(e.text, "t.st: a header of 16777217 bytes, expected at most 16777216");
    free(p);
    p = file_of(wide, huge - 1, 0, &size);
    assert_int_equal(parse_copy(p, size, &e), DAR_OK);
    free(p);
    for (size_t i = 0; i < huge - 1; i++) wide[i] = i % 2 ? ',' : '0';
    wide[0] = '{';
    p = file_of(wide, huge - 1, 0, &size);
    assert_int_equal(parse_copy(p, size, &e), DAR_ERR_FORMAT); /* without parsing 8 million values */
    same_text(e.text, "t.st: the header has more than 1048576 values");
    free(p);
    free(wide);
}

static const char sound[] = "{\"__metadata__\":{\"format\":\"pt\"},\"b\":" T("F32", "2,3", "0,24") ",\"a.w\":" T(
    "BF16", "5", "24,34") ",\"\xc3\xa9\":" T("I64", "", "34,42") "}";

static void truncated_everywhere(void **state)
{
    (void)state;
    size_t size;
    dar_err e;
    unsigned char *p = file_of(sound, strlen(sound), 42, &size);
    assert_int_equal(parse_copy(p, size, &e), DAR_OK);
    for (size_t n = 0; n < size; n++) {
        CHECK(parse_copy(p, n, &e) == DAR_ERR_FORMAT, "accepted with %zu of %zu bytes", n, size);
        check_line(e.text);
    }
    free(p);
}

static void flipped_everywhere(void **state)
{
    (void)state;
    size_t size, accepted = 0, bits = 8 * (8 + strlen(sound));
    dar_err e;
    unsigned char *p = file_of(sound, strlen(sound), 42, &size);
    for (size_t i = 0; i < bits; i++) {
        p[i / 8] ^= (unsigned char)(1u << i % 8);
        dar_status s = parse_copy(p, size, &e);
        CHECK(s == DAR_OK || s == DAR_ERR_FORMAT, "bit %zu: status %d", i, (int)s);
        if (s != DAR_OK) check_line(e.text);
        accepted += s == DAR_OK;
        p[i / 8] ^= (unsigned char)(1u << i % 8);
    }
    CHECK(accepted < bits / 4, "%zu of %zu flipped bits accepted", accepted, bits); /* letters of names and metadata */
    free(p);
}

/* As many tensors as are allowed, and one more. */
static void many_tensors(void **state)
{
    (void)state;
    size_t limit = DAR_WEIGHTS_TENSORS, room = 100 * (limit + 1), at, size;
    char *text = malloc(room);
    dar_err e = { "" };
    for (size_t n = limit; n <= limit + 1; n++) {
        at = (size_t)snprintf(text, room, "{");
        for (size_t i = 0; i < n; i++)
            at += (size_t)snprintf(text + at, room - at, "%s\"t%zu\":" T("U8", "1", "%zu,%zu"), i ? "," : "", i, i,
                                   i + 1);
        at += (size_t)snprintf(text + at, room - at, "}");
        unsigned char *p = file_of(text, at, n, &size);
        dar_status s = parse_copy(p, size, &e);
        CHECK(s == (n == limit ? DAR_OK : DAR_ERR_FORMAT), "%zu tensors: %s", n, e.text);
        free(p);
    }
    same_text(e.text, "t.st: 65537 tensors, expected at most 65536");
    free(text);
}

static void views(void **state)
{
    (void)state;
    dar_weights *s;
    dar_err e;
    dar_tensor x;
    size_t size;
    unsigned char *p = file_of(sound, strlen(sound), 42, &size), *data = p + size - 42;
    unsigned char *moved = malloc(size + 8);
    float f = 1.5f;
    memcpy(data + 20, &f, 4);

    for (size_t shift = 0; shift < 4; shift++) { /* one of them is aligned, the others are copied */
        memcpy(moved + shift, p, size);
        assert_int_equal(dar_weights_parse(&s, "t.st", moved + shift, size, &e), DAR_OK);
        assert_int_equal(dar_weights_count(s), 3);
        assert_string_equal(dar_weights_meta(s, "format"), "pt");
        assert_null(dar_weights_meta(s, "other"));
        assert_int_equal(dar_weights_tensor(s, "b", &x, &e), DAR_OK);
        assert_int_equal((uintptr_t)x.data % 4, 0);
        assert_int_equal(x.shape.n, 2);
        assert_int_equal(x.shape.d[1], 3);
        CHECK_NEAR("b[5]", ((float *)x.data)[5], 1.5, 0);
        assert_int_equal(dar_weights_tensor(s, "a.w", &x, &e), DAR_OK);
        assert_int_equal(x.dtype, DAR_BF16);

        assert_int_equal(dar_weights_tensor(s, "\xc3\xa9", &x, &e), DAR_ERR_FORMAT);
        same_text(e.text, "t.st: \xc3\xa9: dtype I64, expected F64, F32, BF16 or F16");
        assert_string_equal(dar_weights_find(s, "\xc3\xa9")->type, "I64");
        assert_int_equal(dar_weights_tensor(s, "a.x", &x, &e), DAR_ERR_FORMAT);
        same_text(e.text, "t.st: a.x: no such tensor; did you mean 'a.w'?");
        dar_weights_close(s);
    }
    free(p);

    static const char seven[] = "{\"a\":" T("F32", "1,1,1,1,1,1,2", "0,8") ",\"b\":" T("X9", "3", "8,9") "}";
    p = file_of(seven, strlen(seven), 9, &size);
    assert_int_equal(dar_weights_parse(&s, "t.st", p, size, &e), DAR_OK); /* unless they are wanted */
    assert_int_equal(dar_weights_tensor(s, "a", &x, &e), DAR_ERR_FORMAT);
    same_text(e.text, "t.st: a: 7 dimensions, expected at most 6");
    assert_int_equal(dar_weights_tensor(s, "b", &x, &e), DAR_ERR_FORMAT);
    same_text(e.text, "t.st: b: dtype X9, expected F64, F32, BF16 or F16");
    dar_weights_close(s);
    free(p);
    free(moved);
}

/* ---------------------------------------------------------------- files */

static double f64_data[3] = { 1, -2, 0x1.fffffffffffffp+1023 };
static float f32_data[6] = { 0.5f, -0.0f, 3, 4, 5, 6 };
static uint16_t bf16_data[5] = { 0x3f80, 1, 2, 3, 4 };
static int8_t i8_data[7] = { -127, 0, 127, 1, 2, 3, 4 };

static size_t items(dar_safetensors_item *item)
{
    item[0] = (dar_safetensors_item){ "q", dar_tensor_of(DAR_I8, DAR_SHAPE(7), i8_data) };
    item[1] = (dar_safetensors_item){ "half", dar_tensor_of(DAR_BF16, DAR_SHAPE(5, 1), bf16_data) };
    item[2] = (dar_safetensors_item){ "single.weight", dar_tensor_of(DAR_F32, DAR_SHAPE(2, 3), f32_data) };
    item[3] = (dar_safetensors_item){ "scalar", dar_tensor_of(DAR_F32, (dar_shape){ 0 }, f32_data + 2) };
    item[4] = (dar_safetensors_item){ "double", dar_tensor_of(DAR_F64, DAR_SHAPE(3), f64_data) };
    return 5;
}

static void check_items(const char *path)
{
    dar_safetensors_item item[5];
    dar_weights *s;
    dar_err e;
    size_t n = items(item);
    CHECK(dar_weights_open(&s, path, &e) == DAR_OK, "%s", e.text);
    assert_int_equal(dar_weights_count(s), n);
    for (size_t i = 0; i < n; i++) {
        dar_tensor x;
        const dar_weight *t = dar_weights_find(s, item[i].name);
        size_t bytes = dar_tensor_count(&item[i].x) * dar_dtype_size(item[i].x.dtype);
        assert_non_null(t);
        assert_int_equal(t->bytes, bytes);
        assert_memory_equal(t->data, item[i].x.data, bytes);
        if (item[i].x.dtype == DAR_I8) continue;
        CHECK(dar_weights_tensor(s, item[i].name, &x, &e) == DAR_OK, "%s", e.text);
        assert_ptr_equal(x.data, t->data); /* our own files lie straight: nothing is copied */
        assert_int_equal(x.dtype, item[i].x.dtype);
        assert_true(dar_shape_equal(&x.shape, &item[i].x.shape));
    }
    dar_weights_close(s);
}

static void written_is_read(void **state)
{
    (void)state;
    dar_safetensors_item item[5];
    static const char *const meta[] = { "format", "pt", "ss_network_alpha", "16 \"\n", NULL };
    dar_err e;
    dar_weights *s;
    size_t n = items(item);
    CHECK(dar_safetensors_write(in_dir("m.safetensors"), item, n, &(dar_safetensors_options){ .meta = meta }, &e) ==
              DAR_OK,
          "%s", e.text);
    check_items(in_dir("m.safetensors"));
    check_items(scratch_dir);
    assert_int_equal(files_there(), 1);
    assert_int_equal(dar_weights_open(&s, in_dir("m.safetensors"), &e), DAR_OK);
    assert_string_equal(dar_weights_meta(s, "ss_network_alpha"), "16 \"\n");
    assert_int_equal((uintptr_t)dar_weights_at(s, 0)->data % 64, 0);
    dar_weights_close(s);

    assert_int_equal(dar_safetensors_write(in_dir("empty.safetensors"), NULL, 0, NULL, &e), DAR_OK);
    assert_int_equal(dar_weights_open(&s, in_dir("empty.safetensors"), &e), DAR_OK);
    assert_int_equal(dar_weights_count(s), 0);
    dar_weights_close(s);
    assert_int_equal(dar_weights_open(&s, scratch_dir, &e), DAR_ERR_FORMAT); /* two files: which? */

    item[1].name = "q";
    CHECK_ABORTS(dar_safetensors_write(in_dir("m.safetensors"), item, n, NULL, &e));
}

static void shards(void **state)
{
    (void)state;
    dar_safetensors_item item[5];
    dar_safetensors_options o = { .shard_bytes = 25 };
    dar_err e;
    size_t n = items(item);
    assert_int_equal(dar_safetensors_write(in_dir("m.safetensors"), item, n, NULL, &e), DAR_OK);
    CHECK(dar_safetensors_write(in_dir("m.safetensors"), item, n, &o, &e) == DAR_OK, "%s", e.text);
    assert_int_equal(files_there(), 5); /* 17, 24, 4, 24 bytes in 4 shards, and the index; no m.safetensors */
    assert_int_equal(access(in_dir("m-00004-of-00004.safetensors"), F_OK), 0);
    check_items(scratch_dir);
    check_items(in_dir("m.safetensors.index.json"));

    assert_int_equal(dar_safetensors_write(in_dir("m.safetensors"), item, n, NULL, &e), DAR_OK);
    assert_int_not_equal(access(in_dir("m.safetensors.index.json"), F_OK), 0);
    check_items(in_dir("m.safetensors"));
}

static void put_text(const char *name, const char *text)
{
    dar_file_out o;
    assert_int_equal(dar_file_create(&o, in_dir(name), NULL), DAR_OK);
    assert_int_equal(dar_file_write(&o, text, strlen(text), NULL), DAR_OK);
    assert_int_equal(dar_file_commit(&o, NULL), DAR_OK);
}

static void damaged_indices(void **state)
{
    (void)state;
    static const struct {
        const char *map, *message;
    } bad[] = {
        { "{\"weight_map\": {\"single.weight\": \"../a.safetensors\"}}",
          "weight_map.single.weight: found \"../a.safetensors\", expected a plain file name" },
        { "{\"weight_map\": {\"q\": \"\"}}", "weight_map.q: found \"\", expected a plain file name" },
        { "{\"weight_map\": {\"q\": \"..\"}}", "weight_map.q: found \"..\", expected a plain file name" },
        { "{\"weight_map\": {\"q\": 3}}", "weight_map.q: found 3, expected a string" },
        { "{\"weight_map\": 3}", "weight_map: found 3, expected an object" },
        { "{}", "weight_map: missing, expected an object" },
        { "{\"weight_map\": {\"lost\": \"a.safetensors\"}}", "lost: is not in a.safetensors" },
        { "{\"weight_map\": {\"q\": \"a.safetensors\", \"other\": \"b.safetensors\"}}",
          "other: is in DIR/a.safetensors and in DIR/b.safetensors" },
        { "{\"weight_map\": {\"q\": \"c.safetensors\", \"third\": \"a.safetensors\"}}", "q: is not in c.safetensors" },
    };
    dar_safetensors_item item[5], other = { "other", dar_tensor_of(DAR_F32, DAR_SHAPE(6), f32_data) };
    dar_weights *s;
    dar_err e;
    items(item);
    item[1] = other;
    assert_int_equal(dar_safetensors_write(in_dir("a.safetensors"), item, 2, NULL, &e), DAR_OK);
    assert_int_equal(dar_safetensors_write(in_dir("b.safetensors"), &other, 1, NULL, &e), DAR_OK);
    other.name = "third";
    assert_int_equal(dar_safetensors_write(in_dir("c.safetensors"), &other, 1, NULL, &e), DAR_OK);
    for (size_t i = 0; i < DAR_COUNT(bad); i++) {
        put_text("m.safetensors.index.json", bad[i].map);
        assert_int_equal(dar_weights_open(&s, scratch_dir, &e), DAR_ERR_FORMAT);
        assert_null(s);
        char expected[512], *mark;
        snprintf(expected, sizeof expected, "%s/m.safetensors.index.json: %s", scratch_dir, bad[i].message);
        while ((mark = strstr(expected, "DIR"))) {
            memmove(mark + strlen(scratch_dir), mark + 3, strlen(mark + 3) + 1);
            memcpy(mark, scratch_dir, strlen(scratch_dir));
        }
        same_text(e.text, expected);
    }
    put_text("m.safetensors.index.json", "{\"weight_map\": {\"q\": \"none.safetensors\"}}");
    assert_int_equal(dar_weights_open(&s, scratch_dir, &e), DAR_ERR_IO);
    assert_int_equal(dar_weights_open(&s, in_dir("none"), &e), DAR_ERR_IO);
    empty_dir(state);
    assert_int_equal(dar_weights_open(&s, scratch_dir, &e), DAR_ERR_FORMAT);
}

/* A disk that fills up in the middle, played by a limit on the size of files: what was there stays. */
static void full_disk(void **state)
{
    (void)state;
    dar_safetensors_item item[5];
    dar_err e;
    struct rlimit old, small = { 0 };
    size_t n = items(item), many = 1 << 16;
    float *big = calloc(many, sizeof *big);
    assert_int_equal(dar_safetensors_write(in_dir("m.safetensors"), item, n, NULL, &e), DAR_OK);

    getrlimit(RLIMIT_FSIZE, &old);
    small.rlim_cur = 100000;
    small.rlim_max = old.rlim_max;
    void (*handler)(int) = signal(SIGXFSZ, SIG_IGN);
    item[2] = (dar_safetensors_item){ "big", dar_tensor_of(DAR_F32, DAR_SHAPE((int64_t)many), big) };
    setrlimit(RLIMIT_FSIZE, &small);
    dar_status one = dar_safetensors_write(in_dir("m.safetensors"), item, n, NULL, &e);
    dar_status cut =
        dar_safetensors_write(in_dir("m.safetensors"), item, n, &(dar_safetensors_options){ .shard_bytes = 20 }, &e);
    setrlimit(RLIMIT_FSIZE, &old);
    signal(SIGXFSZ, handler);

    assert_int_equal(one, DAR_ERR_NOMEM);
    assert_int_equal(cut, DAR_ERR_NOMEM);
    assert_int_equal(dar_status_exit(one), 3);
    assert_int_equal(files_there(), 1);
    check_items(in_dir("m.safetensors"));
    assert_int_equal(dar_safetensors_write(in_dir("no/m.safetensors"), item, n, NULL, &e), DAR_ERR_IO);
    free(big);
}

/* A file of the format's reference writer: scripts/make-fixtures.py safetensors. */
static void foreign_file(void **state)
{
    (void)state;
    dar_weights *s;
    dar_tensor x;
    dar_err e;
    CHECK(dar_weights_open(&s, "tests/fixtures/reference.safetensors", &e) == DAR_OK, "%s", e.text);
    assert_int_equal(dar_weights_count(s), 6);
    assert_string_equal(dar_weights_meta(s, "made by"), "the reference writer");
    static const char *const names[] = { "f64", "f32", "bf16", "f16" };
    for (size_t k = 0; k < DAR_COUNT(names); k++) {
        CHECK(dar_weights_tensor(s, names[k], &x, &e) == DAR_OK, "%s", e.text);
        assert_string_equal(dar_dtype_name(x.dtype), names[k]);
        assert_int_equal(x.shape.n, 2);
        assert_int_equal(x.shape.d[0], 2);
        for (size_t i = 0; i < 6; i++) CHECK_NEAR(names[k], dar_dtype_get(x.dtype, x.data, i), (double)i / 4 - 0.5, 0);
    }
    assert_int_equal(dar_weights_tensor(s, "scalar", &x, &e), DAR_OK);
    assert_int_equal(x.shape.n, 0);
    CHECK_NEAR("scalar", *(float *)x.data, 7, 0);
    assert_string_equal(dar_weights_find(s, "steps")->type, "I64");
    dar_weights_close(s);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(damaged_headers),
        cmocka_unit_test(damaged_lengths),
        cmocka_unit_test(truncated_everywhere),
        cmocka_unit_test(flipped_everywhere),
        cmocka_unit_test(many_tensors),
        cmocka_unit_test(views),
        cmocka_unit_test_setup(written_is_read, empty_dir),
        cmocka_unit_test_setup(shards, empty_dir),
        cmocka_unit_test_setup(damaged_indices, empty_dir),
        cmocka_unit_test_setup(full_disk, empty_dir),
        cmocka_unit_test(foreign_file),
    };
    return cmocka_run_group_tests(tests, scratch_make, scratch_remove) != 0;
}
