/* test_json.c: strict reading, typed reads and their messages, overrides, printing. */
#include "tests/test.h"

#include <unistd.h>

#include "lib/json.h"
#include "lib/nearest.h"

static dar_json_doc *good(const char *text)
{
    dar_json_doc *doc;
    dar_err e;
    dar_status s = dar_json_parse(&doc, "t.json", text, strlen(text), &e);
    CHECK(s == DAR_OK, "%s: refused: %s", text, e.text);
    return doc;
}

static void same_text(const char *found, const char *expected)
{
    CHECK(strcmp(found, expected) == 0, "found:    %s\nexpected: %s", found, expected);
}

static void refused(const char *text, size_t size, const char *message)
{
    dar_json_doc *doc;
    dar_err e;
    dar_status s = dar_json_parse(&doc, "t.json", text, size, &e);
    CHECK(s == DAR_ERR_FORMAT, "%s: accepted", text);
    assert_null(doc);
    same_text(e.text, message);
}

static void grammar(void **state)
{
    (void)state;
    static const struct {
        const char *text, *message;
    } bad[] = {
        { "", "t.json:1:1: ends too early" },
        { "  // only a comment", "t.json:1:20: ends too early" },
        { "{\"a\": 1,\n  \"b\" 2}", "t.json:2:7: unexpected '2', expected ':'" },
        { "{\"a\": 1,}", "t.json:1:9: unexpected '}', expected a key in quotes" },
        { "{a: 1}", "t.json:1:2: unexpected 'a', expected a key in quotes or '}'" },
        { "[tru]", "t.json:1:2: unexpected 't', expected a value or ']'" },
        { "{\"a\": 1]", "t.json:1:8: unexpected ']', expected ',' or '}'" },
        { "[,]", "t.json:1:2: unexpected ',', expected a value or ']'" },
        { "[1,]", "t.json:1:4: unexpected ']', expected a value" },
        { "[truefalse]", "t.json:1:6: unexpected 'f', expected ',' or ']'" },
        { "[1, 2", "t.json:1:6: ends too early" },
        { "[1]]", "t.json:1:4: unexpected ']', expected nothing more" },
        { "{} x", "t.json:1:4: unexpected 'x', expected nothing more" },
        { "{} {}", "t.json:1:4: unexpected '{', expected nothing more" },
        { "[1 /* \n */ , \xc3\xa9]", "t.json:2:7: unexpected '\xc3\xa9', expected a value" },
        { "[\xff]", "t.json:1:2: not UTF-8" },
        { "[\"\xc0\x80\"]", "t.json:1:3: not UTF-8" },
        { "[\"\xed\xa0\x80\"]", "t.json:1:3: not UTF-8" },
        { "// \xe2\x82\n[]", "t.json:1:4: not UTF-8" },
        { "[1] /* never ends", "t.json:1:5: comment without end" },
        { "[1] /*/", "t.json:1:5: comment without end" },
        { "[1] / 2", "t.json:1:5: unexpected '/', expected nothing more" },
        { "[\"abc", "t.json:1:2: string without end" },
        { "[\"abc\\\"]", "t.json:1:2: string without end" },
        { "[\"a\nb\"]", "t.json:1:4: control character in a string" },
        { "[\x01]", "t.json:1:2: unexpected character 1, expected a value or ']'" },
        { "[\"\\x\"]", "t.json:1:3: unknown escape in a string" },
        { "[\"\\u12g4\"]", "t.json:1:3: \\u without four hexadecimal digits" },
        { "[\"\\u0000\"]", "t.json:1:3: \\u0000 in a string" },
        { "[\"\\ud800\"]", "t.json:1:3: half of a surrogate pair" },
        { "[\"\\udc00\"]", "t.json:1:3: half of a surrogate pair" },
        { "[\"\\ud800\\u0041\"]", "t.json:1:3: half of a surrogate pair" },
        { "[01]", "t.json:1:2: not a number as JSON writes them" },
        { "[-]", "t.json:1:2: not a number as JSON writes them" },
        { "[1.]", "t.json:1:2: not a number as JSON writes them" },
        { "[1e+]", "t.json:1:2: not a number as JSON writes them" },
        { "[.5]", "t.json:1:2: unexpected '.', expected a value or ']'" },
        { "[+1]", "t.json:1:2: unexpected '+', expected a value or ']'" },
        { "[NaN]", "t.json:1:2: unexpected 'N', expected a value or ']'" },
        { "[1e999]", "t.json: [0]: number too large" },
        { "{\"a\": {\"b\": [-1e999]}}", "t.json: a.b[0]: number too large" },
        { "{\"a\": 1, \"b\": {\"c\": 1, \"d\": 2, \"c\": 3}}", "t.json: b.c: given twice" },
        { "{\"a\": 1, \"\\u0061\": 1}", "t.json: a: given twice" },
        { "[1000000000000000000000000000000000000000000000000000000000000000]",
          "t.json:1:2: number of more than 63 characters" },
    };
    for (size_t i = 0; i < DAR_COUNT(bad); i++) refused(bad[i].text, strlen(bad[i].text), bad[i].message);
    refused("[1]\0", 4, "t.json:1:4: unexpected character 0, expected nothing more");

    static const char *const fine[] = { "1",        "\"x\"",
                                        "null",     "[]",
                                        " [ ] \n",  "\xef\xbb\xbf{}",
                                        "{}//",     "/**/[/***/1/* // */,// x\r\n2]//",
                                        "[-0]",     "[0.5e-3, 1E5, -12]",
                                        "[\"//\"]", "[\"\\ud83d\\ude00 \\\"/*\\\\\"]" };
    for (size_t i = 0; i < DAR_COUNT(fine); i++) dar_json_close(good(fine[i]));
}

