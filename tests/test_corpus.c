/* test_corpus.c: the fuzzers' committed corpora, replayed without a fuzzer. */
#include "tests/test.h"

#include <dirent.h>

#include "lib/file.h"

/* LLVMFuzzerTestOneInput of tests/fuzz_json.c and so on, renamed by the Makefile. */
int fuzz_bundle(const uint8_t *data, size_t size);
int fuzz_camera(const uint8_t *data, size_t size);
int fuzz_exr(const uint8_t *data, size_t size);
int fuzz_gltf(const uint8_t *data, size_t size);
int fuzz_image(const uint8_t *data, size_t size);
int fuzz_json(const uint8_t *data, size_t size);
int fuzz_lora(const uint8_t *data, size_t size);
int fuzz_obj(const uint8_t *data, size_t size);
int fuzz_safetensors(const uint8_t *data, size_t size);
int fuzz_torch_file(const uint8_t *data, size_t size);

static void replay(const char *dir, int (*target)(const uint8_t *, size_t))
{
    char path[512];
    int files = 0;
    DIR *d = opendir(dir);
    assert_non_null(d);
    for (const struct dirent *x; (x = readdir(d));) {
        dar_file_map m;
        dar_err e;
        if (x->d_name[0] == '.') continue;
        snprintf(path, sizeof path, "%s/%s", dir, x->d_name);
        CHECK(dar_file_map_open(&m, path, &e) == DAR_OK, "%s", e.text);
        uint8_t *exact = malloc(m.size + !m.size); /* so that a byte read past it is seen */
        if (m.size) memcpy(exact, m.data, m.size);
        target(exact, m.size);
        free(exact);
        dar_file_map_close(&m);
        files++;
    }
    closedir(d);
    CHECK(files >= 10, "%s: %d files", dir, files);
}

static void bundle(void **state)
{
    (void)state;
    replay("tests/corpus/bundle", fuzz_bundle);
}

static void camera(void **state)
{
    (void)state;
    replay("tests/corpus/camera", fuzz_camera);
}

static void exr(void **state)
{
    (void)state;
    replay("tests/corpus/exr", fuzz_exr);
}

static void gltf(void **state)
{
    (void)state;
    replay("tests/corpus/gltf", fuzz_gltf);
}

static void image(void **state)
{
    (void)state;
    replay("tests/corpus/image", fuzz_image);
}

static void json(void **state)
{
    (void)state;
    replay("tests/corpus/json", fuzz_json);
}

static void lora(void **state)
{
    (void)state;
    replay("tests/corpus/lora", fuzz_lora);
}

static void obj(void **state)
{
    (void)state;
    replay("tests/corpus/obj", fuzz_obj);
}

static void safetensors(void **state)
{
    (void)state;
    replay("tests/corpus/safetensors", fuzz_safetensors);
}

static void torch_file(void **state)
{
    (void)state;
    replay("tests/corpus/torch_file", fuzz_torch_file);
}

int main(void)
{
    const struct CMUnitTest tests[] = { cmocka_unit_test(bundle),      cmocka_unit_test(camera),
                                        cmocka_unit_test(exr),         cmocka_unit_test(gltf),
                                        cmocka_unit_test(image),       cmocka_unit_test(json),
                                        cmocka_unit_test(lora),        cmocka_unit_test(obj),
                                        cmocka_unit_test(safetensors), cmocka_unit_test(torch_file) };
    return cmocka_run_group_tests(tests, NULL, NULL) != 0;
}
