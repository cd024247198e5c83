/* lpips.h: LPIPS: how different two pictures look to a network that knows objects.
 *
 *   d = sum over five maps k of the mean over places of  sum_c w_k[c] (f[c] / |f| - g[c] / |g|)^2
 *
 * f, g: what the trunk makes of the two pictures after the ReLU of its map k; |f| = sqrt(sum_c f[c]^2) + 1e-10.
 * Pictures are not resized.  This is version 0.1, not spatial: 0 for equal pictures, the same in both directions.
 *
 * Weights are the user's: files of the trunk, as torchvision has it, and of the w_k, as the lpips package has them, or
 * one file of both, in any order and format of lib/weights.h.  Which network it is, is told by its first kernel; how
 * wide it is, by the shapes of the weights.
 *
 *   trunk   features.N.weight, .bias; or net.sliceS.N.weight, .bias
 *   w_k     lin0.model.1.weight .. lin4.model.1.weight
 *
 * Arithmetic is f32, distances are summed in f64.  Same bits for any number of threads.
 * Source: Zhang et al. 2018, eq. 1; layers of torchvision's AlexNet and VGG16. */
#ifndef DAR_MODELS_LPIPS_H
#define DAR_MODELS_LPIPS_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "lib/status.h"
#include "lib/weights.h"

typedef enum dar_lpips_net { DAR_LPIPS_ALEX, DAR_LPIPS_VGG, DAR_LPIPS_NETS } dar_lpips_net;

extern const char *const dar_lpips_name[]; /* "alex", "vgg", NULL */

typedef struct dar_lpips dar_lpips;

/* Whether one of the files holds a trunk of this kind. */
bool dar_lpips_there(dar_lpips_net net, dar_weights *const *files, size_t n);

/* For pictures of this size; plans and reserves memory.  The files must stay open.  On failure *out is NULL. */
dar_status dar_lpips_open(dar_lpips **out, dar_lpips_net net, dar_weights *const *files, size_t n, size_t width,
                          size_t height, dar_err *e);
void dar_lpips_close(dar_lpips *l); /* accepts NULL */

/* Pictures rgb [H, W, 3].  distance[0]; with a mask [H, W], distance[1] is the same with means over places weighted by
 * the share of their pixels in which the mask is 128 or more, NAN if there is no such pixel, or no mask. */
void dar_lpips_distance(dar_lpips *l, const uint8_t *a, const uint8_t *b, const uint8_t *mask, double distance[2]);

#endif
