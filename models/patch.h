/* patch.h: between video and tokens: pure rearrangements.
 *
 * Token (f h + i) w + j covers rows p i .. and columns p j .. of frame f.  The two directions order the numbers of a
 * token differently, as the reference model does: */
#ifndef DAR_MODELS_PATCH_H
#define DAR_MODELS_PATCH_H

#include "autograd/tape.h"

/* x [B, C, F, p h, p w] -> [B, F h w, C p p], number (c p + di) p + dj: channels slowest, like a convolution's weight.
 */
dar_val *dar_patchify(dar_tape *t, dar_val *x, int64_t p);

/* x [B, F h w, p p C], number (di p + dj) C + c: channels fastest -> [B, C, F, p h, p w] = s. */
dar_val *dar_unpatchify(dar_tape *t, dar_val *x, dar_shape s, int64_t p);

#endif