static void depth(void **state)
{
    (void)state;
    char text[2 * (DAR_JSON_DEPTH + 1)];
    memset(text, '[', sizeof text / 2);
    memset(text + sizeof text / 2, ']', sizeof text / 2);
    refused(text, sizeof text, "t.json:1:65: more than 64 levels");
    dar_json_doc *doc;
    assert_int_equal(dar_json_parse(&doc, "t.json", text + 1, sizeof text - 2, NULL), DAR_OK);
    dar_json_close(doc);

    size_t many = 1 << 20;
    char *bomb = malloc(many);
    memset(bomb, '[', many);
    refused(bomb, many, "t.json:1:65: more than 64 levels");
    free(bomb);
}

/* 100,000 equal keys must not cost 10^10 comparisons: this test would then run for minutes. */
static void many_keys(void **state)
{
    (void)state;
    size_t n = 100000, at = 0;
    size_t room = n * 16;
    char *text = malloc(room);
    text[at++] = '{';
    for (size_t i = 0; i < n; i++) at += (size_t)snprintf(text + at, room - at, "\"k%zu\":%zu,", i, i);
    at += (size_t)snprintf(text + at, room - at, "\"k7\":0}");
    refused(text, at, "t.json: k7: given twice");
    free(text);
}

static const char *const solvers[] = { "euler", "ab2", "unipc", NULL };

static void merging(void **state)
{
    (void)state;
    dar_json_doc *to = good("{\"a\": {\"b\": 1, \"c\": [1, 2]}, \"d\": {\"x\": 0}, \"e\": null}");
    dar_json_doc *from = good("{\"a\": {\"c\": [3], \"n\": {\"m\": true}}, \"d\": 5, \"e\": {\"y\": 1}}");
    dar_err e;
    dar_json_int(dar_json_object(dar_json_root(from), "e"), "y", 0, 0, 9);
    dar_json_merge(dar_json_root(to), dar_json_root(from));
    dar_json_close(from);
    dar_json_writer w = { 0 };
    dar_json_write_value(&w, NULL, dar_json_root(to));
    same_text(w.text, "{\"a\": {\"b\": 1, \"c\": [3], \"n\": {\"m\": true}}, \"d\": 5, \"e\": {\"y\": 1}}");
    dar_json_writer_free(&w);

    dar_json a = dar_json_object(dar_json_root(to), "a"), y = dar_json_object(dar_json_root(to), "e");
    dar_json_accept(a); /* what nobody reads of the rest is told, read before or not */
    dar_json_int(dar_json_root(to), "d", 0, 0, 9);
    (void)y;
    assert_int_equal(dar_json_finish(to, &e), DAR_ERR_FORMAT);
    CHECK(strstr(e.text, "e.y"), "%s", e.text);
    dar_json_close(to);
}

