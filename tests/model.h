/* model.h: a whole network for tests: a preset, its parameters, arenas and a tape. */
#ifndef DAR_TESTS_MODEL_H
#define DAR_TESTS_MODEL_H

#include "lib/weights.h"
#include "models/config.h"
#include "models/dit.h"
#include "models/lora.h"
#include "models/params.h"

extern const double model_times[4]; /* [2, 2] of the fixtures: first frame, the rest */

typedef struct model {
    dar_config c;
    dar_arena weights, step, keep;
    dar_params p;
    dar_dit m;
    dar_tape tape; /* over step and keep */

    /* Filled by model_clip. */
    dar_dit_clip clip;
    dar_tensor z, text, target;
    int64_t count[2];
} model;

/* Read a preset of models/presets. */
dar_config model_preset(const char *name);

/* A network without values; LoRA is not declared.  plan: all arenas only count. */
void model_init(model *o, const dar_config *c, dar_dtype storage, bool plan);
void model_free(model *o);

/* Everything random: two clips of these latent frames and tokens; one of a large model. */
void model_clip(model *o, int64_t frames, int64_t rows, int64_t columns, int64_t text);

/* Values of parameters and inputs as the files of scripts/make-dit-fixtures.py have them. */
void model_fixture(model *o, dar_weights *weights);

/* Scene, text, velocity of the clip on the model's tape, which is cleared first; the times are those of the fixtures.
 */
dar_val *model_velocity(model *o);

/* Mean squared distance of that from the target. */
dar_val *model_loss(model *o);

#endif
