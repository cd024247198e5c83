/* test_exr.c: OpenEXR files: planes come back, names are found, what cannot be read is refused in one line. */
#include "tests/scratch.h"

#include "data/exr.h"

#define W 37
#define H 19

static char path[512];
static float f32[2][H * W];
static uint16_t f16[H * W];
static uint32_t u32[H * W];

/* Blender's names, in an order that is not the file's. */
static const dar_exr_plane planes[] = {
    { "ViewLayer.Depth.Z", DAR_EXR_F32, f32[0] },
    { "ViewLayer.Combined.R", DAR_EXR_F16, f16 },
    { "ViewLayer.CryptoObject00.r", DAR_EXR_F32, f32[1] },
    { "ViewLayer.IndexOB.X", DAR_EXR_U32, u32 },
    { "A", DAR_EXR_F16, f16 },
};

static void fill(void)
{
    for (int i = 0; i < H * W; i++) {
        f32[0][i] = i % 5 ? 0.3f + (float)i / 7 : 1e10f; /* Blender's background */
        f32[1][i] = (float)(i % 11) / 3 - 1;
        f16[i] = (uint16_t)(0x3000 + i % 0x0c00);
        u32[i] = (uint32_t)i * 2654435761u;
    }
}

static void round_trip(void **state)
{
    (void)state;
    static float back[H * W];
    dar_err e;
    dar_exr *x;
    fill();
    for (int c = DAR_EXR_NONE; c <= DAR_EXR_PXR24; c++) {
        ok(dar_exr_write(path, W, H, planes, DAR_COUNT(planes),
                         &(dar_exr_how){ (dar_exr_compression)c, "how it was made" }, &e),
           &e);
        ok(dar_exr_open(&x, path, &e), &e);
        CHECK(dar_exr_width(x) == W && dar_exr_height(x) == H, "size %zux%zu", dar_exr_width(x), dar_exr_height(x));
        CHECK(dar_exr_channels(x) == DAR_COUNT(planes), "%zu channels", dar_exr_channels(x));
        for (size_t i = 0; i < DAR_COUNT(planes); i++) {
            size_t k = 0;
            while (k < DAR_COUNT(planes) && strcmp(dar_exr_name(x, k), planes[i].name) != 0) k++;
            CHECK(k < DAR_COUNT(planes), "%s is not there", planes[i].name);
            CHECK(dar_exr_type_of(x, k) == planes[i].type, "%s: another type", planes[i].name);
            ok(dar_exr_read(x, k, back, &e), &e);
            if (c == DAR_EXR_PXR24 && planes[i].type == DAR_EXR_F32) {
                /* 8 of 23 bits of the mantissa go, by rounding: half of 2^-15. */
                const float *want = planes[i].data;
                for (int p = 0; p < H * W; p++) CHECK_NEAR(planes[i].name, back[p], want[p], fabs(want[p]) * 0x1p-16);
            } else {
                size_t bytes = (size_t)H * W * (planes[i].type == DAR_EXR_F16 ? 2 : 4);
                CHECK(memcmp(back, planes[i].data, bytes) == 0, "%s, compression %d: changed", planes[i].name, c);
            }
        }
        dar_exr_close(x);
    }
}

static void names(void **state)
{
    (void)state;
    static const struct {
        const char *pass, *component, *name;
    } row[] = {
        { "Depth", "Z", "ViewLayer.Depth.Z" },
        { "depth", "z", "ViewLayer.Depth.Z" },
        { "indexob", "X", "ViewLayer.IndexOB.X" },
        { "CryptoObject00", "R", "ViewLayer.CryptoObject00.r" },
        { "", "a", "A" },
        { "", "R", NULL },
        { "epth", "Z", NULL },
        { "ViewLayer", "Z", NULL },
        { "ViewLayer.Depth", "Z", NULL },
        { "Depth", "Y", NULL },
    };
    dar_err e;
    dar_exr *x;
    fill();
    ok(dar_exr_write(path, W, H, planes, DAR_COUNT(planes), &(dar_exr_how){ DAR_EXR_ZIP, NULL }, &e), &e);
    ok(dar_exr_open(&x, path, &e), &e);
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        int k = dar_exr_find(x, row[i].pass, row[i].component);
        const char *found = k < 0 ? "nothing" : dar_exr_name(x, (size_t)k),
                   *name = row[i].name ? row[i].name : "nothing";
        CHECK(strcmp(found, name) == 0, "%s %s: found %s, expected %s", row[i].pass, row[i].component, found, name);
    }
    dar_exr_close(x);
}