static void typed_reads(void **state)
{
    (void)state;
    dar_json_doc *doc =
        good("{\"train\": {\"rank\": 32, \"rate\": 1e-4, \"fast\": true, \"name\": \"caf\\u00e9\",\n"
             "  \"solver\": \"ab2\", \"size\": [3, 2, 0.5], \"none\": null, \"list\": [1, {\"x\": 7}]}}");
    dar_json t = dar_json_object(dar_json_root(doc), "train");
    double size[3] = { 0 }, other[2] = { 4, 5 };

    assert_int_equal(dar_json_int(t, "rank", 16, 1, 4096), 32);
    assert_int_equal(dar_json_int(t, "none", 16, 1, 4096), 16);
    assert_int_equal(dar_json_int(t, "absent", -3, -5, 5), -3);
    CHECK_NEAR("rate", dar_json_number(t, "rate", 0, 0, 1), 1e-4, 0);
    CHECK_NEAR("decay", dar_json_number(t, "decay", 0.01, 0, 1), 0.01, 0);
    assert_true(dar_json_bool(t, "fast", false));
    assert_true(dar_json_bool(t, "slow", true));
    assert_string_equal(dar_json_text(t, "name", ""), "caf\xc3\xa9");
    assert_string_equal(dar_json_text(t, "path", "out"), "out");
    assert_int_equal(dar_json_choice(t, "solver", 0, solvers), 1);
    assert_int_equal(dar_json_choice(t, "solver2", 2, solvers), 2);
    dar_json_numbers(t, "size", size, 3);
    CHECK_NEAR("size[2]", size[2], 0.5, 0);
    dar_json_numbers(t, "other", other, 2);
    CHECK_NEAR("other[1]", other[1], 5, 0);
    assert_null(dar_json_get(t, "lora").item);

    dar_json list = dar_json_array(t, "list"), first = dar_json_first(list), second = dar_json_next(first);
    assert_int_equal(dar_json_size(list), 2);
    assert_int_equal(dar_json_int(first, NULL, DAR_JSON_NEEDED, 0, 9), 1);
    assert_int_equal(dar_json_kind_of(second), DAR_JSON_OBJECT);
    assert_int_equal(dar_json_int(second, "x", 0, 0, 9), 7);
    assert_null(dar_json_next(second).item);
    assert_int_equal(dar_json_size(dar_json_array(t, "empty")), 0);

    dar_err e;
    CHECK(dar_json_finish(doc, &e) == DAR_OK, "%s", e.text);

    /* What was read, with its defaults, is the resolved configuration. */
    dar_json_writer w = { 0 };
    dar_json_write_value(&w, NULL, dar_json_root(doc));
    same_text(w.text, "{\"train\": {\"rank\": 32, \"rate\": 0.0001, \"fast\": true, \"name\": \"caf\xc3\xa9\", "
                      "\"solver\": \"ab2\", \"size\": [3, 2, 0.5], \"none\": 16, \"list\": [1, {\"x\": 7}], "
                      "\"absent\": -3, \"decay\": 0.01, \"slow\": true, \"path\": \"out\", \"solver2\": \"unipc\", "
                      "\"other\": [4, 5], \"lora\": null, \"empty\": []}}");
    dar_json_writer_free(&w);
    dar_json_close(doc);
}

