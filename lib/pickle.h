/* pickle.h: the pickles of torch.save as plain values.  Nothing is called: a state dict takes few forms, they are
 * matched, and whatever else a pickle says refuses it.
 *
 * Values are immutable but for lists and dicts under construction, refer to each other by number, and are never walked
 * in depth: a pickle costs memory and time in proportion to its bytes, whatever it refers to.
 *
 * Source: CPython's pickletools, protocol 2; torch.serialization. */
#ifndef DAR_LIB_PICKLE_H
#define DAR_LIB_PICKLE_H

#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"

#define DAR_PICKLE_VALUES ((uint32_t)4 << 20)
#define DAR_PICKLE_STACK  65536

typedef enum dar_pickle_kind {
    DAR_PICKLE_NONE,
    DAR_PICKLE_BOOL,
    DAR_PICKLE_INT,
    DAR_PICKLE_FLOAT,
    DAR_PICKLE_TEXT,
    DAR_PICKLE_GLOBAL,
    DAR_PICKLE_TUPLE,
    DAR_PICKLE_LIST,
    DAR_PICKLE_DICT, /* its items are key, value, key, value, ... */
    DAR_PICKLE_STORAGE,
    DAR_PICKLE_TENSOR,
    DAR_PICKLE_MARK,
} dar_pickle_kind;

/* An element type of torch. */
typedef struct dar_pickle_type {
    const char *storage, *dtype; /* "FloatStorage", "float32" */
    const char *name;            /* "F32" */
    size_t size;                 /* [bytes] */
} dar_pickle_type;

typedef struct dar_pickle_value {
    dar_pickle_kind kind;
    union {
        int64_t number; /* bool, int; global: which one */
        struct {
            const char *text; /* in the pickle, not terminated */
            size_t size;
        };
        struct {
            uint32_t first, last, count; /* items: cells, 0 is the end */
        };
        struct {
            uint32_t key;                   /* text */
            const dar_pickle_type *element; /* NULL: bytes, typed by the tensor */
            int64_t elements;
        };
        struct {
            uint32_t storage, shape, stride; /* values: storage, tuple, tuple */
            int64_t offset;                  /* [elements] */
            const dar_pickle_type *type;
        };
    };
} dar_pickle_value;

typedef struct dar_pickle_cell {
    uint32_t value, next;
} dar_pickle_cell;

typedef struct dar_pickle {
    const char *name; /* stands for the file in messages */
    const unsigned char *data;
    size_t size, at;

    dar_pickle_value *value; /* number 0 is None */
    uint32_t values, values_room;
    dar_pickle_cell *cell;
    uint32_t cells, cells_room;
    uint32_t *memo;
    uint32_t memos, memo_room;
    uint32_t *stack, height; /* [DAR_PICKLE_STACK] */
    dar_err *e;
} dar_pickle;

/* Values in data[at, size); `name` and data must outlive p. */
dar_status dar_pickle_init(dar_pickle *p, const char *name, const unsigned char *data, size_t size, dar_err *e);
void dar_pickle_free(dar_pickle *p); /* accepts a zeroed one */

/* Run one pickle from p->at; *top is its value and p->at the byte behind its end.  Values of pickles before stay. */
dar_status dar_pickle_next(dar_pickle *p, uint32_t *top, dar_err *e);

/* Items of a tuple, list or dict: for (c = dar_pickle_first(p, v); c; c = p->cell[c].next) p->cell[c].value. */
uint32_t dar_pickle_first(const dar_pickle *p, uint32_t v);

/* Whether the value is this text. */
int dar_pickle_is(const dar_pickle *p, uint32_t v, const char *text);

#endif
