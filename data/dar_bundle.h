/* dar_bundle.h: the commands of dar-bundle, each in a file of its own. */
#ifndef DAR_DATA_DAR_BUNDLE_H
#define DAR_DATA_DAR_BUNDLE_H

#include "lib/program.h"

extern const dar_program dar_command_convert;

#endif