static void read_rank(dar_json r)
{
    dar_json_int(dar_json_object(r, "train"), "rank", 16, 1, 4096);
}
static void read_least(dar_json r)
{
    dar_json_int(r, "n", 1, 1, INT64_MAX);
}
static void read_needed(dar_json r)
{
    dar_json_int(r, "n", DAR_JSON_NEEDED, 0, 7);
    dar_json_text(r, "second", NULL); /* only the first failure is told */
}
static void read_number(dar_json r)
{
    dar_json_number(r, "x", NAN, 0, 0.5);
}
static void read_text(dar_json r)
{
    dar_json_text(r, "s", NULL);
}
static void read_bool(dar_json r)
{
    dar_json_bool(r, "b", false);
}
static void read_choice(dar_json r)
{
    dar_json_choice(r, "solver", -1, solvers);
}
static void read_three(dar_json r)
{
    double x[3] = { NAN };
    dar_json_numbers(r, "v", x, 3);
}
static void read_items(dar_json r)
{
    for (dar_json x = dar_json_first(dar_json_array(r, "a")); x.item; x = dar_json_next(x))
        dar_json_int(x, "n", 0, 0, 9);
}
static void read_even(dar_json r)
{
    if (dar_json_int(r, "n", 0, 0, 9) % 2) dar_json_reject(r, "n", "a multiple of %d", 2);
}
static void read_three_keys(dar_json r)
{
    dar_json t = dar_json_object(r, "train");
    dar_json_int(t, "rank", 1, 0, 9);
    dar_json_int(t, "steps", 1, 0, 9);
    dar_json_get(t, "seed");
    dar_json_accept(dar_json_get(r, "extra"));
}

static void messages(void **state)
{
    (void)state;
    static const struct {
        const char *text;
        void (*read)(dar_json root);
        const char *message;
    } bad[] = {
        { "{\"train\": {\"rank\": \"abc\"}}", read_rank,
          "t.json: train.rank: found \"abc\", expected an integer from 1 to 4096" },
        { "{\"train\": {\"rank\": 1.5}}", read_rank,
          "t.json: train.rank: found 1.5, expected an integer from 1 to 4096" },
        { "{\"train\": {\"rank\": 0}}", read_rank, "t.json: train.rank: found 0, expected an integer from 1 to 4096" },
        { "{\"train\": [1]}", read_rank, "t.json: train: found an array, expected an object" },
        { "[]", read_rank, "t.json: found an array, expected an object" },
        { "{\"n\": 9007199254740993}", read_least,
          "t.json: n: found 9007199254740992, expected an integer, at least 1 and below 2^53" },
        { "{}", read_needed, "t.json: n: missing, expected an integer from 0 to 7" },
        { "{\"n\": null}", read_needed, "t.json: n: found null, expected an integer from 0 to 7" },
        { "{\"x\": 0.75}", read_number, "t.json: x: found 0.75, expected a number from 0 to 0.5" },
        { "{}", read_number, "t.json: x: missing, expected a number from 0 to 0.5" },
        { "{\"s\": {}}", read_text, "t.json: s: found an object, expected a string" },
        { "{\"b\": \"true\"}", read_bool, "t.json: b: found \"true\", expected true or false" },
        { "{\"solver\": \"eular\"}", read_choice,
          "t.json: solver: found \"eular\", expected one of euler, ab2, unipc" },
        { "{\"v\": [1, 2]}", read_three, "t.json: v: found an array, expected an array of 3 numbers" },
        { "{\"v\": [1, 2, true]}", read_three, "t.json: v[2]: found true, expected a number" },
        { "{\"a\": [{\"n\": 3}, {\"n\": 30}]}", read_items,
          "t.json: a[1].n: found 30, expected an integer from 0 to 9" },
        { "{\"a\": [1]}", read_items, "t.json: a[0]: found 1, expected an object" },
        { "{\"n\": 3}", read_even, "t.json: n: found 3, expected a multiple of 2" },
        { "{\"train\": {\"rnak\": 3}}", read_three_keys, "t.json: train.rnak: unknown key; did you mean 'rank'?" },
        { "{\"train\": {\"stepz\": 3}}", read_three_keys, "t.json: train.stepz: unknown key; did you mean 'steps'?" },
        { "{\"train\": {\"sed\": 3}}", read_three_keys, "t.json: train.sed: unknown key; did you mean 'seed'?" },
        { "{\"zzzzzz\": 3, \"extra\": {\"any\": [{\"thing\": 1}]}}", read_three_keys, "t.json: zzzzzz: unknown key" },
        { "{\"s\": \"line\\nline \\u001b[31m and so on for longer than forty bytes\", \"n\": 0}", read_rank,
          "t.json: s: unknown key" },
        { "{\"b\": \"line\\nline and so on for more th\xc3\xa4n \xc3\xa4\xc3\xa4\xc3\xa4\xc3\xa4\xc3\xa4\xc3\xa4 forty "
          "bytes\"}",
          read_bool,
          "t.json: b: found \"line?line and so on for more th\xc3\xa4n \xc3\xa4\xc3\xa4...\", expected true or "
          "false" },
    };
    for (size_t i = 0; i < DAR_COUNT(bad); i++) {
        dar_json_doc *doc = good(bad[i].text);
        dar_err e = { "" };
        bad[i].read(dar_json_root(doc));
        dar_status s = dar_json_finish(doc, &e);
        CHECK(s == DAR_ERR_FORMAT, "%s: accepted", bad[i].text);
        same_text(e.text, bad[i].message);
        dar_json_close(doc);
    }
}

