/* sampler.h: from noise to the latent of a video: a solver's steps around the transformer.
 *
 *     v = c + (g - 1) (c - u)    the velocity that a step takes: c with the prompt, u with the negative one, g guidance
 *
 * Work is done at the rate at which its input changes.  Each way of not doing something twice is exact, has a name, and
 * can be left off, so that it can be compared and its saving told:
 *
 *   pass      equal prompts, or g = 1: u is not computed
 *   scene     adapter and known video enter the patch embedding once, not in every call of the network
 *   text      keys and values of a prompt once, not in every call
 *   times     one embedding of time for the first frame and one for the rest, not one per frame
 *   padding   the zeros after a prompt are one weighted key
 *   begin     what comes before the first word is read, to the first block's self-attention, is done for both prompts
 *   held      of a first frame that is known the last block makes keys and values alone: its velocity is not used
 *   lora      low-rank additions are added to the weights once (models/model.h)
 *   repeat    pieces of the known video that must encode to the same are not encoded (infer/pipeline.h)
 *
 * A clip longer than the network was trained for is seen through windows.  Each is the first frame, which is what the
 * clip shall look like, and a run of those after it, with their own share of the condition: rays and geometry say which
 * point of the first frame a point of a later one is, however far apart the two are in time.  Neighbours overlap; there
 * the velocity goes over from one to the other in equal steps, at every step of the solver, so that there is one latent
 * and no seam to repair.  One window is the plain run.
 *
 * Of steps that are not asked (models/reuse.h) the blocks are not run: an approximation, to compare others with.
 *
 * One clip at a time; the same bits for any number of threads.  Source: the paper, section 4.3; Ho and Salimans 2022,
 * eq. 6 (guidance). */
#ifndef DAR_MODELS_SAMPLER_H
#define DAR_MODELS_SAMPLER_H

#include "models/dit.h"
#include "models/guidance.h"
#include "models/reuse.h"
#include "models/solver.h"

typedef enum dar_skip {
    DAR_SKIP_PASS,
    DAR_SKIP_SCENE,
    DAR_SKIP_TEXT,
    DAR_SKIP_TIMES,
    DAR_SKIP_PADDING,
    DAR_SKIP_BEGIN,
    DAR_SKIP_HELD,
    DAR_SKIP_LORA,
    DAR_SKIP_REPEAT,
    DAR_SKIPS
} dar_skip;

extern const char *const dar_skip_name[DAR_SKIPS + 1]; /* "pass", ..., NULL */

#define DAR_SKIPS_ALL ((1u << DAR_SKIPS) - 1)

typedef struct dar_sampler_config {
    dar_solver_config solver;
    double guidance;           /* g; 1: none */
    double guidance_tolerance; /* G (models/guidance.h); 0: u is computed in every step */
    unsigned skip;             /* bits 1 << dar_skip */
    dar_reuse_config reuse;    /* with a rule, both tolerances are 0 */
} dar_sampler_config;

/* The paper's: 50 steps of Euler, shift 5, guidance 3; every skip. */
dar_sampler_config dar_sampler_default(void);

/* What is constant over a clip; lives as long as the sampler. */
typedef struct dar_sampler_clip {
    int64_t frames, height, width; /* of the latent */
    dar_tensor cond;               /* [1, C, F, H, W] of the adapter, f32; data NULL: its output counts as 0 */
    dar_tensor text[2];            /* [1, n, text width]: prompt, negative prompt; data NULL: no token */
    int64_t window, overlap;       /* latent frames of a window, the first included; of two after it.  0: one window */
} dar_sampler_clip;

/* How many windows a clip takes: as few as overlap by that much or more.  Window i is the clip's frame 0 and, spread
 * evenly, window - 1 frames from `first`. */
int64_t dar_sampler_windows(const dar_sampler_clip *c);
int64_t dar_sampler_window_first(const dar_sampler_clip *c, int64_t i);

typedef struct dar_sampler {
    const dar_dit *m;
    dar_sampler_config c;
    dar_sampler_clip clip;
    bool twice;      /* a step calls the network for both prompts */
    size_t calls;    /* of the network, so far */
    int64_t windows; /* 1: there is one, of the whole clip */

    /* Of the last run (models/solver.h): steps that were called, of them taken back, estimated error. */
    size_t steps, rejected;
    double estimate;
    size_t left_out; /* steps without u; and the error of what stood for it, where that was compared */
    double worst;
    size_t reused; /* steps in which the blocks were not run */

    /* Of the sampler itself. */
    dar_tape kept, step;
    dar_dit_scene *scene; /* [windows] */
    dar_dit_text text[2];
} dar_sampler;

/* Prepare the clip.  What lives as long as the sampler, or a run, lies in `kept`, what lives a call in `step`; both may
 * be planning arenas, then nothing is computed.  On failure *s is freed. */
dar_status dar_sampler_init(dar_sampler *s, const dar_dit *m, const dar_sampler_config *c, const dar_sampler_clip *clip,
                            dar_arena *kept, dar_arena *step, dar_err *e);
void dar_sampler_free(dar_sampler *s); /* accepts a zeroed one; the arenas are the caller's */

/* After each call of the solver's: how many of its steps are done (with a tolerance, several at a time, and fewer where
 * some are taken back), the latent as it is, and where the call saw it go: z - sigma v.  Anything but DAR_OK ends the
 * run. */
typedef dar_status dar_sampler_told(void *ctx, size_t done, const dar_tensor *z, const dar_tensor *clean, dar_err *e);

/* z [1, latent, F, h, w] of the main type: noise becomes the latent.
 *
 * known [1, mask + latent, F, h, w] (dar_dit_known), or NULL: nothing is.  first, whose first frame z's keeps, and
 * whose time is then 0, or NULL.  May be called again, for the same clip with another picture or noise.
 * DAR_ERR_NUMERIC: the velocity of a step is not finite.  DAR_ERR_CHECK: the estimated error exceeds the solver's
 * budget. */
dar_status dar_sampler_run(dar_sampler *s, const dar_tensor *known, const dar_tensor *first, const dar_tensor *z,
                           dar_sampler_told *told, void *ctx, dar_err *e);

/* So far, preparation included [FLOP]. */
double dar_sampler_flops(const dar_sampler *s);

/* Noise for z, the same in every type but for rounding: the program's own stream, or what torch.randn of this shape
 * gives in f32 after torch.manual_seed(seed), for which `scratch` holds z in f32. */
typedef enum dar_noise { DAR_NOISE_OWN, DAR_NOISE_TORCH } dar_noise;
void dar_sampler_noise(dar_noise kind, uint64_t seed, const dar_tensor *z, dar_arena *scratch);

#endif
