/* patch.c: see patch.h.  Frames and token rows lie one after the other in memory, so F and h are one dimension here. */
#include "models/patch.h"

#include "autograd/ops.h"

dar_val *dar_patchify(dar_tape *t, dar_val *x, int64_t p)
{
    const int64_t *d = x->x.shape.d;
    DAR_ASSERT(x->x.shape.n == 5 && d[3] % p == 0 && d[4] % p == 0, "patchify: frames of %lld x %lld, patches of %lld",
               (long long)d[3], (long long)d[4], (long long)p);
    int64_t B = d[0], C = d[1], rows = d[2] * d[3] / p, w = d[4] / p;
    x = dar_reshape(t, x, DAR_SHAPE(B, C, rows, p, w, p));
    x = dar_permute(t, x, (int[]){ 0, 2, 4, 1, 3, 5 });
    return dar_reshape(t, x, DAR_SHAPE(B, rows * w, C * p * p));
}

dar_val *dar_unpatchify(dar_tape *t, dar_val *x, dar_shape s, int64_t p)
{
    int64_t B = s.d[0], C = s.d[1], rows = s.d[2] * s.d[3] / p, w = s.d[4] / p;
    x = dar_reshape(t, x, DAR_SHAPE(B, rows, w, p, p, C));
    x = dar_permute(t, x, (int[]){ 0, 5, 1, 3, 2, 4 });
    return dar_reshape(t, x, s);
}
