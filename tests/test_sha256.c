/* test_sha256.c: the vectors of FIPS 180-4's examples, and every length around a block. */
#include "tests/test.h"

#include "lib/sha256.h"

static void expect(const char *what, dar_sha256 *h, const char *expected)
{
    char text[DAR_SHA256_TEXT];
    dar_sha256_finish(h, text);
    CHECK(strcmp(text, expected) == 0, "%s: found %s, expected %s", what, text, expected);
}

static void vectors(void **state)
{
    (void)state;
    static const struct {
        const char *text, *expected;
    } row[] = {
        { "", "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855" },
        { "abc", "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad" },
        { "abcdbcdecdefdefgefghfghighijhijkijkljklmklmnlmnomnopnopq",
          "248d6a61d20638b8e5c026930c3e6039a33ce45964ff2167f6ecedd419db06c1" },
    };
    dar_sha256 h;
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        dar_sha256_init(&h);
        dar_sha256_add(&h, row[i].text, strlen(row[i].text));
        expect(row[i].text, &h, row[i].expected);
    }
    dar_sha256_init(&h);
    for (int i = 0; i < 1000000 / 8; i++) dar_sha256_add(&h, "aaaaaaaa", 8);
    expect("a million a", &h, "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0");
}

/* Every length from 0 to 200 in one piece and byte by byte; expected: sha256 of the 201 digests, one after the other,
 * as text. */
static void lengths(void **state)
{
    (void)state;
    unsigned char x[200];
    char text[DAR_SHA256_TEXT], again[DAR_SHA256_TEXT];
    dar_sha256 h, all;
    for (size_t i = 0; i < sizeof x; i++) x[i] = (unsigned char)(7 * i + 1);
    dar_sha256_init(&all);
    for (size_t n = 0; n <= sizeof x; n++) {
        dar_sha256_init(&h);
        dar_sha256_add(&h, x, n);
        dar_sha256_finish(&h, text);
        dar_sha256_init(&h);
        for (size_t i = 0; i < n; i++) dar_sha256_add(&h, x + i, 1);
        dar_sha256_finish(&h, again);
        CHECK(strcmp(text, again) == 0, "%zu bytes: %s in one piece, %s byte by byte", n, text, again);
        dar_sha256_add(&all, text, strlen(text));
    }
    expect("all lengths", &all, "2e4a3cd5a1498d68dbe42f5114a172594576fa45febce02f5d6ad8863181bef0");
}

int main(void)
{
    const struct CMUnitTest tests[] = { cmocka_unit_test(vectors), cmocka_unit_test(lengths) };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
