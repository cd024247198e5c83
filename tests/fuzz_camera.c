/* fuzz_camera.c: any bytes as a camera file of any format.  What is accepted is sound and stays so when it is written
 * in every format; what is refused must say why in one line. */
#include <stdint.h>
#include <string.h>

#include "data/camera_io.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static void check_line(const dar_err *e)
{
    DAR_ASSERT(*e->text, "no message");
    for (const char *p = e->text; *p; p++) DAR_ASSERT((unsigned char)*p >= 0x20, "not one line: %s", e->text);
}

/* Printed and read again: as many frames, sound as well. */
static void print_again(const dar_camera_path *p, const dar_camera_options *o)
{
    dar_camera_path again;
    dar_err e = { "" };
    for (int format = DAR_CAMERA_JSON; format <= DAR_CAMERA_TRANSFORMS; format++) {
        dar_json_writer w = { 0 };
        (format == DAR_CAMERA_JSON ? dar_camera_io_print_json : dar_camera_io_print_transforms)(p, o, &w, &e);
        dar_status s = dar_camera_io_parse(&again, "again", w.text, w.size, (dar_camera_format)format, o, &e);
        DAR_ASSERT(s == DAR_OK, "printed, then refused: %s: %s", e.text, w.text);
        DAR_ASSERT(again.frames == p->frames, "%zu frames, then %zu", p->frames, again.frames);
        dar_camera_free(&again);
        dar_json_writer_free(&w);
    }
    dar_json_writer w = { 0 };
    if (dar_camera_io_print_gltf(p, o, &w, &e) != DAR_OK) check_line(&e);
    dar_json_writer_free(&w);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    for (int format = 0; format <= DAR_CAMERA_ANY; format++) {
        for (int sized = 0; sized < 2; sized++) {
            dar_camera_options o = dar_camera_io_standard();
            dar_camera_path p;
            dar_err e = { "" };
            char fault[128];
            if (sized) o.width = 64, o.height = 48;
            if (dar_camera_io_parse(&p, "fuzz", (const char *)data, size, (dar_camera_format)format, &o, &e) !=
                DAR_OK) {
                check_line(&e);
            } else {
                for (size_t t = 0; t < p.frames; t++)
                    DAR_ASSERT(!dar_camera_fault(&p.view[t], fault), "frame %zu: %s", t, fault);
                if (p.frames <= 256) print_again(&p, &o);
            }
            dar_camera_free(&p);
        }
    }
    return 0;
}
