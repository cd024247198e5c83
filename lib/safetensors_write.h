/* safetensors_write.h: tensors into a safetensors file, or into shards with an index.
 *
 * Nothing under the final names changes before everything is on the disk: files are written beside them, flushed, then
 * renamed, the index last.  A failure, a full disk included, leaves what was there. */
#ifndef DAR_LIB_SAFETENSORS_WRITE_H
#define DAR_LIB_SAFETENSORS_WRITE_H

#include <stddef.h>

#include "lib/status.h"
#include "lib/tensor.h"

/* x is contiguous and has no dimension 0.  Of i8 the bytes alone are written: its scales are an item of their own. */
typedef struct dar_safetensors_item {
    const char *name;
    dar_tensor x;
} dar_safetensors_item;

typedef struct dar_safetensors_options {
    const char *const *meta; /* key, value, key, value, ..., NULL; NULL: none */
    size_t shard_bytes;      /* most data per file (one tensor may exceed it); 0: no limit */
} dar_safetensors_options;

/* Write n tensors to `path`, conventionally *.safetensors.  If they need more than one shard, they go to
 * STEM-00001-of-0000K.safetensors and STEM.safetensors.index.json instead.  The other form, file or index, is removed
 * if it was there, so that the name means one thing; shards of an older index stay.
 *
 * Data begins at a multiple of 64 bytes, larger elements first, so every tensor is aligned to its element.  Same
 * tensors, same bytes.  Aborts if a name is not one the reader takes (weights.h) or comes twice.  `o` may be NULL.
 */
dar_status dar_safetensors_write(const char *path, const dar_safetensors_item *item, size_t n,
                                 const dar_safetensors_options *o, dar_err *e);

#endif