/* ---------------------------------------------------------------- files of others, from tests/corpus/exr */

static void windows(void **state)
{
    (void)state;
    /* Display 5x4, data 3x2 at (1, 1); float channel Z counts from 1. */
    static const float want[4][5] = { { 0 }, { 0, 1, 2, 3 }, { 0, 4, 5, 6 }, { 0 } };
    float back[4][5];
    dar_err e;
    dar_exr *x;
    ok(dar_exr_open(&x, "tests/corpus/exr/window", &e), &e);
    ok(dar_exr_read(x, 0, back, &e), &e);
    CHECK(memcmp(back, want, sizeof want) == 0, "a data window inside the display window lies elsewhere");
    dar_exr_close(x);
}

static void parts(void **state)
{
    (void)state;
    float back[2][3];
    dar_err e;
    dar_exr *x;
    ok(dar_exr_open(&x, "tests/corpus/exr/parts", &e), &e);
    int z = dar_exr_find(x, "Depth", "Z"), n = dar_exr_find(x, "Normal", "X");
    CHECK(z >= 0 && n >= 0 && dar_exr_channels(x) == 2, "channels %d, %d of %zu", z, n, dar_exr_channels(x));
    ok(dar_exr_read(x, (size_t)n, back, &e), &e);
    for (int i = 0; i < 6; i++) CHECK_NEAR("second part", back[i / 3][i % 3], 101 + i, 0);
    ok(dar_exr_read(x, (size_t)z, back, &e), &e);
    for (int i = 0; i < 6; i++) CHECK_NEAR("first part", back[i / 3][i % 3], 1 + i, 0);
    dar_exr_close(x);
}

static void refusals(void **state)
{
    (void)state;
    static const struct {
        const char *file, *says;
    } row[] = {
        { "dwaa", "DWAA" },          { "dwab", "DWAB" },          { "tiled", "tiled" },
        { "huge", "exr/huge: " },    { "outside", "not inside" }, { "subsampled", "fewer samples" },
        { "cut_header", "OpenEXR" }, { "empty", "OpenEXR" },
    };
    char name[64];
    dar_err e;
    dar_exr *x;
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        snprintf(name, sizeof name, "tests/corpus/exr/%s", row[i].file);
        CHECK(dar_exr_open(&x, name, &e) != DAR_OK, "%s: accepted", name);
        CHECK(!x && strncmp(e.text, name, strlen(name)) == 0, "no name of the file: %s", e.text);
        CHECK(strstr(e.text, row[i].says), "%s; expected: %s", e.text, row[i].says);
    }
}

/* Cut anywhere: refused when opened or when read. */
static void cut(void **state)
{
    (void)state;
    static float back[H * W];
    dar_file_map m;
    dar_err e;
    dar_exr *x;
    fill();
    ok(dar_exr_write(path, W, H, planes, 1, &(dar_exr_how){ DAR_EXR_ZIP, NULL }, &e), &e);
    ok(dar_file_map_open(&m, path, &e), &e);
    for (size_t n = 0; n < m.size; n += 13) {
        unsigned char *part = malloc(n + 1); /* exact, so that a byte read past it is seen */
        assert_non_null(part);
        memcpy(part, m.data, n);
        dar_status s = dar_exr_parse(&x, "cut", part, n, &e);
        if (s == DAR_OK) s = dar_exr_read(x, 0, back, &e);
        CHECK(s == DAR_ERR_FORMAT && strncmp(e.text, "cut: ", 5) == 0, "%zu of %zu bytes: %s", n, m.size, e.text);
        dar_exr_close(x);
        free(part);
    }
    dar_file_map_close(&m);
}

static int set_up(void **state)
{
    if (scratch_make(state)) return -1;
    snprintf(path, sizeof path, "%s", in_dir("a.exr"));
    return 0;
}

int main(void)
{
    const struct CMUnitTest tests[] = { cmocka_unit_test(round_trip), cmocka_unit_test(names),
                                        cmocka_unit_test(windows),    cmocka_unit_test(parts),
                                        cmocka_unit_test(refusals),   cmocka_unit_test(cut) };
    return cmocka_run_group_tests(tests, set_up, scratch_remove) != 0;
}
