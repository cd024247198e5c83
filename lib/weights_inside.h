/* weights_inside.h: what the readers of weight formats share: weights.c and the files named there.  Nobody else. */
#ifndef DAR_LIB_WEIGHTS_INSIDE_H
#define DAR_LIB_WEIGHTS_INSIDE_H

#include "lib/file.h"
#include "lib/json.h"
#include "lib/weights.h"

struct dar_weight_entry {
    dar_weight pub; /* first: the two convert into each other */
    void *copy;     /* aligned, of what lies askew */
};

struct dar_weight_file {
    char *name;
    dar_file_map map;  /* zero: the caller's memory */
    dar_json_doc *doc; /* safetensors: the header, whose strings are the names */
    dar_json meta;
    char *text; /* torch: the names */
};

struct dar_weights {
    char *path; /* as opened, for messages */
    struct dar_weight_file *file;
    size_t files;
    struct dar_weight_entry *entry;
    size_t entries;
    const struct dar_weight_entry **by_name; /* sorted: found by halving, which no choice of names can slow down */
};

/* Room for `more` entries behind those there are; entries are not counted up.  NULL: out of memory, said in e. */
struct dar_weight_entry *dar_weights_room(dar_weights *s, const struct dar_weight_file *f, size_t more, dar_err *e);

/* Append the tensors of data[0, size), the content of f, whose name is set. */
typedef dar_status dar_weights_read(dar_weights *s, struct dar_weight_file *f, const unsigned char *data, size_t size,
                                    dar_err *e);
dar_weights_read dar_safetensors_read, dar_torch_read;

dar_status dar_weights_no_memory(const char *name, dar_err *e);

#endif
