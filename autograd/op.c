/* op.c: the table of ops. */
#include "autograd/op.h"

const dar_op *const dar_ops[] = {
#define DAR_OP(name) &dar_op_##name,
#include "autograd/ops.def"
#undef DAR_OP
};

const int dar_n_ops = (int)DAR_COUNT(dar_ops);

dar_dtype dar_op_compute(const dar_opctx *c)
{
    return c->y.dtype == DAR_F64 || c->x[0].dtype == DAR_F64 ? DAR_F64 : DAR_F32;
}
