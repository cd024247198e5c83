/* weights.h: tensors by name in a mapped file or in shards, read with distrust: safetensors, and what torch.save wrote.
 *
 * safetensors: 8 bytes little-endian N, N bytes of JSON, data to the end.  Every rule of the format is checked before a
 * tensor is handed out: ranges contiguous from 0 to the end of the file, without hole or overlap; sizes that shape and
 * dtype give exactly; offsets and dimensions plain integers; no key twice.  Beyond the format: N up to 16 MiB, names of
 * 1 to 512 bytes of printable UTF-8.  Source: the format's reference description, huggingface.co/docs/safetensors.
 *
 * torch (.pth, .pt): the zip container of torch 1.6 and later, and the older sequence of pickles.  The pickle is
 * matched against the few forms that a state dict takes; nothing in it is ever called, and any other name or opcode
 * refuses the file.  The tensors are those of the outermost dict or, if it has none, of its member "state_dict",
 * "model_state", "model" or "ema"; other values are passed over.  They must be contiguous, in entries that are stored,
 * not compressed. Checksums of a zip are not verified.
 *
 * Both: up to 65,536 tensors of 1 to 8 dimensions or none, none of them 0.  Values are not looked at.
 *
 * The machine must be little-endian.  Files must not be truncated while mapped (lib/file.h). */
#ifndef DAR_LIB_WEIGHTS_H
#define DAR_LIB_WEIGHTS_H

#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"
#include "lib/tensor.h"

#define DAR_WEIGHTS_HEADER  ((size_t)16 << 20) /* of a header or pickle [bytes] */
#define DAR_WEIGHTS_TENSORS 65536
#define DAR_WEIGHTS_DIMS    8
#define DAR_WEIGHTS_NAME    512

typedef struct dar_weights dar_weights;

/* A tensor as the file has it; lives until the file is closed. */
typedef struct dar_weight {
    const char *name;
    const char *type; /* "F32", "BF16", "I64", ...; may be one that nobody knows */
    const char *file; /* which it lies in */
    int dims;
    int64_t dim[DAR_WEIGHTS_DIMS];
    const void *data; /* read-only, row-major, not aligned to anything */
    size_t bytes;
} dar_weight;

/* Open a file of either format, told by its first bytes; an index (.json) with its shards beside it; or a directory
 * that holds one index or, without index, one .safetensors file.  Of an index, every tensor must be in the shard it
 * names, and none in two.  On failure *out is NULL. */
dar_status dar_weights_open(dar_weights **out, const char *path, dar_err *e);

/* The same for one file in memory, which must outlive *out; `name` stands for it in messages. */
dar_status dar_weights_parse(dar_weights **out, const char *name, const void *data, size_t size, dar_err *e);

void dar_weights_close(dar_weights *s); /* accepts NULL; tensors and entries end with it */

/* Give back the memory of what was read of the files so far; it is read again when it is touched. */
void dar_weights_rest(const dar_weights *s); /* accepts NULL */

/* All tensors, in the order of files and, in each, of offsets (torch: of the dict); i < count. */
size_t dar_weights_count(const dar_weights *s);
const dar_weight *dar_weights_at(const dar_weights *s, size_t i);

/* NULL if there is none of that name. */
const dar_weight *dar_weights_find(const dar_weights *s, const char *name);

/* View a tensor of type F64, F32, BF16 or F16 with at most 6 dimensions; all else is refused by name.  x->data must not
 * be written.  It is aligned to its element: a tensor that lies askew in the file (both formats allow it) is copied at
 * the first call, so such calls belong to one thread. */
dar_status dar_weights_tensor(dar_weights *s, const char *name, dar_tensor *x, dar_err *e);

/* A string of a safetensors file's __metadata__, of the first file that has it; NULL: none has. */
const char *dar_weights_meta(const dar_weights *s, const char *key);

#endif
