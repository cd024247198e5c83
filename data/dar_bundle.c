/* dar_bundle.c: the program dar-bundle: its table of commands. */
#include "data/dar_bundle.h"

int main(int argc, char **argv)
{
    static const dar_program *const commands[] = { &dar_command_render,  &dar_command_check, &dar_command_show,
                                                   &dar_command_convert, &dar_command_synth, NULL };
    static const dar_program program = {
        .name = "dar-bundle",
        .summary = "Clips as the network sees them: cameras, and what every pixel shows, frame by frame.",
        .commands = commands,
    };
    return dar_program_main(&program, argc, argv);
}