static void overrides(void **state)
{
    (void)state;
    static const char *const set[] = { "train.rank=8", "train.name=x y=z", "new.deep.key=[1, {\"a\": null}]",
                                       "list.1=true",  "train.empty=",     "train.text=\"8\"",
                                       "n.x=1e999",    "train.rank=9" };
    dar_json_doc *doc = good("{\"train\": {\"rank\": 4}, \"list\": [0, 1], \"n\": null}");
    dar_err e;
    for (size_t i = 0; i < DAR_COUNT(set); i++)
        CHECK(dar_json_set(doc, set[i], &e) == DAR_OK, "%s: %s", set[i], e.text);
    dar_json_writer w = { 0 };
    dar_json_write_value(&w, NULL, dar_json_root(doc));
    same_text(w.text,
              "{\"train\": {\"rank\": 9, \"name\": \"x y=z\", \"empty\": \"\", \"text\": \"8\"}, "
              "\"list\": [0, true], \"n\": {\"x\": \"1e999\"}, \"new\": {\"deep\": {\"key\": [1, {\"a\": null}]}}}");
    dar_json_writer_free(&w);

    static const struct {
        const char *set, *message;
    } bad[] = {
        { "rank", "--set rank: expected key.path=value" },
        { "=3", "--set =3: expected key.path=value" },
        { "train.rank.x=3", "--set train.rank.x=3: there is no place for 'x'" },
        { "train.rank.x.y=3", "--set train.rank.x.y=3: there is no 'x' to go into" },
        { "list.2=3", "--set list.2=3: there is no place for '2'" },
        { "a..b=3", "--set a..b=3: there is no '' to go into" },
        { "a.=3", "--set a.=3: there is no place for ''" },
        { "a=\xff", "--set a=\xff: not UTF-8" },
    };
    for (size_t i = 0; i < DAR_COUNT(bad); i++) {
        CHECK(dar_json_set(doc, bad[i].set, &e) == DAR_ERR_USAGE, "%s: accepted", bad[i].set);
        same_text(e.text, bad[i].message);
    }
    char deep[512];
    for (size_t i = 0; i < 2 * DAR_JSON_DEPTH; i++) deep[i] = i % 2 ? '.' : 'a';
    memcpy(deep + 2 * DAR_JSON_DEPTH - 1, "=[]", 4);
    assert_int_equal(dar_json_set(doc, deep, &e), DAR_ERR_USAGE);
    deep[2 * DAR_JSON_DEPTH] = '1';
    deep[2 * DAR_JSON_DEPTH + 1] = 0;
    assert_int_equal(dar_json_set(doc, deep, &e), DAR_OK);
    dar_json_writer deepest = { .pretty = true };
    dar_json_write_value(&deepest, NULL, dar_json_root(doc));
    dar_json_writer_free(&deepest);
    dar_json_close(doc);
}

