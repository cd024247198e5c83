/* export.h: a checkpoint as a model that stands by itself: a directory that dar-sample and dar-train open, wherever it
 * is moved.
 *
 *   of a network that was trained whole             of low-rank additions
 *     OUT/model.json                                  OUT/model.json, adapter.safetensors, lora.safetensors
 *     OUT/dit.safetensors, vae.safetensors            OUT/backbone/model.json, dit.safetensors, vae.safetensors
 *
 * backbone: what the additions were trained on, without them: the network that sees rays alone.  Matrices are stored as
 * `storage`, the rest in its arithmetic type, as they are used (models/params.h), so the directory gives the numbers
 * that its checkpoint gives at that precision, but for the additions: they are rounded too before they are merged. */
#ifndef DAR_TRAIN_EXPORT_H
#define DAR_TRAIN_EXPORT_H

#include <stddef.h>

#include "lib/dtype.h"
#include "lib/status.h"

/* Fails if `out` is there and is no model; a model is replaced, with all that lies beside it, in one moment; only its
 * directory results, where scripts put what was measured, stays.  *bytes, which may be NULL: of the weights that were
 * written. */
dar_status dar_export(const char *checkpoint, const char *out, dar_dtype storage, size_t *bytes, dar_err *e);

/* Write OUT/dit.safetensors, under the public names, with additions and adapter put into the weights, and
 * OUT/model.json; the autoencoder stays where it is.  What is at `out` is replaced in one moment. */
dar_status dar_export_merged(const char *checkpoint, const char *out, dar_dtype storage, dar_err *e);

#endif
