/* test_video.c: frames through ffmpeg and back; children that are missing, refuse or are killed. */
#include "tests/scratch.h"

#include "data/video.h"

#define W      34
#define H      18
#define FRAMES 7

static char path[64], script[64];
static uint8_t rgb[FRAMES][H * W * 3], back[H * W * 3];

/* Smooth colours, saturated ones among them; each frame different. */
static void fill(void)
{
    for (int t = 0; t < FRAMES; t++)
        for (int y = 0; y < H; y++)
            for (int x = 0; x < W; x++) {
                uint8_t *p = rgb[t] + 3 * (y * W + x);
                p[0] = (uint8_t)(255 * x / (W - 1));
                p[1] = (uint8_t)(255 * y / (H - 1));
                p[2] = (uint8_t)(30 * t);
            }
}

static void put(dar_video_codec codec, int frames)
{
    dar_video *v;
    dar_err e;
    ok(dar_video_create(&v, path, W, H, &(dar_video_how){ .fps = 12.5, .codec = codec, .comment = "how it was made" },
                        &e),
       &e);
    for (int t = 0; t < frames; t++) ok(dar_video_write(v, rgb[t], &e), &e);
    ok(dar_video_commit(v, &e), &e);
    dar_video_close(v);
}

static void exact(void **state)
{
    (void)state;
    static const dar_video_codec codec[] = { DAR_VIDEO_FFV1, DAR_VIDEO_X264RGB };
    dar_video_info info;
    dar_video *v;
    dar_err e;
    fill();
    for (size_t i = 0; i < DAR_COUNT(codec); i++) {
        put(codec[i], FRAMES);
        ok(dar_video_open(&v, &info, path, &e), &e);
        CHECK(info.width == W && info.height == H && info.frames == FRAMES, "%zux%zu, %zu frames", info.width,
              info.height, info.frames);
        CHECK_NEAR("frames per second", info.fps, 12.5, 1e-3);
        for (int t = 0; t < FRAMES; t++) {
            ok(dar_video_read(v, back, &e), &e);
            CHECK(memcmp(back, rgb[t], sizeof back) == 0, "codec %zu, frame %d: changed", i, t);
        }
        CHECK(dar_video_read(v, back, &e) != DAR_OK && strstr(e.text, "ends after 7 frames"), "%s", e.text);
        dar_video_close(v);
    }
}

/* Blue is the slow channel, constant within a frame: chroma subsampling leaves it.  A wrong matrix (bt601 for bt709)
 * moves it by more than 8 of 255; crf 18 leaves about 2 on such a picture. */
static void lossy(void **state)
{
    (void)state;
    dar_video_info info;
    dar_video *v;
    dar_err e;
    fill();
    put(DAR_VIDEO_H264, FRAMES);
    ok(dar_video_open(&v, &info, path, &e), &e);
    CHECK(info.frames == FRAMES, "%zu frames", info.frames);
    for (int t = 0; t < FRAMES; t++) {
        double sum[3] = { 0 };
        ok(dar_video_read(v, back, &e), &e);
        for (int i = 0; i < H * W * 3; i++) sum[i % 3] += (double)back[i] - rgb[t][i];
        for (int c = 0; c < 3; c++) CHECK_NEAR("mean error of a channel", sum[c] / (H * W), 0, 6);
    }
    dar_video_close(v);
}

static void stop_early(void **state)
{
    (void)state;
    dar_video_info info;
    dar_video *v;
    dar_err e;
    struct stat st;
    fill();
    put(DAR_VIDEO_FFV1, FRAMES);
    ok(dar_video_open(&v, &info, path, &e), &e);
    ok(dar_video_read(v, back, &e), &e);
    dar_video_close(v);
    unlink(path);
    ok(dar_video_create(&v, path, W, H, &(dar_video_how){ .fps = 25, .codec = DAR_VIDEO_FFV1 }, &e), &e);
    ok(dar_video_write(v, rgb[0], &e), &e);
    dar_video_close(v);
    CHECK(stat(path, &st) != 0, "a video that was not committed is there");
}

static void refusals(void **state)
{
    (void)state;
    dar_video_info info;
    dar_video *v;
    dar_err e;
    FILE *f = fopen(path, "wb");
    assert_non_null(f);
    fputs("this is no video", f);
    fclose(f);
    CHECK(dar_video_open(&v, &info, path, &e) != DAR_OK && !v && strstr(e.text, path), "%s", e.text);
    CHECK(strstr(e.text, "ffprobe ended with status"), "%s", e.text);
    unlink(path);
    CHECK(dar_video_probe(&info, path, &e) != DAR_OK && strstr(e.text, "No such file"), "%s", e.text);
    CHECK(dar_video_create(&v, path, 3, 4, &(dar_video_how){ .fps = 25, .codec = DAR_VIDEO_H264 }, &e) ==
                  DAR_ERR_USAGE &&
              !v,
          "odd sides accepted");
}

/* Put a script in the place of ffmpeg; NULL: nothing at all. */
static void pretend(const char *text)
{
    unlink(script);
    if (!text) return;
    FILE *f = fopen(script, "w");
    assert_non_null(f);
    fputs(text, f);
    fclose(f);
    assert_int_equal(chmod(script, 0755), 0);
}

static void children(void **state)
{
    (void)state;
    static const struct {
        const char *script, *says;
    } row[] = {
        { NULL, "expected the Debian package ffmpeg" },
        { "#!/bin/sh\nkill -9 $$\n", "killed by signal 9" },
        { "#!/bin/sh\necho first >&2\necho the disk is on fire >&2\nexit 7\n",
          "ended with status 7: the disk is on fire" },
    };
    char old[4096];
    dar_video *v;
    dar_err e;
    snprintf(old, sizeof old, "%s", getenv("PATH") ? getenv("PATH") : "");
    setenv("PATH", scratch_dir, 1);
    for (size_t i = 0; i < DAR_COUNT(row); i++) {
        pretend(row[i].script);
        dar_status s = dar_video_create(&v, path, W, H, &(dar_video_how){ .fps = 25, .codec = DAR_VIDEO_FFV1 }, &e);
        for (int t = 0; t < 2000 && s == DAR_OK; t++) s = dar_video_write(v, rgb[t % FRAMES], &e);
        CHECK(s != DAR_OK, "frames went on without a reader");
        CHECK(strstr(e.text, row[i].says) && strstr(e.text, path), "found %s, expected %s", e.text, row[i].says);
        dar_video_close(v);
    }
    pretend(NULL);
    setenv("PATH", old, 1);
}

static int set_up(void **state)
{
    if (scratch_make(state)) return -1;
    snprintf(path, sizeof path, "%s/-v:a %%d", scratch_dir); /* no option, no protocol, no pattern */
    snprintf(script, sizeof script, "%s/ffmpeg", scratch_dir);
    return 0;
}

int main(void)
{
    const struct CMUnitTest tests[] = { cmocka_unit_test(exact), cmocka_unit_test(lossy), cmocka_unit_test(stop_early),
                                        cmocka_unit_test(refusals), cmocka_unit_test(children) };
    return cmocka_run_group_tests(tests, set_up, scratch_remove) != 0;
}
