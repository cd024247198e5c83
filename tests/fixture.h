/* fixture.h: what tests/fixtures holds. */
#ifndef DAR_TESTS_FIXTURE_H
#define DAR_TESTS_FIXTURE_H

#include "tests/test.h"

#include "autograd/tape.h"
#include "lib/weights.h"

/* Of its name there, for the caller to close. */
static inline dar_weights *fixture_open(const char *name)
{
    char path[128];
    dar_weights *w;
    dar_err e;
    snprintf(path, sizeof path, "tests/fixtures/%s", name);
    CHECK(dar_weights_open(&w, path, &e) == DAR_OK, "%s", e.text);
    return w;
}

static inline dar_tensor fixture_tensor(dar_weights *w, const char *name)
{
    dar_tensor x;
    dar_err e;
    CHECK(dar_weights_tensor(w, name, &x, &e) == DAR_OK, "%s", e.text);
    return x;
}

static inline double fixture_number(dar_weights *w, const char *name, size_t i)
{
    dar_tensor x = fixture_tensor(w, name);
    return dar_dtype_get(x.dtype, x.data, i);
}

/* x on a tape, in another type. */
static inline dar_val *fixture_input(dar_tape *t, dar_dtype type, const dar_tensor *x)
{
    dar_val *v = dar_input(t, type, x->shape);
    dar_tensor_copy(&v->x, x);
    return v;
}

#endif
