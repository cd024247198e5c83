/* safetensors.h: weights in a mapped file or in shards, read with distrust.
 *
 * A file is 8 bytes little-endian N, N bytes of JSON, data to the end.  Every rule of the format is checked before a
 * tensor is handed out: ranges contiguous from 0 to the end of the file, without hole or overlap; sizes that shape and
 * dtype give exactly; offsets and dimensions plain integers; no key twice.  Beyond the format: N up to 16 MiB, up to
 * 65,536 tensors of 1 to 8 dimensions or none, none of them 0, names of 1 to 512 bytes of printable UTF-8.  Values are
 * not looked at.  Source: the format's reference description, huggingface.co/docs/safetensors.
 *
 * The machine must be little-endian.  Files must not be truncated while mapped (lib/file.h). */
#ifndef DAR_LIB_SAFETENSORS_H
#define DAR_LIB_SAFETENSORS_H

#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"
#include "lib/tensor.h"

#define DAR_SAFETENSORS_HEADER  ((size_t)16 << 20)
#define DAR_SAFETENSORS_TENSORS 65536
#define DAR_SAFETENSORS_DIMS    8
#define DAR_SAFETENSORS_NAME    512

typedef struct dar_safetensors dar_safetensors;

/* A tensor as the file has it; lives until the file is closed. */
typedef struct dar_safetensors_entry {
    const char *name;
    const char *type; /* "F32", "BF16", "I64", ...; may be one that nobody knows */
    const char *file; /* which it lies in */
    int dims;
    int64_t dim[DAR_SAFETENSORS_DIMS];
    const void *data; /* read-only, row-major, not aligned to anything */
    size_t bytes;
} dar_safetensors_entry;

/* Open a .safetensors file; an index (.json) with its shards beside it; or a directory that holds one index or, without
 * index, one file.  Of an index, every tensor must be in the shard it names, and none in two.  On failure *out is
 * NULL. */
dar_status dar_safetensors_open(dar_safetensors **out, const char *path, dar_err *e);

/* The same for one file in memory, which must outlive *out; `name` stands for it in messages. */
dar_status dar_safetensors_parse(dar_safetensors **out, const char *name, const void *data, size_t size, dar_err *e);

void dar_safetensors_close(dar_safetensors *s); /* accepts NULL; tensors and entries end with it */

/* All tensors, in the order of files and offsets; i < count. */
size_t dar_safetensors_count(const dar_safetensors *s);
const dar_safetensors_entry *dar_safetensors_at(const dar_safetensors *s, size_t i);

/* NULL if there is none of that name. */
const dar_safetensors_entry *dar_safetensors_find(const dar_safetensors *s, const char *name);

/* View a tensor of type F64, F32, BF16 or F16 with at most 6 dimensions; all else is refused by name.  x->data must not
 * be written.  It is aligned to its element: a tensor that lies askew in the file (the format allows it) is copied at
 * the first call, so such calls belong to one thread. */
dar_status dar_safetensors_tensor(dar_safetensors *s, const char *name, dar_tensor *x, dar_err *e);

/* A string of __metadata__, of the first file that has it; NULL: none has. */
const char *dar_safetensors_meta(const dar_safetensors *s, const char *key);

#endif