static void printing(void **state)
{
    (void)state;
    dar_json_writer w = { .pretty = true };
    for (int round = 0; round < 2; round++) { /* the buffer is used again */
        dar_json_writer_reset(&w);
        dar_json_write_object(&w, NULL);
        dar_json_write_int(&w, "big", INT64_MIN);
        dar_json_write_text(&w, "s", "a\"b\\c\n\x01 \xc3\xa9 \xff.");
        dar_json_write_number(&w, "nan", NAN);
        dar_json_write_array(&w, "v");
        dar_json_write_number(&w, NULL, 0.1);
        dar_json_write_bool(&w, NULL, true);
        dar_json_write_end(&w);
        dar_json_write_array(&w, "o");
        dar_json_write_object(&w, NULL);
        dar_json_write_null(&w, "x");
        dar_json_write_end(&w);
        dar_json_write_object(&w, NULL);
        dar_json_write_end(&w);
        dar_json_write_end(&w);
        dar_json_write_end(&w);
        same_text(w.text, "{\n    \"big\": -9223372036854775808,\n"
                          "    \"s\": \"a\\\"b\\\\c\\n\\u0001 \xc3\xa9 \xef\xbf\xbd.\",\n    \"nan\": null,\n"
                          "    \"v\": [0.1, true],\n    \"o\": [\n        {\n            \"x\": null\n        },\n"
                          "        {}\n    ]\n}");
    }
    assert_int_equal(w.depth, 0);
    CHECK_ABORTS(dar_json_write_end(&w));
    dar_json_writer_free(&w);
}

static void numbers_round_trip(void **state)
{
    (void)state;
    static const double x[] = { 0.1,
                                1.0 / 3,
                                5e-324,
                                2.2250738585072014e-308,
                                1.7976931348623157e308,
                                1e15,
                                1e15 - 1,
                                1e23,
                                -0.0,
                                123456789012345680,
                                0x1p-20,
                                0x1p53,
                                4.35,
                                0.1f,
                                M_PI,
                                -1,
                                999999.75,
                                6.02214076e23,
                                1e22,
                                9007199254740993e3 };
    char buf[32];
    for (size_t i = 0; i < DAR_COUNT(x); i++) {
        double y = strtod(dar_json_number_text(x[i], buf), NULL);
        CHECK(memcmp(&x[i], &y, sizeof y) == 0, "%a printed as %s, read as %a", x[i], buf, y);
    }
    uint64_t bits = 1;
    for (int i = 0; i < 20000; i++) {
        double v, y;
        bits = bits * 6364136223846793005u + 1442695040888963407u;
        memcpy(&v, &bits, sizeof v);
        if (!isfinite(v)) continue;
        y = strtod(dar_json_number_text(v, buf), NULL);
        CHECK(memcmp(&v, &y, sizeof y) == 0, "%a printed as %s, read as %a", v, buf, y);
    }
    same_text(dar_json_number_text(0.1, buf), "0.1");
    same_text(dar_json_number_text(100000, buf), "100000");
    same_text(dar_json_number_text(-0.0, buf), "-0");
}

static void files(void **state)
{
    (void)state;
    dar_json_doc *doc;
    dar_err e;
    assert_int_equal(dar_json_open(&doc, "build/no-such.json", &e), DAR_ERR_IO);
    same_text(e.text, "build/no-such.json: No such file or directory");
    assert_int_equal(dar_json_open(&doc, "lib", &e), DAR_ERR_IO);
    same_text(e.text, "lib: not a regular file");
    assert_int_equal(dar_json_open(&doc, "/dev/null", &e), DAR_ERR_IO);
}

static void distances(void **state)
{
    (void)state;
    assert_int_equal(dar_nearest_distance("", "abc"), 3);
    assert_int_equal(dar_nearest_distance("kitten", "sitting"), 3);
    assert_int_equal(dar_nearest_distance("rnak", "rank"), 1);
    assert_int_equal(dar_nearest_distance("same", "same"), 0);
    dar_nearest n = dar_nearest_to("ab");
    dar_nearest_try(&n, "xyz");
    assert_null(n.best);
}

int main(void)
{
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(grammar),     cmocka_unit_test(depth),
        cmocka_unit_test(many_keys),   cmocka_unit_test(messages),
        cmocka_unit_test(overrides),   cmocka_unit_test(merging),
        cmocka_unit_test(typed_reads), cmocka_unit_test(printing),
        cmocka_unit_test(files),       cmocka_unit_test(numbers_round_trip),
        cmocka_unit_test(distances),
    };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
