/* load.h: weights of a file into a network: by name, shape and type out of the network's own table.
 *
 * Names may be those of the public checkpoint, with model. or model.diffusion_model. before them, or those of
 * diffusers; which, is told by how many of them are there.  A parameter that is frozen and stored as it is declared
 * becomes a view of the mapped file, so loading a bf16 network costs no more than touching it, and the file must stay
 * open.
 *
 * Every tensor that is missing, of another shape or type, or not used is logged with what was found and expected; those
 * not used are no failure.  On failure the network must not be used. */
#ifndef DAR_MODELS_LOAD_H
#define DAR_MODELS_LOAD_H

#include "lib/weights.h"
#include "models/dit.h"

/* Base and adapter, but what has a value already; low-rank additions have files of their own (models/lora.h).
 *
 * A file without adapter is refused if the network has one: rays would mean nothing to it.  Fewer input channels than
 * the network's are widened (dar_adapter_bind); residual blocks beyond the file's are made anew, as identity. */
dar_status dar_load_dit(dar_dit *m, dar_params *p, dar_weights *w, uint64_t seed, dar_err *e);

/* The adapter alone, from a file of its own, before the rest is loaded; widened likewise. */
dar_status dar_load_adapter(dar_dit *m, dar_params *p, dar_weights *w, uint64_t seed, dar_err *e);

/* Into a table that dar_vae_init, or dar_taew_init, filled and nobody else. */
dar_status dar_load_vae(dar_params *p, dar_weights *w, dar_err *e);

/* An embedding [n, text width], n at most text_keys, a 1 before it or not, as x [1, n, text width], a view of the file.
 * The only tensor of a file may have any name.  Zeros at the end, which tools like to fill up with, are no tokens; with
 * none left x->data is NULL.  `path` stands for the file in messages. */
dar_status dar_load_text(const dar_dit_config *c, dar_weights *w, const char *path, const char *name, dar_tensor *x,
                         dar_err *e);

/* The name that a parameter has in diffusers: of the transformer, of the autoencoder. */
void dar_load_diffusers_dit(const char *name, char *out, size_t size);
void dar_load_diffusers_vae(const char *name, char *out, size_t size);

#endif
