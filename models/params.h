/* params.h: the table of parameters that loaders, LoRA, optimisers and checkpoints walk.
 *
 * A network declares what it has: name and shape as in the public checkpoint, role, how a fresh one is made.  Memory
 * comes afterwards, so that a caller can decide in between:
 *
 *     dar_params_init(&p, &model, DAR_BF16);
 *     dar_dit_init(&m, &p, &config.dit, &config.adapter);        declares
 *     dar_params_train(&p, DAR_PARAM_LORA);                      what gets gradients
 *     dar_param_bind(&p, dar_params_find(&p, name), &x);         values from a file, or views of it
 *     dar_params_fresh(&p, DAR_PARAM_ALL, seed);                 the rest
 *     dar_params_gradients(&p);
 *
 * Types: a matrix is stored in the table's storage type (it is an operand of a large product), everything else in its
 * arithmetic type, and so is every trainable tensor: a bf16 weight loses updates below 2^-9 of it.
 *
 * Values and gradients lie in the model arena or in a mapped file; on a planning arena they are only counted.  The
 * table itself is on the heap; entries keep their addresses. */
#ifndef DAR_MODELS_PARAMS_H
#define DAR_MODELS_PARAMS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "autograd/tape.h"
#include "lib/arena.h"
#include "lib/tensor.h"

#define DAR_PARAM_NAME 96

/* What a parameter belongs to: bits, so that sets can be named. */
typedef enum dar_param_role {
    DAR_PARAM_BASE = 1,    /* the network */
    DAR_PARAM_ADAPTER = 2, /* its control adapter */
    DAR_PARAM_LORA = 4,    /* low-rank additions */
    DAR_PARAM_ALL = 7,
} dar_param_role;

/* How a fresh one is made: `spread` everywhere, uniform in +- spread, or normal with deviation `spread`. */
typedef enum dar_param_law { DAR_FRESH_VALUE, DAR_FRESH_UNIFORM, DAR_FRESH_NORMAL } dar_param_law;

typedef struct dar_param_info {
    dar_param_role role;
    bool matrix;
    dar_param_law law;
    double spread;
} dar_param_info;

typedef struct dar_param {
    char name[DAR_PARAM_NAME];
    dar_param_info info;
    bool trainable;
    bool mapped;  /* x views memory that is not the arena's: read-only */
    dar_tensor x; /* data NULL: no value yet */
    dar_tensor g; /* data NULL: none */
} dar_param;

typedef struct dar_params {
    dar_arena *arena;
    dar_dtype storage; /* of matrices */
    dar_dtype main;    /* of the rest, and of the arithmetic: f64 if storage is, else f32 */
    dar_param **at;
    size_t count, room;
} dar_params;

/* An empty table whose tensors will come from `arena`. */
void dar_params_init(dar_params *p, dar_arena *arena, dar_dtype storage);
void dar_params_free(dar_params *p); /* the table, not the tensors; accepts a zeroed one */

/* Declare one.  Aborts if the name exists or is too long. */
dar_param *dar_params_add(dar_params *p, dar_param_info info, dar_shape s, const char *name, ...)
    __attribute__((format(printf, 4, 5)));

dar_param *dar_params_find(const dar_params *p, const char *name); /* NULL if there is none */

/* Parameters of these roles become trainable.  Before they have values. */
void dar_params_train(dar_params *p, unsigned roles);

/* Give q the value x, of its shape: a view if x is stored as q is declared and will not be written (q is frozen), else
 * a converted copy in the arena. */
void dar_param_bind(dar_params *p, dar_param *q, const dar_tensor *x);

/* Memory for q's value, content undefined, if it has none yet. */
void dar_param_push(dar_params *p, dar_param *q);

/* Fresh values for q, or for those of these roles, where there are none: a pure function of seed and name. */
void dar_param_fresh(dar_params *p, dar_param *q, uint64_t seed);
void dar_params_fresh(dar_params *p, unsigned roles, uint64_t seed);

/* Gradient memory, zeroed, for every trainable parameter that has none. */
void dar_params_gradients(dar_params *p);

/* Numbers in the parameters of these roles. */
size_t dar_params_count(const dar_params *p, unsigned roles);

/* The parameter on a tape; q NULL: NULL. */
dar_val *dar_param_leaf(dar_tape *t, const dar_param *q);

/* The same as operand of a product in `type`: what is kept wide because it is trained is rounded on the way. */
dar_val *dar_param_operand(dar_tape *t, const dar_param *q, dar_dtype type);

#endif
